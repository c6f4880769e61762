"""An estimation problem as a program of CasADi: the numbers of the rollout and of the kernel's transcription."""

import math
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from small_problems import PENDULUM, STEPS, TRACKED, pendulum_step, taken

from yid_ocp.errors import SolverError
from yid_ocp.inference.whitening import (
    problem_with_exact_inputs,
    problem_with_sensor_noise_only,
    problem_with_whitening_at,
)
from yid_ocp.problem import EstimationProblem, ProblemOptions, SensorOptions
from yid_ocp.solvers import GaussNewton, MultipleShooting, Status, fit_problem
from yid_ocp.solvers.nonlinear_program import (
    GaussNewtonHessianRidge,
    LocalVariableFunction,
    MappedFunctionTerm,
    NonlinearProgram,
    ResidualTerm,
    _VectorBlock,
)
from yid_ocp.solvers.symbolic_transcription import problem_unknowns_from_program, transcribe

CASES = {
    "free": ((), {}, {}),
    "robust": ((), {}, {"huber_threshold": 0.8}),
    "paper": ((), {}, {"weighting": "paper"}),
    "estimated": ((), {}, {"initial_state": "estimated"}),
    "local": ((), {}, {"local_parameters": ("elbow.stiffness",)}),
    "prior": ((), {}, {"prior_stds": {"elbow.damping": 0.3}}),
    "known start": ((), {}, {"known_initial_states": {"run_1": [0.1, 0.2, 0.01, 0.02], "run_2": [0, 0.3, 0, -0.01]}}),
    "prescribed": ((), {"prescribed": ("shoulder",)}, {}),
    "all prescribed": ((), {"prescribed": PENDULUM}, {}),
    "driven": ((), {"driven": ("shoulder",)}, {"arm_tracking_feedback": "none"}),
    "driven, proportional": ((), {"driven": ("shoulder",)}, TRACKED),
    "driven, filtered": ((), {"driven": ("shoulder",)}, {"arm_tracking_feedback": "lqr"}),
    "driven and prescribed": ((), {"driven": ("elbow",), "prescribed": ("shoulder",)}, TRACKED),
    "remembering": ((("joint_presliding", "elbow", {"tau_c": 0.3, "yield_angle": 0.02}),), {}, {}),
}


def problem_of(folder, case, seeds=(1, 2), **more):
    """The pendulum of a case and two recordings of it, efforts taken as true."""
    effects, how, options = CASES[case]
    step = pendulum_step(folder, effects, **how)
    springs = [f"{joint}.stiffness" for joint in PENDULUM if f"{joint}.stiffness" in step.system.parameters.names]
    names = ("elbow.damping", *springs, *(n for e in step.system.effects for n in e.parameters.names))
    recordings = [taken(step, seed) for seed in seeds]
    settings = ProblemOptions(path_cutoff=math.inf, **options | more)
    return problem_with_exact_inputs(EstimationProblem(step, recordings, names, settings))


@pytest.fixture(scope="module", params=CASES)
def problem(request, urdf_folder):
    return problem_of(urdf_folder, request.param)


def rolled_out(problem, program, x):
    """The program's unknowns along the rollouts at an unknown vector."""
    w, evaluation = program.initial_guess.copy(), problem.evaluate(x)
    assert evaluation.ok, evaluation.message
    n = problem.step.sizes["n"]
    shared = len(problem.shared_parameters)
    w[program.variables["theta"].index.ravel()] = x[:shared]
    for i, (episode, result) in enumerate(zip(problem.episodes, evaluation.episode_predictions, strict=True)):
        state = result.rollout.state
        own = x[problem.unknowns.unknown_indices_affecting_recording(i)[shared:]]
        parts = {"q": state[:, :n].T, "p": state[:, n : 2 * n].T, "z": state[:, 2 * n :].T}
        parts |= {"lam": result.rollout.multipliers.T, "local": own[: len(problem.local_parameters), None]}
        if result.equilibrium is not None:
            sought = list(problem.model_functions.equilibrium_solver.free_coordinates)
            rest = result.equilibrium
            rest = (rest.state[sought], rest.state[2 * n :], rest.constraint_reactions)
            parts["rest"] = np.concatenate(rest)[:, None]
        for name, values in parts.items():
            if values.size:
                w[program.variables[f"{name}[{episode.name}]"].index] = values
    return w, evaluation


