"""Episodes: recordings placed on the nodes of a rollout (inputs and their errors, measurements, tracking filter)."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from yid_ocp.arrays import Array, IntArray
from yid_ocp.data.recording import Recording
from yid_ocp.errors import DataError
from yid_ocp.integrator.statics import Equilibrium
from yid_ocp.integrator.step import Step, checked_float_array, generalized_momentum
from yid_ocp.integrator.step_model import Rollout, TrackingFeedback
from yid_ocp.integrator.tracking_feedback import lqr_feedback, proportional_feedback
from yid_ocp.model.system import System
from yid_ocp.problem.initial_state_fit import FixedInitialState
from yid_ocp.problem.measurements import (
    Measurements,
    TimeGrid,
    locate_measurements_on_grid,
    make_time_grid,
    with_paper_weights,
)
from yid_ocp.problem.model_functions import ModelFunctions
from yid_ocp.problem.options import ProblemOptions, SensorOptions
from yid_ocp.problem.recorded_inputs import (
    mean_step_inputs,
    prescribed_path,
    smoothed_joint_angles,
    smoothed_joint_efforts,
)
from yid_ocp.problem.signal_filters import LowPassFilter, effort_filter
from yid_ocp.sensors import CHANNEL_KINDS, SENSOR_READERS, SensorReadingContext
from yid_ocp.sensors.joints import (
    JOINT_EFFORT_GROUP_NAME,
    JOINT_POSITION_GROUP_NAME,
    PositionSensor,
    is_noise_std_stated,
    joint_angle_noise_std,
    joint_torque_bias_std,
    joint_torque_noise_std,
)


@dataclass(frozen=True)
class EpisodePrediction:
    """Rollout of one episode, its predicted sensor readings and their sensitivities.

    Attributes
    ----------
    equilibrium : Equilibrium or None
        Equilibrium from which the rollout starts.
    predicted_outputs : tuple of ndarray, shape (M, k) each
        Prediction of every sample, in the sensor's unit.
    output_sensitivities : tuple of ndarray, shape (M, k, d) each, or None
    equilibrium_guess : ndarray, shape (n,), or None
        Configuration at `equilibrium`, the initial guess for similar parameters.
    torque_correction : ndarray, shape (N, nu), or None
        Torque that the tracking filter adds to the recorded one [N m], where encoders are measurements.
    torque_correction_sensitivity : ndarray, shape (N, nu, d), or None
        Its derivative, with `output_sensitivities`.
    """

    rollout: Rollout
    equilibrium: Equilibrium | None
    predicted_outputs: tuple[Array, ...]
    output_sensitivities: tuple[Array, ...] | None
    equilibrium_guess: Array | None = None
    torque_correction: Array | None = None
    torque_correction_sensitivity: Array | None = None

    @property
    def torque_correction_and_sensitivity(self) -> Array | None:
        """`torque_correction` followed by the columns of its derivative where it is known, shape (N, nu, 1 + d)."""
        if self.torque_correction is None:
            return None
        known = self.torque_correction[:, :, None]
        return (
            known
            if self.torque_correction_sensitivity is None
            else np.concatenate([known, self.torque_correction_sensitivity], axis=2)
        )


@dataclass(frozen=True)
class InitialState:
    """Initial state of a rollout with its derivative.

    Attributes
    ----------
    state : ndarray, shape (nx,)
        (q, p, z)
    state_sensitivity : ndarray, shape (nx, d)
        Derivative by (wanted parameters, offset of the start).
    equilibrium : Equilibrium or None
        The equilibrium, where it is one.
    failure_message : str
        What went wrong; empty where all is well.
    """

    state: Array
    state_sensitivity: Array
    equilibrium: Equilibrium | None
    failure_message: str


log = logging.getLogger(__name__)

_MIN_TORQUE_ERROR_FRACTION = 1e-3
"""Least error of a torque beside encoders, in parts of how far it varies: nothing that is computed follows them for
seconds without correction."""


@dataclass(frozen=True)
class InputErrorModel:
    """Noise levels and current estimates of the torque and angle errors that drive one recording's rollout.

    Attributes
    ----------
    torque_std, torque_bias_std, angle_std : ndarray, shape (nu,)
        Of w in a step and of b [N m], of v [rad].
    sample_of_step : ndarray of int, shape (N,)
        Recorded sample that each step's torque comes from: w is the same in all its steps.
    encoder_noise_steps : float
        Number of steps that share one encoder sample's noise through interpolation.
    has_encoder_measurements : bool
        Whether the encoders are measurements.
    torque_bias : ndarray, shape (nu,)
        Value of b that is subtracted from the recorded torque [N m].
    torque_noise : ndarray, shape (N, nu)
        Value of w that is subtracted in every step [N m].
    recorded_torque_noise : ndarray, shape (N, nu)
        Noise of the recorded torque that w implies, subtracted before effects on torques apply [N m].
    transmitted_torque_noise : ndarray, shape (N, nu)
        Part of w that subtracting `recorded_torque_noise` already removes from the acting torque [N m].
    smoothed_reference : ndarray, shape (N, nb), or None
        Smoothed reference of the tracking filter in place of the measured motion.
    """

    torque_std: Array
    torque_bias_std: Array
    angle_std: Array
    sample_of_step: IntArray
    encoder_noise_steps: float
    has_encoder_measurements: bool
    torque_bias: Array
    torque_noise: Array
    recorded_torque_noise: Array
    transmitted_torque_noise: Array
    smoothed_reference: Array | None = None

    @property
    def total_torque_error(self) -> Array:
        """Estimated torque error in every step, constant offset plus noise, shape (N, nu) [N m]."""
        return self.torque_bias + self.torque_noise

    @property
    def torque_error_subtracted_after_effects(self) -> Array:
        """Part of the torque error still to be subtracted after effects on torques apply, shape (N, nu) [N m]."""
        return self.total_torque_error - self.transmitted_torque_noise

    @property
    def with_torque_bias_only(self) -> InputErrorModel:
        """The same errors with the torques' constant offset alone: noise and smoothed reference are dropped."""
        none = np.zeros_like(self.torque_noise)
        return replace(
            self, torque_noise=none, recorded_torque_noise=none, transmitted_torque_noise=none, smoothed_reference=None
        )

    def truncated_to_steps(self, steps: int) -> InputErrorModel:
        """The same error model restricted to the first `steps` steps of the rollout."""
        first = {
            name: getattr(self, name)[:steps]
            for name in ("sample_of_step", "torque_noise", "recorded_torque_noise", "transmitted_torque_noise")
        }
        return replace(
            self,
            **first,
            smoothed_reference=None if self.smoothed_reference is None else self.smoothed_reference[:steps],
        )


