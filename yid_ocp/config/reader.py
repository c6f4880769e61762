"""Reader that checks YAML configuration files against the settings classes and reports line numbers."""

from __future__ import annotations

import dataclasses
import difflib
import functools
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass
from importlib import resources
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError
from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedSeq
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.events import AliasEvent, CollectionEndEvent, CollectionStartEvent, ScalarEvent
from ruamel.yaml.parser import Parser
from ruamel.yaml.scanner import Scanner

from yid_ocp import options
from yid_ocp.config import schema
from yid_ocp.config.settings import RunSettings, innermost_location
from yid_ocp.errors import ConfigError, DataError, nearest_file_question, nearest_name_question
from yid_ocp.files import read_input_text

_KeyPath = tuple[str | int, ...]
SHIPPED_DEFAULT_CONFIG_FILE_NAME = "dual_arm_vision.yaml"
SHIPPED_DIAGNOSIS_CONFIG_FILE_NAME = "diagnosis.yaml"

_MAX_DEPTH, _MAX_ENTRIES, _MAX_BYTES = 40, 20_000, 1 << 20  # of a configuration, far beyond what any needs
_ALIAS_COST = 40  # of an alias in entries, because merging one compares its mapping with all others
_ALLOWED_YAML = "lines KEY: VALUE, those of a section with the same indentation; numbers, text, true, false or [lists]"
_FACTORS = {("ms", "s"): 1e-3, ("us", "s"): 1e-6, ("min", "s"): 60.0, ("mm", "m"): 1e-3, ("cm", "m"): 1e-2}
_FACTORS |= {("deg", "rad"): math.pi / 180, ("g", "kg"): 1e-3, ("kHz", "Hz"): 1e3, ("mN m", "N m"): 1e-3}
_RUN_FOLDER_ENDING = re.compile(
    r"(-(check|compare|diagnose|friction|identifiability|inspect|plan|report|simulate|track))?-\d{8}-\d{6}(-\d+)?$"
)
_YAML_FAULTS = {  # what the parser says: in plain words, and the cure
    "found '<scalar>'": ("text after a closing quote or bracket, or no key", "write KEY: 'a \"quoted\" word'"),
    "expected <block end>": ("its indentation differs from that of the lines above", "indent it like its section"),
    "mapping values are not allowed": ("a second colon, or an indentation too deep", "align keys, one in each line"),
    "found undefined alias": ("a * at the beginning, without quotes", "quote patterns, such as '*.stiffness'"),
    "cannot start any token": ("a tab, or a character that needs quotes", "indent by spaces, and quote such text"),
    "could not find expected ':'": ("a key without a colon", "write KEY: VALUE, with a space after the colon"),
}


def load_config(
    path: str | Path | None = None, overrides: Sequence[str] = (), default: str = SHIPPED_DEFAULT_CONFIG_FILE_NAME
) -> RunSettings:
    """Read and check the settings of a configuration file. Without `path`, the embedded file `default` is read.

    Each override is text such as `problem.time_step=0.005`, a key and a YAML value; it replaces the file's value or is
    added. A section in an override is merged key by key with the section of the file, unless it selects another kind or
    method, or is empty. Raises `ConfigError` if the file is missing or is not YAML, a key is unknown or missing, or a
    value has the wrong type or is outside its range. The error states file, line, key, and what is allowed.
    """
    embedded = Path(str(resources.files("yid_ocp.data").joinpath("defaults", default)))
    file, origin = (embedded, "embedded default") if path is None else (Path(path), str(path))
    data, places = _parse(_read(file), origin)
    for override in overrides:
        _override(data, places, override)
    run = _Reader(places, origin, Path.cwd() if path is None else file.resolve().parent).build(RunSettings, data, ())
    name = file.stem
    if file.name == "config.yaml" and (file.parent / "result.json").is_file():  # of a run folder NAME-COMMAND-DATE
        name = _RUN_FOLDER_ENDING.sub("", file.resolve().parent.name)
    return dataclasses.replace(run, name=name, config_file=str(file), key_locations=places)


