"""Hierarchical quadruped locomotion over footstep targets.

Conventions, everywhere: SI units, quaternions ``wxyz``, legs and feet in the order FL, FR, RL, RR, the world's z axis up.
"""

from __future__ import annotations

import os
import sys

# How long PyTorch's OpenMP workers spin before they sleep. By default they spin for milliseconds after each operation and
# starve MuJoCo's thread pool (physics at 0.65 of its speed); without any spinning each operation pays for a wake-up (updates
# take 1.25 times as long). libgomp reads this once, when torch is first imported.
os.environ.setdefault("GOMP_SPINCOUNT", "20000")

# MuJoCo picks its OpenGL backend when it is first imported; without a screen only EGL (or osmesa) can work.
if sys.platform == "linux" and not os.environ.get("DISPLAY"):
    os.environ.setdefault("MUJOCO_GL", "egl")

__version__ = "0.1.0"
