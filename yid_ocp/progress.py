"""Progress reporting of long work: the interface and its silent default (`workflow.progress` displays it)."""

from __future__ import annotations

import logging
import threading
from dataclasses import dataclass
from typing import Protocol


class AcceptedIterate(Protocol):
    """A point that a search accepted: iteration, cost, elapsed time [s] and a note."""

    @property
    def iteration(self) -> int:
        """Number of the iteration."""

    @property
    def cost(self) -> float:
        """Cost at the point."""

    @property
    def seconds(self) -> float:
        """Wall time since the search started [s]."""

    @property
    def note(self) -> str:
        """Remark on the point, such as the number of its starting point."""


class Progress(Protocol):
    """Receiver of progress reports; called by one thread at a time."""

    def begin_stage(self, text: str) -> None:
        """Report that a new stage of the work begins."""

    def report_iterate(self, entry: AcceptedIterate) -> None:
        """Report that a search accepted a point."""

    def report_parts_done(self, done: int, total: int, text: str) -> None:
        """Report that `done` of `total` parts of the stage are finished; `text` names the last or next one."""


class NullProgress:
    """Progress that is not reported."""

    def begin_stage(self, text: str) -> None:
        """Ignore the report."""

    def report_iterate(self, entry: AcceptedIterate) -> None:
        """Ignore the report."""

    def report_parts_done(self, done: int, total: int, text: str) -> None:
        """Ignore the report."""


@dataclass(frozen=True)
class LoggingProgress(NullProgress):
    """Progress as log messages."""

    log: logging.Logger

    def begin_stage(self, text: str) -> None:
        """Log the name of the stage."""
        self.log.info("%s", text)

    def report_parts_done(self, done: int, total: int, text: str) -> None:
        """Log the number of finished parts."""
        self.log.info("%d of %d, %s", done, total, text)


class ParallelProgress:
    """Progress of a stage whose `total` parts run in parallel, `first` to begin with; counts them as they finish."""

    def __init__(self, progress: Progress, total: int, first: str) -> None:
        self._progress, self._total, self._count, self._lock = progress, total, 0, threading.Lock()
        progress.report_parts_done(0, total, first)

    def count_done(self, text: str) -> None:
        """Report one more finished part; may be called from any thread."""
        with self._lock:
            self._count += 1
            self._progress.report_parts_done(self._count, self._total, text)


NULL_PROGRESS = NullProgress()
