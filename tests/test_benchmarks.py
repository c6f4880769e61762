"""Scores and verdicts of the benchmarks, and a small part of what they do; their timing is not a test."""

import ast
import importlib
import importlib.util
import json
import subprocess
import sys
from dataclasses import fields
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from yid_ocp.diagnosis.thresholds import Thresholds
from yid_ocp.parallel import WorkerConfig


@pytest.fixture(scope="module")
def run(benchmark_module):
    pytest.importorskip("pinocchio", reason="the benchmark's yardstick is Pinocchio: pip install pin")
    return benchmark_module("run")


def test_ratios_of_every_size(run):
    times = {workload.name: 2.0 for workload in run.WORKLOADS}
    results = run.ratios({43: {**times, "step": 1.0}, 50: times})
    assert results["step_43_over_rnea_derivatives"] == 0.5
    assert results["step_ab_43_over_step"] == 2.0
    assert results["adjoint_50_over_step"] == 1.0
    assert len(results) == 2 * len(run.RATIOS)
    baseline = json.loads(run.BASELINE.read_text(encoding="utf-8"))
    assert {key.format(n=size) for key in run.RATIOS for size in run.SIZES} <= set(baseline)


def test_a_regression_is_a_ratio_that_grew_beyond_the_tolerance(run):
    baseline = {"a_over_b": 2.0, "c_over_d": 1.0, "compile_43_seconds": 1.0}
    assert run.regressions({"a_over_b": 2.9, "c_over_d": 0.1, "compile_43_seconds": 9.0}, baseline, 1.5) == []
    found = run.regressions({"a_over_b": 3.1, "compile_43_seconds": 21.0}, baseline, 1.5)
    assert [line.split(":")[0] for line in found] == ["a_over_b", "c_over_d", "compile_43_seconds"]
    assert "1.55 times" in found[0]
    assert "not measured" in found[1]
    assert "limit 20 s" in found[2]


def test_a_rule_is_worth_the_cases_that_change_without_it(benchmark_module, monkeypatch, tmp_path):
    ablation, asked = benchmark_module("ablation"), []
    ways = [("effect a@b", [True, False]), ("effect a@b", [False, True]), ("unknown -", [False, False])]
    changed = [{"now": now, "right": right} for now, right in [*ways, ("not_judged -", [True, False])]]

    def rescored(folder, out, settings):
        asked.append(settings)
        return SimpleNamespace(result={"cases": 9, "not_judged": 1, "rescored": {"changed": changed}})

    monkeypatch.setattr(ablation, "rescore_blind", rescored)
    (tmp_path / "answers").mkdir()
    found = ablation.changes(tmp_path, ["diagnosis.min_z=0"])
    assert dict(found) == {"cases": 9, "not_judged": 1, "lost": 1, "gained": 1, "otherwise": 1}
    assert asked == [["diagnosis.min_z=0"]]
    assert set(ablation.NEUTRAL) <= {entry.name for entry in fields(Thresholds)}
    for name in (*ablation.CONSTANTS, *ablation.CRITERIA):  # each has one place in the code
        with ablation.switched_off(name) as settings:
            assert settings == []


@pytest.fixture(scope="module")
def coverage(benchmark_module):
    pytest.importorskip("mujoco", reason="twins are made in MuJoCo: pip install '.[blind]'")
    return benchmark_module("coverage")


def twin(coverage, z: dict[str, float | None], verdict: str = "identifiable", **found: Any) -> Any:
    """A twin whose estimates are off by so many standard deviations of 0.5; None for a std that is not known."""
    parameters = {
        name: {"value": 10.0 + 0.5 * (value or 0.0), "std": None if value is None else 0.5, "verdict": verdict}
        for name, value in z.items()
    }
    common = {"status": "converged", "seconds": 1.0, "chi2_per_dof": 1.0, "diagnose": False}
    return coverage.Twin(dict.fromkeys(z, 10.0), {**common, "parameters": parameters, **found})


