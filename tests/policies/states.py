"""States of a robot that walks with the shipped policy, and the shipped critic once more, in numpy."""

from pathlib import Path

import numpy as np
import torch
from tensordict.nn import TensorDictSequential
from torchrl.envs.utils import ExplorationType, set_exploration_type

import quadhrl
from quadhrl.envs import FootstepConfig, FootstepEnv
from quadhrl.policies import ActorCritic, HighLevelConfig, HighLevelPolicy
from quadhrl.trainers.checkpoint import load_networks

POLICY = Path(quadhrl.__file__).parent / "assets" / "footstep.torchrl"


def trained_networks():
    return load_networks(POLICY).networks


def random_networks():
    """An untrained critic with inputs and values of a plausible size."""
    torch.manual_seed(5)
    networks = ActorCritic({"proprioception": 80, "goal": 12, "scan": 284}, 15)
    networks.normalizer.module.statistics.update(0.3 * torch.randn(1000, 376))
    networks.value_statistics.update(60.0 * torch.randn(1000, 1) + 150.0)
    return networks.eval()


def make_env(num_envs, *, infill=0.9, height_range=0.05, seed=3):
    config = FootstepConfig()
    config.terrain.infill, config.terrain.height_range = infill, height_range
    config.targets.max_step = config.targets.max_shift = 0.0
    return FootstepEnv(config, num_envs, seed=seed)


def walk(env, steps, networks, hlp=None, callback=None):
    """A deterministic rollout with the high-level policy."""
    hlp = hlp or HighLevelPolicy(networks.value(), HighLevelConfig(resolution=3))
    policy = TensorDictSequential(hlp, networks.policy())
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        return env.rollout(steps, policy=policy, break_when_any_done=False, callback=callback)


def recorded_states(count=6):
    """Observations [count] of different worlds and moments on the training terrain, with both pairs active."""
    networks, env, seen = trained_networks(), make_env(6), []
    walk(env, 100, networks, callback=lambda _, td: seen.append(td.clone()))
    return torch.stack([seen[70 + 5 * k][k] for k in range(count)])


def numpy_value(networks, observation, goals):
    """The critic on goals [M, 12], all else as in one observation, written out by hand."""
    weights = {name: value.double().numpy() for name, value in networks.state_dict().items()}
    rows = np.concatenate(
        [
            np.tile(observation["proprioception"].double().numpy(), (len(goals), 1)),
            goals,
            np.tile(observation["scan"].double().numpy(), (len(goals), 1)),
        ],
        1,
    )
    prefix = "normalizer.module.statistics."
    std = np.maximum(np.sqrt(weights[prefix + "variance"]), 0.01)
    x = np.clip((rows - weights[prefix + "mean"]) / std, -5, 5) * weights["normalizer.module.gain"]
    for layer in ("0", "2", "4"):
        x = x @ weights[f"critic.module.{layer}.weight"].T + weights[f"critic.module.{layer}.bias"]
        if layer != "4":
            x = np.where(x > 0, x, np.exp(np.minimum(x, 0)) - 1)
    return x[:, 0] * np.sqrt(weights["value_statistics.variance"]) + weights["value_statistics.mean"]
