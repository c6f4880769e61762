"""URDF files: what is kept, locked, merged and refused, and the way back to text."""

import math
from pathlib import Path, PurePosixPath

import numpy as np
import pytest
from placed_frames import numbers

from yid_ocp.errors import ModelError
from yid_ocp.model import Mechanism
from yid_ocp.model import urdf as urdf_files
from yid_ocp.model.mechanism import Frame, Inertia, Joint, Placement, homogeneous_transform, merge_inertias
from yid_ocp.model.system import six_joint_floating_mechanism
from yid_ocp.model.urdf import mechanism_to_urdf, read_urdf, urdf_path_from_robot_name

BODY = '<link name="{name}"><inertial><mass value="{mass}"/><inertia {tensor}/></inertial></link>'
TENSOR = 'ixx="{0}" iyy="{1}" izz="{2}" ixy="0" ixz="0" iyz="0"'
JOINT = '<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><axis xyz="{axis}"/>'
JOINT += '<limit lower="-1" upper="2" effort="3" velocity="4"/></joint>'


def urdf(tmp_path: Path, *parts: str) -> Path:
    path = tmp_path / "robot.urdf"
    path.write_text(f'<robot name="robot">{"".join(parts)}</robot>', encoding="utf-8")
    return path


def link(name):
    return BODY.format(name=name, mass=1, tensor=TENSOR.format(1, 1, 1))


def joint(name, parent, child, kind="revolute", axis="0 0 1"):
    return JOINT.format(name=name, kind=kind, parent=parent, child=child, axis=axis)


def assert_equal_mechanisms(one, two, tolerance=1e-12):
    one, two = one.with_numeric_values(), two.with_numeric_values()
    assert one.joint_names == two.joint_names
    assert set(one.frames) <= set(two.frames)
    for a, b in zip(one.joints, two.joints, strict=True):
        assert (a.kind, a.parent_index) == (b.kind, b.parent_index)
        for key in ("lower_limit", "upper_limit", "effort_limit", "velocity_limit"):
            assert getattr(a, key) == getattr(b, key)
        np.testing.assert_allclose(a.axis, b.axis, rtol=0, atol=tolerance)
        pairs = [(a.placement.homogeneous_matrix(), b.placement.homogeneous_matrix())]
        body, other = merge_inertias(a.bodies), merge_inertias(b.bodies)
        assert (body is None) == (other is None)
        if body is not None and other is not None:
            keys = ("mass", "center_of_mass", "inertia_about_com")
            pairs += [(getattr(body, key), getattr(other, key)) for key in keys]
        for x, y in pairs:
            np.testing.assert_allclose(numbers(x), numbers(y), rtol=tolerance, atol=tolerance)
    for name, frame in one.frames.items():
        assert frame.joint_index == two.frames[name].joint_index
        expected = numbers(two.frames[name].placement.homogeneous_matrix())
        np.testing.assert_allclose(numbers(frame.placement.homogeneous_matrix()), expected, rtol=0, atol=tolerance)


def test_kept_joints_in_the_order_given(urdf_folder):
    robot = read_urdf(urdf_folder / "mixed_joints.urdf", joints=["swing", "nod", "slide", "spin"])
    # parents come first, the rest as given
    assert robot.joint_names == ("slide", "swing", "nod", "spin")
    assert [joint.parent_index for joint in robot.joints] == [-1, 0, 1, 0]
    assert robot.name == "mixed_joints"
    assert "slide" not in read_urdf(urdf_folder / "mixed_joints.urdf", locked={"slide": 0.3}).joint_names
    assert robot.ancestor_joint_indices(robot.joint_index("nod")) == (0, 1, 2)
    assert robot.ancestor_joint_indices(-1) == ()


def test_limits_and_kinds(urdf_folder):
    robot = read_urdf(urdf_folder / "mixed_joints.urdf")
    slide, spin = map(robot.joint, ("slide", "spin"))
    assert (slide.kind, slide.unit("rad"), slide.lower_limit, slide.upper_limit) == ("prismatic", "m", -0.4, 0.6)
    assert (slide.effort_limit, slide.velocity_limit, slide.unit("N m s/rad")) == (120.0, 0.8, "N s/m")
    assert (spin.kind, spin.unit("rad")) == ("revolute", "rad")
    assert (spin.lower_limit, spin.upper_limit, spin.effort_limit, spin.velocity_limit) == (-math.inf, math.inf, 30, 6)
    np.testing.assert_allclose(slide.axis, [1 / 3, 2 / 3, 2 / 3], rtol=1e-15)


