"""Worlds by name. A user's own world is one `register` call away from the command line."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from envs import cards
from ppl_jax.cards import EnvCard

BRAX = "brax:"

_MAKERS: dict[str, Callable[..., Any]] = {}
_CARDS: dict[str, EnvCard] = {}


def register(name: str, maker: Callable[..., Any], card: EnvCard | None = None) -> None:
    """Make `make(name)` call `maker`; a name taken already is an error.

    Args:
        name: As the user types it.
        maker: `maker(**options) -> Environment`.
        card: What the environment says of itself; the defaults of `EnvCard` where None.
    """
    if name in _MAKERS:
        raise ValueError(f"environment {name!r} is registered already")
    _MAKERS[name] = maker
    _CARDS[name] = card or EnvCard(name)


def card(name: str) -> EnvCard:
    """What an environment says of itself; it is not built for that.

    Raises:
        ValueError: If no environment has that name.
    """
    if not known(name):
        raise ValueError(unknown(name))
    return _CARDS.get(name, EnvCard(name))


def registered() -> tuple[str, ...]:
    """Known names, sorted."""
    return tuple(sorted(_MAKERS))


def known(name: str) -> bool:
    """Whether `make` may know it: a registered world, or one of brax."""
    return name in _MAKERS or name.startswith(BRAX)


def make(name: str, **options: Any) -> Any:
    """Build the world `name`; "brax:NAME" is a brax environment.

    Raises:
        ValueError: If no world has that name.
    """
    if name.startswith(BRAX):
        from envs.adapters.brax import make_brax

        return make_brax(name.removeprefix(BRAX), **options)
    if name not in _MAKERS:
        raise ValueError(unknown(name))
    return _MAKERS[name](**options)


def unknown(name: str) -> str:
    """What to say of a name that no world has."""
    return f"unknown environment {name!r}: choose one of {', '.join(registered())} or {BRAX}NAME"


def _driving(**options: Any) -> Any:
    from envs.driving.env import make_driving

    return make_driving(**options)


def _table_wiping(**options: Any) -> Any:
    from envs.manipulation.tasks.wiping import make_table_wiping

    return make_table_wiping(**options)


def _nut_assembly(**options: Any) -> Any:
    from envs.manipulation.tasks.nut import make_nut_assembly

    return make_nut_assembly(**options)


register("driving", _driving, cards.DRIVING)
register("nut_assembly", _nut_assembly, cards.NUT_ASSEMBLY)
register("table_wiping", _table_wiping, cards.TABLE_WIPING)
