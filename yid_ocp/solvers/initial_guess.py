"""Initial guesses of the unknowns, with small amplitudes of free effects, and of the states at nodes."""

from __future__ import annotations

import functools
import itertools
import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from yid_ocp.arrays import Array, IntArray
from yid_ocp.effects import EffectBase
from yid_ocp.inference.linearized_residual import bounded_levenberg_marquardt_step, predicted_cost_reduction_by_step
from yid_ocp.inference.uncertainty import unknowns_covariance_and_reduced_chi2
from yid_ocp.integrator.step import generalized_momentum_from_velocity, simulate
from yid_ocp.integrator.tracking_feedback import lqr_tracking_feedback
from yid_ocp.problem.episodes import Episode, InitialStateWithSensitivity
from yid_ocp.problem.estimation_problem import EstimationProblem
from yid_ocp.problem.evaluation import Evaluation
from yid_ocp.sensors.signal_filters import ZeroPhaseLowPassFilter

log = logging.getLogger(__name__)

# Mean square whitened residual of a recording (by index), with given node states and unknowns.
_MisfitFunction = Callable[[int, Array, Array], float]
# Number of values tried per shape parameter, over its range.
_N_SHAPE_VALUES = 4
# Smallest initial amplitude of an activated effect, as a fraction of the amplitude's expected range.
_MIN_AMPLITUDE_FRACTION = 0.1
# Fractions of the way from the neutral start to one with active effects, tried until the rollout succeeds.
_START_FRACTIONS = (1.0, 0.5, 0.2, 0.05)
# Mean square whitened residual above which another guess of the node states is tried.
_POOR_GUESS_CHI2 = 10.0
# Factors on positive parameters that are tried, because a soft object has several shapes and snaps between them.
_PARAMETER_FACTORS = (1.0, 4.0, 2.0, 10.0)
# Spacing of the equilibria from which a guess is interpolated [s].
_EQUILIBRIUM_SPACING = 0.1
# A branch measured a few times a second fits several frequencies, so a parameter with a relative std above the first
# number can have other minima. It is multiplied by these factors, and the others follow the fit's covariance. If the
# cost rises by less than the second number times the predicted rise, the search continues there (twice at most).
_MIN_SCANNED_RELATIVE_STD, _MAX_COST_RISE_RATIO, _MAX_LOCAL_MINIMUM_STARTS = 0.03, 0.2, 2
_SCAN_FACTORS = (1 / 2.5, 1 / 1.6, 1.6, 2.5)


@dataclass(frozen=True)
class UnknownsAndNodeStateGuess:
    """A guess of the unknowns, and of each recording's initial state, node states and constraint multipliers."""

    x: Array  # unknowns, (nx,)
    initial_states: tuple[InitialStateWithSensitivity, ...]
    node_states: tuple[Array, ...]  # shape (K + 1, nx) each
    multipliers: tuple[Array, ...]  # shape (K, m) or (N, m) each


def guess_unknowns_and_node_states(
    problem: EstimationProblem, nodes: Sequence[IntArray], x: Array, misfit: _MisfitFunction
) -> UnknownsAndNodeStateGuess:
    """Guess unknowns and node states near a solution, from `x` or, if `x` fits poorly, from multiples of `x`.

    The states of a recording come from a rollout with the tracking filter, so that they satisfy the equations of
    motion. If the rollout fails or deviates from the measurements (by `misfit`), each node in `nodes` (K + 1,) gets the
    equilibrium at the arms' measured posture. Such states follow the data, but violate the equations of motion.
    """
    lower, upper = problem.bounds
    best: tuple[float, UnknownsAndNodeStateGuess] | None = None
    for factor in _PARAMETER_FACTORS:
        moved = np.where(problem.positive_unknowns_mask, np.clip(factor * x, lower, upper), x)
        begins, states, multipliers, total = [], [], [], 0.0
        for i, episode in enumerate(problem.episodes):
            theta = problem.theta_of_episode(moved, i)
            begins.append(problem.predictor.initial_state_and_derivative(episode, theta))
            found: list[tuple[Array, Array]] = []
            if not begins[-1].failure_message:
                found += _tracked(problem, episode, nodes[i], theta, begins[-1].state)
            sizes = [misfit(i, state, moved) for state, _ in found]
            if not found or sizes[0] > _POOR_GUESS_CHI2:
                found.append(_resting(problem, episode, nodes[i], theta, begins[-1].state))
                sizes.append(misfit(i, found[-1][0], moved))
            state, pull = found[int(np.argmin(sizes))]
            states.append(state)
            multipliers.append(pull)
            total += min(sizes) / len(problem.episodes)
        if best is None or total < best[0]:
            best = total, UnknownsAndNodeStateGuess(moved, tuple(begins), tuple(states), tuple(multipliers))
        if best[0] <= _POOR_GUESS_CHI2 or not np.any(problem.positive_unknowns_mask):
            break
    assert best is not None
    return best[1]


