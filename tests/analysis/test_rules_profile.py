"""Profile likelihood, rule by rule, on formulas whose intervals are known."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from made_models import Formula, estimate, solution

from yid_ocp.analysis.profile import (
    CHI2_QUANTILE_95,
    check_small_estimate,
    is_small_problem,
    nearby_optimum,
    profile_likelihood,
    with_profile_intervals,
)
from yid_ocp.inference.linearized_residual import residual_without_weak_priors

OPEN = {"a": (-math.inf, math.inf), "b": (-math.inf, math.inf)}
HALF = math.sqrt(CHI2_QUANTILE_95)


def profiled(problem, name="a", std=None, at=None, **more):
    x = problem.initial_unknowns if at is None else np.array(at)
    if std is None:
        _, jacobian = residual_without_weak_priors(problem, problem.evaluate(x))
        std = float(np.sqrt(np.diag(np.linalg.pinv(jacobian.T @ jacobian))[problem.unknown_names.index(name)]))
    return profile_likelihood(problem, x, problem.unknown_names.index(name), std, **more)


def test_the_level_is_that_of_95_percent():
    assert pytest.approx(1.959963984540054**2, rel=1e-12) == CHI2_QUANTILE_95


# -- linear models ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("guess", [0.5, 0.05, 5.0, math.inf])
def test_a_linear_model_has_a_symmetric_interval_whatever_the_first_guess(guess):
    problem = Formula(lambda x: [2 * (x["a"] - 3.0)], {"a": 3.0}, bounds=OPEN)
    found = profiled(problem, std=guess)
    assert (found.name, found.value, found.notes) == ("a", 3.0, ())
    np.testing.assert_allclose([found.lower, found.upper], [3 - HALF / 2, 3 + HALF / 2], rtol=0.01)
    np.testing.assert_allclose(found.delta_chi2, 4 * (found.values - 3.0) ** 2, atol=1e-9)
    assert np.all(np.diff(found.values) > 0)


def test_another_level_is_another_interval():
    problem = Formula(lambda x: [2 * (x["a"] - 3.0)], {"a": 3.0}, bounds=OPEN)
    found = profiled(problem, level=1.0)
    np.testing.assert_allclose([found.lower, found.upper], [2.5, 3.5], rtol=0.01)


def test_others_are_refitted_at_every_value():
    rows = np.array([[1.0, 0.9], [0.3, 1.0], [0.5, 0.5]])
    problem = Formula(
        lambda x: [r[0] * (x["a"] - 1.0) + r[1] * (x["b"] + 2.0) for r in rows], {"a": 1.0, "b": -2.0}, bounds=OPEN
    )
    std = np.sqrt(np.linalg.inv(rows.T @ rows)[0, 0])
    alone = 1 / np.linalg.norm(rows[:, 0])
    assert std > 1.5 * alone
    found = profiled(problem)
    np.testing.assert_allclose([found.lower, found.upper], [1 - HALF * std, 1 + HALF * std], rtol=0.02)


def test_a_misfit_widens_the_interval():
    def rows(x):
        return [2 * (x["a"] - 3.0) + 4.0, 2 * (x["a"] - 3.0) - 4.0, 2 * (x["a"] - 3.0)]

    found = profiled(Formula(rows, {"a": 3.0}, bounds=OPEN))
    # chi2 of 32 over two degrees of freedom
    half = HALF * 4.0 / math.sqrt(12.0)
    np.testing.assert_allclose([found.lower, found.upper], [3 - half, 3 + half], rtol=0.01)


def test_weak_priors_do_not_count_and_stated_ones_do():
    def rows(x):
        return [x["a"] - 3.0, (x["a"] - 3.0) * math.sqrt(3.0), 50 * (x["a"] - 3.0)]

    stated = profiled(Formula(rows, {"a": 3.0}, bounds=OPEN, stated=1, weak=1))
    np.testing.assert_allclose([stated.lower, stated.upper], [3 - HALF / 2, 3 + HALF / 2], rtol=0.01)
    np.testing.assert_allclose(stated.delta_chi2, 4 * (stated.values - 3.0) ** 2, atol=1e-9)


def test_rows_in_metres_count_in_units_of_their_noise():
    problem = Formula(
        lambda x: [0.02 * (x["a"] - 3.0), math.sqrt(12.0) * (x["a"] - 3.0)],
        {"a": 3.0},
        bounds=OPEN,
        stated=1,
        noise=0.01,
    )
    found = profiled(problem)
    np.testing.assert_allclose([found.lower, found.upper], [3 - HALF / 4, 3 + HALF / 4], rtol=0.01)


# -- how far it steps -------------------------------------------------------------------------------------------------


def steps(problem, std, unit, name="a", **more):
    """Values asked below and above the best fit, each in units of the interval's half-width or what is given."""
    best = problem.evaluate(problem.initial_unknowns)
    problem.asked.clear()
    profiled(problem, name, std, evaluation=best, **more)
    index = problem.unknown_names.index(name)
    moved = [(x[index] - problem.initial_unknowns[index]) / unit for x in problem.asked]
    return [-d for d in moved if d < 0], [d for d in moved if d > 0]


