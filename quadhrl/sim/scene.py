"""Compile one robot on a window of terrain blocks into a MuJoCo model."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from quadhrl.errors import InputError, check_range
from quadhrl.robots import Robot
from quadhrl.sim.terrain import TerrainConfig

__all__ = ["PhysicsConfig", "Scene", "build_scene"]

WINDOW = 8
"""Blocks along each side of the window that follows a robot: with 0.2 m blocks some 0.65 m of ground on every side."""

BLOCK_OVERLAP = 0.05
"""How far a block's box reaches under those neighbours that are at least as high [m]; see `Simulator`."""


@dataclass
class PhysicsConfig:
    """How a control step is integrated: 60 Hz control as in the paper, with four substeps instead of its two.

    MuJoCo's contacts give way for a time constant of at least two physics steps. At two substeps a foot that lands sinks in by up
    to 3 cm, more than its radius, and the calf behind it touches the ground; see docs/choices.md.
    """

    control_dt: float = 1 / 60
    """Duration of a control step [s]."""
    substeps: int = 4
    """Physics steps per control step."""
    solver_iterations: int = 10
    """Most Newton iterations per physics step (it usually stops after two or three)."""
    line_search_iterations: int = 20
    """Most line-search iterations per Newton iteration."""
    nconmax: int = 64
    """Contacts and candidate pairs per world that the warp engine has room for (pooled over the worlds)."""
    njmax: int = 256
    """Constraint rows per world that the warp engine has room for."""

    def validate(self) -> None:
        """Check every field.

        Raises:
            InputError: a field is out of its range.
        """
        check_range(self, "physics", "control_dt", 0.001, 0.1, "s")
        check_range(self, "physics", "substeps solver_iterations line_search_iterations nconmax njmax", 1)

    @property
    def timestep(self) -> float:
        """Duration of a physics step [s]."""
        return self.control_dt / self.substeps


@dataclass(frozen=True)
class Scene:
    """A compiled model and where its parts are."""

    model: mujoco.MjModel
    robot: Robot
    physics: PhysicsConfig
    base_body: int
    """Body id of the floating base."""
    feet: np.ndarray
    """Geom ids of the feet, [4]."""
    blocks: np.ndarray
    """Geom ids of the terrain window, [WINDOW * WINDOW], row-major in (x, y)."""
    link_geoms: np.ndarray
    """Geom ids of the robot's colliding geoms that are no feet, [G]."""
    link_of_geom: np.ndarray
    """Number of the link (0 ... links-1) that each of `link_geoms` belongs to, [G]."""
    block_offset: np.ndarray
    """Block index of each window tile relative to the window's centre corner, [WINDOW * WINDOW, 2]."""

    @property
    def num_links(self) -> int:
        """Number of links that can collide, feet not counted."""
        return int(self.link_of_geom.max()) + 1

    @property
    def home(self) -> np.ndarray:
        """Generalised position at reset: above the origin, upright, in the robot's stance, [nq]."""
        return np.array([0, 0, self.robot.stance_height, 1, 0, 0, 0, *self.robot.stance])


