"""All methods reach the same optimum of the same problem, near the truth of the other engine."""

import itertools
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from small_problems import pendulum_step, taken

from yid_ocp import load_problem
from yid_ocp.data import read_recording
from yid_ocp.errors import SolverError
from yid_ocp.integrator.step import compile_step, compile_step_like
from yid_ocp.model import Parameters, System
from yid_ocp.model.objects.foam_y import foam_y_object
from yid_ocp.model.urdf import read_urdf
from yid_ocp.problem import EstimationProblem, ProblemOptions
from yid_ocp.solvers import GaussNewton, MultipleShooting, SingleShooting, Status, SteepestDescent, fit_problem
from yid_ocp.solvers.symbolic_transcription import transcribe

FREE = ("T1.bend", "T1.twist", "T2.bend", "T2.twist", "T3.bend", "T3.twist")
SEEN = ("T1.bend", "T1.twist", "T2.bend")


@pytest.fixture(scope="module")
def pendulum(urdf_folder):
    """Two links that swing freely, for what does not depend on the mechanism."""
    step = pendulum_step(urdf_folder)
    return EstimationProblem(step, [taken(step, 1)], ("elbow.damping", "elbow.stiffness"))


@pytest.fixture(scope="module")
def short(make_problem):
    """The first second, three parameters that it determines."""
    return make_problem(free=SEEN, duration=1.0)


@pytest.fixture(scope="module")
def reference(short):
    """The solution by Gauss-Newton, whose iterates fall and are told."""
    told = []
    solution = fit_problem(short, GaussNewton(), callback=told.append)
    costs = [entry.cost for entry in solution.history]
    assert told == list(solution.history)
    assert all(after <= before * (1 + 1e-12) for before, after in itertools.pairwise(costs))
    assert solution.cost == pytest.approx(costs[-1], rel=1e-9)
    return solution


CONDENSED = MultipleShooting(condensing=True)


def within(solution, reference, deviations=0.1):
    return np.all(np.abs(solution.x - reference.x) <= deviations * np.sqrt(np.diag(reference.covariance)))


OTHERS = [(SingleShooting(), 1e-5), (CONDENSED, 1e-3), (MultipleShooting(condensing=True, node_interval=10), 1e-3)]


@pytest.mark.parametrize(("solver", "rtol"), OTHERS, ids=["single shooting", "every 20 steps", "every 10 steps"])
def test_other_methods_agree(short, reference, solver, rtol):
    solution = fit_problem(short, solver)
    assert solution.status == Status.CONVERGED, solution.message
    assert within(solution, reference)
    assert solution.cost == pytest.approx(reference.cost, rel=rtol)


def test_gauss_newton_recovers_the_truth_of_another_engine(make_problem, recording):
    solution = fit_problem(make_problem(), GaussNewton())
    assert solution.status == Status.CONVERGED
    assert 0.9 < solution.goodness_of_fit.chi2_per_dof < 1.2
    for name, entry in solution.parameters.items():
        if entry.free and entry.verdict == "identifiable":
            true = recording.true_parameters[name]
            assert abs(entry.value - true) < max(0.05 * true, 3 * entry.std), name
    verdicts = {name: entry.verdict for name, entry in solution.parameters.items() if entry.free}
    assert verdicts["T1.bend"] == verdicts["T2.bend"] == "identifiable"
    assert verdicts["T2.twist"] == verdicts["T3.twist"] == "not_identifiable"


def test_multiple_shooting_with_a_node_at_every_step_agrees(paper_systems, recording):
    """Of an arm with tubes of one link each: 16 coordinates in place of 43."""
    arm = paper_systems["single"]
    robot, objects = read_urdf("package:baxter", joints=arm.driven), [(foam_y_object(links=1), None, None)]
    system = System.build(robot, objects=objects, grasps=arm.grasps, driven=arm.driven, damping=0.05)
    step, options = compile_step(system, 0.01), ProblemOptions(duration=0.5)
    problem = EstimationProblem(step, [recording], ("T1.bend", "T2.bend"), options)
    single, solution = (fit_problem(problem, solver) for solver in (GaussNewton(), MultipleShooting()))
    assert solution.status == Status.CONVERGED, solution.message
    assert within(solution, single, 0.01)
    assert solution.cost == pytest.approx(single.cost, rel=1e-6)


@pytest.fixture(scope="module")
def two_arms(paper_systems, clean):
    """50 variables, 200 steps, six parameters from 3 N m/rad; two of the twists leave no trace in the data."""
    step = compile_step(paper_systems["dual"], 0.01)
    recording = read_recording(clean / "dual_arm_vision_estimate.h5")
    return EstimationProblem(step, [recording], FREE, ProblemOptions(duration=2.0))


