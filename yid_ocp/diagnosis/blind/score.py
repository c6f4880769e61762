"""Scores of blind diagnoses against their labels, and rates over an ensemble."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
import scipy.stats

from yid_ocp.diagnosis.blind.ensemble import CaseLabel
from yid_ocp.diagnosis.blind.ensemble_plan import CATEGORY_SHARES
from yid_ocp.effects import EFFECTS

_FORMAT = "yid-blind/1"
_CATEGORIES = tuple(CATEGORY_SHARES)
OUT_OF_LIBRARY_CATEGORIES = ("outside", "left_out")
"""Categories whose true effect is not among the candidates."""
_MAX_CONFUSABLE_SET = 3
"""Largest confusable set that counts as correct."""
_VERDICTS = ("no_gap", "unknown", "insufficient_data", "effect", "confusable")


@dataclass(frozen=True)
class CaseScore:
    """Score of one diagnosis against its label.

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
        As the verdict asks: no_gap of a clean one, the true effect alone or in a set of at most three, each of a pair
        likewise, unknown at the right place outside the library.
    closure, best : float
        Held out, of what was added and of the true effects refitted.
    errors : dict of str to (float, bool)
        Relative error of every parameter of the true effect where it was added, and whether its 95 % interval has it.
    seconds : float
    experiment : str
    z : mapping of str to float
        (estimate - truth)/std of the same parameters.
    p_value : float
        Of the null test on the held-out recordings.
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
    experiment: str = ""
    z: Mapping[str, float] = field(default_factory=dict)
    p_value: float = math.nan

    @property
    def named(self) -> tuple[str, ...]:
        """Labels the diagnosis names: the confusable set, or the first effect added."""
        return self.confusable or tuple(self.answer.split(" + ")[:1])

    @property
    def sort(self) -> str:
        """The row of the confusion matrix: the kind of a single effect, else the category."""
        return self.truth.partition("@")[0] if self.category == "single" else self.category

    @property
    def said(self) -> str:
        """The column of the confusion matrix: kind of the first effect added, else the verdict."""
        return self.verdict if self.answer == "-" else self.answer.partition("@")[0]


