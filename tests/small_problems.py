"""Made-up pieces of small problems: recordings, measurements on nodes, sensors."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from yid_ocp.data.recording import JointGroup, PointGroup, Recording
from yid_ocp.effects import make_effect
from yid_ocp.integrator.step import compile_step, simulate
from yid_ocp.model import System
from yid_ocp.model.kinematics import forward_kinematics
from yid_ocp.model.servos_and_springs import StiffnessAndRest
from yid_ocp.model.urdf import read_urdf
from yid_ocp.problem.measurements import SensorMeasurements
from yid_ocp.sensors import sensor_function_with_jacobians
from yid_ocp.sensors.joints import PrescribedJointEffortSensor
from yid_ocp.sensors.points import PointSensor


def efforts(*joints: str) -> PrescribedJointEffortSensor:
    """A sensor of one output a joint."""
    return PrescribedJointEffortSensor(joints)


def points(*names: str, pose=None, group="points") -> PointSensor:
    """A sensor of three outputs a point, each its own frame."""
    return PointSensor(group, names, names, pose)


def measured(sensor, node, fraction, value, weight=None, std=None, span=(0, 100)) -> SensorMeasurements:
    """Samples on nodes; whitened by unit noise unless weights are given."""
    value = np.asarray(value, float)
    seen = np.isfinite(value)
    weight = np.where(seen, 1.0, 0.0) if weight is None else np.asarray(weight, float)
    std = np.where(seen, 1.0, np.nan) if std is None else np.asarray(std, float)
    bias = np.zeros(value.shape[1])
    return SensorMeasurements(sensor, np.asarray(node), np.asarray(fraction, float), value, weight, std, span, bias)


def correlated(episode):
    """The episode with noise that is correlated among the outputs of every sample, each time another way."""
    rng, made = np.random.default_rng(8), []
    for samples in episode.measurements:
        size = samples.value.shape[1]
        factor = rng.standard_normal((len(samples.value), size, size)) + 1.5 * np.eye(size)
        covariance = factor @ factor.transpose(0, 2, 1)
        std = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
        made.append(replace(samples, noise_correlation=covariance / (std[:, :, None] * std[:, None, :])))
    return replace(episode, measurements=tuple(made))


def joints(names, t, position, **more) -> JointGroup:
    return JointGroup(tuple(names), np.asarray(t, float), np.asarray(position, float), **more)


def seen(names, t, position, name="points", **more) -> PointGroup:
    return PointGroup(name, tuple(names), np.asarray(t, float), np.asarray(position, float), **more)


def recording(group=None, *groups, name="made") -> Recording:
    return Recording(group, groups, name=name)


H, STEPS = 0.01, 24
PENDULUM = ("shoulder", "elbow")
TRACKED = {"arm_tracking_feedback": "proportional", "arm_proportional_gains": (9.0,)}


def pendulum_step(folder, effects=(), **how):
    """A double pendulum with springs and dampers; effects as (kind, location, values)."""
    robot = read_urdf(folder / "double_pendulum.urdf")
    springs = {joint: StiffnessAndRest(stiffness, 0.1) for joint, stiffness in zip(PENDULUM, (6.0, 3.0), strict=True)}
    loose = {joint: spring for joint, spring in springs.items() if joint not in how.get("driven", ())}
    loose = {joint: spring for joint, spring in loose.items() if joint not in how.get("prescribed", ())}
    system = System.build(
        robot, springs=loose, damping=dict.fromkeys(PENDULUM, 0.2), point_frames=["tip", "lower"], **how
    )
    made = [make_effect(kind, place, system, values) for kind, place, values in effects]
    return compile_step(system.with_effects(made), H, use_compiler=False)


def elbow(q):
    """Where the elbow is: rods of 0.5 and 0.4 m hang at a height of 1.2 m and turn about x."""
    return np.array([0.0, 0.5 * np.sin(q[0]), 1.2 - 0.5 * np.cos(q[0])])


def tip(q):
    return elbow(q) + 0.4 * np.array([0.0, np.sin(q[0] + q[1]), -np.cos(q[0] + q[1])])


def taken(step, seed, *, efforts=True, camera=True, name=None, steps=STEPS):
    """A recording of something like a motion of the pendulum: smooth angles and efforts, points somewhere near."""
    rng = np.random.default_rng(seed)
    t = 1.0 + H * np.arange(steps + 1)
    names = (*step.system.driven, *step.system.prescribed)
    group = None
    if names:
        phase = rng.uniform(0, 6, (2, len(names)))
        angle = 0.2 + 0.1 * np.sin(9.0 * t[:, None] + phase[0])
        effort = 1.0 + 0.5 * np.sin(7.0 * t[:, None] + phase[1])
        kind = "command" if step.system.driven else "sample"
        group = joints(
            names, t, angle, effort=effort if efforts else None, effort_std=0.3, effort_kind=kind, position_std=1e-3
        )
    place = np.array([0.0, 0.1, 0.35]) + 0.05 * rng.standard_normal((steps + 1, 1, 3))
    groups = [seen(["tip"], t, place, "points_arm", std=np.full(place.shape, 0.02))]
    if camera:
        at = np.sort(rng.uniform(t[0], t[-1], 7))
        pose = np.eye(4)
        pose[:3, 3] = [0.0, 2.0, 0.5]
        shot = np.array([0.0, 0.1, 0.7]) + 0.05 * rng.standard_normal((7, 2, 3))
        shot[2, 1] = np.nan
        more = {"std": np.full(shot.shape, 0.05), "sensor_name": "camera", "camera_pose": pose}
        groups.append(seen(["lower", "tip"], at, shot, "points_camera", **more))
    return Recording(group, tuple(groups), name=name or f"run_{seed}")


def places(system, frames, q):
    """Positions of frames at a configuration, or along a motion, time first."""
    symbol = ca.SX.sym("q", system.n_coordinates)
    kinematics = forward_kinematics(system.mechanism, symbol)
    expression = ca.horzcat(*(kinematics.frame_position(frame) for frame in frames))
    function = ca.Function("at", [symbol, system.parameters.symbols], [expression])
    found = np.array([np.array(function(at, system.parameters.vector())).T for at in np.atleast_2d(q)])
    return found if np.ndim(q) == 2 else found[0]


def read(system: System, sensor, q=None, effort=None) -> np.ndarray:
    """Outputs of a sensor at the parameters' nominal values."""
    n = system.n_coordinates
    function = sensor_function_with_jacobians(system, sensor, ())
    at = {name: np.zeros(n) if values is None else values for name, values in (("q", q), ("load", effort))}
    return np.array(ca.densify(function(**at, theta=system.parameters.vector())["y"])).ravel()


