"""TorchRL environments of the paper's tasks."""

from __future__ import annotations

from quadhrl.envs.base import LocomotionConfig, LocomotionEnv
from quadhrl.envs.footstep import FootstepConfig, FootstepEnv
from quadhrl.envs.forward import ForwardConfig, ForwardEnv

__all__ = [
    "ENVIRONMENTS",
    "FootstepConfig",
    "FootstepEnv",
    "ForwardConfig",
    "ForwardEnv",
    "LocomotionConfig",
    "LocomotionEnv",
]

ENVIRONMENTS: dict[str, type[LocomotionEnv]] = {"footstep": FootstepEnv, "forward": ForwardEnv}
"""The environment of each task, by the task's name."""
