"""Is there a gap, is it chance, what is the verdict: rule by rule."""

import math
from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import Mock

import factories as f
import pytest
from factories import added, cases, closed, effect, fit

from yid_ocp.diagnosis import verdict as verdict_module
from yid_ocp.diagnosis.diagnose import _has_left_start
from yid_ocp.diagnosis.hypotheses import AllCandidatesProblem
from yid_ocp.diagnosis.refit import RefitContext
from yid_ocp.diagnosis.thresholds import Thresholds
from yid_ocp.diagnosis.verdict import NominalModelGapEvidence, judge
from yid_ocp.display import NULL_PROGRESS

LIMITS = Thresholds(min_explained_fraction=0.5, min_closure=0.5)
ONE, OTHER = effect("friction@elbow"), effect("offset@elbow")
ELSEWHERE, THIRD = effect("friction@wrist"), effect("spring@elbow")
LOADS = effect("load@elbow", alone=True), effect("load@wrist", alone=True)


NOMINAL = replace(fit(lost=f.loss(3.0, 3.0), cost=100.0), residual_count=100)


def explaining(part, effects, **more):
    """A model whose effects explain a part of what exceeds the noise of `NOMINAL`."""
    made = fit(effects, f.loss(3.0, 3.0), **({"values": {f"{of.label}.a": 0.5 for of in effects}} | more))
    return replace(made, cost=100.0 - (100.0 * part + made.total_effect_parameter_count) / 2, residual_count=100)


def judgement(chosen, again=None, *, nominal=NOMINAL, gap=True, enough=True, search=None, beside=()):
    """What is said of chosen effects; `again` is the refit on the held-out recordings."""
    search = search or Mock(thresholds=LIMITS, refit_on_held_out=Mock(return_value=again))
    evidence = Mock(nominal_model=nominal, residual_exceeds_noise=Mock(return_value=gap), are_data_sufficient=enough)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(verdict_module, "select_effects", lambda *_: ((), tuple(chosen), dict(beside)))
        return judge(search, evidence)


def seen(tests, scores=()):
    return NominalModelGapEvidence(fit(), *tests, f.screening(scores, [f.visible(ONE)]))


@cases(
    "before, held_out, gap",
    {
        "sure on the data of the fit": ((4e-5, 1.2), (0.5, 1.0), True),
        "sure on held-out data": ((0.5, 1.0), (4e-5, 1.2), True),
        "two tests: the smaller p counts twice": ((6e-5, 1.2), (0.5, 1.0), False),
        "at the level": ((5e-5, 1.2), (0.5, 1.0), False),
        "sure but small": ((0.0, 1.05), (0.0, 1.09), False),
        "at the smallest gap": ((0.0, 1.1), (0.0, 1.1), False),
        "large on the other data": ((0.0, 1.0), (0.5, 1.11), True),
        "large on the fit's data": ((0.5, 1.11), (0.0, 1.0), True),
        "large but chance": ((0.5, 5.0), (0.5, 5.0), False),
    },
)
def test_a_gap_is_sure_and_worth_a_name(before, held_out, gap):
    tests = [f.outcome(p=p, chi2=chi2) for p, chi2 in (before, held_out)]
    assert seen(tests).warrants_effect_search(LIMITS) is seen(tests).residual_exceeds_noise(LIMITS) is gap


@cases(
    "p_values, gap",
    {
        "along one candidate": ((0.004,), True),
        "best of two tries": ((0.006, 0.9), False),
        "best of four tries": ((0.9, 0.001, 0.9, 0.9), True),
        "at the level": ((0.01,), False),
        "no candidate": ((), False),
    },
)
def test_a_gap_along_a_candidate_counts_its_tries(p_values, gap):
    scores = [f.score(effect(f"kind{i}@x"), p=p) for i, p in enumerate(p_values)]
    evidence, limits = seen((f.outcome(), f.outcome()), scores), Thresholds(gap_significance_level=0.01)
    assert (evidence.warrants_effect_search(limits), evidence.residual_exceeds_noise(limits)) == (gap, False)
    assert not replace(evidence, discretisation_chi2=1e9).warrants_effect_search(limits), "the step may remove it"


CERTAIN, HALF, HARDLY_HALF = closed(0.45, 0.4, 0.49), closed(0.9, 0.5, 0.95), closed(0.9, 0.49, 0.95)
NO_INTERVAL, MUCH = closed(0.9, math.nan, math.nan), closed(0.95, 0.9, 0.98)
SINGLE, ALIKE = (added(ONE),), (added(ONE, [OTHER]),)
TWO, THREE = (added(ONE), added(OTHER)), (added(ONE), added(OTHER), added(THIRD))
ONE_LAW, TWO_LOADS = (added(ONE), added(ELSEWHERE)), (added(LOADS[0]), added(LOADS[1]))


