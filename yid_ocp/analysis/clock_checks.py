"""Offset and drift of point clocks relative to the joint clock, and checks of a fit's residuals.

A point that is seen at the stamp t is where it was at t - late - drift (t - middle), so that to first order

    expected - seen = speed (late + drift (t - middle)) + what else the expected place may be wrong by,

which is linear. Standard deviations count that errors of neighbouring samples are alike (blocks of time, Cameron,
Gelbach, Miller 2011, doi:10.1198/jbes.2010.07136). Only motion tells: at rest the columns of both are zero.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import scipy.optimize
from numpy.typing import NDArray

from yid_ocp.analysis.joint_checks import effect_setting_line
from yid_ocp.data.issues import MIN_NOISE_DIFFERENCES, QUALITY_LIMITS, Issue, Severity, median_sample_period
from yid_ocp.data.recording import JointGroup, PointGroup
from yid_ocp.inference.null_test import residual_channels
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.episodes import EpisodePrediction
from yid_ocp.problem.evaluation import Evaluation
from yid_ocp.problem.measurements import Measurements

Array = NDArray[np.float64]

PositionFunction = Callable[[Array], Array]
"""From times on the joints' clock (N,) to places (N, np, 3) [m]."""

_MIN_Z = 5.0  # standard deviations from which on a clock's error counts
_MAX_EXPOSURE_TIME = 0.04
"""No sensor takes longer for one sample: a slow camera knows when a frame was taken better than to its period [s]."""
_N_TIME_BLOCKS = 10  # blocks of time whose errors count as independent of each other
_MAX_DRIFT = 0.05  # part by which clocks that were meant to agree may run apart
_DRIFT_SEARCH_STEP = 0.2  # how far clocks run apart between two drifts that are tried first [s]
_N_RELINEARIZATIONS = 3  # so many times a fit is repeated at the times that the last one found
_MIN_EXPLAINED_FRACTION = 0.5  # part of what a fit leaves beyond noise that a drift has to explain
_FRAME_ERROR_STD, _ENCODER_ZERO_STD = 0.02, 0.02
"""Usual errors of a frame [m, rad] and of an encoder's zero [rad], which must not pass for a clock's."""


@dataclass(frozen=True)
class ClockError:
    """Offset and drift of one point group's clock relative to the joint clock, with standard deviations.

    Attributes
    ----------
    stamp_delay, stamp_delay_std : float
        Recorded stamp minus true time, in the middle of the group [s].
    relative_drift, relative_drift_std : float
        Relative rate by which the group's clock runs faster; 0.001 is one part per thousand.
    explained_excess_fraction : float
        Fraction of the residual sum of squares above the noise level that both explain; NaN where none is above.
    """

    first_time: float
    last_time: float
    stamp_delay: float
    stamp_delay_std: float
    relative_drift: float
    relative_drift_std: float
    explained_excess_fraction: float

    @property
    def accumulated_drift(self) -> float:
        """Drift accumulated from the first to the last time [s]."""
        return self.relative_drift * (self.last_time - self.first_time)

    @property
    def has_drift(self) -> bool:
        """Whether the drift is significant."""
        return abs(self.relative_drift) > _MIN_Z * self.relative_drift_std

    @property
    def has_delay(self) -> bool:
        """Whether the offset is significant."""
        return abs(self.stamp_delay) > _MIN_Z * self.stamp_delay_std


def clock_offset_tolerance(joints: JointGroup, group: PointGroup) -> float:
    """Clock offset that cannot be resolved below the sample periods [s]."""
    return 0.5 * (median_sample_period(joints.t) + min(median_sample_period(group.t), _MAX_EXPOSURE_TIME))


def clock_sensitivities(t: Array, speed: Array, span: tuple[float, float]) -> Array:
    """Derivatives of predicted values by the clock offset and by the accumulated drift, shape (R, 2)."""
    return np.stack([speed, speed * (t - 0.5 * sum(span)) / max(span[1] - span[0], 1e-9)], axis=1)


