"""A threshold that is changed changes what it stands for."""

from dataclasses import fields

import pytest

from yid_ocp.diagnosis.diagnose import diagnose
from yid_ocp.diagnosis.thresholds import Thresholds
from yid_ocp.options import options_by_key

KIND = "joint_coulomb@elbow"


def found(bench, **limits):
    recordings = [bench.recording({KIND: {"tau_c": 0.1}}, seed, duration=2.0) for seed in (1, 2)]
    return diagnose(
        bench.problem(recordings[:1]), (KIND, "joint_stribeck@elbow"), recordings[1:], thresholds=Thresholds(**limits)
    )


def test_every_threshold_is_a_setting():
    assert set(options_by_key(Thresholds)) == {entry.name for entry in fields(Thresholds)}


def test_the_whole_diagnosis_goes_by_what_it_is_given(bench):
    few = {"shape_parameter_grid_size": 2, "n_refit_per_round": 1, "signature_overlap": 1.0}
    sizes = {
        "detectable_amplitude_z": 2 * 3.858,
        "force_prior_std_over_load": 0.2,
        "detectable_unknown_chi2_rise": 40.0,
    }
    usual, other = found(bench), found(bench, residual_test_window=1.0, min_log_bayes_factor=6.0, **sizes, **few)
    assert usual.verdict == other.verdict == "effect"
    longest = [max(round(w.end_time - w.start_time, 6) for w in f.nominal_test.windows) for f in (usual, other)]
    assert longest == [0.5, 1.0]
    sizes = [
        {
            v.effect.label: v.detectable_amplitudes[f"{KIND}.tau_c"]
            for v in f.screening.detectability
            if v.effect.label == KIND
        }
        for f in (usual, other)
    ]
    assert sizes[1][KIND] == pytest.approx(2 * sizes[0][KIND])
    assert other.smoother_result.min_log_bayes_factor == 6.0
    # unknowns of twice the size raise r'r four times as much, and have to
    for source, size in usual.smoother_result.detectable_std.items():
        assert other.smoother_result.detectable_std[source] == pytest.approx(size)
    assert len(other.single_effect_models) == 1 < len(usual.single_effect_models)


@pytest.mark.parametrize(
    ("limits", "verdict"),
    [
        ({"min_samples_per_unknown": 1e4}, "insufficient_data"),
        ({"min_gap_closed": 0.999}, "unknown"),
        ({"gap_significance_level": 1e-300}, "no_gap"),
    ],
)
@pytest.mark.usefixtures("without_law")
def test_a_verdict_goes_by_its_thresholds(bench, limits, verdict):
    assert found(bench, **limits).verdict == verdict
