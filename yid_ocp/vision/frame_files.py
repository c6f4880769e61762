"""Reading and writing of files of one frame: clouds with or without colours, and depth images."""

from __future__ import annotations

import re
import warnings
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from yid_ocp.errors import DataError, OutputError
from yid_ocp.files import is_file
from yid_ocp.vision.frames import Colours, import_open3d
from yid_ocp.vision.ply_reader import read_ply_colours, read_ply_points

Array = NDArray[np.float64]

CLOUD_SUFFIXES = (".ply", ".pcd", ".npz", ".xyz")
DEPTH_IMAGE_SUFFIX = ".png"
_POINTS_ARRAY, _COLOURS_ARRAY = "points", "colours"
"""Arrays of an NPZ file."""

_HEAD = 10_000  # [bytes]; where a PCD file says how many points it has
_COUNT = re.compile(rb"^POINTS\s+(\d{1,18})\b", re.MULTILINE)
_LARGEST_DEPTH = 65.535  # [m]; what sixteen bits of millimetres hold
_AGAIN = "copy or record it again"


def read_cloud(path: Path) -> Array:
    """Points of a cloud, shape (N, 3), in the file's unit.

    Parameters
    ----------
    path : Path
        PLY; PCD; NPZ with the array `points`, shape (N, 3); or XYZ: text, a point a row, its first three columns.

    Raises
    ------
    DataError
        The file is missing, empty or damaged.
    """
    return read_ply_points(_there(path)) if path.suffix.lower() == ".ply" else _read(path)[0]


def read_colours(path: Path) -> Colours | None:
    """Red, green and blue of the points that `read_cloud` gives, shape (N, 3), None where the file has none.

    PLY: `red`, `green`, `blue`; PCD: `rgb`; NPZ: the array `colours`, shape (N, 3); XYZ: the fourth to sixth of six or
    more columns, from 0 to 255.

    Raises
    ------
    DataError
        As `read_cloud`.
    """
    return read_ply_colours(_there(path)) if path.suffix.lower() == ".ply" else _read(path)[1]


def _there(path: Path) -> Path:
    if not is_file(path):
        raise DataError("the file of the cloud is missing", where=str(path))
    return path


def _read(path: Path) -> tuple[Array, Colours | None]:
    match _there(path).suffix.lower():
        case ".npz":
            points, colours = _read_npz(path)
        case ".xyz":
            points, colours = _read_xyz(path)
        case _:
            points, colours = _read_pcd(path)
    if not len(points):
        raise DataError("the cloud is empty or cannot be read", where=str(path))
    return points, colours


def _read_npz(path: Path) -> tuple[Array, Colours | None]:
    allowed = f"the array `{_POINTS_ARRAY}` of numbers, shape (N, 3), and `{_COLOURS_ARRAY}` of whole numbers"
    allowed += " from 0 to 255 if wanted"
    try:
        with np.load(path, allow_pickle=False) as held:
            arrays: dict[str, Any] = {name: held[name] for name in (_POINTS_ARRAY, _COLOURS_ARRAY) if name in held}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, MemoryError) as error:
        raise DataError(f"the cloud is damaged ({error})", where=str(path), allowed=allowed, hint=_AGAIN) from error
    points, colours = arrays.get(_POINTS_ARRAY), arrays.get(_COLOURS_ARRAY)
    if points is None or points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind not in "fiu":
        raise DataError(f"the file has no array `{_POINTS_ARRAY}` of points", where=str(path), allowed=allowed)
    if colours is not None and (colours.shape != points.shape or colours.dtype != np.uint8):
        raise DataError(f"the array `{_COLOURS_ARRAY}` is no colour for every point", where=str(path), allowed=allowed)
    return points.astype(np.float64), colours


def _read_xyz(path: Path) -> tuple[Array, Colours | None]:
    try:
        with warnings.catch_warnings():  # of an empty file, which is said below
            warnings.simplefilter("ignore", UserWarning)
            rows = np.loadtxt(path, ndmin=2, comments=("#", "//"))
    except (OSError, ValueError, UnicodeDecodeError) as error:
        raise DataError(f"the cloud cannot be read ({error})", where=str(path), allowed="x y z in every row") from error
    if rows.shape[0] and rows.shape[1] < 3:
        raise DataError(f"the cloud has {rows.shape[1]} columns", where=str(path), allowed="x y z in every row")
    seen = rows[:, 3:6]
    coloured = seen.shape[1] == 3 and bool(((seen >= 0) & (seen <= 255) & (seen == np.rint(seen))).all())
    return rows[:, :3].copy(), seen.astype(np.uint8) if coloured else None


def _read_pcd(path: Path) -> tuple[Array, Colours | None]:
    o3d = import_open3d()
    with path.open("rb") as file:
        declared = _COUNT.search(file.read(_HEAD))
    if declared is not None and int(declared[1]) > path.stat().st_size:  # each takes several bytes
        what = f"the cloud is damaged: it declares {int(declared[1]):.3g} points in {path.stat().st_size} bytes"
        raise DataError(what, where=str(path), hint=_AGAIN)
    # Open3D says what is wrong on the standard output and returns an empty cloud
    try:
        with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
            cloud = o3d.io.read_point_cloud(str(path))
    except (MemoryError, RuntimeError) as error:
        what = f"the cloud is damaged: it declares more points than fit into memory ({error})"
        raise DataError(what, where=str(path), hint=_AGAIN) from error
    colours = np.rint(255 * np.asarray(cloud.colors)).astype(np.uint8) if cloud.has_colors() else None
    return np.asarray(cloud.points, dtype=np.float64), colours


def write_cloud(path: Path, points: Array) -> None:
    """Write a binary PLY file; `OutputError` where that cannot be."""
    o3d = import_open3d()
    # float32 keeps 0.2 um at 2 m in half the space
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(np.ascontiguousarray(points, dtype=np.float32)))
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        if not o3d.t.io.write_point_cloud(str(path), cloud):
            raise OutputError("the cloud cannot be written", where=str(path))


def read_depth_image(path: Path) -> Array:
    """A depth image in the file's unit, shape (height, width); `DataError` where it is no grey PNG of 16 bits."""
    o3d = import_open3d()
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


def write_depth_image(path: Path, depth: Array) -> None:
    """Write a depth image [m] as millimetres; `OutputError` where that cannot be."""
    o3d = import_open3d()
    good = np.isfinite(depth) & (depth > 0) & (depth < _LARGEST_DEPTH)
    image = np.where(good, np.rint(1e3 * np.where(good, depth, 0.0)), 0.0).astype(np.uint16)
    if not o3d.io.write_image(str(path), o3d.geometry.Image(np.ascontiguousarray(image))):
        raise OutputError("the depth image cannot be written", where=str(path))
