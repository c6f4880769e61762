"""The command line: one row for each command, imports only when a command runs, messages for people."""

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
from pathlib import Path
from typing import TYPE_CHECKING, Any

from yid_ocp.errors import YidError

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

    from yid_ocp.config.settings import Run
    from yid_ocp.data import Recording
    from yid_ocp.solvers import Iterate
    from yid_ocp.workflow.folder import Monitor

Rows = list[Sequence[str]]

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


def _carry_out(
    arguments: argparse.Namespace,
    run: Run,
    command: Callable[..., Any],
    summary: Callable[[dict[str, Any]], list[str]],
    *extra: Any,
) -> Any:
    """Run a command of the workflow under a progress bar, tell a person its result, and say where it is."""
    with _progress(arguments.quiet) as monitor:
        outcome = command(run, arguments.out, monitor, *extra)
    if not arguments.quiet:
        _print(summary(outcome.result))
    _say_folder(outcome.folder, arguments.quiet)
    return outcome


def _solve(arguments: argparse.Namespace) -> int:
    from yid_ocp.workflow.solve import run_solve

    outcome = _carry_out(arguments, _load(arguments), run_solve, solve_summary)
    return DONE if outcome.ok else FAILED


def _compare(arguments: argparse.Namespace) -> int:
    from yid_ocp.workflow.compare import run_compare

    outcome = _carry_out(arguments, _load(arguments), run_compare, compare_summary)
    return DONE if outcome.ok else FAILED


def _identifiability(arguments: argparse.Namespace) -> int:
    from yid_ocp.workflow.identifiability import Question, run_identifiability

    run = _load(arguments)
    names = [name for name in arguments.intervals.split(",") if name]
    question = Question(
        at="initial" if arguments.initial else "solution",
        start="known" if arguments.known_start else "unknown",
        grasp_std=None if arguments.known_grasp else Question().grasp_std,
        intervals={"auto": "auto", "all": "all", "none": ()}.get(arguments.intervals, names),
        what_if=arguments.what_if,
    )
    outcome = _carry_out(arguments, run, run_identifiability, identifiability_summary, question)
    return DONE if outcome.ok else FAILED


def _identifiability_arguments(parser: argparse.ArgumentParser) -> None:
    configured()(parser)
    parser.add_argument("--what-if", action="store_true", help="rank changes of the experiment; takes a few minutes")
    text = "95 %% intervals by profile likelihood of: all, none, or NAME,NAME; by default all if they are few"
    parser.add_argument("--intervals", metavar="NAMES", default="auto", help=text)
    parser.add_argument("--initial", action="store_true", help="judge at the initial values, without solving")
    parser.add_argument("--known-start", action="store_true", help="take initial states as known, not estimated along")
    parser.add_argument("--known-grasp", action="store_true", help="take the places of grasps as known")


def _diagnose(arguments: argparse.Namespace) -> int:
    from yid_ocp.config.reader import DIAGNOSIS_DEFAULT, load_config
    from yid_ocp.workflow.diagnose import run_diagnose

    run = load_config(arguments.config, arguments.overrides, DIAGNOSIS_DEFAULT)
    _carry_out(arguments, run, run_diagnose, diagnose_summary)
    return DONE


def _blind(arguments: argparse.Namespace) -> int:
    from yid_ocp.config.reader import DIAGNOSIS_DEFAULT, load_config
    from yid_ocp.workflow.blind import run_blind, summary_lines

    run = load_config(arguments.config, arguments.overrides, DIAGNOSIS_DEFAULT)
    out = arguments.out or f"{run.name}-blind-{arguments.seed}"
    with _progress(arguments.quiet) as monitor:
        outcome = run_blind(run, out, arguments.cases, arguments.seed, monitor)
    if not arguments.quiet:
        _print(summary_lines(outcome.result))
    _say_folder(outcome.folder, arguments.quiet)
    return DONE


