"""Checks of a recording without a model: clocks, gaps, motion, channels and duplicated data.

Limits come from physics or statistics. Checks against a model are in `analysis`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain, combinations, pairwise

import numpy as np
from scipy.integrate import cumulative_trapezoid

from yid_ocp.arrays import Array, IntArray
from yid_ocp.data import channel_checks
from yid_ocp.data.channel_checks import (
    LATE_POINTS_WORDS,
    LIMIT_VIOLATION_RATIO_CAP,
    QUALITY_LIMITS,
    Issue,
    IssueSeverity,
    SensorOptionsFunction,
    median_sample_period,
)
from yid_ocp.data.recording import JointGroup, PointGroup, Recording
from yid_ocp.display import count_with_noun

_CLOCK_UNITS = {"ms": 1e-3, "us": 1e-6, "ns": 1e-9}  # [s]
_MIN_UNIX_TIME = 1e8  # larger time stamps are seconds since 1970, smaller since power-on [s]
_MAX_SAMPLE_GAP = 0.1  # longest interpolated gap; arm motion has a bandwidth of 5 Hz [s]
_MAX_MISSING_PERIODS = 5  # sample periods that may always be missing
_MIN_PART_DURATION = 0.5  # shortest part of a recording that is kept [s]
_MAX_ROTATION_AT_REST = 0.01  # largest rotation in the first 0.2 s of a part that starts at rest [rad]
_MAX_CLOCK_JUMP_PERIODS = 5  # a gap that joints cross in fewer periods at their speed is a clock jump
_MIN_JUMP_ROTATION = 0.05  # rotation at joint speed over a gap required to detect a clock jump [rad]
_RATES_TOLERATED = f"1/{QUALITY_LIMITS.max_rate_ratio:g} to {QUALITY_LIMITS.max_rate_ratio:g} times is tolerated"
_INTERVAL_GRID = math.sqrt(2.0) * 1e-6  # grid for the comparison of intervals; usual ones are not on its edges [s]
_HASH_BASE = np.uint64(0x9E3779B97F4A7C15)


def split_recording_at_gaps(
    recording: Recording, driving: Sequence[str], anywhere: bool
) -> tuple[list[Recording], list[Issue]]:
    """Split a recording at gaps of its joint samples or, without joints, of the samples of the `driving` points.

    The first part is kept, and each later part at whose start the joints stand still. If `anywhere` is True, parts that
    start in motion are kept too, because the problem can estimate their initial state. Very short parts are dropped.
    Returns the parts, and one issue for each gap.
    """
    t = _times(recording, driving)
    steps = np.diff(t)
    allowed = max(_MAX_SAMPLE_GAP, _MAX_MISSING_PERIODS * median_sample_period(t))
    gaps = np.flatnonzero(steps > allowed)
    if len(steps) < 2 or not len(gaps):
        return [recording], []
    edges = [(0, gaps[0]), *((a + 1, b) for a, b in pairwise(gaps)), (gaps[-1] + 1, len(t) - 1)]
    kept = []
    for begin, end in edges:
        part = None if t[end] - t[begin] < _MIN_PART_DURATION else recording.time_slice(float(t[begin]), float(t[end]))
        if part is not None and (begin == 0 or anywhere or _begins_at_rest(part)):
            kept.append(part)
    left = sum(part.duration for part in kept)
    parts = [f"_part{i + 1}" for i in range(len(kept))] if len(kept) > 1 else [""]
    named = [replace(one, name=f"{recording.name}{part}") for one, part in zip(kept, parts, strict=False)]
    said = f"{count_with_noun(len(kept), 'part')} of the data ({left:.3g} s) {'is' if len(kept) == 1 else 'are'} used"
    if not anywhere and len(kept) < len(edges):
        said += " (with this problem.initial_state, a part must start at rest)"
    return named, [_doubt(recording, t, int(gap), allowed, said) for gap in gaps]


def _times(recording: Recording, driving: Sequence[str]) -> Array:
    """Times of the model's inputs: of joint samples or, without joints, of frames that show all `driving` points."""
    if recording.joints is not None:
        return recording.joints.t
    for group in recording.points:
        if columns := [group.names.index(name) for name in driving if name in group.names]:
            return group.t[np.isfinite(group.position[:, columns]).all(axis=(1, 2))]
    return recording.points[0].t


def _begins_at_rest(recording: Recording) -> bool:
    if (joints := recording.joints) is None:
        return False
    return bool(np.ptp(joints.position[joints.t <= joints.t[0] + 0.2], axis=0).max() < _MAX_ROTATION_AT_REST)


