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

from yid_ocp.analysis.sparsity_patterns import (
    SparsityPattern,
    kkt_pattern,
    kkt_size,
    nlp_stage_sparsity,
    step_sparsity_patterns,
)
from yid_ocp.analysis.step_diagnostics import (
    CheckedLinearisation,
    ParameterDependence,
    linearise_and_check,
    linearise_step_equations,
    parameter_dependences,
    step_structure,
)
from yid_ocp.analysis.step_symbols import EquationEntry, StepSymbols
from yid_ocp.config.reader import load_config
from yid_ocp.config.settings import RunSettings
from yid_ocp.data.hdf5_io import create_hdf5_atomically
from yid_ocp.errors import ModelError
from yid_ocp.export.equations import export_step_functions, write_equation_sheet
from yid_ocp.integrator.statics import EquilibriumSolver
from yid_ocp.integrator.step import Step
from yid_ocp.integrator.step_model import StepLinearization
from yid_ocp.problem import EstimationProblem
from yid_ocp.progress import NULL_PROGRESS, Progress
from yid_ocp.report.png_figures import draw_sparsity_patterns
from yid_ocp.report.summaries import inspect_summary
from yid_ocp.workflow.build import build_step, parameter_settings
from yid_ocp.workflow.build_problem import build_problem
from yid_ocp.workflow.command_runner import CommandResult, run_and_print
from yid_ocp.workflow.run_folder import new_run_folder

_RESULT_FORMAT = "yid-inspect/1"
_SHOWN_STEPS = 2  # of the NLP in its picture: what comes after looks the same
Array = NDArray[np.float64]


@dataclass(frozen=True)
class _LinearisationPoint:
    """State and inputs at which the equations are linearised."""

    description: str
    is_equilibrium: bool
    state: Array
    torque: Array
    theta: Array
    prescribed_positions: Array


