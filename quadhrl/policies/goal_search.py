"""Grid search over the targets of two pairs of feet: M_1 candidates for the next pair times M_2 for the following pair.

The objective is ``V(i, j) + s_1(i) + s_2(j)``: only the value couples the pairs. Three searches find its largest entry:

- `naive_search` passes every combination through the value function.
- `exact_search` gives the same answer about ten times faster. Contributions to the first layer are added instead of computed
  anew, ELU of a sum is taken from products of powers, and where the CPU multiplies bfloat16 natively, the table is first
  computed in bfloat16 and only what may be its maximum again in float32.
- `alternating_search` maximises over one pair with the other fixed, in turn, from several starts. It finds the same
  maximum nearly always (``benchmarks/hlp.py`` measures how often) with a few per cent of the evaluations.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from quadhrl.policies.goal_value import ELU_SCALE, LOG2_E, FactoredValue, GoalValue

__all__ = ["SEARCHES", "PairCandidates", "Search", "alternating_search", "exact_search", "naive_search"]


class PairCandidates(NamedTuple):
    """The candidates of one pair, in N worlds."""

    embedding: Tensor
    """What they contribute to the goal [N, M, D]; see `GoalValue.embed`."""
    score: Tensor
    """Their score beside the value [N, M]."""


Search = Callable[[GoalValue, PairCandidates, PairCandidates], tuple[Tensor, Tensor]]
"""Takes the value and both pairs' candidates; gives the indices (i, j) of the best combination, [N] each."""

MAX_ROWS = 16384
"""Combinations whose hidden layers are held in memory at once, except by `naive_search`."""


def naive_search(value: GoalValue, first: PairCandidates, second: PairCandidates) -> tuple[Tensor, Tensor]:
    """All of a world's combinations through the value function at once: 2 GB for the paper's grid and critic."""
    return _each_world(
        value, first, second, lambda v, a, b: _best_of_table(v, a, b, max_rows=len(a.score[0]) * len(b.score[0]))
    )


def exact_search(value: GoalValue, first: PairCandidates, second: PairCandidates) -> tuple[Tensor, Tensor]:
    """The same for less."""
    screen = isinstance(value, FactoredValue) and len(value.rest) == 2 and first.score.device.type == "cpu"
    screen = screen and torch.cpu._is_avx512_bf16_supported()  # it has no public name yet

    def best(v: GoalValue, a: PairCandidates, b: PairCandidates) -> tuple[Tensor, Tensor]:
        return (_screened(v, a, b) if screen else None) or _best_of_table(v, a, b)

    return _each_world(value, first, second, best)


def alternating_search(value: GoalValue, first: PairCandidates, second: PairCandidates) -> tuple[Tensor, Tensor]:
    """Maximise over the first pair with the second fixed, then over the second, and so on until nothing changes.

    Begins in every world with `STARTS` of the second pair's candidates, spread evenly over their list. A start that arrives where
    another has been is given up.
    """
    worlds, columns = second.score.shape
    device = second.score.device
    tried_first, tried_second = (torch.zeros_like(pair.score, dtype=torch.bool) for pair in (first, second))
    best = first.score.new_full((worlds,), -torch.inf)
    best_i, best_j = torch.zeros(2, worlds, dtype=torch.long, device=device)
    golden = (
        torch.arange(min(STARTS, columns), device=device) * 0.6180339887 + 0.5
    )  # fractional parts fill [0, 1) evenly
    j = (golden % 1.0 * columns).long().unique()
    w, j = _untried(tried_second, torch.arange(worlds, device=device).repeat_interleave(len(j)), j.repeat(worlds))
    while len(w):
        _, i = _best_response(value, first, w, second.embedding[w, j])
        w, i = _untried(tried_first, w, i)
        if len(w) == 0:
            break
        objective, j = _best_response(value, second, w, first.embedding[w, i])
        best, best_i, best_j = _keep_best((best, best_i, best_j), w, objective + first.score[w, i], i, j)
        w, j = _untried(tried_second, w, j)
    return best_i, best_j