@pytest.mark.parametrize(
    ("guess", "asked"),
    [
        (1.0, [1.0]),
        (0.995, [0.995]),
        (0.1, [0.1, 0.4, 1.18, 1.0]),
        (0.04, [0.04, 0.16, 0.64, 1.108, 1.0]),
        (0.9, [0.9, 1.08, 1.0]),
        (5.0, [5.0, 1.0]),
        (15.0, [15.0, 7.5, 7.5 - 6.5 * 7.5 / 7.0, 1.0]),
    ],
)
def test_a_line_is_followed_no_faster_than_it_is_known(guess, asked):
    """A parabola's root is a line: the next point is a third beyond its end, no more than three times what is gone.

    Of two sides, one that is kept counts half; heights of more than ten times the end's are halved.
    """
    problem = Formula(lambda x: [2 * (x["a"] - 3.0)], {"a": 3.0}, bounds=OPEN, scales={"a": 100.0})
    for side in steps(problem, 0.5 * guess, 0.5 * HALF):
        assert side == pytest.approx(asked, rel=1e-6)


def test_the_first_step_is_no_larger_than_the_unknown_itself():
    either = Formula(lambda x: [0 * x["a"] + 1.0], {"a": 3.0}, bounds=OPEN, scales={"a": 2.0})
    below, above = steps(either, math.inf, HALF)
    assert below[0] == above[0] == pytest.approx(20.0)
    positive = Formula(lambda x: [0 * x["a"] + 1.0], {"a": 3.0})
    below, above = steps(positive, math.inf, 3.0)
    assert 1 + above[0] == pytest.approx(math.exp(0.5 * HALF))
    assert 1 - below[0] == pytest.approx(math.exp(-0.5 * HALF))
    below, above = steps(Formula(lambda x: [10 * ca.log(x["a"])], {"a": 3.0}), 0.3, 3.0)
    assert 1 + above[0] == pytest.approx(math.exp(0.1 * HALF))


def test_the_others_go_along_the_tangent_at_once():
    rows = np.array([[1.0, 0.9], [0.3, 1.0], [0.5, 0.5]])
    problem = Formula(
        lambda x: [r[0] * (x["a"] - 1.0) + r[1] * (x["b"] + 2.0) for r in rows], {"a": 1.0, "b": -2.0}, bounds=OPEN
    )
    std = float(np.sqrt(np.linalg.inv(rows.T @ rows)[0, 0]))
    below, above = steps(problem, std, std * HALF)
    assert below == pytest.approx([1.0])
    assert above == pytest.approx([1.0])


def test_refits_leave_little_on_the_table():
    """The other unknown follows the first on a curve, so that its tangent alone is not enough."""
    problem = Formula(
        lambda x: [x["a"] - 3.0 + x["b"], 2 * (x["b"] - 0.3 * (x["a"] - 3.0) ** 2)], {"a": 3.0, "b": 0.0}, bounds=OPEN
    )
    found = profiled(problem)
    gone = found.values - 3.0
    exact = (gone + 0.3 * gone**2) ** 2 / (1 + 1 / 4)
    assert np.max(found.delta_chi2) > 3
    np.testing.assert_allclose(found.delta_chi2, exact, atol=2e-3)
    assert np.all(found.delta_chi2 >= exact - 1e-9)


