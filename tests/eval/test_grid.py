"""The comparison: rollouts counted exactly once, independent of their batch, resumable, and summed up as by hand."""

import csv
import dataclasses
import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch

import quadhrl
from quadhrl.errors import InputError
from quadhrl.eval.grid import GridConfig, run_grid
from quadhrl.eval.methods import make_method, mean_action
from quadhrl.eval.results import ResultsFolder
from quadhrl.eval.rollouts import Episode, Job, StopRules, run_episodes
from quadhrl.eval.summary import Normalizer, bootstrap_mean, summarize
from quadhrl.eval.terrains import PUBLISHED, PUBLISHED_CLAIMS, TEST_TERRAINS, TestTerrain
from quadhrl.policies import HighLevelConfig
from quadhrl.trainers.checkpoint import load_networks

ASSETS = Path(quadhrl.__file__).parent / "assets"
ROUGH, LEVEL = TestTerrain(0.9, 0.05), TestTerrain(1.0, 0.0)
SMALL_HLP = HighLevelConfig(resolution=3)


def make(name):
    task = "forward" if name == "end-to-end" else "footstep"
    return make_method(name, load_networks(ASSETS / f"{task}.torchrl"), SMALL_HLP)


def run(name, jobs, seed=0, **rules):
    cpu = torch.device("cpu")
    return list(run_episodes(make(name), jobs, StopRules(**rules), seed=seed, engine="native", device=cpu))


def jobs(name, terrain, count, start=0):
    return [Job(name, terrain, k) for k in range(start, start + count)]


@pytest.mark.parametrize("name", ["hlp", "llp-random", "end-to-end"])
def test_a_rollout_does_not_depend_on_its_batch(name):
    """Bit by bit: alone, and among others of other terrains."""
    alone = run(name, jobs(name, ROUGH, 1), max_steps=150)
    crowd = run(name, [*jobs(name, LEVEL, 20), *jobs(name, ROUGH, 3), *jobs(name, LEVEL, 14, 20)], max_steps=150)
    assert [e for e in crowd if (e.infill, e.rollout) == (0.9, 0)] == alone
    assert len(crowd) == 37 and len({(e.infill, e.rollout) for e in crowd}) == 37, "each counted exactly once"
    assert run(name, jobs(name, ROUGH, 1), seed=1, max_steps=150) != alone


def test_records_equal_sums_over_a_plain_rollout():
    """The tally against a naive loop over one world of the environment."""
    name = "llp-in-place"
    method = make(name)
    (record,) = run(name, jobs(name, ROUGH, 1), max_steps=120)
    from quadhrl.eval.rollouts import _make_env

    env = _make_env(method, jobs(name, ROUGH, 1), StopRules(max_steps=120), "native", torch.device("cpu"), 0)
    td, reward, collisions, pairs = env.reset(), 0.0, 0, 0
    steps = 0
    while steps < 120:
        steps += 1
        td = env.step(td.set("action", mean_action_of(method, td)))["next"]
        reward += float(td["reward"][0])
        collisions += int(env.sim.readings.collisions[0])
        pairs += int(td["events", "pair_hit"][0])
        if bool(td["done"][0]):
            break
    assert (record.steps, record.collisions, record.pairs) == (steps, collisions, pairs)
    assert record.reward == pytest.approx(reward, rel=1e-6)
    assert record.distance == pytest.approx(float(env.sim.qpos[0, 0]), abs=1e-5)
    assert record.outcome == "timeout"


def mean_action_of(method, td):
    with torch.no_grad():
        return method.act(td)


def test_mean_action_is_the_policys_mean():
    loaded = load_networks(ASSETS / "footstep.torchrl")
    td = torch.stack([make_observation(k) for k in range(5)])
    assert torch.allclose(mean_action(loaded.networks, td), loaded.networks.policy()(td.clone())["loc"], atol=1e-5)


def make_observation(k):
    from tensordict import TensorDict

    torch.manual_seed(k)
    return TensorDict({"proprioception": torch.randn(80), "goal": torch.randn(12), "scan": torch.randn(284)})


