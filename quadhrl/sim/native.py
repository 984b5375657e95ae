"""MuJoCo's C engine, batched over worlds on a thread pool (`mujoco.batch`)."""

from __future__ import annotations

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch, SimulationError
from torch import Tensor

from quadhrl.sim.scene import Scene
from quadhrl.sim.simulator import Simulator
from quadhrl.sim.terrain import BlockTerrain

__all__ = ["NativeSimulator"]


class NativeSimulator(Simulator):
    """Bit-equal to a loop of `mujoco.mj_step` over the worlds, in float64, on all cores.

    Args:
        scene: the compiled robot and terrain window.
        terrain: the terrains, on the CPU.
        threads: threads of the pool; 0 for one per core.
    """

    engine = "native"

    def __init__(self, scene: Scene, terrain: BlockTerrain, *, threads: int = 0) -> None:
        super().__init__(scene, terrain, torch.device("cpu"))
        self.batch = Batch(scene.model, self.num_worlds, threads, persistent=True)
        self._qpos, self._qvel = self.batch.bind("qpos"), self.batch.bind("qvel")
        self._sensors = self.batch.bind("sensordata")
        self._torque = self.batch.bind("actuator_force")
        self._geom_pos, self._geom_size = self.batch.expand("geom_pos"), self.batch.expand("geom_size")
        # The world body's bounding volumes must follow its boxes, or the mid-phase misses contacts.
        model = scene.model
        self._bvh = self.batch.expand("bvh_aabb")
        self._world_nodes = slice(int(model.body_bvhadr[0]), int(model.body_bvhadr[0] + model.body_bvhnum[0]))
        self._node_xy = model.bvh_aabb[self._world_nodes, :2].copy()
        self._lost = torch.zeros(self.num_worlds, dtype=torch.bool)
        self._link_of_sensor = torch.as_tensor(scene.link_of_geom)
        self.start()

    @property
    def qpos(self) -> Tensor:
        """Generalised positions [N, nq], float64 view."""
        return torch.from_numpy(self._qpos)

    @property
    def qvel(self) -> Tensor:
        """Generalised velocities [N, nv], float64 view."""
        return torch.from_numpy(self._qvel)

    def _advance(self, joint_targets: Tensor) -> None:
        self.batch.bind("ctrl")[:] = joint_targets.numpy()
        self.batch.warning[:] = 0
        self._lost.zero_()
        try:
            # The stage brings the feet's sensors from the last substep's beginning to its end.
            self.batch.step(nstep=self.scene.physics.substeps, stage=int(mujoco.mjtStage.mjSTAGE_VEL))
        except SimulationError as error:
            self._lost[torch.as_tensor(error.ids, dtype=torch.long)] = True

    def _overflowed(self) -> Tensor:
        warnings = self.batch.warning[..., 1]  # (last info, count) per kind
        full = warnings[:, mujoco.mjtWarning.mjWARN_CONTACTFULL] + warnings[:, mujoco.mjtWarning.mjWARN_CNSTRFULL]
        return torch.from_numpy(full > 0) | self._lost

    def _write(self, worlds: Tensor, qpos: Tensor, qvel: Tensor, ctrl: Tensor) -> None:
        ids = worlds.numpy()
        self.batch.reset(ids, stage=int(mujoco.mjtStage.mjSTAGE_NONE))
        self._qpos[ids], self._qvel[ids] = qpos.numpy(), qvel.numpy()
        self.batch.bind("ctrl")[ids] = ctrl.numpy()

    def _forward(self, worlds: Tensor) -> None:
        self.batch.forward(worlds.numpy(), stage=int(mujoco.mjtStage.mjSTAGE_VEL))

    def _kinematics(self) -> dict[str, Tensor]:
        feet = torch.from_numpy(self._sensors[:, :24].astype(np.float32)).view(-1, 2, 4, 3)
        return {
            "qpos": self.qpos.float(),
            "qvel": self.qvel.float(),
            "foot_position": feet[:, 0],
            "foot_velocity": feet[:, 1],
        }

    def _forces(self) -> dict[str, Tensor]:
        sensors = torch.from_numpy(self._sensors[:, 24:].astype(np.float32))
        touched = torch.zeros(self.num_worlds, self.scene.num_links).index_add_(
            1, self._link_of_sensor, sensors[:, 12:]
        )
        return {
            "joint_torque": torch.from_numpy(self._torque.astype(np.float32)),
            "foot_force": -sensors[:, :12].view(-1, 4, 3),  # the sensor reports the force that the foot exerts
            "collisions": (touched > 0).sum(-1),
        }

    def _place_blocks(self, worlds: Tensor, centre: Tensor, position: Tensor, half_size: Tensor) -> None:
        ids = worlds.numpy()
        boxes = np.ix_(ids, self.scene.blocks)
        self._geom_pos[boxes], self._geom_size[boxes] = position.numpy(), half_size.numpy()
        nodes = self._bvh[:, self._world_nodes]
        shift = centre.numpy() * self.terrain.config.block_size
        nodes[ids, :, :2] = self._node_xy + shift[:, None]
        top = self.terrain.max_height[worlds].numpy()[:, None]
        bottom = -2 * self.terrain.config.gap_depth
        nodes[ids, :, 2], nodes[ids, :, 5] = (top + bottom) / 2, (top - bottom) / 2

    def _state(self) -> dict[str, Tensor]:
        return {"integration": torch.from_numpy(self.batch.state.copy())}

    def _load_state(self, state: dict[str, Tensor]) -> None:
        self.batch.state[:] = state["integration"].cpu().numpy()
