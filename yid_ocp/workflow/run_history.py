"""Functions that read and compare estimates of earlier runs: baseline of a diagnosis, and the command `report`."""

from __future__ import annotations

import argparse
import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import is_dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from yid_ocp.analysis import run_estimates
from yid_ocp.config.reader import load_config
from yid_ocp.config.settings import EffectSettings, ParameterSettings, RunSettings
from yid_ocp.data.recording import Recording
from yid_ocp.data.recording_hdf5 import open_hdf5_after_read_check, read_recording
from yid_ocp.diagnosis.thresholds import Thresholds
from yid_ocp.display import Progress, abbreviated_names_text
from yid_ocp.errors import ConfigError, DataError, YidError
from yid_ocp.files import attributes_to_dict, file_sha256, is_file, read_input_json
from yid_ocp.inference.null_test import EXTRAPOLATION_FACTOR
from yid_ocp.model.objects import ObjectBuilder
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.predictions import ChannelPrediction
from yid_ocp.report.animation import AnimationData, ConfigurationTrajectory, animation_of_trajectories
from yid_ocp.version import package_version
from yid_ocp.workflow.build import build_system
from yid_ocp.workflow.command_runner import CommandOutcome, run_command_and_print
from yid_ocp.workflow.import_recording import has_native_recording_suffix
from yid_ocp.workflow.prediction_outputs import SOLVE_TRAJECTORIES_FORMAT, trajectories_format
from yid_ocp.workflow.run_folder import atomic_run_folder
from yid_ocp.workflow.run_inputs import (
    existing_input_file,
    read_recordings_of_role,
    resolve_recording_path,
    uniquely_named_recordings,
)

log = logging.getLogger(__name__)

ESTIMATE_FORMAT_BY_COMMAND = {"solve": "yid-solve/1", "diagnose": "yid-diagnosis/2"}
"""Format identifiers of result.json by command, for commands that estimate parameters."""
_COMPARED_MODEL_SECTIONS = ("robot", "arms", "object", "grasp", "joint_springs", "gravity")
"""Sections of `model` in which a baseline's settings must be the same, so that parameters mean the same thing."""
_SAME_MODEL = f"the same {', '.join(_COMPARED_MODEL_SECTIONS)} under `model`"


def read_estimates(folder: str | Path) -> run_estimates.RunEstimates:
    """Read the estimates and covariance of free parameters from the run folder of a `solve` or `diagnose`.

    Raises `DataError` without a finished run, or for a result that is unreadable, old, of another command, or failed.
    """
    file, result = Path(folder) / "result.json", read_estimation_result(folder, needs_minimum=True)
    again = f"repeat the run with this version: {result.get('command', 'the command of this folder')}"
    try:
        said = result.get("model", result)  # of a diagnosis, the final model
        known, parameters = said["covariance"], said["parameters"]
        names = tuple(str(name) for name in known["names"])
        values = np.array([float(parameters[name]["value"]) for name in names])
        matrix = np.array(known["matrix"], float).reshape(len(names), len(names))
        # errors of links and time step are the same in all runs; shifts by encoder noise depend on the motions
        shifts = [result.get("discretisation", {}).get(name, {}).get("encoder_noise") or 0.0 for name in names]
        spread = EXTRAPOLATION_FACTOR * np.array(shifts, float)
        matrix += np.outer(spread, spread)
        units = {name: str(parameters[name]["unit"]) for name in names}
        is_rest_noise = result.get("effects") and result["remaining"]["p_value"] >= Thresholds.significance_level
        told = result["fit"]["explains"] if "fit" in result else is_rest_noise or result["verdict"] == "no_gap"
        all_values = {name: entry["value"] for name, entry in parameters.items() if "@" in name}
        effects = group_parameter_values_by_effect_label(all_values)
    except (LookupError, TypeError, ValueError) as error:
        fault = f"the key {error} is missing" if isinstance(error, KeyError) else f"a value is not valid ({error})"
        what, allowed = f"the result is damaged, or of another version: {fault}", f"a result of {package_version()}"
        raise DataError(what, where=str(file), allowed=allowed, hint=again) from error
    if not names:
        what, allowed = f"the run {folder} determines no parameter to compare", "runs that determine a free parameter"
        hint = f"leave this run out; `yid-ocp identifiability {folder}/config.yaml --what-if` ranks better experiments"
        raise DataError(what, where=str(file), allowed=allowed, hint=hint)
    if not np.all(np.isfinite(matrix)) or not np.all(np.diag(matrix) > 0):
        what, allowed = "the covariance is missing or invalid", "finite numbers, with a positive diagonal"
        raise DataError(what, where=f"{file}: covariance", allowed=allowed, hint=again)
    return run_estimates.RunEstimates(str(folder), names, values, matrix, units, bool(told), effects)


