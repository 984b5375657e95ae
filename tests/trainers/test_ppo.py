"""Training as a user runs it: resume, interruption, run directory, bad input."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from torchrl.checkpoint import CheckpointRotation
from torchrl.envs.utils import ExplorationType, set_exploration_type

from quadhrl.errors import InputError
from quadhrl.eval.curves import plot_curves, read_scalars
from quadhrl.trainers.checkpoint import find_checkpoint, load_networks
from quadhrl.trainers.config import parse_command_line, train_config_from_dict
from quadhrl.trainers.ppo import PPOTrainer, train
from quadhrl.trainers.run_directory import read_run_config

TINY = ["--preset", "smoke", "--num-envs", "8", "--ppo.horizon", "10", "--ppo.epochs", "2", "--ppo.minibatches", "2"]


def tiny(*flags):
    return parse_command_line(args=[*TINY, *flags])


def command(*args, check=None, module="quadhrl.trainers.ppo"):
    done = subprocess.run([sys.executable, "-m", module, *args], capture_output=True, text=True, timeout=300)
    if check is not None:
        assert done.returncode == check, done.stdout + done.stderr
    return done


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A finished run of two iterations."""
    folder = tmp_path_factory.mktemp("logs")
    train(tiny("--total-steps", "160", "--log-dir", str(folder), "--run-name", "two"))
    return folder / "two"


@pytest.mark.parametrize("engine", ["native", "warp"])
def test_two_plus_two_iterations_equal_four(tmp_path, engine):
    whole = PPOTrainer(tiny("--engine", engine))
    reports = [whole.iterate() for _ in range(4)]

    first = PPOTrainer(tiny("--engine", engine))
    for _ in range(2):
        first.iterate()
    path = first.checkpoint().save(tmp_path / "half.ckpt")
    resumed = PPOTrainer(tiny("--engine", engine, "--seed", "99"))
    resumed.iterate()  # whatever happened before the load must not matter
    resumed.load(path)
    assert resumed.samples == 160
    again = [resumed.iterate() for _ in range(2)]

    for old, new in zip(reports[2:], again, strict=True):
        for name, value in old.items():
            if not name.startswith("perf/"):
                assert new[name] == value, name
    for (name, expected), value in zip(
        whole.networks.state_dict().items(), resumed.networks.state_dict().values(), strict=True
    ):
        assert torch.equal(expected, value), name
    assert torch.equal(whole.env.sim.qpos, resumed.env.sim.qpos)


def test_networks_change_and_stay_finite():
    trainer = PPOTrainer(tiny())
    before = [p.clone() for p in trainer.networks.parameters()]
    scalars = trainer.iterate()
    assert all(not torch.equal(a, b) for a, b in zip(before, trainer.networks.parameters(), strict=True))
    assert all(torch.isfinite(p).all() for p in trainer.networks.parameters())
    terms = sum(value for name, value in scalars.items() if name.startswith("reward/"))
    assert terms == pytest.approx(scalars["rollout/reward"], abs=1e-5)


def test_ppo_learns_a_reward_that_it_can_control():
    """Swing reward alone: the mean frequency must rise."""
    config = tiny(
        "--num-envs",
        "64",
        "--ppo.horizon",
        "24",
        "--ppo.epochs",
        "4",
        "--ppo.min-learning-rate",
        "1e-3",
        "--ppo.learning-rate",
        "1e-3",
    )
    for name in ("footstep_target", "velocity_towards_target", "foot_stay", "smoothness", "foot_slip", "collision"):
        setattr(config.env.rewards, name, 0.0)
    trainer = PPOTrainer(config)
    frequency = []
    for _ in range(16):
        batch = trainer._collect()
        trainer.networks.normalizer.module.update(*(batch[key] for key in trainer.networks.observations))
        trainer.update(batch)
        frequency.append(batch["loc"][..., 2].mean().item())
    assert frequency[-1] > frequency[0] + 0.08, frequency


def test_run_directory_is_complete(run):
    config = train_config_from_dict(json.loads((run / "config.json").read_text()))
    assert config.num_envs == 8 and config.env.terrain.infill == 0.9 and config.ppo.horizon == 10
    assert len((run / "git.txt").read_text().split()[0]) == 40
    scalars = read_scalars(run)
    wanted = ["rollout/reward", "rollout/pairs_per_second", "rollout/falls_per_minute", "perf/steps_per_second",
              "update/learning_rate", "update/kl", "update/explained_variance", "reward/footstep_target",
              "reward/velocity_towards_target", "reward/smoothness", "reward/foot_slip", "reward/foot_stay",
              "reward/collision", "reward/swing_phase"]  # fmt: skip
    for name in wanted:
        assert [step for step, _ in scalars[name]] == [80, 160], name
    assert not any(path.suffix in (".pkl", ".pt") for path in run.rglob("*"))


def test_checkpoints_rotate(tmp_path):
    train(tiny("--total-steps", "480", "--log-dir", str(tmp_path), "--run-name", "r", "--checkpoint-minutes", "1e-9"))
    assert 2 <= len(list((tmp_path / "r" / "checkpoints").iterdir())) <= 3
    assert "480" in find_checkpoint(tmp_path / "r").name


