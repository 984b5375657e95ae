"""What there is to see of one world: robot, terrain and footstep targets, for the film and for the web viewer."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
import torch

from quadhrl.envs import FootstepEnv, LocomotionEnv
from quadhrl.robots import get_robot
from quadhrl.sim import build_scene

__all__ = ["Disc", "WorldView"]


class Disc(NamedTuple):
    """A footstep target on the ground."""

    position: np.ndarray
    """Centre [m], [3]."""
    rgba: tuple[float, float, float, float]
    """Red: next target of an active foot; blue: current one of a stance foot; yellow: following one of a stance foot."""


_ACTIVE, _STANCE, _FOLLOWING = (0.95, 0.30, 0.08, 0.9), (0.10, 0.55, 0.90, 0.75), (0.95, 0.75, 0.10, 0.45)


class WorldView:
    """A MuJoCo model and data with visual shapes that follow one world of an environment.

    Args:
        env: the environment.
        world: index of the world.
    """

    WINDOW = 30
    """Blocks along each side of the terrain that is shown."""

    def __init__(self, env: LocomotionEnv, world: int) -> None:
        self.env, self.world = env, world
        self.scene = build_scene(
            get_robot(env.config.robot), env.config.terrain, env.config.physics, window=self.WINDOW, visuals=True
        )
        self.model = self.scene.model
        self.data = mujoco.MjData(self.model)
        self.disc_radius = env.config.rewards.hit_radius if isinstance(env, FootstepEnv) else 0.0
        """Radius within which a foot hits its target [m]."""

    def update(self) -> None:
        """Take over the world's present state."""
        self.data.qpos[:] = self.env.sim.qpos[self.world].double().cpu().numpy()
        self._lay_blocks()
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)

    def discs(self) -> list[Disc]:
        """The present footstep targets, on the ground; none in a task without targets."""
        if not isinstance(self.env, FootstepEnv):
            return []
        targets = self.env.targets
        on = targets.active[self.world].tolist()
        colours = [_ACTIVE if active else _STANCE for active in on] + [_FOLLOWING] * 2
        xy = torch.cat([targets.position[self.world], targets.following[self.world]])
        world = torch.tensor([self.world], device=xy.device)
        heights = self.env.terrain.heights(xy[None], world)[0].clamp(min=-0.05) + 0.004  # over a gap just below its rim
        positions = torch.cat([xy, heights[:, None]], -1).cpu().numpy()
        return [Disc(position, rgba) for position, rgba in zip(positions, colours, strict=True)]

    def _lay_blocks(self) -> None:
        terrain, model, ids = self.env.terrain, self.model, self.scene.blocks
        size = terrain.config.block_size
        blocks = np.rint(self.data.qpos[:2] / size).astype(int) + self.scene.block_offset
        world = torch.tensor([self.world], device=terrain.device)
        tops = terrain.block_heights(torch.as_tensor(blocks, device=terrain.device)[None], world)[0].cpu().numpy()
        gap = tops < -0.5 * terrain.config.gap_depth
        # A black floor a little below the rims: seen from the side, a deep hole shows only its walls.
        shown = np.where(gap, -0.04, tops)
        model.geom_pos[ids] = np.column_stack([(blocks + 0.5) * size, shown - terrain.config.gap_depth / 2])
        model.geom_size[ids, :2] = size / 2  # without the simulators' overlap, whose level faces would flicker
        shade = 0.05 * ((blocks.sum(1) % 2) - 0.5) + 1.2 * np.clip(tops, -0.1, 0.1)
        level = np.clip(np.array([0.78, 0.75, 0.69]) + shade[:, None], 0, 1)
        model.geom_rgba[ids, :3] = np.where(gap[:, None], 0.03, level)
