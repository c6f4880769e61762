"""Systems: sizes, parameters, energies, grasps, effects, clamps, and what is refused."""

import math
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from placed_frames import numbers

from yid_ocp.errors import ConfigError, ModelError, YidError, nearest_name_question, unknown_name_error_arguments
from yid_ocp.model import FlexibleSegment, Grasp, Parameter, Parameters, System, flexible_object, forward_kinematics
from yid_ocp.model.mechanism import merge_inertias, rotation_from_rpy
from yid_ocp.model.objects.foam_y import foam_y_object
from yid_ocp.model.system import Effect, six_joint_floating_mechanism
from yid_ocp.model.urdf import read_urdf


@pytest.fixture
def robot(urdf_folder):
    return read_urdf(urdf_folder / "mixed_joints.urdf")


def test_configuration_order_of_the_paper(dual_arm):
    names = dual_arm.mechanism.joint_names
    sides = [name.split("_")[0] for name in names]
    assert sides == ["left"] * 7 + ["right"] * 7 + ["T1"] * 12 + ["T2"] * 12 + ["T3"] * 12
    assert names[:3] == ("left_s0", "left_s1", "left_e0")
    assert (dual_arm.n_constraints, dual_arm.parameters["right_s0.damping"].value) == (6, 0.05)
    assert dual_arm.point_frames == ("w_T1", "w_T2", "w_T3")
    indices = dual_arm.actuated_coordinate_indices, dual_arm.unprescribed_coordinate_indices
    assert indices == (tuple(range(14)), tuple(range(50)))
    assert [segment.name for segment in dual_arm.segment_layouts] == ["T1", "T2", "T3"]
    assert dual_arm.find_segment_layout("T2").parent_segment == "T1"


def test_forces_and_energy(robot):
    cable = flexible_object([FlexibleSegment("C", 0.5, 0.1, 0.01, links=1, bend=2.0, twist=3.0, damping=0.1)])
    system = System.build(robot, objects=[(cable, "tool", None)], driven=["swing", "spin"], damping={"slide": 0.7})
    theta, n = system.parameters.vector(), system.n_coordinates
    x, u = ca.SX.sym("x", n), ca.SX.sym("u", 2)
    outputs = [system.viscous_force(x), system.input_force(u, x, x), system.elastic_energy(x)]
    function = ca.Function("f", [x, u, system.parameters.symbols], outputs)
    viscous, driven, energy = function(np.arange(1.0, n + 1), [5.0, 6.0], theta)
    index, expected = system.mechanism.joint_index, np.zeros(n)
    expected[index("slide")] = -0.7 * (index("slide") + 1)
    for axis in "xyz":
        expected[index(f"C_0_{axis}")] = -0.1 * (index(f"C_0_{axis}") + 1)
    np.testing.assert_allclose(numbers(viscous).ravel(), expected)
    expected = np.zeros(n)
    expected[[index("swing"), index("spin")]] = [5.0, 6.0]
    np.testing.assert_array_equal(numbers(driven).ravel(), expected)
    x0, y0, z0 = (index(f"C_0_{axis}") + 1 for axis in "xyz")
    assert float(energy) == pytest.approx(0.5 * (2 * x0**2 + 2 * y0**2 + 3 * z0**2))


@pytest.mark.parametrize(("kind", "count"), [("point", 3), ("axis", 5), ("weld", 6)])
def test_grasp_equations(kind, count):
    """Zero where holder, turned and offset, meets the held frame; linear in small displacements."""
    tree = six_joint_floating_mechanism("one").with_attached_mechanism(six_joint_floating_mechanism("two"))
    turn = rotation_from_rpy(0.3, -0.5, 0.9)
    grasp = Grasp("g", "one", "two", kind, ca.SX(ca.DM(turn)), ca.SX(ca.DM([0.1, 0.2, 0.3])), axial_slip=ca.SX(0.05))
    system = System.build(tree, grasps=[grasp])
    assert grasp.n_constraint_equations == system.n_constraints == count
    # `two` turned as Rx Ry Rz, its origin 0.05 m ahead of the grasped point along its own z
    angles = [np.arctan2(-turn[1, 2], turn[2, 2]), np.arcsin(turn[0, 2]), np.arctan2(-turn[0, 1], turn[0, 0])]
    q = np.concatenate([np.zeros(6), np.array([0.1, 0.2, 0.3]) + 0.05 * turn[:, 2], angles])

    def residual(q):
        return numbers(system.constraint_residual(forward_kinematics(tree, ca.SX(ca.DM(q))))).ravel()

    np.testing.assert_allclose(residual(q), 0.0, atol=1e-15)
    shifted = q.copy()
    shifted[6] += 0.01
    np.testing.assert_allclose(residual(shifted), [-0.01, *[0.0] * (count - 1)], atol=1e-15)
    twisted = q.copy()
    twisted[11] += 1e-4
    moved = np.abs(residual(twisted))
    assert np.max(moved[:3]) < 1e-15
    # a turn about the held z axis is seen by the weld alone
    assert np.max(moved, initial=0.0) == pytest.approx(1e-4 if kind == "weld" else 0.0, abs=1e-8)
    bent = q.copy()
    bent[9] += 1e-4
    assert (np.max(np.abs(residual(bent))[3:], initial=0.0) > 1e-5) == (kind != "point")


