"""Building blocks of a command's summary (statements, tables, code), shared by terminal and HTML report."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

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