@cases(
    "changed, verdict",
    {
        "an effect": ({}, "effect"),
        "too few data": ({"enough": False}, "insufficient_data"),
        "no gap": ({"gap": False, "added": ()}, "no_gap"),
        "an effect of parameters that have left an earlier run": ({"gap": False}, "effect"),
        "nothing added": ({"added": ()}, "unknown"),
        "less than half is explained": ({"explained": 0.49}, "unknown"),
        "half is explained": ({"explained": 0.5}, "effect"),
        "little, half of the held-out gap": ({"explained": 0.1, "total": HALF}, "effect"),
        "little, hardly half of the held-out gap": ({"explained": 0.1, "total": HARDLY_HALF}, "unknown"),
        "little, no interval": ({"explained": 0.1, "total": NO_INTERVAL}, "unknown"),
        "two that do the same": ({"added": ALIKE}, "confusable"),
        "only later ones do the same": ({"added": (added(ONE), added(OTHER, [ONE]))}, "effect"),
        "two explain too little for two": ({"added": TWO, "explained": 0.74}, "unknown"),
        "two explain enough": ({"added": TWO, "explained": 0.75}, "effect"),
        "two explain little, but much held out": ({"added": TWO, "explained": 0.1, "total": MUCH}, "effect"),
        "two explain little, and half held out": ({"added": TWO, "explained": 0.1, "total": HALF}, "unknown"),
        "three explain too little for three": ({"added": THREE, "explained": 0.87}, "unknown"),
        "three explain enough": ({"added": THREE, "explained": 0.88}, "effect"),
        "one law at two places explains too little": ({"added": ONE_LAW, "explained": 0.49}, "unknown"),
        "one law at two places explains enough": ({"added": ONE_LAW, "explained": 0.5}, "effect"),
        "loads at two places explain too little for two": ({"added": TWO_LOADS, "explained": 0.74}, "unknown"),
        "loads at two places explain enough for two": ({"added": TWO_LOADS, "explained": 0.75}, "effect"),
        "one law at two places, half held out": ({"added": ONE_LAW, "explained": 0.1, "total": HALF}, "effect"),
        "does not carry over": ({"carried": False}, "unknown"),
    },
)
def test_the_verdict(changed, verdict):
    assert judged(**changed).verdict == verdict


def judged(added=SINGLE, total=CERTAIN, explained=1.0, carried=True, **more):
    """What is said of effects that were added, of which the first explains nothing alone beside others."""
    effects = [entry.effect for entry in added]
    models = [explaining(explained if i == len(effects) else 0.0, effects[:i]) for i in range(1, len(effects) + 1)]
    parts = zip(added, models, [closed(0.1, 0.0, 0.2)] * (len(effects) - 1) + [total], strict=False)
    chosen = [replace(entry, refitted_model=model, cumulative_closure=part) for entry, model, part in parts]
    return judgement(chosen, None if carried else fit(effects), **more)


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({}, ""),
        ({"added": (), "explained": 0.1, "carried": False}, "none"),
        ({"explained": 0.1, "carried": False}, "little"),
        ({"carried": False}, "stand_in"),
    ],
)
def test_the_first_reason_that_holds_is_why_a_gap_has_no_name(changed, reason):
    said, no_gap = judged(**changed), judged(**changed, gap=False)
    assert said.unknown_reason == reason
    # seen along one candidate alone, it is no gap
    assert (no_gap.verdict, no_gap.unknown_reason) == ("no_gap" if reason else said.verdict, "")


def test_the_more_is_explained_the_surer_are_effects_and_several_must_explain_more():
    def sure(explained, effects=ALIKE, carried=True):
        return judged(effects, closed(0.4, 0.0, 0.5), explained, carried).probability

    assert sure(1.0, ()) == 0.0
    assert 0.8 < sure(1.0) < 1.0
    assert sure(1.0) > sure(0.9) > sure(0.6) > sure(0.5) > sure(0.4) >= sure(-3.0) > 0.0
    assert sure(1.0) > sure(1.0, TWO) > sure(1.0, THREE)
    assert sure(1.0, TWO) > sure(0.9, TWO)
    assert sure(1.0, ONE_LAW) == sure(1.0)
    assert sure(1.0, carried=False) == sure(0.0)


