"""The few rotations that tasks and policies need. Quaternions are wxyz."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

__all__ = ["RollPitchYaw", "roll_pitch_yaw", "rotate_vectors", "rotate_yaw"]


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
