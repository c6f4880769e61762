"""A general nonlinear program in CasADi, composed of residual and constraint terms.

    min f(w, p)   subject to   lower <= w <= upper,   g_lower <= g(w, p) <= g_upper

f is half the sum of squares (or the Huber loss) of residuals, g the values of constraint terms. A term is one function
of few variables, evaluated at many places. The module does not depend on mechanics or recordings.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from yid_ocp.arrays import Array, IntArray
from yid_ocp.display import ReprMixin, ReprTexts, count_with_noun
from yid_ocp.errors import SolverError, unknown_name_error_arguments
from yid_ocp.integrator.compiler import compile_casadi_function
from yid_ocp.parallel import CASADI_LOCK, CasadiLockedCache, CasadiLockedProperty

HessianKind = Literal["gauss_newton", "exact"]
# Measured with IPOPT and MUMPS on 40 to 50 coordinates and 500 to 2000 steps [bytes an entry of Jacobian and Hessian].
_BYTES_PER_ENTRY = 250.0

# No warnings, as the solver rejects points that cannot be evaluated; no multipliers of parameters unless requested.
QUIET_NLPSOL_OPTIONS = {"show_eval_warnings": False, "error_on_fail": False, "print_time": False, "calc_lam_p": False}

# Options that fit programs of one size only.
_SIZE_DEPENDENT_OPTIONS = ("iteration_callback", "discrete", "equality", "structure_detection", "N", "nx", "nu", "ng")


class LocalVariableFunction:
    """A symbolic function y(v; d, s) of local variables v, data d and shared data s, with derivatives by v.

    All calls share the values of s. `jacobian` is dy/dv (ny, nv), by default derived from `value`. Derivatives can be
    compiled. The value stays a CasADi expression, so that terms built on it can be differentiated.
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

    def _compiled(self, function: ca.Function) -> ca.Function:
        return compile_casadi_function(function) if self._use_compiler else function

    @CasadiLockedProperty
    def _weighted_hessian_function(self) -> ca.Function | None:
        """CasADi function (v, d, s, weight) of the sparse Hessian of weight . y by v; None if y is linear."""
        # one product with a direction, for each colour of the pattern: the whole would be millions of operations
        v, weight = self._inputs[0], ca.SX.sym("weight", self._expression.numel())
        gradient = ca.gradient(ca.dot(weight, self._expression), v)
        pattern = ca.jacobian_sparsity(gradient, v)
        if not pattern.nnz():
            return None
        direction = ca.SX.sym("direction", v.numel())
        product = ca.cse([ca.densify(ca.jtimes(gradient, v, direction))])
        times = self._compiled(ca.Function(f"{self.name}_product", [*self._inputs, weight, direction], product))
        group, colour = pattern.uni_coloring(), np.zeros(v.numel(), int)
        members, column = group.get_triplet()
        colour[members] = column
        row, at = (np.array(x) for x in pattern.get_triplet())
        symbols = [ca.MX.sym(f"a{i}", times.sparsity_in(i)) for i in range(4)]
        columns = times.map(f"{self.name}_products", "serial", group.size2(), [0, 1, 2, 3], [])
        products = ca.vec(columns(*symbols, ca.DM(group, 1.0)))
        entries = products[(row + v.numel() * colour[at]).tolist()]
        return ca.Function(f"{self.name}_curvature", symbols, [ca.MX(pattern, entries)])


