"""Reader of joint states, stamped points and poses, wrist sensors and IMUs in ROS bags and MCAP files."""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from yid_ocp.arrays import Array
from yid_ocp.data.foreign_formats import (
    ESTIMATED_WRENCH_GROUP_NAME,
    JOINT_VALUE_READERS,
    joint_values_from_message_fields,
)
from yid_ocp.data.readers import base
from yid_ocp.data.recording import JOINT_CHANNEL_UNITS, JointGroup, PointGroup, Recording, SensorChannelGroup
from yid_ocp.display import NULL_PROGRESS, Progress, abbreviated_names_text, grouped
from yid_ocp.errors import DataError, import_optional, nearest_name_question, unknown_name_error_arguments
from yid_ocp.files import check_input_file, file_sha256, limit_process_memory

_PROGRESS_INTERVAL = 5000  # messages from one word of progress to the next
JOINT_STATE_MESSAGE_TYPE = "sensor_msgs/msg/JointState"  # ROS type name of joint state messages
_POINT_STAMPED = "geometry_msgs/msg/PointStamped"
_POSES = tuple(f"geometry_msgs/msg/{name}Stamped" for name in ("Pose", "PoseWithCovariance", "Transform"))
_TREES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_POSE_ARRAY = "geometry_msgs/msg/PoseArray"
_PLACES = (_POINT_STAMPED, *_POSES, _POSE_ARRAY)
_WRENCH, _IMU = "geometry_msgs/msg/WrenchStamped", "sensor_msgs/msg/Imu"
_GROUP_BY_MESSAGE_TYPE = {_WRENCH: "wrist", _IMU: "imu"}  # group of a recording that messages of a type become
_JOINT_TYPES = (JOINT_STATE_MESSAGE_TYPE, *JOINT_VALUE_READERS)
_KNOWN = (*_JOINT_TYPES, *_PLACES, *_GROUP_BY_MESSAGE_TYPE)
# last parts of topics that name a message type, not the measured object
_PLAIN_WORDS = ("pose", "point", "position", "transform", "odom", "wrench", "imu", "data", "data_raw")


@dataclass(frozen=True)
class BagMessage:
    """One message of a bag: topic, time of recording and header stamp [ns], and decoded content."""

    source: str
    logged: int
    stamp: int
    content: Any


class _BagTopic(NamedTuple):
    name: str
    kind: str
    n_messages: int


_MAX_METADATA_BYTES = 1 << 18  # of a bag's YAML metadata, whose parser is slow


