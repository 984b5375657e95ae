"""The footstep environment against a naive numpy implementation, and as a TorchRL citizen."""

import mujoco
import numpy as np
import pytest
import torch
from reference import Reference
from torchrl.envs.utils import check_env_specs

from quadhrl.envs import FootstepConfig, FootstepEnv
from quadhrl.envs.scan import scan_pattern


def make_env(num_envs=4, *, engine="native", seed=0, infill=0.9, height_range=0.05, **changes):
    config = FootstepConfig()
    config.terrain.infill, config.terrain.height_range = infill, height_range
    for path, value in changes.items():
        part, name = path.split("__")
        setattr(getattr(config, part), name, value)
    return FootstepEnv(config, num_envs, engine=engine, seed=seed)


def trot(env, generator, noise=0.15):
    """Stepping on the spot at 3 Hz, with noise: hits targets that stay close, and falls now and then."""
    action = torch.tensor([-1.0, 0.3, 1.0] + [0.0] * 12).expand(env.num_envs, -1)
    return action + noise * torch.randn(action.shape, generator=generator)


@pytest.mark.parametrize("engine", ["native", "warp"])
def test_specs(engine):
    check_env_specs(make_env(engine=engine))


@pytest.mark.parametrize("engine", ["native", "warp"])
def test_rewards_and_observations_equal_the_reference_over_whole_episodes(engine, robot):
    env = make_env(
        6, engine=engine, targets__max_step=0.02, targets__max_shift=0.04, termination__max_steps=70,
        termination__stuck_seconds=0.8,
    )  # fmt: skip
    reference = Reference(robot)
    generator = torch.Generator().manual_seed(0)
    td = env.reset()
    actions = np.zeros((6, 2, 15))
    since_hit, steps = np.zeros(6, int), np.zeros(6, int)
    seen = {"hits": 0, "stuck": 0, "timeout": 0}
    for _ in range(160):
        before, targets = env.sim.readings, env.targets
        record = [(int(targets.index[w]), targets.position[w].numpy().copy()) for w in range(6)]
        td["action"] = trot(env, generator)
        td = env.step(td)
        after, now = td["next"], env.sim.readings
        steps += 1
        since_hit += 1
        for w in range(6):
            action = np.clip(td["action"][w].numpy(), -1, 1)
            qpos, qvel = env.sim.qpos[w].double().numpy(), env.sim.qvel[w].double().numpy()
            feet, velocity, _ = reference.kinematics(qpos, qvel)
            step = {
                "feet": feet, "velocity": velocity, "force": now.foot_force[w].numpy(), "torque": now.joint_torque[w].numpy(),
                "feet_before": before.foot_position[w].numpy(), "force_before": before.foot_force[w].numpy(),
                "collisions": int(now.collisions[w]), "phase": float(env.generator.phase[w]), "frequency": (action[2] + 1) * 1.5,
                "index": record[w][0], "targets": record[w][1], "actions": (action, actions[w, 0], actions[w, 1]),
                "index_after": int(targets.index[w]), "targets_after": targets.position[w].numpy(),
                "following_after": targets.following[w].numpy(),
            }  # fmt: skip
            terms, both = reference.rewards(step)
            for name, term in terms.items():
                assert after["reward_terms", name][w].item() == pytest.approx(term, abs=2e-3), name
            assert after["reward"][w].item() == pytest.approx(sum(terms.values()), abs=5e-3)
            assert after["events", "pair_hit"][w].item() == both
            assert step["index_after"] == step["index"] + both
            proprioception, goal, _ = reference.observation(qpos, qvel, step)
            assert after["proprioception"][w].numpy() == pytest.approx(proprioception, abs=2e-3)
            assert after["goal"][w].numpy() == pytest.approx(goal, abs=1e-4)
            since_hit[w] = 0 if both else since_hit[w]
            stuck, timeout = since_hit[w] >= 48, steps[w] >= 70
            fallen = qpos[2] < -0.025
            assert after["terminated"][w].item() == (
                stuck or fallen or abs(proprioception[36]) > np.pi / 2 or abs(proprioception[37]) > np.pi / 2
            )
            assert after["truncated"][w].item() == (timeout and not after["terminated"][w].item())
            assert after["events", "step_count"][w].item() == steps[w]
            seen["hits"] += both
            seen["stuck"] += stuck
            seen["timeout"] += timeout
            actions[w] = np.stack([action, actions[w, 0]])
            if after["done"][w]:
                actions[w], steps[w], since_hit[w] = 0, 0, 0
        td = env.maybe_reset(after)
    assert all(seen.values()), f"the run must contain every kind of event: {seen}"


