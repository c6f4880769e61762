"""Systems: sizes, parameters, energies, grasps, effects, clamps, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from placed_frames import numbers

from yid_ocp.errors import ConfigError, ModelError
from yid_ocp.model import (
    Effect,
    Grasp,
    Parameter,
    Parameters,
    Segment,
    System,
    flexible_object,
    forward_kinematics,
)
from yid_ocp.model.mechanism import merge_bodies
from yid_ocp.model.objects.foam_y import foam_y_object
from yid_ocp.model.rotations import rotation_from_rpy
from yid_ocp.model.system import floating_clamp
from yid_ocp.model.urdf import read_urdf


@pytest.fixture
def robot(urdf_folder):
    return read_urdf(urdf_folder / "mixed_joints.urdf")


def test_configuration_order_of_the_paper(dual_arm):
    names = dual_arm.mechanism.joint_names
    sides = [name.split("_")[0] for name in names]
    assert sides == ["left"] * 7 + ["right"] * 7 + ["T1"] * 12 + ["T2"] * 12 + ["T3"] * 12
    assert names[:3] == ("left_s0", "left_s1", "left_e0")
    assert dual_arm.n_constraints == 6
    assert dual_arm.parameters["right_s0.damping"].value == 0.05
    assert dual_arm.point_frames == ("w_T1", "w_T2", "w_T3")
    assert dual_arm.driven_coordinate_indices == tuple(range(14))
    assert dual_arm.unprescribed_coordinate_indices == tuple(range(50))
    assert [segment.name for segment in dual_arm.segment_layouts] == ["T1", "T2", "T3"]
    assert dual_arm.segment_layout("T2").parent_segment == "T1"


def test_forces_and_energy(robot):
    cable = flexible_object([Segment("C", 0.5, 0.1, 0.01, links=1, bend=2.0, twist=3.0, damping=0.1)])
    objects = [(cable, "tool", None)]
    system = System.build(robot, objects=objects, driven=["swing", "spin"], damping={"slide": 0.7})
    theta, n = system.parameters.vector(), system.n_coordinates
    x, u = ca.SX.sym("x", n), ca.SX.sym("u", 2)
    outputs = [system.viscous_force(x), system.input_force(u, x, x), system.elastic_energy(x)]
    function = ca.Function("f", [x, u, system.parameters.symbols], outputs)
    viscous, driven, energy = function(np.arange(1.0, n + 1), [5.0, 6.0], theta)
    index = system.mechanism.joint_index
    expected = np.zeros(n)
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
    tree = floating_clamp("one").with_attached_mechanism(floating_clamp("two"))
    turn = rotation_from_rpy(0.3, -0.5, 0.9)
    grasp = Grasp("g", "one", "two", kind, ca.SX(ca.DM(turn)), ca.SX(ca.DM([0.1, 0.2, 0.3])), axial_slip=ca.SX(0.05))
    system = System.build(tree, grasps=[grasp])
    assert grasp.n_constraint_equations == system.n_constraints == count
    # `two` turned as Rx Ry Rz, its origin 0.05 m ahead of the grasped point along its own z
    ry = np.arcsin(turn[0, 2])
    angles = [np.arctan2(-turn[1, 2], turn[2, 2]), ry, np.arctan2(-turn[0, 1], turn[0, 0])]
    q = np.concatenate([np.zeros(6), np.array([0.1, 0.2, 0.3]) + 0.05 * turn[:, 2], angles])

    def residual(q):
        return numbers(system.constraint_residual(forward_kinematics(tree, ca.SX(ca.DM(q))))).ravel()

    np.testing.assert_allclose(residual(q), 0.0, atol=1e-15)
    shifted = q.copy()
    shifted[6] += 0.01
    np.testing.assert_allclose(residual(shifted)[:3], [-0.01, 0, 0], atol=1e-15)
    np.testing.assert_allclose(residual(shifted)[3:], 0.0, atol=1e-15)
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


WRONG = {
    "nothing": (lambda robot: System.build(), ["no joint", "a robot, an object, or both"]),
    "driven": (lambda robot: System.build(robot, driven=["slid"]), ["'slid'", "'slide'"]),
    "prescribed": (lambda robot: System.build(robot, prescribed=["tool"]), ["joint 'tool'"]),
    "both": (lambda robot: System.build(robot, driven=["nod"], prescribed=["nod"]), ["'nod'", "one of the two"]),
    "driven_twice": (lambda robot: System.build(robot, driven=["nod", "nod"]), ["'nod'", "twice", "driven"]),
    "prescribed_twice": (lambda robot: System.build(robot, prescribed=["nod"] * 2), ["twice", "prescribed"]),
    "damping": (lambda robot: System.build(robot, damping={"hing": 1.0}), ["'hing'", "'hinge'"]),
    "holder": (lambda robot: System.build(robot, grasps=[Grasp("g", "tol", "nose")]), ["'tol'", "'tool'"]),
    "held": (lambda robot: System.build(robot, grasps=[Grasp("g", "tool", "noses")]), ["'noses'", "'nose'"]),
    "grasp_twice": (lambda robot: System.build(robot, grasps=[Grasp("g", "tool", "nose")] * 2), ["'g'", "grasps"]),
    "point": (lambda robot: System.build(robot, point_frames=["w_T1"]), ["'w_T1'"]),
    "gravity": (lambda robot: System.build(robot, gravity=[9.81]), ["gravity", "three numbers"]),
    "frame": (lambda robot: System.build(robot, objects=[(foam_y_object(), "rotr", None)]), ["'rotr'", "'rotor'"]),
    "objects": (lambda robot: System.build(objects=[(foam_y_object(), None, None)] * 2), ["two parts", "'T1_0_tip'"]),
    "segment": (lambda robot: System.build(robot).segment_layout("T1"), ["segment 'T1'"]),
}


@pytest.mark.parametrize("name", list(WRONG))
def test_errors_of_build(robot, name):
    action, words = WRONG[name]
    with pytest.raises(ModelError) as caught:
        action(robot)
    for word in words:
        assert word in str(caught.value)


def test_a_clamp_has_six_massless_coordinates():
    clamp = floating_clamp("hand", frame="palm")
    assert clamp.joint_names == ("hand_x", "hand_y", "hand_z", "hand_rx", "hand_ry", "hand_rz")
    assert [j.kind for j in clamp.joints] == ["prismatic"] * 3 + ["revolute"] * 3
    assert clamp.parent_indices == (-1, 0, 1, 2, 3, 4)
    assert all(merge_bodies(j.bodies) is None for j in clamp.joints)
    assert clamp.frame("palm").joint_index == 5
    assert floating_clamp("hand").frame("hand").joint_index == 5
