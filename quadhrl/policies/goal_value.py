"""The value of candidate goals: what the high-level policy's searches ask of a value function.

A candidate goal is the sum of what the next pair's targets and what the following pair's targets contribute to it. `embed`
turns each pair's targets into such a contribution, and `value` turns their sum into the value. For any value function the
contributions are the goal's own numbers; for the paper's critic they are those of its first layer, which is linear, so a grid
of 625 x 625 candidates costs 25 + 25 + 25 + 25 rows of it.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from quadhrl.policies.actor_critic import Denormalize
from quadhrl.policies.normalization import ObservationNormalizer

__all__ = ["ELU_SCALE", "LOG2_E", "FactoredValue", "GoalValue", "ModuleValue", "goal_value"]


class GoalValue(ABC):
    """Values of candidate goals in the N worlds that it was built for."""

    @abstractmethod
    def embed(self, vector: Tensor, columns: Tensor) -> Tensor:
        """What targets contribute to the goal.

        Args:
            vector: a pair's targets as seen from its feet [N, M, 2, 2], m.
            columns: the goal entries that they stand in [N, 4].

        Returns:
            [N, M, D].
        """

    @abstractmethod
    def value(self, embedding: Tensor) -> Tensor:
        """Values [N, K] of the sums [N, K, D] of a next and a following pair's contributions, which may be overwritten."""

    @abstractmethod
    def __getitem__(self, worlds: slice | Tensor) -> GoalValue:
        """The same in some of the worlds."""


class ModuleValue(GoalValue):
    """Any TensorDict module that reads ``goal`` and writes ``state_value``.

    Args:
        module: the value function.
        observation: its inputs, [N]; the goal's entries that candidates set are ignored.
        chosen: the goal's entries that candidates set [N, 12], bool.
    """

    def __init__(self, module: TensorDictModuleBase, observation: TensorDictBase, chosen: Tensor) -> None:
        self.module, self._chosen = module, chosen
        keys = [key for key in module.in_keys if key != "goal"]
        self._observation = observation.select(*keys)
        self._fixed = observation["goal"].masked_fill(chosen, 0.0)
        self._goal = observation["goal"]

    def embed(self, vector: Tensor, columns: Tensor) -> Tensor:
        """The goal's own entries, zero elsewhere, [N, M, 12]."""
        flat = vector.flatten(2)
        zeros = flat.new_zeros(*flat.shape[:2], self._fixed.shape[-1])
        return zeros.scatter(2, columns[:, None].expand(-1, flat.shape[1], -1), flat)

    def value(self, embedding: Tensor) -> Tensor:
        """The module's values of the goals [N, K, 12], every world's observation repeated K times."""
        goal = embedding + self._fixed[:, None]
        batch = self._observation[:, None].expand(goal.shape[:2]).reshape(-1)
        batch["goal"] = goal.flatten(0, 1)
        return self.module(batch)["state_value"].view(goal.shape[:2])

    def __getitem__(self, worlds: slice | Tensor) -> ModuleValue:
        observation = self._observation[worlds].set("goal", self._goal[worlds])
        return ModuleValue(self.module, observation, self._chosen[worlds])


