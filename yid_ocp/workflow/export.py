"""The command `export`: a recording as CSV, the model of a run for other engines."""

from __future__ import annotations

import argparse
from pathlib import Path

from yid_ocp.data import read_recording
from yid_ocp.errors import ConfigError
from yid_ocp.export.csv import export_csv
from yid_ocp.report.terminal import export_summary, recording_summary
from yid_ocp.workflow.command import DONE, tell
from yid_ocp.workflow.export_model import FORMAT, FORMATS, export_model
from yid_ocp.workflow.import_recording import recording_result
from yid_ocp.workflow.progress import shown


def run(arguments: argparse.Namespace) -> int:
    """The command."""
    source, form = Path(arguments.source), arguments.format
    if source.is_dir():
        if form == "csv":
            raise ConfigError(
                "a run's model is no table", where="--format csv", allowed=", ".join(FORMATS), hint="export a recording"
            )
        with shown(arguments) as progress:
            manifest = export_model(source, arguments.out, form or "mjcf", progress)
        tell(arguments, manifest, lambda: export_summary(manifest), arguments.out, arguments.out)
        return DONE
    if form not in (None, "csv"):
        raise ConfigError(
            f"{source.name} is no run folder", where=f"--format {form}", allowed="a run folder of `solve` or `diagnose`"
        )
    recording = read_recording(source, allow_nan_effort=True)
    files = [str(file) for file in export_csv(recording, arguments.out)]
    result = {"format": FORMAT, "file": files, "kind": "csv", **recording_result(recording)}
    tell(arguments, result, lambda: recording_summary(recording), "\n".join(files), "\n".join(files))
    return DONE