def test_mass_parameters_scale_what_a_joint_carries(urdf_folder):
    robot = read_urdf(urdf_folder / "mixed_joints.urdf", joints=["spin", "swing"])
    assert robot.parameters.names == ("spin.mass", "swing.mass")
    # rotor, bracket, fork and finger; lever and nose
    assert robot.parameters["spin.mass"].value == pytest.approx(0.9 + 0.35 + 0.6)
    assert robot.parameters["swing.mass"].value == pytest.approx(0.8 + 0.25)
    nominal, heavy = robot.with_numeric_values().joints[0], robot.with_numeric_values({"spin.mass": 2 * 1.85}).joints[0]
    [many], [few] = heavy.bodies, nominal.bodies
    np.testing.assert_allclose(numbers(many.inertia_about_com), 2 * numbers(few.inertia_about_com))
    np.testing.assert_allclose(numbers(many.center_of_mass), numbers(few.center_of_mass))


@pytest.mark.parametrize(
    "robot", ["package:baxter", "package:panda", "package:ur5", "package:so101", "mixed_joints", "turntable"]
)
def test_urdf_round_trip(robot, urdf_folder, tmp_path):
    mechanism = read_urdf(robot if robot.startswith("package:") else urdf_folder / f"{robot}.urdf")
    path = tmp_path / "again.urdf"
    path.write_text(mechanism_to_urdf(mechanism), encoding="utf-8")
    again = read_urdf(path).with_numeric_values()
    assert_equal_mechanisms(mechanism, again)
    assert again.name == mechanism.name


def test_round_trip_with_names_that_clash_and_half_open_ranges(tmp_path):
    """A frame called like the link that the writer would make, a joint called like its fixed joint."""
    body = (Inertia.from_values(1.0, [0, 0, 0.1], np.eye(3)),)
    shifted = Placement.from_matrix(homogeneous_transform(np.eye(3), [0.0, 0.0, 0.5]))
    one = Joint("a", "revolute", -1, shifted, (0.0, 0.0, 1.0), body, lower_limit=-1.0)
    other = Joint("b_fixed", "prismatic", 0, shifted, (0.0, 1.0, 0.0), body, effort_limit=5e4)
    frames = {"a_link": Frame(1, shifted), "world": Frame(0, shifted), "b": Frame(-1, shifted)}
    mechanism, path = Mechanism("clash", (one, other), frames), tmp_path / "clash.urdf"
    path.write_text(mechanism_to_urdf(mechanism), encoding="utf-8")
    assert_equal_mechanisms(mechanism, read_urdf(path).with_numeric_values())


def test_a_point_mass_needs_no_inertia(tmp_path):
    point = '<link name="b"><inertial><mass value="2"/></inertial></link>'
    path = urdf(tmp_path, link("a"), point, joint("j", "a", "b"))
    body = read_urdf(path).with_numeric_values().joints[0].bodies[0]
    assert float(body.mass) == 2.0
    np.testing.assert_array_equal(numbers(body.inertia_about_com), np.zeros((3, 3)))


def with_tip(mass="1", moments=(1, 1, 1), tensor=TENSOR, change=("", "")):
    tip = BODY.format(name="tip", mass=mass, tensor=tensor.format(*moments)).replace(*change)
    return link("base"), tip, joint("turn", "base", "tip")


