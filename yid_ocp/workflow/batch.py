"""The command `batch`: one run for each configuration or recording, with a common table and report."""

from __future__ import annotations

import argparse
import glob
import itertools
import json
import logging
import math
import shlex
import shutil
import time
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from yid_ocp.analysis.run_estimates import assess_drift_and_outlier_runs
from yid_ocp.config.reader import load_config
from yid_ocp.display import NULL_PROGRESS, Progress, effect_entry_label
from yid_ocp.errors import ConfigError, OutputError, YidError, nearest_file_question
from yid_ocp.files import file_sha256, folder_error, to_json_types, write_strict_json
from yid_ocp.inference.uncertainty import verdict_by_relative_std
from yid_ocp.parallel import LOCAL_WORKER_CONFIG, Task, TaskResult, WorkerConfig, run_tasks
from yid_ocp.report.html import write_report, write_shared_plotly_script
from yid_ocp.report.sections import ReportData
from yid_ocp.version import installed_versions
from yid_ocp.workflow.command_runner import CommandOutcome, run_command_and_print, worker_config_from_arguments
from yid_ocp.workflow.diagnose import run_diagnose
from yid_ocp.workflow.run_folder import current_local_time_text
from yid_ocp.workflow.run_history import read_estimates, require_runs_of_one_model, run_drift_and_outliers_to_dict
from yid_ocp.workflow.run_inputs import input_files_by_name
from yid_ocp.workflow.solve import run_solve

_RUNS_FOLDER, _TASKS_FOLDER = "runs", "tasks"
_PARAMETER_KEYS = ("value", "std", "unit", "verdict")
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _BatchRun:
    """One run of a batch: its name (also of its folder), configuration file and overrides of settings (`a.b=c`)."""

    name: str
    config_file: Path
    overrides: tuple[str, ...]


def run_and_return_exit_code(arguments: argparse.Namespace) -> int:
    """Run the command `batch` and return its exit code."""
    members = batch_runs_from_configs(arguments.configs, arguments.recordings, arguments.overrides)
    workers = worker_config_from_arguments(arguments) or LOCAL_WORKER_CONFIG
    out = arguments.out or Path("runs") / f"batch-{time.strftime('%Y%m%d-%H%M%S')}"
    words = ["yid-ocp", "batch", *map(str, arguments.configs)]
    words += ["--recordings", arguments.recordings] if arguments.recordings else []
    words += ["--command", arguments.each, *(word for said in arguments.overrides for word in ("--set", said))]
    again = shlex.join([*words, "--out", str(out)])
    asked = (members, out, arguments.each, workers)
    return run_command_and_print(arguments, lambda shown: run_batch(*asked, shown, again))


def batch_runs_from_configs(
    configs: Sequence[str | Path], recordings: str | None = None, overrides: Sequence[str] = ()
) -> list[_BatchRun]:
    """List the runs of a batch: one per configuration or, with `recordings`, per configuration and recording.

    `recordings` is a pattern such as `fleet/*.h5` (`**`: any folders). Each run then estimates on one matching
    recording and has no held-out recording, unless `overrides` (`a.b=c` each) change this. Raises `ConfigError` if a
    configuration does not exist or is listed twice, or if no recording matches.
    """
    paths = [Path(config) for config in configs]
    for i, path in enumerate(paths):
        if not path.is_file():
            hint, what = nearest_file_question(path, "*.yaml") or "correct the path", "there is no such configuration"
            raise ConfigError(what, where=str(path), allowed="the path of an existing YAML file", hint=hint)
        if path.resolve() in [other.resolve() for other in paths[:i]]:
            what, allowed = f"the configuration {path.name} is given twice", "every configuration once"
            raise ConfigError(what, where=str(path), allowed=allowed, hint="leave one of the two out")
    entries = [(path.stem, path, tuple(overrides)) for path in paths]
    if recordings is not None:
        files = sorted(Path(match) for match in glob.glob(recordings, recursive=True) if Path(match).is_file())
        if not files:
            advice = "check the folder, and put the pattern in quotes, so that the shell does not expand it"
            allowed = f"a pattern such as 'fleet/*.h5' or 'fleet/**/*.h5', relative to {Path.cwd()}"
            what, where = "no recording matches the pattern", f"--recordings {recordings}"
            raise ConfigError(what, where=where, allowed=allowed, hint=advice)
        entries = []
        for path, file in itertools.product(paths, files):
            name = file.stem if len(paths) == 1 else f"{path.stem}-{file.stem}"
            estimate = f"recordings.estimate=[{json.dumps(str(file.resolve()))}]"
            entries.append((name, path, (estimate, "recordings.held_out=[]", *overrides)))
    members: dict[str, _BatchRun] = {}
    for stem, path, settings in entries:
        names = itertools.chain([stem], (f"{stem}-{number}" for number in itertools.count(2)))
        name = next(name for name in names if name not in members)
        members[name] = _BatchRun(name, path.resolve(), settings)
    return list(members.values())


