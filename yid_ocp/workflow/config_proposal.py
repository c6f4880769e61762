"""Functions that propose arms, mode, marker positions, noise and rates of a configuration from its recordings."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
from scipy.ndimage import maximum_filter1d

from yid_ocp.arrays import Array, BoolArray
from yid_ocp.data.channel_checks import mean_sample_rate, median_sample_period, noise_or_quantization_std
from yid_ocp.data.foreign_formats import ESTIMATED_WRENCH_GROUP_NAME
from yid_ocp.data.recording import JointGroup, PointGroup, Recording
from yid_ocp.errors import ConfigError, nearest_name_question, unknown_name_error_arguments
from yid_ocp.model import FlexibleSegment, Mechanism
from yid_ocp.model.kinematics import forward_kinematics
from yid_ocp.model.mechanism import rotation_from_rpy
from yid_ocp.model.urdf import joint_damping_and_friction, read_urdf, urdf_path_from_robot_name
from yid_ocp.problem.recorded_inputs import select_path_cutoff
from yid_ocp.sensors import SensorOptions
from yid_ocp.sensors.joints import is_noise_std_stated

_TOOL_FRAME_NAMES = ("tool0", "tcp", "gripper", "tool", "end_effector", "ee_link", "grip", "flange", "hand", "link8")
"""Usual names of the frame at the end of an arm, most likely first."""
_MAX_TIME_STEP = 0.01  # default largest time step of the integrator [s]
_SLOW_SAMPLE_PERIOD = 0.05  # samples farther apart than this do not show their noise, because the motion is as fast [s]
_CAMERA_STD, _MARKER_STD = 5e-3, 1e-3  # of points of slow and of fast sensors whose noise the data do not show [m]
_MAX_RIGID_MOTION = 1e-3  # std of a marker in the frame of the gripper to which it is fixed [m]
_MIN_AXIS_DISTANCE = 0.01  # distance of a marker on the gripper from the axis of the object [m]
_MAX_COMMON_NOISE_RATIO = 2.0  # of the largest noise of joints that get one number, over the smallest
_MOUNT_ROTATIONS = {
    "z": (0.0, 0.0, 0.0),
    "x": (0.0, 1.5708, 0.0),
    "-x": (0.0, -1.5708, 0.0),
    "y": (-1.5708, 0.0, 0.0),
    "-y": (1.5708, 0.0, 0.0),
    "-z": (3.1416, 0.0, 0.0),
}
"""Roll, pitch and yaw [rad] that turn the object, whose axis is z, to an axis of the frame that holds it."""
_MIN_AXIS_COSINE = 0.8  # of the angle between an axis and the mean direction of points; rods sag, cables hang
_JOINT_REST_SPEED, _POINT_REST_SPEED = 0.02, 0.03  # A joint [rad/s] or a point [m/s] slower than this is at rest
_REST_WINDOW = 0.1  # window for speeds [s]; up to twice the sample period of slow sensors
_MIN_FRICTION_TRAVEL = 0.02  # a joint that turns less than this does not inform its friction [rad]
_COPIED_COMMAND_RATIO = 1e-6  # relative distance to the measured angles below which commands are copies of them
_TORQUE_BIAS_FRACTION = 0.01  # default constant torque error, as a fraction of a joint's effort limit
_MAX_TORQUE_BIAS_FRACTION_OF_LARGEST = 0.2  # limit on it, as a fraction of the joint's largest recorded torque
_TORQUE_BIAS_FRACTION_OF_LARGEST = 0.05  # the same of its largest recorded torque, where it has no limit
_MIN_ARM_TRAVEL = 0.1  # joints that together turn less than this do not move [rad]
_POSITION_STEP_PERCENT = 5  # resolution of places along a segment that stays bent [%]
_ROUNDED_PLACE_STD = 0.015  # of a point by rounding to that resolution, as a fraction of the length: 5 % / sqrt(12)
_PLACE_STD = 0.005  # of a point on a segment that was straight once, also off the centreline: it sits on the surface
_MAX_ROUNDED_PERCENT = 0.2  # largest rounding of a location on a straight segment [%]
_MAX_LATENESS = 0.25  # largest lateness of the points' clock, for which the holder must stand still [s]
_MAX_STRAIGHT_DEVIATION = 0.01  # of the length; largest deviation of a straight segment's end distance from its length
_STRAIGHTEST_FRACTION = 0.1  # fraction of the samples with the end farthest from the holder
_SEEN_NOISE, _STATED_NOISE = "estimated from differences of consecutive samples", "as the recording states"
_LEROBOT_ARMS = {"so100": ("sts3215", 16.0), "so101": ("sts3215", 16.0)}  # motor and LeRobot's gain, by start of name


@dataclass(frozen=True)
class _ArmChain:
    joints: tuple[str, ...]
    tool_frames: tuple[str, ...]


@dataclass(frozen=True)
class _PointPlacement:
    """Assignment of a recorded point to a model frame (empty for none), with the reason."""

    point: str
    frame: str
    reason: str
    position_std: float = 0.0  # of the point in that frame [m]; above 0 it has a frame of its own name there
    xyz: tuple[float, ...] = ()  # position in that frame [m]; empty: its origin

    @property
    def model_frame(self) -> str:
        """Frame of the model at which the point is predicted."""
        return self.point if self.position_std > 0 else self.frame


@dataclass(frozen=True)
class _GroupNoise:
    """Noise standard deviation of a group (by joint if it differs, None if stated), unit and source."""

    std: float | Mapping[str, float] | None
    unit: str
    reason: str


@dataclass(frozen=True)
class ProposedConfigChoices:
    """What `init` proposes for a new configuration: joints, arms, mode, points and noise, with reasons."""

    joints: tuple[str, ...]  # recorded joints that move the object, in the URDF's order
    unused_joints: tuple[str, ...]  # recorded joints that the model does not need or know
    unrecorded_joints: tuple[str, ...]  # movable joints of the URDF that are not recorded
    locked_joints: Mapping[str, float]  # position of the fingers of a gripper, which rest [rad or m]
    arms: tuple[_ArmChain, ...]  # arms that hold the object; the first one carries its root
    holder_frame: str  # carries the object's root
    holder_axis: str  # of that frame, along which the object leaves it, such as `-x`
    grasps: Mapping[str, str]  # point of the object by the frame that holds it
    arm_mode: str
    arm_mode_reason: str
    initial_state: str
    initial_state_reason: str
    point_placements: Mapping[str, tuple[_PointPlacement, ...]]
    noise_by_group: Mapping[str, _GroupNoise]
    time_step: float  # [s]
    path_cutoff: float  # [Hz]
    clock_descriptions: Mapping[str, str]
    still_joints: tuple[str, ...]  # hardly turn in any recording
    motor_preset: str | None  # motor preset of its servos, if the robot is known
    firmware_gain: float | None  # usual proportional gain, if the motor is known and no recording states one
    has_object: bool  # false for an arm alone
    torque_bias_std: Mapping[str, float]  # default by joint [N m]; empty if the recording states it or has no effort
    is_effort_sampling_kind_unknown: bool  # whether efforts are recorded without it
    urdf_joint_damping: Mapping[str, float]  # above 0, by joint [N m s/rad]
    urdf_joint_friction: Mapping[str, float]  # above 0, by joint [N m]

    @property
    def mount_rpy(self) -> list[float]:
        """Roll, pitch and yaw [rad] of the object in the frame that carries its root."""
        return list(_MOUNT_ROTATIONS[self.holder_axis])

    @property
    def is_identified_from_efforts_only(self) -> bool:
        """Whether only efforts can identify the model: its arms are prescribed, and no sensor measures an object."""
        seen = any(not group.startswith("imu") for group in self.point_placements)
        return self.arm_mode == "prescribed" and not (self.has_object and seen)


def propose_config_choices(
    robot: str,
    recordings: Sequence[Recording],
    branches: Sequence[FlexibleSegment],
    *,
    holder: str | None = None,
    grasps: Mapping[str, str] | None = None,
    standing: bool = False,
) -> ProposedConfigChoices:
    """Propose choices for a configuration from a robot and its recordings. All recordings need joints.

    Raises `ConfigError` if no recorded joint is in the URDF, a later recording lacks a joint of the first, or a frame
    does not exist; other errors are as in `read_urdf`.
    `branches` are the object's segments, parents first; none for an arm without an object. `holder` is the frame that
    carries its root (default: the tool of the arm that moves most). `grasps` are points of the object by frame
    (default: its ends, if two arms were recorded or it is `standing` on the ground, where arms hold its ends).
    """
    whole, first = read_urdf(robot), recordings[0]
    recorded, known = first.joints, _recorded_urdf_joints(robot, whole, recordings)
    assert recorded is not None
    locked = _resting_fingers(read_urdf(robot, joints=known), recorded, recordings)
    tree = read_urdf(robot, joints=[name for name in known if name not in locked], locked=locked)
    arms = tuple(sorted(_arms(tree), key=lambda arm: -_travel(first, arm.joints)))
    if holder is None and not branches:  # a payload is on the frame most similar to a tool
        holder = min(reversed([name for name, at in tree.frames.items() if at.joint_index >= 0]), key=_tool_rank)
    holder, own = _holder(tree, arms, holder, standing)
    held = dict(grasps or {})
    if holder in held and not standing:
        what, hint = f"'{holder}' holds the object's root and {held[holder]}", "leave one out, or give another --holder"
        raise ConfigError(what, where="--grasp", allowed="a frame other than that of the root", hint=hint)
    if not held and standing:
        held = {arm.tool_frames[0]: end for arm, end in zip(arms, ("w_T2", "w_T3"), strict=False)}
    elif not held and branches:
        held = {arm.tool_frames[0]: f"w_{branches[-1].name}" for arm in [arm for arm in arms if arm is not own][:1]}
    carrying = [tree.frame(name).joint_index for name in (*held, *(() if standing else (holder,)))]
    needed = {j for end in carrying for j in tree.ancestor_joint_indices(end)}
    joints = tuple(tree.joint_names[j] for j in sorted(needed)) if branches else tree.joint_names
    for other in recordings:
        for name in (name for name in joints if name not in other.joint_names):
            what, hint = f"the recording lacks the joint '{name}', which {first.name} has", "leave this recording out"
            raise ConfigError(what, where=other.name, allowed=f"the joints {', '.join(joints)}", hint=hint)
    mode, why = _mode(first, recorded, bool(held) and standing, has_object=bool(branches))
    moving = ""
    for recording in recordings:
        start = min(group.t[0] for group in recording.joint_and_point_groups)
        if not moving and (mover := _moving_joint_or_point(recording, joints, start)):
            moving = f"{mover} already moves at the start of recording '{recording.name}'"
    period = median_sample_period(recorded.t) or _MAX_TIME_STEP
    count = math.floor(_MAX_TIME_STEP / period + 1e-3)  # sample periods in a step; a slow clock's period is divided
    step = period * count if count else period / math.ceil(period / _MAX_TIME_STEP - 1e-3)
    axis = "z" if standing or len(branches) != 1 else _holder_axis(tree, first, branches[0].length, holder)
    return ProposedConfigChoices(
        joints,
        tuple(name for name in recorded.names if name not in joints),
        tuple(name for name in whole.joint_names if name not in recorded.names),
        locked,
        tuple(arm for arm in arms if set(arm.joints) & set(joints)) or arms,
        holder,
        axis,
        held,
        mode,
        why,
        "estimated" if moving else "equilibrium",
        moving or "all recordings begin at rest",
        _places(tree, first, branches, holder, axis, standing) | _sensor_places(tree, first, holder),
        _noise(first, recorded, joints),
        float(f"{step:.3g}"),
        select_path_cutoff(recordings, joints if branches and mode == "prescribed" else ()),
        {group.name: _clock(group) for group in first.joint_and_point_groups},
        tuple(name for name in joints if max(_travel(r, [name]) for r in recordings) < _MIN_FRICTION_TRAVEL),
        *_motor_and_gain(robot, mode, recordings),
        bool(branches),
        _torque_bias_std(tree, recorded, joints),
        recorded.effort is not None and recorded.effort_kind is None,
        *({name: value for name, value in own.items() if name in joints} for own in joint_damping_and_friction(robot)),
    )


def _recorded_urdf_joints(robot: str, whole: Mechanism, recordings: Sequence[Recording]) -> list[str]:
    """Joints of the URDF that the first recording has. Raises `ConfigError` if there are none."""
    if not whole.joint_names:
        what, hint = "the robot has no joint that can move", "give the URDF or MJCF file of the whole robot"
        raise ConfigError(what, where=robot, allowed="revolute, continuous or prismatic joints", hint=hint)
    recorded, first = recordings[0].joint_names, recordings[0].name
    for other in recordings[1:]:
        for name in (name for name in whole.joint_names if name in other.joint_names and name not in recorded):
            if _travel(other, [name]) > _MIN_ARM_TRAVEL:
                what = f"the recording lacks the joint '{name}', which moves in {other.name}"
                allowed, hint = "recordings with the same joints", f"leave one of the two out, or record '{name}'"
                raise ConfigError(what, where=first, allowed=allowed, hint=hint)
    if not (known := [name for name in whole.joint_names if name in recorded]):
        what = f"none of the recorded joints is a joint of the robot: {', '.join(recorded)}"
        hint = "give the URDF or MJCF file of the robot that was recorded. If it is the same robot with other names, "
        matches = {name: [joint for joint in whole.joint_names if joint.endswith(name)] for name in recorded}
        renamed = f"{recorded[0]}=NAME_IN_ROBOT,..."
        if all(len(joints) == 1 for joints in matches.values()):
            renamed = ",".join(f"{name}={joints[0]}" for name, joints in matches.items())
        hint += f"rename its joints at the import: --joints {renamed}"
        raise ConfigError(what, where=robot, allowed=", ".join(whole.joint_names), hint=hint)
    return known


def _motor_and_gain(robot: str, mode: str, recordings: Sequence[Recording]) -> tuple[str | None, float | None]:
    name = urdf_path_from_robot_name(robot).stem.lower()
    found = next((known for start, known in _LEROBOT_ARMS.items() if name.startswith(start)), None)
    if mode != "servo" or found is None:
        return None, None
    stated = any(r.joints is not None and r.joints.proportional_gain is not None for r in recordings)
    return found[0], None if stated else found[1]


def _torque_bias_std(tree: Mechanism, recorded: JointGroup, joints: Sequence[str]) -> dict[str, float]:
    if recorded.effort is None or recorded.effort_bias_std is not None:
        return {}
    largest = dict(zip(recorded.names, np.nanmax(np.abs(recorded.effort), axis=0).tolist(), strict=True))
    by_limit = {name: _TORQUE_BIAS_FRACTION * tree.joint(name).effort_limit for name in joints}
    most = {name: _MAX_TORQUE_BIAS_FRACTION_OF_LARGEST * largest[name] for name in joints}
    known = {name: min(size, most[name]) for name, size in by_limit.items() if 0 < size < math.inf}
    return {name: _TORQUE_BIAS_FRACTION_OF_LARGEST * largest[name] for name in joints} | known


def _arms(tree: Mechanism) -> Iterator[_ArmChain]:
    for j in range(len(tree.joints)):
        if all(joint.parent_index != j for joint in tree.joints):
            own = sorted([name for name, frame in tree.frames.items() if frame.joint_index == j], key=_tool_rank)
            ends = [name for name in own if tree.frames[name].proximal_names.issuperset({*own} - {name})]
            own = [*ends, *(name for name in own if name not in ends)] if len(ends) == 1 else own
            yield _ArmChain(tuple(tree.joint_names[i] for i in tree.ancestor_joint_indices(j)), tuple(own))


def _resting_fingers(tree: Mechanism, recorded: JointGroup, recordings: Sequence[Recording]) -> dict[str, float]:
    """Median positions of end joints that rest in all recordings, and before which a frame is more like a tool."""

    def rank(joint: str) -> int:
        return min(_tool_rank(name)[0] for name, at in tree.frames.items() if at.joint_index == tree.joint_index(joint))

    return {
        name: round(float(np.median(recorded.position[:, recorded.names.index(name)])), 4)
        for *before, name in (arm.joints for arm in _arms(tree))
        if before
        and rank(before[-1]) < rank(name)
        and max(_travel(r, [name]) for r in recordings) < _MIN_FRICTION_TRAVEL
    }


def _tool_rank(frame: str) -> tuple[int, bool]:
    name = frame.lower()
    rank = next((i for i, word in enumerate(_TOOL_FRAME_NAMES) if word in name), len(_TOOL_FRAME_NAMES))
    return rank, rank < len(_TOOL_FRAME_NAMES) and not name.endswith(_TOOL_FRAME_NAMES[rank])


def _travel(recording: Recording, joints: Sequence[str]) -> float:
    group = recording.joints
    if group is None:
        return 0.0
    return float(sum(np.ptp(group.position[:, group.names.index(name)]) for name in joints if name in group.names))


def _holder(tree: Mechanism, arms: Sequence[_ArmChain], frame: str | None, standing: bool) -> tuple[str, _ArmChain]:
    if frame is None or standing:
        return arms[0].tool_frames[0], arms[0]
    if frame not in tree.frames:
        usual, near = [name for arm in arms for name in arm.tool_frames], nearest_name_question(frame, tree.frames)
        said = unknown_name_error_arguments(frame, usual, near)
        raise ConfigError(f"there is no frame '{frame}'", where="--holder", **said)
    carried = tree.frames[frame].joint_index
    return frame, next((arm for arm in arms if carried >= 0 and tree.joint_names[carried] in arm.joints), arms[0])


def _mode(recording: Recording, joints: JointGroup, closed: bool, has_object: bool) -> tuple[str, str]:
    wrists = [group.name for group in recording.channel_groups if group.name.startswith("wrist")]
    wrists = [name for name in wrists if name != ESTIMATED_WRENCH_GROUP_NAME]
    seen = ", ".join([*(group.name for group in recording.points), *wrists])
    command = joints.position if joints.position_command is None else joints.position_command
    turned = np.std(joints.position - joints.position.mean(axis=0))
    is_commanded = np.sqrt(np.mean((command - joints.position) ** 2)) > _COPIED_COMMAND_RATIO * turned
    is_servo = joints.effort is None and bool(is_commanded)
    if not has_object and not is_servo and joints.effort is None and not wrists:
        what = "the recording has no measurement of the forces that move the arm"
        allowed = "efforts of its joints, commanded positions that differ from the measured ones, or a wrist sensor"
        hint = "import efforts too (`yid-ocp import FILE --preview` lists signals); with --object, import points on it"
        raise ConfigError(what, where=f"recording '{recording.name}'", allowed=allowed, hint=hint)
    if joints.effort is None and not seen and has_object:
        hint = "import points too; `yid-ocp import FILE --preview` lists the signals of a file"
        what, allowed = "the recording has no measurement of the object", "points on it, or efforts of the joints"
        raise ConfigError(what, where=f"recording '{recording.name}'", allowed=allowed, hint=hint)
    if is_servo:
        return "servo", "no efforts were recorded, but commanded positions, which the arm's servos follow"
    if joints.effort is None:
        return "prescribed", "no efforts were recorded, so the arm moves as measured"
    if not has_object:
        return "prescribed", "the arm moves as measured, and the model predicts the efforts that this motion requires"
    if closed:
        return "driven", "torques move the arm, as errors of measured angles would cause false forces at the grasps"
    if seen:
        return "prescribed", f"the arm moves as measured, as it carries the object; also recorded: {seen}"
    return "prescribed", "the arm moves as measured, and its efforts show the object, because nothing else was measured"


def _moving_joint_or_point(recording: Recording, joints: Sequence[str], time: float) -> str:
    """Name of a joint or point that moves just after a time, from a line fit; empty if nothing moves."""
    seen = [("point '{}'", p.names, p.t, p.position.reshape(len(p.t), -1), _POINT_REST_SPEED) for p in recording.points]
    group = recording.joints
    if group is not None:
        values = group.position[:, [group.names.index(name) for name in joints]]
        seen.insert(0, ("joint '{}'", tuple(joints), group.t, values, _JOINT_REST_SPEED))
    for words, names, t, values, rest_speed in seen:
        speeds, noise = _speeds(t, values, time)
        fast = speeds > rest_speed + 4 * noise
        if fast.any():
            return words.format(names[int(np.argmax(fast)) * len(names) // len(fast)])
    return ""


def _speeds(t: Array, values: Array, time: float) -> tuple[Array, Array]:
    """Return the absolute slope of each channel's line over a window, and its std; zeros for fewer than 4 samples."""
    # the first five frames of a slow camera do not show whether its points started at rest
    window = float(np.clip(5 * (median_sample_period(t) or math.inf), _REST_WINDOW, 2 * _REST_WINDOW))
    rows, zeros = (t >= time - 1e-9) & (t <= time + window), np.zeros(values.shape[1])
    if rows.sum() < 4:
        return zeros, zeros
    centred = t[rows] - t[rows].mean()
    slope = centred @ (values[rows] - values[rows].mean(axis=0)) / (centred @ centred)
    left = values[rows] - values[rows].mean(axis=0) - np.outer(centred, slope)
    return np.nan_to_num(np.abs(slope)), np.nan_to_num(left.std(axis=0) / math.sqrt(centred @ centred))


