"""MJCF files as robots: mass matrix and bias against MuJoCo's own, and what is left out is said."""

import logging
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from yid_ocp.config.reader import load_config
from yid_ocp.errors import ModelError
from yid_ocp.model import Mechanism, forward_kinematics
from yid_ocp.model import mechanism as mechanism_module
from yid_ocp.model.kinematics import lagrangian_first_derivatives, lagrangian_second_derivatives, mass_matrix
from yid_ocp.model.urdf import joint_damping_and_friction, read_urdf
from yid_ocp.workflow.build import build_system

mujoco = pytest.importorskip("mujoco", reason="MJCF needs mujoco: pip install '.[blind]'")

INERTIAL = '<inertial mass="{0}" pos="0.01 -0.02 {1}" quat="0.9 0.1 0.3 -0.2" diaginertia="0.02 0.03 0.04"/>'


def arm(count: int, inner: str = "") -> str:
    """A chain of links that turn about z and y in turn, as Menagerie's arms do by quaternions."""
    text = inner
    for i in reversed(range(count)):
        turn = 'quat="1 -1 0 0"' if i % 2 else 'quat="1 1 0 0"'
        joint = f'<joint name="joint{i + 1}" axis="0 0 1" range="-2.5 2.5"/>'
        own = joint + INERTIAL.format(2.0 / (i + 1), 0.1)
        text = f'<body name="link{i + 1}" pos="0.05 0 0.2" {turn}>{own}{text}</body>'
    return text


FINGERS = """<body name="left_finger" pos="0 0 0.06"><joint name="finger1" type="slide" axis="0 1 0" range="0 0.04"/>
<geom type="box" size="0.01 0.01 0.02" density="3000"/></body><body name="right_finger" pos="0 0 0.06" quat="0 0 0 1">
<joint name="finger2" type="slide" axis="0 1 0" range="0 0.04"/>
<geom type="box" size="0.01 0.01 0.02" density="3000"/></body><site name="tcp" pos="0 0 0.1"/>"""
MODELS = {
    # seven joints, armature and damping by a default class, fingers that follow each other, position actuators
    "arm with a gripper": f"""<mujoco><compiler angle="radian" autolimits="true"/>
<default><joint armature="0.1" damping="1.0"/></default><worldbody>{arm(7, FINGERS)}</worldbody>
<equality><joint joint1="finger2" joint2="finger1" polycoef="0 1 0 0 0"/></equality>
<actuator><position joint="joint1" kp="100" kv="10" forcerange="-87 87"/>
<motor joint="joint2" gear="2" ctrlrange="-20 20"/></actuator></mujoco>""",
    # inertia of geoms, degrees, friction: a small servo arm
    "servo arm": """<mujoco><compiler angle="degree" autolimits="true"/>
      <default><joint frictionloss="0.05" armature="0.028" range="-110 110"/></default>
      <worldbody><body name="base"><geom type="box" size="0.04 0.04 0.03"/>
      <body name="shoulder" pos="0.02 0 0.05" euler="0 90 30"><joint name="pan" axis="0 0 1"/>
        <geom type="capsule" fromto="0 0 0 0.1 0.02 0" size="0.02" density="1200"/>
      <body name="upper" pos="0.1 0.02 0" euler="10 -20 5"><joint name="lift" axis="0 1 0"/>
        <geom type="cylinder" fromto="0 0 0 0 0 0.12" size="0.015"/><geom type="sphere" size="0.02" pos="0 0.03 0.1"/>
      </body></body></body></worldbody></mujoco>""",
    # several joints on one body, none of them at its origin
    "ball by three hinges": f"""<mujoco><compiler angle="radian"/><worldbody>
<body name="upper_arm" pos="0 0 1"><joint name="x" axis="1 0 0" pos="0 0 0.02"/>
<joint name="y" axis="0 1 0" pos="0.03 0 0.02"/><joint name="z" axis="0 0.6 0.8" pos="0 0.05 0"/>
{INERTIAL.format(1.5, -0.2)}<body name="forearm" pos="0 0 -0.4"><joint name="elbow" axis="1 1 0" pos="0 0 0.1"/>
{INERTIAL.format(0.8, -0.1)}</body></body></worldbody></mujoco>""",
    # coordinates that are not zero in the drawn pose, a rail and full inertias
    "rail with references": """<mujoco><compiler angle="radian" autolimits="true"/><worldbody>
<body name="cart" pos="0.1 0.2 0.3" quat="0.7 0.1 0.2 0.3"><joint name="rail" type="slide" axis="1 0 0" ref="0.25"/>
<inertial mass="3" pos="0 0.1 0" fullinertia="0.03 0.04 0.05 0.001 -0.002 0.003"/>
<body name="pole" pos="0 0 0.1"><joint name="swing" axis="0 1 1" ref="0.7" stiffness="3"/>
<inertial mass="1" pos="0 0.1 0.3" fullinertia="0.03 0.04 0.05 0.001 -0.002 0.003"/></body>
</body></worldbody></mujoco>""",
    # two arms on one torso, a welded tool, a body without a name
    "two arms": f"""<mujoco><compiler angle="radian"/><worldbody><body name="torso" pos="0 0 1">{INERTIAL.format(9, 0)}
<joint name="waist" axis="0 0 1"/>
<body name="left" pos="0 0.2 0.3" euler="0.3 0 0"><joint name="left_joint" axis="0 1 0"/>{INERTIAL.format(2, 0.2)}
<body pos="0 0 0.4">{INERTIAL.format(0.5, 0.05)}</body></body>
<body name="right" pos="0 -0.2 0.3" euler="-0.3 0 0"><joint name="right_joint" axis="0 1 0"/>{INERTIAL.format(2, 0.2)}
<body name="tool" pos="0 0 0.4">{INERTIAL.format(0.5, 0.05)}</body></body>
</body></worldbody><equality><weld body1="tool" body2="world" active="false"/></equality></mujoco>""",
}