def _read(path: Path) -> str:
    files = {".urdf": f"{path} RECORDING.h5", ".xml": f"{path} RECORDING.h5", ".h5": f"ROBOT.urdf {path}"}
    if path.suffix in files:  # arguments of `init`
        what = f"{path.name} is a {'recording' if path.suffix == '.h5' else 'robot'}, not a configuration"
        hint = f"write a configuration: yid-ocp init {files[path.suffix]} --out CONFIG.yaml"
        raise ConfigError(what, where=str(path), allowed="a YAML file", hint=hint)
    try:
        return read_input_text(path, _MAX_BYTES)
    except DataError as error:
        what, allowed, hint = error.what, "a YAML file in UTF-8 of at most 1 MiB", error.hint
        if path.is_dir():
            hint = f"use the path of a file, such as {min(path.glob('*.y*ml'), default=path / 'CONFIG.yaml')}"
        if isinstance(error.__context__, FileNotFoundError):
            what, allowed = "there is no such configuration file", "the path of an existing YAML file"
            init = "correct the path, or write a configuration: yid-ocp init ROBOT RECORDING --out CONFIG.yaml"
            hint = nearest_file_question(path, "*.y*ml") or init
        raise ConfigError(what, where=str(path), allowed=allowed, hint=hint) from None


def _parse(text: str, origin: str) -> tuple[dict[str, Any], dict[_KeyPath, str]]:
    data = _loaded(text, origin)
    if data is None:
        data = CommentedMap()
    if not isinstance(data, CommentedMap):
        hint, allowed = "start with the file that `yid-ocp init` writes", "a mapping with sections such as `model:`"
        raise ConfigError("the file has a list or a lone value, but no keys", where=origin, allowed=allowed, hint=hint)
    places: dict[_KeyPath, str] = {}
    return _unwrap(data, (), places, origin), places


class _CheckedParser(Parser):
    """A YAML parser that raises `ConfigError` for tags (`!name`), too many entries, or entries nested too deeply."""

    def __init__(self, origin: str, loader: YAML) -> None:
        super().__init__(loader)
        self._origin, self._count = origin, 0
        self._sizes: dict[str, int] = {}  # sizes of anchored content
        self._begun: list[tuple[str | None, int]] = []  # anchors of the collections that are open, counts before them

    def get_event(self) -> Any:
        event = super().get_event()
        self._count += _ALIAS_COST + self._sizes.get(event.anchor, 0) if isinstance(event, AliasEvent) else 1
        if self._count > _MAX_ENTRIES:
            what = f"the file has more than {_MAX_ENTRIES} entries, with every alias (*NAME) replaced by its content"
            raise self._odd(what, event, "remove entries or aliases")
        if isinstance(event, CollectionStartEvent):
            self._begun.append((event.anchor, self._count))
        elif isinstance(event, CollectionEndEvent):
            anchor, before = self._begun.pop()
            self._sizes |= {anchor: self._count - before} if anchor else {}
        if len(self._begun) > _MAX_DEPTH:
            raise self._odd(f"the entries are nested more than {_MAX_DEPTH} levels deep", event, "use fewer levels")
        if isinstance(event, (ScalarEvent, CollectionStartEvent)) and event.tag is not None:
            raise self._odd(f"the value has the tag '{event.tag}', but no tags are read", event, "remove the tag")
        return event

    def _odd(self, what: str, event: Any, hint: str) -> ConfigError:
        where = f"{self._origin}, line {event.start_mark.line + 1}"
        return ConfigError(what, where=where, allowed=_ALLOWED_YAML, hint=hint)


def _loaded(text: str, origin: str) -> Any:
    yaml = YAML(typ="rt")  # keeps line numbers; comments are ignored, as their positions are sometimes wrong
    yaml.Scanner, yaml.Parser = Scanner, functools.partial(_CheckedParser, origin)
    try:
        return yaml.load(text)
    except MarkedYAMLError as error:
        line = f", line {error.problem_mark.line + 1}" if error.problem_mark is not None else ""
        problem = str(error.problem or error.context).split("\n")[0]
        known = (words for part, words in _YAML_FAULTS.items() if part in f"{error.context} {problem}")
        problem, hint = next(known, (problem, "check indentation, brackets and colons near this line"))
        twice = re.match(r'found duplicate key "(.*?)"', problem)
        what = f"the key '{twice[1]}' is duplicated" if twice else f"the file is not valid YAML: {problem}"
        allowed, hint = ("each key once in a section", "remove one of the two") if twice else (_ALLOWED_YAML, hint)
        raise ConfigError(what, where=f"{origin}{line}", allowed=allowed, hint=hint) from None
    except (YAMLError, ValueError, TypeError, LookupError, AttributeError, ArithmeticError):
        # errors of the YAML library on unusual text: numbers of thousands of digits, keys that are lists
        what, hint = "the file is not valid YAML", "remove numbers of over 4000 digits, and keys that are lists"
        raise ConfigError(what, where=origin, allowed=_ALLOWED_YAML, hint=hint) from None


