"""The high-level policy against brute force, finite differences and hand-made numbers, and as a TorchRL citizen."""

import itertools
import math

import numpy as np
import pytest
import torch
from states import make_env, numpy_value, random_networks, recorded_states, trained_networks, walk
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.collectors import Collector

from quadhrl.errors import InputError
from quadhrl.policies import Direction, HighLevelConfig, HighLevelPolicy, ObjectiveTerm, PairTargets
from quadhrl.policies import high_level as high_level_module
from quadhrl.policies.goal_search import SEARCHES
from quadhrl.policies.high_level import GridProblem

ACTIVE = {0: [0, 3], 1: [1, 2]}


@pytest.fixture(scope="module")
def states():
    return recorded_states()


@pytest.fixture(scope="module")
def networks():
    return trained_networks()


def problem(networks, states, **settings):
    return GridProblem(HighLevelPolicy(networks.value(), HighLevelConfig(**settings)), states)


def brute_force(networks, state, resolution, kappa=50.0, heading=0.0):
    """Every grid point by hand: targets in the world, goal as the robot sees it, numpy critic, eq. 11 with both pairs."""
    active = ACTIVE[int(state["pair"]) % 2]
    stance = ACTIVE[1 - int(state["pair"]) % 2]
    feet, footholds = state["feet"].double().numpy(), state["footholds"].double().numpy()
    yaw = float(state["yaw"])
    turn = np.array([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]])  # world -> robot
    goal = state["goal"].double().numpy()
    ticks = np.linspace(-1, 1, resolution)
    offsets = np.array(list(itertools.product(ticks, repeat=4))).reshape(-1, 2, 2) * 0.15 * np.array([1.0, 0.33])
    goals = np.tile(goal, (len(offsets) ** 2, 1))
    direction = np.array([math.cos(heading), math.sin(heading)])
    score = np.zeros(len(goals))
    first = np.repeat(np.arange(len(offsets)), len(offsets))
    second = np.tile(np.arange(len(offsets)), len(offsets))
    for k in (0, 1):
        to_next = footholds[active[k]] + offsets[first, k] - feet[active[k]]
        to_following = footholds[stance[k]] + 2 * offsets[second, k] - feet[stance[k]]
        goals[:, 2 * active[k] : 2 * active[k] + 2] = to_next @ turn.T
        goals[:, 8 + 2 * k : 10 + 2 * k] = to_following @ turn.T
        score += kappa * (to_next @ direction + 2 * to_following @ direction)
    values = np.concatenate([numpy_value(networks, state, part) for part in np.array_split(goals, 40)])
    return values + score, (first, second), offsets, (active, stance)


@pytest.mark.parametrize("kind", ["trained", "random"])
def test_naive_and_exact_search_find_the_brute_force_maximum_of_all_390625_points(states, kind):
    networks = trained_networks() if kind == "trained" else random_networks()
    state = states[:1]
    objective, (first, second), offsets, (active, stance) = brute_force(networks, state[0], 5)
    assert len(objective) == 390_625
    best = int(objective.argmax())
    footholds = state[0]["footholds"].numpy()
    expected = np.stack([footholds[active] + offsets[first[best]], footholds[stance] + 2 * offsets[second[best]]])
    for search in ("naive", "exact"):
        with torch.no_grad():
            found = problem(networks, state, search=search).search()
        assert found[0].numpy() == pytest.approx(expected, abs=1e-6), search
    solved = problem(networks, state, search="exact")
    assert float(solved.objective(solved.search())) == pytest.approx(objective.max(), abs=2e-2)


def test_the_searches_agree_on_states_of_the_trained_critic(networks, states):
    with torch.no_grad():
        exact, alternating = (problem(networks, states, search=name) for name in ("exact", "alternating"))
        gap = exact.objective(exact.search()) - alternating.objective(alternating.search())
    assert gap.abs().max() < 1.0, "a fall-back of the alternating search, if any, is small"
    assert (gap < 1e-3).sum() >= len(states) - 1


def test_alternating_search_does_not_depend_on_the_other_worlds(networks, states):
    with torch.no_grad():
        together = problem(networks, states).search()
        for k in range(0, len(states), 2):
            assert torch.equal(problem(networks, states[k : k + 2]).search(), together[k : k + 2])