def test_edges_take_few_refits():
    cliff = Formula(lambda x: [0.5 * (x["a"] - 3.0), 1e4 * ca.fmax(x["a"] - 3.7, 0.0)], {"a": 3.0}, bounds=OPEN)
    below, above = steps(cliff, 2.0, 1.0)
    assert len(below) == 1
    assert 10 <= len(above) <= 16
    fails = Formula(lambda x: [0.1 * (x["a"] - 3.0)], {"a": 3.0}, bounds=OPEN, fails=lambda v: v["a"] > 7.0)
    below, above = steps(fails, 10.0, 10 * HALF)
    assert below == pytest.approx([1.0])
    # half the way to where it failed, time and again
    assert above[:3] == pytest.approx([1.0, 1.0, 0.5], rel=1e-6)


def refits(problem, std):
    """What the other unknown is tried at, where the profiled one was first moved to above its best fit."""
    best = problem.evaluate(problem.initial_unknowns)
    problem.asked.clear()
    profiled(problem, std=std, evaluation=best)
    above = [x for x in problem.asked if x[0] > problem.initial_unknowns[0]]
    return above[0][0], [b for a, b in above if a == above[0][0]]


SEARCH = [1e-8, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 0.1, 1.0, 10.0]


@pytest.mark.parametrize(
    ("reach", "parts"),
    [
        (0.0, [1 / (1 + d) for d in SEARCH]),
        (0.6, [*(1 / (1 + d) for d in SEARCH[:8]), *(0.5 + 0.5 / (1 + d) for d in (0.2, 2.0, 20.0))]),
    ],
    ids=["never", "once the step is half"],
)
def test_a_refit_that_fails_takes_ever_shorter_steps_and_gives_up_after_nine(reach, parts):
    """The other unknown would follow on a parabola; where it goes too far the model cannot be rolled out."""
    whole = 0.3 * (100 * HALF) ** 2
    problem = Formula(
        lambda x: [0.01 * (x["a"] - 3.0), x["b"] - 0.3 * (x["a"] - 3.0) ** 2],
        {"a": 3.0, "b": 0.0},
        bounds=OPEN,
        scales={"a": 100.0, "b": 1.0},
        fails=lambda v: v["b"] > reach * whole + 1e-9,
    )
    at, tried = refits(problem, 100.0)
    assert at == pytest.approx(3.0 + 100 * HALF)
    assert tried[0] == 0.0
    found = np.array(tried[1 : len(parts) + 1]) / whole
    np.testing.assert_allclose(found, parts, rtol=1e-6)
    if not reach:
        assert len(tried) == 1 + len(parts)


@pytest.mark.parametrize(("left", "refitted"), [(0.7e-3, False), (1.5e-3, True)])
def test_a_refit_is_worth_a_thousandth_of_chi2(left, refitted):
    problem = Formula(
        lambda x: [x["a"] - 3.0, x["b"] - math.sqrt(left) * ((x["a"] - 3.0) / HALF) ** 2],
        {"a": 3.0, "b": 0.0},
        bounds=OPEN,
        scales={"a": 1.0, "b": 1.0},
    )
    _, tried = refits(problem, 1.0)
    assert (len(tried) > 1) is refitted


# -- positive unknowns ------------------------------------------------------------------------------------------------


def test_a_positive_unknown_has_the_interval_of_its_values_not_of_its_logarithm():
    problem = Formula(lambda x: [1 * (x["a"] - 3.0)], {"a": 3.0})
    found = profiled(problem)
    np.testing.assert_allclose([found.lower, found.upper], [3 - HALF, 3 + HALF], rtol=0.02)


def test_a_relative_uncertainty_is_lopsided():
    problem = Formula(lambda x: [5 * ca.log(x["a"] / 3.0)], {"a": 3.0})
    found = profiled(problem)
    np.testing.assert_allclose([found.lower, found.upper], [3 * math.exp(-HALF / 5), 3 * math.exp(HALF / 5)], rtol=0.01)


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_units_make_no_difference(scale):
    problem = Formula(lambda x: [(x["a"] / scale - 3.0)], {"a": 3.0 * scale})
    found = profiled(problem)
    np.testing.assert_allclose([found.lower / scale, found.upper / scale], [3 - HALF, 3 + HALF], rtol=0.02)


