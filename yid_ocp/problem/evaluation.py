"""The layout of an estimation problem's unknowns and residual, and its priors, bounds and evaluations."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from yid_ocp.arrays import Array, BoolArray, IntArray
from yid_ocp.display import ReprMixin, ReprTexts, count_with_noun
from yid_ocp.effects import EffectBase
from yid_ocp.errors import ConfigError
from yid_ocp.model.system import System
from yid_ocp.problem.episodes import Episode, EpisodePrediction, TorqueAndAngleErrorModel
from yid_ocp.problem.measurements import (
    ResidualAndJacobian,
    SensorMeasurements,
    huber_loss_and_sqrt_weights,
    whiten_with_extra_errors,
    whitened_measurement_sensitivities_to_sensor_errors,
)
from yid_ocp.problem.options import ProblemOptions

EquilibriumGuesses = tuple[Array | None, ...]
"""For each recording, a configuration near the equilibrium from which it starts; None where it is not known."""


class ProcessNoiseWhitener(Protocol):
    """The interface of a Kalman filter with fixed gain that whitens one recording's residual against process noise."""

    @property
    def input_error_model(self) -> TorqueAndAngleErrorModel:
        """The standard deviations of torque and angle errors, and the errors about which the filter is linearised."""
        ...

    def whiten_residuals_and_estimate_torque_bias(self, rows: Array, push: Array | None) -> tuple[Array, Array]:
        """Whiten the residual and its derivatives, and estimate the constant torque errors (nu, c) [N m].

        All arrays have c columns: value, then derivatives. `rows` (r, c) is the residual in units of sensor noise.
        `push` (N, nu, c) is the torque [N m] that the tracking filter adds in each of N steps; None without a filter.
        """
        ...


@dataclass(frozen=True)
class ResidualVectorLayout:
    """The slices of the residual vector: measurements of all episodes, then stated priors, then weak priors."""

    measurements: tuple[tuple[slice, ...], ...]  # slices by episode and sensor group
    data: slice
    stated_priors: slice
    weak_priors: slice

    @property
    def slice_of_data_and_stated_priors(self) -> slice:
        """The slice of the residual vector that holds data and stated priors."""
        return slice(0, self.stated_priors.stop)

    @staticmethod
    def from_episodes(episodes: Sequence[Episode], stated: int, weak: int) -> ResidualVectorLayout:
        """Build the layout from the episodes and the numbers of stated and weak prior residuals."""
        at, groups = 0, []
        for episode in episodes:
            own = []
            for samples in episode.measurements:
                own.append(slice(at, at + samples.n_residuals))
                at += samples.n_residuals
            groups.append(tuple(own))
        last = at + stated
        return ResidualVectorLayout(tuple(groups), slice(0, at), slice(at, last), slice(last, last + weak))


@dataclass(frozen=True, repr=False)
class Evaluation(ReprMixin):
    """The cost, residual, Jacobian and predictions of an estimation problem at one unknown vector."""

    cost: float  # 1/2 |r|^2, or the robust loss; infinite if the rollout failed
    residual: Array  # (nr,)
    jacobian: Array | None  # (nr, nx)
    ok: bool
    message: str
    episode_predictions: tuple[EpisodePrediction, ...]

    def _summary(self) -> ReprTexts:
        slopes = "" if self.jacobian is None else f", by {count_with_noun(self.jacobian.shape[1], 'unknown')}"
        said = f"cost {self.cost:.6g} of {count_with_noun(len(self.residual), 'residual')}{slopes}"
        return ReprTexts(said if self.ok else f"failed, {self.message}")

    @property
    def equilibrium_guesses(self) -> EquilibriumGuesses:
        """The start equilibrium of each episode, or None: first guesses for an evaluation at similar unknowns."""
        return tuple(result.equilibrium_guess for result in self.episode_predictions)


EvaluateFunction = Callable[..., Evaluation]
"""Evaluates a problem at an unknown vector, with the arguments of `EstimationProblem.evaluate`."""


