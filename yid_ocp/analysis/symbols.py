"""Equations of one step with named rows and columns, and access to single entries by name."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from yid_ocp.analysis.formulas import Formula, Name, formula, operations
from yid_ocp.errors import ConfigError, nearest
from yid_ocp.integrator.discrete import DiscreteEquations
from yid_ocp.shown import Shown, Summary, counted

SHORT = 80  # operations up to which an equation is written out without being asked for
MANY = 6  # names of one block that are still listed one by one


@dataclass(frozen=True)
class Block:
    """A named block of equations or variables of one kind.

    Attributes
    ----------
    name : str
        Such as `del` or `q1`.
    labels : tuple of str
        One for every entry: a joint, a grasp's equation, an internal coordinate, a parameter.
    values : casadi.SX, shape (len(labels), 1)
    meaning : str
        Short description.
    letter : str
        LaTeX symbol, with `#` in place of the label.
    """

    name: str
    labels: tuple[str, ...]
    values: ca.SX
    meaning: str
    letter: str

    @property
    def names(self) -> tuple[str, ...]:
        """Full names, `q1[T1_0_x]`; those of parameters and of the time step are their labels."""
        return tuple(label if self.name in ("theta", "time_step") else f"{self.name}[{label}]" for label in self.labels)


@dataclass(frozen=True)
class Entry:
    """One equation of a step, or its derivative by a variable.

    Attributes
    ----------
    row, column : str
        Full names; no column for the equation itself.
    formula : Formula
    variables : tuple of str
        Variables on which it depends, as `StepSymbols.grouped`.
    expression : casadi.SX
    """

    row: str
    column: str
    formula: Formula
    variables: tuple[str, ...]
    expression: ca.SX

    @property
    def title(self) -> str:
        """The entry's name as a formula, `d ROW / d COLUMN` for a derivative."""
        return f"d {self.row} / d {self.column}" if self.column else self.row

    @property
    def zero(self) -> bool:
        """Whether it is zero for every state."""
        return bool(self.expression.is_zero())

    def value(self, variables: ca.SX, at: NDArray[np.float64]) -> float:
        """Numeric value of the entry.

        Parameters
        ----------
        variables : casadi.SX, shape (k, 1)
            `StepSymbols.all_columns`.
        at : ndarray, shape (k,)
        """
        return float(ca.Function("value", [variables], [ca.densify(self.expression)])(at))

    @property
    def lines(self) -> list[str]:
        """Text lines of the whole expression, its shared parts first."""
        if self.zero:
            return [f"{self.title} = 0 whatever the state"]
        said = [_headline(self.title, self.formula.operations, self.variables)]
        said += [f"  {name} = {text}" for name, text in self.formula.shared]
        return [*said, f"  {self.title} = {self.formula.values[0]}"]


