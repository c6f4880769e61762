"""Steps and rollouts of a system, with sensitivities, adjoints and linearized steps."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from yid_ocp.arrays import Array, BoolArray
from yid_ocp.display import ReprMixin, ReprTexts
from yid_ocp.errors import ModelError
from yid_ocp.integrator import codegen, compiler
from yid_ocp.integrator.compiled import CompiledKernel
from yid_ocp.integrator.discrete import ConstraintForcePlacement, DiscreteEquations, ForceSplit
from yid_ocp.integrator.interpreted import InterpretedKernel
from yid_ocp.integrator.step_model import (
    Rollout,
    RolloutInputs,
    RolloutNewtonSummary,
    SensitivityDirections,
    StepEquationsAndFunctions,
    TrackingFeedback,
    build_step_model,
    newton_coordinate_tolerance,
)
from yid_ocp.model.system import System
from yid_ocp.parallel import CASADI_LOCK

_STEPS_PER_CHUNK = 16  # linearised at once, few because their matrices are dense
_MIN_SLOPE = 1e-12  # derivatives by an internal state up to here are rounding
_ALL_STEPS = slice(None)


@dataclass(frozen=True, eq=False, repr=False)
class Step(ReprMixin):
    """The map from a system's state to its state one time step later. `is_compiled` is True if it runs generated C."""

    model: StepEquationsAndFunctions
    kernel: CompiledKernel | InterpretedKernel
    is_compiled: bool

    def _summary(self) -> ReprTexts:
        how = "compiled" if self.is_compiled else "interpreted"
        return ReprTexts(f"{self.time_step:g} s, {self.force_split}, {how}, of {self.system._summary().one_line}")

    @property
    def system(self) -> System:
        """The system that the step simulates."""
        return self.model.system

    @property
    def time_step(self) -> float:
        """The time step h [s]."""
        return self.model.time_step

    def clock_scaled_time_step(self, theta: Array) -> float:
        """Return the time step [s] corrected for the recording's clock: h times `System.recorded_time_scale`."""
        return float(self._clock(theta, self.time_step))

    @functools.cached_property
    def _clock(self) -> ca.Function:
        with CASADI_LOCK:
            return ca.Function("clock", [self.equations.theta, self.equations.time_step], [self.equations.h])

    @property
    def force_split(self) -> ForceSplit:
        """The split of a step's forces between its nodes: `symmetric` (half to each) or `left` (all to the first)."""
        return self.model.equations.force_split

    @property
    def equations(self) -> DiscreteEquations:
        """The symbolic equations that one step solves."""
        return self.model.equations

    @property
    def sizes(self) -> dict[str, int]:
        """The dimensions n (coordinates), nz (internal), m (constraints), nu (inputs), nc (prescribed), nx, ntheta."""
        return self.model.sizes

    def __call__(
        self,
        q0: ArrayLike,
        p0: ArrayLike,
        u: ArrayLike,
        theta: ArrayLike,
        prescribed: tuple[ArrayLike, ArrayLike] | None = None,
        internal: ArrayLike | None = None,
    ) -> tuple[Array, Array, Array, RolloutNewtonSummary]:
        """Compute one DEL step. Returns q_{k+1}, p_{k+1}, the multipliers lam (m,) and a status.

        Parameters
        ----------
        q0, p0 : array_like, shape (n,)
            q_k [rad or m] and p_k [N m s].
        u : array_like, shape (nu,)
            Motor torques held over the step [N m].
        prescribed : pair of array_like, shape (nc,), optional
            Prescribed coordinates at both nodes; required if the system has any.
        internal : array_like, shape (nz,), optional
            Internal coordinates z_k; default: zero.
        """
        rollout, n = self._single(q0, p0, u, theta, prescribed, internal, None), self.sizes["n"]
        return rollout.state[1, :n], rollout.state[1, n : 2 * n], rollout.multipliers[0], rollout.status

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
        """Compute Jacobians of the next state with respect to state, input and the parameters `names` (default: all).

        Returns A (nx, nx), B_u (nx, nu) and B_theta (nx, len(names)), computed by the implicit function theorem. The
        other arguments are as in `__call__`.
        """
        sizes = self.sizes
        chosen = tuple(self.system.parameters.names if names is None else names)
        nx, nu, nt = sizes["nx"], sizes["nu"], len(chosen)
        start = np.zeros((nx, nt + nx + nu))
        start[:, nt : nt + nx] = np.eye(nx)
        torque = np.zeros((1, nu, nt + nx + nu))
        torque[0, :, nt + nx :] = np.eye(nu)
        rollout = self._single(q0, p0, u, theta, prescribed, internal, SensitivityDirections(chosen, start, torque))
        assert rollout.state_sensitivity is not None
        after = rollout.state_sensitivity[1]
        return after[:, nt : nt + nx].copy(), after[:, nt + nx :].copy(), after[:, :nt].copy()

    def _single(
        self,
        q0: ArrayLike,
        p0: ArrayLike,
        u: ArrayLike,
        theta: ArrayLike,
        prescribed: tuple[ArrayLike, ArrayLike] | None,
        internal: ArrayLike | None,
        wanted: SensitivityDirections | None,
    ) -> Rollout:
        sizes, check = self.sizes, float_array_with_checked_shape
        z0 = np.zeros(sizes["nz"]) if internal is None else check("internal", internal, (sizes["nz"],))
        start = np.concatenate([check("q0", q0, (sizes["n"],)), check("p0", p0, (sizes["n"],)), z0])
        ends = prescribed if prescribed is not None else () if sizes["nc"] else ((), ())
        if len(ends) != 2:
            what = f"the argument `prescribed` has {len(ends)} entries for {sizes['nc']} prescribed coordinates"
            allowed = f"(s0, s1): their values at the start and at the end of the step, each of shape ({sizes['nc']},)"
            raise ModelError(what, where="prescribed", allowed=allowed, hint="pass prescribed=(s0, s1) [rad or m]")
        path = np.stack([check("prescribed", s, (sizes["nc"],)) for s in ends])
        torque = check("u", u, (sizes["nu"],))[None, :]
        return self.kernel.rollout(checked_rollout_inputs(self, theta, start, 1, torque, path, None, wanted))


