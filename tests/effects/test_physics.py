"""Each effect does what its equation says, on systems small enough to be worked out by hand."""

import itertools
import math
from functools import partial

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from small_problems import read

from yid_ocp.effects import make_effect
from yid_ocp.integrator.statics import EquilibriumSolver
from yid_ocp.integrator.step import compile_step, simulate
from yid_ocp.model import FlexibleSegment, Grasp, Mechanism, System, flexible_object, forward_kinematics
from yid_ocp.model.mechanism import Frame, Inertia, Joint, Placement, homogeneous_transform, rotation_from_rpy
from yid_ocp.problem import ProblemOptions
from yid_ocp.problem.evaluation import estimated_initial_state_names, max_abs_initial_internal_offsets
from yid_ocp.sensors import PointSensor, PositionSensor, PrescribedJointEffortSensor

LENGTH, MASS, RADIUS, KAPPA = 0.5, 0.2, 0.02, 3.0
INERTIA = MASS * (LENGTH**2 / 3 + RADIUS**2 / 4)
G = 9.81
H = 0.005


JOINTS = ("T1_0_y", "T1_0_x", "T1_0_z")


def link(gravity=(0.0, 0.0, 0.0), prescribed=JOINTS, links=1) -> System:
    """A tube of equal links on the ground, without damping."""
    segment = FlexibleSegment("T1", LENGTH, MASS, RADIUS, links, bend=KAPPA, damping=0.0)
    return System.build(objects=[(flexible_object([segment]), None, None)], prescribed=prescribed, gravity=gravity)


def hinge(mode: str | None = "prescribed", gravity=(0.0, 0.0, 0.0)) -> System:
    """One arm joint about y that carries a link along z."""
    body = Inertia.from_values(MASS, [0.0, 0.0, LENGTH / 2], np.diag([1e-3, 1e-3, 1e-4]))
    joint = Joint("left_a", "revolute", -1, Placement.identity(), (0.0, 1.0, 0.0), (body,))
    tip = Frame(0, Placement.from_matrix(homogeneous_transform(np.eye(3), [0, 0, LENGTH])))
    tree = Mechanism("arm", (joint,), {"left_gripper": tip})
    return System.build(tree, gravity=gravity, **({mode: ["left_a"]} if mode else {}))


def follow(system, effects, path, values=None, z0=None):
    """Effort of the first prescribed joint along its path, the others held, from steady motion; and the rollout."""
    step = compile_step(system.with_effects(effects), H, use_compiler=False)
    theta = step.system.parameters.vector(values)
    sizes = step.sizes
    lead = np.vstack([2 * path[:1] - path[1:2], path])
    lead = np.pad(lead, ((0, 0), (0, sizes["nc"] - lead.shape[1])))
    start = np.zeros(sizes["nx"])
    if z0 is not None:
        start[2 * sizes["n"] :] = z0
    rollout = simulate(step, theta, start, len(lead) - 1, path=lead)
    assert rollout.status.is_converged
    return rollout.effort[1:, 0], rollout


def still(angle: float, steps: int = 4) -> np.ndarray:
    return np.full((steps, 1), angle)


def turning(rate: float, steps: int = 8, angle: float = 0.0) -> np.ndarray:
    return angle + rate * H * np.arange(steps)[:, None]


def swing(system, effects, angle: float, steps: int):
    """Free motion of an undriven system from a bent start: the bent joint's angle, shape (steps + 1,)."""
    step = compile_step(system.with_effects(effects), H, use_compiler=False)
    start = np.zeros(step.sizes["nx"])
    index = step.system.mechanism.joint_index("T1_0_y")
    start[index] = angle
    rollout = simulate(step, step.system.parameters.vector(), start, steps)
    assert rollout.status.is_converged
    return rollout.state[:, index]


def test_kelvin_voigt_takes_energy_out_at_its_damping_ratio() -> None:
    system, tau, steps = link(prescribed=()), 0.01, 320
    q = swing(system, [make_effect("kelvin_voigt", "T1", system, {"tau": tau})], 0.1, steps)
    omega = math.sqrt(KAPPA / INERTIA)
    assert np.max(np.abs(swing(system, [], 0.1, steps)[-50:])) > 0.0999
    peaks = [k for k in range(1, steps) if q[k - 1] < q[k] > q[k + 1]]
    decrement = math.log(q[peaks[0]] / q[peaks[2]]) / 2
    ratio = tau * omega / 2
    assert decrement == pytest.approx(2 * math.pi * ratio / math.sqrt(1 - ratio**2), rel=0.03)


