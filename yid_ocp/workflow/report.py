"""The command `report`: compares runs of one model and tests for drifting parameters and outlier runs."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from yid_ocp.analysis.estimate_history import EstimateHistory, assess_drift
from yid_ocp.config.settings import RunSettings
from yid_ocp.errors import ConfigError
from yid_ocp.files import file_sha256
from yid_ocp.progress import NULL_PROGRESS, Progress
from yid_ocp.report.html import write_report
from yid_ocp.report.sections import ReportData
from yid_ocp.report.summaries import history_summary
from yid_ocp.version import installed_versions
from yid_ocp.workflow.baseline_runs import read_estimates, require_same_model
from yid_ocp.workflow.command_runner import CommandResult, run_and_print
from yid_ocp.workflow.run_folder import local_time_text, new_run_folder

_RESULT_FORMAT = "yid-history/1"


def run(arguments: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    return run_and_print(arguments, lambda shown: run_report(arguments.runs, arguments.out, shown), history_summary)


def run_report(
    folders: Sequence[str | Path], out: str | Path | None = None, progress: Progress = NULL_PROGRESS
) -> CommandResult:
    """Compare runs of one model and write `history.json` and report.html.

    Parameters
    ----------
    folders : sequence of str or Path
        Run folders of `solve` or `diagnose`, in the order of time; two or more.

    Raises
    ------
    ConfigError, DataError, OutputError
        Fewer than two runs, one given twice, runs of different models, or what `read_estimates` refuses.
    """
    paths = [Path(folder) for folder in folders]
    if len(paths) < 2:
        hint = "add the runs of other days"
        raise ConfigError("one run has no history", where="report", allowed="two or more run folders", hint=hint)
    twice = [str(path) for i, path in enumerate(paths) if path.resolve() in [p.resolve() for p in paths[:i]]]
    if twice:
        raise ConfigError("a run is given twice, and would count twice", where=twice[0], hint="list every run once")
    estimates = [read_estimates(path) for path in paths]
    require_same_model(paths)
    progress.begin_stage(f"comparing {len(paths)} runs")
    found = assess_drift(estimates)
    with new_run_folder(RunSettings(name="history"), out, "report") as folder:
        inputs = {str(path): file_sha256(path / "result.json") for path in paths}
        folder.log_event("start", command="report", versions=installed_versions(), inputs=inputs)
        again = shlex.join(["yid-ocp", "report", *map(str, folders)])
        made = {"command": again, "date": local_time_text(), "inputs": inputs, "versions": installed_versions()}
        result = history_result(found) | made
        written = folder.write_json_file("history.json", result)
        progress.begin_stage("writing the report")
        write_report(folder.path / "report.html", ReportData("history", "Runs of one model side by side.", written))
    return CommandResult(folder.path, written)


def history_result(found: EstimateHistory) -> dict[str, Any]:
    """`yid-history/1` without inputs and versions."""
    return {
        "format": _RESULT_FORMAT,
        "level": found.significance_level,
        "chi2": found.chi2,
        "degrees": found.degrees_of_freedom,
        "p_value": found.p_value,
        "runs": [
            {
                "name": entry.run_name,
                "chi2": entry.chi2,
                "degrees": entry.degrees_of_freedom,
                "p_value": entry.p_value,
                "worst": entry.worst_parameter,
                "explains": entry.is_fit_adequate,
                "distrusted": entry.is_outlier,
            }
            for entry in found.run_consistencies
        ],
        "parameters": {
            entry.name: {
                "unit": entry.unit,
                "values": {
                    run: {"value": value, "std": std}
                    for run, value, std in zip(entry.run_names, entry.values, entry.std, strict=True)
                },
                "mean": entry.mean,
                "mean_std": entry.mean_std,
                "chi2": entry.chi2,
                "p_value": entry.p_value,
                "drifted": entry.has_drifted,
            }
            for entry in found.parameter_drifts
        },
    }