def test_curves_become_a_picture_and_a_table(run, tmp_path):
    table = plot_curves([run], tmp_path / "curves.png")
    assert (tmp_path / "curves.png").read_bytes().startswith(b"\x89PNG")
    rows = table.read_text().splitlines()
    assert rows[0].startswith("run,samples,rollout/reward") and len(rows) == 3


def test_curves_of_stages_follow_one_another(run, tmp_path):
    stage = shutil.copytree(run, tmp_path / "next")
    rows = plot_curves([run, stage], tmp_path / "curves.png", chain=True).read_text().splitlines()
    assert [row.split(",")[:2] for row in rows[1:]] == [["two", "80"], ["two", "160"], ["next", "240"], ["next", "320"]]


def test_time_limit_ends_one_start_of_a_run_with_a_checkpoint(tmp_path, capsys):
    train(tiny("--total-steps", "100000000", "--max-minutes", "0.02", "--log-dir", str(tmp_path), "--run-name", "r"))
    assert find_checkpoint(tmp_path / "r").is_file()
    assert f"carry on with: --resume {tmp_path / 'r'}" in capsys.readouterr().out
    carried_on = parse_command_line(read_run_config(str(tmp_path / "r")), ["--resume", str(tmp_path / "r")])
    assert carried_on.max_minutes == 0 and carried_on.total_steps == 100_000_000


def test_ctrl_c_saves_and_resume_carries_on(tmp_path):
    flags = ["--log-dir", str(tmp_path), "--run-name", "r"]
    process = subprocess.Popen(
        [sys.executable, "-m", "quadhrl.trainers.ppo", *TINY, "--total-steps", "100000000", *flags],
        stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONUNBUFFERED": "1"},
    )  # fmt: skip
    for line in process.stdout:
        if " M " in line:
            break
    time.sleep(0.5)
    process.send_signal(signal.SIGINT)
    rest = process.communicate(timeout=60)[0]
    assert process.returncode == 0 and "--resume" in rest
    samples = load_networks(tmp_path / "r").metadata["samples"]
    assert samples > 0
    done = command("--resume", str(tmp_path / "r"), "--total-steps", str(samples + 160), check=0)
    assert f"done: {samples + 160} samples" in done.stdout


