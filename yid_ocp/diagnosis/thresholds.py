"""All numbers that decide a verdict, in one place."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from annotated_types import Ge, Gt, Le, Lt

from yid_ocp.options import About
from yid_ocp.problem.null_test import USUAL, WINDOW, GapLimits


@dataclass(frozen=True)
class Thresholds:
    """All that a verdict depends on besides the data.

    Attributes
    ----------
    level : float
        Significance below which a residual is more than noise.
    smallest_gap : float
        chi2/n - 1 below which a gap is not worth a name, however sure.
    smallest_channel : float
        chi2/n - 1 of the worst channel below which what a candidate would surely mend is not worth a name.
    candidate_level : float
        Significance, as the best of all candidates, from which one shows a gap that the residual as a whole does not.
    shapeless : float
        Part of the significance level that an excess without any shape has to reach.
    samples_per_unknown : float
        Effective samples for every unknown below which nothing is said.
    window : float
        Length of the windows in which the residual is looked at [s].
    detection : float
        Standard deviations of a detectable amplitude: found at the 1 % level nine times out of ten.
    shape_values : int
        Values tried of every shape parameter; the best counts as the best of that many tries.
    refits : int
        Candidates refitted in a round, and once more as many that are like them.
    surest : int
        Candidates of the smallest p-values that are refitted in any case.
    pairs : int
        Pairs of candidates refitted where one effect leaves a gap.
    alike : float
        Part of a signature explained by another candidate from which both are refitted.
    poor, promising : float
        A refit that ends above the chi2/n `poor`, but lowers the excess by the part `promising` or more, is tried again
        from the initial values of the nominal parameters.
    effects : int
        How many may be added.
    away : float
        Standard deviations that an effect must be away from neutral to be kept.
    relevance : float
        Part of the held-out error, of all channels together or of any one, that an effect must take away.
    closure : float
        A held-out closure whose lower end is below this is no improvement; nor is an effect that closes a smaller part
        of what is left.
    tie : float
        Part of chi2/n by which two models may differ and still count as equal, however sure the difference.
    everywhere : float
        chi2/n from which residuals are errors of the model and not noise, so that blocks of time are what is
        independent, and fewer parameters outweigh a larger loss as in BIC.
    stand_in : float
        Part of chi2/n by which an effect of an unlikely shape must beat all others to count.
    shape_factor : float
        Factor by which a shape parameter may leave its range before the shape is unlikely.
    range_widths : float
        Widths of its range by which an amplitude, or a shape parameter whose range begins at zero or below, may leave
        it before the value is unlikely.
    carried : float
        Part of an effect's size by which it may come out otherwise on the held-out recordings.
    carried_stds : float
        Standard deviations by which it may in any case.
    explained : float
        Part of what the smoother explains of the residual which effects have to explain.
    worth : float
        Rise of the log evidence for which a group of unknowns is taken in: odds of 150 to 1.
    places : int
        Groups of unknowns taken in at most.
    noticed : float
        Rise of r'r by which unknowns of the reference size below would be noticed.
    force : float
        Reference standard deviation of an unknown force, as a part of the load that its place carries.
    offset : float
        Reference standard deviation of a grasp's unknown offset [m].
    bias : float
        Reference standard deviation of a sensor's unknown bias, in standard deviations of its noise.
    sure : float
        Standard deviations that an unknown must be away from zero to say when the gap is there.
    as_well : float
        Part of what a place raises the log evidence by that another must reach to be named beside it.
    mapped : float
        1 - posterior/prior variance from which an unknown's value is informed by the data.
    term_error : float
        Part of every term of the inverse dynamics (inertia, Coriolis forces, gravity, springs, friction, the torque
        itself) that a good model may be wrong by at any moment without making an event.
    pulse : float
        Length of the longest event [s]; what lasts longer is the model's.
    event_share : float
        Part of what r'r exceeds the number of samples by that pushes must take with them to be events, and not the
        largest errors of a model that errs everywhere.
    fall : float
        Speed of a joint beyond which the model is not held to anything for the rest of a recording [rad/s or m/s].
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
        """What makes a residual more than noise; the same for a fit."""
        return GapLimits(self.level, self.smallest_gap)


DEFAULTS = Thresholds()
"""What holds where nothing else is said."""
