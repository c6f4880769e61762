"""What a new user has: a bag of an arm that moves a flexible object, from MuJoCo, its chain finer than any model's."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from yid_ocp.config.reader import load_config
from yid_ocp.data.recording import PointGroup, Recording
from yid_ocp.virtual.experiment import ArmSensorNoise, PointCamera, VirtualExperiment, run_virtual_experiment
from yid_ocp.virtual.joint_motion import MultisineOptions, random_multisine
from yid_ocp.virtual.mujoco_simulation import SimulationOptions
from yid_ocp.workflow.build import build_system

START = 1_700_000_000 * 10**9
QUARTER = 1.5707963
CURVED = "stiffness_per_curvature: true, clamped_at_base: true"

UR5 = """\
model:
  robot: package:ur5
  arms: {{mode: driven}}
  object:
    kind: segments
    mount: {{parent_frame: tool0}}
    segments:
      cable: {{length: 1.0, mass: 0.1, radius: 0.005, links: {links}, joint_axes: xy, {curved}}}
  damping: {{shoulder_pan_joint: 0.1, object: 5.0e-4}}
  points: [w_cable, "cable:50%"]
parameters: {{cable.bend: {{initial: 0.03}}}}
"""
UR5_POSTURE = {
    "shoulder_pan_joint": 0.3, "shoulder_lift_joint": -1.2, "elbow_joint": 1.6, "wrist_1_joint": -1.9708,
    "wrist_2_joint": -1.5708, "wrist_3_joint": 0.0,
}  # fmt: skip
UR5_POINTS = {"w_cable": "tip", "cable:50%": "middle"}
UR5_TRUTH = {"cable.bend": 0.03, "cable.damping": 5e-4}

PANDA = """\
model:
  robot: package:panda
  arms:
    mode: driven
    joints: [panda_joint1, panda_joint2, panda_joint3, panda_joint4, panda_joint5, panda_joint6, panda_joint7]
    exclude_links: [panda_hand]
  object:
    kind: segments
    mount: {{parent_frame: panda_link8}}
    segments:
{branches}
  damping: {{panda_joint1: 0.1, object: 2.0e-3}}
  points: [w_b1, w_b2, w_b3, w_b4]
parameters: {{{parameters}}}
"""
PANDA_POSTURE = dict(zip((f"panda_joint{i}" for i in range(1, 8)), (0.0, -0.4, 0.0, -2.0, 0.0, 1.6, 0.8), strict=True))
PANDA_BENDS = {"b1": 0.10, "b2": 0.15, "b3": 0.20, "b4": 0.25}
PANDA_POINTS = {f"w_b{i}": f"marker_{i}" for i in range(1, 5)}
PANDA_TRUTH = {f"{name}.bend": value for name, value in PANDA_BENDS.items()}


SERVO = """\
model:
  robot: default:servo_arm.urdf
  arms: {{mode: servo}}
  object:
    kind: segments
    mount: {{parent_frame: gripper}}
    segments:
      rod: {{length: 0.4, mass: 0.04, radius: 0.003, links: {links}, joint_axes: xy, {curved}}}
  damping: {{pan: 0.05, object: 4.0e-4}}
  points: [w_rod, "rod:50%"]
  effects: [{effects}]
parameters:
  rod.bend: {{initial: 0.03}}
  "*.servo_gain": {{initial: 45.0}}
  "*.servo_damping": {{initial: 2.0}}
  "*.servo_delay": {{initial: 0.03}}
