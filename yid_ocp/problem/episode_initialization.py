"""Preparation of episodes: observed equilibrium, gear loads, and initial states of held-out recordings."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from yid_ocp.arrays import Array
from yid_ocp.errors import DataError
from yid_ocp.problem.episode_prediction import EpisodePredictor
from yid_ocp.problem.episodes import Episode, InitialState, truncate_episode
from yid_ocp.problem.measurements import Measurements
from yid_ocp.problem.model_functions import TimeGridStateValues
from yid_ocp.problem.recorded_inputs import denoised_gear_loads
from yid_ocp.problem.unknown_vector import initial_state_offset_limits

_MAX_FIRST_SAMPLE_TIME = 1.0
"""Latest time at which a point's first sample still shows the initial equilibrium [s]."""
_POOR_EQUILIBRIUM_RMSE = 5.0
"""Root mean square error of first points above which another equilibrium is sought [standard deviations]."""
_MAX_REMAINING_ERROR_FRACTION = 0.5
"""Largest fraction of that error that may remain at another equilibrium."""


def with_observed_equilibrium_and_loads(predictor: EpisodePredictor, episode: Episode, theta: Array) -> Episode:
    """Episode with the initial equilibrium that its points show and with gear loads free of effort noise.

    Parameters
    ----------
    theta : ndarray, shape (ntheta,)
        Nominal parameters.
    """
    return _loaded(predictor, _at_rest(predictor, episode, theta), theta)


def _at_rest(predictor: EpisodePredictor, episode: Episode, theta: Array) -> Episode:
    """Episode with the equilibrium near its first points, where that of least energy is far from them."""
    fitted = episode.fixed_initial_state is not None or predictor.options.initial_state == "fitted_to_points"
    if fitted or not predictor.system.grasps:
        return episode
    seen = [found for samples in episode.measurements if (found := _first(samples, episode.grid.time_step)) is not None]
    if not seen:
        return episode
    own, n = predictor.theta_with_episode_values(episode, theta), predictor.system.n_coordinates
    offset = np.zeros(len(predictor.unknowns.initial_state_names))
    least = predictor.initial_state(episode, own, offset, ())
    error = _error(predictor, seen, least, own)
    if not error > _POOR_EQUILIBRIUM_RMSE:
        return episode
    try:
        shape = predictor.model_functions.initial_state_fitter.fit_to_points(
            episode.initial_known_coordinates, seen, own, _MAX_FIRST_SAMPLE_TIME, episode.prescribed_path
        ).state[:n]
    except DataError:
        return episode
    other = predictor.initial_state(episode, own, offset, (), shape)
    if not _error(predictor, seen, other, own) < _MAX_REMAINING_ERROR_FRACTION * error:
        return episode
    return replace(episode, equilibrium_guess=other.state[:n])


def _first(samples: Measurements, time_step: float) -> Measurements | None:
    """The first sample of points, as if it were taken at node 0; None where it comes too late."""
    rows = np.flatnonzero(samples.used_output_mask.any(axis=1))[:1]
    if (
        not samples.sensor.point_names
        or not len(rows)
        or np.max(samples.node[rows]) * time_step > _MAX_FIRST_SAMPLE_TIME
    ):
        return None
    parts = {name: getattr(samples, name)[rows] for name in ("value", "weight", "std")}
    return replace(samples, node=np.zeros(1, np.int64), fraction=np.zeros(1), noise_correlation=None, **parts)


def _error(predictor: EpisodePredictor, seen: Sequence[Measurements], start: InitialState, theta: Array) -> float:
    """Root mean square error of first points at a start [standard deviations]; infinite where it is not at rest."""
    if start.failure_message:
        return math.inf
    state = start.state[None]
    squares: list[Array] = []
    for samples in seen:
        read = predictor.model_functions.compiled_sensor_function(samples.sensor, predictor.unknowns.free_parameters)
        predicted = read(TimeGridStateValues.from_trajectory(predictor.step, state), theta).output
        squares.append(samples.whitened_residual(predicted)[samples.used_output_mask] ** 2)
    return float(np.sqrt(np.mean(np.concatenate(squares))))


def _loaded(predictor: EpisodePredictor, episode: Episode, theta: Array) -> Episode:
    """The episode with the model's loads on gears of joints whose efforts are compared (`denoised_gear_loads`)."""
    compared = [s for s in episode.measurements if s.sensor.effort_joints]
    corrections = predictor.model_functions.input_corrections
    if not compared or not corrections.angles_depend_on_effort:
        return episode
    result = predictor.predict_episode(episode, theta, np.zeros(len(predictor.unknowns.initial_state_names)), False)
    if isinstance(result, str):
        return episode
    load, own = episode.joint_loads.copy(), predictor.node_values(result.rollout).load
    for samples in compared:
        at = [corrections.joint_names.index(joint) for joint in samples.sensor.effort_joints]
        column = [predictor.system.mechanism.joint_index(joint) for joint in samples.sensor.effort_joints]
        cutoff = predictor.options.path_cutoff
        load[:, at] = denoised_gear_loads(load[:, at], own[:, column], samples.node, episode.grid.node_times, cutoff)
    return replace(episode, joint_loads=load)


_HELD_OUT_START_WINDOW = 0.2
"""Duration of the data from which a held-out recording's initial state is estimated [s]."""
_HELD_OUT_ITERATIONS = 3
"""Gauss-Newton iterations of this nearly linear estimate."""


def estimate_initial_state_offset(predictor: EpisodePredictor, episode: Episode, theta: Array, std: Array) -> Array:
    """Offset of the initial state from equilibrium, estimated from the first measurements and its prior.

    Zero where the rollout fails; `std` is the prior's, (number of estimated rows,).
    """
    offset = np.zeros(len(predictor.unknowns.initial_state_names))
    if not len(offset):
        return offset
    short = truncate_episode(episode, max(round(_HELD_OUT_START_WINDOW / predictor.step.time_step), 2))
    weight = 1.0 / std
    guess: Array | None = None
    limit = initial_state_offset_limits(predictor.system, predictor.unknowns.initial_state_names)
    for _ in range(_HELD_OUT_ITERATIONS):
        result = predictor.predict_episode(short, theta, offset, True, guess)
        if isinstance(result, str) or result.output_sensitivities is None:
            return np.zeros(len(predictor.unknowns.initial_state_names))
        guess = result.equilibrium_guess
        rows, slopes = [weight * offset], [np.diag(weight)]
        for k, samples in enumerate(short.measurements):
            by_start = result.output_sensitivities[k][:, :, len(predictor.unknowns.free_parameters) :]
            part = samples.residual_block(result.predicted_outputs[k], by_start)
            rows.append(part.residual)
            slopes += [] if part.jacobian is None else [part.jacobian]
        offset = offset - np.linalg.lstsq(np.vstack(slopes), np.concatenate(rows), rcond=None)[0]
        offset = np.clip(offset, -limit, limit)
    return offset
