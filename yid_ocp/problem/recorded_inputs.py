"""The inputs of a rollout from a recording: torques, commands, prescribed paths and joint angles."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import scipy.interpolate
import scipy.special

from yid_ocp.arrays import Array, BoolArray
from yid_ocp.data.channel_checks import median_sample_period, noise_or_quantization_std
from yid_ocp.data.recording import JointGroup, Recording
from yid_ocp.display import grouped
from yid_ocp.effects import EFFECTS, signal_kinds_required_by_any_effect
from yid_ocp.errors import DataError
from yid_ocp.model.objects.base import ClampPosePointNames
from yid_ocp.model.servos_and_springs import JOINT_SERVO_GAIN_FACTOR_PARAMETER_SUFFIX, MOTOR_OFF_COMMAND, PositionServo
from yid_ocp.model.system import System
from yid_ocp.problem.measurements import TimeGrid
from yid_ocp.sensors import CHANNEL_KINDS, camera_pose_of_point_group, recorded_joint_column_indices
from yid_ocp.sensors.base import channel_specs_for_group_name
from yid_ocp.sensors.joints import is_point_group_measured_by_arm
from yid_ocp.sensors.signal_filters import ZeroPhaseLowPassFilter

_MAX_LOST = 5  # samples in a row that are taken to lie on a straight line; across longer gaps a torque is held
_MIN_PATH_CUTOFF, _MAX_CUTOFF_OVER_RATE = 10.0, 0.2  # [Hz], and as a fraction of the sample rate
_NOISE_ONLY_LEVEL = 1e-3  # p-value of noise alone below which there is motion in a frequency band, over all channels
_SAMPLES_PER_NOISE_DEGREE = 6.0  # samples that give a robust estimate of noise one degree of freedom, by simulation


def select_path_cutoff(recordings: Sequence[Recording], joints: Sequence[str]) -> float:
    """Choose the lowest cutoff [Hz], from 10 Hz in octaves to rate / 5, above which angles contain only noise.

    A lower cutoff would remove motion, and predicted efforts would lack the torques for this motion.
    """
    groups = [own.joints for own in recordings if own.joints is not None and len(own.joints.t) > 1]
    most = min((_MAX_CUTOFF_OVER_RATE / median_sample_period(group.t) for group in groups), default=math.inf)
    cutoff, most = min(_MIN_PATH_CUTOFF, most), float(f"{most:.3g}")
    while cutoff < most and has_motion_in_band(recordings, joints, cutoff, min(2 * cutoff, most)):
        cutoff = min(2 * cutoff, most)
    return cutoff


def has_motion_in_band(recordings: Sequence[Recording], joints: Sequence[str], low: float, high: float) -> bool:
    """Check whether angles have more power between two frequencies [Hz] than white noise of their noise level."""
    lower, higher, p_values = ZeroPhaseLowPassFilter(low), ZeroPhaseLowPassFilter(high), list[float]()
    groups = [own.joints for own in recordings if own.joints is not None and len(own.joints.t) > 1]
    channels = [(g.t, g.position[:, [g.names.index(name)]]) for g in groups for name in joints if name in g.names]
    for t, angle in channels:
        std = noise_or_quantization_std(t, angle[:, 0])
        if not std > 0:
            return False
        impulse = std * (t == t[len(t) // 2])[:, None]
        kept, noise = (higher(t, values) - lower(t, values) for values in (angle, impulse))
        # beside the ends, where filters amplify noise
        end = min(round(0.5 / (low * median_sample_period(t))), len(t) // 4)
        degrees = 2 * (high - low) * (t[-1 - end] - t[end]), len(t) / _SAMPLES_PER_NOISE_DEGREE
        p_values.append(scipy.special.fdtrc(*degrees, np.mean(kept[end : len(t) - end] ** 2) / np.sum(noise**2)))
    return min(p_values, default=1.0) <= _NOISE_ONLY_LEVEL / max(len(p_values), 1)


def step_mean_inputs(
    joints: JointGroup,
    driven: tuple[str, ...],
    grid: TimeGrid,
    where: str,
    delay: Array | None = None,
    servos: Mapping[str, PositionServo] | None = None,
) -> Array:
    """Return the mean input (steps, nu) of driven joints in every step: torque [N m] or servo command [rad or m].

    Effort samples are interpolated by a cubic spline. Efforts that are interval means are integrated, and the input is
    the derivative of a spline through the integral, which preserves every mean. Efforts of kind `command` and held
    commands of servos are piecewise constant, with up to five lost samples in a row interpolated. Each input acts later
    than recorded by `delay` (nu,) [s]. With `servos` (of all driven joints) the input is the position command, or
    `MOTOR_OFF_COMMAND`. `where` names the recording. Raises `DataError` without a joint or efforts (commands).
    """
    if not driven:
        return np.zeros((grid.steps, 0))
    late = np.zeros(len(driven)) if delay is None else delay
    courses = _courses(joints, driven, where, servos or {})
    total = [_summed(course, grid.node_times - shift) for course, shift in zip(courses, late, strict=True)]
    mean = np.asarray(np.diff(np.stack(total, axis=1), axis=0) / grid.time_step)
    mean[_motor_off_steps(joints, driven, grid, where, bool(servos))] = MOTOR_OFF_COMMAND
    return mean


def step_mean_input_delay_derivative(
    joints: JointGroup,
    driven: tuple[str, ...],
    grid: TimeGrid,
    where: str,
    delay: Array,
    servos: Mapping[str, PositionServo] | None = None,
) -> Array:
    """Return the derivative (steps, nu) of `step_mean_inputs` by each joint's delay. At jumps: mean of both sides."""
    result = []
    for course, shift in zip(_courses(joints, driven, where, servos or {}), delay, strict=True):
        sides = (course(np.clip(grid.node_times - shift + near, *course.x[[0, -1]])) for near in (-1e-9, 1e-9))
        result.append(-np.diff(sum(sides)) / 2 / grid.time_step)
    slope = np.stack(result, axis=1)
    slope[_motor_off_steps(joints, driven, grid, where, bool(servos))] = 0.0
    return slope


