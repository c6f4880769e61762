"""Exceptions of the package. Each states what is wrong, where, what is allowed and what to do."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence


class YidError(Exception):
    """An error that the user can correct. It states what is wrong, where, what is allowed and what to do next.

    Its text has all four parts, at most 600 characters in total, with control characters escaped.
    """

    _usual_allowed = "what the documents describe"
    _usual_hint = "correct it and run the command again"

    def __init__(self, what: str, *, where: str = "", allowed: str = "", hint: str = "") -> None:
        self.what, self.where, self.allowed, self.hint = what, where, allowed, hint
        super().__init__(what)

    def four_parts(self) -> dict[str, str]:
        """The keys what, where, allowed and hint as the user sees them. Missing parts have general texts."""
        said = {
            "what": self.what,
            "where": self.where or "the command as it was given",
            "allowed": self.allowed or self._usual_allowed,
            "hint": self.hint or self._usual_hint,
        }
        shown = {key: _printable(text) for key, text in said.items()}
        room, parts = _MAX_MESSAGE_LENGTH, len(shown)
        for key, text in sorted(shown.items(), key=lambda item: len(item[1])):  # short ones leave room to long ones
            shown[key] = _shortened(text, room // parts)
            room, parts = room - len(shown[key]), parts - 1
        return shown

    def __str__(self) -> str:
        shown = self.four_parts()
        return f"{shown['what']}\n  where: {shown['where']}\n  allowed: {shown['allowed']}\n  try: {shown['hint']}"


class ConfigError(YidError):
    """Raised when the configuration file, or a value that overrides it, is invalid."""

    _usual_allowed = "keys and values as docs/reference/settings.md lists them"


class DataError(YidError):
    """Raised when a recording or another input file is missing, malformed or does not fit the model."""

    _usual_allowed = "a whole file as docs/reference/recordings.md describes it"
    _usual_hint = "correct the file, or record it again"


class ModelError(YidError):
    """Raised when the mechanical model cannot be built as described."""

    _usual_allowed = "a model as docs/howto/choosing.md describes it"
    _usual_hint = "correct the robot's file, or the section `model`"


class SolverError(YidError):
    """Raised when a method does not support the task, or when a solver finds no usable solution."""


class OutputError(YidError):
    """Raised when a result cannot be written to its destination."""

    _usual_allowed = "a place of your own on a disk with room"
    _usual_hint = "choose another place with --out"


class WorkerError(YidError):
    """Raised when workers cannot be reached or are unsuitable for their tasks."""


class InsufficientMemoryError(YidError):
    """Raised when the machine has too little memory."""


_MAX_MESSAGE_LENGTH = 560  # of the four parts together, without their labels


def _printable(text: str) -> str:
    """A text on one line, in which control characters are escaped."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def _shortened(text: str, length: int) -> str:
    """A text of at most `length` characters, without its middle if it is longer."""
    half = (length - 5) // 2
    return text if len(text) <= length else f"{text[:half]} ... {text[-half:]}"


_MAX_LISTED_NAMES, _N_NEAREST_NAMES = 40, 8  # names listed in full where none is similar, and listed otherwise


def nearest_name_hint(name: str, known: Iterable[str]) -> str:
    """Hint for an error about an unknown name: the most similar known name, or a list of known names.

    For an error that also lists what is allowed, use `unknown_name_error_arguments`.
    """
    names = [str(entry) for entry in known]
    return _meant(name, names) or f"known: {_listed(name, sorted(names)) or 'none'}"


def unknown_name_error_arguments(name: str, known: Iterable[str]) -> dict[str, str]:
    """Arguments `allowed` and `hint` of an error for an unknown name: `known` names (shortened) and the nearest one."""
    names = [str(entry) for entry in known]
    return {"allowed": _listed(name, names) or "none", "hint": _meant(name, names)}


def _close(name: str, names: Sequence[str], count: int) -> list[str]:
    plain = {entry.lower(): entry for entry in reversed(names)}
    return [plain[entry] for entry in difflib.get_close_matches(name.lower(), plain, n=count, cutoff=0.5)]


def _meant(name: str, names: Sequence[str]) -> str:
    close = _close(name, names, 1)
    return f"did you mean '{close[0]}'?" if close else ""


def _listed(name: str, names: Sequence[str]) -> str:
    close = _close(name, names, _N_NEAREST_NAMES)
    if len(names) <= _N_NEAREST_NAMES or (not close and len(names) <= _MAX_LISTED_NAMES):
        return ", ".join(names)
    shown = [*close, *(entry for entry in names if entry not in close)][:_N_NEAREST_NAMES]
    return f"{', '.join(shown)} and {len(names) - _N_NEAREST_NAMES} more"
