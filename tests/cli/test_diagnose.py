"""The command `diagnose`: a run folder, words for people, the embedded example."""

from __future__ import annotations

import importlib
import json
from dataclasses import replace
from types import SimpleNamespace

import h5py
import numpy as np
import pytest

from yid_ocp.config.reader import DIAGNOSIS_DEFAULT, load_config
from yid_ocp.data import read_recording, write_recording
from yid_ocp.diagnosis import Refitted
from yid_ocp.workflow.diagnose import reproducing, run_diagnose
from yid_ocp.workflow.folder import new_run_folder
from yid_ocp.workflow.refits import Refits


def test_a_diagnosis_leaves_a_run_folder(cli, pendulum, tmp_path):
    chosen = ("--set", "diagnosis.candidates=[joint_coulomb, link_mass@elbow]", "--set", "output.report=false")
    done = cli("diagnose", pendulum, "--out", tmp_path / "run", *chosen)
    assert done.code == 0, done.err
    result = json.loads((tmp_path / "run" / "result.json").read_text())
    assert result["format"] == "yid-diagnosis/1"
    assert result["verdict"] in done.out
    assert result["verdict"] == "no_gap"
    assert {"config.yaml", "log.jsonl", "trajectories.h5"} <= {path.name for path in (tmp_path / "run").iterdir()}
    with h5py.File(tmp_path / "run" / "trajectories.h5") as file:
        group = file[f"{result['gap']['held_out'][0]}/joints.effort"]
        assert group["before"].shape == group["after"].shape == group["measured"].shape


def test_candidates_that_do_not_fit_are_said(cli, pendulum, tmp_path):
    done = cli("diagnose", pendulum, "--out", tmp_path / "run", "--set", "diagnosis.candidates=[kelvin_voigt]")
    assert done.code == 2
    assert "kelvin_voigt does not fit" in done.err
    assert not (tmp_path / "run").exists()


# -- a pendulum whose elbow rubs, which the model does not know -------------------------------------------------------


@pytest.fixture(scope="module")
def rubbing(tmp_path_factory, pendulum_data):
    """The pendulum's configuration for recordings with friction in the elbow."""
    folder = tmp_path_factory.mktemp("rubbing")
    for name in ("estimate", "held_out"):
        recording = read_recording(pendulum_data.folder / f"{name}.h5")
        joints = recording.joints
        rubbed = joints.effort.copy()
        rubbed[:, 1] += 0.03 * np.sign(np.gradient(joints.position[:, 1]))
        write_recording(replace(recording, joints=replace(joints, effort=rubbed)), folder / f"{name}.h5")
    text = pendulum_data.text.replace(str(pendulum_data.folder), str(folder))
    file = folder / "rubbing.yaml"
    file.write_text(
        f"{text}diagnosis: {{candidates: [joint_coulomb, effort_offset, link_mass@elbow], effects: 1}}\n"
        "output: {report: false}\n"
    )
    return file


def without_times(folder) -> dict:
    result = json.loads((folder / "result.json").read_text())
    return {name: value for name, value in result.items() if name not in ("seconds", "command", "inputs")}


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
    module = importlib.import_module("yid_ocp.diagnosis.refit")
    solver = module.SOLVER

    class Counting:
        def run(self, *arguments):
            calls.count += 1
            return solver.run(*arguments)

    monkeypatch.setattr(module, "SOLVER", Counting())
    return calls


class Interrupting:
    """A monitor that presses Ctrl-C after so many refits."""

    def __init__(self, after: int) -> None:
        self.left = after

    def stage(self, text: str) -> None:
        self.left -= text.startswith("refitted")
        if self.left <= 0:
            raise KeyboardInterrupt

    def iterate(self, entry) -> None: ...

    def advance(self, done, total, text) -> None: ...


def test_an_interrupted_diagnosis_takes_up_its_finished_refits(rubbing, tmp_path, counted, caplog):
    run = load_config(rubbing)
    whole = run_diagnose(run, tmp_path / "whole")
    once, counted.count = counted.count, 0
    with pytest.raises(KeyboardInterrupt):
        run_diagnose(run, tmp_path / "run", Interrupting(after=1))
    done, counted.count = counted.count, 0
    assert 0 < done <= once
    assert "the same command takes them up" in caplog.text
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith("run")] == ["run.partial"]
    again = run_diagnose(run, tmp_path / "run")
    assert counted.count == once - done
    assert close(without_times(again.folder), without_times(whole.folder))
    lines = [json.loads(line) for line in (again.folder / "log.jsonl").read_text().splitlines()]
    assert {"the nominal model"} < {line["refit"] for line in lines if line["event"] == "taken_up"}
    assert any("resumed the refit with" in line.get("text", "") for line in lines)
    assert not (tmp_path / "run.partial").exists()
    assert not list(tmp_path.glob(".*"))


