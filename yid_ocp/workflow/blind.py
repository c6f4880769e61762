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
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from yid_ocp.config.reader import DEFAULT, DIAGNOSIS_DEFAULT, load_config
from yid_ocp.config.settings import Run, dump_config
from yid_ocp.data.hdf5 import read_recording, write_recording
from yid_ocp.diagnosis.blind import (
    PURPOSES,
    Case,
    Label,
    Planned,
    answer,
    best_closure,
    calibrate,
    mark,
    opened,
    opened_wide,
    planned,
    score,
    seal,
)
from yid_ocp.diagnosis.finding import statistics
from yid_ocp.errors import ConfigError, OutputError, YidError
from yid_ocp.files import jsonable, write_json, write_text
from yid_ocp.parallel import LOCAL, Task, Workers, run_tasks, values_of
from yid_ocp.progress import SILENT, Progress
from yid_ocp.report.html import write_report
from yid_ocp.report.pictures import draw_blind
from yid_ocp.report.sections import Findings
from yid_ocp.report.summaries import blind_summary
from yid_ocp.report.tables import blind_markdown
from yid_ocp.version import package_code, versions
from yid_ocp.workflow.command import DONE, carry_out, given_workers
from yid_ocp.workflow.experiments import VARIATIONS, Experiment, experiments_of, refuse_unfit
from yid_ocp.workflow.folder import now

COMMITMENT, LABELS, RESULT, TABLE = "commitment.json", "sealed/labels.json", "result.json", "table.md"
THRESHOLDS = "thresholds.json"
CONFIGS, PREPARED, DRAWN, CASES, ANSWERS, BEST = "configs", "prepared", "sealed/drawn", "cases", "answers", "best"
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class BlindOutcome:
    """Result of `run_blind`: the folder and the contents of its result.json."""

    folder: Path
    result: dict[str, Any]


