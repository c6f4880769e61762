"""Episodes, which are recordings placed on the nodes of a rollout."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from yid_ocp.arrays import Array, IntArray
from yid_ocp.data.recording import Recording
from yid_ocp.effects import EffectBase
from yid_ocp.errors import DataError
from yid_ocp.integrator.statics import Equilibrium
from yid_ocp.integrator.step import Step, float_array_with_checked_shape, generalized_momentum_from_velocity
from yid_ocp.integrator.step_model import Rollout, TrackingFeedback
from yid_ocp.integrator.tracking_feedback import lqr_tracking_feedback, proportional_tracking_feedback
from yid_ocp.model.system import System
from yid_ocp.problem.initial_state_fit import FixedInitialState
from yid_ocp.problem.measurements import (
    SensorMeasurements,
    TimeGrid,
    measurements_located_on_grid,
    measurements_with_paper_weights,
    rollout_time_grid,
)
from yid_ocp.problem.model_functions import ModelFunctions
from yid_ocp.problem.options import ProblemOptions, SensorOptions
from yid_ocp.problem.recorded_inputs import (
    prescribed_coordinates_at_nodes,
    smoothed_efforts_at_nodes,
    smoothed_joint_angles_at_nodes,
    step_mean_inputs,
)
from yid_ocp.sensors import CHANNEL_KINDS, SENSOR_READERS, SensorDataInputs
from yid_ocp.sensors import joints as joint_sensors
from yid_ocp.sensors.signal_filters import ZeroPhaseLowPassFilter, slow_effort_filter, zero_phase_effort_filter


@dataclass(frozen=True)
class EpisodePrediction:
    """The prediction of one episode: rollout, initial equilibrium, sensor readings and sensitivities."""

    rollout: Rollout
    equilibrium: Equilibrium | None
    predicted_outputs: tuple[Array, ...]  # predictions of every sample, in the sensor's unit, (M, k) per sensor
    output_sensitivities: tuple[Array, ...] | None  # (M, k, d) each
    equilibrium_guess: Array | None = None  # configuration at `equilibrium`, for similar parameters, (n,)
    # correction of the recorded torque by the tracking filter, if encoders are measurements, (N, nu) [N m]
    torque_correction: Array | None = None
    torque_correction_sensitivity: Array | None = None  # (N, nu, d)

    @property
    def stacked_feedback_torque_and_sensitivity(self) -> Array | None:
        """The array (N, nu, 1 + d) of `torque_correction` and then its d derivatives, if known. None without it."""
        if self.torque_correction is None:
            return None
        known, slopes = self.torque_correction[:, :, None], self.torque_correction_sensitivity
        return known if slopes is None else np.concatenate([known, slopes], axis=2)


@dataclass(frozen=True)
class InitialStateWithSensitivity:
    """The initial state of a rollout, with derivative and equilibrium, or the reason why no initial state was found."""

    state: Array  # (q, p, z), (nx,)
    state_sensitivity: Array  # by the wanted parameters, then the state offset, (nx, d)
    equilibrium: Equilibrium | None  # None for a fitted or given state
    failure_message: str  # empty on success


log = logging.getLogger(__name__)

# lowest torque error with encoders, relative to the torque's variation: no model follows encoders without correction
_MIN_TORQUE_ERROR_FRACTION = 1e-3
# attributes of `TorqueAndAngleErrorModel` with one row for each step
_STEPWISE_ERRORS = ("sample_of_step", "torque_noise", "recorded_torque_noise", "transmitted_torque_noise")


@dataclass(frozen=True)
class TorqueAndAngleErrorModel:
    """The noise levels and current error estimates of the recorded torques and angles that drive a rollout.

    A recorded torque has an error w in each step and a constant error b [N m]. A recorded angle has an error v [rad].
    """

    torque_std: Array  # standard deviation of w, (nu,)
    torque_bias_std: Array  # standard deviation of b, (nu,)
    angle_std: Array  # standard deviation of v, (nu,)
    sample_of_step: IntArray  # recorded sample of each step's torque, (N,); w is the same in all steps of a sample
    encoder_noise_steps: float  # number of steps that share one encoder sample's noise through interpolation
    has_encoder_measurements: bool
    torque_bias: Array  # value of b that is subtracted from the recorded torque, (nu,)
    torque_noise: Array  # value of w that is subtracted in every step, (N, nu)
    # noise of the recorded torque that follows from w, subtracted before effects on torques apply, (N, nu) [N m]
    recorded_torque_noise: Array
    transmitted_torque_noise: Array  # part of w that this subtraction removes from the applied torque, (N, nu)
    smoothed_reference: Array | None = None  # reference of the tracking filter in place of the measured motion, (N, nb)

    @property
    def recorded_minus_true_torque(self) -> Array:
        """The estimated torque error in every step, recorded minus true, with offset and noise, (N, nu) [N m]."""
        return self.torque_bias + self.torque_noise

    @property
    def with_torque_bias_only(self) -> TorqueAndAngleErrorModel:
        """The same error model with only the constant torque offset, no torque noise and no smoothing of angles."""
        none = np.zeros_like(self.torque_noise)
        return replace(
            self, torque_noise=none, recorded_torque_noise=none, transmitted_torque_noise=none, smoothed_reference=None
        )

    def on_finer_steps(self, ratio: int) -> TorqueAndAngleErrorModel:
        """Return this model for `ratio` times shorter steps, with torque errors held and angles interpolated."""
        made: dict[str, Any] = {name: np.repeat(getattr(self, name), ratio, axis=0) for name in _STEPWISE_ERRORS}
        if (known := self.smoothed_reference) is not None:
            at, nodes = np.arange(ratio * len(known)) / ratio, np.arange(len(known))
            made["smoothed_reference"] = np.stack([np.interp(at, nodes, x) for x in known.T], axis=1)
        return replace(self, **made)

    def _truncated_to_steps(self, steps: int) -> TorqueAndAngleErrorModel:
        """The same error model restricted to the first `steps` steps of the rollout."""
        names = _STEPWISE_ERRORS if self.smoothed_reference is None else (*_STEPWISE_ERRORS, "smoothed_reference")
        return replace(self, **{name: getattr(self, name)[:steps] for name in names})


def _recorded_input_errors(
    recording: Recording,
    system: System,
    grid: TimeGrid,
    sensors: Mapping[str, SensorOptions],
    samples: Sequence[SensorMeasurements],
) -> TorqueAndAngleErrorModel | None:
    """Error levels of the torques and angles that drive a recording's rollout; None without driven joints."""
    joints, driven = recording.joints, system.driven
    if joints is None or joints.effort is None or not driven or system.servos:
        return None
    effort = sensors.get(joint_sensors.JOINT_EFFORT_SENSOR_KEY, SensorOptions())
    position = sensors.get(joint_sensors.JOINT_POSITION_GROUP_NAME, SensorOptions())
    std = joint_sensors.joint_torque_noise_std(joints, driven, effort, recording.name)
    bias = joint_sensors.joint_torque_bias_std(joints, driven, effort)
    encoders = any(entry.sensor.position_joints for entry in samples)
    if not encoders and not np.any(std > 0) and not np.any(bias > 0):
        return None
    angle = joint_sensors.joint_angle_noise_std(joints, driven, position, recording.name)
    for group, choice, level in (
        (joint_sensors.JOINT_EFFORT_SENSOR_KEY, effort, std),
        (joint_sensors.JOINT_POSITION_GROUP_NAME, position, angle),
    ):
        if not joint_sensors.is_noise_std_stated(joints, group, choice):
            words = "%s: the noise of %s is neither recorded nor configured, so %.2g to %.2g %s is estimated from its "
            told = recording.name, group, level.min(), level.max(), CHANNEL_KINDS[group].unit, group
            log.warning(words + "fastest changes. If you know a better value, set sensors.%s.std", *told)
    if encoders:
        columns = [joints.names.index(name) for name in driven]
        std = np.maximum(std, _MIN_TORQUE_ERROR_FRACTION * np.maximum(np.std(joints.effort[:, columns], axis=0), 1e-3))
    period = float(np.median(np.diff(joints.t)))
    middle = grid.node_times[:-1] + grid.time_step / 2
    sample = np.clip(np.searchsorted(joints.t, middle, "right") - 1, 0, len(joints.t) - 1)
    # a step over several samples averages their noise
    held, shared = std * min(1.0, np.sqrt(period / grid.time_step)), max(1.0, period / grid.time_step)
    none = (np.zeros(len(driven)), *(np.zeros((grid.steps, len(driven))) for _ in range(3)))
    return TorqueAndAngleErrorModel(held, bias, angle, sample.astype(np.int64), shared, encoders, *none)


