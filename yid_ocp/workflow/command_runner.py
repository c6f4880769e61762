"""Common shell of all commands: progress display, printed summary, run folder location and exit codes."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from yid_ocp import interruption
from yid_ocp.config.reader import load_config
from yid_ocp.files import to_json_types
from yid_ocp.parallel import WorkerConfig
from yid_ocp.progress import NULL_PROGRESS, Progress
from yid_ocp.report import diagnosis_summaries, summaries  # noqa: F401, they register
from yid_ocp.report.terminal import SUMMARY_BY_FORMAT, summary_terminal_lines

if TYPE_CHECKING:
    import rich.progress

    from yid_ocp.solvers.base import Iterate

EXIT_DONE, EXIT_FAILED, EXIT_WRONG_INPUT = 0, 1, 2
"""Exit codes of commands that ran to their end; the last where they were told to be strict and found something."""
_CommandOutput = TypeVar("_CommandOutput")


@dataclass(frozen=True)
class CommandResult(Generic[_CommandOutput]):
    """Run folder of a command, contents of its result.json, what it computed, and whether it reached its goal."""

    folder: Path
    result: dict[str, Any]
    output: _CommandOutput
    is_successful: bool = True


def command_with_settings(work: Callable[..., CommandResult[Any]], *names: str) -> Callable[[argparse.Namespace], int]:
    """A command that runs `work(settings, out, progress, ...)`, at the end the arguments of these names."""

    def run(arguments: argparse.Namespace) -> int:
        settings = load_config(arguments.config, arguments.overrides)
        more = [getattr(arguments, name) for name in names]
        return run_command_and_print(arguments, lambda shown: work(settings, arguments.out, shown, *more))

    return run


def run_command_and_print(arguments: argparse.Namespace, work: Callable[[Progress], CommandResult[Any]]) -> int:
    """Run a command's function, print the summary of its result and its run folder, and return its exit code."""
    with stderr_progress_display(arguments) as progress:
        outcome = work(progress)
    path, near, result = str(outcome.folder), os.path.relpath(outcome.folder), outcome.result
    place = path if near.startswith("..") else f"run folder: {near}"
    summary = SUMMARY_BY_FORMAT[result["format"]]
    print_result(arguments, result, lambda: summary_terminal_lines(summary(result)), place, path)
    return EXIT_DONE if outcome.is_successful else EXIT_FAILED


def print_result(
    arguments: argparse.Namespace, result: Mapping[str, Any], texts: Callable[[], Sequence[str]], place: str, path: str
) -> None:
    """Print a command's result: its text and then `place`, the path alone (`quiet`) or JSON (`json`).

    Beside JSON nothing else goes to standard output; the place goes to standard error.
    """
    if arguments.json:
        print_json(result)
        if not arguments.quiet:
            print(place, file=sys.stderr)
    elif arguments.quiet:
        print(path)
    else:
        print("\n".join([*texts(), place]))


def workers_from_arguments(arguments: argparse.Namespace) -> WorkerConfig | None:
    """Available workers from `--workers` or `--scheduler`, None where neither is given; errors as `WorkerConfig`."""
    if arguments.workers is None and not arguments.scheduler:
        return None
    workers = WorkerConfig(arguments.workers, arguments.scheduler)
    workers.check_available()
    return workers


def print_json(result: Mapping[str, Any]) -> None:
    """Print a result on standard output as it stands in its file."""
    print(json.dumps(to_json_types(result), indent=1, allow_nan=False))


_MIN_LINE_INTERVAL = 5.0  # least time between two lines of one tenth of a stage [s]
_MIN_ESTIMATE_TIME = 2.0  # time that a stage has to last before the rest of it is guessed [s]


class _RemainingTime:
    def __init__(self) -> None:
        self._first: tuple[int, float] | None = None

    def remaining_text(self, done: int, total: int) -> str:
        now = time.monotonic()
        # what stood there before this run began took no time
        known, begun = self._first = self._first or (done, now)
        if done <= known or done >= total or now - begun < _MIN_ESTIMATE_TIME:
            return ""
        return f", about {_format_duration((now - begun) * (total - done) / (done - known))} left"