def group_parameter_values_by_effect_label(parameters: Mapping[str, float]) -> dict[str, dict[str, float]]:
    """Return the values of effect parameters as {effect label: {name without label: value}}; others are left out."""
    found: dict[str, dict[str, float]] = {}
    for name, value in parameters.items():
        label, _, quantity = name.rpartition(".")
        if "@" in label:
            found.setdefault(label, {})[quantity] = float(value)
    return found


def settings_with_added_effects(run: RunSettings, effects: Mapping[str, Mapping[str, float]]) -> RunSettings:
    """Return settings whose model also has `effects` (values by label). Effects that it has already are unchanged."""
    present = {effect.label for effect in run.model.effects}
    parts = [(label.partition("@"), values) for label, values in effects.items() if label not in present]
    added = [EffectSettings(kind=kind, location=location, values=values) for (kind, _, location), values in parts]
    return replace(run, model=replace(run.model, effects=(*run.model.effects, *added)))


def read_estimation_result(
    folder: str | Path, commands: Sequence[str] = ("solve", "diagnose"), needs_minimum: bool = False
) -> dict[str, Any]:
    """Read result.json of a successful run of one of the `commands`. Errors are as in `read_estimates`.

    With `needs_minimum`, a fit that did not converge is an error, because standard deviations hold at a minimum only.
    """
    file = Path(folder) / "result.json"
    result, formats = read_result_file(file), [ESTIMATE_FORMAT_BY_COMMAND[command] for command in commands]
    if result.get("format") not in formats:
        what = f"the run folder has a result of another command (format {result.get('format')})"
        hint = f"give a run folder of {' or '.join(f'`{command}`' for command in commands)}"
        raise DataError(what, where=str(file), allowed=" or ".join(formats), hint=hint)
    if result.get("status") == "failed":
        what, hint = f"the run in this folder failed: {result.get('message')}", "give the folder of a successful run"
        raise DataError(what, where=str(file), allowed="a successful run", hint=hint)
    if needs_minimum and result.get("status") == "iteration_limit":
        what, allowed = "the fit of this run did not converge, so its values are not estimates", "a run that converged"
        raise DataError(what, where=str(file), allowed=allowed, hint=f"repeat the run: {result['message']}")
    return result


def read_result_file(file: Path) -> dict[str, Any]:
    """Read the result.json of any command. Raises `DataError` if it cannot be read."""
    if not is_file(file):
        hint = "give the folder of one run, as `solve` or `diagnose` printed it, such as runs/NAME"
        lack = "is not the folder of a finished run" if file.parent.is_dir() else "is not an existing folder"
        what = f"{file.parent} {lack}"
        raise DataError(what, where=str(file), allowed="a run folder with result.json", hint=hint)
    result = read_input_json(file)
    if not isinstance(result, dict):
        what, hint = "the file does not have the result of a run", "repeat the command that made the folder"
        raise DataError(what, where=str(file), allowed="result.json as a command wrote it", hint=hint)
    return result