def held_out_split_time(recording: Recording, joints: Sequence[str]) -> float | None:
    """Return a time [s] at which a recording can be split: standstill in its third quarter, and motion after it.

    The part after it can be held out, because its prediction can start from equilibrium. None without such a time.
    """
    first, duration = min(group.t[0] for group in recording.joint_and_point_groups), recording.duration
    for part in np.arange(0.75, 0.5, -0.01) if duration > 0 else ():
        time = first + float(part) * duration
        if not any(_moving_joint_or_point(recording, joints, at) for at in (time, time + _REST_WINDOW)):
            later = recording.time_slice(time, first + duration)
            if later.joints is not None and _travel(later, joints) > _MIN_ARM_TRAVEL:
                return time
    return None


def _places(
    tree: Mechanism, recording: Recording, branches: Sequence[FlexibleSegment], holder: str, axis: str, standing: bool
) -> dict[str, tuple[_PointPlacement, ...]]:
    """Return the place of every point, by group: by its name or, if an arm holds the object, by its positions."""
    names = [branch.name for branch in branches]
    standing = standing or not branches  # an arm alone has no object with points
    frames = {f"w_{name}" for name in names} | set(tree.frames)
    found: dict[str, tuple[_PointPlacement, ...]] = {}
    for group in recording.points:
        placed, positions, parts = [], group.position, None
        if not standing:
            poses = _poses(tree, recording, holder, group.t)
            rows = _rows_to_place_by(group, poses, branches)
            poses, positions = poses[rows], positions[rows]
            parts = _parts_when_straight(positions, poses, branches)
        for i, point in enumerate(group.names):
            owner, colon, part = point.partition(":")
            frame, reason, std = "", "the place on the model is not known", 0.0
            beside: tuple[float, ...] = ()
            if point in frames or (colon and owner in names and part.endswith("%")):
                frame, reason = point, "their names are equal"
            elif point in names:
                frame, reason = f"w_{point}", "the end of the segment of this name"
            elif not standing:
                straight = math.nan if parts is None else float(parts[i])
                if beside := _place_beside_object(poses, positions[:, i], branches, axis):
                    frame, reason = holder, f"the position relative to {holder} is constant, and is not on the object"
                else:
                    frame, reason = _near(poses, positions[:, i], straight, branches, holder)
                if frame and len(branches) == 1:
                    std = (_ROUNDED_PLACE_STD if parts is None else _PLACE_STD) * branches[0].length
            placed.append(_PointPlacement(point, frame, reason, std, beside))
        found[group.name] = tuple(placed)
    return found


