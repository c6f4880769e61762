"""The command `blind`: diagnoses synthetic cases without their labels, then opens the labels and scores."""

from __future__ import annotations

import argparse
import json
import logging
import math
import shlex
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict
from pathlib import Path
from typing import Any

from yid_ocp.config.reader import DEFAULT_CONFIG, DEFAULT_DIAGNOSIS_CONFIG, load_config
from yid_ocp.config.settings import RunSettings, dump_config
from yid_ocp.data.recording_hdf5 import read_recording, write_recording
from yid_ocp.diagnosis.blind import (
    ENSEMBLE_PURPOSES,
    BlindCase,
    CaseLabel,
    PlannedCase,
    best_possible_closure,
    calibrate_thresholds,
    diagnose_case,
    open_sealed_labels,
    permissive_thresholds,
    plan_cases,
    score_case,
    score_ensemble,
    seal_labels,
)
from yid_ocp.diagnosis.diagnosis_result import threshold_statistics
from yid_ocp.errors import ConfigError, OutputError, YidError
from yid_ocp.files import to_json_types, write_json, write_text
from yid_ocp.parallel import LOCAL_WORKERS, Task, WorkerConfig, require_task_values, run_tasks
from yid_ocp.progress import NULL_PROGRESS, Progress
from yid_ocp.report.diagnosis_summaries import blind_markdown
from yid_ocp.report.html import write_report
from yid_ocp.report.png_figures import draw_blind_results
from yid_ocp.report.sections import ReportData
from yid_ocp.report.summaries import blind_summary
from yid_ocp.version import installed_versions, package_source_hash
from yid_ocp.workflow.blind_experiments import (
    EXPERIMENT_VARIATIONS,
    BlindExperiment,
    list_experiments,
    require_blind_compatible,
)
from yid_ocp.workflow.command_runner import CommandResult, run_and_print, workers_from_arguments
from yid_ocp.workflow.run_folder import local_time_text

_COMMITMENT_FILE, _LABELS_FILE, _RESULT_FILE, _TABLE_FILE = (
    "commitment.json",
    "sealed/labels.json",
    "result.json",
    "table.md",
)
_THRESHOLDS_FILE = "thresholds.json"
_CONFIGS_FOLDER, _PREPARED_FOLDER, _DRAWN_FOLDER, _CASES_FOLDER, _ANSWERS_FOLDER, _BEST_FOLDER = (
    "configs",
    "prepared",
    "sealed/drawn",
    "cases",
    "answers",
    "best",
)
_MIN_TWO_ARM_CASES = 100  # cases from which the embedded proof has experiments with two arms as well
log = logging.getLogger(__name__)


