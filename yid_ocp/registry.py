"""Tables of named implementations, such as effects, sensors, readers, solvers and report sections."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Generic, TypeVar

from yid_ocp.errors import ConfigError, require_known_names

_Entry = TypeVar("_Entry")


class Registry(Generic[_Entry]):
    """A table of implementations by name, filled by decorators. Error messages call an entry `entry_noun`."""

    def __init__(self, entry_noun: str) -> None:
        self.entry_noun = entry_noun
        self._entries: dict[str, _Entry] = {}

    def register(self, name: str) -> Callable[[_Entry], _Entry]:
        """Return a decorator that registers a function or class under `name`."""

        def enter(entry: _Entry) -> _Entry:
            if name in self._entries:
                what, allowed = f"another {self.entry_noun} already has the name '{name}'", "a name that is not in use"
                hint = f"register it under another name, such as '{name}_2'"
                raise ConfigError(what, where=f"register('{name}')", allowed=allowed, hint=hint)
            self._entries[name] = entry
            return entry

        return enter

    def unregister_names(self, names: Iterable[str]) -> None:
        """Remove the entries with the given names, for example after the import of a module failed."""
        for name in names:
            self._entries.pop(name, None)

    def __getitem__(self, name: str) -> _Entry:
        if name not in self._entries:  # the earlier the description of an entry has this word, the earlier it is listed
            found = {own: f"{self._entries[own].__doc__} {own}".lower().find(name.lower()) for own in self}
            known = sorted(found, key=lambda own: (found[own] < 0, found[own]))
            require_known_names([name], known, self.entry_noun, f"the name of the {self.entry_noun}", ConfigError)
        return self._entries[name]

    def __contains__(self, name: object) -> bool:
        return name in self._entries

    def __iter__(self) -> Iterator[str]:
        return iter(sorted(self._entries))

    def __len__(self) -> int:
        return len(self._entries)
