"""A policy as one small file: ``python -m quadhrl.eval.export CHECKPOINT --out policy.onnx`` (or ``policy.torchrl``).

The ONNX file holds the deterministic action with the normaliser; the other one networks and settings, for `quadhrl.load_policy`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import torch
import tyro
from torch import Tensor, nn

from quadhrl.errors import InputError, command_line
from quadhrl.policies import ActorCritic
from quadhrl.trainers.checkpoint import load_networks, save_networks

__all__ = ["ExportConfig", "export_onnx", "main"]


@dataclass
class ExportConfig:
    """Export a policy to a file of its own."""

    checkpoint: Annotated[str, tyro.conf.Positional]
    """Checkpoint file or run directory."""
    out: str = "policy.onnx"
    """File to write: .onnx for other runtimes, .torchrl for this package."""


class _MeanAction(nn.Module):
    """Observations -> mean action, as the environments clamp it."""

    def __init__(self, networks: ActorCritic) -> None:
        super().__init__()
        self.normalizer = networks.normalizer.module
        self.gaussian = networks.actor[0].module

    def forward(self, *observations: Tensor) -> Tensor:
        return self.gaussian(self.normalizer(*observations))[0].clamp(-1.0, 1.0)


def export_onnx(networks: ActorCritic, out: Path) -> None:
    """Write the policy to ``out``: one input [N, size] per observation key, by its name, and the output ``action`` [N, 15].

    Raises:
        InputError: the onnx extra is not installed.
        OSError: the file cannot be written.
    """
    names = list(networks.observations)
    example = tuple(torch.zeros(2, size) for size in networks.observations.values())
    batch = torch.export.Dim("N")
    try:
        program = torch.onnx.export(
            _MeanAction(networks).eval(),
            example,
            input_names=names,
            output_names=["action"],
            dynamic_shapes=(tuple({0: batch} for _ in names),),
            dynamo=True,
            verbose=False,
        )
    except ImportError as error:
        raise InputError("--out", str(out), "ONNX is not installed; install quadhrl[onnx]") from error
    assert program is not None
    program.save(out, external_data=False)


def main() -> None:
    """Command line of the exporter."""

    def run() -> None:
        config = tyro.cli(ExportConfig, prog="python -m quadhrl.eval.export")
        out = Path(config.out)
        if not out.absolute().parent.is_dir():
            raise InputError("--out", config.out, "its folder does not exist; create it or choose another")
        loaded = load_networks(config.checkpoint, field="CHECKPOINT")
        try:
            if out.suffix == ".onnx":
                export_onnx(loaded.networks, out)
            elif out.suffix == ".torchrl":
                save_networks(loaded, out)
            else:
                raise InputError("--out", config.out, "choose a file that ends in .onnx or .torchrl")
        except OSError as error:
            raise InputError("--out", config.out, f"cannot write it ({error.strerror}); choose another file") from error
        print(out.absolute())

    command_line(run)


if __name__ == "__main__":
    main()
