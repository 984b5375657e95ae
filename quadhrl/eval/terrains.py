"""The paper's 12 test terrains and what its authors measured on them (facts of their published rollouts)."""

from __future__ import annotations

from typing import NamedTuple

__all__ = ["PUBLISHED", "PUBLISHED_CLAIMS", "TEST_TERRAINS", "Published", "TestTerrain"]


class TestTerrain(NamedTuple):
    """A difficulty of the block terrain."""

    __test__ = False  # not a test, whatever pytest makes of its name
    infill: float
    """Probability that a block is present."""
    height_range: float
    """Peak-to-peak range of the block tops [m]."""

    @property
    def label(self) -> str:
        """Infill in per cent and height range in metres, as in the paper's figures."""
        return f"{100 * self.infill:g} / {self.height_range:g}"


class Published(NamedTuple):
    """A pair of bars: the proposed method (H) and the end-to-end policy (F), means of five rollouts."""

    reward: tuple[float, float]
    """Normalised reward [%]."""
    distance: tuple[float, float]
    """[m]."""
    collisions: tuple[float, float]
    """Per control step."""
    success: tuple[float, float]
    """Share of rollouts that reached 8.5 m."""


TEST_TERRAINS = tuple(TestTerrain(infill, height) for height in (0.0, 0.05, 0.075, 0.1) for infill in (1.0, 0.9, 0.8))
"""100, 90 and 80 % infill times 0, 5, 7.5 and 10 cm of height range, in the paper's order."""

# The authors' blocks had half of the nominal height range; facts about their code, 1.6.
PUBLISHED = dict(
    zip(
        TEST_TERRAINS,
        (
            Published((146.6, 110.7), (8.44, 8.48), (0.0203, 0.0154), (1.0, 1.0)),
            Published((120.7, 110.3), (6.70, 8.44), (0.0516, 0.0606), (0.6, 1.0)),
            Published((87.0, 102.8), (1.96, 7.78), (0.1882, 0.1119), (0.0, 0.8)),
            Published((144.4, 107.9), (8.36, 8.48), (0.0343, 0.0379), (1.0, 1.0)),
            Published((118.1, 97.2), (6.77, 8.16), (0.1338, 0.4090), (0.4, 0.8)),
            Published((95.9, 89.7), (2.51, 6.75), (0.1506, 0.1256), (0.0, 0.6)),
            Published((143.3, 102.6), (8.17, 8.46), (0.0358, 0.0585), (1.0, 1.0)),
            Published((109.8, 102.2), (5.72, 6.20), (0.1478, 0.1919), (0.2, 0.6)),
            Published((92.0, 75.2), (2.04, 4.95), (0.1296, 0.5769), (0.0, 0.4)),
            Published((135.2, 95.2), (8.28, 7.77), (0.0789, 0.0945), (1.0, 1.0)),
            Published((113.9, 99.9), (6.53, 7.81), (0.1303, 0.1408), (0.6, 1.0)),
            Published((86.4, 86.8), (2.42, 4.45), (0.2468, 0.2701), (0.0, 0.4)),
        ),
        strict=True,
    )
)
"""The bars of the paper's three charts and the success rates behind them, by terrain."""

PUBLISHED_CLAIMS = {"reward_h_over_f": 10, "reward_over_100": 8, "distance_h_over_f": 1, "collisions_h_under_f": 9}
"""Terrains, out of 12, on which each claim holds in the published numbers (for the distance the paper's text says two)."""
