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
    alike,
    closed,
    effect,
    evaluation,
    fit,
    loss,
    outcome,
    place,
    point,
    score,
    smoothed,
    visible,
    window,
)
from heard import Heard
from made_series import series

from yid_ocp.diagnosis.baseline_data import BaselineData
from yid_ocp.diagnosis.events import NO_EVENTS, DisturbanceEvent, EventSet
from yid_ocp.diagnosis.hypotheses import AllCandidatesProblem
from yid_ocp.diagnosis.refit import RefitContext
from yid_ocp.diagnosis.screening import ScreeningResult, score_jointly
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

    monkeypatch.setattr(module, "refit", refit)
    monkeypatch.setattr(module, "solve", solve)
    monkeypatch.setattr(module, "recalled", lambda composed, effects, store: made.known)
    return made


CALM = SimpleNamespace(has_process_noise=False)
"""Nothing but the sensors' noise."""


def solution(value=2.0, evaluated=True):
    return SimpleNamespace(
        unknown_names=("k",), x=np.array([value]), evaluation=evaluation([1.0]) if evaluated else None, message="it snaps"
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
    assert module.nominal_fit("problem", composed, given, "store", limits) is nominal.outcome
    assert nominal.starts == [(composed, (), start, "store", limits)]
    assert nominal.solved == [("problem", GaussNewton(max_iterations=30))][:solved]


def test_where_the_solution_cannot_be_rolled_out_again_the_fit_begins_at_the_start(nominal):
    nominal.outcomes = [None]
    composed = SimpleNamespace(is_split_in_blocks=False, problem=CALM)
    assert module.nominal_fit("problem", composed, solution()) is nominal.outcome
    assert [start for _, _, start, _, _ in nominal.starts] == [{"k": 2.0}, {}]


def test_a_nominal_fit_that_is_known_is_not_repeated(nominal):
    nominal.known = fit(cost=7.0)
    assert module.nominal_fit("problem", SimpleNamespace(is_split_in_blocks=False, problem=CALM)) is nominal.known
    assert nominal.starts == nominal.solved == []


def test_a_nominal_model_that_cannot_be_rolled_out_is_said(nominal):
    nominal.found = solution(evaluated=False)
    with pytest.raises(SolverError, match="cannot be fitted: it snaps"):
        module.nominal_fit("problem", SimpleNamespace(is_split_in_blocks=False, problem=CALM))
    nominal.outcome = None
    with pytest.raises(SolverError, match="at its fit"):
        module.nominal_fit("problem", SimpleNamespace(is_split_in_blocks=True, problem=CALM))


def test_the_largest_angles_are_those_of_a_segments_joints_in_all_recordings():
    joints = ("a", "b", "c", "d")
    segments = (SimpleNamespace(name="T1", link_joints=(("a", "b"), ("c",))), SimpleNamespace(name="T2", link_joints=(("d",),)))
    system = SimpleNamespace(segment_layouts=segments, mechanism=SimpleNamespace(joint_index=joints.index))
    states = [np.array([[0.1, -0.2, 0.3, 9.0], [0.0, -0.7, 0.2, 1.0]]), np.array([[0.5, 0.1, 0.6, -11.0]])]
    episodes = tuple(SimpleNamespace(rollout=SimpleNamespace(state=state)) for state in states)
    fitted = SimpleNamespace(problem=SimpleNamespace(system=system), evaluation=SimpleNamespace(episodes=episodes))
    assert module.largest_angles(fitted) == {"T1": 0.7, "T2": 11.0}


# -- null tests -------------------------------------------------------------------------------------------------------


def test_the_test_on_the_fits_data_leaves_out_what_parameters_took(monkeypatch):
    monkeypatch.setattr(module, "residual_series", lambda problem: [series(range(5))] if problem == "problem" else [])
    fitted = SimpleNamespace(problem="problem", evaluation=evaluation([2.0] * 5), values={"k": 1.0, "l": 1.0})
    found = module.fitted_test(fitted, Thresholds(residual_window=0.02))
    assert found.chi2_per_dof == pytest.approx(20 / 3)
    assert found.degrees_of_freedom == 3.0
    assert len(found.windows) == 3


def test_held_out_data_are_tested_without_any_fit(monkeypatch):
    monkeypatch.setattr(module, "spread_by_noise", lambda problem, found: np.array([[0.0]]))
    measured = Recorded(times=[0.0, 0.1, 0.2], value=[[1.0], [2.0], [math.nan]], weight=[[2.0], [3.0], [0.0]])
    problem = measured.predicted_outputs([[2.0], [4.0], [9.0]])
    found = module.held_out_test(SimpleNamespace(problem=problem, values={"k": 5.0}, evaluation=None), Thresholds())
    assert found.chi2_per_dof == pytest.approx((4.0 + 36.0) / 2)
    assert found.degrees_of_freedom == 2.0
    assert problem.asked == [{"k": 5.0}]


def test_held_out_data_are_tested_in_units_of_what_parameters_are_unsure_of_too(monkeypatch):
    asked = []
    monkeypatch.setattr(module, "spread_by_noise", lambda *given: asked.append(given) or np.array([[0.5]]))
    measured = Recorded(times=[0.0, 0.1], value=[[1.0], [2.0]], weight=[[2.0], [3.0]])
    problem = measured.predicted_outputs([[2.0], [4.0]], slopes=[3.0, 0.0])
    found = module.held_out_test(SimpleNamespace(problem=problem, values={"k": 5.0}, evaluation="fit"), Thresholds())
    # one standard deviation of k moves the first sample by 1.5 in its unit of half, the second not at all
    assert found.chi2_per_dof == pytest.approx((4.0 / (1 + 3.0**2) + 36.0) / 2)
    assert asked == [(problem, "fit")]


def test_held_out_data_that_cannot_be_predicted_are_refused():
    problem = Recorded([0.0], [[1.0]], [[1.0]]).predicted_outputs("it snaps")
    with pytest.raises(DataError, match="cannot be predicted: it snaps"):
        module.held_out_test(SimpleNamespace(problem=problem, values={}), Thresholds())


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

    monkeypatch.setattr(module, "fitted_test", lambda of, limits: made.fitted)
    monkeypatch.setattr(module, "held_out_test", lambda of, limits: made.held)
    monkeypatch.setattr(module, "smooth_fit", smooth_fit)
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
    assert where[0].windows == ((0.0, 1.0), (3.0, 3.5))


def test_channels_above_noise_are_no_gap_without_a_candidate_or_a_sure_excess(left):
    left.with_fitted_initial_state = left.held = outcome(p=0.3, chi2=1.02, channels={"a": 1.3, "b": 0.9})
    assert after((added(FRICTION),))[1][2] == ()
    assert left.smoothed == []


# -- all steps --------------------------------------------------------------------------------------------------------


class Steps:
    """A diagnosis whose steps are given; remembers which were taken, and with what."""

    def __init__(self, monkeypatch, **given):
        self.given = {
            "before": outcome(p=1e-9, chi2=2.0, degrees=100.0),
            "held": outcome(p=1e-9, chi2=2.0),
            "screened": ScreeningResult(
                (visible(FRICTION), visible(OFFSET, seen=False)), (score(FRICTION, p=1e-9),), TABLE, ALONE
            ),
            "smoothed": SEEN,
            "added": (added(FRICTION, fitted=fit([FRICTION], loss(1.0, 1.1), cost=50.0, values=VALUES)),),
            "blocks": False,
            "disturbed": False,
            "elsewhere": None,
            "carried": (),
            "events": [NO_EVENTS],
            "smoothed_for_events": None,
        } | given
        self.taken, self.heard = [], Heard()
        self.nominal = fit(lost=loss(2.0, 2.1), cost=100.0, values=VALUES)
        object.__setattr__(
            self.nominal,
            "problem",
            SimpleNamespace(episodes=(), shared_parameters=("k",), system=SYSTEM, has_process_noise=self.given["disturbed"]),
        )
        monkeypatch.setattr(module, "nominal_fit", self.step("nominal", self.nominal))
        monkeypatch.setattr(module, "largest_angles", lambda of: {"T1": 0.5})
        for name, key in (("fitted_test", "before"), ("held_out_test", "held")):
            monkeypatch.setattr(module, name, self.tests(self.given[key]))
        monkeypatch.setattr(module, "screen", self.step("screen", self.given["screened"]))
        monkeypatch.setattr(module, "elsewhere", self.step("elsewhere", self.given["elsewhere"]))
        monkeypatch.setattr(module, "smooth_fit", self.step("smooth", self.given["smoothed"]))
        happened = [module._Happened(events, self.given["smoothed_for_events"]) for events in self.given["events"]]
        monkeypatch.setattr(module, "_undivided", lambda composed, problem: "whole")
        monkeypatch.setattr(
            module, "_happened", lambda whole, of, limits: happened.pop(0) if len(happened) > 1 else happened[0]
        )
        monkeypatch.setattr(module, "without_events", lambda problem, events: f"{problem} without {len(events.found)}")
        monkeypatch.setattr(module, "_settled", self.step("settled", self.nominal))
        refits = tuple(entry.fit for entry in self.given["added"])
        monkeypatch.setattr(module, "compose", self.step("compose", (refits, self.given["added"])))
        monkeypatch.setattr(module, "carried_over", lambda search, of: self.given["carried"])

    def step(self, name, result):
        def taken(*given):
            self.taken.append((name, given))
            return result

        return taken

    def tests(self, before):
        return lambda of, limits: before if of is self.nominal else outcome()

    @property
    def unknown_names(self):
        return [name for name, _ in self.taken]

    def minimize_cost(self, **limits):
        held = (SimpleNamespace(name="other"),)
        self.effects = [Remembering("friction@elbow"), Remembering("offset@wrist")]
        self.nominal.problem.held_out = held
        self.composed = AllCandidatesProblem("problem", tuple(self.effects), self.given["blocks"])
        search = RefitContext(self.composed, Thresholds(**limits), self.heard, "store")
        return module._diagnosed("problem", search, "solution", module._Clock(), BaselineData.from_runs((), ()))


class Remembering:
    """An effect that is told how far joints turn."""

    def __init__(self, label):
        self.label, self.angles = label, None

    def expected(self, angles):
        other = Remembering(self.label)
        other.angles = angles
        return other


TABLE = alike([FRICTION.label], [[1.0]])
ALONE = score_jointly(point([0.0]))
VALUES = {"k": 1.0, "l": 1.0}
UNIT = SimpleNamespace(unit="N m/rad")
SYSTEM = SimpleNamespace(parameters={"k": UNIT, "l": UNIT})


def test_a_gap_is_screened_located_and_closed(monkeypatch):
    steps = Steps(monkeypatch)
    found = steps.run()
    assert steps.names == ["nominal", "screen", "smooth", "compose"]
    assert found.verdict == "effect"
    assert steps.taken[0][1] == ("problem", steps.composed, "solution", "store", Thresholds())
    screened, *given = steps.taken[1][1]
    assert given == [(), steps.nominal.values, Thresholds()]
    assert [(e.label, e.angles) for e in screened.effects] == [(e.label, {"T1": 0.5}) for e in steps.effects]
    assert steps.taken[2][1] == (steps.nominal, Thresholds())
    assert steps.taken[3][1][0].problem is screened
    assert steps.taken[3][1][1:] == (steps.nominal, steps.given["screened"], ["T1"], False)
    assert found.closure.value == pytest.approx(1 - 0.05 / 1.05)
    assert (found.added, found.fits[0]) == (steps.given["added"], steps.given["added"][0].fit)
    assert found.held_out == ("other",)
    assert found.nominal_changes[0].before == 1.0
    assert found.summary.startswith("The gap is real")
    stages = ["nominal", "events", "screening", "other_starts", "localisation", "refits", "carry_over", "remaining"]
    assert list(found.seconds) == stages
    assert all(0 <= value < 5 for value in found.seconds.values())
    said = ["fitting the nominal model", "looking for events", "screening 2 candidates", "locating the gap"]
    assert steps.heard.stages[:4] == said


NOISE = {"before": outcome(p=0.4, degrees=100.0), "held": outcome(p=0.5)}
FAINT = {"before": outcome(p=0.003, chi2=1.2, degrees=100.0), "held": outcome(p=0.5)}
SLIGHT = {"before": outcome(p=1e-9, chi2=1.09, degrees=100.0)}
LARGE = smoothed({FORCE: 9.0}, chi2=(500.0, 100.0))
HARMLESS = ScreeningResult((visible(FRICTION),), (score(FRICTION, p=0.6),), TABLE, ALONE)


@pytest.mark.parametrize(
    ("given", "taken", "verdict"),
    [
        (NOISE | {"screened": HARMLESS}, ["nominal", "screen"], "no_gap"),
        (NOISE, ["nominal", "screen"], "no_gap"),
        (FAINT | {"screened": HARMLESS, "smoothed": SILENT}, ["nominal", "screen", "smooth"], "no_gap"),
        (FAINT | {"screened": HARMLESS}, ["nominal", "screen", "smooth", "compose"], "effect"),
        ({"before": outcome(p=1e-9, chi2=2.0, degrees=5.9)}, ["nominal", "screen"], "insufficient_data"),
        ({"before": outcome(p=1e-9, chi2=2.0, degrees=6.0)}, ["nominal", "screen", "smooth", "compose"], "effect"),
        ({"screened": ScreeningResult((), (), TABLE, ALONE)}, ["nominal", "screen", "smooth"], "insufficient_data"),
        ({"added": ()}, ["nominal", "screen", "smooth", "compose"], "unknown"),
        # where noise drives the motion the smoother's word does not count
        (FAINT | {"screened": HARMLESS, "disturbed": True}, ["nominal", "screen", "smooth"], "no_gap"),
        ({"smoothed": LARGE, "disturbed": True}, ["nominal", "screen", "smooth", "compose"], "effect"),
        (SLIGHT, ["nominal", "screen", "elsewhere", "smooth", "compose"], "effect"),
        (
            {
                "smoothed": smoothed({FORCE: 9.0}, chi2=(500.0, 100.0)),
                "added": (added(FRICTION, fitted=fit([FRICTION], loss(1.7, 1.8), cost=50.0, values=VALUES)),),
            },
            ["nominal", "screen", "smooth", "compose"],
            "unknown",
        ),
    ],
    ids=[
        "noise",
        "noise along a sure candidate",
        "chance",
        "barely, but with a place",
        "fewer than three samples for each of two unknowns",
        "three samples for each",
        "nothing could be seen",
        "nothing was added",
        "chance beside noise of torques, whatever its place",
        "the smoother is no measure beside noise of torques",
        "a slight gap may be a wrong valley",
        "most is left unexplained",
    ],
)
def test_what_leads_to_which_step(monkeypatch, given, taken, verdict):
    steps = Steps(monkeypatch, **given)
    found = steps.run()
    assert (steps.names, found.verdict) == (taken, verdict)
    if verdict not in ("effect", "confusable"):
        assert found.remaining is steps.given["held"]
        assert found.nominal_changes[0].after == found.nominal_changes[0].before == 1.0
        assert found.effects == ()
    if not found.added:
        assert math.isnan(found.closure.value)
        assert math.isnan(found.closure.ci_low)
        assert math.isnan(found.closure.ci_high)
    if "smooth" not in taken:
        assert (found.smoothed, found.where) == (None, ())


def test_a_gap_that_was_a_wrong_valley_of_the_nominal_model_is_none(monkeypatch):
    right = fit(lost=loss(1.0, 1.0), cost=40.0, values=VALUES)
    steps = Steps(monkeypatch, **SLIGHT, elsewhere=right)
    object.__setattr__(right, "problem", steps.nominal.problem)
    found = steps.run()
    assert steps.names == ["nominal", "screen", "elsewhere", "screen"]
    assert found.verdict == "no_gap"
    assert found.nominal is right
    assert found.before.chi2_per_dof == 1.0


class Valleys:
    """A candidate problem of two parameters, one positive, and what the nominal model costs from each start."""

    def __init__(self, monkeypatch, costs):
        self.costs, self.asked = costs, []
        self.problem = SimpleNamespace(
            positive=np.array([True, False]), initial_unknowns=np.array([2.0, -1.0]), has_process_noise=False,
            bounds=(np.array([0.0, -9.0]), np.array([15.0, 9.0])), named=lambda x: dict(zip("kl", x, strict=True)),
        )  # fmt: skip
        monkeypatch.setattr(module, "refit", self.refit)

    def refit(self, composed, effects, start, store, name, limits):
        self.asked.append((name, start))
        cost = self.costs.get(start["k"])
        return None if cost is None else fit(cost=cost, values=start)

    def other(self):
        search = RefitContext(SimpleNamespace(problem=self.problem), Thresholds(), Heard(), "store")
        return module.alternative_start(search, fit(cost=100.0, values={"k": 2.0, "l": -1.0}))


def test_other_starts_are_multiples_of_what_is_positive_within_bounds(monkeypatch):
    valleys = Valleys(monkeypatch, {8.0: 94.9, 4.0: 60.0, 15.0: 70.0})
    assert valleys.other().values == {"k": 4.0, "l": -1.0}
    assert [start["k"] for _, start in valleys.asked] == [8.0, 4.0, 15.0, 4.0]
    assert len({name for name, _ in valleys.asked}) == 4


def test_another_valley_must_be_far_likelier(monkeypatch):
    assert Valleys(monkeypatch, {8.0: 95.0, 4.0: 99.0}).other() is None


def test_how_many_samples_are_enough_is_a_threshold(monkeypatch):
    steps = Steps(monkeypatch)
    assert steps.run(samples_per_unknown=50.0).verdict == "effect"
    found = Steps(monkeypatch).run(samples_per_unknown=50.1)
    assert found.verdict == "insufficient_data"
    assert found.message.startswith("100 effective samples for 2 unknowns, at least 100 are needed")


def test_an_effect_that_is_accepted_is_where_the_gap_was(monkeypatch):
    steps = Steps(monkeypatch, blocks=True)
    steps.given["added"][0].fit.values.update({"k": 2.0, "l": 3.0})
    steps.given["added"][0].fit.std.update({"k": 0.5})
    found = steps.run()
    assert found.where[0] == place("elbow", found.where[0].gap_share)
    assert (found.nominal_changes[0].after, found.nominal_changes[0].std) == (2.0, 0.5)
    assert found.is_split_in_blocks
    assert found.next_experiment.startswith("Repeat")


def happening(begin, channel="elbow"):
    return DisturbanceEvent("run", channel, channel, "force", begin, begin + 0.4, 0.5, 0.1, 0.01, "N m")


def test_what_events_explain_is_taken_out_before_the_rest_is_judged(monkeypatch):
    events = EventSet((happening(1.0),))
    steps = Steps(monkeypatch, events=[events, events])
    found = steps.run()
    name, (composed, start, store, label, _) = steps.taken[1]
    assert (name, composed.problem, start, store) == ("settled", "problem without 1", VALUES, "store")
    assert label == "the nominal model without events, round 1"
    assert steps.names.count("settled") == 1
    assert found.events is events
    assert "elbow is pushed by up to +0.5 N m from 1.00 to 1.40 s in run (+0.1 ± 0.01 N m s)" in found.summary


def test_where_nothing_happened_the_smoother_is_not_run_twice(monkeypatch):
    steps = Steps(monkeypatch, smoothed_for_events=SEEN)
    assert steps.run().smoothed is SEEN
    assert "smooth" not in steps.names
    # a recording in blocks was smoothed whole, one with events before they were taken out, another fit not at all
    events = EventSet((happening(1.0),))
    other = fit(lost=loss(2.0, 2.1), cost=90.0, values=VALUES)
    before = outcome(p=1e-9, chi2=1.05, degrees=100.0)
    for given in ({"blocks": True}, {"events": [events, NO_EVENTS]}, {"elsewhere": other, "before": before}):
        steps = Steps(monkeypatch, smoothed_for_events=SEEN, **given)
        if "elsewhere" in given:
            object.__setattr__(other, "problem", steps.nominal.problem)
            monkeypatch.setattr(module, "held_out_test", lambda of, limits: outcome(p=1e-9, chi2=2.0))
        about = steps.run().nominal
        assert any(name == "smooth" and of[0] is about for name, of in steps.taken), given


def test_events_are_sought_again_about_the_fit_without_them_until_they_stay(monkeypatch):
    first, more = EventSet((happening(1.0),)), EventSet((happening(1.0), happening(3.0, "shoulder")))
    steps = Steps(monkeypatch, events=[first, more, more])
    assert steps.run().events is more
    cleaned = [given[0].problem for name, given in steps.taken if name == "settled"]
    assert cleaned == ["problem without 1", "problem without 2"]


def test_what_the_accepted_effects_explain_was_no_event(monkeypatch):
    events = EventSet((happening(1.0),))
    steps = Steps(monkeypatch, events=[events, events, NO_EVENTS])
    found = steps.run()
    assert found.verdict == "effect"
    assert found.events is NO_EVENTS
