"""Step eight: whether there is a gap, whether the effects carry over to the held-out recordings, and the verdict.

Two or three effects together imitate almost anything on the recordings on which they were fitted. What is true of the
robot comes out the same wherever it is fitted; so the held-out recordings are fitted in turn, and values are compared.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from yid_ocp.analysis.discretisation import refitted_residual_at_finer_step
from yid_ocp.diagnosis.events import EventSet, problem_corrected_for_events
from yid_ocp.diagnosis.hypotheses import join_effect_labels
from yid_ocp.diagnosis.refit import RefitContext, RefitStore, RefittedModel, StoredFit, refit_with_effects
from yid_ocp.diagnosis.screening import CandidateScore, DetectableAmplitudes, bonferroni_min_p_value
from yid_ocp.diagnosis.select import GapClosure, SelectedEffect
from yid_ocp.diagnosis.thresholds import Thresholds
from yid_ocp.effects import EffectBase
from yid_ocp.inference.null_test import NullTestResult, residuals_exceed_noise
from yid_ocp.inference.smoother import SmoothedUnknownsResult

UnknownVerdictReason = Literal["", "none", "unsure", "little", "stand_in"]
"""Why the verdict is unknown: no candidate helps, closure not significant, too little explained, no transfer."""

_DISAGREEMENT_Z = 2.0  # standard deviations beyond which two fits disagree


@dataclass(frozen=True)
class EffectAmplitudeTransferCheck:
    """Comparison of one effect parameter's estimates from the estimation recordings and from the held-out ones."""

    effect_label: str
    parameter: str
    unit: str
    estimation_value: float
    estimation_std: float
    held_out_value: float
    held_out_std: float
    is_consistent: bool

    @property
    def both_estimates_text(self) -> str:
        """Text with both estimates, their standard deviations and unit."""
        here = f"{self.estimation_value:.3g} ± {self.estimation_std:.2g} {self.unit} on the recordings to estimate on"
        there = f"{self.held_out_value:.3g} ± {self.held_out_std:.2g} on the held-out ones"
        return f"{self.effect_label}.{self.parameter} is {here} and {there}"

    @property
    def estimate_difference_and_std(self) -> tuple[float, float]:
        """Absolute difference between the two estimates, and its standard deviation."""
        spread = math.hypot(self.estimation_std, self.held_out_std)
        return abs(self.estimation_value - self.held_out_value), spread


def check_effect_amplitude_transfer(
    search: RefitContext, fit: RefittedModel
) -> tuple[EffectAmplitudeTransferCheck, ...]:
    """Refit the effects on the held-out recordings and compare each amplitude with its estimate in `fit`.

    Empty if one recording is split, or if the model cannot be fitted there, which is no evidence against it.
    """
    if search.problem.is_split_in_blocks or not fit.effects:
        return ()
    search.progress.begin_stage("fitting the held-out recordings with the same effects", 1.0, 2.5)
    problem = search.problem.problem
    turned = replace(search.problem, problem=problem.with_episodes(problem.held_out, problem.episodes))
    if problem.has_process_noise:
        turned = turned.whitened_at(fit.values)
    # what both sets of recordings have in common, nothing of single recordings' starts
    names = {*turned.nominal_free_parameters, *(name for effect in fit.effects for name in effect.parameters.names)}
    start = {name: value for name, value in fit.values.items() if name in names}
    name = f"{join_effect_labels(fit.effects)} on the held-out recordings"
    again = refit_with_effects(turned, fit.effects, start, search.store, name, search.thresholds)
    if again is None:
        return ()
    return tuple(entry for effect in fit.effects for entry in _compare(effect, fit, again, search.thresholds))


