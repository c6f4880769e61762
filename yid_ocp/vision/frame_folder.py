"""Functions that read and write folders of clouds or depth images with time stamps and camera data (`yid-frames/1`).

PLY files (Turk 1994, The PLY polygon file format) are read in Python: a damaged file must not end the process.
"""

from __future__ import annotations

import csv
import json
import math
import os
import re
import warnings
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from yid_ocp import files
from yid_ocp.arrays import Array
from yid_ocp.data.recording import raise_data_error_unless
from yid_ocp.errors import DataError, OutputError, require_known_names
from yid_ocp.vision import frames

_CLOUD_SUFFIXES = (".ply", ".pcd", ".npz", ".xyz")
_DEPTH_IMAGE_SUFFIX = ".png"
_POINTS_ARRAY, _COLOURS_ARRAY = "points", "colours"  # arrays of an NPZ file
_PCD_HEADER_BYTES = 10_000  # [bytes]; contain the number of points of a PCD file
_PCD_POINT_COUNT = re.compile(rb"^POINTS\s+(\d{1,18})\b", re.MULTILINE)
_MAX_FRAME_BYTES = 1 << 28  # largest size of one cloud or image
_Cloud = tuple[Array, frames.PointColourArray | None]
"""Points (N, 3) in the file's unit, and their red, green and blue (N, 3) or None."""


def _read_cloud(path: Path, coloured: bool = False) -> _Cloud:
    """The cloud in a file. The colours of a PLY file are read only if `coloured`."""
    files.check_input_file(path, _MAX_FRAME_BYTES)
    if path.suffix.lower() == ".ply":
        return _read_ply(path, coloured)
    points, colours = {".npz": _read_npz, ".xyz": _read_xyz, ".pcd": _read_pcd}[path.suffix.lower()](path)
    if not len(points):
        raise _damaged(path, "it has no points")
    return points, colours


def _read_npz(path: Path) -> _Cloud:
    allowed = f"`{_POINTS_ARRAY}`: numbers of shape (N, 3); optional `{_COLOURS_ARRAY}`: uint8 of shape (N, 3)"
    try:
        with zipfile.ZipFile(path) as packed:
            files.check_not_too_many_numbers(sum(entry.file_size for entry in packed.infolist()), str(path))
        with np.load(path, allow_pickle=False) as held:
            arrays: dict[str, Any] = {name: held[name] for name in (_POINTS_ARRAY, _COLOURS_ARRAY) if name in held}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, MemoryError) as error:
        raise _damaged(path, "it is damaged, or not an NPZ file") from error
    points, colours = arrays.get(_POINTS_ARRAY), arrays.get(_COLOURS_ARRAY)
    if points is None or points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind not in "fiu":
        found = "missing" if points is None else f"of type {points.dtype} and shape {points.shape}, not numbers (N, 3)"
        what, hint = f"the array `{_POINTS_ARRAY}` is {found}", "write it with numpy.savez(FILE, points=xyz)"
        raise DataError(what, where=str(path), allowed=allowed, hint=hint)
    if colours is not None and (colours.shape != points.shape or colours.dtype != np.uint8):
        what = f"the array `{_COLOURS_ARRAY}` has type {colours.dtype} and shape {colours.shape}"
        hint = f"write uint8 of shape {points.shape}, or leave `{_COLOURS_ARRAY}` out"
        raise DataError(what, where=str(path), allowed=allowed, hint=hint)
    return points.astype(np.float64), colours


def _read_xyz(path: Path) -> _Cloud:
    try:
        with warnings.catch_warnings():  # an empty file is reported below
            warnings.simplefilter("ignore", UserWarning)
            rows = np.loadtxt(path, ndmin=2, comments=("#", "//"))
    except (OSError, ValueError, UnicodeDecodeError) as error:
        raise _damaged(path, f"it is not a table of numbers x y z ({error})") from error
    if rows.shape[0] and rows.shape[1] < 3:
        raise _damaged(path, f"it has {rows.shape[1]} columns, but needs x, y and z")
    seen = rows[:, 3:6]
    coloured = seen.shape[1] == 3 and bool(((seen >= 0) & (seen <= 255) & (seen == np.rint(seen))).all())
    return rows[:, :3].copy(), seen.astype(np.uint8) if coloured else None


