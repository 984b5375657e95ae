"""One world in a browser, through viser (``pip install quadhrl[viewer]``)."""

from __future__ import annotations

import time
from typing import Any

import mujoco
import numpy as np

from quadhrl.envs import LocomotionEnv
from quadhrl.errors import InputError
from quadhrl.eval.world_view import WorldView

__all__ = ["WebViewer"]


class WebViewer:
    """Serves a page that shows one world of an environment as it runs.

    Args:
        env: the environment.
        world: index of the world.
        port: port of the web server; the next free one is taken if it is in use.

    Raises:
        InputError: the viewer extra is not installed.
    """

    def __init__(self, env: LocomotionEnv, world: int = 0, *, port: int = 8080) -> None:
        try:
            import viser
        except ImportError as error:
            raise InputError("--viewer", True, "viser is not installed; install quadhrl[viewer]") from error
        self.view = WorldView(env, world)
        self.server = viser.ViserServer(port=port, verbose=False)
        self._control_dt = env.config.physics.control_dt
        self._next_frame = time.monotonic()
        self.view.update()
        model = self.view.model
        visible = np.flatnonzero(model.geom_group < 3)  # group 3: collision shapes
        self._shapes = {int(geom): self._add_geom(int(geom)) for geom in visible}
        self._discs = [
            self.server.scene.add_cylinder(f"/targets/{k}", self.view.disc_radius, 0.006, opacity=0.8)
            for k in range(len(self.view.discs()))
        ]
        self.url = f"http://localhost:{self.server.get_port()}"
        """Where the page is."""

    def show(self) -> None:
        """Show the present state, at the speed of real time."""
        self._next_frame += self._control_dt
        time.sleep(max(0.0, self._next_frame - time.monotonic()))
        self.view.update()
        data, rotation = self.view.data, np.zeros(4)
        with self.server.atomic():
            for geom, handle in self._shapes.items():
                mujoco.mju_mat2Quat(rotation, data.geom_xmat[geom])
                handle.position, handle.wxyz = data.geom_xpos[geom].copy(), rotation.copy()
            for disc, handle in zip(self.view.discs(), self._discs, strict=True):
                handle.position, handle.color = disc.position, tuple(round(255 * c) for c in disc.rgba[:3])

    def close(self) -> None:
        """Stop serving."""
        self.server.stop()

    def _add_geom(self, geom: int) -> Any:
        model, scene, name = self.view.model, self.server.scene, f"/geoms/{geom}"
        material = model.geom_matid[geom]
        rgba = model.mat_rgba[material] if material >= 0 else model.geom_rgba[geom]
        colour = tuple(round(255 * float(c)) for c in rgba[:3])
        x, y, z = (float(s) for s in model.geom_size[geom])
        shape = mujoco.mjtGeom
        if model.geom_type[geom] == shape.mjGEOM_BOX:
            return scene.add_box(name, colour, (2 * x, 2 * y, 2 * z))
        if model.geom_type[geom] == shape.mjGEOM_SPHERE:
            return scene.add_icosphere(name, x, colour)
        return scene.add_cylinder(name, x, 2 * y, colour)  # cylinders, and capsules without their caps
