"""Profile likelihood on formulas whose intervals are known."""

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from made_models import Formula, estimate, solution
from made_recordings import twin_recording

from yid_ocp.analysis.identifiability import identifiability
from yid_ocp.analysis.profile import (
    compute_profile_likelihood_interval,
    is_small_enough_for_profiles,
    solution_with_profile_intervals,
)
from yid_ocp.inference.linearized_residual import residual_and_jacobian_with_stated_priors
from yid_ocp.parallel import Task, run_tasks
from yid_ocp.problem import EstimationProblem
from yid_ocp.solvers import GaussNewton, fit_problem
from yid_ocp.workflow.build_problem import load_problem

OPEN = dict.fromkeys("ab", (-math.inf, math.inf))
HALF = 1.959963984540054


def profiled(problem, name="a", std=None):
    """The profile about the initial unknowns; the best fit itself is not evaluated again."""
    x, index = problem.initial_unknowns, problem.unknown_names.index(name)
    best = problem.evaluate(x)
    if std is None:
        _, jacobian = residual_and_jacobian_with_stated_priors(problem, best)
        std = float(np.sqrt(np.diag(np.linalg.pinv(jacobian.T @ jacobian))[index]))
    problem.asked.clear()
    found = compute_profile_likelihood_interval(problem, x, index, std, best)
    assert tuple(x) not in problem.points
    return found


ROWS = np.array([[1.0, 0.9], [0.3, 1.0], [0.5, 0.5]])
STD = math.sqrt(np.linalg.inv(ROWS.T @ ROWS)[0, 0])


WIDE, THREE = {"bounds": OPEN}, {"a": 3.0}
INTERVALS = {
    "linear": (lambda x: [2 * (x["a"] - 3)], THREE, WIDE, 3 - HALF / 2, 3 + HALF / 2),
    "others are refitted": (
        lambda x: [r[0] * (x["a"] - 1.0) + r[1] * (x["b"] + 2.0) for r in ROWS],
        *({"a": 1.0, "b": -2.0}, WIDE, 1 - HALF * STD, 1 + HALF * STD),
    ),
    "a misfit widens it": (
        lambda x: [2 * (x["a"] - 3) + 4.0, 2 * (x["a"] - 3) - 4.0, 2 * (x["a"] - 3)],
        *(THREE, WIDE, 3 - HALF * 4 / math.sqrt(12), 3 + HALF * 4 / math.sqrt(12)),
    ),
    "stated priors count, weak ones do not": (
        lambda x: [x["a"] - 3, (x["a"] - 3) * math.sqrt(3.0), 50 * (x["a"] - 3)],
        *(THREE, {**WIDE, "stated": 1, "weak": 1}, 3 - HALF / 2, 3 + HALF / 2),
    ),
    "rows in metres": (
        lambda x: [0.02 * (x["a"] - 3), math.sqrt(12.0) * (x["a"] - 3)],
        *(THREE, {**WIDE, "stated": 1, "noise": 0.01}, 3 - HALF / 4, 3 + HALF / 4),
    ),
    "a positive unknown": (lambda x: [x["a"] - 3.0], THREE, {}, 3 - HALF, 3 + HALF),
    "another unit": (lambda x: [x["a"] * 1e3 - 3.0], {"a": 3e-3}, {}, (3 - HALF) / 1e3, (3 + HALF) / 1e3),
    "lopsided": (lambda x: [5 * ca.log(x["a"] / 3.0)], THREE, {}, 3 * math.exp(-HALF / 5), 3 * math.exp(HALF / 5)),
    "open on one side": (lambda x: [2 * (1 / x["a"] - 1 / 3.0)], THREE, {}, 1 / (1 / 3 + HALF / 2), None),
    "a bound below": (lambda x: [x["a"] - 3.0], THREE, {"bounds": {"a": (2.5, 6.0)}}, None, 3 + HALF),
    "a bound above": (lambda x: [x["a"] - 3.0], THREE, {"bounds": {"a": (-9.0, 4.0)}}, 3 - HALF, None),
    "others at their bounds": (
        lambda x: [x["a"] + x["b"] - 4.0, 0.1 * (x["b"] - 1.0)],
        *({"a": 3.0, "b": 1.0}, {"bounds": {"b": (0.5, 1.25), "a": OPEN["a"]}}),
        *(2.75 - math.sqrt(HALF**2 - 0.025**2), 3.5 + math.sqrt(HALF**2 - 0.05**2)),
    ),
    "a failure beyond the end": (
        lambda x: [x["a"] - 3.0],
        *(THREE, {**WIDE, "fails": lambda v: abs(v["a"] - 3) > 2.2}, 3 - HALF, 3 + HALF),
    ),
    "a cliff": (lambda x: [0.5 * (x["a"] - 3.0), 1e4 * ca.fmax(x["a"] - 3.7, 0.0)], *(THREE, WIDE, 3 - 2 * HALF, 3.7)),
    "a near cliff": (lambda x: [x["a"] / 2 - 1.5, 1e6 * ca.fmax(x["a"] - 3.01, 0.0)], THREE, WIDE, 3 - 2 * HALF, 3.01),
}
ROLLOUTS = dict(zip(INTERVALS, (2, 2, 4, 2, 2, 7, 7, 2, 9, 4, 2, 6, 2, 16, 23), strict=True))


