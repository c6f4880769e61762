"""Equations of one step with named rows and columns, and access to single entries by name."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from yid_ocp.analysis.formula_text import FormulaText, SymbolName, count_operations, format_expressions
from yid_ocp.display import ReprMixin, ReprSummary, count_with_noun
from yid_ocp.errors import ConfigError, nearest_name_hint
from yid_ocp.integrator.discrete import DiscreteEquations

_MAX_PRINTED_OPERATIONS = 80  # operations up to which an equation is written out without being asked for
_MAX_LISTED_SYMBOLS = 6  # names of one block that are still listed one by one


@dataclass(frozen=True)
class SymbolBlock:
    """A named block of equations or variables of one kind.

    Attributes
    ----------
    name : str
        Such as `del` or `q1`.
    labels : tuple of str
        One for every entry: a joint, a grasp's equation, an internal coordinate, a parameter.
    expressions : casadi.SX, shape (len(labels), 1)
    meaning : str
        Short description.
    latex_template : str
        LaTeX symbol, with `#` in place of the label.
    """

    name: str
    labels: tuple[str, ...]
    expressions: ca.SX
    meaning: str
    latex_template: str

    @property
    def full_names(self) -> tuple[str, ...]:
        """Full names, `q1[T1_0_x]`; those of parameters and of the time step are their labels."""
        return tuple(label if self.name in ("theta", "time_step") else f"{self.name}[{label}]" for label in self.labels)


@dataclass(frozen=True)
class EquationEntry:
    """One equation of a step, or its derivative by a variable.

    Attributes
    ----------
    row_name, column_name : str
        Full names; no column for the equation itself.
    formula : Formula
    variable_names : tuple of str
        Variables on which it depends, as `StepSymbols.summarize_columns`.
    expression : casadi.SX
    """

    row_name: str
    column_name: str
    formula: FormulaText
    variable_names: tuple[str, ...]
    expression: ca.SX

    @property
    def title(self) -> str:
        """The entry's name as a formula, `d ROW / d COLUMN` for a derivative."""
        return f"d {self.row_name} / d {self.column_name}" if self.column_name else self.row_name

    @property
    def is_zero(self) -> bool:
        """Whether it is zero for every state."""
        return bool(self.expression.is_zero())

    def numeric_value(self, variables: ca.SX, at: NDArray[np.float64]) -> float:
        """Numeric value of the entry.

        Parameters
        ----------
        variables : casadi.SX, shape (k, 1)
            `StepSymbols.column_symbols`.
        at : ndarray, shape (k,)
        """
        return float(ca.Function("value", [variables], [ca.densify(self.expression)])(at))

    @property
    def text_lines(self) -> list[str]:
        """Text lines of the whole expression, its shared parts first."""
        if self.is_zero:
            return [f"{self.title} = 0 whatever the state"]
        said = [_headline(self.title, self.formula.n_operations, self.variable_names)]
        said += [f"  {name} = {text}" for name, text in self.formula.shared_subexpressions]
        return [*said, f"  {self.title} = {self.formula.expression_texts[0]}"]


