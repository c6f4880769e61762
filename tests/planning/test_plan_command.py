"""The command `plan`: files that others read, parameters and effects of earlier runs, exit codes; and `information`."""

import html
import json

import h5py
import numpy as np
import pytest
from small_problems import pendulum_step, taken

from yid_ocp.config.reader import load_config
from yid_ocp.data import read_recording
from yid_ocp.data.recording_hdf5 import write_recording
from yid_ocp.integrator.step import compile_step
from yid_ocp.report.terminal import summary_blocks, summary_terminal_lines
from yid_ocp.workflow.build import build_system
from yid_ocp.workflow.plan import discrimination_plan_settings, identified_parameters_with_covariance, run_plan
from yid_ocp.workflow.simulate import run_simulate

PLAN = """\
problem: {path_cutoff: .inf}
plan: {point: tip, point_target_offset_from_start: [0.0, 0.15, 0.04], start_joint_positions: {shoulder: 0.2},
  duration: 0.7, hold_duration: 0.3, position_tolerance: 0.02}
"""
INFORMATION = """\
  elbow.damping: {free: true}
recordings: {estimate: [RECORDING]}
problem: {path_cutoff: 15.0, arm_tracking_feedback: none}
plan:
  {goal: information, duration: 0.8, hold_duration: 0.4, n_spline_coefficients: 3, n_random_starts: 2,
    limits: {max_acceleration: 15.0}}
"""
PAIR = ("joint_coulomb@shoulder", "joint_viscous@shoulder")


@pytest.fixture
def config(pendulum):
    return pendulum(PLAN)


@pytest.fixture
def informing(limited_urdf, pendulum, tmp_path):
    recording = tmp_path / "recording.h5"
    write_recording(taken(pendulum_step(limited_urdf.parent, prescribed=("shoulder",)), 3, steps=140), recording)
    return pendulum(INFORMATION.replace("RECORDING", str(recording)), "tip, lower")


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


def diagnosed(folder, stiffness):
    """What `diagnose` leaves, as far as a plan reads it."""
    folder.mkdir()
    which = [
        pair(label) | {"parameters": {name: {"value": value, "std": None, "unit": ""}}}
        for label, (name, value) in zip(PAIR, (("tau_c", 0.4), ("b", None)), strict=True)
    ]
    absorption = {"elbow.stiffness": {"before": stiffness, "after": 9.0, "std": 0.1, "unit": "N m/rad"}}
    result = {"format": "yid-diagnosis/2", "verdict": "confusable", "which": which, "absorption": absorption}
    (folder / "result.json").write_text(json.dumps(result))
    h5py.File(folder / "trajectories.h5", "w").close()
    return folder


def pair(label):
    kind, _, location = label.partition("@")
    return {"kind": kind, "location": location}


def test_the_run_folder_is_what_simulate_and_robots_read(config, tmp_path):
    outcome = run_plan(load_config(config), tmp_path / "out")
    assert outcome.is_successful, outcome.result["message"]
    assert outcome.result["format"] == "yid-plan/1"
    assert {path.name for path in outcome.folder.iterdir()} >= {
        "recording.h5", "csv", "trajectory.json", "result.json", "report.html", "config.yaml", "log.jsonl"
    }  # fmt: skip
    page = (outcome.folder / "report.html").read_text()
    assert '<section id="plan">' in page
    assert "may miss the target, because the plan uses initial values" in page
    message = json.loads((outcome.folder / "trajectory.json").read_text())
    assert message["joint_names"] == ["shoulder"]
    planned = outcome.output.joint_positions[:, 0]
    assert [p["positions"][0] for p in message["points"]] == pytest.approx(planned.tolist())
    times = [p["time_from_start"]["sec"] + 1e-9 * p["time_from_start"]["nanosec"] for p in message["points"]]
    assert times == pytest.approx(outcome.output.t.tolist())

    file = outcome.folder / "recording.h5"
    planned = read_recording(file)
    done = run_simulate(load_config(config, [f"recordings.estimate=[{file}]"]), tmp_path / "again")
    assert done.is_successful, done.result["message"]
    np.testing.assert_allclose(done.output.points[0].position, planned.points[0].position, atol=1e-6)


def test_parameters_and_their_uncertainty_come_from_a_run_of_solve(config, tmp_path):
    folder = solved(tmp_path / "solved", 4.0, 0.25)
    run = load_config(config, [f"plan.parameter_run_folder={folder}"])
    step = compile_step(build_system(run), 0.01, use_compiler=False)
    theta, known, source = identified_parameters_with_covariance(run, step)
    assert theta[step.system.parameters.index("elbow.stiffness")] == 4.0
    assert known.parameter_names == ("elbow.stiffness",)
    assert known.covariance.tolist() == [[0.0625]]
    assert source["parameters"] == {"elbow.stiffness": 4.0}
    assert max(run_plan(run, tmp_path / "out").result["std"]) > 1e-4
    # what is not known is not counted, and said
    run = load_config(config, [f"plan.parameter_run_folder={solved(tmp_path / 'unsure', 4.0, np.inf)}"])
    _, known, source = identified_parameters_with_covariance(run, step)
    assert known.parameter_names == ()
    assert source["uncertainty_unknown"] == ["elbow.stiffness"]


