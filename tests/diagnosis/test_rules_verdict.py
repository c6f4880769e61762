"""Is there a gap, is it chance, what is the verdict: rule by rule."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from factories import BIAS, FORCE, READ_FORCE, added, closed, effect, fit, outcome, score, smoothed, visible

from yid_ocp.diagnosis.thresholds import Thresholds
from yid_ocp.diagnosis.verdict import (
    compute_explained_fraction,
    decide_verdict,
    find_unknown_reason,
    has_gap,
    is_chance_excess,
)

LIMITS = Thresholds(min_explained_fraction=0.5)
ONE, OTHER = effect("friction@elbow"), effect("offset@elbow")
ELSEWHERE, THIRD = effect("friction@wrist"), effect("spring@elbow")
LOADS = effect("load@elbow", alone=True), effect("load@wrist", alone=True)


def scored(*p_values):
    return [score(effect(f"kind{i}@x"), p=p) for i, p in enumerate(p_values)]


# -- is there a gap ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("before", "held_out", "gap"),
    [
        ((0.004, 1.2), (0.5, 1.0), True),
        ((0.5, 1.0), (0.004, 1.2), True),
        ((0.006, 1.2), (0.5, 1.0), False),
        ((0.5, 1.0), (0.006, 1.2), False),
        ((0.005, 1.2), (0.5, 1.0), False),
        ((0.0, 1.05), (0.0, 1.09), False),
        ((0.0, 1.1), (0.0, 1.1), False),
        ((0.0, 1.0), (0.5, 1.11), True),
        ((0.5, 1.11), (0.0, 1.0), True),
        ((0.5, 5.0), (0.5, 5.0), False),
    ],
    ids=[
        "sure on the data of the fit",
        "sure on held-out data",
        "two tests: the smaller p counts twice",
        "two tests, the other way",
        "at the level",
        "sure but small",
        "at the smallest gap",
        "large on the other data",
        "large on the fit's data",
        "large but chance",
    ],
)
def test_a_gap_is_sure_and_worth_a_name(before, held_out, gap):
    tests = [outcome(p=p, chi2=chi2, channels={"a": 1.0}) for p, chi2 in (before, held_out)]
    assert has_gap(*tests, LIMITS) is gap


@pytest.mark.parametrize(
    ("p_values", "before", "held_out", "gap"),
    [
        ((0.004,), {"a": 1.2}, {"a": 1.0}, True),
        ((0.004, 0.9), {"a": 1.0}, {"a": 1.0, "b": 1.2}, True),
        ((0.006, 0.9), {"a": 1.2}, {"a": 1.0}, False),
        ((0.9, 0.001, 0.9, 0.9), {"a": 1.2}, {"a": 1.0}, True),
        ((0.9, 0.003, 0.9, 0.9), {"a": 1.2}, {"a": 1.0}, False),
        ((0.01,), {"a": 1.2}, {"a": 1.2}, False),
        ((0.001,), {"a": 1.02}, {"a": 1.01}, False),
        ((0.001,), {"a": 1.03}, {"a": 0.9}, False),
        ((0.001,), {}, {}, False),
        ((), {"a": 1.2}, {"a": 1.2}, False),
    ],
    ids=[
        "along one candidate",
        "in a held-out channel",
        "best of two tries",
        "best of four tries",
        "not the best of four tries",
        "at the level",
        "no channel above noise",
        "channels at the smallest excess",
        "no channel",
        "no candidate",
    ],
)
def test_a_gap_along_a_candidate_needs_a_channel_above_noise(p_values, before, held_out, gap):
    tests = [outcome(channels=channels) for channels in (before, held_out)]
    assert (
        has_gap(*tests, Thresholds(min_channel_excess_chi2=0.03, candidate_significance_level=0.01), scored(*p_values))
        is gap
    )


@pytest.mark.parametrize(
    ("label", "p", "stated", "gap"),
    [
        ("effort_offset@elbow", 4e-5, True, True),
        ("effort_offset@elbow", 5e-5, True, False),
        ("effort_offset@elbow", 4e-5, False, False),
        ("joint_viscous@elbow", 4e-5, True, False),
    ],
    ids=["beyond", "within", "nobody stated any", "another effect"],
)
def test_an_offset_beyond_what_was_stated_needs_no_channel_above_noise(label, p, stated, gap):
    ranked = (score(effect(label), p=p), score(effect("friction@wrist"), p=0.9))
    assert has_gap(outcome(), outcome(), LIMITS, ranked, stated) is gap


def test_the_level_and_the_smallest_gap_are_thresholds():
    tests = (outcome(p=0.02, chi2=1.2), outcome())
    assert has_gap(*tests, Thresholds(significance_level=0.05))
    assert not has_gap(*tests, Thresholds(significance_level=0.05, min_excess_chi2=0.3))
    by_one = Thresholds(candidate_significance_level=0.05)
    assert has_gap(outcome(), outcome(chi2=1.2), by_one, scored(0.03))
    assert not has_gap(outcome(), outcome(chi2=1.2), replace(by_one, min_channel_excess_chi2=0.3), scored(0.03))
    assert not has_gap(outcome(), outcome(chi2=1.2), Thresholds(significance_level=0.05), scored(0.03))


# -- is it chance -----------------------------------------------------------------------------------------------------

SILENT = smoothed({FORCE: 0.0, BIAS: 0.0})
SPEAKING = smoothed({FORCE: 9.0, BIAS: 0.0}, evidence={"plant": 9.0, "both": 9.0})


@pytest.mark.parametrize(
    ("found", "p_values", "before", "held_out", "chance"),
    [
        (SILENT, (0.5,), 0.003, 0.5, True),
        (SILENT, (0.5,), 0.5, 0.003, True),
        (SILENT, (), 0.003, 0.5, True),
        (SILENT, (0.5,), 0.00009, 0.5, False),
        (SILENT, (0.5,), 0.5, 0.00009, False),
        (SILENT, (0.5,), 0.0001, 0.5, False),
        (SILENT, (0.5,), 0.00011, 0.5, True),
        (SILENT, (0.004, 0.9), 0.003, 0.5, False),
        (SILENT, (0.006, 0.9), 0.003, 0.5, True),
        (SILENT, (0.005, 0.9), 0.003, 0.5, True),
        (SPEAKING, (0.5,), 0.003, 0.5, False),
    ],
    ids=[
        "barely",
        "barely on held-out data",
        "no candidate",
        "sure",
        "sure on held-out data",
        "as sure as needed",
        "not as sure as needed",
        "explained by a candidate",
        "best of two tries",
        "at the level",
        "explained by a force",
    ],
)
def test_a_barely_significant_excess_without_shape_is_chance(found, p_values, before, held_out, chance):
    assert is_chance_excess(found, scored(*p_values), outcome(p=before), outcome(p=held_out), LIMITS) is chance


def test_how_sure_an_excess_without_shape_must_be_is_a_threshold():
    tests = outcome(p=0.003), outcome()
    assert not is_chance_excess(SILENT, (), *tests, Thresholds(unexplained_p_factor=0.5))
    assert is_chance_excess(SILENT, (), *tests, Thresholds(unexplained_p_factor=0.5, significance_level=0.001))


# -- the verdict ------------------------------------------------------------------------------------------------------

SEEN = (visible(ONE),)
CERTAIN = closed(0.45, 0.4, 0.49)


@pytest.mark.parametrize(
    ("changed", "verdict"),
    [
        ({}, "effect"),
        ({"enough": False}, "insufficient_data"),
        ({"visible": (visible(ONE, seen=False),)}, "insufficient_data"),
        ({"visible": ()}, "insufficient_data"),
        ({"visible": (visible(ONE, seen=False), visible(OTHER))}, "effect"),
        ({"enough": False, "gap": False}, "insufficient_data"),
        ({"gap": False}, "no_gap"),
        ({"gap": False, "added": ()}, "no_gap"),
        ({"added": ()}, "unknown"),
        ({"total": closed(0.9, 0.04, 1.0)}, "unknown"),
        ({"total": closed(0.9, 0.05, 1.0)}, "unknown"),
        ({"total": closed(0.06, 0.051, 0.07)}, "effect"),
        ({"total": closed(0.9, math.nan, math.nan)}, "unknown"),
        ({"explained": 0.49}, "unknown"),
        ({"explained": 0.5}, "effect"),
        ({"explained": 0.1, "total": closed(0.9, 0.5, 0.95)}, "effect"),
        ({"explained": 0.1, "total": closed(0.9, 0.49, 0.95)}, "unknown"),
        ({"explained": 0.1, "total": replace(closed(0.9, math.nan, math.nan), is_decisive=True)}, "unknown"),
        ({"explained": 7.0}, "effect"),
        ({"added": (added(ONE, [OTHER]),)}, "confusable"),
        ({"added": (added(ONE, [OTHER]), added(OTHER))}, "confusable"),
        ({"added": (added(ONE), added(OTHER, [ONE]))}, "effect"),
        ({"added": (added(ONE, [OTHER]),), "explained": 0.1}, "unknown"),
        ({"added": (added(ONE), added(OTHER)), "explained": 0.74}, "unknown"),
        ({"added": (added(ONE), added(OTHER)), "explained": 0.75}, "effect"),
        ({"added": (added(ONE), added(OTHER)), "explained": 0.1, "total": closed(0.95, 0.9, 0.98)}, "unknown"),
        ({"added": (added(ONE), added(OTHER), added(THIRD)), "explained": 0.87}, "unknown"),
        ({"added": (added(ONE), added(OTHER), added(THIRD)), "explained": 0.88}, "effect"),
        ({"added": (added(ONE), added(ELSEWHERE)), "explained": 0.49}, "unknown"),
        ({"added": (added(ONE), added(ELSEWHERE)), "explained": 0.5}, "effect"),
        ({"added": (added(LOADS[0]), added(LOADS[1])), "explained": 0.74}, "unknown"),
        ({"added": (added(LOADS[0]), added(LOADS[1])), "explained": 0.75}, "effect"),
        ({"added": (added(ONE), added(ELSEWHERE)), "explained": 0.1, "total": closed(0.9, 0.5, 1.0)}, "effect"),
        ({"carried": False}, "unknown"),
        ({"carried": False, "gap": False}, "no_gap"),
    ],
    ids=[
        "an effect",
        "too few samples",
        "nothing could be seen",
        "no candidate",
        "one could be seen",
        "too few samples and no gap",
        "no gap",
        "no gap and nothing added",
        "nothing added",
        "closure sure by too little, however large",
        "lower end at the limit",
        "lower end just above the limit",
        "no interval",
        "smoother explains more than twice as much",
        "smoother explains twice as much",
        "little where it was fitted, half of the held-out gap",
        "little where it was fitted, hardly half of the held-out gap",
        "little where it was fitted, no interval on held-out motions",
        "smoother explains less",
        "two that do the same",
        "two that do the same, and more",
        "only later ones do the same",
        "confusable but explains little",
        "two explain too little for two",
        "two explain enough",
        "two explain little where they were fitted, however much of the held-out gap",
        "three explain too little for three",
        "three explain enough",
        "one law at two places explains too little",
        "one law at two places explains enough",
        "loads at two places explain too little for two",
        "loads at two places explain enough for two",
        "one law at two places, half of the held-out gap",
        "does not carry over",
        "does not carry over where there is no gap",
    ],
)
def test_the_verdict(changed, verdict):
    usual = {"gap": True, "visible": SEEN, "added": (added(ONE),), "total": CERTAIN, "enough": True, "explained": 1.0}
    said = usual | {"carried": True} | changed
    found = decide_verdict(
        said["gap"],
        said["visible"],
        said["added"],
        said["total"],
        LIMITS,
        said["enough"],
        said["explained"],
        said["carried"],
    )
    assert found == verdict


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({}, ""),
        ({"added": (), "explained": 0.1, "carried": False}, "none"),
        ({"total": closed(0.9, 0.04, 1.0), "explained": 0.1}, "unsure"),
        ({"explained": 0.1, "carried": False}, "little"),
        ({"carried": False}, "stand_in"),
    ],
)
def test_the_first_reason_that_holds_is_why_a_gap_has_no_name(changed, reason):
    said = {"added": (added(ONE),), "total": CERTAIN, "explained": 1.0, "carried": True} | changed
    assert find_unknown_reason(said["added"], said["total"], LIMITS, said["explained"], said["carried"]) == reason


def test_without_a_smoother_the_explained_part_is_whole():
    assert decide_verdict(True, SEEN, (added(ONE),), CERTAIN, LIMITS, True) == "effect"
    assert compute_explained_fraction(fit(), (added(ONE),), None) == 1.0
    assert compute_explained_fraction(fit(), (), SPEAKING) == 1.0


@pytest.mark.parametrize(
    ("costs", "chi2", "degrees", "part"),
    [
        ((100.0, 60.5), (200.0, 110.0), (90.0, 78.0), 1.0),
        ((100.0, 80.5), (200.0, 110.0), (90.0, 78.0), 38.0 / 78.0),
        ((100.0, 60.5), (200.0, 110.0), (90.0, 90.0), 78.0 / 90.0),
        ((100.0, 60.5), (110.0, 100.0), (90.0, 80.0), 1.0),
        ((100.0, 60.5), (100.0, 110.0), (90.0, 90.0), 1.0),
        ((100.0, 100.0), (200.0, 110.0), (90.0, 78.0), -1.0 / 78.0),
    ],
    ids=[
        "as much",
        "half",
        "smoother takes no noise",
        "smoother explains nothing",
        "smoother is worse",
        "explains less",
    ],
)
def test_what_effects_explain_of_what_can_be_explained(costs, chi2, degrees, part):
    """Fall of r'r less what one parameter takes, over the smoother's fall less the degrees of freedom that it takes."""
    nominal, last = fit(cost=costs[0]), added(ONE, fitted=fit([ONE], cost=costs[1]))
    first = added(OTHER, fitted=fit([OTHER], cost=1e3))
    found = smoothed({FORCE: 1.0}, chi2=chi2, degrees=degrees)
    assert compute_explained_fraction(nominal, (first, last), found) == pytest.approx(part)


def test_two_effects_take_of_the_noise_what_all_their_parameters_take():
    last = added(ONE, fitted=fit([ONE, OTHER], cost=60.0))
    found = smoothed({FORCE: 1.0}, chi2=(200.0, 110.0), degrees=(90.0, 78.0))
    assert compute_explained_fraction(fit(cost=100.0), (last,), found) == pytest.approx(78.0 / 78.0)


# -- on which side ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("weight", "evidence", "side"),
    [
        ({FORCE: 0.0}, {}, "none"),
        ({FORCE: 9.0}, {"plant": -1.0, "sensor": -2.0, "both": -1.0}, "none"),
        ({FORCE: 9.0, BIAS: 0.0}, {"plant": 9.0, "sensor": 3.0, "both": 9.0}, "plant"),
        ({FORCE: 0.0, BIAS: 9.0}, {"plant": 3.0, "sensor": 9.0, "both": 9.0}, "sensor"),
        ({FORCE: 9.0, BIAS: 3.0}, {"plant": 9.0, "sensor": 3.0, "both": 14.0}, "plant"),
        ({FORCE: 9.0, BIAS: 3.0}, {"plant": 9.0, "sensor": 3.0, "both": 14.1}, "both"),
        ({FORCE: 3.0, BIAS: 9.0}, {"plant": 3.0, "sensor": 9.0, "both": 14.1}, "both"),
        ({FORCE: 3.0, BIAS: 9.0}, {"plant": 3.0, "sensor": 9.0, "both": 13.9}, "sensor"),
        ({READ_FORCE: 9.0, BIAS: 3.0}, {"plant": 9.0, "sensor": 3.0, "both": 20.0}, "either"),
        ({READ_FORCE: 3.0, FORCE: 9.0}, {"plant": 9.0, "sensor": 0.0, "both": 9.0}, "plant"),
        ({FORCE: 0.1}, {"plant": 0.1, "both": 0.1}, "plant"),
    ],
    ids=[
        "nothing",
        "worse than nothing",
        "plant",
        "sensor",
        "both by chance",
        "both",
        "both, mostly the sensor",
        "mostly the sensor",
        "an effort's bias would do the same",
        "another force weighs more",
        "little",
    ],
)
def test_the_side_of_a_gap_by_evidence(weight, evidence, side):
    assert smoothed(weight, evidence=evidence).gap_origin == side


def test_how_much_more_both_must_explain_is_a_threshold():
    evidence = {"plant": 9.0, "sensor": 3.0, "both": 12.0}
    assert smoothed({FORCE: 9.0, BIAS: 3.0}, evidence=evidence, min_log_bayes_factor=2.0).gap_origin == "both"


@pytest.mark.parametrize(
    ("chi2", "degrees", "part"),
    [
        ((200.0, 90.0), (100.0, 90.0), 1.0),
        ((200.0, 135.0), (100.0, 90.0), 0.5),
        ((200.0, 200.0), (100.0, 100.0), 0.0),
        ((200.0, 400.0), (100.0, 100.0), 0.0),
        ((200.0, 45.0), (100.0, 90.0), 1.0),
        ((100.0, 45.0), (100.0, 90.0), 0.0),
        ((90.0, 45.0), (100.0, 90.0), 0.0),
    ],
    ids=["all", "half", "nothing", "worse", "more than all", "no gap", "below noise"],
)
def test_the_part_of_a_gap_that_can_be_explained_at_all(chi2, degrees, part):
    assert smoothed({FORCE: 1.0}, chi2=chi2, degrees=degrees).explainable_fraction == pytest.approx(part)
