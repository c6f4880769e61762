from __future__ import annotations

import csv
import json
import shutil

import numpy as np
import pytest

from yid_ocp.errors import DataError
from yid_ocp.vision import (
    XTION_INTRINSICS,
    CameraIntrinsics,
    FrameSequence,
    look_at_pose,
    read_frames,
    write_frame_folder,
)

CLOUD = np.array([[0.1, -0.2, 2.0], [0.0, 0.3, 1.5], [-0.4, 0.1, 2.25]])
POSE = look_at_pose([2.0, 0.5, 0.3], [0.0, 0.0, 0.0])


@pytest.fixture
def folder(tmp_path):
    write_frame_folder(FrameSequence.from_clouds([0.5, 0.9], [CLOUD, CLOUD[:2]], POSE), tmp_path / "sequence")
    return tmp_path / "sequence"


def changed(folder, **entries):
    head = json.loads((folder / "camera.json").read_text())
    head |= entries
    (folder / "camera.json").write_text(json.dumps({key: value for key, value in head.items() if value is not None}))


def test_xtion_is_58_degrees_wide():
    left, right = XTION_INTRINSICS.pixel_rays[240, 0], XTION_INTRINSICS.pixel_rays[240, -1]
    cosine = left @ right / np.linalg.norm(left) / np.linalg.norm(right)
    assert np.degrees(np.arccos(cosine)) == pytest.approx(58.0, abs=0.2)
    assert (XTION_INTRINSICS.width, XTION_INTRINSICS.height) == (640, 480)


def test_depth_to_cloud():
    camera = CameraIntrinsics(4, 3, 2.0, 4.0, 1.0, 1.0)
    depth = np.full((3, 4), np.nan)
    depth[2, 3] = 2.0
    depth[0, 0] = 0.0
    assert np.allclose(camera.points_from_depth(depth), [[2.0, 0.5, 2.0]])
    with pytest.raises(DataError, match="shape"):
        camera.points_from_depth(np.ones((4, 3)))


def test_look_at_puts_the_target_ahead():
    assert np.allclose(np.linalg.inv(POSE) @ [0, 0, 0, 1], [0, 0, np.linalg.norm([2.0, 0.5, 0.3]), 1])
    assert POSE[2, 1] < 0  # y points down


def test_a_sequence_survives_the_disk(folder):
    sequence = read_frames(folder)
    assert np.array_equal(sequence.stamps, [0.5, 0.9])
    assert np.allclose(sequence.camera_pose, POSE)
    assert np.allclose(sequence.load_cloud(0), CLOUD, atol=1e-6)
    assert np.allclose(sequence.load_world_cloud(1), CLOUD[:2] @ POSE[:3, :3].T + POSE[:3, 3], atol=1e-6)
    assert sequence.frame_names == ("000000.ply", "000001.ply")


COLOURS = np.array([[255, 0, 7], [1, 2, 3], [9, 200, 0]], np.uint8)


@pytest.mark.parametrize("coloured", [True, False])
@pytest.mark.parametrize("ending", [".pcd", ".ply", ".npz", ".xyz"])
def test_formats_of_clouds(open3d, folder, ending, coloured):
    file = folder / f"other{ending}"
    if ending == ".npz":
        np.savez(file, points=CLOUD, **({"colours": COLOURS} if coloured else {}))
    elif ending == ".xyz":
        np.savetxt(file, np.hstack([CLOUD, COLOURS]) if coloured else CLOUD, header="made")
    else:
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(CLOUD))
        if coloured:
            cloud.colors = open3d.utility.Vector3dVector(COLOURS / 255)
        open3d.io.write_point_cloud(str(file), cloud)
    (folder / "timestamps.csv").write_text(f"file,t\nother{ending},3.5\n")
    sequence = read_frames(folder)
    assert np.allclose(sequence.load_cloud(0), CLOUD, atol=1e-6)
    assert np.array_equal(sequence.load_colours(0), COLOURS) if coloured else sequence.load_colours(0) is None


