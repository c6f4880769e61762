"""Readers of frame sequences from a folder, a ROS bag, an MCAP file or a RealSense recording.

Bags contain `sensor_msgs/PointCloud2`, or `sensor_msgs/Image` with depth and its `sensor_msgs/CameraInfo`.
"""

from __future__ import annotations

import os
import posixpath
import struct
from collections.abc import Iterable
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from yid_ocp.arrays import Array
from yid_ocp.data.readers.bags import JOINT_STATE_MESSAGE_TYPE, BagMessage, OpenBag, time_since_first_message_function
from yid_ocp.errors import DataError
from yid_ocp.vision.frame_folder import STAMP_FILE, metres_per_named_unit, read_frame_folder
from yid_ocp.vision.frames import CameraIntrinsics, FrameSequence, PointColourArray, validated_camera_pose

_CLOUD_MESSAGE, _IMAGE_MESSAGE = "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/Image"
_CAMERA_INFO_MESSAGE = "sensor_msgs/msg/CameraInfo"
_DEPTH_ENCODINGS = {"16UC1": ("u2", 1e-3), "mono16": ("u2", 1e-3), "32FC1": ("f4", 1.0)}
"""Encodings of depth images: type of a pixel and its unit [m]; REP 118. RealSense's files say `mono16`."""
_POINT_FIELD_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""Types of the fields of a PointCloud2."""
_DAMAGED_FRAME_HINT = "record the bag again; `yid-ocp track` drops a damaged frame and uses the others"
_PER_METRE = "/option/Depth_Units/value"  # topic of RealSense's files with the unit of their depth images [m]


def _read_bag_frames(path: Path, pose: ArrayLike | None, unit: str, topic: str | None) -> FrameSequence:
    """Return the frames in a bag as a sequence, which decodes each frame on demand."""
    camera = validated_camera_pose(pose, str(path))
    bag, scale = OpenBag(path), metres_per_named_unit(unit, str(path))
    name = _topic(bag, topic)
    messages, stamps = _frames(bag, name)
    if not messages:
        raise _empty_topic(bag, name)
    is_cloud = name in bag.topic_names_of_types(_CLOUD_MESSAGE)
    lens, per_metre = (None, 1.0) if is_cloud else (_lens(bag, name), _depth_unit(bag, name))
    where = f"{path}: {name}"

    def load(index: int) -> Array:
        content = _decoded(bag, messages[index])
        if lens is None:
            return _points(content, where) * scale
        return lens.points_from_depth(_depth(content, per_metre, where))

    def colours(index: int) -> PointColourArray | None:
        return None if lens is not None else _colours(_decoded(bag, messages[index]), where)

    names = tuple(f"{name} {i}" for i in range(len(messages)))
    return FrameSequence(stamps, names, camera, load, lens, str(path), colours)


def _frames(bag: OpenBag, topic: str) -> tuple[list[BagMessage], Array]:
    frames: list[BagMessage] = []
    with bag.raise_read_errors_as_data_errors():
        for connection, logged, data in bag.reader.messages([c for c in bag.reader.connections if c.topic == topic]):
            before = sum(1 for frame in frames[-8:] if frame.logged == logged)
            frames.append(BagMessage(topic, logged, _stamp(bag, data), (connection, before)))
        of_joints = [c for c in bag.reader.connections if c.msgtype == JOINT_STATE_MESSAGE_TYPE]
        firsts = chain.from_iterable(islice(bag.reader.messages([connection]), 1) for connection in of_joints)
        joints = [BagMessage(connection.topic, logged, _stamp(bag, data), None) for connection, logged, data in firsts]
    return frames, np.array(list(map(time_since_first_message_function(frames, joints), frames)))


def _stamp(bag: OpenBag, data: bytes) -> int:
    """Stamp of a message whose first field is a header [ns], without decoding the rest."""
    order = "<" if not bag.reader.is2 or data[1] == 1 else ">"  # in ROS 2, the CDR header contains the byte order
    seconds, nanoseconds = struct.unpack_from(f"{order}II", data, 4)
    return int(seconds) * 10**9 + int(nanoseconds)


def _decoded(bag: OpenBag, message: BagMessage) -> Any:
    connection, before = message.content
    with bag.raise_read_errors_as_data_errors():
        found = bag.reader.messages([connection], start=message.logged, stop=message.logged + 1)
        for number, (_, _, data) in enumerate(found):
            if number == before:
                return bag.reader.deserialize(data, connection.msgtype)
    what, allowed = "the bag has changed since it was opened", "a bag that is not being written"
    raise DataError(what, where=str(bag.path), allowed=allowed, hint="repeat this command when the recording has ended")


def _first(bag: OpenBag, topic: str) -> Any:
    with bag.raise_read_errors_as_data_errors():
        for connection, _, data in bag.reader.messages([c for c in bag.reader.connections if c.topic == topic]):
            return bag.reader.deserialize(data, connection.msgtype)
    raise _empty_topic(bag, topic)


def _empty_topic(bag: OpenBag, topic: str) -> DataError:
    what, hint = f"the topic '{topic}' has no messages", "set track.frame_topic to another one, or record this one"
    return DataError(what, where=str(bag.path), allowed="a topic with one message or more", hint=hint)


def _depth_unit(bag: OpenBag, topic: str) -> float:
    """Unit of the depth images, in units of 1 mm, as a RealSense camera's file states it; 1 if not stated."""
    for name in (entry.name for entry in bag.topics):
        if name.endswith(_PER_METRE) and name.split("/")[:3] == topic.split("/")[:3]:
            return float(_first(bag, name).data) / _DEPTH_ENCODINGS["mono16"][1]
    return 1.0


