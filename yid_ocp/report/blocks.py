"""What a command has to say, once: statements, tables and commands, for the terminal and the page alike."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

Rows = list[Sequence[str]]


@dataclass(frozen=True)
class Statement:
    """One sentence or note.

    Attributes
    ----------
    text : str
    verdict : bool
        Whether it is what the command was asked for; pages begin with these.
    """

    text: str
    verdict: bool = False


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
    """

    rows: Rows
    title: str = ""
    key: bool = False
    long: bool = False


@dataclass(frozen=True)
class Command:
    """Lines to be typed or pasted."""

    text: str


Block = Statement | Table | Command


def statements(texts: Iterable[str], verdict: bool = False) -> list[Block]:
    """A statement of every text that is not empty."""
    return [Statement(text, verdict) for text in texts if text]


def filled(*tables: Table) -> list[Block]:
    """Those tables that have a row below their head."""
    return [table for table in tables if len(table.rows) > 1]
