"""Shapes, initial behaviour, and the value in reward units."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from quadhrl.errors import InputError
from quadhrl.policies import ActorCritic, NetworkConfig

SIZES = {"proprioception": 80, "goal": 12, "scan": 284}


def observations(n):
    return TensorDict({name: torch.randn(n, size) for name, size in SIZES.items()}, [n])


def test_networks_are_the_papers():
    networks = ActorCritic(SIZES, 15)
    layers = [m for m in networks.actor.modules() if isinstance(m, torch.nn.Linear)]
    assert [(m.in_features, m.out_features) for m in layers] == [(376, 128), (128, 128), (128, 15)]
    actor, critic = set(networks.actor.parameters()), set(networks.critic.parameters())
    assert not actor & critic, "separate networks"


def test_initial_policy_stands_near_its_initial_mean():
    networks = ActorCritic(SIZES, 15, NetworkConfig(initial_std=0.3))
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        action = networks.policy()(observations(500))["action"]
    assert action.mean(0)[:3].tolist() == pytest.approx([-0.7, 0.3, 0.3], abs=0.1)
    assert networks.policy()(observations(500))["scale"].unique().item() == pytest.approx(0.3)


def test_deterministic_actions_are_the_mean_and_random_ones_have_the_stated_probability():
    networks, td = ActorCritic(SIZES, 15), observations(4)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        out = networks.policy()(td.clone())
    assert torch.equal(out["action"], out["loc"])
    with set_exploration_type(ExplorationType.RANDOM):
        out = networks.policy()(td.clone())
    expected = torch.distributions.Normal(out["loc"], out["scale"]).log_prob(out["action"]).sum(-1)
    assert torch.allclose(out["action_log_prob"], expected, atol=1e-4)


def test_value_is_in_reward_units_and_differentiable_in_the_goal():
    networks, td = ActorCritic(SIZES, 15), observations(6)
    networks.value_statistics.update(torch.randn(10000, 1) * 50 + 200)
    td["goal"].requires_grad_()
    out = networks.value()(td)
    expected = out["normalized_value"] * networks.value_statistics.std + networks.value_statistics.mean
    assert torch.allclose(out["state_value"], expected)
    out["state_value"].sum().backward()
    assert td["goal"].grad.abs().sum() > 0


def test_bad_settings_are_named():
    with pytest.raises(InputError, match=r"--network\.hidden-size: got 0"):
        ActorCritic(SIZES, 15, NetworkConfig(hidden_size=0))
