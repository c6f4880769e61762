"""The command `solve`: estimate free parameters, predict held-out recordings, and write the run folder."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from yid_ocp.analysis import discretisation, estimation
from yid_ocp.config.settings import RunSettings
from yid_ocp.display import NULL_PROGRESS, Progress
from yid_ocp.files import attributes_to_dict
from yid_ocp.inference import null_test
from yid_ocp.inference.uncertainty import EstimateChecksBeyondFit, covariance_to_dict
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.episodes import EpisodeAndPredictionOrFailure
from yid_ocp.solvers import Iterate, Solution, Status
from yid_ocp.solvers import base as solvers
from yid_ocp.solvers.base import IterationCallback
from yid_ocp.workflow import prediction_outputs
from yid_ocp.workflow.build_problem import build_problem, issues_to_plain_data
from yid_ocp.workflow.command_runner import CommandOutcome, make_command_function
from yid_ocp.workflow.run_folder import RunFolder, atomic_run_folder


def run_solve(
    run: RunSettings, out: str | Path | None = None, progress: Progress = NULL_PROGRESS, is_live: bool = False
) -> CommandOutcome[Solution]:
    """Estimate and validate the parameters, and write the run folder. Successful if the solver converged.

    If the solver failed, the run folder holds the reason and the best parameters found. With `is_live`, a terminal
    shows a table of cost and parameters that is updated in every iteration.
    """
    with atomic_run_folder(run, out) as folder:
        folder.record_run_start(run, "solve")
        progress.begin_stage("building the model and its compiled step", ahead=20.0)
        problem = build_problem(run)
        log_iterate = _iterate_logger(problem, folder, progress, is_live)
        solution = estimation.solve(problem, run.solver, callback=log_iterate, progress=progress)
        problem, checks = solution.problem or problem, solution.checks or EstimateChecksBeyondFit()
        held_out = checks.held_out_predictions
        folder.log_event("end", status=solution.status.value, message=solution.message)
        prediction_outputs.write_solve_trajectories(folder.path / "trajectories.h5", problem, solution, held_out)
        offsets = prediction_outputs.torque_offsets_by_recording
        copied = problem.system, problem.unpack_episode_unknowns(solution.x, 0)[0], solution.parameters
        export = "export", os.path.relpath(folder.final_path), "--out", "model.xml"
        more = {
            "issues": issues_to_plain_data(checks.data_issues),
            "safeguard": checks.cable_memory_message,
            "covariance": _covariance_result(solution, checks.data_std),
            "discretisation": {
                name: {**asdict(own), "std": checks.data_std.get(name)}
                for name, own in checks.discretisation_shifts.items()
            },
            "finer_settings": discretisation.finer_settings(problem),
            "refinement_notes": dict(checks.notes),
            "stability": checks.step_stability,
            "unused_efforts": prediction_outputs.has_unused_efforts(problem),
            "to_use": prediction_outputs.copyable_estimate_texts(*copied, export, checks.uncounted_errors),
            "torque_offsets": {} if solution.evaluation is None else offsets(problem, solution.x),
        }
        result = solution_to_result_dict(problem, solution, held_out) | more
        written = folder.write_result_and_report(run, progress, result, problem=problem, solution=solution)
    return CommandOutcome(folder.path, written, solution, solution.status == Status.CONVERGED)


run_and_return_exit_code = make_command_function(run_solve, "live")


def solve_and_choose_cable_shape_memory(
    run: RunSettings, problem: EstimationProblem, folder: RunFolder, progress: Progress
) -> tuple[EstimationProblem, Solution]:
    """Fit with the run's solver, for a cable with or without its shape memory. Returns the chosen problem and fit."""
    progress.begin_stage(f"solving by {run.solver.name}")
    limits = problem.options.excess_residual_criteria
    found = solvers.fit_problem(problem, run.solver, callback=_iterate_logger(problem, folder, progress), limits=limits)
    return estimation.choose_fit_with_or_without_shape_memory(problem, run.solver, found)[:2]


def _iterate_logger(
    problem: EstimationProblem, folder: RunFolder, progress: Progress, is_live: bool = False
) -> IterationCallback:
    """Return a callback that logs and reports every iterate, also as a table if `is_live`."""
    iterates: list[Iterate] = []

    def iterate(entry: Iterate) -> None:
        values = {name: float(value) for name, value in zip(problem.shared_parameters, entry.x, strict=False)}
        folder.log_event("iterate", iteration=entry.iteration, cost=entry.cost, gradient=entry.gradient_norm, x=values)
        progress.report_iterate(entry)
        if is_live:
            iterates.append(entry)
            progress.renew_results_table(_iterate_table(problem, iterates))

    return iterate


def _iterate_table(problem: EstimationProblem, iterates: Sequence[Iterate]) -> list[Sequence[str]]:
    """Return table rows of cost and parameters (start, now, last step), largest relative steps first."""
    courses = {name: [float(entry.x[i]) for entry in iterates] for i, name in enumerate(problem.shared_parameters)}
    steps = {name: own[-1] - own[-2] if len(own) > 1 else 0.0 for name, own in courses.items()}
    ordered = sorted(courses, key=lambda name: -abs(steps[name]) / max(abs(courses[name][-1]), 1e-12))
    costs = [entry.cost for entry in iterates]
    last = costs[-1] - costs[-2] if len(costs) > 1 else 0.0
    rows = [("cost", "", costs, last), *((n, problem.system.parameters[n].unit, courses[n], steps[n]) for n in ordered)]
    table: list[Sequence[str]] = [("moves most first", "start", "now", "last step", "unit")]
    for name, unit, own, step in rows:
        table.append((name, f"{own[0]:.5g}", f"{own[-1]:.5g}", f"{step:+.2g}", unit))
    return table


def _covariance_result(solution: Solution, data_std: Mapping[str, float]) -> dict[str, Any]:
    if not solution.covariance.size:
        return {"names": [], "matrix": []}
    names = [name for name in data_std if name in solution.unknown_names]
    at = [solution.unknown_names.index(name) for name in names]
    return covariance_to_dict(names, solution.covariance[np.ix_(at, at)], [data_std[name] for name in names])


def solution_to_result_dict(
    problem: EstimationProblem, solution: Solution, held_out: Sequence[EpisodeAndPredictionOrFailure]
) -> dict[str, Any]:
    """Convert a solution to the contents of a `yid-solve/1` result.json, without inputs and versions."""
    errors, _, residuals = estimation.prediction_errors_units_and_fit_rmse(problem, solution, held_out)
    expected = {} if solution.checks is None else solution.checks.expected_prediction_errors
    share = problem.options.excess_residual_criteria.noise_fraction_of_stated_std
    sensor_noise = {c: share * rmse for c, rmse in null_test.assumed_noise_rmse_by_channel(problem).items()}
    noise = {} if problem.has_process_noise else sensor_noise
    priors = problem.options.prior_stds
    more = {p.name: {"meaning": p.description, "prior_std": priors.get(p.name)} for p in problem.system.parameters}
    return {
        "format": "yid-solve/1",
        "status": solution.status.value,
        "message": solution.message,
        "parameters": {n: asdict(e) | more[n.split("[")[0]] for n, e in solution.parameters.items()},
        **attributes_to_dict(solution, "cost iterations=n_iterations evaluations=n_evaluations seconds=wall_time"),
        "fit": asdict(solution.goodness_of_fit),
        "sensor_noise": sensor_noise,
        "residuals": {channel: own | {"expected": noise.get(channel)} for channel, own in residuals.items()},
        "held_out": [e | {"expected": dict(expected.get(e["recording"], {}))} for e in errors[: len(held_out)]],
    }