def _topic(bag: OpenBag, wanted: str | None) -> str:
    clouds = bag.topic_names_of_types(_CLOUD_MESSAGE)
    usable = bag.topic_names_of_types(_CLOUD_MESSAGE, _IMAGE_MESSAGE)
    if wanted is not None:
        bag.check_topic_is_one_of(wanted, usable, "clouds or depth images")
        return wanted
    deep = [name for name in usable if name in clouds or _is_depth(bag, name)]
    if len(deep) == 1:
        return deep[0]
    if deep:
        what = f"the bag has {len(deep)} topics of clouds or depth images, of which one must be chosen"
        hint = f"set for example track.frame_topic: {deep[0]}"
        raise DataError(what, where=str(bag.path), allowed=", ".join(deep), hint=hint)
    allowed = f"{_CLOUD_MESSAGE}, or {_IMAGE_MESSAGE} of {' or '.join(_DEPTH_ENCODINGS)}, not compressed"
    hint = "record the camera's topic too, or set track.frames_path to the bag that has it"
    raise bag.no_usable_topics_error("the bag has no clouds and no depth images", allowed, hint)


def _is_depth(bag: OpenBag, topic: str) -> bool:
    try:
        return str(_first(bag, topic).encoding) in _DEPTH_ENCODINGS
    except DataError:
        return False


def _lens(bag: OpenBag, topic: str) -> CameraIntrinsics:
    """Camera intrinsics from the `CameraInfo` topic that has the longest common path with an image's topic."""
    infos = bag.topic_names_of_types(_CAMERA_INFO_MESSAGE)
    beside = {name: len(posixpath.commonpath(["/" + name, "/" + topic])) for name in infos}
    nearest = [name for name in infos if beside[name] == max(beside.values())]
    if len(nearest) != 1:
        found = f"several topics: {', '.join(nearest)}" if nearest else "no topic"
        what = f"the intrinsics of the camera are unknown, because the bag has {found}"
        allowed, beside_it = f"one topic of {_CAMERA_INFO_MESSAGE} beside {topic}", topic.rpartition("/")[0]
        hint = "keep one of them" if nearest else f"record {beside_it}/camera_info as well"
        hint += ", or write a folder of frames whose camera.json has the intrinsics"
        raise DataError(what, where=str(bag.path), allowed=allowed, hint=hint)
    info = _first(bag, nearest[0])
    # ROS 1 spells them with a capital
    fields = (getattr(info, name, getattr(info, name.upper(), ())) for name in ("k", "p", "d"))
    matrix, projection, bent = ([float(value) for value in entry] for entry in fields)
    size = int(info.width), int(info.height)
    if "rect" in topic and projection[0] > 0:
        fx, _, cx, _, _, fy, cy = projection[:7]
        return CameraIntrinsics(*size, fx, fy, cx, cy)
    fx, _, cx, _, fy, cy = matrix[:6]
    if not (fx > 0 and fy > 0):
        hint = "record with a calibrated camera, or write a folder of frames whose camera.json has the intrinsics"
        what, allowed = f"the camera is not calibrated: fx = {fx:g}, fy = {fy:g}", "focal lengths above 0 [pixels]"
        raise DataError(what, where=f"{bag.path}: {nearest[0]}", allowed=allowed, hint=hint)
    model = {"": "plumb_bob", "fisheye": "equidistant"}.get(str(info.distortion_model), str(info.distortion_model))
    return CameraIntrinsics(*size, fx, fy, cx, cy, model, tuple(bent))


