"""Relinearization of whitening filters about the constant torque errors estimated at other unknowns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from yid_ocp.problem.episodes import Episode
from yid_ocp.problem.noise import Innovations
from yid_ocp.problem.prediction import Predictor

Array = NDArray[np.float64]
ROUNDS = 6
"""Largest number of rollouts, each about the torque offset estimated from the one before."""
NEAR = 0.05
"""Change of the torque offset, in stated standard deviations, below which the iteration ends."""


def filters_about(
    predictor: Predictor,
    known: Sequence[Innovations | None],
    at: Sequence[tuple[Episode, Array, Array, Array]],
) -> tuple[Innovations | None, ...]:
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


def with_errors(episodes: Sequence[Episode], known: Sequence[Innovations | None]) -> tuple[Episode, ...]:
    """Episodes with the input errors about which their filters are linearized."""
    pairs = zip(episodes, known, strict=True)
    return tuple(episode if own is None else replace(episode, errors=own.errors) for episode, own in pairs)


def _settled(
    predictor: Predictor, whitening: Innovations, episode: Episode, theta: Array, start: Array, frozen: Array
) -> Innovations:
    # what an effect on inputs takes from a torque, its offset no longer has to: that is known without a rollout
    now, before = (predictor.inputs(episode, predictor.own_theta(episode, t), ()).torque for t in (theta, frozen))
    made = trial = _about(whitening, whitening.errors.offset + np.mean(now - before, axis=0))
    for _ in range(ROUNDS if np.any(whitening.errors.bias_std > 0) else 0):
        own = replace(episode, errors=trial.errors)
        result = predictor.run(own, theta, start, False)
        if isinstance(result, str):
            break
        made, offset = trial, predictor.torque_offset(own, result, trial)
        trial = _about(made, offset)
        if _apart(trial, made) < NEAR:
            break
    return made


def torques_apart(some: Sequence[Innovations | None], others: Sequence[Innovations | None]) -> float:
    """Largest difference of the torque offsets of two sets of filters, in stated standard deviations."""
    pairs = zip(some, others, strict=True)
    return max((_apart(one, other) for one, other in pairs if one and other), default=0.0)


def _apart(one: Innovations, other: Innovations) -> float:
    stated = one.errors.bias_std > 0
    apart = np.abs(one.errors.offset - other.errors.offset)
    return float(np.max(apart[stated] / one.errors.bias_std[stated], initial=0.0))


def _about(whitening: Innovations, offset: Array) -> Innovations:
    return replace(whitening, errors=replace(whitening.errors, offset=offset))
