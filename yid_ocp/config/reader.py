"""Configuration files: YAML read with line numbers, checked against the settings, and the JSON Schema for editors."""

from __future__ import annotations

import dataclasses
import functools
import json
import math
import re
import types
import typing
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import annotated_types
from pydantic import TypeAdapter, ValidationError
from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedSeq
from ruamel.yaml.error import MarkedYAMLError, YAMLError

from yid_ocp.config.settings import Run
from yid_ocp.config.settings import dump_config as dump_config
from yid_ocp.errors import ConfigError, nearest
from yid_ocp.options import About

KeyPath = tuple[str | int, ...]
DEFAULT = "dual_arm_vision.yaml"
DIAGNOSIS_DEFAULT = "diagnosis.yaml"


def load_config(path: str | Path | None = None, overrides: Sequence[str] = (), default: str = DEFAULT) -> Run:
    """Read and check a configuration file.

    Parameters
    ----------
    path : str or Path, optional
        The YAML file; the embedded default when absent.
    overrides : sequence of str
        `a.b=c` each: the key and a value in YAML that replaces or adds to the file's.
    default : str
        Name of the embedded file.

    Returns
    -------
    Run

    Raises
    ------
    ConfigError
        No such file, not YAML, an unknown or missing key, a value of the wrong kind or outside its range; it names
        file, line and key, what is allowed and the nearest known key.
    """
    if path is None:
        entry = resources.files("yid_ocp.data").joinpath("defaults", default)
        text, name, origin, base = entry.read_text(encoding="utf-8"), Path(default).stem, "embedded default", Path.cwd()
        file = str(entry)
    else:
        given = Path(path)
        text, name, origin, base, file = _read(given), given.stem, str(path), given.resolve().parent, str(given)
    data, places = _parse(text, origin)
    for override in overrides:
        _override(data, places, override)
    run = _Reader(places, origin, base).build(Run, data, ())
    return dataclasses.replace(run, name=name, file=file, places=places)


def schema() -> dict[str, Any]:
    """JSON Schema of configuration files, for editors that complete and check while typing."""
    head = {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "yid-ocp configuration"}
    return head | _schema(Run)


# -- reading ----------------------------------------------------------------------------------------------------------


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        hint = "check the path"
        if path.parent.is_dir():
            hint = nearest(path.name, (entry.name for entry in path.parent.glob("*.yaml")))
        raise ConfigError("there is no such configuration file", where=str(path), hint=hint) from error
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
        raise ConfigError(
            f"the configuration cannot be read: {reason}", where=str(path), allowed="a YAML file in UTF-8"
        ) from error


def _parse(text: str, origin: str) -> tuple[dict[str, Any], dict[KeyPath, str]]:
    try:
        data = YAML(typ="rt").load(text)
    except MarkedYAMLError as error:
        line = f", line {error.problem_mark.line + 1}" if error.problem_mark is not None else ""
        problem = str(error.problem or error.context).split("\n")[0]
        twice = re.match(r'found duplicate key "(.*?)"', problem)
        raise ConfigError(
            f"the key '{twice[1]}' stands twice" if twice else f"the file is not valid YAML: {problem}",
            where=f"{origin}{line}",
            hint="check indentation, brackets, colons and keys that stand twice",
        ) from error
    except YAMLError as error:
        raise ConfigError(f"the file is not valid YAML: {str(error).splitlines()[0]}", where=origin) from error
    if data is None:
        data = CommentedMap()
    if not isinstance(data, CommentedMap):
        raise ConfigError("the file does not hold keys and values", where=origin, allowed="sections such as `model:`")
    places: dict[KeyPath, str] = {}
    return _unwrap(data, (), places, origin), places


