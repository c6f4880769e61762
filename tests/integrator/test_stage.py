"""A step's equations: as rows of a nonlinear program, and as slot derivatives of the discrete Lagrangian."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from yid_ocp.integrator.discrete import discrete_equations, one_step_nlp_constraints
from yid_ocp.model import System, forward_kinematics
from yid_ocp.model.kinematics import lagrangian_first_derivatives


@pytest.fixture(scope="module")
def made(case):
    return one_step_nlp_constraints(case.step.equations, case.step.time_step)


def inputs_of(made):
    return [made.x0, made.x1, made.lam, made.u, made.theta]


def test_a_rollout_makes_all_rows_zero_and_needs_its_effort(case, made):
    rollout = case.rollout()
    function = ca.Function("stage", inputs_of(made), [made.residual, made.prescribed_effort])
    for k, u in enumerate(rollout.torque):
        x0, x1 = rollout.state[k : k + 2]
        rows, effort = function(x0, x1, rollout.multipliers[k], u, case.theta)
        assert float(ca.norm_inf(rows)) < 1e-7 * max(1.0, np.abs(rollout.state).max())
        scale = max(1.0, np.max(np.abs(rollout.effort), initial=0.0))
        np.testing.assert_allclose(np.array(effort).ravel(), rollout.effort[k], rtol=1e-7, atol=1e-7 * scale)


def test_slopes_in_closed_form_are_those_that_casadi_finds(case, made):
    rng = np.random.default_rng(3)
    n = case.step.sizes["n"]
    point = [rng.normal(scale=0.2, size=symbol.numel()) for symbol in inputs_of(made)]
    point[1] = point[0] + 0.01 * point[1]
    point[-1] = case.theta * (1 + 0.1 * rng.random(len(case.theta)))
    for value, slopes in ((made.residual, made.residual_jacobians), (made.prescribed_effort, made.effort_jacobians)):
        for name, found in slopes.items():
            symbol = getattr(made, name)
            pair = [ca.densify(found), ca.densify(ca.jacobian(value, symbol))]
            function = ca.Function("slopes", inputs_of(made), pair)
            actual, expected = (np.array(x) for x in function(*point))
            assert actual.shape == (value.numel(), symbol.numel())
            scale = max(1.0, np.max(np.abs(expected), initial=0.0))
            np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-11 * scale)
    pattern = np.array(ca.DM(made.residual_jacobians["x1"].sparsity(), 1))
    assert not np.any(pattern[: len(made.residual_names) - n, n : 2 * n])


def test_every_row_and_every_slope_has_its_name(case, made):
    system, s = case.step.system, case.step.sizes
    kinds = [name.partition("[")[0] for name in made.residual_names]
    counts = {"del": s["n"] - s["nc"], "internal": s["nz"], "constraint": s["m"], "p1": s["n"]}
    assert {kind: kinds.count(kind) for kind in counts} == counts
    assert kinds == [kind for kind, count in counts.items() for _ in range(count)]
    assert made.residual_names[0] == f"del[{system.mechanism.joint_names[system.unprescribed_coordinate_indices[0]]}]"
    assert made.residual.numel() == len(made.residual_names)
    by_rows, by_effort = made.residual_and_effort_jacobians_by_parameters(system.parameters.names[:2])
    assert by_rows.shape == (len(made.residual_names), 2)
    assert by_effort.shape == (s["nc"], 2)


FORCE_LEFT = {"symmetric": 0.5, "left": 1.0}
PULL_MIDDLE = {"node": 0.0, "midpoint": 0.5}


def discrete_lagrangian(system: System, q0: ca.SX, q1: ca.SX, h: ca.SX) -> ca.SX:
    """L_d = h L((q0 + q1)/2, (q1 - q0)/h) without effects [J s] (Marsden and West 2001, section 1.3)."""
    q, v = (q0 + q1) / 2, (q1 - q0) / h
    rigid = lagrangian_first_derivatives(forward_kinematics(system.mechanism, q), v, system.gravity)
    kinetic_energy = ca.dot(v, rigid.lagrangian_by_v) / 2
    return h * (kinetic_energy - rigid.potential_energy - system.elastic_energy(q))


SYSTEMS = {
    "closed_loop": lambda parts, folder: parts.closed_loop(folder)[0],
    "welded_cable": lambda parts, folder: parts.clamped_cable("weld")[0],
    "aligned_cable": lambda parts, folder: parts.clamped_cable("axis")[0],
}


@pytest.mark.parametrize("constraint_force_at", list(PULL_MIDDLE))
@pytest.mark.parametrize("force_split", list(FORCE_LEFT))
@pytest.mark.parametrize("name", list(SYSTEMS))
def test_equations_are_slot_derivatives_of_the_discrete_lagrangian(
    parts, urdf_folder, name, force_split, constraint_force_at
):
    system = SYSTEMS[name](parts, urdf_folder)
    e = discrete_equations(system, force_split, constraint_force_at)
    action = discrete_lagrangian(system, e.q0, e.q1, e.h)
    force = system.input_force(e.u, (e.q0 + e.q1) / 2, (e.q1 - e.q0) / e.h) + system.viscous_force((e.q1 - e.q0) / e.h)
    push = FORCE_LEFT[force_split] * e.h * force

    def closed(q: ca.SX) -> ca.SX:
        return system.constraint_residual(forward_kinematics(system.mechanism, q))

    # lam times the constraint at node k, its share s moved to the mean of the ends less half of both
    s, middle = PULL_MIDDLE[constraint_force_at], (e.q0 + e.q1) / 2
    moved = s * ca.dot(e.lam, 2 * closed(middle) - closed(e.q0) - closed(e.q1))
    pull = ca.gradient(ca.dot(e.lam, closed(e.q0)) + moved, e.q0)
    matrix = ca.jacobian(closed(e.q1), e.q1)
    expected = {
        "momentum_balance": e.p0 + ca.gradient(action, e.q0) + push - pull,
        "p1": ca.gradient(action, e.q1) + e.h * force - push - ca.gradient(moved, e.q1),
        "constraint_residual": closed(e.q1),
    }
    pairs = [ca.densify(x) for key, value in expected.items() for x in (getattr(e, key), value)]
    pairs += [ca.densify(x) for x in (e.constraint_impulses.after_jacobian, matrix)]
    pairs += [ca.densify(x) for x in (e.constraint_impulses.after_force_by_q, ca.jacobian(matrix.T @ e.lam, e.q1))]
    function = ca.Function("pairs", e.arguments, pairs)
    rng = np.random.default_rng(4)
    theta = system.parameters.vector()
    for _ in range(3):
        q0 = rng.uniform(-1, 1, system.n_coordinates)
        point = [q0, q0 + 0.05 * rng.normal(size=system.n_coordinates)]
        point += [rng.normal(size=x.numel()) for x in (e.p0, e.z0, e.z1, e.lam, e.u)]
        values = [np.array(x) for x in function.call([*point, theta, 0.01])]
        for actual, wanted in zip(values[::2], values[1::2], strict=True):
            scale = max(1.0, np.max(np.abs(wanted), initial=0.0))
            np.testing.assert_allclose(actual, wanted, rtol=0, atol=1e-11 * scale)
