import json
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recording_examples import joints_of, refused

from yid_ocp.data.readers import preview_file, read_any
from yid_ocp.errors import DataError

NAMES = ["shoulder_pan.pos", "elbow_flex.pos", "gripper.pos"]
PATHS = {
    "v2.0": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
    "v2.1": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
    "v3.0": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
}
FIRST = "data/chunk-000/episode_000000.parquet"


def write_dataset(folder: Path, version: str, names: Any = NAMES, **more: Any) -> Path:
    """Two episodes of four frames at 30 Hz; degrees 100 * episode + 10 * frame + joint, actions one degree more."""
    pyarrow: Any = pytest.importorskip("pyarrow", reason="LeRobot needs pyarrow: pip install '.[lerobot]'")
    from pyarrow import parquet

    shape = {"dtype": "float32", "shape": [3], "names": names}
    features = {
        "action": shape,
        "observation.state": shape,
        "observation.images.top": {"dtype": "video", "shape": [480, 640, 3], "names": ["height", "width", "channel"]},
        **{name: {"dtype": "int64", "shape": [1], "names": None} for name in ("frame_index", "episode_index", "index")},
    }
    info = {"codebase_version": version, "fps": 30, "features": features, "total_episodes": 2, "robot_type": "so101"}
    info |= {"data_path": PATHS.get(version, ""), "chunks_size": 1000} | more
    (folder / "meta").mkdir(parents=True)
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    tables = []
    for episode in range(2):
        state = 100.0 * episode + 10.0 * np.arange(4)[:, None] + np.arange(3)
        columns = {"observation.state": state.tolist(), "action": (state + 1).tolist()}
        tables.append(pyarrow.table({**columns, "frame_index": list(range(4)), "episode_index": [episode] * 4}))
    chunk = folder / "data" / "chunk-000"
    chunk.mkdir(parents=True)
    if version == "v3.0":
        parquet.write_table(pyarrow.concat_tables(tables), chunk / "file-000.parquet")
    else:
        for episode, table in enumerate(tables):
            parquet.write_table(table, chunk / f"episode_{episode:06d}.parquet")
    return folder


@pytest.mark.parametrize("version", PATHS)
def test_state_and_action_of_an_episode(version: str, tmp_path: Path) -> None:
    path = write_dataset(tmp_path / "arm", version)
    units = {"position": "deg", "position_command": "deg"}
    recording = read_any(path, episode=1, joints=["elbow_flex=elbow", "shoulder_pan"], units=units)
    joints = joints_of(recording)
    assert (joints.names, joints.clock) == (("elbow", "shoulder_pan"), "nominal")
    assert np.allclose(joints.t, np.arange(4) / 30)
    assert np.allclose(joints.position, np.radians([[101, 100], [111, 110], [121, 120], [131, 130]]))
    assert np.allclose(joints.values_by_channel["position_command"] - joints.position, math.radians(1))
    assert all(fact in recording.notes[0] for fact in ("observation.images.top", "left out", "video"))
    assert (recording.name, recording.source) == ("arm_000001", "arm, episode 1")


@pytest.mark.parametrize("names", [{"motors": ["a", "b", "c"]}, None], ids=["by kind", "none"])
def test_names_of_older_datasets(names: Any, tmp_path: Path) -> None:
    path = write_dataset(tmp_path / "arm", "v2.0", names)
    expected = ("a", "b", "c") if names else ("joint_0", "joint_1", "joint_2")
    assert read_any(path, units={"position": "deg", "position_command": "deg"}).joint_names == expected


def test_velocities_and_currents_among_the_state(tmp_path: Path) -> None:
    path = write_dataset(tmp_path / "arm", "v3.0", ["a.pos", "a.vel", "a.current"])
    units = {"position": "deg", "position_command": "deg", "effort": "mA"}
    joints = joints_of(read_any(path, units=units, torque_constants={"a": 2.0}, gear_ratios={"a": 100.0}))
    assert joints.names == ("a",)
    assert np.array_equal(joints.values_by_channel["velocity"][:, 0], [1, 11, 21, 31])
    assert np.allclose(joints.values_by_channel["effort"][:, 0], 0.2 * np.array([2, 12, 22, 32]))


def test_the_preview_asks_for_a_unit_that_could_be_two_and_numbers_of_frames_are_no_joints(tmp_path: Path) -> None:
    path = write_dataset(tmp_path / "arm", "v3.0")
    contents = preview_file(path)
    assert "units" not in contents.reader_options
    assert "2 episodes at 30 Hz, v3.0, recorded on so101" in contents.notes[0]
    by_name = {source.name: source for source in contents.sources}
    assert by_name["action"].imported_as == "position_command"
    assert not by_name["observation.images.top"].imported_as
    assert by_name["observation.state"].imported_as == "joints shoulder_pan, elbow_flex"
    assert all(fact in by_name["observation.state"].note for fact in ("without gripper", "0 to 100 %"))
    assert by_name["frame_index"].imported_as == "t"
    assert not by_name["index"].imported_as
    assert "-100 to 100" in refused(path, "unit of the joint positions is unknown", **contents.reader_options).hint
    options = {**contents.reader_options, "units": {"position": "deg", "position_command": "deg"}}
    assert read_any(path, **options).joint_names == ("shoulder_pan", "elbow_flex")
    # per cent are no degrees: of all joints the gripper is left out, and not taken if it is named
    made = read_any(path, **options | {"joints": None})
    assert (made.joint_names, made.notes[-1][:22]) == (("shoulder_pan", "elbow_flex"), "gripper was left out (")
    assert joints_of(made).values_by_channel["position_command"].shape == (4, 2)
    refused(path, "no joint 'gripper'", **options | {"joints": ["gripper=jaw", "elbow_flex"]})


