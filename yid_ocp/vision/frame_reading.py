"""Frame sequences from a folder, a bag of ROS 1 or ROS 2, an MCAP file, a RealSense or an Azure Kinect recording.

Of a bag, `sensor_msgs/PointCloud2`, or `sensor_msgs/Image` with depth and its `sensor_msgs/CameraInfo`: a sequence
keeps where its messages stand; they are read when they are needed.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from yid_ocp.data.readers.bags import damaged_bag_error
from yid_ocp.errors import DataError, unknown_name_details
from yid_ocp.vision.frame_folder import METRES_PER_UNIT, STAMP_FILE, read_frame_folder
from yid_ocp.vision.frames import CameraIntrinsics, Colours, FrameSequence, import_open3d, validated_pose

Array = NDArray[np.float64]

_CLOUD_MESSAGE, _IMAGE_MESSAGE = "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/Image"
_CAMERA_INFO_MESSAGE = "sensor_msgs/msg/CameraInfo"
_JOINT_STATE_MESSAGE = "sensor_msgs/msg/JointState"
_DEPTH_ENCODINGS = {"16UC1": ("u2", 1e-3), "mono16": ("u2", 1e-3), "32FC1": ("f4", 1.0)}
"""Encodings of depth images: type of a pixel and its unit [m]; REP 118. RealSense's files say `mono16`."""
_POINT_FIELD_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""Types of the fields of a PointCloud2."""
_PER_METRE = "/option/Depth_Units/value"  # topic of RealSense's files with the unit of their depth images [m]


@dataclass(frozen=True)
class _Place:
    """Where a message stands: its connection, time of recording [ns], and how many of that time stand before it."""

    connection: Any
    logged: int
    before: int


def _read_bag_frames(
    path: Path, *, pose: ArrayLike | None = None, unit: str | None = None, topic: str | None = None
) -> FrameSequence:
    """Open the frames in a bag."""
    camera = validated_pose(pose, f"{path}: give track.camera_pose")
    bag = _Bag(path)
    given = unit or "m"
    if given not in METRES_PER_UNIT:
        raise DataError(f"the unit is '{given}'", where=str(path), **unknown_name_details(given, METRES_PER_UNIT))
    name = _topic(bag, topic)
    kind = bag.kinds[name]
    places, stamps = bag.frames(name)
    if not places:
        raise DataError(f"there is no message on the topic '{name}'", where=str(path))
    lens, per_metre = (None, 1.0) if kind == _CLOUD_MESSAGE else (_lens(bag, name), bag.depth_unit(name))
    where = f"{path}: {name}"

    def load(index: int) -> Array:
        content = bag.message(places[index])
        if lens is None:
            return _points(content, where) * METRES_PER_UNIT[given]
        return lens.points_from_depth(_depth(content, per_metre, where))

    def colours(index: int) -> Colours | None:
        return None if lens is not None else _colours(bag.message(places[index]), where)

    names = tuple(f"{name} {i}" for i in range(len(places)))
    return FrameSequence(stamps, names, camera, load, lens, str(path), colours)


class _Bag:
    """An open bag; what is wrong with it or with a message is a `DataError`."""

    def __init__(self, path: Path) -> None:
        try:
            from rosbags.highlevel import AnyReader
            from rosbags.typesys import Stores, get_typestore
        except ImportError as error:
            hint = "pip install 'yid-ocp[bags]'"
            raise DataError("reading bags needs the package rosbags", where=str(path), hint=hint) from error
        self.path = path
        try:
            # older ROS 2 bags do not hold the definitions of their messages; these have not changed since
            self.reader: Any = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
            self.reader.open()
        except Exception as error:  # rosbags lets through whatever a damaged file makes struct, sqlite3 or zstd raise
            raise damaged_bag_error(path, error) from error
        self.kinds: dict[str, str] = {c.topic: c.msgtype for c in self.reader.connections}

    def _of(self, topic: str) -> list[Any]:
        return [c for c in self.reader.connections if c.topic == topic]

    def frames(self, topic: str) -> tuple[list[_Place], Array]:
        """Where the messages of a topic stand, and their times [s]."""
        places: list[_Place] = []
        stamps, logs = [], []
        try:
            for connection, logged, data in self.reader.messages(self._of(topic)):
                before = sum(1 for place in reversed(places[-8:]) if place.logged == logged)
                places.append(_Place(connection, logged, before))
                stamps.append(_stamp(self.reader, data))
                logs.append(logged)
            first = [_first(self.reader, c) for c in self.reader.connections if c.msgtype == _JOINT_STATE_MESSAGE]
        except Exception as error:
            raise damaged_bag_error(self.path, error) from error
        joints = [entry for entry in first if entry is not None]
        # one message without a stamp makes the two clocks incomparable, so then no stamp is used
        stamped = all(stamp > 0 for stamp in [*stamps, *(stamp for _, stamp in joints)])
        chosen = stamps if stamped else logs
        # nanoseconds since 1970 do not fit into a float: integers first
        origin = min(([stamp if stamped else logged for logged, stamp in joints] or chosen), default=0)
        return places, np.array([1e-9 * (value - origin) for value in chosen])

    def message(self, place: _Place) -> Any:
        """A message, decoded."""
        try:
            found = self.reader.messages([place.connection], start=place.logged, stop=place.logged + 1)
            for number, (connection, _, data) in enumerate(found):
                if number == place.before:
                    return self.reader.deserialize(data, connection.msgtype)
        except Exception as error:
            raise damaged_bag_error(self.path, error) from error
        raise DataError("the bag has changed since it was opened", where=str(self.path))

    def first(self, topic: str) -> Any:
        """The first message of a topic, decoded."""
        try:
            for connection, _, data in self.reader.messages(self._of(topic)):
                return self.reader.deserialize(data, connection.msgtype)
        except Exception as error:
            raise damaged_bag_error(self.path, error) from error
        raise DataError(f"there is no message on the topic '{topic}'", where=str(self.path))

    def depth_unit(self, topic: str) -> float:
        """Factor on the usual unit of depth images, from the file of a RealSense camera; 1 where it says nothing."""
        for name in self.kinds:
            if name.endswith(_PER_METRE) and name.split("/")[:3] == topic.split("/")[:3]:
                return float(self.first(name).data) / _DEPTH_ENCODINGS["mono16"][1]
        return 1.0


def _stamp(reader: Any, data: bytes) -> int:
    """Stamp of a message whose first field is a header [ns], without decoding the rest."""
    order = "<" if not reader.is2 or data[1] == 1 else ">"  # of ROS 2, the head of CDR says which
    seconds, nanoseconds = struct.unpack_from(f"{order}II", data, 4)
    return int(seconds) * 10**9 + int(nanoseconds)


def _first(reader: Any, connection: Any) -> tuple[int, int] | None:
    """Time of recording and stamp of a connection's first message [ns]."""
    for _, logged, data in reader.messages([connection]):
        return logged, _stamp(reader, data)
    return None


