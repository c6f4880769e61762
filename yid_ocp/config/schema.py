"""Allowed keys of each configuration section, used by the reader, by `--set` and by the JSON Schema."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import MISSING, dataclass
from typing import Any, Literal, get_args

from pydantic import TypeAdapter

from yid_ocp import options
from yid_ocp.config.settings import RunSettings
from yid_ocp.errors import ConfigError, nearest_name_question, unknown_name_error_arguments

RENAMED_NAMES_HINT = "CHANGELOG.md of the project has the new names of older ones"


@dataclass(frozen=True)
class SectionVariants:
    """The alternative settings classes of a configuration section, and the key that selects one of them."""

    classes: Mapping[str, type]  # by value of the selector key; a single class has the empty name
    selector_key: str = ""  # key whose value selects a class; empty if there is one class
    default_variant: str = ""  # value of the selector key if it is absent; empty if it is required
    variant_noun: str = ""  # word for a class in messages, such as "solver"
    is_nullable: bool = False  # whether null is allowed instead of a section

    def read_variant_name(self, raw: Any) -> Any:
        """Return the value of the selector key in the unchecked section `raw`, or `default_variant` if it is absent."""
        given = raw if self.selector_key and isinstance(raw, dict) else {}
        return given.get(self.selector_key, self.default_variant)

    def options_of_variant(self, word: Any = "") -> Mapping[str, options.Option]:
        """Return all options, by key, of the settings class named `word` (default: the first class)."""
        known = isinstance(word, str) and word in self.classes
        own = options.class_options_by_key(self.classes[word] if known else next(iter(self.classes.values())))
        if self.selector_key in ("", *own):
            return own
        return {self.selector_key: options.Option(Literal[tuple(self.classes)], self.default_variant), **own}

    def variants_for_named_entry(self, name: str, where: str) -> SectionVariants:
        """Return the class for the entry `name` of a mapping if names select classes; otherwise return all classes."""
        if self.selector_key != "name":
            return self
        if name not in self.classes:
            raise self.unknown_variant_error(name, where)
        return SectionVariants({"": self.classes[name]})

    def unknown_variant_error(self, word: object, where: str) -> ConfigError:
        """Make the error for a missing or unknown value `word` of the selector key."""
        if not word:
            what = f"the key '{self.selector_key}' is missing"
            hint = f"add {self.selector_key}: {next(iter(self.classes))}"
            return ConfigError(what, where=where, allowed=", ".join(self.classes), hint=hint)
        what, otherwise = f"there is no {self.variant_noun} '{word}'", f"use an allowed name; {RENAMED_NAMES_HINT}"
        return ConfigError(what, where=where, **unknown_name_error_arguments(str(word), self.classes, otherwise))


def section_variants_from_annotation(hint: Any) -> SectionVariants | None:
    """Return the settings classes that the type annotation `hint` allows, or None if it allows no section."""
    bare, markers = options.split_annotated(hint)
    nullable = type(None) in get_args(bare)
    among = next((marker for marker in markers if isinstance(marker, options.RegistryChoice)), None)
    if among is not None:
        noun = among.registry.entry_noun
        return SectionVariants(dict(among.registry), among.selector_key, among.default_name, noun, nullable)
    kinds = [options.split_annotated(member)[0] for member in options.non_none_union_members(bare)]
    if len(kinds) != 1 or not all(map(dataclasses.is_dataclass, kinds)):
        return None
    return SectionVariants({"": kinds[0]}, is_nullable=nullable)


def unknown_key_error(name: str, known: Iterable[str], where: str, within: str = "") -> ConfigError:
    """Make the error for an unknown key `name`. It suggests the nearest `known` key, and sections that have the key."""
    known = list(known)
    homes, near = list(dict.fromkeys(_sections_with_key(RunSettings, name))), nearest_name_question(name, known)
    # a key of an older version often resembles a present one that means something else
    first = near or f"leave '{name}' out;"
    if homes:
        first = f"'{name}' is a key of {' and of '.join(homes[:3])};"
    hint = f"{first} {RENAMED_NAMES_HINT}"
    if name.partition(".")[0] in known and "." in name:
        hint = f"write --set {name}=VALUE, or nested keys in the file, such as parameters: {{NAME: {{free: false}}}}"
    if name.isdigit():
        hint = "if this is a part of a number, write a decimal point: a comma separates keys"
    if ":" in name:
        hint = "put a space after the colon, as in {" + name.replace(":", ": ") + "}"
    what = f"there is no key '{name}'" + (f" in {within}" if within else "")
    allowed = unknown_name_error_arguments(name, known)["allowed"]
    return ConfigError(what, where=where, allowed=allowed, hint=hint)


def _sections_with_key(hint: Any, name: str, at: str = "") -> Iterator[str]:
    """Yield descriptions of the sections that have the key `name`. NAME represents a name that users choose."""
    for inner, step in ((options.mapping_value_type(hint), ".NAME"), (options.variadic_tuple_entry_type(hint), "")):
        if inner is not None:
            yield from _sections_with_key(inner, name, at + step)
    sections = section_variants_from_annotation(hint)
    if sections is None:
        return
    having = [word for word, kind in sections.classes.items() if name in options.class_options_by_key(kind)]
    if having:
        choice = "" if len(having) == len(sections.classes) else f" with {sections.selector_key}: {', '.join(having)}"
        yield (f"`{at}`" if at else "the file itself") + choice
    for kind in sections.classes.values():
        for key, option in options.class_options_by_key(kind).items():
            yield from _sections_with_key(option.type_hint, name, f"{at}.{key}" if at else key)


def config_json_schema() -> dict[str, Any]:
    """Return the JSON Schema of configuration files as plain data."""
    head = {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "yid-ocp configuration"}
    return head | _described_schema(RunSettings)


def _described_schema(hint: Any) -> dict[str, Any]:
    about = option_info_from_annotation(hint)
    text = about.description + (f" [{about.unit}]" if about.unit else "")
    return _type_schema(hint) | ({"description": text} if text else {})


def _type_schema(hint: Any) -> dict[str, Any]:
    sections, entries = section_variants_from_annotation(hint), options.variadic_tuple_entry_type(hint)
    values = options.mapping_value_type(hint)
    if sections is not None:
        parts = [_section_schema(sections, word) for word in sections.classes]
        parts += [{"type": "null"}] if sections.is_nullable else []
        return parts[0] if len(parts) == 1 else {"anyOf": parts}
    if entries is not None and section_variants_from_annotation(entries) is not None:
        return {"type": "array", "items": _described_schema(entries)}
    inner = section_variants_from_annotation(values)
    if inner is not None and inner.selector_key == "name":
        named = {name: _section_schema(inner.variants_for_named_entry(name, ""), "") for name in inner.classes}
        return {"type": "object", "properties": named, "additionalProperties": False}
    if inner is not None:
        return {"type": "object", "additionalProperties": _described_schema(values)}
    return TypeAdapter(hint).json_schema()


def _section_schema(sections: SectionVariants, word: str) -> dict[str, Any]:
    kind = sections.classes[word]
    properties: dict[str, Any] = {}
    required = []
    if sections.selector_key == "name":
        properties["name"] = {"const": word, "description": f"the {sections.variant_noun}"}
    for name, option in options.class_options_by_key(kind).items():
        properties[name] = _described_schema(option.type_hint)
        default = option.default_value
        if default is MISSING:
            required.append(name)
        elif isinstance(default, (bool, int, str)) or (isinstance(default, float) and math.isfinite(default)):
            properties[name]["default"] = default
    if sections.selector_key and word != sections.default_variant:
        required.append(sections.selector_key)
    result: dict[str, Any] = {"type": "object", "properties": properties, "additionalProperties": False}
    if kind.__doc__:
        result["description"] = kind.__doc__.splitlines()[0]
    return result | ({"required": required} if required else {})


def option_info_from_annotation(hint: Any) -> options.OptionInfo:
    """Return the meaning and unit (`OptionInfo`) stated in the type annotation `hint`, or an empty `OptionInfo`."""
    markers = reversed(options.split_annotated(hint)[1])
    return next((marker for marker in markers if isinstance(marker, options.OptionInfo)), options.OptionInfo())
