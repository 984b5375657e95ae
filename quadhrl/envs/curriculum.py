"""Per-world terrain difficulty that follows how well each robot does (as in Rudin et al. 2022)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from quadhrl.errors import check_range
from quadhrl.sim import BlockTerrain

__all__ = ["CurriculumConfig", "TerrainCurriculum"]


@dataclass
class CurriculumConfig:
    """When a world's terrain gets harder or easier."""

    enabled: bool = False
    """Start every world on flat ground and make its terrain harder as its robot does well."""
    promote: float = 0.5
    """An episode that scores at least this (0 to 1) raises its world's level."""
    demote: float = 0.2
    """An episode that scores less than this lowers it."""
    levels: int = 5
    """Steps from flat ground to the full terrain."""

    def validate(self) -> None:
        """Check every field.

        Raises:
            InputError: a field is out of its range.
        """
        check_range(self, "curriculum", "promote", 0, 1)
        check_range(self, "curriculum", "demote", 0, self.promote)
        check_range(self, "curriculum", "levels", 1)


class TerrainCurriculum:
    """Each world's level in [0, 1] scales its share of gaps and its height range, from its next terrain on.

    Args:
        config: when levels change.
        terrain: the terrains; their configured infill and height range are level 1.
    """

    def __init__(self, config: CurriculumConfig, terrain: BlockTerrain) -> None:
        config.validate()
        self.config, self.terrain = config, terrain
        start = 0.0 if config.enabled else 1.0
        self.level = torch.full((terrain.num_worlds,), start, device=terrain.device)
        """Level of each world [N]."""
        self._apply(torch.arange(terrain.num_worlds, device=terrain.device))

    def update(self, worlds: Tensor, score: Tensor) -> None:
        """Judge finished episodes.

        Args:
            worlds: their worlds [K].
            score: how well each went, 0 to 1, [K]; NaN for worlds that have not finished one.
        """
        if not self.config.enabled:
            return
        change = (score >= self.config.promote).float() - (score < self.config.demote).float()
        self.level[worlds] = (self.level[worlds] + change / self.config.levels).clamp(0.0, 1.0)
        self._apply(worlds)

    def _apply(self, worlds: Tensor) -> None:
        full, level = self.terrain.config, self.level[worlds]
        self.terrain.infill[worlds] = 1.0 - level * (1.0 - full.infill)
        self.terrain.height_range[worlds] = level * full.height_range
