"""The command `identifiability`: table, run folder, report, bad requests, tasks on workers."""

import json
from dataclasses import replace
from unittest.mock import Mock

import pytest

from yid_ocp.analysis import identifiability as fisher
from yid_ocp.config.reader import load_config
from yid_ocp.errors import ParallelWorkError, SolverError
from yid_ocp.parallel import InlineExecutor
from yid_ocp.workflow.build import build_system, system_with_second_arm_holding_object
from yid_ocp.workflow.identifiability import IdentifiabilityOptions, run_identifiability

VERDICTS = {"identifiable", "weak", "not_identifiable", "at_bound", "not_trusted"}
EVERY = IdentifiabilityOptions(interval_parameters="all")
COMMANDS, NO_REPORT = ("solve", "identifiability", "compare"), ("output.write_report=false",)
PARTS = {
    "": {"format", "status", "parameters", "directions", "what_if", "inputs", "versions", "correlations"},
    "parameters": {"value", "unit", "std_relative", "verdict", "interval", "std_alone"},
    "directions": {"singular_value", "components", "words", "verdict"},
    "what_if": {"base", "singles", "smallest", "searched"},
    "changes": {"changes", "words", "std_relative", "verdicts", "identifiable", "gain", "message"},
}


def check_keys(result):
    asked = result["what_if"]
    found = [("", result), *(("parameters", entry) for entry in result["parameters"].values())]
    found += [("directions", entry) for entry in result["directions"]]
    if asked is not None:
        found += [("what_if", asked), *(("changes", e) for e in (asked["base"], *asked["singles"], *asked["smallest"]))]
    for part, entry in found:
        assert PARTS[part] <= set(entry), part
    assert result["format"] == "yid-identifiability/1"
    assert {entry["verdict"] for entry in result["parameters"].values()} <= VERDICTS


def test_springs_that_cannot_be_told_apart(carried_out, repository):
    asked = ("--what-if", "--unknown-start", "--unknown-grasp")
    done = carried_out("identifiability", repository / "configs" / "springs_torsion.yaml", *asked)
    assert ("0 of 2 parameters can be determined" in done.out, "plan a motion" in done.out) == (True, False)
    assert "1/spring_1.stiffness + 1/spring_2.stiffness, like springs in series (together" in " ".join(done.out.split())
    assert "All parameters would be found with: the point 'coupling_marker'" in done.out
    result = done.result
    check_keys(result)
    assert (result["start"], result["nuisances"]) == ("unknown", 4)
    for entry in result["parameters"].values():
        assert entry["interval"] == [pytest.approx(1.2, rel=0.02), None]
    parts = "What another experiment would find", "cannot be found"
    assert all(part in (done.folder / "report.html").read_text() for part in parts)
    assert {"config.yaml", "log.jsonl"} <= {entry.name for entry in done.folder.iterdir()}


def test_springs_that_can(carried_out, repository):
    file = repository / "configs" / "springs_series_joint.yaml"
    done = carried_out("identifiability", file, "--intervals", "spring_1.stiffness", settings=NO_REPORT)
    assert "2 of 2 parameters can be determined" in done.out
    result, intervals = done.result, {name: own["interval"] for name, own in done.result["parameters"].items()}
    check_keys(result)
    assert (result["what_if"], result["nuisances"], intervals["spring_2.stiffness"]) == (None, 0, None)
    assert intervals["spring_1.stiffness"][0] < 200.0 < intervals["spring_1.stiffness"][1]


def test_judged_at_the_initial_values_without_solving(carried_out, repository):
    file = repository / "configs" / "springs_series_ends.yaml"
    done = carried_out("identifiability", file, "--initial", settings=NO_REPORT)
    assert (done.result["status"], "interval " in done.out) == ("not_solved", False)
    assert {entry["value"] for entry in done.result["parameters"].values()} == {100.0}


NOT_THERE = {("--intervals", "spring_1.stifness"): "did you mean 'spring_1.stiffness'?"}
NOT_THERE["--set", "model.arms.passive_joints=[spring_1, spring_9]"] = "there is no joint 'spring_9'"


@pytest.mark.parametrize(("options", "said"), NOT_THERE.items())
def test_names_that_are_not_there_are_refused(printed, repository, tmp_path, left_nothing, options, said):
    file = repository / "configs" / "springs_series_ends.yaml"
    assert said in printed("identifiability", file, "--out", tmp_path / "run", *options, code=2)
    left_nothing()


def test_a_failed_solve_leaves_no_point_to_judge_at(carried_out, repository, monkeypatch):
    from yid_ocp.solvers import GaussNewton, Status, fit_problem
    from yid_ocp.solvers import base as solvers

    def failing(problem, solver, callback=None, limits=None):
        done = fit_problem(problem, GaussNewton(max_iterations=1))
        return replace(done, status=Status.FAILED, message="the rollout failed", evaluation=None)

    monkeypatch.setattr(solvers, "fit_problem", failing)
    done = carried_out("identifiability", repository / "configs" / "springs_series_ends.yaml", codes=(1,))
    assert "There is nothing to analyse, because the fit ended as failed (the rollout failed)." in done.out
    assert done.result["parameters"] == {}
    assert "There is nothing to analyse, because the fit ended as failed" in (done.folder / "report.html").read_text()


