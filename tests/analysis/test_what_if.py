"""Changes of an experiment: what they would tell, their ranking, the smallest set, and its proof in another engine."""

from __future__ import annotations

import math
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
from baxter import baxter_foam_y_system
from heard import Heard

from yid_ocp.analysis import experiment_design
from yid_ocp.analysis.experiment_design import ExperimentVariantSensitivityBuilder, UnchangedExperiment
from yid_ocp.analysis.identifiability import identifiability
from yid_ocp.analysis.what_if import ChangedExperimentResult, evaluate_experiment_change_sets, what_if
from yid_ocp.data.recording import PointGroup
from yid_ocp.errors import DataError, SolverError
from yid_ocp.integrator.step import compile_step
from yid_ocp.problem import EstimationProblem
from yid_ocp.solvers import GaussNewton, fit_problem
from yid_ocp.virtual.experiment import VirtualExperimentSettings, run_virtual_experiment
from yid_ocp.virtual.joint_motion import MultisineOptions, random_multisine_motion
from yid_ocp.virtual.mujoco_simulation import SimulationOptions
from yid_ocp.workflow.build_problem import load_problem

TRUTH = {"T1.bend": 22.0, "T1.twist": 13.6, "T2.bend": 10.7, "T2.twist": 8.2, "T3.bend": 11.5, "T3.twist": 9.7}


@pytest.fixture(scope="module")
def short_run(repository):
    """One arm on a coarse Y, half a second."""
    coarse = ("model.object.links=1", "problem.duration=0.5", "problem.use_compiler=false")
    free = "parameters={T*.bend: {free: true, initial: 15}, T*.twist: {free: true, initial: 10}}"
    return load_problem(repository / "configs" / "single_arm_vision.yaml", (*coarse, free))


LETTERS = {"weld": "w", "motion": "m", "travel": "t", "camera:T1_marker": "c", "arm:T2_marker": "a"}
LETTERS |= {"rate:10": "s", "rate:30": "f"}
NAMES = {letter: name for name, letter in LETTERS.items()}


def ranked(problem, considered, table, **more):
    """The ranking where sets find so many of three parameters, with such a gain; None cannot be evaluated."""

    def evaluate(sets, inflation):
        found = []
        for changes in sets:
            key = "".join(sorted(LETTERS[change.name] for change in changes))
            count, gain = table.get(key, (0, 0.0)) or (0, -math.inf)
            failed = table.get(key, ()) is None
            verdicts = {f"k{i}": "identifiable" if i < count else "weak" for i in range(3)}
            names = tuple(change.name for change in changes)
            found.append(ChangedExperimentResult(names, key, {}, {} if failed else verdicts, count, gain, "it snaps"))
        return found

    names = None if considered is None else {NAMES[letter] for letter in considered}
    return what_if(problem, considered_changes=names, evaluate_changes=evaluate, **more)


def words(results):
    return " ".join("".join(sorted(LETTERS[name] for name in entry.changes)) or "-" for entry in results)


THREE = {"c": (1, 1.0), "a": (1, 2.0), "ac": (2, 1.0), "as": (2, 3.0), "acs": (3, 4.0)}
SETS = {
    "one does": ("wca", {"w": (3, 1.0), "c": (2, 5.0), "cw": (3, 9.0)}, "w", 4),
    "two pairs do": ("wcas", {"w": (2, 1.0), "cw": (3, 1.0), "as": (3, 9.0), "acw": (3, 20.0)}, "as cw", 11),
    "three do": ("wcas", THREE, "acs", 15),
    "four would": ("wcas", {"acsw": (3, 4.0)}, "", 15),
    "one motion at a time": ("mt", {"m": (1, 1.0), "mt": (3, 9.0)}, "", 3),
    "one rate at a time": ("sf", {"f": (1, 1.0), "fs": (3, 9.0)}, "", 3),
    "a motion and a rate": ("mf", {"m": (1, 1.0), "fm": (3, 9.0)}, "fm", 4),
    "nothing to find": ("wc", {"": (3, 0.0), "w": (3, 5.0)}, "-", 3),
    "no change": ("", {}, "", 1),
}


@pytest.mark.parametrize(("considered", "table", "smallest", "count"), SETS.values(), ids=SETS)
def test_the_fewest_changes_that_find_every_parameter(short_run, considered, table, smallest, count):
    found = ranked(short_run, considered, table)
    assert words(found.smallest_sufficient_sets) == smallest
    assert found.n_evaluated_sets == count