@pytest.mark.parametrize("case", INTERVALS)
def test_an_interval_is_where_chi2_rises_by_the_quantile(case):
    rows, start, more, lower, upper = INTERVALS[case]
    problem = Formula(rows, start, **more)
    found = profiled(problem)
    near = 0.011  # of the distance to the end, as the root of chi2 is met to a hundredth
    ends = [None if end is None else pytest.approx(end, abs=near * abs(end - start["a"])) for end in (lower, upper)]
    assert list(found.interval) == ends
    assert found.notes == ()
    assert np.all(np.diff(found.values) > 0)
    assert found.delta_chi2.min() == 0.0
    assert len(problem.asked) == ROLLOUTS[case]


def test_series_springs_have_a_common_lower_end():
    """Neither can be softer than both together, to within the noise."""
    found = profiled(Formula(lambda x: [100 * (1 / x["a"] + 1 / x["b"] - 1.0)], {"a": 2.0, "b": 2.0}), std=math.inf)
    assert found.interval == (pytest.approx(1 / (1 + HALF / 100), rel=0.02), None)


@pytest.mark.parametrize(
    ("rows", "more", "ends"),
    [
        (lambda x: [0 * x["a"] + 1.0], {}, (3e-3, 3e3)),
        (lambda x: [0 * x["a"] + 1.0], {"bounds": OPEN, "scales": {"a": 2.0}}, (-1997.0, 2003.0)),
        (lambda x: [20 * (x["a"] * x["b"] - 15.0)], {}, (3e-3, 3e3)),
    ],
    ids=["positive", "of either sign", "one factor of a product"],
)
def test_what_nothing_informs_is_open_on_both_sides(rows, more, ends):
    found = profiled(Formula(rows, {"a": 3.0, "b": 5.0}, **more), std=math.inf)
    assert (found.interval, found.notes) == ((None, None), ())
    assert (found.values[0], found.values[-1]) == pytest.approx(ends)
    assert found.delta_chi2.max() < 0.1


@pytest.mark.parametrize(("start", "side"), [(6.0, "upper"), (2.5, "lower")])
def test_an_unknown_at_its_bound_is_open_there_without_a_search(start, side):
    problem = Formula(lambda x: [x["a"] - start], {"a": start}, bounds={"a": (2.5, 6.0)})
    found = profiled(problem, std=1.0)
    assert (found.interval[side == "upper"], found.notes) == (None, ())
    assert all((x[0] < start) == (side == "upper") for x in problem.points)


@pytest.mark.parametrize(("limit", "side"), [(7.0, "above"), (-7.0, "below")])
def test_where_the_rollout_fails_the_end_is_open_and_said(limit, side):
    far = (lambda v: v["a"] > limit) if limit > 0 else (lambda v: v["a"] < limit)
    problem = Formula(lambda x: [0.1 * (x["a"] - 3.0)], {"a": 3.0}, bounds=OPEN, fails=far)
    found = profiled(problem)
    lower, upper = found.interval
    assert (upper if limit > 0 else lower) is None
    assert (lower if limit > 0 else upper) == pytest.approx(3 - 10 * HALF * np.sign(limit), rel=0.02)
    [note] = found.notes
    begin, _, barrier = note.rpartition(" ")
    assert ("cannot be simulated" in begin, side in begin) == (True, True)
    assert abs(float(barrier)) - abs(limit) == pytest.approx(0.005, abs=0.006)
    assert len(problem.asked) < 24


def test_others_where_they_were_help_where_the_tangent_leads_too_far():
    def rows(x):
        return [x["a"] + x["b"] - 4.0, 0.5 * (x["b"] - 1.0)]

    found = profiled(Formula(rows, {"a": 3.0, "b": 1.0}, bounds=OPEN, fails=lambda v: v["b"] < 0.2))
    assert found.interval[0] == pytest.approx(3 - HALF * math.sqrt(5.0), rel=0.02)
    assert 3 < found.interval[1] < 3 + HALF * math.sqrt(5.0)


