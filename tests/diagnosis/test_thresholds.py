"""A threshold that is changed changes what it stands for."""

from __future__ import annotations

from typing import Annotated, get_args, get_origin, get_type_hints

import numpy as np
import pytest

from yid_ocp.diagnosis import Thresholds, diagnose
from yid_ocp.diagnosis.localise import localise_gap, smoothed_unknown_z_scores
from yid_ocp.options import OptionInfo

KIND = "joint_coulomb@elbow"


def found(bench, **limits):
    recordings = [bench.recording({KIND: {"tau_c": 0.1}}, seed, duration=2.0) for seed in (1, 2)]
    return diagnose(
        bench.problem(recordings[:1]), (KIND, "joint_stribeck@elbow"), recordings[1:], thresholds=Thresholds(**limits)
    )


@pytest.fixture(scope="module")
def usual(bench):
    return found(bench)


def test_every_threshold_says_what_it_is():
    for name, hint in get_type_hints(Thresholds, include_extras=True).items():
        assert get_origin(hint) is Annotated, name
        assert any(isinstance(entry, OptionInfo) and entry.description for entry in get_args(hint)), name


def test_the_whole_diagnosis_goes_by_what_it_is_given(bench, usual):
    other = found(
        bench,
        residual_window=1.0,
        detection_z=2 * 3.858,
        shape_grid_size=2,
        force_prior_std=0.2,
        detectable_chi2=40.0,
        min_log_bayes_factor=6.0,
        n_refit_per_round=1,
        signature_overlap=1.0,
        n_refit_lowest_p=0,
    )
    assert usual.verdict == other.verdict == "effect"
    assert max(round(w.end_time - w.start_time, 6) for w in usual.nominal_test.windows) == 0.5
    assert max(round(w.end_time - w.start_time, 6) for w in other.nominal_test.windows) == 1.0
    sizes = [
        {v.effect.label: v.detectable_amplitudes[f"{KIND}.tau_c"] for v in f.detectability if v.effect.label == KIND}
        for f in (usual, other)
    ]
    assert sizes[1][KIND] == pytest.approx(2 * sizes[0][KIND])
    assert other.smoother_result.min_log_bayes_factor == 6.0
    # unknowns of twice the size raise r'r four times as much, and have to
    for source, size in usual.smoother_result.detectable_std.items():
        assert other.smoother_result.detectable_std[source] == pytest.approx(size)
    assert len(other.single_effect_models) == 1 < len(usual.single_effect_models)


def test_too_few_samples_by_another_measure(bench):
    assert found(bench, min_samples_per_unknown=1e4).verdict == "insufficient_data"


@pytest.mark.parametrize(
    ("limits", "verdict"),
    [
        ({"min_gap_closed": 0.999}, "unknown"),
        ({"min_excess_chi2": 1e3, "min_channel_excess_chi2": 1e3}, "no_gap"),
    ],
)
def test_a_verdict_goes_by_its_thresholds(bench, limits, verdict):
    assert found(bench, **limits).verdict == verdict


def test_a_gap_is_there_by_so_many_standard_deviations(usual):
    loose, strict = (localise_gap(usual.smoother_result, sure)[0].time_windows for sure in (0.5, 20.0))
    assert sum(b - a for a, b in loose) > sum(b - a for a, b in strict)
    informed = [
        np.isfinite(smoothed_unknown_z_scores(usual.smoother_result, 0, mapped)[2]).sum() for mapped in (0.1, 0.999)
    ]
    assert informed[0] > informed[1]
