"""Progress display of commands: bars on a terminal, lines elsewhere, and the remaining time."""

from __future__ import annotations

import argparse
import contextlib
import sys
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING

from yid_ocp.progress import NULL_PROGRESS, AcceptedIterate, Progress

if TYPE_CHECKING:
    import rich.progress

_MIN_LINE_INTERVAL = 5.0
"""Least time between two lines of one tenth of a stage [s]."""
_MIN_ESTIMATE_TIME = 2.0
"""Time that a stage has to last before the rest of it is guessed [s]."""


class _RemainingTime:
    """Estimator of the remaining time of a stage from its finished parts."""

    def __init__(self) -> None:
        self._first: tuple[int, float] | None = None

    def remaining_text(self, done: int, total: int) -> str:
        """Text with the remaining time; empty for short stages or before an estimate exists."""
        now = time.monotonic()
        if self._first is None:
            # what stood there before this run began took no time
            self._first = (done, now)
        known, begun = self._first
        if done <= known or done >= total or now - begun < _MIN_ESTIMATE_TIME:
            return ""
        return f", about {_format_duration((now - begun) * (total - done) / (done - known))} left"


def _format_duration(seconds: float) -> str:
    """A duration as text in seconds, minutes or hours."""
    for unit, size in (("h", 3600.0), ("min", 60.0)):
        if seconds >= 1.5 * size:
            return f"{seconds / size:.1f} h" if unit == "h" else f"{seconds / size:.0f} min"
    return f"{seconds:.0f} s"


class LineProgress:
    """Progress as lines on standard error, for logs and pipes.

    One for every stage and iterate, for every tenth of a stage, and for what else is done `_MIN_LINE_INTERVAL` after the last line.
    """

    def __init__(self) -> None:
        self._tenths, self._last, self._left = 0, 0.0, _RemainingTime()

    def begin_stage(self, text: str) -> None:
        """See `Progress`."""
        self._tenths, self._last, self._left = 0, time.monotonic(), _RemainingTime()
        print(f"{text} ...", file=sys.stderr, flush=True)

    def report_iterate(self, entry: AcceptedIterate) -> None:
        """See `Progress`."""
        print(f"  {_format_iterate(entry)}", file=sys.stderr, flush=True)

    def report_parts_done(self, done: int, total: int, text: str) -> None:
        """See `Progress`."""
        tenths, left = 10 * done // max(total, 1), self._left.remaining_text(done, total)
        if (
            tenths > self._tenths or time.monotonic() > self._last + _MIN_LINE_INTERVAL
        ):  # a line for every frame would be too many
            self._tenths, self._last = tenths, time.monotonic()
            print(f"  {done} of {total}, {text}{left}", file=sys.stderr, flush=True)


class _BarProgress:
    """Progress as one bar for the running stage, below a line for each finished stage."""

    def __init__(self, bars: rich.progress.Progress) -> None:
        self._bars = bars
        self._task: rich.progress.TaskID | None = None
        self._text, self._left, self._begun = "", _RemainingTime(), 0.0

    def begin_stage(self, text: str) -> None:
        """See `Progress`."""
        self.finish_stage()
        self._text, self._left, self._begun = text, _RemainingTime(), time.monotonic()
        self._task = self._bars.add_task(text, total=None)

    def report_iterate(self, entry: AcceptedIterate) -> None:
        """See `Progress`."""
        if self._task is not None:
            self._bars.update(self._task, description=f"{self._text}: {_format_iterate(entry)}")

    def report_parts_done(self, done: int, total: int, text: str) -> None:
        """See `Progress`."""
        if self._task is not None:
            words = f"{self._text}: {done} of {total}, {text}{self._left.remaining_text(done, total)}"
            self._bars.update(self._task, description=words, completed=done, total=total)

    def finish_stage(self) -> None:
        """Finish the running stage and print its duration."""
        if self._task is not None:
            self._bars.remove_task(self._task)
            self._task = None
            spent = _format_duration(time.monotonic() - self._begun)
            self._bars.console.print(f"{self._text}: {spent}", markup=False, highlight=False)


def _format_iterate(entry: AcceptedIterate) -> str:
    """One line of text on an accepted point."""
    note = f", {entry.note}" if entry.note else ""
    return f"iteration {entry.iteration}, cost {entry.cost:.6g}, {entry.seconds:.1f} s{note}"


@contextlib.contextmanager
def show_progress(arguments: argparse.Namespace) -> Iterator[Progress]:
    """Context manager that yields a progress display on standard error.

    Bars on a terminal. Elsewhere lines, for logs, or nothing where a program reads the result (`--json`); nothing where
    it is asked to be quiet.
    """
    terminal = sys.stderr.isatty()
    if arguments.quiet or (arguments.json and not terminal):
        yield NULL_PROGRESS
    elif not terminal:
        yield LineProgress()
    else:
        from rich.console import Console
        from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
        from rich.progress import Progress as Bars

        columns = (BarColumn(bar_width=24), TextColumn("{task.description}", markup=False), TimeElapsedColumn())
        with Bars(*columns, console=Console(stderr=True), transient=True) as bars:
            progress = _BarProgress(bars)
            yield progress
            progress.finish_stage()