def compile_step(
    system: System,
    time_step: float,
    force_split: ForceSplit = "symmetric",
    constraint_force_at: ConstraintForcePlacement = "midpoint",
    *,
    use_compiler: bool = True,
    tolerance: float | None = None,
) -> Step:
    """Build the step map of a system, as compiled C code if there is a compiler.

    Raises `ModelError` if the time step is not positive, or the force split or constraint force is unknown.

    Parameters
    ----------
    time_step : float
        h [s], positive.
    force_split : "symmetric" or "left"
        "symmetric" has order two; "left" is the rule of Caldwell et al. (2014).
    constraint_force_at : "node" or "midpoint"
        Where the constraint forces act. "node" is the rule of that paper; "midpoint" is stable under any tension (see
        the module `discrete`).
    use_compiler : bool
        If False, or if the machine has no compiler (with one log message), the step is interpreted.
    tolerance : float, optional
        Correction of the coordinates at which Newton's method stops [rad or m]; default: from the time step.

    Returns
    -------
    Step
        Map from (q, p, z) [rad or m, N m s or N s, 1] to these values one time step later.
    """
    model = build_step_model(system, _positive(time_step), force_split, constraint_force_at, tolerance)
    library = None
    if use_compiler:
        parts = model.functions, model.index_tables
        source = functools.partial(codegen.kernel_c_source, *parts)
        library = compiler.compile_and_load_library(codegen.kernel_cache_key_text(*parts), source)
    if library is None:
        return Step(model, InterpretedKernel(model), is_compiled=False)
    return Step(model, CompiledKernel(model, library), is_compiled=True)


def step_with_time_step(step: Step, time_step: float) -> Step:
    """Return a copy of a step with another positive time step [s]. Equations and compiled code are shared."""
    model = replace(step.model, time_step=_positive(time_step), tolerance=newton_coordinate_tolerance(time_step))
    return Step(model, step.kernel.make_kernel_sharing_code(model), step.is_compiled)


def compile_step_like(step: Step, system: System, *, use_compiler: bool | None = None) -> Step:
    """Build a step of another system with the time step and integration scheme of `step`."""
    compiled = step.is_compiled if use_compiler is None else use_compiler
    rules = (step.force_split, step.equations.constraint_force_at)
    return compile_step(system, step.time_step, *rules, use_compiler=compiled)


def _positive(time_step: float) -> float:
    if not (math.isfinite(time_step) and time_step > 0):
        what, hint = f"time_step is {time_step}, but must be finite and above 0", "for example time_step=0.002"
        raise ModelError(what, where="time_step", allowed="a number above 0 [s]", hint=hint)
    return time_step


def float_array_with_checked_shape(name: str, values: ArrayLike, shape: tuple[int, ...]) -> Array:
    """Convert values to a contiguous float array. Raises `ModelError` with `name` if its shape is not `shape`."""
    array = np.ascontiguousarray(values, dtype=float)
    if array.size == 0 and 0 in shape:
        return np.zeros(shape)
    if array.shape != shape:
        what, hint = f"{name} has shape {array.shape}, but must have shape {shape}", f"pass {name} with shape {shape}"
        raise ModelError(what, where=name, allowed=f"shape {shape}", hint=hint)
    return array


