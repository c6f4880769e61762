"""The command line: the table of commands and their arguments; `workflow` implements the commands.

A command's module is imported when it runs, so that help needs none of the libraries for numbers.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import io
import json
import logging
import os
import re
import sys
import tempfile
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from typing import Any, NoReturn, TextIO, cast

from yid_ocp import interruption
from yid_ocp.errors import ConfigError, InsufficientMemoryError, OutputError, YidError, unknown_name_details

_EXIT_WRONG_INPUT, _EXIT_BUG, _EXIT_INTERRUPTED = 2, 3, 130
_ERROR_FORMAT = "yid-error/1"


@dataclass(frozen=True)
class _CliCommand:
    """A command: name, help, and the file of `workflow` whose `run` takes the parsed arguments and returns the code."""

    name: str
    help: str
    workflow_module: str
    add_arguments: Callable[[argparse.ArgumentParser], None]


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
        help="set a setting, for example problem.time_step=0.005; a section, 'solver={max_iterations: 9}', merges with "
        "what stands there, an empty one empties it; may be repeated",
    )
    _printing(parser, "run folder's path")


def _printing(parser: argparse.ArgumentParser, path: str) -> None:
    parser.add_argument("--quiet", action="store_true", help=f"print nothing but the {path}")
    text = "print the result as JSON, errors as well, and nothing else on standard output"
    parser.add_argument("--json", action="store_true", help=text)


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
    text = "set a setting in every run, as other commands do; may be repeated"
    parser.add_argument("--set", metavar="KEY=VALUE", action="append", default=[], dest="overrides", help=text)
    _printing(parser, "folder's path")


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


def _track(parser: argparse.ArgumentParser) -> None:
    _doubting(parser)
    text = "keep the told pose and depth of the camera, as of a hand-eye calibration; the arm then checks them"
    fixed = "track.options.calibration.fix_pose=true"
    parser.add_argument("--fix-pose", action="append_const", const=fixed, dest="overrides", help=text)
    _working(parser, "this process alone")


def _simulate(parser: argparse.ArgumentParser) -> None:
    _configured(parser)
    parser.add_argument("--seed", type=int, default=0, help="of the noise and of a virtual experiment's motion")
    parser.add_argument("--noise", action="store_true", help="add noise of the recorded standard deviations")


def _inspect(parser: argparse.ArgumentParser) -> None:
    _configured(parser)
    text = "print an equation, with ROW, COLUMN its derivative, such as 'del[T1_0_x], q1[T1_0_x]', or where a "
    text += "parameter enters; may be repeated"
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
    _printing(parser, "recording's path")


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
    text = "what is held, such as cable, beam, tree or foam_y, the paper's; an unknown word lists all"
    parser.add_argument("--object", metavar="KIND", required=True, help=text)
    for name, unit in (("length", "m"), ("mass", "kg"), ("radius", "m")):
        text = f"of the object, of each equal branch [{unit}]"
        parser.add_argument(f"--{name}", type=float, metavar="NUMBER", help=text)
    parser.add_argument("--section", metavar="X,Y", help="extents of a rectangular cross section [m], not a radius")
    text = "further number of some kinds of objects; an unknown name lists them; may be repeated"
    parser.add_argument("--number", metavar="NAME=VALUE", action="append", default=[], help=text)
    parser.add_argument("--links", type=int, metavar="NUMBER", help="rigid links of each segment")
    parser.add_argument("--branches", type=int, metavar="NUMBER", help="of a tree: equal ones, in a star")
    text = "of a tree: NAME=LENGTH,MASS,RADIUS[,ROLL,PITCH,YAW]; NAME@PARENT grows on PARENT's end; may be repeated"
    parser.add_argument("--branch", metavar="BRANCH", action="append", default=[], help=text)
    parser.add_argument("--holder", metavar="FRAME", help="of the robot, that carries the object's root")
    text = "what else holds it, such as right_gripper=w_cable; may be repeated"
    parser.add_argument("--grasp", metavar="FRAME=POINT", action="append", default=[], help=text)
    _importing(parser)
    _printing(parser, "configuration's path")


def _export(parser: argparse.ArgumentParser) -> None:
    text = "recording to write as CSV or MCAP, or run folder of solve or diagnose whose model or signals to write"
    parser.add_argument("source", metavar="RECORDING.h5|RUN", help=text)
    text = "of a recording: csv (default) or mcap; of a run: mjcf (default), urdf, sdf, yaml for a configuration that "
    text += "starts at the estimates, or mcap for what was measured, predicted and left over"
    parser.add_argument("--format", metavar="FORMAT", help=text)
    text = "folder for CSV or MCAP files, or file for the model; its manifest stands beside it"
    parser.add_argument("--out", metavar="PATH", required=True, help=text)
    _printing(parser, "files' paths")


def _report(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("runs", metavar="RUN", nargs="+", help="run folders of solve or diagnose, in the order of time")
    parser.add_argument("--out", metavar="DIR", help="folder to make (default: runs/history-report-DATE-TIME)")
    _printing(parser, "folder's path")


def _completion(parser: argparse.ArgumentParser) -> None:
    text = 'run `eval "$(yid-ocp completion bash)"` in ~/.bashrc, or ~/.zshrc with zsh; in fish pipe it to `source`'
    parser.add_argument("shell", choices=("bash", "zsh", "fish"), help=text)


def _schema(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", metavar="FILE", help="file to write; printed when absent")


COMMANDS: tuple[_CliCommand, ...] = (
    _CliCommand("init", "write a commented configuration from a robot and recordings of it", "init", _init),
    _CliCommand("solve", "estimate the free parameters from recordings", "solve", partial(_doubting, optional=True)),
    _CliCommand("compare", "run several methods on one problem and say whether they agree", "compare", _doubting),
    _CliCommand(
        "identifiability",
        "say which parameters the recordings determine, and which experiment would tell more",
        "identifiability",
        _identifiability,
    ),
    _CliCommand("friction", "say which law of friction the recordings warrant", "friction", _doubting),
    _CliCommand("diagnose", "find the gap between model and recordings, and what makes it", "diagnose", _diagnose),
    _CliCommand(
        "blind",
        "prove the diagnosis on virtual recordings whose effect is withheld; goes on where it was interrupted",
        "blind",
        _blind,
    ),
    _CliCommand("batch", "solve or diagnose many recordings or robots, one table and report of all", "batch", _batch),
    _CliCommand("report", "compare runs of one model: what drifted, which run to distrust", "run_history", _report),
    _CliCommand("plan", "plan a motion of the arms with the identified model", "plan", _configured),
    _CliCommand("simulate", "write what the model says would be recorded", "simulate", _simulate),
    _CliCommand(
        "check", "validate a configuration, its recordings and the model before a long run", "check", _doubting
    ),
    _CliCommand("inspect", "show the model's equations: names, patterns, single entries, numbers", "inspect", _inspect),
    _CliCommand("track", "measure the object's points in the frames of a depth camera", "track", _track),
    _CliCommand("import", "turn a file of another tool into a recording", "import_recording", _import),
    _CliCommand(
        "export", "turn a recording into CSV or MCAP, a run into MJCF, URDF, SDF, YAML or MCAP", "export", _export
    ),
    _CliCommand(
        "completion",
        "print what makes a shell complete commands, options, files and settings",
        "editor_support",
        _completion,
    ),
    _CliCommand("schema", "print the JSON Schema of configuration files, for editors", "editor_support", _schema),
)


# -- running ----------------------------------------------------------------------------------------------------------


class _Parser(argparse.ArgumentParser):
    """An argument parser that raises `ConfigError` with the nearest known name."""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> tuple[Any, list[str]]:
        """Parse as in `argparse`; unknown arguments are an error of the command."""
        found, rest = super().parse_known_args(args, namespace)
        if rest:
            flag, flags = rest[0].partition("=")[0], [name for name in self._option_string_actions if name[:2] == "--"]
            if not flag.startswith("-"):
                raise ConfigError(f"'{rest[0]}' is one argument too many", where=self.prog, hint=self._help())
            raise ConfigError(f"there is no option '{flag}'", where=self.prog, **unknown_name_details(flag, flags))
        return found, rest

    def error(self, message: str) -> NoReturn:
        """Raise a `ConfigError` for argparse's message."""
        chosen = re.fullmatch(r"argument (\S+): invalid choice: '?(.*?)'? \(choose from (.*)\)", message, re.DOTALL)
        if chosen:
            known = [name.strip(" '") for name in chosen[3].split(",")]
            noun = "command" if chosen[1] == "COMMAND" else f"choice of {chosen[1]}"
            details = unknown_name_details(chosen[2], known)
            raise ConfigError(f"there is no {noun} '{chosen[2]}'", where=self.prog, **details)
        raise ConfigError(message, where=self.prog, hint=self._help())

    def _help(self) -> str:
        return f"{self.prog} --help says what it takes"


