"""Kinematics and dynamics of the joints with recorded angles, and checks of their limits and of their excitation."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np
import scipy.interpolate
from numpy.typing import NDArray

from yid_ocp.data.channel_checks import white_noise_std
from yid_ocp.data.issues import DEGREES_PER_RADIAN, QUALITY_LIMITS, Issue, median_sample_period
from yid_ocp.data.recording import JointGroup, Recording
from yid_ocp.model.kinematics import forward_kinematics, rigid_body_derivatives
from yid_ocp.model.mechanism import Joint
from yid_ocp.model.system import System
from yid_ocp.parallel import LockedCache
from yid_ocp.problem.signal_filters import LowPassFilter
from yid_ocp.sensors import SensorOptions
from yid_ocp.sensors.base import values_by_joint
from yid_ocp.sensors.joints import EFFORT_GROUP, POSITION_GROUP

Array = NDArray[np.float64]

_ANGLE_LIMIT_MARGIN = 0.1
"""How far angles may be beyond a joint's limits, where a robot's own model differs from its URDF [rad or m]."""
_MAX_SPEED_RATIO = 1.5  # factor by which joints may turn faster than the URDF says that they can
_SPEED_SAMPLE_STRIDE = 5  # samples over which a speed is taken, so that neither noise nor steps of encoders count
_MOTION_BANDWIDTH_HZ = 5.0  # where motion of a robot's arm ends; what is faster is left out [Hz]
VISCOUS_FRICTION_FRACTION = 0.04
"""Usual viscous friction beside a joint's largest effort [per rad/s]."""
_MIN_SIGNAL_STDS = 5.0  # standard deviations from which on a signal counts as seen, all samples and joints together


@dataclass(frozen=True)
class RecordedJointsModel:
    """Numeric kinematics and inverse dynamics of the joints whose angles are recorded.

    Driven joints come first, then prescribed ones; unknown coordinates, such as a beam's bending, are zero.
    """

    system: System
    theta: Array
    joint_names: tuple[str, ...]

    @staticmethod
    def from_system(system: System, theta: Array) -> RecordedJointsModel | None:
        """The model of a system's driven and prescribed joints; None where it has none."""
        names = (*system.driven, *system.prescribed)
        return RecordedJointsModel(system, theta, names) if names else None

    def is_recorded_in(self, recording: Recording) -> bool:
        """Whether a recording has the angles of all joints; those of clamps that follow points are not recorded."""
        return all(name in recording.joint_names for name in self.joint_names)

    @property
    def joints(self) -> tuple[Joint, ...]:
        """The joints, in the order of `joint_names`."""
        mechanism = self.system.mechanism
        return tuple(mechanism.joints[mechanism.joint_index(name)] for name in self.joint_names)

    @property
    def joint_indices(self) -> tuple[int, ...]:
        """Indices of the joints in the configuration."""
        return tuple(self.system.mechanism.joint_index(name) for name in self.joint_names)

    def is_frame_determined(self, frame: str) -> bool:
        """Whether a frame's position follows from the recorded angles alone."""
        mechanism = self.system.mechanism
        return set(mechanism.ancestor_joints(mechanism.frame(frame).joint_index)) <= set(self.joint_indices)

    @cached_property
    def has_no_unknown_descendants(self) -> bool:
        """Whether no joint of unknown angle depends on the recorded joints."""
        ancestors, known = self.system.mechanism.ancestor_joints, set(self.joint_indices)
        return not any(set(ancestors(i)) & known for i in range(self.system.n_coordinates) if i not in known)

    def frame_positions(self, frames: tuple[str, ...], q: Array) -> tuple[Array, Array]:
        """Positions (N, nf, 3) [m] of frames and their Jacobian (N, nf, 3, k) by the recorded angles (N, k).

        The frames are such that `is_frame_determined`.
        """
        place, slope = (np.array(ca.densify(x)) for x in self._places(frames).map(len(q)).call([q.T]))
        count, width = len(frames), len(self.joint_names)
        by_angle = slope.reshape(3 * count, len(q), width).transpose(1, 0, 2)
        return place.T.reshape(len(q), count, 3), by_angle.reshape(len(q), count, 3, width)

    def inverse_dynamics(self, q: Array, v: Array, a: Array) -> Array:
        """Joint efforts by rigid-body inverse dynamics, without dampers, springs and grasps, shape (N, k) [N m]."""
        return np.array(self._effort.map(len(q)).call([q.T, v.T, a.T])[0]).T

    @cached_property
    def _places(self) -> LockedCache[tuple[str, ...], ca.Function]:
        return LockedCache(self._place_function)

    def _place_function(self, frames: tuple[str, ...]) -> ca.Function:
        known = ca.SX.sym("q", len(self.joint_names))
        kinematics = forward_kinematics(self.system.mechanism, self._placed(known))
        at = self._numbers(ca.vertcat(*(kinematics.frame_position(frame) for frame in frames)))
        return ca.Function("places", [known], [ca.densify(at), ca.densify(ca.jacobian(at, known))])

    @cached_property
    def _effort(self) -> ca.Function:
        size = self.system.n_coordinates
        full = [ca.SX.sym(name, size) for name in ("q", "v", "a")]
        known = [ca.SX.sym(name, len(self.joint_names)) for name in ("q", "v", "a")]
        rigid = rigid_body_derivatives(forward_kinematics(self.system.mechanism, full[0]), full[1], self.system.gravity)
        by_v = rigid.lagrangian_by_v
        effort = ca.jtimes(by_v, full[0], full[1]) + ca.jtimes(by_v, full[1], full[2]) - rigid.lagrangian_by_q
        placed = ca.vertcat(*(self._placed(x) for x in known))
        effort = ca.substitute(effort[list(self.joint_indices)], ca.vertcat(*full), placed)
        return ca.Function("effort", known, [ca.densify(self._numbers(effort))])

    def _placed(self, known: ca.SX) -> ca.SX:
        full = ca.SX.zeros(self.system.n_coordinates)
        for row, i in enumerate(self.joint_indices):
            full[i] = known[row]
        return full

    def _numbers(self, expression: ca.SX) -> ca.SX:
        internal = self.system.internal_coordinates.values()
        symbols = ca.vertcat(self.system.parameters.symbols, *internal)
        return ca.substitute(expression, symbols, ca.SX(ca.DM([*self.theta, *([0.0] * len(internal))])))


