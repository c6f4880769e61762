"""What one recording says against itself: its clocks, its channels, its noise, and the same data given twice.

Nothing here needs a model; what a model says against a recording stands in `analysis.plausibility`. Limits come from
physics or statistics, with room for what robots do, and stand in `Limits`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import scipy.signal
import scipy.special
from numpy.typing import NDArray

from yid_ocp.data.recording import JointGroup, PointGroup, Recording
from yid_ocp.sensors.base import Choice
from yid_ocp.sensors.joints import DIFFERENCES, EFFORT, POSITION

Array = NDArray[np.float64]
Group = JointGroup | PointGroup
Weight = Literal["warning", "not_trusted", "refused"]

MOST = 1e3
"""Evidence beyond which nothing more is to be said."""
CLOCK_UNITS: Mapping[str, float] = {"milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9}
EPOCH = 1e8
"""A clock that counts from 1970 is beyond this, one that counts from when a robot was switched on is not [s]."""
DEGREE = math.degrees(1.0)
FEWEST = 30
"""Differences from which noise can be told."""


@dataclass(frozen=True)
class Limits:
    """From where on something counts against a recording.

    Attributes
    ----------
    slowest_joints, slowest_points : float
        Longest period of a robot's joints and of frames [s].
    dropped : float
        Part of a clock's samples that may be missing.
    clock_off : float
        Part of the joints' time by which points may start late and end late.
    rate : float
        Factor by which angles may turn faster or more slowly than the recorded velocity says.
    noise : float
        Factor by which noise may exceed what is stated.
    stuck_time : float
        How long a channel that is noisy elsewhere may repeat one value [s].
    stuck_samples : int
        How often it may.
    turned : float
        By how much the recorded velocity may turn a joint whose angle stays the same [rad].
    clipped : int
        How often a noisy effort may hit its extreme exactly.
    motion, travel : float
        Less is no motion, of any joint [rad], of any point [m].
    shared : int
        Samples that two recordings may share.
    """

    slowest_joints: float = 0.5
    slowest_points: float = 30.0
    dropped: float = 0.2
    clock_off: float = 0.2
    rate: float = 1.3
    noise: float = 3.0
    stuck_time: float = 0.3
    stuck_samples: int = 12
    turned: float = 0.03
    clipped: int = 8
    motion: float = 0.01
    travel: float = 0.002
    shared: int = 50


LIMITS = Limits()


@dataclass(frozen=True)
class Doubt:
    """One reason not to believe a recording as it is.

    Attributes
    ----------
    cause : str
        What is wrong, in one word of `CAUSES`.
    what : str
        The same in one sentence, with numbers.
    weight : {'warning', 'not_trusted', 'refused'}
        Whether a run goes on as it would (and says so), goes on but says of no number that it is found, or stops.
    evidence : float
        How many times what was seen exceeds the limit from which on it counts, 1 to `MOST`.
    advice : str
        What to do.
    recording, group, channel : str
        Where; empty for all of them.
    begin, end : float, optional
        Stretch of time on the group's clock [s]; all of it when absent.
    setting : str
        Line of configuration that repairs or describes it, where there is one.
    """

    cause: str
    what: str
    weight: Weight
    evidence: float
    advice: str
    recording: str
    group: str = ""
    channel: str = ""
    begin: float | None = None
    end: float | None = None
    setting: str = ""

    def __post_init__(self) -> None:
        if self.cause not in CAUSES:
            raise ValueError(f"there is no cause '{self.cause}'")
        object.__setattr__(self, "evidence", float(min(max(self.evidence, 1.0), MOST)))

    @property
    def sure(self) -> str:
        """How sure it is, in words."""
        return "perhaps" if self.evidence < 1.5 else "likely" if self.evidence < 3 else "certain"

    @property
    def where(self) -> str:
        """Recording, group, channel and time in one text."""
        place = "/".join(part for part in (self.recording, self.group, self.channel) if part)
        span = "" if self.begin is None or self.end is None else f", {self.begin:.4g} to {self.end:.4g} s"
        return place + span


CAUSES: Mapping[str, str] = {
    "time_unit": "times are not in seconds",
    "time_scale": "the clock runs too fast or too slowly",
    "clock_base": "clocks of two groups have nothing in common",
    "clock_offset": "the clock of one group is late or early",
    "clock_drift": "the clocks of two groups run apart",
    "clock_jump": "the clock jumps",
    "gap": "a gap in what drives the model",
    "dropped_samples": "many samples are missing",
    "standstill": "nothing moves",
    "stuck": "a channel repeats one value",
    "quantised": "a channel has steps larger than its noise",
    "saturated": "a channel is cut off at its extreme",
    "noise": "more noise than stated",
    "same_data": "the same data twice",
    "degrees": "angles are in degrees",
    "angle_scale": "an angle is multiplied by something",
    "angle_sign": "an angle has the wrong sign",
    "swapped_joints": "two joints are exchanged",
    "angle_limits": "angles are beyond the joint's limits",
    "speed_limits": "joints turn faster than they can",
    "effort_zero": "efforts are zero",
    "effort_sign": "an effort has the wrong sign",
    "effort_gain": "an effort is multiplied by something",
    "effort_offset": "an effort's zero is off",
    "effort_lag": "efforts are late",
    "effort_limits": "efforts are larger than the joint can bear",
    "effort_unlike": "efforts are not those of this robot",
    "point_scale": "lengths are not in metres",
    "point_mirrored": "points are mirrored or their axes exchanged",
    "point_frame": "points are in another frame",
    "point_swapped": "two points are exchanged",
    "point_reach": "points are where the object cannot be",
    "encoder_offset": "an encoder's zero is off",
    "point_unlike": "points are not where the robot holds them",
}
"""What may be wrong with a recording, in the words of tables."""

Choices = Callable[[str], Choice]


def check_recording(recording: Recording, choice: Choices, driving: bool = True) -> list[Doubt]:
    """Everything that one recording says against itself.

    Parameters
    ----------
    recording : Recording
        As it was read.
    choice : callable
        From a group's name to how it is used, its stated noise above all.
    driving : bool
        Whether joints drive the model, so that what lies between their samples matters.

    Returns
    -------
    list of Doubt
    """
    units = [replace(doubt, recording=recording.name) for doubt in _units_of_time(recording)]
    if units:
        return units  # nothing else can be said in times that are not seconds
    return [
        replace(doubt, recording=recording.name)
        for found in (
            _common_clock(recording),
            _dropped(recording, driving),
            _velocities(recording),
            _stuck(recording),
            _steps_and_noise(recording, choice),
            _saturated(recording),
            _standstill(recording),
        )
        for doubt in found
    ]


# -- clocks -----------------------------------------------------------------------------------------------------------


def period(t: Array) -> float:
    """Median time between samples [s]; zero for fewer than two."""
    return float(np.median(np.diff(t))) if len(t) > 1 else 0.0


def group_name(group: Group) -> str:
    """Name of a group; `joints` for the joints."""
    return group.name if isinstance(group, PointGroup) else "joints"


def _units_of_time(recording: Recording) -> Iterator[Doubt]:
    for group in recording.groups:
        step, slowest = period(group.t), LIMITS.slowest_joints
        if isinstance(group, PointGroup):
            slowest = LIMITS.slowest_points
        if step <= slowest:
            continue
        fitting = [name for name, size in CLOCK_UNITS.items() if 2e-4 <= step * size <= 2 * slowest]
        rate = f"a sample every {step:.4g} s"
        unit = fitting[0] if fitting else ""
        guess = f": in {unit} it would be {1 / (step * CLOCK_UNITS[unit]):.4g} Hz" if unit else ""
        yield Doubt(
            "time_unit",
            f"{group_name(group)}/t has {rate}{guess}",
            "refused",
            step / slowest,
            f"write times in seconds (divide by {1 / CLOCK_UNITS[unit]:.0e})" if unit else "write times in seconds",
            "",
            group_name(group),
            "t",
        )


def _common_clock(recording: Recording) -> Iterator[Doubt]:
    joints = recording.joints
    if joints is None:
        return
    first, last = joints.t[0], joints.t[-1]
    for group in recording.points:
        begin, end = group.t[0], group.t[-1]
        if end < first or begin > last:
            far = min(abs(begin - last), abs(first - end))
            epoch = (abs(begin) > EPOCH) != (abs(first) > EPOCH)
            since = "one of them counts from 1970: " if epoch else ""
            yield Doubt(
                "clock_base",
                f"{since}joints were recorded from {first:.10g} to {last:.10g} s, {group.name} from {begin:.10g} to "
                f"{end:.10g} s",
                "refused",
                MOST if epoch else 1 + far / max(last - first, 1e-9),
                "write the times of all groups on one clock",
                "",
                group.name,
                "t",
            )
            continue
        slack = max(LIMITS.clock_off * (last - first), 5 * period(group.t))
        late, over = begin - first, end - last
        shift = min(late, over) if late > 0 else max(late, over)
        if late * over > 0 and abs(shift) > slack:
            yield Doubt(
                "clock_offset",
                f"{group.name} begins {late:+.3g} s from the joints and ends {over:+.3g} s from them",
                "not_trusted",
                abs(shift) / slack,
                "shift its times to the joints' clock",
                "",
                group.name,
                "t",
            )


def _dropped(recording: Recording, driving: bool) -> Iterator[Doubt]:
    """Samples missing from an otherwise even clock of what drives the model."""
    joints = recording.joints
    if joints is None or not driving or len(joints.t) < 20:
        return
    steps = np.diff(joints.t)
    base = float(np.percentile(steps, 2))
    if base <= 0:
        return
    count = np.rint(steps / base)
    even = float(np.mean(np.abs(steps / base - count) < 0.1 * count))
    small = count[count < 50]  # what is longer is a gap
    missing = float(np.sum(small - 1) / np.sum(small))
    if even > 0.9 and missing > LIMITS.dropped:
        yield Doubt(
            "dropped_samples",
            f"{100 * missing:.2g} % of the samples of a clock of {1 / base:.4g} Hz are missing",
            "warning",
            missing / LIMITS.dropped,
            "find what lost them; between those that are left the recorded torques are interpolated",
            "",
            "joints",
            "t",
        )


# -- motion -----------------------------------------------------------------------------------------------------------


def smooth_rate(t: Array, values: Array, rates: Array) -> tuple[Array, Array]:
    """Differences of values and mean of the recorded rates over windows long enough for noise not to count.

    Parameters
    ----------
    t : ndarray, shape (N,)
    values, rates : ndarray, shape (N, k)

    Returns
    -------
    ndarray, shape (M, k)
        Changes of the values per second over windows of a fifth of a second, or of three samples.
    ndarray, shape (M, k)
        What the rates say of the same windows, by the trapezoidal rule.
    """
    width = max(3, round(0.2 / max(period(t), 1e-9)))
    starts = np.arange(0, max(len(t) - width, 1), max(1, width // 2))
    ends = np.minimum(starts + width, len(t) - 1)
    length = (t[ends] - t[starts])[:, None]
    area = np.vstack([np.zeros(rates.shape[1]), np.cumsum(0.5 * (rates[1:] + rates[:-1]) * np.diff(t)[:, None], 0)])
    good = (length[:, 0] > 0) & (length[:, 0] < 3 * np.median(length))
    by_value, by_rate = ((x[ends] - x[starts])[good] / length[good] for x in (values, area))
    return by_value, by_rate


def _velocities(recording: Recording) -> Iterator[Doubt]:
    """Angles differentiated beside recorded velocities."""
    joints = recording.joints
    if joints is None or joints.velocity is None or len(joints.t) < 50:
        return
    by_angle, by_velocity = smooth_rate(joints.t, joints.position, joints.velocity)
    names = joints.names
    ratio, fit = np.full(len(names), np.nan), np.zeros(len(names))
    for j in range(len(names)):
        x, y = by_velocity[:, j], by_angle[:, j]
        floor = max(0.02, 2 * _white(joints.t, joints.velocity[:, j]))
        if np.std(x) > floor and np.std(y) > 0:
            ratio[j] = np.sign(x @ y) * math.sqrt(float(y @ y) / float(x @ x))
            fit[j] = float(np.corrcoef(x, y)[0, 1])
    known = [j for j in range(len(names)) if math.isfinite(ratio[j]) and abs(fit[j]) > 0.8]
    wrong = [j for j in known if not 1 / LIMITS.rate <= ratio[j] <= LIMITS.rate]
    if not wrong:
        yield from _exchanged(names, by_angle, by_velocity, fit, ratio)
        return
    typical = float(np.median(ratio[known]))
    alike = bool(len(wrong) == len(known) and np.all(np.abs(ratio[known] / typical - 1) < 0.2))
    if alike and typical > 0 and len(known) >= min(2, len(names)):
        degrees = abs(typical / DEGREE - 1) < 0.1
        yield Doubt(
            "degrees" if degrees else "time_scale",
            f"all angles turn {typical:.3g} times as fast as the recorded velocities say",
            "not_trusted",
            max(typical, 1 / typical) / LIMITS.rate,
            "convert angles to radians"
            if degrees
            else f"multiply times by {typical:.3g}, or find what is wrong with velocities",
            "",
            "joints",
            "position" if degrees else "t",
        )
        return
    for j in wrong:
        cause = "angle_sign" if ratio[j] < 0 and abs(abs(ratio[j]) - 1) < LIMITS.rate - 1 else "angle_scale"
        size = abs(ratio[j])
        yield Doubt(
            cause,
            f"the angle of {names[j]} turns {ratio[j]:.3g} times as fast as its recorded velocity says",
            "not_trusted",
            MOST if cause == "angle_sign" else max(size, 1 / size) / LIMITS.rate,
            f"divide the angle of {names[j]} by {ratio[j]:.3g}",
            "",
            "joints",
            f"position.{names[j]}",
        )


def _exchanged(names: Sequence[str], by_angle: Array, by_velocity: Array, fit: Array, ratio: Array) -> Iterator[Doubt]:
    """Two angles that turn as each other's velocity says."""
    off = [j for j in range(len(names)) if math.isfinite(ratio[j]) and abs(fit[j]) < 0.5]
    for place, i in enumerate(off):
        for j in off[place + 1 :]:
            across = [float(np.corrcoef(by_angle[:, a], by_velocity[:, b])[0, 1]) for a, b in ((i, j), (j, i))]
            if min(across) > 0.9:
                yield Doubt(
                    "swapped_joints",
                    f"the angle of {names[i]} turns as the velocity of {names[j]} says, and the other way round",
                    "not_trusted",
                    min(across) / max(abs(fit[i]), abs(fit[j]), 1e-3),
                    "exchange the two columns",
                    "",
                    "joints",
                    f"position.{names[i]}",
                )


