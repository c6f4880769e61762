"""Interpretation of columns, tables and messages of loggers, motion capture exports and robot drivers."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from yid_ocp.arrays import Array
from yid_ocp.data.recording import JOINT_CHANNEL_UNITS, PointGroup
from yid_ocp.errors import DataError, require_known_names, unknown_name_error_arguments

AXES = ("x", "y", "z")
ColumnMeaning = tuple[str, str] | None
"""Meaning of a column: ("t", ""), (channel, joint), (axis, point), (component, sensor), or None if it is omitted."""
_EXACT_PREFIXES = {"q_": "position", **{f"{channel}_": channel for channel in JOINT_CHANNEL_UNITS}}
# words of column names of common tools; case counts in `tau_J`: `tau_j1` is of a joint `j1`
_WORDS = json.loads((Path(__file__).parent / "defaults" / "header_words.json").read_text("utf-8"))
_CHANNEL_BY_WORD = {word: channel for channel, words in _WORDS["channels"].items() for word in words}
_LONGEST_FIRST = sorted(_CHANNEL_BY_WORD, key=len, reverse=True)
_TOPIC_PREFIX = re.compile(r"(?:field_|(?:\w*_)?joint_states?_)(?=.)", re.IGNORECASE)
UNIT_BY_WORD: Mapping[str, str] = {word: unit for unit, words in _WORDS["units"].items() for word in words}
"""Units in the spellings of headers, in lower case."""
COUNTER_WORDS = frozenset(_WORDS["counters"])  # names of columns that count rows, in lower case
_NUMBERED_COMMAND = re.compile(r"q_(d|des|ref|cmd)_\d+")  # of a joint without a name
_NO_POINT = re.compile(r"(.*_)?(force|torque|moment|velocity|acceleration|orientation|rotation|quaternion)", re.I)
_BRACKETED_UNIT = re.compile(r"(.+?)[\s_]*[\[(]\s*([^\[\]()]+?)\s*[\])]")
_SUFFIXED_UNIT = re.compile(rf"(.+?)_({'|'.join(sorted(map(re.escape, UNIT_BY_WORD), key=len, reverse=True))})", re.I)


def column_meanings(header: Sequence[str], sensor_components: Sequence[str]) -> tuple[list[ColumnMeaning], list[str]]:
    """Return the meaning of each column of `header` (None if unclear), and the unit that its name states (empty: none).

    `sensor_components` are components of vectors measured by sensors on a link, such as `force_x`.
    """
    split = [_split_unit(name, sensor_components) for name in header]
    whole = {name.strip().lower() for name, _ in split}
    meanings = list[ColumnMeaning]()
    for name, _ in split:
        meaning = _exact_meaning(name, sensor_components) or _spelled_meaning(name) or _joint_force(name, meanings)
        if meaning is None and set(AXES) <= whole and name.strip().lower() in AXES:
            meaning = name.strip().lower(), "marker"  # a table of one point
        meanings.append(meaning)
    return meanings, [unit for _, unit in split]


def _split_unit(column: str, sensor_components: Sequence[str]) -> tuple[str, str]:
    """Name and unit (empty: none) of a column such as `time [ms]` or `q1_deg`. An unknown unit gives no name."""
    if (bracketed := _BRACKETED_UNIT.fullmatch(column)) and not bracketed[2].isdecimal():
        name, unit = bracketed[1], UNIT_BY_WORD.get(bracketed[2].lower(), "")
        if unit or _exact_meaning(name, sensor_components) or _spelled_meaning(name):
            return name if unit else "", unit
    if _exact_meaning(column, sensor_components) is None and (suffixed := _SUFFIXED_UNIT.fullmatch(column)):
        name = suffixed[1]
        unit = UNIT_BY_WORD[suffixed[2].lower()]
        if _exact_meaning(name, sensor_components) or _spelled_meaning(name):
            return name, unit
        if unit in ("deg", "rad"):
            return f"q_{name}", unit  # the angle of the joint of this name
    return column, ""


def _exact_meaning(column: str, sensor_components: Sequence[str]) -> ColumnMeaning:
    """Meaning in this package's own spelling, in which joints, points and sensors keep their names."""
    if column.lower() in _WORDS["time"]:
        return "t", ""
    for prefix in sorted(_EXACT_PREFIXES, key=len, reverse=True):
        if column.startswith(prefix) and column != prefix:
            found = _EXACT_PREFIXES[prefix], column.removeprefix(prefix)
            return None if _NUMBERED_COMMAND.fullmatch(column) else found
    kind, _, name = column.partition(":")
    if name and kind in (*JOINT_CHANNEL_UNITS, *AXES, *sensor_components):
        return kind, name
    for component in sorted(sensor_components, key=len, reverse=True):
        if (name := column.removesuffix(f"_{component}")) not in ("", column):
            return component, name
    point, _, axis = column.rpartition("_")
    return (axis, point) if point and axis in AXES and not _NO_POINT.fullmatch(point) else None


