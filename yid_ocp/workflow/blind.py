"""The command `blind`: make an ensemble, commit to its labels, diagnose every case without them, open them, score."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from yid_ocp.config.settings import Run, dump_config
from yid_ocp.data.hdf5 import read_recording, write_recording
from yid_ocp.data.recording import new_file
from yid_ocp.diagnosis import Thresholds
from yid_ocp.diagnosis.blind import Case, Ensemble, Label, answer, best_closure, mark, opened, score, seal
from yid_ocp.errors import OutputError, YidError
from yid_ocp.workflow.build import build_problem, build_system
from yid_ocp.workflow.folder import Monitor, Silent, jsonable, versions

COMMITMENT, LABELS, RESULT, TABLE = "commitment.json", "sealed/labels.json", "result.json", "table.md"


@dataclass(frozen=True)
class BlindOutcome:
    """What `run_blind` leaves: the folder and the contents of its result.json."""

    folder: Path
    result: dict[str, Any]


def run_blind(
    run: Run, out: str | Path, count: int = 20, seed: int = 1, monitor: Monitor | None = None
) -> BlindOutcome:
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
    monitor : Monitor, optional

    Returns
    -------
    BlindOutcome

    Raises
    ------
    ConfigError, DataError, ModelError, SolverError
    OutputError
        The folder holds another ensemble.
    """
    watcher = monitor or Silent()
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
    cases = _made(run, ensemble, folder, count, seed, watcher)
    limits = Thresholds(level=run.diagnosis.level, effects=run.diagnosis.effects)
    for i, case in enumerate(cases):
        watcher.advance(i, len(cases), f"diagnosing {case.name}")
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
        watcher.advance(i, len(cases), f"scoring {case.name}")
        marks.append(_marked(ensemble, folder, case, label, run))
    result = score(marks) | {"seed": seed, "versions": versions(), "candidates": run.diagnosis.candidates}
    written = _write(folder / RESULT, result)
    (folder / TABLE).write_text("\n".join(blind_table(written)) + "\n", encoding="utf-8")
    return BlindOutcome(folder, written)


def _made(run: Run, ensemble: Ensemble, folder: Path, count: int, seed: int, watcher: Monitor) -> list[Case]:
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
        watcher.advance(number, count, f"making case {number}")
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


def blind_table(result: Mapping[str, Any]) -> list[str]:
    """The score and every case, as Markdown."""

    def share(value: float | None, digits: int = 0) -> str:
        return "-" if value is None else f"{100 * value:.{digits}f} %"

    def row(*cells: str) -> str:
        return f"| {' | '.join(cells)} |"

    lines = [row("what", "value"), row("---", "---")]
    lines += [
        row("false alarms on clean data", share(result["false_alarms"])),
        row("true kind and place first, of the gaps found", share(result["kind_first"])),
        row("among the first two", share(result["kind_in_two"])),
        row("place first", share(result["location_first"])),
        row("sets named as not separable hold the truth", share(result["confusable_covers"])),
        row("their size", "-" if result["confusable_size"] is None else f"{result['confusable_size']:.1f}"),
        row("unknown said of effects outside the library", share(result["unknown_recall"])),
        row("their place", share(result["unknown_location"])),
        row("pairs found", share(result["pairs_right"])),
        row("closure over that of the true effect refitted", share(result["closure_of_best"])),
        row("median error of the effects' parameters", share(result["parameter_error"], 1)),
        row("their 95 % intervals that hold the truth", share(result["interval_coverage"])),
        row("time of one diagnosis", "-" if result["seconds"] is None else f"{result['seconds']:.0f} s"),
    ]
    lines += ["", row("size / detectable", "cases", "gap seen", "right"), row(*["---"] * 4)]
    for size, entry in result["detection"].items():
        lines.append(row(size, str(entry["cases"]), share(entry["gap"]), share(entry["right"])))
    head = ("case", "sort", "truth", "size", "verdict", "added", "not separable", "place", "closure", "best", "time")
    lines += ["", row(*head), row(*["---"] * len(head))]
    for entry in result["marks"]:
        lines.append(
            row(
                entry["case"],
                entry["category"],
                entry["truth"],
                "-" if entry["multiple"] is None else f"{entry['multiple']:.3g}",
                entry["verdict"] + ("" if entry["right"] or entry["category"] == "finer_chain" else " (wrong)"),
                entry["answer"],
                ", ".join(entry["confusable"]) or "-",
                "right" if entry["location_first"] else "-",
                share(entry["closure"]),
                share(entry["best"]),
                "-" if entry["seconds"] is None else f"{entry['seconds']:.0f} s",
            )
        )
    return lines


def summary_lines(result: Mapping[str, Any]) -> Sequence[str]:
    """The table for people: the score alone."""
    return [line.strip("| ").replace(" | ", ": ") for line in blind_table(result)[2:15]]
