"""The order of a diagnosis: what leads to which step, and what each step is given."""

from __future__ import annotations

import importlib
import math
from types import SimpleNamespace

import numpy as np
import pytest
from factories import (
    FORCE,
    Recorded,
    added,
    closed,
    effect,
    evaluation,
    fit,
    outcome,
    smoothed,
    window,
)
from heard import Heard
from made_series import series

from yid_ocp.diagnosis.refit import RefitContext
from yid_ocp.diagnosis.thresholds import Thresholds
from yid_ocp.errors import DataError, SolverError
from yid_ocp.solvers import GaussNewton

# the package's own name `diagnose` is the function
module = importlib.import_module("yid_ocp.diagnosis.diagnose")
FRICTION, OFFSET = effect("friction@elbow"), effect("offset@wrist")
SEEN = smoothed({FORCE: 9.0}, evidence={"plant": 9.0, "both": 9.0})
SILENT = smoothed({FORCE: 0.0})


# -- the nominal fit --------------------------------------------------------------------------------------------------


@pytest.fixture
def nominal(monkeypatch):
    """What fits the nominal model is asked; nominal.outcome: what the refit gives."""
    made = SimpleNamespace(outcome=fit(), outcomes=[], known=None, starts=[], solved=[], found=None)

    def refit(problem, effects, start, store, name, limits):
        assert name == ("" if not made.starts else "the nominal model from its start")
        made.starts.append((problem, tuple(effects), dict(start), store, limits))
        return made.outcomes.pop(0) if made.outcomes else made.outcome

    def solve(problem, solver):
        made.solved.append((problem, solver))
        return made.found

    monkeypatch.setattr(module, "refit_with_effects", refit)
    monkeypatch.setattr(module, "solve", solve)
    monkeypatch.setattr(module, "load_stored_refit", lambda composed, effects, store: made.known)
    return made


CALM = SimpleNamespace(has_process_noise=False)
"""Nothing but the sensors' noise."""


def solution(value=2.0, evaluated=True):
    return SimpleNamespace(
        unknown_names=("k",),
        x=np.array([value]),
        evaluation=evaluation([1.0]) if evaluated else None,
        message="it snaps",
    )


@pytest.mark.parametrize(
    ("blocks", "given", "solved", "start"),
    [
        (False, None, 1, {"k": 3.0}),
        (False, solution(), 0, {"k": 2.0}),
        (True, None, 0, {}),
        (True, solution(), 0, {"k": 2.0}),
    ],
    ids=["solved first", "from a solution", "in blocks", "in blocks from a solution"],
)
def test_the_nominal_fit_begins_at_the_solution_of_all_data(nominal, blocks, given, solved, start):
    nominal.found = solution(3.0)
    composed, limits = SimpleNamespace(is_split_in_blocks=blocks, problem=CALM), Thresholds(restart_chi2=2.0)
    assert module.fit_nominal_model("problem", composed, given, "store", limits) is nominal.outcome
    assert nominal.starts == [(composed, (), start, "store", limits)]
    assert nominal.solved == [("problem", GaussNewton(max_iterations=30))][:solved]


def test_where_the_solution_cannot_be_rolled_out_again_the_fit_begins_at_the_start(nominal):
    nominal.outcomes = [None]
    composed = SimpleNamespace(is_split_in_blocks=False, problem=CALM)
    assert module.fit_nominal_model("problem", composed, solution()) is nominal.outcome
    assert [start for _, _, start, _, _ in nominal.starts] == [{"k": 2.0}, {}]


def test_a_nominal_fit_that_is_known_is_not_repeated(nominal):
    nominal.known = fit(cost=7.0)
    assert module.fit_nominal_model("problem", SimpleNamespace(is_split_in_blocks=False, problem=CALM)) is nominal.known
    assert nominal.starts == nominal.solved == []


def test_a_nominal_model_that_cannot_be_rolled_out_is_said(nominal):
    nominal.found = solution(evaluated=False)
    with pytest.raises(SolverError, match="cannot be fitted: it snaps"):
        module.fit_nominal_model("problem", SimpleNamespace(is_split_in_blocks=False, problem=CALM))
    nominal.outcome = None
    with pytest.raises(SolverError, match="at its fit"):
        module.fit_nominal_model("problem", SimpleNamespace(is_split_in_blocks=True, problem=CALM))


