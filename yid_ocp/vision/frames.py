"""Frames of a depth camera: clouds with time stamps, the camera's pose, and their folder on disk (`yid-frames/1`)."""

from __future__ import annotations

import csv
import ctypes
import json
import math
import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from yid_ocp.errors import DataError, OutputError, choices
from yid_ocp.files import is_file, new_file
from yid_ocp.vision.ply import read_ply

Array = NDArray[np.float64]

FORMAT = "yid-frames/1"
CAMERA_FILE, STAMP_FILE = "camera.json", "timestamps.csv"
CLOUD_ENDINGS = (".ply", ".pcd")
DEPTH_ENDING = ".png"
UNITS: Mapping[str, float] = {"m": 1.0, "mm": 1e-3}
"""Units in which a folder's clouds may be, and their size in metres."""

_KEYS = ("format", "pose", "frame", "unit", "intrinsics", "depth_unit", "description")
_HEAD = 10_000  # [bytes]; where a PCD file says how many points it has
_COUNT = re.compile(rb"^POINTS\s+(\d{1,18})\b", re.MULTILINE)
_LARGEST_DEPTH = 65.535  # [m]; what sixteen bits of millimetres hold


@cache
def open3d_module() -> ModuleType:
    """The open3d package; `DataError` where it is not installed or cannot be loaded."""
    hint = "pip install 'yid-ocp[vision]'"
    try:
        # the wheel of open3d wants the system's libusb, which a bare machine does not have
        import libusb_package

        ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    except (ImportError, OSError):
        pass  # the system may have its own
    try:
        import open3d
    except (ImportError, OSError) as error:
        raise DataError(f"vision needs Open3D, which cannot be loaded ({error})", hint=hint) from error
    return open3d