def run(arguments: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    given = arguments.configs or [None]
    runs = [load_config(path, arguments.overrides, DEFAULT_DIAGNOSIS_CONFIG) for path in given]
    if not arguments.configs and arguments.cases >= _MIN_TWO_ARM_CASES:
        runs.append(load_config(None, arguments.overrides, DEFAULT_CONFIG))
    workers = workers_from_arguments(arguments) or LOCAL_WORKERS
    purpose = ENSEMBLE_PURPOSES[int(arguments.calibration)]
    out = arguments.out or f"{runs[0].name}-blind-{'calibration-' if arguments.calibration else ''}{arguments.seed}"

    def proved(shown: Progress) -> CommandResult:
        return run_blind(runs, out, arguments.cases, arguments.seed, shown, workers, purpose)

    return run_and_print(arguments, proved, blind_summary)


def run_blind(
    runs: Sequence[RunSettings],
    out: str | Path,
    count: int = 20,
    seed: int = 1,
    progress: Progress = NULL_PROGRESS,
    workers: WorkerConfig | Executor = LOCAL_WORKERS,
    purpose: str = ENSEMBLE_PURPOSES[0],
) -> CommandResult:
    """Run a blind validation of the diagnosis in several processes; finished parts in the folder are reused.

    Parameters
    ----------
    runs : sequence of RunSettings
        Configurations: models, posture and sensors of their first recordings, `diagnosis.candidates`. Each is varied
        (`workflow.blind_experiments.EXPERIMENT_VARIATIONS`) as far as there are cases for it.
    out : str or Path
        Folder: `configs/`, `prepared/` (what is detectable in every experiment), `cases/` (recordings),
        `sealed/labels.json`, `commitment.json` (hash of the labels, written before the first diagnosis, and of the
        sources that made the cases), `answers/` and `best/` (results of tasks, see `yid_ocp.parallel`), then
        `result.json` (`yid-blind/1`), `table.md` and pictures; of an ensemble to calibrate by `thresholds.json`
        (`yid-calibration/1`).
    count : int
        Number of cases.
    purpose : {'report', 'calibration'}
        The same seed draws other cases for each.

    Raises
    ------
    ConfigError, DataError, ModelError, SolverError, WorkerError
    OutputError
        The folder holds another ensemble.
    """
    folder = Path(out).absolute()
    if count < 1:
        raise runs[0].config_error(f"an ensemble of {count} cases", "diagnosis", hint="give --cases from 1")
    if seed < 0:
        raise ConfigError(f"seed = {seed}", where="--seed", allowed="a whole number from 0")
    for entry in runs:
        require_blind_compatible(entry)
    try:
        cases = _made(_named(runs), folder, count, seed, progress, workers, purpose)
        progress.begin_stage(f"diagnosing {count} cases")
        answers = _done(diagnose_case_task, cases, folder / _ANSWERS_FOLDER, workers, progress)
        commitment = json.loads((folder / _COMMITMENT_FILE).read_text("utf-8"))
        labels = open_sealed_labels((folder / _LABELS_FILE).read_text("utf-8"), commitment["sha256"])
        progress.begin_stage("scoring")
        best = _best(cases, labels, answers, folder, progress, workers)
    except KeyboardInterrupt:
        log.warning("finished cases are in %s; the same command goes on with the others", folder)
        raise
    marks = [
        score_case(label, found["result"], best.get(label.case, math.nan), float(found["seconds"]))
        for label, found in zip(labels, answers, strict=True)
    ]
    files = [folder / _CONFIGS_FOLDER / f"{entry.name}.yaml" for entry in runs]
    flags = ["--cases", count, "--seed", seed, *(["--calibration"] if purpose == ENSEMBLE_PURPOSES[1] else [])]
    again = shlex.join(["yid-ocp", "blind", *map(str, files), *map(str, flags)])
    result = score_ensemble(marks) | {
        "seed": seed,
        "purpose": purpose,
        "code": package_source_hash(),
        "code_of_cases": commitment["code"],
        "command": again,
        "date": local_time_text(),
        "versions": installed_versions(),
        "candidates": {entry.name: entry.diagnosis.candidates for entry in runs},
        "variations": {name: varied.description for name, varied in EXPERIMENT_VARIATIONS.items()},
    }
    if purpose == ENSEMBLE_PURPOSES[1]:
        found = calibrate_thresholds(labels, marks, answers, runs[0].diagnosis)
        result["calibration_of_thresholds"] = found
        made = {key: result[key] for key in ("cases", "seed", "code", "code_of_cases", "command", "date", "versions")}
        write_json(folder / _THRESHOLDS_FILE, to_json_types(found | made))
    return _write_outcome(folder, result, runs, progress)


def _write_outcome(
    folder: Path, result: Mapping[str, Any], runs: Sequence[RunSettings], progress: Progress
) -> CommandResult:
    written = to_json_types(result)
    write_json(folder / _RESULT_FILE, written)
    write_text(folder / _TABLE_FILE, "\n".join(blind_markdown(written)) + "\n")
    draw_blind_results(folder, written)
    if all(entry.output.write_report for entry in runs):
        progress.begin_stage("writing the report")
        said = f"{written['cases']} virtual cases whose effect was withheld, diagnosed, then opened."
        write_report(folder / "report.html", ReportData(folder.name, said, written))
    return CommandResult(folder, written)


# -- the ensemble -----------------------------------------------------------------------------------------------------


def _named(runs: Sequence[RunSettings]) -> dict[str, RunSettings]:
    names = [entry.name for entry in runs]
    twice = [name for i, name in enumerate(names) if name in names[:i]]
    if twice:
        raise ConfigError(
            f"two configurations are called {twice[0]}", where="blind", hint="give each a name of its own"
        )
    return dict(zip(names, runs, strict=True))


def _made(
    runs: Mapping[str, RunSettings],
    folder: Path,
    count: int,
    seed: int,
    progress: Progress,
    workers: WorkerConfig | Executor,
    purpose: str,
) -> list[Task]:
    """The diagnosis of every case, of those in the folder or made now; labels are sealed before this returns."""
    commitment = folder / _COMMITMENT_FILE
    configs = {name: dump_config(entry) for name, entry in runs.items()}
    if not commitment.exists():
        _make(configs, folder, count, seed, progress, workers, purpose)
    said = json.loads(commitment.read_text("utf-8"))
    if (said["cases"], said["seed"], said["purpose"], said["configs"]) != (count, seed, purpose, configs):
        what = f"'{folder}' holds another ensemble ({said['cases']} cases, seed {said['seed']}, for {said['purpose']})"
        hint = "choose another folder, or the same configurations, --cases, --seed and --calibration"
        raise OutputError(what, where="--out", hint=hint)
    tasks = []
    for entry in json.loads((folder / _CASES_FOLDER / "cases.json").read_text("utf-8")):
        name = str(entry["name"])
        config, _, variation = str(entry["experiment"]).rpartition(".")
        arguments = {
            **BlindExperiment(folder / _CONFIGS_FOLDER / f"{config}.yaml", variation, seed, purpose).task_arguments,
            "first": folder / _PREPARED_FOLDER / f"{entry['experiment']}.h5",
            "name": name,
            "recordings": [folder / _CASES_FOLDER / file for file in (*entry["estimate"], entry["held_out"])],
        }
        tasks.append(Task(name, {**arguments, "without": entry["without"]}))
    return tasks


def _make(
    configs: Mapping[str, str],
    folder: Path,
    count: int,
    seed: int,
    progress: Progress,
    workers: WorkerConfig | Executor,
    purpose: str,
) -> None:
    """Draw the cases and commit to their labels."""
    try:
        for name in (_CONFIGS_FOLDER, _PREPARED_FOLDER, _CASES_FOLDER, _DRAWN_FOLDER):
            (folder / name).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"the folder cannot be made: {error}", where=str(folder)) from error
    for name, text in configs.items():
        write_text(folder / _CONFIGS_FOLDER / f"{name}.yaml", text)
    files = {name: folder / _CONFIGS_FOLDER / f"{name}.yaml" for name in configs}
    experiments, chains = list_experiments(files, seed, purpose)
    weights = {name: EXPERIMENT_VARIATIONS[entry.variation].case_fraction for name, entry in experiments.items()}
    plan = plan_cases(count, seed, weights, chains, purpose)
    used = [name for name in experiments if any(entry.experiment == name for entry in plan)]
    progress.begin_stage(f"preparing {len(used)} {'experiment' if len(used) == 1 else 'experiments'}")
    tasks = [
        Task(name, {**experiments[name].task_arguments, "folder": str(folder / _PREPARED_FOLDER), "name": name})
        for name in used
    ]
    _done(_prepare_experiment, tasks, folder / _PREPARED_FOLDER / "tasks", workers, progress)
    progress.begin_stage(f"making {count} cases")
    tasks = []
    for entry in plan:
        name = entry.experiment
        known = {
            "first": folder / _PREPARED_FOLDER / f"{name}.h5",
            "detectable": folder / _PREPARED_FOLDER / f"{name}.json",
        }
        wanted = {"planned": asdict(entry), "folder": str(folder / _CASES_FOLDER)}
        tasks.append(Task(f"case {entry.number}", {**experiments[name].task_arguments, **known, **wanted}))
    made = _done(draw_case, tasks, folder / _DRAWN_FOLDER, workers, progress)
    text, digest = seal_labels([CaseLabel.from_dict(entry["label"]) for entry in made])
    write_text(folder / _LABELS_FILE, text)
    write_json(folder / _CASES_FOLDER / "cases.json", [entry["case"] for entry in made])
    said = {"sha256": digest, "cases": count, "seed": seed, "purpose": purpose, "configs": dict(configs)}
    write_json(folder / _COMMITMENT_FILE, said | {"code": package_source_hash()})


