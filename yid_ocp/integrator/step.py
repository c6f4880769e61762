"""One step of a system, compiled or interpreted: Newton, its Jacobians, and the sweeps built from it."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Protocol

import casadi as ca
import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike, NDArray

from yid_ocp.errors import ModelError
from yid_ocp.integrator import codegen
from yid_ocp.integrator.discrete import DiscreteEquations, ForceSplit, discrete_equations
from yid_ocp.model.system import System

Array = NDArray[np.float64]

# Newton stops when a correction of the coordinates is below TOLERANCE [rad or m], with short time steps below
# RATE_TOLERANCE times the step: what is left undone is momentum lost in every step, mass times correction over step.
TOLERANCE, RATE_TOLERANCE, ROUNDING = 1e-12, 1e-10, 1e-15
ITERATION_LIMIT = 60


class StepCode(IntEnum):
    """How Newton's iteration of a step ended."""

    OK = 0
    NOT_CONVERGED = 1
    SINGULAR = 2
    NOT_FINITE = 3


MESSAGES = {
    StepCode.OK: "converged",
    StepCode.NOT_CONVERGED: "Newton did not converge; try a smaller time step, more damping, or a fitting start",
    StepCode.SINGULAR: "the step's equations are singular; look for redundant grasps or a coordinate without inertia",
    StepCode.NOT_FINITE: "the state is no longer finite; the motion is unstable open loop: add feedback or damping",
}


@dataclass(frozen=True)
class StepStatus:
    """Outcome of a step or of a rollout.

    Attributes
    ----------
    code : StepCode
    step : int
        Steps completed.
    error : float
        Last Newton correction [rad or m].
    iterations, factorisations : int
        Totals over all steps.
    effort : ndarray, shape (nc,)
        Of the last step: effort that the prescribed coordinates needed at its first node [N m].
    internal : ndarray, shape (nz,)
        Internal coordinates after the last step.
    """

    code: StepCode
    step: int
    error: float
    iterations: int
    factorisations: int
    effort: Array = field(default_factory=lambda: np.zeros(0), repr=False)
    internal: Array = field(default_factory=lambda: np.zeros(0), repr=False)

    @property
    def ok(self) -> bool:
        """Whether every step converged."""
        return self.code == StepCode.OK

    @property
    def message(self) -> str:
        """The outcome in words, with the step, the residual and what to try."""
        if self.ok:
            return MESSAGES[self.code]
        return f"step {self.step}: {MESSAGES[self.code]} (last correction {self.error:.2g})"


@dataclass(frozen=True)
class Directions:
    """What to differentiate a rollout by: d columns, the first ones the named parameters.

    Attributes
    ----------
    names : tuple of str
        Parameters of theta.
    start : ndarray, shape (nx, d)
        Derivative of the initial state (q, p, z).
    torque : ndarray, optional, shape (N, nu, d)
        Derivative of the nominal torque.
    path : ndarray, optional, shape (N + 1, nc, d)
        Derivative of the prescribed coordinates.
    """

    names: tuple[str, ...]
    start: Array
    torque: Array | None = None
    path: Array | None = None

    @property
    def count(self) -> int:
        """d, the number of directions."""
        return self.start.shape[1]


@dataclass(frozen=True)
class Feedback:
    """The tracking filter u_k = ubar_k - K_k (x_k[index] - xbar_k).

    Attributes
    ----------
    index : ndarray of int, shape (nb,)
        Rows of the state (q, p, z) that are fed back.
    gain : ndarray, shape (N, nu, nb)
        K_k [N m/rad for a coordinate, 1/s for a momentum].
    reference : ndarray, shape (N, nb)
        Measured values of these rows.
    """

    index: NDArray[np.int32]
    gain: Array
    reference: Array


@dataclass(frozen=True)
class Sweep:
    """A rollout and, where asked for, its forward sensitivities.

    Attributes
    ----------
    state : ndarray, shape (N + 1, nx)
        (q, p, z) at every node.
    multipliers : ndarray, shape (N, m)
        [N s]
    effort : ndarray, shape (N, nc)
        Effort of prescribed coordinates at nodes 0..N-1 [N m]; at node 0 it presumes that p_0 came from a step before
        (`Rest` gives such a p_0); after p_0 = dL/dv it holds only half a step's impulse, half the effort.
    torque : ndarray, shape (N, nu)
        Applied torque [N m].
    by_state, by_multipliers, by_effort : ndarray, shape (..., d), or None
        Derivatives by the directions; like everything else NaN after a step that failed.
    status : StepStatus
    """

    state: Array
    multipliers: Array
    effort: Array
    torque: Array
    by_state: Array | None
    by_multipliers: Array | None
    by_effort: Array | None
    status: StepStatus


