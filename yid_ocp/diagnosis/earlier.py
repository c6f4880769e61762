"""Baseline of a diagnosis: estimates of earlier runs, and reference recordings without the effect sought."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from yid_ocp.analysis.history import Estimates, p_value, together
from yid_ocp.data.recording import Recording
from yid_ocp.diagnosis.baseline import Shift, Since, since
from yid_ocp.diagnosis.counterfactual import Counterfactual, counterfactual
from yid_ocp.diagnosis.refit import Fit
from yid_ocp.diagnosis.select import Added
from yid_ocp.diagnosis.thresholds import Thresholds
from yid_ocp.progress import Progress


@dataclass(frozen=True)
class Earlier:
    """Combined estimates of earlier runs, and reference recordings made without the effect sought.

    Attributes
    ----------
    known : Estimates or None
        All earlier runs together.
    runs : tuple of str
    chi2, p_value : float
        Of the differences between them.
    without : tuple of Recording
    """

    known: Estimates | None
    runs: tuple[str, ...]
    chi2: float
    p_value: float
    without: tuple[Recording, ...]

    @staticmethod
    def of(runs: Sequence[Estimates], without: tuple[Recording, ...]) -> Earlier:
        """Combine the estimates of several runs into one baseline."""
        if not runs:
            return Earlier(None, (), 0.0, 1.0, without)
        known, chi2, degrees = together(runs)
        return Earlier(known, tuple(run.run for run in runs), chi2, p_value(chi2, degrees), without)

    def since(self, fit: Fit, limits: Thresholds) -> Since | None:
        """Compare a fit with the earlier runs; None if there are none."""
        if self.known is None:
            return None
        return since(fit, self.known, limits.level, self.runs, (self.chi2, self.p_value))

    def changed(self, fit: Fit, limits: Thresholds) -> tuple[Shift, ...]:
        """Return the parameters of a fit that changed significantly since the earlier runs."""
        found = self.since(fit, limits)
        return () if found is None else found.changed

    def counterfactual(self, nominal: Fit, added: Sequence[Added], progress: Progress) -> Counterfactual | None:
        """Predict the recordings with effects removed and added; None without effects or reference recordings."""
        if not added or not self.without:
            return None
        progress.stage("predicting the world without the effects")
        return counterfactual(nominal, added[-1].fit, self.without, self.known)


UNTOLD = Earlier(None, (), 0.0, 1.0, ())
"""No earlier runs and no reference recordings."""