def beside(problem):
    x = problem.initial_unknowns
    return x * (1 + 0.2 * np.sin(1 + np.arange(len(x)))) + 0.003 * np.cos(np.arange(len(x)))


def values_at(program, w, *expressions):
    function = ca.Function("f", [program.w, program.p], [ca.densify(e) for e in expressions])
    return [np.array(value) for value in function.call([w, program.parameter_values])]


def test_along_a_rollout_it_has_the_problems_cost_residual_and_no_defects(problem):
    x = beside(problem)
    program = transcribe(problem)
    w, evaluation = rolled_out(problem, program, x)
    cost, defects, residual = values_at(program, w, program.f, program.g, program.residual)
    assert cost.item() == pytest.approx(evaluation.cost, rel=1e-9)
    assert np.abs(defects).max() < 1e-7
    if math.isinf(problem.options.huber_threshold):
        np.testing.assert_allclose(np.sort(residual.ravel()), np.sort(evaluation.residual), rtol=0, atol=1e-8)
    np.testing.assert_allclose(problem_unknowns_from_program(problem, program, w), x, rtol=0, atol=1e-9)


def test_its_reduced_gradient_is_the_problems(problem):
    """dcost/dx when the equations eliminate the states, by their multipliers."""
    x = beside(problem)
    program = transcribe(problem)
    w, _ = rolled_out(problem, program, x)
    gradient, jacobian = values_at(program, w, program.grad_f, program.jac_g)
    own = [program.variables["theta"].index.ravel()] if problem.shared_parameters else []
    rows = list(problem.predictor.estimated_initial_state_indices)
    for episode in problem.episodes:
        if problem.local_parameters:
            own.append(program.variables[f"local[{episode.name}]"].index.ravel())
        if rows:
            parts = [f"{part}[{episode.name}]" for part in ("qpz" if problem.step.sizes["nz"] else "qp")]
            first = np.concatenate([program.variables[part].index[:, 0] for part in parts])
            own.append(first[rows])
    own = np.concatenate(own)
    others = np.setdiff1d(np.flatnonzero(program.lower < program.upper), own)
    assert len(others) == len(jacobian), "as many equations as unknowns that they fix"
    pull = np.linalg.solve(jacobian[:, others].T, gradient[others, 0])
    found = gradient[own, 0] - jacobian[:, own].T @ pull
    expected = problem.cost_and_gradient(x)[1]
    if rows:
        # the program holds the first state where the problem holds its offset from rest, which moves with theta
        count = len(problem.shared_parameters)
        for i, episode in enumerate(problem.episodes):
            by = problem.predictor.initial_state_and_derivative(
                episode, problem.unpack_episode_unknowns(x, i)[0]
            ).state_sensitivity[rows]
            at = problem.unknowns.unknown_indices_affecting_recording(i)[len(problem.unknowns.free_parameter_names) :]
            expected[:count] -= by[:, :count].T @ expected[at]
    np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-7 * np.abs(expected).max())


def test_the_program_and_condensing_have_one_solution(urdf_folder):
    """Of sensor noise alone, which is what condensing knows; the Hessian changes the way, not the end."""
    problem = problem_with_exact_inputs(problem_of(urdf_folder, "driven, proportional", seeds=(1,)))
    tight = {"tol": 1e-12, "acceptable_iter": 0, "mu_init": 1e-12, "mu_target": 1e-15}
    condensed = MultipleShooting(condensing=True, node_interval=5, cost_tolerance=1e-12, step_tolerance=1e-10)
    solvers = (condensed, MultipleShooting(ipopt_options=tight), MultipleShooting(hessian="exact", ipopt_options=tight))
    found = [one.minimize_cost(problem, problem.initial_unknowns, None) for one in solvers]
    assert [one.status for one in found] == [Status.CONVERGED] * 3, [one.message for one in found]
    std = np.sqrt(np.diag(fit_problem(problem, GaussNewton(), initial_unknowns=found[0].x, restarts=False).covariance))
    for one in found[1:]:
        assert np.all(np.abs(one.x - found[0].x) <= 1e-5 * np.maximum(std, np.abs(one.x)))
        assert one.history[-1].cost == pytest.approx(found[0].history[-1].cost, rel=1e-9)
        assert one.history[0].note == "start"
    assert len(found[2].history) <= len(found[1].history)


