"""Hierarchical quadruped locomotion over footstep targets.

Conventions, everywhere: SI units, quaternions ``wxyz``, legs and feet in the order FL, FR, RL, RR, the world's z axis up.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from quadhrl.trainers.checkpoint import LoadedPolicy

__all__ = ["__version__", "load_policy"]

# How long PyTorch's OpenMP workers spin before they sleep. By default they spin for milliseconds after each operation and
# starve MuJoCo's thread pool (physics at 0.65 of its speed); without any spinning each operation pays for a wake-up (updates
# take 1.25 times as long). libgomp reads this once, when torch is first imported.
os.environ.setdefault("GOMP_SPINCOUNT", "20000")

# MuJoCo picks its OpenGL backend when it is first imported; without a screen only EGL (or osmesa) can work.
if sys.platform == "linux" and not os.environ.get("DISPLAY"):
    os.environ.setdefault("MUJOCO_GL", "egl")

__version__ = "0.1.0"


def load_policy(name: str | Path, *, device: str = "cpu") -> LoadedPolicy:
    """Load a trained policy: its networks, the settings it was trained with, and what is known of it.

    Args:
        name: a shipped policy, ``footstep`` (the low-level policy) or ``forward`` (the end-to-end baseline), or the path of
            a checkpoint or run directory.
        device: where the networks go.

    Raises:
        InputError: there is no such policy, or its file is damaged or of another version.
    """
    from quadhrl.trainers.checkpoint import (
        load_networks,  # only now: torch must not be imported before the settings above
    )

    return load_networks(name, device=device, field="name")