def run(arguments: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    settings = load_config(arguments.config, arguments.overrides)
    asked = (tuple(arguments.entries), arguments.export)
    return run_and_print(arguments, lambda shown: run_inspect(settings, arguments.out, shown, *asked), inspect_summary)


def run_inspect(
    run: RunSettings,
    out: str | Path | None = None,
    progress: Progress = NULL_PROGRESS,
    entries: Sequence[str] = (),
    export: str | Path | None = None,
) -> CommandResult:
    """Write result.json, equations.txt, sparsity.png, kkt.png and linearisation.h5 of a run's model.

    Parameters
    ----------
    entries : sequence of str
        Equations or their derivatives to write out, see `StepSymbols.equation_entry`; of a parameter, where it enters.
    export : str or Path, optional
        Folder for CasADi functions, C and a LaTeX sheet.

    Raises
    ------
    ConfigError, DataError, ModelError, OutputError
    """
    with new_run_folder(run, out, "inspect") as folder:
        folder.begin_run(run, "inspect", [part for name in entries for part in ("--entry", name)])
        progress.begin_stage("building the model and its compiled step")
        begun = time.perf_counter()
        step = build_step(run)
        seconds = time.perf_counter() - begun
        symbols = StepSymbols.from_equations(step.equations)
        # a wrong name is told before anything takes time
        named, chosen = _asked(symbols, entries)
        free = tuple(name for name, said in parameter_settings(run, step.system.parameters).items() if said.free)
        progress.begin_stage("linearising")
        problem = build_problem(run, step) if run.recordings.estimate and free else None
        point = _point(step, problem)
        linearisation, rows = _linearised(step, point)
        _write_matrices(folder.path / "linearisation.h5", step, linearisation, point.torque)
        progress.begin_stage("looking for what enters where")
        patterns = _patterns(symbols, linearisation, rows, point)
        draw_sparsity_patterns(folder.path / "sparsity.png", _layout(patterns))
        folder.write_text_file("equations.txt", "\n".join(symbols.text_lines()) + "\n")
        nlp = None if problem is None else _nlp(symbols, problem, folder.path / "kkt.png")
        files = () if export is None else _exported(symbols, Path(export), point, free, step.time_step)
        result = {
            "format": _RESULT_FORMAT,
            "build_seconds": seconds,
            "compiled": step.is_compiled,
            "variables": _variables(step),
            "parameters": _parameters(step, set(free)),
            "equations": step_structure(step),
            "blocks": _blocks(symbols),
            "patterns": {name: _pattern_result(pattern) for name, pattern in patterns.items()},
            "nlp": nlp,
            "dependence": _dependence_result(_dependence(step, symbols, problem, point, rows)),
            "linearisation": _linearisation_result(linearisation, point),
            "asked": named,
            "entries": [_entry_result(entry, symbols, _columns_at(step, point)) for entry in chosen],
            "exported": [str(path) for path in files],
        }
        written = folder.write_result(result)
        pictures = [path for path in (folder.path / name for name in ("sparsity.png", "kkt.png")) if path.exists()]
        folder.write_report_page(run, written, progress, section_data={"pictures": pictures})
    return CommandResult(folder.path, written)


# -- what is computed -------------------------------------------------------------------------------------------------


def _asked(symbols: StepSymbols, entries: Sequence[str]) -> tuple[list[str], list[EquationEntry]]:
    """Parameters, which are single names without brackets, and equations or derivatives among what was asked for."""
    parameters = symbols.equations.system.parameters
    named = [text.strip() for text in entries if text.strip() and not set(text) & set("[,")]
    for name in named:
        parameters.index(name)
    return named, [symbols.equation_entry(text) for text in entries if text.strip() not in named]


def _point(step: Step, problem: EstimationProblem | None) -> _LinearisationPoint:
    """Where the first recording starts: at rest at its first posture, or as fitted to its first points."""
    system, sizes = step.system, step.sizes
    theta = system.parameters.vector()
    known = np.zeros(len(system.driven) + len(system.prescribed))
    torque, words = None, "rest with all known coordinates at zero"
    if problem is not None:
        episode = problem.episodes[0]
        known, words = episode.initial_known_coordinates, f"rest at the first posture of {episode.name}"
        torque = episode.torque[0] if system.driven else None
        theta = problem.predictor.episode_theta(episode, theta)
        if episode.fixed_initial_state is not None:
            held = np.zeros(sizes["nu"]) if torque is None else torque
            words = f"the start that was fitted to the first points of {episode.name}"
            return _LinearisationPoint(
                words, False, episode.fixed_initial_state.state.copy(), held, theta, episode.prescribed_path[0]
            )
    rest = EquilibriumSolver(step).solve(known, theta, torque)
    if rest.is_converged:
        return _LinearisationPoint(words, True, rest.state, rest.holding_torque, theta, known[len(system.driven) :])
    words = f"zero, since there is no rest: {rest.message}"
    return _LinearisationPoint(words, False, np.zeros(sizes["nx"]), np.zeros(sizes["nu"]), theta, np.zeros(sizes["nc"]))


def _linearised(step: Step, point: _LinearisationPoint) -> tuple[CheckedLinearisation, StepLinearization]:
    pair = (point.prescribed_positions, point.prescribed_positions) if len(point.prescribed_positions) else None
    try:
        found = linearise_and_check(step, point.state, point.torque, point.theta, pair)
    except np.linalg.LinAlgError as error:
        raise ModelError(
            "the step cannot be linearised: its equations are singular", where=point.description
        ) from error
    return found, linearise_step_equations(step, point.state, point.torque, point.theta, point.prescribed_positions)


def _columns_at(step: Step, point: _LinearisationPoint) -> Array:
    n = step.sizes["n"]
    q, p, z = point.state[:n], point.state[n : 2 * n], point.state[2 * n :]
    q1, _, lam, status = step(
        q, p, point.torque, point.theta, (point.prescribed_positions, point.prescribed_positions), z
    )
    return np.concatenate([q, p, z, point.torque, point.theta, [step.time_step], q1, status.internal_coordinates, lam])


def _patterns(
    symbols: StepSymbols, linearisation: CheckedLinearisation, rows: StepLinearization, point: _LinearisationPoint
) -> dict[str, SparsityPattern]:
    system = symbols.equations.system
    count = rows.residual_by_new.shape[1]
    known = list(system.prescribed_indices)
    kept = np.setdiff1d(np.arange(count), known)
    values = {
        "dR_dy": rows.residual_by_new[0][np.ix_(kept, kept)],
        "A": linearisation.a,
        "B_u": linearisation.b_input,
        "B_theta": linearisation.b_theta,
        "dR_dtheta": np.vstack([rows.residual_by_theta[0], rows.p1_by_theta[0]]),
    }
    where = "the rest" if point.is_equilibrium else "this point"
    return {
        name: entry.with_marked_nonzeros(values[name], where) for name, entry in step_sparsity_patterns(symbols).items()
    }


def _layout(patterns: dict[str, SparsityPattern]) -> list[list[SparsityPattern]]:
    return [[patterns[name] for name in row] for row in (("dR_dy", "A"), ("dR_dtheta", "B_theta", "B_u"))]


def _nlp(symbols: StepSymbols, problem: EstimationProblem, picture: Path) -> dict[str, Any]:
    """Size of the NLP with a node at every step and what it leaves out; draws the picture of its first steps."""
    episode = problem.episodes[0]
    sensors = [samples.sensor for samples in episode.measurements if not samples.sensor.effort_joints]
    left_out = [samples.sensor.group_name for samples in episode.measurements if samples.sensor.effort_joints] + list(
        problem.local_parameters
    )
    followed = () if episode.tracking_feedback is None else tuple(map(int, episode.tracking_feedback.state_indices))
    stage = nlp_stage_sparsity(
        symbols, problem.shared_parameters, sensors, followed, problem.predictor.estimated_state_indices
    )
    steps = [entry.grid.steps for entry in problem.episodes]
    draw_sparsity_patterns(picture, [[kkt_pattern(stage, problem.shared_parameters, min(_SHOWN_STEPS, *steps))]])
    return {**asdict(kkt_size(stage, steps)), "left_out": left_out}


def _dependence(
    step: Step,
    symbols: StepSymbols,
    problem: EstimationProblem | None,
    point: _LinearisationPoint,
    rows: StepLinearization,
) -> tuple[ParameterDependence, ...]:
    """Where every parameter enters and who sees it; along the recordings where the problem frees it."""
    episode = problem.episodes[0] if problem is not None and point.is_equilibrium else None
    found = parameter_dependences(step, symbols, episode, point.state, point.theta, rows)
    at_start = None if problem is None else problem.evaluate(problem.initial_unknowns)
    if problem is None or at_start is None or not at_start.ok or at_start.jacobian is None:
        return found
    size = np.linalg.norm(at_start.jacobian[problem.residual_rows.data], axis=0)
    along = dict(zip(problem.unknown_names, map(float, size), strict=True))
    return tuple(replace(entry, along=along.get(entry.parameter)) for entry in found)


def _exported(
    symbols: StepSymbols, folder: Path, point: _LinearisationPoint, free: Sequence[str], time_step: float
) -> tuple[Path, ...]:
    files = export_step_functions(symbols, folder, point.theta, time_step)
    sheet = folder / "equations.tex"
    write_equation_sheet(sheet, symbols, point.theta, free, time_step)
    return (*files, sheet)


# -- what is written --------------------------------------------------------------------------------------------------


def _blocks(symbols: StepSymbols) -> dict[str, list[dict[str, Any]]]:
    return {
        kind: [{"name": b.name, "meaning": b.meaning, "names": list(b.full_names)} for b in blocks if b.labels]
        for kind, blocks in (("rows", symbols.row_blocks), ("columns", symbols.column_blocks))
    }


def _pattern_result(pattern: SparsityPattern) -> dict[str, Any]:
    marked = (
        int(np.count_nonzero(pattern.nonzero_mask & pattern.marked_mask)) if pattern.marked_mask is not None else None
    )
    return {
        "shape": list(pattern.nonzero_mask.shape),
        "nonzeros": pattern.n_nonzeros,
        "at_point": marked,
        "title": pattern.title,
    }


def _dependence_result(found: Sequence[ParameterDependence]) -> dict[str, dict[str, Any]]:
    return {entry.parameter: {**asdict(entry), "words": entry.words} for entry in found}


def _entry_result(entry: EquationEntry, symbols: StepSymbols, at: Array) -> dict[str, Any]:
    made = {
        "title": entry.title,
        "row": entry.row_name,
        "column": entry.column_name,
        "operations": entry.formula.n_operations,
    }
    return made | {
        "zero": entry.is_zero,
        "value": entry.numeric_value(symbols.column_symbols, at),
        "lines": entry.text_lines,
    }


def _linearisation_result(linearisation: CheckedLinearisation, point: _LinearisationPoint) -> dict[str, Any]:
    matrices = {"A": linearisation.a, "B_u": linearisation.b_input, "B_theta": linearisation.b_theta}
    return {
        "at": point.description,
        "spectral_radius": linearisation.spectral_radius,
        "norms": {name: float(np.linalg.norm(matrix)) for name, matrix in matrices.items()},
        "finite_difference_errors": linearisation.finite_difference_errors,
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
        {"name": joint.name, "unit": joint.coordinate_unit, "role": roles.get(joint.name, "free")}
        for joint in system.mechanism.joints
    ]


def _write_matrices(path: Path, step: Step, linearisation: CheckedLinearisation, torque: Array) -> None:
    with create_hdf5_atomically(path) as file:
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
