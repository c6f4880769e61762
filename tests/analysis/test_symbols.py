"""Rows and columns of a step by name: what stands under a name, its derivative, and names that do not exist."""

import math
import re

import casadi as ca
import numpy as np
import pytest
from held_rod import held_rod

from yid_ocp.analysis.step_symbols import NamedStepEquations, count_operations, format_expressions
from yid_ocp.errors import ConfigError
from yid_ocp.integrator.discrete import discrete_equations
from yid_ocp.model import Grasp
from yid_ocp.model.servos_and_springs import StiffnessAndRest


@pytest.fixture(scope="module")
def symbols(urdf_folder):
    """A driven shoulder, a springy elbow whose tip is tied to a rod; a relaxing branch on the rod."""
    system = held_rod(urdf_folder, kind="axis", driven=["shoulder"], springs={"elbow": StiffnessAndRest(3.0)})
    return NamedStepEquations.from_equations(discrete_equations(system))


def point(symbols):
    values = np.random.default_rng(3).uniform(0.2, 0.6, len(symbols.all_variable_names))
    values[symbols.row_or_column_block_slice("theta")] = symbols.equations.system.parameters.vector() + 0.1
    values[symbols.all_variable_names.index("h")] = 0.02
    return values


def value(symbols, expression, at):
    return np.array(ca.densify(ca.Function("f", [symbols.all_variable_symbols], [expression])(at))).ravel()


def test_blocks_have_the_names_of_the_project(symbols):
    joints = ["shoulder", "elbow", *(f"T1_{i}_{axis}" for i in (0, 1) for axis in "xyz")]
    assert list(symbols.row_blocks[0].full_names) == [f"del[{name}]" for name in joints]
    assert [block.name for block in symbols.row_blocks] == ["del", "internal", "constraint", "p1"]
    parts = "x", "y", "z", "tilt_x", "tilt_y"
    assert symbols.row_blocks[2].full_names == tuple(f"constraint[hand.{part}]" for part in parts)
    assert list(symbols.row_blocks[1].labels) == list(symbols.equations.system.effect_internal_coordinate_symbols)
    assert symbols.column_blocks[3].full_names == ("u[shoulder]",)
    # parameters are called as everywhere, without a block
    assert symbols.column_blocks[4].full_names == symbols.equations.system.parameters.names
    assert len(set(symbols.row_names)) == len(symbols.row_names)
    assert len(set(symbols.all_variable_names)) == len(symbols.all_variable_names)


def rows_of(symbols):
    return ca.vertcat(*(block.expressions for block in symbols.row_blocks))


def test_rows_and_columns_stand_where_the_equations_have_them(symbols):
    e = symbols.equations
    at = point(symbols)
    expected = value(symbols, ca.vertcat(e.momentum_balance, e.internal_residual, e.constraint_residual, e.p1), at)
    np.testing.assert_array_equal(value(symbols, rows_of(symbols), at), expected)
    for block in (*symbols.row_blocks, *symbols.column_blocks):
        span = symbols.row_or_column_block_slice(block.name)
        assert span.stop - span.start == len(block.labels) == block.expressions.numel()
    assert symbols.all_variable_names.index("q1[T1_0_x]") == symbols.row_or_column_block_slice("q1").start + 2
    assert symbols.row_names.index("p1[elbow]") == symbols.row_or_column_block_slice("p1").start + 1
    for name in ("lam[hand.tilt_y]", "T1.bend", "h", "u[shoulder]"):
        assert symbols.all_variable_names[symbols.all_variable_names.index(name)] == name


@pytest.mark.parametrize("kind", ["point", "axis", "weld"])
def test_every_equation_of_a_grasp_has_a_name(kind):
    grasp = Grasp("left", "a", "b", kind)
    names = grasp.constraint_equation_names
    assert len(set(names)) == len(names) == grasp.n_constraint_equations
    assert names[:3] == ("left.x", "left.y", "left.z")