def drawn(coverage, scale: float, count: int = 100) -> list[Any]:
    """Twins whose z are normal quantiles times a scale."""
    quantiles = coverage.scipy.stats.norm.ppf((np.arange(count) + 0.5) / count)
    return [twin(coverage, {"T1.bend": scale * value, "T2.bend": -scale * value}) for value in quantiles]


def test_only_parameters_that_are_called_found_or_weak_count(coverage):
    assert twin(coverage, {"T1.bend": 2.0, "T3.twist": None}).z == {"T1.bend": pytest.approx(2.0)}
    assert twin(coverage, {"T1.bend": -2.0}, "weak").z == {"T1.bend": pytest.approx(-2.0)}
    for verdict in ("fixed", "not_identifiable", "at_bound", "not_trusted"):
        assert twin(coverage, {"T1.bend": 2.0}, verdict).z == {}
    assert twin(coverage, {"T1.bend": 2.0}, status="failed").z == {}
    assert coverage.Twin(error="none of 50 motions").z == {}


def test_a_group_has_four_hundred_values_of_the_right_size_and_spread(coverage):
    pools = {scale: coverage.pooled("white_0.1", drawn(coverage, scale, 200)) for scale in (0.7, 1.0, 1.3)}
    assert {scale: pool.honest for scale, pool in pools.items()} == {0.7: False, 1.0: True, 1.3: False}
    assert (pools[1.0].rms, pools[1.0].covered) == (pytest.approx(1.0, abs=0.01), pytest.approx(0.95, abs=0.005))
    always = coverage.pooled("white_0.1", [twin(coverage, {"T1.bend": (-1.0) ** k}) for k in range(400)])
    assert (always.rms, always.covered, always.honest) == (pytest.approx(1.0), 1.0, False)
    # 40 degrees of freedom: the central 99.9 % is 16.906 to 76.095
    assert [coverage.in_band(total, 40) for total in (16.0, 17.0, 76.0, 77.0)] == [False, True, True, False]


@pytest.mark.slow
def test_standard_deviations_of_a_few_twins(coverage, tmp_path):
    """Six twins of a cell that holds: all z values together lie within the 99.9 % band of chi-squared."""
    cell = "no_torque_error"
    chosen, twins = coverage.CELLS[cell], []
    for number in range(6):
        made = coverage.make_twin(cell, chosen.recipe, number, str(tmp_path), "test")
        assert min(made["roughness"][:6]) > 0.03
        found = coverage.solve_twin(chosen.config, tmp_path / made["file"], list(chosen.settings))
        twins.append(coverage.Twin(made["truth"], found))
    assert len({tuple(twin.truth.values()) for twin in twins}) == 6
    assert not any(twin.failed for twin in twins)
    values = coverage.pooled(cell, twins).values
    assert len(values) >= 18
    assert coverage.in_band(float(values @ values), len(values))


@pytest.fixture(scope="module")
def events(benchmark_module):
    return benchmark_module("events")


@pytest.mark.slow
def test_injected_pushes_of_a_real_double_pendulum_are_found(events):
    """Five pushed and three calm runs; about half a minute."""
    if not events.RECORDINGS.is_dir():
        pytest.skip("the real recordings are not here (shared/recordings beside the project)")
    found = events.diagnosed("acrobot", events.RECORDINGS).events
    labels = json.loads((events.RECORDINGS / "labels.json").read_text(encoding="utf-8"))
    own = {name: entry for name, entry in labels.items() if name.startswith("acrobot")}
    falls = {fall.recording: fall.time for fall in found.falls}
    score = events.scored(found.found, falls, own, events.UNLABELLED["acrobot"])
    assert score.shortcomings == []
    assert score.apart >= 3