def test_equivalent_effects_share_the_probability_of_their_set():
    last, seen = fit([ONE, THIRD]), f.screening([f.score(own) for own in (ONE, OTHER, THIRD)])
    chosen = (replace(added(ONE, [OTHER], last), shares={ONE.label: 0.7, OTHER.label: 0.3}), added(THIRD, fitted=last))
    told = f.finding("confusable", selected_effects=chosen, single_effect_models=(), screening=seen).to_dict()["which"]
    wanted = {ONE.kind: 0.63, OTHER.kind: 0.27, THIRD.kind: 0.9}
    assert {own["kind"]: own["probability"] for own in told} == pytest.approx(wanted)


@cases(
    "costs, count, left, part",
    {
        "as much": ((100.0, 60.5), 122, 1.2, 1.0),
        "half": ((100.0, 80.5), 122, 1.2, 38.0 / 78.0),
        "hardly more than noise is left": ((100.0, 65.0), 122, 1.0, 1.0),
        "but more of the fitted recordings": ((100.0, 80.5), 122, 1.0, 38.0 / 78.0),
        "more than exceeds the noise": ((100.0, 60.5), 190, 1.2, 1.0),
        "explains less": ((100.0, 100.0), 122, 1.2, -1.0 / 78.0),
        "no excess": ((100.0, 100.0), 300, 1.2, -1.0),
    },
)
def test_what_effects_explain_of_what_exceeds_the_noise(costs, count, left, part):
    """Fall of r'r less what one parameter takes, over its excess over the number of residuals."""
    nominal, last = fit(cost=costs[0]), fit([ONE], f.loss(left, left), cost=costs[1])
    nominal, last = (replace(own, residual_count=count) for own in (nominal, last))
    assert judgement([added(ONE, fitted=last)], nominal=nominal).explained_fraction == pytest.approx(part)


@cases("before, left, part", {"more": (1.2, 1.11, 69 / 78), "less": (1.2, 1.09, 1.0), "noise": (1.005, 1.009, 1.0)})
def test_a_gap_is_explained_where_less_is_left_than_counts_as_a_gap(before, left, part):
    nominal = replace(fit(lost=f.loss(before, before, count=1e4), cost=100.0), residual_count=122)
    last = replace(fit([ONE], f.loss(left, left, count=1e4), cost=65.0), residual_count=122)
    assert judgement([added(ONE, fitted=last)], nominal=nominal).explained_fraction == pytest.approx(part)


@cases(
    "weight, plant, sensor, both, side",
    {
        "nothing": ({f.FORCE: 0.0}, 0.0, 0.0, 0.0, "none"),
        "worse than nothing": ({f.FORCE: 9.0}, -1.0, -2.0, -1.0, "none"),
        "plant": ({f.FORCE: 9.0, f.BIAS: 0.0}, 9.0, 3.0, 9.0, "plant"),
        "sensor": ({f.FORCE: 0.0, f.BIAS: 9.0}, 3.0, 9.0, 9.0, "sensor"),
        "both by chance": ({f.FORCE: 9.0, f.BIAS: 3.0}, 9.0, 3.0, 14.0, "plant"),
        "both": ({f.FORCE: 9.0, f.BIAS: 3.0}, 9.0, 3.0, 14.1, "both"),
        "both, mostly the sensor": ({f.FORCE: 3.0, f.BIAS: 9.0}, 3.0, 9.0, 14.1, "both"),
        "an effort's bias would do the same": ({f.READ_FORCE: 9.0, f.BIAS: 3.0}, 9.0, 3.0, 20.0, "either"),
        "another force weighs more": ({f.READ_FORCE: 3.0, f.FORCE: 9.0}, 9.0, 0.0, 9.0, "plant"),
    },
)
def test_the_side_of_a_gap_by_evidence(weight, plant, sensor, both, side):
    assert f.smoothed(weight, evidence={"plant": plant, "sensor": sensor, "both": both}).plant_or_sensor_origin == side


@cases(
    "chi2, degrees, part",
    {
        "all": ((200.0, 90.0), (100.0, 90.0), 1.0),
        "half": ((200.0, 135.0), (100.0, 90.0), 0.5),
        "nothing": ((200.0, 200.0), (100.0, 100.0), 0.0),
        "worse": ((200.0, 400.0), (100.0, 100.0), 0.0),
        "more than all": ((200.0, 45.0), (100.0, 90.0), 1.0),
        "no gap": ((100.0, 45.0), (100.0, 90.0), 0.0),
    },
)
def test_the_part_of_a_gap_that_can_be_explained_at_all(chi2, degrees, part):
    assert f.smoothed({f.FORCE: 1.0}, chi2=chi2, degrees=degrees).explainable_gap_fraction == pytest.approx(part)


