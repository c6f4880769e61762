"""Search for events: short forces (pushes, snags) and wrong samples, each with location and time window.

At prescribed joints with compared efforts, the unknown force is the required minus the measured torque. At other
coordinates it is an unknown of the smoother's linear model, with all other unknowns at their estimates. In both,
`detect_force_pulses` searches for pulses on a background that depends on load. One to three outlying samples of a
sensor are an event of that sensor. A diagnosis removes events before its other steps.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.special
import threadpoolctl

from yid_ocp.arrays import Array, IntArray
from yid_ocp.diagnosis.hypotheses import hide_marked_measurements
from yid_ocp.diagnosis.pulse_detection import (
    MAX_EVENT_TIME_FRACTION,
    CompiledInverseDynamics,
    DetectedForcePulse,
    ForceEstimate,
    detect_force_pulses,
)
from yid_ocp.diagnosis.refit import RefittedModel
from yid_ocp.diagnosis.thresholds import DEFAULT_THRESHOLDS, Thresholds
from yid_ocp.effects.base import arm_joint_names
from yid_ocp.errors import SolverError
from yid_ocp.files import attributes_to_dict
from yid_ocp.inference import null_test
from yid_ocp.inference.null_test import benjamini_hochberg_mask, excess_over_sample_count, times_since_recording_start
from yid_ocp.inference.smoother import (
    SIGNIFICANT_Z,
    SmoothedUnknownsResult,
    force_log_likelihood_coefficients,
    smooth_unknown_forces_and_biases,
    smoothed_unknown_significance_mask,
)
from yid_ocp.inference.smoother_model import residual_models_with_smoother_unknowns, sensor_bias_location_name
from yid_ocp.inference.whitening import problem_with_whitening_at
from yid_ocp.parallel.threads_and_processes import map_in_threads
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.episodes import Episode, EpisodePrediction
from yid_ocp.problem.evaluation import Evaluation
from yid_ocp.problem.measurements import SensorMeasurements, measurements_minus_sensor_error_estimates
from yid_ocp.problem.options import SensorOptions
from yid_ocp.sensors.base import CHANNEL_KINDS, expand_to_joint_values
from yid_ocp.sensors.joints import quantization_step
from yid_ocp.sensors.signal_filters import zero_phase_effort_filter

_RecordingRollout = tuple[Episode, EpisodePrediction, Array]
"""A recording, its prediction and the parameters theta of the prediction."""

_INVERSE_DYNAMICS_RTOL = 0.03  # assumed error of a good model, as a fraction of the torque
_MIN_FORCE_EVENT_GAP_FRACTION = 0.1  # of the gap that force events must remove
_FORCE_INTERVAL = 0.05  # interval of constant unknown force in the search for events [s]
_MAX_SPAN_POINTS = 250  # maximum number of points of a force history processed together
_MAX_WRONG_SAMPLES = 3  # largest number of consecutive wrong samples; more are a gap or a stuck channel
_STENCIL_STEPS = (4, 7, 10)  # distances [samples] of the points of a cubic around a sample that may be wrong
_NEIGHBOUR_COUNT = 20  # number of samples on either side with which a sample is compared
_MIN_NEIGHBOUR_RATIO = 3.0  # ratio of a wrong sample's deviation to the largest one of its neighbours
_MIN_RECURRENCE_OVERLAP = 0.5  # smallest overlap of two windows at the same time, as a fraction of the longer one
_MAX_RECURRING_FRACTION = 0.5  # fraction of recurring forces above which some belong to the motion
_WRONG_SAMPLE_Z = 8.0  # smallest deviation, in stds of noise and robust stds of its neighbours


@dataclass(frozen=True)
class ForceOrFaultEvent:
    """A brief local disturbance: an external force on one coordinate, or wrong samples of one channel."""

    recording: str
    location: str
    channel: str  # coordinate on which the force acted, or channel with the wrong samples
    kind: str  # "force" or "sample"
    start_time: float  # since the start of the recording [s]
    end_time: float
    # in `unit`: signed value of largest size, of the force beyond model and recording, or of measured minus true value
    peak_value: float
    impulse: float  # integral over time [unit x s]
    impulse_std: float  # standard deviation of the impulse, which includes the assumed model error
    unit: str
    detected_pulse: DetectedForcePulse | None = None  # shape of a force

    @property
    def text(self) -> str:
        """A text that states what happened in which channel, when and in which recording."""
        what = {"force": "push of", "sample": "wrong samples of"}[self.kind]
        return f"{what} {self.channel} at {self.start_time:.2f} to {self.end_time:.2f} s of '{self.recording}'"

    def _overlap(self, other: ForceOrFaultEvent) -> float:
        """Return the common time [s] of two events, each since its recording began; negative without overlap."""
        return min(self.end_time, other.end_time) - max(self.start_time, other.start_time)

    def to_dict(self) -> dict[str, Any]:
        """Convert the event to an entry of `events` in result.json."""
        names = "recording location channel kind from=start_time to=end_time impulse peak=peak_value unit"
        return attributes_to_dict(self, f"{names} std=impulse_std")


@dataclass(frozen=True)
class _Overspeed:
    """Time after which efforts are ignored, because a joint moves faster than `Thresholds.max_joint_speed`."""

    recording: str
    joint: str
    start_time: float  # since the start of the recording [s]


@dataclass(frozen=True)
class EventSet:
    """All events of a diagnosis, sorted by recording and time, with overspeeds of joints and force estimates."""

    disturbances: tuple[ForceOrFaultEvent, ...] = ()
    overspeeds: tuple[_Overspeed, ...] = ()
    force_estimates: tuple[ForceEstimate, ...] = ()

    def __bool__(self) -> bool:
        return bool(self.disturbances or self.overspeeds)

    def overspeed_sentences(self, max_joint_speed: float) -> list[str]:
        """Return a sentence for each recording whose end is ignored because a joint exceeds `max_joint_speed`."""
        why = f"then moves faster than diagnosis.max_joint_speed ({max_joint_speed:g} rad/s or m/s)."
        cut = "s are ignored, because joint"
        return [f"Data of '{e.recording}' after {e.start_time:.3g} {cut} {e.joint} {why}" for e in self.overspeeds]

    def has_same_force_and_fault_events(self, other: EventSet) -> bool:
        """Return whether both sets have equally many events, in the same channels and at overlapping times."""
        pairs = list(zip(self.disturbances, other.disturbances, strict=False))
        same = [(a.recording, a.channel) == (b.recording, b.channel) and a._overlap(b) > 0 for a, b in pairs]
        return len(self.disturbances) == len(other.disturbances) and all(same)

    def events_of_recording(self, recording: str) -> tuple[ForceOrFaultEvent, ...]:
        """Return the events of one recording."""
        return tuple(event for event in self.disturbances if event.recording == recording)

    def _end_of(self, recording: str) -> float:
        """Return the time [s] after which efforts and events of a recording are ignored; infinite without overspeed."""
        return min((fall.start_time for fall in self.overspeeds if fall.recording == recording), default=math.inf)


NO_EVENTS = EventSet()


def find_events(
    whole: EstimationProblem, fit: RefittedModel, limits: Thresholds
) -> tuple[EventSet, SmoothedUnknownsResult | None]:
    """Return the events in all recordings of `whole`, from the residual of a fit, and the smoother's result.

    There are none if the prediction fails. Forces that remove less than a tenth of the gap are errors of the model.
    """
    own, x = fit.problem.with_episodes(whole.episodes, whole.held_out), fit.unknowns
    guesses = fit.evaluation.equilibrium_guesses
    pairs, parts = zip(fit.problem.episodes, own.episodes, strict=True), ("torque", "measurements")
    has_same_data = all(getattr(a, part) is getattr(b, part) for a, b in pairs for part in parts)
    judged, tested = fit.problem, fit.evaluation
    if not has_same_data:
        judged = problem_with_whitening_at(own, x, guesses)
        tested = judged.evaluate(x, False, guesses)
    if not tested.ok:
        return NO_EVENTS, None
    series, level = null_test.channels_with_residual_indices(judged), limits.significance_level
    test = null_test.residual_chi2_null_test(series, tested.residual, len(fit.values), level)
    is_flagged = bool(test.flagged_windows)
    evaluation = tested
    if (is_flagged and not has_same_data) or own.has_process_noise:
        evaluation = own.evaluate(x, is_flagged, guesses)
    if not evaluation.ok:
        return NO_EVENTS, None
    least = limits.min_log_bayes_factor
    smoothed = smooth_unknown_forces_and_biases(own, x, evaluation, least) if is_flagged else None
    found = find_force_and_fault_events(own, x, evaluation, smoothed, limits)
    pushed = EventSet(tuple(e for e in found.disturbances if e.kind == "force"))
    left = 1 - _MIN_FORCE_EVENT_GAP_FRACTION
    if pushed and _excess(fit, problem_corrected_for_events(own, pushed)) > left * _excess(fit, own):
        found = replace(found, disturbances=tuple(e for e in found.disturbances if e.kind != "force"))
    return found, smoothed


def _excess(fit: RefittedModel, problem: EstimationProblem) -> float:
    """Excess of the residual of a fit over noise, in all recordings; infinite if they cannot be predicted."""
    x, guesses = problem.pack_unknowns(fit.values), fit.evaluation.equilibrium_guesses
    judged = problem_with_whitening_at(problem, x, guesses)
    evaluation = judged.evaluate(x, False, guesses)
    if evaluation.ok:
        with contextlib.suppress(SolverError):
            held_out = [part.residual for part in judged.held_out_residuals(judged.predict_held_out(x))]
            return excess_over_sample_count(np.concatenate([evaluation.residual[judged.residual_rows.data], *held_out]))
    return math.inf


def find_force_and_fault_events(
    problem: EstimationProblem,
    x: Array,
    evaluation: Evaluation,
    smoothed: SmoothedUnknownsResult | None,
    limits: Thresholds = DEFAULT_THRESHOLDS,
) -> EventSet:
    """Return significant short forces, wrong samples and overspeeds in the estimation and held-out recordings.

    The false-discovery rate of forces refers to all time windows together. `problem` is whitened by sensor noise and
    has all samples. `x` (nx,) is its fit, and `evaluation` that of `x`, with a Jacobian if `smoothed` is given. Forces
    that move the model are searched only where the smoother found unknown forces.
    """
    fitted = zip(problem.episodes, evaluation.episode_predictions, strict=True)
    told = [(e, result, problem.unpack_episode_unknowns(x, i)[0]) for i, (e, result) in enumerate(fitted)]
    shared = problem.unpack_episode_unknowns(x, 0)[0]
    told += [(e, found, shared) for e, found in problem.predict_held_out(x) if not isinstance(found, str)]
    runs = [(e, result, problem.predictor.theta_with_episode_values(e, theta)) for e, result, theta in told]
    ends = EventSet((), tuple(fall for run in runs for fall in _overspeed(problem, run, limits)))
    wrong = [e for run in runs for e in _wrong_samples(problem, run) if e.end_time < ends._end_of(e.recording)]
    torques = CompiledInverseDynamics(problem.step)
    histories = [history for run in runs for history in _read_forces(problem, run, torques, limits)]
    if smoothed is not None:
        histories += _driving_forces(problem, x, evaluation, runs, smoothed, torques)
    cut = [entry for entry in (_before_overspeed(history, ends) for history in histories) if entry is not None]
    sought = map_in_threads(lambda history: detect_force_pulses(history, limits), cut)
    found = [(history, pulse) for history, (own, _) in zip(cut, sought, strict=True) for pulse in own]
    tries = sum(n for _, n in sought)
    real = benjamini_hochberg_mask([pulse.p_value for _, pulse in found], tries, limits.significance_level)
    forces = _one_each([entry for entry, sure in zip(found, real, strict=True) if sure], problem)
    times = {(e.recording, 0.5 * (e.start_time + e.end_time)) for e in wrong}
    forces = [f for f in forces if not any(f.recording == n and f.start_time <= t <= f.end_time for n, t in times)]
    forces = _without_forces_of_motion(forces, {e.name: e.grid.steps * e.grid.time_step for e, *_ in runs}, limits)
    everything = sorted([*forces, *wrong], key=lambda event: (event.recording, event.start_time, event.location))
    there = {(event.recording, event.channel) for event in forces}
    shown = tuple(history for history in cut if (history.recording, history.coordinate) in there)
    return EventSet(tuple(everything), ends.overspeeds, shown)


# -- forces -----------------------------------------------------------------------------------------------------------


def _overspeed(problem: EstimationProblem, run: _RecordingRollout, limits: Thresholds) -> Iterator[_Overspeed]:
    """Yield the first time at which a joint of the robot exceeds the speed limit, if there is one."""
    episode, result, _ = run
    names, h = problem.system.mechanism.joint_names, episode.grid.time_step
    places = [names.index(name) for name in arm_joint_names(problem.system)]
    if not places:
        return
    speed = np.abs(np.gradient(result.rollout.state[:, places], h, axis=0))
    for at in np.flatnonzero(np.any(speed > limits.max_joint_speed, axis=1))[:1]:
        yield _Overspeed(episode.name, names[places[int(speed[at].argmax())]], float(at * h))


def _before_overspeed(history: ForceEstimate, ends: EventSet) -> ForceEstimate | None:
    """Return a history up to the recording's overspeed, without the end that a filter distorts. None if too short."""
    until = ends._end_of(history.recording) - zero_phase_effort_filter(history.filter_cutoff).end_distortion_duration
    keep = np.flatnonzero(history.t <= until)
    return None if len(keep) < 10 else history.subset_at_time_indices(keep)


