"""The paper's four experiments, solved by the symbolic program with a node at every step."""

from __future__ import annotations

import numpy as np
import pytest

from yid_ocp import load_problem
from yid_ocp.data import read_recording
from yid_ocp.integrator.step import compile_step
from yid_ocp.problem import EstimationProblem
from yid_ocp.solvers import GaussNewton, MultipleShooting, Status, solve

EXPERIMENTS = ("single_arm_no_vision", "single_arm_vision", "dual_arm_no_vision", "dual_arm_vision")
FREE = ("T1.bend", "T1.twist", "T2.bend", "T2.twist", "T3.bend", "T3.twist")


def agree(one, other, deviations):
    """On every parameter that the reference calls identifiable."""
    names = [name for name, entry in one.parameters.items() if entry.free and entry.verdict == "identifiable"]
    assert len(names) >= 2
    for name in names:
        reference = one.parameters[name]
        assert other.parameters[name].value == pytest.approx(reference.value, abs=deviations * reference.std), name


@pytest.mark.slow
@pytest.mark.parametrize("name", EXPERIMENTS)
def test_all_noise_has_one_optimum_as_covariance_and_as_unknowns(repository, name):
    """From 3 N m/rad, with 44 000 to 60 000 unknowns; errors of torques are unknowns here, a covariance there."""
    problem = load_problem(repository / "configs" / f"{name}.yaml")
    assert problem.has_process_noise
    single = solve(problem, GaussNewton())
    solution = solve(problem, MultipleShooting())
    assert solution.status == Status.CONVERGED, solution.message
    assert solution.cost == pytest.approx(single.cost, abs=1.5)
    agree(single, solution, 0.3)


@pytest.mark.slow
@pytest.mark.parametrize("name", EXPERIMENTS)
@pytest.mark.parametrize("hessian", ["gauss_newton", "exact"])
def test_exact_torques_have_one_optimum(paper_systems, clean, name, hessian):
    step = compile_step(paper_systems[name.partition("_")[0]], 0.01)
    problem = EstimationProblem(step, [read_recording(clean / f"{name}_estimate.h5")], FREE)
    single = solve(problem, GaussNewton())
    solution = solve(problem, MultipleShooting(hessian=hessian))
    assert solution.status == Status.CONVERGED, solution.message
    assert solution.cost == pytest.approx(single.cost, abs=0.05)
    agree(single, solution, 0.05)


@pytest.mark.slow
def test_two_thousand_steps_of_two_arms_are_solved_in_silence(paper_systems, clean, capfd):
    step = compile_step(paper_systems["dual"], 0.0025)
    problem = EstimationProblem(step, [read_recording(clean / "dual_arm_vision_estimate.h5")], FREE)
    assert problem.episodes[0].grid.steps == 2000
    solution = solve(problem, MultipleShooting(), restarts=False)
    assert solution.status == Status.CONVERGED, solution.message
    reference = solve(problem, GaussNewton(), initial_unknowns=solution.x, restarts=False)
    assert solution.cost == pytest.approx(reference.cost, abs=0.1)
    assert np.all(np.isfinite(solution.x))
    assert capfd.readouterr() == ("", "")