class OpenBag:
    """An open ROS 1 bag, ROS 2 bag or MCAP file with its topics and reader. Raises `DataError` if it is unreadable."""

    def __init__(self, path: Path) -> None:
        reason = "reading bags needs the package rosbags"
        highlevel = import_optional("rosbags.highlevel", "bags", reason)
        typesys = import_optional("rosbags.typesys", "bags", reason)
        self.path = path
        for file in path.iterdir() if path.is_dir() else (path,):
            if not file.is_dir():
                check_input_file(file, _MAX_METADATA_BYTES if file.suffix == ".yaml" else None)
        counted: Counter[tuple[str, str]] = Counter()
        with self.raise_read_errors_as_data_errors():
            # older ROS 2 bags do not contain message definitions, which have not changed since
            store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
            self.reader: Any = highlevel.AnyReader([path], default_typestore=store)
            self.reader.open()
            for c in self.reader.connections:
                counted[c.topic, c.msgtype] += c.msgcount
        self.topics = tuple(_BagTopic(*key, count) for key, count in sorted(counted.items()))

    @contextmanager
    def raise_read_errors_as_data_errors(self) -> Iterator[None]:
        """Turn every error during reading of the bag into a `DataError` (context manager)."""
        try:
            with limit_process_memory():  # compressed data may state no size or a wrong one
                yield
        except DataError:
            raise
        except Exception as error:  # rosbags lets through whatever a damaged file makes struct, sqlite3 or zstd raise
            tool = "rosbag" if self.path.suffix == ".bag" else "ros2 bag"
            what = "the bag cannot be read, because it is incomplete or damaged"
            hint = f"copy it again, or repair it by `{tool} reindex {self.path}`"
            if self.path.suffix == ".mcap":
                hint = f"copy it again, or save its sound part by `mcap recover {self.path} -o NEW.mcap` (MCAP tools)"
            if isinstance(error, MemoryError):
                what = "the bag cannot be read, because it is damaged or needs too much memory"
                hint = f"check it by `{tool} info {self.path}`; if it is sound, cut it into shorter bags"
            elif self.path.is_dir() and not (self.path / "metadata.yaml").is_file():
                what = "the bag cannot be read, because its folder has no metadata.yaml"
                hint = f"name the files in it (.mcap, .db3, tables) one by one; if the folder is a bag, {hint}"
            elif self.path.is_file() and not self.path.stat().st_size:
                what, hint = "the bag cannot be read, because it is empty (0 bytes)", "copy it again from the recorder"
            elif "Profile is not ros2" in str(error):  # as rosbags says it
                what = "the messages cannot be decoded, because the header of the file does not have the profile ros2"
                hint = "if they are of ROS 2, write the file with the profile 'ros2'; otherwise export them as CSV"
            allowed = "a ROS 1 .bag, a ROS 2 folder with metadata.yaml, or an .mcap or .db3 file of ROS 2"
            raise DataError(what, where=str(self.path), allowed=allowed, hint=hint) from error

    def topic_names_of_types(self, *kinds: str) -> list[str]:
        """Names of the bag's topics with one of the given message types."""
        return [topic.name for topic in self.topics if topic.kind in kinds]

    def check_topic_is_one_of(self, name: str, known: Sequence[str], noun: str) -> None:
        """Raise `DataError` if the topic `name` is not among `known`. `noun` names the content of these topics."""
        if name not in known:
            what, otherwise = f"the bag has no {noun} on the topic '{name}'", "choose a topic that `--preview` lists"
            raise DataError(what, where=str(self.path), **unknown_name_error_arguments(name, known, otherwise))

    def no_usable_topics_error(self, what: str, allowed: str, hint: str = "use a bag that has them") -> DataError:
        """Return the `DataError` for a bag without usable topics. Its text lists the topics of the bag."""
        held = ", ".join(f"{topic.name} ({topic.kind})" for topic in self.topics) or "none"
        return DataError(what, where=f"{self.path}, topics: {held}", allowed=allowed, hint=hint)


def time_since_first_message_function(
    messages: Sequence[BagMessage], origins: Sequence[BagMessage] | None = None
) -> Callable[[BagMessage], float]:
    """Return a function that computes a message's time [s] since the first one of `origins` (default: `messages`)."""
    # if one message has no stamp, the two clocks are not comparable, and no stamp is used
    stamped = all(message.stamp > 0 for message in (*messages, *(origins or ())))
    origin = min((message.stamp if stamped else message.logged for message in origins or messages), default=0)

    def seconds(message: BagMessage) -> float:
        # integers first: nanoseconds since 1970 do not fit into a float
        return ((message.stamp if stamped else message.logged) - origin) * 1e-9

    return seconds


@dataclass(frozen=True)
class _Contents:
    file: OpenBag
    states: Sequence[BagMessage]
    places: Sequence[BagMessage]
    mounted: Sequence[BagMessage]  # readings of wrist sensors and IMUs
    topic_of_fields: str  # topic of the fields that the user named; empty without any
    joints_by_default_topic: Mapping[str, set[str]]
    command_topic: str | None  # the default topic that has commands, as its name says


@dataclass(frozen=True)
class _BagOptions(base.JointPointAndUnitOptions):
    """Options of bags: topics, joints and points, with their names in the recording, and units.

    Messages that lack one of the `joints` are skipped. `joints` is required if the messages of a topic differ in their
    joints. The keys of `point_names` are topics, or `TOPIC:CHILD` for a frame of `/tf`. By default, all topics of
    points, poses and transforms except `/tf` are read. The last descriptive part of a topic is then the point's name.
    """

    joint_topics: Sequence[str] | None = None  # topics of joint states; None: all
    # topic of joint states whose positions are commands: `position_command`, held until the next command
    command_topic: str | None = None
    # path of an array by joint channel, `/topic.field.field`, in messages of any type; joints are then named 1, 2, ...
    message_fields: Mapping[str, str] | None = None
    # distance from a pose's origin of the additional points NAME_x, NAME_y and NAME_z on its axes [m]
    pose_axis_point_distance: float | None = None
    point_sensor_name: str = "unknown"  # sensor of the points
    description: str = ""  # what was recorded


_DEFAULTS = _BagOptions()


