"""HDF5 files with trajectories and predictions of a run."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import ArrayLike, NDArray

from yid_ocp.data.hdf5_io import create_hdf5_atomically
from yid_ocp.diagnosis import DiagnosisResult
from yid_ocp.diagnosis.localise import unknown_units
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.estimation_problem import Episode, EpisodePrediction
from yid_ocp.problem.measurements import Measurements
from yid_ocp.solvers import Solution

SOLVE_TRAJECTORIES_FORMAT = "yid-trajectories/1"
DIAGNOSIS_TRAJECTORIES_FORMAT = "yid-diagnosis-trajectories/1"
HeldOutPrediction = tuple[Episode, EpisodePrediction, EpisodePrediction]
"""A held-out recording, its prediction by the nominal model and that with the effects."""


def write_solve_trajectories(
    path: Path,
    problem: EstimationProblem,
    solution: Solution,
    held_out: Sequence[tuple[Episode, EpisodePrediction | str]],
) -> None:
    """Write trajectories, predictions and unknowns with covariance as `yid-trajectories/1`.

    `unknowns/`: names, x, covariance. `recordings/NAME/`: `t` (N+1,) [s], `q`, `p` (N+1, n), `multipliers` (N, m)
    [N s], `torque` (N, nu) [N m] or what servos are commanded, `command` (N, nu) [rad or m], `effort` (N, nc) [N m],
    the attributes `joints` (n names), `driven` (nu) and `prescribed` (nc), and for every sensor `GROUP/` with `t`,
    `measured`, `predicted`, `std` and the attributes `channels`, `unit`.

    Raises
    ------
    OutputError
    """
    pairs: list[tuple[str, Episode, EpisodePrediction | str]] = [("held_out", *pair) for pair in held_out]
    if solution.evaluation is not None:
        done = solution.episode_predictions
        pairs = [("estimate", e, r) for e, r in zip(problem.episodes, done, strict=True)] + pairs
    with _file(path, SOLVE_TRAJECTORIES_FORMAT) as file:
        unknowns = file.create_group("unknowns")
        unknowns.attrs["names"] = _texts(solution.unknown_names)
        unknowns.create_dataset("x", data=solution.x)
        unknowns.create_dataset("covariance", data=solution.covariance)
        for role, episode, outcome in pairs:
            group = file.require_group("recordings").create_group(episode.name)
            group.attrs["role"] = role
            group.attrs["joints"] = _texts(problem.system.mechanism.joint_names)
            group.attrs["driven"] = _texts(problem.system.driven)
            group.attrs["prescribed"] = _texts(problem.system.prescribed)
            if isinstance(outcome, str):
                group.attrs["message"] = outcome
                continue
            n, rollout = problem.system.n_coordinates, outcome.rollout
            arrays = {
                "t": episode.grid.node_times,
                "q": rollout.state[:, :n],
                "p": rollout.state[:, n : 2 * n],
                "multipliers": rollout.multipliers,
                "command" if problem.system.servos else "torque": rollout.torque,
                "effort": rollout.effort,
            }
            _store(group, arrays)
            for samples, predicted in zip(episode.measurements, outcome.predicted_outputs, strict=True):
                _store_sensor(group, episode, samples, {"predicted": predicted})


def write_diagnosis_trajectories(path: Path, finding: DiagnosisResult, predicted: Sequence[HeldOutPrediction]) -> None:
    """Write held-out predictions and smoothed unknowns as `yid-diagnosis-trajectories/1`.

    `RECORDING/GROUP/` for every held-out recording: `t` (M,) [s], `measured`, `before`, `after`, `std` (M, k) and the
    attributes `channels`, `unit`.

    `where/RECORDING/` for every recording that was estimated on, where there was a gap to locate: `edges` (J + 1,) [s]
    since its first node, of the intervals over which unknowns are constant; `mean` and `std` (J, nd) of the unknown
    forces, offsets and biases about the nominal model and `prior` (nd,), the standard deviation at the largest
    evidence, zero where a group was not taken in; the attributes `unknowns`, `locations`, `kinds`, `units` (nd,) each,
    and `start`, the time of the first node [s].

    `events/RECORDING/CHANNEL/` where a force acted as an event: `t` (M,) [s], `value` (M,) the force beside what model
    and recording have, `allowed` (M,) what the model may be wrong by; the attribute `unit`.

    Raises
    ------
    OutputError
    """
    with _file(path, DIAGNOSIS_TRAJECTORIES_FORMAT) as file:
        for episode, before, after in predicted:
            for k, samples in enumerate(episode.measurements):
                both = {"before": before.predicted_outputs[k], "after": after.predicted_outputs[k]}
                _store_sensor(file.require_group(episode.name), episode, samples, both)
        for trace in () if finding.smoother_result is None else finding.smoother_result.smoothed_unknowns:
            assert finding.smoother_result is not None
            episodes = finding.nominal_model.problem.episodes
            group = file.create_group(f"where/{trace.recording}")
            group.attrs["start"] = next(e.grid.start_time for e in episodes if e.name == trace.recording)
            group.attrs["unknowns"] = _texts(trace.unknown_names)
            group.attrs["locations"] = _texts([source.location for source in trace.unknown_groups])
            group.attrs["kinds"] = _texts([source.kind for source in trace.unknown_groups])
            group.attrs["units"] = _texts(unknown_units(finding.nominal_model.problem.system, trace))
            variance = np.array([finding.smoother_result.group_variance[source] for source in trace.unknown_groups])
            arrays = {
                "edges": trace.interval_edges,
                "mean": trace.posterior_mean * trace.reference_std,
                "std": trace.posterior_std * trace.reference_std,
                "prior": np.sqrt(variance) * trace.reference_std,
            }
            _store(group, arrays)
        for force in finding.events.force_series:
            group = file.create_group(f"events/{force.recording}/{force.channel}")
            group.attrs["unit"] = force.unit
            _store(group, {"t": force.t, "value": force.force, "allowed": force.allowed_model_error})


@contextlib.contextmanager
def _file(path: Path, form: str) -> Iterator[h5py.File]:
    with create_hdf5_atomically(path) as file:
        file.attrs["format"] = form
        yield file


def _store_sensor(
    parent: h5py.Group, episode: Episode, samples: Measurements, predicted: Mapping[str, NDArray[np.float64]]
) -> None:
    """What a sensor measured and what was predicted of it."""
    group = parent.create_group(samples.sensor.group_name)
    group.attrs["channels"] = _texts(samples.sensor.channel_names)
    group.attrs["unit"] = samples.sensor.unit
    times = episode.grid.start_time + episode.grid.time_step * (samples.node + samples.fraction)
    _store(group, {"t": times, "measured": samples.value, **predicted, "std": samples.std})


def _store(group: h5py.Group, arrays: Mapping[str, ArrayLike]) -> None:
    for name, array in arrays.items():
        group.create_dataset(name, data=array, compression="gzip", shuffle=True)


def _texts(values: Sequence[str]) -> NDArray[np.object_]:
    return np.array(values, dtype=h5py.string_dtype())
