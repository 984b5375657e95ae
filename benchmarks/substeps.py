"""Two physics steps of 1/120 s per control step against four of 1/240 s: do trajectories and returns agree?

``python benchmarks/substeps.py CHECKPOINT`` replays one recorded sequence of joint targets on both and prints how far the bases
drift apart, then lets the policy (deterministic, the paper's episode ends) play on both and prints its statistics.
"""

from __future__ import annotations

import copy
import sys
import warnings
from dataclasses import dataclass
from typing import Annotated

import quadhrl  # noqa: F401  (before torch: see there)  # isort: skip
import torch
import tyro
from torchrl.envs.utils import ExplorationType, set_exploration_type

from quadhrl.envs import FootstepEnv
from quadhrl.envs.footstep import FootstepTerminationConfig
from quadhrl.errors import command_line
from quadhrl.trainers.checkpoint import LoadedPolicy, load_networks
from quadhrl.trainers.statistics import rollout_statistics


@dataclass
class SubstepsConfig:
    """Compare 2 and 4 physics steps per control step."""

    checkpoint: Annotated[str, tyro.conf.Positional]
    """Checkpoint file or run directory."""
    worlds: int = 128
    """Number of worlds."""
    seconds: float = 20.0
    """Simulated time of each rollout [s]."""
    seed: int = 0
    """Seed of targets and terrains."""


def build(loaded: LoadedPolicy, config: SubstepsConfig, substeps: int) -> FootstepEnv:
    settings = copy.deepcopy(loaded.config.env)
    settings.physics.substeps, settings.curriculum.enabled = substeps, False
    settings.termination = FootstepTerminationConfig()
    return FootstepEnv(settings, config.worlds, seed=config.seed)


def compare_trajectories(loaded: LoadedPolicy, config: SubstepsConfig) -> None:
    coarse, fine = (build(loaded, config, substeps) for substeps in (2, 4))
    policy, td = loaded.networks.policy(), coarse.reset()
    fine.reset()
    print("distance between the bases, same joint targets [mm]: median, 90 %")
    for k in range(1, 121):
        td = policy(td)
        advance = coarse.sim.step

        def both(targets: torch.Tensor):
            fine.sim.step(targets)
            return advance(targets)  # noqa: B023

        coarse.sim.step = both
        td = coarse.step(td)["next"]
        coarse.sim.step = advance
        if k in (1, 6, 12, 30, 60, 120):
            apart = (coarse.sim.readings.base_position - fine.sim.readings.base_position).norm(dim=-1) * 1000
            print(f"  after {k / 60:4.2f} s: {apart.median():8.2f} {apart.quantile(0.9):8.2f}")


def compare_returns(loaded: LoadedPolicy, config: SubstepsConfig) -> None:
    print("substeps  reward/step  pairs/s  falls/min  collision term/step")
    for substeps in (2, 4):
        env = build(loaded, config, substeps)
        rollout = env.rollout(round(config.seconds * 60), loaded.networks.policy(), break_when_any_done=False)
        found = rollout_statistics(rollout, 1 / 60)
        print(
            f"{substeps:8d} {found['rollout/reward']:12.3f} {found['rollout/pairs_per_second']:8.2f}"
            f" {found['rollout/falls_per_minute']:10.2f} {found['reward/collision']:20.4f}"
        )


def main() -> None:
    warnings.filterwarnings("ignore", category=FutureWarning, module="torchrl")

    def run() -> None:
        config = tyro.cli(SubstepsConfig, prog="python benchmarks/substeps.py")
        loaded = load_networks(config.checkpoint, task="footstep", field="CHECKPOINT")
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            compare_trajectories(loaded, config)
            compare_returns(loaded, config)

    command_line(run)


if __name__ == "__main__":
    sys.exit(main())