def _spelled_meaning(column: str) -> ColumnMeaning:
    """Meaning in the spelling of other tools: `pos_elbow`, `elbow.vel`, `tau_J[0]`, `/joint_states/elbow/effort`."""
    plain = re.sub(r"[\s./:\-\[\]%]+", "_", column).strip("_")
    if plain.lower() in _WORDS["time"] or plain.lower() in ("field_header_stamp", "header_stamp_sec"):
        return "t", ""
    if axis := re.fullmatch(r"(.+?)_([xyzXYZ])", plain):
        return None if _NO_POINT.fullmatch(axis[1]) else (axis[2].lower(), axis[1])
    plain = _TOPIC_PREFIX.sub("", plain, count=1) if _TOPIC_PREFIX.match(plain) else plain
    for word in _LONGEST_FIRST:
        channel = _CHANNEL_BY_WORD[word]
        case = re.IGNORECASE if word.islower() else 0
        end = word.removeprefix("joint_")  # `joint` belongs to a name before it, such as `elbow_joint.position`
        if found := re.fullmatch(rf"{word}_?(\d+)|{word}_(.+)|(?:q_?(?=\d+_))?(.+)_{end}", plain, case):
            return channel, found[1] or found[2] or found[3]
    return None


def _joint_force(column: str, known: Sequence[ColumnMeaning]) -> ColumnMeaning:
    """Effort of a joint, such as a rail, in a column named after its force, if its position is among `known`."""
    found = re.fullmatch(r"(.*?)[\s_.]+(?:force|f)(?:_n)?", column, re.IGNORECASE)
    return ("effort", found[1]) if found and ("position", found[1]) in known else None


_Rows = Iterable[tuple[int, list[str]]]
_VICON_SECTIONS = ("Trajectories", "Devices", "Model Outputs", "Joints", "Segments")
_UNITS = {"mm": "mm", "millimeters": "mm", "cm": "cm", "centimeters": "cm", "m": "m", "meters": "m"}
_MocapTable = tuple[PointGroup, str, tuple[str, ...]]  # points in the file's own unit, this unit, notes for the user


def select_mocap_table_reader(first_row: Sequence[str]) -> Callable[[_Rows, str], _MocapTable] | None:
    """Return the reader of a motion capture export, chosen by the table's first row. Returns None for other tables."""
    readers = {"Format Version": _read_motive, "NO_OF_FRAMES": _read_qualisys}
    readers |= dict.fromkeys(_VICON_SECTIONS, _read_vicon)
    return readers.get(first_row[0].strip()) if first_row else None


def _read_motive(rows: _Rows, where: str) -> _MocapTable:
    """Read positions of rigid bodies and markers from an export of Motive. Rotations and fit errors are omitted."""
    head, body = list[list[str]](), list[list[str]]()
    for _, cells in rows:
        (body if head and head[-1][:1] == ["Frame"] else head).append([cell.strip() for cell in cells])
    said = dict(zip(head[0][::2], head[0][1::2], strict=False))
    by_label = {(row[1] if len(row) > 1 else ""): row for row in head[1:]}
    axes, kinds, names = head[-1], by_label.get("Type", []), by_label.get("Name", [])
    quantities = next((row for row in head[1:-1] if "Position" in row), [])
    if axes[:1] != ["Frame"] or len(axes) < 2 or not (kinds and names and quantities):
        known = {"Type": kinds, "Name": names, "Rotation or Position": quantities}
        lost = [f"a row {word}" for word, cells in known.items() if not cells]
        raise _broken(where, " and ".join(lost) or "a row Frame, Time (Seconds) above the numbers")
    columns: dict[str, range] = {}
    for i in range(2, min(len(axes) - 2, len(names))):
        if quantities[i : i + 3] == ["Position"] * 3 and axes[i : i + 3] == ["X", "Y", "Z"] and names[i]:
            columns.setdefault(names[i], range(i, i + 3))
    table = _numbers(body, len(axes), where)
    unit = _UNITS.get(said.get("Length Units", "Meters").lower(), "m")
    notes = ["Motive's y axis is up by default, and positions are not rotated. Check that the export has z up"]
    if len({names[i] for i in range(2, min(len(names), len(axes)))} - {""}) > len(columns):
        notes.append("rigid bodies and markers without a position were left out")
    return _made(table[:, 1], columns, table, unit, "OptiTrack", notes, where)


