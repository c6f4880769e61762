"""Building blocks of a command's summary (statements, tables, code), shared by terminal and HTML report."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

Rows = list[Sequence[str]]
Weight = Literal["note", "verdict", "conclusion"]


@dataclass(frozen=True)
class Statement:
    """One sentence of a summary, with its importance.

    Attributes
    ----------
    text : str
    weight : "note", "verdict" or "conclusion"
        Verdicts are what the command was asked for, a conclusion is what they come to: a page begins with conclusions,
        then has the verdicts.
    """

    text: str
    weight: Weight = "note"


@dataclass(frozen=True)
class Table:
    """A table of text cells whose first row is the header; empty columns are not shown.

    Attributes
    ----------
    rows : list of sequence of str
    title : str
        Stands above it on a page.
    key : bool
        Whether it stands beside the verdict on a page.
    long : bool
        Whether it is for pages alone.
    links : mapping of str to str
        Pages that cells of the first column lead to.
    """

    rows: Rows
    title: str = ""
    key: bool = False
    long: bool = False
    links: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Command:
    """Preformatted lines, such as a shell command to copy."""

    text: str


Block = Statement | Table | Command


def statements(texts: Iterable[str], weight: Weight = "note") -> list[Block]:
    """Statements made from all non-empty texts."""
    return [Statement(text, weight) for text in texts if text]


def filled(*tables: Table) -> list[Block]:
    """The tables that have at least one row below the header."""
    return [table for table in tables if len(table.rows) > 1]
