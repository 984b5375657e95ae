"""The shipped policies, as a newcomer gets them."""

import pytest
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

import quadhrl
from quadhrl.errors import InputError


@pytest.mark.parametrize(("name", "least_reward"), [("footstep", 2.0), ("forward", 0.8)])
def test_a_shipped_policy_walks(name, least_reward):
    loaded = quadhrl.load_policy(name)
    env = loaded.env(8, seed=3)
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        rollout = env.rollout(240, loaded.policy, break_when_any_done=False)
    assert rollout["next", "reward"][:, 60:].mean() > least_reward
    assert torch.isfinite(loaded.value(rollout[:, 0])["state_value"]).all()
    assert loaded.metadata["task"] == name and loaded.metadata["samples"] > 1e6
    assert env.config.termination == type(env.config.termination)()


def test_its_terrain_can_be_changed():
    env = quadhrl.load_policy("footstep").env(2, infill=1.0, height_range=0.0)
    assert (env.terrain.heights(torch.rand(2, 100, 2)) == 0.0).all()


def test_an_unknown_name_lists_the_shipped_ones():
    with pytest.raises(InputError, match=r"name: got 'trot'; no such file .* one of the shipped: footstep or forward"):
        quadhrl.load_policy("trot")