def _blind_arguments(parser: argparse.ArgumentParser) -> None:
    configured(optional=True)(parser)
    parser.add_argument("--cases", type=int, default=20, help="size of the ensemble")
    parser.add_argument("--seed", type=int, default=1, help="from which it is drawn")


def _simulate(arguments: argparse.Namespace) -> int:
    from yid_ocp.workflow.simulate import run_simulate

    run = _load(arguments)
    with _progress(arguments.quiet) as monitor:
        outcome = run_simulate(run, arguments.out, monitor, arguments.seed, arguments.noise)
    if not arguments.quiet:
        if outcome.recording is None:
            _print([f"failed: {outcome.result['message']}"])
        else:
            groups = outcome.result["groups"].items()
            rows: Rows = [("group", "samples"), *((name, str(entry["samples"])) for name, entry in groups)]
            _print([*table(rows), "", f"{outcome.recording.duration:g} s in recording.h5"])
    _say_folder(outcome.folder, arguments.quiet)
    return DONE if outcome.ok else FAILED


def _simulate_arguments(parser: argparse.ArgumentParser) -> None:
    configured()(parser)
    parser.add_argument("--seed", type=int, default=0, help="of the noise and of a virtual experiment's motion")
    parser.add_argument("--noise", action="store_true", help="add noise of the recorded deviations")


def _check(arguments: argparse.Namespace) -> int:
    from yid_ocp.workflow.check import run_check

    _carry_out(arguments, _load(arguments), run_check, check_summary)
    return DONE


def _track(arguments: argparse.Namespace) -> int:
    from yid_ocp.workflow.track import run_track

    _carry_out(arguments, _load(arguments), run_track, track_summary)
    return DONE


def _inspect(arguments: argparse.Namespace) -> int:
    from yid_ocp.workflow.inspect import run_inspect

    _carry_out(arguments, _load(arguments), run_inspect, inspect_summary)
    return DONE


def _import(arguments: argparse.Namespace) -> int:
    from yid_ocp.data import read_any, write_recording

    recording = read_any(arguments.file)
    write_recording(recording, arguments.out)
    if not arguments.quiet:
        _print(recording_summary(recording))
    print(arguments.out if arguments.quiet else f"recording: {arguments.out}")
    return DONE


def _import_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", metavar="FILE", help="CSV file or folder, rosbag, MCAP, or a recording")
    parser.add_argument("--out", metavar="RECORDING.h5", required=True, help="recording to write")
    parser.add_argument("--quiet", action="store_true", help="print nothing but the recording's path")


def _export(arguments: argparse.Namespace) -> int:
    from yid_ocp.data import read_recording
    from yid_ocp.export.csv import export_csv

    recording = read_recording(arguments.recording, allow_nan_effort=True)
    files = export_csv(recording, arguments.out)
    if not arguments.quiet:
        _print(recording_summary(recording))
    _print([str(file) for file in files])
    return DONE


def _export_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("recording", metavar="RECORDING.h5", help="recording to write as CSV")
    parser.add_argument("--out", metavar="DIR", required=True, help="folder for the CSV files")
    parser.add_argument("--quiet", action="store_true", help="print nothing but the files' paths")


def _schema(arguments: argparse.Namespace) -> int:
    import json

    from yid_ocp.config.reader import schema
    from yid_ocp.errors import OutputError

    text = json.dumps(schema(), indent=1)
    if arguments.out is None:
        print(text)
        return DONE
    try:
        Path(arguments.out).write_text(text + "\n", encoding="utf-8")
    except OSError as error:
        raise OutputError(f"the schema cannot be written: {error.strerror}", where=arguments.out) from error
    print(arguments.out)
    return DONE


def _schema_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", metavar="FILE", help="file to write; printed when absent")


