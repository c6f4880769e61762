"""The command `report`: compares runs of one model and tests for drifting parameters and outlier runs."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from yid_ocp.analysis.history import History, history
from yid_ocp.config.settings import Run
from yid_ocp.errors import ConfigError
from yid_ocp.files import file_sha256
from yid_ocp.progress import SILENT, Progress
from yid_ocp.report.html import write_report
from yid_ocp.report.sections import Findings
from yid_ocp.report.summaries import history_summary
from yid_ocp.version import versions
from yid_ocp.workflow.baseline import read_estimates, refuse_unlike
from yid_ocp.workflow.command import DONE, carry_out
from yid_ocp.workflow.folder import new_run_folder, now

FORMAT = "yid-history/1"


@dataclass(frozen=True)
class ReportOutcome:
    """Result of `run_report`: the folder, contents of history.json and the history."""

    folder: Path
    result: dict[str, Any]
    history: History


def run(arguments: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    carry_out(lambda shown: run_report(arguments.runs, arguments.out, shown), history_summary, arguments)
    return DONE


def run_report(
    folders: Sequence[str | Path], out: str | Path | None = None, progress: Progress = SILENT
) -> ReportOutcome:
    """Compare runs of one model and write `history.json` and report.html.

    Parameters
    ----------
    folders : sequence of str or Path
        Run folders of `solve` or `diagnose`, in the order of time; two or more.
    out : str or Path, optional
        The folder to make; see `new_run_folder`.
    progress : Progress, optional

    Returns
    -------
    ReportOutcome

    Raises
    ------
    ConfigError, DataError, OutputError
        Fewer than two runs, one given twice, runs of different models, or what `read_estimates` refuses.
    """
    paths = [Path(folder) for folder in folders]
    if len(paths) < 2:
        raise ConfigError(
            "one run has no history",
            where="report",
            allowed="two or more run folders",
            hint="add the runs of other days",
        )
    twice = [str(path) for i, path in enumerate(paths) if path.resolve() in [p.resolve() for p in paths[:i]]]
    if twice:
        raise ConfigError("a run is given twice, and would count twice", where=twice[0], hint="list every run once")
    estimates = [read_estimates(path) for path in paths]
    refuse_unlike(paths)
    progress.stage(f"comparing {len(paths)} runs")
    found = history(estimates)
    with new_run_folder(Run(name="history"), out, "report") as folder:
        inputs = {str(path): file_sha256(path / "result.json") for path in paths}
        folder.log("start", command="report", versions=versions(), inputs=inputs)
        again = shlex.join(["yid-ocp", "report", *map(str, folders)])
        made = {"command": again, "date": now(), "inputs": inputs, "versions": versions()}
        result = history_result(found) | made
        written = folder.write_json("history.json", result)
        progress.stage("writing the report")
        write_report(folder.path / "report.html", Findings("history", "Runs of one model side by side.", written))
    return ReportOutcome(folder.path, written, found)


def history_result(found: History) -> dict[str, Any]:
    """`yid-history/1` without inputs and versions."""
    return {
        "format": FORMAT,
        "level": found.level,
        "chi2": found.chi2,
        "degrees": found.degrees,
        "p_value": found.p_value,
        "runs": [
            {
                "name": entry.run,
                "chi2": entry.chi2,
                "degrees": entry.degrees,
                "p_value": entry.p_value,
                "worst": entry.worst,
                "explains": entry.explains,
                "distrusted": entry.distrusted,
            }
            for entry in found.against
        ],
        "parameters": {
            entry.name: {
                "unit": entry.unit,
                "values": {
                    run: {"value": value, "std": std}
                    for run, value, std in zip(entry.runs, entry.values, entry.std, strict=True)
                },
                "mean": entry.mean,
                "mean_std": entry.mean_std,
                "chi2": entry.chi2,
                "p_value": entry.p_value,
                "drifted": entry.drifted,
            }
            for entry in found.parameters
        },
    }
