"""The options of `ppl play` that a command line names; a resumed session is compared with them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

_OF_THE_COMMAND = ("out", "resume", "host", "port", "expose", "words", "settings")


def named_options(command: Any, words: Sequence[str]) -> dict[str, Any]:
    """Settings of run and session that a command line names, with their parsed values.

    Args:
        command: The parsed command: a record of its options.
        words: Words of the command line.
    """
    named = set(_named(words))
    of_session = {
        name: value
        for name, value in vars(command).items()
        if name not in _OF_THE_COMMAND and (name in named or (name == "env" and value is not None))
    }
    return of_session | command.settings


def _named(words: Iterable[str]) -> Iterable[str]:
    for word in words:
        if word.startswith("--"):
            name = word[2:].partition("=")[0].replace("-", "_")
            yield from (name, name.removeprefix("no_"))