@dataclass(frozen=True)
class MappedFunctionTerm:
    """A function of few variables that a nonlinear program evaluates at K places, for example at every time step."""

    name: str
    row_names: tuple[str, ...]  # names of the ny outputs
    local_function: LocalVariableFunction
    variable_indices: IntArray  # indices in w of each place's local variables, without repetition, (K, nv)
    data_indices: IntArray  # indices in p of each place's data, (K, nd)
    shared_data_indices: IntArray  # indices in p of data that all places share, (ns,)

    @property
    def n_values(self) -> int:
        """The total number of output values: ny at each of K places."""
        return len(self.row_names) * len(self.variable_indices)

    def _map_over_places(self, function: ca.Function, w: ca.MX, p: ca.MX, *more: ca.MX) -> ca.MX:
        count = len(self.variable_indices)
        pairs = ((w, self.variable_indices), (p, self.data_indices))
        local = (ca.reshape(vector[at.ravel().tolist()], at.shape[1], count) for vector, at in pairs)
        mapped = function.map(f"{function.name()}_{count}", "serial", count, [2], [])
        return mapped(*local, p[self.shared_data_indices.tolist()], *more)

    def _symbolic_outputs(self, w: ca.MX, p: ca.MX) -> ca.MX:
        """The local function's outputs (ny K, 1) at all K places, one place after another."""
        return ca.vec(self._map_over_places(self.local_function.value, w, p))

    def jacobian(self, w: ca.MX, p: ca.MX) -> ca.MX:
        """Return the sparse Jacobian (ny K, nw) of all outputs with respect to the program's variables w."""
        row, column = (np.array(x, np.int64) for x in self.local_function.jacobian.sparsity_out(0).get_triplet())
        rows = (len(self.row_names) * np.arange(len(self.variable_indices))[:, None] + row).ravel()
        columns, shape = self.variable_indices[:, column].ravel(), (self.n_values, w.numel())
        sparsity, order = ca.Sparsity.triplet(*shape, rows.tolist(), columns.tolist(), False)
        return ca.MX(sparsity, _nonzero_values(self._map_over_places(self.local_function.jacobian, w, p))[order])

    def _weighted_hessian(self, w: ca.MX, p: ca.MX, weight: ca.MX) -> ca.MX:
        """Sparse Hessian (nw, nw) of weight . values in w. Entries of several places at one position are summed."""
        size, function = w.numel(), self.local_function._weighted_hessian_function
        if function is None:
            return ca.MX(size, size)
        weights = ca.reshape(weight, len(self.row_names), len(self.variable_indices))
        entries = _nonzero_values(self._map_over_places(function, w, p, weights))
        row, column = (np.array(x, np.int64) for x in function.sparsity_out(0).get_triplet())
        rows, columns = (self.variable_indices[:, at].ravel().tolist() for at in (row, column))
        sparsity, place = ca.Sparsity.triplet(size, size, rows, columns, True)
        # one column for every entry, with a one in the row of the entry's position
        position = ca.Sparsity(sparsity.nnz(), len(place), list(range(len(place) + 1)), place)
        return ca.MX(sparsity, ca.mtimes(ca.MX(ca.DM(position, 1.0)), entries))


