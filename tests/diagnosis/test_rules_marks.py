"""The blind proof, rule by rule: how answers are given, marked and scored."""

import json
import math
from dataclasses import asdict, replace
from types import SimpleNamespace

import pytest
from factories import added, amplitude, cases, effect, finding, fit, loss, score, screening

from yid_ocp.diagnosis import blind, blind_scores
from yid_ocp.diagnosis.blind import CaseGroundTruth, UnlabelledCase, labels_json_and_sha256, read_labels_checking_sha256
from yid_ocp.diagnosis.blind_scores import blind_case_score_summary, rejudge_diagnosis_evidence, score_blind_case
from yid_ocp.diagnosis.hypotheses import AllCandidatesProblem
from yid_ocp.diagnosis.refit import EffectSearchRecord
from yid_ocp.diagnosis.thresholds import Thresholds
from yid_ocp.errors import DataError
from yid_ocp.virtual.injected import InjectedEffect
from yid_ocp.workflow import blind_slices
from yid_ocp.workflow.blind_slices import rescore_blind, score_joined_slices, write_slice_results

KV, DRY = InjectedEffect("kelvin_voigt", "T1", {"tau": 0.05}), InjectedEffect("joint_coulomb", "elbow", {"tau_c": 2.0})
FRICTION = effect("joint_coulomb@elbow", amplitude("tau_c", expected=(0.0, 3.0)))
GUST = InjectedEffect("gusts", "T3", {"size": 0.1})


def label(category, *injected, multiple=None):
    return CaseGroundTruth("case_000", category, injected, multiple, {"T1.bend": 12.0})


def pair(text):
    kind, _, place = text.partition("@")
    return {"kind": kind, "location": place}


def said(verdict="effect", effects=(), which=None, where=(), confusable=(), closure=None, values=None):
    listed = effects if which is None else which
    return {
        "verdict": verdict,
        "probability": 0.9 if effects else 0.0,
        "effects": [pair(t) for t in effects],
        "which": [pair(t) | {"parameters": (values or {}).get(t, {})} for t in listed],
        "where": [{"location": p} for p in where],
        "confusable": [[pair(t) for t in group] for group in confusable],
        "gap": {"closure": closure},
    }


RIGHT, WRONG, RUBS = "kelvin_voigt@T1", "density@T2", "joint_coulomb@elbow"
NULL, SINGLE, PAIR = label("null"), label("single", KV), label("pair", KV, DRY)
OUTSIDE, LEFT_OUT = label("outside", GUST), label("left_out", KV)


def alike(named, *groups):
    return said("confusable", named, confusable=groups)


@pytest.mark.parametrize(
    ("case", "answer", "right"),
    [
        (NULL, said("no_gap"), True),
        (NULL, said("insufficient_data"), False),
        (SINGLE, said("effect", [RIGHT]), True),
        (SINGLE, said("effect", [WRONG, RIGHT]), False),
        (SINGLE, said("effect", [RIGHT, WRONG]), True),
        (SINGLE, alike([WRONG], [WRONG, "a@b", RIGHT]), True),
        (SINGLE, alike([WRONG], [WRONG, "a@b", "c@d", RIGHT]), False),
        (SINGLE, alike([WRONG, "a@b"], ["a@b", RIGHT]), False),
        (label("finer_chain"), said("effect", [RIGHT]), False),
        (OUTSIDE, said("unknown", where=["T3", "T1"]), True),
        (OUTSIDE, said("unknown", where=["T1", "T3"]), False),
        (OUTSIDE, said("unknown"), False),
        (OUTSIDE, said("effect", [WRONG], where=["T3"]), False),
        (LEFT_OUT, said("unknown", where=["T1"]), True),
        (PAIR, said("effect", [RIGHT, RUBS]), True),
        (PAIR, said("effect", [RUBS, "a@b", RIGHT]), True),
        (PAIR, said("effect", [RIGHT]), False),
        # one set says one of the two, and two sets of which one has both do not say two
        (PAIR, alike([RUBS, "a@b"], [RUBS, RIGHT]), False),
        (PAIR, alike(["a@b", RIGHT], ["a@b", RUBS]), True),
        (PAIR, alike([RIGHT, "a@b"], ["a@b", RUBS]), True),
        (PAIR, alike([RIGHT, "a@b"], ["a@b", "c@d", "e@f", RUBS]), False),
    ],
)
def test_what_is_right_depends_on_the_case(case, answer, right):
    assert score_blind_case(case, answer).right is right


