"""The command `solve`: estimates the free parameters, predicts held-out recordings, writes the run folder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from yid_ocp.analysis import discretisation
from yid_ocp.analysis.clock_checks import drift_and_overstated_noise_issues
from yid_ocp.analysis.compare import ChosenCableMemoryFit, choose_cable_memory_fit
from yid_ocp.analysis.discretisation import AlternatingErrorGrowth, EstimateShiftByLinksAndTimeStep
from yid_ocp.analysis.profile import solution_with_profile_intervals
from yid_ocp.arrays import Array
from yid_ocp.config.settings import RunSettings
from yid_ocp.data.issues import Issue
from yid_ocp.errors import YidError
from yid_ocp.files import named_attributes
from yid_ocp.inference.uncertainty import (
    all_estimates_marked_not_trusted,
    covariance_to_dict,
    typical_parameter_magnitudes,
)
from yid_ocp.model.objects.base import CableTopology
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.evaluation import Evaluation
from yid_ocp.problem.predictions import rmse_unit_and_count_by_channel
from yid_ocp.progress import NULL_PROGRESS, Progress
from yid_ocp.solvers import Iterate, Solution, Status, solve
from yid_ocp.workflow import prediction_outputs
from yid_ocp.workflow.build import build_step, build_system, cable_topology_between_clamps, divided_link_parameter_scale
from yid_ocp.workflow.build_problem import build_problem, issues_to_plain_data
from yid_ocp.workflow.command_runner import CommandOutcome, command_with_settings
from yid_ocp.workflow.prediction_outputs import EpisodeAndPrediction
from yid_ocp.workflow.run_folder import RunFolder, atomic_run_folder

_Refinement = Literal["links", "time_step"]

_MIN_STEPS_TO_COMPILE = 2000  # steps of one evaluation from which on compiling a finer model saves time
_RESULT_FORMAT = "yid-solve/1"


def run_solve(
    run: RunSettings, out: str | Path | None = None, progress: Progress = NULL_PROGRESS
) -> CommandOutcome[Solution]:
    """Estimate, validate and write the run folder; successful where the solver converged.

    Where it failed the run folder holds the reason and the best point.
    """
    with atomic_run_folder(run, out) as folder:
        folder.record_run_start(run, "solve")
        progress.begin_stage("building the model and its compiled step", ahead=20.0)
        safe = solve_and_decide_cable_memory(run, build_problem(run), folder, progress)
        solution, stability = checked_solution_and_step_stability(safe.problem, safe.solution)
        problem = solution.problem or safe.problem
        solution = solution_with_profile_intervals(problem, solution, progress)
        shifts: dict[str, EstimateShiftByLinksAndTimeStep] = {}
        notes: list[str] = []
        if solution.evaluation is not None:
            at = (solution.x, solution.evaluation, _requested_refinements(run))
            shifts, notes = measure_discretisation_shifts(run, problem, *at, progress)
        # the ± and the verdict of everything below count how far the estimate is from a fine model's
        data_std = solution.std
        sizes = {} if solution.problem is None else typical_parameter_magnitudes(solution.problem, solution.x)
        inflated = discretisation.inflate_estimates_by_discretisation(solution.parameters, shifts, sizes)
        solution = replace(solution, parameters=inflated)
        progress.begin_stage("predicting the held-out recordings", 1.2, 1.5)
        held_out = problem.predict_held_out(solution.x)
        cable = cable_topology_between_clamps(run)
        solution, doubts = checked_solution_and_issues(problem, solution, held_out, cable)
        end = {"status": solution.status.value, "message": solution.message, "seconds_solving": solution.wall_time}
        folder.log_event("end", **end)
        prediction_outputs.write_solve_trajectories(folder.path / "trajectories.h5", problem, solution, held_out)
        offsets = prediction_outputs.estimated_torque_offsets
        more = {
            "doubts": issues_to_plain_data(doubts),
            "safeguard": safe.message,
            "covariance": _covariance_result(solution, data_std),
            "discretisation": discretisation_shifts_to_dict(shifts, data_std),
            "discretisation_notes": notes,
            "stability": stability,
            "torque_offsets": {} if solution.evaluation is None else offsets(problem, solution.x),
        }
        result = solution_to_result_dict(problem, solution, held_out, cable) | more
        known = {"problem": problem, "solution": solution, "held_out": tuple(held_out)}
        written = folder.write_result_and_report(run, progress, result, **known)
    return CommandOutcome(folder.path, written, solution, solution.status == Status.CONVERGED)


run_from_arguments = command_with_settings(run_solve)


def solve_and_decide_cable_memory(
    run: RunSettings, problem: EstimationProblem, folder: RunFolder, progress: Progress
) -> ChosenCableMemoryFit:
    """Solution by the run's solver, every iterate logged, and the decision whether a cable keeps its memory."""
    steps = sum(episode.grid.steps for episode in problem.episodes)
    small = min(max(steps / 500 * (problem.system.n_coordinates / 50) ** 1.7, 0.1), 1.0)
    text = f"solving for {len(problem.initial_unknowns)} unknowns by {run.solver.name}"
    progress.begin_stage(text, 5 * small, 9.5 * small + 1.5)

    def iterate(entry: Iterate) -> None:
        values = {name: float(value) for name, value in zip(problem.shared_parameters, entry.x, strict=False)}
        folder.log_event("iterate", iteration=entry.iteration, cost=entry.cost, gradient=entry.gradient_norm, x=values)
        progress.report_iterate(entry)

    limits = run.diagnosis.null_test_residual_limits
    return choose_cable_memory_fit(
        problem, run.solver, solve(problem, run.solver, callback=iterate, limits=limits), limits
    )


