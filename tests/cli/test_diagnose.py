"""The command `diagnose`: a run folder, words for people, the embedded example."""

from __future__ import annotations

import json

import h5py
import pytest


def test_a_diagnosis_leaves_a_run_folder(cli, pendulum, tmp_path):
    chosen = ("--set", "diagnosis.candidates=[joint_coulomb, link_mass@elbow]", "--set", "output.write_report=false")
    done = cli("diagnose", pendulum, "--out", tmp_path / "run", *chosen)
    assert done.code == 0, done.err
    result = json.loads((tmp_path / "run" / "result.json").read_text())
    assert result["format"] == "yid-diagnosis/2"
    assert "verdict: no gap" in done.out
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


def test_a_deviation_that_is_mostly_the_models_error(cli, pendulum, tmp_path):
    """Deviations ten times the noise, of which a tenth is noise, are the noise again."""
    chosen = ("--set", "diagnosis.candidates=[joint_coulomb]", "--set", "output.write_report=false")
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