COMMANDS: tuple[Command, ...] = (
    Command("solve", "estimate the free parameters from recordings", _solve, configured(optional=True)),
    Command("compare", "run several methods on one problem and say whether they agree", _compare, configured()),
    Command(
        "identifiability",
        "say which parameters the recordings determine, and which experiment would tell more",
        _identifiability,
        _identifiability_arguments,
    ),
    Command(
        "diagnose", "find the gap between model and recordings, and what makes it", _diagnose, configured(optional=True)
    ),
    Command(
        "blind",
        "prove the diagnosis on virtual recordings whose effect is withheld; goes on where it was interrupted",
        _blind,
        _blind_arguments,
    ),
    Command("simulate", "write what the model says would be recorded", _simulate, _simulate_arguments),
    Command("check", "validate a configuration, its recordings and the model before a long run", _check, configured()),
    Command("inspect", "show the model's equations in numbers", _inspect, configured()),
    Command("track", "measure the object's points in the frames of a depth camera", _track, configured()),
    Command("import", "turn CSV, rosbag or MCAP into a recording", _import, _import_arguments),
    Command("export", "turn a recording into CSV", _export, _export_arguments),
    Command("schema", "print the JSON Schema of configuration files, for editors", _schema, _schema_arguments),
)


# -- tables for people ------------------------------------------------------------------------------------------------


def solve_summary(result: dict[str, Any]) -> list[str]:
    """Lines that tell a person what a `yid-solve/1` result says."""
    from yid_ocp.report.tables import held_out_rows, medians

    free = {name: entry for name, entry in result["parameters"].items() if entry["free"]}
    failed = result["status"] == "failed"
    words = {"identifiable": "found", "weak": "weakly determined", "not_identifiable": "cannot be found"}
    rows: Rows = [("parameter", "value", "± std", "unit", "verdict", "start")]
    for name, entry in free.items():
        std = "unknown" if entry["std"] is None else f"{entry['std']:.2g}"
        verdict = "" if failed else words[entry["verdict"]]
        rows.append((name, f"{entry['value']:.4g}", std, entry["unit"], verdict, f"{entry['initial']:.4g}"))
    lines = [*table(rows), ""]
    rows = [("channel", "error (rms)", "unit", "samples")]
    rows += [(c, f"{e['rmse']:.3g}", e["unit"], str(e["n"])) for c, e in result["residuals"].items()]
    if len(rows) > 1:
        lines += [*table(rows), ""]
    for entry in result["held_out"]:
        if "message" in entry:
            lines += [f"held-out recording {entry['recording']} could not be predicted: {entry['message']}", ""]
    rows = [("held-out recording", "channel", "error (rms)", "unit", "without a model")]
    predicted = held_out_rows(result)
    for row in [*predicted, *medians(predicted)]:
        without = ", ".join(f"{error:.3g} ({name})" for name, error in row.baselines.items())
        rows.append((row.recording, row.channel, f"{row.rmse:.3g}", row.unit, without))
    lines += [*table(rows), ""] if len(rows) > 1 else []
    lost = [name for name, entry in free.items() if entry["verdict"] == "not_identifiable"]
    weak = [name for name, entry in free.items() if entry["verdict"] == "weak"]
    if failed:
        lines.append("the values are the best point that was reached; nothing can be said about how sure they are")
    if lost and not failed:
        lines.append(f"cannot be found from these recordings: {', '.join(lost)}")
    if weak and not failed:
        lines.append(f"only weakly determined: {', '.join(weak)}")
        lines.append("their deviations are too small on one side; `yid-ocp identifiability` gives intervals")
    lines.append(
        f"{result['status']}: {result['message']} ({result['iterations']} iterations, {result['seconds']:.1f} s)"
    )
    return lines


def track_summary(result: dict[str, Any]) -> list[str]:
    """Lines that tell a person what a `yid-track/1` result says."""
    truth = result["truth_errors"]
    heads = ("error, median [mm]", "error, largest [mm]") if truth else ("", "")
    rows: Rows = [("point", "frames", "± std [mm]", *heads)]
    for name, entry in result["points"].items():
        cells = ["" if entry["std"] is None else f"{1e3 * entry['std']:.1f}"]
        cells += [f"{1e3 * truth[name][key]:.1f}" if name in truth else "" for key in ("median", "largest")]
        rows.append((name, str(entry["frames"]), *cells))
    lines = [*table(rows), ""]
    good = sum(not frame["reason"] for frame in result["frames"])
    spent = 1e3 * result["fit_seconds"]
    lines.append(f"{good} of {len(result['frames'])} frames are good, the fit took {spent:.0f} ms each")
    lines += [f"dropped {number}: {reason}" for reason, number in result["dropped"].items()]
    lines.append(result["clock"]["message"])
    return lines


