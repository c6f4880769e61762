"""opty: direct collocation of the equations that a user writes, by IPOPT."""

from __future__ import annotations

import contextlib
import io
from typing import Any

import numpy as np
import sympy as sm
from answer import Answer
from cases import Trial


def double_pendulum(trial: Trial) -> Answer:
    """Masses and dampers of the double pendulum; states at every sample are unknowns beside them."""
    from opty import Problem

    joints = trial.estimate[0].joints
    assert joints is not None
    assert joints.effort is not None
    t = sm.Symbol("t")
    q1, q2, w1, w2, u1, u2 = (sm.Function(name)(t) for name in ("q1", "q2", "w1", "w2", "u1", "u2"))
    s1, s2, c1, c2 = parameters = sm.symbols("s1 s2 c1 c2")
    both = w1 + w2
    elbow = (sm.Rational(1, 2) * w1) ** 2 + (0.2 * both) ** 2 + 0.2 * w1 * both * sm.cos(q2)
    kinetic = s1 * (0.0208 + 0.25**2) * w1**2 / 2 + s2 * (0.008 * both**2 + 0.6 * elbow) / 2
    potential = -9.81 * (s1 * 0.25 * sm.cos(q1) + s2 * 0.6 * (0.5 * sm.cos(q1) + 0.2 * sm.cos(q1 + q2)))
    lagrangian = kinetic - potential
    forces = {q1: u1 - c1 * w1, q2: u2 - c2 * w2}
    rows = [sm.diff(q1, t) - w1, sm.diff(q2, t) - w2]
    for q, w in ((q1, w1), (q2, w2)):
        momentum = sm.diff(lagrangian, w)
        rows.append((sm.diff(momentum, t) - sm.diff(lagrangian, q) - forces[q]).subs({q1.diff(t): w1, q2.diff(t): w2}))
    nodes, step = len(joints.t), float(joints.t[1] - joints.t[0])
    # torques are held over a sample: the mean of both sides at each node
    held = joints.effort
    torque = np.vstack([held[:1], (held[1:] + held[:-1]) / 2])
    measured = joints.position.T.ravel()

    def cost(free: Any) -> float:
        return float(np.sum((free[: 2 * nodes] - measured) ** 2))

    def slope(free: Any) -> Any:
        found = np.zeros_like(free)
        found[: 2 * nodes] = 2 * (free[: 2 * nodes] - measured)
        return found

    names = list(trial.unknowns)
    symbol = dict(zip(names, parameters, strict=True))
    with contextlib.redirect_stdout(io.StringIO()):
        problem = Problem(
            cost, slope, sm.Matrix(rows), (q1, q2, w1, w2), nodes, step,
            known_trajectory_map={u1: torque[:, 0], u2: torque[:, 1]}, time_symbol=t, integration_method="midpoint",
            bounds={symbol[name]: (own.lower, own.upper) for name, own in trial.unknowns.items()},
        )  # fmt: skip
        problem.add_option("print_level", 0)
        problem.add_option("max_iter", 300)
        order = problem.collocator.unknown_parameters
        begin = {symbol[name]: own.start for name, own in trial.unknowns.items()}
        speed = np.gradient(joints.position, step, axis=0).T.ravel()
        free, info = problem.solve(np.hstack([measured, speed, [begin[each] for each in order]]))
    found = dict(zip(order, map(float, free[-len(order) :]), strict=True))
    status = info["status_msg"]
    message = status.decode() if isinstance(status, bytes) else str(status)
    return Answer({name: found[symbol[name]] for name in names}, messages=() if info["status"] == 0 else (message,))


BY_CASE = {"scaled_torque": double_pendulum}
