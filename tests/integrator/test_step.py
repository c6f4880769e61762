"""What a step does: prescribed coordinates and their effort, internal and compliant coordinates, grasps, failures."""

import math
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from yid_ocp.errors import ModelError
from yid_ocp.integrator.step import compile_step, simulate, step_with_time_step
from yid_ocp.integrator.step_model import NewtonStatusCode
from yid_ocp.model import FlexibleSegment, Grasp, Parameters, System, flexible_object
from yid_ocp.model.mechanism import Inertia
from yid_ocp.model.system import EffectStepTerms, six_joint_floating_mechanism
from yid_ocp.model.urdf import read_urdf, urdf_path_from_robot_name

ARM = [f"left_{joint}" for joint in ("s0", "s1", "e0", "e1", "w0", "w1", "w2")]
BENT = np.array([0.3, -0.2, 0.1, 0.4, 0.2, -0.1, 0.2, 0.3, 0.15])


def numbers(expression) -> np.ndarray:
    return np.array(ca.DM(ca.densify(expression)))


def smooth(time):
    """Angles, rates and accelerations of seven joints."""
    amplitude, rate = np.linspace(0.2, 0.6, 7), np.linspace(1.0, 4.0, 7)
    phase = np.outer(np.atleast_1d(time), rate) + np.arange(7)
    return amplitude * np.sin(phase), amplitude * rate * np.cos(phase), -amplitude * rate**2 * np.sin(phase)


def test_effort_of_prescribed_joints_is_inverse_dynamics_to_second_order(roll, momentum):
    pin = pytest.importorskip("pinocchio", reason="the reference needs Pinocchio: pip install pin")
    system = System.build(read_urdf("package:baxter", joints=ARM), prescribed=ARM)
    theta = system.parameters.vector()
    full = pin.buildModelFromUrdf(str(urdf_path_from_robot_name("package:baxter")))
    rest = [i for i in range(1, full.njoints) if full.names[i] not in ARM]
    model = pin.buildReducedModel(full, rest, pin.neutral(full))
    assert list(model.names[1:]) == ARM
    data = model.createData()
    errors, counts = [], (20, 40, 80, 160)
    for count in counts:
        step = compile_step(system, 0.5 / count)
        q, v, a = smooth(np.arange(count + 1) * step.time_step)
        rollout = roll(step, theta, q[0], momentum(step, q[0], v[0], theta), count, path=q)
        needed = np.array([pin.rnea(model, data, *row) for row in zip(q, v, a, strict=True)])
        errors.append(np.max(np.abs(rollout.effort[1:] - needed[1:-1])))
        # a start with its true momentum has felt only half a step of its effort
        assert np.max(np.abs(2 * rollout.effort[0] - needed[0])) < 60 * step.time_step
    assert np.polyfit(np.log(1 / np.array(counts)), np.log(errors), 1)[0] == pytest.approx(2.0, abs=0.1)


def test_the_effort_of_a_clamp_is_the_pull_of_its_grasp(parts, roll):
    """The clamp has no mass, so its translational effort is the multipliers over the time step."""
    system, q = parts.clamped_cable("point")
    step = compile_step(system, 1e-3)
    rollout = roll(step, system.parameters.vector(), q, np.zeros(system.n_coordinates), 20)
    np.testing.assert_allclose(rollout.effort[:, :3], rollout.multipliers / step.time_step, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(rollout.effort[:, 3:], 0.0, atol=1e-9)


@pytest.fixture(scope="module")
def hinge():
    """One rod on a three-axis joint at the ground."""

    def build(effects=(), **options):
        rod = flexible_object([FlexibleSegment("R", 0.4, 0.2, 0.05, links=1, bend=2.0, twist=1.0, damping=0.0)])
        return System.build(objects=[(rod, None, None)], effects=effects, **options)

    return build


def test_a_maxwell_branch_relaxes_with_its_time_constant(parts, hinge, roll):
    tau, k1, angle = 0.05, 3.0, 0.2
    system = hinge([parts.maxwell_branch("R_0_x", k1, tau)], prescribed=["R_0_x"], gravity=(0, 0, 0))
    theta, q = system.parameters.vector(), np.array([angle, 0.0, 0.0])
    errors = []
    for count in (50, 100):
        step = compile_step(system, 0.2 / count)
        assert step.sizes["nz"] == 1
        rollout = roll(step, theta, q, np.zeros(3), count)
        z = rollout.state[:, -1]
        expected = angle * (1 - np.exp(-np.arange(count + 1) * step.time_step / tau))
        errors.append(np.max(np.abs(z - expected)))
        assert rollout.status.internal_coordinates == pytest.approx([z[-1]])
        # torque on the held joint: the spring beside, and what is left of the branch's
        stretch = angle - expected[1:-1]
        np.testing.assert_allclose(rollout.effort[1:, 0], 2.0 * angle + k1 * stretch, rtol=5e-3)
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.05)


