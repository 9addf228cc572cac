"""Checks of arguments: names that are not known, numbers that cannot be computed with."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import Any

import numpy as np
from jax.core import Tracer

LARGEST = 1e19  # its square is still a float32: losses and Adam square what they get
LARGEST_WHOLE = 2**31 - 1  # an int32


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


def check_number(argument: str, value: Any) -> None:
    """Check that numbers are finite, and small enough for float32 or int32.

    Args:
        argument: Name in the message.
        value: A number, or an array of them.

    Raises:
        ValueError: One line naming the argument, its value and what is allowed.
    """
    numbers = np.asarray(value)
    shown = numbers.tolist() if numbers.ndim else value
    if not np.isfinite(numbers).all():
        raise ValueError(f"{argument} must be a finite number, got {shown}")
    real = np.issubdtype(numbers.dtype, np.floating)
    largest, said = (LARGEST, f"{LARGEST:g}") if real else (LARGEST_WHOLE, str(LARGEST_WHOLE))
    if (np.abs(numbers.astype(np.float64)) > largest).any():
        raise ValueError(f"{argument} must be at most {said} in size, got {shown}")


def check_limit(argument: str, value: Any, limit: str, most: int) -> None:
    """Check that numbers do not exceed a limit; traced ones have no value to check.

    Args:
        argument: Name in the message.
        value: A number, or an array of them.
        limit: What the limit is, in the message.
        most: The limit.

    Raises:
        ValueError: One line naming the argument, its value and the limit.
    """
    if not isinstance(value, Tracer) and (np.asarray(value) > most).any():
        shown = np.asarray(value).tolist()
        raise ValueError(f"{argument} must not exceed {limit} ({most}), got {shown}")
