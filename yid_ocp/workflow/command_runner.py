"""The steps that all commands share: progress display, printed summary, run folder and exit codes."""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from yid_ocp import interruption
from yid_ocp.config.reader import load_config
from yid_ocp.display import NULL_PROGRESS, Progress
from yid_ocp.files import to_json_types
from yid_ocp.parallel import WorkerConfig
from yid_ocp.report import diagnosis_summaries, model_summaries, summaries  # noqa: F401, they register
from yid_ocp.report.terminal import SummaryStatement, aligned_table_lines, summary_blocks, summary_terminal_lines

if TYPE_CHECKING:
    import rich.progress

    from yid_ocp.solvers.base import Iterate

EXIT_DONE, EXIT_FAILED, EXIT_WRONG_INPUT = 0, 1, 2
"""Exit codes: success, no usable result, wrong input. A strict `check` that finds an issue has the last one."""
_CommandOutput = TypeVar("_CommandOutput")


@dataclass(frozen=True)
class CommandOutcome(Generic[_CommandOutput]):
    """The outcome of a command: run folder, contents of result.json, computed result and success."""

    folder: Path
    result: dict[str, Any]
    output: _CommandOutput
    is_successful: bool = True


def make_command_function(work: Callable[..., CommandOutcome[Any]], *names: str) -> Callable[[argparse.Namespace], int]:
    """Make a command: it calls `work(settings, out, progress, *values)`, with values of the arguments `names`."""

    def run(arguments: argparse.Namespace) -> int:
        settings = load_config(arguments.config, arguments.overrides)
        more = [getattr(arguments, name) for name in names]
        return run_command_and_print(arguments, lambda shown: work(settings, arguments.out, shown, *more))

    return run


def run_command_and_print(arguments: argparse.Namespace, work: Callable[[Progress], CommandOutcome[Any]]) -> int:
    """Run a command's function, print its summary and run folder, and return its exit code."""
    with stderr_progress_display(arguments) as progress:
        outcome = work(progress)
    path, near, result = str(outcome.folder), os.path.relpath(outcome.folder), outcome.result
    place = path if near.startswith("..") else f"run folder: {near}"
    print_result(arguments, result, lambda: summary_terminal_lines(summary_blocks(result)), place, path)
    if arguments.quiet and not outcome.is_successful:  # the reason of the exit code
        said = [part for part in summary_blocks(result) if isinstance(part, SummaryStatement)][:1]
        print("\n".join(summary_terminal_lines(said)), file=sys.stderr)
    return EXIT_DONE if outcome.is_successful else EXIT_FAILED


def print_result(
    arguments: argparse.Namespace, result: Mapping[str, Any], texts: Callable[[], Sequence[str]], footer: str, path: str
) -> None:
    """Print a command's result in one of three modes: as text, as path or as JSON.

    By default, the lines of `texts` and the line `footer` are printed. With `quiet`, only `path` is printed. With
    `json`, only JSON is printed on standard output, and `footer` on standard error.
    """
    if arguments.json:
        print_json(result)
        if not arguments.quiet:
            print(footer, file=sys.stderr)
    elif arguments.quiet:
        print(path)
    else:
        print(("\n".join(texts()).rstrip() + f"\n\n{footer}").lstrip())


def worker_config_from_arguments(arguments: argparse.Namespace) -> WorkerConfig | None:
    """Return the workers from `--workers` or `--scheduler`, or None without either. Errors are as in `WorkerConfig`."""
    if arguments.workers is None and not arguments.scheduler:
        return None
    workers = WorkerConfig(arguments.workers, arguments.scheduler)
    workers.check_scheduler_available()
    return workers


def print_json(result: Mapping[str, Any]) -> None:
    """Print a result on standard output, with the same JSON text that a result file has."""
    print(json.dumps(to_json_types(result), indent=1, allow_nan=False))


_MIN_LINE_INTERVAL = 5.0  # least time between two lines of one tenth of a stage [s]
_BAR_WIDTH = 12  # on a terminal [characters]
_MAX_LIVE_ROWS = 10  # results shown below the bar on a terminal
_MIN_ESTIMATE_TIME = 2.0  # shortest time of a stage before its remaining time is estimated [s]
_USUAL_IMPORT_TIME = 1.6  # usual import time of a command, at the pace of the stages' usual times [s]
_USUAL_ITERATIONS = 20  # usual number of iterations of a search
_MAX_PLAN_EXCESS = 6.0  # a plan that grows by more may grow again [usual s]


