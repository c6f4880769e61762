from __future__ import annotations

import dataclasses
import os
import re
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from yid_ocp.data.recording import (
    JOINT_CHANNELS,
    JointGroup,
    PointGroup,
    Recording,
    check_names,
    read_recording,
    validate,
    write_recording,
)
from yid_ocp.errors import DataError, OutputError

ROOT = Path(__file__).parents[2]
REAL_FOLDER = ROOT.parent / "shared" / "recordings"
REAL_FILES = sorted(REAL_FOLDER.glob("*/*.h5"))


def turned(angle: float) -> np.ndarray:
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    pose[:3, 3] = [1.0, 2.0, 3.0]
    return pose


def example() -> Recording:
    generator = np.random.default_rng(0)
    t = np.arange(50) / 100
    joints = JointGroup(
        names=("left_s0", "left_s1"),
        t=t,
        **{channel: generator.normal(size=(50, 2)) for channel in JOINT_CHANNELS},  # type: ignore[arg-type]
        position_std=1e-3,
        velocity_std=np.array([0.01, 0.02]),
    )
    frames = np.array([0.0, 0.1, 0.35, 0.9])
    seen = generator.normal(size=(4, 3, 3))
    seen[1, 2] = np.nan
    camera = PointGroup(
        "points_camera",
        ("w_T1", "w_T2", "w_T3"),
        frames,
        seen,
        np.full((4, 3, 3), 0.01),
        "camera",
        "world",
        turned(0.3),
    )
    arm = PointGroup("points_arm", ("w_T2",), t, generator.normal(size=(50, 1, 3)), sensor="arm", clock="nominal")
    return Recording(joints, (arm, camera), "a test", "nowhere", "example", truth={"T1.bend": 22.0, "T1.twist": 3})


def with_joints(**changes: Any) -> Recording:
    recording = example()
    assert recording.joints is not None
    return dataclasses.replace(recording, joints=dataclasses.replace(recording.joints, **changes))


def with_camera(**changes: Any) -> Recording:
    recording = example()
    return dataclasses.replace(
        recording, points=(recording.points[0], dataclasses.replace(recording.points[1], **changes))
    )


def changed(array: np.ndarray, index: Any, value: float) -> np.ndarray:
    array = array.copy()
    array[index] = value
    return array


def assert_same(left: Recording, right: Recording) -> None:
    assert (left.description, left.source, left.truth) == (right.description, right.source, right.truth)
    assert [type(group) for group in left.groups] == [type(group) for group in right.groups]
    for one, other in zip(left.groups, right.groups, strict=True):
        for field in dataclasses.fields(one):
            ours, theirs = getattr(one, field.name), getattr(other, field.name)
            if isinstance(ours, np.ndarray):
                assert np.array_equal(ours, theirs, equal_nan=True), field.name
            else:
                assert ours == theirs, field.name


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "run.h5"
    write_recording(example(), path)
    return path


# ------------------------------------------------------------------------------------------------------ in memory


