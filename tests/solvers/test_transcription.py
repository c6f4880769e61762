"""Adjoint = forward = finite differences of whole problems."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from yid_ocp.solvers.multiple_shooting import _ShootingIntervals


@pytest.mark.parametrize("weighting", ["whitened", "paper"])
def test_gradients_of_the_cost_agree(make_problem, weighting):
    problem = make_problem(
        duration=1.0, weighting=weighting, huber_threshold=2.0 if weighting == "whitened" else np.inf
    )
    x = problem.initial_unknowns * np.array([5.0, 4.0, 3.0, 2.0, 3.0, 2.0])
    now = problem.evaluate(x)
    forward = now.jacobian.T @ now.residual
    cost, adjoint, _ = problem.cost_and_gradient(x)
    assert cost == pytest.approx(now.cost, rel=1e-8)
    np.testing.assert_allclose(adjoint, forward, rtol=1e-5, atol=1e-7 * np.abs(forward).max())
    for i in (0, 2):
        step = np.zeros_like(x)
        step[i] = 1e-4 * x[i]
        ends = [problem.evaluate(x + sign * step, derivatives=False).cost for sign in (1, -1)]
        assert (ends[0] - ends[1]) / (2 * step[i]) == pytest.approx(adjoint[i], rel=1e-4)


@pytest.mark.parametrize(("interval", "initial_state"), [(1, "equilibrium"), (5, "equilibrium"), (4, "estimated")])
def test_condensed_derivatives_match_differences(make_problem, interval, initial_state):
    """Of the residual by the unknowns, node states moved along, and by closing the defects."""
    problem = make_problem(duration=0.15, initial_state=initial_state)
    intervals = _ShootingIntervals(problem, interval)
    rng = np.random.default_rng(1)
    x, nodes = intervals.initial_guess(4 * problem.initial_unknowns)
    nodes = [state + 1e-4 * rng.normal(size=state.shape) for state in nodes]
    now = intervals.linearize(x, nodes)
    assert now.defect > 1e-5
    open_defects = replace(now, node_slopes=tuple((by_x, 0.0 * by_defect) for by_x, by_defect in now.node_slopes))
    held = replace(now, node_slopes=tuple((0.0 * by_x, by_defect) for by_x, by_defect in now.node_slopes))
    direction = rng.normal(size=len(x)) * np.maximum(np.abs(x), 1e-3)

    def residual(part, step, size):
        return intervals.linearize(x + size * step, intervals.moved(nodes, part, step, size)).residual

    size = 1e-5
    along = (residual(open_defects, direction, size) - residual(open_defects, direction, -size)) / (2 * size)
    expected = now.jacobian @ direction
    np.testing.assert_allclose(expected, along, rtol=1e-4, atol=1e-4 * np.abs(along).max())
    size, none = 1e-3, np.zeros_like(x)
    closing = (residual(held, none, size) - residual(held, none, -size)) / (2 * size)
    np.testing.assert_allclose(now.by_defect, closing, rtol=1e-4, atol=1e-4 * np.abs(closing).max())
