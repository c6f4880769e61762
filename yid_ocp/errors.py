"""Exceptions of the package: each states what is wrong, where, what is allowed and what to do."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence
from typing import TypedDict


class YidError(Exception):
    """An error that the user can correct.

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
        parts = (("where", where), ("allowed", allowed), ("try", hint))
        super().__init__("\n".join([what, *(f"  {label}: {text}" for label, text in parts if text)]))


class ConfigError(YidError):
    """The configuration file, or a value set on top of it, is invalid."""


class DataError(YidError):
    """A recording or another input file is missing, malformed or does not fit the model."""


class ModelError(YidError):
    """The mechanical model cannot be built as described."""


class SolverError(YidError):
    """A solver does not support what was requested."""


class OutputError(YidError):
    """A result cannot be written to its destination."""


class WorkerError(YidError):
    """Workers cannot be reached, or cannot do their tasks."""


class InsufficientMemoryError(YidError):
    """The machine has too little memory."""


_MAX_LISTED_NAMES, _N_NEAREST_NAMES = 40, 8  # names listed in full where none is similar, and listed otherwise


class UnknownNameDetails(TypedDict):
    """Allowed names and hint for an error about an unknown name."""

    allowed: str
    hint: str


def nearest_name_hint(name: str, known: Iterable[str]) -> str:
    """Hint for an error about an unknown name: the most similar known name, or a list of known names.

    It is for errors that do not say what is allowed; beside a list, see `unknown_name_details`.
    """
    names = [str(entry) for entry in known]
    return _meant(name, names) or f"known: {_listed(name, sorted(names)) or 'none'}"


def unknown_name_details(name: str, known: Iterable[str]) -> UnknownNameDetails:
    """Allowed names and hint for an error about an unknown name, as its arguments; long lists are cut."""
    names = [str(entry) for entry in known]
    return {"allowed": _listed(name, names) or "none", "hint": _meant(name, names)}


def _close(name: str, names: Sequence[str], count: int) -> list[str]:
    """Known names similar to a name, most similar first, without regard to case."""
    plain = {entry.lower(): entry for entry in reversed(names)}
    return [plain[entry] for entry in difflib.get_close_matches(name.lower(), plain, n=count, cutoff=0.5)]


def _meant(name: str, names: Sequence[str]) -> str:
    close = _close(name, names, 1)
    return f"did you mean '{close[0]}'?" if close else ""


def _listed(name: str, names: Sequence[str]) -> str:
    """All names, or the most similar ones of many."""
    close = _close(name, names, _N_NEAREST_NAMES)
    if len(names) <= _N_NEAREST_NAMES or (not close and len(names) <= _MAX_LISTED_NAMES):
        return ", ".join(names)
    shown = [*close, *(entry for entry in names if entry not in close)][:_N_NEAREST_NAMES]
    return f"{', '.join(shown)} and {len(names) - _N_NEAREST_NAMES} more"