@dataclass(frozen=True)
class SmoothedJointMotion:
    """Smoothed recorded motion at times t (N,): q, v, a and the effort [N m], each (N, k); both ends are left out."""

    t: Array
    q: Array
    v: Array
    a: Array
    effort: Array | None


def smoothed_joint_motion(joints: JointGroup, names: tuple[str, ...], most: int = 300) -> SmoothedJointMotion | None:
    """Smoothed motion of the named joints at up to `most` times; None where the recording is too short."""
    t, step = joints.t, median_sample_period(joints.t)
    if len(t) < 30 or step <= 0 or t[-1] - t[0] > 1e5 * step:
        return None
    columns = [joints.names.index(name) for name in names]
    low_pass = LowPassFilter(min(_MOTION_BANDWIDTH_HZ, 0.2 / step))
    course = scipy.interpolate.CubicSpline(t, low_pass(t, joints.position[:, columns]), axis=0)
    end = max(5, min(len(t) // 10, round(0.3 / step)))
    kept = slice(end, len(t) - end, max(1, len(t) // most))
    at = t[kept]
    effort = None
    if joints.effort is not None and not np.isnan(joints.effort[:, columns]).any():
        smooth = low_pass(t, joints.effort[:, columns])
        effort = np.stack([np.interp(at, t, column) for column in smooth.T], axis=1)
    return SmoothedJointMotion(at, course(at), course(at, 1), course(at, 2), effort)


def check_joint_limits(arm: RecordedJointsModel, recording: Recording) -> Iterator[Issue]:
    """Issues where recorded angles or speeds exceed the joint limits."""
    joints = recording.joints
    if joints is None:
        return
    position = joints.position[:, [joints.names.index(name) for name in arm.joint_names]]
    found = list(_angle_issues(arm, position))
    if not found or found[0].cause != "degrees":
        found += _speed_issues(arm, joints.t, position)
    yield from (replace(issue, recording=recording.name, group="joints") for issue in found)


def _angle_issues(arm: RecordedJointsModel, position: Array) -> Iterator[Issue]:
    low, high = (np.array([getattr(joint, f"{side}_limit") for joint in arm.joints]) for side in ("lower", "upper"))
    margin, degrees = _ANGLE_LIMIT_MARGIN, position / DEGREES_PER_RADIAN
    beyond = np.maximum(low - position, position - high).max(axis=0)
    inside = np.all((degrees > low - margin) & (degrees < high + margin))
    if np.any(beyond > margin) and inside and np.median(np.max(np.abs(position), axis=0)) > 2 * math.pi:
        words = f"angles reach {np.max(np.abs(position)):.3g} rad; taken as degrees all are within their limits"
        advice = "convert angles to radians; a CSV is read with units: {position: deg}"
        yield Issue("degrees", words, "refused", float(np.max(beyond)) / margin, advice, "", channel="position")
        return
    for j in np.flatnonzero(beyond > margin):
        name, unit = arm.joint_names[j], arm.joints[j].coordinate_unit
        words = f"{name} goes {beyond[j]:.3g} {unit} beyond its limits of {low[j]:.3g} to {high[j]:.3g}"
        advice, depth = (
            "check the joint's zero, unit and column, and that the recording is this robot's",
            beyond[j] / margin,
        )
        yield Issue("angle_limits", words, "not_trusted", float(depth), advice, "", channel=f"position.{name}")


def _speed_issues(arm: RecordedJointsModel, t: Array, position: Array) -> Iterator[Issue]:
    stride = _SPEED_SAMPLE_STRIDE
    if len(t) < 2 * stride:
        return
    limits = np.array([joint.velocity_limit for joint in arm.joints])
    speed = np.abs(position[stride:] - position[:-stride]) / (t[stride:] - t[:-stride])[:, None]
    ratio = np.percentile(speed, 99, axis=0) / limits
    j = int(np.argmax(ratio))
    if ratio[j] > _MAX_SPEED_RATIO:
        able = f"{limits[j]:.3g} {arm.joints[j].coordinate_unit}/s"
        words = f"{arm.joint_names[j]} turns {ratio[j]:.3g} times as fast as it can ({able})"
        advice, depth = "check the unit of time and of angles", float(ratio[j]) / _MAX_SPEED_RATIO
        yield Issue("speed_limits", words, "not_trusted", depth, advice, "", channel="t")


def effect_setting_line(kind: str, location: str, quantity: str, value: float) -> str:
    """The configuration line that models an error as a known effect."""
    return f"model.effects: [{{kind: {kind}, location: {location}, values: {{{quantity}: {value:.3g}}}}}]"


# -- excitation --------------------------------------------------------------------------------------------------------


def check_dynamic_excitation(arm: RecordedJointsModel, recording: Recording, effort: SensorOptions) -> Iterator[Issue]:
    """Issue where efforts due to speed and acceleration do not exceed the noise of measured efforts.

    Weight and stiffness can be found from static configurations; damping, friction and inertia only from these efforts,
    taken from inverse dynamics and friction of a typical size. The recording is one that the arm `is_recorded_in`.
    """
    joints = recording.joints
    motion = None if joints is None else smoothed_joint_motion(joints, arm.joint_names)
    if joints is None or motion is None or motion.effort is None or effort.use is False:
        return
    if float(np.max(np.ptp(motion.q, axis=0))) < QUALITY_LIMITS.min_joint_motion:
        return  # it stands still, which is said already
    noise = _noise(joints, arm.joint_names, effort)
    if not np.all(noise > 0):
        return
    still = np.zeros_like(motion.q)
    moving = arm.inverse_dynamics(motion.q, motion.v, motion.a) - arm.inverse_dynamics(motion.q, still, still)
    limit = np.array([joint.effort_limit for joint in arm.joints])
    friction = np.where(np.isfinite(limit), VISCOUS_FRICTION_FRACTION * limit, 0.0) * motion.v
    # noise beyond the band of motion is smoothed away, so that so many samples count as one
    apart = max(1.0, 1 / (2 * _MOTION_BANDWIDTH_HZ * median_sample_period(joints.t)))
    samples = len(joints.t) / apart
    band = noise / math.sqrt(apart)
    size = np.sqrt(np.mean(moving**2 + friction**2, axis=0))
    seen = float(np.sqrt(samples * np.sum((size / band) ** 2)))
    if seen < _MIN_SIGNAL_STDS:
        j = int(np.argmax(size / band))
        words = (
            f"speed and acceleration ask {arm.joint_names[j]} for {size[j]:.2g} N m (rms), beside noise of "
            f"{noise[j]:.2g} N m from sample to sample; no joint tells more"
        )
        advice = "move faster; from postures alone weight and stiffness can be found, no damping, friction or inertia"
        depth = _MIN_SIGNAL_STDS / max(seen, 1e-9)
        yield Issue("weak_excitation", words, "warning", depth, advice, recording.name, "joints", "position")


def _noise(joints: JointGroup, names: Sequence[str], effort: SensorOptions) -> Array:
    """White noise of efforts, as stated, else as seen, shape (k,) [N m]."""
    given = effort.std if effort.std is not None else joints.effort_std
    if given is not None:
        return values_by_joint(given, joints.names, names, f"sensors.{EFFORT_GROUP}.std")
    assert joints.effort is not None
    return np.array([white_noise_std(joints.t, joints.effort[:, joints.names.index(name)]) for name in names])


def check_joint_excitation(
    recordings: Sequence[Recording], asked: Mapping[str, Sequence[str]], position: SensorOptions
) -> Iterator[Issue]:
    """Issues of joints that have free parameters, `asked` by joint, but hardly move in any recording."""
    for joint, parameters in asked.items():
        widest, limit, name = 0.0, QUALITY_LIMITS.min_joint_motion, ""
        for recording in recordings:
            joints = recording.joints
            if joints is None or joint not in joints.names:
                continue
            angle = joints.position[:, joints.names.index(joint)]
            noise, given = (
                white_noise_std(joints.t, angle),
                joints.position_std if position.std is None else position.std,
            )
            if given is not None:
                std = values_by_joint(given, joints.names, (joint,), f"sensors.{POSITION_GROUP}.std")
                noise = max(noise, float(std[0]))
            limit, width = max(limit, 6 * noise), float(np.ptp(angle))
            if not name or width > widest:
                widest, name = width, recording.name
        if name and widest < limit:
            words = (
                f"{joint} turns by {widest:.2g} rad at most, in {name}; {limit:.2g} rad is the least that tells "
                f"{', '.join(parameters)} from a constant effort"
            )
            advice, depth = f"record a motion that turns {joint}, or fix {parameters[0]}", limit / max(widest, 1e-9)
            line = "; ".join(f"parameters.{parameter}.free: false" for parameter in parameters)
            where = name, "joints", f"position.{joint}"
            yield Issue("weak_excitation", words, "warning", depth, advice, *where, setting=line)
