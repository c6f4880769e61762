"""A diagnosis as `yid-diagnosis/2`: rule by rule."""

import math
from dataclasses import replace
from typing import get_args, get_type_hints

import factories as f
import pytest

from yid_ocp.diagnosis.sentences import diagnosis_summary_text
from yid_ocp.diagnosis.verdict import Judgement

FRICTION, OFFSET = f.effect("friction@elbow"), f.effect("offset@wrist", f.amplitude(lower=-9.0))


@pytest.mark.parametrize("verdict", ["effect", "confusable", "unknown", "no_gap", "insufficient_data"])
def test_effects_count_only_where_the_verdict_names_them(verdict):
    made = f.finding(verdict, selected_effects=(f.added(FRICTION, [OFFSET]),))
    result = made.to_dict()
    named = verdict in ("effect", "confusable")
    assert made.final_model is (made.selected_effects[-1].refitted_model if named else made.nominal_model)
    assert result["effects"] == ([{"kind": "friction", "location": "elbow"}] if named else [])
    assert result["gap"]["closure"] == (0.9 if named else None)
    assert result["gap"]["closure_ci"] == ([0.8, 0.95] if named else [None, None])
    assert len(result["confusable"]) == (1 if named else 0)
    assert result["gap"]["after"]["rmse"] == result["gap"]["before"]["rmse"] == {"points.tip": 0.01}


def test_numbers_that_are_not_finite_become_null():
    moved = f.absorbing(FRICTION, std=math.inf, **{"T1.bend": (1.0, 2.0)})
    result = f.finding(gap_closure=f.closed(0.9, math.nan, math.inf), **moved).to_dict()
    assert result["gap"]["closure_ci"] == [None, None]
    assert result["absorption"] == {"T1.bend": {"before": 1.0, "after": 2.0, "std": None, "unit": "N m/rad"}}


KEYS = """format verdict gap where which effects remaining reason rejected_candidates confusable events next_experiment
next_steps statistics summary absorption steps unseen untried baseline counterfactual seconds law probability
rival_changes"""


def test_model_error_is_the_largest_error_beyond_noise_of_each_unit():
    errors = {"points.tip": (0.03, "m"), "points.end": (0.02, "m"), "joints.effort.elbow": (0.5, "N m")}
    noise = {"points.tip": math.sqrt(3) * 0.0169, "points.end": math.sqrt(3) * 0.001, "joints.effort.elbow": 0.6}
    made = f.finding("unknown", nominal_model=f.fit(lost=f.loss(2.0, channels=errors)), noise_floor=noise)
    size = math.sqrt(0.02**2 - 3 * 0.001**2)
    sizes = f"{1e3 * size:.2g} mm at points.end (rms, noise subtracted)."
    assert f"error of the nominal model is {sizes}" in diagnosis_summary_text(made)  # noise alone gives the torque's
    made = replace(made, noise_floor=dict.fromkeys(noise, 1.0))
    assert "nominal model is 0 N m at joints.effort.elbow, 0 mm at points.tip" in diagnosis_summary_text(made)


def test_the_result_holds_what_was_found():
    made = f.finding(
        "confusable",
        selected_effects=(f.added(FRICTION, [OFFSET]), f.added(OFFSET, fitted=f.fit([FRICTION, OFFSET]))),
        gap_locations=(f.place("T1", 0.7, True, ((0.0, 1.0),)),),
        remaining_gap_locations=(f.place("T2", 0.3, False),),
        remaining_test=f.outcome(p=0.4, chi2=1.02),
        screening=f.screening([f.score(FRICTION)], seen=[f.visible(FRICTION), f.visible(OFFSET, seen=False)]),
        is_split_in_blocks=True,
    )
    result = made.to_dict()
    assert result["format"] == "yid-diagnosis/2"
    assert sorted(result) == sorted(KEYS.split())
    assert result["gap"]["before"]["chi2_per_dof"] == made.nominal_held_out_test.chi2_per_dof
    after = {"rmse": {"points.tip": 0.01}, "unit": {"points.tip": "m"}, "chi2_per_dof": 1.02, "p_value": 0.4}
    assert result["gap"]["after"] == after
    first = {"location": "T1", "share": 0.7, "observable": True, "windows": [[0.0, 1.0]], "indistinguishable_from": []}
    assert result["where"] == [first]
    other = first | {"location": "T2", "share": 0.3, "observable": False, "windows": []}
    assert result["remaining"] == {"p_value": 0.4, "where": [other]}
    alike = [("friction", "elbow"), ("offset", "wrist")]
    assert result["confusable"] == [[{"kind": kind, "location": place} for kind, place in alike]]
    assert [step["added"] for step in result["steps"]] == ["friction@elbow", "offset@wrist"]
    assert result["steps"][0]["rmse"] == {"points.tip": 0.01}
    assert result["unseen"] == ["offset@wrist"]


