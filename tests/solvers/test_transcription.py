"""Adjoint = forward = finite differences of whole problems, and derivatives of the transcription."""

from __future__ import annotations

import numpy as np
import pytest

from yid_ocp.solvers.compiled_transcription import CompiledTranscription


@pytest.mark.parametrize("weighting", ["whitened", "paper"])
def test_gradients_of_the_cost_agree(make_problem, weighting):
    problem = make_problem(
        duration=1.0, weighting=weighting, huber_threshold=2.0 if weighting == "whitened" else np.inf
    )
    x = problem.start * np.array([5.0, 4.0, 3.0, 2.0, 3.0, 2.0])
    now = problem.evaluate(x)
    forward = now.jacobian.T @ now.residual
    cost, adjoint, _ = problem.gradient(x)
    assert cost == pytest.approx(now.cost, rel=1e-8)
    np.testing.assert_allclose(adjoint, forward, rtol=1e-5, atol=1e-7 * np.abs(forward).max())
    for i in (0, 2):
        step = np.zeros_like(x)
        step[i] = 1e-4 * x[i]
        ends = [problem.evaluate(x + sign * step, derivatives=False).cost for sign in (1, -1)]
        assert (ends[0] - ends[1]) / (2 * step[i]) == pytest.approx(adjoint[i], rel=1e-4)


@pytest.mark.parametrize(("interval", "initial_state"), [(1, "equilibrium"), (5, "equilibrium"), (1, "estimated")])
def test_transcription_jacobians_match_differences(make_problem, interval, initial_state):
    problem = make_problem(duration=0.15, initial_state=initial_state)
    transcription = CompiledTranscription(problem, interval)
    rng = np.random.default_rng(1)
    w = transcription.initial_guess(problem.start * 4)
    w = w + 1e-4 * rng.normal(size=len(w))
    direction = rng.normal(size=len(w)) * np.maximum(np.abs(w), 1e-3)
    size = 1e-6
    _, jacobian = transcription.constraints(w, True)
    ends = [transcription.constraints(w + sign * size * direction, False)[0] for sign in (1, -1)]
    numeric = (ends[0] - ends[1]) / (2 * size)
    np.testing.assert_allclose(jacobian @ direction, numeric, rtol=1e-4, atol=1e-5 * np.abs(numeric).max())
    _, slope, _ = transcription.residual(w, True)
    ends = [transcription.residual(w + sign * size * direction, False)[0] for sign in (1, -1)]
    numeric = (ends[0] - ends[1]) / (2 * size)
    np.testing.assert_allclose(slope @ direction, numeric, rtol=1e-4, atol=1e-5 * np.abs(numeric).max())


def test_exact_curvature_matches_differences(make_problem):
    problem = make_problem(free=("T1.bend", "T2.bend"), duration=0.05)
    transcription = CompiledTranscription(problem, 1)
    w = transcription.initial_guess(problem.start * 4)
    rng = np.random.default_rng(2)
    weights = rng.normal(size=len(transcription.constraints(w, False)[0]))
    start_rows = problem.step.sizes["nx"]
    weights[:start_rows] = 0.0
    hessian = transcription.constraint_hessian(w, weights)
    direction = rng.normal(size=len(w)) * np.maximum(np.abs(w), 1e-3)
    size = 1e-5
    ends = [transcription.constraints(w + sign * size * direction, True)[1].T @ weights for sign in (1, -1)]
    numeric = (ends[0] - ends[1]) / (2 * size)
    np.testing.assert_allclose(hessian @ direction, numeric, rtol=1e-3, atol=2e-4 * np.abs(numeric).max())
