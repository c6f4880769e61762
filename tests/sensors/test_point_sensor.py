from __future__ import annotations

import math

import casadi as ca
import numpy as np
import pytest

from yid_ocp.effects import make_effect
from yid_ocp.errors import ModelError
from yid_ocp.model import forward_kinematics
from yid_ocp.model.rotations import homogeneous_transform, rotation_from_rpy
from yid_ocp.sensors import PointSensor, Sensor

POSE = homogeneous_transform(rotation_from_rpy(0.3, -0.2, 1.0), [2.0, 0.5, 0.4])
CAMERA = PointSensor("points_camera", ("joint", "tip"), ("w_T1", "w_T2"), tuple(map(tuple, POSE)))
MOCAP = PointSensor("points_mocap", ("joint", "tip"), ("w_T1", "w_T2"))


def test_it_says_what_it_measures() -> None:
    assert isinstance(CAMERA, Sensor)
    assert CAMERA.channel_names == ("points_camera.joint", "points_camera.tip")
    assert (CAMERA.unit, CAMERA.outputs_per_channel) == ("m", 3)
    assert CAMERA.frame_names == ("w_T1", "w_T2")
    assert CAMERA.camera_pose is not None
    np.testing.assert_allclose(np.array(ca.DM(CAMERA.camera_pose.homogeneous_matrix())), POSE)
    assert MOCAP.camera_pose is None


def test_it_reads_where_its_frames_are(system, read) -> None:
    q = np.random.default_rng(0).uniform(-0.5, 0.5, system.n_coordinates)
    kinematics = forward_kinematics(system.mechanism.with_numeric_values(), ca.SX(ca.DM(q)))
    expected = [np.array(ca.DM(kinematics.frame_position(frame))).ravel() for frame in MOCAP.frame_names]
    assert read(system, MOCAP, q) == pytest.approx(np.concatenate(expected))
    assert read(system, CAMERA, q) == pytest.approx(np.concatenate(expected)), "points stand in the world"


def test_a_point_worked_out_by_hand(system, read) -> None:
    q = np.zeros(system.n_coordinates)
    a, b = 0.3, -0.7
    q[[system.mechanism.joint_index(name) for name in ("left_a", "left_b")]] = a, b
    along = 0.5 + 0.5 * math.cos(b)
    expected = [along * math.sin(a), -0.5 * math.sin(b), along * math.cos(a)]
    assert read(system, PointSensor("points_arm", ("hand",), ("left_gripper",)), q) == pytest.approx(expected)


def test_effects_of_a_camera_change_what_cameras_see(system, read) -> None:
    moved = system.with_effects([make_effect("camera_translation", "camera", system, {"x": 0.01, "y": 0, "z": -0.02})])
    assert read(moved, CAMERA) - read(system, CAMERA) == pytest.approx(2 * [0.01, 0.0, -0.02])
    assert read(moved, MOCAP) == pytest.approx(read(system, MOCAP))


def test_every_channel_knows_its_own_frame(system, read) -> None:
    """The near surface lies at the radius of the tube that each point is on: 30 mm for T1, 10 mm for T2."""
    near = system.with_effects([make_effect("surface_offset", "camera", system, {"fraction": 1.0})])
    shift = (read(near, CAMERA) - read(system, CAMERA)).reshape(2, 3)
    assert np.linalg.norm(shift, axis=1) == pytest.approx([0.03, 0.01])
    rays = POSE[:3, 3] - read(system, CAMERA).reshape(2, 3)
    assert np.cross(shift, rays) == pytest.approx(np.zeros((2, 3)), abs=1e-12)
    assert (np.sum(shift * rays, axis=1) > 0).all()


def test_a_frame_that_is_not_there_is_refused(system, read) -> None:
    with pytest.raises(ModelError, match="w_T9"):
        read(system, PointSensor("points", ("p",), ("w_T9",)))


def test_points_along_a_segment(system, read) -> None:
    """Halfway along two links lies the joint between them; a quarter beyond it, half of the second link."""
    q = np.random.default_rng(1).uniform(-0.5, 0.5, system.n_coordinates)
    found = read(system, PointSensor("points", ("a", "b", "c", "d"), ("T1:50%", "T1_0_tip", "T1:75%", "w_T1")), q)
    half, joint, further, tip = found.reshape(4, 3)
    assert half == pytest.approx(joint)
    assert further == pytest.approx((joint + tip) / 2)
    near = system.with_effects([make_effect("surface_offset", "camera", system, {"fraction": 1.0})])
    along = PointSensor("points_camera", ("a",), ("T1:75%",), tuple(map(tuple, POSE)))
    assert np.linalg.norm(read(near, along, q) - read(system, along, q)) == pytest.approx(0.03)