@dataclass(frozen=True)
class Episode:
    """A recording on the time grid of a rollout, with inputs, measurements, tracking filter and input errors."""

    recording: Recording
    grid: TimeGrid
    torque: Array  # motor torques [N m], or servo commands [rad or m], (N, nu)
    prescribed_path: Array  # (N + 1, nc)
    initial_known_coordinates: Array  # driven, then prescribed, at node 0, (nk,)
    measured_driven_angles: Array  # measured angles of the driven joints at every node, (N + 1, nu)
    measurements: tuple[SensorMeasurements, ...]
    # recorded effort of driven, then prescribed joints, if their true angle depends on it, (N + 1, nk) [N m]
    joint_loads: Array
    # measured angles, smoothed for differentiation; raw if no filter needs them, (N + 1, nu)
    smoothed_driven_angles: Array
    tracking_feedback: TrackingFeedback | None = None  # for driven joints, with gains at the nominal parameters
    known_parameters: Mapping[str, float] = field(default_factory=dict)  # values that differ among recordings
    input_errors: TorqueAndAngleErrorModel | None = None  # errors of the torques and angles that drive the rollout
    fixed_initial_state: FixedInitialState | None = None  # given or fitted to points; else it is an equilibrium
    # index of the estimation episode whose initial state and local parameters this held-out part of it shares
    initial_state_shared_with: int | None = None
    equilibrium_guess: Array | None = None  # near the initial equilibrium; None: that of least energy, (n,)

    @property
    def has_biases_treated_as_noise(self) -> bool:
        """Whether a sensor or its clock has a constant error of unknown size, which is treated as noise."""
        return any(np.any(own.bias_std > 0) or own.change_by_clock is not None for own in self.measurements)

    @property
    def name(self) -> str:
        """The name of the episode's recording."""
        return self.recording.name