def _unwrap(node: Any, path: KeyPath, places: dict[KeyPath, str], origin: str) -> Any:
    """Plain Python values in place of the YAML reader's own; their lines go into `places`."""
    if isinstance(node, CommentedMap):
        result: dict[str, Any] = {}
        for key, value in node.items():
            name = str(key)
            places[(*path, name)] = f"{origin}, line {node.lc.key(key)[0] + 1}"
            result[name] = _unwrap(value, (*path, name), places, origin)
        return result
    if isinstance(node, CommentedSeq):
        for i in range(len(node)):
            places[(*path, i)] = f"{origin}, line {node.lc.item(i)[0] + 1}"
        return [_unwrap(value, (*path, i), places, origin) for i, value in enumerate(node)]
    for kind in (bool, int, float, str):
        if isinstance(node, kind):
            return kind(node)
    return node


def _override(data: dict[str, Any], places: dict[KeyPath, str], text: str) -> None:
    key, equals, value_text = text.partition("=")
    origin = f"--set {key.strip()}"
    if not equals or not key.strip():
        raise ConfigError(
            f"'{text}' does not set anything", where="--set", allowed="KEY=VALUE, for example solver.time_step=0.005"
        )
    path = _key_path(Run, key.strip().split("."), origin, data)
    try:
        value = YAML(typ="rt").load(value_text) if value_text.strip() else None
    except YAMLError as error:
        raise ConfigError(
            f"the value '{value_text}' is not valid YAML", where=origin, allowed="a number, text, [list], {key: value}"
        ) from error
    parent = data
    for part in path[:-1]:
        entry = parent.get(part)
        if not isinstance(entry, dict):
            entry = parent[part] = {}
        parent = entry
    for known in [known for known in places if known[: len(path)] == path]:
        del places[known]
    parent[path[-1]] = _unwrap(value, path, places, origin)
    places[path] = origin


def _key_path(hint: Any, parts: list[str], origin: str, raw: Any) -> tuple[str, ...]:
    """Split a dotted key by the settings' types: names such as T1.bend keep their dots."""
    if not parts:
        return ()
    kind = _member(hint, raw)
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        fields = _fields(kind, raw)
        if parts[0] not in fields:
            raise ConfigError(
                f"there is no key '{parts[0]}'",
                where=origin,
                allowed=", ".join(fields),
                hint=nearest(parts[0], fields),
            )
        inner = raw.get(parts[0]) if isinstance(raw, dict) else None
        return (parts[0], *_key_path(fields[parts[0]].hint, parts[1:], origin, inner))
    entries = _mapping_of(hint)
    if entries is None:
        raise ConfigError(f"there are no keys below '{parts[0]}'", where=origin, hint="shorten the key")
    member = _member(entries, None)
    fields = _fields(member, None) if member is not None else {}
    cut = next((i for i in range(len(parts) - 1, 0, -1) if parts[i] in fields), len(parts))
    if isinstance(raw, dict) and ".".join(parts[:-1]) in raw and cut == len(parts) and fields:
        raise ConfigError(
            f"there is no key '{parts[-1]}'", where=origin, allowed=", ".join(fields), hint=nearest(parts[-1], fields)
        )
    name = ".".join(parts[:cut])
    inner = raw.get(name) if isinstance(raw, dict) else None
    return (name, *_key_path(entries, parts[cut:], origin, inner))


# -- types ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Field:
    hint: Any
    default: Any
    holder: str  # the attribute whose flattened value the key belongs to, empty for a key of one's own


def _fields(kind: type, raw: Any) -> dict[str, _Field]:
    """Keys of a settings class; those of a flattened member (a solver's own settings) among them."""
    hints = _hints(kind)
    result: dict[str, _Field] = {}
    for entry in dataclasses.fields(kind):
        if entry.metadata.get("internal"):
            continue
        if "choose" in entry.metadata:
            chosen = entry.metadata["choose"](raw if isinstance(raw, dict) else {})
            own = {n: f for n, f in _fields(chosen, None).items() if n not in result and n != "name"}
            result |= {n: dataclasses.replace(f, holder=entry.name) for n, f in own.items()}
            continue
        default = entry.default if entry.default_factory is MISSING else entry.default_factory()
        result[entry.name] = _Field(hints[entry.name], default, "")
    return result


@functools.cache
def _hints(kind: type) -> dict[str, Any]:
    return get_type_hints(kind, include_extras=True)


