"""Scores of `benchmarks/coverage.py` and a small part of what it does; the arithmetic of its neighbours on torques."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from yid_ocp.data import JointGroup, Recording

pytest.importorskip("mujoco", reason="twins are made in MuJoCo: pip install 'yid-ocp[blind]'")


def loaded(folder: Path, name: str) -> ModuleType:
    """A module of the benchmarks, and those that it imports from there."""
    path = list(sys.path)
    spec = importlib.util.spec_from_file_location(name, folder / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    before = sys.modules.get(name)
    sys.modules[name] = module  # dataclasses look their module up, and neighbours import it
    sys.path.insert(0, str(folder))
    try:
        spec.loader.exec_module(module)
    finally:
        sys.path[:] = path
        if before is not None:
            sys.modules[name] = before
    return module


@pytest.fixture(scope="module")
def coverage(repository: Path) -> ModuleType:
    """The module benchmarks/coverage.py; a package of the same name may be loaded already."""
    return loaded(repository / "benchmarks", "coverage")


@pytest.fixture(scope="module")
def torque_noise(repository: Path) -> ModuleType:
    """The module benchmarks/torque_noise.py."""
    return loaded(repository / "benchmarks", "torque_noise")


@pytest.fixture(scope="module")
def torque_ensemble(repository: Path, coverage: ModuleType) -> Iterator[ModuleType]:
    """The module benchmarks/torque_ensemble.py, which imports coverage.py beside it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "coverage", coverage)
        yield loaded(repository / "benchmarks", "torque_ensemble")


def twin(coverage: ModuleType, z: dict[str, float | None], verdict: str = "identifiable", **found: Any) -> Any:
    """A twin whose estimates are off by so many standard deviations of 0.5; None for a std that is not known."""
    parameters = {
        name: {"value": 10.0 + 0.5 * (value or 0.0), "std": None if value is None else 0.5, "verdict": verdict}
        for name, value in z.items()
    }
    common = {"status": "converged", "seconds": 1.0, "chi2_per_dof": 1.0, "diagnose": False}
    return coverage.Twin(dict.fromkeys(z, 10.0), {**common, "parameters": parameters, **found})


def drawn(coverage: ModuleType, scale: float, count: int = 100) -> list[Any]:
    """Twins whose z are normal quantiles times a scale."""
    quantiles = coverage.scipy.stats.norm.ppf((np.arange(count) + 0.5) / count)
    return [twin(coverage, {"T1.bend": scale * value, "T2.bend": -scale * value}) for value in quantiles]


def test_only_parameters_that_are_called_found_or_weak_count(coverage: ModuleType) -> None:
    assert twin(coverage, {"T1.bend": 2.0, "T3.twist": None}).z == {"T1.bend": pytest.approx(2.0)}
    assert twin(coverage, {"T1.bend": -2.0}, "weak").z == {"T1.bend": pytest.approx(-2.0)}
    for verdict in ("fixed", "not_identifiable", "at_bound", "not_trusted"):
        assert twin(coverage, {"T1.bend": 2.0}, verdict).z == {}
    assert twin(coverage, {"T1.bend": 2.0}, status="failed").z == {}
    assert coverage.Twin(error="none of 50 motions").z == {}


def test_a_group_has_four_hundred_values_of_the_right_size(coverage: ModuleType) -> None:
    pools = {scale: coverage.pooled("white_0.1", drawn(coverage, scale, 200)) for scale in (0.7, 1.0, 1.3)}
    assert {scale: pool.honest for scale, pool in pools.items()} == {0.7: False, 1.0: True, 1.3: False}
    assert pools[1.0].rms == pytest.approx(1.0, abs=0.01)
    assert pools[1.0].covered == pytest.approx(0.95, abs=0.005)
    assert not coverage.pooled("white_0.1", drawn(coverage, 1.0, 100)).honest


def test_intervals_are_judged_beside_the_size(coverage: ModuleType) -> None:
    always = [twin(coverage, {"T1.bend": 1.0 if k % 2 else -1.0}) for k in range(400)]
    pool = coverage.pooled("white_0.1", always)
    assert (pool.rms, pool.covered) == (pytest.approx(1.0), 1.0)
    assert not pool.honest


def test_a_parameter_lies_in_the_band_of_chi_squared(coverage: ModuleType) -> None:
    # 40 degrees of freedom: the central 99.9 % is 16.906 to 76.095
    assert [coverage.in_band(total, 40) for total in (16.0, 17.0, 76.0, 77.0)] == [False, True, True, False]
    twins = [twin(coverage, {"T1.bend": 1.5, "T2.bend": 1.0}) for _ in range(40)]
    assert coverage.pooled("white_0.1", twins).outside == ("T1.bend",)


def test_cells_are_joined_until_there_are_enough_values(coverage: ModuleType) -> None:
    names = ("no_torque_error", "white_0.1", "white_0.5", "offsets_0.3", "mean_2khz")
    pools = [coverage.pooled(name, drawn(coverage, 1.0)) for name in names]
    groups = coverage.grouped(pools)
    assert [group.cells for group in groups] == [names[:2], names[2:]]
    assert [len(group.values) for group in groups] == [400, 600]
    assert [group.cells for group in coverage.grouped(pools[:1])] == [names[:1]]


