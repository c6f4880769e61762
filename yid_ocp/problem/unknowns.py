"""The unknown vector of an estimation problem: what stands where, recording by recording."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from yid_ocp.effects import EffectBase
from yid_ocp.errors import ConfigError, nearest
from yid_ocp.model.system import System
from yid_ocp.problem.options import ProblemOptions

Array = NDArray[np.float64]
START = "start."
SMALL_RATIO = 1e-3
"""Part of its start below which the weak prior of an unknown is no logarithm any more."""


@dataclass(frozen=True)
class Unknowns:
    """(shared parameters | recording 1: local parameters, offset of its start | recording 2: ...).

    Attributes
    ----------
    shared, local : tuple of str
        Free parameters with one value for all recordings, and with a value in each.
    start : tuple of str
        Rows of an estimated initial state, `q.JOINT` and `p.JOINT`, and of internal coordinates that nothing tells,
        `z.NAME`.
    recordings : tuple of str
    """

    shared: tuple[str, ...]
    local: tuple[str, ...]
    start: tuple[str, ...]
    recordings: tuple[str, ...]

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of all unknowns; local ones and initial states carry their recording's name."""
        own = [*self.local, *(f"{START}{name}" for name in self.start)]
        return (*self.shared, *(f"{name}[{recording}]" for recording in self.recordings for name in own))

    @property
    def parameters(self) -> tuple[str, ...]:
        """Free parameters in the order of one recording's directions."""
        return (*self.shared, *self.local)

    def columns(self, recording: int) -> NDArray[np.int64]:
        """Places of one recording's (shared, local, start) unknowns in the vector."""
        shared, own = len(self.shared), len(self.local) + len(self.start)
        return np.concatenate([np.arange(shared), shared + recording * own + np.arange(own)])

    def placed(self, block: Array, recording: int) -> Array:
        """Columns by one recording's directions, (r, d), moved to their places in the unknown vector, (r, nx)."""
        wide = np.zeros((len(block), len(self.names)))
        wide[:, self.columns(recording)] = block
        return wide

    def split(self, x: ArrayLike, recording: int, theta: Array, system: System) -> tuple[Array, Array]:
        """theta with one recording's values in place of the nominal ones, and the offset of its start."""
        own = np.asarray(x, float)[self.columns(recording)]
        result = theta.copy()
        for name, value in zip(self.parameters, own, strict=False):
            result[system.parameters.index(name)] = value
        return result, own[len(self.parameters) :]

    def spread(self, shared: ArrayLike, local: ArrayLike, start: ArrayLike) -> Array:
        """An unknown vector from values for the shared parameters, each recording's local ones and its start."""
        parts = [np.asarray(shared, float)]
        parts += [np.asarray(local, float), np.asarray(start, float)] * len(self.recordings)
        return np.concatenate(parts)


def replaced(x: Array, names: Sequence[str], values: Mapping[str, float]) -> Array:
    """An unknown vector with named entries replaced."""
    return np.array([values.get(name, value) for name, value in zip(names, x, strict=True)], float)


def stated_std(
    unknowns: Unknowns, options: ProblemOptions, system: System, inertia: Callable[[tuple[str, ...]], Array]
) -> Array:
    """Standard deviation of every unknown's stated Gaussian prior about its start, infinite where there is none.

    `inertia` gives the diagonal of the mass matrix for named joints, by which a start's velocity becomes a momentum. An
    internal coordinate may begin anywhere within its limits; the standard deviation is that of such a uniform prior.
    """
    limits = hidden_starts(system)
    stds = []
    joint = options.joint_prior.of(unknowns.shared)
    known = dict(zip(joint.names, np.sqrt(np.diag(joint.covariance)).tolist(), strict=True))
    for name in unknowns.names:
        base = name.split("[")[0]
        if base.startswith(f"{START}q."):
            stds.append(options.configuration_std)
        elif base.startswith(f"{START}p."):
            mass = float(inertia((base.removeprefix(f"{START}p."),))[0])
            stds.append(options.velocity_std * max(mass, 1e-9))
        elif base.startswith(f"{START}z."):
            stds.append(limits[base.removeprefix(f"{START}z.")] / math.sqrt(3))
        else:
            stds.append(known.get(name, float(options.priors.get(base, np.inf))))
    return np.array(stds)


