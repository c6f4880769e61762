"""Export of a run's final model to other engines or as a configuration, with a manifest of what was kept."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from yid_ocp.config.reader import load_config
from yid_ocp.config.settings import EffectSettings, ParameterSettings, Run, dump_config
from yid_ocp.data.recording import Recording
from yid_ocp.errors import ConfigError, DataError, ModelError
from yid_ocp.export.manifest import FORMAT, Said, said_of_effects, said_of_parameters
from yid_ocp.export.tree import sdf_model, urdf_model
from yid_ocp.files import file_sha256, jsonable, write_json, write_text
from yid_ocp.model.system import System
from yid_ocp.progress import SILENT, Progress
from yid_ocp.virtual.mjcf import mujoco_xml
from yid_ocp.virtual.replay import BANDWIDTH, Error, replay
from yid_ocp.workflow.baseline import run_result
from yid_ocp.workflow.build import build_system, parameter_settings, read_recordings
from yid_ocp.workflow.folder import used_versions

FORMATS = ("mjcf", "urdf", "sdf", "yaml")


@dataclass(frozen=True)
class Calibrated:
    """Final model of a run: settings with found effects, parameter values and stds.

    Attributes
    ----------
    run : Run
        Its settings, with the effects that it found.
    nominal : Run
        Its settings as they were.
    values : mapping of parameter name to value
    std : mapping of parameter name to float or None
        Of those that were estimated, None where nothing is known of them.
    """

    run: Run
    nominal: Run
    values: Mapping[str, float]
    std: Mapping[str, float | None]


def read_model(folder: str | Path) -> Calibrated:
    """The final model read from a run folder of `solve` or `diagnose`.

    Raises
    ------
    ConfigError, DataError
        There is no finished run of these commands, or its solve failed.
    """
    folder = Path(folder)
    result = run_result(folder)
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
    return Calibrated(replace(nominal, model=model), nominal, values, std)


def export_model(
    folder: str | Path, out: str | Path, form: str = "mjcf", progress: Progress = SILENT
) -> dict[str, Any]:
    """Write the final model of a run and `OUT.manifest.json`, which lists what the format represents.

    Parameters
    ----------
    folder : str or Path
        Run folder of `solve` or `diagnose`.
    out : str or Path
        File to write.
    form : str
        Of `FORMATS`.
    progress : Progress, optional

    Returns
    -------
    dict
        The manifest; of `yaml`, which says all that the run does, without one beside it.

    Raises
    ------
    ConfigError, DataError, ModelError, OutputError
    """
    if form not in FORMATS:
        raise _unknown(form)
    calibrated, out = read_model(folder), Path(out)
    progress.stage("building the model")
    if form == "yaml":
        write_text(out, dump_config(calibrated_settings(calibrated)))
        return {"format": FORMAT, "file": str(out), "kind": form, "effects": {}, "parameters": {}, "gate": None}
    system, said = _expressible(calibrated, form)
    text = _written(form, system, _own(calibrated.values, system))
    full = build_system(calibrated.run)
    manifest: dict[str, Any] = {
        "format": FORMAT,
        "file": out.name,
        "kind": form,
        "run": str(Path(folder).resolve()),
        "result": file_sha256(Path(folder) / "result.json"),
        "effects": {label: vars(entry) for label, entry in said.items()},
        "parameters": {
            name: {
                "value": calibrated.values.get(name, full.parameters[name].value),
                "unit": full.parameters[name].unit,
                "estimated": name in calibrated.std,
                "std": calibrated.std.get(name),
                **vars(entry),
            }
            for name, entry in said_of_parameters(full, said, form).items()
        },
        "grasps": {grasp.name: vars(_said_of_grasp(form)) for grasp in full.grasps},
        "gate": None,
        "versions": used_versions(),
    }
    if form == "mjcf":
        progress.stage("replaying recordings in MuJoCo")
        manifest["gate"] = _gate(calibrated, system, text, progress)
    manifest = jsonable(manifest)
    write_text(out, text)
    try:
        write_json(manifest_file(out), manifest)
    except BaseException:
        out.unlink(missing_ok=True)  # a model without its manifest would be silent about what it lacks
        raise
    return manifest


def manifest_file(out: Path) -> Path:
    """Path of the manifest of an exported file."""
    return out.with_name(f"{out.name}.manifest.json")


def calibrated_settings(calibrated: Calibrated) -> Run:
    """Settings of the run with found effects, and estimates as initial values."""
    system = build_system(calibrated.run)
    chosen = dict(parameter_settings(calibrated.run, system.parameters))
    for name in calibrated.std:
        chosen.setdefault(name, ParameterSettings(free=True))
    values = calibrated.values
    parameters = {
        name: replace(said, initial=values[name]) if name in calibrated.std else said for name, said in chosen.items()
    }
    return replace(calibrated.run, parameters=parameters)


def _unknown(form: str) -> ConfigError:
    hint = ""
    if form == "usd":
        hint = "mjcf: UsdPhysics has no schema for cables yet, nor springs on joints that turn about three axes"
    return ConfigError(f"there is no format '{form}'", where="--format", allowed=", ".join(FORMATS), hint=hint)


def _own(values: Mapping[str, float], system: System) -> dict[str, float]:
    return {name: value for name, value in values.items() if name in system.parameters}


def _written(form: str, system: System, values: Mapping[str, float]) -> str:
    writers: Mapping[str, Callable[[System, Mapping[str, float]], str]] = {
        "mjcf": lambda system, values: mujoco_xml(system, values, emulate=True, actuators=True),
        "urdf": urdf_model,
        "sdf": sdf_model,
    }
    return writers[form](system, values)


def _said_of_grasp(form: str) -> Said:
    if form == "mjcf":
        return Said("native", "equality constraints between sites, or a tendon where it gives way")
    return Said("not representable", f"{form.upper()} describes a tree: close the loop in the engine")


def _expressible(calibrated: Calibrated, form: str) -> tuple[System, dict[str, Said]]:
    """The system with those effects that the format can say, and what it makes of every one."""
    system = build_system(calibrated.run)
    said = said_of_effects(system, _own(calibrated.values, system), form)
    for _ in range(len(said) + 1):
        kept = [label for label, entry in said.items() if entry.status != "not representable" and _acts(entry)]
        system = _with(calibrated.run, kept)
        try:
            _written(form, system, _own(calibrated.values, system))
            return system, said
        except ModelError as error:
            for label in kept:  # what the table cannot tell: it depends on where the effect sits
                alone = _with(calibrated.run, [label])
                try:
                    _written(form, alone, _own(calibrated.values, alone))
                except ModelError as own:
                    said[label] = Said("not representable", own.what)
                    break
            else:
                raise ModelError(
                    f"the model cannot be written as {form.upper()}: {error.what}",
                    where=error.where,
                    allowed=error.allowed,
                    hint=error.hint or f"another format: {', '.join(FORMATS)}",
                ) from error
    raise AssertionError("effects run out")


def _acts(said: Said) -> bool:
    return not said.how.startswith("neutral")


def _with(run: Run, labels: Sequence[str]) -> System:
    effects = tuple(effect for effect in run.model.effects if f"{effect.kind}@{effect.location}" in labels)
    model, kept = replace(run.model, effects=effects), set(labels)
    parameters = {name: said for name, said in run.parameters.items() if _owner(name) in ("", *kept)}
    return build_system(replace(run, model=model, parameters=parameters))


def _owner(name: str) -> str:
    """Label of the effect whose parameter, or pattern of parameters, a name is; empty for none."""
    return name.rpartition(".")[0] if "@" in name else ""


# -- the gate ---------------------------------------------------------------------------------------------------------


def _gate(calibrated: Calibrated, system: System, text: str, progress: Progress) -> dict[str, Any]:
    """Errors of the exported model, and of the nominal one, on recordings that neither was fitted to."""
    which = "held_out" if calibrated.run.recordings.held_out else "estimate"
    try:
        recordings = read_recordings(calibrated.run, which)
        if not recordings:
            return {"status": "not done", "reason": "the run has no recordings"}
        kept = [f"{e.kind}@{e.location}" for e in calibrated.nominal.model.effects]
        present = [f"{e.kind}@{e.location}" for e in system.effects]
        nominal = _with(calibrated.nominal, [label for label in kept if label in present])
        before = _replayed(mujoco_xml(nominal, emulate=True, actuators=True), nominal, recordings, progress)
        after = _replayed(text, system, recordings, progress, 1)
    except (DataError, ModelError) as error:
        return {"status": "not done", "reason": error.what}
    channels = {
        name: {
            "unit": error.unit,
            "noise": error.noise,
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
        "bandwidth": BANDWIDTH,
        "channels": channels,
        "fall": _fall([before[name] for name in after], list(after.values())),
    }


def _replayed(
    text: str, system: System, recordings: Sequence[Recording], progress: Progress, round_: int = 0
) -> dict[str, Error]:
    """Errors over all recordings together; in the first or second of two rounds."""
    found: dict[str, list[Error]] = {}
    for i, recording in enumerate(recordings):
        progress.advance(round_ * len(recordings) + i, 2 * len(recordings), recording.name)
        for name, error in replay(text, system, recording).items():
            found.setdefault(name, []).append(error)
    return {name: _together(errors) for name, errors in found.items()}


def _together(errors: Sequence[Error]) -> Error:
    rmse, noise = (
        (sum(getattr(error, key) ** 2 for error in errors) / len(errors)) ** 0.5 for key in ("rmse", "noise")
    )
    return Error(rmse, noise, errors[0].unit)


def _fall(before: Sequence[Error], after: Sequence[Error]) -> float | None:
    """By what part the error beyond the noise falls, channels weighed by their error before; None if there was none."""
    gone = [1 - (b.beyond_noise and a.beyond_noise / b.beyond_noise) for b, a in zip(before, after, strict=True)]
    real = [(part, b) for part, b in zip(gone, before, strict=True) if b.beyond_noise > 0]
    return sum(part for part, _ in real) / len(real) if real else None
