"""What differs from an earlier run, on a small beam that carries a load on the second day."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from yid_ocp.analysis.run_estimates import RunEstimates
from yid_ocp.config.reader import load_config
from yid_ocp.data.recording import PointGroup, Recording
from yid_ocp.data.recording_hdf5 import write_recording
from yid_ocp.diagnosis.baseline import _estimated_without, problem_with_priors_and_baseline
from yid_ocp.diagnosis.hypotheses import AllCandidatesProblem
from yid_ocp.diagnosis.refit import RefitContext, refit_with_effects
from yid_ocp.diagnosis.thresholds import Thresholds
from yid_ocp.errors import ConfigError
from yid_ocp.problem.predictions import recording_from_prediction
from yid_ocp.solvers import GaussNewton, fit_problem
from yid_ocp.workflow.build_problem import build_problem
from yid_ocp.workflow.diagnose import run_diagnose
from yid_ocp.workflow.solve import run_solve

BEAM = """
model:
  object:
    kind: segments
    mount: {rpy: [0.0, 1.5707963267948966, 0.0]}
    named_segments:
      beam: {length: 0.1, mass: 0.1, cross_section_size: [0.03, 0.03], links: 2, values_given_as_rigidities: true,
             clamped_at_base: true, joint_axes: y}
recordings: {estimate: [bare.h5]}
parameters:
  beam.bend: {free: true, initial: 0.015}
  beam.damping: {free: true, initial: 8.0e-5}
problem: {time_step: 0.01, initial_state: estimated, initial_configuration_prior_std: 0.2,
          initial_velocity_prior_std: 3.0}
