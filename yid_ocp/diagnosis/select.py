"""Select effects one after the other by how much of the held-out gap they close.

The closure is 1 - G_after/G_before of the held-out losses. Its interval comes from resampling blocks (Kuensch 1989,
doi:10.1214/aos/1176347265).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from yid_ocp.diagnosis.hypotheses import join_effect_labels
from yid_ocp.diagnosis.refit import HeldOutLoss, RefitContext, RefitStatistics, refit_with_each_effect
from yid_ocp.diagnosis.screening import ScreeningResult, bonferroni_corrected_min_candidate_p_value
from yid_ocp.diagnosis.thresholds import DEFAULT_THRESHOLDS, Thresholds
from yid_ocp.effects import EffectBase
from yid_ocp.errors import SolverError

_MODEL_ERROR_CHI2 = 1e3  # chi2/n above which the residual is model error, not noise
_LOSS_RTOL = 1.4e-3  # relative difference of the losses of equivalent effects' refits
_RESPONSE_RTOL = 0.05  # relative error of a model's response to an effect: links and time step are finite
_MIN_CHI2_FRACTION = _RESPONSE_RTOL**2  # of what effects explain; such an error leaves it, so less proves nothing
_MIN_ADDED_GAP_FRACTION = 4e-4  # of the whole gap, by an effect beside others: it can close a sixth of such an error
_N_BOOTSTRAP = 1000  # draws of held-out blocks for the interval of a closure


@dataclass(frozen=True)
class GapClosure:
    """Fraction of the held-out gap that a model closes, with its 95 % interval. NaN if there is no gap."""

    fraction: float
    ci_low: float
    ci_high: float
    is_decisive: bool = False  # whether the likelihood ratio favours the model decisively, however small the gap


UNDEFINED_GAP_CLOSURE = GapClosure(math.nan, math.nan, math.nan)


@dataclass(frozen=True)
class SelectedEffect:
    """An effect added by forward selection: its refitted model, cumulative closure and equivalent effects."""

    effect: EffectBase
    refitted_model: RefitStatistics  # refit with all effects up to this one
    cumulative_closure: GapClosure  # closure of the whole gap by all effects up to this one
    equivalent_effects: tuple[EffectBase, ...]  # confusable effects, starting with this one


def held_out_gap_closure(
    before: HeldOutLoss, after: HeldOutLoss, limits: Thresholds = DEFAULT_THRESHOLDS
) -> GapClosure:
    """Fraction of the held-out gap closed from `before` to `after`, with a block-bootstrap interval."""
    sure = _lr_decisive(before, after, limits)
    if before.excess_chi2_per_sample <= 0 or not np.isfinite(after.chi2_per_sample):
        return replace(UNDEFINED_GAP_CLOSURE, is_decisive=sure)
    count = len(before.block_sample_counts)
    draws = np.random.default_rng(0).integers(0, count, (_N_BOOTSTRAP, count))
    n = before.block_sample_counts[draws].sum(axis=1)
    g0 = np.maximum((before.block_chi2[draws].sum(axis=1) + before.baseline_chi2) / n - 1.0, 0.0)
    g1 = np.maximum((after.block_chi2[draws].sum(axis=1) + after.baseline_chi2) / n - 1.0, 0.0)
    ratio = 1 - g1[g0 > 0] / g0[g0 > 0]
    low, high = np.quantile(ratio, [0.025, 0.975]) if len(ratio) else (math.nan, math.nan)
    return GapClosure(1 - after.excess_chi2_per_sample / before.excess_chi2_per_sample, float(low), float(high), sure)


def _lr_decisive(before: HeldOutLoss, after: HeldOutLoss, limits: Thresholds) -> bool:
    """Whether the held-out log likelihood ratio clearly favours `after`, if both models leave only noise."""
    fall = before.total_chi2 - after.total_chi2
    return _is_noise(before, limits) and _is_noise(after, limits) and fall > 2 * limits.min_log_bayes_factor


def _is_noise(loss: HeldOutLoss, limits: Thresholds) -> bool:
    """Whether a model leaves little but noise, so that squares are log likelihoods; else they are model errors."""
    return loss.chi2_per_sample < 1 + limits.min_excess_chi2_per_dof


def held_out_improvement(before: HeldOutLoss, after: HeldOutLoss) -> tuple[float, float]:
    """Decrease of held-out chi2/n from `before` to `after`, and its standard error over blocks."""
    total = float(before.block_sample_counts.sum())
    difference = before.block_chi2 - after.block_chi2
    if not np.all(np.isfinite(difference)):
        return (-np.inf if np.isfinite(before.chi2_per_sample) else np.inf), 0.0
    count = len(difference)
    error = np.sqrt(count) * float(np.std(difference, ddof=1)) if count > 1 else np.inf
    return float(difference.sum() + before.baseline_chi2 - after.baseline_chi2) / total, float(error) / total


def bic_difference(fit: RefitStatistics, other: RefitStatistics) -> float:
    """Difference of two fits' Bayesian information criterion (BIC): `fit` minus `other`, negative if `fit` is better.

    The BIC is r'r over estimation and held-out recordings (r: whitened residual) plus log(n) per effect parameter, with
    n residuals (Schwarz 1978, doi:10.1214/aos/1176344136). Half the difference is the log odds of `other` against
    `fit`.
    """
    held = fit.held_out_loss.total_chi2 - other.held_out_loss.total_chi2
    more = fit.effect_parameter_count - other.effect_parameter_count
    return held + 2 * (fit.cost - other.cost) + more * math.log(max(fit.residual_count, 1))


def _chi2(fit: RefitStatistics) -> float:
    return fit.held_out_loss.chi2_per_sample


def _near_best_models(
    nominal: RefitStatistics, fits: Sequence[RefitStatistics], limits: Thresholds
) -> list[RefitStatistics]:
    """Models that the recordings cannot distinguish from the best one: plausible models first, each group best first.

    If the best model leaves only noise, all recordings form one likelihood, and models with odds against them are
    dropped, unless errors of the models' responses could turn these odds. Otherwise the held-out prediction error
    counts, relative to the residual; of equally good models the simplest is best.
    """
    best = min(fits, key=_chi2)
    if _is_noise(best.held_out_loss, limits):
        best = min(fits, key=lambda fit: bic_difference(fit, best))
        most = max(2 * limits.min_log_bayes_factor, _MIN_CHI2_FRACTION * bic_difference(nominal, best))
        near = [fit for fit in fits if bic_difference(fit, best) <= most]
        near.sort(key=lambda fit: bic_difference(fit, best))
    else:
        near = [fit for fit in fits if _is_predicting_as_well(fit, best)]
        near.sort(key=lambda fit: (fit.effect_parameter_count, _chi2(fit)))
    return sorted(near, key=lambda fit: not _is_plausible(fit.effects[-1], fit, limits, in_shape=True))


def _is_predicting_as_well(fit: RefitStatistics, other: RefitStatistics) -> bool:
    """Whether a loss, and the mean logarithm of its blocks, is within a standard error over blocks of the best.

    The sum alone is not enough, because a few large blocks dominate its error. If model error dominates, fewer
    parameters outweigh a larger loss as in BIC, with blocks as samples.
    """
    loss, best = fit.held_out_loss, other.held_out_loss
    (lost, error), count = held_out_improvement(loss, best), len(best.block_chi2)
    ratios = np.log(np.maximum(loss.block_chi2, 1.0) / np.maximum(best.block_chi2, 1.0))
    spread = np.std(ratios, ddof=1) / math.sqrt(count) if np.isfinite(lost) and count > 1 else math.inf
    fewer = other.effect_parameter_count - fit.effect_parameter_count if best.chi2_per_sample > _MODEL_ERROR_CHI2 else 0
    tie = max(_LOSS_RTOL, math.expm1(fewer * math.log(count) / count))
    return bool(lost <= tie * best.chi2_per_sample or (lost <= error and ratios.mean() <= spread))


def _is_plausible(effect: EffectBase, fit: RefitStatistics, limits: Thresholds, *, in_shape: bool) -> bool:
    """Whether no amplitude is clearly outside its prior range, widened by a width or a factor, nor a shape if asked."""
    room = limits.prior_range_margin_in_widths
    for name in effect.prior_ranges if in_shape else effect.amplitude_parameter_names:
        low, high = effect.prior_ranges[name]
        unsure, width = limits.min_z * fit.std.get(name, 0.0), room * (high - low)
        least = low / (1 + room) if low > 0 else low - width
        if not least - unsure <= fit.values[name] <= high + width + unsure:
            return False
    return True


def _has_plausible_sizes(fit: RefitStatistics, base: Sequence[EffectBase], limits: Thresholds) -> bool:
    """Whether all effects of a fit beyond those of `base` have plausible amplitudes."""
    known = {effect.label for effect in base}
    return all(_is_plausible(e, fit, limits, in_shape=False) for e in fit.effects if e.label not in known)


def _is_significant(effect: EffectBase, fit: RefitStatistics, limits: Thresholds) -> bool:
    """Whether the amplitudes together are at least as significant as one amplitude at `min_z` standard deviations."""
    return fit.p_values[effect.label] <= math.erfc(limits.min_z / math.sqrt(2.0))


def _is_needed(
    nominal: RefitStatistics, without: RefitStatistics, fit: RefitStatistics, effect: EffectBase, limits: Thresholds
) -> bool:
    """Whether an effect is significant, and held-out recordings are predicted clearly worse without it.

    An effect beside others must close more of the whole gap than errors in the response to these can leave.
    """
    before, after = without.held_out_loss, fit.held_out_loss
    (gained, error), gap = held_out_improvement(before, after), before.excess_chi2_per_sample
    is_open = gap > 0 and not _is_explained(without, limits)
    closes = is_open and gained > error and gained >= limits.min_gap_closed * gap
    least = (_MIN_ADDED_GAP_FRACTION if is_open else limits.min_gap_closed) if without.effects else 0.0
    is_clear = closes or _lr_decisive(before, after, limits)
    is_enough = gained >= least * nominal.held_out_loss.excess_chi2_per_sample
    return is_clear and is_enough and _is_significant(effect, fit, limits)


def _is_explained(fit: RefitStatistics, limits: Thresholds) -> bool:
    """Whether a fit has effects and leaves little but noise; without effects, even a gap that small remains one."""
    return bool(fit.effects) and _is_noise(fit.held_out_loss, limits)


def _is_too_little(nominal: RefitStatistics, screened: ScreeningResult, limits: Thresholds) -> bool:
    """Whether no candidate beside effects that leave only noise is predicted to close enough of the whole gap."""
    most = max((score.predicted_chi2_decrease for score in screened.candidate_scores), default=0.0)
    return most < limits.min_gap_closed * (2 * nominal.cost - nominal.residual_count)


# -- several effects --------------------------------------------------------------------------------------------------

_Start = tuple[tuple[EffectBase, ...], Mapping[str, float]]
"""Effects that are refitted, and their values at the start."""


def _refit_shortlist(
    screened: ScreeningResult, limits: Thresholds, base: Sequence[EffectBase] = (), places: Sequence[str] = ()
) -> list[_Start]:
    """The candidates to refit, with initial values; they include the best candidate of each gap location."""
    scores, alike = screened.candidate_scores, screened.confusability
    ranked = [score for score in scores if score.p_value < limits.significance_level]
    if not ranked:
        return []
    best = ranked[: limits.n_refit_per_round]
    names = {n for s in best for n in alike.confusable_with(s.effect.label, limits.signature_overlap)}
    extra = [s for s in ranked if s.effect.label in names and s not in best]
    extra = sorted(extra, key=lambda s: -s.predicted_chi2_decrease)[: limits.n_refit_per_round]
    surest = sorted(ranked, key=lambda s: (s.p_value, -s.lm_statistic))[: limits.n_refit_lowest_p]
    # after the first effect, only significant candidates at the gap's locations are added
    there = [[s for s in (ranked if base else scores) if s.effect.location == place][:1] for place in places]
    chosen = {s.effect.label: s for s in (*best, *extra, *surest, *(s for own in there for s in own))}
    return [((s.effect,), s.predicted_values) for s in chosen.values()]


def _from_before(search: RefitContext) -> list[RefitStatistics]:
    """Candidates refitted from the earlier run's parameters; the nominal fit supplies missing parameters."""
    try:
        screened = search.screen((), {}, "from the earlier run's parameters")
    except SolverError:
        return []
    search.progress.begin_stage("trying candidates from the earlier run's parameters")
    chosen = _refit_shortlist(screened, search.thresholds)
    return refit_with_each_effect(search, (), chosen, {}, "from the earlier run's parameters")


