"""The worlds: `make(name)` builds one, `register` adds one's own."""

from envs.registry import known, make, register, registered, unknown

__all__ = ["known", "make", "register", "registered", "unknown"]
