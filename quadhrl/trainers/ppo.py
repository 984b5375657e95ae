"""Proximal policy optimisation: ``python -m quadhrl.trainers.ppo`` (paper, section II-A).

Collector -> GAE -> ClipPPOLoss -> Adam with a learning rate that follows the KL divergence.
"""

from __future__ import annotations

import logging
import math
import signal
import sys
import time
import warnings
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.checkpoint import Checkpoint, CheckpointError, GlobalRNGState
from torchrl.collectors import Collector
from torchrl.objectives import ClipPPOLoss

from quadhrl.envs import ENVIRONMENTS
from quadhrl.envs.threads import one_thread_for_small_batches
from quadhrl.errors import InputError, command_line
from quadhrl.sim import Fault, resolve_device
from quadhrl.trainers.advantage import add_advantages
from quadhrl.trainers.checkpoint import build_networks, find_checkpoint, load_networks, read_metadata
from quadhrl.trainers.config import TrainConfig, flag_value, parse_command_line
from quadhrl.trainers.progress import TrainingProgress
from quadhrl.trainers.run_directory import RunDirectory, describe_machine, read_run_config
from quadhrl.trainers.statistics import rollout_statistics

__all__ = ["PPOTrainer", "main"]

logger = logging.getLogger(__name__)


class PPOTrainer:
    """Environment, networks, loss and optimiser of one run, and its position in it.

    Args:
        config: the run's settings.

    Raises:
        InputError: a setting is out of its range.
    """

    RECENT = 16
    WARM_UP = 10.0
    """Robots begin together, on level ground and with easy targets: rewards of this time [s] are no measure of a policy."""

    def __init__(self, config: TrainConfig) -> None:
        config.validate()
        self.config = config
        self.device = resolve_device(config.device)
        torch.manual_seed(config.seed)
        environment = ENVIRONMENTS[config.task]
        self.env = environment(config.env, config.num_envs, engine=config.engine, device=self.device, seed=config.seed)
        self.inherited = {"samples": 0, "wall_seconds": 0.0}
        """What had gone into the networks of ``--init-from``."""
        if config.init_from and not config.resume:  # a resumed run keeps the name of what it once began with
            loaded = load_networks(config.init_from, task=config.task, field="--init-from")
            self.networks = loaded.networks.train()
            for name in self.inherited:
                self.inherited[name] = loaded.metadata.get(f"total_{name}", loaded.metadata.get(name, 0))
        else:
            self.networks = build_networks(config)
        self.networks.to(self.device)
        self.collector = Collector(
            self.env,
            self.networks.policy(),
            frames_per_batch=config.num_envs * config.ppo.horizon,
            total_frames=-1,
            device=self.device,
            track_traj_ids=False,
            auto_register_policy_transforms=False,
        )
        self._batches = iter(self.collector)
        ppo = config.ppo
        self.loss = ClipPPOLoss(
            self.networks.actor,
            self.networks.critic,
            clip_epsilon=ppo.clip_epsilon,
            entropy_bonus=ppo.entropy_coeff > 0,
            entropy_coeff=ppo.entropy_coeff,
            critic_coeff=ppo.critic_coeff,
            loss_critic_type="l2",
            normalize_advantage=False,
        )
        self.loss.set_keys(value="normalized_value", value_target="normalized_target")
        self.optimizer = torch.optim.Adam(self.loss.parameters(), lr=ppo.learning_rate, eps=1e-8, fused=True)
        self.samples = 0
        """Samples trained on so far."""
        self.recent_rewards: list[float] = []
        """Reward per control step of the last updates after `WARM_UP`, at most `RECENT` of them."""
        self.max_reward = -math.inf
        """Largest mean of `recent_rewards` so far, once there are `RECENT`."""
        self.wall_seconds = 0.0
        """Time spent in `iterate` so far, over all resumes [s]."""

    def iterate(self) -> dict[str, float]:
        """Collect one batch, update the networks with it, and return the scalars that describe both."""
        began = time.perf_counter()
        if not bool(self.networks.normalizer.module.statistics.count):
            self._initialize_normalizer()
        batch = self._collect()
        collected = time.perf_counter()
        scalars = rollout_statistics(batch, self.config.env.physics.control_dt)
        scalars |= self.update(batch)
        # Only now: the update must see the same features as the collection did, or its ratios would not begin at 1.
        self._update_normalizer(batch)
        self.samples += batch.numel()
        if self.samples / self.config.num_envs * self.config.env.physics.control_dt > self.WARM_UP:
            self.recent_rewards = [*self.recent_rewards[1 - self.RECENT :], scalars["rollout/reward"]]
        if len(self.recent_rewards) == self.RECENT:
            self.max_reward = max(self.max_reward, sum(self.recent_rewards) / self.RECENT)
        ended = time.perf_counter()
        self.wall_seconds += ended - began
        scalars |= {
            "perf/steps_per_second": batch.numel() / (ended - began),
            "perf/collection_seconds": collected - began,
            "perf/update_seconds": ended - collected,
            "curriculum/level": self.env.curriculum.level.mean().item(),
        }
        for kind, count in zip(Fault, self.env.sim.fault_counts.tolist(), strict=True):
            scalars[f"faults/{kind.name}".lower()] = count
        return scalars

    def update(self, batch: TensorDictBase) -> dict[str, float]:
        """Improve the networks with a rollout [N, T]; returns the update's scalars."""
        ppo, networks = self.config.ppo, self.networks
        add_advantages(batch, networks, gamma=ppo.gamma, lmbda=ppo.lmbda)
        statistics, target = networks.value_statistics, batch["value_target"]
        explained = 1.0 - (target - batch["state_value"]).var() / target.var().clamp(min=1e-8)
        statistics.update(target)
        advantage = batch["advantage"]
        data = batch.select("features", "action", "action_log_prob").reshape(-1)
        data["normalized_target"] = ((target - statistics.mean) / statistics.std).reshape(-1, 1)
        data["advantage"] = ((advantage - advantage.mean()) / advantage.std().clamp(min=1e-8)).reshape(-1, 1)

        views = [data, self._mirrored(batch, data)] if ppo.symmetry else [data]

        # Shuffled once per batch, as in rsl_rl: gathering the rows anew for every pass costs more than it helps.
        order = torch.randperm(len(data), device=self.device)
        minibatches = list(zip(*(view[order].chunk(ppo.minibatches) for view in views), strict=True))
        sums: dict[str, float] = {}
        updates = skipped = 0
        for _ in range(ppo.epochs):
            epoch_kl: list[float] = []
            for minibatch in minibatches:
                seen = [self.loss(view) for view in minibatch]
                loss = sum(value for losses in seen for key, value in losses.items() if key.startswith("loss_"))
                loss, losses = loss / len(seen), seen[0]  # the divergence, too, is that of what was really sampled
                self.optimizer.zero_grad()
                loss.backward()
                norm = torch.nn.utils.clip_grad_norm_(self.loss.parameters(), ppo.max_grad_norm)
                if not math.isfinite(norm):
                    skipped += 1
                    continue
                self.optimizer.step()
                epoch_kl.append(losses["kl_approx"].item())
                updates += 1
                for name in ("loss_objective", "loss_critic", "kl_approx", "clip_fraction"):
                    sums[name] = sums.get(name, 0.0) + losses[name].item()
        if updates == 0:
            raise FloatingPointError("every gradient of this batch is non-finite; resume from the last checkpoint")
        # Once per batch, by its last pass: the divergence adds up over a batch, so that adapting at each step drives the rate
        # up at the batch's beginning and far down at its end.
        self._adapt_learning_rate(sum(epoch_kl) / len(epoch_kl))
        means = {f"update/{name.removesuffix('_approx')}": value / updates for name, value in sums.items()}
        return means | {
            "update/learning_rate": self.learning_rate,
            "update/explained_variance": explained.item(),
            "update/skipped": float(skipped),
            "policy/std": networks.actor[0].module.log_std.exp().mean().item(),
        }

    def _mirrored(self, batch: TensorDictBase, data: TensorDictBase) -> TensorDictBase:
        """The rows of `update` as seen in a mirror: other features and actions, the same advantages and targets.

        They were sampled by the policy's mirror image, so the probabilities of the actions that were taken stay as they are.
        """
        mirrors, networks = self.env.mirrors, self.networks
        features = networks.normalizer.module(*(mirrors[key](batch[key]) for key in networks.observations))
        mirrored = data.clone(recurse=False)
        mirrored["features"] = features.reshape(len(data), -1)
        mirrored["action"] = mirrors["action"](data["action"])
        return mirrored

    @property
    def learning_rate(self) -> float:
        """The optimiser's present learning rate."""
        return self.optimizer.param_groups[0]["lr"]

    def checkpoint(self) -> Checkpoint:
        """Everything that a resumed run needs, for `Checkpoint.save` and `Checkpoint.load`."""
        return Checkpoint(
            format="archive",
            networks=self.networks,
            optimizer=self.optimizer,
            env=self.env,
            rng=GlobalRNGState(),
            position=self,
        )

    def history(self) -> dict[str, Any]:
        """What has gone into the networks and what they reached, for the checkpoint's metadata."""
        inherited, recent = self.inherited, self.recent_rewards
        reached = {"reward": sum(recent) / len(recent) if recent else 0.0}  # 0: nothing is known before `WARM_UP`
        if math.isfinite(self.max_reward):
            reached["max_reward"] = self.max_reward
        return reached | {
            "wall_seconds": self.wall_seconds,
            "total_samples": inherited["samples"] + self.samples,
            "total_wall_seconds": inherited["wall_seconds"] + self.wall_seconds,
            "machine": describe_machine(self.device),
        }

    def state_dict(self) -> dict[str, Any]:
        """The run's position, beside what has a state of its own."""
        return {
            "samples": self.samples,
            "wall_seconds": self.wall_seconds,
            "recent_rewards": self.recent_rewards,
            "max_reward": self.max_reward,
            "inherited": self.inherited,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the run's position."""
        self.samples, self.wall_seconds = int(state["samples"]), float(state["wall_seconds"])
        self.recent_rewards, self.max_reward = list(state["recent_rewards"]), float(state["max_reward"])
        self.inherited = state.get("inherited", self.inherited)

    def load(self, path: Any) -> None:
        """Carry on exactly where the checkpoint was saved.

        Raises:
            InputError: it is damaged, or its environment's state is of another version.
        """
        try:
            self.checkpoint().load(path, map_location=self.device)
        except CheckpointError as error:
            remedy = "it is damaged or another version wrote its environment's state; start a new run with --init-from"
            raise InputError("--resume", str(path), remedy) from error
        self.collector.reset(keep_state=True)

    def _adapt_learning_rate(self, kl: float) -> None:
        ppo, rate = self.config.ppo, self.learning_rate
        if kl > 2.0 * ppo.target_kl:
            rate = max(rate / 1.5, ppo.min_learning_rate)
        elif kl < 0.5 * ppo.target_kl:
            rate = min(rate * 1.5, ppo.max_learning_rate)
        for group in self.optimizer.param_groups:
            group["lr"] = rate

    def _initialize_normalizer(self) -> None:
        """Spend one batch on the observation statistics alone; it is not trained on and does not count."""
        self._update_normalizer(self._collect())

    def _update_normalizer(self, batch: TensorDictBase) -> None:
        """Take every fourth step of a rollout [N, T] into the statistics: neighbours in time say the same."""
        self.networks.normalizer.module.update(*(batch[key][:, ::4] for key in self.networks.observations))

    def _collect(self) -> TensorDictBase:
        with one_thread_for_small_batches(self.config.num_envs, self.device):
            return next(self._batches)


class _StopRequest:
    """Turns the first Ctrl-C (or SIGTERM) into a flag; the second one interrupts at once."""

    def __init__(self) -> None:
        self.requested = False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._handle)

    def _handle(self, number: int, _frame: object) -> None:
        if self.requested:
            raise KeyboardInterrupt
        self.requested = True