@pytest.mark.parametrize("case", ["local", "estimated", "known start", "driven, filtered", "all prescribed"])
def test_it_solves_what_gauss_newton_solves(urdf_folder, case):
    """Efforts of prescribed joints, which depend on whole steps, need no elimination here."""
    problem = problem_of(urdf_folder, case)
    solution = fit_problem(
        problem, MultipleShooting(hessian="exact", ipopt_options={"acceptable_iter": 0}), restarts=False
    )
    assert solution.status == Status.CONVERGED, solution.message
    single = fit_problem(problem, GaussNewton(cost_tolerance=1e-12), initial_unknowns=solution.x, restarts=False)
    assert single.cost == pytest.approx(solution.cost, rel=1e-7)
    # one parameter alone hardly matters where all is prescribed
    assert (
        solution.cost < (0.998 if case == "all prescribed" else 0.97) * problem.evaluate(problem.initial_unknowns).cost
    )


def test_what_it_does_not_do_is_refused(urdf_folder):
    step = pendulum_step(urdf_folder, (("camera_latency", "camera", {"delay": 0.0137}),))
    with pytest.raises(SolverError, match="an effect that changes recorded inputs, times"):
        transcribe(EstimationProblem(step, [taken(step, 1)], ("elbow.damping",)))


def test_blocks_are_named_after_what_they_hold(urdf_folder):
    problem = problem_of(urdf_folder, "driven, proportional")
    program = transcribe(problem)
    with pytest.raises(SolverError, match=r"'q' names [0-9] blocks"):
        program["q"]
    assert program["q[run_2]"].shape == (2, STEPS + 1)
    assert program["torque[run_1]"].shape == (1, STEPS)
    names = program.variable_names()
    assert len(set(names)) == len(names) == program.w.numel()
    assert names[0] == "theta.elbow.damping"
    assert "q[run_2].elbow.3" in names
    rows = program.constraint_names()
    assert len(set(rows)) == len(rows) == program.g.numel()
    assert "step[run_1].del[shoulder].7" in rows
    given = values_at(program, program.initial_guess, program["torque[run_1]"])[0]
    np.testing.assert_array_equal(given, problem.episodes[0].torque.T)
    np.testing.assert_array_equal(program.solver_arguments["x0"], program.initial_guess)


