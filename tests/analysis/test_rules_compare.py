"""Several methods, rule by rule: whether they agree, why not, and what is said of parameters that are not found."""

from __future__ import annotations

import os
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from made_models import estimate, solution

from yid_ocp.analysis import compare as module
from yid_ocp.analysis.compare import (
    MethodComparison,
    MethodResult,
    _descent_errors,
    _differences,
    _explanations,
    compare_methods,
)
from yid_ocp.problem import ProblemOptions
from yid_ocp.solvers import Status


def run(method="gauss_newton", cost=1.0, status=Status.CONVERGED, **parameters):
    return MethodResult(method, solution(method, status, **parameters), cost, [], 1.0, 1.0, 50.0)


def differences(here, best):
    return _differences(here, best, best.solution.parameters)


# -- do they agree ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("here", "best", "differs"),
    [
        ((10.0, 0.1), (10.0, 0.1), False),
        ((10.2, 0.1), (10.0, 0.1), False),
        ((10.21, 0.1), (10.0, 0.1), True),
        ((9.79, 0.1), (10.0, 0.1), True),
        ((10.3, 0.2), (10.0, 0.1), False),
        ((10.3, 0.1), (10.0, 0.2), False),
        ((10.04, 0.0), (10.0, 0.0), False),
        ((10.06, 0.0), (10.0, 0.0), True),
        ((-10.04, 0.0), (-10.0, 0.0), False),
    ],
    ids=[
        "the same",
        "two standard deviations",
        "more",
        "less",
        "its own are larger",
        "the other's are larger",
        "half a percent",
        "more than half a percent",
        "of a negative value",
    ],
)
def test_estimates_agree_within_two_standard_deviations_or_half_a_percent(here, best, differs):
    said = differences(run(a=estimate(*here)), run(a=estimate(*best)))
    assert bool(said) is differs


@pytest.mark.parametrize(
    ("status", "cost", "why"),
    [
        (Status.ITERATION_LIMIT, 1.0, "it ended with 'iteration_limit' before reaching the optimum"),
        (Status.STALLED, 99.0, "it ended with 'stalled' before reaching the optimum"),
        (Status.CONVERGED, 3.1, "it stopped in another valley of the cost"),
        (Status.CONVERGED, 3.0, "its cost weighs the measurements otherwise"),
        (Status.CONVERGED, 1.0, "its cost weighs the measurements otherwise"),
    ],
)
def test_a_difference_has_a_likely_reason(status, cost, why):
    best = run(a_b=estimate(10.0, 0.123), c=estimate(5.0))
    said = differences(run("single_shooting", cost, status, a_b=estimate(12.3456), c=estimate(5.0)), best)
    assert said == [f"a.b = 12.35, while gauss_newton finds 10 +- 0.12: {why}"]


def test_parameters_that_are_not_found_need_not_agree():
    best = run(a=estimate(10.0, verdict="weak"), b=estimate(10.0, verdict="not_identifiable"), c=estimate(1.0))
    assert differences(run(a=estimate(99.0), b=estimate(99.0), c=estimate(1.0)), best) == []


def test_methods_agree_where_nothing_is_said_against_it():
    runs = (run(), run("single_shooting"))
    judged = ("gauss_newton", False, runs[0].solution, [])
    assert MethodComparison(runs, *judged, {"gauss_newton": [], "single_shooting": []}, ()).is_consistent
    assert not MethodComparison(runs, *judged, {"gauss_newton": [], "single_shooting": ["a differs"]}, ()).is_consistent


# -- what is said -----------------------------------------------------------------------------------------------------


def test_parameters_that_are_not_found_are_explained():
    weak, hidden = estimate(10.0, verdict="weak"), estimate(3.0, verdict="not_identifiable")
    best = run(a_b=weak, c=hidden, d=estimate(1.0), e=estimate(2.0, verdict="fixed", free=False))
    other = run("single_shooting", a_b=estimate(12.3456), c=estimate(4.5), d=estimate(1.0), e=estimate(2.0))
    said = _explanations([best, other], best.solution.parameters, {"a.b": 11.25}, False)
    assert said == [
        "a.b (truth 11.25) is weakly determined: where it ends is the method's choice "
        "(gauss_newton 10, single_shooting 12.3)",
        "c cannot be found: where it ends is the method's choice (gauss_newton 3, single_shooting 4.5)",
    ]


