"""The midpoint discrete Euler-Lagrange (DEL) equations of a system as symbolic expressions.

Position-momentum form, with L_d(q0, q1) = h L((q0 + q1)/2, (q1 - q0)/h) and q_m = (q_k + q_{k+1})/2:

    p_k + D1 L_d(q_k, q_{k+1}) + f- - ((1 - s) Dphi(q_k) + s Dphi(q_m))' lam_k = 0     phi(q_{k+1}) - C lam_k / h = 0
    p_{k+1} = D2 L_d(q_k, q_{k+1}) + f+ - s (Dphi(q_m) - Dphi(q_{k+1}))' lam_k

phi = 0 are the constraints of grasps, with Jacobian Dphi, multipliers lam and compliance C. F is the generalized force.
The symmetric force split has f- = f+ = (h/2) F, the left one f- = h F and f+ = 0. s = 0 puts the constraint force at
the node, s = 1/2 at the midpoint. With s = 1/2 the motion is stable under any tension, with s = 0 only if lam times the
constraint's curvature is below 4 M/h^2 with the mass M (docs/design/constraints.md). Both rules have order two.

The first equation holds for free coordinates. At a prescribed coordinate its left side is -h times the effort that the
motion requires at node k. Both equations of a compliant coordinate are multiplied by its compliance, and so is its
momentum p [rad s]. The spring force (1/compliance) thus stays finite, and the order stays two.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import casadi as ca

from yid_ocp.errors import ModelError, require_known_names
from yid_ocp.model.kinematics import (
    Kinematics,
    LagrangianFirstDerivatives,
    forward_kinematics,
    lagrangian_first_derivatives,
    lagrangian_second_derivatives,
)
from yid_ocp.model.servos_and_springs import MOTOR_OFF_COMMAND
from yid_ocp.model.system import ForceWithFactoredDerivatives, MidpointStateSymbols, System

RIGID_HOLD_STIFFNESS = 1e5
"""Stiffness of a spring that holds a joint at its measured angle with less deflection than encoder noise [N m/rad]."""
ForceSplit = Literal["symmetric", "left"]
ConstraintForcePlacement = Literal["node", "midpoint"]


@dataclass(frozen=True)
class _ConstraintImpulses:
    """Dphi (m, n) and d(Dphi(q)' lam)/dq (n, n) at q_k, q_m and q_{k+1}, with one sparsity pattern.

    The balance loses (start Dphi(q_k) + share Dphi(q_m))' lam with start + share = 1. p1 loses share (Dphi(q_m) -
    Dphi(q_{k+1}))' lam.
    """

    start_share: float
    midpoint_share: float
    before_jacobian: ca.SX
    middle_jacobian: ca.SX
    after_jacobian: ca.SX
    before_force_by_q: ca.SX
    middle_force_by_q: ca.SX
    after_force_by_q: ca.SX

    @property
    def left_jacobian(self) -> ca.SX:
        """Jacobian (m, n); the momentum balance contains minus its transpose times lam."""
        return self.start_share * self.before_jacobian + self.midpoint_share * self.middle_jacobian

    @property
    def right_jacobian(self) -> ca.SX:
        """Jacobian (m, n); p1 contains minus its transpose times lam."""
        return self.midpoint_share * (self.middle_jacobian - self.after_jacobian)


@dataclass(frozen=True)
class DiscreteEquations:
    """The symbolic discrete Euler-Lagrange (DEL) equations of one step of a system, from node 0 to node 1.

    q (n, 1) are coordinates, z (nz, 1) internal coordinates and p (n, 1) momenta [N m s]; the digit 0 or 1 in a name
    denotes the node. The system has m constraints, nu inputs and ntheta parameters.
    """

    system: System
    force_split: ForceSplit
    constraint_force_at: ConstraintForcePlacement
    q0: ca.SX
    q1: ca.SX
    z0: ca.SX
    z1: ca.SX
    p0: ca.SX
    lam: ca.SX  # multipliers of the step, (m, 1) [N s]
    u: ca.SX  # motor torques held over the step [N m], or servo commands [rad or m], (nu, 1)
    theta: ca.SX
    time_step: ca.SX  # as recorded [s]
    h: ca.SX  # true time step in the equations: `time_step` times `System.recorded_time_scale`
    momentum_balance: ca.SX  # left side of the DEL equation, (n, 1)
    internal_residual: ca.SX  # midpoint equations of the internal coordinates, (nz, 1)
    internal_residual_at_rest: ca.SX
    constraint_residual: ca.SX  # phi(q_{k+1}) - C lam / h, (m, 1)
    # factor on phi(q_{k+1}) in `constraint_residual` if a grasp relaxes: g = 1 + T/h; phi(q_k) has 1 - g
    constraint_relaxation_gain: ca.SX | None
    p1: ca.SX
    rigid_body_terms: LagrangianFirstDerivatives
    effect_momentum: ca.SX  # derivative by v of the effects' part of the Lagrangian, such as rotor inertias, (n, 1)
    # `momentum_balance` and `p1` without bodies, p_k, constraint impulses and closed force: for fast Jacobians
    balance_remainder: ca.SX
    p1_remainder: ca.SX
    # sum of those that effects give with their slopes, at the midpoint
    force_with_derivatives: ForceWithFactoredDerivatives | None
    force_with_derivatives_shares: tuple[float, float]  # parts of its impulse h F in `momentum_balance` and in `p1`
    constraint_impulses: _ConstraintImpulses
    row_scale: ca.SX  # factor on rows of the bodies' part and of `constraint_impulses`: 1, or a compliance, (n, 1)

    @property
    def arguments(self) -> list[ca.SX]:
        """The arguments of every compiled function of the step, in order."""
        return [self.q0, self.q1, self.p0, self.z0, self.z1, self.lam, self.u, self.theta, self.time_step]

    @property
    def residual(self) -> ca.SX:
        """The residual of the step: momentum balance of free coordinates, internal equations and constraints."""
        balance = self.momentum_balance[list(self.system.unprescribed_coordinate_indices), 0]
        return ca.vertcat(balance, self.internal_residual, self.constraint_residual)

    @property
    def force_with_derivatives_impulses(self) -> tuple[ca.SX, ca.SX] | None:
        """Impulses (n, 1) [N m s] of `force_with_derivatives` in `momentum_balance` and `p1`, or None without it."""
        if self.force_with_derivatives is None:
            return None
        force, (left, right) = self.force_with_derivatives.force, self.force_with_derivatives_shares
        return left * self.h * self.row_scale * force, right * self.h * self.row_scale * force

    @property
    def end_of_step_constraint_violation(self) -> ca.SX:
        """The constraint violation phi(q_{k+1}) - C lam / h (m, 1) at the end of the step, without relaxation."""
        return ca.substitute(self.constraint_residual, ca.vertcat(self.q0, self.z0), ca.vertcat(self.q1, self.z1))

    @property
    def newton_unknowns(self) -> ca.SX:
        """The unknowns of Newton's method: free coordinates of q1, internal coordinates z1 and multipliers lam."""
        return ca.vertcat(self.q1[list(self.system.unprescribed_coordinate_indices), 0], self.z1, self.lam)


