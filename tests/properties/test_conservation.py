"""What a variational step keeps when no force acts: momentum maps, time reversal, the symplectic form, energy."""

from __future__ import annotations

from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from yid_ocp.integrator.step import compile_step
from yid_ocp.model import Segment, System, flexible_object
from yid_ocp.model.kinematics import mass_matrix
from yid_ocp.model.urdf import read_urdf

SEEDS = st.integers(0, 2**32 - 1)


def free(system):
    """The same system without damping."""
    names = [name for name in system.parameters.names if name.endswith(".damping")]
    return system.parameters.vector(dict.fromkeys(names, 0.0))


def case(system, time_step):
    step = compile_step(system, time_step)
    return SimpleNamespace(system=system, step=step, theta=free(system), n=system.n_coordinates)


def random_state(case, momentum, seed, spread=1.0):
    rng = np.random.default_rng(seed)
    q, v = spread * rng.uniform(-1, 1, case.n), spread * rng.normal(size=case.n)
    return q, momentum(case.step, q, v, case.theta)


@pytest.fixture(scope="module")
def cases(urdf_folder):
    def read(name, **options):
        return System.build(read_urdf(urdf_folder / f"{name}.urdf"), **options)

    cable = flexible_object([Segment("C", 0.6, 0.3, 0.02, links=3, bend=2.0, twist=1.0)])
    return {
        "mixed_joints": case(read("mixed_joints"), 2e-3),
        "turntable": case(read("turntable"), 5e-3),
        "double_pendulum": case(read("double_pendulum"), 2e-3),
        "cable": case(System.build(objects=[(cable, None, None)]), 1e-3),
    }


@given(seed=SEEDS)
def test_angular_momentum_about_a_free_axis(cases, roll, momentum, seed):
    table = cases["turntable"]
    q, p = random_state(table, momentum, seed)
    rollout = roll(table.step, table.theta, q, p, 300)
    assert rollout.status.is_converged, rollout.status.message
    kept = rollout.state[:, table.n]
    assert np.max(np.abs(kept - kept[0])) < 1e-9 * max(1.0, abs(kept[0]))
    assert np.ptp(rollout.state[:, table.n + 1]) > 1e-3


@pytest.mark.parametrize("name", ["mixed_joints", "turntable", "cable"])
@given(seed=SEEDS)
def test_reversible(cases, momentum, name, seed):
    """With F = 0 the step is its own inverse after the momenta are turned round."""
    one = cases[name]
    q0, p0 = random_state(one, momentum, seed, spread=0.3)
    u = np.zeros(0)
    q1, p1, _, there = one.step(q0, p0, u, one.theta)
    q2, p2, _, back = one.step(q1, -p1, u, one.theta)
    assert there.is_converged, there.message
    assert back.is_converged, back.message
    assert np.max(np.abs(q1 - q0)) > 1e-6
    np.testing.assert_allclose(q2, q0, rtol=0, atol=1e-10)
    np.testing.assert_allclose(-p2, p0, rtol=0, atol=1e-9 * max(1.0, np.max(np.abs(p0))))


@pytest.mark.parametrize("name", ["mixed_joints", "double_pendulum", "cable"])
@given(seed=SEEDS)
def test_symplectic(cases, momentum, name, seed):
    one = cases[name]
    q, p = random_state(one, momentum, seed, spread=0.3)
    A, _, _ = one.step.jacobians(q, p, np.zeros(0), one.theta, names=())
    unit, none = np.eye(one.n), np.zeros((one.n, one.n))
    form = np.block([[none, unit], [-unit, none]])
    size = np.abs(A).T @ np.abs(form) @ np.abs(A)
    assert np.max(np.abs(A.T @ form @ A - form)) < 1e-9 * max(1.0, np.max(size))


def test_energy_shows_no_drift_over_a_hundred_thousand_steps(cases, roll, momentum):
    one = cases["double_pendulum"]
    q0 = np.array([0.9, -0.3])
    rollout = roll(one.step, one.theta, q0, momentum(one.step, q0, np.array([0.5, 1.0]), one.theta), 100_000)
    assert rollout.status.is_converged, rollout.status.message
    e, p = one.step.equations, ca.SX.sym("p", 2)
    M = mass_matrix(e.rigid_body_terms, one.system.mechanism)
    energy = ca.substitute([0.5 * ca.dot(p, ca.solve(M, p)) + e.rigid_body_terms.potential_energy], [e.q1], [e.q0])
    every = rollout.state[::10]
    function = ca.Function("energy", [e.q0, p, e.theta, e.time_step], energy)
    values = np.array(function(every[:, :2].T, every[:, 2:4].T, one.theta, one.step.time_step)).ravel()
    error = np.abs(values - values[0])
    tenth = len(error) // 10
    assert 0 < np.max(error) < 1e-4  # [J], of about two that swing to and fro
    assert np.max(error[-tenth:]) < 1.5 * np.max(error[:tenth])
    assert abs(np.mean(values[-tenth:]) - np.mean(values[:tenth])) < 0.1 * np.max(error)
