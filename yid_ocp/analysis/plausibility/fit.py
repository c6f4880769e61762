"""Data-quality checks on the residuals of a fit: drifting clocks and overstated noise."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from yid_ocp.analysis.plausibility.clocks import BLOCKS, allowed, by_clock, clock_error, drift_doubt
from yid_ocp.data.doubt import FEWEST, LIMITS, Doubt
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.evaluation import Evaluation
from yid_ocp.problem.measurements import Measurements
from yid_ocp.problem.null_test import residual_series
from yid_ocp.problem.outcome import EpisodeResult

Array = NDArray[np.float64]

EXPLAINS = 0.5
"""Part of what a fit leaves beyond noise that a drift has to explain."""


def check_fit(problem: EstimationProblem, x: Array, evaluation: Evaluation) -> list[Doubt]:
    """New data-quality issues found in the residuals of a fit: drifting clocks and overstated noise.

    A constant offset of a camera's clock looks like damping that the model lacks; to tell the two is a diagnosis's task
    (effect `camera_latency`). One that grows over a recording is a clock's.

    Parameters
    ----------
    problem : EstimationProblem
    x : ndarray, shape (nx,)
        The fitted unknowns.
    evaluation : Evaluation
        At `x`.
    """
    if not evaluation.ok or evaluation.jacobian is None or problem.noise != 1.0:
        return []
    known = {(doubt.cause, doubt.recording, doubt.group) for doubt in problem.options.doubts}
    found = [*_drifts(problem, x, evaluation), *_overstated(problem, evaluation)]
    return [doubt for doubt in found if (doubt.cause, doubt.recording, doubt.group) not in known]


def _drifts(problem: EstimationProblem, x: Array, evaluation: Evaluation) -> Iterator[Doubt]:
    assert evaluation.jacobian is not None
    times = np.zeros(len(evaluation.residual))
    for series in residual_series(problem):
        times[series.rows] = series.t
    size = np.ones(len(problem.start))
    for i, (episode, result) in enumerate(zip(problem.episodes, evaluation.episodes, strict=True)):
        joints, slices = episode.recording.joints, problem.rows.measurements[i]
        own = slice(slices[0].start, slices[-1].stop) if slices else slice(0)
        for k, samples in enumerate(episode.samples):
            group = next((g for g in episode.recording.points if g.name == samples.sensor.group), None)
            if joints is None or group is None or samples.count < FEWEST or not samples.sensor.points:
                continue
            late = _by_lateness(problem, x, i, samples, result)
            at = slice(slices[k].start - own.start, slices[k].stop - own.start)
            t = times[own]
            span = float(np.min(t[at])), float(np.max(t[at]))
            columns = np.zeros((len(t), 3))  # the first is for what a filter expects, which is no derivative
            columns[at, 1:] = by_clock(t[at], late[samples.seen], span)
            whitening = problem.innovations[i]
            if whitening is not None:
                columns = whitening.whitened(columns, None)[0]
            jacobian = evaluation.jacobian[own] * problem.scales
            error = clock_error(t, evaluation.residual[own], columns[:, 1:], jacobian, size, span)
            limit = allowed(joints, group)
            if error is None or not error.drifts or not abs(error.apart) > limit or not error.excess > EXPLAINS:
                continue
            yield drift_doubt(error, group.name, limit, True)


def _by_lateness(problem: EstimationProblem, x: Array, i: int, samples: Measurements, result: EpisodeResult) -> Array:
    """Whitened prediction less measurement per second that the stamps are late, shape (M, k)."""
    theta = problem.predictor.own_theta(problem.episodes[i], problem.split(x, i)[0])
    state = result.rollout.state
    none = np.zeros((*state.shape, len(problem.unknowns.parameters)))
    steps = np.ones(samples.value.shape[1])
    ahead, behind = (problem.predictor.along(samples.late(s * steps), state, none, theta)[0] for s in (-1.0, 1.0))
    return np.asarray(samples.weight * (ahead - behind) / (2 * problem.step.time_step))


def _overstated(problem: EstimationProblem, evaluation: Evaluation) -> Iterator[Doubt]:
    """Groups whose residuals, also summed over blocks of time as what lasts for long sums up, are far below noise."""
    by_group: dict[str, list[tuple[float, float, int]]] = {}
    units = {}
    for series in residual_series(problem):
        r = evaluation.residual[series.rows]
        if len(r) < FEWEST:
            continue
        sums = np.array([part.sum() / math.sqrt(len(part)) for part in np.array_split(r, BLOCKS)])
        by_group.setdefault(series.group, []).append((float(r @ r), float(sums @ sums) / BLOCKS * len(r), len(r)))
        units[series.group] = series.unit
    for group, parts in by_group.items():
        count = sum(entry[2] for entry in parts)
        free = count - len(problem.start)
        if free < 0.5 * count:
            continue
        seen = math.sqrt(max(sum(entry[i] for entry in parts) for i in (0, 1)) / free)
        if not seen < 1 / LIMITS.overstated:
            continue
        stated = [s.std[s.seen] for e in problem.episodes for s in e.samples if s.sensor.group == group]
        usual = float(np.median(np.concatenate(stated)))
        yield Doubt(
            "noise_overstated",
            f"the fit leaves {seen * usual:.2g} {units[group]} of {group}, all slow errors counted; "
            f"{usual:.2g} {units[group]} is stated",
            "warning",
            1 / (LIMITS.overstated * max(seen, 1e-9)),
            "state the noise that is there: as stated every ± is too wide, and a small gap is not seen",
            "",
            group.partition(".")[0],
            setting="" if problem.disturbed else f"sensors.{group}.std: {seen * usual:.2g}",
        )