def test_errors_of_the_papers_method_are_said_where_the_truth_is_known():
    best = run(a=estimate(10.0))
    descent = run("steepest_descent", a=estimate(10.5))
    judged = best.solution.parameters
    assert _explanations([best, descent], judged, {}, False) == []
    said = _explanations([best, descent, run("single_shooting", a=estimate(99.0))], judged, {"a": 10.0}, False)
    assert said == ["steepest_descent ended within 10 % of the truth everywhere"]


SEEN, HIDDEN = estimate(10.0), estimate(3.0, verdict="not_identifiable")


@pytest.mark.parametrize(
    ("a", "b", "said"),
    [
        (10.9, 2.19, "steepest_descent ended within 10 % of the truth everywhere"),
        (
            10.0,
            3.0,
            "where steepest_descent did not end within 10 % of the truth: b (3 for 2, cannot be found); "
            "these are exactly the parameters that are not found",
        ),
        (
            8.9,
            3.0,
            "where steepest_descent did not end within 10 % of the truth: a (8.9 for 10, found), "
            "b (3 for 2, cannot be found); a could be found: the method stopped short (iteration_limit)",
        ),
        (
            11.1,
            2.0,
            "where steepest_descent did not end within 10 % of the truth: a (11.1 for 10, found); "
            "a could be found: the method stopped short (iteration_limit); "
            "b (cannot be found) came out near the truth all the same",
        ),
    ],
)
def test_where_a_method_ended_far_from_the_truth(a, b, said):
    descent = run("steepest_descent", status=Status.ITERATION_LIMIT, a=estimate(a), b=estimate(b), c=estimate(9.0))
    fixed = estimate(1.0, verdict="fixed", free=False)
    best = run(a=SEEN, b=HIDDEN, c=fixed)
    truth = {"a": 10.0, "b": 2.0, "c": 1.0, "d": 5.0}
    assert _descent_errors(descent, best.solution.parameters, truth, False) == said


@pytest.mark.parametrize(
    ("disturbed", "why"),
    [(True, "it takes the recorded torques as true"), (False, "its cost weighs the measurements otherwise")],
)
def test_a_method_that_converged_did_not_stop_short(disturbed, why):
    said = _descent_errors(run("steepest_descent", a=estimate(5.0)), {"a": SEEN}, {"a": 10.0}, disturbed)
    assert said.endswith(f"a could be found: {why}")


def test_a_truth_of_zero_and_negative_truths_have_their_tenth():
    best = run(a=estimate(0.0), b=estimate(-1.0))
    made = run("steepest_descent", a=estimate(0.0), b=estimate(-1.05))
    assert "everywhere" in _descent_errors(made, best.solution.parameters, {"a": 0.0, "b": -1.0}, False)


# -- running them -----------------------------------------------------------------------------------------------------


class Problem:
    """A problem whose answers cost what they are; remembers what was asked."""

    def __init__(self, weighting="whitened", disturbed=False):
        self.options = ProblemOptions(weighting=weighting)
        self.has_process_noise, self.asked = disturbed, []

    def with_options(self, options):
        other = Problem(options.weighting)
        other.options, other.asked = options, self.asked
        return other

    def evaluate(self, x, derivatives=True):
        self.asked.append((self.options.weighting, float(x[0]), derivatives))
        return SimpleNamespace(cost=float(x[0]))

    def predict_held_out(self, x):
        return [(self.options.weighting, float(x[0]))]


def without_noise(problem):
    other = Problem(problem.options.weighting)
    other.asked = problem.asked
    return other


@pytest.mark.parametrize("weighting", ["whitened", "paper"])
def test_methods_run_one_by_one_and_the_lowest_cost_is_the_reference(monkeypatch, weighting):
    solved, told = [], []
    answers = {"single_shooting": 3.0, "gauss_newton": 2.0, "steepest_descent": 5.0}

    def solve(problem, solver, callback, limits, restarts=True):
        solved.append((solver.name, problem.options.weighting))
        callback("step")
        return solution(solver.name, a=estimate(answers[solver.name]))

    monkeypatch.setattr(module, "solve", solve)
    monkeypatch.setattr(module, "without_input_errors", without_noise)
    solvers = [SimpleNamespace(name=name) for name in answers]
    problem = Problem(weighting)
    found = compare_methods(problem, solvers, {"a": 2.0}, lambda name, entry: told.append((name, entry)))
    assert solved == [("single_shooting", weighting), ("gauss_newton", weighting), ("steepest_descent", "paper")]
    assert told == [(name, "step") for name in answers]
    assert found.reference_method == "gauss_newton"
    assert [r.whitened_cost for r in found.method_results] == [3.0, 2.0, 5.0]
    assert problem.asked == [(weighting, x, False) for x in (3.0, 2.0, 5.0)]
    assert [r.held_out_predictions for r in found.method_results] == [
        [(weighting, 3.0)],
        [(weighting, 2.0)],
        [("paper", 5.0)],
    ]
    assert set(found.disagreements) == set(answers)
    assert found.disagreements["gauss_newton"] == []
    assert found.disagreements["single_shooting"]
    assert len(found.explanations) == 1
    for entry in found.method_results:
        assert 0 <= entry.wall_seconds < 5
        assert 0 <= entry.cpu_seconds < 5
        assert 10 < entry.peak_memory_mib < 1e5
    assert not found.has_process_noise
    assert found.verdict_solution is found.method_results[1].solution
    assert compare_methods(problem, solvers[:1]).explanations == ()


