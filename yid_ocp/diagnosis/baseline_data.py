"""Baseline of a diagnosis: estimates of earlier runs, and reference recordings without the effect sought."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from yid_ocp.analysis.estimate_history import RunEstimates, chi2_p_value, pool_estimates
from yid_ocp.data.recording import Recording
from yid_ocp.diagnosis.baseline_comparison import BaselineComparison, ParameterShift, compare_with_baseline
from yid_ocp.diagnosis.counterfactual import CounterfactualTest, predict_counterfactual
from yid_ocp.diagnosis.refit import RefitModel
from yid_ocp.diagnosis.select import SelectedEffect
from yid_ocp.diagnosis.thresholds import Thresholds
from yid_ocp.progress import Progress


@dataclass(frozen=True)
class BaselineData:
    """Combined estimates of earlier runs, and reference recordings made without the effect sought.

    Attributes
    ----------
    combined_estimates : Estimates or None
        All earlier runs together.
    baseline_runs : tuple of str
    between_runs_chi2, between_runs_p_value : float
        Of the differences between them.
    reference_recordings : tuple of Recording
    """

    combined_estimates: RunEstimates | None
    baseline_runs: tuple[str, ...]
    between_runs_chi2: float
    between_runs_p_value: float
    reference_recordings: tuple[Recording, ...]

    @staticmethod
    def from_runs(runs: Sequence[RunEstimates], without: tuple[Recording, ...]) -> BaselineData:
        """Combine the estimates of several runs into one baseline."""
        if not runs:
            return BaselineData(None, (), 0.0, 1.0, without)
        known, chi2, degrees = pool_estimates(runs)
        return BaselineData(known, tuple(run.run_name for run in runs), chi2, chi2_p_value(chi2, degrees), without)

    def compare_with_baseline(self, fit: RefitModel, limits: Thresholds) -> BaselineComparison | None:
        """Compare a fit with the earlier runs; None if there are none."""
        if self.combined_estimates is None:
            return None
        return compare_with_baseline(
            fit,
            self.combined_estimates,
            limits.significance_level,
            self.baseline_runs,
            (self.between_runs_chi2, self.between_runs_p_value),
        )

    def changed_parameters(self, fit: RefitModel, limits: Thresholds) -> tuple[ParameterShift, ...]:
        """Return the parameters of a fit that changed significantly since the earlier runs."""
        found = self.compare_with_baseline(fit, limits)
        return () if found is None else found.changed_parameters

    def predict_reference_recordings(
        self, nominal: RefitModel, added: Sequence[SelectedEffect], progress: Progress
    ) -> CounterfactualTest | None:
        """Predict the recordings with effects removed and added; None without effects or reference recordings."""
        if not added or not self.reference_recordings:
            return None
        progress.begin_stage("predicting the world without the effects")
        return predict_counterfactual(
            nominal, added[-1].refitted_model, self.reference_recordings, self.combined_estimates
        )


NO_BASELINE = BaselineData(None, (), 0.0, 1.0, ())
"""No earlier runs and no reference recordings."""