SPRING = effect("spring@elbow", f.amplitude("k", lower=-9.0, expected=(0.0, 10.0)), f.shape("s"))
SHIFT = effect("shift@grasp", *(f.amplitude(n, lower=-9.0, expected=(-1.0, 1.0), unit="m") for n in "xy"))


def of(label, values, stds, effects=(SPRING,), **more):
    return fit(
        effects,
        **more,
        values={f"{label}.{name}": value for name, value in values.items()},
        std={f"{label}.{name}": std for name, std in stds.items()},
    )


@pytest.mark.parametrize(
    ("first", "second", "known"),
    [
        ((5.0, 0.6), (8.0, 0.8), True),
        # d/sqrt(2) is half of the size where d is sqrt(2)/2 of it
        ((5.0, 0.01), (8.5, 0.01), True),
        ((5.0, 0.01), (8.6, 0.01), False),
        ((5.0, 0.01), (1.5, 0.01), True),
        ((5.0, 0.01), (1.4, 0.01), False),
        ((5.0, 0.01), (-5.0, 0.01), False),
        # they agree, but the size is not known
        ((5.0, 2.4), (5.0, 0.1), True),
        ((5.0, 2.6), (5.0, 0.1), False),
        ((5.0, math.nan), (-5.0, 0.01), False),
        ((5.0, 0.01), (-5.0, math.inf), True),
    ],
)
def test_an_effect_is_accepted_if_its_size_is_known_beside_all_that_is_left(first, second, known):
    one, other = (of("spring@elbow", {"k": value}, {"k": std}, cost=1.0) for value, std in (first, second))
    said = judgement([added(SPRING, fitted=one)], other)
    assert list(said.undetermined_sizes(LIMITS)) == ([] if known else ["spring@elbow"])
    assert (said.verdict, said.unknown_reason) == (("effect", "") if known else ("unknown", "stand_in"))
    here, there = (f"{value:.4g} ± {std:.2g} N m on the" for value, std in (first, second))
    text = f"spring@elbow.k is {here} fitted recordings and {there} held-out ones"
    assert said.transfer_texts == {"spring@elbow": [text]}


def test_one_part_of_a_vector_that_agrees_is_enough():
    stds = {"x": 1e-3, "y": 1e-3}
    one, other = (of("shift@grasp", values, stds, (SHIFT,)) for values in ({"x": 1.0, "y": 0.1}, {"x": 1.0, "y": -0.1}))
    assert judgement([added(SHIFT, fitted=one)], other).undetermined_sizes(LIMITS) == {}
    far = of("shift@grasp", {"x": -1.0, "y": -0.1}, stds, (SHIFT,))
    assert judgement([added(SHIFT, fitted=one)], far).undetermined_sizes(LIMITS).keys() == {"shift@grasp"}


@pytest.mark.parametrize(
    ("first", "second", "std"),
    [
        # 2 apart: as likely as not with 0.6 and 0.8, together 1
        ((2.0, 0.6), (4.0, 0.8), 0.6),
        ((2.0, 0.6), (4.1, 0.8), 2.1 / math.sqrt(2)),
        ((4.1, 0.6), (2.0, 0.8), 2.1 / math.sqrt(2)),
        ((2.0, 1.6), (5.5, 0.1), 3.5 / math.sqrt(2)),
        ((2.0, math.inf), (5.0, 0.1), math.inf),
        ((2.0, 0.1), (5.0, math.nan), 0.1),
    ],
)
def test_standard_deviations_count_how_far_two_sets_of_recordings_are_apart(first, second, std):
    one, other = (of("spring@elbow", {"k": value, "s": 3.0}, {"k": size}) for value, size in (first, second))
    pairs = ((one, other), (other, one))
    both = (judgement([added(SPRING, fitted=own)], there).selected_effects for own, there in pairs)
    counted, again = (chosen[0].refitted_model for chosen in both)
    assert counted.std == one.std | {"spring@elbow.k": pytest.approx(std)}
    assert counted.values == one.values
    reach = 2 * (counted.std["spring@elbow.k"] + again.std["spring@elbow.k"])
    assert not abs(first[0] - second[0]) > reach  # their intervals overlap