def test_a_standard_linear_solid_relaxes_with_its_time_constant() -> None:
    system, time, ratio = link(), 0.08, 0.6
    effect = make_effect("standard_linear_solid", "T1", system, {"ratio": ratio, "relaxation_time": time})
    effort, _ = follow(system, [effect], still(0.2, 60))
    t = H * np.arange(len(effort))
    # the first steady step has begun to creep already
    assert effort == pytest.approx(KAPPA * 0.2 * (1 + ratio * np.exp(-(t + H) / time)), rel=0.02)
    assert effort[-1] == pytest.approx(KAPPA * 0.2, rel=0.02)


def test_hysteresis_loses_energy_and_saturates() -> None:
    system, stiffness, angle = link(), 1.5, 0.1
    effect = make_effect("hysteresis", "T1", system, {"stiffness": stiffness, "yield_angle": angle})
    path = 0.6 * np.sin(2 * np.pi * 0.5 * H * np.arange(801))[:, None]
    effort, _ = follow(system, [effect], path, dict(zip(effect.parameters.names, (stiffness, angle), strict=True)))
    nominal, _ = follow(system, [], path)
    friction = effort - nominal
    assert np.max(np.abs(friction)) == pytest.approx(stiffness * angle, rel=0.05)
    second = slice(401, 800)
    # work of one cycle, against that of a dry friction of the saturated torque
    work = np.sum(friction[second] * np.gradient(path[:, 0])[second])
    assert 0.7 < work / (4 * 0.6 * stiffness * angle) < 1.0


def test_rest_curvature_is_where_the_object_comes_to_rest() -> None:
    system = link(prescribed=(), links=2)
    bent = system.with_effects([make_effect("rest_curvature", "T1", system, {"qx": 0.1, "qy": -0.2})])
    rest = EquilibriumSolver(compile_step(bent, H, use_compiler=False)).solve([], bent.parameters.vector())
    assert rest.state[:6] == pytest.approx([0.1, -0.2, 0.0] * 2)


about_x = partial(link, prescribed=("T1_0_x", "T1_0_y", "T1_0_z"))
heavy_link, heavy_hinge = (partial(made, gravity=(0, 0, -G)) for made in (link, hinge))
WEIGHT, LOAD = MASS * G * LENGTH / 2, -MASS * G * LENGTH / 2
FLAT, BENT = math.pi / 2, KAPPA * math.pi / 2


@pytest.mark.parametrize(
    ("made", "kind", "location", "values", "angle", "torque"),
    [
        (link, "cubic_stiffness", "T1", {"k3": 5.0}, 0.4, KAPPA * 0.4 + 5.0 * 0.4**3),
        (link, "bend_anisotropy", "T1", {"ratio": 0.25}, 0.3, KAPPA * 1.25 * 0.3),
        (about_x, "bend_anisotropy", "T1", {"ratio": 0.25}, 0.3, KAPPA * 0.3),
        (heavy_link, "density", "T1", {"scale": 1.3}, FLAT, BENT - 1.3 * WEIGHT),
        (heavy_link, "length_scale", "T1", {"scale": 1.1}, FLAT, BENT - 1.1 * WEIGHT),
        (heavy_link, "point_mass", "w_T1", {"mass": 0.05}, FLAT, BENT - WEIGHT - 0.05 * G * LENGTH),
        (heavy_link, "gravity_scale", "object", {"fraction": -0.4}, FLAT, BENT - 0.6 * WEIGHT),
        (heavy_link, "gravity_tilt", "world", {"ry": 0.03}, 0.0, WEIGHT * math.sin(0.03)),
        (heavy_hinge, "joint_spring", "left_a", {"stiffness": 20, "rest_angle": 0.4}, 1.0, LOAD * math.sin(1.0) + 12.0),
        (heavy_hinge, "link_mass", "left_a", {"scale": 1.15}, 1.0, 1.15 * LOAD * math.sin(1.0)),
        (heavy_hinge, "point_mass", "left_gripper", {"mass": 0.33}, FLAT, LOAD - 0.33 * G * LENGTH),
    ],
)
def test_torque_that_holds_a_joint(made, kind, location, values, angle, torque) -> None:
    system = made()
    effort, _ = follow(system, [make_effect(kind, location, system, values)], still(angle))
    assert effort == pytest.approx(torque)


