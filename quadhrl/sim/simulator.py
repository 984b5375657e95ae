"""What every physics engine offers the tasks: batched stepping, resets, readings and fault flags."""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from dataclasses import dataclass
from enum import IntFlag
from typing import Any

import torch
from torch import Tensor

from quadhrl.sim.scene import BLOCK_OVERLAP, Scene
from quadhrl.sim.terrain import BlockTerrain

__all__ = ["Fault", "Readings", "Simulator"]

FOLLOW_STEPS = 4
"""Control steps between two looks at whether a robot has left the middle of its terrain window."""


class Fault(IntFlag):
    """Why a world's last control step cannot be trusted."""

    NONFINITE = 1
    """A position or velocity was NaN or infinite."""
    RUNAWAY = 2
    """The base was faster than 20 m/s, or a joint or the base turned faster than 200 rad/s."""
    OVERFLOW = 4
    """The engine ran out of room for this world's contacts or constraints and dropped some."""


@dataclass(frozen=True)
class Readings:
    """The robots' state after a control step, in the world's frame unless said otherwise. Own memory, float32.

    Positions and velocities are those at the end of the step; forces and torques acted during its last physics step.
    """

    qpos: Tensor
    """Generalised positions [N, 19]: base position, base quaternion, joints."""
    qvel: Tensor
    """Generalised velocities [N, 18]: base linear (world) and angular (base's frame), joints."""
    joint_torque: Tensor
    """Servo torques [N, 12], N m."""
    foot_position: Tensor
    """Foot centres [N, 4, 3], m."""
    foot_velocity: Tensor
    """[N, 4, 3], m/s."""
    foot_force: Tensor
    """Net contact force on each foot [N, 4, 3], N."""
    collisions: Tensor
    """Number of links, feet not counted, that touch the terrain or another link [N], int64."""

    @property
    def base_position(self) -> Tensor:
        """[N, 3], m."""
        return self.qpos[:, :3]

    @property
    def base_quaternion(self) -> Tensor:
        """[N, 4], wxyz."""
        return self.qpos[:, 3:7]

    @property
    def joint_position(self) -> Tensor:
        """[N, 12], rad."""
        return self.qpos[:, 7:]

    @property
    def base_velocity(self) -> Tensor:
        """Linear velocity of the base's origin [N, 3], m/s."""
        return self.qvel[:, :3]

    @property
    def base_angular_velocity(self) -> Tensor:
        """[N, 3], rad/s, in the base's frame."""
        return self.qvel[:, 3:6]

    @property
    def joint_velocity(self) -> Tensor:
        """[N, 12], rad/s."""
        return self.qvel[:, 6:]

    def __getitem__(self, worlds: Tensor) -> Readings:
        """The readings of some worlds."""
        return Readings(**{field.name: getattr(self, field.name)[worlds] for field in dataclasses.fields(self)})

    def replace(self, **tensors: Tensor) -> Readings:
        """A copy with some readings replaced."""
        return dataclasses.replace(self, **tensors)


