"""Annotations of the options that users can set.

An option is a field of a frozen dataclass, annotated with its bounds and with `OptionInfo`:

    time_step: Annotated[float, Gt(0), Le(0.1), OptionInfo("time step", "s")] = 0.01

Reader, `--set`, checks and JSON Schema are derived from the annotation. Fields without `OptionInfo` are for Python.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import operator
import types
from collections.abc import Callable, Iterable, Mapping
from dataclasses import MISSING, dataclass
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import annotated_types

from yid_ocp.errors import ConfigError
from yid_ocp.registry import Registry

PositiveFloat = Annotated[float, annotated_types.Gt(0)]
_BOUND_MARKERS = (
    (annotated_types.Gt, "gt", operator.gt, "above"),
    (annotated_types.Ge, "ge", operator.ge, "from"),
    (annotated_types.Lt, "lt", operator.lt, "below"),
    (annotated_types.Le, "le", operator.le, "up to"),
)
_TYPE_WORDS = {float: "a number", int: "a whole number", bool: "true or false", str: "text", Any: "anything"}


@dataclass(frozen=True)
class OptionInfo:
    """The meaning and SI unit of an option. `is_path` marks a file path relative to the configuration."""

    description: str = ""
    unit: str = ""
    is_path: bool = False


@dataclass(frozen=True, eq=False)
class RegistryChoice:
    """An annotation: a setting chooses a class of `registry` by its key `selector_key` or by its key in a mapping."""

    registry: Registry[Any]
    default_name: str = ""
    selector_key: str = "name"  # if it is not "name", it is a field of every class


@dataclass(frozen=True)
class Option:
    """An option: annotated type, default (`MISSING` if the setting is required) and name of its dataclass field."""

    type_hint: Any
    default_value: Any
    field_name: str = ""


@functools.cache
def class_options_by_key(kind: type) -> Mapping[str, Option]:
    """Return the options of a dataclass by key. A key is the name of an `OptionInfo` field without a trailing `_`."""
    hints = get_type_hints(kind, include_extras=True)
    found = {}
    for entry in dataclasses.fields(kind):
        hint = hints[entry.name]
        if any(isinstance(marker, OptionInfo) for marker in split_annotated(hint)[1]):
            default = entry.default if entry.default_factory is MISSING else entry.default_factory()
            found[entry.name.removesuffix("_")] = Option(hint, default, entry.name)
    return found


def split_annotated(hint: Any) -> tuple[Any, list[Any]]:
    """Split a type into the bare type and the list of its `Annotated` metadata, such as bounds and `OptionInfo`."""
    markers: list[Any] = []
    while get_origin(hint) is Annotated:
        markers += hint.__metadata__
        hint = get_args(hint)[0]
    return hint, markers


def non_none_union_members(hint: Any) -> tuple[Any, ...]:
    """Return the member types of a union, without None. For another type, return the type itself."""
    bare, _ = split_annotated(hint)
    if get_origin(bare) in (Union, types.UnionType):
        return tuple(member for member in get_args(bare) if member is not type(None))
    return (bare,)


def mapping_value_type(hint: Any) -> Any:
    """Return the value type of a mapping type such as `Mapping[str, float]`, or None for other types."""
    found = (split_annotated(member)[0] for member in non_none_union_members(hint))
    return next((get_args(bare)[1] for bare in found if get_origin(bare) in (Mapping, dict)), None)


def variadic_tuple_entry_type(hint: Any) -> Any:
    """Return the entry type of a tuple type of any length, such as `tuple[float, ...]`, or None for other types."""
    bare, _ = split_annotated(hint)
    arguments = get_args(bare)
    return arguments[0] if get_origin(bare) is tuple and arguments[-1] is Ellipsis else None


def literal_choices(hint: Any) -> list[str]:
    """Return the words that a type allows, if it is a `Literal` or a union with one."""
    return [str(word) for own in non_none_union_members(hint) if get_origin(own) is Literal for word in get_args(own)]


def describe_type(hint: Any) -> str:
    """Describe a type, its range and its unit in words for messages, such as "a number above 0 up to 0.1 [s]"."""
    bare, markers = split_annotated(hint)
    unit = next((marker.unit for marker in markers if isinstance(marker, OptionInfo) and marker.unit), "")
    first, *others = dict.fromkeys(map(_words, non_none_union_members(bare)))
    limits = [f" {word} {limit:g}" for limit, _, word in _bounds(markers)]
    least = [f", {marker.min_length} at least" for marker in markers if isinstance(marker, annotated_types.Len)]
    return " or ".join(["".join([first, *limits, *least, f" [{unit}]" * bool(unit)]), *others])


def _words(hint: Any) -> str:
    bare, markers = split_annotated(hint)
    if markers:
        return describe_type(hint)
    if bare in _TYPE_WORDS:
        return _TYPE_WORDS[bare]
    arguments = get_args(bare)
    if get_origin(bare) is Literal:
        return ", ".join(map(str, arguments))
    if get_origin(bare) is tuple:
        count = "" if arguments[-1] is Ellipsis else f" of {len(arguments)}"
        words = f"a list{count}, each {_words(arguments[0])}"
        return words.replace(", each a section", " of sections", 1).replace(", each text", " of text", 1)
    if mapping_value_type(bare) is not None:
        choices = [own for own in split_annotated(mapping_value_type(bare))[1] if isinstance(own, RegistryChoice)]
        if names := [name for own in choices for name in own.registry]:
            return f"a section, such as {{{names[0]}: {{}}}}, with names among {', '.join(names)}"
        entry = mapping_value_type(bare)
        if isinstance(entry, type) and dataclasses.is_dataclass(entry):
            return f"a section, such as {{NAME: {_section_example(entry, True)}}}"
        return f"a section, such as {{NAME: VALUE}}, with {_words(entry)} as VALUE"
    is_section = isinstance(bare, type) and dataclasses.is_dataclass(bare)
    example = _section_example(bare) if is_section else ""
    return "a section" + f", such as {example}" * bool(example)


def _section_example(kind: type, shows_a_key: bool = False) -> str:
    """Write a section with its required keys. `shows_a_key`: with its first key, if it requires none."""
    options = class_options_by_key(kind)
    shown = [f"{key}: {key.upper()}" for key, option in options.items() if option.default_value is MISSING]
    if shows_a_key and not shown:
        shown = [f"{next(iter(options))}: VALUE"]
    return f"{{{', '.join(shown)}}}" if shown else ""


def check_option_bounds(options: Any, where: str) -> None:
    """Raise `ConfigError` if a number in an options dataclass is outside its annotated bounds. `where` is its place."""
    kind: Any = type(options)
    for name, option in class_options_by_key(kind).items():
        value = getattr(options, option.field_name)
        if not _within(option.type_hint, value):
            what, allowed = f"{name} is {value}, which is out of range", describe_type(option.type_hint)
            raise ConfigError(what, where=where, allowed=allowed, hint=default_value_hint(name, option))


def default_value_hint(key: str, option: Option) -> str:
    """Return the advice to set an option to an allowed value, or to its default if it has one."""
    default, about = option.default_value, split_annotated(option.type_hint)[1]
    said = f"write an allowed value for {key}"
    if isinstance(default, (int, float, str)) or (default and isinstance(default, tuple)):
        shown = default if isinstance(default, str) else json.dumps(default).replace("Infinity", ".inf")
        said = f"write {key}: {shown} (the default), or another allowed value"
    return said + "".join(f". Its meaning: {own.description}" for own in about if isinstance(own, OptionInfo))


def _within(hint: Any, value: Any) -> bool:
    """Return whether every number of a value is within the bounds of its type. A value without numbers gives True."""
    if isinstance(value, tuple):
        entries = variadic_tuple_entry_type(hint)
        return entries is None or all(_within(entries, entry) for entry in value)
    if not isinstance(value, (int, float)):
        return True
    markers = [marker for part in (hint, *non_none_union_members(hint)) for marker in split_annotated(part)[1]]
    return all(is_within(value, limit) for limit, is_within, _ in _bounds(markers))


def _bounds(markers: Iterable[Any]) -> list[tuple[float, Callable[[Any, Any], bool], str]]:
    """Return limit, comparison and word of each bound among the markers of a type."""
    pairs = [(marker, row) for marker in markers for row in _BOUND_MARKERS if isinstance(marker, row[0])]
    return [(getattr(marker, name), compare, word) for marker, (_, name, compare, word) in pairs]