def _allowed(torques: CompiledInverseDynamics, run: _RecordingRollout, nodes: IntArray) -> tuple[Array, Array]:
    """Return the assumed model error of all coordinates' torques, and the torque that friction can hold, (M, n)."""
    episode, result, theta = run
    size, rate, held = torques.torque_magnitude_rate_and_static_friction(theta, result.rollout, nodes)
    joints = episode.recording.joints
    # the time of a torque is known to one sample
    late = 0.0 if joints is None else float(np.median(np.diff(joints.t)))
    return np.hypot(_INVERSE_DYNAMICS_RTOL * size, late * rate), held


def _read_forces(
    problem: EstimationProblem, run: _RecordingRollout, torques: CompiledInverseDynamics, limits: Thresholds
) -> Iterator[ForceEstimate]:
    """Yield force estimates at prescribed joints with compared efforts: required minus measured torque."""
    episode, result, _ = run
    unbiased = measurements_minus_sensor_error_estimates(episode.measurements, result.predicted_outputs)
    for samples, predicted in zip(unbiased, result.predicted_outputs, strict=True):
        if not samples.sensor.effort_joints or samples.node.ndim > 1 or len(samples.node) < 10:
            continue
        error, held = _allowed(torques, run, samples.node)
        unit_effort = samples.sensor.effort_per_unit_reading
        weight = np.where(samples.positive_weight_mask, samples.weight, 0.0) / unit_effort
        value = np.where(samples.positive_weight_mask, predicted - samples.value, 0.0) * unit_effort
        times = times_since_recording_start(episode, samples)
        # values closer together than an interval are averaged
        bins = np.unique(np.floor((times - times[0]) / _FORCE_INTERVAL + 1e-6), return_inverse=True)[1]
        together = np.zeros((int(bins.max()) + 1, len(times)))
        together[bins, np.arange(len(times))] = 1.0
        mean = together / together.sum(axis=1, keepdims=True)
        for column, joint in enumerate(samples.sensor.effort_joints):
            at, square = problem.system.mechanism.joint_index(joint), weight[:, column] ** 2
            score, information = together @ (square * value[:, column]), np.diag(together @ square)
            what = (episode.name, joint, joint, problem.system.mechanism.joint(joint).unit("N m"))
            allowed = (mean @ error[:, at], mean @ held[:, at], problem.options.path_cutoff)
            yield from _spans(ForceEstimate(*what, mean @ times, score, information, *allowed), limits)


