"""Choice between a cable's fits with and without memory, by recordings left out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from yid_ocp.inference.linearized_residual import solve_step_within_unknown_sizes
from yid_ocp.inference.null_test import DEFAULT_EXCESS_RESIDUAL_CRITERIA
from yid_ocp.model.objects.cable import MEMORY_HALVING_SPEED_PARAMETER_NAME, START_SPEED_PARAMETER_NAME
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.options import ExcessResidualCriteria
from yid_ocp.solvers import Solution, solve
from yid_ocp.solvers.base import Solver

_MEMORY_SUFFIX = ".memory"
_MAX_REST_SPEED = 0.01  # a recording whose points move more slowly at its start starts at rest [m/s]
_MIN_MOVING_RECORDINGS = 2  # that start in motion, of which one is left out at a time: fewer cannot agree


@dataclass(frozen=True)
class ChosenCableMemoryFit:
    """Problem and solution with or without cable memory, and the reason as a message, empty if nothing was decided."""

    problem: EstimationProblem
    solution: Solution
    message: str = ""


def choose_cable_memory_fit(
    problem: EstimationProblem,
    solver: Solver,
    solution: Solution,
    limits: ExcessResidualCriteria = DEFAULT_EXCESS_RESIDUAL_CRITERIA,
) -> ChosenCableMemoryFit:
    """Return the fit, refitted without cable memory if recordings that start in motion do not support the memory.

    Where a cable moves when its recording begins, the load that it bears there is not known, and what it seems to
    remember may be that motion. Each recording that starts so is predicted from the others alone (one Gauss-Newton
    step away from the fit of all), with memory and with none; it is kept where that is the smaller error in sum.
    """
    memory, moving = _memory_parameters(problem), _moving(problem)
    if not memory or not moving or solution.evaluation is None:
        return ChosenCableMemoryFit(problem, solution)
    without = problem_without_cable_memory(problem)
    known = dict(zip(solution.unknown_names, solution.x, strict=True))
    other = solve(without, solver, without.vector(known).tolist(), limits=limits)
    if other.evaluation is None:
        return ChosenCableMemoryFit(problem, solution)
    if len(moving) < _MIN_MOVING_RECORDINGS:
        words = "memory is not kept: too few recordings start in motion to bear it out"
        return ChosenCableMemoryFit(without, other, words)
    kept, dropped = (_left_out(p, s, moving) for p, s in ((problem, solution), (without, other)))
    told = "recordings that start in motion, each predicted from the others, have the root mean square error"
    errors = f"{told} {kept:.3g} with it and {dropped:.3g} without, in standard deviations"
    if kept < dropped:
        return ChosenCableMemoryFit(problem, solution, f"memory is kept: {errors}")
    return ChosenCableMemoryFit(without, other, f"memory is not kept: {errors}")


def problem_without_cable_memory(problem: EstimationProblem) -> EstimationProblem:
    """The problem with the cable's memory parameters fixed at zero."""
    memory = _memory_parameters(problem)
    free = tuple(name for name in problem.free if name not in (*memory, MEMORY_HALVING_SPEED_PARAMETER_NAME))
    return problem.with_free_parameters_without_recompiling(free).with_parameter_values(dict.fromkeys(memory, 0.0))


def _memory_parameters(problem: EstimationProblem) -> list[str]:
    return [name for name in problem.shared_parameters if name.endswith(_MEMORY_SUFFIX)]


def _moving(problem: EstimationProblem) -> list[int]:
    """Recordings that start in motion."""
    starts = [episode.fixed_initial_state for episode in problem.episodes]
    speeds = [0.0 if s is None else s.fitted_parameters.get(START_SPEED_PARAMETER_NAME, 0.0) for s in starts]
    return [i for i, speed in enumerate(speeds) if speed > _MAX_REST_SPEED]


def _left_out(problem: EstimationProblem, solution: Solution, moving: list[int]) -> float:
    """Root mean square of the whitened residuals of recordings, each predicted by parameters from the others."""
    guesses = None if solution.evaluation is None else solution.evaluation.equilibrium_guesses
    evaluation = problem.evaluate(solution.x, equilibrium_guesses=guesses)
    assert evaluation.jacobian is not None
    total, count = 0.0, 0
    for i in moving:
        own = np.concatenate([np.arange(rows.start, rows.stop) for rows in problem.residual_rows.measurements[i]])
        kept = np.setdiff1d(np.arange(len(evaluation.residual)), own)
        step = solve_step_within_unknown_sizes(
            problem, solution.x, evaluation.jacobian[kept], evaluation.residual[kept], 1e-10
        )
        x = np.clip(solution.x + step, *problem.bounds)
        parts = problem.theta_and_initial_state_deviation(x, i)
        found = problem.predictor.predict_episode(problem.episodes[i], *parts, False)
        if isinstance(found, str):
            return np.inf
        for samples, predicted in zip(problem.episodes[i].measurements, found.predicted_outputs, strict=True):
            total += float(np.sum(samples.whitened_residual(predicted) ** 2))
            count += samples.n_residuals
    return float(np.sqrt(total / max(count, 1)))
