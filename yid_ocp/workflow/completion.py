"""The command `completion`: what makes a shell complete commands, options, files and settings."""

from __future__ import annotations

import argparse
import importlib
from collections.abc import Callable, Mapping
from typing import Any

from yid_ocp.errors import ConfigError, YidError

_EXPORT_FORMATS = ("mjcf", "urdf", "sdf", "yaml", "csv", "mcap")


def run(arguments: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    try:
        library = importlib.import_module("argcomplete")
    except ImportError as error:
        what = "completion needs a package that is not installed"
        raise ConfigError(what, where="argcomplete", hint="pip install 'yid-ocp[completion]'") from error
    print(library.shellcode(["yid-ocp"], shell=arguments.shell).strip())
    return 0


def complete_arguments(parser: argparse.ArgumentParser) -> None:
    """Print completions for the calling shell and exit; does nothing without the package argcomplete.

    Parameters
    ----------
    parser : ArgumentParser
        Of all commands.
    """
    try:
        library = importlib.import_module("argcomplete")
    except ImportError:
        return
    configurations = library.FilesCompleter(("yaml", "yml"))
    completers: Mapping[str, Callable[..., Any]] = {
        "config": configurations,
        "configs": configurations,
        "runs": library.DirectoriesCompleter(),
        "baseline": library.DirectoriesCompleter(),
        "source": library.FilesCompleter(("h5", "hdf5")),
        "format": library.ChoicesCompleter(_EXPORT_FORMATS),
        "overrides": _settings,
    }
    for command in _commands(parser):
        for action in command._actions:
            if action.dest in completers and action.nargs != 0:
                action.completer = completers[action.dest]  # type: ignore[attr-defined]
    library.autocomplete(parser, always_complete_options="long")


def _commands(parser: argparse.ArgumentParser) -> list[argparse.ArgumentParser]:
    group = next(action for action in parser._actions if isinstance(action, argparse._SubParsersAction))
    return list(group.choices.values())


def _settings(prefix: str, parsed_args: argparse.Namespace, **_: Any) -> list[str]:
    from yid_ocp.config.reader import settable_keys  # it takes a second, which no other completion needs

    given = getattr(parsed_args, "config", None) or next(iter(getattr(parsed_args, "configs", None) or ()), None)
    try:
        return settable_keys(prefix, given)
    except YidError:
        return settable_keys(prefix)