def _rows_to_place_by(group: PointGroup, poses: Array, branches: Sequence[FlexibleSegment]) -> BoolArray:
    """Mask (N,) of samples in which the holder `poses` stand still, so that a late clock has no effect; else of all."""
    if len(branches) != 1 or len(group.t) < 2:
        return np.ones(len(group.t), bool)
    speed = np.linalg.norm(np.gradient(poses[:, :3, 3], group.t, axis=0), axis=1)
    width = 2 * math.ceil(_MAX_LATENESS / float(np.median(np.diff(group.t)))) + 1
    still = maximum_filter1d(speed, width) < _POINT_REST_SPEED
    return still if still.any() else ~still


def _parts_when_straight(positions: Array, poses: Array, branches: Sequence[FlexibleSegment]) -> Array | None:
    """Positions (np,) of points as fractions of a single segment's length; None without a straight pose or an end."""
    apart = np.linalg.norm(positions - poses[:, None, :3, 3], axis=2)
    farthest = np.max(apart, axis=0, initial=0.0, where=np.isfinite(apart))
    end = apart[:, int(np.argmax(farthest))]
    if len(branches) != 1 or abs(farthest.max() / branches[0].length - 1) > _MAX_STRAIGHT_DEVIATION:
        return None
    straight = end >= np.nanquantile(end, 1 - _STRAIGHTEST_FRACTION)
    ratio = apart[straight] / end[straight, None]
    return np.array([np.mean(own[np.isfinite(own)]) if np.isfinite(own).any() else math.nan for own in ratio.T])


