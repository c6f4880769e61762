"""Short text and notebook representations of objects, without printing their arrays."""

from __future__ import annotations

import html
from collections.abc import Sequence
from dataclasses import dataclass

_MAX_TABLE_ROWS = 30  # largest number of table rows in a notebook; further rows are only counted


@dataclass(frozen=True)
class ReprLineAndTableRows:
    """Texts that represent an object: one line without its class name, and rows of a notebook table, header first."""

    one_line: str
    table_rows: Sequence[Sequence[str]] = ()


class ReprMixin:
    """Mixin that makes `__repr__` and a notebook table from the method `_summary`; a dataclass needs `repr=False`."""

    def _summary(self) -> ReprLineAndTableRows:
        raise NotImplementedError

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {self._summary().one_line}>"

    def _repr_html_(self) -> str:
        """HTML for notebooks."""
        said = self._summary()
        text = f"<p><b>{type(self).__name__}</b>: {html.escape(said.one_line)}</p>"
        if len(said.table_rows) < 2:
            return text
        head, *rows = said.table_rows
        lines = [_row(head, "th"), *(_row(row, "td") for row in rows[:_MAX_TABLE_ROWS])]
        if len(rows) > _MAX_TABLE_ROWS:
            lines.append(_row([f"and {len(rows) - _MAX_TABLE_ROWS} more", *[""] * (len(head) - 1)], "td"))
        return f"{text}<table>{''.join(lines)}</table>"


def _row(cells: Sequence[str], kind: str) -> str:
    return "<tr>" + "".join(f"<{kind}>{html.escape(cell)}</{kind}>" for cell in cells) + "</tr>"


def count_with_noun(number: int, noun: str) -> str:
    """A number with its noun, such as `1 joint` and `2 joints`."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