def test_verdicts_count_the_noise_that_drives_the_motion(monkeypatch):
    """The methods are compared without it, where nothing can be trusted; one more run, told as another, weighs it."""
    solved, told = [], []

    def solve(problem, solver, callback, limits, restarts=True):
        solved.append((solver.name, problem.has_process_noise, restarts))
        callback("step")
        verdict = "identifiable" if problem.has_process_noise else "not_trusted"
        value = 10.0 if problem.has_process_noise else {"able": 7.0, "single_shooting": 7.5}[solver.name]
        return solution(solver.name, a=estimate(value, 0.1, verdict))

    monkeypatch.setattr(module, "solve", solve)
    monkeypatch.setattr(module, "without_input_errors", without_noise)
    able, other = (
        SimpleNamespace(name="able", uses_process_noise_covariance=True),
        SimpleNamespace(name="single_shooting"),
    )
    found = compare_methods(Problem(disturbed=True), [other, able], {"a": 10.0}, lambda *entry: told.append(entry))
    # by the sensors' noise alone every fit is poor, from wherever it starts
    assert solved == [("single_shooting", False, False), ("able", False, False), ("able", True, True)]
    assert told == [("single_shooting", "step"), ("able", "step"), ("all noise", "step")]
    assert found.has_process_noise
    assert found.verdict_solution.parameters["a"] == estimate(10.0)
    assert found.verdict_held_out_predictions == [("whitened", 10.0)]
    assert found.reference_method == "able"
    # found by the likelihood, so the methods have to agree on it
    assert not found.is_consistent
    assert found.disagreements["single_shooting"][0].startswith("a = 7.5, while able finds 7")
    solved.clear()
    compare_methods(Problem(disturbed=True), [other])
    assert solved == [("single_shooting", False, False), ("gauss_newton", True, True)]


def test_the_peak_of_memory_is_what_was_used_in_between():
    with module._Memory() as memory:
        large = np.ones(30_000_000 // 8)
        large += 1
        time.sleep(0.1)
        during = module._resident()
    assert memory.peak >= 0.9 * during > 20
    del large


STATM = Path("/proc/self/statm")


@pytest.mark.skipif(not STATM.exists(), reason="this system does not tell")
def test_resident_memory_is_in_mebibytes():
    pages = int(STATM.read_text(encoding="ascii").split()[1])
    page = os.sysconf("SC_PAGE_SIZE")
    assert module._resident() == pytest.approx(pages * page / 2**20, rel=0.1)


def test_the_watch_over_memory_keeps_no_process_alive_and_looks_often(monkeypatch):
    looks = []
    monkeypatch.setattr(module, "_resident", lambda: float(looks.append(1) or len(looks)))
    with module._Memory() as memory:
        assert memory._thread.daemon
        time.sleep(0.3)
    assert len(looks) >= 5
    assert memory.peak == len(looks)


@pytest.mark.parametrize(("platform", "unit"), [("linux", 1024.0), ("darwin", 1024.0**2)])
def test_memory_where_the_system_tells_only_its_peak(monkeypatch, platform, unit):
    """Kibibytes everywhere but on macOS, which counts bytes."""
    resource = pytest.importorskip("resource")
    monkeypatch.setattr(Path, "is_file", lambda self: False)
    monkeypatch.setattr("sys.platform", platform)
    monkeypatch.setattr(resource, "getrusage", lambda who: SimpleNamespace(ru_maxrss=96.0 * unit))
    assert module._resident() == pytest.approx(96.0)
