"""Estimates and verdicts against those recorded once: what a change of names or of structure must not move.

    python benchmarks/unchanged.py [NAME ...] [--workers 2] [--keep DIR]   compare with benchmarks/unchanged.json
    python benchmarks/unchanged.py --record [NAME ...] ...                 write what is found into that file
    python benchmarks/unchanged.py --minimum diagnose:CASE ...             both, seen from the minimum of the cost

A NAME is `solve:CONFIGURATION` (a file of `configs/` without its suffix) or `diagnose:CASE` (of `diagnosis_cases.py`);
without names all are run. An estimate may move by a hundredth of its recorded standard deviation, a verdict not at all.
With `--keep`, what a folder holds is not done again; it counts for one version of the package only.
A fit stops near the minimum of its cost. With `--minimum`, the fits of a diagnosis go on until they no longer move, and
it is printed how far the recorded and the new estimates lie from there.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from diagnosis_cases import CASES, found, show

from yid_ocp import cli
from yid_ocp.config.reader import load_config
from yid_ocp.diagnosis.blind_scores import diagnosis_evidence_to_dict
from yid_ocp.parallel import Task, WorkerConfig, run_tasks
from yid_ocp.solvers import GaussNewton
from yid_ocp.workflow.run_inputs import resolve_recording_path

REPOSITORY = Path(__file__).parents[1]
RECORDED = Path(__file__).with_suffix(".json")
MOTION_SEEDS = (1, 7)
SHARP = GaussNewton(max_iterations=100, step_tolerance=1e-9, cost_tolerance=1e-12)
MOST = 0.01
"""How far an estimate may move, in recorded standard deviations."""


def configurations() -> dict[str, Path]:
    """Configurations that `solve` takes, by name."""
    files = sorted((REPOSITORY / "configs").glob("*.yaml"))
    return {path.stem: path for path in files if not path.stem.startswith(("plan_", "track_"))}


def solved(name: str) -> dict[str, Any]:
    """Parameters, status and cost of a configuration; empty where its recordings are not here."""
    file = configurations()[name]
    run = load_config(file)
    if not all(resolve_recording_path(path).is_file() for path in (*run.recordings.estimate, *run.recordings.held_out)):
        return {}
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        cli.main(["solve", str(file), "--out", str(out), "--quiet"])
        result = json.loads((out / "result.json").read_text(encoding="utf-8"))
    parameters = {
        key: {"value": own["value"], "std": own["std"], "verdict": own["verdict"]}
        for key, own in result["parameters"].items()
    }
    return {"status": result["status"], "cost": result["cost"], "parameters": parameters}


def diagnosed(name: str) -> dict[str, Any]:
    """Verdict, effects with their parameters, and nominal parameters of a case."""
    finding, _, _ = found(name, MOTION_SEEDS, truth=False)
    said = finding.to_dict()
    listed = {f"{entry['kind']}@{entry['location']}": entry["parameters"] for entry in said["which"]}
    effects = [f"{entry['kind']}@{entry['location']}" for entry in said["effects"]]
    parameters = {
        f"{label}.{key}": {"value": own["value"], "std": own["std"]}
        for label in effects
        for key, own in listed[label].items()
    }
    nominal = finding.nominal_model
    parameters |= {
        key: {"value": nominal.values[key], "std": number(nominal.std[key])}
        for key in nominal.problem.shared_parameters
    }
    # for `ablation.py`, not compared
    judged = {"said": {key: said[key] for key in ("verdict", "effects", "confusable")}}
    judged["evidence"] = diagnosis_evidence_to_dict(finding)
    return {"status": said["verdict"], "effects": effects, "parameters": parameters, **judged}


def from_minimum(case: str) -> None:
    """Print how far the recorded and the new estimates of a case lie from the minimum, in recorded stds."""
    finding, _, _ = found(case, MOTION_SEEDS, truth=False)
    recorded = json.loads(RECORDED.read_text(encoding="utf-8"))[f"diagnose:{case}"]["parameters"]
    for model, of_effects in ((finding.final_model, True), (finding.nominal_model, False)):
        sharp = SHARP.minimize_cost(model.problem, model.unknowns, None)
        least = model.problem.unknowns.named_values(sharp.x)
        for name, own in recorded.items():
            if ("@" in name) == of_effects and own["std"] and name in least:
                before, now = ((value - least[name]) / own["std"] for value in (own["value"], model.values[name]))
                print(f"{case}: {name}: recorded {before:+.3f} std from the minimum, now {now:+.3f}", flush=True)


def number(value: float) -> float | None:
    return value if math.isfinite(value) else None


def work(name: str) -> dict[str, Any]:
    command, _, item = name.partition(":")
    return {"solve": solved, "diagnose": diagnosed}[command](item)


def differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> Iterator[str]:
    """What moved by more than is allowed, a line each."""
    for key in ("status", "effects"):
        if before.get(key) != now.get(key):
            yield f"{key}: {before.get(key)} -> {now.get(key)}"
    if set(before["parameters"]) != set(now["parameters"]):
        yield f"parameters: {sorted(set(before['parameters']) ^ set(now['parameters']))} on one side only"
    for key in sorted(set(before["parameters"]) & set(now["parameters"])):
        old, new = before["parameters"][key], now["parameters"][key]
        if old.get("verdict") != new.get("verdict"):
            yield f"{key}: {old.get('verdict')} -> {new.get('verdict')}"
        if None in (old["value"], new["value"]):
            if old["value"] != new["value"]:
                yield f"{key}: {old['value']} -> {new['value']}"
            continue
        # a parameter without a standard deviation (fixed, or at its bound) is compared with its own size
        unit = old["std"] or 1e-3 * abs(old["value"]) or 1.0
        if abs(new["value"] - old["value"]) > MOST * unit:
            yield f"{key}: {old['value']:.9g} -> {new['value']:.9g}, {abs(new['value'] - old['value']) / unit:.2g} std"
    if "cost" in before and now["cost"] > before["cost"] * (1 + 1e-6) + 1e-9:
        yield f"cost: {before['cost']:.9g} -> {now['cost']:.9g}"


def main() -> int:
    parser = argparse.ArgumentParser(description="Estimates and verdicts against those recorded once.")
    everything = [*(f"solve:{name}" for name in configurations()), *(f"diagnose:{name}" for name in CASES)]
    parser.add_argument("names", nargs="*", default=everything, help="solve:CONFIGURATION, diagnose:CASE")
    parser.add_argument("--record", action="store_true", help="write into unchanged.json instead of comparing")
    parser.add_argument("--minimum", action="store_true", help="distances from the minimum of the cost, of diagnoses")
    parser.add_argument("--workers", type=int, default=1, help="runs at once")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="folder of results, which are not worked out again")
    arguments = parser.parse_args()
    if unknown := sorted(set(arguments.names) - set(everything)):
        parser.error(f"unknown: {', '.join(unknown)}; allowed are {', '.join(everything)}")
    if arguments.minimum:
        for name in arguments.names:
            from_minimum(name.removeprefix("diagnose:"))
        return 0
    recorded = json.loads(RECORDED.read_text(encoding="utf-8")) if RECORDED.is_file() else {}
    with tempfile.TemporaryDirectory() as folder:
        tasks = [Task(name, {"name": name}) for name in arguments.names]
        results = run_tasks(work, tasks, arguments.keep or Path(folder), WorkerConfig(arguments.workers), show)
    failed = 0
    for name, result in zip(arguments.names, results, strict=True):
        if result.error or not result.value:
            print(f"{name}: {result.error or 'its recordings are not here'}")
            failed += bool(result.error)
        elif arguments.record:
            recorded[name] = {key: own for key, own in result.value.items() if key not in ("said", "evidence")}
        elif name not in recorded:
            print(f"{name}: not recorded")
        else:
            lines = list(differences(recorded[name], result.value))
            failed += bool(lines)
            print(f"{name}: {'as recorded' if not lines else '; '.join(lines)}", flush=True)
    if arguments.record:
        RECORDED.write_text(json.dumps(dict(sorted(recorded.items())), indent=1) + "\n", encoding="utf-8")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
