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
_PROSE_WIDTH, _NOTE_WIDTH, _MAX_UNWRAPPED_NOTE = 100, 118, 200
"""Widths to which sentences and notes are wrapped, and characters of a note that is left in one line."""


@dataclass(frozen=True)
class SummaryStatement:
    """One sentence of a summary, with its importance.

    Verdicts are what the command was asked for, a conclusion is what they come to: a page begins with conclusions, then
    has the verdicts.
    """

    text: str
    kind: _StatementKind = "note"


@dataclass(frozen=True)
class SummaryTable:
    """A table of text cells whose first row is the header; empty columns are not shown.

    Attributes
    ----------
    title : str
        For pages.
    is_key_table : bool
        Whether it stands beside the verdict on a page.
    is_page_only : bool
        Whether it is left out on a terminal.
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


def make_statements(texts: Iterable[str], kind: _StatementKind = "note") -> list[SummaryBlock]:
    """Statements made from all non-empty texts."""
    return [SummaryStatement(text, kind) for text in texts if text]


def nonempty_tables(*tables: SummaryTable) -> list[SummaryBlock]:
    """The tables that have at least one row below the header."""
    return [table for table in tables if len(table.rows) > 1]


def terminal_lines(blocks: Sequence[SummaryBlock]) -> list[str]:
    """Text lines of summary blocks: aligned tables, wrapped sentences and notes."""
    result: list[str] = []
    for block in blocks:
        if isinstance(block, SummaryTable):
            if not block.is_page_only:
                space = [""] if result and result[-1] else []
                result += [*space, *aligned_table_lines(block.rows), ""]
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
    return [*aligned_table_lines(rows), "", f"{recording.duration:g} s", *_note_lines(recording.notes)]


def file_contents_lines(contents: FileContents) -> list[str]:
    """Text lines on the contents of a file of another tool."""
    rows: TableRows = [("source", "type", "count", "Hz", "becomes", "note")]
    for source in contents.sources:
        rate = f"{source.mean_rate:.4g}" if math.isfinite(source.mean_rate) else ""
        rows.append((source.name, source.kind, str(source.n_samples), rate, source.imported_as or "-", source.note))
    return [*aligned_table_lines(rows), *_note_lines(contents.notes)]


def _note_lines(notes: Sequence[str]) -> list[str]:
    return ["", *(f"note: {note}" for note in notes)] if notes else []


def aligned_table_lines(rows: TableRows) -> list[str]:
    """Rows as aligned lines, the first one as head; columns without an entry are left out."""
    columns = [column for column in zip(*rows, strict=True) if any(column)]
    widths = [max(map(len, column)) for column in columns]
    lines = ["  ".join(map(str.ljust, row, widths)).rstrip() for row in zip(*columns, strict=True)]
    return [lines[0], "  ".join("-" * width for width in widths), *lines[1:]]
