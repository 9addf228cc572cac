"""Environments by name. One's own is one `register` call away from the command line."""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from envs.driving.card import DRIVING
from envs.manipulation.cards import LIFT, NUT_ASSEMBLY, TABLE_WIPING
from ppl_jax.cards import DEFAULT, EnvCard, card, register_card
from ppl_jax.plugins import note_caller

if TYPE_CHECKING:
    from ppl_jax.types import Env

BRAX = "brax:"

_MAKERS: dict[str, Callable[..., Env]] = {}
_CHECKED: set[str] = set()


def register(
    name: str, maker: Callable[..., Env], card: EnvCard = DEFAULT, checked: bool = False
) -> None:
    """Make `make(name)` call `maker`.

    Args:
        name: As the user types it.
        maker: `maker(**options) -> Env`; a class will do.
        card: Facts about the environment that need no building of it.
        checked: Its tests call `envs.check.check_env`, so the first `make` need not.

    Raises:
        ValueError: If the name is no word, or taken, or `maker` cannot be called.
    """
    if not name or name.startswith(BRAX) or any(c.isspace() or c in "/\\" for c in name):
        raise ValueError(f"an environment's name must be one word without {BRAX!r}, got {name!r}")
    if name in _MAKERS:
        raise ValueError(f"environment {name!r} is registered already")
    if not callable(maker):
        raise ValueError(f"environment {name!r}: the maker must be callable, got {maker!r}")
    _MAKERS[name] = maker
    note_caller()
    register_card(name, card)
    if checked:
        _CHECKED.add(name)


def registered() -> tuple[str, ...]:
    """Known names, sorted."""
    return tuple(sorted(_MAKERS))


def known(name: str) -> bool:
    """Whether `make` may know it: a registered environment, or one of brax."""
    return name in _MAKERS or name.startswith(BRAX)


def make(name: str, **options: Any) -> Env:
    """Build the environment `name`; "brax:NAME" is a brax environment.

    The first one of a name is checked (`envs.check.check_env`).

    Args:
        name: Name.
        **options: Of its maker. `physics` chooses among the engines that its card names; "auto"
            goes with every environment.

    Raises:
        ValueError: If no environment has that name, it has no such physics, or what was built does
            not fit: one line.
    """
    options = _with_physics(name, options)
    if name.startswith(BRAX):
        from envs.adapters.brax import make_brax

        return make_brax(name.removeprefix(BRAX), **options)
    if name not in _MAKERS:
        raise ValueError(unknown(name))
    env = _MAKERS[name](**options)
    if name not in _CHECKED:
        from envs.check import check_env

        check_env(env, name)
        _CHECKED.add(name)
    return env


def check_physics(name: str, physics: str) -> None:
    """Refuse a physics that an environment does not have.

    Raises:
        ValueError: One line.
    """
    choices = card(name).physics
    if physics != "auto" and physics not in choices:
        allowed = f"auto or one of {', '.join(choices)}" if choices else "auto"
        raise ValueError(f"physics must be {allowed} for {name!r}, got {physics!r}")


def _with_physics(name: str, options: dict[str, Any]) -> dict[str, Any]:
    physics = options.get("physics", "auto")
    check_physics(name, physics)
    if card(name).physics:
        return options
    return {key: value for key, value in options.items() if key != "physics"}


def unknown(name: str) -> str:
    """The message for a name that no environment has."""
    close = difflib.get_close_matches(name, _MAKERS, n=1)
    hint = f", did you mean {close[0]!r}?" if close else ":"
    return (
        f"unknown environment {name!r}{hint} choose one of {', '.join(registered())} or {BRAX}NAME"
    )


def _shipped(module: str, maker: str) -> Callable[..., Env]:
    """A maker whose module is imported when it is called: `import envs` stays light."""

    def make_shipped(**options: Any) -> Env:
        return getattr(importlib.import_module(module), maker)(**options)

    return make_shipped


_ARM = "envs.manipulation.make"
register("driving", _shipped("envs.driving.make", "make_driving"), DRIVING, checked=True)
register("lift", _shipped(_ARM, "make_lift"), LIFT, checked=True)
register("nut_assembly", _shipped(_ARM, "make_nut_assembly"), NUT_ASSEMBLY, checked=True)
register("table_wiping", _shipped(_ARM, "make_table_wiping"), TABLE_WIPING, checked=True)