def compare_summary(result: dict[str, Any]) -> list[str]:
    """Lines that tell a person what a `yid-compare/1` result says."""
    methods: dict[str, Any] = result["methods"]
    free = [name for name, entry in methods[result["reference"]]["parameters"].items() if entry["free"]]
    beside = [key for key in ("published", "truth") if result[key]]
    rows: Rows = [("parameter", *methods, *beside, "verdict")]
    for name in free:
        cells = []
        for entry in methods.values():
            found = entry["parameters"][name]
            cells.append(f"{found['value']:.4g}" + ("" if found["std"] is None else f" ± {found['std']:.2g}"))
        known = [f"{result[key][name]:.4g}" if name in result[key] else "" for key in beside]
        verdict = methods[result["reference"]]["parameters"][name]["verdict"].replace("_", " ")
        rows.append((name, *cells, *known, verdict))
    lines = [*table(rows), ""]

    def row(title: str, *cells: str) -> None:
        prices.append((title, *cells))

    prices: Rows = [("", *methods)]
    row("status", *(entry["status"] for entry in methods.values()))
    costs = [entry["whitened_cost"] for entry in methods.values()]
    row("cost (whitened)", *("failed" if cost is None else f"{cost:.6g}" for cost in costs))
    for channel in sorted({c for e in methods.values() for h in e["held_out"] for c in h.get("rmse", {})}):
        errors = [[h["rmse"][channel] for h in e["held_out"] if channel in h.get("rmse", {})] for e in methods.values()]
        row(f"held out: {channel}", *(f"{sum(e) / len(e):.3g}" if e else "failed" for e in errors))
    row("iterations", *(str(entry["iterations"]) for entry in methods.values()))
    row("evaluations", *(str(entry["evaluations"]) for entry in methods.values()))
    row("wall time [s]", *(f"{entry['wall_seconds']:.2f}" for entry in methods.values()))
    row("CPU time [s]", *(f"{entry['cpu_seconds']:.2f}" for entry in methods.values()))
    row("peak memory [MiB]", *(f"{entry['peak_memory_mib']:.0f}" for entry in methods.values()))
    lines += [*table(prices), ""]
    for name, entry in methods.items():
        if entry["status"] != "converged":
            lines.append(f"{name} did not converge: {entry['message']}")
        lines += [f"{name} differs: {sentence}" for sentence in entry["disagreements"]]
    lines += result["explained"]
    if not any(methods[result["reference"]]["parameters"][name]["verdict"] == "identifiable" for name in free):
        lines.append("no parameter is identifiable from these recordings, so there is nothing to agree on")
        lines.append("`yid-ocp identifiability CONFIG --what-if` says what would have to be measured")
    elif result["agree"]:
        lines.append("all methods agree on the identifiable parameters within their uncertainty")
    return lines