SEARCHES: dict[str, Search] = {
    "alternating": alternating_search,
    "exact": exact_search,
    "naive": naive_search,
}
"""The searches by name."""

STARTS = 8
"""Starts of the alternating search in each world."""


def _values(value: GoalValue, a: Tensor, b: Tensor) -> Tensor:
    """Values of all combinations of contributions a [N, A, D] and b [N, B, D], [N, A, B]."""
    sums = (a[:, :, None] + b[:, None]).flatten(1, 2)
    return value.value(sums).view(len(a), a.shape[1], b.shape[1])


def _each_world(
    value: GoalValue, first: PairCandidates, second: PairCandidates, search: Search
) -> tuple[Tensor, Tensor]:
    """Search one world at a time: a world's table is as much as the caches hold."""
    found = []
    for n in range(len(first.score)):
        world = slice(n, n + 1)
        found.append(search(value[world], *(PairCandidates(*(x[world] for x in pair)) for pair in (first, second))))
    i, j = (torch.cat(indices) for indices in zip(*found, strict=True))
    return i, j


def _best_of_table(
    value: GoalValue, first: PairCandidates, second: PairCandidates, max_rows: int = MAX_ROWS
) -> tuple[Tensor, Tensor]:
    """Indices of the largest entry of one world's table of objectives, computed a few rows at a time."""
    rows, columns = first.score.shape[1], second.score.shape[1]
    step = max(1, max_rows // columns)
    best, index = first.score.new_full((1,), -torch.inf), torch.zeros(1, dtype=torch.long, device=first.score.device)
    for start in range(0, rows, step):
        part = slice(start, start + step)
        table = _values(value, first.embedding[:, part], second.embedding)
        top, where = (table + first.score[:, part, None] + second.score[:, None]).flatten(1).max(1)
        index = torch.where(top > best, where + start * columns, index)
        best = torch.maximum(best, top)
    return index // columns, index % columns


ROWS_AT_ONCE = 1250
"""The same in `alternating_search`, where smaller pieces, which stay in the caches, are faster."""


def _best_response(value: GoalValue, own: PairCandidates, worlds: Tensor, other: Tensor) -> tuple[Tensor, Tensor]:
    """Best of one pair's candidates in the worlds [K], each against a contribution ``other`` [K, D] of the other pair.

    Returns:
        Objectives, without the other pair's score, and indices, [K] each.
    """
    if (
        len(worlds) == 1 < len(own.score)
    ):  # a single matrix product rounds differently from several: see `FactoredValue`
        objective, index = _best_response(value, own, worlds.repeat(2), other.repeat(2, 1))
        return objective[:1], index[:1]
    parts = -(-len(worlds) * own.score.shape[1] // ROWS_AT_ONCE)
    found = []
    for w, embedding in zip(worlds.tensor_split(parts), other.tensor_split(parts), strict=True):
        candidates = own.embedding if len(own.embedding) == 1 else own.embedding[w]
        table = value[w].value(candidates + embedding[:, None]) + own.score[w]
        found.append(table.max(1))
    objective, index = (torch.cat(results) for results in zip(*found, strict=True))
    return objective, index


def _untried(tried: Tensor, worlds: Tensor, index: Tensor) -> tuple[Tensor, Tensor]:
    """Those candidates ``index`` [K] of the worlds [K] that were not tried yet, once each; marks them in ``tried`` [N, M]."""
    new = ~tried[worlds, index]
    key = (worlds[new] * tried.shape[1] + index[new]).unique()
    worlds, index = key // tried.shape[1], key % tried.shape[1]
    tried[worlds, index] = True
    return worlds, index


def _keep_best(
    best: tuple[Tensor, Tensor, Tensor], worlds: Tensor, objective: Tensor, i: Tensor, j: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """The better of each world's best so far (objective, i, j), [N] each, and its new points, [K] each."""
    top = best[0].scatter_reduce(0, worlds, objective, "amax")
    position = torch.arange(len(worlds), device=worlds.device)
    wins = (objective == top[worlds]) & (objective > best[0][worlds])
    nobody = torch.full_like(best[1], len(worlds))
    first = nobody.scatter_reduce(0, worlds[wins], position[wins], "amin")  # the first of equals
    new = first < len(worlds)
    chosen = first.clamp(max=len(worlds) - 1)
    return top, torch.where(new, i[chosen], best[1]), torch.where(new, j[chosen], best[2])


SCREENED = 1024
"""Combinations that `exact_search` computes again in float32, at first."""


def _screened(value: FactoredValue, first: PairCandidates, second: PairCandidates) -> tuple[Tensor, Tensor] | None:
    """One world's best combination by way of a table in bfloat16; None where that cannot tell.

    The largest difference between the tables is measured on the combinations computed again. One left out would have to be
    wrong by `MARGIN` times as much to matter; where that is not excluded, the answer is None.
    """
    a, b = first.embedding[0], second.embedding[0]
    # The activation is `quadhrl.policies.goal_value.elu`; the first layer's power of a sum is a product of powers.
    power_a, power_b = (x.clamp(-60.0, 60.0).exp2() for x in (a, b))
    power_a, power_b, low_a, low_b = (x.bfloat16() for x in (ELU_SCALE * power_a, power_b, a, b))
    (weight, bias), (last, last_bias) = value.rest
    weight, bias, last = weight.bfloat16().contiguous(), bias.bfloat16(), last.bfloat16()
    table = a.new_empty(len(a), len(b))
    hidden, negative = (low_a.new_empty(min(SCREEN_ROWS, len(a)), len(b), a.shape[1]) for _ in range(2))
    for start in range(0, len(a), SCREEN_ROWS):
        rows = slice(start, start + SCREEN_ROWS)
        n = len(a[rows])
        torch.add(low_a[rows, None], low_b, out=hidden[:n])
        torch.mul(power_a[rows, None], power_b, out=negative[:n])
        _minimum(negative[:n], LOG2_E, out=negative[:n])
        _maximum(hidden[:n], negative[:n], out=hidden[:n])
        inputs, outputs = (x[:n].view(-1, a.shape[1]) for x in (hidden, negative))
        torch.addmm(bias, inputs, weight, out=outputs)
        _minimum(outputs, LOG2_E, out=inputs).exp2_().mul_(ELU_SCALE)
        _maximum(outputs, inputs, out=outputs)
        table[rows] = (outputs @ last).view(-1, len(b))
    table = (table + last_bias) * value.scale[0] + value.scale[1]
    table += first.score[0][:, None] + second.score[0]
    flat = table.view(-1)
    kept, where = flat.topk(min(SCREENED, len(flat)), sorted=False)
    i, j = where // len(b), where % len(b)
    exact = value.value((a[i] + b[j])[None])[0] + first.score[0][i] + second.score[0][j]
    top, k = exact.max(0)
    error = (exact - kept).abs().max()
    if len(kept) < len(flat) and top < kept.min() + MARGIN * error:
        return None
    return i[k, None], j[k, None]


def _minimum(x: Tensor, bound: float, *, out: Tensor) -> Tensor:
    """`torch.clamp` of bfloat16 values to a ``bound`` >= 0 from above, three times as fast.

    As long as not both are negative, bfloat16 numbers are in the order of their bits read as integers, and PyTorch compares
    these without turning them to float32 and back.
    """
    bits = int(torch.tensor(bound, dtype=torch.bfloat16).view(torch.int16))
    torch.clamp(x.view(torch.int16), max=bits, out=out.view(torch.int16))
    return out


def _maximum(x: Tensor, other: Tensor, *, out: Tensor) -> Tensor:
    """`torch.maximum` of bfloat16 values and others that are not negative, in the same way."""
    torch.maximum(x.view(torch.int16), other.view(torch.int16), out=out.view(torch.int16))
    return out


SCREEN_ROWS = 16
"""First-pair candidates per step of the screening: few enough for the caches, enough for two threads."""

MARGIN = 2.0
"""How many times larger than the largest error seen an error may be without harm."""
