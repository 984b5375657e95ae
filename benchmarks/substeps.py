"""How many physics steps does a control step need? Speed, how deep the feet sink in, collisions and returns for several numbers.

``python benchmarks/substeps.py CHECKPOINT`` lets a policy of either task (deterministic, the paper's episode ends) act on level
ground and on the training terrain. Contacts take their stiffness from the time step (see `quadhrl.sim.scene`).
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from typing import Annotated

import quadhrl  # noqa: F401  (before torch: see there)  # isort: skip
import torch
import tyro

from quadhrl.envs import LocomotionEnv
from quadhrl.errors import command_line
from quadhrl.eval.methods import mean_action
from quadhrl.trainers.checkpoint import LoadedPolicy, load_networks


@dataclass
class SubstepsConfig:
    """Compare numbers of physics steps per control step."""

    checkpoint: Annotated[str, tyro.conf.Positional]
    """Checkpoint file or run directory."""
    substeps: tuple[int, ...] = (2, 3, 4, 6, 8)
    """Physics steps per control step to compare."""
    worlds: int = 128
    """Number of worlds."""
    seconds: float = 10.0
    """Simulated time of each rollout [s]."""
    seed: int = 0
    """Seed of targets and terrains."""


@torch.no_grad()
def measure(env: LocomotionEnv, loaded: LoadedPolicy, steps: int) -> str:
    """One line: reward, collisions, falls, depth of the loaded feet below the ground, and speed."""
    radius = env.sim.scene.model.geom_size[env.sim.scene.feet[0], 0]
    reward, collisions, falls, depths = 0.0, 0.0, 0, []
    td, start = env.reset(), time.perf_counter()
    for _ in range(steps):
        td["action"] = mean_action(loaded.networks, td)
        td = env.step(td)["next"]
        now = env.sim.readings
        ground = env.terrain.heights(now.foot_position[..., :2].contiguous())
        depth = (ground + radius - now.foot_position[..., 2])[now.foot_force[..., 2] > 20]
        depths.append(depth[depth < 0.1])  # a foot beside a block stands under no ground of its own
        reward += td["reward"].mean().item() / steps
        collisions += now.collisions.float().mean().item() / steps
        falls += int(sum(td["events", name].sum().item() for name in ("fall", "tilt")))
        td = env.maybe_reset(td)
    speed = steps * env.num_envs / (time.perf_counter() - start)
    middle, most = (torch.cat(depths) * 1000).quantile(torch.tensor([0.5, 0.99])).tolist()
    minutes = steps * env.num_envs * env.config.physics.control_dt / 60
    return f"{reward:11.2f} {collisions:15.3f} {falls / minutes:10.2f} {middle:13.1f} {most:8.1f} {speed:14.0f}"


def main() -> None:
    def run() -> None:
        config = tyro.cli(SubstepsConfig, prog="python benchmarks/substeps.py")
        loaded = load_networks(config.checkpoint, field="CHECKPOINT")
        print("terrain     substeps  reward/step  collisions/step  falls/min  depth [mm]: median, 99 %   steps/s")
        for infill, height in ((1.0, 0.0), (0.9, 0.05)):
            for substeps in config.substeps:
                loaded.config.env.physics.substeps = substeps
                env = loaded.env(config.worlds, seed=config.seed, infill=infill, height_range=height)
                line = measure(env, loaded, round(config.seconds / env.config.physics.control_dt))
                print(f"{infill:.0%} / {height * 100:g} cm {substeps:11d} {line}", flush=True)

    command_line(run)


if __name__ == "__main__":
    sys.exit(main())
