"""Preparation of episodes before estimation: the observed initial equilibrium and the gear loads."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from yid_ocp.errors import DataError
from yid_ocp.problem.episodes import Episode
from yid_ocp.problem.inputs import own_loads
from yid_ocp.problem.measurements import Measurements
from yid_ocp.problem.outcome import Start
from yid_ocp.problem.prediction import Predictor

Array = NDArray[np.float64]

FIRST = 1.0
"""Latest time at which a point's first sample still shows the initial equilibrium [s]."""
ELSEWHERE = 5.0
"""Root mean square error of first points above which another equilibrium is sought [standard deviations]."""
NEARER = 0.5
"""Largest fraction of that error that may remain at another equilibrium."""


def prepared(predictor: Predictor, episode: Episode, theta: Array) -> Episode:
    """Episode with the initial equilibrium that its points show and with gear loads free of effort noise.

    Parameters
    ----------
    predictor : Predictor
    episode : Episode
    theta : ndarray, shape (ntheta,)
        Nominal parameters.
    """
    return _loaded(predictor, _at_rest(predictor, episode, theta), theta)


def _at_rest(predictor: Predictor, episode: Episode, theta: Array) -> Episode:
    """Episode with the equilibrium near its first points, where that of least energy is far from them.
    """
    fitted = episode.start is not None or predictor.options.initial_state == "fitted_to_points"
    if fitted or not predictor.system.grasps:
        return episode
    seen = [found for samples in episode.samples if (found := _first(samples, episode.grid.time_step)) is not None]
    if not seen:
        return episode
    own, n = predictor.own_theta(episode, theta), predictor.system.size
    offset = np.zeros(len(predictor.unknowns.start))
    least = predictor.start(episode, own, offset, ())
    error = _error(predictor, seen, least, own)
    if not error > ELSEWHERE:
        return episode
    try:
        shape = predictor.functions.start_fit.solve(episode.posture, seen, own, FIRST, episode.path).state[:n]
    except DataError:
        return episode
    other = predictor.start(episode, own, offset, (), shape)
    if not _error(predictor, seen, other, own) < NEARER * error:
        return episode
    return replace(episode, near=other.state[:n])


def _first(samples: Measurements, time_step: float) -> Measurements | None:
    """The first sample of points, as if it were taken at node 0; None where it comes too late."""
    rows = np.flatnonzero(samples.seen.any(axis=1))[:1]
    if not samples.sensor.points or not len(rows) or np.max(samples.node[rows]) * time_step > FIRST:
        return None
    parts = {name: getattr(samples, name)[rows] for name in ("value", "weight", "std")}
    return replace(samples, node=np.zeros(1, np.int64), fraction=np.zeros(1), correlation=None, **parts)


def _error(predictor: Predictor, seen: Sequence[Measurements], start: Start, theta: Array) -> float:
    """Root mean square error of first points at a start [standard deviations]; infinite where it is not at rest."""
    if start.message:
        return math.inf
    n, state = predictor.system.size, start.state[None]
    squares: list[Array] = []
    for samples in seen:
        read = predictor.functions.sensor(samples.sensor, predictor.unknowns.parameters)
        predicted = read(state[:, :n], state[:, 2 * n :], np.zeros((1, n)), theta)[0][:, :, 0]
        squares.append(samples.whitened(predicted)[samples.seen] ** 2)
    return float(np.sqrt(np.mean(np.concatenate(squares))))


def _loaded(predictor: Predictor, episode: Episode, theta: Array) -> Episode:
    """The episode with the model's own loads on the gears of joints whose efforts are compared; see `own_loads`."""
    compared, corrections = [s for s in episode.samples if s.sensor.efforts], predictor.functions.corrections
    if not compared or not corrections.angles_need_effort:
        return episode
    result = predictor.run(episode, theta, np.zeros(len(predictor.unknowns.start)), False)
    if isinstance(result, str):
        return episode
    load, own = episode.load.copy(), predictor.efforts(result.rollout)
    for samples in compared:
        at = [corrections.joints.index(joint) for joint in samples.sensor.efforts]
        column = [predictor.system.mechanism.joint_index(joint) for joint in samples.sensor.efforts]
        cutoff = predictor.options.path_cutoff
        load[:, at] = own_loads(load[:, at], own[:, column], samples.node, episode.grid.times, cutoff)
    return replace(episode, load=load)
