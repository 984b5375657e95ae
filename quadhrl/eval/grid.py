"""The paper's comparison: ``python -m quadhrl.eval.grid --out results`` runs, measures, draws and reports (section IV)."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import resource
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console

from quadhrl import __version__
from quadhrl.errors import InputError, check_range, command_line
from quadhrl.eval.charts import draw_charts
from quadhrl.eval.landscape import draw_landscape
from quadhrl.eval.methods import METHODS, make_method
from quadhrl.eval.report import write_report, write_table
from quadhrl.eval.results import ResultsFolder
from quadhrl.eval.rollouts import Episode, Job, StopRules, run_episodes
from quadhrl.eval.summary import Normalizer, Summary, bootstrap_mean, published_json, summarize
from quadhrl.eval.terrains import TestTerrain
from quadhrl.policies import HighLevelConfig
from quadhrl.sim import resolve_device
from quadhrl.trainers.checkpoint import LoadedPolicy, find_checkpoint, load_networks

__all__ = ["GridConfig", "main", "run_grid"]


@dataclass
class GridConfig:
    """Compare the methods on a grid of terrains. Run it again with the same --out to carry on, or to add rollouts."""

    out: str = "comparison"
    """Folder for the results; finished rollouts in it are not run again."""
    rollouts: int = 5
    """Rollouts per method and terrain."""
    methods: tuple[str, ...] = tuple(METHODS)
    """Methods to run: hlp, llp-random, llp-in-place, end-to-end."""
    checkpoint_footstep: str = "footstep"
    """Checkpoint or run directory of the low-level policy."""
    checkpoint_forward: str = "forward"
    """Checkpoint or run directory of the end-to-end policy."""
    infill: tuple[float, ...] = (1.0, 0.9, 0.8)
    """Infills of the terrains, 0 to 1."""
    height_range: tuple[float, ...] = (0.0, 0.05, 0.075, 0.1)
    """Height ranges of the terrains [m]."""
    rules: StopRules = field(default_factory=StopRules)
    hlp: HighLevelConfig = field(default_factory=HighLevelConfig)
    seed: int = 0
    """Seed of terrains and targets."""
    num_envs: int = 64
    """Worlds to simulate at once; the results do not depend on it."""
    engine: str = "auto"
    """Physics engine: warp, native or auto."""
    device: str = "cpu"
    """Torch device: cpu, cuda, cuda:N or auto."""

    def validate(self) -> None:
        """Check every field.

        Raises:
            InputError: a field is out of its range.
        """
        check_range(self, "", "rollouts num_envs", 1)
        check_range(self.rules, "rules", "max_steps", 1)
        check_range(self.rules, "rules", "stuck_seconds", 0, unit="s", above=True)
        self.hlp.validate()
        for flag, values, high in (("--infill", self.infill, 1.0), ("--height-range", self.height_range, 0.5)):
            bad = [value for value in values if not 0.0 <= value <= high]
            if bad or not values:
                unit = "(1 is 100 %)" if flag == "--infill" else "m"
                raise InputError(
                    flag, bad[0] if bad else values, f"give values of at least 0 and at most {high:g} {unit}"
                )
        unknown = [name for name in self.methods if name not in METHODS]
        if unknown or not self.methods:
            raise InputError("--methods", unknown[0] if unknown else (), f"choose some of: {', '.join(METHODS)}")


REFERENCES = {"footstep": "llp-random", "forward": "end-to-end"}
"""The method whose reward on its task's training terrain counts as 100 %."""

REFERENCE_ROLLOUTS = 20
"""Rollouts behind that figure."""

REFERENCE_RULES = StopRules(max_steps=3600, end_when_stuck=True)
"""The training's own."""


