"""Tables of named implementations (effects, sensors, readers, solvers, report sections)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Generic, TypeVar

from yid_ocp.errors import ConfigError, choices

T = TypeVar("T")


class Registry(Generic[T]):
    """A table from name to implementation, filled by decorators.

    Parameters
    ----------
    noun : str
        What the entries are, used in error messages.
    """

    def __init__(self, noun: str) -> None:
        self.noun = noun
        self._entries: dict[str, T] = {}

    def register(self, name: str) -> Callable[[T], T]:
        """A decorator that registers its argument under `name`."""

        def enter(entry: T) -> T:
            if name in self._entries:
                raise ConfigError(
                    f"the name '{name}' is taken: another {self.noun} has it",
                    hint="register it under another name",
                )
            self._entries[name] = entry
            return entry

        return enter

    def forget(self, names: Iterable[str]) -> None:
        """Remove entries, such as those of a module whose import failed."""
        for name in names:
            self._entries.pop(name, None)

    def __getitem__(self, name: str) -> T:
        if name not in self._entries:
            raise ConfigError(f"there is no {self.noun} '{name}'", **choices(name, self))
        return self._entries[name]

    def __contains__(self, name: object) -> bool:
        return name in self._entries

    def __iter__(self) -> Iterator[str]:
        return iter(sorted(self._entries))

    def __len__(self) -> int:
        return len(self._entries)