def test_candidates_are_listed_with_what_was_added_first():
    third = f.effect("third@x")
    alone = f.fit([OFFSET], f.loss(1.3, 1.4), values={"offset@wrist.a": 0.3})
    best = f.fit([FRICTION], f.loss(1.0, 1.1), values={"friction@elbow.a": 0.5}, std={"friction@elbow.a": math.inf})
    made = f.finding(
        nominal_model=f.fit(lost=f.loss(2.0, 2.0)),
        single_effect_models=(alone, best),
        selected_effects=(f.added(FRICTION, fitted=best),),
        screening=f.screening(
            [
                f.score(third, p=0.2, statistic=7.0, step={"third@x.a": 0.7}),
                f.score(OFFSET, p=0.1, statistic=8.0),
                f.score(FRICTION, p=0.05, statistic=9.0),
            ]
        ),
    )
    listed = made.to_dict()["which"]
    assert [f"{e['kind']}@{e['location']}" for e in listed] == ["friction@elbow", "offset@wrist", "third@x"]
    assert [(entry["score"], entry["p_value"]) for entry in listed] == [(9.0, 0.05), (8.0, 0.1), (7.0, 0.2)]
    told = [tuple(entry["parameters"]["a"].values()) for entry in listed]
    assert told == [(0.5, None, "N m"), (0.3, 0.01, "N m"), (0.7, None, "N m")]
    assert [entry["closure"] for entry in listed] == [pytest.approx(0.95), pytest.approx(0.65), None]
    assert listed[1]["closure_ci"] == [pytest.approx(0.6), pytest.approx(0.7)]
    assert listed[2]["closure_ci"] == [None, None]
    # the statistic is that of the best of three tries
    assert made.to_dict()["statistics"]["candidate"] == pytest.approx(3 * 0.05)
    chance = f.screening([f.score(OFFSET, p=0.8), f.score(FRICTION, p=0.9)])
    assert f.finding(screening=chance).to_dict()["statistics"]["candidate"] == 1.0
    # of an unknown gap, refits before scores
    made = f.finding(
        "unknown",
        single_effect_models=(f.fit([OFFSET]), f.fit([third])),
        screening=f.screening([f.score(FRICTION, 0.1)]),
    )
    told = [(entry["kind"], entry["p_value"]) for entry in made.to_dict()["which"]]
    assert told == [("offset", 1.0), ("third", 1.0), ("friction", 0.1)], "what has no score is not sure of anything"


def test_rejected_candidates_say_what_they_close_and_why_they_are_none():
    unsure = f.fit(
        [FRICTION, OFFSET], values={"friction@elbow.a": 0.5, "offset@wrist.a": 0.5}, std={"friction@elbow.a": 0.3}
    )
    chosen, checks = (f.added(FRICTION), f.added(OFFSET, fitted=unsure)), f.carried(FRICTION, OFFSET)
    told = f.finding("unknown", unknown_reason="stand_in", selected_effects=chosen, transfer_texts=checks).to_dict()
    rejected = told["rejected_candidates"]
    assert next((own["kind"], own["location"], own["closure"]) for own in rejected) == ("friction", "elbow", 0.9)
    said = "friction@elbow.a is 0.5 ± 0.01 N m on the fitted recordings and 0.9 ± 0.02 N m on the held-out ones"
    assert [own["reason"] for own in rejected] == [said, said], "all fail with the one whose size is not known"
    assert (told["reason"], told["effects"]) == ("stand_in", [])
    assert f.finding("unknown", unknown_reason="little").to_dict()["rejected_candidates"] == []


def test_every_reason_has_a_sentence_of_its_own():
    reasons = [reason for reason in get_args(get_type_hints(Judgement)["unknown_reason"]) if reason]
    assert len({diagnosis_summary_text(f.finding("unknown", unknown_reason=reason)) for reason in reasons}) == len(
        reasons
    )


def test_a_result_shows_itself_in_one_line_and_a_table():
    made = f.finding()
    assert repr(made) == "<DiagnosisResult: effect, friction@elbow, 90 % of the held-out gap closed>"
    assert "<td>friction@elbow</td><td>a = 0.5 N m</td>" in made._repr_html_()
