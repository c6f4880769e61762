"""Numeric kinematics and dynamics of the joints with recorded angles, and checks of angles against joint limits."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
import scipy.interpolate
from numpy.typing import NDArray

from yid_ocp.data.issues import DEGREES_PER_RADIAN, Issue, median_sample_period
from yid_ocp.data.recording import JointGroup, Recording
from yid_ocp.model.kinematics import forward_kinematics, rigid_body_derivatives
from yid_ocp.model.mechanism import Joint
from yid_ocp.model.system import System
from yid_ocp.parallel import LockedCache
from yid_ocp.problem.signal_filters import LowPassFilter

Array = NDArray[np.float64]

_ANGLE_LIMIT_MARGIN = 0.1
"""How far angles may be beyond a joint's limits, where a robot's own model differs from its URDF [rad or m]."""
_MAX_SPEED_RATIO = 1.5
"""Factor by which joints may turn faster than the URDF says that they can."""
_SPEED_SAMPLE_STRIDE = 5
"""Samples over which a speed is taken, so that neither noise nor steps of encoders count."""
MOTION_BANDWIDTH_HZ = 5.0
"""Where motion of a robot's arm ends; what is faster is left out [Hz]."""


@dataclass(frozen=True)
class RecordedJointsModel:
    """Numeric kinematics and inverse dynamics of the joints whose angles are recorded.

    Unknown coordinates beyond them, such as a beam's bending, are zero.

    Attributes
    ----------
    system : System
    theta : ndarray, shape (ntheta,)
    joint_names : tuple of str, length k
        Driven, then prescribed joints.
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
        known = set(self.joint_indices)
        return all(i in known for i in mechanism.ancestor_joints(mechanism.frame(frame).joint_index))

    @cached_property
    def has_no_unknown_descendants(self) -> bool:
        """Whether no joint of unknown angle depends on the recorded joints."""
        known = set(self.joint_indices)
        return not any(
            i not in known and set(self.system.mechanism.ancestor_joints(i)) & known
            for i in range(self.system.n_coordinates)
        )

    def frame_positions(self, frames: tuple[str, ...], q: Array) -> tuple[Array, Array]:
        """Positions of frames and their Jacobian by the recorded angles.

        Parameters
        ----------
        frames : tuple of str
            Frames that it `is_frame_determined`.
        q : ndarray, shape (N, k)

        Returns
        -------
        ndarray, shape (N, nf, 3)
            [m]
        ndarray, shape (N, nf, 3, k)
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
        effort = (
            ca.jtimes(rigid.lagrangian_by_v, full[0], full[1])
            + ca.jtimes(rigid.lagrangian_by_v, full[1], full[2])
            - rigid.lagrangian_by_q
        )
        effort = ca.substitute(
            effort[list(self.joint_indices)], ca.vertcat(*full), ca.vertcat(*(self._placed(x) for x in known))
        )
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
    """Smoothed recorded joint motion with its derivatives; both ends are left out.

    Attributes
    ----------
    t : ndarray, shape (N,)
    q, v, a : ndarray, shape (N, k)
    effort : ndarray, shape (N, k), or None
        Smoothed alike [N m].
    """

    t: Array
    q: Array
    v: Array
    a: Array
    effort: Array | None


def smoothed_joint_motion(joints: JointGroup, names: tuple[str, ...], most: int = 300) -> SmoothedJointMotion | None:
    """Smoothed motion of the named joints at up to `most` times; None where the recording is too short.

    Parameters
    ----------
    joints : JointGroup
    names : tuple of str
    most : int
    """
    t, step = joints.t, median_sample_period(joints.t)
    if len(t) < 30 or step <= 0 or t[-1] - t[0] > 1e5 * step:
        return None
    columns = [joints.names.index(name) for name in names]
    low_pass = LowPassFilter(min(MOTION_BANDWIDTH_HZ, 0.2 / step))
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
    low, high = (np.array([getattr(joint, side) for joint in arm.joints]) for side in ("lower_limit", "upper_limit"))
    position = joints.position[:, [joints.names.index(name) for name in arm.joint_names]]
    beyond = np.maximum(low - position, position - high).max(axis=0)
    if np.any(beyond > _ANGLE_LIMIT_MARGIN):
        inside = np.all(
            (position / DEGREES_PER_RADIAN > low - _ANGLE_LIMIT_MARGIN)
            & (position / DEGREES_PER_RADIAN < high + _ANGLE_LIMIT_MARGIN)
        )
        if inside and np.median(np.max(np.abs(position), axis=0)) > 2 * math.pi:
            yield Issue(
                "degrees",
                f"angles reach {np.max(np.abs(position)):.3g} rad; taken as degrees all are within their limits",
                "refused",
                float(np.max(beyond)) / _ANGLE_LIMIT_MARGIN,
                "convert angles to radians; a CSV is read with units: {position: deg}",
                recording.name,
                "joints",
                "position",
            )
            return
        for j in (int(j) for j in np.flatnonzero(beyond > _ANGLE_LIMIT_MARGIN)):
            yield Issue(
                "angle_limits",
                f"{arm.joint_names[j]} goes {beyond[j]:.3g} {arm.joints[j].coordinate_unit} beyond its limits of {low[j]:.3g} to "
                f"{high[j]:.3g}",
                "not_trusted",
                float(beyond[j]) / _ANGLE_LIMIT_MARGIN,
                "check the joint's zero, unit and column, and that the recording is this robot's",
                recording.name,
                "joints",
                f"position.{arm.joint_names[j]}",
            )
    if len(joints.t) < 2 * _SPEED_SAMPLE_STRIDE:
        return
    limits = np.array([joint.velocity_limit for joint in arm.joints])
    speed = (
        np.abs(position[_SPEED_SAMPLE_STRIDE:] - position[:-_SPEED_SAMPLE_STRIDE])
        / (joints.t[_SPEED_SAMPLE_STRIDE:] - joints.t[:-_SPEED_SAMPLE_STRIDE])[:, None]
    )
    ratio = np.percentile(speed, 99, axis=0) / limits
    if np.any(ratio > _MAX_SPEED_RATIO):
        j = int(np.argmax(ratio))
        yield Issue(
            "speed_limits",
            f"{arm.joint_names[j]} turns {ratio[j]:.3g} times as fast as it can ({limits[j]:.3g} {arm.joints[j].coordinate_unit}/s)",
            "not_trusted",
            float(ratio[j]) / _MAX_SPEED_RATIO,
            "check the unit of time and of angles",
            recording.name,
            "joints",
            "t",
        )


def effect_setting_line(kind: str, location: str, quantity: str, value: float) -> str:
    """The configuration line that models an error as a known effect."""
    return f"model.effects: [{{kind: {kind}, location: {location}, values: {{{quantity}: {value:.3g}}}}}]"
