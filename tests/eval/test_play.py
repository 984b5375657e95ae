"""Playing a policy headless."""

import subprocess
import sys

import pytest

from quadhrl.errors import InputError
from quadhrl.eval.play import PlayConfig, play
from quadhrl.trainers.config import parse_command_line
from quadhrl.trainers.ppo import train


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("logs")
    flags = ["--preset", "smoke", "--num-envs", "4", "--ppo.horizon", "4", "--total-steps", "16", "--run-name", "r"]
    train(parse_command_line(args=[*flags, "--log-dir", str(folder)]))
    return folder / "r"


def test_film_and_picture_of_a_trained_policy(run, tmp_path):
    config = PlayConfig(
        str(run),
        video=str(tmp_path / "a.mp4"),
        picture=str(tmp_path / "a.png"),
        seconds=0.5,
        num_envs=2,
        width=320,
        height=240,
    )
    scalars = play(config)
    assert "rollout/pairs_per_second" in scalars
    imageio = pytest.importorskip("imageio.v3")
    frames = imageio.imread(tmp_path / "a.mp4")
    assert frames.shape == (15, 240, 320, 3)
    assert frames.std(axis=(1, 2)).min() > 5, "pictures, not blank frames"
    picture = imageio.imread(tmp_path / "a.png")
    red = (picture[..., 0] > 150) & (picture[..., 1] < 110) & (picture[..., 2] < 80)
    assert red.sum() > 20, "the next targets are drawn"


def test_high_level_policy_walks_and_forward_policy_is_filmed(tmp_path):
    scalars = play(
        PlayConfig("footstep", hlp=True, heading=30.0, seconds=1.2, num_envs=2, infill=1.0, height_range=0.0)
    )
    assert scalars["rollout/pairs_per_second"] > 3
    film = tmp_path / "a.gif"
    scalars = play(PlayConfig("forward", video=str(film), seconds=1.0, num_envs=2, width=320, height=240))
    assert scalars["reward/forward_velocity"] > 0.1
    assert pytest.importorskip("imageio.v3").imread(film).shape == (10, 240, 320, 3)
    with pytest.raises(InputError, match=r"--hlp: got True; .*footstep"):
        play(PlayConfig("forward", hlp=True))


@pytest.mark.parametrize("policy", ["zero", "random"])
def test_dummy_policies_need_no_checkpoint(policy):
    assert play(PlayConfig(policy=policy, seconds=0.2, num_envs=2))["rollout/faults_per_minute"] == 0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({}, "CHECKPOINT: got ''; give a checkpoint"),
        ({"checkpoint": "nowhere.ckpt"}, "no such file"),
        ({"policy": "magic"}, "--policy: got 'magic'"),
        ({"policy": "zero", "video": "/nowhere/a.mp4"}, "--video: got '/nowhere/a.mp4'"),
        ({"policy": "zero", "video": "a.avi"}, "--video: got 'a.avi'; choose a file that ends in .mp4 or .gif"),
        ({"policy": "zero", "seconds": 0.0}, "--seconds: got 0.0"),
        ({"policy": "zero", "infill": 2.0}, "--infill: got 2.0"),
    ],
)
def test_bad_input_is_named(changes, message):
    with pytest.raises(InputError, match=message):
        play(PlayConfig(**changes))


def test_command_line_refuses_to_play_nothing():
    done = subprocess.run([sys.executable, "-m", "quadhrl.eval.play"], capture_output=True, text=True, timeout=120)
    assert done.returncode == 2 and done.stderr.startswith("error: CHECKPOINT")
    assert len(done.stderr.splitlines()) == 1


def test_web_viewer_serves_a_page_while_the_policy_plays():
    pytest.importorskip("viser")
    import urllib.request

    from quadhrl.envs import FootstepConfig, FootstepEnv
    from quadhrl.eval.viewer import WebViewer

    env = FootstepEnv(FootstepConfig(), 2)
    td = env.reset()
    viewer = WebViewer(env, port=18080)
    try:
        for _ in range(5):
            td["action"] = env.action_spec.rand()
            td = env.step(td)["next"]
            viewer.show()
        page = urllib.request.urlopen(viewer.url, timeout=10).read()
        foot = viewer._shapes[int(viewer.view.scene.feet[0])]
        assert foot.position == pytest.approx(env.sim.readings.foot_position[0, 0].numpy(), abs=1e-4)
    finally:
        viewer.close()
    assert b"<html" in page.lower()