def _spans(whole: ForceEstimate, limits: Thresholds) -> Iterator[ForceEstimate]:
    """Yield parts of a long history, which overlap by twice the longest pulse. Cost grows with the cube of a part."""
    overlap = math.ceil(2 * limits.max_event_duration / whole.time_spacing)
    length = max(_MAX_SPAN_POINTS, 3 * overlap)
    for begin in range(0, max(len(whole.t) - overlap, 1), length - overlap):
        yield whole.subset_at_time_indices(np.arange(begin, min(begin + length, len(whole.t))))


def _driving_forces(
    problem: EstimationProblem,
    x: Array,
    evaluation: Evaluation,
    runs: Sequence[_RecordingRollout],
    smoothed: SmoothedUnknownsResult,
    torques: CompiledInverseDynamics,
) -> list[ForceEstimate]:
    """Return force estimates at coordinates where the smoother found forces, but only for a small part of the time."""
    sought = {trace.recording: _short(smoothed, i) for i, trace in enumerate(smoothed.smoothed_unknowns)}
    found, mechanism = list[ForceEstimate](), problem.system.mechanism
    if not any(sought.values()):
        return found
    with threadpoolctl.threadpool_limits(1):
        models = residual_models_with_smoother_unknowns(problem, x, evaluation, _FORCE_INTERVAL)
        for model, run in zip(models, runs, strict=False):
            if not sought[model.recording]:
                continue
            middle = (model.interval_edges[:-1] + model.interval_edges[1:]) / 2
            error, held = _allowed(torques, run, np.rint(middle / run[0].grid.time_step).astype(np.int64))
            # the last interval is shorter
            full = slice(0, max(len(middle) - 1, 1))
            indices = [model.unknown_names.index(name) for name in sought[model.recording]]
            for source in dict.fromkeys(model.unknown_groups[index] for index in indices):
                chosen = [index for index in indices if model.unknown_groups[index] == source]
                known = force_log_likelihood_coefficients(model, smoothed.group_variance | {source: 0.0}, chosen)
                for index, (score, information) in zip(chosen if known else (), known, strict=True):
                    name, size = model.unknown_names[index], model.reference_std[index]
                    at, unit = mechanism.joint_index(name), mechanism.joint(name).unit("N m")
                    what = (model.recording, source.location, name, unit, middle[full])
                    told = (score[full] / size, information[full, full] / size**2)
                    found.append(ForceEstimate(*what, *told, error[full, at], held[full, at]))
    return found


