"""Frames on disk and their files, lenses, and what hides what."""

import contextlib
import json
import shutil
from dataclasses import asdict

import numpy as np
import pytest
from smooth_rods import frames_of

from yid_ocp.errors import DataError
from yid_ocp.vision import CameraIntrinsics, FrameSequence, look_at_pose, write_frame_folder
from yid_ocp.vision.frame_reading import read_frames
from yid_ocp.vision.frames import XTION_INTRINSICS, OcclusionMap

CLOUD = np.array([[0.1, -0.2, 2.0], [0.0, 0.3, 1.5], [-0.4, 0.1, 2.25]])
POSE = look_at_pose([2.0, 0.5, 0.3], [0.0, 0.0, 0.0])


@pytest.fixture
def folder(tmp_path):
    write_frame_folder(frames_of([0.5, 0.9], [CLOUD, CLOUD[:2]], POSE), tmp_path / "sequence")
    with pytest.raises(DataError, match=r"no points(.|\n)*frame 0"):
        write_frame_folder(frames_of([0.5], [CLOUD[:0]], POSE), tmp_path / "empty")
    return tmp_path / "sequence"


def changed(folder, **entries):
    head = json.loads((folder / "camera.json").read_text())
    head |= entries
    (folder / "camera.json").write_text(json.dumps({key: value for key, value in head.items() if value is not None}))


def test_depth_to_cloud_of_a_camera_of_58_degrees_and_another():
    xtion = XTION_INTRINSICS
    left, right = xtion.pixel_rays_at_unit_depth[240, 0], xtion.pixel_rays_at_unit_depth[240, -1]
    cosine = left @ right / np.linalg.norm(left) / np.linalg.norm(right)
    assert np.degrees(np.arccos(cosine)) == pytest.approx(58.0, abs=0.2)
    assert (xtion.width, xtion.height) == (640, 480)
    camera = CameraIntrinsics(4, 3, 2.0, 4.0, 1.0, 1.0)
    depth = np.full((3, 4), np.nan)
    depth[2, 3], depth[0, 0] = 2.0, 0.0
    assert np.allclose(camera.points_from_depth(depth), [[2.0, 0.5, 2.0]])
    with pytest.raises(DataError, match="shape"):
        camera.points_from_depth(np.ones((4, 3)))


def test_a_sequence_survives_the_disk(folder):
    assert np.allclose(np.linalg.inv(POSE) @ [0, 0, 0, 1], [0, 0, np.linalg.norm([2.0, 0.5, 0.3]), 1])
    assert POSE[2, 1] < 0  # y points down
    sequence = read_frames(folder)
    assert np.array_equal(sequence.stamps, [0.5, 0.9])
    assert np.allclose(sequence.camera_pose, POSE)
    assert np.allclose(sequence.load_cloud(0), CLOUD, atol=1e-6)
    assert np.allclose(sequence.load_cloud(1), CLOUD[:2], atol=1e-6)
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
        ("a.npz", lambda file: np.savez(file, dots=CLOUD), "`points` is missing"),
        ("a.npz", lambda file: np.savez(file, points=CLOUD[:, :2]), r"shape \(3, 2\), not numbers"),
        ("a.npz", lambda file: np.savez(file, points=np.array([{}])), "damaged"),
        ("a.npz", lambda file: np.savez(file, points=CLOUD, colours=COLOURS[:2]), r"has type uint8 and shape \(2, 3\)"),
        ("a.npz", lambda file: file.write_bytes(b"PK nonsense"), "damaged"),
        ("a.xyz", lambda file: file.write_text("1 2\n3 4\n"), "has 2 columns"),
        ("a.xyz", lambda file: file.write_text("1 2 here\n"), "is not a table of numbers x y z .*here"),
        ("a.xyz", lambda file: file.write_text("# nothing\n"), "has no points"),
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
    changed(folder, intrinsics={**asdict(again.intrinsics), "coefficients": ["far"]})
    with pytest.raises(DataError, match="no list of numbers"):
        read_frames(folder)
    changed(folder, intrinsics=None)
    with pytest.raises(DataError, match="intrinsics of the camera are missing"):
        read_frames(folder)


