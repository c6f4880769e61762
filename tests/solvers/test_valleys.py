"""A loosely known parameter may have other valleys than the one that a search ends in."""

from __future__ import annotations

import numpy as np
import pytest
from made_problems import MadeUp

from yid_ocp.solvers import GaussNewton, base, solve

TIMES = np.arange(0.0, 2.0, 1 / 3)
NOISE = 0.35
TRUE, ALIAS = 1.8**2, 1.2**2
"""Frequencies of 1.8 and 1.2 Hz, seen three times a second, are told apart only by what decays beside them."""


def ringing(x, horizon):
    """A branch of stiffness k rings at sqrt(k); its swing dies down faster the stiffer it is."""
    k, kept = x[0], horizon + 1e-9 >= TIMES
    t = TIMES[kept]

    def swing(value):
        return np.exp(-0.15 * value * t) * np.cos(2 * np.pi * np.sqrt(value) * t)

    step = 1e-6 * k
    slope = (swing(k + step) - swing(k - step)) / (2 * step)
    return (swing(k) - swing(TRUE)) / NOISE, slope[:, None] / NOISE


def disturbed(start):
    problem = MadeUp(ringing, [start], duration=2.0)
    problem.has_process_noise = True
    return problem


def test_a_search_that_ends_in_the_wrong_valley_goes_on_from_the_other(monkeypatch):
    problem = disturbed(1.3)
    monkeypatch.setattr(base, "problem_whitened_at", lambda problem, x, warm=None, rounds=1: problem)
    # no other reason to start again
    monkeypatch.setattr(base, "_good_fit", lambda *_: True)
    monkeypatch.setattr(base, "_doubtful", lambda *_: np.zeros(1, bool))
    monkeypatch.setattr(base, "_NEARBY_START_FACTORS", ())
    alone = solve(problem, GaussNewton(max_iterations=40), restarts=False)
    assert alone.x[0] == pytest.approx(ALIAS, rel=0.15), "by itself it stays with the alias"
    found = solve(problem, GaussNewton(max_iterations=40))
    assert found.x[0] == pytest.approx(TRUE, rel=1e-3)
    assert any(step.note.endswith(": another valley") for step in found.history)