def test_arrays_are_copied_and_read_only() -> None:
    t = np.array([0.0, 1.0])
    group = JointGroup(("a",), t, np.zeros((2, 1)))
    t[0] = -1.0
    assert group.t[0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        group.t[0] = 5.0


def test_a_ragged_array_is_refused() -> None:
    with pytest.raises(DataError, match="not an array of real numbers"):
        JointGroup(("a",), [0.0, 1.0], [[0.0], [1.0, 2.0]])  # type: ignore[arg-type]


def test_one_number_for_std_is_spread_over_the_points() -> None:
    group = PointGroup("points", ("a",), np.array([0.0, 1.0]), np.zeros((2, 1, 3)), std=0.01)  # type: ignore[arg-type]
    assert group.std is not None
    assert group.std.shape == (2, 1, 3)
    assert np.all(group.std == 0.01)


def test_names_and_duration() -> None:
    recording = example()
    assert recording.joint_names == ("left_s0", "left_s1")
    assert recording.point_names == ("w_T2", "w_T1", "w_T3")
    assert recording.duration == pytest.approx(0.9)
    assert Recording(points=recording.points[:1]).joint_names == ()


def test_channels_are_those_recorded() -> None:
    group = JointGroup(("a",), np.array([0.0]), np.zeros((1, 1)), effort=np.ones((1, 1)))
    assert list(group.channels) == ["position", "effort"]


def test_slice_keeps_each_clock_and_both_ends() -> None:
    part = example().slice(0.1, 0.4)
    assert part.joints is not None
    assert part.joints.t[[0, -1]] == pytest.approx([0.1, 0.4])
    assert part.joints.effort is not None
    assert part.joints.effort.shape == (31, 2)
    assert list(part.points[1].t) == [0.1, 0.35]
    assert part.points[1].std is not None
    assert part.points[1].std.shape == (2, 3, 3)
    assert_same(part, validate(part))


def test_slice_drops_groups_without_samples() -> None:
    part = example().slice(0.6, 1.0)
    assert part.joints is None
    assert [group.name for group in part.points] == ["points_camera"]


@pytest.mark.parametrize("bounds", [(5.0, 6.0), (0.4, 0.1), (0.1, 0.1), (float("nan"), 1.0)])
def test_an_empty_slice_is_refused(bounds: tuple[float, float]) -> None:
    with pytest.raises(DataError, match="nothing was recorded") as caught:
        example().slice(*bounds)
    assert "0 s to 0.9 s" in caught.value.allowed


def test_select_points_keeps_order_and_drops_empty_groups() -> None:
    recording = example()
    part = recording.select_points(["w_T3", "w_T1"])
    assert [group.name for group in part.points] == ["points_camera"]
    assert part.points[0].names == ("w_T3", "w_T1")
    assert np.array_equal(part.points[0].position, recording.points[1].position[:, [2, 0]], equal_nan=True)
    assert part.points[0].std is not None
    assert part.points[0].std.shape == (4, 2, 3)
    assert recording.select_points([]).points == ()


def test_select_points_refuses_what_is_not_there() -> None:
    with pytest.raises(DataError, match="no point 'w_T4'"):
        example().select_points(["w_T4"])
    with pytest.raises(DataError, match="no joints"):
        dataclasses.replace(example(), joints=None).select_points([])


def test_check_names_names_the_nearest() -> None:
    check_names(example(), ["left_s1"], ["w_T1", "w_T2"])
    with pytest.raises(DataError, match="no joints 'left_s2', 'elbow'") as caught:
        check_names(example(), ["left_s2", "left_s0", "elbow"], [])
    assert "did you mean 'left_s" in caught.value.hint
    assert caught.value.allowed == "left_s0, left_s1"
    with pytest.raises(DataError, match="no point 'tip'") as caught:
        check_names(Recording(example().joints), [], ["tip"])
    assert caught.value.allowed == "no points were recorded"


# ---------------------------------------------------------------------------------------------------- validation

BASE = example()
assert BASE.joints is not None
T, Q, CAMERA = BASE.joints.t, BASE.joints.position, BASE.points[1]

INVALID: dict[str, tuple[Callable[[], Recording], str]] = {
    "no group": (lambda: Recording(), "no group"),
    "no samples": (lambda: with_joints(t=np.empty(0), position=np.empty((0, 2))), "no samples"),
    "no names": (lambda: with_joints(names=()), "no names"),
    "empty name": (lambda: with_joints(names=("a", "")), "'' cannot be used"),
    "name not text": (lambda: with_joints(names=("a", 1)), "1 cannot be used"),
    "null in a name": (lambda: with_joints(names=("a", "b\0c")), "cannot be stored"),
    "null in the frame": (lambda: with_camera(frame="\0"), "cannot be stored"),
    "half a letter": (lambda: dataclasses.replace(BASE, source="\ud800"), "cannot be stored"),
    "repeated joint": (lambda: with_joints(names=("a", "a")), "'a' occurs 2 times"),
    "repeated point": (lambda: with_camera(names=("a", "b", "a")), "'a' occurs 2 times"),
    "repeated group": (lambda: dataclasses.replace(BASE, points=(CAMERA, CAMERA)), "two groups of points"),
    "name of group": (lambda: with_camera(name="camera"), "a group of points is called 'camera'"),
    "clock kind": (lambda: with_joints(clock="wall"), "the clock is 'wall'"),
    "shape of t": (lambda: with_joints(t=T[:, None]), r"shape \(50, 1\)"),
    "length of t": (lambda: with_joints(t=T[:-1]), r"shape \(50, 2\)"),
    "shape of position": (lambda: with_joints(position=Q[:, :1]), r"shape \(50, 1\)"),
    "shape of effort": (lambda: with_joints(effort=Q[:-1]), r"shape \(49, 2\)"),
    "shape of points": (lambda: with_camera(position=CAMERA.position[..., :2]), r"shape \(4, 3, 2\)"),
    "shape of std": (lambda: with_camera(std=np.ones((4, 3))), r"shape \(4, 3\)"),
    "shape of joint std": (lambda: with_joints(effort_std=np.ones(3)), r"shape \(3,\)"),
    "shape of pose": (lambda: with_camera(pose=np.eye(3)), r"shape \(3, 3\)"),
    "infinite time": (lambda: with_joints(t=changed(T, 7, np.inf)), r"time at index \[7\] is not finite"),
    "time going back": (lambda: with_joints(t=changed(T, 4, 0.02)), r"from index 3 to 4: 0\.03 s, then 0\.02 s"),
    "time standing": (lambda: with_camera(t=np.zeros(4)), "from index 0 to 1: 0.0 s, then 0.0 s"),
    "NaN position": (
        lambda: with_joints(position=changed(Q, ([5, 6, 8], 1), np.nan)),
        r"'position' of joint 'left_s1' is not finite at t = 0\.05 s \(3 such values",
    ),
    "NaN velocity": (lambda: with_joints(velocity=changed(Q, (2, 0), np.nan)), "'velocity' of joint 'left_s0'"),
    "NaN effort": (lambda: with_joints(effort=changed(Q, (2, 0), np.nan)), "'effort' of joint 'left_s0'"),
    "infinite effort": (lambda: with_joints(external_effort=changed(Q, (0, 0), np.inf)), "'external_effort' of joint"),
    "infinite point": (lambda: with_camera(position=changed(CAMERA.position, (0, 0, 0), np.inf)), "'w_T1' is .*inf"),
    "half seen": (lambda: with_camera(position=changed(CAMERA.position, (3, 1, 2), np.nan)), "'w_T2' is .*nan"),
    "negative std": (
        lambda: with_camera(std=changed(np.ones((4, 3, 3)), (0, 0, 0), -0.5)),
        r"that was seen is \[-0.5\]",
    ),
    "NaN std": (lambda: with_camera(std=changed(np.ones((4, 3, 3)), (0, 0, 0), np.nan)), r"that was seen is \[nan\]"),
    "negative joint std": (lambda: with_joints(position_std=-1.0), "position_std is -1.0"),
    "NaN joint std": (lambda: with_joints(velocity_std=np.array([0.1, np.nan])), "velocity_std is"),
    "NaN pose": (lambda: with_camera(pose=changed(np.eye(4), (0, 3), np.nan)), "value that is not finite"),
    "last row": (lambda: with_camera(pose=changed(np.eye(4), (3, 0), 1.0)), "last row of the pose"),
    "scaled pose": (lambda: with_camera(pose=np.diag([2.0, 2.0, 2.0, 1.0])), "not orthonormal"),
    "reflection": (lambda: with_camera(pose=np.diag([1.0, 1.0, -1.0, 1.0])), "reflection"),
    "degrees": (lambda: with_joints(position=Q + 90.0), "'position' reaches 9"),
    "degrees asked for": (lambda: with_joints(position_command=Q - 90.0), "'position_command' reaches 9"),
    "millimetres": (lambda: with_camera(position=1e3 * CAMERA.position), "a coordinate reaches"),
    "truth not finite": (lambda: dataclasses.replace(BASE, truth={"T1.bend": np.inf}), "'T1.bend' is inf"),
    "truth not a number": (lambda: dataclasses.replace(BASE, truth={"T1.bend": "3"}), "'T1.bend' is '3'"),  # type: ignore[dict-item]
}


@pytest.mark.parametrize("case", INVALID)
def test_invalid_recordings_are_refused(case: str, tmp_path: Path) -> None:
    make, message = INVALID[case]
    with pytest.raises(DataError, match=message) as caught:
        validate(make())
    assert "recording '" in caught.value.where
    if case != "NaN effort":
        with pytest.raises(DataError, match=message):
            write_recording(make(), tmp_path / "run.h5")
        assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("case", "word"), [("degrees", "degrees"), ("millimetres", "millimetres")])