def test_full_disk_is_reported_and_training_goes_on(tmp_path, caplog, monkeypatch):
    def full(*_args, **_kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(CheckpointRotation, "save", full)
    train(tiny("--total-steps", "160", "--log-dir", str(tmp_path), "--checkpoint-minutes", "1e-9"))
    assert "No space left" in caplog.text and "training goes on" in caplog.text


def test_help_explains_fields_with_unit_and_default():
    text = " ".join(command("--help", check=0).stdout.replace("│", " ").split())
    for flag in ("--preset", "--task", "--engine", "--device", "--num-envs", "--total-steps", "--seed", "--log-dir", "--resume",
                 "--infill", "--height-range", "--ppo.gamma", "--rewards.footstep-target", "--physics.substeps"):  # fmt: skip
        assert flag in text, flag
    assert "Peak-to-peak range of the block tops, uniform around 0 [m]. (default: 0.05)" in text


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--preset", "huge"], "--preset: got 'huge'; choose one of: paper, cpu, smoke"),
        (["--robot", "spot"], "--robot: got 'spot'; choose one of: aliengo"),
        (["--task", "swim"], "--task: got 'swim'; choose one of: footstep"),
        (["--num-envs", "0"], "--num-envs: got 0; give"),
        (["--infill", "-0.1"], "--infill: got -0.1; give"),
        (["--engine", "bullet"], "--engine: got 'bullet'; choose"),
        (["--device", "cuda"], "--device: got 'cuda'; no CUDA device"),
        (["--ppo.gamma", "2"], "--ppo.gamma: got 2.0; give"),
        (["--log-dir", "/proc/nowhere"], "--log-dir: got '/proc/nowhere"),
        (["--resume", "/nowhere"], "--resume: got '/nowhere'; no config.json"),
        (["--init-from", "/nowhere.ckpt"], "--init-from: got '/nowhere.ckpt'; no such file"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(flags, message, tmp_path):
    if "--device" in flags and torch.cuda.is_available():
        pytest.skip("there is a CUDA device")
    done = (
        command(*TINY, "--log-dir", str(tmp_path), *flags, check=2)
        if "--preset" not in flags
        else command(*flags, check=2)
    )
    assert done.stderr.strip().splitlines()[-1].startswith("error: " + message), done.stderr
    assert len([line for line in done.stderr.splitlines() if line.startswith("error")]) == 1
    assert "Traceback" not in done.stderr and not list(tmp_path.iterdir())


def test_an_existing_run_is_not_overwritten(run):
    before = {path: path.stat().st_mtime for path in run.rglob("*")}
    done = command(*TINY, "--log-dir", str(run.parent), "--run-name", run.name, check=2)
    assert "this run exists" in done.stderr
    assert before == {path: path.stat().st_mtime for path in run.rglob("*")}


def test_damaged_and_foreign_checkpoints_are_refused(run, tmp_path):
    good = find_checkpoint(run)
    assert load_networks(good, task="footstep").metadata["samples"] == 160
    cut = tmp_path / "cut.ckpt"
    cut.write_bytes(good.read_bytes()[: good.stat().st_size // 2])
    with pytest.raises(InputError, match="damaged"):
        load_networks(cut)
    text = tmp_path / "text.ckpt"
    text.write_text("not a checkpoint")
    with pytest.raises(InputError, match="damaged or no checkpoint"):
        load_networks(text)
    with pytest.raises(InputError, match="trained for the task 'footstep'; give one for 'forward'"):
        load_networks(good, task="forward")
    with pytest.raises(InputError, match="its format is 0, this version reads 1"):
        load_networks(with_metadata(good, tmp_path / "old.ckpt", quadhrl_format=0))
    with pytest.raises(InputError, match="no checkpoint in this run directory"):
        load_networks(tmp_path)


def with_metadata(source: Path, target: Path, **changes) -> Path:
    """A copy of a checkpoint whose metadata say something else."""
    import zipfile

    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w") as new:
        for name in old.namelist():
            content = old.read(name)
            if name.endswith("manifest.json"):
                manifest = json.loads(content)
                manifest["metadata"] |= changes
                content = json.dumps(manifest)
            new.writestr(name, content)
    return target


def test_the_forward_task_trains_resumes_and_keeps_its_own_config(tmp_path):
    flags = ["--task", "forward", "--log-dir", str(tmp_path), "--run-name", "f", "--rewards.lateral-power", "2"]
    train(tiny(*flags, "--total-steps", "6240"))
    config = train_config_from_dict(json.loads((tmp_path / "f" / "config.json").read_text()))
    assert (config.task, config.env.rewards.lateral_power) == ("forward", 2)
    loaded = load_networks(tmp_path / "f", task="forward")
    assert loaded.networks.observations == {"proprioception": 77, "scan": 284}
    scalars = read_scalars(tmp_path / "f")["rollout/reward"]
    rewards = [value for samples, value in scalars if samples > 8 * 600]  # without the first ten seconds of 8 worlds
    largest = max(sum(rewards[k : k + 16]) / 16 for k in range(len(rewards) - 15))
    assert loaded.metadata["max_reward"] == pytest.approx(largest, rel=1e-4)
    assert loaded.metadata["reward"] == pytest.approx(sum(rewards[-16:]) / 16, rel=1e-4)
    resume = ["--resume", str(tmp_path / "f")]
    command(*resume, "--total-steps", "6320", check=0)
    assert load_networks(tmp_path / "f").metadata["samples"] == 6320
    done = command(*resume, "--task", "footstep", check=2)
    assert "--task: got 'footstep'; this run's task is 'forward'" in done.stderr


def test_a_checkpoint_with_another_versions_state_is_refused(run, tmp_path):
    trainer = PPOTrainer(tiny())
    state = trainer.env.state_dict()
    del state["task"]["footholds"]
    trainer.env.state_dict = lambda *_: state
    path = trainer.checkpoint().save(tmp_path / "old.ckpt")
    with pytest.raises(InputError, match="start a new run with --init-from"):
        PPOTrainer(tiny()).load(path)


def test_symmetry_makes_the_policy_symmetric():
    def asymmetry(*flags):
        trainer = PPOTrainer(parse_command_line(args=["--preset", "smoke", "--ppo.learning-rate", "1e-3", *flags]))
        for _ in range(8):
            trainer.iterate()
        batch = trainer._collect()
        networks, mirrors = trainer.networks, trainer.env.mirrors
        seen = batch.select(*networks.observations)
        for key in networks.observations:
            seen[key] = mirrors[key](seen[key])
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            action, image = (networks.policy()(x)["action"] for x in (batch.select(*networks.observations), seen))
        return (mirrors["action"](image) - action).square().mean().sqrt()

    assert asymmetry("--ppo.symmetry") < 0.5 * asymmetry()


def test_history_counts_what_the_run_began_from(run, tmp_path):
    train(tiny("--total-steps", "80", "--log-dir", str(tmp_path), "--run-name", "next", "--init-from", str(run)))
    first, then = (load_networks(folder).metadata for folder in (run, tmp_path / "next"))
    assert (first["total_samples"], then["samples"], then["total_samples"]) == (160, 80, 240)
    assert then["total_wall_seconds"] == pytest.approx(first["wall_seconds"] + then["wall_seconds"])
    assert then["machine"].endswith("cores")
    resume = ["--resume", str(tmp_path / "next")]
    command(*resume, "--total-steps", "160", check=0)
    then = load_networks(tmp_path / "next").metadata
    assert (then["samples"], then["total_samples"]) == (160, 320)
    assert "leave it out with --resume" in command(*resume, "--init-from", str(run), check=2).stderr