def test_a_changed_configuration_takes_nothing_up(rubbing, tmp_path, monkeypatch, caplog):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        run_diagnose(load_config(rubbing), None, Interrupting(after=1))
    assert (tmp_path / "runs" / "rubbing-diagnose.partial" / "refits.json").is_file()
    caplog.clear()
    outcome = run_diagnose(load_config(rubbing, ["diagnosis.level=0.02"]))
    assert sum("not taken up" in record.getMessage() for record in caplog.records) == 1
    assert "taken_up" not in (outcome.folder / "log.jsonl").read_text()
    assert list((tmp_path / "runs").iterdir()) == [outcome.folder]


@pytest.mark.parametrize("spoil", ["nothing", "inputs", "version", "half a file", "other text"])
def test_kept_refits_count_only_for_what_they_were_made_from(spoil, rubbing, tmp_path, caplog):
    made_from = [{"a.h5": "12"}, "a: 1", {"yid-ocp": "1.0"}]
    refitted = Refitted({"b": 0.1 + 0.2}, {"b": float("inf")}, "done")
    with new_run_folder(load_config(rubbing), tmp_path / "run") as folder:
        first = Refits(folder, *made_from)
        first.put("joint_coulomb@elbow", refitted)
        if spoil == "inputs":
            made_from[0] = {"a.h5": "34"}
        elif spoil == "version":
            made_from[2] = {"yid-ocp": "1.1"}
        elif spoil == "half a file":
            first.file.write_text(first.file.read_text()[:40])
        elif spoil == "other text":
            first.file.write_text("[1, 2]")
        second = Refits(folder, *made_from)
        assert second.get("joint_coulomb@elbow") == (refitted if spoil == "nothing" else None)
        assert second.get("joint_viscous@elbow") is None
        assert len(caplog.records) == (0 if spoil == "nothing" else 1)
        second.clear()
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


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
    changed = load_config(rubbing, ["diagnosis.level=0.02"])
    assert reproducing(changed, tmp_path / "runs" / "a b") == "yid-ocp diagnose 'runs/a b/config.yaml'"
    assert reproducing(load_config(None, (), DIAGNOSIS_DEFAULT), tmp_path) == "yid-ocp diagnose"


def test_a_deviation_that_is_mostly_the_models_error(cli, pendulum, tmp_path):
    """Deviations ten times the noise, of which a tenth is noise, are the noise again."""
    chosen = ("--set", "diagnosis.candidates=[joint_coulomb]", "--set", "output.report=false")
    found = []
    for std, share in ((0.01, 1.0), (0.1, 0.1)):
        out = tmp_path / f"run_{std}_{share}"
        settings = ("--set", f"sensors.joints.effort.std={std}", "--set", f"diagnosis.noise_fraction={share}")
        assert cli("diagnose", pendulum, "--out", out, *chosen, *settings).code == 0
        found.append(json.loads((out / "result.json").read_text())["gap"]["before"]["chi2_per_dof"])
    assert found[1] == pytest.approx(found[0], rel=0.01)


def test_a_share_of_an_unstated_deviation_is_refused(cli, pendulum, tmp_path):
    done = cli("diagnose", pendulum, "--out", tmp_path / "run", "--set", "diagnosis.noise_fraction=0.1")
    assert done.code == 2
    assert "set sensors.joints.effort.std" in done.err


@pytest.mark.slow
def test_the_embedded_example_finds_what_was_withheld(cli, tmp_path):
    done = cli("diagnose", "--out", tmp_path / "run")
    assert done.code == 0, done.err
    result = json.loads((tmp_path / "run" / "result.json").read_text())
    assert result["verdict"] == "effect"
    assert result["effects"] == [{"kind": "kelvin_voigt", "location": "T1"}]
    assert result["which"][0]["parameters"]["tau"]["value"] == pytest.approx(0.05, rel=0.1)
    assert result["gap"]["closure_ci"][0] > 0.9
    assert (tmp_path / "run" / "report.html").exists()
