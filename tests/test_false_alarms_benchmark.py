"""Scores of `benchmarks/false_alarms.py`, and a twin of each sort as it makes and diagnoses them."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from test_coverage_benchmark import loaded

from yid_ocp.parallel import WorkerConfig

pytest.importorskip("mujoco", reason="twins are made in MuJoCo: pip install 'yid-ocp[blind]'")


@pytest.fixture(scope="module")
def benchmark(repository: Path) -> Iterator[ModuleType]:
    """The module benchmarks/false_alarms.py, which imports coverage.py beside it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "coverage", loaded(repository / "benchmarks", "coverage"))
        yield loaded(repository / "benchmarks", "false_alarms")


def twin(benchmark: ModuleType, verdict: str, named: tuple[str, ...] = (), rivals: tuple[str, ...] = ()) -> Any:
    numbers = dict.fromkeys(("chi2_per_dof", "held_out_chi2_per_dof", "p_value", "held_out_p_value", "seconds"), 1.0)
    return benchmark.Twin({"verdict": verdict, "named": list(named), "rivals": [list(rivals)], "best": [], **numbers})


def test_a_clean_twin_has_no_gap_and_another_one_its_effect(benchmark: ModuleType) -> None:
    clean, damped = benchmark.KINDS["one_arm"], benchmark.KINDS["damped_trunk"]
    assert twin(benchmark, "no_gap").right(clean)
    assert not twin(benchmark, "unknown").right(clean)
    assert not benchmark.Twin(error="it fell").right(clean)
    assert twin(benchmark, "effect", ("kelvin_voigt@T1",)).right(damped)
    assert twin(benchmark, "confusable", ("density@T1",), ("density@T1", "kelvin_voigt@T1")).right(damped)
    assert not twin(benchmark, "effect", ("kelvin_voigt@T2",)).right(damped)
    assert not twin(benchmark, "no_gap").right(damped)


def test_three_alarms_of_sixty_are_as_many_as_there_may_be(benchmark: ModuleType) -> None:
    calm, alarm = twin(benchmark, "no_gap"), twin(benchmark, "unknown")
    few = {"one_arm": [calm] * 28 + [alarm] * 2, "two_arms": [calm] * 29 + [alarm]}
    assert benchmark.shortcomings(few) == []
    many = {**few, "two_arms": [calm] * 28 + [alarm] * 2}
    assert benchmark.shortcomings(many) == ["4 of 60 clean twins are not called so"]
    missed = {"damped_trunk": [calm] * 2 + [twin(benchmark, "effect", ("kelvin_voigt@T1",))] * 8}
    assert benchmark.shortcomings(missed) == ["damped_trunk: the effect is named in 8 of 10 twins"]
    lines = benchmark.report(many)
    assert any(line.startswith("one_arm 28: unknown") for line in lines)
    assert lines[-1] == "4 of 60 clean twins are not called so"


@pytest.mark.slow
def test_noise_is_no_gap_and_an_offset_beyond_what_is_stated_is_named(benchmark: ModuleType, tmp_path: Path) -> None:
    names = ["one_arm_encoders", "offset_beyond"]
    workers = WorkerConfig(n_processes=2)
    made = benchmark.record(names, 1, workers, tmp_path)
    twins = benchmark.diagnosed(made, "[kelvin_voigt, joint_viscous, effort_offset]", workers, tmp_path)
    assert [twin.error for entries in twins.values() for twin in entries] == ["", ""]
    assert benchmark.shortcomings(twins) == []