@pytest.mark.parametrize(
    ("listed", "where", "first", "located"),
    [
        ([RIGHT, WRONG], ["T1", "T2"], True, True),
        ([WRONG, RIGHT], ["T2", "T1"], False, False),
        ([WRONG, "a@b", RIGHT], ["T1"], False, True),
        ([], [], False, False),
    ],
)
def test_a_mark_says_what_comes_first(listed, where, first, located):
    found = score_blind_case(label("single", KV), said("unknown", [], which=listed, where=where))
    assert (found.kind_first, found.location_first) == (first, located)


def test_a_mark_keeps_case_answer_and_figures():
    group, sets = [WRONG, RIGHT], {"confusable": [["a@b", "c@d"], [WRONG, RIGHT]], "closure": 0.5}
    case = label("pair", KV, DRY, multiple=3.0)
    found = score_blind_case(case, said("confusable", [WRONG, "a@b"], **sets), best=0.8, seconds=7.0)
    assert (found.case, found.category, found.verdict) == ("case_000", "pair", "confusable")
    assert (found.truth, found.answer) == ("kelvin_voigt@T1 + joint_coulomb@elbow", f"{WRONG} + a@b")
    assert (found.multiple, found.closure, found.best, found.seconds) == (3.0, 0.5, 0.8, 7.0)
    assert found.confusable == tuple(group)
    none = score_blind_case(label("null"), said("no_gap"))
    assert (none.truth, none.answer, none.kind_first, none.location_first) == ("-", "-", False, False)
    assert math.isnan(none.closure)


@pytest.mark.parametrize(
    ("value", "std", "inside"),
    [(0.06, 0.01, True), (0.06, 0.0052, True), (0.06, 0.005, False), (0.04, 0.0052, True), (0.04, 0.005, False)],
)
def test_a_parameter_a_fifth_off_is_within_95_percent_or_not(value, std, inside):
    values = {RIGHT: {"tau": {"value": value, "std": std, "unit": "s"}}}
    found = score_blind_case(label("single", KV), said("effect", [WRONG, RIGHT], which=[WRONG, RIGHT], values=values))
    assert found.errors == {f"{RIGHT}.tau": (pytest.approx(0.2), inside)}


@cases(
    "injected, effects, values",
    {
        "not named": (KV, [WRONG], {}),
        "no value": (KV, [RIGHT], {}),
        "infinite": (KV, [RIGHT], {"tau": {"value": None, "std": 0.1}}),
        "unknown deviation": (KV, [RIGHT], {"tau": {"value": 0.05, "std": None}}),
        "truth is infinite": (replace(KV, values={"tau": math.inf}), [RIGHT], {"tau": {"value": 0.05, "std": 0.1}}),
        "in no library": (GUST, ["gusts@T3"], {"size": {"value": 0.1, "std": 0.1}}),
    },
)
def test_parameters_that_cannot_be_compared_are_left_out(injected, effects, values):
    found = score_blind_case(label("single", injected), said("effect", effects, values=dict.fromkeys(effects, values)))
    assert found.errors == {}


def marked(category, **changed):
    words = {"case": "c", "truth": RIGHT, "verdict": "effect", "answer": RIGHT, "confusable": ()}
    ranks = dict.fromkeys(("gap", "kind_first", "location_first", "right"), True)
    usual = {**words, **ranks, "multiple": 3.0, "closure": 0.9, "best": 1.0}
    return blind_scores.BlindCaseScore(category=category, **(usual | changed))