@pytest.mark.parametrize("row", ["del[T1_0_x]", "del[elbow]", "constraint[hand.tilt_x]", "p1[T1_1_z]"])
def test_an_entry_is_the_row_as_text(symbols, row):
    """The printed lines are all that is needed to work the row out."""
    at, entry = point(symbols), symbols.equation_or_derivative_by_name(row)
    expected = value(symbols, rows_of(symbols), at)[symbols.row_names.index(row)]
    assert worked_out(symbols, entry, at) == pytest.approx(expected, rel=1e-9)
    assert entry.evaluate_numerically(symbols.all_variable_symbols, at) == pytest.approx(expected, rel=1e-12)
    assert entry.title == row
    assert entry.text_lines[0].startswith(f"{row}: {entry.formula.n_operations} operations, depends on ")
    assert entry.text_lines[-1] == f"  {row} = {entry.formula.expression_texts[0]}"


def worked_out(symbols, entry, at):
    """Value of an entry's text, column names put in as numbers."""
    known = dict(FUNCTIONS)
    places = sorted(range(len(symbols.all_variable_names)), key=lambda i: -len(symbols.all_variable_names[i]))

    def numbers(text):
        for i in places:
            name = symbols.all_variable_names[i]
            # `h` is a letter of many words; all other names are longer than any function's
            text = text.replace(name, f"v[{i}]") if name != "h" else text
        return read(text)

    known |= {"v": at, "h": at[symbols.all_variable_names.index("h")]}
    for name, text in entry.formula.shared_subexpressions:
        known[name] = eval(numbers(text), {"__builtins__": {}}, known)
    return eval(numbers(entry.formula.expression_texts[0]), {"__builtins__": {}}, known)


SLOPES = [("del[T1_0_x]", "q1[T1_0_x]"), ("del[T1_0_x]", "T1.bend"), ("del[shoulder]", "u[shoulder]")]
SLOPES += [("del[elbow]", "lam[hand.y]"), ("constraint[hand.x]", "q1[T1_0_y]"), ("p1[T1_1_y]", "h")]


@pytest.mark.parametrize(("row", "column"), SLOPES)
def test_an_entry_with_a_column_is_the_slope(symbols, row, column):
    at, i, j = point(symbols), symbols.row_names.index(row), symbols.all_variable_names.index(column)
    width = 1e-6 * max(1.0, abs(at[j]))
    ends = []
    for sign in (1, -1):
        moved = at.copy()
        moved[j] += sign * width
        ends.append(value(symbols, rows_of(symbols), moved)[i])
    entry = symbols.equation_or_derivative_by_name(f" {row},{column} ")
    assert entry.title == f"d {row} / d {column}"
    assert not entry.is_identically_zero
    assert worked_out(symbols, entry, at) == pytest.approx((ends[0] - ends[1]) / (2 * width), rel=1e-6, abs=1e-9)


def test_an_entry_names_or_counts_its_variables_and_says_where_it_vanishes(symbols):
    entry = symbols.equation_or_derivative_by_name("constraint[hand.x], T1.bend")
    assert entry.is_identically_zero
    [line] = entry.text_lines
    assert line.startswith("d constraint[hand.x] / d T1.bend = 0 ")
    stiffness = symbols.equation_or_derivative_by_name("del[elbow], elbow.stiffness")
    assert stiffness.variable_names == ("q0[elbow]", "elbow.rest", "h", "q1[elbow]")
    assert "8 of q0" in symbols.equation_or_derivative_by_name("del[T1_0_z]").variable_names


@pytest.mark.parametrize(
    ("text", "what", "hint"),
    [
        ("del[T1_0_w]", "no row 'del[T1_0_w]'", "did you mean 'del[T1_0_"),
        ("q1[T1_0_x]", "no row 'q1[T1_0_x]'", "did you mean 'p1[T1_0_x]'?"),
        ("del[T1_0_x], q1[T1_0_w]", "no column 'q1[T1_0_w]'", "did you mean 'q1[T1_0_"),
        ("del[T1_0_x], T1.bent", "no column 'T1.bent'", "did you mean 'T1.bend'?"),
        ("something else entirely", "no row", "equations.txt"),
    ],
)
def test_a_wrong_name_gets_the_nearest(symbols, text, what, hint):
    with pytest.raises(ConfigError) as caught:
        symbols.equation_or_derivative_by_name(text)
    assert what in caught.value.what
    assert hint in caught.value.hint
    assert caught.value.where == "--entry"
    assert "del[shoulder]" in caught.value.allowed or ", u[shoulder] (" in caught.value.allowed


