"""The blind proof, rule by rule: how answers are given, marked and scored."""

from __future__ import annotations

import json
import math
from types import SimpleNamespace

import pytest
from factories import amplitude, cases, effect, fit, loss

from yid_ocp.cli import main
from yid_ocp.diagnosis import blind, blind_scores
from yid_ocp.diagnosis.blind import BlindCase, CaseGroundTruth, open_sealed_labels, seal_labels_with_hash
from yid_ocp.diagnosis.blind_scores import ensemble_success_rates, score_blind_case
from yid_ocp.diagnosis.hypotheses import AllCandidatesProblem
from yid_ocp.errors import DataError
from yid_ocp.virtual.injected import InjectedEffect

KV, DRY = InjectedEffect("kelvin_voigt", "T1", {"tau": 0.05}), InjectedEffect("joint_coulomb", "elbow", {"tau_c": 2.0})
DAMPER = effect("kelvin_voigt@T1", amplitude("tau", expected=(0.0, 0.2), unit="s"))
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
        "effects": [pair(t) for t in effects],
        "which": [pair(t) | {"parameters": (values or {}).get(t, {})} for t in listed],
        "where": [{"location": p} for p in where],
        "confusable": [[pair(t) for t in group] for group in confusable],
        "gap": {"closure": closure},
    }


# -- marks ------------------------------------------------------------------------------------------------------------

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
        (NULL, said("unknown"), False),
        (SINGLE, said("effect", [RIGHT]), True),
        (SINGLE, said("effect", [WRONG]), False),
        (SINGLE, said("effect", [WRONG, RIGHT]), False),
        (SINGLE, said("effect", [RIGHT, WRONG]), True),
        (SINGLE, alike([WRONG], [WRONG, RIGHT]), True),
        (SINGLE, alike([WRONG], [WRONG, "a@b", RIGHT]), True),
        (SINGLE, alike([WRONG], [WRONG, "a@b", "c@d", RIGHT]), False),
        (SINGLE, alike([WRONG, "a@b"], ["a@b", RIGHT]), False),
        (SINGLE, said("unknown", where=["T1"]), False),
        (label("finer_chain"), said("effect", [RIGHT]), False),
        (OUTSIDE, said("unknown", where=["T3", "T1"]), True),
        (OUTSIDE, said("unknown", where=["T1", "T3"]), False),
        (OUTSIDE, said("unknown"), False),
        (OUTSIDE, said("effect", [WRONG], where=["T3"]), False),
        (LEFT_OUT, said("unknown", where=["T1"]), True),
        (LEFT_OUT, said("effect", [RIGHT], where=["T1"]), False),
        (PAIR, said("effect", [RIGHT, RUBS]), True),
        (PAIR, said("effect", [RUBS, "a@b", RIGHT]), True),
        (PAIR, said("effect", [RIGHT]), False),
        # one set says one of the two, and two sets of which one has both do not say two
        (PAIR, alike([RUBS], [RUBS, RIGHT]), False),
        (PAIR, alike([RUBS, "a@b"], [RUBS, RIGHT]), False),
        (PAIR, alike(["a@b", RIGHT], ["a@b", RUBS]), True),
        (PAIR, alike([RIGHT, "a@b"], ["a@b", RUBS]), True),
        (PAIR, alike([RIGHT, "a@b"], ["a@b", "c@d", "e@f", RUBS]), False),
    ],
)
def test_what_is_right_depends_on_the_case(case, answer, right):
    assert score_blind_case(case, answer).right is right


@pytest.mark.parametrize(
    ("listed", "where", "first", "second", "located"),
    [
        ([RIGHT, WRONG], ["T1", "T2"], True, True, True),
        ([WRONG, RIGHT], ["T2", "T1"], False, True, False),
        ([WRONG, "a@b", RIGHT], ["T1"], False, False, True),
        ([], [], False, False, False),
    ],
)
def test_a_mark_says_what_comes_first(listed, where, first, second, located):
    found = score_blind_case(label("single", KV), said("unknown", [], which=listed, where=where))
    assert (found.kind_first, found.kind_second, found.location_first) == (first, second, located)


def test_a_mark_keeps_case_answer_and_figures():
    group = [WRONG, RIGHT]
    found = score_blind_case(
        label("pair", KV, DRY, multiple=3.0),
        said("confusable", [WRONG, "a@b"], confusable=[["a@b", "c@d"], group], closure=0.5),
        best=0.8,
        seconds=7.0,
    )
    assert (found.case, found.category, found.verdict) == ("case_000", "pair", "confusable")
    assert (found.truth, found.answer) == ("kelvin_voigt@T1 + joint_coulomb@elbow", f"{WRONG} + a@b")
    assert (found.multiple, found.closure, found.best, found.seconds) == (3.0, 0.5, 0.8, 7.0)
    assert found.confusable == tuple(group)
    none = score_blind_case(label("null"), said("no_gap"))
    assert math.isnan(none.closure)
    assert (none.truth, none.answer, none.kind_first, none.location_first) == ("-", "-", False, False)


