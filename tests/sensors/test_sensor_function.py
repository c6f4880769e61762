"""What sensors read at a node, effects included, and its derivatives."""

import math
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
import pytest
from held_rod import held_rod
from small_problems import H, measured, read

from yid_ocp.data import JointGroup, PointGroup, Recording
from yid_ocp.effects import make_effect
from yid_ocp.errors import ModelError, SolverError
from yid_ocp.integrator.step import compile_step
from yid_ocp.model import FlexibleSegment, Mechanism, System, flexible_object
from yid_ocp.model.mechanism import Frame, Inertia, Joint, Placement, homogeneous_transform, rotation_from_rpy
from yid_ocp.model.parameters import Parameter, Parameters
from yid_ocp.model.system import Effect, NodeStateSymbols
from yid_ocp.problem import EstimationProblem, ProblemOptions
from yid_ocp.sensors import (
    PointSensor,
    PrescribedJointEffortSensor,
    RecordedChannelSpec,
    Sensor,
    sensor_function_with_jacobians,
)
from yid_ocp.solvers.symbolic_transcription import transcribe

LABEL = "drift@left"


@pytest.fixture(scope="session")
def system() -> System:
    """An arm of two joints beside a flexible Y."""
    along = Placement.from_matrix(homogeneous_transform(np.eye(3), [0.0, 0.0, 0.5]))
    body = Inertia.from_values(1.0, [0.0, 0.0, 0.25], np.diag([0.02, 0.02, 0.001]))
    upper = Joint("left_a", "revolute", -1, Placement.identity(), (0.0, 1.0, 0.0), (body,))
    lower = Joint("left_b", "revolute", 0, along, (1.0, 0.0, 0.0), (body,))
    robot = Mechanism("arm", (upper, lower), {"left_gripper": Frame(1, along)})
    turn = rotation_from_rpy(-0.8, 0.0, 0.0)
    segments = (
        FlexibleSegment("T1", 0.4, 0.08, 0.03, 2),
        FlexibleSegment("T2", 0.3, 0.04, 0.01, 1, parent="T1", rest_rotation=turn),
    )
    return System.build(robot, objects=[(flexible_object(segments), None, None)], prescribed=robot.joint_names)


class Drift(Effect):
    """Adds gain (memory + effort of the first joint) to every reading: what depends on all that a sensor may see."""

    def reading_from_true_value(self, channel: str, output: ca.SX, state: NodeStateSymbols) -> ca.SX:
        memory = self.internal_coordinate_symbols[f"{LABEL}.memory"]
        return output + self.parameters[f"{LABEL}.gain"].symbol * (memory**2 + ca.sin(state.load[0]))


POSE = homogeneous_transform(rotation_from_rpy(0.3, -0.2, 1.0), [2.0, 0.5, 0.4])
CAMERA = PointSensor("points_camera", ("joint", "tip"), ("w_T1", "w_T2"), tuple(map(tuple, POSE)))
EFFORT = PrescribedJointEffortSensor(("left_a", "left_b"))
NAMES = ("T1.length", "drift@left.gain", "camera_scale@camera.scale", "effort_gain@left_b.inverse")


@pytest.fixture(scope="module")
def whole(system: System) -> System:
    scale = make_effect("camera_scale", "camera", system, {"scale": 1.1})
    gain = make_effect("effort_gain", "left_b", system, {"scale": 0.8})
    gains = Parameters([Parameter(f"{LABEL}.gain", 0.2, "1")])
    drift = Drift("drift", "left", gains, {f"{LABEL}.memory": ca.SX.sym(f"{LABEL}.memory")})
    return system.with_effects([scale, gain, drift])


@pytest.mark.parametrize("sensor", [CAMERA, EFFORT], ids=["points", "effort"])
def test_outputs_have_a_row_for_every_reading(whole: System, sensor: Sensor) -> None:
    function = sensor_function_with_jacobians(whole, sensor, NAMES)
    rows = sensor.outputs_per_channel * len(sensor.channel_names)
    n = whole.n_coordinates
    assert [function.size_out(i) for i in range(8)] == [(rows, size) for size in (1, n, 0, 0, 1, n, 0, len(NAMES))]
    assert sensor_function_with_jacobians(whole, sensor, ()).size_out(7) == (rows, 0)


