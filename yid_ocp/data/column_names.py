"""What columns of a table mean by their names, as loggers of robots and exports of other tools call them."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from yid_ocp.data.recording import JOINT_CHANNEL_UNITS

_AXES = ("x", "y", "z")
_Meaning = tuple[str, str] | None
"""Of a column: ("t", ""), (channel, joint), (axis, point), (component, sensor), or None where it is left out."""
_EXACT_PREFIXES = {"q_": "position", **{f"{channel}_": channel for channel in JOINT_CHANNEL_UNITS}}
_TIME_WORDS = "t time times timestamp timestamps time_stamp stamp header_stamp sec secs seconds elapsed elapsed_time"
_CHANNEL_WORDS: Mapping[str, str] = {
    "position": "q pos position positions angle angles joint_pos joint_position joint_positions actual_q q_actual",
    "velocity": "dq qd vel velocity velocities speed joint_vel joint_velocity joint_velocities actual_qd dq_actual",
    "effort": "tau eff effort efforts torque torques trq joint_effort joint_torque joint_torques tau_j tau_measured",
    "external_effort": "tau_ext ext_tau external_torque external_effort tau_ext_hat_filtered",
    "position_command": "cmd q_cmd q_des q_d q_ref pos_cmd cmd_pos position_command target_q desired_position",
    "velocity_command": "dq_cmd dq_des dq_d qd_d vel_cmd cmd_vel velocity_command target_qd desired_velocity",
    "torque_enable": "torque_enable",
}
"""Words of loggers: Franka's, UR's, Isaac Sim's, LeRobot's, of ROS and of PlotJuggler."""
_CHANNEL_BY_WORD = {word: channel for channel, words in _CHANNEL_WORDS.items() for word in words.split()}
_LONGEST_FIRST = sorted(_CHANNEL_BY_WORD, key=len, reverse=True)
_TOPIC_PREFIX = re.compile(r"(?:field_|(?:\w*_)?joint_states?_)(?=.)", re.IGNORECASE)
_UNIT_WORDS = {
    **dict.fromkeys(("s", "sec", "secs", "seconds", "second"), "s"),
    **{word: word for word in ("ms", "us", "ns", "m", "cm", "mm", "rad", "deg", "rev", "rpm", "rad/s", "deg/s")},
    **{"degrees": "deg", "radians": "rad", "deg/sec": "deg/s", "rad_s": "rad/s", "deg_s": "deg/s", "rad/sec": "rad/s"},
    **dict.fromkeys(("nm", "n m", "n*m", "n.m", "n·m", "n_m"), "N m"),
    **{"nmm": "N mm", "n mm": "N mm", "n*mm": "N mm", "mnm": "mN m", "mn m": "mN m"},
}
_BRACKETED_UNIT = re.compile(r"(.+?)[\s_]*[\[(]\s*([^\[\]()]+?)\s*[\])]")
_SUFFIXED_UNIT = re.compile(rf"(.+)_({'|'.join(sorted(map(re.escape, _UNIT_WORDS), key=len, reverse=True))})", re.I)


def column_meanings(header: Sequence[str], sensor_components: Sequence[str]) -> tuple[list[_Meaning], dict[str, str]]:
    """Meaning of every column by its name, None where that says nothing, and unit by quantity where names have one.

    `sensor_components` are components of vectors that sensors on a link read, such as `force_x`.
    """
    split = [_split_unit(name, sensor_components) for name in header]
    whole = {name.strip().lower() for name, _ in split}
    meanings: list[_Meaning] = []
    units: dict[str, str] = {}
    for name, unit in split:
        meaning = _exact_meaning(name, sensor_components) or _spelled_meaning(name)
        if meaning is None and set(_AXES) <= whole and name.strip().lower() in _AXES:
            meaning = name.strip().lower(), "marker"  # a table of one point
        meanings.append(meaning)
        if meaning and unit:
            units.setdefault("points" if meaning[0] in _AXES else meaning[0], unit)
    return meanings, units


def _split_unit(column: str, sensor_components: Sequence[str]) -> tuple[str, str]:
    """Name and unit of a column such as `time [ms]` or `q1_deg`; an empty unit where the name has none."""
    if (bracketed := _BRACKETED_UNIT.fullmatch(column)) and (unit := _UNIT_WORDS.get(bracketed[2].lower())):
        return bracketed[1], unit
    if _exact_meaning(column, sensor_components) is None and (suffixed := _SUFFIXED_UNIT.fullmatch(column)):
        name = suffixed[1]
        if _exact_meaning(name, sensor_components) or _spelled_meaning(name):
            return name, _UNIT_WORDS[suffixed[2].lower()]
    return column, ""


def _exact_meaning(column: str, sensor_components: Sequence[str]) -> _Meaning:
    """Meaning in this package's own spelling, of which a joint, point or sensor keeps its name as it stands."""
    if column.lower() in _TIME_WORDS.split():
        return "t", ""
    for prefix in sorted(_EXACT_PREFIXES, key=len, reverse=True):
        if column.startswith(prefix) and column != prefix:
            return _EXACT_PREFIXES[prefix], column.removeprefix(prefix)
    for component in sorted(sensor_components, key=len, reverse=True):
        if (name := column.removesuffix(f"_{component}")) not in ("", column):
            return component, name
    point, _, axis = column.rpartition("_")
    return (axis, point) if point and axis in _AXES else None


def _spelled_meaning(column: str) -> _Meaning:
    """Meaning of what other tools write: `pos_elbow`, `elbow.vel`, `tau1`, `tau_J[0]`, `/joint_states/elbow/effort`."""
    plain = re.sub(r"[\s./:\-\[\]%]+", "_", column).strip("_")
    if plain.lower() in _TIME_WORDS.split() or plain.lower() in ("field_header_stamp", "header_stamp_sec"):
        return "t", ""
    if axis := re.fullmatch(r"(.+?)_([xyzXYZ])", plain):
        return axis[2].lower(), axis[1]
    plain = _TOPIC_PREFIX.sub("", plain, count=1) if _TOPIC_PREFIX.match(plain) else plain
    for word in _LONGEST_FIRST:
        channel = _CHANNEL_BY_WORD[word]
        if found := re.fullmatch(rf"{word}_?(\d+)", plain, re.IGNORECASE):
            return channel, found[1]
        if found := re.fullmatch(rf"{word}_(.+)|(.+)_{word}", plain, re.IGNORECASE):
            return channel, found[1] or found[2]
    return None
