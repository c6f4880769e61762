"""Bags of ROS 1 and ROS 2, and MCAP files: joint states and stamped points."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from yid_ocp.data.readers.base import READERS
from yid_ocp.data.recording import JointGroup, PointGroup, Recording, validate
from yid_ocp.errors import DataError, nearest
from yid_ocp.files import file_sha256

_JOINT_STATE = "sensor_msgs/msg/JointState"
_POINT_STAMPED = "geometry_msgs/msg/PointStamped"


@READERS.register(".bag")
@READERS.register(".mcap")
@READERS.register(".db3")
@READERS.register("folder")
def read_bag(
    path: str | os.PathLike[str],
    *,
    joint_topic: str | None = None,
    joints: Sequence[str] | None = None,
    point_topics: Mapping[str, str] | None = None,
    sensor: str = "unknown",
    description: str = "",
) -> Recording:
    """Read a ROS 1 bag, a ROS 2 bag folder or an MCAP file.

    `sensor_msgs/JointState` becomes the joints; `geometry_msgs/PointStamped` becomes points, one group per frame of
    reference. Times are the headers' stamps (the times of recording if a message has none), from the first message
    on. A joint channel that is empty, or NaN throughout, was not measured and is left out.

    Parameters
    ----------
    path : path-like
        The bag.
    joint_topic : str, optional
        Topic of the joint states, needed where there are several.
    joints : sequence of str, optional
        Joints to keep, in this order; messages that lack one of them are skipped. Needed where the messages of the
        topic do not all have the same joints.
    point_topics : mapping of str to str, optional
        Topic to name of the point; all topics of that type under the last part of their names where absent.
    sensor : str
        What saw the points.
    description : str
        What was recorded.

    Returns
    -------
    Recording
        The checked recording.

    Raises
    ------
    DataError
        If `rosbags` is not installed, the bag cannot be read, holds no such topic or leaves a choice open, or as
        `validate`.
    """
    path = Path(path)
    digest = file_sha256(path)
    messages, others = _bag_messages(path)
    joint_topic, names, states = _joint_states(messages[_JOINT_STATE], joint_topic, joints, str(path))
    seen = _stamped_points(messages[_POINT_STAMPED], point_topics, str(path))
    if not states and not seen:
        raise DataError(
            "the bag has no joint states and no points",
            where=str(path),
            allowed=f"topics of the types {_JOINT_STATE}, {_POINT_STAMPED}",
            hint="it holds " + (", ".join(others) or "no topics at all"),
        )
    used = [*states, *(message for entries in seen.values() for _, message in entries)]
    # one message without a stamp makes the two clocks incomparable, so then no stamp is used
    stamped = all(message.stamp > 0 for message in used)
    origin = min(message.stamp if stamped else message.logged for message in used)

    def seconds(message: _Message) -> float:
        # integers first: nanoseconds since 1970 do not fit into a float
        return ((message.stamp if stamped else message.logged) - origin) * 1e-9

    groups = []
    for frame, entries in seen.items():
        name = "points" if len(seen) == 1 else "points_" + frame.replace("/", "_")
        groups.append(_point_group(name, frame, sensor, entries, seconds, str(path)))
    joint_group = _joint_group(names, states, seconds, f"{path}: {joint_topic}") if states else None
    return validate(Recording(joint_group, tuple(groups), description, path.name, path.stem, digest))


@dataclass(frozen=True)
class _Message:
    """One message of a bag: topic, time of recording and header stamp [ns], and the decoded contents."""

    topic: str
    logged: int
    stamp: int
    content: Any


def _bag_messages(path: Path) -> tuple[dict[str, list[_Message]], list[str]]:
    """Decode the joint states and points of a bag, by type, and list what else is in it."""
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise DataError(
            "reading bags needs the package rosbags", where=str(path), hint="pip install 'yid-ocp[bags]'"
        ) from error
    messages: dict[str, list[_Message]] = {_JOINT_STATE: [], _POINT_STAMPED: []}
    try:
        # older ROS 2 bags do not hold the definitions of their messages; these two have not changed since
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            others = sorted({f"{c.topic} ({c.msgtype})" for c in reader.connections if c.msgtype not in messages})
            wanted = [connection for connection in reader.connections if connection.msgtype in messages]
            # an empty selection would mean all topics, images included
            for connection, logged, data in reader.messages(wanted) if wanted else ():
                content: Any = reader.deserialize(data, connection.msgtype)
                stamp = content.header.stamp.sec * 10**9 + content.header.stamp.nanosec
                plain = _plain(content, connection.msgtype)
                messages[connection.msgtype].append(_Message(connection.topic, int(logged), int(stamp), plain))
    except Exception as error:  # rosbags lets through whatever a damaged file makes struct, sqlite3 or zstd raise
        raise DataError(
            f"the bag cannot be read ({type(error).__name__}: {error})",
            where=str(path),
            allowed="a ROS 1 .bag, a ROS 2 folder with metadata.yaml, or an .mcap or .db3 file of ROS 2",
            hint="check with `ros2 bag info` or `rosbag info`; a bag cut off by a crash needs `ros2 bag reindex`",
        ) from error
    return messages, others


def _plain(content: Any, kind: str) -> SimpleNamespace:
    """What is needed of a message, in Python's types: a bag brings definitions of its own, which may be damaged."""
    frame = str(content.header.frame_id)
    if kind == _POINT_STAMPED:
        x, y, z = (float(getattr(content.point, axis)) for axis in "xyz")
        return SimpleNamespace(frame=frame, point=(x, y, z))
    names = [str(name) for name in content.name]
    values = {key: np.asarray(getattr(content, key), float).ravel() for key in ("position", "velocity", "effort")}
    return SimpleNamespace(frame=frame, name=names, **values)


