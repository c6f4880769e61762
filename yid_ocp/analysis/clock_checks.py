"""Checks of the clocks of measured points for an offset or drift relative to the clock of the joints.

A point with the time stamp t was measured at the time t - late - drift (t - middle), where `middle` is the middle of
the recorded time. The position expected at the time t differs from the measured one, to first order, by

    expected - seen = speed (late + drift (t - middle)) + other errors of the expected position,

which is linear in the unknowns `late` [s] and `drift`. A point at rest gives no information. The standard deviations
account for correlated errors in blocks of time (Cameron, Gelbach, Miller 2011, doi:10.1198/jbes.2010.07136).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import scipy.optimize

from yid_ocp.analysis.joint_checks import known_effect_config_line
from yid_ocp.arrays import Array
from yid_ocp.data.channel_checks import (
    MIN_DIFFERENCES_FOR_NOISE_STD,
    QUALITY_LIMITS,
    Issue,
    IssueSeverity,
    median_sample_period,
)
from yid_ocp.data.recording import JointGroup, PointGroup
from yid_ocp.inference.null_test import channels_with_residual_indices, times_since_recording_start
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.episodes import EpisodePrediction
from yid_ocp.problem.evaluation import Evaluation
from yid_ocp.problem.measurements import SensorMeasurements
from yid_ocp.sensors import SensorOptions
from yid_ocp.solvers import base as solvers

PositionsAtTimesFunction = Callable[[Array], Array]  # N times on the joints' clock (N,) to points (N, np, 3) [m]


_MIN_Z = 5.0  # standard deviations from which on a clock's error counts
_MAX_EXPOSURE_TIME = 0.04  # of a sample: a slow camera knows the time of a frame better than its period [s]
_N_TIME_BLOCKS = 10  # blocks of time whose errors count as independent of each other
_MAX_DRIFT = 0.05  # largest relative drift of clocks that should agree
_DRIFT_SEARCH_STEP = 0.2  # difference of the total drift between two trials [s]
_N_RELINEARIZATIONS = 3  # repetitions of a fit at the corrected times
_MAX_CLOCK_SHIFT_Z = 2.0  # stated standard deviations by which a clock may be off without an issue
_MAX_CLOCK_RESIDUE = 0.5  # rms error of a corrected path per noise, which adds a quarter to chi2 per degree of freedom
_MIN_EXPLAINED_FRACTION = 0.5  # fraction of the residual beyond noise that a drift must explain
# For the residual of a fit: a longer delay is beyond the linear model, in which it seems to be a drift as well.
_MAX_DELAY_PER_DRIFT = 2.0
# Usual errors of a frame [m, rad] and of an encoder's zero [rad], which must not be attributed to a clock.
_FRAME_ERROR_STD, _ENCODER_ZERO_STD = 0.02, 0.02


@dataclass(frozen=True)
class _ClockError:
    """Clock error of a group: stamp minus true time [s] in the middle of `span`, and relative rate of a fast clock."""

    span: tuple[float, float]
    delay: float
    delay_std: float
    drift: float
    drift_std: float
    explained: float  # explained fraction of the squared residual above noise; NaN without any

    @property
    def whole_drift(self) -> float:
        """Drift accumulated from the first to the last time [s]."""
        return self.drift * (self.span[1] - self.span[0])

    def drifts_beyond(self, limit: float) -> bool:
        """Return whether the drift is significant and its total exceeds a limit [s]."""
        return abs(self.drift) > _MIN_Z * self.drift_std and abs(self.whole_drift) > limit


def _offset_tolerance(joints: JointGroup, group: PointGroup) -> float:
    """Return the largest clock offset [s] that is too small to be resolved with the sample periods of both groups."""
    return 0.5 * (median_sample_period(joints.t) + min(median_sample_period(group.t), _MAX_EXPOSURE_TIME))


def _clock_error(
    t: Array, residual: Array, speed: Array, others: Array, size: Array, span: tuple[float, float]
) -> _ClockError | None:
    """Estimate offset and drift from a residual (R,), with derivatives `speed` by them and `others` of std `size`."""
    length, data = max(span[1] - span[0], 1e-9), len(t)
    if not np.all(np.sum(speed**2, axis=0) > 0) or data < 3 * _N_TIME_BLOCKS:
        return None
    rows = np.vstack([np.hstack([speed, others]), np.hstack([np.zeros((len(size), 2)), np.diag(1 / size)])])
    target = np.concatenate([residual, np.zeros(len(size))])
    scale = np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
    inverse = np.linalg.pinv((rows / scale).T @ (rows / scale), rcond=1e-12, hermitian=True) / np.outer(scale, scale)
    found = inverse @ (rows.T @ target)
    remains = target - rows @ found
    base = target - rows[:, 2:] @ np.linalg.lstsq(rows[:, 2:], target, rcond=None)[0]
    after, before = (float(np.sum(x[:data] ** 2)) for x in (remains, base))
    block = np.clip(((t - span[0]) / length * _N_TIME_BLOCKS).astype(int), 0, _N_TIME_BLOCKS - 1)
    scores = np.zeros((_N_TIME_BLOCKS, rows.shape[1]))
    np.add.at(scores, block, rows[:data] * remains[:data, None])
    middle = scores.T @ scores * _N_TIME_BLOCKS / (_N_TIME_BLOCKS - 1)
    mean_square = max(after / max(data - 2 - len(size), 1), 1.0)
    std = np.sqrt(np.maximum(np.diag(inverse @ middle @ inverse), mean_square * np.diag(inverse)))
    explained = (before - after) / (before - data) if before > data else math.nan
    delay, drift = zip(found[:2].tolist(), std[:2].tolist(), strict=True)
    return _ClockError(span, *delay, drift[0] / length, drift[1] / length, explained)


def _by_clock(t: Array, speed: Array, span: tuple[float, float]) -> Array:
    """Return the derivatives (R, 2) of predicted values by the clock's offset and by its total drift over `span`."""
    return np.stack([speed, speed * (t - 0.5 * sum(span)) / max(span[1] - span[0], 1e-9)], axis=1)


