"""The end-to-end baseline's task against rewards worked out by hand, and as a TorchRL citizen."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torchrl.envs.utils import check_env_specs

from quadhrl.envs import FootstepConfig, FootstepEnv, ForwardConfig, ForwardEnv
from quadhrl.envs.rewards import forward_velocity, lateral_velocity
from quadhrl.errors import InputError


def make_env(num_envs=3, **changes):
    config = ForwardConfig()
    for path, value in changes.items():
        part, name = path.split("__")
        setattr(getattr(config, part), name, value)
    return ForwardEnv(config, num_envs, seed=0)


@pytest.mark.parametrize("engine", ["native", "warp"])
def test_specs(engine):
    check_env_specs(ForwardEnv(ForwardConfig(), 3, engine=engine))


def test_velocity_terms():
    assert forward_velocity(torch.tensor([-2.0, 0.3, 0.9]), 0.5).tolist() == pytest.approx([-2.0, 0.3, 0.5])
    assert lateral_velocity(torch.tensor([-2.0, 0.5]), 1).tolist() == pytest.approx([-2.0, -0.5])
    assert lateral_velocity(torch.tensor([-2.0, 0.5]), 2).tolist() == pytest.approx([-4.0, -0.25])


@pytest.mark.parametrize("power", [1, 2])
def test_reward_is_the_sum_of_the_papers_terms(power):
    env = make_env(rewards__lateral_power=power)
    generator = torch.Generator().manual_seed(0)
    td = env.reset()
    actions = np.zeros((3, 15, 3))
    for _ in range(40):
        before = env.sim.readings
        td["action"] = (torch.randn(3, 15, generator=generator) * 0.3).clamp(-1, 1)
        td = env.step(td)["next"]
        now = env.sim.readings
        actions = np.concatenate([td_action(env), actions[..., :2]], -1)
        for w in range(3):
            velocity = env.sim.qvel[w].numpy()
            by_hand = min(velocity[0], 0.5) - 0.1 * abs(velocity[1]) ** power
            second = actions[w, :, 0] - 2 * actions[w, :, 1] + actions[w, :, 2]
            by_hand -= 0.03125 * np.linalg.norm(second)
            moved = (now.foot_position[w] - before.foot_position[w]).numpy()
            held = (now.foot_force[w, :, 2] > 0).numpy() & (before.foot_force[w, :, 2] > 0).numpy()
            by_hand -= 0.0625 * sum(held & (np.hypot(moved[:, 0], moved[:, 1]) > 0.02))
            by_hand -= 0.125 * int(now.collisions[w])
            half = (2 * float(env.generator.phase[w])) % 1
            by_hand += 0.5 * float(env.generator.frequency[w]) * (0.25 <= half <= 0.75)
            assert float(td["reward"][w]) == pytest.approx(by_hand, abs=1e-4)
    assert set(td["reward_terms"].keys()) == set(ForwardEnv.reward_names)


def td_action(env):
    return env._previous_action[:, 0].numpy()[..., None]


def test_observation_is_the_footstep_tasks_without_targets_and_with_the_yaw():
    forward, footstep = make_env(2), FootstepEnv(FootstepConfig(), 2, seed=0)
    generator = torch.Generator().manual_seed(0)
    a, b = forward.reset(), footstep.reset()
    for _ in range(15):
        action = torch.randn(2, 15, generator=generator) * 0.3
        a = forward.step(a.set("action", action))["next"]
        b = footstep.step(b.set("action", action))["next"]
    shared = b["proprioception"]
    assert torch.equal(a["scan"], b["scan"])
    assert torch.equal(a["proprioception"], torch.cat([shared[:, :44], b["yaw"], shared[:, 48:]], -1))
    assert a["proprioception"].shape[-1] + a["scan"].shape[-1] == 361  # as in the authors' checkpoints
    w, x, y, z = footstep.sim.qpos[0, 3:7].tolist()
    assert b["yaw"][0].item() == pytest.approx(Rotation.from_quat([x, y, z, w]).as_euler("ZYX")[0], abs=1e-5)


def test_success_truncates_and_curriculum_score_is_speed():
    env = make_env(2, termination__goal_distance=0.5)
    env.reset()
    qpos = env.sim.qpos.clone().float()
    qpos[1, 0] = 0.6
    env.sim.reset(torch.arange(2), qpos)
    td = env.step(env.reset(keep_state=True).set("action", torch.zeros(2, 15)))["next"]
    assert td["truncated"].flatten().tolist() == [False, True] and not td["terminated"].any()
    assert td["events", "success"].flatten().tolist() == [False, True]
    env.step_count[:] = 120
    assert env._episode_score(torch.tensor([1])).item() == pytest.approx(0.6 / 2.0 / 0.5, abs=0.02)


@pytest.mark.parametrize(("field", "value"), [("max_velocity", 0.0), ("lateral_power", 3)])
def test_bad_settings_are_named(field, value):
    with pytest.raises(InputError, match=field.replace("_", "-")):
        make_env(1, **{f"rewards__{field}": value})
