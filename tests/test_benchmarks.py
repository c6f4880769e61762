"""The gate of the benchmark; the timing itself is not a test."""

from __future__ import annotations

import importlib.util
import json
import sys

import pytest

pytest.importorskip("pinocchio", reason="the benchmark's yardstick is Pinocchio: pip install pin")


@pytest.fixture(scope="module")
def run(repository):
    """The module benchmarks/run.py."""
    path = list(sys.path)
    spec = importlib.util.spec_from_file_location("benchmark_run", repository / "benchmarks" / "run.py")
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    finally:
        sys.path[:] = path
    return module


def test_ratios_of_every_size(run):
    times = {workload.name: 2.0 for workload in run.WORKLOADS}
    results = run.ratios({43: {**times, "step": 1.0}, 50: times})
    assert results["step_43_over_rnea_derivatives"] == 0.5
    assert results["step_ab_43_over_step"] == 2.0
    assert results["adjoint_50_over_step"] == 1.0
    assert len(results) == 2 * len(run.RATIOS)


def test_a_regression_is_a_ratio_that_grew_beyond_the_tolerance(run):
    baseline = {"a_over_b": 2.0, "c_over_d": 1.0, "compile_43_seconds": 1.0}
    assert run.regressions({"a_over_b": 2.9, "c_over_d": 0.1, "compile_43_seconds": 9.0}, baseline, 1.5) == []
    found = run.regressions({"a_over_b": 3.1, "compile_43_seconds": 21.0}, baseline, 1.5)
    assert [line.split(":")[0] for line in found] == ["a_over_b", "c_over_d", "compile_43_seconds"]
    assert "1.55 times" in found[0]
    assert "not measured" in found[1]
    assert "limit 20 s" in found[2]


def test_the_baseline_holds_every_ratio(run):
    baseline = json.loads(run.BASELINE.read_text(encoding="utf-8"))
    assert {key.format(n=size) for key in run.RATIOS for size in run.SIZES} <= set(baseline)
    assert all(value > 0 for value in baseline.values())