def dynamics(mechanism: Mechanism, gravity: np.ndarray) -> ca.Function:
    q, v = (ca.SX.sym(name, len(mechanism.joints)) for name in "qv")
    kinematics = forward_kinematics(mechanism, q)
    rigid = lagrangian_first_derivatives(kinematics, v, ca.SX(ca.DM(gravity)))
    bias = lagrangian_second_derivatives(rigid, mechanism)[1].T @ v - rigid.lagrangian_by_q
    places = [kinematics.frame_pose(name).homogeneous_matrix() for name in mechanism.frames]
    return ca.Function("dynamics", [q, v], [mass_matrix(rigid, mechanism), bias, *places])


@pytest.mark.parametrize("name", MODELS)
def test_mass_matrix_bias_and_frames_are_those_of_mujoco(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mechanism_module, "_SNAP_TOLERANCE", 0.0)
    file = tmp_path / "robot.xml"
    file.write_text(MODELS[name])
    mechanism, model = read_urdf(file).with_numeric_values(), mujoco.MjModel.from_xml_path(str(file))
    data, own = mujoco.MjData(model), dynamics(mechanism, np.array(model.opt.gravity))
    at = [model.joint(joint).dofadr[0] for joint in mechanism.joint_names]
    assert len(at) == model.nv - ("gripper" in name)
    rng = np.random.default_rng(0)
    for _ in range(3):
        q, v = rng.uniform(-1, 1, len(at)), rng.normal(size=len(at))
        data.qpos[:], data.qvel[:] = 0, 0
        data.qpos[at], data.qvel[at] = q, v
        mujoco.mj_forward(model, data)
        whole = np.zeros((model.nv, model.nv))
        for row, unit in zip(whole, np.eye(model.nv), strict=True):
            mujoco.mj_mulM(model, data, row, unit)
        rotors = np.diag(model.dof_armature)[np.ix_(at, at)]
        mass, bias, *poses = map(np.array, own.call([q, v]))
        np.testing.assert_allclose(mass + rotors, whole[np.ix_(at, at)], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(bias.ravel(), data.qfrc_bias[at], rtol=1e-9, atol=1e-9)
        for frame, pose in zip(mechanism.frames, poses, strict=True):
            if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, frame) > 0:
                np.testing.assert_allclose(pose[:3, 3], data.body(frame).xpos, atol=1e-9)
                np.testing.assert_allclose(pose[:3, :3].ravel(), data.body(frame).xmat, atol=1e-9)
            elif mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, frame) >= 0:
                np.testing.assert_allclose(pose[:3, 3], data.site(frame).xpos, atol=1e-9)


