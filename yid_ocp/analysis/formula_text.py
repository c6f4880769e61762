"""Symbolic expressions as readable text and LaTeX, with variable names and shared subexpressions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca

# How tightly an expression binds: a part that binds less than its place asks for gets parentheses.
_COMPARISON, _SUM, _PRODUCT, _POWER, _ATOM = range(5)
_LEAF_OPERATIONS = (ca.OP_INPUT, ca.OP_CONST)
_MAX_FRACTION_LENGTH = 60  # characters beyond which a fraction is written on one line, which TeX can break

# operation: template, how tightly it binds, what it asks of its parts
_OperationTemplate = tuple[str, int, tuple[int, ...]]
_TEXT_TEMPLATES: dict[int, _OperationTemplate] = {
    ca.OP_ADD: ("{0} + {1}", _SUM, (_SUM, _SUM)),
    ca.OP_SUB: ("{0} - {1}", _SUM, (_SUM, _PRODUCT)),
    ca.OP_NEG: ("-{0}", _SUM, (_PRODUCT,)),
    ca.OP_MUL: ("{0}*{1}", _PRODUCT, (_PRODUCT, _PRODUCT)),
    ca.OP_DIV: ("{0}/{1}", _PRODUCT, (_PRODUCT, _POWER)),
    ca.OP_TWICE: ("2*{0}", _PRODUCT, (_PRODUCT,)),
    ca.OP_INV: ("1/{0}", _PRODUCT, (_POWER,)),
    ca.OP_SQ: ("{0}^2", _POWER, (_ATOM,)),
    ca.OP_POW: ("{0}^{1}", _POWER, (_ATOM, _ATOM)),
    ca.OP_CONSTPOW: ("{0}^{1}", _POWER, (_ATOM, _ATOM)),
    ca.OP_LT: ("{0} < {1}", _COMPARISON, (_SUM, _SUM)),
    ca.OP_LE: ("{0} <= {1}", _COMPARISON, (_SUM, _SUM)),
    ca.OP_EQ: ("{0} == {1}", _COMPARISON, (_SUM, _SUM)),
    ca.OP_NE: ("{0} != {1}", _COMPARISON, (_SUM, _SUM)),
    ca.OP_NOT: ("not {0}", _COMPARISON, (_ATOM,)),
    ca.OP_AND: ("{0} and {1}", _COMPARISON, (_ATOM, _ATOM)),
    ca.OP_OR: ("{0} or {1}", _COMPARISON, (_ATOM, _ATOM)),
    ca.OP_IF_ELSE_ZERO: ("if({0}, {1}, 0)", _ATOM, (_COMPARISON, _COMPARISON)),
    ca.OP_FABS: ("abs({0})", _ATOM, (_COMPARISON,)),
    ca.OP_FMIN: ("min({0}, {1})", _ATOM, (_COMPARISON, _COMPARISON)),
    ca.OP_FMAX: ("max({0}, {1})", _ATOM, (_COMPARISON, _COMPARISON)),
}
_LATEX_TEMPLATES: dict[int, _OperationTemplate] = _TEXT_TEMPLATES | {
    ca.OP_MUL: (r"{0} \, {1}", _PRODUCT, (_PRODUCT, _PRODUCT)),
    ca.OP_DIV: (r"\frac{{{0}}}{{{1}}}", _ATOM, (_COMPARISON, _COMPARISON)),
    ca.OP_TWICE: (r"2 \, {0}", _PRODUCT, (_PRODUCT,)),
    ca.OP_INV: (r"\frac{{1}}{{{0}}}", _ATOM, (_COMPARISON,)),
    ca.OP_SQ: ("{{{0}}}^{{2}}", _POWER, (_ATOM,)),
    ca.OP_POW: ("{{{0}}}^{{{1}}}", _POWER, (_ATOM, _COMPARISON)),
    ca.OP_CONSTPOW: ("{{{0}}}^{{{1}}}", _POWER, (_ATOM, _COMPARISON)),
    ca.OP_LE: (r"{0} \le {1}", _COMPARISON, (_SUM, _SUM)),
    ca.OP_EQ: ("{0} = {1}", _COMPARISON, (_SUM, _SUM)),
    ca.OP_NE: (r"{0} \ne {1}", _COMPARISON, (_SUM, _SUM)),
    ca.OP_NOT: (r"\lnot {0}", _COMPARISON, (_ATOM,)),
    ca.OP_AND: (r"{0} \land {1}", _COMPARISON, (_ATOM, _ATOM)),
    ca.OP_OR: (r"{0} \lor {1}", _COMPARISON, (_ATOM, _ATOM)),
    ca.OP_IF_ELSE_ZERO: (r"[{0}] \, {1}", _PRODUCT, (_COMPARISON, _PRODUCT)),
    ca.OP_FABS: ("|{0}|", _ATOM, (_COMPARISON,)),
}
_FUNCTION_NAMES = {getattr(ca, name): name.removeprefix("OP_").lower() for name in dir(ca) if name.startswith("OP_")}


@dataclass(frozen=True)
class SymbolName:
    """Name of a variable in plain text and in LaTeX."""

    text: str
    latex: str


@dataclass(frozen=True)
class FormulaText:
    """Expressions written as text, with their shared subexpressions.

    Attributes
    ----------
    shared_subexpressions : tuple of (str, str)
        Name and expression of each part that occurs more than once; each may use those before it.
    expression_texts : tuple of str
        The expressions, in terms of the shared parts.
    n_operations : int
        Number of operations, each shared one counted once.
    variable_indices : tuple of int
        Indices of the variables that occur.
    """

    shared_subexpressions: tuple[tuple[str, str], ...]
    expression_texts: tuple[str, ...]
    n_operations: int
    variable_indices: tuple[int, ...]


@dataclass(frozen=True)
class _Node:
    op: int
    parts: tuple[int, ...]
    place: int = -1
    value: float = 0.0


def count_operations(expressions: Sequence[ca.SX], variables: ca.SX) -> int:
    """Number of operations that evaluate all expressions, each shared one counted once."""
    function = _function(expressions, variables)
    skipped = (*_LEAF_OPERATIONS, ca.OP_OUTPUT, ca.OP_PARAMETER)
    return sum(function.instruction_id(i) not in skipped for i in range(function.n_instructions()))


def format_expressions(
    expressions: Sequence[ca.SX], variables: ca.SX, names: Sequence[SymbolName], latex: bool = False
) -> FormulaText:
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
    layouts = _LATEX_TEMPLATES if latex else _TEXT_TEMPLATES
    written: list[tuple[str, int]] = []
    shared: list[tuple[str, str]] = []
    for i, node in enumerate(nodes):
        if node.op == ca.OP_INPUT:
            name = names[node.place]
            written.append((name.latex if latex else name.text, _ATOM))
        elif node.op == ca.OP_CONST:
            written.append((_number(node.value, latex), _SUM if node.value < 0 else _ATOM))
        else:
            text, tightness = _written(node, [written[part] for part in node.parts], layouts, latex)
            simple = node.op == ca.OP_NEG and nodes[node.parts[0]].op in _LEAF_OPERATIONS
            if uses[i] > 1 and not simple:
                name_of = f"c_{{{len(shared) + 1}}}" if latex else f"c{len(shared) + 1}"
                shared.append((name_of, text))
                text, tightness = name_of, _ATOM
            written.append((text, tightness))
    counted = sum(node.op not in _LEAF_OPERATIONS for node in nodes)
    seen = tuple(sorted({node.place for node in nodes if node.op == ca.OP_INPUT}))
    return FormulaText(tuple(shared), tuple(written[r][0] for r in results), counted, seen)


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


def _written(
    node: _Node, parts: list[tuple[str, int]], layouts: dict[int, _OperationTemplate], latex: bool
) -> tuple[str, int]:
    if node.op not in layouts:
        called = _FUNCTION_NAMES[node.op]
        known = called in ("sin", "cos", "tan", "exp", "log", "sinh", "cosh", "tanh", "min", "max")
        arguments = ", ".join(text for text, _ in parts)
        if latex and called == "sqrt":
            return rf"\sqrt{{{arguments}}}", _ATOM
        head = called if not latex else "\\" + called if known else rf"\operatorname{{{called}}}"
        return f"{head}({arguments})", _ATOM
    layout = layouts[node.op]
    if latex and node.op in (ca.OP_DIV, ca.OP_INV) and sum(len(text) for text, _ in parts) > _MAX_FRACTION_LENGTH:
        layout = _TEXT_TEMPLATES[node.op]
    template, tightness, asked = layout
    texts = [text if has >= wants else f"({text})" for (text, has), wants in zip(parts, asked, strict=True)]
    return template.format(*texts), tightness


def _number(value: float, latex: bool) -> str:
    text = f"{value:.12g}"
    mantissa, _, exponent = text.partition("e")
    return rf"{mantissa} \cdot 10^{{{int(exponent)}}}" if latex and exponent else text