def _motor_off_steps(
    joints: JointGroup, driven: tuple[str, ...], grid: TimeGrid, where: str, has_servos: bool
) -> BoolArray:
    """Mask (steps, nu) of steps with servo motors off, by `torque_enable` at mid-step. All steps without commands."""
    is_off = has_servos and joints.position_command is None
    if is_off or not has_servos or joints.torque_enable is None:
        return np.full((grid.steps, len(driven)), is_off)
    row = np.searchsorted(joints.t, grid.node_times[:-1] + grid.time_step / 2, "right") - 1
    enabled = joints.torque_enable[:, recorded_joint_column_indices(joints, driven, where)]
    return np.asarray(enabled[np.clip(row, 0, len(joints.t) - 1)] < 0.5)


def servo_gain_parameters_by_recording(system: System, recordings: Sequence[Recording]) -> dict[str, dict[str, float]]:
    """Read the servo gains stated in recordings: by recording name, the values of parameters `JOINT.servo_gain_factor`.

    Raises `DataError` if only some of the recordings with position commands state gains.
    """
    wanted = {name: f"{name}.{JOINT_SERVO_GAIN_FACTOR_PARAMETER_SUFFIX}" for name in system.servos}
    wanted = {name: parameter for name, parameter in wanted.items() if parameter in system.parameters}
    found: dict[str, dict[str, float]] = {}
    silent = []
    for recording in recordings:
        joints = recording.joints
        if joints is None or not wanted:
            continue
        if joints.proportional_gain is None:
            silent += [] if joints.position_command is None else [recording.name]
            continue
        gains = np.broadcast_to(joints.proportional_gain, (len(joints.names),))
        columns = {name: joints.names.index(name) for name in wanted if name in joints.names}
        found[recording.name] = {wanted[name]: float(gains[column]) for name, column in columns.items()}
    if found and silent:
        what = "the recording has no proportional gain of its servos, but others have it"
        hint = f"use only recordings with the gain, or write it: python -c \"import h5py; h5py.File('{silent[0]}.h5', "
        hint += "'r+')['joints'].attrs['proportional_gain'] = GAIN\""
        where = f"recording '{silent[0]}': joints, attribute proportional_gain"
        raise DataError(what, where=where, allowed="the attribute in all recordings, or in none", hint=hint)
    return found