def _short(smoothed: SmoothedUnknownsResult, recording: int) -> list[str]:
    """Return the names of unknown forces that are significant only for a small part of a recording's time."""
    trace, names = smoothed.smoothed_unknowns[recording], []
    for i, source in enumerate(trace.unknown_groups):
        sure = smoothed_unknown_significance_mask(trace, [i])
        is_force = source.kind == "force" and not source.is_confounded_with_bias and smoothed.group_variance[source]
        if is_force and 0 < np.mean(sure) <= MAX_EVENT_TIME_FRACTION:
            names.append(trace.unknown_names[i])
    return names


def _one_each(
    found: Sequence[tuple[ForceEstimate, DetectedForcePulse]], problem: EstimationProblem
) -> list[ForceOrFaultEvent]:
    """Return force events. A force that moves the model counts once, at the coordinate with the smallest p-value."""
    prescribed = set(problem.system.prescribed)
    kept: list[ForceOrFaultEvent] = []
    for history, pulse in sorted(found, key=lambda entry: entry[1].p_value):
        what = (history.recording, history.location, history.coordinate, "force", pulse.start_time, pulse.end_time)
        size = (pulse.peak_value, pulse.impulse, pulse.peak_std * pulse.impulse_per_unit_peak, history.unit)
        event = ForceOrFaultEvent(*what, *size, pulse)
        same = [e for e in kept if e.recording == event.recording and not {e.channel, event.channel} <= prescribed]
        if all(event._overlap(other) <= 0 for other in same):
            kept.append(event)
    return kept