def mean_square_of_non_effort_residuals(problem: EstimationProblem, i: int, trajectory: Array, x: Array) -> float:
    """Return the mean square whitened residual of recording `i` for a trajectory (N + 1, nx). Efforts are not used."""
    theta = problem.theta_of_episode(x, i)
    slopes = np.zeros((*trajectory.shape, len(problem.unknowns.free_parameter_names)))
    parts = [np.zeros(1)]
    for samples in problem.episodes[i].measurements:
        if not samples.sensor.effort_joints:
            predicted, _ = problem.predictor.readings_and_sensitivities(samples, trajectory, slopes, theta)
            parts.append(samples.residual_and_jacobian(predicted, threshold=problem.options.huber_threshold).residual)
    return float(np.mean(np.concatenate(parts) ** 2))


def _tracked(
    problem: EstimationProblem, episode: Episode, nodes: IntArray, theta: Array, start: Array
) -> list[tuple[Array, Array]]:
    """Node states and multipliers of the rollout with the tracking filter; empty if it fails."""
    feedback = episode.tracking_feedback
    if feedback is None and problem.system.driven and not problem.system.servos:
        low_pass = ZeroPhaseLowPassFilter(problem.options.path_cutoff)
        smooth = low_pass(episode.grid.node_times, episode.measured_driven_angles)
        arms = problem.model_functions.arms_only_integrator_step
        feedback = lqr_tracking_feedback(problem.step, smooth, episode.torque, theta, arms=arms)
    inputs = episode.grid.steps, episode.torque, episode.prescribed_path, feedback
    rollout = simulate(problem.step, theta, start, *inputs)
    return [(rollout.state[nodes], rollout.multipliers)] if rollout.status.is_converged else []


def _resting(
    problem: EstimationProblem, episode: Episode, nodes: IntArray, theta: Array, start: Array
) -> tuple[Array, Array]:
    """Node states and multipliers at equilibria of the measured postures, with momenta from their differences."""
    step, statics = problem.step, problem.model_functions.equilibrium_solver
    n, nx, h = step.sizes["n"], step.sizes["nx"], step.time_step
    # at equal times, however far apart the nodes are: a longer way can lead to another shape of a soft object
    at = np.unique(np.append(np.arange(0, nodes[-1], max(1, round(_EQUILIBRIUM_SPACING / h))), nodes[-1]))
    state, pull = np.tile(start, (len(at), 1)), np.zeros((len(at), step.sizes["m"]))
    shape: Array | None = None
    for j, k in enumerate(at):
        posture = np.concatenate([episode.measured_driven_angles[k], episode.prescribed_path[k]])
        torque = episode.torque[min(k, len(episode.torque) - 1)] if problem.system.driven else None
        rest = statics.solve(posture, theta, torque, shape)
        if rest.max_imbalance < 1e-3:
            shape = rest.state[:n]
            state[j], pull[j] = rest.state, rest.constraint_reactions
        else:
            state[j], pull[j] = state[max(j - 1, 0)], pull[max(j - 1, 0)]
    columns = np.column_stack([state, pull]).T
    state, pull = np.hsplit(np.stack([np.interp(nodes, at, column) for column in columns], axis=1), [nx])
    state[:, list(problem.system.actuated_coordinate_indices)] = episode.measured_driven_angles[nodes]
    velocity = np.gradient(state[:, :n], nodes * h, axis=0)
    state[:, n : 2 * n] += generalized_momentum_from_velocity(step, state[:, :n], velocity, theta)
    return state, pull[:-1] * h


def unknowns_with_neutral_effects_activated(problem: EstimationProblem, x: Array) -> Array:
    """Return the unknown vector `x` (nx,) with small amplitudes of free effects whose amplitudes in `x` are neutral.

    At zero amplitude, an effect's shape parameters (rest angle of a spring, relaxation time) have no influence and
    cannot be estimated, and a poor shape can drive the amplitude to its bound. Several shapes are therefore tried for
    each such effect. The best shape starts with the amplitude that the linearised model predicts, clipped to the
    expected range. An effect without shape parameters keeps its zero amplitude, unless the residual's derivative is
    zero there. An effect also keeps it if the rollout fails with every smaller amplitude that is tried.
    """
    place = {name: i for i, name in enumerate(problem.unknown_names)}
    # effects without shapes, such as the friction of many joints, need the same point
    evaluate = functools.lru_cache(1)(lambda point: problem.evaluate(np.array(point)))
    for effect in problem.system.effects:
        if not isinstance(effect, EffectBase):
            continue
        free = [name for name in effect.parameters.names if name in place]
        amplitudes = [name for name in effect.amplitude_parameter_names if name in free]
        if not amplitudes or any(x[place[name]] != effect.neutral_values[name] for name in amplitudes):
            continue
        begun = _with_effect_begun(problem, x, effect, place, evaluate)
        if begun is None:
            continue
        for pull in _START_FRACTIONS:
            trial = x + pull * (begun - x)
            if np.any(trial != x) and problem.evaluate(trial, derivatives=False).ok:
                log.info("%s begins at %s", effect.label, {name: float(trial[place[name]]) for name in free})
                x = trial
                break
    return x


