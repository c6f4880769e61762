"""A fit that a guess without a model beats is not believed."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from yid_ocp.data import read_recording, write_recording
from yid_ocp.inference.uncertainty import ParameterEstimate, mark_not_trusted
from yid_ocp.workflow.prediction_outputs import worse_than_baseline_issues

UNITS = {"joints.effort.a": "N m", "joints.effort.b": "N m", "points.p": "m", "points.q": "m"}


def entry(rmse, guess):
    return {"recording": "run", "rmse": rmse, "baselines": {"zero": guess}}


EFFORT, POINTS = [("joints", "effort")], [("points", "")]


@pytest.mark.parametrize(
    ("rmse", "guess", "places"),
    [
        ({"joints.effort.a": 1.0, "joints.effort.b": 0.2}, {"joints.effort.a": 3.0, "joints.effort.b": 0.1}, []),
        ({"joints.effort.a": 3.2, "joints.effort.b": 0.2}, {"joints.effort.a": 3.0, "joints.effort.b": 0.4}, EFFORT),
        ({"joints.effort.a": 3.1}, {"joints.effort.a": 3.0}, []),
        ({"points.p": 0.2, "points.q": 0.1, "points": 0.1}, {"points.p": 0.1, "points.q": 0.1, "points": 0.1}, POINTS),
        ({"points.p": 0.2}, {}, []),
        ({}, {"points.p": 0.2}, []),
    ],
)
def test_a_sensor_counts_as_a_whole(rmse, guess, places):
    found = worse_than_baseline_issues([entry(rmse, guess)], UNITS)
    assert [(doubt.group, doubt.channel) for doubt in found] == places
    assert all((d.cause, d.weight, d.recording) == ("worse_than_guess", "not_trusted", "run") for d in found)


def test_the_best_guess_counts():
    said = entry({"points.p": 0.2}, {"points.p": 0.3})
    said["baselines"]["stays"] = {"points.p": 0.1}
    (doubt,) = worse_than_baseline_issues([said], UNITS)
    assert doubt.what == "the model is off by 0.2 m (rms), the guess 'stays' without a model by 0.1 m"
    assert doubt.evidence == pytest.approx(0.2 / 0.105)


def test_what_was_found_is_not_trusted_and_what_was_not_stays_so():
    one = ParameterEstimate(1.0, 0.1, "N m/rad", 1.0, 0.0, 9.0, True, "identifiable")
    known = {
        "found": one,
        "weak": replace(one, verdict="weak"),
        "lost": replace(one, verdict="not_identifiable"),
        "fixed": replace(one, free=False, verdict="fixed"),
    }
    verdicts = {name: made.verdict for name, made in mark_not_trusted(known).items()}
    assert verdicts == {"found": "not_trusted", "weak": "not_trusted", "lost": "not_identifiable", "fixed": "fixed"}


@pytest.mark.parametrize(("factor", "believed"), [(1.0, True), (0.4, False)])
def test_a_recording_held_out_that_a_guess_predicts_better_withholds_trust(
    cli, pendulum_data, tmp_path, factor, believed
):
    recording = read_recording(pendulum_data.folder / "held_out.h5")
    less = replace(recording, joints=replace(recording.joints, effort=factor * recording.joints.effort))
    write_recording(less, tmp_path / "held_out.h5")
    (tmp_path / "run.yaml").write_text(
        pendulum_data.text.replace(str(pendulum_data.folder / "held_out.h5"), "held_out.h5")
    )
    done = cli("solve", tmp_path / "run.yaml", "--out", tmp_path / "run", "--set", "output.write_report=false")
    assert done.code == 0, done.err
    result = json.loads((tmp_path / "run" / "result.json").read_text())
    assert result["fit"]["believed"] is believed
    assert [doubt["cause"] for doubt in result["doubts"]] == ([] if believed else ["worse_than_guess"])
    verdict = result["parameters"]["shoulder.stiffness"]["verdict"]
    assert verdict == ("identifiable" if believed else "not_trusted")
    assert ("a prediction without a model is nearer" in done.out) is not believed
