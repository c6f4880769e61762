from __future__ import annotations

import dataclasses
import os
import signal
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from recording_examples import assert_same, changed, example, finite, joints_of, refused, turned, with_joints

from yid_ocp.data import recording_hdf5
from yid_ocp.data.recording import JOINT_CHANNEL_UNITS, JointGroup, PointGroup, Recording, validated_recording
from yid_ocp.data.recording_hdf5 import open_hdf5_after_read_check, read_recording, write_recording
from yid_ocp.errors import DataError, OutputError

ROOT = Path(__file__).parents[2]
REAL_FOLDER = ROOT.parent / "shared" / "recordings"
REAL_FILES = sorted(REAL_FOLDER.glob("*/*.h5"))


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "run.h5"
    write_recording(example(), path)
    return path


# -------------------------------------------------------------------------------------------------------- the file


def test_positions_of_the_straight_object_survive_the_file(tmp_path: Path) -> None:
    recording = dataclasses.replace(example(), marker_reference_pose=np.array([[0.1, 0.2, 0.3]]))
    write_recording(recording, tmp_path / "run.h5")
    assert_same(read_recording(tmp_path / "run.h5"), recording)
    with h5py.File(tmp_path / "run.h5") as handle:
        assert handle["straight"].attrs["unit"] == "m"


def test_writing_is_reproducible(file: Path, tmp_path: Path) -> None:
    write_recording(read_recording(file), tmp_path / "again.h5")
    assert read_recording(tmp_path / "again.h5").sha256 == read_recording(file).sha256


TEXT = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]))
NAME = st.text(st.characters(exclude_categories=["Cs", "Cc"]), min_size=1)


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
        for channel in draw(st.sets(st.sampled_from(sorted(set(JOINT_CHANNEL_UNITS) - {"position"})))):
            if JOINT_CHANNEL_UNITS[channel] == "1":
                channels[channel] = draw(hnp.arrays(float, shape, elements=st.sampled_from([0.0, 1.0])))
                continue
            bound = {"rad": 50.0, "rad/s": 1e6, "N m": 1e9}[JOINT_CHANNEL_UNITS[channel]]
            channels[channel] = draw(hnp.arrays(float, shape, elements=finite(bound)))
        std = st.none() | st.floats(0, 1e9) | hnp.arrays(float, shape[1], elements=st.floats(0, 1e9))
        kinds = st.sampled_from([None, "sample", "mean", "command"])
        own: dict[str, Any] = {"effort_std": draw(std), "effort_bias_std": draw(std), "effort_kind": draw(kinds)}
        joints = JointGroup(joint_names, t, **channels, **own, clock=draw(st.sampled_from(["recorded", "nominal"])))
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
    return Recording(joints, tuple(points), draw(TEXT), draw(TEXT), true_parameters=truth)


@given(recordings())
def test_any_valid_recording_survives_the_file(recording: Recording) -> None:
    validated_recording(recording)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.h5"
        write_recording(recording, path)
        again = read_recording(path)
    by_name = sorted(recording.points, key=lambda group: group.name.encode())
    assert_same(again, dataclasses.replace(recording, points=tuple(by_name)))


def test_nan_effort_is_written_and_read_on_request(tmp_path: Path) -> None:
    recording = with_joints(effort=changed(joints_of(example()).position, (2, 0), np.nan))
    write_recording(recording, tmp_path / "run.h5")
    assert "allow_nan_effort" in refused(tmp_path / "run.h5", "'effort'", read_recording).hint
    assert_same(read_recording(tmp_path / "run.h5", allow_nan_effort=True), recording)


def test_files_that_are_none(tmp_path: Path) -> None:
    refused(tmp_path / "absent.h5", "no such file", read_recording)
    (tmp_path / "empty.h5").write_bytes(b"")
    (tmp_path / "text.h5").write_bytes(b"t,q_a\n0,1\n")
    for name, advice in ((".", "yid-ocp import"), ("empty.h5", "its usual ending"), ("text.h5", "its usual ending")):
        assert advice in refused(tmp_path / name, "not an HDF5 file", read_recording).hint


