"""Everything that a training run can be told, its presets, and its way through the command line and into files."""

from __future__ import annotations

import dataclasses
import sys
from dataclasses import dataclass, field
from typing import Annotated, Any, get_type_hints

import tyro

from quadhrl.envs import FootstepConfig, ForwardConfig
from quadhrl.errors import InputError, check_range
from quadhrl.policies import NetworkConfig

__all__ = [
    "PRESETS",
    "TASKS",
    "ForwardTrainConfig",
    "PPOConfig",
    "TrainConfig",
    "config_from_dict",
    "parse_command_line",
    "train_config_from_dict",
]


@dataclass
class PPOConfig:
    """Proximal policy optimisation (paper, section II-A; facts of the authors' code, 1.8)."""

    horizon: int = 100
    """Control steps per world and update."""
    epochs: int = 8
    """Passes over the samples per update."""
    minibatches: int = 1
    """Mini-batches per pass."""
    gamma: float = 0.99
    """Discount factor per control step."""
    lmbda: float = 0.95
    """Lambda of the generalised advantage estimate (0.99 in the paper's text, 0.95 in its authors' code)."""
    clip_epsilon: float = 0.2
    """Clipping range of the probability ratio."""
    entropy_coeff: float = 0.0
    """Coefficient of the entropy bonus."""
    critic_coeff: float = 1.0
    """Coefficient of the critic's mean squared error, in normalised units."""
    learning_rate: float = 5e-4
    """Learning rate at the start; it then follows the KL divergence."""
    min_learning_rate: float = 1e-5
    """Lower bound of the learning rate."""
    max_learning_rate: float = 1e-2
    """Upper bound of the learning rate."""
    target_kl: float = 0.01
    """The learning rate falls by 1.5 when the KL divergence exceeds twice this, and rises by 1.5 below half of it."""
    symmetry: bool = False
    """Train on every sample a second time, as seen in a mirror that exchanges left and right."""
    max_grad_norm: float = 1.0
    """Gradients are scaled down to this norm."""

    def validate(self) -> None:
        """Check every field.

        Raises:
            InputError: a field is out of its range.
        """
        check_range(self, "ppo", "horizon epochs minibatches", 1)
        check_range(self, "ppo", "gamma lmbda", 0, 1)
        check_range(self, "ppo", "clip_epsilon learning_rate min_learning_rate target_kl max_grad_norm", 0, above=True)
        check_range(self, "ppo", "max_learning_rate", self.min_learning_rate)


@dataclass
class TrainConfig:
    """Train a policy with PPO."""

    preset: str = "cpu"
    """Where the other fields' defaults come from: paper (4000 worlds, 300 M samples, for a GPU), cpu or smoke."""
    task: str = "footstep"
    """What to learn: footstep (the low-level policy) or forward (the end-to-end baseline)."""
    engine: str = "auto"
    """Physics engine: warp, native (MuJoCo C, CPU only) or auto (warp on CUDA, native on the CPU)."""
    device: str = "auto"
    """Torch device: auto (CUDA where there is one), cpu, cuda or cuda:N."""
    num_envs: int = 512
    """Number of worlds simulated at once."""
    total_steps: int = 20_000_000
    """Samples (control steps summed over worlds) to train for."""
    max_minutes: float = 0.0
    """Stop, with a checkpoint, after this time even if total_steps is not reached [min]; 0 for no limit. Not kept by --resume."""
    seed: int = 0
    """Seed of networks, actions, targets and terrains."""
    log_dir: str = "logs"
    """Folder for run directories."""
    run_name: str = ""
    """Name of the run directory in log_dir; empty for task and time."""
    resume: str = ""
    """Run directory to carry on; its own settings are the defaults then."""
    init_from: str = ""
    """Checkpoint or run directory whose networks the run begins with."""
    checkpoint_minutes: float = 3.0
    """Time between checkpoints [min]."""
    wandb_project: str = ""
    """Weights & Biases project to log to as well; empty for none."""
    env: Annotated[FootstepConfig, tyro.conf.arg(name="")] = field(default_factory=FootstepConfig)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    ppo: PPOConfig = field(default_factory=PPOConfig)

    def validate(self) -> None:
        """Check the fields that no other part checks when it is built.

        Raises:
            InputError: a field is out of its range.
        """
        _check_task(self.task)
        check_range(self, "", "num_envs total_steps", 1)
        check_range(self, "", "max_minutes", 0, unit="min")
        check_range(self, "", "checkpoint_minutes", 0, unit="min", above=True)
        if self.num_envs * self.ppo.horizon < self.ppo.minibatches:
            remedy = f"give at most --num-envs x --ppo.horizon ({self.num_envs * self.ppo.horizon})"
            raise InputError("--ppo.minibatches", self.ppo.minibatches, remedy)
        self.ppo.validate()
        self.network.validate()