@pytest.mark.parametrize(
    ("made", "kind", "location", "values", "inertia"),
    [
        (link, "density", "T1", {"scale": 1.3}, 1.3 * INERTIA),
        (link, "length_scale", "T1", {"scale": 1.1}, MASS * (1.1**2 * LENGTH**2 / 3 + RADIUS**2 / 4)),
        (link, "point_mass", "w_T1", {"mass": 0.05}, INERTIA + 0.05 * LENGTH**2),
        (link, "gravity_scale", "object", {"fraction": -0.4}, INERTIA),
        (hinge, "rotor_inertia", "left_a", {"armature": 0.3}, 0.3 + 1e-3 + MASS * LENGTH**2 / 4),
    ],
)
def test_inertia_of_an_accelerated_joint(made, kind, location, values, inertia) -> None:
    system = made()
    path = 0.5 * 20.0 * (H * np.arange(10)[:, None]) ** 2
    slack = {"T1.bend": 0.0} if made is link else {}
    effort, _ = follow(system, [make_effect(kind, location, system, values)], path, slack)
    assert effort[2:] == pytest.approx(20.0 * inertia, rel=1e-6)


def test_drag_of_a_turning_link() -> None:
    system, rate, cd = link(), 6.0, 1.2
    effort, _ = follow(system, [make_effect("aerodynamic_drag", "T1", system, {"cd": cd})], turning(rate))
    force = 0.5 * 1.2 * cd * 2 * RADIUS * LENGTH * (rate * LENGTH / 2) ** 2
    assert effort - follow(system, [], turning(rate))[0] == pytest.approx(force * LENGTH / 2, rel=1e-3)


def rest_of(system: System, *effects):
    step = compile_step(system.with_effects(effects), H, use_compiler=False)
    rest = EquilibriumSolver(step).solve([], step.system.parameters.vector())
    assert rest.is_converged
    return step, rest


def test_a_mount_is_a_spring_in_series() -> None:
    system = link(gravity=(0.3, 0, 0), prescribed=())
    step, rest = rest_of(system, make_effect("mount_compliance", "base", system, {"stiffness": 12.0}))
    names = step.system.mechanism.joint_names
    assert names == ("mount_compliance@base_x", "mount_compliance@base_y", "T1_0_x", "T1_0_y", "T1_0_z")
    mount, bend = rest.state[1], rest.state[3]
    # both bear the same torque
    assert 12.0 * mount == pytest.approx(KAPPA * bend)
    assert 12.0 * mount == pytest.approx(MASS * 0.3 * LENGTH / 2 * math.cos(mount + bend))
    assert rest.state[0] == pytest.approx(0.0, abs=1e-12)


def test_a_junction_turns_all_branches() -> None:
    segments = [FlexibleSegment("T1", LENGTH, MASS, RADIUS, 2, damping=0.0)]
    for name, lean in (("T2", -0.5), ("T3", 0.5)):
        turn = rotation_from_rpy(lean, 0, 0)
        segments.append(FlexibleSegment(name, 0.2, 0.05, RADIUS, 1, parent="T1", rest_rotation=turn, damping=0.0))
    system = System.build(objects=[(flexible_object(segments), None, None)], gravity=(0.4, 0.0, 0.0))
    step, rest = rest_of(system, make_effect("junction_compliance", "w_T1", system, {"stiffness": 8.0}))
    at = step.system.mechanism.joint_index
    # the torque of both branches about the junction's y axis goes through its spring
    theta = step.system.parameters.vector()
    kinematics = forward_kinematics(step.system.mechanism, ca.SX(ca.DM(rest.state[: step.sizes["n"]])))
    vectors = [*map(kinematics.frame_position, ("w_T1", "w_T2", "w_T3")), kinematics.joint_screws[at("T2_0_x") - 1][:3]]
    found = ca.Function("found", [step.system.parameters.symbols], vectors)(theta)
    junction, *tips, axis = (np.array(vector).ravel() for vector in found)
    torque = sum(np.cross((tip - junction) / 2, [0.05 * 0.4, 0, 0]) @ axis for tip in tips)
    assert 8.0 * rest.state[at("junction_compliance@w_T1_y")] == pytest.approx(torque, rel=1e-6)


