"""A step as rows of a nonlinear program."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from yid_ocp.integrator.discrete import nlp_stage


@pytest.fixture(scope="module")
def made(case):
    return nlp_stage(case.step.equations, case.step.time_step)


def inputs_of(made):
    return [made.x0, made.x1, made.lam, made.u, made.theta]


def test_a_rollout_makes_all_rows_zero_and_needs_its_effort(case, made):
    rollout = case.rollout()
    function = ca.Function("stage", inputs_of(made), [made.residual, made.prescribed_effort])
    for k, u in enumerate(rollout.torque):
        x0, x1 = rollout.state[k : k + 2]
        rows, effort = function(x0, x1, rollout.multipliers[k], u, case.theta)
        assert float(ca.norm_inf(rows)) < 1e-7 * max(1.0, np.abs(rollout.state).max())
        np.testing.assert_allclose(
            np.array(effort).ravel(),
            rollout.effort[k],
            rtol=1e-7,
            atol=1e-7 * max(1.0, np.max(np.abs(rollout.effort), initial=0.0)),
        )


def test_slopes_in_closed_form_are_those_that_casadi_finds(case, made):
    rng = np.random.default_rng(3)
    n = case.step.sizes["n"]
    point = [rng.normal(scale=0.2, size=symbol.numel()) for symbol in inputs_of(made)]
    point[1] = point[0] + 0.01 * point[1]
    point[-1] = case.theta * (1 + 0.1 * rng.random(len(case.theta)))
    for value, slopes in ((made.residual, made.residual_jacobians), (made.prescribed_effort, made.effort_jacobians)):
        for name, found in slopes.items():
            symbol = getattr(made, name)
            function = ca.Function(
                "slopes", inputs_of(made), [ca.densify(found), ca.densify(ca.jacobian(value, symbol))]
            )
            actual, expected = (np.array(x) for x in function(*point))
            assert actual.shape == (value.numel(), symbol.numel())
            np.testing.assert_allclose(
                actual, expected, rtol=0, atol=1e-11 * max(1.0, np.max(np.abs(expected), initial=0.0))
            )
    assert not np.any(
        np.array(ca.DM(made.residual_jacobians["x1"].sparsity(), 1))[: len(made.residual_names) - n, n : 2 * n]
    )


def test_every_row_and_every_slope_has_its_name(case, made):
    system, s = case.step.system, case.step.sizes
    kinds = [name.partition("[")[0] for name in made.residual_names]
    counts = {"del": s["n"] - s["nc"], "internal": s["nz"], "constraint": s["m"], "p1": s["n"]}
    assert {kind: kinds.count(kind) for kind in counts} == counts
    assert kinds == [kind for kind, count in counts.items() for _ in range(count)]
    assert made.residual_names[0] == f"del[{system.mechanism.joint_names[system.unprescribed_coordinate_indices[0]]}]"
    assert made.residual.numel() == len(made.residual_names)
    by_rows, by_effort = made.parameter_jacobians(system.parameters.names[:2])
    assert by_rows.shape == (len(made.residual_names), 2)
    assert by_effort.shape == (s["nc"], 2)
