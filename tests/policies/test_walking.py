"""What the high-level policy makes robots do on level ground, with the shipped low-level policy and with a scripted one."""

import math

import pytest
import torch
from states import make_env, trained_networks, walk

from quadhrl.policies import HighLevelConfig, HighLevelPolicy


@pytest.fixture(scope="module")
def networks():
    return trained_networks()


def strides(env, hlp, networks, steps):
    """Displacements of the next pair's chosen targets from the same feet's last ones, from step 70 on [T, N, 2, 2]."""
    seen = []

    def note(_env, td):
        if int(td["events", "step_count"][0]) >= 70:
            pair = hlp.pairs[td["pair"][:, 0] % 2]
            last = td["footholds"].gather(1, pair[..., None].expand(-1, -1, 2))
            seen.append(td["targets"][:, 0] - last)

    rollout = walk(env, steps, networks, hlp, note)
    return torch.stack(seen), rollout


def test_it_walks_forward_with_strides_at_the_grids_edge(networks):
    env = make_env(2, infill=1.0, height_range=0.0)
    hlp = HighLevelPolicy(networks.value())
    chosen, rollout = strides(env, hlp, networks, 260)
    assert chosen[..., 0].median().item() == pytest.approx(0.15, abs=0.01)  # the authors' median: 0.157 m
    assert not rollout["next", "done"].any()
    speed = env.sim.readings.base_position[:, 0] / (260 / 60)
    assert (speed > 0.2).all(), speed


def test_without_the_directional_term_it_hardly_gets_anywhere(networks):
    """The value alone has no reason to go far; that of the shipped policy likes small steps forward."""
    distance = {}
    for weight in (0.0, 50.0):
        env = make_env(2, infill=1.0, height_range=0.0)
        walk(env, 260, networks, HighLevelPolicy(networks.value(), HighLevelConfig(direction_weight=weight)))
        distance[weight] = env.sim.readings.base_position[:, :2].norm(dim=-1)
    assert (distance[0.0] < 0.5 * distance[50.0]).all(), distance


def test_it_walks_sideways_and_turns_when_the_heading_changes(networks):
    """Two worlds with headings of their own, exchanged in mid-run, with the square box of the paper's text.

    The default box, a third as wide as long, allows 0.15 m/s sideways; the value's own wish for steps forward or backward is of
    the same size there.
    """
    env = make_env(2, infill=1.0, height_range=0.0)
    hlp = HighLevelPolicy(networks.value(), HighLevelConfig(lateral_ratio=1.0))
    hlp.direction.heading = torch.tensor([math.pi / 2, 0.0])
    halfway = []

    def turn(_env, td):
        if int(td["events", "step_count"][0]) == 250:
            halfway.append(env.sim.readings.base_position[:, :2].clone())
            hlp.direction.heading = torch.tensor([0.0, math.pi / 2])

    walk(env, 460, networks, hlp, turn)
    first = halfway[0]
    second = env.sim.readings.base_position[:, :2] - first
    assert first[0, 1] > 0.6 and first[0, 1] > 1.5 * first[0, 0].abs(), "mostly to the left"
    assert first[1, 0] > 0.6 and first[1, 0] > 1.5 * first[1, 1].abs(), "mostly forward"
    assert second[0, 0] > 0.6 and second[0, 0] > 1.5 * second[0, 1].abs(), "now forward"
    assert second[1, 1] > 0.6 and second[1, 1] > 1.5 * second[1, 0].abs(), "now to the left"
