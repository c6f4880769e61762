"""Trees of bodies: hung on frames, merged, given more frames; points named by arc length; rotations."""

import math
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from placed_frames import numbers
from scipy.spatial.transform import Rotation

from yid_ocp.errors import ModelError
from yid_ocp.model import FlexibleSegment, Mechanism, flexible_object, forward_kinematics
from yid_ocp.model.mechanism import (
    Inertia,
    homogeneous_transform,
    merge_inertias,
    numeric_axis_sin_cos_rotation,
    rotation_from_rpy,
    rpy_from_rotation,
    snap_near_integer_entries,
    symbolic_rotation_from_axis_angle,
    symbolic_rotation_from_rpy,
    transform_from_xyz_rpy,
)
from yid_ocp.model.objects.base import CableVertices
from yid_ocp.model.objects.cable import clamped_cable_system
from yid_ocp.model.objects.foam_y import foam_y_object
from yid_ocp.model.urdf import read_urdf


def branched(links=4):
    turn = rotation_from_rpy(-0.8, 0.0, 0.0)
    branch = FlexibleSegment("T2", 0.5, 0.04, 0.01, links, parent="T1", rest_rotation=turn)
    trunk = FlexibleSegment("T1", 0.8, 0.08, 0.03, links)
    return flexible_object([trunk, branch], homogeneous_transform(np.eye(3), [0.1, 0.2, 0.3]))


def places(tree: Mechanism, names, q=None, values=None):
    """Poses (4, 4) of frames at a configuration."""
    q = np.zeros(len(tree.joints)) if q is None else q
    kinematics = forward_kinematics(tree.with_numeric_values(values), ca.SX(ca.DM(q)))
    return [numbers(kinematics.frame_pose(name).homogeneous_matrix()) for name in names]


@pytest.mark.parametrize("links", [1, 2, 3, 4, 7, 8])
@pytest.mark.parametrize("percent", [0.0, 10.0, 25.0, 33.3, 50.0, 99.0, 100.0])
def test_a_percentage_is_that_part_of_the_length_however_many_links(links, percent):
    first, second, junction = places(branched(links).mechanism, [f"T1:{percent:g}%", f"T2:{percent:g}%", "w_T1"])
    np.testing.assert_allclose(first[:3, 3], [0.1, 0.2, 0.3 + 0.8 * percent / 100], atol=1e-12)
    assert np.linalg.norm(second[:3, 3] - junction[:3, 3]) == pytest.approx(0.5 * percent / 100, abs=1e-12)


@pytest.mark.parametrize(("percent", "before", "after", "part"), [(40, 0, 1, 0.6), (85, 2, 3, 0.4)])
def test_inside_a_link_it_lies_on_the_straight_line_and_turns_with_it(percent, before, after, part):
    tree = branched().mechanism
    q = np.random.default_rng(3).uniform(-0.4, 0.4, len(tree.joints))
    near, far, point = places(tree, [f"T1_{before}_tip", f"T1_{after}_tip", f"T1:{percent}%"], q)
    np.testing.assert_allclose(point[:3, 3], near[:3, 3] + part * (far - near)[:3, 3], atol=1e-12)
    np.testing.assert_allclose(point[:3, :3], far[:3, :3], atol=1e-12)


def test_unequal_links_are_counted_by_their_lengths():
    tree = flexible_object([FlexibleSegment("T1", 0.0, 0.1, 0.01, link_lengths=[0.1, 0.5, 0.2])]).mechanism
    heights = [pose[2, 3] for pose in places(tree, [f"T1:{p}%" for p in (5, 12.5, 50, 90)])]
    assert heights == pytest.approx([0.04, 0.1, 0.4, 0.72])


def test_points_stay_when_the_tree_is_put_together():
    """On a robot, after another joint was inserted before it, and with numbers for its parameters."""
    base = flexible_object([FlexibleSegment("B", 0.3, 0.1, 0.01, 2)]).mechanism
    base = replace(base, frames={name: frame for name, frame in base.frames.items() if name != "object_root"})
    aside = homogeneous_transform(np.eye(3), [1.0, 0.0, 0.0])
    tree = base.with_attached_mechanism(branched().mechanism, "B:50%", aside)
    found = places(tree, ["B:50%", "T1:40%"])
    np.testing.assert_allclose(found[0][:3, 3], [0.0, 0.0, 0.15], atol=1e-12)
    np.testing.assert_allclose(found[1][:3, 3], [1.1, 0.2, 0.15 + 0.3 + 0.32], atol=1e-12)
    [again] = places(tree.with_joint_chain_added_at_index(2, [replace(tree.joints[0], name="extra")]), ["T1:40%"])
    np.testing.assert_allclose(again, found[1], atol=1e-12)