def test_stop_rules():
    stand = make("llp-in-place")
    stand = dataclasses.replace(stand, act=lambda td: torch.tensor([-1.0, 0.3, -1.0] + [0.0] * 12).expand(len(td), -1))
    cpu, terrain = torch.device("cpu"), jobs("llp-in-place", LEVEL, 1)
    (free,) = run_episodes(stand, terrain, StopRules(400), seed=0, engine="native", device=cpu)
    assert (free.outcome, free.steps, free.steps_until_stuck) == ("timeout", 400, 300), "5 s at 60 Hz without a pair"
    assert free.reward_until_stuck < free.reward or free.reward_until_stuck != free.reward
    (ended,) = run_episodes(stand, terrain, StopRules(400, end_when_stuck=True), seed=0, engine="native", device=cpu)
    assert (ended.outcome, ended.steps) == ("stuck", 300)
    assert ended.reward == pytest.approx(free.reward_until_stuck)
    flail = dataclasses.replace(stand, act=lambda td: torch.sign(torch.sin(torch.arange(15.0) * 2)).expand(len(td), -1))
    (fallen,) = run_episodes(
        flail, jobs("x", TestTerrain(0.3, 0.1), 1), StopRules(900), seed=0, engine="native", device=cpu
    )
    assert fallen.outcome in ("fall", "timeout") and fallen.steps <= 900


def test_success_at_eight_and_a_half_metres():
    (record,) = run("end-to-end", jobs("end-to-end", LEVEL, 1), max_steps=2000)
    assert record.outcome == "success" and 8.5 <= record.distance < 8.7
    assert 0.4 < record.distance / (record.steps / 60) < 2.0


def episode(method, terrain, rollout, reward=1.0, steps=100, distance=1.0, collisions=10, outcome="fall", free=None):
    free = free or (steps, reward * steps, distance, collisions)
    return Episode(method, *terrain, rollout, outcome, steps, reward * steps, distance, collisions, 7, *free)


def test_summary_and_claims_by_hand():
    a, b = TestTerrain(1.0, 0.0), TestTerrain(0.8, 0.1)
    episodes = [
        episode("hlp", a, 0, reward=4.0, distance=9.0, collisions=5),
        episode("hlp", a, 1, reward=2.0, distance=2.0, collisions=15),
        episode("end-to-end", a, 0, reward=1.1, distance=6.0, collisions=12),
        episode("hlp", b, 0, reward=2.0, distance=1.0, collisions=30, free=(50, 200.0, 0.5, 2)),
        episode("end-to-end", b, 0, reward=1.2, distance=0.9, collisions=20),
        episode("training-footstep", a, 0, reward=99.0),
    ]
    normalizers = {"footstep": Normalizer(2.5, 3.0), "forward": Normalizer(1.0, 1.2)}
    summary = summarize(episodes, normalizers)
    cell = summary.cells["hlp"][a]
    assert cell["normalized_reward"].mean == pytest.approx(100 * 3.0 / 2.5)
    assert cell["distance"].mean == pytest.approx((8.5 + 2.0) / 2), "capped, as the paper's"
    assert cell["collisions"].mean == pytest.approx(0.1)
    assert summary.claims == {
        "reward_h_over_f": 1,  # 120 > 110, 80 < 120
        "reward_over_100": 1,
        "distance_h_over_f": 1,  # 5.25 < 6, 1.0 > 0.9
        "collisions_h_under_f": 1,  # 0.10 < 0.12, 0.3 > 0.2
    }
    assert summary.evidence["reward_h_over_f"] == (0, 0), "too few rollouts"
    stuck = summarize(episodes, normalizers, until_stuck=True)
    assert stuck.cells["hlp"][b]["normalized_reward"].mean == pytest.approx(100 * 4.0 / 2.5)
    assert stuck.claims["reward_h_over_f"] == 2 and stuck.claims["collisions_h_under_f"] == 2
    training = summarize(episodes, normalizers, by_training=True)
    assert training.cells["hlp"][a]["normalized_reward"].mean == pytest.approx(100.0)
    assert training.claims["reward_over_100"] == 0


