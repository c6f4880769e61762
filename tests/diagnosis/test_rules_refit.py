"""Refits: when one is tried again, how sure its values are, and how badly held-out recordings are predicted."""

import importlib
import math
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
import scipy
from factories import amplitude, cases, costing, effect, evaluation, fit, loss, measurements, shape
from heard import Heard

from yid_ocp.diagnosis.refit import (
    RefitContext,
    StoredFit,
    _effect_p_values,
    refit_with_each_effect,
    refit_with_effects,
)
from yid_ocp.diagnosis.thresholds import Thresholds
from yid_ocp.errors import SolverError
from yid_ocp.inference.null_test import held_out_loss
from yid_ocp.problem.options import ProblemOptions
from yid_ocp.solvers import Status

# the package's own name `refit_with_effects` is the function
module = importlib.import_module("yid_ocp.diagnosis.refit")
diagnosing = importlib.import_module("yid_ocp.diagnosis.diagnose")
LIMITS = Thresholds()
FRICTION = effect("friction@elbow", amplitude(neutral=0.25), shape("s", neutral=0.5))
A, S = "friction@elbow.a", "friction@elbow.s"
CERTAIN = np.zeros((1, 1))
TWO_RECORDINGS = SimpleNamespace(
    problem=SimpleNamespace(episodes=["first", "second"], system=SimpleNamespace(effects=range(200))),
    with_step_of_only_effects=lambda group: [effect.label for effect in group],
)


class Problem:
    """A problem of one nominal parameter, an initial state and an effect, whose cost is a function of named values."""

    def __init__(self, cost, rows=10, names=("k", "k[run]", "start.q.k[run]", A, S)):
        self.cost, self.rows, self.unknown_names = cost, rows, names
        self.asked, self.warmed, self.at, self.foreseen = [], [], [], []
        self.freed, self.whitening_filters, self.has_process_noise = None, (), False
        self.step, self.held_out_spread = SimpleNamespace(time_step=0.01), np.zeros((0, 0))

    @property
    def problem(self):
        return self

    unknowns = problem

    def problem_with_nominal_and_effects_free(self, effects):
        self.freed = tuple(effects)
        return self

    def problem_with_effects_and_relinearized_filters(self, effects, at):
        self.at.append(self.named_values(self.pack_unknowns(at)))
        return self.problem_with_nominal_and_effects_free(effects)

    def relinearize_held_out_filters_of_problem(self, own, effects, at):
        assert own is self
        self.foreseen.append(dict(at))
        return self

    def pack_unknowns(self, values):
        return np.array([values.get(name, 1.0) for name in self.unknown_names])

    def named_values(self, x):
        return dict(zip(self.unknown_names, map(float, x), strict=True))

    def evaluate(self, x, derivatives=True, equilibrium_guesses=None):
        self.asked.append(self.named_values(x))
        self.warmed.append(equilibrium_guesses)
        cost = self.cost(self.named_values(x))
        if cost is None:
            return evaluation([], ok=False, message="it snaps")
        return costing(cost, self.rows)


@pytest.fixture
def solved(monkeypatch):
    """Solvers that go nowhere, every std one tenth; `runs` are the solvers' starts, `losses` what was judged."""
    made = SimpleNamespace(runs=[], failed=[], losses=[], known=None, status=Status.CONVERGED, limited=[])

    def run(problem, x, callback, evaluate=None):
        values = problem.named_values(x)
        failed = problem.cost(values) is None
        (made.failed if failed else made.runs).append(values)
        status = Status.FAILED if failed else Status.ITERATION_LIMIT if made.limited else made.status
        usual = {"message": "done", "equilibrium_guesses": "there", "evaluation": made.known}
        usual["history"] = [SimpleNamespace(cost=cost) for cost in (made.limited.pop(0) if made.limited else ())]
        return SimpleNamespace(x=np.asarray(x), status=status, **usual)

    def held_out(problem, x, evaluation, spread):
        assert spread is problem.held_out_spread
        made.losses.append(problem.named_values(x))
        return loss(1.5, 1.6)

    monkeypatch.setattr(Problem, "refit_solver", SimpleNamespace(minimize_cost=run), raising=False)
    monkeypatch.setattr(module.null_test, "held_out_loss", held_out)
    monkeypatch.setattr(module, "noise_only_covariance_sqrt", lambda problem, evaluation: evaluation)
    monkeypatch.setattr(
        module, "_refit_covariance_factor", lambda problem, finish, limits: 0.1 * np.eye(len(problem.unknown_names))
    )
    return made