def discrete_equations(
    system: System, force_split: ForceSplit = "symmetric", constraint_force_at: ConstraintForcePlacement = "midpoint"
) -> DiscreteEquations:
    """Build the discrete Euler-Lagrange equations of one step. Arguments are as in `compile_step`.

    Raises `ModelError` for an unknown rule, or if an internal coordinate has no equation.

    References
    ----------
    Marsden and West (2001), Acta Numerica 10:357, section 3, doi:10.1017/S096249290100006X.
    Johnson and Murphey (2009), IEEE Trans. Robotics 25(6):1249, doi:10.1109/TRO.2009.2032955.
    """
    require_known_names([force_split], get_args(ForceSplit), "rule", "force_split", ModelError)
    places = get_args(ConstraintForcePlacement)
    require_known_names([constraint_force_at], places, "rule", "constraint_force_at", ModelError)
    at = _Symbols.from_system(system)
    lam, h, qm, vm = at.lam, at.h, at.qm, at.vm
    kinematics = forward_kinematics(system.mechanism, qm)
    rigid = lagrangian_first_derivatives(kinematics, vm, system.gravity)
    lagrangian, force, internal, closed = _summed_terms(system, at, kinematics)
    extra_q, extra_v = ca.gradient(lagrangian, qm), ca.gradient(lagrangian, vm)

    share = 1.0 if force_split == "left" else 0.5
    push = h * force
    scale, spring = _row_scale(system, at)
    pulls = _constraint_pulls(system, at, kinematics, 0.0 if constraint_force_at == "node" else 0.5)
    constraint, gain = _constraint(system, at, kinematics)
    balance_rest = scale * (h / 2 * extra_q - extra_v + share * push) - spring
    p1_rest = scale * (h / 2 * extra_q + extra_v + (1 - share) * push) - spring
    by_q, by_v = rigid.lagrangian_by_q, rigid.lagrangian_by_v
    balance = at.p0 + scale * (h / 2 * by_q - by_v - pulls.left_jacobian.T @ lam) + balance_rest
    p1 = scale * (h / 2 * by_q + by_v - pulls.right_jacobian.T @ lam) + p1_rest
    if closed is not None:
        balance += share * h * scale * closed.force
        p1 += (1 - share) * h * scale * closed.force
    symbols = {name: getattr(at, name) for name in ("q0", "q1", "z0", "z1", "p0", "lam", "u", "time_step", "h")}
    wanted = {"momentum_balance": balance, "internal_residual": internal[0], "internal_residual_at_rest": internal[1]}
    wanted |= {"p1": p1, "balance_remainder": balance_rest, "p1_remainder": p1_rest, "effect_momentum": extra_v}
    parts = () if closed is None else (closed.force, closed.A, closed.T)
    # together, so that all of them share what they have in common
    placed = at.placed([*wanted.values(), *vars(rigid).values(), *parts])
    first, last = len(wanted), len(wanted) + len(vars(rigid))
    return DiscreteEquations(
        system=system,
        force_split=force_split,
        constraint_force_at=constraint_force_at,
        **symbols,
        theta=system.parameters.symbols,
        **dict(zip(wanted, placed[:first], strict=True)),
        constraint_residual=constraint,
        constraint_relaxation_gain=gain,
        rigid_body_terms=LagrangianFirstDerivatives(*placed[first:last]),
        force_with_derivatives=ForceWithFactoredDerivatives(*placed[last:]) if parts else None,
        force_with_derivatives_shares=(share, 1 - share),
        constraint_impulses=pulls,
        row_scale=ca.densify(scale),
    )