def test_wrong_units_are_guessed(case: str, word: str) -> None:
    with pytest.raises(DataError) as caught:
        validate(INVALID[case][0]())
    assert word in caught.value.hint


def test_nan_effort_on_request() -> None:
    recording = with_joints(effort=changed(Q, (2, 0), np.nan))
    assert validate(recording, allow_nan_effort=True) is recording
    with pytest.raises(DataError, match="velocity"):
        validate(with_joints(velocity=changed(Q, (2, 0), np.nan)), allow_nan_effort=True)


def test_std_of_a_point_not_seen_may_be_nan() -> None:
    recording = with_camera(std=np.where(np.isnan(CAMERA.position), np.nan, 0.01))
    assert validate(recording) is recording


def test_a_point_never_seen_is_allowed() -> None:
    recording = with_camera(position=np.full((4, 3, 3), np.nan))
    assert validate(recording) is recording


# -------------------------------------------------------------------------------------------------------- the file


def test_round_trip(file: Path) -> None:
    recording = read_recording(file)
    assert_same(recording, example())
    assert recording.name == "run"
    assert recording.sha256 is not None
    assert re.fullmatch("[0-9a-f]{64}", recording.sha256)


def test_writing_is_reproducible(file: Path, tmp_path: Path) -> None:
    write_recording(read_recording(file), tmp_path / "again.h5")
    assert read_recording(tmp_path / "again.h5").sha256 == read_recording(file).sha256