@dataclass(frozen=True)
class Gradient:
    """Derivatives of a scalar cost along a rollout, from the adjoint sweep.

    Attributes
    ----------
    by_theta : ndarray, shape (len(names),)
    by_start : ndarray, shape (nx,)
        By the initial state.
    by_torque : ndarray, shape (N, nu)
        By the nominal torque.
    by_path : ndarray, shape (N + 1, nc)
        By the prescribed coordinates at every node, those at node 0 as in `by_start`.

    All NaN where a step's equations turned out singular.
    """

    by_theta: Array
    by_start: Array
    by_torque: Array
    by_path: Array


@dataclass(frozen=True)
class Stages:
    """Equations of many steps at once, along a trajectory that need not satisfy them.

    Attributes
    ----------
    rows : ndarray, shape (N, nt)
        Balance (n), internal (nz) and constraint (m) rows of every step.
    p1 : ndarray, shape (N, n)
        What p_{k+1} should be.
    rows_new, p1_new : ndarray, shape (N, nt, nt) and (N, n, nt)
        Derivatives by (q_{k+1}, z_{k+1}, lam_k).
    rows_old, p1_old : ndarray, shape (N, nt, n + nz) and (N, n, n + nz)
        Derivatives by (q_k, z_k); that of the balance by p_k is the identity.
    rows_input, p1_input : ndarray, shape (N, nt, nu) and (N, n, nu)
        Derivatives by the torque.
    rows_theta, p1_theta : ndarray, shape (N, nt, ntheta) and (N, n, ntheta)
        Derivatives by the chosen parameters.
    """

    rows: Array
    p1: Array
    rows_new: Array
    rows_old: Array
    rows_input: Array
    p1_new: Array
    p1_old: Array
    p1_input: Array
    rows_theta: Array
    p1_theta: Array


class Kernel(Protocol):
    """What the compiled and the interpreted implementation of the sweeps have in common."""

    def sweep(
        self,
        theta: Array,
        start: Array,
        torque: Array,
        path: Array,
        feedback: Feedback | None,
        wanted: Directions | None,
    ) -> Sweep:
        """Roll out over len(torque) steps from the state `start`."""
        ...

    def adjoint(
        self,
        theta: Array,
        swept: Sweep,
        feedback: Feedback | None,
        names: tuple[str, ...],
        by_state: Array,
        by_multipliers: Array | None,
        by_effort: Array | None,
    ) -> Gradient:
        """Gradient of a cost whose partial derivatives along the rollout are given."""
        ...

    def stages(
        self,
        theta: Array,
        state: Array,
        multipliers: Array,
        torque: Array,
        names: tuple[str, ...],
        derivatives: bool,
    ) -> Stages:
        """Equations of len(torque) steps along a trajectory, with their Jacobians where asked for."""
        ...


