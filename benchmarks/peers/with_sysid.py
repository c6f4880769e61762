"""MuJoCo's identification toolbox, `mujoco.sysid`.

Its rollouts stamp a sensor's reading with the time after the step; `rollout` returns readings from before it.
"""

from __future__ import annotations

import contextlib
import functools
import io
import logging
from collections.abc import Sequence
from typing import Any

import absl.logging
import mujoco
import numpy as np
from answer import Answer
from cases import Trial
from mujoco import sysid
from mujoco_models import SETTERS, at_samples, follow, settled_state, torque_residual


def parameters(trial: Trial, setters: Any) -> sysid.ParameterDict:
    found = sysid.ParameterDict()
    for name, own in trial.unknowns.items():
        found.add(sysid.Parameter(name, own.start, own.lower, own.upper, modifier=setters.get(name)))
    return found


def fit(start: sysid.ParameterDict, residual: Any) -> tuple[Answer, sysid.ParameterDict]:
    messages: list[str] = []
    handler = logging.Handler(logging.WARNING)
    handler.emit = lambda record: messages.append(record.getMessage())  # type: ignore[method-assign]
    absl.logging.get_absl_logger().addHandler(handler)
    with contextlib.redirect_stdout(io.StringIO()):
        found, result = sysid.optimize(
            start, residual, verbose=False, check_conditioning=True, x_scale="jac", eps=1e-5, max_iters=30
        )
    absl.logging.get_absl_logger().removeHandler(handler)
    left, _, _ = residual(result.x, found)
    _, half = sysid.calculate_intervals(left, result.jac)
    ends = {name: (x - w, x + w) for name, x, w in zip(found.keys(), result.x, half, strict=True)}
    estimates = dict(zip(found.keys(), map(float, result.x), strict=True))
    return Answer(estimates, ends, messages=tuple(messages)), found


def series(times: Any, data: Any, names: Sequence[str]) -> sysid.TimeSeries:
    mapping = {name: (sysid.SignalType.CustomObs, np.array([k])) for k, name in enumerate(names)}
    return sysid.TimeSeries(times, data, mapping)


def arm(trial: Trial) -> Answer:
    """Torques that an arm needs to follow its encoders, compared with recorded ones."""
    spec, joints = mujoco.MjSpec.from_string(trial.mjcf), trial.estimate[0].joints
    assert joints is not None
    names, posture = joints.names, joints.position[:5].mean(axis=0)
    following = follow(spec, names, posture)
    start = settled_state(model := spec.compile(), following.columns, posture, trial.true_shape)
    times, controls = following.controls(joints, names, model.opt.timestep)
    measured = series(joints.t - joints.t[0], joints.effort, names)
    sequences = sysid.ModelSequences(
        "arm", spec, "estimate", start, sysid.TimeSeries(times, controls), measured, allow_missing_sensors=True
    )

    def compared(params: Any, predicted: Any, recorded: Any, model: Any, everything: bool, state: Any, **_: Any) -> Any:
        torques = at_samples(times, following.torques(controls, state, model.nq), joints)
        return torque_residual(torques, joints, names), recorded, recorded

    residual = sysid.build_residual_fn(models_sequences=[sequences], modify_residual=compared, resample_true=False)
    setters = {n: lambda s, p, n=n: SETTERS[trial.case](s, n, float(p.value[0])) for n in trial.unknowns}
    return fit(parameters(trial, setters), residual)[0]


