"""Estimation of the initial state of held-out recordings."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from yid_ocp.problem.episode_prediction import EpisodePredictor
from yid_ocp.problem.episodes import Episode, truncate_episode
from yid_ocp.problem.unknown_vector import initial_state_limits

Array = NDArray[np.float64]
_HELD_OUT_START_WINDOW = 0.2
"""Duration of the data from which a held-out recording's initial state is estimated [s]."""
_HELD_OUT_ITERATIONS = 3
"""Gauss-Newton iterations of this nearly linear estimate."""


def estimate_initial_state_offset(predictor: EpisodePredictor, episode: Episode, theta: Array, std: Array) -> Array:
    """Offset of the initial state from equilibrium, estimated from the first `_HELD_OUT_START_WINDOW` seconds and its prior.

    Zero where the rollout fails; `std` is the prior's, (number of estimated rows,).
    """
    offset = np.zeros(len(predictor.unknowns.initial_state_names))
    if not len(offset):
        return offset
    short = truncate_episode(episode, max(round(_HELD_OUT_START_WINDOW / predictor.step.time_step), 2))
    weight, guess, limit = (
        1.0 / std,
        None,
        initial_state_limits(predictor.system, predictor.unknowns.initial_state_names),
    )
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
