"""Exceptions of the package: every one says what is wrong, where, what is allowed and what to do."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence
from typing import TypedDict


class YidError(Exception):
    """A problem that its reader can fix.

    Parameters
    ----------
    what : str
        What is wrong, in one clause.
    where : str
        The file, key, channel or object in which it was found.
    allowed : str
        What would be accepted.
    hint : str
        What to do next.
    """

    def __init__(self, what: str, *, where: str = "", allowed: str = "", hint: str = "") -> None:
        self.what, self.where, self.allowed, self.hint = what, where, allowed, hint
        lines = [what]
        parts = (("where", where), ("allowed", allowed), ("try", hint))
        lines += [f"  {label}: {text}" for label, text in parts if text]
        super().__init__("\n".join(lines))


class ConfigError(YidError):
    """The configuration file, or a value set over it, is not usable."""


class DataError(YidError):
    """A recording or another input file is missing, malformed or does not fit the model."""


class ModelError(YidError):
    """The mechanical model cannot be built as it was described."""


class SolverError(YidError):
    """A solver was asked for something that it does not do."""


class OutputError(YidError):
    """A result cannot be written where it was asked for."""


class WorkerError(YidError):
    """Workers cannot be reached, or are not fit for the tasks that they are to do."""


class ResourceError(YidError):
    """The machine has too little memory for what was asked of it."""


MANY, FEW = 40, 8
"""More names than the first are not listed; of so many that something is near, the second."""


class Choices(TypedDict):
    """What an error says of a name that is not known: its `allowed` and its `hint`."""

    allowed: str
    hint: str


def nearest(name: str, known: Iterable[str]) -> str:
    """Say which known name the given one resembles most, or list what there is.

    Parameters
    ----------
    name : str
        The name that was not found.
    known : iterable of str
        The names that exist.

    Returns
    -------
    str
        A sentence for the `hint` of an error that does not say what is allowed; beside a list, see `choices`.
    """
    names = [str(entry) for entry in known]
    return _meant(name, names) or f"known: {_listed(name, sorted(names)) or 'none'}"


def choices(name: str, known: Iterable[str]) -> Choices:
    """What is allowed in place of a name, and what it resembles most: no name twice, and long lists cut.

    Parameters
    ----------
    name, known
        As in `nearest`.

    Returns
    -------
    dict
        Arguments of an error: `ConfigError(what, where=where, **choices(name, known))`.
    """
    names = [str(entry) for entry in known]
    return {"allowed": _listed(name, names) or "none", "hint": _meant(name, names)}


def _close(name: str, names: Sequence[str], count: int) -> list[str]:
    """The names that resemble one, nearest first, whatever their case."""
    plain = {entry.lower(): entry for entry in reversed(names)}
    return [plain[entry] for entry in difflib.get_close_matches(name.lower(), plain, n=count, cutoff=0.5)]


def _meant(name: str, names: Sequence[str]) -> str:
    close = _close(name, names, 1)
    return f"did you mean '{close[0]}'?" if close else ""


def _listed(name: str, names: Sequence[str]) -> str:
    """All names, or the nearest where they are many."""
    close = _close(name, names, FEW)
    if len(names) <= FEW or (not close and len(names) <= MANY):
        return ", ".join(names)
    shown = [*close, *(entry for entry in names if entry not in close)][:FEW]
    return f"{', '.join(shown)} and {len(names) - FEW} more"
