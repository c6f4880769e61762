"""Diagnostics of a compiled step: dimensions, operation counts, sparsity, and linearisation against differences."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from yid_ocp.integrator.step import Step, float_array_of_shape
from yid_ocp.integrator.step_model import StepLinearization
from yid_ocp.model.system import System

Array = NDArray[np.float64]

_DIFFERENCE_STEP = (
    1e-5  # balances Newton's tolerance against the third derivative, for angles and stiffnesses of order one
)


@dataclass(frozen=True)
class FunctionSize:
    """Number of operations and of nonzero outputs of one generated function."""

    name: str
    n_operations: int
    n_nonzeros: int


@dataclass(frozen=True)
class StepStructure:
    """Dimensions, unknowns and function sizes of a step's equations.

    Attributes
    ----------
    dimensions : dict of str to int
        n, nz, m, nu, nc, nx, ntheta.
    n_unknowns : int
        Free coordinates, internal coordinates and multipliers that Newton's iteration solves for.
    jacobian_nonzeros : int
        Of the DEL residual by the unknowns.
    function_sizes : tuple of Operations
        Residual, its Jacobian's parts and the rest, as generated.
    """

    dimensions: dict[str, int]
    n_unknowns: int
    jacobian_nonzeros: int
    function_sizes: tuple[FunctionSize, ...]


@dataclass(frozen=True)
class CheckedLinearisation:
    """A_k, B_k at a state, with their deviation from finite differences.

    Attributes
    ----------
    state : ndarray, shape (nx,)
        (q, p, z)
    a : ndarray, shape (nx, nx)
    b_input : ndarray, shape (nx, nu)
    b_theta : ndarray, shape (nx, ntheta)
    spectral_radius : float
        Largest absolute eigenvalue of A.
    finite_difference_errors : dict of str to float
        Largest difference from central finite differences, as a fraction of the matrix's largest entry.
    """

    state: Array
    a: Array
    b_input: Array
    b_theta: Array
    spectral_radius: float
    finite_difference_errors: dict[str, float]


def step_structure(step: Step) -> StepStructure:
    """Dimensions, nonzeros and operation counts of a step."""
    e = step.equations
    functions = tuple(
        FunctionSize(f.name(), f.n_instructions(), sum(f.nnz_out(i) for i in range(f.n_out())))
        for f in step.functions.all_functions
    )
    return StepStructure(step.sizes, e.unknowns.numel(), _jacobian_sparsity(step).nnz(), functions)


def _jacobian_sparsity(step: Step) -> ca.Sparsity:
    """Pattern of d(DEL residual)/d(unknowns), shape (ny, ny)."""
    e = step.equations
    pattern: ca.Sparsity = ca.jacobian_sparsity(e.residual, e.unknowns)
    return pattern


def linearise_and_check(
    step: Step, state: ArrayLike, torque: ArrayLike, theta: ArrayLike, prescribed: tuple[ArrayLike, ArrayLike] | None
) -> CheckedLinearisation:
    """Linearise a step at a state (A_k, B_k) and compare it with central finite differences.

    Parameters
    ----------
    step : Step
    state : array_like, shape (nx,)
        (q, p, z)
    torque : array_like, shape (nu,)
        [N m]
    theta : array_like, shape (ntheta,)
    prescribed : pair of array_like, shape (nc,), or None
        Prescribed coordinates at both ends of the step.
    """
    sizes = step.sizes
    n, nx = sizes["n"], sizes["nx"]
    x = float_array_of_shape("state", state, (nx,))
    u, values = (
        float_array_of_shape("torque", torque, (sizes["nu"],)),
        float_array_of_shape("theta", theta, (sizes["ntheta"],)),
    )
    a, b_input, b_theta = step.jacobians(x[:n], x[n : 2 * n], u, values, prescribed, x[2 * n :])

    def after(x: Array, u: Array, values: Array) -> Array:
        q1, p1, _, status = step(x[:n], x[n : 2 * n], u, values, prescribed, x[2 * n :])
        return np.concatenate([q1, p1, status.internal_coordinates])

    fixed = np.array(step.system.prescribed_indices, int)
    by_state = _differences(lambda v: after(v, u, values), x)
    # prescribed coordinates come from the path, so the finite difference does not see them as part of the state
    keep = np.setdiff1d(np.arange(nx), fixed)
    errors = {
        "A": _error(a[:, keep], by_state[:, keep]),
        "B_u": _error(b_input, _differences(lambda v: after(x, v, values), u)),
        "B_theta": _error(b_theta, _differences(lambda v: after(x, u, v), values)),
    }
    radius = float(np.max(np.abs(np.linalg.eigvals(a)), initial=0.0))
    return CheckedLinearisation(x, a, b_input, b_theta, radius, errors)


def linearise_step_equations(step: Step, state: Array, torque: Array, theta: Array, path: Array) -> StepLinearization:
    """Linearised equations of the step that starts at a state, with derivatives by all parameters.

    Parameters
    ----------
    step : Step
    state : ndarray, shape (nx,)
        (q, p, z)
    torque : ndarray, shape (nu,)
        [N m]
    theta : ndarray, shape (ntheta,)
    path : ndarray, shape (nc,)
        Prescribed coordinates, before and after the step.
    """
    n = step.sizes["n"]
    q1, p1, lam, status = step(state[:n], state[n : 2 * n], torque, theta, (path, path), state[2 * n :])
    pair = np.stack([state, np.concatenate([q1, p1, status.internal_coordinates])])
    return step.kernel.linearize(theta, pair, lam[None, :], torque[None, :], step.system.parameters.names, True)


def with_numeric_parameters(system: System, theta: Array) -> System:
    """The system with numeric parameter values in place of symbols, internal coordinates at zero."""
    inner = ca.vertcat(*system.internal_coordinates.values()) if system.internal_coordinates else ca.SX(0, 1)
    symbols = ca.vertcat(system.parameters.symbols, inner)
    values = np.concatenate([theta, np.zeros(inner.numel())])

    def number(expression: ca.SX) -> ca.SX:
        return ca.SX(ca.densify(ca.Function("number", [symbols], [expression])(values)))

    return system.map_expressions(number)


def _differences(function: Callable[[Array], Array], at: Array) -> Array:
    columns = []
    for i in range(len(at)):
        width = _DIFFERENCE_STEP * max(1.0, abs(at[i]))
        up, down = at.copy(), at.copy()
        up[i] += width
        down[i] -= width
        columns.append((function(up) - function(down)) / (2 * width))
    return np.stack(columns, axis=1) if columns else np.zeros((len(function(at)), 0))


def _error(exact: Array, difference: Array) -> float:
    largest = float(np.max(np.abs(exact), initial=0.0))
    return float(np.max(np.abs(exact - difference), initial=0.0)) / largest if largest > 0 else 0.0
