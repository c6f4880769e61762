"""Table rows and sentences that summarise a batch of runs."""

from __future__ import annotations

import statistics
from collections.abc import Mapping
from typing import Any

from yid_ocp.report.summary_blocks import TableRows
from yid_ocp.solvers.fit_messages import VERDICT_WORDS

MAX_TERMINAL_PARAMETERS = 6
"""Parameters that have a column of their own on a terminal; result.json has all."""


_FOUND_VERDICTS = ("identifiable", "weak", None)
"""Verdicts of parameters whose values count; a diagnosis gives its parameters none."""


def batch_rows(result: Mapping[str, Any], max_parameters: int | None = None) -> TableRows:
    """Table rows of the runs of `yid-batch/1`; at most `max_parameters` parameters, the most common first."""
    names = _parameters(result)[:max_parameters]
    units = {name: unit for entry in result["runs"] for name, (_, _, unit, _) in _values(entry).items()}
    heads = [f"{name} [{units[name]}]" if units[name] else name for name in names]
    rows: TableRows = [("run", "status", "chi2/n", "effects", *heads, "time")]
    for entry in result["runs"]:
        known = _values(entry)
        fit = "" if entry["chi2_per_dof"] is None else f"{entry['chi2_per_dof']:.3g}"
        cells = [_cell(*known[name]) if name in known else "" for name in names]
        time = "" if entry["seconds"] is None else f"{entry['seconds']:.1f} s"
        rows.append((entry["name"], entry["status"], fit, ", ".join(entry["effects"]), *cells, time))
    return rows


def parameter_spread_rows(result: Mapping[str, Any]) -> TableRows:
    """Table rows with median and range of every parameter found in at least two runs."""
    rows: TableRows = [("parameter", "runs", "smallest", "median", "largest", "unit")]
    for name in _parameters(result):
        entries = [_values(entry)[name] for entry in result["runs"] if name in _values(entry)]
        found = [value for value, _, _, verdict in entries if verdict in _FOUND_VERDICTS]
        if len(found) > 1:
            numbers = (min(found), statistics.median(found), max(found))
            rows.append((name, str(len(found)), *(f"{x:.4g}" for x in numbers), entries[0][2]))
    return rows


def batch_sentences(result: Mapping[str, Any]) -> list[str]:
    """Sentences on the status of the runs, failures and drifting parameters."""
    runs = result["runs"]
    ended: dict[str, int] = {}
    for entry in runs:
        ended[entry["status"]] = ended.get(entry["status"], 0) + 1
    said = ", ".join(f"{count} {status}" for status, count in ended.items())
    text = [f"{len(runs)} {'run' if len(runs) == 1 else 'runs'}: {said}."]
    text += [f"{entry['name']}: {entry['message'].splitlines()[0]}." for entry in runs if not entry["ok"]]
    alike = result["history"]
    if alike is not None:
        drifted = [name for name, entry in alike["parameters"].items() if entry["drifted"]]
        wrong = [entry["name"] for entry in alike["runs"] if entry["distrusted"]]
        text.append(
            f"{', '.join(drifted)} {'is' if len(drifted) == 1 else 'are'} not the same in all runs."
            if drifted
            else "No parameter differs among the runs by more than they state."
        )
        text += [f"Distrust {', '.join(wrong)}: without it the others agree, or agree far better."] if wrong else []
    return text


def _parameters(result: Mapping[str, Any]) -> list[str]:
    counts: dict[str, int] = {}
    for entry in result["runs"]:
        for name in _values(entry):
            counts[name] = counts.get(name, 0) + 1
    return sorted(counts, key=lambda name: -counts[name])


def _values(entry: Mapping[str, Any]) -> dict[str, tuple[float, float | None, str, str | None]]:
    """Value, standard deviation, unit and verdict of every free parameter of a run."""
    return {
        name: (own["value"], own["std"], own["unit"], own["verdict"])
        for name, own in entry["parameters"].items()
        if own["value"] is not None
    }


def _cell(value: float, std: float | None, unit: str, verdict: str | None) -> str:
    if verdict in _FOUND_VERDICTS:
        return f"{value:.4g}" + ("" if std is None else f" ± {std:.2g}")
    return VERDICT_WORDS[str(verdict)]
