"""The command `diagnose`: is there a gap, where, which effect makes it; writes the run folder."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from yid_ocp.diagnosis import Finding, Thresholds, diagnose
from yid_ocp.errors import OutputError
from yid_ocp.problem import EstimationProblem
from yid_ocp.report.html import write_report
from yid_ocp.report.sections import Findings
from yid_ocp.solvers import Solution, solve
from yid_ocp.workflow.build import build_problem
from yid_ocp.workflow.folder import Monitor, Silent, input_hashes, new_run_folder, versions
from yid_ocp.workflow.settings import Run, dump_config

TRAJECTORIES = "yid-diagnosis-trajectories/1"


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
    """Diagnose and write the run folder.

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
        inputs = input_hashes(run)
        folder.write("config.yaml", dump_config(run))
        watcher.stage("building the model and its compiled step")
        folder.log("start", command="diagnose", versions=versions(), inputs=inputs)
        problem = build_problem(run)

        def note(text: str) -> None:
            folder.log("stage", text=text)
            watcher.stage(text)

        nominal: Solution | None = None
        if run.diagnosis.noise_share < 1 and problem.held_out:
            # in units of noise the solver would take any fit for a bad one and start again elsewhere
            note("solving the nominal model")
            nominal = solve(problem, run.solver.method)
        said = run.diagnosis
        finding = diagnose(
            in_units_of_noise(problem, run),
            said.candidates,
            thresholds=Thresholds(level=said.level, effects=said.effects),
            solution=nominal,
            progress=note,
        )
        folder.log("end", verdict=finding.verdict, effects=[effect.label for effect in finding.effects])
        write_predictions(folder.path / "trajectories.h5", finding)
        again = f"yid-ocp diagnose {run.file}" if run.file else "yid-ocp diagnose"
        result = finding.to_dict() | {"command": again, "inputs": inputs, "versions": versions()}
        written = folder.write_json("result.json", result)
        if run.output.report:
            watcher.stage("writing the report")
            write_report(folder.path / "report.html", Findings(run.name, run.description, written, problem))
    return DiagnoseOutcome(folder.path, written, finding)


def in_units_of_noise(problem: EstimationProblem, run: Run) -> EstimationProblem:
    """The same problem with the noise alone as the sensors' deviations, by `diagnosis.noise_share`.

    Priors and tie-break shrink alike, so that every fit stays what it is; what changes is when a gap counts as one.

    Raises
    ------
    ConfigError
        A sensor without a deviation in the settings.
    """
    share, options = run.diagnosis.noise_share, problem.options
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
                "noise_share",
                hint=f"set sensors.{group}.std",
            )
        smaller = {name: share * value for name, value in std.items()} if isinstance(std, Mapping) else share * std
        sensors[group] = replace(sensors[group], std=smaller)
    return problem.with_options(
        replace(
            options,
            sensors=sensors,
            priors={name: share * std for name, std in options.priors.items()},
            tie_break=options.tie_break**share if options.tie_break > 0 else 0.0,
            configuration_std=share * options.configuration_std,
            velocity_std=share * options.velocity_std,
        )
    )


def write_predictions(path: Path, finding: Finding) -> None:
    """Held-out measurements beside their prediction before and after, as `yid-diagnosis-trajectories/1` (HDF5).

    `RECORDING/GROUP/`: `t` (M,) [s], `measured`, `before`, `after`, `std` (M, k) and the attributes `channels`, `unit`.

    Raises
    ------
    OutputError
    """
    runs = []
    for fit in (finding.nominal, finding.last):
        x = fit.problem.unknowns(fit.values)
        runs.append(dict(enumerate(fit.problem.validate(x))))
    try:
        with h5py.File(path, "w") as file:
            file.attrs["format"] = TRAJECTORIES
            for i, (episode, before) in runs[0].items():
                after = runs[1][i][1]
                if isinstance(before, str) or isinstance(after, str):
                    continue
                for k, samples in enumerate(episode.samples):
                    group = file.create_group(f"{episode.name}/{samples.sensor.group}")
                    group.attrs["channels"] = np.array(samples.sensor.channels, dtype=h5py.string_dtype())
                    group.attrs["unit"] = samples.sensor.unit
                    t = episode.grid.start + episode.grid.time_step * (samples.node + samples.fraction)
                    arrays = {
                        "t": t,
                        "measured": samples.value,
                        "before": before.predicted[k],
                        "after": after.predicted[k],
                        "std": samples.std,
                    }
                    for name, array in arrays.items():
                        group.create_dataset(name, data=array, compression="gzip", shuffle=True)
    except OSError as error:
        raise OutputError(f"the predictions cannot be written: {error}", where=str(path)) from error
