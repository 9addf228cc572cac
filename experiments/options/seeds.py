"""Seeds on the command line: how many, which, or a range of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

from tyro.constructors import PrimitiveConstructorSpec

from experiments.engine.runtime import UserError


def parse_seeds(words: Sequence[str]) -> tuple[int, ...]:
    """Seeds from `5` (0 to 4), `3 7 11` or `10-19`.

    Raises:
        UserError: If a word is neither, a seed is there twice, or there is none.
    """
    seeds: list[int] = []
    try:
        if len(words) == 1 and "-" not in words[0][1:]:
            count = int(words[0])
            if count < 1:
                raise UserError(f"seeds must be at least 1, got {count}")
            return tuple(range(count))
        for word in words:
            first, dash, last = word.partition("-")
            seeds += range(int(first), int(last) + 1) if dash else [int(word)]
    except ValueError as error:
        raise UserError(
            f"seeds must be a number of them (5), a list (3 7 11) or a range (10-19), got "
            f"{' '.join(words)!r}"
        ) from error
    if not seeds:
        raise UserError(f"seeds must be at least one, got {' '.join(words)!r}")
    if len(set(seeds)) != len(seeds):
        raise UserError(f"seeds: every seed once, got {' '.join(words)}")
    return tuple(seeds)


def _words(seeds: tuple[int, ...]) -> list[str]:
    """The shortest words that `parse_seeds` reads as these seeds."""
    counted = seeds == tuple(range(len(seeds)))
    return [str(len(seeds))] if counted else [str(seed) for seed in seeds]


Seeds = Annotated[
    tuple[int, ...],
    PrimitiveConstructorSpec(
        nargs="*",
        metavar="[STR [STR ...]]",
        instance_from_str=parse_seeds,
        is_instance=lambda value: isinstance(value, tuple),
        str_from_instance=_words,
    ),
]
"""Type of an option `--seeds 5`, `--seeds 3 7 11` or `--seeds 10-19`."""