def estimates_of_each_baseline_run(run: RunSettings) -> tuple[run_estimates.RunEstimates, ...]:
    """Read the estimates of the baseline runs. Raises `ConfigError` if one has another model or is listed twice."""
    found: list[run_estimates.RunEstimates] = []
    for i, folder in enumerate(run.diagnosis.baseline_run_folders):
        where = ("diagnosis", "baseline_run_folders", i)
        try:
            own = read_estimates(folder)
        except DataError as error:
            raise run.config_error(error.what, *where, allowed=error.allowed, hint=error.hint) from error
        if any(Path(folder).resolve() == Path(other.run_name).resolve() for other in found):
            what, hint = f"the baseline run {folder} is given twice", "leave one of the two out"
            raise run.config_error(what, *where, allowed="every baseline run once", hint=hint)
        if differing := _difference({"this configuration": run, str(folder): _settings(folder)}):
            what = f"the baseline run is of another model: {differing}"
            hint = f"compare `model` with {Path(folder) / 'config.yaml'}, or choose another baseline run"
            raise run.config_error(what, *where, allowed=_SAME_MODEL, hint=hint)
        found.append(own)
    if dependent := _dependent(run.diagnosis.baseline_run_folders):
        allowed, hint = "runs that are not a baseline of each other", "give the later run only"
        raise run.config_error(dependent, "diagnosis", "baseline_run_folders", allowed=allowed, hint=hint)
    return tuple(found)


def _dependent(folders: Sequence[str | Path]) -> str:
    """Return a message about a run that is the baseline of another one of `folders`. Empty if there is none."""
    known = [Path(folder).resolve() for folder in folders]
    for folder in known:
        for own in settings.diagnosis.baseline_run_folders if (settings := _settings(folder)) else ():
            if Path(own).resolve() in known:
                return f"{own} would count twice, because it is a baseline of {folder}"
    return ""


def require_runs_of_one_model(folders: Sequence[Path]) -> None:
    """Check that all run folders have the same model and none is the baseline of another. Raises `ConfigError`."""
    if dependent := _dependent(folders):
        allowed, hint = "runs that are no baseline of each other", "diagnose without --baseline, or leave one run out"
        raise ConfigError(dependent, where="arguments of `report`", allowed=allowed, hint=hint)
    known = [(folder, settings) for folder in folders if (settings := _settings(folder)) is not None]
    for folder, settings in known[1:]:
        if differing := _difference({str(known[0][0]): known[0][1], str(folder): settings}):
            what = f"the runs have different models: {differing}"
            hint = "give runs of one model; or, to compare two models, two runs of the same recordings"
            raise ConfigError(what, where=str(folder / "config.yaml"), allowed=_SAME_MODEL, hint=hint)


def _difference(runs: Mapping[str, RunSettings | None]) -> str:
    """Say which key of `model` differs first between two runs by label. Empty if none differs, or one is None."""
    known = [own.model for own in runs.values() if own is not None]
    for key in _COMPARED_MODEL_SECTIONS if len(known) == 2 else ():
        here, other = (getattr(model, key) for model in known)
        if key == "robot" and here is not None and other is not None:
            here, other = Path(here).name, Path(other).name  # a folder may have been moved
        if isinstance(here, ObjectBuilder) and isinstance(other, ObjectBuilder):
            here, other = here.with_file_names_instead_of_paths(), other.with_file_names_instead_of_paths()
        if here != other:
            return _first_difference(f"model.{key}", here, other, runs)
    return ""


def _first_difference(key: str, here: Any, there: Any, labels: Iterable[str]) -> str:
    if is_dataclass(here) and type(here) is type(there):
        here, there = vars(here), vars(there)
    if isinstance(here, tuple) and isinstance(there, tuple) and any(map(is_dataclass, here)):
        here, there = dict(enumerate(here)), dict(enumerate(there))
    if isinstance(here, Mapping) and isinstance(there, Mapping):
        name = next(name for name in (*here, *there) if here.get(name) != there.get(name))
        return _first_difference(f"{key}.{name}", here.get(name), there.get(name), labels)
    own = (getattr(value, "kind", "set") if is_dataclass(value) else value for value in (here, there))
    said = (f"no {key}" if value is None else f"{key}: {str(value)[:60]}" for value in own)
    return ", ".join(f"{label} has {words}" for label, words in zip(labels, said, strict=True))


def _settings(folder: str | Path) -> RunSettings | None:
    file = Path(folder) / "config.yaml"
    return load_config(file) if is_file(file) else None