@pytest.mark.parametrize(
    ("value", "std", "error", "inside"),
    [
        (0.06, 0.01, 0.2, True),
        (0.06, 0.0052, 0.2, True),
        (0.06, 0.005, 0.2, False),
        (0.04, 0.0052, 0.2, True),
        (0.04, 0.005, 0.2, False),
    ],
)
def test_a_parameter_is_within_95_percent_or_not(value, std, error, inside):
    values = {RIGHT: {"tau": {"value": value, "std": std, "unit": "s"}}}
    found = score_blind_case(label("single", KV), said("effect", [WRONG, RIGHT], which=[WRONG, RIGHT], values=values))
    assert found.errors == {f"{RIGHT}.tau": (pytest.approx(error), inside)}


@cases(
    "injected, effects, values",
    {
        "not named": (KV, [WRONG], {}),
        "no value": (KV, [RIGHT], {}),
        "infinite": (KV, [RIGHT], {"tau": {"value": None, "std": 0.1}}),
        "unknown deviation": (KV, [RIGHT], {"tau": {"value": 0.05, "std": None}}),
        "truth is infinite": (
            InjectedEffect("kelvin_voigt", "T1", {"tau": math.inf}),
            [RIGHT],
            {"tau": {"value": 0.05, "std": 0.1}},
        ),
        "in no library": (GUST, ["gusts@T3"], {"size": {"value": 0.1, "std": 0.1}}),
    },
)
def test_parameters_that_cannot_be_compared_are_left_out(injected, effects, values):
    found = score_blind_case(label("single", injected), said("effect", effects, values=dict.fromkeys(effects, values)))
    assert found.errors == {}


# -- rates ------------------------------------------------------------------------------------------------------------


def marked(category, **changed):
    usual = {
        "case": "c",
        "category": category,
        "truth": RIGHT,
        "verdict": "effect",
        "answer": RIGHT,
        "multiple": 3.0,
        "gap": True,
        "kind_first": True,
        "kind_second": True,
        "location_first": True,
        "confusable": (),
        "right": True,
        "closure": 0.9,
        "best": 1.0,
    }
    return blind_scores.BlindCaseScore(**(usual | changed))


