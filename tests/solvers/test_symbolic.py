"""An estimation problem as a program of CasADi: the same numbers as the rollout, the kernel's transcription and CasADi."""

from __future__ import annotations

import math
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from small_problems import PENDULUM, STEPS, pendulum_step, taken

import yid_ocp
from yid_ocp.errors import SolverError
from yid_ocp.problem import EstimationProblem, ProblemOptions, SensorOptions
from yid_ocp.solvers import GaussNewton, MultipleShooting, Status, solve
from yid_ocp.solvers.symbolic import transcribe, unknown_vector
from yid_ocp.solvers.transcription import Transcription

TRACKED = {"feedback": "proportional", "gains": (9.0,)}
SOFT = (("standard_linear_solid", "elbow", {}),)
GEARS = (("series_elasticity", "shoulder", {"stiffness": 300.0}),)
OFFSET = (("encoder_offset", "elbow", {"offset": 0.03}),)
CASES = {
    "free": ((), {}, {}),
    "internal": (SOFT, {}, {}),
    "robust": ((), {}, {"huber_threshold": 0.8}),
    "paper": ((), {}, {"weighting": "paper"}),
    "estimated": ((), {}, {"initial_state": "estimated"}),
    "local": ((), {}, {"local": ("elbow.stiffness",)}),
    "prior": ((), {}, {"priors": {"elbow.damping": 0.3}}),
    "known start": ((), {}, {"known_start": {"run_1": [0.1, 0.2, 0.01, 0.02], "run_2": [0.0, 0.3, 0.0, -0.01]}}),
    "prescribed": ((), {"prescribed": ("shoulder",)}, {}),
    "all prescribed": ((), {"prescribed": PENDULUM}, {}),
    "driven": ((), {"driven": ("shoulder",)}, {"feedback": "none"}),
    "driven, proportional": ((), {"driven": ("shoulder",)}, TRACKED),
    "driven, filtered": ((), {"driven": ("shoulder",)}, {"feedback": "lqr"}),
    "driven and prescribed": ((), {"driven": ("elbow",), "prescribed": ("shoulder",)}, TRACKED),
}


def problem_of(folder, case, seeds=(1, 2), **more):
    """The pendulum of a case and two recordings of it, efforts taken as true."""
    effects, how, options = CASES[case]
    step = pendulum_step(folder, effects, **how)
    springs = [f"{joint}.stiffness" for joint in PENDULUM if f"{joint}.stiffness" in step.system.parameters.names]
    names = ("elbow.damping", *springs, *(n for e in step.system.effects for n in e.parameters.names))
    recordings = [taken(step, seed) for seed in seeds]
    settings = ProblemOptions(path_cutoff=math.inf, **options | more)
    return EstimationProblem(step, recordings, names, settings).without_input_errors()


@pytest.fixture(scope="module", params=CASES)
def problem(request, urdf_folder):
    return problem_of(urdf_folder, request.param)


def rolled_out(problem, program, x):
    """The program's unknowns along the rollouts at an unknown vector."""
    w, evaluation = program.start.copy(), problem.evaluate(x)
    assert evaluation.ok, evaluation.message
    n = problem.step.sizes["n"]
    shared = len(problem.shared)
    w[program.variables["theta"].index.ravel()] = x[:shared]
    for i, (episode, result) in enumerate(zip(problem.episodes, evaluation.episodes, strict=True)):
        state = result.rollout.state
        own = x[problem.unknowns.columns(i)[shared:]]
        parts = {"q": state[:, :n].T, "p": state[:, n : 2 * n].T, "z": state[:, 2 * n :].T}
        parts |= {"lam": result.rollout.multipliers.T, "local": own[: len(problem.local), None]}
        if result.rest is not None:
            sought = list(problem.functions.statics.unknown)
            rest = (result.rest.state[sought], result.rest.state[2 * n :], result.rest.constraint_force)
            parts["rest"] = np.concatenate(rest)[:, None]
        for name, values in parts.items():
            if values.size:
                w[program.variables[f"{name}[{episode.name}]"].index] = values
    return w, evaluation


def beside(problem):
    x = problem.start
    return x * (1 + 0.2 * np.sin(1 + np.arange(len(x)))) + 0.003 * np.cos(np.arange(len(x)))


def values_at(program, w, *expressions):
    found = ca.Function("f", [program.w, program.p], [ca.densify(e) for e in expressions]).call([w, program.values])
    return [np.array(value) for value in found]


def test_along_a_rollout_it_has_the_problems_cost_residual_and_no_defects(problem):
    x = beside(problem)
    program = transcribe(problem)
    w, evaluation = rolled_out(problem, program, x)
    cost, defects, residual = values_at(program, w, program.f, program.g, program.residual)
    assert cost.item() == pytest.approx(evaluation.cost, rel=1e-9)
    assert np.abs(defects).max() < 1e-7
    if math.isinf(problem.options.huber_threshold):
        np.testing.assert_allclose(np.sort(residual.ravel()), np.sort(evaluation.residual), rtol=0, atol=1e-8)
    np.testing.assert_allclose(unknown_vector(problem, program, w), x, rtol=0, atol=1e-9)


def test_its_reduced_gradient_is_the_problems(problem):
    """dcost/dx when the equations eliminate the states, by their multipliers."""
    x = beside(problem)
    program = transcribe(problem)
    w, _ = rolled_out(problem, program, x)
    gradient, jacobian = values_at(program, w, program.grad_f, program.jac_g)
    own = [program.variables["theta"].index.ravel()] if problem.shared else []
    rows, n = list(problem.predictor.start_rows), problem.step.sizes["n"]
    for episode in problem.episodes:
        if problem.local:
            own.append(program.variables[f"local[{episode.name}]"].index.ravel())
        if rows:
            first = np.concatenate([program.variables[f"{part}[{episode.name}]"].index[:, 0] for part in "qp"])
            own.append(first[rows])
    own = np.concatenate(own)
    others = np.setdiff1d(np.flatnonzero(program.lower < program.upper), own)
    assert len(others) == len(jacobian), "as many equations as unknowns that they fix"
    pull = np.linalg.solve(jacobian[:, others].T, gradient[others, 0])
    found = gradient[own, 0] - jacobian[:, own].T @ pull
    expected = problem.gradient(x)[1]
    if rows:
        # the program holds the first state where the problem holds its offset from rest, which moves with theta
        begin = [
            problem.start_state(e, problem.split(x, i)[0]).by_unknowns[rows] for i, e in enumerate(problem.episodes)
        ]
        count = len(problem.shared)
        for i, by in enumerate(begin):
            at = problem.unknowns.columns(i)[len(problem.unknowns.parameters) :]
            expected[:count] -= by[:, :count].T @ expected[at]
        assert n > 0
    np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-7 * np.abs(expected).max())