def settings_with_baseline_effects(run: RunSettings, runs: Sequence[run_estimates.RunEstimates]) -> RunSettings:
    """Return settings with the effects of the baseline `runs` at their estimated values, and these parameters free."""
    if not runs:
        return run
    known, _, _ = run_estimates.pool_estimates_and_chi2(runs)
    present = {effect.label for effect in run.model.effects}
    estimated = group_parameter_values_by_effect_label(dict(zip(known.parameter_names, known.values, strict=True)))
    added = {label: {**said, **estimated.get(label, {})} for label, said in known.effects.items()}
    names = [f"{label}.{quantity}" for label in added if label not in present for quantity in estimated.get(label, ())]
    freed = dict.fromkeys(names, ParameterSettings(free=True))
    return replace(settings_with_added_effects(run, added), parameters={**run.parameters, **freed})


def recordings_without_effect_or_reason(run: RunSettings) -> tuple[tuple[Recording, ...], str]:
    """Return recordings without the sought effect (of settings or baseline), and the reason if they are unreadable."""
    found: list[Recording] = []
    for i, path in enumerate(run.recordings.without_effect):
        file = resolve_recording_path(path)
        found.append(read_recording(existing_input_file(run, file, "recording", "recordings", "without_effect", i)))
    for folder in () if found else run.diagnosis.baseline_run_folders:
        there = _settings(folder)
        for path in () if there is None else (*there.recordings.estimate, *there.recordings.held_out):
            try:
                found.append(read_recording(resolve_recording_path(path)))
            except YidError as error:
                return (), f"a recording of {folder} cannot be read: {error.what}"
    named = (replace(recording, name=f"{recording.name} (without)") for recording in found)
    return tuple(uniquely_named_recordings(named)), ""


def require_recordings_not_in_baseline(
    run: RunSettings,
    problem: EstimationProblem,
    runs: Sequence[run_estimates.RunEstimates],
    without: Sequence[Recording],
) -> None:
    """Raise `ConfigError` if a recording of the run is in `without`: those of the baseline or the reference."""
    known = {other.sha256 for other in without} - {None}
    for episode in (*problem.episodes, *problem.held_out):
        if episode.recording.sha256 in known:
            where = ("diagnosis", "baseline_run_folders")
            hint = "leave it out of `recordings`, or choose another baseline"
            what = f"the recording {episode.name} would count twice, because the baseline has it too"
            if not runs or run.recordings.without_effect:
                where, hint = ("recordings", "without_effect"), "remove it from one of the two lists"
                what = f"the recording {episode.name} is also a reference recording"
            raise run.config_error(what, *where, allowed="other recordings", hint=hint)


def run_and_return_exit_code(arguments: argparse.Namespace) -> int:
    """Run the command `report` and return its exit code."""
    paths = [Path(folder) for folder in arguments.runs]
    return run_command_and_print(arguments, lambda shown: _run_report(paths, arguments.out, shown))


def _run_report(paths: Sequence[Path], out: str | Path | None, progress: Progress) -> CommandOutcome[None]:
    """Compare runs of one model as a history, or overlay two runs of the same recordings. Writes JSON and a page."""
    if len(paths) < 2:
        what, hint = "fewer than two runs are given", "add the folder of another run, for example of another day"
        raise ConfigError(what, where="arguments of `report`", allowed="two or more run folders", hint=hint)
    if twice := [str(path) for i, path in enumerate(paths) if path.resolve() in [p.resolve() for p in paths[:i]]]:
        what, hint = f"the run folder {twice[0]} is given twice", "leave one of the two out"
        raise ConfigError(what, where="arguments of `report`", allowed="every run folder once", hint=hint)
    if len(paths) == 2 and _have_same_recordings(paths):
        return _overlay_runs(paths, out, progress)
    labels = [path.name if len({own.name for own in paths}) == len(paths) else str(path) for path in paths]
    estimates = [replace(read_estimates(path), run_name=label) for path, label in zip(paths, labels, strict=True)]
    require_runs_of_one_model(paths)
    progress.begin_stage(f"comparing {len(paths)} runs")
    told = run_drift_and_outliers_to_dict(run_estimates.assess_drift_and_outlier_runs(estimates))
    settings = RunSettings(name="history", description="Runs of one model side by side.")
    with atomic_run_folder(settings, out, "report") as folder:
        folder.input_hashes |= {str(path): file_sha256(path / "result.json") for path in paths}
        folder.log_command_start(["report", *map(str, paths)])
        written = folder.write_result_and_report(settings, progress, told, "history.json")
    return CommandOutcome(folder.path, written, None)


