"""Fits, values and intervals in words, case by case."""

from __future__ import annotations

import math

import pytest

from yid_ocp.inference import uncertainty


@pytest.mark.parametrize(
    ("interval", "expected"),
    [
        ((1.23456, 20.0), "1.235 to 20"),
        ((1.23456, None), "above 1.235"),
        ((None, 20.0), "below 20"),
        ((None, None), "open"),
        ((0.0, 0.0), "0 to 0"),
    ],
)
def test_an_interval_may_have_open_ends(interval, expected):
    assert uncertainty.interval_text(*interval) == expected


@pytest.mark.parametrize(
    ("std", "interval", "expected"),
    [
        (0.1234, None, "22.12 ± 0.12"),
        (0.1234, (20.0, None), "22.12 (above 20)"),
        (None, (20.0, 24.0), "22.12 (20 to 24)"),
        (0.1234, (None, None), "22.12 ± 0.12"),
        (None, (None, None), "22.12"),
        (None, None, "22.12"),
        (0.0, None, "22.12 ± 0"),
    ],
)
def test_a_value_is_told_with_what_is_known_of_it(std, interval, expected):
    assert uncertainty.value_and_uncertainty_text(22.1234, std, interval) == expected


@pytest.mark.parametrize("chi2", [None, math.nan])
@pytest.mark.parametrize("explains", [True, False])
def test_a_fit_without_a_misfit_is_not_judged(chi2, explains):
    assert (
        uncertainty.goodness_of_fit_message(chi2, explains) == "whether the model explains the recordings is not known"
    )


def test_a_fit_is_told_with_its_misfit_and_what_follows():
    assert uncertainty.goodness_of_fit_message(1.0449, True).endswith(
        "to within their noise (chi2 per degree of freedom is 1.04)"
    )
    bad = uncertainty.goodness_of_fit_message(9.0, False)
    assert "does not explain the recordings (chi2 per degree of freedom is 9," in bad
    assert bad.endswith("run `yid-ocp diagnose`")


def test_tables_say_the_same_as_sentences():
    assert uncertainty.VERDICT_TABLE_TEXTS["weak"] == "weakly determined"
    assert uncertainty.VERDICT_TABLE_TEXTS["not_identifiable"] == "cannot be found"
    assert set(uncertainty.VERDICT_TABLE_TEXTS) == set(uncertainty.VERDICT_PREDICATES)