def test_filters_are_about_the_torques_that_are_seen_at_the_start(solved):
    problem = Problem(lambda values: 1.0)
    refit_with_effects(RefitContext(problem), [FRICTION], {"k": 2.0, A: 3.0, S: 0.9})
    # and once more where it ended, which is the same
    assert problem.at == 2 * [{**problem.named_values(np.ones(5)), "k": 2.0, A: 3.0, S: 0.9}]


def test_held_out_recordings_are_seen_about_the_torques_where_the_run_ended(solved):
    problem, memory = Problem(lambda values: 7.0), {}
    found = refit_with_effects(RefitContext(problem, store=memory), [FRICTION], START, FRICTION.label)
    assert problem.foreseen == solved.losses == [found.values]
    refit_with_effects(RefitContext(problem, store=memory), [FRICTION], START, FRICTION.label)
    assert problem.foreseen == solved.losses == 2 * [found.values]


@pytest.mark.parametrize(("apart", "runs"), [(0.9, 1), (1.0, 2)])
def test_an_effect_that_takes_much_of_an_offset_is_fitted_once_more(solved, monkeypatch, apart, runs):
    monkeypatch.setattr(module.whitening, "max_torque_bias_change_in_stds", lambda before, after: apart)
    monkeypatch.setattr(module.whitening, "problem_relinearized_at_torque_bias", lambda problem, x, frozen: problem)
    refit_with_effects(RefitContext(Problem(lambda values: 1.0)), [FRICTION], {"k": 2.0, A: 3.0})
    assert len(solved.runs) == runs


START = {"k": 5.0, "k[run]": 6.0, "start.q.k[run]": 7.0, A: 0.75, S: 0.9}


def test_a_refit_is_evaluated_where_it_ended(solved):
    problem = Problem(lambda values: 7.0)
    found = refit_with_effects(RefitContext(problem), [FRICTION], START)
    assert solved.runs == solved.losses == [found.values] == [START]
    assert found.cost == pytest.approx(7.0)
    assert found.std == dict.fromkeys(problem.unknown_names, 0.1)
    assert found.effects == (FRICTION,)
    assert problem.warmed == ["there"], "the shape at rest is looked for where it was"
    solved.known = costing(3.0, 10)  # there are no filters to linearise anew
    assert refit_with_effects(RefitContext(problem), [FRICTION], START).cost == 3.0
    assert len(problem.asked) == 1


@pytest.mark.parametrize(
    ("costs", "runs"), [([[8.0, 4.1]], 1), ([[8.0, 3.9], [3.9, 2.0]], 2), ([[9.0, 8.7, 8.0, 7.0, 6.0, 5.0, 4.4]], 1)]
)
def test_a_run_that_halves_its_cost_within_five_steps_goes_on_at_its_limit(solved, costs, runs):
    solved.limited = costs
    refit_with_effects(RefitContext(Problem(lambda values: 7.0)), [FRICTION], START)
    assert len(solved.runs) == runs


@pytest.mark.parametrize(("largest", "drawn"), [(2.0, 2.25), (1.3, 1.25), (0.7, 0.65), (0.4, 0.35), (0.26, 0.25)])
def test_a_start_that_cannot_be_rolled_out_is_drawn_back_towards_the_neutral_effect(solved, largest, drawn):
    limit = 9.0 if largest == 2.0 else largest
    problem = Problem(lambda values: 5.0 if values[A] <= limit else None)
    found = refit_with_effects(RefitContext(problem), [FRICTION], {"k": 5.0, A: 2.25, S: 0.5})
    assert found.values[A] == pytest.approx(drawn)
    assert found.values["k"] == 5.0


def test_a_model_that_cannot_be_rolled_out_at_all_has_no_refit(solved):
    assert refit_with_effects(RefitContext(Problem(lambda values: None)), [FRICTION], START) is None
    assert solved.runs == []
    assert [run[A] for run in solved.failed] == pytest.approx([0.75, 0.5, 0.35, 0.275, 0.25])


