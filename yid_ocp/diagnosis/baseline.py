"""Earlier runs: their estimates as priors, how far parameters have moved, predictions without the effects found.

Of a linear model with the prior N(m, C0), the estimate x with the covariance C moves by x - m, which has the covariance
C0 - C where nothing changed. A misfit that makes the data's noise count k times adds (k - 1) C (1 - C/C0). An effect is
understood when taking it away predicts the world without it, and adding it the world with it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.stats

from yid_ocp.analysis.estimate_history import RunEstimates, chi2_p_value, nearest_positive_definite, pool_estimates
from yid_ocp.data.recording import Recording
from yid_ocp.diagnosis.refit import REFIT_SOLVER, RefitModel
from yid_ocp.diagnosis.select import SelectedEffect
from yid_ocp.diagnosis.thresholds import Thresholds
from yid_ocp.effects import EffectBase
from yid_ocp.errors import ConfigError, SolverError, YidError, nearest_name_hint
from yid_ocp.inference.linearized_residual import residual_without_weak_priors
from yid_ocp.inference.whitening import whitened_by_sensor_noise
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.options import MultivariateGaussianPrior
from yid_ocp.problem.prediction_errors import rmse_by_channel
from yid_ocp.progress import Progress
from yid_ocp.solvers import Status

_MIN_INFORMED_FRACTION = 0.05
"""Part of a prior's variance that the data take away, below which they say nothing of the parameter."""


@dataclass(frozen=True)
class ParameterShift:
    """Change of one parameter from the baseline to the current fit."""

    name: str
    unit: str
    baseline_value: float  # by the baseline
    baseline_std: float
    current_value: float  # by the baseline and the recordings together
    current_std: float
    z_score: float | None  # standard deviations by which it moved; None where the recordings say nothing of it
    p_value: float  # of so large a move where nothing changed
    has_changed: bool  # at the level of the diagnosis, counting how many parameters were looked at


@dataclass(frozen=True)
class BaselineComparison:
    """The baseline runs and the shift of every parameter from them."""

    baseline_runs: tuple[str, ...]  # folders or names of the earlier runs
    is_baseline_explained: bool  # whether the model explained their recordings
    baseline_effects: tuple[str, ...]  # labels of the effects that they had and that the model keeps
    between_runs_chi2: float  # of the differences between several earlier runs; zero and one for one run
    between_runs_p_value: float
    parameter_shifts: tuple[ParameterShift, ...]

    @property
    def changed_parameters(self) -> tuple[ParameterShift, ...]:
        """Parameters that have changed significantly, smallest p-value first."""
        return tuple(
            sorted((entry for entry in self.parameter_shifts if entry.has_changed), key=lambda entry: entry.p_value)
        )


def with_baseline_prior(problem: EstimationProblem, baseline: RunEstimates) -> EstimationProblem:
    """Return the problem with a baseline's estimates as a joint prior and its parameters free.

    Parameters
    ----------
    problem : EstimationProblem
        Of the same model, with the effects that the earlier run had.

    Raises
    ------
    ConfigError
        Parameters or effects that the model does not have, or that differ from recording to recording here.
    """
    parameters = problem.system.parameters
    for name in baseline.parameter_names:
        if name in parameters:
            continue
        effect, at, _ = name.rpartition(".")
        what = f"the effect {effect}" if at and "@" in effect else f"the parameter '{name}'"
        raise ConfigError(
            f"the baseline has {what}, which this model does not have",
            where=baseline.run_name,
            allowed="a run of the same model",
            hint="add it under model.effects" if "@" in effect else nearest_name_hint(name, parameters.names),
        )
    local = [name for name in baseline.parameter_names if name in problem.options.local_parameters]
    if local:
        raise ConfigError(
            f"'{local[0]}' has a value of its own in every recording, so a baseline says nothing of it",
            where=f"parameters.{local[0]}.local",
            hint="leave `local` out",
        )
    values = dict(zip(problem.system.parameters.names, map(float, problem.theta), strict=True))
    values |= dict(zip(baseline.parameter_names, map(float, baseline.values), strict=True))
    options = replace(
        problem.options,
        prior_stds={
            name: std for name, std in problem.options.prior_stds.items() if name not in baseline.parameter_names
        },
        multivariate_prior=MultivariateGaussianPrior(
            baseline.parameter_names, nearest_positive_definite(baseline.covariance)
        ),
    )
    free = (*problem.free, *(name for name in baseline.parameter_names if name not in problem.free))
    recordings, held_out = ([e.recording for e in group] for group in (problem.episodes, problem.held_out))
    return EstimationProblem(problem.step, recordings, free, options, values, held_out)