def _standstill(recording: Recording) -> Iterator[Doubt]:
    joints, moved = recording.joints, []
    if joints is not None:
        size = float(np.max(np.ptp(_smoothed(joints.position), axis=0)))
        moved.append(size / LIMITS.motion)
    for group in recording.points:
        seen = group.position[:, np.isfinite(group.position).any(axis=(0, 2))]
        size = float(np.max(np.nanmax(seen, axis=0) - np.nanmin(seen, axis=0), initial=0.0))
        known = np.zeros(0) if group.std is None else group.std[np.isfinite(group.std)]
        noise = 6 * float(np.median(known)) if len(known) else 0.0
        moved.append(size / max(LIMITS.travel, noise))
    if max(moved, default=2.0) < 1.0:
        yield Doubt(
            "standstill",
            f"no joint turns by {LIMITS.motion:g} rad and no point moves by more than its noise",
            "warning",
            1 / max(*moved, 1e-3),
            "record a motion; what a posture at rest says is all that can be found",
            "",
        )


def _smoothed(values: Array) -> Array:
    """Mean of nine neighbours, where there are so many."""
    if len(values) < 9:
        return values
    return np.asarray(scipy.signal.convolve(values, np.full((9, 1), 1 / 9), mode="valid"))


# -- channels ---------------------------------------------------------------------------------------------------------


