"""Joint values in messages of ROS other than `sensor_msgs/JointState`: Franka's, ros2_control's, any by its fields."""

from __future__ import annotations

from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np

from yid_ocp.data.recording import JOINT_CHANNEL_UNITS
from yid_ocp.errors import DataError, unknown_name_error_arguments

JOINT_MESSAGE_TYPES = (
    "franka_msgs/msg/FrankaState",
    "franka_msgs/msg/FrankaRobotState",
    "control_msgs/msg/DynamicJointState",
    "control_msgs/msg/JointTrajectoryControllerState",
)
"""Types of messages, beside JointState, whose joint values are understood."""


def joint_values_of_message(content: Any, kind: str) -> SimpleNamespace:
    """Joint names and values by channel of a message of one of `JOINT_MESSAGE_TYPES`, absent channels left out."""
    if kind == JOINT_MESSAGE_TYPES[0]:
        return _franka_state(content)
    if kind == JOINT_MESSAGE_TYPES[1]:
        return _franka_robot_state(content)
    if kind == JOINT_MESSAGE_TYPES[2]:
        return _dynamic_joint_state(content)
    measured = getattr(content, "feedback", None) or content.actual
    wanted = getattr(content, "reference", None) or content.desired
    own = {"position": measured.positions, "velocity": measured.velocities, "effort": measured.effort}
    return _values(content.joint_names, own | {"position_command": wanted.positions})


def joint_values_of_fields(content: Any, paths: Mapping[str, str], where: str) -> SimpleNamespace:
    """Joint values of any message, from the path of an array by channel, such as `position` to `state.q`.

    Joints are called 1, 2 and so on. `DataError` where a channel or a path is not known, or holds no numbers.
    """
    found: dict[str, Any] = {}
    for channel, path in paths.items():
        if channel not in JOINT_CHANNEL_UNITS:
            what = f"'{channel}' is no channel of joints"
            raise DataError(what, where=where, **unknown_name_error_arguments(channel, JOINT_CHANNEL_UNITS))
        value = content
        for part in path.split("."):
            if not hasattr(value, part):
                known = [name for name in getattr(value, "__dataclass_fields__", {}) if not name.startswith("_")]
                what = f"the message has no field '{path}'"
                raise DataError(what, where=where, **unknown_name_error_arguments(part, known))
            value = getattr(value, part)
        try:
            found[channel] = np.asarray(value, float).ravel()
        except (TypeError, ValueError) as error:
            allowed = "an array of numbers, one for each joint"
            raise DataError(f"the field '{path}' holds no numbers", where=where, allowed=allowed) from error
    count = max((len(values) for values in found.values()), default=0)
    return _values([str(i + 1) for i in range(count)], found)


def _franka_state(content: Any) -> SimpleNamespace:
    """Of the driver for ROS 1, whose messages do not name joints."""
    torque = content.tau_J if hasattr(content, "tau_J") else content.tau_j
    own = {"position": content.q, "velocity": content.dq, "effort": torque, "position_command": content.q_d}
    own["external_effort"] = content.tau_ext_hat_filtered
    return _values([f"panda_joint{i + 1}" for i in range(len(content.q))], own)


def _franka_robot_state(content: Any) -> SimpleNamespace:
    """Of the driver for ROS 2."""
    measured, external = content.measured_joint_state, content.tau_ext_hat_filtered
    own = {"position": measured.position, "velocity": measured.velocity, "effort": measured.effort}
    own["external_effort"] = getattr(external, "effort", external)
    own["position_command"] = content.desired_joint_state.position
    return _values(measured.name, own)


def _dynamic_joint_state(content: Any) -> SimpleNamespace:
    """Of the broadcaster of ros2_control: named interfaces of every joint, of which some have no position."""
    by_joint = {
        str(name): dict(zip(map(str, entry.interface_names), map(float, entry.values), strict=True))
        for name, entry in zip(content.joint_names, content.interface_values, strict=True)
    }
    kept = {name: values for name, values in by_joint.items() if "position" in values}
    channels = [c for c in ("position", "velocity", "effort") if all(c in values for values in kept.values())]
    return _values(kept, {c: [values[c] for values in kept.values()] for c in channels})


def _values(names: Any, values: Mapping[str, Any]) -> SimpleNamespace:
    own = {channel: np.asarray(array, float).ravel() for channel, array in values.items() if len(array)}
    return SimpleNamespace(frame="", name=[str(name) for name in names], **own)
