"""Common shell of all commands: progress display, printed summary, run folder location and exit codes."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from yid_ocp.files import to_json_types
from yid_ocp.parallel import WorkerConfig
from yid_ocp.progress import NULL_PROGRESS, AcceptedIterate, Progress
from yid_ocp.report.terminal import SummaryBlock, terminal_lines

if TYPE_CHECKING:
    import rich.progress

EXIT_DONE, EXIT_FAILED, EXIT_WRONG_INPUT = 0, 1, 2
"""Exit codes of commands that ran to their end; the last where they were told to be strict and found something."""


@dataclass(frozen=True)
class CommandResult:
    """Result of a command: its run folder, the contents of result.json, and whether it reached its goal."""

    folder: Path
    result: dict[str, Any]
    is_successful: bool = field(default=True, kw_only=True)


def run_and_print(
    arguments: argparse.Namespace,
    work: Callable[[Progress], CommandResult],
    summary: Callable[[Mapping[str, Any]], Sequence[SummaryBlock]],
) -> int:
    """Do the work of a command, print its summary and run folder as `print_result` does, and return its exit code.

    Parameters
    ----------
    arguments : Namespace
        Of the command, with `quiet` and `json`.
    work : callable
        The work, given the progress to report to.
    summary : callable
        From the result to what is said of it.
    """
    with show_progress(arguments) as progress:
        outcome = work(progress)
    near = os.path.relpath(outcome.folder)
    place = str(outcome.folder) if near.startswith("..") else f"run folder: {near}"
    print_result(arguments, outcome.result, lambda: terminal_lines(summary(outcome.result)), place, str(outcome.folder))
    return EXIT_DONE if outcome.is_successful else EXIT_FAILED


def print_result(
    arguments: argparse.Namespace, result: Mapping[str, Any], texts: Callable[[], Sequence[str]], place: str, path: str
) -> None:
    """Print a command's result: summary text, the path alone (`quiet`) or JSON (`json`).

    Parameters
    ----------
    arguments : Namespace
        `json`: the result on standard output and nothing else there, the place on standard error; `quiet`: the path
        alone.
    result : mapping
        The same as in its file.
    texts : callable
        What a person reads of it.
    place : str
        The last of these lines: where it is.
    path : str
        The place as a path, which may have several lines for several files.
    """
    if arguments.json:
        print_json(result)
        if not arguments.quiet:
            print(place, file=sys.stderr)
    elif arguments.quiet:
        print(path)
    else:
        print_lines([*texts(), place])


def workers_from_arguments(arguments: argparse.Namespace) -> WorkerConfig | None:
    """Available workers from `--workers` or `--scheduler`; None where neither is given.

    Raises
    ------
    ConfigError, WorkerError
        As `WorkerConfig`.
    """
    if arguments.workers is None and not arguments.scheduler:
        return None
    workers = WorkerConfig(arguments.workers, arguments.scheduler)
    workers.check_available()
    return workers


def print_json(result: Mapping[str, Any]) -> None:
    """Print a result on standard output as it stands in its file."""
    print(json.dumps(to_json_types(result), indent=1, allow_nan=False))


def print_lines(texts: Sequence[str]) -> None:
    """Print lines on standard output."""
    print("\n".join(texts))


# -- progress ---------------------------------------------------------------------------------------------------------

_MIN_LINE_INTERVAL = 5.0  # least time between two lines of one tenth of a stage [s]
_MIN_ESTIMATE_TIME = 2.0  # time that a stage has to last before the rest of it is guessed [s]


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
    for unit, size in (("h", 3600.0), ("min", 60.0)):
        if seconds >= 1.5 * size:
            return f"{seconds / size:.1f} h" if unit == "h" else f"{seconds / size:.0f} min"
    return f"{seconds:.0f} s"


class LineProgress:
    """Progress as lines on standard error, for logs and pipes.

    One for every stage and iterate, for every tenth of a stage, and for what is done some seconds after the last line.
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
        # a line for every frame would be too many
        if tenths > self._tenths or time.monotonic() > self._last + _MIN_LINE_INTERVAL:
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