# -- open ends --------------------------------------------------------------------------------------------------------


def test_what_nothing_informs_is_open_on_both_sides():
    for bounds, std in (({}, math.inf), (OPEN, math.inf), ({}, 0.1)):
        found = profiled(Formula(lambda x: [0 * x["a"] + 1.0], {"a": 3.0}, bounds=bounds), std=std)
        assert (found.lower, found.upper, found.notes) == (None, None, ())
    assert found.values[0] == pytest.approx(3e-3)
    assert found.values[-1] == pytest.approx(3e3)


def test_an_unknown_of_either_sign_is_followed_a_thousand_times_its_size():
    found = profiled(Formula(lambda x: [0 * x["a"] + 1.0], {"a": 3.0}, bounds=OPEN, scales={"a": 2.0}), std=math.inf)
    assert (found.values[0], found.values[-1]) == (3.0 - 2000.0, 3.0 + 2000.0)


def test_an_end_may_be_open_on_one_side():
    # twice what is lost with rising stiffness: 2 (1/a - 1/3)
    problem = Formula(lambda x: [2 * (1 / x["a"] - 1 / 3.0)], {"a": 3.0})
    found = profiled(problem)
    assert found.upper is None
    assert 1 / found.lower == pytest.approx(1 / 3 + HALF / 2, rel=0.02)
    assert found.notes == ()


def test_bounds_are_open_ends_unless_the_level_comes_first():
    made = {"bounds": {"a": (2.5, 6.0)}}
    found = profiled(Formula(lambda x: [1 * (x["a"] - 3.0)], {"a": 3.0}, **made))
    assert found.lower is None
    assert found.upper == pytest.approx(3 + HALF, rel=0.02)
    assert found.values[0] == pytest.approx(2.5)
    either = profiled(Formula(lambda x: [1 * (x["a"] - 3.0)], {"a": 3.0}, bounds={"a": (-9.0, 4.0)}))
    assert either.lower == pytest.approx(3 - HALF, rel=0.02)
    assert either.upper is None
    assert either.values[-1] == pytest.approx(4.0)


@pytest.mark.parametrize(("start", "side"), [(6.0, "upper"), (2.5, "lower")])
def test_an_unknown_at_its_bound_is_open_there_without_a_search(start, side):
    problem = Formula(lambda x: [1 * (x["a"] - start)], {"a": start}, bounds={"a": (2.5, 6.0)})
    found = profiled(problem, std=1.0)
    assert getattr(found, side) is None
    assert found.notes == ()
    assert all((x[0] < start) == (side == "upper") for x in problem.asked if x[0] != start)


def test_others_stop_at_their_bounds():
    problem = Formula(
        lambda x: [x["a"] + x["b"] - 4.0, 0.1 * (x["b"] - 1.0)],
        {"a": 3.0, "b": 1.0},
        bounds={"b": (0.5, 1.25), "a": OPEN["a"]},
    )
    found = profiled(problem)
    assert found.upper == pytest.approx(3.5 + math.sqrt(CHI2_QUANTILE_95 - 0.05**2), rel=0.01)
    assert found.lower == pytest.approx(2.75 - math.sqrt(CHI2_QUANTILE_95 - 0.025**2), rel=0.01)


def test_only_a_product_is_seen_and_either_factor_is_open():
    problem = Formula(lambda x: [20 * (x["a"] * x["b"] - 6.0)], {"a": 2.0, "b": 3.0})
    for name in "ab":
        found = profiled(problem, name, std=math.inf)
        assert (found.lower, found.upper) == (None, None)
        assert found.delta_chi2.max() < 0.1


def test_unknowns_that_nothing_informs_stay_put():
    problem = Formula(lambda x: [1 * (x["a"] - 3.0), 0 * x["b"] + 1.0], {"a": 3.0, "b": 5.0})
    problem.asked.clear()
    profiled(problem)
    np.testing.assert_allclose([b for _, b in problem.asked], 5.0)


