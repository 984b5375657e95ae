"""TorchRL environments of the paper's tasks."""

from __future__ import annotations

from quadhrl.envs.base import LocomotionConfig, LocomotionEnv
from quadhrl.envs.footstep import FootstepConfig, FootstepEnv

__all__ = ["FootstepConfig", "FootstepEnv", "LocomotionConfig", "LocomotionEnv"]
