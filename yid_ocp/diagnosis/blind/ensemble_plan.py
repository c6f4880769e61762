"""Plan of an ensemble: categories and effect sizes of its cases, distributed over the experiments."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from yid_ocp.errors import ConfigError

_Key = TypeVar("_Key", str, float)
DETECTABLE_MULTIPLES = (1.0, 3.0, 10.0)
"""Multiples of the detectable size."""
CATEGORY_SHARES: Mapping[str, float] = {
    "null": 0.2,
    "single": 0.48,
    "pair": 0.1,
    "outside": 0.1,
    "left_out": 0.06,
    "finer_chain": 0.06,
}
"""Fraction of the cases in every category."""
ENSEMBLE_PURPOSES = ("report", "calibration")
"""Purposes of an ensemble; the same seed draws different cases for each."""
_MIN_CASES_PER_EXPERIMENT = 3
"""Cases below which an experiment is not worth its compiled step."""


@dataclass(frozen=True)
class PlannedCase:
    """A planned case: experiment, category and effect size.

    Attributes
    ----------
    number : int
    experiment : str
    category : str
        Of `CATEGORY_SHARES`.
    multiple : float, optional
        Of the detectable size; None where that has no meaning.
    """

    number: int
    experiment: str
    category: str
    multiple: float | None


def plan_cases(
    count: int,
    seed: int,
    weights: Mapping[str, float],
    chains: frozenset[str] = frozenset(),
    purpose: str = ENSEMBLE_PURPOSES[0],
) -> list[PlannedCase]:
    """Return the planned cases of an ensemble, in an order given by the seed.

    Parameters
    ----------
    count : int
    seed : int
    weights : mapping of experiment to float
        How large a part of the cases each gets; those that would get fewer than `_MIN_CASES_PER_EXPERIMENT` get none, but for the largest.
    chains : frozenset of str
        Experiments whose object can be made of finer links.
    purpose : str
        Of `ENSEMBLE_PURPOSES`.

    Raises
    ------
    ConfigError
        No case at all.
    """
    if count < 1:
        raise ConfigError(f"an ensemble of {count} cases", where="--cases", allowed="a whole number from 1")
    total = sum(weights.values())
    kept = {name: part / total for name, part in weights.items() if count * part / total >= _MIN_CASES_PER_EXPERIMENT}
    if not kept:
        kept = {max(weights, key=lambda name: weights[name]): 1.0}
    slots: list[tuple[str, float | None]] = []
    for category, number in _dealt(count, CATEGORY_SHARES).items():
        if category == "single":
            for size, times in _dealt(number, dict.fromkeys(DETECTABLE_MULTIPLES, 1.0)).items():
                slots += [(category, size)] * times
        else:
            slots += [(category, DETECTABLE_MULTIPLES[-1] if category in ("pair", "left_out") else None)] * number
    # the experiment that is furthest behind its part gets the next case, so that every sort is spread over all
    given = dict.fromkeys(kept, 0)
    cases = []
    slots.sort(
        key=lambda slot: slot[0] != "finer_chain"
    )  # what few can do comes first, so that the rest makes up for it
    for i, slot in enumerate(slots):
        able = [name for name in kept if slot[0] != "finer_chain" or name in chains]
        name = max(able or kept, key=lambda entry: kept[entry] * (i + 1) - given[entry])
        given[name] += 1
        cases.append((name, *(slot if able else ("single", DETECTABLE_MULTIPLES[1]))))
    order = np.random.default_rng([seed, ENSEMBLE_PURPOSES.index(purpose), 2]).permutation(count)
    return [PlannedCase(number, *cases[int(place)]) for number, place in enumerate(order)]


def _dealt(count: int, parts: Mapping[_Key, float]) -> dict[_Key, int]:
    """So many things in these proportions, by the largest remainders."""
    total = sum(parts.values())
    exact = {key: count * part / total for key, part in parts.items()}
    found = {key: int(value) for key, value in exact.items()}
    for key in sorted(exact, key=lambda key: found[key] - exact[key])[: count - sum(found.values())]:
        found[key] += 1
    return found