@pytest.mark.parametrize(("start", "is_said"), [(3.8, True), (3.1, False)])
def test_a_better_fit_that_is_met_on_the_way_is_said_and_counts_as_the_best(start, is_said):
    def rows(x):
        return [2 * (x["a"] - 3.0), *(0 * x["a"] for _ in range(9))]

    found = profiled(Formula(rows, {"a": start}, bounds=OPEN))
    said = [part in found.better_fit for part in ("(chi2 lower by 2.", "--set parameters.a.initial=")]
    assert (said, found.notes) == ([is_said] * 2, ())
    assert found.delta_chi2.min() == 0.0
    assert found.interval[0] == pytest.approx(3 - HALF / 2, rel=0.04)


def test_refits_leave_little_on_the_table():
    """The other unknown follows the first on a curve, so that its tangent alone is not enough."""

    def rows(x):
        return [x["a"] - 3.0 + x["b"], 2 * (x["b"] - 0.3 * (x["a"] - 3.0) ** 2)]

    found = profiled(Formula(rows, {"a": 3.0, "b": 0.0}, bounds=OPEN))
    gone = found.values - 3.0
    exact = (gone + 0.3 * gone**2) ** 2 / (1 + 1 / 4)
    assert np.max(found.delta_chi2) > 3
    np.testing.assert_allclose(found.delta_chi2, exact, atol=2e-3)
    assert np.all(found.delta_chi2 >= exact - 1e-9)


@pytest.mark.parametrize(("left", "refitted"), [(0.7e-3, False), (1.5e-3, True)])
def test_a_refit_is_worth_a_thousandth_of_chi2(left, refitted):
    def rows(x):
        return [x["a"] - 3.0, x["b"] - math.sqrt(left) * ((x["a"] - 3.0) / HALF) ** 2]

    problem = Formula(rows, {"a": 3.0, "b": 0.0}, bounds=OPEN, scales={"a": 1.0, "b": 1.0})
    profiled(problem, std=1.0)
    first = next(x[0] for x in problem.points if x[0] > 3.0)
    assert (len([a for a, _ in problem.points if a == first]) > 1) is refitted


@pytest.mark.parametrize(
    ("parameters", "unknowns", "expected"), [(12, 300, True), (13, 13, False), (1, 301, False), (1, 1, True)]
)
def test_intervals_are_worked_out_unasked_where_they_take_no_time(parameters, unknowns, expected):
    names = tuple(f"k{i}" for i in range(parameters))
    starts = tuple(f"start.q.joint[{i}]" for i in range(unknowns - parameters))
    problem = SimpleNamespace(unknown_names=names + starts, shared_parameters=names, local_parameters=())
    assert is_small_enough_for_profiles(problem) is expected


@pytest.mark.parametrize(
    ("size", "value", "std", "verdict", "expected", "interval"),
    [
        (1.7, 0.2, 0.25, "identifiable", ("not_identifiable", math.inf), None),
        (3.2 / 0.75, 5.0, 0.01, "identifiable", ("not_identifiable", math.inf), None),
        (3.35 / 0.99, 0.2, 0.01, "identifiable", ("identifiable", 0.01), None),
        (1.7, 7.0, 0.01, "identifiable", ("identifiable", 0.01), None),
        (1.7, 12.0, 7.0, "weak", ("weak", math.inf), (12.0 / (1 + HALF / 1.7), None)),
    ],
    ids=["by chance", "3.2 of 3.29 deviations", "3.35 deviations", "not small", "open above"],
)
def test_a_small_stiffness_counts_where_its_typical_size_is_ruled_out(size, value, std, verdict, expected, interval):
    """Noise makes it fit best, while the typical size, 20 as others of its kind have, fits nearly as well."""

    def rows(x):
        return [100.0 * (x["a.bend"] - 20.0), size * (1.0 - value / x["b.bend"])]

    found = judged(Formula(rows, {"a.bend": 20.0, "b.bend": value}), estimate(value, std, verdict))
    assert (found.verdict, found.std) == expected
    assert (found.interval is None) == (interval is None)
    if interval:
        assert found.interval == (pytest.approx(interval[0], rel=0.02), None)


def judged(problem, entry):
    """The second parameter's estimate with its interval, where that is worked out; the first stays as it is."""
    first = estimate(20.0, 0.01)
    fitted = solution(a_bend=first, b_bend=entry)
    there = problem.evaluate(problem.initial_unknowns)
    found = solution_with_profile_intervals(
        problem, replace(fitted, x=problem.initial_unknowns, evaluation=there)
    ).parameters
    assert found["a.bend"] == first
    return found["b.bend"]


def test_a_stiffness_that_is_known_to_be_small_is_found():
    start = {"a.bend": 20.0, "b.bend": 0.05}
    problem = Formula(lambda x: [100 * (x["a.bend"] - 20.0), 10.0 * (x["b.bend"] - 0.05)], start)
    found = judged(problem, estimate(0.05, 0.1))
    assert (found.verdict, found.std) == ("identifiable", 0.1)
    assert found.interval == (None, pytest.approx(0.05 + HALF / 10, rel=0.01))


