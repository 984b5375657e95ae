"""What the high-level policy maximises beside the value: terms that score footstep targets (paper, section III-B)."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass

import torch
from torch import Tensor, nn

__all__ = ["Direction", "ObjectiveTerm", "PairTargets"]


@dataclass(frozen=True)
class PairTargets:
    """Candidate targets of one pair of feet, M of them in each of N worlds; front foot first."""

    position: Tensor
    """The targets in the world [N, M, 2, 2], m."""
    vector: Tensor
    """From the feet to the targets, in the robot's yaw-aligned frame [N, M, 2, 2], m: the paper's p."""
    yaw: Tensor
    """The robot's yaw [N], rad."""
    worlds: slice
    """Which of the policy's worlds these are, for terms with parameters per world."""
    following: bool
    """Whether these are the stance pair's following targets, rather than the active pair's next ones."""


class ObjectiveTerm(nn.Module):
    """A term of the high-level policy's objective.

    A term scores one pair's targets at a time; the objective is the value of both pairs' targets together, plus every
    term's score of the next pair and of the following pair. Write a term as differentiable as its gradient steps need;
    where it is flat, only the grid search sees it.
    """

    @abstractmethod
    def forward(self, targets: PairTargets) -> Tensor:
        """Scores [N, M], in reward units."""


class Direction(ObjectiveTerm):
    """Eq. 11 times its weight: how far the targets lie in the direction of travel.

    Args:
        weight: kappa_HD [1/m].
        following_weight: factor on the following pair's score (2 in the authors' code; the paper has the next pair only).
        heading: direction of travel alpha in the world, 0 along x [rad], a number or one per world [N].
    """

    heading: Tensor

    def __init__(self, weight: float = 50.0, following_weight: float = 2.0, heading: float | Tensor = 0.0) -> None:
        super().__init__()
        self.weight, self.following_weight = weight, following_weight
        self.register_buffer("heading", torch.as_tensor(heading, dtype=torch.float32))

    def forward(self, targets: PairTargets) -> Tensor:
        """``[cos alpha, sin alpha] R_z(yaw) (p_a + p_b)``, weighted, [N, M]."""
        heading = self.heading if self.heading.dim() == 0 else self.heading[targets.worlds]
        in_robot = heading - targets.yaw  # alpha as the robot sees it
        p_x, p_y = targets.vector.sum(-2).unbind(-1)
        along = p_x * torch.cos(in_robot)[:, None] + p_y * torch.sin(in_robot)[:, None]
        return self.weight * (self.following_weight if targets.following else 1.0) * along
