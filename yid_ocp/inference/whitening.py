"""Whitening of a recording's residual by a Kalman filter that includes errors of recorded torques and encoders.

The recorded torques of driven joints have two errors: w, white noise from sample to sample, and b, constant over a
recording. Encoders have the error v. To first order, the error d of a rollout's state (model minus truth) obeys

    d_{k+1} = A_k d_k + B_k (w_k + b) + B_k du_k                       if encoders are measurements,
    d_{k+1} = (A_k - B_k K_k) d_k + B_k (G_k (w_k + b) - K_k v_k)      if they are not.

du_k is the correction of the recorded torque by the tracking filter K_k. G_k is the derivative of the applied torque
by an error of the recorded torque (`applied_torque_derivative_by_torque_error`). In the first form du is known, and
the result does not depend on the tracking filter. In the second form the tracking filter is part of the model, because
its reference is not a measurement. Residuals are r = H d + v. With the filter's prediction m of (d, w, b),

    innovations = S^(-1/2) (r - H m),    |innovations|^2 = r' Sigma^-1 r,

where Sigma is the covariance of all residuals. The map is linear and frozen at the point of linearisation: it is the
same for residual and Jacobian, which is generalised least squares.

If a filter exists, the next one is linearised about the smoothed motion with w and b subtracted from the torques: the
derivatives are then those of the sum of squares minimised over w and b (Golub and Pereyra).

References
----------
Golub and Pereyra (1973), SIAM J. Numerical Analysis 10:2, doi:10.1137/0710036. Bryson and Frazier (1963), Smoothing
for linear and nonlinear dynamic systems, Aeronautical Systems Division report TDR-63-119.
Anderson and Moore (1979), Optimal Filtering, chapters 3 and 5. Ljung (1999), System Identification, section 7.4.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from yid_ocp.arrays import Array, BoolArray, IntArray
from yid_ocp.inference.kalman import PrecomputedKalmanFilter, precompute_kalman_filter
from yid_ocp.inference.linearized_residual import (
    NominalTrajectory,
    ResidualDerivativesByStateAndEffort,
    nominal_trajectory_from_prediction,
)
from yid_ocp.integrator.step import linearized_rollout_steps, reachable_and_observable_state_mask
from yid_ocp.integrator.tracking_feedback import applied_torque_derivative_by_torque_error
from yid_ocp.parallel import map_in_threads
from yid_ocp.problem import EquilibriumGuesses, EstimationProblem
from yid_ocp.problem.episode_prediction import EpisodePredictor
from yid_ocp.problem.episodes import Episode, EpisodePrediction, TorqueAndAngleErrorModel
from yid_ocp.problem.estimation_problem import held_out_parameter_vector, held_out_prediction_arguments
from yid_ocp.problem.evaluation import ProcessNoiseWhitener
from yid_ocp.problem.measurements import measurements_minus_sensor_error_estimates

_MIN_TORQUE_GAIN = 0.1  # smallest derivative of applied by recorded torque for conversions of errors
_MIN_START_SLOPE = 1e-12  # smaller derivatives of an initial state are rounding
_ROWS_PER_BLOCK = 4096  # rows whose derivatives by torques are expanded at once
_MAX_ROLLOUTS = 6  # each about the torque offset estimated from the one before
_TORQUE_BIAS_TOLERANCE = 0.05  # change of the offset in stated standard deviations that ends them


class _FilterPart(NamedTuple):
    """Consecutive steps of a filter of (d, w, b) with fixed gains."""

    first: int  # index of the first step
    rows: IntArray  # residual rows, in the order of the steps
    step_of_row: IntArray
    kalman: PrecomputedKalmanFilter
    by_torque: Array  # derivatives of the rows by a known torque of their step, shape (r, nu)


@dataclass(frozen=True)
class WhiteningFilter:
    """A Kalman filter of state error d, torque noise w and torque offset b that whitens the residual of a recording."""

    filter_steps: tuple[_FilterPart, ...]  # all steps, and the last node
    input_error_model: TorqueAndAngleErrorModel  # includes the values of b and w at the linearisation
    initial_covariance: Array  # covariance of (d, w, b) before all measurements, shape (na, na)
    state_mask: BoolArray  # states contained in d, shape (nx,)
    torque_bias_std: Array  # standard deviation of b after all measurements, shape (nu,) [N m]

    def whiten_residuals_and_estimate_torque_bias(self, rows: Array, push: Array | None) -> tuple[Array, Array]:
        """Whiten rows (r, c), and estimate torque errors (nu, c) [N m], as `ProcessNoiseWhitener` describes it."""
        result, mean = np.empty_like(rows), self._expected(rows.shape[1])
        for part in self.filter_steps:
            result[part.rows], mean, _ = self._updated(part, mean, rows[part.rows], push)
        bias = mean[-len(self.input_error_model.torque_bias) :]
        bias[:, 0] += self.input_error_model.torque_bias
        return result, bias

    def _smooth_input_errors(self, rows: Array, push: Array | None) -> tuple[Array, Array, Array]:
        """Smoothed b (nu,) and w (N, nu) [N m] and, with encoder measurements, rollout minus truth (N + 1, nx)."""
        errors, (count, nu) = self.input_error_model, self.input_error_model.torque_noise.shape
        ns = int(np.count_nonzero(self.state_mask))
        torque = slice(ns, ns + nu)
        noise, bias = self.whiten_residuals_and_estimate_torque_bias(rows[:, None], push)
        after, costate = np.zeros((count + 1, nu)), np.zeros((len(self.initial_covariance), 1))
        for part in reversed(self.filter_steps):
            found = part.kalman.smoothed_measurement_noise_and_costate(noise[part.rows], costate)
            noise[part.rows], costate = found[:2]
            after[part.first : part.first + len(found[2])] = found[2][:, torque, 0]
        mean = self._expected(1) + self.initial_covariance @ costate
        fresh = np.concatenate([part.kalman.decay[:, 0] == 0 for part in self.filter_steps])[: count - 1]
        white = np.vstack([errors.torque_noise[0] + mean[torque, 0], errors.torque_std**2 * after[: count - 1]])
        # a torque error is constant until the next sample begins
        white = white[np.maximum.accumulate(np.where(np.append(True, fresh), np.arange(count), 0))]
        error = np.zeros((count + 1, len(self.state_mask)))
        for part in self.filter_steps:
            # without sensor noise there is no innovation; rounding keeps the error bounded
            _, mean, before = self._updated(part, mean, rows[part.rows, None] - noise[part.rows], push, white)
            assert before is not None
            error[part.first : part.first + len(before), self.state_mask] = before[:, :ns, 0]
        return bias[:, 0], white, error

    def _expected(self, columns: int) -> Array:
        """Mean of (d, w, b) before all measurements, (na, columns). Only the first column is nonzero."""
        known = np.concatenate([self.input_error_model.torque_noise[0], self.input_error_model.torque_bias])
        mean = np.zeros((len(self.initial_covariance), columns))
        mean[len(mean) - len(known) :, 0] = -known
        return mean

    def _updated(
        self, part: _FilterPart, mean: Array, own: Array, push: Array | None, white: Array | None = None
    ) -> tuple[Array, Array, Array | None]:
        """Innovations of some steps, and the mean after them. With torque noise `white`, also the mean before each."""
        noise, known = self.input_error_model.torque_noise, None
        if push is not None and part.first < len(push):
            known, own = push[part.first : part.first + len(part.kalman.moves)], own.copy()
            for first in range(0, len(own), _ROWS_PER_BLOCK):
                rows = slice(first, first + _ROWS_PER_BLOCK)
                own[rows] -= np.einsum("ru,ruc->rc", part.by_torque[rows], push[part.step_of_row[rows]])
        # after each step, the noise of the sample that begins then, else zero
        shift, begins = np.zeros_like(part.kalman.decay), np.flatnonzero(part.kalman.decay[:, 0] == 0)
        shift[begins, : noise.shape[1]] = (-noise if white is None else white - noise)[part.first + 1 + begins]
        return part.kalman.normalized_innovations_and_next_mean(mean, own, shift, known, white is not None)


def _build_whitening_filter(course: NominalTrajectory, errors: TorqueAndAngleErrorModel) -> WhiteningFilter:
    """The whitening Kalman filter along a trajectory."""
    step, nu, count = course.model_functions.step, len(errors.torque_bias_std), len(course.rollout.torque)
    slopes = ResidualDerivativesByStateAndEffort.from_nominal_trajectory(course)
    start = np.hstack([course.initial_state_by_angles, *[course.initial_state_by_torque] * 2])
    seen, disturbed = np.any(slopes.by_state != 0, axis=(0, 1)), np.any(np.abs(start) > _MIN_START_SLOPE, axis=1)
    live = reachable_and_observable_state_mask(step, course.theta, course.rollout, seen=seen, disturbed=disturbed)
    kept, order = np.flatnonzero(live), np.argsort(slopes.node, kind="stable")
    rows_of_node = np.split(order, np.searchsorted(slopes.node[order], np.arange(1, count + 1)))
    slopes = slopes.select_states(kept)
    unit = np.vstack([start[kept], np.eye(2 * nu, 3 * nu, nu)])
    unit *= np.concatenate([errors.angle_std, errors.torque_std, errors.torque_bias_std])
    first = unit @ unit.T
    steps, covariance = _filter_steps(course, errors, kept, slopes, rows_of_node[:-1], first)
    # after the last node there is no motion
    rows, none = rows_of_node[-1], np.zeros((len(rows_of_node[-1]), nu))
    observe = np.hstack([slopes.by_state[:, rows].sum(axis=0), none, none])
    still = np.eye(len(kept), len(kept) + nu)[None], 0, np.ones((1, 2 * nu)), np.zeros((1, 2 * nu))
    kalman, covariance = precompute_kalman_filter(covariance, observe, (0, len(rows)), *still)
    spread = np.sqrt(np.maximum(np.diag(covariance)[len(kept) + nu :], 0.0))
    last = _FilterPart(count, rows, np.full(len(rows), count), kalman, none)
    return WhiteningFilter((steps, last), errors, first, live, spread)


def _filter_steps(
    course: NominalTrajectory,
    errors: TorqueAndAngleErrorModel,
    kept: IntArray,
    slopes: ResidualDerivativesByStateAndEffort,
    rows_of_node: Sequence[IntArray],
    covariance: Array,
) -> tuple[_FilterPart, Array]:
    """Filter over all steps for the states at the indices `kept`, and the covariance after the last step."""
    (count, nu), ns, begun = course.rollout.torque.shape, len(kept), 0
    # a new w at each new sample, and the same b
    fresh = np.append(np.diff(errors.sample_of_step) != 0, False)[:, None]
    decay = np.hstack([np.repeat(1.0 - fresh, nu, axis=1), np.ones((count, nu))])
    variance = np.hstack([fresh * errors.torque_std**2, np.zeros((count, nu))])
    inputs, feedback = np.tile(np.eye(nu), (count, 1, 1)), course.tracking_feedback
    if errors.has_encoder_measurements:
        feedback = None
    elif feedback is not None:
        # momenta that the filter follows contain torques of the previous step
        shift = course.model_functions.effect_momentum_calculator
        momentum = shift.momentum_derivative_by_previous_torque(course.theta)
        driving = applied_torque_derivative_by_torque_error(feedback.gain, momentum)
        # only errors of the filter's reference angles count; those of momenta average out
        shaken = feedback.gain[:, :, :nu] * errors.angle_std * np.sqrt(errors.encoder_noise_steps)
        inputs = np.concatenate([driving, shaken], axis=2)
    na, nx, known = len(covariance), course.rollout.state.shape[1], ns + nu
    columns = np.concatenate([kept, np.arange(nx, nx + inputs.shape[2])])
    order, step_of_row = np.concatenate(rows_of_node), np.repeat(np.arange(count), list(map(len, rows_of_node)))
    ordered = slopes.select_residual_rows(order)
    (before, after), by_effort = ordered.by_state, ordered.by_effort.sum(axis=0)
    ends = np.cumsum([0, *map(len, rows_of_node)])
    # stepwise matrices of all steps stand together, so that a column is filtered in one call
    moves = np.empty((count, ns, len(columns)))
    observe, by_torque = np.zeros((ends[-1], na)), np.zeros((ends[-1], nu))
    along = course.model_functions.step, course.theta, course.rollout
    places = kept[:, None] * (nx + inputs.shape[2]) + columns
    for state, effort in linearized_rollout_steps(*along, inputs, feedback):
        move = moves[begun : begun + len(state)]
        move[:] = state if ns == nx else state.reshape(len(state), -1).take(places, axis=1)  # faster than an index
        spans = pairwise(ends[begun : begun + len(state) + 1].tolist())
        for k, rows in enumerate(slice(*pair) for pair in spans):
            observe[rows, :known] = after[rows] @ move[k, :, :known]
            by_torque[rows] = observe[rows, ns:known]
            if by_effort.shape[1]:
                observe[rows, :known] += by_effort[rows] @ effort[k, : by_effort.shape[1]][:, columns[:known]]
        begun += len(state)
    observe[:, known:] = observe[:, ns:known]
    observe[:, :ns] += before
    stepwise = ends.tolist(), moves, inputs.shape[2] - nu, decay, variance
    kalman, covariance = precompute_kalman_filter(covariance, observe, *stepwise)
    return _FilterPart(0, order, step_of_row, kalman, by_torque), covariance


def estimate_episode_torque_bias(episode: Episode, result: EpisodePrediction, whitening: ProcessNoiseWhitener) -> Array:
    """Estimate the constant errors (nu,) [N m] of a recording's torques from its prediction and whitening filter."""
    return _innovations_and_bias(episode, result, whitening)[1][:, 0]


