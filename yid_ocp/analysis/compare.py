"""Comparison of several estimation methods on one problem, and published estimates to compare them with."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from yid_ocp.analysis import estimation
from yid_ocp.analysis.profile import solution_with_profile_intervals
from yid_ocp.inference import uncertainty
from yid_ocp.inference.uncertainty import ParameterEstimate
from yid_ocp.inference.whitening import problem_with_exact_inputs
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.episodes import EpisodeAndPredictionOrFailure
from yid_ocp.solvers import GaussNewton, Iterate, Solution, Status, fit_problem
from yid_ocp.solvers.base import Solver, StopSearch, uses_process_noise_covariance

# Two estimates agree if they differ by less than this many of the larger std, or this fraction (stopping rules).
_AGREEMENT_STDS, _AGREEMENT_RTOL = 2.0, 0.005
_SOLVE_LABEL = "solve"  # the run that gives the verdicts, by all noise


@dataclass(frozen=True)
class _MethodResult:
    """Result of one method: solution, cost and fit with the problem's whitened residual, and times."""

    method: str
    solution: Solution
    whitened_cost: float
    held_out_predictions: list[EpisodeAndPredictionOrFailure]
    wall_seconds: float

    @property
    def has_values(self) -> bool:
        """False if the method was stopped at its start, which is no result."""
        return self.solution.status != Status.STOPPED or len(self.solution.history) != 1


@dataclass(frozen=True)
class MethodsComparisonResult:
    """The results of all estimation methods on one problem, and the parameters on which the methods disagree."""

    method_results: tuple[_MethodResult, ...]
    reference_method: str  # method of lowest cost, with which the other methods are compared
    has_process_noise: bool  # whether the problem has process noise, which all compared methods ignore
    # result of `solve`: the checked reference or, with process noise, that of a method that models it
    verdict_solution: Solution
    disagreements: Mapping[str, list[str]]  # identifiable parameters that differ, with the reason, as one sentence

    @property
    def is_consistent(self) -> bool:
        """True if the estimates of all methods agree on every identifiable parameter."""
        return not any(self.disagreements.values())


def compare_methods(
    problem: EstimationProblem,
    solvers: Sequence[Solver],
    callback: Callable[[str, Iterate], None] | None = None,
    total_time_budget: float = math.inf,
) -> MethodsComparisonResult:
    """Run several estimation methods (`solvers`) from the same initial values and compare their estimates.

    Steepest descent minimises the published cost (points in metres, no noise levels, no weak prior). The other methods
    minimise the problem's cost without process noise, because not every method supports it. If the problem has process
    noise, these estimates are marked `not_trusted`, and the verdicts come from an additional run that includes it.
    `callback` receives the method's name and every `Iterate`. Each method gets an equal part of the remaining
    `total_time_budget` [s].
    """
    runs, whole, problem = [], problem, problem_with_exact_inputs(problem)
    limits, deadline = problem.options.excess_residual_criteria, time.perf_counter() + total_time_budget

    def listener(name: str, share: float = math.inf) -> Callable[[Iterate], None]:
        begun = time.perf_counter()

        def told(entry: Iterate) -> None:
            if callback is not None:
                callback(name, entry)
            if time.perf_counter() - begun > share:
                raise StopSearch(f"stopped at its part of compare.total_time_budget, {share:.3g} s (raise it)")

        return told

    for i, solver in enumerate(solvers):
        own = problem
        if solver.name == "steepest_descent" and problem.options.weighting != "paper":
            own = problem.with_options(replace(problem.options, weighting="paper"))
        wall = time.perf_counter()
        told = listener(solver.name, max(deadline - time.perf_counter(), 0.0) / (len(solvers) - i))
        solution = fit_problem(own, solver, callback=told, limits=limits, restarts=not whole.has_process_noise)
        if whole.has_process_noise:
            solution = replace(solution, parameters=uncertainty.mark_free_estimates_not_trusted(solution.parameters))
        taken = time.perf_counter() - wall
        evaluation = problem.evaluate(solution.x, derivatives=own is not problem)
        if own is not problem:  # chi2 of all methods must count the same residual
            fit = uncertainty.assess_goodness_of_fit(problem, evaluation, limits, solution.x)
            solution = replace(solution, goodness_of_fit=fit)
        runs.append(_MethodResult(solver.name, solution, evaluation.cost, own.predict_held_out(solution.x), taken))
    best = min(runs, key=lambda run: run.whitened_cost)
    if best.method != "steepest_descent":
        runs[runs.index(best)] = best = replace(best, solution=solution_with_profile_intervals(problem, best.solution))
    if whole.has_process_noise:
        able: Solver = next((solver for solver in solvers if uses_process_noise_covariance(solver)), GaussNewton())
        judged = estimation.solve(whole, able, callback=listener(_SOLVE_LABEL))
    else:
        judged = estimation.add_intervals_and_checks(problem, best.solution)
    agreement = {run.method: _differences(run, best, judged.parameters) for run in runs}
    return MethodsComparisonResult(tuple(runs), best.method, whole.has_process_noise, judged, agreement)


def _differences(run: _MethodResult, best: _MethodResult, judged: Mapping[str, ParameterEstimate]) -> list[str]:
    if not run.has_values:
        return ["was stopped before its first iteration and has no values. Raise compare.total_time_budget"]
    values = []
    for name in (name for name, entry in judged.items() if entry.verdict == "identifiable"):
        entry, reference = run.solution.parameters[name], best.solution.parameters[name]
        # a fit that stopped early has a large ± from its misfit, which would agree with everything
        std = max(entry.std, reference.std) if run.solution.status == Status.CONVERGED else reference.std
        if abs(entry.value - reference.value) > max(_AGREEMENT_STDS * std, _AGREEMENT_RTOL * abs(reference.value)):
            values.append(f"{name} = {entry.value:.4g} {entry.unit} (not {reference.value:.4g})")
    if run.solution.status != Status.CONVERGED:
        why = "it stopped before it reached the minimum"
    elif run.whitened_cost > best.whitened_cost + 2.0:
        why = "it stopped in another local minimum, whose cost is higher"
    else:
        why = "its cost weights the measurements differently"
    return [f"gives other values than {best.method}, because {why}: {', '.join(values)}"] if values else []


_PAPER_PARAMETERS = ("T1.bend", "T1.twist", "T2.bend", "T2.twist", "T3.bend", "T3.twist")
PAPER_ESTIMATES: dict[str, dict[str, float]] = {
    "single_arm_no_vision": dict(zip(_PAPER_PARAMETERS, (23.780, 0.000, 18.357, 11.103, 3.200, 3.059), strict=True)),
    "single_arm_vision": dict(zip(_PAPER_PARAMETERS, (22.270, 13.593, 10.735, 8.202, 11.511, 9.692), strict=True)),
    "dual_arm_no_vision": dict(zip(_PAPER_PARAMETERS, (19.559, 4.965, 8.575, 10.374, 0.000, 11.287), strict=True)),
    "dual_arm_vision": dict(zip(_PAPER_PARAMETERS, (24.840, 0.000, 12.373, 30.775, 1.406, 24.900), strict=True)),
}
"""Published stiffness estimates [N m/rad] of Caldwell et al. (2014), by experiment. Their data are not public."""
