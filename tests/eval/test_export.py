"""The exported policy against PyTorch's, in another runtime."""

import numpy as np
import pytest
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

import quadhrl
from quadhrl.eval.export import export_onnx, main
from quadhrl.policies import ActorCritic
from quadhrl.trainers.checkpoint import save_networks


def test_onnx_policy_gives_the_same_actions(tmp_path):
    onnxruntime = pytest.importorskip("onnxruntime")
    networks = ActorCritic({"proprioception": 80, "goal": 12, "scan": 284}, 15)
    observations = [torch.randn(7, size) * 3 for size in (80, 12, 284)]
    networks.normalizer.module.update(*observations)
    export_onnx(networks, tmp_path / "policy.onnx")
    assert [path.name for path in tmp_path.iterdir()] == ["policy.onnx"], "one file, no external data"
    session = onnxruntime.InferenceSession(tmp_path / "policy.onnx")
    inputs = {name: x.numpy() for name, x in zip(networks.observations, observations, strict=True)}
    (action,) = session.run(["action"], inputs)
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        expected = networks.policy()(dict_to_td(networks, observations))["action"].clamp(-1, 1)
    assert np.allclose(action, expected.numpy(), atol=1e-5)


def test_networks_alone_load_like_the_checkpoint(tmp_path):
    source = quadhrl.load_policy("footstep")
    save_networks(source, tmp_path / "policy.torchrl")
    again = quadhrl.load_policy(tmp_path / "policy.torchrl")
    assert [path.name for path in tmp_path.iterdir()] == ["policy.torchrl"]
    assert again.metadata == source.metadata and again.config.env == source.config.env
    for name, tensor in source.networks.state_dict().items():
        assert torch.equal(again.networks.state_dict()[name], tensor), name


@pytest.mark.parametrize("name", ["policy.onnx", "policy.torchrl"])
def test_a_file_that_cannot_be_written_is_one_clear_line(tmp_path, capsys, monkeypatch, name):
    (tmp_path / name / "occupied").mkdir(parents=True)  # a folder of that name
    monkeypatch.setattr("sys.argv", ["export", "footstep", "--out", str(tmp_path / name)])
    with pytest.raises(SystemExit) as stopped:
        main()
    assert stopped.value.code == 2 and "--out: got" in capsys.readouterr().err


def dict_to_td(networks, observations):
    from tensordict import TensorDict

    return TensorDict(dict(zip(networks.observations, observations, strict=True)), [len(observations[0])])
