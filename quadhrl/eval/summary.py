"""What the comparison comes to: means with intervals for each method and terrain, and the paper's claims."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from quadhrl.eval.methods import METHODS
from quadhrl.eval.rollouts import Episode
from quadhrl.eval.terrains import PUBLISHED, PUBLISHED_CLAIMS, TestTerrain

__all__ = ["CLAIMS", "Evidence", "Interval", "Normalizer", "Summary", "bootstrap_mean", "published_json", "summarize"]


class Interval(NamedTuple):
    """A mean over rollouts with its 95 % bootstrap interval."""

    mean: float
    low: float
    high: float


@dataclasses.dataclass(frozen=True)
class Normalizer:
    """Reward per control step that counts as 100 % for one task's methods."""

    deterministic: float
    """Of the deterministic policy in its training setting: the authors' code."""
    training: float
    """The largest reached in training: the paper's text."""


class Claim(NamedTuple):
    """That the hierarchical method is better in one metric, on so and so many terrains."""

    text: str
    metric: str
    sign: float
    """1 where more is better, -1 where less is."""
    bar: float | None
    """What is to be beaten; None for the end-to-end policy."""


CLAIMS = {
    "reward_h_over_f": Claim("normalised reward: hierarchical above end-to-end", "normalized_reward", 1.0, None),
    "reward_over_100": Claim("normalised reward: hierarchical above 100 %", "normalized_reward", 1.0, 100.0),
    "distance_h_over_f": Claim("distance: hierarchical above end-to-end", "distance", 1.0, None),
    "collisions_h_under_f": Claim("collisions per step: hierarchical below end-to-end", "collisions", -1.0, None),
}
"""The paper's claims."""


class Evidence(NamedTuple):
    """Terrains on which the rollouts settle a claim: the 95 % interval of the mean difference leaves 0 out."""

    supported: int
    contradicted: int


@dataclasses.dataclass(frozen=True)
class Summary:
    """The figures of one way of counting."""

    cells: dict[str, dict[TestTerrain, dict[str, Interval]]]
    """By method, terrain and metric."""
    claims: dict[str, int]
    """Terrains on which each claim holds, by the means alone, as in the paper; empty unless both compared methods are there."""
    evidence: dict[str, Evidence]
    """Of each claim: how often chance hardly explains the difference. Rollouts on the same blocks are paired."""
    claims_of: int
    """Terrains that the claims are counted over: those with both methods."""

    @property
    def terrains(self) -> list[TestTerrain]:
        """All terrains with results, in the paper's order."""
        return sorted({t for row in self.cells.values() for t in row}, key=lambda t: (t.height_range, -t.infill))

    def to_json(self) -> dict[str, Any]:
        """As JSON-like values."""
        cells = [
            {"method": method, "infill": terrain.infill, "height_range": terrain.height_range}
            | {name: interval._asdict() for name, interval in metrics.items()}
            for method, row in self.cells.items()
            for terrain, metrics in row.items()
        ]
        return {
            "claims": self.claims,
            "claims_of": self.claims_of,
            "claims_evidence": {name: evidence._asdict() for name, evidence in self.evidence.items()},
            "published_claims": PUBLISHED_CLAIMS,
            "cells": cells,
        }