@pytest.mark.parametrize(("there", "std"), [(None, 0.4), (2.1, 0.4), (3.0, math.sqrt(0.5))])
def test_an_estimate_is_as_unsure_as_further_effects_and_other_recordings_make_it(there, std):
    first = explaining(0.6, [SPRING], values={"spring@elbow.k": 2.0, "spring@elbow.s": 3.0})
    again = None if there is None else fit([SPRING], values=first.values | {"spring@elbow.k": there})
    [found] = judgement((added(SPRING, fitted=first),), again, beside={"spring@elbow.k": 0.4}).selected_effects
    assert found.refitted_model.std == {"spring@elbow.k": pytest.approx(std), "spring@elbow.s": 0.01}


@pytest.mark.parametrize(("degrees", "seen", "enough"), [(5.1, True, True), (5.0, True, False), (9.0, False, False)])
def test_data_suffice_if_samples_outnumber_unknowns_and_a_candidate_is_detectable(degrees, seen, enough):
    screened = f.screening(seen=[f.visible(ONE, seen)])
    test = f.outcome(degrees=degrees)
    evidence = NominalModelGapEvidence(fit(values=dict.fromkeys("abcde", 1.0)), test, test, screened, True)
    assert evidence.are_data_sufficient is evidence.warrants_effect_search(LIMITS) is enough


class Problem:
    """Episodes and held-out ones that can change places."""

    def with_equilibria_near_first_points(self, values):
        return self

    def __init__(self, episodes=("own",), held_out=("other",)):
        self.episodes, self.held_out, self.has_process_noise, self.free = episodes, held_out, False, ("k",)

    def with_episodes(self, episodes, held_out):
        return Problem(episodes, held_out)


def test_the_held_out_recordings_are_fitted_with_the_same_effects(monkeypatch):
    asked = []
    first = of("spring@elbow", {"k": 2.0}, {"k": 0.1})
    again = of("spring@elbow", {"k": 7.0}, {"k": 0.1})
    first.values.update({"k": 3.0, "start.tip[own]": 0.2})

    def refitted(search, effects, start, name):
        problem, store, limits = search.problem, search.store, search.thresholds
        asked.append((problem.problem.episodes, problem.problem.held_out, effects, dict(start), store, name, limits))
        return again

    monkeypatch.setattr("yid_ocp.diagnosis.refit.refit_with_effects", refitted)
    search = RefitContext(AllCandidatesProblem(Problem(), (SPRING,), False), Thresholds(), NULL_PROGRESS, "store")
    [[text]] = judgement([added(SPRING, fitted=first)], search=search).transfer_texts.values()
    assert ("is 2 ±" in text, "and 7 ±" in text) == (True, True)
    [(episodes, held_out, effects, start, store, name, limits)] = asked
    assert (episodes, held_out, effects, store, limits) == (("other",), ("own",), (SPRING,), "store", Thresholds())
    assert start == {"k": 3.0, "spring@elbow.k": 2.0, "spring@elbow.s": 0.5}, "no start of a single recording"
    assert ("spring@elbow" in name, "held-out" in name) == (True, True)


@cases("blocks", {"in blocks": (True,), "no fit": (False,)})
def test_nothing_is_compared_where_there_is_nothing_to_compare(monkeypatch, blocks):
    asked = []
    monkeypatch.setattr("yid_ocp.diagnosis.refit.refit_with_effects", lambda *_: asked.append(True))
    search = RefitContext(AllCandidatesProblem(Problem(), (SPRING,), blocks), Thresholds(), NULL_PROGRESS)
    assert judgement([added(SPRING)], search=search).transfer_texts == {}
    assert bool(asked) is not blocks


@cases(
    "k, prior, far",
    {
        "near": (5.9, 9.9, False), "too stiff": (6.1, 0.0, True), "too soft": (0.6, 0.0, True),
        "beside a prior": (2.0, -10.1, True),
    },
)  # fmt: skip
def test_a_fit_far_from_its_initial_values_or_priors_is_no_start_for_others(k, prior, far):
    """Residuals of priors count in stated stds; a value that begins at zero has no ratio."""
    initial = SimpleNamespace(named_values=lambda _: {"k": 2.0, "tip.x": 0.0})
    rows, options = SimpleNamespace(stated_priors=slice(1, 2)), SimpleNamespace(stated_std_factor=2.0)
    names = {"shared_parameters": ("k", "tip.x"), "initial_unknowns": None}
    problem = SimpleNamespace(residual_rows=rows, options=options, unknowns=initial, **names)
    model = fit(values={"k": k, "tip.x": 0.3}, problem=problem)
    assert _has_left_start(replace(model, evaluation=f.evaluation([99.0, prior]))) is far
