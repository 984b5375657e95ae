"""Running normalisation of observations and values, as modules that are saved and exported with the networks."""

from __future__ import annotations

import torch
from torch import Tensor, nn

__all__ = ["ObservationNormalizer", "RunningStatistics"]


class RunningStatistics(nn.Module):
    """Mean and standard deviation of a stream of rows; forgets beyond `HORIZON` rows, so it can follow a curriculum.

    Args:
        size: entries per row.
        min_std: lower bound of the standard deviation.
    """

    HORIZON = 5_000_000
    mean: Tensor
    variance: Tensor
    count: Tensor

    def __init__(self, size: int, min_std: float = 1e-2) -> None:
        super().__init__()
        self.min_std = min_std
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("variance", torch.ones(size))
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))

    @property
    def std(self) -> Tensor:
        """Standard deviation of each entry [size]."""
        return self.variance.sqrt().clamp(min=self.min_std)

    @torch.no_grad()
    def update(self, rows: Tensor) -> None:
        """Take in more rows [..., size]; rows with a non-finite entry are left out.

        The two halves are merged as in Chan et al. 1979.
        """
        rows = rows.reshape(-1, rows.shape[-1])
        finite = torch.isfinite(rows.sum(-1))  # a sum keeps every NaN and infinity
        if not finite.all():
            rows = rows[finite]
        if len(rows) == 0:
            return
        variance, mean = torch.var_mean(rows, 0, correction=0)
        weight = len(rows) / (self.count + len(rows))
        delta = mean - self.mean
        self.variance.copy_((1 - weight) * self.variance + weight * variance + weight * (1 - weight) * delta**2)
        self.mean += (weight * delta).to(self.mean.dtype)
        self.count.copy_((self.count + len(rows)).clamp(max=self.HORIZON))


class ObservationNormalizer(nn.Module):
    """Concatenates the observations, normalises each entry by its running statistics and clips it to +- `CLIP`.

    Args:
        sizes: number of entries of each observation, in the order in which they are passed.
        gains: factor on each observation's normalised entries.
    """

    CLIP = 5.0
    gain: Tensor

    def __init__(self, sizes: list[int], gains: list[float]) -> None:
        super().__init__()
        self.statistics = RunningStatistics(sum(sizes))
        entries = [torch.full((size,), gain) for size, gain in zip(sizes, gains, strict=True)]
        self.register_buffer("gain", torch.cat(entries))

    def forward(self, *observations: Tensor) -> Tensor:
        """Normalised features [..., sum(sizes)]."""
        statistics = self.statistics
        features = torch.cat(observations, -1)
        return features.sub_(statistics.mean).mul_(1.0 / statistics.std).clamp_(-self.CLIP, self.CLIP).mul_(self.gain)

    def update(self, *observations: Tensor) -> None:
        """Take the observations into the statistics."""
        self.statistics.update(torch.cat(observations, -1))
