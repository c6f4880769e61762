"""Selection of the effects that predict held-out recordings best, and of those that look the same in them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from yid_ocp.diagnosis.hypotheses import join_effect_labels
from yid_ocp.diagnosis.refit import EffectsWithStart, RefitContext, RefitStatistics, refit_with_each_effect
from yid_ocp.diagnosis.screening import ScreeningResult
from yid_ocp.diagnosis.thresholds import NEED_TEST, Thresholds
from yid_ocp.effects import EffectBase
from yid_ocp.inference import null_test

_LOSS_RTOL = 1.4e-3  # relative difference of the losses of equivalent effects' refits
# of what effects explain: a model's response to them errs by 5 %, as links and time step are finite, and leaves this
_MIN_CHI2_FRACTION = 0.05**2
_LOG_ODDS_FACTOR = 2.0  # by which half a difference of BIC exceeds the log odds that simulated cases show
_LOG_ODDS_PER_DISTANCE = 5.0  # between models, where 1 is the distance at which recordings tell them apart
_MIN_FIRST_PART = 0.25  # of the gap, to be explained by the first effect; others are not looked for beside less
_MIN_FURTHER_PART = 0.4  # of the gap that other effects leave, to be explained by a further one
_SET_PROBABILITY = 0.95  # that one of a selected effect and its equivalents is right if one of those near the best is

_Rivals = dict[str, Sequence[tuple[EffectBase, float]]]
"""The effects that the recordings cannot distinguish from a chosen one, by its label, with their distances."""


@dataclass(frozen=True)
class SelectedEffect:
    """An effect chosen by forward selection, with its refit, closed fraction of the gap and equivalent effects."""

    effect: EffectBase
    refitted_model: RefitStatistics  # refit with all effects up to this one
    cumulative_closure: null_test.HeldOutGapClosure  # closure of the whole gap by all effects up to this one
    equivalent_effects: tuple[EffectBase, ...]  # confusable effects, starting with this one
    shares: Mapping[str, float]  # of the probability that one of them is a cause, by label


def total_gap_closure(entries: Sequence[SelectedEffect]) -> null_test.HeldOutGapClosure:
    """Return the fraction of the gap that all effects close together, that of the last one. Undefined without any."""
    return next((entry.cumulative_closure for entry in reversed(entries)), null_test.UNDEFINED_GAP_CLOSURE)


def _leaves_noise(fit: RefitStatistics, limits: Thresholds) -> bool:
    """Whether a fit's held-out chi2 per sample is near 1, so that its residual is mainly noise."""
    return fit.held_out_loss.chi2_per_sample < 1 + limits.min_excess_chi2_per_dof


def bic_difference(fit: RefitStatistics, other: RefitStatistics, more: int = 0) -> float:
    """Compute the BIC (Bayesian information criterion) of `fit` minus that of `other`; negative if `fit` is better.

    The BIC is the smallest r'r of a fit to estimation and held-out recordings (r: whitened residual) plus log(n) per
    effect parameter, with n residuals (Schwarz 1978, doi:10.1214/aos/1176344136). `more` parameters of `fit` count too.
    """
    held = fit.held_out_loss.updated_chi2 - other.held_out_loss.updated_chi2
    more += fit.total_effect_parameter_count - other.total_effect_parameter_count
    return held + 2 * (fit.cost - other.cost) + more * math.log(max(fit.residual_count, 1))


def decisive_bic_difference(limits: Thresholds) -> float:
    """Return the difference of BIC from which on the recordings tell two models apart."""
    return 2 * _LOG_ODDS_FACTOR * limits.min_log_bayes_factor


def relative_probability(distance: float) -> float:
    """Compute the probability of a model beside another one, whose BIC is larger by `distance` decisive differences."""
    return 1.0 / (1.0 + math.exp(-_LOG_ODDS_PER_DISTANCE * distance))


