"""Inertial measurement units on links. They read angular velocity and specific force along their frame's axes."""

from __future__ import annotations

import casadi as ca

from yid_ocp.model.system import NodeState
from yid_ocp.sensors.base import CHANNEL_KINDS, ChannelSpecification
from yid_ocp.sensors.mounted import MountedSensor, register_mounted_sensor

_XYZ = ("x", "y", "z")
_ANGULAR_VELOCITY = CHANNEL_KINDS.register("imu.angular_velocity")(
    ChannelSpecification("imu", "angular_velocity", "rad/s", _XYZ)
)
_SPECIFIC_FORCE = CHANNEL_KINDS.register("imu.specific_force")(
    ChannelSpecification("imu", "specific_force", "m/s^2", _XYZ)
)


@register_mounted_sensor
class _Gyroscope(MountedSensor):
    """Angular velocity of a frame against the world."""

    channel = _ANGULAR_VELOCITY

    def _frame_reading(self, state: NodeState, frame: str) -> ca.SX:
        kinematics = state.kinematics
        return kinematics.frame_pose(frame).rotation.T @ (kinematics.angular_jacobian(frame) @ state.v)


@register_mounted_sensor
class _Accelerometer(MountedSensor):
    """Acceleration of a frame's origin minus gravity: 9.81 m/s^2 upwards at rest."""

    channel = _SPECIFIC_FORCE

    def _frame_reading(self, state: NodeState, frame: str) -> ca.SX:
        kinematics = state.kinematics
        jacobian = kinematics.position_jacobian(frame)
        acceleration = jacobian @ state.a + ca.jtimes(jacobian @ state.v, state.q, state.v)
        return kinematics.frame_pose(frame).rotation.T @ (acceleration - state.system.gravity)
