"""Comparison of a diagnosis with earlier runs, and predictions of reference recordings without the found effects.

In a linear model with the prior N(m, C0) from earlier runs, let x be an estimate with covariance C. If nothing changed,
the shift x - m has the covariance C0 - C. A misfit that multiplies the noise variance by k adds (k - 1) C (1 - C/C0).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.special

from yid_ocp.analysis.run_estimates import RunEstimates, nearby_positive_definite_covariance, pool_estimates_and_chi2
from yid_ocp.data.recording import Recording
from yid_ocp.diagnosis.hypotheses import REFIT_SOLVER, neutral_effect_parameter_values
from yid_ocp.diagnosis.refit import RefittedModel
from yid_ocp.diagnosis.thresholds import Thresholds
from yid_ocp.display import Progress, texts_that_hold
from yid_ocp.display import abbreviated_names_text as listed
from yid_ocp.effects import EffectBase
from yid_ocp.errors import ConfigError, SolverError, YidError, failed_rollout_error, nearest_name_question
from yid_ocp.files import attributes_to_dict
from yid_ocp.inference.linearized_residual import residual_and_jacobian_with_stated_priors
from yid_ocp.inference.null_test import chi2_p_value
from yid_ocp.inference.uncertainty import value_and_uncertainty_text
from yid_ocp.inference.whitening import problem_with_sensor_noise_only
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.options import MultivariateGaussianPrior
from yid_ocp.problem.predictions import held_out_rmse_and_unit_by_channel
from yid_ocp.solvers import Status

_SHIFT = "before=baseline_value before_std=baseline_std now=current_value now_std=current_std unit score=z_score"
_SHIFT += " changed=has_changed"
_MIN_RMSE_CHANGE = 1e-3  # relative change of an RMSE, below which it counts as equal
_FAULTY_RECORDING_ERROR_RATIO = 3  # error on a reference recording by any model, over that on the other recordings
_RUNS_DIFFER_LEVEL = 0.01  # significance below which several runs of a baseline differ
_MIN_INFORMED_FRACTION = 0.05  # relative fall of a prior's variance, below which the data do not inform a parameter


@dataclass(frozen=True)
class ParameterShift:
    """The change of a parameter since earlier runs, with a test of the hypothesis that nothing changed."""

    name: str
    unit: str
    baseline_value: float
    baseline_std: float
    current_value: float  # estimate from the recordings and, if it has a prior, the baseline
    current_std: float
    z_score: float | None  # shift in standard deviations; None if the recordings do not inform the parameter
    has_changed: bool  # significant at the diagnosis' level, Bonferroni-corrected for the parameters

    @property
    def text(self) -> str:
        """A text with both values."""
        before = value_and_uncertainty_text(self.baseline_value, self.baseline_std, least_digits=3)
        now = value_and_uncertainty_text(self.current_value, self.current_std, least_digits=3)
        return f"{self.name} from {before} to {now} {self.unit}"

    def to_dict(self) -> dict[str, Any]:
        """Convert the change to a dictionary."""
        return attributes_to_dict(self, _SHIFT)


@dataclass(frozen=True)
class ParameterShiftsSinceBaseline:
    """The change of every parameter since the earlier runs, and how well these runs agree with each other."""

    is_baseline_explained: bool  # whether the model explained the earlier runs' recordings
    between_runs_p_value: float  # p-value of the differences between earlier runs; 1 for a single run
    parameter_shifts: tuple[ParameterShift, ...]

    @property
    def significant_parameter_shifts(self) -> tuple[ParameterShift, ...]:
        """The parameters that have changed significantly, with the largest shift in standard deviations first."""
        changed = (entry for entry in self.parameter_shifts if entry.has_changed)
        return tuple(sorted(changed, key=lambda entry: -abs(entry.z_score or 0.0)))

    def to_dict(self) -> dict[str, Any]:
        """Convert the parameter changes to a dictionary, the entry `baseline` of `yid-diagnosis/2`."""
        return {"parameters": {entry.name: entry.to_dict() for entry in self.parameter_shifts}}

    def sentences(self, *, has_rivals: bool) -> list[str]:
        """Return sentences on the changes, unless larger ones explain as much as the effects: `has_rivals`."""
        moved = [own.name for own in self.significant_parameter_shifts]
        changed = f"Changed since the earlier runs by more than the ±: {listed(moved)}. If nothing was "
        changed += "altered on purpose, find the cause before you use the values."
        untested = [own.name for own in self.parameter_shifts if own.z_score is None]
        untold = f"These recordings do not show whether these changed since the earlier runs: {listed(untested)}."
        same = f"No {'other ' * bool(untested)}parameter differs significantly from the baseline (the earlier runs)."
        is_tested, p = len(untested) < len(self.parameter_shifts), self.between_runs_p_value
        differ = f"The earlier runs differ from each other by more than their ± (p = {p:.2g} < {_RUNS_DIFFER_LEVEL:g})."
        small = "The model did not explain the recordings of the baseline, so the ± of the baseline may be too small."
        return texts_that_hold(
            (moved and not has_rivals, changed),
            (untested and not has_rivals, untold),
            (is_tested and not moved and not has_rivals, same),
            (p < _RUNS_DIFFER_LEVEL, f"{differ} The ± of the baseline includes this."),
            (not self.is_baseline_explained, small),
        )


def _add_baseline_prior(problem: EstimationProblem, baseline: RunEstimates) -> EstimationProblem:
    """Free the parameters that earlier runs estimated, and use these estimates as a joint Gaussian prior."""
    names, parameters = baseline.parameter_names, problem.system.parameters
    for name in names:
        if name not in parameters:
            effect, at, _ = name.rpartition(".")
            what = f"the effect {effect}" if at and "@" in effect else f"the parameter '{name}'"
            hint = "add it under model.effects" if "@" in effect else nearest_name_question(name, parameters.names)
            what = f"the baseline has {what}, which this model lacks"
            raise ConfigError(what, where=baseline.run_name, allowed="a run of this model", hint=hint or "leave it out")
        if name in problem.options.local_parameters:
            what = f"the baseline cannot give a prior of '{name}', which has its own value in every recording"
            where = f"parameters.{name}.per_recording"
            hint = f"set {where}: false, or diagnose without a baseline (--baseline, baseline)"
            raise ConfigError(what, where=where, allowed="false, or no baseline with this parameter", hint=hint)
    values = dict(zip(parameters.names, map(float, problem.theta), strict=True))
    # a mean of runs, and rounding, can lie beyond a bound at which a run ended
    bounds = np.array([[parameters[name].lower, parameters[name].upper] for name in names]).reshape(-1, 2).T
    values |= dict(zip(names, map(float, np.clip(baseline.values, *bounds)), strict=True))
    prior = MultivariateGaussianPrior(names, nearby_positive_definite_covariance(baseline.covariance))
    stds = {name: std for name, std in problem.options.prior_stds.items() if name not in names}
    options = replace(problem.options, prior_stds=stds, multivariate_prior=prior)
    free = (*problem.free, *(name for name in names if name not in problem.free))
    recordings, held_out = ([e.recording for e in group] for group in (problem.episodes, problem.held_out))
    return EstimationProblem(problem.step, recordings, free, options, values, held_out)


@dataclass(frozen=True)
class EarlierRunsBaseline:
    """The combined estimates of earlier runs, and reference recordings made without the sought effect."""

    combined_estimates: RunEstimates | None  # all earlier runs together
    between_runs_p_value: float  # p-value of the differences between these runs; 1 for one run or none
    reference_recordings: tuple[Recording, ...]

    @staticmethod
    def from_run_estimates(runs: Sequence[RunEstimates], without: tuple[Recording, ...]) -> EarlierRunsBaseline:
        """Create a baseline from the estimates of several runs and from reference recordings `without` the effect."""
        if not runs:
            return EarlierRunsBaseline(None, 1.0, without)
        known, chi2, degrees = pool_estimates_and_chi2(runs)
        return EarlierRunsBaseline(known, chi2_p_value(chi2, degrees), without)

    def parameter_shifts_of_fit(self, fit: RefittedModel, limits: Thresholds) -> ParameterShiftsSinceBaseline | None:
        """Return the changes of the parameters of `fit` since the earlier runs, and their tests. None without runs."""
        baseline, prior = self.combined_estimates, fit.problem.options.multivariate_prior
        if baseline is None:
            return None
        plain = _plain_variance(fit)
        weighted = dict(zip(prior.parameter_names, np.diag(prior.covariance), strict=True))
        every = zip(baseline.parameter_names, baseline.values, baseline.std, strict=True)
        known_before, shifts = [entry for entry in every if entry[0] in fit.values], []
        for name, value, std in known_before:
            now, own, c0 = fit.values[name], fit.std[name], float(std) ** 2
            # without a prior both estimates are independent
            weight, variance = float(math.isfinite(own)), c0 + own**2
            if name in weighted:
                # in units of noise alone, all variances of a problem are smaller by one factor
                c = plain[name] * c0 / float(weighted[name])
                weight, counted = 1 - c / c0, max(1.0, own**2 / c) if c > 0 and math.isfinite(own) else 1.0
                variance = (c0 + (counted - 1) * c) * weight
            score, p = None, 1.0
            if weight > _MIN_INFORMED_FRACTION:
                score = (now - float(value)) / math.sqrt(variance)
                p = float(2 * scipy.special.ndtr(-abs(score)))
            known = (fit.problem.system.parameters[name].unit, float(value), float(std), now, own)
            shifts.append(ParameterShift(name, *known, score, p < limits.significance_level / len(known_before)))
        return ParameterShiftsSinceBaseline(baseline.is_fit_adequate, self.between_runs_p_value, tuple(shifts))

    def shifted_parameters_with_prior(self, fit: RefittedModel, limits: Thresholds) -> list[str]:
        """List the significantly changed parameters of `fit` that earlier runs still hold, most changed first."""
        found, held = self.parameter_shifts_of_fit(fit, limits), fit.problem.options.multivariate_prior.parameter_names
        return [entry.name for entry in found.significant_parameter_shifts if entry.name in held] if found else []

    def predict_counterfactual_errors(
        self, nominal: RefittedModel, last: RefittedModel, progress: Progress
    ) -> CounterfactualPredictionErrors | None:
        """Predict recordings made without the effects of `last`, and those with them, with and without these effects.

        Reference recordings are predicted by `last` without its effects, and the diagnosed recordings by the parameters
        of the earlier runs with these effects. Without earlier runs, these parameters are estimated on the reference
        recordings. Returns None without effects or reference recordings.
        """
        without, known = self.reference_recordings, self.combined_estimates
        if not last.effects or not without:
            return None
        progress.begin_stage("predicting recordings without the effects", 1.0, 1.5)
        shared = nominal.problem.shared_parameters
        now = {name: last.values[name] for name in shared}
        effects = {name: last.values[name] for effect in last.effects for name in effect.parameters.names}
        held = [e.recording for e in (*last.problem.episodes, *last.problem.held_out)]
        present = list({id(recording): recording for recording in held}.values())
        removed = _predicted(last, without, {name: nominal.values[name] for name in shared}, now)
        then = {} if known is None else dict(zip(known.parameter_names, known.values, strict=True))
        try:
            then = then or _estimated_without(last, without, shared)
        except YidError as error:
            why = f"no model can be fitted to the recordings without the effects: {error.what}"
            return CounterfactualPredictionErrors(removed, _nothing(present, why))
        return CounterfactualPredictionErrors(removed, _predicted(last, present, then, {**then, **effects}))


def problem_with_priors_and_baseline(
    problem: EstimationProblem, baseline: RunEstimates | Sequence[RunEstimates] | EarlierRunsBaseline
) -> tuple[EstimationProblem, EarlierRunsBaseline]:
    """Return the problem with the estimates of earlier runs as priors, unless it has such priors, and these runs."""
    if not isinstance(baseline, EarlierRunsBaseline):
        runs = (baseline,) if isinstance(baseline, RunEstimates) else baseline
        baseline = EarlierRunsBaseline.from_run_estimates(runs, ())
    known = baseline.combined_estimates
    if known is not None and not problem.options.multivariate_prior.parameter_names:
        problem = _add_baseline_prior(problem, known)
    return problem, baseline


def _plain_variance(fit: RefittedModel) -> Mapping[str, float]:
    """Return the variance of every unknown by name, from the stated noise and priors alone."""
    problem = fit.problem
    jacobian = residual_and_jacobian_with_stated_priors(problem, fit.evaluation)[1] * problem.unknown_scales
    variance = np.diag(np.linalg.pinv(jacobian.T @ jacobian, rcond=1e-14, hermitian=True)) * problem.unknown_scales**2
    return dict(zip(problem.unknown_names, map(float, variance), strict=True))


_ChannelErrors = Mapping[str, tuple[float, str]]  # root mean square error and its unit by channel


@dataclass(frozen=True)
class _PredictionErrors:
    """Prediction errors on recordings of one kind, by the model without a diagnosis and by the counterfactual model."""

    recordings: tuple[str, ...]
    without_diagnosis: _ChannelErrors
    counterfactual: _ChannelErrors  # prediction with the effects removed (or added)
    failure_message: str = ""  # why there is no prediction

    @property
    def rmse_by_unit(self) -> dict[str, tuple[float, float]]:
        """The root mean square error of all channels by unit: (without a diagnosis, counterfactual)."""

        def rms(errors: _ChannelErrors, unit: str) -> float:
            return float(np.sqrt(np.mean([e**2 for e, of in errors.values() if of == unit])))

        units = dict.fromkeys(unit for _, unit in self.without_diagnosis.values())
        return {unit: (rms(self.without_diagnosis, unit), rms(self.counterfactual, unit)) for unit in units}

    @property
    def is_improved_by_counterfactual(self) -> bool:
        """Whether the counterfactual prediction has a smaller RMSE in one unit or more, and a larger one in none."""
        ratios = [after / before for before, after in self.rmse_by_unit.values() if before > 0]
        return bool(ratios) and min(ratios) < 1 - _MIN_RMSE_CHANGE and max(ratios) <= 1 + _MIN_RMSE_CHANGE

    def to_dict(self) -> dict[str, Any]:
        """Convert the errors to a dictionary: part `removed` or `added` of `counterfactual` in result.json."""
        rmse = {
            channel: {"without_diagnosis": before, "counterfactual": self.counterfactual[channel][0], "unit": unit}
            for channel, (before, unit) in self.without_diagnosis.items()
        }
        better = self.is_improved_by_counterfactual if rmse else None
        return {"recordings": [*self.recordings], "rmse": rmse, "better": better, "message": self.failure_message}


@dataclass(frozen=True)
class CounterfactualPredictionErrors:
    """The prediction errors on reference recordings without the effects, and on diagnosed recordings with them."""

    # recordings without the effects: the diagnosed model minus its effects, against the fitted nominal model
    effects_removed: _PredictionErrors
    # recordings with the effects: the model without effects plus the effects found, against that model alone
    effects_added: _PredictionErrors

    def to_dict(self) -> dict[str, Any]:
        """Convert the prediction errors to a dictionary, the entry `counterfactual` of `yid-diagnosis/2`."""
        return {"removed": self.effects_removed.to_dict(), "added": self.effects_added.to_dict()}

    @property
    def sentences(self) -> list[str]:
        """The sentences on predictions of recordings made without the effects, and of those with them."""
        text, other = list[str](), self.effects_added.rmse_by_unit
        for how, part in (("without", self.effects_removed), ("with", self.effects_added)):
            errors, recordings = part.rmse_by_unit, (name.removesuffix(" (without)") for name in part.recordings)
            names = listed([*recordings])
            plain, then = (", ".join(f"{pair[i]:.2g} {unit}" for unit, pair in errors.items()) for i in (0, 1))
            made = f"Recordings made {how} the effects ({names})"
            failed = f"{made} could not be predicted ({part.failure_message}), so they do not test the effects."
            found = f"{made} are predicted with an error of {then} (rms) by the model {how} the effects, and of {plain}"
            found += " by the model before the diagnosis."
            # at most 1 for the recordings with the effects
            ratios = [min(errors[unit]) / max(other[unit]) for unit in errors.keys() & other]
            worse = f"over {_FAULTY_RECORDING_ERROR_RATIO} times those on the recordings with the effects"
            faulty = f"Both errors are {worse}, so {names} may be faulty. Check clock, units and setup."
            same = " and ".join(unit for unit, (before, after) in errors.items() if after > 0.999 * before)
            wrong = f"The diagnosis does not lower the error in {same} on {names}, so it may be wrong."
            text += texts_that_hold(
                (part.failure_message, failed),
                (max(ratios, default=0.0) > _FAULTY_RECORDING_ERROR_RATIO, f"{found}\n{faulty}"),
                (not part.is_improved_by_counterfactual, f"{found}\n{wrong}"),
                (True, found),
            )[:1]
        return text


def _predicted(
    last: RefittedModel, recordings: Sequence[Recording], plain: Mapping[str, float], other: Mapping[str, float]
) -> _PredictionErrors:
    """Return the errors of predictions with the parameters `plain` and `other`; effects in neither are neutral."""
    try:
        problem = _on(last, recordings)
        first, second = (_errors(problem, values, last.effects) for values in (plain, other))
    except YidError as error:
        return _nothing(recordings, error.what)
    return _PredictionErrors(tuple(recording.name for recording in recordings), first, second)


def _nothing(recordings: Sequence[Recording], message: str) -> _PredictionErrors:
    return _PredictionErrors(tuple(recording.name for recording in recordings), {}, {}, message)


def _on(last: RefittedModel, recordings: Sequence[Recording]) -> EstimationProblem:
    """Return the problem of `last` (step, candidates) with other recordings, both as estimation and held-out ones."""
    own, none = last.problem, MultivariateGaussianPrior()
    options = replace(own.options, prior_stds={}, local_parameters=(), multivariate_prior=none, known_initial_states={})
    values = dict(zip(own.system.parameters.names, map(float, own.theta), strict=True))
    return EstimationProblem(own.step, recordings, own.shared_parameters, options, values, recordings)


def _errors(problem: EstimationProblem, values: Mapping[str, float], effects: Sequence[EffectBase]) -> _ChannelErrors:
    problem = problem_with_sensor_noise_only(problem)
    found = problem.predict_held_out(problem.pack_unknowns({**neutral_effect_parameter_values(effects), **values}))
    failed = [result for _, result in found if isinstance(result, str)]
    if failed:
        raise failed_rollout_error(failed[0], "held-out recordings")
    return held_out_rmse_and_unit_by_channel(found)


def _estimated_without(last: RefittedModel, without: Sequence[Recording], shared: Sequence[str]) -> dict[str, float]:
    """Return the nominal parameters, estimated on the recordings `without` the effects."""
    problem = _on(last, without).with_free_parameters_without_recompiling(shared)
    outcome = REFIT_SOLVER.minimize_cost(problem, problem.initial_unknowns, None)
    if outcome.status == Status.FAILED:
        allowed, hint = "recordings of this setup without effects", "remove recordings of other setups from this list"
        raise SolverError(
            f"the fit failed: {outcome.message}", where="recordings.without_effect", allowed=allowed, hint=hint
        )
    return {name: problem.unknowns.named_values(outcome.x)[name] for name in shared}