def test_an_effect_is_judged_with_its_shape_held():
    # a weak spring: torque and stiffness are known well, the rest angle is their quotient
    names = ["k", A, S]
    jacobian = np.array([[1.0, 0.3, 0.2], [0.0, 8.0, 0.1], [0.0, 0.4, 0.01], [0.1, 0.0, 0.0]])
    held = np.linalg.inv(jacobian[:, :2].T @ jacobian[:, :2])[1, 1]
    for away in (0.1, 0.3):
        found = _effect_p_values([FRICTION], names, np.array([1.0, 0.25 + away, 9.0]), np.linalg.pinv(jacobian))
        assert found == {"friction@elbow": pytest.approx(math.erfc(away / np.sqrt(2 * held)), rel=1e-6)}


def test_amplitudes_are_judged_together_as_a_load_is_known_that_each_of_them_could_carry():
    """Where a direction is not informed at all too, of a std that would leave no digits of a covariance."""
    load, names = effect("load@x", *map(amplitude, "abc")), ["load@x.a", "load@x.b", "load@x.c"]
    axes = np.linalg.qr(np.array([[1.0, 1.0, 0.3], [1.0, -1.0, 0.2], [0.5, 0.1, 1.0]]))[0]
    factor = axes * [1e-3, 1e3, 1e8]
    along = {z: _effect_p_values([load], names, axes[:, 0] * z * 1e-3 + axes[:, 1], factor)["load@x"] for z in (1, 9)}
    assert along[1] == pytest.approx(scipy.special.chdtrc(3, 1.0), rel=1e-3)
    assert along[9] == pytest.approx(scipy.special.chdtrc(3, 81.0), rel=1e-3)
    assert _effect_p_values([load], names, axes[:, 2] * 1e7, factor)["load@x"] > 0.9


def test_another_place_is_tried_where_more_than_noise_is_left(solved, monkeypatch):
    # of ten samples chi2 is above 23.2 in one of a hundred, and costs are half of it
    monkeypatch.setattr(type(FRICTION), "alternative_start", lambda self, start: {A: -start[A]}, raising=False)
    for first, (cost, value) in {11.5: (11.5, 0.75), 11.7: (5.0, -0.75), None: (5.0, -0.75)}.items():
        there = {0.75: first, -0.75: 5.0}
        problem = Problem(lambda values, there=there: there.get(values[A]))
        found = refit_with_effects(RefitContext(problem), [FRICTION], {"k": 2.0, A: 0.75})
        assert (found.cost, found.values[A]) == (pytest.approx(cost), value)
    # a worse one is not taken
    there = {0.75: 20.0, -0.75: 21.0}
    found = refit_with_effects(
        RefitContext(Problem(lambda values: there.get(values[A], 30.0))), [FRICTION], {"k": 2.0, A: 0.75}
    )
    assert found.values[A] == pytest.approx(0.75)


@pytest.mark.parametrize(("status", "stairs"), [(Status.STALLED, 0.0), (Status.CONVERGED, 1.0)])
def test_a_stalled_search_needs_slopes_that_do_not_follow_each_stair_of_the_cost(solved, monkeypatch, status, stairs):
    slopes, known = np.array([[3.0, 1.0], [0.0, 2.0], [1.0, 0.0]]), []
    problem = Problem(lambda values: 99.0, names=(A, S))
    problem.bounds = np.array([0.76, -9.0]), np.array([9.0, 9.0])  # one end of the secants is cut off
    problem.evaluate = lambda x, *_, **how: evaluation(9 + slopes @ x + 1e-3 * np.sign(np.sin(1e4 * x[0])), slopes + 1)
    monkeypatch.setattr(module, "_refit_covariance_factor", lambda *a: known.append(a[1].jacobian) or 0.1 * np.eye(2))
    solved.status = status
    refit_with_effects(RefitContext(problem), [FRICTION], {A: 0.78, S: 0.5})
    np.testing.assert_allclose(known[-1], slopes + stairs, atol=0.05)


