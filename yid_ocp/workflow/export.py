"""The command `export`: recordings as CSV or MCAP, run signals as MCAP, and models for other engines."""

from __future__ import annotations

import argparse
import fnmatch
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from yid_ocp.arrays import Array
from yid_ocp.config.reader import load_config
from yid_ocp.config.settings import ParameterSettings, RunSettings, config_yaml_with_defaults
from yid_ocp.data import read_recording
from yid_ocp.data.recording import Recording
from yid_ocp.data.recording_hdf5 import open_hdf5_after_read_check
from yid_ocp.display import Progress, names_by_kind_text
from yid_ocp.errors import ConfigError, DataError, ModelError, OutputError
from yid_ocp.export import models
from yid_ocp.export.models import EXPORT_MANIFEST_FORMAT, FeatureExportSupport
from yid_ocp.export.signals import (
    RosTopicTimeSeries,
    export_mcap,
    export_recording_csv_files,
    ros_signals_from_recording,
)
from yid_ocp.files import attributes_to_dict, file_sha256, to_json_types, write_strict_json, write_text
from yid_ocp.model.servos_and_springs import JOINT_SERVO_GAIN_FACTOR_PARAMETER_SUFFIX
from yid_ocp.model.system import System
from yid_ocp.report.terminal import recording_summary_lines, summary_blocks, summary_terminal_lines
from yid_ocp.sensors import SensorOptions
from yid_ocp.virtual.mjcf import import_mujoco, mujoco_xml
from yid_ocp.virtual.mujoco_simulation import ReplayErrorAgainstRecording, replay_mismatch_by_channel
from yid_ocp.workflow import run_history
from yid_ocp.workflow.build import build_system, settings_by_parameter_name
from yid_ocp.workflow.build_problem import servo_gains_by_recording
from yid_ocp.workflow.command_runner import EXIT_DONE, print_result, stderr_progress_display
from yid_ocp.workflow.import_recording import recording_summary_dict
from yid_ocp.workflow.prediction_outputs import (
    DIAGNOSIS_TRAJECTORIES_FORMAT,
    SOLVE_TRAJECTORIES_FORMAT,
    trajectories_format,
)
from yid_ocp.workflow.run_folder import software_and_plugin_versions
from yid_ocp.workflow.run_inputs import read_recordings_of_role

_MODEL_FORMATS = ("mjcf", "urdf", "sdf", "yaml")
_FORMAT_BY_ENDING = {"": "mjcf", "xml": "mjcf", "yml": "yaml", "world": "sdf"}  # of other endings, the ending itself
_MCAP = "mcap"
_PREDICTION_TOPICS: Mapping[str, Mapping[str, str]] = {
    SOLVE_TRAJECTORIES_FORMAT: {"predicted": "predicted"},
    DIAGNOSIS_TRAJECTORIES_FORMAT: {"before": "nominal", "after": "with_effects"},
}
"""Arrays of a sensor's group and the first part of their topics' names, by format of trajectories.h5."""
_RESERVED_GROUPS = ("where", "events", "unknowns", "recordings")
_UNKNOWN_SHAPES: Mapping[str, Any] = {"push": "wrench", "offset": "vector", "bias": "vector"}  # by kind of unknown


