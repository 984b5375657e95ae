"""What the package must know of a quadruped beside its MJCF."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from quadhrl.errors import InputError

__all__ = ["Robot"]


@dataclass(frozen=True)
class Robot:
    """A quadruped whose legs are: abduction about x, then thigh and calf about y. Legs in the order FL, FR, RL, RR.

    The MJCF has a floating base, the twelve joints and the four foot spheres named here, and no terrain; actuators in it
    are replaced by position servos with the gains given here.
    """

    name: str
    mjcf: Path
    """The robot's MJCF file."""
    base: str
    """Name of the floating base's body."""
    joints: tuple[str, ...]
    """Names of the 12 joints: abduction, thigh, calf of each leg."""
    feet: tuple[str, ...]
    """Names of the 4 foot geoms, spheres."""
    hip_offset: tuple[tuple[float, float, float], ...]
    """Abduction joint of each leg in the base's frame [m], 4 x 3."""
    hip_length: float
    """Sideways distance from the abduction axis to the thigh joint [m]."""
    thigh_length: float
    """Thigh joint to calf joint [m]."""
    calf_length: float
    """Calf joint to foot centre [m]."""
    foot_radius: float
    """Radius of the foot spheres [m]."""
    stance_height: float
    """Base height above the ground at reset [m]."""
    stance: tuple[float, ...]
    """The 12 joint angles at reset [rad]."""
    stiffness: float
    """Position gain of every joint [N m/rad]."""
    damping: float
    """Velocity gain of every joint [N m s/rad]."""
    torque_limit: float
    """Largest torque of every joint [N m]."""

    @property
    def side(self) -> tuple[float, ...]:
        """+1 for a left leg, -1 for a right one, in leg order."""
        return tuple(float(np.sign(offset[1])) for offset in self.hip_offset)

    def spec(self) -> mujoco.MjSpec:
        """The parsed MJCF.

        Raises:
            InputError: the file is missing, does not parse, or lacks a joint or foot named in this config.
        """
        if not self.mjcf.is_file():
            raise InputError(f"robot {self.name}: mjcf", str(self.mjcf), "give the path of an existing MJCF file")
        try:
            spec = mujoco.MjSpec.from_file(str(self.mjcf))
        except ValueError as error:
            raise InputError(f"robot {self.name}: mjcf", str(self.mjcf), f"mend the MJCF: {error}") from error
        wanted = {"base": (self.base,), "joints": self.joints, "feet": self.feet}
        found = {
            "base": {body.name for body in spec.bodies},
            "joints": {joint.name for joint in spec.joints},
            "feet": {geom.name for geom in spec.geoms},
        }
        for field, names in wanted.items():
            for name in names:
                if name not in found[field]:
                    raise InputError(f"robot {self.name}: {field}", name, "no such name in the MJCF; name it there")
        return spec
