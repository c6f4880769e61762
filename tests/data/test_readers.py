from __future__ import annotations

import contextlib
import math
import sqlite3
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from yid_ocp.data.readers import READERS, read_any, read_bag, read_csv
from yid_ocp.data.recording import JointGroup, Recording, validate, write_recording
from yid_ocp.errors import DataError

SHARED = Path(__file__).parents[2].parent / "shared" / "recordings"
SECOND = 10**9


def table(folder: Path, text: str, name: str = "run.csv") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def joints_of(recording: Recording) -> JointGroup:
    assert recording.joints is not None
    return recording.joints


# ------------------------------------------------------------------------------------------------------------ CSV


def test_csv_conventional_columns(tmp_path: Path) -> None:
    path = table(
        tmp_path,
        "\ufefft, q_a, position_b, effort_a, effort_b, position_command_a, position_command_b, tip_x, tip_y, tip_z\n"
        "0.0, 0.1, 0.2, 1, 2, 0, 0, 0.5, 0.6, 0.7\n"
        "\n"
        "0.5, 0.3, 0.4, 3, 4, 0, 1, , , \n",
    )
    recording = read_csv(path, clock="nominal", sensor="camera", frame="base", description="two joints")
    joints = joints_of(recording)
    assert joints.names == ("a", "b")
    assert joints.clock == "nominal"
    assert np.array_equal(joints.position, [[0.1, 0.2], [0.3, 0.4]])
    assert np.array_equal(joints.channels["effort"], [[1, 2], [3, 4]])
    assert np.array_equal(joints.channels["position_command"], [[0, 0], [0, 1]])
    (points,) = recording.points
    assert (points.names, points.sensor, points.frame, points.clock) == (("tip",), "camera", "base", "nominal")
    assert np.array_equal(points.position, [[[0.5, 0.6, 0.7]]])
    assert np.array_equal(points.t, [0.0])
    assert (recording.name, recording.source, recording.description) == ("run", "run.csv", "two joints")
    assert recording.sha256 is not None


def test_csv_units_are_converted(tmp_path: Path) -> None:
    path = table(tmp_path, "time,q_a,velocity_a,effort_a,p_x,p_y,p_z\n0,180,60,1000,1,2,3\n500,90,0,0,0,0,0\n")
    units = {"t": "ms", "position": "deg", "velocity": "rpm", "effort": "N mm", "points": "mm"}
    recording = read_csv(path, units=units)
    joints = joints_of(recording)
    assert np.allclose(joints.t, [0.0, 0.5])
    assert np.allclose(joints.position[:, 0], [math.pi, math.pi / 2])
    assert joints.channels["velocity"][0, 0] == pytest.approx(2 * math.pi)
    assert joints.channels["effort"][0, 0] == pytest.approx(1.0)
    assert np.allclose(recording.points[0].position[0, 0], [0.001, 0.002, 0.003])
    with pytest.raises(DataError, match="reaches 180 rad"):
        read_csv(path, units={"t": "ms"})


def test_csv_columns_given(tmp_path: Path) -> None:
    path = table(tmp_path, "stamp;angle;label;X;Y;Z\n0;0.1;start;1;2;3\n1;0.2;;4;5;6\n")
    columns: Mapping[str, Any] = {
        "stamp": "t",
        "angle": ("position", "elbow"),
        "label": None,
        "X": ["x", "tip"],
        "Y": ["y", "tip"],
        "Z": ["z", "tip"],
    }
    recording = read_csv(path, columns=columns, delimiter=";")
    assert recording.joint_names == ("elbow",)
    assert np.array_equal(recording.points[0].position[:, 0], [[1, 2, 3], [4, 5, 6]])


def test_csv_two_clocks_in_one_table(tmp_path: Path) -> None:
    recording = read_csv(table(tmp_path, "t,q_a,p_x,p_y,p_z\n0,1,,,\n1,2,1,1,1\n2,,2,2,2\n3,3,,,\n"))
    assert np.array_equal(joints_of(recording).t, [0, 1, 3])
    assert np.array_equal(recording.points[0].t, [1, 2])


def test_csv_of_points_keeps_frames_without_any(tmp_path: Path) -> None:
    recording = read_csv(table(tmp_path, "t,p_x,p_y,p_z\n0,1,1,1\n1,,,\n"))
    assert np.array_equal(recording.points[0].t, [0, 1])
    assert np.isnan(recording.points[0].position[1]).all()


