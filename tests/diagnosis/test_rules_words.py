"""What a finding says, in sentences and as `yid-diagnosis/2`: rule by rule."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import get_args

import pytest
from factories import (
    BIAS,
    FORCE,
    READ_FORCE,
    absorbed,
    added,
    amplitude,
    carried,
    closed,
    effect,
    finding,
    fit,
    loss,
    outcome,
    place,
    score,
    smoothed,
    visible,
)

from yid_ocp.diagnosis.diagnosis_messages import _UNKNOWN_REASON_TEXTS, diagnosis_summary_text, next_experiment_text
from yid_ocp.diagnosis.diagnosis_result import _ranked_candidates
from yid_ocp.diagnosis.hypotheses import TruncatedRecording
from yid_ocp.diagnosis.thresholds import Thresholds
from yid_ocp.diagnosis.verdict import UnknownReason

FRICTION, OFFSET = effect("friction@elbow"), effect("offset@wrist", amplitude(lower=-9.0))
NO_EFFECT = {"added": (), "fits": ()}


# -- is there a gap ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("verdict", "p_values", "said"),
    [
        ("effect", (1e-3, 0.5), "The gap is real (held-out chi2 per degree of freedom 2.35, p = 0.001)."),
        ("effect", (0.5, 2e-3), "The gap is real (held-out chi2 per degree of freedom 2.35, p = 0.002)."),
        ("unknown", (1e-12, 0.5), "The gap is real (held-out chi2 per degree of freedom 2.35, p < 1e-12)."),
        ("unknown", (1.1e-12, 0.5), "The gap is real (held-out chi2 per degree of freedom 2.35, p = 1.1e-12)."),
        (
            "no_gap",
            (0.4, 0.3),
            "There is no gap to speak of (chi2 per degree of freedom 1.12, held out 2.35; p = 0.3).",
        ),
        (
            "no_gap",
            (0.2, 0.3),
            "There is no gap to speak of (chi2 per degree of freedom 1.12, held out 2.35; p = 0.2).",
        ),
    ],
)
def test_whether_there_is_a_gap_comes_first(verdict, p_values, said):
    before, held = outcome(p=p_values[0], chi2=1.123), outcome(p=p_values[1], chi2=2.345)
    made = finding(verdict, nominal_test=before, nominal_held_out_test=held, **NO_EFFECT)
    assert diagnosis_summary_text(made).startswith(said)


def test_insufficient_data_say_why_and_nothing_of_places():
    said = diagnosis_summary_text(
        finding("insufficient_data", message="4 samples.", next_experiment="Longer.", **NO_EFFECT)
    )
    assert said == "The data do not suffice: 4 samples. Next experiment: Longer."
    none = diagnosis_summary_text(finding("no_gap", next_experiment="None is needed.", **NO_EFFECT))
    assert none.endswith("p = 1e-09). Next experiment: None is needed.")


# -- where ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("shares", "said"),
    [
        ({"T1": 0.95, "T2": 0.05}, "It lies in T1 (95 %)."),
        ({"T1": 0.8, "T2": 0.2}, "It lies in T1 (80 %) and T2 (20 %)."),
        ({"T1": 0.9, "T2": 0.1}, "It lies in T1 (90 %)."),
        ({"T1": 0.4, "T2": 0.25, "T3": 0.2, "T4": 0.15}, "It lies in T1 (40 %) and T2 (25 %) and T3 (20 %)."),
        ({"T1": 0.06, "T2": 0.05}, "It lies in T1 (6 %)."),
    ],
    ids=["one", "two", "at the limit", "three at most", "none above the limit"],
)
def test_places_with_much_of_the_gap_are_named(shares, said):
    made = finding("unknown", gap_locations=tuple(place(name, share) for name, share in shares.items()), **NO_EFFECT)
    assert f"{said} No known effect explains it." in diagnosis_summary_text(made)


def test_without_places_nothing_is_said_of_them():
    assert "It lies" not in diagnosis_summary_text(finding("unknown", gap_locations=(), **NO_EFFECT))


@pytest.mark.parametrize(
    ("weight", "evidence", "said"),
    [
        ({FORCE: 9.0}, {"plant": 9.0, "both": 9.0}, " (100 %), in the mechanics rather than in what sensors read."),
        ({BIAS: 9.0}, {"sensor": 9.0, "both": 9.0}, " (100 %), in what sensors read."),
        (
            {READ_FORCE: 9.0},
            {"plant": 9.0, "both": 9.0},
            " (100 %), in the mechanics or in what the effort sensor reads, which efforts alone do not tell apart.",
        ),
        ({FORCE: 9.0, BIAS: 9.0}, {"plant": 9.0, "sensor": 9.0, "both": 20.0}, "It lies in T1 (100 %)."),
    ],
)
def test_the_side_is_said_where_the_evidence_tells(weight, evidence, said):
    made = finding("unknown", smoother_result=smoothed(weight, evidence=evidence), **NO_EFFECT)
    assert said in diagnosis_summary_text(made)


# -- which ------------------------------------------------------------------------------------------------------------


def with_effect(of, value, std=0.02, **changed):
    """A finding in which this effect was added."""
    fitted = fit(
        [of],
        loss(1.0, 1.1),
        values=dict.fromkeys(of.amplitude_names, value),
        std=dict.fromkeys(of.amplitude_names, std),
    )
    return finding(**({"added": (added(of, fitted=fitted),), "fits": (fitted,)} | changed))


@pytest.mark.parametrize(
    ("unit", "std", "said"),
    [
        ("N m", 0.0234, "friction@elbow with a = 0.457 ± 0.023 N m closes"),
        ("1", 0.0234, "friction@elbow with a = 0.457 ± 0.023 closes"),
        ("N m", math.inf, "friction@elbow with a unknown closes"),
        ("N m", math.nan, "friction@elbow with a unknown closes"),
    ],
)
def test_an_effect_is_said_with_its_numbers(unit, std, said):
    of = effect("friction@elbow", amplitude(unit=unit))
    assert said in diagnosis_summary_text(with_effect(of, 0.4567, std))


def test_a_closure_is_said_with_its_interval():
    said = diagnosis_summary_text(with_effect(FRICTION, 0.5, closure=closed(0.9123, 0.8012, 0.9534)))
    assert "closes 91.2 % of it on held-out motions (95 % interval 80.1 to 95.3 %)." in said


def test_two_effects_close_together():
    both = fit([FRICTION, OFFSET], values={"friction@elbow.a": 0.5, "offset@wrist.a": 0.25})
    said = diagnosis_summary_text(finding(selected_effects=(added(FRICTION), added(OFFSET, fitted=both))))
    assert "friction@elbow with a = 0.5 ± 0.01 N m; offset@wrist with a = 0.25 ± 0.01 N m together close 90 %" in said


def test_rivals_are_said_to_be_not_separable():
    third = effect("third@x")
    said = diagnosis_summary_text(with_effect(FRICTION, 0.5, added=(added(FRICTION, [OFFSET, third]),)))
    assert "Not separable from friction@elbow: offset@wrist, third@x." in said
    assert "Not separable" not in diagnosis_summary_text(with_effect(FRICTION, 0.5))


@pytest.mark.parametrize(("value", "odd"), [(2.0, False), (2.5, False), (2.51, True), (-0.5, False), (-0.51, True)])
def test_an_amplitude_beyond_its_range_may_stand_in_for_something_else(value, odd):
    """By more than a quarter of the range, that is."""
    of = effect("offset@wrist", amplitude(neutral=9.0, lower=-99.0, upper=99.0, expected=(0.0, 2.0)))
    sentence = "Beyond what one would expect, and so perhaps standing in for something else: "
    expected = f"{sentence}offset@wrist.a = {value:.3g} (range 0 to 2)."
    assert (expected in diagnosis_summary_text(with_effect(of, value))) is odd


def test_an_amplitude_at_its_neutral_value_is_never_odd():
    of = effect("factor@T1", amplitude(neutral=9.0, expected=(0.0, 1.0)))
    assert "Beyond" not in diagnosis_summary_text(with_effect(of, 9.0))
    assert "Beyond" in diagnosis_summary_text(with_effect(of, 8.0))


@pytest.mark.parametrize(
    ("chi2", "p", "places", "said"),
    [
        (1.23, 0.002, (place("T2"),), "What remains: held-out chi2 per degree of freedom 1.23, most of it in T2."),
        (1.23, 0.002, (), "What remains: held-out chi2 per degree of freedom 1.23."),
        (1.23, 0.02, (), "What remains is noise."),
        (1.23, 0.01, (), "What remains is noise."),
        (0.9, 0.002, (), "What remains is noise."),
        (1.0, 0.002, (), "What remains is noise."),
    ],
)
def test_what_remains(chi2, p, places, said):
    made = with_effect(FRICTION, 0.5, remaining=outcome(p=p, chi2=chi2), remaining_where=places)
    assert f" {said} " in diagnosis_summary_text(made)


@pytest.mark.parametrize(
    ("before", "after", "said"),
    [
        (10.0, 11.1, True),
        (10.0, 8.9, True),
        (10.0, 11.0, False),
        (-10.0, -8.9, True),
        (0.0, 1e-9, True),
        (0.0, 1e-11, False),
    ],
)
def test_a_parameter_that_moves_much_is_said_to(before, after, said):
    made = with_effect(FRICTION, 0.5, absorbed=(absorbed("T1.bend", before, after),))
    assert (f"With it T1.bend goes from {before:.3g} to {after:.3g}." in diagnosis_summary_text(made)) is said


def test_six_parameters_at_most_are_said_to_move():
    made = with_effect(FRICTION, 0.5, absorbed=tuple(absorbed(f"p{i}", 1.0, 2.0) for i in range(8)))
    said = diagnosis_summary_text(made)
    assert "p5 goes from 1 to 2. Next" in said
    assert "p6" not in said


def test_an_unknown_gap_names_the_best_attempt():
    said = diagnosis_summary_text(
        finding("unknown", single_effect_models=(fit([OFFSET]), fit([FRICTION])), selected_effects=())
    )
    assert "No known effect explains it (the best, offset@wrist, is not sure to be there and to close a part)." in said


def test_blocks_and_the_next_experiment_come_last():
    said = diagnosis_summary_text(with_effect(FRICTION, 0.5, in_blocks=True, next_experiment="Repeat."))
    assert said.endswith("alternate blocks of what is estimated on were held out. Next experiment: Repeat.")
    assert "blocks" not in diagnosis_summary_text(with_effect(FRICTION, 0.5))


# -- yid-diagnosis/2 --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("verdict", ["effect", "confusable", "unknown", "no_gap", "insufficient_data"])
def test_effects_count_only_where_the_verdict_names_them(verdict):
    made = finding(verdict, selected_effects=(added(FRICTION, [OFFSET]),))
    result = made.to_dict()
    named = verdict in ("effect", "confusable")
    assert made.final_model is (made.selected_effects[-1].refitted_model if named else made.nominal_model)
    assert result["effects"] == ([{"kind": "friction", "location": "elbow"}] if named else [])
    assert result["gap"]["closure"] == (0.9 if named else None)
    assert result["gap"]["closure_ci"] == ([0.8, 0.95] if named else None)
    assert len(result["confusable"]) == (1 if named else 0)
    after = result["gap"]["after"]["rmse"]
    assert after == result["gap"]["before"]["rmse"] == {"points.tip": 0.01}


def test_numbers_that_are_not_finite_become_null():
    made = finding(
        gap_closure=closed(0.9, math.nan, math.inf),
        nominal_changes=(absorbed("T1.bend", 1.0, 2.0, math.inf),),
        selected_effects=(added(FRICTION, part=closed(math.nan, 0.1, 0.2)),),
    )
    result = made.to_dict()
    assert result["gap"]["closure_ci"] == [None, None]
    assert result["absorption"]["T1.bend"] == {"before": 1.0, "after": 2.0, "std": None, "unit": "N m/rad"}
    assert result["steps"][0]["closure"] is None
    assert result["steps"][0]["closure_ci"] == [0.1, 0.2]


def test_the_result_holds_what_was_found():
    spoken = smoothed({FORCE: 9.0}, evidence={"plant": 9.0, "both": 9.0})
    made = finding(
        "confusable",
        selected_effects=(added(FRICTION, [OFFSET]), added(OFFSET)),
        smoother_result=spoken,
        gap_locations=(place("T1", 0.7, True, ((0.0, 1.0),)),),
        remaining_gap_locations=(place("T2", 0.3, False),),
        remaining_test=outcome(p=0.4, chi2=1.02),
        detectability=(visible(FRICTION), visible(OFFSET, seen=False)),
        is_split_in_blocks=True,
    )
    result = made.to_dict()
    assert result["format"] == "yid-diagnosis/2"
    assert result["gap"]["before"]["chi2_per_dof"] == made.nominal_held_out_test.chi2_per_dof
    assert result["gap"]["after"] | {"unit": None} == {
        "rmse": {"points.tip": 0.01},
        "unit": None,
        "chi2_per_dof": 1.02,
        "p_value": 0.4,
    }
    assert result["gap"]["before"]["unit"] == {"points.tip": "m"}
    assert result["where"] == [
        {"location": "T1", "share": 0.7, "observable": True, "windows": [[0.0, 1.0]], "indistinguishable_from": []}
    ]
    assert result["remaining"] == {
        "p_value": 0.4,
        "where": [{"location": "T2", "share": 0.3, "observable": False, "windows": [], "indistinguishable_from": []}],
    }
    both = [{"kind": "friction", "location": "elbow"}, {"kind": "offset", "location": "wrist"}]
    assert result["confusable"] == [both]
    assert [step["added"] for step in result["steps"]] == ["friction@elbow", "offset@wrist"]
    assert result["steps"][0]["chi2_per_dof"] == 1.0
    assert result["steps"][0]["rmse"] == {"points.tip": 0.01}
    assert (result["side"], result["explainable"], result["evidence"]["plant"]) == (
        "plant",
        spoken.explainable_fraction,
        9.0,
    )
    assert result["unseen"] == ["offset@wrist"]
    assert result["noise"] == {"points.tip": {"std": 0.001, "unit": "m", "samples": 100}}
    assert result["held_out_in_blocks"] is True


def test_candidates_are_listed_with_what_was_added_first():
    third = effect("third@x")
    alone = fit([OFFSET], loss(1.3, 1.4), values={"offset@wrist.a": 0.3})
    best = fit([FRICTION], loss(1.0, 1.1), values={"friction@elbow.a": 0.5}, std={"friction@elbow.a": math.inf})
    made = finding(
        nominal_model=fit(lost=loss(2.0, 2.0)),
        single_effect_models=(alone, best),
        selected_effects=(added(FRICTION, fitted=best),),
        candidate_scores=(
            score(third, p=0.2, statistic=7.0, step={"third@x.a": 0.7}),
            score(OFFSET, p=0.1, statistic=8.0),
            score(FRICTION, p=0.05, statistic=9.0),
        ),
    )
    listed = _ranked_candidates(made)
    assert [f"{e['kind']}@{e['location']}" for e in listed] == ["friction@elbow", "offset@wrist", "third@x"]
    assert [entry["score"] for entry in listed] == [9.0, 8.0, 7.0]
    assert [entry["p_value"] for entry in listed] == [0.05, 0.1, 0.2]
    assert listed[0]["parameters"]["a"] == {"value": 0.5, "std": None, "unit": "N m"}
    assert listed[1]["parameters"]["a"] == {"value": 0.3, "std": 0.01, "unit": "N m"}
    assert listed[2]["parameters"]["a"] == {"value": 0.7, "std": None, "unit": "N m"}
    assert [entry["closure"] for entry in listed] == [pytest.approx(0.95), pytest.approx(0.65), None]
    assert listed[1]["closure_ci"] == [pytest.approx(0.6), pytest.approx(0.7)]
    assert listed[2]["closure_ci"] is None


def test_a_refit_without_a_score_is_listed_as_insignificant():
    made = finding(candidate_scores=(), single_effect_models=(fit([OFFSET]),), selected_effects=())
    [entry] = _ranked_candidates(made)
    assert (entry["kind"], entry["score"], entry["p_value"]) == ("offset", 0.0, 1.0)


def test_an_unknown_gap_lists_refits_before_scores():
    made = finding("unknown", single_effect_models=(fit([OFFSET]),), candidate_scores=(score(FRICTION), score(OFFSET)))
    assert [entry["kind"] for entry in _ranked_candidates(made)] == ["offset", "friction"]


# -- why a gap has no name --------------------------------------------------------------------------------------------


def nameless(reason, **changed):
    return diagnosis_summary_text(
        finding("unknown", unknown_reason=reason, thresholds=Thresholds(min_explained_fraction=0.5), **changed)
    )


@pytest.mark.parametrize(
    ("reason", "changed", "said"),
    [
        (
            "unsure",
            {"gap_closure": closed(0.4, 0.01, 0.7)},
            "closes 40 % of it, but not surely: at least 1 %, where 5 %",
        ),
        (
            "little",
            {"explained_fraction": 0.31, "gap_closure": closed(0.4, 0.29, 0.5)},
            "explains 31 % of what unknown forces, offsets and biases explain, and surely closes 29 % on held-out "
            "motions; 50 % of either are asked.",
        ),
        (
            "stand_in",
            {"gap_closure": closed(0.91), "transfer_checks": (carried(),)},
            "imitates it (closing 91 % on held-out motions)",
        ),
    ],
)
def test_why_a_gap_has_no_name_is_said_with_the_numbers_that_decide_it(reason, changed, said):
    assert said in nameless(reason, **changed)
    assert "friction@elbow" in nameless(reason, **changed)


@pytest.mark.parametrize(
    ("reason", "said"), [("unsure", " close 9"), ("little", " explain 31 %"), ("stand_in", " imitate it")]
)
def test_several_effects_do_what_one_does(reason, said):
    both = (added(FRICTION), added(OFFSET))
    text = nameless(reason, selected_effects=both, explained_fraction=0.31, transfer_checks=(carried(),))
    assert f"friction@elbow and offset@wrist{said}" in text


def test_of_several_effects_more_is_asked_and_only_where_they_were_fitted():
    assert "; 75 % of the former are asked of 2 assumptions." in nameless(
        "little", selected_effects=(added(FRICTION), added(OFFSET)), explained_fraction=0.7
    )


def test_what_does_not_carry_over_is_named_with_both_values():
    entries = (carried(agrees=True, name="b", values=(3.0, 3.1)), carried(values=(0.5, 0.9), stds=(0.01, 0.02)))
    text = nameless("stand_in", transfer_checks=entries)
    assert "friction@elbow.a is 0.5 ± 0.01 N m on the recordings to estimate on and 0.9 ± 0.02 on the held-out" in text
    assert "friction@elbow.b" not in text


@pytest.mark.parametrize("reason", get_args(UnknownReason))
def test_every_reason_has_a_sentence(reason):
    assert reason == "" or reason in _UNKNOWN_REASON_TEXTS


def test_rejected_candidates_say_what_they_close_and_why_they_are_none():
    told = finding("unknown", unknown_reason="stand_in", transfer_checks=(carried(),)).to_dict()
    [rejected] = told["rejected_candidates"]
    assert (rejected["kind"], rejected["location"], rejected["closure"]) == ("friction", "elbow", 0.9)
    assert rejected["reason"].startswith(
        "friction@elbow.a is 0.5 ± 0.01 N m on the recordings to estimate on and 0.9 ±"
    )
    assert (told["reason"], told["effects"]) == ("stand_in", [])
    [entry] = told["carried_over"]
    assert (entry["value"], entry["again"], entry["agrees"]) == (0.5, 0.9, False)
    assert finding("unknown", unknown_reason="little").to_dict()["rejected_candidates"] == []


# -- places and recordings --------------------------------------------------------------------------------------------


def test_places_that_cannot_be_told_apart_are_named_together():
    at = replace(place("T3"), indistinguishable_from=("T1", "T2"))
    text = diagnosis_summary_text(finding(gap_locations=(at,)))
    assert "It lies in T3 or T1 or T2 (100 %)" in text
    assert finding(gap_locations=(at,)).to_dict()["where"][0]["indistinguishable_from"] == ["T1", "T2"]


@pytest.mark.parametrize(
    ("kept", "said"),
    [
        (1.8, "The nominal model follows other for 1.8 of 5 s only; the rest is left out."),
        (0.0, "The nominal model cannot follow other at all, which is left out."),
    ],
)
def test_a_recording_that_cannot_be_followed_is_named(kept, said):
    made = finding(truncated_recordings=(TruncatedRecording("other", kept, 5.0),))
    assert said in diagnosis_summary_text(made)
    assert made.to_dict()["gap"]["cut"] == [{"recording": "other", "kept": kept, "whole": 5.0}]


def test_blocks_for_want_of_a_recording_that_can_be_followed_are_said():
    text = diagnosis_summary_text(
        finding(truncated_recordings=(TruncatedRecording("other", 0.0, 5.0),), is_split_in_blocks=True)
    )
    assert "No held-out recording is left: alternate blocks" in text


# -- sentences that numbers would contradict --------------------------------------------------------------------------


@pytest.mark.parametrize("share", [0.0, 0.004])
def test_a_place_without_a_share_is_no_place(share):
    text = diagnosis_summary_text(finding("unknown", gap_locations=(place("spring_1", share),)))
    assert "spring_1" not in text.replace("Move spring_1", "")
    assert "These data do not tell where it lies." in text


@pytest.mark.parametrize(
    ("at", "share", "said"),
    [
        ("T1", 0.8, "Move T1 alone, slowly and fast, and hold it still in several postures."),
        ("world", 0.8, "Record other motions, faster and larger."),
        ("camera", 0.8, "Record other motions, faster and larger."),
        ("spring_1", 0.0, "Record other motions, faster and larger."),
    ],
)
def test_nobody_is_asked_to_move_what_does_not_move(at, share, said):
    assert next_experiment_text("unknown", (), (place(at, share),), ()) == said
