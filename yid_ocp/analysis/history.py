"""Estimates of one model from several runs: pooled mean, drift of parameters, and outlier runs.

For estimates x_i with covariances C_i of the same parameters, their mean is x = (sum C_i^-1)^-1 sum C_i^-1 x_i. Where
nothing changed, chi2 = sum (x_i - x)' C_i^-1 (x_i - x) has (k - 1) n degrees of freedom. Where it is larger, the
standard deviations of the mean are widened by sqrt(chi2/dof), Birge's ratio.

References
----------
Birge (1932), Physical Review 40:207, doi:10.1103/PhysRev.40.207.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import scipy.stats
from numpy.typing import NDArray

from yid_ocp.shown import Shown, Summary, counted

Array = NDArray[np.float64]
SMALLEST = 1e-12
"""Smallest eigenvalue of a correlation matrix; what is known better than that follows from rounding."""


@dataclass(frozen=True, eq=False, repr=False)
class Estimates(Shown):
    """Estimates of parameters from one run, with their covariance.

    Attributes
    ----------
    run : str
        Name of the run.
    names : tuple of str, length n
    values : ndarray, shape (n,)
    covariance : ndarray, shape (n, n)
    units : mapping of str to str
    explains : bool
        Whether the model explains the run's recordings; where not, the covariance includes the misfit.
    effects : mapping of label to mapping of quantity to value
        Effects that the run's model had beyond the nominal one, as `kind@location`.
    """

    run: str
    names: tuple[str, ...]
    values: Array
    covariance: Array
    units: Mapping[str, str] = field(default_factory=dict)
    explains: bool = True
    effects: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    def _summary(self) -> Summary:
        rows = [("parameter", "value", "unit")]
        known = zip(self.names, self.values, self.std, strict=True)
        rows += [(name, f"{value:.4g} ± {std:.2g}", self.units.get(name, "")) for name, value, std in known]
        return Summary(f"{counted(len(self.names), 'parameter')} of the run '{self.run}'", rows)

    @property
    def std(self) -> Array:
        """Standard deviations, shape (n,)."""
        return np.sqrt(np.diag(self.covariance))

    def of(self, names: Sequence[str]) -> Estimates:
        """The estimates of the named parameters, in that order; names that the run lacks are skipped."""
        at = [self.names.index(name) for name in names if name in self.names]
        kept = tuple(self.names[i] for i in at)
        covariance = self.covariance[np.ix_(at, at)]
        return Estimates(self.run, kept, self.values[at], covariance, self.units, self.explains, self.effects)


@dataclass(frozen=True)
class Drift:
    """Test whether one parameter has the same value in all runs.

    Attributes
    ----------
    name, unit : str
    runs : tuple of str
        That have it.
    values, std : tuple of float
    mean, mean_std : float
        Pooled over these runs.
    chi2, p_value : float
        Of the differences; p is one where only one run has it.
    drifted : bool
        Whether p is below the requested level, Bonferroni-corrected for the number of parameters.
    """

    name: str
    unit: str
    runs: tuple[str, ...]
    values: tuple[float, ...]
    std: tuple[float, ...]
    mean: float
    mean_std: float
    chi2: float
    p_value: float
    drifted: bool


@dataclass(frozen=True)
class Against:
    """Test of one run against the pooled estimates of all others.

    Attributes
    ----------
    run : str
    chi2 : float
    degrees : int
    p_value : float
    worst : str
        Parameter that differs most, in standard deviations.
    explains : bool
        Whether the model explained its recordings.
    distrusted : bool
        Whether it alone disagrees with the others, which agree without it.
    """

    run: str
    chi2: float
    degrees: int
    p_value: float
    worst: str
    explains: bool
    distrusted: bool


@dataclass(frozen=True)
class History:
    """Drift of parameters and consistency of runs over several runs of one model.

    Attributes
    ----------
    runs : tuple of str
    parameters : tuple of Drift
    against : tuple of Against
    chi2, p_value : float
        Of all differences together.
    degrees : int
    level : float
    """

    runs: tuple[str, ...]
    parameters: tuple[Drift, ...]
    against: tuple[Against, ...]
    chi2: float
    degrees: int
    p_value: float
    level: float

    @property
    def drifted(self) -> tuple[str, ...]:
        """Names of parameters that differ significantly between runs."""
        return tuple(entry.name for entry in self.parameters if entry.drifted)

    @property
    def distrusted(self) -> tuple[str, ...]:
        """Names of runs that alone disagree with the others."""
        return tuple(entry.run for entry in self.against if entry.distrusted)


def positive(covariance: Array) -> Array:
    """A nearby invertible covariance with the same standard deviations: small correlation eigenvalues are raised."""
    std = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(std, std))
    clipped = (vectors * np.maximum(values, SMALLEST)) @ vectors.T
    scale = std / np.sqrt(np.diag(clipped))
    return np.asarray((clipped + clipped.T) / 2 * np.outer(scale, scale))


def together(runs: Sequence[Estimates]) -> tuple[Estimates, float, int]:
    """Pool the estimates of several runs; returns them with chi2 of the differences and its degrees of freedom.

    Parameters
    ----------
    runs : sequence of Estimates
        Each may lack some of the parameters.

    Returns
    -------
    Estimates
        Of all parameters of any run, widened by Birge's ratio where the runs differ by more than they state.
    chi2 : float
    degrees : int
    """
    names = tuple(dict.fromkeys(name for run in runs for name in run.names))
    information, sums = np.zeros((len(names), len(names))), np.zeros(len(names))
    # in units of the first standard deviations known, so that nothing is lost to rounding
    unit = np.array([next(run.std[run.names.index(name)] for run in runs if name in run.names) for name in names])
    parts = []
    for run in runs:
        at = [names.index(name) for name in run.names]
        inverse = np.linalg.inv(positive(run.covariance) / np.outer(unit[at], unit[at]))
        parts.append((at, inverse, run.values / unit[at]))
        information[np.ix_(at, at)] += inverse
        sums[at] += inverse @ parts[-1][2]
    mean = np.linalg.solve(information, sums)
    chi2 = float(sum((x - mean[at]) @ inverse @ (x - mean[at]) for at, inverse, x in parts))
    degrees = sum(len(run.names) for run in runs) - len(names)
    widened = max(1.0, chi2 / degrees) if degrees else 1.0
    covariance = np.linalg.inv(information) * widened * np.outer(unit, unit)
    units = {name: unit for run in runs for name, unit in run.units.items()}
    effects = {label: own for run in runs for label, own in run.effects.items()}
    label = runs[0].run if len(runs) == 1 else f"{len(runs)} runs"
    explains = all(run.explains for run in runs)
    return Estimates(label, names, mean * unit, np.asarray(covariance, float), units, explains, effects), chi2, degrees


def history(runs: Sequence[Estimates], level: float = 0.01) -> History:
    """Test which parameters drifted between runs and which run is an outlier.

    Each parameter is tested by its marginal variances, each run by its whole covariance. A run is an outlier where it
    disagrees with the others and these agree without it, or better than with any other left out. With two runs none is.

    Parameters
    ----------
    runs : sequence of Estimates
        Two or more, in the order of time.
    level : float
        Significance level; divided by the number of parameters, and by that of runs.
    """
    names = tuple(dict.fromkeys(name for run in runs for name in run.names))
    _, chi2, degrees = together(runs)
    drifts = tuple(_drift(name, runs, level / max(len(names), 1)) for name in names)
    against = tuple(_against(i, runs, level / len(runs)) for i in range(len(runs)))
    return History(tuple(run.run for run in runs), drifts, against, chi2, degrees, p_value(chi2, degrees), level)


def _drift(name: str, runs: Sequence[Estimates], level: float) -> Drift:
    own = [run.of((name,)) for run in runs if name in run.names]
    mean, chi2, degrees = together(own)
    p = p_value(chi2, degrees)
    values, std = tuple(float(run.values[0]) for run in own), tuple(float(run.std[0]) for run in own)
    unit = mean.units.get(name, "")
    places = tuple(run.run for run in own)
    return Drift(name, unit, places, values, std, float(mean.values[0]), float(mean.std[0]), chi2, p, p < level)


def _against(i: int, runs: Sequence[Estimates], level: float) -> Against:
    """One run against the mean of all others; distrusted where they agree without it."""
    chi2, degrees, worst = _apart(runs[i], [run for k, run in enumerate(runs) if k != i])
    p = p_value(chi2, degrees)
    without = []
    for k in range(len(runs)):
        _, rest, free = together([run for j, run in enumerate(runs) if j != k])
        without.append((rest, free))
    rest, free = without[i]
    alone = len(runs) > 2 and p < level and p_value(rest, free) >= level
    alone = alone or (len(runs) > 2 and p < level and rest < 0.5 * min(r for k, (r, _) in enumerate(without) if k != i))
    return Against(runs[i].run, chi2, degrees, p, worst, runs[i].explains, alone)


def _apart(run: Estimates, others: Sequence[Estimates]) -> tuple[float, int, str]:
    """chi2 of the difference of a run from others, its degrees of freedom, and what differs most."""
    mean, _, _ = together(others)
    shared = [name for name in run.names if name in mean.names]
    if not shared:
        return 0.0, 0, ""
    own, rest = run.of(shared), mean.of(shared)
    apart, covariance = own.values - rest.values, positive(own.covariance + rest.covariance)
    std = np.sqrt(np.diag(covariance))
    unit = apart / std
    chi2 = float(unit @ np.linalg.solve(covariance / np.outer(std, std), unit))
    return chi2, len(shared), shared[int(np.argmax(np.abs(unit)))]


def p_value(chi2: float, degrees: int) -> float:
    """Probability of a chi2 at least this large; 1 without degrees of freedom."""
    return float(scipy.stats.chi2.sf(chi2, degrees)) if degrees else 1.0
