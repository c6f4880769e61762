"""A folder of clouds or depth images with time stamps and the camera (`yid-frames/1`): read and written."""

from __future__ import annotations

import csv
import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from yid_ocp.errors import DataError, OutputError, unknown_name_details
from yid_ocp.files import atomic_write
from yid_ocp.vision.camera_intrinsics import CameraIntrinsics
from yid_ocp.vision.frame_files import (
    CLOUD_SUFFIXES,
    DEPTH_IMAGE_SUFFIX,
    read_cloud,
    read_colours,
    read_depth_image,
    write_cloud,
    write_depth_image,
)
from yid_ocp.vision.frames import Colours, FrameSequence, validated_pose

Array = NDArray[np.float64]

_FRAMES_FORMAT = "yid-frames/1"
_CAMERA_FILE, STAMP_FILE = "camera.json", "timestamps.csv"
METRES_PER_UNIT: Mapping[str, float] = {"m": 1.0, "mm": 1e-3}
"""Allowed units of clouds and their size in metres."""

_KEYS = ("format", "pose", "frame", "unit", "intrinsics", "depth_unit", "description")


def read_frame_folder(
    folder: str | os.PathLike[str], *, pose: ArrayLike | None = None, unit: str | None = None
) -> FrameSequence:
    """Open a folder of clouds or depth images.

    The folder holds `camera.json` (`yid-frames/1`: `pose` 4x4, `frame` "camera" or "world" of the clouds, `unit` "m" or
    "mm" of the clouds, `intrinsics` and `depth_unit` [m] of depth images), `timestamps.csv` (columns `file`, `t` [s])
    and the files that it names: PLY, PCD, NPZ or XYZ clouds, or 16-bit PNG depth images, in any order. They are read
    when they are needed.

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
    head = _read_camera(path / _CAMERA_FILE)
    where = str(path / _CAMERA_FILE)
    camera = validated_pose(head.get("pose") if pose is None else pose, where)
    given = str(unit or head.get("unit", "m"))
    if given not in METRES_PER_UNIT:
        raise DataError(f"the unit is '{given}'", where=where, **unknown_name_details(given, METRES_PER_UNIT))
    frame = head.get("frame", "camera")
    if frame not in ("camera", "world"):
        raise DataError(f"the frame of the clouds is '{frame}'", where=where, allowed="camera, world")
    intrinsics = _intrinsics(head.get("intrinsics"), where)
    names, times = _read_stamps(path / STAMP_FILE)
    _check_kinds(names, path, intrinsics)
    depth_unit = _number(head.get("depth_unit", 1e-3), "depth_unit", where)

    def load(index: int) -> Array:
        file = path / names[index]
        if file.suffix.lower() == DEPTH_IMAGE_SUFFIX:
            assert intrinsics is not None
            return intrinsics.points_from_depth(read_depth_image(file) * depth_unit)
        points = read_cloud(file) * METRES_PER_UNIT[given]
        if frame == "world":
            points = (points - camera[:3, 3]) @ camera[:3, :3]
        return points

    def colours(index: int) -> Colours | None:
        return None if names[index].lower().endswith(DEPTH_IMAGE_SUFFIX) else read_colours(path / names[index])

    return FrameSequence(times, names, camera, load, intrinsics, str(path), colours)


def write_frame_folder(
    sequence: FrameSequence, folder: str | os.PathLike[str], *, depth: Sequence[ArrayLike] | None = None
) -> None:
    """Write a frame sequence as a folder for `read_frame_folder`: binary PLY clouds, or depth images in millimetres.

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
    ending = CLOUD_SUFFIXES[0] if depth is None else DEPTH_IMAGE_SUFFIX
    names = [f"{i:06d}{ending}" for i in range(len(sequence))]
    for i, name in enumerate(names):
        if depth is None:
            write_cloud(path / name, sequence.load_cloud(i))
        else:
            write_depth_image(path / name, np.asarray(depth[i], float))
    head: dict[str, Any] = {
        "format": _FRAMES_FORMAT,
        "pose": sequence.camera_pose.tolist(),
        "frame": "camera",
        "unit": "m",
    }
    if sequence.intrinsics is not None:
        head["intrinsics"] = asdict(sequence.intrinsics)
        head["depth_unit"] = 1e-3
    with atomic_write(path / _CAMERA_FILE) as temporary:
        temporary.write_text(json.dumps(head, indent=1) + "\n", encoding="utf-8")
    with atomic_write(path / STAMP_FILE) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["file", "t"])
        writer.writerows([name, repr(float(t))] for name, t in zip(names, sequence.stamps, strict=True))


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
            raise DataError(f"unknown key '{key}'", where=str(path), **unknown_name_details(key, _KEYS))
    if head.get("format", _FRAMES_FORMAT) != _FRAMES_FORMAT:
        raise DataError(f"the format of the frames is '{head['format']}'", where=str(path), allowed=_FRAMES_FORMAT)
    return head


def _check_kinds(names: Sequence[str], folder: Path, intrinsics: CameraIntrinsics | None) -> None:
    for name in names:
        kind = Path(name).suffix.lower()
        if kind not in (*CLOUD_SUFFIXES, DEPTH_IMAGE_SUFFIX):
            what, allowed = (
                f"'{name}' is neither a cloud nor a depth image",
                ", ".join((*CLOUD_SUFFIXES, DEPTH_IMAGE_SUFFIX)),
            )
            raise DataError(what, where=str(folder / STAMP_FILE), allowed=allowed)
        if kind == DEPTH_IMAGE_SUFFIX and intrinsics is None:
            raise DataError(
                "there are depth images but the camera's intrinsics are missing",
                where=str(folder / _CAMERA_FILE),
                hint="add `intrinsics` with width, height, fx, fy, cx, cy [pixels]",
            )


def _intrinsics(entry: object, where: str) -> CameraIntrinsics | None:
    if entry is None:
        return None
    known = [f.name for f in fields(CameraIntrinsics)]
    needed, bent = known[:6], known[6:]
    if not isinstance(entry, dict) or set(entry) - set(bent) != set(needed):
        allowed = f"{', '.join(needed)}; for a lens with distortion {', '.join(bent)} as well"
        raise DataError("the intrinsics are not complete", where=where, allowed=allowed)
    values = {name: _number(entry[name], f"intrinsics.{name}", where) for name in needed}
    coefficients = entry.get("coefficients", ())
    if not isinstance(coefficients, (list, tuple)) or not all(type(k) in (int, float) for k in coefficients):
        raise DataError(f"the coefficients are {coefficients!r}", where=f"{where}: intrinsics", allowed="numbers")
    return CameraIntrinsics(
        int(values["width"]),
        int(values["height"]),
        values["fx"],
        values["fy"],
        values["cx"],
        values["cy"],
        model=str(entry.get("model", "plumb_bob")),
        coefficients=tuple(float(k) for k in coefficients),
    )


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
