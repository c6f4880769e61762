"""The stepping kernel in generated C, called through ctypes."""

from __future__ import annotations

import ctypes
import functools
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from yid_ocp.arrays import Array, IntArray
from yid_ocp.display import grouped
from yid_ocp.errors import ModelError
from yid_ocp.files import file_sha256
from yid_ocp.integrator import codegen, compiler
from yid_ocp.integrator.step_model import (
    NEWTON_ITERATION_LIMIT,
    CostDerivativesByRolloutOutputs,
    NewtonStatusCode,
    Rollout,
    RolloutCostGradient,
    RolloutInputs,
    StepEquationsAndFunctions,
    StepResidualsAndJacobians,
    TrackingFeedback,
    allocate_rollout,
    allocate_step_linearizations,
    attach_status_to_rollout,
    out_of_memory_error,
)
from yid_ocp.parallel import CasadiLockedCache, call_merged_with_other_threads, map_in_threads

_BATCH_COST, _BATCH_COST_PER_COLUMN = 1.7, 0.11
"""Cost of a batch of any size, in rollouts of one member, and the extra cost per sensitivity column."""
_MIN_BATCH_SPEEDUP = 1.5  # minimum speed-up of a batch over single rollouts; above 2 it is also faster than two threads
MAX_BATCHED_COLUMNS = int((8 / _MIN_BATCH_SPEEDUP - _BATCH_COST) / _BATCH_COST_PER_COLUMN)  # of a useful batch
MIN_STEPS_TO_COMPILE_BATCH = 50_000  # that could have been batched, after which the batched kernel is compiled


class _Struct(ctypes.Structure):
    """A struct of `kernel.c`. It keeps the arrays and structs alive to which its pointers point."""

    kept: object = None


def _struct(name: str, *fields: str) -> type[_Struct]:
    kinds = {"int": ctypes.c_int, "double": ctypes.c_double, "long": ctypes.c_longlong, "pointer": ctypes.c_void_p}
    words = [part.split() for part in fields]
    return type(name, (_Struct,), {"_fields_": [(field, kinds[kind]) for kind, *names in words for field in names]})


_Directions = _struct(
    "Directions",
    "int count theta_count",
    "pointer by_theta rows_pattern p1_pattern effort_pattern rows_nz p1_nz effort_nz w iw",
)
_Feedback = _struct("Feedback", "int count", "pointer index gain reference")
_Motion = _struct(
    "Motion", "int steps limit", "double time_step tolerance", "pointer theta torque path feedback directions"
)
_Trajectory = _struct("Trajectory", "pointer state multipliers effort applied")
_Sensitivities = _struct("Sensitivities", "pointer state multipliers effort torque path")
_Partials = _struct("Partials", "pointer state multipliers effort")
_Gradient = _struct("Gradient", "pointer theta start torque path")
_Linearization = _struct(
    "Linearization", "pointer rows p1 rows_new rows_old rows_input p1_new p1_old p1_input rows_theta p1_theta"
)
_StepMaps = _struct("StepMaps", "int inputs loads", "pointer torque on_rows on_p1 after effort")
_Outcome = _struct("Outcome", "int step status", "double error", "long iterations memory")


def _filled(kind: type[_Struct], *values: object) -> _Struct:
    """A struct from numbers and from the addresses of arrays and other structs; None becomes a null pointer."""

    def entry(value: object) -> object:
        if isinstance(value, np.ndarray):
            return value.ctypes.data
        return ctypes.addressof(value) if isinstance(value, _Struct) else value

    struct = kind(*map(entry, values))
    struct.kept = values
    return struct


def _along(state: Array, multipliers: Array, torque: Array) -> _Struct:
    """The struct of a trajectory with given states, multipliers and applied torques."""
    return _filled(_Trajectory, *(_doubles(a) for a in (state, multipliers, None, torque)))


def _doubles(array: ArrayLike | None) -> Array | None:
    return None if array is None else np.ascontiguousarray(array, dtype=float)


@dataclass(frozen=True)
class _ThetaColumns:
    """Compiled derivatives with respect to some parameters. Patterns have CasADi's compressed-column format."""

    address: int
    patterns: tuple[IntArray, ...]
    work: int