def _doubt(recording: Recording, t: Array, gap: int, allowed: float, said: str) -> Issue:
    length = float(t[gap + 1] - t[gap])
    joints, jumped = recording.joints, False
    if joints is not None and gap >= 5 and gap + 6 < len(t):
        before = (joints.position[gap] - joints.position[gap - 5]) / (t[gap] - t[gap - 5])
        after = (joints.position[gap + 6] - joints.position[gap + 1]) / (t[gap + 6] - t[gap + 1])
        speed = 0.5 * (np.abs(before) + np.abs(after)) * (np.sign(before) == np.sign(after))
        way = np.abs(joints.position[gap + 1] - joints.position[gap])
        fastest = float(np.max(speed))
        at_once = np.max(way) < _MAX_CLOCK_JUMP_PERIODS * median_sample_period(t) * fastest
        jumped = fastest * length > _MIN_JUMP_ROTATION and bool(at_once)
    what = f"the data that move the model have no samples for {length:.3g} s ({allowed:.2g} s is tolerated)"
    if jumped:
        what += f", but the joints continue smoothly, so the clock jumps by {length - median_sample_period(t):.3g} s"
    cause, group = "clock_jump" if jumped else "gap", "joints" if joints is not None else ""
    advice = "find out why samples are missing. To use another part, cut it out (Python: Recording.time_slice)"
    what, begin, end = f"{what}. {said}", float(t[gap]), float(t[gap + 1])
    return Issue(cause, what, "warning", length / allowed, advice, recording.name, group, "t", begin, end)


def recording_quality_issues(recording: Recording, options: SensorOptionsFunction, span: float = np.inf) -> list[Issue]:
    """Return the issues of one recording that need no model. `options`(key): of a sensor. `span`: used seconds."""
    recording = recording.with_effort_sampling_kind(options("joints.effort").effort_sampling_kind)
    # if times are not seconds, only the number of samples can be checked
    found = list(_units_of_time(recording)) or chain(
        _common_clock(recording, options),
        _dropped(recording),
        _velocities(recording),
        channel_checks.stuck_channel_issues(recording),
        channel_checks.excess_noise_issues(recording, options),
        channel_checks.overstated_noise_std_issues(recording, options),
        channel_checks.saturated_effort_issues(recording),
        _standstill(recording),
    )
    return [replace(issue, recording=recording.name) for issue in chain(_few_samples(recording, span), found)]


def _units_of_time(recording: Recording) -> Iterator[Issue]:
    for group in recording.all_groups:
        step, limits = median_sample_period(group.t), QUALITY_LIMITS
        slowest = limits.max_point_period if isinstance(group, PointGroup) else limits.max_joint_period
        if step <= slowest:
            continue
        what = f"{group.name}/t has only one sample every {step:.4g} s (at most {slowest:g} s is allowed)"
        advice = "write times in seconds"
        for unit, size in _CLOCK_UNITS.items():
            if 2e-4 <= step * size <= 2 * slowest:
                what += f". If the times are in {unit}, the rate is {1 / (step * size):.4g} Hz"
                advice = f"if so, import again with --units t={unit}, or divide them by {1 / size:g}"
                break
        yield Issue("time_unit", what, "refused", step / slowest, advice, "", group.name, "t")


def _few_samples(recording: Recording, span: float) -> Iterator[Issue]:
    groups, least = recording.joint_and_point_groups, QUALITY_LIMITS.min_samples
    counts = [int(np.sum(group.t - group.t[0] <= span * (1 + 1e-9))) for group in groups]
    for group, count in zip(groups, counts, strict=True):
        if count < least:
            # angles between so few samples are unknown; a few frames beside a dense group still tell something
            is_serious = group is recording.joints or max(counts) < least
            first = f" in the first {span:g} s" * (count < len(group.t))
            what = f"{group.name} has only {count_with_noun(count, 'sample')}{first} (at least {least} are needed)"
            severity: IssueSeverity = "not_trusted" if is_serious else "warning"
            advice = "if samples are lost, import the file again. If not, record longer"
            advice = "set a longer problem.duration" if first else advice
            yield Issue("few_samples", what, severity, least / count, advice, "", group.name)


