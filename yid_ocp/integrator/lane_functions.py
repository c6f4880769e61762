"""C source of CasADi functions in the arithmetic of `lanes.c`, several members at once."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca

# libm's functions of one member after another
_ONE = {
    ca.OP_EXP: "exp",
    ca.OP_LOG: "log",
    ca.OP_TAN: "tan",
    ca.OP_ASIN: "asin",
    ca.OP_ACOS: "acos",
    ca.OP_ATAN: "atan",
    ca.OP_SINH: "sinh",
    ca.OP_COSH: "cosh",
    ca.OP_TANH: "tanh",
    ca.OP_ASINH: "asinh",
    ca.OP_ACOSH: "acosh",
    ca.OP_ATANH: "atanh",
    ca.OP_FLOOR: "floor",
    ca.OP_CEIL: "ceil",
    ca.OP_ERF: "erf",
    ca.OP_LOG1P: "log1p",
    ca.OP_EXPM1: "expm1",
}
_TWO = {
    ca.OP_POW: "pow",
    ca.OP_CONSTPOW: "pow",
    ca.OP_ATAN2: "atan2",
    ca.OP_FMOD: "fmod",
    ca.OP_REMAINDER: "remainder",
    ca.OP_COPYSIGN: "copysign",
    ca.OP_HYPOT: "hypot",
}
_FORMS = {
    ca.OP_ASSIGN: "{0}",
    ca.OP_ADD: "{0} + {1}",
    ca.OP_SUB: "{0} - {1}",
    ca.OP_MUL: "{0} * {1}",
    ca.OP_DIV: "{0} / {1}",
    ca.OP_NEG: "-{0}",
    ca.OP_SQ: "{0} * {0}",
    ca.OP_TWICE: "{0} + {0}",
    ca.OP_INV: "1.0 / {0}",
    ca.OP_SQRT: "root({0})",
    ca.OP_FABS: "magnitude({0})",
    ca.OP_SIGN: "sign_of({0})",
    ca.OP_FMIN: "lesser({0}, {1})",
    ca.OP_FMAX: "larger({0}, {1})",
    ca.OP_LT: "truth({0} < {1})",
    ca.OP_LE: "truth({0} <= {1})",
    ca.OP_EQ: "truth({0} == {1})",
    ca.OP_NE: "truth({0} != {1})",
    ca.OP_NOT: "truth({0} == 0)",
    ca.OP_AND: "truth(({0} != 0) & ({1} != 0))",
    ca.OP_OR: "truth(({0} != 0) | ({1} != 0))",
    ca.OP_IF_ELSE_ZERO: "choose({0} != 0, {1}, (real)ALL(0.0))",
    **{code: f"each({name}, {{0}})" for code, name in _ONE.items()},
    **{code: f"each_pair({name}, {{0}}, {{1}})" for code, name in _TWO.items()},
}
_TURNS = {ca.OP_SIN: "sine", ca.OP_COS: "cosine"}


def lane_functions_source(functions: Sequence[ca.Function]) -> str | None:
    """C source of SX functions with the signatures of CasADi's own; None where one uses an operation without a form.

    Parameters
    ----------
    functions : sequence of casadi.Function
        All their arguments and results are there whenever they are called.
    """
    sources = [_source(function) for function in functions]
    return None if None in sources else "\n".join(source for source in sources if source is not None)


def _source(function: ca.Function) -> str | None:
    lines = [f"static void {function.name()}(const real **arg, real **res, long long *iw, real *w, int mem) {{"]
    value: dict[int, str] = {}  # what stands in a place of CasADi's work vector now
    turned: dict[str, str] = {}  # sine and cosine of a value are worked out together
    for k in range(function.n_instructions()):
        code, inputs, outputs = (
            function.instruction_id(k),
            function.instruction_input(k),
            function.instruction_output(k),
        )
        name = f"v{k}"
        if code == ca.OP_OUTPUT:
            lines.append(f"res[{outputs[0]}][{outputs[1]}] = {value[inputs[0]]};")
            continue
        if code == ca.OP_CONST:
            constant = repr(function.instruction_constant(k)).replace("inf", "INFINITY").replace("nan", "NAN")
            lines.append(f"const real {name} = ALL({constant});")
        elif code == ca.OP_INPUT:
            lines.append(f"const real {name} = arg[{inputs[0]}][{inputs[1]}];")
        elif code in _TURNS:
            angle = value[inputs[0]]
            if angle not in turned:
                turned[angle] = f"t{k}"
                lines.append(f"const Turn t{k} = turn({angle});")
            name = f"{turned[angle]}.{_TURNS[code]}"
        elif code in _FORMS:
            lines.append(f"const real {name} = {_FORMS[code].format(*(value[i] for i in inputs))};")
        else:
            return None
        value[outputs[0]] = name
    return "\n".join([*lines, "}"])
