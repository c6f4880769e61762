"""What only a fit shows of its recordings: two springs in series, from statics in closed form."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from yid_ocp.analysis.clock_checks import check_fit_residuals
from yid_ocp.config.reader import load_config
from yid_ocp.problem import EstimationProblem, SensorOptions
from yid_ocp.solvers import solve
from yid_ocp.workflow.build_problem import build_problem


@pytest.fixture(scope="module")
def springs(repository):
    run = load_config(repository / "configs" / "springs_series_joint.yaml", ["problem.use_compiler=false"])
    return run, build_problem(run)


def doubts(springs, late=0.0, drift=0.0, std=None):
    """Doubts after a fit of the recording on another clock, or with another noise in the settings."""
    run, problem = springs
    recording = problem.episodes[0].recording
    group = recording.points[0]
    moved = replace(group, t=group.t + late + drift * (group.t - group.t.mean()))
    inside = (moved.t >= recording.joints.t[0]) & (moved.t <= recording.joints.t[-1])
    moved = replace(moved, t=moved.t[inside], position=moved.position[inside], std=group.std[inside])
    options = problem.options
    if std is not None:
        own = replace(options.sensors.get(group.name, SensorOptions()), std=std)
        options = replace(options, sensors={**options.sensors, group.name: own})
    made = EstimationProblem(problem.step, [replace(recording, points=(moved,))], problem.free, options)
    solution = solve(made, run.solver)
    return check_fit_residuals(solution.problem or made, solution.x, solution.evaluation)


def test_a_fit_of_a_sound_recording_raises_nothing(springs):
    assert doubts(springs) == []


def test_a_clock_that_runs_apart_is_told_by_what_the_fit_leaves(springs):
    (doubt,) = doubts(springs, drift=0.01)
    assert (doubt.cause, doubt.weight, doubt.group) == ("clock_drift", "not_trusted", "points_camera")
    told, std = map(float, re.search(r"runs ([\d.]+) ± ([\d.]+) parts per thousand too fast", doubt.what).groups())
    assert told == pytest.approx(10.0, abs=4 * std + 0.5)


def test_a_clock_that_is_late_is_left_to_a_diagnosis(springs):
    assert "clock_drift" not in {doubt.cause for doubt in doubts(springs, late=0.1)}


def test_noise_that_settings_state_ten_times_too_large(springs):
    (doubt,) = doubts(springs, std=1e-2)
    assert (doubt.cause, doubt.weight) == ("noise_overstated", "warning")
    name, value = doubt.setting.split(": ")
    assert name == "sensors.points_camera.std"
    assert float(value) == pytest.approx(1e-3, rel=0.15)
    assert np.isclose(doubt.evidence, 1e-2 / (5 * float(value)), rtol=0.05)
