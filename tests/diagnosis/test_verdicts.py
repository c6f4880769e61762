"""One case of each verdict, the format of what comes out, and input that is refused."""

import importlib
import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from pendulum_bench import Bench

from yid_ocp.diagnosis.diagnose import diagnose
from yid_ocp.diagnosis.sentences import diagnosis_summary_text
from yid_ocp.diagnosis.thresholds import Thresholds
from yid_ocp.display import Progress
from yid_ocp.errors import SolverError, YidError
from yid_ocp.integrator.step import step_with_time_step
from yid_ocp.problem import ProblemOptions, SensorOptions

diagnose_module = importlib.import_module("yid_ocp.diagnosis.diagnose")  # the function hides its module
FRICTION = ("joint_coulomb", "link_mass@elbow", "effort_offset@elbow")


def found(bench, effects, candidates, **how):
    recordings = [bench.recording(effects, seed, **how) for seed in (1, 2)]
    problem = bench.problem(recordings[:1])
    finding = diagnose(problem, candidates, recordings[1:], thresholds=Thresholds(max_effects=2))
    result = json.loads(json.dumps(finding.to_dict()))
    located = result["verdict"] in ("effect", "confusable", "unknown")
    assert sum(place["share"] for place in result["where"]) == pytest.approx(1.0 if located else 0.0)
    # a stage that is not come to leaves nothing behind: neither places nor refits where there is no gap to locate
    assert (finding.smoother_result is not None) is located
    assert located or not finding.single_effect_models
    assert bool(result["effects"]) is (result["verdict"] in ("effect", "confusable"))
    assert (result["reason"] != "") is (result["verdict"] == "unknown")
    stages = "compose nominal events screening refits transfer localisation remaining law"
    assert list(result["seconds"]) == stages.split()
    assert finding.summary == diagnosis_summary_text(finding) == result["summary"]
    return finding, result


def test_a_withheld_effect_is_named_placed_and_measured(bench):
    finding, result = found(bench, {"joint_coulomb@elbow": {"tau_c": 0.1}}, FRICTION)
    assert result["verdict"] == "effect"
    assert result["effects"] == [{"kind": "joint_coulomb", "location": "elbow"}]
    assert result["which"][0]["kind"] == "joint_coulomb"
    assert result["where"][0]["location"] == "elbow"
    said = result["which"][0]["parameters"]["tau_c"]
    assert abs(said["value"] - 0.1) < 4 * said["std"]
    low, high = result["gap"]["closure_ci"]
    assert 0.9 < low <= result["gap"]["closure"] <= high + 1e-12
    assert result["gap"]["after"]["chi2_per_dof"] < 1.1 < result["gap"]["before"]["chi2_per_dof"]
    told = result["statistics"]
    assert told["explained_fraction"] == finding.explained_fraction > 0.9
    assert told["candidate"] <= len(FRICTION) * result["which"][0]["p_value"]
    left = finding.single_effect_models[0].held_out_loss.chi2_per_sample
    assert told["single_effects"]["joint_coulomb@elbow"] == {"held_out_chi2_per_sample": left, "bic_difference": 0.0}
    assert min(entry["bic_difference"] for entry in told["single_effects"].values()) == 0.0, "no other is as likely"
    again, name = finding.record.refits["joint_coulomb@elbow on the held-out recordings"], "joint_coulomb@elbow.tau_c"
    pair = finding.single_effect_models[0], again
    assert abs(np.diff([own.values[name] for own in pair])) < 4 * np.hypot(*(own.std[name] for own in pair))
    damping = finding.nominal_parameters_before_and_after["elbow.damping"]
    assert damping["before"] > damping["after"], "friction hides in the damping until it is named"
    assert "\n  joint_coulomb@elbow: tau_c" in result["summary"]