def run(arguments: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    given = arguments.configs or [None]
    runs = [load_config(path, arguments.overrides, DIAGNOSIS_DEFAULT) for path in given]
    if not arguments.configs and arguments.cases >= TWO_ARMS:
        runs.append(load_config(None, arguments.overrides, DEFAULT))
    workers = given_workers(arguments) or LOCAL
    purpose = PURPOSES[int(arguments.calibration)]
    out = arguments.out or f"{runs[0].name}-blind-{'calibration-' if arguments.calibration else ''}{arguments.seed}"

    def proved(shown: Progress) -> BlindOutcome:
        return run_blind(runs, out, arguments.cases, arguments.seed, shown, workers, purpose)

    carry_out(proved, blind_summary, arguments)
    return DONE


TWO_ARMS = 100
"""Cases from which the embedded proof has experiments with two arms as well."""


def run_blind(
    runs: Sequence[Run],
    out: str | Path,
    count: int = 20,
    seed: int = 1,
    progress: Progress = SILENT,
    workers: Workers | Executor = LOCAL,
    purpose: str = PURPOSES[0],
) -> BlindOutcome:
    """Run a blind validation of the diagnosis in several processes; finished parts in the folder are reused.

    Parameters
    ----------
    runs : sequence of Run
        Configurations: models, posture and sensors of their first recordings, `diagnosis.candidates`. Each is varied
        (`workflow.experiments.VARIATIONS`) as far as there are cases for it.
    out : str or Path
        Folder: `configs/`, `prepared/` (what is detectable in every experiment), `cases/` (recordings),
        `sealed/labels.json`, `commitment.json` (hash of the labels, written before the first diagnosis, and of the
        sources that made the cases), `answers/` and `best/` (results of tasks, see `yid_ocp.parallel`), then
        `result.json` (`yid-blind/1`), `table.md` and pictures; of an ensemble to calibrate by `thresholds.json`
        (`yid-calibration/1`).
    count : int
        Number of cases.
    seed : int
    progress : Progress, optional
    workers : Workers or Executor, optional
    purpose : {'report', 'calibration'}
        The same seed draws other cases for each.

    Returns
    -------
    BlindOutcome

    Raises
    ------
    ConfigError, DataError, ModelError, SolverError, WorkerError
    OutputError
        The folder holds another ensemble.
    """
    folder = Path(out).absolute()
    if count < 1:
        raise runs[0].refuse(f"an ensemble of {count} cases", "diagnosis", hint="give --cases from 1")
    if seed < 0:
        raise ConfigError(f"seed = {seed}", where="--seed", allowed="a whole number from 0")
    for entry in runs:
        refuse_unfit(entry)
    try:
        cases = _made(_named(runs), folder, count, seed, progress, workers, purpose)
        progress.stage(f"diagnosing {count} cases")
        answers = _done(diagnosed, cases, folder / ANSWERS, workers, progress)
        commitment = json.loads((folder / COMMITMENT).read_text("utf-8"))
        labels = opened((folder / LABELS).read_text("utf-8"), commitment["sha256"])
        progress.stage("scoring")
        best = _best(cases, labels, answers, folder, progress, workers)
    except KeyboardInterrupt:
        log.warning("finished cases are in %s; the same command goes on with the others", folder)
        raise
    marks = [
        mark(label, found["result"], best.get(label.case, math.nan), float(found["seconds"]))
        for label, found in zip(labels, answers, strict=True)
    ]
    files = [folder / CONFIGS / f"{entry.name}.yaml" for entry in runs]
    flags = ["--cases", count, "--seed", seed, *(["--calibration"] if purpose == PURPOSES[1] else [])]
    again = shlex.join(["yid-ocp", "blind", *map(str, files), *map(str, flags)])
    result = score(marks) | {
        "seed": seed,
        "purpose": purpose,
        "code": package_code(),
        "code_of_cases": commitment["code"],
        "command": again,
        "date": now(),
        "versions": versions(),
        "candidates": {entry.name: entry.diagnosis.candidates for entry in runs},
        "variations": {name: varied.words for name, varied in VARIATIONS.items()},
    }
    if purpose == PURPOSES[1]:
        found = calibrate(labels, marks, answers, runs[0].diagnosis)
        result["calibration_of_thresholds"] = found
        made = {key: result[key] for key in ("cases", "seed", "code", "code_of_cases", "command", "date", "versions")}
        write_json(folder / THRESHOLDS, jsonable(found | made))
    written = jsonable(result)
    write_json(folder / RESULT, written)
    write_text(folder / TABLE, "\n".join(blind_markdown(written)) + "\n")
    draw_blind(folder, written)
    if all(entry.output.report for entry in runs):
        progress.stage("writing the report")
        said = f"{count} virtual cases whose effect was withheld, diagnosed, then opened."
        write_report(folder / "report.html", Findings(folder.name, said, written))
    return BlindOutcome(folder, written)


# -- the ensemble -----------------------------------------------------------------------------------------------------


def _named(runs: Sequence[Run]) -> dict[str, Run]:
    names = [entry.name for entry in runs]
    twice = [name for i, name in enumerate(names) if name in names[:i]]
    if twice:
        raise ConfigError(
            f"two configurations are called {twice[0]}", where="blind", hint="give each a name of its own"
        )
    return dict(zip(names, runs, strict=True))


def _made(
    runs: Mapping[str, Run],
    folder: Path,
    count: int,
    seed: int,
    progress: Progress,
    workers: Workers | Executor,
    purpose: str,
) -> list[Task]:
    """The diagnosis of every case, of those in the folder or made now; labels are sealed before this returns."""
    commitment = folder / COMMITMENT
    configs = {name: dump_config(entry) for name, entry in runs.items()}
    if not commitment.exists():
        _make(configs, folder, count, seed, progress, workers, purpose)
    said = json.loads(commitment.read_text("utf-8"))
    if (said["cases"], said["seed"], said["purpose"], said["configs"]) != (count, seed, purpose, configs):
        raise OutputError(
            f"'{folder}' holds another ensemble ({said['cases']} cases, seed {said['seed']}, for {said['purpose']})",
            where="--out",
            hint="choose another folder, or the same configurations, --cases, --seed and --calibration",
        )
    tasks = []
    for entry in json.loads((folder / CASES / "cases.json").read_text("utf-8")):
        name = str(entry["name"])
        config, _, variation = str(entry["experiment"]).rpartition(".")
        arguments = {
            **Experiment(folder / CONFIGS / f"{config}.yaml", variation, seed, purpose).told,
            "first": folder / PREPARED / f"{entry['experiment']}.h5",
            "name": name,
            "estimate": [folder / CASES / file for file in entry["estimate"]],
            "held_out": folder / CASES / entry["held_out"],
        }
        tasks.append(Task(name, {**arguments, "without": entry["without"]}))
    return tasks


def _make(
    configs: Mapping[str, str],
    folder: Path,
    count: int,
    seed: int,
    progress: Progress,
    workers: Workers | Executor,
    purpose: str,
) -> None:
    """Draw the cases and commit to their labels."""
    try:
        for name in (CONFIGS, PREPARED, CASES, DRAWN):
            (folder / name).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"the folder cannot be made: {error}", where=str(folder)) from error
    for name, text in configs.items():
        write_text(folder / CONFIGS / f"{name}.yaml", text)
    files = {name: folder / CONFIGS / f"{name}.yaml" for name in configs}
    experiments, chains = experiments_of(files, seed, purpose)
    weights = {name: VARIATIONS[entry.variation].weight for name, entry in experiments.items()}
    plan = planned(count, seed, weights, chains, purpose)
    used = [name for name in experiments if any(entry.experiment == name for entry in plan)]
    progress.stage(f"preparing {len(used)} {'experiment' if len(used) == 1 else 'experiments'}")
    tasks = [Task(name, {**experiments[name].told, "folder": str(folder / PREPARED), "name": name}) for name in used]
    _done(prepared, tasks, folder / PREPARED / "tasks", workers, progress)
    progress.stage(f"making {count} cases")
    tasks = []
    for entry in plan:
        name = entry.experiment
        known = {"first": folder / PREPARED / f"{name}.h5", "detectable": folder / PREPARED / f"{name}.json"}
        wanted = {"planned": asdict(entry), "folder": str(folder / CASES)}
        tasks.append(Task(f"case {entry.number}", {**experiments[name].told, **known, **wanted}))
    made = _done(drawn, tasks, folder / DRAWN, workers, progress)
    text, digest = seal([Label.from_dict(entry["label"]) for entry in made])
    write_text(folder / LABELS, text)
    write_json(folder / CASES / "cases.json", [entry["case"] for entry in made])
    said = {"sha256": digest, "cases": count, "seed": seed, "purpose": purpose, "configs": dict(configs)}
    write_json(folder / COMMITMENT, said | {"code": package_code()})