@dataclass(frozen=True, repr=False)
class StepSymbols(ReprMixin):
    """Equations of one step with named rows and columns.

    Attributes
    ----------
    equations : DiscreteEquations
    row_blocks : tuple of Block
        `del` (DEL equations; at a prescribed coordinate what is left is -h times its effort), `internal`,
        `constraint_residual`, and `p1`, the momentum after the step.
    column_blocks : tuple of Block
        `q0`, `p0`, `z0`, `u`, `theta`, `time_step`, and the unknowns `q1`, `z1`, `lam`.
    """

    equations: DiscreteEquations
    row_blocks: tuple[SymbolBlock, ...]
    column_blocks: tuple[SymbolBlock, ...]

    def _summary(self) -> ReprSummary:
        rows = [("block", "entries", "meaning")]
        rows += [
            (block.name, str(len(block.full_names)), block.meaning) for block in (*self.row_blocks, *self.column_blocks)
        ]
        count = count_with_noun(sum(len(block.full_names) for block in self.row_blocks), "equation")
        return ReprSummary(f"{count} of a step of {self.equations.system.mechanism.name}", rows)

    @staticmethod
    def from_equations(equations: DiscreteEquations) -> StepSymbols:
        """Named rows and columns of a step's equations."""
        e, system = equations, equations.system
        joints, internal = system.mechanism.joint_names, tuple(system.internal_coordinates)
        closed = tuple(name for grasp in system.grasps for name in grasp.equation_names)
        k, after = r"_{k,\,#}", r"_{k+1,\,#}"
        rows = (
            SymbolBlock("del", joints, e.momentum_balance, "DEL equation, balance of momentum", "R" + k),
            SymbolBlock("internal", internal, e.internal_residual, "equation of an internal coordinate", "Z" + k),
            SymbolBlock("constraint", closed, e.constraint_residual, "equation of a grasp", r"\varphi" + after),
            SymbolBlock("p1", joints, e.p1, "momentum after the step", "p" + after),
        )
        columns = (
            SymbolBlock("q0", joints, e.q0, "coordinates before the step", "q" + k),
            SymbolBlock("p0", joints, e.p0, "momenta before the step", "p" + k),
            SymbolBlock("z0", internal, e.z0, "internal coordinates before the step", "z" + k),
            SymbolBlock("u", system.driven, e.u, "commands of servos" if system.servos else "motor torques", "u" + k),
            SymbolBlock("theta", system.parameters.names, e.theta, "parameters", r"\theta_{#}"),
            SymbolBlock("time_step", ("h",), e.time_step, "time step", "h"),
            SymbolBlock("q1", joints, e.q1, "coordinates after the step", "q" + after),
            SymbolBlock("z1", internal, e.z1, "internal coordinates after the step", "z" + after),
            SymbolBlock("lam", closed, e.lam, "multipliers of the grasps", r"\lambda" + k),
        )
        return StepSymbols(equations, rows, columns)

    @property
    def row_names(self) -> tuple[str, ...]:
        """Full names of all rows, in order."""
        return tuple(name for block in self.row_blocks for name in block.full_names)

    @property
    def column_names(self) -> tuple[str, ...]:
        """Full names of all columns, in order."""
        return tuple(name for block in self.column_blocks for name in block.full_names)

    @cached_property
    def row_expressions(self) -> ca.SX:
        """Expressions of all rows, shape (n + nz + m + n, 1)."""
        return ca.vertcat(*(block.expressions for block in self.row_blocks))

    @cached_property
    def column_symbols(self) -> ca.SX:
        """Symbols of all columns, one below the other."""
        return ca.vertcat(*(block.expressions for block in self.column_blocks))

    @cached_property
    def jacobian_pattern(self) -> ca.Sparsity:
        """Sparsity of the Jacobian of all rows by all columns."""
        found: ca.Sparsity = ca.jacobian_sparsity(self.row_expressions, self.column_symbols)
        return found

    @cached_property
    def column_display_names(self) -> tuple[SymbolName, ...]:
        """Text and LaTeX names of all columns, in order."""
        return tuple(
            SymbolName(name, block.latex_template.replace("#", rf"\mathrm{{{escape_latex(label)}}}"))
            for block in self.column_blocks
            for name, label in zip(block.full_names, block.labels, strict=True)
        )

    def block_slice(self, block: str) -> slice:
        """Index range of a block among all rows or among all columns."""
        blocks = self.row_blocks if any(entry.name == block for entry in self.row_blocks) else self.column_blocks
        at = 0
        for entry in blocks:
            if entry.name == block:
                return slice(at, at + len(entry.labels))
            at += len(entry.labels)
        raise KeyError(block)

    def row_index(self, name: str) -> int:
        """Index of a row by its full name; raises `ConfigError` with the nearest name where it does not exist."""
        return _place(name, self.row_names, "row", self.row_blocks)

    def column_index(self, name: str) -> int:
        """Index of a column by its full name; raises `ConfigError` with the nearest name where it does not exist."""
        return _place(name, self.column_names, "column", self.column_blocks)

    def equation_entry(self, text: str) -> EquationEntry:
        """The equation with a given name or, for `ROW, COLUMN`, its derivative by a variable.

        Parameters
        ----------
        text : str
            Such as `del[T1_0_x]`, `del[T1_0_x], q1[T1_0_x]` or `constraint[left.x], T2.length`.

        Raises
        ------
        ConfigError
            Neither one name nor two, or one that does not exist.
        """
        said = [part.strip() for part in text.split(",")]
        if len(said) > 2 or not all(said):
            raise ConfigError(
                f"'{text}' is no entry",
                where="--entry",
                allowed="the name of a row, or of a row and a column with a comma between them",
                hint="--entry 'del[T1_0_x], q1[T1_0_x]'",
            )
        at = self.row_index(said[0])
        expression = self.row_expressions[at]
        if len(said) == 2:
            expression = ca.jacobian(expression, self.column_symbols[self.column_index(said[1])])
        made = format_expressions([expression], self.column_symbols, self.column_display_names)
        column = self.column_names[self.column_index(said[1])] if len(said) == 2 else ""
        return EquationEntry(
            self.row_names[at], column, made, self.summarize_columns(made.variable_indices), expression
        )

    def summarize_columns(self, places: Iterable[int]) -> tuple[str, ...]:
        """Names of columns by index; a block with many of them is abbreviated, `24 of q0`."""
        chosen, names, words = set(places), self.column_names, []
        for block in self.column_blocks:
            span = self.block_slice(block.name)
            inside = [names[i] for i in range(span.start, span.stop) if i in chosen]
            words += inside if len(inside) <= _MAX_LISTED_SYMBOLS else [f"{len(inside)} of {block.name}"]
        return tuple(words)

    def text_lines(self) -> list[str]:
        """Text lines of all equations, short ones in full, then the names of all variables."""
        said = []
        place = {self.column_symbols[i].element_hash(): i for i in range(self.column_symbols.numel())}
        for at, name in enumerate(self.row_names):
            row = self.row_expressions[at]
            count = count_operations([row], self.column_symbols)
            if count <= _MAX_PRINTED_OPERATIONS:
                said += self.equation_entry(name).text_lines
            else:
                used = self.summarize_columns(place[symbol.element_hash()] for symbol in ca.symvar(row))
                said.append(_headline(name, count, used))
        blocks = [block for block in self.column_blocks if block.labels]
        return [
            "equations of one step; `inspect --entry 'NAME'` prints any of them whole, with ', COLUMN' its derivative",
            "",
            *said,
            "",
            *(f"{block.name} ({block.meaning}): {', '.join(block.full_names)}" for block in blocks),
        ]