def finite(bound: float) -> st.SearchStrategy[float]:
    return st.floats(-bound, bound, allow_nan=False)


TEXT = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]))
NAME = TEXT.filter(bool)


@st.composite
def recordings(draw: st.DrawFn) -> Recording:
    def clock() -> np.ndarray:
        return np.array(sorted(draw(st.lists(finite(1e9), min_size=1, max_size=6, unique=True))))

    def names() -> tuple[str, ...]:
        return tuple(draw(st.lists(NAME, min_size=1, max_size=3, unique=True)))

    joints = None
    if draw(st.booleans()):
        t, joint_names = clock(), names()
        shape = (len(t), len(joint_names))
        channels: dict[str, Any] = {"position": draw(hnp.arrays(float, shape, elements=finite(50.0)))}
        for channel in draw(st.sets(st.sampled_from(sorted(set(JOINT_CHANNELS) - {"position"})))):
            bound = 50.0 if channel == "position_command" else 1e300
            channels[channel] = draw(hnp.arrays(float, shape, elements=finite(bound)))
        std = draw(st.none() | st.floats(0, 1e9) | hnp.arrays(float, shape[1], elements=st.floats(0, 1e9)))
        joints = JointGroup(
            joint_names, t, **channels, effort_std=std, clock=draw(st.sampled_from(["recorded", "nominal"]))
        )
    suffixes = draw(st.sets(st.sampled_from(["", "_camera", "_arm", "_\u00e9 2"]), min_size=0 if joints else 1))
    points = []
    for suffix in sorted(suffixes):
        t, point_names = clock(), names()
        position = draw(hnp.arrays(float, (len(t), len(point_names), 3), elements=finite(50.0)))
        position[draw(hnp.arrays(bool, position.shape[:2]))] = np.nan
        std = draw(st.none() | hnp.arrays(float, position.shape, elements=st.floats(0, 1e9)))
        pose = draw(st.none() | finite(10.0).map(turned))
        points.append(PointGroup(f"points{suffix}", point_names, t, position, std, draw(TEXT), draw(TEXT), pose))
    truth = draw(st.dictionaries(st.text(), finite(1e300), max_size=3))
    return Recording(joints, tuple(points), draw(TEXT), draw(TEXT), truth=truth)


@given(recordings())
def test_any_valid_recording_survives_the_file(recording: Recording) -> None:
    validate(recording)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.h5"
        write_recording(recording, path)
        again = read_recording(path)
    by_name = sorted(recording.points, key=lambda group: group.name.encode())
    assert_same(again, dataclasses.replace(recording, points=tuple(by_name)))


@given(st.lists(finite(1e6), min_size=2, max_size=20, unique=True), finite(1e6), finite(1e6))
def test_a_slice_holds_just_the_times_in_between(times: list[float], one: float, other: float) -> None:
    t, start, stop = np.array(sorted(times)), min(one, other), max(one, other)
    recording = Recording(JointGroup(("a",), t, np.zeros((len(t), 1))))
    expected = t[(t >= start - 1e-9) & (t <= stop + 1e-9)]
    if start == stop or not len(expected):
        with pytest.raises(DataError):
            recording.slice(start, stop)
    else:
        part = recording.slice(start, stop)
        assert part.joints is not None
        assert np.array_equal(part.joints.t, expected)


def test_nan_effort_is_written_and_read_on_request(tmp_path: Path) -> None:
    recording = with_joints(effort=changed(Q, (2, 0), np.nan))
    write_recording(recording, tmp_path / "run.h5")
    with pytest.raises(DataError, match="'effort'") as caught:
        read_recording(tmp_path / "run.h5")
    assert "allow_nan_effort" in caught.value.hint
    assert_same(read_recording(tmp_path / "run.h5", allow_nan_effort=True), recording)