class CompiledKernel:
    """A thread-safe stepping kernel in generated C. It has the methods of `InterpretedKernel`."""

    def __init__(self, model: StepEquationsAndFunctions, library: ctypes.CDLL) -> None:
        self._model = model
        self._library = library
        self._wished = 0  # steps for which a batch would have been the better way
        self._batched = CasadiLockedCache[None, tuple[ctypes.CDLL, int] | None](lambda _: _batched_library(model))
        self._theta_columns = CasadiLockedCache(functools.partial(_theta_columns, model, library))

    def make_kernel_sharing_code(self, model: StepEquationsAndFunctions) -> CompiledKernel:
        """Create a kernel for another step model that uses the same compiled library."""
        other = CompiledKernel(model, self._library)
        other._theta_columns, other._batched = self._theta_columns, self._batched
        return other

    def rollout(self, inputs: RolloutInputs) -> Rollout:
        """Simulate one rollout in C, with its derivatives."""
        return self._rolled_out(self._library, [inputs])[0]

    def rollout_batch(self, members: Sequence[RolloutInputs]) -> list[Rollout]:
        """Simulate several rollouts in C. SIMD batches are used where they are faster."""
        return call_merged_with_other_threads(self._rollouts, list(members))

    def _rollouts(self, members: Sequence[RolloutInputs]) -> list[Rollout]:
        loops = (m.feedback and tuple(np.asarray(m.feedback.state_indices).tolist()) for m in members)
        kinds = zip(loops, (m.directions is None for m in members), strict=True)
        alike = grouped((kind, i) for i, kind in enumerate(kinds))
        # a batch costs as many columns and steps as its widest and longest member
        for group in alike.values():
            group.sort(key=lambda i: (_width(members[i]), len(members[i].torque)), reverse=True)
        batches = [part for group in alike.values() for part in self._split(group, members)]
        made = map_in_threads(lambda batch: self._together([members[i] for i in batch]), batches)
        found = dict(zip(itertools.chain(*batches), itertools.chain(*made), strict=True))
        return [found[i] for i in range(len(members))]

    def _split(self, group: Sequence[int], members: Sequence[RolloutInputs]) -> list[Sequence[int]]:
        """Split similar members into batches, independent of the number of threads (batches differ by rounding)."""
        batches, left = list[Sequence[int]](), list(group)
        fewest = max(_MIN_BATCH_SPEEDUP * (_BATCH_COST + _BATCH_COST_PER_COLUMN * _width(members[left[0]])), 2.0)
        if len(left) >= fewest:
            self._wished += sum(len(members[i].torque) for i in left)
        known = self._batched(None) if len(left) >= fewest and self._wished > MIN_STEPS_TO_COMPILE_BATCH else None
        while known is not None and min(len(left), known[1]) >= fewest:
            batches.append(left[: known[1]])
            left = left[known[1] :]
        return [*batches, *([i] for i in left)]

    def _together(self, members: Sequence[RolloutInputs]) -> list[Rollout]:
        known = self._batched(None) if len(members) > 1 else None
        if known is None:
            return [self._rolled_out(self._library, [member])[0] for member in members]
        found = self._rolled_out(known[0], members)
        # a batch has simplified Newton only; members that fail in it are repeated with the kernel for one member
        pairs = zip(found, members, strict=True)
        return [out if out.status.is_converged else self._rolled_out(self._library, [one])[0] for out, one in pairs]

    def _rolled_out(self, library: ctypes.CDLL, members: Sequence[RolloutInputs]) -> list[Rollout]:
        """Rollouts from one call of a kernel, which takes one member or a batch."""
        sizes = self._model.sizes
        outs, motions, trajectories, sensitivities = [], [], [], []
        for m in members:
            out = allocate_rollout(sizes, len(m.torque), None if m.directions is None else m.directions.count)
            out.state[0] = m.initial_state
            directions = None
            if m.directions is not None and out.state_sensitivity is not None:
                out.state_sensitivity[0] = m.directions.initial_state_tangents
                given = _doubles(m.directions.torque_tangents), _doubles(m.directions.prescribed_tangents)
                own = (out.state_sensitivity, out.multipliers_sensitivity, out.effort_sensitivity)
                sensitivities.append(_filled(_Sensitivities, *own, *given))
                directions = self._directions(m.directions.parameter_names, m.directions.count)
            motions.append(self._motion(len(m.torque), m.theta, m.torque, m.prescribed_path, m.feedback, directions))
            trajectories.append(_filled(_Trajectory, out.state, out.multipliers, out.effort, out.torque))
            outs.append(out)
        outcomes: Any = (_Outcome * len(members))()
        filled = (_Motion * len(members))(*motions), (_Trajectory * len(members))(*trajectories)
        by = (_Sensitivities * len(members))(*sensitivities) if sensitivities else None
        _check(library.yid_rollout(ctypes.c_int(len(members)), *filled, by, outcomes), outcomes[0])
        ends = ((o.status, o.step, o.error, o.iterations) for o in outcomes)
        return [attach_status_to_rollout(out, sizes, *end) for out, end in zip(outs, ends, strict=True)]

    def adjoint_gradient(
        self,
        theta: Array,
        rollout: Rollout,
        feedback: TrackingFeedback | None,
        names: tuple[str, ...],
        by: CostDerivativesByRolloutOutputs,
    ) -> RolloutCostGradient:
        """Compute the gradient of a cost, also by the parameters `names`, from its derivatives `by` along a rollout."""
        sizes, steps = self._model.sizes, len(rollout.multipliers)
        shapes = (len(names),), (sizes["nx"],), (steps, sizes["nu"]), (steps + 1, sizes["nc"])
        gradient = RolloutCostGradient(*(np.zeros(shape) for shape in shapes))
        motion = self._motion(steps, theta, None, None, feedback, self._directions(names, len(names)))
        along, partials = _along(rollout.state, rollout.multipliers, rollout.torque), map(_doubles, by)
        made = _filled(_Gradient, *vars(gradient).values())
        if self._call("yid_adjoint", motion, along, _filled(_Partials, *partials), made) != NewtonStatusCode.OK:
            for array in vars(gradient).values():
                array[:] = np.nan
        return gradient

    def step_residuals_and_jacobians(
        self, theta: Array, state: Array, multipliers: Array, torque: Array, names: tuple[str, ...], derivatives: bool
    ) -> StepResidualsAndJacobians:
        """Evaluate the step residuals along any trajectory in C. Without `derivatives`, the Jacobians are empty."""
        out = allocate_step_linearizations(self._model.sizes, len(torque), len(names), derivatives)
        # in the order of the struct
        matrices = [out.residual_by_new, out.residual_by_old, out.residual_by_input, out.p1_by_new, out.p1_by_old]
        matrices += [out.p1_by_input, out.residual_by_theta, out.p1_by_theta]
        directions = self._directions(names, len(names)) if derivatives else None
        motion = self._motion(len(torque), theta, None, None, None, directions)
        made = _filled(_Linearization, out.residual, out.p1, *(matrices if derivatives else [None] * len(matrices)))
        self._call("yid_linearize", motion, _along(state, multipliers, torque), made)
        return out

    def linearized_rollout_steps(
        self, theta: Array, along: Rollout, feedback: TrackingFeedback | None, inputs: Array, loads: tuple[Array, Array]
    ) -> tuple[Array, Array]:
        """Compute the derivatives of a rollout's steps in C, as `step.linearized_rollout_steps` describes them."""
        count, sizes, widths = len(along.torque), self._model.sizes, (inputs.shape[2], loads[0].shape[1])
        rows = sizes["nx"], sizes["nc"] + sizes["m"]
        after, effort = (np.empty((count, height, sizes["nx"] + sum(widths))) for height in rows)
        made = _filled(_StepMaps, *widths, _doubles(inputs), *map(_doubles, loads), after, effort)
        motion, given = self._motion(count, theta, None, None, feedback, None), (along.multipliers, along.torque)
        if self._call("yid_step_maps", motion, _along(along.state, *given), made) != NewtonStatusCode.OK:
            raise np.linalg.LinAlgError("the equations of a time step have a singular Jacobian")
        return after, effort

    def _call(self, function: str, *structs: _Struct) -> int:
        """Call a function of the library with the addresses of the structs. Returns its status code."""
        outcome: Any = _Outcome()
        code: int = getattr(self._library, function)(*map(ctypes.byref, (*structs, outcome)))
        _check(code, outcome)
        return code

    def _motion(
        self,
        steps: int,
        theta: Array,
        torque: Array | None,
        path: Array | None,
        feedback: TrackingFeedback | None,
        directions: _Struct | None,
    ) -> _Struct:
        loop = None
        if feedback is not None:
            index = np.ascontiguousarray(feedback.state_indices, np.int32)
            loop = _filled(_Feedback, len(index), index, _doubles(feedback.gain), _doubles(feedback.reference))
        inputs = (_doubles(theta), _doubles(torque), _doubles(path))
        numbers = (steps, NEWTON_ITERATION_LIMIT, self._model.time_step, self._model.tolerance)
        return _filled(_Motion, *numbers, *inputs, loop, directions)

    def _directions(self, names: tuple[str, ...], count: int) -> _Struct:
        if not names:
            return _filled(_Directions, count, 0)
        columns = self._theta_columns(names)
        values = [np.zeros(int(pattern[2 + pattern[1]])) for pattern in columns.patterns]
        w, iw = np.zeros(columns.work), np.zeros(columns.work, np.int64)
        return _filled(_Directions, count, len(names), columns.address, *columns.patterns, *values, w, iw)