def _recorded_input_errors(
    recording: Recording,
    system: System,
    grid: TimeGrid,
    sensors: Mapping[str, SensorOptions],
    samples: Sequence[Measurements],
) -> InputErrorModel | None:
    """Error levels of the torques and angles that drive a recording's rollout; None where there are none."""
    joints, driven = recording.joints, system.driven
    if joints is None or joints.effort is None or not driven or system.servos:
        return None
    effort, position = (
        sensors.get(group, SensorOptions()) for group in (JOINT_EFFORT_GROUP_NAME, JOINT_POSITION_GROUP_NAME)
    )
    std = joint_torque_noise_std(joints, driven, effort, recording.name)
    bias = joint_torque_bias_std(joints, driven, effort)
    encoders = any(isinstance(entry.sensor, PositionSensor) for entry in samples)
    if not encoders and not np.any(std > 0) and not np.any(bias > 0):
        return None
    angle = joint_angle_noise_std(joints, driven, position, recording.name)
    for group, choice, level in ((JOINT_EFFORT_GROUP_NAME, effort, std), (JOINT_POSITION_GROUP_NAME, position, angle)):
        if not is_noise_std_stated(joints, group, choice):
            words = "%s: the noise of %s is neither recorded nor configured; %.2g to %.2g %s estimated from its fastest"
            log.warning(words + " changes", recording.name, group, level.min(), level.max(), CHANNEL_KINDS[group].unit)
    if encoders:
        columns = [joints.names.index(name) for name in driven]
        std = np.maximum(std, _MIN_TORQUE_ERROR_FRACTION * np.maximum(np.std(joints.effort[:, columns], axis=0), 1e-3))
    period = float(np.median(np.diff(joints.t)))
    middle = grid.node_times[:-1] + grid.time_step / 2
    sample = np.clip(np.searchsorted(joints.t, middle, "right") - 1, 0, len(joints.t) - 1)
    return InputErrorModel(
        # a step that spans several samples averages them
        std * min(1.0, np.sqrt(period / grid.time_step)),
        bias,
        angle,
        sample.astype(np.int64),
        max(1.0, period / grid.time_step),
        encoders,
        np.zeros(len(driven)),
        *(np.zeros((grid.steps, len(driven))) for _ in range(3)),
    )


