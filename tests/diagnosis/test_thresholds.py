"""A threshold that is changed changes what it stands for."""

import pytest

from yid_ocp.diagnosis.diagnose import diagnose
from yid_ocp.diagnosis.thresholds import Thresholds

KIND = "joint_coulomb@elbow"


def found(bench, **limits):
    recordings = [bench.recording({KIND: {"tau_c": 0.1}}, seed, duration=2.0) for seed in (1, 2)]
    return diagnose(
        bench.problem(recordings[:1]), (KIND, "joint_stribeck@elbow"), recordings[1:], thresholds=Thresholds(**limits)
    )


def test_the_whole_diagnosis_goes_by_what_it_is_given(bench):
    few = {"n_refit_per_round": 1, "signature_overlap": 1.0}
    usual, other = found(bench), found(bench, min_log_bayes_factor=6.0, **few)
    assert usual.verdict == other.verdict == "effect"
    assert other.smoother_result.min_log_bayes_factor == 6.0
    assert len(other.single_effect_models) == 1 < len(usual.single_effect_models)


@pytest.mark.parametrize(
    ("limits", "verdict"), [({"min_z": 1e3}, "unknown"), ({"gap_significance_level": 1e-300}, "no_gap")]
)
@pytest.mark.usefixtures("without_law")
def test_a_verdict_goes_by_its_thresholds(bench, limits, verdict):
    assert found(bench, **limits).verdict == verdict
