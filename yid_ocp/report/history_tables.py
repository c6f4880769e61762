"""Table rows and sentences that compare runs: baseline, counterfactual prediction, run history."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from yid_ocp.report.summary_blocks import TableRows


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