def _read_bag(
    path: str | os.PathLike[str], options: _BagOptions = _DEFAULTS, progress: Progress = NULL_PROGRESS
) -> Recording:
    """Read a ROS 1 bag, a ROS 2 bag folder or an MCAP file.

    docs/reference/import_formats.md has the types of messages. Points have one group per reference frame. Each topic of
    `WrenchStamped` or `Imu` becomes a group `wrist` or `imu` at the frame of its header.

    Times are header stamps, relative to the first message. If any message has no stamp, all times are recording times.
    A message that repeats time and values of the previous one counts once. A joint channel that is empty or all NaN is
    omitted. `notes` lists unused topics. Raises `DataError` if `rosbags` is not installed, if the bag cannot be read,
    has no usable topic or is ambiguous, or if `validated_recording` refuses the result.
    """
    path, distance = Path(path), options.pose_axis_point_distance
    digest = file_sha256(path)
    if distance is not None and not 0 < distance < float("inf"):
        what, option = f"pose_axis_point_distance is {distance:g} m, but must be above 0", "--pose-axis-point-distance"
        raise DataError(what, where=f"{option}, for {path}", allowed="a finite distance [m]", hint=f"add {option} 0.1")
    bag = _contents(path, tuple(at for at in options.point_names or () if ":" in at), progress, options.message_fields)
    groups, notes = _joints(bag, options, str(path))
    seen = _named_places(bag, options.point_names, str(path))
    if not groups and not seen and not bag.mounted:
        kinds = ", ".join((*_KNOWN, _TREES[0]))
        allowed = f"topics of the types {kinds}, or fields of any: --field position=/TOPIC.FIELD"
        what, hint = "the bag has no joint states and no points", "name the angles: --field position=/TOPIC.FIELD"
        raise bag.file.no_usable_topics_error(what, allowed, hint)
    places = [message for entries in seen.values() for _, message in entries]
    used_messages = [*(m for entry in groups for m in entry.messages), *places, *bag.mounted]
    seconds = time_since_first_message_function(used_messages)
    joint_group, more = _on_one_clock(groups, seconds, str(path))
    if unstamped := sum(message.stamp <= 0 for message in used_messages):
        lost = f"{unstamped} of {len(used_messages)} messages have no stamp"
        more = (*more, f"{lost}, so the times at which the bag received them count")
    points = []
    for frame, entries in seen.items():
        position = _positions(_with_axes(entries, distance), seconds, str(path))
        name = "points" if len(seen) == 1 else "points_" + frame.replace("/", "_")
        points.append(PointGroup(name, *position, None, options.point_sensor_name, frame))
    used = {entry.topic for entry in groups} | {message.source.partition(":")[0] for message in places}
    channels = tuple(_mounted_sensors(bag, groups, seconds))
    if channels and channels[-1].name == ESTIMATED_WRENCH_GROUP_NAME:
        said = "computed by the robot's driver from the joint torques, without the loads that it knows"
        more = (*more, f"{ESTIMATED_WRENCH_GROUP_NAME} is {said}. Use it in place of the efforts, not with them")
    used |= {message.source for message in bag.mounted}
    turned, names = {m.source for m in places if m.content.axes is not None}, _names_of(bag)
    if turned and distance is None:
        said = f"of {abbreviated_names_text(sorted(turned))}, the orientations were not imported, only the positions. "
        said += "--pose-axis-point-distance 0.1 at the import keeps them as points 0.1 m away on the axes of each pose"
        more = (*more, said)
    others = (_preview_source(topic, bag, names) for topic in bag.file.topics if topic.name not in used)
    reasons = ((s, "not selected" if s.imported_as else s.note) for s in others)
    left = [f"{s.name} was left out ({s.n_samples} of {s.kind}): {reason}" for s, reason in reasons]
    own = options.description, path.name, path.stem, digest
    raw = Recording(joint_group, tuple(points), *own, notes=(*notes, *more, *left), channel_groups=channels)
    return base.convert_to_si_and_validate(raw, str(path), replace(options, joints=None, point_names=None))