def prepare_episode(
    functions: ModelFunctions,
    recording: Recording,
    options: ProblemOptions,
    theta: Array,
    free: Sequence[str],
    like: Episode | None = None,
) -> Episode:
    """Prepare a recording for prediction: place its inputs and measurements on the nodes of a time grid.

    The nominal parameters `theta` are used to convert encoder noise to effort and to compute the tracking filter's
    gains; those of `like`, an episode with the same arms, are taken if its motion and torques are the same. Raises
    `DataError` if the recording does not fit the model, is too short, or has no noise level.
    """
    step, system = functions.step, functions.step.system
    efforts = options.sensors.get(joint_sensors.JOINT_EFFORT_SENSOR_KEY, SensorOptions())
    recording = recording.with_effort_sampling_kind(efforts.effort_sampling_kind)
    grid = rollout_time_grid(recording, step.time_step, options.duration)
    if system.driven and recording.joints is None:
        what = "the arms of the model are driven by torques, but the recording has no joints"
        where, hint = f"recording '{recording.name}'", "import it together with a file that has its joints"
        raise DataError(what, where=where, allowed="a recording with the group `joints`", hint=hint)
    low_pass, clamps = ZeroPhaseLowPassFilter(options.path_cutoff), options.clamp_pose_point_names
    path = prescribed_coordinates_at_nodes(recording, system, grid, low_pass, clamps)
    arm = smooth = np.zeros((grid.steps + 1, 0))
    torque = np.zeros((grid.steps, 0))
    if recording.joints is not None:
        read = (recording.joints, system.driven, grid, recording.name)
        torque = step_mean_inputs(*read, servos=system.servos)
        arm = smoothed_joint_angles_at_nodes(*read, ZeroPhaseLowPassFilter(math.inf))
        smooth = smoothed_joint_angles_at_nodes(*read, low_pass) if options.arm_tracking_feedback == "lqr" else arm
    uncertain = options.has_uncertain_point_clocks and any("damping" in name for name in free)
    effects = [own for own in system.effects if isinstance(own, EffectBase)]
    estimated = [own for own in effects if not {*free}.isdisjoint(own.amplitude_parameter_names)]
    sticking = {own.location: own.max_sticking_speed for own in estimated if own.max_sticking_speed}
    samples = _samples(step, recording, options, theta, grid, uncertain, sticking)
    load = np.zeros((grid.steps + 1, len(system.driven) + len(system.prescribed)))
    if functions.input_corrections.angles_depend_on_effort:
        parts = ((system.driven, low_pass), (system.prescribed, slow_effort_filter(options.path_cutoff)))
        load = np.hstack([smoothed_efforts_at_nodes(recording, names, grid, own) for names, own in parts if names])
    known_parameters = options.parameters_by_recording.get(recording.name, {})
    start = errors = None
    if (state := options.known_initial_states.get(recording.name)) is not None:
        start = FixedInitialState(float_array_with_checked_shape("known_start", state, (step.sizes["nx"],)))
    if options.weighting != "paper":
        errors = _recorded_input_errors(recording, system, grid, options.sensors, samples)
    inputs = (recording, grid, torque, path, np.concatenate([arm[0], path[0]]), arm)
    episode = Episode(*inputs, samples, load, smooth, None, known_parameters, errors, start)
    if like is not None and like.grid == grid:
        pairs = (like.torque, torque), (like.smoothed_driven_angles, smooth), (like.measured_driven_angles, arm)
        if all(np.array_equal(*pair) for pair in pairs):
            arms = np.array(system.actuated_coordinate_indices, np.int32)
            index, loop = np.concatenate([arms, system.n_coordinates + arms]), like.tracking_feedback
            return replace(episode, tracking_feedback=loop and replace(loop, state_indices=index[: loop.gain.shape[2]]))
    return _tracked(episode, functions, options, theta)


