"""Objects held by clamps or the world, frames and markers."""

import json
from dataclasses import replace

import numpy as np
import pytest

from yid_ocp.analysis.run_estimates import RunEstimates
from yid_ocp.config.reader import load_config
from yid_ocp.data.recording import PointGroup, Recording
from yid_ocp.data.recording_hdf5 import write_recording
from yid_ocp.diagnosis.baseline import problem_with_priors_and_baseline
from yid_ocp.errors import ConfigError, DataError
from yid_ocp.solvers import GaussNewton, MultipleShooting, fit_problem
from yid_ocp.workflow import run_history
from yid_ocp.workflow.build import build_system
from yid_ocp.workflow.build_problem import build_problem, make_problem_options
from yid_ocp.workflow.run_inputs import read_recordings_of_role
from yid_ocp.workflow.simulate import run_simulate

BEAM = """
model:
  object:
    kind: segments
    mount: {xyz: [0.1, 0.2, 0.3], rpy: [0.0, 1.5707963267948966, 0.0]}
    named_segments:
      beam:
        {length: 0.1, mass: 0.1, cross_section_size: [0.03, 0.03], links: 2, values_given_as_rigidities: true,
         clamped_at_base: true, joint_axes: y}
  frames:
    mark: {parent_frame: w_beam, use_recorded_straight_position: true}
recordings: {estimate: [beam.h5]}
sensors: {points: {std: 1.0e-4}}
parameters:
  beam.bend: {free: true, initial: 0.02}
  beam.damping: {free: true, initial: 5.0e-5}
problem: {time_step: 0.01, use_compiler: false, initial_state: estimated, duration: 0.4}
output: {write_report: false, checked_discretisation: none}
"""
STRAIGHT = np.array([0.2, 0.2, 0.32])  # the tip's face is at 0.2, 0.2, 0.3


def blank(straight=STRAIGHT, name="mark"):
    t, position = np.arange(41) * 0.01, np.broadcast_to(STRAIGHT - np.array([0.0, 0.0, 0.004]), (41, 1, 3))
    points = (PointGroup("points", (name,), t, position, 1e-4),)
    return Recording(None, points, marker_reference_pose=None if straight is None else straight[None, :])


def settings(folder, recording=None, overrides=()):
    write_recording(blank() if recording is None else recording, folder / "beam.h5")
    (folder / "beam.yaml").write_text(BEAM, encoding="utf-8")
    return load_config(folder / "beam.yaml", overrides)


@pytest.fixture
def run(tmp_path):
    return settings(tmp_path)


def test_every_recording_has_its_own_places_of_markers_in_the_frame_that_carries_them(run):
    system = build_system(run)
    found = [system.parameters[f"mark.{axis}"].value for axis in "xyz"]
    # the link's z axis is the world's x, its x axis looks down
    assert found == pytest.approx([-0.02, 0.0, 0.0], abs=1e-9)
    other = replace(blank(STRAIGHT + np.array([0.0, 0.005, 0.0])), name="other")
    problem = build_problem(run, reference_recordings=[other])
    assert problem.options.parameters_by_recording["beam"]["mark.y"] == pytest.approx(0.0, abs=1e-9)
    assert problem.options.parameters_by_recording["other"]["mark.y"] == pytest.approx(0.005, abs=1e-9)


@pytest.mark.parametrize(
    ("overrides", "recording", "kind", "words"),
    [
        ((), blank(None), DataError, "has no marker positions"),
        ((), blank(name="elsewhere"), ConfigError, "lacks the point 'mark', where the frame of this name is placed"),
        (("model.frames.mark.parent_frame=w_bean",), None, ConfigError, "its parent is not a frame of the object"),
        (("model.arms.joints=[elbow]",), None, ConfigError, "the model has no robot"),
        (("model.frames.foot={}", "model.object.mount.parent_frame=foot"), None, ConfigError, "moves"),
    ],
)
def test_what_an_object_without_a_robot_cannot_have_is_refused_in_words(tmp_path, overrides, recording, kind, words):
    run = settings(tmp_path, recording, overrides)
    with pytest.raises(kind, match=words):
        build_problem(run)


