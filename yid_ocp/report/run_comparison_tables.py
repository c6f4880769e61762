"""Table rows and sentences on several runs: batches, histories, baselines."""

from __future__ import annotations

import statistics
from collections.abc import Mapping
from typing import Any

from yid_ocp.report.terminal import TableRows
from yid_ocp.solvers.fit_messages import VERDICT_WORDS

MAX_TERMINAL_PARAMETERS = 6  # parameters that have a column of their own on a terminal; result.json has all


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


def baseline_rows(result: Mapping[str, Any]) -> TableRows:
    """Table rows of parameters in the baseline and now; only the header without a baseline."""
    rows: TableRows = [("parameter", "baseline", "now", "unit", "moved by", "")]
    found = result.get("baseline") or {"parameters": {}}
    for name, entry in found["parameters"].items():
        moved = "not informed" if entry["score"] is None else f"{entry['score']:+.2g} std"
        rows.append((
            name,
            _value(entry["before"], entry["before_std"]),
            _value(entry["now"], entry["now_std"]),
            entry["unit"],
            moved,
            "changed" if entry["changed"] else "",
        ))  # fmt: skip
    return rows


def counterfactual_rows(result: Mapping[str, Any]) -> TableRows:
    """Table rows of errors without the diagnosis and with effects removed or added; only the header without any."""
    rows: TableRows = [("channel", "made", "without a diagnosis", "effects removed or added", "unit")]
    found = result.get("counterfactual") or {}
    for key, made in (("removed", "without the effects"), ("added", "with the effects")):
        for channel, entry in found.get(key, {"rmse": {}})["rmse"].items():
            errors = (f"{entry[part]:.3g}" for part in ("without_diagnosis", "counterfactual"))
            rows.append((channel, made, *errors, entry["unit"]))
    return rows


def history_rows(result: Mapping[str, Any]) -> TableRows:
    """Table rows of the parameters of `yid-history/1`, one column per run."""
    runs = [entry["name"] for entry in result["runs"]]
    rows: TableRows = [("parameter", *runs, "together", "unit", "p", "")]
    for name, entry in result["parameters"].items():
        cells = [
            _value(entry["values"][run]["value"], entry["values"][run]["std"]) if run in entry["values"] else ""
            for run in runs
        ]
        p = "" if len(entry["values"]) < 2 else _p(entry["p_value"])
        together = _value(entry["mean"], entry["mean_std"])
        rows.append((name, *cells, together, entry["unit"], p, "drifted" if entry["drifted"] else ""))
    return rows


def run_consistency_rows(result: Mapping[str, Any]) -> TableRows:
    """Table rows that test each run of `yid-history/1` against all others."""
    rows: TableRows = [("run", "differs from the others", "p", "most in", "model explains it", "")]
    for entry in result["runs"]:
        apart = f"chi2 {entry['chi2']:.3g} of {entry['degrees']}"
        said = "distrust" if entry["distrusted"] else ""
        explains = "yes" if entry["explains"] else "no"
        rows.append((entry["name"], apart, _p(entry["p_value"]), entry["worst"], explains, said))
    return rows


def history_sentences(result: Mapping[str, Any]) -> list[str]:
    """Sentences that summarise a `yid-history/1` result."""
    parameters, runs = result["parameters"], result["runs"]
    drifted = [name for name, entry in parameters.items() if entry["drifted"]]
    wrong = [entry["name"] for entry in runs if entry["distrusted"]]
    text = []
    if not drifted and result["p_value"] >= result["level"]:
        text.append(
            f"Nothing drifted: all {len(runs)} runs agree within what they state (p {_relation(result['p_value'])})."
        )
    elif not drifted:
        text.append(
            f"Together the runs differ (p {_relation(result['p_value'])}), though no parameter alone does: look at "
            "what they have in common."
        )
    for name in drifted:
        values = list(parameters[name]["values"].values())
        unit = parameters[name]["unit"]
        first, last = values[0]["value"], values[-1]["value"]
        text.append(
            f"{name} is not the same in all runs: {first:.4g} in the first, {last:.4g} {unit} in the last "
            f"(p {_relation(parameters[name]['p_value'])})."
        )
    if wrong:
        text.append(f"Distrust {' and '.join(wrong)}: without it the others agree, or agree far better.")
    elif drifted and len(runs) == 2:
        text.append("Two runs that differ do not say which of them to distrust; a third one would.")
    elif drifted:
        text.append("No single run stands apart from the others.")
    poor = [entry["name"] for entry in runs if not entry["explains"]]
    if poor:
        text.append(
            f"The model did not explain the recordings of {', '.join(poor)}: the ± there counts the misfit and may "
            "still be too small."
        )
    return text


def _value(value: float, std: float | None) -> str:
    return f"{value:.4g}" + ("" if std is None else f" ± {std:.2g}")


def _p(value: float) -> str:
    return f"{value:.2g}" if value > 1e-12 else "< 1e-12"


def _relation(value: float) -> str:
    return f"= {value:.2g}" if value > 1e-12 else "< 1e-12"
