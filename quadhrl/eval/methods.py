"""The methods that the comparison runs, each as an environment config and a deterministic policy."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from quadhrl.envs import FootstepConfig, LocomotionConfig
from quadhrl.policies import ActorCritic, HighLevelConfig, HighLevelPolicy
from quadhrl.trainers.checkpoint import LoadedPolicy

__all__ = ["METHODS", "Method", "MethodInfo", "make_method", "mean_action"]


class MethodInfo(NamedTuple):
    """What there is to know of a method without running it."""

    label: str
    """For people."""
    task: str
    """The task whose policy it runs."""


METHODS = {
    "hlp": MethodInfo("low-level policy + high-level policy", "footstep"),
    "llp-random": MethodInfo("low-level policy on random targets", "footstep"),
    "llp-in-place": MethodInfo("low-level policy on fixed in-place targets", "footstep"),
    "end-to-end": MethodInfo("end-to-end policy", "forward"),
}
"""The methods by name: the paper's two, its low-level policy without the high-level one, and a control."""


@dataclass(frozen=True)
class Method:
    """A method, ready to run."""

    task: str
    """The environment's task."""
    env_config: LocomotionConfig
    """The environment as the policy was trained in, with this method's targets."""
    act: Callable[[TensorDictBase], Tensor]
    """Observations [N] -> actions [N, 15]."""
    choose: HighLevelPolicy | None
    """Chooses the targets before `act`, if anything does."""


def make_method(name: str, loaded: LoadedPolicy, hlp: HighLevelConfig) -> Method:
    """Make one of `METHODS`.

    Args:
        name: its name.
        loaded: networks trained for its task.
        hlp: settings of the high-level policy.
    """
    config = copy.deepcopy(loaded.config.env)
    config.curriculum.enabled = False
    if isinstance(config, FootstepConfig) and name != "llp-random":
        config.targets.max_step = config.targets.max_shift = 0.0  # until a high-level policy chooses, and after
    networks = loaded.networks
    choose = HighLevelPolicy(networks.value(), hlp) if name == "hlp" else None
    return Method(METHODS[name].task, config, lambda td: mean_action(networks, td), choose)


@torch.no_grad()
def mean_action(networks: ActorCritic, tensordict: TensorDictBase) -> Tensor:
    """The deterministic action [N, A], each world's product by itself.

    A world's action then does not depend, to the last bit, on which worlds share its batch (of two or more); with contacts, a
    last bit decides where a robot is ten seconds later.
    """
    hidden = networks.normalizer.module(*(tensordict[key] for key in networks.observations))[:, None]
    for layer in networks.actor[0].module.mlp.children():
        if isinstance(layer, nn.Linear):
            hidden = torch.bmm(hidden, layer.weight.T.expand(len(hidden), -1, -1)) + layer.bias
        else:
            hidden = layer(hidden)
    return hidden[:, 0]
