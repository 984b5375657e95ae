"""The low-level policy's task: hit a sequence of footstep targets (paper, section II)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Unbounded

from quadhrl.envs import rewards
from quadhrl.envs.base import LocomotionConfig, LocomotionEnv, SharedRewardConfig, TerminationConfig
from quadhrl.envs.scan import SCAN_POINTS
from quadhrl.envs.symmetry import ACTION, BODY, PHASE_AND_ACTIONS, SCAN, Mirror, entries, join, legs
from quadhrl.envs.targets import FootstepTargets, TargetConfig
from quadhrl.errors import check_range
from quadhrl.rotations import rotate_yaw
from quadhrl.sim import Readings

__all__ = ["FootstepConfig", "FootstepEnv", "FootstepRewardConfig", "FootstepTerminationConfig"]


@dataclass
class FootstepRewardConfig(SharedRewardConfig):
    """Coefficients of the footstep task's reward terms."""

    footstep_target: float = 2.0
    """Coefficient of the footstep target reward."""
    velocity_towards_target: float = 0.25
    """Coefficient of the feet's speed towards their targets [s/m]."""
    foot_stay: float = 0.25
    """Coefficient of the foot stay reward."""
    hit_radius: float = 0.075
    """A foot within this of its target can hit it [m]."""
    hit_force: float = 5.0
    """Least vertical contact force of a hit [N]."""

    def validate(self) -> None:
        """Check the fields that are no coefficients.

        Raises:
            InputError: a field is out of its range.
        """
        check_range(self, "rewards", "hit_radius slip_distance", 0, 1, "m", above=True)
        check_range(self, "rewards", "hit_force", 0, unit="N")


@dataclass
class FootstepTerminationConfig(TerminationConfig):
    """When an episode of the footstep task ends."""

    stuck_seconds: float = 5.0
    """The episode ends when no pair of targets has been hit for this long [s]."""

    def validate(self) -> None:
        """Check every field.

        Raises:
            InputError: a field is out of its range.
        """
        super().validate()
        check_range(self, "termination", "stuck_seconds", 0, unit="s", above=True)


@dataclass
class FootstepConfig(LocomotionConfig):
    """Settings of the footstep task."""

    targets: TargetConfig = field(default_factory=TargetConfig)
    rewards: FootstepRewardConfig = field(default_factory=FootstepRewardConfig)
    termination: FootstepTerminationConfig = field(default_factory=FootstepTerminationConfig)


