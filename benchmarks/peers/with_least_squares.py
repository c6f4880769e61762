"""`scipy.optimize.least_squares` over rollouts of MuJoCo."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from answer import Answer
from cases import Trial
from mujoco import rollout
from mujoco_models import SETTERS, Following, at_samples, follow, intervals, named, settled_state, torque_residual
from scipy.optimize import least_squares


def fit(trial: Trial, residual: Any, scale: Any) -> Answer:
    unknowns = trial.unknowns
    bounds = [entry.lower for entry in unknowns.values()], [entry.upper for entry in unknowns.values()]
    found = least_squares(
        residual, [entry.start for entry in unknowns.values()], bounds=bounds, x_scale=scale, diff_step=1e-4
    )
    half = intervals(found.fun, found.jac)
    ends = {name: (x - w, x + w) for name, x, w in zip(unknowns, found.x, half, strict=True)}
    return Answer(named(found.x, unknowns), ends, messages=() if found.success else (found.message,))


def arm(trial: Trial) -> Answer:
    """Torques that an arm needs to follow its encoders, compared with recorded ones."""
    spec, joints = mujoco.MjSpec.from_string(trial.mjcf), trial.estimate[0].joints
    assert joints is not None
    names, posture = joints.names, joints.position[:5].mean(axis=0)
    following: Following = follow(spec, names, posture)
    start = settled_state(model := spec.compile(), following.columns, posture, trial.true_shape)
    times, controls = following.controls(joints, names, model.opt.timestep)
    data = mujoco.MjData(model)

    def residual(x: Any) -> Any:
        for name, value in zip(trial.unknowns, x, strict=True):
            SETTERS[trial.case](spec, name, value)
        own = spec.compile()
        states, _ = rollout.rollout(own, data, start, controls)
        torques = following.torques(controls, states[0], own.nq)
        return torque_residual(at_samples(times, torques, joints), joints, names).ravel()

    return fit(trial, residual, "jac")


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
    data = mujoco.MjData(model)

    def residual(x: Any) -> Any:
        for name, value in zip(trial.unknowns, x, strict=True):
            SETTERS[trial.case](spec, name, value)
        _, places = rollout.rollout(spec.compile(), data, start, controls)
        # a sensor is read before the step
        predicted = np.array([np.interp(points.t, times, column) for column in places[0].T]).T
        return (points.position[:, points.names.index("end")] - predicted).ravel() / 1e-3

    return fit(trial, residual, "jac")


def servo(trial: Trial) -> Answer:
    """Angles of a servo under its commands; a motor that is off has no torque and no counter-voltage."""
    spec = mujoco.MjSpec.from_string(trial.mjcf)

    def predicted(x: Any, recording: Any) -> Any:
        gain, counter_voltage, limit, armature, viscous, coulomb, offset, delay = x
        joints, joint, motor = recording.joints, spec.joint("joint"), spec.actuator("motor")
        t = joints.t - joints.t[0]
        on = joints.effort is None or bool(np.any(joints.effort))
        gain *= float(np.ravel(joints.proportional_gain)[0]) if on else 0.0
        motor.gainprm[0], motor.biasprm[1], motor.forcerange = gain, -gain, (-limit, limit)
        joint.damping[0] = viscous + counter_voltage * on
        joint.frictionloss, joint.armature, joint.ref = coulomb, armature, offset
        model = spec.compile()
        data, times = mujoco.MjData(model), np.arange(0, t[-1], model.opt.timestep)
        data.qpos[0] = joints.position[0, 0]
        state = np.empty(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
        mujoco.mj_getState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        command = joints.position if joints.position_command is None else joints.position_command
        _, angle = rollout.rollout(model, data, state, command[np.searchsorted(t, times - delay, "right").clip(1) - 1])
        return np.interp(t, times, angle[0, :, 0])

    def residual(x: Any) -> Any:
        return np.concatenate([predicted(x, each) - each.joints.position[:, 0] for each in trial.estimate])

    answer = fit(trial, residual, "jac")
    x = list(answer.estimates.values())
    left = (predicted(x, each) - each.joints.position[:, 0] for each in trial.held_out)
    return Answer(answer.estimates, answer.intervals, held_out=tuple(float(np.sqrt(np.mean(r**2))) for r in left))


BY_CASE = {"foam": arm, "foam_noise": arm, "payload": arm, "scaled_torque": arm, "springs": springs, "servo": servo}