@pytest.mark.parametrize("encoders", [False, True])
@pytest.mark.parametrize(
    "feedback",
    [TRACKED, {"arm_tracking_feedback": "lqr"}, {"arm_tracking_feedback": "none"}],
    ids=["angles", "momenta_too", "none"],
)
def test_errors_as_unknowns_have_the_likelihood_of_innovations(urdf_folder, encoders, feedback):
    """At fixed parameters, with errors so small that everything is linear, the best errors cost what innovations do."""
    step = pendulum_step(urdf_folder, driven=("shoulder",))
    made, size = taken(step, 3), 1e-5
    group = replace(made.joints, effort_std=0.3 * size, effort_bias_std=0.2 * size, position_std=2e-3 * size)
    # two steps a sample
    group = replace(group, t=group.t[::2], position=group.position[::2], effort=group.effort[::2])
    points = tuple(g for g in made.points if not encoders or g.name == "points_camera")
    options = ProblemOptions(sensors={"joints.position": SensorOptions(use=encoders)}, **feedback)
    first = EstimationProblem(step, [replace(made, joints=group, points=points)], ("elbow.damping",), options)
    x, rng = first.initial_unknowns, np.random.default_rng(5)
    episode, errors = first.episodes[0], first.episodes[0].input_errors
    # measured is what an open loop does, which is then what the tracking filter follows, and some noise of all kinds
    plain = first.with_episodes([replace(episode, tracking_feedback=None)], ()).evaluate(x).episode_predictions[0]
    if episode.tracking_feedback is not None:
        reference = plain.rollout.state[:-1, episode.tracking_feedback.state_indices]
        episode = replace(episode, tracking_feedback=replace(episode.tracking_feedback, reference=reference))
    samples = []
    for s, y in zip(episode.measurements, plain.predicted_outputs, strict=True):
        weight = np.where(s.positive_weight_mask, 1e4 / size, 0.0)
        samples.append(replace(s, value=y + size * 1e-4 * rng.standard_normal(y.shape), weight=weight))
    white = rng.standard_normal(len(np.unique(errors.sample_of_step)))
    wrong = errors.torque_std * white[errors.sample_of_step][:, None]
    torque = episode.torque + wrong + 1.5 * errors.torque_bias_std
    episode = replace(episode, measurements=tuple(samples), torque=torque)
    problem = first.with_episodes([episode], ())
    expected = problem_with_whitening_at(problem, x).evaluate(x).cost
    assert problem_with_sensor_noise_only(problem).evaluate(x).cost > 3 * expected
    program = transcribe(problem)
    arguments = program.solver_arguments
    theta = program.find_vector_block("theta").index.ravel()
    arguments["lbx"][theta] = arguments["ubx"][theta] = x
    solver = program.make_solver("ipopt", "exact", ipopt={"print_level": 0, "sb": "yes", "tol": 1e-9, "max_iter": 50})
    found = solver(**arguments)
    assert solver.stats()["success"], solver.stats()["return_status"]
    # beside encoders no torque is taken as better than a thousandth: errors are then not small enough to be linear;
    # where momenta are followed, the noise of the step before is taken for this step's
    exact = not encoders and feedback["arm_tracking_feedback"] != "lqr"
    assert float(found["f"]) == pytest.approx(expected, rel=1e-4 if exact else 4e-3)
    assert ("angle_error[run_3]" in program.variables) is (not encoders and feedback["arm_tracking_feedback"] != "none")
    assert program.find_vector_block("torque_error").index.shape == (1, len(np.unique(errors.sample_of_step)))


def test_a_fit_among_noise_is_judged_by_its_likelihood(urdf_folder):
    step = pendulum_step(urdf_folder, driven=("shoulder",))
    problem = EstimationProblem(step, [taken(step, 1)], ("elbow.damping", "elbow.stiffness"), ProblemOptions(**TRACKED))
    assert problem.has_process_noise
    single = fit_problem(problem, GaussNewton(cost_tolerance=1e-10), restarts=False)
    solution = fit_problem(problem, MultipleShooting(), restarts=False)
    left_out = fit_problem(problem, MultipleShooting(condensing=True), restarts=False)
    assert "ignore noise of the torques" not in solution.message
    assert "ignore noise of the torques" in left_out.message
    assert solution.cost == pytest.approx(single.cost, rel=0.02)
    assert left_out.problem.whitening_filters == (None,)
    assert solution.problem.whitening_filters != (None,)


# a chain of COUNT places: x_0, y_0, x_1, y_1, ... x_COUNT, with one shared unknown in front
COUNT = 5
SIZE = 2 + 2 * COUNT