def test_units_and_frames_of_clouds(folder):
    (folder / "timestamps.csv").write_text("\ufeff" + (folder / "timestamps.csv").read_text())  # as Excel saves it
    changed(folder, unit="mm")
    assert np.allclose(read_frames(folder).load_cloud(0), 1e-3 * CLOUD)
    assert np.allclose(read_frames(folder, unit="m").load_cloud(0), CLOUD, atol=1e-6)
    changed(folder, unit="m", frame="world")
    assert np.allclose(read_frames(folder).load_cloud(0) @ POSE[:3, :3].T + POSE[:3, 3], CLOUD, atol=1e-6)


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"pose": None}, "pose of the camera is missing"),
        ({"pose": [[1, 0], [0, 1]]}, "not a rigid transform"),
        ({"pose": (2 * np.eye(4)).tolist()}, "not a rigid transform"),
        ({"pose": "north"}, "not a matrix"),
        ({"unit": "cm"}, "no unit 'cm'"),
        ({"frame": "base"}, "no coordinate frame 'base'"),
        ({"posse": 1}, "there is no key 'posse'"),
        ({"format": "yid-frames/7"}, "format of the frames"),
        ({"intrinsics": {"width": 3}}, "missing .cx, cy, fx, fy, height."),
        ({"depth_unit": -1}, "depth_unit is -1"),
    ],
)
def test_what_is_wrong_with_the_camera_is_said(folder, entries, message):
    changed(folder, **entries)
    with pytest.raises(DataError, match=message) as caught:
        read_frames(folder)
    assert "camera.json" in caught.value.where


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "file of time stamps does not exist"),
        ("file,t\n", "time stamps has no rows"),
        ("name,time\n000000.ply,1\n", "the columns are"),
        ("file,t\n000000.ply,noon\n", "the time is 'noon'"),
        ("file,t\n000000.stl,1\n", "neither a cloud nor a depth image"),
    ],
)
def test_what_is_wrong_with_the_stamps_is_said(folder, text, message):
    (folder / "timestamps.csv").unlink()
    if text is not None:
        (folder / "timestamps.csv").write_text(text)
    with pytest.raises(DataError, match=message):
        read_frames(folder)


def test_broken_files_fail_when_loaded(folder, capfd):
    (folder / "000000.ply").write_bytes(b"ply\nformat nonsense")
    (folder / "000001.ply").unlink()
    sequence = read_frames(folder)
    with pytest.raises(DataError, match="it has no header"):
        sequence.load_cloud(0)
    with pytest.raises(DataError, match="no such file"):
        sequence.load_cloud(1)
    assert "ply" not in capfd.readouterr().out.lower()
    shutil.rmtree(folder)
    with pytest.raises(DataError, match="no such file or folder"):
        read_frames(folder)


VERTICES = np.random.default_rng(0).normal(size=(7, 3))
COLUMNS = [("red", "u1"), ("x", "f4"), ("nx", "f8"), ("y", "f4"), ("z", "f4")]
NAMES = {"u1": "uchar", "f4": "float", "f8": "double", "i2": "short"}


def ply_head(form: str, count: object = 7, before: str = "") -> bytes:
    rows = "".join(f"property {NAMES[kind]} {name}\n" for name, kind in COLUMNS)
    return f"ply\nformat {form} 1.0\ncomment made\n{before}element vertex {count}\n{rows}end_header\n".encode()


def ply_body(order: str) -> bytes:
    rows = np.zeros(7, [(name, order + kind) for name, kind in COLUMNS])
    for axis, column in zip("xyz", VERTICES.T, strict=True):
        rows[axis] = column
    return rows.tobytes()


TEXT = "".join(f"255 {x:.9g} 0.5 {y:.9g} {z:.9g}\n" for x, y, z in VERTICES).encode()
FACES = b"element face 1\nproperty list uchar int vertex_indices\n"
CAMERA = "element camera 2\nproperty short view\n"
SOUND = {
    "little": ply_head("binary_little_endian") + ply_body("<"),
    "big": ply_head("binary_big_endian") + ply_body(">"),
    "text": ply_head("ascii") + TEXT,
    "text without a last newline": ply_head("ascii") + TEXT[:-1],
    "windows": (ply_head("ascii") + TEXT).replace(b"\n", b"\r\n"),
    "another element before": ply_head("binary_little_endian", before=CAMERA) + b"\x01\x00\x02\x00" + ply_body("<"),
    "the same as text": ply_head("ascii", before=CAMERA) + b"1\n2\n" + TEXT,
    "a comment longer than any buffer": (ply_head("ascii") + TEXT).replace(b"made", b"made" + b"9" * 5000),
    "faces after": ply_head("ascii").replace(b"end_header", FACES + b"end_header") + TEXT + b"3 0 1 2\n",
}


@pytest.fixture(scope="module")
def read(tmp_path_factory):
    """The points of a file with some bytes."""
    folder = tmp_path_factory.mktemp("frames")
    write_frame_folder(frames_of([0.0], [VERTICES], np.eye(4)), folder)
    sequence = read_frames(folder)

    def points(data):
        (folder / sequence.frame_names[0]).write_bytes(data)
        return sequence.load_cloud(0)

    return points


