"""Block terrain with gaps, one random terrain per world (paper, section IV, "Locomotion on challenging terrain")."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import torch
import tyro
from torch import Tensor

from quadhrl.errors import check_range
from quadhrl.hashing import hash_key, hash_uniform

__all__ = ["BlockTerrain", "TerrainConfig"]


@dataclass
class TerrainConfig:
    """Square blocks on a regular grid; each is present with probability `infill`, its top at a random height."""

    infill: Annotated[float, tyro.conf.arg(prefix_name=False)] = 0.9
    """Probability that a block is present, 0 to 1; a missing block is a gap."""
    height_range: Annotated[float, tyro.conf.arg(prefix_name=False)] = 0.05
    """Peak-to-peak range of the block tops, uniform around 0 [m]."""
    block_size: float = 0.2
    """Edge length of a block [m]."""
    gap_depth: float = 2.0
    """Depth of the ground in a gap below height 0 [m]."""
    platform_length: float = 0.8
    """Extent in x of the gap-free, level start platform around the origin [m]; 0 means none."""
    platform_width: float = 0.4
    """Extent in y of the start platform [m]."""

    def validate(self) -> None:
        """Check every field.

        Raises:
            InputError: a field is out of its range.
        """
        check_range(self, "", "infill", 0, 1)
        check_range(self, "", "height_range", 0, 0.5, "m")
        check_range(self, "terrain", "block_size", 0.05, 2, "m")
        check_range(self, "terrain", "gap_depth", 0.5, 10, "m")
        check_range(self, "terrain", "platform_length platform_width", 0, 5, "m")


class BlockTerrain:
    """One random, endless block terrain per world, a pure function of (seed, world's number, episode).

    Block ``(i, j)`` covers ``[i b, (i+1) b) x [j b, (j+1) b)``. The terrain repeats every `PERIOD` blocks. `heights` is the
    only height query: the scan, the simulators' boxes, the renderer and the tests all use it.

    Args:
        config: the terrain's settings; `infill` and `height_range` start every world and can be changed per world.
        num_worlds: number of worlds, N.
        seed: the terrains' seed.
        device: where the height table lives.
    """

    PERIOD = 64
    """Blocks after which the terrain repeats, in x and in y (12.8 m with 0.2 m blocks)."""

    def __init__(
        self, config: TerrainConfig, num_worlds: int, *, seed: int = 0, device: str | torch.device = "cpu"
    ) -> None:
        config.validate()
        self.config = config
        self.num_worlds = num_worlds
        self.seed = seed
        self.device = torch.device(device)
        self.number = torch.arange(num_worlds, device=self.device)
        """Each world's number [N], its index unless `assign` gave it another."""
        self.key = torch.zeros_like(self.number)
        """Hash of seed, number and episode [N]: what else is random in a world's episode can be drawn from it."""
        self.infill = torch.full((num_worlds,), float(config.infill), device=self.device)
        """Per-world infill [N], used at a world's next `regenerate`."""
        self.height_range = torch.full((num_worlds,), float(config.height_range), device=self.device)
        """Per-world height range [m], [N], used at a world's next `regenerate`."""
        self.episode = torch.full((num_worlds,), -1, dtype=torch.long, device=self.device)
        """Number of the terrain that each world stands on [N]; -1 before the first `regenerate`."""
        self.max_height = torch.zeros(num_worlds, device=self.device)
        """Upper bound of the block tops of each world's present terrain [m], [N]."""
        self._table = torch.zeros(num_worlds, self.PERIOD * self.PERIOD, device=self.device)
        self._everyone = torch.arange(num_worlds, dtype=torch.int32, device=self.device)
        self._platform = self._platform_cells()

    def regenerate(self, worlds: Tensor) -> None:
        """Give each of the worlds its next terrain.

        Args:
            worlds: indices of the worlds, [K].
        """
        self.episode[worlds] += 1
        self._build(worlds)

    def assign(self, number: Tensor, infill: Tensor, height_range: Tensor) -> None:
        """Give every world a number and a difficulty of its own, from its next `regenerate` on.

        Args:
            number: worlds of the same number have the same terrains [N], int64.
            infill: [N].
            height_range: [N], m.
        """
        self.number.copy_(number)
        self.infill.copy_(infill)
        self.height_range.copy_(height_range)

    def state_dict(self) -> dict[str, Any]:
        """What every world's present and next terrains follow from, beside the config."""
        names = ("seed", "number", "infill", "height_range", "episode")
        return {name: getattr(self, name) for name in names}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` gave."""
        self.seed = int(state["seed"])
        self.assign(state["number"], state["infill"], state["height_range"])
        self.episode.copy_(state["episode"])
        self._build(torch.arange(self.num_worlds, device=self.device))

    def heights(self, xy: Tensor, worlds: Tensor | None = None) -> Tensor:
        """Height of the ground.

        Args:
            xy: world positions [m], [K, ..., 2].
            worlds: the worlds they lie in, [K]; None for all.

        Returns:
            Height of the block top, or ``-gap_depth`` over a gap [m], [K, ...].
        """
        x, y = xy.unbind(-1)
        return self.heights_at(x.clone(), y.clone(), worlds)

    def heights_at(self, x: Tensor, y: Tensor, worlds: Tensor | None = None) -> Tensor:
        """The same from separate coordinates [K, ...], which are overwritten: the scan's 145,000 points count every pass."""
        inverse = 1.0 / self.config.block_size
        return self._look_up(x.mul_(inverse).floor_().int(), y.mul_(inverse).floor_().int(), worlds)

    def block_heights(self, blocks: Tensor, worlds: Tensor | None = None) -> Tensor:
        """Height of blocks given by their integer indices.

        Args:
            blocks: block indices (i, j), [K, ..., 2].
            worlds: the worlds they lie in, [K]; None for all.

        Returns:
            Block tops [m], [K, ...].
        """
        return self._look_up(blocks[..., 0].int(), blocks[..., 1].int(), worlds)

    def over_gap(self, xy: Tensor, worlds: Tensor | None = None) -> Tensor:
        """Whether positions lie over a gap, [K, ...] bool; arguments as for `heights`."""
        return self.heights(xy, worlds) == -self.config.gap_depth

    def nearest_ground(self, xy: Tensor, worlds: Tensor | None = None) -> Tensor:
        """The nearest position over one of the nine blocks at and around each position; itself if all nine are missing.

        Args:
            xy: world positions [m], [K, ..., 2].
            worlds: the worlds they lie in, [K]; None for all.

        Returns:
            [K, ..., 2], m: the position itself where there is a block, else 0.1 mm inside of a block's edge.
        """
        size, inside = self.config.block_size, 1e-4
        offsets = torch.tensor([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)], device=self.device) * size
        low = (torch.floor(xy / size) * size)[..., None, :] + offsets
        gap = self.over_gap(low + size / 2, worlds)
        candidate = xy[..., None, :].clamp(low + inside, low + size - inside)
        distance = (candidate - xy[..., None, :]).norm(dim=-1).masked_fill(gap, torch.inf)
        nearest = distance.argmin(-1, keepdim=True)
        chosen = candidate.gather(-2, nearest[..., None].expand(*nearest.shape, 2)).squeeze(-2)
        stays = ~self.over_gap(xy, worlds) | gap.all(-1)
        return torch.where(stays[..., None], xy, chosen)

    def _look_up(self, i: Tensor, j: Tensor, worlds: Tensor | None) -> Tensor:
        """Table entries of the blocks (i, j), int32 [K, ...] each; overwrites ``i`` and ``j``."""
        worlds = self._everyone if worlds is None else worlds.int()
        row = worlds.view(-1, *[1] * (i.dim() - 1)) * (self.PERIOD * self.PERIOD)
        index = i.bitwise_and_(self.PERIOD - 1).mul_(self.PERIOD).add_(j.bitwise_and_(self.PERIOD - 1)).add_(row)
        return self._table.view(-1).index_select(0, index.view(-1)).view(index.shape)

    def _build(self, worlds: Tensor) -> None:
        key = hash_key(self.seed, self.number[worlds], self.episode[worlds])
        self.key[worlds] = key
        presence, height = hash_uniform(key, 2 * self.PERIOD * self.PERIOD).view(len(worlds), -1, 2).unbind(-1)
        height_range = self.height_range[worlds]
        tops = (height - 0.5) * height_range[:, None]
        tops = torch.where(presence < self.infill[worlds][:, None], tops, -self.config.gap_depth)
        self._table[worlds] = torch.where(self._platform, 0.0, tops)
        self.max_height[worlds] = height_range / 2

    def _platform_cells(self) -> Tensor:
        """Mask of the start platform's blocks in the table, [PERIOD * PERIOD]."""
        centre = torch.arange(self.PERIOD, device=self.device).float() + 0.5
        centre = torch.where(centre > self.PERIOD / 2, centre - self.PERIOD, centre) * self.config.block_size
        in_x, in_y = centre.abs() < self.config.platform_length / 2, centre.abs() < self.config.platform_width / 2
        return (in_x[:, None] & in_y[None]).flatten()