"""
SERVO_POSTURE = {"pan": 0.0, "lift": 0.4, "elbow": 1.0, "wrist_flex": 0.3, "wrist_roll": 0.0}
SERVO_POINTS = {"w_rod": "tip", "rod:50%": "middle"}
SERVO_TRUTH = {"cable.bend": 0.03, "cable.damping": 4e-4}
SERVOS = {
    f"{joint}.servo_{name}": value
    for joint in ("lift", "elbow", "wrist_flex")
    for name, value in {"gain": 45.0, "damping": 2.0, "delay": 0.03}.items()
}


def servo_text(links: int = 12) -> str:
    rotors = (f"{{kind: rotor_inertia, location: {joint}, values: {{armature: 0.01}}}}" for joint in SERVO_POSTURE)
    return SERVO.format(links=links, curved=CURVED, effects=", ".join(rotors))


def ur5_text(links: int = 16) -> str:
    return UR5.format(links=links, curved=CURVED)


def panda_text(links: int = 10) -> str:
    shape = f"length: 0.4, mass: 0.03, radius: 0.004, links: {links}, joint_axes: xy, {CURVED}"
    turns = [f"rpy: [0.0, {QUARTER}, {round(QUARTER * i, 7)}]" for i in range(4)]
    branches = [f"      {name}: {{{shape}, {turn}}}" for name, turn in zip(PANDA_BENDS, turns, strict=True)]
    parameters = ", ".join(f"{name}.bend: {{initial: {value}}}" for name, value in PANDA_BENDS.items())
    return PANDA.format(branches="\n".join(branches), parameters=parameters)


def simulated(
    folder: Path,
    text: str,
    posture: Mapping[str, float],
    points: Mapping[str, str],
    seed: int,
    duration: float,
    excitation: MultisineOptions | None = None,
) -> Recording:
    """Joints at 100 Hz without efforts, points at 50 Hz to half a millimetre under names of their own."""
    file = folder / "truth.yaml"
    file.write_text(text)
    system = build_system(load_config(file))
    excitation = excitation or MultisineOptions(max_joint_speed=1.0, duration=duration, frequency_band=(0.3, 1.5))
    experiment = VirtualExperiment(
        motion=random_multisine(system, None, seed=seed, initial_joint_angles=posture, excitation=excitation),
        initial_joint_angles=posture,
        simulation=SimulationOptions(duration, time_step=2e-4),
        arm_noise=ArmSensorNoise(position_std=1e-4),
        camera=PointCamera(point_std=5e-4, frame_rate=50.0, has_dropouts=False, hidden_probability=0.0, pose=np.eye(4)),
        seed=seed,
    )
    made = run_virtual_experiment(system, None, experiment)
    [seen] = made.points
    names = tuple(points[name] for name in seen.names)
    return Recording(made.joints, (PointGroup("points", names, seen.t, seen.position, None, "mocap"),), name="run")


def write_mcap(recording: Recording, folder: Path) -> Path:
    """A bag with the joints on one topic, their commands on another, every point on its own, and one nobody needs."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    types: Any = store.types
    joints = recording.joints
    assert joints is not None

    def header(t: float, frame: str) -> Any:
        stamp = types["builtin_interfaces/msg/Time"](*divmod(START + round(1e9 * t), 10**9))
        return types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame)

    messages: list[tuple[float, str, str, Any]] = []
    none = np.zeros(0)
    for t, row in zip(joints.t, joints.position, strict=True):
        state = types["sensor_msgs/msg/JointState"](header(t, ""), list(joints.names), row, none, none)
        messages.append((t, "/joint_states", "sensor_msgs/msg/JointState", state))
    commands = () if joints.position_command is None else joints.position_command
    for t, row in zip(joints.t, commands, strict=False):
        asked = types["sensor_msgs/msg/JointState"](header(t, ""), list(joints.names), row, none, none)
        messages.append((t, "/joint_commands", "sensor_msgs/msg/JointState", asked))
    for group in recording.points:
        for t, row in zip(group.t, group.position, strict=True):
            for name, place in zip(group.names, row, strict=True):
                point = types["geometry_msgs/msg/PointStamped"](
                    header(t, "world"), types["geometry_msgs/msg/Point"](*place)
                )
                messages.append((t, f"/mocap/{name}", "geometry_msgs/msg/PointStamped", point))
    messages.append((0.0, "/note", "std_msgs/msg/String", types["std_msgs/msg/String"]("hello")))
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connections: dict[str, Any] = {}
        for t, topic, kind, message in sorted(messages, key=lambda entry: entry[0]):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(connections[topic], START + round(1e9 * t), store.serialize_cdr(message, kind))
    return folder / f"{folder.name}.mcap"