def _sensor_whitened_residual(
    measurements: Sequence[SensorMeasurements], result: EpisodePrediction, threshold: float = math.inf
) -> ResidualAndJacobian:
    """Residual of one recording in units of the sensors' noise, group after group."""
    slopes = result.output_sensitivities or (None,) * len(measurements)
    groups = zip(measurements, result.predicted_outputs, slopes, strict=True)
    parts = [samples.residual_and_jacobian(y, slope, threshold) for samples, y, slope in groups]
    jacobians = [part.jacobian for part in parts if part.jacobian is not None]
    return ResidualAndJacobian(
        sum(part.cost for part in parts),
        np.concatenate([part.residual for part in parts]),
        np.vstack(jacobians) if jacobians else None,
        np.concatenate([part.robust_factor for part in parts]),
    )


def episode_residual_and_jacobian(
    episode: Episode, whitening: ProcessNoiseWhitener | None, result: EpisodePrediction, threshold: float = np.inf
) -> ResidualAndJacobian:
    """Whiten one episode's residual by sensor noise, or by the Kalman filter `whitening` if given.

    Constant sensor errors count as noise (`whiten_with_extra_errors`). `threshold` is the Huber threshold.
    """
    by_constants = whitened_measurement_sensitivities_to_sensor_errors(episode.measurements)
    if whitening is None and not by_constants.shape[1]:
        return _sensor_whitened_residual(episode.measurements, result, threshold)
    plain = _sensor_whitened_residual(episode.measurements, result)
    columns = plain.residual[:, None]
    if plain.jacobian is not None:
        columns = np.hstack([columns, plain.jacobian])
    if whitening is not None:
        kept, push = columns.shape[1], result.stacked_feedback_torque_and_sensitivity
        # constant sensor errors do not drive the motion
        push = None if push is None else np.pad(push, ((0, 0), (0, 0), (0, by_constants.shape[1])))
        innovations, _ = whitening.whiten_residuals_and_estimate_torque_bias(np.hstack([columns, by_constants]), push)
        columns, by_constants = innovations[:, :kept], innovations[:, kept:]
    if by_constants.shape[1]:
        columns = whiten_with_extra_errors(columns, by_constants)
    cost, factor = huber_loss_and_sqrt_weights(columns[:, 0], threshold)
    columns = factor[:, None] * columns
    return ResidualAndJacobian(cost, columns[:, 0], None if plain.jacobian is None else columns[:, 1:], factor)


def stated_rms_noise_of_data_residuals(episodes: Sequence[Episode], options: ProblemOptions) -> float:
    """Return the RMS noise of all data residuals: 1 for whitened residuals, else the noise of the points [m]."""
    if options.weighting != "paper":
        return 1.0
    found = [s.std[np.isfinite(s.std)] for episode in episodes for s in episode.measurements]
    return float(np.sqrt(np.mean(np.concatenate(found) ** 2)))


INITIAL_STATE_UNKNOWN_PREFIX = "start."
LOG_PRIOR_PARABOLA_RATIO = 1e-3
"""Ratio of an unknown to its initial value below which the weak prior's logarithm is replaced by a parabola."""


