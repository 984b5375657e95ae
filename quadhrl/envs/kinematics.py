"""Leg kinematics, forward and (analytic) inverse."""

from __future__ import annotations

import torch
from torch import Tensor

from quadhrl.robots import Robot

__all__ = ["LegKinematics"]


class LegKinematics:
    """Abduction-thigh-calf legs: foot centre in the frame of the abduction joint <-> joint angles.

    Frame: origin at the abduction joint, axes of the base (x forward, y left, z up).

    Args:
        robot: the robot's link lengths, sides and joint limits.
        device: where the tensors live.
        dtype: their type.
    """

    MARGIN = 1e-3
    """How far inside the workspace's border foot targets are kept [m] (facts of the authors' code, 1.2)."""

    def __init__(self, robot: Robot, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32) -> None:
        self.hip, self.thigh, self.calf = robot.hip_length, robot.thigh_length, robot.calf_length
        self.offset = torch.tensor(robot.side, device=device, dtype=dtype) * robot.hip_length
        """Sideways position of each thigh joint, [4], m."""
        self.max_reach = ((self.thigh + self.calf) ** 2 + self.hip**2) ** 0.5 - self.MARGIN
        self.min_reach = self.hip + self.MARGIN

    def forward(self, joints: Tensor) -> Tensor:
        """Foot centres [..., 4, 3] of joint angles [..., 4, 3] (abduction, thigh, calf)."""
        abduction, thigh, calf = joints.unbind(-1)
        x = -self.thigh * torch.sin(thigh) - self.calf * torch.sin(thigh + calf)
        down = self.thigh * torch.cos(thigh) + self.calf * torch.cos(thigh + calf)
        cos, sin = torch.cos(abduction), torch.sin(abduction)
        return torch.stack([x, self.offset * cos + down * sin, self.offset * sin - down * cos], -1)

    def clip(self, feet: Tensor) -> Tensor:
        """Move foot targets [..., 4, 3] into the workspace: at least 0.1 m below the hip, within reach of the links."""
        feet = torch.cat([feet[..., :2], feet[..., 2:].clamp(max=-0.1)], -1)
        reach = feet.norm(dim=-1, keepdim=True)
        return feet * (reach.clamp(self.min_reach, self.max_reach) / reach)

    def inverse(self, feet: Tensor) -> Tensor:
        """Joint angles [..., 4, 3] that put the foot centres at ``feet`` [..., 4, 3], knees bent backwards.

        Targets outside the workspace give the angles of a nearby point; see `clip`.
        """
        x, y, z = feet.unbind(-1)
        down = (y * y + z * z - self.hip**2).clamp(min=1e-8).sqrt()
        abduction = torch.atan2(y, -z) - torch.atan2(self.offset, down)
        cos_calf = (x * x + down * down - self.thigh**2 - self.calf**2) / (2 * self.thigh * self.calf)
        calf = -torch.acos(cos_calf.clamp(-1.0, 1.0))
        thigh = torch.atan2(-x, down) - torch.atan2(
            self.calf * torch.sin(calf), self.thigh + self.calf * torch.cos(calf)
        )
        return torch.stack([abduction, thigh, calf], -1)