class _RemainingTime:
    """Estimator of the remaining time of a command whose stages state their usual time, or else of a single stage.

    The pace is the spent time over the usual time, of imports and past stages; each counts half as much as the next.
    """

    def __init__(self, import_time: float = _USUAL_IMPORT_TIME) -> None:
        self._spent = min(max(import_time, _USUAL_IMPORT_TIME / 4), _USUAL_IMPORT_TIME * 32)
        self._usual, self._work, self._ahead = _USUAL_IMPORT_TIME, 0.0, math.nan
        self._begun, self.n_iterates, self._has_grown = time.monotonic(), 0, False
        self._start_of_command = self._begun - import_time
        self._first: tuple[int, float] | None = None
        self._first_cost = math.nan

    def begin_stage(self, work: float, ahead: float | None) -> None:
        now = time.monotonic()
        if self._work > 0:
            as_before = self._work * self._spent / self._usual
            self._spent = self._spent / 2 + min(max(now - self._begun, as_before / 4), 16 * as_before)
            self._usual = self._usual / 2 + self._work
        # only a stage that is part of the planned work announces later stages
        if ahead is not None and (work == 0 or not math.isnan(self._ahead)):
            self._has_grown |= work + ahead > self._ahead + _MAX_PLAN_EXCESS
            self._ahead = ahead
        else:
            self._ahead = max(self._ahead - work, 0.0)
        if work > 0 or self._work > 0:
            self._begun = now
        self._work, self.n_iterates, self._first = work, 0, None

    def of_command(self) -> str:
        """Return the text of the command's remaining time. Empty before a stage or an iteration is measured.

        After a plan has grown, it is the elapsed time: a search that repeats its stages can grow many times.
        """
        if self._has_grown:
            return f", {time.monotonic() - self._start_of_command:.0f} s so far"
        left = self.seconds_left() if self.n_iterates or self._usual != _USUAL_IMPORT_TIME else 0.0
        return f", about {_format_duration(left)} left" if left >= _MIN_ESTIMATE_TIME else ""

    def seconds_left(self) -> float:
        spent, pace = time.monotonic() - self._begun, self._spent / self._usual
        if self._work == 0:
            return max(self._ahead * pace, 1.25 * spent)  # beyond the usual time: as long again, and more
        expected = self._work * pace
        if self.n_iterates:
            expected = spent * (_USUAL_ITERATIONS + 1) / (self.n_iterates + 1)
        if self.n_iterates or spent > expected:
            pace = (self._spent / 2 + max(spent, expected)) / (self._usual / 2 + self._work)
        # a stage that exceeds its usual time is expected to take as long again as the excess
        return abs(expected - spent) + self._ahead * pace

    def iterate_text(self, entry: Iterate) -> str:
        """Count an iterate of the stage and return its text, with the first cost of the stage."""
        self.n_iterates += 1
        self._first_cost = entry.cost if self.n_iterates == 1 else self._first_cost
        cost = f"cost {entry.cost:.6g}" + f" (first {self._first_cost:.6g})" * (self.n_iterates > 1)
        seconds = f"{time.monotonic() - self._start_of_command:.1f} s"  # several searches follow each other
        return ", ".join(filter(None, (f"iteration {self.n_iterates - 1}", cost, seconds, entry.note)))

    def of_parts(self, done: int, total: int) -> str:
        """Return the text of a stage's remaining time, from its done parts. Empty if the command's time is known."""
        now = time.monotonic()
        known, begun = self._first = self._first or (done, now)  # stored results of an earlier run took no time
        if not math.isnan(self._ahead) or done <= known or done >= total or now - begun < _MIN_ESTIMATE_TIME:
            return ""
        return f", about {_format_duration((now - begun) * (total - done) / (done - known))} left"


def _format_duration(seconds: float) -> str:
    if seconds >= 1.5 * 3600:
        return f"{seconds / 3600:.1f} h"
    return f"{seconds / 60:.0f} min" if seconds >= 1.5 * 60 else f"{seconds:.0f} s"