@pytest.mark.parametrize(
    ("robot", "scale", "asked"),
    [("panda", 0.01, False), ("panda", 1.0, True), ("so100_follower", 0.01, True), ("koch", 0.01, True)],
)
def test_small_numbers_are_radians_unless_the_robot_never_records_them(
    robot: str, scale: float, asked: bool, tmp_path: Path
) -> None:
    """Normalised units of a small motion lie where radians do: LeRobot's own arms are always asked."""
    from pyarrow import parquet

    path = write_dataset(tmp_path / "arm", "v3.0", robot_type=robot)
    file = path / "data/chunk-000/file-000.parquet"
    table = parquet.read_table(file)
    for name in ("observation.state", "action"):
        values = [[scale * x for x in row] for row in table[name].to_pylist()]
        table = table.set_column(table.schema.get_field_index(name), name, [values])
    parquet.write_table(table, file)
    if asked:
        assert ("position=rad" in refused(path, "unit of the joint positions is unknown").allowed) == (robot == "panda")
        recording = read_any(path, units={"position": "rad", "position_command": "rad"})
    else:
        recording = read_any(path)
    assert joints_of(recording).position[1, 0] == pytest.approx(10 * scale)


@pytest.mark.parametrize(
    ("more", "options", "message"),
    [
        ({}, {"episode": 2}, "there is no episode 2"),
        ({}, {"episode": -1}, "there is no episode -1"),
        ({"total_episodes": 9}, {"episode": 5}, "no file of the dataset has episode 5"),
        ({"codebase_version": "v1.6"}, {}, "has the version v1.6"),
        ({"fps": 0}, {}, "fps is 0, which is not allowed"),
        ({"fps": "fast"}, {}, 'fps is "fast", which is not allowed'),
        ({"features": {"action": {}}}, {}, "no observation.state"),
        ({}, {"joints": ["elbow"], "units": {"position": "deg"}}, "no joint 'elbow'"),
        ({}, {"episode": 1}, "unit of the joint positions is unknown; the largest absolute value is 131"),
    ],
    ids=["beyond", "negative", "lost", "version", "rate", "text", "state", "joint", "degrees"],
)
def test_datasets_that_are_refused(more: Any, options: Any, message: str, tmp_path: Path) -> None:
    assert "arm" in refused(write_dataset(tmp_path / "arm", "v3.0", **more), message, **options).where


@pytest.mark.parametrize(
    "more",
    [
        {"data_path": "{episode_index.foo}"}, {"data_path": "{episode_index:>9999999999}"},
        {"data_path": "{episode_index!r}{episode_index"}, {"data_path": "../{episode_index:06d}.parquet"},
        {"chunks_size": 0.5}, {"chunks_size": math.inf}, {"features": "text"}, {"features": None},
        {"features": {"observation.state": ["a"]}}, {"fps": math.nan}, {"total_episodes": "many"},
    ],
    ids=lambda more: str(*more.values())[:30],
)  # fmt: skip
def test_metadata_of_other_types_is_refused(more: Any, tmp_path: Path) -> None:
    path = write_dataset(tmp_path / "arm", "v2.1", **more)
    for read in (read_any, preview_file):
        with pytest.raises(DataError) as caught:
            read(path)
        assert "info.json" in caught.value.where


@pytest.mark.parametrize("column", [["a", "b"], [None, None], [[1], [1, 2]]], ids=["text", "nothing", "lists"])
def test_frame_numbers_that_are_none_are_refused(column: list[Any], tmp_path: Path) -> None:
    path = write_dataset(tmp_path / "arm", "v2.1")
    import pyarrow
    from pyarrow import parquet

    table = {"observation.state": [[1.0, 2, 3]] * 2, "action": [[1.0, 2, 3]] * 2, "episode_index": [0, 0]}
    parquet.write_table(pyarrow.table({**table, "frame_index": column}), path / FIRST)
    with pytest.raises(DataError):
        read_any(path)


@pytest.mark.parametrize("name", ["frame_index", "observation.state", "action"])
def test_texts_that_unpack_to_very_many_bytes_are_refused_by_their_type(name: str, tmp_path: Path) -> None:
    """A dictionary of one long text makes gigabytes of some kilobytes, though it declares few values."""
    path = write_dataset(tmp_path / "arm", "v2.1")
    import pyarrow
    from pyarrow import parquet

    table = parquet.read_table(path / FIRST).to_pydict()
    text = pyarrow.DictionaryArray.from_arrays(pyarrow.array([0] * len(table[name])), ["x" * 1_000_000])
    parquet.write_table(pyarrow.table({**table, name: text}), path / FIRST, store_schema=False)
    refused(path, f"the column {name} contains string instead of numbers")


def test_a_table_too_large_or_damaged_and_a_missing_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_dataset(tmp_path / "arm", "v2.1")
    monkeypatch.setattr("yid_ocp.files.MAX_INPUT_NUMBERS", 30)  # four frames of eight numbers and three lists
    refused(path, "the file holds too many numbers")
    (path / FIRST).write_bytes(b"PAR1 and no more")
    refused(path, "table of the episode cannot be read")
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    assert refused(path, "needs pyarrow").hint == "pip install '.[lerobot]' in the project's clone"
