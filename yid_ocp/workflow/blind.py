"""The command `blind`: make an ensemble, commit to its labels, diagnose every case without them, open them, score."""

from __future__ import annotations

import argparse
import json
import logging
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from yid_ocp.config.reader import DIAGNOSIS_DEFAULT, load_config
from yid_ocp.config.settings import Run, dump_config
from yid_ocp.data.hdf5 import read_recording, write_recording
from yid_ocp.diagnosis.blind import Case, Ensemble, Label, answer, best_closure, mark, opened, score, seal
from yid_ocp.errors import OutputError, YidError
from yid_ocp.files import jsonable, write_json, write_text
from yid_ocp.parallel import Task, TaskResult, run_tasks
from yid_ocp.report.tables import blind_table
from yid_ocp.report.terminal import blind_summary
from yid_ocp.version import versions
from yid_ocp.workflow.build import build_problem, build_system
from yid_ocp.workflow.command import DONE, carry_out
from yid_ocp.workflow.progress import SILENT, Progress

COMMITMENT, LABELS, RESULT, TABLE = "commitment.json", "sealed/labels.json", "result.json", "table.md"
CONFIG, CASES, ANSWERS, BEST = "config.yaml", "cases", "answers", "best"
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class BlindOutcome:
    """What `run_blind` leaves: the folder and the contents of its result.json."""

    folder: Path
    result: dict[str, Any]


def run(arguments: argparse.Namespace) -> int:
    """The command."""
    settings = load_config(arguments.config, arguments.overrides, DIAGNOSIS_DEFAULT)
    out = arguments.out or f"{settings.name}-blind-{arguments.seed}"

    def proved(shown: Progress) -> BlindOutcome:
        return run_blind(settings, out, arguments.cases, arguments.seed, shown)

    carry_out(proved, blind_summary, arguments.quiet)
    return DONE


def run_blind(run: Run, out: str | Path, count: int = 20, seed: int = 1, progress: Progress = SILENT) -> BlindOutcome:
    """Prove a diagnosis blind, in several processes; what a folder of the same name holds is not done again.

    Parameters
    ----------
    run : Run
        The experiment: its model, its first recording's posture and sensors, `diagnosis.candidates`.
    out : str or Path
        Folder: `config.yaml`, `cases/` (recordings), `sealed/labels.json`, `commitment.json` (hash of the labels,
        written before the first diagnosis), `answers/` and `best/` (results of tasks, see `yid_ocp.parallel`), then
        `result.json` (`yid-blind/1`) and `table.md`.
    count : int
        Number of cases.
    seed : int
    progress : Progress, optional

    Returns
    -------
    BlindOutcome

    Raises
    ------
    ConfigError, DataError, ModelError, SolverError
    OutputError
        The folder holds another ensemble.
    """
    folder = Path(out)
    if count < 1:
        raise run.refuse(f"an ensemble of {count} cases", "diagnosis", hint="give --cases from 1")
    if run.diagnosis.noise_fraction < 1 or any(entry.std is not None for entry in run.sensors.values()):
        raise run.refuse(
            "virtual recordings have the noise of `virtual_experiment`, not that of these settings",
            "sensors",
            hint="leave sensors.*.std and diagnosis.noise_fraction out",
        )
    cases = _made(run, folder, count, seed, progress)
    try:
        progress.stage(f"diagnosing {count} cases")
        answers = _values(run_tasks(diagnosed, cases, folder / ANSWERS, progress=progress.advance))
        labels = opened((folder / LABELS).read_text("utf-8"), json.loads((folder / COMMITMENT).read_text())["sha256"])
        progress.stage("scoring")
        best = _best(cases, labels, answers, folder, progress)
    except KeyboardInterrupt:
        log.warning("finished cases are in %s; the same command goes on with the others", folder)
        raise
    marks = [
        mark(label, found["result"], best.get(label.case, math.nan), float(found["seconds"]))
        for label, found in zip(labels, answers, strict=True)
    ]
    result = score(marks) | {"seed": seed, "versions": versions(), "candidates": run.diagnosis.candidates}
    written = jsonable(result)
    write_json(folder / RESULT, written)
    write_text(folder / TABLE, "\n".join(blind_table(written)) + "\n")
    return BlindOutcome(folder, written)


# -- the ensemble -----------------------------------------------------------------------------------------------------