def escape_latex(name: str) -> str:
    """A name with LaTeX's special characters escaped."""
    return "".join("\\" + letter if letter in "_%#&${}" else letter for letter in name)


def _headline(title: str, count: int, variables: Sequence[str]) -> str:
    return f"{title}: {count} operations, depends on {', '.join(variables) or 'nothing'}"


def _place(name: str, known: tuple[str, ...], kind: str, blocks: tuple[SymbolBlock, ...]) -> int:
    if name in known:
        return known.index(name)
    shapes = [f"{b.name}[{b.labels[0]}]" if b.full_names[0] != b.labels[0] else b.labels[0] for b in blocks if b.labels]
    raise ConfigError(
        f"the equations of a step have no {kind} '{name}'",
        where="--entry",
        allowed=f"{kind}s of these kinds: {', '.join(shapes)}",
        hint=nearest_name_hint(name, known) if len(known) < 12 else _close(name, known, blocks),
    )


def _close(name: str, known: tuple[str, ...], blocks: tuple[SymbolBlock, ...]) -> str:
    """The nearest name: of the same block where the block is right, else of all."""
    block = name.partition("[")[0]
    same = [n for b in blocks if b.name == block for n in b.full_names]
    said = nearest_name_hint(name, same or known)
    return said if said.startswith("did") else "`yid-ocp inspect` lists all names in equations.txt"
