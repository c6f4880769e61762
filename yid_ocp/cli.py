"""The command line: one row for each command and its arguments; what a command does stands in `workflow`.

A command's module is imported when it runs, so that help needs none of the libraries for numbers.
"""

from __future__ import annotations

import argparse
import contextlib
import logging
import os
import sys
import tempfile
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from yid_ocp import interruption
from yid_ocp.errors import OutputError, ResourceError, YidError

WRONG_INPUT, BUG, INTERRUPTED = 2, 3, 130


@dataclass(frozen=True)
class Command:
    """One row of the command table.

    Attributes
    ----------
    name, help : str
    module : str
        File of `workflow` whose `run` takes the parsed arguments and returns the exit code.
    arguments : callable
        Adds the command's arguments to its parser.
    """

    name: str
    help: str
    module: str
    arguments: Callable[[argparse.ArgumentParser], None]


# -- arguments --------------------------------------------------------------------------------------------------------


def _configured(parser: argparse.ArgumentParser, optional: bool = False) -> None:
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
        help="replace a setting, for example --set problem.time_step=0.005; may be repeated",
    )
    parser.add_argument("--quiet", action="store_true", help="print nothing but the run folder's path")


def _doubting(parser: argparse.ArgumentParser, optional: bool = False) -> None:
    _configured(parser, optional)
    text = "stop, with exit code 2, where anything about a recording is in doubt"
    strict = "recordings.strict=true"
    parser.add_argument("--strict", action="append_const", const=strict, dest="overrides", help=text)


def _working(parser: argparse.ArgumentParser, absent: str = "as many as there are processors") -> None:
    text = f"processes that share the work; {absent} when absent"
    parser.add_argument("--workers", metavar="N", type=int, help=text)
    text = "HOST:PORT of a Dask scheduler, or its scheduler file, whose workers do the work instead"
    parser.add_argument("--scheduler", metavar="ADDRESS", default="", help=text)


def _doubting_or_embedded(parser: argparse.ArgumentParser) -> None:
    _doubting(parser, optional=True)


def _diagnose(parser: argparse.ArgumentParser) -> None:
    _doubting(parser, optional=True)
    text = "run folder of an earlier solve or diagnose of the same model: ask what differs since; may be repeated"
    parser.add_argument("--baseline", metavar="RUN", action="append", default=[], help=text)


def _identifiability(parser: argparse.ArgumentParser) -> None:
    _doubting(parser)
    parser.add_argument("--what-if", action="store_true", help="rank changes of the experiment; takes a few minutes")
    text = "95 %% intervals by profile likelihood of: all, none, or NAME,NAME; by default all if they are few"
    parser.add_argument("--intervals", metavar="NAMES", default="auto", help=text)
    parser.add_argument("--initial", action="store_true", help="judge at the initial values, without solving")
    text = "judge with initial states estimated along, whatever the settings assume"
    parser.add_argument("--unknown-start", action="store_true", help=text)
    _working(parser, "this process alone")
    parser.add_argument("--unknown-grasp", action="store_true", help="judge with the places of grasps estimated along")


def _overrides(parser: argparse.ArgumentParser) -> None:
    text = "replace a setting in every run; may be repeated"
    parser.add_argument("--set", metavar="KEY=VALUE", action="append", default=[], dest="overrides", help=text)
    parser.add_argument("--quiet", action="store_true", help="print nothing but the folder's path")


def _blind(parser: argparse.ArgumentParser) -> None:
    text = "settings of experiments, which are varied as far as there are cases for it; embedded ones when absent"
    parser.add_argument("configs", metavar="CONFIG.yaml", nargs="*", help=text)
    parser.add_argument("--out", metavar="DIR", help="folder of the proof; the same one again does what is not done")
    parser.add_argument("--cases", type=int, default=20, help="size of the ensemble")
    parser.add_argument("--seed", type=int, default=1, help="from which it is drawn")
    text = "draw an ensemble to set thresholds by, other cases than those that are reported for the same seed"
    parser.add_argument("--calibration", action="store_true", help=text)
    _overrides(parser)
    _working(parser)