def _check(code: int, outcome: Any) -> None:
    if code == NewtonStatusCode.OUT_OF_MEMORY:
        raise out_of_memory_error("the work arrays of one time step", outcome.memory)


def _width(member: RolloutInputs) -> int:
    return 0 if member.directions is None else member.directions.count


def _batched_library(model: StepEquationsAndFunctions) -> tuple[ctypes.CDLL, int] | None:
    """The kernel of a batch and its number of members. None if compiler or processor do not support it."""
    parts = model.functions, model.index_tables
    source = functools.partial(codegen.kernel_c_source, *parts, batched=True)
    library = compiler.compile_and_load_library(f"batched\0{codegen.kernel_cache_key_text(*parts)}", source)
    count = 0 if library is None else int(library.yid_simd_width())
    return None if library is None or not count else (library, count)


def _theta_columns(model: StepEquationsAndFunctions, kernel: ctypes.CDLL, names: tuple[str, ...]) -> _ThetaColumns:
    """Compiled derivatives by parameters. The cache key is the kernel and the indices of the parameters."""

    def source() -> str:
        function = codegen.parameter_jacobian_function(model.equations, names)
        return codegen.casadi_c_source(function.name(), (function,))

    places = [str(model.system.parameters.index(name)) for name in names]
    told = "\0".join([file_sha256(Path(codegen.__file__)), Path(kernel._name).name, *places])
    library = compiler.compile_and_load_library(told, source)
    if library is None:
        what, where = "the C compiler failed on the code for parameter derivatives", "the environment variable CC"
        hint = "set CC to another compiler, such as gcc or clang, or to none (slower)"
        raise ModelError(what, where=where, allowed="a working C compiler, or none", hint=hint)
    function, sizes = ca.external("by_theta", library._name), model.sizes
    rows = (sizes["n"] + sizes["nz"] + sizes["m"], sizes["n"], sizes["nc"])
    shapes = [function.size_out(i) for i in range(function.n_out())]
    if shapes != [(count, len(names)) for count in rows]:
        raise ValueError(f"derivatives by {len(names)} parameters have the shapes {shapes}, not the rows {rows}")
    address = ctypes.cast(library.by_theta, ctypes.c_void_p).value
    assert address is not None
    patterns = (function.sparsity_out(i) for i in range(function.n_out()))
    compressed = (np.array([s.size1(), s.size2(), *s.colind(), *s.row()], np.int64) for s in patterns)
    return _ThetaColumns(address, tuple(compressed), max(function.sz_w(), function.sz_iw(), 1))