def _courses(
    joints: JointGroup, driven: tuple[str, ...], where: str, servos: Mapping[str, PositionServo]
) -> list[scipy.interpolate.PPoly]:
    """Input of each joint over time, from the first sample to the end of the last sample's interval."""
    t, columns = joints.t, recorded_joint_column_indices(joints, driven, where)
    edges = np.append(t, 2 * t[-1] - t[-2])  # the last sample lasts as long as the previous one
    if servos:
        if joints.position_command is None and joints.effort is not None and not np.any(joints.effort):
            return [_held(np.zeros(len(t)), edges)] * len(driven)  # motors are off
        if joints.position_command is None:
            what = "model.arms.mode is servo, so the joints follow commanded positions, but the recording has none"
            allowed = "the commanded position of every joint; or efforts of zero throughout if the motors are off"
            hint = "import commands (bag: --command-topic TOPIC), or let measured angles move the arm: mode: prescribed"
            raise DataError(what, where=f"recording '{where}': joints/position_command", allowed=allowed, hint=hint)
        own = joints.position_command[:, columns]
        times, rows = _with_lost_samples(t, own)

        def command(row: Array, name: str) -> scipy.interpolate.PPoly:
            if servos[name].command_interpolation == "held":
                return _held(row, np.append(times, edges[-1]))
            return scipy.interpolate.PPoly(np.stack([np.diff(row) / np.diff(times), row[:-1]]), times)

        return list(map(command, rows.T, driven))
    if joints.effort is None:
        what, allowed = "joint efforts drive the model, but the recording has none", "the effort of every driven joint"
        hint = "import a file with efforts, or set model.arms.mode: prescribed"
        raise DataError(what, where=f"recording '{where}': joints/effort", allowed=allowed, hint=hint)
    effort = joints.effort[:, columns]
    if joints.effort_sampling_kind_or_default == "sample":
        return [scipy.interpolate.CubicSpline(t, column) for column in effort.T]
    if joints.effort_sampling_kind_or_default == "command":
        times, rows = _with_lost_samples(t, effort)
        return [_held(column, np.append(times, edges[-1])) for column in rows.T]
    sums = np.vstack([np.zeros((1, len(driven))), np.cumsum(effort * np.diff(edges)[:, None], axis=0)])
    return [scipy.interpolate.CubicSpline(edges, column).derivative() for column in sums.T]


def _with_lost_samples(t: Array, values: Array) -> tuple[Array, Array]:
    """Times and rows of a channel (N, k), with lost samples of an even clock added by linear interpolation."""
    lost = np.rint(np.diff(t) / median_sample_period(t)).astype(int) - 1
    added = [t[i] + (t[i + 1] - t[i]) * np.arange(1, n + 1) / (n + 1) for i, n in enumerate(lost) if 0 < n <= _MAX_LOST]
    times = np.sort(np.concatenate([t, *added]))
    return times, np.stack([np.interp(times, t, column) for column in values.T], axis=1)


def _held(values: Array, edges: Array) -> scipy.interpolate.PPoly:
    return scipy.interpolate.PPoly(values[None, :], edges)


