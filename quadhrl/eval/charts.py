"""The paper's three bar charts, with the published bars beside ours."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np

from quadhrl.eval.summary import Summary
from quadhrl.eval.terrains import PUBLISHED

__all__ = ["CHARTS", "draw_charts"]

CHARTS = {
    "normalized_reward": ("reward", "normalised reward [%]"),
    "distance": ("distance", "distance [m]"),
    "collisions": ("collisions", "collisions per control step"),
}
"""Metric -> published metric and axis title."""

_SERIES = (("hlp", 0, "#1b6ca8", "hierarchical"), ("end-to-end", 1, "#d9822b", "end-to-end"))
_CONTROLS = (("llp-in-place", "#5b9a4d", "in-place targets"), ("llp-random", "#8a6fb3", "random targets"))


def draw_charts(summary: Summary, folder: Path) -> dict[str, Path]:
    """Write each chart as PNG and SVG; returns the PNGs' paths by metric."""
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    terrains = summary.terrains
    x = np.arange(len(terrains), dtype=float)
    paths = {}
    for metric, (published, title) in CHARTS.items():
        controls = _CONTROLS if metric == "normalized_reward" else ()
        figure, axis = plt.subplots(figsize=(11, 4.2), constrained_layout=True)
        bars = 2 * len(_SERIES) + len(controls)
        width, position = 0.84 / bars, 0
        for method, column, colour, label in _SERIES:
            _bars(
                axis, x + (position - bars / 2 + 0.5) * width, width, summary, method, metric, terrains, colour, label
            )
            theirs = [getattr(PUBLISHED[t], published)[column] if t in PUBLISHED else 0.0 for t in terrains]
            place = x + (position + 1 - bars / 2 + 0.5) * width
            axis.bar(place, theirs, width, color="white", edgecolor=colour, hatch="////", label=f"{label}, published")
            position += 2
        for method, colour, label in controls:
            _bars(
                axis, x + (position - bars / 2 + 0.5) * width, width, summary, method, metric, terrains, colour, label
            )
            position += 1
        if metric == "normalized_reward":
            axis.axhline(100.0, color="black", linewidth=0.8)
        axis.set_xticks(x, [t.label for t in terrains])
        axis.set(xlabel="infill [%] / height range [m]", ylabel=title)
        axis.grid(axis="y", alpha=0.3)
        axis.set_axisbelow(True)
        axis.legend(ncols=6, fontsize="small", frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.0))
        paths[metric] = folder / f"{metric}.png"
        for suffix in (".png", ".svg"):
            figure.savefig(paths[metric].with_suffix(suffix), dpi=130)
        plt.close(figure)
    return paths


def _bars(axis, x, width, summary, method, metric, terrains, colour, label) -> None:
    """One series with its intervals; terrains that were not run stay empty."""
    row = summary.cells.get(method, {})
    if not row:
        return
    cells = [row[t][metric] if t in row else None for t in terrains]
    means = [c.mean if c else 0.0 for c in cells]
    errors = np.array([(c.mean - c.low, c.high - c.mean) if c else (0.0, 0.0) for c in cells]).T
    axis.bar(x, means, width, color=colour, label=label, yerr=errors, error_kw={"linewidth": 0.8}, capsize=1.5)