def _batch(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("configs", metavar="CONFIG.yaml", nargs="+", help="settings of one run each")
    text = "pattern of recordings in quotes, such as 'fleet/*.h5': a run of every configuration for each of them"
    parser.add_argument("--recordings", metavar="GLOB", help=text)
    parser.add_argument("--command", dest="each", choices=("solve", "diagnose"), default="solve", help="to run")
    text = "folder of all runs (default: runs/batch-DATE-TIME); the same one again does what is not done yet"
    parser.add_argument("--out", metavar="DIR", help=text)
    _overrides(parser)
    _working(parser)


def _simulate(parser: argparse.ArgumentParser) -> None:
    _configured(parser)
    parser.add_argument("--seed", type=int, default=0, help="of the noise and of a virtual experiment's motion")
    parser.add_argument("--noise", action="store_true", help="add noise of the recorded standard deviations")


def _inspect(parser: argparse.ArgumentParser) -> None:
    _configured(parser)
    text = (
        "print an equation, with ROW, COLUMN its derivative, such as 'del[T1_0_x], q1[T1_0_x]', or where a parameter "
    )
    text += "enters; may be repeated"
    parser.add_argument("--entry", metavar="ROW[, COLUMN]", action="append", default=[], dest="entries", help=text)
    text = "folder for the equations as CasADi functions, C and a LaTeX sheet"
    parser.add_argument("--export", metavar="DIR", help=text)


def _import(parser: argparse.ArgumentParser) -> None:
    files = "CSV, C3D, MCAP, rosbag (file or folder), LeRobot dataset (folder), or a recording"
    parser.add_argument("file", metavar="FILE", help=files)
    parser.add_argument("--out", metavar="RECORDING.h5", help="recording to write; needed without --preview")
    text = "show what there is, and the command that imports it, and write nothing"
    parser.add_argument("--preview", action="store_true", help=text)
    text = "its section `import` says how; a flag goes before what stands there"
    parser.add_argument("--config", metavar="CONFIG.yaml", help=text)
    _importing(parser)
    parser.add_argument("--quiet", action="store_true", help="print nothing but the recording's path")


def _importing(parser: argparse.ArgumentParser) -> None:
    """Flags that are keys of the section `import`; a list may be split by commas, and its flag repeated."""
    group = parser.add_argument_group("how files of other tools are read")
    listed = (
        ("--joint-topic", "joint_topics", "TOPIC", "of a bag: topic of joint states; several are put on one clock"),
        ("--joints", "joints", "NAME[=NEW]", "joints to keep, in this order, and what they are called in the URDF"),
        ("--points", "points", "SOURCE=POINT", "topic, TOPIC:FRAME of /tf, marker or stem, and its point: cable:100%%"),
        ("--columns", "columns", "COLUMN=MEANING", "of a table: t, CHANNEL:JOINT, AXIS:POINT or skip; or in order"),
        ("--units", "units", "UNIT", "deg, mm, ms, or QUANTITY=UNIT, of what is not SI"),
        ("--torque-constants", "torque_constants", "JOINT=N_M_PER_A", "where the efforts are currents; * is any text"),
        ("--gears", "gears", "JOINT=RATIO", "turns of the motor per turn of the joint"),
    )
    for flag, key, shape, text in listed:
        group.add_argument(flag, dest=key, metavar=f"{shape},...", action="append", default=[], help=text)
    text = "of a bag: topic of joint states whose positions were asked for"
    group.add_argument("--command-topic", metavar="TOPIC", help=text)
    text = "of a bag: make points so far along the axes of every pose [m]"
    group.add_argument("--pose-axes", type=float, metavar="METRES", help=text)
    text = "of a table: its first row holds numbers"
    group.add_argument("--no-header", dest="header", action="store_const", const=False, help=text)
    text = "of a table: leave lines that are no numbers out, and count them"
    group.add_argument("--skip-bad-lines", action="store_const", const=True, help=text)
    group.add_argument("--delimiter", metavar="CHARACTER", help="of a table: between its cells")
    group.add_argument("--episode", type=int, metavar="NUMBER", help="of a LeRobot dataset; 0 when absent")
    group.add_argument("--clock", choices=("recorded", "nominal"), help="of a table: whether its times were measured")
    group.add_argument("--sensor", metavar="TEXT", help="what saw the points")
    group.add_argument("--frame", metavar="TEXT", help="frame of reference of the points, of a table or C3D file")


def _init(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("robot", metavar="ROBOT", help="URDF file, or package:NAME such as package:ur5")
    text = "recordings of it, or files that `import` understands; several: the last ones are held out"
    parser.add_argument("files", metavar="FILE", nargs="+", help=text)
    parser.add_argument("--out", metavar="CONFIG.yaml", required=True, help="configuration to write")
    parser.add_argument("--replace", action="store_true", help="write over files that are there")
    kinds = ("cable", "beam", "tree", "y")
    parser.add_argument("--object", choices=kinds, required=True, help="what is held; y is the foam Y of the paper")
    for name, text in (("length", "[m]"), ("mass", "[kg]"), ("radius", "[m]")):
        parser.add_argument(
            f"--{name}", type=float, metavar="NUMBER", help=f"of the object, of each equal branch {text}"
        )
    parser.add_argument("--section", metavar="X,Y", help="extents of a rectangular cross section [m], not a radius")
    parser.add_argument("--links", type=int, metavar="NUMBER", help="rigid links of each segment")
    parser.add_argument("--branches", type=int, metavar="NUMBER", help="of a tree: equal ones, in a star")
    text = "of a tree: NAME=LENGTH,MASS,RADIUS[,ROLL,PITCH,YAW]; NAME@PARENT grows on PARENT's end; may be repeated"
    parser.add_argument("--branch", metavar="BRANCH", action="append", default=[], help=text)
    parser.add_argument("--holder", metavar="FRAME", help="of the robot, that carries the object's root")
    text = "what else holds it, such as right_gripper=w_cable; may be repeated"
    parser.add_argument("--grasp", metavar="FRAME=POINT", action="append", default=[], help=text)
    _importing(parser)
    parser.add_argument("--quiet", action="store_true", help="print nothing but the configuration's path")


def _export(parser: argparse.ArgumentParser) -> None:
    text = "recording to write as CSV or MCAP, or run folder of solve or diagnose whose model or signals to write"
    parser.add_argument("source", metavar="RECORDING.h5|RUN", help=text)
    text = "of a recording: csv (default) or mcap; of a run: mjcf (default), urdf, sdf, yaml for a configuration that "
    text += "starts at the estimates, or mcap for what was measured, predicted and left over"
    parser.add_argument("--format", metavar="FORMAT", help=text)
    text = "folder for CSV or MCAP files, or file for the model; its manifest stands beside it"
    parser.add_argument("--out", metavar="PATH", required=True, help=text)
    parser.add_argument("--quiet", action="store_true", help="print nothing but the files' paths")


def _report(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("runs", metavar="RUN", nargs="+", help="run folders of solve or diagnose, in the order of time")
    parser.add_argument("--out", metavar="DIR", help="folder to make (default: runs/history-report-DATE-TIME)")
    parser.add_argument("--quiet", action="store_true", help="print nothing but the folder's path")


def _schema(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", metavar="FILE", help="file to write; printed when absent")


COMMANDS: tuple[Command, ...] = (
    Command("init", "write a commented configuration from a robot and recordings of it", "init", _init),
    Command("solve", "estimate the free parameters from recordings", "solve", _doubting_or_embedded),
    Command("compare", "run several methods on one problem and say whether they agree", "compare", _doubting),
    Command(
        "identifiability",
        "say which parameters the recordings determine, and which experiment would tell more",
        "identifiability",
        _identifiability,
    ),
    Command(
        "diagnose",
        "find the gap between model and recordings, and what makes it",
        "diagnose",
        _diagnose,
    ),
    Command(
        "blind",
        "prove the diagnosis on virtual recordings whose effect is withheld; goes on where it was interrupted",
        "blind",
        _blind,
    ),
    Command("batch", "solve or diagnose many recordings or robots, one table and report of all", "batch", _batch),
    Command("report", "compare runs of one model: what drifted, which run to distrust", "report", _report),
    Command("plan", "plan a motion of the arms with the identified model", "plan", _configured),
    Command("simulate", "write what the model says would be recorded", "simulate", _simulate),
    Command("check", "validate a configuration, its recordings and the model before a long run", "check", _doubting),
    Command("inspect", "show the model's equations: names, patterns, single entries, numbers", "inspect", _inspect),
    Command("track", "measure the object's points in the frames of a depth camera", "track", _doubting),
    Command("import", "turn a file of another tool into a recording", "import_recording", _import),
    Command("export", "turn a recording into CSV or MCAP, a run into MJCF, URDF, SDF, YAML or MCAP", "export", _export),
    Command("schema", "print the JSON Schema of configuration files, for editors", "schema", _schema),
)


# -- running ----------------------------------------------------------------------------------------------------------


def parser() -> argparse.ArgumentParser:
    """The argument parser of all commands."""
    from yid_ocp import __version__

    top = argparse.ArgumentParser(prog="yid-ocp", description="Stiffness of flexible objects from robot recordings.")
    top.add_argument("--version", action="version", version=f"yid-ocp {__version__}")
    commands = top.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for row in COMMANDS:
        added = commands.add_parser(row.name, help=row.help, description=row.help[0].upper() + row.help[1:] + ".")
        row.arguments(added)
        added.set_defaults(module=row.module)
    return top


def _wrong(error: YidError) -> int:
    print(f"error: {error}", file=sys.stderr)
    return WRONG_INPUT


@contextlib.contextmanager
def _notices() -> Iterator[None]:
    """Show the library's warnings on standard error while a command runs."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setLevel(logging.WARNING)
    handler.setFormatter(logging.Formatter("notice: %(message)s"))
    logger = logging.getLogger("yid_ocp")
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command.

    Returns
    -------
    int
        0 done; 1 the solve failed, the run folder says why; 2 the input is wrong, or the system refused something; 3 a
        bug; 128 and the signal's number where one ended it, as 130 for an interruption.
    """
    try:
        arguments = parser().parse_args(argv)
    except SystemExit as error:
        return int(error.code or 0)
    try:
        with interruption.signals_raised(), _notices():
            return _carried_out(arguments)
    except KeyboardInterrupt as error:
        name = str(error) or "SIGINT"
        print(f"interrupted ({name}); nothing half-finished was left", file=sys.stderr)
        return error.number + 128 if isinstance(error, interruption.Interrupted) else INTERRUPTED


def _carried_out(arguments: argparse.Namespace) -> int:
    """Exit code of a command."""
    if sys.stdout is None:  # closed by who started the program
        sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115
    try:
        os.getcwd()
    except OSError as error:
        what = f"the working directory is not there: {error.strerror or error}"
        return _wrong(OutputError(what, hint="cd to one that is"))
    try:
        code = int(import_module(f"yid_ocp.workflow.{arguments.module}").run(arguments))
        sys.stdout.flush()
        return code
    except Exception as error:
        number = interruption.asked()
        if number is not None:  # what a library makes of being interrupted is no cause
            raise interruption.Interrupted(number) from error
        return _failed(error)


def _failed(error: Exception) -> int:
    """Say why a command failed; its exit code."""
    if isinstance(error, YidError):
        return _wrong(error)
    if isinstance(error, BrokenPipeError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # or Python fails again when it ends
        return _wrong(OutputError("standard output was closed before all was printed", hint="read it to its end"))
    if isinstance(error, OSError):
        what = f"the system refused: {error.strerror or error}"
        return _wrong(OutputError(what, where=str(error.filename or ""), hint="see whether disk and rights allow it"))
    if isinstance(error, MemoryError):
        what = f"there is not enough memory: {error}"
        return _wrong(ResourceError(what, hint="shorten the run, or take fewer links"))
    # whatever else comes up here is a mistake of ours
    with tempfile.NamedTemporaryFile("w", prefix="yid-ocp-", suffix=".log", delete=False, encoding="utf-8") as file:
        traceback.print_exception(error, file=file)
    print(f"bug: {type(error).__name__}: {error}\n  please report it with {file.name}", file=sys.stderr)
    return BUG
