"""Readers that turn other formats (CSV, rosbag, MCAP) into a recording."""

from __future__ import annotations

import csv
import inspect
import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from yid_ocp.data.recording import (
    JOINT_CHANNELS,
    Array,
    Clock,
    JointGroup,
    PointGroup,
    Recording,
    read_recording,
    validate,
)
from yid_ocp.errors import DataError, nearest
from yid_ocp.files import file_sha256
from yid_ocp.registry import Registry

Reader = Callable[..., Recording]

READERS: Registry[Reader] = Registry("recording format")
"""Readers by file suffix, and `folder` for what is stored as a folder; each takes a path, then named options."""

_TO_SI: Mapping[str, Mapping[str, float]] = {
    "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    "m": {"m": 1.0, "cm": 1e-2, "mm": 1e-3},
    "rad": {"rad": 1.0, "deg": math.pi / 180},
    "rad/s": {"rad/s": 1.0, "deg/s": math.pi / 180, "rpm": 2 * math.pi / 60},
    "N m": {"N m": 1.0, "N mm": 1e-3, "mN m": 1e-3},
}
_QUANTITIES: Mapping[str, str] = {"t": "s", **JOINT_CHANNELS, "points": "m"}
_PREFIXES = {"q_": "position", **{f"{channel}_": channel for channel in JOINT_CHANNELS}}
_AXES = ("x", "y", "z")
_JOINT_STATE = "sensor_msgs/msg/JointState"
_POINT_STAMPED = "geometry_msgs/msg/PointStamped"


def read_any(path: str | os.PathLike[str], **options: Any) -> Recording:
    """Read a recording of any known format, chosen by its suffix.

    Parameters
    ----------
    path : path-like
        An HDF5 recording, a CSV file, a rosbag, an MCAP file or a ROS 2 bag folder.
    **options
        Named options of the reader in `READERS`.

    Returns
    -------
    Recording
        The checked recording.

    Raises
    ------
    DataError
        If the format or an option is not known, or the reader refuses the file.
    """
    path = Path(path)
    suffix = "folder" if path.is_dir() else path.suffix.lower()
    if suffix not in READERS:
        raise DataError(
            f"there is no reader for '{suffix}' files",
            where=str(path),
            allowed=", ".join(READERS),
            hint=nearest(suffix, READERS),
        )
    reader = READERS[suffix]
    known = [name for name in inspect.signature(reader).parameters if name != "path"]
    for name in options:
        if name not in known:
            raise DataError(
                f"the reader of '{suffix}' files has no option '{name}'",
                where=str(path),
                allowed=", ".join(known),
                hint=nearest(name, known),
            )
    return reader(path, **options)


def read_csv(
    path: str | os.PathLike[str],
    *,
    columns: Mapping[str, str | Sequence[str] | None] | None = None,
    units: Mapping[str, str] | None = None,
    clock: Clock = "recorded",
    sensor: str = "unknown",
    frame: str = "world",
    delimiter: str = ",",
    description: str = "",
) -> Recording:
    """Read a table with one header row and one row per time.

    Columns are understood by their names: `t` or `time`; a channel and a joint, `q_<joint>`, `position_<joint>`,
    `velocity_<joint>`, `effort_<joint>` and so on; else a point and an axis, `<point>_x`, `<point>_y`, `<point>_z`. An
    empty cell is NaN. Where a table has joints and points, a row in which all cells of one of them are empty is a time
    at which only the other was measured.

    Parameters
    ----------
    path : path-like
        The table.
    columns : mapping, optional
        Column to its meaning, where its name does not say: `"t"`, (channel, joint), (axis, point), or None to leave
        it out.
    units : mapping, optional
        Unit of `t`, of a joint channel or of `points`, where it is not SI: s, ms, us, ns; rad, deg; rad/s, deg/s, rpm;
        N m, N mm, mN m; m, cm, mm. Converted here and nowhere else.
    clock : {'recorded', 'nominal'}
        Whether the times were measured.
    sensor, frame : str
        What saw the points, and their frame of reference.
    delimiter : str
        One character between cells.
    description : str
        What was recorded.

    Returns
    -------
    Recording
        The checked recording, in SI units, its points in one group called `points`.

    Raises
    ------
    DataError
        If the file, a column, a cell, an option or a unit cannot be understood, or as `validate`.
    """
    path = Path(path)
    digest = file_sha256(path)
    factors = _factors(units or {}, str(path))
    meanings, table = _read_table(path, delimiter, columns or {})
    t = factors["t"] * table[:, meanings.index(("t", ""))]
    joint_names, channels = _joint_columns(meanings, table, str(path))
    point_names, position = _point_columns(meanings, table, str(path))
    joint_rows = point_rows = np.arange(len(t))
    if joint_names and point_names:
        joint_rows = np.flatnonzero(~np.isnan(np.hstack(list(channels.values()))).all(axis=1))
        point_rows = np.flatnonzero(~np.isnan(position).all(axis=(1, 2)))
    joints, points = None, []
    if joint_names:
        si: dict[str, Any] = {name: factors[name] * values[joint_rows] for name, values in channels.items()}
        joints = JointGroup(joint_names, t[joint_rows], clock=clock, **si)
    if point_names:
        seen = factors["points"] * position[point_rows]
        points = [PointGroup("points", point_names, t[point_rows], seen, None, sensor, frame, None, clock)]
    return validate(Recording(joints, tuple(points), description, path.name, path.stem, digest))


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