def build_scene(
    robot: Robot, terrain: TerrainConfig, physics: PhysicsConfig, *, window: int = WINDOW, visuals: bool = False
) -> Scene:
    """Compile the robot, its servos and contact sensors, and a window of static block boxes.

    The boxes are geoms of the world body, whose positions and sizes the simulators write per world: static geoms cost half
    of what mocap bodies do on the native engine. They are compiled at their largest, so that the bounding volumes hold.

    Args:
        robot: the robot.
        terrain: block size and gap depth are compiled in; heights are not.
        physics: time step and solver settings.
        window: blocks along each side of the window.
        visuals: keep the robot's visual geoms (for rendering; the simulators leave them out).

    Raises:
        InputError: the robot's MJCF does not fit its config.
    """
    physics.validate()
    spec = robot.spec()
    for geom in list(spec.geoms):
        if geom.contype == 0 and geom.conaffinity == 0 and not visuals:
            spec.delete(geom)
    _set_options(spec, physics)
    _add_servos(spec, robot)
    _add_blocks(spec, terrain, window)
    for geom in spec.geoms:
        geom.solref = [2 * physics.timestep, 1.0]  # the stiffest without overshoot that MuJoCo allows
    link_geoms = [
        geom.name
        for geom in spec.geoms
        if (geom.contype or geom.conaffinity) and geom.name not in robot.feet and not geom.name.startswith("block_")
    ]
    if "" in link_geoms:
        raise InputError(f"robot {robot.name}: mjcf", str(robot.mjcf), "name every colliding geom in the MJCF")
    _add_sensors(spec, robot, link_geoms)
    model = spec.compile()
    if [model.joint(k).name for k in range(1, model.njnt)] != list(robot.joints) or model.nq != 19:
        remedy = "it must have a free joint and then just these joints, in this order; sort them"
        raise InputError(f"robot {robot.name}: joints", list(robot.joints), remedy)
    links = model.geom_bodyid[[model.geom(name).id for name in link_geoms]]
    offsets = (
        np.stack(np.meshgrid(np.arange(window), np.arange(window), indexing="ij"), -1).reshape(-1, 2) - window // 2
    )
    return Scene(
        model=model,
        robot=robot,
        physics=physics,
        base_body=model.body(robot.base).id,
        feet=np.array([model.geom(name).id for name in robot.feet]),
        blocks=np.array([model.geom(f"block_{k}").id for k in range(window * window)]),
        link_geoms=np.array([model.geom(name).id for name in link_geoms]),
        link_of_geom=np.unique(links, return_inverse=True)[1],
        block_offset=offsets,
    )


def _set_options(spec: mujoco.MjSpec, physics: PhysicsConfig) -> None:
    option = spec.option
    option.timestep = physics.timestep
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE  # MuJoCo 4.0.0: the sparse Newton Hessian is wrong
    option.iterations = physics.solver_iterations
    option.ls_iterations = physics.line_search_iterations
    # A diverged world must stay visible as such: MuJoCo's silent reset to qpos0 would hide it from the fault check.
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET


def _add_servos(spec: mujoco.MjSpec, robot: Robot) -> None:
    for actuator in list(spec.actuators):
        spec.delete(actuator)
    for joint in robot.joints:
        servo = spec.add_actuator(
            name=joint,
            target=joint,
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            forcelimited=True,
            forcerange=[-robot.torque_limit, robot.torque_limit],
        )
        servo.set_to_position(kp=robot.stiffness, kv=robot.damping)


def _add_blocks(spec: mujoco.MjSpec, terrain: TerrainConfig, window: int) -> None:
    largest = terrain.block_size / 2 + BLOCK_OVERLAP
    for k in range(window * window):
        x, y = k // window - window // 2, k % window - window // 2
        spec.worldbody.add_geom(
            name=f"block_{k}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[largest, largest, terrain.gap_depth / 2],
            pos=[(x + 0.5) * terrain.block_size, (y + 0.5) * terrain.block_size, -terrain.gap_depth / 2],
            friction=[1.0, 0.005, 0.0001],
            rgba=[0.62, 0.58, 0.52, 1.0],
        )


def _add_sensors(spec: mujoco.MjSpec, robot: Robot, link_geoms: list[str]) -> None:
    """Position, velocity and net contact force of each foot, and whether each link geom touches anything."""
    geom = mujoco.mjtObj.mjOBJ_GEOM
    for kind, sensor_type in (
        ("position", mujoco.mjtSensor.mjSENS_FRAMEPOS),
        ("velocity", mujoco.mjtSensor.mjSENS_FRAMELINVEL),
    ):
        for foot in robot.feet:
            spec.add_sensor(name=f"{kind}_{foot}", type=sensor_type, objtype=geom, objname=foot)
    force, found = 1 << int(mujoco.mjtConDataField.mjCONDATA_FORCE), 1 << int(mujoco.mjtConDataField.mjCONDATA_FOUND)
    net_force, any_contact = 3, 0  # reduction: in the world's frame, summed; none
    for foot in robot.feet:
        spec.add_sensor(
            name=f"force_{foot}",
            type=mujoco.mjtSensor.mjSENS_CONTACT,
            objtype=geom,
            objname=foot,
            intprm=[force, net_force, 1],
        )
    for name in link_geoms:
        spec.add_sensor(
            name=f"touch_{name}",
            type=mujoco.mjtSensor.mjSENS_CONTACT,
            objtype=geom,
            objname=name,
            intprm=[found, any_contact, 1],
        )