def _topic(bag: _Bag, wanted: str | None) -> str:
    usable = sorted(name for name, kind in bag.kinds.items() if kind in (_CLOUD_MESSAGE, _IMAGE_MESSAGE))
    if wanted is not None:
        if wanted not in usable:
            what = f"there are no clouds or depth images on the topic '{wanted}'"
            raise DataError(what, where=str(bag.path), **unknown_name_details(wanted, usable))
        return wanted
    deep = [name for name in usable if bag.kinds[name] == _CLOUD_MESSAGE or _is_depth(bag, name)]
    if len(deep) == 1:
        return deep[0]
    if deep:
        hint = "say which one with track.frame_topic"
        what = f"the bag has {len(deep)} topics of clouds or depth images"
        raise DataError(what, where=str(bag.path), allowed=", ".join(deep), hint=hint)
    held = ", ".join(f"{name} ({kind})" for name, kind in sorted(bag.kinds.items())) or "no topics at all"
    encoded = f"with the encoding {' or '.join(_DEPTH_ENCODINGS)}, not compressed"
    allowed, hint = f"{_CLOUD_MESSAGE}, or {_IMAGE_MESSAGE} {encoded}", f"it holds {held}"
    raise DataError("the bag has no clouds and no depth images", where=str(bag.path), allowed=allowed, hint=hint)


def _is_depth(bag: _Bag, topic: str) -> bool:
    try:
        return str(bag.first(topic).encoding) in _DEPTH_ENCODINGS
    except DataError:
        return False


def _lens(bag: _Bag, topic: str) -> CameraIntrinsics:
    """Intrinsics from the camera's messages that stand nearest to an image's topic."""
    infos = [name for name, kind in bag.kinds.items() if kind == _CAMERA_INFO_MESSAGE]
    beside = {name: _shared(name.split("/"), topic.split("/")) for name in infos}
    nearest = [name for name in infos if beside[name] == max(beside.values())]
    if len(nearest) != 1:
        allowed = f"one topic of {_CAMERA_INFO_MESSAGE} beside {topic}"
        what = f"the camera's intrinsics are not known: the bag has {len(nearest)} topics that may hold them"
        hint = f"record {topic.rpartition('/')[0]}/camera_info as well"
        raise DataError(what, where=str(bag.path), allowed=allowed, hint=hint)
    info = bag.first(nearest[0])
    matrix, projection, bent = (_field(info, name) for name in ("k", "p", "d"))
    if "rect" in topic and projection[0] > 0:
        fx, _, cx, _, _, fy, cy = projection[:7]
        return CameraIntrinsics(int(info.width), int(info.height), fx, fy, cx, cy)
    if not (matrix[0] > 0 and matrix[4] > 0):
        hint = "calibrate the camera, or write a folder of frames with camera.json"
        raise DataError("the camera is not calibrated: its focal length is 0", where=nearest[0], hint=hint)
    model = str(info.distortion_model) or "plumb_bob"
    model = "equidistant" if model == "fisheye" else model
    fx, _, cx, _, fy, cy = matrix[:6]
    return CameraIntrinsics(int(info.width), int(info.height), fx, fy, cx, cy, model, tuple(bent))


