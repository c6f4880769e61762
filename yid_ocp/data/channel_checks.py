"""Checks of single channels of a recording for repeated values, quantization, noise and saturation."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import scipy.special
from scipy.integrate import cumulative_trapezoid

from yid_ocp.arrays import Array
from yid_ocp.data.recording import JOINT_CHANNEL_UNITS, Recording
from yid_ocp.errors import DataError
from yid_ocp.sensors import CHANNEL_KINDS, SensorOptions
from yid_ocp.sensors.joints import JOINT_EFFORT_SENSOR_KEY, NOISE_ESTIMATE_DIFFERENCE_ORDER, quantization_step

_MAX_REPEATED_FRACTION = 0.1  # fraction of samples that may repeat the previous one
_MAX_STEPS_AT_REST, _MAX_FRACTION_AT_REST = 2.5, 0.2  # change next to a rest over smallest and median change
_MIN_NOISE_FRACTION = 1e-2  # fraction of the stated noise below which a channel was computed
_MAX_SAMPLE_PERIOD = 0.02  # longest period at which arm motion counts as slow [s]


def _channels(recording: Recording, *wanted: str) -> Iterator[tuple[str, str, Array, Array]]:
    """Yield group, channel, times [s] and values (N,) or (N, 3) of each measured channel of the `wanted` quantities."""
    if (joints := recording.joints) is not None:
        for quantity, values in joints.values_by_channel.items():
            for j, name in enumerate(joints.names if quantity in wanted else ()):
                yield "joints", f"{quantity}.{name}", joints.t, values[:, j]
    for group in recording.points if "points" in wanted else ():
        for i, name in enumerate(group.names):
            seen = np.isfinite(group.position[:, i]).all(axis=1)
            yield group.name, name, group.t[seen], group.position[seen, i]


def stuck_channel_issues(recording: Recording) -> Iterator[Issue]:
    """Find channels that repeat one value although they vary elsewhere or the recorded velocity is not zero."""
    joints = recording.joints
    for group, channel, t, values in _channels(recording, "position", "effort", "points"):
        if len(t) <= QUALITY_LIMITS.min_stuck_samples:
            continue
        same = np.all(np.diff(values.reshape(len(t), -1), axis=0) == 0, axis=1)
        quantity, _, name = channel.partition(".")
        turned_by = np.zeros(len(t))
        if joints is not None and quantity == "position" and joints.velocity is not None:
            turned_by = cumulative_trapezoid(joints.velocity[:, joints.names.index(name)], t, initial=0)
        edges = np.flatnonzero(np.diff(np.concatenate([[False], same, [False]]).astype(int)))
        runs = [  # stretches of equal samples: first and last index, and rotation meanwhile
            (begin, end, float(np.ptp(turned_by[begin : end + 1])))
            for begin, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)
            if end - begin >= QUALITY_LIMITS.min_stuck_samples and t[end] - t[begin] >= QUALITY_LIMITS.min_stuck_time
        ]
        unseen = QUALITY_LIMITS.max_unseen_rotation
        rests = [run for run in runs if run[2] <= unseen and _comes_to_rest(values, *run[:2])]
        if joints is not None and quantity == "effort":  # a command that holds a joint still is constant
            angle = joints.position[:, joints.names.index(name)]
            most = 10 * noise_or_quantization_std(t, angle)  # range of noise, or three counts
            rests = [run for run in runs if run in rests or np.ptp(angle[run[0] : run[1] + 1]) <= most]
        if len(rests) == len(runs):
            continue
        begin, end, turned = longest = max((run for run in runs if run not in rests), key=lambda run: run[1] - run[0])
        count = end - begin
        elsewhere = np.delete(same, np.concatenate([np.arange(*run[:2]) for run in (longest, *rests)]))
        usual = float(np.mean(elsewhere)) if len(elsewhere) >= count // 4 else 1.0
        stated = None if joints is None or quantity != "position" else joints.position_std
        # if the channel changes in nine of ten samples, a repetition of this length is not chance
        is_unlikely = usual < 0.1 or (count == len(same) and stated is not None and bool(np.all(stated)))
        evidence = count / QUALITY_LIMITS.min_stuck_samples if is_unlikely else 0.0
        if turned > unseen:
            evidence = max(evidence, turned / unseen)
        if quantity == "effort" and values[begin] in (0.0, np.max(values), np.min(values)):
            continue  # no effort was recorded, or it is cut off: other causes
        if evidence >= 1:
            start, stop, least = float(t[begin]), float(t[end]), QUALITY_LIMITS.min_stuck_samples
            what = f"{channel} repeats one value from {start:.4g} to {stop:.4g} s"
            what += f", {count} times (fewer than {least} are tolerated)" if is_unlikely else ""
            if turned > unseen:
                what += f", although its velocity says that it turns by {turned:.2g} rad ({unseen:g} rad is tolerated)"
            advice = "check the sensor. Cut out this time (Python: Recording.time_slice), or do not use the channel"
            yield Issue("stuck", what, "not_trusted", evidence, advice, "", group, channel, start, stop)


def _comes_to_rest(values: Array, begin: int, end: int) -> bool:
    """Whether a channel slowly approaches and leaves the value that it repeats, like the angle of a joint at rest."""
    moves = np.abs(np.diff(values, axis=0))
    moves = moves[moves > 0]
    if values.ndim > 1 or not len(moves):
        return False
    slow = max(_MAX_STEPS_AT_REST * np.min(moves), _MAX_FRACTION_AT_REST * np.median(moves))
    sides = values[max(begin - 2, 0) : begin][::-1], values[end + 1 : end + 3]
    # a constant acceleration from rest moves it four times as far in two samples as in one
    return all(np.all(np.abs(side - values[begin]) < slow * np.array([1, 4])[: len(side)]) for side in sides)


def white_noise_std(t: Array, values: Array) -> float:
    """Estimate the standard deviation of white noise. Zero for few samples, uneven times `t` or mostly equal values."""
    if len(t) < NOISE_ESTIMATE_DIFFERENCE_ORDER + MIN_DIFFERENCES_FOR_NOISE_STD:
        return 0.0
    even = np.abs(np.diff(t) / max(median_sample_period(t), 1e-12) - 1) < 0.2
    together = np.lib.stride_tricks.sliding_window_view(even, NOISE_ESTIMATE_DIFFERENCE_ORDER).all(axis=1)
    if together.sum() < MIN_DIFFERENCES_FOR_NOISE_STD:
        return 0.0
    size = math.sqrt(float(scipy.special.comb(2 * NOISE_ESTIMATE_DIFFERENCE_ORDER, NOISE_ESTIMATE_DIFFERENCE_ORDER)))
    return float(1.4826 * np.median(np.abs(np.diff(values, NOISE_ESTIMATE_DIFFERENCE_ORDER)[together])) / size)


def noise_or_quantization_std(t: Array, values: Array) -> float:
    """Estimate the noise standard deviation of a channel: the larger one of white noise and quantization noise."""
    return max(white_noise_std(t, values), quantization_step(values) / math.sqrt(12))


def _stated(recording: Recording, choice: SensorOptionsFunction, group: str, channel: str) -> float:
    """Noise standard deviation of a channel as the settings or else the recording state it; zero if neither does."""
    joints, (quantity, _, name) = recording.joints, channel.partition(".")
    if group == "joints" and joints is not None:
        said = choice(f"joints.{quantity}").std
        if isinstance(said, Mapping):
            return float(said.get(name, 0.0))
        recorded = getattr(joints, CHANNEL_KINDS[f"joints.{quantity}"].std_attribute_names[0])
        given = next((std for std in (said, recorded) if std is not None), 0.0)
        if quantity == "position" and said is None and joints.position_resolution is not None:
            given = np.hypot(given, joints.position_resolution / math.sqrt(12))
        return float(np.broadcast_to(given, (len(joints.names),))[joints.names.index(name)])
    said = choice(group).std
    if isinstance(said, (int, float)):
        return float(said)
    own_group = next(entry for entry in recording.points if entry.name == group)
    spread = np.nan if own_group.std is None else own_group.std[:, own_group.names.index(channel)]
    return float(np.nanmedian(spread)) if np.any(np.isfinite(spread)) else 0.0


def excess_noise_issues(recording: Recording, options: SensorOptionsFunction) -> Iterator[Issue]:
    """Find channels whose quantization or noise far exceeds the stated noise. Rates below 20 Hz are not checked."""
    for group, channel, t, values in _channels(recording, "position", "effort", "points"):
        if len(t) < 100 or median_sample_period(t) > 0.05:
            continue
        stated = _stated(recording, options, group, channel)
        columns = values.reshape(len(t), -1).T
        step = max(quantization_step(column) for column in columns)
        size, wide = step / math.sqrt(12), float(np.ptp(values))
        # an angle that hardly moves always has few levels
        least = 5 * QUALITY_LIMITS.min_joint_motion if channel.startswith("position") else 0.0
        few, unit = step > wide / 16 and wide > least, JOINT_CHANNEL_UNITS.get(channel.partition(".")[0], "m")
        setting = f"sensors.{'joints.' + channel.partition('.')[0] if group == 'joints' else group}.std"
        every = " for all joints" if group == "joints" else ""
        tolerated = f"times the stated {stated:.2g} {unit} ({QUALITY_LIMITS.max_noise_ratio:g} times is tolerated)"
        if step > 0 and (size > QUALITY_LIMITS.max_noise_ratio * stated > 0 or (few and stated == 0)):
            what = f"{channel} has steps of {step:.3g} {unit}, so rounding alone has a std of {size:.2g} {unit}"
            levels = f". Only {wide / step:.3g} steps span its range (at least 16 are needed), and no std is stated"
            what += f", {size / stated:.3g} {tolerated}" if stated else levels
            ratio = size / (QUALITY_LIMITS.max_noise_ratio * stated) if stated else 16 * step / wide
            advice, line = f"record with more digits, or state the std of rounding{every}", f"{setting}: {size:.2g}"
            yield Issue("quantised", what, "not_trusted", ratio, advice, "", group, channel, setting=line)
            continue
        seen = max(white_noise_std(t, column) for column in columns)
        if next(entry.clock for entry in recording.joint_and_point_groups if entry.name == group) == "nominal":
            # sampling times are known to half a period, which looks like noise during motion
            seen -= min(seen, 0.5 * max(float(np.mean(np.abs(np.diff(column)))) for column in columns))
        if seen > QUALITY_LIMITS.max_noise_ratio * stated > 0:
            what = f"the noise of {channel} has a std of {seen:.2g} {unit}, {seen / stated:.3g} {tolerated}"
            ratio, line = seen / (QUALITY_LIMITS.max_noise_ratio * stated), f"{setting}: {seen:.2g}"
            advice = f"find the cause of the noise, or state its actual std{every}"
            yield Issue("noise", what, "not_trusted", ratio, advice, "", group, channel, setting=line)


def overstated_noise_std_issues(recording: Recording, options: SensorOptionsFunction) -> Iterator[Issue]:
    """Find channels whose noise is far below the noise that the recording states.

    Channels of a sensor with equal stated noise are judged together. Noise stated in the settings (`options`) is not
    checked, because it may represent model error. Noise need not be white, so it is estimated from all samples, from
    every second, every fourth and so on, up to a period of `_MAX_SAMPLE_PERIOD`. The largest estimate counts, but at
    least the quantization noise. Computed channels without noise, such as commands, are skipped.
    """
    found: dict[str, list[tuple[str, float, float]]] = {}
    commanded = recording.joints is not None and recording.joints.effort_sampling_kind_or_default == "command"
    for group, channel, t, values in _channels(recording, "position", "effort", "points"):
        sensor = f"joints.{channel.partition('.')[0]}" if group == "joints" else group
        said, step = options(sensor), median_sample_period(t)
        stated = _stated(recording, options, group, channel)
        if stated <= 0 or said.std is not None or said.use is False:
            continue
        if (commanded and sensor == JOINT_EFFORT_SENSOR_KEY) or len(t) < 100 or not 0 < step <= _MAX_SAMPLE_PERIOD:
            continue
        columns = values.reshape(len(t), -1).T
        if np.mean(np.diff(columns, axis=1) == 0) > _MAX_REPEATED_FRACTION:
            continue  # a saturated, coarse or stuck channel does not show its noise
        strides = [2**k for k in range(12) if 2**k * step <= _MAX_SAMPLE_PERIOD]
        sizes = [white_noise_std(t[::k], column[::k]) for k in strides for column in columns]
        seen = max([*sizes, *(quantization_step(column) / math.sqrt(12) for column in columns)])
        found.setdefault(sensor, []).append((channel, stated, seen))
    for sensor, entries in found.items():
        seen_of = {name: max(s for _, also, s in entries if also == stated) for name, stated, _ in entries}
        most = {name: QUALITY_LIMITS.max_overstatement_ratio * seen for name, seen in seen_of.items()}
        low = {name for name, stated, _ in entries if _MIN_NOISE_FRACTION * stated < most[name] < stated}
        if not low:
            continue
        channel, stated = max(((name, s) for name, s, _ in entries if name in low), key=lambda e: e[1] / seen_of[e[0]])
        own = {name.partition(".")[2] or name: seen_of[name] if name in low else s for name, s, _ in entries}
        line = f"{{{', '.join(f'{name}: {size:.2g}' for name, size in own.items())}}}"
        if len(set(own.values())) == 1 or not sensor.startswith("joints."):  # a group of points takes one number
            line = f"{max(own.values()):.2g}"
        ratio, unit = stated / most[channel], JOINT_CHANNEL_UNITS.get(channel.partition(".")[0], "m")
        what = f"the noise of {channel} has a std of at most {seen_of[channel]:.2g}, not {stated:.2g} {unit} as stated"
        what += f" (too large for {len(low)} of {len(entries)} such channels)" if len(low) > 1 else ""
        what += f". A stated std of {QUALITY_LIMITS.max_overstatement_ratio:g} times the noise is tolerated"
        advice = "the large std makes every ± too wide and hides small gaps. State the std of the actual noise"
        setting = f"sensors.{sensor}.std: {line}" if len(low) == len(entries) or line[0] == "{" else ""
        group = sensor.partition(".")[0]
        yield Issue("noise_overstated", what, "warning", ratio, advice, "", group, channel, setting=setting)


def saturated_effort_issues(recording: Recording) -> Iterator[Issue]:
    """Find joints with saturated effort: the effort repeatedly equals its largest or smallest value exactly."""
    if recording.joints is not None and recording.joints.effort_sampling_kind_or_default == "command":
        return  # commands end at the controller's own limit
    for group, channel, t, values in _channels(recording, "effort"):
        for sign in (1.0, -1.0):
            levels, counts = np.unique(sign * values, return_counts=True)
            near = (levels > levels[-1] - 0.05 * np.ptp(levels)) & (levels < levels[-1])
            at = sign * values == levels[-1]
            # a value of many samples, whose neighbouring values have less than a fifth as many, held several times
            steps, least = np.diff(np.flatnonzero(at)), QUALITY_LIMITS.min_clipped_samples
            alone = at.sum() >= least and at.sum() > 5 * np.max(counts[near], initial=0)
            again = np.sum(steps == 1) >= least / 2 and np.any(steps > 1)
            if alone and again and len(levels) > MIN_DIFFERENCES_FOR_NOISE_STD:
                begin, end = map(float, t[np.flatnonzero(at)[[0, -1]]])
                what = f"{channel} is cut off (saturated) at {sign * levels[-1]:.4g} N m: {at.sum()} samples have "
                what += f"exactly this value (fewer than {least} are tolerated)"
                advice = "if the sensor measures torque, record within its range or cut out these times. "
                advice += "If the efforts are a controller's commands, state this"
                line, place = f"sensors.{JOINT_EFFORT_SENSOR_KEY}.effort_sampling_kind: command", (group, channel)
                yield Issue("saturated", what, "not_trusted", at.sum() / least, advice, "", *place, begin, end, line)


def typical_point_pair_distances(
    edges: Sequence[tuple[str, str]], recordings: Sequence[Recording], frames: int | None = None
) -> dict[tuple[str, str], float]:
    """Return the typical distance [m] between the two points of each pair in `edges`.

    It is the mean over the first `frames` frames of a recording (None: all frames), then the median over the
    recordings. If the points are in two groups, the frames are those of the group with fewer samples, and the other
    point is interpolated. Raises `DataError` if a point is not recorded, or if no frame shows both points of a pair.
    """
    result: dict[tuple[str, str], float] = {}
    for edge in edges:
        seen = []
        for recording in recordings:
            t = min((recording.group_of_point(point).t for point in edge), key=len)[:frames]
            begin, end = np.swapaxes(recording.point_positions(edge, t), 0, 1)
            length = np.linalg.norm(end - begin, axis=1)
            if np.any(np.isfinite(length)):
                seen.append(float(np.nanmean(length)))
        if not seen:
            what = f"no frame shows both points of the edge {edge[0]} to {edge[1]}, so its length is unknown"
            where = ", ".join(f"recording '{r.name}'" for r in recordings)
            hint = f"add to recordings.estimate a recording in which {edge[0]} and {edge[1]} are visible at one time"
            raise DataError(what, where=where, allowed="at least one frame with both points", hint=hint)
        result[edge] = float(np.median(seen))
    return result


IssueSeverity = Literal["warning", "not_trusted", "refused"]

LIMIT_VIOLATION_RATIO_CAP = 1e3  # largest value of `Issue.limit_violation_ratio`; larger ratios are clipped
DEGREES_PER_RADIAN = math.degrees(1.0)
MIN_DIFFERENCES_FOR_NOISE_STD = 30  # least number of differences of samples that give a channel's noise
LATE_POINTS_WORDS = "the points match the angles best if shifted by "  # note of merged files; the shift [s] follows


@dataclass(frozen=True)
class _QualityLimits:
    """Limits above which a check of a recording reports an issue."""

    max_joint_period: float = 0.5
    max_point_period: float = 30.0
    max_missing_fraction: float = 0.2
    max_clock_mismatch_fraction: float = 0.2
    max_rate_ratio: float = 1.3
    max_noise_ratio: float = 3.0
    max_overstatement_ratio: float = 5.0
    min_noise: float = 1e-6  # of any sensor [m, rad or N m]
    min_stuck_time: float = 0.3
    min_stuck_samples: int = 12
    max_unseen_rotation: float = 0.03
    min_clipped_samples: int = 8
    min_samples: int = 4
    min_joint_motion: float = 0.01
    min_point_travel: float = 0.002
    min_shared_samples: int = 50
    max_chance_of_shared_run: float = 1e-6


QUALITY_LIMITS = _QualityLimits()


@dataclass(frozen=True)
class Issue:
    """One suspected error of a recording, with its cause, severity, evidence and remedy."""

    cause: str  # key of `ISSUE_CAUSE_DESCRIPTIONS`
    what: str  # sentence on the cause, with numbers
    severity: IssueSeverity  # a run continues with a warning, continues with the verdict `not_trusted`, or stops
    limit_violation_ratio: float  # value over limit (inverse for a lower limit), 1 to `LIMIT_VIOLATION_RATIO_CAP`
    advice: str  # recommended action
    recording: str  # location; empty means all
    group: str = ""
    channel: str = ""
    begin: float | None = None  # time interval on the group's clock [s]; None means the whole recording
    end: float | None = None
    setting: str = ""  # line of configuration that repairs or describes it, if any

    def __post_init__(self) -> None:
        if self.cause not in ISSUE_CAUSE_DESCRIPTIONS:
            raise ValueError(f"there is no cause '{self.cause}'")
        ratio = min(max(self.limit_violation_ratio, 1.0), LIMIT_VIOLATION_RATIO_CAP)
        object.__setattr__(self, "limit_violation_ratio", float(ratio))

    @property
    def certainty_word(self) -> str:
        """Certainty by `limit_violation_ratio`: `perhaps`, `likely` (from 1.5) or `certain` (from 3, or a count)."""
        ratio, is_counted = self.limit_violation_ratio, self.cause in ("few_samples", "dropped_samples", "gap")
        return "certain" if is_counted or ratio >= 3 else "perhaps" if ratio < 1.5 else "likely"

    @property
    def location_text(self) -> str:
        """Location of the issue as text: recording, group, channel and time."""
        place = "/".join(part for part in (self.recording, self.group, self.channel) if part)
        return place if self.begin is None or self.end is None else f"{place}, {self.begin:.4g} to {self.end:.4g} s"


_LINES = Path(__file__).with_name("issue_causes.yaml").read_text(encoding="utf-8").splitlines()
ISSUE_CAUSE_DESCRIPTIONS: Mapping[str, str] = dict(line.split(": ", 1) for line in _LINES[1:])  # a tenth of YAML's time
"""Description of every cause of an issue, as shown in tables."""

SensorOptionsFunction = Callable[[str], SensorOptions]


def mean_sample_rate(t: Array) -> float:
    """Mean sample rate [Hz] of the times `t` [s]; NaN for fewer than two samples."""
    span = float(t[-1] - t[0]) if len(t) > 1 else 0.0
    return (len(t) - 1) / span if span > 0 else math.nan


def median_sample_period(t: Array) -> float:
    """Median time between samples at the times `t` [s], or zero for fewer than two samples."""
    return float(np.median(np.diff(t))) if len(t) > 1 else 0.0