def identifiability_summary(result: dict[str, Any]) -> list[str]:
    """Lines that tell a person what a `yid-identifiability/1` result says."""
    if not result["parameters"]:
        return [f"{result['status']}: {result['message']}; there is no point at which to judge"]
    words = {"identifiable": "identifiable", "weak": "weak", "not_identifiable": "not identifiable"}
    rows: Rows = [("parameter", "value", "±", "± if start and grasps were known", "95 % interval", "unit", "verdict")]
    for name, entry in result["parameters"].items():
        spread = (_percent(entry["std_relative"]), _percent(entry["std_relative_known"]))
        interval = "" if entry["interval"] is None else _interval(*entry["interval"])
        rows.append((name, f"{entry['value']:.4g}", *spread, interval, entry["unit"], words[entry["verdict"]]))
    lines = [*table(rows), ""]
    hidden = [entry["words"] for entry in result["directions"] if entry["verdict"] != "identifiable"]
    if len(hidden) > 8:
        hidden = [*hidden[:8], f"and {len(hidden) - 8} more directions, in result.json"]
    lines += [*hidden, ""] if hidden else []
    if not result["profiles"]:
        lines.append("intervals of parameters are worked out on request: --intervals NAME,NAME or --intervals all")
    lines += [f"{name}: {note}" for name, entry in result["profiles"].items() for note in entry["notes"]]
    asked = result["what_if"]
    if asked is not None:
        total = len(result["parameters"])
        rows = [("what if", "identifiable", "gain [nat]", "")]
        for entry in [asked["base"], *asked["singles"]]:
            gain = "" if entry["gain"] is None else f"{entry['gain']:.1f}"
            rows.append((entry["words"], f"{entry['identifiable']} of {total}", gain, entry["message"]))
        lines += [*table(rows), ""]
        best = asked["smallest"][0]["words"] if asked["smallest"] else ""
        if not asked["smallest"]:
            lines.append("no set of up to three changes makes all of them identifiable")
        else:
            lines.append(f"fewest changes that make all of them identifiable: {best}")
    found = sum(entry["verdict"] == "identifiable" for entry in result["parameters"].values())
    lines.append(f"{found or 'none'} of {len(result['parameters'])} parameters identifiable from these recordings")
    return lines


def _percent(value: float | None) -> str:
    return "unknown" if value is None else f"{100 * value:.2g} %" if value < 10 else f"{value:.2g} times"


def _interval(lower: float | None, upper: float | None) -> str:
    if lower is None and upper is None:
        return "open"
    if lower is None:
        return f"below {upper:.4g}"
    return f"above {lower:.4g}" if upper is None else f"{lower:.4g} to {upper:.4g}"


def diagnose_summary(result: dict[str, Any]) -> list[str]:
    """Lines that tell a person what a `yid-diagnosis/1` result says."""
    import textwrap

    lines = [*textwrap.wrap(result["summary"], 100), ""]
    before, after, units = (result["gap"][a][b] for a, b in (("before", "rmse"), ("after", "rmse"), ("before", "unit")))
    rows: Rows = [("held-out channel", "before", "after", "unit")]
    rows += [(c, f"{e:.3g}", f"{after[c]:.3g}" if c in after else "", units[c]) for c, e in before.items()]
    lines += [*table(rows), ""]
    rows = [("candidate", "parameters", "closure alone", "score", "p")]
    for entry in result["which"][:8]:
        known = {name: q for name, q in entry["parameters"].items() if q["value"] is not None}
        spread = {name: "" if q["std"] is None else f" ± {q['std']:.2g}" for name, q in known.items()}
        values = ", ".join(f"{name} = {q['value']:.3g}{spread[name]} {q['unit']}" for name, q in known.items())
        closed = "" if entry["closure"] is None else f"{100 * entry['closure']:.3g} %"
        label = f"{entry['kind']}@{entry['location']}"
        rows.append((label, values, closed, f"{entry['score']:.3g}", f"{entry['p_value']:.2g}"))
    lines += [*table(rows), ""] if len(rows) > 1 else []
    return [*lines, f"verdict: {result['verdict']} ({sum(result['seconds'].values()):.1f} s)"]