@dataclass(frozen=True)
class Episode:
    """One recording placed on the nodes of a rollout: inputs, measurements, tracking filter, input errors.

    Attributes
    ----------
    torque : ndarray, shape (N, nu)
        Of motors, or what servos are commanded.
    prescribed_path : ndarray, shape (N + 1, nc)
    initial_known_coordinates : ndarray, shape (nk,)
        Known coordinates (driven, then prescribed) at node 0.
    measured_driven_angles : ndarray, shape (N + 1, nu)
        Measured angles of the driven joints at every node.
    joint_loads : ndarray, shape (N + 1, nk)
        Recorded effort of driven, then prescribed joints, where an effect makes their true angle depend on it.
    smoothed_driven_angles : ndarray, shape (N + 1, nu)
        Measured angles of the driven joints, smooth enough to be differenced; as measured where no filter needs them.
    tracking_feedback : TrackingFeedback or None
        Tracking filter of the driven joints with gains computed at the nominal parameters.
    known_parameters : mapping of str to float
        Known values of parameters that differ from recording to recording.
    input_errors : InputErrorModel or None
        Of the torques and angles that drive the rollout; None where there are none.
    fixed_initial_state : FixedInitialState or None
        Initial state that is given or was fitted to points; None where it is an equilibrium.
    initial_state_shared_with : int, optional
        Index of the estimation episode whose initial state this held-out part of the same recording shares.
    equilibrium_guess : ndarray, optional, shape (n,)
        Configuration near the initial equilibrium, where that is not the one of least energy.
    """

    recording: Recording
    grid: TimeGrid
    torque: Array
    prescribed_path: Array
    initial_known_coordinates: Array
    measured_driven_angles: Array
    measurements: tuple[Measurements, ...]
    joint_loads: Array
    smoothed_driven_angles: Array
    tracking_feedback: TrackingFeedback | None = None
    known_parameters: Mapping[str, float] = field(default_factory=dict)
    input_errors: InputErrorModel | None = None
    fixed_initial_state: FixedInitialState | None = None
    initial_state_shared_with: int | None = None
    equilibrium_guess: Array | None = None

    @property
    def feedback_about_smoothed_motion(self) -> TrackingFeedback | None:
        """Tracking filter with the smoothed motion as its reference where that is known."""
        if self.tracking_feedback is None or self.input_errors is None or self.input_errors.smoothed_reference is None:
            return self.tracking_feedback
        return replace(self.tracking_feedback, reference=self.input_errors.smoothed_reference)

    @property
    def has_uncertain_sensor_biases(self) -> bool:
        """Whether a sensor may have a constant error over the recording, which counts as noise."""
        return any(np.any(samples.bias_std > 0) for samples in self.measurements)

    @property
    def name(self) -> str:
        """Name of the recording."""
        return self.recording.name


def prepare_episode(functions: ModelFunctions, recording: Recording, options: ProblemOptions, theta: Array) -> Episode:
    """Place a recording on the nodes of a rollout: torques, paths, joint coordinates, samples, tracking filter.

    Parameters
    ----------
    theta : ndarray, shape (ntheta,)
        Nominal parameters, at which encoder noise is converted to effort and the filter's gains are computed.

    Raises
    ------
    DataError
        The recording does not fit the model, is too short, or states no noise level.
    """
    step, system = functions.step, functions.step.system
    recording = recording.with_effort_kind(options.sensors.get(JOINT_EFFORT_GROUP_NAME, SensorOptions()).effort_kind)
    grid = make_time_grid(recording, step.time_step, options.duration)
    if system.driven and recording.joints is None:
        raise DataError("the model's arms are driven but the recording has no joints", where=recording.name)
    low_pass = LowPassFilter(options.path_cutoff)
    path = prescribed_path(recording, system, grid, low_pass, options.clamp_paths)
    arm = smooth = np.zeros((grid.steps + 1, 0))
    torque = np.zeros((grid.steps, 0))
    if recording.joints is not None:
        read = (recording.joints, system.driven, grid, recording.name)
        torque = mean_step_inputs(*read, servos=system.servos)
        arm = smoothed_joint_angles(*read, LowPassFilter(math.inf))
        smooth = smoothed_joint_angles(*read, low_pass) if options.feedback == "lqr" else arm
    samples = _samples(step, recording, options, theta, grid)
    known = (*system.driven, *system.prescribed)
    load = np.zeros((grid.steps + 1, len(known)))
    if functions.input_corrections.angles_depend_on_effort:
        load = smoothed_joint_efforts(recording, known, grid, low_pass)
    start = options.known_initial_states.get(recording.name)
    episode = Episode(
        recording,
        grid,
        torque,
        path,
        np.concatenate([arm[0], path[0]]),
        arm,
        samples,
        load,
        smooth,
        known_parameters=options.parameters_by_recording.get(recording.name, {}),
        input_errors=None
        if options.weighting == "paper"
        else _recorded_input_errors(recording, system, grid, options.sensors, samples),
        fixed_initial_state=None
        if start is None
        else FixedInitialState(checked_float_array("known_start", start, (step.sizes["nx"],))),
    )
    return _tracked(episode, functions, options, theta)