def _tracked(episode: Episode, functions: ModelFunctions, options: ProblemOptions, theta: Array) -> Episode:
    """The episode with the tracking filter of its driven joints; its gains are computed at `theta`."""
    step = functions.step
    if not step.system.driven or step.system.servos or options.arm_tracking_feedback == "none":
        return episode
    if options.arm_tracking_feedback == "proportional":
        loop = proportional_tracking_feedback(step, episode.measured_driven_angles, options.arm_proportional_gains)
    else:
        plain = functions.effect_momentum_calculator.parameter_values_with_neutral_effects(theta)
        known = episode.smoothed_driven_angles, episode.torque, plain
        loop = lqr_tracking_feedback(step, *known, functions.arms_only_integrator_step)
    return replace(episode, tracking_feedback=loop)


def truncate_episode(episode: Episode, steps: int) -> Episode:
    """Shorten an episode to its first `steps` steps and the measurements in them."""
    steps, samples = min(steps, episode.grid.steps), []
    for entry in episode.measurements:
        last = min(entry.predictable_nodes[1], steps - (episode.grid.steps - entry.predictable_nodes[1]))
        early = entry.node + entry.fraction <= last + 1e-9
        parts = {name: getattr(entry, name)[early] for name in ("node", "fraction", "value", "weight", "std")}
        for name in ("noise_correlation", "change_by_clock"):
            parts |= {} if getattr(entry, name) is None else {name: getattr(entry, name)[early]}
        samples.append(replace(entry, **parts, predictable_nodes=(entry.predictable_nodes[0], last)))
    loop, errors = episode.tracking_feedback, episode.input_errors
    at_nodes = ("prescribed_path", "measured_driven_angles", "joint_loads", "smoothed_driven_angles")
    return replace(
        episode,
        grid=replace(episode.grid, steps=steps),
        torque=episode.torque[:steps],
        measurements=tuple(samples),
        tracking_feedback=loop and replace(loop, gain=loop.gain[:steps], reference=loop.reference[:steps]),
        input_errors=errors and errors._truncated_to_steps(steps),
        **{name: getattr(episode, name)[: steps + 1] for name in at_nodes},
    )


def mass_matrix_diagonal_at_zero(step: Step, theta: Array, names: tuple[str, ...]) -> Array:
    """Return the mass matrix's diagonal entries (k,) of the named joints at zero configuration [kg m^2 or kg]."""
    sizes = step.sizes
    n, zero = sizes["n"], np.zeros
    state = [zero(n), zero(n), zero(n), zero(sizes["nz"]), zero(sizes["nz"]), zero(sizes["m"]), zero(sizes["nu"])]
    pairs = np.array(step.model.functions.function("linear")(*state, theta, step.time_step)[0]).ravel()
    plus, _, lower, upper = (pairs[6 * n * i : 6 * n * (i + 1)].reshape(6, n) for i in range(4))
    mass = np.sum(plus * (upper - lower), axis=0) * step.time_step / 2
    return np.asarray(mass[[step.system.mechanism.joint_index(name) for name in names]])


