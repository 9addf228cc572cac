"""Checks of arguments: names that are not known, and the nearest one that is."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """`: did you mean 'x'?` where a known name is near, else the empty string."""
    near = difflib.get_close_matches(name, list(known), n=1, cutoff=0.6)
    return f": did you mean {near[0]!r}?" if near else ""


def check_name(argument: str, name: str, allowed: Iterable[str]) -> None:
    """Check that a name is one of those allowed.

    Args:
        argument: Its name in the message.
        name: Its value.
        allowed: The names that it may be.

    Raises:
        ValueError: One line naming the argument, its value and what is allowed.
    """
    allowed = tuple(allowed)
    if name not in allowed:
        raise ValueError(
            f"{argument} must be one of {', '.join(allowed)}, got {name!r}"
            + did_you_mean(str(name), allowed)
        )
