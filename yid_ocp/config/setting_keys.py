"""Allowed keys of each configuration section, derived from the settings classes; for reader, `--set` and schema."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal, get_args

from yid_ocp.errors import ConfigError, unknown_name_details
from yid_ocp.options import (
    Option,
    RegistryChoice,
    dataclass_options,
    mapping_value_type,
    sequence_entry_type,
    split_annotated,
    union_members,
)


@dataclass(frozen=True)
class SectionVariants:
    """Alternative settings classes of one configuration section, and the key that selects one.

    Attributes
    ----------
    classes : mapping of str to type
        By the word that chooses one; a single one under the empty word.
    selector_key : str
        Which key holds the word, empty where there is no choice.
    default_variant : str
        The word where the key is absent, empty where it must be given.
    variant_noun : str
        What the classes are.
    is_nullable : bool
        Whether there may be none.
    """

    classes: Mapping[str, type]
    selector_key: str = ""
    default_variant: str = ""
    variant_noun: str = ""
    is_nullable: bool = False

    def selected_variant(self, raw: Any) -> Any:
        """Value of the selector key in a raw section; the default where the key is absent."""
        return (
            raw.get(self.selector_key, self.default_variant)
            if self.selector_key and isinstance(raw, dict)
            else self.default_variant
        )

    def variant_options(self, word: Any = "") -> Mapping[str, Option]:
        """Options by key of the selected class; of the first class where the value selects none."""
        known = isinstance(word, str) and word in self.classes
        options = dataclass_options(self.classes[word] if known else next(iter(self.classes.values())))
        if self.selector_key in ("", *options):
            return options
        return {self.selector_key: Option(Literal[tuple(self.classes)], self.default_variant), **options}

    def for_name(self, name: str, where: str) -> SectionVariants:
        """Classes allowed under one name of a mapping: the registered class of that name, or all."""
        if self.selector_key != "name":
            return self
        if name not in self.classes:
            raise self.unknown_variant_error(name, where)
        return SectionVariants({"": self.classes[name]})

    def unknown_variant_error(self, word: object, where: str) -> ConfigError:
        """The error for a missing or unknown value of the selector key."""
        if not word:
            return ConfigError(
                f"the key '{self.selector_key}' is missing", where=where, allowed=", ".join(self.classes)
            )
        return ConfigError(
            f"there is no {self.variant_noun} '{word}'", where=where, **unknown_name_details(str(word), self.classes)
        )


def section_variants(hint: Any) -> SectionVariants | None:
    """Alternative settings classes that a type annotation allows; None for other types."""
    bare, markers = split_annotated(hint)
    nullable = type(None) in get_args(bare)
    among = next((marker for marker in markers if isinstance(marker, RegistryChoice)), None)
    if among is not None:
        classes = {name: among.registry[name] for name in among.registry}
        noun = among.registry.entry_noun
        return SectionVariants(classes, among.selector_key, among.default_name, noun, nullable)
    kinds = [split_annotated(member)[0] for member in union_members(bare)]
    if not kinds or not all(map(dataclasses.is_dataclass, kinds)):
        return None
    return SectionVariants({"": kinds[0]}, is_nullable=nullable) if len(kinds) == 1 else None


def unknown_key_error(root: type, name: str, known: Iterable[str], where: str, within: str = "") -> ConfigError:
    """The error for an unknown key, with the nearest allowed key and the sections that have this key."""
    said = unknown_name_details(name, known)
    homes = list(dict.fromkeys(_sections_with_key(root, name)))
    hints = [said["hint"]] if said["hint"] else []
    hints += [f"'{name}' is a key of {', '.join(homes[:3])}"] if homes else []
    hints.append("names changed in this version: see the table in CHANGELOG.md")
    if ":" in name:
        hints = ["put a space behind the colon, as in {" + name.replace(":", ": ") + "}"]
    return ConfigError(
        f"there is no key '{name}'" + (f" in {within}" if within else ""),
        where=where,
        allowed=said["allowed"],
        hint="; ".join(hints),
    )


def iter_settable_keys(hint: Any, prefix: str, raw: Any, at: str = "") -> Iterator[str]:
    """Yield completions of a dotted key prefix, up to the next dot or to `=` where a value follows.

    Parameters
    ----------
    hint : Any
        Type of what stands at `at`.
    raw : Any
        What a file says there: its names count where users choose them.
    at : str
        The keys before, each with its dot.
    """
    sections, values = section_variants(hint), mapping_value_type(hint)
    named = section_variants(values)
    below: dict[str, Any] = {}
    if sections is not None:
        below = {
            name: option.type_hint for name, option in sections.variant_options(sections.selected_variant(raw)).items()
        }
    elif named is not None and named.selector_key == "name":
        below = dict(named.classes)
    elif values is not None and isinstance(raw, dict):
        below = dict.fromkeys(raw, values)
    for name, inner in below.items():
        path = f"{at}{name}"
        if prefix.startswith(f"{path}."):
            yield from iter_settable_keys(inner, prefix, raw.get(name) if isinstance(raw, dict) else None, f"{path}.")
        elif path.startswith(prefix):
            yield path + ("=" if section_variants(inner) is None and mapping_value_type(inner) is None else ".")


def _sections_with_key(hint: Any, name: str, at: str = "") -> Iterator[str]:
    """Yield descriptions of the sections that have a key; NAME represents a user-chosen name."""
    for inner, step in ((mapping_value_type(hint), ".NAME"), (sequence_entry_type(hint), "")):
        if inner is not None:
            yield from _sections_with_key(inner, name, at + step)
    sections = section_variants(hint)
    if sections is None:
        return
    having = [word for word, kind in sections.classes.items() if name in dataclass_options(kind)]
    if having:
        choice = "" if len(having) == len(sections.classes) else f" with {sections.selector_key}: {', '.join(having)}"
        yield (f"`{at}`" if at else "the file itself") + choice
    for kind in sections.classes.values():
        for key, option in dataclass_options(kind).items():
            yield from _sections_with_key(option.type_hint, name, f"{at}.{key}" if at else key)
