"""The command `inspect`: show the equations, sparsity patterns and linearisation of a run's model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from yid_ocp.analysis import step_diagnostics
from yid_ocp.analysis.step_symbols import NamedStepEquations
from yid_ocp.arrays import Array
from yid_ocp.config.settings import RunSettings
from yid_ocp.data.recording_hdf5 import create_hdf5_atomically
from yid_ocp.display import Progress
from yid_ocp.errors import ConfigError, ModelError, require_known_names
from yid_ocp.export.equations import export_step_functions
from yid_ocp.files import attributes_to_dict, write_text
from yid_ocp.integrator.statics import EquilibriumSolver
from yid_ocp.integrator.step import Step
from yid_ocp.integrator.step_model import StepResidualsAndJacobians
from yid_ocp.problem import EstimationProblem
from yid_ocp.report.png_figures import draw_sparsity_patterns
from yid_ocp.workflow.build import build_step, free_parameter_names
from yid_ocp.workflow.build_problem import build_problem
from yid_ocp.workflow.command_runner import CommandOutcome, make_command_function
from yid_ocp.workflow.prediction_outputs import store_texts
from yid_ocp.workflow.run_folder import atomic_run_folder

_PATTERN_LAYOUT = (("dR_dy", "A"), ("dR_dtheta", "B_theta", "B_u"))
_ENTRY_KEYS = "title row=row_name column=column_name zero=is_identically_zero lines=text_lines"
_INSPECTED_KEYS = ("value", "unit", "lower", "upper", "description")
_DEPENDENCE_KEYS = (
    "parameter unit rows seen=observable_rows best=most_sensitive_sensor read=directly_dependent_sensors "
    "along=change_along_recordings"
)


@dataclass(frozen=True)
class _LinearisationPoint:
    description: str
    is_equilibrium: bool
    state: Array
    torque: Array
    theta: Array
    prescribed_positions: Array


def _run_inspect(
    run: RunSettings, out: str | Path | None, progress: Progress, entries: Sequence[str], export: str | None
) -> CommandOutcome[None]:
    """Write result.json, equations.txt, sparsity.png and linearisation.h5; if `export`, also functions of the step."""
    with atomic_run_folder(run, out, "inspect") as folder:
        folder.record_run_start(run, "inspect", [part for name in entries for part in ("--entry", name)])
        progress.begin_stage("building the model and its compiled step")
        step = build_step(run)
        symbols, parameters = NamedStepEquations.from_equations(step.equations), step.system.parameters
        # check names before anything slow; parameter names have no brackets
        named = [text for text in map(str.strip, entries) if text and not set(text) & set("[,")]
        require_known_names(named, parameters.names, "parameter", "--entry", ConfigError)
        chosen = [symbols.equation_or_derivative_by_name(text) for text in entries if text.strip() not in named]
        free = free_parameter_names(run, parameters)
        progress.begin_stage("linearising the equations of a step")
        problem = build_problem(run, step) if run.recordings.estimate and free else None
        point = _point(step, problem)
        matrices, rows = _linearised(step, point)
        _write_matrices(folder.path / "linearisation.h5", step, {**vars(point), **matrices})
        progress.begin_stage("finding which variables each equation depends on")
        patterns = _patterns(symbols, matrices, rows, point)
        picture = folder.path / "sparsity.png"
        draw_sparsity_patterns(picture, [[patterns[name] for name in row] for row in _PATTERN_LAYOUT])
        write_text(folder.path / "equations.txt", "\n".join(symbols.text_lines()) + "\n")
        files = () if export is None else export_step_functions(symbols, Path(export), point.theta, step.time_step)
        dependences = _dependence(step, symbols, problem, point)
        moved = {"driven": step.system.driven, "servo": step.system.servos, "prescribed": step.system.prescribed}
        roles = {joint: role for role, joints in moved.items() for joint in joints}
        at = _columns_at(step, point) if chosen else np.zeros(0)
        result = {
            "format": "yid-inspect/1",
            "variables": [
                {"name": joint.name, "unit": joint.unit("rad"), "role": roles.get(joint.name, "free")}
                for joint in step.system.mechanism.joints
            ],
            "parameters": {
                entry.name: {key: getattr(entry, key) for key in _INSPECTED_KEYS} | {"free": entry.name in free}
                for entry in parameters
            },
            "equations": step_diagnostics.step_complexity_summary(step),
            "patterns": {name: _pattern_result(pattern) for name, pattern in patterns.items()},
            "dependence": {entry.parameter: attributes_to_dict(entry, _DEPENDENCE_KEYS) for entry in dependences},
            "linearisation": {
                "at": point.description,
                "spectral_radius": float(np.max(np.abs(np.linalg.eigvals(matrices["A"])), initial=0.0)),
            },
            "asked": named,
            "entries": [
                attributes_to_dict(entry, _ENTRY_KEYS)
                | {"operations": entry.formula.n_operations}
                | {"value": entry.evaluate_numerically(symbols.all_variable_symbols, at)}
                for entry in chosen
            ],
            "exported": [str(path) for path in files],
        }
        written = folder.write_result_and_report(run, progress, result, section_data={"pictures": [picture]})
    return CommandOutcome(folder.path, written, None)


run_and_return_exit_code = make_command_function(_run_inspect, "entries", "export")


def _point(step: Step, problem: EstimationProblem | None) -> _LinearisationPoint:
    """Return the point of linearisation: the first recording's start, an equilibrium or fitted to its first points."""
    system, sizes = step.system, step.sizes
    theta = system.parameters.vector()
    known = np.zeros(len(system.driven) + len(system.prescribed))
    torque, words = None, "rest with all known coordinates at zero"
    if problem is not None:
        episode = problem.episodes[0]
        known, words = episode.initial_known_coordinates, f"rest at the first posture of {episode.name}"
        torque = episode.torque[0] if system.driven else None
        theta = problem.predictor.theta_with_episode_values(episode, theta)
        if episode.fixed_initial_state is not None:
            held = np.zeros(sizes["nu"]) if torque is None else torque
            words = f"the start that was fitted to the first points of {episode.name}"
            start = episode.fixed_initial_state.state.copy()
            return _LinearisationPoint(words, False, start, held, theta, episode.prescribed_path[0])
    rest = EquilibriumSolver(step).solve(known, theta, torque)
    if rest.is_converged:
        return _LinearisationPoint(words, True, rest.state, rest.holding_torque, theta, known[len(system.driven) :])
    words = f"the zero state (no equilibrium was found: {rest.message})"
    return _LinearisationPoint(words, False, np.zeros(sizes["nx"]), np.zeros(sizes["nu"]), theta, np.zeros(sizes["nc"]))