def simulate(
    step: Step,
    theta: ArrayLike,
    start: ArrayLike,
    steps: int,
    torque: ArrayLike | None = None,
    path: ArrayLike | None = None,
    feedback: TrackingFeedback | None = None,
    directions: SensitivityDirections | None = None,
) -> Rollout:
    """Simulate a system for N = `steps` time steps.

    Raises `ModelError` for a wrong shape.

    Parameters
    ----------
    theta : array_like, shape (ntheta,)
        Values of all parameters, in the order of `step.system.parameters`.
    start : array_like, shape (nx,)
        Initial (q, p, z): coordinates [rad or m], momenta [N m s or N s], internal coordinates.
    torque : array_like, shape (N, nu), optional
        Nominal motor torque of every step [N m]; default: zero.
    path : array_like, shape (N + 1, nc), optional
        Prescribed coordinates at every node [rad or m]; default: their initial values.
    feedback : TrackingFeedback, optional
        Correction of the torque by the state.
    directions : SensitivityDirections, optional
        Directions along which the result has derivatives; default: it has none.

    Returns
    -------
    Rollout
        States (N + 1, nx) with units as `start`. If Newton's method fails, `status` says so, and later entries are NaN.
    """
    inputs = checked_rollout_inputs(step, theta, start, steps, torque, path, feedback, directions)
    return step.kernel.rollout_batch([inputs])[0]


def checked_rollout_inputs(
    step: Step,
    theta: ArrayLike,
    start: ArrayLike,
    steps: int,
    torque: ArrayLike | None = None,
    path: ArrayLike | None = None,
    feedback: TrackingFeedback | None = None,
    directions: SensitivityDirections | None = None,
) -> RolloutInputs:
    """Check the shapes of the inputs of one rollout, and return them. Arguments and errors are as in `simulate`."""
    sizes, check = step.sizes, float_array_with_checked_shape
    nx, nu, nc = sizes["nx"], sizes["nu"], sizes["nc"]
    if steps < 1:
        what, hint = f"the number of time steps is {steps}, but must be at least 1", "pass steps=1 or more"
        raise ModelError(what, where="steps", allowed="a whole number from 1", hint=hint)
    begin = check("start", start, (nx,)).copy()
    fixed = list(step.system.prescribed_coordinate_indices)
    inputs = np.zeros((steps, nu)) if torque is None else check("torque", torque, (steps, nu))
    course = np.tile(begin[fixed], (steps + 1, 1)) if path is None else check("path", path, (steps + 1, nc))
    begin[fixed] = course[0]
    if directions is not None:
        d, along = directions.count, directions.prescribed_tangents
        check("directions.start", directions.initial_state_tangents, (nx, d))
        if directions.torque_tangents is not None:
            check("directions.torque", directions.torque_tangents, (steps, nu, d))
        if along is not None:
            check("directions.path", along, (steps + 1, nc, d))
            first = directions.initial_state_tangents.copy()
            first[fixed] = along[0]
            directions = replace(directions, initial_state_tangents=first)
    return RolloutInputs(check("theta", theta, (sizes["ntheta"],)), begin, inputs, course, feedback, directions)


def actuated_joint_torques_of_rollout(step: Step, theta: ArrayLike, rollout: Rollout) -> Array:
    """Return the torque on the driven joints in every step, (N, nu) [N m]: the input, or the torque of the servos."""
    system, h = step.system, step.clock_scaled_time_step(np.asarray(theta, float))
    if not system.servos:
        return rollout.torque
    e, n, driven = step.equations, system.n_coordinates, list(system.actuated_coordinate_indices)
    with CASADI_LOCK:
        force = ca.densify(system.input_force(e.u, e.q0, e.q1)[driven])
        internal = ca.vertcat(ca.SX(0, 1), *system.effect_internal_coordinate_symbols.values())
        function = ca.Function("applied", [e.u, e.q0, e.q1, internal, e.theta], [force])
    middle, rate = (rollout.state[1:] + rollout.state[:-1]) / 2, np.diff(rollout.state[:, :n], axis=0) / h
    inputs = rollout.torque.T, middle[:, :n].T, rate.T, middle[:, 2 * n :].T
    return np.array(function.map(len(rate))(*inputs, np.asarray(theta, float))).T