@pytest.mark.parametrize(
    ("name", "make", "message"),
    [
        ("a.npz", lambda file: np.savez(file, dots=CLOUD), "no array `points`"),
        ("a.npz", lambda file: np.savez(file, points=CLOUD[:, :2]), "no array `points`"),
        ("a.npz", lambda file: np.savez(file, points=np.array([{}])), "damaged"),
        ("a.npz", lambda file: np.savez(file, points=CLOUD, colours=COLOURS[:2]), "no colour for every point"),
        ("a.npz", lambda file: file.write_bytes(b"PK nonsense"), "damaged"),
        ("a.xyz", lambda file: file.write_text("1 2\n3 4\n"), "has 2 columns"),
        ("a.xyz", lambda file: file.write_text("1 2 here\n"), "cannot be read"),
        ("a.xyz", lambda file: file.write_text("# nothing\n"), "empty"),
    ],
)
def test_damaged_clouds_are_refused(folder, name, make, message):
    make(folder / name)
    (folder / "timestamps.csv").write_text(f"file,t\n{name},3.5\n")
    with pytest.raises(DataError, match=message):
        read_frames(folder).load_cloud(0)


@pytest.mark.parametrize("lens", [(), ("equidistant", (0.01, 0.0, 0.0, 0.0))])
def test_depth_images_and_their_lens(open3d, tmp_path, lens):
    camera, depth = CameraIntrinsics(8, 6, 10.0, 10.0, 3.5, 2.5, *lens), np.arange(1000, 1048).reshape(6, 8)
    depth[0, :3] = 0
    sequence = FrameSequence(np.array([0.1]), ("a",), POSE, lambda i: camera.points_from_depth(1e-3 * depth), camera)
    folder = tmp_path / "sequence"
    write_frame_folder(sequence, folder)
    open3d.io.write_image(str(folder / "a.png"), open3d.geometry.Image(depth.astype(np.uint16)))
    (folder / "timestamps.csv").write_text("file,t\na.png,0.1\n")
    again = read_frames(folder)
    assert again.intrinsics == camera
    assert np.allclose(again.load_cloud(0), sequence.load_cloud(0), atol=1e-9)
    changed(folder, intrinsics={**again.intrinsics.__dict__, "coefficients": ["far"]})
    with pytest.raises(DataError, match="coefficients are"):
        read_frames(folder)
    changed(folder, intrinsics=None)
    with pytest.raises(DataError, match="intrinsics are missing"):
        read_frames(folder)


def test_units_and_frames_of_clouds(folder):
    changed(folder, unit="mm")
    assert np.allclose(read_frames(folder).load_cloud(0), 1e-3 * CLOUD)
    assert np.allclose(read_frames(folder, unit="m").load_cloud(0), CLOUD, atol=1e-6)
    changed(folder, unit="m", frame="world")
    assert np.allclose(read_frames(folder).load_world_cloud(0), CLOUD, atol=1e-6)


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"pose": None}, "pose of the camera is missing"),
        ({"pose": [[1, 0], [0, 1]]}, "not a rigid transform"),
        ({"pose": (2 * np.eye(4)).tolist()}, "not a rigid transform"),
        ({"pose": "north"}, "not a matrix"),
        ({"unit": "cm"}, "unit is 'cm'"),
        ({"frame": "base"}, "frame of the clouds is 'base'"),
        ({"posse": 1}, "unknown key 'posse'"),
        ({"format": "yid-frames/7"}, "format of the frames"),
        ({"intrinsics": {"width": 3}}, "intrinsics are not complete"),
        ({"depth_unit": -1}, "depth_unit is -1"),
    ],
)
def test_what_is_wrong_with_the_camera_is_said(folder, entries, message):
    changed(folder, **entries)
    with pytest.raises(DataError, match=message) as caught:
        read_frames(folder)
    assert "camera.json" in caught.value.where


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (None, "no time stamps"),
        ([["file", "t"]], "no frame"),
        ([["name", "time"], ["000000.ply", "1"]], "the columns are"),
        ([["file", "t"], ["000000.ply", "noon"]], "the time is 'noon'"),
        ([["file", "t"], ["000000.stl", "1"]], "neither a cloud nor a depth image"),
    ],
)
def test_what_is_wrong_with_the_stamps_is_said(folder, rows, message):
    path = folder / "timestamps.csv"
    path.unlink()
    if rows is not None:
        with path.open("w", newline="") as file:
            csv.writer(file).writerows(rows)
    with pytest.raises(DataError, match=message):
        read_frames(folder)


def test_broken_files_fail_when_loaded(folder, capfd):
    (folder / "000000.ply").write_bytes(b"ply\nformat nonsense")
    (folder / "000001.ply").unlink()
    sequence = read_frames(folder)
    with pytest.raises(DataError, match="empty or cannot be read"):
        sequence.load_cloud(0)
    with pytest.raises(DataError, match="no such file"):
        sequence.load_cloud(1)
    assert "ply" not in capfd.readouterr().out.lower()
    shutil.rmtree(folder)
    with pytest.raises(DataError, match="no such folder"):
        read_frames(folder)