class FactoredValue(GoalValue):
    """The paper's critic, cut after the linear part of its first layer.

    Layers work in units in which ELU is a maximum and a power of two, which PyTorch computes twice as fast: the sum x of a neuron
    stands as ``LOG2_E * (x + 1)``, its output as ``LOG2_E * (elu(x) + 1)``; see `elu`. Weights and biases take care of the rest.

    All products are batched over worlds, so that a world's values do not depend, to the last bit, on which worlds share
    its batch (of two or more).
    """

    def __init__(self, base: Tensor, first: _FirstLayer, rest: list[tuple[Tensor, Tensor]], scale: tuple) -> None:
        self._base, self._first, self.rest, self.scale = base, first, rest, scale

    @classmethod
    def build(cls, module: TensorDictModuleBase, observation: TensorDictBase, chosen: Tensor) -> FactoredValue | None:
        """The value function cut in two, or None where it is not normaliser, ELU network and value statistics."""
        try:
            normalizer, critic, denormalize = (part.module for part in module)  # type: ignore[union-attr]
        except (AttributeError, TypeError, ValueError):
            return None
        kinds = (ObservationNormalizer, nn.Sequential, Denormalize)
        if not all(isinstance(part, kind) for part, kind in zip((normalizer, critic, denormalize), kinds, strict=True)):
            return None
        linear, activations = list(critic)[::2], list(critic)[1::2]
        plain = all(isinstance(a, nn.ELU) and a.alpha == 1.0 for a in activations)
        if len(linear) < 2 or not plain or not all(isinstance(layer, nn.Linear) for layer in linear):
            return None
        keys = list(module.in_keys)
        start = sum(observation[key].shape[-1] for key in keys[: keys.index("goal")])
        statistics = normalizer.statistics
        goal = slice(start, start + chosen.shape[-1])
        first = _FirstLayer(
            mean=statistics.mean[goal],
            inverse_std=1.0 / statistics.std[goal],
            gain=normalizer.gain[goal],
            clip=normalizer.CLIP,
            weight=LOG2_E * linear[0].weight[:, goal].T,
        )
        features = normalizer(*(observation[key] for key in keys))
        features[:, goal] = features[:, goal].masked_fill(chosen, 0.0)
        base = torch.bmm(features[:, None], _batched(linear[0].weight.T, len(features)))[:, 0] + linear[0].bias
        base = LOG2_E * (base + 1.0)
        hidden, last = linear[1:-1], linear[-1]
        rest = [(layer.weight.T, LOG2_E * (layer.bias - layer.weight.sum(1) + 1.0)) for layer in hidden]
        rest.append((last.weight.T / LOG2_E, last.bias - last.weight.sum(1)))
        return cls(base, first, rest, (denormalize.statistics.std, denormalize.statistics.mean))

    def embed(self, vector: Tensor, columns: Tensor) -> Tensor:
        """First-layer sums of the targets' entries [N, M, H]; half of the rest of the observation's is in each pair's."""
        sums = self._base[:, None] * 0.5
        for number, weights in self._first(vector, columns):
            sums = sums + number[..., None] * weights[:, None]
        return sums

    def value(self, embedding: Tensor) -> Tensor:
        """The rest of the critic on first-layer sums [N, K, H], which are overwritten where no gradient is asked for."""
        n, hidden = len(embedding), elu(embedding)
        for weight, bias in self.rest[:-1]:
            hidden = elu(torch.bmm(hidden, _batched(weight, n)).add_(bias))
        weight, bias = self.rest[-1]
        value = torch.bmm(hidden, _batched(weight, n))[..., 0] + bias
        return value * self.scale[0] + self.scale[1]

    def __getitem__(self, worlds: slice | Tensor) -> FactoredValue:
        return FactoredValue(self._base[worlds], self._first, self.rest, self.scale)


class _FirstLayer:
    """The goal's part of the critic's normaliser and first layer."""

    def __init__(self, mean: Tensor, inverse_std: Tensor, gain: Tensor, clip: float, weight: Tensor) -> None:
        self._mean, self._inverse_std, self._gain, self._clip, self._weight = mean, inverse_std, gain, clip, weight

    def __call__(self, vector: Tensor, columns: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Each of the four numbers, normalised [N, M], and its weights [N, H]."""
        terms = []
        for number, column in zip(vector.flatten(2).unbind(-1), columns.unbind(-1), strict=True):
            mean, inverse, gain = (x[column][:, None] for x in (self._mean, self._inverse_std, self._gain))
            normalised = ((number - mean) * inverse).clamp(-self._clip, self._clip) * gain
            terms.append((normalised, self._weight[column]))
        return terms


def goal_value(module: TensorDictModuleBase, observation: TensorDictBase, chosen: Tensor) -> GoalValue:
    """Values of candidate goals, the fast way where the value function allows it.

    Args:
        module: the value function: reads ``goal`` [N, 12] and other observations, writes ``state_value`` [N, 1].
        observation: its inputs, [N].
        chosen: the goal's entries that candidates set [N, 12], bool.
    """
    return FactoredValue.build(module, observation, chosen) or ModuleValue(module, observation, chosen)


def elu(x: Tensor) -> Tensor:
    """``LOG2_E * (ELU + 1)`` of a sum given as ``LOG2_E * (sum + 1)``, in its place where no gradient is asked for.

    An exponential is nowhere below its tangent: ELU + 1 is the larger of sum + 1 and exp(min(sum, 0)).
    """
    negative = x.clamp(max=LOG2_E)
    if torch.is_grad_enabled():
        return torch.maximum(x, ELU_SCALE * negative.exp2())
    return torch.maximum(x, negative.exp2_().mul_(ELU_SCALE), out=x)


LOG2_E = math.log2(math.e)
ELU_SCALE = LOG2_E / math.e
"""What ``exp2(LOG2_E * (x + 1))`` lacks to be ``LOG2_E * exp(x)``."""


def _batched(matrix: Tensor, n: int) -> Tensor:
    return matrix.expand(n, *matrix.shape)
