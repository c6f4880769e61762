"""The command `plan`: files that others read, parameters from a run of `solve`, exit codes."""

from __future__ import annotations

import html
import json

import h5py
import numpy as np
import pytest

from yid_ocp.cli import main
from yid_ocp.config.reader import load_config
from yid_ocp.data import read_recording
from yid_ocp.workflow.plan import compile_step_for_planning, identified_parameters_with_covariance, run_plan
from yid_ocp.workflow.simulate import run_simulate

PLAN = """\
problem: {path_cutoff: .inf}
plan: {point: tip, target_offset: [0.0, 0.15, 0.04], start_joint_positions: {shoulder: 0.2}, duration: 0.7,
  hold_duration: 0.3, position_tolerance: 0.02}
"""


@pytest.fixture
def config(pendulum):
    return pendulum(PLAN)


def solved(folder, stiffness, std, status="converged", **more):
    """What `solve` leaves, as far as a plan reads it."""
    folder.mkdir()
    parameters = {"elbow.stiffness": {"value": stiffness, "free": True}} | more
    result = {"format": "yid-solve/1", "status": status, "message": "made up", "parameters": parameters}
    (folder / "result.json").write_text(json.dumps(result))
    with h5py.File(folder / "trajectories.h5", "w") as file:
        unknowns = file.create_group("unknowns")
        unknowns.attrs["names"] = np.array(["elbow.stiffness"], dtype=h5py.string_dtype())
        unknowns.create_dataset("covariance", data=[[std**2]])
    return folder


def test_the_run_folder_is_what_simulate_and_robots_read(config, tmp_path):
    outcome = run_plan(load_config(config), tmp_path / "out")
    assert outcome.is_successful, outcome.result["message"]
    assert outcome.result["format"] == "yid-plan/1"
    assert {path.name for path in outcome.folder.iterdir()} >= {
        "recording.h5", "csv", "trajectory.json", "result.json", "report.html", "config.yaml", "log.jsonl"
    }  # fmt: skip
    page = (outcome.folder / "report.html").read_text()
    assert '<section id="plan">' in page
    assert "of how uncertain that is" in page
    message = json.loads((outcome.folder / "trajectory.json").read_text())
    assert message["joint_names"] == ["shoulder"]
    planned = outcome.output.joint_positions[:, 0]
    assert [p["positions"][0] for p in message["points"]] == pytest.approx(planned.tolist())
    times = [p["time_from_start"]["sec"] + 1e-9 * p["time_from_start"]["nanosec"] for p in message["points"]]
    assert times == pytest.approx(outcome.output.t.tolist())

    file = outcome.folder / "recording.h5"
    planned = read_recording(file)
    again = load_config(config, [f"recordings.estimate=[{file}]"])
    done = run_simulate(again, tmp_path / "again")
    assert done.is_successful, done.result["message"]
    np.testing.assert_allclose(done.output.points[0].position, planned.points[0].position, atol=1e-6)


def test_parameters_and_their_uncertainty_come_from_a_run_of_solve(config, tmp_path):
    folder = solved(tmp_path / "solved", 4.0, 0.25)
    run = load_config(config, [f"plan.parameter_run={folder}"])
    step = compile_step_for_planning(run)
    theta, known, source = identified_parameters_with_covariance(run, step)
    assert theta[step.system.parameters.index("elbow.stiffness")] == 4.0
    assert known.parameter_names == ("elbow.stiffness",)
    assert known.covariance.tolist() == [[0.0625]]
    assert source["parameters"] == {"elbow.stiffness": 4.0}
    outcome = run_plan(run, tmp_path / "out")
    assert max(outcome.result["std"]) > 1e-4
    # what is not known is not counted, and said
    run = load_config(config, [f"plan.parameter_run={solved(tmp_path / 'unsure', 4.0, np.inf)}"])
    _, known, source = identified_parameters_with_covariance(run, step)
    assert known.parameter_names == ()
    assert source["uncertainty_unknown"] == ["elbow.stiffness"]


def test_a_plan_that_fails_says_so(config, tmp_path, capsys):
    assert main(["plan", str(config), "--out", str(tmp_path / "out"), "--set", "plan.duration=0.1"]) == 1
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    assert result["status"] == "failed"
    assert result["message"] in capsys.readouterr().out
    assert result["message"] in html.unescape((tmp_path / "out" / "report.html").read_text())


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (["plan.parameter_run=nowhere"], ("no finished run of `solve`", "plan.parameter_run")),
        (["plan.goal=throw"], ("plan.goal", "place, path, box")),
        (["plan.limits.velocity_fraction=2"], ("plan.limits.velocity_fraction", "up to 1")),
        (["plan.point=tup"], ("no frame 'tup'", "did you mean 'tip'?", "pendulum.yaml")),
    ],
)
def test_wrong_input_leaves_nothing(config, refused, settings, words):
    refused(config, settings, words)


def test_a_folder_of_another_kind_is_refused(config, tmp_path, capsys):
    failed = solved(tmp_path / "failed", 4.0, 0.1, status="failed")
    assert main(["plan", str(config), "--out", str(tmp_path / "out"), "--set", f"plan.parameter_run={failed}"]) == 2
    assert "failed: made up" in capsys.readouterr().err


def test_a_run_with_effects_that_the_model_lacks_is_refused(config, tmp_path, capsys):
    more = {"point_mass@tip.mass": {"value": 0.1, "free": True}}
    folder = solved(tmp_path / "solved", 4.0, 0.1, **more)
    chosen = ("plan", str(config), "--out", str(tmp_path / "out"), "--set", f"plan.parameter_run={folder}")
    assert main(list(chosen)) == 2
    told = capsys.readouterr().err
    assert "was solved with point_mass@tip, which this model does not have" in told
    assert "model.effects" in told
    with_it = "model.effects=[{kind: point_mass, location: tip}]"
    assert main([*chosen, "--set", with_it]) == 0
    assert (
        json.loads((tmp_path / "out" / "result.json").read_text())["from"]["parameters"]["point_mass@tip.mass"] == 0.1
    )