def check_summary(result: dict[str, Any]) -> list[str]:
    """Lines that tell a person what a `yid-check/1` result says."""
    model = result["model"]
    lines = [
        f"model: {model['n']} coordinates, {model['m']} constraints, {model['nu']} driven, {model['nc']} prescribed, "
        f"{model['ntheta']} parameters",
        "",
    ]
    rows: Rows = [("recording", "use", "group", "samples", "rate", "longest gap", "noise (median)")]
    for entry in result["recordings"]:
        for name, group in entry["groups"].items():
            noise = entry["noise"].get(name) or entry["noise"].get(f"{name}.effort")
            shown = "" if noise is None or noise["std"] is None else f"{noise['std']:.3g} {noise['unit']}"
            rows.append(
                (
                    entry["recording"],
                    "held out" if entry["role"] == "held_out" else "estimate",
                    name,
                    str(group["samples"]),
                    f"{group['rate']:.4g} Hz",
                    f"{group['longest_gap']:.3g} s",
                    shown,
                )
            )
    lines += [*table(rows), ""] if len(rows) > 1 else []
    for entry in result["recordings"]:
        gaps = [f"{name} {1e3 * gap:.2g} mm" for name, gap in entry["grasp_gaps"].items()]
        rest = entry.get("equilibrium")
        said = [] if rest is None else ["equilibrium found" if rest["found"] else f"no equilibrium: {rest['message']}"]
        if gaps or said:
            lines.append(
                f"{entry['recording']}: " + "; ".join([*said, *(["grasp gaps " + ", ".join(gaps)] if gaps else [])])
            )
    convergence = result["convergence"]
    for key, head in (("links", "links"), ("time_step", "time step [s]")):
        rows = [(head, "lowest frequencies [Hz]", "")]
        for row in convergence[key]:
            note = row["message"] or (f"{row['growing']} modes grow" if row["growing"] else "")
            rows.append((f"{row['value']:g}", ", ".join(f"{f:.4g}" for f in row["hertz"]), note))
        lines += ["", *table(rows)] if len(rows) > 1 else []
    if convergence["message"]:
        lines += ["", f"frequencies: {convergence['message']}"]
    lines += ["", *(f"warning: {text}" for text in result["warnings"])]
    lines.append(
        "nothing stands in the way of a run" if not result["warnings"] else "a run is possible; see the warnings"
    )
    return lines


def inspect_summary(result: dict[str, Any]) -> list[str]:
    """Lines that tell a person what a `yid-inspect/1` result says."""
    roles = [entry["role"] for entry in result["variables"]]
    counts = [f"{roles.count(role)} {role}" for role in ("driven", "prescribed", "free") if role in roles]
    equations = result["equations"]
    lines = [f"coordinates: {len(roles)} ({', '.join(counts)}), constraints: {equations['sizes']['m']}", ""]
    rows: Rows = [("parameter", "value", "unit", "bounds", "")]
    for name, entry in result["parameters"].items():
        low, high = ("inf" if entry[key] is None else f"{entry[key]:g}" for key in ("lower", "upper"))
        low = "-inf" if entry["lower"] is None else low
        rows.append((name, f"{entry['value']:.6g}", entry["unit"], f"{low} to {high}", "free" if entry["free"] else ""))
    lines += [*table(rows), ""]
    rows = [("function", "operations", "nonzeros")]
    rows += [(f["name"], str(f["operations"]), str(f["nonzeros"])) for f in equations["functions"]]
    count = equations["unknowns"]
    lines += [*table(rows), ""]
    lines.append(f"Jacobian of the step: {count} x {count}, {equations['jacobian_nonzeros']} nonzeros (sparsity.png)")
    linear = result["linearisation"]
    lines.append(f"linearised at {linear['at']}: spectral radius of A {linear['spectral_radius']:.6g}")
    rows = [("matrix", "norm", "largest difference from finite differences")]
    rows += [
        (name, f"{norm:.4g}", f"{linear['finite_difference_errors'][name]:.1e}")
        for name, norm in linear["norms"].items()
    ]
    return [*lines, *table(rows), "matrices: linearisation.h5"]


def recording_summary(recording: Recording) -> list[str]:
    """Lines that tell a person what a recording holds."""
    rows: Rows = [("group", "samples", "names")]
    for group in recording.groups:
        rows.append((getattr(group, "name", "joints"), str(len(group.t)), ", ".join(group.names)))
    return [*table(rows), "", f"{recording.duration:g} s"]


