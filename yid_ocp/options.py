"""Annotations of options (dataclass fields that users may set), from which keys, descriptions and checks follow.

An option is a field of a frozen dataclass, annotated with its bounds and with `About`:

    time_step: Annotated[float, Gt(0), Le(0.1), About("of the integrator", "s")] = 0.01

Reader, `--set`, checks and JSON Schema follow from it. A field without `About` is set by code alone.
"""

from __future__ import annotations

import dataclasses
import functools
import operator
import types
from collections.abc import Mapping
from dataclasses import MISSING, dataclass
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import annotated_types

from yid_ocp.errors import ConfigError
from yid_ocp.registry import Registry

BOUNDS = (
    (annotated_types.Gt, "gt", operator.gt, "above"),
    (annotated_types.Ge, "ge", operator.ge, "from"),
    (annotated_types.Lt, "lt", operator.lt, "below"),
    (annotated_types.Le, "le", operator.le, "up to"),
)
WORDS = {float: "a number", int: "a whole number", bool: "true or false", str: "text", Any: "anything"}


@dataclass(frozen=True)
class About:
    """Annotation of an option: its meaning and unit.

    Attributes
    ----------
    text : str
    unit : str
        SI, empty for text and pure numbers.
    path : bool
        Whether the text names a file, relative to the configuration; `package:NAME` and `default:NAME` are kept.
    """

    text: str = ""
    unit: str = ""
    path: bool = False


@dataclass(frozen=True)
class Among:
    """Annotation of a type: the user chooses a class of a registry by the key `name`, or by a mapping's key.

    Attributes
    ----------
    registry : Registry
    default : str
        Chosen where there is no `name`.
    """

    registry: Registry[Any]
    default: str = ""


@dataclass(frozen=True)
class Option:
    """An option's annotated type, default (`MISSING` where there is none) and dataclass field name."""

    hint: Any
    default: Any
    field: str = ""


@functools.cache
def options_of(kind: type) -> Mapping[str, Option]:
    """Options of a dataclass by key, which is the field's name without a trailing `_`."""
    hints = get_type_hints(kind, include_extras=True)
    return {
        entry.name.removesuffix("_"): Option(
            hints[entry.name],
            entry.default if entry.default_factory is MISSING else entry.default_factory(),
            entry.name,
        )
        for entry in dataclasses.fields(kind)
        if any(isinstance(marker, About) for marker in stripped(hints[entry.name])[1])
    }


def stripped(hint: Any) -> tuple[Any, list[Any]]:
    """A type without its `Annotated` metadata, and the metadata."""
    markers: list[Any] = []
    while get_origin(hint) is Annotated:
        markers += hint.__metadata__
        hint = get_args(hint)[0]
    return hint, markers


def members(hint: Any) -> tuple[Any, ...]:
    """Member types of a union, without None; the type itself where it is not a union."""
    bare, _ = stripped(hint)
    if get_origin(bare) in (Union, types.UnionType):
        return tuple(member for member in get_args(bare) if member is not type(None))
    return (bare,)


def values_of(hint: Any) -> Any:
    """Value type of a mapping; None for other types."""
    found = (stripped(member)[0] for member in members(hint))
    return next((get_args(bare)[1] for bare in found if get_origin(bare) in (Mapping, dict)), None)


def entries_of(hint: Any) -> Any:
    """Entry type of a tuple of any length; None for other types."""
    bare, _ = stripped(hint)
    arguments = get_args(bare)
    return arguments[0] if get_origin(bare) is tuple and arguments[-1] is Ellipsis else None


def words(hint: Any) -> str:
    """Description of a type with its range and unit, for messages."""
    bare, markers = stripped(hint)
    unit = next((marker.unit for marker in markers if isinstance(marker, About) and marker.unit), "")
    limits = [
        f"{word} {getattr(marker, name):g}"
        for marker in markers
        for kind, name, _, word in BOUNDS
        if isinstance(marker, kind)
    ]
    text = " or ".join(dict.fromkeys(map(_words, members(bare))))
    least = [f", {marker.min_length} at least" for marker in markers if isinstance(marker, annotated_types.Len)]
    return " ".join([text, *limits]) + "".join(least) + (f" [{unit}]" if unit else "")


def _words(hint: Any) -> str:
    bare, markers = stripped(hint)
    if markers:
        return words(hint)
    if bare in WORDS:
        return WORDS[bare]
    arguments = get_args(bare)
    if get_origin(bare) is Literal:
        return ", ".join(map(str, arguments))
    if get_origin(bare) is tuple:
        count = "" if arguments[-1] is Ellipsis else f" of {len(arguments)}"
        return f"a list{count}, each {_words(arguments[0])}"
    if values_of(bare) is not None:
        return f"names, each with {_words(values_of(bare))}"
    return "a section"


def check(options: Any, where: str) -> None:
    """Check that all numbers of an options object are within their bounds.

    Raises
    ------
    ConfigError
    """
    kind: Any = type(options)
    for name, option in options_of(kind).items():
        value = getattr(options, option.field)
        if not _within(option.hint, value):
            raise ConfigError(f"{name} = {value}", where=where, allowed=words(option.hint))


def _within(hint: Any, value: Any) -> bool:
    """Whether every number of a value is within the bounds of its type; True for other values."""
    if isinstance(value, tuple):
        entries = entries_of(hint)
        return entries is None or all(_within(entries, entry) for entry in value)
    if not isinstance(value, (int, float)):
        return True
    markers = [marker for part in (hint, *members(hint)) for marker in stripped(part)[1]]
    return all(
        compare(value, getattr(marker, name))
        for marker in markers
        for kind, name, compare, _ in BOUNDS
        if isinstance(marker, kind)
    )
