"""The command `export`: recordings as CSV or MCAP, signals of a run as MCAP, models for other engines."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from yid_ocp.config.reader import load_config
from yid_ocp.config.settings import EffectSettings, ParameterSettings, RunSettings, dump_config
from yid_ocp.data import read_recording
from yid_ocp.data.hdf5_io import open_checked_hdf5
from yid_ocp.data.recording import Recording
from yid_ocp.errors import ConfigError, DataError, ModelError
from yid_ocp.export.models import (
    EXPORT_FORMAT,
    FormatSupport,
    effect_support,
    parameter_support,
    system_to_sdf,
    system_to_urdf,
)
from yid_ocp.export.signals import TopicSignal, export_csv, export_mcap, signals_from_recording
from yid_ocp.files import file_sha256, to_json_types, write_json, write_text
from yid_ocp.model.system import System
from yid_ocp.progress import NULL_PROGRESS, Progress
from yid_ocp.report.summaries import export_summary
from yid_ocp.report.terminal import recording_summary_lines, terminal_lines
from yid_ocp.virtual.mjcf import mujoco_xml
from yid_ocp.virtual.mujoco_replay import REPLAY_BANDWIDTH, ReplayMismatch, replay_in_mujoco
from yid_ocp.workflow.build import build_system, parameter_settings
from yid_ocp.workflow.command_runner import EXIT_DONE, print_result, show_progress
from yid_ocp.workflow.import_recording import recording_contents
from yid_ocp.workflow.prediction_outputs import DIAGNOSIS_TRAJECTORIES_FORMAT, SOLVE_TRAJECTORIES_FORMAT
from yid_ocp.workflow.run_folder import software_versions
from yid_ocp.workflow.run_history import read_run_result
from yid_ocp.workflow.run_inputs import read_recordings

_MCAP = "mcap"


def run(arguments: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    source, form = Path(arguments.source), arguments.format
    if source.is_dir():
        if form == "csv":
            hint = "export a recording, or the run's signals as mcap"
            raise ConfigError(
                "a run is no table", where="--format csv", allowed=", ".join((*MODEL_FORMATS, _MCAP)), hint=hint
            )
        if form == _MCAP:
            written, notes = export_run_signals(source, arguments.out)
            paths = [str(file) for file in written]
            result = {"format": EXPORT_FORMAT, "file": paths, "kind": form, "notes": notes}
            print_result(arguments, result, lambda: notes, "\n".join(paths), "\n".join(paths))
            return EXIT_DONE
        with show_progress(arguments) as progress:
            manifest = export_model(source, arguments.out, form or "mjcf", progress)
        print_result(
            arguments, manifest, lambda: terminal_lines(export_summary(manifest)), arguments.out, arguments.out
        )
        return EXIT_DONE
    if form not in (None, "csv", _MCAP):
        allowed = f"csv or {_MCAP} of a recording; {', '.join(MODEL_FORMATS)} of a run folder of `solve` or `diagnose`"
        raise ConfigError(f"{source.name} is no run folder", where=f"--format {form}", allowed=allowed)
    recording = read_recording(source, allow_nan_effort=True)
    result, notes = recording_contents(recording), []
    if form == _MCAP:
        files: tuple[Path, ...] = (Path(arguments.out) / f"{source.stem}.mcap",)
        shift = export_mcap(signals_from_recording(recording), files[0])
        if shift:
            notes.append(f"{shift:g} s were added to all times, as stamps cannot be negative")
    else:
        files = export_csv(recording, arguments.out)
    paths = [str(file) for file in files]
    result |= {"format": EXPORT_FORMAT, "file": paths, "kind": form or "csv", "notes": [*result["notes"], *notes]}
    print_result(
        arguments, result, lambda: [*notes, *recording_summary_lines(recording)], "\n".join(paths), "\n".join(paths)
    )
    return EXIT_DONE


MODEL_FORMATS = ("mjcf", "urdf", "sdf", "yaml")


@dataclass(frozen=True)
class _CalibratedModel:
    """Final model of a run: settings with found effects, parameter values and stds."""

    settings: RunSettings
    nominal_settings: RunSettings
    parameter_values: Mapping[str, float]
    parameter_stds: Mapping[str, float | None]


def _read_calibrated_model(folder: str | Path) -> _CalibratedModel:
    folder = Path(folder)
    result = read_run_result(folder)
    try:
        parameters = {str(name): dict(entry) for name, entry in result.get("model", result)["parameters"].items()}
        values = {name: float(entry["value"]) for name, entry in parameters.items()}
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        raise DataError(
            "the result has no parameters", where=str(folder / "result.json"), hint="run it again"
        ) from error
    nominal = load_config(folder / "config.yaml")
    known = {f"{effect.kind}@{effect.location}" for effect in nominal.model.effects}
    found: dict[str, dict[str, float]] = {}
    for name, value in values.items():
        label, _, quantity = name.rpartition(".")
        if "@" in label and label not in known:
            found.setdefault(label, {})[quantity] = value
    effects = [
        EffectSettings(kind=label.partition("@")[0], location=label.partition("@")[2], values=own)
        for label, own in found.items()
    ]
    std = {name: entry.get("std") for name, entry in parameters.items() if entry.get("free")}
    model = replace(nominal.model, effects=(*nominal.model.effects, *effects))
    return _CalibratedModel(replace(nominal, model=model), nominal, values, std)


def export_model(
    folder: str | Path, out: str | Path, form: str = "mjcf", progress: Progress = NULL_PROGRESS
) -> dict[str, Any]:
    """Write the final model of a run and `OUT.manifest.json`, which lists what the format represents.

    Parameters
    ----------
    folder : str or Path
        Run folder of `solve` or `diagnose`.
    out : str or Path
        File to write.
    form : str
        Of `MODEL_FORMATS`.

    Returns
    -------
    dict
        The manifest; of `yaml`, which says all that the run does, without one beside it.

    Raises
    ------
    ConfigError, DataError, ModelError, OutputError
    """
    if form not in MODEL_FORMATS:
        raise _unknown(form)
    calibrated, out = _read_calibrated_model(folder), Path(out)
    progress.begin_stage("building the model")
    if form == "yaml":
        write_text(out, dump_config(_settings_with_estimates(calibrated)))
        return {"format": EXPORT_FORMAT, "file": str(out), "kind": form, "effects": {}, "parameters": {}, "gate": None}
    system, said = _expressible(calibrated, form)
    text = _written(form, system, _own(calibrated.parameter_values, system))
    full = build_system(calibrated.settings)
    manifest: dict[str, Any] = {
        "format": EXPORT_FORMAT,
        "file": out.name,
        "kind": form,
        "run": str(Path(folder).resolve()),
        "result": file_sha256(Path(folder) / "result.json"),
        "effects": {label: vars(entry) for label, entry in said.items()},
        "parameters": {
            name: {
                "value": calibrated.parameter_values.get(name, full.parameters[name].value),
                "unit": full.parameters[name].unit,
                "estimated": name in calibrated.parameter_stds,
                "std": calibrated.parameter_stds.get(name),
                **vars(entry),
            }
            for name, entry in parameter_support(full, said, form).items()
        },
        "grasps": {grasp.name: vars(_said_of_grasp(form)) for grasp in full.grasps},
        "gate": None,
        "versions": software_versions(),
    }
    if form == "mjcf":
        progress.begin_stage("replaying recordings in MuJoCo")
        manifest["gate"] = _gate(calibrated, system, text, progress)
    manifest = to_json_types(manifest)
    write_text(out, text)
    try:
        write_json(_manifest_path(out), manifest)
    except BaseException:
        out.unlink(missing_ok=True)  # a model without its manifest would be silent about what it lacks
        raise
    return manifest


def _manifest_path(out: Path) -> Path:
    return out.with_name(f"{out.name}.manifest.json")


def _settings_with_estimates(calibrated: _CalibratedModel) -> RunSettings:
    system = build_system(calibrated.settings)
    chosen = dict(parameter_settings(calibrated.settings, system.parameters))
    for name in calibrated.parameter_stds:
        chosen.setdefault(name, ParameterSettings(free=True))
    values = calibrated.parameter_values
    parameters = {
        name: replace(said, initial=values[name]) if name in calibrated.parameter_stds else said
        for name, said in chosen.items()
    }
    return replace(calibrated.settings, parameters=parameters)


def _unknown(form: str) -> ConfigError:
    hint = ""
    if form == "usd":
        hint = "mjcf: UsdPhysics has no schema for cables yet, nor springs on joints that turn about three axes"
    return ConfigError(f"there is no format '{form}'", where="--format", allowed=", ".join(MODEL_FORMATS), hint=hint)


def _own(values: Mapping[str, float], system: System) -> dict[str, float]:
    return {name: value for name, value in values.items() if name in system.parameters}


def _written(form: str, system: System, values: Mapping[str, float]) -> str:
    writers: Mapping[str, Callable[[System, Mapping[str, float]], str]] = {
        "mjcf": lambda system, values: mujoco_xml(system, values, emulate=True, actuators=True),
        "urdf": system_to_urdf,
        "sdf": system_to_sdf,
    }
    return writers[form](system, values)


def _said_of_grasp(form: str) -> FormatSupport:
    if form == "mjcf":
        return FormatSupport("native", "equality constraints between sites, or a tendon where it gives way")
    return FormatSupport("not representable", f"{form.upper()} describes a tree: close the loop in the engine")


def _expressible(calibrated: _CalibratedModel, form: str) -> tuple[System, dict[str, FormatSupport]]:
    system = build_system(calibrated.settings)
    said = effect_support(system, _own(calibrated.parameter_values, system), form)
    for _ in range(len(said) + 1):
        kept = [label for label, entry in said.items() if entry.status != "not representable" and _acts(entry)]
        system = _with(calibrated.settings, kept)
        try:
            _written(form, system, _own(calibrated.parameter_values, system))
            return system, said
        except ModelError as error:
            for label in kept:  # what the table cannot tell: it depends on where the effect sits
                alone = _with(calibrated.settings, [label])
                try:
                    _written(form, alone, _own(calibrated.parameter_values, alone))
                except ModelError as own:
                    said[label] = FormatSupport("not representable", own.what)
                    break
            else:
                what = f"the model cannot be written as {form.upper()}: {error.what}"
                hint = error.hint or f"another format: {', '.join(MODEL_FORMATS)}"
                raise ModelError(what, where=error.where, allowed=error.allowed, hint=hint) from error
    raise AssertionError("effects run out")


def _acts(said: FormatSupport) -> bool:
    return not said.how.startswith("neutral")


def _with(run: RunSettings, labels: Sequence[str]) -> System:
    effects = tuple(effect for effect in run.model.effects if f"{effect.kind}@{effect.location}" in labels)
    model, kept = replace(run.model, effects=effects), set(labels)
    parameters = {name: said for name, said in run.parameters.items() if _owner(name) in ("", *kept)}
    return build_system(replace(run, model=model, parameters=parameters))


def _owner(name: str) -> str:
    """Label of the effect whose parameter, or pattern of parameters, a name is; empty for none."""
    return name.rpartition(".")[0] if "@" in name else ""


# -- the gate ---------------------------------------------------------------------------------------------------------


def _gate(calibrated: _CalibratedModel, system: System, text: str, progress: Progress) -> dict[str, Any]:
    """Errors of the exported model, and of the nominal one, on recordings that neither was fitted to."""
    which = "held_out" if calibrated.settings.recordings.held_out else "estimate"
    try:
        recordings = read_recordings(calibrated.settings, which)
        if not recordings:
            return {"status": "not done", "reason": "the run has no recordings"}
        kept = [f"{e.kind}@{e.location}" for e in calibrated.nominal_settings.model.effects]
        present = [f"{e.kind}@{e.location}" for e in system.effects]
        nominal = _with(calibrated.nominal_settings, [label for label in kept if label in present])
        before = _replayed(mujoco_xml(nominal, emulate=True, actuators=True), nominal, recordings, progress)
        after = _replayed(text, system, recordings, progress, 1)
    except (DataError, ModelError) as error:
        return {"status": "not done", "reason": error.what}
    channels = {
        name: {
            "unit": error.unit,
            "noise": error.noise_rms,
            "before": before[name].rmse,
            "after": error.rmse,
            "fall": _fall([before[name]], [error]),
        }
        for name, error in after.items()
    }
    return {
        "status": "done",
        "which": which,
        "recordings": [recording.name for recording in recordings],
        "bandwidth": REPLAY_BANDWIDTH,
        "channels": channels,
        "fall": _fall([before[name] for name in after], list(after.values())),
    }


def _replayed(
    text: str, system: System, recordings: Sequence[Recording], progress: Progress, round_: int = 0
) -> dict[str, ReplayMismatch]:
    found: dict[str, list[ReplayMismatch]] = {}
    for i, recording in enumerate(recordings):
        progress.report_parts_done(round_ * len(recordings) + i, 2 * len(recordings), recording.name)
        for name, error in replay_in_mujoco(text, system, recording).items():
            found.setdefault(name, []).append(error)
    return {name: _together(errors) for name, errors in found.items()}


def _together(errors: Sequence[ReplayMismatch]) -> ReplayMismatch:
    rmse, noise = (
        (sum(getattr(error, key) ** 2 for error in errors) / len(errors)) ** 0.5 for key in ("rmse", "noise_rms")
    )
    return ReplayMismatch(rmse, noise, errors[0].unit)


def _fall(before: Sequence[ReplayMismatch], after: Sequence[ReplayMismatch]) -> float | None:
    """By what part the error beyond the noise falls, channels weighed by their error before; None if there was none."""
    gone = [
        1 - (b.rmse_beyond_noise and a.rmse_beyond_noise / b.rmse_beyond_noise)
        for b, a in zip(before, after, strict=True)
    ]
    real = [(part, b) for part, b in zip(gone, before, strict=True) if b.rmse_beyond_noise > 0]
    return sum(part for part, _ in real) / len(real) if real else None


Array = NDArray[np.float64]
_PREDICTION_TOPICS: Mapping[str, Mapping[str, str]] = {
    SOLVE_TRAJECTORIES_FORMAT: {"predicted": "predicted"},
    DIAGNOSIS_TRAJECTORIES_FORMAT: {"before": "nominal", "after": "with_effects"},
}
"""Arrays of a sensor's group, and the first part of the topics that tell them."""
_RESERVED_GROUPS = ("where", "events", "unknowns", "recordings")