def test_a_plan_that_fails_says_so(config, carried_out):
    """A search that its limit of evaluations ends is not finished; one that finds its best motion is no use."""
    best = carried_out("plan", config, settings=["plan.duration=0.05"], codes=(1,), out="best")
    assert (best.result["unfinished"], best.out.startswith("Do not use this motion: ")) == (False, True)
    done = carried_out("plan", config, settings=["plan.duration=0.1"], codes=(1,))
    assert (done.result["unfinished"], done.out.startswith("Not finished: ")) == (True, True)
    assert done.result["status"] == "failed"
    assert done.result["message"] in done.out
    assert done.result["message"] in html.unescape((done.folder / "report.html").read_text())


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (["plan.parameter_run_folder=nowhere"], ("nowhere is not an existing folder", "plan.parameter_run_folder")),
        (["plan.goal=throw"], ("plan.goal", "place, path, box")),
        (["plan.limits.velocity_fraction=2"], ("plan.limits.velocity_fraction", "up to 1")),
        (["plan.point=tup"], ("no frame 'tup'", "did you mean 'tip'?", "--set plan.point")),
    ],
)
def test_wrong_input_leaves_nothing(config, refused, settings, words):
    refused(config, settings, words)


def test_a_run_that_failed_and_one_of_another_command_are_refused(config, tmp_path, refused):
    failed, other = solved(tmp_path / "failed", 4.0, 0.1, status="failed"), diagnosed(tmp_path / "diagnosed", 4.0)
    refused(config, [f"plan.parameter_run_folder={failed}"], ("failed: made up",))
    refused(config, [f"plan.parameter_run_folder={other}"], ("result of another command (format yid-diagnosis/2)",))


def test_a_run_with_effects_that_the_model_lacks_is_refused(config, tmp_path, printed):
    folder = solved(tmp_path / "solved", 4.0, 0.1, **{"point_mass@tip.mass": {"value": 0.1, "free": True}})
    chosen = ("plan", config, "--out", tmp_path / "out", "--set", f"plan.parameter_run_folder={folder}")
    told = printed(*chosen, code=2)
    assert "has effects that this one lacks: point_mass@tip" in told
    assert "model.effects" in told
    printed(*chosen, "--set", "model.effects=[{kind: point_mass, location: tip}]")
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    assert result["from"]["parameters"]["point_mass@tip.mass"] == 0.1


def test_the_run_folder_says_what_is_told_and_what_limits_it(informing, tmp_path):
    outcome = run_plan(load_config(informing), tmp_path / "out")
    assert outcome.is_successful, outcome.result["message"]
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    assert (result["format"], result["goal"]) == ("yid-plan/1", "information")
    assert {"recording.h5", "csv", "trajectory.json", "report.html"} <= {p.name for p in (tmp_path / "out").iterdir()}
    planned = read_recording(tmp_path / "out" / "recording.h5")
    np.testing.assert_allclose(planned.joints.position, outcome.output.joint_positions)
    assert '<section id="plan">' in (tmp_path / "out" / "report.html").read_text()
    words = " ".join(summary_terminal_lines(summary_blocks(result)))
    for name, known in outcome.output.parameter_precisions.items():
        assert result["parameters"][name]["std_relative_after"] == pytest.approx(known.std_planned)
        assert f"{100 * known.std_planned:.2g} %" in words
    assert all(name in words for names in result["limits_reached"].values() for name in names)
    assert "uses the initial values of the configuration" in words
    result["parameters"] = {name: own | {"verdict": "not_identifiable"} for name, own in result["parameters"].items()}
    assert summary_terminal_lines(summary_blocks(result))[0].startswith("Do not use this ")


def test_a_diagnosis_hands_over_its_parameters_and_effects(informing, tmp_path):
    folder = diagnosed(tmp_path / "diagnosed", 4.0)
    section = discrimination_plan_settings([[pair(label) for label in PAIR]], str(folder))
    found = {"effects_to_discriminate": list(PAIR), "parameter_run_folder": str(folder)}
    assert section == {"goal": "information", **found}
    assert discrimination_plan_settings([], str(folder)) is None
    result = {"summary": "", "verdict": "unknown", "next_plan": section, "seconds": {}, "which": []}
    result |= {"format": "yid-diagnosis/2", "unused_efforts": False, "gap": {"before": {"rmse": {}, "unit": {}}}}
    lines = summary_terminal_lines(summary_blocks(result))
    [command] = [line.strip() for line in lines if "yid-ocp plan" in line]
    assert command.startswith(f"yid-ocp plan {folder / 'config.yaml'} --set plan.goal=information")
    overrides = [f"plan.effects_to_discriminate=[{', '.join(PAIR)}]", f"plan.parameter_run_folder={folder}"]
    assert all(f"'{text}'" in command or text in command for text in overrides)
    outcome = run_plan(load_config(informing, [*overrides, "plan.max_iterations=3"]), tmp_path / "out")
    assert outcome.result["from"]["parameters"] == {"elbow.stiffness": 4.0, "elbow.damping": 0.2}
    assert {(entry["effect"], entry["explained_by"]) for entry in outcome.result["distances"]} == {PAIR, PAIR[::-1]}
    assert all(entry["after"] > entry["before"] for entry in outcome.result["distances"])
    told = summary_terminal_lines(summary_blocks(outcome.result))
    assert PAIR[0] in "\n".join(told)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (["plan.parameters_to_identify=[elbow.stif]"], ("no parameter 'elbow.stif'", "did you mean", "--set plan")),
        (["parameters.elbow.stiffness.free=false", "parameters.elbow.damping.free=false"], ("no parameter is free",)),
        (["recordings.estimate=[]"], ("no recording is listed for estimation",)),
        (["plan.duration=0.1", "plan.hold_duration=0.1"], ("too short", "plan.duration")),
    ],
)
def test_wrong_input_of_information_leaves_nothing(informing, refused, settings, words):
    refused(informing, settings, words)