for _suffix in (".h5", ".hdf5"):
    READERS.register(_suffix)(read_recording)
READERS.register(".csv")(read_csv)
for _suffix in (".bag", ".mcap", ".db3", "folder"):
    READERS.register(_suffix)(read_bag)


def _factors(units: Mapping[str, str], where: str) -> dict[str, float]:
    factors = dict.fromkeys(_QUANTITIES, 1.0)
    for quantity, unit in units.items():
        if quantity not in _QUANTITIES:
            raise DataError(
                f"a unit is given for '{quantity}', which is no quantity",
                where=where,
                allowed=", ".join(_QUANTITIES),
                hint=nearest(quantity, _QUANTITIES),
            )
        known = _TO_SI[_QUANTITIES[quantity]]
        if unit not in known:
            what = f"'{unit}' is not a unit of '{quantity}'"
            raise DataError(what, where=where, allowed=", ".join(known), hint=nearest(unit, known))
        factors[quantity] = known[unit]
    return factors


def _read_table(
    path: Path, delimiter: str, columns: Mapping[str, str | Sequence[str] | None]
) -> tuple[list[tuple[str, str]], Array]:
    """Read the columns that mean something: their meanings and the table, shape (rows, columns), in its own units."""
    if len(delimiter) != 1:
        raise DataError(f"the delimiter is {delimiter!r}", where=str(path), allowed="one character")
    rows: list[list[float]] = []
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            lines = csv.reader(file, delimiter=delimiter, skipinitialspace=True)
            header = [cell.strip() for cell in next(lines, [])]
            _check_header(header, path, delimiter)
            meanings = _meanings(header, columns, f"{path}, line 1")
            for cells in lines:
                if cells:
                    rows.append(_numbers(cells, header, meanings, f"{path}, line {lines.line_num}"))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        what = f"the file is not a table of text ({error})"
        raise DataError(what, where=str(path), allowed="CSV with one header row, in UTF-8") from error
    if not rows:
        raise DataError("the table has no rows", where=str(path), allowed="one header row, then one row per time")
    return [meaning for meaning in meanings if meaning], np.array(rows)


def _check_header(header: Sequence[str], path: Path, delimiter: str) -> None:
    allowed = "one header row with names such as t, q_<joint>, effort_<joint>, <point>_x"
    if not any(header):
        raise DataError("the table is empty", where=str(path), allowed=allowed)
    if all(_is_number(cell) for cell in header):
        raise DataError("the table has no header row", where=f"{path}, line 1", allowed=allowed)
    if len(header) == 1:
        others = [repr(mark) for mark in ";\t, " if mark in header[0] and mark != delimiter]
        hint = f"set delimiter={others[0]}" if others else ""
        raise DataError(f"the table has one column, '{header[0]}'", where=str(path), allowed=allowed, hint=hint)
    repeated = [name for name in header if header.count(name) > 1]
    if repeated:
        raise DataError(f"two columns are called '{repeated[0]}'", where=f"{path}, line 1")


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _numbers(
    cells: Sequence[str], header: Sequence[str], meanings: Sequence[tuple[str, str] | None], where: str
) -> list[float]:
    if len(cells) != len(header):
        raise DataError(f"the row has {len(cells)} cells", where=where, allowed=f"{len(header)} cells, as the header")
    numbers = []
    for cell, name, meaning in zip(cells, header, meanings, strict=True):
        if meaning:
            try:
                numbers.append(float(cell) if cell.strip() else math.nan)
            except ValueError as error:
                allowed = "a number with a decimal point, or nothing where there was no measurement"
                raise DataError(f"column '{name}' holds '{cell}'", where=where, allowed=allowed) from error
    return numbers