@pytest.mark.slow
def test_equilibria_of_nodes_far_apart_keep_the_shape_of_a_soft_object(two_arms):
    whole = EstimationProblem(two_arms.step, [two_arms.episodes[0].recording], FREE)
    solution = fit_problem(whole, CONDENSED, restarts=False)
    assert solution.status == Status.CONVERGED, solution.message


@pytest.mark.slow
@pytest.mark.parametrize(
    "solver",
    [CONDENSED, MultipleShooting(condensing=True, node_interval=10), MultipleShooting()],
    ids=["node every 20 steps", "node every 10 steps", "node every step"],
)
def test_fifty_variables_from_far_away(two_arms, solver):
    """One start is enough, and weakly informed parameters do not keep the methods busy."""
    single = fit_problem(two_arms, GaussNewton())
    solution = fit_problem(two_arms, solver)
    assert solution.status == Status.CONVERGED, solution.message
    assert "starts" not in solution.message
    assert solution.n_iterations <= 40
    assert solution.cost == pytest.approx(single.cost, abs=0.2)
    found = [name for name, entry in single.parameters.items() if entry.verdict == "identifiable"]
    assert found == ["T1.bend", "T1.twist", "T2.bend", "T3.bend"]
    for name in found:
        reference = single.parameters[name]
        assert solution.parameters[name].value == pytest.approx(reference.value, abs=0.1 * reference.std), name


def test_steepest_descent_lowers_the_papers_cost_and_with_a_memory_returns_the_best_point(make_problem):
    problem = make_problem(free=("T1.bend", "T2.bend"), duration=2.0, weighting="paper")
    solution = fit_problem(problem, SteepestDescent(max_iterations=60, first_trial_step_rule="spectral"))
    assert solution.history[-1].cost < 0.05 * solution.history[0].cost
    assert solution.parameters["T1.bend"].value == pytest.approx(22.0, rel=0.05)
    patient = SteepestDescent(first_trial_step_rule="spectral", nonmonotone_memory=10, gradient_tolerance=1e-4)
    solution = fit_problem(problem, patient)
    costs = [entry.cost for entry in solution.history]
    assert solution.status == Status.CONVERGED
    assert any(after > before for before, after in itertools.pairwise(costs))
    assert solution.cost == pytest.approx(min(costs), rel=1e-12)
    assert solution.x == pytest.approx(fit_problem(problem, GaussNewton(cost_tolerance=1e-12)).x, rel=1e-3)


def test_estimated_start_gives_the_same_optimum_in_both_formulations(make_problem):
    problem = make_problem(free=("T1.bend", "T2.bend"), duration=0.6, initial_state="estimated")
    single = fit_problem(problem, GaussNewton())
    multiple = fit_problem(problem, CONDENSED)
    spread = np.sqrt(np.diag(single.covariance))[:2]
    assert np.all(np.abs(single.x[:2] - multiple.x[:2]) <= 0.2 * spread)


def test_bounds_are_respected(one_arm, recording, make_problem):
    problem = make_problem(free=("T1.bend", "T2.bend"), duration=0.5)
    system = problem.system
    entries = Parameters(replace(p, upper=15.0) if p.name == "T1.bend" else p for p in system.parameters)
    step = compile_step_like(problem.step, replace(system, parameters=entries))
    problem = EstimationProblem(step, [recording], problem.free, problem.options)
    for solver in (GaussNewton(), SingleShooting(), CONDENSED):
        solution = fit_problem(problem, solver)
        assert solution.x[0] <= 15.0 + 1e-9, solver.name
        assert solution.x[0] == pytest.approx(15.0, abs=1e-2), solver.name


def test_open_loop_is_for_multiple_shooting(make_problem):
    """Without feedback the arm leaves the measured motion; a second of it can be rolled out, three cannot."""
    problem = make_problem(free=("T1.bend", "T2.bend"), arm_tracking_feedback="none", duration=1.0)
    single = GaussNewton(max_iterations=15).minimize_cost(problem, problem.initial_unknowns, None)
    nodes = CONDENSED.minimize_cost(problem, problem.initial_unknowns, None)
    assert nodes.status == Status.CONVERGED, nodes.message
    assert nodes.history[-1].cost == pytest.approx(single.history[-1].cost, rel=1e-3)
    assert nodes.x == pytest.approx([22.0, 10.7], rel=0.1)
    longer = make_problem(free=("T1.bend", "T2.bend"), arm_tracking_feedback="none", duration=3.0)
    assert not longer.evaluate(longer.initial_unknowns, derivatives=False).ok


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"hessian": "bfgs"}, "there is no Hessian 'bfgs'"),
        ({"ipopt_options": {"hessian_approximation": "limited-memory"}}, "limited-memory"),
        ({"node_interval": 10}, "node_interval is 10, but must be 1 without condensing"),
        ({"condensing": True, "node_interval": 1000}, "the node interval is 1000 steps"),
    ],
)
def test_settings_that_do_not_fit_are_refused_with_a_reason(pendulum, settings, said):
    with pytest.raises(SolverError, match=said):
        MultipleShooting(**settings).minimize_cost(pendulum, pendulum.initial_unknowns, None)


