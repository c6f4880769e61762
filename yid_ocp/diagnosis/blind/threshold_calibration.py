"""Calibration of thresholds from an ensemble with known labels: quantiles over clean cases and true effects.

With n values of a statistic on cases of one kind, a further such case stays at or below the k-th smallest of them with
probability k/(n + 1) at least (split conformal prediction: Vovk, Gammerman and Shafer 2005, doi:10.1007/b106715).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from yid_ocp.diagnosis.blind.ensemble import CaseLabel
from yid_ocp.diagnosis.blind.score import OUT_OF_LIBRARY_CATEGORIES, CaseScore, binomial_proportion
from yid_ocp.diagnosis.thresholds import DEFAULT_THRESHOLDS, Thresholds

_FORMAT = "yid-calibration/1"
_TARGET_COVERAGE = 0.95
"""Fraction of the cases that a threshold is to leave on their side."""

_Statistics = Mapping[str, Any]


def permissive_thresholds(limits: Thresholds) -> Thresholds:
    """Return thresholds by which any residual is a gap and the best candidate is always added.

    A diagnosis of clean recordings with these shows how far chance alone goes.
    """
    sure = 1.0 + 1e-9
    limits = replace(
        limits,
        significance_level=sure,
        candidate_significance_level=sure,
        unexplained_p_factor=1.0,
        min_excess_chi2=-1.0,
        min_channel_excess_chi2=-1.0,
    )
    return replace(
        limits,
        min_log_bayes_factor=1e-9,
        max_unknown_groups=1,
        min_gap_closed=-math.inf,
        min_rmse_reduction=-math.inf,
        max_effects=1,
    )


@dataclass(frozen=True)
class _CalibrationRule:
    """Rule that derives one threshold from a statistic of the cases.

    Attributes
    ----------
    setting : str
        Of `diagnosis`.
    statistic : callable
        Of `diagnosis.threshold_statistics`, the thresholds of the diagnosis and the true effect's label; -inf where the case did
        not come to it.
    words : str
        What it is.
    of : {'clean', 'named', 'refitted'}
        Cases whose quantile it is: clean recordings, single effects that were named right, or those that were refitted.
    side : {'most', 'least'}
        Whether these cases are to stay below the threshold or above it.
    limit : float
        Of use, whatever the cases show: less is not worth a name, or odds that convince nobody; where `side` is
        'least', more than anybody asks.
    """

    setting: str
    statistic: Callable[[_Statistics, Thresholds, str], float]
    words: str
    of: Literal["clean", "named", "refitted"]
    side: Literal["most", "least"]
    limit: float


def _excess(said: _Statistics, limits: Thresholds, _: str) -> float:
    """chi2/n - 1 by which a residual counts as a gap, if it is significant at all."""
    if said["chi2_per_dof"] is None:
        return math.inf  # it could not be followed at all
    return float(said["chi2_per_dof"]) - 1 if said["p_value"] < limits.significance_level else -math.inf


def _along(said: _Statistics, limits: Thresholds, _: str) -> float:
    """That of the worst channel, if any candidate is significant."""
    return (
        (said["largest_channel"] or 1.0) - 1 if said["candidate"] < limits.candidate_significance_level else -math.inf
    )


def _of(name: str) -> Callable[[_Statistics, Thresholds, str], float]:
    return lambda said, limits, truth: -math.inf if said.get(name) is None else float(said[name])


def _rivals(said: _Statistics, limits: Thresholds, truth: str) -> Mapping[str, _Statistics]:
    """Effects refitted alone that leave little but noise, if the true one does: likelihood tells only these apart."""
    found = {
        label: own
        for label, own in said["behind"].items()
        if own["left"] is not None and own["left"] < 1 + limits.min_excess_chi2
    }
    return found if truth in found else {}


def _odds(said: _Statistics, limits: Thresholds, truth: str) -> float:
    """Log odds of the likeliest effect alone against the true one alone."""
    known = {label: own["squares"] for label, own in _rivals(said, limits, truth).items()}
    return 0.5 * (known[truth] - min(known.values())) if known else -math.inf


def _lost(said: _Statistics, limits: Thresholds, truth: str) -> float:
    """Held-out chi2/n by which the true effect alone is behind the best one alone, where that is beyond chance."""
    known = _rivals(said, limits, truth)
    if not known:
        return -math.inf
    own, best = known[truth], min(known.values(), key=lambda entry: float(entry["left"]))
    lost = float(own["chi2_per_dof"] - best["chi2_per_dof"])
    # both are said beside the first, one of which they are as a rule
    return lost if lost > math.hypot(own["error"], best["error"]) else 0.0


_CALIBRATION_RULES: Mapping[str, _CalibrationRule] = {
    "gap": _CalibrationRule("min_excess_chi2", _excess, "chi2/n - 1 of a significant residual", "clean", "most", 0.1),
    "candidate": _CalibrationRule(
        "candidate_significance_level", _of("candidate"), "p of the best candidate", "clean", "least", 1e-4
    ),
    "channel": _CalibrationRule(
        "min_channel_excess_chi2", _along, "the same of the worst channel, along a candidate", "clean", "most", 0.02
    ),
    "evidence": _CalibrationRule(
        "min_log_bayes_factor", _of("evidence"), "rise of the log evidence by the best place", "clean", "most", 5.0
    ),
    "rival": _CalibrationRule(
        "min_log_bayes_factor", _odds, "log odds of the likeliest effect against the truth", "refitted", "most", 5.0
    ),
    "closure": _CalibrationRule(
        "min_gap_closed", _of("closure_low"), "lower end of the closure by the best effect", "clean", "most", 0.05
    ),
    "relevance": _CalibrationRule(
        "min_rmse_reduction", _of("fall"), "part of a held-out error taken away by it", "clean", "most", 0.01
    ),
    "explained": _CalibrationRule(
        "min_explained_fraction", _of("explained"), "part of the smoother's explanation", "named", "least", 0.75
    ),
    "carried": _CalibrationRule(
        "transfer_z_max", _of("carried"), "standard deviations between recordings", "named", "most", 3.0
    ),
    "tie": _CalibrationRule(
        "chi2_equivalence",
        _lost,
        "held-out chi2/n by which the truth is behind the best effect, beyond a standard error",
        "refitted",
        "most",
        0.001,
    ),
}
"""All rules, by what they look at."""


def _conformal_quantile(
    sample: Sequence[float], side: Literal["most", "least"], coverage: float = _TARGET_COVERAGE
) -> tuple[float, float]:
    """Return the conformal quantile of a sample and its coverage.

    Parameters
    ----------
    sample : sequence of float
    side : {'most', 'least'}
    coverage : float
        Asked for.

    Returns
    -------
    value, coverage : float
        NaN and 0 without a sample; the extreme one and n/(n + 1) where there are too few for what is asked.
    """
    n = len(sample)
    if not n:
        return math.nan, 0.0
    ordered = sorted(sample) if side == "most" else sorted(sample, reverse=True)
    k = min(math.ceil((n + 1) * coverage - 1e-9), n)
    return ordered[k - 1], k / (n + 1)


def calibrate_thresholds(
    labels: Sequence[CaseLabel],
    marks: Sequence[CaseScore],
    answers: Sequence[Mapping[str, Any]],
    limits: Thresholds = DEFAULT_THRESHOLDS,
    coverage: float = _TARGET_COVERAGE,
) -> dict[str, Any]:
    """Return conformal quantiles for thresholds, and how each would treat the effects of the ensemble.

    Parameters
    ----------
    labels : sequence of Label
    marks : sequence of Mark
        Of the same cases.
    answers : sequence of mapping
        `result` of each, with its `threshold_statistics`, and those with open thresholds (`open`) where no gap was seen.
    limits : Thresholds
        By which they were given.
    coverage : float

    Returns
    -------
    dict
        `yid-calibration/1`.
    """
    cases = [
        (label, mark, said, _opened(entry))
        for label, mark, entry in zip(labels, marks, answers, strict=True)
        if (said := entry["result"].get("statistics")) is not None
    ]
    found = {}
    for name, rule in _CALIBRATION_RULES.items():
        clean = [rule.statistic(wide or said, limits, "") for label, _, said, wide in cases if label.category == "null"]
        true = [
            (mark.multiple, rule.statistic(said, limits, mark.truth))
            for label, mark, said, _ in cases
            if label.category == "single" and (mark.right or rule.of != "named")
        ]
        strange = [
            rule.statistic(said, limits, "")
            for label, _, said, _ in cases
            if label.category in OUT_OF_LIBRARY_CATEGORIES
        ]
        sample = clean if rule.of == "clean" else [value for _, value in true if value > -math.inf]
        value, attained = _conformal_quantile(sample, rule.side, coverage)
        sizes = sorted({size for size, _ in true})
        # what chance brings more of is what small values tell of
        sign = -1.0 if rule.of == "clean" and rule.side == "least" else 1.0
        beyond = {size: [sign * x > sign * value for s, x in true if s == size] for size in sizes}
        found[name] = {
            "setting": rule.setting,
            "statistic": rule.words,
            "of": rule.of,
            "side": rule.side,
            "cases": len(sample),
            "coverage": attained,
            "quantile": _number(value),
            "limit": rule.limit,
            "is": getattr(limits, rule.setting),
            "sample": [_number(entry) for entry in sorted(sample)],
            "effects_beyond": {f"{size:.3g}": binomial_proportion(hits) for size, hits in beyond.items()},
            "strange_beyond": binomial_proportion([sign * entry > sign * value for entry in strange]),
        }
    return {"format": _FORMAT, "asked": coverage, "rules": found, "settings": _recommended_settings(found)}


def _recommended_settings(rules: Mapping[str, Mapping[str, Any]]) -> dict[str, float]:
    """Return the recommended settings: quantiles rounded outwards to two digits, within each rule's limit.

    Parameters
    ----------
    rules : mapping
        Of `yid-calibration/1`.

    Returns
    -------
    dict of setting to value
    """
    settings: dict[str, float] = {}
    for own in rules.values():
        most, value, limit = own["side"] == "most", own["quantile"], float(own["limit"])
        if value is not None:
            outwards = _rounded(value, up=most)
            limit = max(limit, outwards) if most else min(limit, outwards)
        settings[own["setting"]] = max(limit, settings.get(own["setting"], limit))
    return settings


def _rounded(value: float, up: bool) -> float:
    """To two digits, up or down."""
    if value == 0:
        return 0.0
    digits = 1 - math.floor(math.log10(abs(value)))
    scaled = value * 10.0**digits
    whole = math.ceil(scaled - 1e-9) if up else math.floor(scaled + 1e-9)
    return round(whole / 10.0**digits, max(digits, 0))


def _opened(answer: Mapping[str, Any]) -> _Statistics | None:
    """Statistics with open thresholds, where there are any."""
    wide = answer.get("open")
    return wide if wide is not None and "p_value" in wide else None


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None
