"""A robot and its mirror image, simulated side by side."""

import dataclasses
import re

import pytest
import torch

from quadhrl.envs import FootstepConfig, FootstepEnv, ForwardConfig, ForwardEnv
from quadhrl.envs.scan import scan_pattern
from quadhrl.robots import ROBOTS


def mirrored_targets(targets):
    """Every world's targets with y negated and the legs exchanged; the mirrored pair is the other one."""
    flipped = targets.position[:, [1, 0, 3, 2]] * torch.tensor([1.0, -1.0])
    return targets.index + 1, flipped, targets.following * torch.tensor([1.0, -1.0])


@pytest.mark.parametrize(("cls", "config"), [(FootstepEnv, FootstepConfig), (ForwardEnv, ForwardConfig)])
def test_mirrored_actions_give_mirrored_observations_and_the_same_reward(cls, config, symmetric_aliengo):
    settings = config()
    settings.terrain.infill, settings.terrain.height_range = 1.0, 0.0
    robot, image = cls(settings, 4, seed=0), cls(settings, 4, seed=0)
    td, image_td = robot.reset(), image.reset()
    image.generator.phase += 0.5
    if cls is FootstepEnv:
        image.targets.index, image.targets.position, image.targets.following = mirrored_targets(robot.targets)
    generator = torch.Generator().manual_seed(0)
    seen = {key: [] for key in (*cls.network_inputs, "reward")}
    for _ in range(10):
        td["action"] = (torch.randn(4, 15, generator=generator) * 0.5).clamp(-1, 1)
        image_td["action"] = cls.mirrors["action"](td["action"])
        # Without the goal: one that differs from the environment's own would set its targets anew.
        td, image_td = (env.step(x.exclude("goal"))["next"] for env, x in ((robot, td), (image, image_td)))
        for key in cls.network_inputs:
            seen[key].append((td[key], cls.mirrors[key](image_td[key])))
        seen["reward"].append((td["reward"], image_td["reward"]))
    for key, steps in seen.items():
        real, mirrored = (torch.cat(side) for side in zip(*steps, strict=True))
        # Friction pyramids are not symmetric, so impacts differ a little. A wrong sign or place would give 1 or more.
        difference = (real - mirrored).square().mean(0).sqrt() / real.square().mean(0).sqrt().clamp(min=0.05)
        assert difference.max() < 0.3, (key, difference)
        assert difference.median() < 0.02, key


@pytest.fixture
def symmetric_aliengo(tmp_path, monkeypatch):
    """Aliengo with the trunk's mass in the middle."""
    aliengo = ROBOTS["aliengo"]
    text = aliengo.mjcf.read_text()
    symmetric = re.sub(
        r'pos="0.008465 [^"]*" mass="9.041" fullinertia="[^"]*"',
        'pos="0 0 0" mass="9" diaginertia="0.03 0.16 0.17"',
        text,
    )
    assert symmetric != text
    (tmp_path / "aliengo.xml").write_text(symmetric)
    monkeypatch.setitem(ROBOTS, "aliengo", dataclasses.replace(aliengo, mjcf=tmp_path / "aliengo.xml"))


def test_the_scan_pattern_is_its_own_mirror_image():
    seen = FootstepEnv.mirrors["scan"](scan_pattern().repeat(4, 1).T).T
    assert torch.allclose(seen, scan_pattern().repeat(4, 1) * torch.tensor([1.0, -1.0]), atol=1e-6)


@pytest.mark.parametrize("cls", [FootstepEnv, ForwardEnv])
def test_twice_in_the_mirror_is_nothing_new(cls):
    for key, size in (cls.network_inputs | {"action": 15}).items():
        x = torch.randn(5, size)
        assert torch.equal(cls.mirrors[key](cls.mirrors[key](x)), x)