@dataclass(frozen=True)
class _Symbols:
    """The symbols of a step and of its midpoint. `placed` replaces the midpoint's symbols by those of the two nodes."""

    q0: ca.SX
    q1: ca.SX
    p0: ca.SX
    z0: ca.SX
    z1: ca.SX
    lam: ca.SX
    u: ca.SX
    time_step: ca.SX
    h: ca.SX
    qm: ca.SX
    vm: ca.SX
    zm: ca.SX
    z_rate: ca.SX
    pull_rate: ca.SX
    internal: ca.SX

    @staticmethod
    def from_system(system: System) -> _Symbols:
        internal = system.effect_internal_coordinate_symbols
        n, m, nz = system.n_coordinates, system.n_constraints, len(internal)
        sizes = {"q0": n, "q1": n, "p0": n, "z0": nz, "z1": nz, "lam": m, "u": len(system.driven), "time_step": 1}
        sizes |= {"qm": n, "vm": n, "zm": nz, "z_rate": nz, "pull_rate": m}
        symbols = {name: ca.SX.sym(name, size) for name, size in sizes.items()}
        own = ca.vertcat(*internal.values()) if internal else ca.SX(0, 1)
        return _Symbols(**symbols, h=symbols["time_step"] * system.recorded_time_scale, internal=own)

    def placed(self, expressions: Sequence[ca.SX], dense: bool = True) -> list[ca.SX]:
        """Expressions in which symbols of the two nodes replace those of the midpoint."""
        midpoint = ca.vertcat(self.qm, self.vm, self.zm, self.z_rate, self.pull_rate, self.internal)
        (q, v), (z, z_rate) = (((a + b) / 2, (b - a) / self.h) for a, b in ((self.q0, self.q1), (self.z0, self.z1)))
        placed = ca.substitute(list(expressions), [midpoint], [ca.vertcat(q, v, z, z_rate, self.lam / self.h, z)])
        return [ca.densify(x) for x in placed] if dense else placed


