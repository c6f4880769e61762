"""The tracking filter: optimal gains, and a reference that a true motion follows by itself."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
import scipy.linalg

from yid_ocp.errors import ModelError
from yid_ocp.integrator.step import compile_step, simulate
from yid_ocp.integrator.tracking_feedback import lqr_feedback, proportional_feedback
from yid_ocp.model import Segment, System, flexible_object, forward_kinematics
from yid_ocp.model.kinematics import mass_matrix, rigid_body_lagrangian_derivatives
from yid_ocp.model.urdf import read_urdf

ANGLE, RATE, TORQUE = 0.02, 0.3, 1.0
STEPS, TIME_STEP = 300, 5e-3


@pytest.fixture(scope="module")
def robot(urdf_folder):
    return read_urdf(urdf_folder / "double_pendulum.urdf")


@pytest.fixture(scope="module")
def step(robot):
    """The driven pendulum with a rod hung on its tip."""
    rod = flexible_object([Segment("R", 0.2, 0.02, 0.01, links=1)])
    system = System.build(robot, objects=[(rod, "tip", None)], driven=robot.joint_names, damping=0.1)
    return compile_step(system, TIME_STEP, use_compiler=False)


@pytest.fixture(scope="module")
def motion(robot):
    """The bare arm's own motion under a known torque."""
    arm = compile_step(System.build(robot, driven=robot.joint_names, damping=0.1), TIME_STEP, use_compiler=False)
    time = np.arange(STEPS) * TIME_STEP
    torque = np.stack([3.0 * np.sin(2 * time), np.cos(3 * time)], axis=1)
    swung = simulate(arm, arm.system.parameters.vector(), np.array([0.3, -0.2, 0.0, 0.0]), STEPS, torque)
    assert swung.status.is_converged
    return arm, torque, swung


def test_gains_far_from_the_end_solve_the_riccati_equation(step, robot):
    """About a posture that is held still, the weights being those that the filter promises, in angles and rates."""
    posture = np.array([0.3, -0.2])
    q, v = ca.SX.sym("q", 2), ca.SX.sym("v", 2)
    tree = robot.with_numeric_values()
    rigid = rigid_body_lagrangian_derivatives(forward_kinematics(tree, q), v, ca.SX(ca.DM([0, 0, -9.81])))
    function = ca.Function("arm", [q, v], [mass_matrix(rigid, tree), rigid.lagrangian_by_q])
    inertia, by_q = (np.array(ca.densify(x)) for x in function(posture, [0, 0]))
    torque = np.tile(-by_q.ravel(), (STEPS, 1))
    theta = step.system.parameters.vector()
    loop = lqr_feedback(step, np.tile(posture, (STEPS + 1, 1)), torque, theta)
    n = step.system.n_coordinates
    np.testing.assert_array_equal(loop.state_indices, [0, 1, n, n + 1])

    arm = compile_step(System.build(robot, driven=robot.joint_names, damping=0.1), TIME_STEP, use_compiler=False)
    a, b, _ = arm.jacobians(posture, np.zeros(2), torque[0], arm.system.parameters.vector(), names=())
    backward = np.linalg.inv(inertia)
    weight = scipy.linalg.block_diag(np.eye(2) / ANGLE**2, backward.T @ backward / RATE**2)
    held = np.eye(2) / TORQUE**2
    cost = scipy.linalg.solve_discrete_are(a, b, weight, held)
    expected = np.linalg.solve(held + b.T @ cost @ b, b.T @ cost @ a)
    np.testing.assert_allclose(loop.gain[0], expected, rtol=2e-2, atol=2e-2 * np.max(np.abs(expected[:, 2:])))
    # momenta are fed back, and by the end no angle is worth a torque
    assert np.min(np.abs(np.diag(expected[:, 2:]))) > 1.0
    assert np.max(np.abs(loop.gain[-1, :, :2])) < 0.01 * np.max(np.abs(expected[:, :2]))


def test_the_reference_is_a_motion_of_the_arm_alone(step, motion):
    """It holds the angles and, by the arm's own equations, the momenta; the first one from a standing start."""
    _, torque, swung = motion
    loop = lqr_feedback(step, swung.state[:, :2], torque, step.system.parameters.vector())
    np.testing.assert_allclose(loop.reference[1:], swung.state[1:-1], rtol=0, atol=1e-9)


def test_a_proportional_filter(step):
    measured = np.arange(8.0).reshape(4, 2)
    loop = proportional_feedback(step, measured, [5.0, 7.0])
    np.testing.assert_array_equal(loop.gain, [np.diag([5.0, 7.0])] * 3)
    np.testing.assert_array_equal(loop.reference, measured[:-1])
    np.testing.assert_array_equal(loop.state_indices, [0, 1])
    np.testing.assert_array_equal(proportional_feedback(step, measured, 5.0).gain, [np.diag([5.0, 5.0])] * 3)
    with pytest.raises(ModelError, match=r"negative: -1 N m/rad"):
        proportional_feedback(step, measured, [5.0, -1.0])
    with pytest.raises(ModelError, match="3 gains for 2 driven joints"):
        proportional_feedback(step, measured, [1.0, 2.0, 3.0])


def test_driven_joints_must_come_first(parts):
    step = compile_step(parts.cable(driven=["C_2_x"]), 0.01, use_compiler=False)
    with pytest.raises(ModelError, match="come first"):
        lqr_feedback(step, np.zeros((4, 1)), np.zeros((3, 1)), step.system.parameters.vector())