@pytest.mark.parametrize("kind", SOUND)
def test_points_are_read(read, kind):
    assert np.allclose(read(SOUND[kind]), VERTICES, atol=1e-6)


WRONG = {
    "no ply": (b"plx\n", "has no header"),
    "no end": (ply_head("ascii")[:-12], "has no header"),
    "no format": (ply_head("ascii").replace(b"format ascii 1.0\n", b"") + TEXT, "its header has no format"),
    "another format": (ply_head("ascii").replace(b"ascii", b"utf") + TEXT, "line 2 .*: 'format utf 1.0'"),
    "another type": (ply_head("ascii").replace(b"float", b"flaot", 1) + TEXT, "header is no .*: 'property flaot x'"),
    "no z": (ply_head("ascii").replace(b"float z", b"float w") + TEXT, "w, .*need x, y and z"),
    "two of a name": (ply_head("ascii").replace(b"double nx", b"double x") + TEXT, "each property once"),
    "lists before": (ply_head("ascii", before=FACES.decode()) + TEXT, r"lists \('face'\)"),
    "too many": (ply_head("binary_little_endian", 3_000_000_000) + ply_body("<"), "for 3000000000 points"),
    "negative": (ply_head("ascii", -1) + TEXT, "element vertex -1"),
    "none": (ply_head("ascii", 0), "states 0 vertices"),
    "cut": (SOUND["little"][:-5], "for 7 points"),
    "cut by one byte": (SOUND["little"][:-1], "for 7 points"),
    "cut text": (ply_head("ascii") + TEXT[:90], "needs numbers for|of the 7 points|cut off"),
    "words": (ply_head("ascii") + TEXT.replace(b"0.5", b"0.5 one", 1), r"\(point \d\) is .* one .*, but needs numbers"),
}


@pytest.mark.parametrize("kind", WRONG)
def test_damage_is_said(read, kind):
    data, message = WRONG[kind]
    with pytest.raises(DataError, match=message):
        read(data)


def test_whatever_is_damaged_is_read_or_refused(read):
    rng = np.random.default_rng(1)
    for data in SOUND.values():
        for _ in range(100):
            made = bytearray(data)
            for at in rng.integers(len(made), size=3):
                made[at] = int(rng.integers(256))
            with contextlib.suppress(DataError):
                assert read(bytes(made)).shape[1] == 3


SIZE = 64, 48, 60.0, 61.0, 31.0, 24.5
LENSES = {
    "none": CameraIntrinsics(*SIZE),
    "plumb_bob": CameraIntrinsics(*SIZE, "plumb_bob", (-0.25, 0.08, 1e-3, -2e-3, 0.01)),
    "four": CameraIntrinsics(*SIZE, "plumb_bob", (0.1, -0.05, 1e-3, 2e-3)),
    "rational": CameraIntrinsics(*SIZE, "rational_polynomial", (0.5, 0.1, 1e-3, -1e-3, 0, 0.6, 0.2, 0)),
    "equidistant": CameraIntrinsics(64, 48, 30.0, 30.0, 31.0, 24.5, "equidistant", (0.02, -0.01, 0.003, 0.0)),
}


def pixels(lens, points):
    """Where points (..., 3) before a camera appear."""
    x, y = lens._distort(points[..., 0] / points[..., 2], points[..., 1] / points[..., 2])
    return np.stack([lens.fx * x + lens.cx, lens.fy * y + lens.cy], axis=-1)


@pytest.mark.parametrize("name", LENSES)
def test_a_ray_appears_at_its_pixel(name):
    u, v = np.meshgrid(np.arange(64), np.arange(48))
    assert np.abs(pixels(LENSES[name], LENSES[name].pixel_rays_at_unit_depth) - np.stack([u, v], axis=-1)).max() < 2e-3


def test_the_formula_of_ros():
    """Worked out by hand for one point: r^2 = 0.05, and the equidistant angle."""
    point = np.array([0.4, 0.2, 2.0])
    x, y, square = 0.2, 0.1, 0.05
    k1, k2, p1, p2, k3 = (-0.25, 0.08, 1e-3, -2e-3, 0.01)
    factor = 1 + k1 * square + k2 * square**2 + k3 * square**3
    u = 60 * (x * factor + 2 * p1 * x * y + p2 * (square + 2 * x**2)) + 31.0
    v = 61 * (y * factor + p1 * (square + 2 * y**2) + 2 * p2 * x * y) + 24.5
    assert np.allclose(pixels(LENSES["plumb_bob"], point), [u, v])
    angle = np.arctan(np.sqrt(square))
    bent = angle + 0.02 * angle**3 - 0.01 * angle**5 + 0.003 * angle**7
    expected = 30 * bent / np.sqrt(square) * np.array([x, y]) + [31.0, 24.5]
    assert np.allclose(pixels(LENSES["equidistant"], point), expected)