@dataclass(frozen=True)
class ResidualTerm:
    """A residual term of a program's objective, r = weight * (combination @ v - target), with values v of `term`."""

    term: MappedFunctionTerm
    combination: ca.DM  # shape (nr, ny K)
    weight_indices: IntArray | None = None  # indices of the weights in p, (nr,); None for weights of one
    target_indices: IntArray | None = None  # indices of the targets in p, (nr,); None for targets of zero
    huber_threshold: float = math.inf  # residual beyond which Huber's loss is linear

    @property
    def n_residuals(self) -> int:
        """The number nr of residuals."""
        return self.combination.size1()

    def _residual_jacobian_by_term_values(self, p: ca.MX) -> ca.MX:
        """Sparse Jacobian of the residuals r with respect to the term's values."""
        if self.weight_indices is None:
            return ca.MX(self.combination)
        row, _ = self.combination.sparsity().get_triplet()
        factors = p[self.weight_indices[np.array(row, int)].tolist()]
        return ca.MX(self.combination.sparsity(), factors * ca.MX(ca.DM(self.combination.nonzeros())))

    def _symbolic_outputs(self, w: ca.MX, p: ca.MX) -> ca.MX:
        """Residuals r (nr, 1) at the program's variables w and parameters p."""
        result = ca.mtimes(self._residual_jacobian_by_term_values(p), self.term._symbolic_outputs(w, p))
        if self.target_indices is None:
            return result
        target = p[self.target_indices.tolist()]
        return result - (target if self.weight_indices is None else p[self.weight_indices.tolist()] * target)

    def jacobian(self, w: ca.MX, p: ca.MX) -> ca.MX:
        """Return the sparse Jacobian (nr, nw) of the residuals with respect to the program's variables w."""
        return ca.mtimes(self._residual_jacobian_by_term_values(p), self.term.jacobian(w, p))

    def _evaluate_loss(self, r: ca.MX) -> ca.MX:
        if math.isinf(self.huber_threshold):
            return ca.sumsqr(r) / 2
        size, limit = ca.fabs(r), self.huber_threshold
        return ca.sum1(ca.if_else(size <= limit, r**2 / 2, limit * (size - limit / 2)))

    def _loss_gradient_by_residual(self, r: ca.MX) -> ca.MX:
        limit = self.huber_threshold
        return r if math.isinf(limit) else ca.fmax(ca.fmin(r, limit), -limit)

    def _loss_hessian_residual_weights(self, r: ca.MX, exact: bool) -> ca.MX | None:
        """Weight of each residual in the Hessian of the loss. None if all weights are one.

        With `exact`, the weight is the second derivative of the Huber loss: one up to the threshold, zero beyond.
        Without `exact`, it is that of iteratively reweighted least squares, with the same gradient and never zero.
        """
        if math.isinf(self.huber_threshold):
            return None
        size = ca.fabs(r)
        if exact:
            return ca.if_else(size <= self.huber_threshold, 1.0, 0.0)
        return ca.fmin(1.0, self.huber_threshold / ca.fmax(size, 1e-300))


@dataclass(frozen=True)
class GaussNewtonHessianRidge:
    """A term added to the Gauss-Newton Hessian that keeps steps of poorly determined variables small.

    For such variables, the curvature that Gauss-Newton neglects can be as large as its own curvature. The ridge adds
    factor * mean square residual / max(|w_i|, scale_i)^2 to the diagonal of the Gauss-Newton Hessian. `factor` is a
    number or a function of the variables w, whose value can change between iterates.
    """

    index: IntArray  # indices i in w of the variables with a ridge
    scale: Array  # typical size of each of them
    factor: float | ca.Function


def _nonzero_values(matrix: ca.MX) -> ca.MX:
    return ca.MX(ca.Sparsity.dense(matrix.nnz(), 1), matrix.nz[:])


@dataclass(frozen=True)
class _VectorBlock:
    """Named block of variables or parameters: indices in the vector, (rows, columns), and names of the rows."""

    index: IntArray
    row_names: tuple[str, ...]
    unit: str = ""


@dataclass
class ProgramVectorLayout:
    """The layout of the vector of a program's variables or parameters in named blocks, with values and bounds."""

    size: int = 0
    blocks: dict[str, _VectorBlock] = field(default_factory=dict)
    values: list[Array] = field(default_factory=list)
    lower: list[Array] = field(default_factory=list)
    upper: list[Array] = field(default_factory=list)

    def append_values(
        self, values: Array, lower: float | Array = -math.inf, upper: float | Array = math.inf
    ) -> IntArray:
        """Append values with their bounds. Returns their indices in the vector."""
        self.values.append(values)
        self.lower.append(np.broadcast_to(lower, values.shape).astype(float))
        self.upper.append(np.broadcast_to(upper, values.shape).astype(float))
        self.size += len(values)
        return np.arange(self.size - len(values), self.size)

    def assign_block_name(self, name: str, index: IntArray, rows: Sequence[str], unit: str = "") -> None:
        """Name the block of existing entries `index` (rows, columns) of the vector. An empty block gets no name."""
        if index.size:
            self.blocks[name] = _VectorBlock(index, tuple(rows), unit)

    def append_block(self, name: str, values: Array, rows: Sequence[str], unit: str = "") -> IntArray:
        """Append a table column by column as a named block. Returns the vector index of each entry (rows, columns)."""
        table = np.asarray(values, float)
        table = table[:, None] if table.ndim == 1 else table
        index = self.append_values(table.ravel(order="F")).reshape(table.shape, order="F")
        self.assign_block_name(name, index, rows, unit)
        return index


