"""The command `blind`: make an ensemble, commit to its labels, diagnose every case without them, open them, score."""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from yid_ocp.config.reader import DIAGNOSIS_DEFAULT, load_config
from yid_ocp.config.settings import Run, dump_config
from yid_ocp.data.recording import read_recording, write_recording
from yid_ocp.diagnosis import Thresholds
from yid_ocp.diagnosis.blind import Case, Ensemble, Label, answer, best_closure, mark, opened, score, seal
from yid_ocp.errors import OutputError, YidError
from yid_ocp.files import jsonable, new_file
from yid_ocp.report.tables import blind_table
from yid_ocp.report.terminal import blind_summary
from yid_ocp.workflow.build import build_problem, build_system
from yid_ocp.workflow.command import DONE, carry_out
from yid_ocp.workflow.folder import versions
from yid_ocp.workflow.progress import SILENT, Progress

COMMITMENT, LABELS, RESULT, TABLE = "commitment.json", "sealed/labels.json", "result.json", "table.md"


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
    """Prove a diagnosis blind; what a folder of the same name holds already is not done again.

    Parameters
    ----------
    run : Run
        The experiment: its model, its first recording's posture and sensors, `diagnosis.candidates`.
    out : str or Path
        Folder: `cases/` (recordings), `sealed/labels.json`, `commitment.json` (hash of the labels, written before
        the first diagnosis), `answers/`, then `result.json` (`yid-blind/1`) and `table.md`.
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
    problem = build_problem(run)
    links = len(problem.system.segments[0].links) if problem.system.segments else 0
    finer = (lambda times: build_system(run, links * times)) if links else None
    ensemble = Ensemble(problem, seed, finer, run.diagnosis.candidates)
    cases = _made(run, ensemble, folder, count, seed, progress)
    limits = Thresholds(level=run.diagnosis.level, effects=run.diagnosis.effects)
    for i, case in enumerate(cases):
        progress.advance(i, len(cases), f"diagnosing {case.name}")
        path = folder / "answers" / f"{case.name}.json"
        if path.exists():
            continue
        begun = time.perf_counter()
        try:
            result = answer(ensemble, case, run.diagnosis.candidates, limits).to_dict()
        except YidError as error:
            result = _nothing(str(error))
        _write(path, {"seconds": time.perf_counter() - begun, "result": result})
    labels = opened((folder / LABELS).read_text("utf-8"), json.loads((folder / COMMITMENT).read_text())["sha256"])
    marks = []
    for i, (case, label) in enumerate(zip(cases, labels, strict=True)):
        progress.advance(i, len(cases), f"scoring {case.name}")
        marks.append(_marked(ensemble, folder, case, label, run))
    result = score(marks) | {"seed": seed, "versions": versions(), "candidates": run.diagnosis.candidates}
    written = _write(folder / RESULT, result)
    (folder / TABLE).write_text("\n".join(blind_table(written)) + "\n", encoding="utf-8")
    return BlindOutcome(folder, written)


def _made(run: Run, ensemble: Ensemble, folder: Path, count: int, seed: int, progress: Progress) -> list[Case]:
    """The ensemble's cases, from the folder or made now; their labels are sealed before this returns."""
    config = dump_config(run)
    commitment = folder / COMMITMENT
    if commitment.exists():
        said = json.loads(commitment.read_text("utf-8"))
        if (said["cases"], said["seed"], said["config"]) != (count, seed, config):
            raise OutputError(
                f"'{folder}' holds another ensemble ({said['cases']} cases, seed {said['seed']})",
                where="--out",
                hint="choose another folder, or the same configuration, --cases and --seed",
            )
        listed = json.loads((folder / "cases" / "cases.json").read_text("utf-8"))
        return [_read(folder, entry) for entry in listed]
    try:
        for name in ("cases", "sealed", "answers"):
            (folder / name).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"the folder cannot be made: {error}", where=str(folder)) from error
    cases, labels = [], []
    for number in range(count):
        progress.advance(number, count, f"making case {number}")
        case, label = ensemble.draw(number, count)
        for recording in (case.estimate, case.held_out):
            write_recording(recording, folder / "cases" / f"{recording.name}.h5")
        cases.append(case)
        labels.append(label)
    text, digest = seal(labels)
    (folder / LABELS).write_text(text, encoding="utf-8")
    _write(folder / "cases" / "cases.json", [{"name": case.name, "without": list(case.without)} for case in cases])
    _write(commitment, {"sha256": digest, "cases": count, "seed": seed, "config": config})
    return cases


def _read(folder: Path, entry: Mapping[str, Any]) -> Case:
    name = str(entry["name"])
    pair = [read_recording(folder / "cases" / f"{name}_{purpose}.h5") for purpose in ("estimate", "held_out")]
    return Case(name, pair[0], pair[1], tuple(entry["without"]))


def _marked(ensemble: Ensemble, folder: Path, case: Case, label: Label, run: Run) -> Any:
    stored = json.loads((folder / "answers" / f"{case.name}.json").read_text("utf-8"))
    best = math.nan
    gap = stored["result"]["verdict"] not in ("no_gap", "insufficient_data")
    if gap and label.category in ("single", "pair"):
        try:
            best = best_closure(ensemble, case, label, run.diagnosis.candidates)
        except YidError:
            best = math.nan
    return mark(label, stored["result"], best, float(stored["seconds"]))


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


def _write(path: Path, data: Any) -> Any:
    clean = jsonable(data)
    with new_file(path) as temporary:
        temporary.write_text(json.dumps(clean, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    return clean
