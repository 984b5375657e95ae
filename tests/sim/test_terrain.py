"""Block terrain: what `heights` says is what a ray and a dropped sphere meet."""

import mujoco
import numpy as np
import pytest
import torch

from quadhrl.errors import InputError
from quadhrl.sim import BlockTerrain, TerrainConfig

INFILLS, HEIGHT_RANGES = (1.0, 0.9, 0.8), (0.0, 0.05, 0.075, 0.1)


def everywhere(terrain):
    terrain.regenerate(torch.arange(terrain.num_worlds))
    return terrain


def all_blocks(terrain):
    side = torch.arange(terrain.PERIOD)
    blocks = torch.stack(torch.meshgrid(side, side, indexing="ij"), -1)
    return terrain.block_heights(blocks.expand(terrain.num_worlds, -1, -1, -1)).flatten(1)


@pytest.mark.parametrize("infill", INFILLS)
@pytest.mark.parametrize("height_range", HEIGHT_RANGES)
def test_share_of_gaps_and_spread_of_heights(infill, height_range):
    terrain = everywhere(BlockTerrain(TerrainConfig(infill=infill, height_range=height_range), 8))
    heights = all_blocks(terrain)
    gaps = heights == -2.0
    assert gaps.float().mean().item() == pytest.approx(1 - infill, abs=0.01)
    tops = heights[~gaps]
    assert tops.abs().max() <= height_range / 2
    assert tops.std().item() == pytest.approx(height_range / 12**0.5, rel=0.03, abs=1e-9)


def test_worlds_differ_and_the_same_seed_gives_the_same_terrain():
    config = TerrainConfig()
    first, again = (all_blocks(everywhere(BlockTerrain(config, 4, seed=7))) for _ in range(2))
    assert torch.equal(first, again)
    assert not torch.equal(first[0], first[1])
    other = all_blocks(everywhere(BlockTerrain(config, 4, seed=8)))
    assert not torch.equal(first, other)
    fewer = all_blocks(everywhere(BlockTerrain(config, 2, seed=7)))
    assert torch.equal(fewer, first[:2]), "a world's terrain must not depend on how many worlds there are"


def test_next_episode_brings_another_terrain_to_that_world_only():
    terrain = everywhere(BlockTerrain(TerrainConfig(), 3))
    before = all_blocks(terrain)
    terrain.regenerate(torch.tensor([1]))
    after = all_blocks(terrain)
    assert torch.equal(before[[0, 2]], after[[0, 2]]) and not torch.equal(before[1], after[1])


def test_start_platform_is_level_and_without_gaps():
    terrain = everywhere(BlockTerrain(TerrainConfig(infill=0.0, height_range=0.1), 1))
    side = torch.linspace(-0.99, 0.99, 100)
    xy = torch.stack(torch.meshgrid(side, side, indexing="ij"), -1)[None]
    inside = (xy[..., 0].abs() < 0.4) & (xy[..., 1].abs() < 0.2)
    assert torch.equal(terrain.heights(xy), torch.where(inside, 0.0, -2.0))


def test_per_world_difficulty():
    terrain = BlockTerrain(TerrainConfig(), 2)
    terrain.infill[:] = torch.tensor([1.0, 0.5])
    terrain.height_range[:] = torch.tensor([0.0, 0.2])
    heights = all_blocks(everywhere(terrain))
    assert (heights[0] == 0).all()
    assert (heights[1] == -2).float().mean().item() == pytest.approx(0.5, abs=0.03)


@pytest.mark.parametrize("engine", ["native", "warp"])
@pytest.mark.parametrize("infill", INFILLS)
@pytest.mark.parametrize("height_range", HEIGHT_RANGES)
def test_blocks_in_the_engine_are_where_heights_says(make_sim, engine, infill, height_range):
    """Vertical rays and dropped foot spheres against the boxes of either engine, far from the origin."""
    sim = make_sim(3, engine=engine, infill=infill, height_range=height_range, seed=3)
    away = torch.tensor([[3.33, -2.71], [-8.2, 0.4], [20.05, 31.4]])
    qpos = sim._home.expand(3, -1).clone()
    qpos[:, :2] = away.to(qpos)
    sim.reset(torch.arange(3), qpos)
    rng = np.random.default_rng(1)
    for world in range(3):
        model, data = geoms_of(sim, world)
        points = away[world].numpy() + rng.uniform(-0.65, 0.65, size=(40, 2))
        points = points[
            (np.abs((points / 0.2) % 1 - 0.5) < 0.36).all(1)
        ]  # a sphere beside an edge would touch two blocks
        heights = sim.terrain.heights(torch.tensor(points, dtype=torch.float32)[None], torch.tensor([world]))[0].numpy()
        for (x, y), height in zip(points, heights, strict=True):
            geom = np.zeros(1, np.int32)
            distance = mujoco.mj_ray(model, data, [x, y, 1.0], [0.0, 0.0, -1.0], None, 1, -1, geom)
            assert geom[0] in sim.scene.blocks
            assert 1.0 - distance == pytest.approx(height, abs=1e-5)
        dropped = drop_spheres(model, points, heights)
        assert dropped == pytest.approx(heights + 0.0265, abs=2e-3)


def geoms_of(sim, world):
    """A plain MuJoCo model without the robot, its boxes where the engine has them in that world."""
    spec = mujoco.MjSpec()
    for k in range(len(sim.scene.blocks)):
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.1, 0.1, 1.0], name=f"block_{k}")
    model = spec.compile()
    if sim.engine == "native":
        position = sim.batch.get_model(world).geom_pos[sim.scene.blocks]
    else:
        position = sim._view["geom_xpos"][world][sim._blocks].numpy()
    model.geom_pos[:] = position
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    sim.scene.blocks.sort()
    data_ids = {"offset": sim.scene.blocks[0]}
    assert data_ids["offset"] == 0, "the blocks are the model's first geoms, so the ids agree"
    return model, data


def drop_spheres(model, points, heights):
    """Height at which a foot-sized sphere comes to rest on the boxes, one drop per point."""
    rest = []
    for (x, y), height in zip(points, heights, strict=True):
        spec = mujoco.MjSpec()
        for position in model.geom_pos[np.linalg.norm(model.geom_pos[:, :2] - [x, y], axis=1) < 0.3]:
            spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.1, 0.1, 1.0], pos=position)
        ball = spec.worldbody.add_body(pos=[x, y, height + 0.03])
        ball.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 0, 1])
        ball.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.0265, 0, 0], mass=0.1)
        dropped = spec.compile()
        data = mujoco.MjData(dropped)
        for _ in range(300):
            mujoco.mj_step(dropped, data)
        rest.append(data.geom_xpos[-1, 2])
    return np.array(rest)


@pytest.mark.parametrize(
    ("field", "value", "flag"),
    [
        ("infill", -0.1, "--infill"),
        ("infill", 1.5, "--infill"),
        ("height_range", -0.01, "--height-range"),
        ("block_size", 0.0, "block-size"),
        ("gap_depth", 0.1, "gap-depth"),
        ("platform_width", -1.0, "platform-width"),
    ],
)
def test_bad_settings_are_named(field, value, flag):
    with pytest.raises(InputError, match=flag):
        BlockTerrain(TerrainConfig(**{field: value}), 1)