def _likelier(fits: Sequence[RefitStatistics]) -> list[RefitStatistics]:
    """The fit with the lowest cost for each effect, in order of first occurrence."""
    best: dict[str, RefitStatistics] = {}
    for fit in fits:
        label = fit.effects[-1].label
        best[label] = min(best.get(label, fit), fit, key=lambda entry: entry.cost)
    return list(best.values())


def select_effects(
    search: RefitContext,
    nominal: RefitStatistics,
    screened: ScreeningResult,
    locations: Sequence[str] = (),
    moved: bool = False,
) -> tuple[tuple[RefitStatistics, ...], tuple[SelectedEffect, ...]]:
    """Select effects by forward selection on the held-out gap, then try replacing and removing each effect.

    `locations` are those of the gap. If `moved` (the nominal fit has left the estimates of an earlier
    run), candidates are also tried from those estimates. Returns the fits of single effects in the first round and the
    selected effects. The fit of the chosen effect comes first (its last fit if no other effect is selected), then all
    other fits by held-out loss.
    """
    limits, alone, chosen, before = search.thresholds, screened, _Choice(nominal), nominal
    first: list[RefitStatistics] = []
    while len(chosen.fit.effects) < limits.max_effects:
        base, current = chosen.fit.effects, chosen.fit
        if base:
            beside = join_effect_labels(base)
            if search.record_skip_if_past_deadline(f"the residual gap next to {beside}"):
                break
            ahead = 3.5 if _is_explained(current, limits) else 20.0
            search.progress.begin_stage(f"scoring the residual gap next to {beside}", 1.0, ahead)
            screened = search.screen(base, current.values, f"beside {beside}")
            # a candidate can show a residual gap that the whole residual does not
            p_value = bonferroni_corrected_min_candidate_p_value(screened.candidate_scores)
            if _is_explained(current, limits) and (
                p_value >= limits.gap_significance_level or _is_too_little(nominal, screened, limits)
            ):
                break
            if len(base) == 1 and _futile(search, [nominal, current, *first], alone, screened):
                break
        shortlist = _refit_shortlist(screened, limits, base, locations)
        fits = refit_with_each_effect(search, base, shortlist, current.values)
        if (
            moved
            and not base
            and not search.record_skip_if_past_deadline("candidates from the earlier run's parameters")
        ):
            fits = _likelier([*fits, *_from_before(search)])
        if len(base) == 1:
            pairs = _pairs_to_refit(search, alone, base[0])
            fits += [
                fit
                for fit in refit_with_each_effect(search, (), pairs, nominal.values, "together")
                if _is_significant(fit.effects[0], fit, limits)
            ]
        # an effect of implausible size would correct errors of earlier effects
        fits = [fit for fit in fits if not base or _has_plausible_sizes(fit, base, limits)]
        near = _near_best_models(nominal, fits, limits) if fits else []
        first = first or [*near[:1], *sorted((fit for fit in fits if fit is not near[0]), key=_chi2)]
        better = next((fit for fit in near if _is_needed(nominal, current, fit, fit.effects[-1], limits)), None)
        if better is None:
            break
        # untried confusable candidates cannot be excluded yet
        alike = screened.confusability.confusable_with(better.effects[-1].label, limits.signature_overlap)
        untried = [own[0] for own, _ in shortlist if own[0].label in {*alike}.intersection(search.skipped)]
        before = current
        chosen = chosen.replaced(better, [fit.effects[-1] for fit in near if fit.effects[:-1] == base], untried)
        closed = held_out_gap_closure(nominal.held_out_loss, better.held_out_loss, limits).fraction
        said = "" if math.isnan(closed) else f": {100 * closed:.3g} % of the held-out gap closed"
        search.progress.begin_stage(f"explained by {join_effect_labels(better.effects)}{said}")
    chosen = _reconsidered(search, nominal, chosen, before)
    if len(chosen.fit.effects) == 1:
        # its last fit may differ from its first one
        first = [chosen.fit, *(fit for fit in first if fit.effects != chosen.fit.effects)]
    return tuple(first), _with_closures(search, nominal, chosen, first)


