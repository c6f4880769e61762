"""Step seven: which effects are added, one after the other, by what they close of the held-out gap.

1 - G_after/G_before of the held-out losses is what was closed; its interval comes from resampling blocks (Kuensch 1989,
doi:10.1214/aos/1176347265).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from yid_ocp.diagnosis.hypotheses import join_effect_labels
from yid_ocp.diagnosis.refit import HeldOutLoss, RefitContext, RefitStatistics, refit_with_each_effect
from yid_ocp.diagnosis.screening import ScreeningResult, bonferroni_min_p_value
from yid_ocp.diagnosis.thresholds import DEFAULT_THRESHOLDS, Thresholds
from yid_ocp.effects import EffectBase
from yid_ocp.errors import SolverError
from yid_ocp.inference.uncertainty import CHI2_95_TWO_SIDED

_N_BOOTSTRAP = 1000  # draws of held-out blocks for the interval of a closure


@dataclass(frozen=True)
class GapClosure:
    """Fraction of the held-out gap that a model closes, with its 95 % interval; NaN if there is no gap."""

    fraction: float
    ci_low: float
    ci_high: float
    is_decisive: bool = False  # whether the likelihood ratio favours the model decisively, however small the gap


UNDEFINED_GAP_CLOSURE = GapClosure(math.nan, math.nan, math.nan)


@dataclass(frozen=True)
class SelectedEffect:
    """An effect added by forward selection, with its refitted model, cumulative closure and equivalent effects."""

    effect: EffectBase
    refitted_model: RefitStatistics  # with all effects up to this one
    cumulative_closure: GapClosure  # of the whole gap by all effects up to this one
    equivalent_effects: tuple[EffectBase, ...]  # effects that the data cannot tell from this one, the chosen one first


def held_out_gap_closure(
    before: HeldOutLoss, after: HeldOutLoss, limits: Thresholds = DEFAULT_THRESHOLDS
) -> GapClosure:
    """Return the fraction of the held-out gap closed from `before` to `after`, with a block-bootstrap interval."""
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
    """Whether the held-out log likelihood ratio favours `after` decisively, if both models leave only noise."""
    fall = before.total_chi2 - after.total_chi2 if _noise_is_left(limits, before, after) else 0.0
    return fall > 2 * limits.min_log_bayes_factor


def _noise_is_left(limits: Thresholds, *losses: HeldOutLoss) -> bool:
    """Whether all of some models leave little but noise."""
    return max(loss.chi2_per_sample for loss in losses) < 1 + limits.min_excess_chi2_per_dof


def held_out_improvement(before: HeldOutLoss, after: HeldOutLoss) -> tuple[float, float]:
    """Return the decrease of held-out chi2/n from `before` to `after`, and its standard error over blocks."""
    total = float(before.block_sample_counts.sum())
    difference = before.block_chi2 - after.block_chi2
    if not np.all(np.isfinite(difference)):
        return (-np.inf if np.isfinite(before.chi2_per_sample) else np.inf), 0.0
    count = len(difference)
    error = np.sqrt(count) * float(np.std(difference, ddof=1)) if count > 1 else np.inf
    return float(difference.sum() + before.baseline_chi2 - after.baseline_chi2) / total, float(error) / total


def _chi2(fit: RefitStatistics) -> float:
    return fit.held_out_loss.chi2_per_sample


def _near_best_models(
    fits: Sequence[RefitStatistics], limits: Thresholds = DEFAULT_THRESHOLDS
) -> list[RefitStatistics]:
    """Models that predict the held-out recordings as well as the best one, the simplest first."""
    best = min(fits, key=_chi2)
    likely = [fit for fit in fits if not fit.effects or _likely(fit.effects[-1], fit, limits)]
    if likely and min(map(_chi2, likely)) <= (1 + limits.implausible_shape_margin) * _chi2(best):
        fits, best = likely, min(likely, key=_chi2)
    near = []
    for fit in fits:
        close = fit is best or _is_predicting_as_well(fit.held_out_loss, best.held_out_loss, limits)
        if close or _noise_difference(fit, best, limits) <= CHI2_95_TWO_SIDED or _bic_prefers(fit, best, limits):
            near.append(fit)
    likeliest = min(near, key=lambda fit: penalized_chi2_difference(fit, best))
    near = [fit for fit in near if not _noise_difference(fit, likeliest, limits) > 2 * limits.min_log_bayes_factor]

    def order(fit: RefitStatistics) -> tuple[bool, int, float]:
        odd = any(_is_amplitude_outside_prior(effect, fit, limits) for effect in fit.effects[-1:])
        return odd, fit.effect_parameter_count, penalized_chi2_difference(fit, likeliest)

    return sorted(near, key=order)


def _is_predicting_as_well(loss: HeldOutLoss, best: HeldOutLoss, limits: Thresholds) -> bool:
    """Whether a loss is within one standard error over blocks of the best, or within `chi2_equivalence` of it.

    Where a model errs, few loud blocks make the error of a sum: then it has to hold of the mean logarithm of the
    blocks' ratios as well.
    """
    lost, error = held_out_improvement(loss, best)
    if lost <= limits.chi2_equivalence * best.chi2_per_sample:
        return True
    count = len(best.block_chi2)
    if lost > error or count < 2 or _noise_is_left(limits, loss, best):
        return lost <= error
    ratios = np.log(np.maximum(loss.block_chi2, 1.0) / np.maximum(best.block_chi2, 1.0))
    return float(ratios.mean()) <= float(np.std(ratios, ddof=1)) / math.sqrt(count)


def _noise_difference(fit: RefitStatistics, other: RefitStatistics, limits: Thresholds) -> float:
    """`penalized_chi2_difference`; NaN where either leaves more than noise, so that squares are errors of a model."""
    left = _noise_is_left(limits, fit.held_out_loss, other.held_out_loss)
    return penalized_chi2_difference(fit, other) if left else math.nan


def penalized_chi2_difference(fit: RefitStatistics, other: RefitStatistics) -> float:
    """Return r'r of `fit` minus r'r of `other`, over fitted and held-out recordings, plus a parameter penalty.

    Every parameter counts as the one by which chance alone lowers r'r.
    """
    held = fit.held_out_loss.total_chi2 - other.held_out_loss.total_chi2
    return held + 2 * (fit.cost - other.cost) + fit.effect_parameter_count - other.effect_parameter_count


def _bic_prefers(fit: RefitStatistics, best: RefitStatistics, limits: Thresholds) -> bool:
    """Whether BIC prefers `fit` with fewer parameters over `best` when model error dominates, alike within a block.

    Schwarz 1978, doi:10.1214/aos/1176344136.
    """
    blocks, fewer = len(best.held_out_loss.block_chi2), best.effect_parameter_count - fit.effect_parameter_count
    if _chi2(best) < limits.model_error_chi2 or not np.isfinite(_chi2(fit)) or fewer <= 0:
        return False
    return blocks * math.log(_chi2(fit) / _chi2(best)) <= fewer * math.log(blocks)


def _likely(effect: EffectBase, fit: RefitStatistics, limits: Thresholds) -> bool:
    return _is_significant(effect, fit, limits) and not _is_shape_outside_prior(effect, fit, limits)


def _is_shape_outside_prior(effect: EffectBase, fit: RefitStatistics, limits: Thresholds) -> bool:
    """Whether a shape exceeds its prior range by `max_shape_out_of_range_factor` or the margin in widths."""
    for name in effect.shape_parameter_names:
        low, high = effect.prior_ranges[name]
        room, factor = limits.prior_range_margin_in_widths * (high - low), limits.max_shape_out_of_range_factor
        near, far = (low / factor, high * factor) if low > 0 else (low - room, high + room)
        unsure = limits.min_z * fit.std.get(name, 0.0)
        if not near - unsure <= fit.values[name] <= far + unsure:
            return True
    return False


def _is_amplitude_outside_prior(effect: EffectBase, fit: RefitStatistics, limits: Thresholds) -> bool:
    """Whether an amplitude lies more than `prior_range_margin_in_widths` outside its prior range."""
    for name in effect.amplitude_names:
        low, high = effect.prior_ranges[name]
        room = limits.prior_range_margin_in_widths * (high - low)
        if not low - room <= fit.values[name] <= high + room:
            return True
    return False


def _is_significant(effect: EffectBase, fit: RefitStatistics, limits: Thresholds) -> bool:
    """Whether any amplitude is at least `min_z` standard deviations from neutral."""
    neutral, std = effect.neutral_values, fit.amplitude_std
    return any(abs(fit.values[n] - neutral[n]) >= limits.min_z * std.get(n, 0.0) for n in effect.amplitude_names)


def _is_rmse_reduced(before: HeldOutLoss, after: HeldOutLoss, limits: Thresholds) -> bool:
    """Whether the held-out error, of all channels or of any one, is reduced by the fraction `min_rmse_reduction`."""
    sure = _lr_decisive(before, after, limits) or not np.isfinite(before.chi2_per_sample)
    return sure or largest_relative_rmse_reduction(before, after) >= limits.min_rmse_reduction


def largest_relative_rmse_reduction(before: HeldOutLoss, after: HeldOutLoss) -> float:
    """Return the relative reduction of the held-out RMSE, of all channels or the best channel, whichever is larger."""
    channels = [name for name in before.channel_rmse if name in after.channel_rmse]
    pairs = [(np.sqrt(before.chi2_per_sample), np.sqrt(after.chi2_per_sample))]
    pairs += [(before.channel_rmse[name][0], after.channel_rmse[name][0]) for name in channels]
    return float(max(1.0 - later / earlier if earlier > 0 else 0.0 for earlier, later in pairs))


# -- several effects --------------------------------------------------------------------------------------------------

_Start = tuple[tuple[EffectBase, ...], Mapping[str, float]]
"""Effects that are refitted, and their values at the start."""


def _refit_shortlist(
    screened: ScreeningResult, limits: Thresholds, base: Sequence[EffectBase] = (), places: Sequence[str] = ()
) -> list[_Start]:
    """The candidates to refit, with their start values; the best of every place of the gap is among them."""
    scores, alike = screened.candidate_scores, screened.confusability
    ranked = [score for score in scores if score.p_value < limits.significance_level]
    if not ranked:
        return []
    best = ranked[: limits.n_refit_per_round]
    names = {n for s in best for n in alike.confusable_with(s.effect.label, limits.signature_overlap)}
    extra = [s for s in ranked if s.effect.label in names and s not in best]
    extra = sorted(extra, key=lambda s: -s.predicted_chi2_decrease)[: limits.n_refit_per_round]
    surest = sorted(ranked, key=lambda s: (s.p_value, -s.lm_statistic))[: limits.n_refit_lowest_p]
    # where the gap lay before anything was added asks for no more than the significant afterwards
    there = [[s for s in (ranked if base else scores) if s.effect.location == place][:1] for place in places]
    chosen = {s.effect.label: s for s in (*best, *extra, *surest, *(s for own in there for s in own))}
    return [((s.effect,), s.predicted_values) for s in chosen.values()]


def _from_before(search: RefitContext) -> list[RefitStatistics]:
    """Candidates refitted from the earlier run's parameters: the nominal fit's stand in for what is missing."""
    try:
        screened = search.screen((), {}, "from the earlier run's parameters")
    except SolverError:
        return []
    search.progress.begin_stage("trying candidates from the earlier run's parameters")
    chosen = _refit_shortlist(screened, search.thresholds)
    return refit_with_each_effect(search, (), chosen, {}, "from the earlier run's parameters")


def _likelier(fits: Sequence[RefitStatistics]) -> list[RefitStatistics]:
    """Of every effect the fit of least cost, in the order of their first ones."""
    best: dict[str, RefitStatistics] = {}
    for fit in fits:
        label = fit.effects[-1].label
        best[label] = min(best.get(label, fit), fit, key=lambda entry: entry.cost)
    return list(best.values())


def select_effects(
    search: RefitContext,
    nominal: RefitStatistics,
    screened: ScreeningResult,
    places: Sequence[str] = (),
    moved: bool = False,
) -> tuple[tuple[RefitStatistics, ...], tuple[SelectedEffect, ...]]:
    """Select effects by forward selection on the held-out gap, then try replacing and removing each.

    `places` are where the smoother says that the gap lies, and `moved` is whether the nominal fit has left what an
    earlier run found, so that candidates are tried from there as well. Returned are the fits of single effects in the
    first round, the chosen one first, then by held-out loss (where one stays alone, its last fit first), and what was
    selected.
    """
    limits, alone, current = search.thresholds, screened, nominal
    first: tuple[RefitStatistics, ...] = ()
    added: tuple[SelectedEffect, ...] = ()
    paired = False
    while len(added) < limits.max_effects:
        base = tuple(entry.effect for entry in added)
        if added:
            if search.note_skip_past_deadline(f"the residual gap next to {join_effect_labels(base)}"):
                break
            ahead = 3.5 if _little_is_left(current, limits) else 20.0
            search.progress.begin_stage(
                f"scoring the residual gap next to {', '.join(e.label for e in base)}", 1.0, ahead
            )
            screened = search.screen(base, current.values, f"beside {join_effect_labels(base)}")
            # a rest that the residual as a whole does not show may show along a candidate, as a gap does
            p_value = bonferroni_min_p_value(screened.candidate_scores)
            if _little_is_left(current, limits) and p_value >= limits.gap_significance_level_by_candidate:
                break
            if len(base) == 1 and _futile(search, [nominal, current, *first], alone, screened):
                break
        shortlist = _refit_shortlist(screened, limits, base, places)
        fits = refit_with_each_effect(search, base, shortlist, current.values)
        if moved and not base and not search.note_skip_past_deadline("candidates from the earlier run's parameters"):
            fits = _likelier([*fits, *_from_before(search)])
        if len(base) == 1:
            pairs = _pairs_to_refit(search, alone, base[0])
            for fit in refit_with_each_effect(search, (), pairs, nominal.values, "together"):
                one = fit.effects[0]
                if _likely(one, fit, limits) and not _is_amplitude_outside_prior(one, fit, limits):
                    fits.append(fit)
        # of an unlikely size it would mend what those before it do wrong
        fits = [fit for fit in fits if not base or not _is_amplitude_outside_prior(fit.effects[-1], fit, limits)]
        if not fits:
            break
        near = _near_best_models(fits, limits)
        first = first or (near[0], *sorted((fit for fit in fits if fit is not near[0]), key=_chi2))
        chosen = next((fit for fit in near if _worth_adding(current, fit, limits)), None)
        if chosen is None:
            break
        paired = chosen.effects[:-1] != base
        total = held_out_gap_closure(nominal.held_out_loss, chosen.held_out_loss, limits)
        both = f"put {join_effect_labels(chosen.effects)} in the place of {join_effect_labels(base)}"
        said = "" if np.isnan(total.fraction) else f": {100 * total.fraction:.3g} % of the held-out gap closed"
        search.progress.begin_stage((both if paired else f"added {chosen.effects[-1].label}") + said)
        if paired:
            pair = [SelectedEffect(effect, chosen, total, (effect,)) for effect in chosen.effects]
            added = _rebuilt(search, nominal, pair, chosen)
        else:
            beside = [fit.effects[-1] for fit in near if fit is not chosen and fit.effects[:-1] == base]
            # what looks alike and was not tried cannot be separated from it yet
            alike = screened.confusability.confusable_with(chosen.effects[-1].label, limits.signature_overlap)
            beside += [own[0] for own, _ in shortlist if own[0].label in {*alike}.intersection(search.skipped)]
            added = (*added, SelectedEffect(chosen.effects[-1], chosen, total, (chosen.effects[-1], *beside)))
        current = chosen
    kept = _reconsidered(search, nominal, added, paired)
    if len(kept) == 1:
        # it may have ended elsewhere than where it was tried first
        [own] = kept
        first = (own.refitted_model, *(fit for fit in first if fit.effects[0].label != own.effect.label))
    return first, kept


def _futile(
    search: RefitContext, fits: Sequence[RefitStatistics], alone: ScreeningResult, rest: ScreeningResult
) -> bool:
    """Whether no refit closes half of the gap and no two effects promise to explain it; never beside torque noise."""
    limits, (nominal, current, *tried) = search.thresholds, fits
    best = held_out_gap_closure(nominal.held_out_loss, min(tried, key=_chi2).held_out_loss)
    if nominal.has_process_noise or not best.fraction < 0.5:
        return False
    *_, pair = next(iter(search.ranked_pairs(alone)), (0.0,))
    second = max((score.predicted_chi2_decrease for score in rest.candidate_scores), default=0.0)
    promised = max(pair, 2 * (nominal.cost - current.cost) + second)
    return promised < limits.min_explained_fraction * (2 * nominal.cost - nominal.residual_count)


def _pairs_to_refit(search: RefitContext, screened: ScreeningResult, without: EffectBase) -> list[_Start]:
    """The pairs of candidates to refit: best penalized decrease first, without confusable duplicates."""
    limits = search.thresholds

    def same(one: EffectBase, other: EffectBase) -> bool:
        alike = screened.confusability.confusable_with(one.label, limits.signature_overlap)
        return one.label == other.label or other.label in alike

    chosen: list[_Start] = []
    for (a, b), values, _ in search.ranked_pairs(screened, without.label):
        if len(chosen) == limits.n_refit_pairs:
            break
        before = (pair for pair, _ in chosen)
        if not any((same(a, c) and same(b, d)) or (same(a, d) and same(b, c)) for c, d in before):
            chosen.append(((a, b), values))
    return chosen


def _little_is_left(fit: RefitStatistics, limits: Thresholds) -> bool:
    """Whether the effects of a fit leave little but noise; a gap that is as little is one without any."""
    return bool(fit.effects) and _noise_is_left(limits, fit.held_out_loss)


def _worth_adding(current: RefitStatistics, chosen: RefitStatistics, limits: Thresholds) -> bool:
    """Whether the last effect of a fit closes a significant and relevant part of the gap, and is significant itself."""
    before, after = current.held_out_loss, chosen.held_out_loss
    gained, error = held_out_improvement(before, after)
    part = gained >= limits.min_gap_closed * before.excess_chi2_per_sample and before.excess_chi2_per_sample > 0
    closes = not _little_is_left(current, limits) and gained > error and part
    return (closes or _lr_decisive(before, after, limits)) and _is_there(current, chosen, chosen.effects[-1], limits)


def _is_there(without: RefitStatistics, full: RefitStatistics, effect: EffectBase, limits: Thresholds) -> bool:
    """Whether an effect is significant and removes a relevant part of the held-out error."""
    reduced = _is_rmse_reduced(without.held_out_loss, full.held_out_loss, limits)
    return reduced and _is_significant(effect, full, limits)


def _reconsidered(
    search: RefitContext, nominal: RefitStatistics, added: Sequence[SelectedEffect], paired: bool
) -> tuple[SelectedEffect, ...]:
    """Effects after testing each with the others: without it, and with others instead of it."""
    kept = tuple(added)
    seen = {_labels(kept)}
    tried = set() if paired else {_labels(kept[:-1])}
    while len(kept) > 1:
        others = [_labels(kept) - {entry.effect.label} for entry in kept]
        position = next((i for i, own in enumerate(others) if own not in tried), None)
        if position is None or search.note_skip_past_deadline("each effect without the others' company"):
            break
        tried.add(others[position])
        revised = _revised(search, nominal, kept, kept[position])
        if _labels(revised) == _labels(kept) or _labels(revised) not in seen:
            kept = revised
            seen.add(_labels(kept))
    return kept


def _labels(added: Sequence[SelectedEffect]) -> frozenset[str]:
    return frozenset(entry.effect.label for entry in added)


def _revised(
    search: RefitContext, nominal: RefitStatistics, kept: tuple[SelectedEffect, ...], entry: SelectedEffect
) -> tuple[SelectedEffect, ...]:
    """The effects without one of them, with another in its place, or as they are with what would do as well."""
    limits, full, label = search.thresholds, kept[-1].refitted_model, entry.effect.label
    rest = [other.effect for other in kept if other is not entry]
    # it begins elsewhere than a refit of the same effects in an earlier round
    without = _again(search, rest, full, f"{join_effect_labels(full.effects)} without {label}")
    if without is None:
        return kept
    if not _needed(without, full, entry.effect, limits):
        search.progress.begin_stage(f"left {label} out again: the others do as well")
        return _rebuilt(search, nominal, [other for other in kept if other is not entry], without)
    search.progress.begin_stage(f"looking for others in the place of {label}", 1.0, 12.0)
    company = f"in the place of {label}"
    screened = search.screen(rest, without.values, f"beside {join_effect_labels(rest)} {company}")
    tried = _refit_shortlist(screened, limits)[: limits.n_refit_per_round]
    own = replace(full, effects=(*rest, entry.effect))
    tried = [pair for pair in tried if pair[0][0].label != label]
    others = refit_with_each_effect(search, rest, tried, without.values, company)
    if not _is_amplitude_outside_prior(entry.effect, own, limits):
        others = [fit for fit in others if not _is_amplitude_outside_prior(fit.effects[-1], fit, limits)]
    near = _near_best_models([own, *others], limits)
    chosen = next((fit for fit in near if _needed(without, fit, fit.effects[-1], limits)), own)
    rivals = (chosen.effects[-1], *(fit.effects[-1] for fit in near if fit is not chosen))
    placed = [replace(e, effect=chosen.effects[-1], equivalent_effects=rivals) if e is entry else e for e in kept]
    if chosen is own:
        return tuple(placed)
    search.progress.begin_stage(f"put {chosen.effects[-1].label} in the place of {label}")
    return _rebuilt(search, nominal, placed, replace(chosen, effects=tuple(e.effect for e in placed)))


def _needed(without: RefitStatistics, full: RefitStatistics, effect: EffectBase, limits: Thresholds) -> bool:
    """Whether held-out recordings are predicted significantly worse without an effect that is significant."""
    gained, error = held_out_improvement(without.held_out_loss, full.held_out_loss)
    sure = gained > error or _lr_decisive(without.held_out_loss, full.held_out_loss, limits)
    return sure and _is_there(without, full, effect, limits)


def _rebuilt(
    search: RefitContext, nominal: RefitStatistics, entries: Sequence[SelectedEffect], last: RefitStatistics
) -> tuple[SelectedEffect, ...]:
    """Effects in their order, each with the fit of all up to it, or of all where that cannot be made."""
    effects = [entry.effect for entry in entries]
    parts = [effects[:i] for i in range(1, len(effects))]
    fits = [_again(search, part, last, f"{join_effect_labels(part)} again") or last for part in parts]
    found = []
    for entry, fit in zip(entries, [*fits, last], strict=True):
        closure = held_out_gap_closure(nominal.held_out_loss, fit.held_out_loss, search.thresholds)
        found.append(replace(entry, refitted_model=fit, cumulative_closure=closure))
    return tuple(found)


def selection_without(
    search: RefitContext, nominal: RefitStatistics, kept: Sequence[SelectedEffect], entry: SelectedEffect
) -> tuple[SelectedEffect, ...]:
    """Return the selected effects without one of them, the others refitted; empty if they cannot be."""
    full, rest = kept[-1].refitted_model, [other for other in kept if other is not entry]
    name = f"{join_effect_labels(full.effects)} without {entry.effect.label}"
    without = _again(search, [other.effect for other in rest], full, name)
    return () if without is None else _rebuilt(search, nominal, rest, without)


def _again(
    search: RefitContext, effects: Sequence[EffectBase], near: RefitStatistics, name: str
) -> RefitStatistics | None:
    """A refit that begins where another one ended."""
    return search.refit(effects, near.values, name)
