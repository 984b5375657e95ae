"""A second, naive implementation of the footstep task in numpy, one world at a time, from recorded simulator states."""

import mujoco
import numpy as np

PAIRS = ([0, 3], [1, 2])  # feet of even and odd pairs


class Reference:
    """Follows one world of a recorded run with its own arithmetic; contact forces and torques come from the record."""

    def __init__(self, robot):
        self.robot = robot
        self.model = robot.spec().compile()
        self.data = mujoco.MjData(self.model)
        self.feet = [self.model.geom(name).id for name in robot.feet]

    def kinematics(self, qpos, qvel):
        """Foot positions and velocities, base rotation, from plain MuJoCo."""
        self.data.qpos[:], self.data.qvel[:] = qpos, qvel
        mujoco.mj_forward(self.model, self.data)
        velocity = np.zeros((4, 6))
        for k, foot in enumerate(self.feet):
            mujoco.mj_objectVelocity(self.model, self.data, mujoco.mjtObj.mjOBJ_GEOM, foot, velocity[k], 0)
        rotation = self.data.body(self.robot.base).xmat.reshape(3, 3).copy()
        return self.data.geom_xpos[self.feet].copy(), velocity[:, 3:], rotation

    @staticmethod
    def rewards(step):
        """The seven weighted terms of one step, from scalars and small arrays."""
        feet, velocity, force = step["feet"], step["velocity"], step["force"]
        phase, active = step["phase"], PAIRS[step["index"] % 2]
        hits, closeness = [], []
        for foot in range(4):
            d = np.hypot(*(step["targets"][foot] - feet[foot, :2]))
            p = (phase + (0.5, 0.0, 0.0, 0.5)[foot]) % 1
            hit = d < 0.075 and force[foot, 2] > 5 and p >= 0.5
            hits.append(hit)
            closeness.append((1 + 0.5 * (1 - d / 0.075)) if hit else 0.0)
        both = all(hits[foot] for foot in active)
        towards = 0.0
        for foot in active:
            vector = step["targets"][foot] - feet[foot, :2]
            towards += velocity[foot, :2] @ vector / np.linalg.norm(vector)
        slips = sum(
            force[foot, 2] > 0
            and step["force_before"][foot, 2] > 0
            and np.hypot(*(feet[foot, :2] - step["feet_before"][foot, :2])) > 0.02
            for foot in range(4)
        )
        a, a1, a2 = step["actions"]
        phi = 2 * np.pi * phase
        swinging = 0.25 * np.pi <= phi <= 0.75 * np.pi or 1.25 * np.pi <= phi <= 1.75 * np.pi
        terms = {
            "footstep_target": 2.0 * (3 if both else 1) * sum(closeness[foot] for foot in active),
            "velocity_towards_target": 0.25 * towards,
            "smoothness": -0.03125 * np.linalg.norm(a - 2 * a1 + a2),
            "foot_slip": -0.0625 * slips,
            "foot_stay": 0.25 * sum(closeness[foot] for foot in range(4) if foot not in active),
            "collision": -0.125 * step["collisions"],
            "swing_phase": 0.5 * step["frequency"] if swinging else 0.0,
        }
        return terms, both

    def observation(self, qpos, qvel, step):
        """Proprioception and goal after the targets have moved on."""
        feet, velocity, rotation = self.kinematics(qpos, qvel)
        yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
        pitch = -np.arcsin(rotation[2, 0])
        roll = np.arctan2(rotation[2, 1], rotation[2, 2])
        level = np.array([[np.cos(yaw), np.sin(yaw), 0], [-np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
        hips = qpos[:3] + np.array(self.robot.hip_offset) @ rotation.T
        spin = level @ (rotation @ qvel[3:6])
        active = PAIRS[step["index_after"] % 2]
        stance = PAIRS[(step["index_after"] + 1) % 2]
        phi = 2 * np.pi * step["phase"]
        proprioception = np.concatenate([
            ((feet - hips) @ level.T).ravel(),
            (velocity @ level.T).ravel(),
            step["torque"],
            [roll, pitch, spin[0], spin[1]],
            (step["force"][:, 2] > 0).astype(float),
            [float(foot in active) for foot in range(4)],
            [np.cos(phi), np.sin(phi)],
            step["actions"][0],
            step["actions"][1],
        ])  # fmt: skip
        vectors = [step["targets_after"][foot] - feet[foot, :2] for foot in range(4)]
        vectors += [target - feet[foot, :2] for target, foot in zip(step["following_after"], stance, strict=True)]
        goal = (np.array(vectors) @ level[:2, :2].T).ravel()
        return proprioception, goal, feet
