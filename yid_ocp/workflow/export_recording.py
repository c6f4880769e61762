"""The command `export`: a recording as CSV."""

from __future__ import annotations

import argparse

from yid_ocp.data import read_recording
from yid_ocp.export.csv import export_csv
from yid_ocp.report.terminal import recording_summary
from yid_ocp.workflow.command import DONE, print_lines


def run(arguments: argparse.Namespace) -> int:
    """The command."""
    recording = read_recording(arguments.recording, allow_nan_effort=True)
    files = export_csv(recording, arguments.out)
    if not arguments.quiet:
        print_lines(recording_summary(recording))
    print_lines([str(file) for file in files])
    return DONE
