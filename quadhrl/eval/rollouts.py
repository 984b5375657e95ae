"""Runs evaluation rollouts in batches: each on a terrain of its own, each counted exactly once."""

from __future__ import annotations

import copy
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor

from quadhrl.envs import ENVIRONMENTS, FootstepEnv, LocomotionEnv
from quadhrl.eval.methods import Method
from quadhrl.eval.terrains import TestTerrain
from quadhrl.hashing import hash_key
from quadhrl.policies import HighLevelPolicy

__all__ = ["Episode", "Job", "StopRules", "run_episodes"]


@dataclass(frozen=True)
class StopRules:
    """When a rollout ends, beside a fall and 8.5 m reached (paper, section IV-C; facts of the authors' code, 1.7)."""

    max_steps: int = 10_000
    """Control steps."""
    stuck_seconds: float = 5.0
    """A robot with targets is stuck when it has hit no pair for this long [s]."""
    end_when_stuck: bool = False
    """Whether that ends the rollout, as in the authors' evaluation; if not, it goes on and the moment is noted."""


@dataclass(frozen=True)
class Job:
    """One rollout to run."""

    method: str
    """Name of the method."""
    terrain: TestTerrain
    """Its terrain's difficulty."""
    rollout: int
    """Its number; rollouts of the same number and terrain have the same blocks under every method."""


@dataclass(frozen=True)
class Episode:
    """One finished rollout. What ends in ``_until_stuck`` counts up to the moment in which the robot was first stuck."""

    method: str
    infill: float
    height_range: float
    rollout: int
    outcome: str
    """success, fall, stuck, timeout or fault."""
    steps: int
    """Control steps."""
    reward: float
    """Sum over the steps."""
    distance: float
    """Final position of the base along x [m]."""
    collisions: int
    """Sum over the steps of the number of colliding links."""
    pairs: int
    """Target pairs hit."""
    steps_until_stuck: int
    """The same as `steps` if the robot was never stuck."""
    reward_until_stuck: float
    distance_until_stuck: float
    collisions_until_stuck: int


def run_episodes(
    method: Method,
    jobs: list[Job],
    rules: StopRules,
    *,
    seed: int,
    engine: str,
    device: torch.device,
    report: Callable[[int, int], None] = lambda steps, running: None,
) -> Iterator[Episode]:
    """Run rollouts of one method side by side and give each as it ends.

    A rollout's course follows from the seed, its terrain and its number alone, bit by bit on the native engine, whatever
    else is in the batch.

    Args:
        method: the method.
        jobs: the rollouts, at least one.
        rules: when a rollout ends.
        seed: seed of terrains and targets.
        engine: physics engine.
        device: torch device.
        report: called in each step with the number of steps taken and of rollouts that still run.
    """
    env = _make_env(method, jobs, rules, engine, device, seed)
    tally = _Tally(env, rules)
    running = torch.zeros(env.num_envs, dtype=torch.bool, device=device)
    running[: len(jobs)] = True
    with torch.no_grad(), _worlds_side_by_side(device) as workers:
        td = env.reset()
        for step in range(1, rules.max_steps + 1):
            if method.choose is not None:
                _choose(method.choose, td, running, workers)
            td["action"] = method.act(td)
            td = env.step(td)["next"]
            ended = tally.add(td, running)
            for k in ended.nonzero()[:, 0].tolist():
                yield tally.episode(k, jobs[k])
            running &= ~ended
            count = int(running.sum())
            report(step, count)
            if count == 0:
                return


BLOCK = 32
"""Worlds come in multiples of this: what does not fill two vector registers, PyTorch rounds differently."""


