"""Command-line interface: the arguments of all commands, their execution, error output and shell completion.

The package `workflow` implements the commands. A command's module is imported only when the command runs.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import gc
import io
import json
import logging
import os
import re
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, NoReturn, TextIO, cast

from yid_ocp import interruption
from yid_ocp.errors import ConfigError, InsufficientMemoryError, OutputError, YidError, unknown_name_error_arguments

_EXIT_WRONG_INPUT, _EXIT_BUG, _EXIT_INTERRUPTED = 2, 3, 130
_ERROR_FORMAT = "yid-error/1"


@dataclass(frozen=True)
class _Command:
    name: str
    help: str
    run: str | Callable[[argparse.Namespace], int]
    add_arguments: Callable[[argparse.ArgumentParser], None]


def _switch(parser: argparse.ArgumentParser, flag: str, text: str) -> None:
    parser.add_argument(flag, action="store_true", help=text)


def _setting(parser: argparse.ArgumentParser, flag: str, override: str, text: str) -> None:
    parser.add_argument(flag, action="append_const", const=override, dest="overrides", help=text)


def _repeated(parser: argparse.ArgumentParser, flag: str, metavar: str, text: str, dest: str | None = None) -> None:
    parser.add_argument(flag, metavar=metavar, action="append", default=[], dest=dest, help=f"{text}; may be repeated")


def _configured(parser: argparse.ArgumentParser, optional: bool = False) -> None:
    what = "the run's settings; an embedded example when absent" if optional else "the run's settings"
    parser.add_argument("config", metavar="CONFIG.yaml", help=what, nargs="?" if optional else None)
    parser.add_argument("--out", metavar="DIR", help="run folder to create (default: runs/NAME-DATE-TIME)")
    text = "set a setting, for example problem.time_step=0.005; a section, 'solver={max_iterations: 9}', merges with "
    text += "the existing one, and an empty one clears it"
    _repeated(parser, "--set", "KEY=VALUE", text, "overrides")
    _printing(parser, "run folder's path")


def _printing(parser: argparse.ArgumentParser, path: str) -> None:
    _switch(parser, "--quiet", f"print nothing but the {path}")
    _switch(parser, "--verbose", "list every iteration (on a terminal, one line is updated by default)")
    _switch(parser, "--json", "print only the result, or an error, as JSON on standard output")


def _doubting(parser: argparse.ArgumentParser, optional: bool = False) -> None:
    _configured(parser, optional)
    text = "stop with exit code 2 if any recording has an issue (`check`: also if the model has a warning)"
    _setting(parser, "--strict", "recordings.stop_on_any_issue=true", text)


def _working(parser: argparse.ArgumentParser, absent: str = "one for each processor") -> None:
    parser.add_argument("--workers", metavar="N", type=int, help=f"processes that share the work; {absent} when absent")
    text = "HOST:PORT of a Dask scheduler, or its scheduler file, whose workers do the work instead"
    parser.add_argument("--scheduler", metavar="ADDRESS", default="", help=text)


def _solve(parser: argparse.ArgumentParser) -> None:
    _doubting(parser, optional=True)
    text = "show cost and parameters in a table that the terminal renews while it fits; without a terminal nothing"
    _switch(parser, "--live", text)


def _diagnose(parser: argparse.ArgumentParser) -> None:
    _doubting(parser, optional=True)
    text = "run folder of an earlier solve or diagnose of the same model: report what changed since"
    _repeated(parser, "--baseline", "RUN", text)


def _identifiability(parser: argparse.ArgumentParser) -> None:
    _doubting(parser)
    _switch(parser, "--what-if", "rank changes of the experiment; takes a few minutes")
    text = "95 %% intervals by profile likelihood of: all, none or NAME,NAME (default: all if few, none with --initial)"
    parser.add_argument("--intervals", metavar="NAMES", default="auto", help=text)
    _switch(parser, "--initial", "analyse the initial values, without solving")
    _switch(parser, "--unknown-start", "also estimate the initial states, regardless of the settings")
    _working(parser, "this process alone")
    _switch(parser, "--unknown-grasp", "also estimate offsets of the grasps")


def _overrides(parser: argparse.ArgumentParser) -> None:
    _repeated(parser, "--set", "KEY=VALUE", "set a setting in every run, as other commands do", "overrides")
    _printing(parser, "folder's path")
    _working(parser)


def _blind(parser: argparse.ArgumentParser) -> None:
    text = "settings of experiments, varied if there are enough cases; embedded settings when absent"
    parser.add_argument("configs", metavar="CONFIG.yaml", nargs="*", help=text)
    parser.add_argument("--out", metavar="DIR", help="folder of the proof; an existing one is completed")
    parser.add_argument("--cases", type=int, default=20, help="number of cases in the ensemble")
    parser.add_argument("--seed", type=int, default=1, help="random seed of the ensemble")
    text = "make and diagnose the K-th of N slices of the ensemble only, in a folder of its own"
    parser.add_argument("--slice", metavar="K/N", default="1/1", help=text)
    text = "score slices of one ensemble together: their files slice.json, or folders that hold one"
    parser.add_argument("--join", metavar="FILE", nargs="+", help=text)
    text = "draw an ensemble for setting thresholds, with other cases than the reported one of the same seed"
    _switch(parser, "--calibration", text)
    text = "score the finished cases of a proof again with the thresholds of --set, without a refit"
    parser.add_argument("--rescore", metavar="DIR", help=text)
    _overrides(parser)


def _batch(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("configs", metavar="CONFIG.yaml", nargs="+", help="settings of one run each")
    text = "pattern of recordings in quotes, such as 'fleet/*.h5': every configuration runs for each of them"
    parser.add_argument("--recordings", metavar="GLOB", help=text)
    parser.add_argument("--command", dest="each", choices=("solve", "diagnose"), default="solve", help="command to run")
    text = "folder of all runs (default: runs/batch-DATE-TIME); an existing one is completed"
    parser.add_argument("--out", metavar="DIR", help=text)
    _overrides(parser)


def _track(parser: argparse.ArgumentParser) -> None:
    _doubting(parser)
    text = "keep the specified camera pose and depth (of a hand-eye calibration); the arm only checks them"
    _setting(parser, "--fix-pose", "track.options.calibration.fix_pose=true", text)
    _working(parser, "this process alone")


def _simulate(parser: argparse.ArgumentParser) -> None:
    _configured(parser)
    parser.add_argument("--seed", type=int, default=0, help="random seed of noise and virtual motion")
    _switch(parser, "--noise", "add noise of the recorded standard deviations")


def _inspect(parser: argparse.ArgumentParser) -> None:
    _configured(parser)
    text = "equation to print; with COLUMN, its derivative ('del[T1_0_x], q1[T1_0_x]'); or a parameter, to see its use"
    _repeated(parser, "--entry", "ROW[, COLUMN]", text, "entries")
    parser.add_argument("--export", metavar="DIR", help="folder for the equations as CasADi functions and C")


def _import(parser: argparse.ArgumentParser) -> None:
    files = "CSV, C3D, MCAP, rosbag (file or folder), LeRobot dataset (folder), or a recording; several of one run, "
    files += "such as joints and motion capture, become one recording"
    parser.add_argument("files", metavar="FILE", nargs="+", help=files)
    parser.add_argument("--out", metavar="RECORDING.h5", help="recording to write; needed without --preview")
    _switch(parser, "--preview", "show the content and the import command, and write nothing")
    text = "configuration whose section `import` sets the options; flags override it"
    parser.add_argument("--config", metavar="CONFIG.yaml", help=text)
    _importing(parser)
    _printing(parser, "recording's path")


def _importing(parser: argparse.ArgumentParser) -> None:
    """Add a flag for each key of the section `import`. A flag for a list accepts commas, and may be repeated."""
    group = parser.add_argument_group("reading files of other tools")
    listed = (
        ("--joint-topic", "joint_topics", "TOPIC", "of a bag: topic of joint states; several are merged on one clock"),
        ("--field", "message_fields", "CHANNEL=/TOPIC.FIELD", "of a bag: array of any message; joints are 1, 2, ..."),
        ("--joints", "joints", "NAME[=NEW]", "joints to keep, in order, and their names in the URDF; * is any text"),
        ("--points", "point_names", "SOURCE=POINT", "topic, TOPIC:FRAME, marker or stem, and its point if it differs"),
        ("--columns", "column_meanings", "COLUMN=MEANING", "t, CHANNEL:JOINT, AXIS:POINT or skip; or in order"),
        ("--units", "units", "UNIT", "units that are not SI: deg, mm, ms, or QUANTITY=UNIT"),
        ("--torque-constants", "torque_constants", "JOINT=N_M_PER_A", "where the efforts are currents; * is any text"),
        ("--clock-offset", "file_clock_offsets", "FILE=SECONDS", "of several files: added to the times of that one"),
        ("--gear-ratios", "gear_ratios", "JOINT=RATIO", "turns of the motor per turn of the joint"),
    )
    for flag, key, shape, text in listed:
        group.add_argument(flag, dest=key, metavar=f"{shape},...", action="append", default=[], help=text)
    text = "of a bag: topic of joint states whose positions are commands"
    group.add_argument("--command-topic", metavar="TOPIC", help=text)
    text = "of a bag: make points at this distance along the axes of every pose [m]"
    group.add_argument("--pose-axis-point-distance", type=float, metavar="METRES", help=text)
    text = "of a table: the first row holds numbers, not names"
    group.add_argument("--no-header", dest="has_header", action="store_const", const=False, help=text)
    text = "of a table: skip and count lines that are not numbers"
    group.add_argument("--skip-bad-lines", action="store_const", const=True, help=text)
    group.add_argument("--delimiter", metavar="CHARACTER", help="of a table: character between cells")
    group.add_argument("--episode", type=int, metavar="NUMBER", help="episode of a LeRobot dataset; 0 when absent")
    group.add_argument("--timestamp-kind", choices=("recorded", "nominal"), help="of a table: kind of its times")
    group.add_argument("--point-sensor-name", metavar="TEXT", help="name of the sensor of the points")
    group.add_argument("--point-frame", metavar="TEXT", help="reference frame of points, of a table or C3D file")


def _init(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("robot", metavar="ROBOT", help="URDF or MJCF file, or package:NAME such as package:ur5")
    text = "recordings, or files for `import`; of several the last ones are held out"
    parser.add_argument("files", metavar="FILE", nargs="+", help=text)
    parser.add_argument("--out", metavar="CONFIG.yaml", required=True, help="configuration to write")
    _switch(parser, "--replace", "overwrite existing files")
    text = "held object: cable, beam, tree, foam_y or others (any word lists them); without it, an arm with a payload"
    parser.add_argument("--object", metavar="KIND", help=text)
    for name, unit in (("length", "m"), ("mass", "kg"), ("radius", "m")):
        text = f"{name} of the object, or of each equal branch [{unit}]"
        parser.add_argument(f"--{name}", type=float, metavar="NUMBER", help=text)
    parser.add_argument("--section", metavar="X,Y", help="extents of a rectangular cross section [m], not a radius")
    _repeated(parser, "--number", "NAME=VALUE", "further number of an object; an unknown name lists them")
    parser.add_argument("--links", type=int, metavar="NUMBER", help="rigid links of each segment")
    parser.add_argument("--branches", type=int, metavar="NUMBER", help="of a tree: number of equal branches in a star")
    text = "of a tree: NAME=LENGTH,MASS,RADIUS[,ROLL,PITCH,YAW]; NAME@PARENT grows on PARENT's end"
    _repeated(parser, "--branch", "BRANCH", text)
    parser.add_argument("--holder", metavar="FRAME", help="frame of the robot that carries the object's root")
    _repeated(parser, "--grasp", "FRAME=POINT", "further grasp, such as right_gripper=w_cable")
    _importing(parser)
    _printing(parser, "configuration's path")


def _export(parser: argparse.ArgumentParser) -> None:
    text = "recording to write as CSV or MCAP, or run folder of solve or diagnose whose model or signals to write"
    parser.add_argument("source", metavar="RECORDING.h5|RUN", help=text)
    text = "of a recording: csv (default) or mcap; of a run: mjcf, urdf, sdf, yaml for a configuration that starts at "
    text += "the estimates (default: by the ending of --out, else mjcf), or mcap for all signals"
    parser.add_argument("--format", metavar="FORMAT", help=text)
    text = "folder for CSV or MCAP files, or file for the model; its manifest is written next to it"
    parser.add_argument("--out", metavar="PATH", required=True, help=text)
    text = "write a model even if the format cannot hold all of it; the manifest lists omissions"
    parser.add_argument("--lossy", action="store_true", help=text)
    _printing(parser, "files' paths")


def _report(parser: argparse.ArgumentParser) -> None:
    text = "run folders of solve or diagnose, in the order of time; two of the same recordings are overlaid"
    parser.add_argument("runs", metavar="RUN", nargs="+", help=text)
    parser.add_argument("--out", metavar="DIR", help="folder to create (default: a dated one in runs)")
    _printing(parser, "folder's path")


def _schema(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", metavar="FILE", help="file to write; printed when absent")


def _print_schema(arguments: argparse.Namespace) -> int:
    from yid_ocp.config.schema import config_json_schema
    from yid_ocp.files import write_text

    text = json.dumps(config_json_schema(), indent=1)
    if arguments.out is not None:
        write_text(Path(arguments.out), text + "\n")
    print(text if arguments.out is None else arguments.out)
    return 0


def _print_shell_completions(parser: argparse.ArgumentParser) -> None:
    """Print completions for the calling shell and exit. Without the package argcomplete, return without output."""
    with contextlib.suppress(ImportError):
        import_module("argcomplete").autocomplete(parser, always_complete_options="long")


_SAID_IDENTIFIABILITY = "list the parameters that the recordings determine, and experiments that would determine more"
_SAID_BLIND = "test the diagnosis on synthetic recordings with sealed effects; resumes an interrupted test"
_SAID_REPORT = "compare runs of one model: changed parameters, deviating runs; overlay two of the same recordings"
_SAID_EXPORT = "turn a recording into CSV or MCAP, a run into MJCF, URDF, SDF, YAML or MCAP"
_HEADINGS = {"import": "prepare", "solve": "estimate and explain", "plan": "use"}  # by the first command below it
COMMANDS = (
    _Command("import", "turn a file of another tool into a recording", "import_recording", _import),
    _Command("track", "measure the object's points in the frames of a depth camera", "track", _track),
    _Command("init", "write a commented configuration from a robot and recordings of it", "init", _init),
    _Command("check", "validate a configuration, its recordings and the model before a long run", "check", _doubting),
    _Command("solve", "estimate the free parameters from recordings", "solve", _solve),
    _Command("identifiability", _SAID_IDENTIFIABILITY, "identifiability", _identifiability),
    _Command("diagnose", "test for a gap between model and recordings, and name its cause", "diagnose", _diagnose),
    _Command("friction", "choose the friction law that the recordings justify", "friction", _doubting),
    _Command("compare", "run several methods on one problem and compare their results", "compare", _doubting),
    _Command("plan", "plan a motion of the arms with the identified model", "plan", _configured),
    _Command("simulate", "simulate a recording with the model", "simulate", _simulate),
    _Command("export", _SAID_EXPORT, "export", _export),
    _Command("inspect", "show the model's equations: names, patterns, single entries, numbers", "inspect", _inspect),
    _Command("report", _SAID_REPORT, "run_history", _report),
    _Command("batch", "solve or diagnose many recordings or robots, one table and report of all", "batch", _batch),
    _Command("blind", _SAID_BLIND, "blind", _blind),
    _Command("schema", "print the JSON Schema of configuration files, for editors", _print_schema, _schema),
)


class _GroupedHelp(argparse.HelpFormatter):
    def _format_action(self, action: argparse.Action) -> str:
        heading = _HEADINGS.get(action.dest)
        return f"\n  {heading}:\n" * bool(heading) + super()._format_action(action)


class _Parser(argparse.ArgumentParser):
    """An argument parser that raises `ConfigError` for invalid arguments, with the nearest known name as hint."""

    parsers_by_command: dict[str, _Parser] | None = None  # of all commands, at the parser of a command

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> tuple[Any, list[str]]:
        found, rest = super().parse_known_args(args, namespace)
        if rest:
            flag, flags = rest[0].partition("=")[0], [name for name in self._option_string_actions if name[:2] == "--"]
            if not flag.startswith("-"):
                what, hint = f"'{rest[0]}' is one argument too many", f"leave it out, or {self._help()}"
                words = [*(args or ())]
                before = words[words.index(rest[0]) - 1] if rest[0] in words else ""
                if getattr(self._option_string_actions.get(before), "nargs", None) == 0:
                    what = f"{before} takes no value, so {what}"
                if lacking := [own for own in getattr(found, "overrides", None) or () if "=" not in own]:
                    name = lacking[0].rstrip(":")
                    what, hint = f"--set {name} has no value", f"write --set {name}=VALUE, without spaces"
                raise ConfigError(what, where=self.prog, allowed=self._usage(), hint=hint)
            said = unknown_name_error_arguments(flag, flags, self._help())
            parsers = self.parsers_by_command or {}
            others = [name for name, own in parsers.items() if flag in own._option_string_actions]
            what = f"there is no option '{flag}'" + (f"; the command {' or '.join(others)} has it" if others else "")
            raise ConfigError(what, where=self.prog, **said)
        return found, rest

    def error(self, message: str) -> NoReturn:
        chosen = re.fullmatch(r"argument (\S+): invalid choice: '?(.*?)'? \(choose from (.*)\)", message, re.DOTALL)
        if chosen:
            known = [name.strip(" '") for name in chosen[3].split(",")]
            noun = "command" if chosen[1] == "COMMAND" else f"choice of {chosen[1]}"
            hint = "write the command first, then its options; " * (noun == "command") + self._help()
            details = unknown_name_error_arguments(chosen[2], known, hint)
            raise ConfigError(f"there is no {noun} '{chosen[2]}'", where=self.prog, **details)
        where, allowed, hint = self.prog, self._usage(), self._help()
        if lacking := re.fullmatch(r"the following arguments are required: (.*)", message):
            about = {(*own.option_strings, own.metavar)[0]: f" ({own.help})" for own in self._needed() if own.help}
            hint = f"add {', '.join(name + about.get(name, '') for name in lacking[1].split(', '))}; {hint}"
        if wrong := re.fullmatch(r"argument (\S+): invalid (\w+) value: (.*)", message, re.DOTALL):
            allowed = {"int": "a whole number", "float": "a number such as 0.5"}[wrong[2]]
            where = f"{self.prog} {wrong[1]}"
            message = f"{wrong[1]} is {wrong[3]}, but must be {allowed}"
        raise ConfigError(message, where=where, allowed=allowed, hint=hint)

    def _needed(self) -> list[argparse.Action]:
        return [own for own in self._actions if own.required or not (own.option_strings or own.nargs == "?")]

    def _usage(self) -> str:
        """Arguments that the command has, such as `yid-ocp init ROBOT FILE ... --out CONFIG.yaml [OPTIONS]`."""
        words = (" ".join([*own.option_strings[:1], str(own.metavar or own.dest)]) for own in self._needed())
        optional = (f"[{own.metavar or own.dest}]" for own in self._actions if own.nargs == "?")
        return " ".join([self.prog, *words, *optional, "[OPTIONS]"])

    def _help(self) -> str:
        return f"see {self.prog} --help"


def build_argument_parser() -> argparse.ArgumentParser:
    """Return the argument parser of all commands. It raises `ConfigError` if an argument is invalid."""
    from yid_ocp import __version__

    about = "Stiffness of flexible objects from robot recordings."
    top = _Parser(prog="yid-ocp", description=about, formatter_class=_GroupedHelp)
    top.add_argument("--version", action="version", version=f"yid-ocp {__version__}")
    commands = top.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for row in COMMANDS:
        added = commands.add_parser(row.name, help=row.help, description=row.help[0].upper() + row.help[1:] + ".")
        row.add_arguments(added)
        added.set_defaults(run=row.run)
        added.parsers_by_command = commands.choices
    return top


class _LossyStream:
    """A wrapper of standard error that discards text that it cannot write, so that a full disk stops no command."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        try:
            self._stream.write(text)
            self._stream.flush()
        except OSError:
            _discard_what_follows(self._stream)
        return len(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def _discard_what_follows(stream: TextIO) -> None:
    """Redirect an unwritable stream to the null device, because otherwise Python fails again when it exits."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


@contextlib.contextmanager
def _reliable_streams() -> Iterator[None]:
    """Ensure that output streams exist and escape unprintable text in a `with` block. Standard error never fails."""
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
    _told(as_json, type(error).__name__, code=_EXIT_WRONG_INPUT, **error.message_parts())
    return _EXIT_WRONG_INPUT


def _told(as_json: bool, kind: str, what: str, code: int, **parts: str) -> None:
    if as_json:
        print(json.dumps({"format": _ERROR_FORMAT, "kind": kind, "what": what, **parts, "exit_code": code}, indent=1))


@contextlib.contextmanager
def _notices() -> Iterator[None]:
    """Print each different warning of the package once on standard error, inside a `with` block."""
    handler = logging.StreamHandler(sys.stderr)
    shown = set[str]()

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
    """Run the command in `argv` (default: the arguments of this process) and return its exit code.

    Returns
    -------
    int
        0: done. 1: the solve failed; the run folder states why. 2: wrong input, or an error of the operating system.
        3: a bug. 128 plus the signal number (130 for Ctrl-C) if a signal ended the command. With `--json` an error is
        also printed on standard output, as JSON `yid-error/1`: kind, what, where, allowed, hint and exit_code.
    """
    if "_ARGCOMPLETE" in os.environ:
        _print_shell_completions(build_argument_parser())
    as_json = "--json" in (sys.argv[1:] if argv is None else argv)
    with _reliable_streams():
        try:
            arguments = build_argument_parser().parse_args(argv)
        except SystemExit as error:
            return int(error.code or 0)
        except ConfigError as error:
            return _wrong(error, as_json)
        try:
            with interruption.raise_on_termination_signals(), _notices():
                return _carried_out(arguments, as_json)
        except KeyboardInterrupt as error:
            what = f"the command was interrupted ({str(error) or 'SIGINT'}); incomplete results were discarded"
            number = getattr(error, "signal_number", None)  # of an `InterruptedBySignal`
            code = _EXIT_INTERRUPTED if number is None else 128 + int(number)
            print(what, file=sys.stderr)
            _told(as_json, "Interrupted", what, code)
            return code


def _carried_out(arguments: argparse.Namespace, as_json: bool) -> int:
    try:
        os.getcwd()
    except OSError:
        what, allowed = "the working directory has been deleted or moved", "an existing working directory"
        return _wrong(OutputError(what, where=".", allowed=allowed, hint="cd to an existing folder"), as_json)
    # matrices are small: threads of the linear algebra library cost more than they gain, in workers as well
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # freed arrays stay, in pages of the usual size: new pages take a tenth of the time, huge ones more
    os.environ.setdefault("NUMPY_MADVISE_HUGEPAGE", "0")
    with contextlib.suppress(OSError, AttributeError, TypeError):
        # glibc's M_TRIM_THRESHOLD, M_MMAP_THRESHOLD and M_ARENA_MAX: threads reuse what other threads freed
        for option, value in ((-1, 2**30), (-3, 2**30), (-8, 1)):
            ctypes.CDLL(None).mallopt(option, value)
    try:
        run, arguments.begin_time = arguments.run, time.monotonic()
        if isinstance(run, str):
            gc.disable()  # imports leave nothing to collect, and looking for it takes a tenth of their time
            try:
                run = import_module(f"yid_ocp.workflow.{run}").run_and_return_exit_code
                gc.freeze()  # nor do later collections look through modules
            finally:
                gc.enable()
        code = int(run(arguments))
        sys.stdout.flush()
        interruption.raise_if_interrupted()
        return code
    except Exception as error:
        interruption.raise_if_interrupted()  # a library's error during an interruption is not the cause
        return _failed(error, as_json)


def _failed(error: Exception, as_json: bool) -> int:
    if isinstance(error, YidError):
        return _wrong(error, as_json)
    if isinstance(error, BrokenPipeError):
        _discard_what_follows(sys.stdout)
        what = "the reader of standard output closed it before the whole output was printed"
        hint = "read the output to its end, or write it to a file"
        return _wrong(OutputError(what, where="standard output", allowed="an open pipe or file", hint=hint), False)
    if isinstance(error, OSError):
        what = f"the operating system reports: {error.strerror or error}"
        where, allowed = str(error.filename or "files of this command"), "readable inputs, and writable disk space"
        hint = "correct the path" if isinstance(error, FileNotFoundError) else "check permissions, and space with df -h"
        return _wrong(OutputError(what, where=where, allowed=allowed, hint=hint), as_json)
    if isinstance(error, ValueError) and "embedded null" in str(error):  # what Python says of a NUL in a path
        what, allowed = "a path contains a null character", "paths without null characters"
        return _wrong(ConfigError(what, where="command line", allowed=allowed, hint="correct the path"), as_json)
    if isinstance(error, MemoryError):
        what, hint = f"there is not enough memory: {error}", "use shorter recordings, fewer links or --workers 1"
        allowed = "a run that fits into the free memory"
        return _wrong(InsufficientMemoryError(what, where="this machine", allowed=allowed, hint=hint), as_json)
    if isinstance(error, ModuleNotFoundError) and not (error.name or "yid_ocp").startswith("yid_ocp"):
        what, allowed = f"the Python package {error.name} cannot be imported", "an environment with all dependencies"
        hint, where = "pip install . in the project's clone", f"the Python environment {sys.prefix}"
        return _wrong(ConfigError(what, where=where, allowed=allowed, hint=hint), as_json)
    # any other exception is a bug of this package
    with tempfile.NamedTemporaryFile("w", prefix="yid-ocp-", suffix=".log", delete=False, encoding="utf-8") as file:
        traceback.print_exception(error, file=file)
    what = f"{type(error).__name__}: {error}"
    print(f"bug in yid_ocp: {what}\n  please report it to the project, with the log {file.name}", file=sys.stderr)
    _told(as_json, "bug", what, _EXIT_BUG, where=file.name)
    return _EXIT_BUG
