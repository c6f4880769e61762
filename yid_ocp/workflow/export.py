"""The command `export`: a recording as CSV, the model of a run for other engines."""

from __future__ import annotations

import argparse
from pathlib import Path

from yid_ocp.data import read_recording
from yid_ocp.errors import ConfigError
from yid_ocp.export.csv import export_csv
from yid_ocp.report.summaries import export_summary
from yid_ocp.report.terminal import lines, recording_summary
from yid_ocp.workflow.command import DONE, print_lines
from yid_ocp.workflow.export_model import FORMATS, export_model
from yid_ocp.workflow.progress import shown


def run(arguments: argparse.Namespace) -> int:
    """The command."""
    source, form = Path(arguments.source), arguments.format
    if source.is_dir():
        if form == "csv":
            raise ConfigError(
                "a run's model is no table", where="--format csv", allowed=", ".join(FORMATS), hint="export a recording"
            )
        with shown(arguments.quiet) as progress:
            manifest = export_model(source, arguments.out, form or "mjcf", progress)
        if not arguments.quiet:
            print_lines(lines(export_summary(manifest)))
        print(arguments.out)
        return DONE
    if form not in (None, "csv"):
        raise ConfigError(
            f"{source.name} is no run folder", where=f"--format {form}", allowed="a run folder of `solve` or `diagnose`"
        )
    recording = read_recording(source, allow_nan_effort=True)
    files = export_csv(recording, arguments.out)
    if not arguments.quiet:
        print_lines(recording_summary(recording))
    print_lines([str(file) for file in files])
    return DONE
