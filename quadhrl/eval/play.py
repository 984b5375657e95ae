"""Watch a policy: ``python -m quadhrl.eval.play CHECKPOINT --video out.mp4`` (headless), or ``--viewer`` in a browser."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import torch
import tyro
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from torchrl.envs.utils import ExplorationType, set_exploration_type

from quadhrl.envs import ENVIRONMENTS, FootstepConfig, LocomotionEnv
from quadhrl.errors import InputError, command_line
from quadhrl.policies import HighLevelConfig, HighLevelPolicy
from quadhrl.sim import resolve_device
from quadhrl.trainers.checkpoint import load_networks
from quadhrl.trainers.statistics import rollout_statistics

__all__ = ["PlayConfig", "main", "play"]


@dataclass
class PlayConfig:
    """Play a policy in one world and film it."""

    checkpoint: Annotated[str, tyro.conf.Positional] = ""
    """Checkpoint file or run directory."""
    policy: str = "checkpoint"
    """Who acts: checkpoint (the default, deterministic), zero or random."""
    hlp: bool = False
    """Let the high-level policy choose the targets (for a footstep policy): the robot walks along --heading."""
    heading: float = 0.0
    """Direction of travel in the world with --hlp, 0 along x [degrees]."""
    video: str = ""
    """Write a film of the first world to this file (.mp4; or .gif, with fewer frames)."""
    picture: str = ""
    """Write the last frame to this file (.png)."""
    viewer: bool = False
    """Show the first world in a browser as it runs, in real time."""
    seconds: float = 15.0
    """Simulated time [s]."""
    infill: float | None = None
    """Probability that a terrain block is present; None for what the policy was trained on."""
    height_range: float | None = None
    """Height range of the terrain blocks [m]; None for what the policy was trained on."""
    num_envs: int = 16
    """Worlds to play in; the printed numbers are means over all of them."""
    seed: int = 0
    """Seed of targets and terrains."""
    engine: str = "auto"
    """Physics engine: warp, native or auto."""
    device: str = "cpu"
    """Torch device."""
    width: int = 960
    """Width of the film [px]."""
    height: int = 540
    """Height of the film [px]."""


FRAME_STEPS = {".mp4": 2, ".gif": 6}
"""Control steps per frame: 30 and 10 frames a second."""


def play(config: PlayConfig) -> dict[str, float]:
    """Run the policy, write the film, and return the mean statistics.

    Raises:
        InputError: no policy was chosen, or a file cannot be read or written.
    """
    if config.policy not in ("checkpoint", "zero", "random"):
        raise InputError("--policy", config.policy, "choose checkpoint, zero or random")
    if config.policy == "checkpoint" and not config.checkpoint:
        raise InputError("CHECKPOINT", "", "give a checkpoint or run directory, or choose --policy zero or random")
    for flag, file in (("--video", config.video), ("--picture", config.picture)):
        if file and not Path(file).absolute().parent.is_dir():
            raise InputError(flag, file, "its folder does not exist; create it or choose another")
    if config.seconds <= 0.0:
        raise InputError("--seconds", config.seconds, "give a time above 0 s")
    torch.manual_seed(config.seed)
    device = resolve_device(config.device)
    if config.policy == "checkpoint":
        loaded = load_networks(config.checkpoint, device=device, field="CHECKPOINT")
        task, env_config, policy = loaded.config.task, loaded.config.env, loaded.networks.policy()
    else:
        task, env_config, policy = "footstep", FootstepConfig(), None
    env_config.curriculum.enabled = False
    env_config.termination = type(env_config.termination)()  # the paper's, whatever training used
    for name in ("infill", "height_range"):
        if getattr(config, name) is not None:
            setattr(env_config.terrain, name, getattr(config, name))
    if config.hlp:
        if policy is None or not isinstance(env_config, FootstepConfig):
            raise InputError("--hlp", True, "the high-level policy needs the checkpoint of a footstep policy; give one")
        env_config.targets.max_step = env_config.targets.max_shift = 0.0  # until it begins to choose
        settings = HighLevelConfig(heading=math.radians(config.heading))
        policy = TensorDictSequential(HighLevelPolicy(loaded.networks.value(), settings), policy)
    env = ENVIRONMENTS[task](env_config, config.num_envs, engine=config.engine, device=device, seed=config.seed)

    def act(td):
        if policy is not None:
            return policy(td)
        action = torch.zeros_like(env.action_spec.zero()) if config.policy == "zero" else env.action_spec.rand()
        return td.set("action", action)

    watchers = []
    if config.video or config.picture:
        watchers.append(_Film(config, env))
    if config.viewer:
        from quadhrl.eval.viewer import WebViewer

        watchers.append(WebViewer(env))
        print(watchers[-1].url)

    def watch(_env: LocomotionEnv, _td: TensorDictBase) -> None:
        for watcher in watchers:
            watcher.show()

    steps = round(config.seconds / env_config.physics.control_dt)
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        rollout = env.rollout(
            steps,
            policy=act,
            break_when_any_done=False,
            callback=watch if watchers else None,
            auto_cast_to_device=False,
        )
    for watcher in watchers:
        watcher.close()
    return rollout_statistics(rollout, env_config.physics.control_dt)


class _Film:
    def __init__(self, config: PlayConfig, env: LocomotionEnv) -> None:
        from quadhrl.eval.rendering import WorldRenderer

        self._config, self._steps = config, 0
        self._renderer = WorldRenderer(env, 0, width=config.width, height=config.height)
        self._writer = None
        if config.video:
            kind = Path(config.video).suffix
            if kind not in FRAME_STEPS:
                raise InputError("--video", config.video, f"choose a file that ends in {' or '.join(FRAME_STEPS)}")
            self._frame_steps = FRAME_STEPS[kind]
            seconds = env.config.physics.control_dt * self._frame_steps
            try:
                import imageio.v2 as imageio

                how = {"fps": round(1 / seconds), "macro_block_size": 1, "quality": 7}
                how = how if kind == ".mp4" else {"duration": 1000 * seconds, "loop": 0}
                self._writer = imageio.get_writer(config.video, **how)
            except (ImportError, OSError, ValueError) as error:
                remedy = f"cannot write it ({error}); install quadhrl[video] and choose a writable file"
                raise InputError("--video", config.video, remedy) from error

    def show(self) -> None:
        if self._writer is not None and self._steps % self._frame_steps == 0:
            self._writer.append_data(self._renderer.frame())
        self._steps += 1

    def close(self) -> None:
        if self._writer is not None:
            self._writer.close()
        if self._config.picture:
            import matplotlib.image

            matplotlib.image.imsave(self._config.picture, self._renderer.frame())
        self._renderer.close()


def main() -> None:
    """Command line of the player."""

    def run() -> None:
        config = tyro.cli(PlayConfig, prog="python -m quadhrl.eval.play")
        statistics = play(config)
        for name, value in statistics.items():
            print(f"{name:32s} {value:9.4f}")
        for file in (config.video, config.picture):
            if file:
                print(Path(file).absolute())

    command_line(run)


if __name__ == "__main__":
    sys.exit(main())