def run_and_return_exit_code(arguments: argparse.Namespace) -> int:
    """Run the command `export` and return its exit code."""
    source, form, out = Path(arguments.source), arguments.format, arguments.out
    ending = Path(out).suffix[1:].lower()
    if ending in ("csv", _MCAP):
        what, hint = f"{out} would be a folder of {ending} files", f"write --out {Path(out).with_suffix('')}"
        raise ConfigError(what, where="--out", allowed="a folder name without this ending", hint=hint)
    meant = form or _FORMAT_BY_ENDING.get(ending, ending)
    if source.is_dir() and form != _MCAP:
        with stderr_progress_display(arguments) as progress:
            manifest = _export_model(source, Path(out), meant, arguments.lossy, progress)
        blocks = summary_blocks(manifest)
        print_result(arguments, manifest, lambda: summary_terminal_lines(blocks), f"model: {out}", out)
        return EXIT_DONE
    if not source.is_dir() and (form not in (None, "csv", _MCAP) or (ending and meant in _MODEL_FORMATS)):
        allowed = f"csv or {_MCAP} of a recording; {', '.join(_MODEL_FORMATS)} of a run folder of `solve` or `diagnose`"
        what, hint = f"the format {meant} needs a run folder, not {source.name}", "give a run folder, or --format csv"
        raise ConfigError(what, where="--format, or the ending of --out", allowed=allowed, hint=hint)
    contents: dict[str, Any] = {"notes": []}
    texts = ["The files have the measured and the predicted signals of the run."]
    if source.is_dir():
        files, notes = _export_run_signals(source, out)
    else:
        recording, files, notes = read_recording(source, allow_nan_effort=True), [], []
        contents, texts = recording_summary_dict(recording), recording_summary_lines(recording)
        if form == _MCAP:
            files = [Path(out) / f"{source.stem}.mcap"]
            notes = _shift_notes("", export_mcap(ros_signals_from_recording(recording), files[0]))
        else:
            files = list(export_recording_csv_files(recording, out))
    paths = [str(file) for file in files]
    own = {"format": EXPORT_MANIFEST_FORMAT, "file": paths, "kind": form or "csv"}
    own |= {"notes": [*contents["notes"], *notes]}
    print_result(arguments, contents | own, lambda: [*notes, *texts], "\n".join(paths), "\n".join(paths))
    return EXIT_DONE


def _shift_notes(begin: str, shift: float) -> list[str]:
    return [f"{begin}{shift:g} s were added to all times, because MCAP has no negative times"] if shift else []


@dataclass(frozen=True)
class _CalibratedModel:
    """Final model of a run: settings with and without the found effects, parameter values and their stds."""

    settings: RunSettings
    nominal_settings: RunSettings
    parameter_values: Mapping[str, float]
    parameter_stds: Mapping[str, float | None]  # None for an estimate that cannot be found or is in doubt

    def system(self, labels: Iterable[str], nominal: bool = False) -> System:
        """Return the system with the effects `labels`; if `nominal`, only with those of them in the nominal model."""
        run = self.nominal_settings if nominal else self.settings
        kept = {"", *labels}
        effects = tuple(effect for effect in run.model.effects if effect.label in kept)
        # names of parameters start with that of their effect
        names = [n for n in self.parameter_values if "@" not in n or n.rpartition(".")[0] in kept]
        parameters = {key: said for key, said in run.parameters.items() if key in names or fnmatch.filter(names, key)}
        model = replace(run.model, effects=effects, friction=None)
        return build_system(replace(run, model=model, parameters=parameters))

    def values_for(self, system: System) -> dict[str, float]:
        return {name: value for name, value in self.parameter_values.items() if name in system.parameters}

    def servo_gains(self, recordings: Sequence[Recording]) -> list[dict[str, float]]:
        """Return the servo gains that each recording states, by parameter, without those that the settings state."""
        gains = servo_gains_by_recording(self.settings, build_system(self.settings), recordings)
        return [gains.get(recording.name, {}) for recording in recordings]

    def with_values(self, values: Mapping[str, float]) -> _CalibratedModel:
        """Return the model with some other parameter values."""
        return replace(self, parameter_values={**self.parameter_values, **values})

    def text(self, form: str, system: System) -> str:
        values = self.values_for(system)
        if form == "mjcf":
            return mujoco_xml(system, values, standalone=True)
        return (models.system_to_urdf if form == "urdf" else models.system_to_sdf)(system, values)


def _read_calibrated_model(folder: Path) -> _CalibratedModel:
    result = run_history.read_estimation_result(folder)
    try:
        parameters = {str(name): dict(entry) for name, entry in result.get("model", result)["parameters"].items()}
        values = {name: float(entry["value"]) for name, entry in parameters.items()}
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        where, allowed = str(folder / "result.json"), "a result of `solve` or `diagnose` of this version"
        what = "the result has no valid parameter values: another version wrote it, or it is damaged"
        raise DataError(what, where=where, allowed=allowed, hint=f"repeat {result.get('command', 'it')}") from error
    nominal = load_config(folder / "config.yaml")
    by_label, added = run_history.group_parameter_values_by_effect_label, run_history.settings_with_added_effects
    # a friction law becomes single effects, so that a file can lack one of them
    nominal = added(nominal, by_label({entry.name: entry.value for entry in build_system(nominal).parameters}))
    doubtful = [n for n, own in parameters.items() if own.get("verdict") in ("not_identifiable", "not_trusted")]
    if "model" in result:  # a diagnosis, which has no verdicts of parameters
        doubtful += (result.get("to_use") or {}).get("left_out", ())
    std = {n: None if n in doubtful else own.get("std") for n, own in parameters.items() if own.get("free")}
    return _CalibratedModel(added(nominal, by_label(values)), nominal, values, std)


