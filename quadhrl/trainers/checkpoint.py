"""Checkpoints: what is in them, and loading a policy from one with every check that a stranger's file needs."""

from __future__ import annotations

import copy
import dataclasses
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictSequential
from torchrl.checkpoint import Checkpoint, CheckpointError, CheckpointRotation

from quadhrl.envs import ENVIRONMENTS, LocomotionEnv
from quadhrl.envs.trajectory_generator import ACTION_DIM
from quadhrl.errors import InputError
from quadhrl.policies import ActorCritic
from quadhrl.trainers.config import TrainConfig, train_config_from_dict

__all__ = [
    "FORMAT_VERSION",
    "SHIPPED",
    "LoadedPolicy",
    "find_checkpoint",
    "load_networks",
    "metadata",
    "read_metadata",
    "rotation",
    "save_networks",
]

SHIPPED = {path.stem: path for path in (Path(__file__).parents[1] / "assets").glob("*.torchrl")}
"""The policies that come with the package, by name."""

FORMAT_VERSION = 1
"""Version of the checkpoints' content; raise it when old files can no longer be read."""


@dataclass(frozen=True)
class LoadedPolicy:
    """Networks from a checkpoint, and what they were trained as."""

    networks: ActorCritic
    config: TrainConfig
    metadata: dict[str, Any]
    """Samples and wall time (of its run; ``total_`` with the runs that it began from), machine, and scores in training."""

    @property
    def policy(self) -> TensorDictSequential:
        """Observations -> action [..., 15]; follows TorchRL's exploration type (deterministic: the mean)."""
        return self.networks.policy()

    @property
    def value(self) -> TensorDictSequential:
        """Observations -> ``state_value`` [..., 1], the expected discounted return in reward units."""
        return self.networks.value()

    def env(self, num_envs: int, *, seed: int = 0, engine: str = "auto", **terrain: float) -> LocomotionEnv:
        """The environment that the policy was trained in, with the paper's episode ends and without a curriculum.

        Args:
            num_envs: number of worlds.
            seed: seed of targets and terrains.
            engine: physics engine: warp, native or auto.
            terrain: fields of `quadhrl.sim.TerrainConfig` to change, such as ``infill`` and ``height_range``.

        Raises:
            InputError: an argument is out of its range.
        """
        config = copy.deepcopy(self.config.env)
        config.curriculum.enabled = False
        config.termination = type(config.termination)()
        config.terrain = dataclasses.replace(config.terrain, **terrain)
        device = next(self.networks.parameters()).device
        return ENVIRONMENTS[self.config.task](config, num_envs, engine=engine, device=device, seed=seed)


def build_networks(config: TrainConfig) -> ActorCritic:
    """Fresh networks for a config's task."""
    return ActorCritic(ENVIRONMENTS[config.task].network_inputs, ACTION_DIM, config.network)


def rotation(directory: Path) -> CheckpointRotation:
    """The checkpoints of a run directory: the last two and the best by reward."""
    return CheckpointRotation(directory / "checkpoints", keep_last=2, keep_best=("reward", "max"))


def metadata(config: TrainConfig, **facts: Any) -> dict[str, Any]:
    """A checkpoint's metadata: its format, the run's config, and facts such as samples and reward."""
    return {"quadhrl_format": FORMAT_VERSION, "task": config.task, "config": dataclasses.asdict(config), **facts}


def save_networks(loaded: LoadedPolicy, out: Path) -> None:
    """Write the networks alone, with config and metadata: a twentieth of a run's checkpoint, and all that `load_networks` needs.

    Raises:
        OSError: the file cannot be written.
    """
    facts = {name: value for name, value in loaded.metadata.items() if name not in ("quadhrl_format", "task")}
    config = dataclasses.replace(loaded.config, log_dir="logs", init_from="", resume="")  # paths of another machine
    with tempfile.TemporaryDirectory(dir=out.absolute().parent) as folder:
        file = Path(folder) / out.name
        Checkpoint(format="archive", networks=loaded.networks).save(file, metadata=metadata(config, **facts))
        file.replace(out)


def find_checkpoint(path: str | Path, field: str = "checkpoint") -> Path:
    """The checkpoint file itself, the newest one of a run directory, or a shipped policy by its name.

    Raises:
        InputError: there is none.
    """
    path = SHIPPED.get(str(path), Path(path))
    if path.is_file():
        return path
    if path.is_dir():
        newest = rotation(path).latest()
        if newest is not None:
            return newest
        raise InputError(field, str(path), "no checkpoint in this run directory; give another one")
    names = " or ".join(sorted(SHIPPED))
    remedy = f"no such file or run directory; give the path of a checkpoint (*.torchrl), or one of the shipped: {names}"
    raise InputError(field, str(path), remedy)


def read_metadata(path: Path, field: str = "checkpoint") -> dict[str, Any]:
    """A checkpoint's metadata, after checking that it is one of ours and of this version.

    Raises:
        InputError: the file is damaged, not a checkpoint of this package, or of another version.
    """
    try:
        manifest = Checkpoint.manifest(path)
    except Exception as error:  # zip, JSON, Unicode, key and OS errors: all mean that the file is not readable
        raise InputError(field, str(path), "the file is damaged or no checkpoint; give another one") from error
    facts = manifest.get("metadata") or {}
    if facts.get("quadhrl_format") != FORMAT_VERSION:
        found = facts.get("quadhrl_format")
        remedy = f"its format is {found!r}, this version reads {FORMAT_VERSION}; use the version that wrote it"
        raise InputError(field, str(path), remedy)
    return facts


def load_networks(
    path: str | Path, *, task: str | None = None, device: torch.device | str = "cpu", field: str = "checkpoint"
) -> LoadedPolicy:
    """Load the networks of a checkpoint file or of a run directory's newest checkpoint.

    Args:
        path: checkpoint file, run directory, or name of a shipped policy.
        task: the task that it must have been trained for; None for any.
        device: where the networks go.
        field: what the user calls this input, for error messages.

    Raises:
        InputError: the file is missing, damaged, or of another version or task.
    """
    path = find_checkpoint(path, field)
    facts = read_metadata(path, field)
    if task is not None and facts["task"] != task:
        raise InputError(field, str(path), f"it was trained for the task {facts['task']!r}; give one for {task!r}")
    config = train_config_from_dict(facts["config"], where=f"{field} {path}")
    networks = build_networks(config)
    try:
        Checkpoint(networks=networks).load(path, components={"networks"}, map_location="cpu")
    except (CheckpointError, RuntimeError, OSError, ValueError, KeyError, EOFError) as error:
        raise InputError(field, str(path), "the file is damaged; give another one") from error
    facts = {name: value for name, value in facts.items() if name != "config"}
    return LoadedPolicy(networks.to(device).eval(), config, facts)