def _stripped(hint: Any) -> tuple[Any, list[Any]]:
    markers: list[Any] = []
    while get_origin(hint) is Annotated:
        markers += hint.__metadata__
        hint = get_args(hint)[0]
    return hint, markers


def _options(hint: Any) -> tuple[Any, ...]:
    """Members of a union, without None."""
    bare, _ = _stripped(hint)
    if get_origin(bare) in (Union, types.UnionType):
        return tuple(member for member in get_args(bare) if member is not type(None))
    return (bare,)


def _member(hint: Any, raw: Any) -> Any:
    """The settings class that a value is meant for, chosen by its `kind` among several; None for other types."""
    bare = [_stripped(member)[0] for member in _options(hint)]
    classes = [member for member in bare if dataclasses.is_dataclass(member)]
    if len(classes) > 1:
        wanted = raw.get("kind") if isinstance(raw, dict) else None
        return next((member for member in classes if _kind(member) == wanted), classes[0])
    return classes[0] if classes else None


def _kind(member: Any) -> str:
    return str(get_args(_stripped(_hints(member)["kind"])[0])[0])


def _sequence_of(hint: Any) -> Any:
    """Settings class of the entries of a list; None for other types."""
    bare, _ = _stripped(hint)
    arguments = get_args(bare)
    if get_origin(bare) is tuple and len(arguments) == 2 and arguments[1] is Ellipsis:
        return arguments[0] if _member(arguments[0], None) is not None else None
    return None


def _mapping_of(hint: Any) -> Any:
    """Type of the values of a mapping; None for other types."""
    for member in _options(hint):
        bare, _ = _stripped(member)
        if get_origin(bare) is Mapping:
            return get_args(bare)[1]
    return None


