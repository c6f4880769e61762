"""Thresholds that decide the verdict of a diagnosis."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from annotated_types import Ge, Gt, Le, Lt

from yid_ocp.inference.null_test import (
    DEFAULT_EXCESS_RESIDUAL_CRITERIA,
    RESIDUAL_WINDOW_SECONDS,
)
from yid_ocp.inference.smoother_model import SmootherThresholds
from yid_ocp.options import OptionInfo
from yid_ocp.problem.options import ExcessResidualCriteria


@dataclass(frozen=True)
class Thresholds(SmootherThresholds):
    """Thresholds of every step of a diagnosis, from the null test to the events.

    Each field has a description, repeated in the section `diagnosis` of the settings reference."""

    # is there a gap
    significance_level: Annotated[
        float, Gt(0), Lt(1), OptionInfo("significance from which a candidate is tried, and a window flagged")
    ] = DEFAULT_EXCESS_RESIDUAL_CRITERIA.significance_level
    min_excess_chi2_per_dof: Annotated[float, Ge(0), OptionInfo("chi2/n - 1 below which a gap is not worth a name")] = (
        DEFAULT_EXCESS_RESIDUAL_CRITERIA.min_excess_chi2_per_dof
    )
    min_channel_excess_chi2_per_dof: Annotated[
        float, Ge(0), OptionInfo("the same for the worst channel, if a candidate explains it")
    ] = 0.02
    gap_significance_level: Annotated[
        float, Gt(0), Lt(1), OptionInfo("significance from which there is a gap, of all residuals or along a candidate")
    ] = 1e-4
    min_samples_per_unknown: Annotated[float, Gt(0), OptionInfo("effective samples needed for every unknown")] = 3.0
    residual_window: Annotated[float, Gt(0), OptionInfo("length of the windows of the residual", "s")] = (
        RESIDUAL_WINDOW_SECONDS
    )
    # which candidates are worth a refit
    detectable_amplitude_z: Annotated[float, Gt(0), OptionInfo("amplitude over std at which it is detectable")] = (
        2.576 + 1.282
    )
    shape_grid_size: Annotated[int, Ge(1), OptionInfo("values tried of every shape parameter")] = 4
    n_refit_per_round: Annotated[int, Ge(1), OptionInfo("candidates refitted in a round")] = 6
    n_refit_lowest_p: Annotated[int, Ge(0), OptionInfo("candidates of the smallest p-values refitted in any case")] = 2
    n_refit_pairs: Annotated[int, Ge(0), OptionInfo("pairs of candidates refitted where one effect leaves a gap")] = 4
    signature_overlap: Annotated[
        float, Gt(0), Le(1), OptionInfo("part of a signature from which two candidates are alike")
    ] = 0.9
    budget: Annotated[float | None, Gt(0), OptionInfo("time from which on no refit begins", "s")] = None
    # which effects are added
    max_effects: Annotated[int, Ge(1), Le(10), OptionInfo("how many effects may be added")] = 3
    min_z: Annotated[float, Ge(0), OptionInfo("standard deviations from neutral below which no effect is kept")] = 2.0
    min_gap_closed: Annotated[float, Ge(0), Lt(1), OptionInfo("part of the held-out gap that must be closed")] = 0.05
    prior_range_margin_in_widths: Annotated[
        float, Ge(0), OptionInfo("widths, or a factor of 1 + this, by which a value may leave its range")
    ] = 1.0
    transfer_rtol: Annotated[
        float, Ge(0), OptionInfo("part of an effect by which it may differ on held-out recordings")
    ] = 0.3
    transfer_z_max: Annotated[float, Gt(0), OptionInfo("standard deviations by which it may differ in any case")] = 4.5
    min_explained_fraction: Annotated[
        float, Ge(0), Le(1), OptionInfo("part of the smoother's explanation that effects reach")
    ] = 0.75
    # where the gap lies
    location_z: Annotated[float, Gt(0), OptionInfo("standard deviations from zero at which the gap is there")] = 3.0
    informed_fraction: Annotated[
        float, Ge(0), Lt(1), OptionInfo("1 - posterior/prior variance of an informed value")
    ] = 0.5

    # events
    inverse_dynamics_rtol: Annotated[
        float, Ge(0), Lt(1), OptionInfo("part of every torque by which a good model may be wrong")
    ] = 0.03
    max_event_duration: Annotated[float, Gt(0), OptionInfo("length of the longest event", "s")] = 1.0
    min_event_chi2_fraction: Annotated[
        float, Ge(0), Lt(1), OptionInfo("part of the gap that pushes take with them at least")
    ] = 0.1
    max_joint_speed: Annotated[
        float, Gt(0), OptionInfo("speed of a joint from which nothing is judged any more", "rad/s or m/s")
    ] = 20.0

    @property
    def null_test_limits(self) -> ExcessResidualCriteria:
        """Significance level and smallest excess of the null test, also used by `solve`."""
        return ExcessResidualCriteria(self.significance_level, self.min_excess_chi2_per_dof)


DEFAULT_THRESHOLDS = Thresholds()
"""Default thresholds."""