def test_most_identifiable_first_then_gain_and_what_failed_last(short_run):
    table = {"f": (2, 1.0), "a": (1, 9.0), "c": (1, 2.0), "w": (0, 50.0), "m": None}
    assert words(ranked(short_run, "wmcaf", table).single_changes) == "f a c w m"
    with pytest.raises(SolverError, match="it snaps"):
        ranked(short_run, "w", {"": None})


def test_changes_that_apply(short_run, held_tube):
    names = {}
    for problem, key in ((short_run, "y"), (held_tube, "tube")):
        given = []
        what_if(problem, evaluate_changes=lambda sets, _, given=given: given.extend(sets) or told(sets))
        names[key] = {change.name: change for (change,) in (entry for entry in given if len(entry) == 1)}
    assert {"weld", "motion", "travel", "rate:10", "rate:30"} <= set(names["y"])
    assert "torque" in names["tube"]
    assert not {"motion", "rate:10", "camera:T1_0_tip", "second_arm"} & set(names["tube"])
    for found in names.values():
        for name, change in found.items():
            kind, _, what = name.partition(":")
            assert change.setup_change == (name if name in experiment_design.SETUP_CHANGE_DESCRIPTIONS else "")
            assert change.camera_frame == (what if kind == "camera" else "")
            assert change.arm_frame == (what if kind == "arm" else "")
            assert change.camera_rate == (float(what) if kind == "rate" else None)
    assert names["tube"]["arm:T1_marker"].description.endswith("at the end of T1, seen by the arm")
    assert "camera at 30 Hz" in names["tube"]["rate:30"].description


def told(sets):
    """Every parameter is found with any change, none without."""
    names = [tuple(change.name for change in changes) for changes in sets]
    return [ChangedExperimentResult(own, "", {}, {"k": "weak"}, int(bool(own)), 1.0) for own in names]


@pytest.mark.parametrize(("period", "rates"), [(0.2, ["rate:10", "rate:30"]), (0.09, ["rate:30"]), (0.03, [])])
def test_faster_cameras_than_there_was(held_tube, period, rates):
    recording, t = held_tube.episodes[0].recording, period * np.arange(1, 10)
    camera = PointGroup("points_camera", ["T1_0_tip"], t, np.zeros((9, 1, 3)), 2e-3, "camera", camera_pose=np.eye(4))
    recordings = [replace(recording, points=(camera,))]
    problem = EstimationProblem(held_tube.step, recordings, held_tube.free, held_tube.options)
    found = what_if(problem, considered_changes={"rate:10", "rate:30"}, evaluate_changes=lambda sets, _: told(sets))
    assert sorted(name for entry in found.single_changes for name in entry.changes) == rates


@pytest.fixture(scope="module")
def tube_ranking(held_tube):
    heard = Heard()
    return what_if(held_tube, progress=heard), heard.stages


def test_the_experiment_as_it_is_agrees_with_the_analysis(held_tube, tube_ranking):
    ranking, _ = tube_ranking
    base, info = ranking.unchanged_experiment, identifiability(held_tube)
    assert (base.changes, base.description) == ((), "none (the experiment as it is)")
    assert base.verdicts == {name: entry.verdict for name, entry in info.parameters.items()}
    assert base.identifiable == sum(said == "identifiable" for said in base.verdicts.values())
    for name, entry in info.parameters.items():
        assert base.std_relative[name] == pytest.approx(entry.std_relative, rel=1e-5)
    gain = 0.5 * np.sum(np.log1p(16 * np.linalg.eigvalsh(info.fisher_information)))
    assert base.gain == pytest.approx(gain, rel=1e-5)


def test_a_fit_that_is_worse_than_its_noise_informs_less(held_tube, tube_ranking):
    x = held_tube.initial_unknowns
    chi2 = identifiability(held_tube, x).chi2_per_dof
    assert chi2 > 2
    found = what_if(held_tube, x, considered_changes=()).unchanged_experiment.std_relative["T1.bend"]
    known = tube_ranking[0].unchanged_experiment.std_relative["T1.bend"]
    assert found == pytest.approx(math.sqrt(chi2) * known, rel=1e-5)
    [other] = evaluate_experiment_change_sets(UnchangedExperiment(held_tube, x), [()], chi2)
    assert other.std_relative["T1.bend"] == pytest.approx(found, rel=1e-9)