def test_joints_named_after_axes_are_not_points(tmp_path: Path) -> None:
    recording = read_csv(table(tmp_path, "t,q_T1_x,q_T1_y,q_T1_z\n0,1,2,3\n"))
    assert recording.joint_names == ("T1_x", "T1_y", "T1_z")
    assert not recording.points


GOOD = "t,q_a\n0,1\n"
CSV_ERRORS: dict[str, tuple[str, dict[str, Any], str, str]] = {
    "empty": ("", {}, "the table is empty", ""),
    "no header": ("0,1\n1,2\n", {}, "no header row", ""),
    "no rows": ("t,q_a\n", {}, "no rows", ""),
    "other delimiter": ("t;q_a\n0;1\n", {}, "one column, 't;q_a'", "delimiter=';'"),
    "one column": ("t\n0\n", {}, "one column, 't'", ""),
    "long delimiter": (GOOD, {"delimiter": "::"}, "the delimiter is '::'", ""),
    "repeated column": ("t,q_a,q_a\n0,1,1\n", {}, "two columns are called 'q_a'", ""),
    "same meaning": ("t,q_a,position_a\n0,1,1\n", {}, "'q_a' and 'position_a' mean the same, position a", ""),
    "unknown column": ("t,q_a,label\n0,1,2\n", {}, "meaning of column 'label'", "columns={'label'"),
    "bare prefix": ("t,q_\n0,1\n", {}, "meaning of column 'q_'", ""),
    "no time": ("q_a,q_b\n0,1\n", {}, "no column of times", ""),
    "only time": ("t,label\n0,1\n", {"columns": {"label": None}}, "the recording has no group", ""),
    "column not there": (GOOD, {"columns": {"q_b": None}}, "there is no column 'q_b'", "did you mean 'q_a'"),
    "meaning of a column": (GOOD, {"columns": {"q_a": ("angle", "a")}}, "given the meaning", "known: "),
    "meaning without joint": (GOOD, {"columns": {"q_a": "position"}}, "given the meaning 'position'", ""),
    "short row": ("t,q_a\n0,1\n1\n", {}, "the row has 1 cells", ""),
    "text": ("t,q_a\n0,1\n1,fast\n", {}, "column 'q_a' holds 'fast'", ""),
    "joint missing in a channel": ("t,q_a,q_b,effort_a\n0,1,1,1\n", {}, "no column for effort of 'b'", ""),
    "no position": ("t,effort_a\n0,1\n", {}, "no column for position of 'a'", ""),
    "axis missing": ("t,p_x,p_y\n0,1,1\n", {}, "no column for z of 'p'", ""),
    "empty cell of a joint": ("t,q_a\n0,1\n1,\n", {}, "'position' of joint 'a' is not finite at t = 1 s", ""),
    "clock": ("t,q_a\n1,1\n0,1\n", {}, "from index 0 to 1", ""),
    "unit of what": (GOOD, {"units": {"angle": "deg"}}, "unit is given for 'angle'", ""),
    "unit": (GOOD, {"units": {"velocity": "deg"}}, "'deg' is not a unit of 'velocity'", "did you mean 'deg/s'"),
}


@pytest.mark.parametrize("case", CSV_ERRORS)
def test_csv_errors(case: str, tmp_path: Path) -> None:
    text, options, message, hint = CSV_ERRORS[case]
    path = table(tmp_path, text)
    with pytest.raises(DataError, match=message.replace("(", r"\(")) as caught:
        read_csv(path, **options)
    assert "run" in caught.value.where
    assert hint in caught.value.hint


def test_csv_errors_say_the_line(tmp_path: Path) -> None:
    with pytest.raises(DataError) as caught:
        read_csv(table(tmp_path, "t,q_a\n0,1\n\n1,fast\n"))
    assert caught.value.where.endswith("line 4")


