"""The real soft beam: stiffness from the bare run, the load from what differs, the bare run from the loaded one.

Minutes long: `python -m pytest -m slow tests/diagnosis/test_soft_beam.py`. Other recordings of the beam with a load can
be named in the environment, with their masses, as `YID_OCP_LOADS=FILE:KG,FILE:KG`.
"""

import os

import pytest

from yid_ocp.config.reader import load_config
from yid_ocp.workflow.diagnose import run_diagnose
from yid_ocp.workflow.solve import run_solve

pytestmark = pytest.mark.slow
SECOND_MOMENT = 0.03**4 / 12  # of the section [m^4]
QUIET = ("output.write_report=false",)


@pytest.fixture(scope="module")
def folder(shared):
    found = shared / "recordings" / "soft_beam"
    if not found.is_dir():
        pytest.skip("the real recordings are not here (shared/recordings beside the project)")
    return found


@pytest.fixture(scope="module")
def bare(repository, folder, tmp_path_factory):
    run = load_config(repository / "configs" / "soft_beam.yaml", QUIET)
    return run_solve(run, tmp_path_factory.mktemp("beam") / "bare")


def loads(folder):
    said = [entry.rpartition(":") for entry in os.environ.get("YID_OCP_LOADS", "").split(",") if entry]
    return [(str(folder / "beam_load52_a.h5"), 0.052), *((file, float(mass)) for file, _, mass in said)]


def test_the_bare_run_gives_the_modulus_that_others_found(bare):
    assert bare.output.parameters["beam.bend"].value / SECOND_MOMENT == pytest.approx(264e3, rel=0.08)
    assert bare.output.goodness_of_fit.explains
    assert max(channel["rmse"] for channel in bare.result["residuals"].values()) < 3e-4


def test_the_load_is_named_and_taking_it_away_predicts_the_bare_run(repository, folder, bare, tmp_path):
    for i, (recording, mass) in enumerate(loads(folder)):
        said = (f"recordings.estimate=[{recording}]", f"diagnosis.baseline_run_folders=[{bare.folder}]")
        run = load_config(repository / "configs" / "soft_beam.yaml", (*QUIET, *said))
        finding = run_diagnose(run, tmp_path / f"load{i}").output
        assert finding.accepted_effects[0].label == "point_mass@w_beam"
        model, name = finding.final_model, "point_mass@w_beam.mass"
        # hysteresis makes the cost rough, so the estimate depends on the minimum; its std includes what is left
        assert abs(model.values[name] - mass) < 2 * model.std[name] < 0.5 * mass
        assert finding.counterfactual is not None
        # of a swing of 9 mm; without a diagnosis it is as little or 11 mm, by where the nominal fit ends
        [(_, without)] = finding.counterfactual.effects_removed.rmse_by_unit.values()
        assert without < 2e-3
        assert finding.counterfactual.effects_removed.is_improved_by_counterfactual
        assert finding.counterfactual.effects_added.is_improved_by_counterfactual