def test_scan_is_what_a_ray_meets():
    env = make_env(3, infill=0.8, height_range=0.1)
    td = env.reset()
    for _ in range(5):
        td["action"] = trot(env, torch.Generator().manual_seed(1))
        td = env.step(td)["next"]
    pattern = scan_pattern().double().numpy()
    assert pattern.shape == (71, 2)
    assert np.unique(np.linalg.norm(pattern, axis=1).round(6)) == pytest.approx(
        [0, 0.025, 0.05, 0.075, 0.1, 0.125, 0.15, 0.2]
    )
    only_terrain = np.array([1, 0, 0, 0, 0, 0], np.uint8)
    for world in range(3):
        model, data = env.sim.batch.get_model(world), env.sim.batch.get_data(world)
        mujoco.mj_kinematics(model, data)
        scan = td["scan"][world].view(4, 71).numpy()
        for foot in range(4):
            centre = env.sim.readings.foot_position[world, foot].double().numpy()
            for k, offset in enumerate(pattern):
                x, y = centre[:2] + offset
                if min(abs((x / 0.2) % 1), abs((y / 0.2) % 1)) < 1e-3:
                    continue  # on an edge, where rounding decides
                distance = mujoco.mj_ray(
                    model, data, [x, y, 1.0], [0.0, 0.0, -1.0], only_terrain, 1, -1, np.zeros(1, np.int32)
                )
                assert scan[foot, k] == pytest.approx(np.clip(centre[2] - (1.0 - distance), -1, 1), abs=1e-5)


@pytest.mark.parametrize("engine", ["native", "warp"])
def test_same_seed_gives_the_same_rollout(engine):
    def run(seed):
        env = make_env(engine=engine, seed=seed)
        generator = torch.Generator().manual_seed(0)
        return env.rollout(60, policy=lambda td: td.set("action", trot(env, generator, 0.5)), break_when_any_done=False)

    first, again, other = run(3), run(3), run(4)
    for key in first.keys(include_nested=True, leaves_only=True):
        assert torch.equal(first[key], again[key]), key
    assert not torch.equal(first["goal"], other["goal"]) and not torch.equal(first["scan"], other["scan"])


def test_every_tensor_that_leaves_is_its_own_memory():
    """A rollout keeps references: each of its rows must still hold what was there when it was made."""
    env = make_env()
    generator = torch.Generator().manual_seed(0)
    kept, copies = [], []
    td = env.reset()
    for _ in range(25):
        td["action"] = trot(env, generator, 0.6)
        td, following = env.step_and_maybe_reset(td)
        kept.append(td)
        copies.append(td.clone())
        td = following
    for original, copy in zip(kept, copies, strict=True):
        for key in copy.keys(include_nested=True, leaves_only=True):
            assert torch.equal(original[key], copy[key]), key
    assert not torch.equal(kept[0]["next", "proprioception"], kept[1]["next", "proprioception"])


@pytest.mark.parametrize("engine", ["native", "warp"])
def test_partial_resets_leave_other_worlds_untouched(engine):
    """World 1 is reset by hand in one of two equal runs; worlds 0 and 2 must not notice. (Draws are for all worlds at once.)"""
    runs = []
    for reset in (False, True):
        env = make_env(3, engine=engine, targets__max_shift=0.0)
        generator = torch.Generator().manual_seed(0)
        td, rows = env.reset(), []
        for k in range(40):
            td["action"] = trot(env, generator)
            td = env.step(td)["next"]
            if reset and k == 20:
                td["_reset"] = torch.tensor([[False], [True], [False]])
                before = td.clone()
                td = env.reset(td)
                for key in ("proprioception", "goal", "scan"):
                    assert torch.equal(td[key][[0, 2]], before[key][[0, 2]])
                assert td["events", "step_count"][1] == 0 and env.targets.index[1] == 1
            rows.append(td["proprioception"][[0, 2]])
        runs.append(torch.stack(rows))
    assert torch.equal(*runs)


def test_terminal_observation_is_the_true_one():
    env = make_env(2, termination__max_steps=5)
    td = env.reset()
    for _ in range(5):
        td["action"] = torch.zeros(2, 15)
        td, following = env.step_and_maybe_reset(td)
        last, td = td, following
    assert last["next", "truncated"].all() and not last["next", "terminated"].any()
    assert last["next", "events", "step_count"].tolist() == [[5], [5]]
    assert following["events", "step_count"].tolist() == [[0], [0]]
    assert not torch.equal(last["next", "proprioception"], following["proprioception"])


@pytest.mark.parametrize("engine", ["native", "warp"])
def test_a_broken_world_ends_its_episode_and_nothing_else(engine):
    env = make_env(3, engine=engine)
    td = env.reset()
    for k in range(8):
        td["action"] = torch.zeros(3, 15)
        if k == 5:
            env.sim.qvel[1] = float("nan")
        td, following = env.step_and_maybe_reset(td)
        assert td["next", "events", "fault"].flatten().tolist() == [False, k == 5, False]
        assert td["next", "terminated"].flatten().tolist() == [False, k == 5, False]
        assert all(torch.isfinite(v.float()).all() for v in td["next"].values(include_nested=True, leaves_only=True))
        td = following
    assert td["events", "step_count"].flatten().tolist() == [8, 2, 8]


def test_nan_actions_do_not_spread():
    env = make_env(2)
    td = env.reset()
    td["action"] = torch.full((2, 15), float("nan"))
    td = env.step(td)
    assert torch.isfinite(td["next", "proprioception"]).all() and torch.isfinite(td["next", "reward"]).all()


