"""The high-level policy: footstep targets that maximise the low-level policy's value (paper, section III, algorithm 1)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from quadhrl.errors import InputError, check_range
from quadhrl.policies.goal_search import SEARCHES, PairCandidates
from quadhrl.policies.goal_value import GoalValue, ModuleValue, goal_value
from quadhrl.policies.objective import Direction, ObjectiveTerm, PairTargets
from quadhrl.rotations import rotate_yaw

__all__ = ["GridProblem", "HighLevelConfig", "HighLevelPolicy"]


@dataclass
class HighLevelConfig:
    """Settings of the high-level policy; the defaults are the paper's, and its authors' where the paper is silent."""

    resolution: int = 5
    """Grid points per axis, R."""
    half_width: float = 0.15
    """Half width of the box around a foot's last target, B [m]."""
    lateral_ratio: float = 0.33
    """Half width of the box in y, relative to x."""
    following_ratio: float = 2.0
    """Size of the following pair's box, relative to the next pair's."""
    pairs: str = "both"
    """What is chosen: both (8 numbers) or active (4: the next pair; the following targets stay where the feet stand)."""
    direction_weight: float = 50.0
    """Weight of the directional term, kappa_HD [1/m]."""
    following_weight: float = 2.0
    """Factor on the following pair's directional term."""
    heading: float = 0.0
    """Direction of travel in the world, alpha; 0 is along x [rad]."""
    ascent_rate: float = 1e-4
    """Step size of the gradient ascent, eta [m^2]."""
    ascent_steps: int = 5
    """Steps of the gradient ascent, N."""
    confine: bool = True
    """Whether the gradient ascent stays in the box; without, a target can leave it by some centimetres."""
    search: str = "alternating"
    """Grid search: alternating, exact or naive; see quadhrl.policies.goal_search."""
    start_step: int = 60
    """Control step of an episode from which on targets are chosen."""
    start_pair: int = 2
    """Pair from which on targets are chosen."""

    def validate(self) -> None:
        """Check every field.

        Raises:
            InputError: a field is out of its range.
        """
        check_range(self, "hlp", "resolution", 1, 9)
        check_range(self, "hlp", "half_width", 0, 1, "m")
        check_range(self, "hlp", "lateral_ratio following_ratio ascent_rate", 0)
        check_range(self, "hlp", "ascent_steps start_step start_pair", 0)
        if self.pairs not in ("both", "active"):
            raise InputError("--hlp.pairs", self.pairs, "choose both or active")
        if self.search not in SEARCHES:
            raise InputError("--hlp.search", self.search, f"choose one of: {', '.join(SEARCHES)}")


