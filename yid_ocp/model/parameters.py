"""Named physical parameters with value, unit, bounds and symbol."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import casadi as ca
import numpy as np

from yid_ocp.arrays import Array
from yid_ocp.display import ReprMixin, ReprTexts, count_with_noun
from yid_ocp.errors import ConfigError, require_known_names


@dataclass(frozen=True)
class Parameter:
    """A physical parameter with its nominal value, SI unit, physical bounds and symbol."""

    name: str  # `owner.quantity`, for example `T1.bend`; for an effect `kind@location.quantity`
    value: float
    unit: str  # `1` for a pure number
    lower: float = -math.inf
    upper: float = math.inf
    description: str = ""
    symbol: ca.SX = field(default_factory=ca.SX, compare=False, repr=False)  # scalar symbol in expressions

    def __post_init__(self) -> None:
        if self.symbol.is_empty():
            object.__setattr__(self, "symbol", ca.SX.sym(self.name))
        if not math.isfinite(self.value):
            what, allowed = f"{self.name} = {self.value} is not a finite number", f"a finite number [{self.unit}]"
            raise ConfigError(what, where=f"parameters.{self.name}", allowed=allowed, hint="pass a finite `value`")
        if not self.lower <= self.value <= self.upper:
            is_low = self.value < self.lower
            side, bound = ("below its lower", self.lower) if is_low else ("above its upper", self.upper)
            allowed = f"{'at least' if is_low else 'at most'} {bound:g} {self.unit}"
            what = f"{self.name} = {self.value:g} {self.unit} lies {side} bound of {bound:g} {self.unit}"
            where = f"parameters.{self.name}"
            hint = f"change {where}.initial, or set wider {where}.bounds"
            raise ConfigError(what, where=where, allowed=allowed, hint=hint)


class Parameters(ReprMixin):
    """The parameters of a model, in the order of the vector `theta`. Names are unique; the sequence is immutable."""

    def __init__(self, entries: Iterable[Parameter] = ()) -> None:
        self._entries = tuple(entries)
        self._index = {entry.name: i for i, entry in enumerate(self._entries)}
        if len(self._index) != len(self._entries):
            twice = sorted(name for name, count in Counter(self.names).items() if count > 1)
            what = f"two parameters are called '{twice[0]}'"
            hint = "remove the repeated effect, or rename the joint or segment"
            raise ConfigError(what, where="parameters of the model", allowed="every name once", hint=hint)

    def _summary(self) -> ReprTexts:
        rows = [("parameter", "value", "unit", "lower", "upper")]
        rows += [(e.name, f"{e.value:.4g}", e.unit, f"{e.lower:g}", f"{e.upper:g}") for e in self]
        return ReprTexts(count_with_noun(len(self), "parameter"), rows)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the parameters, in the order of `theta`."""
        return tuple(entry.name for entry in self._entries)

    @property
    def symbols(self) -> ca.SX:
        """The symbols of the parameters, in the order of `theta`, shape (ntheta, 1)."""
        return ca.vertcat(*(entry.symbol for entry in self._entries)) if self._entries else ca.SX(0, 1)

    def __len__(self) -> int:
        return len(self._entries)

    def __iter__(self) -> Iterator[Parameter]:
        return iter(self._entries)

    def __contains__(self, name: object) -> bool:
        return name in self._index

    def __getitem__(self, name: str) -> Parameter:
        return self._entries[self.index(name)]

    def index(self, name: str) -> int:
        """Return the index of a parameter in `theta`. Raises `ConfigError`, with the nearest name, if there is none."""
        require_known_names([name], self._index, "parameter", "parameters of the model", ConfigError)
        return self._index[name]

    def vector(self, values: Mapping[str, float] | None = None) -> Array:
        """Return theta (ntheta,), from `values` (by name) or nominal. Raises `ConfigError` for a bad name or number."""
        theta = np.array([entry.value for entry in self._entries], dtype=float)
        for name, value in (values or {}).items():
            if not math.isfinite(value):
                what, hint = f"{name} = {value} is not a finite number", f"pass for example {self[name].value:g}"
                raise ConfigError(what, where=f"parameters.{name}", allowed="a finite number", hint=hint)
            theta[self.index(name)] = value
        return theta

    def with_nominal_values(self, values: Mapping[str, float]) -> Parameters:
        """Return a copy in which the named parameters have other nominal values. Symbols stay the same."""
        changed = list(self._entries)
        for name, value in values.items():
            changed[self.index(name)] = replace(self[name], value=float(value))
        return Parameters(changed)

    def with_added(self, *others: Iterable[Parameter]) -> Parameters:
        """Return a copy with the parameters of `others` appended."""
        return Parameters([*self._entries, *(entry for other in others for entry in other)])

    def lower_and_upper_bounds(self, names: Sequence[str]) -> tuple[Array, Array]:
        """Return the lower and upper bounds of the named parameters, as two arrays (len(names),)."""
        chosen = [self[name] for name in names]
        return np.array([e.lower for e in chosen], dtype=float), np.array([e.upper for e in chosen], dtype=float)
