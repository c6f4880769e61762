"""Flexible objects: lengths, stiffnesses, inertias, rest shapes, what is refused; the paper's Y and a tapered rod."""

import math
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from placed_frames import numbers, positions

from yid_ocp.config.reader import load_config
from yid_ocp.effects import make_effect
from yid_ocp.effects.base import frame_positions
from yid_ocp.errors import ModelError
from yid_ocp.integrator.statics import EquilibriumSolver
from yid_ocp.integrator.step import compile_step
from yid_ocp.model import FlexibleSegment, System, flexible_object, forward_kinematics
from yid_ocp.model.flexible import edge_to_edge_rotations_from_vertices
from yid_ocp.model.mechanism import homogeneous_transform, rotation_from_rpy
from yid_ocp.model.objects.base import OBJECT_KINDS, ObjectBuilder, object_factories_for_init
from yid_ocp.model.objects.foam_y import foam_y_object, foam_y_segments
from yid_ocp.model.urdf import mechanism_to_urdf
from yid_ocp.workflow.build import build_system, link_division_parameter_scale


def stiffness(item):
    """Stiffness and damping of every coordinate by joint name."""
    both = ca.vertcat(*(ca.horzcat(s.stiffness, s.damping) for s in item.elastic_joints))
    rows = numbers(both, item.mechanism.parameters)
    return {spring.joint_name: tuple(row) for spring, row in zip(item.elastic_joints, rows, strict=True)}


def bodies(item) -> list:
    return [body for joint in item.mechanism.with_numeric_values().joints for body in joint.bodies]


def test_unequal_links():
    lengths = [0.1, 0.3, 0.2]
    item = flexible_object([FlexibleSegment("C", 9.9, 0.6, 0.01, link_lengths=lengths)])
    tips = positions(item, ["C_0_tip", "C_1_tip", "C_2_tip", "w_C"])
    np.testing.assert_allclose(tips[:, 2], [0.1, 0.4, 0.6, 0.6])
    assert item.mechanism.parameters["C.length"].value == pytest.approx(0.6)
    carried = bodies(item)
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
    shared = {"bend": 2.0, "twist": 1.5, "damping": 0.1, "values_given_as_rigidities": True, "link_lengths": lengths}
    trunk = FlexibleSegment("A", 0.0, 0.6, 0.01, clamped_at_base=True, **shared)
    branch = FlexibleSegment("B", 0.0, 0.6, 0.01, parent="A", parent_link_index=1, twist_damping=0.3, **shared)
    held = FlexibleSegment("D", 0.0, 0.6, 0.01, parent="A", clamped_at_base=True, **shared)
    springs = stiffness(flexible_object([trunk, branch, held]))
    between = [2 / (0.1 + 0.3), 2 / (0.3 + 0.2)]
    first = {"A": 2 / 0.1, "B": 2 / (0.3 + 0.1), "D": 2 / 0.1}
    for name, start in first.items():
        for i, factor in enumerate([start, *between]):
            assert springs[f"{name}_{i}_x"] == pytest.approx((2.0 * factor, 0.1 * factor))
            assert springs[f"{name}_{i}_y"] == springs[f"{name}_{i}_x"]
            damping = 0.3 if name == "B" else 0.1
            assert springs[f"{name}_{i}_z"] == pytest.approx((1.5 * factor, damping * factor))
    segment = FlexibleSegment("A", 0.6, 0.6, 0.01, links=3, bend=2.0, twist=1.5, damping=0.1)
    assert set(stiffness(flexible_object([segment])).values()) == {(2.0, 0.1), (1.5, 0.1)}


def test_branches_at_inner_links():
    turn = rotation_from_rpy(math.pi / 2, 0.0, 0.0)
    branch = FlexibleSegment("a", 0.2, 0.1, 0.01, links=2, parent="P", parent_link_index=0, rest_rotation=turn)
    item = flexible_object([FlexibleSegment("P", 0.6, 0.3, 0.01, links=3), branch])
    joint = item.mechanism.joint("a_0_x")
    assert item.mechanism.joint_names[joint.parent_index] == "P_0_z"
    np.testing.assert_allclose(positions(item, ["w_a", "w_P"]), [[0, -0.2, 0.2], [0, 0, 0.6]], atol=1e-15)


