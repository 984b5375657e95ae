"""The benchmarks run: what they measure is no test's business."""

import subprocess
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


@pytest.mark.parametrize(
    ("script", "flags", "shown"),
    [
        (
            "throughput",
            ["--engines", "native", "--worlds", "4", "--horizon", "4", "--repeats", "1", "--json"],
            "env_step",
        ),
        ("substeps", ["forward", "--substeps", "4", "--worlds", "4", "--seconds", "0.3"], "90% / 5 cm"),
        ("holes", ["--worlds", "4", "--seconds", "0.5"], "on a block"),
    ],
)
def test_runs(script, flags, shown):
    done = subprocess.run(
        [sys.executable, BENCHMARKS / f"{script}.py", *flags], capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    assert shown in done.stdout