def _near_best_models(
    nominal: RefitStatistics, fits: Sequence[RefitStatistics], limits: Thresholds
) -> list[tuple[RefitStatistics, float]]:
    """Models that the recordings cannot distinguish from the best one, with their distance from it, 0 to 1.

    If the best one leaves only noise, the distance is a log odds in units of what decides. Otherwise it is the held-out
    error in standard errors, the simplest first; implausible ones count only if no plausible one explains enough.
    """
    best = min(fits, key=_chi2, default=nominal)
    if _leaves_noise(best, limits):
        ranked = sorted(fits, key=lambda fit: bic_difference(fit, nominal))
        best = next(iter(ranked), nominal)
        # errors of the models' responses leave a part of what the best one explains; a test would find a std of chi2
        samples = best.residual_count + float(best.held_out_loss.block_sample_counts.sum())
        errors = min(_MIN_CHI2_FRACTION * bic_difference(nominal, best), math.sqrt(2 * samples))
        decisive = max(decisive_bic_difference(limits), errors)
        distances = [bic_difference(fit, best) / decisive for fit in ranked]
    else:
        sized = [fit for fit in fits if fit.determines_size(fit.effects[-1], limits.min_z)]
        plausible = [fit for fit in sized if not fit.implausible_parameters(fit.effects[-1], limits)]
        most = (1 - limits.min_explained_fraction) * nominal.held_out_loss.excess_chi2_per_sample
        best_plausible = min(plausible, key=_chi2, default=nominal)
        if best_plausible.held_out_loss.excess_chi2_per_sample <= most:
            best, fits = best_plausible, plausible
        ranked = sorted(fits, key=lambda fit: (fit.total_effect_parameter_count, _chi2(fit)))
        distances = [_distance_in_prediction(fit, best) for fit in ranked]
    return [(fit, distance) for fit, distance in zip(ranked, distances, strict=True) if distance <= 1]


def _chi2(fit: RefitStatistics) -> float:
    return fit.held_out_loss.chi2_per_sample


def _distance_in_prediction(fit: RefitStatistics, other: RefitStatistics) -> float:
    """Held-out loss beyond that of the best model, and the mean logarithm of blocks' ratios, in standard errors.

    The larger of both counts, because a few large blocks dominate the error of the sum.
    """
    loss, best = fit.held_out_loss, other.held_out_loss
    lost, error = null_test.chi2_per_sample_decrease_and_std_error(loss, best)
    ratios = np.log(np.clip(loss.block_chi2, 1.0, 1e300) / np.maximum(best.block_chi2, 1.0))
    spread = float(np.std(ratios, ddof=1)) / math.sqrt(len(ratios))
    return max(lost / max(error, _LOSS_RTOL * best.chi2_per_sample), float(ratios.mean()) / max(spread, _LOSS_RTOL))


def _is_needed(without: RefitStatistics, fit: RefitStatistics, limits: Thresholds) -> bool:
    """Whether the effects that `without` lacks are significant, and held-out recordings predicted clearly better.

    Beside other effects, they must also explain a good part of what is left. Less may be errors of the others.
    """
    before, after = without.held_out_loss, fit.held_out_loss
    gained, error = null_test.chi2_per_sample_decrease_and_std_error(before, after)
    part_of_fitted = 2 * (without.cost - fit.cost) / max(without.excess_chi2, 1.0)
    part = max(part_of_fitted, gained / max(before.excess_chi2_per_sample, 1e-9))
    is_clear = gained > error and part > (_MIN_FURTHER_PART if without.effects else _MIN_FIRST_PART)
    if _leaves_noise(without, limits):
        is_clear = before.total_chi2 - after.total_chi2 > 2 * limits.min_log_bayes_factor
    # the amplitudes of an effect together are at least as significant as one amplitude at `min_z` standard deviations
    least = math.erfc(limits.min_z / math.sqrt(2.0))
    return is_clear and all(fit.p_values[effect.label] <= least for effect in _beside(without.effects, fit))


def _beside(effects: Sequence[EffectBase], fit: RefitStatistics) -> list[EffectBase]:
    """The effects of a fit that are not among some effects."""
    known = {effect.label for effect in effects}
    return [effect for effect in fit.effects if effect.label not in known]


def _plausible_beside(
    base: Sequence[EffectBase], fits: Sequence[RefitStatistics], limits: Thresholds
) -> list[RefitStatistics]:
    """Fits whose effects beside `base` are plausible; others would correct errors of the effects in `base`."""
    return [fit for fit in fits if not any(fit.implausible_parameters(effect, limits) for effect in _beside(base, fit))]


def _refit_shortlist(screened: ScreeningResult, limits: Thresholds) -> list[EffectsWithStart]:
    """Candidates to refit, with initial values: the best, and as many that are confusable with them."""
    ranked = [score for score in screened.candidate_scores if score.p_value < limits.significance_level]
    best, others = ranked[: limits.n_refit_per_round], ranked[limits.n_refit_per_round :]
    most = limits.signature_overlap
    names = {name for s in best for name in screened.candidates_confusable_with(s.effect.label, most)}
    alike = [s for s in others if s.effect.label in names][: limits.n_refit_per_round]
    return [((s.effect,), s.predicted_values) for s in (*best, *alike)]


