"""A grasped object under tension: what the pull's own stiffness does to a step, and to its multipliers."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from yid_ocp.integrator.step import compile_step, simulate
from yid_ocp.model import Grasp, System
from yid_ocp.model.mechanism import Inertia
from yid_ocp.model.system import floating_clamp

PULL, WEIGHT = 100.0, 9.81  # [N]


def test_tension_makes_no_motion_grow_where_constraints_pull_at_the_midpoint(parts):
    """A light cable, almost straight, drawn up by a clamp of 1 kg."""
    light = {"mass": 0.06, "radius": 0.01, "bend": 0.5, "twist": 0.5, "damping": 1e-3}
    clamp, bent = floating_clamp("clamp"), np.array([0.02, 0, 0, -0.03, 0, 0, 0.01, 0, 0])
    body = Inertia.from_values(1.0, np.zeros(3), 1e-3 * np.eye(3))
    clamp = replace(clamp, joints=tuple(replace(j, bodies=(body,) * (j.name == "clamp_z")) for j in clamp.joints))
    held = [name for name in clamp.joint_names if name != "clamp_z"]
    objects = [(parts.cable_object(**light), None, None)]
    grasps = [Grasp("clamp", "clamp", "w_C")]
    system = System.build(clamp, objects=objects, grasps=grasps, driven=["clamp_z"], prescribed=held, damping=0.1)
    start = np.concatenate([parts.tip(parts.cable().mechanism, "w_C", bent)[:3, 3], np.zeros(3), bent, np.zeros(15)])

    def roll(h, constraint_force):
        step, count = compile_step(system, h, "symmetric", constraint_force, use_compiler=False), round(2 / h)
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