def test_an_internal_coordinate_needs_an_equation(parts, hinge):
    internal = {"orphan@R.z": ca.SX.sym("z")}
    orphan = parts.Added("orphan", "R", Parameters(), internal, add=lambda effect, state: EffectStepTerms())
    with pytest.raises(ModelError, match=r"orphan@R\.z"):
        compile_step(hinge([orphan]), 0.01)


def test_a_compliance_equals_a_spring(parts, roll):
    """Spring 2 N m/rad against compliance 1/2; the momentum of a compliant coordinate carries the compliance."""
    plain, soft = parts.cable(), parts.cable(effects=[parts.soft_joint("C_1_y", 0.5)])
    index = plain.mechanism.joint_index("C_1_y")
    states = []
    for system in (plain, soft):
        theta = system.parameters.vector({"C.damping": 0.0})
        states.append(roll(compile_step(system, 1e-3), theta, BENT, np.zeros(9), 200).state.copy())
    states[1][:, 9 + index] /= 0.5
    np.testing.assert_allclose(states[1], states[0], rtol=0, atol=1e-8)


def test_without_compliance_a_coordinate_stays_at_zero(parts, roll):
    q = BENT.copy()
    index = 4
    q[index] = 0.0
    system = parts.cable(effects=[parts.soft_joint("C_1_y", 0.0)])
    assert system.mechanism.joint_index("C_1_y") == index
    step = compile_step(system, 1e-3)
    rollout = roll(step, system.parameters.vector(), q, np.zeros(9), 200)
    # exactly in compiled code, whose elimination does not pivot
    assert np.max(np.abs(rollout.state[:, [index, 9 + index]])) <= (0.0 if step.is_compiled else 1e-18)
    assert np.ptp(rollout.state[:, 3]) > 0.01
    # the neighbours move as if there were no joint
    rigid = replace(parts.cable(prescribed=["C_1_y"]))
    other = roll(compile_step(rigid, 1e-3), rigid.parameters.vector(), q, np.zeros(9), 200)
    np.testing.assert_allclose(rollout.state[:, :9], other.state[:, :9], rtol=0, atol=1e-9)


def test_the_step_is_differentiable_where_the_compliance_is_zero(parts):
    system = parts.cable(effects=[parts.soft_joint("C_1_y", 0.0)])
    step = compile_step(system, 1e-3)
    q = BENT.copy()
    q[4] = 0.0
    theta = system.parameters.vector()
    _, _, B = step.jacobians(q, np.zeros(9), [], theta, names=["soft@C_1_y.compliance"])
    small = 1e-7
    moved = step(q, np.zeros(9), [], system.parameters.vector({"soft@C_1_y.compliance": small}))
    still = step(q, np.zeros(9), [], theta)
    expected = np.concatenate([(a - b) / small for a, b in zip(moved[:2], still[:2], strict=True)])
    assert abs(B[4, 0]) > 1e-3
    np.testing.assert_allclose(B[:, 0], expected, rtol=1e-3, atol=1e-4 * np.max(np.abs(expected)))