def _channels(recording: Recording, *wanted: str) -> Iterator[tuple[str, str, Array, Array]]:
    """Group, channel, times and values (N,) or (N, 3) of what was measured."""
    joints = recording.joints
    if joints is not None:
        for quantity, values in joints.channels.items():
            for j, name in enumerate(joints.names):
                if quantity in wanted:
                    yield "joints", f"{quantity}.{name}", joints.t, values[:, j]
    for group in recording.points:
        for i, name in enumerate(group.names):
            seen = np.isfinite(group.position[:, i]).all(axis=1)
            if "points" in wanted:
                yield group.name, name, group.t[seen], group.position[seen, i]


def _stuck(recording: Recording) -> Iterator[Doubt]:
    """A channel that is noisy elsewhere repeats one value, or stays where its velocity says that it turns."""
    joints, found = recording.joints, []
    for group, channel, t, values in _channels(recording, "position", "effort", "points"):
        if len(t) <= LIMITS.stuck_samples:
            continue
        same = np.all(np.diff(values.reshape(len(t), -1), axis=0) == 0, axis=1)
        begin, end = _longest_run(same)
        count, length = end - begin, float(t[end] - t[begin])
        if count < LIMITS.stuck_samples or length < LIMITS.stuck_time:
            continue
        rest = np.delete(same, slice(begin, end))
        usual = float(np.mean(rest)) if len(rest) >= count // 4 else 1.0
        quantity, _, name = channel.partition(".")
        turned = 0.0
        if joints is not None and quantity == "position" and joints.velocity is not None:
            speed = joints.velocity[begin : end + 1, joints.names.index(name)]
            area = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * np.diff(t[begin : end + 1]))])
            turned = float(np.ptp(area))
        # of a channel that changes from sample to sample in nine of ten, so long a run is no chance
        evidence = (count / LIMITS.stuck_samples) if usual < 0.1 else 0.0
        stated = joints is not None and quantity == "position" and bool(np.all(joints.position_std or 0))
        if not len(rest) and stated:
            evidence = count / LIMITS.stuck_samples
        evidence = max(evidence, turned / LIMITS.turned if turned > LIMITS.turned else 0.0)
        if quantity == "effort" and values[begin] in (0.0, np.max(values), np.min(values)):
            continue  # no effort was recorded, or it is cut off: other causes
        if evidence >= 1:
            also = f", while its velocity turns it by {turned:.2g} rad" if turned > LIMITS.turned else ""
            found.append((group, channel, float(t[begin]), float(t[end]), evidence, also))
    for group, channel, start, stop, evidence, also in found:
        yield Doubt(
            "stuck",
            f"{channel} repeats one value for {stop - start:.3g} s{also}",
            "not_trusted",
            evidence,
            "leave that stretch or that channel out, and look at the sensor",
            "",
            group,
            channel,
            start,
            stop,
        )


