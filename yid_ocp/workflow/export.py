"""The command `export`: recordings as CSV or MCAP, predictions of a run as MCAP, models for other engines."""

from __future__ import annotations

import argparse
from pathlib import Path

from yid_ocp.data import read_recording
from yid_ocp.errors import ConfigError
from yid_ocp.export.csv_tables import export_csv
from yid_ocp.export.format_support import EXPORT_FORMAT
from yid_ocp.export.mcap import export_mcap, signals_from_recording
from yid_ocp.report.summaries import export_summary
from yid_ocp.report.terminal import recording_summary_lines, terminal_lines
from yid_ocp.workflow.command_runner import EXIT_DONE, print_result, show_progress
from yid_ocp.workflow.export_model import MODEL_FORMATS, export_model
from yid_ocp.workflow.export_signals import export_run_signals
from yid_ocp.workflow.import_recording import recording_contents

_MCAP = "mcap"


def run(arguments: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    source, form = Path(arguments.source), arguments.format
    if source.is_dir():
        if form == "csv":
            hint = "export a recording, or the run's signals as mcap"
            raise ConfigError(
                "a run is no table", where="--format csv", allowed=", ".join((*MODEL_FORMATS, _MCAP)), hint=hint
            )
        if form == _MCAP:
            written, notes = export_run_signals(source, arguments.out)
            paths = [str(file) for file in written]
            result = {"format": EXPORT_FORMAT, "file": paths, "kind": form, "notes": notes}
            print_result(arguments, result, lambda: notes, "\n".join(paths), "\n".join(paths))
            return EXIT_DONE
        with show_progress(arguments) as progress:
            manifest = export_model(source, arguments.out, form or "mjcf", progress)
        print_result(
            arguments, manifest, lambda: terminal_lines(export_summary(manifest)), arguments.out, arguments.out
        )
        return EXIT_DONE
    if form not in (None, "csv", _MCAP):
        allowed = f"csv or {_MCAP} of a recording; {', '.join(MODEL_FORMATS)} of a run folder of `solve` or `diagnose`"
        raise ConfigError(f"{source.name} is no run folder", where=f"--format {form}", allowed=allowed)
    recording = read_recording(source, allow_nan_effort=True)
    result, notes = recording_contents(recording), []
    if form == _MCAP:
        files: tuple[Path, ...] = (Path(arguments.out) / f"{source.stem}.mcap",)
        shift = export_mcap(signals_from_recording(recording), files[0])
        if shift:
            notes.append(f"{shift:g} s were added to all times, as stamps cannot be negative")
    else:
        files = export_csv(recording, arguments.out)
    paths = [str(file) for file in files]
    result |= {"format": EXPORT_FORMAT, "file": paths, "kind": form or "csv", "notes": [*result["notes"], *notes]}
    print_result(
        arguments, result, lambda: [*notes, *recording_summary_lines(recording)], "\n".join(paths), "\n".join(paths)
    )
    return EXIT_DONE