def test_rates_are_over_the_cases_that_they_speak_of():
    found = blind_case_score_summary(
        [
            marked("null", gap=True),
            marked("null", gap=False),
            marked("null", gap=False, seconds=4.0),
            marked("null", gap=False, seconds=8.0),
            marked("single", kind_first=False, location_first=False, errors={"a": (0.5, True), "b": (0.1, False)}),
            marked("single", kind_first=False, closure=0.3, best=0.5, errors={"a": (0.2, True)}),
            marked("single", confusable=(WRONG, RIGHT), closure=math.nan),
            marked("single", confusable=(WRONG, "a@b", "c@d"), right=False, best=math.nan),
            marked("single", gap=False, right=False, multiple=1.0, kind_first=False, best=-1.0),
            marked("single", multiple=math.nan, best=0.0),
            marked("outside", verdict="unknown", location_first=False),
            marked("left_out", verdict="effect"),
            marked("left_out", verdict="no_gap", gap=False, location_first=False),
            marked("pair", truth=f"{RIGHT} + a@b", answer=f"a@b + c@d + {RIGHT}", right=True),
            marked("pair", truth=f"{RIGHT} + a@b", answer=f"c@d + {RIGHT}", right=True),
            marked("pair", truth=f"{RIGHT} + a@b", answer="-", right=False),
            marked("pair", truth=f"{RIGHT} + a@b", answer=RIGHT, right=False),
            marked("finer_chain", right=False),
        ]
    )
    assert found["cases"] == len(found["marks"]) == 18
    seen = found["detection_intervals"]
    shares = {size: [own["gap"]["of"], *(part["rate"] for part in own.values())] for size, own in seen.items()}
    assert shares == {"1": [1, 0.0, 0.0, 0.0], "3": [4, 1.0, 0.5, 0.75]}
    rates = {
        "false_alarms": 0.25, "detected": 5 / 6, "kind_first": 3 / 5, "location_first": 4 / 5, "sets_cover": 0.8,
        "unknown_outside": 1.0, "unknown_left_out": 0.0, "unknown_location": 0.5, "pairs_right": 0.5,
        "interval_coverage": 2 / 3,
    }  # fmt: skip
    assert {name: own["rate"] for name, own in found["intervals"].items()} == pytest.approx(rates)
    sizes = {"set_size": 1.6, "closure_of_best": (0.9 + 0.6) / 2, "parameter_error": 0.2, "seconds": 6.0}
    assert {name: found[name] for name in sizes} == pytest.approx(sizes), "an effect named alone is a set of one"
    named = blind_case_score_summary([marked("null", experiment=name) for name in "abb"])["experiments"]
    assert {name: own["cases"] for name, own in named.items()} == {"a": 1, "b": 2}
    none = blind_case_score_summary([])
    assert (none["cases"], {none[name] for name in sizes}) == (0, {None})
    assert all(entry["rate"] is None for entry in none["intervals"].values())
    assert none["confusion"]["counts"] == []


def test_probabilities_are_compared_with_how_often_sets_hold_the_cause():
    marks = [marked("single", probability=p, is_cause_in_sets=p > 0.5) for p in (0.1, 0.2, 0.9, 0.7, 0.8)]
    found = blind_case_score_summary([*marks, marked("single", answer="-", probability=0.0)])["calibration"]
    assert [own["level"] for own in found["probabilities"]] == pytest.approx([0.1, 0.2, 0.7, 0.8, 0.9])
    assert [own["rate"] for own in found["probabilities"]] == [0.0, 0.0, 1.0, 1.0, 1.0]
    assert found["expected_calibration_error"] == pytest.approx((0.1 + 0.2 + 0.3 + 0.2 + 0.1) / 5)
    assert blind_case_score_summary([])["calibration"]["expected_calibration_error"] is None
    equal = [marked("single", probability=0.8, is_cause_in_sets=i % 2 == 0) for i in range(20)]
    assert blind_case_score_summary(equal)["calibration"]["expected_calibration_error"] == pytest.approx(0.3)
    # large sets and sets of each cause of a pair count, which are not right answers
    wide = score_blind_case(SINGLE, alike([WRONG], [WRONG, "a@b", "c@d", RIGHT]))
    assert (wide.right, wide.is_cause_in_sets, wide.probability) == (False, True, 0.9)
    assert not score_blind_case(PAIR, said("effect", [RIGHT])).is_cause_in_sets
    assert not score_blind_case(OUTSIDE, said("effect", [RIGHT])).is_cause_in_sets
    # answers of older versions have no probability
    older = score_blind_case(SINGLE, {key: own for key, own in said("effect", [RIGHT]).items() if key != "probability"})
    assert blind_case_score_summary([older])["calibration"]["expected_calibration_error"] is None


@pytest.mark.parametrize(
    ("count", "total", "low", "high"),
    # tables of the binomial distribution
    [(0, 10, 0.0, 0.3085), (10, 10, 0.6915, 1.0), (3, 60, 0.0104, 0.1392), (85, 100, 0.7647, 0.9135)],
)
def test_rates_have_binomial_intervals(count, total, low, high):
    marks = [marked("null", gap=i < count) for i in range(total)]
    found = blind_case_score_summary(marks)["intervals"]["false_alarms"]
    assert (found["count"], found["of"], found["rate"]) == (count, total, count / total)
    assert (found["low"], found["high"]) == (pytest.approx(low, abs=1e-4), pytest.approx(high, abs=1e-4))


