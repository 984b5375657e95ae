"""What targets over holes cost: pairs hit and time spent, by how far the farther target of a pair lies from solid ground.

``python benchmarks/holes.py`` lets a footstep policy (deterministic, the paper's episode ends) follow random targets. A foot hits
its target with its centre, within 7.5 cm, and stands on a block's edge with its rim, up to 2.65 cm beside the block.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Annotated

import quadhrl  # (before torch: see there)  # isort: skip
import torch
import tyro
from torch import Tensor

from quadhrl.envs import FootstepConfig, FootstepEnv
from quadhrl.errors import InputError, command_line
from quadhrl.eval.methods import mean_action


@dataclass
class HolesConfig:
    """Measure what targets over holes cost."""

    checkpoint: Annotated[str, tyro.conf.Positional] = "footstep"
    """Shipped policy, checkpoint file or run directory."""
    infill: float = 0.9
    """Probability that a terrain block is present."""
    height_range: float = 0.05
    """Height range of the terrain blocks [m]."""
    on_blocks: bool = False
    """Move targets that lie over a gap to the nearest block, whatever the policy was trained with."""
    worlds: int = 256
    """Number of worlds."""
    seconds: float = 20.0
    """Simulated time [s]."""
    seed: int = 1
    """Seed of targets and terrains."""


CLASSES = {"on a block": 0.0, "up to 4 cm off": 0.04, "up to 7.5 cm off": 0.075, "farther": torch.inf}
"""Greatest distance of each class from solid ground [m]."""


def distance_to_ground(env: FootstepEnv) -> Tensor:
    """Distance of the active pair's farther target from the nearest block [N], m; at most the size of a block."""
    target, terrain = env.targets.position, env.terrain
    ground = terrain.nearest_ground(target)
    nearest = torch.where(terrain.over_gap(ground), terrain.config.block_size, (ground - target).norm(dim=-1))
    return torch.where(env.targets.active, nearest, 0.0).amax(-1)


@torch.no_grad()
def main(config: HolesConfig) -> None:
    """Run and print the table."""
    loaded = quadhrl.load_policy(config.checkpoint)
    if isinstance(loaded.config.env, FootstepConfig):
        loaded.config.env.targets.on_blocks = config.on_blocks
    env = loaded.env(config.worlds, seed=config.seed, infill=config.infill, height_range=config.height_range)
    if not isinstance(env, FootstepEnv):
        raise InputError("CHECKPOINT", config.checkpoint, "it has no targets; give a footstep policy")
    bounds = torch.tensor(list(CLASSES.values()))
    pairs, hits, falls, seconds = torch.zeros(4, len(CLASSES))
    td = env.reset()
    steps, rewards, waits = round(config.seconds * 60), torch.zeros(2), torch.zeros(2)
    for _ in range(steps):
        kind = torch.bucketize(distance_to_ground(env), bounds)
        td["action"] = mean_action(loaded.networks, td)
        td = env.step(td)["next"]
        hit, ended = td["events", "pair_hit"][:, 0], td["done"][:, 0]
        wait = (env.steps_since_hit > 60).long()
        rewards += torch.bincount(wait, td["reward"][:, 0], minlength=2)
        waits += torch.bincount(wait, minlength=2)
        seconds += torch.bincount(kind, minlength=len(CLASSES)) / 60
        pairs += torch.bincount(kind[hit | ended], minlength=len(CLASSES))
        hits += torch.bincount(kind[hit], minlength=len(CLASSES))
        falls += torch.bincount(kind[td["events", "tilt"][:, 0]], minlength=len(CLASSES))
        td = env.maybe_reset(td)
    total = config.worlds * config.seconds
    rates = f"pairs/s {hits.sum() / total:.3f}, falls/min {falls.sum() / total * 60:.2f}"
    print(f"reward/step {rewards.sum() / waits.sum():.3f}, {rates}")
    share = f"{waits[1] / waits.sum():.1%} of the time, at {rewards[1] / waits[1]:.2f} reward/step"
    print(f"more than 1 s without a pair: {share} (else {rewards[0] / waits[0]:.2f})")
    print("farther target     pairs    hit  fell  time per pair [s]  share of time")
    for k, name in enumerate(CLASSES):
        row = f"{pairs[k] / pairs.sum():9.1%} {hits[k] / pairs[k]:6.1%} {falls[k] / pairs[k]:5.1%}"
        print(f"{name:16s} {row} {seconds[k] / pairs[k]:14.2f} {seconds[k] / seconds.sum():18.1%}")


if __name__ == "__main__":
    sys.exit(command_line(lambda: main(tyro.cli(HolesConfig, prog="python benchmarks/holes.py"))))