diagnosis: {candidates: [point_mass@w_beam, kelvin_voigt@beam]}
output: {write_report: false, checked_discretisation: none}
"""
NOISE, LOAD, SOFTER = 1e-4, 0.05, 0.016
TRUTH = {"beam.bend": 0.02, "beam.damping": 5e-5}


def swing(folder, name, seed, effects="[]", **changed):
    """A recording of 1.6 s of the beam let go from 0.1 rad a joint, and its file."""
    t = np.arange(161) * 0.01
    empty = Recording(None, (PointGroup("points", ("w_beam",), t, np.zeros((161, 1, 3)), NOISE),))
    write_recording(empty, folder / "bare.h5")
    (folder / "beam.yaml").write_text(BEAM, encoding="utf-8")
    problem = build_problem(load_config(folder / "beam.yaml", (f"model.effects={effects}",)))
    start = {f"start.q.{joint}[bare]": 0.1 for joint in problem.system.mechanism.joint_names}
    values = problem.unknowns.named_values(problem.pack_unknowns({**TRUTH, **changed, **start}))
    theta, offset = problem.unpack_episode_unknowns(problem.pack_unknowns(values), 0)
    outcome = problem.predictor.predict_episode(problem.episodes[0], theta, offset, False)
    assert not isinstance(outcome, str)
    made = recording_from_prediction(problem.predictor, problem.episodes[0], outcome, problem.theta, seed)
    write_recording(replace(made, true_parameters={}), folder / f"{name}.h5")


@pytest.fixture(scope="module")
def beam(tmp_path_factory):
    """Folder with a bare and a loaded swing, and a run of `solve` on the bare one."""
    folder = tmp_path_factory.mktemp("beam")
    swing(folder, "loaded", 2, f"[{{kind: point_mass, location: w_beam, values: {{mass: {LOAD}}}}}]")
    swing(folder, "again", 3)
    swing(folder, "softer", 4, **{"beam.bend": SOFTER})
    swing(folder, "little_softer", 5, **{"beam.bend": 0.0195})
    swing(folder, "hardly_softer", 6, **{"beam.bend": 0.01985})
    bent = "[{kind: rest_curvature, location: beam, values: {qy: 0.1}}]"
    swing(folder, "softer_and_bent", 7, bent, **{"beam.bend": SOFTER})
    swing(folder, "bare", 1)
    run_solve(load_config(folder / "beam.yaml"), folder / "old")
    return folder


def diagnosed(beam, recording, out):
    said = (f"recordings.estimate=[{recording}.h5]", "diagnosis.baseline_run_folders=[old]")
    return run_diagnose(load_config(beam / "beam.yaml", said), out)


def test_a_load_is_what_differs_and_taking_it_away_predicts_the_first_day(beam, tmp_path):
    outcome = diagnosed(beam, "loaded", tmp_path / "new")
    finding, result = outcome.output, outcome.result
    assert [effect.label for effect in finding.accepted_effects] == ["point_mass@w_beam"]
    mass = finding.final_model.values["point_mass@w_beam.mass"]
    assert abs(mass - LOAD) < 4 * finding.final_model.std["point_mass@w_beam.mass"]
    assert not any(entry["changed"] for entry in result["baseline"]["parameters"].values())
    for part in ("removed", "added"):
        errors = result["counterfactual"][part]["rmse"]["points.w_beam"]
        # no more than noise in three coordinates is left
        assert errors["counterfactual"] < 1.5 * np.sqrt(3) * NOISE < errors["without_diagnosis"]
    assert "Recordings made without the effects (bare) are predicted with an error of" in result["summary"]
    assert set(result["model"]["covariance"]["names"]) == {*TRUTH, "point_mass@w_beam.mass"}


def test_a_parameter_that_has_left_the_baseline_is_estimated_without_it(beam, tmp_path):
    outcome = diagnosed(beam, "softer", tmp_path / "new")
    [shift] = outcome.output.baseline_comparison.significant_parameter_shifts
    assert (outcome.result["verdict"], shift.name) == ("no_gap", "beam.bend")
    assert abs(shift.current_value - SOFTER) < 4 * shift.current_std


def test_a_change_that_an_effect_imitates_worse_is_a_change(beam, tmp_path):
    result = diagnosed(beam, "little_softer", tmp_path / "new").result
    shift = result["baseline"]["parameters"]["beam.bend"]
    assert result["verdict"] == "no_gap"
    assert abs(shift["now"] - 0.0195) < 4 * shift["now_std"]


def test_a_change_that_explains_as_much_as_an_effect_is_told_and_shares_its_probability(beam, tmp_path):
    finding = diagnosed(beam, "hardly_softer", tmp_path / "new").output
    [rival] = finding.rival_shifts
    assert (finding.verdict, rival.name) == ("confusable", "beam.bend")
    assert abs(rival.current_value - 0.01985) < 4 * rival.current_std
    assert finding.probability < finding.rival_probability
    assert finding.summary.index(rival.text) < finding.summary.index("the true cause is")


def test_a_prior_stays_where_the_model_does_not_explain_the_recordings_without_it(beam, tmp_path):
    final = diagnosed(beam, "softer_and_bent", tmp_path / "new").output.final_model
    assert "beam.bend" in final.problem.options.multivariate_prior.parameter_names


def test_nothing_differs_where_nothing_changed(beam, tmp_path):
    outcome = diagnosed(beam, "again", tmp_path / "new")
    assert outcome.result["verdict"] == "no_gap"
    assert not any(entry["changed"] for entry in outcome.result["baseline"]["parameters"].values())
    assert outcome.result["counterfactual"] is None
    assert "No parameter differs significantly" in outcome.result["summary"]


def test_a_recording_of_the_baseline_is_refused(beam, tmp_path):
    with pytest.raises(ConfigError, match="would count twice"):
        diagnosed(beam, "bare", tmp_path / "new")


def test_the_world_without_effects_is_estimated_on_its_own_recordings(beam):
    loaded, bare = (
        build_problem(load_config(beam / "beam.yaml", (f"recordings.estimate=[{name}.h5]",)))
        for name in ("loaded", "bare")
    )
    found = _estimated_without(SimpleNamespace(problem=loaded), [e.recording for e in bare.episodes], tuple(TRUTH))
    expected = fit_problem(bare, GaussNewton())
    for name, truth in TRUTH.items():
        assert abs(found[name] - truth) < 4 * expected.std[name]
        assert found[name] == pytest.approx(expected.parameters[name].value, abs=0.1 * expected.std[name])


@pytest.mark.parametrize("times", [0.1, 1.0, 10.0])
def test_a_move_counts_as_the_difference_of_two_independent_estimates(beam, times):
    """Of one parameter it is (data alone - baseline) over the root of both variances, however tight the baseline is."""
    files = ("recordings.estimate=[again.h5]", "recordings.held_out=[bare.h5]")
    run = load_config(beam / "beam.yaml", (*files, "parameters.beam.damping.free=false"))
    problem = build_problem(run).with_parameter_values(TRUTH)
    alone = refit_with_effects(RefitContext(AllCandidatesProblem(problem, (), False)), (), {})
    std = alone.std["beam.bend"] * times
    before = alone.values["beam.bend"] + 3 * std
    known = RunEstimates("old", ("beam.bend",), np.array([before]), np.array([[std**2]]))
    beyond = replace(known, values=np.array([-1e-18]))  # rounding, where a run ended at its bound
    assert problem_with_priors_and_baseline(problem, beyond)[0].theta[problem.system.parameters.index("beam.bend")] == 0
    together, baseline = problem_with_priors_and_baseline(problem, known)
    both = refit_with_effects(RefitContext(AllCandidatesProblem(together, (), False)), (), {})
    [shift] = baseline.parameter_shifts_of_fit(both, Thresholds()).parameter_shifts
    apart = (alone.values["beam.bend"] - before) / np.hypot(std, alone.std["beam.bend"])
    if times < 0.2:
        assert shift.z_score is None  # the recording says nothing beside such a baseline
    else:
        assert shift.z_score == pytest.approx(apart, rel=0.1)