class Step:
    """The compiled time step of a system; made by `compile_step`.

    Attributes
    ----------
    system : System
    time_step : float
        h [s]
    force_split : str
    tolerance : float
        Newton's, on the coordinates [rad or m].
    equations : DiscreteEquations
    kernel : Kernel
    compiled : bool
        Whether generated C code is used.
    """

    def __init__(
        self,
        system: System,
        time_step: float,
        force_split: ForceSplit,
        use_compiler: bool,
    ) -> None:
        self.system = system
        self.time_step = float(time_step)
        self.force_split: ForceSplit = force_split
        self.tolerance = max(ROUNDING, min(TOLERANCE, RATE_TOLERANCE * self.time_step))
        self.equations: DiscreteEquations = discrete_equations(system, force_split)
        self.functions = codegen.step_functions(self.equations)
        self.structure = codegen.structure(self.functions)
        library = (
            codegen.compile_library(codegen.kernel_source(self.functions, self.structure)) if use_compiler else None
        )
        self.compiled = library is not None
        self.kernel: Kernel = InterpretedKernel(self) if library is None else CompiledKernel(self, library)

    @property
    def sizes(self) -> dict[str, int]:
        """n, nz, m, nu, nc, nx and ntheta."""
        e = self.equations
        n, nz = self.system.size, e.z0.numel()
        return {
            "n": n,
            "nz": nz,
            "m": e.lam.numel(),
            "nu": e.u.numel(),
            "nc": len(self.system.prescribed),
            "nx": 2 * n + nz,
            "ntheta": e.theta.numel(),
        }

    def __call__(
        self,
        q0: ArrayLike,
        p0: ArrayLike,
        u: ArrayLike,
        theta: ArrayLike,
        prescribed: tuple[ArrayLike, ArrayLike] | None = None,
        internal: ArrayLike | None = None,
    ) -> tuple[Array, Array, Array, StepStatus]:
        """One DEL step.

        Parameters
        ----------
        q0, p0 : array_like, shape (n,)
            q_k [rad or m] and p_k [N m s].
        u : array_like, shape (nu,)
            Motor torques held over the step [N m].
        theta : array_like, shape (ntheta,)
        prescribed : pair of array_like, shape (nc,), optional
            s_k and s_{k+1}; required when the system has prescribed coordinates.
        internal : array_like, shape (nz,), optional
            z_k, zero when absent.

        Returns
        -------
        q1, p1 : ndarray, shape (n,)
        lam : ndarray, shape (m,)
        status : StepStatus
        """
        sweep = self._single(q0, p0, u, theta, prescribed, internal, None)
        n = self.system.size
        after = sweep.state[1]
        return after[:n], after[n : 2 * n], sweep.multipliers[0], sweep.status

    def jacobians(
        self,
        q0: ArrayLike,
        p0: ArrayLike,
        u: ArrayLike,
        theta: ArrayLike,
        prescribed: tuple[ArrayLike, ArrayLike] | None = None,
        internal: ArrayLike | None = None,
        names: Sequence[str] | None = None,
    ) -> tuple[Array, Array, Array]:
        """Derivatives of the step map by the implicit function theorem.

        Parameters
        ----------
        names : sequence of str, optional
            Parameters by which to differentiate; all of theta when absent.

        Returns
        -------
        A : ndarray, shape (nx, nx)
            d(q, p, z)_{k+1}/d(q, p, z)_k.
        B_u : ndarray, shape (nx, nu)
        B_theta : ndarray, shape (nx, len(names))
        """
        sizes = self.sizes
        chosen = tuple(self.system.parameters.names if names is None else names)
        nx, nu, nt = sizes["nx"], sizes["nu"], len(chosen)
        start = np.zeros((nx, nt + nx + nu))
        start[:, nt : nt + nx] = np.eye(nx)
        torque = np.zeros((1, nu, nt + nx + nu))
        torque[0, :, nt + nx :] = np.eye(nu)
        sweep = self._single(q0, p0, u, theta, prescribed, internal, Directions(chosen, start, torque))
        assert sweep.by_state is not None
        after = sweep.by_state[1]
        return after[:, nt : nt + nx].copy(), after[:, nt + nx :].copy(), after[:, :nt].copy()

    def _single(
        self,
        q0: ArrayLike,
        p0: ArrayLike,
        u: ArrayLike,
        theta: ArrayLike,
        prescribed: tuple[ArrayLike, ArrayLike] | None,
        internal: ArrayLike | None,
        wanted: Directions | None,
    ) -> Sweep:
        sizes = self.sizes
        z0 = np.zeros(sizes["nz"]) if internal is None else check_shape("internal", internal, (sizes["nz"],))
        start = np.concatenate([check_shape("q0", q0, (sizes["n"],)), check_shape("p0", p0, (sizes["n"],)), z0])
        if prescribed is None:
            if sizes["nc"]:
                raise ModelError(
                    f"{sizes['nc']} coordinates are prescribed", where="step", hint="pass prescribed=(s0, s1)"
                )
            path = np.zeros((2, 0))
        else:
            if len(prescribed) != 2:
                raise ModelError(f"prescribed has {len(prescribed)} entries", allowed="the pair (s0, s1)")
            path = np.stack([check_shape("prescribed", s, (sizes["nc"],)) for s in prescribed])
        start[list(self.system.prescribed_indices)] = path[0]
        torque = check_shape("u", u, (sizes["nu"],))[None, :]
        return self.kernel.sweep(check_shape("theta", theta, (sizes["ntheta"],)), start, torque, path, None, wanted)


def compile_step(
    system: System,
    time_step: float,
    force_split: ForceSplit = "symmetric",
    *,
    use_compiler: bool = True,
) -> Step:
    """Turn a system into a time step.

    Parameters
    ----------
    system : System
    time_step : float
        h [s], positive.
    force_split : "symmetric", "left" or "left_damping"
        Order two; the rule of the paper's engine; or order two but for the dampers (see `discrete_equations`).
    use_compiler : bool
        Whether to generate and compile C; without a compiler on the machine the interpreter is used with one notice.

    Returns
    -------
    Step

    Raises
    ------
    ModelError
        Time step not positive, unknown force split.
    """
    if not (math.isfinite(time_step) and time_step > 0):
        raise ModelError(f"time_step = {time_step}", allowed="a positive number of seconds")
    return Step(system, time_step, force_split, use_compiler)


def check_shape(name: str, values: ArrayLike, shape: tuple[int, ...]) -> Array:
    """The values as a contiguous float array of the given shape; `ModelError` naming it where it has another."""
    array = np.ascontiguousarray(values, dtype=float)
    if array.size == 0 and 0 in shape:
        return np.zeros(shape)
    if array.shape != shape:
        raise ModelError(f"{name} has shape {array.shape}", allowed=f"shape {shape}")
    return array


class _Feedback(ctypes.Structure):
    _fields_ = (
        ("count", ctypes.c_int),
        ("index", ctypes.c_void_p),
        ("gain", ctypes.c_void_p),
        ("reference", ctypes.c_void_p),
    )


class _Directions(ctypes.Structure):
    _fields_ = (
        ("count", ctypes.c_int),
        ("theta_count", ctypes.c_int),
        ("by_theta", ctypes.c_void_p),
        ("rows_pattern", ctypes.c_void_p),
        ("p1_pattern", ctypes.c_void_p),
        ("effort_pattern", ctypes.c_void_p),
        ("rows_nz", ctypes.c_void_p),
        ("p1_nz", ctypes.c_void_p),
        ("effort_nz", ctypes.c_void_p),
        ("w", ctypes.c_void_p),
        ("iw", ctypes.c_void_p),
    )


