"""Held-out recordings that begin in motion: their start is found from their first moments alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small_problems import swinging_pendulum

from yid_ocp.problem import EstimationProblem, ProblemOptions
from yid_ocp.problem.episodes import truncate_episode

NOISE = 1e-3


@pytest.fixture(scope="module")
def swinging(urdf_folder):
    step, record = swinging_pendulum(urdf_folder)
    first, *others = (record(seed, 150, bend=0.05, noise=NOISE) for seed in (1, 2, 3))

    def problem(**options):
        return EstimationProblem(step, [first], ("elbow.damping",), ProblemOptions(**options), held_out=others)

    return problem


def misfit(problem):
    found = []
    for episode, result in problem.predict_held_out(problem.initial_unknowns):
        for samples, predicted in zip(episode.measurements, result.predicted_outputs, strict=True):
            found.append(samples.weight * (predicted - samples.value))
    return float(np.mean(np.concatenate(found) ** 2))


def test_an_estimated_start_is_estimated_in_held_out_recordings_too(swinging):
    at_rest = misfit(swinging(initial_state="equilibrium"))
    estimated = misfit(swinging(initial_state="estimated", start_configuration_std=0.2, start_velocity_std=1.0))
    assert at_rest > 100
    assert estimated < 4


def test_only_the_first_moments_count(swinging):
    problem = swinging(initial_state="estimated", start_configuration_std=0.2, start_velocity_std=1.0)
    episode = problem.held_out[0]
    found = problem.held_out_prediction_inputs(problem.initial_unknowns)[0][2]
    assert np.any(found)
    moved = {}
    for first in (50, 5):
        value = episode.measurements[0].value.copy()
        value[first:] += 1.0
        changed = replace(episode, measurements=(replace(episode.measurements[0], value=value),))
        moved[first] = problem.with_episodes(problem.episodes, [changed]).held_out_prediction_inputs(
            problem.initial_unknowns
        )[0][2]
    assert moved[50] == pytest.approx(found, abs=1e-12)
    assert moved[5] != pytest.approx(found, abs=1e-3)


def test_the_beginning_of_an_episode_holds_what_was_measured_in_it(swinging):
    episode = swinging().held_out[0]
    short = truncate_episode(episode, 20)
    assert short.grid.steps == 20
    assert (short.measurements[0].node + short.measurements[0].fraction).max() <= 20
    assert len(short.measurements[0].value) == 21
    assert short.measurements[0].predictable_nodes == (0, 20)
