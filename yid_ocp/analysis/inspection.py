"""The symbolic side of a step in numbers: sizes, operations, sparsity, linearisation at a state, finite differences."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from yid_ocp.errors import OutputError
from yid_ocp.integrator.step import Step, check_shape

Array = NDArray[np.float64]

DIFFERENCE = 1e-5  # balances Newton's tolerance against the third derivative, for angles and stiffnesses of order one


@dataclass(frozen=True)
class Operations:
    """Size of one generated function: operations of its expression graph and nonzeros of its outputs."""

    name: str
    operations: int
    nonzeros: int


@dataclass(frozen=True)
class Inspection:
    """What the equations of a step look like.

    Attributes
    ----------
    sizes : dict of str to int
        n, nz, m, nu, nc, nx, ntheta.
    unknowns : int
        Free coordinates, internal coordinates and multipliers that Newton's iteration solves for.
    jacobian_nonzeros : int
        Of the DEL residual by the unknowns.
    functions : tuple of Operations
        Residual, its Jacobian's parts and the rest, as generated.
    """

    sizes: dict[str, int]
    unknowns: int
    jacobian_nonzeros: int
    functions: tuple[Operations, ...]


@dataclass(frozen=True)
class Linearisation:
    """A_k, B_k at a state, and how far they are from finite differences.

    Attributes
    ----------
    state : ndarray, shape (nx,)
        (q, p, z)
    a : ndarray, shape (nx, nx)
    b_input : ndarray, shape (nx, nu)
    b_theta : ndarray, shape (nx, ntheta)
    spectral_radius : float
        Largest absolute eigenvalue of A.
    errors : dict of str to float
        Largest difference from central finite differences, as a fraction of the matrix's largest entry.
    """

    state: Array
    a: Array
    b_input: Array
    b_theta: Array
    spectral_radius: float
    errors: dict[str, float]


def inspect_step(step: Step) -> Inspection:
    """Count variables, equations and operations of a step."""
    e = step.equations
    functions = tuple(
        Operations(f.name(), f.n_instructions(), sum(f.nnz_out(i) for i in range(f.n_out())))
        for f in step.functions.all
    )
    return Inspection(step.sizes, e.unknowns.numel(), jacobian_sparsity(step).nnz(), functions)


def jacobian_sparsity(step: Step) -> ca.Sparsity:
    """Pattern of d(DEL residual)/d(unknowns), shape (ny, ny)."""
    e = step.equations
    pattern: ca.Sparsity = ca.jacobian_sparsity(e.residual, e.unknowns)
    return pattern


def sparsity_picture(step: Step, path: str | Path) -> None:
    """Draw the pattern of the residual's Jacobian as PNG, blocks of coordinates and multipliers set apart.

    Raises
    ------
    OutputError
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    pattern = jacobian_sparsity(step)
    row, column = (np.array(part) for part in pattern.get_triplet())
    count, m = pattern.size1(), step.sizes["m"]
    figure = Figure(figsize=(6.4, 6.6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.scatter(column, row, s=max(1.0, (250.0 / max(count, 1)) ** 2), marker="s", color="#0b6e99", linewidths=0)
    for edge in (count - m - step.sizes["nz"] - 0.5, count - m - 0.5):
        if -0.5 < edge < count - 0.5:
            axes.axhline(edge, color="#c2571a", linewidth=0.8)
            axes.axvline(edge, color="#c2571a", linewidth=0.8)
    edge = max(count, 1) - 0.5
    axes.set(xlim=(-0.5, edge), ylim=(edge, -0.5), aspect="equal")
    axes.set_xlabel("unknown: coordinates, internal coordinates, multipliers")
    axes.set_ylabel("equation")
    axes.set_title(f"Jacobian of one step: {count} x {count}, {pattern.nnz()} nonzeros", fontsize=10)
    try:
        figure.savefig(path, dpi=130, format="png")
    except OSError as error:
        raise OutputError(f"the picture cannot be written: {error.strerror}", where=str(path)) from error


def linearise(
    step: Step, state: ArrayLike, torque: ArrayLike, theta: ArrayLike, prescribed: tuple[ArrayLike, ArrayLike] | None
) -> Linearisation:
    """A_k, B_k at a state by the implicit function theorem, compared with central finite differences of the step.

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
    x = check_shape("state", state, (nx,))
    u, values = check_shape("torque", torque, (sizes["nu"],)), check_shape("theta", theta, (sizes["ntheta"],))
    a, b_input, b_theta = step.jacobians(x[:n], x[n : 2 * n], u, values, prescribed, x[2 * n :])

    def after(x: Array, u: Array, values: Array) -> Array:
        q1, p1, _, status = step(x[:n], x[n : 2 * n], u, values, prescribed, x[2 * n :])
        return np.concatenate([q1, p1, status.internal])

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
    return Linearisation(x, a, b_input, b_theta, radius, errors)


def _differences(function: Callable[[Array], Array], at: Array) -> Array:
    columns = []
    for i in range(len(at)):
        width = DIFFERENCE * max(1.0, abs(at[i]))
        up, down = at.copy(), at.copy()
        up[i] += width
        down[i] -= width
        columns.append((function(up) - function(down)) / (2 * width))
    return np.stack(columns, axis=1) if columns else np.zeros((len(function(at)), 0))


def _error(exact: Array, difference: Array) -> float:
    largest = float(np.max(np.abs(exact), initial=0.0))
    return float(np.max(np.abs(exact - difference), initial=0.0)) / largest if largest > 0 else 0.0
