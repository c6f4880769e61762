"""The command `diagnose`: a run folder, words for people, the embedded example."""

from __future__ import annotations

import h5py
import pytest


def test_a_diagnosis_leaves_a_run_folder(carried_out, pendulum):
    settings = ("diagnosis.candidates=[joint_coulomb, link_mass@elbow]", "output.write_report=false")
    done = carried_out("diagnose", pendulum, settings=settings)
    assert (done.result["format"], done.result["verdict"]) == ("yid-diagnosis/2", "no_gap")
    assert "verdict: no gap" in done.out
    assert {"config.yaml", "log.jsonl", "trajectories.h5"} <= {path.name for path in done.folder.iterdir()}
    with h5py.File(done.folder / "trajectories.h5") as file:
        group = file[f"{done.result['gap']['held_out'][0]}/joints.effort"]
        assert group["before"].shape == group["after"].shape == group["measured"].shape


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("diagnosis.candidates=[kelvin_voigt]", "kelvin_voigt does not fit"),
        ("diagnosis.noise_fraction=0.1", "set sensors.joints.effort.std"),
    ],
)
def test_what_cannot_be_diagnosed_is_said(cli, pendulum, tmp_path, setting, said):
    done = cli("diagnose", pendulum, "--out", tmp_path / "run", "--set", setting)
    assert (done.code, said in done.err) == (2, True)
    assert not (tmp_path / "run").exists()


def test_a_deviation_that_is_mostly_the_models_error(carried_out, pendulum):
    """Deviations ten times the noise, of which a tenth is noise, are the noise again."""
    chosen = ("diagnosis.candidates=[joint_coulomb]", "output.write_report=false")
    found = []
    for std, share in ((0.01, 1.0), (0.1, 0.1)):
        settings = (f"sensors.joints.effort.std={std}", f"diagnosis.noise_fraction={share}", *chosen)
        done = carried_out("diagnose", pendulum, settings=settings, out=f"run_{share}")
        found.append(done.result["gap"]["before"]["chi2_per_dof"])
    assert found[1] == pytest.approx(found[0], rel=0.01)


@pytest.mark.slow
def test_the_embedded_example_finds_what_was_withheld(carried_out):
    done = carried_out("diagnose")
    result = done.result
    assert result["verdict"] == "effect"
    assert result["effects"] == [{"kind": "kelvin_voigt", "location": "T1"}]
    assert result["which"][0]["parameters"]["tau"]["value"] == pytest.approx(0.05, rel=0.1)
    assert result["gap"]["closure_ci"][0] > 0.9
    assert (done.folder / "report.html").exists()
