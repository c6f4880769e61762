"""Changes of an experiment: what they would tell, their ranking, the smallest set, and its proof in another engine."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from heard import Heard

from yid_ocp.analysis import experiment_design
from yid_ocp.analysis.experiment_design import BaseExperiment, CandidateExperimentBuilder, observable_frames
from yid_ocp.analysis.identifiability import identifiability
from yid_ocp.analysis.what_if import ExperimentChange, WhatIfOptions, _are_compatible, what_if
from yid_ocp.data.recording import PointGroup
from yid_ocp.errors import DataError
from yid_ocp.integrator.step import compile_step
from yid_ocp.problem import EstimationProblem
from yid_ocp.solvers import GaussNewton, solve
from yid_ocp.virtual.experiment import VirtualExperiment, baxter_foam_y_system, run_virtual_experiment
from yid_ocp.virtual.joint_motion import MultisineOptions, random_multisine
from yid_ocp.virtual.mujoco_simulation import SimulationOptions
from yid_ocp.workflow.build_problem import load_problem

TRUTH = {"T1.bend": 22.0, "T1.twist": 13.6, "T2.bend": 10.7, "T2.twist": 8.2, "T3.bend": 11.5, "T3.twist": 9.7}


@pytest.fixture(scope="module")
def tube_ranking(held_tube):
    heard = Heard()
    return what_if(held_tube, progress=heard), heard.stages


def test_the_experiment_as_it_is_agrees_with_the_analysis(held_tube, tube_ranking):
    ranking, _ = tube_ranking
    info = identifiability(held_tube)
    assert ranking.unchanged_experiment.changes == ()
    assert ranking.unchanged_experiment.verdicts == {name: entry.verdict for name, entry in info.parameters.items()}
    for name, entry in info.parameters.items():
        assert ranking.unchanged_experiment.std_relative[name] == pytest.approx(entry.std_relative, rel=1e-5)


def test_a_predicted_sensor_tells_what_it_tells_when_it_is_there(held_tube, tube_ranking):
    ranking, _ = tube_ranking
    predicted = next(entry for entry in ranking.single_changes if entry.changes == ("camera:T1_1_tip",))
    episode = held_tube.episodes[0]
    camera = episode.recording.points[0]
    both = PointGroup(
        "points_camera", ["T1_0_tip", "T1_1_tip"], camera.t, np.zeros((21, 2, 3)), 2e-3, sensor="camera", pose=np.eye(4)
    )
    recording = replace(episode.recording, points=(both,))
    info = identifiability(EstimationProblem(held_tube.step, [recording], held_tube.free, held_tube.options))
    for name, entry in info.parameters.items():
        assert predicted.std_relative[name] == pytest.approx(entry.std_relative, rel=1e-5)


def test_changes_are_ranked_and_the_smallest_set_is_a_pair(tube_ranking):
    ranking, told = tube_ranking
    keys = [(-entry.identifiable, -entry.gain) for entry in ranking.single_changes]
    assert keys == sorted(keys)
    names = {entry.changes[0] for entry in ranking.single_changes}
    assert {"weld", "torque", "arm:T1_marker", "camera:T1_marker", "camera:w_T1", "rate:30"} <= names
    assert not any(entry.is_fully_identifiable for entry in ranking.single_changes)
    # more light and more points never tell less
    for entry in ranking.single_changes:
        if entry.changes[0].startswith(("camera:", "arm:", "rate:")):
            assert entry.gain >= ranking.unchanged_experiment.gain - 1e-9
    # the tube is turned only by a weld, and what that takes is felt only in torques
    assert {frozenset(entry.changes) for entry in ranking.smallest_sufficient_sets} == {frozenset({"weld", "torque"})}
    assert ranking.smallest_sufficient_sets[0].is_fully_identifiable
    assert ranking.n_evaluated_sets > len(ranking.single_changes)
    assert "working out weld grasps in place of points" in told


def test_torsional_springs_need_a_marker_off_the_axis(springs):
    ranking = what_if(springs("torsion"))
    assert ranking.unchanged_experiment.identifiable == 0
    complete = {entry.changes for entry in ranking.single_changes if entry.is_fully_identifiable}
    assert complete == {("camera:coupling_marker",), ("camera:spring_1_marker",)}
    assert {entry.changes for entry in ranking.smallest_sufficient_sets} == complete
    assert [entry.changes for entry in ranking.greedy_sequence] == [ranking.single_changes[0].changes]


def test_series_springs_need_the_joint(springs):
    ranking = what_if(springs("series_ends"), options=WhatIfOptions(max_set_size=1))
    assert [entry.changes for entry in ranking.smallest_sufficient_sets] == [("camera:joint",)]


def test_one_motion_and_one_rate_at_a_time():
    motion, travel = ExperimentChange("motion", "", "motion"), ExperimentChange("travel", "", "travel")
    slow, fast, weld = (
        ExperimentChange("rate:10", "", camera_rate=10.0),
        ExperimentChange("rate:30", "", camera_rate=30.0),
        ExperimentChange("weld", "", "weld"),
    )
    assert _are_compatible((motion, slow, weld))
    assert not _are_compatible((motion, travel))
    assert not _are_compatible((slow, fast))


def test_sights_of_the_y(single_arm):
    found = {sight.name: sight for sight in observable_frames(single_arm)}
    assert set(found) == {f"{form}" for s in ("T1", "T2", "T3") for form in (f"w_{s}", f"{s}_1_tip", f"{s}_marker")}
    assert found["T2_marker"].is_arm_measurable
    assert not found["T3_marker"].is_arm_measurable
    assert "3 cm off the axis at the end of T2" in found["T2_marker"].description


@pytest.fixture(scope="module")
def short_run(repository):
    """One arm on a coarse Y, half a second."""
    settings = (
        "model.object.links=1",
        "problem.duration=0.5",
        "problem.use_compiler=false",
        "parameters={T*.bend: {free: true, initial: 15}, T*.twist: {free: true, initial: 10}}",
    )
    return load_problem(repository / "configs" / "single_arm_vision.yaml", settings)


def test_another_motion_comes_from_held_out_recordings_without_mujoco(short_run, monkeypatch):
    def missing(*arguments, **settings):
        raise DataError("MuJoCo is not installed")

    monkeypatch.setattr(experiment_design, "simulate_in_mujoco", missing)
    builder = CandidateExperimentBuilder(BaseExperiment(short_run, short_run.initial_unknowns))
    other = builder.build_experiment(frozenset({"motion"}))
    assert not isinstance(other, str), other
    held_out = short_run.held_out[0].measured_driven_angles[:20]
    np.testing.assert_allclose(other.problem.episodes[0].measured_driven_angles[:20], held_out, atol=1e-12)
    assert builder.build_experiment(frozenset({"travel"})) == "MuJoCo is not installed"


def test_what_cannot_be_worked_out_is_said_and_ranked_last(short_run, monkeypatch):
    def missing(*arguments, **settings):
        raise DataError("MuJoCo is not installed")

    monkeypatch.setattr(experiment_design, "simulate_in_mujoco", missing)
    ranking = what_if(
        short_run, options=WhatIfOptions(considered_changes=("travel", "rate:30"), max_set_size=1), start="known"
    )
    assert [entry.changes for entry in ranking.single_changes] == [("rate:30",), ("travel",)]
    assert ranking.single_changes[1].message == "MuJoCo is not installed"
    assert ranking.single_changes[1].verdicts == {}
    assert ranking.single_changes[1].gain == -math.inf


# -- the paper's open question ----------------------------------------------------------------------------------------


def at_truth(problem: EstimationProblem) -> np.ndarray:
    return np.array([TRUTH[name] for name in problem.unknown_names])


@pytest.fixture
def exact(repository, clean):
    """exact(name): one of the paper's experiments with exact torques."""

    def load(name: str) -> EstimationProblem:
        files = (f"recordings.{purpose}=[{clean / name}_{purpose}.h5]" for purpose in ("estimate", "held_out"))
        return load_problem(repository / "configs" / f"{name}.yaml", tuple(files))

    return load


