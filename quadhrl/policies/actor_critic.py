"""The paper's actor and critic: separate MLPs with two hidden layers of 128 (section II-A), normaliser inside."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.modules import MLP, IndependentNormal, ProbabilisticActor, ValueOperator

from quadhrl.errors import check_range
from quadhrl.policies.normalization import ObservationNormalizer, RunningStatistics

__all__ = ["ActorCritic", "Denormalize", "NetworkConfig"]


@dataclass
class NetworkConfig:
    """Sizes and initial values of actor and critic."""

    hidden_size: int = 128
    """Units in each hidden layer."""
    hidden_layers: int = 2
    """Number of hidden layers."""
    goal_gain: float = 2.0
    """Factor on the normalised goal, which is 12 of 376 inputs and decides where the feet must go."""
    scan_gain: float = 0.12
    """Factor on the normalised terrain scan. On level ground a foot's 71 scan entries are 71 copies of its height; a
    factor of 1/sqrt(71) gives them together the weight of one input."""
    initial_std: float = 0.5
    """Initial standard deviation of every action."""
    initial_amplitude: float = -0.7
    """Initial mean of the step amplitude's action."""
    initial_height: float = 0.3
    """Initial mean of the standing height's action."""
    initial_frequency: float = 0.3
    """Initial mean of the frequency's action."""

    def validate(self) -> None:
        """Check every field.

        Raises:
            InputError: a field is out of its range.
        """
        check_range(self, "network", "hidden_size hidden_layers", 1)
        check_range(self, "network", "goal_gain scan_gain initial_std", 0, above=True)


class _Gaussian(nn.Module):
    """Mean from an MLP, standard deviation from a parameter that does not depend on the state."""

    def __init__(self, features: int, actions: int, config: NetworkConfig) -> None:
        super().__init__()
        self.mlp = _mlp(features, actions, config)
        self.log_std = nn.Parameter(torch.full((actions,), config.initial_std).log())
        last = self.mlp[-1]
        with torch.no_grad():
            last.weight.mul_(0.1)  # begin near the initial mean below, whatever the state
            last.bias.zero_()
            last.bias[:3] = torch.tensor([config.initial_amplitude, config.initial_height, config.initial_frequency])

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        loc = self.mlp(features)
        return loc, self.log_std.exp().expand_as(loc)


class Denormalize(nn.Module):
    """Value in reward units from the critic's normalised one.

    Args:
        statistics: mean and standard deviation of the values.
    """

    def __init__(self, statistics: RunningStatistics) -> None:
        super().__init__()
        self.statistics = statistics

    def forward(self, value: Tensor) -> Tensor:
        """Values [..., 1] in reward units."""
        return value * self.statistics.std + self.statistics.mean


class ActorCritic(nn.Module):
    """Actor, critic and their shared normaliser; `policy` and `value` compose them from observation keys.

    Args:
        observations: observation keys and their sizes, in the networks' input order.
        actions: number of actions.
        config: sizes and initial values.
    """

    def __init__(self, observations: dict[str, int], actions: int, config: NetworkConfig | None = None) -> None:
        super().__init__()
        config = config or NetworkConfig()
        config.validate()
        self.observations = dict(observations)
        features = sum(observations.values())
        gain = {"goal": config.goal_gain, "scan": config.scan_gain}
        gains = [gain.get(name, 1.0) for name in observations]
        self.normalizer = TensorDictModule(
            ObservationNormalizer(list(observations.values()), gains), in_keys=list(observations), out_keys=["features"]
        )
        self.actor = ProbabilisticActor(
            TensorDictModule(_Gaussian(features, actions, config), in_keys=["features"], out_keys=["loc", "scale"]),
            in_keys=["loc", "scale"],
            distribution_class=IndependentNormal,
            distribution_kwargs={"tanh_loc": False},
            return_log_prob=True,
        )
        """features -> action, with its log-probability."""
        self.critic = ValueOperator(_mlp(features, 1, config), in_keys=["features"], out_keys=["normalized_value"])
        """features -> value in units of `value_statistics`."""
        self.value_statistics = RunningStatistics(1, min_std=1e-3)

    def policy(self) -> TensorDictSequential:
        """Observations -> action [..., A]; follows TorchRL's exploration type (deterministic: the mean)."""
        return TensorDictSequential(self.normalizer, self.actor)

    def value(self) -> TensorDictSequential:
        """Observations -> ``state_value`` [..., 1], the expected discounted return in reward units; differentiable."""
        denormalize = TensorDictModule(Denormalize(self.value_statistics), ["normalized_value"], ["state_value"])
        return TensorDictSequential(self.normalizer, self.critic, denormalize)


def _mlp(inputs: int, outputs: int, config: NetworkConfig) -> MLP:
    sizes = [config.hidden_size] * config.hidden_layers
    return MLP(in_features=inputs, out_features=outputs, num_cells=sizes, activation_class=nn.ELU)
