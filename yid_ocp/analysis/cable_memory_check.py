"""Leave-one-out check of a cable's memory parameter on recordings that start in motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from yid_ocp.inference.linearized_residual import bounded_least_squares_step
from yid_ocp.inference.null_test import DEFAULT_GAP_CRITERIA, GapCriteria
from yid_ocp.model.objects.cable import START_SPEED_PARAMETER, START_SPEED_SCALE_PARAMETER
from yid_ocp.problem import EstimationProblem
from yid_ocp.solvers import Solution, solve
from yid_ocp.solvers.base import Solver

Array = NDArray[np.float64]

_MEMORY_SUFFIX = ".memory"
# A recording whose points move more slowly at its start starts at rest [m/s].
_MAX_REST_SPEED = 0.01
# Recordings that start in motion, of which one is left out at a time: fewer than that cannot agree.
_MIN_MOVING_RECORDINGS = 2


@dataclass(frozen=True)
class CableMemoryDecision:
    """Problem and solution with or without cable memory, and the reason; the message is empty without a decision."""

    problem: EstimationProblem
    solution: Solution
    message: str = ""


def decide_cable_memory(
    problem: EstimationProblem, solver: Solver, solution: Solution, limits: GapCriteria = DEFAULT_GAP_CRITERIA
) -> CableMemoryDecision:
    """The solution, refitted without cable memory where recordings that start in motion do not support it.

    Where a cable moves when its recording begins, the load that it bears there is not known, and what it seems to
    remember may be that motion. Each recording that starts so is predicted from the others alone (one Gauss-Newton
    step away from the fit of all), with memory and with none; it is kept where that is the smaller error in sum.

    Parameters
    ----------
    problem : EstimationProblem
    solver : Solver
        For the fit without memory.
    solution : Solution
        Of this problem.
    limits : GapLimits, optional
        What makes a residual more than noise.
    """
    memory = [name for name in problem.shared_parameters if name.endswith(_MEMORY_SUFFIX)]
    moving = _moving(problem)
    if not memory or not moving or solution.evaluation is None:
        return CableMemoryDecision(problem, solution)
    without = without_cable_memory(problem)
    known = dict(zip(solution.unknown_names, solution.x, strict=True))
    other = solve(without, solver, without.vector(known).tolist(), limits=limits)
    if other.evaluation is None:
        return CableMemoryDecision(problem, solution)
    if len(moving) >= _MIN_MOVING_RECORDINGS:
        kept, dropped = (_left_out(p, s, moving) for p, s in ((problem, solution), (without, other)))
        if kept < dropped:
            return CableMemoryDecision(problem, solution, f"memory is kept: {_words(kept, dropped)}")
        return CableMemoryDecision(without, other, f"memory is not kept: {_words(kept, dropped)}")
    return CableMemoryDecision(without, other, "memory is not kept: too few recordings start in motion to bear it out")


def without_cable_memory(problem: EstimationProblem) -> EstimationProblem:
    """The problem with the cable's memory parameters fixed at zero."""
    memory = [name for name in problem.shared_parameters if name.endswith(_MEMORY_SUFFIX)]
    free = tuple(name for name in problem.free if name not in (*memory, START_SPEED_SCALE_PARAMETER))
    return problem.with_free_subset(free).with_parameter_values(dict.fromkeys(memory, 0.0))


def _words(kept: float, dropped: float) -> str:
    return (
        "recordings that start in motion, each predicted from the others, have the root mean square error "
        f"{kept:.3g} with it and {dropped:.3g} without, in standard deviations"
    )


def _moving(problem: EstimationProblem) -> list[int]:
    """Recordings that start in motion."""
    return [
        i
        for i, episode in enumerate(problem.episodes)
        if episode.fixed_initial_state is not None
        and episode.fixed_initial_state.fitted_parameters.get(START_SPEED_PARAMETER, 0.0) > _MAX_REST_SPEED
    ]


def _left_out(problem: EstimationProblem, solution: Solution, moving: list[int]) -> float:
    """Root mean square of the whitened residuals of recordings, each predicted by parameters from the others."""
    evaluation = problem.evaluate(
        solution.x, equilibrium_guesses=None if solution.evaluation is None else solution.evaluation.equilibrium_guesses
    )
    assert evaluation.jacobian is not None
    total, count = 0.0, 0
    for i in moving:
        own = np.concatenate([np.arange(rows.start, rows.stop) for rows in problem.residual_rows.measurements[i]])
        kept = np.setdiff1d(np.arange(len(evaluation.residual)), own)
        x = _stepped(problem, solution.x, evaluation.residual[kept], evaluation.jacobian[kept])
        found = problem.predictor.predict_episode(problem.episodes[i], *problem.split(x, i), False)
        if isinstance(found, str):
            return np.inf
        for samples, predicted in zip(problem.episodes[i].measurements, found.predicted_outputs, strict=True):
            total += float(np.sum(samples.whitened_residual(predicted) ** 2))
            count += samples.n_residuals
    return float(np.sqrt(total / max(count, 1)))


def _stepped(problem: EstimationProblem, x: Array, residual: Array, jacobian: Array) -> Array:
    """One Gauss-Newton step within the bounds, of at most the unknowns' size."""
    lower, upper = problem.bounds
    size = np.maximum(np.abs(x), problem.unknown_scales)
    low, high = np.maximum((lower - x) / size, -1.0), np.minimum((upper - x) / size, 1.0)
    return np.asarray(
        np.clip(x + bounded_least_squares_step(jacobian * size, residual, 1e-10, low, high) * size, lower, upper)
    )
