"""The environments: `make(name)` builds one, `register` adds one of your own."""

from envs.cards import EnvCard, card
from envs.registry import known, make, register, registered, unknown

__all__ = ["EnvCard", "card", "known", "make", "register", "registered", "unknown"]
