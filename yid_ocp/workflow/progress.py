"""How a long run is doing: what a command reports, and who shows it."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from typing import TYPE_CHECKING, Protocol

from yid_ocp.solvers import Iterate

if TYPE_CHECKING:
    import rich.progress


class Progress(Protocol):
    """Whoever wants to know how a long run is doing."""

    def stage(self, text: str) -> None:
        """A new part of the work begins."""
        ...

    def iterate(self, entry: Iterate) -> None:
        """A solver accepted a point."""
        ...

    def advance(self, done: int, total: int, text: str) -> None:
        """So many of so many parts of the stage are done, and what comes next."""
        ...


class Silent:
    """Progress that nobody sees."""

    def stage(self, text: str) -> None:
        """Nothing."""

    def iterate(self, entry: Iterate) -> None:
        """Nothing."""

    def advance(self, done: int, total: int, text: str) -> None:
        """Nothing."""


SILENT = Silent()


class PlainProgress:
    """A line on standard error for every stage and iterate, and for every tenth of a stage; for logs and pipes."""

    def __init__(self) -> None:
        self._tenths = 0

    def stage(self, text: str) -> None:
        """See `Progress`."""
        self._tenths = 0
        print(f"{text} ...", file=sys.stderr, flush=True)

    def iterate(self, entry: Iterate) -> None:
        """See `Progress`."""
        print(f"  {iterate_words(entry)}", file=sys.stderr, flush=True)

    def advance(self, done: int, total: int, text: str) -> None:
        """See `Progress`."""
        tenths = 10 * done // max(total, 1)
        if tenths > self._tenths:  # a line for every frame would be too many
            self._tenths = tenths
            print(f"  {done} of {total}, {text}", file=sys.stderr, flush=True)


class BarProgress:
    """A moving bar for the stage that runs."""

    def __init__(self, bars: rich.progress.Progress) -> None:
        self._bars = bars
        self._task: rich.progress.TaskID | None = None
        self._text = ""

    def stage(self, text: str) -> None:
        """See `Progress`."""
        self.close()
        self._text = text
        self._task = self._bars.add_task(text, total=None)

    def iterate(self, entry: Iterate) -> None:
        """See `Progress`."""
        if self._task is not None:
            self._bars.update(self._task, description=f"{self._text}: {iterate_words(entry)}")

    def advance(self, done: int, total: int, text: str) -> None:
        """See `Progress`."""
        if self._task is not None:
            self._bars.update(self._task, description=f"{self._text}: {text}", completed=done, total=total)

    def close(self) -> None:
        """Mark the running stage as done."""
        if self._task is not None:
            self._bars.update(self._task, description=self._text, total=1, completed=1)


def iterate_words(entry: Iterate) -> str:
    """An accepted point in a line."""
    note = f", {entry.note}" if entry.note else ""
    return f"iteration {entry.iteration}, cost {entry.cost:.6g}, {entry.seconds:.1f} s{note}"


@contextlib.contextmanager
def shown(quiet: bool) -> Iterator[Progress]:
    """Progress on standard error while the block runs: bars on a terminal, lines elsewhere, nothing where quiet."""
    if quiet:
        yield SILENT
    elif not sys.stderr.isatty():
        yield PlainProgress()
    else:
        from rich.console import Console
        from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
        from rich.progress import Progress as Bars

        columns = (BarColumn(bar_width=24), TextColumn("{task.description}", markup=False), TimeElapsedColumn())
        with Bars(*columns, console=Console(stderr=True)) as bars:
            progress = BarProgress(bars)
            yield progress
            progress.close()
