"""Transfer check: whether the amplitudes of an effect agree between the estimation and the held-out recordings.

Two or three effects together imitate almost anything on the recordings on which they were fitted. What is true of the
robot comes out the same wherever it is fitted; what stands in for something else has to be something else for every
motion. The recordings that are held out are fitted in turn, with the same effects, and the values are compared.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from yid_ocp.diagnosis.hypotheses import AllCandidatesProblem
from yid_ocp.diagnosis.refit import RefitContext, RefitModel, refit_with_effects
from yid_ocp.diagnosis.thresholds import DEFAULT_THRESHOLDS, Thresholds
from yid_ocp.effects import EffectBase

_DISAGREEMENT_Z = 2.0  # standard deviations beyond which two fits disagree


@dataclass(frozen=True)
class TransferCheck:
    """One parameter of an effect, estimated on the estimation recordings and again on the held-out ones."""

    effect_label: str
    parameter: str
    unit: str
    estimation_value: float  # on the recordings to estimate on
    estimation_std: float
    held_out_value: float  # on the held-out ones
    held_out_std: float
    is_consistent: bool

    @property
    def disagreement(self) -> str:
        """Both estimates, in words."""
        here = f"{self.estimation_value:.3g} ± {self.estimation_std:.2g} {self.unit} on the recordings to estimate on"
        there = f"{self.held_out_value:.3g} ± {self.held_out_std:.2g} on the held-out ones"
        return f"{self.effect_label}.{self.parameter} is {here} and {there}"


def check_transfer(search: RefitContext, fit: RefitModel) -> tuple[TransferCheck, ...]:
    """Refit the effects on the held-out recordings and compare every amplitude; empty if one recording is split.

    Nothing, too, where the model cannot be fitted there: no evidence against it.
    """
    if search.problem.is_split_in_blocks or not fit.effects:
        return ()
    search.progress.begin_stage("fitting the held-out recordings with the same effects")
    problem = search.problem.problem
    turned = replace(search.problem, problem=problem.with_episodes(problem.held_out, problem.episodes))
    if problem.has_process_noise:
        turned = turned.whitened_at(fit.values)
    name = f"{' and '.join(effect.label for effect in fit.effects)} on the held-out recordings"
    again = refit_with_effects(turned, fit.effects, _shared(turned, fit), search.store, name, search.thresholds)
    if again is None:
        return ()
    return tuple(
        entry for effect in fit.effects for entry in _compare_amplitudes(effect, fit, again, search.thresholds)
    )


def _shared(turned: AllCandidatesProblem, fit: RefitModel) -> dict[str, float]:
    """Values of what both sets of recordings have in common: parameters, and nothing of single recordings' starts."""
    names = {*turned.nominal_parameters, *(name for effect in fit.effects for name in effect.parameters.names)}
    return {name: value for name, value in fit.values.items() if name in names}


def _compare_amplitudes(
    effect: EffectBase, first: RefitModel, second: RefitModel, limits: Thresholds = DEFAULT_THRESHOLDS
) -> list[TransferCheck]:
    """Compare the amplitudes of one effect in two fits."""
    neutral, found = effect.neutral_values, []
    width = {name: high - low for name, (low, high) in effect.prior_ranges.items()}
    size = max(abs(fit.values[n] - neutral[n]) / width[n] for fit in (first, second) for n in effect.amplitude_names)
    for name in effect.amplitude_names:
        apart = abs(first.values[name] - second.values[name])
        spread = math.hypot(first.std[name], second.std[name])
        # what has no standard deviation says nothing against it
        sure = math.isfinite(spread) and apart > limits.transfer_z_max * spread
        agrees = not sure or apart <= limits.transfer_rtol * size * width[name]
        parameter = effect.parameters[name]
        own = (first.values[name], first.std[name], second.values[name], second.std[name])
        found.append(TransferCheck(effect.label, name.removeprefix(f"{effect.label}."), parameter.unit, *own, agrees))
    return found


def inflate_std_by_disagreement(fit: RefitModel, entries: Sequence[TransferCheck]) -> RefitModel:
    """Return the fit with amplitude standard deviations inflated by the disagreement between the recordings.

    What a model misses of all of a recording its residual does not show: where two fits differ by more than
    `_DISAGREEMENT_Z` standard deviations of both together, each is known to the spread of the two, the difference over
    the square root of two.
    """
    std = dict(fit.std)
    for entry in entries:
        apart = abs(entry.estimation_value - entry.held_out_value)
        if apart > _DISAGREEMENT_Z * math.hypot(entry.estimation_std, entry.held_out_std):
            name = f"{entry.effect_label}.{entry.parameter}"
            std[name] = max(std[name], apart / math.sqrt(2.0))
    return replace(fit, std=std)


def failed_transfer_checks(entries: Sequence[TransferCheck]) -> tuple[TransferCheck, ...]:
    """Return the checks whose two estimates disagree."""
    return tuple(entry for entry in entries if not entry.is_consistent)