def test_what_was_said_of_what_is_counted():
    single = [said("effect", [RIGHT]), said("effect", ["density@T1"]), said("no_gap")]
    marks = [score_blind_case(SINGLE, answer) for answer in single]
    marks += [score_blind_case(NULL, said(verdict)) for verdict in ("no_gap", "unknown", "no_gap")]
    assert blind_case_score_summary(marks)["confusion"] == {
        "true": ["kelvin_voigt", "null"],
        "said": ["density", "kelvin_voigt", "no_gap", "unknown"],
        "counts": [[1, 1, 1, 0], [0, 0, 2, 1]],
    }


def test_intervals_and_p_values_are_held_against_what_they_promise():
    def single(miss):
        values = {"kelvin_voigt@T1": {"tau": {"value": 0.05 + 0.01 * miss, "std": 0.01, "unit": "s"}}}
        return score_blind_case(label("single", KV), said("effect", [RIGHT], values=values))

    def null(p):
        told = said("no_gap")
        return score_blind_case(label("null"), {**told, "gap": {**told["gap"], "before": {"p_value": p}}})

    found = blind_case_score_summary([single(0.5), single(-1.5), single(2.1), null(0.03), null(0.4), null(0.9)])[
        "calibration"
    ]
    held = {entry["level"]: entry["count"] for entry in found["intervals"]}
    assert (held[0.5], held[0.8], held[0.9], held[0.95], held[0.99]) == (1, 1, 2, 2, 3)
    assert {entry["level"]: entry["count"] for entry in found["p_values"]} == {0.01: 0, 0.05: 1, 0.1: 1, 0.2: 1, 0.5: 2}
    assert {entry["of"] for entry in found["intervals"]} == {3}


def test_a_sealed_text_is_sorted_holds_all_and_opens_only_as_it_was():
    text, digest = labels_json_and_sha256([label("single", KV, multiple=3.0)])
    effect = {"kind": "kelvin_voigt", "location": "T1", "values": {"tau": 0.05}}
    told = {"case": "case_000", "category": "single", "injected": [effect], "experiment": "", "multiple": 3.0}
    assert json.loads(text) == [told | {"truth": {"T1.bend": 12.0}}]
    assert text.index('"case"') < text.index('"injected"') < text.index('"truth"')
    assert len(digest) == 64
    assert read_labels_checking_sha256(text, digest)[0].injected == (KV,)
    with pytest.raises(DataError, match="commitment"):
        read_labels_checking_sha256(text.replace("0.05", "0.06"), digest)


@cases(
    "injected, refitted, expected",
    {
        "the true effect": ((KV,), True, 0.75),
        "cannot be fitted": ((KV,), False, math.nan),
        "one is in no library": ((KV, GUST), True, math.nan),
        "none": ((), True, 0.75),
    },
)
def test_the_best_that_could_be_closed_is_that_of_the_true_effects(monkeypatch, injected, refitted, expected):
    asked = []
    stiff = effect("kelvin_voigt@T1", amplitude("tau", unit="s"), amplitude("other"))

    def composed_from(problem, effects, held_out):
        asked.append(held_out)
        return AllCandidatesProblem("from the start", tuple(effects), False)

    def refit(search, chosen, start):
        asked.append((search.problem.problem, [e.kind for e in chosen], dict(start)))
        return fit(chosen, loss(1.25, 1.25)) if refitted else None

    nominal = fit(lost=loss(2.0, 2.0), values={"k": 3.0}, problem="settled")
    monkeypatch.setattr(blind, "make_candidate_effects", lambda *_: [stiff, FRICTION])
    monkeypatch.setattr(blind, "AllCandidatesProblem", SimpleNamespace(from_problem=composed_from))
    monkeypatch.setattr(blind, "fit_nominal_model", lambda *_: nominal)
    monkeypatch.setattr(blind, "refit_with_effects", refit)
    ensemble = SimpleNamespace(candidates="all", _nominal_problem=lambda _: SimpleNamespace(system="system"))
    case, told = UnlabelledCase("c", "estimate", "held out", ()), CaseGroundTruth("c", "single", injected, 1.0, {})
    assert blind.true_effects_gap_closure(ensemble, case, told) == pytest.approx(expected, nan_ok=True)
    at_truth = {"kelvin_voigt@T1.tau": 0.05} if injected else {}
    assert asked == [["held out"], ("settled", ["kelvin_voigt"] if injected else [], {"k": 3.0} | at_truth)]