def test_a_stored_refit_is_evaluated_and_not_solved(solved):
    values, std = {**START, "k": 2.0}, dict.fromkeys(START, 0.3)
    store = {"friction@elbow at 0.01 s": StoredFit(values, std, {FRICTION.label: 0.2})}
    problem = Problem(lambda values: 5.0)
    found = refit_with_effects(RefitContext(problem, store=store), [FRICTION], START, FRICTION.label)
    assert solved.runs == []
    assert (found.values, found.std, found.p_values) == (values, std, {FRICTION.label: 0.2})
    assert found.p_values == {FRICTION.label: 0.2}
    assert found.cost == pytest.approx(5.0)
    assert solved.losses == [values]
    assert problem.freed == (FRICTION,)
    # another start, or another time step, is another refit
    assert refit_with_effects(RefitContext(problem, store=store), [FRICTION], START, "another").values == START
    problem.step.time_step = 0.005
    assert refit_with_effects(RefitContext(problem, store=store), [FRICTION], START, FRICTION.label).values == START
    assert [*store] == ["friction@elbow at 0.01 s", "another at 0.01 s", "friction@elbow at 0.005 s"]


def test_a_stored_refit_that_cannot_be_rolled_out_is_solved_again(solved):
    store = {"friction@elbow at 0.01 s": StoredFit({**START, A: 9.0}, START, {FRICTION.label: 0.2})}
    found = refit_with_effects(
        RefitContext(Problem(lambda values: 5.0 if values[A] < 9.0 else None), store=store),
        [FRICTION],
        START,
        FRICTION.label,
    )
    assert solved.runs == [found.values] == [START]
    assert store["friction@elbow at 0.01 s"].values == found.values


def test_all_are_refitted_from_the_fit_and_their_own_steps(solved, monkeypatch):
    asked, heard = [], Heard()
    other, third, lost = effect("offset@elbow"), effect("third@x"), effect("lost@x")

    def one(search, effects, start, name):
        asked.append((search.problem, [e.kind for e in effects], start, search.store, name, search.thresholds))
        left = math.inf if effects[-1] is lost else 1.2345
        return None if effects[-1] is third else fit(effects, loss(left, left))

    monkeypatch.setattr(module, "refit_with_effects", one)
    search = RefitContext(TWO_RECORDINGS, LIMITS, heard, "store")
    tried = [((FRICTION,), {A: 0.7}), ((other,), {"k": 3.0}), ((third,), {})]
    found = refit_with_each_effect(search, (effect("base@x"),), tried, {"k": 2.0})
    assert [f.effects[-1].kind for f in found] == ["friction", "offset"]
    by_kind, name = {kinds[-1]: (problem, kinds, *rest) for problem, kinds, *rest in asked}, "base@x and friction@elbow"
    # one step for all, without other candidates
    group = ["base@x", "friction@elbow", "offset@elbow", "third@x"]
    assert by_kind["friction"] == (group, ["base", "friction"], {"k": 2.0, A: 0.7}, "store", name, LIMITS)
    assert by_kind["offset"][2] == {"k": 3.0}
    assert [("base@x" in stage, "3 effects" in stage) for stage in heard.stages] == [(True, True)]
    both = [(f"base@x and {label}", "1.234") for label in ("friction@elbow", "offset@elbow")]
    assert (heard.table[0], sorted(heard.table[1:])) == (("effects", "held-out chi2/n"), both)
    told = sorted(text.removeprefix("held-out chi2/n with ") for done, _, text in heard.parts if done)
    best = "1.234 (best so far: 1.234)"
    assert told == [f"friction@elbow: {best}", f"offset@elbow: {best}", "third@x: failed"]
    assert refit_with_each_effect(search, (), [((lost,), {})], {}) == [], "it predicts no held-out recording"
    assert asked[3][0] is TWO_RECORDINGS, "a step for one refit costs more than it saves"
    # from elsewhere they have names of their own in the store
    refit_with_each_effect(search, (effect("base@x"),), tried, {}, "from there")
    assert sorted(name for *_, name, _ in asked[4:]) == [
        f"base@x and {label} from there" for label in ("friction@elbow", "offset@elbow", "third@x")
    ]


def test_where_the_model_with_all_candidates_fails_there_are_none(monkeypatch):
    snap = Mock(side_effect=SolverError("it snaps", where="model", hint=""))
    monkeypatch.setattr(module, "screen_candidates", snap)
    search = RefitContext(TWO_RECORDINGS, LIMITS, Heard(), n_batched=2)
    assert search.screen((FRICTION,), {A: 0.7}, "beside it").candidate_scores == ()
    assert list(search.record.screenings) == ["beside it"]


