"""Documentation of the configuration: a JSON Schema for editors and Markdown tables."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import MISSING
from typing import Any

from pydantic import TypeAdapter

from yid_ocp.config.setting_keys import SectionVariants, section_variants
from yid_ocp.config.settings import RunSettings
from yid_ocp.config.settings_examples import SETTINGS_EXAMPLES
from yid_ocp.options import (
    Option,
    OptionInfo,
    dataclass_options,
    describe_type,
    mapping_value_type,
    sequence_entry_type,
    split_annotated,
)

_PAGE_HEAD = """\
# Settings

Every key of a configuration file. NAME stands for a name of yours or of the model. Units are SI and stand in brackets;
`needed` keys have no default, and where none is shown it is nothing at all (`null`). Any key may be set on the command
line as well, `--set problem.time_step=0.005`; a section merges with what stands there, key by key, and an empty one
empties it. How to choose links, time step and split: [choosing.md](choosing.md); recordings and their units:
[recordings.md](recordings.md). This page is made from the code; CONTRIBUTING.md has the command.
"""


def config_json_schema() -> dict[str, Any]:
    """JSON Schema of a configuration file, as plain data."""
    head = {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "yid-ocp configuration"}
    return head | _of(RunSettings)


def _of(hint: Any) -> dict[str, Any]:
    about = _about(hint)
    text = about.description + (f" [{about.unit}]" if about.unit else "")
    return _bare(hint) | ({"description": text} if text else {})


def _bare(hint: Any) -> dict[str, Any]:
    sections, entries, values = section_variants(hint), sequence_entry_type(hint), mapping_value_type(hint)
    if sections is not None:
        parts = [_section(sections, word) for word in sections.classes]
        parts += [{"type": "null"}] if sections.is_nullable else []
        return parts[0] if len(parts) == 1 else {"anyOf": parts}
    if entries is not None and section_variants(entries) is not None:
        return {"type": "array", "items": _of(entries)}
    inner = section_variants(values)
    if inner is not None and inner.selector_key == "name":
        named = {name: _section(inner.for_name(name, ""), "") for name in inner.classes}
        return {"type": "object", "properties": named, "additionalProperties": False}
    if inner is not None:
        return {"type": "object", "additionalProperties": _of(values)}
    return TypeAdapter(hint).json_schema()


def _section(sections: SectionVariants, word: str) -> dict[str, Any]:
    kind = sections.classes[word]
    properties: dict[str, Any] = {}
    required = []
    if sections.selector_key == "name":
        properties["name"] = {"const": word, "description": f"the {sections.variant_noun}"}
    for name, option in dataclass_options(kind).items():
        properties[name] = _of(option.type_hint)
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


def _about(hint: Any) -> OptionInfo:
    """What the outermost marker says."""
    return next(
        (marker for marker in reversed(split_annotated(hint)[1]) if isinstance(marker, OptionInfo)), OptionInfo()
    )


# -- for people -------------------------------------------------------------------------------------------------------


def settings_markdown() -> str:
    """Markdown page of all settings with meaning, allowed values and default."""
    lines = _PAGE_HEAD.splitlines()
    tables = {title: (text, rows) for title, text, rows in _tables(RunSettings, "")}
    for title, (text, rows) in tables.items():
        lines += ["", f"## {title}", "", text, "", "| key | meaning | allowed | default |", "|---|---|---|---|", *rows]
        lines += ["", "```yaml", *SETTINGS_EXAMPLES.get(title, "").splitlines(), "```"]
    return "\n".join(lines) + "\n"


def _tables(hint: Any, path: str) -> Iterator[tuple[str, str, list[str]]]:
    """Title, first sentence and rows of a section and of all below it."""
    sections = section_variants(hint)
    for word, kind in sections.classes.items() if sections is not None else ():
        options = dataclass_options(kind)
        title = (
            f"{path}, {sections.selector_key}: {word}"
            if sections is not None and sections.selector_key
            else path or "The file"
        )
        yield title, (kind.__doc__ or "").splitlines()[0], [_row(*item) for item in options.items()]
        for name, option in options.items():
            yield from _tables(option.type_hint, f"{path}.{name}" if path else name)
    values, entries = mapping_value_type(hint), sequence_entry_type(hint)
    named = section_variants(values)
    if values is not None and (named is None or named.selector_key != "name"):
        yield from _tables(values, f"{path}.NAME")
    if entries is not None:
        yield from _tables(entries, path)


def _row(name: str, option: Option) -> str:
    default = "needed" if option.default_value is MISSING else _default(option.default_value)
    cells = (f"`{name}`", _about(option.type_hint).description, describe_type(option.type_hint), default)
    return "| " + " | ".join(cells) + " |"


def _default(value: Any) -> str:
    if value is None or value in ({}, "") or dataclasses.is_dataclass(value):
        return ""
    if isinstance(value, Mapping):
        return ", ".join(f"`{name}`" for name in value)
    return "`.inf`" if value == math.inf else f"`{json.dumps(value)}`"