def test_a_spent_budget_ends_with_the_verdict_of_what_was_refitted(bench, monkeypatch):
    """Time stands still until the first refit is done, and is over then; without any it is over before."""
    recordings = [bench.recording({"joint_coulomb@elbow": {"tau_c": 0.1}}, seed) for seed in (1, 2)]
    clock = [0.0]

    class Hurried(Progress):
        def report_parts_done(self, done, total, text):
            clock[0] = 1e9 if done else 0.0

    def stopped(progress):
        limits = Thresholds(max_effects=2, budget=1e4, min_excess_chi2_per_dof=-0.5)
        problem = bench.problem(recordings[:1])
        finding = diagnose(problem, FRICTION, recordings[1:], thresholds=limits, progress=progress)
        said = f"(diagnosis.budget: 10000.0 s): {finding.untried[0]}"
        assert finding.summary.count(said) == 1
        return json.loads(json.dumps(finding.to_dict(), allow_nan=False))

    monkeypatch.setattr("yid_ocp.diagnosis.refit.time", SimpleNamespace(perf_counter=lambda: clock[0]))
    result = stopped(Hurried())
    assert (result["verdict"], result["effects"]) == ("effect", [{"kind": "joint_coulomb", "location": "elbow"}])
    assert [entry["closure"] is not None for entry in result["which"]] == [True, False, False, False]
    assert result["untried"][-1].endswith("beside joint_coulomb@elbow")
    clock[0] = 1e9
    result = stopped(Progress())
    assert (result["verdict"], result["reason"], result["effects"]) == ("unknown", "none", [])
    assert result["where"][0]["location"] == "elbow"
    assert all(entry["closure"] is None for entry in result["which"])
    assert "joint_coulomb@elbow" in result["untried"]
    assert "before the model was refitted" in result["summary"]


def test_a_model_that_is_right_has_no_gap(bench):
    _, result = found(bench, {}, FRICTION)
    assert result["verdict"] == "no_gap"
    assert result["gap"]["closure"] is None
    assert result["gap"]["before"] == result["gap"]["after"]
    told = result["statistics"]
    assert told["p_value"] > 0.01
    assert told["evidence"] is None


@pytest.mark.usefixtures("without_law")
def test_a_model_that_fails_with_all_candidates_is_diagnosed_at_a_shorter_step(bench, monkeypatch):
    real, failures = diagnose_module.screen_candidates, [SolverError("it fails", hint="")] * 2

    def screen(*arguments):
        if failures:
            raise failures.pop()
        return real(*arguments)

    monkeypatch.setattr(diagnose_module, "screen_candidates", screen)
    stated, finding = bench.step.time_step, found(bench, {}, FRICTION)[0]
    assert (finding.verdict, finding.stated_and_used_time_step) == ("no_gap", (stated, stated / 4))
    assert f"Time steps of {stated:.4g} s are too long" in finding.summary


@pytest.mark.parametrize(
    ("joints", "verdict", "steps"),
    [
        ((), "no_gap", (0.04, 0.02)),
        (("elbow", "shoulder"), "effect", (0.04, 0.04)),
        (("elbow",), "effect", (0.04, 0.01)),
    ],
)
@pytest.mark.usefixtures("without_law")
def test_the_error_of_a_long_step_is_no_gap_alone_or_beside_an_effect(bench, joints, verdict, steps):
    """Steps four times as long as those of the recordings; refits of the finer step have names of their own."""
    own = {f"joint_coulomb@{joint}": {"tau_c": 0.1} for joint in joints}
    recordings = [bench.recording(own, seed, duration=3.0) for seed in (1, 2)]
    coarse, store = Bench(bench.system, step_with_time_step(bench.step, 0.04)), {}
    candidates = ["joint_coulomb", "effort_offset"]
    finding = diagnose(coarse.problem(recordings[:1]), candidates, recordings[1:], store=store)
    assert (finding.verdict, finding.stated_and_used_time_step) == (verdict, steps)
    assert {effect.label for effect in finding.accepted_effects} == set(own)
    is_finer = steps[0] != steps[1]
    assert ("Time steps of 0.04 s are too long" in finding.summary, finding.discretisation_chi2 > 0) == (is_finer,) * 2
    assert ("the nominal model at 0.02 s" in store) is is_finer
    fit, true = finding.final_model, {"tau_c": 0.1, "damping": 0.05}
    wrong = [name for name, x in fit.values.items() if abs(x - true[name.rpartition(".")[2]]) > 2 * fit.std[name]]
    assert (wrong, finding.errors_in_std) == ([], ("time_step",))  # ± counts the step that was used


