"""Recordings as a model itself would measure them; a module of its own, so that other processes can import it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from yid_ocp.data import Recording
from yid_ocp.problem import EstimationProblem


def twin_recording(problem: EstimationProblem, x: np.ndarray, seed: int) -> Recording:
    """The problem's recording as the model itself would measure it, with the sensors' noise."""
    rng = np.random.default_rng(seed)
    evaluation = problem.evaluate(x, derivatives=False)
    assert evaluation.ok, evaluation.message
    recording = problem.episodes[0].recording
    groups = []
    for group, predicted in zip(recording.points, evaluation.episode_predictions[0].predicted_outputs, strict=True):
        count = len(predicted)
        position, std = group.position[:count], group.std[:count]
        seen = predicted.reshape(position.shape) + std * rng.standard_normal(position.shape)
        seen[~np.isfinite(position)] = np.nan
        groups.append(replace(group, t=group.t[:count], position=seen, std=std))
    return replace(recording, points=tuple(groups))