def _preview_bag(path: str | os.PathLike[str], progress: Progress = NULL_PROGRESS) -> base.FilePreview:
    path = Path(path)
    bag = _contents(path, None, progress)
    names, options, notes = _names_of(bag), dict[str, Any](), list[str]()
    sources = [_preview_source(topic, bag, names) for topic in bag.file.topics]
    joints, command = bag.joints_by_default_topic, bag.command_topic
    states = [topic for topic in sorted(joints) if topic != command]
    if shared := {one for one in states for other in states if one != other and joints[one] & joints[other]}:
        options["joint_topics"] = [states[0], *(topic for topic in states[1:] if topic not in shared)]
        notes.append(f"{', '.join(sorted(shared))} have joints in common. Choose the measured one by --joint-topic")
    elif len(states) > 1:
        options["joint_topics"] = states
    if any(message.content.axes is not None for message in bag.places if message.source in names):
        notes.append("poses have orientations. --pose-axis-point-distance 0.1 keeps them as points 0.1 m along axes")
    units, why = base.guess_non_si_units(_for_guess(bag, names))
    has_equal_names = len({*names.values()}) < len(names)  # which an import refuses
    told = (("command_topic", command), ("point_names", names if has_equal_names else {}), ("units", units))
    options |= {key: found for key, found in told if found}
    return base.FilePreview(tuple(sources), options, (*notes, *why))


for _kind in (".bag", ".mcap", ".db3", "folder"):
    base.READERS.register(_kind)(_read_bag)
    base.FILE_PREVIEWERS.register(_kind)(_preview_bag)


def _contents(
    path: Path, trees: Sequence[str] | None, progress: Progress, fields: Mapping[str, str] | None = None
) -> _Contents:
    """Decode the usable messages of a bag. `trees` lists the frames of transform trees to decode (None: all)."""
    bag, states, places, mounted = OpenBag(path), list[BagMessage](), list[BagMessage](), list[BagMessage]()
    own_topic, paths = _topic_and_paths(bag, fields or {})
    lists = {**dict.fromkeys(_JOINT_TYPES, states), **dict.fromkeys(_GROUP_BY_MESSAGE_TYPE, mounted)}
    wanted_kinds = _KNOWN if trees is not None and not trees else (*_KNOWN, *_TREES)
    with bag.raise_read_errors_as_data_errors(), closing(bag.reader) as reader:
        wanted = [c for c in reader.connections if c.topic == own_topic or c.msgtype in wanted_kinds]
        # without definitions, as in older ROS 2 bags, only common types can be read
        wanted = [c for c in wanted if c.topic == own_topic or c.msgtype in reader.typestore.fielddefs]
        total = sum(connection.msgcount for connection in wanted)
        # an empty selection would mean all topics, including images
        for done, (connection, logged, data) in enumerate(reader.messages(wanted) if wanted else ()):
            if done % _PROGRESS_INTERVAL == 0:
                progress.report_parts_done(done, total, "messages")
            content: Any = reader.deserialize(data, connection.msgtype)
            if connection.topic == own_topic:
                values = joint_values_from_message_fields(content, paths, f"{path}: {own_topic}")
                states.append(BagMessage(own_topic, int(logged), _stamp(content), values))
                continue
            for source, part, kind in _parts_of_message(connection.topic, content, connection.msgtype):
                if connection.msgtype not in _TREES or trees is None or source in trees:
                    lists.get(kind, places).append(BagMessage(source, int(logged), _stamp(part), _plain(part, kind)))
    usual = _default_joint_topics(bag)
    joints, command = base.joints_and_command_topic((m.source, m.content.name) for m in states if m.source in usual)
    return _Contents(bag, states, places, mounted, own_topic, joints, command)


def _parts_of_message(topic: str, content: Any, kind: str) -> Iterator[tuple[str, Any, str]]:
    """Yield source, content and type of the frames of a tree or poses of an array; of others, the message itself."""
    if kind in _TREES:
        yield from ((f"{topic}:{part.child_frame_id.strip('/')}", part, _POSES[2]) for part in content.transforms)
    elif kind == _POSE_ARRAY:
        for i, pose in enumerate(content.poses):
            yield f"{topic}:{i + 1}", SimpleNamespace(header=content.header, pose=pose), _POSES[0]
    else:
        yield topic, content, kind


