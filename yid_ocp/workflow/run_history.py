"""Earlier runs: their estimates, as baseline of a diagnosis and in the command `report`."""

from __future__ import annotations

import argparse
import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from yid_ocp.analysis.estimate_history import EstimateHistory, RunEstimates, assess_drift, pool_estimates
from yid_ocp.config.reader import load_config
from yid_ocp.config.settings import EffectSettings, ParameterSettings, RunSettings
from yid_ocp.data.recording import Recording
from yid_ocp.data.recording_hdf5 import read_recording
from yid_ocp.errors import ConfigError, DataError, YidError
from yid_ocp.files import file_sha256, is_file
from yid_ocp.model.objects import ObjectKind
from yid_ocp.problem import EstimationProblem
from yid_ocp.progress import NULL_PROGRESS, Progress
from yid_ocp.report.html import write_report
from yid_ocp.report.sections import ReportData
from yid_ocp.report.summaries import history_summary
from yid_ocp.version import installed_versions
from yid_ocp.workflow.command_runner import CommandResult, run_and_print
from yid_ocp.workflow.run_folder import local_time_text, new_run_folder
from yid_ocp.workflow.run_inputs import recording_path

_RUN_FORMATS = ("yid-solve/1", "yid-diagnosis/2")
_OLD_FORMATS = ("yid-diagnosis/1",)
"""Of earlier versions, which had other keys."""
_COMPARED_MODEL_SECTIONS = ("robot", "arms", "clamps", "object", "grasp", "springs", "gravity")
"""Sections of `model` in which a baseline's settings must be the same, so that parameters mean the same thing."""


def read_estimates(folder: str | Path) -> RunEstimates:
    """Estimates and covariance of the free parameters, read from a run folder of `solve` or `diagnose`.

    Returns
    -------
    RunEstimates
        Parameters that were not found at all are left out.

    Raises
    ------
    DataError
        There is no finished run, its result cannot be read, is one of another command or of an older format, or its
        solve failed.
    """
    file, result = Path(folder) / "result.json", read_run_result(folder)
    try:
        said = result.get("model", result)  # of a diagnosis, the model that it ended with
        known, parameters = said["covariance"], said["parameters"]
        names = tuple(str(name) for name in known["names"])
        values = np.array([float(parameters[name]["value"]) for name in names])
        matrix = np.array(known["matrix"], float).reshape(len(names), len(names))
        units = {name: str(parameters[name]["unit"]) for name in names}
        explains = bool(result["fit"]["explains"]) if "fit" in result else result["verdict"] == "no_gap"
        effects: dict[str, dict[str, float]] = {}
        for name, entry in parameters.items():
            label, _, quantity = name.rpartition(".")
            if "@" in label:
                effects.setdefault(label, {})[quantity] = float(entry["value"])
    except (LookupError, TypeError, ValueError) as error:
        what = "the result does not say how sure its parameters are together"
        allowed = "keys parameters and covariance, as this version writes them"
        raise DataError(what, where=str(file), allowed=allowed, hint="run it again") from error
    if not names:
        raise DataError(
            "the run found no parameter", where=str(file), hint="give a run in which some parameter was found"
        )
    if not np.all(np.isfinite(matrix)) or not np.all(np.diag(matrix) > 0):
        raise DataError("its covariance is none", where=str(file), allowed="finite, with a positive diagonal")
    return RunEstimates(str(folder), names, values, matrix, units, explains, effects)


def read_run_result(folder: str | Path) -> dict[str, Any]:
    """Contents of result.json of a successful `solve` or `diagnose`; errors as `read_estimates`."""
    file = Path(folder) / "result.json"
    result = _result(file)
    require_current_format(result, file)
    if result.get("format") not in _RUN_FORMATS:
        what = f"the run folder is one of another command ({result.get('format')})"
        raise DataError(
            what, where=str(file), allowed=" or ".join(_RUN_FORMATS), hint="give a run folder of `solve` or `diagnose`"
        )
    if result.get("status") == "failed":
        raise DataError(f"the run failed: {result.get('message')}", where=str(file), hint="give one that converged")
    return result


def require_current_format(result: Mapping[str, Any], file: Path) -> None:
    """Raise an error where a result is of an earlier version, whose keys had other names.

    Raises
    ------
    DataError
    """
    if result.get("format") in _OLD_FORMATS:
        raise DataError(
            f"the run is of an earlier version ({result['format']}), whose keys had other names; "
            "CHANGELOG.md has the table old -> new under Unreleased",
            where=str(file),
            allowed=" or ".join(_RUN_FORMATS),
            hint="diagnose again with this version",
        )


def _result(file: Path) -> dict[str, Any]:
    if not is_file(file):
        hint = "give the run folder that `solve` or `diagnose` printed"
        raise DataError(f"there is no finished run in {file.parent}", where=str(file), hint=hint)
    try:
        result = json.loads(file.read_text(encoding="utf-8"))
        return dict(result)
    except (OSError, ValueError, TypeError, RecursionError) as error:
        raise DataError(f"the result cannot be read ({error})", where=str(file), hint="run it again") from error


