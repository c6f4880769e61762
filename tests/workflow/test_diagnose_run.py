"""What a diagnosis leaves in its run folder, and how it goes on after an interruption."""

from __future__ import annotations

import json
from importlib import import_module
from types import SimpleNamespace

import h5py
import numpy as np
import pytest

from yid_ocp.config.reader import DEFAULT_DIAGNOSIS_CONFIG, load_config
from yid_ocp.diagnosis.refit import REFIT_SOLVER
from yid_ocp.workflow.diagnose import run_diagnose
from yid_ocp.workflow.run_folder import _reproducing_command


def without_times(folder) -> dict:
    result = json.loads((folder / "result.json").read_text())
    return {name: value for name, value in result.items() if name not in ("seconds", "command", "date", "inputs")}


def close(one, other) -> bool:
    """Equal but for the rounding of a rollout that begins from another guess."""
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(close(one[name], other[name]) for name in one)
    if isinstance(one, list):
        return len(one) == len(other) and all(map(close, one, other))
    return one == (pytest.approx(other, rel=1e-6, abs=1e-9) if isinstance(one, float) else other)


@pytest.fixture
def counted(monkeypatch):
    """How often the solver of refits is called."""
    calls = SimpleNamespace(count=0)

    class Counting:
        def run(self, *arguments):
            calls.count += 1
            return REFIT_SOLVER.minimize_cost(*arguments)

    monkeypatch.setattr(import_module("yid_ocp.diagnosis.refit_with_effects"), "SOLVER", Counting())
    return calls


class Interrupting:
    """Progress that presses Ctrl-C after so many refits."""

    def __init__(self, after: int) -> None:
        self.left = after

    def stage(self, text: str) -> None: ...

    def iterate(self, entry) -> None: ...

    def advance(self, done: int, total: int, text: str) -> None:
        self.left -= text.startswith("refitted")
        if self.left <= 0:
            raise KeyboardInterrupt


def test_an_interrupted_diagnosis_resumes_its_finished_refits(rubbing, tmp_path, counted, caplog):
    run = load_config(rubbing)
    whole = run_diagnose(run, tmp_path / "whole")
    once, counted.count = counted.count, 0
    with pytest.raises(KeyboardInterrupt):
        run_diagnose(run, tmp_path / "run", Interrupting(after=1))
    done, counted.count = counted.count, 0
    assert 0 < done <= once
    assert "the same command resumes them" in caplog.text
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith("run")] == ["run.partial"]
    again = run_diagnose(run, tmp_path / "run")
    assert counted.count == once - done
    assert close(without_times(again.folder), without_times(whole.folder))
    lines = [json.loads(line) for line in (again.folder / "log.jsonl").read_text().splitlines()]
    assert {"the nominal model"} < {line["refit"] for line in lines if line["event"] == "resumed"}
    assert any("resumed the refit with" in line.get("text", "") for line in lines)
    assert not (tmp_path / "run.partial").exists()
    assert not list(tmp_path.glob(".*"))


def test_a_changed_configuration_resumes_nothing(rubbing, tmp_path, monkeypatch, caplog):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        run_diagnose(load_config(rubbing), None, Interrupting(after=1))
    assert (tmp_path / "runs" / "rubbing-diagnose.partial" / "refits.json").is_file()
    caplog.clear()
    outcome = run_diagnose(load_config(rubbing, ["diagnosis.significance_level=0.02"]))
    assert sum("not resumed" in record.getMessage() for record in caplog.records) == 1
    assert '"resumed"' not in (outcome.folder / "log.jsonl").read_text()
    assert list((tmp_path / "runs").iterdir()) == [outcome.folder]


def test_the_result_says_how_sure_a_closure_is_and_where_the_unknown_forces_are(rubbing, tmp_path):
    outcome = run_diagnose(load_config(rubbing), tmp_path / "run")
    assert outcome.result["command"] == f"yid-ocp diagnose {rubbing}"
    assert outcome.result["effects"] == [{"kind": "joint_coulomb", "location": "elbow"}]
    refitted = [entry for entry in outcome.result["which"] if entry["closure"] is not None]
    assert refitted
    for entry in refitted:
        low, high = entry["closure_ci"]
        assert low <= high
    assert all(entry["closure_ci"] is None for entry in outcome.result["which"] if entry["closure"] is None)
    with h5py.File(outcome.folder / "trajectories.h5") as file:
        group = file["where/estimate"]
        names = list(group.attrs["unknowns"])
        assert group["mean"].shape == group["std"].shape == (len(group["edges"]) - 1, len(names))
        assert list(group.attrs["units"]) == ["N m"] * len(names)
        assert set(group.attrs["kinds"]) == {"force"}
        elbow = names.index("elbow")
        assert group.attrs["locations"][elbow] == "elbow"
        assert group["prior"][elbow] > 0
        # friction of 0.03 N m, part of which the damping takes for itself
        assert 0.005 < np.max(np.abs(group["mean"][:, elbow])) < 0.06


def test_the_command_that_gives_a_result_again(rubbing, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    changed = load_config(rubbing, ["diagnosis.significance_level=0.02"])
    assert (
        _reproducing_command(changed, tmp_path / "runs" / "a b", "diagnose")
        == "yid-ocp diagnose 'runs/a b/config.yaml'"
    )
    assert (
        _reproducing_command(load_config(None, (), DEFAULT_DIAGNOSIS_CONFIG), tmp_path, "diagnose")
        == "yid-ocp diagnose"
    )
