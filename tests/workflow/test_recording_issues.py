"""What is in doubt about recordings, and what it does to a run."""

from dataclasses import replace

import numpy as np
import pytest
from made_series import without

from yid_ocp.config.reader import load_config
from yid_ocp.data import read_recording, write_recording
from yid_ocp.data.channel_checks import Issue
from yid_ocp.errors import DataError
from yid_ocp.solvers import fit_problem
from yid_ocp.workflow.build import build_system
from yid_ocp.workflow.build_problem import (
    _is_in_used_time,
    _is_modelled,
    _once,
    _without_repeated_warnings,
    build_problem,
    data_quality_issues_of_recording,
)


@pytest.fixture
def damaged(pendulum_data, tmp_path, written):
    """Write the pendulum's recording after a change, and its configuration; returns the configuration's file."""

    def write(change=lambda recording: recording):
        write_recording(change(read_recording(pendulum_data.folder / "estimate.h5")), tmp_path / "damaged.h5")
        return written(pendulum_data.text.replace(str(pendulum_data.folder / "estimate.h5"), "damaged.h5"))

    return write


def joints(**changes):
    def change(recording):
        made = {name: make(recording.joints) for name, make in changes.items()}
        return replace(recording, joints=replace(recording.joints, **made))

    return change


def noisy(recording):
    rng = np.random.default_rng(1)
    more = 10 * recording.joints.effort_std * rng.standard_normal(recording.joints.effort.shape)
    return joints(effort=lambda group: group.effort + more)(recording)


def test_a_run_on_good_recordings_says_nothing(damaged, carried_out):
    done = carried_out("solve", damaged(), "--strict", settings=["output.write_report=false"])
    assert ("an error?" in done.out, done.result["issues"], done.result["fit"]["data_trusted"]) == (False, [], True)
    assert done.result["parameters"]["shoulder.stiffness"]["verdict"] == "identifiable"


def test_no_number_from_a_recording_in_grave_doubt_is_found(damaged, carried_out):
    done = carried_out("solve", damaged(noisy))
    result = done.result
    assert ({doubt["cause"] for doubt in result["issues"]}, result["fit"]["data_trusted"]) == ({"noise"}, False)
    free = [entry for entry in result["parameters"].values() if entry["free"]]
    assert {entry["verdict"] for entry in free} <= {"not_trusted", "not_identifiable"}
    for words in ("Do not use estimates yet, because ", "joints.effort.std=0.1", "/joints/effort."):
        assert words in done.out
    page = (done.folder / "report.html").read_text()
    assert all(text in page for text in ("Do not use estimates yet, because ", "a channel has more noise than stated"))


def test_the_doubt_alone_forbids_to_trust_what_a_model_explains(damaged):
    """With the noise stated ten times larger everything is explained; then a doubt is all that is left."""
    run = load_config(damaged())
    problem = build_problem(run)
    doubt = Issue("effort_sign", "made up", "not_trusted", 5.0, "", "damaged")
    for severity, verdict in (("warning", "identifiable"), ("not_trusted", "not_trusted")):
        said = problem.with_options(replace(problem.options, data_issues=(replace(doubt, severity=severity),)))
        solution = fit_problem(said, run.solver)
        assert solution.goodness_of_fit.explains
        assert solution.goodness_of_fit.data_trusted == (severity == "warning")
        assert solution.parameters["shoulder.stiffness"].verdict == verdict


@pytest.mark.parametrize("command", ["solve", "compare", "diagnose", "check"])
def test_strict_stops_a_run_in_doubt(printed, damaged, tmp_path, left_nothing, command):
    file = damaged(noisy)
    told = printed(command, file, "--strict", "--out", tmp_path / "run", code=2)
    assert "error: a channel has more noise than stated: the noise of effort.shoulder" in told
    assert "damaged/joints/effort.shoulder" in told
    left_nothing(file)


def test_check_lists_what_is_in_doubt(carried_out, damaged):
    done = carried_out("check", damaged(noisy))
    assert " ".join(done.out.split()).startswith("Do not run `solve` yet, because its values would be unusable: a cha")


def test_times_that_are_not_seconds_stop_a_run_at_once(printed, damaged, tmp_path, left_nothing):
    file = damaged(joints(t=lambda group: 1e3 * group.t))
    told = printed("solve", file, "--out", tmp_path / "run", code=2)
    assert "times are not in seconds: joints/t has only one sample every 10 s (at most 0.5 s is allowed)" in told
    assert "divide them by 1000" in told
    left_nothing(file)


def test_gaps_are_cut_out_and_said(damaged, carried_out):
    file = damaged(lambda recording: without(recording, 0.55, 0.66))
    result = carried_out("solve", file, settings=["output.write_report=false"]).result
    assert [doubt["cause"] for doubt in result["issues"]] == ["gap"]
    assert "2 parts of the data (1.07 s) are used" in result["issues"][0]["what"]
    assert result["fit"]["data_trusted"]