def build_argument_parser() -> argparse.ArgumentParser:
    """The argument parser of all commands; its errors are `ConfigError`."""
    from yid_ocp import __version__

    top = _Parser(prog="yid-ocp", description="Stiffness of flexible objects from robot recordings.")
    top.add_argument("--version", action="version", version=f"yid-ocp {__version__}")
    commands = top.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for row in COMMANDS:
        added = commands.add_parser(row.name, help=row.help, description=row.help[0].upper() + row.help[1:] + ".")
        row.add_arguments(added)
        added.set_defaults(module=row.workflow_module)
    return top


class _LossyStream:
    """Standard error that discards what it cannot write: a full disk is no reason to stop."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        """Write text as far as that is possible; returns its length."""
        try:
            self._stream.write(text)
            self._stream.flush()
        except OSError:
            _discard_what_follows(self._stream)
        return len(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def _discard_what_follows(stream: TextIO) -> None:
    """Lead a stream that cannot be written to nowhere, or Python fails again when it ends."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


@contextlib.contextmanager
def _reliable_streams() -> Iterator[None]:
    """Context manager in which standard output and error exist, show every letter, and error never fails."""
    with contextlib.ExitStack() as held:
        for name in ("stdout", "stderr"):
            if getattr(sys, name) is None:  # closed by who started the program
                setattr(sys, name, held.enter_context(open(os.devnull, "w", encoding="utf-8")))
                held.callback(setattr, sys, name, None)
            if isinstance(stream := getattr(sys, name), io.TextIOWrapper):
                stream.reconfigure(errors="backslashreplace")
        held.enter_context(contextlib.redirect_stderr(cast(TextIO, _LossyStream(sys.stderr))))
        yield