def test_within_a_limit_refits_begin_best_first_as_long_as_they_may_end(monkeypatch):
    """Of ten seconds each, one after the other: four begin within 35 s."""
    now, tried, batches = [0.0], [((effect(f"{kind}@x"),), {}) for kind in "abcdef"], []

    def one(search, effects, start, name):
        now[0] += 10.0
        left = 9.0 - ord(effects[-1].kind)
        return fit(effects, loss(left, left))

    def batched(function, entries, questions_per_item):
        assert questions_per_item == 2  # of each refit: one per recording
        batches.append([of.kind for (of,), _ in entries])
        return [function(entry) for entry in entries]

    monkeypatch.setattr(module, "time", SimpleNamespace(perf_counter=lambda: now[0]))
    monkeypatch.setattr(module, "refit_with_effects", one)
    monkeypatch.setattr(module, "map_with_merged_calls", batched)
    search, march = (
        RefitContext(TWO_RECORDINGS, LIMITS, Heard(), deadline=35.0, n_batched=2),
        [["a"], ["b"], ["c"], ["d"]],
    )
    found = refit_with_each_effect(search, (), tried, {})
    assert ([f.effects[-1].kind for f in found], batches, search.skipped) == ([*"abcd"], march, ["e@x", "f@x"])
    assert refit_with_each_effect(search, (), tried[:1], {}) == []
    assert [name for name, _ in search.progress.table[1:]] == ["d@x", "c@x", "b@x", "a@x"]
    # without one all march together, as ever
    batches.clear()
    search = RefitContext(TWO_RECORDINGS, LIMITS, Heard(), n_batched=2)
    assert len(refit_with_each_effect(search, (), tried, {})) == 6
    assert batches == [[*"abcdef"]]


def episode(name="other", steps=100, time_step=0.01, of=()):
    grid = SimpleNamespace(steps=steps, time_step=time_step)
    return SimpleNamespace(name=name, grid=grid, measurements=tuple(of))


def measured(times, value, weight, time_step=0.01):
    t = np.asarray(times) / time_step
    node = np.floor(t + 1e-9).astype(int)
    return measurements(["a", "b"], node, t - node, value, weight)


@pytest.fixture
def predicting(monkeypatch):
    """predicting(*pairs): a problem that predicts its held-out episodes so, or says why not; and what was told."""
    told = {}

    def channel_errors(results, episodes):
        told["episodes"] = [e.name for e in episodes]
        return {"a": {"rmse": np.float64(0.25), "unit": "m", "n": 3}} if results else {}

    monkeypatch.setattr("yid_ocp.problem.predictions.rmse_unit_count_dicts_by_channel", channel_errors)

    def rows(there, whitening, result):
        pairs = zip(there.measurements, result.predicted_outputs, strict=True)
        residual = np.concatenate([group.residual_and_jacobian(x).residual for group, x in pairs])
        return SimpleNamespace(residual=residual, jacobian=np.full((len(residual), 2), [1.0, 7.0]))

    monkeypatch.setattr(module.null_test, "episode_residual_and_jacobian", rows)
    usual = {"has_process_noise": False, "options": ProblemOptions()}
    usual |= {"shared_parameters": ("k",), "unknown_names": (), "initial_unknowns": np.zeros(0)}

    def made(*pairs):
        own = {"held_out": [e for e, _ in pairs], "held_out_whitening_filters": [None] * len(pairs)}
        return SimpleNamespace(predict_held_out=lambda x, _: list(pairs), **own, **usual), told

    return made


