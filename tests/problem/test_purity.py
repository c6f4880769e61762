"""What a problem says depends on the question alone: not on what was asked before, and not on who asks beside."""

from concurrent.futures import ThreadPoolExecutor

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings
from small_problems import pendulum_step, swinging_pendulum, taken

from yid_ocp.integrator.step import compile_step
from yid_ocp.problem import EstimationProblem, ProblemOptions

H = 0.01
KINDS = ("equilibrium", "estimated", "fitted_to_points")


@pytest.fixture(scope="module")
def pendulum(urdf_folder):
    """Makes problems on three swings of a double pendulum with springs, whose start depends on what is asked."""
    step, record = swinging_pendulum(urdf_folder)
    taken = {seed: record(seed, 15, bend=0.3) for seed in (1, 2, 3)}

    def make(kind):
        options = ProblemOptions(initial_state=kind, initial_state_fit_window=0.02)
        free = ("elbow.damping", "shoulder.damping")
        return EstimationProblem(step, [taken[1], taken[2]], free, options, held_out=[taken[3]])

    return make


@pytest.fixture(scope="module")
def arm(urdf_folder):
    """Makes problems on a driven pendulum under its tracking filter, at rest where its spring and weight let it."""
    step = compile_step(pendulum_step(urdf_folder, driven=("shoulder",)).system, H)
    recordings = [taken(step, seed) for seed in (1, 2)]

    def make(kind):
        options = ProblemOptions(initial_state=kind, duration=0.15)
        return EstimationProblem(
            step, recordings[:1], ("elbow.stiffness", "elbow.damping"), options, held_out=recordings[1:]
        )

    return make


def said(problem, x):
    """Everything that a problem says of a point."""
    evaluation = problem.evaluate(x)
    cost, gradient, _ = problem.cost_and_gradient(x)
    held_out = [r if isinstance(r, str) else r.predicted_outputs for _, r in problem.predict_held_out(x)]
    return evaluation.cost, evaluation.residual, evaluation.jacobian, cost, gradient, held_out


def assert_same(one, other):
    for a, b in zip(one, other, strict=True):
        if isinstance(a, (list, tuple)):
            assert_same(a, b)
        else:
            np.testing.assert_array_equal(a, b)


def points(problem, seeds):
    lower, upper = problem.bounds
    found = []
    for seed in seeds:
        change = np.random.default_rng(seed).uniform(0.5, 2.0, len(problem.initial_unknowns))
        offset = np.where(problem.initial_unknowns == 0, 0.01 * (change - 1), 0.0)
        found.append(np.clip(problem.initial_unknowns * change + offset, lower, upper))
    return found


@pytest.mark.parametrize("kind", KINDS)
def test_an_answer_does_not_depend_on_earlier_questions(kind, pendulum):
    reference = {}
    for seed in range(4):
        fresh = pendulum(kind)
        reference[seed] = said(fresh, points(fresh, [seed])[0])
    asked = pendulum(kind)

    @settings(max_examples=10)
    @given(st.lists(st.integers(0, 3), min_size=2, max_size=4), st.lists(st.sampled_from("egv"), max_size=3))
    def check(order, between):
        for seed, x in zip(order, points(asked, order), strict=True):
            assert_same(said(asked, x), reference[seed])
            for question in between:
                ask = {"e": asked.evaluate, "g": asked.cost_and_gradient, "v": asked.predict_held_out}[question]
                ask(2.0 * x)

    check()


def test_an_answer_at_rest_does_not_depend_on_earlier_questions(arm):
    fresh, asked = arm("equilibrium"), arm("equilibrium")
    for x in points(asked, [2, 1]):
        said(asked, x)
    for x in points(asked, [1, 2]):
        assert_same(said(arm("equilibrium"), x), said(asked, x))
    # a warm start leads to the same equilibrium, to the tolerance of the statics
    x, near = points(fresh, [1, 2])
    warm = fresh.evaluate(near).equilibrium_guesses
    assert fresh.evaluate(x, equilibrium_guesses=warm).cost == pytest.approx(fresh.evaluate(x).cost, rel=1e-8)


@pytest.mark.parametrize(("made", "kind"), [*(("pendulum", kind) for kind in KINDS), ("arm", "equilibrium")])
def test_an_answer_does_not_depend_on_threads(request, made, kind):
    make = request.getfixturevalue(made)
    asked = make(kind)
    asking = points(asked, range(4 if made == "pendulum" else 3))
    reference = [said(make(kind), x) for x in asking]
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda x: said(asked, x), asking * 2))
    for one, other in zip(found, reference * 2, strict=True):
        assert_same(one, other)
