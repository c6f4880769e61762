"""Equilibria: which one is found, its derivatives, and what is said where there is none."""

import casadi as ca
import numpy as np
import pytest

from yid_ocp.integrator.discrete import RIGID_HOLD_STIFFNESS, equilibrium_equations
from yid_ocp.integrator.statics import EquilibriumSolver, steady_effect_internal_coordinates
from yid_ocp.integrator.step import compile_step, simulate
from yid_ocp.model import FlexibleSegment, Grasp, System, flexible_object
from yid_ocp.model.mechanism import rotation_from_rpy
from yid_ocp.model.servos_and_springs import MOTOR_OFF_COMMAND, ServoModelOptions, StiffnessAndRest
from yid_ocp.model.system import six_joint_floating_mechanism
from yid_ocp.model.urdf import read_urdf


def hung_cable(span: float):
    """A cable of 0.6 m that starts level along x, its end held at a fraction of its length; statics and clamp pose."""
    turn = rotation_from_rpy(0.0, np.pi / 2, 0.0)
    segment = FlexibleSegment("C", 0.6, 0.3, 0.01, links=4, bend=0.05, twist=1.0, damping=0.01, rest_rotation=turn)
    clamp = six_joint_floating_mechanism("clamp")
    objects, grasps = [(flexible_object([segment], name="cable"), None, None)], [Grasp("end", "clamp", "w_C")]
    system = System.build(clamp, objects=objects, grasps=grasps, prescribed=clamp.joint_names)
    return EquilibriumSolver(compile_step(system, 0.01, use_compiler=False)), np.array([0.6 * span, 0, 0, 0, 0, 0])


def test_of_several_equilibria_the_one_of_least_energy(parts):
    """The cable could also stand as an arch, and the search comes across that with the smaller imbalance."""
    statics, posture = hung_cable(0.95)
    system, theta = statics.step.system, statics.step.system.parameters.vector()
    rest = statics.solve(posture, theta)
    assert rest.is_converged, rest.message
    assert parts.tip(system.mechanism, "C_1_tip", rest.state[: system.n_coordinates])[2, 3] < -0.05


def test_a_cable_held_far_from_its_undeformed_shape_hangs_at_rest(parts):
    statics, _ = hung_cable(0.95)
    system, theta = statics.step.system, statics.step.system.parameters.vector()
    # on the other side of where it begins, where Newton's iteration from the undeformed shape leads nowhere
    rest = statics.solve([-0.3, 0.2, 0.2, 0.0, 0.0, 0.0], theta)
    assert rest.is_converged, rest.message
    np.testing.assert_allclose(simulate(statics.step, theta, rest.state, 50).state[-1], rest.state, atol=1e-8)
    assert parts.tip(system.mechanism, "w_C", rest.state[: system.n_coordinates])[2, 3] == pytest.approx(0.2)


@pytest.fixture(scope="module")
def arm(robot):
    """The double pendulum, its elbow driven, with a spring on each joint."""
    springs = {name: StiffnessAndRest(4.0, 0.1) for name in robot.joint_names}
    system = System.build(robot, driven=["elbow"], springs=springs)
    return EquilibriumSolver(compile_step(system, 0.01, use_compiler=False))


def derivatives(step, rest, given, held, stiffness, theta):
    """Of the state by theta and by the known coordinates, by CasADi from the equations of rest as a whole."""
    e, n = equilibrium_equations(step.equations), step.system.n_coordinates
    others = ca.vertcat(e.inputs[4], e.inputs[1])
    outputs = [ca.densify(ca.jacobian(f, x)) for f in (e.residual, e.state) for x in (e.inputs[0], others)]
    free = list(step.system.unprescribed_coordinate_indices)
    w = np.concatenate([rest.state[free], rest.state[2 * n :], rest.constraint_reactions])
    at = (w, given, held, stiffness, theta, step.time_step)
    by_w, by_others, state_by_w, state_by_others = (np.array(x) for x in ca.Function("by", e.inputs, outputs)(*at))
    return state_by_others - state_by_w @ np.linalg.lstsq(by_w, by_others, rcond=None)[0]


