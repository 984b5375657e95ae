"""Random numbers as a pure function of integers: a world's terrain and targets are its own, whatever the batch it is in."""

from __future__ import annotations

from functools import reduce

import torch
from torch import Tensor

__all__ = ["hash_key", "hash_uniform"]


def hash_key(*parts: Tensor | int) -> Tensor:
    """Combine integers or int64 tensors (broadcast against each other) into 32 random bits, int64."""
    return reduce(lambda key, part: _mix(key ^ torch.as_tensor(part)), parts[1:], _mix(torch.as_tensor(parts[0])))


def hash_uniform(key: Tensor, count: int) -> Tensor:
    """Uniform numbers in [0, 1), float32.

    Args:
        key: keys from `hash_key`, [...].
        count: how many numbers to draw for each key.

    Returns:
        [..., count].
    """
    counter = _mix(torch.arange(count, device=key.device))
    return (_mix(key[..., None] ^ counter) >> 8).float() * (1.0 / (1 << 24))


def _mix(x: Tensor) -> Tensor:
    """The 32-bit integer hash "lowbias32" (Wellons 2018), on int64 tensors."""
    mask = 0xFFFFFFFF
    x = x & mask
    x = ((x ^ (x >> 16)) * 0x7FEB352D) & mask
    x = ((x ^ (x >> 15)) * 0x846CA68B) & mask
    return x ^ (x >> 16)
