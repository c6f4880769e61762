"""The command `diagnose`: is there a gap, where, which effect makes it; writes the run folder."""

from __future__ import annotations

import logging
import os
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from yid_ocp.config.settings import Run, dump_config
from yid_ocp.diagnosis import Finding, Thresholds, diagnose
from yid_ocp.diagnosis.localise import units
from yid_ocp.errors import OutputError
from yid_ocp.problem import EstimationProblem, SensorOptions
from yid_ocp.problem.episodes import Episode
from yid_ocp.problem.prediction import EpisodeResult
from yid_ocp.report.html import write_report
from yid_ocp.report.sections import Findings
from yid_ocp.solvers import Solution, solve
from yid_ocp.workflow.build import build_problem
from yid_ocp.workflow.folder import Monitor, Silent, input_hashes, new_run_folder, versions
from yid_ocp.workflow.refits import Refits

TRAJECTORIES = "yid-diagnosis-trajectories/1"
log = logging.getLogger(__name__)
Prediction = tuple[Episode, EpisodeResult, EpisodeResult]
"""A held-out recording, its prediction by the nominal model and that with the effects."""


@dataclass(frozen=True)
class DiagnoseOutcome:
    """What `run_diagnose` leaves.

    Attributes
    ----------
    folder : Path
        The finished run folder.
    result : dict
        Contents of result.json.
    finding : Finding
    """

    folder: Path
    result: dict[str, Any]
    finding: Finding


def run_diagnose(run: Run, out: str | Path | None = None, monitor: Monitor | None = None) -> DiagnoseOutcome:
    """Diagnose and write the run folder; refits that an interrupted run of the same kind finished are taken up.

    Parameters
    ----------
    run : Run
    out : str or Path, optional
        The run folder; see `new_run_folder`.
    monitor : Monitor, optional
        Told about stages.

    Returns
    -------
    DiagnoseOutcome

    Raises
    ------
    ConfigError, DataError, ModelError, SolverError, OutputError
    """
    watcher = monitor or Silent()
    with new_run_folder(run, out, "diagnose") as folder:
        inputs, config = input_hashes(run), dump_config(run)
        folder.write("config.yaml", config)
        watcher.stage("building the model and its compiled step")
        folder.log("start", command="diagnose", versions=versions(), inputs=inputs)
        refits = Refits(folder, inputs, config, versions())
        problem = build_problem(run)

        def note(text: str) -> None:
            folder.log("stage", text=text)
            watcher.stage(text)

        nominal: Solution | None = None
        if run.diagnosis.noise_fraction < 1 and problem.held_out:
            # in units of noise the solver would take any fit for a bad one and start again elsewhere
            note("solving the nominal model")
            nominal = solve(problem, run.solver.method)
        said = run.diagnosis
        try:
            finding = diagnose(
                in_units_of_noise(problem, run),
                said.candidates,
                thresholds=Thresholds(level=said.level, effects=said.effects),
                solution=nominal,
                progress=note,
                store=refits,
            )
        except KeyboardInterrupt:
            if len(refits):
                log.warning("%d finished refits are in %s; the same command takes them up", len(refits), refits.file)
            raise
        folder.log("end", verdict=finding.verdict, effects=[effect.label for effect in finding.effects])
        predicted = predictions(finding)
        write_trajectories(folder.path / "trajectories.h5", finding, predicted)
        result = finding.to_dict() | {"command": reproducing(run, folder.target)}
        written = folder.write_json("result.json", result | {"inputs": inputs, "versions": versions()})
        if run.output.report:
            watcher.stage("writing the report")
            more = {"finding": finding, "predictions": predicted}
            write_report(folder.path / "report.html", Findings(run.name, run.description, written, problem, more=more))
    refits.clear()
    return DiagnoseOutcome(folder.path, written, finding)


def reproducing(run: Run, folder: Path) -> str:
    """The command that gives a result again; the resolved configuration in its folder, where `--set` changed one."""
    origins = list(run.places.values())
    if any(origin.startswith("--set") for origin in origins):
        near = os.path.relpath(folder)
        return shlex.join(
            ["yid-ocp", "diagnose", str((folder if near.startswith("..") else Path(near)) / "config.yaml")]
        )
    if any(origin.startswith("embedded default") for origin in origins):
        return "yid-ocp diagnose"
    return shlex.join(["yid-ocp", "diagnose", run.file])