def test_a_claim_is_settled_where_the_paired_difference_leaves_zero_out():
    a, b, c = TestTerrain(1.0, 0.0), TestTerrain(0.8, 0.1), TestTerrain(0.9, 0.1)
    episodes = []
    for k in range(10):  # the blocks of rollout 9 are easy for both: the difference is the same on all
        easy = 5.0 * (k == 9)
        episodes += [
            episode("hlp", a, 9 - k, distance=1.0 + 5.0 * (k == 0)),
            episode("end-to-end", a, k, distance=0.9 + easy),
        ]
        episodes += [episode("hlp", b, k, distance=1.0), episode("end-to-end", b, k, distance=1.0 + 0.01 * k)]
        episodes += [episode("hlp", c, k, distance=2.0 + k), episode("end-to-end", c, k, distance=2.1 + 9 - k)]
    summary = summarize(episodes, {"footstep": Normalizer(1.0, 1.0), "forward": Normalizer(1.0, 1.0)})
    assert summary.claims["distance_h_over_f"] == 1
    assert summary.evidence["distance_h_over_f"] == (1, 1), "a for, b against, c scatters"
    assert summary.evidence["reward_h_over_f"] == (0, 0), "no difference at all"
    few = summarize(
        [e for e in episodes if e.rollout < 4], {"footstep": Normalizer(1.0, 1.0), "forward": Normalizer(1.0, 1.0)}
    )
    assert few.evidence["distance_h_over_f"] == (0, 0), "four rollouts settle nothing"
    assert summary.to_json()["claims_evidence"]["distance_h_over_f"] == {"supported": 1, "contradicted": 1}


def test_bootstrap_interval_covers_as_often_as_it_says():
    rng = np.random.default_rng(0)
    covered = [low <= 3.0 <= high for _, low, high in (bootstrap_mean(rng.normal(3.0, 2.0, 20)) for _ in range(100))]
    assert 85 <= sum(covered) <= 99
    assert bootstrap_mean(np.array([2.0])) == (2.0, 2.0, 2.0)


def test_published_numbers_give_the_papers_counts():
    counts = {
        "reward_h_over_f": sum(p.reward[0] > p.reward[1] for p in PUBLISHED.values()),
        "reward_over_100": sum(p.reward[0] > 100 for p in PUBLISHED.values()),
        "distance_h_over_f": sum(p.distance[0] > p.distance[1] for p in PUBLISHED.values()),
        "collisions_h_under_f": sum(p.collisions[0] < p.collisions[1] for p in PUBLISHED.values()),
    }
    assert counts == PUBLISHED_CLAIMS and len(TEST_TERRAINS) == 12


TINY = [
    "--infill", "1.0", "0.8", "--height-range", "0.05", "--rollouts", "1", "--rules.max-steps", "70",
    "--hlp.resolution", "3", "--hlp.start-step", "10",
]  # fmt: skip