def _topic_and_paths(bag: OpenBag, fields: Mapping[str, str]) -> tuple[str, dict[str, str]]:
    """Split fields `/topic.field.field` into their common topic (empty without fields) and a field path by channel."""
    split = {channel: text.partition(".") for channel, text in fields.items()}
    topics = sorted({topic for topic, _, _ in split.values()})
    where, allowed = str(bag.path), "entries CHANNEL=/TOPIC.FIELD of one topic, one of them for position"
    for channel, (topic, _, path) in split.items():
        bag.check_topic_is_one_of(topic, [known.name for known in bag.topics], "messages")
        if not path:
            what, hint = f"'{channel}={topic}' names a topic, but no field", f"write --field {channel}={topic}.FIELD"
            raise DataError(what, where=where, allowed=allowed, hint=hint)
    if len(topics) > 1 or (fields and "position" not in fields):
        what = f"the fields belong to {len(topics)} topics" if len(topics) > 1 else "the channel position has no field"
        hint = "choose fields of one topic" if len(topics) > 1 else f"add --field position={topics[0]}.FIELD"
        raise DataError(what, where=where, allowed=allowed, hint=hint)
    return next(iter(topics), ""), {channel: path for channel, (_, _, path) in split.items()}


def _default_joint_topics(bag: OpenBag) -> list[str]:
    """Topics of joint states or, without any, of other messages with joints."""
    return bag.topic_names_of_types(JOINT_STATE_MESSAGE_TYPE) or bag.topic_names_of_types(*JOINT_VALUE_READERS)


def _stamp(content: Any) -> int:
    header = getattr(content, "header", None)
    return 0 if header is None else int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


def _plain(content: Any, kind: str) -> SimpleNamespace:
    if kind in JOINT_VALUE_READERS:
        return JOINT_VALUE_READERS[kind](content)
    frame = str(content.header.frame_id)
    if kind == JOINT_STATE_MESSAGE_TYPE:
        values = {key: np.asarray(getattr(content, key), float).ravel() for key in ("position", "velocity", "effort")}
        return SimpleNamespace(frame=frame, name=[str(name) for name in content.name], **values)
    if kind in _GROUP_BY_MESSAGE_TYPE:
        return SimpleNamespace(frame=frame, **_vectors(content, kind))
    if kind == _POINT_STAMPED:
        return SimpleNamespace(frame=frame, point=_numbers(content.point, "xyz"), axes=None)
    if kind == _POSES[2]:
        place, turn = content.transform.translation, content.transform.rotation
    else:
        pose = content.pose.pose if kind == _POSES[1] else content.pose
        place, turn = pose.position, pose.orientation
    return SimpleNamespace(frame=frame, point=_numbers(place, "xyz"), axes=_numbers(turn, "xyzw"))


def _vectors(content: Any, kind: str) -> dict[str, Any]:
    """Values by quantity, and variances of their components if the message states them."""
    if kind == _WRENCH:
        return {"values": {name: _numbers(getattr(content.wrench, name), "xyz") for name in ("force", "torque")}}
    parts = {"angular_velocity": "angular_velocity", "specific_force": "linear_acceleration"}
    variances = {name: np.asarray(getattr(content, f"{own}_covariance"), float)[::4] for name, own in parts.items()}
    return {
        "values": {name: _numbers(getattr(content, own), "xyz") for name, own in parts.items()},
        "variances": {name: own for name, own in variances.items() if np.all(own >= 0) and np.any(own > 0)},
    }


def _numbers(content: Any, names: str) -> tuple[float, ...]:
    return tuple(float(getattr(content, name)) for name in names)


def _mounted_sensors(
    bag: _Contents, groups: Sequence[_States], seconds: Callable[[BagMessage], float]
) -> Iterator[SensorChannelGroup]:
    """Yield a group for each topic of wrenches or inertial readings, and for a wrench that a driver estimates."""
    for kind, group in _GROUP_BY_MESSAGE_TYPE.items():
        topics = _names_of(bag, kind)
        for topic, name in topics.items():
            messages = [message for message in bag.mounted if message.source == topic]
            yield from _sensor_group(group if len(topics) == 1 else f"{group}_{name}", name, messages, seconds)
    told = ([replace(m, content=w) for m in e.messages if (w := getattr(m.content, "wrench", None))] for e in groups)
    yield from _sensor_group(ESTIMATED_WRENCH_GROUP_NAME, "", next(filter(None, told), []), seconds)


def _sensor_group(
    group: str, name: str, messages: Sequence[BagMessage], seconds: Callable[[BagMessage], float]
) -> Iterator[SensorChannelGroup]:
    if messages := sorted(messages, key=seconds):
        first = messages[0].content
        values = {key: np.array([[m.content.values[key]] for m in messages]) for key in first.values}
        stds = {f"{key}_std": math.sqrt(own.mean()) for key, own in getattr(first, "variances", {}).items()}
        t = np.array([seconds(message) for message in messages])
        yield SensorChannelGroup(group, (first.frame.strip("/") or name,), t, values, stds)


