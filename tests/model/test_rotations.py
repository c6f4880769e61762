"""Rotation matrices: numeric and symbolic forms agree with each other and with SciPy."""

from __future__ import annotations

import math

import casadi as ca
import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from placed_frames import numbers
from scipy.spatial.transform import Rotation

from yid_ocp.model.rotations import (
    rotation_from_axis_sin_cos,
    rotation_from_rpy,
    rpy_from_rotation,
    snap_near_integer_entries,
    symbolic_rotation_from_axis_angle,
    symbolic_rotation_from_rpy,
)

ANGLES = st.floats(-math.pi, math.pi)
OBLIQUE = ((0.6, 0.0, 0.8), (1 / 3, -2 / 3, 2 / 3))
AXES = st.sampled_from([*map(tuple, np.eye(3)), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0), *OBLIQUE])


@given(axis=AXES, angle=ANGLES)
def test_a_turn_about_an_axis(axis, angle):
    expected = Rotation.from_rotvec(angle * np.array(axis)).as_matrix()
    np.testing.assert_allclose(
        rotation_from_axis_sin_cos(axis, math.sin(angle), math.cos(angle)), expected, rtol=0, atol=1e-14
    )
    symbolic = symbolic_rotation_from_axis_angle(axis, ca.SX(angle))
    assert symbolic.is_dense()
    np.testing.assert_allclose(numbers(symbolic), expected, rtol=0, atol=1e-14)


@given(roll=ANGLES, pitch=ANGLES, yaw=ANGLES)
def test_roll_pitch_yaw(roll, pitch, yaw):
    expected = Rotation.from_euler("xyz", [roll, pitch, yaw]).as_matrix()
    np.testing.assert_allclose(rotation_from_rpy(roll, pitch, yaw), expected, rtol=0, atol=1e-14)
    symbols = [ca.SX(value) for value in (roll, pitch, yaw)]
    np.testing.assert_allclose(numbers(symbolic_rotation_from_rpy(*symbols)), expected, rtol=0, atol=1e-14)
    level = symbolic_rotation_from_rpy(symbols[0], symbols[1])
    np.testing.assert_allclose(numbers(level), rotation_from_rpy(roll, pitch, 0.0), rtol=0, atol=1e-14)


@given(roll=ANGLES, pitch=st.one_of(ANGLES, st.just(math.pi / 2), st.just(-math.pi / 2)), yaw=ANGLES)
def test_angles_of_a_rotation_give_it_back(roll, pitch, yaw):
    rotation = rotation_from_rpy(roll, pitch, yaw)
    found = rpy_from_rotation(rotation)
    assert abs(found[1]) <= math.pi / 2
    np.testing.assert_allclose(rotation_from_rpy(*found), rotation, rtol=0, atol=1e-14)


def test_a_turn_about_a_coordinate_axis_keeps_exact_zeros():
    """The step's equations stay small because products with these zeros vanish."""
    matrix = symbolic_rotation_from_axis_angle((0.0, -1.0, 0.0), ca.SX.sym("angle"))
    assert [i for i in range(9) if matrix[i].is_zero()] == [1, 3, 5, 7]
    assert matrix[4].is_one()


def test_entries_next_to_0_and_1_are_meant_to_be_these():
    matrix = np.array([[1 - 1e-12, 1e-12, -1 + 1e-12], [1 + 1e-10, 0.5, -1e-10]])
    rounded = snap_near_integer_entries(matrix)
    np.testing.assert_array_equal(rounded, [[1.0, 0.0, -1.0], [1 + 1e-10, 0.5, -1e-10]])
    assert matrix[0, 0] != 1.0
