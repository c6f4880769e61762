"""Recordings in memory: joint groups, point groups, other sensors, and their validation."""

from __future__ import annotations

import numbers
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from yid_ocp.arrays import Array, BoolArray
from yid_ocp.display import ReprMixin, ReprTexts, count_with_noun
from yid_ocp.errors import DataError, require_known_names, unknown_name_error_arguments
from yid_ocp.sensors.base import CHANNEL_KINDS, EffortSamplingKind, RecordedChannelSpec, channel_specs_for_group_name

TimestampKind = Literal["recorded", "nominal"]

JOINT_CHANNEL_UNITS: Mapping[str, str] = {
    "position": "rad",
    "velocity": "rad/s",
    "effort": "N m",
    "position_command": "rad",
    "velocity_command": "rad/s",
    "external_effort": "N m",
    "torque_enable": "1",
}
"""Channels of a joint group and their units."""

_STD_NAMES = ("position_std", "velocity_std", "effort_std", "effort_bias_std")
JOINT_NOISE_AND_SERVO_CONSTANT_NAMES = (*_STD_NAMES, "position_resolution", "proportional_gain")
"""Names of the optional constants of a joint group. A constant is one number for all joints, or one for each joint."""
POINT_GROUP_NAME_PATTERN = re.compile(r"points(_[^/]+)?")  # pattern of allowed names of point groups
_CONTROL_CHARACTER = re.compile(r"[\x00-\x1f\x7f-\x9f\ud800-\udfff]")  # what terminals obey and HDF5 cannot store

_POINT_ARRAY = "a row for each time, an entry for each point, 3 coordinates"
_LARGEST = {"1": 1.0, "rad": 50.0, "rad/s": 1e6, "N m": 1e9}
"""Largest accepted values by unit: eight turns, which angles in degrees nearly always exceed, or beyond any machine."""
_LARGEST_SPREAD = 1e9  # its square is finite
_LARGEST_DISTANCE = 50.0  # beyond any motion capture volume [m]; objects in millimetres exceed it
_TIME_TOLERANCE = 1e-9  # a nominal clock is a sum of rounded periods, so its end is seldom exactly the number asked for


@dataclass(frozen=True, eq=False, repr=False)
class JointGroup(ReprMixin):
    """Joint measurements of a robot: N samples of nj joints with a common clock. Arrays are copied and read-only.

    Attributes
    ----------
    names : tuple of str, length nj
        Joint names as in the URDF.
    t : ndarray, shape (N,)
        Strictly increasing time [s].
    position, velocity, effort : ndarray, shape (N, nj)
        Measured values [rad], [rad/s], [N m].
    position_command, velocity_command : ndarray, shape (N, nj), or None
        Positions and velocities that the controller was commanded to reach [rad], [rad/s].
    external_effort : ndarray, shape (N, nj), or None
        Measured effort minus the effort that the robot's own model predicts [N m].
    position_std, velocity_std, effort_std, effort_bias_std : float or ndarray, shape (nj,), or None
        Standard deviations of white noise, and of a constant error of a joint's effort [rad], [rad/s], [N m].
    torque_enable : ndarray, shape (N, nj), or None
        One if a servo's motor is on, zero if it is off.
    position_resolution, proportional_gain : float or ndarray, shape (nj,), or None
        Step of the encoder [rad]; proportional gain set in a servo's firmware, in the firmware's unit.
    effort_kind : {'sample', 'mean', 'command'} or None
        Meaning of `effort[k]`: torque at t_k, mean torque from t_k to t_{k+1}, or command held from t_k to t_{k+1}.
    clock : {'recorded', 'nominal'}
        Whether `t` was measured or is a sample index times a nominal period.
    """

    name: ClassVar[str] = "joints"

    names: tuple[str, ...]
    t: Array
    position: Array
    velocity: Array | None = None
    effort: Array | None = None
    position_command: Array | None = None
    velocity_command: Array | None = None
    external_effort: Array | None = None
    torque_enable: Array | None = None
    position_std: float | Array | None = None
    velocity_std: float | Array | None = None
    effort_std: float | Array | None = None
    effort_bias_std: float | Array | None = None
    position_resolution: float | Array | None = None
    proportional_gain: float | Array | None = None
    effort_kind: EffortSamplingKind | None = None
    clock: TimestampKind = "recorded"

    def __post_init__(self) -> None:
        _freeze_arrays(self, ("t", *JOINT_CHANNEL_UNITS))
        for name in JOINT_NOISE_AND_SERVO_CONSTANT_NAMES:
            if getattr(self, name) is not None:
                object.__setattr__(self, name, _constant(getattr(self, name), f"joints, attribute {name}"))

    @property
    def values_by_channel(self) -> dict[str, Array]:
        """Recorded arrays (N, nj) by channel name, such as `position`. Units are in `JOINT_CHANNEL_UNITS`."""
        return {name: getattr(self, name) for name in JOINT_CHANNEL_UNITS if getattr(self, name) is not None}

    @property
    def effort_sampling_kind_or_default(self) -> EffortSamplingKind:
        """Meaning of the effort samples: `effort_kind`. If it is None: `sample`, as drivers publish them."""
        return self.effort_kind or "sample"

    def _summary(self) -> ReprTexts:
        count = count_with_noun(len(self.names), "joint")
        rows = [("joint",), *((name,) for name in self.names)]
        return ReprTexts(f"{count}, {_sampled(self.t)}: {', '.join(self.values_by_channel)}", rows)

    def _rows(self, rows: BoolArray) -> JointGroup:
        changes: dict[str, Any] = {name: value[rows] for name, value in self.values_by_channel.items()}
        return replace(self, t=self.t[rows], **changes)


