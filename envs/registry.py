"""Worlds by name. A user's own world is one `register` call away from the command line."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

_MAKERS: dict[str, Callable[..., Any]] = {}


def register(name: str, maker: Callable[..., Any]) -> None:
    """Make `make(name)` call `maker`; a name taken already is an error."""
    if name in _MAKERS:
        raise ValueError(f"environment {name!r} is registered already")
    _MAKERS[name] = maker


def registered() -> tuple[str, ...]:
    """Known names, sorted."""
    return tuple(sorted(_MAKERS))


def make(name: str, **options: Any) -> Any:
    """Build the world `name`.

    Raises:
        ValueError: If no world has that name.
    """
    if name not in _MAKERS:
        raise ValueError(f"unknown environment {name!r}: choose one of {', '.join(registered())}")
    return _MAKERS[name](**options)


def _driving(**options: Any) -> Any:
    from envs.driving.env import make_driving

    return make_driving(**options)


def _table_wiping(**options: Any) -> Any:
    from envs.manipulation.wiping import make_table_wiping

    return make_table_wiping(**options)


def _nut_assembly(**options: Any) -> Any:
    from envs.manipulation.nut import make_nut_assembly

    return make_nut_assembly(**options)


register("driving", _driving)
register("nut_assembly", _nut_assembly)
register("table_wiping", _table_wiping)