class Heavier(Effect):
    """An effect that doubles gravity at parameter one and adds nothing else."""

    def apply_to_system(self, system):
        return replace(system, gravity=system.gravity * (1 + self.parameters.symbols[0]))


def test_effects_are_appended(robot):
    plain = System.build(robot)
    effect = Heavier("heavier", "world", Parameters([Parameter("heavier@world.fraction", 0.0, "1")]))
    system = plain.with_effects([effect])
    assert system.parameters.names == (*plain.parameters.names, "heavier@world.fraction")
    assert system.effects == (effect,)
    gravity = ca.Function("g", [system.parameters.symbols], [system.gravity])
    np.testing.assert_allclose(numbers(gravity(system.parameters.vector())).ravel(), [0, 0, -9.81])
    double = system.parameters.vector({"heavier@world.fraction": 1.0})
    np.testing.assert_allclose(numbers(gravity(double)).ravel(), [0, 0, -2 * 9.81])
    with pytest.raises(ConfigError, match=r"heavier@world\.fraction"):
        system.with_effects([effect])


EQUAL = [Grasp("g", "nose", "tool"), Grasp("h", "tool", "nose", "weld")]
WRONG = {
    "nothing": (lambda robot: System.build(), ["no joint", "model.object, or both"]),
    "driven": (lambda robot: System.build(robot, driven=["slid"]), ["'slid'", "'slide'"]),
    "prescribed": (lambda robot: System.build(robot, prescribed=["tool"]), ["joint 'tool'"]),
    "both": (lambda robot: System.build(robot, driven=["nod"], prescribed=["nod"]), ["'nod'", "one of the two"]),
    "driven_twice": (lambda robot: System.build(robot, driven=["nod", "nod"]), ["'nod'", "twice", "driven"]),
    "prescribed_twice": (lambda robot: System.build(robot, prescribed=["nod"] * 2), ["twice", "prescribed"]),
    "damping": (lambda robot: System.build(robot, damping={"hing": 1.0}), ["'hing'", "'hinge'"]),
    "holder": (lambda robot: System.build(robot, grasps=[Grasp("g", "tol", "nose")]), ["'tol'", "'tool'"]),
    "held": (lambda robot: System.build(robot, grasps=[Grasp("g", "tool", "noses")]), ["'noses'", "'nose'"]),
    "grasp_twice": (lambda robot: System.build(robot, grasps=[Grasp("g", "tool", "nose")] * 2), ["'g'", "grasps"]),
    "equal_grasps": (lambda robot: System.build(robot, grasps=EQUAL), ["'g' and 'h'", "tool and nose", "remove 'h'"]),
    "point": (lambda robot: System.build(robot, point_frames=["w_T1"]), ["'w_T1'"]),
    "gravity": (lambda robot: System.build(robot, gravity=[9.81]), ["gravity", "3 finite numbers"]),
    "frame": (lambda robot: System.build(robot, objects=[(foam_y_object(), "rotr", None)]), ["'rotr'", "'rotor'"]),
    "objects": (lambda robot: System.build(objects=[(foam_y_object(), None, None)] * 2), ["two parts", "'T1_0_tip'"]),
    "segment": (lambda robot: System.build(robot).find_segment_layout("T1"), ["segment 'T1'"]),
}


@pytest.mark.parametrize("name", list(WRONG))
def test_errors_of_build(refused_with, robot, name):
    action, words = WRONG[name]
    with refused_with(ModelError, words):
        action(robot)


def test_a_clamp_has_six_massless_coordinates():
    clamp = six_joint_floating_mechanism("hand")
    assert clamp.joint_names == tuple(f"hand_{name}" for name in ("x", "y", "z", "rx", "ry", "rz"))
    assert [j.kind for j in clamp.joints] == ["prismatic"] * 3 + ["revolute"] * 3
    assert [j.parent_index for j in clamp.joints] == [-1, 0, 1, 2, 3, 4]
    assert all(merge_inertias(j.bodies) is None for j in clamp.joints)
    assert clamp.frame("hand").joint_index == 5


@pytest.fixture
def three():
    bend, mass = Parameter("T1.bend", 3.0, "N m/rad", 0.0), Parameter("T1.mass", 0.064, "kg", 0.0, 1.0)
    return Parameters([bend, mass, Parameter("wind@object.speed", -2.0, "m/s")])


def test_order_of_theta(three):
    assert three.names == ("T1.bend", "T1.mass", "wind@object.speed")
    np.testing.assert_array_equal(three.vector(), [3.0, 0.064, -2.0])
    np.testing.assert_array_equal(three.vector({"T1.mass": 0.1, "T1.bend": 22.0}), [22.0, 0.1, -2.0])
    assert [three.index(name) for name in three.names] == [0, 1, 2]
    assert [entry.name for entry in three] == list(three.names)
    assert len(three) == 3
    assert "T1.mass" in three
    assert "T1.weight" not in three


