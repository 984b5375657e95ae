"""Robots: one MJCF and one small `Robot` config each."""

from __future__ import annotations

from quadhrl.errors import InputError
from quadhrl.robots.aliengo import ALIENGO
from quadhrl.robots.robot import Robot

__all__ = ["ROBOTS", "Robot", "get_robot"]

ROBOTS: dict[str, Robot] = {ALIENGO.name: ALIENGO}
"""Every known robot by name; add your own with ``ROBOTS[robot.name] = robot``."""


def get_robot(name: str) -> Robot:
    """The robot of that name.

    Raises:
        InputError: no robot has that name.
    """
    if name not in ROBOTS:
        raise InputError("--robot", name, f"choose one of: {', '.join(sorted(ROBOTS))}")
    return ROBOTS[name]
