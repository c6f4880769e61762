"""Expressions as text and as LaTeX: read back, they have the values of the expressions that they came from."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from formula_reader import FUNCTIONS, read, read_latex

from yid_ocp.analysis.step_symbols import _SymbolName, count_operations, format_expressions

X = ca.SX.sym("x", 4)
A, B, C, D = ca.vertsplit(X)
NAMES = [_SymbolName(f"v[{i}]", f"v_{{{i}}}") for i in range(4)]
POINT = np.array([0.7, -1.3, 2.1, 0.4])
EXPRESSIONS = {
    "sums": A - (B - C) - (-D) + 2.5,
    "products": -(A + B) * (C - D) * -3 / (A / (B * C)),
    "quotients of quotients": A / (B / (C / D)) / 7.0,
    "powers of powers": (C**D) ** 2 + ca.sqrt((A * C) ** 2) + ((A + B) ** 2) ** 2 + (A**D) ** C,
    "powers": (A + B) ** 2 + ca.sqrt(C) ** 3 + (A * B) ** 2 + C**D + (-B) ** 2.5,
    "negative parts": (A - B) * (-ca.sin(C)) * (-D) + (-A) ** 2 / (-(B + C)) + A * (B * -0.5) ** 2 * (-0.5 * C),
    "a negative factor": A * -0.25 - -0.25 * B + A / -3.0,
    "double and inverse": 2 * (A + B) + 1 / (C + D) + 1 / (1 / C),
    "functions": ca.sin(A) * ca.cos(A + B) + ca.exp(-D) * ca.log(C) + ca.tan(D) + ca.tanh(B) + ca.atan2(A, B),
    "shared": ca.sin(A + B) * (A + B) + ca.sin(A + B) ** 2,
    "cases": ca.if_else(A < B, C, D) + ca.if_else(ca.logic_and(A > 0, C >= D), A * B, ca.fmax(C, ca.fabs(B))),
    "limits": ca.fmin(A, B) - ca.sign(B) * ca.fabs(B - C),
    "tiny numbers": 3.25e-9 * A - 1.5e12 * B,
    "a constant": ca.SX(-4.25) + 0 * A,
    "a variable": C,
}


def evaluate(made, reader) -> list[float]:
    known = {**FUNCTIONS, "v": POINT}
    for name, text in made.shared_subexpressions:
        known[reader(name)] = eval(reader(text), {"__builtins__": {}}, known)
    return [float(eval(reader(value), {"__builtins__": {}}, known)) for value in made.expression_texts]


@pytest.mark.parametrize("latex", [False, True], ids=["text", "latex"])
@pytest.mark.parametrize("name", list(EXPRESSIONS))
def test_formulas_have_the_value_of_their_expression(name, latex):
    expression = EXPRESSIONS[name]
    expected = float(ca.Function("f", [X], [expression])(POINT))
    made = format_expressions([expression, 2 * expression], X, NAMES, latex)
    found = evaluate(made, read_latex if latex else read)
    assert found == pytest.approx([expected, 2 * expected], rel=1e-9)


def test_parts_that_occur_twice_are_written_once():
    made = format_expressions([EXPRESSIONS["shared"]], X, NAMES)
    assert [text for _, text in made.shared_subexpressions] == ["v[0] + v[1]", "sin(c1)"]
    assert made.expression_texts == ("c2*c1 + c2^2",)
    # a sum, a sine, a product, a square, a sum
    assert made.n_operations == count_operations([EXPRESSIONS["shared"]], X) == 5
    assert made.variable_indices == (0, 1)


def test_long_fractions_can_be_broken_into_lines():
    long = sum((ca.sin(A * i) for i in range(2, 12)), ca.SX(0)) / (B + C)
    made = format_expressions([long], X, NAMES, latex=True)
    assert r"\frac" not in made.expression_texts[0]
    assert ")/(" in made.expression_texts[0]
    assert format_expressions([A / B], X, NAMES, latex=True).expression_texts == (r"\frac{v_{0}}{v_{1}}",)


def test_nothing_is_left_of_what_cancels():
    made = format_expressions([A - A], X, NAMES)
    assert (made.expression_texts, made.n_operations, made.variable_indices) == (("0",), 0, ())