def test_a_cable_is_counted_from_clamp_to_clamp():
    parent = ("a", "b", "c", "d", "e")
    shape = {name: [0.1 * i, 0.0, 0.0] for i, name in enumerate(parent)} | {"f": [0.2, 0.0, 0.1]}
    cable = CableVertices(parent, {"child": ("c", "f")}, shape)
    tree = clamped_cable_system(dict.fromkeys(cable.edge_vertex_names, 0.1), cable).mechanism
    along = places(tree, ["parent:0%", "parent:12.5%", "parent:25%", "parent:50%", "parent:100%", "child:50%"])
    a, b, c, e, f = places(tree, ["a", "b", "c", "e", "f"])
    for found, place in zip(along, (a, (a + b) / 2, b, c, e, (c + f) / 2), strict=True):
        np.testing.assert_allclose(found[:3, 3], place[:3, 3], atol=1e-12)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("T1:140%", "'140%' is not a position along 'T1'"),
        ("T1:-1%", "a percentage of the length from 0% (base) to 100% (tip)"),
        ("T1:40", "T1:40%"),
        ("T1:half", "'half' is not a position along 'T1'"),
        ("T1:nan%", "'nan%' is not a position"),
        ("T9:40%", "there is no frame 'T9:40%'"),
        ("T9:40%", ":40%'?"),
        ("w_T9", "did you mean 'w_T"),
    ],
)
def test_what_is_no_place_is_refused(refused_with, name, words):
    tree = branched().mechanism
    with refused_with(ModelError, [words]):
        tree.frame(name)
    assert tree.has_frame(name) == name.startswith("T1:")


def test_joined_mechanisms_hang_on_a_frame(robot):
    item = foam_y_object().mechanism
    placement = transform_from_xyz_rpy([0.0, 0.1, 0.0], [0.0, 0.3, 0.0])
    both = robot.with_attached_mechanism(item, "tip", placement)
    assert both.joint_names == (*robot.joint_names, *item.joint_names)
    assert both.joints[2].parent_index == 1
    assert both.frames["object_root"].joint_index == 1
    assert set(both.parameters.names) == {*robot.parameters.names, *item.parameters.names}
    expected = numbers(robot.frames["tip"].placement.homogeneous_matrix()) @ placement
    expected = expected @ numbers(item.with_numeric_values().joints[0].placement.homogeneous_matrix())
    found = numbers(both.with_numeric_values().joints[2].placement.homogeneous_matrix())
    np.testing.assert_allclose(found, expected, atol=1e-15)


def test_merged_bodies_weigh_what_they_weigh_together():
    rng = np.random.default_rng(1)
    bodies = []
    for _ in range(3):
        root = rng.normal(size=(3, 3))
        bodies.append(Inertia.from_values(rng.uniform(0.1, 2), rng.normal(size=3), root @ root.T))
    one = merge_inertias(bodies)
    masses = np.array([float(b.mass) for b in bodies])
    centres = np.array([numbers(b.center_of_mass).ravel() for b in bodies])
    assert float(one.mass) == pytest.approx(masses.sum())
    np.testing.assert_allclose(numbers(one.center_of_mass).ravel(), masses @ centres / masses.sum())

    def about_origin(body):
        c, m = numbers(body.center_of_mass).ravel(), float(body.mass)
        return numbers(body.inertia_about_com) + m * (c @ c * np.eye(3) - np.outer(c, c))

    np.testing.assert_allclose(about_origin(one), sum(about_origin(b) for b in bodies), atol=1e-12)
    assert merge_inertias([]) is None
    assert merge_inertias([Inertia.from_values(0.0, np.zeros(3), np.zeros((3, 3)))]) is None


def test_a_frame_that_the_file_does_not_have(urdf_folder):
    robot = read_urdf(urdf_folder / "double_pendulum.urdf").with_numeric_values()
    at = homogeneous_transform(np.eye(3), [0.1, 0.2, 0.3])
    more = robot.with_added_frame("load", "tip", at).with_added_frame("wall", None, at)
    tip, load = more.frame("tip"), more.frame("load")
    assert load.joint_index == tip.joint_index
    apart = numbers(load.placement.translation - tip.placement.translation)
    np.testing.assert_allclose(apart, numbers(tip.placement.rotation) @ [[0.1], [0.2], [0.3]])
    assert more.frame("wall").joint_index == -1
    with pytest.raises(ModelError, match="there is already a frame 'tip'"):
        robot.with_added_frame("tip", None, at)
    with pytest.raises(ModelError, match="no frame 'tips'"):
        robot.with_added_frame("load", "tips", at)


ANGLES = st.floats(-math.pi, math.pi)
OBLIQUE = ((0.6, 0.0, 0.8), (1 / 3, -2 / 3, 2 / 3))
AXES = st.sampled_from([*map(tuple, np.eye(3)), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0), *OBLIQUE])


@given(axis=AXES, angle=ANGLES)
def test_a_turn_about_an_axis(axis, angle):
    expected = Rotation.from_rotvec(angle * np.array(axis)).as_matrix()
    numeric = numeric_axis_sin_cos_rotation(axis, math.sin(angle), math.cos(angle))
    np.testing.assert_allclose(numeric, expected, rtol=0, atol=1e-14)
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
    np.testing.assert_array_equal(snap_near_integer_entries(matrix), [[1.0, 0.0, -1.0], [1 + 1e-10, 0.5, -1e-10]])
    assert matrix[0, 0] != 1.0