def hanging(kind: str, **values: float):
    """The one-link tube, its tip held from above by an arm joint prescribed at zero: step, rest, index of its foot."""
    up = Placement.from_matrix(homogeneous_transform(np.eye(3), [0, 0, LENGTH]))
    joint = Joint("left_a", "revolute", -1, up, (0.0, 0.0, 1.0))
    robot = Mechanism("arm", (joint,), {"left_gripper": Frame(0, Placement.identity())})
    item = flexible_object([FlexibleSegment("T1", LENGTH, MASS, RADIUS, 1, bend=KAPPA, damping=0.5)])
    slide = Joint("foot", "prismatic", -1, Placement.identity(), (0.0, 0.0, 1.0))
    tree = robot.with_attached_mechanism(Mechanism("rail", (slide,), {"rail": Frame(0, Placement.identity())}))
    parts = {"objects": [(item, "rail", None)], "grasps": [Grasp("left", "left_gripper", "w_T1")]}
    system = System.build(tree, **parts, prescribed=["left_a"], gravity=(0, 0, -G), damping=0.0)
    step = compile_step(system.with_effects([make_effect(kind, "left", system, values)]), H, use_compiler=False)
    rest = EquilibriumSolver(step).solve([0.0], step.system.parameters.vector())
    assert rest.is_converged
    return step, rest.state, step.system.mechanism.joint_index("foot")


def test_a_compliant_grasp_stretches_by_force_over_stiffness() -> None:
    _, rest, foot = hanging("grasp_compliance", stiffness=400.0, damping=3.0)
    # the tube hangs on the grasp alone: its foot slides
    assert rest[foot] == pytest.approx(-MASS * G / 400.0)


def test_a_slipping_grasp_creeps_at_its_rate() -> None:
    step, rest, at = hanging("grasp_slip", slip_per_load=0.005)
    rollout = simulate(step, step.system.parameters.vector(), rest, 40)
    assert rollout.status.is_converged
    foot, offset = rollout.state[:, at], rollout.state[:, -1]
    # the gripper pulls the tube up, so it creeps towards the tip and the tube sinks
    assert offset[-1] == pytest.approx(0.005 * MASS * G * 40 * H, rel=0.02)
    assert foot[-1] == pytest.approx(-offset[-1], abs=1e-9)


def test_a_grasp_offset_moves_the_held_point() -> None:
    _, rest, foot = hanging("grasp_offset", dz=0.013)
    assert rest[foot] == pytest.approx(0.013)