def _joint_states(
    messages: Sequence[_Message], topic: str | None, joints: Sequence[str] | None, where: str
) -> tuple[str | None, tuple[str, ...], list[_Message]]:
    """Choose the topic, the joints and the messages that have them."""
    topics = sorted({message.topic for message in messages})
    if topic is not None and topic not in topics:
        what = f"there are no joint states on the topic '{topic}'"
        raise DataError(what, where=where, allowed=", ".join(topics), hint=nearest(topic, topics))
    if topic is None and len(topics) > 1:
        what = "there are joint states on several topics"
        raise DataError(what, where=where, allowed=", ".join(topics), hint=f"choose one: joint_topic='{topics[0]}'")
    states = [message for message in messages if topic in (None, message.topic)]
    sets = {tuple(sorted(message.content.name)): tuple(message.content.name) for message in states}
    if joints is None:
        if len(sets) > 1:
            raise DataError(
                f"the messages have {len(sets)} different sets of joints",
                where=f"{where}: {topic or topics[0]}",
                allowed="; ".join(", ".join(names) for names in sets.values()),
                hint="choose joints that come together: joints=[...]",
            )
        joints = next(iter(sets.values()), ())
    elif not any(set(joints) <= set(names) for names in sets):
        known = sorted({name for names in sets for name in names})
        missing = [name for name in joints if name not in known]
        raise DataError(
            f"there is no joint '{missing[0]}'" if missing else "the joints never come in one message",
            where=where,
            allowed="; ".join(", ".join(names) for names in sets.values()) or "no joints were recorded",
            hint=nearest(missing[0], known) if missing and known else "",
        )
    kept = [message for message in states if set(joints) <= set(message.content.name)]
    return topic or next(iter(topics), None), tuple(joints), kept


def _joint_group(
    names: tuple[str, ...], states: Sequence[_Message], seconds: Callable[[_Message], float], where: str
) -> JointGroup:
    states = sorted(states, key=seconds)
    t = np.array([seconds(message) for message in states])
    channels: dict[str, Any] = {}
    for channel in ("position", "velocity", "effort"):
        rows = []
        for message in states:
            values, own = getattr(message.content, channel), message.content.name
            if len(values) == len(own):
                rows.append([values[own.index(name)] for name in names])
            elif len(values):
                what = f"a message has {len(values)} values of '{channel}' for {len(own)} joints"
                raise DataError(what, where=where, allowed="one for each joint, or none")
        if rows and len(rows) < len(states):
            raise DataError(f"{len(states) - len(rows)} of {len(states)} messages lack '{channel}'", where=where)
        if rows and not np.isnan(rows).all():
            channels[channel] = np.array(rows)
    if "position" not in channels:
        raise DataError("the joint states have no positions", where=where)
    return JointGroup(names, t, **channels)


def _stamped_points(
    messages: Sequence[_Message], topics: Mapping[str, str] | None, where: str
) -> dict[str, list[tuple[str, _Message]]]:
    """Sort the points by frame of reference, each with its name."""
    present = sorted({message.topic for message in messages})
    names = {topic: topic.rpartition("/")[2] for topic in present} if topics is None else dict(topics)
    for topic in names:
        if topic not in present:
            what = f"there are no points on the topic '{topic}'"
            raise DataError(what, where=where, allowed=", ".join(present), hint=nearest(topic, present))
    shared = [topic for topic, name in names.items() if list(names.values()).count(name) > 1]
    if shared:
        what = f"the topics {', '.join(shared)} give points of the same name"
        raise DataError(what, where=where, hint="name them: point_topics={'topic': 'point', ...}")
    groups: dict[str, list[tuple[str, _Message]]] = {}
    for message in messages:
        if message.topic in names:
            frame = message.content.frame.strip("/") or "unknown"
            groups.setdefault(frame, []).append((names[message.topic], message))
    return groups


def _point_group(
    name: str,
    frame: str,
    sensor: str,
    entries: Iterable[tuple[str, _Message]],
    seconds: Callable[[_Message], float],
    where: str,
) -> PointGroup:
    seen: dict[tuple[float, str], tuple[float, float, float]] = {}
    for point, message in entries:
        key, position = (seconds(message), point), message.content.point
        if key in seen:
            raise DataError(f"point '{point}' comes twice at {key[0]:g} s", where=f"{where}: {message.topic}")
        seen[key] = position
    times, names = sorted({time for time, _ in seen}), sorted({point for _, point in seen})
    rows, columns = ({key: index for index, key in enumerate(keys)} for keys in (times, names))
    array = np.full((len(times), len(names), 3), np.nan)
    for (time, point), coordinates in seen.items():
        array[rows[time], columns[point]] = coordinates
    return PointGroup(name, tuple(names), np.array(times), array, None, sensor, frame)
