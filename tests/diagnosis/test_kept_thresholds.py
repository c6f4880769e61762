"""The thresholds of the code are what the calibration that is kept beside it advises."""

from __future__ import annotations

import json
from importlib.resources import files

import pytest

from yid_ocp.diagnosis.blind.score import (
    _CALIBRATION_FORMAT,
    _CALIBRATION_RULES,
    _conformal_quantile,
    _recommended_settings,
)
from yid_ocp.diagnosis.thresholds import DEFAULT_THRESHOLDS


@pytest.fixture(scope="module")
def kept():
    return json.loads((files("yid_ocp") / "data" / "defaults" / "thresholds.json").read_text("utf-8"))


def test_defaults_are_those_that_it_advises(kept):
    assert kept["format"] == _CALIBRATION_FORMAT
    assert kept["settings"] == {
        rule.setting: getattr(DEFAULT_THRESHOLDS, rule.setting) for rule in _CALIBRATION_RULES.values()
    }


def test_its_advice_follows_from_its_samples_by_the_rules_as_they_are(kept):
    rules = kept["rules"]
    assert set(rules) == set(_CALIBRATION_RULES)
    for name, rule in _CALIBRATION_RULES.items():
        own = rules[name]
        assert (own["setting"], own["of"], own["side"], own["limit"]) == (
            rule.setting,
            rule.of,
            rule.side,
            rule.limit,
        )
        sample = [float("-inf") if value is None else value for value in own["sample"]]
        value, coverage = _conformal_quantile(sample, rule.side, kept["asked"])
        assert own["coverage"] == coverage
        assert own["quantile"] == (None if value == float("-inf") else value)
    assert _recommended_settings(rules) == kept["settings"]


def test_it_says_what_it_was_made_of(kept):
    assert kept["cases"] >= 100
    assert f"--seed {kept['seed']}" in kept["command"]
    assert "--calibration" in kept["command"]
    assert "/" not in kept["command"], "of no machine in particular"
    assert kept["code"] == kept["code_of_cases"]
