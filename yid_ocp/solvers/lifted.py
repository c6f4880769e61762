"""Gauss-Newton on the lifted problem: node states as unknowns, condensed onto the parameters in every iteration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from annotated_types import Ge, Gt
from numpy.typing import NDArray

from yid_ocp.integrator.step import Directions
from yid_ocp.options import About, check
from yid_ocp.problem.outcome import Start
from yid_ocp.problem.problem import EstimationProblem
from yid_ocp.solvers.base import SOLVERS, Callback, Outcome, Recorder, Status, projected_gradient
from yid_ocp.solvers.linear_model import bounded_step
from yid_ocp.solvers.transcription import Transcription

Array = NDArray[np.float64]

# Largest factor by which one iteration changes an unknown that is positive by nature.
REACH = 3.0
# Fraction of a point's cost or defects that a better point may at most have; shortest fraction of a step that is tried.
MARGIN = 1.0 - 1e-5
SHORTEST = 1e-3
# Damping up to which a step tells how far the cost can still be lowered.
TRUSTED = 0.1


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
        if any(trial.defect >= MARGIN * defect and trial.cost >= MARGIN * cost for defect, cost in self._points):
            return False
        # with defects as good as closed the cost has to fall as it should
        if slope < 0 and (-slope / max(now.cost, 1e-300)) ** 2.3 > now.defect**1.1:
            return trial.cost <= now.cost + 1e-4 * slope
        if trial.defect <= MARGIN * now.defect or trial.cost <= MARGIN * now.cost:
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

    node_interval: Annotated[int, Ge(1), About("steps between nodes")] = 20
    iterations: Annotated[int, Ge(1), About("limit on accepted steps")] = 80
    step_tolerance: Annotated[
        float, Gt(0), About("converged when no unknown moves by more than this fraction of its size")
    ] = 1e-5
    cost_tolerance: Annotated[
        float, Gt(0), About("converged when the promised relative reduction of the cost is below this")
    ] = 1e-5
    defect_tolerance: Annotated[float, Gt(0), About("largest defect that counts as closed", "rad, m or N m s")] = 1e-7
    name: ClassVar[str] = "lifted"
    needs_rollout: ClassVar[bool] = False

    def __post_init__(self) -> None:
        check(self, f"solver {self.name}")

    def run(self, problem: EstimationProblem, start: Array, callback: Callback | None) -> Outcome:
        """Minimize the problem's cost from `start` by condensed Gauss-Newton steps on node states."""
        # the inner steps are eliminated, so there are no multipliers among the unknowns, whatever the interval
        transcription = Transcription(problem, self.node_interval, multipliers=False)
        recorder = Recorder(callback)
        guess = transcription.guess(start[: len(problem.shared)])
        nodes = [guess[layout.state] for layout in transcription.layouts]
        x = start.copy()
        x[: len(problem.shared)] = guess[: len(problem.shared)]
        lower, upper = problem.bounds
        now = self._linearise(transcription, x, nodes)
        recorder.evaluations += 1
        if isinstance(now, str):
            return Outcome(Status.FAILED, now, x, (), recorder.evaluations)
        mu, filtered = 1e-4, _Filter(now)
        for _ in range(self.iterations):
            size = np.maximum(np.abs(x), problem.scales)
            closed = now.residual + now.by_defect
            recorder.accept(now.cost, x, projected_gradient(x, now.jacobian.T @ now.residual, lower, upper, size))
            # far from the solution the linear model is good for a factor, not for a jump to a bound
            low = np.where(problem.positive, np.maximum(lower, x / REACH), lower)
            high = np.where(problem.positive, np.minimum(upper, np.maximum(x, 1e-3 * problem.scales) * REACH), upper)
            step = bounded_step(now.jacobian * size, closed, mu, (low - x) / size, (high - x) / size) * size
            after = closed + now.jacobian @ step
            promised = 0.5 * float(closed @ closed - after @ after)
            moved = float(np.max(np.abs(step) / size, initial=0.0))
            if moved < self.step_tolerance or (mu < TRUSTED and promised <= self.cost_tolerance * now.cost):
                if now.defect < self.defect_tolerance:
                    return self._end(Status.CONVERGED, f"closed to {now.defect:.1e}", x, recorder, transcription)
                # a change along what the data do not inform would only open the defects again
                step = np.zeros_like(step)
            slope = float(now.residual @ (now.by_defect + now.jacobian @ step))
            factor = 1.0
            while True:
                trial_x = np.clip(x + factor * step, lower, upper)
                trial = self._linearise(transcription, trial_x, self._moved(transcription, nodes, now, step, factor))
                recorder.evaluations += 1
                if not isinstance(trial, str) and filtered.accepts(now, trial, factor * slope):
                    break
                factor *= 0.5
                if factor < SHORTEST:
                    break
            if factor < SHORTEST:
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
        message = f"no convergence in {self.iterations} iterations; largest defect {now.defect:.1e}"
        return self._end(Status.ITERATION_LIMIT, message, x, recorder, transcription)

    def _end(self, status: Status, message: str, x: Array, recorder: Recorder, transcription: Transcription) -> Outcome:
        return Outcome(status, message, x, tuple(recorder.history), recorder.evaluations, transcription.warm)

    def _moved(
        self, transcription: Transcription, nodes: list[Array], now: _Linearised, step: Array, factor: float
    ) -> list[Array]:
        moved = []
        for i, (state, (by_x, by_defect, _)) in enumerate(zip(nodes, now.states, strict=True)):
            local = transcription.problem.unknowns.columns(i)
            moved.append(state + factor * (by_x @ step[local] + by_defect))
        return moved

    def _linearise(self, transcription: Transcription, x: Array, nodes: list[Array]) -> _Linearised | str:
        problem = transcription.problem
        cost, defect, residuals, jacobians, changes, states = 0.0, 0.0, [], [], [], []
        for i, episode in enumerate(problem.episodes):
            theta, offset = problem.split(x, i)
            theta = problem.predictor.own_theta(episode, theta)
            start = problem.start_state(episode, theta, offset, transcription.warm[i])
            if start.message:
                return start.message
            condensed = self._condensed(transcription, i, theta, start, nodes[i])
            if isinstance(condensed, str):
                return condensed
            trajectory, slopes, by_x, by_defect, gaps = condensed
            defect = max(defect, float(np.max(np.abs(gaps), initial=0.0)))
            states.append((by_x, by_defect, gaps))
            for samples in episode.samples:
                predicted, sensitivity = problem.predictor.along(samples, trajectory, slopes, theta)
                part = samples.rows(predicted, sensitivity, problem.options.huber_threshold)
                assert part.jacobian is not None
                cost += part.cost
                residuals.append(part.residual)
                jacobians.append(problem.unknowns.placed(part.jacobian[:, :-1], i))
                changes.append(part.jacobian[:, -1])
        prior, by_x_prior = problem.prior(x)
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
        self, transcription: Transcription, i: int, theta: Array, start: Start, nodes: Array
    ) -> tuple[Array, Array, Array, Array, Array] | str:
        """Trajectory through the nodes with derivatives by (free parameters and start, closing of the defects)."""
        problem, layout = transcription.problem, transcription.layouts[i]
        by_start = start.by_unknowns
        nx, width = transcription.nx, by_start.shape[1]
        steps = problem.episodes[i].grid.steps
        trajectory, slopes = np.zeros((steps + 1, nx)), np.zeros((steps + 1, nx, width + 1))
        by_x, by_defect = np.zeros((len(nodes), nx, width)), np.zeros((len(nodes), nx))
        gaps = np.zeros((len(nodes), nx))
        gaps[0] = start.state - nodes[0]
        by_x[0], by_defect[0] = by_start, gaps[0]
        for j in range(len(nodes) - 1):
            first, last = int(layout.nodes[j]), int(layout.nodes[j + 1])
            column = np.concatenate([by_x[j], by_defect[j][:, None]], axis=1)
            wanted = problem.unknowns.parameters
            rollout = transcription.interval_sweep(i, j, nodes[j], theta, Directions(wanted, column))
            if not rollout.status.ok or rollout.by_state is None:
                return f"{problem.episodes[i].name}: interval {j}: {rollout.status.message}"
            trajectory[first:last], slopes[first:last] = rollout.state[:-1], rollout.by_state[:-1]
            gaps[j + 1] = rollout.state[-1] - nodes[j + 1]
            by_x[j + 1] = rollout.by_state[-1][:, :width]
            by_defect[j + 1] = rollout.by_state[-1][:, width] + gaps[j + 1]
            trajectory[last] = nodes[j + 1]
            slopes[last, :, :width], slopes[last, :, width] = by_x[j + 1], by_defect[j + 1]
        return trajectory, slopes, by_x, by_defect, gaps
