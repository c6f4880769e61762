"""A nonlinear program in CasADi, made of functions at many places, with their derivatives placed by hand.

    min f(w, p)   subject to   lower <= w <= upper,   g_lower <= g(w, p) <= g_upper

f is half the sum of squares (or Huber's loss) of residuals, g the values of constraint terms, and each is one function
mapped over its places in w. The derivatives of that function, once for all places, are placed into the program's:
CasADi would find the same ones by colouring the whole band, in many times the time. Nothing here knows mechanics or
recordings.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from yid_ocp.errors import SolverError, nearest
from yid_ocp.integrator.compiler import compiled_function
from yid_ocp.parallel import SYMBOLIC, Once

Array = NDArray[np.float64]
Places = NDArray[np.int64]
Hessian = Literal["gauss_newton", "exact"]


@dataclass(frozen=True)
class Block:
    """A named part of a vector.

    Attributes
    ----------
    index : ndarray of int, shape (rows, columns)
        Places in the vector.
    rows : tuple of str
        Name of every row.
    unit : str
    """

    index: Places
    rows: tuple[str, ...]
    unit: str = ""


class Local:
    """A function y(v; d, s) of local variables v, data d and data s that all places share, with its derivatives.

    Parameters
    ----------
    name : str
    inputs : sequence of casadi.SX
        (v, d, s), columns.
    value : casadi.SX, shape (ny, 1)
    jacobian : casadi.SX, shape (ny, nv), optional
        dy/dv; differentiated from the value when absent.
    use_compiler : bool
        Whether the derivatives are compiled where that is possible; the value stays CasADi's own, so that whoever
        builds upon it can differentiate it.
    """

    def __init__(
        self,
        name: str,
        inputs: Sequence[ca.SX],
        value: ca.SX,
        jacobian: ca.SX | None = None,
        use_compiler: bool = False,
    ) -> None:
        self.name, self._inputs, self._expression, self._use_compiler = name, list(inputs), value, use_compiler
        self.value = ca.Function(name, self._inputs, [value])
        slopes = ca.jacobian(value, inputs[0]) if jacobian is None else jacobian
        self.jacobian = self._compiled(ca.Function(f"{name}_slope", self._inputs, ca.cse([ca.sparsify(slopes)])))
        self._curvature: Once[None, ca.Function | None] = Once(lambda _: self._curved())

    @property
    def curvature(self) -> ca.Function | None:
        """Second derivative of weight . y by v at (v, d, s, weight), sparse; None where y is linear."""
        return self._curvature(None)

    def _compiled(self, function: ca.Function) -> ca.Function:
        return compiled_function(function) if self._use_compiler else function

    def _curved(self) -> ca.Function | None:
        """One product with a direction, for each colour of the pattern: the whole would be millions of operations."""
        v, weight = self._inputs[0], ca.SX.sym("weight", self._expression.numel())
        gradient = ca.gradient(ca.dot(weight, self._expression), v)
        pattern = ca.jacobian_sparsity(gradient, v)
        if not pattern.nnz():
            return None
        direction = ca.SX.sym("direction", v.numel())
        product = ca.cse([ca.densify(ca.jtimes(gradient, v, direction))])
        times = self._compiled(ca.Function(f"{self.name}_product", [*self._inputs, weight, direction], product))
        group = pattern.uni_coloring()
        colour = np.zeros(v.numel(), int)
        members, column = group.get_triplet()
        colour[members] = column
        row, column = (np.array(x) for x in pattern.get_triplet())
        symbols = [ca.MX.sym(f"a{i}", times.sparsity_in(i)) for i in range(4)]
        columns = times.map(f"{self.name}_products", "serial", group.size2(), [0, 1, 2, 3], [])
        products = ca.vec(columns(*symbols, ca.DM(group, 1.0)))
        entries = products[(row + v.numel() * colour[column]).tolist()]
        return ca.Function(f"{self.name}_curvature", symbols, [ca.MX(pattern, entries)])


@dataclass(frozen=True)
class Term:
    """One function at K places of a program.

    Attributes
    ----------
    name : str
    rows : tuple of str
        Names of the ny outputs.
    local : Local
    places : ndarray of int, shape (K, nv)
        Where the local variables of every place stand among the unknowns; none twice in a row.
    data : ndarray of int, shape (K, nd)
        Where its data stand among the parameters.
    shared : ndarray of int, shape (ns,)
        Where the data stand that all places share.
    """

    name: str
    rows: tuple[str, ...]
    local: Local
    places: Places
    data: Places
    shared: Places

    @property
    def size(self) -> int:
        """Number of values at all places."""
        return len(self.rows) * len(self.places)

    def arguments(self, w: ca.MX, p: ca.MX) -> tuple[ca.MX, ca.MX, ca.MX]:
        """Local variables (nv, K), data (nd, K) and shared data (ns, 1)."""

        def gathered(vector: ca.MX, index: Places) -> ca.MX:
            return ca.reshape(vector[index.ravel().tolist()], index.shape[1], index.shape[0])

        return gathered(w, self.places), gathered(p, self.data), p[self.shared.tolist()]

    def mapped(self, function: ca.Function, *arguments: ca.MX) -> ca.MX:
        """A function of the local ones at every place, its results side by side."""
        return function.map(f"{function.name()}_{len(self.places)}", "serial", len(self.places), [2], [])(*arguments)

    def values(self, w: ca.MX, p: ca.MX) -> ca.MX:
        """Values place by place, shape (ny K, 1)."""
        return ca.vec(self.mapped(self.local.value, *self.arguments(w, p)))

    def entries(self, w: ca.MX, p: ca.MX) -> ca.MX:
        """Entries of the Jacobian, in the order of `slots`."""
        return nonzeros(self.mapped(self.local.jacobian, *self.arguments(w, p)))

    def slots(self) -> tuple[Places, Places]:
        """Row and column of the entries of the Jacobian."""
        row, column = (np.array(x, np.int64) for x in self.local.jacobian.sparsity_out(0).get_triplet())
        first = len(self.rows) * np.arange(len(self.places))[:, None]
        return (first + row).ravel(), self.places[:, column].ravel()

    def curvature(self, w: ca.MX, p: ca.MX, weight: ca.MX) -> tuple[ca.MX, Places, Places] | None:
        """Second derivative of weight . values: entries, rows and columns, which may repeat; None where it is zero."""
        function = self.local.curvature
        if function is None:
            return None
        weights = ca.reshape(weight, len(self.rows), len(self.places))
        entries = nonzeros(self.mapped(function, *self.arguments(w, p), weights))
        row, column = (np.array(x, np.int64) for x in function.sparsity_out(0).get_triplet())
        return entries, self.places[:, row].ravel(), self.places[:, column].ravel()


@dataclass(frozen=True)
class Residual:
    """Weighted differences of combined values and data: r = weight (combination values - target).

    Attributes
    ----------
    term : Term
    combination : casadi.DM, shape (nr, ny K), or None
        None takes the values as they are.
    weight, target : ndarray of int, shape (nr,), or None
        Where they stand among the parameters; None for ones and for zeros.
    threshold : float
        Beyond which Huber's loss is linear.
    """

    term: Term
    combination: ca.DM | None = None
    weight: Places | None = None
    target: Places | None = None
    threshold: float = math.inf

    @property
    def size(self) -> int:
        """Number of residuals."""
        return self.term.size if self.combination is None else self.combination.size1()

    def by_values(self, p: ca.MX) -> ca.MX | None:
        """dr/dvalues, sparse; None for the identity."""
        if self.combination is None and self.weight is None:
            return None
        combination = ca.DM.eye(self.size) if self.combination is None else self.combination
        if self.weight is None:
            return ca.MX(combination)
        row, _ = combination.sparsity().get_triplet()
        factors = p[self.weight[np.array(row, int)].tolist()]
        return ca.MX(combination.sparsity(), factors * ca.MX(ca.DM(combination.nonzeros())))

    def values(self, w: ca.MX, p: ca.MX) -> ca.MX:
        """r, shape (nr, 1)."""
        matrix, value = self.by_values(p), self.term.values(w, p)
        result = value if matrix is None else ca.mtimes(matrix, value)
        if self.target is None:
            return result
        target = p[self.target.tolist()]
        return result - (target if self.weight is None else p[self.weight.tolist()] * target)

    def jacobian(self, w: ca.MX, p: ca.MX) -> ca.MX:
        """dr/dw, shape (nr, nw), sparse."""
        placed = assembled(self.term.entries(w, p), *self.term.slots(), (self.term.size, w.numel()))
        matrix = self.by_values(p)
        return placed if matrix is None else ca.mtimes(matrix, placed)

    def loss(self, r: ca.MX) -> ca.MX:
        """Half the sum of squares, or Huber's loss."""
        if math.isinf(self.threshold):
            return ca.sumsqr(r) / 2
        size, limit = ca.fabs(r), self.threshold
        return ca.sum1(ca.if_else(size <= limit, r**2 / 2, limit * (size - limit / 2)))

    def pull(self, r: ca.MX) -> ca.MX:
        """Derivative of the loss by r."""
        return r if math.isinf(self.threshold) else ca.fmax(ca.fmin(r, self.threshold), -self.threshold)

    def slope_weight(self, r: ca.MX) -> ca.MX | None:
        """Factor on the squares in Gauss-Newton's Hessian; None for ones."""
        return None if math.isinf(self.threshold) else ca.fmin(1.0, self.threshold / ca.fmax(ca.fabs(r), 1e-300))