def run_batch(
    members: Sequence[_BatchRun],
    out: str | Path,
    command: str = "solve",
    workers: WorkerConfig | Executor = LOCAL_WORKER_CONFIG,
    progress: Progress = NULL_PROGRESS,
    command_line: str = "",
) -> CommandOutcome[None]:
    """Run `command` (`solve` or `diagnose`) for each of `members`, from `batch_runs_from_configs`.

    Finished runs in the folder `out` are reused. The batch is successful if all runs are. docs/howto/workers.md has the
    files of the folder; its page shows `command_line`. Raises `OutputError` if `out` holds other files or cannot be
    created; `ParallelWorkError` as in `run_tasks`.
    """
    folder = _folder(Path(out))
    write_shared_plotly_script(folder)
    results: dict[str, TaskResult] = {}
    tasks = []
    for member in members:
        try:
            run = load_config(member.config_file, member.overrides)
            # input files beside the settings; their content counts, not their path
            inputs = sorted({path.absolute() for path in input_files_by_name(run).values()})
            for path in inputs:
                file_sha256(path)
        except YidError as error:
            results[member.name] = TaskResult(member.name, error=str(error))
            log.warning("the run %s is left out, because it cannot start: %s", member.name, error.what)
            continue
        own = {"name": member.name, "config": member.config_file, "settings": list(member.overrides)}
        more = {"inputs": inputs, "command": command, "folder": str(folder / _RUNS_FOLDER)}
        tasks.append(Task(member.name, own | more))
    progress.begin_stage(f"running `{command}` {len(tasks)} {'time' if len(tasks) == 1 else 'times'}")
    done = run_tasks(_run_batch_task, tasks, folder / _TASKS_FOLDER, workers, progress.report_parts_done)
    results |= {entry.name: entry for entry in done}
    entries = [_entry(results[member.name], folder) for member in members]
    result = {
        "format": "yid-batch/1",
        "command": command,
        "again": command_line,
        "runs": entries,
        "history": _history([folder / _RUNS_FOLDER / entry["name"] for entry in entries if entry["ok"]]),
        "date": current_local_time_text(),
        "versions": installed_versions(),
    }
    written: dict[str, Any] = to_json_types(result)
    write_strict_json(folder / "batch.json", written)
    progress.begin_stage("writing the report")
    about = f"{len(entries)} runs of {command} side by side."
    write_report(folder / "report.html", ReportData(folder.name, about, written))
    return CommandOutcome(folder, written, None, all(entry["ok"] for entry in entries))


def _run_batch_task(
    name: str, config: Path, settings: Sequence[str], inputs: Sequence[Path], command: str, folder: str
) -> dict[str, Any]:
    """Task: do one run in its folder, which is emptied first. Returns its status, parameters and effects as JSON."""
    del inputs  # part of the key of the result
    target = Path(folder) / name
    if target.exists():
        shutil.rmtree(target)
    run = load_config(config, settings)
    begun = time.perf_counter()
    if command == "diagnose":
        result = run_diagnose(run, target).result
        judged, fit = result["model"]["parameters"], result["gap"]["after"]
        status, ok, message = result["verdict"], True, result["summary"]
    else:
        result = run_solve(run, target).result
        judged, fit = result["parameters"], result["fit"]
        status, ok, message = result["status"], result["status"] == "converged", result["message"]
    free = {parameter: own for parameter, own in judged.items() if own.get("free", True)}
    parameters = {parameter: {key: own.get(key) for key in _PARAMETER_KEYS} for parameter, own in free.items()}
    for own in parameters.values():  # a diagnosis does not judge them
        std = math.inf if own["std"] is None else own["std"]
        own["verdict"] = own["verdict"] or verdict_by_relative_std(own["value"], std, abs(own["value"]))
    effects = [effect_entry_label(entry) for entry in result.get("effects", ())]
    found = {"status": status, "ok": ok, "message": message, "effects": effects, "parameters": parameters}
    found |= {key: fit.get(key) for key in ("chi2_per_dof", "explains")} | {"seconds": time.perf_counter() - begun}
    return dict(to_json_types(found))


def _entry(result: TaskResult, folder: Path) -> dict[str, Any]:
    place = f"{_RUNS_FOLDER}/{result.name}"
    own = {"name": result.name, "folder": place if (folder / place).is_dir() else None}
    if not result.error:
        return own | dict(result.value)
    failed = {"status": "error", "ok": False, "message": result.error, "chi2_per_dof": None}
    return own | failed | {"effects": [], "parameters": {}, "seconds": None}


def _history(folders: Sequence[Path]) -> dict[str, Any] | None:
    """Return drift and outlier tests (`yid-history/1`) of two or more runs of one model. None for other runs."""
    if len(folders) < 2:
        return None
    try:
        require_runs_of_one_model(folders)
        runs = [replace(read_estimates(folder), run_name=folder.name) for folder in folders]
        return run_drift_and_outliers_to_dict(assess_drift_and_outlier_runs(runs))
    except YidError:
        return None


def _folder(path: Path) -> Path:
    folder = path.expanduser().absolute()
    try:
        if folder.is_dir() and any(folder.iterdir()) and not (folder / _TASKS_FOLDER).is_dir():
            allowed = "a new name, an empty folder, or the folder of a batch to complete"
            what = "the folder has files, but not those of a batch"
            raise OutputError(what, where=str(folder), allowed=allowed, hint="choose another folder with --out")
        (folder / _RUNS_FOLDER).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise folder_error(error, folder, "the folder of the batch cannot be created") from error
    return folder