@pytest.mark.parametrize("relaxation", [None, 5e-3])
def test_a_soft_grasp_gives_way_in_proportion_and_relaxes_with_its_time_constant(parts, roll, violation, relaxation):
    """phi + T dphi/dt = C lam / h, backward in time: damping beside the grasp's stiffness."""
    compliance = 2e-4
    system, q = parts.clamped_cable("point", [parts.soft_grasp("clamp", compliance, relaxation)])
    step, theta = compile_step(system, 1e-3), system.parameters.vector()
    rollout = roll(step, theta, q, np.zeros(system.n_coordinates), 30)
    rigid, _ = parts.clamped_cable("point")
    plain = compile_step(rigid, 1e-3)
    nominal = rigid.parameters.vector()
    gaps = [violation(plain, x[: system.n_coordinates], nominal) for x in rollout.state]
    for k in (0, 10, 29):
        rate = (gaps[k + 1] - gaps[k]) / step.time_step
        load = rollout.multipliers[k] / step.time_step
        np.testing.assert_allclose(gaps[k + 1] + (relaxation or 0.0) * rate, compliance * load, rtol=1e-8, atol=1e-12)


@pytest.mark.parametrize("kind", ["point", "axis", "weld"])
def test_grasps_hold_what_they_should(parts, roll, violation, kind):
    system, q = parts.clamped_cable(kind)
    step, theta = compile_step(system, 5e-4), system.parameters.vector()
    path = np.tile(q[:6], (101, 1))
    # the clamp turns about its own axes
    path[:, 3:] += np.outer(1 - np.cos(np.linspace(0, np.pi, 101)), [0.05, -0.04, 0.08])
    end = roll(step, theta, q, np.zeros(system.n_coordinates), 100, path=path).state[-1, : system.n_coordinates]
    assert np.max(np.abs(violation(step, end, theta))) < 1e-10
    grasp = system.grasps[0]
    holder = parts.tip(system.mechanism, "clamp", end)
    wanted = holder[:3, :3] @ numbers(grasp.held_orientation)
    held = parts.tip(system.mechanism, "w_C", end)
    np.testing.assert_allclose(held[:3, 3], holder[:3, 3], atol=1e-9)
    aligned = np.allclose(held[:3, 2], wanted[:, 2], atol=1e-9)
    same = np.allclose(held[:3, :3], wanted, atol=1e-9)
    assert (aligned, same) == {"point": (False, False), "axis": (True, False), "weld": (True, True)}[kind]


def test_a_creeping_grasp_slides_along_the_object(parts, roll, violation):
    system, q = parts.clamped_cable("point", [parts.creeping_grasp("clamp", 0.05)])
    step, theta = compile_step(system, 5e-4), system.parameters.vector()
    rollout = roll(step, theta, q, np.zeros(system.n_coordinates), 100)
    slip, end = rollout.state[-1, -1], rollout.state[-1, : system.n_coordinates]
    held, holder = parts.tip(system.mechanism, "w_C", end), parts.tip(system.mechanism, "clamp", end)
    assert abs(slip) > 1e-4
    np.testing.assert_allclose(held[:3, 3] - slip * held[:3, 2], holder[:3, 3], atol=1e-9)
    assert system.parameters.vector()[-1] == 0.05


