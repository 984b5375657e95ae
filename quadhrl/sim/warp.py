"""MuJoCo-Warp: all worlds in GPU kernels, one captured CUDA graph per control step; the same code runs on Warp's CPU."""

# pyright: reportOperatorIssue=false, reportGeneralTypeIssues=false
# (Warp compiles the kernels' arithmetic from the source; it is not Python's.)

from __future__ import annotations

import copy
import logging
from typing import Any

import mujoco
import mujoco_warp as mjw
import torch
import warp as wp
from torch import Tensor

from quadhrl.sim.scene import Scene
from quadhrl.sim.simulator import Simulator
from quadhrl.sim.terrain import BlockTerrain

__all__ = ["WarpSimulator"]

logger = logging.getLogger(__name__)

wp.config.log_level = wp.LOG_WARNING
wp.config.enable_backward = False  # nothing here is differentiated, and compiling takes half as long
wp.init()


@wp.kernel
def _read_contacts(
    nacon: wp.array(dtype=int),
    geom: wp.array(dtype=wp.vec2i),
    worldid: wp.array(dtype=int),
    wrench: wp.array(dtype=wp.spatial_vector),
    foot_of_geom: wp.array(dtype=int),
    link_of_geom: wp.array(dtype=int),
    foot_force: wp.array2d(dtype=wp.vec3),
    link_touched: wp.array2d(dtype=int),
):
    """Add each contact's force to the foot it acts on, and mark the links that touch anything."""
    contact = wp.tid()
    if contact >= nacon[0]:
        return
    world = worldid[contact]
    force = wp.spatial_top(wrench[contact])  # what the first geom exerts on the second
    for k in range(2):
        g = geom[contact][k]
        if foot_of_geom[g] >= 0:
            wp.atomic_add(foot_force, world, foot_of_geom[g], float(2 * k - 1) * force)
        if link_of_geom[g] >= 0:
            link_touched[world, link_of_geom[g]] = 1


@wp.kernel
def _read_feet(
    geom_xpos: wp.array2d(dtype=wp.vec3),
    subtree_com: wp.array2d(dtype=wp.vec3),
    cvel: wp.array2d(dtype=wp.spatial_vector),
    feet: wp.array(dtype=int),
    foot_body: wp.array(dtype=int),
    base: int,
    foot_position: wp.array2d(dtype=wp.vec3),
    foot_velocity: wp.array2d(dtype=wp.vec3),
):
    """Position and velocity of each foot's centre; `cvel` is taken about the robot's centre of mass."""
    world, foot = wp.tid()
    position = geom_xpos[world, feet[foot]]
    twist = cvel[world, foot_body[foot]]
    arm = position - subtree_com[world, base]
    foot_position[world, foot] = position
    foot_velocity[world, foot] = wp.spatial_bottom(twist) + wp.cross(wp.spatial_top(twist), arm)


