"""How far estimates move with a finer model, rule by rule, on formulas and on chains."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from made_models import Formula, estimate

from yid_ocp.analysis.discretisation import (
    DiscretisationEstimateShift,
    FinerDiscretisationProblem,
    discretisation_estimate_shifts,
    fine_joints_by_coarse_joint,
    inflate_estimates_by_discretisation,
)
from yid_ocp.integrator.step import compile_step
from yid_ocp.model import Segment, System, flexible_object
from yid_ocp.problem import EstimationProblem
from yid_ocp.solvers import GaussNewton, solve

OPEN = {"a": (-math.inf, math.inf), "b": (-math.inf, math.inf)}


def problem(rows, start, shared=None, **more):
    made = Formula(rows, start, **more)
    made.shared_parameters = tuple(start) if shared is None else shared
    made.system = SimpleNamespace(mechanism=SimpleNamespace(joint_names=()))
    return made


# -- the step ---------------------------------------------------------------------------------------------------------


def shifts(coarse, finer, factors=None, **more):
    """Of the coarse problem's parameters at its initial values."""
    x = coarse.initial_unknowns
    return discretisation_estimate_shifts(
        FinerDiscretisationProblem(finer, factors or {}), coarse, x, coarse.evaluate(x), **more
    )


@pytest.mark.parametrize("factor", [1.0, 2.0])
def test_an_estimate_moves_to_where_a_linear_finer_model_fits_best(factor):
    """The finer model's own parameter is so many times the coarse one's; its best fit is at 3.3 coarse units."""
    coarse = problem(lambda x: [2 * (x["a"] - 3.0), x["a"] + x["b"] - 5.0], {"a": 3.0, "b": 2.0}, bounds=OPEN)
    finer = problem(
        lambda x: [2 * (x["a"] / factor - 3.3), x["a"] / factor + x["b"] - 5.1], {"a": 1.0, "b": 1.0}, bounds=OPEN
    )
    assert shifts(coarse, finer, {"a": factor}) == pytest.approx({"a": 0.3, "b": -0.2})


def test_a_point_that_is_no_estimate_counts_the_difference_of_the_models_alone():
    """At 2 the coarse model wants to go to 3 and the finer one to 3.3."""
    coarse = problem(lambda x: [2 * (x["a"] - 3.0)], {"a": 2.0}, bounds=OPEN)
    finer = problem(lambda x: [2 * (x["a"] - 3.3)], {"a": 2.0}, bounds=OPEN)
    assert shifts(coarse, finer) == pytest.approx({"a": 1.3})
    assert shifts(coarse, finer, model_difference_only=True) == pytest.approx({"a": 0.3})


def test_a_move_ends_at_the_bound():
    start = {"a": 1.0}
    assert shifts(problem(lambda x: [x["a"] - 1.0], start), problem(lambda x: [x["a"] + 5.0], start)) == {"a": -1.0}


def test_what_cannot_be_compared_says_why():
    coarse = problem(lambda x: [x["a"] - 1.0], {"a": 1.0})
    assert shifts(coarse, problem(lambda x: [x["a"]], {"a": 1.0}, fails=lambda values: True)) == "it snaps"
    longer = problem(lambda x: [x["a"], x["a"]], {"a": 1.0})
    assert "other samples" in shifts(coarse, longer, model_difference_only=True)


# -- what stands for what ---------------------------------------------------------------------------------------------


def chain(links):
    tube = flexible_object([Segment("T1", 0.6, 0.1, 0.02, links=links, joint_axes="xy")])
    return System.build(None, objects=[(tube, None, None)])


def test_divided_links_share_their_angle():
    coarse, fine = chain(2), chain(4)
    divided = fine_joints_by_coarse_joint(coarse, fine)
    assert divided == {
        "T1_0_x": ("T1_0_x", "T1_1_x"),
        "T1_0_y": ("T1_0_y", "T1_1_y"),
        "T1_1_x": ("T1_2_x", "T1_3_x"),
        "T1_1_y": ("T1_2_y", "T1_3_y"),
    }
    assert fine_joints_by_coarse_joint(coarse, coarse) == fine_joints_by_coarse_joint(fine, coarse) == {}


def test_a_start_and_its_equilibrium_are_carried_to_the_finer_chain():
    """Of a chain of half the links, whose angles are shared; what a finer model has besides keeps its own value."""
    names = [f"start.{kind}.{joint}[run]" for kind in "qp" for joint in ("T1_0_x", "T1_1_x")]
    free = dict.fromkeys((*names, "start.q.T1_0_x[run]", "start.p.T1_0_x[run]"), (-9.0, 9.0))
    given = {"a": 1.5, "c[run]": 2.0, "start.q.T1_0_x[run]": 0.4, "start.p.T1_0_x[run]": 0.9, "gone": 5.0}
    coarse = problem(lambda x: [x["a"]], given, bounds=free)
    coarse.system = chain(1)
    start = {"a": 1.0, "c[run]": 1.0, "b": 7.0, **dict.fromkeys(names, 0.0)}
    fine, asked = problem(lambda x: [x["a"]], start, bounds=free), []
    fine.system = chain(2)
    inner = fine.evaluate
    fine.evaluate = lambda x, equilibrium_guesses: asked.append((x, equilibrium_guesses)) or inner(x)
    at = replace(
        coarse.evaluate(coarse.initial_unknowns),
        episode_predictions=(
            SimpleNamespace(equilibrium_guess=np.array([0.2, -0.4])),
            SimpleNamespace(equilibrium_guess=None),
        ),
    )
    refined = FinerDiscretisationProblem(
        fine, {"a": 2.0, "c": 3.0}, fine_joints_by_coarse_joint(coarse.system, fine.system)
    )
    discretisation_estimate_shifts(refined, coarse, coarse.initial_unknowns, at)
    [(x, (warm, none))] = asked
    point = dict(zip(fine.unknown_names, x, strict=True))
    assert point == {"a": 3.0, "c[run]": 6.0, "b": 7.0, **dict(zip(names, (0.2, 0.2, 0.0, 0.0), strict=True))}
    np.testing.assert_allclose(warm, [0.1, -0.2, 0.1, -0.2])
    assert none is None