def _innovations_and_bias(episode: Episode, result: EpisodePrediction, by: ProcessNoiseWhitener) -> tuple[Array, Array]:
    rows, push = _plain(episode, result)[:, None], result.stacked_feedback_torque_and_sensitivity
    return by.whiten_residuals_and_estimate_torque_bias(rows, push)


def _plain(episode: Episode, result: EpisodePrediction) -> Array:
    """Residual of an episode in units of sensor noise, after subtraction of constant sensor and clock errors."""
    samples = measurements_minus_sensor_error_estimates(episode.measurements, result.predicted_outputs)
    pairs = zip(samples, result.predicted_outputs, strict=True)
    return np.concatenate([own.residual_and_jacobian(y).residual for own, y in pairs])


def _whitened_episode(
    predictor: EpisodePredictor,
    episode: Episode,
    at: tuple[Array, Array],
    guess: Array | None,
    before: WhiteningFilter | None,
    result: EpisodePrediction | str | None,
    keep_weights: bool = False,
) -> tuple[Episode, WhiteningFilter | None]:
    """Episode with estimated input errors, and the filter that whitens its residual at (theta, offset).

    The filter is None without process noise or if the rollout fails. It is linearised about the motion smoothed by
    `before`, if given. With `keep_weights` it keeps the weights of `before`. `result` is the prediction, if known.
    """
    if episode.input_errors is None:
        return episode, None
    result = result or predictor.predict_episode(episode, *at, False, guess)
    if not isinstance(result, str):
        episode = replace(episode, equilibrium_guess=result.equilibrium_guess)
    if before is not None and not isinstance(result, str):
        episode = _about_smoothed(predictor, episode, at[0], result, before)
        result = predictor.predict_episode(episode, *at, False, guess)
    if isinstance(result, str) or episode.input_errors is None:
        return episode, None
    if before is not None and keep_weights:
        return episode, replace(before, input_error_model=episode.input_errors)
    course = nominal_trajectory_from_prediction(predictor, episode, result, at[0])
    return episode, _build_whitening_filter(course, episode.input_errors)