@dataclass
class ForwardTrainConfig(TrainConfig):
    """Train the end-to-end baseline with PPO."""

    task: str = "forward"
    """What to learn: footstep (the low-level policy) or forward (the end-to-end baseline)."""
    env: Annotated[ForwardConfig, tyro.conf.arg(name="")] = field(default_factory=ForwardConfig)


TASKS: dict[str, type[TrainConfig]] = {"footstep": TrainConfig, "forward": ForwardTrainConfig}
"""The config of each task."""


def _check_task(task: str) -> None:
    if task not in TASKS:
        raise InputError("--task", task, f"choose one of: {', '.join(TASKS)}")


def _paper(task: str) -> TrainConfig:
    return TASKS[task](preset="paper", num_envs=4000, total_steps=300_000_000)


def _cpu(task: str) -> TrainConfig:
    """What learns fastest on a few cores: smaller updates, earlier ends of hopeless episodes, terrain by curriculum."""
    config = TASKS[task](preset="cpu")
    config.ppo = PPOConfig(horizon=24, epochs=3, minibatches=4, target_kl=0.015)
    config.network.initial_std = 0.25
    config.env.termination.max_steps = 1200
    config.env.termination.fall_height = 0.12
    config.env.termination.max_tilt = 60.0
    config.env.curriculum.enabled = True
    if isinstance(config.env, FootstepConfig):
        config.env.termination.stuck_seconds = 1.0
    return config


def _smoke(task: str) -> TrainConfig:
    """Seconds long: shows that everything runs."""
    config = _cpu(task)
    config.preset, config.num_envs, config.total_steps, config.ppo.horizon = "smoke", 32, 4096, 16
    return config


PRESETS = {"paper": _paper, "cpu": _cpu, "smoke": _smoke}


def parse_command_line(default: TrainConfig | None = None, args: list[str] | None = None) -> TrainConfig:
    """Read the command line over a preset's defaults, or over ``default``.

    Raises:
        InputError: the preset or the task is unknown, a resumed run is of another task, or is to begin with other networks.
    """
    args = sys.argv[1:] if args is None else args
    task = flag_value(args, "--task")
    if default is None:
        preset = flag_value(args, "--preset") or "cpu"
        if preset not in PRESETS:
            raise InputError("--preset", preset, f"choose one of: {', '.join(PRESETS)}")
        _check_task(task or "footstep")
        default = PRESETS[preset](task or "footstep")
    elif task is not None and task != default.task:
        raise InputError("--task", task, f"this run's task is {default.task!r}; leave the flag out with --resume")
    init_from = flag_value(args, "--init-from")
    if init_from is not None and flag_value(args, "--resume") is not None:
        raise InputError("--init-from", init_from, "leave it out with --resume, which has its own networks")
    default.max_minutes = 0.0  # of one start of a run, as in time slices: the next one has its own, or none
    return tyro.cli(type(default), default=default, args=args, prog="python -m quadhrl.trainers.ppo")


def flag_value(args: list[str], flag: str) -> str | None:
    """The value given to a flag, as ``--flag value`` or ``--flag=value``; None where it is missing."""
    for k, arg in enumerate(args):
        if arg == flag and k + 1 < len(args):
            return args[k + 1]
        if arg.startswith(flag + "="):
            return arg.split("=", 1)[1]
    return None


def train_config_from_dict(values: dict[str, Any], where: str = "config") -> TrainConfig:
    """Rebuild a run's config, of whichever task, from its dictionary.

    Raises:
        InputError: the task or a field is unknown (the file is from another version).
    """
    _check_task(values.get("task", ""))
    return config_from_dict(values, TASKS[values["task"]], where)


def config_from_dict(values: dict[str, Any], cls: Any, where: str = "config") -> Any:
    """Rebuild a (nested) config dataclass from its dictionary.

    Raises:
        InputError: a field is unknown (the file is from another version).
    """
    hints = get_type_hints(cls)
    known = {f.name for f in dataclasses.fields(cls)}
    for name in values:
        if name not in known:
            raise InputError(
                f"{where}: field", name, "this version does not know it; use the version that wrote the file"
            )
    nested = {
        name: config_from_dict(value, hints[name], where) if dataclasses.is_dataclass(hints[name]) else value
        for name, value in values.items()
    }
    return cls(**nested)
