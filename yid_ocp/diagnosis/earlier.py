"""What a diagnosis is told of another time: earlier runs, and recordings made without what is looked for."""

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
    """What a diagnosis is told of another time.

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
        """Several runs as one."""
        if not runs:
            return Earlier(None, (), 0.0, 1.0, without)
        known, chi2, degrees = together(runs)
        return Earlier(known, tuple(run.run for run in runs), chi2, p_value(chi2, degrees), without)

    def since(self, fit: Fit, limits: Thresholds) -> Since | None:
        """How far a fit has moved from the earlier runs; None without any."""
        if self.known is None:
            return None
        return since(fit, self.known, limits.level, self.runs, (self.chi2, self.p_value))

    def changed(self, fit: Fit, limits: Thresholds) -> tuple[Shift, ...]:
        """Parameters that a fit has moved."""
        found = self.since(fit, limits)
        return () if found is None else found.changed

    def counterfactual(self, nominal: Fit, added: Sequence[Added], progress: Progress) -> Counterfactual | None:
        """The world without the effects that were found; None where there are none, or nothing of that world."""
        if not added or not self.without:
            return None
        progress.stage("predicting the world without the effects")
        return counterfactual(nominal, added[-1].fit, self.without, self.known)


UNTOLD = Earlier(None, (), 0.0, 1.0, ())
"""Of a diagnosis that stands for itself."""