class Simulator(ABC):
    """N independent robots, each on its own terrain.

    A world with a fault is put back to its home state at once, so that every reading is finite; `fault` keeps the reason
    until the next step and `fault_counts` counts them.

    The terrain is a window of boxes that follows each robot. A sphere that sinks into a box by more than its radius is
    pushed out through the nearest face, which at the seam of two level blocks is a side face of each: it would be
    wedged between them, and feet sank by 10 cm on level ground. So every box reaches a little way under its neighbours
    wherever that is hidden, where they are at least as high; the surface stays exactly that of `BlockTerrain.heights`.

    Args:
        scene: the compiled robot and terrain window.
        terrain: the terrains, one per world; regenerate a world's terrain before resetting the world.
        device: where the readings live.
    """

    engine: str
    """Name of the engine: "native" or "warp"."""

    def __init__(self, scene: Scene, terrain: BlockTerrain, device: torch.device) -> None:
        self.scene = scene
        self.terrain = terrain
        self.device = device
        self.num_worlds = terrain.num_worlds
        self.fault = torch.zeros(self.num_worlds, dtype=torch.long, device=device)
        """`Fault` bits of each world's last control step [N]."""
        self.fault_counts = torch.zeros(len(Fault), dtype=torch.long, device=device)
        """Worlds reset for each `Fault` so far, in the order of its members."""
        self._home = torch.tensor(scene.home, device=device)
        self._centre = torch.zeros(self.num_worlds, 2, dtype=torch.long, device=device)
        self._block_offset = torch.as_tensor(scene.block_offset, device=device)
        self._steps = 0
        self._window = round(len(scene.blocks) ** 0.5)
        self.readings: Readings
        """The latest readings."""

    def start(self) -> None:
        """Put every world into its home state; each engine calls this at the end of its construction."""
        self.readings = Readings(**self._kinematics(), **self._forces())
        self.reset(torch.arange(self.num_worlds, device=self.device))

    def step(self, joint_targets: Tensor) -> Readings:
        """Advance every world by one control step.

        Args:
            joint_targets: set-points of the position servos [rad], [N, 12].

        Returns:
            The new readings, also kept as `readings`.
        """
        self._advance(joint_targets)
        self.readings = Readings(**self._kinematics(), **self._forces())
        self.fault = self._find_faults()
        faulty = self.fault.nonzero().squeeze(-1)
        if len(faulty):
            for k, kind in enumerate(Fault):
                self.fault_counts[k] += (self.fault & kind).bool().sum()
            self.reset(faulty)
        self._follow()
        return self.readings

    def reset(self, worlds: Tensor, qpos: Tensor | None = None, qvel: Tensor | None = None) -> Readings:
        """Put some worlds into a given state; the others are not touched.

        Args:
            worlds: indices [K].
            qpos: generalised positions [K, nq]; None for the robot's home pose.
            qvel: generalised velocities [K, nv]; None for rest.

        Returns:
            The new readings of all worlds; forces, torques and collisions of the given ones are 0.
        """
        home = self._home.expand(len(worlds), -1)
        qpos = home if qpos is None else qpos.to(self._home)
        qvel = self._home.new_zeros(len(worlds), self.scene.model.nv) if qvel is None else qvel.to(self._home)
        self._write(worlds, qpos, qvel, ctrl=self._home[7:].expand(len(worlds), -1))
        self._lay_around(worlds, qpos[:, :2])
        self._forward(worlds)
        self.readings = self.readings.replace(**self._kinematics())
        self._silence(worlds)
        return self.readings

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next step depends on, and the last readings."""
        readings = {field.name: getattr(self.readings, field.name) for field in dataclasses.fields(Readings)}
        return {
            "physics": self._state(),
            "readings": readings,
            "centre": self._centre,
            "steps": self._steps,
            "fault": self.fault,
            "fault_counts": self.fault_counts,
            "terrain": self.terrain.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` gave, from a simulator with the same scene and number of worlds."""
        self.terrain.load_state_dict(state["terrain"])
        self.readings = Readings(**{name: value.to(self.device) for name, value in state["readings"].items()})
        everyone = torch.arange(self.num_worlds, device=self.device)
        self._centre.copy_(state["centre"])
        self._steps = int(state["steps"])
        self._lay(everyone)
        self._load_state(state["physics"])
        self._forward(everyone)
        self.fault.copy_(state["fault"])
        self.fault_counts.copy_(state["fault_counts"])

    @property
    @abstractmethod
    def qpos(self) -> Tensor:
        """Generalised positions [N, nq], a view."""

    @property
    @abstractmethod
    def qvel(self) -> Tensor:
        """Generalised velocities [N, nv], a view."""

    @abstractmethod
    def _advance(self, joint_targets: Tensor) -> None:
        """Integrate one control step and bring positions and velocities of the feet up to date."""

    @abstractmethod
    def _overflowed(self) -> Tensor:
        """Worlds that lost contacts or constraints in the last control step [N], bool."""

    @abstractmethod
    def _write(self, worlds: Tensor, qpos: Tensor, qvel: Tensor, ctrl: Tensor) -> None:
        """Set the state of some worlds, forgetting their warm start."""

    @abstractmethod
    def _forward(self, worlds: Tensor) -> None:
        """Bring what follows from state and boxes up to date in at least these worlds, without stepping."""

    @abstractmethod
    def _kinematics(self) -> dict[str, Tensor]:
        """The readings that follow from the present state, of all worlds."""

    @abstractmethod
    def _forces(self) -> dict[str, Tensor]:
        """The readings that stem from the last physics step, of all worlds."""

    @abstractmethod
    def _place_blocks(self, worlds: Tensor, centre: Tensor, position: Tensor, half_size: Tensor) -> None:
        """Lay the window of some worlds around the block corner ``centre`` [K, 2]: boxes' centres and half sizes [K, B, 3]."""

    @abstractmethod
    def _state(self) -> dict[str, Tensor]:
        """The engine's own integration state."""

    @abstractmethod
    def _load_state(self, state: dict[str, Tensor]) -> None:
        """Restore the engine's own integration state."""

    def _silence(self, worlds: Tensor) -> None:
        """Zero the forces in the readings of worlds that have just been put somewhere: nothing has acted on them yet."""
        if len(worlds):
            for name in ("joint_torque", "foot_force", "collisions"):
                forces = getattr(self.readings, name).clone()
                forces[worlds] = 0
                self.readings = self.readings.replace(**{name: forces})

    def _find_faults(self) -> Tensor:
        qpos, qvel = self.readings.qpos, self.readings.qvel
        # A sum keeps every NaN and infinity. Float32 turns what is too large for it into infinity.
        finite = torch.isfinite(qpos.sum(-1) + qvel.sum(-1))
        runaway = (qvel[:, :3].norm(dim=-1) > 20.0) | (qvel[:, 3:].abs().amax(-1) > 200.0)
        return (
            torch.where(finite, 0, int(Fault.NONFINITE))
            | torch.where(finite & runaway, int(Fault.RUNAWAY), 0)
            | torch.where(self._overflowed(), int(Fault.OVERFLOW), 0)
        )

    def _follow(self) -> None:
        """Move the terrain windows of the robots that have left theirs' middle."""
        self._steps += 1
        if self._steps % FOLLOW_STEPS:
            return
        # Half a block is enough to leave; the rest keeps a robot on an edge from moving its window again and again.
        xy = self.readings.base_position[:, :2]
        away = (xy / self.terrain.config.block_size - self._centre).abs().amax(-1) > 0.6
        worlds = away.nonzero().squeeze(-1)
        if len(worlds):
            self._lay_around(worlds, xy[worlds])

    def _lay_around(self, worlds: Tensor, xy: Tensor) -> None:
        """Lay the windows of some worlds around horizontal positions [K, 2], m."""
        self._centre[worlds] = torch.round(xy / self.terrain.config.block_size).long()
        self._lay(worlds)

    def _lay(self, worlds: Tensor) -> None:
        """Lay the windows of some worlds around their `_centre`."""
        centre = self._centre[worlds]
        low, high = self._box_corners(centre, worlds)
        self._place_blocks(worlds, centre, (low + high) / 2, (high - low) / 2)

    def _box_corners(self, centre: Tensor, worlds: Tensor) -> tuple[Tensor, Tensor]:
        """Lowest and highest corner of each box of the windows around the block corners ``centre`` [K, 2], [K, B, 3]."""
        terrain, reach = self.terrain.config, self._window // 2 + 1
        side = torch.arange(-reach, reach, device=self.device)  # the window and a ring around it
        i, j = torch.meshgrid(side, side, indexing="ij")
        around = self.terrain.block_heights(centre[:, None, None] + torch.stack([i, j], -1), worlds)
        tops = around[:, 1:-1, 1:-1]

        def hidden(di: int, dj: int) -> Tensor:
            n = self._window
            return around[:, 1 + di : 1 + di + n, 1 + dj : 1 + dj + n] >= tops

        west, east = hidden(-1, 0), hidden(1, 0)
        # A box that reaches out to two sides covers the corner between them as well: give one side up where it would show.
        south = hidden(0, -1) & (hidden(-1, -1) | ~west) & (hidden(1, -1) | ~east)
        north = hidden(0, 1) & (hidden(-1, 1) | ~west) & (hidden(1, 1) | ~east)
        corner = (centre[:, None] + self._block_offset) * terrain.block_size
        low_reach = torch.stack([west, south], -1).flatten(1, 2) * BLOCK_OVERLAP
        high_reach = torch.stack([east, north], -1).flatten(1, 2) * BLOCK_OVERLAP
        top = tops.flatten(1)[..., None]
        low = torch.cat([corner - low_reach, top - terrain.gap_depth], -1)
        return low, torch.cat([corner + terrain.block_size + high_reach, top], -1)