def _read_pcd(path: Path) -> _Cloud:
    o3d = frames.import_open3d()
    with path.open("rb") as file:
        declared = _PCD_POINT_COUNT.search(file.read(_PCD_HEADER_BYTES))
    if declared is not None and int(declared[1]) > path.stat().st_size:  # each takes several bytes
        raise _damaged(path, f"it is cut off and has only {path.stat().st_size} bytes for {int(declared[1])} points")
    # Open3D prints errors to standard output and returns an empty cloud
    try:
        with files.limit_process_memory(), o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
            cloud = o3d.io.read_point_cloud(str(path))
    except (MemoryError, RuntimeError) as error:
        raise _damaged(path, "its header announces more points than fit into memory") from error
    colours = np.rint(255 * np.asarray(cloud.colors)).astype(np.uint8) if cloud.has_colors() else None
    return np.asarray(cloud.points, dtype=np.float64), colours


def _read_depth_image(path: Path) -> Array:
    """A depth image (height, width) in the file's unit. `DataError` if it is not a grey 16-bit PNG."""
    o3d = frames.import_open3d()
    with files.check_input_file(path, _MAX_FRAME_BYTES).open("rb") as file:
        head = file.read(24)  # the last eight bytes are a PNG's width and height
    files.check_not_too_many_numbers(int.from_bytes(head[16:20], "big") * int.from_bytes(head[20:24], "big"), str(path))
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        image = np.asarray(o3d.io.read_image(str(path)))
    if image.ndim != 2 or image.dtype != np.uint16:
        what = f"the depth image has shape {image.shape}, type {image.dtype}" if image.size else "the image is damaged"
        raise DataError(what, where=str(path), allowed="16-bit grey PNG", hint="export it again as 16-bit grey PNG")
    return image.astype(np.float64)


_MAX_HEADER_BYTES = 100_000  # a longer head is none
_NUMPY_TYPES = {
    **{"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2"},
    **{"uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4"},
    **{"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"},
}
_AXIS_PROPERTIES, _COLOUR_PROPERTIES = ("x", "y", "z"), ("red", "green", "blue")
_BYTE_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_Element = tuple[str, int, list[tuple[str, str]]]
"""A table of a PLY file: name, number of rows, and columns by name and NumPy's name of their type ("" for a list)."""


def _read_ply(path: Path, coloured: bool) -> _Cloud:
    """Positions and colours of a PLY file's vertices. Other properties and later elements are ignored."""
    head, end, body = path.read_bytes().partition(b"end_header")
    line, _, body = body.partition(b"\n")
    if not end or len(head) > _MAX_HEADER_BYTES or line.strip() or not head.startswith(b"ply"):
        raise _damaged(path, "it has no header from 'ply' to 'end_header'")
    order, elements = _head(path, head.decode("latin-1"))
    for name, count, columns in elements:
        if name == "vertex":
            return _vertices(path, count, columns, order, body, coloured)
        if any(not kind for _, kind in columns):  # their length is unknown
            raise _damaged(path, f"it has lists ('{name}') before the vertices, so write the vertices first")
        if order:
            body = body[count * sum(np.dtype(kind).itemsize for _, kind in columns) :]
        else:
            body = b"\n".join(body.split(b"\n")[min(count, len(body)) :])
    raise _damaged(path, "its header has no line 'element vertex NUMBER', so it has no points")


def _damaged(path: Path, why: str) -> DataError:
    allowed = f"a complete {path.suffix} file with x, y and z of every point"
    hint = f"export the cloud again with x, y and z of every point, or remove its row from {STAMP_FILE}"
    return DataError(f"the point cloud cannot be used: {why}", where=str(path), allowed=allowed, hint=hint)


