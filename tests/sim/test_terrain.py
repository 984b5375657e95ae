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
        points = away[world].numpy() + rng.uniform(-0.6, 0.6, size=(40, 2))
        inside = (np.abs((points / 0.2) % 1 - 0.5) < 0.36).all(1)  # a sphere beside an edge would touch two blocks
        points = points[inside]
        heights = sim.terrain.heights(torch.tensor(points, dtype=torch.float32)[None], torch.tensor([world]))[0].numpy()
        model, data = boxes_and_balls(sim, world, points, heights + 0.05)
        only_boxes = np.array([1, 0, 0, 0, 0, 0], np.uint8)
        for (x, y), height in zip(points, heights, strict=True):
            distance = mujoco.mj_ray(
                model, data, [x, y, 1.0], [0.0, 0.0, -1.0], only_boxes, 1, -1, np.zeros(1, np.int32)
            )
            assert 1.0 - distance == pytest.approx(height, abs=1e-5)
        for _ in range(300):
            mujoco.mj_step(model, data)
        resting = data.geom_xpos[-len(points) :, 2]
        assert resting == pytest.approx(heights + 0.0265, abs=2e-3)


def boxes_and_balls(sim, world, points, heights):
    """A plain MuJoCo model of the engine's boxes in that world, and foot-sized balls above the points."""
    if sim.engine == "native":
        model = sim.batch.get_model(world)
        positions, sizes = model.geom_pos[sim.scene.blocks], model.geom_size[sim.scene.blocks]
    else:
        positions, sizes = (sim._view[name][world][sim._blocks].double().numpy() for name in ("geom_xpos", "geom_size"))
    spec = mujoco.MjSpec()
    for position, size in zip(positions, sizes, strict=True):
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=size, pos=position, contype=1, conaffinity=2)
    for (x, y), height in zip(points, heights, strict=True):
        ball = spec.worldbody.add_body(pos=[x, y, height])
        ball.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 0, 1])
        ball.add_geom(
            type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.0265, 0, 0], mass=0.1, group=1, contype=2, conaffinity=1
        )  # fmt: skip
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def test_boxes_never_show_beyond_their_block(make_sim):
    """The overlap that closes the seams must be hidden: rays close to every edge, on steps and gaps."""
    sim = make_sim(1, infill=0.7, height_range=0.1, seed=5)
    model, data = boxes_and_balls(sim, 0, np.zeros((0, 2)), np.zeros(0))
    edges = np.arange(-6, 7) * 0.1 + np.repeat([[-0.004], [0.004]], 13, 1)
    points = np.array([[x, y] for x in edges.ravel() for y in edges.ravel()])
    heights = sim.terrain.heights(torch.tensor(points, dtype=torch.float32)[None])[0].numpy()
    assert (heights == -2).any() and len(np.unique(heights)) > 20
    for (x, y), height in zip(points, heights, strict=True):
        distance = mujoco.mj_ray(model, data, [x, y, 1.0], [0.0, 0.0, -1.0], None, 1, -1, np.zeros(1, np.int32))
        assert 1.0 - distance == pytest.approx(height, abs=1e-5), (x, y)


@pytest.mark.parametrize("engine", ["native", "warp"])
def test_feet_do_not_sink_into_the_seams_of_level_ground(make_sim, engine):
    """A robot stamping on the corner of four blocks; before the overlap, a fifth of such feet sat 10 cm deep."""
    sim = make_sim(16, engine=engine)
    stance = sim._home[7:].float().expand(16, -1)
    generator = torch.Generator().manual_seed(0)
    lowest = min(
        sim.step(stance + 0.2 * torch.randn(16, 12, generator=generator)).foot_position[..., 2].min().item()
        for _ in range(120)
    )
    assert lowest > -0.03


def test_nearest_ground_against_a_search_over_fine_points():
    terrain = everywhere(BlockTerrain(TerrainConfig(infill=0.5), 2, seed=3))
    random = torch.Generator().manual_seed(0)
    xy = 2.0 * torch.rand(2, 200, 2, generator=random) + 1.0
    side = torch.arange(-0.2, 0.2, 0.004)
    around = xy[:, :, None] + torch.cartesian_prod(side, side)  # [2, 200, 10000, 2]
    distance = (around - xy[:, :, None]).norm(dim=-1).masked_fill(terrain.over_gap(around), torch.inf).amin(-1)
    found = terrain.nearest_ground(xy)
    gap = terrain.over_gap(xy)
    assert torch.equal(found[~gap], xy[~gap])
    reachable = gap & distance.isfinite()
    assert reachable.sum() > 100 and not terrain.over_gap(found)[reachable].any()
    moved = (found - xy).norm(dim=-1)
    assert (moved - distance)[reachable].abs().max() < 0.006, "the points are 4 mm apart"


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