def _summed_terms(
    system: System, at: _Symbols, kinematics: Kinematics
) -> tuple[ca.SX, ca.SX, tuple[ca.SX, ca.SX], ForceWithFactoredDerivatives | None]:
    """Lagrangian, force, internal equations (moving, at rest) and closed-form force of springs, inputs and effects."""
    names = tuple(system.effect_internal_coordinate_symbols)
    rows_of = {name: i for i, name in enumerate(names)}
    state = MidpointStateSymbols(system, kinematics, at.qm, at.vm, at.zm, at.z_rate, at.u, at.pull_rate, rows_of, at.h)
    energy = -system.elastic_energy(at.qm)
    force, viscous = system.input_force(at.u, at.qm, at.vm), system.viscous_force(at.vm)
    equations, at_rest, closed = dict[str, ca.SX](), dict[str, ca.SX](), list[ForceWithFactoredDerivatives]()
    for effect in system.effects:
        terms = effect.step_terms(state)
        energy += terms.lagrangian
        force = force if terms.generalized_force is None else force + terms.generalized_force
        viscous = viscous if terms.dissipative_force is None else viscous + terms.dissipative_force
        equations.update(terms.internal_equations)
        at_rest.update(terms.static_equations)
        closed += [] if terms.force_with_derivatives is None else [terms.force_with_derivatives]
    if missing := [name for name in names if name not in equations]:
        own = next(e for e in system.effects if missing[0] in e.internal_coordinate_symbols)
        what, hint = f"the internal coordinate '{missing[0]}' has no equation", "return one in `internal_equations`"
        raise ModelError(what, where=own.label, allowed="one equation per coordinate", hint=hint)
    parts = ([getattr(c, name) for c in closed] for name in ("force", "A", "T"))
    summed = ForceWithFactoredDerivatives(*(sum(rest, first) for first, *rest in parts)) if closed else None
    internal = [ca.vertcat(ca.SX(0, 1), *(rows[name] for name in names)) for rows in (equations, equations | at_rest)]
    return energy, force + viscous, (internal[0], internal[1]), summed


def _row_scale(system: System, at: _Symbols) -> tuple[ca.SX, ca.SX]:
    """Factor on every row, and the term subtracted for the spring of a compliant coordinate, both (n, 1)."""
    scale, held = [ca.SX(1)] * system.n_coordinates, [ca.SX(0)] * system.n_coordinates
    for joint, compliance in system.joint_compliances.items():
        index = system.mechanism.joint_index(joint)
        q, v = at.qm[index], at.vm[index]
        relaxed = q + system.joint_relaxation_times[joint] * v if joint in system.joint_relaxation_times else q
        scale[index], held[index] = compliance, at.h / 2 * relaxed
    return ca.vertcat(*scale), ca.vertcat(*held)


def _constraint(system: System, at: _Symbols, middle: Kinematics) -> tuple[ca.SX, ca.SX | None]:
    """`constraint_residual` and `constraint_relaxation_gain` of `DiscreteEquations`."""
    residual = system.constraint_residual(middle)

    def phi(q: ca.SX, z: ca.SX) -> ca.SX:
        return ca.substitute([residual], [at.qm, at.internal], [q, z])[0]

    closure, gain = phi(at.q1, at.z1), None
    grasp_of_row = [grasp for grasp in system.grasps for _ in range(grasp.n_constraint_equations)]
    if not all(grasp.relaxation_time.is_zero() for grasp in grasp_of_row):
        gain = 1 + ca.vertcat(*(grasp.relaxation_time for grasp in grasp_of_row)) / at.h
        closure = gain * closure + (1 - gain) * phi(at.q0, at.z0)
    compliances = (grasp.compliance for grasp in grasp_of_row)
    return ca.densify(closure - ca.vertcat(ca.SX(0, 1), *compliances) * at.lam / at.h), gain


def _constraint_pulls(system: System, at: _Symbols, middle: Kinematics, share_m: float) -> _ConstraintImpulses:
    parts: dict[str, ca.SX] = {}
    found = _constraint_derivatives(system, middle, at.lam)
    for name, q, z in (("before", at.q0, at.z0), ("after", at.q1, at.z1)):
        jacobian, by_q = ca.substitute(found, [at.qm, at.internal], [q, z])
        parts |= {f"{name}_jacobian": jacobian, f"{name}_force_by_q": by_q}
    parts["middle_jacobian"], parts["middle_force_by_q"] = at.placed(found, dense=False)
    jacobians = ("before_jacobian", "middle_jacobian", "after_jacobian")
    before, middle_sparsity, after = (parts[name].sparsity() for name in jacobians)
    parts |= {name: ca.project(parts[name], before + middle_sparsity + after) for name in jacobians}
    return _ConstraintImpulses(1.0 - share_m, share_m, **parts)