def _head(path: Path, text: str) -> tuple[str, list[_Element]]:
    """Byte order (empty for ASCII) and elements, in file order, that the header `text` of a PLY file declares."""
    order: str | None = None
    found: list[_Element] = []
    for number, line in enumerate(text.splitlines()[1:], start=2):
        match line.split():
            case [] | ["comment" | "obj_info", *_]:
                continue
            case ["format", name, _] if name in _BYTE_ORDERS:
                order = _BYTE_ORDERS[name]
            case ["element", name, count] if count.isascii() and count.isdigit() and len(count) <= 18:
                found.append((name, int(count), []))
            case ["property", "list", _, _, name] if found:
                found[-1][2].append((name, ""))
            case ["property", kind, name] if found and kind in _NUMPY_TYPES:
                found[-1][2].append((name, _NUMPY_TYPES[kind]))
            case _:
                raise _damaged(path, f"line {number} of its header is no known declaration: {line[:60]!r}")
    if order is None:
        raise _damaged(path, "its header has no format, such as the line 'format ascii 1.0'")
    return order, found


def _vertices(
    path: Path, count: int, columns: Sequence[tuple[str, str]], order: str, body: bytes, coloured: bool
) -> _Cloud:
    names, kinds = zip(*columns, strict=True) if columns else ((), ())
    if len(set(names)) < len(names) or not set(_AXIS_PROPERTIES) <= set(names) or "" in kinds:
        held = ", ".join(name if kind else f"{name} (a list)" for name, kind in columns) or "no properties"
        raise _damaged(path, f"its vertices have {held}, but need x, y and z, each property once, and no list")
    size = sum(np.dtype(kind).itemsize for kind in kinds) if order else 2 * len(names)
    if count * size > len(body) + (not order):  # the last line of a text may end without a newline
        raise _damaged(path, f"it is cut off and has only {len(body)} bytes for {count} points")
    if not count:
        raise _damaged(path, "its header states 0 vertices (points)")
    wanted = [*_AXIS_PROPERTIES, *(_COLOUR_PROPERTIES if coloured and set(_COLOUR_PROPERTIES) <= set(names) else ())]
    if order:
        rows = np.frombuffer(body, [(n, order + k) for n, k in columns], count)
        values = np.stack([rows[name].astype(np.float64) for name in wanted], axis=1)
    else:
        lines = [line.split() for line in body.split(b"\n", count)[:count]]
        values = np.empty((len(lines), len(wanted)))
        for i, row in enumerate(lines):
            try:
                values[i] = [float(row[names.index(name)]) for name in wanted]
            except (ValueError, IndexError) as error:
                whole = files.check_input_file(path, _MAX_FRAME_BYTES).read_bytes()
                at = whole.count(b"\n") - body.count(b"\n") + 1
                text, held = b" ".join(row)[:60].decode("latin-1"), ", ".join(names)
                what = f"line {at + i} (point {i + 1}) is '{text}', but needs numbers for {held}"
                raise _damaged(path, what) from error
    if len(values) < count:
        raise _damaged(path, f"it has only {len(values)} of the {count} points that its header states")
    return values[:, :3], values[:, 3:].astype(np.uint8) if len(wanted) > 3 else None


_FRAMES_FORMAT = "yid-frames/1"
_CAMERA_FILE, STAMP_FILE = "camera.json", "timestamps.csv"
_METRES_PER_UNIT: Mapping[str, float] = {"m": 1.0, "mm": 1e-3}
_CAMERA_FILE_KEYS = ("format", "pose", "frame", "unit", "intrinsics", "depth_unit", "description")