def test_symbols_stand_for_the_entries(three):
    function = ca.Function("f", [three.symbols], [three["T1.bend"].symbol * 10 + three["T1.mass"].symbol])
    assert float(function([1.0, 2.0, 3.0])) == 12.0
    assert three.symbols.shape == (3, 1)
    assert Parameters().symbols.shape == (0, 1)


def test_changed_sets_keep_order_and_symbols(three):
    changed = three.with_nominal_values({"T1.bend": 5.0})
    assert changed.names == three.names
    assert (changed["T1.bend"].value, changed["T1.bend"].lower) == (5.0, 0.0)
    assert three["T1.bend"].value == 3.0
    assert ca.is_equal(changed["T1.bend"].symbol, three["T1.bend"].symbol)
    more = three.with_added([Parameter("a", 1.0, "1")], [Parameter("b", 2.0, "1")])
    assert more.names == (*three.names, "a", "b")
    lower, upper = three.lower_and_upper_bounds(["T1.mass", "wind@object.speed"])
    assert (lower.tolist(), upper.tolist()) == ([0.0, -math.inf], [1.0, math.inf])


@pytest.mark.parametrize(
    ("action", "words"),
    [
        (lambda p: p["T1.bent"], ["'T1.bent'", "did you mean 'T1.bend'?"]),
        (lambda p: p.vector({"zz": 1.0}), ["'zz'", "T1.bend, T1.mass, wind@object.speed"]),
        (lambda p: p.vector({"T1.bend": math.nan}), ["T1.bend = nan", "finite"]),
        (lambda p: p.with_nominal_values({"T1.mass": 2.0}), ["T1.mass = 2 kg", "at most 1 kg"]),
        (lambda p: p.with_nominal_values({"T1.mas": 2.0}), ["did you mean 'T1.mass'?"]),
        (lambda p: p.lower_and_upper_bounds(["T2.bend"]), ["'T2.bend'", "'T1.bend'"]),
        (lambda p: p.with_added([Parameter("T1.bend", 1.0, "1")]), ["called 'T1.bend'", "remove the repeated effect"]),
        (lambda p: Parameter("x", math.inf, "1"), ["x = inf"]),
        (lambda p: Parameter("x", 1.0, "1", lower=2.0), ["x = 1 1", "at least 2"]),
    ],
)
def test_errors_name_what_is_wrong_and_what_is_allowed(refused_with, three, action, words):
    with refused_with(ConfigError, words):
        action(three)


def test_an_error_has_its_parts_on_lines_of_their_own():
    error = ModelError("it broke", where="here", allowed="this", hint="that")
    assert str(error) == "it broke\n  where: here\n  allowed: this\n  try: that"
    assert isinstance(error, YidError)
    assert (error.what, error.where, error.allowed, error.hint) == ("it broke", "here", "this", "that")
    lines = str(ModelError("it broke", hint="mend it")).splitlines()
    assert [line.split(":")[0] for line in lines] == ["it broke", "  where", "  allowed", "  try"]


def test_a_long_error_is_shortened_where_it_is_long_and_obeyed_by_no_terminal():
    error = ModelError("what \x1b[2J\n  where: elsewhere", where="here", allowed="a" * 100_000, hint="a_name, " * 40)
    assert len(str(error)) <= 600
    assert str(error).isprintable() == (str(error).count("\n") == 0)
    what, where, allowed, hint = str(error).split("\n")
    assert (what, where) == (r"what \x1b[2J\n  where: elsewhere", "  where: here")
    assert " ... " in allowed
    assert (len(hint) > 200, set(hint.split())) == (True, {"try:", "a_name,", "..."})


def test_nearest_name():
    assert nearest_name_question("left_s3", ["left_s0", "head"]) == "did you mean 'left_s0'?"
    assert nearest_name_question("run_70", ["run_07", "run_09"]) == "did you mean 'run_07'?"
    assert nearest_name_question("zzz", ["b", "a"]) == ""
    assert nearest_name_question("W_t1", ["w_T2", "w_T1"]) == "did you mean 'w_T1'?"


def test_names_are_listed_once_and_long_lists_are_cut():
    few, many, more = ["b", "a"], [f"joint_{i}" for i in range(30)], [f"frame_{i}" for i in range(70)]
    assert unknown_name_error_arguments("aXX", few) == {"allowed": "b, a", "hint": "use one of the allowed names"}
    assert unknown_name_error_arguments("zzz", []) == {"allowed": "none", "hint": "leave 'zzz' out"}
    assert unknown_name_error_arguments("zzz", few, "see --help")["hint"] == "see --help"
    # nothing is near: all of them, for somebody who looks for a name
    assert unknown_name_error_arguments("zzz", many)["allowed"] == ", ".join(many)
    said = unknown_name_error_arguments("joint_7x", many)
    assert said["hint"] == "did you mean 'joint_7'?"
    assert said["allowed"].startswith("joint_7, ")
    assert said["allowed"].endswith(" and 22 more")
    assert unknown_name_error_arguments("joint_7x", many[:9])["allowed"] == ", ".join(many[:9])
    assert unknown_name_error_arguments("zzz", more)["allowed"] == ", ".join(more[:8]) + " and 62 more"
