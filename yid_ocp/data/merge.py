"""Merging of recordings of one run by several devices, such as a robot and a motion capture system."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from yid_ocp.arrays import Array
from yid_ocp.data.channel_checks import LATE_POINTS_WORDS, QUALITY_LIMITS, median_sample_period
from yid_ocp.data.readers.base import guess_non_si_units, joints_on_fastest_clock
from yid_ocp.data.recording import Recording, validated_recording
from yid_ocp.errors import DataError, require_known_names

_MIN_SHARED_FRACTION = 0.5  # overlap over the shorter recording; clocks with less are unrelated
_MIN_CONTRAST = 0.6  # log of errors, lags far from the best over best; 2 % of unrelated motions of one arm reach it
_NEAR_LAGS = 0.6  # lags that slow motions do not distinguish well [s]
_MAX_LEFT_RATIO = 0.7  # ratio of residuals with and without a lag, below which it is reported
_MIN_SAID_LAG = 0.02  # [s]
_MAX_GRID, _MAX_BRIDGED = 20000, 0.1  # samples of the search of lags; gap of points that it bridges [s]
_MIN_TURN, _MIN_TRAVEL, _MIN_SAMPLES, _MIN_SEEN_FRACTION = 0.05, 0.005, 20, 0.5  # [rad], [m]
_ALIGNED_CLOCK_STD = 0.03  # of an offset that the motion tells, which an object that swings behind shifts [s]
_LEAST_PERIOD = 5e-5  # of a sensor [s]; a camera whose seconds are read as milliseconds has less
_LARGEST_START = 1e6  # larger times are counted from the first sample [s]


class _MotionLag(NamedTuple):
    lag: float
    explained: float
    left_ratio: float  # of the errors with and without the lag
    is_clear: bool


def merge_recordings(recordings: Sequence[Recording], clock_offsets: Mapping[str, float] | None = None) -> Recording:
    """Merge recordings of one run into one recording, named after the first.

    Recordings whose time ranges overlap are assumed to share one clock and are not shifted; a note reports a remaining
    lag between points and joints. Recordings without overlap are aligned by the motion: the lag is chosen for which the
    joint angles explain the points best. The points get its uncertainty as `clock_offset_std`. Joints of several
    recordings are interpolated to the fastest clock. Points and other sensors keep their clocks. `clock_offsets` [s]
    are added to the times of the recordings that they name, which are then not aligned. The result's `notes` list these
    changes. Raises `DataError` for a joint in two recordings, a failed alignment, or an offset that names no recording.
    """
    offsets, names = dict(clock_offsets or {}), [recording.name for recording in recordings]
    where = ", ".join(names)
    require_known_names(offsets, names, "recording", "--clock-offset", DataError)
    lead = next((recording for recording in recordings if recording.joints is not None), recordings[0])
    first = _with_times_shifted(lead, offsets.get(lead.name, 0.0))
    shifted, notes = list[Recording](), list[str]()
    for recording in recordings:
        if recording.name in offsets:
            shift, said = offsets[recording.name], "as --clock-offset states"
            if recording is not lead:
                late = _late_points(first, _with_times_shifted(recording, shift), recording.name, shift)
                said += late and f". But {late}"
        else:
            shift, said = (0.0, "") if recording is lead else _shift(first, recording)
            if shift:
                points = tuple(replace(group, clock_offset_std=_ALIGNED_CLOCK_STD) for group in recording.points)
                recording = replace(recording, points=points)
        if said:
            shifts = f"the times of {recording.name} were shifted by {shift:+.4f} s, "
            notes.append(f"{shifts if shift or recording.name in offsets else ''}{said}")
        shifted.append(_with_times_shifted(recording, shift))
    begin = min(float(group.t[0]) for recording in shifted for group in recording.all_groups)
    if abs(begin) > _LARGEST_START:
        shifted = [_with_times_shifted(recording, -begin) for recording in shifted]
        notes.append(f"all times now count from the first sample, which has the time {begin:.9g} s in its file")
    groups, joints = [(r.name, r.joints) for r in shifted if r.joints is not None], None
    if groups:
        hint = "import one file alone without its joints (--columns 'q_*=skip'), then import the .h5 in its place"
        joints, more = joints_on_fastest_clock(groups, where, hint)
        notes += more
    merged = Recording(
        joints,
        _with_unique_names(shifted, [r.points for r in shifted]),
        next((r.description for r in recordings if r.description), ""),
        "; ".join(r.source for r in recordings if r.source),
        recordings[0].name,
        notes=(*(note for recording in recordings for note in recording.notes), *notes),
        channel_groups=_with_unique_names(shifted, [r.channel_groups for r in shifted]),
    )
    return validated_recording(merged, where=where)


def _span(recording: Recording) -> tuple[float, float]:
    clocks = [group.t for group in recording.all_groups]
    return float(min(t[0] for t in clocks)), float(max(t[-1] for t in clocks))


def _shift(first: Recording, other: Recording) -> tuple[float, str]:
    """Shift [s] to add to the times of `other`, and the reason. Raises `DataError` if the clocks cannot be aligned."""
    (begin, end), (start, stop) = _span(first), _span(other)
    overlap, shortest = min(end, stop) - max(begin, start), min(end - begin, stop - start)
    shared = overlap >= _MIN_SHARED_FRACTION * shortest
    for recording in sorted((first, other), key=_least_period):
        _check_time_unit(recording, shortest, default="ms" if shared else "")
    part = f"their times overlap by {overlap:.4g} of {max(end - begin, stop - start):.4g} s"
    said = f"{first.name} and {other.name} are assumed to have one clock ({part})"
    if shared:
        late = _late_points(first, other, other.name, 0.0)
        if late:
            return 0.0, f"{said}, so nothing was shifted. But {late}"
        return 0.0, f"{said}. If not, import again with --clock-offset {other.name}=SECONDS, added to its times"
    best = _motion_lag(first, other, begin - start)
    if best is None or not best.is_clear:
        spans = f"{first.name}: {begin:.10g} to {end:.10g} s, {other.name}: {start:.10g} to {stop:.10g} s"
        what = f"the recording times of {first.name} and {other.name} do not overlap, and no motion clearly aligns them"
        hint = f"shift its times: --clock-offset {other.name}={begin - start:.4f}, if both began together"
        guess = f" (the motion hints at {begin - start - best.lag:.4f}, which is uncertain)" if best else ""
        hint += f"; otherwise measure the offset{guess}"
        allowed = "recording times that overlap, or a clear common motion"
        raise DataError(what, where=spans, allowed=allowed, hint=hint)
    why = "because the recording times do not overlap. With this shift, the points follow the joint angles best "
    why += f"({best.explained:.1%} of the motion). A fit of the model corrects the rest (± {_ALIGNED_CLOCK_STD:g} s)"
    return begin - start - best.lag, why


def _late_points(first: Recording, other: Recording, name: str, applied: float) -> str:
    """What is said if the points of `other` clearly follow the joints of `first` better with another shift."""
    best = _motion_lag(first, other)
    if best is None or not best.is_clear or best.left_ratio > _MAX_LEFT_RATIO or abs(best.lag) < _MIN_SAID_LAG:
        return ""
    said = f"{LATE_POINTS_WORDS}{-best.lag:+.2g} s (which explains {best.explained:.0%} of their motion): their clock "
    said += "is off, or the flexible object lags behind the arm. `yid-ocp check` says how to decide. If it is the "
    return f"{said}clock, import again with this option (--clock-offset {name}={round(applied - best.lag, 3):.12g})"


def _least_period(recording: Recording) -> float:
    return min(median_sample_period(group.t) or math.inf for group in recording.all_groups)


def _check_time_unit(recording: Recording, duration: float, default: str) -> None:
    """Raise `DataError` if hardly any of many samples lies in `duration` [s] and the unit shows or has a `default`."""
    name, unit = recording.name, guess_non_si_units(recording)[0].get("t", default)
    total = max(len(group.t) for group in recording.all_groups)
    inside = max(np.count_nonzero(group.t - group.t[0] <= duration) for group in recording.all_groups)
    is_too_fast = (period := _least_period(recording)) < _LEAST_PERIOD
    if is_too_fast or (unit and total >= _MIN_SAMPLES and inside < QUALITY_LIMITS.min_samples):
        what = f"only {inside} of {total} samples of {name} lie in {duration:.4g} s, so its times seem to be in {unit}"
        hint = f"import {name} alone with --units t={unit}, and list its .h5 in its place"
        if is_too_fast:
            what = f"the samples of {name} would be {period:.3g} s apart, so its times seem to have another unit"
            hint = f"import {name} alone, without a unit of t or with the right one, and list its .h5 in its place"
        raise DataError(what, where=name, allowed="files of one run with one unit of time", hint=hint)


def _motion_lag(first: Recording, other: Recording, shift: float = 0.0) -> _MotionLag | None:
    """How late the points of `other`, shifted by `shift` [s], follow the joints of `first`; None for too little motion.

    At every lag with enough common time, linear functions of the angles are fitted to the positions.
    """
    from scipy import signal  # slow to import

    seen_path, joints = _seen_path(other), first.joints
    if seen_path is None or joints is None or len(joints.t) < _MIN_SAMPLES:
        return None
    t, path = seen_path[0] + shift, seen_path[1]
    sums = partial(signal.correlate, method="fft")  # over the common samples, for every lag of the first argument
    moving = joints.position[:, np.ptp(joints.position, axis=0) > _MIN_TURN]
    spans = joints.t[-1] - joints.t[0], t[-1] - t[0]
    period = max(0.005, median_sample_period(joints.t), median_sample_period(t), max(spans) / _MAX_GRID)
    grid, even = np.arange(joints.t[0], joints.t[-1], period), np.arange(t[0], t[-1], period)
    if not moving.shape[1] or min(len(grid), len(even)) < max(_MIN_SAMPLES, 5 * moving.shape[1]):
        return None
    later = np.minimum(np.searchsorted(t, even), len(t) - 1)
    seen = (t[later] - t[np.maximum(later - 1, 0)] < _MAX_BRIDGED).astype(float)
    x = np.stack([np.interp(grid, joints.t, column) for column in (moving - moving.mean(axis=0)).T])
    y = seen * np.stack([np.interp(even, t, column) for column in (path - path.mean(axis=0)).T])
    whole = np.ones(len(grid))
    n = np.maximum(np.rint(sums(seen, whole)), 1.0)
    sum_x, sum_y = np.array([sums(seen, a) for a in x]), np.array([sums(b, whole) for b in y])
    xx = np.array([[sums(seen, a * b) for b in x] for a in x]) - sum_x[:, None] * sum_x / n
    xy = np.array([[sums(b, a) for b in y] for a in x]) - sum_x[:, None] * sum_y / n
    yy = sums(np.sum(y**2, axis=0), whole) - np.sum(sum_y**2, axis=0) / n
    used = n >= _MIN_SHARED_FRACTION * min(len(grid), seen.sum())
    lags = (signal.correlation_lags(len(even), len(grid)) * period + (even[0] - grid[0]))[used]
    xx, xy, n, yy = np.moveaxis(xx, 2, 0)[used], np.moveaxis(xy, 2, 0)[used], n[used], yy[used]
    gained = np.sum(xy * (np.linalg.pinv(xx, rcond=1e-6, hermitian=True) @ xy), axis=(1, 2))
    explained = np.clip(gained / np.maximum(yy, 1e-12), 0.0, 1.0 - 1e-9)
    support = -np.log1p(-explained) * n
    best = int(np.argmax(support))
    far = np.max(support, where=np.abs(lags - lags[best]) > _NEAR_LAGS, initial=0.0)
    left = (1 - explained[best]) / (1 - explained[np.argmin(np.abs(lags))])
    is_clear = bool(support[best] - far >= _MIN_CONTRAST * n[best])
    return _MotionLag(float(lags[best]), float(explained[best]), float(left), is_clear)


def _seen_path(recording: Recording) -> tuple[Array, Array] | None:
    """Times (M,) and coordinates (M, columns) of the often seen points, from frames that show all of these points."""
    for group in recording.points:
        whole = group.position.reshape(len(group.t), -1)
        whole = whole[:, np.isfinite(whole).mean(axis=0) > _MIN_SEEN_FRACTION]
        rows = np.isfinite(whole).all(axis=1)
        if whole.shape[1] and rows.sum() >= _MIN_SAMPLES and np.ptp(whole[rows], axis=0).max() > _MIN_TRAVEL:
            return group.t[rows], whole[rows]
    return None


def _with_times_shifted(recording: Recording, shift: float) -> Recording:
    if not shift:
        return recording
    joints = recording.joints and replace(recording.joints, t=recording.joints.t + shift)
    points = tuple(replace(group, t=group.t + shift) for group in recording.points)
    channels = tuple(replace(group, t=group.t + shift) for group in recording.channel_groups)
    return replace(recording, joints=joints, points=points, channel_groups=channels)


def _with_unique_names(recordings: Sequence[Recording], groups: Sequence[Sequence[Any]]) -> tuple[Any, ...]:
    """Groups of all recordings. If several groups have one name, the name of the recording is added to each."""
    pairs = [(group, recording) for recording, own in zip(recordings, groups, strict=True) for group in own]
    names = [group.name for group, _ in pairs]
    return tuple(g if names.count(g.name) == 1 else replace(g, name=f"{g.name}_{r.name}") for g, r in pairs)