def _field(info: Any, name: str) -> list[float]:
    """A field of CameraInfo, which ROS 1 spells with a capital."""
    return [float(value) for value in getattr(info, name, getattr(info, name.upper(), ()))]


def _shared(one: Sequence[str], other: Sequence[str]) -> int:
    return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], zip(one, other, strict=False)))


def _depth(content: Any, per_metre: float, where: str) -> Array:
    encoding = str(content.encoding)
    if encoding not in _DEPTH_ENCODINGS:
        raise DataError(f"the image is encoded as '{encoding}'", where=where, allowed=", ".join(_DEPTH_ENCODINGS))
    kind, size = _DEPTH_ENCODINGS[encoding]
    pixel = np.dtype((">" if content.is_bigendian else "<") + kind)
    height, width, step = int(content.height), int(content.width), int(content.step)
    data = np.asarray(content.data, np.uint8).tobytes()
    if step < width * pixel.itemsize or len(data) < height * step:
        raise DataError(f"the image has {len(data)} bytes for {width} x {height} pixels", where=where)
    image = np.ndarray((height, width), pixel, data, strides=(step, pixel.itemsize))
    return image.astype(np.float64) * (size * per_metre)


def _cloud_columns(content: Any, names: Iterable[str], where: str) -> list[NDArray[Any]] | None:
    """Some fields of a PointCloud2, each shape (N,); None where one is missing."""
    fields = {str(field.name): field for field in content.fields}
    height, width, step, row = (int(getattr(content, k)) for k in ("height", "width", "point_step", "row_step"))
    data = np.asarray(content.data, np.uint8).tobytes()
    order, found = ">" if content.is_bigendian else "<", []
    for name in names:
        if name not in fields:
            return None
        kind = np.dtype(order + _POINT_FIELD_TYPES.get(int(fields[name].datatype), "u1"))
        offset = int(fields[name].offset)
        if offset + kind.itemsize > step or row < width * step or len(data) < height * row:
            what = f"the cloud has {len(data)} bytes for {width} x {height} points of {step}"
            raise DataError(what, where=where)
        column = np.ndarray((height, width), kind, data, offset, (row, step))
        found.append(column.ravel())
    return found


def _points(content: Any, where: str) -> Array:
    axes = _cloud_columns(content, "xyz", where)
    if axes is None:
        names = ", ".join(str(field.name) for field in content.fields)
        raise DataError(f"the cloud has the fields {names}", where=where, allowed="x, y, z among them")
    return np.stack([axis.astype(np.float64) for axis in axes], axis=1)


def _colours(content: Any, where: str) -> Colours | None:
    for name in ("rgb", "rgba"):
        found = _cloud_columns(content, (name,), where)
        if found is not None and found[0].itemsize == 4:
            packed = np.ascontiguousarray(found[0]).view(found[0].dtype.byteorder + "u4").astype(np.uint32)
            return np.stack([(packed >> shift) & 0xFF for shift in (16, 8, 0)], axis=1).astype(np.uint8)
    return None


_BAG_SUFFIXES, _AZURE_KINECT_SUFFIX = (".bag", ".mcap", ".db3"), ".mkv"
_MILLIMETRE, _MICROSECOND = 1e-3, 1e-6


def read_frames(
    path: str | os.PathLike[str], *, pose: ArrayLike | None = None, unit: str | None = None, topic: str | None = None
) -> FrameSequence:
    """Open the frames of a camera, which are then read one at a time.

    Parameters
    ----------
    path : path-like
        A folder (`read_frame_folder`); a bag of ROS 1 or ROS 2, an MCAP file or a RealSense file;
        or an Azure Kinect's `.mkv`, where the build of Open3D reads it.
    pose : array_like, shape (4, 4), optional
        Camera in the world, instead of the folder's; others do not say it.
    unit : str, optional
        Unit of clouds, instead of the folder's.
    topic : str, optional
        Of a bag: of the clouds or depth images.

    Raises
    ------
    DataError
        What is there cannot be read, or lacks time stamps, pose or intrinsics.
    """
    place = Path(path)
    ending = place.suffix.lower()
    if place.is_dir():
        files = () if (place / STAMP_FILE).exists() else place.iterdir()
        if not any(file.name == "metadata.yaml" or file.suffix in _BAG_SUFFIXES for file in files):
            return read_frame_folder(place, pose=pose, unit=unit)
    if place.is_dir() or (place.is_file() and ending in _BAG_SUFFIXES):
        return _read_bag_frames(place, pose=pose, unit=unit, topic=topic)
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
    """Depth registered to the colour camera, as Open3D gives it."""
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
