"""Progress of a long run: a bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import datetime
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from experiments.engine.compile_log import announce_compile


class Progress:
    """Tells how far a run is and when it will be done; compile time does not count.

    Use as a context manager; call `start` when the program is compiled. On a terminal the bar, the
    percentage and the time left are always visible; the note has a line of its own, cut to fit.
    """

    def __init__(self, total: int, what: str, done: int = 0):
        self.total, self.what = total, what
        self.first = self.done = done
        self.note = ""
        self.began = time.perf_counter()
        self.bar: Any = _terminal_bar() if sys.stderr.isatty() else None

    def __enter__(self) -> Progress:
        if self.bar is not None:
            self.bar.start()
            self.task = self.bar.add_task(
                self.what, total=self.total, completed=self.done, note="starting"
            )
        return self

    def __exit__(self, *_: object) -> None:
        if self.bar is not None:
            self.bar.stop()

    def start(self) -> None:
        """The clock for the remaining time starts now."""
        self.began = time.perf_counter()
        self._show(self.note)

    @contextmanager
    def compiling(self, what: str, key: str | None = None) -> Iterator[None]:
        """Show what compiles and how long that took last time; its time does not count.

        Args:
            what: The program, for people: "training step".
            key: Distinguishes it from other programs of that name; `what` if None.
        """
        began = time.perf_counter()
        with announce_compile(what, key, quiet=self.bar is not None) as phrase:
            self._show(phrase)
            yield
        self.began += time.perf_counter() - began
        self._show(self.note)

    def say(self, note: str) -> None:
        """Show what is under way."""
        self.note = note
        if self.bar is not None:
            self._show(note)
        else:
            print(f"{self.what}: {note}", file=sys.stderr, flush=True)

    def update(self, done: int, note: str) -> None:
        """`done` of the total are done."""
        self.done, self.note = done, note
        if self.bar is not None:
            self._show(note)
            return
        spent, left = time.perf_counter() - self.began, self.left() or 0.0
        print(
            f"{self.what} {done}/{self.total}  {note}  [{spent:.0f}s, {left:.0f}s left]",
            file=sys.stderr,
            flush=True,
        )

    def left(self) -> float | None:
        """Seconds left at the speed so far; None before anything is done."""
        if self.done == self.first:
            return None
        spent = time.perf_counter() - self.began
        return spent / (self.done - self.first) * (self.total - self.done)

    def _show(self, note: str) -> None:
        if self.bar is not None:
            left = self.left()
            ends = None if left is None else time.perf_counter() + left
            self.bar.update(self.task, completed=self.done, note=note, ends=ends)
            self.bar.refresh()


def _terminal_bar() -> Any:
    """A line with the bar on standard error, and the note in a line of its own below it."""
    from rich.console import Console, RenderableType
    from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn
    from rich.text import Text

    class TimeLeft(ProgressColumn):
        """The time left, which runs down between two updates."""

        def render(self, task: Task) -> Text:
            ends = task.fields.get("ends")
            if ends is None:
                return Text("-:--:-- left")
            left = max(round(ends - time.perf_counter()), 0)
            return Text(f"{datetime.timedelta(seconds=left)} left")

    class Bar(Progress):
        def get_renderables(self) -> Iterator[RenderableType]:
            yield self.make_tasks_table(self.tasks)
            for task in self.tasks:
                yield Text(f"  {task.fields['note']}", no_wrap=True, overflow="ellipsis")

    return Bar(
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=None),
        TextColumn("{task.percentage:>3.0f}%", markup=False),
        TimeLeft(),
        console=Console(stderr=True),
        expand=True,
    )