@dataclass(frozen=True)
class Pinhole:
    """Intrinsics of a camera without distortion (x right, y down, z ahead).

    Attributes
    ----------
    width, height : int
        [pixels]
    fx, fy, cx, cy : float
        Focal lengths and principal point [pixels]:  u = fx x/z + cx,  v = fy y/z + cy.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    @staticmethod
    def of_view(width: int, height: int, horizontal: float) -> Pinhole:
        """Square pixels, the principal point in the middle, and a horizontal angle of view [rad]."""
        focal = 0.5 * width / math.tan(0.5 * horizontal)
        return Pinhole(width, height, focal, focal, 0.5 * (width - 1), 0.5 * (height - 1))

    @property
    def rays(self) -> Array:
        """Direction of every pixel with z = 1, shape (height, width, 3)."""
        u, v = np.meshgrid(np.arange(self.width), np.arange(self.height))
        return np.stack([(u - self.cx) / self.fx, (v - self.cy) / self.fy, np.ones(u.shape)], axis=-1)

    def cloud(self, depth: ArrayLike) -> Array:
        """Points of a depth image in the camera's frame.

        Parameters
        ----------
        depth : array_like, shape (height, width)
            Distance along the optical axis [m]; zero or NaN where nothing was measured.

        Returns
        -------
        ndarray, shape (N, 3)
            [m], row by row.

        Raises
        ------
        DataError
            An image of another size.
        """
        image = np.asarray(depth, float)
        if image.shape != (self.height, self.width):
            raise DataError(f"the depth image has shape {image.shape}", allowed=f"({self.height}, {self.width})")
        seen = np.isfinite(image) & (image > 0)
        return np.asarray(self.rays[seen] * image[seen][:, None])


XTION = Pinhole.of_view(640, 480, math.radians(58.0))
"""The depth camera of the Asus Xtion Pro Live: 640 x 480 pixels, 58 degrees wide."""


@dataclass(frozen=True, eq=False)
class FrameSequence:
    """Clouds of one camera, loaded one at a time.

    Attributes
    ----------
    t : ndarray, shape (M,)
        Time stamps as the camera gave them, in the order of the frames: neither sorted nor unique [s].
    names : tuple of str
    pose : ndarray, shape (4, 4)
        Camera (x right, y down, z ahead) in the world [m].
    load : callable
        From a frame's index to its cloud in the camera's frame, shape (N, 3) [m]; `DataError` where it cannot be read.
    intrinsics : Pinhole, optional
    source : str
        Where the frames come from, for messages.
    """

    t: Array
    names: tuple[str, ...]
    pose: Array
    load: Callable[[int], Array]
    intrinsics: Pinhole | None = None
    source: str = "sequence"

    def __len__(self) -> int:
        return len(self.names)

    def world(self, index: int) -> Array:
        """Cloud of a frame in the world, shape (N, 3) [m]; `DataError` where it cannot be read."""
        return self.load(index) @ self.pose[:3, :3].T + self.pose[:3, 3]

    def select(self, indices: Sequence[int]) -> FrameSequence:
        """The frame sequence with only these frames, in this order."""
        kept = [int(i) for i in indices]
        names, source = tuple(self.names[i] for i in kept), self.source
        return FrameSequence(self.t[kept], names, self.pose, lambda i: self.load(kept[i]), self.intrinsics, source)

    @staticmethod
    def of(t: ArrayLike, clouds: Sequence[ArrayLike], pose: ArrayLike, *, source: str = "sequence") -> FrameSequence:
        """A frame sequence of clouds that are in memory.

        Parameters
        ----------
        t : array_like, shape (M,)
            [s]
        clouds : sequence of array_like, each (N, 3)
            In the camera's frame [m].
        pose : array_like, shape (4, 4)
            Camera in the world.
        source : str
        """
        arrays = [np.asarray(cloud, float).reshape(-1, 3) for cloud in clouds]
        names = tuple(f"frame {i}" for i in range(len(arrays)))
        return FrameSequence(np.asarray(t, float), names, checked_pose(pose, source), arrays.__getitem__, None, source)


def look_at(eye: ArrayLike, target: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0)) -> Array:
    """Pose of a camera (x right, y down, z ahead) at `eye` that looks at `target`, shape (4, 4) [m]."""
    position = np.asarray(eye, float)
    ahead = np.asarray(target, float) - position
    ahead = ahead / np.linalg.norm(ahead)
    right = np.cross(ahead, np.asarray(up, float))
    right = right / np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([right, np.cross(ahead, right), ahead])
    pose[:3, 3] = position
    return pose


def checked_pose(pose: ArrayLike | None, where: str) -> Array:
    """A camera's pose as an array; `DataError` where it is missing or not a rigid transform."""
    hint = "give the camera in the world as a 4x4 matrix, x right, y down, z ahead, translation in metres"
    if pose is None:
        raise DataError("the pose of the camera is missing", where=where, hint=hint)
    try:
        matrix = np.asarray(pose, float)
    except (TypeError, ValueError) as error:
        raise DataError("the pose of the camera is not a matrix of numbers", where=where, hint=hint) from error
    good = matrix.shape == (4, 4) and bool(np.isfinite(matrix).all())
    if good:
        rotation = matrix[:3, :3]
        good = bool(np.allclose(rotation.T @ rotation, np.eye(3), atol=1e-4) and np.linalg.det(rotation) > 0)
        good = good and bool(np.allclose(matrix[3], [0, 0, 0, 1]))
    if not good:
        raise DataError("the pose of the camera is not a rigid transform", where=where, allowed="4x4", hint=hint)
    return matrix


# -- the folder -------------------------------------------------------------------------------------------------------