@pytest.mark.parametrize("pairs", ["both", "active"])
def test_gradient_equals_finite_differences_and_is_each_worlds_own(networks, states, pairs):
    solved = problem(networks, states, pairs=pairs, confine=False, ascent_rate=1e-4, ascent_steps=1, resolution=3)
    start = solved.search()
    step = solved.ascent(start)[1][0] - start
    # finite differences of the numpy critic, one world at a time
    for w, state in enumerate(states[:3]):
        active, stance = ACTIVE[int(state["pair"]) % 2], ACTIVE[1 - int(state["pair"]) % 2]
        feet, yaw, goal = state["feet"].double().numpy(), float(state["yaw"]), state["goal"].double().numpy()
        turn = np.array([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]])

        def objective(targets, state=state, feet=feet, turn=turn, goal=goal, active=active, stance=stance):
            full, score = goal.copy(), 0.0
            for k in (0, 1):
                to_next, to_following = targets[0, k] - feet[active[k]], targets[1, k] - feet[stance[k]]
                full[2 * active[k] : 2 * active[k] + 2], full[8 + 2 * k : 10 + 2 * k] = (
                    turn @ to_next,
                    turn @ to_following,
                )
                score += 50.0 * (to_next[0] + 2 * to_following[0])
            return numpy_value(networks, state, full[None])[0] + score

        point, h = start[w].double().numpy(), 1e-5
        for index in np.ndindex(2, 2, 2):
            if pairs == "active" and index[0] == 1:
                assert step[(w, *index)] == 0.0
                continue
            bump = np.zeros((2, 2, 2))
            bump[index] = h
            slope = (objective(point + bump) - objective(point - bump)) / (2 * h)
            assert float(step[(w, *index)]) / 1e-4 == pytest.approx(slope, rel=0.02, abs=0.3)


@pytest.mark.parametrize("confine", [True, False])
def test_ascent_at_the_edge_of_the_box(networks, states, confine):
    """Confined, a target slides along the box's edge; not confined, it leaves the box. Never is the result worse."""
    solved = problem(networks, states, confine=confine, ascent_steps=5, ascent_rate=1e-4)
    start = solved.search()
    best, objective = solved.ascend(start)
    assert (objective >= solved.objective(start).detach() - 1e-4).all()
    half = torch.tensor([[0.15, 0.0495], [0.30, 0.099]])[:, None]
    outside = ((best - solved.centre).abs() - half).clamp(min=0.0)
    assert (outside.max() < 1e-6) == confine
    if not confine:
        assert 0.005 < outside.max() < 0.2


def test_a_reckless_ascent_falls_back_to_the_grid(networks, states):
    solved = problem(networks, states, confine=False, ascent_rate=1.0, ascent_steps=3, direction_weight=0.0)
    start = solved.search()
    best, objective = solved.ascend(start)
    at_start = solved.objective(start).detach()
    assert (objective >= at_start).all()
    lost = objective == at_start
    assert lost.any() and torch.equal(best[lost], start[lost])


def test_grid_start_beats_random_starts_on_average(networks, states):
    """The paper's lemma, on the trained critic."""
    solved = problem(networks, states)
    with torch.no_grad():
        grid = solved.objective(solved.search())
        torch.manual_seed(0)
        half = torch.tensor([[0.15, 0.0495], [0.30, 0.099]])[:, None]
        random = torch.stack(
            [solved.objective(solved.centre + half * (2 * torch.rand_like(solved.centre) - 1)) for _ in range(200)]
        )
    assert (grid > random.mean(0)).all() and (grid >= random.max(0).values).all()


@pytest.mark.parametrize("yaw", [0.0, 0.4, -2.1, math.pi / 2])
@pytest.mark.parametrize("alpha", [0.0, 1.0])
def test_directional_term_is_equation_11(yaw, alpha):
    p_a, p_b = (0.10, -0.03), (0.07, 0.02)
    rotated = [(math.cos(yaw) * x - math.sin(yaw) * y, math.sin(yaw) * x + math.cos(yaw) * y) for x, y in (p_a, p_b)]
    by_hand = sum(math.cos(alpha) * x + math.sin(alpha) * y for x, y in rotated)
    vector = torch.tensor([[[p_a, p_b]]])
    for following, factor in ((False, 1.0), (True, 2.0)):
        targets = PairTargets(torch.zeros(1, 1, 2, 2), vector, torch.tensor([yaw]), slice(0, 1), following)
        assert Direction(50.0, 2.0, alpha)(targets).item() == pytest.approx(50 * factor * by_hand, abs=1e-4)


def test_heading_per_world_reaches_the_right_worlds(networks, states, monkeypatch):
    many = torch.cat([states, states])
    hlp = HighLevelPolicy(networks.value(), HighLevelConfig(resolution=3, direction_weight=5000.0))
    hlp.direction.heading = torch.arange(12.0)
    whole = hlp(many.clone())["targets"]
    monkeypatch.setattr(high_level_module, "WORLDS_AT_ONCE", 5)
    assert torch.allclose(hlp(many.clone())["targets"], whole, atol=1e-4), "the memory bound changes nothing"
    for k in range(12):
        hlp.direction.heading = torch.tensor(float(k))
        assert torch.allclose(hlp(many.clone())["targets"][k], whole[k], atol=1e-4)


def test_any_batch_shape_goes(networks, states):
    hlp = HighLevelPolicy(networks.value(), HighLevelConfig(resolution=3))
    flat = hlp(states.clone())
    folded = hlp(states.clone().reshape(2, 3))
    assert folded["targets"].shape == (2, 3, 2, 2, 2)
    assert torch.equal(folded["goal"].reshape(6, 12), flat["goal"])


