"""Several methods on one problem: cost in time, agreement, and what is said of parameters that nothing informs."""

from __future__ import annotations

import json

import pytest

from yid_ocp.analysis.compare import compare_methods
from yid_ocp.cli import main
from yid_ocp.data import read_recording
from yid_ocp.integrator.step import compile_step
from yid_ocp.problem import EstimationProblem, ProblemOptions
from yid_ocp.solvers import GaussNewton, SingleShooting, SteepestDescent


@pytest.fixture(scope="module")
def problem(paper_systems, clean):
    step = compile_step(paper_systems["single"], 0.01)
    recording = read_recording(clean / "single_arm_vision_estimate.h5")
    held_out = read_recording(clean / "single_arm_vision_held_out.h5")
    free = ("T1.bend", "T2.bend", "T3.twist")
    return EstimationProblem(step, [recording], free, ProblemOptions(duration=1.5), None, [held_out])


def test_methods_agree_on_what_the_data_inform(problem):
    told = []
    found = compare_methods(
        problem, [GaussNewton(), SingleShooting()], {"T3.twist": 9.7}, lambda name, _: told.append(name)
    )
    assert found.is_consistent
    assert {run.method for run in found.method_results} == set(told) == {"gauss_newton", "single_shooting"}
    assert any("T3.twist (truth 9.7) cannot be found: where it ends" in sentence for sentence in found.explanations)
    for run in found.method_results:
        assert run.wall_seconds > 0
        assert run.peak_memory_mib > 10
        assert len(run.held_out_predictions) == 1


def test_a_method_that_stops_early_is_said_to_differ(problem):
    found = compare_methods(problem, [GaussNewton(), SteepestDescent(max_iterations=2)])
    assert found.reference_method == "gauss_newton"
    assert not found.is_consistent
    assert any("iteration_limit" in sentence for sentence in found.disagreements["steepest_descent"])


def test_steepest_descent_goes_wrong_exactly_where_nothing_is_found(problem):
    """The core of the paper's effect on a quick case; docs/comparison.md has its four experiments."""
    truth = {"T1.bend": 22.0, "T2.bend": 10.7, "T3.twist": 9.7}
    descent = SteepestDescent(first_trial_step="spectral", nonmonotone_memory=10, gradient_tolerance=1e-4)
    found = compare_methods(problem, [GaussNewton(), descent], truth)
    assert found.is_consistent
    sentence = found.explanations[-1]
    assert "T3.twist (3 for 9.7, cannot be found)" in sentence
    assert "T1.bend" not in sentence
    assert "T2.bend" not in sentence
    assert "exactly the parameters that are not found" in sentence
    short = compare_methods(problem, [GaussNewton(), SteepestDescent(max_iterations=2)], truth)
    assert "could be found: the method stopped short (iteration_limit)" in short.explanations[-1]


def test_nothing_to_agree_on(repository, tmp_path, capsys):
    config = repository / "configs" / "springs_series_ends.yaml"
    methods = "compare.methods={gauss_newton: {}, single_shooting: {max_iterations: 3}, "
    methods += "multiple_shooting: {max_iterations: 2}}"
    assert main(["compare", str(config), "--out", str(tmp_path / "run"), "--set", methods]) == 0
    text = capsys.readouterr().out
    assert "single_shooting did not converge" in text
    assert "multiple_shooting did not converge: IPOPT stopped after 2 iterations" in text
    assert "no parameter can be found from these recordings, so there is nothing to agree on" in text
    result = json.loads((tmp_path / "run" / "result.json").read_text(encoding="utf-8"))
    assert all(entry["parameters"]["spring_1.stiffness"]["value"] > 0 for entry in result["methods"].values())


def test_command(repository, clean, tmp_path, capsys):
    config = repository / "configs" / "single_arm_no_vision.yaml"
    settings = [
        "problem.duration=0.5",
        "compare.methods={gauss_newton: {}, single_shooting: {}}",
        "parameters={}",
        "parameters={T1.bend: {free: true, initial: 15}, T1.twist: {initial: 13.6}, T2.bend: {initial: 10.7}, "
        "T2.twist: {initial: 8.2}, T3.bend: {initial: 11.5}, T3.twist: {initial: 9.7}}",
        *(f"recordings.{purpose}=[{clean}/single_arm_no_vision_{purpose}.h5]" for purpose in ("estimate", "held_out")),
    ]
    arguments = [part for setting in settings for part in ("--set", setting)]
    assert main(["compare", str(config), "--out", str(tmp_path / "run"), *arguments]) == 0
    text = capsys.readouterr().out
    assert "published" in text
    assert "truth" in text
    assert "all noise" not in text
    assert "\nT1.bend = 23.78 of the paper: " in text
    result = json.loads((tmp_path / "run" / "result.json").read_text(encoding="utf-8"))
    assert result["format"] == "yid-compare/1"
    assert set(result["methods"]) == {"gauss_newton", "single_shooting"}
    assert result["methods"]["gauss_newton"]["format"] == "yid-solve/1"
    assert result["judged"]["parameters"] == result["methods"][result["reference"]]["parameters"]
    assert [said.split(" = ")[0] for said in result["published_explained"]] == ["T1.bend"]
    assert (tmp_path / "run" / "convergence.png").stat().st_size > 1000


@pytest.mark.slow
def test_command_weighs_all_noise_of_the_embedded_recordings(repository, tmp_path, capsys):
    """Torques with offsets mislead what takes them as true; the verdicts do not follow it."""
    config = repository / "configs" / "dual_arm_no_vision.yaml"
    arguments = ["--out", str(tmp_path / "run"), "--set", "compare.methods={single_shooting: {}}"]
    assert main(["compare", str(config), *arguments]) == 0
    assert "the column 'all noise' and the verdicts weigh" in capsys.readouterr().out
    result = json.loads((tmp_path / "run" / "result.json").read_text(encoding="utf-8"))
    assert result["judged"]["fit"]["explains"]
    assert not result["methods"]["single_shooting"]["fit"]["explains"]
    found = {name: e for name, e in result["judged"]["parameters"].items() if e["verdict"] == "identifiable"}
    assert set(found) == {"T1.bend", "T1.twist", "T2.bend", "T3.bend"}
    for name, entry in found.items():
        assert abs(entry["value"] - result["truth"][name]) < 2 * entry["std"], name


@pytest.mark.parametrize("methods", ["{newton: {}}", "{gauss_newton: {iteration: 3}}", "{}"])
def test_wrong_methods_are_refused(repository, tmp_path, capsys, methods):
    config = repository / "configs" / "single_arm_no_vision.yaml"
    arguments = ["compare", str(config), "--out", str(tmp_path / "run"), "--set", f"compare.methods={methods}"]
    assert main(arguments) == 2
    assert "compare.methods" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