# -- tasks ------------------------------------------------------------------------------------------------------------


def _done(
    function: Callable[..., Any],
    tasks: Sequence[Task],
    folder: Path,
    workers: WorkerConfig | Executor,
    progress: Progress,
) -> list[Any]:
    """What a function finds for each task; one experiment after the other, so that a worker builds each once."""
    order = sorted(range(len(tasks)), key=lambda i: [str(tasks[i].arguments[key]) for key in ("config", "variation")])
    found = require_task_values(
        run_tasks(function, [tasks[i] for i in order], folder, workers, progress.report_parts_done)
    )
    return [value for _, value in sorted(zip(order, found, strict=True), key=lambda pair: pair[0])]


def _prepare_experiment(
    config: Path, variation: str, seed: int, purpose: str, folder: str, name: str
) -> dict[str, int]:
    """Task: write an experiment's first recording and the detectable size of every candidate."""
    experiment = BlindExperiment(config, variation, seed, purpose)
    first = Path(folder) / f"{name}.h5"
    experiment.write_first_recording(first)
    _, ensemble = experiment.build_ensemble(first)
    detectable = [entry.to_dict() for entry in ensemble.detectable_effects]
    write_json(Path(folder) / f"{name}.json", detectable)
    return {"candidates": len(detectable)}