class _States(NamedTuple):
    """Joint states of one topic: recorded and wanted names, messages, and whether they are commands."""

    topic: str
    names: tuple[str, ...]
    wanted: tuple[str, ...]
    messages: Sequence[BagMessage]
    command: bool = False


def _joints(bag: _Contents, options: _BagOptions, where: str) -> tuple[list[_States], tuple[str, ...]]:
    topics, command, notes = options.joint_topics, options.command_topic, list[str]()
    if topics is None and command is None and not bag.topic_of_fields and (command := bag.command_topic):
        notes.append(f"{command} has commands, as its name says. If they are measured, add --joint-topic {command}")
    default = [bag.topic_of_fields] if bag.topic_of_fields else _default_joint_topics(bag.file)
    known = list(dict.fromkeys([*bag.file.topic_names_of_types(*_JOINT_TYPES), *default]))
    for topic in (*(topics or ()), *((command,) if command else ())):
        bag.file.check_topic_is_one_of(topic, known, "joint states")
    chosen = [topic for topic in (default if topics is None else topics) if topic != command]
    sent = dict.fromkeys(name for m in bag.states if m.source in chosen for name in m.content.name)
    wanted = None if options.joints is None else base.parse_old_to_new_joint_names(options.joints, sent, where)
    found = []
    if wanted is not None:
        _check_together(bag, chosen, wanted, where)
    for topic in chosen:
        messages = [message for message in bag.states if message.source == topic]
        sets = {tuple(sorted(message.content.name)): tuple(message.content.name) for message in messages}
        if wanted is None and len(sets) > 1:
            what, hint = f"the {len(messages)} messages have {len(sets)} different sets of joints", "choose one set"
            allowed = "one of the sets: " + "; ".join(", ".join(names) for names in sets.values())
            raise DataError(what, where=f"{where}: {topic}", allowed=allowed, hint=f"{hint}: --joints NAME,NAME")
        names = next(iter(sets.values()), ()) if wanted is None else _own(wanted, sets.values())
        kept = [message for message in messages if names and set(names) <= set(message.content.name)]
        if (skipped := len(messages) - len(kept)) and names:
            lacking = ", ".join(name for name in names if any(name not in m.content.name for m in messages))
            notes.append(f"{skipped} of {len(messages)} messages of {topic} gave no sample, as they lack {lacking}")
        if kept:
            renamed = names if wanted is None else tuple(wanted[name] for name in names)
            found.append(_States(topic, names, renamed, kept))
    if command is not None:
        messages = [message for message in bag.states if message.source == command]
        names = tuple(name for entry in found for name in entry.names)
        kept = [message for message in messages if set(names) <= set(message.content.name)]
        if not kept or not names:
            allowed, hint = f"messages with {', '.join(names) or 'the joints'}", "choose another --command-topic TOPIC"
            what = f"none of the {len(messages)} messages of '{command}' has all joints"
            raise DataError(what, where=where, allowed=allowed, hint=hint)
        found.append(_States(command, names, tuple(n for entry in found for n in entry.wanted), kept, True))
    return found, tuple(notes)


def _own(wanted: Mapping[str, str], sets: Iterable[Sequence[str]]) -> tuple[str, ...]:
    """The largest set of wanted joints that occur together in messages of one topic."""
    return max((tuple(name for name in wanted if name in names) for names in sets), key=len, default=())


def _check_together(bag: _Contents, topics: Sequence[str], wanted: Mapping[str, str], where: str) -> None:
    sets = {tuple(message.content.name): message.source for message in bag.states if message.source in topics}
    known = sorted({name for names in sets for name in names})
    allowed = "; ".join(dict.fromkeys(", ".join(names) for names in sets)) or "no joints were recorded"
    for name in wanted:
        if name not in known:
            hint = nearest_name_question(name, known) or f"choose recorded joints: --joints {','.join(known[:2])}"
            raise DataError(f"the bag has no joint '{name}'", where=where, allowed=allowed, hint=hint)
    got = {name for topic in topics for name in _own(wanted, [n for n, source in sets.items() if source == topic])}
    if got != set(wanted):
        what, allowed = f"no message has all of {', '.join(wanted)}", f"joints of one of these sets: {allowed}"
        raise DataError(what, where=where, allowed=allowed, hint="choose joints of one set: --joints NAME,NAME")