def _place_beside_object(
    poses: Array, position: Array, branches: Sequence[FlexibleSegment], axis: str
) -> tuple[float, ...]:
    """Position of a point in the holder's frame, if it is fixed there and away from the object's axis; else empty."""
    local = _in_frame(poses, position[:, None])[:, 0]
    local = local[np.isfinite(local).all(axis=1)]
    if len(branches) != 1 or len(local) < 2 or local.std(axis=0).max() > _MAX_RIGID_MOTION:
        return ()
    mean, direction = local.mean(axis=0), _mount_direction(axis)
    along = float(mean @ direction)
    is_away = max(float(np.linalg.norm(mean - along * direction)), -along) > _MIN_AXIS_DISTANCE
    is_near = np.linalg.norm(mean) < branches[0].length / 4
    return tuple(np.round(mean, 4).tolist()) if is_away and is_near else ()


def _in_frame(poses: Array, positions: Array) -> Array:
    """Positions (N, np, 3) in frames of the poses (N, 4, 4)."""
    return np.einsum("nji,npj->npi", poses[:, :3, :3], positions - poses[:, None, :3, 3])


def _mount_direction(axis: str) -> Array:
    return rotation_from_rpy(*_MOUNT_ROTATIONS[axis])[:, 2]


def _holder_axis(tree: Mechanism, recording: Recording, length: float, holder: str) -> str:
    """Axis of the holder's frame nearest to the mean direction of points on a single segment; `z` if none is near."""
    total, count = np.zeros(3), 0
    for group in recording.points:
        local = _in_frame(_poses(tree, recording, holder, group.t), group.position)
        apart = np.linalg.norm(local, axis=2)
        far = apart > length / 4  # nearer ones may be on the gripper
        total, count = total + (local[far] / apart[far][:, None]).sum(axis=0), count + int(far.sum())
    cosines = {axis: float(total @ _mount_direction(axis)) for axis in _MOUNT_ROTATIONS}
    best = max(cosines, key=cosines.__getitem__)
    return best if cosines[best] > _MIN_AXIS_COSINE * count else "z"


