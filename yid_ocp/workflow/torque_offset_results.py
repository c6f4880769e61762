"""Estimated constant torque errors per recording, as plain data for results."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from yid_ocp.inference.whitening import (
    WhiteningFilter,
    estimate_torque_bias,
    estimate_torque_biases,
    held_out_whitened_at,
)
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.episodes import Episode

Array = NDArray[np.float64]
_OffsetsByRecording = dict[str, dict[str, dict[str, float]]]


def estimated_torque_offsets(problem: EstimationProblem, x: Array) -> _OffsetsByRecording:
    """Estimated torque offset by recording and joint: `value`, `std`, `prior_std` [N m], held-out included.

    Parameters
    ----------
    problem : EstimationProblem
        With weights frozen near `x` (`whitened_at`); where it has none, or offsets are no part of the model, there is
        nothing to say.
    x : ndarray, shape (nx,)
    """
    found: _OffsetsByRecording = {}
    if all(whitening is None for whitening in problem.whitening_filters):
        return found
    for episode, own in zip(problem.episodes, estimate_torque_biases(problem, x), strict=True):
        found |= _entry(problem, episode, own)
    apart = [e for e in problem.held_out if e.input_errors is not None and e.initial_state_shared_with is None]
    if not any(np.any(e.input_errors.torque_bias_std > 0) for e in apart if e.input_errors is not None):
        return found
    held = problem if any(problem.held_out_whitening_filters) else held_out_whitened_at(problem, x)
    for (episode, result), whitening in zip(held.predict_held_out(x), held.held_out_whitening_filters, strict=True):
        if (
            isinstance(whitening, WhiteningFilter)
            and not isinstance(result, str)
            and episode.initial_state_shared_with is None
        ):
            value = estimate_torque_bias(episode, result, whitening)
            found |= _entry(held, episode, (value, whitening.torque_bias_std))
    return found


def _entry(
    problem: EstimationProblem, episode: Episode, own: Sequence[Array] | None
) -> Mapping[str, dict[str, dict[str, float]]]:
    """One recording's part; empty where none of its torques may be off."""
    if own is None or episode.input_errors is None or not np.any(episode.input_errors.torque_bias_std > 0):
        return {}
    rows = zip(problem.system.driven, *own, episode.input_errors.torque_bias_std, strict=True)
    return {
        episode.name: {
            joint: {"value": float(value), "std": float(std), "prior_std": float(prior)}
            for joint, value, std, prior in rows
            if prior > 0
        }
    }
