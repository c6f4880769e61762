"""Chains of links: lengths, stiffnesses, inertias, rest shapes, and what is refused."""

from __future__ import annotations

import math

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from placed_frames import numbers, positions

from yid_ocp.errors import ModelError
from yid_ocp.model import Segment, flexible_object
from yid_ocp.model.flexible import parallel_transport_rotations
from yid_ocp.model.rotations import homogeneous_transform, rotation_from_rpy


def stiffness(item, values=None):
    """Stiffness and damping of every coordinate by joint name."""
    p = item.mechanism.parameters
    function = ca.Function(
        "springs", [p.symbols], [ca.vertcat(*(ca.horzcat(s.stiffness, s.damping) for s in item.elastic_joints))]
    )
    rows = np.array(function(p.vector(values)))
    return {spring.joint_name: tuple(row) for spring, row in zip(item.elastic_joints, rows, strict=True)}


def test_unequal_links():
    lengths = [0.1, 0.3, 0.2]
    item = flexible_object([Segment("C", 9.9, 0.6, 0.01, link_lengths=lengths)])
    tips = positions(item, ["C_0_tip", "C_1_tip", "C_2_tip", "w_C"])
    np.testing.assert_allclose(tips[:, 2], [0.1, 0.4, 0.6, 0.6])
    assert item.mechanism.parameters["C.length"].value == pytest.approx(0.6)
    carried = [joint.bodies[0] for joint in item.mechanism.with_numeric_values().joints if joint.bodies]
    np.testing.assert_allclose([float(b.mass) for b in carried], [0.1, 0.3, 0.2])
    for body, length in zip(carried, lengths, strict=True):
        mass = float(body.mass)
        side = mass * (length**2 / 12 + 0.01**2 / 4)
        np.testing.assert_allclose(numbers(body.center_of_mass).ravel(), [0, 0, length / 2])
        np.testing.assert_allclose(numbers(body.inertia_about_com), np.diag([side, side, mass * 0.01**2 / 2]))
    [layout] = item.segment_layouts
    parameters = item.mechanism.parameters
    np.testing.assert_allclose([numbers(x, parameters).item() for x in layout.link_lengths], lengths)
    assert layout.link_joints == tuple(tuple(f"C_{i}_{axis}" for axis in "xyz") for i in range(3))


def test_rigidity_becomes_stiffness_by_the_lengths_about_a_joint():
    lengths = [0.1, 0.3, 0.2]
    shared = {"bend": 2.0, "twist": 1.5, "damping": 0.1, "stiffness_per_curvature": True, "link_lengths": lengths}
    trunk = Segment("A", 0.0, 0.6, 0.01, clamped_at_base=True, **shared)
    branch = Segment("B", 0.0, 0.6, 0.01, parent="A", parent_link_index=1, twist_damping=0.3, **shared)
    held = Segment("D", 0.0, 0.6, 0.01, parent="A", clamped_at_base=True, **shared)
    springs = stiffness(flexible_object([trunk, branch, held]))
    between = [2 / (0.1 + 0.3), 2 / (0.3 + 0.2)]
    first = {"A": 2 / 0.1, "B": 2 / (0.3 + 0.1), "D": 2 / 0.1}
    for name, start in first.items():
        for i, factor in enumerate([start, *between]):
            assert springs[f"{name}_{i}_x"] == pytest.approx((2.0 * factor, 0.1 * factor))
            assert springs[f"{name}_{i}_y"] == springs[f"{name}_{i}_x"]
            damping = 0.3 if name == "B" else 0.1
            assert springs[f"{name}_{i}_z"] == pytest.approx((1.5 * factor, damping * factor))
    plain = stiffness(flexible_object([Segment("A", 0.6, 0.6, 0.01, links=3, bend=2.0, twist=1.5, damping=0.1)]))
    assert set(plain.values()) == {(2.0, 0.1), (1.5, 0.1)}


def test_branches_at_inner_links():
    trunk = Segment("P", 0.6, 0.3, 0.01, links=3)
    turn = rotation_from_rpy(math.pi / 2, 0.0, 0.0)
    item = flexible_object(
        [trunk, Segment("a", 0.2, 0.1, 0.01, links=2, parent="P", parent_link_index=0, rest_rotation=turn)]
    )
    joint = item.mechanism.joints[item.mechanism.joint_index("a_0_x")]
    assert item.mechanism.joint_names[joint.parent_index] == "P_0_z"
    np.testing.assert_allclose(positions(item, ["w_a", "w_P"]), [[0, -0.2, 0.2], [0, 0, 0.6]], atol=1e-15)


def test_a_flat_beam_that_bends_one_way():
    beam = Segment(
        "B",
        0.6,
        0.3,
        links=3,
        cross_section=(0.001, 0.08),
        joint_axes="y",
        bend=1.2,
        stiffness_per_curvature=True,
        clamped_at_base=True,
    )
    item = flexible_object([beam])
    assert item.mechanism.joint_names == ("B_0_y", "B_1_y", "B_2_y")
    assert {spring.axis for spring in item.elastic_joints} == {"y"}
    assert [stiffness(item)[f"B_{i}_y"][0] for i in range(3)] == pytest.approx([2 * 1.2 / 0.2, 1.2 / 0.2, 1.2 / 0.2])
    x, y, z = 0.001**2 / 12, 0.08**2 / 12, 0.2**2 / 12
    for joint in item.mechanism.with_numeric_values().joints:
        np.testing.assert_allclose(numbers(joint.bodies[0].inertia_about_com), 0.1 * np.diag([y + z, x + z, x + y]))
    [layout] = item.segment_layouts
    assert numbers(layout.radius, item.mechanism.parameters).item() == pytest.approx(math.hypot(0.001, 0.08) / 2)


