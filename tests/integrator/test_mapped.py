"""Functions at many points at once: compiled, interpreted, sparse, shared inputs, and when they fail."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from yid_ocp.integrator import compiler, mapped_function
from yid_ocp.integrator.mapped_function import MappedFunction

needs_compiler = pytest.mark.skipif(compiler._compiler_path() is None, reason="this machine has no C compiler")


@pytest.mark.parametrize("use_compiler", [True, False], ids=["compiled", "interpreted"])
def test_values_at_every_point(use_compiler):
    x, y = ca.SX.sym("x", 3), ca.SX.sym("y", 2)
    sparse = ca.SX(3, 4)
    sparse[0, 1], sparse[2, 3] = x[0] * y[1], 7
    dense = x @ y.T
    function = ca.Function("products", [x, y], [dense, sparse, ca.SX(0, 2)])
    points, shared = np.arange(12.0).reshape(4, 3), np.array([2.0, 5.0])
    one, two, none = MappedFunction(function, shared_inputs=(1,), use_compiler=use_compiler)(points, shared)
    np.testing.assert_array_equal(one, points[:, :, None] * shared)
    expected = np.zeros((4, 3, 4))
    expected[:, 0, 1], expected[:, 2, 3] = 5 * points[:, 0], 7
    np.testing.assert_array_equal(two, expected)
    assert none.shape == (4, 0, 2)
    with pytest.raises(AssertionError, match=r"input 1 of products"):
        MappedFunction(function, use_compiler=use_compiler)(points, shared[None])


@needs_compiler
def test_no_memory(poor, monkeypatch):
    libraries = []

    def poor_library(source):
        libraries.append(compiler.compile_library(poor.source + source))
        return libraries[-1]

    monkeypatch.setattr(mapped_function, "compile_library", poor_library)
    x = ca.SX.sym("x", 2)
    double = MappedFunction(ca.Function("double_it", [x], [2 * x]))
    poor.watch(libraries[0])
    points = np.arange(6.0).reshape(3, 2)
    assert poor.grants_needed(lambda: double(points)) == 2
    poor.grants.value = 2
    np.testing.assert_array_equal(double(points)[0][:, :, 0], 2 * points)


@needs_compiler
def test_a_function_that_fails_gives_no_result(monkeypatch):
    def failing_library(source):
        return compiler.compile_library(source.replace("if (fail_it(", "if (1 || fail_it("))

    monkeypatch.setattr(mapped_function, "compile_library", failing_library)
    x = ca.SX.sym("x")
    with pytest.raises(RuntimeError, match="could not evaluate"):
        MappedFunction(ca.Function("fail_it", [x], [x]))(np.ones((1, 1)))
