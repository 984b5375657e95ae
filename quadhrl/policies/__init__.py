"""Networks of the low-level and the end-to-end policy."""

from __future__ import annotations

from quadhrl.policies.actor_critic import ActorCritic, NetworkConfig

__all__ = ["ActorCritic", "NetworkConfig"]
