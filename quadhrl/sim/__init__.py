"""Batched physics: robots on block terrain, on MuJoCo's C engine or on MuJoCo-Warp."""

from __future__ import annotations

import torch

from quadhrl.errors import InputError
from quadhrl.robots import Robot
from quadhrl.sim.scene import PhysicsConfig, Scene, build_scene
from quadhrl.sim.simulator import Fault, Readings, Simulator
from quadhrl.sim.terrain import BlockTerrain, TerrainConfig

__all__ = [
    "BlockTerrain",
    "Fault",
    "PhysicsConfig",
    "Readings",
    "Scene",
    "Simulator",
    "TerrainConfig",
    "build_scene",
    "make_simulator",
    "resolve_device",
]


def resolve_device(device: str) -> torch.device:
    """The torch device for "auto" (CUDA where there is one), "cpu" or "cuda[:N]".

    Raises:
        InputError: the name is unknown, or no CUDA device is there.
    """
    if device == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        resolved = torch.device(device)
    except RuntimeError as error:
        raise InputError("--device", device, "choose auto, cpu, cuda or cuda:N") from error
    if resolved.type not in ("cpu", "cuda"):
        raise InputError("--device", device, "choose auto, cpu, cuda or cuda:N")
    if resolved.type == "cuda" and not torch.cuda.is_available():
        raise InputError("--device", device, "no CUDA device is available here; choose cpu or auto")
    return resolved


def make_simulator(
    robot: Robot,
    terrain: TerrainConfig,
    physics: PhysicsConfig,
    num_worlds: int,
    *,
    engine: str = "auto",
    device: torch.device | str = "cpu",
    seed: int = 0,
) -> Simulator:
    """Build a simulator with its terrains.

    Args:
        robot: the robot.
        terrain: the terrains' settings.
        physics: time step and solver settings.
        num_worlds: number of worlds, N.
        engine: "native" (MuJoCo C, CPU only), "warp" (MuJoCo-Warp), or "auto": warp on CUDA, native on the CPU.
        device: where the readings live, and for warp the physics.
        seed: the terrains' seed.

    Raises:
        InputError: an argument is out of its range, or engine and device do not go together.
    """
    device = torch.device(device)
    if num_worlds < 1:
        raise InputError("--num-envs", num_worlds, "give a whole number of at least 1")
    if engine not in ("auto", "native", "warp"):
        raise InputError("--engine", engine, "choose auto, native or warp")
    if engine == "auto":
        engine = "warp" if device.type == "cuda" else "native"
    if engine == "native" and device.type != "cpu":
        raise InputError("--engine", engine, f"the native engine runs on the CPU, not on {device}; choose warp or auto")
    scene = build_scene(robot, terrain, physics)
    terrains = BlockTerrain(terrain, num_worlds, seed=seed, device=device)
    terrains.regenerate(torch.arange(num_worlds, device=device))
    if engine == "native":
        from quadhrl.sim.native import NativeSimulator

        return NativeSimulator(scene, terrains)
    from quadhrl.sim.warp import WarpSimulator  # Warp starts up and prints when imported: only for those who use it

    return WarpSimulator(scene, terrains, device)