def chain(use_compiler=False, threshold=math.inf, ridge=None):
    """x_{k+1} = x_k + d_k sin(y_k) a s, residuals of x between the places and of y itself."""
    v, d, s = ca.SX.sym("v", 4), ca.SX.sym("d", 1), ca.SX.sym("s", 1)
    motion = LocalVariableFunction(
        "motion", [v, d, s], ca.vertcat(v[3] - v[1] - d * ca.sin(v[2]) * v[0] * s, v[2] * v[0]), None, use_compiler
    )
    places = np.array([[0, 1 + 2 * k, 2 + 2 * k, 3 + 2 * k] for k in range(COUNT)])
    stages = MappedFunctionTerm("motion", ("gap", "work"), motion, places, np.arange(COUNT)[:, None], np.array([COUNT]))
    one, two = ca.SX.sym("q", 1), ca.SX.sym("q", 2)
    none = ca.SX(0, 1)
    square = LocalVariableFunction("square", [one, none, none], one + 0.2 * one**2)
    at = np.arange(1, SIZE, 2)[:, None]
    seen = MappedFunctionTerm("x", ("x",), square, at, np.zeros((len(at), 0), int), np.zeros(0, int))
    between = ca.DM(COUNT, COUNT + 1)
    for k in range(COUNT):
        between[k, k], between[k, k + 1] = 0.25, 0.75
    target, weight = COUNT + 1 + np.arange(COUNT), 2 * COUNT + 1 + np.arange(COUNT)
    pair = LocalVariableFunction("pair", [two, none, none], two[0] * two[1] - 0.3)
    beside = MappedFunctionTerm("y", ("y",), pair, np.array([[0, 2], [0, 4]]), np.zeros((2, 0), int), np.zeros(0, int))
    rng = np.random.default_rng(0)
    values = np.concatenate([rng.random(COUNT), [1.5], rng.random(COUNT), 1 + rng.random(COUNT)])
    states = np.arange(1, SIZE).reshape(1, -1)
    variables = {
        "shared": _VectorBlock(np.array([[0]]), ("a",), "N m"),
        "chain[one]": _VectorBlock(states, ("x or y",)),
    }
    blocks = variables, {"s": _VectorBlock(np.array([[COUNT]]), ("s",))}
    terms = (stages,), (ResidualTerm(seen, between, weight, target, threshold), ResidualTerm(beside, ca.DM.eye(2)))
    numbers = np.full(SIZE, -np.inf), np.full(SIZE, np.inf), 0.3 * rng.standard_normal(SIZE), values
    return NonlinearProgram(*blocks, *terms, *numbers, ridge, ca.MX.sym("w", SIZE), ca.MX.sym("p", len(values)))


def at(program, *expressions, seed=1):
    """Values at a random point with random multipliers."""
    rng = np.random.default_rng(seed)
    symbols = [program.w, program.p, program.lam_f, program.lam_g]
    function = ca.Function("f", symbols, [ca.densify(ca.MX(e)) for e in expressions])
    point = [rng.standard_normal(SIZE), program.parameter_values, 0.7, rng.standard_normal(program.g.numel())]
    return [np.array(x) for x in function(*point)] if len(expressions) > 1 else np.array(function(*point))


@pytest.mark.parametrize("use_compiler", [False, True])
@pytest.mark.parametrize("threshold", [math.inf, 0.4])
def test_placed_derivatives_are_those_that_casadi_finds(use_compiler, threshold):
    program = chain(use_compiler, threshold)
    w = program.w
    extra = ca.sumsqr(ca.sin(w[1:4])) * w[0]
    for nlp in (program, program.with_user_terms(extra, [w[2] * w[3], program["chain"][:2].T], [0.0, -1.0, -1.0], 1.0)):
        pairs = [
            (nlp.jac_g, ca.jacobian(nlp.g, w)),
            (nlp.jac_r, ca.jacobian(nlp.residual, w)),
            (nlp.grad_f, ca.gradient(nlp.f, w)),
            (nlp.hessian("exact"), ca.hessian(nlp.lam_f * nlp.f + ca.dot(nlp.lam_g, nlp.g), w)[0]),
        ]
        for placed, expected in pairs:
            actual, reference = at(nlp, placed, expected)
            np.testing.assert_allclose(actual, reference, rtol=0, atol=1e-12)


