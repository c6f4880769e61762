"""Held-out recordings that begin in motion: their start is found from their first moments alone."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from yid_ocp.data.recording import PointGroup, Recording
from yid_ocp.integrator.rollout import simulate
from yid_ocp.integrator.step import compile_step
from yid_ocp.model import System
from yid_ocp.model.kinematics import forward_kinematics
from yid_ocp.model.urdf import read_urdf
from yid_ocp.problem import EstimationProblem, ProblemOptions
from yid_ocp.problem.episodes import beginning

TIME_STEP, NOISE = 0.01, 1e-3


@pytest.fixture(scope="module")
def swinging(urdf_folder):
    tree = read_urdf(str(urdf_folder / "double_pendulum.urdf"))
    system = System.build(tree, damping={"shoulder": 0.1, "elbow": 0.1})
    step = compile_step(system, TIME_STEP, use_compiler=False)
    frames = list(system.mechanism.frames)[-2:]
    q = ca.SX.sym("q", system.size)
    kinematics = forward_kinematics(system.mechanism, q)
    place = ca.Function("place", [q], [ca.horzcat(*(kinematics.position(frame) for frame in frames))])

    def record(seed):
        rng = np.random.default_rng(seed)
        start = np.zeros(step.sizes["nx"])
        start[:2], start[2:4] = 0.05 * rng.standard_normal(2), 0.02 * rng.standard_normal(2)
        swept = simulate(step, system.parameters.vector(), start, 150)
        clean = np.stack([np.array(place(x[:2])).T for x in swept.state])
        position = clean + NOISE * rng.standard_normal(clean.shape)
        t = TIME_STEP * np.arange(151)
        group = PointGroup("points", tuple(frames), t, position, std=np.full(clean.shape, NOISE))
        return Recording(None, (group,), name=f"swing_{seed}")

    def problem(**options):
        return EstimationProblem(
            step, [record(1)], ("elbow.damping",), ProblemOptions(**options), held_out=[record(2), record(3)]
        )

    return problem


def misfit(problem):
    found = []
    for episode, result in problem.validate(problem.start):
        for samples, predicted in zip(episode.samples, result.predicted, strict=True):
            found.append(samples.weight * (predicted - samples.value))
    return float(np.mean(np.concatenate(found) ** 2))


def test_an_estimated_start_is_estimated_in_held_out_recordings_too(swinging):
    at_rest = misfit(swinging(initial_state="equilibrium"))
    estimated = misfit(swinging(initial_state="estimated", configuration_std=0.2, velocity_std=1.0))
    assert at_rest > 100
    assert estimated < 4


def test_only_the_first_moments_count(swinging):
    problem = swinging(initial_state="estimated", configuration_std=0.2, velocity_std=1.0)
    episode = problem.held_out[0]
    found = problem.held_out_offset(0, problem.start)
    assert np.any(found)
    moved = {}
    for first in (50, 5):
        value = episode.samples[0].value.copy()
        value[first:] += 1.0
        changed = replace(episode, samples=(replace(episode.samples[0], value=value),))
        moved[first] = problem.on(problem.episodes, [changed]).held_out_offset(0, problem.start)
    assert moved[50] == pytest.approx(found, abs=1e-12)
    assert moved[5] != pytest.approx(found, abs=1e-3)


def test_the_beginning_of_an_episode_holds_what_was_measured_in_it(swinging):
    episode = swinging().held_out[0]
    short = beginning(episode, 20)
    assert short.grid.steps == 20
    assert (short.samples[0].node + short.samples[0].fraction).max() <= 20
    assert len(short.samples[0].value) == 21
    assert short.samples[0].span == (0, 20)
