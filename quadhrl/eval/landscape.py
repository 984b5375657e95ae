"""The paper's figure 2: the high-level policy's objective over a slice of its goals, with the search's points and the ascent."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import torch
from tensordict import TensorDictBase
from torch import Tensor

from quadhrl.envs import FootstepEnv
from quadhrl.eval.methods import Method
from quadhrl.eval.terrains import TestTerrain
from quadhrl.policies import HighLevelPolicy
from quadhrl.policies.high_level import GridProblem

__all__ = ["draw_landscape"]

TERRAIN = TestTerrain(0.9, 0.05)
"""Where the figure's robot walks."""
STEPS = 150
"""Control steps after which the figure is taken."""
WORLDS = 16
"""Robots of which the one with the most telling ground before it is shown."""


@torch.no_grad()
def draw_landscape(method: Method, path: Path, *, seed: int = 0, points: int = 61) -> Path:
    """Draw the objective over where one foot of the next pair steps, its other seven numbers at their best.

    Args:
        method: the method "hlp".
        path: picture to write.
        seed: seed of the terrains.
        points: samples along each axis.
    """
    policy = method.choose
    assert policy is not None
    env = FootstepEnv(method.env_config, WORLDS, seed=seed)
    numbers = torch.arange(WORLDS)
    env.terrain.assign(numbers, torch.full((WORLDS,), TERRAIN.infill), torch.full((WORLDS,), TERRAIN.height_range))
    env.set_seed(seed)
    td = env.reset()
    for _ in range(STEPS):
        td["goal"] = policy(td.clone(recurse=False))["goal"]
        td["action"] = method.act(td)
        td = env.step(td)["next"]
    world, foot = _telling(env, policy, td)
    # Two worlds, the smallest batch whose products round as in a rollout; the picture needs only one.
    problem = GridProblem(policy, td[[world, world]])
    start = problem.search()
    way = torch.stack([point[0, 0, foot] for point, _ in problem.ascent(start)])
    best, _ = problem.ascend(start)
    centre, half = problem.centre[0, 0, foot], policy.half_width[0]
    span = 1.25 * half.max()
    x, y = (torch.linspace(float(c - span), float(c + span), points) for c in centre)
    grid = torch.cartesian_prod(x, y)
    targets = best[:1].expand(len(grid), -1, -1, -1).clone()
    targets[:, 0, foot] = grid
    slice_problem = GridProblem(policy, td[torch.full((len(grid),), world)])
    objective = slice_problem.objective(targets).view(points, points)
    return _draw(path, (x, y), objective, env, world, centre, half, policy.offsets(False)[:, foot], way)


def _telling(env: FootstepEnv, policy: HighLevelPolicy, td: TensorDictBase) -> tuple[int, int]:
    """The world and the foot of its next pair with a third of gaps around its box, if possible with room to ascend."""
    problem = GridProblem(policy, td)
    way = problem.ascent(problem.search())
    moved = (way[-1][0] - way[0][0])[:, 0].norm(dim=-1)  # [N, 2], m
    side = torch.linspace(-0.19, 0.19, 20)
    around = problem.centre[:, 0, :, None] + torch.cartesian_prod(side, side)  # [N, 2, 400, 2]
    gaps = env.terrain.over_gap(around).float().mean(-1)
    gaps[env.step_count < STEPS] = 9.0  # robots that have fallen and begun anew
    k = int(((gaps - 1.0 / 3.0).abs() - 10.0 * moved).argmin())
    return k // 2, k % 2


def _draw(
    path: Path,
    axes: tuple[Tensor, Tensor],
    objective: Tensor,
    env: FootstepEnv,
    world: int,
    centre: Tensor,
    half: Tensor,
    offsets: Tensor,
    way: Tensor,
) -> Path:
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.patches import Rectangle

    figure, axis = plt.subplots(figsize=(6.6, 5.6), constrained_layout=True)
    x, y = axes
    filled = axis.contourf(x, y, objective.T, levels=24, cmap="viridis")
    figure.colorbar(filled, label="objective: value + directional term")
    size = env.terrain.config.block_size
    low, high = ((torch.stack([a[k] for a in axes]) / size).floor().long() for k in (0, -1))
    index = torch.tensor([world])
    for i in range(int(low[0]), int(high[0]) + 1):
        for j in range(int(low[1]), int(high[1]) + 1):
            gap = env.terrain.over_gap((torch.tensor([[[i, j]]]) + 0.5) * size, index).item()
            style = {"facecolor": (0, 0, 0, 0.35), "hatch": "xx"} if gap else {"facecolor": "none"}
            axis.add_patch(Rectangle((i * size, j * size), size, size, edgecolor="white", linewidth=0.8, **style))
    grid = (centre + offsets).unique(dim=0)
    axis.plot(grid[:, 0], grid[:, 1], "o", color="white", markersize=4, markeredgecolor="black", label="grid points")
    corner = (centre - half).tolist()
    axis.add_patch(Rectangle(corner, *(2 * half).tolist(), fill=False, edgecolor="white", linestyle="--"))
    axis.plot(way[:, 0], way[:, 1], "-o", color="red", markersize=3, label="gradient ascent")
    axis.plot(*centre, "P", color="orange", markersize=9, markeredgecolor="black", label="last target of this foot")
    axis.set(xlim=(x[0], x[-1]), ylim=(y[0], y[-1]), xlabel="x in the world [m]", ylabel="y in the world [m]")
    axis.set_aspect("equal")
    axis.legend(loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=3, frameon=False, fontsize="small")
    axis.set_title("One foot's next target (hatched: gaps; lines: block edges)", fontsize="medium")
    for suffix in (".png", ".svg"):
        figure.savefig(path.with_suffix(suffix), dpi=130)
    plt.close(figure)
    return path
