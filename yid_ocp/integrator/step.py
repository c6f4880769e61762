"""One step of a system, compiled or interpreted: the step map and its Jacobians."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from yid_ocp.arrays import Array
from yid_ocp.display import ReprMixin, ReprSummary
from yid_ocp.errors import ModelError
from yid_ocp.integrator import codegen, compiler
from yid_ocp.integrator.compiled import CompiledKernel
from yid_ocp.integrator.discrete import ConstraintForcePlacement, DiscreteEquations, ForceSplit
from yid_ocp.integrator.interpreted import InterpretedKernel
from yid_ocp.integrator.step_model import (
    Rollout,
    RolloutInputs,
    SensitivityDirections,
    StepModel,
    StepStatus,
    build_step_model,
    newton_tolerance,
)
from yid_ocp.model.system import System


@dataclass(frozen=True, eq=False, repr=False)
class Step(ReprMixin):
    """Step map of a system over one time step; made by `compile_step`. `is_compiled`: by generated C code."""

    model: StepModel
    kernel: CompiledKernel | InterpretedKernel
    is_compiled: bool

    def _summary(self) -> ReprSummary:
        how = "compiled" if self.is_compiled else "interpreted"
        return ReprSummary(f"{self.time_step:g} s, {self.force_split}, {how}, of {self.system._summary().one_line}")

    @property
    def system(self) -> System:
        """System whose motion the step computes."""
        return self.model.system

    @property
    def time_step(self) -> float:
        """Time step h [s]."""
        return self.model.time_step

    def equation_time_step(self, theta: Array) -> float:
        """Time step in the equations at a theta [s]: the recorded one times `System.recorded_time_scale`."""
        s = self.sizes
        none = [np.zeros(s[key]) for key in ("n", "n", "n", "nz", "nz", "m", "nu")]
        return float(self.functions.row_scale_and_time_step(*none, theta, self.time_step)[1])

    @property
    def force_split(self) -> ForceSplit:
        """Distribution of the force of a step between its ends, `symmetric` or `left`."""
        return self.model.equations.force_split

    @property
    def constraint_force(self) -> ConstraintForcePlacement:
        """Configuration at which the constraint forces act, `node` or `midpoint`."""
        return self.model.equations.constraint_force

    @property
    def equations(self) -> DiscreteEquations:
        """The symbolic equations of a step."""
        return self.model.equations

    @property
    def functions(self) -> codegen.StepFunctions:
        """CasADi functions of the step equations."""
        return self.model.functions

    @property
    def sizes(self) -> dict[str, int]:
        """Dimensions n, nz, m, nu, nc, nx and ntheta by name."""
        return self.model.sizes

    def __call__(
        self,
        q0: ArrayLike,
        p0: ArrayLike,
        u: ArrayLike,
        theta: ArrayLike,
        prescribed: tuple[ArrayLike, ArrayLike] | None = None,
        internal: ArrayLike | None = None,
    ) -> tuple[Array, Array, Array, StepStatus]:
        """Compute one DEL step.

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
        q1, p1, lam : ndarray, shape (n,), (n,) and (m,)
        status : StepStatus
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
        """Derivatives of (q, p, z)_{k+1} by the implicit function theorem; arguments as of a step.

        Returns A (nx, nx) by (q, p, z)_k, B_u (nx, nu) and B_theta (nx, len(names)), by all of theta without `names`.
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
        sizes, check = self.sizes, checked_float_array
        z0 = np.zeros(sizes["nz"]) if internal is None else check("internal", internal, (sizes["nz"],))
        start = np.concatenate([check("q0", q0, (sizes["n"],)), check("p0", p0, (sizes["n"],)), z0])
        if prescribed is None and sizes["nc"]:
            what = f"{sizes['nc']} coordinates are prescribed"
            raise ModelError(what, where="step", hint="pass prescribed=(s0, s1)")
        ends = ((), ()) if prescribed is None else prescribed
        if len(ends) != 2:
            raise ModelError(f"prescribed has {len(ends)} entries", allowed="the pair (s0, s1)")
        path = np.stack([check("prescribed", s, (sizes["nc"],)) for s in ends])
        start[list(self.system.prescribed_coordinate_indices)] = path[0]
        torque = check("u", u, (sizes["nu"],))[None, :]
        values = check("theta", theta, (sizes["ntheta"],))
        return self.kernel.rollout(RolloutInputs(values, start, torque, path, None, wanted))


def compile_step(
    system: System,
    time_step: float,
    force_split: ForceSplit = "symmetric",
    constraint_force: ConstraintForcePlacement = "midpoint",
    *,
    use_compiler: bool = True,
    tolerance: float | None = None,
) -> Step:
    """Build the step map of a system, compiled where possible.

    Parameters
    ----------
    system : System
    time_step : float
        h [s], positive.
    force_split : "symmetric" or "left"
        Order two, or the rule of the paper's engine.
    constraint_force : "node" or "midpoint"
        Where the constraints pull: as in the paper's engine, or so that no tension makes the motion grow (see
        `discrete_equations`).
    use_compiler : bool
        Whether to generate and compile C; without a compiler on the machine the interpreter is used with one notice.
    tolerance : float, optional
        Newton's, on the coordinates [rad or m]; follows from the time step when absent.

    Raises
    ------
    ModelError
        Time step not positive, unknown force split or constraint force.
    """
    model = build_step_model(system, _positive(time_step), force_split, constraint_force, tolerance)
    source = codegen.kernel_c_source(model.functions, model.index_tables) if use_compiler else None
    library = None if source is None else compiler.compiled_shared_library(source)
    if library is None:
        return Step(model, InterpretedKernel(model), is_compiled=False)
    return Step(model, CompiledKernel(model, library), is_compiled=True)


def step_with_time_step(step: Step, time_step: float) -> Step:
    """A copy of a step with another, positive, time step [s], from the same equations and compiled code."""
    model = replace(step.model, time_step=_positive(time_step), tolerance=newton_tolerance(time_step))
    return Step(model, step.kernel.with_step_model(model), step.is_compiled)


def compile_step_like(step: Step, system: System, *, use_compiler: bool | None = None) -> Step:
    """The step of another system with the time step, integration rules and, by default, kernel type of `step`."""
    compiled = step.is_compiled if use_compiler is None else use_compiler
    return compile_step(system, step.time_step, step.force_split, step.constraint_force, use_compiler=compiled)


def _positive(time_step: float) -> float:
    if not (math.isfinite(time_step) and time_step > 0):
        raise ModelError(f"time_step = {time_step}", allowed="a positive number of seconds")
    return time_step


def checked_float_array(name: str, values: ArrayLike, shape: tuple[int, ...]) -> Array:
    """The values as a contiguous float array; `ModelError` with `name` if its shape is not `shape`."""
    array = np.ascontiguousarray(values, dtype=float)
    if array.size == 0 and 0 in shape:
        return np.zeros(shape)
    if array.shape != shape:
        raise ModelError(f"{name} has shape {array.shape}", allowed=f"shape {shape}")
    return array