def _linearised(step: Step, point: _LinearisationPoint) -> tuple[dict[str, Array], StepResidualsAndJacobians]:
    """Return the derivatives A, B_u, B_theta of the next state (by state, inputs, parameters), and of all equations."""
    n, path = step.sizes["n"], point.prescribed_positions
    q, p, z = point.state[:n], point.state[n : 2 * n], point.state[2 * n :]
    found = step.jacobians(q, p, point.torque, point.theta, (path, path) if len(path) else None, z)
    if not all(np.isfinite(matrix).all() for matrix in found):
        what, allowed = "the step cannot be linearised: its equations are singular", "a model with regular equations"
        hint = "give massless links a mass, or remove redundant grasps under model.grasp"
        raise ModelError(what, where=point.description, allowed=allowed, hint=hint)
    rows = step_diagnostics.step_equation_jacobians_at_state(step, point.state, point.torque, point.theta, path)
    return dict(zip(("A", "B_u", "B_theta"), found, strict=True)), rows


def _columns_at(step: Step, point: _LinearisationPoint) -> Array:
    """Return the values of all variables of the equations, in a step from the point of linearisation."""
    n, still = step.sizes["n"], point.prescribed_positions
    q, p, z = point.state[:n], point.state[n : 2 * n], point.state[2 * n :]
    q1, _, lam, status = step(q, p, point.torque, point.theta, (still, still), z)
    return np.concatenate([q, p, z, point.torque, point.theta, [step.time_step], q1, status.internal_coordinates, lam])


