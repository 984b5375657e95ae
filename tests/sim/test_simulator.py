"""Both engines against plain `mujoco.mj_step`, against each other, and under abuse."""

import mujoco
import numpy as np
import pytest
import torch

from quadhrl.errors import InputError
from quadhrl.sim import Fault

ENGINES = ("native", "warp")


def stance(sim):
    return sim._home[7:].float().expand(sim.num_worlds, -1)


def noisy_controls(sim, steps, scale=0.15, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return [stance(sim) + scale * torch.randn(sim.num_worlds, 12, generator=generator) for _ in range(steps)]


def blocks_of(sim, world):
    model = sim.batch.get_model(world)
    return {name: getattr(model, name).copy() for name in ("geom_pos", "geom_size", "bvh_aabb")}


@pytest.mark.parametrize("engine", ENGINES)
def test_stands_for_five_seconds(make_sim, engine):
    sim = make_sim(2, engine=engine)
    for _ in range(300):
        readings = sim.step(stance(sim))
    assert (readings.base_position[:, 2] > 0.38).all()
    assert (readings.base_quaternion[:, 0] > 0.99).all()
    assert readings.base_velocity.norm(dim=-1).max() < 0.02
    assert readings.foot_force[..., 2].sum(-1).numpy() == pytest.approx(20.637 * 9.81, rel=0.01)
    assert (readings.collisions == 0).all() and (sim.fault_counts == 0).all()


def test_native_engine_is_bit_equal_to_mj_step(make_sim):
    sim = make_sim(3, infill=0.9, height_range=0.05)
    models = [sim.batch.get_model(world) for world in range(3)]
    datas = [mujoco.MjData(model) for model in models]
    for data in datas:
        data.qpos[:], data.ctrl[:] = sim.scene.home, sim.scene.home[7:]

    for control in noisy_controls(sim, 120):
        for world, model in enumerate(models):
            for name, value in blocks_of(sim, world).items():
                getattr(model, name)[:] = value
        readings = sim.step(control)
        for world, (model, data) in enumerate(zip(models, datas, strict=True)):
            data.ctrl[:] = control[world].numpy().astype(np.float64)
            for _ in range(sim.scene.physics.substeps):
                mujoco.mj_step(model, data)
            assert np.array_equal(sim.qpos[world].numpy(), data.qpos)
            assert np.array_equal(sim.qvel[world].numpy(), data.qvel)
    for world, (model, data) in enumerate(zip(models, datas, strict=True)):
        forces = np.zeros((4, 3))
        links = set()
        for k, contact in enumerate(data.contact):
            local = np.zeros(6)
            mujoco.mj_contactForce(model, data, k, local)
            force = contact.frame.reshape(3, 3).T @ local[:3]
            for geom, sign in zip(contact.geom, (-1, 1), strict=True):
                if geom in sim.scene.feet:
                    forces[list(sim.scene.feet).index(geom)] += sign * force
                elif geom not in sim.scene.blocks:
                    links.add(model.geom_bodyid[geom])
        assert readings.foot_force[world].numpy() == pytest.approx(forces, abs=1e-3)
        assert readings.collisions[world] == len(links)
        assert readings.joint_torque[world].numpy() == pytest.approx(data.actuator_force, abs=1e-4)
        mujoco.mj_forward(model, data)  # feet: fresh, not one substep behind
        feet = sim.scene.feet
        assert readings.foot_position[world].numpy() == pytest.approx(data.geom_xpos[feet], abs=1e-6)
        velocity = np.zeros(6)
        for foot in range(4):
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_GEOM, feet[foot], velocity, 0)
            assert readings.foot_velocity[world, foot].numpy() == pytest.approx(velocity[3:], abs=1e-5)


def test_warp_follows_native(make_sim):
    """Same states, same controls, 2 s on rough terrain.

    Warp computes in float32 (and its Newton solver stops at 1e-6), native in float64. Contact makes the difference grow, so
    the bound is tight for the first steps, where it is rounding alone, and loose at the end.
    """
    native, warp = (make_sim(8, engine=engine, infill=0.9, height_range=0.05) for engine in ENGINES)
    for k, control in enumerate(noisy_controls(native, 120, scale=0.1)):
        a, b = native.step(control), warp.step(control)
        position = (a.base_position - b.base_position).abs().amax().item()
        joints = (a.joint_position - b.joint_position).abs().amax().item()
        assert position < (1e-5 if k < 10 else 5e-3) and joints < (1e-4 if k < 10 else 5e-2), k
        if k < 10:
            assert (a.foot_position - b.foot_position).abs().amax() < 1e-5
            assert (a.foot_velocity - b.foot_velocity).abs().amax() < 5e-3
            assert (a.foot_force - b.foot_force).abs().amax() < 0.5  # N, of some 50
            assert (a.joint_torque - b.joint_torque).abs().amax() < 2e-2
            assert torch.equal(a.collisions, b.collisions)


