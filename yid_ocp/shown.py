"""Objects that show themselves: in a line where they are printed, in a notebook with a small table, never as arrays."""

from __future__ import annotations

import html
from collections.abc import Sequence
from dataclasses import dataclass

MOST = 30
"""Rows of a table in a notebook; of more, the rest is counted."""


@dataclass(frozen=True)
class Summary:
    """What an object says of itself.

    Attributes
    ----------
    line : str
        In one line, without the name of its class.
    rows : sequence of sequence of str
        The table of a notebook; its first row is the head.
    """

    line: str
    rows: Sequence[Sequence[str]] = ()


class Shown:
    """An object that is shown by its `_summary`; of a dataclass, whose own text would list all arrays, `repr=False`."""

    def _summary(self) -> Summary:
        raise NotImplementedError

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {self._summary().line}>"

    def _repr_html_(self) -> str:
        """What a notebook shows."""
        said = self._summary()
        text = f"<p><b>{type(self).__name__}</b>: {html.escape(said.line)}</p>"
        if len(said.rows) < 2:
            return text
        head, *rows = said.rows
        lines = [_row(head, "th"), *(_row(row, "td") for row in rows[:MOST])]
        if len(rows) > MOST:
            lines.append(_row([f"and {len(rows) - MOST} more", *[""] * (len(head) - 1)], "td"))
        return f"{text}<table>{''.join(lines)}</table>"


def _row(cells: Sequence[str], kind: str) -> str:
    return "<tr>" + "".join(f"<{kind}>{html.escape(cell)}</{kind}>" for cell in cells) + "</tr>"


def counted(number: int, noun: str) -> str:
    """A number of things, such as `1 joint` and `2 joints`."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