def score_case(
    label: CaseLabel, result: Mapping[str, Any], best: float = math.nan, seconds: float = math.nan
) -> CaseScore:
    """Score a `yid-diagnosis/2` result against its label.

    Parameters
    ----------
    label : Label
    result : mapping
    best : float
        Of `best_possible_closure`.
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
        right = _found(true, named, groups)
    else:
        right = bool(true) and _found(true, named[:1], groups)
    errors: dict[str, tuple[float, bool]] = {}
    z: dict[str, float] = {}
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
            if found["std"] > 0:
                z[f"{effect.label}.{name}"] = miss / found["std"]
    closed, before = result["gap"]["closure"], result["gap"].get("before") or {}
    p_value = before.get("p_value")
    return CaseScore(
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
        label.experiment,
        z,
        math.nan if p_value is None else float(p_value),
    )


def _found(true: Sequence[str], named: Sequence[str], groups: Sequence[tuple[str, ...]]) -> bool:
    """Whether every true effect has one of its own among those named: itself, or one in a set of at most `_MAX_CONFUSABLE_SET` with it.

    A set that has two of them in it says one of the two.
    """
    if not true:
        return True
    sets = [
        {name, *(label for group in groups if name in group and len(group) <= _MAX_CONFUSABLE_SET for label in group)}
        for name in named
    ]
    return any(true[0] in own and _found(true[1:], [*named[:i], *named[i + 1 :]], groups) for i, own in enumerate(sets))


def binomial_proportion(hits: Sequence[bool]) -> dict[str, float | int | None]:
    """Return count, total, rate and its 95 % interval (Clopper and Pearson 1934, doi:10.1093/biomet/26.4.404).

    Parameters
    ----------
    hits : sequence of bool
    """
    count, total = sum(map(bool, hits)), len(hits)
    if not total:
        return {"count": 0, "of": 0, "rate": None, "low": None, "high": None}
    low = 0.0 if count == 0 else float(scipy.stats.beta.ppf(0.025, count, total - count + 1))
    high = 1.0 if count == total else float(scipy.stats.beta.ppf(0.975, count + 1, total - count))
    return {"count": count, "of": total, "rate": count / total, "low": low, "high": high}


def score_ensemble(marks: Sequence[CaseScore]) -> dict[str, Any]:
    """Return the rates over an ensemble; None for a rate without cases."""

    def mean(values: Sequence[float]) -> float | None:
        return float(np.mean(values)) if len(values) else None

    singles = [m for m in marks if m.category == "single"]
    seen = [m for m in singles if m.gap]
    named = [m for m in seen if m.answer != "-"]
    strange = [m for m in marks if m.category in OUT_OF_LIBRARY_CATEGORIES]
    pairs = [m for m in marks if m.category == "pair"]
    errors = [entry for m in singles for entry in m.errors.values()]
    relative = [m.closure / m.best for m in singles if m.best > 0 and math.isfinite(m.closure)]
    sizes = sorted({m.multiple for m in singles if math.isfinite(m.multiple)})
    shares = {
        "false_alarms": [m.gap for m in marks if m.category == "null"],
        "kind_first": [m.kind_first for m in seen],
        "kind_in_two": [m.kind_second for m in seen],
        "location_first": [m.location_first for m in seen],
        "sets_cover": [m.truth in m.named for m in named],
        "unknown_recall": [m.verdict == "unknown" for m in strange],
        **{
            f"unknown_{sort}": [m.verdict == "unknown" for m in strange if m.category == sort]
            for sort in OUT_OF_LIBRARY_CATEGORIES
        },
        "unknown_location": [m.location_first for m in strange if m.gap],
        "pairs_right": [m.right for m in pairs],
        "pairs_named": [set(m.truth.split(" + ")) <= set(m.answer.split(" + ")) for m in pairs],
        "interval_coverage": [inside for _, inside in errors],
    }
    intervals = {name: binomial_proportion(hits) for name, hits in shares.items()}
    detected = {}
    for size in sizes:
        own = [m for m in singles if m.multiple == size]
        hits = {"gap": [m.gap for m in own], "first": [m.gap and m.kind_first for m in own]}
        hits["right"] = [m.right for m in own]
        detected[f"{size:.3g}"] = {name: binomial_proportion(said) for name, said in hits.items()}
    return {
        "format": _FORMAT,
        "cases": len(marks),
        **{name: entry["rate"] for name, entry in intervals.items()},
        "intervals": intervals,
        "detection": {
            size: {"cases": own["gap"]["of"], **{name: entry["rate"] for name, entry in own.items()}}
            for size, own in detected.items()
        },
        "detection_intervals": detected,
        "set_size": mean([len(m.named) for m in named]),
        "closure_of_best": mean(relative),
        "parameter_error": None if not errors else float(np.median([e for e, _ in errors])),
        "seconds": mean([m.seconds for m in marks if math.isfinite(m.seconds)]),
        "experiments": _by_experiment(marks),
        "confusion": _confusion_matrix(marks),
        "calibration": _calibration_rates(marks),
        "marks": [asdict(m) for m in marks],
    }


def _by_experiment(marks: Sequence[CaseScore]) -> dict[str, dict[str, Any]]:
    """Cases, false alarms and right answers of every experiment."""
    found = {}
    for name in dict.fromkeys(m.experiment for m in marks):
        own = [m for m in marks if m.experiment == name]
        found[name] = {
            "cases": len(own),
            "false_alarms": binomial_proportion([m.gap for m in own if m.category == "null"]),
            "right": binomial_proportion([m.right for m in own if m.category not in ("null", "finer_chain")]),
        }
    return found


def _confusion_matrix(marks: Sequence[CaseScore]) -> dict[str, Any]:
    """Return the confusion matrix: true classes (rows), answers (columns) and counts."""
    rows = sorted({m.sort for m in marks}, key=lambda name: (name in _CATEGORIES, name))
    columns = sorted({m.said for m in marks}, key=lambda name: (name in _VERDICTS, name))
    counts = [[sum((m.sort, m.said) == (row, column) for m in marks) for column in columns] for row in rows]
    return {"true": rows, "said": columns, "counts": counts}


def _calibration_rates(marks: Sequence[CaseScore]) -> dict[str, Any]:
    """Return the empirical coverage of parameter intervals and of p-values of clean recordings.

    Of each nominal level: how many intervals of that level hold the truth, how many clean cases have a smaller p-value.
    """
    z = [abs(value) for m in marks if m.category == "single" for value in m.z.values()]
    p = [m.p_value for m in marks if m.category == "null" and math.isfinite(m.p_value)]
    levels = (0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99)
    quantiles = {level: float(scipy.stats.norm.ppf(0.5 * (1 + level))) for level in levels}
    return {
        "intervals": [{"level": a, **binomial_proportion([x <= quantiles[a] for x in z])} for a in levels],
        "p_values": [{"level": a, **binomial_proportion([x < a for x in p])} for a in (0.01, 0.05, 0.1, 0.2, 0.5)],
    }