def test_compiled_and_interpreted_equilibria_are_one(case):
    """Of every feature of a step; those without a spring have nowhere to rest."""
    system, names = case.step.system, case.step.system.parameters.names
    fixed = list(system.prescribed_coordinate_indices)
    given = np.concatenate([case.start[list(system.actuated_coordinate_indices)], case.path[0]])
    torque = 0.3 * case.torque[0] if len(system.driven) else None
    guess = case.start[: system.n_coordinates].copy()
    guess[fixed] = case.path[0]
    steps = case.step, case.interpreted_step
    fast, slow = (EquilibriumSolver(step).solve(given, case.theta, torque, guess, names) for step in steps)
    assert fast.is_converged == slow.is_converged == bool(system.elastic_joints), fast.message
    for name in ("state", "holding_torque", "constraint_reactions"):
        np.testing.assert_allclose(getattr(fast, name), getattr(slow, name), rtol=1e-7, atol=1e-8, err_msg=name)
    if not fast.is_converged:
        return
    stiffness = RIGID_HOLD_STIFFNESS if torque is None else 1e3
    held = np.zeros(0) if torque is None else torque
    expected = derivatives(steps[1], fast, given, held, stiffness, case.theta)
    for rest in (fast, slow):
        found = np.hstack([rest.state_by_theta, rest.state_by_known_coordinates])
        np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-8)
        by_torque = rest.state_by_known_coordinates[:, : len(held)] / stiffness
        np.testing.assert_allclose(rest.state_by_torque, by_torque, rtol=1e-12)


def test_the_equations_of_rest_hold_a_joint_whose_motor_is_off(urdf_folder):
    robot, servos = read_urdf(urdf_folder / "double_pendulum.urdf"), ServoModelOptions("held", False)
    step = compile_step(System.build(robot, driven=robot.joint_names, servos=servos), 0.01, use_compiler=False)
    theta, names = step.system.parameters.vector(), step.system.parameters.names
    given, held = np.array([0.6, -0.3]), np.array([MOTOR_OFF_COMMAND, 0.2])
    rest, e = EquilibriumSolver(step).solve(given, theta, held, None, names), equilibrium_equations(step.equations)
    at = rest.state[:2], given, held, 1e-9, theta, step.time_step
    residual, state = (np.array(x).ravel() for x in ca.Function("rest", e.inputs, [e.residual, e.state])(*at))
    np.testing.assert_allclose(residual, 0.0, atol=1e-8)
    np.testing.assert_allclose(state, rest.state, atol=1e-12)
    found = np.hstack([rest.state_by_theta, rest.state_by_known_coordinates])
    np.testing.assert_allclose(found, derivatives(step, rest, given, held, at[3], theta), rtol=1e-7, atol=1e-8)


def test_a_measured_torque_that_fits_takes_the_load_off_the_holding_spring(arm):
    theta = arm.step.system.parameters.vector()
    elbow = arm.step.system.mechanism.joint_index("elbow")
    rest = arm.solve([0.4], theta)
    given = rest.holding_torque[0] / RIGID_HOLD_STIFFNESS
    assert abs(given) > 1e-6
    assert rest.state[elbow] == pytest.approx(0.4 - given, abs=1e-12)
    again = arm.solve([0.4], theta, torque=rest.holding_torque)
    assert again.is_converged, again.message
    assert abs(again.state[elbow] - 0.4) < 0.05 * abs(given)


def test_a_torque_that_does_not_fit_the_posture_is_said(arm):
    rest = arm.solve([0.4], arm.step.system.parameters.vector(), torque=[100.0])
    assert not rest.is_converged
    assert "would move elbow" in rest.message


def test_a_grasp_out_of_reach_is_said():
    statics, posture = hung_cable(1.5)
    rest = statics.solve(posture, statics.step.system.parameters.vector())
    assert not rest.is_converged
    assert "grasp 'end' is out of reach by" in rest.message


def test_internal_coordinates_of_an_object_that_has_long_been_there(parts):
    system = parts.cable(effects=[parts.maxwell_branch("C_0_x", 3.0, 0.02)])
    step = compile_step(system, 1e-3, use_compiler=False)
    q = np.linspace(0.1, 0.5, 9)
    np.testing.assert_allclose(
        steady_effect_internal_coordinates(step, q, system.parameters.vector()), [q[0]], rtol=1e-12
    )
    plain = compile_step(parts.cable(), 1e-3, use_compiler=False)
    assert steady_effect_internal_coordinates(plain, q, plain.system.parameters.vector()).shape == (0,)