def export_run_signals(folder: str | Path, out: str | Path) -> tuple[list[Path], list[str]]:
    """Write `OUT/RECORDING.mcap` for every recording of a run.

    Topics: `/measured/...`, `/predicted/...` (of a diagnosis `/nominal/...` and `/with_effects/...`) and
    `/residual/...`, predicted minus measured, with `joints/QUANTITY` or `points/GROUP/POINT` behind; the whole
    configuration as `/predicted/joint_states`, what moves it as `/predicted/driven_efforts` (of servos as
    `/predicted/commands`) and `/predicted/prescribed_efforts`. Of a diagnosis also `/unknown/joint_states` (forces),
    `/unknown/push/SEGMENT`, `/unknown/offset/GRASP`, `/unknown/bias/POINT` and `/events/CHANNEL`.

    Parameters
    ----------
    folder : str or Path
        Run folder of `solve` or `diagnose`.
    out : str or Path
        Folder to write to.

    Raises
    ------
    ConfigError, DataError, OutputError
    """
    folder, out = Path(folder), Path(out)
    read_run_result(folder)
    files, notes = [], []
    with open_checked_hdf5(folder / "trajectories.h5") as file:
        form = str(file.attrs.get("format", ""))
        if form not in _PREDICTION_TOPICS:
            what = f"the trajectories are of format '{form}'"
            raise DataError(
                what, where=str(folder / "trajectories.h5"), allowed=", ".join(_PREDICTION_TOPICS), hint="run it again"
            )
        for name, signals in _recordings(file, form).items():
            files.append(out / f"{name}.mcap")
            shift = export_mcap(signals, files[-1])
            if shift:
                notes.append(f"{files[-1].name}: {shift:g} s were added to all times, as stamps cannot be negative")
    return files, notes