WEAK, STRANGE = effect("joint_viscous@elbow", amplitude("b")), effect("joint_spring@elbow", amplitude("stiffness"))


def diagnosed(decrease=180.0, there=0.5):
    """A case in which one effect is true: what was refitted and screened for its diagnosis, and what that said."""

    def model(effects, lost, cost, size=0.5):
        return fit(effects, loss(lost, lost + 0.1), cost, {f"{e.label}.{e.definitions[0].name}": size for e in effects})

    ranked = [score(FRICTION, p=1e-9, decrease=90.0), score(WEAK, p=1e-8, decrease=40.0), score(STRANGE, p=0.03)]
    refits = {e.label: model([e], *of) for e, *of in ((FRICTION, 1.6, 100 - decrease / 2), (WEAK, 2.4, 90.0))}
    refits[f"{FRICTION.label} on the held-out recordings"] = model([FRICTION], 1.0, 50.0, there)
    beside = screening([score(WEAK, p=0.5), score(STRANGE, p=0.6)])
    known = {"screening": screening(ranked), "nominal_model": fit((), loss(3.0, 3.2), 100.0, {"k": 2.0})}
    record = EffectSearchRecord(refits, {f"beside {FRICTION.label}": beside}, {FRICTION.label: ()})
    named = {"single_effect_models": (refits[FRICTION.label],), "selected_effects": (added(FRICTION),)}
    return finding(**named, record=record, **known)


def again(finding, **limits):
    """Verdict and effects of what was kept of a diagnosis, by other thresholds."""
    data = json.loads(json.dumps(blind_scores.diagnosis_evidence_to_dict(finding), allow_nan=False))
    found = rejudge_diagnosis_evidence(data, limits)
    return found["verdict"], [f"{e['kind']}@{e['location']}" for e in found["effects"]]


@cases(
    "made, limits, verdict",
    {
        "by the same": ({}, {}, "effect"),
        "too little explained": ({"decrease": 120.0}, {"min_closure": 0.9}, "unknown"),
        "less is asked": ({"decrease": 120.0}, {"min_closure": 0.9, "min_explained_fraction": 0.5}, "effect"),
        "another value elsewhere": ({"there": 0.8}, {}, "effect"),
        "the opposite elsewhere": ({"there": -0.5}, {}, "unknown"),
        "no gap is sure enough": ({}, {"gap_significance_level": 1e-30}, "no_gap"),
        "a refit that was not made": ({}, {"significance_level": 0.05}, "not_judged"),
        "a second effect that was not tried": ({}, {"significance_level": 0.6}, "not_judged"),
    },
)
def test_what_was_kept_of_a_case_is_judged_by_other_thresholds(made, limits, verdict):
    assert again(diagnosed(**made), **limits) == (verdict, [FRICTION.label] if verdict == "effect" else [])


def test_a_case_keeps_its_own_thresholds_as_far_as_there_still_are_such():
    asked = Thresholds(min_explained_fraction=0.5, min_closure=0.9)
    made = blind_scores.diagnosis_evidence_to_dict(replace(diagnosed(decrease=120.0), thresholds=asked))
    assert rejudge_diagnosis_evidence(made, {})["verdict"] == "effect"
    made["thresholds"] = {"min_explained_fraction": 0.8, "min_closure": 0.9, "one_that_is_gone": 3.0}
    assert rejudge_diagnosis_evidence(made, {})["verdict"] == "unknown"


def test_a_case_of_an_earlier_version_is_refused():
    made = blind_scores.diagnosis_evidence_to_dict(diagnosed()) | {"format": "yid-evidence/1"}
    with pytest.raises(DataError, match="'yid-evidence/1'"):
        rejudge_diagnosis_evidence(made, {})