def _on_one_clock(
    groups: Sequence[_States], seconds: Callable[[BagMessage], float], where: str
) -> tuple[JointGroup | None, tuple[str, ...]]:
    if not groups:
        return None, ()
    made = [(e.topic, _joint_group(e, seconds, f"{where}: {e.topic}")) for e in groups if not e.command]
    together, notes = base.joints_on_fastest_clock(made, where, "choose what is measured: --joint-topic TOPIC,TOPIC")
    for entry in (entry for entry in groups if entry.command):
        group = _joint_group(entry, seconds, f"{where}: {entry.topic}")
        # each command is held until the next; before the first command, the first one is used
        held = group.position[np.maximum(np.searchsorted(group.t, together.t + 1e-9, side="right") - 1, 0)]
        together = replace(together, position_command=held)
    return together, notes


def _joint_group(entry: _States, seconds: Callable[[BagMessage], float], where: str) -> JointGroup:
    states = sorted(entry.messages, key=seconds)
    t = np.array([seconds(message) for message in states])
    channels: dict[str, Any] = {}
    for channel in JOINT_CHANNEL_UNITS:
        rows = []
        for message in states:
            values, own = getattr(message.content, channel, ()), message.content.name
            if len(values) == len(own):
                rows.append([values[own.index(name)] for name in entry.names])
            elif len(values):
                what = f"a message has {len(values)} values of '{channel}' for {len(own)} joints"
                what += f", {seconds(message):.4g} s after the first message"
                hint = "correct the node that publishes the topic, or choose another topic with --joint-topic"
                raise DataError(what, where=where, allowed="one value for each joint, or none", hint=hint)
        if rows and len(rows) < len(states):
            what = f"{len(states) - len(rows)} of {len(states)} messages lack '{channel}'"
            allowed = "a channel in all messages, or in none"
            raise DataError(what, where=where, allowed=allowed, hint="choose another topic: --joint-topic TOPIC")
        if rows and not np.isnan(rows).all():
            channels[channel] = np.array(rows)
    if "position" not in channels:
        allowed, hint = "messages whose `position` is filled", "choose another topic: --joint-topic TOPIC"
        raise DataError(f"the {len(states)} joint states have no positions", where=where, allowed=allowed, hint=hint)
    values = np.hstack([t[:, None], *channels.values()])
    own = np.append(True, (np.diff(values, axis=0) != 0).any(axis=1))  # a message that is sent twice counts once
    return JointGroup(entry.wanted, t[own], **{name: values[own] for name, values in channels.items()})


def _names_of(bag: _Contents, *kinds: str) -> dict[str, str]:
    """Names by source, for topics of the types `kinds` (default: points): the last descriptive part of the topic.

    Poses of arrays have numbers. If arrays of a topic differ in length, a number is not always one point: no names.
    """
    names = dict[str, str]()
    counts = Counter(message.source for message in bag.places)
    arrays = bag.file.topic_names_of_types(_POSE_ARRAY)
    for topic in bag.file.topic_names_of_types(*(kinds or _PLACES)):
        parts = [part for part in topic.split("/") if part]
        name = ([part for part in parts if part.lower() not in _PLAIN_WORDS] or parts)[-1]
        own = [source for source in counts if source.partition(":")[0] == topic] if topic in arrays else [topic]
        if len({counts[source] for source in own}) == 1:
            names |= {source: name + source.removeprefix(topic).replace(":", "_") for source in own}
    return names


def _named_places(
    bag: _Contents, points: Mapping[str, str] | None, where: str
) -> dict[str, list[tuple[str, BagMessage]]]:
    """Names and messages of the points by reference frame. `points`: None for all except frames of transform trees."""
    present = sorted({message.source for message in bag.places})
    names = _names_of(bag) if points is None else dict(points)
    known = [*present, *(f"{tree}:FRAME" for tree in bag.file.topic_names_of_types(*_TREES))]
    for source in () if points is None else names:
        if source not in present:
            bag.file.check_topic_is_one_of(source, known, "points")
    base.check_unique_point_names(names, where)
    named = ((names[message.source], message) for message in bag.places if message.source in names)
    return grouped((own[1].content.frame.strip("/") or "unknown", own) for own in named)