def test_a_small_value_is_found_where_no_rollout_succeeds_at_the_typical_size():
    start = {"a.bend": 20.0, "b.bend": 1.2}
    problem = Formula(
        lambda x: [100 * (x["a.bend"] - 20.0), 300.0 * (x["b.bend"] - 1.2)], start, fails=lambda v: v["b.bend"] > 9.0
    )
    found = judged(problem, estimate(1.2, 0.003))
    assert (found.verdict, found.std) == ("identifiable", 0.003)


def test_the_papers_cost_and_a_failed_fit_have_no_intervals():
    problem = Formula(lambda x: [0.1 * (x["a"] - 3.0)], {"a": 3.0})
    fitted = replace(solution(a=estimate(3.0, 10.0, "weak")), x=problem.initial_unknowns)
    assert solution_with_profile_intervals(problem, fitted) is fitted
    fitted = replace(fitted, evaluation=problem.evaluate(problem.initial_unknowns))
    assert solution_with_profile_intervals(problem, fitted).parameters["a"].interval is not None
    problem.options = replace(problem.options, weighting="paper")
    assert solution_with_profile_intervals(problem, fitted) is fitted


TWINS = 100
SEEN = ("T1.bend", "T1.twist", "T2.bend", "T3.bend")
TRUTH = {"T1.bend": 22.0, "T1.twist": 13.6, "T2.bend": 10.7, "T2.twist": 8.2, "T3.bend": 11.5, "T3.twist": 9.7}


def holds(interval: tuple[float | None, float | None], truth: float) -> bool:
    lower, upper = interval
    return (lower is None or lower <= truth) and (upper is None or truth <= upper)


def judged_twin(config: Path, seed: int) -> dict[str, Any]:
    """Of a twin: which of the intervals hold the truth, and which parameters are called identifiable."""
    exact = config.parents[1] / "tests" / "data" / "clean" / "single_arm_vision_estimate.h5"
    made = load_problem(config, ["problem.duration=3.0", f"recordings.estimate=[{exact}]"])
    recording = twin_recording(made, np.array([TRUTH[name] for name in made.unknown_names]), seed)
    problem = EstimationProblem(made.step, [recording], made.free, made.options, dict.fromkeys(TRUTH, 10.0))
    info = identifiability(problem, fit_problem(problem, GaussNewton()), intervals=list(SEEN))
    held = [holds(info.parameters[name].interval, TRUTH[name]) for name in SEEN]
    found = [name for name, entry in info.parameters.items() if entry.verdict == "identifiable"]
    return {"held": held, "identifiable": found}


def report(record_property, hits: dict[str, list[bool]]) -> float:
    pooled = float(np.mean([hit for found in hits.values() for hit in found]))
    record_property("coverage", pooled)
    print(f"coverage {100 * pooled:.1f} %", {name: f"{sum(found)} of {len(found)}" for name, found in hits.items()})
    return pooled


@pytest.mark.slow
def test_coverage_on_a_pendulum(pendulum, twin, record_property):
    empty = pendulum()
    truth = dict(zip(empty.unknown_names, empty.initial_unknowns, strict=True))
    profile: dict[str, list[bool]] = {name: [] for name in truth}
    gaussian: dict[str, list[bool]] = {name: [] for name in truth}
    for seed in range(TWINS):
        recording = twin(empty, empty.initial_unknowns, 1000 + seed)
        problem = pendulum(recording, {"elbow.stiffness": 3.0, "elbow.damping": 0.1, "elbow.rest": 0.1})
        info = identifiability(problem, fit_problem(problem, GaussNewton()), intervals="all")
        for name, value in truth.items():
            entry = info.parameters[name]
            profile[name].append(holds(entry.interval, value))
            gaussian[name].append(abs(entry.value - value) <= 1.96 * entry.std)
    assert 0.92 <= report(record_property, profile) <= 0.98
    assert 0.92 <= report(record_property, gaussian) <= 0.98


@pytest.mark.slow
def test_coverage_on_one_arm_and_the_y(repository, tmp_path, record_property):
    """43 coordinates, 3 s: bends to a percent, T1.twist and T3.bend so weakly that only profiles are honest."""
    config = repository / "configs" / "single_arm_vision.yaml"
    tasks = [Task(f"twin {seed}", {"config": config, "seed": seed}) for seed in range(TWINS)]
    results = run_tasks(judged_twin, tasks, tmp_path)
    assert [entry.error for entry in results if entry.error] == []
    found = [entry.value for entry in results]
    assert all({"T2.twist", "T3.twist"}.isdisjoint(entry["identifiable"]) for entry in found)
    hits = {name: [entry["held"][i] for entry in found] for i, name in enumerate(SEEN)}
    assert 0.92 <= report(record_property, hits) <= 0.98