def _near(
    poses: Array, position: Array, part_when_straight: float, branches: Sequence[FlexibleSegment], holder: str
) -> tuple[str, str]:
    """Return the most probable frame of a point (empty if unknown), from its distance to the holder, and the reason."""
    seen = np.isfinite(position).all(axis=1)
    if not seen.any():
        return "", "no sample has a position"
    poses = poses[seen]
    from_holder = position[seen] - poses[:, :3, 3]
    if len(branches) == 1:
        # bending brings points nearer, never farther: the farthest position is the closest to the arc length
        branch = branches[0]
        part = float(np.linalg.norm(from_holder, axis=1).max()) / branch.length
        if part > 1.2:
            return "", f"it is {part:.1f} object lengths away from {holder}: check --length and --point-frame"
        exact = 100 * part_when_straight  # NaN if it never was
        rounded = _POSITION_STEP_PERCENT * round((100 * part if math.isnan(exact) else exact) / _POSITION_STEP_PERCENT)
        percent = round(exact, 2) if abs(exact - rounded) > _MAX_ROUNDED_PERCENT else rounded
        why = f"its distance from {holder} is at most {part:.0%} of the length"
        why += ". That is too far: check --length, --holder and the clocks" * (part > 1.05)
        return _along(branch.name, min(100, percent)), why
    local = poses[0, :3, :3].T @ from_holder[0]
    apart = {name: float(np.linalg.norm(local - spot)) for name, spot in _straight(branches).items()}
    name = min(apart, key=apart.__getitem__)
    if apart[name] > 0.5 * max(branch.length for branch in branches):
        return "", f"it is {apart[name]:.2g} m away from the straight object. Is it in the world frame?"
    return name, f"it is {1e3 * apart[name]:.0f} mm from this frame when the object is straight"


