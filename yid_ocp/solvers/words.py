"""A parameter's verdict in words: the one wording for the terminal, the report and the comparison of methods."""

from __future__ import annotations

from collections.abc import Mapping

PREDICATES: Mapping[str, str] = {
    "fixed": "is fixed",
    "identifiable": "is found",
    "weak": "is weakly determined",
    "not_identifiable": "cannot be found",
}
"""What is said of a parameter, by its verdict; see `yid_ocp.solvers.base.verdict`."""
VERDICT_WORDS: Mapping[str, str] = {verdict: text.removeprefix("is ") for verdict, text in PREDICATES.items()}
"""The same for the cell of a table."""
