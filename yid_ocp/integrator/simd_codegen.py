"""C source of CasADi functions in the arithmetic of `simd.c`: for several members at once, and for long functions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

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
_KNOWN = {ca.OP_INPUT, ca.OP_OUTPUT, ca.OP_CONST, *_FORMS, *_TURNS}


_LONG_INSTRUCTION_COUNT = 80_000
"""Number of instructions above which a function is split into parts, since compile time grows superlinearly."""
_PART_INSTRUCTION_COUNT = 300
"""Instructions per part; with 300 a step of 151 variables compiles in half the time of 4000 and runs as fast."""


def is_long_function(function: ca.Function) -> bool:
    """Whether a function is so long that its C code is split into parts."""
    return int(function.n_instructions()) > _LONG_INSTRUCTION_COUNT


def simd_c_source(functions: Sequence[ca.Function]) -> str | None:
    """SIMD C source of SX functions with CasADi's signatures; None if one uses an operation without a SIMD form.

    Parameters
    ----------
    functions : sequence of casadi.Function
        All their arguments and results are there whenever they are called. A long one is written as functions of
        `_PART_INSTRUCTION_COUNT` instructions, which hand on what later ones need in the work vector.
    """
    sources = [_source(function) for function in functions]
    return None if None in sources else "\n".join(source for source in sources if source is not None)


@dataclass(frozen=True)
class _Instruction:
    code: int
    inputs: list[int]  # argument and entry, or the instructions whose values it takes
    outputs: list[int]  # the place of CasADi's work vector, or result and entry
    constant: float


def _source(function: ca.Function) -> str | None:
    instructions = _instructions(function)
    if any(instruction.code not in _KNOWN for instruction in instructions):
        return None
    size = _PART_INSTRUCTION_COUNT if is_long_function(function) else max(len(instructions), 1)
    needed = [0] * len(instructions)  # the last part that takes its value
    for k, instruction in enumerate(instructions):
        for of in instruction.inputs if instruction.code != ca.OP_INPUT else ():
            needed[of] = k // size
    signature, name = "const real **arg, real **res, long long *iw, real *restrict w, int mem", function.name()
    parts = [_part(instructions, first, size, needed) for first in range(0, max(len(instructions), 1), size)]
    if len(parts) == 1:
        return "\n".join([f"static void {name}({signature}) {{", *parts[0], "}"])
    written = [
        "\n".join([f"static __attribute__((noinline)) void {name}_{i}({signature}) {{", *lines, "}"])
        for i, lines in enumerate(parts)
    ]
    calls = [f"{name}_{i}(arg, res, iw, w, mem);" for i in range(len(parts))]
    return "\n".join([*written, f"static void {name}({signature}) {{", *calls, "}"])


def _instructions(function: ca.Function) -> list[_Instruction]:
    """What a function does, in order; of an operation without a form no input is looked up."""
    held: dict[int, int] = {}  # the instruction whose value stands in a place now
    found = []
    for k in range(function.n_instructions()):
        code, inputs, outputs = (
            function.instruction_id(k),
            function.instruction_input(k),
            function.instruction_output(k),
        )
        if code in _KNOWN and code != ca.OP_INPUT:
            inputs = [held[place] for place in inputs]
        constant = function.instruction_constant(k) if code == ca.OP_CONST else 0.0
        found.append(_Instruction(code, inputs, outputs, constant))
        if code != ca.OP_OUTPUT:
            held.update(dict.fromkeys(outputs, k))
    return found


def _part(instructions: Sequence[_Instruction], first: int, size: int, needed: Sequence[int]) -> list[str]:
    """Some instructions, each value a constant of its own; those that later parts need go to the work vector."""
    lines: list[str] = []
    known: dict[int, str] = {}  # values of this part, and those that it has read from the work vector
    turned: dict[int, str] = {}  # sine and cosine of a value are worked out together

    def value(of: int) -> str:
        if of not in known:
            known[of] = f"v{of}"
            lines.append(f"const real v{of} = w[{instructions[of].outputs[0]}];")
        return known[of]

    own = range(first, min(first + size, len(instructions)))
    for k in own:
        told, name = instructions[k], f"v{k}"
        if told.code == ca.OP_OUTPUT:
            result = value(told.inputs[0])
            lines.append(f"res[{told.outputs[0]}][{told.outputs[1]}] = {result};")
            continue
        if told.code == ca.OP_CONST:
            constant = repr(told.constant).replace("inf", "INFINITY").replace("nan", "NAN")
            lines.append(f"const real {name} = ALL({constant});")
        elif told.code == ca.OP_INPUT:
            lines.append(f"const real {name} = arg[{told.inputs[0]}][{told.inputs[1]}];")
        elif told.code in _TURNS:
            of, angle = told.inputs[0], value(told.inputs[0])
            if of not in turned:
                turned[of] = f"t{k}"
                lines.append(f"const Turn t{k} = turn({angle});")
            name = f"{turned[of]}.{_TURNS[told.code]}"
        else:
            operands = [value(of) for of in told.inputs]
            lines.append(f"const real {name} = {_FORMS[told.code].format(*operands)};")
        known[k] = name
    kept = sorted((instructions[k].outputs[0], k) for k in own if needed[k] > first // size)
    return [*lines, *(f"w[{place}] = {known[k]};" for place, k in kept)]