@dataclass(frozen=True)
class _Choice:
    """The effects in the model, refitted together, and the equivalent effects of each."""

    fit: RefitStatistics
    rivals: Mapping[str, tuple[EffectBase, ...]] = field(default_factory=dict)  # by label, itself first

    def replaced(self, fit: RefitStatistics, near: Sequence[EffectBase], untried: Sequence[EffectBase] = ()) -> _Choice:
        """The choice with other effects; the last has the rivals `near`, and effects that stay keep theirs."""
        *before, last = fit.effects
        kept = {effect.label: self.rivals.get(effect.label, (effect,)) for effect in before}
        known = {effect.label: effect for effect in (last, *near, *untried)}
        return _Choice(fit, kept | {last.label: tuple(known.values())})


def _reconsidered(search: RefitContext, nominal: RefitStatistics, chosen: _Choice, before: RefitStatistics) -> _Choice:
    """Try each effect's position again with all others present: without it, and with other effects instead."""
    is_added = chosen.fit.effects[:-1] == before.effects
    tried = {frozenset(effect.label for effect in before.effects)} if is_added else set()
    while len(chosen.fit.effects) > 1:
        labels = frozenset(effect.label for effect in chosen.fit.effects)
        own = next((effect for effect in chosen.fit.effects if labels - {effect.label} not in tried), None)
        if own is None or search.record_skip_if_past_deadline("each effect without the others' company"):
            break
        tried.add(labels - {own.label})
        chosen = _revised(search, nominal, chosen, own)
    return chosen


