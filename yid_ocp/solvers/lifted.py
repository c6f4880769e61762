"""Gauss-Newton on the lifted problem: node states as unknowns, condensed onto the parameters in every iteration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from annotated_types import Ge, Gt
from numpy.typing import NDArray

from yid_ocp.inference.linearized_residual import bounded_least_squares_step
from yid_ocp.integrator.step import SensitivityDirections
from yid_ocp.options import OptionInfo, check_option_bounds
from yid_ocp.problem.episodes import InitialState
from yid_ocp.problem.estimation_problem import EstimationProblem
from yid_ocp.solvers.base import (
    SOLVERS,
    IterationCallback,
    IterationRecorder,
    SolverResult,
    Status,
    projected_gradient_norm,
)
from yid_ocp.solvers.compiled_transcription import CompiledTranscription

Array = NDArray[np.float64]

# Largest factor by which one iteration changes an unknown that is positive by nature.
_MAX_CHANGE_FACTOR = 3.0
# Fraction of a point's cost or defects that a better point may at most have; shortest fraction of a step that is tried.
_IMPROVEMENT_MARGIN = 1.0 - 1e-5
_MIN_STEP_FRACTION = 1e-3
# Damping up to which a step tells how far the cost can still be lowered.
_MAX_TRUSTED_DAMPING = 0.1


@dataclass(frozen=True)
class _Linearised:
    """Whitened residual, its derivative by the unknowns and its change by closing the defects; sizes of the defects."""

    cost: float
    defect: float
    residual: Array
    jacobian: Array
    by_defect: Array
    states: tuple[tuple[Array, Array, Array], ...]


class _Filter:
    """Which trial points are acceptable: those better than every point so far in cost or in defects.

    A merit function has to weigh the two against each other; a weight that was needed far from the solution makes steps
    short near it.

    References
    ----------
    Waechter and Biegler (2005), SIAM J. Optim. 16(1):1, doi:10.1137/S1052623403426556.
    """

    def __init__(self, start: _Linearised) -> None:
        self._largest = 1e4 * max(start.defect, 1.0)
        self._points: list[tuple[float, float]] = []

    def accepts(self, now: _Linearised, trial: _Linearised, slope: float) -> bool:
        """Whether to go on from `trial`, for which the linear model says that the cost changes by `slope`."""
        if not trial.defect <= self._largest or not np.isfinite(trial.cost):
            return False
        if any(
            trial.defect >= _IMPROVEMENT_MARGIN * defect and trial.cost >= _IMPROVEMENT_MARGIN * cost
            for defect, cost in self._points
        ):
            return False
        # with defects as good as closed the cost has to fall as it should
        if slope < 0 and (-slope / max(now.cost, 1e-300)) ** 2.3 > now.defect**1.1:
            return trial.cost <= now.cost + 1e-4 * slope
        if trial.defect <= _IMPROVEMENT_MARGIN * now.defect or trial.cost <= _IMPROVEMENT_MARGIN * now.cost:
            self._points.append((now.defect, now.cost))
            return True
        return False


@SOLVERS.register("lifted")
@dataclass(frozen=True)
class Lifted:
    """Lifted Gauss-Newton: iterates on node states s_j and parameters x with defects d_j = F^n(s_j, x) - s_{j+1}.

    A linear step closes every defect; the recursion  S_{j+1} = A_j S_j + B_j,  c_{j+1} = A_j c_j + d_j  expresses all
    node steps by the parameters' step (condensing), so that an iteration costs one sweep with one direction more
    than single shooting's. A filter decides whether a step is good: it must improve the cost or the defects.

    References
    ----------
    Albersmeyer and Diehl (2010), SIAM J. Optim. 20(3):1655, doi:10.1137/080724885.
    """

    node_interval: Annotated[int, Ge(1), OptionInfo("steps between nodes")] = 20
    max_iterations: Annotated[int, Ge(1), OptionInfo("limit on accepted steps")] = 80
    step_tolerance: Annotated[
        float, Gt(0), OptionInfo("converged when no unknown moves by more than this fraction of its size")
    ] = 1e-5
    cost_tolerance: Annotated[
        float, Gt(0), OptionInfo("converged when the promised relative reduction of the cost is below this")
    ] = 1e-5
    defect_tolerance: Annotated[float, Gt(0), OptionInfo("largest defect that counts as closed", "rad, m or N m s")] = (
        1e-7
    )
    name: ClassVar[str] = "lifted"
    needs_rollout: ClassVar[bool] = False

    def __post_init__(self) -> None:
        check_option_bounds(self, f"solver {self.name}")

    def minimize_cost(
        self, problem: EstimationProblem, start: Array, callback: IterationCallback | None
    ) -> SolverResult:
        """Minimize the problem's cost from `start` by condensed Gauss-Newton steps on node states."""
        # the inner steps are eliminated, so there are no multipliers among the unknowns, whatever the interval
        transcription = CompiledTranscription(problem, self.node_interval, multipliers=False)
        recorder = IterationRecorder(callback)
        guess = transcription.initial_guess(start[: len(problem.shared_parameters)])
        nodes = [guess[layout.state_indices] for layout in transcription.layouts]
        x = start.copy()
        x[: len(problem.shared_parameters)] = guess[: len(problem.shared_parameters)]
        lower, upper = problem.bounds
        now = self._linearise(transcription, x, nodes)
        recorder.n_evaluations += 1
        if isinstance(now, str):
            return SolverResult(Status.FAILED, now, x, (), recorder.n_evaluations)
        mu, filtered = 1e-4, _Filter(now)
        for _ in range(self.max_iterations):
            size = np.maximum(np.abs(x), problem.unknown_scales)
            closed = now.residual + now.by_defect
            recorder.record_iterate(
                now.cost, x, projected_gradient_norm(x, now.jacobian.T @ now.residual, lower, upper, size)
            )
            # far from the solution the linear model is good for a factor, not for a jump to a bound
            low = np.where(problem.is_positive, np.maximum(lower, x / _MAX_CHANGE_FACTOR), lower)
            high = np.where(
                problem.is_positive,
                np.minimum(upper, np.maximum(x, 1e-3 * problem.unknown_scales) * _MAX_CHANGE_FACTOR),
                upper,
            )
            step = (
                bounded_least_squares_step(now.jacobian * size, closed, mu, (low - x) / size, (high - x) / size) * size
            )
            after = closed + now.jacobian @ step
            promised = 0.5 * float(closed @ closed - after @ after)
            moved = float(np.max(np.abs(step) / size, initial=0.0))
            if moved < self.step_tolerance or (
                mu < _MAX_TRUSTED_DAMPING and promised <= self.cost_tolerance * now.cost
            ):
                if now.defect < self.defect_tolerance:
                    return self._end(Status.CONVERGED, f"closed to {now.defect:.1e}", x, recorder, transcription)
                # a change along what the data do not inform would only open the defects again
                step = np.zeros_like(step)
            slope = float(now.residual @ (now.by_defect + now.jacobian @ step))
            factor = 1.0
            while True:
                trial_x = np.clip(x + factor * step, lower, upper)
                trial = self._linearise(transcription, trial_x, self._moved(transcription, nodes, now, step, factor))
                recorder.n_evaluations += 1
                if not isinstance(trial, str) and filtered.accepts(now, trial, factor * slope):
                    break
                factor *= 0.5
                if factor < _MIN_STEP_FRACTION:
                    break
            if factor < _MIN_STEP_FRACTION:
                if mu > 1e2:
                    message = trial if isinstance(trial, str) else "no step lowers the cost or closes the defects"
                    return self._end(
                        Status.STALLED, f"{message}; try more nodes, or gauss_newton", x, recorder, transcription
                    )
                mu = max(mu * 30.0, 1e-4)
                continue
            mu = mu * 0.2 if factor == 1.0 else mu * 5.0
            assert not isinstance(trial, str)
            nodes = self._moved(transcription, nodes, now, step, factor)
            x, now = trial_x, trial
        message = f"no convergence in {self.max_iterations} iterations; largest defect {now.defect:.1e}"
        return self._end(Status.ITERATION_LIMIT, message, x, recorder, transcription)

    def _end(
        self, status: Status, message: str, x: Array, recorder: IterationRecorder, transcription: CompiledTranscription
    ) -> SolverResult:
        return SolverResult(
            status, message, x, tuple(recorder.history), recorder.n_evaluations, transcription.equilibrium_guesses
        )

    def _moved(
        self, transcription: CompiledTranscription, nodes: list[Array], now: _Linearised, step: Array, factor: float
    ) -> list[Array]:
        moved = []
        for i, (state, (by_x, by_defect, _)) in enumerate(zip(nodes, now.states, strict=True)):
            local = transcription.problem.unknowns.recording_columns(i)
            moved.append(state + factor * (by_x @ step[local] + by_defect))
        return moved

    def _linearise(self, transcription: CompiledTranscription, x: Array, nodes: list[Array]) -> _Linearised | str:
        problem = transcription.problem
        cost, defect, residuals, jacobians, changes, states = 0.0, 0.0, [], [], [], []
        for i, episode in enumerate(problem.episodes):
            theta, offset = problem.split(x, i)
            theta = problem.predictor.episode_theta(episode, theta)
            start = problem.initial_state(episode, theta, offset, transcription.equilibrium_guesses[i])
            if start.failure_message:
                return start.failure_message
            condensed = self._condensed(transcription, i, theta, start, nodes[i])
            if isinstance(condensed, str):
                return condensed
            trajectory, slopes, by_x, by_defect, gaps = condensed
            defect = max(defect, float(np.max(np.abs(gaps), initial=0.0)))
            states.append((by_x, by_defect, gaps))
            for samples in episode.measurements:
                predicted, sensitivity = problem.predictor.readings_along_trajectory(samples, trajectory, slopes, theta)
                part = samples.residual_block(predicted, sensitivity, problem.options.huber_threshold)
                assert part.jacobian is not None
                cost += part.cost
                residuals.append(part.residual)
                jacobians.append(problem.unknowns.scatter_columns(part.jacobian[:, :-1], i))
                changes.append(part.jacobian[:, -1])
        prior, by_x_prior = problem.prior_residual(x)
        cost += 0.5 * float(prior @ prior)
        return _Linearised(
            cost,
            defect,
            np.concatenate([*residuals, prior]),
            np.vstack([*jacobians, by_x_prior]),
            np.concatenate([*changes, np.zeros(len(prior))]),
            tuple(states),
        )

    def _condensed(
        self, transcription: CompiledTranscription, i: int, theta: Array, start: InitialState, nodes: Array
    ) -> tuple[Array, Array, Array, Array, Array] | str:
        """Trajectory through the nodes with derivatives by (free parameters and start, closing of the defects)."""
        problem, layout = transcription.problem, transcription.layouts[i]
        by_start = start.state_sensitivity
        nx, width = transcription.nx, by_start.shape[1]
        steps = problem.episodes[i].grid.steps
        trajectory, slopes = np.zeros((steps + 1, nx)), np.zeros((steps + 1, nx, width + 1))
        by_x, by_defect = np.zeros((len(nodes), nx, width)), np.zeros((len(nodes), nx))
        gaps = np.zeros((len(nodes), nx))
        gaps[0] = start.state - nodes[0]
        by_x[0], by_defect[0] = by_start, gaps[0]
        for j in range(len(nodes) - 1):
            first, last = int(layout.node_steps[j]), int(layout.node_steps[j + 1])
            column = np.concatenate([by_x[j], by_defect[j][:, None]], axis=1)
            wanted = problem.unknowns.free_parameters
            rollout = transcription.rollout_interval(i, j, nodes[j], theta, SensitivityDirections(wanted, column))
            if not rollout.status.is_converged or rollout.state_sensitivity is None:
                return f"{problem.episodes[i].name}: interval {j}: {rollout.status.message}"
            trajectory[first:last], slopes[first:last] = rollout.state[:-1], rollout.state_sensitivity[:-1]
            gaps[j + 1] = rollout.state[-1] - nodes[j + 1]
            by_x[j + 1] = rollout.state_sensitivity[-1][:, :width]
            by_defect[j + 1] = rollout.state_sensitivity[-1][:, width] + gaps[j + 1]
            trajectory[last] = nodes[j + 1]
            slopes[last, :, :width], slopes[last, :, width] = by_x[j + 1], by_defect[j + 1]
        return trajectory, slopes, by_x, by_defect, gaps
