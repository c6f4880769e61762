"""Joint values of bags whose messages bring their own definitions: Franka's, ros2_control's, and any by its fields."""

import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recording_examples import joints_of, refused
from ros_bags import SECOND, START, Bag

from yid_ocp.data import read_recording
from yid_ocp.data.readers import preview_file, read_any

DEFINITIONS = {
    "franka_msgs/msg/FrankaState": (
        "std_msgs/Header header\nfloat64[7] q\nfloat64[7] dq\nfloat64[7] q_d\nfloat64[7] tau_J\n"
        "float64[7] tau_ext_hat_filtered\nfloat64[6] O_F_ext_hat_K\nfloat64[6] K_F_ext_hat_K"
    ),
    "franka_msgs/msg/FrankaRobotState": (
        "std_msgs/Header header\nsensor_msgs/JointState measured_joint_state\n"
        "sensor_msgs/JointState desired_joint_state\nsensor_msgs/JointState tau_ext_hat_filtered\n"
        "geometry_msgs/WrenchStamped k_f_ext_hat_k"
    ),
    "ur_msgs/msg/RobotStateRTMsg": (
        "float64 time\nfloat64[] q_target\nfloat64[] m_target\nfloat64[] q_actual\nfloat64[] qd_actual\n"
        "float64[] i_actual"
    ),
    "control_msgs/msg/InterfaceValue": "string[] interface_names\nfloat64[] values",
    "control_msgs/msg/DynamicJointState": (
        "std_msgs/Header header\nstring[] joint_names\ncontrol_msgs/InterfaceValue[] interface_values"
    ),
    "control_msgs/msg/JointTrajectoryControllerState": (
        "std_msgs/Header header\nstring[] joint_names\ntrajectory_msgs/JointTrajectoryPoint desired\n"
        "trajectory_msgs/JointTrajectoryPoint actual\ntrajectory_msgs/JointTrajectoryPoint error"
    ),
    "lab_msgs/msg/Inner": "float64[] q\nfloat64[] torque\nstring label",
    "lab_msgs/msg/Arm": "lab_msgs/Inner state\nfloat64 temperature",
}
ANGLES = np.arange(7.0)
JOINTS = [f"panda_joint{i}" for i in range(1, 8)]


def state(bag: Bag, names: Any, position: Any = (), velocity: Any = (), effort: Any = ()) -> Any:
    own = {"position": np.array(position), "velocity": np.array(velocity), "effort": np.array(effort)}
    return bag.of("sensor_msgs/msg/JointState", bag.header(0), list(names), **own)


