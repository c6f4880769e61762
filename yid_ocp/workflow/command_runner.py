"""Common shell of all commands: progress display, printed summary, run folder location and exit codes."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, TypeVar

from yid_ocp.files import to_json_types
from yid_ocp.parallel import WorkerConfig
from yid_ocp.progress import Progress
from yid_ocp.report.summary_blocks import SummaryBlock
from yid_ocp.report.terminal import terminal_lines
from yid_ocp.workflow.progress_display import show_progress

EXIT_DONE, EXIT_FAILED, EXIT_WRONG_INPUT = 0, 1, 2
"""Exit codes of commands that ran to their end; the last where they were told to be strict and found something."""


class CommandResult(Protocol):
    """Result of a command: its run folder and result data."""

    @property
    def folder(self) -> Path:
        """The finished run folder."""
        ...

    @property
    def result(self) -> dict[str, Any]:
        """Contents of result.json."""
        ...


_CommandResultT = TypeVar("_CommandResultT", bound=CommandResult)


def run_and_print(
    work: Callable[[Progress], _CommandResultT],
    summary: Callable[[Mapping[str, Any]], Sequence[SummaryBlock]],
    arguments: argparse.Namespace,
) -> _CommandResultT:
    """Do the work of a command, print its summary and run folder as `print_result` does, and return its result.

    Parameters
    ----------
    work : callable
        The work, given the progress to report to.
    summary : callable
        From the result to what is said of it.
    arguments : Namespace
        Of the command, with `quiet` and `json`.

    Returns
    -------
    Outcome
        Of the work.
    """
    with show_progress(arguments) as progress:
        outcome = work(progress)
    near = os.path.relpath(outcome.folder)
    place = str(outcome.folder) if near.startswith("..") else f"run folder: {near}"
    print_result(arguments, outcome.result, lambda: terminal_lines(summary(outcome.result)), place, str(outcome.folder))
    return outcome


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
