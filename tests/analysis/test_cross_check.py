"""The model beside Pinocchio's: agreement where both are right, a clear sentence where one number is wrong."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from yid_ocp.analysis.pinocchio_comparison import compare_system_with_pinocchio, compare_urdf_with_pinocchio
from yid_ocp.effects import make_effect
from yid_ocp.model import FlexibleSegment, Grasp, System, flexible_object
from yid_ocp.model.mechanism import Mechanism, rotation_from_rpy
from yid_ocp.model.urdf import read_urdf, urdf_path_from_robot_name

GRAVITY = np.array([0.3, -0.2, -9.81])
KEPT = ["extend", "hinge", "spin", "swing"]


def branched(urdf_folder) -> System:
    """A pendulum and an object of three branches, the branches' joints one after the other in turn."""
    robot = read_urdf(urdf_folder / "double_pendulum.urdf")
    soft = {"radius": 0.02, "links": 2, "bend": 4.0, "twist": 3.0}
    turns = {"T2": rotation_from_rpy(0.7, 0.0, 0.0), "T3": rotation_from_rpy(-0.7, 0.2, 0.0)}
    parts = [FlexibleSegment("T1", 0.6, 0.1, **soft)]
    parts += [FlexibleSegment(name, 0.3, 0.05, parent="T1", rest_rotation=turn, **soft) for name, turn in turns.items()]
    grasps = [Grasp("hand", "tip", "w_T2")]
    return System.build(robot, objects=[(flexible_object(parts), None, None)], grasps=grasps, gravity=GRAVITY)


def interleaved(system: System) -> System:
    """The same with T2's and T3's joints alternating: parents come first, branches not one after the other."""
    mechanism = system.mechanism
    names = list(mechanism.joint_names)
    order = list(range(names.index("T2_0_x")))
    for i in range(6):
        order += [names.index(f"{tube}_{i // 3}_{'xyz'[i % 3]}") for tube in ("T2", "T3")]
    new = {old: i for i, old in enumerate(order)} | {-1: -1}
    joints = tuple(replace(mechanism.joints[i], parent_index=new[mechanism.joints[i].parent_index]) for i in order)
    frames = {name: replace(frame, joint_index=new[frame.joint_index]) for name, frame in mechanism.frames.items()}
    return replace(system, mechanism=Mechanism("mixed", joints, frames, mechanism.parameters, mechanism.link_chains))


@pytest.mark.parametrize("mixed", [False, True], ids=["in order", "branches in turn"])
def test_a_built_model_is_pinocchios(urdf_folder, mixed):
    system = interleaved(branched(urdf_folder)) if mixed else branched(urdf_folder)
    rng = np.random.default_rng(2)
    theta, posture = system.parameters.vector({"T2.mass": 0.4}), rng.uniform(-1, 1, system.n_coordinates)
    found = compare_system_with_pinocchio(system, theta, posture)
    assert found.agrees_within_rounding
    assert max(found.mass, found.weight, found.motion) < 1e-12
    assert found.words.startswith(
        "this model: mass matrix, weight and inverse dynamics agree with those of the library Pinocchio, except "
    )


@pytest.mark.parametrize(
    ("kind", "location", "value"),
    [("gravity_scale", "object", 0.7), ("link_mass", "elbow", 1.5), ("length_scale", "T1", 1.1)],
)
def test_effects_are_compared_as_well(urdf_folder, kind, location, value):
    system = branched(urdf_folder)
    effect = make_effect(kind, location, system, {})
    names = effect.parameters.names
    system = system.with_effects([effect])
    theta = system.parameters.vector({names[0]: value})
    found = compare_system_with_pinocchio(system, theta, np.zeros(system.n_coordinates))
    assert found.agrees_within_rounding, found.words


def test_differences_and_files_that_pinocchio_does_not_read_are_said(tmp_path, urdf_folder):
    said = "it differs from Pinocchio's: weight by 2 % of the largest entry (1e-06 % is tolerated). Find the cause"
    system = branched(urdf_folder)
    same = compare_system_with_pinocchio(system, system.parameters.vector(), np.zeros(system.n_coordinates))
    heavier, unknown = (replace(same, of="it", weight=error) for error in (0.02, float("nan")))
    assert (heavier.words, unknown.agrees_within_rounding) == (f"{said} before you use it", False)
    (tmp_path / "odd.urdf").write_text("<robot name='odd'><link name='a'/><link name='b'/></robot>")
    with pytest.raises(ValueError, match="valid URDF"):
        compare_urdf_with_pinocchio(tmp_path / "odd.urdf", read_urdf(urdf_folder / "double_pendulum.urdf"), GRAVITY)


@pytest.mark.parametrize(
    ("file", "joints", "locked"),
    [
        ("double_pendulum.urdf", None, {}),
        ("mixed_joints.urdf", KEPT, {}),
        ("turntable.urdf", None, {}),
        ("package:baxter", ["left_s0", "left_s1", "left_e0", "left_e1", "left_w0", "left_w1", "left_w2"], {}),
    ],
)
def test_a_file_is_read_as_pinocchio_reads_it(urdf_folder, file, joints, locked):
    package = file.startswith("package:")
    path = urdf_path_from_robot_name(file) if package else urdf_folder / file
    robot = read_urdf(file if package else path, joints=joints, locked=locked)
    found = compare_urdf_with_pinocchio(path, robot, GRAVITY, joints, locked)
    assert found.agrees_within_rounding, found.words
    assert found.words.startswith(f"the file {path.name}: ")


def test_a_file_read_wrongly_or_a_lock_at_another_value_is_said(urdf_folder):
    path = urdf_folder / "mixed_joints.urdf"
    robot = read_urdf(path)
    joint = robot.joints[-1]
    placement = replace(joint.placement, translation=joint.placement.translation + ca.SX(ca.DM([0.0, 0.0, 0.001])))
    wrong = replace(robot, joints=(*robot.joints[:-1], replace(joint, placement=placement)))
    found = compare_urdf_with_pinocchio(path, wrong, GRAVITY)
    assert min(found.mass, found.weight, found.motion) > 1e-6
    assert found.words.startswith("the file mixed_joints.urdf differs from Pinocchio's: ")
    robot = read_urdf(path, joints=KEPT, locked={"nod": 0.7})
    assert compare_urdf_with_pinocchio(path, robot, GRAVITY, KEPT, {"nod": 0.7}).agrees_within_rounding
    assert not compare_urdf_with_pinocchio(path, robot, GRAVITY, KEPT, {"nod": 0.6}).agrees_within_rounding


@pytest.mark.parametrize(
    ("file", "left_out", "joints"),
    [("package:panda", ["panda_hand"], None), ("double_pendulum.urdf", ["lower"], ["shoulder"])],
)
def test_what_is_left_out_of_a_file_is_left_out_of_both(urdf_folder, file, left_out, joints):
    path = urdf_path_from_robot_name("package:panda") if file.startswith("package:") else urdf_folder / file
    robot = read_urdf(path, joints=joints, exclude_links=left_out)
    found = compare_urdf_with_pinocchio(path, robot, GRAVITY, joints, None, left_out)
    assert found.agrees_within_rounding, found.words
    whole = read_urdf(path, joints=robot.joint_names)
    found = compare_urdf_with_pinocchio(path, whole, GRAVITY, robot.joint_names, None, left_out)
    assert not found.agrees_within_rounding
