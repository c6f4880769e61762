"""Relinearization of whitening filters about the constant torque errors estimated at other unknowns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from yid_ocp.problem.episode_prediction import EpisodePredictor
from yid_ocp.problem.episodes import Episode
from yid_ocp.problem.input_noise import WhiteningFilter

Array = NDArray[np.float64]
_MAX_ROLLOUTS = 6
"""Largest number of rollouts, each about the torque offset estimated from the one before."""
_TORQUE_BIAS_TOLERANCE = 0.05
"""Change of the torque offset, in stated standard deviations, below which the iteration ends."""


def relinearized_filters(
    predictor: EpisodePredictor,
    known: Sequence[WhiteningFilter | None],
    at: Sequence[tuple[Episode, Array, Array, Array]],
) -> tuple[WhiteningFilter | None, ...]:
    """Filters relinearized about the torque offsets estimated at other parameters, their weights unchanged.

    Parameters
    ----------
    predictor : Predictor
    known : sequence of Innovations or None
        Of every episode.
    at : sequence of (Episode, theta, start, frozen)
        Episode with its filter's errors, new theta and initial state offset, and the theta of the present
        linearization.
    """
    return tuple(own and _settled(predictor, own, *told) for own, told in zip(known, at, strict=True))


def with_filter_input_errors(
    episodes: Sequence[Episode], known: Sequence[WhiteningFilter | None]
) -> tuple[Episode, ...]:
    """Episodes with the input errors about which their filters are linearized."""
    pairs = zip(episodes, known, strict=True)
    return tuple(episode if own is None else replace(episode, input_errors=own.input_errors) for episode, own in pairs)


def _settled(
    predictor: EpisodePredictor, whitening: WhiteningFilter, episode: Episode, theta: Array, start: Array, frozen: Array
) -> WhiteningFilter:
    # what an effect on inputs takes from a torque, its offset no longer has to: that is known without a rollout
    now, before = (
        predictor.corrected_inputs(episode, predictor.episode_theta(episode, t), ()).torque for t in (theta, frozen)
    )
    made = trial = _about(whitening, whitening.input_errors.torque_bias + np.mean(now - before, axis=0))
    for _ in range(_MAX_ROLLOUTS if np.any(whitening.input_errors.torque_bias_std > 0) else 0):
        own = replace(episode, input_errors=trial.input_errors)
        result = predictor.predict_episode(own, theta, start, False)
        if isinstance(result, str):
            break
        made, offset = trial, predictor.estimate_torque_bias(own, result, trial)
        trial = _about(made, offset)
        if _apart(trial, made) < _TORQUE_BIAS_TOLERANCE:
            break
    return made


def torque_bias_distance(some: Sequence[WhiteningFilter | None], others: Sequence[WhiteningFilter | None]) -> float:
    """Largest difference of the torque offsets of two sets of filters, in stated standard deviations."""
    pairs = zip(some, others, strict=True)
    return max((_apart(one, other) for one, other in pairs if one and other), default=0.0)


def _apart(one: WhiteningFilter, other: WhiteningFilter) -> float:
    stated = one.input_errors.torque_bias_std > 0
    apart = np.abs(one.input_errors.torque_bias - other.input_errors.torque_bias)
    return float(np.max(apart[stated] / one.input_errors.torque_bias_std[stated], initial=0.0))


def _about(whitening: WhiteningFilter, offset: Array) -> WhiteningFilter:
    return replace(whitening, input_errors=replace(whitening.input_errors, torque_bias=offset))