TWO = link("a"), link("b")
THREE = *TWO, link("c")
BROKEN = {
    "floating": ((*TWO, joint("j", "a", "b", "floating")), ["'j'", "'floating'", "prismatic"]),
    "planar": ((*TWO, joint("j", "a", "b", "planar")), ["'j'", "'planar'"]),
    "zero_axis": ((*TWO, joint("j", "a", "b", axis="0 0 0")), ["joint 'j' is 0 0 0", "axis other than 0 0 0", "write"]),
    "two_roots": (TWO, ["2 root links", "exactly one"]),
    "no_root": ((*TWO, joint("j", "a", "b"), joint("k", "b", "a")), ["0 root links"]),
    "unknown_link": ((link("base"), link("b"), joint("j", "bas", "b")), ["'j'", "'bas'", "'base'"]),
    "two_parents": (
        (*THREE, joint("j", "a", "c"), joint("k", "a", "b"), joint("l", "b", "c")),
        ["two joints carry the link 'c'"],
    ),
    "twice_the_joint": ((*THREE, joint("j", "a", "b"), joint("j", "b", "c")), ["two joints are called 'j'"]),
    "ring_beside": ((*THREE, joint("j", "c", "b"), joint("k", "b", "c")), ["'b' is not connected to the root"]),
    "xacro": ((*TWO, '<x:tip xmlns:x="http://www.ros.org/wiki/xacro"/>'), ["unexpanded xacro", ".urdf > robot.urdf`"]),
    "nan_mimic": ((*TWO, joint("j", "a", "b").replace("<limit", '<mimic offset="nan"/><limit')), ["offset is 'nan'"]),
    "truncated": ((link("a"), "<link name="), ["cannot be read"]),
    "negative_moment": (with_tip(moments=(1, -2, 1)), ["negative moment of inertia"]),
    "nan_moment": (with_tip(moments=("nan", 1, 1)), ["inertia ixx is 'nan'"]),
    "infinite_moment": (with_tip(moments=(1, "inf", 1)), ["inertia iyy is 'inf'"]),
    "huge_moment": (with_tip(moments=("1e308", 1, 1)), ["inertia ixx is '1e308'"]),
    "missing_moment": (with_tip(tensor='ixx="1" iyy="1"'), ["inertia ixy is ''"]),
    "negative_mass": (with_tip(mass="-1"), ["a mass of -1 kg", "a mass of zero"]),
    "vanishing_mass": (with_tip(mass="1e-320"), ["a mass of 9.99989e-321 kg", "1e-09 kg and more"]),
    "mass_with_unit": (with_tip(mass="1 kg"), ["mass is '1 kg'"]),
    "no_mass": (with_tip(change=('<mass value="1"/>', "")), ["without a mass"]),
    "two_inertials": (with_tip(change=("</link>", "<inertial/></link>")), ["2 elements <inertial>"]),
    **{f"axis_{x}": ((*TWO, joint("j", "a", "b", axis=x)), ["axis xyz"]) for x in ("1 0", "nan 0 1", "1 0 0 0", "")},
}


def test_a_joint_is_chosen_once(urdf_folder):
    with pytest.raises(ModelError, match="joint 'spin' is listed twice"):
        read_urdf(urdf_folder / "mixed_joints.urdf", joints=["spin", "swing", "spin"])


@pytest.mark.parametrize("name", list(BROKEN))
def test_a_broken_urdf_is_refused(refused_with, name, tmp_path):
    parts, words = BROKEN[name]
    path = urdf(tmp_path, *parts)
    with refused_with(ModelError, [*words, str(path)]):
        read_urdf(path)
    (tmp_path / "page.urdf").write_text("<html></html>")
    with pytest.raises(ModelError, match="the URDF cannot be read: an element has no 'name'"):
        read_urdf(tmp_path / "page.urdf")


@pytest.mark.parametrize(
    ("action", "words"),
    [
        (lambda path: read_urdf("nowhere.urdf"), ["'nowhere.urdf'", "package:NAME"]),
        (lambda path: read_urdf("package:backster"), ["'backster'", "did you mean 'baxter'?", "allowed: baxter, "]),
        (lambda path: read_urdf("so101"), ["'so101'", "package:so101"]),
        (lambda path: read_urdf("package:anymal"), ["has 2 robots 'anymal'", "package:anymal_b_simple_description/"]),
        (lambda path: read_urdf("default:y_objekt.urdf"), ["'y_objekt.urdf'", "did you mean 'y_object.urdf'?"]),
        (lambda path: read_urdf(path, joints=["swimg"]), ["'swimg'", "did you mean 'swing'?"]),
        (lambda path: read_urdf(path, locked={"nods": 1.0}), ["'nods'", "did you mean 'nod'?"]),
        (lambda path: read_urdf(path, ["nod"], {"nod": 1.0}), ["'nod' is listed twice (in joints and in locked"]),
        (lambda path: read_urdf(path, joints=["bolt"]), ["movable joint 'bolt'"]),
        (lambda path: read_urdf(path).joint_index("slider"), ["'slider'", "'slide'", "mixed_joints"]),
        (lambda path: read_urdf(path).frame("tol"), ["frame 'tol'", "'tool'"]),
        (lambda path: read_urdf(path).with_attached_mechanism(read_urdf(path)), ["two parts", "'bracket'"]),
        (
            lambda path: read_urdf(path).with_attached_mechanism(six_joint_floating_mechanism("c"), "rotr"),
            ["'rotr'", "'rotor'"],
        ),
    ],
)
def test_errors_name_what_is_wrong_and_what_is_near(refused_with, urdf_folder, action, words):
    with refused_with(ModelError, words):
        action(urdf_folder / "mixed_joints.urdf")


