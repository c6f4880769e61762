"""Opening of frame sequences: a folder of files, a bag, or an Azure Kinect recording."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from yid_ocp.errors import DataError
from yid_ocp.vision.bag_frames import read_bag_frames
from yid_ocp.vision.camera_intrinsics import CameraIntrinsics
from yid_ocp.vision.frame_folder import STAMP_FILE, read_frame_folder
from yid_ocp.vision.frames import Colours, FrameSequence, import_open3d, validated_pose

Array = NDArray[np.float64]

_BAG_SUFFIXES, _AZURE_KINECT_SUFFIX = (".bag", ".mcap", ".db3"), ".mkv"
_MILLIMETRE, _MICROSECOND = 1e-3, 1e-6


def read_frames(
    path: str | os.PathLike[str],
    *,
    pose: ArrayLike | None = None,
    unit: str | None = None,
    topic: str | None = None,
) -> FrameSequence:
    """Open the frames of a camera, which are then read one at a time.

    Parameters
    ----------
    path : path-like
        A folder (`read_frame_folder`); a bag of ROS 1 or ROS 2, an MCAP file or a RealSense file (`read_bag_frames`);
        or an Azure Kinect's `.mkv`, where the build of Open3D reads it.
    pose : array_like, shape (4, 4), optional
        Camera in the world, instead of the folder's; others do not say it.
    unit : str, optional
        Unit of clouds, instead of the folder's.
    topic : str, optional
        Of a bag: of the clouds or depth images.

    Returns
    -------
    FrameSequence

    Raises
    ------
    DataError
        What is there cannot be read, or lacks time stamps, pose or intrinsics.
    """
    place = Path(path)
    ending = place.suffix.lower()
    if place.is_dir():
        bag = not (place / STAMP_FILE).exists() and any(
            file.name == "metadata.yaml" or file.suffix in _BAG_SUFFIXES for file in place.iterdir()
        )
        return (
            read_bag_frames(place, pose=pose, unit=unit, topic=topic)
            if bag
            else read_frame_folder(place, pose=pose, unit=unit)
        )
    if place.is_file() and ending in _BAG_SUFFIXES:
        return read_bag_frames(place, pose=pose, unit=unit, topic=topic)
    if place.is_file() and ending == _AZURE_KINECT_SUFFIX:
        return _read_film(place, pose)
    if place.exists():
        bags = ", ".join(_BAG_SUFFIXES)
        allowed = f"a folder with {STAMP_FILE}, a bag ({bags}) or an Azure Kinect's {_AZURE_KINECT_SUFFIX}"
        raise DataError("this is no sequence of frames", where=str(place), allowed=allowed)
    raise DataError("there is no such folder of frames, and no such file", where=str(place), hint="check the path")


class _Film:
    """An Azure Kinect's film, whose frames are found by going through it: the last one that was read is kept."""

    def __init__(self, path: Path) -> None:
        kind = getattr(import_open3d().io, "AzureKinectMKVReader", None)
        hint = "write its depth images as 16-bit PNG into a folder with camera.json and timestamps.csv"
        if kind is None:
            raise DataError("this build of Open3D cannot read the films of Azure Kinects", where=str(path), hint=hint)
        self.path, self._open = path, kind
        try:
            self.reader = self._opened()
        except RuntimeError as error:  # it loads the camera's own library when asked to
            what = f"this build of Open3D cannot read the films of Azure Kinects here ({error})"
            raise DataError(what, where=str(path), hint=hint) from error
        if not self.reader.is_opened():
            raise DataError("the film cannot be read", where=str(path), allowed="an Azure Kinect's .mkv", hint=hint)
        self.next, self.kept = 0, (-1, None)

    def _opened(self) -> Any:
        reader = self._open()
        reader.open(str(self.path))
        return reader

    def count(self) -> int:
        """How many frames there are, by going through all of them."""
        number = 0
        while True:
            self.reader.next_frame()
            if self.reader.is_eof():
                break
            number += 1
        self.reader.close()
        self.reader, self.next = self._opened(), 0
        return number

    def frame(self, index: int) -> Any:
        """Colour and depth of a frame."""
        if self.kept[0] == index:
            return self.kept[1]
        if index < self.next:
            self.reader.close()
            self.reader, self.next = self._opened(), 0
        while self.next <= index:
            found = self.reader.next_frame()
            if self.reader.is_eof():
                raise DataError("the film ends before this frame", where=str(self.path))
            self.next += 1
        self.kept = index, found
        return found


def _read_film(path: Path, pose: ArrayLike | None) -> FrameSequence:
    """Depth registered to the colour camera, as Open3D gives it.

    Open3D does not say when a frame was taken: they are counted and lie evenly in the film's length.
    """
    camera, film = validated_pose(pose, f"{path}: give track.camera_pose"), _Film(path)
    metadata = film.reader.get_metadata()
    inner = metadata.intrinsics
    matrix = np.asarray(inner.intrinsic_matrix, float)
    lens = CameraIntrinsics(int(inner.width), int(inner.height), matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])
    length = _MICROSECOND * float(metadata.stream_length_usec)
    count = film.count()
    if not count:
        raise DataError("the film holds no frame", where=str(path))
    times = length * np.arange(count) / count

    def of(index: int, part: Callable[[Any], Any]) -> Any:
        found = film.frame(index)
        if found is None:
            raise DataError("the film has no picture there", where=f"{path}, frame {index}")
        return part(found)

    def depth(index: int) -> Array:
        return _MILLIMETRE * np.asarray(of(index, lambda found: found.depth), float)

    def colours(index: int) -> Colours | None:
        image = np.asarray(of(index, lambda found: found.color))
        seen = lens.is_measured(depth(index))
        return None if image.shape[:2] != seen.shape else np.asarray(image[seen][:, :3], np.uint8)

    names = tuple(f"frame {i}" for i in range(count))
    return FrameSequence(times, names, camera, lambda i: lens.points_from_depth(depth(i)), lens, str(path), colours)