@dataclass(frozen=True, repr=False)
class StepSymbols(Shown):
    """Equations of one step with named rows and columns.

    Attributes
    ----------
    equations : DiscreteEquations
    rows : tuple of Block
        `del` (DEL equations; at a prescribed coordinate what is left is -h times its effort), `internal`,
        `constraint`, and `p1`, the momentum after the step.
    columns : tuple of Block
        `q0`, `p0`, `z0`, `u`, `theta`, `time_step`, and the unknowns `q1`, `z1`, `lam`.
    """

    equations: DiscreteEquations
    rows: tuple[Block, ...]
    columns: tuple[Block, ...]

    def _summary(self) -> Summary:
        rows = [("block", "entries", "meaning")]
        rows += [(block.name, str(len(block.names)), block.meaning) for block in (*self.rows, *self.columns)]
        count = counted(sum(len(block.names) for block in self.rows), "equation")
        return Summary(f"{count} of a step of {self.equations.system.mechanism.name}", rows)

    @staticmethod
    def of(equations: DiscreteEquations) -> StepSymbols:
        """Named rows and columns of a step's equations."""
        e, system = equations, equations.system
        joints, internal = system.mechanism.joint_names, tuple(system.internal)
        closed = tuple(name for grasp in system.grasps for name in grasp.equation_names)
        k, after = r"_{k,\,#}", r"_{k+1,\,#}"
        rows = (
            Block("del", joints, e.momentum_balance, "DEL equation, balance of momentum", "R" + k),
            Block("internal", internal, e.internal, "equation of an internal coordinate", "Z" + k),
            Block("constraint", closed, e.constraint, "equation of a grasp", r"\varphi" + after),
            Block("p1", joints, e.p1, "momentum after the step", "p" + after),
        )
        columns = (
            Block("q0", joints, e.q0, "coordinates before the step", "q" + k),
            Block("p0", joints, e.p0, "momenta before the step", "p" + k),
            Block("z0", internal, e.z0, "internal coordinates before the step", "z" + k),
            Block("u", system.driven, e.u, "commands of servos" if system.servos else "motor torques", "u" + k),
            Block("theta", system.parameters.names, e.theta, "parameters", r"\theta_{#}"),
            Block("time_step", ("h",), e.time_step, "time step", "h"),
            Block("q1", joints, e.q1, "coordinates after the step", "q" + after),
            Block("z1", internal, e.z1, "internal coordinates after the step", "z" + after),
            Block("lam", closed, e.lam, "multipliers of the grasps", r"\lambda" + k),
        )
        return StepSymbols(equations, rows, columns)

    @property
    def row_names(self) -> tuple[str, ...]:
        """Full names of all rows, in order."""
        return tuple(name for block in self.rows for name in block.names)

    @property
    def column_names(self) -> tuple[str, ...]:
        """Full names of all columns, in order."""
        return tuple(name for block in self.columns for name in block.names)

    @cached_property
    def all_rows(self) -> ca.SX:
        """Expressions of all rows, shape (n + nz + m + n, 1)."""
        return ca.vertcat(*(block.values for block in self.rows))

    @cached_property
    def all_columns(self) -> ca.SX:
        """Symbols of all columns, one below the other."""
        return ca.vertcat(*(block.values for block in self.columns))

    @cached_property
    def pattern(self) -> ca.Sparsity:
        """Sparsity of the Jacobian of all rows by all columns."""
        found: ca.Sparsity = ca.jacobian_sparsity(self.all_rows, self.all_columns)
        return found

    @cached_property
    def names(self) -> tuple[Name, ...]:
        """Text and LaTeX names of all columns, in order."""
        return tuple(
            Name(name, block.letter.replace("#", rf"\mathrm{{{latex_text(label)}}}"))
            for block in self.columns
            for name, label in zip(block.names, block.labels, strict=True)
        )

    def span(self, block: str) -> slice:
        """Index range of a block among all rows or among all columns."""
        blocks = self.rows if any(entry.name == block for entry in self.rows) else self.columns
        at = 0
        for entry in blocks:
            if entry.name == block:
                return slice(at, at + len(entry.labels))
            at += len(entry.labels)
        raise KeyError(block)

    def row(self, name: str) -> int:
        """Index of a row by its full name; raises `ConfigError` with the nearest name where it does not exist."""
        return _place(name, self.row_names, "row", self.rows)

    def column(self, name: str) -> int:
        """Index of a column by its full name; raises `ConfigError` with the nearest name where it does not exist."""
        return _place(name, self.column_names, "column", self.columns)

    def entry(self, text: str) -> Entry:
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
        at = self.row(said[0])
        expression = self.all_rows[at]
        if len(said) == 2:
            expression = ca.jacobian(expression, self.all_columns[self.column(said[1])])
        made = formula([expression], self.all_columns, self.names)
        column = self.column_names[self.column(said[1])] if len(said) == 2 else ""
        return Entry(self.row_names[at], column, made, self.grouped(made.variables), expression)

    def grouped(self, places: Iterable[int]) -> tuple[str, ...]:
        """Names of columns by index; a block with many of them is abbreviated, `24 of q0`."""
        chosen, names, words = set(places), self.column_names, []
        for block in self.columns:
            span = self.span(block.name)
            inside = [names[i] for i in range(span.start, span.stop) if i in chosen]
            words += inside if len(inside) <= MANY else [f"{len(inside)} of {block.name}"]
        return tuple(words)

    def lines(self) -> list[str]:
        """Text lines of all equations, short ones in full, then the names of all variables."""
        said = []
        place = {self.all_columns[i].element_hash(): i for i in range(self.all_columns.numel())}
        for at, name in enumerate(self.row_names):
            row = self.all_rows[at]
            count = operations([row], self.all_columns)
            if count <= SHORT:
                said += self.entry(name).lines
            else:
                used = self.grouped(place[symbol.element_hash()] for symbol in ca.symvar(row))
                said.append(_headline(name, count, used))
        blocks = [block for block in self.columns if block.labels]
        return [
            "equations of one step; `inspect --entry 'NAME'` prints any of them whole, with ', COLUMN' its derivative",
            "",
            *said,
            "",
            *(f"{block.name} ({block.meaning}): {', '.join(block.names)}" for block in blocks),
        ]


def latex_text(name: str) -> str:
    """A name with LaTeX's special characters escaped."""
    return "".join("\\" + letter if letter in "_%#&${}" else letter for letter in name)


def _headline(title: str, count: int, variables: Sequence[str]) -> str:
    return f"{title}: {count} operations, depends on {', '.join(variables) or 'nothing'}"


def _place(name: str, known: tuple[str, ...], kind: str, blocks: tuple[Block, ...]) -> int:
    if name in known:
        return known.index(name)
    shapes = [f"{b.name}[{b.labels[0]}]" if b.names[0] != b.labels[0] else b.labels[0] for b in blocks if b.labels]
    raise ConfigError(
        f"the equations of a step have no {kind} '{name}'",
        where="--entry",
        allowed=f"{kind}s of these kinds: {', '.join(shapes)}",
        hint=nearest(name, known) if len(known) < 12 else _close(name, known, blocks),
    )


def _close(name: str, known: tuple[str, ...], blocks: tuple[Block, ...]) -> str:
    """The nearest name: of the same block where the block is right, else of all."""
    block = name.partition("[")[0]
    same = [n for b in blocks if b.name == block for n in b.names]
    said = nearest(name, same or known)
    return said if said.startswith("did") else "`yid-ocp inspect` lists all names in equations.txt"