def fields_of(bag: Bag, kind: str, k: int) -> dict[str, Any]:
    """Angles 0.01 k + joint, speeds 2, torques 3, external 4, commands 0.5 more than the angles; of seven joints."""
    q, one, header = 0.01 * k + 0.1 * ANGLES, np.ones(7), bag.header(START + k * SECOND // 100)
    if kind == "franka_msgs/msg/FrankaState":
        own = {"q": q, "dq": 2 * one, "q_d": q + 0.5, "tau_J": 3 * one, "tau_ext_hat_filtered": 4 * one}
        return {"header": header, **own, "O_F_ext_hat_K": np.zeros(6), "K_F_ext_hat_K": np.arange(6.0) + k}
    if kind == "ur_msgs/msg/RobotStateRTMsg":
        own = {"q_target": q[:6] + 0.5, "m_target": one[:6], "q_actual": q[:6], "qd_actual": 2 * one[:6]}
        return {"time": 0.01 * k, **own, "i_actual": one[:6]}
    if kind == "franka_msgs/msg/FrankaRobotState":
        measured, wanted = state(bag, JOINTS, q, 2 * one, 3 * one), state(bag, JOINTS, q + 0.5)
        external = state(bag, JOINTS, (), (), 4 * one)
        vectors = (bag.of("geometry_msgs/msg/Vector3", *(np.arange(3.0) + 3 * i + k)) for i in range(2))
        wrench = bag.of("geometry_msgs/msg/Wrench", *vectors)
        stamped = bag.of("geometry_msgs/msg/WrenchStamped", bag.header(0, "panda_hand_tcp"), wrench)
        own = {"measured_joint_state": measured, "desired_joint_state": wanted, "tau_ext_hat_filtered": external}
        own["k_f_ext_hat_k"] = stamped
        return {"header": header, **own}
    if kind == "control_msgs/msg/DynamicJointState":
        values = [
            bag.of("control_msgs/msg/InterfaceValue", ["effort", "position", "velocity"], np.array([3.0, x, 2.0]))
            for x in q
        ]
        values.append(bag.of("control_msgs/msg/InterfaceValue", ["force"], np.array([1.0])))
        return {"header": header, "joint_names": [*JOINTS, "sensor"], "interface_values": values}
    if kind == "lab_msgs/msg/Arm":
        return {"state": bag.of("lab_msgs/msg/Inner", q, 3 * one, "x"), "temperature": 20.0}
    duration = bag.of("builtin_interfaces/msg/Duration", 0, 0)
    point = "trajectory_msgs/msg/JointTrajectoryPoint"
    actual, desired, error = (
        bag.of(point, x, v, np.zeros(0), e, duration)
        for x, v, e in ((q, 2 * one, 3 * one), (q + 0.5, 0 * one, np.zeros(0)), (q, q, np.zeros(0)))
    )
    return {"header": header, "joint_names": JOINTS, "desired": desired, "actual": actual, "error": error}


def write(folder: Path, kind: str, storage: str = "mcap", beside: bool = False) -> Path:
    with Bag(folder, storage) as bag:
        from rosbags.typesys import get_types_from_msg

        for name, text in DEFINITIONS.items():
            bag.store.register(get_types_from_msg(text, name))
        for k in range(30):
            bag.put("/arm", kind, START + k * SECOND // 100, **fields_of(bag, kind, k))
            if beside:
                message = state(bag, ["a"], [0.1 * k])
                message.header.stamp.sec, message.header.stamp.nanosec = divmod(START + k * SECOND // 100, SECOND)
                own = {name: getattr(message, name) for name in ("header", "name", "position", "velocity", "effort")}
                bag.put("/joint_states", "sensor_msgs/msg/JointState", START + k * SECOND // 100, **own)
    return bag.path


CONTROL = ("control_msgs/msg/DynamicJointState", "control_msgs/msg/JointTrajectoryControllerState")
CASES = [
    ("franka_msgs/msg/FrankaState", "bag", {"external_effort": 4.0}, 0.5),
    ("franka_msgs/msg/FrankaRobotState", "mcap", {"external_effort": 4.0}, 0.5),
    (CONTROL[0], "mcap", {}, None),
    (CONTROL[1], "mcap", {}, 0.5),
]


@pytest.mark.parametrize(("kind", "storage", "more", "command"), CASES, ids=[case[0].split("/")[2] for case in CASES])
def test_joints_of_messages_of_real_labs(
    kind: str, storage: str, more: dict[str, float], command: float | None, tmp_path: Path
) -> None:
    path = write(tmp_path, kind, storage)
    joints = joints_of(read_any(path))
    assert joints.names == tuple(JOINTS)
    assert joints.t == pytest.approx(0.01 * np.arange(30))
    assert np.allclose(joints.position, 0.01 * np.arange(30)[:, None] + 0.1 * ANGLES)
    for channel, value in {"velocity": 2.0, "effort": 3.0, **more}.items():
        assert np.all(joints.values_by_channel[channel] == value)
    if command is not None:
        assert np.allclose(joints.position_command, joints.position + command)
    assert preview_file(path).sources[0].imported_as == f"joints {', '.join(JOINTS)}"


@pytest.mark.parametrize(
    ("kind", "storage", "frame"),
    [("franka_msgs/msg/FrankaState", "bag", "K"), ("franka_msgs/msg/FrankaRobotState", "mcap", "panda_hand_tcp")],
)
def test_the_wrench_that_a_driver_estimates_is_a_group_that_says_so(
    kind: str, storage: str, frame: str, tmp_path: Path
) -> None:
    recording = read_any(write(tmp_path, kind, storage))
    [group] = recording.channel_groups
    assert (group.name, group.names) == ("wrist_estimated", (frame,))
    wanted = np.arange(30.0)[:, None] + np.arange(3.0)
    assert np.array_equal(group.values_by_quantity["force"][:, 0], wanted)
    assert np.array_equal(group.values_by_quantity["torque"][:, 0], wanted + 3)
    assert any("Use it in place of the efforts" in note for note in recording.notes)


def test_the_state_of_a_ur_becomes_joints_of_its_usual_names(tmp_path: Path) -> None:
    joints = joints_of(read_any(write(tmp_path, "ur_msgs/msg/RobotStateRTMsg", "bag")))
    assert joints.names[0] == "shoulder_pan_joint"
    assert len(joints.names) == 6
    assert np.allclose(joints.position, 0.01 * np.arange(30)[:, None] + 0.1 * ANGLES[:6])
    assert np.allclose(joints.position_command, joints.position + 0.5)
    assert joints.effort is None


def test_joint_states_go_before_them_unless_they_are_chosen(tmp_path: Path) -> None:
    path = write(tmp_path, CONTROL[0], beside=True)
    assert joints_of(read_any(path)).names == ("a",)
    assert {source.name: source.imported_as for source in preview_file(path).sources}["/arm"] == ""
    assert joints_of(read_any(path, joint_topics=["/arm"])).names == tuple(JOINTS)


def test_fields_of_any_message_become_joints_and_no_command_is_suggested_without(tmp_path, monkeypatch, printed):
    monkeypatch.chdir(tmp_path)
    path = write(tmp_path, "lab_msgs/msg/Arm")
    told = printed("import", path, "--preview")
    assert "needs more information" in told
    assert "--field position=" in told
    assert "\n  yid-ocp import" not in told
    fields = ("position=/arm.state.q", "effort=/arm.state.torque")
    words = [*(word for field in fields for word in ("--field", field)), "--joints", "1=shoulder,2=elbow"]
    *_, said = printed("import", path, "--preview", *words).strip().splitlines()
    printed(*shlex.split(said)[1:])
    joints = joints_of(read_recording(tmp_path / f"{path.stem}.h5"))
    assert joints.names == ("shoulder", "elbow")
    assert np.allclose(joints.position[:, 1], 0.01 * np.arange(30) + 0.1)
    assert np.all(joints.values_by_channel["effort"] == 3.0)
    for fields, what in (
        ({"position": "/arm.state.p"}, "no field 'state.p'"),
        ({"position": "/arm.state.label"}, "is not numeric"),
        ({"position": "/hand.q"}, "no messages on the topic '/hand'"),
        ({"position": "/arm"}, "'position=/arm' names a topic, but no field"),
        ({"effort": "/arm.state.torque"}, "the channel position has no field"),
        ({"position": "/arm.state.q", "effect": "/arm.state.torque"}, "no joint channel 'effect'"),
    ):
        refused(path, what, message_fields=fields)