def compare_with_baseline(
    fit: RefitModel,
    baseline: RunEstimates,
    level: float,
    runs: tuple[str, ...] = (),
    apart: tuple[float, float] = (0.0, 1.0),
) -> BaselineComparison:
    """Return how far the parameters of a fit have moved from its baseline prior.

    Parameters
    ----------
    level : float
        Significance, divided by the number of parameters.
    runs : tuple of str
        What the baseline was put together of.
    apart : (float, float)
        chi2 and p-value of the differences between these runs.
    """
    problem, evaluation = fit.problem, fit.evaluation
    plain = _plain_variance(problem, fit)
    names = [name for name in baseline.parameter_names if name in problem.options.multivariate_prior.parameter_names]
    shifts = []
    prior = dict(
        zip(
            problem.options.multivariate_prior.parameter_names,
            np.diag(problem.options.multivariate_prior.covariance),
            strict=True,
        )
    )
    for i, name in enumerate(baseline.parameter_names):
        if name not in names:
            continue
        before, std, now = float(baseline.values[i]), float(baseline.std[i]), fit.values[name]
        # in units of noise alone a problem's variances are smaller, all by one factor
        c0 = std**2
        c = plain[name] * c0 / float(prior[name])
        counted = max(1.0, fit.std[name] ** 2 / c) if c > 0 and math.isfinite(fit.std[name]) else 1.0
        weight = 1 - c / c0
        score, p = None, 1.0
        if weight > _MIN_INFORMED_FRACTION:
            variance = c0 * weight + (counted - 1) * c * weight
            score = (now - before) / math.sqrt(variance)
            p = float(2 * scipy.stats.norm.sf(abs(score)))
        unit = problem.system.parameters[name].unit
        shifts.append(
            ParameterShift(name, unit, before, std, now, fit.std[name], score, p, p < level / max(len(names), 1))
        )
    assert evaluation.ok
    labels = tuple(baseline.effects)
    return BaselineComparison(runs or (baseline.run_name,), baseline.is_fit_adequate, labels, *apart, tuple(shifts))


def _plain_variance(problem: EstimationProblem, fit: RefitModel) -> Mapping[str, float]:
    """Variance of every unknown by the stated noise and priors alone."""
    evaluation = fit.evaluation
    if evaluation.jacobian is None:
        evaluation = problem.evaluate(problem.vector(fit.values), equilibrium_guesses=evaluation.equilibrium_guesses)
    jacobian = residual_without_weak_priors(problem, evaluation)[1] * problem.unknown_scales
    variance = np.diag(np.linalg.pinv(jacobian.T @ jacobian, rcond=1e-14, hermitian=True)) * problem.unknown_scales**2
    return dict(zip(problem.unknown_names, map(float, variance), strict=True))


_ParameterValues = Mapping[str, float]


