"""The command `diagnose`: is there a gap, where, which effect makes it; writes the run folder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from yid_ocp.diagnosis import Finding, Thresholds, diagnose
from yid_ocp.errors import OutputError
from yid_ocp.report.html import write_report
from yid_ocp.report.sections import Findings
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

        said = run.diagnosis
        finding = diagnose(
            problem,
            said.candidates,
            thresholds=Thresholds(level=said.level, effects=said.effects),
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
