"""Episodes: recordings placed on the nodes of a rollout (inputs, measurements, tracking filter)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from yid_ocp.data.recording import Recording
from yid_ocp.errors import DataError
from yid_ocp.integrator.lqr import lqr_filter, proportional_filter
from yid_ocp.integrator.rollout import momentum_of
from yid_ocp.integrator.step import Feedback, Step, check_shape
from yid_ocp.problem.functions import ModelFunctions
from yid_ocp.problem.grid import Grid, make_grid
from yid_ocp.problem.inputs import held_inputs, joint_loads, measured_angles, prescribed_path
from yid_ocp.problem.low_pass import LowPass, effort_filter
from yid_ocp.problem.measurements import Measurements, paper_weighting, placed
from yid_ocp.problem.noise import InputErrors, input_errors
from yid_ocp.problem.options import ProblemOptions, SensorOptions
from yid_ocp.problem.start import FittedStart
from yid_ocp.sensors import SENSORS, Surroundings
from yid_ocp.sensors.joints import EFFORT, POSITION

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Episode:
    """One recording placed on the nodes of a rollout: inputs, measurements, tracking filter, input errors.

    Attributes
    ----------
    recording : Recording
    grid : Grid
    torque : ndarray, shape (N, nu)
        Of motors, or what servos are commanded.
    path : ndarray, shape (N + 1, nc)
    posture : ndarray, shape (nk,)
        Known coordinates (driven, then prescribed) at node 0.
    measured_arm : ndarray, shape (N + 1, nu)
        Measured angles of the driven joints at every node.
    samples : tuple of Measurements
    load : ndarray, shape (N + 1, nk)
        Recorded effort of driven, then prescribed joints, where an effect makes their true angle depend on it.
    smooth_arm : ndarray, shape (N + 1, nu)
        Measured angles of the driven joints, smooth enough to be differenced; as measured where no filter needs them.
    feedback : Feedback or None
        Tracking filter of the driven joints with gains computed at the nominal parameters.
    values : mapping of str to float
        Known values of parameters that differ from recording to recording.
    errors : InputErrors or None
        Of the torques and angles that drive the rollout; None where there are none.
    start : FittedStart or None
        Initial state that is given or was fitted to points; None where it is an equilibrium.
    shares_start_of : int, optional
        Index of the estimation episode whose initial state this held-out part of the same recording shares.
    near : ndarray, optional, shape (n,)
        Configuration near the initial equilibrium, where that is not the one of least energy.
    """

    recording: Recording
    grid: Grid
    torque: Array
    path: Array
    posture: Array
    measured_arm: Array
    samples: tuple[Measurements, ...]
    load: Array
    smooth_arm: Array
    feedback: Feedback | None = None
    values: Mapping[str, float] = field(default_factory=dict)
    errors: InputErrors | None = None
    start: FittedStart | None = None
    shares_start_of: int | None = None
    near: Array | None = None

    @property
    def tracking(self) -> Feedback | None:
        """Tracking filter with the smoothed motion as its reference where that is known."""
        if self.feedback is None or self.errors is None or self.errors.followed is None:
            return self.feedback
        return replace(self.feedback, reference=self.errors.followed)

    @property
    def has_constant_errors(self) -> bool:
        """Whether a sensor may have a constant error over the recording, which counts as noise."""
        return any(np.any(samples.bias_std > 0) for samples in self.samples)

    @property
    def name(self) -> str:
        """Name of the recording."""
        return self.recording.name


def prepare_episode(functions: ModelFunctions, recording: Recording, options: ProblemOptions, theta: Array) -> Episode:
    """Place a recording on the nodes of a rollout: torques, paths, joint coordinates, samples, tracking filter.

    Parameters
    ----------
    functions : ModelFunctions
    recording : Recording
    options : ProblemOptions
    theta : ndarray, shape (ntheta,)
        Nominal parameters, at which encoder noise is converted to effort and the filter's gains are computed.

    Raises
    ------
    DataError
        The recording does not fit the model, is too short, or states no noise level.
    """
    step, system = functions.step, functions.step.system
    recording = recording.with_effort_kind(options.sensors.get(EFFORT, SensorOptions()).kind)
    grid = make_grid(recording, step.time_step, options.duration)
    if system.driven and recording.joints is None:
        raise DataError("the model's arms are driven but the recording has no joints", where=recording.name)
    low_pass = LowPass(options.path_cutoff)
    path = prescribed_path(recording, system, grid, low_pass, options.clamps)
    arm = smooth = np.zeros((grid.steps + 1, 0))
    torque = np.zeros((grid.steps, 0))
    if recording.joints is not None:
        read = (recording.joints, system.driven, grid, recording.name)
        torque, arm = held_inputs(*read, servos=system.servos), measured_angles(*read, LowPass(math.inf))
        smooth = measured_angles(*read, low_pass) if options.feedback == "lqr" else arm
    samples = _samples(step, recording, options, theta, grid)
    known = (*system.driven, *system.prescribed)
    load = np.zeros((grid.steps + 1, len(known)))
    if functions.corrections.angles_need_effort:
        load = joint_loads(recording, known, grid, low_pass)
    start = options.known_start.get(recording.name)
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
        values=options.recording_values.get(recording.name, {}),
        errors=None
        if options.weighting == "paper"
        else input_errors(recording, system, grid, options.sensors, samples),
        start=None if start is None else FittedStart(check_shape("known_start", start, (step.sizes["nx"],))),
    )
    return _tracked(episode, functions, options, theta)


def _tracked(episode: Episode, functions: ModelFunctions, options: ProblemOptions, theta: Array) -> Episode:
    """The episode with the tracking filter of its driven joints, its gains worked out at given parameters."""
    step = functions.step
    if not step.system.driven or step.system.servos or options.feedback == "none":
        return episode
    if options.feedback == "proportional":
        return replace(episode, feedback=proportional_filter(step, episode.measured_arm, options.gains))
    plain = functions.momentum_shift.without(theta)
    loop = lqr_filter(step, episode.smooth_arm, episode.torque, plain, arms=functions.arms)
    return replace(episode, feedback=loop)


def beginning(episode: Episode, steps: int) -> Episode:
    """Truncate an episode to its first steps and the measurements in them."""
    steps = min(steps, episode.grid.steps)
    samples = []
    for entry in episode.samples:
        last = min(entry.span[1], steps - (episode.grid.steps - entry.span[1]))
        early = entry.node + entry.fraction <= last + 1e-9
        parts = {name: getattr(entry, name)[early] for name in ("node", "fraction", "value", "weight", "std")}
        if entry.correlation is not None:
            parts["correlation"] = entry.correlation[early]
        samples.append(replace(entry, **parts, span=(entry.span[0], last)))
    whole, errors = episode.feedback, episode.errors
    return replace(
        episode,
        grid=replace(episode.grid, steps=steps),
        torque=episode.torque[:steps],
        path=episode.path[: steps + 1],
        measured_arm=episode.measured_arm[: steps + 1],
        samples=tuple(samples),
        load=episode.load[: steps + 1],
        smooth_arm=episode.smooth_arm[: steps + 1],
        feedback=None if whole is None else Feedback(whole.index, whole.gain[:steps], whole.reference[:steps]),
        errors=None if errors is None else errors.until(steps),
    )


def apparent_inertia(step: Step, theta: Array, names: tuple[str, ...]) -> Array:
    """Mass matrix diagonal of the named joints at the zero configuration, shape (k,) [kg m^2 or kg]."""
    sizes = step.sizes
    n, zero = sizes["n"], np.zeros
    state = [zero(n), zero(n), zero(n), zero(sizes["nz"]), zero(sizes["nz"]), zero(sizes["m"]), zero(sizes["nu"])]
    pairs = np.array(step.functions.linear(*state, theta, step.time_step)[0]).ravel()
    plus, _, lower, upper = (pairs[6 * n * i : 6 * n * (i + 1)].reshape(6, n) for i in range(4))
    mass = np.sum(plus * (upper - lower), axis=0) * step.time_step / 2
    return np.asarray(mass[[step.system.mechanism.joint_index(name) for name in names]])


def coupled_inertia(step: Step, theta: Array, names: tuple[str, ...], angles: Array) -> Array:
    """Mass matrix block of the named joints in several configurations, shape (K, k, k).

    Parameters
    ----------
    step : Step
    theta : ndarray, shape (ntheta,)
    names : tuple of str
    angles : ndarray, shape (K, k)
        Of these joints [rad or m]; all others are at zero.
    """
    places = [step.system.mechanism.joint_index(name) for name in names]
    q = np.zeros((len(angles), step.sizes["n"]))
    q[:, places] = angles
    # every joint's unit velocity in every configuration, in one go
    velocity = np.zeros((len(places), *q.shape))
    velocity[range(len(places)), :, places] = 1.0
    still = np.broadcast_to(q, velocity.shape).reshape(-1, q.shape[1])
    momentum = momentum_of(step, still, velocity.reshape(still.shape), theta).reshape(velocity.shape)
    return momentum[:, :, places].transpose(1, 2, 0)


def _samples(
    step: Step, recording: Recording, options: ProblemOptions, theta: Array, grid: Grid
) -> tuple[Measurements, ...]:
    around = Surroundings(
        step.system,
        recording,
        lambda group: options.sensors.get(group, SensorOptions()),
        grid.times,
        grid.time_step,
        effort_filter(options.path_cutoff),
        partial(coupled_inertia, step, theta),
    )
    found = [data for kind in SENSORS for data in SENSORS[kind](around)]
    if options.weighting == "paper":
        # its cost is in square metres
        found = [data for data in found if data.sensor.group != POSITION]
    # places before efforts, which follow from the motion
    found.sort(key=lambda data: bool(data.sensor.efforts))
    samples = tuple(placed(data, grid, recording.name) for data in found)
    if not any(s.count for s in samples):
        raise DataError(
            "the recording holds no measurement that the model could be compared with",
            where=recording.name,
            hint="check `sensors` and the names of the recorded points",
        )
    return tuple(paper_weighting(s, grid) for s in samples) if options.weighting == "paper" else samples