def _joint_mass_matrices(step: Step, theta: Array, names: tuple[str, ...], angles: Array) -> Array:
    """Mass matrix block of the named joints in several configurations, shape (K, k, k)."""
    places = [step.system.mechanism.joint_index(name) for name in names]
    q = np.zeros((len(angles), step.sizes["n"]))
    q[:, places] = angles
    velocity = np.zeros((len(places), *q.shape))  # unit velocity of every joint in every configuration, together
    velocity[range(len(places)), :, places] = 1.0
    still = np.broadcast_to(q, velocity.shape).reshape(-1, q.shape[1])
    momentum = generalized_momentum_from_velocity(step, still, velocity.reshape(still.shape), theta)
    return momentum.reshape(velocity.shape)[:, :, places].transpose(1, 2, 0)


def _samples(
    step: Step,
    recording: Recording,
    options: ProblemOptions,
    theta: Array,
    grid: TimeGrid,
    has_uncertain_clocks: bool,
    sticking_speeds: Mapping[str, float],
) -> tuple[SensorMeasurements, ...]:
    around = SensorDataInputs(
        step.system,
        recording,
        lambda group: options.sensors.get(group, SensorOptions()),
        grid.node_times,
        grid.time_step,
        max(1, round(options.sampling_time_step / grid.time_step)),
        zero_phase_effort_filter(options.path_cutoff),
        ZeroPhaseLowPassFilter(options.path_cutoff),
        partial(_joint_mass_matrices, step, theta),
        has_uncertain_clocks,
        sticking_speeds,
    )
    found = [data for kind in SENSOR_READERS for data in SENSOR_READERS[kind](around)]
    if options.weighting == "paper":
        found = [data for data in found if data.sensor.has_paper_weight]
    found.sort(key=lambda data: bool(data.sensor.effort_joints))  # places before efforts, which follow from the motion
    samples = tuple(measurements_located_on_grid(data, grid, recording.name) for data in found)
    if not any(s.n_residuals for s in samples):
        what, where = "no sensor of the model has a measurement in the recording", f"recording '{recording.name}'"
        what += ", which has no efforts" * (recording.joints is not None and recording.joints.effort is None)
        lost = [group.name for group in recording.points if np.isnan(group.position).all()]
        what += f". All readings of {', '.join(lost)} are missing (NaN)" if lost else ""
        if options.weighting == "paper":
            what = "steepest_descent and weighting: paper compare points or efforts only, and the recording has none"
        hint = "record efforts or points; if the file has some, set use: true or frame_by_recorded_name under `sensors`"
        if found and not lost:
            what = f"no reading of the recording can be used in {grid.node_times[-1] - grid.node_times[0]:.3g} s: all "
            what += "are missing, of joints at rest, or nearer to an end than the filter of problem.path_cutoff reaches"
            hint = "set a longer problem.duration, or use another recording"
        raise DataError(what, where=where, allowed="points on the model's frames, or channels of its joints", hint=hint)
    return tuple(measurements_with_paper_weights(s, grid) for s in samples) if options.weighting == "paper" else samples


def with_encoder_noise_in_effort_std(step: Step, episode: Episode, options: ProblemOptions, theta: Array) -> Episode:
    """Return an episode whose encoder noise is converted to noise of compared efforts at the parameters `theta`."""
    again = _samples(step, episode.recording, options, theta, episode.grid, False, {})
    found = {samples.sensor.group_name: samples for samples in again if samples.sensor.effort_joints}

    def changed(own: SensorMeasurements) -> SensorMeasurements:
        new = found.get(own.sensor.group_name)
        if new is None or own.value.shape != new.value.shape:
            return own
        weight = np.where(own.weight > 0, new.weight, 0.0)
        std = np.where(np.isnan(own.std), np.nan, new.std)
        return replace(own, weight=weight, std=std, noise_correlation=new.noise_correlation)

    return replace(episode, measurements=tuple(map(changed, episode.measurements)))


EpisodeAndPredictionOrFailure = tuple[Episode, EpisodePrediction | str]
"""A recording and its prediction, or the reason why it has no prediction."""
