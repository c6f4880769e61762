"""The command `import`: CSV, rosbag or MCAP as a recording."""

from __future__ import annotations

import argparse

from yid_ocp.data import read_any, write_recording
from yid_ocp.report.terminal import recording_summary
from yid_ocp.workflow.command import DONE, print_lines


def run(arguments: argparse.Namespace) -> int:
    """The command."""
    recording = read_any(arguments.file)
    write_recording(recording, arguments.out)
    if not arguments.quiet:
        print_lines(recording_summary(recording))
    print(arguments.out if arguments.quiet else f"recording: {arguments.out}")
    return DONE