def select_effects(
    search: RefitContext, nominal: RefitStatistics, screened: ScreeningResult, moved: bool = False, far: bool = False
) -> tuple[tuple[RefitStatistics, ...], tuple[SelectedEffect, ...], dict[str, float]]:
    """Add effects one by one to close the held-out gap, then try to replace and remove each of them.

    Candidates are also tried from the initial values if `moved` (the nominal fit has left the estimates of an earlier
    run, which are these values), or if it is `far` from them or from priors and all candidates leave a gap. Returns the
    fits of single effects in the first round, the selected effects, and by effect parameter the std of what further
    effects may contribute to it. The fit of the chosen effect comes first (its last fit if no other effect is
    selected), then all other fits by held-out loss.
    """
    limits, chosen, before, seen = search.thresholds, nominal, nominal, screened
    shortlist, later, rivals = _refit_shortlist(screened, limits), list[RefitStatistics](), _Rivals()
    fits = refit_with_each_effect(search, (), shortlist, nominal.values)
    where = "from the initial values"
    far = far and not any(_leaves_noise(fit, limits) for fit in fits)
    if (moved or far) and not search.is_skipped_past_deadline(f"candidates {where}"):
        again = _refit_shortlist(search.screen((), {}, where), limits)
        fits = sorted([*fits, *refit_with_each_effect(search, (), again, {}, where)], key=lambda fit: -fit.cost)
    single = {fit.effects[0].label: fit for fit in fits}  # of two fits the one that costs less, which is the last
    near = _near_best_models(nominal, list(single.values()), limits)
    best = next((fit.effects[0].label for fit, _ in near), "")
    while better := next((fit for fit, _ in near if _is_needed(chosen, fit, limits)), None):
        # untried candidates may be better; where only noise is left, just those that are confusable
        label, likely = better.effects[-1].label, tuple(own[0].label for own, _ in shortlist)
        if _leaves_noise(better, limits):
            likely = seen.candidates_confusable_with(label, limits.signature_overlap)
        untried = [(own[0], 0.0) for own, _ in shortlist if own[0].label in {*likely}.intersection(search.skipped)]
        tried = [(fit.effects[-1], distance) for fit, distance in near if fit.effects[:-1] == chosen.effects]
        rivals[label] = [*tried, *untried]
        before, chosen, base = chosen, better, better.effects
        beside = join_effect_labels(base)
        closed = null_test.held_out_gap_closure(nominal.held_out_loss, better.held_out_loss)
        rest = f"further effects beside {beside}"
        search.progress.begin_stage(f"the model now has {beside} ({closed.text})".removesuffix(" ()"))
        if len(base) >= limits.max_effects or _leaves_noise(better, limits) or search.is_skipped_past_deadline(rest):
            break
        search.progress.begin_stage(f"scoring {rest}", 3.0, 13.0)
        seen = search.screen(base, better.values, f"beside {beside}")
        if len(base) == 1:  # a later effect may correct the error of the discretisation
            search.check_discretisation(better, seen.largest_predicted_chi2_decrease)
        # what the effects close together with what another one promises in the linear model
        promised = 2 * (nominal.cost - better.cost) + seen.largest_predicted_chi2_decrease
        if promised < limits.min_explained_fraction * max(nominal.excess_chi2, 1.0):
            break
        fits = refit_with_each_effect(search, base, _refit_shortlist(seen, limits), better.values)
        if len(base) == 1:
            pairs = _pairs_to_refit(search, screened, base[0])
            fits += refit_with_each_effect(search, (), pairs, nominal.values, "together")
        later += [fit.statistics() for fit in fits]
        near = _near_best_models(nominal, _plausible_beside(base, fits, limits), limits)
    chosen = _reconsidered(search, nominal, chosen, before, rivals)
    known = single | {join_effect_labels(chosen.effects): chosen}  # it may differ from the first fit
    added = []
    for i, effect in enumerate(chosen.effects, 1):
        name = join_effect_labels(chosen.effects[:i])
        fit = known.get(name) or search.refit(chosen.effects[:i], chosen.values, f"{name} again") or chosen
        closed = null_test.held_out_gap_closure(nominal.held_out_loss, fit.held_out_loss)
        same, shares = _equivalents_and_shares(effect, rivals.get(effect.label, ()))
        added.append(SelectedEffect(effect, fit, closed, same, shares))
    alone = [fit for fit in known.values() if len(fit.effects) == 1]
    alone.sort(key=lambda fit: (fit is not chosen, fit.effects[0].label != best, _chi2(fit)))
    return tuple(alone), tuple(added), _model_error_std(chosen, later, limits)


