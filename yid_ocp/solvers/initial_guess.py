"""Initial guess of node states and parameters for solvers with states as unknowns."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from yid_ocp.integrator.lqr import lqr_feedback
from yid_ocp.integrator.rollout import generalized_momentum, simulate
from yid_ocp.integrator.step import Rollout, TrackingFeedback
from yid_ocp.problem.episodes import Episode, InitialState
from yid_ocp.problem.estimation_problem import EstimationProblem
from yid_ocp.problem.signal_filters import LowPassFilter

Array = NDArray[np.float64]


class _MisfitFunction(Protocol):
    """Mean square whitened residual of recording `i` with given node states, at unknowns `x` of the problem."""

    def __call__(self, i: int, nodes: Array, x: Array) -> float: ...


# Mean square whitened residual above which another guess of the node states is tried.
_POOR_GUESS_CHI2 = 10.0
# A soft object hangs in other shapes, and hops from one to another: positive parameters are tried that much larger.
_PARAMETER_FACTORS = (1.0, 4.0, 2.0, 10.0)
# Shapes change slowly: so far apart is enough [s].
_EQUILIBRIUM_SPACING = 0.1


@dataclass(frozen=True)
class NodeStateGuess:
    """Initial guess of parameters, node states and multipliers.

    Attributes
    ----------
    x : ndarray, shape (nx,)
        Unknowns of the problem.
    initial_states : tuple of Start
        Initial states of all recordings at `x`.
    node_states, multipliers : tuple of ndarray
        Of every recording, (K + 1, nx) at the nodes and (K, m) or (N, m).
    """

    x: Array
    initial_states: tuple[InitialState, ...]
    node_states: tuple[Array, ...]
    multipliers: tuple[Array, ...]


def guess_node_states(
    problem: EstimationProblem, nodes: Sequence[NDArray[np.int64]], x: Array, misfit: _MisfitFunction
) -> NodeStateGuess:
    """Guess node states near a solution, at an unknown vector or, where that fits poorly, at multiples of it.

    A recording's states are the rollout under the tracking filter, which has no defects, or, where that fails or strays
    from what was measured, every node at rest at the posture that the arms had then, which has defects but follows the
    data.

    Parameters
    ----------
    problem : EstimationProblem
    nodes : sequence of ndarray of int, shape (K + 1,)
        Of every recording.
    x : ndarray, shape (nx,)
    misfit : callable
    """
    lower, upper = problem.bounds
    best: tuple[float, NodeStateGuess] | None = None
    for factor in _PARAMETER_FACTORS:
        moved = np.where(problem.is_positive, np.clip(factor * x, lower, upper), x)
        begins, states, multipliers, total = [], [], [], 0.0
        for i, episode in enumerate(problem.episodes):
            theta = problem.predictor.episode_theta(episode, problem.split(moved, i)[0])
            begins.append(problem.initial_state(episode, theta))

            judged = partial(misfit, i, x=moved)
            size, state, pull = _node_states(problem, episode, nodes[i], theta, begins[-1], judged)
            states.append(state)
            multipliers.append(pull)
            total += size / len(problem.episodes)
        if best is None or total < best[0]:
            best = total, NodeStateGuess(moved, tuple(begins), tuple(states), tuple(multipliers))
        if best[0] <= _POOR_GUESS_CHI2 or not np.any(problem.is_positive):
            break
    assert best is not None
    return best[1]


def mean_square_residual(problem: EstimationProblem, i: int, trajectory: Array, theta: Array) -> float:
    """Mean square whitened residual of a trajectory (N + 1, nx) of recording `i`, without effort channels."""
    slopes = np.zeros((*trajectory.shape, len(problem.unknowns.free_parameters)))
    parts = [np.zeros(1)]
    for samples in problem.episodes[i].measurements:
        if not samples.sensor.effort_joints:
            predicted, _ = problem.predictor.readings_along_trajectory(samples, trajectory, slopes, theta)
            parts.append(samples.residual_block(predicted, threshold=problem.options.huber_threshold).residual)
    return float(np.mean(np.concatenate(parts) ** 2))


def _node_states(
    problem: EstimationProblem,
    episode: Episode,
    nodes: NDArray[np.int64],
    theta: Array,
    begin: InitialState,
    misfit: Callable[[Array], float],
) -> tuple[float, Array, Array]:
    """Misfit, node states and multipliers of one recording."""
    found: list[tuple[float, Array, Array]] = []
    rollout = None if begin.failure_message else _tracked(problem, episode, theta, begin.state)
    if rollout is not None and rollout.status.is_converged:
        state = rollout.state[nodes]
        found.append((misfit(state), state, rollout.multipliers))
    if not found or found[0][0] > _POOR_GUESS_CHI2:
        state, pull = _resting(problem, episode, nodes, theta, begin.state)
        found.append((misfit(state), state, pull))
    return min(found, key=lambda entry: entry[0])


def _tracked(problem: EstimationProblem, episode: Episode, theta: Array, start: Array) -> Rollout:
    feedback = _tracking(problem, episode, theta)
    return simulate(problem.step, theta, start, episode.grid.steps, episode.torque, episode.prescribed_path, feedback)


def _tracking(problem: EstimationProblem, episode: Episode, theta: Array) -> TrackingFeedback | None:
    feedback = episode.tracking_feedback
    if feedback is None and problem.system.driven and not problem.system.servos:
        smooth = LowPassFilter(problem.options.path_cutoff)(episode.grid.node_times, episode.measured_driven_angles)
        return lqr_feedback(problem.step, smooth, episode.torque, theta, arms=problem.model_functions.arms_only_step)
    return feedback


def _resting(
    problem: EstimationProblem, episode: Episode, nodes: NDArray[np.int64], theta: Array, start: Array
) -> tuple[Array, Array]:
    """Node states at rest at the measured postures, with the momentum of moving from one to the next."""
    step, statics = problem.step, problem.model_functions.equilibrium_solver
    n, m, h = step.sizes["n"], step.sizes["m"], step.time_step
    state = np.tile(start, (len(nodes), 1))
    pull = np.zeros((len(nodes), m))
    shape: Array | None = None
    every = max(1, round(_EQUILIBRIUM_SPACING * (len(nodes) - 1) / (h * max(int(nodes[-1]), 1))))
    chosen = np.unique(np.append(np.arange(0, len(nodes), every), len(nodes) - 1))
    for j in chosen:
        node = nodes[j]
        posture = np.concatenate([episode.measured_driven_angles[node], episode.prescribed_path[node]])
        torque = episode.torque[min(node, len(episode.torque) - 1)] if problem.system.driven else None
        rest = statics.solve(posture, theta, torque, shape)
        if rest.max_imbalance < 1e-3:
            shape = rest.state[:n]
            state[j], pull[j] = rest.state, rest.constraint_reactions
        else:
            state[j], pull[j] = state[max(j - 1, 0)], pull[max(j - 1, 0)]
    times = nodes * h
    for column in range(state.shape[1]):
        state[:, column] = np.interp(times, times[chosen], state[chosen, column])
    force = np.zeros((len(times), m))
    for column in range(m):
        force[:, column] = np.interp(times, times[chosen], pull[chosen, column])
    driven = list(problem.system.driven_indices)
    state[:, driven] = episode.measured_driven_angles[nodes]
    velocity = np.gradient(state[:, :n], times, axis=0)
    state[:, n : 2 * n] += generalized_momentum(step, state[:, :n], velocity, theta)
    return state, force[:-1] * h