def train(config: TrainConfig) -> None:
    """Run training to its end, or to the first Ctrl-C, saving checkpoints on the way."""
    resume_from = find_checkpoint(config.resume, "--resume") if config.resume else None
    trainer = PPOTrainer(config)
    if resume_from is not None:
        read_metadata(resume_from, "--resume")
        trainer.load(resume_from)
    directory = RunDirectory(config)
    stop = _StopRequest()

    def save() -> None:
        directory.save(checkpoint, trainer.samples, **trainer.history())

    checkpoint = trainer.checkpoint()
    began = last_save = time.monotonic()
    with TrainingProgress(config.total_steps, trainer.samples) as progress:
        sim = trainer.env.sim
        progress.message(f"run {directory.path}: {config.num_envs} worlds, {sim.engine} engine, {trainer.device}")
        while trainer.samples < config.total_steps and not stop.requested:
            if config.max_minutes and time.monotonic() - began > 60.0 * config.max_minutes:
                break
            scalars = trainer.iterate()
            directory.log(scalars, trainer.samples)
            progress.update(trainer.samples, scalars)
            if time.monotonic() - last_save > 60.0 * config.checkpoint_minutes:
                save()
                last_save = time.monotonic()
        save()
    if trainer.samples < config.total_steps:
        print(f"stopped at {trainer.samples} samples; carry on with: --resume {directory.path}")
    else:
        print(f"done: {trainer.samples} samples in {trainer.wall_seconds:.0f} s, see {directory.path}")


def main() -> None:
    """Command line of the trainer."""

    def run() -> None:
        resume = flag_value(sys.argv[1:], "--resume")
        config = parse_command_line(read_run_config(resume) if resume else None)
        train(config)

    logging.basicConfig(level=logging.INFO, format="%(message)s")
    warnings.filterwarnings("ignore", category=FutureWarning, module="torchrl")
    command_line(run)


if __name__ == "__main__":
    main()