def stated_rows(unknowns: Unknowns, options: ProblemOptions, std: Array) -> Array:
    """Rows of the stated priors, (k, nx): times (x - start) they are in units of what is known, and independent.

    Parameters
    ----------
    unknowns : Unknowns
    options : ProblemOptions
    std : ndarray, shape (nx,)
        From `stated_std`.
    """
    joint = options.joint_prior.of(unknowns.shared)
    at = [unknowns.names.index(name) for name in joint.names]
    alone = [i for i in np.flatnonzero(np.isfinite(std)) if i not in at]
    rows = np.zeros((len(alone) + len(at), len(std)))
    rows[np.arange(len(alone)), alone] = 1.0 / std[alone]
    if at:
        # C = L L', so that L^-1 d has unit covariance
        rows[len(alone) :, at] = np.linalg.inv(np.linalg.cholesky(joint.covariance))
    return rows


def start_names(system: System, options: ProblemOptions, free: Sequence[str], theta: Array) -> tuple[str, ...]:
    """Estimated rows of an initial state.

    Where starts are estimated, q and p of the coordinates that are neither driven by torques, nor prescribed, nor
    follow their load at once; in any case the internal coordinates that nothing tells, of effects that are free or not
    neutral.
    """
    found: list[str] = []
    if options.initial_state == "estimated":
        known = {*(() if system.servos else system.driven_indices), *system.prescribed_indices}
        known |= {system.mechanism.joint_index(joint) for joint in system.compliant}
        coordinates = [name for i, name in enumerate(system.mechanism.joint_names) if i not in known]
        found = [*(f"q.{name}" for name in coordinates), *(f"p.{name}" for name in coordinates)]
    for effect in system.effects:
        if isinstance(effect, EffectBase) and effect.unknown_at_start:
            index = system.parameters.index
            names = effect.amplitudes
            if any(name in free or theta[index(name)] != effect.neutral[name] for name in names):
                found += [f"z.{name}" for name in effect.unknown_at_start]
    return tuple(found)


def hidden_starts(system: System) -> dict[str, float]:
    """Internal coordinates that nothing tells at the start of a recording, and how large they may be."""
    effects = [effect for effect in system.effects if isinstance(effect, EffectBase)]
    return {name: size for effect in effects for name, size in effect.unknown_at_start.items()}


def start_limits(system: System, names: Sequence[str]) -> Array:
    """How far estimated rows of an initial state may be off, infinite for coordinates and momenta."""
    limits = hidden_starts(system)
    return np.array([limits[name.removeprefix("z.")] if name.startswith("z.") else np.inf for name in names])


def check_free(system: System, free: Sequence[str], options: ProblemOptions) -> None:
    """Refuse parameters that are unknown, named twice, or local or with a prior without being free."""
    for name in [*free, *options.local, *options.priors, *options.joint_prior.names]:
        system.parameters.index(name)
    if len(set(free)) != len(free):
        raise ConfigError("a free parameter is named twice", where=", ".join(free))
    for name in (*options.local, *options.priors):
        if name not in free:
            raise ConfigError(f"'{name}' is not free", hint=nearest(name, free), where="local or priors")


def check_bounds(system: System, free: Sequence[str], theta: Array) -> None:
    """Refuse initial values outside their bounds, and bounds without room."""
    for name in free:
        entry, value = system.parameters[name], theta[system.parameters.index(name)]
        if not entry.lower <= value <= entry.upper:
            raise ConfigError(
                f"initial value {value:g} {entry.unit} of {name} lies outside its bounds",
                where=f"parameters.{name}",
                allowed=f"{entry.lower:g} to {entry.upper:g} {entry.unit}",
            )
        if not entry.lower < entry.upper:
            raise ConfigError(
                f"the bounds of {name} leave no room",
                where=f"parameters.{name}",
                allowed="lower below upper",
                hint="fix the parameter instead of closing its bounds",
            )


def soft_logarithm(ratio: Array) -> tuple[Array, Array]:
    """log(ratio) and its slope, from `SMALL_RATIO` down the parabola that joins it twice differentiably.

    A weak prior on an unknown that its bound keeps at zero then has a value and a slope like any other row, where the
    logarithm would be a wall that nothing climbs.

    Parameters
    ----------
    ratio : ndarray, shape (k,)
        Zero or above.
    """
    below = (ratio - SMALL_RATIO) / SMALL_RATIO
    small = below < 0
    kept = np.where(small, SMALL_RATIO, ratio)
    value = np.log(kept) + np.where(small, below - below**2 / 2, 0.0)
    return value, np.where(small, (1 - below) / SMALL_RATIO, 1 / kept)