def _depth(content: Any, per_metre: float, where: str) -> Array:
    encoding = str(content.encoding)
    if encoding not in _DEPTH_ENCODINGS:
        what, hint = f"'{encoding}' is no encoding of depth images", "set track.frame_topic to a topic of depth images"
        raise DataError(what, where=where, allowed=", ".join(_DEPTH_ENCODINGS), hint=hint)
    kind, size = _DEPTH_ENCODINGS[encoding]
    pixel = np.dtype((">" if content.is_bigendian else "<") + kind)
    height, width, step = int(content.height), int(content.width), int(content.step)
    data = np.asarray(content.data, np.uint8).tobytes()
    if step < width * pixel.itemsize or len(data) < height * step:
        what = f"the image is cut off and has only {len(data)} bytes for {width} x {height} pixels"
        allowed = f"at least {height * max(step, width * pixel.itemsize)} bytes"
        raise DataError(what, where=where, allowed=allowed, hint=_DAMAGED_FRAME_HINT)
    image = np.ndarray((height, width), pixel, data, strides=(step, pixel.itemsize))
    return image.astype(np.float64) * (size * per_metre)


def _cloud_columns(content: Any, names: Iterable[str], where: str) -> list[NDArray[Any]] | None:
    """The fields `names` of a PointCloud2, each (N,). None if the cloud lacks one of them."""
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
            what = f"the cloud is cut off and has only {len(data)} bytes for {width} x {height} points of {step} bytes"
            raise DataError(what, where=where, allowed=f"{width * height * step} bytes", hint=_DAMAGED_FRAME_HINT)
        found.append(np.ndarray((height, width), kind, data, offset, (row, step)).ravel())
    return found


def _points(content: Any, where: str) -> Array:
    axes = _cloud_columns(content, "xyz", where)
    if axes is None:
        what = f"the cloud has the fields {', '.join(str(field.name) for field in content.fields)}, but not x, y and z"
        hint = "set track.frame_topic to a topic whose clouds have x, y and z"
        raise DataError(what, where=where, allowed="the fields x, y and z", hint=hint)
    return np.stack([axis.astype(np.float64) for axis in axes], axis=1)


def _colours(content: Any, where: str) -> PointColourArray | None:
    for name in ("rgb", "rgba"):
        found = _cloud_columns(content, (name,), where)
        if found is not None and found[0].itemsize == 4:
            packed = np.ascontiguousarray(found[0]).view(found[0].dtype.byteorder + "u4").astype(np.uint32)
            return np.stack([(packed >> shift) & 0xFF for shift in (16, 8, 0)], axis=1).astype(np.uint8)
    return None


_BAG_SUFFIXES = (".bag", ".mcap", ".db3")


def read_frames(
    path: str | os.PathLike[str], *, pose: ArrayLike | None = None, unit: str | None = None, topic: str | None = None
) -> FrameSequence:
    """Read a frame sequence from a folder or file of a depth camera, one frame at a time.

    `path` is a folder (`read_frame_folder`), or a ROS 1 or ROS 2 bag, an MCAP or RealSense file with clouds or depth
    images under `topic`. `pose` (4, 4) is the pose of the camera in the world, `unit` the unit of clouds. Both replace
    the values of a folder and are required for other formats. Raises `DataError` for unreadable or incomplete input.
    """
    place = Path(path)
    if place.is_dir():
        files = () if (place / STAMP_FILE).exists() else place.iterdir()
        if not any(file.name == "metadata.yaml" or file.suffix in _BAG_SUFFIXES for file in files):
            return read_frame_folder(place, pose=pose, unit=unit)
    if place.is_dir() or (place.is_file() and place.suffix.lower() in _BAG_SUFFIXES):
        return _read_bag_frames(place, pose, unit or "m", topic)
    what, hint = "there is no such file or folder of frames", "set track.frames_path to an existing folder or bag"
    if place.exists():
        what = "the file is not a frame sequence"
        hint = f"write its frames as .ply or 16-bit .png files into a folder with {STAMP_FILE} and camera.json"
    allowed = f"a folder with {STAMP_FILE}, or a bag ({', '.join(_BAG_SUFFIXES)})"
    raise DataError(what, where=str(place), allowed=allowed, hint=hint)