def test_a_tool_that_is_not_mounted_is_left_out(tmp_path):
    parts = (
        *(link(name) for name in ("base", "arm", "hand", "finger")),
        joint("turn", "base", "arm"),
        joint("wrist", "arm", "hand", "fixed"),
        joint("grip", "hand", "finger", "prismatic"),
    )
    path = urdf(tmp_path, *parts)
    bare = read_urdf(path, exclude_links=["hand"])
    assert (bare.joint_names, set(bare.frames)) == (("turn",), {"base", "arm"})
    assert float(bare.with_numeric_values().joints[0].bodies[0].mass) == 1.0
    with pytest.raises(ModelError, match=r"(?s)no link 'hands'.*exclude_links.*did you mean 'hand'"):
        read_urdf(path, exclude_links=["hands"])
    with pytest.raises(ModelError, match="joint 'grip' is to be used, but carries the excluded link 'finger'"):
        read_urdf(path, joints=["turn", "grip"], exclude_links=["hand"])


def test_moments_that_no_body_has_are_said(tmp_path, caplog, monkeypatch):
    """Robots that people use have them: PR2, Allegro, Romeo. Each path of the file gives the same notice."""
    monkeypatch.chdir(tmp_path)
    for path in (urdf(tmp_path, *with_tip(moments=(1, 1, 3))), "robot.urdf"):
        read_urdf(path)
    assert "robot.urdf: link 'tip' has principal moments" in caplog.text
    assert len({*caplog.messages}) == 1
    caplog.clear()
    path = urdf(tmp_path, *with_tip(moments=(1, 2, 3)))
    read_urdf(path)
    assert caplog.text == ""
    path.write_text(path.read_text().replace('<mass value="1', '<mass value="0" was="1'))
    read_urdf(path)
    assert "robot.urdf: link 'tip' has moments of inertia, but no mass. They are not used" in caplog.text


def follower(tmp_path, following="first"):
    mimic = f'<mimic joint="{following}" multiplier="-2" offset="0.5"/></joint>'
    second = joint("second", "middle", "tip").replace("</joint>", mimic)
    return urdf(tmp_path, link("base"), link("middle"), link("tip"), joint("first", "base", "middle"), second)


def test_a_joint_that_follows_is_locked_where_its_leader_stands(tmp_path, caplog):
    file = follower(tmp_path)
    assert read_urdf(file).joint_names == ("first",)
    assert "'second' follows 'first'" in caplog.text
    pose = numbers(read_urdf(file, joints=(), locked={"first": 0.2}).frames["tip"].placement.homogeneous_matrix())
    angle = 0.2 + (0.5 - 2 * 0.2)
    np.testing.assert_allclose(pose[:2, :2], [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    # and cannot be chosen
    with pytest.raises(ModelError, match="follows 'first'"):
        read_urdf(follower(tmp_path), joints=("first", "second"))
    with pytest.raises(ModelError, match="a joint 'frist' that does not exist"):
        read_urdf(follower(tmp_path, "frist"))


def test_mechanisms_that_ship_are_found_by_name_also_where_a_wheel_put_them(urdf_folder, tmp_path, monkeypatch) -> None:
    assert urdf_path_from_robot_name("default:turntable.urdf").samefile(urdf_folder / "turntable.urdf")

    class Installed(PurePosixPath):
        def locate(self):
            return urdf_folder / self.name

    files = [Installed("../../../share/yid_ocp/urdf/turntable.urdf"), Installed("yid_ocp/cli.py")]
    monkeypatch.setattr(urdf_files, "__file__", str(tmp_path / "site-packages" / "yid_ocp" / "model" / "urdf.py"))
    monkeypatch.setattr(urdf_files.metadata, "files", {"yid-ocp": files}.__getitem__)
    assert urdf_path_from_robot_name("default:turntable.urdf") == urdf_folder / "turntable.urdf"
    with pytest.raises(ModelError, match="no URDF"):
        urdf_path_from_robot_name("default:cli.py")


@pytest.mark.parametrize(
    ("name", "file"),
    [
        ("xarm7", "xarm_description/urdf/xarm7.urdf"),
        ("SO101", "so_arm_description/urdf/so101.urdf"),
        ("kinova.urdf", "kinova_description/robots/kinova.urdf"),
        ("ur5", "ur_description/urdf/ur5_robot.urdf"),
        ("anymal_b_simple_description/robots/anymal.urdf", "anymal_b_simple_description/robots/anymal.urdf"),
    ],
)
def test_a_robot_of_example_robot_data_is_found_by_its_stem_in_any_case(name: str, file: str) -> None:
    assert urdf_path_from_robot_name(f"package:{name}").as_posix().endswith(f"robots/{file}")