def run_drift_and_outliers_to_dict(found: run_estimates.DriftAndOutlierTestResults) -> dict[str, Any]:
    """Convert drift and outlier tests of several runs to a `yid-history/1` result, without inputs and versions."""
    parameters = {}
    for entry in found.parameter_drift_tests:
        known = zip(entry.run_names, entry.values, entry.std, strict=True)
        values = {name: {"value": value, "std": std} for name, value, std in known}
        own = attributes_to_dict(entry, "unit mean mean_std chi2 p_value drifted=has_drifted")
        parameters[entry.name] = own | {"values": values}
    names = "name=run_name chi2 degrees=degrees_of_freedom p_value explains=is_fit_adequate distrusted=is_outlier"
    return {
        "format": "yid-history/1",
        **attributes_to_dict(found, "level=significance_level chi2 degrees=degrees_of_freedom p_value"),
        "runs": [attributes_to_dict(entry, names) for entry in found.run_outlier_tests],
        "parameters": parameters,
    }


def _have_same_recordings(folders: Sequence[Path]) -> bool:
    """Return whether two runs have the same recordings. Raises `ConfigError` if they share only some of them."""
    inputs = [read_result_file(folder / "result.json").get("inputs", {}) for folder in folders]
    known = [{digest: path for path, digest in own.items() if has_native_recording_suffix(path)} for own in inputs]
    if not known[0].keys() & known[1].keys():
        return False
    lacking = []
    for folder, own, other in zip(folders, known, reversed(known), strict=True):
        lacking += [f"{Path(path).name} only in {folder}" for digest, path in own.items() if digest not in other]
    if lacking:
        what = f"the runs share some recordings but not all: {', '.join(lacking)}"
        allowed = "two runs of the same recordings, or runs without a common recording"
        hint = "run one of them again with the `recordings` of the other"
        raise ConfigError(what, where="report RUN RUN", allowed=allowed, hint=hint)
    return True


def _overlay_runs(folders: Sequence[Path], out: str | Path | None, progress: Progress) -> CommandOutcome[None]:
    """Overlay two runs of the same recordings and write `overlay.json` and report.html."""
    labels = [folder.name if folders[0].name != folders[1].name else str(folder) for folder in folders]
    results, roles = [read_estimation_result(folder, needs_minimum=True) for folder in folders], dict[str, list[str]]()
    progress.begin_stage("overlaying the predictions of both runs")
    known = [_stored_predictions(folder, roles) for folder in folders]
    pairs = [(own, known[1][key]) for key, own in known[0].items() if key in known[1]]
    if not pairs:
        names = (abbreviated_names_text(list(dict.fromkeys(name for _, name in own))) for own in known)
        said = (f"{label} predicts {own or 'nothing'}" for label, own in zip(labels, names, strict=True))
        what = f"the runs predict no common channel: {', '.join(said)}"
        allowed, hint = "one common channel or more", "compare runs that use the same `sensors`. No report was written"
        raise DataError(what, where=f"{folders[0]} and {folders[1]}", allowed=allowed, hint=hint)
    pairs.sort(key=lambda pair: "estimate" in roles[pair[0].recording])
    channels = [
        {
            **attributes_to_dict(own, "recording channel unit"),
            "held_out": "estimate" not in roles[own.recording],
            "rmse": {labels[0]: own.rmse, labels[1]: other.rmse},
            "difference": replace(other, t=own.t, predicted=other.predicted_at(own.t), measured=own.predicted).rmse,
        }
        for own, other in pairs
    ]
    found = [result.get("model", result)["parameters"] for result in results]
    runs = dict(zip(labels, map(str, folders), strict=True))
    parameters = _overlaid_parameters(labels, found)
    first, second = map(_settings, folders)
    told = {"format": "yid-overlay/1", "runs": runs, "parameters": parameters, "channels": channels}
    told["model_difference"] = _difference(dict(zip(labels, (first, second), strict=True)))
    fits = {label: result.get("fit", {}) for label, result in zip(labels, results, strict=True)}
    told["poor"] = [label for label, fit in fits.items() if fit.get("explains") is False]
    settings = RunSettings(name="overlay", description="Two runs of the same recordings, one over the other.")
    with atomic_run_folder(settings, out, "report") as folder:
        folder.input_hashes |= {str(path): file_sha256(path / "result.json") for path in folders}
        folder.log_command_start(["report", *map(str, folders)])
        robot, motions = None if first is None else first.model.robot, _overlaid_motions(folders, labels, found)
        about: dict[str, Any] = {"robot": robot, "animations": motions, "section_data": {"overlay": pairs}}
        written = folder.write_result_and_report(settings, progress, told, "overlay.json", **about)
    return CommandOutcome(folder.path, written, None)


