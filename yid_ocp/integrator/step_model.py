"""Data types that all stepping kernels share: step models, rollouts, adjoints and linearizations."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from yid_ocp.arrays import Array
from yid_ocp.errors import InsufficientMemoryError, ModelError
from yid_ocp.integrator import codegen
from yid_ocp.integrator.discrete import ConstraintForcePlacement, DiscreteEquations, ForceSplit, discrete_equations
from yid_ocp.model.system import System

NEWTON_ITERATION_LIMIT = 60  # Newton iterations of one step before it is given up

# Newton stops when a correction of the coordinates is below _COORDINATE_TOLERANCE [rad or m], and for short steps below
# _VELOCITY_TOLERANCE times the step: a remaining correction loses momentum (mass times correction over step).
_COORDINATE_TOLERANCE, _VELOCITY_TOLERANCE, _ROUNDING_FLOOR = 1e-12, 1e-10, 1e-15


@dataclass(frozen=True, eq=False)
class StepEquationsAndFunctions:
    """The equations, functions and index tables of one time step, from which a kernel is built.

    `sizes` holds the numbers of coordinates (n), internal coordinates (nz), constraints (m), inputs (nu), prescribed
    coordinates (nc), states (nx = 2 n + nz) and parameters (ntheta). `time_step` is in s. Newton's method stops at a
    correction below `tolerance` [rad or m].
    """

    system: System
    equations: DiscreteEquations
    functions: codegen.StepFunctions
    index_tables: codegen.StepSparsityTables
    sizes: dict[str, int]
    time_step: float
    tolerance: float


def build_step_model(
    system: System,
    time_step: float,
    force_split: ForceSplit,
    constraint_force_at: ConstraintForcePlacement,
    tolerance: float | None = None,
) -> StepEquationsAndFunctions:
    """Build the equations, functions and index tables of a step. Arguments are as in `compile_step`."""
    e = discrete_equations(system, force_split, constraint_force_at)
    functions = codegen.build_casadi_step_functions(e)
    n, nz = system.n_coordinates, e.z0.numel()
    sizes = {"n": n, "nz": nz, "m": e.lam.numel(), "nu": e.u.numel(), "nc": len(system.prescribed)}
    sizes |= {"nx": 2 * n + nz, "ntheta": e.theta.numel()}
    limit = newton_coordinate_tolerance(time_step) if tolerance is None else tolerance
    tables = codegen.step_elimination_tables(functions)
    return StepEquationsAndFunctions(system, e, functions, tables, sizes, float(time_step), limit)


def newton_coordinate_tolerance(time_step: float) -> float:
    """Return the coordinate correction [rad or m] at which Newton's method has converged, for a time step [s]."""
    return max(_ROUNDING_FLOOR, min(_COORDINATE_TOLERANCE, _VELOCITY_TOLERANCE * time_step))


class NewtonStatusCode(IntEnum):
    """The status codes of Newton's method in one step. The C kernel uses the same numbers."""

    OK = 0
    NOT_CONVERGED = 1
    SINGULAR = 2
    NOT_FINITE = 3
    OUT_OF_MEMORY = 4


_STATUS_MESSAGES = {
    NewtonStatusCode.OK: "converged",
    NewtonStatusCode.NOT_CONVERGED: "Newton's method found no solution of its equations",
    NewtonStatusCode.SINGULAR: "the equations of the step are singular, as with two grasps that hold the same point, "
    "or with a joint that moves no mass",
    NewtonStatusCode.NOT_FINITE: "the state is no longer finite, because the simulated motion is unstable",
    NewtonStatusCode.OUT_OF_MEMORY: "there is not enough memory",
}

_LONG_ROLLOUT_STEPS = 100  # after which a failure is due to the integration method, not to the initial state
_INSTABILITY_CAUSE = "usually because a fast vibration grows: the midpoint rule has no numerical damping"


