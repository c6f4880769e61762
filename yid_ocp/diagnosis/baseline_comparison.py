"""Comparison with a baseline: estimates of earlier runs as priors, and how far the parameters have moved.

Of a linear model with the prior N(m, C0), the estimate x with the covariance C moves by x - m, which has the covariance
C0 - C where nothing changed. A misfit that makes the data's noise count k times adds (k - 1) C (1 - C/C0).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import scipy.stats

from yid_ocp.analysis.estimate_history import RunEstimates, nearest_positive_definite
from yid_ocp.diagnosis.refit import RefitModel
from yid_ocp.errors import ConfigError, nearest_name_hint
from yid_ocp.inference.linearized_residual import residual_without_weak_priors
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.options import MultivariateGaussianPrior

_MIN_INFORMED_FRACTION = 0.05
"""Part of a prior's variance that the data take away, below which they say nothing of the parameter."""


@dataclass(frozen=True)
class ParameterShift:
    """Change of one parameter from the baseline to the current fit.

    Attributes
    ----------
    name, unit : str
    baseline_value, baseline_std : float
        By the baseline.
    current_value, current_std : float
        By the baseline and the recordings together.
    z_score : float or None
        Standard deviations by which it moved; None where the recordings say nothing of it.
    p_value : float
        Of so large a move where nothing changed.
    has_changed : bool
        At the level of the diagnosis, counting how many parameters were looked at.
    """

    name: str
    unit: str
    baseline_value: float
    baseline_std: float
    current_value: float
    current_std: float
    z_score: float | None
    p_value: float
    has_changed: bool


@dataclass(frozen=True)
class BaselineComparison:
    """The baseline runs and the shift of every parameter from them.

    Attributes
    ----------
    baseline_runs : tuple of str
        Folders or names of the earlier runs.
    is_baseline_explained : bool
        Whether the model explained their recordings.
    baseline_effects : tuple of str
        Labels of the effects that they had and that the model keeps.
    between_runs_chi2, between_runs_p_value : float
        Of the differences between several earlier runs; zero and one for one run.
    parameter_shifts : tuple of Shift
    """

    baseline_runs: tuple[str, ...]
    is_baseline_explained: bool
    baseline_effects: tuple[str, ...]
    between_runs_chi2: float
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
    baseline : Estimates

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
    fit : Fit
    baseline : Estimates
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