@dataclass(frozen=True)
class Ridge:
    """Curvature added to Gauss-Newton's Hessian: factor * mean square residual / max(|w_i|, scale_i)^2.

    Along unknowns that the data hardly inform the curvature that Gauss-Newton leaves out may be as large as its own.
    """

    index: Places
    scale: Array
    factor: float


@dataclass(frozen=True)
class Extra:
    """A user's own part of a program: a term of the objective, rows of the constraints, or both."""

    objective: ca.MX
    constraints: ca.MX
    lower: Array
    upper: Array


def nonzeros(matrix: ca.MX) -> ca.MX:
    """Entries of a sparse expression as a column."""
    return ca.MX(ca.Sparsity.dense(matrix.nnz(), 1), matrix.nz[:])


def assembled(entries: ca.MX, row: Places, column: Places, shape: tuple[int, int]) -> ca.MX:
    """A sparse matrix from its entries, each at a place of its own."""
    order = np.lexsort((row, column))
    start = np.concatenate([[0], np.cumsum(np.bincount(column, minlength=shape[1]))])
    sparsity = ca.Sparsity(*shape, start.tolist(), row[order].tolist())
    return ca.MX(sparsity, entries[order.tolist()])


def summed(entries: ca.MX, row: Places, column: Places, size: int) -> ca.MX:
    """A sparse square matrix from entries that share places."""
    keys, place = np.unique(column * size + row, return_inverse=True)
    start = np.concatenate([[0], np.cumsum(np.bincount(keys // size, minlength=size))])
    sparsity = ca.Sparsity(size, size, start.tolist(), (keys % size).tolist())
    # one column for every entry, its only row being where it goes
    columns = ca.Sparsity(len(keys), len(place), list(range(len(place) + 1)), place.ravel().tolist())
    return ca.MX(sparsity, ca.mtimes(ca.MX(ca.DM(columns, 1.0)), entries))


@dataclass(frozen=True, eq=False)
class NonlinearProgram:
    """min f(w, p) subject to bounds and constraints, in CasADi.

    `nlp[name]` is a block of `variables` or `parameters` as MX of its shape; where there is one recording, `nlp["q"]`
    stands for `nlp["q[NAME]"]`.

    Attributes
    ----------
    variables, parameters : mapping of str to Block
        What `w` and `p` are made of.
    constraints : tuple of Term
        Equalities, one below the other in `g`.
    residuals : tuple of Residual
        Their losses make the objective.
    lower, upper : ndarray, shape (nw,)
        Bounds of `w`.
    start : ndarray, shape (nw,)
        Guess of `w`.
    values : ndarray, shape (np,)
        Of `p`.
    ridge : Ridge or None
    w, p : casadi.MX
        Unknowns and parameters, columns.
    extras : tuple of Extra
        What `adding` added.
    """

    variables: Mapping[str, Block]
    parameters: Mapping[str, Block]
    constraints: tuple[Term, ...]
    residuals: tuple[Residual, ...]
    lower: Array
    upper: Array
    start: Array
    values: Array
    ridge: Ridge | None
    w: ca.MX
    p: ca.MX
    extras: tuple[Extra, ...] = ()
    _kept: dict[str, Any] = field(default_factory=dict, repr=False)

    # -- what it is made of -------------------------------------------------------------------------------------------

    def block(self, name: str) -> Block:
        """A block by its name, or by what comes before the recording's name where there is one recording.

        Raises
        ------
        SolverError
            There is none, or more than one.
        """
        blocks = {**self.variables, **self.parameters}
        if name in blocks:
            return blocks[name]
        alike = [key for key in blocks if key.startswith(f"{name}[")]
        if len(alike) == 1:
            return blocks[alike[0]]
        raise SolverError(f"the program has {len(alike)} blocks '{name}'", hint=nearest(name, alike or blocks))

    def __getitem__(self, name: str) -> ca.MX:
        """See the class."""
        block = self.block(name)
        vector = self.w if any(block is own for own in self.variables.values()) else self.p
        return ca.reshape(vector[block.index.T.ravel().tolist()], *block.index.shape)

    def names(self) -> tuple[str, ...]:
        """Name of every unknown: block, row and column."""
        named = np.full(self.w.numel(), "", dtype=object)
        for name, block in self.variables.items():
            for row, places in zip(block.rows, block.index, strict=True):
                several = len(places) > 1
                named[places] = [f"{name}.{row}.{k}" if several else f"{name}.{row}" for k in range(len(places))]
        return tuple(named)

    def row_names(self) -> tuple[str, ...]:
        """Name of every row of `g`: term, row and place; `added.I` for those of `adding`."""
        terms = [f"{t.name}.{row}.{k}" for t in self.constraints for k in range(len(t.places)) for row in t.rows]
        return (*terms, *(f"added.{i}" for i in range(sum(len(extra.lower) for extra in self.extras))))

    @property
    def f(self) -> ca.MX:
        """Objective."""
        return self._once("f", lambda: sum((self._loss(i) for i in range(len(self.residuals))), ca.MX(0)) + self._own())

    @property
    def g(self) -> ca.MX:
        """Constraints, shape (ng, 1)."""

        def made() -> ca.MX:
            terms = (term.values(self.w, self.p) for term in self.constraints)
            return ca.vertcat(ca.MX(0, 1), *terms, *(extra.constraints for extra in self.extras))

        return self._once("g", made)

    @property
    def nlp(self) -> dict[str, ca.MX]:
        """The program as `casadi.nlpsol` takes it."""
        return {"x": self.w, "p": self.p, "f": self.f, "g": self.g}

    @property
    def arguments(self) -> dict[str, Array]:
        """What a solver of it is called with: guess, parameters and bounds."""
        zero = np.zeros(sum(term.size for term in self.constraints))
        low, high = ([zero, *(getattr(extra, side) for extra in self.extras)] for side in ("lower", "upper"))
        bounds = {"lbx": self.lower, "ubx": self.upper, "lbg": np.concatenate(low), "ubg": np.concatenate(high)}
        return {"x0": self.start, "p": self.values, **bounds}

    # -- derivatives --------------------------------------------------------------------------------------------------

    @property
    def residual(self) -> ca.MX:
        """All residuals, shape (nr, 1)."""
        parts = (self._residual(i) for i in range(len(self.residuals)))
        return self._once("r", lambda: ca.vertcat(ca.MX(0, 1), *parts))

    @property
    def jac_r(self) -> ca.MX:
        """dr/dw, sparse."""
        parts = (self._slope(i) for i in range(len(self.residuals)))
        return self._once("jac_r", lambda: ca.vertcat(ca.MX(0, self.w.numel()), *parts))

    @property
    def jac_g(self) -> ca.MX:
        """dg/dw, sparse."""
        return self._once("jac_g", self._jacobian)

    @property
    def grad_f(self) -> ca.MX:
        """df/dw, shape (nw, 1)."""
        return self._once("grad_f", self._gradient)

    def hessian(self, kind: Hessian, lam_f: ca.MX, lam_g: ca.MX) -> ca.MX:
        """Second derivative of lam_f f + lam_g . g, or what Gauss-Newton takes for it, sparse and symmetric.

        Gauss-Newton leaves out the curvature of residuals and of terms of `constraints`, not that of what was added.
        """
        w, p, size = self.w, self.p, self.w.numel()
        total = ca.MX(size, size)
        for i, residual in enumerate(self.residuals):
            r, slope = self._residual(i), self._slope(i)
            weight = residual.slope_weight(r)
            weighted = slope if weight is None else ca.mtimes(ca.diag(weight), slope)
            total += lam_f * ca.mtimes(slope.T, weighted)
            if kind == "exact":
                matrix, pull = residual.by_values(p), residual.pull(r)
                pull = pull if matrix is None else ca.mtimes(matrix.T, pull)
                curved = residual.term.curvature(w, p, lam_f * pull)
                total += 0 if curved is None else summed(*curved, size)
        if kind == "exact":
            at = 0
            for term in self.constraints:
                curved = term.curvature(w, p, lam_g[at : at + term.size])
                at += term.size
                total += 0 if curved is None else summed(*curved, size)
        elif self.ridge is not None:
            total += lam_f * self._ridge(self.ridge)
        at = sum(term.size for term in self.constraints)
        for extra in self.extras:
            own = lam_f * extra.objective + ca.dot(lam_g[at : at + len(extra.lower)], extra.constraints)
            at += len(extra.lower)
            total += ca.hessian(own, w)[0]
        return total

    def _once(self, name: str, make: Any) -> Any:
        with SYMBOLIC:
            if name not in self._kept:
                self._kept[name] = make()
            return self._kept[name]

    def _own(self) -> ca.MX:
        return sum((extra.objective for extra in self.extras), ca.MX(0))

    def _residual(self, i: int) -> ca.MX:
        return self._once(f"r{i}", lambda: self.residuals[i].values(self.w, self.p))

    def _slope(self, i: int) -> ca.MX:
        return self._once(f"jac_r{i}", lambda: self.residuals[i].jacobian(self.w, self.p))

    def _loss(self, i: int) -> ca.MX:
        return self.residuals[i].loss(self._residual(i))

    def _jacobian(self) -> ca.MX:
        entries, rows, columns, at = [], [], [], 0
        for term in self.constraints:
            row, column = term.slots()
            entries.append(term.entries(self.w, self.p))
            rows.append(at + row)
            columns.append(column)
            at += term.size
        if not entries:
            placed = ca.MX(0, self.w.numel())
        else:
            where = np.concatenate(rows), np.concatenate(columns)
            placed = assembled(ca.vertcat(*entries), *where, (at, self.w.numel()))
        return ca.vertcat(placed, *(ca.jacobian(extra.constraints, self.w) for extra in self.extras))

    def _gradient(self) -> ca.MX:
        total = ca.gradient(self._own(), self.w) if self.extras else ca.MX.zeros(self.w.numel(), 1)
        for i, residual in enumerate(self.residuals):
            total += ca.mtimes(self._slope(i).T, residual.pull(self._residual(i)))
        return total

    def _ridge(self, ridge: Ridge) -> ca.MX:
        count = sum(residual.size for residual in self.residuals)
        cost = sum((self._loss(i) for i in range(len(self.residuals))), ca.MX(0))
        at = ridge.index.tolist()
        size = ca.fmax(ca.fabs(self.w[at]), ca.DM(ridge.scale))
        pattern = ca.Sparsity.triplet(self.w.numel(), self.w.numel(), at, at)
        return ca.MX(pattern, ridge.factor * 2 * cost / count / size**2)

    # -- use ----------------------------------------------------------------------------------------------------------

    def adding(
        self,
        objective: ca.MX | float = 0.0,
        constraints: ca.MX | Sequence[ca.MX] = (),
        lower: ArrayLike = 0.0,
        upper: ArrayLike = 0.0,
    ) -> NonlinearProgram:
        """The program with a term more in its objective and rows more in its constraints.

        Parameters
        ----------
        objective : casadi.MX
            Scalar expression of `w` and `p`.
        constraints : casadi.MX or sequence of them
            Expressions of `w` and `p`.
        lower, upper : array_like
            Bounds of these rows; equalities to zero when absent.

        Raises
        ------
        SolverError
            An expression of other symbols, or bounds of another number than rows.
        """
        rows = [constraints] if isinstance(constraints, ca.MX) else list(constraints)
        column = ca.vertcat(ca.MX(0, 1), *(ca.vec(ca.densify(row)) for row in rows))
        scalar = ca.MX(objective)
        strange = [s.name() for s in ca.symvar(ca.vertcat(scalar, column)) if not _is_of(s, self.w, self.p)]
        if strange:
            raise SolverError(
                f"the symbol '{strange[0]}' is neither an unknown nor a parameter of the program",
                where="NonlinearProgram.adding",
                allowed="expressions of nlp.w, nlp.p and of nlp[NAME]",
            )
        bounds = []
        for name, side in (("lower", lower), ("upper", upper)):
            given = np.asarray(side, float).ravel()
            if given.size not in (1, column.numel()):
                raise SolverError(
                    f"{given.size} {name} bounds for {column.numel()} constraints",
                    where="NonlinearProgram.adding",
                    allowed=f"one for all, or {column.numel()}",
                )
            bounds.append(np.broadcast_to(given, (column.numel(),)).copy())
        return replace(self, extras=(*self.extras, Extra(scalar, column, *bounds)), _kept={})

    def solver(self, plugin: str = "ipopt", hessian: Hessian = "gauss_newton", **options: Any) -> ca.Function:
        """`casadi.nlpsol` of the program, with the placed derivatives.

        Parameters
        ----------
        plugin : str
            Any of CasADi's.
        hessian : "gauss_newton" or "exact"
        **options
            Of `casadi.nlpsol`.

        Returns
        -------
        casadi.Function
            To be called with `arguments`.

        Raises
        ------
        SolverError
            CasADi does not have the plug-in, or refuses the options.
        """
        with SYMBOLIC:
            # a trial point that cannot be worked out is the solver's to reject, not for the screen
            options = {"show_eval_warnings": False, "error_on_fail": False, "print_time": False, **options}
            try:
                asked = _asked_for(plugin, options)
                made = {name: self._derivatives(name, *ends, hessian) for name, ends in asked.items()}
                cache = {name: function for name, function in made.items() if function is not None}
                return ca.nlpsol("program", plugin, self.nlp, {**options, "cache": cache})
            except RuntimeError as error:
                raise SolverError(
                    f"CasADi cannot make the solver '{plugin}': {str(error).strip().splitlines()[-1]}",
                    hint="see casadi.doc_nlpsol for its options",
                ) from error

    def _derivatives(
        self, name: str, inputs: list[str], outputs: list[str], hessian: Hessian
    ) -> ca.Function | None:
        lam_f, lam_g = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", self.g.numel())
        symbols = {"x": self.w, "p": self.p, "lam_f": lam_f, "lam_g": lam_g}
        known = {
            "f": lambda: self.f,
            "g": lambda: self.g,
            "grad_f_x": lambda: self.grad_f,
            "jac_g_x": lambda: self.jac_g,
            "grad_gamma_x": lambda: lam_f * self.grad_f + ca.mtimes(self.jac_g.T, lam_g),
            "hess_gamma_x_x": lambda: self.hessian(hessian, lam_f, lam_g),
            "triu_hess_gamma_x_x": lambda: ca.triu(self.hessian(hessian, lam_f, lam_g)),
        }
        if not set(outputs) <= set(known) or not set(inputs) <= set(symbols):
            return None
        return ca.Function(name, [symbols[i] for i in inputs], [known[o]() for o in outputs], inputs, outputs)


def _is_of(symbol: ca.MX, *vectors: ca.MX) -> bool:
    return any(ca.is_equal(symbol, vector) for vector in vectors)


def _asked_for(plugin: str, options: Mapping[str, Any]) -> dict[str, tuple[list[str], list[str]]]:
    """Inputs and outputs of the functions that a plug-in asks for, learnt on a program of one unknown."""
    x, p = ca.MX.sym("x"), ca.MX.sym("p")
    tiny = ca.nlpsol("tiny", plugin, {"x": x, "p": p, "f": x**2, "g": x}, dict(options))
    functions = {name: tiny.get_function(name) for name in tiny.get_function()}
    return {name: (f.name_in(), f.name_out()) for name, f in functions.items()}
