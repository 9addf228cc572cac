"""Progress of a long run: a bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import time
from typing import Any


class Progress:
    """Tells how far a run is and when it will be done; compile time does not count.

    Use as a context manager; call `start` when the program is compiled.
    """

    def __init__(self, total: int, what: str, done: int = 0):
        self.total, self.what = total, what
        self.first = self.done = done
        self.began = time.perf_counter()
        self.bar: Any = None
        if sys.stderr.isatty():
            from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

            self.bar = Progress(
                TextColumn("{task.description}"),
                BarColumn(),
                TextColumn("{task.percentage:.0f}%"),
                TimeRemainingColumn(),
                TextColumn("{task.fields[note]}"),
                transient=False,
            )

    def __enter__(self) -> Progress:
        if self.bar is not None:
            self.bar.start()
            self.task = self.bar.add_task(
                self.what, total=self.total, completed=self.done, note="compiling"
            )
        return self

    def __exit__(self, *_: object) -> None:
        if self.bar is not None:
            self.bar.stop()

    def start(self) -> None:
        """The clock for the remaining time starts now."""
        self.began = time.perf_counter()
        if self.bar is not None:
            self.bar.reset(self.task, total=self.total, completed=self.done, note="")

    def update(self, done: int, note: str) -> None:
        """`done` of the total are done."""
        self.done = done
        if self.bar is not None:
            self.bar.update(self.task, completed=done, note=note)
            return
        spent = time.perf_counter() - self.began
        left = spent / max(done - self.first, 1) * (self.total - done)
        print(
            f"{self.what} {done}/{self.total}  {note}  [{spent:.0f}s, {left:.0f}s left]",
            file=sys.stderr,
            flush=True,
        )
