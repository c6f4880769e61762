"""The command `export`: recordings as CSV or MCAP, predictions of a run as MCAP, models for other engines."""

from __future__ import annotations

import argparse
from pathlib import Path

from yid_ocp.data import read_recording
from yid_ocp.errors import ConfigError
from yid_ocp.export.csv import export_csv
from yid_ocp.export.manifest import FORMAT
from yid_ocp.export.mcap import export_mcap, recorded_signals
from yid_ocp.report.summaries import export_summary
from yid_ocp.report.terminal import lines, recording_summary
from yid_ocp.workflow.command import DONE, tell
from yid_ocp.workflow.export_model import FORMATS, export_model
from yid_ocp.workflow.export_signals import export_run_signals
from yid_ocp.workflow.import_recording import recording_result
from yid_ocp.workflow.progress import shown

MCAP = "mcap"


def run(arguments: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    source, form = Path(arguments.source), arguments.format
    if source.is_dir():
        if form == "csv":
            raise ConfigError(
                "a run is no table",
                where="--format csv",
                allowed=", ".join((*FORMATS, MCAP)),
                hint="export a recording, or the run's signals as mcap",
            )
        if form == MCAP:
            written, notes = export_run_signals(source, arguments.out)
            paths = [str(file) for file in written]
            result = {"format": FORMAT, "file": paths, "kind": form, "notes": notes}
            tell(arguments, result, lambda: notes, "\n".join(paths), "\n".join(paths))
            return DONE
        with shown(arguments) as progress:
            manifest = export_model(source, arguments.out, form or "mjcf", progress)
        tell(arguments, manifest, lambda: lines(export_summary(manifest)), arguments.out, arguments.out)
        return DONE
    if form not in (None, "csv", MCAP):
        raise ConfigError(
            f"{source.name} is no run folder",
            where=f"--format {form}",
            allowed=f"csv or {MCAP} of a recording; {', '.join(FORMATS)} of a run folder of `solve` or `diagnose`",
        )
    recording = read_recording(source, allow_nan_effort=True)
    result, notes = recording_result(recording), []
    if form == MCAP:
        files: tuple[Path, ...] = (Path(arguments.out) / f"{source.stem}.mcap",)
        shift = export_mcap(recorded_signals(recording), files[0])
        if shift:
            notes.append(f"{shift:g} s were added to all times, as stamps cannot be negative")
    else:
        files = export_csv(recording, arguments.out)
    paths = [str(file) for file in files]
    result |= {"format": FORMAT, "file": paths, "kind": form or "csv", "notes": [*result["notes"], *notes]}
    tell(arguments, result, lambda: [*notes, *recording_summary(recording)], "\n".join(paths), "\n".join(paths))
    return DONE