def springs(trial: Trial) -> Answer:
    """Places of the end of two springs on a rail that is tilted as measured."""
    spec, recording = mujoco.MjSpec.from_string(trial.mjcf), trial.estimate[0]
    joints, points = recording.joints, recording.points[0]
    assert joints is not None
    following = follow(spec, joints.names, joints.position[0])
    end = {"objtype": mujoco.mjtObj.mjOBJ_XBODY, "objname": "spring_2_body"}
    spec.add_sensor(name="end", type=mujoco.mjtSensor.mjSENS_FRAMEPOS, **end)
    start = settled_state(model := spec.compile(), following.columns, joints.position[0], trial.true_shape)
    times, controls = following.controls(joints, joints.names, model.opt.timestep)
    places = points.position[:, points.names.index("end")]
    measured = sysid.TimeSeries(points.t, places, sysid.TimeSeries.compute_all_sensor_mapping(model))
    sequences = sysid.ModelSequences("rail", spec, "estimate", start, sysid.TimeSeries(times, controls), measured)

    def compared(params: Any, predicted: Any, recorded: Any, *_: Any, **__: Any) -> Any:
        moved = sysid.TimeSeries(predicted.times - model.opt.timestep, predicted.data, predicted.signal_mapping)
        return recorded.data - moved.resample(recorded.times).data, recorded, recorded

    residual = sysid.build_residual_fn(models_sequences=[sequences], modify_residual=compared, resample_true=False)
    setters = {n: lambda s, p, n=n: SETTERS[trial.case](s, n, float(p.value[0])) for n in trial.unknowns}
    return fit(parameters(trial, setters), residual)[0]


def set_servo(spec: mujoco.MjSpec, parameter: sysid.Parameter) -> None:
    joint, motor, value = spec.joint("joint"), spec.actuator("motor"), float(parameter.value[0])
    gain = spec.numeric("gain").data[0]
    if parameter.name == "gain":
        motor.gainprm[0], motor.biasprm[1] = gain * value, -gain * value
    elif parameter.name == "torque_limit":
        motor.forcerange = (-value, value)
    elif parameter.name == "counter_voltage":
        joint.damping[0] = value * (gain > 0)
    elif parameter.name == "viscous":
        joint.damping[0] += value  # set after the counter-voltage
    elif parameter.name != "delay":
        setattr(joint, {"armature": "armature", "coulomb": "frictionloss", "offset": "ref"}[parameter.name], value)


def servo(trial: Trial) -> Answer:
    """Angles of a servo under its commands; a motor that is off has no torque and no counter-voltage."""

    def sequences(recording: Any) -> sysid.ModelSequences:
        spec, joints = mujoco.MjSpec.from_string(trial.mjcf), recording.joints
        on = joints.effort is None or bool(np.any(joints.effort))
        spec.add_numeric(name="gain", data=[float(np.ravel(joints.proportional_gain)[0]) if on else 0.0], size=1)
        model, t = spec.compile(), joints.t - joints.t[0]
        command = joints.position if joints.position_command is None else joints.position_command
        times = np.arange(0, t[-1], model.opt.timestep)
        control = sysid.TimeSeries(times, command[np.searchsorted(t, times, "right") - 1])
        angle = sysid.TimeSeries(t, joints.position, sysid.TimeSeries.compute_all_sensor_mapping(model))
        start = sysid.create_initial_state(model, joints.position[0])
        return sysid.ModelSequences(recording.name, spec, recording.name, start, control, angle)

    def compared(params: Any, predicted: Any, recorded: Any, model: Any, *_: Any, **__: Any) -> Any:
        late = float(params["delay"].value[0]) - model.opt.timestep
        moved = sysid.apply_resample_and_delay(predicted, recorded.times, late)
        return recorded.data - moved.data, moved, recorded

    build = functools.partial(sysid.build_residual_fn, modify_residual=compared)
    start = parameters(trial, dict.fromkeys(trial.unknowns, set_servo))
    answer, found = fit(start, build(models_sequences=[sequences(each) for each in trial.estimate]))
    left, _, _ = build(models_sequences=[sequences(each) for each in trial.held_out])(found.as_vector(), found)
    errors = tuple(float(np.sqrt(np.mean(each**2))) for each in left)
    return Answer(answer.estimates, answer.intervals, (), answer.messages, errors)


BY_CASE = {"foam": arm, "foam_noise": arm, "payload": arm, "scaled_torque": arm, "springs": springs, "servo": servo}
