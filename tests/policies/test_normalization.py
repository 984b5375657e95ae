"""Running statistics against numpy over the whole stream."""

import pytest
import torch

from quadhrl.policies.normalization import ObservationNormalizer, RunningStatistics


def test_statistics_equal_those_of_the_whole_stream():
    generator = torch.Generator().manual_seed(0)
    batches = [3.0 + 2.0 * k + torch.randn(10, 7, 5, generator=generator) * (k + 1) for k in range(6)]
    statistics = RunningStatistics(5)
    for batch in batches:
        statistics.update(batch)
    everything = torch.cat([batch.reshape(-1, 5) for batch in batches])
    assert statistics.mean.numpy() == pytest.approx(everything.mean(0).numpy(), rel=1e-5)
    assert statistics.std.numpy() == pytest.approx(everything.std(0, correction=0).numpy(), rel=1e-5)
    assert statistics.count == len(everything)


def test_rows_with_a_non_finite_entry_are_left_out():
    rows = torch.randn(100, 2, generator=torch.Generator().manual_seed(0))
    dirty = rows.clone()
    dirty[3, 0], dirty[7, 1] = float("nan"), float("inf")
    clean, statistics = RunningStatistics(2), RunningStatistics(2)
    clean.update(rows[[k for k in range(100) if k not in (3, 7)]])
    statistics.update(dirty)
    assert torch.equal(clean.mean, statistics.mean) and torch.equal(clean.variance, statistics.variance)
    statistics.update(torch.full((4, 2), float("nan")))
    assert torch.isfinite(statistics.mean).all()


def test_old_rows_are_forgotten_beyond_the_horizon(monkeypatch):
    monkeypatch.setattr(RunningStatistics, "HORIZON", 1000)
    statistics = RunningStatistics(1)
    statistics.update(torch.zeros(5000, 1))
    for _ in range(20):
        statistics.update(torch.ones(500, 1))
    assert statistics.mean.item() > 0.99


def test_normalizer_clips_scales_and_passes_gradients():
    normalizer = ObservationNormalizer([2, 3], [1.0, 0.1])
    normalizer.update(torch.randn(1000, 2) * 4 + 1, torch.randn(1000, 3))
    goal = torch.zeros(1, 2, requires_grad=True)
    features = normalizer(goal, torch.full((1, 3), 1e6))
    assert features[0, 2:].tolist() == pytest.approx([0.5] * 3)
    features[0, 0].backward()
    assert goal.grad is not None and goal.grad[0, 0].item() == pytest.approx(1 / 4, rel=0.1)