def test_missing_file_and_folder(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no such file"):
        read_recording(tmp_path / "absent.h5")
    with pytest.raises(DataError, match="not an HDF5 file"):
        read_recording(tmp_path)


def test_other_contents(tmp_path: Path) -> None:
    for contents in (b"", b"t,q_a\n0,1\n"):
        (tmp_path / "run.h5").write_bytes(contents)
        with pytest.raises(DataError, match="not an HDF5 file"):
            read_recording(tmp_path / "run.h5")


@pytest.mark.parametrize("share", [0.05, 0.3, 0.6, 0.9, 0.999])
def test_truncated_file(file: Path, share: float) -> None:
    contents = file.read_bytes()
    file.write_bytes(contents[: int(share * len(contents))])
    with pytest.raises(DataError, match="truncated or damaged") as caught:
        read_recording(file)
    assert caught.value.where == str(file)


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="the superuser may read everything")
def test_unreadable_file(file: Path) -> None:
    file.chmod(0)
    with pytest.raises(DataError, match="cannot be read"):
        read_recording(file)


def rename(file: h5py.File, old: str, new: str) -> None:
    file.move(old, new)


def set_names(file: h5py.File, names: Any) -> None:
    file["joints"].attrs["names"] = names


MALFORMED: dict[str, tuple[Callable[[h5py.File], object], str, str]] = {
    "no format": (lambda f: f.attrs.pop("format"), "does not say its format", ""),
    "other format": (lambda f: f.attrs.modify("format", "yid-recording/2"), "'yid-recording/2'", ""),
    "format no text": (lambda f: f.attrs.create("format", 1), "found", ""),
    "format not UTF-8": (lambda f: f.attrs.create("format", np.bytes_(b"\xff\xfe")), "not UTF-8", ""),
    "group": (lambda f: rename(f, "joints", "joint"), "no group 'joint'", "did you mean 'joints'"),
    "dataset at the top": (lambda f: f.create_dataset("points", data=[1.0]), "'points' is not a group", ""),
    "dataset": (lambda f: rename(f, "joints/effort", "joints/efort"), "no dataset 'efort'", "did you mean 'effort'"),
    "dataset of points": (lambda f: rename(f, "points_arm/position", "points_arm/xyz"), "no dataset 'xyz'", "known:"),
    "attribute": (lambda f: f["joints"].attrs.create("effrt_std", 1.0), "no attribute 'effrt_std'", "'effort_std'"),
    "no t": (lambda f: f["joints"].__delitem__("t"), "dataset 't' is missing", ""),
    "no position": (lambda f: f["points_arm"].__delitem__("position"), "dataset 'position' is missing", ""),
    "no names": (lambda f: f["joints"].attrs.pop("names"), "attribute 'names' is missing", ""),
    "no sensor": (lambda f: f["points_arm"].attrs.pop("sensor"), "attribute 'sensor' is missing", ""),
    "no frame": (lambda f: f["points_arm"].attrs.pop("frame"), "attribute 'frame' is missing", ""),
    "names no text": (lambda f: set_names(f, [1, 2]), "found 1", ""),
    "names empty": (lambda f: set_names(f, h5py.Empty("S1")), "cannot be used", ""),
    "clock": (lambda f: f["joints"].attrs.modify("clock", "wall"), "the clock is 'wall'", ""),
    "unit of position": (lambda f: f["joints/position"].attrs.modify("unit", "deg"), "'deg'", "never converted"),
    "unit of points": (
        lambda f: f["points_arm/position"].attrs.modify("unit", "mm"),
        "'mm'",
        "convert the values to m:",
    ),
    "unit of t": (lambda f: f["joints/t"].attrs.modify("unit", "ms"), "'ms'", "convert the values to s:"),
    "group for dataset": (lambda f: [f["joints"].pop("effort"), f.create_group("joints/effort")], "not a dataset", ""),
    "text for numbers": (
        lambda f: [f["joints"].pop("effort"), f["joints"].create_dataset("effort", data=b"many")],
        "not a dataset of real numbers",
        "",
    ),
    "std twice": (lambda f: f["points_camera"].attrs.create("std", 1.0), "both a dataset and an attribute", ""),
    "std no number": (lambda f: f["joints"].attrs.create("position_std", "small"), "not an array of real", ""),
    "truth no JSON": (lambda f: f.attrs.modify("truth", "T1.bend = 3"), "not JSON", ""),
    "truth no object": (lambda f: f.attrs.modify("truth", "[3]"), "not an object", ""),
    "truth no number": (lambda f: f.attrs.modify("truth", '{"a": true}'), "'a' is True", ""),
    "contents": (lambda f: f["joints/t"].__setitem__(3, 0.0), "from index 2 to 3", "sort by time"),
}