def test_rates_are_over_the_cases_that_they_speak_of():
    found = ensemble_success_rates(
        [
            marked("null", gap=True),
            marked("null", gap=False),
            marked("null", gap=False, seconds=4.0),
            marked("null", gap=False, seconds=8.0),
            marked("single", kind_first=False, location_first=False, errors={"a": (0.5, True), "b": (0.1, False)}),
            marked("single", kind_first=False, kind_second=False, closure=0.3, best=0.5, errors={"a": (0.2, True)}),
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
    assert found["cases"] == 18
    assert found["false_alarms"] == 0.25
    assert found["detection"] == {
        "1": {"cases": 1, "gap": 0.0, "first": 0.0, "right": 0.0},
        "3": {"cases": 4, "gap": 1.0, "first": 0.5, "right": 0.75},
    }
    assert found["kind_first"] == pytest.approx(3 / 5)
    assert found["kind_in_two"] == pytest.approx(4 / 5)
    assert found["location_first"] == pytest.approx(4 / 5)
    # an effect that is named alone is a set of one
    assert (found["sets_cover"], found["set_size"]) == (0.8, 1.6)
    assert found["unknown_recall"] == pytest.approx(1 / 3)
    assert (found["unknown_outside"], found["unknown_left_out"]) == (1.0, 0.0)
    assert found["unknown_location"] == 0.5
    assert (found["pairs_right"], found["pairs_named"]) == (0.5, 0.25)
    assert found["closure_of_best"] == pytest.approx((0.9 + 0.6) / 2)
    assert found["parameter_error"] == pytest.approx(0.2)
    assert found["interval_coverage"] == pytest.approx(2 / 3)
    assert found["seconds"] == 6.0
    assert len(found["marks"]) == 18


def test_no_cases_of_a_sort_have_no_rate():
    found = ensemble_success_rates([])
    assert found["cases"] == 0
    whole = ("format", "cases", "detection", "detection_intervals", "marks", "intervals", "experiments")
    assert {found[key] for key in found if key not in (*whole, "confusion", "calibration")} == {None}
    assert all(entry["rate"] is None for entry in found["intervals"].values())
    assert found["confusion"]["counts"] == []


@pytest.mark.parametrize(
    ("count", "total", "low", "high"),
    # tables of the binomial distribution
    [(0, 10, 0.0, 0.3085), (10, 10, 0.6915, 1.0), (3, 60, 0.0104, 0.1392), (85, 100, 0.7647, 0.9135)],
)
def test_rates_have_binomial_intervals(count, total, low, high):
    found = blind_scores._binomial_proportion([True] * count + [False] * (total - count))
    assert (found["count"], found["of"], found["rate"]) == (count, total, count / total)
    assert (found["low"], found["high"]) == (pytest.approx(low, abs=1e-4), pytest.approx(high, abs=1e-4))


def test_what_was_said_of_what_is_counted():
    marks = [
        score_blind_case(label("single", KV), said("effect", [RIGHT])),
        score_blind_case(label("single", KV), said("effect", ["density@T1"])),
        score_blind_case(label("single", KV), said("no_gap")),
        score_blind_case(label("null"), said("no_gap")),
        score_blind_case(label("null"), said("unknown")),
        score_blind_case(label("null"), said("no_gap")),
    ]
    found = blind_scores._confusion_matrix(marks)
    assert (found["true"], found["said"]) == (
        ["kelvin_voigt", "null"],
        ["density", "kelvin_voigt", "no_gap", "unknown"],
    )
    assert found["counts"] == [[1, 1, 1, 0], [0, 0, 2, 1]]


def test_intervals_and_p_values_are_held_against_what_they_promise():
    def single(miss):
        values = {"kelvin_voigt@T1": {"tau": {"value": 0.05 + 0.01 * miss, "std": 0.01, "unit": "s"}}}
        return score_blind_case(label("single", KV), said("effect", [RIGHT], values=values))

    def null(p):
        told = said("no_gap")
        return score_blind_case(label("null"), {**told, "gap": {**told["gap"], "before": {"p_value": p}}})

    found = blind_scores._calibration_rates([single(0.5), single(-1.5), single(2.1), null(0.03), null(0.4), null(0.9)])
    held = {entry["level"]: entry["count"] for entry in found["intervals"]}
    assert (held[0.5], held[0.8], held[0.9], held[0.95], held[0.99]) == (1, 1, 2, 2, 3)
    assert {entry["level"]: entry["count"] for entry in found["p_values"]} == {0.01: 0, 0.05: 1, 0.1: 1, 0.2: 1, 0.5: 2}
    assert {entry["of"] for entry in found["intervals"]} == {3}


# -- seals ------------------------------------------------------------------------------------------------------------


def test_a_sealed_text_is_sorted_holds_all_and_opens_only_as_it_was():
    text, digest = seal_labels_with_hash([label("single", KV, multiple=3.0)])
    assert json.loads(text) == [
        {
            "case": "case_000",
            "category": "single",
            "injected": [{"kind": "kelvin_voigt", "location": "T1", "values": {"tau": 0.05}}],
            "experiment": "",
            "multiple": 3.0,
            "truth": {"T1.bend": 12.0},
        }
    ]
    assert text.index('"case"') < text.index('"injected"') < text.index('"truth"')
    assert len(digest) == 64
    assert open_sealed_labels(text, digest)[0].injected == (KV,)
    with pytest.raises(DataError, match="committed"):
        open_sealed_labels(text.replace("0.05", "0.06"), digest)


# -- answers ----------------------------------------------------------------------------------------------------------


def case(without=("density",)):
    return BlindCase("case_000", "estimate", "held out", without)


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

    nominal = fit(lost=loss(2.0, 2.0), values={"k": 3.0}, problem="settled")
    monkeypatch.setattr(blind, "make_candidate_effects", lambda *_: [stiff, FRICTION])
    monkeypatch.setattr(blind, "AllCandidatesProblem", SimpleNamespace(from_problem=composed_from))
    monkeypatch.setattr(blind, "fit_nominal_model", lambda *_: nominal)

    def refit(composed, chosen, start):
        asked.append((composed.problem, [e.kind for e in chosen], dict(start)))
        return fit(chosen, loss(1.25, 1.25)) if refitted else None

    monkeypatch.setattr(blind, "refit_with_effects", refit)
    ensemble = SimpleNamespace(_nominal_problem=lambda recording: SimpleNamespace(system="system"))
    found = blind.true_effects_gap_closure(ensemble, case(), CaseGroundTruth("c", "single", injected, 1.0, {}))
    assert found == pytest.approx(expected, nan_ok=True)
    at_truth = {"kelvin_voigt@T1.tau": 0.05} if injected else {}
    assert asked == [["held out"], ("settled", ["kelvin_voigt"] if injected else [], {"k": 3.0} | at_truth)]


@pytest.mark.slow
def test_a_small_ensemble_runs_resumes_and_keeps_its_labels_sealed(tmp_path, capsys):
    pytest.importorskip("mujoco", reason="blind proofs need MuJoCo: pip install 'yid-ocp[blind]'")
    folder = tmp_path / "proof"
    command = ["blind", "--cases", "2", "--seed", "11", "--out", str(folder), "--quiet"]
    assert main(command) == 0
    first = json.loads((folder / "result.json").read_text())
    assert first["format"] == "yid-blind/1"
    for path in (folder / "cases").iterdir():
        assert b"kelvin" not in path.read_bytes()
    answers = {json.loads(path.read_text())["name"]: path for path in (folder / "answers").iterdir()}
    assert set(answers) == {"case_000", "case_001"}
    kept = answers["case_000"].stat().st_mtime_ns
    answers["case_001"].unlink()
    assert main(command) == 0
    assert answers["case_000"].stat().st_mtime_ns == kept
    assert answers["case_001"].is_file()
    again = json.loads((folder / "result.json").read_text())
    assert [m["verdict"] for m in again["marks"]] == [m["verdict"] for m in first["marks"]]
    assert main([*command[:-1], "--seed", "12", "--quiet"]) == 2
    assert "another ensemble" in capsys.readouterr().err