def _recordings(file: h5py.File, form: str) -> dict[str, list[TopicSignal]]:
    parent = file.get("recordings", {}) if form == SOLVE_TRAJECTORIES_FORMAT else file
    found: dict[str, list[TopicSignal]] = {}
    for name in parent:
        if form == SOLVE_TRAJECTORIES_FORMAT or name not in _RESERVED_GROUPS:
            found.setdefault(name, []).extend(_of_recording(parent[name], _PREDICTION_TOPICS[form]))
    for name, group in file.get("where", {}).items():
        found.setdefault(name, []).extend(_unknown_signals(group))
    for name, channels in file.get("events", {}).items():
        for channel, group in channels.items():
            values = {"effort": np.array(group["value"])[:, None]}
            signal = TopicSignal(f"/events/{_topic(channel)}", "joints", np.array(group["t"]), values, (channel,))
            found.setdefault(name, []).append(signal)
    return {name: signals for name, signals in found.items() if any(len(signal.t) for signal in signals)}


def _of_recording(group: h5py.Group, predictions: Mapping[str, str]) -> Iterator[TopicSignal]:
    if "q" in group:
        joints, t = _texts(group.attrs["joints"]), np.array(group["t"])
        yield TopicSignal("/predicted/joint_states", "joints", t, {"position": np.array(group["q"])}, joints)
        if "command" in group:
            values = {"position": np.array(group["command"])}
            yield TopicSignal("/predicted/commands", "joints", t[:-1], values, _texts(group.attrs["driven"]))
        for key, names in (("torque", "driven"), ("effort", "prescribed")):
            if key in group and len(group.attrs[names]):
                values = {"effort": np.array(group[key])}
                yield TopicSignal(f"/predicted/{names}_efforts", "joints", t[:-1], values, _texts(group.attrs[names]))
    for sensor in group.values():
        if not isinstance(sensor, h5py.Group):
            continue
        measured = np.array(sensor["measured"])
        yield from _of_sensor(sensor, "measured", measured)
        for key, words in predictions.items():
            predicted = np.array(sensor[key])
            residual = "residual" if len(predictions) == 1 else f"residual/{words}"
            yield from _of_sensor(sensor, words, predicted)
            yield from _of_sensor(sensor, residual, predicted - measured)


