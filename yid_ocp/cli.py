"""The command line: one row for each command, imports only when a command runs, messages for people."""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from yid_ocp.errors import YidError

if TYPE_CHECKING:
    from yid_ocp.workflow.settings import Run

DONE, FAILED, WRONG_INPUT, BUG, INTERRUPTED = 0, 1, 2, 3, 130


@dataclass(frozen=True)
class Command:
    """One row of the command table.

    Attributes
    ----------
    name, help : str
    run : callable
        From the parsed arguments to the exit code.
    arguments : callable
        Adds the command's own arguments to its parser.
    """

    name: str
    help: str
    run: Callable[[argparse.Namespace], int]
    arguments: Callable[[argparse.ArgumentParser], None]


def configured(optional: bool = False) -> Callable[[argparse.ArgumentParser], None]:
    """Arguments of commands that take a configuration file."""

    def add(parser: argparse.ArgumentParser) -> None:
        extra: dict[str, Any] = {"nargs": "?"} if optional else {}
        what = "the run's settings; an embedded example when absent" if optional else "the run's settings"
        parser.add_argument("config", metavar="CONFIG.yaml", help=what, **extra)
        parser.add_argument("--out", metavar="DIR", help="run folder to make (default: runs/NAME-DATE-TIME)")
        parser.add_argument(
            "--set",
            metavar="KEY=VALUE",
            action="append",
            default=[],
            dest="overrides",
            help="replace a setting, for example --set solver.time_step=0.005; may be repeated",
        )
        parser.add_argument("--quiet", action="store_true", help="print nothing but the run folder's path")

    return add


# -- commands ---------------------------------------------------------------------------------------------------------


def _solve(arguments: argparse.Namespace) -> int:
    from yid_ocp.workflow.solve import run_solve

    run = _load(arguments)
    with _progress(arguments.quiet) as monitor:
        outcome = run_solve(run, arguments.out, monitor)
    if not arguments.quiet:
        _print(solve_summary(outcome.result))
    _say_folder(outcome.folder, arguments.quiet)
    return DONE if outcome.ok else FAILED


COMMANDS: tuple[Command, ...] = (
    Command("solve", "estimate the free parameters from recordings", _solve, configured(optional=True)),
)


# -- tables for people ------------------------------------------------------------------------------------------------


def solve_summary(result: dict[str, Any]) -> list[str]:
    """Lines that tell a person what a `yid-solve/1` result says."""
    free = {name: entry for name, entry in result["parameters"].items() if entry["free"]}
    words = {"identifiable": "found", "weak": "weakly determined", "not_identifiable": "cannot be found"}
    rows = [("parameter", "value", "± std", "unit", "verdict", "start")]
    for name, entry in free.items():
        std = "unknown" if entry["std"] is None else f"{entry['std']:.2g}"
        rows.append((name, f"{entry['value']:.4g}", std, entry["unit"], words[entry["verdict"]], f"{entry['initial']:.4g}"))
    lines = [*table(rows), ""]
    rows = [("channel", "error (rms)", "unit", "samples")]
    rows += [(c, f"{e['rmse']:.3g}", e["unit"], str(e["n"])) for c, e in result["residuals"].items()]
    if len(rows) > 1:
        lines += [*table(rows), ""]
    units = {channel: entry["unit"] for channel, entry in result["residuals"].items()}
    rows = [("held-out recording", "channel", "error (rms)", "unit", "without a model")]
    for entry in result["held_out"]:
        if "message" in entry:
            lines += [f"held-out recording {entry['recording']} could not be predicted: {entry['message']}", ""]
        for channel, rmse in entry["rmse"].items():
            without = [f"{errors[channel]:.3g} ({name})" for name, errors in entry["baselines"].items() if channel in errors]
            rows.append((entry["recording"], channel, f"{rmse:.3g}", units.get(channel, ""), ", ".join(without)))
    if len(rows) > 1:
        lines += [*table(rows), ""]
    lost = [name for name, entry in free.items() if entry["verdict"] == "not_identifiable"]
    weak = [name for name, entry in free.items() if entry["verdict"] == "weak"]
    if lost:
        lines.append(f"cannot be found from these recordings: {', '.join(lost)}")
    if weak:
        lines.append(f"only weakly determined: {', '.join(weak)}")
    lines.append(f"{result['status']}: {result['message']}" f" ({result['iterations']} iterations, {result['seconds']:.1f} s)")
    return lines


def table(rows: Sequence[Sequence[str]]) -> list[str]:
    """Rows as aligned lines, the first one as head."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
    return [lines[0], "  ".join("-" * width for width in widths), *lines[1:]]


# -- around the commands ----------------------------------------------------------------------------------------------


def _load(arguments: argparse.Namespace) -> Run:
    from yid_ocp.config import load_config

    return load_config(arguments.config, arguments.overrides)


def _progress(quiet: bool) -> Any:
    from yid_ocp.progress import console_progress

    return console_progress(quiet)


def _print(lines: Sequence[str]) -> None:
    print("\n".join(lines))


def _say_folder(folder: Path, quiet: bool) -> None:
    shown = os.path.relpath(folder)
    print(folder if quiet or shown.startswith("..") else f"run folder: {shown}")


def parser() -> argparse.ArgumentParser:
    """The argument parser of all commands."""
    from yid_ocp import __version__

    top = argparse.ArgumentParser(prog="yid-ocp", description=__doc__ and "Stiffness of flexible objects from robot recordings.")
    top.add_argument("--version", action="version", version=f"yid-ocp {__version__}")
    commands = top.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for row in COMMANDS:
        added = commands.add_parser(row.name, help=row.help, description=row.help[0].upper() + row.help[1:] + ".")
        row.arguments(added)
        added.set_defaults(run=row.run)
    return top


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command.

    Returns
    -------
    int
        0 done; 1 the solve failed, the run folder says why; 2 the input is wrong; 3 a bug; 130 interrupted.
    """
    try:
        arguments = parser().parse_args(argv)
    except SystemExit as error:
        return int(error.code or 0)
    try:
        return int(arguments.run(arguments))
    except YidError as error:
        print(f"error: {error}", file=sys.stderr)
        return WRONG_INPUT
    except KeyboardInterrupt:
        print("interrupted; no run folder was left", file=sys.stderr)
        return INTERRUPTED
    except Exception as error:  # whatever else comes up here is a mistake of ours
        with tempfile.NamedTemporaryFile(
            "w", prefix="yid-ocp-", suffix=".log", delete=False, encoding="utf-8"
        ) as file:
            traceback.print_exc(file=file)
        print(f"bug: {type(error).__name__}: {error}\n  please report it with {file.name}", file=sys.stderr)
        return BUG
