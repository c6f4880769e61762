"""Outputs of a fit: files of trajectories and predictions, estimated torque offsets, and texts to copy."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterable, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np
from numpy.typing import ArrayLike

from yid_ocp.arrays import Array
from yid_ocp.data.recording_hdf5 import create_hdf5_atomically
from yid_ocp.display import grouped
from yid_ocp.errors import DataError
from yid_ocp.inference import whitening
from yid_ocp.inference.smoother import smoothed_unknown_units
from yid_ocp.inference.uncertainty import ParameterEstimate, value_and_uncertainty_text
from yid_ocp.model.servos_and_springs import MOTOR_OFF_COMMAND
from yid_ocp.model.system import System
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.episodes import Episode, EpisodeAndPredictionOrFailure, EpisodePrediction
from yid_ocp.problem.measurements import SensorMeasurements
from yid_ocp.report.animation import ConfigurationTrajectory
from yid_ocp.sensors.joints import JOINT_EFFORT_SENSOR_KEY
from yid_ocp.solvers import Solution
from yid_ocp.virtual.mjcf import CasadiEvaluator, system_joint_dynamics_terms

if TYPE_CHECKING:
    from yid_ocp.diagnosis.diagnosis_result import DiagnosisResult


def torque_offsets_by_recording(problem: EstimationProblem, x: Array) -> dict[str, dict[str, dict[str, float]]]:
    """Return torque offsets by recording (also held-out ones) and joint: `value`, `std`, `prior_std` [N m].

    They are estimated at the unknowns `x` (nx,), near which the whitening filters were linearised. The result is empty
    if the problem has no filters, or if no offset is allowed.
    """
    if all(whitening is None for whitening in problem.whitening_filters):
        return {}
    known = list(zip(problem.episodes, whitening.torque_biases_and_stds_per_recording(problem, x), strict=True))
    if any(e.initial_state_shared_with is None and _has_torque_bias(e) for e in problem.held_out):
        held = problem
        if not any(problem.held_out_whitening_filters):
            held = whitening.problem_with_held_out_kalman_whitening(problem, x, keep_weights=True)
        for (episode, result), own in zip(held.predict_held_out(x), held.held_out_whitening_filters, strict=True):
            is_apart = episode.initial_state_shared_with is None
            if is_apart and isinstance(own, whitening.WhiteningFilter) and not isinstance(result, str):
                bias = whitening.estimate_episode_torque_bias(episode, result, own)
                known.append((episode, (bias, own.torque_bias_std)))
    found = {}
    for episode, estimate in known:
        if estimate is not None and episode.input_errors is not None and _has_torque_bias(episode):
            rows = zip(problem.system.driven, *estimate, episode.input_errors.torque_bias_std, strict=True)
            found[episode.name] = {
                joint: {"value": float(value), "std": float(std), "prior_std": float(prior)}
                for joint, value, std, prior in rows
                if prior > 0
            }
    return found


def has_unused_efforts(problem: EstimationProblem) -> bool:
    """Check whether torques are recorded, but neither drive the arms nor are compared with predictions."""
    episode = problem.episodes[0]
    joints, used = episode.recording.joints, {own.sensor.group_name for own in episode.measurements}
    recorded = joints is not None and joints.effort is not None
    return recorded and not problem.system.driven and JOINT_EFFORT_SENSOR_KEY not in used


def copyable_estimate_texts(
    system: System,
    theta: Array,
    estimates: Mapping[str, ParameterEstimate],
    command: Sequence[str],
    uncounted_errors: Sequence[str],
    model_yaml: Sequence[str] = (),
) -> dict[str, Any]:
    """Return texts to copy, with those of the `estimates` that are identifiable. Empty without such a parameter.

    The keys are `values` (lines NAME = VALUE ± STD), `uncounted_errors` (not in ±), `left_out` (parameters not found),
    `near_zero` (less than two stds from zero), `joints` (number of links, range of joint stiffness [N m/rad], by
    segment and deformation), lines of `yaml` (first `model_yaml`) and `mjcf`, rows of `latex`, `export` (the
    `command`), `cite` (BibTeX). `theta` (ntheta,) has all parameters.
    `values` and `latex` have no offsets of points beside other estimates.
    """
    sure = {n: e for n, e in estimates.items() if e.free and e.verdict == "identifiable"}
    found = {n: e for n, e in sure.items() if abs(e.value) > 2 * e.std}
    if not found:
        return {}
    unknown = [name for name, own in estimates.items() if own.free and name not in sure]
    terms, springs, joints = _found_joint_terms(system, theta, found, unknown), system.elastic_joints, []
    links = {s.joint_name for s in springs if s.segment_name != s.joint_name}
    turning = [joint.name for joint in system.mechanism.joints if joint.kind == "revolute"]
    lines = [_mjcf_joint_line(j, own, turning, unknown) for j, own in terms.items() if own and j not in links]
    for layout in system.segment_layouts:
        for key in ((layout.name, "bend"), (layout.name, "twist")):
            own = [terms[s.joint_name] for s in springs if (s.segment_name, s.deformation) == key]
            sizes = {term: [at[term] for at in own if term in at] for term in ("stiffness", "damping")}
            count = len(layout.link_joints)
            note = f"{' '.join(key)}, {count} links"
            if stiffness := sizes["stiffness"]:
                low, high = min(stiffness), max(stiffness)
                note += f"; for n links, multiply the stiffness and any Kelvin-Voigt damping by n/{count}"
                known = {"segment": key[0], "deformation": key[1], "links": count}
                joints.append(known | {"lowest": low, "highest": high})
                note += f"; joints have {low:.4g} to {high:.4g}, see the export" if high - low > 1e-9 * high else ""
            shown = " ".join(f'{term}="{np.median(size):.4g}"' for term, size in sizes.items() if size)
            lines += [f"<joint {shown}/> <!-- {note} -->"] if shown else []
    shared = {name: e for name, e in found.items() if name in system.parameters}
    starts = (f"  {name}: {{free: true, initial: {e.value:.6g}}}" for name, e in shared.items())
    labels = {n: n.replace("_", r"\_") for n in found}
    told = {n: value_and_uncertainty_text(e.value, e.std, least_digits=2) for n, e in found.items()}
    # nobody quotes the offset of a marker
    offsets = {f"{frame}.{axis}" for frame in system.mechanism.frames for axis in "xyz"}
    quoted = {n: e for n, e in found.items() if n not in offsets} or found
    rows = [rf"{labels[n]} & ${told[n]}$ & {e.unit} \\".replace("±", r"\pm") for n, e in quoted.items()]
    return {
        "values": [f"{n} = {told[n]} {e.unit}".removesuffix(" 1") for n, e in quoted.items()],
        "uncounted_errors": list(uncounted_errors),
        "left_out": unknown,
        "near_zero": [name for name in sure if name not in found],
        "joints": joints,
        "yaml": [*model_yaml, *["parameters:"] * bool(shared), *starts],
        "mjcf": lines,
        "latex": [re.sub(r"(?<=\d)e([+-])0*(\d+)", r" \\cdot 10^{\1\2}", row) for row in rows],
        "export": shlex.join(["yid-ocp", *command]),
        "cite": resources.files("yid_ocp.data").joinpath("defaults", "citation.bib").read_text("utf-8"),
    }


def _found_joint_terms(
    system: System, theta: Array, names: Iterable[str], unknown: Iterable[str]
) -> dict[str, dict[str, float]]:
    """Return the attributes of each joint in MJCF that depend on parameters `names`, not on `unknown` ones alone."""
    values, found = dict(zip(system.parameters.names, theta, strict=True)), {}
    shared = (values.keys() & own for own in ((), names, unknown))  # without those of single recordings
    moves = ({name: values[name] + 0.01 * (abs(values[name]) or 1.0) for name in own} for own in shared)
    evaluators = (CasadiEvaluator(system, values | moved) for moved in moves)
    terms, others, doubtful = (system_joint_dynamics_terms(system, own) for own in evaluators)
    for joint, own in terms.items():
        changed = {key for key, size in vars(own).items() if size != getattr(others[joint], key)}
        sizes = {"damping": own.damping, "armature": own.armature, "dry_friction": own.dry_friction}
        found[joint] = {key.replace("dry_friction", "frictionloss"): sizes[key] for key in sizes if key in changed}
        if changed & {"stiffness", "constant_force"} and own.stiffness > 0:
            found[joint] |= {"stiffness": own.stiffness, "springref": own.constant_force / own.stiffness}
            is_known = own.damping == doubtful[joint].damping > 0
            found[joint] |= {"damping": own.damping} if is_known else {}
    return found


def _mjcf_joint_line(
    joint: str, attributes: Mapping[str, float], turning: Sequence[str], unknown: Sequence[str] = ()
) -> str:
    shown = " ".join(f'{key}="{size:.4g}"' for key, size in attributes.items())
    note = ' <!-- with compiler angle="radian" -->' if joint in turning and attributes.get("springref") else ""
    part = "damping contains" if "damping" in attributes else "add"
    lost = f" <!-- {part} {joint}.damping, not known to within 10 % -->" * (f"{joint}.damping" in unknown)
    return f'<joint name="{joint}" {shown}/>{note}{lost}'


def _has_torque_bias(episode: Episode) -> bool:
    return episode.input_errors is not None and bool(np.any(episode.input_errors.torque_bias_std > 0))


def predicted_configuration_trajectory(
    name: str, problem: EstimationProblem, episode: Episode, prediction: EpisodePrediction, theta: Array
) -> ConfigurationTrajectory:
    """Return a predicted motion as trajectory `name` of an animation. `theta` (ntheta,) holds all parameters."""
    system, q = problem.system, prediction.rollout.state[:, : problem.system.n_coordinates]
    own = problem.predictor.theta_with_episode_values(episode, theta)
    return ConfigurationTrajectory(name, system, own, episode.grid.node_times, q)


SOLVE_TRAJECTORIES_FORMAT = "yid-trajectories/2"
DIAGNOSIS_TRAJECTORIES_FORMAT = "yid-diagnosis-trajectories/2"
EpisodeWithNominalAndEffectPredictions = tuple[Episode, EpisodePrediction, EpisodePrediction]
"""A held-out recording, its prediction by the nominal model, and its prediction with the effects."""


def trajectories_format(file: h5py.File) -> str:
    """Return the format of an open trajectories.h5. Raises `DataError` for one that this version does not read."""
    form = str(file.attrs.get("format", ""))
    if form not in (SOLVE_TRAJECTORIES_FORMAT, DIAGNOSIS_TRAJECTORIES_FORMAT):
        allowed = f"{SOLVE_TRAJECTORIES_FORMAT} or {DIAGNOSIS_TRAJECTORIES_FORMAT}"
        what, hint = f"this version reads no trajectories of the format '{form}'", "run `solve` or `diagnose` again"
        raise DataError(what, where=str(file.filename), allowed=allowed, hint=hint)
    return form


def write_solve_trajectories(
    path: Path, problem: EstimationProblem, solution: Solution, held_out: Sequence[EpisodeAndPredictionOrFailure]
) -> None:
    """Write trajectories, predictions and unknowns (HDF5, arrays: docs/howto/signals.md). Raises `OutputError`."""
    pairs: list[tuple[str, Episode, EpisodePrediction | str]] = [("held_out", *pair) for pair in held_out]
    if solution.evaluation is not None:
        done = solution.episode_predictions
        pairs = [("estimate", e, r) for e, r in zip(problem.episodes, done, strict=True)] + pairs
    with create_hdf5_atomically(path) as file:
        file.attrs["format"] = SOLVE_TRAJECTORIES_FORMAT
        unknowns = file.create_group("unknowns")
        store_texts(unknowns, {"names": solution.unknown_names})
        unknowns.create_dataset("x", data=solution.x)
        unknowns.create_dataset("covariance", data=solution.covariance)
        for role, episode, outcome in pairs:
            group, system = file.require_group("recordings").create_group(episode.name), problem.system
            group.attrs["role"] = role
            names = {"joints": system.mechanism.joint_names, "driven": system.driven, "prescribed": system.prescribed}
            store_texts(group, names)
            if isinstance(outcome, str):
                group.attrs["message"] = outcome
                continue
            n, rollout, torque = system.n_coordinates, outcome.rollout, {"torque": outcome.rollout.torque}
            if system.servos:
                torque = {"command": np.where(rollout.torque < MOTOR_OFF_COMMAND / 2, rollout.torque, np.nan)}
            _store(group, {"t": episode.grid.node_times, "q": rollout.state[:, :n], "p": rollout.state[:, n : 2 * n]})
            _store(group, {"multipliers": rollout.multipliers, **torque, "effort": rollout.effort})
            for samples, predicted in zip(episode.measurements, outcome.predicted_outputs, strict=True):
                _store_sensor(group, episode, samples, {"predicted": predicted})


def write_diagnosis_hdf5(
    path: Path, result: DiagnosisResult, pairs: Sequence[EpisodeWithNominalAndEffectPredictions]
) -> None:
    """Write predictions, smoothed unknowns and event forces (arrays: docs/howto/signals.md). Raises `OutputError`."""
    with create_hdf5_atomically(path) as file:
        file.attrs["format"] = DIAGNOSIS_TRAJECTORIES_FORMAT
        for episode, before, after in pairs:
            for k, samples in enumerate(episode.measurements):
                both = {"before": before.predicted_outputs[k], "after": after.predicted_outputs[k]}
                _store_sensor(file.require_group(episode.name), episode, samples, both)
        smoothed = result.smoother_result
        for trace in () if smoothed is None else smoothed.smoothed_unknowns:
            assert smoothed is not None
            problem = result.nominal_model.problem
            group = file.create_group(f"where/{trace.recording}")
            group.attrs["start"] = next(e.grid.start_time for e in problem.episodes if e.name == trace.recording)
            sources, units = trace.unknown_groups, smoothed_unknown_units(problem.system, trace)
            store_texts(group, {"unknowns": trace.unknown_names, "units": units})
            store_texts(group, {"locations": [s.location for s in sources], "kinds": [s.kind for s in sources]})
            variance = np.array([smoothed.group_variance[source] for source in sources])
            relative = {"mean": trace.posterior_mean, "std": trace.posterior_std, "prior": np.sqrt(variance)}
            absolute = {name: array * trace.reference_std for name, array in relative.items()}
            _store(group, {"edges": trace.interval_edges, **absolute})
        found = ((f"events/{force.recording}/{force.coordinate}", force) for force in result.events.force_estimates)
        for name, parts in grouped(found).items():  # parts of a long recording overlap
            group = file.create_group(name)
            group.attrs["unit"] = parts[0].unit
            t, first = np.unique(np.concatenate([part.t for part in parts]), return_index=True)
            value = np.concatenate([part.most_likely_force_signal for part in parts])[first]
            allowed = np.concatenate([part.assumed_model_error for part in parts])[first]
            _store(group, {"t": t, "value": value, "allowed": allowed})


def _store_sensor(
    parent: h5py.Group, episode: Episode, samples: SensorMeasurements, predicted: Mapping[str, Array]
) -> None:
    group = parent.create_group(samples.sensor.group_name)
    store_texts(group, {"channels": samples.sensor.channel_names, "units": samples.sensor.channel_units})
    times = episode.grid.start_time + episode.grid.time_step * (samples.node + samples.fraction)
    _store(group, {"t": times, "measured": samples.value, **predicted, "std": samples.std})


def _store(group: h5py.Group, arrays: Mapping[str, ArrayLike]) -> None:
    for name, array in arrays.items():
        group.create_dataset(name, data=array, compression="gzip", shuffle=True)


def store_texts(group: h5py.Group, texts: Mapping[str, Sequence[str]]) -> None:
    """Store lists of texts as attributes of a group."""
    for name, values in texts.items():
        group.attrs[name] = np.array(values, dtype=h5py.string_dtype())
