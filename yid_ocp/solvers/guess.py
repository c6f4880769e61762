"""A guess of the node states of one recording, for methods that have them as unknowns."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from yid_ocp.integrator.lqr import lqr_filter
from yid_ocp.integrator.rollout import momentum_of, simulate
from yid_ocp.integrator.step import Feedback, Rollout
from yid_ocp.problem.episodes import Episode
from yid_ocp.problem.low_pass import LowPass
from yid_ocp.problem.prediction import Start
from yid_ocp.problem.problem import EstimationProblem

Array = NDArray[np.float64]
Misfit = Callable[[Array, Array], float]
"""Mean square whitened residual of node states and multipliers."""

# Mean square whitened residual above which a rollout is not the best guess of the node states.
POOR_GUESS = 100.0
# Shapes change slowly: so far apart is enough [s].
BETWEEN_SHAPES = 0.1


def node_states(
    problem: EstimationProblem, episode: Episode, nodes: NDArray[np.int64], theta: Array, begin: Start, misfit: Misfit
) -> tuple[Array, Array]:
    """Node states (K + 1, nx) and multipliers before each later one, (K, m) or (N, m), near a solution.

    Either the rollout under the tracking filter, which has no defects, or, where that fails or strays far from what was
    measured, every node at rest at the posture that the arms had then, which has defects but follows the data.

    Parameters
    ----------
    problem : EstimationProblem
    episode : Episode
    nodes : ndarray of int, shape (K + 1,)
    theta : ndarray, shape (ntheta,)
        The episode's own.
    begin : Start
    misfit : callable
    """
    rollout = None if begin.message else _tracked(problem, episode, theta, begin.state)
    candidates = []
    if rollout is not None and rollout.status.ok:
        candidates.append((rollout.state[nodes], rollout.multipliers))
    if not candidates or misfit(*candidates[0]) > POOR_GUESS:
        candidates.append(_resting(problem, episode, nodes, theta, begin.state))
    return candidates[0] if len(candidates) == 1 else min(candidates, key=lambda pair: misfit(*pair))


def _tracked(problem: EstimationProblem, episode: Episode, theta: Array, start: Array) -> Rollout:
    feedback = _tracking(problem, episode, theta)
    return simulate(problem.step, theta, start, episode.grid.steps, episode.torque, episode.path, feedback)


def _tracking(problem: EstimationProblem, episode: Episode, theta: Array) -> Feedback | None:
    feedback = episode.feedback
    if feedback is None and problem.system.driven:
        smooth = LowPass(problem.options.path_cutoff)(episode.grid.times, episode.measured_arm)
        return lqr_filter(problem.step, smooth, episode.torque, theta)
    return feedback


def _resting(
    problem: EstimationProblem, episode: Episode, nodes: NDArray[np.int64], theta: Array, start: Array
) -> tuple[Array, Array]:
    """Node states at rest at the measured postures, with the momentum of moving from one to the next."""
    step, statics = problem.step, problem.functions.statics
    n, m, h = step.sizes["n"], step.sizes["m"], step.time_step
    state = np.tile(start, (len(nodes), 1))
    pull = np.zeros((len(nodes), m))
    shape: Array | None = None
    every = max(1, round(BETWEEN_SHAPES * (len(nodes) - 1) / (h * max(int(nodes[-1]), 1))))
    chosen = np.unique(np.append(np.arange(0, len(nodes), every), len(nodes) - 1))
    for j in chosen:
        node = nodes[j]
        posture = np.concatenate([episode.measured_arm[node], episode.path[node]])
        torque = episode.torque[min(node, len(episode.torque) - 1)] if problem.system.driven else None
        rest = statics.solve(posture, theta, torque, shape)
        if rest.error < 1e-3:
            shape = rest.state[:n]
            state[j], pull[j] = rest.state, rest.constraint_force
        else:
            state[j], pull[j] = state[max(j - 1, 0)], pull[max(j - 1, 0)]
    times = nodes * h
    for column in range(state.shape[1]):
        state[:, column] = np.interp(times, times[chosen], state[chosen, column])
    force = np.zeros((len(times), m))
    for column in range(m):
        force[:, column] = np.interp(times, times[chosen], pull[chosen, column])
    driven = list(problem.system.driven_indices)
    state[:, driven] = episode.measured_arm[nodes]
    velocity = np.gradient(state[:, :n], times, axis=0)
    state[:, n : 2 * n] += momentum_of(step, state[:, :n], velocity, theta)
    return state, force[:-1] * h
