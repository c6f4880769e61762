"""Estimates of a two-arm twin from another engine as the time step is halved."""

from __future__ import annotations

import importlib.util
import sys

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="the twin is MuJoCo's: pip install mujoco")
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def bench(repository):
    """The module benchmarks/step_order.py."""
    spec = importlib.util.spec_from_file_location("step_order", repository / "benchmarks" / "step_order.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def twin(bench):
    system = bench.baxter_foam_y_system(2)
    return system, bench.played(system, seed=3, duration=3.0)


def test_changes_shrink_as_those_of_a_rule_of_order_two(bench, twin):
    system, run = twin
    fine = bench.recorded(system, run, 1, 0.0, "fine")
    estimates = {step: bench.estimated(system, fine, step) for step in bench.STEPS[:3]}
    ratios = np.concatenate(list(bench.orders(estimates).values()))
    seen = ratios[np.isfinite(ratios)]
    assert len(seen) >= 2
    assert np.all((seen > 3) & (seen < 5)), bench.orders(estimates)
    truth = np.array([bench.TRUTH[name] for name in bench.FREE])
    np.testing.assert_allclose(estimates[0.005].values, truth, rtol=5e-3)


def test_estimates_with_ten_and_five_milliseconds_agree(bench, twin):
    system, run = twin
    recording = bench.recorded(system, run, 20, 1.0, "recorded")
    estimates = {step: bench.estimated(system, recording, step) for step in bench.STEPS[:2]}
    assert max(bench.moved(estimates).values()) < 0.3
    truth = np.array([bench.TRUTH[name] for name in bench.FREE])
    assert np.max(np.abs(estimates[0.01].values - truth) / estimates[0.01].std) < 3.0