def test_csv_that_is_no_text(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    path.write_bytes(b"t,q_a\n\xff\xfe\x00,1\n")
    with pytest.raises(DataError, match="not a table of text"):
        read_csv(path)
    with pytest.raises(DataError, match="not a table of text"):
        read_csv(tmp_path)
    with pytest.raises(DataError, match="no such file"):
        read_csv(tmp_path / "absent.csv")


# ------------------------------------------------------------------------------------------------------- any format


def test_read_any_chooses_by_suffix(tmp_path: Path) -> None:
    recording = read_any(table(tmp_path, GOOD, "RUN.CSV"), units={"position": "deg"})
    assert joints_of(recording).position[0, 0] == pytest.approx(math.pi / 180)
    write_recording(recording, tmp_path / "run.h5")
    assert joints_of(read_any(tmp_path / "run.h5", allow_nan_effort=True)).names == ("a",)


def test_read_any_refuses_what_it_does_not_know(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"no reader for '\.csvv'") as caught:
        read_any(tmp_path / "run.csvv")
    assert caught.value.hint == "did you mean '.csv'?"
    assert ".mcap" in caught.value.allowed
    with pytest.raises(DataError, match="no option 'unit'") as caught:
        read_any(table(tmp_path, GOOD), unit={})
    assert caught.value.hint == "did you mean 'units'?"


def test_a_new_reader_is_one_registration(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(READERS, "_entries", dict(READERS._entries))

    @READERS.register(".one")
    def read_one(path: Path, *, value: float = 1.0) -> Recording:
        return validate(Recording(JointGroup(("a",), np.zeros(1), np.full((1, 1), value)), name=path.stem))

    assert joints_of(read_any(tmp_path / "run.one", value=2.0)).position[0, 0] == 2.0


@pytest.mark.skipif(
    not (SHARED / "deft").is_dir(), reason="the real recordings are not here (shared/recordings beside the project)"
)
def test_a_real_table_that_is_no_recording_is_refused() -> None:
    with pytest.raises(DataError, match="meaning of column 'point'"):
        read_any(SHARED / "deft" / "bdlo1_undeformed.csv")


# ------------------------------------------------------------------------------------------------------------ bags

NO_ROSBAGS = "bags need rosbags: pip install 'yid-ocp[bags]'"
JOINT_STATE, POINT = "sensor_msgs/msg/JointState", "geometry_msgs/msg/PointStamped"
START = 1_700_000_000 * SECOND
FORMATS = ("bag", "mcap", "mcap folder", "db3", "db3 folder")


def joint_state(names: Sequence[str], stamp: int, **channels: Sequence[float]) -> tuple[str, dict[str, Any]]:
    return JOINT_STATE, {"name": list(names), "stamp": stamp, "frame_id": "", **channels}


def point(stamp: int, xyz: Sequence[float], frame: str = "camera_link") -> tuple[str, dict[str, Any]]:
    return POINT, {"stamp": stamp, "frame_id": frame, "xyz": xyz}


Messages = Sequence[tuple[str, int, tuple[str, dict[str, Any]]]]


def write_bag(folder: Path, kind: str, messages: Messages) -> Path:
    """Write (topic, time of recording, message) triples as one of `FORMATS`."""
    pytest.importorskip("rosbags", reason=NO_ROSBAGS)
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if kind == "bag" else Stores.ROS2_HUMBLE)
    types: Any = store.types
    path = folder / ("run.bag" if kind == "bag" else "run")
    writer: Any
    if kind == "bag":
        writer = Writer1(path)
    else:
        plugin = StoragePlugin.MCAP if kind.startswith("mcap") else StoragePlugin.SQLITE3
        writer = Writer2(path, version=9, storage_plugin=plugin)
    with writer:
        connections: dict[tuple[str, str], Any] = {}
        for topic, logged, (msgtype, values) in messages:
            if (topic, msgtype) not in connections:
                connections[topic, msgtype] = writer.add_connection(topic, msgtype, typestore=store)
            stamp = types["builtin_interfaces/msg/Time"](*divmod(values["stamp"], SECOND))
            sequence = (0,) if kind == "bag" else ()
            header = types["std_msgs/msg/Header"](*sequence, stamp=stamp, frame_id=values["frame_id"])
            if msgtype == JOINT_STATE:
                arrays = [np.array(values.get(c, []), dtype=float) for c in ("position", "velocity", "effort")]
                message = types[JOINT_STATE](header, values["name"], *arrays)
            elif msgtype == POINT:
                message = types[POINT](header, types["geometry_msgs/msg/Point"](*map(float, values["xyz"])))
            else:
                message = types[msgtype](values["data"])
            serialize = store.serialize_ros1 if kind == "bag" else store.serialize_cdr
            writer.write(connections[topic, msgtype], logged, serialize(message, msgtype))
    return path / f"run.{kind}" if kind in ("mcap", "db3") else path


def arm_and_camera() -> Messages:
    messages: list[tuple[str, int, tuple[str, dict[str, Any]]]] = []
    for k in range(5):
        stamp = START + k * SECOND // 100
        values = {"position": [0.1 * k, 0.2 * k], "velocity": [1.0, 2.0], "effort": [math.nan, math.nan]}
        messages.append(("/joint_states", stamp + 1000, joint_state(("a", "b"), stamp, **values)))
    for k, topic in enumerate(("/seen/w_T1", "/seen/w_T2", "/seen/w_T1")):
        stamp = START + (k // 2) * SECOND // 50 + SECOND // 200
        messages.append((topic, stamp + 1000, point(stamp, (0.1 * k, 0.0, 1.0))))
    messages.append(("/note", START, ("std_msgs/msg/String", {"stamp": 0, "frame_id": "", "data": "hello"})))
    return messages


@pytest.mark.parametrize("kind", FORMATS)
def test_bag_round_trip(kind: str, tmp_path: Path) -> None:
    path = write_bag(tmp_path, kind, arm_and_camera())
    recording = read_any(path, sensor="camera")
    joints = joints_of(recording)
    assert joints.names == ("a", "b")
    assert np.allclose(joints.t, 0.01 * np.arange(5), rtol=0, atol=1e-12)
    assert np.allclose(joints.position, np.outer(np.arange(5), [0.1, 0.2]))
    assert list(joints.channels) == ["position", "velocity"]
    (points,) = recording.points
    assert (points.name, points.names) == ("points", ("w_T1", "w_T2"))
    assert (points.frame, points.sensor, points.clock) == ("camera_link", "camera", "recorded")
    assert np.allclose(points.t, [0.005, 0.025])
    assert np.allclose(points.position[0], [[0.0, 0, 1], [0.1, 0, 1]])
    assert np.allclose(points.position[1, 0], [0.2, 0, 1])
    assert np.isnan(points.position[1, 1]).all()
    assert recording.name == "run"
    assert recording.sha256 is not None
    write_recording(recording, tmp_path / "run.h5")
    assert read_any(tmp_path / "run.h5").point_names == ("w_T1", "w_T2")


def test_bag_order_of_joints_may_change(tmp_path: Path) -> None:
    first = joint_state(("a", "b"), START, position=[1.0, 2.0])
    second = joint_state(("b", "a"), START + SECOND, position=[4.0, 3.0])
    path = write_bag(tmp_path, "bag", [("/joint_states", START, first), ("/joint_states", START + SECOND, second)])
    assert np.array_equal(joints_of(read_bag(path, joints=["a", "b"])).position, [[1, 2], [3, 4]])
    assert np.array_equal(np.sort(joints_of(read_bag(path)).position), [[1, 2], [3, 4]])


def test_bag_with_different_sets_of_joints(tmp_path: Path) -> None:
    """Baxter's grippers come on the topic of its arms, in messages of their own."""
    arm = joint_state(("a", "b"), START, position=[1.0, 2.0])
    gripper = joint_state(("finger",), START, position=[0.5])
    path = write_bag(tmp_path, "bag", [("/joint_states", START, arm), ("/joint_states", START, gripper)])
    with pytest.raises(DataError, match="2 different sets of joints") as caught:
        read_bag(path)
    assert "joints=[...]" in caught.value.hint
    assert read_bag(path, joints=["b"]).joint_names == ("b",)
    with pytest.raises(DataError, match="no joint 'fingr'") as caught:
        read_bag(path, joints=["a", "fingr"])
    assert caught.value.hint == "did you mean 'finger'?"
    with pytest.raises(DataError, match="never come in one message"):
        read_bag(path, joints=["a", "finger"])


def test_bag_with_several_joint_topics(tmp_path: Path) -> None:
    one, two = (joint_state((name,), START, position=[1.0]) for name in "ab")
    path = write_bag(tmp_path, "bag", [("/left", START, one), ("/right", START, two)])
    with pytest.raises(DataError, match="several topics"):
        read_bag(path)
    assert read_bag(path, joint_topic="/right").joint_names == ("b",)
    with pytest.raises(DataError, match="on the topic '/rigth'") as caught:
        read_bag(path, joint_topic="/rigth")
    assert caught.value.hint == "did you mean '/right'?"


@pytest.mark.parametrize("stamps", [(0, 0), (START - SECOND // 2, 0)])
def test_bag_without_stamps_uses_the_time_of_recording(stamps: tuple[int, int], tmp_path: Path) -> None:
    messages = [
        ("/joint_states", START + k * SECOND, joint_state(("a",), stamp, position=[1.0]))
        for k, stamp in enumerate(stamps)
    ]
    path = write_bag(tmp_path, "mcap", messages)
    assert np.array_equal(joints_of(read_bag(path)).t, [0.0, 1.0])


def test_bag_without_definitions_of_its_messages(tmp_path: Path) -> None:
    path = write_bag(tmp_path, "db3", arm_and_camera())
    with contextlib.closing(sqlite3.connect(path)) as database, database:
        database.execute("DELETE FROM message_definitions")
    recording = read_bag(path)
    assert recording.joint_names == ("a", "b")
    assert recording.point_names == ("w_T1", "w_T2")


def test_bag_points_of_two_frames(tmp_path: Path) -> None:
    messages = [
        ("/a/tip", START, point(START, (0, 0, 0), "base/link")),
        ("/b/tip", START, point(START + SECOND, (1, 1, 1), "camera")),
    ]
    path = write_bag(tmp_path, "bag", messages)
    with pytest.raises(DataError, match="points of the same name"):
        read_bag(path)
    recording = read_bag(path, point_topics={"/a/tip": "tip", "/b/tip": "seen_tip"})
    assert recording.joints is None
    assert [(g.name, g.frame, g.names) for g in recording.points] == [
        ("points_base_link", "base/link", ("tip",)),
        ("points_camera", "camera", ("seen_tip",)),
    ]
    assert recording.duration == 1.0
    with pytest.raises(DataError, match="no points on the topic '/c'"):
        read_bag(path, point_topics={"/c": "tip"})


@pytest.mark.parametrize(
    ("messages", "expected"),
    [
        (
            [("/note", START, ("std_msgs/msg/String", {"stamp": 0, "frame_id": "", "data": "x"}))],
            "no joint states and no",
        ),
        ([("/j", START, joint_state(("a",), START, velocity=[1.0]))], "no positions"),
        ([("/j", START, joint_state(("a", "b"), START, position=[1.0]))], "1 values of 'position' for 2 joints"),
        (
            [
                ("/j", START, joint_state(("a",), START, position=[1.0], effort=[1.0])),
                ("/j", START, joint_state(("a",), START + 1000, position=[1.0])),
            ],
            "1 of 2 messages lack 'effort'",
        ),
        ([("/j", START + k, joint_state(("a",), START, position=[1.0])) for k in range(2)], "from index 0 to 1"),
        ([("/p", START + k, point(START, (1, 1, 1))) for k in range(2)], "point 'p' comes twice"),
    ],
    ids=["nothing", "no positions", "length", "sometimes", "repeated joints", "repeated point"],
)
def test_bag_errors(messages: Messages, expected: str, tmp_path: Path) -> None:
    path = write_bag(tmp_path, "bag", messages)
    with pytest.raises(DataError, match=expected):
        read_bag(path)


@pytest.mark.parametrize("kind", ["bag", "mcap", "db3"])
@pytest.mark.parametrize("share", [0.0, 0.01, 0.3, 0.9])
def test_truncated_bags(kind: str, share: float, tmp_path: Path) -> None:
    path = write_bag(tmp_path, kind, arm_and_camera())
    contents = path.read_bytes()
    path.write_bytes(contents[: int(share * len(contents))])
    with pytest.raises(DataError, match="the bag cannot be read") as caught:
        read_bag(path)
    assert caught.value.where == str(path)


def test_bags_that_are_none(tmp_path: Path) -> None:
    pytest.importorskip("rosbags", reason=NO_ROSBAGS)
    with pytest.raises(DataError, match="the bag cannot be read"):
        read_any(tmp_path)
    with pytest.raises(DataError, match="no such file"):
        read_bag(tmp_path / "absent.bag")


def test_bags_without_rosbags(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_bag(tmp_path, "bag", arm_and_camera())
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with pytest.raises(DataError, match="needs the package rosbags") as caught:
        read_any(path)
    assert caught.value.hint == "pip install 'yid-ocp[bags]'"