def test_iteration_limit_is_a_status_with_the_best_point(make_problem, pendulum):
    arm = make_problem(free=SEEN, duration=0.4)
    few = [(arm, GaussNewton(max_iterations=1)), (arm, MultipleShooting(condensing=True, max_iterations=2))]
    few += [(pendulum, MultipleShooting(max_iterations=2, ipopt_options={"acceptable_iter": 0}))]
    for problem, solver in few:
        solution = fit_problem(problem, solver)
        assert solution.status == Status.ITERATION_LIMIT
        assert np.all(np.isfinite(solution.x))
        assert "Set solver.max_iterations: 200" in solution.message


def test_more_memory_than_there_is_ends_with_a_status(pendulum, monkeypatch, caplog):
    monkeypatch.setattr("yid_ocp.solvers.nonlinear_program.available_memory_bytes", lambda: 1e4)
    with caplog.at_level("INFO"):
        found = MultipleShooting().minimize_cost(pendulum, pendulum.initial_unknowns, None)
    assert found.status == Status.FAILED
    assert found.x == pytest.approx(pendulum.initial_unknowns)
    assert "of memory, but only 1e-05 GB are free" in found.message
    assert "IPOPT on 104 unknowns, 102 equations" in caplog.text


def test_a_program_that_ipopt_cannot_begin_is_a_status_and_silent(pendulum, monkeypatch, capfd):
    def lost(*arguments):
        program = transcribe(*arguments)
        return program.with_user_terms(ca.log(program["theta"][0] - 100.0))

    monkeypatch.setattr("yid_ocp.solvers.symbolic_transcription.transcribe", lost)
    found = MultipleShooting(max_iterations=3).minimize_cost(pendulum, pendulum.initial_unknowns, None)
    assert found.status in (Status.STALLED, Status.FAILED)
    assert "IPOPT found no minimum (Invalid_Number_Detected)" in found.message
    assert np.all(np.isfinite(found.x))
    assert capfd.readouterr() == ("", "")


EXPERIMENTS = ("single_arm_no_vision", "single_arm_vision", "dual_arm_no_vision", "dual_arm_vision")


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
    single = fit_problem(problem, GaussNewton())
    solution = fit_problem(problem, MultipleShooting())
    assert solution.status == Status.CONVERGED, solution.message
    assert solution.cost == pytest.approx(single.cost, abs=1.5)
    agree(single, solution, 0.3)


@pytest.mark.slow
@pytest.mark.parametrize("name", EXPERIMENTS)
@pytest.mark.parametrize("hessian", ["gauss_newton", "exact"])
def test_exact_torques_have_one_optimum(paper_systems, clean, name, hessian):
    step = compile_step(paper_systems[name.partition("_")[0]], 0.01)
    problem = EstimationProblem(step, [read_recording(clean / f"{name}_estimate.h5")], FREE)
    single = fit_problem(problem, GaussNewton())
    solution = fit_problem(problem, MultipleShooting(hessian=hessian))
    assert solution.status == Status.CONVERGED, solution.message
    assert solution.cost == pytest.approx(single.cost, abs=0.05)
    agree(single, solution, 0.05)


@pytest.mark.slow
def test_two_thousand_steps_of_two_arms_are_solved_in_silence(paper_systems, clean, capfd):
    step = compile_step(paper_systems["dual"], 0.0025)
    problem = EstimationProblem(step, [read_recording(clean / "dual_arm_vision_estimate.h5")], FREE)
    assert problem.episodes[0].grid.steps == 2000
    solution = fit_problem(problem, MultipleShooting(), restarts=False)
    assert solution.status == Status.CONVERGED, solution.message
    reference = fit_problem(problem, GaussNewton(), initial_unknowns=solution.x, restarts=False)
    assert solution.cost == pytest.approx(reference.cost, abs=0.1)
    assert np.all(np.isfinite(solution.x))
    assert capfd.readouterr() == ("", "")