class HighLevelPolicy(TensorDictModuleBase):
    """Sets ``goal`` [N, 12] so that value and directional term are largest; ``TensorDictSequential(hlp, actor)`` walks.

    Reads the value function's inputs and, in the world's frame, what `FootstepEnv` observes beside them. Writes also
    ``targets`` [N, 2, 2, 2] (m): the next pair's and the following pair's targets in the world, front foot first, and
    ``objective`` [N, 1]. Until its first step and pair (`HighLevelConfig`), it leaves the goal as it is.

    The box of a foot is centred on the target that the foot hit last, in the world, not on the foot: targets must not run
    away from a foot that follows them. It keeps the result of the gradient ascent only where that is better than the grid's.

    Args:
        value: the low-level policy's value function: a TensorDict module from observations with ``goal`` to ``state_value``.
        config: the settings.
        terms: further terms of the objective.
    """

    half_width: Tensor
    """Half widths of the boxes of the next and of the following pair's feet in x and y [2, 2], m."""
    pairs: Tensor
    """Feet of even and of odd pairs, front foot first [2, 2]."""
    IN_WORLD = ("yaw", "feet", "footholds", "pair", ("events", "step_count"))
    """What it reads beside the value function's inputs."""

    def __init__(
        self,
        value: TensorDictModuleBase,
        config: HighLevelConfig | None = None,
        terms: Iterable[ObjectiveTerm] = (),
    ) -> None:
        super().__init__()
        self.config = config or HighLevelConfig()
        self.config.validate()
        self.value = value
        self.direction = Direction(self.config.direction_weight, self.config.following_weight, self.config.heading)
        """The directional term; its ``heading`` can be set at any time, a number or one per world [N]."""
        self.terms = nn.ModuleList([self.direction, *terms])
        self.in_keys = [*value.in_keys, *self.IN_WORLD]
        self.out_keys = ["goal", "targets", "objective"]
        half_width = torch.tensor([1.0, self.config.lateral_ratio]) * self.config.half_width
        following = self.config.following_ratio if self.config.pairs == "both" else 0.0
        self.register_buffer("half_width", torch.stack([half_width, following * half_width]))
        self.register_buffer("pairs", torch.tensor([[0, 3], [1, 2]]))
        self.to(next((parameter.device for parameter in value.parameters()), torch.device("cpu")))

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Choose targets in every world; see the class."""
        flat = tensordict.select(*self.in_keys).reshape(-1)
        parts = torch.arange(len(flat)).tensor_split(
            -(-len(flat) // WORLDS_AT_ONCE)
        )  # of equal sizes, so never of one world
        chosen = [self._choose(flat, slice(int(part[0]), int(part[-1]) + 1)) for part in parts]
        for key, values in zip(self.out_keys, zip(*chosen, strict=True), strict=True):
            tensordict[key] = torch.cat(values).unflatten(0, tensordict.batch_size)
        return tensordict

    def _choose(self, tensordict: TensorDictBase, worlds: slice) -> tuple[Tensor, Tensor, Tensor]:
        """What `forward` writes, for some of the worlds."""
        problem = GridProblem(self, tensordict[worlds], worlds)
        steps: Tensor = tensordict["events", "step_count"][worlds]
        started = (tensordict["pair"][worlds] >= self.config.start_pair) & (steps >= self.config.start_step)
        goal, targets = tensordict["goal"][worlds], problem.observed_targets
        objective = problem.objective(targets).detach()
        if started.any():
            chosen, its_objective = problem.ascend(problem.search())
            goal = torch.where(started, problem.goal(chosen), goal)
            targets = torch.where(started[..., None, None], chosen, targets)
            objective = torch.where(started[:, 0], its_objective, objective)
        return goal, targets, objective[:, None]

    def offsets(self, following: bool) -> Tensor:
        """One pair's grid: displacements of its feet from their last targets [M, 2, 2], m; M = R^4 (1 where it is fixed)."""
        points = torch.linspace(-1.0, 1.0, self.config.resolution, device=self.half_width.device)
        if self.config.resolution == 1 or not self.half_width[int(following)].any():
            points = points.new_zeros(1)
        return torch.cartesian_prod(points, points, points, points).view(-1, 2, 2) * self.half_width[int(following)]


WORLDS_AT_ONCE = 64
"""At most this many worlds are searched together: 40 MB of candidates with the paper's grid and critic."""


