"""Signals: MCAP files, read back by the packages of the MCAP project, and tables that read back as what was written."""

import json
import math
import tempfile
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from yid_ocp.data import JointGroup, PointGroup, Recording
from yid_ocp.data.readers import read_any
from yid_ocp.errors import OutputError
from yid_ocp.export.signals import (
    RosTopicTimeSeries,
    export_mcap,
    export_recording_csv_files,
    ros_signals_from_recording,
)


def read(path) -> dict[str, list]:
    """Messages by topic, each with its stamp [s], and its type as the file defines it."""
    found: dict[str, list] = {}
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        last = 0
        for schema, channel, message, told in reader.iter_decoded_messages():
            assert schema.encoding == "ros2msg"
            assert schema.data
            stamp = told.header.stamp.sec * 10**9 + told.header.stamp.nanosec
            assert message.log_time == stamp >= last
            last = stamp
            found.setdefault(channel.topic, []).append((1e-9 * stamp, schema.name, told))
    return found


def xyz(entries, field) -> np.ndarray:
    return np.array([[getattr(getattr(told, field), axis) for axis in "xyz"] for *_, told in entries])


@pytest.fixture
def recording() -> Recording:
    rng = np.random.default_rng(3)
    position, velocity, command = rng.normal(size=(3, 20, 2))
    joints = JointGroup(("a", "b"), 0.1 + 0.01 * np.arange(20), position, velocity, position_command=command)
    seen = rng.normal(size=(5, 2, 3))
    seen[2, 0] = np.nan
    points = PointGroup("camera", ("tip", "mid"), 0.04 * np.arange(5), seen, frame="base")
    return Recording(joints, (points,), name="one")


def test_a_recording_comes_back_number_by_number(recording, tmp_path):
    file = tmp_path / "one.mcap"
    assert export_mcap(ros_signals_from_recording(recording), file) == 0
    found = read(file)
    assert set(found) == {"/joint_states", "/joint_commands", "/points/camera/tip", "/points/camera/mid"}
    states = found["/joint_states"]
    assert {kind for _, kind, _ in states} == {"sensor_msgs/msg/JointState"}
    assert [list(told.name) for *_, told in states] == [["a", "b"]] * 20
    np.testing.assert_array_equal([told.position for *_, told in states], recording.joints.position)
    np.testing.assert_array_equal([told.velocity for *_, told in states], recording.joints.velocity)
    assert all(len(told.effort) == 0 for *_, told in states)
    np.testing.assert_allclose([stamp for stamp, *_ in states], recording.joints.t, rtol=0, atol=1e-9)
    commands = [told.position for *_, told in found["/joint_commands"]]
    np.testing.assert_array_equal(commands, recording.joints.position_command)
    [points] = recording.points
    seen = np.isfinite(points.position[:, 0, 0])
    np.testing.assert_array_equal(xyz(found["/points/camera/tip"], "point"), points.position[seen, 0])
    np.testing.assert_allclose([stamp for stamp, *_ in found["/points/camera/tip"]], points.t[seen], rtol=0, atol=1e-9)
    np.testing.assert_array_equal(xyz(found["/points/camera/mid"], "point"), points.position[:, 1])
    assert found["/points/camera/mid"][0][2].header.frame_id == "base"
    topics = {"/points/camera/tip": "tip", "/points/camera/mid": "mid"}
    again = read_any(file, joint_topics=("/joint_states",), point_names=topics)
    np.testing.assert_array_equal(again.joints.position, recording.joints.position)
    assert {name for group in again.points for name in group.names} == {"tip", "mid"}


def test_times_before_zero_are_moved_by_whole_seconds(tmp_path):
    t = np.array([-1.25, 0.0, 0.5])
    signals = [RosTopicTimeSeries("/f", "wrench", t, {"xyz": np.arange(9.0).reshape(3, 3)})]
    assert export_mcap(signals, tmp_path / "f.mcap") == 2.0
    found = read(tmp_path / "f.mcap")["/f"]
    assert [stamp for stamp, *_ in found] == [0.75, 2.0, 2.5]
    assert [(told.wrench.force.x, told.wrench.torque.x) for *_, told in found] == [(0, 0), (3, 0), (6, 0)]


def test_nothing_is_refused_and_nothing_is_left_behind(tmp_path):
    with pytest.raises(OutputError, match="signals have no samples"):
        export_mcap([], tmp_path / "none.mcap")
    (tmp_path / "file").write_text("")
    signal = RosTopicTimeSeries("/f", "vector", np.zeros(1), {"xyz": np.zeros((1, 3))})
    with pytest.raises(OutputError, match="cannot be written"):
        export_mcap([signal], tmp_path / "file" / "a.mcap")
    tables = Recording(JointGroup(("a",), np.zeros(1), np.zeros((1, 1))))
    with pytest.raises(OutputError, match="folder cannot be made"):
        export_recording_csv_files(tables, tmp_path / "file")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
    (tmp_path / "joints.csv").write_text("measured")
    with pytest.raises(OutputError, match=r"joints\.csv exists"):
        export_recording_csv_files(tables, tmp_path)
    assert (tmp_path / "joints.csv").read_text() == "measured"