def test_a_flat_beam_that_bends_one_way():
    more = {"values_given_as_rigidities": True, "clamped_at_base": True, "joint_axes": "y"}
    beam = FlexibleSegment("B", 0.6, 0.3, links=3, cross_section_size=(0.001, 0.08), bend=1.2, **more)
    item = flexible_object([beam])
    assert item.mechanism.joint_names == ("B_0_y", "B_1_y", "B_2_y")
    assert {spring.axis for spring in item.elastic_joints} == {"y"}
    assert [stiffness(item)[f"B_{i}_y"][0] for i in range(3)] == pytest.approx([2 * 1.2 / 0.2, 1.2 / 0.2, 1.2 / 0.2])
    x, y, z = 0.001**2 / 12, 0.08**2 / 12, 0.2**2 / 12
    for body in bodies(item):
        np.testing.assert_allclose(numbers(body.inertia_about_com), 0.1 * np.diag([y + z, x + z, x + y]))
    [layout] = item.segment_layouts
    assert numbers(layout.radius, item.mechanism.parameters).item() == pytest.approx(math.hypot(0.001, 0.08) / 2)


@given(seed=st.integers(0, 2**32 - 1), count=st.integers(2, 7))
def test_polyline_is_reproduced_by_forward_kinematics(seed, count):
    rng = np.random.default_rng(seed)
    vertices = np.cumsum(rng.normal(size=(count, 3)), axis=0)
    start = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    start *= np.sign(np.linalg.det(start))
    first, *later = edge_to_edge_rotations_from_vertices(vertices, start)
    lengths = np.linalg.norm(np.diff(vertices, axis=0), axis=1)
    segment = FlexibleSegment("C", 0.0, 1.0, 0.01, link_lengths=lengths, rest_rotation=first, link_rest_rotations=later)
    item = flexible_object([segment], root_placement=homogeneous_transform(start, vertices[0]))
    tips = positions(item, [f"C_{i}_tip" for i in range(len(lengths))])
    np.testing.assert_allclose(tips, vertices[1:], atol=1e-9)


def test_polyline_turns_the_shortest_way():
    straight, back, sideways = edge_to_edge_rotations_from_vertices([[0, 0, 0], [0, 0, 1], [0, 0, 0], [0, 1, 0]])
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
    item = flexible_object([FlexibleSegment("C", 1.0, 1.0, 0.1, links=links, link_lengths=shares)])
    numeric = item.mechanism.with_numeric_values({"C.length": length, "C.mass": mass, "C.radius": radius})
    found = bodies(replace(item, mechanism=numeric))
    assert sum(float(body.mass) for body in found) == pytest.approx(mass)
    for body in found:
        tensor = numbers(body.inertia_about_com)
        np.testing.assert_array_equal(tensor, tensor.T)
        moments = np.linalg.eigvalsh(tensor)
        assert moments[0] > 0
        # a body's principal moments obey the triangle inequality
        assert moments[2] <= (moments[0] + moments[1]) * (1 + 1e-12)
    assert positions(item, ["w_C"])[0, 2] == pytest.approx(item.mechanism.parameters["C.length"].value)