def _export_model(folder: Path, out: Path, form: str, is_lossy: bool, progress: Progress) -> dict[str, Any]:
    """Write a run's final model and return its manifest. `ConfigError` for a loss, unless `is_lossy` accepts it."""
    calibrated = _read_calibrated_model(folder)
    if form not in _MODEL_FORMATS:
        why = "; UsdPhysics has no cables yet, nor springs of joints that turn about three axes" * (form == "usd")
        allowed, where = ", ".join((*_MODEL_FORMATS, _MCAP)), "--format, or the ending of --out"
        what, hint = f"a run cannot be exported as '{form}'", f"write --format mjcf (model) or mcap (signals){why}"
        raise ConfigError(what, where=where, allowed=allowed, hint=hint)
    if out.is_file():
        what, hint = f"{out.name} already exists, and `export` overwrites nothing", "choose another --out, or remove it"
        raise OutputError(what, where=str(out), allowed="a file that does not exist yet", hint=hint)
    progress.begin_stage("building the model")
    full, unknown = build_system(calibrated.settings), [n for n, s in calibrated.parameter_stds.items() if s is None]
    if form == "yaml":
        chosen = settings_by_parameter_name(calibrated.settings, full.parameters)
        for name in calibrated.parameter_stds:
            said = chosen.get(name, ParameterSettings(free=True))
            chosen[name] = replace(said, initial=calibrated.parameter_values[name])
        write_text(out, config_yaml_with_defaults(replace(calibrated.settings, parameters=chosen)))
        head = {"format": EXPORT_MANIFEST_FORMAT, "file": str(out), "kind": form}
        return head | {"unknown": unknown, "effects": {}, "parameters": {}, "gate": None}
    has_firmware_gain = any(n.endswith(JOINT_SERVO_GAIN_FACTOR_PARAMETER_SUFFIX) for n in full.parameters.names)
    recordings = read_recordings_of_role(calibrated.settings, "estimate") if has_firmware_gain else []
    gains = next(iter(calibrated.servo_gains(recordings[:1])), {})
    calibrated = calibrated.with_values(gains)
    system, supports = _expressible(calibrated, full, form)
    text = calibrated.text(form, system)
    grasps = {g.name: _grasp_support(form, supports.get(f"grasp_compliance@{g.name}")) for g in full.grasps}
    parameters = {}
    for name, entry in models.support_in_export_format_by_parameter(full, supports, form).items():
        own, stds = full.parameters[name], calibrated.parameter_stds
        known = {"value": calibrated.parameter_values.get(name, own.value), "unit": own.unit}
        parameters[name] = known | {"estimated": name in stds, "std": stds.get(name), **vars(entry)}
    _refuse_losses(form, is_lossy, supports, parameters, grasps)
    manifest: dict[str, Any] = {
        "format": EXPORT_MANIFEST_FORMAT,
        "file": out.name,
        "kind": form,
        "run": str(folder.resolve()),
        "result": file_sha256(folder / "result.json"),
        "effects": {label: vars(entry) for label, entry in supports.items()},
        "parameters": parameters,
        "unknown": unknown,
        "grasps": {name: vars(entry) for name, entry in grasps.items()},
        "gain_of": recordings[0].name if gains else None,
        "gate": None,
        "versions": software_and_plugin_versions(),
    }
    write_text(out, text)
    try:
        if form == "mjcf":
            manifest["gate"] = _gate(calibrated, system, progress)
        manifest = to_json_types(manifest)
        write_strict_json(out.with_name(f"{out.name}.manifest.json"), manifest)
    except BaseException:
        out.unlink(missing_ok=True)  # without its manifest, a model would not state its losses
        raise
    return manifest


