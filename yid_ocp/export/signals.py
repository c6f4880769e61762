"""Export of signals as CSV tables, ROS 2 messages in an MCAP file, and ROS joint trajectories."""

from __future__ import annotations

import csv
import math
import os
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from yid_ocp.arrays import Array
from yid_ocp.data import JointGroup, Recording
from yid_ocp.errors import OutputError, import_optional
from yid_ocp.files import atomic_write, make_folder, os_error_reason

_SignalKind = Literal["joints", "point", "vector", "wrench"]
_MESSAGE_TYPES: Mapping[_SignalKind, str] = {
    "joints": "sensor_msgs/msg/JointState",
    "point": "geometry_msgs/msg/PointStamped",
    "vector": "geometry_msgs/msg/Vector3Stamped",
    "wrench": "geometry_msgs/msg/WrenchStamped",
}
_WORLD_FRAME = "world"


@dataclass(frozen=True)
class RosTopicTimeSeries:
    """The time series of one ROS topic at the times t (M,) [s]. A time without finite values gets no message.

    For the kind `joints`, `values` holds `position`, `velocity` and `effort`, each (M, len(names)). For other kinds it
    holds `xyz` (M, 3): position, vector, or force of a wrench.
    """

    topic: str
    kind: _SignalKind
    t: Array
    values: Mapping[str, Array]
    names: Sequence[str] = ()
    frame: str = _WORLD_FRAME


def export_mcap(signals: Sequence[RosTopicTimeSeries], path: str | os.PathLike[str]) -> float:
    """Write the ROS time series `signals` to one MCAP file with message definitions, sorted by time.

    Returns the shift [s] that was added to all times: whole seconds that make them non-negative, usually zero. Raises
    `OutputError` if `rosbags` is not installed, if there are no samples, or if the file cannot be written.
    """
    path = Path(path)
    import_optional("rosbags", "bags", "writing MCAP needs the package rosbags", OutputError)
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    if not any(len(signal.t) for signal in signals):
        what, hint = "the signals have no samples", "export a recording or run that has samples"
        raise OutputError(what, where=str(path), allowed="signals with one sample or more", hint=hint)
    store = get_typestore(Stores.ROS2_HUMBLE)
    shift = float(max(0.0, -np.floor(min(float(np.min(signal.t)) for signal in signals if len(signal.t)))))
    made = [(stamp, k, told) for k, signal in enumerate(signals) for stamp, told in _messages(signal, shift, store)]
    made.sort(key=lambda entry: entry[:2])
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # a bag is a folder; only its one file is needed
        with tempfile.TemporaryDirectory(dir=path.parent) as folder:
            bag = Path(folder) / "bag"
            with Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
                connections = [writer.add_connection(s.topic, _MESSAGE_TYPES[s.kind], typestore=store) for s in signals]
                for stamp, k, message in made:
                    writer.write(connections[k], stamp, store.serialize_cdr(message, _MESSAGE_TYPES[signals[k].kind]))
            [file] = bag.glob("*.mcap")
            with atomic_write(path) as temporary:
                os.replace(file, temporary)
    except OSError as error:
        what, hint = f"the file cannot be written: {os_error_reason(error)}", "choose another --out, or free disk space"
        raise OutputError(what, where=str(path), allowed="a writable folder with free space", hint=hint) from error
    return shift


def ros_signals_from_recording(recording: Recording) -> list[RosTopicTimeSeries]:
    """Convert a recording to ROS topics `/joint_states`, `/joint_commands`, `/external_efforts` and `/points/...`."""
    found: list[RosTopicTimeSeries] = []
    for group in recording.joint_and_point_groups:
        if isinstance(group, JointGroup):
            for topic, form, names in (
                ("/joint_states", "{}", ("position", "velocity", "effort")),
                ("/joint_commands", "{}_command", ("position", "velocity")),
                ("/external_efforts", "external_{}", ("effort",)),
            ):
                channels = {name: group.values_by_channel.get(form.format(name)) for name in names}
                values = {name: known for name, known in channels.items() if known is not None}
                found += [RosTopicTimeSeries(topic, "joints", group.t, values, group.names)] if values else []
        else:
            for i, name in enumerate(group.names):
                topic, place = f"/points/{group.name}/{name}", {"xyz": group.position[:, i]}
                found.append(RosTopicTimeSeries(topic, "point", group.t, place, frame=group.frame or _WORLD_FRAME))
    return found