def test_the_largest_angles_are_those_of_a_segments_joints_in_all_recordings():
    joints = ("a", "b", "c", "d")
    segments = (
        SimpleNamespace(name="T1", link_joints=(("a", "b"), ("c",))),
        SimpleNamespace(name="T2", link_joints=(("d",),)),
    )
    system = SimpleNamespace(segment_layouts=segments, mechanism=SimpleNamespace(joint_index=joints.index))
    states = [np.array([[0.1, -0.2, 0.3, 9.0], [0.0, -0.7, 0.2, 1.0]]), np.array([[0.5, 0.1, 0.6, -11.0]])]
    episodes = tuple(SimpleNamespace(rollout=SimpleNamespace(state=state)) for state in states)
    fitted = SimpleNamespace(
        problem=SimpleNamespace(system=system), evaluation=SimpleNamespace(episode_predictions=episodes)
    )
    assert module._largest_joint_angles(fitted) == {"T1": 0.7, "T2": 11.0}


# -- null tests -------------------------------------------------------------------------------------------------------


def test_the_test_on_the_fits_data_leaves_out_what_parameters_took(monkeypatch):
    monkeypatch.setattr(module, "residual_channels", lambda problem: [series(range(5))] if problem == "problem" else [])
    fitted = SimpleNamespace(problem="problem", evaluation=evaluation([2.0] * 5), values={"k": 1.0, "l": 1.0})
    found = module._estimation_null_test(fitted, Thresholds(residual_window=0.02))
    assert found.chi2_per_dof == pytest.approx(20 / 3)
    assert found.degrees_of_freedom == 3.0
    assert len(found.windows) == 3


def test_held_out_data_are_tested_without_any_fit(monkeypatch):
    monkeypatch.setattr(module, "noise_covariance_factor", lambda problem, found: np.array([[0.0]]))
    measured = Recorded(times=[0.0, 0.1, 0.2], value=[[1.0], [2.0], [math.nan]], weight=[[2.0], [3.0], [0.0]])
    problem = measured.predicted_outputs([[2.0], [4.0], [9.0]])
    found = module._held_out_null_test(
        SimpleNamespace(problem=problem, values={"k": 5.0}, evaluation=None), Thresholds()
    )
    assert found.chi2_per_dof == pytest.approx((4.0 + 36.0) / 2)
    assert found.degrees_of_freedom == 2.0
    assert problem.asked == [{"k": 5.0}]


def test_held_out_data_are_tested_in_units_of_what_parameters_are_unsure_of_too(monkeypatch):
    asked = []
    monkeypatch.setattr(module, "noise_covariance_factor", lambda *given: asked.append(given) or np.array([[0.5]]))
    measured = Recorded(times=[0.0, 0.1], value=[[1.0], [2.0]], weight=[[2.0], [3.0]])
    problem = measured.predicted_outputs([[2.0], [4.0]], slopes=[3.0, 0.0])
    found = module._held_out_null_test(
        SimpleNamespace(problem=problem, values={"k": 5.0}, evaluation="fit"), Thresholds()
    )
    # one standard deviation of k moves the first sample by 1.5 in its unit of half, the second not at all
    assert found.chi2_per_dof == pytest.approx((4.0 / (1 + 3.0**2) + 36.0) / 2)
    assert asked == [(problem, "fit")]


def test_held_out_data_that_cannot_be_predicted_are_refused():
    problem = Recorded([0.0], [[1.0]], [[1.0]]).predicted_outputs("it snaps")
    with pytest.raises(DataError, match="cannot be predicted: it snaps"):
        module._held_out_null_test(SimpleNamespace(problem=problem, values={}), Thresholds())


# -- what is left -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("parts", "expected"),
    [
        ([("elbow", 0.6)], {"elbow": 0.6}),
        ([("elbow", 0.6), ("wrist", 0.9)], {"elbow": 0.6, "wrist": 0.3}),
        ([("elbow", 0.6), ("elbow", 0.9)], {"elbow": 0.9}),
        ([("elbow", 0.6), ("wrist", 0.5), ("world", 0.7)], {"elbow": 0.6, "wrist": 0.0, "world": 0.1}),
        ([("elbow", -0.2), ("wrist", 0.5)], {"elbow": 0.0, "wrist": 0.5}),
    ],
    ids=["one", "two", "at one place", "one that closes nothing more", "worse than nothing"],
)
def test_every_effect_closes_what_it_adds_to_those_before_it(parts, expected):
    entries = [added(effect(f"kind@{location}"), part=closed(value)) for location, value in parts]
    assert module._closed(entries) == pytest.approx(expected)