def test_a_solve_says_what_it_measured_and_predicted(pendulum, printed, tmp_path):
    printed("solve", pendulum, "--out", "run", "--set", "output.write_report=false")
    told = printed("export", "run", "--format", "mcap", "--out", "signals")
    assert told.startswith("The files have the measured and the predicted signals of the run.")
    assert told.split()[-2:] == ["signals/estimate.mcap", "signals/held_out.mcap"]
    found = read(tmp_path / "signals" / "held_out.mcap")
    with h5py.File(tmp_path / "run" / "trajectories.h5") as file:
        own = file["recordings/held_out"]
        measured, predicted = (np.array(own[f"joints.effort/{key}"]) for key in ("measured", "predicted"))
        q, effort = np.array(own["q"]), np.array(own["effort"])
    for topic, values in (("measured", measured), ("predicted", predicted), ("residual", predicted - measured)):
        entries = found[f"/{topic}/joints/effort"]
        assert list(entries[0][2].name) == ["shoulder", "elbow"]
        np.testing.assert_array_equal([told.effort for *_, told in entries], values)
    np.testing.assert_array_equal([told.position for *_, told in found["/predicted/joint_states"]], q)
    np.testing.assert_array_equal([told.effort for *_, told in found["/predicted/prescribed_efforts"]], effort)
    printed("export", "run", "--format", "csv", "--out", "x", code=2)


def test_a_diagnosis_says_what_it_could_not_explain(tmp_path, cli):
    """From made-up trajectories: every kind of unknown, an event, points before and after."""
    rng, run = np.random.default_rng(0), tmp_path / "run"
    run.mkdir()
    (run / "result.json").write_text(json.dumps({"format": "yid-diagnosis/2", "verdict": "effect"}))
    (run / "config.yaml").write_text("")
    names = ["elbow", "T1.push_x", "T1.push_z", "left.x", "left.y", "left.z", "camera.w_T1.y", "wrist"]
    kinds = ["force", "push", "push", "offset", "offset", "offset", "bias", "force"]
    mean, prior = rng.normal(size=(4, 8)), np.array([1.0] * 7 + [0.0])
    seen, before, after = rng.normal(size=(3, 6, 3))
    with h5py.File(run / "trajectories.h5", "w") as file:
        file.attrs["format"] = "yid-diagnosis-trajectories/2"
        where = file.create_group("where/a")
        where.attrs.update({"unknowns": names, "kinds": kinds, "start": 10.0})
        where["edges"], where["mean"], where["prior"] = 0.5 * np.arange(5), mean, prior
        points = file.create_group("b/points_camera")
        points.attrs["channels"] = ["points_camera.w_T1"]
        points["t"], points["measured"], points["before"], points["after"] = np.arange(6.0), seen, before, after
        event = file.create_group("events/b/elbow")
        event["t"], event["value"] = np.arange(3.0), np.array([0.0, 2.0, 0.0])
    told = json.loads(cli("export", run, "--format", "mcap", "--out", tmp_path / "out", "--json").out)
    assert {path.rpartition("/")[2] for path in told["file"]} == {"a.mcap", "b.mcap"}
    assert told["notes"] == []
    found = read(tmp_path / "out" / "a.mcap")
    held = np.vstack([mean, mean[-1:]])
    topics = {"/unknown/joint_states", "/unknown/push/T1", "/unknown/offset/left", "/unknown/bias/camera/w_T1"}
    assert set(found) == topics
    forces = found["/unknown/joint_states"]
    assert [stamp for stamp, *_ in forces] == [10.0, 10.5, 11.0, 11.5, 12.0]
    assert list(forces[0][2].name) == ["elbow"], "what was not taken in is no finding"
    np.testing.assert_array_equal([told.effort for *_, told in forces], held[:, :1])
    pushes = [(told.wrench.force.x, told.wrench.force.y, told.wrench.force.z) for *_, told in found["/unknown/push/T1"]]
    np.testing.assert_array_equal(pushes, np.stack([held[:, 1], np.zeros(5), held[:, 2]], axis=1))
    np.testing.assert_array_equal(xyz(found["/unknown/offset/left"], "vector"), held[:, 3:6])
    np.testing.assert_array_equal(xyz(found["/unknown/bias/camera/w_T1"], "vector")[:, 1], held[:, 6])
    other = read(tmp_path / "out" / "b.mcap")
    point = "points/points_camera/w_T1"
    np.testing.assert_array_equal(xyz(other[f"/measured/{point}"], "point"), seen)
    for name, values in (("nominal", before), ("with_effects", after)):
        np.testing.assert_array_equal(xyz(other[f"/{name}/{point}"], "point"), values)
        np.testing.assert_array_equal(xyz(other[f"/residual/{name}/{point}"], "vector"), values - seen)
    assert [list(told.effort) for *_, told in other["/events/elbow"]] == [[0.0], [2.0], [0.0]]


@given(
    hnp.arrays(float, (4, 2), elements=st.floats(-50, 50)),
    hnp.arrays(float, (3, 2, 3), elements=st.floats(-50, 50)),
    hnp.arrays(bool, (3, 2)),
)
def test_csv_round_trip(position: np.ndarray, points: np.ndarray, hidden: np.ndarray) -> None:
    points[hidden] = np.nan
    joints = JointGroup(("a", "b_x"), np.array([0.0, 0.1, 0.3, 1e9 / 3]), position, effort=-position)
    camera = PointGroup("points_camera", ("p", "q r"), np.array([-1.0, 0.0, math.pi]), points)
    with tempfile.TemporaryDirectory() as folder:
        files = export_recording_csv_files(Recording(joints, (camera,)), Path(folder) / "new" / "tables")
        assert [file.name for file in files] == ["joints.csv", "points_camera.csv"]
        back, (points_back,) = read_any(files[0]).joints, read_any(files[1]).points
    assert (back.names, points_back.names) == (joints.names, camera.names)
    assert list(back.values_by_channel) == ["position", "effort"]
    for own, read_back in ((joints, back), (camera, points_back)):
        np.testing.assert_array_equal(read_back.t, own.t)
        np.testing.assert_array_equal(read_back.position, own.position)
    np.testing.assert_array_equal(back.values_by_channel["effort"], -position)
