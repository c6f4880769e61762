"""Checks of recorded joint motions and efforts against the limits, kinematics and dynamics of the joints."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import casadi as ca
import numpy as np
import scipy.interpolate

from yid_ocp.arrays import Array, BoolArray
from yid_ocp.data.channel_checks import DEGREES_PER_RADIAN, QUALITY_LIMITS, Issue, median_sample_period, white_noise_std
from yid_ocp.data.recording import JointGroup, Recording
from yid_ocp.effects.base import EffectBase, joint_names_by_arm
from yid_ocp.integrator.compiler import MappedFunction
from yid_ocp.model.kinematics import forward_kinematics, lagrangian_first_derivatives
from yid_ocp.model.mechanism import Joint
from yid_ocp.model.system import System
from yid_ocp.parallel import CasadiLockedCache
from yid_ocp.sensors import SensorOptions
from yid_ocp.sensors.base import expand_to_joint_values
from yid_ocp.sensors.joints import (
    JOINT_EFFORT_SENSOR_KEY,
    JOINT_POSITION_GROUP_NAME,
    is_noise_std_stated,
    joint_angle_noise_std,
)
from yid_ocp.sensors.signal_filters import ZeroPhaseLowPassFilter

_ANGLE_LIMIT_MARGIN = 0.1  # allowed excess over joint limits, because robots differ from their URDF [rad or m]
_MAX_SPEED_RATIO = 1.5  # allowed ratio of a joint speed to the limit of the URDF
_SPEED_SAMPLE_STRIDE = 5  # samples over which a speed is averaged, to reduce noise and steps of encoders
_MOTION_BANDWIDTH_HZ = 5.0  # bandwidth of an arm's motion; faster components are removed [Hz]
_MAX_MOTION_SAMPLES = 300  # approximate number of samples used of a motion
_VISCOUS_FRICTION_FRACTION = 0.04  # typical viscous friction over a joint's effort limit [per rad/s]
_LOAD_RANGE_FRACTION = 0.1  # typical size of an unknown load parameter over the range between its bounds
_MIN_SIGNAL_STDS = 5.0  # size over noise from which on a signal is measurable, over all samples and joints


@dataclass(frozen=True)
class RecordedJointsModel:
    """A numeric model of the kinematics and inverse dynamics of the joints whose angles are recorded.

    Driven joints come first, then prescribed ones. Coordinates without recorded angles (a beam's bending) are zero.
    """

    system: System
    joint_names: tuple[str, ...]
    unknown_load_parameters: tuple[str, ...]  # free parameters of payloads and point masses

    @staticmethod
    def from_system(system: System, free: Sequence[str] = ()) -> RecordedJointsModel | None:
        """Return the model of a system's driven and prescribed joints, or None if the system has no such joints."""
        names = (*system.driven, *system.prescribed)
        loads = (effect for effect in system.effects if isinstance(effect, EffectBase) and effect.is_load)
        unknown = tuple(name for effect in loads for name in effect.parameters.names if name in free)
        return RecordedJointsModel(system, names, unknown) if names else None

    def recording_has_all_joint_angles(self, recording: Recording) -> bool:
        """Check whether a recording contains the angles of all joints. Clamps that follow measured points have none."""
        return all(name in recording.joint_names for name in self.joint_names)

    @property
    def joints(self) -> tuple[Joint, ...]:
        """The joints of the model, in the order of `joint_names`."""
        return tuple(map(self.system.mechanism.joint, self.joint_names))

    @property
    def system_configuration_indices(self) -> tuple[int, ...]:
        """The indices of the joints in the system's configuration vector q (n,)."""
        return tuple(self.system.mechanism.joint_index(name) for name in self.joint_names)

    def is_frame_determined_by_angles(self, frame: str) -> bool:
        """Check whether the recorded angles alone determine the position of the frame named `frame`."""
        tree = self.system.mechanism
        return {*tree.ancestor_joint_indices(tree.frame(frame).joint_index)} <= {*self.system_configuration_indices}

    @cached_property
    def _has_no_unknown_descendants(self) -> bool:
        """True if no joint with unknown angle is attached to the recorded joints."""
        ancestors, known = self.system.mechanism.ancestor_joint_indices, set(self.system_configuration_indices)
        return not any(set(ancestors(i)) & known for i in range(self.system.n_coordinates) if i not in known)

    def frame_positions_and_jacobians(self, frames: tuple[str, ...], q: Array) -> tuple[Array, Array]:
        """Compute positions (N, nf, 3) [m] of nf frames, and their derivatives (N, nf, 3, k) with respect to k angles.

        `q` (N, k) holds the joint angles at N times. Every frame must satisfy `is_frame_determined_by_angles`.
        """
        place, slope = self._places(frames)(q)
        return place.reshape(len(q), len(frames), 3), slope.reshape(len(q), len(frames), 3, len(self.joint_names))

    def _inverse_dynamics(self, q: Array, v: Array, a: Array) -> Array:
        """Return joint efforts (N, k) [N m] by rigid-body inverse dynamics, without dampers, springs and grasps."""
        return self._effort(q, v, a)[0][:, :, 0]

    @cached_property
    def _places(self) -> CasadiLockedCache[tuple[str, ...], MappedFunction]:
        def made(frames: tuple[str, ...]) -> MappedFunction:
            known = ca.SX.sym("q", len(self.joint_names))
            kinematics = forward_kinematics(self.system.mechanism, self._placed(known))
            at = self._numbers(ca.vertcat(*(kinematics.frame_position(frame) for frame in frames)))
            outputs = [ca.densify(at), ca.densify(ca.jacobian(at, known))]
            return MappedFunction(ca.Function("places", [known], outputs), use_compiler=False)

        return CasadiLockedCache(made)

    @cached_property
    def _effort(self) -> MappedFunction:
        (q, kinematics), tree, count = self.system.symbols_and_kinematics, self.system.mechanism, len(self.joint_names)
        if self._has_no_unknown_descendants and self.system_configuration_indices == tuple(range(count)):
            frames = {name: frame for name, frame in tree.frames.items() if frame.joint_index < count}
            moved = replace(tree, joints=tree.joints[:count], frames=frames, link_chains={})
            kinematics = replace(kinematics, mechanism=moved)  # without what these joints do not move
        full = [q, *(ca.SX.sym(name, self.system.n_coordinates) for name in "va")]
        known = [ca.SX.sym(name, len(self.joint_names)) for name in ("q", "v", "a")]
        rigid = lagrangian_first_derivatives(kinematics, full[1], self.system.gravity)
        by_v = rigid.lagrangian_by_v
        effort = ca.jtimes(by_v, full[0], full[1]) + ca.jtimes(by_v, full[1], full[2]) - rigid.lagrangian_by_q
        placed = ca.vertcat(*(self._placed(x) for x in known))
        effort = ca.substitute(effort[list(self.system_configuration_indices)], ca.vertcat(*full), placed)
        by = ca.vertcat(ca.SX(0, 1), *(self.system.parameters[name].symbol for name in self.unknown_load_parameters))
        outputs = [ca.densify(self._numbers(part)) for part in (effort, ca.jacobian(effort, by))]
        return MappedFunction(ca.Function("effort", known, outputs), use_compiler=False)

    def _placed(self, known: ca.SX) -> ca.SX:
        full = ca.SX.zeros(self.system.n_coordinates)
        full[list(self.system_configuration_indices)] = known
        return full

    def _numbers(self, expression: ca.SX) -> ca.SX:
        internal = self.system.effect_internal_coordinate_symbols.values()
        symbols = ca.vertcat(self.system.parameters.symbols, *internal)
        values = [*self.system.parameters.vector(), *([0.0] * len(internal))]
        return ca.substitute(expression, symbols, ca.SX(ca.DM(values)))


@dataclass(frozen=True)
class _SmoothedMotion:
    """Smoothed recorded motion of k joints at N times, without both ends of the recording."""

    t: Array  # shape (N,) [s]
    q: Array  # shape (N, k), like speed `v`, acceleration `a` and effort [N m]
    v: Array
    a: Array
    effort: Array | None


def _smoothed_motion(joints: JointGroup, names: tuple[str, ...]) -> _SmoothedMotion | None:
    """Return the smoothed motion of the named joints at a few hundred times, or None if the recording is too short."""
    t, step = joints.t, median_sample_period(joints.t)
    if len(t) < 30 or step <= 0 or t[-1] - t[0] > 1e5 * step:
        return None
    columns = [joints.names.index(name) for name in names]
    low_pass = ZeroPhaseLowPassFilter(min(_MOTION_BANDWIDTH_HZ, 0.2 / step))
    course = scipy.interpolate.CubicSpline(t, low_pass(t, joints.position[:, columns]), axis=0)
    end = max(5, min(len(t) // 10, round(0.3 / step)))
    at = t[end : len(t) - end : max(1, len(t) // _MAX_MOTION_SAMPLES)]
    effort = None
    if joints.effort is not None and not np.isnan(joints.effort[:, columns]).any():
        effort = np.stack([np.interp(at, t, column) for column in low_pass(t, joints.effort[:, columns]).T], axis=1)
    return _SmoothedMotion(at, course(at), course(at, 1), course(at, 2), effort)


def joint_limit_issues(arm: RecordedJointsModel, recording: Recording) -> Iterator[Issue]:
    """Yield issues about recorded angles or speeds that exceed the joint limits of the URDF."""
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
        words = f"angles reach {np.max(np.abs(position)):.3g} rad, {np.max(beyond):.3g} rad beyond their joint's limit "
        words += f"({margin:g} rad is tolerated). If they are degrees, all are within the joint limits"
        advice = "convert angles to radians, or import them again with --units position=deg"
        yield Issue("degrees", words, "refused", float(np.max(beyond)) / margin, advice, "", channel="position")
        return
    for j in np.flatnonzero(beyond > margin):
        name, unit = arm.joint_names[j], arm.joints[j].unit("rad")
        words = f"{name} goes {beyond[j]:.3g} {unit} beyond its limits of {low[j]:.3g} to {high[j]:.3g} {unit}"
        words += f" ({margin:g} {unit} is tolerated)"
        advice = "check the joint's zero, unit and column, and whether the recording is of this robot"
        yield Issue("angle_limits", words, "not_trusted", beyond[j] / margin, advice, "", channel=f"position.{name}")


def _speed_issues(arm: RecordedJointsModel, t: Array, position: Array) -> Iterator[Issue]:
    stride = _SPEED_SAMPLE_STRIDE
    if len(t) < 2 * stride:
        return
    limits = np.array([joint.velocity_limit for joint in arm.joints])
    speed = np.abs(position[stride:] - position[:-stride]) / (t[stride:] - t[:-stride])[:, None]
    ratio = np.percentile(speed, 99, axis=0) / limits
    j = int(np.argmax(ratio))
    if ratio[j] > _MAX_SPEED_RATIO:
        able = f"{limits[j]:.3g} {arm.joints[j].unit('rad')}/s; {_MAX_SPEED_RATIO:g} times is tolerated"
        words = f"{arm.joint_names[j]} turns {ratio[j]:.3g} times as fast as its speed limit ({able})"
        advice, depth = "check the units of times and angles", float(ratio[j]) / _MAX_SPEED_RATIO
        yield Issue("speed_limits", words, "not_trusted", depth, advice, "", channel="t")


def known_effect_config_line(kind: str, location: str, quantity: str, value: float) -> str:
    """Return the configuration line that adds an effect `kind` at a location, with a known `value` of one quantity."""
    return f"model.effects: [{{kind: {kind}, location: {location}, values: {{{quantity}: {value:.3g}}}}}]"


def slow_motion_excitation_issues(
    arm: RecordedJointsModel, recording: Recording, effort: SensorOptions
) -> Iterator[Issue]:
    """Yield an issue if the motion is too slow to reveal damping, friction and inertia in the measured efforts.

    The efforts due to speed and acceleration must exceed the noise of measured efforts. They are computed by inverse
    dynamics, plus friction of a typical size. `effort` holds the options of the effort sensor.
    """
    joints = recording.joints
    motion = None if joints is None else _smoothed_motion(joints, arm.joint_names)
    if joints is None or joints.effort is None or motion is None or motion.effort is None or effort.use is False:
        return
    if float(np.max(np.ptp(motion.q, axis=0))) < QUALITY_LIMITS.min_joint_motion:
        return  # another check reports a standstill
    names = arm.joint_names
    given = effort.std if effort.std is not None else joints.effort_std
    if given is None:
        noise = np.array([white_noise_std(joints.t, joints.effort[:, joints.names.index(name)]) for name in names])
    else:
        noise = expand_to_joint_values(given, joints.names, names, f"sensors.{JOINT_EFFORT_SENSOR_KEY}.std")
    if not np.all(noise > 0):
        return
    still = np.zeros_like(motion.q)
    moving = arm._inverse_dynamics(motion.q, motion.v, motion.a) - arm._inverse_dynamics(motion.q, still, still)
    limit = np.array([joint.effort_limit for joint in arm.joints])
    friction = np.where(np.isfinite(limit), _VISCOUS_FRICTION_FRACTION * limit, 0.0) * motion.v
    size = np.sqrt(np.mean(moving**2 + friction**2, axis=0))
    seen = float(np.sqrt(len(joints.t) * np.sum((size / noise) ** 2)))
    if seen < _MIN_SIGNAL_STDS:
        words = "over all samples and joints, the effort that speed and acceleration require is only "
        words += f"{seen:.2g} standard deviations of the noise (at least {_MIN_SIGNAL_STDS:g} are needed)"
        advice = "move faster, because slow motions do not determine damping, friction and inertia"
        depth = _MIN_SIGNAL_STDS / max(seen, 1e-9)
        yield Issue("weak_excitation", words, "warning", depth, advice, recording.name, "joints", "position")


def joint_excitation_issues(
    recordings: Sequence[Recording], free_parameters: Mapping[str, Sequence[str]], position: SensorOptions
) -> Iterator[Issue]:
    """Yield an issue for each joint with `free_parameters` that hardly moves; `position`: options of its sensor."""
    for joint, parameters in free_parameters.items():
        widest, limit, name = 0.0, QUALITY_LIMITS.min_joint_motion, ""
        for recording in recordings:
            joints = recording.joints
            if joints is None or joint not in joints.names:
                continue
            angle = joints.position[:, joints.names.index(joint)]
            noise = white_noise_std(joints.t, angle)
            if is_noise_std_stated(joints, JOINT_POSITION_GROUP_NAME, position):
                noise = max(noise, float(joint_angle_noise_std(joints, (joint,), position, recording.name)[0]))
            limit, width = max(limit, 6 * noise), float(np.ptp(angle))
            if not name or width > widest:
                widest, name = width, recording.name
        if name and widest < limit:
            words = f"{joint} turns by at most {widest:.2g} rad ({limit:.2g} rad is needed for {', '.join(parameters)})"
            advice, depth = "turn the joint further, or fix these parameters", limit / max(widest, 1e-9)
            line = "; ".join(f"parameters.{parameter}.free: false" for parameter in parameters)
            where = name, "joints", f"position.{joint}"
            yield Issue("weak_excitation", words, "warning", depth, advice, *where, setting=line)


# With measured effort e_j of joint j and the effort w_j that bodies and gravity require (Newton and Euler),
#
#     e_j / g_j = w_j + c_j + d_j v_j + s_j sign(v_j) + k_j q_j + (J' f)_j,
#
# linear in the inverse gain 1/g_j, offset c_j, viscous friction d_j, dry friction s_j, spring k_j, the load f of each
# grasp on the arm, f = f_0 + K (x - mean x) + D dx/dt + (quadratic in x), and the unknown parameters of payloads. All
# have priors of a size that is typical for robots, so that a joint without information keeps g = 1. A joint whose
# effort stays unexplained has no issue: a counterbalance that the URDF lacks is not a wrong sign.

# Error of a robot's model: fraction of the joint's effort limit, fraction of the required effort's standard deviation.
_EFFORT_LIMIT_ERROR_FRACTION, _EFFORT_SPREAD_ERROR_FRACTION = 0.02, 0.1
# Typical sizes over a joint's effort limit: offset, dry friction, spring [per rad].
_OFFSET_FRACTION, _COULOMB_FRICTION_FRACTION, _JOINT_SPRING_FRACTION = 0.05, 0.02, 0.02
# Typical force on a grasp [N], and its derivatives [N/m, N/m^2, N s/m].
_GRASP_FORCE_STD, _GRASP_STIFFNESS_STD, _GRASP_QUADRATIC_STIFFNESS_STD, _GRASP_DAMPING_STD = 30.0, 150.0, 1500.0, 30.0
_WRONG_GAIN_FACTOR = 3.0  # usual size of 1/g, and the factor from which a gain counts as wrong
_MAX_EXPLAINED_RMS = 1.5  # residual over the model's error, up to which a joint's effort is explained
_WELL_EXPLAINED_RMS = 0.5  # ratio below which no lag is needed as an explanation
_WRONG_ROBOT_RMS = 3.0  # ratio above which the efforts do not belong to this robot
_MIN_FITTED_STD, _MAX_FITTED_EFFORT = 1e-12, 1e12  # limits of numbers that a fit can use
_MIN_Z = 5.0  # standard deviations from which on an error is significant
_INDEPENDENT_SAMPLE_BANDWIDTH = 1.0  # samples count as independent if they are half of its inverse apart [Hz]
_MIN_EFFORT = 1e-3  # smaller efforts give no information [N m]
_LAG_SEARCH_STEP = 0.1  # step of the search for a lag of efforts; a shorter lag is no gross error [s]
_IDLE_COMMAND_FRACTION = 0.2  # of the effort limit, which a joint with zero command may seem to require by friction
_MAX_EFFORT_RATIO = 1.3  # allowed ratio to the URDF's effort limit, which may hold for continuous use only


@dataclass(frozen=True)
class _Data:
    """Motion, recorded efforts (N, k), efforts that bodies and gravity require (`needed`), and effort limits [N m]."""

    arm: RecordedJointsModel
    motion: _SmoothedMotion
    effort: Array
    needed: Array
    size: Array

    @property
    def holders(self) -> tuple[str, ...]:
        """Frames at which the arm holds objects: those of the grasps whose position the angles determine."""
        frames = (grasp.holder_frame for grasp in self.arm.system.grasps)
        return tuple(frame for frame in frames if self.arm.is_frame_determined_by_angles(frame))


class _EffortFit(NamedTuple):
    """Results of a fit of each joint's effort, shape (k,)."""

    inverse: Array  # 1/g
    std: Array
    offset: Array  # [N m]
    offset_std: Array
    left: Array  # rms of the unexplained part over the model's error
    direct: Array  # gain from the variation of recorded and required efforts alone, without prior and noise
    shift: Array  # mean recorded minus mean required effort, without prior and noise [N m]
    cost: float


def inverse_dynamics_effort_issues(arm: RecordedJointsModel, recording: Recording) -> list[Issue]:
    """Return issues about recorded efforts that disagree with the inverse dynamics of the recorded motion."""
    joints = recording.joints
    motion = None if joints is None else _smoothed_motion(joints, arm.joint_names)
    if joints is None or motion is None or motion.effort is None or len(motion.t) < 10:
        return []
    needed = arm._inverse_dynamics(motion.q, motion.v, motion.a)
    largest = np.array([joint.effort_limit for joint in arm.joints])
    size = np.where(np.isfinite(largest), largest, np.maximum(np.max(np.abs(needed), axis=0), 1e-9))
    found, ratio = list[Issue](), np.percentile(np.abs(motion.effort), 99, axis=0) / largest
    if np.any(ratio > _MAX_EFFORT_RATIO):
        j = int(np.argmax(ratio))
        words = f"the effort of {arm.joint_names[j]} is {ratio[j]:.3g} times its effort limit ({largest[j]:.3g} N m; "
        words += f"{_MAX_EFFORT_RATIO:g} times is tolerated)"
        advice = "check the effort limit in the URDF. If efforts are in N mm, import again with --units 'effort=N mm'"
        found.append(_issue("effort_limits", words, float(ratio[j]) / _MAX_EFFORT_RATIO, advice, arm.joint_names[j]))
    most = [float(np.max(np.abs(values), initial=0.0)) for values in (needed, motion.effort)]
    if most[0] > _MIN_EFFORT and max(most) < _MAX_FITTED_EFFORT:
        commanded = joints.effort_sampling_kind_or_default == "command"
        least = (_IDLE_COMMAND_FRACTION if commanded else 2 * _EFFORT_LIMIT_ERROR_FRACTION) * size
        wanted = np.sqrt(np.mean(needed**2, axis=0))
        dead = (np.max(np.abs(motion.effort), axis=0) < 1e-3 * wanted) & (wanted > least)
        if dead.any():
            which = "all joints" if dead.all() else ", ".join(np.array(arm.joint_names)[dead])
            words = f"the effort of {which} is zero throughout, but gravity and motion require "
            words += f"{np.max(wanted[dead]):.2g} N m (rms)"
            advice = "record efforts, or move the arms as measured and use no efforts"
            setting = "model.arms.mode: prescribed; sensors.joints.effort.use: false"
            found.append(_issue("effort_zero", words, 1e3, advice, setting=setting))
        elif arm._has_no_unknown_descendants or not arm.system.grasps:  # no closed loop of any load
            # a delayed oscillation looks like a flipped sign, so delays are tested first
            data = _Data(arm, motion, motion.effort, needed, size)
            fit = _fitted(data)
            found += list(_late(data, fit)) or list(_by_joint(data, fit))
    return [replace(issue, recording=recording.name) for issue in found]


def _issue(cause: str, words: str, depth: float, advice: str, joint: str = "", setting: str = "") -> Issue:
    channel = f"effort.{joint}" if joint else "effort"
    return Issue(cause, words, "not_trusted", depth, advice, "", "joints", channel, setting=setting)


def _by_joint(data: _Data, fit: _EffortFit) -> Iterator[Issue]:
    arm, effort, needed, size = data.arm, data.effort, data.needed, data.size
    loaded, factor, names = _loaded(data), _WRONG_GAIN_FACTOR, arm.joint_names
    # A held object can add to efforts, but not several times the arm's weight, nor support nearly all of it. The prior
    # on the gain does not allow powers of ten, so efforts are scaled first.
    ratio = float(np.linalg.norm(needed)) / max(float(np.linalg.norm(effort)), 1e-300)
    common = 1.0 if 1 / factor < ratio < factor else 10.0 ** round(math.log10(ratio))
    fit = fit if common == 1.0 else _fitted(replace(data, effort=common * effort))
    told = fit.std < np.maximum(0.6 * np.abs(fit.inverse), 0.35)
    sound = told & (fit.left < _MAX_EXPLAINED_RMS) & (np.abs(fit.offset) < 3 * _OFFSET_FRACTION * size)
    usual = 1.0
    if common != 1.0 and sound.sum() >= 2:
        scale = 1 / (common * max(float(np.median(np.abs(fit.inverse[sound]))), _MIN_FITTED_STD))
        # the fitted gains and the sizes of the efforts must give one scale, or each joint is compared with 1
        if not 1 / factor < scale < factor and 1 / factor < scale * common < factor:
            words = f"efforts are {_ratio_text(scale)} times the required ones "
            words += f"(1/{factor:g} to {factor:g} times is tolerated)"
            advice = f"divide the efforts in the file by {1 / common:g}, if they are in another unit than N m"
            yield _issue("effort_gain", words, max(scale, 1 / scale) / factor, advice)
            usual, common = 1 / common, 1.0  # said; each joint is compared with the others
    turned = sound & (fit.inverse < -_MIN_Z * fit.std / 2) & (fit.inverse < -0.3)
    yield from _signs(arm, fit, turned, told & (fit.inverse > _MIN_Z * fit.std / 2) & (fit.inverse > 0.3))
    for j in np.flatnonzero(sound & ~turned):
        inverse = common * float(fit.inverse[j])
        off = abs(inverse - 1) / (common * float(fit.std[j]))
        strong = 0 < inverse < 1 / factor and fit.direct[j] / common > factor and not loaded[j]
        if off > _MIN_Z and (inverse > factor or strong):
            words = f"the effort of {names[j]} is {_ratio_text(usual / inverse)} times what gravity and motion require "
            words += f"(expected ratio: {usual:g}; 1/{factor:g} to {factor:g} times this is tolerated)"
            advice = "find out the unit and scale of the recorded effort, and on which side of the gear it is measured"
            yield _issue("effort_gain", words, off / _MIN_Z, advice, names[j])
    yield from _offsets(data, fit, told & ~loaded)
    lost = fit.left > _WRONG_ROBOT_RMS
    if arm._has_no_unknown_descendants and lost.sum() > len(names) / 2:
        left = float(np.median(fit.left[lost]))
        strange = f"efforts of {lost.sum()} of {len(names)} joints ({', '.join(np.array(names)[lost])})"
        words = f"{strange} do not match this robot and motion. Their error is {left:.2g} times the usual model error "
        words += f"({_WRONG_ROBOT_RMS:g} times is tolerated)"
        advice = "check that the recording is of this robot, and check its unit of time and the order of its joints"
        yield _issue("effort_unlike", words, left / _WRONG_ROBOT_RMS, advice)


def _ratio_text(ratio: float) -> str:
    return f"{float(f'{ratio:.2g}'):g}"  # two digits, without an exponent


def _signs(arm: RecordedJointsModel, fit: _EffortFit, turned: BoolArray, upright: BoolArray) -> Iterator[Issue]:
    depth = -fit.inverse / fit.std / (_MIN_Z / 2)
    wrong = ((arm.joint_names[j], float(depth[j])) for j in np.flatnonzero(turned))
    cases = [(f"the effort of {name} has", by, name) for name, by in wrong]
    if turned.sum() >= 2 and not upright.any():
        cases = [("all efforts have", float(np.max(depth[turned])), "")]
    for who, by, joint in cases:
        words = f"{who} the opposite sign of what gravity and motion require"
        advice = "multiply the effort in the file by -1, because effort is the motor's torque on the joint"
        yield _issue("effort_sign", words, by, advice, joint)


def _offsets(data: _Data, fit: _EffortFit, told: BoolArray) -> Iterator[Issue]:
    needed, size = data.needed, data.size
    low, high = 1 / _WRONG_GAIN_FACTOR, _WRONG_GAIN_FACTOR
    # a large offset looks like a large gain, but then the variation has the right size
    off_zero = (fit.inverse > 0) & (fit.inverse < low) & (fit.direct > low) & (fit.direct < high)
    offset = np.where(off_zero, fit.shift, fit.offset)
    calm = told & (fit.left < _MAX_EXPLAINED_RMS / 1.5) & (off_zero | ((fit.inverse > low) & (fit.inverse < high)))
    for j in np.flatnonzero(calm & (np.abs(offset) > 3 * _OFFSET_FRACTION * size)):
        # springs that support part of the weight are no wrong offset
        balanced = offset[j] * np.mean(needed[:, j]) < 0 and abs(offset[j]) < np.max(np.abs(needed[:, j]))
        if abs(offset[j]) > _MIN_Z * fit.offset_std[j] and not balanced:
            name, value = data.arm.joint_names[j], float(offset[j])
            limit = 3 * _OFFSET_FRACTION * float(size[j])
            words = f"the effort of {name} has a constant error of {value:+.3g} N m ({limit:.2g} N m is tolerated)"
            setting, depth = known_effect_config_line("effort_offset", name, "offset", value), abs(value) / limit
            yield _issue("effort_offset", words, depth, "correct the sensor's zero, or model the offset", name, setting)


def _late(data: _Data, fit: _EffortFit) -> Iterator[Issue]:
    motion, trials = data.motion, _LAG_SEARCH_STEP * np.arange(-5, 6)
    if motion.t[-1] - motion.t[0] < 4 * trials[-1] or np.max(fit.left) < _WELL_EXPLAINED_RMS:
        return
    inside = (motion.t >= motion.t[0] + trials[-1]) & (motion.t <= motion.t[-1] - trials[-1])
    kept = replace(motion, t=motion.t[inside], q=motion.q[inside], v=motion.v[inside], a=motion.a[inside])
    costs = []
    for late in trials:
        moved = np.stack([np.interp(kept.t + late, motion.t, column) for column in data.effort.T], axis=1)
        costs.append(_fitted(replace(data, motion=kept, effort=moved, needed=data.needed[inside])).cost)
    at = int(np.argmin(costs))
    lag = float(trials[at])
    # by a factor of two, because friction and grasp explain part of a lag
    if abs(lag) > 0.5 * _LAG_SEARCH_STEP and costs[at] < 0.4 * costs[len(trials) // 2]:
        when, arms = "earlier" if lag > 0 else "later", joint_names_by_arm(data.arm.system)
        words = f"efforts fit the motion best if their times are shifted {abs(lag):.2g} s {when} "
        words += f"(a shift below {_LAG_SEARCH_STEP:g} s is tolerated)"
        lines = [known_effect_config_line("effort_delay", name, "delay", lag) for name in arms]
        setting = "; ".join(lines) if abs(lag) <= _LAG_SEARCH_STEP else ""
        advice = "correct the times of efforts" + ", or model the delay" * bool(setting)
        yield _issue("effort_lag", words, abs(lag) / _LAG_SEARCH_STEP, advice, setting=setting)


def _fitted(data: _Data) -> _EffortFit:
    motion, effort, needed, size = data.motion, data.effort, data.needed, data.size
    count, width = needed.shape
    error = _EFFORT_LIMIT_ERROR_FRACTION * size + _EFFORT_SPREAD_ERROR_FRACTION * needed.std(axis=0)
    columns, spread = _by_itself(data)
    loads, sizes = _loads(data)
    matrix, prior = np.concatenate([columns, loads], axis=2) / error[:, None], np.concatenate([spread, sizes])
    weight = math.sqrt(min(1.0, max(2 * _INDEPENDENT_SAMPLE_BANDWIDTH * (motion.t[-1] - motion.t[0]), 2.0) / count))
    rows, target = weight * matrix.reshape(count * width, -1), weight * (needed / error).ravel()
    normal = rows.T @ rows + np.diag(1 / prior**2)
    neutral = np.arange(len(prior)) < width
    found = np.linalg.solve(normal, rows.T @ target + neutral / prior**2)
    std = np.maximum(np.sqrt(np.diag(np.linalg.inv(normal))), _MIN_FITTED_STD)
    remains = (rows @ found - target).reshape(count, width) / weight
    others = np.concatenate([np.zeros(2 * width), found[2 * width :]])
    explained = needed - np.einsum("njc,c->nj", matrix * error[:, None], others)
    shift = effort.mean(axis=0) - explained.mean(axis=0)
    moved, about = explained - explained.mean(axis=0), effort - effort.mean(axis=0)
    direct = np.sum(about * moved, axis=0) / np.maximum(np.sum(moved**2, axis=0), 1e-12)
    cost = float(np.sum((rows @ found - target) ** 2) + np.sum(((found - neutral) / prior) ** 2))
    own, left = slice(width, 2 * width), np.sqrt(np.mean(remains**2, axis=0))
    return _EffortFit(found[:width], std[:width], found[own], std[own], left, direct, shift, cost)


def _by_itself(data: _Data) -> tuple[Array, Array]:
    """Return the columns (N, k, 5 k) of single joints, and their typical sizes: 1/g, offset, friction twice, spring."""
    motion, size, width = data.motion, data.size, data.effort.shape[1]
    # springs are large for joints at which the model estimates a spring
    sprung = {spring.joint_name for spring in data.arm.system.elastic_joints}
    springs = np.where([name in sprung for name in data.arm.joint_names], 10 * size, _JOINT_SPRING_FRACTION * size)
    parts = [
        (data.effort, np.full(width, _WRONG_GAIN_FACTOR)),
        (-np.ones_like(data.effort), _OFFSET_FRACTION * size),
        (-motion.v, _VISCOUS_FRICTION_FRACTION * size),
        (-np.tanh(motion.v / 0.02), _COULOMB_FRICTION_FRACTION * size),
        (-(motion.q - motion.q.mean(axis=0)), springs),
    ]
    columns = np.concatenate([values[:, :, None] * np.eye(width) for values, _ in parts], axis=2)
    return columns, np.concatenate([spread for _, spread in parts])


def _loaded(data: _Data) -> BoolArray:
    """Return the mask (k,) of joints on which a held object can act like an offset."""
    if not data.holders:
        return np.zeros(len(data.size), bool)
    q = data.motion.q
    _, by_angle = data.arm.frame_positions_and_jacobians(data.holders, q[:: max(1, len(q) // 20)])
    lever = np.max(np.linalg.norm(by_angle, axis=2), axis=(0, 1))
    return np.asarray(_GRASP_FORCE_STD * lever > 3 * _OFFSET_FRACTION * data.size)


def _loads(data: _Data) -> tuple[Array, Array]:
    """Return the columns (N, k, c) of held loads and their typical sizes: unknown load parameters, 33 per grasp."""
    motion, arm = data.motion, data.arm
    unknown = [arm.system.parameters[name] for name in arm.unknown_load_parameters]
    columns = [*arm._effort(motion.q, motion.v, motion.a)[1].transpose(2, 0, 1)] if unknown else []
    sizes = [_LOAD_RANGE_FRACTION * (entry.upper - entry.lower) for entry in unknown]
    if data.holders:
        place, by_angle = arm.frame_positions_and_jacobians(data.holders, motion.q)
    for g in range(len(data.holders)):
        moved = place[:, g] - place[:, g].mean(axis=0)
        speed = np.einsum("nik,nk->ni", by_angle[:, g], motion.v)
        for axis in range(3):
            lever = by_angle[:, g, axis, :]
            squares = [lever * (moved[:, [b]] * moved[:, [c]]) for b in range(3) for c in range(b, 3)]
            columns += [lever, *(lever * moved[:, [b]] for b in range(3)), *squares, lever * speed[:, [axis]]]
    stiffness = [_GRASP_STIFFNESS_STD] * 3 + [_GRASP_QUADRATIC_STIFFNESS_STD] * 6
    sizes += [_GRASP_FORCE_STD, *stiffness, _GRASP_DAMPING_STD] * 3 * len(data.holders)
    return np.stack([np.zeros_like(data.needed), *columns], axis=2)[:, :, 1:], np.array(sizes)
