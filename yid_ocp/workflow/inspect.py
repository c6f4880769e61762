"""The command `inspect`: equations, sparsity patterns and linearisation of a run's model."""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from yid_ocp.analysis.dependence import Dependence, dependence
from yid_ocp.analysis.inspection import Linearisation, inspect_step, linearise, linearised_rows
from yid_ocp.analysis.patterns import Pattern, kkt_pattern, kkt_size, stages, step_patterns
from yid_ocp.analysis.symbols import Entry, StepSymbols
from yid_ocp.config.reader import load_config
from yid_ocp.config.settings import Run
from yid_ocp.data.hdf5_file import new_hdf5
from yid_ocp.errors import ModelError
from yid_ocp.export.functions import export_functions
from yid_ocp.export.latex import write_sheet
from yid_ocp.integrator.statics import Statics
from yid_ocp.integrator.step import Step
from yid_ocp.integrator.step_model import StepLinearization
from yid_ocp.problem import EstimationProblem
from yid_ocp.progress import SILENT, Progress
from yid_ocp.report.sparsity import draw_patterns
from yid_ocp.report.summaries import inspect_summary
from yid_ocp.workflow.build import build_problem, build_step, parameter_settings
from yid_ocp.workflow.command import DONE, carry_out
from yid_ocp.workflow.folder import new_run_folder

FORMAT = "yid-inspect/1"
SHOWN_STEPS = 2  # of the NLP in its picture: what comes after looks the same
Array = NDArray[np.float64]


@dataclass(frozen=True)
class InspectOutcome:
    """Result of `run_inspect`: the run folder and the contents of its result.json."""

    folder: Path
    result: dict[str, Any]


@dataclass(frozen=True)
class Point:
    """State and inputs at which the equations are linearised.

    Attributes
    ----------
    words : str
        In a sentence.
    resting : bool
        Whether it is a rest.
    state, torque, theta, path : ndarray, shape (nx,), (nu,), (ntheta,), (nc,)
    """

    words: str
    resting: bool
    state: Array
    torque: Array
    theta: Array
    path: Array


