"""Control steps per second of every layer, measured in one run: raw physics, ``env.step``, collection, training.

``python benchmarks/throughput.py [--json]`` prints one object
``{"engines": {"native": {"worlds", "raw", "env_step", "collect", "train"}, "warp": {...}}}`` for the engines that the machine
has. The policy's actions and the joint targets that they become are recorded first; ``env_step`` replays the actions and
``raw`` the joint targets, from the same state, so both describe the same motion.
"""

from __future__ import annotations

import copy
import json
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import quadhrl  # noqa: F401  (before torch: see there)  # isort: skip
import torch
import tyro
from tensordict.nn import TensorDictModuleBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from quadhrl.errors import command_line
from quadhrl.sim import Readings, resolve_device
from quadhrl.trainers.config import PRESETS, TrainConfig
from quadhrl.trainers.ppo import PPOTrainer


@dataclass
class BenchmarkConfig:
    """Measure the throughput of each engine."""

    worlds: int = 512
    """Worlds of the native engine, and of warp on CUDA."""
    warp_cpu_worlds: int = 16
    """Worlds of the warp engine on the CPU."""
    horizon: int = 24
    """Control steps per batch."""
    repeats: int = 8
    """Batches per figure; the figures take turns, and each is the total over its batches."""
    checkpoint: str = ""
    """Checkpoint or run directory of the policy; empty for an untrained one."""
    engines: tuple[str, ...] = ("native", "warp")
    """Engines to measure."""
    device: str = "auto"
    """Torch device of the warp engine; native runs on the CPU."""
    infill: float = 0.9
    """Probability that a terrain block is present."""
    height_range: float = 0.05
    """Height range of the terrain blocks [m]."""
    json: bool = False
    """Print nothing but one JSON object."""


def measure(engine: str, config: BenchmarkConfig) -> dict[str, float]:
    """Control steps per second of one engine's layers."""
    device = resolve_device(config.device) if engine == "warp" else torch.device("cpu")
    worlds = config.worlds if engine == "native" or device.type == "cuda" else config.warp_cpu_worlds
    train: TrainConfig = PRESETS["cpu"]("footstep")
    train.engine, train.device, train.num_envs, train.init_from = engine, str(device), worlds, config.checkpoint
    train.ppo.horizon, train.env.curriculum.enabled = config.horizon, False
    train.env.terrain.infill, train.env.terrain.height_range = config.infill, config.height_range
    trainer = PPOTrainer(train)
    trainer.iterate()  # compiles, warms up, and initialises the normaliser
    env, sim, policy = trainer.env, trainer.env.sim, trainer.networks.policy()

    def timed(work: Callable[[], object]) -> float:
        if device.type == "cuda":
            torch.cuda.synchronize()
        began = time.perf_counter()
        work()
        if device.type == "cuda":
            torch.cuda.synchronize()
        return time.perf_counter() - began

    def replay_actions(actions: list[torch.Tensor]) -> None:
        td = env.reset(keep_state=True)
        for action in actions:
            td["action"] = action
            env.step(td)

    def replay_targets(targets: list[torch.Tensor]) -> None:
        for joint_targets in targets:
            sim._advance(joint_targets)

    seconds = dict.fromkeys(("raw", "env_step", "collect", "train"), 0.0)
    for _ in range(config.repeats):
        state = copy.deepcopy(env.state_dict())
        actions, targets = _record(trainer, policy, config.horizon)
        env.load_state_dict(state)
        seconds["env_step"] += timed(partial(replay_actions, actions))
        env.load_state_dict(state)
        seconds["raw"] += timed(partial(replay_targets, targets))
        env.load_state_dict(state)
        trainer.collector.reset(keep_state=True)
        seconds["collect"] += timed(trainer._collect)
        seconds["train"] += timed(trainer.iterate)
    total = worlds * config.horizon * config.repeats
    return {"worlds": worlds} | {name: round(total / value, 1) for name, value in seconds.items()}


def _record(
    trainer: PPOTrainer, policy: TensorDictModuleBase, steps: int
) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
    """Let the policy act without resets; returns its actions and the joint targets that they became."""
    env, step = trainer.env, trainer.env.sim.step
    actions: list[torch.Tensor] = []
    targets: list[torch.Tensor] = []

    def recording_step(joint_targets: torch.Tensor) -> Readings:
        targets.append(joint_targets.clone())
        return step(joint_targets)

    env.sim.step = recording_step  # type: ignore[method-assign]
    td = env.reset(keep_state=True)
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        for _ in range(steps):
            td = policy(td)
            actions.append(td["action"].clone())
            td = env.step(td)["next"]
    env.sim.step = step  # type: ignore[method-assign]
    return actions, targets


def main() -> None:
    warnings.filterwarnings("ignore", category=FutureWarning, module="torchrl")

    def run() -> None:
        config = tyro.cli(BenchmarkConfig, prog="python benchmarks/throughput.py")
        figures = {engine: measure(engine, config) for engine in config.engines}
        if config.json:
            print(json.dumps({"engines": figures}))
            return
        for engine, figure in figures.items():
            ratios = "  ".join(
                f"{name} {value:,.0f} ({value / figure['raw']:.2f})"
                for name, value in figure.items()
                if name != "worlds"
            )
            print(f"{engine}, {figure['worlds']} worlds, control steps/s (share of raw): {ratios}")

    command_line(run)


if __name__ == "__main__":
    sys.exit(main())