@pytest.mark.usefixtures("without_law")
def test_a_candidate_that_is_left_out_is_composed_and_not_tried(bench):
    recordings = [bench.recording({"joint_coulomb@elbow": {"tau_c": 0.1}}, seed) for seed in (1, 2)]
    problem = bench.problem(recordings[:1])
    finding = diagnose(problem, FRICTION, recordings[1:], exclude=["joint_coulomb@elbow", "effort_offset"])
    tried = {score.effect.label for score in finding.screening.candidate_scores}
    assert tried == {"joint_coulomb@shoulder", "link_mass@elbow"}
    assert "joint_coulomb@elbow.tau_c" in finding.nominal_model.problem.system.parameters.names
    assert "joint_coulomb@elbow" not in {effect.label for effect in finding.accepted_effects}
    for name, said in (("joint_viscous", "no candidate 'joint_viscous'"), ("joint_friction", "list joint_coulomb")):
        with pytest.raises(YidError, match=said):
            diagnose(problem, FRICTION, recordings[1:], exclude=[name])
    with pytest.raises(YidError, match="candidates are excluded"):
        diagnose(problem, FRICTION, recordings[1:], exclude=["joint_coulomb", "link_mass", "effort_offset"])


@pytest.mark.usefixtures("without_law")
def test_an_effect_that_is_not_in_the_library_is_unknown_but_placed(bench):
    def rattle(t):
        return np.stack([0 * t, 0.15 * np.sin(2 * np.pi * 7.3 * t)], axis=1)

    _, result = found(bench, {}, FRICTION, torque=rattle)
    assert result["verdict"] == "unknown"
    assert result["effects"] == []
    assert result["where"][0]["location"] == "elbow"


def test_effects_that_do_the_same_are_confusable(bench):
    # turning gravity about x and turning the first joint about x are one and the same
    _, result = found(
        bench, {"gravity_tilt@world": {"rx": 0.05}}, ("gravity_tilt", "encoder_offset@shoulder", "link_mass@elbow")
    )
    assert result["verdict"] == "confusable"
    labels = {f"{entry['kind']}@{entry['location']}" for entry in result["confusable"][0]}
    assert labels == {"gravity_tilt@world", "encoder_offset@shoulder"}
    assert result["next_experiment"]


def test_a_moment_of_data_is_insufficient(bench):
    _, result = found(bench, {"joint_coulomb@elbow": {"tau_c": 0.1}}, FRICTION, duration=0.03)
    assert result["verdict"] == "insufficient_data"
    assert result["effects"] == []
    assert "independent samples" in result["summary"]


@pytest.fixture
def short(bench):
    return bench.recording({}, 1, duration=0.5)


@pytest.mark.parametrize(
    ("candidates", "words"),
    [
        (["kelvin_voigt"], ("kelvin_voigt is not possible for this model",)),
        (["joint_coulom"], ("joint_coulom", "joint_coulomb")),
        (["joint_coulomb@elbo"], ("elbo", "elbow")),
        (["camera_latency"], ("camera_latency is not possible for this model", "camera")),
        ([], ("candidates are []",)),
        ("everything", ("all",)),
    ],
)
def test_candidates_that_do_not_fit_are_refused(refused_with, bench, short, candidates, words):
    with refused_with(YidError, words):
        diagnose(bench.problem([short]), candidates)


@pytest.mark.parametrize("std", [None, 0.0])
def test_a_noise_level_that_is_zero_or_absent_is_refused(bench, short, std):
    silent = replace(short, joints=replace(short.joints, effort_std=std))
    with pytest.raises(YidError, match="noise "):
        diagnose(bench.problem([silent]), FRICTION)


def test_held_out_data_must_be_other_data_and_the_papers_weighting_cannot_be_diagnosed(bench, short):
    copy = replace(short, name="another_name")
    with pytest.raises(YidError, match="both for the estimate and as held-out"):
        diagnose(bench.problem([short]), FRICTION, [copy])
    options = ProblemOptions(weighting="paper", path_cutoff=np.inf, sensors={"joints.effort": SensorOptions(std=0.02)})
    with pytest.raises(YidError, match="whitened"):
        diagnose(bench.problem([short], options=options), FRICTION)