def _without_forces_of_motion(
    forces: Sequence[ForceOrFaultEvent], durations: Mapping[str, float], limits: Thresholds
) -> list[ForceOrFaultEvent]:
    """Return the forces that do not belong to the motion. All are returned if at most half recur in other recordings.

    A force belongs to the motion if more recordings than by chance have the same force, or if its recording and one of
    these have more forces in common than by chance. Numbers by chance are Poisson distributed.
    """
    pairs = np.array([[_recurrence(one, other, durations) for other in forces] for one in forces])
    pairs = pairs.reshape(len(forces), len(forces), 2)
    names = list(dict.fromkeys(force.recording for force in forces))
    recording = np.array([names.index(force.recording) for force in forces], int)
    of = np.eye(len(names))[recording]
    recurs, chance = pairs[..., 0] @ of > 0, pairs[..., 1] @ of  # by force and other recording
    is_recurring = np.any(recurs, axis=1)
    if is_recurring.sum() <= _MAX_RECURRING_FRACTION * len(forces):
        return list(forces)
    by_force = scipy.special.pdtrc(recurs.sum(axis=1) - 1, chance.sum(axis=1))
    by_recording = scipy.special.pdtrc(of.T @ recurs - 1, of.T @ chance)[recording]
    p_values = np.minimum(by_force, np.min(by_recording, axis=1, where=recurs, initial=1.0))
    p_values[~is_recurring] = 1.0
    common = benjamini_hochberg_mask(p_values, len(forces) * (1 + len(names)), limits.significance_level)
    return [force for force, is_common in zip(forces, common, strict=True) if not is_common]