def robot_held_point_clock_issues(
    joints: JointGroup,
    group: PointGroup,
    t: Array,
    seen: Array,
    by_angle: Array,
    std: float,
    path: PositionsAtTimesFunction,
) -> Iterator[Issue]:
    """Yield an issue if the clock of points on the robot has an offset or drift relative to the clock of the joints.

    The measured positions `seen` (N, np, 3) [m] at the times `t` (N,) are compared with the positions that `path`
    computes from the joint angles at given times. `by_angle` (N, np, 3, k) is the derivative of these positions with
    respect to the k angles. `std` is the standard deviation of the points' noise [m], zero if unknown.
    """
    span, step = (float(t[0]), float(t[-1])), 0.5 * median_sample_period(joints.t)
    shifted = np.broadcast_to(np.eye(3), (*seen.shape, 3))
    size = np.concatenate([np.full(by_angle.shape[3], _ENCODER_ZERO_STD), np.full(6, _FRAME_ERROR_STD)])
    late = drift = 0.0
    for _ in range(_N_RELINEARIZATIONS):
        at = t - late - drift * (t - 0.5 * sum(span))
        place, speed = path(at), (path(at + step) - path(at - step)) / (2 * step)
        good = np.isfinite(seen) & ((at > joints.t[0]) & (at < joints.t[-1]))[:, None, None]
        if not good.any():
            return
        noise = std if std > 0 else max(float(np.sqrt(np.mean((seen - place)[good] ** 2))), 1e-9)
        middle = place[good.all(axis=2)].mean(axis=0)
        turned = np.stack([np.cross(axis, place - middle) for axis in np.eye(3)], axis=3)
        others = np.concatenate([by_angle, shifted, turned], axis=3)[good] / noise
        when = np.broadcast_to(t[:, None, None], seen.shape)[good]
        own = _by_clock(when, speed[good] / noise, span)
        more = _clock_error(when, (place - seen)[good] / noise, own, others, size, span)
        if more is None:
            return
        late, drift = late + more.delay, drift + more.drift
    assert more is not None
    found = replace(more, delay=late, drift=drift)
    moved, limit = float(np.sqrt(np.mean(np.sum(speed**2, axis=2)))), _offset_tolerance(joints, group)
    severity: IssueSeverity = "not_trusted" if moved * max(abs(late), abs(found.whole_drift)) > noise else "warning"
    if found.drifts_beyond(limit):
        yield _drift_issue(found, group.name, limit, severity)
    elif abs(late) > _MIN_Z * found.delay_std and abs(late) > limit:
        error = f"{1e3 * abs(late):.3g} ± {1e3 * found.delay_std:.2g} ms {'late' if late > 0 else 'early'}"
        words = f"time stamps of {group.name} are {error} on the joints' clock ({1e3 * limit:.3g} ms is tolerated)"
        camera = "camera" in f"{group.name} {group.sensor_name}".lower() or group.camera_pose is not None
        advice, setting = f"add {-late:+.3g} s to their times, or omit these points", f"sensors.{group.name}.use: false"
        if camera and late > 0:
            setting = known_effect_config_line("camera_latency", "camera", "delay", late)
            advice = f"add {-late:+.3g} s to their times, or model the delay"
        yield Issue("clock_offset", words, severity, abs(late) / limit, advice, "", group.name, "t", setting=setting)