@pytest.mark.parametrize("sensor", [CAMERA, EFFORT], ids=["points", "effort"])
def test_derivatives_agree_with_differences(whole: System, sensor: Sensor) -> None:
    rng = np.random.default_rng(1)
    function = sensor_function_with_jacobians(whole, sensor, NAMES)
    n = whole.n_coordinates
    at = {"q": rng.uniform(-0.6, 0.6, n), "z": np.array([0.4]), "load": rng.uniform(-1, 1, n)}
    at["theta"] = whole.parameters.vector()
    exact = {name: np.array(ca.densify(value)) for name, value in function(**at).items()}
    chosen = [whole.parameters.index(name) for name in NAMES]
    columns = {"q": range(n), "z": range(1), "load": range(n), "theta": chosen}
    for which, indices in columns.items():
        ways = 1e-6 * np.eye(len(at[which]))[list(indices)]
        ends = [[function(**(at | {which: at[which] + s * w}))["y"] for w in ways] for s in (1, -1)]
        differences = np.subtract(*(np.array([np.array(y).ravel() for y in end]) for end in ends)) / 2e-6
        np.testing.assert_allclose(exact[f"by_{which}"], np.transpose(differences), rtol=1e-7, atol=1e-8)
    assert np.abs(exact["by_z"]).max() > 0.01, "the memory of an effect is seen"


def test_effects_act_one_after_the_other_on_every_channel(whole: System) -> None:
    """effort 3 N m at left_b: gain 0.8, then the drift 0.2 (0.5^2 + sin 2), which left_a gets alone."""
    effort = np.zeros(whole.n_coordinates)
    a, b = (whole.mechanism.joint_index(name) for name in ("left_a", "left_b"))
    effort[a], effort[b] = 2.0, 3.0
    assert a == 0
    function = sensor_function_with_jacobians(whole, EFFORT, ())
    read = np.array(function(z=0.5, load=effort, theta=whole.parameters.vector())["y"]).ravel()
    drift = 0.2 * (0.25 + np.sin(2.0))
    assert read == pytest.approx([2.0 + drift, 0.8 * 3.0 + drift])


def test_a_point_worked_out_by_hand(system: System) -> None:
    q = np.zeros(system.n_coordinates)
    a, b = 0.3, -0.7
    q[[system.mechanism.joint_index(name) for name in ("left_a", "left_b")]] = a, b
    along = 0.5 + 0.5 * math.cos(b)
    expected = [along * math.sin(a), -0.5 * math.sin(b), along * math.cos(a)]
    assert read(system, PointSensor("points_arm", ("hand",), ("left_gripper",)), q) == pytest.approx(expected)


def test_every_channel_knows_its_own_frame(system: System) -> None:
    """The near surface lies at the radius of the tube that each point is on: 30 mm for T1, 10 mm for T2."""
    near = system.with_effects([make_effect("surface_offset", "camera", system, {"fraction": 1.0})])
    shift = (read(near, CAMERA) - read(system, CAMERA)).reshape(2, 3)
    assert np.linalg.norm(shift, axis=1) == pytest.approx([0.03, 0.01])
    rays = POSE[:3, 3] - read(system, CAMERA).reshape(2, 3)
    assert np.cross(shift, rays) == pytest.approx(np.zeros((2, 3)), abs=1e-12)
    assert (np.sum(shift * rays, axis=1) > 0).all()


def test_points_along_a_segment(system: System) -> None:
    """Halfway along two links lies the joint between them; a quarter beyond it, half of the second link."""
    q = np.random.default_rng(1).uniform(-0.5, 0.5, system.n_coordinates)
    found = read(system, PointSensor("points", ("a", "b", "c", "d"), ("T1:50%", "T1_0_tip", "T1:75%", "w_T1")), q)
    half, joint, further, tip = found.reshape(4, 3)
    assert half == pytest.approx(joint)
    assert further == pytest.approx((joint + tip) / 2)
    near = system.with_effects([make_effect("surface_offset", "camera", system, {"fraction": 1.0})])
    along = PointSensor("points_camera", ("a",), ("T1:75%",), tuple(map(tuple, POSE)))
    assert np.linalg.norm(read(near, along, q) - read(system, along, q)) == pytest.approx(0.03)


