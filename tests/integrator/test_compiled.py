"""Compiled code: no memory, derivatives that do not fit, and threads that share one step."""

import ctypes
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from unittest.mock import Mock

import casadi as ca
import numpy as np
import pytest

from yid_ocp.errors import InsufficientMemoryError, ModelError
from yid_ocp.integrator import codegen, compiled, compiler
from yid_ocp.integrator.compiled import CompiledKernel
from yid_ocp.integrator.statics import EquilibriumSolver
from yid_ocp.integrator.step import compile_step, simulate
from yid_ocp.integrator.step_model import RolloutInputs, SensitivityDirections
from yid_ocp.model import System
from yid_ocp.model.urdf import read_urdf

needs_compiler = pytest.mark.usefixtures("c_compiler")


@pytest.fixture
def step(parts, urdf_folder):
    return compile_step(parts.closed_loop(urdf_folder)[0], 2e-3)


@needs_compiler
@pytest.mark.usefixtures("shipped_optimization")
def test_no_memory_is_said_by_every_entry_point(poor, step, parts, urdf_folder):
    case = parts.make_case(*parts.closed_loop(urdf_folder))
    model = case.step.model
    source = codegen.kernel_c_source(model.functions, model.index_tables)
    library = compiler.compile_and_load_library(poor.source + source)
    poor.watch(library)
    kernel = CompiledKernel(model, library)
    names = ("spin.mass", "hinge.damping")
    directions = SensitivityDirections(names, np.zeros((step.sizes["nx"], 2)))
    inputs = RolloutInputs(case.theta, case.start, case.torque, case.path, case.feedback)
    differentiated = replace(inputs, directions=directions)
    plain = case.rollout(feedback=case.feedback, directions=directions)
    assert plain.status.is_converged

    # all that a call works with is one block
    assert poor.grants_needed(lambda: kernel.rollout(inputs)) == 1
    assert poor.grants_needed(lambda: kernel.rollout(differentiated)) == 1
    back = (case.theta, plain, case.feedback, names, (np.ones_like(plain.state), None, None))
    assert poor.grants_needed(lambda: kernel.adjoint_gradient(*back)) == 1
    trajectory = (case.theta, plain.state, plain.multipliers, plain.torque, names, True)
    assert poor.grants_needed(lambda: kernel.step_residuals_and_jacobians(*trajectory)) == 1
    loads = np.zeros((sum(step.sizes[key] for key in ("n", "nz", "m")), 0)), np.zeros((step.sizes["n"], 0))
    mapped = case.theta, plain, case.feedback, np.zeros((*plain.torque.shape, 1)), loads
    assert poor.grants_needed(lambda: kernel.linearized_rollout_steps(*mapped)) == 1
    poor.grants.value = 100
    again = kernel.rollout(differentiated)
    np.testing.assert_array_equal(again.state, plain.state)
    np.testing.assert_array_equal(again.state_sensitivity, plain.state_sensitivity)


@needs_compiler
def test_structs_are_laid_out_as_in_the_kernel(step):
    """A field at another place would be read as another array."""
    structs = compiled._Struct.__subclasses__()
    assert len(structs) == 10
    fields = [(kind, field) for kind in structs for field, _ in kind._fields_]
    sizes = [f"sizeof({kind.__name__})" for kind in structs]
    places = [f"offsetof({kind.__name__}, {field})" for kind, field in fields]
    text = f"#include <stddef.h>\nconst long long yid_layout[] = {{{', '.join(sizes + places)}}};\n"
    source = codegen.kernel_c_source(step.model.functions, step.model.index_tables)
    library = compiler.compile_and_load_library(source + text)
    layout = list((ctypes.c_longlong * (len(sizes) + len(places))).in_dll(library, "yid_layout"))
    expected = [ctypes.sizeof(kind) for kind in structs] + [getattr(kind, field).offset for kind, field in fields]
    assert layout == expected


@pytest.mark.parametrize("use_compiler", [True, False], ids=["compiled", "interpreted"])
def test_a_rollout_beyond_all_memory(refused_with, urdf_folder, use_compiler):
    system = System.build(read_urdf(urdf_folder / "double_pendulum.urdf"))
    step = compile_step(system, 0.01, use_compiler=use_compiler)
    theta, start, nothing = system.parameters.vector(), np.zeros(4), np.zeros((3, 0))
    with refused_with(
        InsufficientMemoryError,
        ("a rollout of 100000000000000 steps with 0 derivatives", "3.2e+06 GB", "fewer parameters"),
    ):
        simulate(step, theta, start, 10**14)
    wide = SensitivityDirections((), np.broadcast_to(0.0, (4, 10**15)))
    said = r"3 steps with 1000000000000000 derivatives needs 1\.28e\+08 GB"
    with pytest.raises(InsufficientMemoryError, match=said):
        step.kernel.rollout(RolloutInputs(theta, start, nothing, np.zeros((4, 0)), None, wide))


def test_fewer_directions_than_parameters_are_refused():
    with pytest.raises(ModelError, match="1 columns for 2 parameters"):
        SensitivityDirections(("a", "b"), np.zeros((4, 1)))