@pytest.mark.slow
def test_noise_is_no_gap_and_an_offset_beyond_what_is_stated_is_named(benchmark_module, coverage, tmp_path):
    alarms = benchmark_module("false_alarms", coverage=coverage)
    workers = WorkerConfig(n_processes=2)
    made = alarms.record(["one_arm_encoders", "offset_beyond"], 1, workers, tmp_path)
    twins = alarms.diagnosed(made, "[kelvin_voigt, joint_viscous, effort_offset]", workers, tmp_path)
    assert [twin.error for entries in twins.values() for twin in entries] == ["", ""]
    assert alarms.shortcomings(twins) == []


@pytest.mark.slow
def test_disturbed_runs_lose_nothing(repository):
    pytest.importorskip("rosbags", reason="its recordings stand beside a bag: pip install '.[bags]'")
    counts = ("--kills", "12", "--pairs", "3", "--disks", "6", "--caches", "2", "--seed", "1")
    command = [sys.executable, repository / "benchmarks" / "kills.py", *counts]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr[-2000:]
    assert json.loads(done.stdout.splitlines()[-1])["wrong"] == 0


FOUND = {"value": 10.0, "std": 0.1, "interval": None, "verdict": "identifiable", "free": True}
LOST = FOUND | {"std": None, "verdict": "not_identifiable"}
WEAK = FOUND | {"std": 2.0, "verdict": "weak"}
OPEN = WEAK | {"interval": [8.0, None]}
# published value and our estimate by reason, where the truth is 10 and a descent without torque errors stops at 5
REASONS = {
    "not informed": [(99.0, LOST), (10.0, LOST), (13.9, WEAK)],
    "hardly informed": [(99.0, OPEN)],
    "near the truth": [(9.0, FOUND), (11.0, FOUND)],
    "slow": [(3.0, FOUND), (5.5, FOUND), (6.0, FOUND, 10.0, 8.0), (2.5, FOUND, 1.0, 2.0)],
    "torque error": [(13.9, FOUND), (7.9, OPEN), (8.9, FOUND), (10.0, FOUND, None)],
    "unexplained": [(14.1, WEAK), (5.6, FOUND), (2.9, FOUND), (4.0, FOUND, 10.0, 9.1), (4.0, FOUND, None)],
}


@pytest.mark.parametrize(("expected", "case"), [(reason, case) for reason, many in REASONS.items() for case in many])
def test_why_a_published_value_is_what_it_is(benchmark_module, expected, case):
    """Of descents that start at 3, stop where it says, and end between 6 and 14 with errors of the torques."""
    published, entry, truth, stopped = (*case, *(10.0, 5.0)[len(case) - 2 :])
    said = benchmark_module("torque_ensemble")._reason("one", published, entry, truth, stopped, [6.0, 14.0])
    assert said.startswith(expected)


def test_each_published_value_of_a_comparison_has_one_sentence(benchmark_module):
    module = benchmark_module("torque_ensemble")
    for experiment, published in module.PAPER_ESTIMATES.items():
        parameters = {name: FOUND | {"value": value} for name, value in module.TRUTH.items()} | {"T2.twist": LOST}
        result = {"published": published, "truth": module.TRUTH, "judged": {"parameters": parameters}}
        said = module.explain(result)
        assert [text.split(" = ")[0] for text in said] == list(published)
        assert ": not informed; its verdict in such an experiment is 'cannot be found'" in said[3]
        assert ("which was chosen from it" in said[0]) == (experiment == module.CHOSEN_FROM)
        parameters["T1.bend"] = FOUND | {"verdict": "not_trusted"}
        assert module.explain(result) == []
    assert module.is_within_range(0.0, [0.04, 5.0])
    assert not module.is_within_range(0.0, [0.06, 5.0])


def test_every_name_that_a_benchmark_imports_exists(repository):
    for file in sorted((repository / "benchmarks").rglob("*.py")):
        for node in ast.walk(ast.parse(file.read_text("utf-8"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] == "yid_ocp":
                module = importlib.import_module(node.module)
                missing = [own.name for own in node.names if not hasattr(module, own.name)]
                assert all(importlib.util.find_spec(f"{node.module}.{name}") for name in missing), file.name
