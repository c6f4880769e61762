from __future__ import annotations

import contextlib
import math
import sqlite3
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from heard import Heard
from recording_examples import joints_of, refused
from ros_bags import BAG_KINDS, SECOND, START, Bag

from yid_ocp.data.readers import preview_file, read_any
from yid_ocp.data.readers.bags import OpenBag
from yid_ocp.data.recording_hdf5 import write_recording
from yid_ocp.errors import DataError

NO_ROSBAGS = "bags need rosbags: pip install '.[bags]'"
BOOL, STRING = "std_msgs/msg/Bool", "std_msgs/msg/String"
QUARTER = (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5))
"""A quarter turn about z, as (x, y, z, w)."""
Message = tuple[str, Callable[[Bag], dict[str, Any]]]
"""Type of a message, and its fields in a bag."""


def geometry(bag: Bag, kind: str, values: Sequence[float]) -> Any:
    return bag.of(f"geometry_msgs/msg/{kind}", *map(float, values))


def joint_state(names: Sequence[str], stamp: int, **channels: Sequence[float]) -> Message:
    arrays = {c: np.array(channels.get(c, []), dtype=float) for c in ("position", "velocity", "effort")}
    return "sensor_msgs/msg/JointState", lambda bag: {"header": bag.header(stamp), "name": list(names), **arrays}


def point(stamp: int, xyz: Sequence[float], frame: str = "camera_link") -> Message:
    def fields(bag: Bag) -> dict[str, Any]:
        return {"header": bag.header(stamp, frame), "point": geometry(bag, "Point", xyz)}

    return "geometry_msgs/msg/PointStamped", fields


def pose(stamp: int, xyz: Sequence[float]) -> Message:
    def fields(bag: Bag) -> dict[str, Any]:
        place = geometry(bag, "Point", xyz), geometry(bag, "Quaternion", QUARTER)
        return {"header": bag.header(stamp, "map"), "pose": bag.of("geometry_msgs/msg/Pose", *place)}

    return "geometry_msgs/msg/PoseStamped", fields


def frame(stamp: int, child: str, xyz: Sequence[float]) -> Message:
    def fields(bag: Bag) -> dict[str, Any]:
        place = geometry(bag, "Vector3", xyz), geometry(bag, "Quaternion", QUARTER)
        made = bag.header(stamp, "map"), child, bag.of("geometry_msgs/msg/Transform", *place)
        return {"transforms": [bag.of("geometry_msgs/msg/TransformStamped", *made)]}

    return "tf2_msgs/msg/TFMessage", fields


def poses(stamp: int, *points: Sequence[float]) -> Message:
    def fields(bag: Bag) -> dict[str, Any]:
        turn = geometry(bag, "Quaternion", QUARTER)
        made = [bag.of("geometry_msgs/msg/Pose", geometry(bag, "Point", xyz), turn) for xyz in points]
        return {"header": bag.header(stamp, "map"), "poses": made}

    return "geometry_msgs/msg/PoseArray", fields


def plain(data: Any = "x", kind: str = STRING) -> Message:
    return kind, lambda bag: {"data": data}


Messages = Sequence[tuple[str, int, Message]]


def write_bag(folder: Path, kind: str, messages: Messages) -> Path:
    """Write (topic, time of recording, message) triples as one of `BAG_KINDS`."""
    with Bag(folder, kind) as bag:
        for topic, logged, (msgtype, fields) in messages:
            bag.put(topic, msgtype, logged, **fields(bag))
    return bag.path


