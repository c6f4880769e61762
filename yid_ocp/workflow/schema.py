"""The command `schema`: the JSON Schema of configuration files, for editors."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from yid_ocp.config.schema import config_json_schema
from yid_ocp.files import write_text
from yid_ocp.workflow.command_runner import EXIT_DONE


def run(arguments: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    text = json.dumps(config_json_schema(), indent=1)
    if arguments.out is None:
        print(text)
        return EXIT_DONE
    write_text(Path(arguments.out), text + "\n")
    print(arguments.out)
    return EXIT_DONE