@dataclass(frozen=True)
class PredictionErrors:
    """Prediction errors (RMSE by channel) on recordings no fit has used, without diagnosis and counterfactual."""

    recordings: tuple[str, ...]
    # root mean square errors without a diagnosis, and with the effects removed (or added)
    rmse_without_diagnosis: Mapping[str, float]
    rmse_counterfactual: Mapping[str, float]
    channel_units: Mapping[str, str]
    failure_message: str = ""  # why there are none

    @property
    def rmse_by_unit(self) -> dict[str, tuple[float, float]]:
        """Root mean square over the channels of each unit: (without a diagnosis, counterfactual)."""
        found = {}
        for unit in dict.fromkeys(self.channel_units.values()):
            own = [channel for channel, of in self.channel_units.items() if of == unit]
            found[unit] = tuple(
                float(np.sqrt(np.mean([errors[c] ** 2 for c in own])))
                for errors in (self.rmse_without_diagnosis, self.rmse_counterfactual)
            )
        return {unit: (pair[0], pair[1]) for unit, pair in found.items()}

    @property
    def is_improved(self) -> bool:
        """Whether the counterfactual prediction has the smaller RMSE in every unit."""
        return bool(self.rmse_by_unit) and all(after < before for before, after in self.rmse_by_unit.values())


@dataclass(frozen=True)
class CounterfactualTest:
    """Prediction errors with the effects removed, and with the effects added."""

    # recordings made without the effects: by the diagnosed model with its effects taken out, against the
    # nominal model as it was fitted to the recordings with them
    effects_removed: PredictionErrors
    # recordings made with the effects: by the model of the world without them with the effects put in, against
    # that model alone
    effects_added: PredictionErrors

    def to_dict(self) -> dict[str, object]:
        """Return `predict_counterfactual` of `yid-diagnosis/2`, JSON-compatible."""
        return {name: _entry(part) for name, part in (("removed", self.effects_removed), ("added", self.effects_added))}


def predict_counterfactual(
    nominal: RefitModel,
    last: RefitModel,
    reference_recordings: Sequence[Recording],
    baseline: RunEstimates | None = None,
) -> CounterfactualTest:
    """Predict reference recordings with the effects removed, and the diagnosed recordings with them added.

    Parameters
    ----------
    nominal, last : RefitModel
        Without and with the effects.
    reference_recordings : sequence of Recording
        Made without the effects; with the same sensors.
    baseline : RunEstimates, optional
        What is known of the world without the effects; estimated on `reference_recordings` where absent.

    Returns
    -------
    CounterfactualTest
        A message stands for what cannot be predicted.
    """
    shared = nominal.problem.shared_parameters
    now = {name: last.values[name] for name in shared}
    effects = {name: last.values[name] for effect in last.effects for name in effect.parameters.names}
    held = [e.recording for e in (*last.problem.episodes, *last.problem.held_out)]
    present = list({id(recording): recording for recording in held}.values())
    removed = _predicted(last, reference_recordings, {name: nominal.values[name] for name in shared}, now)
    try:
        then = (
            _then(last, reference_recordings, shared)
            if baseline is None
            else dict(zip(baseline.parameter_names, baseline.values, strict=True))
        )
    except YidError as error:
        return CounterfactualTest(removed, _nothing(present, error.what))
    return CounterfactualTest(removed, _predicted(last, present, then, {**then, **effects}))


def _predicted(
    last: RefitModel, recordings: Sequence[Recording], plain: _ParameterValues, other: _ParameterValues
) -> PredictionErrors:
    """Errors by two models; parameters that neither names are the problem's own, and effects neutral."""
    try:
        problem = _on(last, recordings)
        first, units = _errors(problem, plain, last.effects)
        second, _ = _errors(problem, other, last.effects)
    except YidError as error:
        return _nothing(recordings, error.what)
    return PredictionErrors(tuple(recording.name for recording in recordings), first, second, units)


def _nothing(recordings: Sequence[Recording], message: str) -> PredictionErrors:
    return PredictionErrors(tuple(recording.name for recording in recordings), {}, {}, {}, message)


def _on(last: RefitModel, recordings: Sequence[Recording]) -> EstimationProblem:
    """The problem with its compiled step, all candidates in it, on other recordings: to predict and to estimate on."""
    own = last.problem
    options = replace(
        own.options,
        prior_stds={},
        local_parameters=(),
        multivariate_prior=MultivariateGaussianPrior(),
        known_initial_states={},
    )
    values = dict(zip(own.system.parameters.names, map(float, own.theta), strict=True))
    return EstimationProblem(own.step, recordings, own.shared_parameters, options, values, recordings)


