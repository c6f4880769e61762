"""Data-quality checks on the residuals of a fit: drifting clocks and overstated noise."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from yid_ocp.analysis.data_quality.clock_synchronization import (
    N_TIME_BLOCKS,
    clock_drift_issue,
    clock_offset_tolerance,
    clock_sensitivities,
    estimate_clock_error,
)
from yid_ocp.data.issues import MIN_NOISE_DIFFERENCES, QUALITY_LIMITS, Issue
from yid_ocp.inference.null_test import residual_channels
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.episodes import EpisodePrediction
from yid_ocp.problem.evaluation import Evaluation
from yid_ocp.problem.measurements import Measurements

Array = NDArray[np.float64]

_MIN_EXPLAINED_FRACTION = 0.5
"""Part of what a fit leaves beyond noise that a drift has to explain."""


def check_fit_residuals(problem: EstimationProblem, x: Array, evaluation: Evaluation) -> list[Issue]:
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
    if not evaluation.ok or evaluation.jacobian is None or problem.data_noise_unit != 1.0:
        return []
    known = {(doubt.cause, doubt.recording, doubt.group) for doubt in problem.options.data_issues}
    found = [*_drifts(problem, x, evaluation), *_overstated(problem, evaluation)]
    return [doubt for doubt in found if (doubt.cause, doubt.recording, doubt.group) not in known]


def _drifts(problem: EstimationProblem, x: Array, evaluation: Evaluation) -> Iterator[Issue]:
    assert evaluation.jacobian is not None
    times = np.zeros(len(evaluation.residual))
    for series in residual_channels(problem):
        times[series.residual_indices] = series.t
    size = np.ones(len(problem.initial_unknowns))
    for i, (episode, result) in enumerate(zip(problem.episodes, evaluation.episode_predictions, strict=True)):
        joints, slices = episode.recording.joints, problem.residual_rows.measurements[i]
        own = slice(slices[0].start, slices[-1].stop) if slices else slice(0)
        for k, samples in enumerate(episode.measurements):
            group = next((g for g in episode.recording.points if g.name == samples.sensor.group_name), None)
            if (
                joints is None
                or group is None
                or samples.n_residuals < MIN_NOISE_DIFFERENCES
                or not samples.sensor.point_names
            ):
                continue
            late = _by_lateness(problem, x, i, samples, result)
            at = slice(slices[k].start - own.start, slices[k].stop - own.start)
            t = times[own]
            span = float(np.min(t[at])), float(np.max(t[at]))
            columns = np.zeros((len(t), 3))  # the first is for what a filter expects, which is no derivative
            columns[at, 1:] = clock_sensitivities(t[at], late[samples.is_used], span)
            whitening = problem.whitening_filters[i]
            if whitening is not None:
                columns = whitening.whiten(columns, None)[0]
            jacobian = evaluation.jacobian[own] * problem.unknown_scales
            error = estimate_clock_error(t, evaluation.residual[own], columns[:, 1:], jacobian, size, span)
            limit = clock_offset_tolerance(joints, group)
            if (
                error is None
                or not error.has_drift
                or not abs(error.accumulated_drift) > limit
                or not error.explained_excess_fraction > _MIN_EXPLAINED_FRACTION
            ):
                continue
            yield clock_drift_issue(error, group.name, limit, True)


def _by_lateness(
    problem: EstimationProblem, x: Array, i: int, samples: Measurements, result: EpisodePrediction
) -> Array:
    """Whitened prediction less measurement per second that the stamps are late, shape (M, k)."""
    theta = problem.predictor.episode_theta(problem.episodes[i], problem.split(x, i)[0])
    state = result.rollout.state
    none = np.zeros((*state.shape, len(problem.unknowns.free_parameters)))
    steps = np.ones(samples.value.shape[1])
    ahead, behind = (
        problem.predictor.readings_along_trajectory(samples.delayed_by(s * steps), state, none, theta)[0]
        for s in (-1.0, 1.0)
    )
    return np.asarray(samples.weight * (ahead - behind) / (2 * problem.step.time_step))


def _overstated(problem: EstimationProblem, evaluation: Evaluation) -> Iterator[Issue]:
    """Groups whose residuals, also summed over blocks of time as what lasts for long sums up, are far below noise."""
    by_group: dict[str, list[tuple[float, float, int]]] = {}
    units = {}
    for series in residual_channels(problem):
        r = evaluation.residual[series.residual_indices]
        if len(r) < MIN_NOISE_DIFFERENCES:
            continue
        sums = np.array([part.sum() / math.sqrt(len(part)) for part in np.array_split(r, N_TIME_BLOCKS)])
        by_group.setdefault(series.group, []).append(
            (float(r @ r), float(sums @ sums) / N_TIME_BLOCKS * len(r), len(r))
        )
        units[series.group] = series.unit
    for group, parts in by_group.items():
        count = sum(entry[2] for entry in parts)
        free = count - len(problem.initial_unknowns)
        if free < 0.5 * count:
            continue
        seen = math.sqrt(max(sum(entry[i] for entry in parts) for i in (0, 1)) / free)
        if not seen < 1 / QUALITY_LIMITS.max_overstatement_ratio:
            continue
        stated = [s.std[s.is_used] for e in problem.episodes for s in e.measurements if s.sensor.group_name == group]
        usual = float(np.median(np.concatenate(stated)))
        yield Issue(
            "noise_overstated",
            f"the fit leaves {seen * usual:.2g} {units[group]} of {group}, all slow errors counted; "
            f"{usual:.2g} {units[group]} is stated",
            "warning",
            1 / (QUALITY_LIMITS.max_overstatement_ratio * max(seen, 1e-9)),
            "state the noise that is there: as stated every ± is too wide, and a small gap is not seen",
            "",
            group.partition(".")[0],
            setting="" if problem.has_process_noise else f"sensors.{group}.std: {seen * usual:.2g}",
        )
