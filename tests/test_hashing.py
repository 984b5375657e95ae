"""Random numbers as a function of integers."""

import torch

from quadhrl.hashing import hash_key, hash_uniform


def test_numbers_are_uniform_and_uncorrelated():
    numbers = hash_uniform(hash_key(3, torch.arange(2000)), 50)
    assert numbers.min() >= 0.0 and numbers.max() < 1.0
    counts = torch.histc(numbers, 10, 0, 1) / numbers.numel()
    assert (counts - 0.1).abs().max() < 0.005
    assert torch.corrcoef(numbers.T).fill_diagonal_(0).abs().max() < 0.1
    assert torch.corrcoef(numbers[:50]).fill_diagonal_(0).abs().max() < 0.7


def test_numbers_do_not_depend_on_the_batch():
    whole = hash_uniform(hash_key(7, torch.arange(100), torch.arange(100) % 3), 4)
    assert torch.equal(hash_uniform(hash_key(7, torch.arange(40, 60), torch.arange(40, 60) % 3), 4), whole[40:60])
    assert not torch.equal(hash_uniform(hash_key(8, torch.arange(100), torch.arange(100) % 3), 4), whole)
