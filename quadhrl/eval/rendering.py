"""Pictures of one world: robot, terrain, footstep targets. Works headless."""

from __future__ import annotations

import os

import mujoco
import numpy as np
import torch

from quadhrl.envs import FootstepEnv
from quadhrl.errors import InputError
from quadhrl.robots import get_robot
from quadhrl.sim import build_scene

__all__ = ["WorldRenderer"]

_ACTIVE, _STANCE, _FOLLOWING = (0.95, 0.35, 0.10, 0.9), (0.10, 0.55, 0.90, 0.75), (0.95, 0.75, 0.10, 0.45)


class WorldRenderer:
    """Renders one world of an environment from a camera that follows its robot.

    Next targets are red discs of the hit radius, targets to stay on blue, the stance pair's following targets yellow.

    Args:
        env: the environment.
        world: index of the world.
        width: picture width [px].
        height: picture height [px].

    Raises:
        InputError: no headless OpenGL can be had.
    """

    WINDOW = 30
    """Blocks along each side of the drawn terrain."""

    def __init__(self, env: FootstepEnv, world: int = 0, *, width: int = 960, height: int = 540) -> None:
        self.env, self.world = env, world
        robot = get_robot(env.config.robot)
        self.scene = build_scene(robot, env.config.terrain, env.config.physics, window=self.WINDOW, visuals=True)
        model = self.scene.model
        _decorate(model)
        self.data = mujoco.MjData(model)
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        model.vis.headlight.ambient[:], model.vis.headlight.diffuse[:] = 0.5, 0.4
        try:
            self._renderer = mujoco.Renderer(model, height, width)
        except Exception as error:  # the backends raise errors of many kinds
            remedy = "no OpenGL there; install Mesa's EGL (Debian: libegl1) or set MUJOCO_GL=osmesa"
            raise InputError("MUJOCO_GL", os.environ.get("MUJOCO_GL", ""), remedy) from error
        # The paint of collision shapes would hide the visual ones.
        self._options = mujoco.MjvOption()
        self._options.geomgroup[:] = [1, 1, 1, 0, 0, 0]
        self._camera = mujoco.MjvCamera()
        self._camera.distance, self._camera.azimuth, self._camera.elevation = 1.9, 125.0, -22.0
        self._look_at: np.ndarray | None = None

    def frame(self) -> np.ndarray:
        """The present state as a picture, [height, width, 3] uint8."""
        model, data = self.scene.model, self.data
        qpos = self.env.sim.qpos[self.world].double().cpu().numpy()
        data.qpos[:] = qpos
        self._lay_blocks(qpos[:2])
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        base = np.array([*qpos[:2], 0.2])
        self._look_at = base if self._look_at is None or np.linalg.norm(base - self._look_at) > 1 else self._look_at
        self._look_at = 0.92 * self._look_at + 0.08 * base
        self._camera.lookat[:] = self._look_at
        self._renderer.update_scene(data, self._camera, self._options)
        self._draw_targets()
        return self._renderer.render()

    def close(self) -> None:
        """Free the OpenGL context."""
        self._renderer.close()

    def _lay_blocks(self, centre: np.ndarray) -> None:
        terrain, model = self.env.terrain, self.scene.model
        size = terrain.config.block_size
        blocks = np.rint(centre / size).astype(int) + self.scene.block_offset
        world = torch.tensor([self.world], device=terrain.device)
        tops = terrain.block_heights(torch.as_tensor(blocks, device=terrain.device)[None], world)[0].cpu().numpy()
        position = model.geom_pos[self.scene.blocks]
        position[:, :2] = (blocks + 0.5) * size
        position[:, 2] = tops - terrain.config.gap_depth / 2
        model.geom_pos[self.scene.blocks] = position
        model.geom_size[self.scene.blocks, :2] = (
            size / 2
        )  # without the simulators' overlap, whose level faces would flicker
        shade = 0.05 * ((blocks.sum(1) % 2) - 0.5) + 1.2 * np.clip(tops, -0.1, 0.1)
        model.geom_rgba[self.scene.blocks, :3] = np.clip(np.array([0.78, 0.75, 0.69]) + shade[:, None], 0, 1)

    def _draw_targets(self) -> None:
        targets, radius = self.env.targets, self.env.config.rewards.hit_radius
        active = targets.active[self.world]
        spots = [(xy, _ACTIVE if on else _STANCE) for xy, on in zip(targets.position[self.world], active, strict=True)]
        spots += [(xy, _FOLLOWING) for xy in targets.following[self.world]]
        everyone = torch.stack([xy for xy, _ in spots])[None]
        world = torch.tensor([self.world], device=everyone.device)
        heights = self.env.terrain.heights(everyone, world)[0]
        for (xy, colour), height in zip(spots, heights.tolist(), strict=True):
            self._add_disc([*xy.tolist(), max(height, -0.05) + 0.004], radius, colour)

    def _add_disc(self, position: list[float], radius: float, rgba: tuple[float, ...]) -> None:
        scene = self._renderer.scene
        if scene.ngeom >= scene.maxgeom:
            return
        mujoco.mjv_initGeom(
            scene.geoms[scene.ngeom],
            mujoco.mjtGeom.mjGEOM_CYLINDER,
            np.array([radius, 0.003, 0.0]),
            np.array(position),
            np.eye(3).flatten(),
            np.array(rgba, dtype=np.float32),
        )
        scene.ngeom += 1


def _decorate(model: mujoco.MjModel) -> None:
    """Shadows and haze instead of a black void."""
    model.vis.map.fogstart, model.vis.map.fogend = 6.0, 12.0
    model.vis.quality.shadowsize = 4096