def _about_smoothed(
    predictor: EpisodePredictor, episode: Episode, theta: Array, result: EpisodePrediction, before: WhiteningFilter
) -> Episode:
    """Episode with smoothed torque errors and, if encoders are measurements, a smoothed reference motion."""
    errors, feedback = episode.input_errors, episode.tracking_feedback
    assert errors is not None
    plain, push = _plain(episode, result), result.stacked_feedback_torque_and_sensitivity
    bias, noise, state_error = before._smooth_input_errors(plain, push)
    own = predictor.theta_with_episode_values(episode, theta)
    errors = replace(errors, torque_bias=bias, torque_noise=noise)
    errors = _behind_effects(predictor, episode, own, errors)
    if errors.has_encoder_measurements and feedback is not None:
        inputs = predictor.corrected_inputs_with_effect_momentum(episode, own, (), result.rollout.state[0])
        driven = predictor.system.actuated_coordinate_indices
        guided = inputs.tracking_feedback_with_corrected_reference(feedback, driven, episode.measured_driven_angles)
        assert guided is not None
        true = (result.rollout.state - state_error)[:-1, feedback.state_indices]
        errors = replace(errors, smoothed_reference=true - (guided.reference - feedback.reference))
    return replace(episode, input_errors=errors)


def _behind_effects(
    predictor: EpisodePredictor, episode: Episode, theta: Array, errors: TorqueAndAngleErrorModel
) -> TorqueAndAngleErrorModel:
    """The errors, with torque noise converted to noise of the readings, because an effect may scale the readings."""
    corrections, nu = predictor.model_functions.input_corrections, errors.torque_noise.shape[1]
    read = errors.torque_noise
    if corrections.corrects_efforts:
        readings = np.pad(episode.torque, ((0, 0), (0, episode.prescribed_path.shape[1])))
        by_reading = corrections.true_angles_and_efforts(np.zeros_like(readings), readings, theta, ())[4][:, :nu]
        # a reading with almost no influence on the applied torque does not reveal its error
        seen = np.abs(by_reading) > _MIN_TORQUE_GAIN
        read = np.where(seen, read, 0.0) / np.where(seen, by_reading, 1.0)
    plain = errors.with_torque_bias_only
    both = (replace(episode, input_errors=own) for own in (plain, replace(plain, recorded_torque_noise=read)))
    none, without = (predictor.corrected_inputs(own, theta, ()).torque for own in both)
    return replace(errors, recorded_torque_noise=read, transmitted_torque_noise=none - without)