def _revised(search: RefitContext, nominal: RefitStatistics, chosen: _Choice, effect: EffectBase) -> _Choice:
    """The choice without one effect, or with it or another effect last, and the equivalent effects there."""
    limits, full, label = search.thresholds, chosen.fit, effect.label
    rest = tuple(other for other in full.effects if other is not effect)
    # it starts elsewhere than a refit of the same effects in an earlier round
    without = search.refit(rest, full.values, f"{join_effect_labels(full.effects)} without {label}")
    if without is None:
        return chosen
    if not _is_needed(nominal, without, full, effect, limits):
        search.progress.begin_stage(f"left {label} out again: the others do as well")
        return replace(chosen, fit=without)
    search.progress.begin_stage(f"looking for others in the place of {label}", 1.0, 12.0)
    company = f"in the place of {label}"
    screened = search.screen(rest, without.values, f"beside {join_effect_labels(rest)} {company}")
    tried = _refit_shortlist(screened, limits)[: limits.n_refit_per_round]
    tried = [pair for pair in tried if pair[0][0].label != label]
    own = replace(full, effects=(*rest, effect))
    others = refit_with_each_effect(search, rest, tried, without.values, company)
    near = _near_best_models(
        nominal, [own, *(fit for fit in others if _has_plausible_sizes(fit, rest, limits))], limits
    )
    better = next((fit for fit in near if _is_needed(nominal, without, fit, fit.effects[-1], limits)), own)
    if better is not own:
        search.progress.begin_stage(f"put {better.effects[-1].label} in the place of {label}")
    found = chosen.replaced(better, [fit.effects[-1] for fit in near])
    return replace(found, fit=full) if better is own else found


