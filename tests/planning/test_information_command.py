"""The goal `information` from the command line: run folder, words, parameters and effects of a diagnosis."""

from __future__ import annotations

import json

import h5py
import numpy as np
import pytest
from small_problems import pendulum_step, taken

from yid_ocp.config.reader import load_config
from yid_ocp.data import read_recording
from yid_ocp.data.recording_hdf5 import write_recording
from yid_ocp.report.diagnosis_summaries import _planning_command
from yid_ocp.report.summaries import plan_summary
from yid_ocp.report.terminal import summary_terminal_lines
from yid_ocp.workflow.plan import discrimination_plan_settings, run_plan

PLAN = """\
  elbow.damping: {free: true}
recordings: {estimate: [RECORDING]}
problem: {path_cutoff: 15.0, feedback: none}
plan:
  {goal: information, duration: 0.8, hold_duration: 0.4, n_spline_coefficients: 3, n_random_starts: 2,
    limits: {max_acceleration: 15.0}}
"""
PAIR = ("joint_coulomb@shoulder", "joint_viscous@shoulder")


@pytest.fixture
def config(limited_urdf, pendulum, tmp_path):
    recording = tmp_path / "recording.h5"
    write_recording(taken(pendulum_step(limited_urdf.parent, prescribed=("shoulder",)), 3, steps=140), recording)
    return pendulum(PLAN.replace("RECORDING", str(recording)), "tip, lower")


def diagnosed(folder, stiffness, verdict="confusable"):
    """What `diagnose` leaves, as far as a plan reads it."""
    folder.mkdir()
    sizes = {PAIR[0]: {"tau_c": 0.4}, PAIR[1]: {"b": None}}
    which = [
        {
            "kind": label.partition("@")[0],
            "location": label.partition("@")[2],
            "parameters": {name: {"value": value, "std": None, "unit": ""} for name, value in sizes[label].items()},
        }
        for label in PAIR
    ]
    absorption = {"elbow.stiffness": {"before": stiffness, "after": 9.0, "std": 0.1, "unit": "N m/rad"}}
    result = {"format": "yid-diagnosis/2", "verdict": verdict, "which": which, "absorption": absorption}
    (folder / "result.json").write_text(json.dumps(result))
    h5py.File(folder / "trajectories.h5", "w").close()
    return folder


def test_the_run_folder_says_what_is_told_and_what_limits_it(config, tmp_path):
    outcome = run_plan(load_config(config), tmp_path / "out")
    assert outcome.is_successful, outcome.result["message"]
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    assert result["format"] == "yid-plan/1"
    assert result["goal"] == "information"
    assert {"recording.h5", "csv", "trajectory.json", "report.html"} <= {p.name for p in (tmp_path / "out").iterdir()}
    planned = read_recording(tmp_path / "out" / "recording.h5")
    np.testing.assert_allclose(planned.joints.position, outcome.output.joint_positions)
    page = (tmp_path / "out" / "report.html").read_text()
    assert '<section id="information">' in page
    words = "\n".join(summary_terminal_lines(plan_summary(result)))
    for name, known in outcome.output.parameter_precisions.items():
        assert result["parameters"][name]["std_relative_after"] == pytest.approx(known.std_planned)
        assert f"± {100 * known.std_planned:.2g} %" in words
    assert "tells most" in words
    assert all(name in words for names in result["limits_reached"].values() for name in names)
    assert "the parameters are those of the configuration" in words


def test_a_diagnosis_hands_over_its_parameters_and_effects(config, tmp_path):
    folder = diagnosed(tmp_path / "diagnosed", 4.0)
    alike = [[{"kind": label.partition("@")[0], "location": label.partition("@")[2]} for label in PAIR]]
    section = discrimination_plan_settings(alike, folder)
    assert section == {"goal": "information", "discriminate": list(PAIR), "parameter_run": str(folder)}
    assert discrimination_plan_settings([], folder) is None
    command = _planning_command(section)
    assert command.startswith(f"yid-ocp plan {folder / 'config.yaml'} --set plan.goal=information")
    overrides = [f"plan.discriminate=[{', '.join(PAIR)}]", f"plan.parameter_run={folder}", "plan.max_iterations=3"]
    assert all(f"'{text}'" in command or text in command for text in overrides[:2])
    outcome = run_plan(load_config(config, overrides), tmp_path / "out")
    assert outcome.result["from"]["parameters"] == {"elbow.stiffness": 4.0, "elbow.damping": 0.2}
    pairs = {(entry["effect"], entry["explained_by"]) for entry in outcome.result["distances"]}
    assert pairs == {PAIR, PAIR[::-1]}
    assert all(entry["after"] > entry["before"] for entry in outcome.result["distances"])
    assert f"{PAIR[0]}" in "\n".join(summary_terminal_lines(plan_summary(outcome.result)))


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (["plan.identify=[elbow.stifness]"], ("no parameter 'elbow.stifness'", "did you mean", "pendulum.yaml")),
        (["parameters.elbow.stiffness.free=false", "parameters.elbow.damping.free=false"], ("no parameter is free",)),
        (["recordings.estimate=[]"], ("no recording to estimate on",)),
        (["plan.parameter_run=nowhere"], ("no finished run of `solve` or `diagnose`", "plan.parameter_run")),
        (["plan.duration=0.1", "plan.hold_duration=0.1"], ("too short", "plan.duration")),
    ],
)
def test_wrong_input_leaves_nothing(config, refused, settings, words):
    refused(config, settings, words)


def test_other_goals_do_not_take_a_diagnosis(config, tmp_path, refused):
    folder = diagnosed(tmp_path / "diagnosed", 4.0)
    settings = ["plan.goal=place", "plan.point=tip", "plan.target_offset=[0,0.1,0]", f"plan.parameter_run={folder}"]
    refused(config, settings, ("run folder of another command (yid-diagnosis/2)",))