def table(rows: Rows) -> list[str]:
    """Rows as aligned lines, the first one as head; columns without an entry are left out."""
    kept = [i for i in range(len(rows[0])) if any(row[i] for row in rows)]
    widths = [max(len(row[i]) for row in rows) for i in kept]
    lines = ["  ".join(row[i].ljust(width) for i, width in zip(kept, widths, strict=True)).rstrip() for row in rows]
    return [lines[0], "  ".join("-" * width for width in widths), *lines[1:]]


# -- around the commands ----------------------------------------------------------------------------------------------


def _load(arguments: argparse.Namespace) -> Run:
    from yid_ocp.config.reader import load_config

    return load_config(arguments.config, arguments.overrides)


class _PlainProgress:
    """A line for every stage and iterate, for logs and pipes."""

    def __init__(self) -> None:
        self._tenths = 0

    def stage(self, text: str) -> None:
        self._tenths = 0
        print(f"{text} ...", file=sys.stderr, flush=True)

    def iterate(self, entry: Iterate) -> None:
        print(f"  {_iterate_words(entry)}", file=sys.stderr, flush=True)

    def advance(self, done: int, total: int, text: str) -> None:
        tenths = 10 * done // max(total, 1)
        if tenths > self._tenths:  # a line for every frame would be too many
            self._tenths = tenths
            print(f"  {done} of {total}, {text}", file=sys.stderr, flush=True)


class _BarProgress:
    """A moving bar for the stage that runs."""

    def __init__(self, bars: Progress) -> None:
        self._bars = bars
        self._task: TaskID | None = None
        self._text = ""

    def stage(self, text: str) -> None:
        self.close()
        self._text = text
        self._task = self._bars.add_task(text, total=None)

    def iterate(self, entry: Iterate) -> None:
        if self._task is not None:
            self._bars.update(self._task, description=f"{self._text}: {_iterate_words(entry)}")

    def advance(self, done: int, total: int, text: str) -> None:
        if self._task is not None:
            self._bars.update(self._task, description=f"{self._text}: {text}", completed=done, total=total)

    def close(self) -> None:
        """Mark the running stage as done."""
        if self._task is not None:
            self._bars.update(self._task, description=self._text, total=1, completed=1)


def _iterate_words(entry: Iterate) -> str:
    note = f", {entry.note}" if entry.note else ""
    return f"iteration {entry.iteration}, cost {entry.cost:.6g}, {entry.seconds:.1f} s{note}"


@contextlib.contextmanager
def _progress(quiet: bool) -> Iterator[Monitor | None]:
    if quiet:
        yield None
    elif not sys.stderr.isatty():
        yield _PlainProgress()
    else:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

        columns = (BarColumn(bar_width=24), TextColumn("{task.description}", markup=False), TimeElapsedColumn())
        with Progress(*columns, console=Console(stderr=True)) as bars:
            monitor = _BarProgress(bars)
            yield monitor
            monitor.close()


def _print(lines: Sequence[str]) -> None:
    print("\n".join(lines))


def _say_folder(folder: Path, quiet: bool) -> None:
    shown = os.path.relpath(folder)
    print(folder if quiet or shown.startswith("..") else f"run folder: {shown}")


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


def parser() -> argparse.ArgumentParser:
    """The argument parser of all commands."""
    from yid_ocp import __version__

    top = argparse.ArgumentParser(
        prog="yid-ocp", description=__doc__ and "Stiffness of flexible objects from robot recordings."
    )
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
        with _notices():
            return int(arguments.run(arguments))
    except YidError as error:
        print(f"error: {error}", file=sys.stderr)
        return WRONG_INPUT
    except KeyboardInterrupt:
        print("interrupted; no run folder was left", file=sys.stderr)
        return INTERRUPTED
    except Exception as error:  # whatever else comes up here is a mistake of ours
        with tempfile.NamedTemporaryFile("w", prefix="yid-ocp-", suffix=".log", delete=False, encoding="utf-8") as file:
            traceback.print_exc(file=file)
        print(f"bug: {type(error).__name__}: {error}\n  please report it with {file.name}", file=sys.stderr)
        return BUG