def command(*flags):
    return [sys.executable, "-m", "quadhrl.eval.grid", *TINY, *flags]


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A small comparison, run to its end through the command line."""
    folder = tmp_path_factory.mktemp("grid") / "results"
    done = subprocess.run(command("--out", str(folder)), capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip().endswith("report.html")
    return folder


def test_everything_is_written(finished):
    names = {path.name for path in finished.iterdir()}
    charts = {
        f"{chart}.{kind}"
        for chart in ("normalized_reward", "distance", "collisions", "landscape")
        for kind in ("png", "svg")
    }
    assert names == charts | {"episodes.csv", "summary.json", "report.html", "table.md", "configuration.json"}
    summary = json.loads((finished / "summary.json").read_text())
    assert set(summary["claims"]) == set(PUBLISHED_CLAIMS) and summary["claims_of"] == 2
    table = (finished / "table.md").read_text().splitlines()
    whole, until_stuck = (
        next(c for c in counted["cells"] if (c["method"], c["infill"]) == ("hlp", 0.8))["normalized_reward"]["mean"]
        for counted in (summary, summary["authors_rules"])
    )
    assert f"| 80 / 0.05 | {whole:.0f} | {until_stuck:.0f} (96) |" in table[3] and len(table) == 4
    assert len(summary["cells"]) == 8 and summary["search"] == "alternating"
    with (finished / "episodes.csv").open() as file:
        rows = list(csv.DictReader(file))
    keys = [(r["method"], r["infill"], r["height_range"], r["rollout"]) for r in rows]
    assert len(set(keys)) == len(keys) == 8 + 40


def test_killed_half_way_it_carries_on_and_ends_with_the_same_rows(finished, tmp_path):
    folder = tmp_path / "results"
    process = subprocess.Popen(command("--out", str(folder), "--num-envs", "1"), stdout=subprocess.DEVNULL)
    deadline = time.time() + 120
    file = folder / "episodes.csv"
    while time.time() < deadline and (not file.exists() or len(file.read_text().splitlines()) < 4):
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.wait()
    before = file.read_text()
    assert 3 < len(before.splitlines()) < 49
    file.write_text(before + "hlp,0.8,0.05,0,fal")  # a line that the kill cut short
    done = subprocess.run(command("--out", str(folder)), capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert f"{len(before.splitlines()) - 1} rollouts are there already" in done.stdout
    assert file.read_text() == (finished / "episodes.csv").read_text()


def error_of(*flags):
    done = subprocess.run(command(*flags), capture_output=True, text=True, timeout=120)
    assert done.returncode == 2, done.stdout + done.stderr
    lines = done.stderr.strip().splitlines()
    assert len(lines) == 1 and "Traceback" not in done.stderr, done.stderr
    return lines[0]


def test_bad_input_is_one_line_and_nothing_is_overwritten(finished, tmp_path):
    before = {path: path.read_bytes() for path in finished.iterdir()}
    out = ["--out", str(tmp_path / "new")]
    assert "--checkpoint-forward" in error_of(*out, "--checkpoint-forward", str(ASSETS / "footstep.torchrl"))
    assert "--checkpoint-footstep" in error_of(*out, "--checkpoint-footstep", str(tmp_path / "missing"))
    assert "--infill: got 1.2" in error_of(*out, "--infill", "1.2")
    assert "--infill: got -0.1" in error_of(*out, "--infill", "-0.1")
    assert "--rollouts: got 0" in error_of(*out, "--rollouts", "0")
    assert "--methods: got 'magic'" in error_of(*out, "--methods", "magic")
    assert "--hlp.search" in error_of(*out, "--hlp.search", "magic")
    assert not (tmp_path / "new").exists()
    message = error_of("--out", str(finished), "--seed", "5")
    assert "seed = 0, not 5" in message
    assert "rules" in error_of("--out", str(finished), "--rules.max-steps", "71")
    other = tmp_path / "other"
    other.mkdir()
    (other / "thesis.tex").write_text("years of work")
    assert "something else" in error_of("--out", str(other))
    assert {path: path.read_bytes() for path in finished.iterdir()} == before
    assert [path.name for path in other.iterdir()] == ["thesis.tex"]


def test_damaged_lines_and_a_full_disk(tmp_path, monkeypatch):
    folder = ResultsFolder(tmp_path / "r", {"seed": 0})
    for k in range(3):
        folder.add(episode("hlp", ROUGH, k))
    again = ResultsFolder(tmp_path / "r", {"seed": 0})
    assert again.episodes == folder.episodes
    file = tmp_path / "r" / "episodes.csv"
    file.write_text(file.read_text().replace("fall", "fall,fall", 1))
    with pytest.raises(InputError, match=r"episodes\.csv:2"):
        ResultsFolder(tmp_path / "r", {"seed": 0})

    def full(*_args, **_kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "open", full)
    with pytest.raises(InputError, match="No space left"):
        folder.add(episode("hlp", ROUGH, 9))


def test_more_rollouts_are_added_to_the_same_folder(finished, tmp_path):
    import shutil

    folder = tmp_path / "results"
    shutil.copytree(finished, folder)
    config = GridConfig(
        out=str(folder), rollouts=2, infill=(1.0, 0.8), height_range=(0.05,), methods=("llp-in-place",),
        rules=StopRules(max_steps=70), hlp=HighLevelConfig(resolution=3, start_step=10),
    )  # fmt: skip
    before = (folder / "episodes.csv").read_text().splitlines()
    run_grid(config)
    after = (folder / "episodes.csv").read_text().splitlines()
    assert set(before) < set(after) and len(after) == len(before) + 2
    summary = json.loads((folder / "summary.json").read_text())
    assert {cell["method"] for cell in summary["cells"]} == {"llp-in-place"}, "only what was asked for"
    assert summary["claims"] == {}
