"""Thresholds as quantiles: conformal coverage, which cases count, what a threshold would do to the others."""

import json
import math
from dataclasses import replace
from importlib.resources import files
from typing import Any

import numpy as np
import pytest

from yid_ocp.diagnosis.blind import CaseGroundTruth
from yid_ocp.diagnosis.blind_scores import (
    _conformal_quantile,
    _recommended_settings,
    calibrate_thresholds,
    score_blind_case,
    thresholds_always_accepting_best_candidate,
)
from yid_ocp.diagnosis.thresholds import DEFAULT_THRESHOLDS, Thresholds
from yid_ocp.virtual.injected import InjectedEffect

DAMPER = InjectedEffect("kelvin_voigt", "T1", {"tau": 0.05})


@pytest.mark.parametrize(("n", "coverage"), [(19, 0.95), (39, 0.95), (59, 0.95), (9, 0.8)])
def test_a_further_case_stays_below_the_quantile_as_often_as_is_said(n: int, coverage: float) -> None:
    rng = np.random.default_rng(n)
    kept = said = 0.0
    for _ in range(3000):
        *sample, another = rng.standard_exponential(n + 1)
        value, said = _conformal_quantile(sample, "most", coverage)
        kept += another <= value
    assert said >= coverage
    assert kept / 3000 == pytest.approx(said, abs=0.015)


def test_too_few_cases_promise_less() -> None:
    assert _conformal_quantile([3.0, 1.0, 2.0], "most") == (3.0, 0.75)
    assert _conformal_quantile([3.0, 1.0, 2.0], "least") == (1.0, 0.75)
    value, coverage = _conformal_quantile([], "most")
    assert (math.isnan(value), coverage) == (True, 0.0)
    # of forty the second largest is enough, of nineteen the largest
    assert _conformal_quantile(list(range(40)), "most") == (38, 39 / 41)
    assert _conformal_quantile(list(range(40)), "least") == (1, 39 / 41)


STATISTICS = dict.fromkeys(("evidence", "explained_fraction")) | {"single_effects": {}}
STATISTICS |= dict.fromkeys(("p_value", "chi2_per_dof", "candidate"), 1.0)


def case(category: str, verdict: str, *effects: InjectedEffect, multiple: float | None = None, **said: Any) -> Any:
    label = CaseGroundTruth("case_000", category, effects, multiple, {})
    named = [{"kind": effect.kind, "location": effect.location} for effect in effects] if verdict == "effect" else []
    result = {
        "verdict": verdict,
        "probability": 0.9,
        "effects": named,
        "which": [{**entry, "parameters": {}} for entry in named],
        "where": [],
        "confusable": [],
        "gap": {"closure": None},
        "statistics": STATISTICS | said.pop("statistics", {}),
    }
    return label, score_blind_case(label, result), {"result": result, **said}


def calibrated(*cases: Any) -> dict[str, Any]:
    labels, marks, answers = zip(*cases, strict=True)
    return json.loads(json.dumps(calibrate_thresholds(labels, marks, answers)))


def test_clean_recordings_set_what_chance_may_reach() -> None:
    clean = [
        case("null", "no_gap", open=STATISTICS | {"p_value": 1e-5, "chi2_per_dof": 1.04, "evidence": 2.0}),
        case("null", "no_gap", statistics={"p_value": 0.2, "chi2_per_dof": 1.3}, open={"message": "it did not run"}),
        # a false alarm counts with what it was decided by
        case("null", "unknown", statistics={"p_value": 1e-9, "chi2_per_dof": 1.2, "evidence": 7.0}),
        case("null", "no_gap", open=STATISTICS | {"candidate": 1e-6}),
    ]
    effects = [
        case("single", "effect", DAMPER, multiple=size, statistics={"evidence": 10.0 * size, "explained_fraction": 0.9})
        for size in (0.1, 1.0)
    ]
    strange = [case("left_out", "unknown", DAMPER, statistics={"evidence": 6.0})]
    lost = case("null", "unknown", statistics={"chi2_per_dof": None, "p_value": 0.0})
    assert calibrated(*clean, lost)["rules"]["gap"]["sample"].count(None) == 3, "beyond any number, or not significant"
    found = calibrated(*clean, *effects, *strange)["rules"]
    evidence = found["evidence"]
    assert (evidence["quantile"], evidence["coverage"], evidence["cases"]) == (7.0, 0.8, 4)
    assert evidence["sample"] == [None, None, 2.0, 7.0]
    assert {size: entry["count"] for size, entry in evidence["effects_beyond"].items()} == {"0.1": 0, "1": 1}
    assert (evidence["strange_beyond"]["count"], evidence["strange_beyond"]["of"]) == (0, 1)
    assert evidence["is"] == Thresholds().min_log_bayes_factor
    # a residual that is not significant is none, however large
    assert found["gap"]["sample"][-2:] == [pytest.approx(0.04), pytest.approx(0.2)]
    assert found["candidate"]["quantile"] == 1e-6


