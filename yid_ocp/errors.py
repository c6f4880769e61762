"""Exceptions of the package: every one says what is wrong, where, what is allowed and what to do."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


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


def nearest(name: str, known: Iterable[str]) -> str:
    """Say which known name the given one resembles most, or list them all.

    Parameters
    ----------
    name : str
        The name that was not found.
    known : iterable of str
        The names that exist.

    Returns
    -------
    str
        A sentence for the `hint` of an error.
    """
    names = [str(entry) for entry in known]
    close = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
    if close:
        return f"did you mean '{close[0]}'?"
    return "known: " + (", ".join(sorted(names)) if names else "none")