@pytest.mark.parametrize("share", [0.05, 0.3, 0.6, 0.9, 0.999])
def test_truncated_file(file: Path, share: float) -> None:
    contents = file.read_bytes()
    file.write_bytes(contents[: int(share * len(contents))])
    assert refused(file, "truncated or damaged", read_recording).where == str(file)


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="the superuser may read everything")
def test_unreadable_file(file: Path) -> None:
    file.chmod(0)
    refused(file, "cannot be read", read_recording)


def set_names(file: h5py.File, names: Any) -> None:
    file["joints"].attrs["names"] = names


def straight(file: h5py.File, rows: int = 1, unit: str = "m") -> h5py.File:
    """Add positions of a straight object, of as many points as `points_arm` has when there is one row."""
    file.create_dataset("straight", data=np.zeros((rows, 3))).attrs["unit"] = unit
    return file


MALFORMED: dict[str, tuple[Callable[[h5py.File], object], str, str]] = {
    "no format": (lambda f: f.attrs.pop("format"), "the file has no format", ""),
    "other format": (lambda f: f.attrs.modify("format", "yid-recording/2"), "'yid-recording/2'", ""),
    "format no text": (lambda f: f.attrs.create("format", 1), "the value 1 is not text", ""),
    "format not UTF-8": (lambda f: f.attrs.create("format", np.bytes_(b"\xff\xfe")), "not UTF-8", ""),
    "group": (lambda f: f.move("joints", "joint"), "unknown group, 'joint'", "did you mean 'joints'"),
    "dataset at the top": (lambda f: f.create_dataset("points", data=[1.0]), "'points' is a dataset, but must be", ""),
    "dataset": (lambda f: f.move("joints/effort", "joints/efort"), "unknown dataset, 'efort'", "did you mean 'effort'"),
    "dataset of points": (lambda f: f.move("points_arm/position", "points_arm/xyz"), "unknown dataset, 'xyz'", ""),
    "attribute": (lambda f: f["joints"].attrs.create("effrt_std", 1.0), "unknown attribute, 'effrt_std'", "effort_std"),
    "no t": (lambda f: f["joints"].__delitem__("t"), "dataset 't' is missing", ""),
    "no position": (lambda f: f["points_arm"].__delitem__("position"), "dataset 'position' is missing", ""),
    "no names": (lambda f: f["joints"].attrs.pop("names"), "attribute 'names' is missing", ""),
    "no sensor": (lambda f: f["points_arm"].attrs.pop("sensor"), "attribute 'sensor' is missing", ""),
    "no frame": (lambda f: f["points_arm"].attrs.pop("frame"), "attribute 'frame' is missing", ""),
    "names no text": (lambda f: set_names(f, [1, 2]), "the value 1 is not text", ""),
    "names empty": (lambda f: set_names(f, h5py.Empty("S1")), "cannot be used", ""),
    "clock": (lambda f: f["joints"].attrs.modify("clock", "wall"), "the clock is 'wall'", ""),
    "kind of effort": (lambda f: f["joints"].attrs.modify("effort_kind", "mean of"), "'mean of'", "leave the"),
    "kind no text": (lambda f: f["joints"].attrs.create("effort_kind", 2.0), "the value 2.0 is not text", ""),
    "unit of position": (lambda f: f["joints/position"].attrs.modify("unit", "deg"), "'deg'", "never converted"),
    "unit of points": (lambda f: f["points_arm/position"].attrs.modify("unit", "mm"), "'mm'", "convert the values"),
    "unit of t": (lambda f: f["joints/t"].attrs.modify("unit", "ms"), "'ms'", "convert the values to s,"),
    "group for dataset": (lambda f: [f["joints"].pop("effort"), f.create_group("joints/effort")], "not a dataset", ""),
    "text for numbers": (lambda f: f.create_dataset("points_arm/std", data=b"many"), "not a dataset of real", ""),
    "std twice": (lambda f: f["points_camera"].attrs.create("std", 1.0), "both a dataset and an attribute", ""),
    "std no number": (lambda f: f["joints"].attrs.create("position_std", "small"), "not an array of numbers", ""),
    "truth no JSON": (lambda f: f.attrs.modify("truth", "T1.bend = 3"), "not JSON", ""),
    "truth no object": (lambda f: f.attrs.modify("truth", "[3]"), "not an object", ""),
    "truth no number": (lambda f: f.attrs.modify("truth", '{"a": true}'), "'a' is True", ""),
    "straight in millimetres": (lambda f: straight(f, unit="mm"), "'mm'", "convert the values to m,"),
    "straight a group": (lambda f: f.create_group("straight"), "not a dataset of real numbers", ""),
    "straight of too few": (lambda f: straight(f, rows=2), r"shape \(2, 3\)", ""),
    "another entry at the top": (lambda f: straight(f).move("straight", "straigt"), "'straigt'", "mean 'straight'"),
    "contents": (lambda f: f["joints/t"].__setitem__(3, 0.0), "from sample 3 to 4", "sort by time"),
}