def _summed(course: scipy.interpolate.PPoly, t: Array) -> Array:
    """Integral of an input up to times `t`, same shape; the input is constant outside its time range."""
    inside = np.clip(t, *course.x[[0, -1]])
    return np.asarray(course.antiderivative()(inside) + course(inside) * (t - inside))


def smoothed_joint_angles_at_nodes(
    joints: JointGroup, names: tuple[str, ...], grid: TimeGrid, where: str, low_pass: ZeroPhaseLowPassFilter
) -> Array:
    """Low-pass filter the recorded joint angles and sample them at every node, (steps + 1, len(names)) [rad]."""
    columns = recorded_joint_column_indices(joints, names, where)
    return _smoothed_at_nodes(joints.t, joints.position[:, columns], grid, low_pass)


def _smoothed_at_nodes(t: Array, values: Array, grid: TimeGrid, low_pass: ZeroPhaseLowPassFilter) -> Array:
    spline = scipy.interpolate.CubicSpline(t, low_pass(t, values), axis=0)
    return np.asarray(spline(np.clip(grid.node_times, *t[[0, -1]])))


def smoothed_efforts_at_nodes(
    recording: Recording, names: tuple[str, ...], grid: TimeGrid, low_pass: ZeroPhaseLowPassFilter
) -> Array:
    """Low-pass filter joint efforts and sample them at each node, (steps + 1, len(names)) [N m]. Raises `DataError`."""
    joints = recording.joints
    if joints is None or joints.effort is None:
        what = "an effect of the model (series_elasticity or backlash) needs joint efforts, but the recording has none"
        where, hint = f"recording '{recording.name}': joints/effort", "import efforts, or remove the effect"
        raise DataError(what, where=where, allowed="the effort of every joint", hint=hint)
    effort = low_pass(joints.t, joints.effort[:, recorded_joint_column_indices(joints, names, recording.name)])
    # the mean of an interval belongs to its centre
    late = 0.0 if joints.effort_sampling_kind_or_default == "sample" else median_sample_period(joints.t) / 2
    return np.stack([np.interp(grid.node_times, joints.t + late, column) for column in effort.T], axis=1)


def recorded_signal_kinds(recordings: Sequence[Recording]) -> frozenset[str]:
    """Return the kinds of signals in the recordings that effects can require, such as `joints.effort`.

    Each sensor mounted on a frame is a kind, such as `wrist:FRAME`. In recordings with joints, each point group that
    neither a camera nor an arm measured is a kind too: `points:GROUP`.
    """
    found, mounted = set[str](), set[str]()
    for recording in recordings:
        own = {} if recording.joints is None else {"joints": recording.joints.values_by_channel}
        own |= {group.name: dict(group.values_by_quantity) for group in recording.channel_groups}
        for kind in CHANNEL_KINDS:
            channel = CHANNEL_KINDS[kind]
            if any(channel.matches_group_name(group) and channel.quantity in values for group, values in own.items()):
                found.add(kind)
        for group in recording.channel_groups:
            of_vectors = [c.group for c in channel_specs_for_group_name(group.name) if c.components]
            mounted |= {f"{kind}:{name}" for kind in of_vectors for name in group.names}
        if any(camera_pose_of_point_group(group) is not None for group in recording.points):
            found.add("camera")
        for points in recording.points if recording.joints is not None else ():
            if camera_pose_of_point_group(points) is None and not is_point_group_measured_by_arm(points):
                mounted.add(f"points:{points.name}")
        if any(group.clock == "nominal" for group in recording.all_groups):
            found.add("nominal_clock")
    return frozenset(found & signal_kinds_required_by_any_effect() | mounted)


def effect_kinds_by_missing_signals(recordings: Sequence[Recording]) -> dict[str, list[str]]:
    """Map missing signals, such as 'camera and joints.effort', to the kinds of effects that cannot be candidates."""
    present = recorded_signal_kinds(recordings)
    missing = ((" and ".join(sorted(EFFECTS[kind].required_sensors - present)), kind) for kind in EFFECTS)
    return grouped(pair for pair in missing if pair[0])


