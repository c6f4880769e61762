"""How long work is doing: what is told of it where it is done, whoever shows it (`workflow.progress`)."""

from __future__ import annotations

import logging
import threading
from typing import Protocol


class Point(Protocol):
    """A point that a search accepted: which one, its cost, the time so far [s], and anything out of the ordinary."""

    @property
    def iteration(self) -> int:
        """Its number."""
        ...

    @property
    def cost(self) -> float:
        """What the search lowers."""
        ...

    @property
    def seconds(self) -> float:
        """Wall time so far [s]."""
        ...

    @property
    def note(self) -> str:
        """Anything out of the ordinary, such as which of several starts it belongs to."""
        ...


class Progress(Protocol):
    """Whoever wants to know how a long run is doing; asked from one thread at a time."""

    def stage(self, text: str) -> None:
        """A new part of the work begins."""
        ...

    def iterate(self, entry: Point) -> None:
        """A search accepted a point."""
        ...

    def advance(self, done: int, total: int, text: str) -> None:
        """So many of so many parts of the stage are done, and what was done last or comes next."""
        ...


class Silent:
    """Progress that nobody sees."""

    def stage(self, text: str) -> None:
        """Nothing."""

    def iterate(self, entry: Point) -> None:
        """Nothing."""

    def advance(self, done: int, total: int, text: str) -> None:
        """Nothing."""


class Logged(Silent):
    """Progress as messages of a log."""

    def __init__(self, log: logging.Logger) -> None:
        self._log = log

    def stage(self, text: str) -> None:
        """See `Progress`."""
        self._log.info("%s", text)

    def advance(self, done: int, total: int, text: str) -> None:
        """See `Progress`."""
        self._log.info("%d of %d, %s", done, total, text)


class Parts:
    """Parts of a stage that are done side by side, counted as they end.

    Parameters
    ----------
    progress : Progress
    total : int
        How many there are.
    first : str
        One that is begun with.
    """

    def __init__(self, progress: Progress, total: int, first: str) -> None:
        self._progress, self._total, self._count, self._lock = progress, total, 0, threading.Lock()
        progress.advance(0, total, first)

    def done(self, text: str) -> None:
        """One more is done; from any thread."""
        with self._lock:
            self._count += 1
            self._progress.advance(self._count, self._total, text)


SILENT = Silent()
