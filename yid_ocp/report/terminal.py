"""Summary blocks (statements, tables, code) and their lines on a terminal."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from yid_ocp.data import Recording
from yid_ocp.data.readers import FileContents

TableRows = list[Sequence[str]]
_StatementKind = Literal["note", "verdict", "conclusion"]


@dataclass(frozen=True)
class SummaryStatement:
    """One sentence of a summary, with its importance.

    Attributes
    ----------
    kind : "note", "verdict" or "conclusion"
        Verdicts are what the command was asked for, a conclusion is what they come to: a page begins with conclusions,
        then has the verdicts.
    """

    text: str
    kind: _StatementKind = "note"


@dataclass(frozen=True)
class SummaryTable:
    """A table of text cells whose first row is the header; empty columns are not shown.

    Attributes
    ----------
    title : str
        Stands above it on a page.
    is_key_table : bool
        Whether it stands beside the verdict on a page.
    is_page_only : bool
        Whether it is for pages alone.
    links : mapping of str to str
        Pages that cells of the first column lead to.
    """

    rows: TableRows
    title: str = ""
    is_key_table: bool = False
    is_page_only: bool = False
    links: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class CodeBlock:
    """Preformatted lines, such as a shell command to copy."""

    text: str


SummaryBlock = SummaryStatement | SummaryTable | CodeBlock


def make_statements(texts: Iterable[str], weight: _StatementKind = "note") -> list[SummaryBlock]:
    """Statements made from all non-empty texts."""
    return [SummaryStatement(text, weight) for text in texts if text]


def nonempty_tables(*tables: SummaryTable) -> list[SummaryBlock]:
    """The tables that have at least one row below the header."""
    return [table for table in tables if len(table.rows) > 1]


_PROSE_WIDTH, _NOTE_WIDTH, _MAX_UNWRAPPED_NOTE = 100, 118, 200
"""Widths to which sentences and notes are wrapped, and characters of a note that is left in one line."""


def terminal_lines(blocks: Sequence[SummaryBlock]) -> list[str]:
    """Text lines of summary blocks: aligned tables, wrapped sentences and notes."""
    result: list[str] = []
    for block in blocks:
        if isinstance(block, SummaryTable):
            if block.is_page_only:
                continue
            result += (
                ["", *aligned_table_lines(block.rows), ""]
                if result and result[-1]
                else [*aligned_table_lines(block.rows), ""]
            )
        elif isinstance(block, CodeBlock):
            result += [f"  {line}" for line in block.text.splitlines()]
        elif block.text.endswith("."):
            result += textwrap.wrap(block.text, _PROSE_WIDTH)
        elif len(block.text) > _MAX_UNWRAPPED_NOTE:
            result += textwrap.wrap(block.text, _NOTE_WIDTH, subsequent_indent="  ")
        else:
            result.append(block.text)
    return result[:-1] if result and not result[-1] else result


def recording_summary_lines(recording: Recording) -> list[str]:
    """Text lines on the contents of a recording."""
    rows: TableRows = [("group", "samples", "names")]
    for group in recording.groups:
        rows.append((getattr(group, "name", "joints"), str(len(group.t)), ", ".join(group.names)))
    notes = ["", *(f"note: {note}" for note in recording.notes)] if recording.notes else []
    return [*aligned_table_lines(rows), "", f"{recording.duration:g} s", *notes]


def file_contents_lines(contents: FileContents) -> list[str]:
    """Text lines on the contents of a file of another tool."""
    rows: TableRows = [("source", "type", "count", "Hz", "becomes", "note")]
    for source in contents.sources:
        rate = f"{source.mean_rate:.4g}" if math.isfinite(source.mean_rate) else ""
        rows.append((source.name, source.kind, str(source.n_samples), rate, source.imported_as or "-", source.note))
    return [
        *aligned_table_lines(rows),
        *(["", *(f"note: {note}" for note in contents.notes)] if contents.notes else []),
    ]


def aligned_table_lines(rows: TableRows) -> list[str]:
    """Rows as aligned lines, the first one as head; columns without an entry are left out."""
    kept = [i for i in range(len(rows[0])) if any(row[i] for row in rows)]
    widths = [max(len(row[i]) for row in rows) for i in kept]
    told = ["  ".join(row[i].ljust(width) for i, width in zip(kept, widths, strict=True)).rstrip() for row in rows]
    return [told[0], "  ".join("-" * width for width in widths), *told[1:]]
