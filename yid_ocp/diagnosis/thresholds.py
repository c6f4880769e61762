"""Thresholds that decide the verdict of a diagnosis."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from annotated_types import Ge, Gt, Le, Lt

from yid_ocp.options import About
from yid_ocp.problem.null_test import USUAL, WINDOW, GapLimits


@dataclass(frozen=True)
class Thresholds:
    """Thresholds of every step of a diagnosis: null test, screening, refits, selection, localisation and events.

    Attributes
    ----------
    level : float
        Significance below which a residual is more than noise.
    smallest_gap : float
        Smallest excess chi2/n - 1 that counts as a gap, even if a smaller one is significant.
    smallest_channel : float
        Smallest excess chi2/n - 1 of the worst channel for a significant candidate alone to show a gap.
    candidate_level : float
        Bonferroni-corrected significance at which a candidate shows a gap that the null test does not.
    shapeless : float
        Factor on `level` for the p-value of an excess that no candidate and no unknown explains.
    samples_per_unknown : float
        Effective samples required for every unknown; with fewer the verdict is insufficient_data.
    window : float
        Length of the windows of the null test [s].
    detection : float
        Detectable amplitude in standard deviations: 90 % power at the 1 % level.
    shape_values : int
        Grid values of every shape parameter; the p-value is Bonferroni-corrected for them.
    refits : int
        Candidates refitted in a round, plus at most as many that are confusable with them.
    surest : int
        Number of candidates with the smallest p-values that are always refitted.
    pairs : int
        Number of candidate pairs refitted if one effect leaves a gap.
    alike : float
        Fraction of a signature explained by another candidate above which both are refitted.
    poor, promising : float
        A refit that ends above chi2/n `poor` but reduces the excess by at least the fraction `promising` is restarted
        from the initial values of the nominal parameters.
    effects : int
        Maximum number of effects added.
    away : float
        Distance from neutral, in standard deviations, below which an effect is dropped.
    relevance : float
        Relative reduction of the held-out error, of all channels or of any one, required of an effect.
    closure : float
        Smallest fraction of the held-out gap to close: by the lower 95 % bound in total, and by each effect of what is
        left.
    tie : float
        Relative difference of chi2/n below which two models are equivalent, even if it is significant.
    everywhere : float
        chi2/n above which model error dominates, so that blocks of time are the independent samples and BIC weighs
        parameters against loss.
    stand_in : float
        Relative improvement of chi2/n over all other models required of an effect with an implausible shape.
    shape_factor : float
        Factor by which a shape parameter may leave its prior range before the shape is implausible.
    range_widths : float
        Widths of its prior range by which an amplitude, or a shape parameter whose range begins at zero or below, may
        leave it before the value is implausible.
    carried : float
        Relative tolerance between an effect's amplitudes on the estimation and the held-out recordings.
    carried_stds : float
        Largest difference of the same amplitudes in standard deviations; smaller ones always agree.
    explained : float
        Fraction of the smoother's explained chi2 that the effects are required to explain.
    worth : float
        Smallest log Bayes factor for adding a group of unknowns; 5 means odds of 150 to 1.
    places : int
        Maximum number of groups of unknowns.
    noticed : float
        Rise of r'r at which unknowns of the reference size below are detectable.
    force : float
        Prior standard deviation of an unknown force, relative to the load at its location.
    offset : float
        Prior standard deviation of a grasp's unknown offset [m].
    bias : float
        Prior standard deviation of a sensor's unknown bias, relative to its noise.
    sure : float
        Distance of an unknown from zero, in standard deviations, at which a time interval belongs to the gap.
    as_well : float
        Fraction of a location's log evidence that another must reach to be indistinguishable from it.
    mapped : float
        1 - posterior/prior variance above which the data inform an unknown's value.
    term_error : float
        Relative error of the inverse dynamics terms (inertia, Coriolis forces, gravity, springs, friction, the torque
        itself) allowed at any moment without an event.
    pulse : float
        Maximum duration of an event [s]; longer disturbances count as model error.
    event_share : float
        Smallest fraction of the excess of r'r over the number of samples that force events must explain; with less,
        model error dominates and they are dropped.
    fall : float
        Joint speed above which the rest of a recording is ignored [rad/s or m/s].
    """

    # is there a gap
    level: Annotated[float, Gt(0), Lt(1), About("significance below which a gap counts as one")] = USUAL.level
    smallest_gap: Annotated[float, Ge(0), About("chi2/n - 1 below which a gap is not worth a name")] = (
        USUAL.smallest_gap
    )
    smallest_channel: Annotated[float, Ge(0), About("the same of the worst channel, where a candidate mends it")] = 0.02
    candidate_level: Annotated[float, Gt(0), Lt(1), About("significance from which a candidate alone shows a gap")] = (
        1e-4
    )
    shapeless: Annotated[float, Gt(0), Le(1), About("part of the level that an excess without shape must reach")] = 0.01
    samples_per_unknown: Annotated[float, Gt(0), About("effective samples needed for every unknown")] = 3.0
    window: Annotated[float, Gt(0), About("length of the windows of the residual", "s")] = WINDOW
    # which candidates are worth a refit
    detection: Annotated[float, Gt(0), About("standard deviations of a detectable amplitude")] = 2.576 + 1.282
    shape_values: Annotated[int, Ge(1), About("values tried of every shape parameter")] = 4
    refits: Annotated[int, Ge(1), About("candidates refitted in a round")] = 6
    surest: Annotated[int, Ge(0), About("candidates of the smallest p-values refitted in any case")] = 2
    pairs: Annotated[int, Ge(0), About("pairs of candidates refitted where one effect leaves a gap")] = 4
    alike: Annotated[float, Gt(0), Le(1), About("part of a signature from which two candidates are alike")] = 0.9
    poor: Annotated[float, Gt(0), About("chi2/n above which a refit may be tried again")] = 1.1
    promising: Annotated[float, Gt(0), Lt(1), About("part of the excess explained by a refit tried again")] = 0.2
    # which effects are added
    effects: Annotated[int, Ge(1), Le(10), About("how many effects may be added")] = 3
    away: Annotated[float, Ge(0), About("standard deviations from neutral below which no effect is kept")] = 2.0
    relevance: Annotated[float, Ge(0), Lt(1), About("part of a held-out error that an effect must take away")] = 0.01
    closure: Annotated[float, Ge(0), Lt(1), About("part of the held-out gap that must be closed")] = 0.05
    tie: Annotated[float, Ge(0), About("part of chi2/n within which models are equal")] = 0.0014
    everywhere: Annotated[float, Gt(0), About("chi2/n from which a model errs everywhere, and blocks count")] = 1e3
    stand_in: Annotated[float, Ge(0), About("part of chi2/n by which an unlikely shape must be better")] = 0.05
    shape_factor: Annotated[float, Ge(1), About("factor by which a shape parameter may leave its range")] = 2.0
    range_widths: Annotated[float, Ge(0), About("widths of its range by which a value may leave it")] = 1.0
    carried: Annotated[float, Ge(0), About("part of an effect by which it may differ on held-out recordings")] = 0.3
    carried_stds: Annotated[float, Gt(0), About("standard deviations by which it may differ in any case")] = 4.5
    explained: Annotated[float, Ge(0), Le(1), About("part of the smoother's explanation that effects reach")] = 0.75
    # where the gap lies
    worth: Annotated[float, Gt(0), About("rise of the log evidence that a group of unknowns must bring")] = 5.0
    places: Annotated[int, Ge(1), About("groups of unknowns taken in at most")] = 4
    noticed: Annotated[float, Gt(0), About("rise of r'r by which unknowns would be noticed")] = 10.0
    force: Annotated[float, Gt(0), About("unknown force over the load that its place carries")] = 0.1
    offset: Annotated[float, Gt(0), About("unknown offset of a grasp", "m")] = 2e-3
    bias: Annotated[float, Gt(0), About("unknown bias over the noise of its sensor")] = 3.0
    sure: Annotated[float, Gt(0), About("standard deviations from zero at which the gap is there")] = 3.0
    as_well: Annotated[float, Gt(0), Le(1), About("part of a place's evidence at which another is named beside it")] = (
        0.9
    )
    mapped: Annotated[float, Ge(0), Lt(1), About("1 - posterior/prior variance of an informed value")] = 0.5

    # events
    term_error: Annotated[float, Ge(0), Lt(1), About("part of every torque by which a good model may be wrong")] = 0.03
    pulse: Annotated[float, Gt(0), About("length of the longest event", "s")] = 1.0
    event_share: Annotated[float, Ge(0), Lt(1), About("part of the gap that pushes take with them at least")] = 0.1
    fall: Annotated[float, Gt(0), About("speed of a joint from which nothing is judged any more", "rad/s or m/s")] = (
        20.0
    )

    @property
    def gap(self) -> GapLimits:
        """Limits of the null test, which `solve` uses as well."""
        return GapLimits(self.level, self.smallest_gap)


DEFAULTS = Thresholds()
"""Default thresholds."""