@dataclass(frozen=True)
class _Reader:
    """Builds settings from plain data and says where something is wrong."""

    places: Mapping[KeyPath, str]
    origin: str
    base: Path

    def where(self, path: KeyPath) -> str:
        key = ".".join(map(str, path))
        for count in range(len(path), 0, -1):
            if path[:count] in self.places:
                place = self.places[path[:count]]
                return place if place == f"--set {key}" else f"{place}: {key}"
        return f"{self.origin}: {key}" if key else self.origin

    def build(self, hint: Any, raw: Any, path: KeyPath) -> Any:
        """A value of the given type."""
        kind = _member(hint, raw)
        nullable = type(None) in get_args(_stripped(hint)[0])
        if raw is None and (nullable or kind is not None):
            return None if nullable else self._settings(kind, {}, path)
        if kind is not None:
            return self._settings(self._chosen(hint, raw, path), raw, path)
        entries = _sequence_of(hint)
        if entries is not None:
            if not isinstance(raw, list):
                raise self._wrong(raw, hint, path)
            return tuple(self.build(entries, value, (*path, i)) for i, value in enumerate(raw))
        inner = _mapping_of(hint)
        if inner is not None and _member(inner, None) is not None:
            if raw is not None and not isinstance(raw, dict):
                raise self._wrong(raw, hint, path)
            return {name: self.build(inner, value, (*path, name)) for name, value in (raw or {}).items()}
        return self._leaf(hint, raw, path)

    def _chosen(self, hint: Any, raw: Any, path: KeyPath) -> type:
        classes = [_stripped(member)[0] for member in _options(hint)]
        if len(classes) == 1 or not isinstance(raw, dict):
            return typing.cast(type, classes[0])
        kinds = {_kind(member): member for member in classes}
        wanted = raw.get("kind")
        if wanted not in kinds:
            what = "the key 'kind' is missing" if wanted is None else f"there is no kind '{wanted}'"
            raise ConfigError(
                what,
                where=self.where((*path, "kind") if "kind" in raw else path),
                allowed=", ".join(kinds),
                hint="" if wanted is None else nearest(str(wanted), kinds),
            )
        return typing.cast(type, kinds[wanted])

    def _settings(self, kind: type, raw: Any, path: KeyPath) -> Any:
        if not isinstance(raw, dict):
            allowed = "keys: " + ", ".join(_fields(kind, None))
            raise ConfigError(
                f"{self._name(path)} = {_shown(raw)} is not a section", where=self.where(path), allowed=allowed
            )
        fields = _fields(kind, raw)
        for name in raw:
            if name not in fields:
                raise ConfigError(
                    f"there is no key '{name}'" + (f" in {'.'.join(map(str, path))}" if path else ""),
                    where=self.where((*path, name)),
                    allowed=", ".join(fields),
                    hint=nearest(name, fields),
                )
        values: dict[str, Any] = {}
        flat: dict[str, dict[str, Any]] = {}
        for name, entry in fields.items():
            if name in raw:
                value = self.build(entry.hint, raw[name], (*path, name))
            elif entry.default is MISSING:
                raise ConfigError(
                    f"the key '{name}' is missing", where=self.where(path), allowed=_described(entry.hint)
                )
            else:
                value = entry.default
            (flat.setdefault(entry.holder, {}) if entry.holder else values)[name] = value
        for member in dataclasses.fields(kind):
            if "choose" in member.metadata:
                self._known_choice(member, raw, path)
                values[member.name] = member.metadata["choose"](raw)(**flat.get(member.name, {}))
        return kind(**values)

    def _known_choice(self, entry: dataclasses.Field, raw: Mapping[str, Any], path: KeyPath) -> None:
        among = entry.metadata["among"]
        if "name" in raw and raw["name"] not in among:
            raise ConfigError(
                f"there is no {among.noun} '{raw['name']}'",
                where=self.where((*path, "name")),
                allowed=", ".join(among),
                hint=nearest(str(raw["name"]), among),
            )

    def _leaf(self, hint: Any, raw: Any, path: KeyPath) -> Any:
        try:
            text = json.dumps(raw)
            value = _adapter(hint).validate_json(text, strict=True)
        except (ValidationError, TypeError, ValueError) as error:
            raise self._wrong(raw, hint, path) from error
        if "NaN" in text and _has_nan(raw):
            raise self._wrong(raw, hint, path)
        return _absolute(value, hint, self.base)

    def _wrong(self, raw: Any, hint: Any, path: KeyPath) -> ConfigError:
        unit = next((m.unit for m in _stripped(hint)[1] if isinstance(m, About) and m.unit), "")
        hint_text = ""
        if isinstance(raw, str) and (match := re.fullmatch(r"\s*([-+]?[\d.]+(?:[eE][-+]?\d+)?)\s*([^\d\s].*)", raw)):
            hint_text = f"write the number alone, in {unit}" if unit else "write the number alone"
            if unit and match[2].strip() != unit:
                hint_text += f": convert it from {match[2].strip()}"
        return ConfigError(
            f"{self._name(path)} = {_shown(raw)} is not allowed",
            where=self.where(path),
            allowed=_described(hint),
            hint=hint_text,
        )

    @staticmethod
    def _name(path: KeyPath) -> str:
        return ".".join(map(str, path)) or "the configuration"


def _adapter(hint: Any) -> TypeAdapter[Any]:
    try:
        return _cached_adapter(hint)
    except TypeError:
        return TypeAdapter(hint)


@functools.cache
def _cached_adapter(hint: Any) -> TypeAdapter[Any]:
    return TypeAdapter(hint)


def _has_nan(raw: Any) -> bool:
    if isinstance(raw, dict):
        return any(map(_has_nan, raw.values()))
    if isinstance(raw, list):
        return any(map(_has_nan, raw))
    return isinstance(raw, float) and math.isnan(raw)


def _absolute(value: Any, hint: Any, base: Path) -> Any:
    bare, markers = _stripped(hint)
    if isinstance(value, str):
        is_path = any(isinstance(marker, About) and marker.path for marker in markers)
        is_path = is_path or any(
            isinstance(marker, About) and marker.path for member in _options(hint) for marker in _stripped(member)[1]
        )
        if is_path and not value.startswith(("package:", "default:")):
            return str((base / Path(value).expanduser()).resolve())
        return value
    if isinstance(value, tuple) and get_origin(bare) is tuple and get_args(bare)[-1] is Ellipsis:
        return tuple(_absolute(entry, get_args(bare)[0], base) for entry in value)
    return value