def run_grid(config: GridConfig) -> Path:
    """Run what is missing, and write figures, ``summary.json``, ``table.md`` and ``report.html``; returns the report's path.

    Raises:
        InputError: a setting, a checkpoint or the results folder is not usable.
    """
    began = time.monotonic()
    config.validate()
    device = resolve_device(config.device)
    policies = _load(config)
    folder = ResultsFolder(Path(config.out), _fingerprint(config, str(device)))
    batches = list(_plan(config, folder, policies))
    progress = _Progress(batches, len(folder.episodes))
    for name, jobs, rules in batches:
        method = make_method(name, policies[METHODS[name].task], config.hlp)
        progress.begin(name, jobs, rules)
        for episode in run_episodes(
            method, jobs, rules, seed=config.seed, engine=config.engine, device=device, report=progress.report
        ):
            folder.add(episode)
            progress.finish_one()
    folder.sort()

    normalizers = _normalizers(folder, policies)
    episodes = [e for e in folder.episodes if _asked_for(e, config)]  # the folder may hold more
    summary = summarize(episodes, normalizers)
    variants = {
        "authors_rules": summarize(episodes, normalizers, until_stuck=True),
        "by_training_maximum": summarize(episodes, normalizers, by_training=True),
    }
    draw_charts(summary, folder.path)
    if "hlp" in config.methods:
        walking = make_method("hlp", policies["footstep"], config.hlp)
        draw_landscape(walking, folder.path / "landscape.png", seed=config.seed)
    run = {
        "seconds": round(time.monotonic() - began, 1),
        "rollouts_run": progress.finished,
        "peak_memory_gib": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, 2),
    }
    facts = _facts(config, folder, policies, normalizers)
    _write_summary(folder.path / "summary.json", summary, variants, facts | {"run": run})
    write_table(folder.path, summary, variants["authors_rules"])
    return write_report(folder.path, config, summary, variants, facts, run)


def _asked_for(episode: Episode, config: GridConfig) -> bool:
    terrain = episode.infill in config.infill and episode.height_range in config.height_range
    return terrain and episode.method in config.methods and episode.rollout < config.rollouts


def _load(config: GridConfig) -> dict[str, LoadedPolicy]:
    paths = {"footstep": config.checkpoint_footstep, "forward": config.checkpoint_forward}
    return {
        task: load_networks(paths[task], task=task, device=resolve_device(config.device), field=f"--checkpoint-{task}")
        for task in sorted({METHODS[name].task for name in config.methods})
    }


def _fingerprint(config: GridConfig, device: str) -> dict[str, Any]:
    """What rollouts of one folder must have in common; a method, a terrain or a rollout more or less changes none of them."""
    checkpoints = {}
    for task in ("footstep", "forward"):
        if any(METHODS[name].task == task for name in config.methods):
            file = find_checkpoint(getattr(config, f"checkpoint_{task}"), f"--checkpoint-{task}")
            checkpoints[f"checkpoint_{task}_sha256"] = hashlib.sha256(file.read_bytes()).hexdigest()
    return {
        "version": __version__,
        "seed": config.seed,
        "engine": config.engine,
        "device": device,
        "rules": dataclasses.asdict(config.rules),
        "hlp": dataclasses.asdict(config.hlp),
        **checkpoints,
    }


def _plan(
    config: GridConfig, folder: ResultsFolder, policies: dict[str, LoadedPolicy]
) -> Iterator[tuple[str, list[Job], StopRules]]:
    """Batches of rollouts that are still to be run: method, jobs and stop rules."""
    done = {(e.method, e.infill, e.height_range, e.rollout) for e in folder.episodes}
    terrains = [TestTerrain(infill, height) for height in config.height_range for infill in config.infill]
    work: list[tuple[str, list[Job], StopRules]] = []
    for task, loaded in policies.items():
        trained_on = loaded.config.env.terrain
        terrain = TestTerrain(trained_on.infill, trained_on.height_range)
        jobs = [Job(f"training-{task}", terrain, k) for k in range(REFERENCE_ROLLOUTS)]
        work.append((REFERENCES[task], jobs, REFERENCE_RULES))
    for name in config.methods:
        jobs = [Job(name, terrain, k) for k in range(config.rollouts) for terrain in terrains]
        work.append((name, jobs, config.rules))
    for name, jobs, rules in work:
        left = [job for job in jobs if (job.method, *job.terrain, job.rollout) not in done]
        for start in range(0, len(left), config.num_envs):
            yield name, left[start : start + config.num_envs], rules


def _normalizers(folder: ResultsFolder, policies: dict[str, LoadedPolicy]) -> dict[str, Normalizer]:
    result = {}
    for task, loaded in policies.items():
        rewards = [e.reward / e.steps for e in folder.episodes if e.method == f"training-{task}"]
        trained = loaded.metadata.get("max_reward")
        deterministic = sum(rewards) / len(rewards)
        result[task] = Normalizer(deterministic, float(deterministic if trained is None else trained))
    return result


