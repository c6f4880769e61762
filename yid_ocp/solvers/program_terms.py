"""Terms of a nonlinear program: one local function at many places, with directly assembled derivatives.

CasADi would find the same derivatives by colouring the whole Jacobian, many times more slowly.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from yid_ocp.arrays import Array, IntArray
from yid_ocp.integrator.compiler import compiled_casadi_function
from yid_ocp.parallel import CASADI_LOCK


class ThreadSafeCachedProperty(cached_property[Any]):
    """Cached property that one thread computes under CasADi's lock while other threads wait."""

    def __get__(self, instance: Any, owner: type[Any] | None = None) -> Any:
        with CASADI_LOCK:
            return super().__get__(instance, owner)


class LocalVariableFunction:
    """Symbolic function y(v; d, s) of local variables v, data d and shared data s (columns), with its derivatives.

    The `jacobian` dy/dv, shape (ny, nv), is differentiated from the value where it is not given. Derivatives may be
    compiled; the value stays CasADi's own, so that whoever builds upon it can differentiate it.
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
        return compiled_casadi_function(function) if self._use_compiler else function

    @ThreadSafeCachedProperty
    def _weighted_hessian_function(self) -> ca.Function | None:
        """CasADi function (v, d, s, weight) of the sparse Hessian of weight . y by v; None where y is linear."""
        # one product with a direction, for each colour of the pattern: the whole would be millions of operations
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
        row, at = (np.array(x) for x in pattern.get_triplet())
        symbols = [ca.MX.sym(f"a{i}", times.sparsity_in(i)) for i in range(4)]
        columns = times.map(f"{self.name}_products", "serial", group.size2(), [0, 1, 2, 3], [])
        products = ca.vec(columns(*symbols, ca.DM(group, 1.0)))
        entries = products[(row + v.numel() * colour[at]).tolist()]
        return ca.Function(f"{self.name}_curvature", symbols, [ca.MX(pattern, entries)])


@dataclass(frozen=True)
class MappedFunctionTerm:
    """Function of a few unknowns that a nonlinear program evaluates at K places, for example at every time step."""

    name: str
    row_names: tuple[str, ...]  # of the ny outputs
    local_function: LocalVariableFunction
    variable_indices: IntArray  # local variables of each place among the unknowns; none twice in a row, (K, nv)
    data_indices: IntArray  # data of each place among the parameters, shape (K, nd)
    shared_data_indices: IntArray  # data that all places share, shape (ns,)

    @property
    def n_values(self) -> int:
        """Number of output values at all places together, ny K."""
        return len(self.row_names) * len(self.variable_indices)

    def _map_over_places(self, function: ca.Function, w: ca.MX, p: ca.MX, *more: ca.MX) -> ca.MX:
        count = len(self.variable_indices)
        pairs = ((w, self.variable_indices), (p, self.data_indices))
        local = (ca.reshape(vector[at.ravel().tolist()], at.shape[1], count) for vector, at in pairs)
        mapped = function.map(f"{function.name()}_{count}", "serial", count, [2], [])
        return mapped(*local, p[self.shared_data_indices.tolist()], *more)

    def symbolic_outputs(self, w: ca.MX, p: ca.MX) -> ca.MX:
        """The local function's ny outputs at all K places, one place after another, shape (ny K, 1)."""
        return ca.vec(self._map_over_places(self.local_function.value, w, p))

    def jacobian_nonzero_values(self, w: ca.MX, p: ca.MX) -> ca.MX:
        """Nonzero entries of the Jacobian with respect to w, in the order of `jacobian_nonzero_indices`."""
        return _nonzero_values(self._map_over_places(self.local_function.jacobian, w, p))

    def jacobian_nonzero_indices(self) -> tuple[IntArray, IntArray]:
        """Row and column indices of the nonzero entries of the Jacobian of all values with respect to w."""
        row, column = (np.array(x, np.int64) for x in self.local_function.jacobian.sparsity_out(0).get_triplet())
        first = len(self.row_names) * np.arange(len(self.variable_indices))[:, None]
        return (first + row).ravel(), self.variable_indices[:, column].ravel()

    def weighted_hessian_triplets(self, w: ca.MX, p: ca.MX, weight: ca.MX) -> tuple[ca.MX, IntArray, IntArray] | None:
        """Entries, rows and columns (some may repeat) of the Hessian of weight . values in w; None if it is zero."""
        function = self.local_function._weighted_hessian_function
        if function is None:
            return None
        weights = ca.reshape(weight, len(self.row_names), len(self.variable_indices))
        entries = _nonzero_values(self._map_over_places(function, w, p, weights))
        row, column = (np.array(x, np.int64) for x in function.sparsity_out(0).get_triplet())
        return entries, self.variable_indices[:, row].ravel(), self.variable_indices[:, column].ravel()