def test_an_effort_sensor_reads_its_joints_in_its_own_order(system: System) -> None:
    effort = np.arange(1.0, system.n_coordinates + 1)
    a, b = (system.mechanism.joint_index(name) for name in ("left_a", "left_b"))
    swapped = PrescribedJointEffortSensor(("left_b", "left_a"))
    assert read(system, swapped, effort=effort) == pytest.approx([effort[b], effort[a]])


@pytest.mark.parametrize("sensor", [PrescribedJointEffortSensor(("x9",)), PointSensor("points", ("p",), ("x9",))])
def test_a_joint_or_frame_that_is_not_there_is_refused(sensor: Sensor, system: System) -> None:
    with pytest.raises(ModelError, match="x9"):
        read(system, sensor)


@dataclass(frozen=True)
class Hand(Sensor):
    """How fast the elbow turns, how that changes and what holds the hand: what a node has beside its coordinates."""

    channel = RecordedChannelSpec("hand", "touch", "1")
    group_name: str = "hand.touch"
    frame_names = point_names = ()

    @property
    def channel_names(self) -> tuple[str, ...]:
        return tuple(f"hand.touch.{name}" for name in ("speed", "acceleration", "force"))

    def ideal_reading(self, state: NodeStateSymbols) -> ca.SX:
        return ca.vertcat(state.v[1] * ca.cos(state.q[0]), state.a[1] * state.q[0], state.lam[0])


def test_rates_and_constraint_forces_are_read_along_a_rollout(urdf_folder):
    names = ("T1.bend", "shoulder.damping", "clock_scale@clock.scale")
    held = held_rod(urdf_folder, driven=("shoulder",), damping=0.3)
    held = held.with_effects([make_effect("clock_scale", "clock", held)])
    step = compile_step(held, H, use_compiler=False)
    t = H * np.arange(41)
    joints = JointGroup(("shoulder", "elbow"), t, np.zeros((41, 2)), effort=np.sin(4 * t)[:, None] * [1.0, 0.0])
    options = ProblemOptions(arm_tracking_feedback="none", weighting="paper")
    tip = PointGroup("points", ("tip",), t, np.zeros((41, 1, 3)), 1.0)
    problem = EstimationProblem(step, [Recording(joints, (tip,), name="held")], names, options)
    samples = measured(Hand(), [3, 7, 20, 39], [0.0, 0.5, 0.0, 1.0], np.zeros((4, 3)), span=(0, 40))
    problem = problem.with_episodes([replace(problem.episodes[0], measurements=(samples,))], [])
    x = problem.initial_unknowns
    evaluation = problem.evaluate(x)
    [prediction] = evaluation.episode_predictions
    rollout, scale = prediction.rollout, problem.theta[held.parameters.index(names[2])]
    speed = np.gradient(rollout.state[:, 1], H) * np.cos(rollout.state[:, 0]) / scale
    change = np.pad(np.diff(rollout.state[:, 1], 2), 1, mode="edge") / (H * scale) ** 2 * rollout.state[:, 0]
    series = (speed, change, np.append(rollout.multipliers[:, 0], rollout.multipliers[-1, 0]) / H / scale)
    expected = np.stack([np.interp([3, 7.5, 20, 40], np.arange(41), values) for values in series], axis=1)
    np.testing.assert_allclose(prediction.predicted_outputs[0], expected, rtol=1e-9, atol=1e-12)
    rows, gradient = problem.residual_rows.data, problem.cost_and_gradient(x)[1]
    np.testing.assert_allclose(gradient, evaluation.jacobian.T @ evaluation.residual, rtol=1e-6)
    for i, size in enumerate(1e-5 * np.abs(x)):
        ends = [problem.evaluate(x + sign * size * np.eye(3)[i]).residual[rows] for sign in (1, -1)]
        numeric, exact = (ends[0] - ends[1]) / (2 * size), evaluation.jacobian[rows, i]
        np.testing.assert_allclose(exact, numeric, atol=1e-5 * np.abs(numeric).max())
    with pytest.raises(SolverError, match=r"no sensor of positions"):
        transcribe(problem)