def test_a_proof_is_judged_again_without_a_refit(tmp_path, monkeypatch):
    """Two cases of one experiment: the second asks for more refits where a smaller effect counts as significant."""
    sealed = [
        CaseGroundTruth(
            f"case_{i}", "single", (InjectedEffect("joint_coulomb", "elbow", {"tau_c": 0.5}),), 3.0, {}, "of.it"
        )
        for i in range(2)
    ]
    text, digest = labels_json_and_sha256(sealed)
    monkeypatch.setattr(blind_slices, "draw_blind_validation_figures", lambda *_: None)
    for part in ("sealed", "answers", "best"):
        (tmp_path / part).mkdir()
    (tmp_path / "sealed/labels.json").write_text(text)
    told = {"sha256": digest, "cases": 2, "seed": 3, "purpose": "report", "configs": {"of": ""}}
    (tmp_path / "commitment.json").write_text(json.dumps(told))
    first, second = diagnosed(), diagnosed()
    few = replace(second.screening, candidate_scores=second.screening.candidate_scores[:2])
    second = replace(second, screening=few)
    for i, made in enumerate((first, second)):
        value = {"seconds": 9.0, "result": made.to_dict(), "evidence": blind_scores.diagnosis_evidence_to_dict(made)}
        (tmp_path / f"answers/{i}.json").write_text(json.dumps({"name": f"case_{i}", "value": value}))
    said = rescore_blind(tmp_path, tmp_path / "same").result
    assert (said["not_judged"], said["rescored"]["changed"]) == (0, [])
    assert said["detection_intervals"]["3"]["right"]["rate"] == 1.0
    said = rescore_blind(tmp_path, tmp_path / "other", ["diagnosis.significance_level=0.05"]).result
    assert (said["cases"], said["not_judged"], said["detection_intervals"]["3"]["gap"]["of"]) == (2, 1, 1)
    assert said["confusion"]["said"] == ["joint_coulomb", "not_judged"]
    [changed] = said["rescored"]["changed"]
    known = {"case": "case_0", "then": "effect joint_coulomb@elbow", "now": "not_judged -"}
    assert {key: changed[key] for key in known} == known
    assert "| of.it | 2 | 1 |" in (tmp_path / "other/table.md").read_text()


def written_slice(tmp_path, part, cases, **changes):
    """The folder of a slice whose cases are clean and were called so."""
    labels = [CaseGroundTruth(f"case_{i:03d}", "null", (), None, {}) for i in cases]
    known = dict.fromkeys(("code", "code_of_cases", "command"), "made up") | {"versions": {}}
    answers = [{"seconds": 1.0, "result": said("no_gap")} for _ in cases]
    found = {"slice": part, "cases": 4, "seed": 1, "purpose": "report", "configs": {}, **known}
    found |= {"labels": [asdict(label) for label in labels], "answers": answers, "best": {}}
    found["labels_sha256"] = labels_json_and_sha256(labels)[1]
    folder = tmp_path / part.replace("/", "-") / str(len(list(tmp_path.iterdir())))
    folder.mkdir(parents=True)
    write_slice_results(found | changes, folder)
    return folder


def test_slices_of_one_ensemble_count_together_and_can_be_judged_again(tmp_path, monkeypatch):
    for name in ("draw_blind_validation_figures", "write_report"):
        monkeypatch.setattr(blind_slices, name, lambda *_: None)
    parts = [written_slice(tmp_path, "1/2", (0, 2)), written_slice(tmp_path, "2/2", (1, 3)) / "slice.json"]
    joined = score_joined_slices(parts, tmp_path / "joined").result
    assert [entry["case"] for entry in joined["marks"]] == [f"case_{i:03d}" for i in range(4)]
    assert (joined["slices"], joined["cases"], joined["intervals"]["false_alarms"]["rate"]) == (["1/2", "2/2"], 4, 0.0)
    assert rescore_blind(tmp_path / "joined", tmp_path / "again").result["cases"] == 4


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"seed": 2}, "different blind tests"),
        ({"code": "newer"}, "different blind tests"),
        ({"slice": "2/3"}, "different blind tests"),
        ({"slice": "1/2"}, "given twice"),
        ({"labels_sha256": "0"}, "do not match the hashes"),
    ],
)
def test_slices_count_together_only_with_one_hash(tmp_path, changes, words):
    first, other = written_slice(tmp_path, "1/2", (0, 2)), written_slice(tmp_path, "2/2", (1, 3), **changes)
    with pytest.raises(DataError, match=words):
        score_joined_slices([first, other], tmp_path / "joined")
    with pytest.raises(DataError, match="no slice"):
        score_joined_slices([tmp_path], tmp_path / "joined")