@dataclass(frozen=True)
class UnknownVectorLayout:
    """The order of the unknown vector: shared parameters, then each recording's local parameters and state offset."""

    shared_parameters: tuple[str, ...]  # free, with one value for all recordings
    local_parameters: tuple[str, ...]  # free, with a value in each
    initial_state_names: tuple[str, ...]  # `q.JOINT`, `p.JOINT`, and `z.NAME` of unobserved internal coordinates
    recording_names: tuple[str, ...]

    @cached_property
    def unknown_names(self) -> tuple[str, ...]:
        """The names of all unknowns. Local parameters and initial states include the recording's name."""
        own = [*self.local_parameters, *(f"{INITIAL_STATE_UNKNOWN_PREFIX}{name}" for name in self.initial_state_names)]
        each = (f"{name}[{recording}]" for recording in self.recording_names for name in own)
        return (*self.shared_parameters, *each)

    @property
    def free_parameter_names(self) -> tuple[str, ...]:
        """The names of the free parameters, shared then local: the order of one recording's derivative columns."""
        return (*self.shared_parameters, *self.local_parameters)

    def unknown_indices_affecting_recording(self, recording: int) -> IntArray:
        """Return the indices of the shared unknowns and of one recording's local parameters and initial state."""
        shared, own = len(self.shared_parameters), len(self.local_parameters) + len(self.initial_state_names)
        return np.concatenate([np.arange(shared), shared + recording * own + np.arange(own)])

    def scatter_to_unknown_columns(self, block: Array, recording: int) -> Array:
        """Expand one recording's derivative columns (r, d) to columns of all unknowns (r, nx), filled with zeros."""
        wide = np.zeros((len(block), len(self.unknown_names)))
        wide[:, self.unknown_indices_affecting_recording(recording)] = block
        return wide

    def unpack_episode_unknowns(
        self, x: ArrayLike, recording: int, theta: Array, system: System
    ) -> tuple[Array, Array]:
        """Return a copy of `theta` with one recording's values from `x`, and that recording's initial state offset."""
        own = np.asarray(x, float)[self.unknown_indices_affecting_recording(recording)]
        result, count = theta.copy(), len(self.free_parameter_names)
        result[[system.parameters.index(name) for name in self.free_parameter_names]] = own[:count]
        return result, own[count:]

    def pack_same_for_all_recordings(self, value_by_name: Callable[[str], float], start: Array) -> Array:
        """Return all unknowns: parameters by name, and the initial-state offsets `start` in each recording."""
        shared, local = (list(map(value_by_name, part)) for part in (self.shared_parameters, self.local_parameters))
        return np.array([*shared, *([*local, *start] * len(self.recording_names))], dtype=float)

    def named_values(self, x: Array) -> dict[str, float]:
        """Return the values of the unknown vector `x` by unknown name."""
        return dict(zip(self.unknown_names, map(float, x), strict=True))


def initial_unknown_vector_and_bounds(
    unknowns: UnknownVectorLayout, system: System, theta: Array
) -> tuple[Array, Array, Array]:
    """Return the initial unknown vector and its lower and upper bounds, (nx,) each. Initial states have offset zero."""
    parameters, pack = system.parameters, unknowns.pack_same_for_all_recordings
    wide = max_abs_initial_internal_offsets(system, unknowns.initial_state_names)
    start = pack(lambda name: theta[parameters.index(name)], np.zeros(len(wide)))
    return start, pack(lambda name: parameters[name].lower, -wide), pack(lambda name: parameters[name].upper, wide)


def positive_unknowns_mask(unknowns: UnknownVectorLayout, system: System, lower: Array, start: Array) -> BoolArray:
    """Return the mask (nx,) of nonnegative unknowns that start above zero, except amplitudes that may become zero.

    An amplitude may become zero unless its effect has shape parameters, which would then lose their influence.
    """
    effects = [e for e in system.effects if isinstance(e, EffectBase) and not e.shape_parameter_names]
    vanishing = {name for e in effects for name in e.amplitude_parameter_names if e.neutral_values[name] == 0}
    offset = np.zeros(len(unknowns.initial_state_names))
    return (lower >= 0) & (start > 0) & (unknowns.pack_same_for_all_recordings(vanishing.__contains__, offset) == 0)


def stated_prior_stds_of_unknowns(
    unknowns: UnknownVectorLayout, options: ProblemOptions, system: System, inertia: Callable[[tuple[str, ...]], Array]
) -> Array:
    """Return the standard deviation of each unknown's stated Gaussian prior, (nx,). Infinite without prior.

    `inertia` returns the mass matrix diagonal of named joints, which converts a velocity std to a momentum std. An
    effect's internal coordinate has a uniform prior within its limits, and the std of this uniform prior is returned.
    """
    limits, at_start = _unobserved_state_limits(system), list[float]()
    joint = options.multivariate_prior.restricted_to(unknowns.shared_parameters)
    known = dict(zip(joint.parameter_names, np.sqrt(np.diag(joint.covariance)).tolist(), strict=True))
    for part, _, name in (name.partition(".") for name in unknowns.initial_state_names):
        if part == "q":
            at_start.append(options.initial_configuration_prior_std)
        elif part == "p":
            at_start.append(options.initial_velocity_prior_std * max(float(inertia((name,))[0]), 1e-9))
        else:
            at_start.append(limits[name] / math.sqrt(3))
    stated = {**options.prior_stds, **known}
    return unknowns.pack_same_for_all_recordings(lambda name: stated.get(name, math.inf), np.array(at_start))