WRONG = {
    "unknown_parent": ({"parent": "T9"}, ["'T9'", "is not a segment that is listed before"]),
    "no_length": ({"length": 0.0}, ["length is 0.0", "a number above 0 [m]"]),
    "negative_mass": ({"mass": -1.0}, ["mass is -1.0", "a number above 0 [kg]"]),
    "no_radius": ({"radius": math.nan}, ["radius is nan", "a number above 0 [m]"]),
    "no_links": ({"links": 0}, ["links is 0"]),
    "empty_link": ({"link_lengths": [0.1, 0.0]}, ["link_lengths is ["]),
    "no_link_lengths": ({"link_lengths": []}, ["link_lengths is ["]),
    "rotations": ({"links": 3, "link_rest_rotations": [np.eye(3)]}, ["3 links have 1 link_rest_rotations, but need 2"]),
    "parent_link": ({"parent": "T1", "parent_link_index": 4}, ["parent_link_index is 4", "0 to 3"]),
    "joint_axes": ({"joint_axes": "xxz"}, ["joint_axes is 'xxz'", "x, y, z, each at most once"]),
    "no_axis": ({"joint_axes": ""}, ["joint_axes is ''"]),
    "two_sections": ({"cross_section_size": (0.1, 0.2)}, ["both radius and cross_section_size", "remove the other"]),
    "no_section": ({"radius": None}, ["neither radius nor cross_section_size", "one of the two"]),
    "flat_section": (
        {"radius": None, "cross_section_size": (0.0, 0.2)},
        ["cross_section_size[0] is 0.0", "a number above 0 [m]"],
    ),
    "same_name": ({"name": "T1"}, ["two segments are called 'T1'"]),
}


@pytest.mark.parametrize("name", list(WRONG))
def test_errors_of_a_segment(refused_with, name):
    changes, words = WRONG[name]
    options = {"name": "B", "length": 1.0, "mass": 1.0, "radius": 0.1, **changes}
    with refused_with(ModelError, [*words, f"segment {options['name']}"]):
        flexible_object([FlexibleSegment("T1", 1.0, 1.0, 0.1), FlexibleSegment(**options)])


@pytest.mark.parametrize(
    "vertices", [[[0, 0, 0]], [[0, 0], [1, 1]], [[0, 0, 0], [0, 0, 0]], [[0, 0, 0], [math.nan, 0, 0]]]
)
def test_a_degenerate_polyline_is_refused(vertices):
    with pytest.raises(ModelError, match="vertices"):
        edge_to_edge_rotations_from_vertices(vertices)


def test_the_paper_y_stands_where_it_should():
    item = foam_y_object()
    foot, junction, left, right = positions(item, ["object_root", "w_T1", "w_T2", "w_T3"])
    half = math.sqrt(0.5)
    np.testing.assert_allclose(foot, [0.85, 0.0, -0.93])
    np.testing.assert_allclose(junction, foot + np.array([0, 0, 0.813]))
    np.testing.assert_allclose(left, junction + 0.610 * half * np.array([0, 1, 1]), atol=1e-15)
    np.testing.assert_allclose(right, junction + 0.737 * half * np.array([0, -1, 1]), atol=1e-15)
    moved = flexible_object(foam_y_segments(), homogeneous_transform(np.eye(3), [0.0, 0.0, 1.0]))
    np.testing.assert_allclose(positions(moved, ["w_T1"])[0], [0, 0, 1.813])
    assert flexible_object(foam_y_segments()).mechanism.joint_names == item.mechanism.joint_names


def test_the_mount_of_an_object_turns_about_its_root():
    """Where the clamp is, `mount.rx` and `mount.ry` turn the rod as the mount's own roll and pitch would."""
    rod = flexible_object([FlexibleSegment("T1", 0.6, 0.1, 0.02, links=2, clamped_at_base=True)])
    at, turned, angles = np.array([0.1, 0.2, 0.3]), rod.with_root_rotation_parameters(), (0.04, -0.07)
    systems = [
        System.build(objects=[(item, None, homogeneous_transform(rotation_from_rpy(*rpy), at))], gravity=(0, 0, -9.81))
        for item, rpy in ((rod, (*angles, 0.0)), (turned, (0.0, 0.0, 0.0)))
    ]
    values = dict(zip(("mount.rx", "mount.ry"), angles, strict=True))
    q = np.array([[0.3, -0.2, 0.1, 0.0, 0.2, -0.1]])
    for frame in ("object_root", "w_T1"):
        exact, tilted = (frame_positions(s, v, [frame], q) for s, v in zip(systems, ({}, values), strict=True))
        np.testing.assert_allclose(tilted, exact, atol=1e-15)


def test_checked_in_urdf_is_what_the_generator_writes(urdf_folder):
    assert mechanism_to_urdf(foam_y_object().mechanism) == (urdf_folder / "y_object.urdf").read_text(encoding="utf-8")


