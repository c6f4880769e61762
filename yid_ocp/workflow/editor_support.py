"""The commands `schema` and `completion`: what editors and shells need to complete settings, commands and files."""

from __future__ import annotations

import argparse
import importlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from yid_ocp.errors import ConfigError, YidError

_EXPORT_FORMATS = ("mjcf", "urdf", "sdf", "yaml", "csv", "mcap")


def run(arguments: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    if arguments.command == "schema":
        from yid_ocp.config.schema import config_json_schema
        from yid_ocp.files import write_text

        text = json.dumps(config_json_schema(), indent=1)
        if arguments.out is not None:
            write_text(Path(arguments.out), text + "\n")
            text = arguments.out
    else:
        try:
            text = importlib.import_module("argcomplete").shellcode(["yid-ocp"], shell=arguments.shell).strip()
        except ImportError as error:
            what = "completion needs a package that is not installed"
            raise ConfigError(what, where="argcomplete", hint="pip install 'yid-ocp[completion]'") from error
    print(text)
    return 0


def print_shell_completions(parser: argparse.ArgumentParser) -> None:
    """Print completions for the calling shell and exit; does nothing without the package argcomplete."""
    try:
        library = importlib.import_module("argcomplete")
    except ImportError:
        return
    configurations, folders = library.FilesCompleter(("yaml", "yml")), library.DirectoriesCompleter()
    completers: Mapping[str, Callable[..., Any]] = {
        "config": configurations,
        "configs": configurations,
        "runs": folders,
        "baseline": folders,
        "source": library.FilesCompleter(("h5", "hdf5")),
        "format": library.ChoicesCompleter(_EXPORT_FORMATS),
        "overrides": _settings,
    }
    commands = next(action for action in parser._actions if isinstance(action, argparse._SubParsersAction))
    for command in commands.choices.values():
        for action in command._actions:
            if action.dest in completers and action.nargs != 0:
                action.completer = completers[action.dest]
    library.autocomplete(parser, always_complete_options="long")


def _settings(prefix: str, parsed_args: argparse.Namespace, **_: Any) -> list[str]:
    from yid_ocp.config.reader import settable_keys_with_prefix  # it takes a second, which no other completion needs

    given = getattr(parsed_args, "config", None) or next(iter(getattr(parsed_args, "configs", None) or ()), None)
    try:
        return settable_keys_with_prefix(prefix, given)
    except YidError:
        return settable_keys_with_prefix(prefix)
