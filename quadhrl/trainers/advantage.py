"""Values of a rollout and its generalised advantage estimate (Schulman et al. 2015)."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torchrl.objectives.value import GAE

from quadhrl.policies import ActorCritic

__all__ = ["add_advantages", "add_values"]


@torch.no_grad()
def add_values(batch: TensorDictBase, networks: ActorCritic) -> None:
    """Write ``state_value`` and ``("next", "state_value")`` [N, T, 1] into a rollout [N, T].

    The observation after a step is the next row's, so its value is, too, except at the rollout's end and where an episode
    ended: there the networks see the true last observation, which is what a time-out bootstraps from.
    """
    statistics = networks.value_statistics
    value = networks.critic.module(batch["features"]) * statistics.std + statistics.mean
    after = torch.cat([value[:, 1:], value[:, -1:]], 1)
    ends = batch["next", "done"].squeeze(-1).clone()
    ends[:, -1] = True
    last = batch["next"].select(*networks.observations)[ends]
    after[ends] = networks.value()(last)["state_value"]
    batch["state_value"] = value
    batch["next", "state_value"] = after


@torch.no_grad()
def add_advantages(batch: TensorDictBase, networks: ActorCritic, *, gamma: float, lmbda: float) -> None:
    """Write ``advantage`` and ``value_target`` [N, T, 1] (reward units) into a rollout [N, T]."""
    add_values(batch, networks)
    # The loop over time is exact and steady; TorchRL's vectorised estimate slows down with the number of episode ends.
    GAE(gamma=gamma, lmbda=lmbda, value_network=None, vectorized=False)(batch)
