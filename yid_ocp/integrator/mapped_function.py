"""Evaluation of a CasADi function at many points at once."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from yid_ocp.integrator.codegen import casadi_c_source, nonzero_indices
from yid_ocp.integrator.compiler import compile_library
from yid_ocp.integrator.step_model import NewtonStatus, out_of_memory_error


class MappedFunction:
    """A CasADi function evaluated at many points at once, compiled where possible.

    Parameters
    ----------
    function : casadi.Function
        Dense or sparse outputs of any number; inputs are dense columns.
    shared_inputs : collection of int
        Positions of the inputs that are the same at every point.
    use_compiler : bool
        Whether to try compiled code.
    """

    def __init__(self, function: ca.Function, shared_inputs: Sequence[int] = (), use_compiler: bool = True) -> None:
        self.function = function
        self.shared_inputs = frozenset(shared_inputs)
        self._inputs = [function.numel_in(i) for i in range(function.n_in())]
        self._outputs = [function.nnz_out(i) for i in range(function.n_out())]
        self._library = compile_library(self._source()) if use_compiler else None

    def _source(self) -> str:
        name, f = self.function.name(), self.function
        strides = ", ".join("0" if i in self.shared_inputs else str(size) for i, size in enumerate(self._inputs)) or "0"
        widths = ", ".join(str(size) for size in self._outputs) or "0"
        return f"""{casadi_c_source(name, (f,))}
#include <stdlib.h>
#ifndef YID_ALLOCATE
#define YID_ALLOCATE calloc
#define YID_FREE free
#endif
int yid_map(int count, const double **in, double **out) {{
    static const int stride[] = {{{strides}}}, width[] = {{{widths}}};
    const double *arg[{max(f.sz_arg(), 1)}];
    double *res[{max(f.sz_res(), 1)}];
    double *w = YID_ALLOCATE({max(f.sz_w(), 1)}, sizeof(double));
    long long *iw = YID_ALLOCATE({max(f.sz_iw(), 1)}, sizeof(long long));
    int status = w && iw ? {NewtonStatus.OK.value} : {NewtonStatus.OUT_OF_MEMORY.value};
    for (int k = 0; k < count && !status; k++) {{
        for (int i = 0; i < {len(self._inputs)}; i++) arg[i] = in[i] + (size_t)k * stride[i];
        for (int o = 0; o < {len(self._outputs)}; o++) res[o] = out[o] + (size_t)k * width[o];
        if ({name}(arg, res, iw, w, 0)) status = {NewtonStatus.NOT_FINITE.value};
    }}
    YID_FREE(w);
    YID_FREE(iw);
    return status;
}}
"""

    def __call__(self, *inputs: NDArray[np.float64]) -> list[NDArray[np.float64]]:
        """Evaluate the function at all points.

        Parameters
        ----------
        *inputs : ndarray, shape (count, size) or, where shared, (size,)

        Returns
        -------
        list of ndarray, shape (count, rows, columns)
            Dense, one for each output.
        """
        count = next((len(x) for i, x in enumerate(inputs) if i not in self.shared_inputs), 1)
        arrays = [np.ascontiguousarray(x, dtype=float) for x in inputs]
        for i, array in enumerate(arrays):
            expected = (self._inputs[i],) if i in self.shared_inputs else (count, self._inputs[i])
            assert array.shape == expected, f"input {i} of {self.function.name()}: {array.shape}, not {expected}"
        values = [np.zeros((count, size)) for size in self._outputs]
        if self._library is not None:
            pointers = (ctypes.c_void_p * max(len(arrays), 1))(*(a.ctypes.data for a in arrays))
            targets = (ctypes.c_void_p * len(values))(*(v.ctypes.data for v in values))
            code = self._library.yid_map(ctypes.c_int(count), pointers, targets)
            if code == NewtonStatus.OUT_OF_MEMORY:
                raise out_of_memory_error(self.function.name(), 8 * (self.function.sz_w() + self.function.sz_iw()))
            if code != NewtonStatus.OK:
                raise RuntimeError(f"CasADi could not evaluate {self.function}")
        else:
            for k in range(count):
                point = [a if i in self.shared_inputs else a[k] for i, a in enumerate(arrays)]
                for target, result in zip(values, self.function.call(point), strict=True):
                    target[k] = np.array(result.nonzeros())
        dense = []
        for o, value in enumerate(values):
            sparsity = self.function.sparsity_out(o)
            if sparsity.is_dense():
                dense.append(value.reshape(count, sparsity.size2(), sparsity.size1()).transpose(0, 2, 1))
                continue
            full = np.zeros((count, *sparsity.shape))
            row, column = nonzero_indices(sparsity)
            full[:, row, column] = value
            dense.append(full)
        return dense
