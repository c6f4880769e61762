"""Null test: whether a residual is larger or less random than noise alone explains.

Under the null hypothesis the whitened residual r is noise of unit standard deviation whose colour rho is known (white,
or that of the smoothing filter). Then r'r/n has the variance 2/n (1 + 2 sum rho_l^2), which is that of a chi-squared
variable with n/(1 + 2 sum rho_l^2) degrees of freedom; a free parameter takes one of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.stats
from numpy.typing import NDArray

from yid_ocp.problem.episodes import Episode
from yid_ocp.problem.low_pass import LowPass, effort_filter
from yid_ocp.problem.measurements import Measurements
from yid_ocp.problem.problem import EstimationProblem

Array = NDArray[np.float64]

WINDOW = 0.5
"""Length of the time windows in which a residual is tested [s]."""


@dataclass(frozen=True)
class GapLimits:
    """Criteria for a residual that exceeds noise: significance level and size.

    Attributes
    ----------
    level : float
        Significance below which a residual is more than noise.
    smallest_gap : float
        chi2/n - 1 below which a significant excess is ignored.
    noise_fraction : float
        Fraction of the stated standard deviations that is noise; the rest represents model error.
    """

    level: float = 0.01
    smallest_gap: float = 0.1
    noise_fraction: float = 1.0


USUAL = GapLimits()


@dataclass(frozen=True)
class Series:
    """One scalar sensor output of one recording: its times, residual indices and noise autocorrelation.

    Attributes
    ----------
    recording, channel : str
    group : str
    unit : str
    t : ndarray, shape (M,)
        Times since the start of the recording [s].
    rows : ndarray of int, shape (M,)
        Indices in the residual.
    colour : ndarray, shape (L + 1,)
        Autocorrelation of the noise at lags 0 to L samples.
    """

    recording: str
    channel: str
    group: str
    unit: str
    t: Array
    rows: NDArray[np.int64]
    colour: Array


@dataclass(frozen=True)
class Floor:
    """Noise standard deviation that is assumed for one channel.

    Attributes
    ----------
    channel, unit : str
    std : float
        Median standard deviation of its samples, after smoothing where they are smoothed, in `unit`.
    samples : int
    """

    channel: str
    unit: str
    std: float
    samples: int


@dataclass(frozen=True)
class Window:
    """Test of one channel's residual in one time window.

    Attributes
    ----------
    recording, channel : str
    begin, end : float
        [s]
    z : float
        Excess of r'r over its expectation, in standard deviations.
    flagged : bool
        Whether it is more than chance among all windows (false-discovery rate).
    """

    recording: str
    channel: str
    begin: float
    end: float
    z: float
    flagged: bool


@dataclass(frozen=True)
class NullTest:
    """Result of the null test: chi2, p-values and whiteness of a residual.

    Attributes
    ----------
    chi2_per_dof : float
    degrees : float
        Effective, of coloured noise.
    p_value : float
        Probability of a residual this large under noise alone.
    channels : dict of channel to float
        Mean square of its whitened residual.
    whiteness : dict of channel to float
        p-value of its first autocorrelations under the noise's colour (Ljung-Box; NaN for smoothed channels).
    windows : tuple of Window
    """

    chi2_per_dof: float
    degrees: float
    p_value: float
    channels: dict[str, float]
    whiteness: dict[str, float]
    windows: tuple[Window, ...]


def noise_floor(problem: EstimationProblem) -> tuple[Floor, ...]:
    """Noise levels that the problem assumes, channel by channel."""
    found: dict[str, list[Array]] = {}
    units: dict[str, str] = {}
    for episode in problem.episodes:
        for samples in episode.samples:
            for column, channel in enumerate(samples.channel_of_column):
                found.setdefault(channel, []).append(samples.std[np.isfinite(samples.std[:, column]), column])
                units[channel] = samples.sensor.unit
    joined = {channel: np.concatenate(parts) for channel, parts in found.items()}
    return tuple(Floor(c, units[c], float(np.median(v)), len(v)) for c, v in joined.items() if len(v))


def spread(colour: Array) -> float:
    """Variance inflation 1 + 2 sum rho_l^2 of a mean square of autocorrelated noise."""
    return float(1 + 2 * np.sum(colour[1:] ** 2))


def null_test(
    series: Sequence[Series],
    residual: Array,
    parameters: int,
    level: float = USUAL.level,
    window: float = WINDOW,
) -> NullTest:
    """Test a whitened residual against the hypothesis that it is noise alone.

    Parameters
    ----------
    series : sequence of Series
    residual : ndarray, shape (nr,)
        Rows that belong to no series (priors) do not count.
    parameters : int
        Number of free parameters.
    level : float
        False-discovery rate of the windows.
    window : float
        Their length [s].
    """
    count = sum(len(s.rows) for s in series)
    effective = max(sum(len(s.rows) / spread(s.colour) for s in series) - parameters, 1.0)
    total = float(sum(np.sum(residual[s.rows] ** 2) for s in series))
    ratio = total / max(count - parameters, 1)
    p_value = float(scipy.stats.chi2.sf(ratio * effective, effective))
    channels, whiteness = {}, {}
    for channel in dict.fromkeys(s.channel for s in series):
        own = [s for s in series if s.channel == channel]
        channels[channel] = float(np.mean(np.concatenate([residual[s.rows] for s in own]) ** 2))
        whiteness[channel] = _whiteness([residual[s.rows] for s in own]) if len(own[0].colour) == 1 else float("nan")
    return NullTest(ratio, effective, p_value, channels, whiteness, _windows(series, residual, level, window))


def whitened_beside(residual: Array, spread: Array) -> Array:
    """Whiten a residual by its noise and by k further independent errors, (I + F F')^(-1/2) r.

    Parameters
    ----------
    residual : ndarray, shape (nr,)
        In units of its noise.
    spread : ndarray, shape (nr, k)
        F: change of the residual per standard deviation of each error; non-finite columns are ignored.
    """
    spread = spread[:, np.isfinite(spread).all(axis=0)]
    columns, sizes, _ = np.linalg.svd(spread, full_matrices=False)
    return np.asarray(residual + columns @ ((1 / np.hypot(1.0, sizes) - 1) * (columns.T @ residual)))


def more_than_noise(tests: Sequence[NullTest], limits: GapLimits = USUAL) -> bool:
    """Whether residuals of one model exceed noise, both significantly and by a relevant size.

    Parameters
    ----------
    tests : sequence of NullTest
        Of the recordings that were fitted, of those held out, or of both.
    limits : GapLimits
    """
    return smallest_p_value(tests) < limits.level and max(test.chi2_per_dof for test in tests) > 1 + limits.smallest_gap


def smallest_p_value(tests: Sequence[NullTest]) -> float:
    """Bonferroni-corrected smallest p-value of several tests."""
    return min(1.0, len(tests) * min(test.p_value for test in tests))


def _whiteness(parts: Sequence[Array], lags: int = 10) -> float:
    """Ljung-Box p-value, doi:10.1093/biomet/65.2.297."""
    statistic, degrees = 0.0, 0
    for r in parts:
        n = len(r)
        if n <= 3 * lags or not np.any(r):
            continue
        # whitened noise has mean zero: an offset is part of what must be noticed
        power = float(r @ r)
        for lag in range(1, lags + 1):
            rho = float(r[lag:] @ r[:-lag]) / power
            statistic += n * (n + 2) * rho**2 / (n - lag)
        degrees += lags
    return float(scipy.stats.chi2.sf(statistic, degrees)) if degrees else float("nan")


def _windows(series: Sequence[Series], residual: Array, level: float, length: float) -> tuple[Window, ...]:
    raw: list[tuple[str, str, float, float, float, float]] = []
    merged: dict[tuple[str, str], list[Series]] = {}
    for s in series:
        merged.setdefault((s.recording, s.channel), []).append(s)
    for (recording, channel), own in merged.items():
        last = max(float(s.t[-1]) for s in own)
        for k in range(int(last / length) + 1):
            begin, total, degrees, count = k * length, 0.0, 0.0, 0
            for s in own:
                inside = (s.t >= begin) & (s.t < begin + length)
                r = residual[s.rows[inside]]
                total, count = total + float(r @ r), count + len(r)
                degrees += len(r) / spread(s.colour)
            if count:
                p = float(scipy.stats.chi2.sf(total / count * degrees, degrees))
                z = (total / count - 1) * np.sqrt(degrees / 2)
                raw.append((recording, channel, begin, min(begin + length, last), float(z), p))
    flagged = discoveries([entry[5] for entry in raw], len(raw), level)
    return tuple(Window(*entry[:5], flag) for entry, flag in zip(raw, flagged, strict=True))


def discoveries(p_values: Sequence[float], tries: float, level: float) -> list[bool]:
    """Which of several p-values are significant at a false-discovery rate.

    Benjamini and Hochberg (1995), doi:10.1111/j.2517-6161.1995.tb02031.x.

    Parameters
    ----------
    p_values : sequence of float
        Reported p-values.
    tries : float
        Number of tests made, reported or not.
    level : float
        False-discovery rate.
    """
    order = np.argsort(p_values)
    passed = np.flatnonzero(np.sort(p_values) <= level * np.arange(1, len(order) + 1) / max(tries, 1.0))
    real = np.zeros(len(order), bool)
    if len(passed):
        real[order[: passed[-1] + 1]] = True
    return [bool(r) for r in real]


def sample_times(episode: Episode, samples: Measurements) -> Array:
    """Sample times since the start of the recording, shape (M,) [s]."""
    return np.asarray((samples.node + samples.fraction) * episode.grid.time_step)


def residual_series(problem: EstimationProblem) -> tuple[Series, ...]:
    """Channels of a problem's residual: one entry for each scalar output of each recording."""
    series: list[Series] = []
    for episode, groups in zip(problem.episodes, problem.rows.measurements, strict=True):
        for samples, rows in zip(episode.samples, groups, strict=True):
            t = sample_times(episode, samples)
            place = np.full(samples.seen.shape, -1)
            place[samples.seen] = np.arange(rows.start, rows.stop)
            colour = noise_colour(problem, episode, samples)
            for column, channel in enumerate(samples.channel_of_column):
                seen = samples.seen[:, column]
                if seen.any():
                    text = (episode.name, channel, samples.sensor.group, samples.sensor.unit)
                    series.append(Series(*text, t[seen], place[seen, column], colour))
    return tuple(series)


def noise_colour(problem: EstimationProblem, episode: Episode, samples: Measurements) -> Array:
    """Autocorrelation of a sensor's noise at lags 0, 1, ... samples: white, except for smoothed efforts."""
    if not samples.sensor.efforts:
        return np.ones(1)
    low_pass, step = effort_filter(problem.options.path_cutoff), episode.grid.time_step
    return smoothed_colour(low_pass, step)[:: low_pass.stride(step)]


def smoothed_colour(low_pass: LowPass, step: float) -> Array:
    """Autocorrelation of filtered white noise at lags 0, 1, ... times `step` [s]."""
    if not np.isfinite(low_pass.cutoff):
        return np.ones(1)
    half = int(2 * low_pass.passes / (low_pass.cutoff * step)) + 10
    impulse = np.zeros((2 * half + 1, 1))
    impulse[half] = 1.0
    times = step * np.arange(2 * half + 1, dtype=float)
    response = low_pass(times, impulse)[:, 0]
    full = np.correlate(response, response, "full")[2 * half :]
    return np.asarray(full[:half] / full[0])