def test_what_is_left_out_is_said_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING)
    file = tmp_path / "robot.xml"
    cube = '<body name="cube"><freejoint/><geom size="0.1"/><site name="top"/></body></worldbody>'
    file.write_text(MODELS["arm with a gripper"].replace("</worldbody>", cube))
    mechanism = read_urdf(file)
    read_urdf(file)
    assert caplog.text.count("leaves out motors (1 in the file). Efforts count as torques") == 1
    assert "actuators other" not in caplog.text
    assert "equalities" not in caplog.text  # the second finger follows the first
    assert "finger2" not in mechanism.joint_names
    assert [joint.effort_limit for joint in mechanism.joints[:2]] == [87, 40]
    assert mechanism.joints[0].upper_limit == 2.5
    assert {"tcp", "cube", "top"}.intersection(mechanism.frames) == {"tcp"}
    assert "leaves out bodies of free objects (1 in the file)" in caplog.text
    assert read_urdf(file, joints=["joint1", "joint2"]).joint_names == ("joint1", "joint2")
    file.write_text(MODELS["rail with references"])
    read_urdf(file)
    assert "springs of joints (1 in the file). To add them to efforts, set model.joint_springs" in caplog.text


GRIPPER = """<body name="gripper" {at}>{free}<site name="palm" pos="0 0.02 0.01"/>
  <inertial mass="0.8" pos="0 0.01 0.05" diaginertia="0.001 0.002 0.003"/>
  <body name="finger" pos="0 0 0.1"><joint name="slide" type="slide" axis="0 1 0"/>
    <inertial mass="0.1" pos="0 0 0.02" diaginertia="1e-4 1e-4 1e-4"/></body></body>"""


@pytest.mark.parametrize(
    "weld",
    [
        '<weld body1="link2" body2="gripper" relpose="0.1 0 0.05 0.8 0.6 0 0"/>',
        '<weld body1="gripper" body2="link2"/>',
        '<weld site1="flange" site2="palm"/>',
    ],
    ids=["stated", "as drawn", "by sites"],
)
def test_a_free_gripper_that_is_welded_to_the_arm_is_a_part_of_it(weld: str, tmp_path: Path) -> None:
    """As if it were drawn as the arm's own body, whose mass matrix and bias are MuJoCo's (above)."""
    site = '<site name="flange" pos="0 0.01 0.1" quat="1 0 0.5 0"/>'
    drawn = GRIPPER.format(at='pos="0.3 0.1 0.2" quat="1 0.2 0 0"', free="<freejoint/>")
    file, made = tmp_path / "welded.xml", tmp_path / "one.xml"
    file.write_text(f"<mujoco><worldbody>{drawn}{arm(2, site)}</worldbody><equality>{weld}</equality></mujoco>")
    model = mujoco.MjModel.from_xml_path(str(file))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    turn, place = data.body("link2").xmat.reshape(3, 3), data.body("link2").xpos
    if "relpose" in weld:
        at = 'pos="0.1 0 0.05" quat="0.8 0.6 0 0"'
    else:
        palm = data.site("palm").xmat.reshape(3, 3), data.site("palm").xpos
        flange = data.site("flange").xmat.reshape(3, 3), data.site("flange").xpos
        own, origin = data.body("gripper").xmat.reshape(3, 3), data.body("gripper").xpos
        if "site1" in weld:  # the two sites meet
            own, origin = flange[0] @ palm[0].T @ own, flange[1] + flange[0] @ palm[0].T @ (origin - palm[1])
        quat = np.roll(Rotation.from_matrix(turn.T @ own).as_quat(), 1)
        numbers = (" ".join(map(str, values.tolist())) for values in (turn.T @ (origin - place), quat))
        at = 'pos="{}" quat="{}"'.format(*numbers)
    whole = GRIPPER.format(at=at, free="")
    made.write_text(f"<mujoco><worldbody>{arm(2, site + whole)}</worldbody></mujoco>")
    one, other = (read_urdf(path).with_numeric_values() for path in (file, made))
    assert sorted(one.joint_names) == sorted(other.joint_names) == ["joint1", "joint2", "slide"]
    rng, gravity = np.random.default_rng(1), np.array([0.0, 0.0, -9.81])
    values = {name: rng.normal(size=2) for name in other.joint_names}
    found = []
    for tree in (one, other):
        q, v = np.array([values[name] for name in tree.joint_names]).T
        mass, bias, *_ = map(np.array, dynamics(tree, gravity).call([q, v]))
        order = np.argsort(tree.joint_names)
        found.append((mass[np.ix_(order, order)], bias.ravel()[order]))
    for first, second in zip(*found, strict=True):
        np.testing.assert_allclose(first, second, rtol=1e-9, atol=1e-9)


