"""Hierarchical quadruped locomotion over footstep targets.

Conventions, everywhere: SI units, quaternions ``wxyz``, legs and feet in the order FL, FR, RL, RR, the world's z axis up.
"""

from __future__ import annotations

import os

# PyTorch's OpenMP workers spin between operations by default, and so starve MuJoCo's thread pool (a 512-row forward
# pass then takes 54 ms instead of 1 ms). libgomp reads this once, when torch is first imported.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

__version__ = "0.1.0"
