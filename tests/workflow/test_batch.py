"""Many runs as a batch: each its folder, a failing one stops no other, what is done is not done again."""

from __future__ import annotations

import json

import pytest

from yid_ocp.data import read_recording, write_recording
from yid_ocp.errors import ConfigError, OutputError
from yid_ocp.parallel import InlineExecutor
from yid_ocp.workflow.batch import list_batch_runs, run_batch

HERE = InlineExecutor()
SHORT = "problem.duration=0.6"
QUICK = ("output.write_report=false", "output.discretisation_check=none", "recordings.held_out=[]", SHORT)


@pytest.fixture
def fleet(pendulum, pendulum_data, tmp_path):
    """The pendulum's configuration and a folder of three recordings, of which one is damaged."""
    folder = tmp_path / "fleet"
    folder.mkdir()
    for name, source in (("monday", "estimate"), ("tuesday", "held_out")):
        write_recording(read_recording(pendulum_data.folder / f"{source}.h5"), folder / f"{name}.h5")
    (folder / "spoiled.h5").write_bytes(b"not a recording")
    return folder


def names(outcome):
    return {entry["name"]: entry["status"] for entry in outcome.result["runs"]}


def test_a_failing_run_stops_no_other_and_is_tried_again(pendulum, pendulum_data, fleet, tmp_path):
    members = list_batch_runs([pendulum], str(fleet / "*.h5"), QUICK)
    assert [member.name for member in members] == ["monday", "spoiled", "tuesday"]
    out = tmp_path / "batch"
    first = run_batch(members, out, workers=HERE)
    assert names(first) == {"monday": "converged", "spoiled": "error", "tuesday": "converged"}
    assert not first.is_successful
    told = {entry["name"]: entry for entry in first.result["runs"]}
    assert "DataError" in told["spoiled"]["message"]
    for name in ("monday", "tuesday"):
        own = json.loads((out / "runs" / name / "result.json").read_text())
        for parameter, value in pendulum_data.truth.items():
            assert told[name]["parameters"][parameter]["value"] == own["parameters"][parameter]["value"]
            assert own["parameters"][parameter]["value"] == pytest.approx(value, rel=0.05)
    assert json.loads((out / "batch.json").read_text()) == first.result
    page = (out / "report.html").read_text()
    assert "monday" in page
    assert "spoiled" in page
    # both recordings are of one pendulum
    assert not any(entry["drifted"] for entry in first.result["history"]["parameters"].values())

    kept = (out / "runs" / "monday" / "result.json").stat().st_mtime_ns
    write_recording(read_recording(fleet / "monday.h5"), fleet / "spoiled.h5")
    assert run_batch(members, out, workers=HERE).is_successful
    assert (out / "runs" / "monday" / "result.json").stat().st_mtime_ns == kept
    write_recording(read_recording(fleet / "tuesday.h5"), fleet / "monday.h5")
    third = run_batch(members, out, workers=HERE)
    changed = {entry["name"]: entry["parameters"]["elbow.damping"]["value"] for entry in third.result["runs"]}
    assert (out / "runs" / "monday" / "result.json").stat().st_mtime_ns > kept
    assert changed["monday"] == changed["tuesday"] != told["monday"]["parameters"]["elbow.damping"]["value"]


def test_robots_are_configurations_and_what_differs_has_no_history(pendulum, written, pendulum_data, tmp_path):
    other = written(pendulum_data.text.replace("rest_position: 0.2", "rest_position: 0.25"), "other.yaml")
    broken = written(pendulum_data.text.replace("free: true", "fre: true"), "broken.yaml")
    outcome = run_batch(list_batch_runs([pendulum, other, broken], None, QUICK), tmp_path / "batch", workers=HERE)
    assert names(outcome) == {"pendulum": "converged", "other": "converged", "broken": "error"}
    assert "fre" in outcome.result["runs"][2]["message"]
    assert outcome.result["history"] is None


def test_a_fleet_is_diagnosed(rubbing, tmp_path):
    outcome = run_batch(list_batch_runs([rubbing]), tmp_path / "batch", "diagnose", HERE)
    (entry,) = outcome.result["runs"]
    assert entry["effects"] == ["joint_coulomb@elbow"]
    assert entry["status"] == json.loads((tmp_path / "batch/runs/rubbing/result.json").read_text())["verdict"]


def test_names_are_told_apart(pendulum, written, pendulum_data, tmp_path):
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "run.h5").write_bytes(b"")
    (tmp_path / "a" / "run.yaml").write_text(pendulum_data.text)
    found = list_batch_runs([pendulum], str(tmp_path / "*" / "run.h5"))
    assert [member.name for member in found] == ["run", "run-2"]
    found = list_batch_runs([pendulum, tmp_path / "a" / "run.yaml"], str(tmp_path / "**" / "run.h5"))
    assert [member.name for member in found] == ["pendulum-run", "pendulum-run-2", "run-run", "run-run-2"]


def test_what_cannot_be_a_batch_is_refused(pendulum, tmp_path):
    with pytest.raises(ConfigError, match=r"no recording matches(.|\n)*nowhere/\*\.h5(.|\n)*in quotes"):
        list_batch_runs([pendulum], "nowhere/*.h5")
    with pytest.raises(ConfigError, match=r"no such configuration(.|\n)*did you mean 'pendulum.yaml'"):
        list_batch_runs(["pendulun.yaml"])
    with pytest.raises(ConfigError, match="given twice"):
        list_batch_runs([pendulum, pendulum])
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes").write_text("")
    with pytest.raises(OutputError, match="no batch"):
        run_batch(list_batch_runs([pendulum]), tmp_path / "full", workers=HERE)


def test_the_command_runs_the_fleet_in_processes(cli, pendulum, fleet, tmp_path):
    (fleet / "spoiled.h5").unlink()
    settings = [part for setting in QUICK for part in ("--set", setting)]
    given = (pendulum, "--recordings", fleet / "*.h5", *settings, "--out", "fleet_runs")
    done = cli("batch", *given, "--workers", 1)
    assert done.code == 0, done.err
    assert "2 runs: 2 converged." in done.out
    assert "shoulder.stiffness" in done.out
    assert "2 of 2" in done.err
    assert cli("batch", pendulum, "--recordings", "nowhere*.h5").code == 2
    assert cli("batch", *given, "--workers", 0).code == 2
    refused = cli("batch", *given, "--workers", 2, "--scheduler", "localhost:8786")
    assert refused.code == 2
    assert "one of the two" in refused.err
