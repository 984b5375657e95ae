"""The comparison as one self-contained page: pictures inside, nothing loaded from anywhere."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jinja2

from quadhrl.eval.charts import CHARTS
from quadhrl.eval.methods import METHODS
from quadhrl.eval.summary import CLAIMS, Summary
from quadhrl.eval.terrains import PUBLISHED, PUBLISHED_CLAIMS

if TYPE_CHECKING:
    from quadhrl.eval.grid import GridConfig

__all__ = ["write_report", "write_table"]


def write_report(
    folder: Path,
    config: GridConfig,
    summary: Summary,
    variants: dict[str, Summary],
    facts: dict[str, Any],
    run: dict[str, Any],
) -> Path:
    """Write ``report.html`` into the results folder from its pictures and figures; returns its path.

    Args:
        folder: the results folder, with the pictures in it.
        config: the comparison's settings.
        summary: its results.
        variants: its results counted in other ways, by name.
        facts: rewards in training and the like.
        run: duration and memory.
    """
    titles = {name: title for name, (_, title) in CHARTS.items()} | {"landscape": "what the high-level policy sees"}
    pictures = {
        name: "data:image/png;base64," + base64.b64encode(file.read_bytes()).decode()
        for name in titles
        if (file := folder / f"{name}.png").exists()
    }
    loader = jinja2.PackageLoader("quadhrl.eval", ".")
    template = jinja2.Environment(loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True).get_template(
        "report.html.j2"
    )
    page = template.render(
        config=config, summary=summary, variants=variants, facts=facts, run=run, pictures=pictures, titles=titles,
        methods=METHODS, claims=CLAIMS, published=PUBLISHED, published_claims=PUBLISHED_CLAIMS,
    )  # fmt: skip
    path = folder / "report.html"
    path.write_text(page)
    return path


def write_table(folder: Path, summary: Summary, until_stuck: Summary) -> Path:
    """Write the means of every terrain as a Markdown table, ``table.md``, published figures in brackets; returns its path.

    Args:
        folder: where to.
        summary: results of whole rollouts.
        until_stuck: the same, each rollout up to the moment in which the robot was first stuck: what was published of `hlp`.
    """
    columns: list[tuple[str, str, str, Summary]] = []
    for metric, title in (
        ("normalized_reward", "reward %"),
        ("distance", "distance m"),
        ("collisions", "collisions/step"),
    ):
        columns += [
            (f"{title}, hlp", metric, "hlp", summary),
            (f"{title}, hlp until stuck", metric, "hlp", until_stuck),
        ]
        columns += [(f"{title}, end-to-end", metric, "end-to-end", summary)]
        if metric == "normalized_reward":
            columns += [(f"{title}, llp-in-place", metric, "llp-in-place", summary)]
    columns = [column for column in columns if column[2] in summary.cells]
    lines = [
        "| infill % / height m | " + " | ".join(title for title, *_ in columns) + " |",
        "| --- |" + " ---: |" * len(columns),
    ]
    for terrain in summary.terrains:
        cells = []
        for _, metric, method, source in columns:
            cell = source.cells[method].get(terrain)
            digits = {"normalized_reward": 0, "distance": 1, "collisions": 2}[metric]
            text = "" if cell is None else f"{cell[metric].mean:.{digits}f}"
            if terrain in PUBLISHED and (method == "end-to-end" or source is until_stuck):
                published = getattr(PUBLISHED[terrain], CHARTS[metric][0])[("hlp", "end-to-end").index(method)]
                text += f" ({published:.{digits}f})"
            cells.append(text)
        lines.append(f"| {terrain.label} | " + " | ".join(cells) + " |")
    path = folder / "table.md"
    path.write_text("\n".join(lines) + "\n")
    return path