def _wrong(error: YidError, as_json: bool) -> int:
    print(f"error: {error}", file=sys.stderr)
    _told(as_json, type(error).__name__, code=_EXIT_WRONG_INPUT, **error.four_parts())
    return _EXIT_WRONG_INPUT


def _told(as_json: bool, kind: str, what: str, code: int, **parts: str) -> None:
    """Print an error as JSON on standard output, where `--json` is set."""
    if as_json:
        print(json.dumps({"format": _ERROR_FORMAT, "kind": kind, "what": what, **parts, "exit_code": code}, indent=1))


@contextlib.contextmanager
def _notices() -> Iterator[None]:
    """Context manager that prints the package's warnings on standard error, each once."""
    handler, shown = logging.StreamHandler(sys.stderr), set[str]()

    def is_new(record: logging.LogRecord) -> bool:
        text = record.getMessage()
        new = text not in shown
        shown.add(text)
        return new

    handler.addFilter(is_new)
    handler.setLevel(logging.WARNING)
    handler.setFormatter(logging.Formatter("notice: %(message)s"))
    logger = logging.getLogger("yid_ocp")
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code.

    Returns
    -------
    int
        0 done; 1 the solve failed, the run folder says why; 2 the input is wrong, or the system refused something; 3 a
        bug; 128 and the signal's number where one ended it, as 130 for an interruption. With `--json` an error is
        printed as `yid-error/1` as well: kind, what, where, allowed, hint and exit_code.
    """
    if "_ARGCOMPLETE" in os.environ:
        import_module("yid_ocp.workflow.editor_support").print_shell_completions(build_argument_parser())
    as_json = "--json" in (sys.argv[1:] if argv is None else argv)
    with _reliable_streams():
        return _parsed_and_carried_out(argv, as_json)


def _parsed_and_carried_out(argv: Sequence[str] | None, as_json: bool) -> int:
    try:
        arguments = build_argument_parser().parse_args(argv)
    except SystemExit as error:
        return int(error.code or 0)
    except ConfigError as error:
        return _wrong(error, as_json)
    try:
        with interruption.raise_on_signals(), _notices():
            return _carried_out(arguments, as_json)
    except KeyboardInterrupt as error:
        what = f"interrupted ({str(error) or 'SIGINT'}); nothing half-finished was left"
        code = error.signal_number + 128 if isinstance(error, interruption.InterruptedBySignal) else _EXIT_INTERRUPTED
        print(what, file=sys.stderr)
        _told(as_json, "Interrupted", what, code)
        return code


def _carried_out(arguments: argparse.Namespace, as_json: bool) -> int:
    """Run a command; returns its exit code."""
    try:
        os.getcwd()
    except OSError as error:
        what = f"the working directory is not there: {error.strerror or error}"
        return _wrong(OutputError(what, hint="cd to one that is"), as_json)
    # matrices are small: threads of the linear algebra library cost more than they give, in workers as well
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        gc.disable()  # imports leave nothing to collect, and looking for it takes a tenth of their time
        try:
            command = import_module(f"yid_ocp.workflow.{arguments.module}")
        finally:
            gc.enable()
        code = int(command.run(arguments))
        sys.stdout.flush()
        interruption.raise_if_requested()
        return code
    except Exception as error:
        number = interruption.received_signal_number()
        if number is not None:  # what a library makes of being interrupted is no cause
            raise interruption.InterruptedBySignal(number) from error
        return _failed(error, as_json)


def _failed(error: Exception, as_json: bool) -> int:
    """Print why a command failed; returns its exit code."""
    if isinstance(error, YidError):
        return _wrong(error, as_json)
    if isinstance(error, BrokenPipeError):
        _discard_what_follows(sys.stdout)
        what = "standard output was closed before all was printed"
        return _wrong(OutputError(what, hint="read it to its end"), False)
    if isinstance(error, OSError):
        what = f"the system refused: {error.strerror or error}"
        hint = "see whether disk and rights allow it"
        return _wrong(OutputError(what, where=str(error.filename or ""), hint=hint), as_json)
    if isinstance(error, ValueError) and "embedded null" in str(error):  # what Python says of a NUL in a path
        what, allowed = "a path holds a NUL", "names without control characters"
        return _wrong(ConfigError(what, allowed=allowed, hint="write the path anew"), as_json)
    if isinstance(error, MemoryError):
        what = f"there is not enough memory: {error}"
        return _wrong(InsufficientMemoryError(what, hint="shorten the run, or take fewer links"), as_json)
    # whatever else comes up here is a mistake of ours
    with tempfile.NamedTemporaryFile("w", prefix="yid-ocp-", suffix=".log", delete=False, encoding="utf-8") as file:
        traceback.print_exception(error, file=file)
    what = f"{type(error).__name__}: {error}"
    print(f"bug: {what}\n  please report it with {file.name}", file=sys.stderr)
    _told(as_json, "bug", what, _EXIT_BUG, where=file.name)
    return _EXIT_BUG
