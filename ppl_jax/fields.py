"""Settings that describe themselves: what a field of a settings class says beside its default.

Help, ranges, groups and sweep axes of the command line, the checks before a run and the tables of
the documentation are all read from these fields.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

KEY = "ppl_jax"


@dataclasses.dataclass(frozen=True)
class About:
    """Metadata of a settings field.

    Attributes:
        help: One sentence, with the unit.
        low, high: Smallest and largest value that is allowed; None where there is no bound.
        choices: Allowed values of a name, or None.
        group: Group on the command line: "run", "world", "method", "gate", "predictor", "expert" or
            "evaluation".
        common: Shown by `--help`, not only by `--help-all`.
    """

    help: str
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] | None = None
    group: str = "method"
    common: bool = False


def setting(
    default: Any,
    help: str,
    *,
    low: float | None = None,
    high: float | None = None,
    choices: Sequence[str] | None = None,
    group: str = "method",
    common: bool = False,
) -> Any:
    """A field of a settings class (a frozen dataclass, or a `flax.struct.dataclass`).

    Args:
        default: Its value where nobody sets it.
        help: One sentence, with the unit.
        low: Smallest value allowed.
        high: Largest value allowed.
        choices: The names that are allowed.
        group: Group on the command line.
        common: Whether `--help` shows it.
    """
    about = About(
        help=help,
        low=low,
        high=high,
        choices=None if choices is None else tuple(choices),
        group=group,
        common=common,
    )
    return dataclasses.field(default=default, metadata={KEY: about})


def about(field: dataclasses.Field[Any]) -> About:
    """Metadata of a field; one without `setting` has its name for help."""
    return field.metadata.get(KEY, About(field.name.replace("_", " ")))