@pytest.mark.parametrize("use_compiler", [True, False], ids=["compiled", "interpreted"])
class TestFailures:
    def test_a_torque_that_is_not_a_number(self, robot, use_compiler):
        system = System.build(robot, driven=["elbow"])
        step = compile_step(system, 0.01, use_compiler=use_compiler)
        theta = system.parameters.vector()
        _, _, _, status = step([0.1, 0.2], [0.0, 0.0], [math.nan], theta)
        assert (status.is_converged, status.code, status.completed_steps) == (False, NewtonStatusCode.NOT_FINITE, 0)
        torque = np.zeros((12, 1))
        torque[7] = math.nan
        rollout = simulate(step, theta, [0.1, 0.2, 0.0, 0.0], 12, torque)
        assert (rollout.status.code, rollout.status.completed_steps) == (NewtonStatusCode.NOT_FINITE, 7)
        assert rollout.status.message.startswith("at step 7, the state is no longer finite")
        assert np.all(np.isfinite(rollout.state[:8]))
        assert np.all(np.isnan(rollout.state[9:]))
        assert np.all(np.isnan(rollout.multipliers[7:]))

    def test_a_system_without_unknowns(self, robot, use_compiler):
        system = System.build(robot, prescribed=["shoulder", "elbow"])
        step = compile_step(system, 0.01, use_compiler=use_compiler)
        pair = ([0.1, 0.2], [0.11, 0.19])
        q1, p1, lam, status = step(pair[0], [0.0, 0.0], [], system.parameters.vector(), prescribed=pair)
        assert status.is_converged
        np.testing.assert_array_equal(q1, pair[1])
        assert np.all(np.isfinite([*p1, *status.prescribed_effort]))
        assert lam.shape == (0,)


def test_a_status_says_what_to_try(single_step, golden, theta_golden):
    trep, theta = golden("single"), theta_golden("single")
    *_, status = single_step(trep.q[0], trep.p[0], 1e6 * trep.u[0] + 1e7, theta)
    assert not status.is_converged
    assert "at step 0, Newton's method found no solution" in status.message
    *_, status = single_step(trep.q[0], trep.p[0], trep.u[0], theta)
    assert (status.is_converged, status.message, status.completed_steps) == (True, "converged", 1)
    assert status.newton_iterations >= 1
    assert status.last_correction < single_step.model.tolerance


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        *(({"time_step": h}, [f"time_step is {h}", "a number above 0 [s]"]) for h in (0.0, -0.01, math.nan, math.inf)),
        ({"force_split": "right"}, ["no rule 'right'", "force_split", "symmetric, left"]),
        ({"constraint_force_at": "end"}, ["no rule 'end'", "constraint_force_at", "node, midpoint"]),
    ],
)
def test_a_step_that_cannot_be_is_refused(refused_with, hinge, arguments, words):
    with refused_with(ModelError, words):
        compile_step(hinge(), **{"time_step": 0.01, **arguments})


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"q0": np.zeros(5)}, ["q0", "(5,)", "(6,)"]),
        ({"p0": np.zeros((6, 1))}, ["p0", "(6, 1)", "(6,)"]),
        ({"u": np.zeros(3)}, ["u has shape (3,)", "(2,)"]),
        ({"theta": np.zeros(4)}, ["theta", "(4,)"]),
        ({"prescribed": None}, ["0 entries for 1 prescribed coordinates", "prescribed=(s0, s1)"]),
        ({"prescribed": ([0.3],)}, ["`prescribed` has 1 entries"]),
        ({"prescribed": ([0.3], [0.3, 0.1])}, ["prescribed has shape (2,)", "(1,)"]),
        ({"internal": [1.0]}, ["internal has shape (1,)", "(0,)"]),
    ],
)
def test_wrong_shapes_name_the_array(refused_with, parts, urdf_folder, change, words):
    system, q = parts.closed_loop(urdf_folder)
    step = compile_step(system, 0.01, use_compiler=False)
    s = system.mechanism.joint_index("swing")
    arguments = {"q0": q, "p0": np.zeros(6), "u": np.zeros(2), "theta": system.parameters.vector()}
    arguments |= {"prescribed": (q[[s]], q[[s]])}
    assert step(**arguments)[3].is_converged
    with refused_with(ModelError, words):
        step(**{**arguments, **change})


