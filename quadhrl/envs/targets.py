"""The sequence of footstep targets of a trot (paper, section IV-A; facts of the authors' code, 1.5).

Pairs alternate: pair 0 is (FL, RR) on its nominal places, pair 1, the first to be hit, is (FR, RL), and so on. At any time
one pair is *active* (its feet have next targets) and the other is the *stance* pair (its feet stand on their current ones).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from quadhrl.errors import check_range
from quadhrl.hashing import hash_key, hash_uniform
from quadhrl.sim import BlockTerrain

__all__ = ["FootstepTargets", "TargetConfig"]


@dataclass
class TargetConfig:
    """How random target sequences are drawn."""

    max_step: float = 0.2
    """Step length per pair is drawn from U(0, this) [m], once per episode."""
    max_heading: float = 180.0
    """Heading of the sequence is drawn from U(-this, this) [degrees], once per episode."""
    max_shift: float = 0.1
    """Every target is shifted by U(-this, this) in x and in y [m]."""
    ramp_pairs: int = 10
    """Pairs over which the shift grows from 0 to its full size; 1 for full shifts from the start."""
    on_blocks: bool = False
    """Move targets that lie over a gap to the nearest block; in the paper they stay where they are drawn."""
    lateral_ratio: float = 0.33
    """Step length sideways relative to forward: an ellipse over the heading; 1 for a circle."""

    def validate(self) -> None:
        """Check every field.

        Raises:
            InputError: a field is out of its range.
        """
        check_range(self, "targets", "max_step", 0, 1, "m")
        check_range(self, "targets", "max_heading", 0, 180, "degrees")
        check_range(self, "targets", "max_shift", 0, 0.5, "m")
        check_range(self, "targets", "ramp_pairs", 1)
        check_range(self, "targets", "lateral_ratio", 0, 1, above=True)


class FootstepTargets:
    """Each world's current, next and following targets.

    Args:
        config: how sequences are drawn.
        nominal: nominal foot positions around the origin [m], [4, 2].
        terrain: the worlds that the targets lie in, N of them.
    """

    def __init__(self, config: TargetConfig, nominal: Tensor, terrain: BlockTerrain) -> None:
        config.validate()
        self.config, self._nominal, self._terrain = config, nominal, terrain
        num_worlds = terrain.num_worlds
        device = nominal.device
        self.index = torch.ones(num_worlds, dtype=torch.long, device=device)
        """Number of the active pair [N]; odd: (FR, RL), even: (FL, RR)."""
        self.position = nominal.expand(num_worlds, 4, 2).clone()
        """World target of each foot [N, 4, 2], m: the next one of an active foot, the current one of a stance foot."""
        self.following = torch.zeros(num_worlds, 2, 2, device=device)
        """World targets of the stance pair after its current ones, front foot then rear foot [N, 2, 2], m."""
        self.footholds = nominal.expand(num_worlds, 4, 2).clone()
        """World target that each foot hit last [N, 4, 2], m: the one that a stance foot stands on, that an active foot left."""
        self._key = torch.zeros(
            num_worlds, dtype=torch.long, device=device
        )  # what each world's randomness follows from
        self._step = torch.zeros(num_worlds, 2, device=device)  # displacement per pair, m
        self._pairs = torch.tensor([[0, 3], [1, 2]], device=device)  # feet of even and of odd pairs, front foot first
        self._active = torch.tensor([[True, False, False, True], [False, True, True, False]], device=device)

    @property
    def active(self) -> Tensor:
        """Which feet have next targets [N, 4]."""
        return self._active[self.index % 2]

    @property
    def stance_feet(self) -> Tensor:
        """Indices of the stance pair's feet, front foot first [N, 2]."""
        return self._pairs[(self.index + 1) % 2]

    def reset(self, worlds: Tensor) -> None:
        """Draw new sequences, starting from the nominal places around the origin; each follows from its terrain's key.

        Args:
            worlds: the worlds, [K].
        """
        self._key[worlds] = key = self._terrain.key[worlds]
        draws = hash_uniform(hash_key(key, 0), 2)
        length = draws[:, 0] * self.config.max_step
        heading = (2.0 * draws[:, 1] - 1.0) * torch.pi * self.config.max_heading / 180.0
        cos, sin, ratio = torch.cos(heading), torch.sin(heading), self.config.lateral_ratio
        length = length * ratio / torch.sqrt(sin**2 + (ratio * cos) ** 2)
        self._step[worlds] = torch.stack([length * cos, length * sin], -1)
        self.index[worlds] = 1
        self.position[worlds] = self._nominal
        self.footholds[worlds] = self._nominal
        pair_1, pair_2 = self._draw(1), self._draw(2)
        self.position[worlds[:, None], self._pairs[1]] = pair_1[worlds]
        self.following[worlds] = pair_2[worlds]

    def adopt(self, position: Tensor, following: Tensor) -> None:
        """Take over the targets that a policy chose, in every world.

        Args:
            position: the feet's next (active) or current (stance) targets [N, 4, 2], m.
            following: the stance pair's following targets [N, 2, 2], m.
        """
        self.position, self.following = position, following

    def state_dict(self) -> dict[str, Tensor]:
        """Where every world's sequence stands."""
        names = ("index", "position", "following", "footholds")
        return {name: getattr(self, name) for name in names} | {"key": self._key, "step": self._step}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore what `state_dict` gave."""
        device = self._nominal.device
        for name in ("index", "position", "following", "footholds"):
            setattr(self, name, state[name].to(device))
        self._key, self._step = state["key"].to(device), state["step"].to(device)

    def advance(self, hit: Tensor) -> None:
        """Move on to the next pair in the worlds where the active pair was hit.

        Args:
            hit: [N], bool.
        """
        arrived = torch.zeros_like(self.position).scatter_(
            1, self.stance_feet[..., None].expand(-1, -1, 2), self.following
        )
        stance = ~self.active
        self.footholds = torch.where(hit[:, None, None], self.position, self.footholds)
        self.position = torch.where((hit[:, None] & stance)[..., None], arrived, self.position)
        self.index = self.index + hit
        self.following = torch.where(hit[:, None, None], self._draw(self.index + 1), self.following)

    def _draw(self, pair: Tensor | int) -> Tensor:
        """Draw the targets of pair number ``pair`` in every world [N, 2, 2]; the worlds that need none ignore theirs."""
        device = self._nominal.device
        number = torch.as_tensor(pair, device=device).expand(len(self.index))
        shift = hash_uniform(hash_key(self._key, number), 4).view(-1, 2, 2) * 2.0 - 1.0
        ramp = ((number - 1) / max(self.config.ramp_pairs - 1, 1)).clamp(max=1.0) if self.config.ramp_pairs > 1 else 1.0
        scale = self.config.max_shift * torch.as_tensor(ramp, device=device).expand(len(number))
        nominal = self._nominal[self._pairs[number % 2]]
        drawn = nominal + ((number - 1)[:, None] * self._step)[:, None] + scale[:, None, None] * shift
        return self._terrain.nearest_ground(drawn) if self.config.on_blocks else drawn