def _unwrap(node: Any, path: _KeyPath, places: dict[_KeyPath, str], origin: str) -> Any:
    """Convert the YAML reader's values to plain Python values, and store their lines in `places`."""
    if len(path) > _MAX_DEPTH:
        what, hint = "an alias (*NAME) stands within the entry that it repeats", "replace it by the intended content"
        raise ConfigError(what, where=origin, allowed="aliases of other entries", hint=hint)
    if isinstance(node, CommentedMap):
        result: dict[str, Any] = {}
        for key, value in node.items():
            name = str(key)
            places[(*path, name)] = _place(node, key, origin)
            result[name] = _unwrap(value, (*path, name), places, origin)
        return result
    if isinstance(node, CommentedSeq):
        for i in range(len(node)):
            places[(*path, i)] = _place(node, i, origin)
        return [_unwrap(value, (*path, i), places, origin) for i, value in enumerate(node)]
    if isinstance(node, str) and "\0" in node:
        what, allowed = "the text contains a null character", "text without null characters"
        raise ConfigError(what, where=places.get(path, origin), allowed=allowed, hint="remove the character")
    if isinstance(node, int) and node.bit_length() > 1023:
        what, allowed, hint = "the number has too many digits", "numbers below 1e308", "write a smaller number"
        raise ConfigError(what, where=places.get(path, origin), allowed=allowed, hint=hint)
    for kind in (bool, int, float, str):
        if isinstance(node, kind):
            return kind(node)
    return node


def _place(node: CommentedMap | CommentedSeq, key: Any, origin: str) -> str:
    try:
        line = (node.lc.key(key) if isinstance(node, CommentedMap) else node.lc.item(key))[0]
    except (KeyError, TypeError):
        line = node.lc.line
    return origin if origin.startswith("--set ") else f"{origin}, line {int(line) + 1}"


def _override(data: dict[str, Any], places: dict[_KeyPath, str], text: str) -> None:
    key, equals, value_text = text.partition("=")
    origin = f"--set {key.strip()}"
    if not equals or not key.strip():
        allowed, hint = "KEY=VALUE", "write, for example, --set problem.time_step=0.005"
        raise ConfigError(f"'{text}' is not of the form KEY=VALUE", where="--set", allowed=allowed, hint=hint)
    path, hint = _key_path(RunSettings, key.strip().split("."), origin, data)
    try:
        value = _loaded(value_text, origin) if value_text.strip() else None
    except ConfigError:
        spaced = re.sub(r":(?=\S)", ": ", value_text)
        what, hint = f"the value '{value_text[:80]}' is not valid YAML", "close brackets and quotation marks"
        if "{" in value_text and spaced != value_text:
            what, hint = f"{what}: a space is missing after a colon", f"write --set '{key.strip()}={spaced}'"
        raise ConfigError(what, where=origin, allowed="a number, text, [list], {key: value}", hint=hint) from None
    parent = data
    for i, part in enumerate(path[:-1]):
        entry = parent.get(part)
        if not isinstance(entry, dict):
            entry = parent[part] = {}
            places[path[: i + 1]] = origin
        parent = entry
    own: dict[_KeyPath, str] = {path: origin}
    parent[path[-1]] = _merged(hint, parent.get(path[-1]), _unwrap(value, path, own, origin), path, places)
    places |= own


def _merged(hint: Any, before: Any, value: Any, path: _KeyPath, places: dict[_KeyPath, str]) -> Any:
    """Return a key's value after an override: sections of one kind are merged, other values are replaced."""
    sections = schema.section_variants_from_annotation(hint)
    merges = bool(value) and isinstance(before, dict) and isinstance(value, dict)
    if merges and sections is not None and sections.selector_key in value:
        merges = sections.read_variant_name(value) == sections.read_variant_name(before)
    if not merges:
        for known in [known for known in places if known[: len(path)] == path]:
            del places[known]
        return value
    keys = {} if sections is None else sections.options_of_variant(sections.read_variant_name({**before, **value}))
    for name, entry in value.items():
        kind = keys[name].type_hint if name in keys else options.mapping_value_type(hint)
        before[name] = _merged(kind, before.get(name), entry, (*path, name), places)
    return before


