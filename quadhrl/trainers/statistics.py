"""The numbers that describe one rollout."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase

__all__ = ["rollout_statistics"]


@torch.no_grad()
def rollout_statistics(batch: TensorDictBase, control_dt: float) -> dict[str, float]:
    """Scalars of a rollout [N, T], by their TensorBoard names.

    Args:
        batch: the rollout.
        control_dt: duration of a control step [s].

    Returns:
        Reward per control step; target pairs per second; falls (and tilts), stuck ends and faults per robot-minute; mean
        length of the episodes that ended [steps]; and the mean of each weighted reward term per step.
    """
    after, events = batch["next"], batch["next", "events"]
    seconds = batch.numel() * control_dt
    done = after["done"]
    lengths = events["step_count"][done].float()
    per_minute = 60.0 / seconds
    scalars = {
        "rollout/reward": after["reward"].mean().item(),
        "rollout/falls_per_minute": (events["fall"] | events["tilt"]).sum().item() * per_minute,
        "rollout/faults_per_minute": events["fault"].sum().item() * per_minute,
    }
    if len(lengths):
        scalars["rollout/episode_length"] = lengths.mean().item()
    if events.get("pair_hit", None) is not None:
        scalars["rollout/pairs_per_second"] = events["pair_hit"].sum().item() / seconds
        scalars["rollout/stuck_per_minute"] = events["stuck"].sum().item() * per_minute
    for name, term in after["reward_terms"].items():
        scalars[f"reward/{name}"] = term.mean().item()
    return scalars
