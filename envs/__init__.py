"""The environments: `make(name)` builds one, `register` adds one of your own."""

from envs.registry import known, make, register, registered, unknown

__all__ = ["known", "make", "register", "registered", "unknown"]