def arm_and_camera() -> Messages:
    messages: list[tuple[str, int, Message]] = []
    for k in range(5):
        stamp = START + k * SECOND // 100
        values = {"position": [0.1 * k, 0.2 * k], "velocity": [1.0, 2.0], "effort": [math.nan, math.nan]}
        messages += 2 * [("/joint_states", stamp + 1000, joint_state(("a", "b"), stamp, **values))]
    for k, topic in enumerate(("/seen/w_T1", "/seen/w_T2", "/seen/w_T1")):
        stamp = START + (k // 2) * SECOND // 50 + SECOND // 200
        messages += 2 * [(topic, stamp + 1000, point(stamp, (0.1 * k, 0.0, 1.0)))]
    messages.append(("/note", START, plain("hello")))
    return messages


@pytest.mark.parametrize("kind", BAG_KINDS)
def test_bag_round_trip(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, heard = write_bag(tmp_path, kind, arm_and_camera()), Heard()
    monkeypatch.setattr("yid_ocp.data.readers.bags._PROGRESS_INTERVAL", 3)
    recording = read_any(path, point_sensor_name="camera", progress=heard)
    assert heard.parts == [(done, 16, "messages") for done in range(0, 16, 3)]
    joints = joints_of(recording)
    assert joints.names == ("a", "b")
    assert np.allclose(joints.t, 0.01 * np.arange(5), rtol=0, atol=1e-12)
    assert np.allclose(joints.position, np.outer(np.arange(5), [0.1, 0.2]))
    assert list(joints.values_by_channel) == ["position", "velocity"]
    (points,) = recording.points
    assert (points.name, points.names) == ("points", ("w_T1", "w_T2"))
    assert (points.frame, points.sensor_name, points.clock) == ("camera_link", "camera", "recorded")
    assert np.allclose(points.t, [0.005, 0.025])
    assert np.allclose(points.position, [[[0.0, 0, 1], [0.1, 0, 1]], [[0.2, 0, 1], [np.nan] * 3]], equal_nan=True)
    assert recording.name == "run"
    assert recording.sha256 is not None
    write_recording(recording, tmp_path / "run.h5")
    assert read_any(tmp_path / "run.h5", progress=heard).point_names == ("w_T1", "w_T2")


def test_bag_order_and_sets_of_joints_may_change(tmp_path: Path) -> None:
    """Baxter's grippers come on the topic of its arms, in messages of their own."""
    arm = joint_state(("a", "b"), START, position=[1.0, 2.0])
    second = joint_state(("b", "a"), START + SECOND, position=[4.0, 3.0])
    path = write_bag(tmp_path, "bag", [("/joint_states", START, arm), ("/joint_states", START + SECOND, second)])
    assert np.array_equal(joints_of(read_any(path, joints=["a", "b"])).position, [[1, 2], [3, 4]])
    assert np.array_equal(np.sort(joints_of(read_any(path)).position), [[1, 2], [3, 4]])
    assert read_any(path, joints=["*=arm_*"]).joint_names == ("arm_a", "arm_b")
    gripper = joint_state(("finger",), START, position=[0.5])
    (tmp_path / "other").mkdir()
    path = write_bag(tmp_path / "other", "bag", [("/joint_states", START, arm), ("/joint_states", START, gripper)])
    assert "--joints" in refused(path, "2 different sets of joints").hint
    assert read_any(path, joints=["b"]).joint_names == ("b",)
    assert refused(path, "no joint 'fingr'", joints=["a", "fingr"]).hint == "did you mean 'finger'?"
    refused(path, "no message has all of a, finger", joints=["a", "finger"])


def two_arms(rate: int = 200, effort: bool = True) -> Messages:
    """Left at 100 Hz, right at `rate` Hz from 5 ms on, its angle a straight line in time."""
    messages: list[tuple[str, int, Message]] = []
    for k in range(20):
        stamp = START + k * SECOND // 100
        more = {"effort": [1.0]} if effort else {}
        messages.append(("/left", stamp, joint_state(("a",), stamp, position=[0.01 * k], **more)))
    for k in range(40):
        stamp = START + k * SECOND // rate + SECOND // 200
        values = {"position": [float(k) / rate], "effort": [2.0 * k]}
        messages.append(("/right", stamp, joint_state(("b",), stamp, **values)))
    return messages


def test_bag_with_several_joint_topics(tmp_path: Path) -> None:
    path = write_bag(tmp_path, "mcap", two_arms())
    recording = read_any(path)
    joints = joints_of(recording)
    assert joints.names == ("a", "b")
    # the faster topic is the clock, from where the slower one has samples on both sides
    assert joints.t[0] == pytest.approx(0.005)
    assert joints.t[-1] == pytest.approx(0.19)
    assert np.allclose(joints.position[:, 0], joints.t)  # 0.01 rad every 10 ms, interpolated
    assert np.allclose(joints.position[:, 1], joints.t - 0.005)
    assert np.array_equal(joints.values_by_channel["effort"][:, 1], 2.0 * np.arange(len(joints.t)))
    assert any("/left were interpolated to the times of /right" in note for note in recording.notes)
    alone = read_any(path, joint_topics=["/right"])
    assert alone.joint_names == ("b",)
    assert any(note.startswith("/left was left out") for note in alone.notes)
    assert refused(path, "on the topic '/rigth'", joint_topics=["/rigth"]).hint == "did you mean '/right'?"


def test_joint_topics_that_do_not_fit_together(tmp_path: Path) -> None:
    refused(write_bag(tmp_path, "mcap", two_arms(effort=False)), "/left has no effort, but another source has it")
    (tmp_path / "twice").mkdir()
    one = joint_state(("a",), START, position=[1.0])
    path = write_bag(tmp_path / "twice", "mcap", [("/x", START, one), ("/y", START, one)])
    assert "--joint-topic" in refused(path, "joint 'a' is in /x and in /y").hint


def test_a_gap_of_one_topic_stays_a_gap_and_commands_are_held_until_the_next(tmp_path: Path) -> None:
    lost = [m for m in two_arms() if m[0] != "/left" or not 5 <= round(100 * (m[1] - START) / SECOND) < 15]
    joints = joints_of(read_any(write_bag(tmp_path, "db3", lost)))
    assert not ((joints.t > 0.041) & (joints.t < 0.149)).any()
    assert np.allclose(joints.position[:, 0], joints.t)
    messages = list(two_arms())
    for k in range(4):
        stamp = START + (5 * k + 1) * SECOND // 100 + 1000
        messages.append(("/command", stamp, joint_state(("a",), stamp, position=[10.0 + k])))
    (tmp_path / "held").mkdir()
    path = write_bag(tmp_path / "held", "mcap", messages)
    joints = joints_of(read_any(path, joint_topics=["/left"], command_topic="/command"))
    wanted = [10.0] * 7 + [11.0] * 5 + [12.0] * 5 + [13.0] * 3
    assert np.array_equal(joints.values_by_channel["position_command"][:, 0], wanted)


def test_a_topic_called_command_is_no_measurement(tmp_path: Path) -> None:
    stamps = [START + k * SECOND // 100 for k in range(4)]
    messages = [("/joint_commands", t, joint_state(("a",), t, position=[5.0])) for t in stamps]
    messages += [("/joint_states", t, joint_state(("a",), t, position=[float(k)])) for k, t in enumerate(stamps)]
    path = write_bag(tmp_path, "mcap", messages)
    contents = preview_file(path)
    assert [source.imported_as for source in contents.sources] == ["commands a", "joints a"]
    assert contents.reader_options["command_topic"] == "/joint_commands"
    for options in ({}, contents.reader_options):
        joints = joints_of(read_any(path, **options))
        assert np.array_equal(joints.position[:, 0], np.arange(4))
        assert np.array_equal(joints.values_by_channel["position_command"][:, 0], [5.0] * 4)
    assert joints_of(read_any(path, joint_topics=["/joint_commands"])).position[0, 0] == 5.0
    path.write_bytes(path.read_bytes().replace(b"\x04\0\0\0ros2", b"\x04\0\0\0none", 1))
    refused(path, "does not have the profile ros2")


def twelve_topics() -> Messages:
    """Two arms, a point, a pose and a transform's frame, and seven topics that say nothing of joints or points."""
    messages = list(two_arms())
    for k in range(10):
        stamp = START + k * SECOND // 50 + SECOND // 200
        messages.append(("/mocap/tip", stamp, point(stamp, (1.0, 0.0, 0.1 * k), "map")))
        messages.append(("/vrpn/hand/pose", stamp, pose(stamp, (0.5, 0.0, 0.1 * k))))
        messages.append(("/tf", stamp, frame(stamp, "middle", (0.0, 0.7, 0.1 * k))))
        messages.append(("/gripper/closed", stamp, plain(True, BOOL)))
    messages += [(f"/log/{name}", START, plain()) for name in "abcdef"]
    return messages


def test_a_bag_of_twelve_topics(tmp_path: Path) -> None:
    path = write_bag(tmp_path, "mcap", twelve_topics())
    named = {"/mocap/tip": "cable:100%", "/vrpn/hand/pose": "hand", "/tf:middle": "cable:50%"}
    recording = read_any(path, point_names=named)
    assert recording.joint_names == ("a", "b")
    (points,) = recording.points
    assert (points.names, points.frame) == (("cable:100%", "cable:50%", "hand"), "map")
    assert np.allclose(points.position[3], [[1.0, 0.0, 0.3], [0.0, 0.7, 0.3], [0.5, 0.0, 0.3]])
    left = [note for note in recording.notes if "was left out (" in note]
    assert [note.split()[0] for note in left] == ["/gripper/closed", *(f"/log/{name}" for name in "abcdef")]
    assert "(10 of std_msgs/msg/Bool): its type is not known. For joint values, add --field position=/gri" in left[0]
    assert any("of /tf:middle, /vrpn/hand/pose, the orientations were not" in note for note in recording.notes)
    write_recording(recording, tmp_path / "all.h5")
    assert read_any(tmp_path / "all.h5").notes == recording.notes
    by_itself = read_any(path)
    assert by_itself.points[0].names == ("hand", "tip")
    assert any(note.startswith("/tf was left out") for note in by_itself.notes)


def wrench(stamp: int, force: float, frame: str = "/ft_link") -> Message:
    def fields(bag: Bag) -> dict[str, Any]:
        parts = [bag.of("geometry_msgs/msg/Vector3", size, 0.0, -size) for size in (force, 0.1 * force)]
        return {"header": bag.header(stamp, frame), "wrench": bag.of("geometry_msgs/msg/Wrench", *parts)}

    return "geometry_msgs/msg/WrenchStamped", fields


def inertial(stamp: int, turn: float, variance: float) -> Message:
    def fields(bag: Bag) -> dict[str, Any]:
        rate, push = (bag.of("geometry_msgs/msg/Vector3", *parts) for parts in ((turn, 0.0, 0.0), (0.0, 0.0, 9.81)))
        spread, unknown = variance * np.eye(3).ravel(), -np.eye(3).ravel()
        covariances = {"orientation_covariance": unknown, "linear_acceleration_covariance": unknown}
        covariances["angular_velocity_covariance"] = spread
        turned = bag.of("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0)
        values = {"orientation": turned, "angular_velocity": rate, "linear_acceleration": push}
        return {"header": bag.header(stamp, "camera_imu"), **values, **covariances}

    return "sensor_msgs/msg/Imu", fields


@pytest.mark.parametrize("kind", ["bag", "mcap"])
def test_wrenches_and_inertial_readings_become_groups_on_the_frames_of_their_headers(kind: str, tmp_path: Path) -> None:
    messages = [*arm_and_camera()]
    for k in range(4):
        stamp = START + k * SECOND // 200
        messages.append(("/left/wrench", stamp, wrench(stamp, 1.0 + k)))
        messages.append(("/right/wrench", stamp, wrench(stamp, -1.0, "")))
        messages.append(("/imu/data", stamp, inertial(stamp, 0.1 * k, 4e-4)))
    path = write_bag(tmp_path, kind, messages)
    recording = read_any(path)
    groups = {group.name: group for group in recording.channel_groups}
    assert {name: group.names for name, group in groups.items()} == {
        "wrist_left": ("ft_link",),
        "wrist_right": ("right",),
        "imu": ("camera_imu",),
    }
    assert groups["imu"].t == pytest.approx(0.005 * np.arange(4))
    own = groups["wrist_left"].values_by_quantity
    np.testing.assert_allclose(own["force"][:, 0], np.outer(1.0 + np.arange(4), [1, 0, -1]))
    np.testing.assert_allclose(own["torque"], 0.1 * own["force"])
    np.testing.assert_allclose(groups["imu"].values_by_quantity["angular_velocity"][:, 0, 0], 0.1 * np.arange(4))
    np.testing.assert_allclose(groups["imu"].values_by_quantity["specific_force"][:, 0], [[0, 0, 9.81]] * 4)
    assert groups["imu"].noise_and_bias_stds_by_attribute == {"angular_velocity_std": pytest.approx(0.02)}
    assert not any("wrench" in note or "imu" in note for note in recording.notes)
    said = {source.name: source.imported_as for source in preview_file(path).sources}
    assert (said["/left/wrench"], said["/imu/data"]) == ("wrist on /ft_link", "imu on camera_imu")


def test_the_preview_of_a_bag_proposes_what_imports_it(tmp_path: Path) -> None:
    path = write_bag(tmp_path, "mcap", twelve_topics())
    contents = preview_file(path)
    by_name = {source.name: source for source in contents.sources}
    assert len(by_name) == 12
    assert by_name["/left"].imported_as == "joints a"
    assert by_name["/left"].mean_rate == pytest.approx(100.0)
    assert by_name["/vrpn/hand/pose"].imported_as == "point hand"
    assert "middle. To use one, add --points /tf:FRAME" in by_name["/tf"].note
    assert sum(not source.imported_as for source in contents.sources) == 8
    assert "point_names" not in contents.reader_options
    recording = read_any(path, **contents.reader_options)
    assert (recording.joint_names, sorted(recording.point_names)) == (("a", "b"), ["hand", "tip"])


def test_a_preview_says_what_looks_like_degrees_and_millimetres(tmp_path: Path) -> None:
    messages = [("/j", START, joint_state(("a",), START, position=[170.0])), ("/p", START, point(START, (900.0, 0, 0)))]
    path = write_bag(tmp_path, "mcap", messages)
    contents = preview_file(path)
    assert contents.reader_options["units"] == {"position": "deg", "points": "mm"}
    recording = read_any(path, **contents.reader_options)
    assert joints_of(recording).position[0, 0] == pytest.approx(math.radians(170))
    assert recording.points[0].position[0, 0, 0] == pytest.approx(0.9)


def test_an_orientation_becomes_points_on_the_axes(tmp_path: Path) -> None:
    path = write_bag(tmp_path, "mcap", [("/hand/pose", START, pose(START, (1.0, 2.0, 3.0)))])
    (points,) = read_any(path, pose_axis_point_distance=0.1).points
    assert points.names == ("hand", "hand_x", "hand_y", "hand_z")
    # the quarter turn about z takes x to y and y to -x
    assert np.allclose(points.position[0], [[1, 2, 3], [1, 2.1, 3], [0.9, 2, 3], [1, 2, 3.1]])
    refused(path, "pose_axis_point_distance is 0 m", pose_axis_point_distance=0.0)


def test_the_poses_of_an_array_are_points_with_numbers(tmp_path: Path) -> None:
    """A number is no point if a pose is missing at times, unless the user says so."""
    times = [START + k * SECOND // 100 for k in range(4)]
    messages = [("/mocap/markers", t, poses(t, (1, 0, k), (2, 0, k))) for k, t in enumerate(times)]
    messages += [("/some", t, poses(t, *[(0, k, 0)] * (1 + k % 2))) for k, t in enumerate(times)]
    path = write_bag(tmp_path, "mcap", messages)
    contents = preview_file(path)
    assert [source.imported_as for source in contents.sources] == ["point markers_1, markers_2", ""]
    recording = read_any(path, **contents.reader_options)
    assert recording.points[0].names == ("markers_1", "markers_2")
    assert np.allclose(recording.points[0].position[3], [[1, 0, 3], [2, 0, 3]])
    assert "To use a point of them, add --points /some:NUMBER=POINT" in recording.notes[-1]
    (points,) = read_any(path, point_names={"/some:2": "tip"}).points
    assert (points.names, len(points.t)) == (("tip",), 2)


def test_joints_are_renamed_and_currents_become_torques(tmp_path: Path) -> None:
    path = write_bag(tmp_path, "mcap", two_arms())
    joints = joints_of(read_any(path, joints=["b=elbow", "a"]))
    assert set(joints.names) == {"elbow", "a"}
    assert np.allclose(joints.position[:, joints.names.index("elbow")], joints.t - 0.005)
    efforts = joints_of(read_any(path)).values_by_channel["effort"]
    options: dict[str, Any] = {"torque_constants": {"*": 0.1, "b": 0.2}, "gear_ratios": {"b": 50.0}}
    torques = joints_of(read_any(path, units={"effort": "mA"}, **options)).values_by_channel["effort"]
    assert np.allclose(torques, 1e-3 * efforts * [0.1, 0.2 * 50])
    current = "effort of 'a' is a current, but its torque constant is not given"
    refused(path, current, units={"effort": "A"}, torque_constants={"b": 1.0})
    refused(path, "unit of the efforts is not a unit of current", torque_constants={"*": 1.0})


@pytest.mark.parametrize("stamps", [(0, 0), (START - SECOND // 2, 0)])
def test_bag_without_stamps_uses_the_time_of_recording(stamps: tuple[int, int], tmp_path: Path) -> None:
    states = [joint_state(("a",), stamp, position=[1.0]) for stamp in stamps]
    path = write_bag(tmp_path, "mcap", [("/j", START + k * SECOND, state) for k, state in enumerate(states)])
    assert np.array_equal(joints_of(read_any(path)).t, [0.0, 1.0])
    assert f"{stamps.count(0)} of 2 messages have no stamp" in read_any(path).notes[-1]


def test_bag_without_definitions_of_its_messages(tmp_path: Path) -> None:
    path = write_bag(tmp_path, "db3", arm_and_camera())
    with contextlib.closing(sqlite3.connect(path)) as database, database:
        database.execute("DELETE FROM message_definitions")
    recording = read_any(path)
    assert recording.joint_names == ("a", "b")
    assert recording.point_names == ("w_T1", "w_T2")


def test_bag_points_of_two_frames(tmp_path: Path) -> None:
    messages = [
        ("/a/tip", START, point(START, (0, 0, 0), "base/link")),
        ("/b/tip", START, point(START + SECOND, (1, 1, 1), "camera")),
    ]
    path = write_bag(tmp_path, "bag", messages)
    refused(path, "points have the same name")
    assert preview_file(path).reader_options["point_names"] == {"/a/tip": "tip", "/b/tip": "tip"}
    recording = read_any(path, point_names={"/a/tip": "tip", "/b/tip": "seen_tip"})
    assert recording.joints is None
    assert [(g.name, g.frame, g.names) for g in recording.points] == [
        ("points_base_link", "base/link", ("tip",)),
        ("points_camera", "camera", ("seen_tip",)),
    ]
    assert recording.duration == 1.0
    refused(path, "no points on the topic '/c'", point_names={"/c": "tip"})


@pytest.mark.parametrize(
    ("messages", "expected"),
    [
        ([("/note", START, plain())], "no joint states and no"),
        ([("/j", START, joint_state(("a",), START, velocity=[1.0]))], "no positions"),
        ([("/j", START, joint_state(("a", "b"), START, position=[1.0]))], "1 values of 'position' for 2 joints"),
        (
            [
                ("/j", START, joint_state(("a",), START, position=[1.0], effort=[1.0])),
                ("/j", START, joint_state(("a",), START + 1000, position=[1.0])),
            ],
            "1 of 2 messages lack 'effort'",
        ),
        ([("/j", START + k, joint_state(("a",), START, position=[k])) for k in range(2)], "from sample 1 to 2"),
        ([("/p", START + k, point(START, (k, 1, 1))) for k in range(2)], "point 'p' has two positions"),
    ],
    ids=["nothing", "no positions", "length", "sometimes", "repeated joints", "repeated point"],
)
def test_bag_errors(messages: Messages, expected: str, tmp_path: Path) -> None:
    refused(write_bag(tmp_path, "bag", messages), expected)


@pytest.mark.parametrize("kind", ["bag", "mcap", "db3"])
@pytest.mark.parametrize("share", [0.0, 0.01, 0.3, 0.9])
def test_truncated_bags(kind: str, share: float, tmp_path: Path) -> None:
    path = write_bag(tmp_path, kind, arm_and_camera())
    contents = path.read_bytes()
    path.write_bytes(contents[: int(share * len(contents))])
    error = refused(path, "the bag cannot be read")
    assert (error.where, f"mcap recover {path} -o" in error.hint) == (str(path), kind == "mcap" and share > 0.0)


def test_bags_that_are_none_and_no_rosbags(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("rosbags", reason=NO_ROSBAGS)
    refused(tmp_path, "the bag cannot be read")
    refused(tmp_path / "absent.bag", "no such file")
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    assert refused(tmp_path, "needs the package rosbags").hint == "pip install '.[bags]' in the project's clone"


@pytest.mark.skipif(sys.platform != "linux", reason="the system cannot limit memory")
def test_what_a_bag_unpacks_to_is_limited(tmp_path: Path) -> None:
    import resource

    if resource.getrlimit(resource.RLIMIT_AS)[0] != resource.RLIM_INFINITY:
        pytest.skip("memory is limited from outside, which stays as it is")
    bag = OpenBag(write_bag(tmp_path, "mcap", arm_and_camera()))
    with pytest.raises(DataError, match="too much memory"), bag.raise_read_errors_as_data_errors():
        bytearray(2 << 30)
    assert np.empty(2 << 30, np.uint8).nbytes == 2 << 30  # and afterwards nothing is


def test_metadata_of_a_bag_that_take_long_are_refused(tmp_path: Path) -> None:
    path = write_bag(tmp_path, "mcap folder", arm_and_camera())
    with (path / "metadata.yaml").open("a") as file:
        file.write("more: [" + "1, " * 100_000 + "1]\n")
    refused(path, "more than 0.25 MiB")
