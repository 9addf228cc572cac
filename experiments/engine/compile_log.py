"""How long each program took to compile the last time, so that a wait can be announced."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from experiments.engine.files import write_text_atomic
from experiments.engine.runtime import cache_folder

FILE = "compile_times.json"
WORTH_TELLING_S = 1.0  # a shorter wait needs no announcement


def _path() -> Path:
    """In the folder of compiled programs: emptying it forgets their times too."""
    return cache_folder() / FILE


def _read() -> dict[str, float]:
    try:
        found = json.loads(_path().read_text())
    except (OSError, ValueError):
        return {}
    if not isinstance(found, dict):
        return {}
    return {name: s for name, s in found.items() if isinstance(s, int | float) and s >= 0}


def last_time(key: str) -> float | None:
    """Seconds that the program `key` took last time; None if it was never compiled here."""
    return _read().get(key)


def remember(key: str, seconds: float) -> None:
    """Keep how long a program took; where nothing can be written, nothing is kept."""
    try:
        _path().parent.mkdir(parents=True, exist_ok=True)
        text = json.dumps(_read() | {key: round(seconds, 2)}, indent=1, sort_keys=True)
        write_text_atomic(_path(), text + "\n")
    except OSError:
        return


def phrase(name: str, key: str) -> str:
    """The announcement: "compiling NAME", with the time it took before if that is worth it."""
    before = last_time(key)
    if before is None:
        return f"compiling {name} (for the first time)"
    if before < WORTH_TELLING_S:  # it was read from the cache
        return f"compiling {name}"
    return f"compiling {name} (took {before:.0f} s last time)"


@contextmanager
def announce_compile(name: str, key: str | None = None, quiet: bool = False) -> Iterator[str]:
    """Announce on standard error what compiles, and remember how long it took.

    Args:
        name: Name of the program, for people: "training step".
        key: Distinguishes it from other programs of that name; the name itself if None.
        quiet: Only remember: the caller shows the phrase.

    Yields:
        The phrase that announces it.
    """
    key = name if key is None else key
    text = phrase(name, key)
    if not quiet:
        before = last_time(key)
        if before is None or before >= WORTH_TELLING_S:
            print(text, file=sys.stderr, flush=True)
    began = time.perf_counter()
    yield text
    remember(key, time.perf_counter() - began)
