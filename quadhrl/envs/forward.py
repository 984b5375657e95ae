"""The end-to-end baseline's task: walk forward, without targets (paper, section IV-B)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import torch
from torch import Tensor
from torchrl.data import Unbounded

from quadhrl.envs import rewards
from quadhrl.envs.base import LocomotionConfig, LocomotionEnv, SharedRewardConfig
from quadhrl.envs.scan import SCAN_POINTS
from quadhrl.envs.symmetry import ACTION, BODY, PHASE_AND_ACTIONS, SCAN, Mirror, entries, join
from quadhrl.errors import check_range
from quadhrl.sim import Readings

__all__ = ["ForwardConfig", "ForwardEnv", "ForwardRewardConfig"]


@dataclass
class ForwardRewardConfig(SharedRewardConfig):
    """Coefficients of the forward task's reward terms."""

    forward_velocity: float = 1.0
    """Coefficient of the forward velocity, kappa_VX [s/m]."""
    lateral_velocity: float = 0.1
    """Coefficient of the sideways speed's penalty, kappa_VY [s/m]."""
    max_velocity: float = 0.5
    """Forward velocity above which nothing more is paid [m/s]."""
    lateral_power: int = 1
    """Exponent of the sideways speed: 1 as in the paper's text, 2 as in its authors' code."""

    def validate(self) -> None:
        """Check the fields that are no coefficients.

        Raises:
            InputError: a field is out of its range.
        """
        check_range(self, "rewards", "max_velocity", 0, unit="m/s", above=True)
        check_range(self, "rewards", "lateral_power", 1, 2)
        check_range(self, "rewards", "slip_distance", 0, 1, "m", above=True)


@dataclass
class ForwardConfig(LocomotionConfig):
    """Settings of the forward task."""

    rewards: ForwardRewardConfig = field(default_factory=ForwardRewardConfig)


class ForwardEnv(LocomotionEnv):
    """Observation: ``proprioception`` [N, 77], ``scan`` [N, 284]; action [N, 15] in [-1, 1].

    ``proprioception`` is the footstep task's without the active feet and with the yaw: foot positions (12) and velocities
    (12), joint torques (12), roll, pitch and their rates (4), foot contacts (4), yaw (1), cos and sin of the phase (2) and
    the last two actions (30). The paper's list of reward terms leaves foot stay in; it has no meaning without targets, and
    its authors' code has none either.
    """

    config: ForwardConfig
    network_inputs: ClassVar[dict[str, int]] = {"proprioception": 77, "scan": 4 * SCAN_POINTS}
    mirrors: ClassVar[dict[str, Mirror]] = {
        "proprioception": join(BODY, entries(-1), PHASE_AND_ACTIONS),
        "scan": SCAN,
        "action": ACTION,
    }
    reward_names = ("forward_velocity", "lateral_velocity", "smoothness", "foot_slip", "collision", "swing_phase")

    def _set_up_task(self) -> None:
        self.config.rewards.validate()

    def _task_specs(self) -> dict[str, Any]:
        return {"proprioception": Unbounded(shape=(self.num_envs, 77), device=self.device)}

    def _reset_task(self, worlds: Tensor) -> None:
        pass

    def _episode_score(self, worlds: Tensor) -> Tensor:
        """Mean forward velocity relative to the one that is paid for."""
        seconds = self.step_count[worlds] * self.config.physics.control_dt
        distance = self.sim.readings.base_position[worlds, 0]
        return distance / seconds.clamp(min=1.0) / self.config.rewards.max_velocity

    def _reward_terms(self, before: Readings, now: Readings, action: Tensor) -> dict[str, Tensor]:
        weights, velocity = self.config.rewards, now.base_velocity
        sideways = rewards.lateral_velocity(velocity[:, 1], weights.lateral_power)
        return {
            "forward_velocity": weights.forward_velocity
            * rewards.forward_velocity(velocity[:, 0], weights.max_velocity),
            "lateral_velocity": weights.lateral_velocity * sideways,
        } | self._shared_reward_terms(weights, before, now, action)

    def _task_events(self) -> dict[str, Tensor]:
        return {}

    def _task_observation(self, readings: Readings, worlds: Tensor) -> dict[str, Tensor]:
        parts = [*self._shared_proprioception(readings, worlds), self._attitude.yaw[worlds][:, None]]
        return {"proprioception": torch.cat([*parts, *self._phase_and_actions(worlds)], -1)}

    def _task_state(self) -> dict[str, Tensor]:
        return {}

    def _load_task_state(self, state: dict[str, Tensor]) -> None:
        pass
