"""Checks of arguments: names that are not known, numbers that cannot be computed with."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import Any

import numpy as np

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
    largest = LARGEST if np.issubdtype(numbers.dtype, np.floating) else LARGEST_WHOLE
    if (np.abs(numbers.astype(np.float64)) > largest).any():
        shape = f"{largest:g}" if largest == LARGEST else str(largest)
        raise ValueError(f"{argument} must be at most {shape} in size, got {shown}")