def _read_vicon(rows: _Rows, where: str) -> _MocapTable:
    lines = [[cell.strip() for cell in cells] for _, cells in rows]
    begin = next((i for i, cells in enumerate(lines) if cells[:1] == ["Trajectories"]), None)
    if begin is None or len(lines) < begin + 6:
        raise _broken(where, "a section Trajectories with rate, names, Frame, Sub Frame, X, Y, Z and units")
    rate, named, axes, units, *body = lines[begin + 1 :]
    end = next((i for i, cells in enumerate(body) if cells[0] in _VICON_SECTIONS or not any(cells)), len(body))
    table = _numbers(body[:end], len(axes), where)
    columns: dict[str, range] = {}
    for i, name in enumerate(named):
        if name and [axis.upper() for axis in axes[i : i + 3]] == ["X", "Y", "Z"]:
            columns[name] = range(i, i + 3)
    short = {name.rpartition(":")[2]: at for name, at in columns.items()}
    columns = short if len(short) == len(columns) else columns
    unit = _UNITS.get(next((cell for cell in units if cell), "mm").lower(), "mm")
    frequency = _frequency(rate, where, "the rate in Hz in the line below Trajectories")
    return _made((table[:, 0] - table[0, 0]) / frequency, columns, table, unit, "Vicon", [], where)


def _read_qualisys(rows: _Rows, where: str) -> _MocapTable:
    """Read markers from an export of QTM (Qualisys). Three zeros mean that a marker was not seen."""
    said, body, head = dict[str, list[str]](), list[list[str]](), list[str]()
    for _, cells in rows:
        row = [cell.strip() for cell in cells]
        if not body and row[0] and not _is_number(row[0]):
            said.setdefault(row[0], row[1:])
            head = row if row[0] == "Frame" else head
        else:
            body.append(row)
    names = [name for name in said.get("MARKER_NAMES", []) if name]
    first = 2 if head else 0  # frame and time
    table = _numbers(body, max(map(len, body), default=0), where)
    frequency = _frequency(said.get("FREQUENCY", []), where, "FREQUENCY and MARKER_NAMES in the header")
    if not names or table.shape[1] < first + 3 * len(names):
        raise _broken(where, "MARKER_NAMES and three columns for each")
    columns = {name: range(first + 3 * i, first + 3 * i + 3) for i, name in enumerate(names)}
    for at in columns.values():
        table[np.ix_((table[:, at] == 0).all(axis=1), list(at))] = math.nan
    t = table[:, 1] if head else np.arange(len(table)) / frequency
    return _made(t, columns, table, "mm", "Qualisys", [], where)


def _frequency(cells: Sequence[str], where: str, allowed: str) -> float:
    if not (cells and _is_number(cells[0]) and 0 < float(cells[0]) < math.inf):
        raise _broken(where, allowed)
    return float(cells[0])


def _made(
    t: Array, columns: dict[str, range], table: Array, unit: str, program: str, notes: list[str], where: str
) -> _MocapTable:
    if not columns or not len(table):
        raise _broken(where, "markers or rigid bodies with positions")
    position = np.stack([table[:, list(at)] for at in columns.values()], axis=1)
    position[np.isnan(position).any(axis=2)] = math.nan
    group = PointGroup("points", tuple(columns), t, position, None, program, clock="nominal")
    return group, unit, (f"the file is an export of {program} with {len(columns)} points in {unit}", *notes)


def _numbers(rows: Sequence[Sequence[str]], n_columns: int, where: str) -> Array:
    """Table (rows, `n_columns`) of the numbers in the cells; NaN for an empty or missing cell."""
    table = np.full((len(rows), n_columns), math.nan)
    for i, row in enumerate(rows):
        for j, cell in enumerate(row[:n_columns]):
            if cell and cell.upper() != "NULL":
                if not _is_number(cell):
                    place, hint = f"{where}, row {i + 1} of the data", "export the motion again, or empty this cell"
                    allowed = "numbers, NULL and empty cells"
                    raise DataError(f"the cell '{cell}' is not a number", where=place, allowed=allowed, hint=hint)
                table[i, j] = float(cell)
    return table


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _broken(where: str, lacking: str) -> DataError:
    allowed, hint = "an export with its whole header, not edited", "export the motion again, and do not edit the file"
    return DataError(f"the motion capture export lacks {lacking}", where=where, allowed=allowed, hint=hint)


ESTIMATED_WRENCH_GROUP_NAME = "wrist_estimated"
"""Recording group of the external wrench that a driver estimates from joint torques, in the frame that it states."""
_UR_JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")