def read_frames(
    folder: str | os.PathLike[str], *, pose: ArrayLike | None = None, unit: str | None = None
) -> FrameSequence:
    """Open a folder of clouds or depth images.

    The folder holds `camera.json` (`yid-frames/1`: `pose` 4x4, `frame` "camera" or "world" of the clouds, `unit` "m" or
    "mm" of the clouds, `intrinsics` and `depth_unit` [m] of depth images), `timestamps.csv` (columns `file`, `t` [s])
    and the files that it names: PLY or PCD clouds, or 16-bit PNG depth images. Clouds are read when they are needed.

    Parameters
    ----------
    folder : path-like
    pose : array_like, shape (4, 4), optional
        Camera in the world, instead of the folder's.
    unit : str, optional
        Unit of the clouds, instead of the folder's.

    Returns
    -------
    FrameSequence

    Raises
    ------
    DataError
        No such folder, no time stamps, no pose, an unknown key or unit, depth images without intrinsics.
    """
    path = Path(folder)
    if not path.is_dir():
        raise DataError("there is no such folder of frames", where=str(path), hint="check the path")
    head = _read_camera(path / CAMERA_FILE)
    where = str(path / CAMERA_FILE)
    camera = checked_pose(head.get("pose") if pose is None else pose, where)
    given = str(unit or head.get("unit", "m"))
    if given not in UNITS:
        raise DataError(f"the unit is '{given}'", where=where, **choices(given, UNITS))
    frame = head.get("frame", "camera")
    if frame not in ("camera", "world"):
        raise DataError(f"the frame of the clouds is '{frame}'", where=where, allowed="camera, world")
    intrinsics = _intrinsics(head.get("intrinsics"), where)
    names, times = _read_stamps(path / STAMP_FILE)
    _check_kinds(names, path, intrinsics)
    depth_unit = _number(head.get("depth_unit", 1e-3), "depth_unit", where)

    def load(index: int) -> Array:
        file = path / names[index]
        if file.suffix.lower() == DEPTH_ENDING:
            assert intrinsics is not None
            return intrinsics.cloud(_read_depth(file) * depth_unit)
        points = _read_cloud(file) * UNITS[given]
        if frame == "world":
            points = (points - camera[:3, 3]) @ camera[:3, :3]
        return points

    return FrameSequence(times, names, camera, load, intrinsics, str(path))


def write_frames(
    sequence: FrameSequence, folder: str | os.PathLike[str], *, depth: Sequence[ArrayLike] | None = None
) -> None:
    """Write a frame sequence as a folder that `read_frames` reads: binary PLY clouds, or depth images in millimetres.

    Parameters
    ----------
    sequence : FrameSequence
    folder : path-like
        Made where it does not exist.
    depth : sequence of array_like, each (height, width), optional
        Depth images [m] to write instead of clouds; the frame sequence must have intrinsics.

    Raises
    ------
    OutputError
        The folder or a file cannot be written, or images without intrinsics.
    """
    path = Path(folder)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"the folder cannot be made: {error.strerror}", where=str(path)) from error
    if depth is not None and sequence.intrinsics is None:
        raise OutputError("depth images need the camera's intrinsics", where=str(path))
    ending = CLOUD_ENDINGS[0] if depth is None else DEPTH_ENDING
    names = [f"{i:06d}{ending}" for i in range(len(sequence))]
    for i, name in enumerate(names):
        if depth is None:
            _write_cloud(path / name, sequence.load(i))
        else:
            _write_depth(path / name, np.asarray(depth[i], float))
    head: dict[str, Any] = {"format": FORMAT, "pose": sequence.pose.tolist(), "frame": "camera", "unit": "m"}
    if sequence.intrinsics is not None:
        head["intrinsics"] = asdict(sequence.intrinsics)
        head["depth_unit"] = 1e-3
    with new_file(path / CAMERA_FILE) as temporary:
        temporary.write_text(json.dumps(head, indent=1) + "\n", encoding="utf-8")
    with new_file(path / STAMP_FILE) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["file", "t"])
        writer.writerows([name, repr(float(t))] for name, t in zip(names, sequence.t, strict=True))


def _read_camera(path: Path) -> dict[str, Any]:
    try:
        head = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, RecursionError) as error:  # not UTF-8, not JSON, numbers of thousands of digits
        raise DataError(f"the camera's file cannot be read ({error})", where=str(path), allowed="JSON") from error
    if not isinstance(head, dict):
        raise DataError("the camera's file is not an object", where=str(path), allowed='{"pose": ..., ...}')
    for key in head:
        if key not in _KEYS:
            raise DataError(f"unknown key '{key}'", where=str(path), **choices(key, _KEYS))
    if head.get("format", FORMAT) != FORMAT:
        raise DataError(f"the format of the frames is '{head['format']}'", where=str(path), allowed=FORMAT)
    return head


def _check_kinds(names: Sequence[str], folder: Path, intrinsics: Pinhole | None) -> None:
    for name in names:
        kind = Path(name).suffix.lower()
        if kind not in (*CLOUD_ENDINGS, DEPTH_ENDING):
            what, allowed = f"'{name}' is neither a cloud nor a depth image", ", ".join((*CLOUD_ENDINGS, DEPTH_ENDING))
            raise DataError(what, where=str(folder / STAMP_FILE), allowed=allowed)
        if kind == DEPTH_ENDING and intrinsics is None:
            raise DataError(
                "there are depth images but the camera's intrinsics are missing",
                where=str(folder / CAMERA_FILE),
                hint="add `intrinsics` with width, height, fx, fy, cx, cy [pixels]",
            )


