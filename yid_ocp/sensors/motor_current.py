"""Motor currents of prescribed joints, predicted as the joint effort divided by a torque constant."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from yid_ocp.arrays import Array
from yid_ocp.errors import DataError, nearest_name_question
from yid_ocp.model.system import NodeStateSymbols
from yid_ocp.sensors import base
from yid_ocp.sensors.joints import JointSensor, filtered_effort_sensor_data

_TORQUE_CONSTANT = "torque_constant"
_CURRENT = base.CHANNEL_KINDS.register("motors.current")(
    base.RecordedChannelSpec("motors", "current", "A", constants={_TORQUE_CONSTANT: "N m/A"})
)


@dataclass(frozen=True)
class _MotorCurrentSensor(JointSensor):
    """Motor currents of named prescribed joints, current = joint effort / torque constant."""

    channel = _CURRENT
    naive_prediction = "zero"
    has_paper_weight = False
    torque_constants: tuple[float, ...]  # joint torque per current, gears included, of each joint [N m/A]

    @property
    def effort_joints(self) -> tuple[str, ...]:
        return self.joint_names

    @property
    def effort_per_unit_reading(self) -> Array:
        return np.array(self.torque_constants)

    def ideal_reading(self, state: NodeStateSymbols) -> ca.SX:
        return self.select_sensor_joint_entries(state.load, state) / ca.DM(self.torque_constants)


@base.SENSOR_READERS.register("motors.current")
def _read_motor_currents(around: base.SensorDataInputs) -> list[base.SensorData]:
    groups = (group for group in around.recording.channel_groups if _CURRENT.matches_group_name(group.name))
    return [found for group in groups if (found := _currents(around, group)) is not None]


def _currents(around: base.SensorDataInputs, group: base.RecordedExtraChannelsInterface) -> base.SensorData | None:
    key, where = f"{group.name}.{_CURRENT.quantity}", f"recording '{around.recording.name}': {group.name}"
    choice, names = around.sensor_usage(key), tuple(n for n in around.system.prescribed if n in group.names)
    if choice.use is False or not names or around.recording.joints is None:
        return None
    for name in group.names:
        if name not in around.system.mechanism.joint_names:
            what, motors = f"the model has no joint '{name}', whose current is recorded", around.system.prescribed
            near = nearest_name_question(name, {*motors} - {*group.names})
            hint = f"{near} Correct it in the recording, or set sensors.{key}.use: false".strip()
            raise DataError(what, where=where, allowed=", ".join(motors), hint=hint)
    stated = [group.noise_and_bias_stds_by_attribute.get(attribute) for attribute in _CURRENT.std_attribute_names]
    constants, std = choice.constants.get(_TORQUE_CONSTANT), stated[0] if choice.std is None else choice.std
    bias = next((given for given in (choice.bias_std, stated[1]) if given is not None), 0.0)
    if constants is None:
        what, allowed = "the motors' torque constants are not stated", "torque at the joint per current [N m/A]"
        hint = f"set sensors.{key}.constants: {{{_TORQUE_CONSTANT}: NUMBER}}, or {{JOINT: NUMBER, ...}} as its value"
        raise DataError(what, where=where, allowed=allowed, hint=hint)
    if std is None:
        raise base.missing_noise_level_error("the motor currents", where, key, "A")
    by_joint = [
        base.expand_to_joint_values(given, group.names, names, f"sensors.{key}.{setting}")
        for given, setting in ((constants, "constants"), (std, "std"), (bias, "bias_std"))
    ]
    if not np.all(by_joint[0] != 0):
        what = f"the torque constant of joint '{names[int(np.argmin(np.abs(by_joint[0])))]}' is zero"
        where, hint = f"sensors.{key}.constants", f"set {_TORQUE_CONSTANT} to the motor's torque per current"
        raise DataError(what, where=where, allowed="numbers other than zero [N m/A]", hint=hint)
    sensor = _MotorCurrentSensor(names, key, tuple(by_joint[0].tolist()))
    values = group.values_by_quantity[_CURRENT.quantity][:, [group.names.index(name) for name in names]]
    return filtered_effort_sensor_data(around, sensor, group.t, values, by_joint[1], by_joint[2], is_sample=True)