def _common_clock(recording: Recording, options: SensorOptionsFunction) -> Iterator[Issue]:
    joints, late_notes = recording.joints, [note for note in recording.notes if LATE_POINTS_WORDS in note]
    if joints is None:
        return
    first, last = joints.t[0], joints.t[-1]
    for group in recording.points:
        begin, end = group.t[0], group.t[-1]
        if end < first or begin > last:
            far = min(abs(begin - last), abs(first - end))
            epoch = (abs(begin) > _MIN_UNIX_TIME) != (abs(first) > _MIN_UNIX_TIME)
            since = "One of the clocks counts from 1970" if epoch else f"{far:.3g} s lie between them"
            spans = f"from {first:.10g} to {last:.10g} s, {group.name} from {begin:.10g} to {end:.10g} s"
            what, advice = f"joints were recorded {spans}. {since}", "convert the times of all groups to one clock"
            yield Issue("clock_base", what, "refused", LIMIT_VIOLATION_RATIO_CAP, advice, "", group.name, "t")
            continue
        slack = max(QUALITY_LIMITS.max_clock_mismatch_fraction * (last - first), 5 * median_sample_period(group.t))
        late, over = begin - first, end - last
        shift = min(late, over) if late > 0 else max(late, over)
        if late * over > 0 and abs(shift) > slack:
            how = f"start {abs(late):.3g} s and end {abs(over):.3g} s {'later' if late > 0 else 'earlier'}"
            what = f"the times of {group.name} {how} than those of the joints (one end may differ by {slack:.3g} s)"
            advice = f"if both began together, import again with {-late:+.4g} s more in --clock-offset FILE=SECONDS. "
            advice += "If not, cut out the common time (Python: Recording.time_slice)"
            yield Issue("clock_offset", what, "not_trusted", abs(shift) / slack, advice, "", group.name, "t")
        elif (
            len(recording.points) == 1  # a note does not say which of several groups is late
            and late_notes
            and options(group.name).clock_offset_std is None
            and group.clock_offset_std is None
        ):
            lag, _, option = late_notes[0].partition(LATE_POINTS_WORDS)[2].partition(" (--clock-offset ")
            what = f"{LATE_POINTS_WORDS}{lag.partition(':')[0]}. Their clock is off, or the flexible object lags behind"
            advice = "`yid-ocp diagnose` distinguishes a late clock (camera_latency) from a lag of the object. A late "
            advice += "clock makes a damping wrong. If it is the clock, import all files of this clock again, here "
            advice += f"with --clock-offset {option.rstrip(')')}, or let a fit find the offset"
            line = f"sensors.{group.name}.clock_offset_std: {lag.split()[0][1:]}"
            yield Issue("clock_offset", what, "warning", 1.0, advice, "", group.name, "t", setting=line)


def _dropped(recording: Recording) -> Iterator[Issue]:
    """Find a joint recording with an even clock from which many samples are missing."""
    joints = recording.joints
    if joints is None or len(joints.t) < 20:
        return
    steps = np.diff(joints.t)
    base = float(np.percentile(steps, 2))
    count = np.rint(steps / base)
    even = float(np.mean(np.abs(steps / base - count) < 0.1 * count))
    small = count[count < 50]  # longer ones are gaps
    missing = float(np.sum(small - 1) / np.sum(small))
    if even > 0.9 and missing > QUALITY_LIMITS.max_missing_fraction:
        ratio, at = missing / (most := QUALITY_LIMITS.max_missing_fraction), f"the joint samples at {1 / base:.4g} Hz"
        what = f"{100 * missing:.2g} % of {at} are missing ({100 * most:g} % is tolerated)"
        advice = "find out why they are missing. Until then, torques are interpolated between the remaining samples"
        yield Issue("dropped_samples", what, "warning", ratio, advice, "", "joints", "t")