@pytest.mark.parametrize("case", MALFORMED)
def test_malformed_files_are_refused(case: str, file: Path) -> None:
    damage, message, hint = MALFORMED[case]
    with h5py.File(file, "r+") as handle:
        damage(handle)
    with pytest.raises(DataError, match=message) as caught:
        read_recording(file)
    assert str(file) in caught.value.where
    assert hint in caught.value.hint


def test_files_of_other_tools(file: Path) -> None:
    """MATLAB and C write byte strings, scalars and integers where h5py writes text, arrays and floats."""
    with h5py.File(file, "r+") as handle:
        handle.attrs["format"] = np.bytes_("yid-recording/1")
        handle.attrs["description"] = h5py.Empty("S1")
        handle.attrs["operator"] = "free notes on the file are nobody's business"
        set_names(handle, np.array([b"a", b"b"]))
        del handle["joints/effort"], handle["points_camera/std"]
        handle["joints"].create_dataset("effort", data=np.ones((50, 2), dtype=np.int32))
        handle["points_camera"].create_dataset("std", data=0.02)
        handle["points_arm"].attrs["names"] = "w_T2"
        handle["points_arm"].attrs["std"] = 0.03
        handle["points_arm"].attrs["clock"] = np.array(["nominal"], dtype=h5py.string_dtype())
        del handle["joints"].attrs["clock"], handle["joints/t"].attrs["unit"]
    recording = read_recording(file)
    assert recording.joint_names == ("a", "b")
    assert recording.description == ""
    assert recording.joints is not None
    assert recording.joints.clock == "recorded"
    assert recording.joints.effort is not None
    assert recording.joints.effort.dtype == np.float64
    arm, camera = recording.points
    assert arm.names == ("w_T2",)
    assert arm.clock == "nominal"
    assert arm.std is not None
    assert camera.std is not None
    assert (arm.std[0, 0, 0], camera.std.shape) == (0.03, (4, 3, 3))


# -------------------------------------------------------------------------------------------------------- writing


def test_unwritable_places(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "absent" / "run.h5", tmp_path / "file" / "run.h5"):
        with pytest.raises(OutputError, match="folder to write to does not exist"):
            write_recording(example(), path)
    with pytest.raises(OutputError, match="that of a folder"):
        write_recording(example(), tmp_path)


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="the superuser may write everywhere")
def test_a_folder_without_permission(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(OutputError, match="Permission denied"):
        write_recording(example(), tmp_path / "run.h5")


def test_a_failure_leaves_the_old_file_alone(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = file.read_bytes()

    def refuse(source: object, target: object) -> None:
        raise PermissionError(13, "no")

    monkeypatch.setattr(os, "replace", refuse)
    with pytest.raises(OutputError, match="Permission denied"):
        write_recording(example().slice(0.0, 0.1), file)
    assert [entry.name for entry in file.parent.iterdir()] == ["run.h5"]
    assert file.read_bytes() == before


# ------------------------------------------------------------------------------------------------- real recordings


# joints and points of the recordings in each folder
REAL_SIZES = {"baxter": (7, 0), "deft": (0, 20), "double_pendulum": (2, 0), "panda_beam": (7, 0), "soft_beam": (0, 6)}


@pytest.mark.skipif(
    not REAL_FILES, reason="the real recordings are not here (folder shared/recordings beside the project)"
)
def test_the_real_recordings_are_all_there() -> None:
    assert {path.parent.name for path in REAL_FILES} == set(REAL_SIZES)


@pytest.mark.parametrize(
    "path",
    REAL_FILES
    or [
        pytest.param(
            Path(),
            marks=pytest.mark.skip(reason="the real recordings are not here (shared/recordings beside the project)"),
        )
    ],
    ids=lambda path: path.stem,
)
def test_real_recordings_read(path: Path, tmp_path: Path) -> None:
    recording = read_recording(path)
    assert (len(recording.joint_names), len(recording.point_names)) == REAL_SIZES[path.parent.name]
    assert 4.0 < recording.duration < 60.0
    assert recording.source
    write_recording(recording, tmp_path / "copy.h5")
    assert_same(read_recording(tmp_path / "copy.h5"), recording)