def _with_closures(
    search: RefitContext, nominal: RefitStatistics, chosen: _Choice, first: Sequence[RefitStatistics]
) -> tuple[SelectedEffect, ...]:
    """The selected effects in order, each with the fit of all effects up to it (or of all, if that fit fails)."""
    effects, found = chosen.fit.effects, []
    for i, effect in enumerate(effects, 1):
        known = next((fit for fit in (chosen.fit, *first) if fit.effects == effects[:i]), None)
        fit = known or search.refit(effects[:i], chosen.fit.values, f"{join_effect_labels(effects[:i])} again")
        closed = held_out_gap_closure(nominal.held_out_loss, (fit or chosen.fit).held_out_loss, search.thresholds)
        found.append(SelectedEffect(effect, fit or chosen.fit, closed, chosen.rivals[effect.label]))
    return tuple(found)


def _futile(
    search: RefitContext, fits: Sequence[RefitStatistics], alone: ScreeningResult, rest: ScreeningResult
) -> bool:
    """Whether no refit closes half of the gap and no pair is predicted to explain it; False with torque noise."""
    limits, (nominal, current, *tried) = search.thresholds, fits
    best = held_out_gap_closure(nominal.held_out_loss, min(tried, key=_chi2).held_out_loss)
    if nominal.has_process_noise or not best.fraction < 0.5:
        return False
    *_, pair = next(iter(search.ranked_candidate_pairs(alone)), (0.0,))
    second = max((score.predicted_chi2_decrease for score in rest.candidate_scores), default=0.0)
    promised = max(pair, 2 * (nominal.cost - current.cost) + second)
    return promised < limits.min_explained_fraction * (2 * nominal.cost - nominal.residual_count)