@pytest.fixture
def left(monkeypatch):
    """Null tests and smoothers of fits: left.tests, left.places."""
    made = SimpleNamespace(fitted=outcome(), held=outcome(), rest=SEEN, smoothed=[])

    def smooth_fit(of, limits):
        made.smoothed.append((of, limits))
        return made.rest

    monkeypatch.setattr(module, "_estimation_null_test", lambda of, limits: made.fitted)
    monkeypatch.setattr(module, "_held_out_null_test", lambda of, limits: made.held)
    monkeypatch.setattr(module, "_smooth_about_model", smooth_fit)
    return made


def after(accepted, found=SEEN, before=None):
    held = outcome(p=1e-9, chi2=2.0)
    return held, module._after(fit(), accepted, found, before or outcome(), held, Thresholds())


def test_without_effects_what_is_left_is_what_there_was(left):
    held, (remaining, where, rest) = after(())
    assert remaining is held
    assert where == rest
    assert [(p.location, p.gap_share) for p in where] == [("T1", 1.0)]
    assert after((), found=None)[1][1:] == ((), ())
    assert left.smoothed == []


def test_an_effect_takes_what_it_closes_and_noise_has_no_place(left):
    fitted = fit([FRICTION])
    _, (remaining, where, rest) = after((added(FRICTION, fitted=fitted, part=closed(0.75)),))
    assert remaining is left.held
    assert rest == ()
    assert [(p.location, p.gap_share) for p in where] == [("elbow", 1.0), ("T1", 0.0)]
    assert left.smoothed == []


def test_a_gap_that_is_left_is_located_again(left):
    left.held = outcome(p=1e-9, chi2=1.5)
    fitted = fit([OFFSET])
    flagged = [window(0.0, 0.5), window(0.5, 1.0), window(2.0, 2.5, flagged=False), window(3.0, 3.5)]
    entries = (added(FRICTION, part=closed(0.5)), added(OFFSET, fitted=fitted, part=closed(0.75)))
    _, (remaining, where, rest) = after(entries, before=outcome(windows=flagged))
    assert remaining is left.held
    assert left.smoothed == [(fitted, Thresholds())]
    assert [p.location for p in rest] == ["T1"]
    assert {p.location: p.gap_share for p in where} == {"elbow": 0.5, "wrist": 0.25, "T1": 0.25}
    assert where[0].time_windows == ((0.0, 1.0), (3.0, 3.5))


def test_channels_above_noise_are_no_gap_without_a_candidate_or_a_sure_excess(left):
    left.fitted = left.held = outcome(p=0.3, chi2=1.02, channels={"a": 1.3, "b": 0.9})
    assert after((added(FRICTION),))[1][2] == ()
    assert left.smoothed == []


# -- other starts ------------------------------------------------------------------------------------------------------


class Valleys:
    """A candidate problem of two parameters, one positive, and what the nominal model costs from each start."""

    def __init__(self, monkeypatch, costs):
        self.costs, self.asked = costs, []
        self.problem = SimpleNamespace(
            is_positive=np.array([True, False]), initial_unknowns=np.array([2.0, -1.0]), has_process_noise=False,
            bounds=(np.array([0.0, -9.0]), np.array([15.0, 9.0])),
            named_values=lambda x: dict(zip("kl", x, strict=True)),
        )  # fmt: skip
        monkeypatch.setattr(module, "refit_with_effects", self.refit)

    def refit(self, composed, effects, start, store, name, limits):
        self.asked.append((name, start))
        cost = self.costs.get(start["k"])
        return None if cost is None else fit(cost=cost, values=start)

    def other(self):
        search = RefitContext(SimpleNamespace(problem=self.problem), Thresholds(), Heard(), "store")
        return module._better_nominal_fit(search, fit(cost=100.0, values={"k": 2.0, "l": -1.0}))


def test_other_starts_are_multiples_of_what_is_positive_within_bounds(monkeypatch):
    valleys = Valleys(monkeypatch, {8.0: 94.9, 4.0: 60.0, 15.0: 70.0})
    assert valleys.other().values == {"k": 4.0, "l": -1.0}
    assert [start["k"] for _, start in valleys.asked] == [8.0, 4.0, 15.0, 4.0]
    assert len({name for name, _ in valleys.asked}) == 4


def test_another_valley_must_be_far_likelier(monkeypatch):
    assert Valleys(monkeypatch, {8.0: 95.0, 4.0: 99.0}).other() is None
