"""JSON Schema of configuration files, for editors that complete and check while typing."""

from __future__ import annotations

import math
from dataclasses import MISSING
from typing import Any

from pydantic import TypeAdapter

from yid_ocp.config.keys import Sections, sections_of
from yid_ocp.config.settings import Run
from yid_ocp.options import About, entries_of, options_of, stripped, values_of


def schema() -> dict[str, Any]:
    """JSON Schema of a configuration file."""
    head = {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "yid-ocp configuration"}
    return head | _of(Run)


def _of(hint: Any) -> dict[str, Any]:
    about = next((marker for marker in stripped(hint)[1] if isinstance(marker, About)), None)
    text = "" if about is None else about.text + (f" [{about.unit}]" if about.unit else "")
    return _bare(hint) | ({"description": text} if text else {})


def _bare(hint: Any) -> dict[str, Any]:
    sections, entries, values = sections_of(hint), entries_of(hint), values_of(hint)
    if sections is not None:
        parts = [_section(sections, word) for word in sections.classes]
        parts += [{"type": "null"}] if sections.nullable else []
        return parts[0] if len(parts) == 1 else {"anyOf": parts}
    if entries is not None and sections_of(entries) is not None:
        return {"type": "array", "items": _of(entries)}
    inner = sections_of(values)
    if inner is not None and inner.key == "name":
        named = {name: _section(inner.of(name, ""), "") for name in inner.classes}
        return {"type": "object", "properties": named, "additionalProperties": False}
    if inner is not None:
        return {"type": "object", "additionalProperties": _of(values)}
    return TypeAdapter(hint).json_schema()


def _section(sections: Sections, word: str) -> dict[str, Any]:
    kind = sections.classes[word]
    properties: dict[str, Any] = {}
    required = []
    if sections.key == "name":
        properties["name"] = {"const": word, "description": f"the {sections.noun}"}
    for name, option in options_of(kind).items():
        properties[name] = _of(option.hint)
        default = option.default
        if default is MISSING:
            required.append(name)
        elif isinstance(default, (bool, int, str)) or (isinstance(default, float) and math.isfinite(default)):
            properties[name]["default"] = default
    if sections.key and word != sections.default:
        required.append(sections.key)
    result: dict[str, Any] = {"type": "object", "properties": properties, "additionalProperties": False}
    if kind.__doc__:
        result["description"] = kind.__doc__.splitlines()[0]
    return result | ({"required": required} if required else {})