def _pairs_to_refit(search: RefitContext, screened: ScreeningResult, without: EffectBase) -> list[_Start]:
    """The pairs of candidates to refit: best penalised decrease first, without confusable duplicates."""
    limits = search.thresholds

    def same(one: EffectBase, other: EffectBase) -> bool:
        alike = screened.confusability.confusable_with(one.label, limits.signature_overlap)
        return one.label == other.label or other.label in alike

    chosen: list[_Start] = []
    for (a, b), values, _ in search.ranked_candidate_pairs(screened, without.label):
        if len(chosen) == limits.n_refit_pairs:
            break
        before = (pair for pair, _ in chosen)
        if not any((same(a, c) and same(b, d)) or (same(a, d) and same(b, c)) for c, d in before):
            chosen.append(((a, b), values))
    return chosen


def refit_selection_without_effect(
    search: RefitContext, nominal: RefitStatistics, kept: Sequence[SelectedEffect], entry: SelectedEffect
) -> tuple[SelectedEffect, ...]:
    """Remove one of the selected effects and refit the others. Empty if the refit fails."""
    full, rest = kept[-1].refitted_model, [other for other in kept if other is not entry]
    name = f"{join_effect_labels(full.effects)} without {entry.effect.label}"
    without = search.refit(tuple(other.effect for other in rest), full.values, name)
    if without is None:
        return ()
    rivals = {other.effect.label: other.equivalent_effects for other in rest}
    return _with_closures(search, nominal, _Choice(without, rivals), ())