def swinging_pendulum(folder, *effects):
    """The step of a damped double pendulum, and a function that records a free swing of it, its lower points seen.

    The function (seed, steps, bend, noise) starts with angles of `bend` times a standard normal number and adds `noise`
    metres to what is seen; the standard deviation said is 1 mm. The swing has the effects (kind, location, values).
    """
    system = System.build(read_urdf(str(folder / "double_pendulum.urdf")), damping={"shoulder": 0.1, "elbow": 0.1})
    step = compile_step(system, H, use_compiler=False)
    real = system.with_effects([make_effect(kind, place, system, values) for kind, place, values in effects])
    moving = compile_step(real, H, use_compiler=False) if effects else step
    frames = list(system.mechanism.frames)[-2:]

    def record(seed, steps, bend, noise=0.0):
        rng = np.random.default_rng(seed)
        start = np.zeros(step.sizes["nx"])
        start[:2], start[2:4] = bend * rng.standard_normal(2), 0.02 * rng.standard_normal(2)
        states = simulate(moving, real.parameters.vector(), start, steps).state
        clean = places(system, frames, states[:, :2])
        position = clean + noise * rng.standard_normal(clean.shape)
        group = seen(frames, H * np.arange(steps + 1), position, std=np.full(clean.shape, 1e-3))
        return recording(None, group, name=f"swing_{seed}")

    return step, record


def keeps_inputs(made) -> bool:
    return all(made.predictor.are_input_corrections_neutral_and_fixed(e, made.theta) for e in made.episodes)


def torque_function(step, known):
    """Torques at (u, q, v) and known values."""
    system = step.system
    u, q, v = (ca.SX.sym(name, 2) for name in "uqv")
    function = ca.Function("torque", [u, q, v, system.parameters.symbols], [system.input_force(u, q, v)])
    theta = system.parameters.vector({name: x for name, x in known.items() if name in system.parameters})
    return lambda *at: np.array(function(*at, theta)).ravel()


def assert_slopes_are_those_of_differences(made, width, rtol, atol):
    """Of rows of data, by moves of each unknown by `width(name, value)`."""
    x, rows = made.initial_unknowns, made.residual_rows.data
    at = made.evaluate(x)
    assert at.ok, at.message
    for i, name in enumerate(made.unknown_names):
        move = width(name, x[i]) * np.eye(len(x))[i]
        ends = [made.evaluate(x + sign * move, False).residual[rows] for sign in (1, -1)]
        exact = at.jacobian[rows, i]
        assert np.abs(exact - (ends[0] - ends[1]) / (2 * move[i])).max() < rtol * np.abs(exact).max() + atol, name


def assert_the_compiled_step_agrees(slow, problem_with):
    fast = compile_step(slow.system, H)
    if not fast.is_compiled:
        pytest.skip("no C compiler")
    one, other = (p.evaluate(p.initial_unknowns) for p in map(problem_with, (slow, fast)))
    np.testing.assert_allclose(one.residual, other.residual, atol=1e-7)
    np.testing.assert_allclose(one.jacobian, other.jacobian, rtol=1e-6, atol=1e-6)