def _key_path(hint: Any, parts: list[str], origin: str, raw: Any) -> tuple[tuple[str, ...], Any]:
    """Split a dotted key by the types of the settings (names such as T1.bend keep dots), and return the last type."""
    if not parts:
        return (), hint
    name, rest = parts[0], parts[1:]
    sections, values = schema.section_variants_from_annotation(hint), options.mapping_value_type(hint)
    inner = schema.section_variants_from_annotation(values)
    if sections is not None:
        known = sections.options_of_variant(sections.read_variant_name(raw))
        if name not in known:
            raise schema.unknown_key_error(name, known, origin)
        below = known[name].type_hint
    elif values is None:
        key = origin.removeprefix("--set ").removesuffix("." + ".".join(parts))
        what, allowed = f"'{key}' has a value, and no key '{name}' below it", options.describe_type(hint)
        raise ConfigError(what, where=origin, allowed=allowed, hint=f"write --set {key}=VALUE")
    elif inner is not None and inner.selector_key == "name":
        below = inner.variants_for_named_entry(name, origin).classes[""]
    else:
        known = {} if inner is None else inner.options_of_variant()
        cut = next((i for i in range(len(parts) - 1, 0, -1) if parts[i] in known), len(parts))
        if isinstance(raw, dict) and ".".join(parts[:-1]) in raw and cut == len(parts) and known:
            raise schema.unknown_key_error(parts[-1], known, origin)
        name, rest, below = ".".join(parts[:cut]), parts[cut:], values
    path, found = _key_path(below, rest, origin, raw.get(name) if isinstance(raw, dict) else None)
    return (name, *path), found


