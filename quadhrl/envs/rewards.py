"""The reward terms of the paper, sections II-D and IV-B, unweighted; one function per equation, [N] per control step."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = [
    "collision",
    "footstep_target",
    "foot_slip",
    "foot_stay",
    "forward_velocity",
    "lateral_velocity",
    "smoothness",
    "swing_phase",
    "target_closeness",
    "velocity_towards_target",
]


def target_closeness(distance: Tensor, hit: Tensor, hit_radius: float) -> Tensor:
    """The common part of eqs. 4 and 8: ``h (1 + 0.5 (1 - d / d_hit))`` per foot.

    Args:
        distance: horizontal distance of each foot from its target [m], [N, 4].
        hit: whether each foot hits its target, [N, 4], bool.
        hit_radius: d_hit [m].
    """
    return hit * (1.0 + 0.5 * (1.0 - distance / hit_radius))


def footstep_target(closeness: Tensor, hit: Tensor, active: Tensor) -> Tensor:
    """Eq. 4: the sum over the active feet, tripled when both are hit in the same step."""
    both = (hit | ~active).all(-1)
    return (2.0 * both + 1.0) * (closeness * active).sum(-1)


def foot_stay(closeness: Tensor, active: Tensor) -> Tensor:
    """Eq. 8: the same sum over the stance feet and their current targets."""
    return (closeness * ~active).sum(-1)


def velocity_towards_target(to_target: Tensor, foot_velocity: Tensor, active: Tensor) -> Tensor:
    """Eq. 5: speed of the active feet towards their targets, positive when approaching.

    The paper writes the rate of change of the distance; read literally, that would reward moving away.

    Args:
        to_target: horizontal vector from each foot to its target [m], [N, 4, 2].
        foot_velocity: [N, 4, 2], m/s.
        active: [N, 4], bool.
    """
    direction = to_target / to_target.norm(dim=-1, keepdim=True).clamp(min=1e-6)
    return ((direction * foot_velocity).sum(-1) * active).sum(-1)


def smoothness(action: Tensor, previous: Tensor, before_previous: Tensor) -> Tensor:
    """Eq. 6: norm of the actions' second difference, each action [N, 15]. The coefficient is negative: a penalty."""
    return (action - 2.0 * previous + before_previous).norm(dim=-1)


def foot_slip(moved: Tensor, contact: Tensor, contact_before: Tensor, limit: float) -> Tensor:
    """Eq. 7: minus the number of feet in contact now and before that moved farther than ``limit``.

    Args:
        moved: horizontal displacement of each foot in this step [m], [N, 4, 2].
        contact: whether each foot is in contact, [N, 4], bool.
        contact_before: the same one step earlier.
        limit: [m].
    """
    slipped = (moved.norm(dim=-1) > limit) & contact & contact_before
    return -slipped.sum(-1).float()


def collision(collisions: Tensor) -> Tensor:
    """Eq. 9: minus the number of colliding links, [N] int."""
    return -collisions.float()


def swing_phase(swing_window: Tensor, frequency: Tensor) -> Tensor:
    """Eq. 10: the generator's frequency [Hz] while its phase is in S, [N] each."""
    return torch.where(swing_window, frequency, 0.0)


def forward_velocity(velocity: Tensor, limit: float) -> Tensor:
    """Eq. 15: the base's velocity along x [m/s], [N], clipped above at ``limit``."""
    return velocity.clamp(max=limit)


def lateral_velocity(velocity: Tensor, power: int) -> Tensor:
    """Eq. 16: minus the speed along y [m/s], [N], to the given power."""
    return -(velocity.abs() ** power)
