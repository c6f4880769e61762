"""Text and notebook representations of objects, and progress reports of long computations."""

from __future__ import annotations

import html
import logging
import re
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

_Key = TypeVar("_Key")
_Value = TypeVar("_Value")
_MAX_NAMES_IN_LINE = 12  # names in a line; tables list all
_MAX_NOTEBOOK_ROWS = 30  # largest number of table rows in a notebook; further rows are only counted


@dataclass(frozen=True)
class ReprTexts:
    """The texts that represent an object: a line without class name, and rows of a notebook table (header first)."""

    one_line: str
    table_rows: Sequence[Sequence[str]] = ()


class ReprMixin:
    """A mixin class that makes `__repr__` and a notebook table from `_summary`. Its dataclasses need `repr=False`."""

    def _summary(self) -> ReprTexts:
        raise NotImplementedError

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {self._summary().one_line}>"

    def _repr_html_(self) -> str:
        said = self._summary()
        text = f"<p><b>{type(self).__name__}</b>: {html.escape(said.one_line)}</p>"
        if len(said.table_rows) < 2:
            return text
        head, *rows = said.table_rows
        lines = [_row(head, "th"), *(_row(row, "td") for row in rows[:_MAX_NOTEBOOK_ROWS])]
        if len(rows) > _MAX_NOTEBOOK_ROWS:
            lines.append(_row([f"and {len(rows) - _MAX_NOTEBOOK_ROWS} more", *[""] * (len(head) - 1)], "td"))
        return f"{text}<table>{''.join(lines)}</table>"


def _row(cells: Sequence[str], kind: str) -> str:
    return "<tr>" + "".join(f"<{kind}>{html.escape(cell)}</{kind}>" for cell in cells) + "</tr>"


def count_with_noun(number: int, noun: str) -> str:
    """Return a number with its noun in singular or plural, such as `1 joint` or `2 joints`."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def texts_that_hold(*rows: tuple[object, _Value]) -> list[_Value]:
    """Return the texts (or tuples of texts) whose condition holds, or is not empty."""
    return [text for holds, text in rows if holds]


def p_value_text(p_value: float, relation: str = "") -> str:
    """Format a p-value after a `relation`, such as "= ". Values below 1e-12 give `< 1e-12`."""
    return f"{relation}{p_value:.2g}" if p_value > 1e-12 else "< 1e-12"


def abbreviated_names_text(names: Sequence[str], max_entries: float = _MAX_NAMES_IN_LINE) -> str:
    """Join names to one line of text. Three or more that end in consecutive numbers become `joint1 to joint7`.

    Four or more are merged if text follows the number: `T1.bend to T3.bend` would seem to contain `T1.twist`.
    The line has at most `max_entries` entries, followed by the number of omitted names.
    """
    parts = [re.split(r"(\d+)", name) for name in names]
    taken: set[int] = set()
    said, left = list[str](), 0
    for i, own in enumerate(parts):
        if i in taken:
            continue
        longest, text = [i], names[i]
        for at in range(1, len(own), 2):
            run = [i]
            for number in range(int(own[at]) + 1, int(own[at]) + len(names)):
                following = [*own[:at], str(number), *own[at + 1 :]]
                if following not in parts:
                    break
                run.append(parts.index(following))
            least = 3 if own[at + 1 :] == [""] else 4
            if len(run) > max(least - 1, len(longest)) and not taken.intersection(run):
                longest, text = run, f"{names[i]} to {names[run[-1]]}"
        taken.update(longest)
        if len(said) < max_entries:
            said.append(text)
        else:
            left += len(longest)
    return ", ".join(said) + (f" and {left} more" if left else "")


def kind_of_part(name: str) -> str:
    """Return the kind in the name of an effect (`kind@place`) or parameter (`place.kind`)."""
    return name.partition("@")[0] if "@" in name else name.rpartition(".")[2]


def names_by_kind_text(names: Sequence[str]) -> str:
    """Join names of effects and parameters to one line of text. Four or more of a kind become a number."""
    kinds = grouped((kind_of_part(name), name) for name in names)
    return ", ".join(f"{kind} ({len(own)} times)" if len(own) > 3 else ", ".join(own) for kind, own in kinds.items())


def grouped(pairs: Iterable[tuple[_Key, _Value]]) -> dict[_Key, list[_Value]]:
    """Return the values of (key, value) pairs by key, in their order."""
    found: dict[_Key, list[_Value]] = {}
    for key, value in pairs:
        found.setdefault(key, []).append(value)
    return found


def effect_entry_label(entry: Mapping[str, Any]) -> str:
    """Return the label `kind@location` of an effect in a result dictionary."""
    return f"{entry['kind']}@{entry['location']}"


def unseen_effects_sentence(labels: Sequence[str]) -> str:
    """Sentence on effects that recordings would not show. Empty if there are none."""
    kinds = list[str]()
    for kind, (first, *others) in grouped(label.partition("@")[::2] for label in labels).items():
        more = f" and {count_with_noun(len(others), 'other place')}" if others else ""
        kinds.append(f"{kind}@{first}{more}")
    return f"These recordings would not show these effects, even if they exist: {', '.join(kinds)}." if kinds else ""


class Progress:
    """A base class for receivers of progress reports, which ignores all reports. One thread at a time calls it."""

    def begin_stage(self, text: str, work: float = 0.0, ahead: float | None = None) -> None:
        """Report that a new stage of the work, described by `text`, begins.

        `work` is the expected time of the stage, `ahead` the expected time of all later stages [s]. Without `ahead`,
        the receiver subtracts `work` from the time that it expected for all later stages. A stage whose duration does
        not predict the later ones (such as compilation) has `work` zero, and `ahead` includes its time.
        """

    def report_iterate(self, entry: Any) -> None:
        """Report a new accepted point of a search (`solvers.base.Iterate`)."""

    def report_parts_done(self, done: int, total: int, text: str) -> None:
        """Report that `done` of `total` parts of the stage are finished. `text` names the last or next part."""

    def renew_results_table(self, rows: Sequence[Sequence[str]]) -> None:
        """Replace the table of all results so far. Its header comes first, then the best result."""


NULL_PROGRESS = Progress()


@dataclass(frozen=True)
class LoggingProgress(Progress):
    """A progress receiver that writes reports to a logger."""

    log: logging.Logger

    def begin_stage(self, text: str, work: float = 0.0, ahead: float | None = None) -> None:
        """Log the name of the stage."""
        self.log.info("%s", text)

    def report_parts_done(self, done: int, total: int, text: str) -> None:
        """Log the number of finished parts."""
        self.log.info("%d of %d, %s", done, total, text)


class PartsDoneCounter:
    """A thread-safe counter of the finished parts of a stage. It reports every count; `first` is the text for zero."""

    def __init__(self, progress: Progress, total: int, first: str) -> None:
        self._progress, self._total, self._count, self._lock = progress, total, 0, threading.Lock()
        progress.report_parts_done(0, total, first)

    def count_done(self, text: str, table: Callable[[], Sequence[Sequence[str]]] | None = None) -> None:
        """Report that one more part is finished, with the table of results if given. Any thread may call it."""
        with self._lock:
            self._count += 1
            self._progress.report_parts_done(self._count, self._total, text)
            if table is not None:
                self._progress.renew_results_table(table())
