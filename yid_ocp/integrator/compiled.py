"""The sweeps in generated C, called through ctypes."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from yid_ocp.errors import ModelError
from yid_ocp.integrator import codegen, compiler
from yid_ocp.integrator.step_model import (
    ITERATION_LIMIT,
    LINEARIZATION_MATRICES,
    Directions,
    Feedback,
    Gradient,
    Rollout,
    StepCode,
    StepLinearization,
    StepModel,
    empty_linearization,
    status_of,
)

Array = NDArray[np.float64]


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

    def __init__(self, model: StepModel, library: ctypes.CDLL) -> None:
        self._model = model
        self._library = library
        self._columns: dict[tuple[str, ...], _CompiledColumns] = {}

    def _theta_columns(self, names: tuple[str, ...]) -> _CompiledColumns:
        if names not in self._columns:
            function = codegen.theta_function(self._model.equations, names)
            library = compiler.compile_library(codegen.function_source(function), straight_line=True)
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

    def rollout(
        self,
        theta: Array,
        start: Array,
        torque: Array,
        path: Array,
        feedback: Feedback | None,
        wanted: Directions | None,
    ) -> Rollout:
        """See `Kernel.rollout`."""
        sizes = self._model.sizes
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
            ctypes.c_double(self._model.time_step),
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
            ctypes.c_double(self._model.tolerance),
            ctypes.c_int(ITERATION_LIMIT),
            _pointer(info),
        )
        del keep, held
        status = status_of(code, info, effort, state, sizes)
        return Rollout(state, multipliers, effort, applied, by_state, by_multipliers, by_effort, status)

    def adjoint(
        self,
        theta: Array,
        rollout: Rollout,
        feedback: Feedback | None,
        names: tuple[str, ...],
        by_state: Array,
        by_multipliers: Array | None,
        by_effort: Array | None,
    ) -> Gradient:
        """See `Kernel.adjoint`."""
        sizes = self._model.sizes
        steps = len(rollout.multipliers)
        gradient, by_start = np.zeros(max(len(names), 1)), np.zeros(sizes["nx"])
        by_torque, by_path = np.zeros((steps, sizes["nu"])), np.zeros((steps + 1, sizes["nc"]))
        info = np.zeros(4)
        struct, keep = self._directions(names, len(names))
        loop, held = _feedback_struct(feedback)
        inputs = [
            np.ascontiguousarray(a, dtype=float) for a in (theta, rollout.torque, rollout.state, rollout.multipliers)
        ]
        partial = [_contiguous(a) for a in (by_state, by_multipliers, by_effort)]
        code = self._library.yid_adjoint(
            ctypes.c_int(steps),
            _pointer(inputs[0]),
            ctypes.c_double(self._model.time_step),
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

    def linearize(
        self,
        theta: Array,
        state: Array,
        multipliers: Array,
        torque: Array,
        names: tuple[str, ...],
        derivatives: bool,
    ) -> StepLinearization:
        """See `Kernel.linearize`."""
        inputs = [np.ascontiguousarray(a, dtype=float) for a in (theta, state, multipliers, torque)]
        stages = empty_linearization(self._model.sizes, len(torque), len(names), derivatives)
        struct, keep = self._directions(names, len(names))
        matrices = [getattr(stages, field) if derivatives else None for field in LINEARIZATION_MATRICES]
        self._library.yid_linearize(
            ctypes.c_int(len(torque)),
            _pointer(inputs[0]),
            ctypes.c_double(self._model.time_step),
            *(_pointer(a) for a in inputs[1:]),
            ctypes.byref(struct),
            _pointer(stages.rows),
            _pointer(stages.p1),
            *(_pointer(matrix) for matrix in matrices),
        )
        del keep
        return stages


def _feedback_struct(feedback: Feedback | None) -> tuple[_Feedback | None, list[object]]:
    if feedback is None:
        return None, []
    index = np.ascontiguousarray(feedback.index, np.int32)
    gain, reference = np.ascontiguousarray(feedback.gain, float), np.ascontiguousarray(feedback.reference, float)
    return _Feedback(len(index), _pointer(index), _pointer(gain), _pointer(reference)), [index, gain, reference]