def estimate_clock_error(
    t: Array, residual: Array, own: Array, others: Array, size: Array, span: tuple[float, float]
) -> ClockError | None:
    """Estimate a clock's offset and drift from a residual by least squares, together with other unknowns.

    Parameters
    ----------
    t : ndarray, shape (R,)
    residual : ndarray, shape (R,)
        Expected less seen, in units of the noise.
    own : ndarray, shape (R, 2)
        Its derivatives by offset and accumulated drift; see `clock_sensitivities` [1/s].
    others : ndarray, shape (R, k)
        Its derivatives by other unknowns, whose usual sizes are `size`.
    size : ndarray, shape (k,)
    span : (float, float)
        First and last time of the group [s].

    Returns
    -------
    ClockError or None
        None where the motion is not informative.
    """
    begin, end = span
    length, data = max(end - begin, 1e-9), len(t)
    if not np.all(np.sum(own**2, axis=0) > 0) or data < 3 * _N_TIME_BLOCKS:
        return None
    rows = np.vstack([np.hstack([own, others]), np.hstack([np.zeros((len(size), 2)), np.diag(1 / size)])])
    target = np.concatenate([residual, np.zeros(len(size))])
    scale = np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
    inverse = np.linalg.pinv((rows / scale).T @ (rows / scale), rcond=1e-12, hermitian=True) / np.outer(scale, scale)
    found = inverse @ (rows.T @ target)
    remains = target - rows @ found
    plain = rows[:, 2:]
    base = target - plain @ np.linalg.lstsq(plain, target, rcond=None)[0]
    after, before = (float(np.sum(x[:data] ** 2)) for x in (remains, base))
    block = np.clip(((t - begin) / length * _N_TIME_BLOCKS).astype(int), 0, _N_TIME_BLOCKS - 1)
    scores = np.zeros((_N_TIME_BLOCKS, rows.shape[1]))
    np.add.at(scores, block, rows[:data] * remains[:data, None])
    middle = scores.T @ scores * _N_TIME_BLOCKS / (_N_TIME_BLOCKS - 1)
    mean_square = max(after / max(data - 2 - len(size), 1), 1.0)
    spread = np.maximum(np.diag(inverse @ middle @ inverse), mean_square * np.diag(inverse))
    std = np.sqrt(spread)
    beyond = before - data
    excess = (before - after) / beyond if beyond > 0 else math.nan
    return ClockError(
        begin, end, float(found[0]), float(std[0]), float(found[1]) / length, float(std[1]) / length, float(excess)
    )


def check_held_point_clock(
    joints: JointGroup, group: PointGroup, t: Array, seen: Array, by_angle: Array, std: float, path: PositionFunction
) -> Iterator[Issue]:
    """Issues of clock offset or drift of points whose positions follow from the joint angles.

    Parameters
    ----------
    t : ndarray, shape (N,)
        Times at which they are compared.
    seen : ndarray, shape (N, np, 3)
        [m]
    by_angle : ndarray, shape (N, np, 3, k)
        Derivative of their places by the angles.
    std : float
        Noise of the points [m]; zero where nobody says.
    """
    begin, end, step = float(t[0]), float(t[-1]), 0.5 * median_sample_period(joints.t)
    shifted = np.broadcast_to(np.eye(3), (*seen.shape, 3))
    size = np.concatenate([np.full(by_angle.shape[3], _ENCODER_ZERO_STD), np.full(6, _FRAME_ERROR_STD)])
    late = drift = 0.0
    found: ClockError | None = None
    for _ in range(_N_RELINEARIZATIONS):
        at = t - late - drift * (t - 0.5 * (begin + end))
        place, speed = path(at), (path(at + step) - path(at - step)) / (2 * step)
        good = np.isfinite(seen) & ((at > joints.t[0]) & (at < joints.t[-1]))[:, None, None]
        if not good.any():
            return
        noise = std if std > 0 else max(float(np.sqrt(np.mean((seen - place)[good] ** 2))), 1e-9)
        middle = place[good.all(axis=2)].mean(axis=0)
        turned = np.stack([np.cross(axis, place - middle) for axis in np.eye(3)], axis=3)
        others = np.concatenate([by_angle, shifted, turned], axis=3)[good] / noise
        when = np.broadcast_to(t[:, None, None], seen.shape)[good]
        own = clock_sensitivities(when, speed[good] / noise, (begin, end))
        more = estimate_clock_error(when, (place - seen)[good] / noise, own, others, size, (begin, end))
        if more is None:
            return
        late, drift = late + more.stamp_delay, drift + more.relative_drift
        found = replace(more, first_time=begin, last_time=end, stamp_delay=late, relative_drift=drift)
    assert found is not None
    moved = float(np.sqrt(np.mean(np.sum(speed**2, axis=2))))
    yield from _said(found, joints, group, moved * max(abs(found.stamp_delay), abs(found.accumulated_drift)) > noise)


