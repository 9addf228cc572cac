"""The worlds: `make(name)` builds one, `register` adds one's own."""

from envs.registry import card, known, make, register, registered, unknown

__all__ = ["card", "known", "make", "register", "registered", "unknown"]
