"""Progress of long work: what is told of it, silent unless a subclass shows it (`workflow.command_runner`)."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any


class Progress:
    """Base class of receivers of progress reports, called by one thread at a time; it ignores all reports."""

    def begin_stage(self, text: str, work: float = 0.0, ahead: float | None = None) -> None:
        """Report that a new stage of the work begins.

        `work` is the time that it usually takes, `ahead` that of all stages after it, on one scale [s]. A stage whose
        time says nothing of those after it (it may compile) is a part of `ahead`; absent, that falls by `work`.
        """

    def report_iterate(self, entry: Any) -> None:
        """Report the point that a search accepted, a `solvers.base.Iterate`."""

    def report_parts_done(self, done: int, total: int, text: str) -> None:
        """Report that `done` of `total` parts of the stage are finished; `text` names the last or next one."""

    def report_table(self, rows: Sequence[Sequence[str]]) -> None:
        """Report a table of all results so far, header first, then best first; it replaces the previous table."""


NULL_PROGRESS = Progress()


@dataclass(frozen=True)
class LoggingProgress(Progress):
    """A progress receiver that writes reports to a logger."""

    log: logging.Logger

    def begin_stage(self, text: str, work: float = 0.0, ahead: float | None = None) -> None:
        """Log the name of the stage."""
        self.log.info("%s", text)

    def report_parts_done(self, done: int, total: int, text: str) -> None:
        """Log the number of finished parts."""
        self.log.info("%d of %d, %s", done, total, text)


class PartsDoneCounter:
    """Thread-safe counter of a stage's `total` parallel parts; reports every count, the first with the text `first`."""

    def __init__(self, progress: Progress, total: int, first: str) -> None:
        self._progress, self._total, self._count, self._lock = progress, total, 0, threading.Lock()
        progress.report_parts_done(0, total, first)

    def count_done(self, text: str, table: Callable[[], Sequence[Sequence[str]]] | None = None) -> None:
        """Report one more finished part, with the table of results if there is one; may be called from any thread."""
        with self._lock:
            self._count += 1
            self._progress.report_parts_done(self._count, self._total, text)
            if table is not None:
                self._progress.report_table(table())