def draw_case(
    config: Path,
    variation: str,
    seed: int,
    purpose: str,
    first: Path,
    detectable: Path,
    planned: Mapping[str, Any],
    folder: str,
) -> dict[str, Any]:
    """Task: write the recordings of a case; returns its label and the data given to its diagnosis."""
    _, ensemble = BlindExperiment(config, variation, seed, purpose).build_ensemble(first)
    ensemble.load_detectable_effects(json.loads(detectable.read_text("utf-8")))
    case, label = ensemble.draw_case(PlannedCase(**planned))
    for recording in (*case.estimation_recordings, case.held_out_recording):
        write_recording(recording, Path(folder) / f"{recording.name}.h5")
    told = {
        "name": case.name,
        "experiment": planned["experiment"],
        "estimate": [f"{recording.name}.h5" for recording in case.estimation_recordings],
        "held_out": f"{case.held_out_recording.name}.h5",
        "without": list(case.excluded_kinds),
    }
    found: dict[str, Any] = to_json_types({"label": label.to_dict(), "case": told})
    return found


def diagnose_case_task(
    config: Path,
    variation: str,
    seed: int,
    purpose: str,
    first: Path,
    name: str,
    recordings: Sequence[Path],
    without: Sequence[str],
) -> dict[str, Any]:
    """Task: diagnose a case from its recordings, the last one held out; returns {seconds, result}.

    For calibration, one without a gap has `open` too: the statistics of a diagnosis that takes anything for a gap.
    """
    run, ensemble = BlindExperiment(config, variation, seed, purpose).build_ensemble(first)
    case = _case(name, recordings, without)
    begun = time.perf_counter()
    try:
        result = diagnose_case(ensemble, case, run.diagnosis.candidates, run.diagnosis).to_dict()
    except YidError as error:
        result = _nothing(str(error))
    found: dict[str, Any] = to_json_types({"seconds": time.perf_counter() - begun, "result": result})
    if purpose == ENSEMBLE_PURPOSES[1] and result["verdict"] == "no_gap":
        anything = permissive_thresholds(run.diagnosis)
        try:
            found["open"] = to_json_types(
                threshold_statistics(diagnose_case(ensemble, case, run.diagnosis.candidates, anything))
            )
        except YidError as error:
            found["open"] = {"message": str(error)}
    return found


def _true_effect_closure(
    config: Path,
    variation: str,
    seed: int,
    purpose: str,
    first: Path,
    name: str,
    recordings: Sequence[Path],
    label: Mapping[str, Any],
) -> float | None:
    """Task: fraction of a case's gap closed by its refitted true effects; None where it cannot be computed."""
    run, ensemble = BlindExperiment(config, variation, seed, purpose).build_ensemble(first)
    case = _case(name, recordings, ())
    try:
        best = best_possible_closure(ensemble, case, CaseLabel.from_dict(label), run.diagnosis.candidates)
    except YidError:
        return None
    return best if math.isfinite(best) else None


def _case(name: str, recordings: Sequence[Path], without: Sequence[str]) -> BlindCase:
    *estimate, held_out = map(read_recording, recordings)
    return BlindCase(name, tuple(estimate), held_out, tuple(without))


def _best(
    cases: Sequence[Task],
    labels: Sequence[CaseLabel],
    answers: Sequence[Mapping[str, Any]],
    folder: Path,
    progress: Progress,
    workers: WorkerConfig | Executor,
) -> dict[str, float]:
    """By case, what its true effects close, where one of them or two were withheld and a gap was seen."""
    tasks = []
    for case, label, found in zip(cases, labels, answers, strict=True):
        gap = found["result"]["verdict"] not in ("no_gap", "insufficient_data")
        if gap and label.category in ("single", "pair"):
            arguments = {key: value for key, value in case.arguments.items() if key != "without"}
            tasks.append(Task(case.name, {**arguments, "label": label.to_dict()}))
    best = _done(_true_effect_closure, tasks, folder / _BEST_FOLDER, workers, progress)
    return {task.name: value for task, value in zip(tasks, best, strict=True) if value is not None}


def _nothing(message: str) -> dict[str, Any]:
    return {
        "verdict": "insufficient_data",
        "message": message,
        "effects": [],
        "which": [],
        "where": [],
        "confusable": [],
        "gap": {"closure": None},
    }