def _meanings(
    header: Sequence[str], columns: Mapping[str, str | Sequence[str] | None], where: str
) -> list[tuple[str, str] | None]:
    """Say for each column: ("t", ""), (channel, joint), (axis, point), or None for one to leave out."""
    for name in columns:
        if name not in header:
            what = f"there is no column '{name}'"
            raise DataError(what, where=where, allowed=", ".join(header), hint=nearest(name, header))
    meanings: list[tuple[str, str] | None] = []
    for name in header:
        meaning = _given_meaning(name, columns[name], where) if name in columns else _conventional_meaning(name)
        if meaning is None and name not in columns:
            raise DataError(
                f"the meaning of column '{name}' is not known",
                where=where,
                allowed="t, "
                + ", ".join(f"{prefix}<joint>" for prefix in _PREFIXES)
                + ", <point>_x, <point>_y, <point>_z",
                hint=f"rename it, or set columns={{'{name}': ('position', 'joint')}}, or None to leave it out",
            )
        if meaning and meaning in meanings:
            other = header[meanings.index(meaning)]
            raise DataError(f"columns '{other}' and '{name}' mean the same, {' '.join(meaning).strip()}", where=where)
        meanings.append(meaning)
    if ("t", "") not in meanings:
        raise DataError(
            "the table has no column of times", where=where, allowed="t or time", hint="columns={'...': 't'}"
        )
    return meanings


def _conventional_meaning(column: str) -> tuple[str, str] | None:
    if column in ("t", "time"):
        return "t", ""
    for prefix in sorted(_PREFIXES, key=len, reverse=True):
        if column.startswith(prefix) and column != prefix:
            return _PREFIXES[prefix], column.removeprefix(prefix)
    point, _, axis = column.rpartition("_")
    return (axis, point) if point and axis in _AXES else None


def _given_meaning(column: str, given: str | Sequence[str] | None, where: str) -> tuple[str, str] | None:
    if given is None:
        return None
    words = (given, "") if isinstance(given, str) else tuple(given)
    if words == ("t", ""):
        return "t", ""
    known = (*JOINT_CHANNELS, *_AXES)
    if len(words) != 2 or not words[1] or words[0] not in known:
        raise DataError(
            f"column '{column}' is given the meaning {given!r}",
            where=where,
            allowed=f"'t', or a pair of one of {', '.join(known)} and the name of the joint or point, or None",
            hint=nearest(str(words[0]), known) if words and words[0] not in known else "",
        )
    return str(words[0]), str(words[1])


def _joint_columns(
    meanings: Sequence[tuple[str, str]], table: Array, where: str
) -> tuple[tuple[str, ...], dict[str, Array]]:
    found = [meaning for meaning in meanings if meaning[0] in JOINT_CHANNELS]
    names = tuple(dict.fromkeys(joint for _, joint in found))
    used = dict.fromkeys(["position", *(channel for channel, _ in found)]) if found else {}
    return names, {channel: _gather(meanings, table, [(channel, name) for name in names], where) for channel in used}


def _point_columns(meanings: Sequence[tuple[str, str]], table: Array, where: str) -> tuple[tuple[str, ...], Array]:
    names = tuple(dict.fromkeys(point for axis, point in meanings if axis in _AXES))
    wanted = [(axis, name) for name in names for axis in _AXES]
    return names, _gather(meanings, table, wanted, where).reshape(len(table), len(names), 3)


def _gather(meanings: Sequence[tuple[str, str]], table: Array, wanted: Sequence[tuple[str, str]], where: str) -> Array:
    for meaning in wanted:
        if meaning not in meanings:
            what = f"there is no column for {meaning[0]} of '{meaning[1]}'"
            allowed = "every channel for all joints, position always; x, y and z of every point"
            raise DataError(what, where=where, allowed=allowed)
    return table[:, [meanings.index(meaning) for meaning in wanted]]


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
                messages[connection.msgtype].append(_Message(connection.topic, logged, stamp, content))
    except Exception as error:  # rosbags lets through whatever a damaged file makes struct, sqlite3 or zstd raise
        raise DataError(
            f"the bag cannot be read ({type(error).__name__}: {error})",
            where=str(path),
            allowed="a ROS 1 .bag, a ROS 2 folder with metadata.yaml, or an .mcap or .db3 file of ROS 2",
            hint="check with `ros2 bag info` or `rosbag info`; a bag cut off by a crash needs `ros2 bag reindex`",
        ) from error
    return messages, others


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
            frame = message.content.header.frame_id.strip("/") or "unknown"
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
        seen[key] = (position.x, position.y, position.z)
    times, names = sorted({time for time, _ in seen}), sorted({point for _, point in seen})
    rows, columns = ({key: index for index, key in enumerate(keys)} for keys in (times, names))
    array = np.full((len(times), len(names), 3), np.nan)
    for (time, point), coordinates in seen.items():
        array[rows[time], columns[point]] = coordinates
    return PointGroup(name, tuple(names), np.array(times), array, None, sensor, frame)