def _errors(
    problem: EstimationProblem, values: _ParameterValues, effects: Sequence[EffectBase]
) -> tuple[dict[str, float], dict[str, str]]:
    neutral = {name: value for effect in effects for name, value in effect.neutral_values.items()}
    if problem.has_process_noise:
        problem = whitened_by_sensor_noise(problem)
    found = problem.predict_held_out(problem.vector({**neutral, **values}))
    failed = [result for _, result in found if isinstance(result, str)]
    if failed:
        raise SolverError(f"a recording cannot be predicted: {failed[0]}")
    errors = rmse_by_channel([r for _, r in found if not isinstance(r, str)], [episode for episode, _ in found])
    return {c: float(e["rmse"]) for c, e in errors.items()}, {c: str(e["unit"]) for c, e in errors.items()}


def _then(last: RefitModel, without: Sequence[Recording], shared: Sequence[str]) -> dict[str, float]:
    """The nominal parameters as they are estimated on the recordings without the effects."""
    problem = _on(last, without).with_free_subset(shared)
    outcome = REFIT_SOLVER.minimize_cost(problem, problem.initial_unknowns, None)
    if outcome.status == Status.FAILED:
        raise SolverError(
            f"the nominal model cannot be fitted to the recordings without the effects: {outcome.message}"
        )
    return {name: problem.named_values(outcome.x)[name] for name in shared}


def _entry(part: PredictionErrors) -> dict[str, object]:
    return {
        "recordings": list(part.recordings),
        "rmse": {
            channel: {
                "without_diagnosis": part.rmse_without_diagnosis[channel],
                "counterfactual": part.rmse_counterfactual[channel],
                "unit": unit,
            }
            for channel, unit in part.channel_units.items()
        },
        "better": part.is_improved if part.channel_units else None,
        "message": part.failure_message,
    }


@dataclass(frozen=True)
class BaselineData:
    """Combined estimates of earlier runs, and reference recordings made without the effect sought."""

    combined_estimates: RunEstimates | None  # all earlier runs together
    baseline_runs: tuple[str, ...]
    between_runs_chi2: float  # of the differences between them
    between_runs_p_value: float
    reference_recordings: tuple[Recording, ...]

    @staticmethod
    def from_runs(runs: Sequence[RunEstimates], without: tuple[Recording, ...]) -> BaselineData:
        """Combine the estimates of several runs into one baseline."""
        if not runs:
            return BaselineData(None, (), 0.0, 1.0, without)
        known, chi2, degrees = pool_estimates(runs)
        return BaselineData(known, tuple(run.run_name for run in runs), chi2, chi2_p_value(chi2, degrees), without)

    def compare_with_baseline(self, fit: RefitModel, limits: Thresholds) -> BaselineComparison | None:
        """Compare a fit with the earlier runs; None if there are none."""
        if self.combined_estimates is None:
            return None
        return compare_with_baseline(
            fit,
            self.combined_estimates,
            limits.significance_level,
            self.baseline_runs,
            (self.between_runs_chi2, self.between_runs_p_value),
        )

    def changed_parameters(self, fit: RefitModel, limits: Thresholds) -> tuple[ParameterShift, ...]:
        """Return the parameters of a fit that changed significantly since the earlier runs."""
        found = self.compare_with_baseline(fit, limits)
        return () if found is None else found.changed_parameters

    def predict_reference_recordings(
        self, nominal: RefitModel, added: Sequence[SelectedEffect], progress: Progress
    ) -> CounterfactualTest | None:
        """Predict the recordings with effects removed and added; None without effects or reference recordings."""
        if not added or not self.reference_recordings:
            return None
        progress.begin_stage("predicting the world without the effects")
        return predict_counterfactual(
            nominal, added[-1].refitted_model, self.reference_recordings, self.combined_estimates
        )


NO_BASELINE = BaselineData(None, (), 0.0, 1.0, ())
"""No earlier runs and no reference recordings."""