def _along(name: str, percent: float) -> str:
    return f"w_{name}" if percent == 100 else f"{name}:{percent:g}%"


def _sensor_places(tree: Mechanism, recording: Recording, holder: str) -> dict[str, tuple[_PointPlacement, ...]]:
    """Frames of wrist sensors and inertial units: the frame of the same name, else, for a wrist, the holder."""
    found: dict[str, tuple[_PointPlacement, ...]] = {}
    for key, group, channel in recording.mounted_sensor_channels:
        other = ("", "no link has this name. To use it, set {frame_by_recorded_name: {NAME: FRAME}, use: true}")
        if channel.group == "wrist":
            other = (holder, "a wrist sensor usually carries this link. If it does not, set frame_by_recorded_name")
        own = {name: name in tree.frames and tree.frames[name].joint_index >= 0 for name in group.names}
        found[key] = tuple(
            _PointPlacement(name, name, "their names are equal") if moves else _PointPlacement(name, *other)
            for name, moves in own.items()
        )
    return found


def _straight(branches: Sequence[FlexibleSegment]) -> dict[str, Array]:
    """Positions along the straight object, by frame name."""
    spots: dict[str, Array] = {}
    ends: dict[str | None, tuple[Array, Array]] = {None: (np.eye(3), np.zeros(3))}
    for branch in branches:
        turn, base = ends[branch.parent]
        turn = turn if branch.rest_rotation is None else turn @ np.asarray(branch.rest_rotation)
        along = branch.length * turn[:, 2]
        ends[branch.name] = (turn, base + along)
        for percent in range(_POSITION_STEP_PERCENT, 101, _POSITION_STEP_PERCENT):
            spots[_along(branch.name, percent)] = base + percent / 100 * along
    return spots


