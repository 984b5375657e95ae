"""Fixtures that several rooms share. Everything runs on the CPU with few worlds."""

import pytest
import torch

from quadhrl.robots import get_robot
from quadhrl.sim import PhysicsConfig, TerrainConfig, make_simulator


@pytest.fixture(scope="session")
def robot():
    return get_robot("aliengo")


@pytest.fixture
def make_sim(robot):
    """Build a simulator of a few worlds."""

    def make(num_worlds=4, *, engine="native", infill=1.0, height_range=0.0, seed=0, device="cpu", **physics):
        terrain = TerrainConfig(infill=infill, height_range=height_range)
        return make_simulator(
            robot, terrain, PhysicsConfig(**physics), num_worlds, engine=engine, device=device, seed=seed
        )

    return make


@pytest.fixture(autouse=True)
def _fixed_seed():
    torch.manual_seed(0)
