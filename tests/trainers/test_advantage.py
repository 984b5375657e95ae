"""Values and advantages of a rollout against loops written out by hand."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from quadhrl.policies import ActorCritic
from quadhrl.trainers.advantage import add_advantages

N, T, GAMMA, LMBDA = 5, 30, 0.97, 0.9


@pytest.fixture
def rollout():
    """Random numbers with every kind of episode end; the observation after a time-out differs from the next episode's first."""
    torch.manual_seed(0)
    networks = ActorCritic({"goal": 12}, 15)
    networks.normalizer.module.update(torch.randn(1000, 12) * 3)
    networks.value_statistics.update(torch.randn(1000, 1) * 20 + 100)
    terminated = torch.rand(N, T, 1) < 0.08
    truncated = (torch.rand(N, T, 1) < 0.08) & ~terminated
    done = terminated | truncated
    goal, after = torch.randn(N, T, 12), torch.randn(N, T, 12)
    after[:, :-1] = torch.where(done[:, :-1], after[:, :-1], goal[:, 1:])
    following = TensorDict(
        {"goal": after, "reward": torch.randn(N, T, 1), "done": done, "terminated": terminated, "truncated": truncated},
        [N, T],
    )
    batch = TensorDict({"goal": goal, "features": networks.normalizer.module(goal), "next": following}, [N, T])
    assert truncated.any() and terminated.any()
    return networks, batch


def test_values_are_those_of_the_true_observations(rollout):
    networks, batch = rollout
    add_advantages(batch, networks, gamma=GAMMA, lmbda=LMBDA)
    with torch.no_grad():
        value = networks.value()(batch.select("goal").clone())["state_value"]
        after = networks.value()(batch["next"].select("goal").clone())["state_value"]
    assert torch.allclose(batch["state_value"], value, atol=1e-4)
    assert torch.allclose(batch["next", "state_value"], after, atol=1e-4)


def test_advantages_equal_a_hand_written_gae(rollout):
    networks, batch = rollout
    add_advantages(batch, networks, gamma=GAMMA, lmbda=LMBDA)
    value, after = batch["state_value"].numpy()[..., 0], batch["next", "state_value"].numpy()[..., 0]
    reward = batch["next", "reward"].numpy()[..., 0]
    terminated, done = (batch["next", name].numpy()[..., 0] for name in ("terminated", "done"))
    for world in range(N):
        accumulated = 0.0
        for t in reversed(range(T)):
            bootstrap = 0.0 if terminated[world, t] else after[world, t]  # a time-out bootstraps, a failure does not
            delta = reward[world, t] + GAMMA * bootstrap - value[world, t]
            accumulated = delta + (0.0 if done[world, t] else GAMMA * LMBDA * accumulated)
            assert batch["advantage"][world, t].item() == pytest.approx(accumulated, rel=1e-3, abs=2e-3)
            assert batch["value_target"][world, t].item() == pytest.approx(accumulated + value[world, t], rel=1e-4)
    assert np.isfinite(batch["advantage"]).all()
