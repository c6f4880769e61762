"""Export of signals as ROS 2 messages in one MCAP file, for Foxglove, PlotJuggler and other bag readers."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from yid_ocp.data import JointGroup, Recording
from yid_ocp.errors import OutputError
from yid_ocp.files import atomic_write, os_error_reason

Array = NDArray[np.float64]
_SignalKind = Literal["joints", "point", "vector", "wrench"]
_MESSAGE_TYPES: Mapping[_SignalKind, str] = {
    "joints": "sensor_msgs/msg/JointState",
    "point": "geometry_msgs/msg/PointStamped",
    "vector": "geometry_msgs/msg/Vector3Stamped",
    "wrench": "geometry_msgs/msg/WrenchStamped",
}
_WORLD_FRAME = "world"


@dataclass(frozen=True)
class TopicSignal:
    """Time series of one ROS topic.

    Attributes
    ----------
    topic : str
    kind : "joints", "point", "vector" or "wrench"
    t : ndarray, shape (M,)
        [s]
    values : mapping of str to ndarray, shape (M, n)
        Of joints `position`, `velocity` and `effort`, as many as there are; of all else `xyz`, shape (M, 3), the forces
        of a wrench. Messages without a number are left out.
    names : sequence of str
        Of the joints.
    frame : str
        Coordinate frame of points and vectors.
    """

    topic: str
    kind: _SignalKind
    t: Array
    values: Mapping[str, Array]
    names: Sequence[str] = field(default=())
    frame: str = _WORLD_FRAME


def export_mcap(signals: Sequence[TopicSignal], path: str | os.PathLike[str]) -> float:
    """Write signals into one MCAP file, with the definitions of their messages, in the order of time.

    Parameters
    ----------
    signals : sequence of Signal
    path : path-like
        File to write.

    Returns
    -------
    float
        Shift added to all times because stamps cannot be negative: whole seconds, usually zero [s].

    Raises
    ------
    OutputError
        `rosbags` is not installed, there is nothing to write, or the file cannot be written.
    """
    path = Path(path)
    try:
        from rosbags.rosbag2 import StoragePlugin, Writer
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        hint = "pip install 'yid-ocp[bags]'"
        raise OutputError("writing MCAP needs the package rosbags", where=str(path), hint=hint) from None
    if not any(len(signal.t) for signal in signals):
        raise OutputError("there is nothing to write", where=str(path))
    store = get_typestore(Stores.ROS2_HUMBLE)
    first = min(float(np.min(signal.t)) for signal in signals if len(signal.t))
    shift = float(max(0.0, -np.floor(first)))
    made = [
        (stamp, k, message) for k, signal in enumerate(signals) for stamp, message in _messages(signal, shift, store)
    ]
    made.sort(key=lambda entry: entry[:2])
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # a bag is a folder; its one file is all that is wanted
        with tempfile.TemporaryDirectory(dir=path.parent) as folder:
            bag = Path(folder) / "bag"
            with Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
                told = [writer.add_connection(s.topic, _MESSAGE_TYPES[s.kind], typestore=store) for s in signals]
                for stamp, k, message in made:
                    writer.write(told[k], stamp, store.serialize_cdr(message, _MESSAGE_TYPES[signals[k].kind]))
            [file] = bag.glob("*.mcap")
            with atomic_write(path) as temporary:
                os.replace(file, temporary)
    except OSError as error:
        raise OutputError(f"the file cannot be written: {os_error_reason(error)}", where=str(path)) from error
    return shift


def signals_from_recording(recording: Recording) -> list[TopicSignal]:
    """The signals of a recording: `/joint_states`, `/joint_commands`, `/external_efforts` and `/points/GROUP/POINT`."""
    found: list[TopicSignal] = []
    for group in recording.groups:
        if isinstance(group, JointGroup):
            own = group.channels
            parts: dict[str, dict[str, Array]] = {
                "/joint_states": {name: own[name] for name in ("position", "velocity", "effort") if name in own},
                "/joint_commands": {
                    name: own[f"{name}_command"] for name in ("position", "velocity") if f"{name}_command" in own
                },
                "/external_efforts": {"effort": own["external_effort"]} if "external_effort" in own else {},
            }
            found += [TopicSignal(topic, "joints", group.t, v, group.names) for topic, v in parts.items() if v]
            continue
        for i, name in enumerate(group.names):
            place = {"xyz": group.position[:, i]}
            found.append(
                TopicSignal(f"/points/{group.name}/{name}", "point", group.t, place, frame=group.frame or _WORLD_FRAME)
            )
    return found


def _messages(signal: TopicSignal, shift: float, store: Any) -> Iterator[tuple[int, Any]]:
    """Stamp [ns] and message of every time at which there is a number."""
    types = store.types
    make: Mapping[_SignalKind, Callable[[Any, int], Any]] = {
        "joints": lambda header, i: types[_MESSAGE_TYPES["joints"]](
            header, list(signal.names), *(_row(signal, name, i) for name in ("position", "velocity", "effort"))
        ),
        "point": lambda header, i: types[_MESSAGE_TYPES["point"]](
            header, _vector(types, "Point", signal.values["xyz"][i])
        ),
        "vector": lambda header, i: types[_MESSAGE_TYPES["vector"]](
            header, _vector(types, "Vector3", signal.values["xyz"][i])
        ),
        "wrench": lambda header, i: types[_MESSAGE_TYPES["wrench"]](
            header,
            types["geometry_msgs/msg/Wrench"](
                _vector(types, "Vector3", signal.values["xyz"][i]), _vector(types, "Vector3", np.zeros(3))
            ),
        ),
    }
    known = np.any([np.isfinite(values).any(axis=1) for values in signal.values.values()], axis=0)
    for i in np.flatnonzero(known):
        stamp = round(1e9 * (float(signal.t[i]) + shift))
        time = types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
        yield stamp, make[signal.kind](types["std_msgs/msg/Header"](time, signal.frame), int(i))


def _row(signal: TopicSignal, name: str, i: int) -> Array:
    """Values of all joints at one time; none at all of what is not known."""
    return np.ascontiguousarray(signal.values[name][i], float) if name in signal.values else np.zeros(0)


def _vector(types: Any, kind: str, xyz: Array) -> Any:
    return types[f"geometry_msgs/msg/{kind}"](*map(float, xyz))
