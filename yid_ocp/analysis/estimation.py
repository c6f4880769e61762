"""Estimate of a problem's parameters as `solve` reports it: solution, all that its uncertainty includes, and checks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from yid_ocp.analysis import discretisation
from yid_ocp.analysis.baseline_comparison import (
    predict_held_out_with_expected_errors,
    prediction_errors_and_units,
    worse_than_baseline_issues,
)
from yid_ocp.analysis.cable_memory import choose_cable_memory_fit
from yid_ocp.analysis.clock_checks import drift_and_overstated_noise_issues
from yid_ocp.analysis.discretisation import AlternatingErrorGrowth
from yid_ocp.analysis.profile import solution_with_profile_intervals
from yid_ocp.data.issues import Issue
from yid_ocp.files import named_attributes
from yid_ocp.inference.uncertainty import free_estimates_marked_not_trusted, typical_parameter_magnitudes
from yid_ocp.problem import EstimationProblem
from yid_ocp.progress import NULL_PROGRESS, Progress
from yid_ocp.solvers import GaussNewton, Solution, Status
from yid_ocp.solvers import base as solvers
from yid_ocp.solvers.base import EpisodeAndPrediction, EstimateChecks, IterationCallback, Solver

_UNCOUNTED_ERROR_TEXTS = {"links": "of the object's links", "time_step": "of the time step"}


def solve(
    problem: EstimationProblem,
    solver: Solver | None = None,
    initial_unknowns: Sequence[float] | None = None,
    callback: IterationCallback | None = None,
    progress: Progress = NULL_PROGRESS,
) -> Solution:
    """Solve an estimation problem and return the estimates, uncertainty and verdicts that the command `solve` reports.

    The best fit of several starts (`solvers.solve`), a cable without memory where the recordings do not support it,
    profile-likelihood intervals of what is weakly determined, and the error of the discretisations that
    `problem.options.checked_discretisations` names, which the standard deviations include. Verdicts are `not_trusted`
    where the step is unstable, clocks drift, or a prediction without a model is nearer.

    Parameters
    ----------
    solver : Solver, optional
        `GaussNewton()` when absent, whatever the problem's configuration file names.
    initial_unknowns : sequence of float, optional
        The problem's when absent.
    callback : callable, optional
        Receives every `Iterate`.

    Returns
    -------
    Solution
        With its `checks`. Non-convergence raises nothing: see its status and message.
    """
    solver, limits = solver or GaussNewton(), problem.options.excess_residual_criteria
    steps = sum(episode.grid.steps for episode in problem.episodes)
    small = min(max(steps / 500 * (problem.system.n_coordinates / 50) ** 1.7, 0.1), 1.0)
    text = f"solving for {len(problem.initial_unknowns)} unknowns by {solver.name}"
    progress.begin_stage(text, 5 * small, 9.5 * small + 1.5)
    found = solvers.solve(problem, solver, initial_unknowns, callback, limits)
    safe = choose_cable_memory_fit(problem, solver, found, limits)
    solution = checked_solution(safe.problem, safe.solution, progress)
    checks = replace(solution.checks or EstimateChecks(), cable_memory_message=safe.message)
    return replace(solution, checks=checks)


def checked_solution(problem: EstimationProblem, solution: Solution, progress: Progress = NULL_PROGRESS) -> Solution:
    """The solution of a fit with profile intervals, the discretisation's error, and its `checks`; see `solve`."""
    solution, stability = _checked_solution_and_step_stability(problem, solution)
    problem = solution.problem or problem
    solution = solution_with_profile_intervals(problem, solution, progress)
    data_std = solution.std
    solution, checks = _with_discretisation_errors(problem, solution, progress)
    progress.begin_stage("predicting the held-out recordings", 1.2, 1.5)
    held_out, expected = predict_held_out_with_expected_errors(problem, solution.x)
    solution, issues = _checked_solution_and_issues(problem, solution, held_out)
    checks = replace(
        checks,
        data_std=data_std,
        held_out_predictions=tuple(held_out),
        expected_prediction_errors=expected,
        data_issues=issues,
        step_stability=stability,
    )
    return replace(solution, checks=checks, problem=problem)


def _with_discretisation_errors(
    problem: EstimationProblem, solution: Solution, progress: Progress
) -> tuple[Solution, EstimateChecks]:
    """The solution with standard deviations that include the discretisation, and its shifts with notes."""
    if solution.evaluation is None:
        return solution, EstimateChecks()
    kinds = problem.options.checked_discretisations
    shifts, notes = discretisation.measure_discretisation_shifts(
        problem, solution.x, solution.evaluation, kinds, progress
    )
    sizes = typical_parameter_magnitudes(problem, solution.x)
    inflated = discretisation.inflate_estimates_by_discretisation(solution.parameters, shifts, sizes)
    checked = {kind for own in shifts.values() for kind in kinds if getattr(own, kind) is not None}
    uncounted = tuple(words for kind, words in _UNCOUNTED_ERROR_TEXTS.items() if kind not in checked)
    if not problem.system.segment_layouts or ("links" not in kinds and problem.options.divided_links_model):
        uncounted = tuple(words for words in uncounted if words != _UNCOUNTED_ERROR_TEXTS["links"])
    checks = EstimateChecks(discretisation_shifts=shifts, notes=tuple(notes), uncounted_errors=uncounted)
    return replace(solution, parameters=inflated), checks


def _checked_solution_and_issues(
    problem: EstimationProblem, solution: Solution, held_out: Sequence[EpisodeAndPrediction]
) -> tuple[Solution, tuple[Issue, ...]]:
    """The solution, its verdicts set to untrusted where the fit is poor, and all issues of data and fit."""
    if solution.evaluation is None:
        return solution, problem.options.data_issues
    errors, units, _ = prediction_errors_and_units(problem, solution, held_out)
    found = drift_and_overstated_noise_issues(problem, solution.x, solution.evaluation)
    found += worse_than_baseline_issues(errors, units)
    if any(doubt.weight != "warning" for doubt in found):
        believed = replace(solution.goodness_of_fit, believed=False)
        marked = free_estimates_marked_not_trusted(solution.parameters)
        solution = replace(solution, goodness_of_fit=believed, parameters=marked)
    return solution, (*problem.options.data_issues, *found)


def _checked_solution_and_step_stability(
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
