"""Analytic leg kinematics and rotations."""

import mujoco
import numpy as np
import pytest
import torch

from quadhrl.envs.kinematics import LegKinematics
from quadhrl.rotations import roll_pitch_yaw, rotate_yaw


@pytest.mark.parametrize(("dtype", "bound"), [(torch.float64, 1e-9), (torch.float32, 1e-5)])
def test_inverse_undoes_forward_inside_the_workspace(robot, dtype, bound):
    kinematics = LegKinematics(robot, dtype=dtype)
    generator = torch.Generator().manual_seed(0)
    low, high = torch.tensor([-0.7, -0.9, -2.7]), torch.tensor([0.7, 1.8, -0.65])
    joints = (low + (high - low) * torch.rand(5000, 4, 3, generator=generator)).to(dtype)
    feet = kinematics.forward(joints)
    feet = feet[(feet[..., 2] < -0.1).all(-1)]
    assert len(feet) > 1000
    back = kinematics.forward(kinematics.inverse(feet))
    assert (back - feet).norm(dim=-1).max() < bound
    assert torch.equal(kinematics.clip(feet)[feet.norm(dim=-1) < 0.5], feet[feet.norm(dim=-1) < 0.5])


def test_round_trip_is_within_a_micrometre_for_the_generators_range(robot):
    """Every foot target that an action can ask for, after clipping."""
    kinematics = LegKinematics(robot, dtype=torch.float64)
    generator = torch.Generator().manual_seed(1)
    feet = torch.rand(20000, 4, 3, generator=generator, dtype=torch.float64) * torch.tensor(
        [1.2, 0.5, 0.7]
    ) - torch.tensor([0.6, 0.25, 0.7])
    feet = kinematics.clip(feet)
    reachable = feet[..., 1] ** 2 + feet[..., 2] ** 2 > robot.hip_length**2
    error = (kinematics.forward(kinematics.inverse(feet)) - feet).norm(dim=-1)
    assert error[reachable].max() < 1e-6


def test_targets_outside_the_workspace_are_pulled_in(robot):
    kinematics = LegKinematics(robot)
    wild = torch.tensor([[0.0, 0.0, 0.5], [3.0, 0.0, -3.0], [0.0, 0.0, 0.0], [0.0, 1e-6, -1e-3]])
    feet = kinematics.clip(wild[:, None].expand(-1, 4, -1))
    assert torch.isfinite(kinematics.inverse(feet)).all()
    assert (feet.norm(dim=-1) <= kinematics.max_reach + 1e-6).all()
    assert (feet.norm(dim=-1) >= kinematics.min_reach - 1e-6).all()
    assert (feet[..., 2] < 0).all()


def test_roll_pitch_yaw_rebuilds_the_rotation():
    rng = np.random.default_rng(0)
    for _ in range(100):
        angles = rng.uniform([-3, -1.5, -3], [3, 1.5, 3])
        quaternion = np.zeros(4)
        mujoco.mju_euler2Quat(quaternion, angles, "XYZ")  # extrinsic: Rz(yaw) Ry(pitch) Rx(roll)
        found = roll_pitch_yaw(torch.tensor(quaternion))
        assert [float(a) for a in found] == pytest.approx(angles, abs=1e-9)


def test_rotate_yaw_turns_counter_clockwise_and_keeps_z():
    quarter = torch.tensor(torch.pi / 2)
    turned = rotate_yaw(torch.tensor([1.0, 0.0, 5.0]), quarter.cos(), quarter.sin())
    assert turned.tolist() == pytest.approx([0.0, 1.0, 5.0], abs=1e-6)
