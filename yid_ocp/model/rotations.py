"""Rotations and rigid transforms, numeric and symbolic."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

Matrix = NDArray[np.float64]


# URDF writers round pi to a dozen digits; entries this close to 0 and 1 are meant to be exactly that.
SNAP = 1e-11


def snapped(matrix: Matrix) -> Matrix:
    """Replace entries within `SNAP` of -1, 0 and 1 by these."""
    result = np.array(matrix, dtype=float)
    for exact in (-1.0, 0.0, 1.0):
        result[np.abs(result - exact) < SNAP] = exact
    return result


def transform(rotation: ArrayLike, translation: ArrayLike) -> Matrix:
    """Homogeneous 4x4 matrix from a rotation (3, 3) and a translation (3,) [m]."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = np.asarray(rotation, float), np.asarray(translation, float)
    return matrix


def roll_pitch_yaw(roll: float, pitch: float, yaw: float) -> Matrix:
    """Rotation matrix Rz(yaw) Ry(pitch) Rx(roll), the URDF convention [rad]."""
    cr, sr, cp, sp, cy, sy = *_cs(roll), *_cs(pitch), *_cs(yaw)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def _cs(angle: float) -> tuple[float, float]:
    return math.cos(angle), math.sin(angle)


def _angles(rotation: Matrix) -> tuple[float, float, float]:
    # the roll is taken in the frame that yaw and pitch leave, which holds at and near pitch = 90 degrees too
    yaw = math.atan2(rotation[1, 0], rotation[0, 0])
    pitch = math.atan2(-rotation[2, 0], math.hypot(rotation[0, 0], rotation[1, 0]))
    c, s = _cs(yaw)
    return math.atan2(s * rotation[0, 2] - c * rotation[1, 2], c * rotation[1, 1] - s * rotation[0, 1]), pitch, yaw