def _constraint_derivatives(system: System, kinematics: Kinematics, lam: ca.SX) -> list[ca.SX]:
    """Dphi(q) and d(Dphi(q)' lam)/dq in closed form.

    For joint i before joint j in the chain: d2x/dq_i dq_j = w_i x dx/dq_j for a point x, d2v/dq_i dq_j = w_i x (w_j x
    v) for a direction v.
    """
    n, row = system.n_coordinates, 0
    blocks, upper = [ca.SX(0, n)], ca.SX(n, n)
    for grasp in system.grasps:
        part = lam[row : row + grasp.n_constraint_equations]
        row += grasp.n_constraint_equations
        frames = grasp.grasped_point_frames(system.mechanism)
        axes = [kinematics.angular_jacobian(frame) for frame in frames]  # w_j, zero for a prismatic joint
        block = ca.SX(3, n)
        for sign, frame, own in zip((1.0, -1.0), frames, axes, strict=True):
            jacobian = kinematics.position_jacobian(frame)
            block += sign * jacobian
            upper += sign * ca.triu((ca.skew(part[:3]) @ own).T @ jacobian)
        blocks.append(block)
        rows = grasp.orientation_products(kinematics)
        blocks += [sum((ca.cross(a, b).T @ (axes[0] - axes[1]) for a, b in pairs), ca.SX(1, n)) for pairs in rows]
        for a, b in [(part[3 + k] * a, b) for k, pairs in enumerate(rows) for a, b in pairs]:
            turns = [-ca.skew(vector) @ own for vector, own in ((a, axes[0]), (b, axes[1]))]
            upper += ca.triu((ca.skew(b) @ axes[0]).T @ turns[0]) + ca.triu((ca.skew(a) @ axes[1]).T @ turns[1])
            mixed = turns[0].T @ turns[1]
            upper += ca.triu(mixed + mixed.T)
    return [ca.sparsify(ca.vertcat(*blocks)), ca.sparsify(ca.triu2symm(upper))]


@dataclass(frozen=True)
class EquilibriumEquations:
    """The symbolic equations of static equilibrium. Torques and springs hold the driven joints."""

    # (unknowns: free coordinates, internal ones, forces of constraints), known coordinates (driven, then prescribed),
    # held torque, holding spring's stiffness, theta, time step
    inputs: list[ca.SX]
    residual: ca.SX  # balance of the free coordinates [N m], internal equations, constraints [m]
    state: ca.SX  # (q, p, z) at rest, (nx, 1)


def equilibrium_equations(e: DiscreteEquations) -> EquilibriumEquations:
    """Build the equations of static equilibrium: a step from a configuration to itself with unchanged momentum."""
    system, h, nu = e.system, e.h, e.u.numel()
    free, fixed = list(system.unprescribed_coordinate_indices), list(system.prescribed_coordinate_indices)
    driven = list(system.actuated_coordinate_indices)
    given, sought = ca.SX.sym("given", nu + len(fixed)), ca.SX.sym("sought", len(free))
    z, force = ca.SX.sym("z", e.z0.numel()), ca.SX.sym("force", e.lam.numel())
    held, stiffness = ca.SX.sym("held", nu), ca.SX.sym("stiffness")
    q = ca.SX(ca.DM.zeros(system.n_coordinates))
    q[[*fixed, *free]] = ca.vertcat(given[nu:, 0], sought)
    u = held + stiffness * (given[:nu] - q[driven]) if nu else held
    old, now = [e.q0, e.q1, e.z0, e.z1, e.lam, e.u], [q, q, z, z, h * force, u]
    rows = ca.substitute([e.p1, e.momentum_balance, e.internal_residual_at_rest, e.constraint_residual], old, now)
    p, balance, internal, constraint = (ca.densify(x) for x in rows)
    balance = ca.substitute(balance, e.p0, p) / h
    if system.servos:  # a spring holds a joint whose motor is off until the motion begins
        hand = ca.if_else(held >= MOTOR_OFF_COMMAND / 2, RIGID_HOLD_STIFFNESS, 0) * (given[:nu] - q[driven])
        balance[driven] += hand
        p[driven] += h / 2 * hand
    inputs = [ca.vertcat(sought, z, force), given, held, stiffness, e.theta, e.time_step]
    residual = ca.vertcat(balance[free, 0], internal, constraint)
    return EquilibriumEquations(inputs, residual, ca.densify(ca.vertcat(q, p, z)))


