"""Terminal output: summary blocks and file contents as lines of text."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence

from yid_ocp.data import Recording
from yid_ocp.data.readers import Contents
from yid_ocp.report.blocks import Block, Command, Rows, Table

PROSE, NOTE, LONGEST = 100, 118, 200
"""Widths to which sentences and notes are wrapped, and characters of a note that is left in one line."""


def lines(blocks: Sequence[Block]) -> list[str]:
    """Text lines of summary blocks: aligned tables, wrapped sentences and notes."""
    result: list[str] = []
    for block in blocks:
        if isinstance(block, Table):
            if block.long:
                continue
            result += ["", *table(block.rows), ""] if result and result[-1] else [*table(block.rows), ""]
        elif isinstance(block, Command):
            result += [f"  {line}" for line in block.text.splitlines()]
        elif block.text.endswith("."):
            result += textwrap.wrap(block.text, PROSE)
        elif len(block.text) > LONGEST:
            result += textwrap.wrap(block.text, NOTE, subsequent_indent="  ")
        else:
            result.append(block.text)
    return result[:-1] if result and not result[-1] else result


def recording_summary(recording: Recording) -> list[str]:
    """Text lines on the contents of a recording."""
    rows: Rows = [("group", "samples", "names")]
    for group in recording.groups:
        rows.append((getattr(group, "name", "joints"), str(len(group.t)), ", ".join(group.names)))
    notes = ["", *(f"note: {note}" for note in recording.notes)] if recording.notes else []
    return [*table(rows), "", f"{recording.duration:g} s", *notes]


def contents_summary(contents: Contents) -> list[str]:
    """Text lines on the contents of a file of another tool."""
    rows: Rows = [("source", "type", "count", "Hz", "becomes", "note")]
    for source in contents.sources:
        rate = f"{source.rate:.4g}" if math.isfinite(source.rate) else ""
        rows.append((source.name, source.kind, str(source.count), rate, source.becomes or "-", source.note))
    return [*table(rows), *(["", *(f"note: {note}" for note in contents.notes)] if contents.notes else [])]


def table(rows: Rows) -> list[str]:
    """Rows as aligned lines, the first one as head; columns without an entry are left out."""
    kept = [i for i in range(len(rows[0])) if any(row[i] for row in rows)]
    widths = [max(len(row[i]) for row in rows) for i in kept]
    told = ["  ".join(row[i].ljust(width) for i, width in zip(kept, widths, strict=True)).rstrip() for row in rows]
    return [told[0], "  ".join("-" * width for width in widths), *told[1:]]
