"""The worlds: `make(name)` builds one, `register` adds one's own."""

from envs.registry import make, register, registered

__all__ = ["make", "register", "registered"]