@pytest.mark.parametrize(
    ("kind", "values", "extra"),
    [
        ("joint_viscous", {"b": 0.7}, lambda v: 0.7 * v),
        ("joint_coulomb", {"tau_c": 0.9}, lambda v: 0.9 * math.copysign(1, v)),
        ("joint_stribeck", {"tau_s": 0.9, "v_stribeck": 0.5}, lambda v: 0.9 * math.exp(-4.0) * math.copysign(1, v)),
    ],
)
@pytest.mark.parametrize("rate", [1.0, -1.0])
def test_friction_works_against_the_motion(kind, values, extra, rate) -> None:
    system = hinge()
    effort, _ = follow(system, [make_effect(kind, "left_a", system, values)], turning(rate))
    assert effort == pytest.approx(extra(rate), rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("use_compiler", [True, False])
def test_a_joint_breaks_loose_where_friction_falls_faster_than_inertia_over_step(use_compiler) -> None:
    system = hinge("driven")
    sizes = {"joint_coulomb": {"tau_c": 0.3}, "joint_stribeck": {"tau_s": 1.0, "v_stribeck": 0.05}}
    rubbing = system.with_effects([make_effect(kind, "left_a", system, own) for kind, own in sizes.items()])
    step, torque = compile_step(rubbing, H, use_compiler=use_compiler), np.linspace(0.0, 2.0, 101)[:, None]
    rollout = simulate(step, rubbing.parameters.vector(), np.zeros(step.sizes["nx"]), 101, torque)
    assert rollout.status.is_converged
    speed = np.diff(rollout.state[:, 0]) / H
    assert np.max(np.abs(speed[torque[:, 0] < 0.9])) < 0.05
    assert np.min(speed[torque[:, 0] > 1.3]) > 0.2


TAU = 0.8


@pytest.mark.parametrize("width", [0.2, 0.02, 1e-4])
def test_s_is_the_solution_of_dahls_equation(width) -> None:
    t, system = 0.01 * np.arange(201), hinge()
    path = 0.3 * (1 - np.cos(2 * np.pi * t)) + 0.05 * np.sin(9 * t) - 0.45 * t
    effect = make_effect("joint_presliding", "left_a", system, {"tau_c": TAU, "yield_angle": width})
    step = compile_step(system.with_effects([effect]), 0.01, use_compiler=False)
    rollout = simulate(step, step.system.parameters.vector(), np.array([0.0, 0.0, -0.4]), 200, path=path[:, None])
    assert rollout.status.is_converged
    s = rollout.state[:, 2]
    expected = [-0.4]
    for a, b in itertools.pairwise(path):
        way = np.sign(b - a)
        run = solve_ivp(lambda x, y, way=way: (1 - way * y) / width * way, (0, abs(b - a)), [expected[-1]], rtol=1e-9)
        expected.append(float(run.y[0, -1]))
    np.testing.assert_allclose(s, expected, atol=5e-3)
    assert np.max(np.abs(s)) <= 1.0 + 1e-3


def test_every_step_takes_out_more_than_it_stores() -> None:
    """Stored is tau_c yield_angle s^2/2; the law of one step alone, for any angle and any s."""
    system = hinge()
    effect = make_effect("joint_presliding", "left_a", system, {"tau_c": TAU, "yield_angle": 0.01})
    step = compile_step(system.with_effects([effect]), H, use_compiler=False)
    e, theta, rng = step.equations, step.system.parameters.vector(), np.random.default_rng(1)
    bare = compile_step(system, H, use_compiler=False).equations
    inputs = [e.q0, e.q1, e.z0, e.z1, e.p0, e.theta, e.time_step]
    law = ca.Function("law", inputs, [e.internal_residual, e.momentum_balance])
    without = ca.Function("without", [bare.q0, bare.q1, bare.p0, bare.theta, bare.time_step], [bare.momentum_balance])
    for _ in range(200):
        turned, before = 10.0 ** rng.uniform(-7, 0) * rng.choice([-1, 1]), rng.uniform(-1, 1)
        residual = float(law(0, turned, before, before, 0, theta, H)[0])
        after = before - residual  # the equation is z1 - z0 - change, whatever z1 is
        assert abs(float(law(0, turned, before, after, 0, theta, H)[0])) < 1e-12
        friction = float(law(0, turned, before, after, 0, theta, H)[1])
        friction -= float(without(0, turned, 0, system.parameters.vector(), H))
        work = -friction / (H / 2) * turned
        stored = TAU * 0.01 * (after**2 - before**2) / 2
        assert work >= stored - 1e-6 * TAU * 0.01


def test_it_holds_a_load_at_rest_and_lets_go_above() -> None:
    """Gravity on a hanging arm turned aside: below tau_c it creeps into the presliding angle and stays."""
    weight = MASS * G * LENGTH / 2
    for tau_c, stays in ((1.3 * weight, True), (0.5 * weight, False)):
        system = hinge(gravity=(G, 0.0, 0.0), mode=None)
        effects = [
            make_effect("joint_presliding", "left_a", system, {"tau_c": tau_c, "yield_angle": 1e-3}),
            make_effect("joint_viscous", "left_a", system, {"b": 0.5}),
        ]
        step = compile_step(system.with_effects(effects), H / 10, use_compiler=False)
        rollout = simulate(step, step.system.parameters.vector(), np.zeros(step.sizes["nx"]), 1200)
        assert rollout.status.is_converged
        q = rollout.state[:, 0]
        assert (abs(q[-1]) < 0.02) == stays
        if stays:
            assert abs(q[-1] - q[-200]) < 1e-6
            assert rollout.state[-1, 2] == pytest.approx(weight * np.cos(q[-1]) / tau_c, rel=1e-3)


def test_a_resting_joint_is_as_stiff_as_the_friction_before_it_yields() -> None:
    system = hinge("driven")
    effect = make_effect("joint_presliding", "left_a", system, {"tau_c": TAU, "yield_angle": 0.02})
    step = compile_step(system.with_effects([effect]), H, use_compiler=False)
    theta = step.system.parameters.vector()
    a, b, _ = step.jacobians(np.zeros(1), np.zeros(1), np.zeros(1), theta, internal=np.zeros(1))
    inertia = 1e-3 + MASS * LENGTH**2 / 4
    # dq/du of a midpoint step: h^2/2 over M + h^2 k/4
    assert b[0, 0] == pytest.approx(H**2 / 2 / (inertia + H**2 / 4 * TAU / 0.02), rel=1e-4)
    assert a[2, 0] == pytest.approx((a[0, 0] - 1) / 0.02, rel=1e-6)


def test_where_it_begins_is_estimated_with_every_recording() -> None:
    system = hinge()
    whole = system.with_effects([make_effect("joint_presliding", "left_a", system)])
    theta, options = whole.parameters.vector(), ProblemOptions()
    assert estimated_initial_state_names(whole, options, (), theta) == ()
    [name] = estimated_initial_state_names(whole, options, ("joint_presliding@left_a.tau_c",), theta)
    assert name == "z.joint_presliding@left_a.s"
    assert max_abs_initial_internal_offsets(whole, [name]).tolist() == [1.0]
    known = whole.parameters.vector({"joint_presliding@left_a.tau_c": 0.1})
    assert estimated_initial_state_names(whole, options, (), known) == (name,)


@pytest.mark.parametrize(
    ("kind", "values", "angle", "torque"),
    [
        ("encoder_offset", {"offset": 0.02}, 0.52, 3.0),
        ("series_elasticity", {"stiffness": 300.0}, 0.51, 3.0),
        ("backlash", {"width": 0.01}, 0.5 + 0.005 * math.tanh(3.0 / 0.2), 3.0),
        ("effort_gain", {"scale": 0.9}, 0.5, 2.7),
        ("effort_offset", {"offset": -0.4}, 0.5, 2.6),
    ],
)
def test_joint_readings_and_the_way_back(kind, values, angle, torque) -> None:
    system, names = hinge(), ("left_a",)
    effect = make_effect(kind, "left_a", system, values)
    whole, sensors = system.with_effects([effect]), (PositionSensor(names), PrescribedJointEffortSensor(names))
    seen = [read(whole, sensor, [0.5], [3.0])[0] for sensor in sensors]
    assert seen == pytest.approx([angle, torque])
    channels = zip(("joints.position.left_a", "joints.effort.left_a"), seen, strict=True)
    back = [effect.true_value_from_reading(channel, ca.SX(reading), ca.SX(3.0)) for channel, reading in channels]
    value = ca.Function("back", [effect.parameters.symbols], back)(ca.DM([p.value for p in effect.parameters]))
    assert [float(x) for x in value] == pytest.approx([0.5, 3.0])
    assert effect.true_value_from_reading("joints.position.other", ca.SX(1), ca.SX(1)).is_one()


POSE = np.eye(4)
POSE[:3, 3] = [1.0, 0.0, 0.2]


def test_cameras_see_points_elsewhere() -> None:
    system = link(prescribed=())
    eye = PointSensor("points_camera", ("w_T1",), ("w_T1",), tuple(map(tuple, POSE)))
    true, centre = np.array([0.0, 0.0, LENGTH]), POSE[:3, 3]
    assert read(system, eye) == pytest.approx(true)

    def seen(kind: str, **values: float) -> np.ndarray:
        whole = system.with_effects([make_effect(kind, "camera", system, values)])
        assert read(whole, PointSensor("points_mocap", ("w_T1",), ("w_T1",))) == pytest.approx(true)
        return read(whole, eye)

    assert seen("camera_translation", x=0.01, z=-0.02) - true == pytest.approx([0.01, 0.0, -0.02])
    turned = seen("camera_rotation", ry=0.05)
    assert np.linalg.norm(turned - centre) == pytest.approx(np.linalg.norm(true - centre))
    assert turned - true == pytest.approx(np.cross([0, 0.05, 0], true - centre), abs=2e-3)
    assert seen("camera_scale", scale=1.02) - centre == pytest.approx(1.02 * (true - centre))


def test_latency_belongs_to_cameras_and_late_torque_to_arms() -> None:
    late = make_effect("effort_delay", "left", hinge("driven"), {"delay": 0.03})

    def seconds(effect, channel: str, camera: bool = False) -> float:
        values = ca.DM([p.value for p in effect.parameters])
        delay = effect.added_channel_delay(channel, camera)
        return float(ca.Function("d", [effect.parameters.symbols], [delay])(values))

    assert seconds(late, "torque.left_a") == 0.03
    assert seconds(late, "joints.effort.left_a") == -0.03
    assert seconds(late, "joints.position.left_a") == seconds(late, "torque.right_a") == 0.0
    latency = make_effect("camera_latency", "camera", link(prescribed=()), {"delay": 0.05})
    assert seconds(latency, "points_camera.w_T1", True) == 0.05
    assert seconds(latency, "points_mocap.w_T1", False) == 0.0


def test_a_fast_clock_slows_what_is_recorded() -> None:
    system, steps = link(prescribed=()), 300
    true = swing(system, [], 0.05, steps)
    recorded = swing(system, [make_effect("clock_scale", "clock", system, {"scale": 1.1})], 0.05, steps)
    t = H * np.arange(steps + 1)
    assert recorded == pytest.approx(np.interp(t / 1.1, t, true), abs=2e-3)