class StderrLogLinesProgress(Progress):
    """A progress display that prints lines on standard error for stages, iterates, parts of a stage and long waits."""

    def __init__(self, import_time: float = _USUAL_IMPORT_TIME) -> None:
        self._lines, self._last, self._left = 0, 0.0, _RemainingTime(import_time)

    def begin_stage(self, text: str, work: float = 0.0, ahead: float | None = None) -> None:
        """Print a line with the name of the stage and the remaining time."""
        interruption.raise_if_interrupted()
        self._lines, self._last = 0, time.monotonic()
        self._left.begin_stage(work, ahead)
        print(f"{text} ...{self._left.of_command().removeprefix(',')}", file=sys.stderr, flush=True)

    def report_iterate(self, entry: Iterate) -> None:
        """Print a line for the accepted iterate; after the usual number of iterates, only every five seconds."""
        told = self._left.iterate_text(entry)
        if self._left.n_iterates <= _USUAL_ITERATIONS or time.monotonic() > self._last + _MIN_LINE_INTERVAL:
            self._last = time.monotonic()
            told += f" (then a line every {_MIN_LINE_INTERVAL:g} s)" * (self._left.n_iterates == _USUAL_ITERATIONS)
            print(f"  {told}", file=sys.stderr, flush=True)

    def report_parts_done(self, done: int, total: int, text: str) -> None:
        """Print up to twenty lines for the stage's parts, and others if the last line is some seconds old."""
        lines, left = 20 * done // max(total, 1), self._left.of_parts(done, total)
        if lines > self._lines or time.monotonic() > self._last + _MIN_LINE_INTERVAL:
            self._lines, self._last = lines, time.monotonic()
            print(f"  {done} of {total}, {text}{left or self._left.of_command()}", file=sys.stderr, flush=True)


class _BarProgress(Progress):
    def __init__(self, bars: rich.progress.Progress, left: _RemainingTime, table: list[str], verbose: bool) -> None:
        self._bars, self._left, self._table, self._is_verbose = bars, left, table, verbose
        self._task: rich.progress.TaskID | None = None
        self._text, self._begun = "", 0.0

    def begin_stage(self, text: str, work: float = 0.0, ahead: float | None = None) -> None:
        interruption.raise_if_interrupted()
        self.finish_stage()
        self._text, self._begun = text, time.monotonic()
        self._left.begin_stage(work, ahead)
        self._task = self._bars.add_task(text, total=None)

    def report_iterate(self, entry: Iterate) -> None:
        told = self._left.iterate_text(entry)
        if self._task is not None:
            self._bars.update(self._task, description=f"{told} ({self._text})")
            if self._is_verbose:
                self._bars.console.print(f"  {told}", markup=False, highlight=False)

    def report_parts_done(self, done: int, total: int, text: str) -> None:
        if self._task is not None:
            words = f"{self._text}: {done} of {total}, {text}{self._left.of_parts(done, total)}"
            self._bars.update(self._task, description=words, completed=done, total=total)

    def renew_results_table(self, rows: Sequence[Sequence[str]]) -> None:
        self._table[:] = aligned_table_lines([*rows[: _MAX_LIVE_ROWS + 1]])

    def finish_stage(self) -> None:
        if self._task is not None:
            self._bars.remove_task(self._task)
            self._task = None
            spent = _format_duration(time.monotonic() - self._begun)
            self._bars.console.print(f"{self._text}: {spent}", markup=False, highlight=False)


@contextlib.contextmanager
def stderr_progress_display(arguments: argparse.Namespace) -> Iterator[Progress]:
    """Context manager that shows progress on standard error: bars on a terminal, else lines; nothing if `--quiet`."""
    terminal, import_time = sys.stderr.isatty(), time.monotonic() - arguments.begin_time
    if arguments.quiet or (arguments.json and not terminal):
        yield NULL_PROGRESS
    elif not terminal:
        yield StderrLogLinesProgress(import_time)
    else:
        from rich.console import Console, RenderableType
        from rich.progress import BarColumn, ProgressColumn
        from rich.progress import Progress as Bars
        from rich.text import Text

        console, left, table = Console(stderr=True), _RemainingTime(import_time), list[str]()

        class TimesAndStage(ProgressColumn):
            def render(self, task: rich.progress.Task) -> Text:
                spent = _format_duration(task.elapsed or 0.0)
                text = Text(f"{spent}{left.of_command()}: {task.description}", no_wrap=True)
                text.truncate(max(console.width - _BAR_WIDTH - 2, 1), overflow="ellipsis")
                return text

        class BarsBelowTable(Bars):
            def get_renderables(self) -> Iterator[RenderableType]:
                yield from (*map(Text, table), *super().get_renderables())

        with BarsBelowTable(BarColumn(_BAR_WIDTH), TimesAndStage(), console=console, transient=True) as bars:
            progress = _BarProgress(bars, left, table, arguments.verbose)
            yield progress
            progress.finish_stage()
