"""What all solvers share, rule by rule: restarts, horizons, gradients, histories."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from made_problems import MadeUp, Steps, linear

from yid_ocp.errors import DataError, SolverError
from yid_ocp.inference.linearized_residual import (
    bounded_levenberg_marquardt_step,
    is_stationary_point,
    max_abs_projected_gradient,
    predicted_cost_reduction_by_step,
    size_limited_damped_step,
)
from yid_ocp.problem.evaluation import PriorResiduals
from yid_ocp.solvers import GaussNewton, base
from yid_ocp.solvers.base import AcceptedIterateRecorder, Solution, Status, fit_problem

INSIDE = [((1, 1), (3, -4), 8.0), ((1, 1), (5, -1), 5.0)]
LOW = [((0, 1), (5, -1), 2.0), ((0, 1), (-5, -1), 5.0), ((0, 2), (5, -9), 0.0), ((-0.1, 2.1), (5, -9), 0.0)]
HIGH = [((1, 2), (1, -9), 1.0), ((1, 2), (1, 9), 18.0)]


@pytest.mark.parametrize(("x", "gradient", "expected"), [*INSIDE, *LOW, *HIGH])
def test_a_gradient_that_pushes_against_a_bound_does_not_count(x, gradient, expected):
    found = max_abs_projected_gradient(
        np.array(x), np.array(gradient), np.zeros(2), np.full(2, 2.0), np.array([1.0, 2.0])
    )
    assert found == expected


def test_a_recorder_keeps_points_as_they_were_and_tells_them():
    told, x = [], np.array([1.0])
    recorder = AcceptedIterateRecorder(told.append)
    recorder.n_evaluations = 3
    recorder.record_iterate(9.0, x, 0.5, "first")
    x[0] = 2.0
    recorder.record_iterate(8.0, x, 0.25)
    first, second = recorder.history
    assert told == [first, second]
    assert (first.iteration, first.cost, first.x[0], first.gradient_norm, first.n_evaluations) == (0, 9.0, 1.0, 0.5, 3)
    assert (first.note, second.note, second.iteration) == ("first", "", 1)
    assert 0 <= first.seconds <= second.seconds < 5


def misfit(cost_at):
    """Rows whose chi2 per degree of freedom at x is that of a function of x; ten of them, one unknown."""

    def rows(x, duration):
        chi2 = cost_at(float(x[0]))
        return None if chi2 is None else (math.sqrt(0.9 * chi2) * (-1.0) ** np.arange(10), np.ones((10, 1)))

    return rows


def starts(solver):
    return [start for start, _ in solver.runs]


def test_a_good_fit_is_not_started_again():
    solver = Steps([[1.0], [2.0]])
    solution = fit_problem(MadeUp(misfit(lambda x: 4.9)), solver)
    assert solver.runs == [([1.0], 10.0)]
    assert (solution.status, solution.message, solution.solver_name) == (Status.CONVERGED, "run 1", "made_up")
    assert (solution.n_iterations, solution.n_evaluations) == (1, 2)
    assert solution.goodness_of_fit.chi2_per_dof == pytest.approx(4.9)
    assert solution.cost == pytest.approx(0.5 * 9 * 4.9)


@pytest.mark.parametrize(
    ("chi2_at", "tried", "kept", "message"),
    [
        ({1.0: 9.0, 4.0: 7.0, 2.0: 6.0, 10.0: 8.0}, [1.0, 4.0, 2.0, 10.0], 2.0, "run 3 (best of 4 starts)"),
        ({1.0: 9.0, 4.0: 4.0}, [1.0, 4.0], 4.0, "run 2 (best of 2 starts)"),
        (dict.fromkeys((1.0, 4.0, 2.0, 10.0), 5.5), [1.0, 4.0, 2.0, 10.0], 1.0, "run 1 (best of 4 starts)"),
    ],
    ids=["the best is kept", "the first good fit ends it", "the first of equals"],
)
def test_a_poor_fit_is_started_again_from_multiples_of_the_start(chi2_at, tried, kept, message):
    solver, told = Steps(), []
    solution = fit_problem(MadeUp(misfit(chi2_at.get)), solver, callback=told.append)
    assert starts(solver) == [[x] for x in tried]
    assert (solution.x.tolist(), solution.message) == ([kept], message)
    notes = [f"start {n} of at most 4: initial values times {x:g}" for n, x in enumerate(tried[1:], 2)]
    assert [entry.note for entry in solution.history] == [entry.note for entry in told] == ["", *notes]
    assert (solution.n_evaluations, solution.n_iterations) == (len(tried), len(tried) - 1)


@pytest.mark.parametrize(("far", "kept"), [(0.9, 100.0), (8.5, 4.0)], ids=["better than all fits", "worse than a fit"])
def test_a_start_far_away_is_tried_where_its_prediction_is_better_than_every_fit(far, kept):
    solver = Steps()
    at = {1.0: 9.0, 4.0: 7.0, 2.0: 8.0, 10.0: 8.0, 30.0: 20.0, 100.0: far}
    assert fit_problem(MadeUp(misfit(at.get)), solver).x.tolist() == [kept]
    assert starts(solver)[4:] == ([[100.0]] if kept == 100.0 else [])


def test_a_fit_is_left_alone_where_that_is_asked_for_or_the_cost_says_nothing_of_noise():
    solver = Steps()
    assert fit_problem(MadeUp(misfit(lambda x: 9.0)), solver, restarts=False).message == "run 1"
    assert starts(solver) == [[1.0]]
    solver = Steps()
    assert fit_problem(MadeUp(misfit(lambda x: 99.0), weighting="paper", noise=1.0), solver).message == "run 1"
    assert len(solver.runs) == 1


def test_a_failed_fit_is_started_again_and_loses():
    at = {1.0: None, 4.0: 3.0}
    solver = Steps()
    solver.needs_rollout = False
    solution = fit_problem(MadeUp(misfit(at.get), count=10), solver)
    assert solution.x.tolist() == [4.0]
    assert solution.evaluation is not None


UPPER = {"upper": 3.0}
BOUNDED = [(UPPER, None, [1, 3, 2, 3]), (UPPER, [0.5], [0.5, 2, 1, 3]), (UPPER, [7.0], [3] * 4)]


@pytest.mark.parametrize(("bounds", "given", "tried"), [*BOUNDED, ({"lower": -5.0}, None, [1] * 4)])
def test_new_starts_stay_within_bounds_and_move_positive_unknowns_only(bounds, given, tried):
    solver = Steps()
    fit_problem(MadeUp(misfit(lambda x: 9.0), (1.0,), **bounds), solver, given)
    assert starts(solver) == [[x] for x in tried]


def test_a_fit_that_cannot_be_evaluated_has_failed():
    solution = fit_problem(MadeUp(misfit({1.0: 2.0}.get)), Steps([[9.0]], [[9.0]], [[9.0]], [[9.0]]))
    assert (solution.status, solution.message, solution.evaluation) == (Status.FAILED, "it snaps", None)
    assert solution.cost == math.inf
    assert replace(solution, history=()).n_iterations == 0
    assert math.isnan(solution.goodness_of_fit.chi2_per_dof)
    paper = MadeUp(misfit({1.0: 2.0, 4.0: 2.0}.get), weighting="paper")
    solver = Steps([[9.0]])
    assert fit_problem(paper, solver).status == Status.CONVERGED
    assert len(solver.runs) == 2, "the published cost is started again as well where it failed"


def test_the_end_is_evaluated_where_the_solver_found_its_equilibria_and_has_deviations():
    problem = MadeUp(misfit(lambda x: 1.0))
    fit_problem(problem, Steps([[2.0]]))
    x, derivatives, warm = next(asked for asked in reversed(problem.asked) if asked[1])
    assert (x.tolist(), derivatives, warm) == ([2.0], True, "warm")
    problem = MadeUp(linear(np.eye(2), [-1.0, -2.0]), (4.0, 50.0), fixed=(7.0,))
    solution = fit_problem(problem, Steps([[1.0, 2.0]]))
    assert solution.std == {"k1": pytest.approx(1.0), "k0": pytest.approx(1.0)}


def reaching(limit):
    """Rows that can be worked out up to so many seconds for a value; the longest recording has ten."""

    def rows(x, duration):
        if duration > limit(float(x[0])) + 1e-9:
            return None
        return np.full(10, 0.1), np.ones((10, 1))

    return rows


def test_a_start_that_fails_is_approached_over_longer_and_longer_horizons():
    # every run takes the value further, by which the rollout holds longer
    limits = {1.0: 1.3, 2.0: 1.3, 3.0: 4.9, 4.0: 6.0, 5.0: 10.0}
    solver = Steps([[1.5], [2.0]], [[3.0]], [[4.0]], [[5.0]], [[5.0]])
    told = []
    problem = MadeUp(reaching(lambda x: limits.get(x, 0.0)), count=10)
    solution = fit_problem(problem, solver, callback=told.append)
    runs = [([1.0], 0.6), ([2.0], 1.2), ([3.0], 2.5), ([4.0], 5.0), ([5.0], 10.0)]
    assert [(start, pytest.approx(duration)) for start, duration in solver.runs] == runs
    notes = ["first 0.6 s", "first 0.6 s", "first 1.2 s", "first 2.5 s", "first 5 s", ""]
    assert [entry.note for entry in solution.history] == notes
    assert (solution.n_evaluations, len(told)) == (6, 6)


def test_horizons_that_fail_are_skipped_and_the_rest_is_left_out_once_the_whole_holds():
    limits = {1.0: 1.0, 2.0: 10.0}
    solver = Steps([[2.0]], [[2.0]])
    fit_problem(MadeUp(reaching(lambda x: limits.get(x, 10.0)), count=10), solver)
    assert [(start, pytest.approx(duration)) for start, duration in solver.runs] == [([1.0], 0.6), ([2.0], 10.0)]


@pytest.mark.parametrize("needs", [True, False])
def test_a_solver_that_needs_no_rollout_is_not_given_shorter_horizons(needs):
    solver = Steps([[1.0]], [[1.0]], [[1.0]], [[1.0]], [[1.0]])
    solver.needs_rollout = needs
    solution = fit_problem(MadeUp(reaching(lambda x: 0.7), weighting="paper", count=10), solver)
    assert len([duration for _, duration in solver.runs if duration == 10.0]) == 4
    assert (len(solver.runs) > 4) is needs
    assert isinstance(solution, Solution)


@pytest.fixture(autouse=True)
def weighted_as_made_up_problems_say(monkeypatch):
    for name in ("problem_with_whitening_at", "problem_with_sensor_noise_only"):
        monkeypatch.setattr(base, name, lambda problem, *at, name=name, **how: getattr(problem, name)(*at, **how))


class Disturbed(MadeUp):
    """A problem whose weights are frozen where it is asked for them; remembers where that was."""

    def __init__(self, *arguments, asked=None, about=None, **more):
        super().__init__(*arguments, **more)
        self.has_process_noise, self.frozen, self._about = True, [] if asked is None else asked, about

    def problem_with_whitening_at(self, x, warm=None, predictions=(), keep_weights=False):
        self.frozen.append((np.asarray(x).tolist(), keep_weights))
        rows = self._rows if self._about is None else self._about(float(x[0]))
        made = Disturbed(rows, self.initial_unknowns, asked=self.frozen, about=self._about)
        made.frozen_at = np.asarray(x).tolist()
        return made


class Carrying(Steps):
    """A method that weighs residuals by noise that drives the motion."""

    uses_process_noise_covariance = True


def test_weights_are_renewed_after_every_step_and_gains_kept_after_short_ones():
    solver = Carrying([[0.5], [1.0]])
    problem = Disturbed(linear(np.eye(1), [-2.5]))
    told = []
    solution = fit_problem(problem, solver, callback=told.append, restarts=False)
    assert [entry.note for entry in told] == ["", "", *(f"weighting {k} of at most 16" for k in (2, 3, 4))]
    assert starts(solver) == [[1.0]]
    assert [at[0] for at, _ in problem.frozen] == pytest.approx([1.0, 1.0, 2.0, 2.5])
    assert [kept for _, kept in problem.frozen] == [False, False, False, True]
    assert solution.x.tolist() == pytest.approx([2.5])
    assert solution.problem.frozen_at == solution.x.tolist()
    assert solution.n_evaluations == 7
    assert "ignore noise of the torques" not in solution.message


def overshooting(frozen):
    """Rows whose minimum under frozen weights is as far behind the optimum 2.5 as they are frozen before it."""

    def rows(x, duration):
        d, near = x[0] - frozen, 1e-3
        bent, slope = d**3 / (d**2 + near**2), (d**4 + 3 * d**2 * near**2) / (d**2 + near**2) ** 2
        return 10 * np.array([x[0] - 2.5 - bent / 2]), 10 * np.array([[1 - slope / 2]])

    return rows


def test_smoothed_errors_that_depend_on_the_unknowns_do_not_keep_a_fit_from_its_end():
    """Searches to their end under each weights would alternate between two points on both sides."""
    problem = Disturbed(overshooting(2.4), [2.4], about=overshooting)
    ends = [
        GaussNewton().minimize_cost(Disturbed(overshooting(at), [at]), np.array([at]), None).x[0] for at in (2.4, 2.6)
    ]
    assert ends == pytest.approx([2.6, 2.4], abs=1e-3)
    solution = fit_problem(problem, GaussNewton(), restarts=False)
    assert (solution.status, len(problem.frozen) < 5) == (Status.CONVERGED, True)
    assert solution.x[0] == pytest.approx(2.5, abs=1e-3)


def test_steps_that_alternate_are_shortened():
    """The derivative lacks what smoothed errors do, so that every whole step is twice the right one."""
    problem = Disturbed(lambda x, duration: (10 * (x - 2.5), np.array([[5.0]])), [2.48])
    solution = fit_problem(problem, Carrying(), restarts=False)
    assert (solution.status, len(problem.frozen)) == (Status.CONVERGED, 4)
    assert solution.x[0] == pytest.approx(2.5, abs=1e-6)


def test_weights_that_never_settle_are_renewed_a_limited_number_of_times():
    def moving(frozen):
        return linear(np.eye(1), [-frozen - 0.5])

    problem = Disturbed(moving(1.0), about=moving)
    solution = fit_problem(problem, Carrying([[1.0]]), restarts=False)
    assert len(problem.frozen) == 16
    assert solution.status == Status.ITERATION_LIMIT
    assert "the last of 15 linearizations moved the unknowns by 0.5 std" in solution.message


def test_a_long_step_that_raises_the_cost_is_left_to_the_solver():
    def rows(x, duration):
        return np.array([100 * np.arctan(x[0] - 14)]), np.array([[100 / (1 + (x[0] - 14) ** 2)]])

    solver = Carrying([[10.0]], [[13.9]])
    solution = fit_problem(Disturbed(rows, [10.0]), solver, restarts=False)
    assert starts(solver) == [[10.0], [10.0]]
    assert solution.x[0] == pytest.approx(14.0, abs=1e-3)


def test_a_search_can_be_stopped_between_weights():
    def stop(entry):
        if entry.note.startswith("weighting 3"):
            raise base.StopSearch("enough")

    solution = fit_problem(Disturbed(linear(np.eye(1), [-9.5])), Carrying([[1.0]]), callback=stop)
    assert (solution.x.tolist(), solution.message) == ([2.0], "enough")


@pytest.mark.parametrize(
    ("slope", "target", "tried"),
    [(20.0, 2.5, False), (0.12, 2.5, True), (0.08, 2.5, False), (1e4, 0.01, True), (1e4, 0.03, False)],
    ids=["well known", "loosely known", "not informed", "nearly vanished", "small and well known"],
)
def test_beside_noise_that_drives_the_motion_doubtful_estimates_have_another_start(slope, target, tried):
    """A start four times as large, with weights of its own."""
    there = [[1.0], [target]]
    solver = Carrying(there, [[4.0], [target]])
    solution = fit_problem(Disturbed(linear(slope * np.eye(1), [-slope * target])), solver)
    assert ([4.0] in [start for start, _ in solver.runs]) is tried
    assert ("best of 2 starts" in solution.message) is tried
    calm = Carrying(there, [[4.0], [target]])
    fit_problem(MadeUp(linear(slope * np.eye(1), [-slope * target])), calm)
    assert [4.0] not in [start for start, _ in calm.runs]


def test_another_start_of_gauss_newton_is_weighed_anew_only_where_it_leads_elsewhere():
    """Weights of the best fit tell that a start four times as large leads to the same minimum."""
    problem = Disturbed(linear(2.0 * np.eye(1), [-5.0]))
    found = fit_problem(problem, GaussNewton())
    assert "(best of 2 starts)" in found.message
    assert found.x.tolist() == pytest.approx([2.5])
    assert [at[0] for at, _ in problem.frozen] == pytest.approx([1.0, 2.5], rel=1e-3)


class Coarse(Carrying):
    """A method whose other starts are first followed to coarse tolerances; it reports the costs."""

    with_coarse_tolerances = property(lambda self: self)

    def minimize_cost(self, problem, start, callback):
        def priced(entry):
            return replace(entry, cost=problem.evaluate(entry.x).cost)

        found = super().minimize_cost(problem, start, callback and (lambda entry: callback(priced(entry))))
        return replace(found, history=tuple(map(priced, found.history)))


@pytest.mark.parametrize(
    ("other", "gain", "tolerance", "weighed"),
    [(2.6, 0.0, 0.0, False), (2.6, 0.01, 0.0, True), (2.6, 0.01, 1.0, False), (3.6, 0.01, 1.0, True)],
    ids=["no better", "better", "better by less than the solver's tolerance", "in another minimum"],
)
def test_another_start_is_weighed_anew_where_it_gains_more_than_the_solver_can_tell(other, gain, tolerance, weighed):
    """The standard deviation is 0.5; the first search ends at 2.4, where the cost is 0.02."""

    def rows(x, duration):
        least, cost = (2.4, 0.02) if x[0] < 2.5 else (other, 0.02 - gain)
        return np.array([2 * (x[0] - least), math.sqrt(2 * cost)]), np.array([[2.0], [0.0]])

    problem = Disturbed(rows)
    solver = Coarse([[1.0], [2.4]], [[4.0], [other]], [[other]])
    solver.cost_tolerance = tolerance
    solution = fit_problem(problem, solver)
    assert [at for at, _ in problem.frozen[2:]] == ([[other], [other]] if weighed else [])
    assert solution.x.tolist() == [other if weighed else 2.4]


def test_another_start_is_given_up_as_soon_as_it_is_in_the_bowl_of_the_best_fit():
    """Its end would be reached at 2.5, a standard deviation is 0.5."""
    solver = Coarse([[1.0], [2.5]], [[4.0], [3.6], [3.4], [3.0]])
    solution = fit_problem(Disturbed(linear(2.0 * np.eye(1), [-5.0])), solver)
    assert [entry.x[0] for entry in solution.history] == [1.0, 2.5, 2.5, 4.0, 3.6, 3.4]
    assert solution.x.tolist() == [2.5]


def test_beside_such_noise_a_fit_that_explains_nothing_is_started_again_nearby():
    """The valley of x = 2 and the one of x = 2.5 lie on two sides of a ridge."""

    def rows(x, duration):
        chi2 = 1.0 if x[0] > 2.3 else 4.9
        return math.sqrt(0.9 * chi2) * (-1.0) ** np.arange(10), 1e3 * np.ones((10, 1))

    there = [[1.0], [2.0]]
    solver = Carrying(there, [[2.5], [2.5]])
    solution = fit_problem(Disturbed(rows), solver)
    assert [2.5] in [start for start, _ in solver.runs]
    assert (solution.x.tolist(), solution.goodness_of_fit.explains) == ([2.5], True)
    assert "(best of 2 starts)" in solution.message
    notes = {entry.note for entry in solution.history}
    assert notes == {"", "weighting 2 of at most 16", "start 2 of at most 3: best fit times 1.25"}
    poor = Carrying(there, [[2.5], [2.1]], [[3.2], [2.2]])
    solution = fit_problem(Disturbed(rows), poor)
    assert "(best of 3 starts)" in solution.message
    assert [3.2] in [start for start, _ in poor.runs]
    assert "best of" not in fit_problem(Disturbed(rows), Carrying(there), restarts=False).message


def test_a_method_that_cannot_carry_the_noise_says_so_and_runs_once():
    solver = Steps([[1.0], [2.0]], [[3.0]])
    problem = Disturbed(linear(np.eye(1), [-2.0]))
    solution = fit_problem(problem, solver)
    assert len(solver.runs) == 1
    assert problem.frozen == []
    assert solution.problem is problem
    assert ("ignore noise of the torques" in solution.message, solution.message[:7]) == (True, "run 1. ")


def test_a_recording_that_its_torques_as_they_are_cannot_follow_has_the_reason_in_place_of_a_prediction():
    """Weights are about smoothed torques, which may be followed where the recorded ones are not."""
    smoothed = SimpleNamespace(ok=True, equilibrium_guesses="warm", episode_predictions=("smoothed a", "smoothed b"))

    def run(episode, theta, offset, derivatives):
        assert (theta, offset, derivatives) == (f"theta {episode}", "offset", False)
        return f"{episode} falls" if episode == "b" else {"episode": episode}

    def known(ok):
        found = SimpleNamespace(ok=ok, episode_predictions=("plain a", "plain b") if ok else ())
        how = {
            "unpack_episode_unknowns": lambda x, i: (f"theta {'ab'[i]}", "offset"),
            "evaluate": lambda x, derivatives, warm: found,
        }
        plain = SimpleNamespace(episodes=("a", "b"), predictor=SimpleNamespace(predict_episode=run), **how)
        return SimpleNamespace(has_process_noise=True, problem_with_sensor_noise_only=lambda: plain)

    fitted = fit_problem(MadeUp(misfit(lambda x: 1.0)), Steps())
    assert replace(fitted, evaluation=smoothed, problem=known(True)).episode_predictions == ("plain a", "plain b")
    lost = replace(fitted, evaluation=smoothed, problem=known(False)).episode_predictions
    assert lost == ({"episode": "a"}, "b falls")
    calm = SimpleNamespace(has_process_noise=False)
    assert replace(fitted, evaluation=smoothed, problem=calm).episode_predictions == ("smoothed a", "smoothed b")
    assert replace(fitted, evaluation=None, problem=calm).episode_predictions == ()


TIMES = np.arange(0.0, 2.0, 1 / 3)
NOISE = 0.35
# frequencies of 1.8 and 1.2 Hz, seen three times a second, are told apart only by what decays beside them
TRUE, ALIAS = 1.8**2, 1.2**2


def ringing(x, horizon):
    """A branch of stiffness k rings at sqrt(k); its swing dies down faster the stiffer it is."""
    k, kept = x[0], horizon + 1e-9 >= TIMES
    t = TIMES[kept]

    def swing(value):
        return np.exp(-0.15 * value * t) * np.cos(2 * np.pi * np.sqrt(value) * t)

    step = 1e-6 * k
    slope = (swing(k + step) - swing(k - step)) / (2 * step)
    return (swing(k) - swing(TRUE)) / NOISE, slope[:, None] / NOISE


def test_a_search_that_ends_in_the_wrong_valley_goes_on_from_the_other(monkeypatch):
    problem = MadeUp(ringing, [1.3], duration=2.0)
    problem.has_process_noise = True
    monkeypatch.setattr(base, "problem_with_whitening_at", lambda problem, x, *_, **how: problem)
    # no other reason to start again
    monkeypatch.setattr(base, "_good_fit", lambda *_: True)
    monkeypatch.setattr(base, "_doubtful", lambda *_: np.zeros(1, bool))
    monkeypatch.setattr(base, "_NEARBY_START_FACTORS", ())
    alone = fit_problem(problem, GaussNewton(max_iterations=40), restarts=False)
    assert alone.x[0] == pytest.approx(ALIAS, rel=0.15), "by itself it stays with the alias"
    found = fit_problem(problem, GaussNewton(max_iterations=40))
    assert found.x[0] == pytest.approx(TRUE, rel=1e-3)
    assert any(step.note.endswith(": another local minimum") for step in found.history)


def with_weak_prior(target, std=0.1, start=3.0):
    """One stiffness that the data want at a value, with the weak prior of a problem."""

    def rows(x, duration):
        value, slope = weak.residual_and_jacobian(x)
        return np.concatenate([(x - target) / std, value]), np.array([[1 / std], slope[0]])

    weak = PriorResiduals(np.array([start]), np.zeros((0, 1)), np.zeros(0), np.arange(1), math.log(10.0))
    return MadeUp(rows, (start,), weak=1)


def test_an_unknown_clipped_to_its_bound_at_zero_comes_back():
    found = GaussNewton().minimize_cost(with_weak_prior(2.0), np.zeros(1), None)
    assert found.status == Status.CONVERGED
    assert found.x[0] == pytest.approx(2.0, abs=1e-2)


def edge(limit, weak=10.0):
    """A weakly informed unknown drawn to 2 beside a well informed one; beyond a limit nothing can be predicted."""

    def rows(x, duration):
        return None if x[0] > limit else (np.array([weak * (x[0] - 2.0), 1e3 * x[1]]), np.diag([weak, 1e3]))

    return MadeUp(rows, (1.0, 1.0), lower=-np.inf)


def test_a_rejected_step_is_followed_by_one_that_is_shorter_along_what_is_weakly_informed_too():
    problem = edge(1.2)
    GaussNewton().minimize_cost(problem, np.array([1.0, 0.0]), None)
    tried = [x[0] - 1.0 for x, *_ in problem.asked[1:5]]
    accepted = next(i for i, moved in enumerate(tried) if moved <= 0.2)
    assert tried[0] == pytest.approx(1.0, rel=0.02)
    assert accepted == 1
    assert tried[accepted] >= 0.02
    assert [has_slopes for _, has_slopes, _ in problem.asked[1:4]] == [True, False, True]


def test_the_step_after_a_rejected_one_is_as_long_as_that_suggests_whatever_the_damping(monkeypatch):
    problem = edge(1.2, weak=0.1)
    monkeypatch.setattr("yid_ocp.solvers.gradient_methods._INITIAL_DAMPING", 1e-12)
    GaussNewton().minimize_cost(problem, np.array([1.0, 0.0]), None)
    assert 0.05 < problem.asked[2][0][0] - 1.0 <= 0.25


def test_at_the_edge_of_what_can_be_predicted_the_search_stalls_soon():
    found = GaussNewton().minimize_cost(edge(1.0), np.array([1.0, 0.0]), None)
    assert found.status == Status.STALLED
    assert "it snaps" in found.message
    assert found.n_evaluations <= 10


def test_a_short_step_beside_a_steep_row_is_no_end():
    """A row of slope 1e9 allows no step but a short one; the cost falls along it all the same."""

    def rows(x, duration):
        wall = 1e9 * (x[1] - 1e-9 * (x[0] - 3.0))
        return np.array([10 * (x[0] - 1.0), wall]), np.array([[10.0, 0.0], [-1.0, 1e9]])

    problem = MadeUp(rows, (3.0, 1.0), lower=-np.inf)
    assert not is_stationary_point(problem, np.array([3.0, 0.0]), problem.evaluate([3.0, 0.0]))
    end = np.array([1.0, -2e-9])
    assert is_stationary_point(problem, end, problem.evaluate(end))
    found = GaussNewton(max_iterations=3).minimize_cost(problem, np.array([3.0, 0.0]), None)
    assert found.status != Status.CONVERGED


# pushed against its bound an unknown is at its end
ENDS, NO_ENDS = [(1.0, 0.0), (1.0, 0.1), (0.0, 5.0), (9.0, -5.0)], [(1.0, 0.2), (0.0, -5.0), (9.0, 5.0)]


@pytest.mark.parametrize(("at", "expected"), [*((at, True) for at in ENDS), *((at, False) for at in NO_ENDS)])
def test_a_point_is_an_end_where_no_step_within_the_bounds_promises_much(at, expected):
    x, residual = np.array([at[0], 1.0]), np.array([at[1], 0.0])
    problem = MadeUp(lambda at, duration: (residual, np.eye(2)), (1.0, 1.0), upper=9.0, count=2)
    assert is_stationary_point(problem, x, problem.evaluate(x)) is expected


@pytest.mark.parametrize(
    ("size", "slope", "residual", "expected"),
    [
        *((100.0, [[0.01]], [-5.0], False), (1.0, [[10.0]], [-0.5], False)),
        *((1.0, [[1e-3]], [-5.0], True), (1e-3, [[10.0]], [-0.5], True), (1.0, [[1e-9]], [50.0], True)),
        (1.0, [[1.0], [0.0]], [1.0, 100.0], True),  # a small part of the cost
    ],
)
def test_no_step_longer_than_the_unknowns_size_counts(size, slope, residual, expected):
    problem = MadeUp(linear(slope, residual), lower=-np.inf, scales=(size,))
    assert is_stationary_point(problem, np.zeros(1), problem.evaluate([0.0])) is expected


def test_a_step_does_not_depend_on_the_unit_of_the_residual():
    jacobian, residual = np.array([[1.0, 2.0], [0.5, -1.0], [0.0, 1.0]]), np.array([3.0, -1.0, 0.5])
    open_ends = np.full(2, -np.inf), np.full(2, np.inf)
    plain, small = (bounded_levenberg_marquardt_step(c * jacobian, c * residual, 0.1, *open_ends) for c in (1.0, 1e-3))
    np.testing.assert_allclose(small, plain)
    damped = jacobian.T @ jacobian + 0.1 * 6.0 * np.eye(2)  # the second column is the larger one
    np.testing.assert_allclose(plain, -np.linalg.solve(damped, jacobian.T @ residual))


@pytest.mark.parametrize(("pull", "expected"), [(9.0, -0.1), (-9.0, 0.2), (0.05, -0.05)])
def test_a_step_ends_at_the_bounds(pull, expected):
    problem = MadeUp(linear([[1.0]], [0.0]), (0.5,), lower=0.4, upper=0.7, scales=(0.01,))
    step = size_limited_damped_step(problem, np.array([0.5]), np.eye(1), np.array([pull]), 1e-14)
    assert step[0] == pytest.approx(expected)


def test_the_promise_of_a_step_is_the_fall_of_a_linear_models_cost_and_nothing_without_unknowns():
    jacobian, residual, step = np.array([[1.0, 2.0], [0.5, -1.0]]), np.array([3.0, -1.0]), np.array([0.2, -0.4])
    after = residual + jacobian @ step
    fall = 0.5 * (residual @ residual - after @ after)
    assert predicted_cost_reduction_by_step(jacobian, residual, step) == pytest.approx(fall)
    none = MadeUp(linear(np.zeros((2, 0)), [3.0, 3.0]), ())
    assert is_stationary_point(none, np.zeros(0), none.evaluate(np.zeros(0)))


def test_a_method_that_stops_short_has_not_converged_whatever_it_says():
    problem = MadeUp(linear([[1.0], [1.0]], [-3.0, -3.0]), (1.0,))
    stopped = fit_problem(problem, Steps([[2.0]]))
    assert stopped.status == Status.STALLED
    assert "stopped where the cost still falls (run 1)" in stopped.message
    assert fit_problem(problem, Steps([[3.0]])).status == Status.CONVERGED
    limited = fit_problem(problem, Steps([[2.0]], status=Status.ITERATION_LIMIT))
    assert (limited.status, limited.message) == (Status.ITERATION_LIMIT, "run 1")


def failing_beyond(limit):
    return lambda x, duration: None if duration > limit and x[0] < 2 else (np.full(10, 0.1), np.zeros((10, 1)))


def test_a_horizon_too_short_for_a_filter_is_left_out():
    problem = MadeUp(failing_beyond(3.0), count=10)
    prepared = problem.with_options

    def shortened(options):
        if options.duration < 2.0:
            raise DataError("0.6 s of efforts are too short for a low-pass filter of 8 Hz", hint="")
        return prepared(options)

    problem.with_options = shortened
    solver = Steps([[2.0]], [[2.0]])
    solution = fit_problem(problem, solver)
    assert [duration for _, duration in solver.runs] == [2.5, 10.0]
    assert solution.status == Status.CONVERGED


def test_another_start_that_cannot_even_begin_loses_nothing():
    class Fragile(Steps):
        def minimize_cost(self, problem, start, callback):
            if start[0] > 3.0:
                raise SolverError("no transcription from here", hint="")
            return super().minimize_cost(problem, start, callback)

    problem = MadeUp(lambda x, duration: (9.0 * (-1.0) ** np.arange(10), np.ones((10, 1))))
    solution = fit_problem(problem, Fragile())
    assert (solution.status, solution.x.tolist()) == (Status.CONVERGED, [1.0])


def winding(steepness, pull, wound=40.0, size=0.2):
    """A pull towards 1 along a valley that winds: steps are short, and the linear model promises all of the pull."""

    def rows(x, duration):
        bend = wound * x[0]
        residual = np.array([steepness * (x[1] - np.sin(bend) / wound), pull * (x[0] - 1.0), 3.0])
        return residual, np.array([[-steepness * np.cos(bend), steepness], [pull, 0.0], [0.0, 0.0]])

    return MadeUp(rows, (size, size), lower=-np.inf)


def test_steps_that_are_worth_nothing_beside_the_noise_are_an_end():
    """The pull is worth 0.4 of a standard deviation; a hundredth of it is gained in twenty steps."""
    problem = winding(1e4, 0.4, size=1.0)
    found = fit_problem(problem, GaussNewton(max_iterations=100), initial_unknowns=[0.0, 0.0], restarts=False)
    assert found.status == Status.CONVERGED
    assert found.n_iterations == 20
    assert "moved no estimated value by more than a tenth of its standard deviation" in found.message


@pytest.mark.parametrize(("steepness", "pull"), [(1e4, 2.5), (1e2, 1.5)], ids=["worth more", "quick enough"])
def test_what_is_worth_a_standard_deviation_or_is_gained_is_none(steepness, pull):
    found = GaussNewton(max_iterations=25).minimize_cost(winding(steepness, pull, size=1.0), np.zeros(2), None)
    assert not found.stopped_at_noise_level