def _poses(tree: Mechanism, recording: Recording, frame: str, t: Array) -> Array:
    """Poses (N, 4, 4) of a frame at recorded times."""
    group = recording.joints
    assert group is not None
    q = ca.SX.sym("q", len(tree.joints))
    pose = forward_kinematics(tree.with_numeric_values(), q).frame_pose(frame).homogeneous_matrix()
    columns = [group.names.index(name) for name in tree.joint_names]
    angles = np.stack([np.interp(t, group.t, group.position[:, j]) for j in columns])
    return np.array(ca.Function("pose", [q], [pose]).map(len(t))(angles)).reshape(4, len(t), 4).transpose(1, 0, 2)


def _noise(recording: Recording, recorded: JointGroup, joints: Sequence[str]) -> dict[str, _GroupNoise]:
    found, at = dict[str, _GroupNoise](), [recorded.names.index(name) for name in joints]
    for channel, unit, least in (("position", "rad", 1e-6), ("effort", "N m", 1e-3)):
        values = recorded.values_by_channel.get(channel)
        if values is not None:
            is_stated = is_noise_std_stated(recorded, f"joints.{channel}", SensorOptions())
            found[f"joints.{channel}"] = _channel_noise(recorded.t, values[:, at], least, unit, is_stated, joints)
    for key, group, kind in recording.mounted_sensor_channels:
        values, stated = group.values_by_quantity[kind.quantity], group.noise_and_bias_stds_by_attribute
        columns = values.reshape(len(values), -1)
        found[key] = _channel_noise(group.t, columns, 1e-3, kind.unit, kind.std_attribute_names[0] in stated)
    return found | {group.name: _point_noise(group) for group in recording.points}