def _stated_prior_jacobian(unknowns: UnknownVectorLayout, options: ProblemOptions, std: Array) -> Array:
    """Jacobian P (k, nx) of the stated priors' whitened residual P (x - x0); x0: the initial unknowns."""
    joint = options.multivariate_prior.restricted_to(unknowns.shared_parameters)
    at = [unknowns.unknown_names.index(name) for name in joint.parameter_names]
    alone = [i for i in np.flatnonzero(np.isfinite(std)) if i not in at]
    rows = np.zeros((len(alone) + len(at), len(std)))
    rows[np.arange(len(alone)), alone] = 1.0 / std[alone]
    if at:
        # C = L L', so that L^-1 d has unit covariance
        rows[len(alone) :, at] = np.linalg.inv(np.linalg.cholesky(joint.covariance))
    return rows


@dataclass(frozen=True)
class PriorResiduals:
    """The whitened residuals of stated Gaussian priors, and of weak log-normal priors of positive unknowns."""

    initial_unknowns: Array  # (nx,)
    stated_jacobian: Array  # (k, nx)
    initial_state_stds: Array  # of the estimated initial state components, ordered as `initial_state_names`
    weak: IntArray  # indices of unknowns with a weak prior
    weak_log_std: float

    @staticmethod
    def from_options(
        unknowns: UnknownVectorLayout, options: ProblemOptions, start: Array, stds: Array, positive: BoolArray
    ) -> PriorResiduals:
        """Build the priors about `start`. Positive unknowns without a stated prior get the weak one of the options."""
        has_weak_priors = options.weighting != "paper" and options.weak_prior_geometric_std > 1
        weak = np.flatnonzero(positive & ~np.isfinite(stds) & has_weak_priors)
        at, spread = len(unknowns.free_parameter_names), np.log(max(options.weak_prior_geometric_std, 1.0 + 1e-9))
        own = stds[at : at + len(unknowns.initial_state_names)]
        return PriorResiduals(start, _stated_prior_jacobian(unknowns, options, stds), own, weak, float(spread))

    def residual_and_jacobian(self, x: Array) -> tuple[Array, Array]:
        """Return the residual of the stated and weak priors, and its Jacobian with respect to the unknowns."""
        stated, weak, start = self.stated_jacobian, self.weak, self.initial_unknowns
        rows = np.vstack([stated, np.zeros((len(weak), len(x)))])
        value, slope = _soft_logarithm_and_slope(x[weak] / start[weak])
        rows[len(stated) + np.arange(len(weak)), weak] = slope / (self.weak_log_std * start[weak])
        return np.concatenate([stated @ (x - start), value / self.weak_log_std]), rows


def estimated_initial_state_names(
    system: System, options: ProblemOptions, free: Sequence[str], theta: Array
) -> tuple[str, ...]:
    """List the names of the estimated components of initial states, such as `q.JOINT`, `p.JOINT` and `z.NAME`.

    With the option "estimated", q and p are estimated of coordinates that are not driven by torques, not prescribed and
    not compliant. Unobserved internal coordinates z of effects that are free or not neutral are always estimated.
    """
    found: list[str] = []
    if options.initial_state == "estimated":
        known = {*(() if system.servos else system.actuated_coordinate_indices), *system.prescribed_coordinate_indices}
        known |= {system.mechanism.joint_index(joint) for joint in system.joint_compliances}
        coordinates = [name for i, name in enumerate(system.mechanism.joint_names) if i not in known]
        found = [*(f"q.{name}" for name in coordinates), *(f"p.{name}" for name in coordinates)]
    for effect in system.effects:
        if isinstance(effect, EffectBase) and effect.max_abs_initial_internal_coordinates:
            at, neutral = system.parameters.index, effect.neutral_values
            if any(n in free or theta[at(n)] != neutral[n] for n in effect.amplitude_parameter_names):
                found += [f"z.{name}" for name in effect.max_abs_initial_internal_coordinates]
    return tuple(found)