def _recurrence(one: ForceOrFaultEvent, other: ForceOrFaultEvent, durations: Mapping[str, float]) -> tuple[bool, float]:
    """Return whether `other` is the same force in another recording, and the probability of this at a random time.

    The same force acts on the same coordinate at the same time, and impulses differ by at most `SIGNIFICANT_Z` stds.
    """
    shorter, longer = sorted(force.end_time - force.start_time for force in (one, other))
    apart, std = abs(one.impulse - other.impulse), math.hypot(one.impulse_std, other.impulse_std)
    is_alike = one.channel == other.channel and one.impulse * other.impulse > 0 and apart <= SIGNIFICANT_Z * std
    if one.recording == other.recording or not is_alike or shorter <= _MIN_RECURRENCE_OVERLAP * longer:
        return False, 0.0
    return one._overlap(other) > _MIN_RECURRENCE_OVERLAP * longer, shorter / durations[other.recording]


# -- wrong samples ----------------------------------------------------------------------------------------------------


def _wrong_samples(problem: EstimationProblem, run: _RecordingRollout) -> Iterator[ForceOrFaultEvent]:
    """Yield samples that contradict their neighbours: residuals of sensors, and recorded values of joints."""
    episode, result, _ = run
    for samples, predicted in zip(episode.measurements, result.predicted_outputs, strict=True):
        sensor = samples.sensor
        if sensor.effort_joints or samples.node.ndim > 1:
            continue
        t, width = times_since_recording_start(episode, samples), sensor.outputs_per_channel
        for column, channel in enumerate(samples.channel_name_per_output):
            location = channel.rpartition(".")[2]
            if width > 1:
                location = sensor_bias_location_name(problem.system, sensor, sensor.frame_name_per_output[column])
            seen = samples.positive_weight_mask[:, column]
            about = (episode.name, location, sensor.output_names[column], sensor.channel_units[column // width])
            values = (samples.value - predicted)[seen, column]
            yield from _alone(t[seen], values, samples.std[seen, column], about)
    joints = episode.recording.joints
    if joints is None:
        return
    t = joints.t - episode.grid.start_time
    inside = (t >= 0) & (t <= episode.grid.node_times[-1] - episode.grid.start_time)
    for quantity in ("position", "effort"):
        values, revolute = joints.values_by_channel.get(quantity), CHANNEL_KINDS[f"joints.{quantity}"].unit
        for column, joint in enumerate(joints.names):
            floor = _floor(problem, episode, joint, quantity)
            if values is not None and floor is not None:
                own = values[inside, column]
                noise = np.full(len(own), max(floor, quantization_step(own)))
                unit = problem.system.mechanism.joint(joint).unit(revolute)
                yield from _alone(t[inside], own, noise, (episode.name, joint, f"joints.{quantity}.{joint}", unit))


def _floor(problem: EstimationProblem, episode: Episode, joint: str, quantity: str) -> float | None:
    """Return the noise std of a joint's raw channel. None if the model neither takes it as input nor smooths it."""
    joints, options, system = episode.recording.joints, problem.options, problem.system
    assert joints is not None
    by_torque = joint in system.driven and joint not in system.servos
    if joint not in system.prescribed and (not by_torque or quantity == "position"):
        return None
    group = f"joints.{quantity}"
    choice = options.sensors.get(group, SensorOptions())
    given = choice.std if choice.std is not None else getattr(joints, CHANNEL_KINDS[group].std_attribute_names[0])
    std = 0.0
    if given is not None:
        std = float(expand_to_joint_values(given, joints.names, (joint,), f"sensors.{group}.std")[0])
    if quantity == "effort" and joint in system.prescribed and math.isfinite(options.path_cutoff):
        # smoothing reduces the noise of one sample by its share of the filter's time
        std /= min(math.sqrt(2 * options.path_cutoff * float(np.median(np.diff(joints.t)))), 1.0)
    return std


def _alone(t: Array, values: Array, noise: Array, about: tuple[str, str, str, str]) -> Iterator[ForceOrFaultEvent]:
    """Yield up to `_MAX_WRONG_SAMPLES` consecutive samples that deviate from a cubic far more than their neighbours."""
    count, many = len(values), _NEIGHBOUR_COUNT
    if count < 2 * many:
        return
    off = _beside_neighbours(t, values)
    size = np.abs(off)
    wide = np.lib.stride_tricks.sliding_window_view(np.pad(size, many, mode="reflect"), 2 * many + 1)
    spread = np.maximum(noise, 1.4826 * np.median(wide, axis=1))
    odd = size > _WRONG_SAMPLE_Z * np.maximum(spread, 1e-12)
    recording, location, channel, unit = about
    for begin in np.flatnonzero(odd & ~np.roll(odd, 1)):
        end = begin + int(np.argmin([*odd[begin:], False])) - 1
        if end - begin >= _MAX_WRONG_SAMPLES:
            continue
        near = np.r_[max(begin - many, 0) : begin, end + 1 : min(end + 1 + many, count)]
        # a stamp that is late by one interval changes a value by its step from sample to sample
        steps = np.abs(np.diff(values))[[k for k in near[:-1] if k + 1 != begin and k < count - 1]]
        around = max(size[near].max(initial=0.0), steps.max(initial=0.0))
        if size[begin : end + 1].min() < _MIN_NEIGHBOUR_RATIO * around:
            continue
        period = float(np.median(np.diff(t[max(begin - many, 0) : end + many])))
        window = (float(t[begin] - period / 2), float(t[end] + period / 2))
        peak = float(off[begin + int(size[begin : end + 1].argmax())])
        impulse = float(off[begin : end + 1].sum() * period)
        std = float(spread[begin]) * period * math.sqrt(end - begin + 1)
        yield ForceOrFaultEvent(recording, location, channel, "sample", *window, peak, impulse, std, unit)


def _beside_neighbours(t: Array, values: Array) -> Array:
    """Return values minus a cubic through four nearby samples (M,): the smallest of three such differences."""
    found = np.zeros((len(_STENCIL_STEPS), len(values)))
    for one, step in zip(found, _STENCIL_STEPS, strict=True):
        middle = np.arange(2 * step, len(values) - 2 * step)
        at = [middle + shift * step for shift in (-2, -1, 1, 2)]
        cubic = np.zeros(len(middle))
        for own in at:
            weights = [(t[middle] - t[other]) / (t[own] - t[other]) for other in at if other is not own]
            cubic += np.prod(weights, axis=0) * values[own]
        one[middle] = values[middle] - cubic
    smallest = found[np.argmin(np.abs(found), axis=0), np.arange(len(values))]
    smallest[np.any(found > 0, axis=0) & np.any(found < 0, axis=0)] = 0.0
    return smallest


# -- recordings without the events ------------------------------------------------------------------------------------


def problem_corrected_for_events(problem: EstimationProblem, events: EventSet) -> EstimationProblem:
    """Return the problem without the influence of found events on its data, so that they do not disturb a fit.

    Forces at joints driven by recorded torques are added to these torques; forces on an object and at servos are not
    compensated. Excluded are wrong samples, effort samples during an event, and effort samples after an overspeed.
    """
    system, cutoff = problem.system, problem.options.path_cutoff

    def cleaned(episode: Episode) -> Episode:
        own, end = events.events_of_recording(episode.name), events._end_of(episode.name)
        if not own and not math.isfinite(end):
            return episode
        torque = episode.torque.copy()
        times = episode.grid.node_times[:-1] - episode.grid.start_time + episode.grid.time_step / 2
        for event in own:
            if event.detected_pulse is not None and event.channel in set(system.driven) - set(system.servos):
                torque[:, system.driven.index(event.channel)] += event.detected_pulse.filtered_force_at(times)
        parts = [_counting(episode, samples, own, end, cutoff) for samples in episode.measurements]
        return replace(episode, torque=torque, measurements=tuple(parts))

    return problem.with_episodes([cleaned(e) for e in problem.episodes], [cleaned(e) for e in problem.held_out])


def _counting(
    episode: Episode, samples: SensorMeasurements, own: Sequence[ForceOrFaultEvent], end: float, cutoff: float
) -> SensorMeasurements:
    """Return the samples without those that an event affects."""
    hidden, is_effort = np.zeros(samples.value.shape, bool), bool(samples.sensor.effort_joints)
    t = times_since_recording_start(episode, samples)
    t = t if t.ndim > 1 else np.broadcast_to(t[:, None], hidden.shape)
    if math.isfinite(end) and is_effort:
        hidden |= t > end - zero_phase_effort_filter(cutoff).end_distortion_duration
    smear = 1 / cutoff if is_effort else 0.0
    for event in own:
        inside = (t > event.start_time - smear) & (t < event.end_time + smear)
        for column, channel in enumerate(samples.channel_name_per_output):
            name = channel.rpartition(".")[2] if is_effort else samples.sensor.output_names[column]
            # a wrong angle changes the required torques of all joints
            if event.channel == name or (is_effort and event.kind == "sample"):
                hidden[:, column] |= inside[:, column]
    return hide_marked_measurements(samples, hidden) if np.any(hidden & samples.positive_weight_mask) else samples
