"""Plug-ins: effects and sensors from files named in a configuration and from installed packages."""

from __future__ import annotations

import importlib.util
import sys
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from typing import Any

from yid_ocp.config.settings import RunSettings
from yid_ocp.effects import EFFECTS
from yid_ocp.errors import ConfigError, YidError
from yid_ocp.files import file_sha256
from yid_ocp.registry import Registry
from yid_ocp.sensors import SENSOR_READERS

_ENTRY_POINT_GROUP = "yid_ocp.effects"
"""Entry points of this group are modules that register effects or sensors when they are imported."""

_REGISTRIES: tuple[Registry[Any], ...] = (EFFECTS, SENSOR_READERS)
_loaded: dict[str, str] = {}  # what this process has run: file or entry point, and the hash or distribution


def load_plugins(run: RunSettings) -> None:
    """Import the files of `plugins` and the entry points of `_ENTRY_POINT_GROUP`, each once per process.

    Raises
    ------
    ConfigError
        A file that is missing, raises, registers nothing, or uses a name that is taken; one that changed after this
        process ran it. Nothing of it stays registered.
    """
    for entry in _installed():
        name, of = f"entry point {entry.name}", _distribution(entry)
        if name not in _loaded:
            imported = entry.module in sys.modules  # by somebody's script, which registered it
            with _registering(name, f"{entry.value} of {of}", "update that package, or remove it", None, imported):
                entry.load()
            _loaded[name] = of
    for path, where in _plugin_files(run):
        name, digest = str(path.resolve()), file_sha256(path)
        if _loaded.get(name, digest) != digest:
            raise ConfigError("the plug-in changed after it was loaded", where=where, hint="start a new Python")
        if name not in _loaded:
            with _registering(f"plug-in {path.name}", where, f"correct {path.name}", path):
                _run(path, digest)
            _loaded[name] = digest


def _plugin_files(run: RunSettings) -> list[tuple[Path, str]]:
    """Plug-in files, each with the location of its setting."""
    return [(Path(path), run.describe_location("plugins", i)) for i, path in enumerate(run.plugins)]


def plugin_versions() -> dict[str, str]:
    """Package and version of every entry point of `_ENTRY_POINT_GROUP`."""
    return {f"entry point {entry.name}": _distribution(entry) for entry in _installed()}


def _distribution(entry: metadata.EntryPoint) -> str:
    return "unknown" if entry.dist is None else f"{entry.dist.name} {entry.dist.version}"


def _installed() -> Sequence[metadata.EntryPoint]:
    return sorted(metadata.entry_points(group=_ENTRY_POINT_GROUP), key=lambda entry: entry.name)


def _run(path: Path, digest: str) -> None:
    """Import a file under a name that nothing else has, so that two of one name do not meet."""
    name = f"yid_ocp_plugin_{path.stem}_{digest[:8]}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ImportError("this is no Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look for the module of their class
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise


@contextmanager
def _registering(
    name: str, where: str, hint: str, path: Path | None = None, nothing_new: bool = False
) -> Iterator[None]:
    """Say what is wrong with a plug-in that the block runs, and forget what it registered until then."""
    before = [set(registry) for registry in _REGISTRIES]
    try:
        yield
        unchanged = all(set(registry) == known for registry, known in zip(_REGISTRIES, before, strict=True))
        if unchanged and not nothing_new:
            decorators = "@EFFECTS.register(NAME) or @SENSORS.register(NAME)"
            raise ConfigError(
                f"the {name} registers nothing", where=where, allowed=f"a class or function under {decorators}"
            )
    except (Exception, SystemExit) as error:
        for registry, known in zip(_REGISTRIES, before, strict=True):
            registry.unregister(set(registry) - known)
        if isinstance(error, YidError):
            what = f"the {name} cannot be used: {error.what}" if error.where != where else error.what
            raise ConfigError(what, where=where, allowed=error.allowed, hint=error.hint or hint) from error
        line = None if path is None else _line(error, path)
        what = f"the {name} raised {type(error).__name__}: {error}"
        raise ConfigError(what, where=f"{where} (line {line})" if line else where, hint=hint) from error


def _line(error: BaseException, path: Path) -> int | None:
    """Last line of a file on the way to an error."""
    if isinstance(error, SyntaxError):
        return error.lineno
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(path)]
    return lines[-1] if lines else None