def _unobserved_state_limits(system: System) -> dict[str, float]:
    """Largest magnitude of each unobserved initial internal coordinate of the effects."""
    effects = [effect for effect in system.effects if isinstance(effect, EffectBase)]
    return {name: size for effect in effects for name, size in effect.max_abs_initial_internal_coordinates.items()}


def max_abs_initial_internal_offsets(system: System, names: Sequence[str]) -> Array:
    """Return the largest absolute initial offset of each effect's internal coordinate, infinite for other names."""
    limits = _unobserved_state_limits(system)
    return np.array([limits[name.removeprefix("z.")] if name.startswith("z.") else np.inf for name in names])


def check_free_parameter_names(system: System, free: Sequence[str], options: ProblemOptions) -> None:
    """Check that free parameters exist and are listed once, and that local ones and those in `prior_stds` are free."""
    for name in [*free, *options.local_parameters, *options.prior_stds, *options.multivariate_prior.parameter_names]:
        system.parameters.index(name)
    if twice := [name for name in free if list(free).count(name) > 1]:
        what, hint = f"the free parameter '{twice[0]}' is listed twice", "delete one of the two entries of free"
        raise ConfigError(what, where="list of free parameters", allowed="every name once", hint=hint)
    for name in (*options.local_parameters, *options.prior_stds):
        if name not in free:
            noun, where = "value per recording" if name in options.local_parameters else "prior", f"parameters.{name}"
            what, allowed = f"the parameter '{name}' has a {noun}, but is not free", f"{where}.free: true"
            raise ConfigError(what, where=where, allowed=allowed, hint=f"set {where}.free: true")


def check_unique_recording_names(names: Sequence[str]) -> None:
    """Check that no two estimation recordings have the same name. Raises `ConfigError`."""
    if twice := [name for name in names if names.count(name) > 1]:
        what, hint = f"two recordings are called '{twice[0]}'", "rename one of the two, or leave one out"
        raise ConfigError(what, where="recordings.estimate", allowed="every name once", hint=hint)


def check_no_known_value_of_free_parameters(episodes: Iterable[Episode], free: Sequence[str]) -> None:
    """Check that no recording has a known value of a free parameter. Raises `ConfigError`."""
    for episode in episodes:
        known = {*episode.known_parameters, *getattr(episode.fixed_initial_state, "fitted_parameters", ())}
        if found := [name for name in free if name in known]:
            what = f"the parameter '{found[0]}' is free, but the recording has a known value of it"
            allowed, hint = "a parameter is either free or known, not both", f"set parameters.{found[0]}.free: false"
            raise ConfigError(what, where=f"recording '{episode.name}'", allowed=allowed, hint=hint)


def check_initial_values_and_bounds(system: System, free: Sequence[str], theta: Array) -> None:
    """Check that each free parameter has distinct bounds and an initial value within them. Raises `ConfigError`."""
    for name in free:
        entry, value = system.parameters[name], theta[system.parameters.index(name)]
        replace(entry, value=float(value))  # it checks its bounds
        if not entry.lower < entry.upper:
            what, hint = f"the bounds of {name} are equal: {entry.lower:g}", f"set parameters.{name}.free: false"
            raise ConfigError(what, where=f"parameters.{name}.bounds", allowed="[lower, upper], not equal", hint=hint)


def _soft_logarithm_and_slope(ratio: Array) -> tuple[Array, Array]:
    """Return the logarithm of a ratio and its derivative, continued by a parabola below `LOG_PRIOR_PARABOLA_RATIO`."""
    below = (ratio - LOG_PRIOR_PARABOLA_RATIO) / LOG_PRIOR_PARABOLA_RATIO
    small = below < 0
    kept = np.where(small, LOG_PRIOR_PARABOLA_RATIO, ratio)
    value = np.log(kept) + np.where(small, below - below**2 / 2, 0.0)
    return value, np.where(small, (1 - below) / LOG_PRIOR_PARABOLA_RATIO, 1 / kept)
