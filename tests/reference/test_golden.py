"""One step from each state of trep's trajectories, its first derivatives, and the numbers of the model."""

import casadi as ca
import numpy as np
import pytest

from yid_ocp.model import forward_kinematics
from yid_ocp.model.mechanism import merge_inertias

NAMES = ("single", "dual")
TIPS = {"wT1": "w_T1", "wT2": "w_T2", "wT3": "w_T3", "left": "left_gripper", "right": "right_gripper"}


@pytest.fixture(scope="module", params=NAMES)
def case(request, golden, paper_systems, theta_golden, single_step, dual_step):
    step = {"single": single_step, "dual": dual_step}[request.param]
    return golden(request.param), paper_systems[request.param], step, theta_golden(request.param)


def test_every_step(case):
    trep, _, step, theta = case
    for k in range(len(trep.u)):
        q1, p1, lam, status = step(trep.q[k], trep.p[k], trep.u[k], theta)
        assert status.is_converged, status.message
        np.testing.assert_allclose(q1, trep.q[k + 1], rtol=0, atol=1e-9)
        np.testing.assert_allclose(p1, trep.p[k + 1], rtol=0, atol=1e-9)
        # trep was given pi as the URDF rounds it (to 5e-12), which shows in small multipliers: relative to the largest
        np.testing.assert_allclose(lam, trep.lam[k], rtol=0, atol=1e-8 * np.max(np.abs(trep.lam)))


@pytest.mark.parametrize("k", [0, 10, 299])
def test_first_derivatives(case, k):
    trep, _, step, theta = case
    A, B_u, B_theta = step.jacobians(trep.q[k], trep.p[k], trep.u[k], theta, names=())
    for actual, expected in ((A, getattr(trep, f"A_{k}")), (B_u, getattr(trep, f"Bu_{k}"))):
        np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-8 * np.max(np.abs(expected)))
    assert B_theta.shape == (2 * step.system.n_coordinates, 0)


def test_measured_points(case):
    trep, system, _, theta = case
    q = ca.SX.sym("q", system.n_coordinates)
    kinematics = forward_kinematics(system.mechanism, q)
    points = ca.horzcat(*(kinematics.frame_position(name) for name in ("w_T1", "w_T2", "w_T3")))
    function = ca.Function("points", [q, system.parameters.symbols], [points])
    for k in range(0, 300, 30):
        np.testing.assert_allclose(np.array(function(trep.q[k + 1], theta)).T, trep.w[k], rtol=0, atol=1e-10)


def number(mechanism_expression) -> np.ndarray:
    return np.array(ca.DM(mechanism_expression))


def test_model_numbers(case):
    trep, system, _, theta = case
    values = dict(zip(system.parameters.names, theta, strict=True))
    mechanism = system.mechanism.with_numeric_values({name: values[name] for name in system.mechanism.parameters.names})
    springs = {spring.joint_name: spring.stiffness for spring in system.elastic_joints}
    assert len(mechanism.joints) == len(trep.model["nodes"])
    for joint, node in zip(mechanism.joints, trep.model["nodes"], strict=True):
        assert joint.parent_index == node["parent"]
        np.testing.assert_allclose(number(joint.placement.homogeneous_matrix()), node["X"], rtol=0, atol=1e-10)
        np.testing.assert_array_equal(joint.axis, np.eye(3)["xyz".index(node["axis"])])
        body = merge_inertias(joint.bodies)
        if body is None:
            assert not node["mass"]
        else:
            assert float(body.mass) == pytest.approx(node["mass"], abs=1e-10)
            np.testing.assert_allclose(number(body.center_of_mass).ravel(), node["com"], rtol=0, atol=1e-10)
            np.testing.assert_allclose(number(body.inertia_about_com), node["I"], rtol=0, atol=1e-10)
        stiffness = springs.get(joint.name)
        if stiffness is None:
            assert node["stiffness"] is None
        else:
            assert ca.is_equal(stiffness, system.parameters[node["stiffness"].replace("_", ".")].symbol)


def test_model_tips_and_grasps(case):
    trep, system, _, _ = case
    mechanism = system.mechanism.with_numeric_values()
    for name, tip in trep.model["tips"].items():
        frame = mechanism.frame(TIPS[name])
        assert frame.joint_index == tip["node"]
        np.testing.assert_allclose(number(frame.placement.homogeneous_matrix()), tip["X"], rtol=0, atol=1e-10)
    grasps = [[grasp.holder_frame, grasp.held_frame] for grasp in system.grasps]
    assert grasps == [[TIPS[holder], TIPS[held]] for holder, held in trep.model["grasps"]]
