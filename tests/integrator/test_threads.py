"""One step shared by threads gives, bit for bit, what it gives to them one by one."""

from __future__ import annotations

import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from yid_ocp.integrator import codegen, compiler
from yid_ocp.integrator.statics import EquilibriumSolver
from yid_ocp.integrator.step import compile_step
from yid_ocp.integrator.step_model import RolloutInputs, SensitivityDirections

THREADS = 4


@pytest.fixture(params=[True, False], ids=["compiled", "interpreted"])
def use_compiler(request):
    if request.param and compiler._compiler_path() is None:
        pytest.skip("this machine has no C compiler")
    return request.param


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


def assert_same(one, other):
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
            along = step.kernel.linearize(theta, rollout.state, rollout.multipliers, rollout.torque, names, True)
            found = (
                rollout.state,
                rollout.multipliers,
                rollout.effort,
                rollout.state_sensitivity,
                rollout.multipliers_sensitivity,
            )
            return *found, *vars(back).values(), *vars(along).values()

        return run

    # neither step has its derivatives by these parameters yet
    shared, plain = (compile_step(system, case.step.time_step, use_compiler=use_compiler) for _ in range(2))
    built = slowed(monkeypatch, codegen, "parameter_jacobian_function")
    together = at_once(everything(shared), thetas)
    assert built == (["parameter_jacobian_function"] if use_compiler else [])
    assert_same(together, [everything(plain)(theta) for theta in thetas])


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
    assert_same(together, [rest(plain)(theta) for theta in thetas])
