"""The trajectory generator against the authors' formulas, written out naively."""

import math

import numpy as np
import pytest
import torch

from quadhrl.envs.kinematics import LegKinematics
from quadhrl.envs.trajectory_generator import TrajectoryGenerator, TrajectoryGeneratorConfig, lift, stride
from quadhrl.rotations import RollPitchYaw


def authors_x(p):
    u = 2 * (p % 1)
    return 2 * (-2 * u**3 + 3 * u**2) - 1 if u < 1 else 2 * (2 * u**3 - 9 * u**2 + 12 * u - 4) - 1


def authors_z(p):
    n = 4 * ((p + 0.5) % 1) - 2
    if 0 <= n < 1:
        return -2 * n**3 + 3 * n**2
    return 2 * n**3 - 9 * n**2 + 12 * n - 4 if n >= 1 else 0.0


def test_shapes_of_the_cycle():
    p = torch.linspace(0, 0.999, 500, dtype=torch.float64)
    assert stride(p).numpy() == pytest.approx(np.array([authors_x(float(q)) for q in p]), abs=1e-12)
    assert lift(p).numpy() == pytest.approx(np.array([authors_z(float(q)) for q in p]), abs=1e-12)


@pytest.fixture
def generator(robot):
    return TrajectoryGenerator(TrajectoryGeneratorConfig(), robot, 3, 1 / 60, torch.device("cpu"))


def level(n=3):
    return RollPitchYaw(*torch.zeros(3, n))


def test_action_ranges_and_phase(generator, robot):
    action = torch.zeros(3, 15)
    action[0, :3] = torch.tensor([-1.0, -1.0, -1.0])
    action[1, :3] = torch.tensor([1.0, 1.0, 1.0])
    kinematics = LegKinematics(robot)
    for k in range(1, 30):
        feet = kinematics.forward(generator.joint_targets(action, level()).view(3, 4, 3))
        assert generator.frequency.tolist() == [0.0, 3.0, 1.5]
        assert generator.phase.tolist() == pytest.approx([0.0, (3 * k / 60) % 1, (1.5 * k / 60) % 1], abs=1e-5)
        y = [0.075, -0.075, 0.075, -0.075]
        height, amplitude = {0: -0.5, 1: -0.3, 2: -0.4}, {0: 0.0, 1: 0.5, 2: 0.25}
        for world in range(3):
            for leg, offset in enumerate((0.5, 0.0, 0.0, 0.5)):
                p = float(generator.phase[world]) + offset
                target = np.array([
                    amplitude[world] * authors_x(p), y[leg], height[world] + 0.05 * authors_z(p) + 0.0265
                ])  # fmt: skip
                reach = np.linalg.norm(target)
                target *= min(reach, kinematics.max_reach) / reach
                assert feet[world, leg].numpy() == pytest.approx(target, abs=1e-4)


def test_feet_stay_level_when_the_base_tilts(generator, robot):
    action = torch.zeros(1, 15).expand(3, -1)
    roll, pitch = torch.tensor([0.3, 0.0, -0.2]), torch.tensor([0.0, -0.4, 0.25])
    flat = LegKinematics(robot).forward(generator.joint_targets(action, level()).view(3, 4, 3))
    generator.reset(torch.arange(3))
    tilted = LegKinematics(robot).forward(
        generator.joint_targets(action, RollPitchYaw(roll, pitch, roll)).view(3, 4, 3)
    )
    for world in range(3):
        r, p = float(roll[world]), float(pitch[world])
        rx = np.array([[1, 0, 0], [0, math.cos(r), -math.sin(r)], [0, math.sin(r), math.cos(r)]])
        ry = np.array([[math.cos(p), 0, math.sin(p)], [0, 1, 0], [-math.sin(p), 0, math.cos(p)]])
        assert pytest.approx(flat[world].numpy(), abs=1e-4) == (ry @ rx @ tilted[world].numpy().T).T


def test_swing_window_and_support_follow_the_paper(generator):
    for phase in np.linspace(0, 0.999, 97):
        generator.phase[:] = float(phase)
        phi = 2 * math.pi * phase
        in_s = 0.25 * math.pi <= phi <= 0.75 * math.pi or 1.25 * math.pi <= phi <= 1.75 * math.pi
        assert generator.swing_window[0].item() == in_s
        assert generator.support[0].tolist() == [phase < 0.5, phase >= 0.5, phase >= 0.5, phase < 0.5]