def _drift_issue(found: _ClockError, group: str, limit: float, severity: IssueSeverity, can_omit: bool = True) -> Issue:
    late, drift, whole = found.delay, found.drift, found.whole_drift
    begin, end = (_lateness_text(late + sign * 0.5 * whole) for sign in (-1, 1))
    size, how = f"{100 * abs(drift):.2g} ± {100 * found.drift_std:.1g}", "fast" if drift > 0 else "slowly"
    words = f"time stamps of {group} are {begin} at the beginning and {end} at the end, on the joints' clock "
    words += f"(a change by {1e3 * limit:.3g} ms is tolerated). Their clock runs {size} % too {how}"
    advice = timestamp_correction_advice(late, drift, 0.5 * sum(found.span)) + ", or leave the points out" * can_omit
    setting = f"sensors.{group}.use: false" * can_omit
    return Issue("clock_drift", words, severity, abs(whole) / limit, advice, "", group, "t", setting=setting)


def _lateness_text(late: float) -> str:
    size = f"{abs(late):.3g} s" if abs(late) >= 1 else f"{1e3 * abs(late):.3g} ms"
    return f"{size} {'late' if late > 0 else 'early'}"


def timestamp_correction_advice(late: float, drift: float, middle: float) -> str:
    """Return the formula that corrects time stamps which are `late` [s] at the time `middle` [s] and have a `drift`."""
    return f"replace the times t of the points by t {-late:+.4g} {-drift:+.4g} (t - {middle:.6g})"