@dataclass(frozen=True, eq=False)
class OneStepNlpEqualities:
    """The symbolic equality constraints of one step in a nonlinear program (NLP), with their Jacobians.

    `residual_jacobians` and `effort_jacobians` are the sparse derivatives of `residual` (nr, 1) and `prescribed_effort`
    (nc, 1) with respect to `x0`, `x1`, `lam` and `u`.
    """

    equations: DiscreteEquations
    time_step: float  # [s]
    x0: ca.SX  # state (q, p, z), (nx, 1)
    x1: ca.SX
    lam: ca.SX
    u: ca.SX
    theta: ca.SX
    residual: ca.SX  # zero if the step equations hold
    residual_names: tuple[str, ...]  # row names: `del[JOINT]`, `internal[NAME]`, `constraint[GRASP.x]`, `p1[JOINT]`
    residual_jacobians: dict[str, ca.SX]
    prescribed_effort: ca.SX  # effort of the prescribed coordinates at the first node [N m]
    effort_jacobians: dict[str, ca.SX]

    def residual_and_effort_jacobians_by_parameters(self, names: Sequence[str]) -> tuple[ca.SX, ca.SX]:
        """Compute derivatives of `residual` and `prescribed_effort` with respect to parameters, (..., len(names))."""
        chosen = ca.vertcat(ca.SX(0, 1), *(self.equations.system.parameters[name].symbol for name in names))
        return ca.jacobian(self.residual, chosen), ca.jacobian(self.prescribed_effort, chosen)


def one_step_nlp_constraints(equations: DiscreteEquations, time_step: float) -> OneStepNlpEqualities:
    """Build the equality constraints of one time step [s] for a nonlinear program, with their Jacobians.

    The state is x = (q, p, z), and p1 is the momentum after the step. The constraint rows are scaled to order one:

        free rows of the momentum balance / h   internal equations   constraints   (p_{k+1} - p1(q_k, q_{k+1})) / h

    The rows do not depend on recordings: torques, prescribed coordinates and parameters may be data or unknowns. The
    bodies' second derivatives have a closed form (`LagrangianFirstDerivatives`) with a quarter of the operations of
    automatic differentiation. All other derivatives come from automatic differentiation.
    """
    e, h, system = equations, time_step, equations.system
    free, fixed = list(system.unprescribed_coordinate_indices), list(system.prescribed_coordinate_indices)
    p1 = ca.SX.sym("p1", e.p0.numel())
    x0, x1 = ca.vertcat(e.q0, e.p0, e.z0), ca.vertcat(e.q1, p1, e.z1)
    names = [f"del[{system.mechanism.joint_names[i]}]" for i in free]
    names += [f"internal[{name}]" for name in system.effect_internal_coordinate_symbols]
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
    return OneStepNlpEqualities(e, h, x0, x1, e.lam, e.u, e.theta, dense[0], tuple(names), by[0], dense[1], by[1])


def _slopes(e: DiscreteEquations) -> tuple[dict[str, ca.SX], dict[str, ca.SX]]:
    """Derivatives of `momentum_balance` and of `p1` with respect to the step's symbols. The key `none` holds zeros.

    With L the bodies' Lagrangian at the midpoint and a = -1 in the balance, +1 in p1, the term h/2 L_q + a L_v has the
    derivative h/4 L_qq + b/2 L_qv + a (1/2 L_vq + b/h L_vv) with respect to q_k (b = -1) and q_{k+1} (b = 1).
    """
    n, h, scale, pulls = e.q0.numel(), e.h, e.row_scale, e.constraint_impulses
    rigid = e.rigid_body_terms
    L_qq, L_qv, L_vv = lagrangian_second_derivatives(rigid, e.system.mechanism)
    bent = pulls.midpoint_share * pulls.middle_force_by_q / 2
    curves = {
        -1: {"q0": pulls.start_share * pulls.before_force_by_q + bent, "q1": bent},
        1: {"q0": bent, "q1": bent - pulls.midpoint_share * pulls.after_force_by_q},
    }
    impulses = e.force_with_derivatives_impulses or (ca.SX(n, 1), ca.SX(n, 1))
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