def _format_duration(seconds: float) -> str:
    if seconds >= 1.5 * 3600:
        return f"{seconds / 3600:.1f} h"
    return f"{seconds / 60:.0f} min" if seconds >= 1.5 * 60 else f"{seconds:.0f} s"


def _format_iterate(entry: Iterate) -> str:
    note = f", {entry.note}" if entry.note else ""
    return f"iteration {entry.iteration}, cost {entry.cost:.6g}, {entry.seconds:.1f} s{note}"


class StderrLogLinesProgress(Progress):
    """Progress as lines on standard error: for every stage, iterate, tenth of a stage, and some seconds of silence."""

    def __init__(self) -> None:
        self._tenths, self._last, self._left = 0, 0.0, _RemainingTime()

    def begin_stage(self, text: str) -> None:
        """Print a line with the name of the stage."""
        interruption.raise_if_requested()
        self._tenths, self._last, self._left = 0, time.monotonic(), _RemainingTime()
        print(f"{text} ...", file=sys.stderr, flush=True)

    def report_iterate(self, entry: Iterate) -> None:
        """Print a line for the accepted point."""
        print(f"  {_format_iterate(entry)}", file=sys.stderr, flush=True)

    def report_parts_done(self, done: int, total: int, text: str) -> None:
        """Print a line for every tenth of the stage, or where the last one is some seconds old."""
        tenths, left = 10 * done // max(total, 1), self._left.remaining_text(done, total)
        # a line for every frame would be too many
        if tenths > self._tenths or time.monotonic() > self._last + _MIN_LINE_INTERVAL:
            self._tenths, self._last = tenths, time.monotonic()
            print(f"  {done} of {total}, {text}{left}", file=sys.stderr, flush=True)


class _BarProgress(Progress):
    """Progress as one bar for the running stage, below a line for each finished stage."""

    def __init__(self, bars: rich.progress.Progress) -> None:
        self._bars = bars
        self._task: rich.progress.TaskID | None = None
        self._text, self._left, self._begun = "", _RemainingTime(), 0.0

    def begin_stage(self, text: str) -> None:
        interruption.raise_if_requested()
        self.finish_stage()
        self._text, self._left, self._begun = text, _RemainingTime(), time.monotonic()
        self._task = self._bars.add_task(text, total=None)

    def report_iterate(self, entry: Iterate) -> None:
        if self._task is not None:
            self._bars.update(self._task, description=f"{self._text}: {_format_iterate(entry)}")

    def report_parts_done(self, done: int, total: int, text: str) -> None:
        if self._task is not None:
            words = f"{self._text}: {done} of {total}, {text}{self._left.remaining_text(done, total)}"
            self._bars.update(self._task, description=words, completed=done, total=total)

    def finish_stage(self) -> None:
        if self._task is not None:
            self._bars.remove_task(self._task)
            self._task = None
            spent = _format_duration(time.monotonic() - self._begun)
            self._bars.console.print(f"{self._text}: {spent}", markup=False, highlight=False)


@contextlib.contextmanager
def stderr_progress_display(arguments: argparse.Namespace) -> Iterator[Progress]:
    """Context manager for progress on standard error: bars on a terminal, else lines; nothing if `--quiet`."""
    terminal = sys.stderr.isatty()
    if arguments.quiet or (arguments.json and not terminal):
        yield NULL_PROGRESS
    elif not terminal:
        yield StderrLogLinesProgress()
    else:
        from rich.console import Console
        from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
        from rich.progress import Progress as Bars

        columns = (BarColumn(bar_width=24), TextColumn("{task.description}", markup=False), TimeElapsedColumn())
        with Bars(*columns, console=Console(stderr=True), transient=True) as bars:
            progress = _BarProgress(bars)
            yield progress
            progress.finish_stage()