def test_pixels_that_a_lens_does_not_have_are_no_points():
    """A barrel that turns back: its corners have no direction."""
    lens = CameraIntrinsics(64, 48, 30.0, 30.0, 31.5, 23.5, "plumb_bob", (-0.6, 0.0, 0.0, 0.0))
    assert np.isnan(lens.pixel_rays_at_unit_depth[0, 0]).any()
    cloud = lens.points_from_depth(np.ones((48, 64)))
    assert np.isfinite(cloud).all()
    assert len(cloud) < 48 * 64


@pytest.mark.parametrize(
    ("model", "coefficients", "message"),
    [
        ("inverse_brown", (0.1, 0, 0, 0, 0), "the distortion model 'inverse_brown' is unknown"),
        ("plumb_bob", (0.1, 0.2), "has the coefficients"),
        ("equidistant", (np.nan, 0, 0, 0), "has the coefficients"),
    ],
)
def test_unknown_distortions_are_refused(model, coefficients, message):
    with pytest.raises(DataError, match=message):
        CameraIntrinsics(64, 48, 60.0, 60.0, 32.0, 24.0, model, coefficients)
    assert not CameraIntrinsics(64, 48, 60.0, 60.0, 32.0, 24.0, model, (0.0,) * 5).has_distortion


HOME = np.eye(4)  # at the origin, looking along z
PLACE, RADIUS = np.array([[0.0, 0.0, 2.0]]), np.array([0.02])


def patch(centre, size, step=0.004):
    """Points of an upright square."""
    across = np.arange(-size / 2, size / 2, step)
    x, y = np.meshgrid(across, across)
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]) + centre


@pytest.mark.parametrize(
    ("points", "hidden"),
    [
        (patch([0.0, 0.0, 3.0], 1.0), False),  # looked through, on what is behind
        (patch([0.0, 0.0, 1.0], 0.1), True),  # something before it
        (patch([0.0, 0.0, 1.99], 0.1), False),  # its own surface
        (patch([0.4, 0.0, 3.0], 0.1), False),  # nothing in that direction
        (patch([-0.04, 0.0, 1.0], 0.05), True),  # in the shadow of something beside the line of sight
        (patch([-0.2, 0.0, 1.0], 0.05), False),  # too far beside it for a shadow
        (patch([-0.072, 0.0, 0.4], 0.02), True),  # the nearer it is, the further its shadow falls
    ],
)
def test_a_place_without_points_is_hidden_or_empty(points, hidden):
    assert OcclusionMap(points, HOME).occluded_position_mask(PLACE, RADIUS, 0.01).tolist() == [hidden]
    # what is expected to be asked about saves work and changes nothing
    for expected in (PLACE, PLACE + 0.3, np.empty((0, 3))):
        view = OcclusionMap(points, HOME, expected_points=expected)
        assert view.occluded_position_mask(PLACE, RADIUS, 0.01).tolist() == [hidden]


def test_nothing_is_seen_beside_the_picture_which_ends_where_points_stand_along_its_side():
    camera = CameraIntrinsics(320, 240, 300.0, 300.0, 159.5, 119.5)
    behind = patch([0.0, 0.0, 4.0], 1.0)
    places = np.array([[0.0, 0.0, 2.0], [1.2, 0.0, 2.0], [0.0, 0.0, -1.0]])
    found = OcclusionMap(behind, HOME, camera).occluded_position_mask(places, np.full(3, 0.02), 0.01)
    assert found.tolist() == [False, True, True]
    wall = patch([0.0, 0.0, 4.0], 2.0, 0.02)  # fills the picture, which is 0.5 wide in x/z
    places, radius = np.array([[0.2, 0.0, 2.0], [0.6, 0.0, 2.0]]), np.full(2, 0.02)
    assert OcclusionMap(wall, HOME).occluded_position_mask(places, radius, 0.01).tolist() == [False, True]
    # a cloud of the object alone has no such side: what is missing beside it is missing
    rod = np.column_stack([np.linspace(-0.2, 0.2, 200), np.zeros(200), np.full(200, 2.0)])
    assert OcclusionMap(rod, HOME).occluded_position_mask(places, radius, 0.01).tolist() == [False, False]
