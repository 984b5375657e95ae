"""Networks of the low-level and the end-to-end policy, and the high-level policy."""

from __future__ import annotations

from quadhrl.policies.actor_critic import ActorCritic, NetworkConfig
from quadhrl.policies.high_level import HighLevelConfig, HighLevelPolicy
from quadhrl.policies.objective import Direction, ObjectiveTerm, PairTargets

__all__ = [
    "ActorCritic",
    "Direction",
    "HighLevelConfig",
    "HighLevelPolicy",
    "NetworkConfig",
    "ObjectiveTerm",
    "PairTargets",
]
