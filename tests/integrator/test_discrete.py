"""The step's equations against the discrete Lagrangian, differentiated by CasADi from the energies alone."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from yid_ocp.integrator.discrete import discrete_equations
from yid_ocp.model import System, forward_kinematics
from yid_ocp.model.kinematics import rigid_body
from yid_ocp.model.urdf import read_urdf

SHARES = {"symmetric": (0.5, 0.5), "left": (1.0, 1.0), "left_damping": (0.5, 1.0)}


def discrete_lagrangian(system: System, q0: ca.SX, q1: ca.SX, h: ca.SX) -> ca.SX:
    """L_d = h L((q0 + q1)/2, (q1 - q0)/h) without effects [J s] (Marsden and West 2001, section 1.3)."""
    q, v = (q0 + q1) / 2, (q1 - q0) / h
    rigid = rigid_body(forward_kinematics(system.mechanism, q), v, system.gravity)
    return h * (rigid.kinetic - rigid.potential - system.elastic_energy(q))


SYSTEMS = {
    "closed_loop": lambda parts, folder: parts.closed_loop(folder)[0],
    "welded_cable": lambda parts, folder: parts.clamped_cable("weld")[0],
    "aligned_cable": lambda parts, folder: parts.clamped_cable("axis")[0],
    "open_chain": lambda parts, folder: System.build(
        read_urdf(folder / "mixed_joints.urdf"), driven=["nod", "slide"], damping=0.3
    ),
}


@pytest.mark.parametrize("force_split", list(SHARES))
@pytest.mark.parametrize("name", list(SYSTEMS))
def test_equations_are_slot_derivatives_of_the_discrete_lagrangian(parts, urdf_folder, name, force_split):
    system = SYSTEMS[name](parts, urdf_folder)
    e = discrete_equations(system, force_split)
    action = discrete_lagrangian(system, e.q0, e.q1, e.h)
    share, viscous_share = SHARES[force_split]
    force, viscous = system.input_force(e.u), system.viscous_force((e.q1 - e.q0) / e.h)
    closure = [system.constraints(forward_kinematics(system.mechanism, q)) for q in (e.q0, e.q1)]
    pull = ca.jtimes(closure[0], e.q0, e.lam, True)
    push = e.h * (share * force + viscous_share * viscous)
    expected = {
        "momentum_balance": e.p0 + ca.gradient(action, e.q0) + push - pull,
        "p1": ca.gradient(action, e.q1) + e.h * (force + viscous) - push,
        "constraint": closure[1],
        "constraint_matrix": ca.jacobian(closure[0], e.q0),
        "pull_by_q": ca.jacobian(pull, e.q0),
    }
    pairs = [ca.densify(x) for key, value in expected.items() for x in (getattr(e, key), value)]
    function = ca.Function("pairs", e.arguments, pairs)
    rng = np.random.default_rng(4)
    theta = system.parameters.vector()
    for _ in range(3):
        q0 = rng.uniform(-1, 1, system.size)
        point = [q0, q0 + 0.05 * rng.normal(size=system.size)]
        point += [rng.normal(size=x.numel()) for x in (e.p0, e.z0, e.z1, e.lam, e.u)]
        values = [np.array(x) for x in function.call([*point, theta, 0.01])]
        for actual, wanted in zip(values[::2], values[1::2], strict=True):
            scale = max(1.0, np.max(np.abs(wanted), initial=0.0))
            np.testing.assert_allclose(actual, wanted, rtol=0, atol=1e-11 * scale)