def joint_values_from_message_fields(content: Any, paths: Mapping[str, str], where: str) -> SimpleNamespace:
    """Read joint values from the decoded message `content`. `paths` maps each channel to the path of an array.

    Joints are named 1, 2 and so on. Raises `DataError` if a channel is unknown, or a path is missing or not numeric.
    """
    found: dict[str, Any] = {}
    require_known_names(paths, JOINT_CHANNEL_UNITS, "joint channel", where, DataError)
    for channel, path in paths.items():
        value, hint = content, f"choose another field: --field {channel}=/TOPIC.FIELD"
        for part in path.split("."):
            if not hasattr(value, part):
                known = [name for name in getattr(value, "__dataclass_fields__", {}) if not name.startswith("_")]
                what = f"the message has no field '{path}'"
                raise DataError(what, where=where, **unknown_name_error_arguments(part, known, hint))
            value = getattr(value, part)
        try:
            found[channel] = np.asarray(value, float).ravel()
        except (TypeError, ValueError) as error:
            what, allowed = f"the field '{path}' is not numeric", "an array of numbers, one for each joint"
            raise DataError(what, where=where, allowed=allowed, hint=hint) from error
    return _values([str(i + 1) for i in range(max((len(values) for values in found.values()), default=0))], found)


def _franka_state(content: Any) -> SimpleNamespace:
    """Joint values of a message of Franka's ROS 1 driver, which does not name the joints."""
    torque = content.tau_J if hasattr(content, "tau_J") else content.tau_j
    own = {"position": content.q, "velocity": content.dq, "effort": torque, "position_command": content.q_d}
    own["external_effort"] = content.tau_ext_hat_filtered
    known, wrench = getattr(content, "K_F_ext_hat_K", None), None
    if known is not None:
        wrench = SimpleNamespace(frame="K", values={"force": tuple(known[:3]), "torque": tuple(known[3:])})
    return _values([f"panda_joint{i + 1}" for i in range(len(content.q))], own, wrench)


def _franka_robot_state(content: Any) -> SimpleNamespace:
    """Joint values of a message of Franka's ROS 2 driver."""
    measured, external = content.measured_joint_state, content.tau_ext_hat_filtered
    own = {"position": measured.position, "velocity": measured.velocity, "effort": measured.effort}
    own["external_effort"] = getattr(external, "effort", external)
    own["position_command"] = content.desired_joint_state.position
    known, wrench = getattr(content, "k_f_ext_hat_k", None), None
    if known is not None:
        parts = {"force": known.wrench.force, "torque": known.wrench.torque}
        values = {name: (float(part.x), float(part.y), float(part.z)) for name, part in parts.items()}
        wrench = SimpleNamespace(frame=str(known.header.frame_id).strip("/") or "K", values=values)
    return _values(measured.name, own, wrench)


def _dynamic_joint_state(content: Any) -> SimpleNamespace:
    """Values of the joints with a position in a message of ros2_control, and the channels that all of them have."""
    by_joint = {
        str(name): dict(zip(map(str, entry.interface_names), map(float, entry.values), strict=True))
        for name, entry in zip(content.joint_names, content.interface_values, strict=True)
    }
    kept = {name: values for name, values in by_joint.items() if "position" in values}
    channels = [c for c in ("position", "velocity", "effort") if all(c in values for values in kept.values())]
    return _values(kept, {c: [values[c] for values in kept.values()] for c in channels})


def _controller_state(content: Any) -> SimpleNamespace:
    """Joint values of a message of ros2_control's trajectory controller."""
    measured = getattr(content, "feedback", None) or content.actual
    wanted = getattr(content, "reference", None) or content.desired
    own = {"position": measured.positions, "velocity": measured.velocities, "effort": measured.effort}
    return _values(content.joint_names, own | {"position_command": wanted.positions})


def _ur_state(content: Any) -> SimpleNamespace:
    """Joint values of a message of Universal Robots' driver."""
    own = {"position": content.q_actual, "velocity": content.qd_actual, "position_command": content.q_target}
    return _values([f"{name}_joint" for name in _UR_JOINTS], own)


def _values(names: Any, values: Mapping[str, Any], wrench: SimpleNamespace | None = None) -> SimpleNamespace:
    own = {channel: np.asarray(array, float).ravel() for channel, array in values.items() if len(array)}
    return SimpleNamespace(frame="", name=[str(name) for name in names], wrench=wrench, **own)


JOINT_VALUE_READERS: Mapping[str, Callable[[Any], SimpleNamespace]] = {
    "franka_msgs/msg/FrankaState": _franka_state,
    "franka_msgs/msg/FrankaRobotState": _franka_robot_state,
    "control_msgs/msg/DynamicJointState": _dynamic_joint_state,
    "control_msgs/msg/JointTrajectoryControllerState": _controller_state,
    "ur_msgs/msg/RobotStateRTMsg": _ur_state,
}
"""Functions that read joint names and values from messages other than JointState, by message type.

Absent channels are omitted. If the driver estimates an external wrench, `wrench` has its frame and its `values` by
quantity.
"""