def read_frame_folder(
    folder: str | os.PathLike[str], *, pose: ArrayLike | None = None, unit: str | None = None
) -> frames.FrameSequence:
    """Read a folder of point clouds or depth images as a frame sequence, one frame at a time.

    docs/howto/vision.md has the files and keys of such a folder. The arguments `pose` (4, 4) and `unit` replace the
    folder's values. Raises `DataError` if an entry is missing or invalid.
    """
    path = Path(folder)
    head, where = _read_camera(path / _CAMERA_FILE), str(path / _CAMERA_FILE)
    camera = frames.validated_camera_pose(head.get("pose") if pose is None else pose, where)
    scale = metres_per_named_unit(str(unit or head.get("unit", "m")), where)
    frame = head.get("frame", "camera")
    require_known_names([str(frame)], ("camera", "world"), "coordinate frame", f"{where}: frame", DataError)
    intrinsics = _intrinsics(head.get("intrinsics"), where)
    names, times = _read_stamps(path / STAMP_FILE)
    _check_kinds(names, path, intrinsics)
    depth_unit = _number(head.get("depth_unit", 1e-3), "depth_unit", where)

    def load(index: int) -> Array:
        file = path / names[index]
        if file.suffix.lower() == _DEPTH_IMAGE_SUFFIX:
            assert intrinsics is not None
            return intrinsics.points_from_depth(_read_depth_image(file) * depth_unit)
        points = _read_cloud(file)[0] * scale
        return (points - camera[:3, 3]) @ camera[:3, :3] if frame == "world" else points

    def colours(index: int) -> frames.PointColourArray | None:
        return None if names[index].lower().endswith(_DEPTH_IMAGE_SUFFIX) else _read_cloud(path / names[index], True)[1]

    return frames.FrameSequence(times, names, camera, load, intrinsics, str(path), colours)


def write_frame_folder(sequence: frames.FrameSequence, folder: str | os.PathLike[str]) -> None:
    """Write a frame sequence as a folder of PLY clouds. `DataError` for a frame without points, else `OutputError`."""
    path, o3d = files.make_folder(folder), frames.import_open3d()
    names = [f"{i:06d}{_CLOUD_SUFFIXES[0]}" for i in range(len(sequence))]
    for i, name in enumerate(names):
        # float32 keeps 0.2 um at 2 m in half the space
        points = np.ascontiguousarray(sequence.load_cloud(i), dtype=np.float32)
        if not len(points):
            hint = "direct the camera at the object (track.virtual_frames.camera_target), or leave the frame out"
            raise DataError("the frame has no points", where=f"frame {i}", allowed="at least one point", hint=hint)
        with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
            made = o3d.t.io.write_point_cloud(str(path / name), o3d.t.geometry.PointCloud(o3d.core.Tensor(points)))
        if not made:
            allowed, hint = "a writable folder on a disk with free space", "choose another folder, or free disk space"
            raise OutputError("Open3D cannot write the cloud", where=str(path / name), allowed=allowed, hint=hint)
    pose = sequence.camera_pose.tolist()
    head: dict[str, Any] = {"format": _FRAMES_FORMAT, "pose": pose, "frame": "camera", "unit": "m"}
    if sequence.intrinsics is not None:
        head |= {"intrinsics": asdict(sequence.intrinsics), "depth_unit": 1e-3}
    files.write_text(path / _CAMERA_FILE, json.dumps(head, indent=1) + "\n")
    with files.atomic_write(path / STAMP_FILE) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["file", "t"])
        writer.writerows([name, repr(float(t))] for name, t in zip(names, sequence.stamps, strict=True))


def metres_per_named_unit(unit: str, where: str) -> float:
    """Return the length of a cloud's unit in metres [m]. Raises `DataError` for an unknown unit."""
    require_known_names([unit], _METRES_PER_UNIT, "unit", where, DataError)
    return _METRES_PER_UNIT[unit]


def _read_camera(path: Path) -> dict[str, Any]:
    if not path.exists():
        return {}
    head = files.read_input_json(path)
    what, hint = "the file holds no JSON object {...}", 'write for example {"pose": [[...], ...], "unit": "m"}'
    allowed = f"an object with {', '.join(_CAMERA_FILE_KEYS)}"
    raise_data_error_unless(isinstance(head, dict), what, str(path), allowed, hint)
    require_known_names(head, _CAMERA_FILE_KEYS, "key", str(path), DataError)
    if head.get("format", _FRAMES_FORMAT) != _FRAMES_FORMAT:
        what = f"the format of the frames is '{head['format']}', which this version of yid_ocp does not read"
        hint = "update yid_ocp, or leave `format` out"
        raise DataError(what, where=f"{path}: format", allowed=_FRAMES_FORMAT, hint=hint)
    return head