def _facts(
    config: GridConfig, folder: ResultsFolder, policies: dict[str, LoadedPolicy], normalizers: dict[str, Normalizer]
) -> dict[str, Any]:
    """What the report and the summary say of the run beside its results."""
    references = {}
    for task, loaded in policies.items():
        episodes = [e for e in folder.episodes if e.method == f"training-{task}"]
        minutes = sum(e.steps for e in episodes) * loaded.config.env.physics.control_dt / 60.0
        references[task] = {
            "reward_per_step": bootstrap_mean(_array([e.reward / e.steps for e in episodes]))._asdict(),
            "reward_in_training": normalizers[task].training,
            "falls_per_minute": sum(e.outcome == "fall" for e in episodes) / minutes,
            "pairs_per_second": sum(e.pairs for e in episodes) / minutes / 60.0,
            "metres_per_second": sum(e.distance for e in episodes) / minutes / 60.0,
            "samples": loaded.metadata.get("total_samples", loaded.metadata.get("samples")),
        }
    return {
        "rollouts": config.rollouts,
        "search": config.hlp.search,
        "references": references,
        "configuration": json.loads((folder.path / "configuration.json").read_text()),
        "published": published_json(),
    }


def _array(values: list[float]) -> Any:
    import numpy as np

    return np.array(values)


def _write_summary(path: Path, summary: Summary, variants: dict[str, Summary], facts: dict[str, Any]) -> None:
    content = summary.to_json() | {name: variant.to_json() for name, variant in variants.items()} | facts
    path.write_text(json.dumps(content, indent=1) + "\n")


HLP_COST = 50.0
"""A world's control step with the high-level policy, in steps without it (native engine, two cores)."""


class _Progress:
    """A line with the time that is left: in place on a terminal, now and then elsewhere.

    Args:
        batches: method, jobs and stop rules of what is to be run.
        before: rollouts that are there already.
    """

    LINE_SECONDS = 20.0

    def __init__(self, batches: list[tuple[str, list[Job], StopRules]], before: int) -> None:
        self._console = Console()
        self._total = sum(len(jobs) for _, jobs, _ in batches)
        # Half of the most that a batch may take: some rollouts end early, some never.
        self._to_come = sum(0.5 * len(jobs) * rules.max_steps * _cost(name) for name, jobs, rules in batches)
        self._work = 0.0  # done so far, in world-steps without high-level policy
        self._began, self._last = time.monotonic(), 0.0
        self.finished = 0
        """Rollouts that ended in this run."""
        self._status = self._console.status("") if self._console.is_terminal else None
        if before:
            self._console.print(f"{before} rollouts are there already, {self._total} to go")

    def begin(self, method: str, jobs: list[Job], rules: StopRules) -> None:
        """A batch begins."""
        self._name, self._rollouts, self._ended = jobs[0].method, len(jobs), 0
        self._max_steps, self._cost = rules.max_steps, _cost(method)
        self._to_come -= 0.5 * len(jobs) * rules.max_steps * self._cost
        if self._status is not None:
            self._status.start()

    def finish_one(self) -> None:
        """A rollout has ended."""
        self.finished += 1
        self._ended += 1

    def report(self, step: int, running: int) -> None:
        """A step has been taken."""
        self._work += running * self._cost
        now = time.monotonic()
        over = running == 0 and self.finished >= self._total
        if not over and now - self._last < (0.5 if self._status is not None else self.LINE_SECONDS):
            return
        self._last = now
        left = self._to_come + 0.5 * running * (self._max_steps - step) * self._cost
        eta = (now - self._began) * left / max(self._work, 1.0)
        text = (
            f"{self._name}: {self._ended} of {self._rollouts} rollouts, step {step}; "
            f"{self.finished} of {self._total} in all, ETA {eta / 60:.1f} min"
        )
        if self._status is None:
            self._console.print(text, highlight=False, soft_wrap=True)
        elif over:
            self._status.stop()
        else:
            self._status.update(text)


def _cost(method: str) -> float:
    return HLP_COST if method == "hlp" else 1.0


def main() -> None:
    """Command line of the comparison."""

    def run() -> None:
        config = tyro.cli(GridConfig, prog="python -m quadhrl.eval.grid")
        print(run_grid(config).absolute())

    command_line(run)


if __name__ == "__main__":
    main()
