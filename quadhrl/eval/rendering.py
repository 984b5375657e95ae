"""Pictures of one world. Works headless."""

from __future__ import annotations

import math
import os

import mujoco
import numpy as np

from quadhrl.envs import LocomotionEnv
from quadhrl.errors import InputError
from quadhrl.eval.world_view import Disc, WorldView

__all__ = ["WorldRenderer"]

LAG = 0.3
"""The camera follows the robot by this much time [s], so that its steps do not shake the picture."""


class WorldRenderer:
    """Renders one world of an environment from a camera that follows its robot.

    Args:
        env: the environment.
        world: index of the world.
        width: picture width [px].
        height: picture height [px].

    Raises:
        InputError: no headless OpenGL can be had.
    """

    def __init__(self, env: LocomotionEnv, world: int = 0, *, width: int = 960, height: int = 540) -> None:
        self.view = WorldView(env, world)
        visual = self.view.model.vis
        visual.global_.offwidth, visual.global_.offheight = width, height
        visual.headlight.ambient[:], visual.headlight.diffuse[:] = 0.5, 0.4
        visual.quality.shadowsize = 4096
        try:
            self._renderer = mujoco.Renderer(self.view.model, height, width)
        except Exception as error:  # the backends raise errors of many kinds
            remedy = "no OpenGL there; install Mesa's EGL (Debian: libegl1 libegl-mesa0) or set MUJOCO_GL=osmesa"
            raise InputError("MUJOCO_GL", os.environ.get("MUJOCO_GL", ""), remedy) from error
        self._options = mujoco.MjvOption()
        self._options.geomgroup[:] = [1, 1, 1, 0, 0, 0]  # group 3: collision shapes, which would hide the visual ones
        self._camera = mujoco.MjvCamera()
        self._camera.distance, self._camera.azimuth, self._camera.elevation = 1.9, 125.0, -22.0
        self._env, self._world = env, world
        self._look_at = np.zeros(3)
        self._step = -1  # of the last frame

    def frame(self) -> np.ndarray:
        """The present state as a picture, [height, width, 3] uint8."""
        self.view.update()
        base = np.array([*self.view.data.qpos[:2], 0.2])
        step = int(self._env.step_count[self._world])
        new = self._step < 0 or step < self._step  # the first episode, or the next one
        elapsed = (step - self._step) * self._env.config.physics.control_dt
        kept = 0.0 if new else math.exp(-elapsed / LAG)
        self._look_at, self._step = kept * self._look_at + (1.0 - kept) * base, step
        self._camera.lookat[:] = self._look_at
        self._renderer.update_scene(self.view.data, self._camera, self._options)
        for disc in self.view.discs():
            self._draw(disc)
        return self._renderer.render()

    def close(self) -> None:
        """Free the OpenGL context."""
        self._renderer.close()

    def _draw(self, disc: Disc) -> None:
        scene = self._renderer.scene
        if scene.ngeom >= scene.maxgeom:
            return
        mujoco.mjv_initGeom(
            scene.geoms[scene.ngeom],
            mujoco.mjtGeom.mjGEOM_CYLINDER,
            np.array([self.view.disc_radius, 0.003, 0.0]),
            disc.position.astype(np.float64),
            np.eye(3).flatten(),
            np.array(disc.rgba, dtype=np.float32),
        )
        scene.ngeom += 1