def test_series_springs_have_a_common_lower_end():
    def rows(x):
        return [100 * (1 / x["a"] + 1 / x["b"] - 1 / 2.0 - 1 / 2.0)]

    found = profiled(Formula(rows, {"a": 2.0, "b": 2.0}), std=math.inf)
    # neither can be softer than both together, to within the noise
    assert found.lower == pytest.approx(1 / (1 + HALF / 100), rel=0.02)
    assert found.upper is None


# -- what stands in the way -------------------------------------------------------------------------------------------


def test_where_the_rollout_fails_the_end_is_open_and_said():
    problem = Formula(lambda x: [0.1 * (x["a"] - 3.0)], {"a": 3.0}, bounds=OPEN, fails=lambda v: v["a"] > 7.0)
    found = profiled(problem)
    assert found.upper is None
    assert found.lower == pytest.approx(3 - 10 * HALF, rel=0.02)
    [note] = found.notes
    assert note.startswith("the model cannot be rolled out above 7")
    below = profiled(Formula(lambda x: [0.1 * (x["a"] - 3.0)], {"a": 3.0}, bounds=OPEN, fails=lambda v: v["a"] < -7.0))
    assert below.lower is None
    assert below.notes[0].startswith("the model cannot be rolled out below -7")


def test_a_failure_beyond_the_end_does_no_harm():
    problem = Formula(lambda x: [1 * (x["a"] - 3.0)], {"a": 3.0}, bounds=OPEN, fails=lambda v: abs(v["a"] - 3.0) > 2.2)
    found = profiled(problem, std=2.0)
    np.testing.assert_allclose([found.lower, found.upper], [3 - HALF, 3 + HALF], rtol=0.02)
    assert found.notes == ()


def test_others_where_they_were_help_where_the_tangent_leads_too_far():
    problem = Formula(
        lambda x: [x["a"] + x["b"] - 4.0, 0.5 * (x["b"] - 1.0)],
        {"a": 3.0, "b": 1.0},
        bounds=OPEN,
        fails=lambda v: v["b"] < 0.2,
    )
    found = profiled(problem)
    assert found.lower == pytest.approx(3 - HALF * math.sqrt(5.0), rel=0.02)
    assert found.upper is not None
    assert found.upper < 3 + HALF * math.sqrt(5.0)


def test_a_better_fit_that_is_met_on_the_way_is_said_and_counts_as_the_best():
    def rows(x):
        return [2 * (x["a"] - 3.0), *(0 * x["a"] for _ in range(9))]

    found = profiled(Formula(rows, {"a": 3.8}, bounds=OPEN))
    [note] = found.notes
    assert note.startswith("a fit better by 2.")
    assert note.endswith("in chi2 was met; the point was not the best one")
    assert found.delta_chi2.min() == 0.0
    assert found.lower == pytest.approx(3 - HALF / 2, rel=0.04)
    near = profiled(Formula(rows, {"a": 3.1}, bounds=OPEN))
    assert near.notes == ()


def test_a_cliff_is_found_by_halving():
    def rows(x):
        return [0.5 * (x["a"] - 3.0), 1e4 * ca.fmax(x["a"] - 3.7, 0.0)]

    found = profiled(Formula(rows, {"a": 3.0}, bounds=OPEN))
    assert found.upper == pytest.approx(3.7, abs=2e-3)
    assert found.lower == pytest.approx(3 - 2 * HALF, rel=0.02)
    assert found.notes == ()


def test_a_point_that_is_evaluated_already_is_not_evaluated_again():
    problem = Formula(lambda x: [2 * (x["a"] - 3.0)], {"a": 3.0}, bounds=OPEN)
    best = problem.evaluate(problem.initial_unknowns)
    problem.asked.clear()
    found = profile_likelihood(problem, problem.initial_unknowns, 0, 0.5, best)
    assert (3.0,) not in problem.asked
    assert len(problem.asked) == len(found.values) - 1 <= 6


def test_the_best_fit_is_the_optimum_nearby():
    problem = Formula(lambda x: [2 * (x["a"] - 3.0), x["a"] * x["b"] - 6.0], {"a": 2.0, "b": 1.0})
    x, evaluation = nearby_optimum(problem, problem.initial_unknowns)
    np.testing.assert_allclose(x, [3.0, 2.0], rtol=1e-4)
    assert evaluation.cost == pytest.approx(0.0, abs=1e-6)
    assert evaluation.jacobian is not None