def _of_sensor(sensor: h5py.Group, begin: str, values: Array) -> Iterator[TopicSignal]:
    """Joints of a group as one topic, points as one each; differences of places are vectors."""
    channels, t = _texts(sensor.attrs["channels"]), np.array(sensor["t"])
    if values.shape[1] == len(channels):
        quantity = channels[0].split(".")[1]
        names = [channel.rsplit(".", 1)[1] for channel in channels]
        yield TopicSignal(f"/{begin}/joints/{quantity}", "joints", t, {quantity: values}, names)
        return
    for i, channel in enumerate(channels):
        kind: Any = "vector" if begin.startswith("residual") else "point"
        yield TopicSignal(f"/{begin}/points/{_topic(channel)}", kind, t, {"xyz": values[:, 3 * i : 3 * i + 3]})


def _unknown_signals(group: h5py.Group) -> Iterator[TopicSignal]:
    """Unknown forces, pushes, offsets and biases, where each interval begins and where the last one ends."""
    edges = np.array(group["edges"]) + float(group.attrs.get("start", 0.0))
    mean = np.array(group["mean"])
    if not len(mean):
        return
    held = np.vstack([mean, mean[-1:]])
    names, kinds = _texts(group.attrs["unknowns"]), _texts(group.attrs["kinds"])
    kept = np.array(group["prior"]) > 0
    forces = [i for i, kind in enumerate(kinds) if kind == "force" and kept[i]]
    if forces:
        told = [names[i] for i in forces]
        yield TopicSignal("/unknown/joint_states", "joints", edges, {"effort": held[:, forces]}, told)
    shapes: Mapping[str, tuple[str, Any]] = {
        "push": ("push", "wrench"), "offset": ("offset", "vector"), "bias": ("bias", "vector")
    }  # fmt: skip
    for kind, (words, form) in shapes.items():
        for owner, columns in _triples(names, kinds, kind).items():
            if kept[[i for i in columns if i is not None]].any():
                xyz = np.stack([np.zeros(len(edges)) if i is None else held[:, i] for i in columns], axis=1)
                yield TopicSignal(f"/unknown/{words}/{_topic(owner)}", form, edges, {"xyz": xyz})


def _triples(names: Sequence[str], kinds: Sequence[str], kind: str) -> dict[str, list[int | None]]:
    """Columns of x, y and z by owner: `left.x`, `T1.push_y`; None where one has no unknown."""
    found: dict[str, list[int | None]] = {}
    for i, name in enumerate(names):
        owner, axis = name[:-2].removesuffix(".push"), name[-1]
        if kinds[i] == kind and axis in "xyz":
            found.setdefault(owner, [None, None, None])["xyz".index(axis)] = i
    return found


def _topic(name: str) -> str:
    return "".join(c if c.isalnum() or c in "_/" else "_" for c in name.replace(".", "/"))


def _texts(values: Any) -> list[str]:
    return [value.decode() if isinstance(value, bytes) else str(value) for value in values]
