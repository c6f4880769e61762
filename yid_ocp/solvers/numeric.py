"""Functions computed in Python, as CasADi's solvers take them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import casadi as ca
import numpy as np


class NumericFunction(ca.Callback):
    """A CasADi function computed in Python."""

    def __init__(
        self,
        name: str,
        inputs: Sequence[str],
        outputs: Sequence[str],
        sparsity: Mapping[str, ca.Sparsity],
        compute: Callable[..., list],
    ) -> None:
        ca.Callback.__init__(self)
        self._inputs, self._outputs, self._sparsity, self._compute = list(inputs), list(outputs), sparsity, compute
        self.construct(name, {})

    def get_n_in(self) -> int:
        """Number of inputs."""
        return len(self._inputs)

    def get_n_out(self) -> int:
        """Number of outputs."""
        return len(self._outputs)

    def get_name_in(self, i: int) -> str:
        """Name of an input."""
        return self._inputs[i]

    def get_name_out(self, i: int) -> str:
        """Name of an output."""
        return self._outputs[i]

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        """Pattern of an input."""
        return self._sparsity[self._inputs[i]]

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        """Pattern of an output."""
        return self._sparsity[self._outputs[i]]

    def has_eval_buffer(self) -> bool:
        """Whether `eval_buffer` is there."""
        return True

    def eval_buffer(self, arguments: Sequence[memoryview | None], results: Sequence[memoryview | None]) -> int:
        """Compute on CasADi's own memory: a Jacobian of millions of entries is not copied to and fro."""
        # the arguments' memory is CasADi's only as long as this call lasts
        values = self._compute(*(np.zeros(0) if a is None else np.frombuffer(a).copy() for a in arguments))
        for place, value in zip(results, values, strict=True):
            if place is not None:
                np.frombuffer(place)[:] = value
        return 0