@dataclass(frozen=True)
class _CompiledColumns:
    address: int
    patterns: tuple[NDArray[np.int64], ...]
    work: int
    keep: object


def _pointer(array: Array | NDArray[np.int32] | NDArray[np.int64] | None) -> ctypes.c_void_p | None:
    return None if array is None else ctypes.c_void_p(array.ctypes.data)


def _contiguous(array: Array | None) -> Array | None:
    return None if array is None else np.ascontiguousarray(array, dtype=float)


class CompiledKernel:
    """Sweeps in generated C; holds no state between calls, so that threads may share it."""

    def __init__(self, step: Step, library: ctypes.CDLL) -> None:
        self._step = step
        self._library = library
        self._columns: dict[tuple[str, ...], _CompiledColumns] = {}

    def _theta_columns(self, names: tuple[str, ...]) -> _CompiledColumns:
        if names not in self._columns:
            function = codegen.theta_function(self._step.equations, names)
            library = codegen.compile_library(codegen.function_source(function))
            if library is None:
                raise ModelError("the compiler worked for the step but not for its derivatives", hint="set CC=none")
            address = ctypes.cast(library.by_theta, ctypes.c_void_p).value
            assert address is not None
            patterns = []
            for out in range(3):
                sparsity = function.sparsity_out(out)
                patterns.append(
                    np.array([sparsity.size1(), sparsity.size2(), *sparsity.colind(), *sparsity.row()], np.int64)
                )
            work = max(function.sz_w(), function.sz_iw(), 1)
            self._columns[names] = _CompiledColumns(address, tuple(patterns), work, library)
        return self._columns[names]

    def _directions(self, names: tuple[str, ...], count: int) -> tuple[_Directions, list[object]]:
        if not names:
            return _Directions(count=count, theta_count=0), []
        columns = self._theta_columns(names)
        values = [np.zeros(max(int(pattern[2 + pattern[1]]), 1)) for pattern in columns.patterns]
        w, iw = np.zeros(columns.work), np.zeros(columns.work, np.int64)
        struct = _Directions(
            count,
            len(names),
            columns.address,
            *(_pointer(pattern) for pattern in columns.patterns),
            *(_pointer(value) for value in values),
            _pointer(w),
            _pointer(iw),
        )
        return struct, [values, w, iw]

    def sweep(
        self,
        theta: Array,
        start: Array,
        torque: Array,
        path: Array,
        feedback: Feedback | None,
        wanted: Directions | None,
    ) -> Sweep:
        """See `Kernel.sweep`."""
        sizes = self._step.sizes
        steps = len(torque)
        theta, torque, path = (np.ascontiguousarray(a, dtype=float) for a in (theta, torque, path))
        state = np.full((steps + 1, sizes["nx"]), np.nan)
        state[0] = start
        multipliers = np.full((steps, sizes["m"]), np.nan)
        effort = np.full((steps, sizes["nc"]), np.nan)
        applied = np.full((steps, sizes["nu"]), np.nan)
        info = np.zeros(4)
        by_state = by_multipliers = by_effort = given_torque = given_path = None
        struct = None
        keep: list[object] = []
        if wanted is not None:
            d = wanted.count
            by_state = np.full((steps + 1, sizes["nx"], d), np.nan)
            by_state[0] = wanted.start
            by_multipliers, by_effort = (np.full((steps, sizes[key], d), np.nan) for key in ("m", "nc"))
            struct, keep = self._directions(wanted.names, d)
            given_torque, given_path = _contiguous(wanted.torque), _contiguous(wanted.path)
        loop, held = _feedback_struct(feedback)
        code = self._library.yid_rollout(
            ctypes.c_int(steps),
            _pointer(theta),
            ctypes.c_double(self._step.time_step),
            _pointer(torque),
            _pointer(path),
            ctypes.byref(loop) if loop is not None else None,
            _pointer(state),
            _pointer(multipliers),
            _pointer(effort),
            _pointer(applied),
            ctypes.byref(struct) if struct is not None else None,
            _pointer(by_state),
            _pointer(by_multipliers),
            _pointer(by_effort),
            _pointer(given_torque),
            _pointer(given_path),
            ctypes.c_double(self._step.tolerance),
            ctypes.c_int(ITERATION_LIMIT),
            _pointer(info),
        )
        del keep, held
        status = _status(code, info, effort, state, sizes)
        return Sweep(state, multipliers, effort, applied, by_state, by_multipliers, by_effort, status)

    def adjoint(
        self,
        theta: Array,
        swept: Sweep,
        feedback: Feedback | None,
        names: tuple[str, ...],
        by_state: Array,
        by_multipliers: Array | None,
        by_effort: Array | None,
    ) -> Gradient:
        """See `Kernel.adjoint`."""
        sizes = self._step.sizes
        steps = len(swept.multipliers)
        gradient, by_start = np.zeros(max(len(names), 1)), np.zeros(sizes["nx"])
        by_torque, by_path = np.zeros((steps, sizes["nu"])), np.zeros((steps + 1, sizes["nc"]))
        info = np.zeros(4)
        struct, keep = self._directions(names, len(names))
        loop, held = _feedback_struct(feedback)
        inputs = [np.ascontiguousarray(a, dtype=float) for a in (theta, swept.torque, swept.state, swept.multipliers)]
        partial = [_contiguous(a) for a in (by_state, by_multipliers, by_effort)]
        code = self._library.yid_adjoint(
            ctypes.c_int(steps),
            _pointer(inputs[0]),
            ctypes.c_double(self._step.time_step),
            _pointer(inputs[1]),
            ctypes.byref(loop) if loop is not None else None,
            _pointer(inputs[2]),
            _pointer(inputs[3]),
            ctypes.byref(struct),
            *(_pointer(a) for a in partial),
            _pointer(gradient),
            _pointer(by_start),
            _pointer(by_torque),
            _pointer(by_path),
            _pointer(info),
        )
        del keep, held
        if code != StepCode.OK:
            for array in (gradient, by_start, by_torque, by_path):
                array[:] = np.nan
        return Gradient(gradient[: len(names)], by_start, by_torque, by_path)

    def stages(
        self,
        theta: Array,
        state: Array,
        multipliers: Array,
        torque: Array,
        names: tuple[str, ...],
        derivatives: bool,
    ) -> Stages:
        """See `Kernel.stages`."""
        inputs = [np.ascontiguousarray(a, dtype=float) for a in (theta, state, multipliers, torque)]
        stages = _empty_stages(self._step.sizes, len(torque), len(names), derivatives)
        struct, keep = self._directions(names, len(names))
        matrices = [getattr(stages, field) if derivatives else None for field in _STAGE_MATRICES]
        self._library.yid_stages(
            ctypes.c_int(len(torque)),
            _pointer(inputs[0]),
            ctypes.c_double(self._step.time_step),
            *(_pointer(a) for a in inputs[1:]),
            ctypes.byref(struct),
            _pointer(stages.rows),
            _pointer(stages.p1),
            *(_pointer(matrix) for matrix in matrices),
        )
        del keep
        return stages