def _said(found: ClockError, joints: JointGroup, group: PointGroup, matters: bool) -> Iterator[Issue]:
    limit, late, std = clock_offset_tolerance(joints, group), found.stamp_delay, found.stamp_delay_std
    if found.has_drift and abs(found.accumulated_drift) > limit:
        yield _clock_drift_issue(found, group.name, limit, matters)
    elif found.has_delay and abs(late) > limit:
        words = (
            f"{group.name} is stamped {1e3 * late:+.3g} ± {1e3 * std:.2g} ms from the joints; "
            f"{1e3 * limit:.3g} ms are in doubt anyway, as samples stand for a period"
        )
        camera = "camera" in group.name.lower() or "camera" in group.sensor.lower() or group.pose is not None
        setting = f"sensors.{group.name}.use: false"
        if camera and late > 0:
            setting = effect_setting_line("camera_latency", "camera", "delay", late)
        advice, severity = f"subtract {late:.3g} s from their times", _severity(matters)
        yield Issue("clock_offset", words, severity, abs(late) / limit, advice, "", group.name, "t", setting=setting)


def _severity(matters: bool) -> Severity:
    return "not_trusted" if matters else "warning"


def _clock_drift_issue(found: ClockError, group: str, limit: float, matters: bool) -> Issue:
    """The data-quality issue of a drifting point clock."""
    late, drift, whole = found.stamp_delay, found.relative_drift, found.accumulated_drift
    words = (
        f"{group} is stamped {1e3 * (late - 0.5 * whole):+.3g} ms from the joints at its beginning, "
        f"{1e3 * (late + 0.5 * whole):+.3g} ms at its end: its clock runs {1e3 * abs(drift):.2g} ± "
        f"{1e3 * found.relative_drift_std:.1g} parts per thousand too {'fast' if drift > 0 else 'slowly'}"
    )
    advice = timestamp_correction(late, drift, 0.5 * (found.first_time + found.last_time))
    setting = f"sensors.{group}.use: false"
    return Issue("clock_drift", words, _severity(matters), abs(whole) / limit, advice, "", group, "t", setting=setting)


def timestamp_correction(late: float, drift: float, middle: float) -> str:
    """Advice on how to correct time stamps with an offset and a drift."""
    return f"replace its times t by t {-late:+.4g} {-drift:+.4g} (t - {middle:.6g})"


# -- clocks that are far apart ----------------------------------------------------------------------------------------