def in_units_of_noise(problem: EstimationProblem, run: Run) -> EstimationProblem:
    """The same problem with the noise alone as the sensors' deviations, by `diagnosis.noise_fraction`.

    Priors and weak prior shrink alike, so that every fit stays what it is; what changes is when a gap counts as one.

    Raises
    ------
    ConfigError
        A sensor without a deviation in the settings.
    """
    share, options = run.diagnosis.noise_fraction, problem.options
    if share == 1:
        return problem
    used = {samples.sensor.group for episode in problem.episodes for samples in episode.samples}
    sensors = dict(options.sensors)
    for group in sorted(used):
        std = sensors[group].std if group in sensors else None
        if std is None:
            raise run.refuse(
                f"the share of noise in the deviation of '{group}' is given, but not the deviation",
                "diagnosis",
                "noise_fraction",
                hint=f"set sensors.{group}.std",
            )
        sensors[group] = replace(
            sensors[group], std=_times(share, std), position_std=_encoder(run, problem, sensors, group)
        )
    return problem.with_options(
        replace(
            options,
            sensors=sensors,
            priors={name: share * std for name, std in options.priors.items()},
            huber_threshold=options.huber_threshold / share,
            weak_prior_factor=options.weak_prior_factor**share if options.weak_prior_factor > 0 else 0.0,
            configuration_std=share * options.configuration_std,
            velocity_std=share * options.velocity_std,
        )
    )


def _times(share: float, std: float | Mapping[str, float]) -> float | Mapping[str, float]:
    return {name: share * value for name, value in std.items()} if isinstance(std, Mapping) else share * std


def _encoder(
    run: Run, problem: EstimationProblem, sensors: Mapping[str, SensorOptions], group: str
) -> float | Mapping[str, float] | None:
    """The encoders' deviation, which enters that of efforts, shrunk alike."""
    stated = sensors[group].position_std
    if stated is not None:
        return _times(run.diagnosis.noise_fraction, stated)
    recorded = [e.recording.joints.position_std for e in problem.episodes if e.recording.joints is not None]
    if group == "joints.effort" and any(std is not None and np.any(std) for std in recorded):
        raise run.refuse(
            "the share of noise is given, but the encoders' deviation stands in the recordings alone",
            "diagnosis",
            "noise_fraction",
            hint=f"set sensors.{group}.position_std",
        )
    return None


def predictions(finding: Finding) -> list[Prediction]:
    """Held-out recordings that can be predicted both before and after."""
    before, after = (fit.problem.validate(fit.problem.vector(fit.values)) for fit in (finding.nominal, finding.last))
    return [
        (episode, first, last)
        for (episode, first), (_, last) in zip(before, after, strict=True)
        if not isinstance(first, str) and not isinstance(last, str)
    ]


def write_trajectories(path: Path, finding: Finding, predicted: Sequence[Prediction]) -> None:
    """Predictions and what the smoother found, as `yid-diagnosis-trajectories/1` (HDF5).

    `RECORDING/GROUP/` for every held-out recording: `t` (M,) [s], `measured`, `before`, `after`, `std` (M, k) and the
    attributes `channels`, `unit`.

    `where/RECORDING/` for every recording that was estimated on, where there was a gap to locate: `edges` (J + 1,) [s]
    since its first node, of the intervals over which unknowns are constant; `mean` and `std` (J, nd) of the unknown
    forces, offsets and biases about the nominal model and `prior` (nd,), the deviation at the largest evidence, zero
    where a group was not taken in; the attributes `unknowns`, `locations`, `kinds`, `units` (nd,) each.

    Raises
    ------
    OutputError
    """
    try:
        with h5py.File(path, "w") as file:
            file.attrs["format"] = TRAJECTORIES
            for episode, before, after in predicted:
                for k, samples in enumerate(episode.samples):
                    group = file.create_group(f"{episode.name}/{samples.sensor.group}")
                    group.attrs["channels"] = np.array(samples.sensor.channels, dtype=h5py.string_dtype())
                    group.attrs["unit"] = samples.sensor.unit
                    arrays = {
                        "t": episode.grid.start + episode.grid.time_step * (samples.node + samples.fraction),
                        "measured": samples.value,
                        "before": before.predicted[k],
                        "after": after.predicted[k],
                        "std": samples.std,
                    }
                    for name, array in arrays.items():
                        group.create_dataset(name, data=array, compression="gzip", shuffle=True)
            _write_unknowns(file, finding)
    except OSError as error:
        raise OutputError(f"the trajectories cannot be written: {error}", where=str(path)) from error


def _write_unknowns(file: h5py.File, finding: Finding) -> None:
    if finding.smoothed is None:
        return
    for trace in finding.smoothed.traces:
        group = file.create_group(f"where/{trace.recording}")
        texts = {
            "unknowns": trace.unknowns,
            "locations": [source.location for source in trace.sources],
            "kinds": [source.kind for source in trace.sources],
            "units": units(finding.nominal.problem.system, trace),
        }
        for name, values in texts.items():
            group.attrs[name] = np.array(values, dtype=h5py.string_dtype())
        variance = np.array([finding.smoothed.variance[source] for source in trace.sources])
        arrays = {
            "edges": trace.edges,
            "mean": trace.mean * trace.reference,
            "std": trace.std * trace.reference,
            "prior": np.sqrt(variance) * trace.reference,
        }
        for name, array in arrays.items():
            group.create_dataset(name, data=array, compression="gzip", shuffle=True)