def _overlaid_parameters(labels: Sequence[str], found: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return values of parameters that are free in a run, with their difference, also in units of the larger std."""
    parameters: dict[str, Any] = {}
    for name in dict.fromkeys(name for own in found for name, entry in own.items() if entry.get("free", True)):
        known = {label: own[name] for label, own in zip(labels, found, strict=True) if name in own}
        kept = {"value": None, "std": None, "free": True, "verdict": None}
        values = {label: {key: own.get(key, kept[key]) for key in kept} for label, own in known.items()}
        both = [own["value"] for own in values.values() if own["verdict"] != "not_identifiable"]
        apart = both[1] - both[0] if len(both) == 2 else None
        largest = max(own["std"] or 0.0 for own in values.values())
        over = None if apart is None or largest == 0 else apart / largest
        unit = next(iter(known.values()))["unit"]
        parameters[name] = {"unit": unit, "values": values, "difference": apart, "difference_in_std": over}
    return parameters


def _stored_predictions(folder: Path, roles: dict[str, list[str]]) -> dict[tuple[str, str], ChannelPrediction]:
    """Return predictions in a run's trajectories.h5 by recording and channel. Adds each recording's role to `roles`."""
    found: dict[tuple[str, str], ChannelPrediction] = {}
    with open_hdf5_after_read_check(folder / "trajectories.h5") as file:
        is_solve = trajectories_format(file) == SOLVE_TRAJECTORIES_FORMAT
        parent = file["recordings"] if is_solve else file
        for name in (name for name in parent if is_solve or name not in ("where", "events")):
            roles.setdefault(name, []).append(str(parent[name].attrs.get("role", "held_out")))
            for group in (own for own in parent[name].values() if isinstance(own, h5py.Group)):
                arrays = [np.array(group[key]) for key in ("measured", "predicted" if is_solve else "after", "std")]
                t, names = np.array(group["t"]), list(map(str, group.attrs["channels"]))
                width = arrays[0].shape[1] // len(names)
                for i, channel in enumerate(names):
                    own = (values[:, width * i : width * (i + 1)] for values in arrays)
                    times = t if t.ndim == 1 else t[:, width * i]
                    found[name, channel] = ChannelPrediction(name, channel, str(group.attrs["units"][i]), times, *own)
    return found


def _overlaid_motions(
    folders: Sequence[Path], labels: Sequence[str], found: Sequence[Mapping[str, Any]]
) -> list[AnimationData]:
    """Return animations of measured and predicted motions of both runs. Empty if a model or file cannot be read."""
    told: dict[str, list[ConfigurationTrajectory]] = {}
    try:
        runs = [load_config(folder / "config.yaml") for folder in folders]
        recordings = [own for which in ("held_out", "estimate") for own in read_recordings_of_role(runs[0], which)]
        for folder, label, run, values in zip(folders, labels, runs, found, strict=True):
            system = build_system(run)
            known = {name: entry["value"] for name, entry in values.items() if name in system.parameters}
            model = label, system, system.parameters.vector(known)
            with open_hdf5_after_read_check(folder / "trajectories.h5") as file:
                for name, group in file.get("recordings", {}).items():
                    if "q" in group:
                        path = ConfigurationTrajectory(*model, np.array(group["t"]), np.array(group["q"]))
                        told.setdefault(name, []).insert(0, path)  # the last one is drawn in the first color
    except YidError as error:
        log.warning("the report has no animation of the motions; all else is complete. The reason: %s", error.what)
        return []
    return [animation_of_trajectories(r.name, told[r.name], r) for r in recordings if len(told.get(r.name, ())) == 2]
