"""Console output of a training run: a progress bar with ETA and a table of the latest numbers."""

from __future__ import annotations

import time
from types import TracebackType

from rich.console import Console, Group
from rich.live import Live
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

__all__ = ["TrainingProgress"]


_LINE = {
    "reward": "rollout/reward",
    "pairs/s": "rollout/pairs_per_second",
    "falls/min": "rollout/falls_per_minute",
    "level": "curriculum/level",
    "std": "policy/std",
    "lr": "update/learning_rate",
    "steps/s": "perf/steps_per_second",
}


class TrainingProgress:
    """Shows a live display on a terminal, and a line every `LINE_SECONDS` elsewhere.

    Args:
        total: samples to train for.
        done: samples already done.
    """

    LINE_SECONDS = 20.0

    def __init__(self, total: int, done: int = 0) -> None:
        self._console = Console()
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.fields[samples]}"),
            TimeElapsedColumn(),
            TextColumn("ETA"),
            TimeRemainingColumn(),
            console=self._console,
            speed_estimate_period=120,
        )
        self._task = self._bar.add_task("training", total=total, completed=done, samples="")
        self._total = total
        self._live = Live(self._bar, console=self._console, refresh_per_second=2) if self._console.is_terminal else None
        self._last_line = 0.0
        self._started, self._begun_at = time.monotonic(), done

    def __enter__(self) -> TrainingProgress:
        if self._live is not None:
            self._live.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._live is not None:
            self._live.__exit__(kind, error, traceback)

    def message(self, text: str) -> None:
        """Print a line above the display."""
        self._console.print(text, highlight=False, soft_wrap=True)

    def update(self, samples: int, scalars: dict[str, float]) -> None:
        """Show the state after ``samples`` samples."""
        self._bar.update(
            self._task, completed=samples, samples=f"{samples / 1e6:.2f} of {self._total / 1e6:g} M samples"
        )
        now = time.monotonic()
        if self._live is not None:
            self._live.update(Group(self._bar, _table(scalars)))
        elif now - self._last_line >= self.LINE_SECONDS or samples >= self._total:
            self._last_line = now
            rate = (samples - self._begun_at) / max(now - self._started, 1e-9)
            eta = (self._total - samples) / max(rate, 1e-9)
            numbers = "  ".join(f"{short} {scalars[name]:.4g}" for short, name in _LINE.items() if name in scalars)
            self.message(f"{samples / 1e6:7.2f} M  {numbers}  ETA {eta / 60:.1f} min")


def _table(scalars: dict[str, float]) -> Table:
    table = Table.grid(padding=(0, 2))
    names = sorted(scalars)
    half = (len(names) + 1) // 2
    for left, right in zip(names[:half], [*names[half:], ""], strict=False):
        cells = [left, f"{scalars[left]:.4g}"] + ([right, f"{scalars[right]:.4g}"] if right else [])
        table.add_row(*cells)
    return table