# -- what it leaves of a standard deviation ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("links", "time_step", "std"),
    [
        (None, None, 0.1),
        (0.1, -0.1, 0.1),
        (-0.3, 0.05, math.hypot(0.1, 0.6)),
        (0.05, 0.3, math.hypot(0.1, 0.6)),
        (0.3, -0.4, math.hypot(0.1, 0.6, 0.8)),
    ],
    ids=["not tried", "within it", "links", "time step", "both"],
)
def test_a_move_larger_than_the_standard_deviation_widens_it_to_where_the_limit_is(links, time_step, std):
    shifts = {"a": DiscretisationEstimateShift(links, time_step)}
    found = inflate_estimates_by_discretisation({"a": estimate(10.0, 0.1)}, shifts, {})
    assert found["a"].std == pytest.approx(std)


@pytest.mark.parametrize(
    ("move", "before", "after"),
    [
        (0.01, "identifiable", "identifiable"),
        (0.4, "identifiable", "identifiable"),
        (0.6, "identifiable", "weak"),
        (30.0, "identifiable", "not_identifiable"),
        (0.6, "weak", "weak"),
        (0.4, "weak", "weak"),
        (0.6, "at_bound", "at_bound"),
        (30.0, "not_identifiable", "not_identifiable"),
        (0.6, "not_trusted", "not_trusted"),
    ],
)
def test_a_verdict_is_lowered_by_moves_and_never_raised(move, before, after):
    """Of a value of 10 and a standard deviation of 0.02: ten percent are reached by a move of half of them."""
    said = {"a": estimate(10.0, 0.02, verdict=before), "b": estimate(10.0, 0.02), "c": estimate(3.0, 0.0, free=False)}
    found = inflate_estimates_by_discretisation(
        said, {"c": DiscretisationEstimateShift(9.0), "a": DiscretisationEstimateShift(move)}, {}
    )
    assert found["a"].verdict == after
    assert found["a"].std == (0.02 if move < 0.02 else pytest.approx(math.hypot(0.02, 2 * move)))
    assert found["b"] == said["b"]
    assert found["c"] == said["c"]
    assert replace(found["a"], std=0.02, verdict=before) == said["a"]


@pytest.mark.parametrize(
    ("interval", "expected"),
    [
        ((9.0, 12.0), (9.0 - 1.96 * 0.6, 12.0 + 1.96 * 0.6)),
        ((None, 12.0), (None, 12.0 + 1.96 * 0.6)),
        ((9.0, None), (9.0 - 1.96 * 0.6, None)),
        ((0.2, 19.5), (0.0, 20.0)),
        (None, None),
    ],
    ids=["both", "open below", "open above", "to the bounds", "none"],
)
def test_an_interval_grows_at_its_ends_by_what_the_move_adds(interval, expected):
    said = replace(estimate(10.0, 0.2), interval=interval, lower=0.0, upper=20.0)
    found = inflate_estimates_by_discretisation({"a": said}, {"a": DiscretisationEstimateShift(0.3)}, {})["a"].interval
    if expected is None:
        assert found is None
    else:
        assert [None if end is None else pytest.approx(end, rel=1e-4) for end in expected] == list(found)


def test_what_nothing_informs_stays_unknown():
    said = {"a": estimate(10.0, math.inf, verdict="not_identifiable")}
    assert inflate_estimates_by_discretisation(said, {"a": DiscretisationEstimateShift(5.0, 5.0)}, {}) == said


# -- on a real chain --------------------------------------------------------------------------------------------------


def test_half_the_step_of_a_pendulum_is_where_its_own_fit_goes(pendulum, twin):
    """The problem's own answer with half the step is what one Gauss-Newton step says, to second order."""
    clean = pendulum()
    recording = twin(clean, clean.initial_unknowns, 3)
    coarse = pendulum(recording)
    step = compile_step(coarse.system, coarse.step.time_step / 2, coarse.step.force_split, use_compiler=False)
    fine = EstimationProblem(
        step, [recording], coarse.free, coarse.options, dict(zip(coarse.free, coarse.initial_unknowns, strict=True))
    )
    found = solve(coarse, GaussNewton())
    finer = solve(fine, GaussNewton(), initial_unknowns=found.x)
    own = discretisation_estimate_shifts(FinerDiscretisationProblem(fine), coarse, found.x, found.evaluation)
    change = finer.x - found.x
    assert np.abs(change).max() > 1e-5
    np.testing.assert_allclose(
        [own[name] for name in coarse.unknown_names], change, rtol=0.1, atol=0.05 * np.abs(change).max()
    )