def generalized_momentum_from_velocity(step: Step, q: ArrayLike, v: ArrayLike, theta: ArrayLike) -> Array:
    """Compute the momentum dL/dv at (q, v), each (n,) or (K, n) [N m s], times compliance at compliant coordinates."""
    e, s = step.equations, step.sizes
    middle, half = (np.atleast_2d(np.asarray(x, float)) * by for x, by in ((q, 1.0), (v, step.time_step / 2)))
    none = [np.zeros(s[key]) for key in ("n", "nz", "nz", "m", "nu")]
    with CASADI_LOCK:
        momentum = e.row_scale * (e.rigid_body_terms.lagrangian_by_v + e.effect_momentum)
        function = ca.Function("momentum", e.arguments, [momentum]).map(len(middle))
        rows = function((middle - half).T, (middle + half).T, *none, np.asarray(theta, float), step.time_step)
    return np.array(ca.densify(rows)).T.reshape(np.shape(q))


def reachable_and_observable_state_mask(
    step: Step,
    theta: Array,
    rollout: Rollout,
    loads: tuple[Array, Array] | None = None,
    seen: BoolArray | None = None,
    disturbed: BoolArray | None = None,
) -> BoolArray:
    """Return a mask (nx,) of the states that depend on a state or input and affect measurements, also indirectly.

    Prescribed coordinates and internal states of a neutral effect are excluded. Other coordinates and momenta count as
    measured. Only the first and the last step are examined. `loads` are further inputs as in
    `linearized_rollout_steps`. `seen` (nx,) marks states on which sensors depend directly. `disturbed` (nx,) marks
    states with an initial error; if given, states that neither initial errors nor torque errors reach are excluded.
    """
    count, nx, inputs = len(rollout.torque), step.sizes["nx"], np.eye(step.sizes["nu"])[None]
    given = (step, theta, rollout, np.repeat(inputs, count, 0), None, loads)
    first, last = slice(0, 1), slice(count - 1, count)
    ends = [next(linearized_rollout_steps(*given, chosen)) for chosen in (first, last)]
    by_all = np.max([np.abs(state[0]) for state, _ in ends], axis=0)
    by_state, moved = by_all[:, :nx], np.any(by_all > 0, axis=1)
    moved[list(step.system.prescribed_coordinate_indices)] = False
    if disturbed is not None:
        reached = disturbed | np.any(by_all[:, nx:] > _MIN_SLOPE, axis=1)
        while np.any(more := ~reached & np.any(by_state[:, reached] > _MIN_SLOPE, axis=1)):
            reached |= more
        moved &= reached
    felt = np.arange(len(moved)) < 2 * step.sizes["n"]
    felt |= False if seen is None else seen
    efforts = [effort[0, : step.sizes["nc"], :nx] for _, effort in ends]
    felt |= np.any([np.any(np.abs(effort) > _MIN_SLOPE, axis=0) for effort in efforts], axis=0)
    while np.any(more := ~felt & np.any(by_state[felt] > _MIN_SLOPE, axis=0)):
        felt |= more
    return moved & felt


def linearized_rollout_steps(
    step: Step,
    theta: Array,
    rollout: Rollout,
    inputs: Array,
    feedback: TrackingFeedback | None = None,
    loads: tuple[Array, Array] | None = None,
    chosen: slice = _ALL_STEPS,
) -> Iterator[tuple[Array, Array]]:
    """Yield the derivatives of a rollout's steps, in blocks of k steps. Prescribed coordinates are held fixed.

    Each block has two arrays: the derivatives of the next state, (k, nx, d), and the derivatives of the efforts at
    prescribed coordinates and of the constraint forces, (k, nc + m, d). The d = nx + c + e columns are the state
    (including the feedback, if given), the c torque directions `inputs` (N, nu, c) and e loads. `loads` are additions
    to the nt = n + nz + m step equations, (nt, e), and to the next momentum, (n, e), the same in all steps. `chosen` is
    a range of consecutive steps. Raises `numpy.linalg.LinAlgError` if the equations of a step are singular.
    """
    if loads is None:
        loads = np.zeros((sum(step.sizes[key] for key in ("n", "nz", "m")), 0)), np.zeros((step.sizes["n"], 0))
    begin, end, _ = chosen.indices(len(rollout.torque))
    for first in range(begin, end, _STEPS_PER_CHUNK):
        span = slice(first, min(first + _STEPS_PER_CHUNK, end))
        nodes, own = rollout.state[first : span.stop + 1], feedback and replace(feedback, gain=feedback.gain[span])
        along = replace(rollout, state=nodes, multipliers=rollout.multipliers[span], torque=rollout.torque[span])
        yield step.kernel.linearized_rollout_steps(theta, along, own, inputs[span], loads)
