"""Functions that read a run's files, recordings and plug-ins, and errors with the location of a setting."""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import os
import sys
import traceback
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from importlib import metadata, resources
from pathlib import Path
from typing import Any

from yid_ocp.config.settings import RunSettings
from yid_ocp.data.recording import Recording
from yid_ocp.data.recording_hdf5 import read_recording
from yid_ocp.effects import EFFECTS
from yid_ocp.errors import ConfigError, YidError, nearest_file_question, unknown_name_error_arguments
from yid_ocp.files import file_sha256, is_file, json_sha256
from yid_ocp.model.urdf import urdf_path_from_robot_name
from yid_ocp.registry import Registry
from yid_ocp.sensors import CHANNEL_KINDS, SENSOR_READERS

_ENTRY_POINT_GROUP = "yid_ocp.effects"  # entry points of modules that register effects, sensors or report sections


def load_plugins(run: RunSettings) -> None:
    """Import the files of `plugins` and the entry points of `_ENTRY_POINT_GROUP`, each once in a process.

    Raises `ConfigError` if a plug-in is missing, raises an error, registers nothing, uses a registered name, or changed
    after this process ran it. Nothing of this plug-in is then registered.
    """
    for entry in _installed(*sys.path):
        where, imported = f"{entry.value} of {_distribution(entry)}", entry.module in sys.modules
        with _registering(f"entry point {entry.name}", where, "update that package, or remove it", known=imported):
            entry.load()
    for i, plugin in enumerate(run.plugins):
        path, where = Path(plugin), run.setting_location("plugins", i)
        # its place and text make a unique name, so that neither another file nor another version is taken for it
        prefix = f"yid_ocp_plugin_{path.stem}_{json_sha256(str(path.resolve()))[:8]}_"
        name = prefix + file_sha256(path)
        loaded = [module for module in list(sys.modules) if module.startswith(prefix)]
        if loaded not in ([], [name]):
            what, hint = f"{path.name} was changed after this process loaded it", "start a new Python process"
            raise ConfigError(what, where=where, allowed="the text that was loaded", hint=hint)
        if not loaded:
            with _registering(f"plug-in {path.name}", where, f"correct {path.name}", path, name):
                _run(path, name)


def installed_plugin_versions() -> dict[str, str]:
    """Return the package and version of each installed plugin (entry point group `yid_ocp.effects`)."""
    return {f"entry point {entry.name}": _distribution(entry) for entry in _installed(*sys.path)}


def _distribution(entry: metadata.EntryPoint) -> str:
    return "unknown" if entry.dist is None else f"{entry.dist.name} {entry.dist.version}"


@functools.cache
def _installed(*_folders: str) -> Sequence[metadata.EntryPoint]:
    """Return the entry points of installed plug-ins, cached by Python's search path, because the search takes 5 ms."""
    return sorted(metadata.entry_points(group=_ENTRY_POINT_GROUP), key=lambda entry: entry.name)


def _run(path: Path, name: str) -> None:
    """Import a plug-in file as the module `name`."""
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ImportError("the file is not a Python module")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look for the module of their class
    spec.loader.exec_module(module)


@contextlib.contextmanager
def _registering(
    name: str, where: str, hint: str, path: Path | None = None, module: str = "", known: bool = False
) -> Iterator[None]:
    """Context manager in which a plug-in runs: its errors become `ConfigError`, after which nothing of it is kept."""
    from yid_ocp.report.sections import REPORT_SECTIONS  # which few runs with plug-ins need before their report

    registries: tuple[Registry[Any], ...] = (EFFECTS, SENSOR_READERS, CHANNEL_KINDS, REPORT_SECTIONS)
    before = [set(registry) for registry in registries]
    try:
        yield
        if all(set(registry) == names for registry, names in zip(registries, before, strict=True)) and not known:
            allowed = "@EFFECTS.register(NAME), or another decorator that docs/howto/extending.md describes"
            raise ConfigError(f"the {name} registers nothing", where=where, allowed=allowed, hint="add a decorator")
    except BaseException as error:
        for registry, names in zip(registries, before, strict=True):
            for own in set(registry) - names:
                del registry[own]
        sys.modules.pop(module, None)
        if not isinstance(error, (Exception, SystemExit)):
            raise
        if isinstance(error, YidError):
            what = f"the {name} cannot be used: {error.what}" if error.where != where else error.what
            raise ConfigError(what, where=where, allowed=error.allowed, hint=error.hint or hint) from error
        line = None if path is None else _line(error, path)
        what, where = f"the {name} raised {type(error).__name__}: {error}", f"{where} (line {line})" if line else where
        raise ConfigError(what, where=where, allowed="a file that Python can import", hint=hint) from error


def _line(error: BaseException, path: Path) -> int | None:
    if isinstance(error, SyntaxError):
        return error.lineno
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(path)]
    return lines[-1] if lines else None