def test_gauss_newton_leaves_out_curvature_but_not_that_of_what_was_added():
    program = chain(ridge=GaussNewtonHessianRidge(np.array([0]), np.array([0.5]), 0.2))
    w = program.w
    slope, cost, first = at(program, program.jac_r, program.f, w[0])
    expected = 0.7 * slope.T @ slope
    count = program.residual.numel()
    expected[0, 0] += 0.7 * 0.2 * 2 * cost.item() / count / max(abs(first.item()), 0.5) ** 2
    np.testing.assert_allclose(at(program, program.hessian()), expected, rtol=0, atol=1e-12)
    more = program.with_user_terms(w[1] ** 4)
    twelve = at(more, more.hessian())[1, 1] - expected[1, 1] - 0.7 * 12 * at(more, w[1]).item() ** 2
    gained = 0.7 * 0.2 * 2 * (at(more, more.f) - cost) / count
    assert abs(twelve) < 1e-12, "the ridge knows the residuals alone"
    assert gained.item() != 0


def test_blocks_and_rows_have_names():
    program = chain()
    assert program.variable_names()[:3] == ("shared.a", "chain[one].x or y.0", "chain[one].x or y.1")
    assert program.constraint_names()[:3] == ("motion.gap.0", "motion.work.0", "motion.gap.1")
    np.testing.assert_array_equal(at(program, program["chain"]).ravel(), at(program, program.w).ravel()[1:])
    np.testing.assert_array_equal(at(program, program["s"]), [[1.5]])
    assert program.with_user_terms(0.0, program.w[:2]).constraint_names()[-2:] == ("added.0", "added.1")
    with pytest.raises(SolverError, match="no block 'chian'"):
        program["chian"]


def test_what_is_added_must_fit():
    program = chain()
    with pytest.raises(SolverError, match="'other' is neither a variable nor a parameter"):
        program.with_user_terms(ca.MX.sym("other") * program.w[0])
    with pytest.raises(SolverError, match="3 lower bounds are given for 2 constraints"):
        program.with_user_terms(0.0, program.w[:2], [0.0, 0.0, 0.0])
    with pytest.raises(SolverError, match="CasADi cannot make the solver 'no_such_plugin'"):
        program.make_solver("no_such_plugin")


QUIET = {
    "ipopt": {"ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-12}},
    "sqpmethod": {
        **dict.fromkeys(("print_header", "print_iteration", "print_status"), False),
        **{"qpsol": "qrqp", "tol_du": 1e-10, "tol_pr": 1e-10},
        "qpsol_options": dict.fromkeys(("print_iter", "print_header", "error_on_fail"), False),
    },
}


@pytest.mark.parametrize("hessian", ["gauss_newton", "exact"])
@pytest.mark.parametrize("plugin", list(QUIET))
def test_any_plugin_finds_the_same_optimum_with_the_derivatives_it_is_given(plugin, hessian, capfd):
    program = chain(ridge=GaussNewtonHessianRidge(np.array([0]), np.array([1.0]), 0.1))
    program = program.with_user_terms(ca.sumsqr(program.w - 0.1) / 2, program.w[1] + program.w[3], 0.5, 2.0)
    # `work` is no equality here: leave it free
    arguments = program.solver_arguments
    arguments["lbg"][1 : 2 * COUNT : 2], arguments["ubg"][1 : 2 * COUNT : 2] = -10.0, 10.0
    plain = ca.nlpsol("plain", "ipopt", program.nlp, {**QUIET["ipopt"], "print_time": False})(**arguments)
    solver = program.make_solver(plugin, hessian, **QUIET[plugin])
    found = solver(**arguments)
    assert solver.stats()["success"]
    np.testing.assert_allclose(np.array(found["x"]), np.array(plain["x"]), rtol=0, atol=1e-7)
    asked = {name: solver.get_function(name) for name in solver.get_function()}
    curved = next(function for name, function in asked.items() if "hess" in name)
    given = curved(arguments["x0"], program.parameter_values, 1.0, np.zeros(program.g.numel()))
    dense = np.array(ca.densify(given[-1] if isinstance(given, tuple) else given))
    symbols = [program.w, program.p, program.lam_f, program.lam_g]
    function = ca.Function("h", symbols, [ca.densify(program.hessian(hessian))])
    expected = np.array(function(arguments["x0"], program.parameter_values, 1.0, 0.0))
    np.testing.assert_allclose(np.triu(dense), np.triu(expected), rtol=0, atol=1e-12)