@dataclass(frozen=True)
class ResidualTerm:
    """Residual term of a program's objective: r = weight (combination values - target)."""

    term: MappedFunctionTerm
    combination: ca.DM | None = None  # shape (nr, ny K); None takes the values as they are
    weight_indices: IntArray | None = None  # among the parameters, shape (nr,); None for weights of one
    target_indices: IntArray | None = None  # among the parameters, shape (nr,); None for targets of zero
    huber_threshold: float = math.inf  # residual beyond which Huber's loss is linear

    @property
    def n_residuals(self) -> int:
        """Number nr of residuals."""
        return self.term.n_values if self.combination is None else self.combination.size1()

    def residual_jacobian_by_term_values(self, p: ca.MX) -> ca.MX | None:
        """Jacobian of the residuals r with respect to the program term's values, sparse; None for the identity."""
        if self.combination is None and self.weight_indices is None:
            return None
        combination = ca.DM.eye(self.n_residuals) if self.combination is None else self.combination
        if self.weight_indices is None:
            return ca.MX(combination)
        row, _ = combination.sparsity().get_triplet()
        factors = p[self.weight_indices[np.array(row, int)].tolist()]
        return ca.MX(combination.sparsity(), factors * ca.MX(ca.DM(combination.nonzeros())))

    def symbolic_outputs(self, w: ca.MX, p: ca.MX) -> ca.MX:
        """Residuals r at the program's unknowns w and parameters p, shape (nr, 1)."""
        matrix, value = self.residual_jacobian_by_term_values(p), self.term.symbolic_outputs(w, p)
        result = value if matrix is None else ca.mtimes(matrix, value)
        if self.target_indices is None:
            return result
        target = p[self.target_indices.tolist()]
        return result - (target if self.weight_indices is None else p[self.weight_indices.tolist()] * target)

    def jacobian(self, w: ca.MX, p: ca.MX) -> ca.MX:
        """Jacobian (nr, nw) of the residuals r with respect to the program's unknowns w, sparse."""
        entries, shape = self.term.jacobian_nonzero_values(w, p), (self.term.n_values, w.numel())
        placed = sparse_mx_from_entries(entries, *self.term.jacobian_nonzero_indices(), shape)
        matrix = self.residual_jacobian_by_term_values(p)
        return placed if matrix is None else ca.mtimes(matrix, placed)

    def evaluate_loss(self, r: ca.MX) -> ca.MX:
        """Loss of residuals r: half the sum of squares, or Huber's loss."""
        if math.isinf(self.huber_threshold):
            return ca.sumsqr(r) / 2
        size, limit = ca.fabs(r), self.huber_threshold
        return ca.sum1(ca.if_else(size <= limit, r**2 / 2, limit * (size - limit / 2)))

    def loss_gradient_by_residual(self, r: ca.MX) -> ca.MX:
        """Gradient of the loss with respect to the residuals r, shape (nr, 1)."""
        limit = self.huber_threshold
        return r if math.isinf(limit) else ca.fmax(ca.fmin(r, limit), -limit)

    def loss_hessian_residual_weights(self, r: ca.MX, exact: bool) -> ca.MX | None:
        """Weight of each residual in the Hessian of the loss; None if all weights are one.

        Exactly it is one or zero; Gauss-Newton's, that of weighted squares with the same gradient, is never zero.
        """
        if math.isinf(self.huber_threshold):
            return None
        size = ca.fabs(r)
        if exact:
            return ca.if_else(size <= self.huber_threshold, 1.0, 0.0)
        return ca.fmin(1.0, self.huber_threshold / ca.fmax(size, 1e-300))


@dataclass(frozen=True)
class GaussNewtonHessianRidge:
    """Curvature added to the Gauss-Newton Hessian, not the cost: factor * mean square residual / max(|w_i|, scale_i)^2.

    Along unknowns that the data hardly inform the curvature that Gauss-Newton leaves out may be as large as its own.
    The factor is a number, or a function of the unknowns that gives one, which may change from iterate to iterate.
    """

    index: IntArray
    scale: Array
    factor: float | ca.Function


def _nonzero_values(matrix: ca.MX) -> ca.MX:
    """Nonzero entries of a sparse expression as a column."""
    return ca.MX(ca.Sparsity.dense(matrix.nnz(), 1), matrix.nz[:])


def sparse_mx_from_entries(entries: ca.MX, row: IntArray, column: IntArray, shape: tuple[int, int]) -> ca.MX:
    """Assemble a sparse matrix from entries at distinct positions."""
    order = np.lexsort((row, column))
    start = np.concatenate([[0], np.cumsum(np.bincount(column, minlength=shape[1]))])
    sparsity = ca.Sparsity(*shape, start.tolist(), row[order].tolist())
    return ca.MX(sparsity, entries[order.tolist()])


def sparse_matrix_summing_duplicates(entries: ca.MX, row: IntArray, column: IntArray, size: int) -> ca.MX:
    """Assemble a sparse square matrix from entries, summing those at the same position."""
    keys, place = np.unique(column * size + row, return_inverse=True)
    start = np.concatenate([[0], np.cumsum(np.bincount(keys // size, minlength=size))])
    sparsity = ca.Sparsity(size, size, start.tolist(), (keys % size).tolist())
    # one column for every entry, its only row being where it goes
    columns = ca.Sparsity(len(keys), len(place), list(range(len(place) + 1)), place.ravel().tolist())
    return ca.MX(sparsity, ca.mtimes(ca.MX(ca.DM(columns, 1.0)), entries))