@pytest.mark.slow
def test_two_arms_need_welds_and_no_camera(exact):
    for name in ("dual_arm_vision", "dual_arm_no_vision"):
        problem = exact(name)
        ranking = what_if(problem, at_truth(problem))
        assert {n for n, v in ranking.unchanged_experiment.verdicts.items() if v == "not_identifiable"} == {
            "T2.twist",
            "T3.twist",
        }
        assert [entry.changes for entry in ranking.smallest_sufficient_sets] == [("weld",)]
        assert max(ranking.smallest_sufficient_sets[0].std_relative.values()) < 0.03


@pytest.mark.slow
def test_one_arm_needs_another_arm_and_welds(exact):
    problem = exact("single_arm_vision")
    ranking = what_if(problem, at_truth(problem), two_arm_system=baxter_foam_y_system(2))
    assert [set(entry.changes) for entry in ranking.smallest_sufficient_sets] == [{"weld", "second_arm"}]
    assert ranking.single_changes[0].changes == ("second_arm",)


@pytest.mark.slow
def test_the_smallest_set_finds_all_six_in_another_engine(exact):
    """Two arms with welds and no camera, MuJoCo's motion and noise, from a start of 3 N m/rad each."""
    made = exact("dual_arm_no_vision")
    layout = CandidateExperimentBuilder(BaseExperiment(made, at_truth(made))).build_experiment(frozenset({"weld"}))
    assert not isinstance(layout, str), layout
    system = layout.problem.system
    posture = dict(zip(system.driven, map(float, made.episodes[0].measured_driven_angles[0]), strict=True))
    motion = random_multisine(
        system, TRUTH, seed=7, initial_joint_angles=posture, excitation=MultisineOptions(gripper_travel=0.13)
    )
    simulation = SimulationOptions(time_step=5e-5)
    experiment = VirtualExperiment(motion, posture, simulation, camera=None, seed=5, recording_name="welded")
    recording = run_virtual_experiment(system, TRUTH, experiment)
    assert [group.name for group in recording.points] == ["points_arm"]
    step = compile_step(system, 0.01)
    problem = EstimationProblem(step, [recording], made.free, made.options, dict.fromkeys(TRUTH, 3.0))
    solution = solve(problem, GaussNewton())
    assert solution.goodness_of_fit.chi2_per_dof < 1.1
    info = identifiability(problem, solution, intervals="all")
    assert set(info.identifiable_parameters) == set(TRUTH)
    for name, truth in TRUTH.items():
        lower, upper = info.parameters[name].interval
        assert lower < truth < upper, name