def checked_solution_and_issues(
    problem: EstimationProblem,
    solution: Solution,
    held_out: Sequence[EpisodeAndPrediction],
    cable: CableTopology | None = None,
) -> tuple[Solution, tuple[Issue, ...]]:
    """The solution, its verdicts set to untrusted where the fit is poor, and all issues of data and fit.

    `held_out` is from `EstimationProblem.predict_held_out`, `cable` for the baselines that it has.
    """
    if solution.evaluation is None:
        return solution, problem.options.data_issues
    errors, units, _ = _prediction_errors(problem, solution, held_out, cable)
    found = drift_and_overstated_noise_issues(problem, solution.x, solution.evaluation)
    found += prediction_outputs.worse_than_baseline_issues(errors, units)
    if any(doubt.weight != "warning" for doubt in found):
        believed = replace(solution.goodness_of_fit, believed=False)
        marked = all_estimates_marked_not_trusted(solution.parameters)
        solution = replace(solution, goodness_of_fit=believed, parameters=marked)
    return solution, (*problem.options.data_issues, *found)


def _covariance_result(solution: Solution, data_std: Mapping[str, float]) -> dict[str, Any]:
    if not solution.covariance.size:
        return {"names": [], "matrix": []}
    names = [name for name in data_std if name in solution.unknown_names]
    at = [solution.unknown_names.index(name) for name in names]
    return covariance_to_dict(names, solution.covariance[np.ix_(at, at)], [data_std[name] for name in names])


def solution_to_result_dict(
    problem: EstimationProblem,
    solution: Solution,
    held_out: Sequence[EpisodeAndPrediction],
    cable: CableTopology | None = None,
) -> dict[str, Any]:
    """Contents of a `yid-solve/1` result.json, without inputs and versions."""
    errors, units, residuals = _prediction_errors(problem, solution, held_out, cable)
    worse = prediction_outputs.channels_worse_than_naive_guess(errors, units)
    return {
        "format": _RESULT_FORMAT,
        "status": solution.status.value,
        "message": solution.message,
        "parameters": {name: asdict(entry) for name, entry in solution.parameters.items()},
        "cost": solution.cost,
        "iterations": solution.n_iterations,
        "evaluations": solution.n_evaluations,
        "seconds": solution.wall_time,
        "fit": asdict(solution.goodness_of_fit) | {"worse_than_guess": worse},
        "residuals": residuals,
        "held_out": errors[: len(held_out)],
    }


def _prediction_errors(
    problem: EstimationProblem,
    solution: Solution,
    held_out: Sequence[EpisodeAndPrediction],
    cable: CableTopology | None,
) -> tuple[list[dict[str, Any]], dict[str, str], Mapping[str, Any]]:
    """Errors beside baselines of recordings held out and then of those fitted, units, and errors of channels fitted."""
    residuals: Mapping[str, Any] = {}
    pairs = list(held_out)
    if solution.evaluation is not None:
        fitted = list(zip(problem.episodes, solution.episode_predictions, strict=True))
        able = [(result, episode) for episode, result in fitted if not isinstance(result, str)]
        residuals = rmse_unit_and_count_by_channel([result for result, _ in able], [episode for _, episode in able])
        pairs += fitted
    units = {channel: entry["unit"] for channel, entry in residuals.items()}
    return [prediction_outputs.prediction_error_entry(problem, *pair, cable) for pair in pairs], units, residuals


def discretisation_shifts_to_dict(
    shifts: Mapping[str, EstimateShiftByLinksAndTimeStep], std: Mapping[str, float]
) -> dict[str, Any]:
    """Discretisation shifts of estimates for result.json, with each parameter's standard deviation from the data."""
    return {name: {**asdict(own), "std": std.get(name)} for name, own in shifts.items()}