def test_constants_of_joints_come_into_the_model_unless_the_settings_have_others(tmp_path: Path) -> None:
    (tmp_path / "robot.xml").write_text(MODELS["arm with a gripper"])
    (tmp_path / "servo.xml").write_text(MODELS["servo arm"])

    def values(robot: str, arms: str, more: str = "") -> dict[str, float]:
        (tmp_path / "run.yaml").write_text(f"model:\n  robot: {robot}\n  arms: {arms}\n{more}")
        return {entry.name: entry.value for entry in build_system(load_config(tmp_path / "run.yaml")).parameters}

    found = values("robot.xml", "{joints: [joint1, joint2], mode: servo}")
    assert found["rotor_inertia@joint1.armature"] == 0.1
    assert (found["joint1.damping"], joint_damping_and_friction(tmp_path / "robot.xml")[0]["joint2"]) == (1.0, 1.0)
    assert (found["joint1.servo_gain"], found["joint1.servo_damping"]) == (100.0, 10.0)
    more = "  damping: {pan: 0.3, lift: 0.2}\n  friction: {law: presliding, joints: [lift]}\n"
    found = values("servo.xml", "{joints: [pan, lift], mode: prescribed}", more)
    assert (found["joint_coulomb@pan.tau_c"], found["rotor_inertia@lift.armature"]) == (0.05, 0.028)
    assert (found["pan.damping"], "joint_coulomb@lift.tau_c" in found) == (0.3, False), "a law replaces dry friction"
    more = "  effects:\n    - {kind: rotor_inertia, location: pan}\n"
    more += "    - {kind: rotor_inertia, location: lift, values: {armature: 0.5}}\n"
    more += "parameters:\n  joint_coulomb@pan.tau_c: {initial: 0.2}\n"
    found = values("servo.xml", "{joints: [pan, lift], mode: prescribed}", more)
    assert (found["rotor_inertia@pan.armature"], found["rotor_inertia@lift.armature"]) == (0.028, 0.5)
    assert found["joint_coulomb@pan.tau_c"] == 0.2
    (tmp_path / "servo.mjcf").write_text(MODELS["servo arm"].replace('name="pan" ', ""))
    found = values("servo.mjcf", "{joints: [shoulder_joint, lift], mode: prescribed}")
    assert found["rotor_inertia@shoulder_joint.armature"] == 0.028


def test_bad_files_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "robot.xml"
    file.write_text("<mujoco><worldbody><body><joint type='ball'/><geom size='1'/></body></worldbody></mujoco>")
    with pytest.raises(ModelError, match="has the type ball"):
        read_urdf(file)
    file.write_text("<mujoco><worldbody><body><geom type='mesh' mesh='none'/></body></worldbody></mujoco>")
    with pytest.raises(ModelError, match="MuJoCo cannot read the file"):
        read_urdf(file)