@pytest.mark.parametrize("named", ["pendulum", "springs_torsion", "springs_series_joint"])
def test_no_two_commands_give_two_verdicts_for_one_parameter(carried_out, repository, pendulum, named):
    file = pendulum if named == "pendulum" else repository / "configs" / f"{named}.yaml"
    settings = (*NO_REPORT, "compare.methods={gauss_newton: {}, single_shooting: {}}")
    solved, judged, compared = (carried_out(name, file, settings=settings, out=name).result for name in COMMANDS)
    reference = compared["methods"][compared["reference"]]["parameters"]
    free = [name for name, entry in solved["parameters"].items() if entry["free"]]
    assert free
    for name in free:
        said = {entry[name]["verdict"] for entry in (solved["parameters"], judged["parameters"], reference)}
        assert len(said) == 1, (name, said)
        if solved["parameters"][name]["verdict"] == "identifiable":
            # `solve` adds how far the discretisation moves it
            alone = solved["discretisation"].get(name, solved["parameters"][name])["std"]
            assert judged["parameters"][name]["std"] == pytest.approx(alone, rel=0.05)


@pytest.mark.parametrize("command", COMMANDS)
def test_a_model_that_does_not_explain_its_recordings_is_said_first_by_all(carried_out, pendulum, command):
    """The same pendulum with its noise stated ten times too small."""
    settings = (*NO_REPORT, "sensors={joints.effort: {std: 0.001}}", "compare.methods={gauss_newton: {}}")
    done = carried_out(command, pendulum, settings=settings)
    doubt, _, text = " ".join(done.out.split()).partition("The model does not explain the recordings: chi2 ")
    assert text.partition(" First follow the advice above.")[0].endswith("; noise alone gives 1.")
    assert not doubt or doubt.startswith("Do not use estimates yet, because a channel has more ")
    assert "in doubt" in done.out
    result = done.result
    own = result["methods"]["gauss_newton"] if command == "compare" else result
    assert own["fit"]["explains"] is False
    assert {entry["verdict"] for entry in own["parameters"].values()} - {"fixed"} == {"not_trusted"}


QUICK = ("output.write_report=false", "problem.duration=5")
KEYS = ("parameters", "directions", "profiles", "what_if", "correlations", "fit")


def read(outcome):
    told = json.loads((outcome.folder / "result.json").read_text())
    return {key: told[key] for key in KEYS}


@pytest.fixture
def run(repository):
    """Two springs in series that can be told apart."""
    return load_config(repository / "configs" / "springs_series_joint.yaml", QUICK)


def test_workers_find_what_one_process_does(run, tmp_path):
    known = {"start_knowledge": "unknown", "grasp_offset_std": 0.01}
    asked = IdentifiabilityOptions(interval_parameters="all", rank_changes=True, **known)
    alone = run_identifiability(run, tmp_path / "alone", options=asked)
    assert read(run_identifiability(run, tmp_path / "shared", options=asked, workers=InlineExecutor())) == read(alone)
    assert {path.name for path in tmp_path.iterdir()} == {"alone", "shared"}


def test_an_interrupted_run_goes_on(run, tmp_path, monkeypatch):
    done, asked = fisher.identifiability, Mock(side_effect=[None, KeyboardInterrupt])

    def twice(problem, solution, intervals=(), **more):
        if intervals:
            asked(intervals)
        return done(problem, solution, intervals=intervals, **more)

    monkeypatch.setattr(fisher, "identifiability", twice)
    with pytest.raises(KeyboardInterrupt):
        run_identifiability(run, tmp_path / "run", options=EVERY, workers=InlineExecutor())
    assert len(list((tmp_path / "run.partial" / "tasks").glob("*.json"))) == 1
    monkeypatch.setattr(fisher, "identifiability", done)
    outcome = run_identifiability(run, tmp_path / "run", options=EVERY, workers=InlineExecutor())
    assert set(outcome.result["profiles"]) == {"spring_1.stiffness", "spring_2.stiffness"}
    assert not (tmp_path / "run.partial").exists()


def test_a_part_that_fails_is_said(run, tmp_path, monkeypatch):
    done = fisher.identifiability

    def failing(problem, solution, intervals=(), **more):
        if intervals:
            raise SolverError(f"no {intervals[0]}", hint="mend it")
        return done(problem, solution, **more)

    monkeypatch.setattr(fisher, "identifiability", failing)
    words = r"2 of 2 tasks failed; the first failure is that of spring_1.stiffness: no s(.|\n)*mend it"
    with pytest.raises(ParallelWorkError, match=words):
        run_identifiability(run, tmp_path / "run", options=EVERY, workers=InlineExecutor())


def test_the_other_arm_of_a_robot(repository):
    run = load_config(repository / "configs" / "single_arm_vision.yaml")
    system = build_system(run)
    both = system_with_second_arm_holding_object(run, system)
    assert both is not None
    assert both.driven[:7] == system.driven
    assert both.driven[7:] == tuple(name.replace("left_", "right_") for name in system.driven)
    found = {grasp.name: (grasp.holder_frame, grasp.held_frame) for grasp in both.grasps}
    assert found == {"left": ("left_gripper", "w_T2"), "right": ("right_gripper", "w_T3")}
    dual = load_config(repository / "configs" / "dual_arm_vision.yaml")
    assert system_with_second_arm_holding_object(dual, both) is None
    moved = replace(run, model=replace(run.model, arms=replace(run.model.arms, mode="prescribed")))
    assert system_with_second_arm_holding_object(moved, system) is None