@pytest.mark.parametrize("engine", ENGINES)
def test_collisions_count_links_not_contacts(make_sim, engine):
    """A robot dropped on its belly: some links touch, and the count is that of plain MuJoCo's contacts."""
    sim = make_sim(1, engine=engine)
    qpos = sim._home[None].clone()
    qpos[0, 2] = 0.3
    sim.reset(torch.tensor([0]), qpos)
    readings = sim.step(qpos[:, 7:].float())
    assert readings.collisions[0] >= 1
    model, data = sim.scene.model, mujoco.MjData(sim.scene.model)
    data.qpos[:], data.ctrl[:] = qpos[0].numpy(), qpos[0, 7:].numpy()
    for _ in range(2):
        mujoco.mj_step(model, data)
    touched = {model.geom_bodyid[g] for c in data.contact for g in c.geom if g not in sim.scene.feet}
    assert readings.collisions[0] == len(touched - {0})


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("abuse", ["nan", "fast"])
def test_a_broken_world_is_flagged_reset_and_counted_alone(make_sim, engine, abuse):
    sim, reference = make_sim(4, engine=engine), make_sim(4, engine=engine)
    controls = noisy_controls(sim, 20)
    for k, control in enumerate(controls):
        if k == 10:
            sim.qvel[2] = float("nan") if abuse == "nan" else 1e3
        readings, expected = sim.step(control), reference.step(control)
        others = [0, 1, 3]
        assert torch.equal(sim.qpos[others], reference.qpos[others])
        assert torch.equal(readings.foot_force[others], expected.foot_force[others])
        kind = Fault.NONFINITE if abuse == "nan" else Fault.RUNAWAY
        broken = k == 10
        assert sim.fault.tolist()[2] in ((int(kind), int(Fault.NONFINITE)) if broken else (0,))
        assert all(torch.isfinite(value.float()).all() for value in vars(readings).values())
        if broken:
            assert readings.base_position[2].tolist() == pytest.approx([0, 0, 0.435])
            assert (readings.foot_force[2] == 0).all()
    assert sim.fault_counts.sum() == 1 and (reference.fault_counts == 0).all()


def test_warp_overflow_is_flagged_for_the_greedy_world(make_sim):
    """Room for six constraint rows: a standing robot needs sixteen."""
    sim = make_sim(2, engine="warp", njmax=6)
    for _ in range(3):
        sim.step(stance(sim))
    assert (sim.fault & Fault.OVERFLOW).bool().all()
    assert sim.fault_counts[list(Fault).index(Fault.OVERFLOW)] >= 2


def test_warp_contact_pool_overflow_warns_and_names_the_field(make_sim, caplog):
    sim = make_sim(2, engine="warp", nconmax=3)
    for _ in range(3):
        sim.step(stance(sim))
    assert "raise --physics.nconmax" in caplog.text
    assert (sim.fault & Fault.OVERFLOW == 0).all(), "the pool is shared: no single world is to blame"


@pytest.mark.parametrize("engine", ENGINES)
def test_state_round_trip_continues_exactly(make_sim, engine):
    first, second = (make_sim(3, engine=engine, infill=0.9, height_range=0.05) for _ in range(2))
    controls = noisy_controls(first, 30)
    for control in controls[:16]:  # the window has just followed the robots
        first.step(control)
    second.load_state_dict(first.state_dict())
    for control in controls[16:]:
        a, b = first.step(control), second.step(control)
        for name, value in vars(a).items():
            assert torch.equal(value, getattr(b, name)), name


@pytest.mark.parametrize("engine", ENGINES)
def test_partial_reset_leaves_the_others_untouched(make_sim, engine):
    sim, reference = make_sim(4, engine=engine), make_sim(4, engine=engine)
    for k, control in enumerate(noisy_controls(sim, 20)):
        if k == 10:
            sim.reset(torch.tensor([1, 3]))
        readings, expected = sim.step(control), reference.step(control)
        for name, value in vars(readings).items():
            assert torch.equal(value[[0, 2]], getattr(expected, name)[[0, 2]]), name


def test_window_follows_the_robot(make_sim):
    """A robot put anywhere finds ground under its feet, and falls through none."""
    sim = make_sim(6)
    qpos = sim._home.expand(6, -1).clone()
    qpos[:, :2] = torch.tensor([[0.1, 0.1], [5, 5], [-7.31, 2.2], [63.9, -12.7], [0.09, -0.11], [-100.0, 100.0]])
    sim.reset(torch.arange(6), qpos)
    for _ in range(60):
        readings = sim.step(stance(sim))
    assert (readings.base_position[:, 2] > 0.38).all()


def test_a_reset_robot_meets_its_new_ground_at_once(make_sim):
    """The first contacts after a reset must be with the boxes at the new place, not with those of the old one."""
    sim, fresh = make_sim(1), make_sim(1)
    far, low = sim._home[None].clone(), sim._home[None].clone()
    far[0, :2], low[0, 2] = 5.05, 0.42
    sim.reset(torch.tensor([0]), far)
    sim.step(stance(sim))
    for simulator in (sim, fresh):
        simulator.reset(torch.tensor([0]), low)
    assert torch.equal(sim.step(stance(sim)).qvel, fresh.step(stance(fresh)).qvel)


def test_the_default_substeps_agree_with_twice_as_many_for_a_while(make_sim):
    coarse, fine = make_sim(4), make_sim(4, substeps=8)
    for control in noisy_controls(coarse, 6, scale=0.05):
        a, b = coarse.step(control), fine.step(control)
    assert (a.base_position - b.base_position).abs().max() < 5e-3


@pytest.mark.parametrize("engine", ENGINES)
def test_ground_is_hard(make_sim, engine):
    """After a fall from 5 cm the feet sink in by less than a third of their radius: the calves stay clear of the ground."""
    sim = make_sim(1, engine=engine)
    high = sim._home[None].clone()
    high[0, 2] += 0.05
    sim.reset(torch.tensor([0]), high)
    lowest = min(sim.step(stance(sim)).foot_position[..., 2].min().item() for _ in range(30))
    assert 0.0265 - 0.009 < lowest < 0.0265


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"num_worlds": 0}, "--num-envs: got 0"),
        ({"engine": "bullet"}, "--engine: got 'bullet'"),
        ({"substeps": 0}, "--physics.substeps: got 0"),
        ({"infill": -0.5}, "--infill: got -0.5"),
    ],
)
def test_bad_arguments_are_named(make_sim, change, message):
    with pytest.raises(InputError, match=message):
        make_sim(**change)
