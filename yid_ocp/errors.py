"""Exceptions of the package. Each states what is wrong, where, what is allowed and what to do."""

from __future__ import annotations

import difflib
import re
import sys
from collections.abc import Collection, Iterable, Sequence
from importlib import import_module
from pathlib import Path
from types import ModuleType


class YidError(Exception):
    """An error that the user can correct. It states what is wrong, where, what is allowed and what to do next.

    Its text has all four parts, at most 600 characters in total, with control characters escaped.
    """

    _usual_allowed = "what docs/reference and docs/howto describe"

    def __init__(self, what: str, *, hint: str, where: str = "", allowed: str = "") -> None:
        self.what, self.where, self.allowed, self.hint = what, where, allowed, hint
        super().__init__(what)

    def message_parts(self) -> dict[str, str]:
        """Return what, where, allowed and hint as shown; a general text replaces a missing where or allowed."""
        said = {
            "what": self.what,
            "where": self.where or "the arguments of this command or function",
            "allowed": self.allowed or self._usual_allowed,
            "hint": self.hint,
        }
        shown = {
            key: "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
            for key, text in said.items()
        }
        room, parts = _MAX_MESSAGE_LENGTH, len(shown)
        for key, text in sorted(shown.items(), key=lambda item: len(item[1])):  # short ones leave room to long ones
            half = (room // parts - 5) // 2
            begin, end = re.sub(r" \S{,40}$", "", text[:half]), re.sub(r"^\S{,40} ", "", text[-half:])  # whole words
            shown[key] = text if len(text) <= room // parts else f"{begin} ... {end}"
            room, parts = room - len(shown[key]), parts - 1
        return shown

    def __str__(self) -> str:
        shown = self.message_parts()
        return f"{shown['what']}\n  where: {shown['where']}\n  allowed: {shown['allowed']}\n  try: {shown['hint']}"


class ConfigError(YidError):
    """An error that is raised when the configuration file, or a value that overrides it, is invalid."""

    _usual_allowed = "the keys and values in docs/reference/settings.md"


class DataError(YidError):
    """An error that is raised when an input file is missing, malformed or does not fit the model."""

    _usual_allowed = "data in a format that docs/reference/recordings.md or docs/howto/import.md describes"


class ModelError(YidError):
    """An error that is raised when the mechanical model cannot be built as described."""

    _usual_allowed = "a model as the section `model` of docs/reference/settings.md describes it"


class SolverError(YidError):
    """An error that is raised when a method does not support the task, or a solver finds no usable solution."""


def failed_rollout_error(reason: str, where: str = "parameter values and initial states") -> SolverError:
    """Create the `SolverError` for a model that cannot be simulated at `where`. `reason` completes the message."""
    what, allowed = f"the model cannot be simulated: {reason}", "settings for which every time step has a solution"
    return SolverError(what, where=where, allowed=allowed, hint=FAILED_ROLLOUT_ADVICE)


def import_optional(module: str, extra: str, what: str, kind: type[YidError] = DataError) -> ModuleType:
    """Import and return a module of the optional dependencies `extra`.

    Raises `kind` with the text `what`, and how to install `extra` or a system library, if the import fails.
    """
    try:
        return import_module(module)
    except (ImportError, OSError) as error:
        where, hint = f"the Python environment {sys.prefix}", f"pip install '.[{extra}]' in the project's clone"
        if not isinstance(error, ModuleNotFoundError):
            what = f"{what}, which is installed but cannot be loaded: {error}"
            hint = f"install the missing system library (libGL.so.1: apt install libgl1); if none is missing, {hint}"
        raise kind(what, where=where, allowed=f"yid_ocp with its extra `{extra}`", hint=hint) from error


class OutputError(YidError):
    """An error that is raised when a result cannot be written to its destination."""

    _usual_allowed = "a path in a writable folder, on a disk with free space"


class ParallelWorkError(YidError):
    """An error raised when workers cannot be reached, are unsuitable for their tasks, or fail for a known cause."""


class InsufficientMemoryError(YidError):
    """An error that is raised when the machine has too little memory."""


FAILED_ROLLOUT_ADVICE = "set model.damping above 0; if it is, halve problem.time_step or change parameters.NAME.initial"
_MAX_MESSAGE_LENGTH = 560  # of the four parts together, without their labels
# names listed in full where none is similar; characters of a list given in full in any case; names listed otherwise
_MAX_LISTED_NAMES, _MAX_LISTED_CHARACTERS, _N_NEAREST_NAMES = 40, 240, 8


def unknown_name_error_arguments(name: str, known: Iterable[str], otherwise: str = "") -> dict[str, str]:
    """Return the arguments `allowed` and `hint` of an error about an unknown name. A long list is shortened.

    The hint asks whether the most similar known name was meant. If no name is similar, it is `otherwise`.
    """
    names = [str(entry) for entry in known]
    otherwise = otherwise or ("use one of the allowed names" if names else f"leave '{name}' out")
    return {"allowed": _listed(name, names) or "none", "hint": nearest_name_question(name, names) or otherwise}


def require_known_names(
    names: Iterable[str], known: Collection[str], noun: str, where: str, kind: type[YidError]
) -> None:
    """Raise an error of `kind` if any name is unknown: "there is no NOUN 'NAME'", with the nearest known name."""
    for name in names:
        if name not in known:
            raise kind(f"there is no {noun} '{name}'", where=where, **unknown_name_error_arguments(name, known))


def _close(name: str, names: Sequence[str], count: int, cutoff: float) -> list[str]:
    plain = {entry.lower(): entry for entry in reversed(names)}
    near = difflib.get_close_matches(name.lower(), plain, n=len(plain) + 1, cutoff=cutoff)
    return [plain[n] for n in sorted(near, key=lambda n: sorted(n) != sorted(name.lower()))[:count]]


def nearest_name_question(name: str, names: Iterable[str]) -> str:
    """Return the question "did you mean NAME?" for the most similar known name. Empty if no name is similar."""
    names = [*names]
    longer = [entry for entry in names if len(name) > 3 and name.lower() in entry.lower()]
    close = _close(name, names, 1, 0.6) or (longer if len(longer) == 1 else [])
    return f"did you mean '{close[0]}'?" if close else ""


def nearest_file_question(path: Path, pattern: str = "*") -> str:
    """Return the question "did you mean NAME?" for the file beside `path` of the most similar name without ending."""
    names = {entry.stem: entry.name for entry in path.parent.glob(pattern) if entry != path}
    close = _close(path.stem, [*names], 1, 0.6)
    return f"did you mean '{names[close[0]]}'?" if close else ""


def _listed(name: str, names: Sequence[str]) -> str:
    close = _close(name, names, _N_NEAREST_NAMES, 0.5)
    if len(", ".join(names)) <= _MAX_LISTED_CHARACTERS or (not close and len(names) <= _MAX_LISTED_NAMES):
        return ", ".join(names)
    shown = [*close, *(entry for entry in names if entry not in close)][:_N_NEAREST_NAMES]
    return f"{', '.join(shown)} and {len(names) - _N_NEAREST_NAMES} more"