def _grasp_support(form: str, compliance: FeatureExportSupport | None) -> FeatureExportSupport:
    """Return how a format represents a grasp with an effect `compliance`, which it represents as stated."""
    if form != "mjcf":
        why = f"{form.upper()} describes a tree: close the loop in the engine"
        return FeatureExportSupport("not representable", why)
    rigid = "equality constraints between sites"
    if compliance in (None, models.NEUTRAL_EFFECT_SUPPORT):
        return FeatureExportSupport("native", rigid)
    is_lost = compliance.status == "not representable"
    return FeatureExportSupport("emulated", f"{rigid}: the grasp is rigid" if is_lost else "a tendon with a spring")


def _refuse_losses(
    form: str,
    is_lossy: bool,
    effects: Mapping[str, FeatureExportSupport],
    parameters: Mapping[str, Mapping[str, Any]],
    grasps: Mapping[str, FeatureExportSupport],
) -> None:
    """Refuse a file that lacks effects, estimates or grasps of the model, unless losses are accepted."""
    lost = [label for label, entry in effects.items() if entry.loses_motion_or_force]
    absent = [name for name, own in parameters.items() if own["estimated"] and own["status"] == "not representable"]
    lost += [name for name in absent if name.rpartition(".")[0] not in effects]
    lost += [f"grasp {name}" for name, entry in grasps.items() if entry.loses_motion_or_force]
    if lost and not is_lossy:
        told, where = names_by_kind_text(lost), f"--format {form}"
        what = f"{form.upper()} cannot represent these parts of the model: {told}"
        other = "" if form == "mjcf" else "write a MuJoCo model (--format mjcf), which has more parts, or "
        hint = f"{other}add --lossy to leave them out, with a manifest that has the reason for each"
        raise ConfigError(what, where=where, allowed="--lossy, or a model without them", hint=hint)


def _expressible(
    calibrated: _CalibratedModel, full: System, form: str
) -> tuple[System, dict[str, FeatureExportSupport]]:
    """Return the system without effects that a format cannot represent, and how the format represents each effect."""
    said = models.export_support_by_effect(full, calibrated.values_for(full), form)
    while True:
        told = {label: entry for label, entry in said.items() if entry.status != "not representable"}
        kept = [label for label, entry in told.items() if entry != models.NEUTRAL_EFFECT_SUPPORT]
        system = calibrated.system(kept)
        try:
            calibrated.text(form, system)
            return system, said
        except ModelError as error:
            for label in kept:  # the table cannot know this: it depends on the location of the effect
                try:
                    calibrated.text(form, calibrated.system([label]))
                except ModelError as own:
                    said[label] = FeatureExportSupport("not representable", own.what)
                    break
            else:
                what = f"the model cannot be written as {form.upper()}: {error.what}"
                hint = error.hint or f"another format: {', '.join(_MODEL_FORMATS)}"
                raise ModelError(what, where=error.where, allowed=error.allowed, hint=hint) from error


def _gate(calibrated: _CalibratedModel, system: System, progress: Progress) -> dict[str, Any]:
    """Return the errors of the exported and the nominal model on held-out recordings, or on fitted ones if none are."""
    which = "held_out" if calibrated.settings.recordings.held_out else "estimate"
    try:
        recordings = read_recordings_of_role(calibrated.settings, which)
        if not recordings:
            return {"status": "not done", "reason": "the run has no recordings"}
        import_mujoco("the replay needs MuJoCo")
        progress.begin_stage("replaying recordings in MuJoCo")
        nominal = calibrated.system([effect.label for effect in system.effects], nominal=True)
        system, nominal = (_with_recorded_points(own, recordings) for own in (system, nominal))
        recordings = [_with_configured_noise(own, nominal, calibrated.settings.sensors) for own in recordings]
        gains = calibrated.servo_gains(recordings)
        before = [mujoco_xml(nominal, own, standalone=True) for own in gains]
        after = [calibrated.with_values(own).text("mjcf", system) for own in gains]
        errors = [_replayed(before, nominal, recordings, progress), _replayed(after, system, recordings, progress, 1)]
    except (DataError, ModelError) as error:
        return {"status": "not done", "reason": ". Try: ".join(filter(None, (error.what, error.hint)))}
    kept = "unit noise=noise_rms after=rmse"
    channels = {n: attributes_to_dict(own, kept) | {"before": errors[0][n].rmse} for n, own in errors[1].items()}
    return {
        "status": "done",
        "which": which,
        "recordings": [recording.name for recording in recordings],
        "channels": channels,
    }


