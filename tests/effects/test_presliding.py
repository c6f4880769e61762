"""Friction that holds at rest: Dahl's equation, whatever the step, without ringing and without making energy."""

from __future__ import annotations

import itertools

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from yid_ocp.effects import make_effect
from yid_ocp.integrator.step import compile_step, simulate
from yid_ocp.model import Mechanism, System
from yid_ocp.model.mechanism import Frame, Inertia, Joint, Placement
from yid_ocp.problem import ProblemOptions
from yid_ocp.problem.unknown_vector import estimated_initial_state_names, initial_state_offset_limits

H, TAU = 0.01, 0.8
BODY = Inertia.from_values(0.5, [0.0, 0.0, 0.2], np.diag([1e-2, 1e-2, 1e-3]))


def hinge(mode: str, gravity=(0.0, 0.0, 0.0)) -> System:
    joint = Joint("hinge", "revolute", -1, Placement.identity(), (0.0, 1.0, 0.0), (BODY,))
    tree = Mechanism("arm", (joint,), {"tip": Frame(0, Placement.identity())})
    return System.build(tree, gravity=gravity, **({} if mode == "free" else {mode: ["hinge"]}))


def rubbed(path: np.ndarray, width: float, h: float = H, s0: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Friction in every step and s at every node along a prescribed path."""
    system = hinge("prescribed")
    effect = make_effect("joint_presliding", "hinge", system, {"tau_c": TAU, "yield_angle": width})
    with_it, without = (compile_step(one, h, use_compiler=False) for one in (system.with_effects([effect]), system))
    found = []
    for step, begin in ((with_it, [0.0, 0.0, s0]), (without, [0.0, 0.0])):
        rollout = simulate(step, step.system.parameters.vector(), np.array(begin), len(path) - 1, path=path[:, None])
        assert rollout.status.is_converged
        found.append(rollout)
    # half of a step's force acts at either end: what a node needs is the mean of the steps beside it
    both = found[0].effort[:, 0] - found[1].effort[:, 0]
    return both, found[0].state[:, 2]


def sway(count: int, h: float) -> np.ndarray:
    t = h * np.arange(count + 1)
    return 0.3 * (1 - np.cos(2 * np.pi * t)) + 0.05 * np.sin(9 * t) - 0.45 * t


@pytest.mark.parametrize("width", [0.2, 0.02, 1e-4])
def test_s_is_the_solution_of_dahls_equation(width) -> None:
    path = sway(200, H)
    _, s = rubbed(path, width, s0=-0.4)
    expected = [-0.4]
    for a, b in itertools.pairwise(path):
        way = np.sign(b - a)
        run = solve_ivp(lambda x, y, way=way: (1 - way * y) / width * way, (0, abs(b - a)), [expected[-1]], rtol=1e-9)
        expected.append(float(run.y[0, -1]))
    np.testing.assert_allclose(s, expected, atol=5e-3)
    assert np.max(np.abs(s)) <= 1.0 + 1e-3


def test_every_step_takes_out_more_than_it_stores() -> None:
    """Stored is tau_c yield_angle s^2/2; the law of one step alone, for any angle and any s."""
    system = hinge("prescribed")
    effect = make_effect("joint_presliding", "hinge", system, {"tau_c": TAU, "yield_angle": 0.01})
    step = compile_step(system.with_effects([effect]), H, use_compiler=False)
    e, theta = step.equations, step.system.parameters.vector()
    plain = compile_step(system, H, use_compiler=False)
    rng = np.random.default_rng(1)
    law = ca.Function(
        "law", [e.q0, e.q1, e.z0, e.z1, e.p0, e.theta, e.time_step], [e.internal_residual, e.momentum_balance]
    )
    bare = ca.Function(
        "bare",
        [plain.equations.q0, plain.equations.q1, plain.equations.p0, plain.equations.theta, plain.equations.time_step],
        [plain.equations.momentum_balance],
    )
    for _ in range(200):
        turned, before = 10.0 ** rng.uniform(-7, 0) * rng.choice([-1, 1]), rng.uniform(-1, 1)
        residual = float(law(0, turned, before, before, 0, theta, H)[0])
        after = before - residual  # the equation is z1 - z0 - change, whatever z1 is
        assert abs(float(law(0, turned, before, after, 0, theta, H)[0])) < 1e-12
        friction = float(law(0, turned, before, after, 0, theta, H)[1]) - float(
            bare(0, turned, 0, system.parameters.vector(), H)
        )
        work = -friction / (H / 2) * turned
        stored = TAU * 0.01 * (after**2 - before**2) / 2
        assert work >= stored - 1e-6 * TAU * 0.01


def test_it_holds_a_load_at_rest_and_lets_go_above() -> None:
    """Gravity on a hanging arm turned aside: below tau_c it creeps into the presliding angle and stays."""
    weight = 0.5 * 9.81 * 0.2
    for tau_c, stays in ((1.3 * weight, True), (0.5 * weight, False)):
        system = hinge("free", (9.81, 0.0, 0.0))
        effects = [
            make_effect("joint_presliding", "hinge", system, {"tau_c": tau_c, "yield_angle": 1e-3}),
            make_effect("joint_viscous", "hinge", system, {"b": 0.5}),
        ]
        step = compile_step(system.with_effects(effects), H / 10, use_compiler=False)
        rollout = simulate(step, step.system.parameters.vector(), np.zeros(step.sizes["nx"]), 1200)
        assert rollout.status.is_converged
        q = rollout.state[:, 0]
        assert (abs(q[-1]) < 0.02) == stays
        if stays:
            assert abs(q[-1] - q[-200]) < 1e-6
            assert rollout.state[-1, 2] == pytest.approx(weight * np.cos(q[-1]) / tau_c, rel=1e-3)


def test_a_resting_joint_is_as_stiff_as_the_friction_before_it_yields() -> None:
    system = hinge("driven")
    effect = make_effect("joint_presliding", "hinge", system, {"tau_c": TAU, "yield_angle": 0.02})
    step = compile_step(system.with_effects([effect]), H, use_compiler=False)
    theta = step.system.parameters.vector()
    a, b, _ = step.jacobians(np.zeros(1), np.zeros(1), np.zeros(1), theta, internal=np.zeros(1))
    inertia = float(np.array(ca.DM(BODY.inertia_about_com))[1, 1]) + 0.5 * 0.2**2
    # dq/du of a midpoint step: h^2/2 over M + h^2 k/4
    assert b[0, 0] == pytest.approx(H**2 / 2 / (inertia + H**2 / 4 * TAU / 0.02), rel=1e-4)
    assert a[2, 0] == pytest.approx((a[0, 0] - 1) / 0.02, rel=1e-6)


def test_where_it_begins_is_estimated_with_every_recording() -> None:
    system = hinge("prescribed")
    effect = make_effect("joint_presliding", "hinge", system)
    whole = system.with_effects([effect])
    theta, options = whole.parameters.vector(), ProblemOptions()
    assert estimated_initial_state_names(whole, options, (), theta) == ()
    [name] = estimated_initial_state_names(whole, options, ("joint_presliding@hinge.tau_c",), theta)
    assert name == "z.joint_presliding@hinge.s"
    assert initial_state_offset_limits(whole, [name]).tolist() == [1.0]
    known = whole.parameters.vector({"joint_presliding@hinge.tau_c": 0.1})
    assert estimated_initial_state_names(whole, options, (), known) == (name,)