def point_clock_offset_drift_and_rms_error(
    path: PositionsAtTimesFunction, knots: tuple[float, float], t: Array, seen: Array, drifts: bool = False
) -> tuple[float, float, float]:
    """Find the clock offset [s] and drift that bring points nearest to a known path, and the remaining rms error [m].

    The search goes from coarse to fine steps. The path is known from the first to the last time in `knots` [s]. The
    points `seen` (N, np, 3) [m] have the time stamps `t` (N,). `drifts`: also search drifts up to ± `_MAX_DRIFT`.
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
        square, late = nearest(0.0, (width / 100, 100), (width / 1000, 12), (width / 10000, 12))
        return late, 0.0, math.sqrt(square)
    trials = np.linspace(-_MAX_DRIFT, _MAX_DRIFT, 1 + 2 * int(np.clip(_MAX_DRIFT * span / _DRIFT_SEARCH_STEP, 10, 100)))
    _, late, drift = min((*nearest(float(rate), (width / 48, 12), (width / 400, 8)), float(rate)) for rate in trials)
    begin = [late, drift * span]
    fine = scipy.optimize.minimize(lambda x: min(error(x[0], x[1] / span), 1e300), begin, method="Nelder-Mead")
    return float(fine.x[0]), float(fine.x[1]) / span, math.sqrt(fine.fun)


def problem_with_fitted_clocks_and_issues(problem: EstimationProblem) -> tuple[EstimationProblem, list[Issue]]:
    """Return the problem with corrected times of points whose clock is uncertain, and an issue for large corrections.

    A group is corrected if its `clock_offset_std` exceeds half a sample period: the residual is not linear in so large
    an offset. Fits alternate with shifts of the times to the predicted paths. Held-out recordings are shifted, too. A
    correction is large above half a sample period.
    """
    recordings = [episode.recording for episode in (*problem.episodes, *problem.held_out)]
    sensors, count, late = problem.options.sensors, len(problem.episodes), dict[tuple[int, str], tuple[float, float]]()
    for i, recording in enumerate(recordings):
        for group in recording.points:
            stated = sensors.get(group.name, SensorOptions()).clock_offset_std
            std = group.clock_offset_std if stated is None else stated
            if std is not None and len(group.t) > 1 and std > 0.5 * median_sample_period(group.t):
                late[i, group.name] = 0.0, float(std)
    for _ in range(_N_RELINEARIZATIONS if late else 0):
        fit = solvers.fit_problem(problem, restarts=False, verdicts=False)
        if fit.evaluation is None:
            break
        held_out = problem.predict_held_out(fit.x)
        known = [*zip(problem.episodes, fit.evaluation.episode_predictions, strict=True), *held_out]
        for i, (episode, result) in enumerate(known):
            for k, samples in enumerate(episode.measurements):
                name, seen = samples.sensor.group_name, samples.positive_weight_mask
                if (i, name) in late and not isinstance(result, str):
                    (before, std), path = late[i, name], result.predicted_outputs[k]
                    rate = np.gradient(path, times_since_recording_start(episode, samples), axis=0)
                    rate, left = (samples.weight * rate)[seen], (samples.weight * (path - samples.value))[seen]
                    more = float((rate @ left - before / std**2) / (rate @ rate + std**-2))
                    late[i, name] = before + more, std
                    groups = (replace(g, t=g.t - more) if g.name == name else g for g in recordings[i].points)
                    recordings[i] = replace(recordings[i], points=tuple(groups))
        made = recordings[:count], problem.free, problem.options, None, recordings[count:]
        problem = EstimationProblem(problem.step, *made)
    issues, advice = list[Issue](), "values may be used, as the fit shifts the times. If you know the offset, import "
    advice += "again with --clock-offset FILE=SECONDS"
    for (i, name), (shift, std) in late.items():
        [group] = (own for own in recordings[i].points if own.name == name)
        if abs(shift) > 0.5 * median_sample_period(group.t):
            ratio = abs(shift) / (_MAX_CLOCK_SHIFT_Z * std)
            limit = f" ({_MAX_CLOCK_SHIFT_Z:g} times this is tolerated)" * (ratio > 1)
            words = f"a fit finds time stamps of {name} {_lateness_text(shift)} and corrects them. Their "
            words += f"clock_offset_std is {1e3 * std:.3g} ms{limit}"
            issues.append(Issue("clock_offset", words, "warning", ratio, advice, recordings[i].name, name, "t"))
    return problem, issues


def clock_and_noise_issues_from_residuals(problem: EstimationProblem, x: Array, evaluation: Evaluation) -> list[Issue]:
    """Return issues about late and drifting clocks, and overstated sensor noise, found in a fit at `x` (nx,).

    An offset is an issue if it far exceeds the size that the fit expects, or if it grows during a recording. A smaller
    one has the same effect as missing damping; a diagnosis distinguishes the two (effect `camera_latency`).
    """
    if not evaluation.ok or evaluation.jacobian is None or problem.stated_rms_noise_of_data_residuals != 1.0:
        return []
    known = {(issue.cause, issue.recording, issue.group) for issue in problem.options.data_issues}
    found = [*_clocks(problem, x, evaluation), *_overstated(problem, evaluation)]
    return [issue for issue in found if (issue.cause, issue.recording, issue.group) not in known]


def _late(samples: SensorMeasurements, speed: Array, bend: Array, path: Array, recording: str) -> Iterator[Issue]:
    """Yield an issue if the clock of points is too late or early for a correction by `speed`, as the path bends."""
    if samples.change_by_clock is not None and speed.any():
        left, name = (samples.weight * (path - samples.value))[samples.positive_weight_mask], samples.sensor.group_name
        late = float(speed @ left / (speed @ speed))
        error = 0.5 * late**2 * float(np.sqrt(np.mean(bend**2)))
        what = f"the fit finds time stamps of {name} roughly {_lateness_text(late)}. Its "
        what += f"linear correction leaves {error:.2g} times the noise ({_MAX_CLOCK_RESIDUE:g} is tolerated)"
        advice = "if you know the offset, import again with --clock-offset FILE=SECONDS, else let a fit find it"
        if (ratio := error / _MAX_CLOCK_RESIDUE) > 1:
            line = f"sensors.{name}.clock_offset_std: {abs(late):.2g}"
            yield Issue("clock_offset", what, "warning", ratio, advice, recording, name, "t", setting=line)


def _clocks(problem: EstimationProblem, x: Array, evaluation: Evaluation) -> Iterator[Issue]:
    assert evaluation.jacobian is not None
    times = np.zeros(len(evaluation.residual))
    for series in channels_with_residual_indices(problem):
        times[series.residual_indices] = series.t
    size = np.ones(len(problem.initial_unknowns))
    for i, (episode, result) in enumerate(zip(problem.episodes, evaluation.episode_predictions, strict=True)):
        joints, slices = episode.recording.joints, problem.residual_rows.measurements[i]
        groups = {group.name: group for group in episode.recording.points}
        for k, samples in enumerate(episode.measurements):
            group = groups.get(samples.sensor.group_name)
            few = samples.n_residuals < MIN_DIFFERENCES_FOR_NOISE_STD
            if joints is None or group is None or few or not samples.sensor.point_names:
                continue
            own = slice(slices[0].start, slices[-1].stop)
            at, t = slice(slices[k].start - own.start, slices[k].stop - own.start), times[own]
            span = float(np.min(t[at])), float(np.max(t[at]))
            columns = np.zeros((len(t), 3))  # the first is for what a filter expects, which is no derivative
            path, seen = result.predicted_outputs[k], samples.positive_weight_mask
            speed, bend = (rates[seen] for rates in _by_lateness(problem, x, i, samples, result, path))
            yield from _late(samples, speed, bend, path, episode.recording.name)
            columns[at, 1:] = _by_clock(t[at], speed, span)
            if (whitening := problem.whitening_filters[i]) is not None:
                columns = whitening.whiten_residuals_and_estimate_torque_bias(columns, None)[0]
            jacobian = evaluation.jacobian[own] * problem.unknown_scales
            error = _clock_error(t, evaluation.residual[own], columns[:, 1:], jacobian, size, span)
            limit = _offset_tolerance(joints, group)
            if error is None or not (error.drifts_beyond(limit) and error.explained > _MIN_EXPLAINED_FRACTION):
                continue
            if abs(late := error.delay) > _MAX_DELAY_PER_DRIFT * abs(error.whole_drift):
                words = f"time stamps of {group.name} are about {_lateness_text(late)} on the joints' clock"
                advice = f"add {-late:+.3g} s to their times, and repeat this command"
                yield Issue("clock_offset", words, "not_trusted", abs(late) / limit, advice, "", group.name, "t")
            elif abs(error.drift) <= _MAX_DRIFT:  # a larger one is the sign of another error, such as a wrong scale
                yield _drift_issue(error, group.name, limit, "not_trusted", len(episode.measurements) > 1)


def _by_lateness(
    problem: EstimationProblem, x: Array, i: int, samples: SensorMeasurements, result: EpisodePrediction, path: Array
) -> tuple[Array, Array]:
    """Return the first and second derivative (M, k) of whitened predictions by the lateness [s] of the time stamps."""
    theta, state = problem.theta_of_episode(x, i), result.rollout.state
    none = np.zeros((*state.shape, len(problem.unknowns.free_parameter_names)))
    step, read = problem.step.time_step, problem.predictor.readings_and_sensitivities
    moved = (samples.shifted_earlier_by_delays(np.full(path.shape[1], s)) for s in (-1.0, 1.0))
    ahead, behind = (read(own, state, none, theta)[0] for own in moved)
    return samples.weight * (ahead - behind) / (2 * step), samples.weight * (ahead - 2 * path + behind) / step**2


def _overstated(problem: EstimationProblem, evaluation: Evaluation) -> Iterator[Issue]:
    """Yield issues for groups whose residuals, per sample and summed over time blocks, are far below stated noise."""
    if problem.options.excess_residual_criteria.noise_fraction_of_stated_std < 1.0:
        return  # the stated noise contains model error
    by_group: dict[str, list[tuple[float, float, int]]] = {}
    for series in channels_with_residual_indices(problem):
        r = evaluation.residual[series.residual_indices]
        if len(r) >= MIN_DIFFERENCES_FOR_NOISE_STD:
            sums = np.array([part.sum() / math.sqrt(len(part)) for part in np.array_split(r, _N_TIME_BLOCKS)])
            entry = float(r @ r), float(sums @ sums) / _N_TIME_BLOCKS * len(r), len(r)
            by_group.setdefault(series.group, []).append(entry)
    for group, parts in by_group.items():
        *squares, count = (sum(column) for column in zip(*parts, strict=True))
        free = count - len(problem.initial_unknowns)
        if free < 0.5 * count:
            continue
        seen = math.sqrt(max(squares) / free)
        if not seen < 1 / QUALITY_LIMITS.max_overstatement_ratio:
            continue
        own = [s for e in problem.episodes for s in e.measurements if s.sensor.group_name == group]
        axis = " per axis" * bool(own[0].sensor.point_names)
        usual = float(np.median(np.concatenate([s.std[s.positive_weight_mask] for s in own])))
        unit, least, size = own[0].sensor.unit, QUALITY_LIMITS.max_overstatement_ratio, seen * usual
        leaves = f"the errors of {group} after the fit, slow ones included, have a std of {size:.2g} {unit}{axis}"
        severity = 1 / (least * max(seen, 1e-9))
        times = f"{least * severity:.2g} times below the stated {usual:.2g} {unit} ({least:g} times is tolerated)"
        advice = "the large std makes every ± too wide, hides small gaps and can end the fit before its error is "
        advice += f"smallest. Until this issue is gone, fit again with a smaller sensors.{group}.std"
        setting = "" if problem.has_process_noise else f"sensors.{group}.std: {size:.2g}"
        if size < QUALITY_LIMITS.min_noise:
            advice, setting = "simulate with noise (`yid-ocp simulate --noise`), as no sensor has so little noise", ""
        where = group.partition(".")[0]
        yield Issue("noise_overstated", f"{leaves}, {times}", "warning", severity, advice, "", where, setting=setting)