@pytest.mark.parametrize(("right", "wrong", "low"), [(80, 20, 0.76), (9, 1, 0.82), (20, 0, 0.9)])
def test_stated_log_odds_are_fitted_to_the_outcomes(right: int, wrong: int, low: float) -> None:
    named = [case("single", "effect", DAMPER, multiple=1.0) for _ in range(right)]
    false = replace(named[0][0], injected=(replace(DAMPER, location="T2"),))
    named += [(false, score_blind_case(false, named[0][2]["result"]), named[0][2]) for _ in range(wrong)]
    line = calibrated(*named)["log_odds"]
    assert (line["cases"], line["right"]) == (right + wrong, right)
    assert low < 1 / (1 + math.exp(-line["offset"] - line["slope"] * math.log(9.0))) < low + 0.1


def test_a_candidate_is_surer_than_any_of_clean_recordings() -> None:
    clean = [case("null", "no_gap", open=STATISTICS | {"candidate": p}) for p in (0.4, 2.345e-5, 3e-3)]
    effects = [case("single", "effect", DAMPER, multiple=3.0, statistics={"candidate": p}) for p in (1e-9, 1e-8, 1e-3)]
    found = calibrated(*clean, *effects)
    assert found["rules"]["candidate"]["quantile"] == 2.345e-5
    assert found["rules"]["candidate"]["effects_beyond"]["3"]["count"] == 2
    assert found["settings"]["gap_significance_level"] == 2.3e-5
    assert calibrated(clean[0])["settings"]["gap_significance_level"] == 1e-4, "no less sure than odds that convince"


@pytest.mark.parametrize(
    ("evidence", "explained", "worth", "asked"),
    [
        # what chance reaches, and what effects reach, outwards to two digits
        (7.123, 0.7089, 7.2, 0.7),
        # but no less than what is worth a name, nor more than anybody asks
        (1.0, 0.99, 5.0, 0.75),
        (None, None, 5.0, 0.75),
    ],
)
def test_settings_are_quantiles_within_what_is_of_use(evidence, explained, worth, asked) -> None:
    clean = case("null", "no_gap", open=STATISTICS | {"evidence": evidence})
    named = case("single", "effect", DAMPER, multiple=3.0, statistics={"explained_fraction": explained})
    settings = calibrated(clean, named)["settings"]
    assert (settings["min_log_bayes_factor"], settings["min_explained_fraction"]) == (worth, asked)


def test_of_two_rules_for_one_setting_the_wider_counts() -> None:
    clean = case("null", "no_gap", open=STATISTICS | {"evidence": 6.0})
    fits = {"a@b": -4.0, "kelvin_voigt@T1": 14.0}
    alone = {label: {"held_out_chi2_per_sample": 1.0, "bic_difference": size} for label, size in fits.items()}
    true = case("single", "effect", DAMPER, multiple=3.0, statistics={"single_effects": alone})
    assert calibrated(clean, true)["settings"]["min_log_bayes_factor"] == 9.0


def test_cases_that_could_not_be_fitted_do_not_count() -> None:
    label, told, answer = case("null", "insufficient_data")
    del answer["result"]["statistics"]
    found = calibrated((label, told, answer))["rules"]
    assert {entry["cases"] for entry in found.values()} == {0}
    assert {entry["quantile"] for entry in found.values()} == {None}


def test_every_rule_is_of_a_threshold() -> None:
    assert all(hasattr(Thresholds(), rule["setting"]) for rule in calibrate_thresholds((), (), ())["rules"].values())
    wide = thresholds_always_accepting_best_candidate(Thresholds(n_refit_per_round=3))
    assert wide.n_refit_per_round == 3
    assert wide.significance_level > 1 > Thresholds().significance_level


@pytest.fixture(scope="module")
def kept():
    return json.loads((files("yid_ocp") / "data" / "defaults" / "thresholds.json").read_text("utf-8"))


def test_defaults_are_those_that_it_advises_and_follow_from_its_samples_by_the_rules_as_they_are(kept):
    current = calibrate_thresholds((), (), ())
    settings = [rule["setting"] for rule in current["rules"].values()]
    assert kept["format"] == current["format"]
    assert kept["settings"] == {setting: getattr(DEFAULT_THRESHOLDS, setting) for setting in settings}
    least = DEFAULT_THRESHOLDS.null_test_excess_criteria.min_excess_chi2_per_dof
    assert least == kept["settings"]["min_excess_chi2_per_dof"]
    rules = kept["rules"]
    assert set(rules) == set(current["rules"])
    for name, rule in current["rules"].items():
        own = rules[name]
        assert all(own[part] == rule[part] for part in ("setting", "of", "side", "limit"))
        sample = [float("-inf") if value is None else value for value in own["sample"]]
        value, coverage = _conformal_quantile(sample, own["side"], kept["asked"])
        assert own["coverage"] == coverage
        assert own["quantile"] == (None if value == float("-inf") else value)
    assert _recommended_settings(rules) == kept["settings"]


def test_it_says_what_it_was_made_of(kept):
    assert kept["cases"] >= 100
    assert f"--seed {kept['seed']}" in kept["command"]
    assert "--calibration" in kept["command"]
    assert "/" not in kept["command"], "of no machine in particular"
    assert kept["code"] == kept["code_of_cases"]
