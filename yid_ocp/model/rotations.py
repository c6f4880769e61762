"""Rotations and rigid transforms, numeric and symbolic."""

from __future__ import annotations

import math
from collections.abc import Sequence

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from yid_ocp.arrays import Array

# URDF writers round pi to a dozen digits; entries this close to 0 and 1 are meant to be exactly that.
_SNAP_TOLERANCE = 1e-11


def snap_near_integer_entries(matrix: Array) -> Array:
    """The matrix with entries within `_SNAP_TOLERANCE` of -1, 0 or 1 rounded to these numbers."""
    result = np.array(matrix, dtype=float)
    for exact in (-1.0, 0.0, 1.0):
        result[np.abs(result - exact) < _SNAP_TOLERANCE] = exact
    return result


def homogeneous_transform(rotation: ArrayLike, translation: ArrayLike) -> Array:
    """Homogeneous 4x4 matrix from a rotation (3, 3) and a translation (3,) [m]."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = np.asarray(rotation, float), np.asarray(translation, float)
    return matrix


def rotation_from_rpy(roll: float, pitch: float, yaw: float) -> Array:
    """Rotation matrix Rz(yaw) Ry(pitch) Rx(roll) from angles [rad], the convention of URDF, shape (3, 3)."""
    cr, sr, cp, sp, cy, sy = (f(angle) for angle in (roll, pitch, yaw) for f in (math.cos, math.sin))
    x = [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr]
    y = [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr]
    return np.array([x, y, [-sp, cp * sr, cp * cr]])


def rpy_from_rotation(rotation: Array) -> tuple[float, float, float]:
    """Roll, pitch and yaw [rad] of a rotation matrix, the inverse of `rotation_from_rpy`."""
    # the roll is taken in the frame that yaw and pitch leave, which holds at and near pitch = 90 degrees too
    yaw = math.atan2(rotation[1, 0], rotation[0, 0])
    pitch = math.atan2(-rotation[2, 0], math.hypot(rotation[0, 0], rotation[1, 0]))
    c, s = math.cos(yaw), math.sin(yaw)
    return math.atan2(s * rotation[0, 2] - c * rotation[1, 2], c * rotation[1, 1] - s * rotation[0, 1]), pitch, yaw


def rotation_from_axis_sin_cos(axis: ArrayLike, sine: float, cosine: float) -> Array:
    """Rotation matrix about a unit axis, from the sine and cosine of the angle (Rodrigues' formula)."""
    skew = _skew(np.asarray(axis, float))
    return np.eye(3) + sine * skew + (1 - cosine) * skew @ skew


def symbolic_rotation_from_axis_angle(axis: Sequence[float], angle: ca.SX) -> ca.SX:
    """Rotation matrix about a numeric unit axis by a symbolic angle [rad], shape (3, 3)."""
    c, s = ca.cos(angle), ca.sin(angle)
    for k in range(3):
        if abs(abs(axis[k]) - 1.0) < 1e-15:
            s = s * axis[k]
            a, b = (k + 1) % 3, (k + 2) % 3
            matrix = ca.SX(ca.DM.eye(3))
            matrix[a, a], matrix[a, b], matrix[b, a], matrix[b, b] = c, -s, s, c
            return ca.densify(matrix)
    u = np.asarray(axis)
    along = np.outer(u, u)
    return ca.SX(ca.DM(along)) + c * ca.SX(ca.DM(np.eye(3) - along)) + s * ca.SX(ca.DM(_skew(u)))


def symbolic_rotation_from_rpy(roll: ca.SX, pitch: ca.SX, yaw: ca.SX | None = None) -> ca.SX:
    """Rotation matrix Rz(yaw) Ry(pitch) Rx(roll) of symbolic angles [rad], (3, 3); yaw is zero if absent."""
    about_x = symbolic_rotation_from_axis_angle((1.0, 0.0, 0.0), roll)
    turned = symbolic_rotation_from_axis_angle((0.0, 1.0, 0.0), pitch) @ about_x
    return ca.densify(turned if yaw is None else symbolic_rotation_from_axis_angle((0.0, 0.0, 1.0), yaw) @ turned)


def _skew(u: Array) -> Array:
    return np.array([[0, -u[2], u[1]], [u[2], 0, -u[0]], [-u[1], u[0], 0]])


def transform_from_xyz_rpy(xyz: ArrayLike = (0.0, 0.0, 0.0), rpy: ArrayLike = (0.0, 0.0, 0.0)) -> Array:
    """Homogeneous 4x4 matrix from a translation [m] and roll, pitch, yaw [rad]."""
    return homogeneous_transform(rotation_from_rpy(*np.asarray(rpy, float)), xyz)