@needs_compiler
def test_derivatives_that_the_cache_has_are_not_derived_again(parts, urdf_folder, monkeypatch, tmp_path):
    monkeypatch.setenv("YID_OCP_CACHE", str(tmp_path))
    names = ("spin.mass", "hinge.damping")

    def swept(wanted):
        case = parts.make_case(*parts.closed_loop(urdf_folder))
        directions = SensitivityDirections(wanted, np.zeros((case.step.sizes["nx"], len(wanted))))
        return case.rollout(directions=directions).state_sensitivity

    first, turned = swept(names), swept(names[::-1])
    np.testing.assert_array_equal(turned, first[:, :, ::-1])
    monkeypatch.setattr(codegen, "parameter_jacobian_function", Mock(side_effect=AssertionError("derived again")))
    np.testing.assert_array_equal(swept(names), first)
    with pytest.raises(AssertionError, match="derived again"):
        swept(("spin.mass",))


@needs_compiler
def test_derivatives_are_those_of_their_own_equations(parts, robot, monkeypatch, tmp_path):
    """Two systems whose parameters have the same names and places, and other equations."""

    def swept(split, cache):
        monkeypatch.setenv("YID_OCP_CACHE", str(tmp_path / cache))
        system = System.build(robot, driven=("shoulder",), damping={"shoulder": 0.3, "elbow": 0.1})
        made = compile_step(system, 1e-2, force_split=split)
        directions = SensitivityDirections(("elbow.damping",), np.zeros((made.sizes["nx"], 1)))
        start = np.concatenate([[0.4, -0.3], np.zeros(made.sizes["nx"] - 2)])
        given = system.parameters.vector(), start, np.full((20, 1), 0.7), np.zeros((21, 0))
        return made.kernel.rollout(RolloutInputs(*given, None, directions)).state_sensitivity

    together = [swept(split, "one") for split in ("left", "symmetric")]
    for split, found in zip(("left", "symmetric"), together, strict=True):
        np.testing.assert_array_equal(found, swept(split, f"that of {split}"))


THREADS = 4
GIVEN = ("state", "multipliers", "effort", "state_sensitivity", "multipliers_sensitivity")


@pytest.fixture(params=[True, False], ids=["compiled", "interpreted"])
def use_compiler(request):
    return request.param and bool(request.getfixturevalue("c_compiler"))


def at_once(function, items):
    """Results of all items, every thread let go at the same moment."""
    gate = threading.Barrier(len(items))

    def run(item):
        gate.wait()
        return function(item)

    with ThreadPoolExecutor(len(items)) as pool:
        return list(pool.map(run, items))


def slowed(monkeypatch, owner, name):
    """Count the calls of a function and let each last long enough for other threads to come in between."""
    calls = []
    original = getattr(owner, name)

    def slow(*arguments, **options):
        calls.append(name)
        time.sleep(0.05)
        return original(*arguments, **options)

    monkeypatch.setattr(owner, name, slow)
    return calls


def assert_equal_arrays(one, other):
    for actual, expected in zip(one, other, strict=True):
        for a, b in zip(actual, expected, strict=True):
            np.testing.assert_array_equal(a, b)


def test_rollouts_adjoints_and_linearizations(parts, urdf_folder, monkeypatch, tmp_path, use_compiler):
    monkeypatch.setenv("YID_OCP_CACHE", str(tmp_path))
    case = parts.make_case(*parts.closed_loop(urdf_folder), steps=40)
    system = case.step.system
    names = tuple(system.parameters.names[::2])
    directions = SensitivityDirections(names, np.random.default_rng(1).normal(size=(len(case.start), len(names))))
    inputs = RolloutInputs(case.theta, case.start, case.torque, case.path, case.feedback, directions)
    thetas = [case.theta * (1 + 0.02 * i) for i in range(THREADS)]

    def everything(step):
        def run(theta):
            rollout = step.kernel.rollout(replace(inputs, theta=theta))
            assert rollout.status.is_converged, rollout.status.message
            cost = (np.ones_like(rollout.state), None, None)
            back = step.kernel.adjoint_gradient(theta, rollout, case.feedback, names, cost)
            along = step.kernel.step_residuals_and_jacobians(
                theta, rollout.state, rollout.multipliers, rollout.torque, names, True
            )
            return *[getattr(rollout, name) for name in GIVEN], *vars(back).values(), *vars(along).values()

        return run

    # neither step has its derivatives by these parameters yet
    shared, plain = (compile_step(system, case.step.time_step, use_compiler=use_compiler) for _ in range(2))
    built = slowed(monkeypatch, codegen, "parameter_jacobian_function")
    together = at_once(everything(shared), thetas)
    assert built == (["parameter_jacobian_function"] if use_compiler else [])
    assert_equal_arrays(together, [everything(plain)(theta) for theta in thetas])


def test_equilibria(parts, monkeypatch):
    system = parts.cable()
    shared, plain = (EquilibriumSolver(compile_step(system, 1e-3, use_compiler=False)) for _ in range(2))
    thetas = [system.parameters.vector({"C.bend": 2.0 + i}) for i in range(THREADS)]

    def rest(statics):
        def run(theta):
            found = statics.solve([], theta, names=("C.bend", "C.mass"))
            assert found.is_converged, found.message
            return found.state, found.state_by_theta

        return run

    built = slowed(monkeypatch, ca, "jacobian")
    together = at_once(rest(shared), thetas)
    assert len(built) == 2  # of a step by its unknowns and by all else, once
    assert_equal_arrays(together, [rest(plain)(theta) for theta in thetas])