def test_a_share_of_the_weight_leaves_the_inertia_whole():
    whole, half = foam_y_object(), foam_y_object(gravity_fraction=0.5)
    for body, light in zip(bodies(whole), bodies(half), strict=True):
        assert float(light.mass) == float(body.mass)
        np.testing.assert_array_equal(numbers(light.inertia_about_com), numbers(body.inertia_about_com))
        assert (float(body.gravity_fraction), float(light.gravity_fraction)) == (1.0, 0.5)


LENGTH, MASS, BEND, TIP_MASS, GRAVITY = 1.2, 0.05, 40.0, 0.02, 9.81


def rod(links: int, tip_radius: float = 0.003) -> ObjectBuilder:
    sizes = {"length": LENGTH, "mass": MASS, "base_radius": 0.006, "tip_radius": tip_radius}
    return OBJECT_KINDS["tapered_rod"](**sizes, links=links, joint_axes="x", gravity_fraction=0.0)


def test_mass_and_centre_are_those_of_a_frustum() -> None:
    found, k = bodies(rod(5).build(0.0)), 0.5
    masses = np.array([float(body.mass) for body in found])
    centres = [LENGTH * i / 5 + float(body.center_of_mass[2]) for i, body in enumerate(found)]
    assert masses.sum() == pytest.approx(MASS)
    assert masses @ centres / MASS == pytest.approx(LENGTH / 4 * (1 + 2 * k + 3 * k**2) / (1 + k + k**2))


def test_without_taper_its_links_are_cylinders() -> None:
    item = rod(3, tip_radius=0.006)
    plain = flexible_object(item.segment_definitions(0.02), gravity_fraction=0.0)
    for one, other in zip(bodies(item.build(0.02)), bodies(plain), strict=True):
        tensors = [numbers(body.inertia_about_com) for body in (one, other)]
        assert tensors[0] == pytest.approx(tensors[1], rel=1e-12, abs=1e-15)


@pytest.mark.parametrize("links", [12, 24])
def test_a_tip_load_bends_it_as_beam_theory_says(links: int) -> None:
    """A cone cut off at the tip, under a force F there, bends F L^3 / (3 B taper), B being the base's rigidity."""
    system = System.build(objects=[(rod(links).build(0.01), None, None)], gravity=(0.0, -GRAVITY, 0.0))
    system = system.with_effects([make_effect("point_mass", "w_rod", system, {"mass": TIP_MASS})])
    theta = system.parameters.vector({"rod.bend": BEND})
    rest = EquilibriumSolver(compile_step(system, 0.01, use_compiler=False)).solve([], theta)
    assert rest.is_converged
    q = ca.SX(ca.DM(rest.state[: system.n_coordinates]))
    place = forward_kinematics(system.mechanism, q).frame_position("w_rod")
    place = ca.Function("tip", [system.parameters.symbols], [place])(theta)
    expected = -TIP_MASS * GRAVITY * LENGTH**3 / (3 * BEND * 0.5)
    assert float(place[1]) == pytest.approx(expected, rel=3 / links**2 + 2e-3)


def test_a_configuration_and_init_describe_it(written) -> None:
    text = "{kind: tapered_rod, length: 1.2, mass: 0.05, base_radius: 0.006, tip_radius: 0.003, links: 4}"
    run = load_config(written(f"model: {{object: {text}}}\nparameters: {{rod.taper: {{initial: 0.4}}}}\n"))
    system = build_system(run, link_division=2)
    assert system.parameters["rod.taper"].value == 0.4
    assert len(system.find_segment_layout("rod").link_joints) == 8
    assert link_division_parameter_scale(run, "rod.bend", 2) == 1  # a rigidity
    given = {"length": LENGTH, "mass": MASS, "radius": 0.006, "tip_radius": 0.003}
    made = object_factories_for_init()["tapered_rod"].build(given, 4)
    assert made.settings == replace(rod(4), joint_axes="xy", gravity_fraction=1.0)
    assert set(made.start_values) == {"rod.bend", "rod.damping"}
