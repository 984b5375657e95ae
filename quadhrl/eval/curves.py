"""Learning curves of a run as PNG and CSV: ``python -m quadhrl.eval.curves RUN [RUN ...] --out curves.png``."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import matplotlib
import numpy as np
import tyro
from scipy.ndimage import uniform_filter1d

from quadhrl.errors import InputError, command_line

__all__ = ["CurvesConfig", "main", "plot_curves", "read_scalars"]

PANELS = {
    "rollout/reward": "reward per control step",
    "rollout/pairs_per_second": "target pairs hit per second",
    "rollout/falls_per_minute": "falls per robot-minute",
    "curriculum/level": "mean terrain level",
}

SMOOTHED = 25
"""Updates that a point of the thick curves is the mean of; fewer in a run of less than eight times as many."""


@dataclass
class CurvesConfig:
    """Plot the learning curves of training runs."""

    runs: Annotated[tuple[str, ...], tyro.conf.Positional]
    """Run directories."""
    out: str = "curves.png"
    """Picture to write; the numbers go into a CSV file beside it."""
    chain: bool = False
    """Draw the runs one after the other, as stages of one training (each with --init-from the one before)."""


def read_scalars(run: str | Path) -> dict[str, list[tuple[int, float]]]:
    """TensorBoard scalars of a run: (samples, value) by name.

    Raises:
        InputError: there are none.
    """
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    merged: dict[str, dict[int, float]] = {}
    for file in sorted(Path(run).rglob("events.out.tfevents.*")):  # one per start of the run; later ones win
        events = EventAccumulator(str(file), size_guidance={"scalars": 0})
        events.Reload()
        for name in events.Tags()["scalars"]:
            merged.setdefault(name, {}).update((event.step, event.value) for event in events.Scalars(name))
    if not merged:
        raise InputError("RUN", str(run), "no TensorBoard scalars there; give a run directory")
    return {name: sorted(points.items()) for name, points in merged.items()}


def _chained(scalars: dict[str, dict[str, list[tuple[int, float]]]]) -> None:
    """Let each run's samples begin where those of the run before end."""
    begin = 0
    for values in scalars.values():
        for name, points in values.items():
            values[name] = [(begin + step, value) for step, value in points]
        begin = values["rollout/reward"][-1][0]


def plot_curves(runs: list[Path], out: Path, *, chain: bool = False) -> Path:
    """Draw the runs' curves into ``out`` (PNG) and write them beside it as CSV; returns the CSV's path.

    Args:
        runs: run directories.
        out: the picture.
        chain: whether each run begins where the one before ends.

    Raises:
        InputError: a run has no TensorBoard scalars.
    """
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    scalars = {run.name: read_scalars(run) for run in runs}
    if chain:
        _chained(scalars)
    varied = [
        name for name in PANELS if any(np.ptp([y for _, y in run.get(name, [(0, 0)])]) for run in scalars.values())
    ]
    figure, axes = plt.subplots(
        1, len(varied), figsize=(4.2 * len(varied), 3.4), constrained_layout=True, squeeze=False
    )
    for axis, name in zip(axes[0], varied, strict=True):
        for number, (run, values) in enumerate(scalars.items()):
            steps, points = np.array(values.get(name, [])).reshape(-1, 2).T
            smooth = uniform_filter1d(points, min(SMOOTHED, len(points) // 8 + 1), mode="nearest")
            color, dashes = f"C{number}", ("-", "--")[number // 10 % 2]  # there are ten colors
            axis.plot(steps / 1e6, points, color=color, linewidth=0.6, alpha=0.25)
            axis.plot(steps / 1e6, smooth, color=color, linestyle=dashes, linewidth=1.4, label=run)
        axis.set(title=PANELS[name], xlabel="samples [M]")
        axis.grid(alpha=0.3)
    if len(runs) > 1:
        figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=6, frameon=False)
    figure.savefig(out, dpi=130)
    plt.close(figure)
    table = out.with_suffix(".csv")
    with table.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["run", "samples", *PANELS])
        for run, values in scalars.items():
            columns = {name: dict(values.get(name, [])) for name in PANELS}
            for step, _ in values["rollout/reward"]:
                writer.writerow([run, step, *(f"{columns[name].get(step, float('nan')):.5g}" for name in PANELS)])
    return table


def main() -> None:
    """Command line of the plotter."""

    def run() -> None:
        config = tyro.cli(CurvesConfig, prog="python -m quadhrl.eval.curves")
        out = Path(config.out)
        if not out.absolute().parent.is_dir():
            raise InputError("--out", config.out, "its folder does not exist; create it or choose another")
        table = plot_curves([Path(name) for name in config.runs], out, chain=config.chain)
        print(out.absolute(), table.absolute(), sep="\n")

    command_line(run)


if __name__ == "__main__":
    main()
