"""One step as constraints of a nonlinear program: DEL equations of (x_k, x_{k+1}, lam_k, u_k, theta), none eliminated.

With x = (q, p, z) and the letters of `discrete.py`, the rows of a stage are, all of order one,

    free rows of the momentum balance / h      internal equations      constraints      (p_{k+1} - p1(q_k, q_{k+1})) / h

They do not depend on recordings: torques, prescribed coordinates and parameters may be data or unknowns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca

from yid_ocp.integrator.discrete import DiscreteEquations
from yid_ocp.model.kinematics import lagrangian_second_derivatives


@dataclass(frozen=True, eq=False)
class NlpStage:
    """Symbolic equality constraints of one step in a nonlinear program, and their Jacobians.

    Letters: n coordinates, nz internal ones, m constraints, nu inputs, nc prescribed coordinates, nx = 2 n + nz.

    Attributes
    ----------
    x0, x1 : casadi.SX, shape (nx, 1)
        States (q, p, z) at the two nodes, `time_step` [s] apart.
    residual : casadi.SX, shape (nr, 1)
        Zero if the step equations hold.
    residual_names : tuple of str
        Names of the rows: `del[JOINT]`, `internal[NAME]`, `constraint[GRASP.x]`, `p1[JOINT]`.
    prescribed_effort : casadi.SX, shape (nc, 1)
        Effort of the prescribed coordinates at the first node [N m].
    residual_jacobians, effort_jacobians : mapping of str to casadi.SX
        Derivatives of the two by `x0`, `x1`, `lam` and `u`, sparse.
    """

    equations: DiscreteEquations
    time_step: float
    x0: ca.SX
    x1: ca.SX
    lam: ca.SX
    u: ca.SX
    theta: ca.SX
    residual: ca.SX
    residual_names: tuple[str, ...]
    residual_jacobians: dict[str, ca.SX]
    prescribed_effort: ca.SX
    effort_jacobians: dict[str, ca.SX]

    def parameter_jacobians(self, names: Sequence[str]) -> tuple[ca.SX, ca.SX]:
        """Derivatives of `residual` and of `prescribed_effort` by named parameters, sparse, shape (..., len(names))."""
        parameters = self.equations.system.parameters
        chosen = ca.vertcat(ca.SX(0, 1), *(parameters[name].symbol for name in names))
        return ca.jacobian(self.residual, chosen), ca.jacobian(self.prescribed_effort, chosen)


def nlp_stage(equations: DiscreteEquations, time_step: float) -> NlpStage:
    """The constraint rows of one step and their derivatives for a time step [s].

    The bodies' second derivatives have a closed form (`RigidBodyLagrangianDerivatives`) with a quarter of the
    operations of automatic differentiation, which gives all others.
    """
    e, h, system = equations, time_step, equations.system
    free, fixed = list(system.unprescribed_coordinate_indices), list(system.prescribed_coordinate_indices)
    p1 = ca.SX.sym("p1", e.p0.numel())
    x0, x1 = ca.vertcat(e.q0, e.p0, e.z0), ca.vertcat(e.q1, p1, e.z1)
    names = [f"del[{system.mechanism.joint_names[i]}]" for i in free]
    names += [f"internal[{name}]" for name in system.internal_coordinates]
    names += [f"constraint[{name}]" for grasp in system.grasps for name in grasp.constraint_equation_names]
    names += [f"p1[{name}]" for name in system.mechanism.joint_names]
    rows = ca.vertcat(e.momentum_balance[free] / h, e.internal_residual, e.constraint_residual, (p1 - e.p1) / h)
    effort = -e.momentum_balance[fixed] / e.h
    balance, end = _slopes(e)
    groups = {"x0": ("q0", "p0", "z0"), "x1": ("q1", "none", "z1"), "lam": ("lam",), "u": ("u",)}
    symbols = {"x0": x0, "x1": x1, "lam": e.lam, "u": e.u}
    slopes, effort_slopes = [], []
    for name, parts in groups.items():
        first, last = (ca.horzcat(*(by[part] for part in parts)) for by in (balance, end))
        middle = ca.jacobian(ca.vertcat(e.internal_residual, e.constraint_residual), symbols[name])
        slopes.append(ca.vertcat(first[free, :] / h, middle, (ca.jacobian(p1, symbols[name]) - last) / h))
        effort_slopes.append(-first[fixed, :] / e.h)
    made = ca.substitute([rows, effort, *slopes, *effort_slopes], [e.time_step], [ca.SX(h)])
    rows, effort, *values = ca.cse([ca.sparsify(expression) for expression in made])
    by = [dict(zip(groups, part, strict=True)) for part in (values[: len(groups)], values[len(groups) :])]
    dense = ca.densify(rows), ca.densify(effort)
    return NlpStage(e, h, x0, x1, e.lam, e.u, e.theta, dense[0], tuple(names), by[0], dense[1], by[1])


def _slopes(e: DiscreteEquations) -> tuple[dict[str, ca.SX], dict[str, ca.SX]]:
    """Derivatives of `momentum_balance` and of `p1` by the step's symbols, and by `none`, on which neither depends.

    With L the bodies' Lagrangian at the midpoint and a = -1 in the balance, +1 in p1,  h/2 L_q + a L_v  changes by
    h/4 L_qq + b/2 L_qv + a (1/2 L_vq + b/h L_vv)  with q_k (b = -1) and with q_{k+1} (b = 1).
    """
    n, h, scale, pulls = e.q0.numel(), e.h, e.row_scale, e.constraint_impulses
    rigid = e.rigid_body_terms
    L_qq, L_qv, L_vv = lagrangian_second_derivatives(rigid, e.system.mechanism)
    bent = pulls.midpoint_share * pulls.middle_force_by_q / 2
    curves = {
        -1: {"q0": pulls.start_share * pulls.before_force_by_q + bent, "q1": bent},
        1: {"q0": bent, "q1": bent - pulls.midpoint_share * pulls.after_force_by_q},
    }
    impulses = e.closed_form_force_impulses or (ca.SX(n, 1), ca.SX(n, 1))
    found = []
    apart_and_rows = (e.balance_remainder, pulls.left_jacobian), (e.p1_remainder, pulls.right_jacobian)
    for side, impulse, (rest, rows) in zip((-1, 1), impulses, apart_and_rows, strict=True):
        apart = rest + impulse
        by = {name: ca.jacobian(apart, getattr(e, name)) for name in ("q0", "q1", "z0", "z1", "u")}
        for name, sign in (("q0", -1), ("q1", 1)):
            bodies = h / 4 * L_qq + sign / 2 * L_qv + side * (L_qv.T / 2 + sign * L_vv / h)
            by[name] += ca.mtimes(ca.diag(scale), bodies - curves[side][name])
        # placements, masses and grasps may depend on internal coordinates
        whole = scale * (h / 2 * rigid.lagrangian_by_q + side * rigid.lagrangian_by_v - rows.T @ e.lam)
        for name in ("z0", "z1"):
            by[name] += ca.jacobian(whole, getattr(e, name))
        by["lam"] = -ca.mtimes(ca.diag(scale), rows.T)
        by["p0"] = ca.SX.eye(n) if side < 0 else ca.SX(n, n)
        by["none"] = ca.SX(n, n)
        found.append(by)
    return found[0], found[1]
