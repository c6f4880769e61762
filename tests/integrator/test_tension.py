"""A grasped object under tension: what the pull's own stiffness does to a step, and to its multipliers."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from yid_ocp.data import read_recording
from yid_ocp.integrator.rollout import simulate
from yid_ocp.integrator.statics import EquilibriumSolver
from yid_ocp.integrator.step import compile_step
from yid_ocp.integrator.tracking_feedback import lqr_feedback

TRUTH = {"T1.bend": 22.0, "T1.twist": 13.6, "T2.bend": 10.7, "T2.twist": 8.2, "T3.bend": 11.5, "T3.twist": 9.7}


@pytest.fixture(scope="module")
def two_arms(paper_systems, clean):
    """two_arms(time_step, constraint_force): five seconds of another engine's motion, rolled out at its parameters."""
    system = paper_systems["dual"]
    joints = read_recording(clean / "dual_arm_no_vision_estimate.h5").joints
    theta = system.parameters.vector(TRUTH)

    def roll(every, constraint_force):
        h = 0.01 * every
        step = compile_step(system, h, "symmetric", constraint_force)
        arm = joints.position[::every]
        steps = len(arm) - 1
        torque = joints.effort[: steps * every].reshape(steps, every, -1).mean(axis=1)
        rest = EquilibriumSolver(step).solve(arm[0], theta, torque[0])
        assert rest.is_converged, rest.message
        feedback = lqr_feedback(step, arm, torque, theta)
        return simulate(step, theta, rest.state, steps, torque, feedback=feedback), h

    return roll


def alternation(rollout, h):
    """Largest second difference of the constraint forces, as a part of the largest force."""
    force = rollout.multipliers / h
    return np.max(np.abs(np.diff(force, 2, axis=0))) / np.max(np.abs(force))


def test_two_arms_hold_their_object_under_tension_without_growth(two_arms):
    at_node, h = two_arms(2, "node")
    assert not at_node.status.is_converged or alternation(at_node, h) > 0.5
    coarse, h = two_arms(2, "midpoint")
    assert coarse.status.is_converged, coarse.status.message
    fine, half = two_arms(1, "midpoint")
    assert fine.status.is_converged, fine.status.message
    # 500 steps, driven by torque that jumps from sample to sample
    assert alternation(coarse, h) < 0.05
    assert alternation(fine, half) < 0.05
    np.testing.assert_allclose(fine.state[::2, :50], coarse.state[: len(fine.state[::2]), :50], atol=5e-3)


def test_a_loop_without_damping_keeps_its_energy(parts, urdf_folder):
    system, q = parts.closed_loop(urdf_folder)
    names = [name for name in system.parameters.names if name.endswith(".damping")]
    step = compile_step(system, 0.01)
    start = np.concatenate([q, np.zeros(step.sizes["n"] + step.sizes["nz"])])
    theta = system.parameters.vector(dict.fromkeys(names, 0.0))
    rollout = simulate(step, theta, start, 4000)
    assert rollout.status.is_converged, rollout.status.message
    e = step.equations
    parts_of_energy = [
        e.rigid_body_terms.kinetic_energy,
        e.rigid_body_terms.kinetic_energy + e.rigid_body_terms.potential_energy,
    ]
    function = ca.Function("energy", [e.q0, e.q1, e.theta, e.time_step], parts_of_energy)
    states = rollout.state[:, : system.n_coordinates]
    kinetic, energy = (np.array(x).ravel() for x in function(states[:-1].T, states[1:].T, theta, 0.01))
    # it falls along its slide as it swings
    assert np.ptp(kinetic) > 1e3
    assert np.ptp(energy) < 1e-6 * np.ptp(kinetic)
