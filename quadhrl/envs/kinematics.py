"""Leg kinematics (forward and analytic inverse) and the few rotations that the tasks need."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from quadhrl.robots import Robot

__all__ = ["LegKinematics", "RollPitchYaw", "roll_pitch_yaw", "rotate_vectors", "rotate_yaw"]


class RollPitchYaw(NamedTuple):
    """Angles of the rotation ``Rz(yaw) Ry(pitch) Rx(roll)`` [rad], each [...]."""

    roll: Tensor
    pitch: Tensor
    yaw: Tensor


def roll_pitch_yaw(quaternion: Tensor) -> RollPitchYaw:
    """Roll, pitch and yaw of quaternions wxyz, [..., 4]."""
    w, x, y, z = quaternion.unbind(-1)
    return RollPitchYaw(
        roll=torch.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
        pitch=torch.asin((2 * (w * y - z * x)).clamp(-1.0, 1.0)),
        yaw=torch.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
    )


def rotate_yaw(vector: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    """Rotate the x and y of vectors [..., 2 or more] about the vertical; components beyond y stay as they are.

    Args:
        vector: vectors, x and y first.
        cos: cosine of the angle, broadcast against ``vector[..., 0]``.
        sin: its sine.
    """
    x, y = vector[..., 0], vector[..., 1]
    rotated = torch.stack([cos * x - sin * y, sin * x + cos * y], -1)
    return rotated if vector.shape[-1] == 2 else torch.cat([rotated, vector[..., 2:]], -1)


def rotate_vectors(quaternion: Tensor, vectors: Tensor) -> Tensor:
    """Rotate vectors [N, M, 3] by quaternions wxyz [N, 4]."""
    w, axis = quaternion[:, None, :1], quaternion[:, None, 1:].expand_as(vectors)
    twice = 2.0 * torch.linalg.cross(axis, vectors)
    return vectors + w * twice + torch.linalg.cross(axis, twice)


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