@dataclass(frozen=True)
class RolloutNewtonSummary:
    """The outcome of a rollout: status code, last Newton correction [rad or m], and Newton iterations of all steps.

    `prescribed_effort` (nc,) [N m] is that at the start of the last step, `internal_coordinates` (nz,) at its end.
    """

    code: NewtonStatusCode
    completed_steps: int
    last_correction: float
    newton_iterations: int
    prescribed_effort: Array = field(default_factory=lambda: np.zeros(0), repr=False)
    internal_coordinates: Array = field(default_factory=lambda: np.zeros(0), repr=False)

    @property
    def is_converged(self) -> bool:
        """True if Newton's method converged in every step."""
        return self.code == NewtonStatusCode.OK

    @property
    def message(self) -> str:
        """A sentence that explains the status, with step and usual cause. It has no advice, which errors add."""
        if self.is_converged:
            return _STATUS_MESSAGES[self.code]
        step, is_open = self.completed_steps, self.code == NewtonStatusCode.NOT_CONVERGED
        said = f"at step {step}, {_STATUS_MESSAGES[self.code]}"
        unstable = step >= _LONG_ROLLOUT_STEPS and (is_open or self.code == NewtonStatusCode.NOT_FINITE)
        return f"{said}, {_INSTABILITY_CAUSE}" if unstable else said


@dataclass(frozen=True)
class SensitivityDirections:
    """The d quantities with respect to which a rollout is differentiated, the named parameters first.

    The tangents are derivatives of initial state (nx, d), torque (N, nu, d) and prescribed path (N + 1, nc, d).
    """

    parameter_names: tuple[str, ...]
    initial_state_tangents: Array
    torque_tangents: Array | None = None
    prescribed_tangents: Array | None = None

    def __post_init__(self) -> None:
        if self.count < len(self.parameter_names):
            what = f"initial_state_tangents has {self.count} columns for {len(self.parameter_names)} parameters"
            allowed = "at least one column for each parameter"
            raise ModelError(what, where="SensitivityDirections", allowed=allowed, hint="add the missing columns")

    @property
    def count(self) -> int:
        """The number d of directions."""
        return self.initial_state_tangents.shape[1]


@dataclass(frozen=True)
class TrackingFeedback:
    """A feedback that keeps driven arms near the measured motion: torque u_k = ubar_k - K_k (x_k[index] - xbar_k).

    `state_indices` (nb,) selects entries of the state (q, p, z). `gain` (N, nu, nb) holds K_k [N m/rad for a
    coordinate, 1/s for a momentum]. `reference` (N, nb) holds the measured values xbar_k of these entries.
    """

    state_indices: NDArray[np.int32]
    gain: Array
    reference: Array


@dataclass(frozen=True)
class RolloutInputs:
    """The inputs of one rollout: parameters, initial state, torques, prescribed path, feedback and directions.

    Shapes: `theta` (ntheta,), initial state (q, p, z) (nx,), nominal motor torque of every step (N, nu) [N m], and
    prescribed coordinates at every node (N + 1, nc) [rad or m].
    """

    theta: Array
    initial_state: Array
    torque: Array
    prescribed_path: Array
    feedback: TrackingFeedback | None = None
    directions: SensitivityDirections | None = None


@dataclass(frozen=True)
class Rollout:
    """A simulated trajectory, with its derivatives (..., d) along d directions. Values after a failed step are NaN.

    `state` (N + 1, nx) holds (q, p, z) at every node, q in rad or m, p in N m s or N s. `multipliers` (N, m) are in N
    s. `effort` (N, nc) is the effort of prescribed coordinates at nodes 0..N-1 [N m], `torque` (N, nu) the applied
    torque [N m]. The effort at node 0 is correct if p_0 contains the impulse of a previous step, as the initial
    momentum of an `Equilibrium` does. If p_0 is computed from the velocity v (p_0 = dL/dv), it contains only half a
    step's impulse, and the effort at node 0 is only half.
    """

    state: Array
    multipliers: Array
    effort: Array
    torque: Array
    state_sensitivity: Array | None
    multipliers_sensitivity: Array | None
    effort_sensitivity: Array | None
    status: RolloutNewtonSummary


CostDerivativesByRolloutOutputs = tuple[Array, Array | None, Array | None]
"""Partial derivatives of a cost by states (N + 1, nx), multipliers (N, m) and efforts (N, nc) of a rollout."""


@dataclass(frozen=True)
class RolloutCostGradient:
    """The gradient of a scalar cost along a rollout, by the adjoint method. NaN if a step's equations are singular.

    It has the derivatives with respect to the chosen parameters, the initial state (nx,), the nominal torque (N, nu)
    and the prescribed coordinates at every node (N + 1, nc). Those at node 0 are also in `by_initial_state`.
    """

    by_theta: Array
    by_initial_state: Array
    by_torque: Array
    by_prescribed_path: Array