def prescribed_coordinates_at_nodes(
    recording: Recording,
    system: System,
    grid: TimeGrid,
    low_pass: ZeroPhaseLowPassFilter,
    clamps: tuple[ClampPosePointNames, ...] = (),
) -> Array:
    """Return the prescribed coordinates (steps + 1, nc) at every node, from smoothed joints and clamp points.

    Raises `DataError` if a joint or clamp point is not recorded or has too few measurements.
    """
    if not system.prescribed:
        return np.zeros((grid.steps + 1, 0))
    course: dict[str, Array] = {}
    for clamp in clamps:
        course.update(_clamp_course(recording, clamp, grid, low_pass))
    if remaining := tuple(name for name in system.prescribed if name not in course):
        if recording.joints is None:
            what = f"joint '{remaining[0]}' is prescribed, but the recording has no joints"
            allowed, hint = "a recording with the group `joints`", "import it together with a file that has its joints"
            raise DataError(what, where=f"recording '{recording.name}'", allowed=allowed, hint=hint)
        sampled = smoothed_joint_angles_at_nodes(recording.joints, remaining, grid, recording.name, low_pass)
        course.update({name: sampled[:, i] for i, name in enumerate(remaining)})
    return np.stack([course[name] for name in system.prescribed], axis=1)


def _clamp_course(
    recording: Recording, clamp: ClampPosePointNames, grid: TimeGrid, low_pass: ZeroPhaseLowPassFilter
) -> Mapping[str, Array]:
    origin = _smoothed_point_path(recording, clamp.origin_point_name, grid, low_pass)
    direction = _smoothed_point_path(recording, clamp.z_axis_point_name, grid, low_pass) - origin
    length = np.linalg.norm(direction, axis=1, keepdims=True)
    if np.any(length < 1e-6):
        names, at = (clamp.origin_point_name, clamp.z_axis_point_name), grid.node_times[int(np.argmin(length))]
        what = f"{clamp.clamp_name} has no direction: its points '{names[0]}' and '{names[1]}' coincide at {at:.4g} s"
        allowed, hint = "two points at least 1e-6 m apart", "correct the points, or choose others under model.object"
        raise DataError(what, where=f"recording '{recording.name}'", allowed=allowed, hint=hint)
    d = direction / length
    about_y = np.arcsin(np.clip(d[:, 0], -1, 1))
    about_x = np.unwrap(np.arctan2(-d[:, 1], d[:, 2]))
    result = {f"{clamp.clamp_name}_{axis}": origin[:, i] for i, axis in enumerate("xyz")}
    about_z = np.zeros(len(d))
    # the angular velocity about z of Rx(a) Ry(b) Rz(c) is c' + a' sin b
    about_z[1:] = -np.cumsum(np.diff(about_x) * np.sin((about_y[1:] + about_y[:-1]) / 2))
    result |= {f"{clamp.clamp_name}_rx": about_x, f"{clamp.clamp_name}_ry": about_y, f"{clamp.clamp_name}_rz": about_z}
    return result


def _smoothed_point_path(recording: Recording, point: str, grid: TimeGrid, low_pass: ZeroPhaseLowPassFilter) -> Array:
    """Smoothed position of a recorded point at every node, shape (steps + 1, 3) [m]."""
    group = recording.group_of_point(point)
    seen = group.position[:, group.names.index(point)]
    good = np.all(np.isfinite(seen), axis=1)
    if good.sum() < 4:
        what, hint = f"point '{point}' is seen in {good.sum()} frames, too few", "choose another point for this clamp"
        raise DataError(what, where=f"recording '{recording.name}'", allowed="4 frames or more", hint=hint)
    return _smoothed_at_nodes(group.t[good], seen[good], grid, low_pass)