@given(seed=st.integers(0, 2**32 - 1), count=st.integers(2, 7))
def test_polyline_is_reproduced_by_forward_kinematics(seed, count):
    rng = np.random.default_rng(seed)
    vertices = np.cumsum(rng.normal(size=(count, 3)), axis=0)
    start = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    start *= np.sign(np.linalg.det(start))
    first, *later = parallel_transport_rotations(vertices, start)
    lengths = np.linalg.norm(np.diff(vertices, axis=0), axis=1)
    segment = Segment("C", 0.0, 1.0, 0.01, link_lengths=lengths, rest_rotation=first, link_rest_rotations=later)
    item = flexible_object([segment], root_placement=homogeneous_transform(start, vertices[0]))
    tips = positions(item, [f"C_{i}_tip" for i in range(len(lengths))])
    np.testing.assert_allclose(tips, vertices[1:], atol=1e-9)


def test_polyline_turns_the_shortest_way():
    straight, back, sideways = parallel_transport_rotations([[0, 0, 0], [0, 0, 1], [0, 0, 0], [0, 1, 0]])
    np.testing.assert_array_equal(straight, np.eye(3))
    np.testing.assert_allclose(back @ [0, 0, 1], [0, 0, -1])
    assert np.trace(sideways) == pytest.approx(1.0)
    for rotation in (back, sideways):
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-15)
        assert np.linalg.det(rotation) == pytest.approx(1.0)


@given(
    length=st.floats(1e-3, 10),
    mass=st.floats(1e-4, 100),
    radius=st.floats(1e-4, 1),
    links=st.integers(1, 6),
    unequal=st.booleans(),
    seed=st.integers(0, 2**32 - 1),
)
def test_inertia_is_physical_for_every_theta(length, mass, radius, links, unequal, seed):
    shares = np.random.default_rng(seed).uniform(0.2, 1.0, links) if unequal else None
    item = flexible_object([Segment("C", 1.0, 1.0, 0.1, links=links, link_lengths=shares)])
    numeric = item.mechanism.with_numeric_values({"C.length": length, "C.mass": mass, "C.radius": radius})
    bodies = [body for joint in numeric.joints for body in joint.bodies]
    assert sum(float(body.mass) for body in bodies) == pytest.approx(mass)
    for body in bodies:
        tensor = numbers(body.inertia_about_com)
        np.testing.assert_array_equal(tensor, tensor.T)
        moments = np.linalg.eigvalsh(tensor)
        assert moments[0] > 0
        # a body's principal moments obey the triangle inequality
        assert moments[2] <= (moments[0] + moments[1]) * (1 + 1e-12)
    tip = positions(item, ["w_C"])[0, 2]
    assert tip == pytest.approx(item.mechanism.parameters["C.length"].value)


WRONG = {
    "unknown_parent": ({"parent": "T9"}, ["'T9'", "does not come before"]),
    "no_length": ({"length": 0.0}, ["length = 0.0", "positive"]),
    "negative_mass": ({"mass": -1.0}, ["mass = -1.0", "positive"]),
    "no_radius": ({"radius": math.nan}, ["radius = nan", "positive"]),
    "no_links": ({"links": 0}, ["links = 0"]),
    "empty_link": ({"link_lengths": [0.1, 0.0]}, ["a link has no length"]),
    "no_link_lengths": ({"link_lengths": []}, ["a link has no length"]),
    "rotations": ({"links": 3, "link_rest_rotations": [np.eye(3)]}, ["1 link rotations for 3 links", "2"]),
    "parent_link": ({"parent": "T1", "parent_link_index": 4}, ["parent_link_index = 4", "0 to 3"]),
    "joint_axes": ({"joint_axes": "xxz"}, ["joint_axes = 'xxz'", "x, y, z, each at most once"]),
    "no_axis": ({"joint_axes": ""}, ["joint_axes = ''"]),
    "two_sections": ({"cross_section": (0.1, 0.2)}, ["a radius or a section"]),
    "no_section": ({"radius": None}, ["a radius or a section"]),
    "flat_section": ({"radius": None, "cross_section": (0.0, 0.2)}, ["cross_section[0] = 0.0", "positive"]),
    "same_name": ({"name": "T1"}, ["two segments are called 'T1'"]),
}


@pytest.mark.parametrize("name", list(WRONG))
def test_errors_of_a_segment(name):
    changes, words = WRONG[name]
    options = {"name": "B", "length": 1.0, "mass": 1.0, "radius": 0.1, **changes}
    with pytest.raises(ModelError) as caught:
        flexible_object([Segment("T1", 1.0, 1.0, 0.1), Segment(**options)])
    for word in [*words, f"segment {options['name']}"]:
        assert word in str(caught.value)


@pytest.mark.parametrize(
    "vertices", [[[0, 0, 0]], [[0, 0], [1, 1]], [[0, 0, 0], [0, 0, 0]], [[0, 0, 0], [math.nan, 0, 0]]]
)
def test_a_degenerate_polyline_is_refused(vertices):
    with pytest.raises(ModelError, match="vertices"):
        parallel_transport_rotations(vertices)