class FootstepEnv(LocomotionEnv):
    """Observation: ``proprioception`` [N, 80], ``goal`` [N, 12], ``scan`` [N, 284]; action [N, 15] in [-1, 1].

    ``proprioception`` holds foot positions (12) and velocities (12), joint torques (12), roll, pitch and their rates (4),
    foot contacts (4), the active feet (4), cos and sin of the phase (2) and the last two actions (30). ``goal`` holds the
    horizontal vector from each foot to its target (8: the next one of an active foot, the current one of a stance foot) and
    from the two stance feet to their following targets (4), turned by -yaw. A policy that sets another ``goal`` gives the
    robot other targets: the environment adopts them before it steps.

    For policies that choose targets, in the world's frame: ``yaw`` [N, 1] (rad), ``feet`` [N, 4, 2] (m), ``footholds``
    [N, 4, 2], the target that each foot hit last (m), and ``pair`` [N, 1], the number of the active pair.
    """

    config: FootstepConfig
    network_inputs: ClassVar[dict[str, int]] = {"proprioception": 80, "goal": 12, "scan": 4 * SCAN_POINTS}
    mirrors: ClassVar[dict[str, Mirror]] = {
        "proprioception": join(BODY, legs(entries(1)), PHASE_AND_ACTIONS),
        "goal": join(legs(entries(1, -1)), entries(1, -1, 1, -1)),
        "scan": SCAN,
        "action": ACTION,
    }
    reward_names = (
        "footstep_target",
        "velocity_towards_target",
        "smoothness",
        "foot_slip",
        "foot_stay",
        "collision",
        "swing_phase",
    )
    terminal_events = (*LocomotionEnv.terminal_events, "stuck")
    event_names = (*LocomotionEnv.event_names, "stuck", "pair_hit")

    def _set_up_task(self) -> None:
        self.config.rewards.validate()
        self.targets = FootstepTargets(self.config.targets, self.nominal_feet, self.terrain)
        self.steps_since_hit = torch.zeros(self.num_envs, dtype=torch.long, device=self.device)
        """Control steps since the last pair was hit, or since the episode began [N]."""
        self._stuck_steps = round(self.config.termination.stuck_seconds / self.config.physics.control_dt)
        self._pair_hit = torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        self._adopt_choices(tensordict)
        out = super()._step(tensordict)
        return out.set(
            "goal", out["goal"].clone()
        )  # a policy may write into it; `_adopt_choices` compares with the original

    def _task_specs(self) -> dict[str, Any]:
        n = self.num_envs
        return {
            "proprioception": Unbounded(shape=(n, 80), device=self.device),
            "goal": Unbounded(shape=(n, 12), device=self.device),
            "yaw": Unbounded(shape=(n, 1), device=self.device),
            "feet": Unbounded(shape=(n, 4, 2), device=self.device),
            "footholds": Unbounded(shape=(n, 4, 2), device=self.device),
            "pair": Unbounded(shape=(n, 1), dtype=torch.long, device=self.device),
        }

    def _reset_task(self, worlds: Tensor) -> None:
        self.targets.reset(worlds)
        self.steps_since_hit[worlds] = 0

    def _episode_score(self, worlds: Tensor) -> Tensor:
        """Pairs hit per second relative to 6, which a gait of 3 Hz allows."""
        seconds = self.step_count[worlds] * self.config.physics.control_dt
        return (self.targets.index[worlds] - 1) / seconds.clamp(min=1.0) / 6.0

    def _reward_terms(self, before: Readings, now: Readings, action: Tensor) -> dict[str, Tensor]:
        weights, active = self.config.rewards, self.targets.active
        to_target = self.targets.position - now.foot_position[..., :2]
        distance = to_target.norm(dim=-1)
        # A hit counts only in the foot's own support half: with the paper's complement of S for both pairs, a robot that
        # stands on in-place targets collects hits three times faster than its gait allows.
        hit = (distance < weights.hit_radius) & (now.foot_force[..., 2] > weights.hit_force) & self.generator.support
        self._pair_hit = (hit | ~active).all(-1) & (self.sim.fault == 0)
        closeness = rewards.target_closeness(distance, hit, weights.hit_radius)
        velocity = rewards.velocity_towards_target(to_target, now.foot_velocity[..., :2], active)
        shared = self._shared_reward_terms(weights, before, now, action)
        return {
            "footstep_target": weights.footstep_target * rewards.footstep_target(closeness, hit, active),
            "velocity_towards_target": weights.velocity_towards_target * velocity,
            "foot_stay": weights.foot_stay * rewards.foot_stay(closeness, active),
        } | shared

    def _task_events(self) -> dict[str, Tensor]:
        """Advance the targets where a pair was hit (after the reward, before the observation) and say what happened."""
        hit = self._pair_hit
        self.steps_since_hit = torch.where(hit, 0, self.steps_since_hit + 1)
        self.targets.advance(hit)
        return {"stuck": self.steps_since_hit >= self._stuck_steps, "pair_hit": hit}

    def _task_observation(self, readings: Readings, worlds: Tensor) -> dict[str, Tensor]:
        targets = self.targets
        parts = [*self._shared_proprioception(readings, worlds), targets.active[worlds].float()]
        feet = readings.foot_position[..., :2]
        stance_feet = feet.gather(1, targets.stance_feet[worlds][..., None].expand(-1, -1, 2))
        to_targets = torch.cat([targets.position[worlds] - feet, targets.following[worlds] - stance_feet], 1)
        yaw = self._attitude.yaw[worlds][:, None]
        return {
            "proprioception": torch.cat([*parts, *self._phase_and_actions(worlds)], -1),
            "goal": rotate_yaw(to_targets, torch.cos(yaw), -torch.sin(yaw)).flatten(1),
            "yaw": yaw,
            "feet": feet,
            "footholds": targets.footholds[worlds],
            "pair": targets.index[worlds][:, None],
        }

    def _adopt_choices(self, tensordict: TensorDictBase) -> None:
        """Where the policy has set another goal than the one observed, turn it back into targets in the world."""
        goal, observed = tensordict.get("goal", None), self._observation["goal"]
        if goal is None:
            return
        targets, yaw = self.targets, self._attitude.yaw[:, None]
        feet = self.sim.readings.foot_position[..., :2]
        stance_feet = feet.gather(1, targets.stance_feet[..., None].expand(-1, -1, 2))
        vectors = rotate_yaw(goal.view(-1, 6, 2), torch.cos(yaw), torch.sin(yaw))
        # Only what was changed: turning there and back would move the other targets by rounding errors, step by step.
        changed = ((goal != observed) & goal.isfinite()).view(-1, 6, 2).any(-1, keepdim=True)
        targets.adopt(
            torch.where(changed[:, :4], feet + vectors[:, :4], targets.position),
            torch.where(changed[:, 4:], stance_feet + vectors[:, 4:], targets.following),
        )

    def _task_state(self) -> dict[str, Tensor]:
        return self.targets.state_dict() | {"steps_since_hit": self.steps_since_hit}

    def _load_task_state(self, state: dict[str, Tensor]) -> None:
        self.targets.load_state_dict(state)
        self.steps_since_hit = state["steps_since_hit"].to(self.device)