# The order in which `yid_stages` takes them.
_STAGE_MATRICES = (
    "rows_new",
    "rows_old",
    "rows_input",
    "p1_new",
    "p1_old",
    "p1_input",
    "rows_theta",
    "p1_theta",
)


def _empty_stages(sizes: dict[str, int], count: int, width: int, derivatives: bool) -> Stages:
    n, nz, m, nu = sizes["n"], sizes["nz"], sizes["m"], sizes["nu"]
    nt, steps = n + nz + m, count if derivatives else 0
    return Stages(
        np.zeros((count, nt)),
        np.zeros((count, n)),
        *(np.zeros((steps, rows, columns)) for rows in (nt, n) for columns in (nt, n + nz, nu)),
        *(np.zeros((steps, rows, width)) for rows in (nt, n)),
    )


def _feedback_struct(feedback: Feedback | None) -> tuple[_Feedback | None, list[object]]:
    if feedback is None:
        return None, []
    index = np.ascontiguousarray(feedback.index, np.int32)
    gain, reference = np.ascontiguousarray(feedback.gain, float), np.ascontiguousarray(feedback.reference, float)
    return _Feedback(len(index), _pointer(index), _pointer(gain), _pointer(reference)), [index, gain, reference]


def _status(code: int, info: Array, effort: Array, state: Array, sizes: dict[str, int]) -> StepStatus:
    done = int(info[0])
    last = effort[done - 1] if done else np.zeros(sizes["nc"])
    return StepStatus(
        StepCode(code), done, float(info[1]), int(info[2]), int(info[3]), last, state[done, 2 * sizes["n"] :]
    )


@dataclass
class _Linearised:
    """Dense Jacobians of one converged step, as in `kernel.c`."""

    rows_new: Array
    rows_old: Array
    rows_input: Array
    p1_new: Array
    p1_old: Array
    p1_input: Array