def test_points_of_a_cable_may_be_in_groups_with_their_own_times(tmp_path):
    """The clamps are seen every 10 ms, and the cable between them every 30 ms."""
    (tmp_path / "shape.csv").write_text("point,x,y,z\n" + "".join(f"p{i},{i},0,0\n" for i in range(5)))
    x, held = np.tile(np.arange(5)[:, None] * np.eye(3)[0], (31, 1, 1)), ("p0", "p1", "p3", "p4")
    clamps = PointGroup("points_clamps", held, 0.01 * np.arange(31), x[:, [0, 1, 3, 4]])
    recording = Recording(None, (PointGroup("points", ("p2",), 0.03 * np.arange(11), x[:11, [2]]), clamps))
    item = "{kind: cable, main_branch_vertex_names: [p0, p1, p2, p3, p4], undeformed_shape_file: shape.csv}"
    run = settings(tmp_path, recording, (f"model.object={item}", "model.frames={}", "parameters={}", "sensors={}"))
    sensors = make_problem_options(run, build_system(run), read_recordings_of_role(run)).sensors
    assert (sensors["points"].used_points, sensors["points_clamps"].use) == (("p2",), False)


def test_without_a_recording_nothing_moves_an_object_alone(tmp_path):
    run = settings(tmp_path, None, ("recordings.estimate=[]", "model.frames={}"))
    with pytest.raises(ConfigError, match="no recording drives the model, and it has no driven joints"):
        run_simulate(run, tmp_path / "made")


def folder_of(path, values=(0.02, 5e-5), std=(2e-4, 1e-6), correlation=0.5, **more):
    """A run folder of `solve` as far as a baseline reads it."""
    path.mkdir()
    c, names = correlation * std[0] * std[1], ["beam.bend", "beam.damping"]
    covariance = {"names": names, "matrix": [[std[0] ** 2, c], [c, std[1] ** 2]]}
    entries = [{"value": v, "std": s, "unit": "", "free": True} for v, s in zip(values, std, strict=True)]
    result = {"format": "yid-solve/1", "status": "converged", "fit": {"explains": True}, "covariance": covariance}
    result["parameters"] = dict(zip(names, entries, strict=True))
    (path / "result.json").write_text(json.dumps(result | more), encoding="utf-8")
    return path


def test_a_baseline_is_a_joint_prior_about_its_values(run, tmp_path):
    shift = {"beam.bend": {"links": 9.0}, "beam.damping": {"links": None, "encoder_noise": 4e-6}}
    known = run_history.read_estimates(folder_of(tmp_path / "old", values=(0.018, 4e-5), discretisation=shift))
    # of two runs, only the shift by encoder noise differs
    assert known.std == pytest.approx([2e-4, np.hypot(1e-6, 8e-6)])
    problem, _ = problem_with_priors_and_baseline(build_problem(run), known)
    at = [problem.unknown_names.index(name) for name in ("beam.bend", "beam.damping")]
    assert problem.initial_unknowns[at] == pytest.approx([0.018, 4e-5])
    moved = problem.initial_unknowns.copy()
    moved[at] += [3e-4, -1e-6]
    residual, rows = problem.priors.residual_and_jacobian(moved)
    apart = moved[at] - problem.initial_unknowns[at]
    assert residual @ residual == pytest.approx(apart @ np.linalg.solve(known.covariance, apart), rel=1e-9)
    assert rows @ (moved - problem.initial_unknowns) == pytest.approx(residual, rel=1e-9)


def test_the_baselines_effects_stay_in_the_model(run):
    values = ("kelvin_voigt@beam.tau",), np.array([0.01]), np.array([[1e-6]])
    known = RunEstimates("old", *values, effects={"kelvin_voigt@beam": {"tau": 0.01}})
    with pytest.raises(ConfigError, match="the effect kelvin_voigt@beam"):
        problem_with_priors_and_baseline(build_problem(run), known)
    run = run_history.settings_with_baseline_effects(run, (known,))
    problem, _ = problem_with_priors_and_baseline(build_problem(run), known)
    assert "kelvin_voigt@beam.tau" in problem.free
    assert problem.unknowns.named_values(problem.initial_unknowns)["kelvin_voigt@beam.tau"] == pytest.approx(0.01)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"format": "yid-plan/1"}, "another command"),
        ({"status": "failed", "message": "no"}, "the run in this folder failed: no"),
        ({"covariance": {}}, "the key .names. is missing"),
        ({"covariance": {"names": [], "matrix": []}}, "determines no parameter to compare"),
    ],
)
def test_a_folder_that_says_nothing_of_parameters_is_refused(tmp_path, change, words):
    with pytest.raises(DataError, match=words):
        run_history.read_estimates(folder_of(tmp_path / "old", **change))


