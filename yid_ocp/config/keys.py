"""Allowed keys of each configuration section, derived from the settings classes; for reader, `--set` and schema."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal, get_args

from yid_ocp.errors import ConfigError, choices
from yid_ocp.options import Among, Option, entries_of, members, options_of, stripped, values_of


@dataclass(frozen=True)
class Sections:
    """Alternative settings classes of one configuration section, and the key that selects one.

    Attributes
    ----------
    classes : mapping of str to type
        By the word that chooses one; a single one under the empty word.
    key : str
        Which key holds the word, empty where there is no choice.
    default : str
        The word where the key is absent, empty where it must be given.
    noun : str
        What the classes are.
    nullable : bool
        Whether there may be none.
    """

    classes: Mapping[str, type]
    key: str = ""
    default: str = ""
    noun: str = ""
    nullable: bool = False

    def word(self, raw: Any) -> Any:
        """Value of the selector key in a raw section; the default where the key is absent."""
        return raw.get(self.key, self.default) if self.key and isinstance(raw, dict) else self.default

    def keys(self, word: Any = "") -> Mapping[str, Option]:
        """Options by key of the selected class; of the first class where the value selects none."""
        known = isinstance(word, str) and word in self.classes
        options = options_of(self.classes[word] if known else next(iter(self.classes.values())))
        if self.key in ("", *options):
            return options
        return {self.key: Option(Literal[tuple(self.classes)], self.default), **options}

    def of(self, name: str, where: str) -> Sections:
        """Classes allowed under one name of a mapping: the registered class of that name, or all."""
        if self.key != "name":
            return self
        if name not in self.classes:
            raise self.unknown(name, where)
        return Sections({"": self.classes[name]})

    def unknown(self, word: object, where: str) -> ConfigError:
        """The error for a missing or unknown value of the selector key."""
        if not word:
            return ConfigError(f"the key '{self.key}' is missing", where=where, allowed=", ".join(self.classes))
        return ConfigError(f"there is no {self.noun} '{word}'", where=where, **choices(str(word), self.classes))


def sections_of(hint: Any) -> Sections | None:
    """Alternative settings classes that a type annotation allows; None for other types."""
    bare, markers = stripped(hint)
    nullable = type(None) in get_args(bare)
    among = next((marker for marker in markers if isinstance(marker, Among)), None)
    if among is not None:
        classes = {name: among.registry[name] for name in among.registry}
        return Sections(classes, "name", among.default, among.registry.noun, nullable)
    kinds = [stripped(member)[0] for member in members(bare)]
    if not kinds or not all(map(dataclasses.is_dataclass, kinds)):
        return None
    if len(kinds) == 1:
        return Sections({"": kinds[0]}, nullable=nullable)
    return Sections({options_of(kind)["kind"].default: kind for kind in kinds}, "kind", "", "kind", nullable)


def unknown_key(root: type, name: str, known: Iterable[str], where: str, within: str = "") -> ConfigError:
    """The error for an unknown key, with the nearest allowed key and the sections that have this key."""
    said = choices(name, known)
    homes = list(dict.fromkeys(homes_of(root, name)))
    hints = [said["hint"]] if said["hint"] else []
    hints += [f"'{name}' is a key of {', '.join(homes[:3])}"] if homes else []
    if ":" in name:
        hints = ["put a space behind the colon, as in {" + name.replace(":", ": ") + "}"]
    return ConfigError(
        f"there is no key '{name}'" + (f" in {within}" if within else ""),
        where=where,
        allowed=said["allowed"],
        hint="; ".join(hints),
    )


def settable(hint: Any, prefix: str, raw: Any, at: str = "") -> Iterator[str]:
    """Yield completions of a dotted key prefix, up to the next dot or to `=` where a value follows.

    Parameters
    ----------
    hint : Any
        Type of what stands at `at`.
    prefix : str
    raw : Any
        What a file says there: its names count where users choose them.
    at : str
        The keys before, each with its dot.
    """
    sections, values = sections_of(hint), values_of(hint)
    named = sections_of(values)
    below: dict[str, Any] = {}
    if sections is not None:
        below = {name: option.hint for name, option in sections.keys(sections.word(raw)).items()}
    elif named is not None and named.key == "name":
        below = dict(named.classes)
    elif values is not None and isinstance(raw, dict):
        below = dict.fromkeys(raw, values)
    for name, inner in below.items():
        path = f"{at}{name}"
        if prefix.startswith(f"{path}."):
            yield from settable(inner, prefix, raw.get(name) if isinstance(raw, dict) else None, f"{path}.")
        elif path.startswith(prefix):
            yield path + ("=" if sections_of(inner) is None and values_of(inner) is None else ".")


def homes_of(hint: Any, name: str, at: str = "") -> Iterator[str]:
    """Yield descriptions of the sections that have a key; NAME represents a user-chosen name."""
    for inner, step in ((values_of(hint), ".NAME"), (entries_of(hint), "")):
        if inner is not None:
            yield from homes_of(inner, name, at + step)
    sections = sections_of(hint)
    if sections is None:
        return
    having = [word for word, kind in sections.classes.items() if name in options_of(kind)]
    if having:
        choice = "" if len(having) == len(sections.classes) else f" with {sections.key}: {', '.join(having)}"
        yield (f"`{at}`" if at else "the file itself") + choice
    for kind in sections.classes.values():
        for key, option in options_of(kind).items():
            yield from homes_of(option.hint, name, f"{at}.{key}" if at else key)
