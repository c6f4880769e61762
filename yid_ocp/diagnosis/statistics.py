"""What a verdict depends on besides thresholds, number by number; thresholds are calibrated on it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from yid_ocp.diagnosis.select import fall
from yid_ocp.diagnosis.verdict import assumptions, best_of

if TYPE_CHECKING:
    from yid_ocp.diagnosis.finding import Finding


def statistics(finding: Finding) -> dict[str, Any]:
    """The numbers that were held against `Thresholds`, as JSON; None where a step was not come to.

    Parameters
    ----------
    finding : Finding

    Returns
    -------
    dict
        `p_value` and `chi2_per_dof` of the null test (of both residuals together), `largest_channel` (chi2/n of the
        worst channel), `candidate` (p-value of the best, as the best of so many), `evidence` (what unknown forces,
        offsets and biases raise the log evidence by), `closure` and `closure_low` (held out, of all that was added,
        accepted or not), `fall` (part of the held-out error that they take away), `explained` (over what the smoother
        explains), `assumptions`, `carried` (standard deviations between the values found and those on the held-out
        recordings, at most).
    """
    tests = (finding.before, finding.held_out_before)
    apart = [
        abs(entry.value - entry.again) / math.hypot(entry.std, entry.again_std)
        for entry in finding.carried
        if math.hypot(entry.std, entry.again_std) > 0
    ]
    added = finding.added
    found = {
        "p_value": min(1.0, len(tests) * min(test.p_value for test in tests)),
        "chi2_per_dof": max(test.chi2_per_dof for test in tests),
        "largest_channel": max((value for test in tests for value in test.channels.values()), default=None),
        "candidate": min(1.0, best_of(finding.scores)),
        "evidence": None if finding.smoothed is None else max(finding.smoothed.evidence.values()),
        "closure": finding.closure.value if added else None,
        "closure_low": finding.closure.low if added else None,
        "fall": fall(finding.nominal.loss, added[-1].fit.loss) if added else None,
        "explained": finding.explained if added else None,
        "assumptions": assumptions(added),
        "carried": max(apart, default=None),
    }
    return {name: None if value is None or not math.isfinite(value) else value for name, value in found.items()}