@dataclass(frozen=True, eq=False, repr=False)
class PointGroup(ReprMixin):
    """Positions of np named points at M times, from one sensor with its own clock. Arrays are copied and read-only.

    Attributes
    ----------
    name : str
        `points`, or `points_` and a word chosen by the user (`points_camera`, `points_arm`).
    t : ndarray, shape (M,)
        Strictly increasing time [s].
    position : ndarray, shape (M, np, 3)
        Position in `frame` [m]; three NaN if a point was not seen.
    std : ndarray, shape (M, np, 3), or None
        Standard deviation of the noise [m]; a single number is broadcast.
    sensor_name, frame : str
        Name of the sensor that measured the points, such as `arm`, and their reference frame.
    camera_pose : ndarray, shape (4, 4), or None
        For a camera: the transform from camera to world coordinates [m].
    clock : {'recorded', 'nominal'}
        As in `JointGroup`.
    clock_offset_std : float or None
        Standard deviation of the unknown constant offset of `t` from the joints' clock [s]; None if not stated.
    """

    name: str
    names: tuple[str, ...]
    t: Array
    position: Array
    std: Array | None = None
    sensor_name: str = "unknown"
    frame: str = "world"
    camera_pose: Array | None = None
    clock: TimestampKind = "recorded"
    clock_offset_std: float | None = None

    def __post_init__(self) -> None:
        _freeze_arrays(self, ("t", "position", "std", "camera_pose"))
        if self.std is not None and self.std.ndim == 0:
            object.__setattr__(self, "std", np.full(self.position.shape, float(self.std)))
            _freeze_arrays(self, ("std",))

    def _summary(self) -> ReprTexts:
        seen = np.isfinite(self.position).all(axis=2).sum(axis=0)
        rows = [("point", "seen"), *((name, str(count)) for name, count in zip(self.names, seen, strict=True))]
        count = count_with_noun(len(self.names), "point")
        return ReprTexts(f"{self.name}, {count}, {_sampled(self.t)}, in {self.frame}", rows)

    def _rows(self, rows: BoolArray) -> PointGroup:
        std = None if self.std is None else self.std[rows]
        return replace(self, t=self.t[rows], position=self.position[rows], std=std)