def _make_env(
    method: Method, jobs: list[Job], rules: StopRules, engine: str, device: torch.device, seed: int
) -> LocomotionEnv:
    config = copy.deepcopy(method.env_config)
    limits = config.termination
    limits.max_steps, limits.fall_height, limits.max_tilt, limits.goal_distance = rules.max_steps, 0.0, 90.0, 8.5
    if method.task == "footstep":
        limits.stuck_seconds = 1e6  # the tally sees to it
    worlds = -(-len(jobs) // BLOCK) * BLOCK
    env = ENVIRONMENTS[method.task](config, worlds, engine=engine, device=device, seed=seed)
    padded = jobs + [jobs[-1]] * (worlds - len(jobs))
    infill, height = (torch.tensor([job.terrain[k] for job in padded], device=device) for k in (0, 1))
    rollout = torch.tensor([job.rollout for job in padded], device=device)
    number = hash_key((infill * 1e4).round().long(), (height * 1e4).round().long(), rollout)
    env.terrain.assign(number, infill, height)
    env.set_seed(seed)
    return env


class _Tally:
    """Running sums of every world."""

    def __init__(self, env: LocomotionEnv, rules: StopRules) -> None:
        self._env, self._rules = env, rules
        n, device = env.num_envs, env.device
        self._sums = torch.zeros(2, 3, n, dtype=torch.float64, device=device)
        """Steps, reward and collisions [2, 3, N]: of the whole rollout, and until the robot was first stuck."""
        self._distance = torch.zeros(2, n, device=device)
        self._pairs, self._since_pair = torch.zeros(2, n, dtype=torch.long, device=device)
        self._stuck = torch.zeros(n, dtype=torch.bool, device=device)
        self._patience = round(rules.stuck_seconds / env.config.physics.control_dt)
        self._events: dict[str, Tensor] = {}

    def add(self, after: TensorDictBase, running: Tensor) -> Tensor:
        """Count a step; returns which of the running worlds have ended [N]."""
        self._events = {name: value[:, 0] for name, value in after["events"].items()}
        readings = self._env.sim.readings
        now = torch.stack([torch.ones_like(after["reward"][:, 0]), after["reward"][:, 0], readings.collisions.float()])
        free = running & ~self._stuck
        self._sums += now * torch.stack([running, free])[:, None]
        trusted = ~self._events["fault"]  # a faulty world is back at its start
        x = readings.base_position[:, 0]
        self._distance = torch.where(torch.stack([running & trusted, free & trusted]), x, self._distance)
        if isinstance(self._env, FootstepEnv):
            hit = self._events["pair_hit"]
            self._pairs += hit & running
            self._since_pair = torch.where(hit, 0, self._since_pair + 1)
            self._stuck |= self._since_pair >= self._patience
        done = after["done"][:, 0]
        return running & (done | self._stuck if self._rules.end_when_stuck else done)

    def episode(self, k: int, job: Job) -> Episode:
        """The record of world ``k``, which has just ended."""
        (steps, reward, collisions), (steps_free, reward_free, collisions_free) = self._sums[:, :, k].tolist()
        distance, distance_free = self._distance[:, k].tolist()
        outcome = next((o for o, names in _OUTCOMES.items() if any(self._events[name][k] for name in names)), "stuck")
        return Episode(
            job.method, *job.terrain, job.rollout, outcome, int(steps), reward, distance, int(collisions),
            int(self._pairs[k]), int(steps_free), reward_free, distance_free, int(collisions_free),
        )  # fmt: skip


_OUTCOMES = {"fault": ("fault",), "fall": ("fall", "tilt"), "success": ("success",), "timeout": ("timeout",)}
"""Which events make an outcome, most important first."""


def _choose(policy: HighLevelPolicy, td: TensorDictBase, running: Tensor, workers: ThreadPoolExecutor | None) -> None:
    """Let the high-level policy set the goals of the worlds that still run, some in each thread."""
    worlds = running.nonzero()[:, 0]
    shares = 1 if workers is None else min(os.cpu_count() or 1, max(1, len(worlds) // 2))

    def choose(share: Tensor) -> Tensor:
        return policy(td[share].select(*policy.in_keys))["goal"][: len(share)]

    # At least two worlds in each share: see `FactoredValue`.
    parts = [part.repeat(2) if len(part) == 1 else part for part in worlds.tensor_split(shares)]
    goals = [choose(part) for part in parts] if workers is None else list(workers.map(choose, parts))
    td["goal"] = td["goal"].index_copy(0, torch.cat(parts), torch.cat(goals))


@contextmanager
def _worlds_side_by_side(device: torch.device) -> Iterator[ThreadPoolExecutor | None]:
    """On the CPU, one thread to each operation and a pool of threads for worlds.

    Threads inside an operation cut its data at places that depend on the batch, and its rounding with it.
    """
    if device.type != "cpu":
        yield None
        return
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with ThreadPoolExecutor(os.cpu_count(), initializer=torch.set_num_threads, initargs=(1,)) as pool:
            yield pool
    finally:
        torch.set_num_threads(threads)