def problem_with_whitening_at(
    problem: EstimationProblem,
    x: ArrayLike,
    equilibrium_guesses: EquilibriumGuesses | None = None,
    predictions: Sequence[EpisodePrediction] = (),
    rounds: int = 1,
    keep_weights: bool = False,
) -> EstimationProblem:
    """Return a problem whose residuals are whitened by sensor noise and input noise, linearized at the unknowns `x`.

    `problem` itself is returned if it has no input noise, or if a rollout at `x` fails. New filters are linearized
    about the smoothed motion and torques that the problem's existing filters estimate, otherwise about the rollout.
    `rounds` is the number of linearizations (a fit uses 2). With `keep_weights`, the gains of existing filters are
    kept, which suffices after a step of one standard deviation. The search for equilibria starts at
    `equilibrium_guesses`. If `predictions` of all recordings at `x` are given, they are not simulated again.
    """
    x = np.asarray(x, float)
    guesses = equilibrium_guesses or (None,) * len(problem.episodes)

    def one(i: int) -> tuple[Episode, WhiteningFilter | None]:
        before = _own_filter(problem.whitening_filters[i])
        own = problem.unpack_episode_unknowns(x, i)
        known = predictions[i] if predictions else None
        return _whitened_episode(problem.predictor, problem.episodes[i], own, guesses[i], before, known, keep_weights)

    if not problem.has_process_noise:
        return problem
    episodes, made = zip(*map_in_threads(one, range(len(problem.episodes))), strict=True)
    if any(m is None and e.input_errors is not None for m, e in zip(made, episodes, strict=True)):
        return problem
    found = problem.with_episodes(episodes, problem.held_out, made)
    return found if rounds < 2 else problem_with_whitening_at(found, x, equilibrium_guesses, rounds=rounds - 1)