def _requested_refinements(run: RunSettings) -> tuple[_Refinement, ...]:
    """Refinements that a run's settings request after a solve, by default those that matter for its object."""
    said, item = run.output.discretisation_check_mode, run.model.object
    if said is None:
        said = "both" if item is not None and item.default_link_refinement else "time_step"
    return {"none": (), "time_step": ("time_step",), "both": ("links", "time_step")}[said]  # type: ignore[return-value]


def measure_discretisation_shifts(
    run: RunSettings,
    problem: EstimationProblem,
    x: Array,
    at_x: Evaluation,
    what: tuple[_Refinement, ...],
    progress: Progress = NULL_PROGRESS,
    *,
    models_alone: bool = False,
) -> tuple[dict[str, EstimateShiftByLinksAndTimeStep], list[str]]:
    """Shifts of the estimates when every link is divided in two and when the time step is halved.

    Of every shared free parameter, none where nothing was tried; and why something that was asked for is not known.
    `x`, shape (nx,), is the estimate, `at_x` its evaluation with Jacobian; `models_alone` for a point that is none.
    """
    found: dict[str, dict[str, float]] = {}
    notes: list[str] = []
    for key in what:
        words = "twice the links" if key == "links" else "half the time step"
        if key == "links" and (run.model.object is None or run.model.object.n_links_per_segment_or_total is None):
            continue
        progress.begin_stage(f"trying {words}", 2.5, 2.7)
        try:
            refined = _refined_problem(run, problem, key)
            shifts = discretisation.parameter_shifts_in_finer_model
            own = shifts(refined, problem, x, at_x, model_difference_only=models_alone)
        except YidError as error:
            own = error.what
        if isinstance(own, str):
            notes.append(f"what {words} would change is not known: {own}")
        else:
            found[key] = own
    links, steps = found.get("links", {}), found.get("time_step", {})
    names = problem.shared_parameters if found else ()
    return {name: EstimateShiftByLinksAndTimeStep(links.get(name), steps.get(name)) for name in names}, notes


def _refined_problem(
    run: RunSettings, problem: EstimationProblem, what: _Refinement
) -> discretisation.FinerDiscretisationProblem:
    if what == "time_step":
        return discretisation.FinerDiscretisationProblem(problem.with_time_step(problem.step.time_step / 2))
    recordings, options = [episode.recording for episode in problem.episodes], problem.options
    system = build_system(run, link_division=2)
    steps = sum(episode.grid.steps for episode in problem.episodes)
    compiled = problem.step.is_compiled and steps > _MIN_STEPS_TO_COMPILE
    step = build_step(replace(run, problem=replace(run.problem, use_compiler=compiled)), system)
    factors = {name: float(divided_link_parameter_scale(run, name, 2)) for name in system.parameters.names}
    priors = {name: std * factors.get(name, 1.0) for name, std in options.prior_stds.items()}
    joint = options.multivariate_prior.with_parameters_scaled_by(factors)
    options = replace(options, prior_stds=priors, multivariate_prior=joint)
    made = EstimationProblem(step, recordings, problem.free, options)
    joints = discretisation.fine_joints_by_coarse_joint(problem.system, system)
    return discretisation.FinerDiscretisationProblem(made, factors, joints)


def checked_solution_and_step_stability(
    problem: EstimationProblem, solution: Solution
) -> tuple[Solution, dict[str, Any]]:
    """The solution, marked as not converged where the step is unstable, and stability data for result.json.

    Along the recorded motions, at the start of the search and at the estimate. A search may begin where the step is not
    stable and leave that place; one that ends there has followed the step's own errors.
    """
    growth = discretisation.largest_alternating_error_growth
    begin, end = growth(problem, problem.initial_unknowns), growth(problem, solution.x)
    found = {"start": _growth_result(begin), "estimate": _growth_result(end)}
    if end is not None and not end.keeps_errors_below_resolution:
        status = Status.STALLED if solution.status == Status.CONVERGED else solution.status
        message = f"at the estimate {end.description} ({solution.message})"
        return replace(solution, status=status, message=message), found
    if solution.status == Status.FAILED and begin is not None and not begin.keeps_errors_below_resolution:
        return replace(solution, message=f"at the start {begin.description} ({solution.message})"), found
    return solution, found


def _growth_result(growth: AlternatingErrorGrowth | None) -> dict[str, Any] | None:
    names = "recording=recording_name decades=growth_decades factor=max_step_factor time=max_growth_time time_step"
    return None if growth is None else named_attributes(growth, names)