@dataclass(frozen=True, eq=False, repr=False)
class SensorChannelGroup(ReprMixin):
    """Samples of one additional sensor, such as a current sensor, with its own clock. Arrays are read-only copies.

    Attributes
    ----------
    name : str
        Group of a kind of sensor, such as `motors`, optionally with `_` and a word chosen by the user.
    names : tuple of str, length k
        Names of the columns, such as joints.
    t : ndarray, shape (M,)
        Strictly increasing time [s].
    values_by_quantity : mapping of quantity to ndarray, shape (M, k) or (M, k, components)
        Values in the channel's unit.
    noise_and_bias_stds_by_attribute : mapping of str to float or ndarray, shape (k,)
        Standard deviations of white noise (`QUANTITY_std`) and of a constant error (`QUANTITY_bias_std`), in its unit.
    clock : {'recorded', 'nominal'}
        As in `JointGroup`.
    """

    name: str
    names: tuple[str, ...]
    t: Array
    values_by_quantity: Mapping[str, Array]
    noise_and_bias_stds_by_attribute: Mapping[str, float | Array] = field(default_factory=dict)
    clock: TimestampKind = "recorded"

    def __post_init__(self) -> None:
        _freeze_arrays(self, ("t",))
        values = {key: read_only_copy(value, f"{self.name}/{key}") for key, value in self.values_by_quantity.items()}
        known = self.noise_and_bias_stds_by_attribute.items()
        stds = {key: _constant(std, f"{self.name}, attribute {key}") for key, std in known}
        object.__setattr__(self, "values_by_quantity", values)
        object.__setattr__(self, "noise_and_bias_stds_by_attribute", stds)

    def _summary(self) -> ReprTexts:
        quantities = ", ".join(self.values_by_quantity)
        return ReprTexts(f"{self.name}, {', '.join(self.names)}, {_sampled(self.t)}: {quantities}")

    def _rows(self, rows: BoolArray) -> SensorChannelGroup:
        values = {key: value[rows] for key, value in self.values_by_quantity.items()}
        return replace(self, t=self.t[rows], values_by_quantity=values)