@pytest.mark.parametrize("use_compiler", [True, False])
def test_a_step_of_another_length_is_one_compiled_for_it(parts, use_compiler):
    system = parts.cable()
    coarse, expected = (compile_step(system, h, use_compiler=use_compiler) for h in (4e-3, 1e-4))
    fine = step_with_time_step(coarse, 1e-4)
    assert fine.model.tolerance == expected.model.tolerance < coarse.model.tolerance
    state, theta = np.concatenate([BENT, np.zeros(9)]), system.parameters.vector()
    names = ("C.bend", "C.twist")
    for step in (fine, expected):
        assert step.time_step == 1e-4
    at = (state[:9], state[9:], [], theta)
    made, again = ([*step(*at)[:2], *step.jacobians(*at, names=names)] for step in (fine, expected))
    for one, other in zip(made, again, strict=True):
        np.testing.assert_array_equal(one, other)
    assert coarse.time_step == 4e-3
    assert np.max(np.abs(coarse(*at)[0] - made[0])) > 1e-6
    with pytest.raises(ModelError, match="time_step is 0"):
        step_with_time_step(coarse, 0.0)


PULL, WEIGHT = 100.0, 9.81  # [N]


def test_tension_makes_no_motion_grow_where_constraints_pull_at_the_midpoint(parts):
    """A light cable, almost straight, drawn up by a clamp of 1 kg."""
    light = {"mass": 0.06, "radius": 0.01, "bend": 0.5, "twist": 0.5, "damping": 1e-3}
    clamp, bent = six_joint_floating_mechanism("clamp"), np.array([0.02, 0, 0, -0.03, 0, 0, 0.01, 0, 0])
    body = Inertia.from_values(1.0, np.zeros(3), 1e-3 * np.eye(3))
    clamp = replace(clamp, joints=tuple(replace(j, bodies=(body,) * (j.name == "clamp_z")) for j in clamp.joints))
    held = [name for name in clamp.joint_names if name != "clamp_z"]
    objects = [(parts.cable_object(**light), None, None)]
    grasps = [Grasp("clamp", "clamp", "w_C")]
    system = System.build(clamp, objects=objects, grasps=grasps, driven=["clamp_z"], prescribed=held, damping=0.1)
    start = np.concatenate([parts.tip(parts.cable().mechanism, "w_C", bent)[:3, 3], np.zeros(3), bent, np.zeros(15)])

    def roll(h, constraint_force_at):
        step, count = compile_step(system, h, "symmetric", constraint_force_at, use_compiler=False), round(2 / h)
        return simulate(step, system.parameters.vector(), start, count, np.full((count, 1), PULL))

    assert not roll(0.01, "node").status.is_converged
    for h in (0.02, 0.01):
        taut = roll(h, "midpoint")
        assert taut.status.is_converged, taut.status.message
        assert np.max(np.abs(taut.state[:, 6:15])) < 0.2
        assert np.mean(taut.multipliers[:, 2]) / h == pytest.approx(PULL - WEIGHT, rel=0.01)


def test_a_loop_without_damping_keeps_its_energy(parts, urdf_folder):
    system, q = parts.closed_loop(urdf_folder)
    names = [name for name in system.parameters.names if name.endswith(".damping")]
    step = compile_step(system, 0.01)
    start = np.concatenate([q, np.zeros(step.sizes["n"] + step.sizes["nz"])])
    theta = system.parameters.vector(dict.fromkeys(names, 0.0))
    rollout = simulate(step, theta, start, 4000)
    assert rollout.status.is_converged, rollout.status.message
    e = step.equations
    rigid = e.rigid_body_terms
    kinetic, potential = ca.dot((e.q1 - e.q0) / e.h, rigid.lagrangian_by_v) / 2, rigid.potential_energy
    function = ca.Function("energy", [e.q0, e.q1, e.theta, e.time_step], [kinetic, kinetic + potential])
    states = rollout.state[:, : system.n_coordinates]
    kinetic, energy = (np.array(x).ravel() for x in function(states[:-1].T, states[1:].T, theta, 0.01))
    # it falls along its slide as it swings
    assert np.ptp(kinetic) > 1e3
    assert np.ptp(energy) < 1e-6 * np.ptp(kinetic)
