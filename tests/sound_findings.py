"""What must hold of every finding of a diagnosis, whatever it is: checked of all findings of the tests."""

import json
import re

from yid_ocp.diagnosis.diagnosis_result import DiagnosisResult
from yid_ocp.inference.null_test import residuals_exceed_noise


def assert_nothing_impossible_is_said(finding: DiagnosisResult, text: str) -> None:
    """Numbers are finite, a gap is above noise, and closure has a gap to close."""
    assert not re.search(r"\b(nan|inf)\b", text), text
    tests = (finding.nominal_test, finding.nominal_held_out_test)
    if "an error beyond noise (a gap)" in text and finding.screening.candidate_scores:
        assert residuals_exceed_noise(tests, finding.thresholds.null_test_excess_criteria), text
    if finding.verdict == "no_gap" and not finding.residual_exceeds_noise(finding.thresholds):
        is_significant = min(test.p_value for test in tests) < finding.thresholds.significance_level
        assert ("but too small for a gap" in text) == is_significant
    if finding.verdict in ("no_gap", "insufficient_data"):
        assert "an error beyond noise (a gap)" not in text
        assert not finding.accepted_effects
    if finding.nominal_model.held_out_loss.excess_chi2_per_sample <= 0:
        assert not re.search(r"\bremoves? [0-9-]", text), text


def assert_sound(finding: DiagnosisResult) -> None:
    """The same, and of result.json: strict numbers, no closure where there is no gap."""
    assert_nothing_impossible_is_said(finding, finding.summary)
    result = finding.to_dict()
    json.dumps(result, allow_nan=False)
    rejected = result["rejected_candidates"]
    closures = [result["gap"]["closure"], *(entry["closure"] for entry in (*result["which"], *rejected))]
    if finding.nominal_model.held_out_loss.excess_chi2_per_sample <= 0:
        assert closures == [None] * len(closures)
    if finding.verdict in ("no_gap", "insufficient_data"):
        assert result["gap"]["closure"] is None
        assert result["effects"] == []
