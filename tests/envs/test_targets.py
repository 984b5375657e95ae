"""The target sequence: ranges, alternation, ramp, advance and stay."""

import math

import pytest
import torch

from quadhrl.envs.targets import FootstepTargets, TargetConfig
from quadhrl.errors import InputError
from quadhrl.sim import BlockTerrain, TerrainConfig

NOMINAL = torch.tensor([[0.2134, 0.1494], [0.2135, -0.1493], [-0.2694, 0.1495], [-0.2693, -0.1492]])


def make(num_worlds=2000, terrain=None, **settings):
    if terrain is None:
        terrain = BlockTerrain(TerrainConfig(), num_worlds)
        terrain.key.copy_(torch.arange(num_worlds))  # all that the targets need, and far quicker than `regenerate`
    targets = FootstepTargets(TargetConfig(**settings), NOMINAL, terrain)
    targets.reset(torch.arange(num_worlds))
    return targets


def test_first_pair_is_fr_and_rl_on_nominal_places():
    targets = make(4)
    assert targets.active.tolist() == [[False, True, True, False]] * 4
    assert targets.stance_feet.tolist() == [[0, 3]] * 4
    assert torch.allclose(targets.position, NOMINAL.expand(4, -1, -1)), "pair 1 has no displacement and no shift yet"


def test_pairs_alternate_and_feet_keep_what_they_hit():
    targets = make(3)
    for index in range(1, 8):
        before, following = targets.position.clone(), targets.following.clone()
        hit = torch.tensor([True, True, False])
        targets.advance(hit)
        active = [1, 2] if index % 2 else [0, 3]
        stance = [0, 3] if index % 2 else [1, 2]
        assert targets.index.tolist() == [index + 1, index + 1, 1]
        assert torch.equal(targets.position[:2, active], before[:2, active])
        assert torch.equal(targets.position[:2, stance], following[:2])
        assert torch.equal(targets.position[2], before[2]) and torch.equal(targets.following[2], following[2])


def test_sequence_is_nominal_plus_steps_plus_ramped_shifts():
    targets = make()
    step = targets._step.clone()
    for k in range(1, 20):
        pair = [1, 2] if k % 2 else [0, 3]
        offset = targets.position[:, pair] - NOMINAL[pair] - ((k - 1) * step)[:, None]
        limit = 0.1 * min(k - 1, 9) / 9
        assert offset.abs().max().item() == pytest.approx(limit, rel=0.01, abs=1e-5)
        assert offset.mean().abs() < 0.01
        targets.advance(torch.ones(len(step), dtype=torch.bool))


def test_step_lengths_and_headings_fill_their_ranges():
    targets = make(20000, lateral_ratio=1.0)
    length, heading = targets._step.norm(dim=-1), torch.atan2(targets._step[:, 1], targets._step[:, 0])
    assert length.max() <= 0.2 and length.mean().item() == pytest.approx(0.1, abs=0.002)
    assert heading.abs().max().item() == pytest.approx(math.pi, abs=0.01) and heading.mean().abs() < 0.05


def test_sideways_steps_are_shorter_by_the_ellipse():
    targets = make(20000)
    forward = targets._step[targets._step[:, 1].abs() < 0.02 * targets._step[:, 0].abs()]
    sideways = targets._step[targets._step[:, 0].abs() < 0.02 * targets._step[:, 1].abs()]
    assert forward.norm(dim=-1).max().item() == pytest.approx(0.2, rel=0.03)
    assert sideways.norm(dim=-1).max().item() == pytest.approx(0.2 * 0.33, rel=0.05)


def test_partial_reset_leaves_other_worlds():
    targets = make(4)
    targets.advance(torch.ones(4, dtype=torch.bool))
    before = targets.position.clone()
    targets.reset(torch.tensor([2]))
    assert torch.equal(targets.position[[0, 1, 3]], before[[0, 1, 3]]) and targets.index.tolist() == [2, 2, 1, 2]


def test_in_place_targets():
    targets = make(4, max_step=0.0, max_shift=0.0)
    for _ in range(5):
        targets.advance(torch.ones(4, dtype=torch.bool))
    assert torch.allclose(targets.position, NOMINAL.expand(4, -1, -1))


@pytest.mark.parametrize(
    ("field", "value"), [("max_step", -0.1), ("ramp_pairs", 0), ("lateral_ratio", 0.0), ("max_heading", 200.0)]
)
def test_bad_settings_are_named(field, value):
    with pytest.raises(InputError, match=field.replace("_", "-")):
        make(1, **{field: value})


def test_targets_on_blocks_differ_only_where_there_is_a_gap():
    everyone = torch.ones(300, dtype=torch.bool)
    terrain, gaps = BlockTerrain(TerrainConfig(infill=0.7), 300), 0
    terrain.regenerate(torch.arange(300))
    free, moved = (make(300, terrain, on_blocks=on) for on in (False, True))
    for _ in range(40):
        drawn, placed = free.position, moved.position
        gap = terrain.over_gap(drawn)
        assert torch.equal(placed[~gap], drawn[~gap])
        assert not terrain.over_gap(placed).any()
        assert (placed - drawn).norm(dim=-1).max() < 0.2
        gaps += int(gap.sum())
        free.advance(everyone)
        moved.advance(everyone)
    assert gaps > 5000