def _shown(raw: Any) -> str:
    text = json.dumps(raw, default=str)
    return text if len(text) <= 60 else text[:57] + "..."


def _described(hint: Any) -> str:
    """A type in words, with its range and unit."""
    bare, markers = _stripped(hint)
    unit = next((m.unit for m in markers if isinstance(m, About) and m.unit), "")
    limits = [
        f"{word} {getattr(marker, name):g}"
        for marker in markers
        for cls, name, word in (
            (annotated_types.Gt, "gt", "above"),
            (annotated_types.Ge, "ge", "from"),
            (annotated_types.Lt, "lt", "below"),
            (annotated_types.Le, "le", "up to"),
        )
        if isinstance(marker, cls)
    ]
    text = " or ".join(dict.fromkeys(map(_bare_words, _options(bare))))
    return " ".join([text, *limits]) + (f" [{unit}]" if unit else "")


def _bare_words(hint: Any) -> str:
    bare, markers = _stripped(hint)
    if markers:
        return _described(hint)
    words = {float: "a number", int: "a whole number", bool: "true or false", str: "text"}
    if bare in words:
        return words[bare]
    origin, arguments = get_origin(bare), get_args(bare)
    if origin is Literal:
        return ", ".join(map(str, arguments))
    if origin is tuple and arguments[-1] is Ellipsis:
        return f"a list, each {_bare_words(arguments[0])}"
    if origin is tuple:
        return f"a list of {len(arguments)}, each {_bare_words(arguments[0])}"
    if _mapping_of(bare) is not None:
        return f"names, each with {_bare_words(_mapping_of(bare))}"
    return "a section"


# -- schema -----------------------------------------------------------------------------------------------------------


def _schema(hint: Any) -> dict[str, Any]:
    """JSON Schema of a type, from the same walk as the reader's."""
    bare, markers = _stripped(hint)
    about = next((marker for marker in markers if isinstance(marker, About)), None)
    text = "" if about is None else about.text + (f" [{about.unit}]" if about.unit else "")
    note = {"description": text} if text else {}
    classes = [_stripped(member)[0] for member in _options(bare)]
    if classes and all(map(dataclasses.is_dataclass, classes)):
        parts = [_class_schema(member) for member in classes]
        if type(None) in get_args(bare):
            parts.append({"type": "null"})
        return (parts[0] if len(parts) == 1 else {"anyOf": parts}) | note
    entries = _sequence_of(bare)
    if entries is not None:
        return {"type": "array", "items": _schema(entries)} | note
    inner = _mapping_of(bare)
    if inner is not None and _member(inner, None) is not None:
        return {"type": "object", "additionalProperties": _schema(inner)} | note
    return _adapter(hint).json_schema() | note


def _class_schema(kind: Any) -> dict[str, Any]:
    properties: dict[str, Any] = {}
    required = []
    for name, entry in _fields(kind, None).items():
        properties[name] = _schema(entry.hint)
        if entry.default is MISSING:
            required.append(name)
        elif isinstance(entry.default, (bool, int, str)) or (
            isinstance(entry.default, float) and math.isfinite(entry.default)
        ):
            properties[name]["default"] = entry.default
    for field in dataclasses.fields(kind):
        if "choose" in field.metadata:
            among = field.metadata["among"]
            properties["name"] = {"enum": list(among), "default": "gauss_newton", "description": f"the {among.noun}"}
            for method in among:
                for name, entry in _fields(among[method], None).items():
                    properties.setdefault(name, _schema(entry.hint))
    result: dict[str, Any] = {"type": "object", "properties": properties, "additionalProperties": False}
    if kind.__doc__:
        result["description"] = kind.__doc__.splitlines()[0]
    return result | ({"required": required} if required else {})