def _messages(signal: RosTopicTimeSeries, shift: float, store: Any) -> Iterator[tuple[int, Any]]:
    types = store.types

    def vector(kind: str, xyz: Array) -> Any:
        return types[f"geometry_msgs/msg/{kind}"](*map(float, xyz))

    def content(i: int) -> list[Any]:
        if signal.kind == "joints":
            # an unknown quantity has an empty array
            known = (signal.values.get(name) for name in ("position", "velocity", "effort"))
            rows = (np.zeros(0) if values is None else np.ascontiguousarray(values[i], float) for values in known)
            return [list(signal.names), *rows]
        xyz = vector("Point" if signal.kind == "point" else "Vector3", signal.values["xyz"][i])
        is_wrench = signal.kind == "wrench"
        return [types["geometry_msgs/msg/Wrench"](xyz, vector("Vector3", np.zeros(3))) if is_wrench else xyz]

    known = np.any([np.isfinite(values).any(axis=1) for values in signal.values.values()], axis=0)
    for i in np.flatnonzero(known):
        stamp = round(1e9 * (float(signal.t[i]) + shift))
        time = types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
        header = types["std_msgs/msg/Header"](time, signal.frame)
        yield stamp, types[_MESSAGE_TYPES[signal.kind]](header, *content(int(i)))


def export_recording_csv_files(recording: Recording, folder: str | os.PathLike[str]) -> tuple[Path, ...]:
    """Write each group of a recording as a table `GROUP.csv` with all digits, which `read_any` can read.

    The tables omit standard deviations, the kind of effort, sensor, frame, pose and clock. The cells of an unseen point
    are empty. Returns the written files, joints first. Raises `OutputError` if a file exists or cannot be written.
    """
    folder, groups = make_folder(folder), recording.joint_and_point_groups
    written = [folder / f"{'joints' if isinstance(group, JointGroup) else group.name}.csv" for group in groups]
    for target in written:
        if target.exists():
            what, allowed = f"{target.name} exists and is not overwritten", f"a folder without {target.name}"
            raise OutputError(what, where=str(folder), allowed=allowed, hint="choose another --out, or remove the file")
    for group, target in zip(groups, written, strict=True):
        if isinstance(group, JointGroup):
            columns = [f"{channel}_{name}" for channel in group.values_by_channel for name in group.names]
            table = np.column_stack([group.t, *group.values_by_channel.values()])
        else:
            columns = [f"{name}_{axis}" for name in group.names for axis in "xyz"]
            table = np.column_stack([group.t, group.position.reshape(len(group.t), -1)])
        with atomic_write(target) as temporary, temporary.open("x", encoding="utf-8", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(["t", *columns])
            writer.writerows([["" if math.isnan(value) else repr(value) for value in row] for row in table.tolist()])
    return tuple(written)


def joint_trajectory_message(
    names: Sequence[str], t: Array, position: Array, velocity: Array, acceleration: Array, effort: Array
) -> dict[str, Any]:
    """Return a ROS trajectory_msgs/JointTrajectory message for nj joints as a dictionary.

    Times t (N,) [s] count from the start of the motion; the other arrays are (N, nj) in SI units. See
    https://docs.ros.org/en/api/trajectory_msgs/html/msg/JointTrajectory.html
    """
    points = []
    for i, time in enumerate(t):
        second = math.floor(time)
        since = {"sec": second, "nanosec": min(round(1e9 * (time - second)), 999_999_999)}
        rows = {"positions": position, "velocities": velocity, "accelerations": acceleration, "effort": effort}
        points.append({**{key: values[i].tolist() for key, values in rows.items()}, "time_from_start": since})
    return {"header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}, "joint_names": list(names), "points": points}