def test_success_is_reported_and_is_no_failure():
    env = make_env(1, infill=1.0, height_range=0.0, termination__goal_distance=0.3)
    td = env.reset()
    qpos = env.sim._home[None].clone()
    qpos[0, 0] = 0.4
    env.sim.reset(torch.tensor([0]), qpos)
    td["action"] = torch.zeros(1, 15)
    after = env.step(td)["next"]
    assert after["events", "success"] and after["truncated"] and after["done"] and not after["terminated"]


def test_curriculum_moves_levels_by_score_and_not_on_the_first_reset():
    env = make_env(4, curriculum__enabled=True)
    env.reset()
    assert env.curriculum.level.tolist() == [0.0] * 4 and (env.terrain.infill == 1.0).all()
    env.curriculum.update(torch.arange(4), torch.tensor([0.9, 0.3, 0.0, torch.nan]))
    assert env.curriculum.level.tolist() == pytest.approx([0.2, 0.0, 0.0, 0.0])
    assert env.terrain.infill.tolist() == pytest.approx([0.98, 1, 1, 1])
    assert env.terrain.height_range.tolist() == pytest.approx([0.01, 0, 0, 0])


def test_the_environment_adopts_the_targets_of_a_rewritten_goal():
    env = make_env(3)
    td = env.reset()
    for _ in range(12):
        td = env.step(td.set("action", torch.zeros(3, 15)))["next"]
    position, following = env.targets.position.clone(), env.targets.following.clone()
    yaw = float(td["yaw"][1])
    wish = torch.tensor([0.31, -0.12])  # in the world, for FR of world 1; and the first following target of world 2
    goal = td["goal"].clone()
    offset = wish - td["feet"][1, 1]
    turn = torch.tensor([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]], dtype=torch.float32)
    goal[1, 2:4] = turn @ offset
    goal[2, 8] += 0.05
    after = env.step(td.set("goal", goal).set("action", torch.zeros(3, 15)))["next"]
    assert torch.allclose(env.targets.position[1, 1], wish, atol=1e-6)
    assert not torch.equal(env.targets.following[2, 0], following[2, 0])
    untouched = torch.ones(3, 4, dtype=torch.bool)
    untouched[1, 1] = False
    assert torch.equal(env.targets.position[untouched], position[untouched]), "bit by bit"
    assert torch.equal(env.targets.following[:2], following[:2]) and torch.equal(
        env.targets.following[2, 1], following[2, 1]
    )
    yaw = float(after["yaw"][1])
    turn = torch.tensor([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]], dtype=torch.float32)
    assert torch.allclose(after["goal"][1, 2:4], turn @ (wish - after["feet"][1, 1]), atol=1e-6)


def test_goals_written_in_place_or_not_finite():
    env, twin = make_env(2), make_env(2)
    td, same = env.reset(), twin.reset()
    for _ in range(3):
        td = env.step(td.set("action", torch.zeros(2, 15)))["next"]
        same = twin.step(same.set("action", torch.zeros(2, 15)))["next"]
    td["goal"][0, 2] += 0.1
    td["goal"][1, 2] = float("nan")
    position = env.targets.position.clone()
    env.step(td.set("action", torch.zeros(2, 15)))
    moved = (env.targets.position - position).norm(dim=-1)
    assert moved[0, 1] == pytest.approx(0.1, abs=1e-6) and moved.sum() == moved[0, 1], (
        "written in place counts, NaN does not"
    )
    assert torch.isfinite(env.targets.position).all()


def test_footholds_are_the_targets_hit_last():
    env = make_env(2, targets__max_step=0.02, targets__max_shift=0.04)
    generator = torch.Generator().manual_seed(0)
    td = env.reset()
    expected = env.targets.position.clone()
    expected[:] = env.nominal_feet
    for _ in range(60):
        position = env.targets.position.clone()
        td = env.step(td.set("action", trot(env, generator)))["next"]
        for w in range(2):
            if bool(td["events", "pair_hit"][w]):
                expected[w] = position[w]
        assert torch.equal(td["footholds"], expected)
    assert int(td["pair"].min()) > 2


def test_a_world_has_the_same_terrain_and_targets_in_any_batch():
    """Terrain, targets and, on the native engine, the whole course follow from the seed and the world's number."""
    big, small = make_env(64), make_env(32)
    numbers = torch.arange(40, 72)
    small.terrain.assign(numbers, torch.full((32,), 0.9), torch.full((32,), 0.05))
    big.terrain.assign(torch.arange(8, 72), torch.full((64,), 0.9), torch.full((64,), 0.05))
    courses = []
    for env, part in ((big, slice(32, 64)), (small, slice(0, 32))):
        env.set_seed(4)
        td = env.reset()
        courses.append([])
        for k in range(80):
            action = torch.sin(torch.arange(15) * 1.7 + 0.3 * k).expand(env.num_envs, -1) * 0.4
            td = env.step(td.set("action", action))["next"]
            courses[-1].append(torch.cat([td["goal"], td["scan"], td["proprioception"]], -1)[part])
    assert torch.equal(torch.stack(courses[0]), torch.stack(courses[1]))
