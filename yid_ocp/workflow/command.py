"""What commands do around their work: progress while it runs, the table for people, and where the run folder is."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, TypeVar

from yid_ocp.parallel import Workers
from yid_ocp.report.blocks import Block
from yid_ocp.report.terminal import lines
from yid_ocp.workflow.progress import Progress, shown

DONE, FAILED, WRONG_INPUT = 0, 1, 2
"""Exit codes of commands that ran to their end; the last where they were told to be strict and found something."""


class Outcome(Protocol):
    """What the work of a command leaves."""

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
    work: Callable[[Progress], Left], summary: Callable[[Mapping[str, Any]], Sequence[Block]], quiet: bool
) -> Left:
    """Do the work of a command and print for a person what it found and where it is; quietly, only where it is.

    Parameters
    ----------
    work : callable
        The work, given the progress to report to.
    summary : callable
        From the result to what is said of it.
    quiet : bool

    Returns
    -------
    Outcome
        Of the work.
    """
    with shown(quiet) as progress:
        outcome = work(progress)
    if not quiet:
        print_lines(lines(summary(outcome.result)))
    near = os.path.relpath(outcome.folder)
    print(outcome.folder if quiet or near.startswith("..") else f"run folder: {near}")
    return outcome


def given_workers(arguments: argparse.Namespace) -> Workers | None:
    """The workers that a command is given by `--workers` or `--scheduler`, known to be there; None for neither.

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


def print_lines(texts: Sequence[str]) -> None:
    """Print lines on standard output."""
    print("\n".join(texts))
