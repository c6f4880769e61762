"""Verdicts and fits in words: the one wording for the terminal, the report and the comparison of methods."""

from __future__ import annotations

import math
from collections.abc import Mapping

PREDICATES: Mapping[str, str] = {
    "fixed": "is fixed",
    "identifiable": "is found",
    "weak": "is weakly determined",
    "not_identifiable": "cannot be found",
    "at_bound": "is at its bound",
    "not_trusted": "is not to be trusted",
}
"""What is said of a parameter, by its verdict; see `yid_ocp.solvers.judgement.verdict`."""
VERDICT_WORDS: Mapping[str, str] = {verdict: text.removeprefix("is ") for verdict, text in PREDICATES.items()}
"""The same for the cell of a table."""
REMEDY = "run `yid-ocp diagnose`"
"""What to do where the model does not explain the recordings."""


def fit_words(chi2_per_dof: float | None, explains: bool) -> str:
    """One sentence: whether a model explains its recordings, and what follows where it does not."""
    if chi2_per_dof is None or chi2_per_dof != chi2_per_dof:
        return "whether the model explains the recordings is not known"
    size = f"chi2 per degree of freedom is {chi2_per_dof:.3g}"
    if explains:
        return f"the model explains the recordings to within their noise ({size})"
    said = f"the model does not explain the recordings ({size}, 1 is noise alone)"
    return f"{said}: no number is to be trusted; {REMEDY}"


def parameter_words(value: float, std: float | None, interval: tuple[float | None, float | None] | None) -> str:
    """A value with what is known of it: an interval where there is one, else a standard deviation, else nothing.

    Parameters
    ----------
    value : float
    std : float, optional
        None where the data do not inform the value.
    interval : (float or None, float or None), optional
        95 %.
    """
    if interval is not None and interval != (None, None):
        return f"{value:.4g} ({interval_words(*interval)})"
    return f"{value:.4g}" if std is None else f"{value:.4g} ± {std:.2g}"


def finite(value: float) -> float | None:
    """A number, None where it is infinite or unknown, as a standard deviation is that nothing informs."""
    return value if math.isfinite(value) else None


def percent_words(part: float) -> str:
    """A part in per cent, to two digits, without a power of ten as far as people read numbers."""
    return f"{100 * part:.2g}" if 100 * part < 99.5 else f"{100 * part:.0f}" if part < 100 else f"{100 * part:.2g}"


def interval_words(lower: float | None, upper: float | None) -> str:
    """A 95 % interval, of which ends may be open."""
    if lower is None and upper is None:
        return "open"
    if lower is None:
        return f"below {upper:.4g}"
    return f"above {lower:.4g}" if upper is None else f"{lower:.4g} to {upper:.4g}"