def baseline_estimates(run: RunSettings) -> tuple[RunEstimates, ...]:
    """Estimates of the runs listed in `diagnosis.baseline`, in that order.

    Raises
    ------
    ConfigError, DataError
        As `read_estimates`; a run of another model, or one that is given twice.
    """
    found: list[RunEstimates] = []
    for i, folder in enumerate(run.diagnosis.baseline):
        where = ("diagnosis", "baseline", i)
        try:
            own = read_estimates(folder)
        except DataError as error:
            raise run.config_error(error.what, *where, allowed=error.allowed, hint=error.hint) from error
        if any(Path(folder).resolve() == Path(other.run_name).resolve() for other in found):
            raise run.config_error(
                f"{folder} is given twice, and would count twice", *where, hint="list every run once"
            )
        there = _settings(folder)
        differing = "" if there is None else _different(run, there)
        if differing:
            what = f"{folder} is a run of another model: model.{differing} differs"
            hint = f"compare model.{differing} with {Path(folder) / 'config.yaml'}"
            allowed = f"the same {', '.join(_COMPARED_MODEL_SECTIONS)} under `model`"
            raise run.config_error(what, *where, allowed=allowed, hint=hint)
        found.append(own)
    dependent = _dependent(run.diagnosis.baseline)
    if dependent:
        raise run.config_error(dependent, "diagnosis", "baseline", hint="give the later one alone")
    return tuple(found)


def _dependent(folders: Sequence[str | Path]) -> str:
    """Says which run has another one of them as its baseline, so that one would count twice; empty where none has."""
    known = [Path(folder).resolve() for folder in folders]
    for folder in known:
        said = _result(folder / "result.json").get("baseline") or {}
        twice = [own for own in said.get("runs", ()) if Path(own).resolve() in known]
        if twice:
            return f"{folder} has {twice[0]} as its baseline already, which would count twice"
    return ""


def require_same_model(folders: Sequence[Path]) -> None:
    """Raise an error unless all run folders have the same model and none is the baseline of another.

    Raises
    ------
    ConfigError
    """
    dependent = _dependent(folders)
    if dependent:
        raise ConfigError(dependent, where="report", hint="diagnose without --baseline for a history, or leave one out")
    known = [(folder, settings) for folder in folders if (settings := _settings(folder)) is not None]
    for folder, settings in known[1:]:
        differing = _different(known[0][1], settings)
        if differing:
            allowed = f"the same {', '.join(_COMPARED_MODEL_SECTIONS)} under `model` as in {known[0][0]}"
            what = f"the runs are of different models: model.{differing} differs"
            raise ConfigError(what, where=str(folder / "config.yaml"), allowed=allowed)


def _different(run: RunSettings, there: RunSettings) -> str:
    """The first section of the model in which two runs differ, empty where none does."""
    for key in _COMPARED_MODEL_SECTIONS:
        here, other = getattr(run.model, key), getattr(there.model, key)
        if key == "robot" and here is not None and other is not None:
            here, other = Path(here).name, Path(other).name  # a folder may have moved
        if isinstance(here, ObjectKind) and isinstance(other, ObjectKind):
            here, other = here.without_folders(), other.without_folders()
        if here != other:
            return key
    return ""


def _settings(folder: str | Path) -> RunSettings | None:
    try:
        return load_config(Path(folder) / "config.yaml")
    except YidError:
        return None


def with_baseline_effects(run: RunSettings, runs: Sequence[RunEstimates]) -> RunSettings:
    """The run with the effects of its baseline at their estimated values; their estimated parameters are free."""
    if not runs:
        return run
    known, _, _ = pool_estimates(runs)
    present = {f"{effect.kind}@{effect.location}" for effect in run.model.effects}
    values = dict(zip(known.parameter_names, map(float, known.values), strict=True))
    added = []
    for label, said in known.effects.items():
        if label not in present:
            kind, _, location = label.partition("@")
            own = {quantity: values.get(f"{label}.{quantity}", value) for quantity, value in said.items()}
            added.append(EffectSettings(kind=kind, location=location, values=own))
    freed: Mapping[str, ParameterSettings] = {
        name: ParameterSettings(free=True) for name in known.parameter_names if name.rpartition(".")[0] not in present
    }
    # of an effect that is added here only what was estimated is free
    freed = {name: said for name, said in freed.items() if name.rpartition(".")[0] in known.effects}
    model = replace(run.model, effects=(*run.model.effects, *added))
    return replace(run, model=model, parameters={**run.parameters, **freed})