def _with_axes(entries: Iterable[tuple[str, BagMessage]], distance: float | None) -> Iterator[tuple[str, BagMessage]]:
    """Yield the points and, if `distance` [m] is given, three more points at this distance on the axes of each pose."""
    from scipy.spatial.transform import Rotation

    for name, message in entries:
        yield name, message
        turn = message.content.axes
        if turn is None or distance is None:
            continue
        # a quaternion of zero length has no rotation
        rotation = Rotation.from_quat(turn).as_matrix() if any(turn) else np.full((3, 3), np.nan)
        for axis, direction in zip("xyz", rotation.T, strict=True):
            place = tuple(np.array(message.content.point) + distance * direction)
            content = SimpleNamespace(**{**vars(message.content), "point": place})
            yield f"{name}_{axis}", replace(message, content=content)


def _positions(
    entries: Iterable[tuple[str, BagMessage]], seconds: Callable[[BagMessage], float], where: str
) -> tuple[tuple[str, ...], Array, Array]:
    """Names, times [s] and positions (N, np, 3) [m] of the points; NaN if a point has no message at a time."""
    seen: dict[tuple[float, str], tuple[float, ...]] = {}
    for point, message in entries:
        time, place = seconds(message), message.content.point
        if seen.setdefault((time, point), place) != place:
            what, where = f"point '{point}' has two positions at {time:g} s", f"{where}: {message.source}"
            hint = "of two topics, rename one (--points TOPIC=POINT); of one topic, remove a message with this time"
            raise DataError(what, where=where, allowed="one position of a point at a time", hint=hint)
    times, names = sorted({time for time, _ in seen}), sorted({point for _, point in seen})
    rows, columns = ({key: index for index, key in enumerate(keys)} for keys in (times, names))
    array = np.full((len(times), len(names), 3), np.nan)
    for (time, point), coordinates in seen.items():
        array[rows[time], columns[point]] = coordinates
    return tuple(names), np.array(times), array


def _preview_source(topic: _BagTopic, bag: _Contents, names: Mapping[str, str]) -> base.TopicOrColumnSummary:
    own = [m for m in (*bag.states, *bag.places, *bag.mounted) if m.source.partition(":")[0] == topic.name]
    logged, frames = [m.logged for m in own], ", ".join(dict.fromkeys(m.content.frame for m in own))
    span = 1e-9 * (max(logged) - min(logged)) if logged else 0.0
    rate = (topic.n_messages - 1) / span if span > 0 else float("nan")
    becomes, note = "", f"its type is not known. For joint values, add --field position={topic.name}.FIELD"
    if topic.kind in JOINT_VALUE_READERS and topic.name not in _default_joint_topics(bag.file):
        note = f"joints, left out because the bag has joint states. To use them, add --joint-topic {topic.name}"
    elif topic.kind in _JOINT_TYPES:
        joints = list(dict.fromkeys(joint for message in own for joint in message.content.name))
        kind = "commands" if topic.name == bag.command_topic else "joints"
        becomes, note = f"{kind} {', '.join(joints)}", ""
    elif points := [name for source, name in names.items() if source.partition(":")[0] == topic.name]:
        becomes, note = f"point {', '.join(points)}", f"in {frames}" if frames else ""
    elif topic.kind == _POSE_ARRAY:
        note = f"arrays of different lengths. To use a point of them, add --points {topic.name}:NUMBER=POINT"
    elif topic.kind in _GROUP_BY_MESSAGE_TYPE:
        becomes, note = f"{_GROUP_BY_MESSAGE_TYPE[topic.kind]} on {frames or topic.name}", ""
    elif topic.kind in _TREES:
        children = abbreviated_names_text(sorted({m.source.partition(":")[2] for m in own})) or "(see --preview)"
        note = f"frames {children}. To use one, add --points {topic.name}:FRAME=POINT"
    return base.TopicOrColumnSummary(*topic, rate, *((becomes, note) if topic.n_messages else ("", "no messages")))


def _for_guess(bag: _Contents, names: Mapping[str, str]) -> Recording:
    """Recording with the angles and points of a bag in their own units, from which the units are guessed."""
    widest = [float(np.nanmax(np.abs(m.content.position), initial=0.0)) for m in bag.states]
    joints = JointGroup(("any",), np.arange(float(len(widest))) * 1e-3, np.array(widest)[:, None]) if widest else None
    own = np.array([m.content.point for m in bag.places if m.source in names], float).reshape(-1, 1, 3)
    points = (PointGroup("points", ("any",), np.arange(float(len(own))) * 1e-3, own),) if len(own) else ()
    return Recording(joints, points)