def _longest_run(same: NDArray[np.bool_]) -> tuple[int, int]:
    """First and last index of the longest stretch of samples that are all the same."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], same, [False]]).astype(int)))
    if not len(edges):
        return 0, 0
    begins, ends = edges[::2], edges[1::2]
    longest = int(np.argmax(ends - begins))
    return int(begins[longest]), int(ends[longest])


def _white(t: Array, values: Array) -> float:
    """Noise that is white from sample to sample, robustly; zero for a channel with long rests or an uneven clock."""
    even = np.abs(np.diff(t) / max(period(t), 1e-12) - 1) < 0.2
    if len(t) < DIFFERENCES + FEWEST:
        return 0.0
    together = np.lib.stride_tricks.sliding_window_view(even, DIFFERENCES).all(axis=1)
    if together.sum() < FEWEST:
        return 0.0
    size = math.sqrt(float(scipy.special.comb(2 * DIFFERENCES, DIFFERENCES)))
    return float(1.4826 * np.median(np.abs(np.diff(values, DIFFERENCES)[together])) / size)


def quantum(values: Array) -> float:
    """Step of which all differences of a channel are multiples, zero where there is none."""
    levels = np.unique(values)
    if not 1 < len(levels) < 0.7 * values.size:
        return 0.0
    apart = np.diff(levels)
    step = float(np.min(apart[apart > 1e-9 * np.ptp(levels)], initial=np.inf))
    if not math.isfinite(step):
        return 0.0
    count = apart / step
    return step if np.mean(np.abs(count - np.rint(count)) < 0.05 * np.maximum(count, 1)) > 0.95 else 0.0


def _stated(recording: Recording, choice: Choices, group: str, channel: str) -> float:
    """Standard deviation that settings or recording give to a channel, zero where nobody says."""
    joints = recording.joints
    quantity, _, name = channel.partition(".")
    if group == "joints" and joints is not None:
        said = choice({"position": POSITION, "effort": EFFORT}[quantity]).std
        if isinstance(said, Mapping):
            return float(said.get(name, 0.0))
        own = joints.position_std if quantity == "position" else joints.effort_std
        given = said if said is not None else own
        if given is None:
            return 0.0
        return float(np.broadcast_to(given, (len(joints.names),))[joints.names.index(name)])
    said = choice(group).std
    if isinstance(said, (int, float)):
        return float(said)
    own_group = next(entry for entry in recording.points if entry.name == group)
    if own_group.std is None:
        return 0.0
    spread = own_group.std[:, own_group.names.index(channel)]
    return float(np.nanmedian(spread)) if np.any(np.isfinite(spread)) else 0.0


def _steps_and_noise(recording: Recording, choice: Choices) -> Iterator[Doubt]:
    """Steps and noise beside the noise that is stated; where frames are as slow as the motion nothing can be said."""
    for group, channel, t, values in _channels(recording, "position", "effort", "points"):
        if len(t) < 100 or period(t) > 0.05:
            continue
        stated = _stated(recording, choice, group, channel)
        columns = values.reshape(len(t), -1).T
        step = max(quantum(column) for column in columns)
        size, wide = step / math.sqrt(12), float(np.ptp(values))
        # an angle that hardly moves has few levels by nature
        few = step > wide / 16 and wide > (5 * LIMITS.motion if channel.startswith("position") else 0.0)
        setting = f"sensors.{'joints.' + channel.partition('.')[0] if group == 'joints' else group}.std"
        if step > 0 and (size > LIMITS.noise * stated > 0 or (few and stated == 0)):
            yield Doubt(
                "quantised",
                f"{channel} moves in steps of {step:.3g}, which is noise of {size:.2g}"
                + (f"; {stated:.2g} is stated" if stated else ""),
                "not_trusted",
                size / (LIMITS.noise * stated) if stated else 16 * step / wide,
                "state the noise that the steps make, or record with more digits",
                "",
                group,
                channel,
                setting=f"{setting}: {size:.2g}",
            )
            continue
        seen = max(_white(t, column) for column in columns)
        if _clock(recording, group) == "nominal":
            # when a sample was taken is known to half a period, which looks like noise wherever something moves
            seen -= min(seen, 0.5 * max(float(np.mean(np.abs(np.diff(column)))) for column in columns))
        if seen > LIMITS.noise * stated > 0:
            yield Doubt(
                "noise",
                f"{channel} has noise of {seen:.2g} from sample to sample; {stated:.2g} is stated",
                "not_trusted",
                seen / (LIMITS.noise * stated),
                "state the noise that is there",
                "",
                group,
                channel,
                setting=f"{setting}: {seen:.2g}",
            )


def _clock(recording: Recording, name: str) -> str:
    return next(group.clock for group in recording.groups if group_name(group) == name)


def _saturated(recording: Recording) -> Iterator[Doubt]:
    """Efforts that meet their extreme again and again, to the last digit."""
    if recording.joints is not None and recording.joints.effort_taken_as == "command":
        return  # a controller's own bound is no sensor's
    for group, channel, t, values in _channels(recording, "effort"):
        for sign in (1.0, -1.0):
            levels, counts = np.unique(sign * values, return_counts=True)
            near = (levels > levels[-1] - 0.05 * np.ptp(levels)) & (levels < levels[-1])
            at = sign * values == levels[-1]
            # a value that many samples share while none of its neighbours has a fifth as many, held again and again
            held = int(np.sum(np.diff(np.flatnonzero(at)) == 1))
            apart = int(np.sum(np.diff(np.flatnonzero(at)) > 1)) + 1
            alone = at.sum() >= LIMITS.clipped and at.sum() > 5 * np.max(counts[near], initial=0)
            if alone and len(levels) > FEWEST and held >= LIMITS.clipped / 2 and apart >= 2:
                first, last = np.flatnonzero(at)[[0, -1]]
                yield Doubt(
                    "saturated",
                    f"{channel} is exactly {sign * levels[-1]:.4g} N m in {at.sum()} samples and never beyond",
                    "not_trusted",
                    at.sum() / LIMITS.clipped,
                    "leave what is cut off out, or record within the sensor's range",
                    "",
                    group,
                    channel,
                    float(t[first]),
                    float(t[last]),
                )


# -- several recordings -----------------------------------------------------------------------------------------------


def shared_samples(one: Recording, other: Recording) -> int:
    """How many samples of motion two recordings have in common, to the last digit."""
    if one.joints is not None and other.joints is not None:
        return _common(_rows(one.joints), _rows(other.joints))
    others = {group.name: group for group in other.points}
    return max((_common(_rows(g), _rows(others[g.name])) for g in one.points if g.name in others), default=0)


def _rows(group: Group) -> Array:
    if isinstance(group, PointGroup):
        return np.nan_to_num(group.position.reshape(len(group.t), -1))
    return group.position if group.effort is None else np.hstack([group.position, np.nan_to_num(group.effort)])


def _common(one: Array, other: Array) -> int:
    if one.shape[1] != other.shape[1]:
        return 0
    pairs = ({row.tobytes() for row in np.ascontiguousarray(rows)} for rows in (one, other))
    return len(set.intersection(*pairs))


def same_data(one: Recording, other: Recording) -> Doubt | None:
    """The doubt that two recordings are the same measurement, at least in part; it names the second."""
    count = shared_samples(one, other)
    few = min(len(group.t) for recording in (one, other) for group in recording.groups[:1])
    if count < min(LIMITS.shared, 0.5 * few):
        return None
    return Doubt(
        "same_data",
        f"{count} samples of {other.name} are those of {one.name} to the last digit",
        "warning",
        MOST,
        "list every measurement once",
        other.name,
    )
