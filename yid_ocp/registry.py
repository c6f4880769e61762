"""Tables of named implementations, such as effects, sensors, readers, solvers and report sections."""

from __future__ import annotations

from collections import UserDict
from collections.abc import Callable, Iterator
from typing import TypeVar

from yid_ocp.errors import ConfigError, unknown_name_error_arguments

_Entry = TypeVar("_Entry")


class Registry(UserDict[str, _Entry]):
    """A table of implementations sorted by name, filled by decorators. Error messages call an entry `entry_noun`."""

    def __init__(self, entry_noun: str) -> None:
        super().__init__()
        self.entry_noun = entry_noun

    def register(self, name: str) -> Callable[[_Entry], _Entry]:
        """Return a decorator that registers a function or class under `name`."""

        def enter(entry: _Entry) -> _Entry:
            if name in self:
                what, allowed = f"another {self.entry_noun} already has the name '{name}'", "a name that is not in use"
                hint = f"register it under another name, such as '{name}_2'"
                raise ConfigError(what, where=f"register('{name}')", allowed=allowed, hint=hint)
            self[name] = entry
            return entry

        return enter

    def __missing__(self, name: str) -> _Entry:
        # the earlier the description of an entry has this word, the earlier it is listed
        found = {own: f"{entry.__doc__} {own}".lower().find(name.lower()) for own, entry in self.items()}
        said = unknown_name_error_arguments(name, sorted(found, key=lambda own: (found[own] < 0, found[own])))
        what, where = f"there is no {self.entry_noun} '{name}'", f"the name of the {self.entry_noun}"
        raise ConfigError(what, where=where, **said)

    def __iter__(self) -> Iterator[str]:
        return iter(sorted(self.data))
