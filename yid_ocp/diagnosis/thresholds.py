"""Thresholds that decide the verdict of a diagnosis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

from annotated_types import Ge, Gt, Le, Lt

from yid_ocp.inference.null_test import DEFAULT_EXCESS_RESIDUAL_CRITERIA
from yid_ocp.inference.smoother import DEFAULT_MIN_LOG_BAYES_FACTOR
from yid_ocp.options import OptionInfo
from yid_ocp.problem.options import ExcessResidualCriteria

NEED_TEST = "whether every effect is needed"  # the name of the last test of a search, which a time limit can skip
_MIN_FINAL_PROBABILITY = 0.5  # of the accepted effects, below which they are provisional


def is_provisional(verdict: str, probability: float, untried: Sequence[str]) -> bool:
    """Check whether accepted effects are probably not the cause, or the need for each of them was not tested."""
    return verdict == "effect" and (probability < _MIN_FINAL_PROBABILITY or NEED_TEST in untried)


@dataclass(frozen=True)
class Thresholds:
    """The thresholds for every step of a diagnosis. The section `diagnosis` of the settings reference has them all."""

    min_log_bayes_factor: Annotated[
        float, Gt(0), OptionInfo("smallest rise of the log evidence for which a group of unknowns is selected")
    ] = DEFAULT_MIN_LOG_BAYES_FACTOR
    # is there a gap
    significance_level: Annotated[
        float, Gt(0), Lt(1), OptionInfo("significance level at which a candidate is tried and a window is flagged")
    ] = DEFAULT_EXCESS_RESIDUAL_CRITERIA.significance_level
    min_excess_chi2_per_dof: Annotated[float, Ge(0), OptionInfo("smallest chi2/n - 1 of a gap")] = (
        DEFAULT_EXCESS_RESIDUAL_CRITERIA.min_excess_chi2_per_dof
    )
    gap_significance_level: Annotated[
        float, Gt(0), Lt(1), OptionInfo("significance level of a gap, of all residuals or along a candidate")
    ] = 1e-4
    # which candidates are worth a refit
    n_refit_per_round: Annotated[int, Ge(1), OptionInfo("number of candidates refitted per round")] = 6
    n_refit_pairs: Annotated[int, Ge(0), OptionInfo("pairs of candidates refitted if one effect leaves a gap")] = 4
    signature_overlap: Annotated[
        float, Gt(0), Le(1), OptionInfo("fraction of a signature that another candidate must explain to be confusable")
    ] = 0.9
    budget: Annotated[float | None, Gt(0), OptionInfo("time after which no further refit starts", "s")] = None
    # which effects are added
    max_effects: Annotated[int, Ge(1), Le(10), OptionInfo("largest number of added effects")] = 3
    min_z: Annotated[float, Ge(0), OptionInfo("standard deviations from neutral below which no effect is kept")] = 2.0
    prior_range_margin_in_widths: Annotated[
        float, Ge(0), OptionInfo("how far a value may leave its usual range: in widths, or a factor of 1 + this")
    ] = 1.0
    min_explained_fraction: Annotated[
        float, Ge(0), Lt(1), OptionInfo("fraction of the fitted gap that one effect must explain")
    ] = 0.75
    min_closure: Annotated[
        float, Ge(0), Lt(1), OptionInfo("lower end of the closure's 95 % interval that one effect must reach otherwise")
    ] = 0.4
    # where the gap lies, and when
    max_event_duration: Annotated[float, Gt(0), OptionInfo("largest duration of an event", "s")] = 1.0
    max_joint_speed: Annotated[
        float, Gt(0), OptionInfo("speed of a joint above which the rest of a recording is ignored", "rad/s or m/s")
    ] = 20.0

    @property
    def null_test_excess_criteria(self) -> ExcessResidualCriteria:
        """The significance level and the smallest relevant excess of the null test, also used by `solve`."""
        return ExcessResidualCriteria(self.significance_level, self.min_excess_chi2_per_dof)


DEFAULT_THRESHOLDS = Thresholds()
