"""Numerical stability of a time step along a motion: growth of errors that alternate from step to step."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from yid_ocp.integrator.rollout import simulate
from yid_ocp.integrator.step import Step
from yid_ocp.integrator.step_model import Rollout, TrackingFeedback
from yid_ocp.problem import EstimationProblem

Array = NDArray[np.float64]

_N_CHECKED_NODES, _MIN_CHECKED_NODES = 24, 4
"""Nodes at which the linearised step is looked at: of all motions together, and of one at least."""

_MAX_GROWTH_DECADES = 6.0
"""Powers of ten by which an alternating error may grow: from the rounding of a step (1e-12) to what no sensor sees."""


@dataclass(frozen=True)
class StepErrorGrowth:
    """Growth of errors that alternate in sign from step to step along one motion.

    What a body does by itself goes on in one direction for several steps; a mode of the linearised step whose
    eigenvalue has a negative real part turns back at every step, and is the method's own. Where its magnitude exceeds
    one, the equations no longer follow the body, however well Newton solves them.

    Attributes
    ----------
    recording_name : str
    growth_decades : float
        Powers of ten by which such an error grows over the stretch of the motion on which it grows most.
    max_step_factor : float
        Largest growth in one step.
    max_growth_time : float
        Time of this largest growth, from the start of the motion [s].
    time_step : float
        [s]
    """

    recording_name: str
    growth_decades: float
    max_step_factor: float
    max_growth_time: float
    time_step: float

    @property
    def is_stable(self) -> bool:
        """Whether rounding errors stay below sensor resolution."""
        return self.growth_decades <= _MAX_GROWTH_DECADES

    @property
    def description(self) -> str:
        """A sentence on the stability and, where unstable, on the remedy."""
        grows = (
            f"an error that alternates from step to step grows by {100 * (self.max_step_factor - 1):.2g} % in a step"
        )
        if self.is_stable:
            return f"{self.recording_name}: the step of {self.time_step:g} s is stable along the motion"
        return (
            f"{self.recording_name}: the step of {self.time_step:g} s is not stable: {grows} at {self.max_growth_time:.3g} s; "
            f"take a shorter problem.time_step ({self.time_step / 2:g} s, say)"
        )


def _error_growth_along(
    step: Step,
    theta: ArrayLike,
    rollout: Rollout,
    feedback: TrackingFeedback | None = None,
    name: str = "motion",
    looks: int = _N_CHECKED_NODES,
) -> StepErrorGrowth:
    """Growth of alternating errors along a rollout, up to its first failed step.

    Parameters
    ----------
    step : Step
        Any: nothing is assumed of how it treats forces and constraints.
    theta : array_like, shape (ntheta,)
    rollout : Rollout
        From `simulate` with the same step, theta and feedback.
    feedback : Feedback, optional
        The tracking filter, which is part of the loop.
    name : str
        Of the motion.
    looks : int
        Number of nodes at which A is worked out.

    Returns
    -------
    Growth

    Notes
    -----
    The eigenvalues of A_k - B_k K_k are taken at some nodes (A_k by the implicit function theorem, so that the
    constraints are in it), their largest alternating magnitude counts for the steps in between in its logarithm, and
    the stretch of the largest sum is what grows. A step at which Newton failed or the derivatives are singular ends the
    motion.
    """
    failed = np.flatnonzero(~np.isfinite(rollout.state).all(axis=1))
    steps = (int(failed[0]) if len(failed) else len(rollout.state)) - 1
    nodes = np.unique(np.linspace(0, max(steps - 1, 0), looks).astype(int)) if steps > 0 else np.zeros(0, int)
    at, magnitudes = [], []
    for node in nodes:
        found = _alternating_mode_magnitude(step, np.asarray(theta, float), rollout, int(node), feedback)
        if found is None:
            break
        at.append(int(node))
        magnitudes.append(found)
    if not at:
        return StepErrorGrowth(name, 0.0, 0.0, 0.0, step.time_step)
    rates = np.log10(np.maximum(np.interp(np.arange(at[-1] + 1), at, magnitudes), 1e-3))
    worst = int(np.argmax(magnitudes))
    return StepErrorGrowth(name, _largest_sum(rates), magnitudes[worst], at[worst] * step.time_step, step.time_step)


def _alternating_mode_magnitude(
    step: Step, theta: Array, rollout: Rollout, node: int, feedback: TrackingFeedback | None
) -> float | None:
    """Largest magnitude of the eigenvalues of A - B K with negative real part at a node; None where A is not finite.

    Parameters
    ----------
    step : Step
    theta : ndarray, shape (ntheta,)
    rollout : Rollout
    node : int
        From 0 to N - 1.
    feedback : Feedback or None
    """
    system, sizes = step.system, step.sizes
    n, fixed = system.n_coordinates, list(system.prescribed_indices)
    state, after = rollout.state[node], rollout.state[node + 1]
    a, by_torque, _ = step.jacobians(
        state[:n], state[n : 2 * n], rollout.torque[node], theta, (state[fixed], after[fixed]), state[2 * n :], names=()
    )
    if feedback is not None:
        a[:, feedback.state_indices] -= by_torque @ feedback.gain[node]
    if not np.isfinite(a).all():
        return None
    moving = np.setdiff1d(np.arange(sizes["nx"]), [*fixed, *(n + index for index in fixed)])
    values = np.linalg.eigvals(a[np.ix_(moving, moving)])
    return float(np.max(np.abs(values[values.real < 0]), initial=0.0))


def _largest_sum(rates: Array) -> float:
    """Largest sum over a stretch, zero where all shrink (Kadane)."""
    best = running = 0.0
    for rate in rates:
        running = max(0.0, running + float(rate))
        best = max(best, running)
    return best


def largest_error_growth(problem: EstimationProblem, x: ArrayLike) -> StepErrorGrowth | None:
    """The largest error growth among a problem's recordings; None where no recording has an initial state.

    Parameters
    ----------
    problem : EstimationProblem
    x : array_like, shape (nx,)

    Returns
    -------
    Growth or None
        Of a failed rollout, along the part before the failure.
    """
    predictor, system = problem.predictor, problem.system
    found = []
    looks = max(_N_CHECKED_NODES // len(problem.episodes), _MIN_CHECKED_NODES)
    for i, episode in enumerate(problem.episodes):
        shared, offset = problem.split(x, i)
        theta = predictor.episode_theta(episode, shared)
        begin = predictor.initial_state(episode, theta, offset, ())
        if begin.failure_message:
            continue
        inputs = predictor.tracking_inputs(episode, theta, (), begin.state)
        feedback = inputs.corrected_feedback(
            episode.tracking_feedback, system.driven_indices, episode.measured_driven_angles
        )
        rollout = simulate(
            problem.step, theta, begin.state, episode.grid.steps, inputs.torque, inputs.prescribed_path, feedback
        )
        found.append(_error_growth_along(problem.step, theta, rollout, feedback, episode.name, looks))
    return max(found, key=lambda growth: (growth.growth_decades, growth.max_step_factor), default=None)
