"""The equations of one time step with named rows and columns, and their formulas as text."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca

from yid_ocp.arrays import Array
from yid_ocp.display import ReprMixin, ReprTexts, count_with_noun
from yid_ocp.errors import ConfigError, nearest_name_question
from yid_ocp.integrator.codegen import COMPARISON_OPERATOR_SYMBOLS, resolved_instructions
from yid_ocp.integrator.discrete import DiscreteEquations

# Binding strength of an expression: an operand that binds less than required gets parentheses.
_COMPARISON, _SUM, _PRODUCT, _POWER, _ATOM = range(5)
_LEAF_OPERATIONS = (ca.OP_INPUT, ca.OP_CONST)

# by operation: template, binding strength of the result, required binding strength of each operand
_TEXT_TEMPLATES: dict[int, tuple[str, int, tuple[int, ...]]] = {
    ca.OP_ADD: ("{0} + {1}", _SUM, (_SUM, _SUM)),
    ca.OP_SUB: ("{0} - {1}", _SUM, (_SUM, _PRODUCT)),
    ca.OP_NEG: ("-{0}", _SUM, (_PRODUCT,)),
    ca.OP_MUL: ("{0}*{1}", _PRODUCT, (_PRODUCT, _PRODUCT)),
    ca.OP_DIV: ("{0}/{1}", _PRODUCT, (_PRODUCT, _POWER)),
    ca.OP_TWICE: ("2*{0}", _PRODUCT, (_PRODUCT,)),
    ca.OP_INV: ("1/{0}", _PRODUCT, (_POWER,)),
    ca.OP_SQ: ("{0}^2", _POWER, (_ATOM,)),
    **dict.fromkeys((ca.OP_POW, ca.OP_CONSTPOW), ("{0}^{1}", _POWER, (_ATOM, _ATOM))),
    **{op: (f"{{0}} {sign} {{1}}", _COMPARISON, (_SUM, _SUM)) for op, sign in COMPARISON_OPERATOR_SYMBOLS.items()},
    ca.OP_AND: ("{0} and {1}", _COMPARISON, (_ATOM, _ATOM)),
    ca.OP_OR: ("{0} or {1}", _COMPARISON, (_ATOM, _ATOM)),
    ca.OP_NOT: ("not {0}", _COMPARISON, (_ATOM,)),
    ca.OP_IF_ELSE_ZERO: ("if({0}, {1}, 0)", _ATOM, (_COMPARISON, _COMPARISON)),
    ca.OP_FABS: ("abs({0})", _ATOM, (_COMPARISON,)),
    ca.OP_FMIN: ("min({0}, {1})", _ATOM, (_COMPARISON, _COMPARISON)),
    ca.OP_FMAX: ("max({0}, {1})", _ATOM, (_COMPARISON, _COMPARISON)),
}
_FUNCTION_NAMES = {getattr(ca, name): name.removeprefix("OP_").lower() for name in dir(ca) if name.startswith("OP_")}


@dataclass(frozen=True)
class _FormulaText:
    """Expressions written as text, with their shared subexpressions."""

    shared_subexpressions: tuple[tuple[str, str], ...]  # names and texts; each may use earlier names
    expression_texts: tuple[str, ...]
    n_operations: int  # operations of shared subexpressions count once
    variable_indices: tuple[int, ...]  # indices of the variables that occur


def count_operations(expressions: Sequence[ca.SX], variables: ca.SX) -> int:
    """Count the operations needed to evaluate all expressions of `variables`. Shared subexpressions count once."""
    function = _function(expressions, variables)
    skipped = (*_LEAF_OPERATIONS, ca.OP_OUTPUT, ca.OP_PARAMETER)
    return sum(function.instruction_id(i) not in skipped for i in range(function.n_instructions()))


def format_expressions(expressions: Sequence[ca.SX], variables: ca.SX, names: Sequence[str]) -> _FormulaText:
    """Convert scalar symbolic expressions to text. They contain no symbols but `variables` (k, 1), named by `names`."""
    instructions, results = resolved_instructions(_function(expressions, variables)), [0] * len(expressions)
    uses = Counter(itertools.chain(*(own.inputs for own in instructions if own.code not in _LEAF_OPERATIONS)))
    written, shared = dict[int, tuple[str, int]](), list[tuple[str, str]]()
    for i, own in enumerate(instructions):
        op, parts, value = own.code, own.inputs, own.constant
        if op == ca.OP_OUTPUT:
            results[own.outputs[1]] = parts[0]
        elif op == ca.OP_INPUT:
            written[i] = names[parts[1]], _ATOM
        elif op == ca.OP_CONST:
            written[i] = f"{value:.12g}", _SUM if value < 0 else _ATOM
        else:
            # a function without a template binds like an atom, and its operands stand between commas
            template, tightness, asked = _TEXT_TEMPLATES.get(op, ("", _ATOM, (_COMPARISON,) * len(parts)))
            pairs = zip((written[part] for part in parts), asked, strict=True)
            texts = [text if has >= wants else f"({text})" for (text, has), wants in pairs]
            text = template.format(*texts) if template else f"{_FUNCTION_NAMES[op]}({', '.join(texts)})"
            simple = op == ca.OP_NEG and instructions[parts[0]].code in _LEAF_OPERATIONS
            if uses[i] > 1 and not simple:
                name_of = f"c{len(shared) + 1}"
                shared.append((name_of, text))
                text, tightness = name_of, _ATOM
            written[i] = text, tightness
    counted = sum(own.code not in (*_LEAF_OPERATIONS, ca.OP_OUTPUT) for own in instructions)
    seen = tuple(sorted({own.inputs[1] for own in instructions if own.code == ca.OP_INPUT}))
    return _FormulaText(tuple(shared), tuple(written[r][0] for r in results), counted, seen)


def _function(expressions: Sequence[ca.SX], variables: ca.SX) -> ca.Function:
    return ca.Function("formula", [variables], [ca.cse(ca.densify(ca.vertcat(*expressions)))])


_MAX_PRINTED_OPERATIONS = 80  # longer equations are printed only on request
_MAX_LISTED_SYMBOLS = 6  # names of one block up to which each is listed


@dataclass(frozen=True)
class _SymbolBlock:
    """A named block of equations or variables of one kind, as a symbolic column (k, 1)."""

    name: str
    labels: tuple[str, ...]  # by row: name of a joint, grasp equation, internal coordinate or parameter
    expressions: ca.SX
    meaning: str

    @property
    def full_names(self) -> tuple[str, ...]:
        """Full names such as `q1[T1_0_x]`. For parameters and the time step they are the labels."""
        return tuple(label if self.name in ("theta", "time_step") else f"{self.name}[{label}]" for label in self.labels)


@dataclass(frozen=True)
class EquationOrDerivativeFormula:
    """The formula of one step equation or, if `column_name` is set, of its derivative with respect to that variable."""

    row_name: str
    column_name: str
    formula: _FormulaText
    variable_names: tuple[str, ...]
    expression: ca.SX

    @property
    def title(self) -> str:
        """The name of the equation, or `d ROW / d COLUMN` for a derivative."""
        return f"d {self.row_name} / d {self.column_name}" if self.column_name else self.row_name

    @property
    def is_identically_zero(self) -> bool:
        """True if the expression is zero for all values of the variables."""
        return bool(self.expression.is_zero())

    def evaluate_numerically(self, variables: ca.SX, at: Array) -> float:
        """Compute the expression for the values `at` (k,) of the symbols `variables` (k, 1)."""
        return float(ca.Function("value", [variables], [ca.densify(self.expression)])(at))

    @property
    def text_lines(self) -> list[str]:
        """The lines of text that show the whole formula, with shared subexpressions first."""
        if self.is_identically_zero:
            return [f"{self.title} = 0 for every state"]
        said = [_headline(self.title, self.formula.n_operations, self.variable_names)]
        said += [f"  {name} = {text}" for name, text in self.formula.shared_subexpressions]
        return [*said, f"  {self.title} = {self.formula.expression_texts[0]}"]


@dataclass(frozen=True, repr=False)
class NamedStepEquations(ReprMixin):
    """The symbolic equations of one time step, with a name for each row (equation) and column (variable).

    The row blocks are `del` (discrete Euler-Lagrange equations; at a prescribed coordinate the residual is -h times its
    effort, with the time step h), `internal`, `constraint`, and `p1` (momentum after the step). The column blocks are
    `q0`, `p0`, `z0`, `u`, `theta`, `time_step` and the unknowns `q1`, `z1`, `lam`. Each has a `meaning`.
    """

    equations: DiscreteEquations
    row_blocks: tuple[_SymbolBlock, ...]
    column_blocks: tuple[_SymbolBlock, ...]

    def _summary(self) -> ReprTexts:
        blocks = (*self.row_blocks, *self.column_blocks)
        rows = [("block", "entries", "meaning"), *((b.name, str(len(b.full_names)), b.meaning) for b in blocks)]
        count = count_with_noun(sum(len(block.full_names) for block in self.row_blocks), "equation")
        return ReprTexts(f"{count} of a step of {self.equations.system.mechanism.name}", rows)

    @staticmethod
    def from_equations(equations: DiscreteEquations) -> NamedStepEquations:
        """Name the rows and columns of the discrete equations of a step after joints, grasps and parameters."""
        e, system = equations, equations.system
        joints, internal = system.mechanism.joint_names, tuple(system.effect_internal_coordinate_symbols)
        closed = tuple(name for grasp in system.grasps for name in grasp.constraint_equation_names)
        rows = (
            _SymbolBlock("del", joints, e.momentum_balance, "discrete Euler-Lagrange equation, balance of momentum"),
            _SymbolBlock("internal", internal, e.internal_residual, "equation of an internal coordinate"),
            _SymbolBlock("constraint", closed, e.constraint_residual, "equation of a grasp"),
            _SymbolBlock("p1", joints, e.p1, "momentum after the step"),
        )
        columns = (
            _SymbolBlock("q0", joints, e.q0, "coordinates before the step"),
            _SymbolBlock("p0", joints, e.p0, "momenta before the step"),
            _SymbolBlock("z0", internal, e.z0, "internal coordinates before the step"),
            _SymbolBlock("u", system.driven, e.u, "commands of servos" if system.servos else "motor torques"),
            _SymbolBlock("theta", system.parameters.names, e.theta, "parameters"),
            _SymbolBlock("time_step", ("h",), e.time_step, "time step"),
            _SymbolBlock("q1", joints, e.q1, "coordinates after the step"),
            _SymbolBlock("z1", internal, e.z1, "internal coordinates after the step"),
            _SymbolBlock("lam", closed, e.lam, "multipliers of the grasps"),
        )
        return NamedStepEquations(equations, rows, columns)

    @property
    def row_names(self) -> tuple[str, ...]:
        """The full names of all equations, in order."""
        return tuple(name for block in self.row_blocks for name in block.full_names)

    @property
    def all_variable_names(self) -> tuple[str, ...]:
        """The full names of all variables, in order."""
        return tuple(name for block in self.column_blocks for name in block.full_names)

    @cached_property
    def _row_expressions(self) -> ca.SX:
        return ca.vertcat(*(block.expressions for block in self.row_blocks))

    @cached_property
    def all_variable_symbols(self) -> ca.SX:
        """The symbols of all variables, as one column vector."""
        return ca.vertcat(*(block.expressions for block in self.column_blocks))

    @cached_property
    def full_jacobian_sparsity_pattern(self) -> ca.Sparsity:
        """The sparsity of the Jacobian of all equations with respect to all variables."""
        found: ca.Sparsity = ca.jacobian_sparsity(self._row_expressions, self.all_variable_symbols)
        return found

    def row_or_column_block_slice(self, block: str) -> slice:
        """Return the index range of a named block among all rows or columns."""
        blocks = self.row_blocks if any(entry.name == block for entry in self.row_blocks) else self.column_blocks
        ends = list(itertools.accumulate((len(entry.labels) for entry in blocks), initial=0))
        at = [entry.name for entry in blocks].index(block)
        return slice(ends[at], ends[at + 1])

    def equation_or_derivative_by_name(self, text: str) -> EquationOrDerivativeFormula:
        """Return the equation with a given name or, for `ROW, COLUMN`, its derivative with respect to a variable.

        Examples of `text`: `del[T1_0_x]`, `del[T1_0_x], q1[T1_0_x]`, `constraint[left.x], T2.length`. Raises
        `ConfigError` if there are not one or two names, or if a name does not exist.
        """
        said = [part.strip() for part in text.split(",")]
        if len(said) > 2 or not all(said):
            allowed = "ROW (an equation), or ROW, COLUMN (its derivative by a variable)"
            hint = "write for example --entry 'del[T1_0_x], q1[T1_0_x]'"
            what = f"'{text}' is neither one name nor two names with a comma"
            raise ConfigError(what, where="--entry", allowed=allowed, hint=hint)
        row, column = _place(said[0], self.row_names, "row", self.row_blocks), ""
        expression = self._row_expressions[row]
        if len(said) == 2:
            at = _place(said[1], self.all_variable_names, "column", self.column_blocks)
            expression, column = ca.jacobian(expression, self.all_variable_symbols[at]), self.all_variable_names[at]
        made = format_expressions([expression], self.all_variable_symbols, self.all_variable_names)
        used = self._summarize_columns(made.variable_indices)
        return EquationOrDerivativeFormula(self.row_names[row], column, made, used, expression)

    def _summarize_columns(self, places: Iterable[int]) -> tuple[str, ...]:
        """Return the names of columns by index. Many names of one block are abbreviated, such as `24 of q0`."""
        chosen, names, words = set(places), self.all_variable_names, []
        for block in self.column_blocks:
            span = self.row_or_column_block_slice(block.name)
            inside = [names[i] for i in range(span.start, span.stop) if i in chosen]
            words += inside if len(inside) <= _MAX_LISTED_SYMBOLS else [f"{len(inside)} of {block.name}"]
        return tuple(words)

    def text_lines(self) -> list[str]:
        """Return all equations, then all variable names, as lines of text. Long equations are only summarised."""
        said = []
        place = {self.all_variable_symbols[i].element_hash(): i for i in range(self.all_variable_symbols.numel())}
        for at, name in enumerate(self.row_names):
            row = self._row_expressions[at]
            count = count_operations([row], self.all_variable_symbols)
            if count <= _MAX_PRINTED_OPERATIONS:
                said += self.equation_or_derivative_by_name(name).text_lines
            else:
                used = self._summarize_columns(place[symbol.element_hash()] for symbol in ca.symvar(row))
                said.append(_headline(name, count, used))
        whole = "`yid-ocp inspect FILE --entry 'ROW'` prints one in full, `--entry 'ROW, COLUMN'` its derivative"
        blocks = [block for block in self.column_blocks if block.labels]
        names = (f"{b.name} ({b.meaning}): {', '.join(b.full_names)}" for b in blocks)
        return [f"equations of one step; {whole}", "", *said, "", *names]


def _headline(title: str, count: int, variables: Sequence[str]) -> str:
    return f"{title}: {count} operations, depends on {', '.join(variables) or 'nothing'}"


def _place(name: str, known: tuple[str, ...], kind: str, blocks: tuple[_SymbolBlock, ...]) -> int:
    """Return the index of a row or column by its full name. Raises `ConfigError`, with the nearest name, if unknown."""
    if name in known:
        return known.index(name)
    shapes = [f"{b.full_names[0]} ({b.meaning})" for b in blocks if b.labels]
    # of the same block, if the block exists
    same = tuple(n for b in blocks if b.name == name.partition("[")[0] for n in b.full_names)
    hint = nearest_name_question(name, known if len(known) < 12 else same or known)
    hint = hint or "leave --entry out: equations.txt of `yid-ocp inspect` has all names"
    allowed = f"{kind}s such as {', '.join(shapes)}"
    raise ConfigError(f"the equations of a step have no {kind} '{name}'", where="--entry", allowed=allowed, hint=hint)