class _UserTerms(NamedTuple):
    objective: ca.MX
    constraints: ca.MX
    lower: Array
    upper: Array


def available_memory_bytes() -> float:
    """Return the available memory [bytes]. Infinite if the system does not report it."""
    told = Path("/proc/meminfo")
    lines = told.read_text(encoding="ascii", errors="replace").splitlines() if told.is_file() else []
    found = [float(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:")]
    return found[0] if found else math.inf


@dataclass(frozen=True, eq=False, repr=False)
class NonlinearProgram(ReprMixin):
    """A nonlinear program in CasADi that minimises f(w, p) over the variables w, under bounds and constraints.

    `nlp[name]` is a block of the variables w or of the parameters p, an MX of the block's shape. With one recording,
    `nlp["q"]` is short for `nlp["q[NAME]"]`.
    """

    variables: Mapping[str, _VectorBlock]  # named blocks of the vector `w`
    parameters: Mapping[str, _VectorBlock]  # named blocks of the vector `p`
    constraint_terms: tuple[MappedFunctionTerm, ...]  # equalities to zero, one below the other in `g`
    residual_terms: tuple[ResidualTerm, ...]  # the objective is the sum of their losses
    lower: Array  # lower bounds of `w`, (nw,), the same shape as `upper` and `initial_guess`
    upper: Array
    initial_guess: Array
    parameter_values: Array  # of `p`, shape (np,)
    ridge: GaussNewtonHessianRidge | None
    w: ca.MX
    p: ca.MX
    user_terms: tuple[_UserTerms, ...] = ()

    def _summary(self) -> ReprTexts:
        rows = [("block", "entries"), *((name, str(block.index.size)) for name, block in self.variables.items())]
        equalities = count_with_noun(sum(term.n_values for term in self.constraint_terms), "equation")
        return ReprTexts(f"{count_with_noun(len(self.initial_guess), 'variable')}, {equalities}", rows)

    def find_vector_block(self, name: str) -> _VectorBlock:
        """Find a named block's indices, row names and unit. With one recording, `[NAME]` can be omitted.

        Raises `SolverError` if there is no such block, or more than one.
        """
        blocks = {**self.variables, **self.parameters}
        if name in blocks:
            return blocks[name]
        alike = [key for key in blocks if key.startswith(f"{name}[")]
        if len(alike) == 1:
            return blocks[alike[0]]
        said = unknown_name_error_arguments(name, alike or blocks)
        what = f"'{name}' names {len(alike)} blocks of the program" if alike else f"the program has no block '{name}'"
        raise SolverError(what, where=f"nlp['{name}']", **said)

    def __getitem__(self, name: str) -> ca.MX:
        """Block of variables or parameters as an MX matrix of its shape."""
        block = self.find_vector_block(name)
        vector = self.w if any(block is own for own in self.variables.values()) else self.p
        return ca.reshape(vector[block.index.T.ravel().tolist()], *block.index.shape)

    def variable_names(self) -> tuple[str, ...]:
        """Return the names of all variables w, composed of block, row and, if there are several, column."""
        named = np.full(self.w.numel(), "", dtype=object)
        for name, block in self.variables.items():
            for row, places in zip(block.row_names, block.index, strict=True):
                several = len(places) > 1
                named[places] = [f"{name}.{row}.{k}" if several else f"{name}.{row}" for k in range(len(places))]
        return tuple(named)

    def constraint_names(self) -> tuple[str, ...]:
        """Return the names of all constraint rows by term, row and place. Rows of `with_user_terms` are `added.I`."""
        places = ((t, k) for t in self.constraint_terms for k in range(len(t.variable_indices)))
        terms = [f"{t.name}.{row}.{k}" for t, k in places for row in t.row_names]
        return (*terms, *(f"added.{i}" for i in range(sum(len(extra.lower) for extra in self.user_terms))))

    @CasadiLockedProperty
    def f(self) -> ca.MX:
        """Return the symbolic scalar objective f(w, p)."""
        return sum((*self._losses, *(extra.objective for extra in self.user_terms)), ca.MX(0))

    @CasadiLockedProperty
    def g(self) -> ca.MX:
        """Return the symbolic constraint functions g(w, p), shape (ng, 1)."""
        terms = (term._symbolic_outputs(self.w, self.p) for term in self.constraint_terms)
        return ca.vertcat(ca.MX(0, 1), *terms, *(extra.constraints for extra in self.user_terms))

    @property
    def nlp(self) -> dict[str, ca.MX]:
        """The program as a dictionary (x, p, f, g) for `casadi.nlpsol`."""
        return {"x": self.w, "p": self.p, "f": self.f, "g": self.g}

    @property
    def solver_arguments(self) -> dict[str, Array]:
        """The initial guess, parameter values and bounds, which are the arguments for a call of a CasADi solver."""
        zero = np.zeros(sum(term.n_values for term in self.constraint_terms))
        low, high = ([zero, *(getattr(extra, side) for extra in self.user_terms)] for side in ("lower", "upper"))
        bounds = {"lbx": self.lower, "ubx": self.upper, "lbg": np.concatenate(low), "ubg": np.concatenate(high)}
        return {"x0": self.initial_guess, "p": self.parameter_values, **bounds}

    @CasadiLockedProperty
    def _residuals(self) -> list[ca.MX]:
        return [term._symbolic_outputs(self.w, self.p) for term in self.residual_terms]

    @CasadiLockedProperty
    def _slopes(self) -> list[ca.MX]:
        return [term.jacobian(self.w, self.p) for term in self.residual_terms]

    @property
    def _losses(self) -> list[ca.MX]:
        return [term._evaluate_loss(r) for term, r in zip(self.residual_terms, self._residuals, strict=True)]

    @CasadiLockedProperty
    def residual(self) -> ca.MX:
        """Return the symbolic residuals r(w, p) of the objective's least-squares terms, (nr, 1)."""
        return ca.vertcat(ca.MX(0, 1), *self._residuals)

    @CasadiLockedProperty
    def jac_r(self) -> ca.MX:
        """Return the sparse Jacobian of all residuals r with respect to the variables w."""
        return ca.vertcat(ca.MX(0, self.w.numel()), *self._slopes)

    @CasadiLockedProperty
    def jac_g(self) -> ca.MX:
        """Return the sparse Jacobian of the constraints g with respect to the variables w."""
        own = (term.jacobian(self.w, self.p) for term in self.constraint_terms)
        added = (ca.jacobian(extra.constraints, self.w) for extra in self.user_terms)
        return ca.vertcat(ca.MX(0, self.w.numel()), *own, *added)

    @CasadiLockedProperty
    def grad_f(self) -> ca.MX:
        """Return the gradient of the objective f with respect to the variables w, shape (nw, 1)."""
        own = sum((extra.objective for extra in self.user_terms), ca.MX(0))
        total = ca.gradient(own, self.w) if self.user_terms else ca.MX.zeros(self.w.numel(), 1)
        for term, r, slope in zip(self.residual_terms, self._residuals, self._slopes, strict=True):
            total += ca.mtimes(slope.T, term._loss_gradient_by_residual(r))
        return total

    @CasadiLockedProperty
    def lam_f(self) -> ca.MX:
        """Return the symbolic factor on the objective f in the Lagrangian of `hessian`."""
        return ca.MX.sym("lam_f")

    @CasadiLockedProperty
    def lam_g(self) -> ca.MX:
        """Return the symbolic multipliers of the constraints g in the Lagrangian, shape (ng, 1)."""
        return ca.MX.sym("lam_g", self.g.numel())

    @CasadiLockedProperty
    def _hessians(self) -> CasadiLockedCache[bool, ca.MX]:
        return CasadiLockedCache(lambda exact: self._data_curvature(exact) + self._other_curvature(exact))

    def hessian(self, kind: HessianKind = "gauss_newton") -> ca.MX:
        """Return the sparse symmetric Hessian of the Lagrangian lam_f f + lam_g' g, exact or Gauss-Newton.

        Gauss-Newton neglects the curvature of residuals and of `constraint_terms`, but keeps that of user terms.
        """
        return self._hessians(kind == "exact")

    def _data_curvature(self, exact: bool) -> ca.MX:
        total = ca.MX(self.w.numel(), self.w.numel())
        for residual, r, slope in zip(self.residual_terms, self._residuals, self._slopes, strict=True):
            weight = residual._loss_hessian_residual_weights(r, exact)
            weighted = slope if weight is None else ca.mtimes(ca.diag(weight), slope)
            total += self.lam_f * ca.mtimes(slope.T, weighted)
            if exact:
                matrix = residual._residual_jacobian_by_term_values(self.p)
                pull = ca.mtimes(matrix.T, residual._loss_gradient_by_residual(r))
                total += residual.term._weighted_hessian(self.w, self.p, self.lam_f * pull)
        return total

    def _other_curvature(self, exact: bool) -> ca.MX:
        total, at = ca.MX(self.w.numel(), self.w.numel()), 0
        if not exact and self.ridge is not None:
            total += self.lam_f * self._ridge(self.ridge)
        for term in self.constraint_terms:
            weight = self.lam_g[at : at + term.n_values]
            total += term._weighted_hessian(self.w, self.p, weight) if exact else 0
            at += term.n_values
        for extra in self.user_terms:
            weight = self.lam_g[at : at + len(extra.lower)]
            at += len(extra.lower)
            total += ca.hessian(self.lam_f * extra.objective + ca.dot(weight, extra.constraints), self.w)[0]
        return total

    def _ridge(self, ridge: GaussNewtonHessianRidge) -> ca.MX:
        count = sum(residual.n_residuals for residual in self.residual_terms)
        at = ridge.index.tolist()
        size = ca.fmax(ca.fabs(self.w[at]), ca.DM(ridge.scale))
        pattern = ca.Sparsity.triplet(self.w.numel(), self.w.numel(), at, at)
        factor = ridge.factor(self.w) if isinstance(ridge.factor, ca.Function) else ridge.factor
        return ca.MX(pattern, factor * 2 * sum(self._losses, ca.MX(0)) / count / size**2)

    def estimated_solver_memory(self, hessian: HessianKind = "gauss_newton") -> float:
        """Estimate the additional memory [bytes] that an interior-point method with a direct linear solver needs."""
        return _BYTES_PER_ENTRY * float(self.jac_g.nnz() + self.hessian(hessian).nnz())

    def with_user_terms(
        self,
        objective: ca.MX | float = 0.0,
        constraints: ca.MX | Sequence[ca.MX] = (),
        lower: ArrayLike = 0.0,
        upper: ArrayLike = 0.0,
    ) -> NonlinearProgram:
        """Return the program with an added objective term and constraint rows, which use its variables and parameters.

        Rows without bounds are equalities to zero. Raises `SolverError` if an expression contains other symbols, or if
        the number of bounds is neither one nor the number of rows.
        """
        rows = [constraints] if isinstance(constraints, ca.MX) else list(constraints)
        column = ca.vertcat(ca.MX(0, 1), *(ca.vec(ca.densify(row)) for row in rows))
        scalar = ca.MX(objective)
        where, bounds = "NonlinearProgram.with_user_terms", []
        for symbol in ca.symvar(ca.vertcat(scalar, column)):
            if not any(ca.is_equal(symbol, vector) for vector in (self.w, self.p)):
                message = f"the symbol '{symbol.name()}' is neither a variable nor a parameter of the program"
                allowed, hint = "expressions of nlp.w, nlp.p and of nlp[NAME]", "use a number or nlp[NAME] in its place"
                raise SolverError(message, where=where, allowed=allowed, hint=hint)
        for name, side in (("lower", lower), ("upper", upper)):
            given = np.asarray(side, float).ravel()
            if given.size not in (1, column.numel()):
                message = f"{given.size} {name} bounds are given for {column.numel()} constraints"
                allowed, hint = f"1 or {column.numel()} bounds", f"pass one number or {column.numel()} as {name}"
                raise SolverError(message, where=f"{where}: {name}", allowed=allowed, hint=hint)
            bounds.append(np.broadcast_to(given, (column.numel(),)).copy())
        return replace(self, user_terms=(*self.user_terms, _UserTerms(scalar, column, *bounds)))

    def make_solver(self, plugin: str = "ipopt", hessian: HessianKind = "gauss_newton", **options: Any) -> ca.Function:
        """Make a `casadi.nlpsol` solver with the program's derivatives. Call the solver with `solver_arguments`.

        `plugin` is the name of a CasADi plug-in, `options` are options of `casadi.nlpsol`. Raises `SolverError` if
        CasADi lacks the plug-in or refuses the options.
        """
        with CASADI_LOCK:
            options = {**QUIET_NLPSOL_OPTIONS, **options}
            fitting = {name: value for name, value in options.items() if name not in _SIZE_DEPENDENT_OPTIONS}
            x, p = ca.MX.sym("x"), ca.MX.sym("p")
            try:
                # a program of one unknown tells which functions the plug-in asks for
                tiny = ca.nlpsol("tiny", plugin, {"x": x, "p": p, "f": x**2, "g": x}, fitting)
                asked = ((name, tiny.get_function(name)) for name in tiny.get_function())
                made = {name: self._derivatives(name, f.name_in(), f.name_out(), hessian) for name, f in asked}
                cache = {name: function for name, function in made.items() if function is not None}
                return ca.nlpsol("program", plugin, self.nlp, {**options, "cache": cache})
            except RuntimeError as error:
                message = f"CasADi cannot make the solver '{plugin}': {str(error).strip().splitlines()[-1]}"
                allowed, hint = "a plug-in of casadi.nlpsol and its options", f"see casadi.doc_nlpsol('{plugin}')"
                raise SolverError(message, where=f"solver '{plugin}'", allowed=allowed, hint=hint) from error

    def _derivatives(
        self, name: str, inputs: list[str], outputs: list[str], hessian: HessianKind
    ) -> ca.Function | None:
        symbols = {"x": self.w, "p": self.p, "lam_f": self.lam_f, "lam_g": self.lam_g}
        known = {
            "f": lambda: self.f,
            "g": lambda: self.g,
            "grad_f_x": lambda: self.grad_f,
            "jac_g_x": lambda: self.jac_g,
            "grad_gamma_x": lambda: self.lam_f * self.grad_f + ca.mtimes(self.jac_g.T, self.lam_g),
            "hess_gamma_x_x": lambda: self.hessian(hessian),
            "triu_hess_gamma_x_x": lambda: ca.triu(self.hessian(hessian)),
        }
        if not set(outputs) <= set(known) or not set(inputs) <= set(symbols):
            return None
        return ca.Function(name, [symbols[i] for i in inputs], [known[o]() for o in outputs], inputs, outputs)