def _check_kinds(names: Sequence[str], folder: Path, intrinsics: frames.CameraIntrinsics | None) -> None:
    known = (*_CLOUD_SUFFIXES, _DEPTH_IMAGE_SUFFIX)
    for name in names:
        kind = Path(name).suffix.lower()
        what, hint = f"'{name}' is neither a cloud nor a depth image", "convert the file, or remove its row"
        raise_data_error_unless(kind in known, what, str(folder / STAMP_FILE), ", ".join(known), hint)
        if kind == _DEPTH_IMAGE_SUFFIX and intrinsics is None:
            what, hint = f"the intrinsics of the camera are missing, which '{name}' needs", "add the key `intrinsics`"
            allowed = '"intrinsics": {"width": 640, "height": 480, "fx": 577, "fy": 577, "cx": 319.5, "cy": 239.5}'
            raise DataError(what, where=str(folder / _CAMERA_FILE), allowed=allowed, hint=hint)


def _intrinsics(entry: object, where: str) -> frames.CameraIntrinsics | None:
    if entry is None:
        return None
    known = [f.name for f in fields(frames.CameraIntrinsics)]
    needed, bent = known[:6], known[6:]
    if not isinstance(entry, dict) or set(entry) - set(bent) != set(needed):
        allowed = f"{', '.join(needed)}; for a lens with distortion {', '.join(bent)} as well"
        lacking = ", ".join(sorted(set(needed) - set(entry if isinstance(entry, dict) else ()))) or "none"
        what, hint = f"keys of the intrinsics are missing ({lacking}) or unknown", "add or remove these keys"
        raise DataError(what, where=f"{where}: intrinsics", allowed=allowed, hint=hint)
    width, height, fx, fy, cx, cy = (_number(entry[name], f"intrinsics.{name}", where) for name in needed)
    coefficients = entry.get("coefficients", ())
    if not isinstance(coefficients, (list, tuple)) or not all(type(k) in (int, float) for k in coefficients):
        what = f"the lens' coefficients {coefficients!r} are no list of numbers"
        allowed, hint = "a list such as [0.1, -0.2, 0, 0]", "write the calibration's, or leave `coefficients` out"
        raise DataError(what, where=f"{where}: intrinsics", allowed=allowed, hint=hint)
    model, distortion = str(entry.get("model", "plumb_bob")), tuple(float(k) for k in coefficients)
    return frames.CameraIntrinsics(int(width), int(height), fx, fy, cx, cy, model, distortion)


def _number(value: object, name: str, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value) or value <= 0:
        what, hint = f"{name} is {value!r}, but must be above 0", "correct it; depth_unit is 0.001 for images in mm"
        raise DataError(what, where=where, allowed="a finite number above 0 [m or pixels]", hint=hint)
    return float(value)


def _read_stamps(path: Path) -> tuple[tuple[str, ...], Array]:
    allowed, hint = "CSV with the columns file, t [s]", "write the row file,t and one for each frame, as 0.ply,0.033"
    raise_data_error_unless(path.exists(), "the file of time stamps does not exist", str(path), allowed, hint)
    try:
        rows = list(csv.DictReader(files.read_input_text(path).splitlines()))
    except csv.Error as error:
        raise DataError(f"the file is not CSV: {error}", where=str(path), allowed=allowed, hint=hint) from error
    raise_data_error_unless(rows, "the table of time stamps has no rows", str(path), allowed, hint)
    what, hint = f"the columns are {', '.join(map(str, rows[0]))}, not file and t", "rename them to file and t"
    raise_data_error_unless({"file", "t"} <= set(rows[0]), what, f"{path}, line 1", allowed, hint)
    times = []
    for number, row in enumerate(rows, start=2):
        try:
            times.append(float(row["t"]))
        except (TypeError, ValueError) as error:
            what, where = f"the time is {row['t']!r}, but must be a number", f"{path}, line {number}"
            raise DataError(what, where=where, allowed="seconds", hint="correct it, or remove the row") from error
    return tuple(str(row["file"]) for row in rows), np.array(times)
