"""A run's folder: resolved config, git state, TensorBoard scalars and checkpoints."""

from __future__ import annotations

import dataclasses
import json
import logging
import os
import platform
import subprocess
from datetime import datetime
from pathlib import Path
from typing import Any

import torch
from torchrl.checkpoint import Checkpoint
from torchrl.record.loggers import get_logger

from quadhrl.errors import InputError
from quadhrl.trainers.checkpoint import metadata, rotation
from quadhrl.trainers.config import TrainConfig, train_config_from_dict

__all__ = ["RunDirectory", "read_run_config"]

logger = logging.getLogger(__name__)


class RunDirectory:
    """Creates, or with ``config.resume`` reopens, the run's folder.

    Args:
        config: the run's settings, written to ``config.json``.

    Raises:
        InputError: the folder cannot be written, or a new run's folder exists already.
    """

    def __init__(self, config: TrainConfig) -> None:
        self.config = config
        name = config.run_name or f"{config.task}_{datetime.now():%Y-%m-%d_%H-%M-%S}"
        self.path = Path(config.resume) if config.resume else Path(config.log_dir) / name
        if not config.resume and (self.path / "config.json").exists():
            raise InputError("--run-name", str(self.path), "this run exists; choose another name, or --resume it")
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            (self.path / "config.json").write_text(json.dumps(dataclasses.asdict(config), indent=2) + "\n")
        except OSError as error:
            raise InputError(
                "--log-dir", str(self.path), f"cannot write there ({error.strerror}); choose another"
            ) from error
        (self.path / "git.txt").write_text(_git_state())
        self._rotation = rotation(self.path)
        self._loggers = [get_logger("tensorboard", logger_name=str(self.path), experiment_name="tensorboard")]
        if config.wandb_project:
            self._loggers.append(
                get_logger(
                    "wandb",
                    logger_name=str(self.path),
                    experiment_name=self.path.name,
                    wandb_kwargs={"project": config.wandb_project},
                )
            )

    def log(self, scalars: dict[str, float], step: int) -> None:
        """Write scalars at ``step`` samples."""
        for target in filter(None, self._loggers):
            for name, value in scalars.items():
                target.log_scalar(name, value, step=step)

    def save(self, checkpoint: Checkpoint, step: int, **facts: Any) -> Path | None:
        """Save a checkpoint at ``step`` samples; a full disk is reported and does not end the run."""
        try:
            return self._rotation.save(checkpoint, step=step, metadata=metadata(self.config, samples=step, **facts))
        except OSError as error:
            logger.error("checkpoint at %d samples not saved (%s); training goes on, free some space", step, error)
            return None


def read_run_config(path: str) -> TrainConfig:
    """The settings of an existing run.

    Raises:
        InputError: there is no run, or its config cannot be read.
    """
    file = Path(path) / "config.json"
    if not file.is_file():
        raise InputError("--resume", path, "no config.json there; give the path of a run directory")
    try:
        values = json.loads(file.read_text())
    except (OSError, ValueError) as error:
        raise InputError("--resume", str(file), "the file is damaged; restore it") from error
    return train_config_from_dict(values, where=f"--resume {file}")


def describe_machine(device: torch.device) -> str:
    """The GPU's name, or the processor's with the number of its cores."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        name = next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        name = platform.processor() or platform.machine()
    return f"{name}, {os.cpu_count()} cores"


def _git_state() -> str:
    """Commit and uncommitted changes of the source tree; empty outside of a repository."""
    root = Path(__file__).parent
    texts = []
    for command in (["git", "rev-parse", "HEAD"], ["git", "diff", "HEAD"]):
        try:
            texts.append(subprocess.run(command, cwd=root, capture_output=True, text=True, timeout=10).stdout)
        except (OSError, subprocess.TimeoutExpired):
            return ""
    return "\n".join(texts)
