"""The command `identifiability` on workers, and the second arm among its changes."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from yid_ocp.config.reader import load_config
from yid_ocp.errors import SolverError, WorkerError
from yid_ocp.parallel import InlineExecutor
from yid_ocp.workflow import identifiability as identifiability_command
from yid_ocp.workflow.build import build_system, system_with_second_arm
from yid_ocp.workflow.identifiability import IdentifiabilityOptions, run_identifiability

QUICK = ("output.write_report=false", "problem.duration=5")
KEYS = ("parameters", "directions", "profiles", "what_if", "correlations", "fit")


def read(outcome):
    told = json.loads((outcome.folder / "result.json").read_text())
    return {key: told[key] for key in KEYS}


def test_workers_find_what_one_process_does(repository, tmp_path):
    run = load_config(repository / "configs" / "springs_series_joint.yaml", QUICK)
    asked = IdentifiabilityOptions(
        interval_parameters="all", rank_changes=True, start_knowledge="unknown", grasp_offset_std=0.01
    )
    alone = run_identifiability(run, tmp_path / "alone", options=asked)
    shared = run_identifiability(run, tmp_path / "shared", options=asked, workers=InlineExecutor())
    assert read(shared) == read(alone)
    assert {path.name for path in tmp_path.iterdir()} == {"alone", "shared"}


def test_an_interrupted_run_goes_on(repository, tmp_path, monkeypatch):
    run = load_config(repository / "configs" / "springs_series_joint.yaml", QUICK)
    asked = IdentifiabilityOptions(interval_parameters="all")
    names, done = [], identifiability_command.profile_likelihood_task

    def twice(name, **arguments):
        if len(names) == 1:
            raise KeyboardInterrupt
        names.append(name)
        return done(name=name, **arguments)

    twice.__module__, twice.__qualname__ = done.__module__, done.__qualname__
    monkeypatch.setattr(identifiability_command, "profile_likelihood_task", twice)
    with pytest.raises(KeyboardInterrupt):
        run_identifiability(run, tmp_path / "run", options=asked, workers=InlineExecutor())
    assert len(list((tmp_path / "run.partial" / "tasks").glob("*.json"))) == 1
    monkeypatch.setattr(identifiability_command, "profile_likelihood_task", done)
    outcome = run_identifiability(run, tmp_path / "run", options=asked, workers=InlineExecutor())
    assert set(outcome.result["profiles"]) == {"spring_1.stiffness", "spring_2.stiffness"}
    assert not (tmp_path / "run.partial").exists()


def test_a_part_that_fails_is_said(repository, tmp_path, monkeypatch):
    def failing(name, **arguments):
        raise SolverError(f"no {name}", hint="mend it")

    failing.__module__, failing.__qualname__ = "yid_ocp.workflow.identifiability", "profiled"
    monkeypatch.setattr(identifiability_command, "profile_likelihood_task", failing)
    run = load_config(repository / "configs" / "springs_series_joint.yaml", QUICK)
    words = r"2 of 2 tasks failed, spring_1.stiffness with SolverError: no spring_1.stiffness(.|\n)*mend it"
    with pytest.raises(WorkerError, match=words):
        run_identifiability(
            run, tmp_path / "run", options=IdentifiabilityOptions(interval_parameters="all"), workers=InlineExecutor()
        )


def test_the_other_arm_of_a_robot(repository):
    run = load_config(repository / "configs" / "single_arm_vision.yaml")
    system = build_system(run)
    both = system_with_second_arm(run, system)
    assert both is not None
    assert both.driven[:7] == system.driven
    assert both.driven[7:] == tuple(name.replace("left_", "right_") for name in system.driven)
    assert [(grasp.name, grasp.holder_frame, grasp.held_frame) for grasp in both.grasps] == [
        ("left", "left_gripper", "w_T2"),
        ("right", "right_gripper", "w_T3"),
    ]
    assert system_with_second_arm(load_config(repository / "configs" / "dual_arm_vision.yaml"), both) is None
    moved = replace(run, model=replace(run.model, arms=replace(run.model.arms, mode="prescribed")))
    assert system_with_second_arm(moved, system) is None