def _made(run: Run, folder: Path, count: int, seed: int, progress: Progress) -> list[Task]:
    """The diagnosis of every case, of those in the folder or made now; labels are sealed before this returns."""
    commitment = folder / COMMITMENT
    if not commitment.exists():
        _make(run, folder, count, seed, progress)
    said = json.loads(commitment.read_text("utf-8"))
    if (said["cases"], said["seed"], said["config"]) != (count, seed, dump_config(run)):
        raise OutputError(
            f"'{folder}' holds another ensemble ({said['cases']} cases, seed {said['seed']})",
            where="--out",
            hint="choose another folder, or the same configuration, --cases and --seed",
        )
    tasks = []
    for entry in json.loads((folder / CASES / "cases.json").read_text("utf-8")):
        name = str(entry["name"])
        arguments = {
            "config": folder / CONFIG,
            "seed": seed,
            "name": name,
            "estimate": folder / CASES / f"{name}_estimate.h5",
            "held_out": folder / CASES / f"{name}_held_out.h5",
        }
        tasks.append(Task(name, {**arguments, "without": entry["without"]}))
    return tasks


def _make(run: Run, folder: Path, count: int, seed: int, progress: Progress) -> None:
    """Draw the cases and commit to their labels."""
    progress.stage("building the model and its compiled step")
    ensemble = _ensemble(run, seed)
    try:
        for name in (CASES, "sealed"):
            (folder / name).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"the folder cannot be made: {error}", where=str(folder)) from error
    config = dump_config(run)
    write_text(folder / CONFIG, config)
    progress.stage(f"making {count} cases")
    cases, labels = [], []
    for number in range(count):
        progress.advance(number, count, f"case {number}")
        case, label = ensemble.draw(number, count)
        for recording in (case.estimate, case.held_out):
            write_recording(recording, folder / CASES / f"{recording.name}.h5")
        cases.append({"name": case.name, "without": list(case.without)})
        labels.append(label)
    text, digest = seal(labels)
    write_text(folder / LABELS, text)
    write_json(folder / CASES / "cases.json", cases)
    write_json(folder / COMMITMENT, {"sha256": digest, "cases": count, "seed": seed, "config": config})


def _ensemble(run: Run, seed: int) -> Ensemble:
    problem = build_problem(run)
    finer = (lambda times: build_system(run, times)) if problem.system.segments else None
    return Ensemble(problem, seed, finer, run.diagnosis.candidates, run.diagnosis)


# -- tasks: each builds the problem again, which takes a twentieth of the time of a diagnosis -------------------------


def diagnosed(
    config: Path, seed: int, name: str, estimate: Path, held_out: Path, without: Sequence[str]
) -> dict[str, Any]:
    """The answer to a case, from its recordings alone: {seconds, result}, result as `yid-diagnosis/1`."""
    run = load_config(config)
    ensemble = _ensemble(run, seed)
    case = Case(name, read_recording(estimate), read_recording(held_out), tuple(without))
    begun = time.perf_counter()
    try:
        result = answer(ensemble, case, run.diagnosis.candidates, run.diagnosis).to_dict()
    except YidError as error:
        result = _nothing(str(error))
    found: dict[str, Any] = jsonable({"seconds": time.perf_counter() - begun, "result": result})
    return found


def closed_at_best(
    config: Path, seed: int, name: str, estimate: Path, held_out: Path, label: Mapping[str, Any]
) -> float | None:
    """What of a case's gap its true effects close, refitted; None where that cannot be worked out."""
    run = load_config(config)
    case = Case(name, read_recording(estimate), read_recording(held_out), ())
    try:
        best = best_closure(_ensemble(run, seed), case, Label.from_dict(label), run.diagnosis.candidates)
    except YidError:
        return None
    return best if math.isfinite(best) else None


def _best(
    cases: Sequence[Task],
    labels: Sequence[Label],
    answers: Sequence[Mapping[str, Any]],
    folder: Path,
    progress: Progress,
) -> dict[str, float]:
    """By case, what its true effects close, where one of them or two were withheld and a gap was seen."""
    tasks = []
    for case, label, found in zip(cases, labels, answers, strict=True):
        gap = found["result"]["verdict"] not in ("no_gap", "insufficient_data")
        if gap and label.category in ("single", "pair"):
            arguments = {key: value for key, value in case.arguments.items() if key != "without"}
            tasks.append(Task(case.name, {**arguments, "label": label.to_dict()}))
    best = _values(run_tasks(closed_at_best, tasks, folder / BEST, progress=progress.advance))
    return {task.name: value for task, value in zip(tasks, best, strict=True) if value is not None}


def _values(results: Sequence[TaskResult]) -> list[Any]:
    """Values of tasks that are all done."""
    failed = [entry for entry in results if entry.error]
    if failed:
        raise RuntimeError(
            f"{len(failed)} of {len(results)} cases failed, {failed[0].name} with {failed[0].error}; "
            "the same command tries them again"
        )
    return [entry.value for entry in results]


def _nothing(message: str) -> dict[str, Any]:
    """The answer where the nominal model cannot even be fitted."""
    return {
        "verdict": "insufficient_data",
        "message": message,
        "effects": [],
        "which": [],
        "where": [],
        "confusable": [],
        "gap": {"closure": None},
    }
