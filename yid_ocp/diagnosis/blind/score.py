"""How answers compare with their labels, and the rates over an ensemble."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from yid_ocp.diagnosis.blind.ensemble import Label
from yid_ocp.effects import EFFECTS

FORMAT = "yid-blind/1"


@dataclass(frozen=True)
class Mark:
    """How one answer compares with its label.

    Attributes
    ----------
    case, category, truth, verdict, answer : str
    multiple : float
    gap : bool
        Whether a gap was reported.
    kind_first, kind_second, location_first : bool
        The true kind at the true place is first, or among the first two, of the candidates; the true place comes first.
    confusable : tuple of str
        Set that was named as not separable.
    right : bool
        As the verdict asks: no_gap of a clean one, the true effect alone or in a set of at most three, unknown at the
        right place outside the library.
    closure, best : float
        Held out, of what was added and of the true effects refitted.
    errors : dict of str to (float, bool)
        Relative error of every parameter of the true effect where it was added, and whether its 95 % interval has it.
    seconds : float
    """

    case: str
    category: str
    truth: str
    verdict: str
    answer: str
    multiple: float
    gap: bool
    kind_first: bool
    kind_second: bool
    location_first: bool
    confusable: tuple[str, ...]
    right: bool
    closure: float
    best: float
    errors: Mapping[str, tuple[float, bool]] = field(default_factory=dict)
    seconds: float = math.nan


def mark(label: Label, result: Mapping[str, Any], best: float = math.nan, seconds: float = math.nan) -> Mark:
    """Compare a `yid-diagnosis/1` result with its label.

    Parameters
    ----------
    label : Label
    result : mapping
    best : float
        Of `best_closure`.
    seconds : float
    """
    verdict = str(result["verdict"])
    named = [f"{e['kind']}@{e['location']}" for e in result["effects"]]
    listed = [f"{e['kind']}@{e['location']}" for e in result["which"]]
    groups = [tuple(f"{e['kind']}@{e['location']}" for e in group) for group in result["confusable"]]
    alike = next((group for group in groups if named and named[0] in group), ())
    true = [effect.label for effect in label.injected]
    places = [p["location"] for p in result["where"]]
    gap = verdict not in ("no_gap", "insufficient_data")
    located = bool(true) and bool(places) and places[0] in {effect.location for effect in label.injected}
    if label.category in ("null",):
        right = verdict == "no_gap"
    elif label.category in ("outside", "left_out"):
        right = verdict == "unknown" and located
    elif label.category == "pair":
        right = set(true) <= {*named, *alike}
    else:
        right = bool(true) and (named[:1] == true or (true[0] in alike and len(alike) <= 3))
    errors: dict[str, tuple[float, bool]] = {}
    for effect in label.injected:
        if effect.label not in named or effect.kind not in EFFECTS:
            continue
        entry = result["which"][listed.index(effect.label)]
        for name, value in effect.values.items():
            found = entry["parameters"].get(name, {})
            if found.get("value") is None or found.get("std") is None or not math.isfinite(value):
                continue
            miss = found["value"] - value
            errors[f"{effect.label}.{name}"] = (abs(miss) / max(abs(value), 1e-9), abs(miss) <= 1.96 * found["std"])
    closed = result["gap"]["closure"]
    return Mark(
        label.case,
        label.category,
        " + ".join(true) or "-",
        verdict,
        " + ".join(named) or "-",
        math.nan if label.multiple is None else label.multiple,
        gap,
        bool(true) and listed[:1] == true[:1],
        bool(true) and true[0] in listed[:2],
        located,
        alike,
        right,
        math.nan if closed is None else float(closed),
        best,
        errors,
        seconds,
    )


def score(marks: Sequence[Mark]) -> dict[str, Any]:
    """Rates over an ensemble; None where there was no case of the sort."""

    def rate(values: Sequence[bool | float]) -> float | None:
        return float(np.mean(values)) if len(values) else None

    singles = [m for m in marks if m.category == "single"]
    seen = [m for m in singles if m.gap]
    named = [m for m in seen if m.confusable]
    strange = [m for m in marks if m.category in ("outside", "left_out")]
    errors = [entry for m in singles for entry in m.errors.values()]
    relative = [m.closure / m.best for m in singles if m.best > 0 and math.isfinite(m.closure)]
    sizes = sorted({m.multiple for m in singles if math.isfinite(m.multiple)})
    return {
        "format": FORMAT,
        "cases": len(marks),
        "false_alarms": rate([m.gap for m in marks if m.category == "null"]),
        "detection": {
            f"{size:.3g}": {
                "cases": sum(m.multiple == size for m in singles),
                "gap": rate([m.gap for m in singles if m.multiple == size]),
                "right": rate([m.right for m in singles if m.multiple == size]),
            }
            for size in sizes
        },
        "kind_first": rate([m.kind_first for m in seen]),
        "kind_in_two": rate([m.kind_second for m in seen]),
        "location_first": rate([m.location_first for m in seen]),
        "confusable_covers": rate([m.truth in m.confusable for m in named]),
        "confusable_size": rate([len(m.confusable) for m in named]),
        "unknown_recall": rate([m.verdict == "unknown" for m in strange]),
        "unknown_location": rate([m.location_first for m in strange if m.gap]),
        "pairs_right": rate([m.right for m in marks if m.category == "pair"]),
        "closure_of_best": rate(relative),
        "parameter_error": None if not errors else float(np.median([e for e, _ in errors])),
        "interval_coverage": rate([inside for _, inside in errors]),
        "seconds": rate([m.seconds for m in marks if math.isfinite(m.seconds)]),
        "marks": [asdict(m) for m in marks],
    }
