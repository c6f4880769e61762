"""Check of the model's tube lengths and radii against the clouds of many frames.

Every frame has a least cost about the sizes x (logarithms of lengths and radii, relative to the model's), the bends
following: g_f'x + x'S_f x/2 (`DimensionEquations`). Together, with a wide prior P,

    x = -(S + P)^-1 g,    cov x = (S + P)^-1 + (S + P)^-1 (sum_f r_f r_f') (S + P)^-1 + diag(b^2),    r_f = g_f + S_f x

found by Gauss and Newton's method, the frames fitted anew at every x. The second term is the scatter between frames,
however alike the errors within one are. b is what all frames share: an end is seen no better than a point is and stands
where the camera's pose has it; noise along the sight makes a tube thinner or thicker by as much as its square over the
radius.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from yid_ocp.model.system import System
from yid_ocp.vision.shape_fit_result import FrameShapeFit

Array = NDArray[np.float64]
DimensionKind = Literal["length", "radius"]
_DIMENSION_KINDS: tuple[DimensionKind, ...] = ("length", "radius")

_PRIOR = (0.2, 0.4)  # standard deviations of the logarithms of lengths and radii
_SIGMAS = 3.0  # from the model's value, beyond which that is doubted
_CLEAR = 2.0  # from there, within which a first look finds nothing to doubt
_KNOWN = 0.1  # standard deviation of a logarithm, above which nothing can be said of a size
_ROUNDS, _SETTLED, _LONGEST_STEP = 8, 0.004, 0.15
_LEAST_FRAMES = 3
_APART = 3.0  # robust standard deviations from the other frames' ends, at which a frame's end is a wrong one
_TO_SIGMA = 1.4826


@dataclass(frozen=True, eq=False)
class DimensionCheck:
    """Tube lengths and radii estimated from the frames, compared with the model.

    Attributes
    ----------
    names : tuple of str
        `T1.length` and so on: lengths of all segments, then their radii.
    model_values : ndarray, shape (2 s,)
        The model's values [m].
    log_ratio : ndarray, shape (2 s,)
        Logarithm of the value that fits over the model's.
    covariance : ndarray, shape (2 s, 2 s)
        Of `log_ratio`.
    is_estimated : tuple of bool
        Which of them the fit uses in place of the model's.
    n_frames : int
        That were asked; 0 where nothing could be said.
    """

    names: tuple[str, ...]
    model_values: Array
    log_ratio: Array
    covariance: Array
    is_estimated: tuple[bool, ...]
    n_frames: int

    @property
    def log_ratio_std(self) -> Array:
        """Standard deviation of `log_ratio`, shape (2 s,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def is_determined(self) -> NDArray[np.bool_]:
        """Which dimensions the frames determine, shape (2 s,)."""
        return np.asarray((self.log_ratio_std < _KNOWN) & (self.n_frames > 0))

    @property
    def is_contradicted(self) -> NDArray[np.bool_]:
        """Which of the model's values contradict the frames, shape (2 s,)."""
        return np.asarray(self.is_determined & (np.abs(self.log_ratio) > _SIGMAS * self.log_ratio_std))

    @property
    def contradiction_message(self) -> str:
        """Which of the model's values contradict the frames and have no estimate in their place; empty for none."""
        values, fitting = 1e3 * self.model_values, 1e3 * self.model_values * np.exp(self.log_ratio)
        wrong = [
            f"{self.names[i]} {values[i]:.4g} mm where {fitting[i]:.4g} mm fits"
            for i in np.flatnonzero(self.is_contradicted & ~np.array(self.is_estimated))
        ]
        return f"the object seems to be other than the model says ({', '.join(wrong)})" if wrong else ""

    @property
    def messages(self) -> tuple[str, ...]:
        """Of every size that is doubted or estimated: the value that fits, with its interval."""
        lines = []
        for i, name in enumerate(self.names):
            value = self.model_values[i] * math.exp(self.log_ratio[i])
            two = 2 * value * self.log_ratio_std[i]
            found = f"{1e3 * value:.4g} mm ± {1e3 * two:.2g} mm (two standard deviations) fits {self.n_frames} frames"
            if self.is_estimated[i]:
                lines.append(f"{name} is estimated: {found}; the model says {1e3 * self.model_values[i]:.4g} mm")
            elif self.is_contradicted[i]:
                kind = name.rpartition(".")[2]
                lines.append(
                    f"{name} seems to be wrong: {found}, the model says {1e3 * self.model_values[i]:.4g} mm. "
                    f"Measure it again, or estimate it: track.options.estimated_dimensions: [{kind}]"
                )
        return tuple(lines)

    def point_std(self, points: Array) -> Array:
        """Standard deviations of points due to wrong and uncertain dimensions.

        Parameters
        ----------
        points : ndarray, shape (np, 3, 2 s)
            How they move with the sizes (`DimensionEquations`) [m].

        Returns
        -------
        ndarray, shape (np, 3)
            Standard deviations [m]: the whole displacement of what is doubted and yet used, and what remains uncertain
            of what is estimated.
        """
        used = np.array(self.is_estimated)
        wrong = np.where(self.is_contradicted & ~used, self.log_ratio, 0.0)
        chosen = points[..., used]
        spread = np.einsum("ijk,kl,ijl->ij", chosen, self.covariance[np.ix_(used, used)], chosen)
        return np.asarray(np.sqrt((points @ wrong) ** 2 + np.maximum(spread, 0.0)))

    def parameter_values(self, system: System, given: Mapping[str, float] | None) -> dict[str, float]:
        """Parameter values with the estimated sizes in place of the model's."""
        return _changed(system, given, np.where(self.is_estimated, self.log_ratio, 0.0))


def check_dimensions(
    system: System,
    given: Mapping[str, float] | None,
    estimate: Sequence[DimensionKind],
    std: tuple[float, float],
    fitted: Callable[[Mapping[str, float], Sequence[Array]], list[FrameShapeFit]],
) -> DimensionCheck:
    """Estimate the tubes' dimensions from some frames and compare them with the model.

    Parameters
    ----------
    system : System
    given : mapping of str to float, optional
        Parameter values; nominal where absent.
    estimate : sequence of "length" and "radius"
        What the fit is to use in place of the model's values, where the frames tell it.
    std : (float, float)
        Standard deviations of a point's distance from the surface, and of the error of places that all frames share
        with the camera's pose [m].
    fitted : callable
        From parameter values and the configurations of the round before, empty in the first, to the fits of the frames
        that can be used.

    Returns
    -------
    Sizes
    """
    told = _told(system, given)
    count, many = len(told), len(told) // 2
    names = tuple(f"{s.name}.{kind}" for kind in _DIMENSION_KINDS for s in system.segment_layouts)
    prior = np.diag(np.repeat(1.0 / np.square(_PRIOR), many))
    change, starts = np.zeros(count), list[Array]()
    nothing = DimensionCheck(names, told, change, np.asarray(np.linalg.inv(prior)), (False,) * count, 0)
    wanted = np.array([kind in estimate for kind in _DIMENSION_KINDS for _ in range(many)])
    shared = np.concatenate([math.hypot(*std) / told[:many], std[0] ** 2 / (2 * told[many:] ** 2)])
    covariance, frames = nothing.covariance, 0
    for turn in range(_ROUNDS):
        fits = fitted(_changed(system, given, change), starts)
        chosen = _believed(fits)
        if len(chosen) < _LEAST_FRAMES:
            return nothing
        starts, frames = [fit.q for fit in fits], len(chosen)
        gradient = np.array([fit.dimension_equations.gradient for fit in chosen])
        curvature = np.array([fit.dimension_equations.hessian for fit in chosen])
        inverse = np.linalg.inv(curvature.sum(axis=0) + prior)
        step = -inverse @ (gradient.sum(axis=0) + prior @ change)
        left = gradient + curvature @ step
        scatter = inverse @ (left.T @ left) @ inverse * frames / (frames - 1)
        covariance = np.asarray(inverse + scatter + np.diag(shared**2))
        change = change + np.clip(step, -_LONGEST_STEP, _LONGEST_STEP)
        if turn == 0 and not wanted.any() and (np.abs(change) < _CLEAR * np.sqrt(np.diag(covariance))).all():
            break  # nothing to doubt
        if np.abs(step).max() < _SETTLED:
            break
    known = np.sqrt(np.diag(covariance)) < _KNOWN
    return DimensionCheck(names, told, change, covariance, tuple(bool(x) for x in wanted & known), frames)


def _believed(fits: Sequence[FrameShapeFit]) -> list[FrameShapeFit]:
    """Fits whose free ends stand where those of the others do, as seen from the shape's."""
    if not fits:
        return []
    ends = np.array([fit.end_offsets for fit in fits])
    keep = np.ones(len(fits), bool)
    for column in ends.T:
        seen = np.isfinite(column)
        if seen.any():
            middle = float(np.median(column[seen]))
            spread = _TO_SIGMA * float(np.median(np.abs(column[seen] - middle)))
            usual = max(spread, float(np.median([fit.noise_std for fit in fits])))
            keep &= ~seen | (np.abs(column - middle) < _APART * usual)
    return [fit for fit, good in zip(fits, keep, strict=True) if good]


def _symbols(system: System) -> list[list[str]]:
    """Parameters that each size is made of."""
    found = [[x.name() for x in ca.symvar(ca.vertcat(*s.link_lengths))] for s in system.segment_layouts]
    return found + [[x.name() for x in ca.symvar(s.radius)] for s in system.segment_layouts]


def _told(system: System, given: Mapping[str, float] | None) -> Array:
    symbols, theta = system.parameters.symbols, system.parameters.vector(given)
    sums = [ca.sum1(ca.vertcat(*s.link_lengths)) for s in system.segment_layouts] + [
        s.radius for s in system.segment_layouts
    ]
    return np.array(ca.Function("told", [symbols], [ca.densify(ca.vertcat(*sums))])(theta)).ravel()


def _changed(system: System, given: Mapping[str, float] | None, change: Array) -> dict[str, float]:
    values = dict(zip(system.parameters.names, system.parameters.vector(given).tolist(), strict=True))
    for i, names in enumerate(_symbols(system)):
        for name in names:
            values[name] *= math.exp(float(change[i]))
    return values