def load_reference_recordings(run: RunSettings) -> tuple[tuple[Recording, ...], str]:
    """Reference recordings made without the sought effect, and a message where there are none.

    Those of `recordings.reference_recordings`, else those on which the baseline was estimated and which it held out.

    Raises
    ------
    ConfigError, DataError
        As `read_recordings`, of those that the settings name.
    """
    said = run.recordings.reference_recordings
    if said:
        return _named([_read(run, i, path) for i, path in enumerate(said)]), ""
    found: list[Recording] = []
    for folder in run.diagnosis.baseline:
        there = _settings(folder)
        for path in () if there is None else (*there.recordings.estimate, *there.recordings.held_out):
            try:
                found.append(read_recording(recording_path(path)))
            except YidError as error:
                return (), f"a recording of {folder} cannot be read: {error.what}"
    return _named(found), ""


def _read(run: RunSettings, i: int, path: str) -> Recording:
    file = recording_path(path)
    if not is_file(file):
        raise run.config_error(
            f"there is no such recording: {file}", "recordings", "reference_recordings", i, hint="check the path"
        )
    return read_recording(file)


def _named(recordings: Sequence[Recording]) -> tuple[Recording, ...]:
    return tuple(replace(recording, name=f"{recording.name} (without)") for recording in recordings)


def require_distinct_recordings(
    run: RunSettings, problem: EstimationProblem, runs: Sequence[RunEstimates], without: Sequence[Recording]
) -> None:
    """Raise an error where a recording of the run is also a baseline or reference recording.

    Raises
    ------
    ConfigError
    """
    for episode in (*problem.episodes, *problem.held_out):
        for other in without:
            if episode.recording.sha256 is not None and episode.recording.sha256 == other.sha256:
                of_baseline = bool(runs) and not run.recordings.reference_recordings
                raise run.config_error(
                    f"{episode.name} is a recording of the baseline too, and would count twice"
                    if of_baseline
                    else f"{episode.name} is among the recordings made without what is looked for",
                    *(("diagnosis", "baseline") if of_baseline else ("recordings", "reference_recordings")),
                    allowed="recordings of another time",
                )


_RESULT_FORMAT = "yid-history/1"


def run(arguments: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    return run_and_print(arguments, lambda shown: run_report(arguments.runs, arguments.out, shown), history_summary)


def run_report(
    folders: Sequence[str | Path], out: str | Path | None = None, progress: Progress = NULL_PROGRESS
) -> CommandResult:
    """Compare runs of one model and write `history.json` and report.html.

    Parameters
    ----------
    folders : sequence of str or Path
        Run folders of `solve` or `diagnose`, in the order of time; two or more.

    Raises
    ------
    ConfigError, DataError, OutputError
        Fewer than two runs, one given twice, runs of different models, or what `read_estimates` refuses.
    """
    paths = [Path(folder) for folder in folders]
    if len(paths) < 2:
        hint = "add the runs of other days"
        raise ConfigError("one run has no history", where="report", allowed="two or more run folders", hint=hint)
    twice = [str(path) for i, path in enumerate(paths) if path.resolve() in [p.resolve() for p in paths[:i]]]
    if twice:
        raise ConfigError("a run is given twice, and would count twice", where=twice[0], hint="list every run once")
    estimates = [read_estimates(path) for path in paths]
    require_same_model(paths)
    progress.begin_stage(f"comparing {len(paths)} runs")
    found = assess_drift(estimates)
    with new_run_folder(RunSettings(name="history"), out, "report") as folder:
        inputs = {str(path): file_sha256(path / "result.json") for path in paths}
        folder.log_event("start", command="report", versions=installed_versions(), inputs=inputs)
        again = shlex.join(["yid-ocp", "report", *map(str, folders)])
        made = {"command": again, "date": local_time_text(), "inputs": inputs, "versions": installed_versions()}
        result = history_result(found) | made
        written = folder.write_json_file("history.json", result)
        progress.begin_stage("writing the report")
        write_report(folder.path / "report.html", ReportData("history", "Runs of one model side by side.", written))
    return CommandResult(folder.path, written)


def history_result(found: EstimateHistory) -> dict[str, Any]:
    """`yid-history/1` without inputs and versions."""
    return {
        "format": _RESULT_FORMAT,
        "level": found.significance_level,
        "chi2": found.chi2,
        "degrees": found.degrees_of_freedom,
        "p_value": found.p_value,
        "runs": [
            {
                "name": entry.run_name,
                "chi2": entry.chi2,
                "degrees": entry.degrees_of_freedom,
                "p_value": entry.p_value,
                "worst": entry.worst_parameter,
                "explains": entry.is_fit_adequate,
                "distrusted": entry.is_outlier,
            }
            for entry in found.run_consistencies
        ],
        "parameters": {
            entry.name: {
                "unit": entry.unit,
                "values": {
                    run: {"value": value, "std": std}
                    for run, value, std in zip(entry.run_names, entry.values, entry.std, strict=True)
                },
                "mean": entry.mean,
                "mean_std": entry.mean_std,
                "chi2": entry.chi2,
                "p_value": entry.p_value,
                "drifted": entry.has_drifted,
            }
            for entry in found.parameter_drifts
        },
    }
