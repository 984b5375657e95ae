"""What the footstep and the forward task share: a robot driven through the trajectory generator, as a TorchRL environment."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, field
from typing import Any, ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from quadhrl.envs import rewards
from quadhrl.envs.curriculum import CurriculumConfig, TerrainCurriculum
from quadhrl.envs.scan import SCAN_POINTS, scan, scan_pattern
from quadhrl.envs.symmetry import Mirror
from quadhrl.envs.threads import one_thread_for_small_batches
from quadhrl.envs.trajectory_generator import ACTION_DIM, TrajectoryGenerator, TrajectoryGeneratorConfig
from quadhrl.errors import check_range
from quadhrl.robots import get_robot
from quadhrl.rotations import RollPitchYaw, roll_pitch_yaw, rotate_vectors, rotate_yaw
from quadhrl.sim import PhysicsConfig, Readings, TerrainConfig, make_simulator

__all__ = ["LocomotionConfig", "LocomotionEnv", "SharedRewardConfig", "TerminationConfig"]


@dataclass
class SharedRewardConfig:
    """Coefficients of the reward terms that both tasks have (paper, section II-D; facts of the authors' code, 1.4)."""

    smoothness: float = -0.03125
    """Coefficient of the actions' second difference (a penalty, so negative)."""
    foot_slip: float = 0.0625
    """Coefficient of the foot slip penalty, per slipping foot."""
    collision: float = 0.125
    """Coefficient of the collision penalty, per colliding link."""
    swing_phase: float = 0.5
    """Coefficient of the swing phase reward [1/Hz]."""
    slip_distance: float = 0.02
    """Horizontal motion in one step above which a foot in contact slips [m]."""


@dataclass
class TerminationConfig:
    """When an episode ends."""

    max_steps: int = 3600
    """Control steps after which an episode is truncated."""
    fall_height: float = 0.0
    """The robot has fallen when its base is lower than this above the lowest nominal block top [m]."""
    max_tilt: float = 90.0
    """The robot has tilted over when its roll or pitch exceeds this [degrees]."""
    goal_distance: float = 8.5
    """The episode is a success, and is truncated, when the base has come this far in x [m]."""

    def validate(self) -> None:
        """Check every field.

        Raises:
            InputError: a field is out of its range.
        """
        check_range(self, "termination", "max_steps", 1)
        check_range(self, "termination", "max_tilt", 0, 180, "degrees", above=True)
        check_range(self, "termination", "goal_distance", 0, unit="m", above=True)


@dataclass
class LocomotionConfig:
    """Settings that both tasks share."""

    robot: str = "aliengo"
    """Name of the robot; see quadhrl.robots.ROBOTS."""
    terrain: TerrainConfig = field(default_factory=TerrainConfig)
    physics: PhysicsConfig = field(default_factory=PhysicsConfig)
    generator: TrajectoryGeneratorConfig = field(default_factory=TrajectoryGeneratorConfig)
    termination: TerminationConfig = field(default_factory=TerminationConfig)
    curriculum: CurriculumConfig = field(default_factory=CurriculumConfig)
    scan_clip: float = 1.0
    """The terrain scan is clipped to +- this [m]; a gap shows as this value."""


class LocomotionEnv(EnvBase):
    """N robots in lock-step; a task adds its reward terms, its observations and its reasons to end an episode.

    Observation keys: ``proprioception`` [N, 80] or what the task makes of it, ``scan`` [N, 284], the task's own, and for
    the record ``reward_terms`` (weighted, by name, [N, 1] each) and ``events`` (``step_count``, and why an episode ended).
    A world resets only through `reset`, so ``("next", ...)`` holds the true terminal observation.

    Args:
        config: the task's settings.
        num_envs: number of worlds, N.
        engine: "native", "warp" or "auto".
        device: where the tensors live.
        seed: seed of targets and terrains.
    """

    batch_locked = True
    reward_names: tuple[str, ...]
    """Names of the task's reward terms."""
    network_inputs: ClassVar[dict[str, int]]
    """Observation keys that policy and value function see, and their sizes, in input order."""
    mirrors: ClassVar[dict[str, Mirror]]
    """How each of them and the action look in a mirror (see `quadhrl.envs.symmetry`)."""

    def __init__(
        self,
        config: LocomotionConfig,
        num_envs: int,
        *,
        engine: str = "auto",
        device: torch.device | str = "cpu",
        seed: int = 0,
    ) -> None:
        config.termination.validate()
        check_range(config, "", "scan_clip", 0, unit="m", above=True)
        robot = get_robot(config.robot)
        self.sim = make_simulator(
            robot, config.terrain, config.physics, num_envs, engine=engine, device=device, seed=seed
        )
        super().__init__(device=self.sim.device, batch_size=[num_envs])
        self.config = config
        device = self.sim.device
        self.terrain = self.sim.terrain
        self.curriculum = TerrainCurriculum(config.curriculum, self.terrain)
        self.generator = TrajectoryGenerator(config.generator, robot, num_envs, config.physics.control_dt, device)
        self.step_count = torch.zeros(num_envs, dtype=torch.long, device=device)
        """Steps of the present episode [N]."""
        self._previous_action = torch.zeros(num_envs, 2, ACTION_DIM, device=device)  # the last, and the one before
        self._attitude = RollPitchYaw(*torch.zeros(3, num_envs, device=device))
        self._hip_offset = torch.tensor(robot.hip_offset, device=device)
        self._scan_pattern = scan_pattern(device)
        self.nominal_feet = self.sim.readings.foot_position[0, :, :2].clone()
        """Horizontal foot positions at reset [4, 2], m."""
        self._observation: TensorDict
        self._set_up_task()
        self._make_specs()

    # ---- what a task adds ------------------------------------------------------------------------------------------

    @abstractmethod
    def _set_up_task(self) -> None:
        """Create the task's own state."""

    @abstractmethod
    def _task_specs(self) -> dict[str, Any]:
        """Specs of the task's own observations."""

    @abstractmethod
    def _reset_task(self, worlds: Tensor) -> None:
        """Begin new episodes in the worlds [K]."""

    @abstractmethod
    def _episode_score(self, worlds: Tensor) -> Tensor:
        """How well the episodes that end in the worlds [K] went, 0 to 1, for the curriculum."""

    @abstractmethod
    def _reward_terms(self, before: Readings, now: Readings, action: Tensor) -> dict[str, Tensor]:
        """Weighted reward terms by name, [N] each."""

    @abstractmethod
    def _task_events(self) -> dict[str, Tensor]:
        """Facts of this step by name, bool [N]; one named like an entry of `terminal_events` ends the episode."""

    @abstractmethod
    def _task_observation(self, readings: Readings, worlds: Tensor) -> dict[str, Tensor]:
        """The task's own observations of the worlds [K]."""

    terminal_events: tuple[str, ...] = ("fall", "tilt", "fault")
    """Events that terminate an episode; ``timeout`` and ``success`` truncate it."""
    event_names: tuple[str, ...] = ("fall", "tilt", "fault", "timeout", "success")
    """All events."""

    # ---- the TorchRL interface -------------------------------------------------------------------------------------

    def _make_specs(self) -> None:
        n, device = self.num_envs, self.device
        self._terminal_columns = [self.event_names.index(name) for name in self.terminal_events]
        flag = Binary(n=1, shape=(n, 1), dtype=torch.bool, device=device)
        unbounded = Unbounded(shape=(n, 1), device=device)
        events = {name: flag.clone() for name in self.event_names}
        step_count = Unbounded(shape=(n, 1), dtype=torch.long, device=device)
        self.observation_spec = Composite(
            scan=Unbounded(shape=(n, 4 * SCAN_POINTS), device=device),
            **self._task_specs(),
            reward_terms=Composite({name: unbounded.clone() for name in self.reward_names}, shape=(n,), device=device),
            events=Composite(**events, step_count=step_count, shape=(n,), device=device),
            shape=(n,),
            device=device,
        )
        self.action_spec = Bounded(-1.0, 1.0, shape=(n, ACTION_DIM), device=device)
        self.reward_spec = Unbounded(shape=(n, 1), device=device)
        self.full_done_spec = Composite(
            done=flag.clone(), terminated=flag.clone(), truncated=flag.clone(), shape=(n,), device=device
        )

    @property
    def num_envs(self) -> int:
        """Number of worlds, N."""
        return self.batch_size[0]

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            self.terrain.seed = seed
            self.terrain.episode.fill_(-1)

    def _reset(self, tensordict: TensorDictBase | None = None, *, keep_state: bool = False, **_: Any) -> TensorDict:
        """Begin new episodes in the worlds marked by ``_reset``, or in all.

        Args:
            tensordict: may hold ``_reset`` [N, 1].
            keep_state: give the present observation and change nothing (to carry on after `load_state_dict`).
        """
        if keep_state:
            return self._with_done(self._observation.clone())
        mask = None if tensordict is None else tensordict.get("_reset", None)
        everyone = torch.arange(self.num_envs, device=self.device)
        worlds = everyone if mask is None else mask.view(-1).nonzero().squeeze(-1)
        finished = self.step_count[worlds] > 0
        self.curriculum.update(worlds, torch.where(finished, self._episode_score(worlds), torch.nan))
        self.terrain.regenerate(worlds)
        self.sim.reset(worlds)
        self.generator.reset(worlds)
        self._previous_action[worlds] = 0.0
        self.step_count[worlds] = 0
        self._reset_task(worlds)
        self._attitude = roll_pitch_yaw(self.sim.readings.base_quaternion)
        fresh = self._observe(worlds)
        fresh["reward_terms"] = TensorDict(
            {name: torch.zeros(len(worlds), 1, device=self.device) for name in self.reward_names}
        )
        none = torch.zeros(len(worlds), 1, dtype=torch.bool, device=self.device)
        fresh["events"] = TensorDict({name: none.clone() for name in self.event_names} | {"step_count": none.long()})
        if len(worlds) == self.num_envs:
            observation = TensorDict(fresh, batch_size=self.batch_size, device=self.device)
        else:
            observation = self._observation.clone()
            observation[worlds] = TensorDict(fresh, batch_size=[len(worlds)], device=self.device)
        self._observation = observation
        return self._with_done(observation.clone())

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        with one_thread_for_small_batches(self.num_envs, self.device):
            return self._control_step(tensordict)

    def _control_step(self, tensordict: TensorDictBase) -> TensorDict:
        action = tensordict["action"].nan_to_num(0.0).clamp(-1.0, 1.0)
        before = self.sim.readings
        now = self.sim.step(self.generator.joint_targets(action, self._attitude))
        self.step_count += 1
        self._attitude = roll_pitch_yaw(now.base_quaternion)

        terms = self._reward_terms(before, now, action)
        self._previous_action = torch.stack([action, self._previous_action[:, 0]], 1)
        # A faulty world was put back to its home: its reward would be nonsense.
        trusted = (self.sim.fault == 0)[:, None]
        rewarded = torch.where(trusted, torch.stack([terms[name] for name in self.reward_names], -1), 0.0)
        events = self._shared_events(now) | self._task_events()
        happened = torch.stack([events[name] for name in self.event_names], -1)
        terminated = happened[:, self._terminal_columns].any(-1, keepdim=True)
        truncated = (events["timeout"] | events["success"])[:, None] & ~terminated

        everyone = torch.arange(self.num_envs, device=self.device)
        observation: dict[str, Any] = self._observe(everyone)
        observation["reward_terms"] = dict(zip(self.reward_names, rewarded.split(1, -1), strict=True))
        observation["events"] = dict(zip(self.event_names, happened.split(1, -1), strict=True))
        observation["events"]["step_count"] = self.step_count[:, None].clone()
        self._observation = TensorDict(observation, self.batch_size, device=self.device)
        out = self._with_done(self._observation.clone(recurse=False), terminated, truncated)
        out["reward"] = rewarded.sum(-1, keepdim=True)
        return out

    def _with_done(
        self, out: TensorDict, terminated: Tensor | None = None, truncated: Tensor | None = None
    ) -> TensorDict:
        none = torch.zeros(self.num_envs, 1, dtype=torch.bool, device=self.device)
        out["terminated"] = none if terminated is None else terminated
        out["truncated"] = none.clone() if truncated is None else truncated
        out["done"] = out["terminated"] | out["truncated"]
        return out

    # ---- parts -----------------------------------------------------------------------------------------------------

    def _shared_events(self, now: Readings) -> dict[str, Tensor]:
        limits = self.config.termination
        lowest_top = -self.terrain.max_height
        tilt = torch.maximum(self._attitude.roll.abs(), self._attitude.pitch.abs())
        return {
            "fall": now.base_position[:, 2] < lowest_top + limits.fall_height,
            "tilt": tilt > limits.max_tilt * torch.pi / 180.0,
            "fault": self.sim.fault != 0,
            "timeout": self.step_count >= limits.max_steps,
            "success": now.base_position[:, 0] >= limits.goal_distance,
        }

    def _shared_reward_terms(
        self, weights: SharedRewardConfig, before: Readings, now: Readings, action: Tensor
    ) -> dict[str, Tensor]:
        previous, before_previous = self._previous_action.unbind(1)
        moved = now.foot_position[..., :2] - before.foot_position[..., :2]
        contact, contact_before = now.foot_force[..., 2] > 0, before.foot_force[..., 2] > 0
        generator = self.generator
        return {
            "smoothness": weights.smoothness * rewards.smoothness(action, previous, before_previous),
            "foot_slip": weights.foot_slip * rewards.foot_slip(moved, contact, contact_before, weights.slip_distance),
            "collision": weights.collision * rewards.collision(now.collisions),
            "swing_phase": weights.swing_phase * rewards.swing_phase(generator.swing_window, generator.frequency),
        }

    def _observe(self, worlds: Tensor) -> dict[str, Any]:
        readings, subset = self.sim.readings, None
        if len(worlds) < self.num_envs:
            readings, subset = readings[worlds], worlds
        return {
            "scan": scan(self.terrain, readings.foot_position, self._scan_pattern, self.config.scan_clip, subset),
            **self._task_observation(readings, worlds),
        }

    def _shared_proprioception(self, readings: Readings, worlds: Tensor) -> list[Tensor]:
        """Foot positions and velocities, torques, roll, pitch and their rates, contacts (paper, section II-C).

        Foot positions are relative to the hips, and with the velocities in the level, yaw-aligned frame.
        """
        yaw = self._attitude.yaw[worlds][:, None]
        cos, sin = torch.cos(yaw), torch.sin(yaw)
        in_base = torch.cat([self._hip_offset.expand(len(cos), -1, -1), readings.base_angular_velocity[:, None]], 1)
        in_world = rotate_vectors(readings.base_quaternion, in_base)
        feet = readings.foot_position - readings.base_position[:, None] - in_world[:, :4]
        level = rotate_yaw(torch.cat([feet, readings.foot_velocity, in_world[:, 4:]], 1), cos, -sin).flatten(1)
        angles = torch.stack([self._attitude.roll[worlds], self._attitude.pitch[worlds]], -1)
        contact = (readings.foot_force[..., 2] > 0).float()
        return [level[:, :24], readings.joint_torque, angles, level[:, 24:26], contact]

    def _phase_and_actions(self, worlds: Tensor) -> list[Tensor]:
        phi = 2.0 * torch.pi * self.generator.phase[worlds][:, None]
        return [torch.cos(phi), torch.sin(phi), self._previous_action[worlds].flatten(1)]

    # ---- saving and resuming ---------------------------------------------------------------------------------------

    def state_dict(self, *_: Any, **__: Any) -> dict[str, Any]:  # type: ignore[override]
        """Everything that the next step depends on: resuming from it continues the run exactly."""
        return {
            "simulator": self.sim.state_dict(),
            "generator": {"phase": self.generator.phase, "frequency": self.generator.frequency},
            "step_count": self.step_count,
            "level": self.curriculum.level,
            "previous_action": self._previous_action,
            "observation": self._observation.flatten_keys(".").to_dict(),
            "task": self._task_state(),
        }

    def load_state_dict(self, state: dict[str, Any], *_: Any, **__: Any) -> None:  # type: ignore[override]
        """Restore what `state_dict` gave; then ``reset(keep_state=True)`` gives the observation to carry on from."""
        self.sim.load_state_dict(state["simulator"])
        self.generator.phase.copy_(state["generator"]["phase"])
        self.generator.frequency = state["generator"]["frequency"].to(self.device)
        self.step_count.copy_(state["step_count"])
        self.curriculum.level.copy_(state["level"])
        self._previous_action = state["previous_action"].to(self.device)
        observation = {name: value.to(self.device) for name, value in state["observation"].items()}
        self._observation = TensorDict(observation, self.batch_size, device=self.device).unflatten_keys(".")
        self._attitude = roll_pitch_yaw(self.sim.readings.base_quaternion)
        self._load_task_state(state["task"])

    @abstractmethod
    def _task_state(self) -> dict[str, Tensor]:
        """The task's own part of `state_dict`."""

    @abstractmethod
    def _load_task_state(self, state: dict[str, Tensor]) -> None:
        """Restore the task's own part of `state_dict`."""
