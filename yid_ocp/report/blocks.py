"""What a command has to say, once: statements, tables and commands, for the terminal and the page alike."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

Rows = list[Sequence[str]]
Weight = Literal["note", "verdict", "conclusion"]


@dataclass(frozen=True)
class Statement:
    """One sentence or note.

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
    """Rows of equal length, the first one their head; columns without an entry are not shown.

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
    """Lines to be typed or pasted."""

    text: str


Block = Statement | Table | Command


def statements(texts: Iterable[str], weight: Weight = "note") -> list[Block]:
    """A statement of every text that is not empty."""
    return [Statement(text, weight) for text in texts if text]


def filled(*tables: Table) -> list[Block]:
    """Those tables that have a row below their head."""
    return [table for table in tables if len(table.rows) > 1]
