"""Sentences on parameters that are identifiable only in combination: as a sum, springs in series, a ratio."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_MAX_DIRECTION_MISMATCH = 0.05  # of a direction against that of a plain combination, both of unit length
_FINITE_CHANGE_FACTOR = 1.3  # factor on the first parameter in the test of a combination at a finite change
_MAX_LISTED_NAMES = 4  # in a sentence
_MAX_RELATIVE_DATA_CHANGE = 0.1  # by which a combination may move the data, of what one change alone does


@dataclass(frozen=True)
class DirectionComponent:
    """One parameter's coefficient in a direction of relative parameter changes, with its value and unit."""

    name: str
    coefficient: float
    value: float
    unit: str


@dataclass(frozen=True)
class _CombinationForm:
    """A function of two parameters that may be identifiable where neither of them is."""

    words: str
    slope: Callable[[float, float], tuple[float, float]]
    partner: Callable[[float, float, float], float]
    same_unit: bool


def _series_partner(a: float, b: float, n: float) -> float:
    return 1 / (1 / a + 1 / b - 1 / n)


_COMBINATION_FORMS: tuple[_CombinationForm, ...] = (
    _CombinationForm("1/{a} + 1/{b}, as springs in series are", lambda a, b: (a, -b), _series_partner, True),
    _CombinationForm("{a} + {b}, as springs side by side are", lambda a, b: (b, -a), lambda a, b, n: a + b - n, True),
    _CombinationForm("the ratio {a} / {b}", lambda a, b: (1.0, 1.0), lambda a, b, n: b * n / a, False),
    _CombinationForm("the product {a} x {b}", lambda a, b: (1.0, -1.0), lambda a, b, n: b * a / n, False),
)


def describe_combination(
    parts: Sequence[DirectionComponent], moved: Callable[[Mapping[str, float]], float] | None
) -> str:
    """A sentence on which combination of the parameters in an unidentifiable direction the data determine.

    `moved` tells how far the data move [standard deviations] where parameters take new values, and so combinations
    apart that look alike for small changes. Without it the trade is described and not named.
    """
    if len(parts) == 1:
        return f"{parts[0].name} is not seen"
    names = [part.name for part in parts]
    listed = join_names(names)
    if len(parts) == 2 and moved is not None:
        form = _form(parts[0], parts[1], moved)
        if form is not None:
            return f"{listed} are seen only as {form.words.format(a=names[0], b=names[1])}"
    largest = max(abs(part.coefficient) for part in parts)
    shown = list(parts)
    if len(parts) > _MAX_LISTED_NAMES:
        shown = sorted(parts, key=lambda part: -abs(part.coefficient))[:_MAX_LISTED_NAMES]
    trade = " with ".join(f"{part.name} {10 * part.coefficient / largest:+.2g} %" for part in shown)
    rest = " and the others to match" if len(shown) < len(parts) else ""
    return f"{listed} are seen only together: {trade}{rest} changes nothing that is measured"


def join_names(names: Sequence[str]) -> str:
    """Names joined to a text; beyond the first four, only the number of further names is given."""
    if len(names) > _MAX_LISTED_NAMES:
        return f"{', '.join(names[:_MAX_LISTED_NAMES])} and {len(names) - _MAX_LISTED_NAMES} more"
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def _form(
    first: DirectionComponent, second: DirectionComponent, moved: Callable[[Mapping[str, float]], float]
) -> _CombinationForm | None:
    direction = np.array([first.coefficient, second.coefficient])
    direction /= np.linalg.norm(direction)
    a, b = first.value, second.value
    tried: list[tuple[float, _CombinationForm]] = []
    for form in _COMBINATION_FORMS:
        if form.same_unit and first.unit != second.unit:
            continue
        slope = np.array(form.slope(a, b))
        if 1.0 - abs(float(slope @ direction)) / float(np.linalg.norm(slope)) > _MAX_DIRECTION_MISMATCH**2:
            continue
        new_a = a * _FINITE_CHANGE_FACTOR
        new_b = form.partner(a, b, new_a)
        if new_b > 0:
            tried.append((moved({first.name: new_a, second.name: new_b}), form))
    if not tried:
        return None
    least, best = min(tried, key=lambda entry: entry[0])
    allowed = max(_MAX_RELATIVE_DATA_CHANGE * moved({first.name: a * _FINITE_CHANGE_FACTOR}), 1.0)
    return best if math.isfinite(least) and least <= allowed else None


def sparse_basis(vectors: Array) -> list[Array]:
    """Sparse basis, of unit vectors, of the space spanned by row vectors (d, p).

    Row echelon form with complete pivoting: as many components as there are vectors stand in one vector only.
    """
    rows = vectors.copy()
    taken: list[int] = []
    for i in range(len(rows)):
        open_columns = [j for j in range(rows.shape[1]) if j not in taken]
        block = np.abs(rows[i:][:, open_columns])
        at = np.unravel_index(int(np.argmax(block)), block.shape)
        pivot, column = i + int(at[0]), open_columns[int(at[1])]
        rows[[i, pivot]] = rows[[pivot, i]]
        rows[i] /= rows[i, column]
        for k in range(len(rows)):
            if k != i:
                rows[k] -= rows[k, column] * rows[i]
        taken.append(column)
    return [row / np.linalg.norm(row) for row in rows]
