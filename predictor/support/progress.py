"""Progress of long work: a bar on a terminal, plain lines where the output goes into a file."""

import time
from collections.abc import Iterable, Iterator
from types import TracebackType
from typing import TypeVar

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

Item = TypeVar("Item")

PARTS = 10
"""Number of plain lines in which the whole work is told."""
SOON_S, LATE_S = 2.0, 60.0
"""Shortest and longest time between two plain lines [s]."""
_BAR = 16


class WorkShown:
    """Shows how much of some work is done, inside `with`.

    Args:
        what: name of the work.
        total: number of its parts.
        done: number of parts that were done before.
        console: terminal or file; None takes standard output.
    """

    def __init__(self, what: str, total: int, done: int = 0, console: Console | None = None) -> None:
        """Shows nothing before `with`."""
        self._what, self._total, self._done, self._before = what, total, done, done
        self._console = console or Console()
        columns = (TextColumn(escape(what)), BarColumn(_BAR), MofNCompleteColumn(), TimeRemainingColumn())
        self._bar: Progress | None = None
        if self._console.is_terminal:
            self._bar = Progress(*columns, TextColumn("{task.fields[note]}", markup=False), console=self._console)
        self._began = self._told = time.monotonic()
        self._told_at = done

    def __enter__(self) -> "WorkShown":
        """Begins, with the bar if there is a terminal."""
        self._began = self._told = time.monotonic()
        if self._bar is not None:
            self._bar.start()
            self._task = self._bar.add_task("", total=self._total, completed=self._done, note="")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Gives the terminal back; in a file, tells the end of the work."""
        if self._bar is not None:
            self._bar.stop()
        elif kind is None and self._told_at != self._done:
            self._tell()

    def to(self, done: int, note: str = "") -> None:
        """Shows that this many parts are done; the note stands beside the bar."""
        self._done = done
        if self._bar is not None:
            self._bar.update(self._task, completed=done, note=note)
            return
        since = time.monotonic() - self._told
        tenth = PARTS * done // max(1, self._total) > PARTS * self._told_at // max(1, self._total)
        if since >= LATE_S or (tenth and since >= SOON_S):
            self._tell(note)

    def advance(self, parts: int = 1) -> None:
        """Shows that some more parts are done."""
        self.to(self._done + parts)

    def say(self, line: str) -> None:
        """Prints a line that stays, above the bar if there is one."""
        self._console.print(line, markup=False, highlight=False, soft_wrap=True)

    def _tell(self, note: str = "") -> None:
        """Prints a plain line: how much is done, how long it took and what is left."""
        self._told, self._told_at = time.monotonic(), self._done
        took_s = self._told - self._began
        line = f"{self._what}: {self._done} of {self._total}, {took_s:.0f} s"
        parts = self._done - self._before
        if 0 < parts and self._done < self._total:
            line += f", about {took_s / parts * (self._total - self._done):.0f} s left"
        self.say(f"{line}, {note}" if note else line)


def track(items: Iterable[Item], what: str, total: int | None = None) -> Iterator[Item]:
    """Yields items and shows how many there were; without `total`, items must have a length."""
    with WorkShown(what, len(items) if total is None else total) as shown:  # type: ignore[arg-type]
        for item in items:
            yield item
            shown.advance()