def test_the_same_data_twice_count_once(damaged):
    file = damaged()
    once = build_problem(load_config(file))
    (file.parent / "again").mkdir()
    write_recording(read_recording(file.parent / "damaged.h5"), file.parent / "again" / "damaged.h5")
    twice = build_problem(load_config(file, ["recordings.estimate=[damaged.h5, again/damaged.h5]"]))
    assert [episode.name for episode in twice.episodes] == [episode.name for episode in once.episodes]
    assert [doubt.cause for doubt in twice.options.data_issues] == ["same_data"]
    one, issues = read_recording(file.parent / "damaged.h5"), list[Issue]()
    assert _once(load_config(file), [], [one, replace(one, name="copy")], issues) == ([], [one])
    assert f"samples of copy equal samples of {one.name} to the last digit" in issues[0].what
    with pytest.raises(DataError, match=r"(?s)listed for estimation and as held out.*leave out damaged_1 or damaged"):
        build_problem(load_config(file, ["recordings.held_out=[again/damaged.h5]"]))


def test_times_since_1970_give_the_same_problem(damaged):
    usual = build_problem(load_config(damaged()))
    late = build_problem(load_config(damaged(joints(t=lambda group: group.t + 1.7e9))))
    assert late.options.data_issues == ()
    issue = Issue("stuck", "", "warning", 1.0, "", "", begin=1.7e9 + 1, end=1.7e9 + 2)
    assert [_is_in_used_time(issue, [late.episodes[0].recording], span) for span in (0.5, 1.5)] == [False, True]
    assert np.allclose(late.episodes[0].prescribed_path, usual.episodes[0].prescribed_path, atol=1e-5)
    assert late.episodes[0].measurements[0].n_residuals == usual.episodes[0].measurements[0].n_residuals


@pytest.mark.parametrize(
    ("setting", "name"), [("used_points: [w_T1, w_T4]", "'w_T4'"), ("frame_by_recorded_name: {w_T1: w_Tl}", "'w_Tl'")]
)
def test_points_listed_by_name_that_are_not_there_are_an_error(repository, setting, name, refused_with):
    file = repository / "configs" / "single_arm_vision.yaml"
    settings = [f"sensors.points_camera={{{setting}}}", "problem.use_compiler=false", "model.object.links=1"]
    run = load_config(file, settings)
    with refused_with(DataError, (name, "did you mean 'w_T")):
        build_problem(run)


def test_what_the_model_has_as_an_effect_is_no_doubt(repository, clean, tmp_path):
    """The line that a doubt gives is one that the configuration takes, and answers it."""
    recording = read_recording(clean / "single_arm_no_vision_estimate.h5")
    moved = joints(position=lambda group: group.position + 0.05 * (np.arange(7) == 3))(recording)
    write_recording(moved, tmp_path / "moved.h5")
    settings = [f"recordings.estimate=[{tmp_path / 'moved.h5'}]", "recordings.held_out=[]"]
    file = repository / "configs" / "single_arm_no_vision.yaml"
    run = load_config(file, settings)
    (doubt,) = data_quality_issues_of_recording(run, build_system(run), moved)
    assert (doubt.cause, doubt.channel) == ("encoder_offset", "position.left_e1")
    assert doubt.setting == "model.effects: [{kind: encoder_offset, location: left_e1, values: {offset: 0.05}}]"
    answered = load_config(file, [*settings, doubt.setting.replace(": ", "=", 1)])
    assert data_quality_issues_of_recording(answered, build_system(answered), moved) == []


@pytest.mark.parametrize("effect", ["effort_delay, location: left", "effort_lag, location: left_e1"])
def test_a_delay_and_a_lag_both_answer_late_efforts(repository, effect):
    file = repository / "configs" / "single_arm_no_vision.yaml"
    late = Issue("effort_lag", "efforts are late", "not_trusted", 3.0, "shift their times", "", "joints", "effort")
    for overrides, answered in (((), False), ((f"model.effects=[{{kind: {effect}}}]",), True)):
        assert _is_modelled(build_system(load_config(file, overrides)), late) is answered


def test_what_is_certain_of_a_group_is_not_said_again_as_a_warning() -> None:
    def issue(severity: str, cause: str = "clock_offset", group: str = "points") -> Issue:
        return Issue(cause, "late", severity, 1.0, "shift them", "one", group)

    other, elsewhere = issue("warning", "clock_drift"), issue("warning", group="markers")
    certain = issue("not_trusted")
    assert _without_repeated_warnings([issue("warning"), certain, other, elsewhere]) == [certain, other, elsewhere]
    assert _without_repeated_warnings([issue("warning")]) == [issue("warning")]
