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

from yid_ocp.analysis.history import Estimates, positive
from yid_ocp.diagnosis.refit import Fit
from yid_ocp.errors import ConfigError, nearest
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.options import JointPrior

INFORMED = 0.05
"""Part of a prior's variance that the data take away, below which they say nothing of the parameter."""


@dataclass(frozen=True)
class Shift:
    """Change of one parameter from the baseline to the current fit.

    Attributes
    ----------
    name, unit : str
    before, before_std : float
        By the baseline.
    now, now_std : float
        By the baseline and the recordings together.
    score : float or None
        Standard deviations by which it moved; None where the recordings say nothing of it.
    p_value : float
        Of so large a move where nothing changed.
    changed : bool
        At the level of the diagnosis, counting how many parameters were looked at.
    """

    name: str
    unit: str
    before: float
    before_std: float
    now: float
    now_std: float
    score: float | None
    p_value: float
    changed: bool


@dataclass(frozen=True)
class Since:
    """The baseline runs and the shift of every parameter from them.

    Attributes
    ----------
    runs : tuple of str
        Folders or names of the earlier runs.
    explains : bool
        Whether the model explained their recordings.
    effects : tuple of str
        Labels of the effects that they had and that the model keeps.
    chi2, p_value : float
        Of the differences between several earlier runs; zero and one for one run.
    parameters : tuple of Shift
    """

    runs: tuple[str, ...]
    explains: bool
    effects: tuple[str, ...]
    chi2: float
    p_value: float
    parameters: tuple[Shift, ...]

    @property
    def changed(self) -> tuple[Shift, ...]:
        """Parameters that have changed significantly, smallest p-value first."""
        return tuple(sorted((entry for entry in self.parameters if entry.changed), key=lambda entry: entry.p_value))


def with_baseline(problem: EstimationProblem, baseline: Estimates) -> EstimationProblem:
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
    for name in baseline.names:
        if name in parameters:
            continue
        effect, at, _ = name.rpartition(".")
        what = f"the effect {effect}" if at and "@" in effect else f"the parameter '{name}'"
        raise ConfigError(
            f"the baseline has {what}, which this model does not have",
            where=baseline.run,
            allowed="a run of the same model",
            hint="add it under model.effects" if "@" in effect else nearest(name, parameters.names),
        )
    local = [name for name in baseline.names if name in problem.options.local]
    if local:
        raise ConfigError(
            f"'{local[0]}' has a value of its own in every recording, so a baseline says nothing of it",
            where=f"parameters.{local[0]}.local",
            hint="leave `local` out",
        )
    values = dict(zip(problem.system.parameters.names, map(float, problem.theta), strict=True))
    values |= dict(zip(baseline.names, map(float, baseline.values), strict=True))
    options = replace(
        problem.options,
        priors={name: std for name, std in problem.options.priors.items() if name not in baseline.names},
        joint_prior=JointPrior(baseline.names, positive(baseline.covariance)),
    )
    free = (*problem.free, *(name for name in baseline.names if name not in problem.free))
    recordings, held_out = ([e.recording for e in group] for group in (problem.episodes, problem.held_out))
    return EstimationProblem(problem.step, recordings, free, options, values, held_out)


def since(
    fit: Fit, baseline: Estimates, level: float, runs: tuple[str, ...] = (), apart: tuple[float, float] = (0.0, 1.0)
) -> Since:
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
    names = [name for name in baseline.names if name in problem.options.joint_prior.names]
    shifts = []
    prior = dict(zip(problem.options.joint_prior.names, np.diag(problem.options.joint_prior.covariance), strict=True))
    for i, name in enumerate(baseline.names):
        if name not in names:
            continue
        before, std, now = float(baseline.values[i]), float(baseline.std[i]), fit.values[name]
        # in units of noise alone a problem's variances are smaller, all by one factor
        c0 = std**2
        c = plain[name] * c0 / float(prior[name])
        counted = max(1.0, fit.std[name] ** 2 / c) if c > 0 and math.isfinite(fit.std[name]) else 1.0
        weight = 1 - c / c0
        score, p = None, 1.0
        if weight > INFORMED:
            variance = c0 * weight + (counted - 1) * c * weight
            score = (now - before) / math.sqrt(variance)
            p = float(2 * scipy.stats.norm.sf(abs(score)))
        unit = problem.system.parameters[name].unit
        shifts.append(Shift(name, unit, before, std, now, fit.std[name], score, p, p < level / max(len(names), 1)))
    assert evaluation.ok
    labels = tuple(baseline.effects)
    return Since(runs or (baseline.run,), baseline.explains, labels, *apart, tuple(shifts))


def _plain_variance(problem: EstimationProblem, fit: Fit) -> Mapping[str, float]:
    """Variance of every unknown by the stated noise and priors alone."""
    evaluation = fit.evaluation
    if evaluation.jacobian is None:
        evaluation = problem.evaluate(problem.vector(fit.values), warm=evaluation.warm)
    jacobian = problem.informing(evaluation)[1] * problem.scales
    variance = np.diag(np.linalg.pinv(jacobian.T @ jacobian, rcond=1e-14, hermitian=True)) * problem.scales**2
    return dict(zip(problem.names, map(float, variance), strict=True))
