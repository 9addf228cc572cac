"""Modules that register environments, methods, gates or predictors of a user's own.

A registration lives in the process that made it. A worker process of a study imports the same
modules again, so each `register` notes who called it; and any process imports those that are named
to it, on the command line or in the environment variable `PPL_JAX_IMPORT`.
"""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Iterable

VARIABLE = "PPL_JAX_IMPORT"
MAIN = "__main__"

_REGISTERED: dict[str, None] = {}


def note_caller() -> None:
    """Remember the module that called the function that calls this one."""
    name = sys._getframe(2).f_globals.get("__name__")
    if name:
        _REGISTERED[name] = None


def noted() -> tuple[str, ...]:
    """Modules that have registered something, in order; the program itself is `MAIN`."""
    return tuple(_REGISTERED)


def named() -> tuple[str, ...]:
    """Modules that `PPL_JAX_IMPORT` names, divided by commas."""
    return tuple(name for name in os.environ.get(VARIABLE, "").split(",") if name.strip())


def import_modules(names: Iterable[str]) -> None:
    """Import modules for what they register; the current folder is looked through last.

    Raises:
        ValueError: One line, if one cannot be imported.
    """
    for name in names:
        if os.getcwd() not in sys.path and "" not in sys.path:
            sys.path.append(os.getcwd())
        try:
            importlib.import_module(name.strip())
        except Exception as error:  # whatever a user's module raises
            reason = (str(error).splitlines() or [""])[0]
            raise ValueError(
                f"module {name.strip()!r} cannot be imported: {type(error).__name__}: {reason}"
            ) from error
