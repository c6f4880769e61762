"""Sealing, marking and scoring of the blind proof."""

from __future__ import annotations

import json

import pytest

from yid_ocp.cli import main
from yid_ocp.diagnosis.blind import (
    CaseGenerator,
    CaseLabel,
    open_sealed_labels,
    score_case,
    score_ensemble,
    seal_labels,
)
from yid_ocp.errors import ConfigError, DataError
from yid_ocp.virtual.injected import InjectedEffect

KV = InjectedEffect("kelvin_voigt", "T1", {"tau": 0.05})
GUST = InjectedEffect("gusts", "T3", {"size": 0.1})


def label(category, *injected, multiple=None, case="case_000"):
    return CaseLabel(case, category, injected, multiple, {"T1.bend": 12.0})


def result(verdict, which=(), effects=(), where=(), confusable=(), closure=None, values=None):
    def pair(text):
        kind, _, place = text.partition("@")
        return {"kind": kind, "location": place}

    return {
        "verdict": verdict,
        "effects": [pair(t) for t in effects],
        "which": [pair(t) | {"parameters": (values or {}).get(t, {})} for t in which],
        "where": [{"location": p} for p in where],
        "confusable": [[pair(t) for t in group] for group in confusable],
        "gap": {"closure": closure},
    }


def test_sealed_labels_open_only_as_they_were():
    labels = [label("single", KV, multiple=3.0), label("null", case="case_001")]
    text, digest = seal_labels(labels)
    again = open_sealed_labels(text, digest)
    assert again[0].injected == (KV,)
    assert [entry.category for entry in again] == ["single", "null"]
    with pytest.raises(DataError, match="committed"):
        open_sealed_labels(text.replace("0.05", "0.06"), digest)


def test_an_effect_named_first_is_right_and_its_parameters_are_compared():
    values = {"kelvin_voigt@T1": {"tau": {"value": 0.052, "std": 0.002, "unit": "s"}}}
    said = result("effect", ["kelvin_voigt@T1"], ["kelvin_voigt@T1"], ["T1"], closure=0.9, values=values)
    found = score_case(label("single", KV, multiple=10.0), said, best=1.0, seconds=5.0)
    assert found.right
    assert found.kind_first
    assert found.location_first
    error, inside = found.errors["kelvin_voigt@T1.tau"]
    assert error == pytest.approx(0.04)
    assert inside


@pytest.mark.parametrize(
    ("said", "right"),
    [
        (result("confusable", ["density@T1"], ["density@T1"], confusable=[["density@T1", "kelvin_voigt@T1"]]), True),
        (result("confusable", ["density@T1"], ["density@T1"], confusable=[["density@T1", "point_mass@w_T1"]]), False),
        (result("confusable", ["a@T1"], ["a@T1"], confusable=[["a@T1", "b@T1", "c@T1", "kelvin_voigt@T1"]]), False),
        (result("unknown", ["density@T1"], where=["T1"]), False),
        (result("no_gap"), False),
    ],
)
def test_a_set_of_three_with_the_truth_is_right_and_nothing_else(said, right):
    assert score_case(label("single", KV, multiple=10.0), said).right is right


def test_outside_the_library_only_unknown_at_the_right_place_is_right():
    assert score_case(label("outside", GUST), result("unknown", where=["T3", "T1"])).right
    assert not score_case(label("outside", GUST), result("unknown", where=["T1", "T3"])).right
    assert not score_case(label("outside", GUST), result("effect", ["density@T3"], ["density@T3"], ["T3"])).right


def test_rates_count_what_they_say():
    marks = [
        score_case(label("null"), result("no_gap")),
        score_case(label("null"), result("unknown")),
        score_case(
            label("single", KV, multiple=10.0),
            result("effect", ["kelvin_voigt@T1"], ["kelvin_voigt@T1"], ["T1"], closure=0.8),
            1.0,
        ),
        score_case(label("single", KV, multiple=1.0), result("no_gap")),
        score_case(label("outside", GUST), result("unknown", where=["T1"])),
    ]
    found = score_ensemble(marks)
    assert found["false_alarms"] == 0.5
    assert found["detection"]["10"] == {"cases": 1, "gap": 1.0, "first": 1.0, "right": 1.0}
    assert found["detection"]["1"] == {"cases": 1, "gap": 0.0, "first": 0.0, "right": 0.0}
    assert found["unknown_recall"] == 1.0
    assert found["unknown_location"] == 0.0
    assert found["closure_of_best"] == pytest.approx(0.8)
    assert found["pairs_right"] is None
    json.dumps(found["detection"])


def test_a_system_that_nothing_drives_is_refused(bench):
    problem = bench.problem([bench.recording({}, 1, duration=0.5)])
    with pytest.raises(ConfigError, match="driven"):
        CaseGenerator(problem, 1)


def test_the_command_says_which_systems_it_needs(capsys, tmp_path, urdf_folder):
    config = tmp_path / "c.yaml"
    config.write_text("model:\n  robot: nowhere.urdf\n", encoding="utf-8")
    assert main(["blind", str(config), "--out", str(tmp_path / "b")]) == 2
    assert "error:" in capsys.readouterr().err
    del urdf_folder


@pytest.mark.slow
def test_a_small_ensemble_runs_resumes_and_keeps_its_labels_sealed(tmp_path, capsys):
    pytest.importorskip("mujoco", reason="blind proofs need MuJoCo: pip install 'yid-ocp[blind]'")
    folder = tmp_path / "proof"
    command = ["blind", "--cases", "2", "--seed", "11", "--out", str(folder), "--quiet"]
    assert main(command) == 0
    first = json.loads((folder / "result.json").read_text())
    assert first["format"] == "yid-blind/1"
    for path in (folder / "cases").iterdir():
        assert b"kelvin" not in path.read_bytes()
    answers = {json.loads(path.read_text())["name"]: path for path in (folder / "answers").iterdir()}
    assert set(answers) == {"case_000", "case_001"}
    kept = answers["case_000"].stat().st_mtime_ns
    answers["case_001"].unlink()
    assert main(command) == 0
    assert answers["case_000"].stat().st_mtime_ns == kept
    assert answers["case_001"].is_file()
    again = json.loads((folder / "result.json").read_text())
    assert [m["verdict"] for m in again["marks"]] == [m["verdict"] for m in first["marks"]]
    assert main([*command[:-1], "--seed", "12", "--quiet"]) == 2
    assert "another ensemble" in capsys.readouterr().err