# -- tasks ------------------------------------------------------------------------------------------------------------


def _done(
    function: Callable[..., Any], tasks: Sequence[Task], folder: Path, workers: Workers | Executor, progress: Progress
) -> list[Any]:
    """What a function finds for each task; one experiment after the other, so that a worker builds each once."""
    order = sorted(range(len(tasks)), key=lambda i: [str(tasks[i].arguments[key]) for key in ("config", "variation")])
    found = values_of(run_tasks(function, [tasks[i] for i in order], folder, workers, progress.advance))
    return [value for _, value in sorted(zip(order, found, strict=True), key=lambda pair: pair[0])]


def prepared(config: Path, variation: str, seed: int, purpose: str, folder: str, name: str) -> dict[str, int]:
    """Task: write an experiment's first recording and the detectable size of every candidate."""
    experiment = Experiment(config, variation, seed, purpose)
    first = Path(folder) / f"{name}.h5"
    experiment.begin(first)
    _, ensemble = experiment.ensemble(first)
    detectable = [entry.to_dict() for entry in ensemble.detectable]
    write_json(Path(folder) / f"{name}.json", detectable)
    return {"candidates": len(detectable)}


def drawn(
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
    _, ensemble = Experiment(config, variation, seed, purpose).ensemble(first)
    ensemble.knowing(json.loads(detectable.read_text("utf-8")))
    case, label = ensemble.draw(Planned(**planned))
    for recording in (*case.estimate, case.held_out):
        write_recording(recording, Path(folder) / f"{recording.name}.h5")
    told = {
        "name": case.name,
        "experiment": planned["experiment"],
        "estimate": [f"{recording.name}.h5" for recording in case.estimate],
        "held_out": f"{case.held_out.name}.h5",
        "without": list(case.without),
    }
    found: dict[str, Any] = jsonable({"label": label.to_dict(), "case": told})
    return found


def diagnosed(
    config: Path,
    variation: str,
    seed: int,
    purpose: str,
    first: Path,
    name: str,
    estimate: Sequence[Path],
    held_out: Path,
    without: Sequence[str],
) -> dict[str, Any]:
    """Task: diagnose a case from its recordings alone; returns {seconds, result} with a `yid-diagnosis/1` result.

    For calibration, one without a gap has `open` too: the statistics of a diagnosis that takes anything for a gap.
    """
    run, ensemble = Experiment(config, variation, seed, purpose).ensemble(first)
    case = _case(name, estimate, held_out, without)
    begun = time.perf_counter()
    try:
        result = answer(ensemble, case, run.diagnosis.candidates, run.diagnosis).to_dict()
    except YidError as error:
        result = _nothing(str(error))
    found: dict[str, Any] = jsonable({"seconds": time.perf_counter() - begun, "result": result})
    if purpose == PURPOSES[1] and result["verdict"] == "no_gap":
        anything = opened_wide(run.diagnosis)
        try:
            found["open"] = jsonable(statistics(answer(ensemble, case, run.diagnosis.candidates, anything)))
        except YidError as error:
            found["open"] = {"message": str(error)}
    return found


def closed_at_best(
    config: Path,
    variation: str,
    seed: int,
    purpose: str,
    first: Path,
    name: str,
    estimate: Sequence[Path],
    held_out: Path,
    label: Mapping[str, Any],
) -> float | None:
    """Task: fraction of a case's gap closed by its refitted true effects; None where it cannot be computed."""
    run, ensemble = Experiment(config, variation, seed, purpose).ensemble(first)
    case = _case(name, estimate, held_out, ())
    try:
        best = best_closure(ensemble, case, Label.from_dict(label), run.diagnosis.candidates)
    except YidError:
        return None
    return best if math.isfinite(best) else None


def _case(name: str, estimate: Sequence[Path], held_out: Path, without: Sequence[str]) -> Case:
    return Case(name, tuple(read_recording(path) for path in estimate), read_recording(held_out), tuple(without))


def _best(
    cases: Sequence[Task],
    labels: Sequence[Label],
    answers: Sequence[Mapping[str, Any]],
    folder: Path,
    progress: Progress,
    workers: Workers | Executor,
) -> dict[str, float]:
    """By case, what its true effects close, where one of them or two were withheld and a gap was seen."""
    tasks = []
    for case, label, found in zip(cases, labels, answers, strict=True):
        gap = found["result"]["verdict"] not in ("no_gap", "insufficient_data")
        if gap and label.category in ("single", "pair"):
            arguments = {key: value for key, value in case.arguments.items() if key != "without"}
            tasks.append(Task(case.name, {**arguments, "label": label.to_dict()}))
    best = _done(closed_at_best, tasks, folder / BEST, workers, progress)
    return {task.name: value for task, value in zip(tasks, best, strict=True) if value is not None}


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
