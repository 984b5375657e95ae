"""Terrain scan around each foot (paper, section II-C, "a scan of points around each foot")."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from quadhrl.sim import BlockTerrain

__all__ = ["DIRECTIONS", "SCAN_POINTS", "scan", "scan_pattern"]

_RADII = (0.025, 0.05, 0.075, 0.1, 0.125, 0.15, 0.2)
DIRECTIONS = 10
"""Points on each ring, the first one in the direction of the x axis."""

SCAN_POINTS = 1 + len(_RADII) * DIRECTIONS
"""Points around each foot: 71."""


def scan_pattern(device: torch.device | str = "cpu") -> Tensor:
    """Offsets of the scan points from the foot's centre in world axes [m], [71, 2]: the centre, then rings outwards."""
    angles = [2 * math.pi * k / DIRECTIONS for k in range(DIRECTIONS)]
    points = [(0.0, 0.0), *((r * math.cos(a), r * math.sin(a)) for r in _RADII for a in angles)]
    return torch.tensor(points, device=device)


def scan(terrain: BlockTerrain, feet: Tensor, pattern: Tensor, clip: float, worlds: Tensor | None = None) -> Tensor:
    """Height of the feet above the ground around them.

    Args:
        terrain: the terrains.
        feet: foot centres [K, 4, 3], m.
        pattern: offsets of the scan points, [71, 2].
        clip: values are clipped to +- this [m]; a gap shows as +clip.
        worlds: the worlds that the feet are in, [K]; None for all.

    Returns:
        [K, 284], m, foot by foot.
    """
    x, y, z = (feet[..., k, None] for k in range(3))
    heights = terrain.heights_at(x + pattern[:, 0], y + pattern[:, 1], worlds)
    return heights.neg_().add_(z).clamp_(-clip, clip).flatten(1)