class GridProblem:
    """The optimisation problem of eq. 13 in every world. Targets are [N, 2, 2, 2]: next and following pair, foot, xy.

    Args:
        policy: the policy that it is solved for.
        tensordict: the policy's inputs in these worlds, [N].
        worlds: which of the policy's worlds they are.
    """

    def __init__(self, policy: HighLevelPolicy, tensordict: TensorDictBase, worlds: slice = slice(None)) -> None:
        self._policy, self._worlds, self._goal = policy, worlds, tensordict["goal"]
        parity = tensordict["pair"][:, 0] % 2
        feet = policy.pairs[torch.stack([parity, 1 - parity], 1)]  # [N, 2, 2]
        index = feet.flatten(1)[..., None].expand(-1, -1, 2)
        self._feet, self.centre = (tensordict[key].gather(1, index).view(-1, 2, 2, 2) for key in ("feet", "footholds"))
        """``centre``: the middle of each foot's box, the target that it hit last, m."""
        self._yaw = tensordict["yaw"][:, 0]
        xy = torch.arange(2, device=feet.device)
        following = torch.arange(8, 12, device=feet.device).expand(len(feet), -1)
        self._entries = torch.stack([(2 * feet[:, 0, :, None] + xy).flatten(1), following], 1)
        """Where the pairs' targets stand in the goal [N, 2, 4]."""
        chosen = torch.zeros_like(self._goal, dtype=torch.bool).scatter(1, self._entries.flatten(1), True)
        build = ModuleValue if policy.config.search == "naive" else goal_value
        self._value: GoalValue = build(policy.value, tensordict, chosen)

    @property
    def observed_targets(self) -> Tensor:
        """The targets that the observed goal stands for, m."""
        vectors = self._goal.gather(1, self._entries.flatten(1)).view(-1, 2, 2, 2)
        yaw = self._yaw[:, None, None]
        return self._feet + rotate_yaw(vectors, torch.cos(yaw), torch.sin(yaw))

    def goal(self, targets: Tensor) -> Tensor:
        """The goal with the targets in it [N, 12]."""
        vectors = torch.stack([self._see(targets[:, None, k], k).vector[:, 0] for k in (0, 1)], 1)
        return self._goal.scatter(1, self._entries.flatten(1), vectors.flatten(1))

    @torch.no_grad()
    def search(self) -> Tensor:
        """The grid's best targets."""
        grids = [self.centre[:, None, k] + self._policy.offsets(bool(k)) for k in (0, 1)]
        best = SEARCHES[self._policy.config.search](self._value, *(self._candidates(grids[k], k) for k in (0, 1)))
        worlds = torch.arange(len(self._goal), device=self._goal.device)
        return torch.stack([grid[worlds, k] for grid, k in zip(grids, best, strict=True)], 1)

    def ascent(self, targets: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Gradient ascent from ``targets``, in each world by itself: the points on its way and their objectives [N]."""
        config, half_width = self._policy.config, self._policy.half_width[:, None]
        low, high = self.centre - half_width, self.centre + half_width
        points = []
        for _ in range(config.ascent_steps + 1):
            with torch.enable_grad():
                variable = targets.detach().requires_grad_()
                objective = self.objective(variable)
                (gradient,) = torch.autograd.grad(objective.sum(), variable)
            points.append((targets, objective.detach()))
            targets = targets + config.ascent_rate * gradient * (half_width > 0.0)
            if config.confine:
                targets = targets.clamp(low, high)
        return points

    def ascend(self, targets: Tensor) -> tuple[Tensor, Tensor]:
        """The best point of the `ascent` from ``targets`` and its objective [N]: never worse than where it began."""
        best, best_objective = targets, torch.full_like(self._yaw, -torch.inf)
        for point, objective in self.ascent(targets):
            better = objective > best_objective
            best = torch.where(better[:, None, None, None], point, best)
            best_objective = torch.maximum(objective, best_objective)
        return best, best_objective

    def objective(self, targets: Tensor) -> Tensor:
        """Eq. 12: value plus the other terms [N], differentiable in the targets."""
        first, second = (self._candidates(targets[:, None, k], k) for k in (0, 1))
        return (self._value.value(first.embedding + second.embedding) + first.score + second.score)[:, 0]

    def _candidates(self, position: Tensor, pair: int) -> PairCandidates:
        targets = self._see(position, pair)
        embedding = self._value.embed(targets.vector, self._entries[:, pair])
        return PairCandidates(
            embedding, sum((term(targets) for term in self._policy.terms), start=0.0 * self._yaw[:, None])
        )

    def _see(self, position: Tensor, pair: int) -> PairTargets:
        """Targets of one pair [N, M, 2, 2], m, with what they look like from the robot."""
        yaw = self._yaw[:, None, None]
        vector = rotate_yaw(position - self._feet[:, None, pair], torch.cos(yaw), -torch.sin(yaw))
        return PairTargets(position, vector, self._yaw, self._worlds, following=bool(pair))