def test_a_baseline_of_another_model_is_refused_by_what_differs(tmp_path):
    folder_of(tmp_path / "old")
    (tmp_path / "old" / "config.yaml").write_text(BEAM.replace("links: 2", "links: 3"), encoding="utf-8")
    run = settings(tmp_path, None, ("diagnosis.baseline_run_folders=[old]",))
    differs = r"has model\.object\.\w+\.beam\.links: 2, \S*old has model\.object\.\w+\.beam\.links: 3"
    with pytest.raises(ConfigError, match=f"this configuration {differs}"):
        run_history.estimates_of_each_baseline_run(run)
    (tmp_path / "run.yaml").write_text(BEAM.replace("model:", "model:\n  robot: package:baxter"), encoding="utf-8")
    (tmp_path / "arm").mkdir()
    (tmp_path / "run.yaml").rename(tmp_path / "arm" / "config.yaml")
    with pytest.raises(ConfigError, match=r"old has no model\.robot, \S*arm has model\.robot: package:baxter"):
        run_history.require_runs_of_one_model([tmp_path / "old", tmp_path / "arm"])


def test_recordings_of_the_baseline_are_those_without_what_is_looked_for(tmp_path):
    folder = folder_of(tmp_path / "old")
    (folder / "config.yaml").write_text(BEAM.replace("[beam.h5]", "[../beam.h5]"), encoding="utf-8")
    run = settings(tmp_path, None, ("diagnosis.baseline_run_folders=[old]",))
    [found], message = run_history.recordings_without_effect_or_reason(run)
    assert (found.name, message) == ("beam (without)", "")
    assert found.sha256 == read_recordings_of_role(run, "estimate")[0].sha256


def test_report_says_what_drifted_and_writes_the_history(tmp_path, printed):
    folders = [folder_of(tmp_path / f"day{i}", values=(0.02 if i < 3 else 0.025, 5e-5)) for i in range(4)]
    told = printed("report", *folders, "--out", tmp_path / "history", "--json")
    written = json.loads((tmp_path / "history" / "history.json").read_text(encoding="utf-8"))
    assert (written["format"], json.loads(told)) == ("yid-history/1", written)
    assert [name for name, entry in written["parameters"].items() if entry["drifted"]] == ["beam.bend"]
    assert [entry["name"] for entry in written["runs"] if entry["distrusted"]] == ["day3"]
    page = (tmp_path / "history" / "report.html").read_text(encoding="utf-8")
    assert all(own in page for own in ("differs between the runs, from 0.02 in day0 to 0.025", "(day0 to day2) agree"))
    later, older = (folder_of(tmp_path / name) for name in ("later", "older"))
    (later / "config.yaml").write_text(f"{BEAM}\ndiagnosis: {{baseline_run_folders: [{folders[0]}]}}\n", "utf-8")
    (older / "config.yaml").write_text(f"{BEAM}\ndiagnosis: {{worth: 3}}\n", "utf-8")
    refused = ((later, "would count twice"), (older, "CHANGELOG.md"))
    for runs, message in [*(([folders[0], run], text) for run, text in refused), (folders[:1], "fewer than two runs")]:
        assert message in printed("report", *runs, "--out", tmp_path / "other", code=2)


@pytest.mark.slow
def test_a_program_with_node_states_has_the_same_joint_prior(tmp_path):
    """`python -m pytest -m slow tests/workflow/test_clamps.py`: some seconds in IPOPT."""
    run = settings(tmp_path, None, ("problem.initial_state=equilibrium",))
    known = run_history.read_estimates(folder_of(tmp_path / "old", values=(0.018, 4e-5)))
    problem, _ = problem_with_priors_and_baseline(build_problem(run), known)
    rolled, program = (fit_problem(problem, method) for method in (GaussNewton(), MultipleShooting()))
    assert program.cost == pytest.approx(rolled.cost, rel=1e-6)
    assert program.x == pytest.approx(rolled.x, rel=1e-3)