def test_what_is_not_as_it_should_be_is_said(coverage: ModuleType) -> None:
    good = {"white_0.1": drawn(coverage, 1.0, 200)}
    assert coverage.shortcomings(good) == []
    bad = coverage.shortcomings({"white_0.1": [*drawn(coverage, 2.0, 200), coverage.Twin(error="no motion")]})
    assert bad[0] == "white_0.1: 1 of 201 twins have no estimate"
    assert bad[1:3] == [f"white_0.1: {name} lies outside its band" for name in ("T1.bend", "T2.bend")]
    assert "rms 1.99, 67.0 % covered" in bad[3]
    assert "too few to judge" in coverage.shortcomings({"white_0.1": drawn(coverage, 1.0, 10)})[0]


def test_errors_that_nobody_states_must_not_pass_for_findings(coverage: ModuleType) -> None:
    def entries(silent: int, **changed: Any) -> list[Any]:
        warned = twin(coverage, {"T1.bend": 9.0}, "not_trusted", diagnose=True)
        other = twin(coverage, {"T1.bend": 9.0}, **{"verdict": "not_trusted", "diagnose": True, **changed})
        return [warned] * silent + [other] * (40 - silent)

    for changed in ({"verdict": "identifiable"}, {"verdict": "weak"}, {"diagnose": False}, {"status": "failed"}):
        lines = coverage.shortcomings({"offsets_unstated": entries(37, **changed)})
        assert any("37 of 40 twins warn" in line for line in lines)
        assert not any(
            "twins warn" in line for line in coverage.shortcomings({"offsets_unstated": entries(38, **changed)})
        )
    assert "white_0.1" in coverage.CELLS
    assert not coverage.CELLS["offsets_unstated"].stated


def test_every_cell_has_its_row(coverage: ModuleType) -> None:
    twins = {"white_0.1": drawn(coverage, 1.0), "offsets_unstated": [coverage.Twin(error="no motion")]}
    lines = coverage.report(twins)
    assert [line.split()[0] for line in lines[2:4]] == list(twins)
    assert "offsets_unstated: no motion" in lines


def test_recipes_decide_what_is_kept(coverage: ModuleType) -> None:
    recipes = [cell.recipe for cell in coverage.CELLS.values()]
    steps, base = coverage.CELLS["steps_5ms"], coverage.CELLS["no_torque_error"]
    assert steps.recipe == base.recipe  # how a twin is solved does not change its recording
    assert len({coverage.json_sha256(recipe) for recipe in recipes}) == len(recipes) - 1


@pytest.mark.slow
@pytest.mark.parametrize("cell", ["no_torque_error"])
def test_standard_deviations_of_a_few_twins(coverage: ModuleType, tmp_path: Path, cell: str) -> None:
    """Six twins of a cell that holds: all z values together lie within the 99.9 % band of chi-squared."""
    chosen, twins = coverage.CELLS[cell], []
    for number in range(6):
        made = coverage.make_twin(cell, chosen.recipe, number, str(tmp_path), "test")
        assert min(made["roughness"][:6]) > 0.03
        found = coverage.solve_twin(chosen.config, Path(made["file"]), list(chosen.settings))
        twins.append(coverage.Twin(made["truth"], found))
    assert len({tuple(twin.truth.values()) for twin in twins}) == 6
    assert not any(twin.failed for twin in twins)
    values = coverage.pooled(cell, twins).values
    assert len(values) >= 18
    assert coverage.in_band(float(values @ values), len(values))


def test_white_noise_is_told_from_a_motion(torque_noise: ModuleType) -> None:
    rng, t = np.random.default_rng(0), np.arange(5000) / 100
    std = np.array([0.02, 0.1])
    motion = 5.0 * np.sin(2 * np.pi * 1.3 * t)[:, None] + 8.0
    effort = motion + std * rng.standard_normal((5000, 2))
    recording = Recording(JointGroup(("a", "b"), t, np.zeros((5000, 2)), effort=effort))
    np.testing.assert_allclose(torque_noise.white_std(recording), std, rtol=0.1)
    smooth = Recording(JointGroup(("a", "b"), t, np.zeros((5000, 2)), effort=np.hstack([motion, motion])))
    expected = 5.0 / np.sqrt(2) * (2 - 2 * np.cos(2 * np.pi * 1.3 / 100))
    np.testing.assert_allclose(torque_noise.roughness(smooth), expected, rtol=1e-2)


def test_the_ensemble_stands_beside_what_was_published(torque_ensemble: ModuleType) -> None:
    members = {name: [0.5 * value, value, 2 * value] for name, value in torque_ensemble.TRUTH.items()}
    none = {name: [] for name in members}
    lines = torque_ensemble.report({"single_arm_no_vision": {"offsets": members, "both": none}})
    bend = next(line for line in lines if line.startswith("T1.bend"))
    assert bend.split() == ["T1.bend", "22", "23.78", "11", "..", "22", "..", "44*", "-"]
    assert "*" not in next(line for line in lines if line.startswith("T1.twist"))
