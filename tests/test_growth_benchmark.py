"""The arithmetic of `benchmarks/growth.py`, and its smallest points."""

from __future__ import annotations

import json
import math
from pathlib import Path
from types import ModuleType

import pytest
from test_coverage_benchmark import loaded


@pytest.fixture(scope="module")
def growth(repository: Path) -> ModuleType:
    """The module benchmarks/growth.py."""
    return loaded(repository / "benchmarks", "growth")


def test_a_slope_is_that_of_logarithms(growth: ModuleType) -> None:
    points = [{"n": n, "cpu": 3e-6 * n**1.7, "memory": 5.0 * n} for n in (25, 43, 151)]
    assert growth.slope(points, "n", "cpu") == pytest.approx(1.7)
    assert growth.slope(points, "n", "memory") == pytest.approx(1.0)
    assert math.isnan(growth.slope(points[:1], "n", "cpu"))
    assert math.isnan(growth.slope([{"n": 1, "cpu": 1.0}, {"n": 2, "cpu": 0.0}], "n", "cpu"))


def test_points_are_measured_stored_and_shown(growth: ModuleType, tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(growth, "alone", lambda function, *arguments: function(*arguments))
    monkeypatch.setitem(growth.HORIZONS, True, (5, 10, 40))
    assert growth.main(["horizon", "--quick", "--largest", "10", "--json", str(tmp_path / "growth.json")]) == 0
    found = json.loads((tmp_path / "growth.json").read_text())
    assert [(point["variables"], point["steps"]) for point in found["points"]["horizon"]] == [(16, 5), (16, 10)]
    assert all(point["cpu"] > 0 for point in found["points"]["horizon"])
    assert "cpu" in found["slopes"]["horizon"]
    assert "slope" in capsys.readouterr().out


def test_workers_that_are_always_busy_and_waste_nothing_are_worth_themselves(growth: ModuleType, monkeypatch) -> None:
    def shared(settings, count, cases):
        return {"workers": count, "cpu": 10.0 * (1 if count == 1 else 1.25), "occupied": 1.0 / count}, [1.0] * cases

    monkeypatch.setattr(growth, "case", lambda *_: None)
    monkeypatch.setattr(growth, "shared", shared)
    found = growth.efficiency([1, 2], 3, True)
    assert [point["efficiency"] for point in found] == [1.0, pytest.approx(0.8 * 0.5)]
    monkeypatch.setattr(growth, "shared", lambda settings, count, cases: (shared(settings, count, cases)[0], [count]))
    with pytest.raises(AssertionError, match="workers change the answers"):
        growth.efficiency([1, 2], 3, True)


def test_an_axis_that_is_not_there_is_refused(growth: ModuleType, capsys) -> None:
    with pytest.raises(SystemExit):
        growth.main(["depth"])
    assert "there is no axis 'depth'; choose from variables, horizon" in capsys.readouterr().err