@pytest.mark.parametrize("case", MALFORMED)
def test_malformed_files_are_refused(case: str, file: Path) -> None:
    damage, message, hint = MALFORMED[case]
    with h5py.File(file, "r+") as handle:
        damage(handle)
    error = refused(file, message, read_recording)
    assert str(file) in error.where
    assert hint in error.hint


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
    joints = joints_of(recording)
    assert (joints.names, joints.clock, recording.description) == (("a", "b"), "recorded", "")
    assert joints.values_by_channel["effort"].dtype == np.float64
    arm, camera = recording.points
    assert (arm.names, arm.clock) == (("w_T2",), "nominal")
    assert (np.asarray(arm.std)[0, 0, 0], np.shape(camera.std)) == (0.03, (4, 3, 3))


def test_a_recording_that_cannot_be_written_leaves_the_old_one(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = file.read_bytes()
    monkeypatch.setattr(os, "replace", Mock(side_effect=PermissionError(13, "no")))
    with pytest.raises(OutputError, match="Permission denied"):
        write_recording(example().time_slice(0.0, 0.1), file)
    assert [entry.name for entry in file.parent.iterdir()] == ["run.h5"]
    assert file.read_bytes() == before


# joints and points of the recordings in each folder
REAL_SIZES = {"baxter": (7, 0), "deft": (0, 20), "double_pendulum": (2, 0), "panda_beam": (7, 0), "soft_beam": (0, 6)}
REAL_SIZES["servo_pendulum"] = (1, 0)


@pytest.mark.skipif(not REAL_FILES, reason="the real recordings are not here (shared/recordings beside the project)")
@pytest.mark.parametrize("path", REAL_FILES or [Path()], ids=lambda path: path.stem)
def test_real_recordings_are_all_there_and_read(path: Path, tmp_path: Path) -> None:
    assert {path.parent.name for path in REAL_FILES} == set(REAL_SIZES)
    recording = read_recording(path)
    assert (len(recording.joint_names), len(recording.point_names)) == REAL_SIZES[path.parent.name]
    assert (recording.marker_reference_pose is not None) == (path.parent.name == "soft_beam")
    assert 1.9 < recording.duration < 60.0
    assert recording.source
    write_recording(recording, tmp_path / "copy.h5")
    assert_same(read_recording(tmp_path / "copy.h5"), recording)


needs_fork = pytest.mark.skipif(not hasattr(os, "fork"), reason="files are tried in forks")


@pytest.fixture
def plain_file(tmp_path):
    path = tmp_path / "file.h5"
    with recording_hdf5.create_hdf5_atomically(path) as new:
        new.attrs["format"] = "test"
        new.create_dataset("a/values", data=np.arange(3.0))
    return path


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no device without room")
def test_a_full_disk_is_an_error_and_not_the_end(tmp_path, monkeypatch):
    """The library would write when it closes the file, and end the process when it cannot."""
    monkeypatch.setattr("yid_ocp.files.secrets.token_hex", lambda _: "x")
    (tmp_path / ".full.h5.x.tmp").symlink_to("/dev/full")
    with (
        pytest.raises(OutputError, match="No space left"),
        recording_hdf5.create_hdf5_atomically(tmp_path / "full.h5") as new,
    ):
        new.create_dataset("a", data=np.zeros(1000))
    assert not (tmp_path / "full.h5").exists()


def virtual_values(data: h5py.File, other: Path) -> None:
    layout = h5py.VirtualLayout((1,), "f8")
    layout[:] = h5py.VirtualSource(other, "secret", (1,))
    data.create_virtual_dataset("a/more", layout)


PACKED = {"chunks": (1 << 20, 7), "compression": "gzip"}
OTHER_FILE = r"'more'.*another file"
UNREADABLE: dict[str, tuple[Callable[[h5py.File, Path], object], str]] = {
    "external link": (lambda f, o: f.__setitem__("a/more", h5py.ExternalLink(o.name, "secret")), OTHER_FILE),
    "external values": (lambda f, o: f.create_dataset("a/more", (1,), "f8", external=[(str(o), 0, 8)]), OTHER_FILE),
    "virtual values": (virtual_values, OTHER_FILE),
    "groups without end": (lambda f, o: f.__setitem__("a/self", f["a"]), "nested more than 10 levels deep"),
    # numbers of one byte each; as float64 with copies they are 27 GB
    "a bomb": (lambda f, o: f.create_dataset("b", (120_000_000, 7), "i1", **PACKED), "declares 840 million numbers"),
    "not there": (lambda f, o: f.create_dataset("b", (10**9,), "f8", chunks=(1000,)), "declares 1000 million numbers"),
}


@needs_fork
@pytest.mark.parametrize("kind", UNREADABLE)
def test_a_file_of_other_files_or_of_more_than_it_holds_is_refused(plain_file, tmp_path, kind):
    make, message = UNREADABLE[kind]
    with h5py.File(tmp_path / "other.h5", "w") as other, h5py.File(plain_file, "a") as data:
        other.create_dataset("secret", data=[1.0])
        make(data, tmp_path / "other.h5")
    assert plain_file.stat().st_size < 100_000
    with pytest.raises(DataError, match=message), open_hdf5_after_read_check(plain_file):
        pass


@needs_fork
@pytest.mark.skipif(not os.path.exists("/proc/self/statm"), reason="no /proc")
def test_the_trial_has_a_limit_on_its_memory(plain_file):
    def greedy(path):
        return f"took {len(bytearray(4 << 30))} bytes"

    with pytest.raises(DataError, match="the HDF5 library crashes") as caught:
        recording_hdf5.check_readable_in_child_process(plain_file, greedy, "HDF5")
    assert "took" not in caught.value.what


@needs_fork
@pytest.mark.parametrize(
    ("done", "said"), [(lambda: os.kill(os.getpid(), signal.SIGSEGV), "SIGSEGV"), (signal.pause, r"within 0\.3 s")]
)
def test_a_file_that_ends_the_library_or_never_ends_does_not_end_us(plain_file, monkeypatch, done, said):
    if done is signal.pause:
        monkeypatch.setattr(recording_hdf5, "_READ_TIMEOUT", 0.3)
    monkeypatch.setattr(h5py, "File", lambda *_: done())
    with pytest.raises(DataError, match=said), open_hdf5_after_read_check(plain_file):
        pass
