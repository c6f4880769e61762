"""Estimation of the initial state of held-out recordings."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from yid_ocp.problem.episodes import Episode, beginning
from yid_ocp.problem.prediction import Predictor
from yid_ocp.problem.unknowns import start_limits

Array = NDArray[np.float64]
HELD_OUT_START = 0.2
"""Duration of the data from which a held-out recording's initial state is estimated [s]."""
HELD_OUT_ITERATIONS = 3
"""Gauss-Newton iterations of this nearly linear estimate."""


def held_out_offset(predictor: Predictor, episode: Episode, theta: Array, std: Array) -> Array:
    """Offset of the initial state from equilibrium, estimated from the first `HELD_OUT_START` seconds and its prior.

    Zero where the rollout fails; `std` is the prior's, (number of estimated rows,).
    """
    offset = np.zeros(len(predictor.unknowns.start))
    if not len(offset):
        return offset
    short = beginning(episode, max(round(HELD_OUT_START / predictor.step.time_step), 2))
    weight, guess, limit = 1.0 / std, None, start_limits(predictor.system, predictor.unknowns.start)
    for _ in range(HELD_OUT_ITERATIONS):
        result = predictor.run(short, theta, offset, True, guess)
        if isinstance(result, str) or result.sensitivities is None:
            return np.zeros(len(predictor.unknowns.start))
        guess = result.warm
        rows, slopes = [weight * offset], [np.diag(weight)]
        for k, samples in enumerate(short.samples):
            by_start = result.sensitivities[k][:, :, len(predictor.unknowns.parameters) :]
            part = samples.rows(result.predicted[k], by_start)
            rows.append(part.residual)
            slopes += [] if part.jacobian is None else [part.jacobian]
        offset = offset - np.linalg.lstsq(np.vstack(slopes), np.concatenate(rows), rcond=None)[0]
        offset = np.clip(offset, -limit, limit)
    return offset