@pytest.mark.parametrize(
    ("name", "frames", "times"),
    [("camera:T1_1_tip", ["T1_0_tip", "T1_1_tip"], 0.1 * np.arange(21)), ("rate:30", ["T1_0_tip"], np.arange(61) / 30)],
)
def test_a_predicted_sensor_tells_what_it_tells_when_it_is_there(held_tube, tube_ranking, name, frames, times):
    ranking, _ = tube_ranking
    predicted = next(entry for entry in ranking.single_changes if entry.changes == (name,))
    nothing, how = np.zeros((len(times), len(frames), 3)), {"sensor_name": "camera", "camera_pose": np.eye(4)}
    seen = PointGroup("points_camera", frames, times, nothing, 2e-3, **how)
    recording = replace(held_tube.episodes[0].recording, points=(seen,))
    info = identifiability(EstimationProblem(held_tube.step, [recording], held_tube.free, held_tube.options))
    for parameter, entry in info.parameters.items():
        assert predicted.std_relative[parameter] == pytest.approx(entry.std_relative, rel=1e-4)


def test_changes_are_ranked_and_the_smallest_set_is_a_pair(tube_ranking):
    ranking, stages = tube_ranking
    names = {entry.changes[0] for entry in ranking.single_changes}
    assert {"weld", "torque", "arm:T1_marker", "camera:T1_marker", "camera:w_T1", "rate:30"} <= names
    assert all(entry.identifiable < 2 for entry in ranking.single_changes)
    # more light and more points never tell less
    for entry in ranking.single_changes:
        if entry.changes[0].startswith(("camera:", "arm:", "rate:")):
            assert entry.gain >= ranking.unchanged_experiment.gain - 1e-9
    # the tube is turned only by a weld, and what that takes is felt only in torques
    assert [set(entry.changes) for entry in ranking.smallest_sufficient_sets] == [{"weld", "torque"}]
    assert ranking.smallest_sufficient_sets[0].identifiable == 2
    assert "simulating with weld grasps in place of point grasps" in stages


def test_springs_need_a_marker_off_the_axis_or_the_joint(springs):
    ranking = what_if(springs("torsion"))
    assert ranking.unchanged_experiment.identifiable == 0
    complete = {entry.changes for entry in ranking.single_changes if set(entry.verdicts.values()) == {"identifiable"}}
    assert complete == {("camera:coupling_marker",), ("camera:spring_1_marker",)}
    assert {entry.changes for entry in ranking.smallest_sufficient_sets} == complete
    assert [entry.changes for entry in what_if(springs("series_ends")).smallest_sufficient_sets] == [("camera:joint",)]


def test_another_motion_comes_from_held_out_recordings_without_mujoco(short_run, monkeypatch):
    missing = Mock(side_effect=DataError("MuJoCo is not installed", hint=""))
    monkeypatch.setattr(experiment_design, "simulate_in_mujoco", missing)
    builder = ExperimentVariantSensitivityBuilder(UnchangedExperiment(short_run, short_run.initial_unknowns))
    other = builder.position_sensitivities_of_variant(frozenset({"motion"}))
    assert not isinstance(other, str), other
    held_out = short_run.held_out[0].measured_driven_angles[:20]
    np.testing.assert_allclose(other.problem.episodes[0].measured_driven_angles[:20], held_out, atol=1e-12)
    ranking = what_if(short_run, considered_changes=("travel", "rate:30"))
    assert [entry.changes for entry in ranking.single_changes] == [("rate:30",), ("travel",)]
    failed = ranking.single_changes[1]
    assert (failed.message, failed.verdicts, failed.gain) == ("MuJoCo is not installed", {}, -math.inf)


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
        hidden = {n for n, v in ranking.unchanged_experiment.verdicts.items() if v == "not_identifiable"}
        assert hidden == {"T2.twist", "T3.twist"}
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
    layout = ExperimentVariantSensitivityBuilder(
        UnchangedExperiment(made, at_truth(made))
    ).position_sensitivities_of_variant(frozenset({"weld"}))
    assert not isinstance(layout, str), layout
    system = layout.problem.system
    posture = dict(zip(system.driven, map(float, made.episodes[0].measured_driven_angles[0]), strict=True))
    how = {"initial_joint_angles": posture, "excitation": MultisineOptions(gripper_travel=0.13)}
    motion = random_multisine_motion(system, TRUTH, seed=7, **how)
    simulation = SimulationOptions(time_step=5e-5)
    experiment = VirtualExperimentSettings(motion, posture, simulation, camera=None, seed=5, recording_name="welded")
    recording = run_virtual_experiment(system, TRUTH, experiment)
    assert [group.name for group in recording.points] == ["points_arm"]
    start = dict.fromkeys(TRUTH, 3.0)
    problem = EstimationProblem(compile_step(system, 0.01), [recording], made.free, made.options, start)
    solution = fit_problem(problem, GaussNewton())
    assert solution.goodness_of_fit.chi2_per_dof < 1.1
    info = identifiability(problem, solution, intervals="all")
    for name, truth in TRUTH.items():
        assert info.parameters[name].verdict == "identifiable"
        lower, upper = info.parameters[name].interval
        assert lower < truth < upper, name
