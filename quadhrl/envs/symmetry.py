"""Left and right: what observations and actions look like in a mirror that stands along the robot's x axis.

The mirror image of a trot is a trot in which the other pair of legs is half a cycle ahead, so a robot and its task look the same
in it, up to some millimetres in the trunk's centre of mass. In training every sample can stand for two (Mittal et al. 2024,
"Symmetry Considerations for Learning Task Symmetric Robot Policies").
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from quadhrl.envs.scan import DIRECTIONS, SCAN_POINTS

__all__ = ["ACTION", "BODY", "PHASE_AND_ACTIONS", "SCAN", "Mirror", "entries", "join", "legs"]


@dataclass(frozen=True)
class Mirror:
    """A signed permutation of a vector's entries; it is its own inverse."""

    source: Tensor
    """Where each entry comes from [D]."""
    sign: Tensor
    """What it is multiplied by, 1 or -1 [D]."""

    def __call__(self, x: Tensor) -> Tensor:
        """Vectors [..., D] as seen in the mirror."""
        return x[..., self.source.to(x.device)] * self.sign.to(x.device)


def entries(*signs: int) -> Mirror:
    """Numbers that keep their places and, where the sign is -1, are negated."""
    return Mirror(torch.arange(len(signs)), torch.tensor(signs, dtype=torch.float32))


def legs(part: Mirror) -> Mirror:
    """The same part for each leg: FL and FR are exchanged, RL and RR are."""
    size = len(part.sign)
    opposite = torch.tensor([1, 0, 3, 2])
    return Mirror((opposite[:, None] * size + part.source).flatten(), part.sign.repeat(4))


def join(*parts: Mirror) -> Mirror:
    """Parts one after the other."""
    starts = torch.tensor([0, *(len(part.sign) for part in parts)]).cumsum(0)
    sources = [part.source + start for part, start in zip(parts, starts, strict=False)]
    return Mirror(torch.cat(sources), torch.cat([part.sign for part in parts]))


def _rings() -> Mirror:
    """A foot's scan: its centre, then rings of points counted anticlockwise from the x axis."""
    ring, direction = torch.arange(SCAN_POINTS - 1) // DIRECTIONS, torch.arange(SCAN_POINTS - 1) % DIRECTIONS
    source = torch.cat([torch.zeros(1, dtype=torch.long), 1 + ring * DIRECTIONS + -direction % DIRECTIONS])
    return Mirror(source, torch.ones(SCAN_POINTS))


_VECTORS = legs(entries(1, -1, 1))

ACTION = join(entries(1, 1, 1), _VECTORS)
"""An action: amplitude, height, frequency, the feet's residuals."""

BODY = join(_VECTORS, _VECTORS, legs(entries(-1, 1, 1)), entries(-1, 1, -1, 1), legs(entries(1)))
"""Foot positions and velocities, joint torques (about x, y, y), roll, pitch and their rates, contacts."""

PHASE_AND_ACTIONS = join(entries(-1, -1), ACTION, ACTION)
"""Cosine and sine of the phase, which is half a cycle ahead in the mirror, and the last two actions."""

SCAN = legs(_rings())
"""The terrain scan."""