def _compare(
    effect: EffectBase, first: RefittedModel, second: RefittedModel, limits: Thresholds
) -> list[EffectAmplitudeTransferCheck]:
    """The amplitudes of one effect in two fits."""
    neutral, found = effect.neutral_values, []
    width = {name: high - low for name, (low, high) in effect.prior_ranges.items()}
    size = max(abs(fit.values[n] - neutral[n]) / width[n] for fit in (first, second) for n in effect.amplitude_names)
    for name in effect.amplitude_names:
        own = (first.values[name], first.std[name], second.values[name], second.std[name])
        what = (effect.label, name.removeprefix(f"{effect.label}."), effect.parameters[name].unit)
        entry = EffectAmplitudeTransferCheck(*what, *own, True)
        apart, spread = entry.estimate_difference_and_std
        # what has no standard deviation says nothing against it
        sure = math.isfinite(spread) and apart > limits.transfer_z_max * spread
        found.append(replace(entry, is_consistent=not sure or apart <= limits.transfer_rtol * size * width[name]))
    return found


def inflate_fit_stds_by_disagreement(
    fit: RefittedModel, entries: Sequence[EffectAmplitudeTransferCheck]
) -> RefittedModel:
    """Return the fit with standard deviations increased for amplitudes that disagree between the recordings.

    Where two fits differ by more than `_DISAGREEMENT_Z` standard deviations of both together, each is known to the
    spread of the two, the difference over the square root of two.
    """
    std = dict(fit.std)
    for entry in entries:
        (apart, spread), name = entry.estimate_difference_and_std, f"{entry.effect_label}.{entry.parameter}"
        if apart > _DISAGREEMENT_Z * spread:
            std[name] = max(std[name], apart / math.sqrt(2.0))
    return replace(fit, std=std)


def failed_transfer_checks(entries: Sequence[EffectAmplitudeTransferCheck]) -> tuple[EffectAmplitudeTransferCheck, ...]:
    """Return the checks whose two estimates disagree."""
    return tuple(entry for entry in entries if not entry.is_consistent)


def has_significant_gap(
    before: NullTestResult,
    held_out: NullTestResult,
    limits: Thresholds,
    ranked: Sequence[CandidateScore] = (),
    offsets: bool = False,
) -> bool:
    """Whether the residual, as a whole or along a candidate's signature, exceeds noise by a relevant amount.

    Along a candidate's signature some channel must be above noise too; the sum over all channels does not notice what
    only a few samples show. A candidate alone needs a smaller p-value than the sum. An offset of a torque beyond the
    stated one needs no such channel where `offsets` are stated: it is one number among thousands.
    """
    if residuals_exceed_noise((before, held_out), limits.null_test_limits):
        return True
    stated = [score.p_value for score in ranked if score.effect.is_torque_offset] if offsets else []
    if stated and min(stated) * len(ranked) < limits.gap_significance_level_by_candidate:
        return True
    best = bonferroni_min_p_value(ranked)
    largest = max((*before.channel_chi2.values(), *held_out.channel_chi2.values()), default=1.0)
    return best < limits.gap_significance_level_by_candidate and largest > 1 + limits.min_channel_excess_chi2_per_dof


@dataclass(frozen=True)
class _FinerStepRefitStore:
    """The refits of another store that were made at a finer time step [s] than stated, under names of their own."""

    store: RefitStore
    time_step: float

    def get(self, name: str) -> StoredFit | None:
        """Return the refit stored under a name at this time step; None if there is none."""
        return self.store.get(f"{name} at {self.time_step:g} s")

    def put(self, name: str, refitted: StoredFit) -> None:
        """Store a refit under a name and this time step."""
        self.store.put(f"{name} at {self.time_step:g} s", refitted)


def finer_step_that_explains_gap(
    search: RefitContext, fit: RefittedModel, events: EventSet, ranked: Sequence[CandidateScore]
) -> RefitContext | None:
    """Return all hypotheses at half the time step if that explains more than half of what the best candidate promises.

    The test is one prediction at the nominal `fit` and one Gauss-Newton step from there, on the recordings to
    estimate on without their `events`; None where it explains less or cannot be predicted.
    """
    h = fit.problem.step.time_step / 2
    search.progress.begin_stage("trying half the time step", 1.0, 8.5)
    finer = search.problem.with_time_step(h)
    fine = problem_corrected_for_events(finer.problem, events)
    left = refitted_residual_at_finer_step(fine, fit.problem, fit.problem.vector(fit.values), fit.evaluation)
    if left is None:
        return None
    excess, rest = (float(r @ r) - np.count_nonzero(r) for r in (fit.evaluation.residual, left))
    if excess - rest <= max((score.predicted_chi2_decrease for score in ranked), default=excess) / 2:
        return None
    search.progress.begin_stage(f"half the time step lowers chi2 by {excess - rest:.3g}: going on at {h:g} s")
    store = None if search.store is None else _FinerStepRefitStore(search.store, h)
    return replace(search, problem=finer, store=store)