def _channel_noise(
    t: Array, values: Array, least: float, unit: str, is_stated: bool, joints: Sequence[str] = ()
) -> _GroupNoise:
    if is_stated:
        return _GroupNoise(None, unit, _STATED_NOISE)
    sizes = [max(least, noise_or_quantization_std(t, column)) for column in values.T]
    is_common = not joints or max(sizes) < _MAX_COMMON_NOISE_RATIO * min(sizes)
    return _GroupNoise(max(sizes) if is_common else dict(zip(joints, sizes, strict=True)), unit, _SEEN_NOISE)


def _point_noise(group: PointGroup) -> _GroupNoise:
    if group.std is not None:
        return _GroupNoise(None, "m", _STATED_NOISE)
    slow = len(group.t) < 2 or 1.0 / mean_sample_rate(group.t) > _SLOW_SAMPLE_PERIOD
    sizes: list[float] = []
    for i in range(len(group.names)):
        seen = np.isfinite(group.position[:, i]).all(axis=1)
        sizes += [noise_or_quantization_std(group.t[seen], column) for column in group.position[seen, i].T]
    if slow or not any(sizes):
        std = _CAMERA_STD if slow else _MARKER_STD
        return _GroupNoise(std, "m", "a guess, because the data are too slow or too clean to show the noise")
    return _GroupNoise(math.sqrt(math.fsum(x * x for x in sizes) / np.count_nonzero(sizes)), "m", _SEEN_NOISE)


def _clock(group: JointGroup | PointGroup) -> str:
    steps = np.diff(group.t)
    if not len(steps):
        return "one sample"
    uneven = float(np.std(steps) / np.mean(steps))
    said = f"{mean_sample_rate(group.t):.4g} Hz, with {'recorded' if group.clock == 'recorded' else 'computed'} times"
    if uneven >= 0.01:
        said += f", whose periods vary by {uneven:.0%}"
    if isinstance(group, PointGroup) and group.clock_offset_std is not None:
        said += f", known to ± {group.clock_offset_std:g} s (clock_offset_std), which a fit corrects"
    return said
