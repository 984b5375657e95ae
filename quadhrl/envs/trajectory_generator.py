"""Trajectory generator: a 15-D action modulates an open-loop trot (paper, section II-B; Iscen et al. 2018, Lee et al. 2020).

A leg's cycle fraction is ``p``: the foot swings forward for p in [0, 0.5), with its highest point at 0.25, and supports
for p in [0.5, 1). FR and RL run half a cycle ahead of FL and RR.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from quadhrl.envs.kinematics import LegKinematics
from quadhrl.errors import check_range
from quadhrl.robots import Robot
from quadhrl.rotations import RollPitchYaw

__all__ = ["ACTION_DIM", "TrajectoryGenerator", "TrajectoryGeneratorConfig"]

ACTION_DIM = 15
"""Step amplitude, standing height, frequency, and an xyz residual for each foot."""


@dataclass
class TrajectoryGeneratorConfig:
    """Ranges that the action's [-1, 1] maps to (facts of the authors' code, 1.2)."""

    max_amplitude: float = 0.5
    """Largest amplitude of the feet in x [m]; the smallest is 0."""
    min_height: float = -0.5
    """Lowest height of the feet below the hips [m]."""
    max_height: float = -0.3
    """Highest height of the feet below the hips [m]."""
    max_frequency: float = 3.0
    """Highest cycle frequency [Hz]; the lowest is 0."""
    max_residual: float = 0.1
    """Largest residual of a foot along each axis [m]."""
    step_height: float = 0.05
    """Height of the swing foot's arc [m]."""
    stance_width: float = 0.075
    """Sideways distance of the feet from the abduction joints [m]."""

    def validate(self) -> None:
        """Check every field.

        Raises:
            InputError: a field is out of its range.
        """
        check_range(self, "generator", "max_amplitude max_residual step_height stance_width", 0, 1, "m")
        check_range(self, "generator", "max_frequency", 0, 10, "Hz", above=True)
        check_range(self, "generator", "min_height", -2, self.max_height, "m")
        check_range(self, "generator", "max_height", -2, 0, "m")


class TrajectoryGenerator:
    """Turns actions into joint targets and keeps each world's phase.

    Args:
        config: the action's ranges.
        robot: the robot.
        num_worlds: number of worlds, N.
        control_dt: duration of a control step [s].
        device: where the tensors live.
    """

    def __init__(
        self, config: TrajectoryGeneratorConfig, robot: Robot, num_worlds: int, control_dt: float, device: torch.device
    ) -> None:
        config.validate()
        self.config, self.control_dt = config, control_dt
        self.kinematics = LegKinematics(robot, device)
        self.phase = torch.zeros(num_worlds, device=device)
        """Cycle fraction t of each world [N], in [0, 1); the paper's phase is phi = 2 pi t."""
        self.frequency = torch.zeros(num_worlds, device=device)
        """Frequency of the last action [N], Hz."""
        self._offset = torch.tensor([0.5, 0.0, 0.0, 0.5], device=device)
        self._stance_y = torch.tensor(robot.side, device=device) * config.stance_width
        self._foot_radius = robot.foot_radius

    def reset(self, worlds: Tensor) -> None:
        """Begin a new cycle in the worlds [K]."""
        self.phase[worlds] = 0.0
        self.frequency[worlds] = 0.0

    @property
    def leg_phase(self) -> Tensor:
        """Cycle fraction of each leg [N, 4]."""
        return (self.phase[:, None] + self._offset) % 1.0

    @property
    def support(self) -> Tensor:
        """Whether each foot is in its own support half of the cycle [N, 4]."""
        return self.leg_phase >= 0.5

    @property
    def swing_window(self) -> Tensor:
        """The paper's phi in S = [0.25 pi, 0.75 pi] u [1.25 pi, 1.75 pi]: the middle of either pair's swing [N]."""
        half_cycle = (2.0 * self.phase) % 1.0
        return (half_cycle >= 0.25) & (half_cycle <= 0.75)

    def joint_targets(self, action: Tensor, attitude: RollPitchYaw) -> Tensor:
        """Advance the phase by one control step and give the servos' set-points.

        Args:
            action: clamped actions [N, 15], in [-1, 1].
            attitude: the base's roll and pitch, each [N]; the feet move in a frame that stays level.

        Returns:
            Joint angles [N, 12], rad.
        """
        c = self.config
        unit = (action[:, :3] + 1.0) / 2.0
        amplitude = unit[:, 0] * c.max_amplitude
        height = c.min_height + unit[:, 1] * (c.max_height - c.min_height)
        self.frequency = unit[:, 2] * c.max_frequency
        self.phase = (self.phase + self.frequency * self.control_dt) % 1.0
        p = self.leg_phase
        x = amplitude[:, None] * stride(p)
        z = (
            height[:, None] + c.step_height * lift(p) + self._foot_radius
        )  # heights are those of the sphere's lowest point
        feet = torch.stack([x, self._stance_y.expand_as(x), z], -1) + c.max_residual * action[:, 3:].view(-1, 4, 3)
        feet = self.kinematics.clip(_level_to_base(feet, attitude))
        return self.kinematics.inverse(feet).flatten(1)


def stride(p: Tensor) -> Tensor:
    """Forward position in [-1, 1] over the cycle fraction: forward in swing, back in support (cubic, smooth ends)."""
    u = 2.0 * p
    v = torch.where(u < 1.0, u, 2.0 - u)
    return 2.0 * v * v * (3.0 - 2.0 * v) - 1.0


def lift(p: Tensor) -> Tensor:
    """Height in [0, 1] over the cycle fraction (Lee et al. 2020, eq. 11): up and down in swing, 0 in support."""
    k = 4.0 * p
    v = torch.where(k < 1.0, k, 2.0 - k).clamp(min=0.0)
    return v * v * (3.0 - 2.0 * v)


def _level_to_base(feet: Tensor, attitude: RollPitchYaw) -> Tensor:
    """Rotate vectors [N, 4, 3] from the level, yaw-aligned frame into the base's: by -pitch about y, then -roll about x."""
    angles = torch.stack([attitude.roll, attitude.pitch])[..., None]
    (cr, cp), (sr, sp) = torch.cos(angles), torch.sin(angles)
    x, y, z = feet.unbind(-1)
    x, z = cp * x - sp * z, sp * x + cp * z
    return torch.stack([x, cr * y + sr * z, cr * z - sr * y], -1)