@dataclass(frozen=True)
class _Reader:
    """Builds settings objects from plain data. `places` holds the location of each value for error messages."""

    places: Mapping[_KeyPath, str]
    origin: str
    base: Path

    def where(self, path: _KeyPath) -> str:
        key, place = ".".join(map(str, path)), innermost_location(self.places, path) or self.origin
        return place if not key or place == f"--set {key}" else f"{place}: {key}"

    def build(self, hint: Any, raw: Any, path: _KeyPath, default: Any = MISSING) -> Any:
        sections, entries = schema.section_variants_from_annotation(hint), options.variadic_tuple_entry_type(hint)
        inner = schema.section_variants_from_annotation(options.mapping_value_type(hint))
        if sections is not None:
            return None if raw is None and sections.is_nullable else self._section(sections, raw, path)
        if entries is not None and schema.section_variants_from_annotation(entries) is not None:
            if not isinstance(raw, list):
                raise self._wrong(raw, hint, path, default)
            return tuple(self.build(entries, value, (*path, i)) for i, value in enumerate(raw))
        if inner is not None:
            if raw is not None and not isinstance(raw, dict):
                raise self._wrong(raw, hint, path, default)
            return {
                name: self._section(inner.variants_for_named_entry(name, self.where((*path, name))), own, (*path, name))
                for name, own in (raw or {}).items()
            }
        try:
            text = json.dumps(raw)
            json.loads(text, parse_constant=_refuse_nan)
            value = _adapter(hint).validate_json(text, strict=True)
        except (ValidationError, TypeError, ValueError):
            raise self._wrong(raw, hint, path, default) from None
        return _absolute(value, hint, self.base)

    def _section(self, sections: schema.SectionVariants, raw: Any, path: _KeyPath) -> Any:
        raw = {} if raw is None else raw
        if not isinstance(raw, dict):
            keys = list(sections.options_of_variant(sections.default_variant))
            name, what = self._name(path), f"{self._name(path)} = {_shown(raw)} is not a section"
            near = difflib.get_close_matches(name.rpartition(".")[2], keys, 1, 0.65)
            hint = f"did you mean '{near[0]}'?" if near else f"add a key, as in {name}.{keys[0]}"
            raise ConfigError(what, where=self.where(path), allowed="keys: " + ", ".join(keys), hint=hint)
        word = sections.read_variant_name(raw)
        if not isinstance(word, str) or word not in sections.classes:
            at = (*path, sections.selector_key) if sections.selector_key in raw else path
            raise sections.unknown_variant_error(word, self.where(at))
        known, kind = sections.options_of_variant(word), sections.classes[word]
        for name in raw:
            if name not in known:
                within = ".".join(map(str, path))
                within += f" with {sections.selector_key}: {word}" if within and len(sections.classes) > 1 else ""
                raise schema.unknown_key_error(name, known, self.where((*path, name)), within)
        values: dict[str, Any] = {}
        for name, option in options.class_options_by_key(kind).items():
            if name in raw:
                values[option.field_name] = self.build(option.type_hint, raw[name], (*path, name), option.default_value)
            elif option.default_value is MISSING:
                allowed, hint = options.describe_type(option.type_hint), f"add {self._name((*path, name))}: VALUE"
                raise ConfigError(f"the key '{name}' is missing", where=self.where(path), allowed=allowed, hint=hint)
        return kind(**values)

    def _wrong(self, raw: Any, hint: Any, path: _KeyPath, default: Any) -> ConfigError:
        named = schema.section_variants_from_annotation(options.mapping_value_type(hint))
        unit = schema.option_info_from_annotation(hint).unit
        advice = options.default_value_hint(self._name(path), options.Option(hint, default))
        if isinstance(raw, str) and (match := re.fullmatch(r"\s*([-+]?[\d.]+(?:[eE][-+]?\d+)?)\s*([^\d\s.,].*)", raw)):
            given = match[2].strip()
            factor = _FACTORS.get((given, unit), float(given == unit)) * (match[1].count(".") < 2)
            number = f"{float(match[1]) * factor:.6g}" if factor else "the number"
            advice = f"write {number} alone, without a unit" + f": it is in {unit}" * bool(unit)
        kinds = [own for own in map(options.variadic_tuple_entry_type, options.non_none_union_members(hint)) if own]
        are_sections = any(schema.section_variants_from_annotation(kind) is not None for kind in kinds)
        if kinds and (isinstance(raw, dict) or (isinstance(raw, str) and not are_sections)):
            advice = f"write it as a list of one entry: [{_shown(raw)}]"
        if isinstance(raw, str):
            advice = nearest_name_question(raw, options.literal_choices(hint)) or advice
        if isinstance(raw, (list, str)) and named is not None and named.selector_key == "name":
            asked = [raw] if isinstance(raw, str) else [own for own in raw if isinstance(own, str)]
            meant = [next(iter(difflib.get_close_matches(own, named.classes, 1)), own) for own in asked]
            sections = ", ".join(f"{own}: {{}}" for own in dict.fromkeys(meant))
            advice = f"write a section, {self._name(path)}: {{{sections}}}, in place of {_shown(raw)}"
        shown = f"{_shown(raw)} {unit}".rstrip() if type(raw) in (int, float) and not {*",'"} & {*unit} else _shown(raw)
        what = f"{self._name(path)} is {shown}, which is not allowed"
        return ConfigError(what, where=self.where(path), allowed=options.describe_type(hint), hint=advice)

    @staticmethod
    def _name(path: _KeyPath) -> str:
        return ".".join(map(str, path)) or "the configuration"


_adapter = functools.cache(TypeAdapter)


def _refuse_nan(word: str) -> float:
    if word == "NaN":
        raise ValueError("not a number")
    return float(word)


def _absolute(value: Any, hint: Any, base: Path) -> Any:
    if isinstance(value, tuple):
        entries = options.variadic_tuple_entry_type(hint)
        return value if entries is None else tuple(_absolute(entry, entries, base) for entry in value)
    parts = (hint, *options.non_none_union_members(hint))
    markers = [marker for part in parts for marker in options.split_annotated(part)[1]]
    is_path = any(isinstance(marker, options.OptionInfo) and marker.is_path for marker in markers)
    if not isinstance(value, str) or not is_path or value.startswith(("package:", "default:")):
        return value
    return str((base / Path(value).expanduser()).resolve())


def _shown(raw: Any) -> str:
    text = json.dumps(raw, default=str)
    return text if len(text) <= 60 else text[:57] + "..."