def _with_recorded_points(system: System, recordings: Sequence[Recording]) -> System:
    """The system with recorded points at its frames, unless it has measured points already."""
    names = {name for recording in recordings for group in recording.points for name in group.names}
    return replace(system, point_frames=system.point_frames or tuple(sorted(names & {*system.mechanism.frames})))


def _with_configured_noise(recording: Recording, system: System, sensors: Mapping[str, SensorOptions]) -> Recording:
    """The recording with the noise that settings state, and without the sensors that they leave out."""
    angle, effort = (sensors.get(f"joints.{name}", SensorOptions()) for name in ("position", "effort"))
    joints, points = recording.joints, []
    if joints is not None:
        joints = replace(joints, position_std=_stated_std(angle, joints.names, joints.position_std))
        if effort.use is False and not system.driven:
            joints = replace(joints, effort=None, effort_std=None, effort_bias_std=None)
        elif joints.effort is not None:
            joints = replace(joints, effort_std=_stated_std(effort, joints.names, joints.effort_std))
    for group in recording.points:
        choice = sensors.get(group.name, SensorOptions())
        own = group if choice.std is None else replace(group, std=np.full(group.position.shape, choice.std))
        points += [own] if choice.use is not False else []
    return replace(recording, joints=joints, points=tuple(points))


def _stated_std(choice: SensorOptions, names: Sequence[str], recorded: float | Array | None) -> float | Array | None:
    std = choice.std
    return np.array([std.get(name, 0.0) for name in names]) if isinstance(std, Mapping) else std or recorded


def _replayed(
    texts: Sequence[str], system: System, recordings: Sequence[Recording], progress: Progress, round_: int = 0
) -> dict[str, ReplayErrorAgainstRecording]:
    found: dict[str, list[ReplayErrorAgainstRecording]] = {}
    for i, (text, recording) in enumerate(zip(texts, recordings, strict=True)):
        own = f"{recording.name}{' as exported' * round_}"
        progress.report_parts_done(round_ * len(recordings) + i, 2 * len(recordings), own)
        for name, error in replay_mismatch_by_channel(text, system, recording).items():
            found.setdefault(name, []).append(error)
    together = {}
    for name, errors in found.items():
        rmse, noise = np.sqrt(np.mean([(error.rmse**2, error.noise_rms**2) for error in errors], axis=0))
        together[name] = ReplayErrorAgainstRecording(float(rmse), float(noise), errors[0].unit)
    return together


def _export_run_signals(folder: Path, out: str) -> tuple[list[Path], list[str]]:
    """Write `OUT/RECORDING.mcap` for every recording of a run; docs/howto/signals.md lists its topics."""
    source, files, notes = folder / "trajectories.h5", [], []
    run_history.read_estimation_result(folder)
    with open_hdf5_after_read_check(source) as file:
        form = trajectories_format(file)
        for name, signals in _recordings(file, form).items():
            files.append(Path(out) / f"{name}.mcap")
            notes += _shift_notes(f"{files[-1].name}: ", export_mcap(signals, files[-1]))
    return files, notes


def _recordings(file: h5py.File, form: str) -> dict[str, list[RosTopicTimeSeries]]:
    parent = file.get("recordings", {}) if form == SOLVE_TRAJECTORIES_FORMAT else file
    found: dict[str, list[RosTopicTimeSeries]] = {}
    for name in parent:
        if form == SOLVE_TRAJECTORIES_FORMAT or name not in _RESERVED_GROUPS:
            found.setdefault(name, []).extend(_of_recording(parent[name], _PREDICTION_TOPICS[form]))
    for name, group in file.get("where", {}).items():
        found.setdefault(name, []).extend(_unknown_signals(group))
    for name, channels in file.get("events", {}).items():
        for channel, group in channels.items():
            t, values = np.array(group["t"]), {"effort": np.array(group["value"])[:, None]}
            signal = RosTopicTimeSeries(f"/events/{_topic(channel)}", "joints", t, values, (channel,))
            found.setdefault(name, []).append(signal)
    return {name: signals for name, signals in found.items() if any(len(signal.t) for signal in signals)}