def problem_with_held_out_kalman_whitening(
    problem: EstimationProblem, x: ArrayLike, *, keep_weights: bool = False
) -> EstimationProblem:
    """Return a problem that whitens the residuals of held-out recordings by sensor and input noise.

    Each held-out recording gets a Kalman filter that is linearised at the unknowns `x`, about the smoothed motion that
    the recording's previous filter estimates. A recording without a filter first gets one that is linearised about its
    rollout. With `keep_weights`, the gains of this first filter are kept, which suffices for torque offsets. A
    recording whose rollout fails is weighted by sensor noise only.
    """
    x, episodes, made = np.asarray(x, float), [], []
    known = zip(problem.held_out_whitening_filters, held_out_prediction_arguments(problem, x), strict=True)
    for held, (before, (own, theta, offset)) in zip(problem.held_out, known, strict=True):
        whitening, at = _own_filter(before), (theta, offset)
        result = problem.predictor.predict_episode(own, *at, False) if own.input_errors else None
        if first := whitening is None:
            own, whitening = _whitened_episode(problem.predictor, own, at, None, None, result)
        own, whitening = _whitened_episode(problem.predictor, own, at, None, whitening, result, first and keep_weights)
        episodes.append(replace(held, input_errors=own.input_errors, equilibrium_guess=own.equilibrium_guess))
        made.append(whitening)
    return problem.with_episodes(problem.episodes, episodes, problem.whitening_filters, made)