def _intrinsics(entry: object, where: str) -> Pinhole | None:
    if entry is None:
        return None
    known = [f.name for f in fields(Pinhole)]
    if not isinstance(entry, dict) or sorted(entry) != sorted(known):
        raise DataError("the intrinsics are not complete", where=where, allowed=", ".join(known))
    values = {name: _number(entry[name], f"intrinsics.{name}", where) for name in known}
    return Pinhole(int(values["width"]), int(values["height"]), *(values[name] for name in known[2:]))


def _number(value: object, name: str, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value) or value <= 0:
        raise DataError(f"{name} is {value!r}", where=where, allowed="a positive number")
    return float(value)


def _read_stamps(path: Path) -> tuple[tuple[str, ...], Array]:
    allowed = "CSV with the columns file, t [s]"
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
    except FileNotFoundError as error:
        raise DataError("the frames have no time stamps", where=str(path), allowed=allowed) from error
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise DataError(f"the time stamps cannot be read ({error})", where=str(path), allowed=allowed) from error
    if not rows:
        raise DataError("there is no frame", where=str(path), allowed=allowed)
    if not {"file", "t"} <= set(rows[0]):
        raise DataError(f"the columns are {', '.join(map(str, rows[0]))}", where=str(path), allowed=allowed)
    names, times = [], []
    for number, row in enumerate(rows, start=2):
        try:
            times.append(float(row["t"]))
        except (TypeError, ValueError) as error:
            raise DataError(
                f"the time is {row['t']!r}", where=f"{path}, line {number}", allowed="seconds, as a number"
            ) from error
        names.append(str(row["file"]))
    return tuple(names), np.array(times)


def _read_cloud(path: Path) -> Array:
    if not is_file(path):
        raise DataError("the file of the cloud is missing", where=str(path))
    if path.suffix.lower() == ".ply":
        return read_ply(path)
    o3d = open3d_module()
    with path.open("rb") as file:
        declared = _COUNT.search(file.read(_HEAD))
    if declared is not None and int(declared[1]) > path.stat().st_size:  # each takes several bytes
        what = f"the cloud is damaged: it declares {int(declared[1]):.3g} points in {path.stat().st_size} bytes"
        raise DataError(what, where=str(path), hint="copy or record it again")
    # Open3D says what is wrong on the standard output and returns an empty cloud
    try:
        with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
            cloud = o3d.io.read_point_cloud(str(path))
    except (MemoryError, RuntimeError) as error:
        what = f"the cloud is damaged: it declares more points than fit into memory ({error})"
        raise DataError(what, where=str(path), hint="copy or record it again") from error
    points = np.asarray(cloud.points, dtype=np.float64)
    if not len(points):
        raise DataError("the cloud is empty or cannot be read", where=str(path))
    return points


def _write_cloud(path: Path, points: Array) -> None:
    o3d = open3d_module()
    # float32 keeps 0.2 um at 2 m in half the space
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(np.ascontiguousarray(points, dtype=np.float32)))
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        if not o3d.t.io.write_point_cloud(str(path), cloud):
            raise OutputError("the cloud cannot be written", where=str(path))


def _read_depth(path: Path) -> Array:
    o3d = open3d_module()
    if not is_file(path):
        raise DataError("the file of the depth image is missing", where=str(path))
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        image = np.asarray(o3d.io.read_image(str(path)))
    if image.ndim != 2 or image.dtype != np.uint16:
        raise DataError(
            "the depth image is empty, damaged or not one channel of 16 bits",
            where=str(path),
            allowed="16-bit grey PNG",
        )
    return image.astype(np.float64)


def _write_depth(path: Path, depth: Array) -> None:
    o3d = open3d_module()
    good = np.isfinite(depth) & (depth > 0) & (depth < _LARGEST_DEPTH)
    image = np.where(good, np.rint(1e3 * np.where(good, depth, 0.0)), 0.0).astype(np.uint16)
    if not o3d.io.write_image(str(path), o3d.geometry.Image(np.ascontiguousarray(image))):
        raise OutputError("the depth image cannot be written", where=str(path))