@dataclass(frozen=True, eq=False, repr=False)
class Recording(ReprMixin):
    """One recording of a robot or a virtual experiment in SI units. `validated_recording` checks it.

    Attributes
    ----------
    joints : JointGroup or None
        Positions, velocities, efforts and commands of the joints (revolute: rad, rad/s, N m; prismatic: m, m/s, N).
    points, channel_groups : tuple of PointGroup, tuple of SensorChannelGroup
        Measured points and the channels of other sensors, each group with its own clock.
    name, sha256 : str, str or None
        Short name (the file name without suffix), and hash of the file.
    true_parameters : mapping of str to float
        Parameter values of a virtual experiment, in the parameters' units; empty for a real recording.
    marker_reference_pose : ndarray, shape (np, 3), or None
        Positions of the points of the first group while the object was held straight, in that group's frame [m].
    notes : tuple of str
        Sentences on content that an import omitted or changed.
    """

    joints: JointGroup | None = None
    points: tuple[PointGroup, ...] = ()
    description: str = ""
    source: str = ""
    name: str = "recording"
    sha256: str | None = None
    true_parameters: Mapping[str, float] = field(default_factory=dict)
    marker_reference_pose: Array | None = None
    notes: tuple[str, ...] = ()
    channel_groups: tuple[SensorChannelGroup, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "true_parameters", dict(self.true_parameters))
        for name in ("points", "channel_groups", "notes"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        if self.marker_reference_pose is not None:
            object.__setattr__(self, "marker_reference_pose", read_only_copy(self.marker_reference_pose, "straight"))

    def _summary(self) -> ReprTexts:
        names = {"joint": self.joint_names, "point": self.point_names}
        counts = " and ".join(count_with_noun(len(own), noun) for noun, own in names.items())
        rows = [("group", "names", "samples", "channels")]
        for g in self.all_groups:
            quantities = getattr(g, "values_by_quantity", ("position",))
            channels = g.values_by_channel if isinstance(g, JointGroup) else quantities
            rows.append((g.name, ", ".join(g.names), _sampled(g.t), ", ".join(channels)))
        span = f", {self.duration:.4g} s" if self.all_groups else ""
        return ReprTexts(f"'{self.name}', {counts}{span}", rows)

    @property
    def joint_and_point_groups(self) -> tuple[JointGroup | PointGroup, ...]:
        """The joint group, if any, followed by the point groups."""
        return ((self.joints,) if self.joints is not None else ()) + self.points

    @property
    def all_groups(self) -> tuple[JointGroup | PointGroup | SensorChannelGroup, ...]:
        """All groups of the recording: joints, then points, then channels of additional sensors."""
        return (*self.joint_and_point_groups, *self.channel_groups)

    @property
    def sensor_setting_keys(self) -> tuple[str, ...]:
        """Keys allowed under `sensors` in the settings for this recording, such as `joints.effort`."""
        own = [key for key, kind in CHANNEL_KINDS.items() if self.joints is not None and kind.group == "joints"]
        own += [group.name for group in self.points]
        own += [f"{group.name}.{quantity}" for group in self.channel_groups for quantity in group.values_by_quantity]
        return tuple(own)

    @property
    def mounted_sensor_channels(self) -> list[tuple[str, SensorChannelGroup, RecordedChannelSpec]]:
        """Recorded vectors of sensors on a link: key under `sensors` in the settings, group and kind of channel."""
        pairs = ((group, kind) for group in self.channel_groups for kind in channel_specs_for_group_name(group.name))
        found = ((g, kind) for g, kind in pairs if kind.components and kind.quantity in g.values_by_quantity)
        return [(f"{group.name}.{kind.quantity}", group, kind) for group, kind in found]

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the recorded joints, length nj; empty without a joint group."""
        return () if self.joints is None else self.joints.names

    @property
    def point_names(self) -> tuple[str, ...]:
        """Names of the points of all groups, without repetitions, in order of appearance."""
        return tuple(dict.fromkeys(name for group in self.points for name in group.names))

    def group_of_point(self, name: str) -> PointGroup:
        """Return the first group that has the point `name`. Raises `DataError` if it is not recorded."""
        require_known_names([name], self.point_names, "point", f"recording '{self.name}'", DataError)
        return next(group for group in self.points if name in group.names)

    def point_positions(self, names: Sequence[str], t: Array | None = None) -> Array:
        """Return the positions (M, len(names), 3) [m] of points at times `t` (default: those of the first point).

        They are interpolated linearly, and NaN outside of a group's times. `DataError` if a point is not recorded.
        """
        found, groups = [], [self.group_of_point(name) for name in names]
        for name, group in zip(names, groups, strict=True):
            columns, at = group.position[:, group.names.index(name)].T, groups[0].t if t is None else t
            found.append(np.stack([np.interp(at, group.t, column, np.nan, np.nan) for column in columns], axis=1))
        return np.stack(found, axis=1)

    @property
    def duration(self) -> float:
        """Time from the earliest to the latest sample of all groups [s]."""
        return float(max(group.t[-1] for group in self.all_groups) - min(group.t[0] for group in self.all_groups))

    def with_effort_sampling_kind(self, kind: EffortSamplingKind | None) -> Recording:
        """Return a copy with another `effort_kind`, or the same recording if `kind` is None or there are no joints."""
        if kind is None or self.joints is None:
            return self
        return replace(self, joints=replace(self.joints, effort_kind=kind))

    def time_slice(self, start: float, stop: float) -> Recording:
        """Return a copy with the samples from `start` to `stop` [s]. Groups without such samples are omitted.

        Raises `DataError` if there are no samples in this interval, or if `start` is not before `stop`.
        """
        masks = [(g.t >= start - _TIME_TOLERANCE) & (g.t <= stop + _TIME_TOLERANCE) for g in self.all_groups]
        kept = [group._rows(mask) for group, mask in zip(self.all_groups, masks, strict=True) if mask.any()]
        first, last = min(g.t[0] for g in self.all_groups), max(g.t[-1] for g in self.all_groups)
        what, allowed = f"nothing was recorded from {start:g} s to {stop:g} s", f"within {first:g} s to {last:g} s"
        where, hint = f"recording '{self.name}'", f"pass for example start={first:g}, stop={last:g}"
        raise_data_error_unless(start < stop and kept, what, where, f"start < stop, {allowed}", hint)
        joints = next((group for group in kept if isinstance(group, JointGroup)), None)
        points = tuple(group for group in kept if isinstance(group, PointGroup))
        channels = tuple(group for group in kept if isinstance(group, SensorChannelGroup))
        straight = self.marker_reference_pose if points and points[0].name == self.points[0].name else None
        return replace(self, joints=joints, points=points, channel_groups=channels, marker_reference_pose=straight)


def validated_recording(recording: Recording, *, allow_nan_effort: bool = False, where: str = "") -> Recording:
    """Check shapes, clocks, names, values and units of a recording, and return it unchanged.

    `allow_nan_effort` permits NaN in `effort` and `external_effort`. Errors call the recording `where`, or its name.
    Raises `DataError`, also if a position exceeds 50 rad or a coordinate 50 m, which indicates degrees or millimetres,
    or if a speed or effort is beyond any machine. Three NaN are a point that was not seen; one or two are an error.
    """
    origin = where or f"recording '{recording.name}'"
    allowed = "numbers of joints, points or another sensor"
    hint = "import more data, such as columns of a table: --columns COLUMN=position:JOINT (or x:POINT, force_x:SENSOR)"
    raise_data_error_unless(recording.all_groups, "the recording has no measurements", origin, allowed, hint)
    texts = (("description", recording.description), ("source", recording.source))
    _check_text(origin, *texts, *(("notes", note) for note in recording.notes))
    for key, value in recording.true_parameters.items():
        good = isinstance(value, numbers.Real) and not isinstance(value, bool) and bool(np.isfinite(value))
        what, hint = f"the true value of '{key}' is {value!r}", f"write a number, or remove '{key}'"
        raise_data_error_unless(good, what, f"{origin}: truth", "a finite number", hint)
    if recording.joints is not None:
        _validate_joints(recording.joints, f"{origin}: joints", allow_nan_effort)
    for noun, groups in (("points", recording.points), ("sensor channels", recording.channel_groups)):
        for name, count in Counter(group.name for group in groups).items():
            what = f"two groups of {noun} are called '{name}'"
            raise_data_error_unless(count == 1, what, origin, "every name once", f"rename one of them to {name}_2")
    for group in recording.points:
        legal = POINT_GROUP_NAME_PATTERN.fullmatch(group.name)
        what, hint = f"a group of points is called '{group.name}'", f"rename it, for example to points_{group.name}"
        raise_data_error_unless(legal, what, origin, "points, points_<name>", hint)
        _validate_points(group, f"{origin}: {group.name}")
    for channels in recording.channel_groups:
        _validate_channels(channels, f"{origin}: {channels.name}")
    if recording.marker_reference_pose is not None:
        _validate_straight(recording.marker_reference_pose, recording.points, f"{origin}: straight")
    return recording


def _sampled(t: Array) -> str:
    rate = (len(t) - 1) / (t[-1] - t[0]) if len(t) > 1 else 0.0
    return f"{count_with_noun(len(t), 'sample')} at {rate:.4g} Hz" if rate else count_with_noun(len(t), "sample")


def raise_data_error_unless(condition: object, what: str, where: str, allowed: str, hint: str) -> None:
    """Raise a `DataError` with the texts `what`, `where`, `allowed` and `hint` unless a condition holds."""
    if not condition:
        raise DataError(what, where=where, allowed=allowed, hint=hint)


def read_only_copy(value: ArrayLike, where: str) -> Array:
    """Copy an array as read-only float64. Raises `DataError` if it cannot be converted."""
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        what = "the value is not an array of numbers with rows of equal length"
        hint = "write an equal count of numbers in all rows"
        raise DataError(what, where=where, allowed="an array of real numbers", hint=hint) from error
    array.setflags(write=False)
    return array


def _constant(value: ArrayLike, where: str) -> float | Array:
    array = read_only_copy(value, where)
    return float(array) if array.ndim == 0 else array


def _freeze_arrays(group: JointGroup | PointGroup | SensorChannelGroup, names: Iterable[str]) -> None:
    """Convert the named fields of a new group to read-only arrays, except None, and its `names` to a tuple."""
    object.__setattr__(group, "names", tuple(group.names))
    for name in (name for name in names if getattr(group, name) is not None):
        object.__setattr__(group, name, read_only_copy(getattr(group, name), f"{group.name}/{name}"))


def _validate_joints(joints: JointGroup, where: str, allow_nan_effort: bool) -> None:
    _check_names_and_clock(joints, where)
    for channel, value in joints.values_by_channel.items():
        place = f"{where}/{channel}"
        _check_shape(value, (len(joints.t), len(joints.names)), place, "a row for each time, a column for each joint")
        is_effort = channel in ("effort", "external_effort")
        bad = np.isinf(value) if is_effort and allow_nan_effort else ~np.isfinite(value)
        if bad.any():
            row, column = (int(index[0]) for index in np.nonzero(bad))
            what = f"channel '{channel}' has {count_with_noun(int(bad.sum()), 'missing or infinite value')}, "
            what += f"the first of joint '{joints.names[column]}' at t = {joints.t[row]:g} s"
            hint = "delete the samples at these times from the file, of all joints (short gaps are interpolated)"
            hint += ", or leave out this channel" * (channel != "position")
            hint += ", or use read_recording(..., allow_nan_effort=True)" if is_effort else ""
            raise DataError(what, where=place, allowed="finite numbers", hint=hint)
        unit, size = JOINT_CHANNEL_UNITS[channel], np.nan_to_num(np.abs(value))
        row, column = divmod(int(size.argmax()), len(joints.names))
        what = f"'{channel}' reaches {size.max():g} {unit} (joint '{joints.names[column]}', {joints.t[row]:g} s)"
        cause, units = ("if angles are in degrees", "deg") if unit == "rad" else ("check its unit", f"{channel}=UNIT")
        hint = f"{cause}, import the original data again with --units {units}"
        raise_data_error_unless(size.max() <= _LARGEST[unit], what, place, f"at most {_LARGEST[unit]:g} {unit}", hint)
    enabled = joints.torque_enable
    ok = enabled is None or np.isin(enabled, (0.0, 1.0)).all()
    what, allowed = "torque_enable has a value that is neither 0 nor 1", "0 (motor off) or 1 (motor on)"
    raise_data_error_unless(ok, what, f"{where}/torque_enable", allowed, "write 0 and 1, or leave torque_enable out")
    for name in JOINT_NOISE_AND_SERVO_CONSTANT_NAMES:
        std, place = getattr(joints, name), f"{where}, attribute {name}"
        if std is not None:
            _validate_std(std, len(joints.names), name, place, "one number, or one for each joint")
    if joints.effort_kind is not None:
        place, kinds = f"{where}, attribute effort_kind", get_args(EffortSamplingKind)
        what, hint = f"effort_kind is '{joints.effort_kind}', which is unknown", "leave the attribute out if in doubt"
        raise_data_error_unless(joints.effort_kind in kinds, what, place, ", ".join(kinds), hint)


def _validate_points(group: PointGroup, where: str) -> None:
    _check_names_and_clock(group, where)
    _check_text(where, ("sensor", group.sensor_name), ("frame", group.frame))
    _check_shape(group.position, (len(group.t), len(group.names), 3), f"{where}/position", _POINT_ARRAY)
    unseen = np.isnan(group.position).all(axis=2)
    if (bad := ~np.isfinite(group.position).all(axis=2) & ~unseen).any():
        row, column = (int(index[0]) for index in np.nonzero(bad))
        position = np.round(group.position[row, column], 6).tolist()
        what = f"the position of point '{group.names[column]}' is {position} m at t = {group.t[row]:g} s"
        allowed, hint = "three finite coordinates, or three NaN", "write three NaN where the point was not seen"
        raise DataError(what, where=f"{where}/position", allowed=allowed, hint=hint)
    _check_distances(group.position[~unseen], f"{where}/position")
    if group.std is not None:
        _check_shape(group.std, group.position.shape, f"{where}/std", f"one number, or {_POINT_ARRAY}")
        seen = group.std[~unseen]
        wrong = seen[~((seen >= 0) & (seen <= _LARGEST_SPREAD))]
        what = f"the standard deviation of a point that was seen is {next(iter(wrong), 0.0):g} m"
        hint = "write the sensor's noise, such as 0.002, wherever the point was seen"
        raise_data_error_unless(wrong.size == 0, what, f"{where}/std", f"0 to {_LARGEST_SPREAD:g} m", hint)
    if group.camera_pose is not None:
        _check_pose(group.camera_pose, f"{where}, attribute pose")
    if group.clock_offset_std is not None:
        _validate_std(group.clock_offset_std, 0, "clock_offset_std", f"{where}, attribute", "one number [s]")


def _check_distances(positions: Array, where: str) -> None:
    largest, hint = float(np.abs(positions).max(initial=0.0)), "if it is in millimetres, import with --units points=mm"
    what, allowed = f"a coordinate reaches {largest:g} m", f"coordinates in metres, up to {_LARGEST_DISTANCE:g}"
    raise_data_error_unless(largest <= _LARGEST_DISTANCE, what, where, allowed, hint)


def _validate_channels(group: SensorChannelGroup, where: str) -> None:
    _check_names_and_clock(group, where)
    declared = {channel.quantity: channel for channel in channel_specs_for_group_name(group.name)}
    fields = [name for channel in declared.values() for name in channel.std_attribute_names]
    own, stds = group.values_by_quantity, group.noise_and_bias_stds_by_attribute
    hint = "add one of the allowed datasets, or leave the group out"
    allowed = ", ".join(declared) or ", ".join(CHANNEL_KINDS)
    raise_data_error_unless(own, "the group has no dataset of measured values", where, allowed, hint)
    for noun, found, known in (("dataset", own, declared), ("attribute", stds, fields)):
        for name in found:
            what, hint = f"the group has an unknown {noun}, '{name}'", f"rename or remove the {noun} '{name}'"
            raise_data_error_unless(name in known, what, where, **unknown_name_error_arguments(name, known, hint))
    for quantity, values in own.items():
        parts = len(declared[quantity].components)
        shape = (len(group.t), len(group.names), *([parts] if parts else []))
        _check_shape(values, shape, f"{where}/{quantity}", "a row for each time, an entry for each name")
        what, hint = f"{quantity} has a value that is not finite", "remove the samples in which a value is missing"
        raise_data_error_unless(np.isfinite(values).all(), what, f"{where}/{quantity}", "finite numbers", hint)
    for name, std in stds.items():
        _validate_std(std, len(group.names), name, f"{where}, attribute {name}", "one number, or one for each name")


def _validate_std(std: float | Array, count: int, name: str, where: str, allowed: str) -> None:
    if np.ndim(std) > 0:
        _check_shape(np.asarray(std), (count,), where, allowed)
    good = np.all((np.asarray(std) >= 0) & (np.asarray(std) <= _LARGEST_SPREAD))
    raise_data_error_unless(good, f"{name} is {std}", where, f"0 to {_LARGEST_SPREAD:g}", f"leave {name} out if unsure")


def _validate_straight(straight: Array, groups: Sequence[PointGroup], where: str) -> None:
    allowed, hint = "`straight` together with a group of points", "add the group of points, or leave `straight` out"
    raise_data_error_unless(groups, "the recording has `straight`, but no group of points", where, allowed, hint)
    _check_shape(straight, (len(groups[0].names), 3), where, "a row for each point of the first group, 3 coordinates")
    what, hint = "`straight` has a position that is not finite", "measure all points, or leave `straight` out"
    raise_data_error_unless(np.isfinite(straight).all(), what, where, "finite coordinates of every point [m]", hint)
    _check_distances(straight, where)
    # a file lists its groups by name, so other orders are not stored
    first = min(groups, key=lambda group: group.name.encode())
    what = f"the positions belong to '{groups[0].name}', but a file would list '{first.name}' first"
    raise_data_error_unless(first is groups[0], what, where, "point groups sorted by name", "sort them by name")


def _check_pose(pose: Array, where: str) -> None:
    _check_shape(pose, (4, 4), where, "a rigid transform")
    rotation, allowed = pose[:3, :3], "a rotation, a translation [m] and the last row 0 0 0 1"
    last_is_unit = np.allclose(pose[3], np.eye(4)[3], rtol=0, atol=1e-6)
    with np.errstate(all="ignore"):
        orthonormal, det = np.allclose(rotation.T @ rotation, np.eye(3), rtol=0, atol=1e-6), np.linalg.det(rotation)
    for good, what, hint in (
        (np.isfinite(pose).all(), "has a value that is not finite", "write finite numbers, or leave the pose out"),
        (last_is_unit, f"has the last row {pose[3].tolist()}", "transpose the pose, or write 0 0 0 1 as its last row"),
        (orthonormal, "has axes that are not orthonormal", "write the rotation with 7 digits and without a scale"),
        (det > 0, "contains a reflection", "reverse the signs of one column of the rotation"),
    ):
        raise_data_error_unless(good, f"the pose {what}", where, allowed, hint)


def _check_names_and_clock(group: JointGroup | PointGroup | SensorChannelGroup, where: str) -> None:
    place, allowed = f"{where}, names", "one name for every column, each once"
    raise_data_error_unless(group.names, "the group has no names", where, allowed, "write them into its entry `names`")
    allowed, hint = "one sample or more", "import the data again, with samples of this group or without it"
    raise_data_error_unless(group.t.size > 0, f"the group '{group.name}' has no samples", where, allowed, hint)
    for name, count in Counter(group.names).items():
        usable = isinstance(name, str) and name and not _CONTROL_CHARACTER.search(name)
        what, allowed = f"the name {name!r} cannot be used", "a text that is not empty and has no control characters"
        raise_data_error_unless(usable, what, place, allowed, "use letters, digits and underscores, as in left_s0")
        what, hint = f"the name '{name}' occurs {count} times", f"rename all but one, for example to '{name}_2'"
        raise_data_error_unless(count == 1, what, place, "every name once", hint)
    clocks, place, hint = get_args(TimestampKind), f"{where}, attribute clock", "leave it out if times were measured"
    raise_data_error_unless(group.clock in clocks, f"the clock is '{group.clock}'", place, " or ".join(clocks), hint)
    _check_shape(group.t, (group.t.size,), f"{where}/t", "one-dimensional")
    bad = np.flatnonzero(~np.isfinite(group.t))
    what = f"the time at index {next(iter(bad), 0)} is {group.t[next(iter(bad), 0)]}"
    raise_data_error_unless(bad.size == 0, what, f"{where}/t", "finite times [s]", "remove the sample in every channel")
    if (backward := np.flatnonzero(np.diff(group.t) <= 0)).size:
        index = int(backward[0])
        before, after = float(group.t[index]), float(group.t[index + 1])
        what = f"the clock does not advance from sample {index + 1} to {index + 2}: {before!r} s, then {after!r} s"
        allowed, hint = "strictly increasing times", f"remove repeated samples ({np.sum(np.diff(group.t) == 0)} in all)"
        if after < before:
            hint = "if the clock was set back, cut the file here into two recordings; if rows are mixed, sort by time"
        raise DataError(what, where=f"{where}/t", allowed=allowed, hint=hint)


def _check_shape(array: Array, shape: tuple[int, ...], where: str, allowed: str) -> None:
    what = f"the array has shape {array.shape}, but must have {shape}"
    hint = "transpose it" if array.shape[::-1] == shape else "correct the array, or the times and names beside it"
    raise_data_error_unless(array.shape == shape, what, where, allowed, hint)


def _check_text(where: str, *texts: tuple[str, str]) -> None:
    for name, text in texts:
        # HDF5 ends text at the first null character and stores it as UTF-8
        storable = "\0" not in text and not any("\ud800" <= letter <= "\udfff" for letter in text)
        what, allowed = f"the text {text!r} cannot be stored", "Unicode text without null characters and surrogates"
        raise_data_error_unless(storable, what, f"{where}, attribute {name}", allowed, "remove these characters")