def _windowed_rates(t: Array, values: Array, rates: Array) -> tuple[Array, Array]:
    """Mean rates of change in overlapping windows of about 0.2 s: from `values`, and from the recorded `rates`."""
    width = max(3, round(0.2 / max(median_sample_period(t), 1e-9)))
    starts = np.arange(0, max(len(t) - width, 1), max(1, width // 2))
    ends = np.minimum(starts + width, len(t) - 1)
    length, area = (t[ends] - t[starts])[:, None], cumulative_trapezoid(rates, t, axis=0, initial=0)
    good = (length[:, 0] > 0) & (length[:, 0] < 3 * np.median(length))
    by_value, by_rate = ((x[ends] - x[starts])[good] / length[good] for x in (values, area))
    return by_value, by_rate


def _velocities(recording: Recording) -> Iterator[Issue]:
    joints = recording.joints
    if joints is None or joints.velocity is None or len(joints.t) < 50:
        return
    by_angle, by_velocity = _windowed_rates(joints.t, joints.position, joints.velocity)
    names = joints.names
    ratio, fit = np.full(len(names), np.nan), np.zeros(len(names))
    for j, (x, y) in enumerate(zip(by_velocity.T, by_angle.T, strict=True)):
        if np.std(x) > max(0.02, 2 * channel_checks.white_noise_std(joints.t, joints.velocity[:, j])) and np.std(y) > 0:
            ratio[j] = np.sign(x @ y) * math.sqrt(float(y @ y) / float(x @ x))
            fit[j] = float(np.corrcoef(x, y)[0, 1])
    known = [j for j in range(len(names)) if math.isfinite(ratio[j]) and abs(fit[j]) > 0.8]
    wrong = [j for j in known if not 1 / QUALITY_LIMITS.max_rate_ratio <= ratio[j] <= QUALITY_LIMITS.max_rate_ratio]
    if not wrong:
        yield from _exchanged(names, by_angle, by_velocity, fit, ratio)
        return
    typical = float(np.median(ratio[known]))
    alike = bool(len(wrong) == len(known) and np.all(np.abs(ratio[known] / typical - 1) < 0.2))
    if alike and typical > 0 and len(known) >= min(2, len(names)):
        cause, channel = "time_scale", "t"
        advice = f"multiply the times in the file by {typical:.3g}, or correct the velocities"
        if abs(typical / math.degrees(1.0) - 1) < 0.1:
            cause, channel, advice = "degrees", "position", "convert the angles in the file to radians"
        elif abs(typical * math.degrees(1.0) - 1) < 0.1:
            cause, channel, advice = "degrees", "velocity", "convert the velocities in the file to rad/s"
        what = f"all angles change {typical:.3g} times as fast as the recorded velocities state ({_RATES_TOLERATED})"
        ratio_beyond = max(typical, 1 / typical) / QUALITY_LIMITS.max_rate_ratio
        yield Issue(cause, what, "not_trusted", ratio_beyond, advice, "", "joints", channel)
        return
    for j in wrong:
        size, cause = abs(ratio[j]), "angle_scale"
        evidence = max(size, 1 / size) / QUALITY_LIMITS.max_rate_ratio
        what = f"{names[j]} turns {ratio[j]:.3g} times as fast as its recorded velocity states ({_RATES_TOLERATED})"
        advice = f"divide the angle of {names[j]} in the file by {ratio[j]:.3g}, or correct its velocity"
        if ratio[j] < 0 and abs(size - 1) < QUALITY_LIMITS.max_rate_ratio - 1:
            cause, evidence, advice = "angle_sign", LIMIT_VIOLATION_RATIO_CAP, f"multiply the angle of {names[j]} by -1"
        yield Issue(cause, what, "not_trusted", evidence, advice, "", "joints", f"position.{names[j]}")


def _exchanged(names: Sequence[str], by_angle: Array, by_velocity: Array, fit: Array, ratio: Array) -> Iterator[Issue]:
    """Find pairs of exchanged joints: the angle of each joint changes like the recorded velocity of the other one."""
    for i, j in combinations([j for j in range(len(names)) if math.isfinite(ratio[j]) and abs(fit[j]) < 0.5], 2):
        across = [float(np.corrcoef(by_angle[:, a], by_velocity[:, b])[0, 1]) for a, b in ((i, j), (j, i))]
        if min(across) > 0.9:
            own = max(abs(fit[i]), abs(fit[j]), 1e-3)
            what = f"the angle of {names[i]} changes like the velocity of {names[j]}, and vice versa (correlation "
            what += f"{min(across):.2g}), not like its own velocity (correlation {own:.2g})"
            evidence, advice = min(across) / own, "exchange the columns of the two angles in the file"
            yield Issue("swapped_joints", what, "not_trusted", evidence, advice, "", "joints", f"position.{names[i]}")


def _standstill(recording: Recording) -> Iterator[Issue]:
    joints, moved = recording.joints, list[tuple[float, str]]()
    if joints is not None:
        width, least = 9 if len(joints.t) >= 9 else 1, QUALITY_LIMITS.min_joint_motion
        smoothed = np.lib.stride_tricks.sliding_window_view(joints.position, width, axis=0).mean(axis=-1)
        size = float(np.max(np.ptp(smoothed, axis=0)))
        moved.append((size / least, f"the joints turn by at most {size:.2g} rad (at least {least:g} rad is needed)"))
    for group in recording.points:
        seen = group.position[:, np.isfinite(group.position).any(axis=(0, 2))]
        size = float(np.max(np.nanmax(seen, axis=0) - np.nanmin(seen, axis=0), initial=0.0))
        known = np.zeros(0) if group.std is None else group.std[np.isfinite(group.std)]
        least = max(QUALITY_LIMITS.min_point_travel, 6 * float(np.median(known)) if len(known) else 0.0)
        moved.append((size / least, f"{group.name} moves by at most {size:.2g} m (at least {least:.2g} m is needed)"))
    if moved and max(moved)[0] < 1.0:
        advice = "record a motion. For weights and stiffnesses alone, several postures at rest are enough"
        what = " and ".join(words for _, words in moved)
        yield Issue("standstill", what, "warning", 1 / max(max(moved)[0], 1e-3), advice, "")


def _transitions(one: JointGroup | PointGroup, other: JointGroup | PointGroup) -> tuple[IntArray, IntArray]:
    """Number the changes between the samples of two groups. Equal changes after equal times get equal numbers."""
    changes = []
    for group in (one, other):
        rows = np.nan_to_num(group.position.reshape(len(group.t), -1))
        if isinstance(group, JointGroup) and group.effort is not None:
            rows = np.hstack([rows, np.nan_to_num(group.effort)])
        kept = np.concatenate([[True], np.any(np.diff(rows, axis=0) != 0, axis=1)])
        rows, t = rows[kept], group.t[kept]
        changes.append(np.hstack([rows[:-1], rows[1:], np.rint(np.diff(t) / _INTERVAL_GRID)[:, None]]))
    if changes[0].shape[1] != changes[1].shape[1]:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    known: dict[bytes, int] = {}  # sorting the rows takes far longer; a zero has one sign
    numbers = np.array([known.setdefault(row.tobytes(), len(known)) for row in np.vstack(changes) + 0.0], np.int64)
    return numbers[: len(changes[0])], numbers[len(changes[0]) :]


def _longest_shared_run(one: IntArray, other: IntArray) -> int:
    if not np.intersect1d(one, other).size:
        return 0
    least, most, size = 0, min(len(one), len(other)), max(len(one), len(other))
    # the hash of a stretch is a difference of two sums of powers of an odd number, modulo 2^64
    powers = np.cumprod(np.full(size + 1, _HASH_BASE))
    terms = [(own.astype(np.uint64) + np.uint64(1)) * powers[: len(own)] for own in (one, other)]
    sums = [np.concatenate([np.zeros(1, np.uint64), np.cumsum(own)]) for own in terms]
    while least < most:
        length = (least + most + 1) // 2
        hashes = [(own[length:] - own[:-length]) * powers[size - np.arange(len(own) - length)] for own in sums]
        least, most = (length, most) if np.intersect1d(*hashes).size else (least, length - 1)
    return least


def _log_chance_of_run(one: IntArray, other: IntArray, length: int) -> float:
    """Logarithm of the number of equal runs of `length` expected by chance, from the repetitions within each series."""
    again = again_twice = pairs = 0.0
    for values in (one, other):
        follow = np.unique(np.column_stack([values[:-1], values[1:]]), axis=0, return_counts=True)[1]
        counts = np.unique(values, return_counts=True)[1]
        again += float(np.sum(counts * (counts - 1.0))) / 2
        again_twice += float(np.sum(follow * (follow - 1.0))) / 2
        pairs += len(values) * (len(values) - 1.0) / 2
    first = (again + 1) / (pairs + 1)
    return math.log(len(one) * len(other) * first) + (length - 1) * math.log((again_twice + first) / (again + 1))


def duplicate_data_issue(one: Recording, other: Recording) -> Issue | None:
    """Return an issue of the recording `other` if many of its samples also occur in the recording `one`, else None."""
    others = {group.name: group for group in other.joint_and_point_groups}
    count = 0
    for group in one.joint_and_point_groups if one.joints is None else (one.joints,):
        if group.name in others:
            numbers = _transitions(group, others[group.name])
            length = _longest_shared_run(*numbers)
            if length and _log_chance_of_run(*numbers, length) < math.log(QUALITY_LIMITS.max_chance_of_shared_run):
                count = max(count, length + 1)
    few = min(len(group.t) for recording in (one, other) for group in recording.joint_and_point_groups[:1])
    if count < min(QUALITY_LIMITS.min_shared_samples, 0.5 * few):
        return None
    what = f"{count} samples of {other.name} equal samples of {one.name} to the last digit, which is no coincidence"
    advice = "list only one of the two under recordings"
    return Issue("same_data", what, "warning", LIMIT_VIOLATION_RATIO_CAP, advice, other.name)