def run(arguments: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    settings = load_config(arguments.config, arguments.overrides)
    asked = (tuple(arguments.entries), arguments.export)
    carry_out(lambda shown: run_inspect(settings, arguments.out, shown, *asked), inspect_summary, arguments)
    return DONE


def run_inspect(
    run: Run,
    out: str | Path | None = None,
    progress: Progress = SILENT,
    entries: Sequence[str] = (),
    export: str | Path | None = None,
) -> InspectOutcome:
    """Write result.json, equations.txt, sparsity.png, kkt.png and linearisation.h5 of a run's model.

    Parameters
    ----------
    run : Run
    out : str or Path, optional
    progress : Progress, optional
    entries : sequence of str
        Equations or their derivatives to write out, see `StepSymbols.entry`; of a parameter, where it enters.
    export : str or Path, optional
        Folder for CasADi functions, C and a LaTeX sheet.

    Raises
    ------
    ConfigError, DataError, ModelError, OutputError
    """
    with new_run_folder(run, out, "inspect") as folder:
        folder.begin(run, "inspect", [part for name in entries for part in ("--entry", name)])
        progress.stage("building the model and its compiled step")
        begun = time.perf_counter()
        step = build_step(run)
        seconds = time.perf_counter() - begun
        symbols = StepSymbols.of(step.equations)
        # a wrong name is told before anything takes time
        named, chosen = _asked(symbols, entries)
        free = tuple(name for name, said in parameter_settings(run, step.system.parameters).items() if said.free)
        progress.stage("linearising")
        problem = build_problem(run, step) if run.recordings.estimate and free else None
        point = _point(step, problem)
        linearisation, rows = _linearised(step, point)
        _write_matrices(folder.path / "linearisation.h5", step, linearisation, point.torque)
        progress.stage("looking for what enters where")
        patterns = _patterns(symbols, linearisation, rows, point)
        draw_patterns(folder.path / "sparsity.png", _layout(patterns))
        folder.write("equations.txt", "\n".join(symbols.lines()) + "\n")
        nlp = None if problem is None else _nlp(symbols, problem, folder.path / "kkt.png")
        files = () if export is None else _exported(symbols, Path(export), point, free, step.time_step)
        result = {
            "format": FORMAT,
            "build_seconds": seconds,
            "compiled": step.compiled,
            "variables": _variables(step),
            "parameters": _parameters(step, set(free)),
            "equations": asdict(inspect_step(step)),
            "blocks": _blocks(symbols),
            "patterns": {name: _pattern_result(pattern) for name, pattern in patterns.items()},
            "nlp": nlp,
            "dependence": _dependence_result(_dependence(step, symbols, problem, point, rows)),
            "linearisation": _linearisation_result(linearisation, point),
            "asked": named,
            "entries": [_entry_result(entry, symbols, _columns_at(step, point)) for entry in chosen],
            "exported": [str(path) for path in files],
        }
        written = folder.finish(result)
        pictures = [path for path in (folder.path / name for name in ("sparsity.png", "kkt.png")) if path.exists()]
        folder.report(run, written, progress, more={"pictures": pictures})
    return InspectOutcome(folder.path, written)


# -- what is computed -------------------------------------------------------------------------------------------------


def _asked(symbols: StepSymbols, entries: Sequence[str]) -> tuple[list[str], list[Entry]]:
    """Parameters, which are single names without brackets, and equations or derivatives among what was asked for."""
    parameters = symbols.equations.system.parameters
    named = [text.strip() for text in entries if text.strip() and not set(text) & set("[,")]
    for name in named:
        parameters.index(name)
    return named, [symbols.entry(text) for text in entries if text.strip() not in named]


def _point(step: Step, problem: EstimationProblem | None) -> Point:
    """Where the first recording starts: at rest at its first posture, or as fitted to its first points."""
    system, sizes = step.system, step.sizes
    theta = system.parameters.vector()
    known = np.zeros(len(system.driven) + len(system.prescribed))
    torque, words = None, "rest with all known coordinates at zero"
    if problem is not None:
        episode = problem.episodes[0]
        known, words = episode.posture, f"rest at the first posture of {episode.name}"
        torque = episode.torque[0] if system.driven else None
        theta = problem.predictor.own_theta(episode, theta)
        if episode.start is not None:
            held = np.zeros(sizes["nu"]) if torque is None else torque
            words = f"the start that was fitted to the first points of {episode.name}"
            return Point(words, False, episode.start.state.copy(), held, theta, episode.path[0])
    rest = Statics(step).solve(known, theta, torque)
    if rest.converged:
        return Point(words, True, rest.state, rest.torque, theta, known[len(system.driven) :])
    words = f"zero, since there is no rest: {rest.message}"
    return Point(words, False, np.zeros(sizes["nx"]), np.zeros(sizes["nu"]), theta, np.zeros(sizes["nc"]))


def _linearised(step: Step, point: Point) -> tuple[Linearisation, StepLinearization]:
    pair = (point.path, point.path) if len(point.path) else None
    try:
        found = linearise(step, point.state, point.torque, point.theta, pair)
    except np.linalg.LinAlgError as error:
        raise ModelError("the step cannot be linearised: its equations are singular", where=point.words) from error
    return found, linearised_rows(step, point.state, point.torque, point.theta, point.path)


def _columns_at(step: Step, point: Point) -> Array:
    """Every variable of the step that starts at the point, in the order of `StepSymbols.columns`."""
    n = step.sizes["n"]
    q, p, z = point.state[:n], point.state[n : 2 * n], point.state[2 * n :]
    q1, _, lam, status = step(q, p, point.torque, point.theta, (point.path, point.path), z)
    return np.concatenate([q, p, z, point.torque, point.theta, [step.time_step], q1, status.internal, lam])


def _patterns(
    symbols: StepSymbols, linearisation: Linearisation, rows: StepLinearization, point: Point
) -> dict[str, Pattern]:
    """Patterns of a step, with the entries marked that differ from zero at the point."""
    system = symbols.equations.system
    count = rows.rows_new.shape[1]
    known = list(system.prescribed_indices)
    kept = np.setdiff1d(np.arange(count), known)
    values = {
        "dR_dy": rows.rows_new[0][np.ix_(kept, kept)],
        "A": linearisation.a,
        "B_u": linearisation.b_input,
        "B_theta": linearisation.b_theta,
        "dR_dtheta": np.vstack([rows.rows_theta[0], rows.p1_theta[0]]),
    }
    where = "the rest" if point.resting else "this point"
    return {name: entry.with_values(values[name], where) for name, entry in step_patterns(symbols).items()}


def _layout(patterns: dict[str, Pattern]) -> list[list[Pattern]]:
    return [[patterns[name] for name in row] for row in (("dR_dy", "A"), ("dR_dtheta", "B_theta", "B_u"))]


def _nlp(symbols: StepSymbols, problem: EstimationProblem, picture: Path) -> dict[str, Any]:
    """Size of the NLP with a node at every step and what it leaves out; draws the picture of its first steps."""
    episode = problem.episodes[0]
    sensors = [samples.sensor for samples in episode.samples if not samples.sensor.efforts]
    left_out = [samples.sensor.group for samples in episode.samples if samples.sensor.efforts] + list(problem.local)
    followed = () if episode.feedback is None else tuple(map(int, episode.feedback.index))
    stage = stages(symbols, problem.shared, sensors, followed, problem.predictor.start_rows)
    steps = [entry.grid.steps for entry in problem.episodes]
    draw_patterns(picture, [[kkt_pattern(stage, problem.shared, min(SHOWN_STEPS, *steps))]])
    return {**asdict(kkt_size(stage, steps)), "left_out": left_out}


def _dependence(
    step: Step, symbols: StepSymbols, problem: EstimationProblem | None, point: Point, rows: StepLinearization
) -> tuple[Dependence, ...]:
    """Where every parameter enters and who sees it; along the recordings where the problem frees it."""
    episode = problem.episodes[0] if problem is not None and point.resting else None
    found = dependence(step, symbols, episode, point.state, point.theta, rows)
    at_start = None if problem is None else problem.evaluate(problem.start)
    if problem is None or at_start is None or not at_start.ok or at_start.jacobian is None:
        return found
    size = np.linalg.norm(at_start.jacobian[problem.rows.data], axis=0)
    along = dict(zip(problem.names, map(float, size), strict=True))
    return tuple(replace(entry, along=along.get(entry.parameter)) for entry in found)


def _exported(
    symbols: StepSymbols, folder: Path, point: Point, free: Sequence[str], time_step: float
) -> tuple[Path, ...]:
    files = export_functions(symbols, folder, point.theta, time_step)
    sheet = folder / "equations.tex"
    write_sheet(sheet, symbols, point.theta, free, time_step)
    return (*files, sheet)


# -- what is written --------------------------------------------------------------------------------------------------


def _blocks(symbols: StepSymbols) -> dict[str, list[dict[str, Any]]]:
    return {
        kind: [{"name": b.name, "meaning": b.meaning, "names": list(b.names)} for b in blocks if b.labels]
        for kind, blocks in (("rows", symbols.rows), ("columns", symbols.columns))
    }


def _pattern_result(pattern: Pattern) -> dict[str, Any]:
    marked = int(np.count_nonzero(pattern.mask & pattern.marked)) if pattern.marked is not None else None
    return {"shape": list(pattern.mask.shape), "nonzeros": pattern.nonzeros, "at_point": marked, "title": pattern.title}


def _dependence_result(found: Sequence[Dependence]) -> dict[str, dict[str, Any]]:
    return {entry.parameter: {**asdict(entry), "words": entry.words} for entry in found}


def _entry_result(entry: Entry, symbols: StepSymbols, at: Array) -> dict[str, Any]:
    made = {"title": entry.title, "row": entry.row, "column": entry.column, "operations": entry.formula.operations}
    return made | {"zero": entry.zero, "value": entry.value(symbols.all_columns, at), "lines": entry.lines}


def _linearisation_result(linearisation: Linearisation, point: Point) -> dict[str, Any]:
    matrices = {"A": linearisation.a, "B_u": linearisation.b_input, "B_theta": linearisation.b_theta}
    return {
        "at": point.words,
        "spectral_radius": linearisation.spectral_radius,
        "norms": {name: float(np.linalg.norm(matrix)) for name, matrix in matrices.items()},
        "finite_difference_errors": linearisation.errors,
    }


def _parameters(step: Step, free: set[str]) -> dict[str, dict[str, Any]]:
    return {
        entry.name: {
            "value": entry.value,
            "unit": entry.unit,
            "lower": entry.lower,
            "upper": entry.upper,
            "free": entry.name in free,
            "description": entry.description,
        }
        for entry in step.system.parameters
    }


def _variables(step: Step) -> list[dict[str, str]]:
    system = step.system
    roles = dict.fromkeys(system.driven, "driven") | dict.fromkeys(system.prescribed, "prescribed")
    return [
        {"name": joint.name, "unit": joint.unit, "role": roles.get(joint.name, "free")}
        for joint in system.mechanism.joints
    ]


def _write_matrices(path: Path, step: Step, linearisation: Linearisation, torque: Array) -> None:
    with new_hdf5(path) as file:
        file.attrs["format"] = "yid-linearisation/1"
        file.attrs["time_step"] = step.time_step
        text = h5py.string_dtype()
        file.attrs["joints"] = np.array(step.system.mechanism.joint_names, dtype=text)
        file.attrs["inputs"] = np.array(step.system.driven, dtype=text)
        file.attrs["parameters"] = np.array(step.system.parameters.names, dtype=text)
        for name, matrix in (
            ("state", linearisation.state),
            ("torque", torque),
            ("A", linearisation.a),
            ("B_u", linearisation.b_input),
            ("B_theta", linearisation.b_theta),
        ):
            file.create_dataset(name, data=matrix)