def problem_relinearized_at_torque_bias(problem: EstimationProblem, x: Array, frozen: Array) -> EstimationProblem:
    """Return a problem with whitening filters at the torque offsets of `x` and the gains of the unknowns `frozen`."""
    parts = problem.unpack_episode_unknowns
    at = [(e, *parts(x, i), parts(frozen, i)[0]) for i, e in enumerate(problem.episodes)]
    episodes, made = _relinearized(problem.predictor, problem.episodes, problem.whitening_filters, at)
    return problem.with_episodes(episodes, problem.held_out, made, problem.held_out_whitening_filters)


def problem_with_reestimated_held_out_torque_biases(
    problem: EstimationProblem, x: Array, frozen: Array
) -> EstimationProblem:
    """Return a problem with held-out whitening filters at the torque offsets of `x`, and the gains at `frozen`."""
    pairs = zip(held_out_prediction_arguments(problem, x), problem.held_out, strict=True)
    at = [(*own, held_out_parameter_vector(problem, frozen, held)) for own, held in pairs]
    held_out, made = _relinearized(problem.predictor, problem.held_out, problem.held_out_whitening_filters, at)
    return problem.with_episodes(problem.episodes, held_out, problem.whitening_filters, made)


def problem_with_sensor_noise_only(problem: EstimationProblem) -> EstimationProblem:
    """Return the problem with sensor noise but without noise of recorded inputs. Estimated torque offsets are kept."""
    return _with_errors(problem, lambda errors: errors.with_torque_bias_only)


def problem_with_exact_inputs(problem: EstimationProblem) -> EstimationProblem:
    """Return the problem with its recorded torques and angles treated as exact."""
    return _with_errors(problem, lambda errors: None)


def _with_errors(
    problem: EstimationProblem, changed: Callable[[TorqueAndAngleErrorModel], TorqueAndAngleErrorModel | None]
) -> EstimationProblem:
    def without(episode: Episode) -> Episode:
        return replace(episode, input_errors=episode.input_errors and changed(episode.input_errors))

    return problem.with_episodes(list(map(without, problem.episodes)), list(map(without, problem.held_out)))