@dataclass(frozen=True)
class StepResidualsAndJacobians:
    """The residuals and Jacobians of the step equations along any trajectory, even if it does not satisfy them.

    Each step has nt = n + nz + m equations: momentum balance (n), internal (nz) and constraint (m). `p1` is the
    momentum p_{k+1} (n) that follows from the other values. The Jacobians are with respect to the new values (q_{k+1},
    z_{k+1}, lam_k), the old values (q_k, z_k), the torque and the chosen parameters. That by p_k is the identity.
    """

    residual: Array
    p1: Array
    residual_by_new: Array
    residual_by_old: Array
    residual_by_input: Array
    p1_by_new: Array
    p1_by_old: Array
    p1_by_input: Array
    residual_by_theta: Array
    p1_by_theta: Array


def allocate_rollout(sizes: dict[str, int], steps: int, count: int | None) -> Rollout:
    """Allocate an empty rollout of `steps` steps, with `count` sensitivity directions (None: no directions)."""
    shapes: dict[str, tuple[int, ...]] = {"state": (steps + 1, sizes["nx"]), "multipliers": (steps, sizes["m"])}
    shapes |= {"effort": (steps, sizes["nc"]), "torque": (steps, sizes["nu"])}
    names = [f"{name}_sensitivity" for name in ("state", "multipliers", "effort")]
    if count is not None:
        shapes |= {name: (*shapes[name.removesuffix("_sensitivity")], count) for name in names}
    arrays = _arrays(f"a rollout of {steps} steps with {count or 0} derivatives", shapes, np.empty)
    values: dict[str, Any] = dict.fromkeys(names) | arrays
    return Rollout(**values, status=RolloutNewtonSummary(NewtonStatusCode.OK, 0, 0.0, 0))


def allocate_step_linearizations(
    sizes: dict[str, int], count: int, width: int, derivatives: bool
) -> StepResidualsAndJacobians:
    """Allocate zero-filled linearizations of `count` steps and `width` parameters, with Jacobians if `derivatives`."""
    n, nz, m, nu = sizes["n"], sizes["nz"], sizes["m"], sizes["nu"]
    nt, steps = n + nz + m, count if derivatives else 0
    shapes: dict[str, tuple[int, ...]] = {"residual": (count, nt), "p1": (count, n)}
    for name, columns in {"new": nt, "old": n + nz, "input": nu, "theta": width}.items():
        shapes |= {f"residual_by_{name}": (steps, nt, columns), f"p1_by_{name}": (steps, n, columns)}
    return StepResidualsAndJacobians(**_arrays(f"the derivatives of {count} steps", shapes, np.zeros))


def _arrays(what: str, shapes: Mapping[str, tuple[int, ...]], make: Callable[..., Array]) -> dict[str, Array]:
    try:
        return {name: make(shape) for name, shape in shapes.items()}
    except MemoryError as error:
        raise out_of_memory_error(what, 8 * sum(math.prod(shape) for shape in shapes.values())) from error


def out_of_memory_error(what: str, size: int) -> InsufficientMemoryError:
    """Create the error for a lack of memory, because `what` needs `size` bytes."""
    amount = f"{size / 1e9:.3g} GB" if size >= 1e9 else f"{size / 1e6:.3g} MB"
    said = f"{_STATUS_MESSAGES[NewtonStatusCode.OUT_OF_MEMORY]}: {what} needs {amount}"
    hint = "close other programs; else cut the recording, or estimate fewer parameters at once (parameters.NAME.free)"
    allowed = "a need below the free memory, which `free -h` shows"
    return InsufficientMemoryError(said, where="this machine", allowed=allowed, hint=hint)


def attach_status_to_rollout(
    rollout: Rollout, sizes: dict[str, int], code: int, step: int, error: float, iterations: int
) -> Rollout:
    """Add a status to a rollout, and set values after a failed step to NaN."""
    if code != NewtonStatusCode.OK:
        first_missing = {"state": step + 2, "state_sensitivity": step + 1}  # the last state that was tried is kept
        for name in [name for name, array in vars(rollout).items() if isinstance(array, np.ndarray)]:
            getattr(rollout, name)[first_missing.get(name, step) :] = np.nan
    last = rollout.effort[step - 1] if step else np.zeros(sizes["nc"])
    inner = rollout.state[step, 2 * sizes["n"] :]
    return replace(rollout, status=RolloutNewtonSummary(NewtonStatusCode(code), step, error, iterations, last, inner))