class InterpretedKernel:
    """The same sweeps by CasADi's interpreter and SciPy's LU, for machines without a C compiler."""

    def __init__(self, step: Step) -> None:
        self._step = step
        n = step.system.size
        self._mask = np.zeros((n, n), bool)
        for j, chain in enumerate(step.structure.ancestors):
            self._mask[j, chain] = True
        self._theta_functions: dict[tuple[str, ...], ca.Function] = {}
        patterns = step.functions.patterns
        self._triplets = {
            key: tuple(np.array(part, np.intp) for part in s.get_triplet()) for key, s in patterns.items()
        }
        self._unknown = step.structure.unknown_row
        self._free = np.array(step.system.free_indices, np.intp)
        self._fixed = np.array(step.system.prescribed_indices, np.intp)

    def _scales(self, theta: Array) -> tuple[Array, float]:
        s = self._step.sizes
        zero = [np.zeros(s["n"])] * 3 + [np.zeros(s["nz"])] * 2 + [np.zeros(s["m"]), np.zeros(s["nu"])]
        scale, h = self._step.functions.scales(*zero, theta, self._step.time_step)
        return np.array(scale).ravel(), float(h)

    def _matrix(self, arguments: list[Array | float]) -> Array:
        s = self._step.sizes
        phi = np.zeros((s["m"], s["n"]))
        phi[self._triplets["matrix"]] = np.array(self._step.functions.matrix(*arguments)).ravel()
        return phi

    def _rows(self, arguments: list[Array | float], phi: Array, scale: Array) -> tuple[Array, Array]:
        balance, internal, constraint, p1 = (np.array(x).ravel() for x in self._step.functions.residual(*arguments))
        pull = phi.T @ np.asarray(arguments[5])
        return np.concatenate([balance - scale * pull, internal, constraint]), p1

    def _linearise(self, arguments: list[Array | float], phi: Array, scale: Array) -> _Linearised:
        s = self._step.sizes
        n, nz, m, nu = s["n"], s["nz"], s["m"], s["nu"]
        nt, nqz = n + nz + m, n + nz
        pairs, rest, rest_p, by_unknown = (np.array(x).ravel() for x in self._step.functions.linear(*arguments))
        plus, minus, lower, upper = (pairs[6 * n * i : 6 * n * (i + 1)].reshape(6, n) for i in range(4))
        turn, moment = pairs[24 * n : 27 * n].reshape(3, n), pairs[27 * n :].reshape(3, n)
        weight = moment.T @ turn
        low, up = (
            np.where(self._mask, lower.T @ plus + weight, 0.0),
            np.where(self._mask, weight - upper.T @ minus, 0.0),
        )
        here = np.where(self._mask, weight - lower.T @ minus, 0.0)
        there = np.where(self._mask, weight + upper.T @ plus, 0.0)
        strict = np.tril(np.ones((n, n)), -1)

        def both(below: Array, above: Array) -> Array:
            diagonal = np.diag(np.diag(below))
            return below * strict + (above * strict).T + diagonal

        slope = both(low, up)
        rows_new, rows_old, rows_input = np.zeros((nt, nt)), np.zeros((nt, nqz)), np.zeros((nt, nu))
        p1_new, p1_old, p1_input = np.zeros((n, nt)), np.zeros((n, nqz)), np.zeros((n, nu))
        rows_new[:n, :n] = scale[:, None] * slope
        rows_old[:n, :n] = scale[:, None] * both(here, here)
        p1_new[:, :n], p1_old[:, :n] = scale[:, None] * both(there, there), scale[:, None] * slope.T
        for key, values, blocks in (
            ("rest", rest, (rows_new, rows_old, rows_input)),
            ("rest_p", rest_p, (p1_new, p1_old, p1_input)),
        ):
            row, column = self._triplets[key]
            wide = np.zeros((blocks[0].shape[0], nt + nqz + nu))
            wide[row, column] = values
            for block, part in zip(blocks, np.split(wide, [nt, nt + nqz], axis=1), strict=True):
                block += part
        row, column = self._triplets["constraint"]
        rows_new[n + nz + row, column] += by_unknown
        rows_new[:n, n + nz :] -= scale[:, None] * phi.T
        if m:
            row, column = self._triplets["pull"]
            rows_old[row, column] -= scale[row] * np.array(self._step.functions.pull(*arguments)).ravel()
        return _Linearised(rows_new, rows_old, rows_input, p1_new, p1_old, p1_input)

    def _by_theta(self, names: tuple[str, ...], arguments: list[Array | float]) -> list[Array]:
        if names not in self._theta_functions:
            self._theta_functions[names] = codegen.theta_function(self._step.equations, names)
        return [np.array(ca.densify(out)) for out in self._theta_functions[names].call(arguments)]

    def _newton(self, arguments: list[Array | float], phi: Array, scale: Array) -> tuple[StepCode, float, Array, int]:
        n, nz = self._step.sizes["n"], self._step.sizes["nz"]
        count = len(self._free) + nz
        q1, z1, lam = arguments[1], arguments[4], arguments[5]
        assert isinstance(q1, np.ndarray)
        assert isinstance(z1, np.ndarray)
        assert isinstance(lam, np.ndarray)
        previous, error, tolerance = math.inf, 0.0, self._step.tolerance
        for iteration in range(1, ITERATION_LIMIT + 1):
            rows, p1 = self._rows(arguments, phi, scale)
            if not np.all(np.isfinite(rows[self._unknown])):
                return StepCode.NOT_FINITE, error, p1, iteration
            if len(self._unknown) == 0:
                return StepCode.OK, 0.0, p1, iteration
            jacobian = self._linearise(arguments, phi, scale).rows_new[np.ix_(self._unknown, self._unknown)]
            *factors, singular = scipy.linalg.lapack.dgetrf(jacobian)
            if singular:
                return StepCode.SINGULAR, error, p1, iteration
            delta = -scipy.linalg.lu_solve(factors, rows[self._unknown], check_finite=False)
            error = float(np.max(np.abs(delta[:count]), initial=0.0))
            if not math.isfinite(error):
                return StepCode.SINGULAR, error, p1, iteration
            if error <= tolerance or (error < 1e3 * tolerance and error > 0.5 * previous):
                lam += delta[count:]
                return StepCode.OK, error, p1, iteration
            previous = error
            keep = q1.copy(), z1.copy(), lam.copy()
            factor = 0.5 / error if error > 0.5 else 1.0
            while True:
                q1[self._free] += factor * delta[: len(self._free)]
                z1 += factor * delta[len(self._free) : count]
                lam += factor * delta[count:]
                trial = scipy.linalg.lu_solve(
                    factors, self._rows(arguments, phi, scale)[0][self._unknown], check_finite=False
                )
                if np.max(np.abs(trial[:count]), initial=0.0) <= (1 - 0.25 * factor) * error:
                    break
                if factor < 1e-4:
                    return StepCode.NOT_CONVERGED, error, p1, iteration
                q1[:], z1[:], lam[:] = keep
                factor *= 0.5
        return StepCode.NOT_CONVERGED, error, np.full(n, np.nan), ITERATION_LIMIT

    def sweep(
        self,
        theta: Array,
        start: Array,
        torque: Array,
        path: Array,
        feedback: Feedback | None,
        wanted: Directions | None,
    ) -> Sweep:
        """See `Kernel.sweep`."""
        s = self._step.sizes
        n, m, nx = s["n"], s["m"], s["nx"]
        steps, d = len(torque), 0 if wanted is None else wanted.count
        scale, h = self._scales(theta)
        state = np.full((steps + 1, nx), np.nan)
        state[0] = start
        multipliers, effort = np.full((steps, m), np.nan), np.full((steps, s["nc"]), np.nan)
        applied = np.full((steps, s["nu"]), np.nan)
        by_state, by_multipliers = np.full((steps + 1, nx, d), np.nan), np.full((steps, m, d), np.nan)
        by_effort = np.full((steps, s["nc"], d), np.nan)
        if wanted is not None:
            by_state[0] = wanted.start
        total, code, error, k = 0, StepCode.OK, 0.0, 0
        lam = np.zeros(m)
        for k in range(steps):
            x = state[k]
            u = torque[k].copy()
            if feedback is not None:
                u -= feedback.gain[k] @ (x[feedback.index] - feedback.reference[k])
            guess = x if k == 0 else 2 * x - state[k - 1] if k == 1 else 3 * (x - state[k - 1]) + state[k - 2]
            q1, z1, lam = guess[:n].copy(), guess[2 * n :].copy(), lam.copy()
            q1[self._fixed] = path[k + 1]
            arguments: list[Array | float] = [
                x[:n],
                q1,
                x[n : 2 * n],
                x[2 * n :],
                z1,
                lam,
                u,
                theta,
                self._step.time_step,
            ]
            phi = self._matrix(arguments)
            code, error, p1, spent = self._newton(arguments, phi, scale)
            if code != StepCode.OK:
                q1[self._free], z1[:], lam[:] = x[self._free], x[2 * n :], 0.0
                code, error, p1, more = self._newton(arguments, phi, scale)
                spent += more
            total += spent
            state[k + 1] = np.concatenate([q1, p1, z1])
            if code != StepCode.OK:
                break
            applied[k], multipliers[k] = u, lam
            effort[k] = -self._rows(arguments, phi, scale)[0][self._fixed] / h
            if wanted is not None:
                by_state[k + 1], by_multipliers[k], by_effort[k] = self._sensitivity(
                    arguments, phi, scale, h, wanted, by_state[k], k, feedback
                )
        else:
            k = steps
        info = np.array([k, error, total, total], dtype=float)
        status = _status(int(code), info, effort, state, s)
        some = wanted is not None
        return Sweep(
            state,
            multipliers,
            effort,
            applied,
            by_state if some else None,
            by_multipliers if some else None,
            by_effort if some else None,
            status,
        )

    def _sensitivity(
        self,
        arguments: list[Array | float],
        phi: Array,
        scale: Array,
        h: float,
        wanted: Directions,
        before: Array,
        k: int,
        feedback: Feedback | None,
    ) -> tuple[Array, Array, Array]:
        s = self._step.sizes
        n, nz, nt, d = s["n"], s["nz"], s["n"] + s["nz"] + s["m"], wanted.count
        matrices = self._linearise(arguments, phi, scale)
        old = np.concatenate([before[:n], before[2 * n :]])
        rows = matrices.rows_old @ old
        rows[:n] += before[n : 2 * n]
        change = np.zeros((s["nu"], d)) if wanted.torque is None else wanted.torque[k].copy()
        if feedback is not None:
            change -= feedback.gain[k] @ before[feedback.index]
        rows += matrices.rows_input @ change
        joined = np.zeros((nt, d))
        if wanted.path is not None:
            joined[self._fixed] = wanted.path[k + 1]
            rows += matrices.rows_new[:, self._fixed] @ wanted.path[k + 1]
        p1 = matrices.p1_input @ change
        by_effort = -rows[self._fixed] / h
        if wanted.names:
            width = len(wanted.names)
            by_rows, by_p1, partial = self._by_theta(wanted.names, arguments)
            rows[:, :width] += by_rows
            p1[:, :width] += by_p1
            by_effort[:, :width] += partial
        if len(self._unknown):
            jacobian = matrices.rows_new[np.ix_(self._unknown, self._unknown)]
            joined[self._unknown] = -np.linalg.solve(jacobian, rows[self._unknown])
        p1 += matrices.p1_old @ old + matrices.p1_new @ joined
        free = np.setdiff1d(np.arange(nt), self._fixed)
        by_effort -= matrices.rows_new[np.ix_(self._fixed, free)] @ joined[free] / h
        return np.concatenate([joined[:n], p1, joined[n : n + nz]]), joined[n + nz :], by_effort

    def adjoint(
        self,
        theta: Array,
        swept: Sweep,
        feedback: Feedback | None,
        names: tuple[str, ...],
        by_state: Array,
        by_multipliers: Array | None,
        by_effort: Array | None,
    ) -> Gradient:
        """See `Kernel.adjoint`."""
        s = self._step.sizes
        n, nt = s["n"], s["n"] + s["nz"] + s["m"]
        scale, h = self._scales(theta)
        steps = len(swept.multipliers)
        gradient, by_torque, by_path = np.zeros(len(names)), np.zeros((steps, s["nu"])), np.zeros((steps + 1, s["nc"]))
        costate = by_state[steps].copy()
        for k in reversed(range(steps)):
            x, after = swept.state[k], swept.state[k + 1]
            arguments: list[Array | float] = [
                x[:n],
                after[:n],
                x[n : 2 * n],
                x[2 * n :],
                after[2 * n :],
                swept.multipliers[k],
                swept.torque[k],
                theta,
                self._step.time_step,
            ]
            matrices = self._linearise(arguments, self._matrix(arguments), scale)
            weight = costate[n : 2 * n]
            effort = np.zeros(s["nc"]) if by_effort is None else by_effort[k]
            last = np.zeros(s["m"]) if by_multipliers is None else by_multipliers[k]
            outer = np.concatenate([costate[:n], costate[2 * n :], last]) + matrices.p1_new.T @ weight
            outer -= matrices.rows_new[self._fixed].T @ effort / h
            full = np.zeros(nt)
            if len(self._unknown):
                jacobian = matrices.rows_new[np.ix_(self._unknown, self._unknown)]
                full[self._unknown] = -np.linalg.solve(jacobian.T, outer[self._unknown])
            if names:
                by_rows, by_p1, partial = self._by_theta(names, arguments)
                gradient += full @ by_rows + weight @ by_p1 + effort @ partial
            by_path[k + 1] = outer[self._fixed] + full @ matrices.rows_new[:, self._fixed]
            full[self._fixed] = -effort / h
            old = matrices.rows_old.T @ full + matrices.p1_old.T @ weight
            by_torque[k] = matrices.rows_input.T @ full + matrices.p1_input.T @ weight
            costate = np.concatenate([old[:n], full[:n], old[n:]]) + by_state[k]
            if feedback is not None:
                np.subtract.at(costate, feedback.index, feedback.gain[k].T @ by_torque[k])
        by_path[0] = costate[self._fixed]
        return Gradient(gradient, costate, by_torque, by_path)

    def stages(
        self,
        theta: Array,
        state: Array,
        multipliers: Array,
        torque: Array,
        names: tuple[str, ...],
        derivatives: bool,
    ) -> Stages:
        """See `Kernel.stages`."""
        s = self._step.sizes
        n = s["n"]
        scale, _ = self._scales(theta)
        stages = _empty_stages(s, len(torque), len(names), derivatives)
        for k, u in enumerate(torque):
            x, after = state[k], state[k + 1]
            arguments: list[Array | float] = [
                x[:n],
                after[:n],
                x[n : 2 * n],
                x[2 * n :],
                after[2 * n :],
                multipliers[k],
                u,
                theta,
                self._step.time_step,
            ]
            phi = self._matrix(arguments)
            stages.rows[k], stages.p1[k] = self._rows(arguments, phi, scale)
            if derivatives:
                matrices = self._linearise(arguments, phi, scale)
                for name in _STAGE_MATRICES[:6]:
                    getattr(stages, name)[k] = getattr(matrices, name)
                if names:
                    stages.rows_theta[k], stages.p1_theta[k], _ = self._by_theta(names, arguments)
        return stages