def _of_recording(group: h5py.Group, predictions: Mapping[str, str]) -> Iterator[RosTopicTimeSeries]:
    if "q" in group:
        t = np.array(group["t"])
        for key, names, topic, quantity in (
            ("q", "joints", "joint_states", "position"),
            ("command", "driven", "commands", "position"),
            ("torque", "driven", "driven_efforts", "effort"),
            ("effort", "prescribed", "prescribed_efforts", "effort"),
        ):
            if key in group and (key in ("q", "command") or len(group.attrs[names])):
                values, told = np.array(group[key]), [*map(str, group.attrs[names])]
                yield RosTopicTimeSeries(f"/predicted/{topic}", "joints", t[: len(values)], {quantity: values}, told)
    for sensor in (entry for entry in group.values() if isinstance(entry, h5py.Group)):
        measured = np.array(sensor["measured"])
        yield from _of_sensor(sensor, "measured", measured)
        for key, words in predictions.items():
            predicted = np.array(sensor[key])
            residual = "residual" if len(predictions) == 1 else f"residual/{words}"
            yield from _of_sensor(sensor, words, predicted)
            yield from _of_sensor(sensor, residual, predicted - measured)


def _of_sensor(sensor: h5py.Group, begin: str, values: Array) -> Iterator[RosTopicTimeSeries]:
    """Yield the time series of a sensor: one topic for all joints, or one per point (residuals as vectors)."""
    channels, t = [*map(str, sensor.attrs["channels"])], np.array(sensor["t"])
    if values.shape[1] == len(channels):
        quantity, names = channels[0].split(".")[1], [channel.rsplit(".", 1)[1] for channel in channels]
        yield RosTopicTimeSeries(f"/{begin}/joints/{quantity}", "joints", t, {quantity: values}, names)
        return
    kind: Any = "vector" if begin.startswith("residual") else "point"
    for i, channel in enumerate(channels):
        yield RosTopicTimeSeries(f"/{begin}/points/{_topic(channel)}", kind, t, {"xyz": values[:, 3 * i : 3 * i + 3]})


def _unknown_signals(group: h5py.Group) -> Iterator[RosTopicTimeSeries]:
    """Yield unknown forces, pushes, offsets and biases, at the start of each interval and the end of the last one."""
    edges, mean = np.array(group["edges"]) + float(group.attrs.get("start", 0.0)), np.array(group["mean"])
    if not len(mean):
        return
    held = np.vstack([mean, mean[-1:]])
    names, kinds = ([*map(str, group.attrs[key])] for key in ("unknowns", "kinds"))
    kept = np.array(group["prior"]) > 0
    if forces := [i for i, kind in enumerate(kinds) if kind == "force" and kept[i]]:
        told = [names[i] for i in forces]
        yield RosTopicTimeSeries("/unknown/joint_states", "joints", edges, {"effort": held[:, forces]}, told)
    for kind, form in _UNKNOWN_SHAPES.items():
        owners: dict[str, dict[int, int]] = {}  # x, y and z by owner: `left.x`, `T1.push_y`
        for i, name in enumerate(names):
            if kinds[i] == kind and name[-1] in "xyz":
                owners.setdefault(name[:-2].removesuffix(".push"), {})["xyz".index(name[-1])] = i
        for owner, columns in owners.items():
            if kept[list(columns.values())].any():
                xyz = np.zeros((len(edges), 3))
                xyz[:, list(columns)] = held[:, list(columns.values())]
                yield RosTopicTimeSeries(f"/unknown/{kind}/{_topic(owner)}", form, edges, {"xyz": xyz})


def _topic(name: str) -> str:
    return "".join(c if c.isalnum() or c in "_/" else "_" for c in name.replace(".", "/"))
