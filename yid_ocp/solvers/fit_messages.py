"""Messages about fits and verdicts for the terminal, the report and the comparison of methods."""

from __future__ import annotations

import math
from collections.abc import Mapping

VERDICT_PREDICATES: Mapping[str, str] = {
    "fixed": "is fixed",
    "identifiable": "is found",
    "weak": "is weakly determined",
    "not_identifiable": "cannot be found",
    "at_bound": "is at its bound",
    "not_trusted": "is not to be trusted",
}
"""Sentence predicate for a parameter of each verdict."""
VERDICT_WORDS: Mapping[str, str] = {verdict: text.removeprefix("is ") for verdict, text in VERDICT_PREDICATES.items()}
"""Table text of each verdict."""


def fit_message(chi2_per_dof: float | None, explains: bool) -> str:
    """Sentence that tells whether a model explains its recordings, with advice where it does not."""
    if chi2_per_dof is None or chi2_per_dof != chi2_per_dof:
        return "whether the model explains the recordings is not known"
    size = f"chi2 per degree of freedom is {chi2_per_dof:.3g}"
    if explains:
        return f"the model explains the recordings to within their noise ({size})"
    said = f"the model does not explain the recordings ({size}, 1 is noise alone)"
    return f"{said}: no number is to be trusted; run `yid-ocp diagnose`"


def parameter_text(value: float, std: float | None, interval: tuple[float | None, float | None] | None) -> str:
    """Format a value with its 95 % interval, or else its standard deviation where the data inform it."""
    if interval is not None and interval != (None, None):
        return f"{value:.4g} ({interval_text(*interval)})"
    return f"{value:.4g}" if std is None else f"{value:.4g} ± {std:.2g}"


def finite_or_none(value: float) -> float | None:
    """Return a finite number unchanged, and None for an infinite or NaN one."""
    return value if math.isfinite(value) else None


def percent_text(part: float) -> str:
    """Format a fraction as a percentage with two digits, without exponents below 10000 %."""
    return f"{100 * part:.2g}" if 100 * part < 99.5 else f"{100 * part:.0f}" if part < 100 else f"{100 * part:.2g}"


def interval_text(lower: float | None, upper: float | None) -> str:
    """Format a 95 % interval, whose ends may be open."""
    if lower is None and upper is None:
        return "open"
    if lower is None:
        return f"below {upper:.4g}"
    return f"above {lower:.4g}" if upper is None else f"{lower:.4g} to {upper:.4g}"