class WarpSimulator(Simulator):
    """MuJoCo-Warp in float32.

    Args:
        scene: the compiled robot and terrain window.
        terrain: the terrains, on ``device``.
        device: a CUDA device, or the CPU (for tests and small numbers of worlds).
    """

    engine = "warp"

    def __init__(self, scene: Scene, terrain: BlockTerrain, device: torch.device) -> None:
        super().__init__(scene, terrain, device)
        self._home = self._home.float()
        model = copy.copy(scene.model)
        # The sensors serve the native engine; here the two kernels above read the same from the contacts.
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_SENSOR
        model.opt.disableflags &= ~int(
            mujoco.mjtDisableBit.mjDSBL_AUTORESET
        )  # unknown to MuJoCo-Warp, which never resets
        if device.type == "cpu":
            logger.info(
                "compiling MuJoCo-Warp for the CPU: the first run takes about a minute, later ones use the cache"
            )
        self._wp_device = wp.device_from_torch(device)
        with wp.ScopedDevice(self._wp_device):
            self.model = mjw.put_model(model, batch_sizes={"geom_size": self.num_worlds})
            self.model.opt.warn_overflow = False  # polled in _overflowed instead: printing floods and serialises
            physics = scene.physics
            self.data = mjw.make_data(model, self.num_worlds, nconmax=physics.nconmax, njmax=physics.njmax)
            self._allocate_readouts()
            self._advance_kernels()  # loads every module: lazy loading inside a capture would invalidate it
            self._graph = None
            if self._wp_device.is_cuda:
                with wp.ScopedCapture() as capture:
                    self._advance_kernels()
                self._graph = capture.graph
        self._pool_overflow_seen = False
        self.start()

    @property
    def qpos(self) -> Tensor:
        """Generalised positions [N, nq], float32 view."""
        return self._view["qpos"]

    @property
    def qvel(self) -> Tensor:
        """Generalised velocities [N, nv], float32 view."""
        return self._view["qvel"]

    def _allocate_readouts(self) -> None:
        scene, n = self.scene, self.num_worlds
        foot_of_geom = torch.full((scene.model.ngeom,), -1, dtype=torch.int32)
        foot_of_geom[torch.as_tensor(scene.feet)] = torch.arange(4, dtype=torch.int32)
        link_of_geom = torch.full((scene.model.ngeom,), -1, dtype=torch.int32)
        link_of_geom[torch.as_tensor(scene.link_geoms)] = torch.as_tensor(scene.link_of_geom, dtype=torch.int32)
        self._foot_of_geom = wp.array(foot_of_geom.numpy(), dtype=int)
        self._link_of_geom = wp.array(link_of_geom.numpy(), dtype=int)
        self._feet = wp.array(scene.feet, dtype=int)
        self._foot_body = wp.array(scene.model.geom_bodyid[scene.feet], dtype=int)
        self._contact_ids = wp.array(list(range(self.data.naconmax)), dtype=int)
        self._wrench = wp.zeros(self.data.naconmax, dtype=wp.spatial_vector)
        self._foot_force = wp.zeros((n, 4), dtype=wp.vec3)
        self._link_touched = wp.zeros((n, scene.num_links), dtype=int)
        self._foot_position = wp.zeros((n, 4), dtype=wp.vec3)
        self._foot_velocity = wp.zeros((n, 4), dtype=wp.vec3)
        shared: dict[str, Any] = {
            name: getattr(self.data, name)
            for name in ("qpos", "qvel", "ctrl", "qacc_warmstart", "time", "geom_xpos", "overflow", "actuator_force")
        }
        shared["geom_size"] = self.model.geom_size
        readouts = {
            "foot_force": self._foot_force,
            "link_touched": self._link_touched,
            "foot_position": self._foot_position,
            "foot_velocity": self._foot_velocity,
        }
        self._view = {name: wp.to_torch(array) for name, array in (shared | readouts).items()}
        self._blocks = torch.as_tensor(scene.blocks, device=self.device)

    def _advance_kernels(self) -> None:
        for _ in range(self.scene.physics.substeps):
            mjw.step(self.model, self.data)
        data = self.data
        mjw.contact_force(self.model, data, self._contact_ids, True, self._wrench)
        self._foot_force.zero_()
        self._link_touched.zero_()
        wp.launch(
            _read_contacts,
            dim=data.naconmax,
            inputs=[
                data.nacon, data.contact.geom, data.contact.worldid, self._wrench, self._foot_of_geom, self._link_of_geom,
            ],
            outputs=[self._foot_force, self._link_touched],
        )  # fmt: skip
        self._kinematics_kernels()

    def _kinematics_kernels(self) -> None:
        model, data = self.model, self.data
        mjw.kinematics(model, data)
        mjw.com_pos(model, data)
        mjw.com_vel(model, data)
        wp.launch(
            _read_feet,
            dim=(self.num_worlds, 4),
            inputs=[
                data.geom_xpos, data.subtree_com, data.cvel, self._feet, self._foot_body, self.scene.base_body,
            ],
            outputs=[self._foot_position, self._foot_velocity],
        )  # fmt: skip

    def _advance(self, joint_targets: Tensor) -> None:
        self._view["ctrl"].copy_(joint_targets)
        with wp.ScopedDevice(self._wp_device):
            if self._graph is not None:
                wp.capture_launch(self._graph)
            else:
                self._advance_kernels()

    def _overflowed(self) -> Tensor:
        overflow = self._view["overflow"].clone()
        self._view["overflow"].zero_()
        pool = int(mjw.OverflowType.BROADPHASE | mjw.OverflowType.NARROWPHASE)
        if not self._pool_overflow_seen and bool((overflow & pool).any()):
            # The pool is shared, so every world carries the bit whoever was greedy: resetting them all would be wrong.
            self._pool_overflow_seen = True
            logger.warning("the contact pool overflowed and contacts were lost: raise --physics.nconmax")
        return (overflow & int(mjw.OverflowType.NEFC)) > 0

    def _write(self, worlds: Tensor, qpos: Tensor, qvel: Tensor, ctrl: Tensor) -> None:
        view = self._view
        view["qpos"][worlds], view["qvel"][worlds], view["ctrl"][worlds] = qpos, qvel, ctrl
        view["qacc_warmstart"][worlds] = 0  # a NaN here would survive the reset
        view["time"][worlds] = 0

    def _forward(self, worlds: Tensor) -> None:
        with wp.ScopedDevice(self._wp_device):
            self._kinematics_kernels()

    def _kinematics(self) -> dict[str, Tensor]:
        return {name: self._view[name].clone() for name in ("qpos", "qvel", "foot_position", "foot_velocity")}

    def _forces(self) -> dict[str, Tensor]:
        return {
            "joint_torque": self._view["actuator_force"].clone(),
            "foot_force": self._view["foot_force"].clone(),
            "collisions": self._view["link_touched"].sum(-1),
        }

    def _place_blocks(self, worlds: Tensor, centre: Tensor, position: Tensor, half_size: Tensor) -> None:
        # Warp computes the poses of static geoms once, so writing them here moves the boxes for good.
        boxes = (worlds[:, None], self._blocks[None])
        self._view["geom_xpos"][boxes], self._view["geom_size"][boxes] = position.float(), half_size.float()

    def _state(self) -> dict[str, Tensor]:
        return {name: self._view[name].clone() for name in ("qpos", "qvel", "ctrl", "qacc_warmstart", "time")}

    def _load_state(self, state: dict[str, Tensor]) -> None:
        for name, value in state.items():
            self._view[name].copy_(value)
