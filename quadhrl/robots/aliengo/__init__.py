"""Unitree Aliengo, 20.6 kg, with the paper's position servos (stiffness 100 N m/rad, damping 5 N m s/rad, 44.4 N m)."""

from __future__ import annotations

from pathlib import Path

from quadhrl.robots.robot import Robot

__all__ = ["ALIENGO"]

_LEGS = ("FL", "FR", "RL", "RR")

ALIENGO = Robot(
    name="aliengo",
    mjcf=Path(__file__).parent / "aliengo.xml",
    base="trunk",
    joints=tuple(f"{leg}_{part}_joint" for leg in _LEGS for part in ("hip", "thigh", "calf")),
    feet=tuple(f"{leg}_foot" for leg in _LEGS),
    hip_offset=((0.2399, 0.051, 0.0), (0.2399, -0.051, 0.0), (-0.2399, 0.051, 0.0), (-0.2399, -0.051, 0.0)),
    hip_length=0.083,
    thigh_length=0.25,
    calf_length=0.25,
    foot_radius=0.0265,
    stance_height=0.435,
    stance=(0.037199, 0.660252, -1.200187, -0.037199, 0.660252, -1.200187) * 2,
    stiffness=100.0,
    damping=5.0,
    torque_limit=44.4,
)
