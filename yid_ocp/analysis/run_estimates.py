"""Mean of the estimates of one model over several runs, and tests for drifting parameters and outlier runs.

The mean of estimates x_i of the same n parameters with covariances C_i is x = (sum C_i^-1)^-1 sum C_i^-1 x_i. If the
parameters are constant over k runs, chi2 = sum (x_i - x)' C_i^-1 (x_i - x) has (k - 1) n degrees of freedom. If chi2 is
larger, the standard deviations of the mean are multiplied by sqrt(chi2/dof), Birge's ratio (Birge 1932, Physical Review
40:207, doi:10.1103/PhysRev.40.207).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from yid_ocp.arrays import Array
from yid_ocp.display import ReprMixin, ReprTexts, count_with_noun
from yid_ocp.inference.null_test import chi2_p_value

_MIN_CORRELATION_EIGENVALUE = 1e-12  # smaller eigenvalues result from rounding


@dataclass(frozen=True, eq=False, repr=False)
class RunEstimates(ReprMixin):
    """The estimates (n,) of n parameters from one run, with covariance (n, n). `units` holds the units by parameter."""

    run_name: str
    parameter_names: tuple[str, ...]
    values: Array  # shape (n,)
    covariance: Array  # shape (n, n)
    units: Mapping[str, str] = field(default_factory=dict)
    is_fit_adequate: bool = True  # False: the model does not explain the recordings, the covariance has its misfit
    effects: Mapping[str, Mapping[str, float]] = field(default_factory=dict)  # values by `kind@location` and name

    def _summary(self) -> ReprTexts:
        rows = [("parameter", "value", "unit")]
        known = zip(self.parameter_names, self.values, self.std, strict=True)
        rows += [(name, f"{value:.4g} ± {std:.2g}", self.units.get(name, "")) for name, value, std in known]
        count = count_with_noun(len(self.parameter_names), "parameter")
        return ReprTexts(f"{count} of the run '{self.run_name}'", rows)

    @property
    def std(self) -> Array:
        """The standard deviations of the parameters, shape (n,)."""
        return np.sqrt(np.diag(self.covariance))

    def _only(self, names: Sequence[str]) -> RunEstimates:
        at = [self.parameter_names.index(name) for name in names]
        covariance = self.covariance[np.ix_(at, at)]
        return replace(self, parameter_names=tuple(names), values=self.values[at], covariance=covariance)


@dataclass(frozen=True)
class _ParameterDriftTest:
    """Test whether a parameter is the same in all runs that have it: weighted mean, chi2 of differences from it."""

    name: str
    unit: str
    run_names: tuple[str, ...]
    values: tuple[float, ...]
    std: tuple[float, ...]
    mean: float
    mean_std: float
    chi2: float
    p_value: float
    has_drifted: bool  # p is below the requested level, Bonferroni-corrected for the number of parameters


@dataclass(frozen=True)
class _RunOutlierTest:
    """Test of one run against the weighted mean of all other runs. `chi2` is of the difference from this mean."""

    run_name: str
    chi2: float
    degrees_of_freedom: int
    p_value: float
    is_fit_adequate: bool
    is_outlier: bool  # the other runs agree with each other, but not with this run


@dataclass(frozen=True)
class DriftAndOutlierTestResults:
    """Tests of several runs for drifting parameters and outlier runs. `chi2` tests all parameters and runs at once."""

    parameter_drift_tests: tuple[_ParameterDriftTest, ...]
    run_outlier_tests: tuple[_RunOutlierTest, ...]
    chi2: float
    degrees_of_freedom: int
    p_value: float
    significance_level: float


def nearby_positive_definite_covariance(covariance: Array) -> Array:
    """Return an invertible covariance with the same standard deviations: small correlation eigenvalues are raised."""
    std = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(std, std))
    clipped = (vectors * np.maximum(values, _MIN_CORRELATION_EIGENVALUE)) @ vectors.T
    scale = std / np.sqrt(np.diag(clipped))
    return np.asarray((clipped + clipped.T) / 2 * np.outer(scale, scale))


def pool_estimates_and_chi2(runs: Sequence[RunEstimates]) -> tuple[RunEstimates, float, int]:
    """Compute the weighted mean of the estimates of several runs, and chi2 of the runs' differences from it.

    Returns the mean, chi2 and its degrees of freedom. Parameters that only some runs contain are included. If the runs
    differ by more than their standard deviations explain, the standard deviations of the mean are multiplied by Birge's
    ratio, sqrt(chi2 / degrees of freedom).
    """
    names = tuple(dict.fromkeys(name for run in runs for name in run.parameter_names))
    information, sums = np.zeros((len(names), len(names))), np.zeros(len(names))
    # scaled by the first known standard deviations, to avoid rounding errors
    first = [next(run for run in runs if name in run.parameter_names) for name in names]
    unit = np.array([run.std[run.parameter_names.index(name)] for name, run in zip(names, first, strict=True)])
    parts = []
    for run in runs:
        at = [names.index(name) for name in run.parameter_names]
        inverse = np.linalg.inv(nearby_positive_definite_covariance(run.covariance) / np.outer(unit[at], unit[at]))
        parts.append((at, inverse, run.values / unit[at]))
        information[np.ix_(at, at)] += inverse
        sums[at] += inverse @ parts[-1][2]
    mean = np.linalg.solve(information, sums)
    chi2 = float(sum((x - mean[at]) @ inverse @ (x - mean[at]) for at, inverse, x in parts))
    degrees = sum(len(run.parameter_names) for run in runs) - len(names)
    widened = max(1.0, chi2 / degrees) if degrees else 1.0
    covariance = np.asarray(np.linalg.inv(information) * widened * np.outer(unit, unit), float)
    units = {name: unit for run in runs for name, unit in run.units.items()}
    effects = {label: own for run in runs for label, own in run.effects.items()}
    label = runs[0].run_name if len(runs) == 1 else f"{len(runs)} runs"
    explains = all(run.is_fit_adequate for run in runs)
    return RunEstimates(label, names, mean * unit, covariance, units, explains, effects), chi2, degrees


def assess_drift_and_outlier_runs(runs: Sequence[RunEstimates], level: float = 0.01) -> DriftAndOutlierTestResults:
    """Test which parameters changed from run to run (in order of time), and which run is an outlier.

    A run is an outlier if it differs significantly from the mean of the others, and the others agree: their own chi2 is
    not significant, or less than half of what it is without any other run. With two runs no outlier is reported. A
    parameter is tested with its variances, a run with its covariance. `level` is divided by their number.
    """
    mean, chi2, degrees = pool_estimates_and_chi2(runs)
    drifts = tuple(_drift(name, runs, level / len(mean.parameter_names)) for name in mean.parameter_names)
    against = tuple(_against(i, runs, level / len(runs)) for i in range(len(runs)))
    return DriftAndOutlierTestResults(drifts, against, chi2, degrees, chi2_p_value(chi2, degrees), level)


def _drift(name: str, runs: Sequence[RunEstimates], level: float) -> _ParameterDriftTest:
    own = [run._only((name,)) for run in runs if name in run.parameter_names]
    mean, chi2, degrees = pool_estimates_and_chi2(own)
    p, places = chi2_p_value(chi2, degrees), tuple(run.run_name for run in own)
    values, std = tuple(float(run.values[0]) for run in own), tuple(float(run.std[0]) for run in own)
    pooled = float(mean.values[0]), float(mean.std[0])
    return _ParameterDriftTest(name, mean.units.get(name, ""), places, values, std, *pooled, chi2, p, p < level)


def _against(i: int, runs: Sequence[RunEstimates], level: float) -> _RunOutlierTest:
    """Test run `i` against the mean of all other runs. It is an outlier if the others agree without it."""
    chi2, degrees = _apart(runs[i], [run for k, run in enumerate(runs) if k != i])
    p = chi2_p_value(chi2, degrees)
    without = [pool_estimates_and_chi2([*runs[:k], *runs[k + 1 :]])[1:] for k in range(len(runs))]
    rest, free = without[i]
    agree = chi2_p_value(rest, free) >= level or rest < 0.5 * min(r for k, (r, _) in enumerate(without) if k != i)
    alone = len(runs) > 2 and p < level and agree
    return _RunOutlierTest(runs[i].run_name, chi2, degrees, p, runs[i].is_fit_adequate, alone)


def _apart(run: RunEstimates, others: Sequence[RunEstimates]) -> tuple[float, int]:
    mean, _, _ = pool_estimates_and_chi2(others)
    shared = [name for name in run.parameter_names if name in mean.parameter_names]
    if not shared:
        return 0.0, 0
    own, rest = run._only(shared), mean._only(shared)
    apart, covariance = own.values - rest.values, nearby_positive_definite_covariance(own.covariance + rest.covariance)
    std = np.sqrt(np.diag(covariance))
    unit = apart / std
    chi2 = float(unit @ np.linalg.solve(covariance / np.outer(std, std), unit))
    return chi2, len(shared)