def is_barely_significant_and_unexplained(
    smoothed: SmoothedUnknownsResult | None,
    ranked: Sequence[CandidateScore],
    before: NullTestResult,
    held_out: NullTestResult,
    limits: Thresholds,
) -> bool:
    """Whether an excess counts as chance: barely significant, and explained by no unknown or candidate.

    A significant excess without shape stays a gap: understated noise looks like that.
    """
    best = bonferroni_min_p_value(ranked)
    barely = min(before.p_value, held_out.p_value) > limits.unexplained_p_factor * limits.significance_level
    has_no_place = smoothed is None or smoothed.plant_or_sensor_origin == "none"
    return barely and best >= limits.significance_level and has_no_place


def decide_verdict(
    gap: bool,
    enough: bool,
    visible: Sequence[DetectableAmplitudes],
    reason: UnknownVerdictReason,
    added: Sequence[SelectedEffect],
) -> str:
    """Return the verdict of a diagnosis; `enough` states whether there are enough samples for the unknowns."""
    if not enough or not any(entry.is_detectable for entry in visible):
        return "insufficient_data"
    if not gap:
        return "no_gap"
    if reason:
        return "unknown"
    return "confusable" if len(added[0].equivalent_effects) > 1 else "effect"


def independent_assumption_count(added: Sequence[SelectedEffect]) -> int:
    """Number of independent assumptions in effects: one for each kind, but one for each local effect."""
    return len({entry.effect.label if entry.effect.is_local else entry.effect.kind for entry in added})


def required_fraction_of_smoother_chi2_decrease(added: Sequence[SelectedEffect], limits: Thresholds) -> float:
    """Return the fraction of the chi2 explained by the smoother that the effects are required to explain.

    Each further assumption has to explain that part of what could be left.
    """
    return 1.0 - (1.0 - limits.min_explained_fraction) ** independent_assumption_count(added)


def find_unknown_verdict_reason(
    added: Sequence[SelectedEffect], total: GapClosure, limits: Thresholds, explained: float, carried: bool
) -> UnknownVerdictReason:
    """Return the code of the reason why no effect is accepted for a gap; empty if one is accepted.

    Effects have to explain `required_fraction_of_smoother_chi2_decrease` of what the smoother explains where the
    model was fitted; a single assumption passes too where the lower 95 % bound of its held-out closure reaches
    `min_explained_fraction`.
    """
    if not added:
        return "none"
    if not (total.ci_low > limits.min_gap_closed or total.is_decisive):
        return "unsure"
    elsewhere = independent_assumption_count(added) == 1 and total.ci_low >= limits.min_explained_fraction
    if explained < required_fraction_of_smoother_chi2_decrease(added, limits) and not elsewhere:
        return "little"
    return "" if carried else "stand_in"


def fraction_of_smoother_chi2_decrease(
    nominal: RefittedModel, added: Sequence[SelectedEffect], smoothed: SmoothedUnknownsResult | None
) -> float:
    """Return the effects' decrease of r'r divided by the smoother's, each less degrees of freedom; 1 if undefined."""
    if smoothed is None or not added:
        return 1.0
    last = added[-1].refitted_model
    by_effects = 2 * (nominal.cost - last.cost) - last.effect_parameter_count
    by_smoother = smoothed.chi2_before - smoothed.chi2_after - (smoothed.dof_before - smoothed.dof_after)
    return float(by_effects / by_smoother) if by_smoother > 0 else 1.0
