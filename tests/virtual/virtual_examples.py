"""Systems and values that the tests of this folder share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import casadi as ca
import numpy as np
import pytest

from yid_ocp.model.flexible import Segment, flexible_object
from yid_ocp.model.kinematics import forward_kinematics, mass_matrix, rigid_body_lagrangian_derivatives
from yid_ocp.model.mechanism import Inertia
from yid_ocp.model.system import MidpointState, System, floating_clamp
from yid_ocp.virtual.experiment import baxter_foam_y_system
from yid_ocp.virtual.mjcf import compile_mjcf, mujoco_xml
from yid_ocp.virtual.mujoco_simulation import SimulationResult

mujoco = pytest.importorskip("mujoco", reason="virtual experiments need MuJoCo: pip install 'yid-ocp[blind]'")

TRUTH = {"T1.bend": 22.0, "T1.twist": 13.6, "T2.bend": 10.7, "T2.twist": 8.2, "T3.bend": 11.5, "T3.twist": 9.7}
SYSTEMS = {arms: baxter_foam_y_system(arms) for arms in (1, 2)}
Runs = Callable[..., SimulationResult]


@cache
def single_arm_xml() -> str:
    """The paper's system with one arm in MuJoCo's words."""
    return mujoco_xml(SYSTEMS[1], TRUTH)


def grasp_gaps(system: System) -> ca.Function:
    """From a configuration to what the grasps leave open."""
    q = ca.SX.sym("q", system.n_coordinates)
    return ca.Function("phi", [q], [system.constraint_residual(forward_kinematics(system.numeric_mechanism(), q))])


def clamped_beam() -> System:
    beam = flexible_object([Segment("B", 0.5, 0.2, 0.01, links=3)], name="beam")
    clamp = floating_clamp("clamp")
    body = Inertia.from_values(0.3, [0.01, 0.02, 0.03], np.diag([1e-3, 2e-3, 2.5e-3]))
    clamp = replace(clamp, joints=(*clamp.joints[:-1], replace(clamp.joints[-1], bodies=(body,))))
    return System.build(clamp, objects=[(beam, "clamp", None)], driven=["clamp_x"], damping=0.1)


def assert_same_mechanics(system: System, values: dict[str, float]) -> None:
    """Mass matrix, bias and passive forces, and places of points are in MuJoCo what they are in symbols."""
    q, v = ca.SX.sym("q", system.n_coordinates), ca.SX.sym("v", system.n_coordinates)
    kinematics, none = forward_kinematics(system.mechanism, q), ca.SX(0, 1)
    rigid = rigid_body_lagrangian_derivatives(kinematics, v, system.gravity)
    mass = mass_matrix(rigid, system.mechanism)
    bias = ca.jtimes(rigid.lagrangian_by_v, q, v) - rigid.lagrangian_by_q
    passive = system.viscous_force(v) - ca.gradient(system.elastic_energy(q), q)
    for joint, compliance in system.joint_compliances.items():
        at = system.mechanism.joint_index(joint)
        passive[at] -= (q[at] + system.joint_relaxation_times[joint] * v[at]) / compliance
    for effect in system.effects:
        terms = effect.step_terms(MidpointState(system, kinematics, q, v, none, none, none, none, {}, ca.SX(1)))
        mass, passive = mass + ca.hessian(terms.lagrangian, v)[0], passive + ca.gradient(terms.lagrangian, q)
        passive += 0 if terms.dissipative_force is None else terms.dissipative_force
    points = ca.horzcat(ca.SX(3, 0), *(kinematics.frame_position(name) for name in system.point_frames))
    ours = ca.Function("ours", [q, v, system.parameters.symbols], [mass, bias, passive, points])
    model = compile_mjcf(mujoco_xml(system, values))
    data = mujoco.MjData(model)
    order = [model.joint(name).id for name in system.mechanism.joint_names]
    assert model.nv == system.n_coordinates
    rng = np.random.default_rng(0)
    for _ in range(2):
        posture, velocity = rng.uniform(-1, 1, (2, system.n_coordinates))
        data.qpos[order], data.qvel[order] = posture, velocity
        mujoco.mj_forward(model, data)
        full = np.zeros((model.nv, model.nv))
        for column in range(model.nv):
            mujoco.mj_mulM(model, data, full[column], np.eye(model.nv)[column])
        expected = [np.array(ca.densify(e)) for e in ours(posture, velocity, system.parameters.vector(values))]
        np.testing.assert_allclose(full[np.ix_(order, order)], expected[0], rtol=0, atol=1e-9)
        np.testing.assert_allclose(data.qfrc_bias[order], expected[1].ravel(), rtol=0, atol=1e-9)
        np.testing.assert_allclose(data.qfrc_passive[order], expected[2].ravel(), rtol=1e-9, atol=1e-9)
        seen = np.array([data.site(name).xpos for name in system.point_frames]).reshape(-1, 3)
        np.testing.assert_allclose(seen, expected[3].T, rtol=0, atol=1e-9)
