"""Symbolic expressions as readable text and LaTeX, with variable names and shared subexpressions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca

# How tightly an expression binds: a part that binds less than its place asks for gets parentheses.
COMPARED, SUM, PRODUCT, POWER, ATOM = range(5)
LEAVES = (ca.OP_INPUT, ca.OP_CONST)
LONG_FRACTION = 60  # characters beyond which a fraction is written on one line, which TeX can break

# operation: template, how tightly it binds, what it asks of its parts
Layout = tuple[str, int, tuple[int, ...]]
TEXT: dict[int, Layout] = {
    ca.OP_ADD: ("{0} + {1}", SUM, (SUM, SUM)),
    ca.OP_SUB: ("{0} - {1}", SUM, (SUM, PRODUCT)),
    ca.OP_NEG: ("-{0}", SUM, (PRODUCT,)),
    ca.OP_MUL: ("{0}*{1}", PRODUCT, (PRODUCT, PRODUCT)),
    ca.OP_DIV: ("{0}/{1}", PRODUCT, (PRODUCT, POWER)),
    ca.OP_TWICE: ("2*{0}", PRODUCT, (PRODUCT,)),
    ca.OP_INV: ("1/{0}", PRODUCT, (POWER,)),
    ca.OP_SQ: ("{0}^2", POWER, (ATOM,)),
    ca.OP_POW: ("{0}^{1}", POWER, (ATOM, ATOM)),
    ca.OP_CONSTPOW: ("{0}^{1}", POWER, (ATOM, ATOM)),
    ca.OP_LT: ("{0} < {1}", COMPARED, (SUM, SUM)),
    ca.OP_LE: ("{0} <= {1}", COMPARED, (SUM, SUM)),
    ca.OP_EQ: ("{0} == {1}", COMPARED, (SUM, SUM)),
    ca.OP_NE: ("{0} != {1}", COMPARED, (SUM, SUM)),
    ca.OP_NOT: ("not {0}", COMPARED, (ATOM,)),
    ca.OP_AND: ("{0} and {1}", COMPARED, (ATOM, ATOM)),
    ca.OP_OR: ("{0} or {1}", COMPARED, (ATOM, ATOM)),
    ca.OP_IF_ELSE_ZERO: ("if({0}, {1}, 0)", ATOM, (COMPARED, COMPARED)),
    ca.OP_FABS: ("abs({0})", ATOM, (COMPARED,)),
    ca.OP_FMIN: ("min({0}, {1})", ATOM, (COMPARED, COMPARED)),
    ca.OP_FMAX: ("max({0}, {1})", ATOM, (COMPARED, COMPARED)),
}
LATEX: dict[int, Layout] = TEXT | {
    ca.OP_MUL: (r"{0} \, {1}", PRODUCT, (PRODUCT, PRODUCT)),
    ca.OP_DIV: (r"\frac{{{0}}}{{{1}}}", ATOM, (COMPARED, COMPARED)),
    ca.OP_TWICE: (r"2 \, {0}", PRODUCT, (PRODUCT,)),
    ca.OP_INV: (r"\frac{{1}}{{{0}}}", ATOM, (COMPARED,)),
    ca.OP_SQ: ("{{{0}}}^{{2}}", POWER, (ATOM,)),
    ca.OP_POW: ("{{{0}}}^{{{1}}}", POWER, (ATOM, COMPARED)),
    ca.OP_CONSTPOW: ("{{{0}}}^{{{1}}}", POWER, (ATOM, COMPARED)),
    ca.OP_LE: (r"{0} \le {1}", COMPARED, (SUM, SUM)),
    ca.OP_EQ: ("{0} = {1}", COMPARED, (SUM, SUM)),
    ca.OP_NE: (r"{0} \ne {1}", COMPARED, (SUM, SUM)),
    ca.OP_NOT: (r"\lnot {0}", COMPARED, (ATOM,)),
    ca.OP_AND: (r"{0} \land {1}", COMPARED, (ATOM, ATOM)),
    ca.OP_OR: (r"{0} \lor {1}", COMPARED, (ATOM, ATOM)),
    ca.OP_IF_ELSE_ZERO: (r"[{0}] \, {1}", PRODUCT, (COMPARED, PRODUCT)),
    ca.OP_FABS: ("|{0}|", ATOM, (COMPARED,)),
}
CALLED = {getattr(ca, name): name.removeprefix("OP_").lower() for name in dir(ca) if name.startswith("OP_")}


@dataclass(frozen=True)
class Name:
    """Name of a variable in plain text and in LaTeX."""

    text: str
    latex: str


@dataclass(frozen=True)
class Formula:
    """Expressions written as text, with their shared subexpressions.

    Attributes
    ----------
    shared : tuple of (str, str)
        Name and expression of each part that occurs more than once; each may use those before it.
    values : tuple of str
        The expressions, in terms of the shared parts.
    operations : int
        Number of operations, each shared one counted once.
    variables : tuple of int
        Indices of the variables that occur.
    """

    shared: tuple[tuple[str, str], ...]
    values: tuple[str, ...]
    operations: int
    variables: tuple[int, ...]


@dataclass(frozen=True)
class _Node:
    op: int
    parts: tuple[int, ...]
    place: int = -1
    value: float = 0.0


def operations(expressions: Sequence[ca.SX], variables: ca.SX) -> int:
    """Number of operations that evaluate all expressions, each shared one counted once."""
    function = _function(expressions, variables)
    skipped = (*LEAVES, ca.OP_OUTPUT, ca.OP_PARAMETER)
    return sum(function.instruction_id(i) not in skipped for i in range(function.n_instructions()))


def formula(expressions: Sequence[ca.SX], variables: ca.SX, names: Sequence[Name], latex: bool = False) -> Formula:
    """Expressions written as text or LaTeX with named variables.

    Parameters
    ----------
    expressions : sequence of casadi.SX
        Scalars.
    variables : casadi.SX, shape (k, 1)
        All symbols that may occur.
    names : sequence of Name
        Of the variables, in order.
    latex : bool
        LaTeX in place of text.

    Returns
    -------
    Formula
    """
    nodes, results = _nodes(_function(expressions, variables), len(expressions))
    uses = [0] * len(nodes)
    for node in nodes:
        for part in node.parts:
            uses[part] += 1
    for result in results:
        uses[result] += 1
    layouts = LATEX if latex else TEXT
    written: list[tuple[str, int]] = []
    shared: list[tuple[str, str]] = []
    for i, node in enumerate(nodes):
        if node.op == ca.OP_INPUT:
            name = names[node.place]
            written.append((name.latex if latex else name.text, ATOM))
        elif node.op == ca.OP_CONST:
            written.append((_number(node.value, latex), SUM if node.value < 0 else ATOM))
        else:
            text, tightness = _written(node, [written[part] for part in node.parts], layouts, latex)
            simple = node.op == ca.OP_NEG and nodes[node.parts[0]].op in LEAVES
            if uses[i] > 1 and not simple:
                name_of = f"c_{{{len(shared) + 1}}}" if latex else f"c{len(shared) + 1}"
                shared.append((name_of, text))
                text, tightness = name_of, ATOM
            written.append((text, tightness))
    counted = sum(node.op not in LEAVES for node in nodes)
    seen = tuple(sorted({node.place for node in nodes if node.op == ca.OP_INPUT}))
    return Formula(tuple(shared), tuple(written[r][0] for r in results), counted, seen)


def _function(expressions: Sequence[ca.SX], variables: ca.SX) -> ca.Function:
    together = ca.cse(ca.densify(ca.vertcat(*expressions)))
    return ca.Function("formula", [variables], [together])


def _nodes(function: ca.Function, count: int) -> tuple[list[_Node], list[int]]:
    """The function's instructions as nodes that are written once, and which nodes are the outputs."""
    nodes: list[_Node] = []
    at: dict[int, int] = {}
    results = [0] * count
    for i in range(function.n_instructions()):
        op, taken, given = function.instruction_id(i), function.instruction_input(i), function.instruction_output(i)
        if op == ca.OP_OUTPUT:
            results[given[1]] = at[taken[0]]
            continue
        if op == ca.OP_INPUT:
            node = _Node(op, (), place=taken[1])
        elif op == ca.OP_CONST:
            node = _Node(op, (), value=float(function.instruction_constant(i)))
        else:
            node = _Node(op, tuple(at[register] for register in taken))
        at[given[0]] = len(nodes)
        nodes.append(node)
    return nodes, results


def _written(node: _Node, parts: list[tuple[str, int]], layouts: dict[int, Layout], latex: bool) -> tuple[str, int]:
    if node.op not in layouts:
        called = CALLED[node.op]
        known = called in ("sin", "cos", "tan", "exp", "log", "sinh", "cosh", "tanh", "min", "max")
        arguments = ", ".join(text for text, _ in parts)
        if latex and called == "sqrt":
            return rf"\sqrt{{{arguments}}}", ATOM
        head = called if not latex else "\\" + called if known else rf"\operatorname{{{called}}}"
        return f"{head}({arguments})", ATOM
    layout = layouts[node.op]
    if latex and node.op in (ca.OP_DIV, ca.OP_INV) and sum(len(text) for text, _ in parts) > LONG_FRACTION:
        layout = TEXT[node.op]
    template, tightness, asked = layout
    texts = [text if has >= wants else f"({text})" for (text, has), wants in zip(parts, asked, strict=True)]
    return template.format(*texts), tightness


def _number(value: float, latex: bool) -> str:
    text = f"{value:.12g}"
    mantissa, _, exponent = text.partition("e")
    return rf"{mantissa} \cdot 10^{{{int(exponent)}}}" if latex and exponent else text
