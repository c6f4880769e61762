"""The command `solve`: estimates the free parameters, predicts held-out recordings, writes the run folder."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from yid_ocp.analysis.clock_checks import check_fit_residuals
from yid_ocp.analysis.compare import decide_cable_memory
from yid_ocp.analysis.profile import with_profile_intervals
from yid_ocp.config.reader import load_config
from yid_ocp.config.settings import RunSettings
from yid_ocp.data.issues import Issue
from yid_ocp.inference.uncertainty import covariance_to_dict, mark_not_trusted
from yid_ocp.model.objects.base import CableTopology
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.episodes import Episode, EpisodePrediction
from yid_ocp.problem.prediction_errors import rmse_by_channel
from yid_ocp.progress import NULL_PROGRESS, Progress
from yid_ocp.report.summaries import solve_summary
from yid_ocp.solvers import Iterate, Solution, Status, solve
from yid_ocp.workflow.build import build_cable
from yid_ocp.workflow.build_problem import build_problem
from yid_ocp.workflow.command_runner import CommandResult, run_and_print
from yid_ocp.workflow.discretisation_check import (
    DiscretisationShifts,
    measure_discretisation_shifts,
    requested_refinements,
    with_discretisation_uncertainty,
    with_stability_check,
)
from yid_ocp.workflow.prediction_outputs import (
    channels_worse_than_baseline,
    estimated_torque_offsets,
    prediction_error_entry,
    worse_than_baseline_issues,
    write_solve_trajectories,
)
from yid_ocp.workflow.recording_issues import issues_result
from yid_ocp.workflow.run_folder import new_run_folder

_RESULT_FORMAT = "yid-solve/1"


@dataclass(frozen=True)
class SolveCommandResult(CommandResult):
    """Result of `run_solve` with the solution and its problem; successful where the solver converged."""

    solution: Solution
    problem: EstimationProblem


def run(arguments: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    settings = load_config(arguments.config, arguments.overrides)
    return run_and_print(arguments, lambda shown: run_solve(settings, arguments.out, shown), solve_summary)


def run_solve(
    run: RunSettings, out: str | Path | None = None, progress: Progress = NULL_PROGRESS
) -> SolveCommandResult:
    """Estimate, validate and write the run folder.

    Returns
    -------
    SolveCommandResult
        Also where the solver failed: the run folder then holds the reason and the best point.

    Raises
    ------
    ConfigError, DataError, ModelError, OutputError
    """
    with new_run_folder(run, out) as folder:
        folder.begin_run(run, "solve")
        progress.begin_stage("building the model and its compiled step")
        problem = build_problem(run)
        progress.begin_stage(f"solving for {len(problem.initial_unknowns)} unknowns by {run.solver.name}")

        def iterate(entry: Iterate) -> None:
            values = {name: float(value) for name, value in zip(problem.shared_parameters, entry.x, strict=False)}
            folder.log_event(
                "iterate", iteration=entry.iteration, cost=entry.cost, gradient=entry.gradient_norm, x=values
            )
            progress.report_iterate(entry)

        solution = solve(problem, run.solver, callback=iterate, limits=run.diagnosis.fit_gap_limits)
        safe = decide_cable_memory(problem, run.solver, solution, run.diagnosis.fit_gap_limits)
        solution, stability = with_stability_check(safe.problem, safe.solution)
        problem = solution.problem or safe.problem
        solution = with_profile_intervals(problem, solution, progress)
        finer = DiscretisationShifts({})
        if solution.evaluation is not None:
            finer = measure_discretisation_shifts(
                run, problem, solution.x, solution.evaluation, requested_refinements(run), progress
            )
        # the ± and the verdict of everything below count how far the estimate is from a fine model's
        data_std, solution = solution.std, with_discretisation_uncertainty(solution, finer)
        progress.begin_stage("predicting the held-out recordings")
        held_out = problem.predict_held_out(solution.x)
        cable = build_cable(run)
        solution, doubts = with_fit_issues(problem, solution, held_out, cable)
        folder.log_event(
            "end", status=solution.status.value, message=solution.message, seconds_solving=solution.wall_time
        )
        write_solve_trajectories(folder.path / "trajectories.h5", problem, solution, held_out)
        more = {
            "doubts": issues_result(doubts),
            "safeguard": safe.message,
            "covariance": _covariance_result(solution, data_std),
            "discretisation": finer.to_result(data_std),
            "discretisation_notes": list(finer.notes),
            "stability": stability,
            "torque_offsets": {} if solution.evaluation is None else estimated_torque_offsets(problem, solution.x),
        }
        written = folder.write_result(solve_result(problem, solution, held_out, cable) | more)
        folder.write_report_page(run, written, progress, problem=problem, solution=solution, held_out=tuple(held_out))
    done = solution.status == Status.CONVERGED
    return SolveCommandResult(folder.path, written, solution, problem, is_successful=done)


def with_fit_issues(
    problem: EstimationProblem,
    solution: Solution,
    held_out: Sequence[tuple[Episode, EpisodePrediction | str]],
    cable: CableTopology | None = None,
) -> tuple[Solution, tuple[Issue, ...]]:
    """The solution with untrusted verdicts where its fit raises issues, and all issues of the data.

    Parameters
    ----------
    problem : EstimationProblem
        As it was solved.
    held_out : sequence of (Episode, EpisodePrediction or str)
        From `EstimationProblem.predict_held_out`.
    cable : CableTopology, optional
        For the baselines that it has.
    """
    if solution.evaluation is None:
        return solution, problem.options.data_issues
    fitted, predicted, residuals = _predictions(problem, solution, held_out, cable)
    found = check_fit_residuals(problem, solution.x, solution.evaluation) + worse_than_baseline_issues(
        [*predicted, *fitted], _units(residuals)
    )
    if all(doubt.weight == "warning" for doubt in found):
        return solution, (*problem.options.data_issues, *found)
    believed = replace(solution.goodness_of_fit, believed=False)
    solution = replace(solution, goodness_of_fit=believed, parameters=mark_not_trusted(solution.parameters))
    return solution, (*problem.options.data_issues, *found)


def _covariance_result(solution: Solution, data_std: Mapping[str, float]) -> dict[str, Any]:
    names = [name for name in data_std if name in solution.unknown_names]
    at = [solution.unknown_names.index(name) for name in names]
    if not solution.covariance.size:
        return {"names": [], "matrix": []}
    return covariance_to_dict(names, solution.covariance[np.ix_(at, at)], [data_std[name] for name in names])


def solve_result(
    problem: EstimationProblem,
    solution: Solution,
    held_out: Sequence[tuple[Episode, EpisodePrediction | str]],
    cable: CableTopology | None = None,
) -> dict[str, Any]:
    """Entries of `yid-solve/1` without inputs and versions."""
    fitted, predicted, residuals = _predictions(problem, solution, held_out, cable)
    return {
        "format": _RESULT_FORMAT,
        "status": solution.status.value,
        "message": solution.message,
        "parameters": {name: asdict(entry) for name, entry in solution.parameters.items()},
        "cost": solution.cost,
        "iterations": solution.n_iterations,
        "evaluations": solution.n_evaluations,
        "seconds": solution.wall_time,
        "fit": asdict(solution.goodness_of_fit)
        | {"worse_than_guess": channels_worse_than_baseline([*predicted, *fitted], _units(residuals))},
        "residuals": residuals,
        "held_out": predicted,
    }


def _predictions(
    problem: EstimationProblem,
    solution: Solution,
    held_out: Sequence[tuple[Episode, EpisodePrediction | str]],
    cable: CableTopology | None,
) -> tuple[list[dict[str, Any]], list[dict[str, Any]], Mapping[str, Any]]:
    """Errors of the recordings that were fitted and of those held out beside guesses, and of every channel fitted."""
    residuals: Mapping[str, Any] = {}
    fitted: list[dict[str, Any]] = []
    if solution.evaluation is not None:
        done = solution.episode_predictions
        able = [(r, e) for r, e in zip(done, problem.episodes, strict=True) if not isinstance(r, str)]
        residuals = rmse_by_channel([result for result, _ in able], [episode for _, episode in able])
        fitted = [prediction_error_entry(problem, *pair, cable) for pair in zip(problem.episodes, done, strict=True)]
    return (
        fitted,
        [prediction_error_entry(problem, episode, outcome, cable) for episode, outcome in held_out],
        residuals,
    )


def _units(residuals: Mapping[str, Any]) -> dict[str, str]:
    return {channel: entry["unit"] for channel, entry in residuals.items()}