def torque_biases_and_stds_per_recording(problem: EstimationProblem, x: ArrayLike) -> list[tuple[Array, Array] | None]:
    """Estimate the constant torque errors (nu,) [N m] of each recording at `x`, with their standard deviations.

    An entry is None if the recording has no whitening filter (`problem_with_whitening_at`), or if its rollout fails.
    """
    x, found = np.asarray(x, float), list[tuple[Array, Array] | None]()
    for i, (episode, own) in enumerate(zip(problem.episodes, problem.whitening_filters, strict=True)):
        whitening = _own_filter(own)
        parts = problem.unpack_episode_unknowns(x, i)
        result = "" if whitening is None else problem.predictor.predict_episode(episode, *parts, False)
        if whitening is None or isinstance(result, str):
            found.append(None)
        else:
            found.append((estimate_episode_torque_bias(episode, result, whitening), whitening.torque_bias_std))
    return found


def _own_filter(whitening: ProcessNoiseWhitener | None) -> WhiteningFilter | None:
    assert whitening is None or isinstance(whitening, WhiteningFilter)
    return whitening


def _relinearized(
    predictor: EpisodePredictor,
    episodes: Sequence[Episode],
    known: Sequence[ProcessNoiseWhitener | None],
    at: Sequence[tuple[Episode, Array, Array, Array]],
) -> tuple[tuple[Episode, ...], tuple[WhiteningFilter | None, ...]]:
    """Episodes and filters at the torque offsets estimated for each entry (episode, theta, start, frozen theta)."""
    pairs = zip(map(_own_filter, known), at, strict=True)
    made = tuple(own and _settled(predictor, own, *told) for own, told in pairs)
    both = zip(episodes, made, strict=True)
    return tuple(e if own is None else replace(e, input_errors=own.input_error_model) for e, own in both), made


def _settled(
    predictor: EpisodePredictor, whitening: WhiteningFilter, episode: Episode, theta: Array, start: Array, frozen: Array
) -> WhiteningFilter:
    # an effect on inputs changes the torque offset by a known amount, without a rollout
    both = (predictor.theta_with_episode_values(episode, t) for t in (theta, frozen))
    now, before = (predictor.corrected_inputs(episode, own, ()).torque for own in both)

    def about(offset: Array) -> WhiteningFilter:
        return replace(whitening, input_error_model=replace(whitening.input_error_model, torque_bias=offset))

    made = trial = about(whitening.input_error_model.torque_bias + np.mean(now - before, axis=0))
    least = np.inf
    for _ in range(_MAX_ROLLOUTS if np.any(whitening.input_error_model.torque_bias_std > 0) else 0):
        own = replace(episode, input_errors=trial.input_error_model)
        result = predictor.predict_episode(own, theta, start, False)
        if isinstance(result, str):
            break
        innovations, bias = _innovations_and_bias(own, result, trial)
        cost = float(np.sum(innovations[:, 0] ** 2))
        if cost < least:
            least, made, offset = cost, trial, bias[:, 0]
        else:
            # with dry friction, the linear estimate can be too far
            offset = (made.input_error_model.torque_bias + trial.input_error_model.torque_bias) / 2
        trial = about(offset)
        if _apart(trial, made) < _TORQUE_BIAS_TOLERANCE:
            break
    return made


def max_torque_bias_change_in_stds(
    some: Sequence[ProcessNoiseWhitener | None], others: Sequence[ProcessNoiseWhitener | None]
) -> float:
    """Return the largest difference of torque offsets between two lists of filters, in stated standard deviations."""
    return max((_apart(one, other) for one, other in zip(some, others, strict=True) if one and other), default=0.0)


def _apart(one: ProcessNoiseWhitener, other: ProcessNoiseWhitener) -> float:
    stated = one.input_error_model.torque_bias_std > 0
    apart = np.abs(one.input_error_model.torque_bias - other.input_error_model.torque_bias)
    return float(np.max(apart[stated] / one.input_error_model.torque_bias_std[stated], initial=0.0))