def _pairs_to_refit(search: RefitContext, screened: ScreeningResult, without: EffectBase) -> list[EffectsWithStart]:
    """The pairs of candidates to refit: best penalised decrease first, without confusable duplicates."""
    chosen, known, most = list[EffectsWithStart](), set[tuple[str, ...]](), search.thresholds.signature_overlap
    for pair, values, _ in search.rank_candidate_pairs(screened, without.label):
        alike = ({own.label, *screened.candidates_confusable_with(own.label, most)} for own in pair)
        if known.isdisjoint(itertools.product(*alike)):
            chosen.append((pair, values))
            known.update(itertools.permutations(own.label for own in pair))
    return chosen[: search.thresholds.n_refit_pairs]


def _reconsidered(
    search: RefitContext, nominal: RefitStatistics, fit: RefitStatistics, before: RefitStatistics, rivals: _Rivals
) -> RefitStatistics:
    """Try each effect's position again with all others present: without it, and with other effects instead.

    The position beside the effects of `before`, the fit without the last addition, has just been tried.
    """
    tried = {frozenset[str](), frozenset(effect.label for effect in before.effects)}
    labels = frozenset(effect.label for effect in fit.effects)
    while own := next((effect for effect in fit.effects if labels - {effect.label} not in tried), None):
        if search.is_skipped_past_deadline(NEED_TEST):
            break
        tried.add(labels - {own.label})
        fit = _revised(search, nominal, fit, own, rivals)
        labels = frozenset(effect.label for effect in fit.effects)
    return fit


def _revised(
    search: RefitContext, nominal: RefitStatistics, full: RefitStatistics, effect: EffectBase, rivals: _Rivals
) -> RefitStatistics:
    """The fit without one effect of `full`, or with it or another effect last, whose `rivals` are then replaced."""
    limits, label = search.thresholds, effect.label
    rest = tuple(other for other in full.effects if other is not effect)
    # it starts elsewhere than a refit of the same effects in an earlier round
    without = search.refit(rest, full.values, f"{join_effect_labels(full.effects)} without {label}")
    if without is None:
        return full
    if not _is_needed(without, full, limits):
        search.progress.begin_stage(f"removed {label}, because the other effects explain as much without it")
        return without
    now = f"{full.held_out_loss.chi2_per_sample:.4g}"
    search.progress.begin_stage(f"trying other effects in place of {label} (held-out chi2/n with it: {now})", 3.0, 13.0)
    company = f"in place of {label}"
    screened = search.screen(rest, without.values, f"beside {join_effect_labels(rest)} {company}")
    best = _refit_shortlist(screened, limits)[: limits.n_refit_per_round]
    tried = [start for start in best if start[0][0].label != label]
    own = replace(full, effects=(*rest, effect))
    others = refit_with_each_effect(search, rest, tried, without.values, company)
    near = _near_best_models(nominal, [own, *_plausible_beside(rest, others, limits)], limits)
    better = next((fit for fit, _ in near if _is_needed(without, fit, limits)), own)
    rivals[better.effects[-1].label] = [(fit.effects[-1], distance) for fit, distance in near]
    if better is own:
        return full
    search.progress.begin_stage(f"replaced {label} by {better.effects[-1].label}")
    return better


def _equivalents_and_shares(
    effect: EffectBase, rivals: Sequence[tuple[EffectBase, float]]
) -> tuple[tuple[EffectBase, ...], dict[str, float]]:
    """An effect and its likely rivals, given with their distances, and their shares of its probability by label."""
    known = {own.label: (own, distance) for own, distance in ((effect, 0.0), *rivals)}
    effects, distances = zip(*known.values(), strict=True)
    weights = np.exp(-_LOG_ODDS_PER_DISTANCE * np.array(distances))
    shares = weights / weights.sum()
    order = np.array([0, *1 + np.argsort(-shares[1:], kind="stable")])
    kept = order[np.cumsum(shares[order]) - shares[order] < _SET_PROBABILITY]
    return tuple(effects[i] for i in kept), {effects[i].label: float(shares[i]) for i in kept}


def _model_error_std(fit: RefitStatistics, later: Sequence[RefitStatistics], limits: Thresholds) -> dict[str, float]:
    """Root mean square change of each effect parameter of a fit by one plausible effect more; empty if none can act.

    Any further effect may have a part in the gap that the fit leaves. A fit that leaves only noise has no gap.
    """
    if _leaves_noise(fit, limits):
        return {}
    # one effect more, and no other one less
    more = [o for o in later if len(_beside(fit.effects, o)) == 1 == len(o.effects) - len(fit.effects)]
    more = _plausible_beside(fit.effects, more, limits)
    names, count = [name for effect in fit.effects for name in effect.parameters.names], max(len(more), 1)
    moved = {name: [other.values[name] - fit.values[name] for other in more] for name in names}
    return {name: math.hypot(*changes) / math.sqrt(count) for name, changes in moved.items()}
