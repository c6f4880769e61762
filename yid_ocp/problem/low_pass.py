"""The zero-phase low-pass filter of recorded paths and efforts."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy.interpolate
import scipy.signal
from numpy.typing import NDArray

from yid_ocp.errors import DataError

Array = NDArray[np.float64]

LEAST = 1e-4  # of half the sampling rate; below it the filter's sections are singular to rounding
FILTER_ORDER = 4


@dataclass(frozen=True)
class LowPass:
    """Zero-phase low-pass filter (Butterworth of order 4, forward and backward) on an even clock.

    Attributes
    ----------
    cutoff : float
        Frequency at which the amplitude is halved in power twice over [Hz]; infinite for no filter.
    """

    cutoff: float

    def __call__(self, t: Array, values: Array) -> Array:
        """Smoothed values at the same times; an uneven clock is resampled to its median step in between.

        Parameters
        ----------
        t : ndarray, shape (M,)
        values : ndarray, shape (M, k)
        """
        if not math.isfinite(self.cutoff):
            return values
        step = float(np.median(np.diff(t)))
        even = t[0] + step * np.arange(round((t[-1] - t[0]) / step) + 1)
        sections = self._sections(step)
        resampled = scipy.interpolate.interp1d(t, values, axis=0, bounds_error=False, fill_value="extrapolate")(even)
        pad = min(len(even) - 1, max(15, int(3 / (self.cutoff * step))))
        smooth = scipy.signal.sosfiltfilt(sections, resampled, axis=0, padlen=pad)
        return np.asarray(scipy.interpolate.CubicSpline(even, smooth, axis=0)(np.clip(t, even[0], even[-1])))

    def stride(self, step: float) -> int:
        """Samples of a clock with this step [s] from one smoothed value to the next that tells something new: 1/(2 f).

        Noise that was white is limited to a band of the cutoff f and correlated over about that time.
        """
        return max(1, round(1 / (2 * self.cutoff * step))) if math.isfinite(self.cutoff) else 1

    @property
    def settling(self) -> float:
        """How far from either end of a record the filter still sees what it does not hold [s].

        The slowest pair of its poles has then decayed to a thousandth.
        """
        decay = 2 * math.pi * self.cutoff * math.sin(math.pi / (2 * FILTER_ORDER))
        return math.log(1e3) / decay

    def gains(self, step: float) -> tuple[float, float, float]:
        """Factors from white noise's std to that of the value, its rate [1/s] and its second rate [1/s^2]."""
        if not math.isfinite(self.cutoff):
            return 1.0, math.sqrt(0.5) / step, math.sqrt(6.0) / step**2
        length = 2 * int(5 / (self.cutoff * step)) + 101
        impulse = np.zeros(length)
        impulse[length // 2] = 1.0
        response = scipy.signal.sosfiltfilt(self._sections(step), impulse)
        rate = np.gradient(response, step)
        second = np.zeros_like(response)
        second[1:-1] = (response[2:] - 2 * response[1:-1] + response[:-2]) / step**2
        return float(np.linalg.norm(response)), float(np.linalg.norm(rate)), float(np.linalg.norm(second))

    def _sections(self, step: float) -> Array:
        nyquist = 0.5 / step
        least = LEAST * nyquist
        if not least < self.cutoff < nyquist:
            raise DataError(
                f"path_cutoff = {self.cutoff:g} Hz",
                allowed=f"above {least:.2g} and below {nyquist:g} Hz for this recording",
            )
        return np.asarray(scipy.signal.butter(FILTER_ORDER, self.cutoff / nyquist, output="sos"))
