"""95 % intervals hold the truth in 95 of 100 noisy twins of a matching model."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from twins import twin_recording

from yid_ocp.analysis.identifiability import identifiability
from yid_ocp.parallel import Task, run_tasks
from yid_ocp.problem import EstimationProblem
from yid_ocp.solvers import GaussNewton, solve
from yid_ocp.workflow.build_problem import load_problem

TWINS = 100
SEEN = ("T1.bend", "T1.twist", "T2.bend", "T3.bend")
TRUTH = {"T1.bend": 22.0, "T1.twist": 13.6, "T2.bend": 10.7, "T2.twist": 8.2, "T3.bend": 11.5, "T3.twist": 9.7}


def holds(interval: tuple[float | None, float | None], truth: float) -> bool:
    lower, upper = interval
    return (lower is None or lower <= truth) and (upper is None or truth <= upper)


def judged(config: Path, seed: int) -> dict[str, Any]:
    """Of a twin: which of the intervals hold the truth, and which parameters are called identifiable."""
    exact = config.parents[1] / "tests" / "data" / "clean" / "single_arm_vision_estimate.h5"
    made = load_problem(config, ["problem.duration=3.0", f"recordings.estimate=[{exact}]"])
    recording = twin_recording(made, np.array([TRUTH[name] for name in made.unknown_names]), seed)
    problem = EstimationProblem(made.step, [recording], made.free, made.options, dict.fromkeys(TRUTH, 10.0))
    info = identifiability(problem, solve(problem, GaussNewton()), intervals=list(SEEN))
    held = [holds(info.parameters[name].interval, TRUTH[name]) for name in SEEN]
    return {
        "held": held,
        "identifiable": [name for name, entry in info.parameters.items() if entry.verdict == "identifiable"],
    }


def report(record_property, hits: dict[str, list[bool]]) -> float:
    pooled = float(np.mean([hit for found in hits.values() for hit in found]))
    record_property("coverage", pooled)
    print(f"coverage {100 * pooled:.1f} %", {name: f"{sum(found)} of {len(found)}" for name, found in hits.items()})
    return pooled


@pytest.mark.slow
def test_coverage_on_a_pendulum(pendulum, twin, record_property):
    empty = pendulum()
    truth = dict(zip(empty.unknown_names, empty.initial_unknowns, strict=True))
    profile: dict[str, list[bool]] = {name: [] for name in truth}
    gaussian: dict[str, list[bool]] = {name: [] for name in truth}
    for seed in range(TWINS):
        recording = twin(empty, empty.initial_unknowns, 1000 + seed)
        problem = pendulum(recording, {"elbow.stiffness": 3.0, "elbow.damping": 0.1, "elbow.rest": 0.1})
        info = identifiability(problem, solve(problem, GaussNewton()), intervals="all")
        for name, value in truth.items():
            entry = info.parameters[name]
            profile[name].append(holds(entry.interval, value))
            gaussian[name].append(abs(entry.value - value) <= 1.96 * entry.std)
    assert 0.92 <= report(record_property, profile) <= 0.98
    assert 0.92 <= report(record_property, gaussian) <= 0.98


@pytest.mark.slow
def test_coverage_on_one_arm_and_the_y(repository, tmp_path, record_property):
    """43 coordinates, 3 s: bends to a percent, T1.twist and T3.bend so weakly that only profiles are honest."""
    config = repository / "configs" / "single_arm_vision.yaml"
    tasks = [Task(f"twin {seed}", {"config": config, "seed": seed}) for seed in range(TWINS)]
    results = run_tasks(judged, tasks, tmp_path)
    assert [entry.error for entry in results if entry.error] == []
    found = [entry.value for entry in results]
    assert all({"T2.twist", "T3.twist"}.isdisjoint(entry["identifiable"]) for entry in found)
    hits = {name: [entry["held"][i] for entry in found] for i, name in enumerate(SEEN)}
    assert 0.92 <= report(record_property, hits) <= 0.98
