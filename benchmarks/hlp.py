"""Time of one solve of the high-level policy's grid search, each search in the same run on the same recorded states.

``python benchmarks/hlp.py [--json]`` prints one object ``{"solves": [{"worlds", "device", "naive_ms", "exact_ms",
"alternating_ms", "agreement", "worst_gap"}]}``: milliseconds per solve and world; the share of states where the alternating
search finds the maximum that the exact one finds; and by how much its objective falls short in the worst state, in reward
units.
The states are those of a robot that walks over the training terrain with the high-level policy.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass

import quadhrl  # noqa: F401  (before torch: see there)  # isort: skip
import torch
import tyro
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from quadhrl.envs import FootstepConfig, FootstepEnv
from quadhrl.errors import InputError, command_line
from quadhrl.policies import ActorCritic, HighLevelConfig, HighLevelPolicy
from quadhrl.policies.high_level import GridProblem
from quadhrl.sim import resolve_device
from quadhrl.trainers.checkpoint import load_networks


@dataclass
class BenchmarkConfig:
    """Measure the searches of the high-level policy."""

    checkpoint: str = "footstep"
    """Footstep policy whose critic and states are used."""
    worlds: tuple[int, ...] = (1, 12, 60)
    """Batch sizes to measure."""
    states: int = 600
    """Recorded states on which the alternating search is compared with the exact one."""
    repeats: int = 3
    """Solves of each batch; the fastest counts."""
    device: str = "auto"
    """Torch device."""
    json: bool = False
    """Print nothing but one JSON object."""


def record_states(networks: ActorCritic, count: int, device: torch.device) -> TensorDictBase:
    """Observations [count] of robots that walk with the high-level policy on the training terrain, ten steps apart."""
    config = FootstepConfig()
    config.targets.max_step = config.targets.max_shift = 0.0
    env = FootstepEnv(config, 60, device=device, seed=1)
    policy = TensorDictSequential(HighLevelPolicy(networks.value()), networks.policy())
    seen: list[TensorDictBase] = []

    def record(_env: FootstepEnv, td: TensorDictBase) -> None:
        if env.step_count[0] % 10 == 5:
            walking = (td["pair"][:, 0] >= 2) & (td["events", "step_count"][:, 0] >= 60)
            seen.append(td.select(*policy.in_keys)[walking].clone())

    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        env.rollout(80 + count // 5, policy=policy, break_when_any_done=False, callback=record)
    states: TensorDictBase = torch.cat(seen)  # type: ignore[assignment]
    return states[torch.randperm(len(states), generator=torch.Generator().manual_seed(0))[:count]]


def solve(networks: ActorCritic, states: TensorDictBase, search: str) -> Tensor:
    """Objectives of the grid points that a search finds [N]."""
    problem = GridProblem(HighLevelPolicy(networks.value(), HighLevelConfig(search=search)), states)
    return problem.objective(problem.search())


def measure(networks: ActorCritic, states: TensorDictBase, worlds: int, search: str, repeats: int) -> float:
    """Milliseconds per solve and world, in batches of ``worlds``: the mean over the first `MEASURED` states or one batch."""
    batches = [states[start : start + worlds] for start in range(0, max(1, MEASURED // worlds) * worlds, worlds)]
    total = 0.0
    for batch in batches:
        best = float("inf")
        for _ in range(repeats):
            began = time.perf_counter()
            solve(networks, batch, search)
            if torch.cuda.is_available():
                torch.cuda.synchronize()
            best = min(best, time.perf_counter() - began)
        total += best
    return 1e3 * total / (len(batches) * worlds)


MEASURED = 12
"""States in single-world solves; how long one takes depends on the state."""


@torch.no_grad()
def main(config: BenchmarkConfig) -> None:
    """Run the benchmark and print the result."""
    device = resolve_device(config.device)
    networks = load_networks(config.checkpoint, task="footstep", device=device, field="--checkpoint").networks
    least = max(MEASURED, *config.worlds)
    if config.states < least:
        raise InputError(
            "--states", config.states, f"give at least {least}: the largest batch and the single solves take these"
        )
    states = record_states(networks, config.states, device)
    exact, alternating = (solve(networks, states, search) for search in ("exact", "alternating"))
    gap = (exact - alternating).clamp(min=0.0)
    # Two points closer than this are the same to float32, whose sums depend on their order.
    agreement, worst = (gap < 1e-3).float().mean().item(), gap.max().item()
    results = []
    for worlds in config.worlds:
        times = {
            "alternating_ms": measure(networks, states, worlds, "alternating", 3 * config.repeats),
            "exact_ms": measure(networks, states, worlds, "exact", config.repeats),
            "naive_ms": measure(networks, states, worlds, "naive", 1 if worlds > 12 else 2),
        }
        row = {"worlds": worlds, "device": str(device)} | {k: round(v, 3) for k, v in reversed(times.items())}
        results.append(row | {"agreement": round(agreement, 4), "worst_gap": round(worst, 4)})
        if not config.json:
            faster = {k: times["naive_ms"] / times[k] for k in ("exact_ms", "alternating_ms")}
            print(results[-1], {k.removesuffix("_ms"): f"{v:.0f} x naive" for k, v in faster.items()}, flush=True)
    if config.json:
        print(json.dumps({"solves": results}))


if __name__ == "__main__":
    command_line(lambda: main(tyro.cli(BenchmarkConfig, prog="python benchmarks/hlp.py")))