@pytest.mark.parametrize(
    ("parameters", "unknowns", "expected"),
    [(12, 300, True), (13, 13, False), (1, 301, False), (13, 301, False), (1, 1, True)],
)
def test_intervals_are_worked_out_unasked_where_they_take_no_time(parameters, unknowns, expected):
    names = tuple(f"k{i}" for i in range(parameters))
    starts = tuple(f"start.q.joint[{i}]" for i in range(unknowns - parameters))
    assert (
        is_small_problem(SimpleNamespace(unknown_names=names + starts, shared_parameters=names, local_parameters=()))
        is expected
    )


# -- verdicts ---------------------------------------------------------------------------------------------------------


def test_a_stiffness_that_comes_out_small_by_chance_is_not_called_found():
    """Noise makes 0.2 fit best, while a joint that hardly gives fits nearly as well as 1/k fades."""

    def rows(x):
        return [100.0 * (x["a.bend"] - 20.0), 1.7 * (1.0 - 0.2 / x["b.bend"])]

    problem = Formula(rows, {"a.bend": 20.0, "b.bend": 0.2})
    there = problem.evaluate(problem.initial_unknowns)
    fitted = solution(a_bend=estimate(20.0, 0.01), b_bend=estimate(0.2, 0.25))
    judged = with_profile_intervals(problem, replace(fitted, x=problem.initial_unknowns, evaluation=there)).parameters
    assert judged["a.bend"] == fitted.parameters["a.bend"]
    assert judged["b.bend"] == replace(fitted.parameters["b.bend"], verdict="not_identifiable", std=math.inf)


@pytest.mark.parametrize(
    ("asymptote", "said"), [(3.2, "not_identifiable"), (3.35, "identifiable"), (30.0, "identifiable")]
)
def test_a_small_stiffness_counts_where_its_typical_size_is_ruled_out(asymptote, said):
    """3.29 standard deviations at 20, which is what others of its kind have."""
    problem = Formula(
        lambda x: [100.0 * (x["a.bend"] - 20.0), asymptote * (1.0 - 0.2 / x["b.bend"]) / 0.99],
        {"a.bend": 20.0, "b.bend": 0.2},
    )
    there = problem.evaluate(problem.initial_unknowns)
    entry = check_small_estimate(problem, problem.initial_unknowns, 1, estimate(0.2, 0.01), 20.0, there)
    assert entry.verdict == said
    assert (
        check_small_estimate(problem, problem.initial_unknowns, 1, estimate(7.0, 0.01), 20.0, there).verdict
        == "identifiable"
    )


def test_an_interval_may_be_open_where_a_typical_size_is_not_asked():
    problem = Formula(
        lambda x: [100.0 * (x["a.bend"] - 20.0), 1.7 * (1.0 - 12.0 / x["b.bend"])], {"a.bend": 20.0, "b.bend": 12.0}
    )
    there = problem.evaluate(problem.initial_unknowns)
    fitted = solution(a_bend=estimate(20.0, 0.01), b_bend=estimate(12.0, 7.0, "weak"))
    found = with_profile_intervals(problem, replace(fitted, x=problem.initial_unknowns, evaluation=there)).parameters[
        "b.bend"
    ]
    assert (found.verdict, found.std) == ("weak", math.inf)
    assert found.interval == (pytest.approx(12.0 / (1 + HALF / 1.7), rel=0.02), None)


def test_a_stiffness_that_is_known_to_be_small_is_found():
    problem = Formula(lambda x: [x["a.bend"] - 20.0, 10.0 * (x["b.bend"] - 0.05)], {"a.bend": 20.0, "b.bend": 0.05})
    there = problem.evaluate(problem.initial_unknowns)
    fitted = solution(a_bend=estimate(20.0, 1.0), b_bend=estimate(0.05, 0.1))
    found = with_profile_intervals(problem, replace(fitted, x=problem.initial_unknowns, evaluation=there)).parameters[
        "b.bend"
    ]
    assert (found.verdict, found.std) == ("identifiable", 0.1)
    assert found.interval == (None, pytest.approx(0.05 + HALF / 10, rel=0.01))