def test_targets_and_goal_say_the_same(networks, states):
    out = HighLevelPolicy(networks.value(), HighLevelConfig(resolution=3))(states.clone())
    for state, goal, targets in zip(states, out["goal"], out["targets"], strict=True):
        active, stance = ACTIVE[int(state["pair"]) % 2], ACTIVE[1 - int(state["pair"]) % 2]
        yaw = float(state["yaw"])
        turn = torch.tensor([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]])
        for k in (0, 1):
            assert torch.allclose(
                goal.view(6, 2)[active[k]], turn @ (targets[0, k] - state["feet"][active[k]]), atol=1e-6
            )
            assert torch.allclose(goal.view(6, 2)[4 + k], turn @ (targets[1, k] - state["feet"][stance[k]]), atol=1e-6)
            assert torch.equal(goal.view(6, 2)[stance[k]], state["goal"].view(6, 2)[stance[k]]), "stance stays"


def test_it_waits_for_its_first_step_and_pair(networks, states):
    early, first_pair = states[:2].clone(), states[:2].clone()
    early["events", "step_count"] = torch.full_like(early["events", "step_count"], 59)
    first_pair["pair"] = torch.ones_like(first_pair["pair"])
    hlp = HighLevelPolicy(networks.value(), HighLevelConfig(resolution=3))
    for td in (early, first_pair):
        out = hlp(td.clone())
        assert torch.equal(out["goal"], td["goal"])
        number = int(td[0]["pair"]) % 2
        seen = td["feet"][0, ACTIVE[number]] + _turned(td["goal"][0].view(6, 2)[ACTIVE[number]], float(td["yaw"][0]))
        assert torch.allclose(out["targets"][0, 0], seen, atol=1e-5)


def _turned(vectors, yaw):
    return vectors @ torch.tensor([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]])


class _OddCritic(torch.nn.Module):
    """Another architecture: reads goal and yaw only, peaks where every target is at a wished-for place."""

    wish = 0.05

    def forward(self, goal, yaw):
        return -((goal - self.wish) ** 2).sum(-1, keepdim=True).sqrt() + 0.0 * yaw


def test_a_value_function_of_another_architecture_works(states):
    critic = TensorDictModule(_OddCritic(), ["goal", "yaw"], ["state_value"])
    with torch.no_grad():
        solutions = {}
        for search in SEARCHES:
            hlp = HighLevelPolicy(critic, HighLevelConfig(resolution=3, direction_weight=0.0, search=search))
            solutions[search] = hlp(states.clone())
    assert torch.allclose(solutions["exact"]["goal"], solutions["naive"]["goal"])
    assert (solutions["alternating"]["objective"] >= solutions["exact"]["objective"] - 0.01).all()


class _NearForeignPoint(ObjectiveTerm):
    """A user's term: stay away from the right-hand half-plane, whatever the value says."""

    def forward(self, targets):
        return -1e4 * (targets.position[..., 1] < 0.0).any(-1).float()


def test_further_terms_count(networks, states):
    plain = HighLevelPolicy(networks.value(), HighLevelConfig(resolution=3))(states.clone())["targets"]
    td = states.clone()
    td["footholds"] = td["footholds"] - td["footholds"][:, :, 1:].mean(1, keepdim=True) * torch.tensor([0.0, 1.0])
    hlp = HighLevelPolicy(networks.value(), HighLevelConfig(resolution=3, lateral_ratio=3.0), [_NearForeignPoint()])
    targets = hlp(td)["targets"]
    assert (targets[:, 0, :, 1] >= -1e-6).all() and (plain[:, 0, :, 1] < 0).any()


def test_it_composes_with_the_actor_in_a_rollout_and_a_collector(networks):
    env = make_env(2)
    rollout = walk(env, 80, networks)
    assert torch.isfinite(rollout["next", "reward"]).all() and rollout["targets"].shape == (2, 80, 2, 2, 2)
    hlp = HighLevelPolicy(networks.value(), HighLevelConfig(resolution=3, start_step=5, start_pair=1))
    collector = Collector(
        make_env(2), TensorDictSequential(hlp, networks.policy()), frames_per_batch=40, total_frames=40,
        auto_register_policy_transforms=False,
    )  # fmt: skip
    for batch in collector:
        chosen, targets = batch["goal"][0, 10], batch["targets"][0, 10]
        assert targets.shape == (2, 2, 2)
        # The environment has taken the choice over: it is in the next observation, seen from feet that have moved on.
        after = batch["next"][0, 10]
        if not bool(after["events", "pair_hit"]):
            foot = ACTIVE[int(after["pair"]) % 2][0]
            in_world = after["feet"][foot] + _turned(after["goal"].view(6, 2)[foot][None], float(after["yaw"]))[0]
            assert torch.allclose(in_world, targets[0, 0], atol=1e-4)
        assert not torch.equal(chosen, batch["goal"][0, 0])
    collector.shutdown()


@pytest.mark.parametrize(
    ("field", "value"),
    [("resolution", 0), ("half_width", -0.1), ("ascent_steps", -1), ("pairs", "three"), ("search", "random")],
)
def test_bad_settings_are_named(field, value):
    with pytest.raises(InputError, match=field.replace("_", "-")):
        HighLevelConfig(**{field: value}).validate()