def summarize(
    episodes: list[Episode], normalizers: dict[str, Normalizer], *, until_stuck: bool = False, by_training: bool = False
) -> Summary:
    """Means, intervals and claims.

    Args:
        episodes: finished rollouts of `METHODS`; others are left out.
        normalizers: by task.
        until_stuck: count each rollout up to the moment in which the robot was first stuck, as the authors' evaluation does.
        by_training: normalise by the largest reward of the training instead of the deterministic policy's.
    """
    by_cell: dict[tuple[str, TestTerrain], list[Episode]] = {}
    for episode in episodes:
        by_cell.setdefault((episode.method, TestTerrain(episode.infill, episode.height_range)), []).append(episode)
    metrics = _UNTIL_STUCK if until_stuck else _WHOLE
    cells: dict[str, dict[TestTerrain, dict[str, Interval]]] = {}
    values: dict[tuple[str, TestTerrain], dict[int, dict[str, float]]] = {}  # by rollout
    for method, info in METHODS.items():
        for terrain in sorted({terrain for _, terrain in by_cell}, key=lambda t: (t.height_range, -t.infill)):
            runs = by_cell.get((method, terrain))
            if not runs:
                continue
            normalizer = normalizers[info.task]
            unit = normalizer.training if by_training else normalizer.deterministic
            columns = {name: np.array([metric(run) for run in runs]) for name, metric in metrics.items()}
            columns = {"normalized_reward": 100.0 * columns["reward"] / unit} | columns
            cell = {name: bootstrap_mean(column) for name, column in columns.items()}
            cells.setdefault(method, {})[terrain] = cell
            values[method, terrain] = {
                run.rollout: {name: float(column[k]) for name, column in columns.items()} for k, run in enumerate(runs)
            }
    ours, theirs = cells.get("hlp", {}), cells.get("end-to-end", {})
    shared = [terrain for terrain in ours if terrain in theirs]
    claims: dict[str, int] = {}
    evidence: dict[str, Evidence] = {}
    for name, claim in CLAIMS.items() if shared else ():
        advantages = [_advantage(claim, values["hlp", t], values["end-to-end", t]) for t in shared]
        evidence[name] = Evidence(sum(a.low > 0.0 for a in advantages), sum(a.high < 0.0 for a in advantages))
        metric, sign, bar = claim.metric, claim.sign, claim.bar
        claims[name] = sum(
            sign * (ours[t][metric].mean - (theirs[t][metric].mean if bar is None else bar)) > 0.0 for t in shared
        )
    return Summary(cells, claims, evidence, len(shared))


def _advantage(claim: Claim, ours: dict[int, dict[str, float]], theirs: dict[int, dict[str, float]]) -> Interval:
    """Mean advantage over the rollouts, each against the other method's on the same blocks, or against the claim's bar."""
    numbers = sorted(ours.keys() & theirs.keys() if claim.bar is None else ours.keys())
    if len(numbers) < 5:  # of fewer, all differ in the same direction by chance too often for 95 %
        return Interval(0.0, -np.inf, np.inf)
    other = [theirs[n][claim.metric] if claim.bar is None else claim.bar for n in numbers]
    return bootstrap_mean(claim.sign * (np.array([ours[n][claim.metric] for n in numbers]) - other))


def bootstrap_mean(values: np.ndarray) -> Interval:
    """Mean of [n] values and its 95 % percentile bootstrap interval; no width where they are all the same."""
    mean = float(values.mean())
    if len(values) < 2 or np.ptp(values) == 0.0:
        return Interval(mean, mean, mean)
    result = stats.bootstrap((values,), np.mean, n_resamples=2000, method="percentile", rng=np.random.default_rng(0))
    return Interval(mean, float(result.confidence_interval.low), float(result.confidence_interval.high))


def _share(outcome: str) -> Callable[[Episode], float]:
    return lambda e: float(e.outcome == outcome)


_COMMON: dict[str, Callable[[Episode], float]] = {
    "success": _share("success"),
    "fall": _share("fall"),
    "pairs": lambda e: e.pairs,
    "steps": lambda e: e.steps,
    "ever_stuck": lambda e: float(e.outcome == "stuck" or e.steps_until_stuck < e.steps),
}
_WHOLE = {
    "reward": lambda e: e.reward / e.steps,
    "distance": lambda e: min(e.distance, 8.5),
    "collisions": lambda e: e.collisions / e.steps,
} | _COMMON
_UNTIL_STUCK = {
    "reward": lambda e: e.reward_until_stuck / e.steps_until_stuck,
    "distance": lambda e: min(e.distance_until_stuck, 8.5),
    "collisions": lambda e: e.collisions_until_stuck / e.steps_until_stuck,
} | _COMMON


def published_json() -> list[dict[str, Any]]:
    """The published figures as JSON-like values."""
    return [terrain._asdict() | published._asdict() for terrain, published in PUBLISHED.items()]