def _tracked(episode: Episode, functions: ModelFunctions, options: ProblemOptions, theta: Array) -> Episode:
    """The episode with the tracking filter of its driven joints, its gains worked out at given parameters."""
    step = functions.step
    if not step.system.driven or step.system.servos or options.feedback == "none":
        return episode
    if options.feedback == "proportional":
        return replace(
            episode,
            tracking_feedback=proportional_feedback(step, episode.measured_driven_angles, options.proportional_gains),
        )
    plain = functions.momentum_shift.theta_without_effects(theta)
    loop = lqr_feedback(
        step, episode.smoothed_driven_angles, episode.torque, plain, arms=functions.arms_only_integrator_step
    )
    return replace(episode, tracking_feedback=loop)


def truncate_episode(episode: Episode, steps: int) -> Episode:
    """Truncate an episode to its first steps and the measurements in them."""
    steps = min(steps, episode.grid.steps)
    samples = []
    for entry in episode.measurements:
        last = min(entry.predictable_nodes[1], steps - (episode.grid.steps - entry.predictable_nodes[1]))
        early = entry.node + entry.fraction <= last + 1e-9
        parts = {name: getattr(entry, name)[early] for name in ("node", "fraction", "value", "weight", "std")}
        if entry.noise_correlation is not None:
            parts["noise_correlation"] = entry.noise_correlation[early]
        samples.append(replace(entry, **parts, predictable_nodes=(entry.predictable_nodes[0], last)))
    whole, errors = episode.tracking_feedback, episode.input_errors
    return replace(
        episode,
        grid=replace(episode.grid, steps=steps),
        torque=episode.torque[:steps],
        prescribed_path=episode.prescribed_path[: steps + 1],
        measured_driven_angles=episode.measured_driven_angles[: steps + 1],
        measurements=tuple(samples),
        joint_loads=episode.joint_loads[: steps + 1],
        smoothed_driven_angles=episode.smoothed_driven_angles[: steps + 1],
        tracking_feedback=None
        if whole is None
        else TrackingFeedback(whole.state_indices, whole.gain[:steps], whole.reference[:steps]),
        input_errors=None if errors is None else errors.truncated_to_steps(steps),
    )


def mass_matrix_diagonal_at_zero(step: Step, theta: Array, names: tuple[str, ...]) -> Array:
    """Mass matrix diagonal of the named joints at the zero configuration, shape (k,) [kg m^2 or kg]."""
    sizes = step.sizes
    n, zero = sizes["n"], np.zeros
    state = [zero(n), zero(n), zero(n), zero(sizes["nz"]), zero(sizes["nz"]), zero(sizes["m"]), zero(sizes["nu"])]
    pairs = np.array(step.functions.jacobian_parts(*state, theta, step.time_step)[0]).ravel()
    plus, _, lower, upper = (pairs[6 * n * i : 6 * n * (i + 1)].reshape(6, n) for i in range(4))
    mass = np.sum(plus * (upper - lower), axis=0) * step.time_step / 2
    return np.asarray(mass[[step.system.mechanism.joint_index(name) for name in names]])


def _joint_mass_matrices(step: Step, theta: Array, names: tuple[str, ...], angles: Array) -> Array:
    """Mass matrix block of the named joints in several configurations, shape (K, k, k)."""
    places = [step.system.mechanism.joint_index(name) for name in names]
    q = np.zeros((len(angles), step.sizes["n"]))
    q[:, places] = angles
    # every joint's unit velocity in every configuration, in one go
    velocity = np.zeros((len(places), *q.shape))
    velocity[range(len(places)), :, places] = 1.0
    still = np.broadcast_to(q, velocity.shape).reshape(-1, q.shape[1])
    momentum = generalized_momentum(step, still, velocity.reshape(still.shape), theta).reshape(velocity.shape)
    return momentum[:, :, places].transpose(1, 2, 0)


def _samples(
    step: Step, recording: Recording, options: ProblemOptions, theta: Array, grid: TimeGrid
) -> tuple[Measurements, ...]:
    around = SensorReadingContext(
        step.system,
        recording,
        lambda group: options.sensors.get(group, SensorOptions()),
        grid.node_times,
        grid.time_step,
        effort_filter(options.path_cutoff),
        partial(_joint_mass_matrices, step, theta),
    )
    found = [data for kind in SENSOR_READERS for data in SENSOR_READERS[kind](around)]
    if options.weighting == "paper":
        found = [data for data in found if data.sensor.has_paper_weight]
    # places before efforts, which follow from the motion
    found.sort(key=lambda data: bool(data.sensor.effort_joints))
    samples = tuple(locate_measurements_on_grid(data, grid, recording.name) for data in found)
    if not any(s.n_residuals for s in samples):
        raise DataError(
            "the recording holds no measurement that the model could be compared with",
            where=recording.name,
            hint="check `sensors` and the names of the recorded points",
        )
    return tuple(with_paper_weights(s, grid) for s in samples) if options.weighting == "paper" else samples