@contextlib.contextmanager
def add_setting_location_to_errors(run: RunSettings, *path: str | int) -> Iterator[None]:
    """Context manager that adds the location of the setting `path` to errors raised in its block."""
    try:
        yield
    except YidError as error:
        inner = tuple(error.where.split("."))  # the key itself may come from --set
        known = (key for key in run.key_locations if key[: len(path)] == path and _value_at(run, key) == error.where)
        where = run.setting_location(*(inner if inner[: len(path)] == path else next(known, path)))
        where = where if error.where in where else f"{where} ({error.where})"
        raise type(error)(error.what, where=where, allowed=error.allowed, hint=error.hint) from error


def _value_at(run: RunSettings, path: Sequence[str | int]) -> str:
    """Return the text of a setting; empty if it is no text."""
    value: Any = run
    for key in path:
        entries = dict(enumerate(value)) if isinstance(value, tuple | list) else value
        value = (entries if isinstance(entries, Mapping) else getattr(entries, "__dict__", {})).get(key)
    return value if isinstance(value, str) else ""


def unknown_name_error(run: RunSettings, noun: str, name: str, known: Iterable[str], *path: str | int) -> ConfigError:
    """Make, but do not raise, a `ConfigError` about an unknown name in the settings, with the nearest known name."""
    return run.config_error(f"there is no {noun} '{name}'", *path, **unknown_name_error_arguments(name, known))


def check_names_in_setting(
    run: RunSettings, noun: str, names: Iterable[str], known: Collection[str], *path: str | int
) -> None:
    """Raise `unknown_name_error` if a list, or a section by name, under the key `path` has a name that is not known."""
    for i, name in enumerate(names):
        if name not in known:
            raise unknown_name_error(run, noun, name, known, *path, name if isinstance(names, Mapping) else i)


def input_files_by_name(run: RunSettings) -> dict[str, Path]:
    """Return all input files of a run (configuration, plug-ins, robot, object, recordings), by name in the settings.

    Raises `ConfigError` if a file does not exist. The message has the setting and the most similar existing file.
    """
    files = {"configuration": Path(run.config_file)} if run.config_file else {}
    files |= {path: existing_input_file(run, Path(path), "plug-in", "plugins", i) for i, path in enumerate(run.plugins)}
    robot = run.model.robot
    if robot is not None:
        with add_setting_location_to_errors(run, "model", "robot"):
            file = urdf_path_from_robot_name(robot)
        files[robot] = existing_input_file(run, file, "URDF file", "model", "robot")
    for key, name in {} if run.model.object is None else run.model.object.input_file_paths().items():
        files[name] = existing_input_file(run, Path(name), "file", "model", "object", key)
    for which in ("estimate", "held_out"):
        for i, path in enumerate(getattr(run.recordings, which)):
            files[path] = existing_input_file(run, resolve_recording_path(path), "recording", "recordings", which, i)
    return files


def existing_input_file(run: RunSettings, file: Path, noun: str, *key: str | int) -> Path:
    """Return the path of an existing file. Raises `ConfigError` with the setting `key` and the most similar file."""
    if is_file(file):
        return file
    folder = Path(run.config_file).resolve().parent
    here = Path(os.path.relpath(file, folder))  # the path as written, which may be meant from the working directory
    hint = f"write {os.path.relpath(here, folder)}: paths are relative to the folder of the configuration file"
    if not is_file(here):
        hint = nearest_file_question(file, f"*{file.suffix}") or "correct the path (relative to the configuration file)"
    what = f"there is no such {noun}: {file}"
    if file.is_dir():
        what, hint = f"{file} is a folder, but must be a {noun}", f"write the path of a file, such as {here / 'NAME'}"
    raise run.config_error(what, *key, allowed="the path of an existing file", hint=hint)


def resolve_recording_path(path: str) -> Path:
    """Return the path of a recording. `default:NAME` becomes a file of the package; other paths are unchanged."""
    if not path.startswith("default:"):
        return Path(path)
    return Path(str(resources.files("yid_ocp.data").joinpath("defaults", path.removeprefix("default:"))))


def read_recordings_of_role(run: RunSettings, which: str = "estimate", count: int | None = None) -> list[Recording]:
    """Read the first `count` recordings (None: all) of `recordings.estimate` or `held_out`.

    Names are unique among the recordings of both lists. Errors are as in `read_recording`, with the setting.
    """
    others = () if which == "estimate" else map(resolve_recording_path, run.recordings.estimate)
    found: list[Recording] = []
    for i, path in enumerate(getattr(run.recordings, which)[:count]):
        file = existing_input_file(run, resolve_recording_path(path), "recording", "recordings", which, i)
        with add_setting_location_to_errors(run, "recordings", which, i):
            found.append(read_recording(file))
    return uniquely_named_recordings(found, [path.stem for path in others])


def uniquely_named_recordings(recordings: Iterable[Recording], taken: Iterable[str] = ()) -> list[Recording]:
    """Return recordings with unique names: a name that is repeated or in `taken` gets a number."""
    names, found = [*taken], list[Recording]()
    for recording in recordings:
        name = f"{recording.name}_{len(names)}" if recording.name in names else recording.name
        names.append(name)
        found.append(replace(recording, name=name))
    return found