def search_clock_error(
    path: PositionFunction, knots: tuple[float, float], t: Array, seen: Array, drifts: bool = False
) -> tuple[float, float]:
    """Clock offset [s] and relative drift that bring points nearest to a path, by a coarse-to-fine search.

    Parameters
    ----------
    knots : (float, float)
        First and last time at which it is known [s].
    t : ndarray, shape (N,)
    seen : ndarray, shape (N, np, 3)
        [m]
    drifts : bool
        Whether the clock may run apart as well, by up to `_MAX_DRIFT`.
    """
    middle, span = 0.5 * float(t[0] + t[-1]), float(t[-1] - t[0])

    def error(late: float, drift: float) -> float:
        at = t - late - drift * (t - middle)
        inside = (at >= knots[0]) & (at <= knots[1])
        if inside.sum() <= max(3, len(t) // 2):
            return math.inf
        return float(np.nanmean(np.sum((seen[inside] - path(at[inside])) ** 2, axis=2)))

    def nearest(drift: float, *searches: tuple[float, int]) -> tuple[float, float]:
        late = 0.0
        for step, reach in searches:
            late = min((late + step * k for k in range(-reach, reach + 1)), key=lambda one: error(one, drift))
        return error(late, drift), late

    width = 0.5 * (knots[1] - knots[0])
    if not drifts:
        return nearest(0.0, (width / 100, 100), (width / 1000, 12), (width / 10000, 12))[1], 0.0
    trials = np.linspace(-_MAX_DRIFT, _MAX_DRIFT, 1 + 2 * int(np.clip(_MAX_DRIFT * span / _DRIFT_SEARCH_STEP, 10, 100)))
    _, late, drift = min((*nearest(float(rate), (width / 48, 12), (width / 400, 8)), float(rate)) for rate in trials)
    fine = scipy.optimize.minimize(
        lambda x: min(error(x[0], x[1] / span), 1e300), [late, drift * span], method="Nelder-Mead"
    )
    return float(fine.x[0]), float(fine.x[1]) / span


# -- residuals of a fit ------------------------------------------------------------------------------------------------


def check_fit_residuals(problem: EstimationProblem, x: Array, evaluation: Evaluation) -> list[Issue]:
    """New data-quality issues found in the residuals of a fit: drifting clocks and overstated noise.

    A constant offset of a camera's clock looks like damping that the model lacks; to tell the two is a diagnosis's task
    (effect `camera_latency`). One that grows over a recording is a clock's.
    """
    if not evaluation.ok or evaluation.jacobian is None or problem.data_noise_unit != 1.0:
        return []
    known = {(issue.cause, issue.recording, issue.group) for issue in problem.options.data_issues}
    found = [*_drifts(problem, x, evaluation), *_overstated(problem, evaluation)]
    return [issue for issue in found if (issue.cause, issue.recording, issue.group) not in known]


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
            few = samples.n_residuals < MIN_NOISE_DIFFERENCES
            if joints is None or group is None or few or not samples.sensor.point_names:
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
            if error is None or not error.has_drift or not abs(error.accumulated_drift) > limit:
                continue
            if error.explained_excess_fraction > _MIN_EXPLAINED_FRACTION:
                yield _clock_drift_issue(error, group.name, limit, True)


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
        sums = np.array([part.sum() / math.sqrt(len(part)) for part in np.array_split(r, _N_TIME_BLOCKS)])
        entry = float(r @ r), float(sums @ sums) / _N_TIME_BLOCKS * len(r), len(r)
        by_group.setdefault(series.group, []).append(entry)
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
        unit, least = units[group], QUALITY_LIMITS.max_overstatement_ratio
        words = (
            f"the fit leaves {seen * usual:.2g} {unit} of {group}, all slow errors counted; "
            f"{usual:.2g} {unit} is stated"
        )
        advice = "state the noise that is there: as stated every ± is too wide, and a small gap is not seen"
        setting = "" if problem.has_process_noise else f"sensors.{group}.std: {seen * usual:.2g}"
        severity = 1 / (least * max(seen, 1e-9))
        where = group.partition(".")[0]
        yield Issue("noise_overstated", words, "warning", severity, advice, "", where, setting=setting)
