"""The MJCF against the published numbers and against the analytic leg kinematics."""

import dataclasses

import mujoco
import numpy as np
import pytest
import torch

from quadhrl.envs.kinematics import LegKinematics
from quadhrl.errors import InputError
from quadhrl.robots import ROBOTS, get_robot
from quadhrl.sim import PhysicsConfig, TerrainConfig, build_scene


@pytest.fixture(scope="module")
def model(robot):
    return robot.spec().compile()


def full_inertia(model, body):
    """Inertia tensor about the centre of mass in the body's axes."""
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, model.body(body).iquat)
    rotation = rotation.reshape(3, 3)
    return rotation @ np.diag(model.body(body).inertia) @ rotation.T


def test_total_mass_is_the_published_one(model):
    assert model.body_mass.sum() == pytest.approx(20.637, abs=1e-6)


@pytest.mark.parametrize(("leg", "front", "left"), [("FL", 1, 1), ("FR", 1, -1), ("RL", -1, 1), ("RR", -1, -1)])
def test_inertias_are_mirrored(model, leg, front, left):
    hip = full_inertia(model, f"{leg}_hip")
    assert np.diag(hip) == pytest.approx([0.002903894, 0.004907517, 0.005586944], abs=1e-9)
    assert hip[0, 1] == pytest.approx(-7.185e-5 * front * left, abs=1e-9)
    assert hip[0, 2] == pytest.approx(-1.262e-6 * front, abs=1e-9)
    assert hip[1, 2] == pytest.approx(-1.75e-6 * left, abs=1e-9)
    assert model.body(f"{leg}_hip").ipos == pytest.approx([-0.022191 * front, 0.015144 * left, -1.5e-5])
    thigh = full_inertia(model, f"{leg}_thigh")
    assert thigh[0, 1] == pytest.approx(3.597e-6 * left, abs=1e-9)
    assert thigh[0, 2] == pytest.approx(4.91446e-4, abs=1e-9)
    assert thigh[1, 2] == pytest.approx(1.0086e-5 * left, abs=1e-9)
    assert model.body(f"{leg}_thigh").ipos == pytest.approx([-0.005607, -0.003877 * left, -0.048199])


def test_collision_shapes_are_spheres_and_capsules(model):
    colliding = model.geom_contype != 0
    shapes = {int(mujoco.mjtGeom.mjGEOM_SPHERE), int(mujoco.mjtGeom.mjGEOM_CAPSULE)}
    assert set(model.geom_type[colliding].tolist()) <= shapes
    foot = model.geom("FL_foot")
    assert (foot.type[0], foot.size[0]) == (int(mujoco.mjtGeom.mjGEOM_SPHERE), 0.0265)


def test_stance_puts_the_feet_where_the_authors_have_them(model, robot):
    data = mujoco.MjData(model)
    data.qpos[2], data.qpos[7:] = robot.stance_height, robot.stance
    mujoco.mj_kinematics(model, data)
    feet = np.array([data.geom(name).xpos for name in robot.feet])
    published = [
        [0.2134, 0.1494, 0.0285],
        [0.2135, -0.1493, 0.0285],
        [-0.2694, 0.1495, 0.0285],
        [-0.2693, -0.1492, 0.0285],
    ]
    assert feet == pytest.approx(
        np.array(published), abs=5e-3
    )  # the published places are 5 mm off the published joint angles


def test_link_lengths_of_the_config_are_those_of_the_mjcf(model, robot):
    """Analytic forward kinematics against MuJoCo's, at random joint angles."""
    rng = np.random.default_rng(0)
    kinematics = LegKinematics(robot, dtype=torch.float64)
    data = mujoco.MjData(model)
    for _ in range(50):
        joints = rng.uniform([-1.2, -1.5, -2.7], [1.2, 3.0, -0.65], size=(4, 3))
        data.qpos[:7], data.qpos[7:] = [0, 0, 0, 1, 0, 0, 0], joints.ravel()
        mujoco.mj_kinematics(model, data)
        feet = np.array([data.geom(name).xpos for name in robot.feet]) - np.array(robot.hip_offset)
        assert kinematics.forward(torch.tensor(joints)).numpy() == pytest.approx(feet, abs=1e-9)


def test_servos_get_the_configs_gains(robot):
    model = build_scene(robot, TerrainConfig(), PhysicsConfig()).model
    assert model.nu == 12
    assert (model.actuator_gainprm[:, 0] == 100).all()
    assert (model.actuator_biasprm[:, 1] == -100).all() and (model.actuator_biasprm[:, 2] == -5).all()
    assert (model.actuator_forcerange == [-44.4, 44.4]).all()


def test_another_robot_needs_one_mjcf_and_one_config(robot, tmp_path):
    """Half the size, other names: builds, stands, and its feet are where its own kinematics say."""
    text = robot.mjcf.read_text().replace("FL_", "lf_").replace("trunk", "torso")
    (tmp_path / "small.xml").write_text(text)
    small = dataclasses.replace(
        robot,
        name="small",
        mjcf=tmp_path / "small.xml",
        base="torso",
        joints=tuple(name.replace("FL_", "lf_") for name in robot.joints),
        feet=tuple(name.replace("FL_", "lf_") for name in robot.feet),
        stiffness=60.0,
    )
    scene = build_scene(small, TerrainConfig(), PhysicsConfig())
    assert scene.model.geom(int(scene.feet[0])).name == "lf_foot"
    assert (scene.model.actuator_gainprm[:, 0] == 60).all()
    assert scene.num_links == 13


def test_unknown_robot_names_the_choices():
    with pytest.raises(InputError, match="--robot: got 'spot'; choose one of: aliengo"):
        get_robot("spot")
    assert list(ROBOTS) == ["aliengo"]


def test_a_config_that_does_not_fit_its_mjcf_is_refused(robot, tmp_path):
    with pytest.raises(InputError, match="joints: got 'nose'"):
        dataclasses.replace(robot, joints=("nose", *robot.joints[1:])).spec()
    with pytest.raises(InputError, match=r"mjcf.*existing"):
        dataclasses.replace(robot, mjcf=tmp_path / "missing.xml").spec()
    broken = tmp_path / "broken.xml"
    broken.write_text("<mujoco><worldbody>")
    with pytest.raises(InputError, match="mend the MJCF"):
        dataclasses.replace(robot, mjcf=broken).spec()