def test_a_held_out_loss_sums_whitened_squares_block_by_block(predicting):
    value, weight = [[1, 1], [2, math.nan], [3, 3], [4, 4], [5, 5]], [[1, 1], [2, 0], [1, 1], [1, 1], [1, 2]]
    group, more = measured([0.0, 0.49, 0.5, 0.99, 1.0], value, weight), measured([0.2], [[0, 0]], [[3, 3]])
    predicted = np.array([[2.0, 1.0], [3.0, 9.0], [3.0, 1.0], [4.0, 5.0], [6.0, 6.0]])
    outputs = SimpleNamespace(predicted_outputs=(predicted, np.array([[1.0, 2.0]])))
    problem, told = predicting((episode(of=[group, more]), outputs))
    found = held_out_loss(problem, np.zeros(1), CERTAIN)
    # blocks of half a second: [0, 0.5), [0.5, 1.0) and the last sample
    np.testing.assert_allclose(found.block_chi2, [1 + 4 + 9 + 36, 4 + 1, 1 + 4])
    np.testing.assert_allclose(found.block_sample_counts, [2 + 1 + 2, 4, 2])
    assert found.channel_rmse == {"a": (0.25, "m")}
    assert told["episodes"] == ["other"]
    # an uncertain offset of all eleven residuals, whose sum is 14, is no gap
    unsure = held_out_loss(problem, np.zeros(1), CERTAIN, np.full((11, 1), 1e6))
    assert unsure.total_chi2 == pytest.approx(found.total_chi2 - 14**2 / 11)
    # a fit to all recordings changes the offset, whose std is 2, at the price of its square
    joint = held_out_loss(problem, np.zeros(1), np.array([[2.0]]))
    shift = -14 / (11 + 1 / 4)
    residual = found.total_chi2 + 2 * 14 * shift + 11 * shift**2
    assert joint.total_chi2 == found.total_chi2 == found.updated_chi2
    assert joint.updated_chi2 == pytest.approx(residual + (shift / 2) ** 2)


@cases(
    "seconds, length",
    {"short": ((10.0,), 0.5), "forty seconds": ((40.0,), 1.0), "two": ((30.0, 30.0), 1.5), "long": ((200.0,), 2.0)},
)
def test_held_out_time_is_cut_in_some_forty_blocks(predicting, seconds, length):
    """Of a sample at the begin and two about the end of the first block, the last one is alone."""
    group = measured([0.0, 0.99 * length, 1.01 * length], np.ones((3, 2)), np.ones((3, 2)))
    outputs = SimpleNamespace(predicted_outputs=(np.ones((3, 2)),))
    problem, _ = predicting(*((episode(steps=round(s / 0.01), of=[group]), outputs) for s in seconds))
    found = held_out_loss(problem, np.zeros(1), CERTAIN)
    np.testing.assert_array_equal(found.block_sample_counts, [4.0, 2.0] * len(seconds))


def test_a_failed_prediction_is_infinitely_bad_where_it_was_measured(predicting):
    group = measured([0.1, 0.6], [[1, 1], [1, 1]], [[1, 1], [1, 0]])
    good = SimpleNamespace(predicted_outputs=(np.ones((2, 2)),))
    problem, told = predicting((episode("one", of=[group]), "it snaps"), (episode("two", of=[group]), good))
    found = held_out_loss(problem, np.zeros(1), CERTAIN)
    np.testing.assert_array_equal(found.block_chi2, [math.inf, math.inf, 0.0, 0.0])
    np.testing.assert_array_equal(found.block_sample_counts, [2.0, 1.0, 2.0, 1.0])
    assert told["episodes"] == ["two"]
    none, _ = predicting((episode("one", of=[group]), "it snaps"))
    assert held_out_loss(none, np.zeros(1), CERTAIN).channel_rmse == {}


@cases(
    "known, start, solved", {"a solution is there": (3.0, {"k": 3.0}, 0), "it is solved first": (None, {"k": 2.0}, 1)}
)
def test_the_nominal_model_starts_from_the_solution(monkeypatch, known, start, solved):
    def solution(value):
        return SimpleNamespace(unknown_names=("k",), x=np.array([value]), problem=None)

    asked = []
    monkeypatch.setattr(diagnosing, "fit_problem", lambda *given, **how: asked.append(given) or solution(2.0))
    monkeypatch.setattr(diagnosing, "_fitted_nominal_model", lambda search, start: start)
    given = None if known is None else solution(known)
    composed = SimpleNamespace(with_smoothed_input_errors_of=lambda fitted: "composed", refit_solver=None)
    assert diagnosing.fit_nominal_model("problem", RefitContext(composed, LIMITS, Heard()), given) == start
    assert len(asked) == solved
