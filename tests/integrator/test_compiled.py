"""Faults of compiled code: no memory, derivatives that do not fit."""

from __future__ import annotations

import ctypes

import casadi as ca
import numpy as np
import pytest

from yid_ocp.errors import ModelError, ResourceError
from yid_ocp.integrator import codegen, compiler, mapped
from yid_ocp.integrator.compiled import CompiledKernel
from yid_ocp.integrator.mapped import Mapped
from yid_ocp.integrator.rollout import simulate
from yid_ocp.integrator.step import compile_step
from yid_ocp.integrator.step_model import Directions
from yid_ocp.model import System
from yid_ocp.model.urdf import read_urdf

needs_compiler = pytest.mark.skipif(compiler.compiler() is None, reason="this machine has no C compiler")

# An allocator that gives out `yid_grants` pieces of memory and then none, and counts those that were not given back.
POOR = """
#include <stdlib.h>
long yid_grants = 0, yid_held = 0;
static void *poor_allocate(size_t count, size_t size) {
    if (yid_grants <= 0) return NULL;
    yid_grants--;
    yid_held++;
    return calloc(count, size);
}
static void poor_free(void *memory) {
    if (memory) yid_held--;
    free(memory);
}
#define YID_ALLOCATE poor_allocate
#define YID_FREE poor_free
"""


class Poor:
    """A library with that allocator."""

    def __init__(self, library):
        self.grants, self.held = (ctypes.c_long.in_dll(library, name) for name in ("yid_grants", "yid_held"))

    def grants_needed(self, action) -> int:
        """How many pieces an action asks for; every smaller number must end in an error and leave nothing behind."""
        messages = []
        for grants in range(20):
            self.grants.value = grants
            try:
                action()
            except ResourceError as error:
                messages.append(str(error))
            else:
                assert all("not enough memory for" in m and " MB" in m and "fewer parameters" in m for m in messages)
                return grants
            finally:
                assert self.held.value == 0
        raise AssertionError("never enough")


@pytest.fixture
def step(parts, urdf_folder):
    return compile_step(parts.closed_loop(urdf_folder)[0], 2e-3)


@needs_compiler
def test_no_memory_is_said_by_every_entry_point(step, parts, urdf_folder):
    case = parts.make_case(*parts.closed_loop(urdf_folder))
    model = case.step.model
    library = compiler.compile_library(POOR + codegen.kernel_source(model.functions, model.structure))
    poor, kernel = Poor(library), CompiledKernel(model, library)
    names = ("spin.mass", "hinge.damping")
    directions = Directions(names, np.zeros((step.sizes["nx"], 2)))
    arguments = (case.theta, case.start, case.torque, case.path, case.feedback)
    plain = case.rollout(feedback=case.feedback, directions=directions)
    assert plain.status.ok

    # the step's work, CasADi's two work arrays; with derivatives their columns
    assert poor.grants_needed(lambda: kernel.rollout(*arguments, None)) == 3
    assert poor.grants_needed(lambda: kernel.rollout(*arguments, directions)) == 4
    by_state = np.ones_like(plain.state)
    assert (
        poor.grants_needed(lambda: kernel.adjoint(case.theta, plain, case.feedback, names, by_state, None, None)) == 3
    )
    trajectory = (case.theta, plain.state, plain.multipliers, plain.torque, names, True)
    assert poor.grants_needed(lambda: kernel.linearize(*trajectory)) == 3

    poor.grants.value = 100
    again = kernel.rollout(*arguments, directions)
    np.testing.assert_array_equal(again.state, plain.state)
    np.testing.assert_array_equal(again.by_state, plain.by_state)


@needs_compiler
def test_no_memory_for_a_mapped_function(monkeypatch):
    libraries = []

    def poor_library(source, straight_line=False):
        libraries.append(compiler.compile_library(POOR + source, straight_line))
        return libraries[-1]

    monkeypatch.setattr(mapped, "compile_library", poor_library)
    x = ca.SX.sym("x", 2)
    double = Mapped(ca.Function("double_it", [x], [2 * x]))
    poor = Poor(libraries[0])
    points = np.arange(6.0).reshape(3, 2)
    assert poor.grants_needed(lambda: double(points)) == 2
    poor.grants.value = 2
    np.testing.assert_array_equal(double(points)[0][:, :, 0], 2 * points)


@needs_compiler
def test_a_mapped_function_that_fails_is_no_result(monkeypatch):
    def failing_library(source, straight_line=False):
        return compiler.compile_library(source.replace("if (fail_it(", "if (1 || fail_it("), straight_line)

    monkeypatch.setattr(mapped, "compile_library", failing_library)
    x = ca.SX.sym("x")
    with pytest.raises(RuntimeError, match="could not evaluate"):
        Mapped(ca.Function("fail_it", [x], [x]))(np.ones((1, 1)))


@pytest.mark.parametrize("use_compiler", [True, False], ids=["compiled", "interpreted"])
def test_a_rollout_beyond_all_memory(urdf_folder, use_compiler):
    system = System.build(read_urdf(urdf_folder / "double_pendulum.urdf"))
    step = compile_step(system, 0.01, use_compiler=use_compiler)
    theta, start, nothing = system.parameters.vector(), np.zeros(4), np.zeros((3, 0))
    with pytest.raises(ResourceError) as caught:
        simulate(step, theta, start, 10**14)
    for word in ("a rollout of 100000000000000 steps with 0 derivatives", "3.2e+09 MB", "fewer parameters"):
        assert word in str(caught.value)
    wide = Directions((), np.broadcast_to(0.0, (4, 10**15)))
    with pytest.raises(ResourceError, match=r"3 steps with 1000000000000000 derivatives: it takes 1\.28e\+11 MB"):
        step.kernel.rollout(theta, start, nothing, np.zeros((4, 0)), None, wide)


@needs_compiler
@pytest.mark.parametrize("rows", [0, 1, 2])
def test_derivatives_of_other_equations_are_refused(step, monkeypatch, rows):
    """The kernel adds them row by row without looking; a number of rows that does not fit is found before."""
    original = codegen.theta_function

    def cut(equations, names):
        function = original(equations, names)
        outputs = function.call(equations.arguments)
        outputs[rows] = ca.vertcat(outputs[rows], ca.SX(1, len(names)))
        return ca.Function("by_theta", equations.arguments, outputs)

    monkeypatch.setattr(codegen, "theta_function", cut)
    q, theta = np.zeros(6), step.system.parameters.vector()
    with pytest.raises(ValueError, match="derivatives by 1 parameters have the shapes"):
        step.jacobians(q, q, np.zeros(2), theta, ([0.0], [0.0]), names=["spin.mass"])


def test_fewer_directions_than_parameters_are_refused():
    with pytest.raises(ModelError, match="1 directions for 2 parameters"):
        Directions(("a", "b"), np.zeros((4, 1)))