def _with_effect_begun(
    problem: EstimationProblem,
    x: Array,
    effect: EffectBase,
    place: dict[str, int],
    evaluate: Callable[[tuple[float, ...]], Evaluation],
) -> Array | None:
    """The start with an effect at its best shape; None if only its amplitude is free, and observable at neutral."""
    amplitudes = [place[name] for name in effect.amplitude_parameter_names if name in place]
    shapes = [place[name] for name in effect.shape_parameter_names if name in place]
    expected = {place[name]: limits for name, limits in effect.prior_ranges.items() if name in place}
    grids = [[float(x[at]), *np.linspace(*expected[at], _N_SHAPE_VALUES)] for at in shapes]
    best, most, blind = x.copy(), -np.inf, True
    for values in itertools.product(*grids):
        trial = x.copy()
        trial[shapes] = values
        found = evaluate(tuple(trial.tolist()))
        if not found.ok or found.jacobian is None:
            continue
        blind = blind and not np.any(found.jacobian[problem.residual_rows.data][:, amplitudes])
        if not shapes and not blind:
            return None
        step, fall = _amplitude(problem, trial, found, amplitudes)
        if fall > most:
            best, most = trial, fall
            best[amplitudes] += step
    for at in amplitudes:
        low, high = expected[at]
        width, least = high - low, _MIN_AMPLITUDE_FRACTION * (high - low)
        moved = float(np.clip(best[at] - x[at], -width, width))
        if abs(moved) < least:
            moved = -least if moved < 0 and x[at] - least >= problem.bounds[0][at] else least
        best[at] = x[at] + moved
    return np.clip(best, *problem.bounds)


def _amplitude(problem: EstimationProblem, x: Array, found: Evaluation, amplitudes: list[int]) -> tuple[Array, float]:
    """Step of the amplitudes, with all other unknowns adapted, and its predicted decrease of the cost."""
    assert found.jacobian is not None
    lower, upper = problem.bounds
    size = np.maximum(np.abs(x), problem.unknown_scales)
    others = np.setdiff1d(np.arange(len(x)), amplitudes)
    low, high = (lower - x) / size, (upper - x) / size
    # other unknowns may move by at most their size, because the model is linear about a start
    low[others], high[others] = np.maximum(low[others], -1.0), np.minimum(high[others], 1.0)
    scaled = found.jacobian * size
    step = bounded_levenberg_marquardt_step(scaled, found.residual, 1e-10, low, high)
    return step[amplitudes] * size[amplitudes], predicted_cost_reduction_by_step(scaled, found.residual, step)


def start_vectors_toward_other_minima(problem: EstimationProblem, finish: Evaluation, x: Array) -> list[Array]:
    """Return start vectors that may lead to another minimum than `x` (evaluation: `finish`), by increasing cost."""
    if not finish.ok or finish.jacobian is None or not problem.has_process_noise:
        return []
    covariance, _ = unknowns_covariance_and_reduced_chi2(problem, finish)
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    found: list[tuple[float, Array]] = []
    # poorly known unknowns stay unchanged
    known = std < np.abs(x)
    for i in np.flatnonzero(problem.positive_unknowns_mask & known & (std > _MIN_SCANNED_RELATIVE_STD * np.abs(x))):
        for factor in _SCAN_FACTORS:
            along = np.where(known, covariance[:, i] / covariance[i, i], 0.0)
            moved = np.clip(x + along * (factor - 1.0) * x[i], *problem.bounds)
            # a stiffness is compared on a log scale if that is smaller: a vanishing slope is no minimum
            expected = 0.5 * (min(abs(factor - 1.0), abs(math.log(factor))) * x[i] / std[i]) ** 2
            there = problem.evaluate(moved, derivatives=False, equilibrium_guesses=finish.equilibrium_guesses)
            rise = there.cost - finish.cost
            if there.ok and expected > 2.0 and rise < _MAX_COST_RISE_RATIO * expected:
                found.append((rise, moved))
    found.sort(key=lambda entry: entry[0])
    return [moved for _, moved in found[:_MAX_LOCAL_MINIMUM_STARTS]]