def _patterns(
    symbols: NamedStepEquations,
    matrices: Mapping[str, Array],
    rows: StepResidualsAndJacobians,
    point: _LinearisationPoint,
) -> dict[str, step_diagnostics.SparsityPattern]:
    prescribed = list(symbols.equations.system.prescribed_coordinate_indices)
    kept = np.setdiff1d(np.arange(rows.residual_by_new.shape[1]), prescribed)
    values = {
        **matrices,
        "dR_dy": rows.residual_by_new[0][np.ix_(kept, kept)],
        "dR_dtheta": np.vstack([rows.residual_by_theta[0], rows.p1_by_theta[0]]),
    }
    found = step_diagnostics.step_jacobian_sparsity_patterns(symbols)
    where = "the rest" if point.is_equilibrium else "this point"
    return {name: entry.with_numerical_nonzeros_marked(values[name], where) for name, entry in found.items()}


def _dependence(
    step: Step, symbols: NamedStepEquations, problem: EstimationProblem | None, point: _LinearisationPoint
) -> tuple[step_diagnostics.EquationsAndSensorsOfParameter, ...]:
    """Return the equations and sensors that depend on each parameter; for free ones also over whole recordings."""
    episode = problem.episodes[0] if problem is not None and point.is_equilibrium else None
    at = point.state, point.torque, point.theta, point.prescribed_positions
    found = step_diagnostics.equations_and_sensors_per_parameter(step, symbols, episode, *at)
    at_start = None if problem is None else problem.evaluate(problem.initial_unknowns)
    if problem is None or at_start is None or not at_start.ok or at_start.jacobian is None:
        return found
    slopes, squares = at_start.jacobian, dict[str, Array]()
    for i, own in enumerate(problem.episodes):
        for samples, block in zip(own.measurements, problem.residual_rows.measurements[i], strict=True):
            group = samples.sensor.group_name
            squares[group] = squares.get(group, np.zeros(slopes.shape[1])) + np.sum(slopes[block] ** 2, axis=0)
    size = np.linalg.norm(slopes[problem.residual_rows.data], axis=0)
    along = dict(zip(problem.unknown_names, map(float, size), strict=True))
    groups, best = [*squares], np.argmax([*squares.values()], axis=0)
    sensor = {name: groups[k] for name, k in zip(problem.unknown_names, best, strict=True) if along[name] > 0}
    return tuple(
        replace(
            entry,
            change_along_recordings=along.get(entry.parameter),
            # the equations of a step do not contain a delay
            most_sensitive_sensor=entry.most_sensitive_sensor or sensor.get(entry.parameter, ""),
        )
        for entry in found
    )


def _pattern_result(pattern: step_diagnostics.SparsityPattern) -> dict[str, Any]:
    return {"shape": list(pattern.nonzero_mask.shape), "nonzeros": pattern.n_nonzeros, "title": pattern.title}


def _write_matrices(path: Path, step: Step, arrays: Mapping[str, Any]) -> None:
    system = step.system
    names = {"joints": system.mechanism.joint_names, "inputs": system.driven, "parameters": system.parameters.names}
    with create_hdf5_atomically(path) as file:
        file.attrs["format"] = "yid-linearisation/1"
        file.attrs["time_step"] = step.time_step
        store_texts(file, names)
        for name in ("state", "torque", "A", "B_u", "B_theta"):
            file.create_dataset(name, data=arrays[name])
