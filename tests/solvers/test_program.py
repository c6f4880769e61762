"""Nonlinear programs made of terms: their derivatives, what may be added to them, and the solvers that take them."""

from __future__ import annotations

import math

import casadi as ca
import numpy as np
import pytest

from yid_ocp.errors import SolverError
from yid_ocp.solvers.nonlinear_program import NonlinearProgram, _VectorBlock
from yid_ocp.solvers.program_terms import LocalVariableFunction, ProgramTerm, ResidualTerm, RidgeRegularization

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
    stages = ProgramTerm("motion", ("gap", "work"), motion, places, np.arange(COUNT)[:, None], np.array([COUNT]))
    one, two = ca.SX.sym("q", 1), ca.SX.sym("q", 2)
    none = ca.SX(0, 1)
    square = LocalVariableFunction("square", [one, none, none], one + 0.2 * one**2)
    at = np.arange(1, SIZE, 2)[:, None]
    seen = ProgramTerm("x", ("x",), square, at, np.zeros((len(at), 0), int), np.zeros(0, int))
    between = ca.DM(COUNT, COUNT + 1)
    for k in range(COUNT):
        between[k, k], between[k, k + 1] = 0.25, 0.75
    target, weight = COUNT + 1 + np.arange(COUNT), 2 * COUNT + 1 + np.arange(COUNT)
    pair = LocalVariableFunction("pair", [two, none, none], two[0] * two[1] - 0.3)
    beside = ProgramTerm("y", ("y",), pair, np.array([[0, 2], [0, 4]]), np.zeros((2, 0), int), np.zeros(0, int))
    rng = np.random.default_rng(0)
    values = np.concatenate([rng.random(COUNT), [1.5], rng.random(COUNT), 1 + rng.random(COUNT)])
    states = np.arange(1, SIZE).reshape(1, -1)
    variables = {
        "shared": _VectorBlock(np.array([[0]]), ("a",), "N m"),
        "chain[one]": _VectorBlock(states, ("x or y",)),
    }
    return NonlinearProgram(
        variables,
        {"s": _VectorBlock(np.array([[COUNT]]), ("s",))},
        (stages,),
        (ResidualTerm(seen, between, weight, target, threshold), ResidualTerm(beside)),
        np.full(SIZE, -np.inf),
        np.full(SIZE, np.inf),
        0.3 * rng.standard_normal(SIZE),
        values,
        ridge,
        ca.MX.sym("w", SIZE),
        ca.MX.sym("p", len(values)),
    )


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
    ridge = RidgeRegularization(np.array([0]), np.array([0.5]), 0.2)
    program = chain(ridge=ridge)
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


def test_the_loss_is_hubers():
    plain, robust = chain(), chain(threshold=0.4)
    r, second, cost = at(robust, robust.residual[:COUNT], robust.residual[COUNT:], robust.f)
    size = np.abs(r)
    expected = np.where(size <= 0.4, r**2 / 2, 0.4 * (size - 0.2)).sum() + (second**2).sum() / 2
    assert np.any(size > 0.4)
    assert np.any(size < 0.4)
    assert cost.item() == pytest.approx(expected, rel=1e-13)
    assert at(plain, plain.f).item() > cost.item()


def test_blocks_and_rows_have_names():
    program = chain()
    assert program.variable_names()[:3] == ("shared.a", "chain[one].x or y.0", "chain[one].x or y.1")
    assert program.constraint_names()[:3] == ("motion.gap.0", "motion.work.0", "motion.gap.1")
    np.testing.assert_array_equal(at(program, program["chain"]).ravel(), at(program, program.w).ravel()[1:])
    np.testing.assert_array_equal(at(program, program["s"]), [[1.5]])
    assert program.with_user_terms(0.0, program.w[:2]).constraint_names()[-2:] == ("added.0", "added.1")
    with pytest.raises(SolverError, match="has 0 blocks 'chian'"):
        program["chian"]


def test_what_is_added_must_fit():
    program = chain()
    with pytest.raises(SolverError, match="'other' is neither an unknown nor a parameter"):
        program.with_user_terms(ca.MX.sym("other") * program.w[0])
    with pytest.raises(SolverError, match="3 lower bounds for 2 constraints"):
        program.with_user_terms(0.0, program.w[:2], [0.0, 0.0, 0.0])
    with pytest.raises(SolverError, match="CasADi cannot make the solver 'no_such_plugin'"):
        program.make_solver("no_such_plugin")


QUIET = {
    "ipopt": {"ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-12}},
    "sqpmethod": {
        "qpsol": "qrqp",
        "print_header": False,
        "print_iteration": False,
        "print_status": False,
        "qpsol_options": {"print_iter": False, "print_header": False, "error_on_fail": False},
        "tol_du": 1e-10,
        "tol_pr": 1e-10,
    },
}


@pytest.mark.parametrize("hessian", ["gauss_newton", "exact"])
@pytest.mark.parametrize("plugin", list(QUIET))
def test_any_plugin_finds_the_same_optimum_with_the_derivatives_it_is_given(plugin, hessian, capfd):
    program = chain(ridge=RidgeRegularization(np.array([0]), np.array([1.0]), 0.1))
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
    expected = np.array(
        ca.densify(
            ca.Function("h", symbols, [program.hessian(hessian)])(arguments["x0"], program.parameter_values, 1.0, 0.0)
        )
    )
    np.testing.assert_allclose(np.triu(dense), np.triu(expected), rtol=0, atol=1e-12)


def test_a_trial_point_without_a_value_is_not_for_the_screen(capfd):
    program = chain()
    program = program.with_user_terms(ca.log(program.w[0]) ** 2)
    arguments = {**program.solver_arguments, "x0": np.full(SIZE, -1.0)}
    arguments["lbg"][1 : 2 * COUNT : 2], arguments["ubg"][1 : 2 * COUNT : 2] = -10.0, 10.0
    solver = program.make_solver("ipopt", "exact", ipopt={"print_level": 0, "sb": "yes"})
    solver(**arguments)
    assert not solver.stats()["success"]
    assert capfd.readouterr() == ("", "")