@pytest.mark.parametrize("text", ["", "del[elbow],", "del[elbow], h, h"])
def test_neither_one_name_nor_two_is_refused(symbols, text):
    with pytest.raises(ConfigError, match="is neither one name nor two names"):
        symbols.equation_or_derivative_by_name(text)


def test_all_rows_are_listed_the_short_ones_whole(symbols):
    lines = symbols.text_lines()
    text = "\n".join(lines)
    for name in symbols.row_names:
        assert any(line.startswith(f"{name}: ") for line in lines), name
    assert symbols.equation_or_derivative_by_name("del[T1_0_z]").text_lines[0] in lines
    inner = symbols.row_blocks[1].full_names[0]
    assert f"  {inner} = " in text
    assert "  del[T1_0_z] = " not in text
    for name in symbols.all_variable_names:
        assert name in text


X = ca.SX.sym("x", 4)
A, B, C, D = ca.vertsplit(X)
NAMES = [f"v[{i}]" for i in range(4)]
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
    "limits": ca.fmin(A, B) - ca.sign(B) * ca.fabs(B - C) + ca.log1p(C),
    "tiny numbers": 3.25e-9 * A - 1.5e12 * B,
    "a constant": ca.SX(-4.25) + 0 * A,
    "a variable": C,
}


FUNCTIONS = {
    "sin": math.sin, "cos": math.cos, "tan": math.tan, "exp": math.exp, "log": math.log, "tanh": math.tanh,
    "sqrt": math.sqrt, "atan2": math.atan2, "sign": lambda x: float(np.sign(x)), "abs": abs, "min": min, "max": max,
    "log1p": math.log1p, "where": lambda said, value, other: value if said else other,
}  # fmt: skip


def read(text: str) -> str:
    """A formula as Python."""
    assert not re.search(r"[*/]-", text), f"a sign behind a product reads badly: {text}"
    return re.sub(r"\bif\(", "where(", text.replace("^", "**"))


def evaluate(made) -> list[float]:
    known = {**FUNCTIONS, "v": POINT}
    for name, text in made.shared_subexpressions:
        known[name] = eval(read(text), {"__builtins__": {}}, known)
    return [float(eval(read(value), {"__builtins__": {}}, known)) for value in made.expression_texts]


@pytest.mark.parametrize("name", list(EXPRESSIONS))
def test_formulas_have_the_value_of_their_expression(name):
    expression = EXPRESSIONS[name]
    expected = float(ca.Function("f", [X], [expression])(POINT))
    assert evaluate(format_expressions([expression, 2 * expression], X, NAMES)) == pytest.approx(
        [expected, 2 * expected], rel=1e-9
    )


def test_parts_that_occur_twice_are_written_once():
    made = format_expressions([EXPRESSIONS["shared"]], X, NAMES)
    assert [text for _, text in made.shared_subexpressions] == ["v[0] + v[1]", "sin(c1)"]
    assert made.expression_texts == ("c2*c1 + c2^2",)
    # a sum, a sine, a product, a square, a sum
    assert made.n_operations == count_operations([EXPRESSIONS["shared"]], X) == 5
    assert made.variable_indices == (0, 1)


def test_only_a_sum_or_a_negative_number_has_brackets_in_a_product():
    made = format_expressions([0.5 * A * (B + 1), A**-0.5], X, NAMES)
    assert made.expression_texts == ("0.5*v[0]*(v[1] + 1)", "v[0]^(-0.5)")


def test_nothing_is_left_of_what_cancels():
    made = format_expressions([A - A], X, NAMES)
    assert (made.expression_texts, made.n_operations, made.variable_indices) == (("0",), 0, ())
