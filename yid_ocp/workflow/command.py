"""Common shell of all commands: progress display, printed summary, run folder location and exit codes."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, TypeVar

from yid_ocp.files import jsonable
from yid_ocp.parallel import Workers
from yid_ocp.progress import Progress
from yid_ocp.report.blocks import Block
from yid_ocp.report.terminal import lines
from yid_ocp.workflow.progress import shown

DONE, FAILED, WRONG_INPUT = 0, 1, 2
"""Exit codes of commands that ran to their end; the last where they were told to be strict and found something."""


class Outcome(Protocol):
    """Result of a command: its run folder and result data."""

    @property
    def folder(self) -> Path:
        """The finished run folder."""
        ...

    @property
    def result(self) -> dict[str, Any]:
        """Contents of result.json."""
        ...


Left = TypeVar("Left", bound=Outcome)


def carry_out(
    work: Callable[[Progress], Left],
    summary: Callable[[Mapping[str, Any]], Sequence[Block]],
    arguments: argparse.Namespace,
) -> Left:
    """Do the work of a command, print its summary and run folder as `tell` does, and return its result.

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
    with shown(arguments) as progress:
        outcome = work(progress)
    near = os.path.relpath(outcome.folder)
    place = str(outcome.folder) if near.startswith("..") else f"run folder: {near}"
    tell(arguments, outcome.result, lambda: lines(summary(outcome.result)), place, str(outcome.folder))
    return outcome


def tell(
    arguments: argparse.Namespace,
    result: Mapping[str, Any],
    texts: Callable[[], Sequence[str]],
    place: str,
    path: str,
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


def given_workers(arguments: argparse.Namespace) -> Workers | None:
    """Available workers from `--workers` or `--scheduler`; None where neither is given.

    Raises
    ------
    ConfigError, WorkerError
        As `Workers`.
    """
    if arguments.workers is None and not arguments.scheduler:
        return None
    workers = Workers(arguments.workers, arguments.scheduler)
    workers.check()
    return workers


def print_json(result: Mapping[str, Any]) -> None:
    """Print a result on standard output as it stands in its file."""
    print(json.dumps(jsonable(result), indent=1, allow_nan=False))


def print_lines(texts: Sequence[str]) -> None:
    """Print lines on standard output."""
    print("\n".join(texts))
