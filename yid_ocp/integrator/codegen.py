"""From symbolic step equations to CasADi functions, index tables and generated C."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from yid_ocp.integrator.discrete import DiscreteEquations
from yid_ocp.integrator.simd_codegen import is_long_function, simd_c_source

Indices = NDArray[np.int32]


@dataclass(frozen=True)
class StepFunctions:
    """CasADi functions of one step, all with the arguments of `DiscreteEquations.arguments`.

    Attributes
    ----------
    residual : (balance, internal, constraint, p1, share of Dphi(q_m)), balance and p1 without the constraints' pull
    jacobian_parts : (pair vectors, rest Jacobian, rest Jacobian of p1, constraint Jacobian, curvature), the last four as
        nonzeros; the curvature is the derivative of the midpoint's pull by q_k, which is that by q_{k+1}
    before_constraint_jacobian : share of Dphi(q_k) in the balance, which does not depend on the unknowns
    after_constraint_jacobian : share of Dphi(q_{k+1}) in p1
    constraint_force_derivatives : (derivative of the pull of `before_constraint_jacobian` by (q_k, z_k), that of `after_constraint_jacobian` by q_{k+1})
    row_scale_and_time_step : (row scale, h)
    internal_residual_at_rest : (equations of the internal coordinates at rest, their derivative by (q, z, lam, u), nodes being one)
    sparsity_patterns : sparsity of rest, rest of p1, constraint Jacobian, matrix (also of the other shares of Dphi), pull,
        curvature and that at the end, derivative at rest

    What is at the midpoint and after it is empty where the constraints pull at the node.
    """

    equations: DiscreteEquations
    residual: ca.Function
    jacobian_parts: ca.Function
    before_constraint_jacobian: ca.Function
    after_constraint_jacobian: ca.Function
    constraint_force_derivatives: ca.Function
    row_scale_and_time_step: ca.Function
    internal_residual_at_rest: ca.Function
    sparsity_patterns: dict[str, ca.Sparsity]

    @property
    def all_functions(self) -> tuple[ca.Function, ...]:
        """All functions, in the order of code generation."""
        return (
            self.residual,
            self.jacobian_parts,
            self.before_constraint_jacobian,
            self.after_constraint_jacobian,
            self.constraint_force_derivatives,
            self.row_scale_and_time_step,
            self.internal_residual_at_rest,
        )


def step_functions(equations: DiscreteEquations) -> StepFunctions:
    """The CasADi functions that the stepping kernel calls.

    The bodies' part of the Jacobians comes as vectors per joint, from which the kernel forms the entries pair by pair
    (`RigidBodyDerivatives`), everything else as sparse nonzeros from automatic differentiation.
    """
    e = equations
    bodies = [
        e.row_scale * (e.h / 2 * e.rigid_body_terms.lagrangian_by_q + sign * e.rigid_body_terms.lagrangian_by_v)
        for sign in (-1, 1)
    ]
    if e.closed_form_impulses is not None:
        bodies = [part + push for part, push in zip(bodies, e.closed_form_impulses, strict=True)]
    balance, p1 = e.balance_remainder + e.p0 + bodies[0], e.p1_remainder + bodies[1]
    rest, rest_p, by_unknown = _rest_jacobians(e, *bodies)
    pulls = e.constraint_impulses
    by_z = ca.jacobian(pulls.before_jacobian.T @ e.lam, e.z0)
    pull = ca.sparsify(pulls.start_share * ca.horzcat(pulls.before_force_by_q, by_z))
    moving = [pulls.middle_jacobian, pulls.after_jacobian, pulls.middle_force_by_q / 2, pulls.after_force_by_q]
    by_node = [[ca.jacobian(e.internal_residual_at_rest, x) for x in pair] for pair in ((e.q0, e.q1), (e.z0, e.z1))]
    by_held = [ca.jacobian(e.internal_residual_at_rest, x) for x in (e.lam, e.u)]
    at_rest = ca.sparsify(ca.horzcat(*(first + second for first, second in by_node), *by_held))
    middle, after, curve, after_curve = (
        pulls.midpoint_share * x if pulls.midpoint_share else ca.SX(*x.shape) for x in moving
    )

    def function(name: str, *outputs: ca.SX) -> ca.Function:
        return ca.Function(name, e.arguments, ca.cse(list(outputs)))

    def nonzeros(matrix: ca.SX) -> ca.SX:
        values: ca.SX = matrix.nz[:]
        return values

    return StepFunctions(
        e,
        function("residual", balance, e.internal_residual, e.constraint_residual, p1, nonzeros(middle)),
        function("linear", _pairs(e), nonzeros(rest), nonzeros(rest_p), nonzeros(by_unknown), nonzeros(curve)),
        function("matrix", nonzeros(pulls.start_share * pulls.before_jacobian)),
        function("ending", nonzeros(after)),
        function("pull", nonzeros(pull), nonzeros(after_curve)),
        function("scales", e.row_scale, e.h),
        function("resting", e.internal_residual_at_rest, nonzeros(at_rest)),
        {
            "rest": rest.sparsity(),
            "rest_p": rest_p.sparsity(),
            "constraint": by_unknown.sparsity(),
            "matrix": pulls.before_jacobian.sparsity(),
            "pull": pull.sparsity(),
            "curve": curve.sparsity(),
            "after_curve": after_curve.sparsity(),
            "resting": at_rest.sparsity(),
        },
    )


def _pairs(e: DiscreteEquations) -> ca.SX:
    """Vectors per joint from which the kernel forms the bodies' part of the Jacobians, joint by joint."""
    h, rigid = e.h, e.rigid_body_terms
    plus, minus = rigid.S + h / 2 * rigid.D, rigid.S - h / 2 * rigid.D
    lower, upper = rigid.B / 2 - rigid.F / h, rigid.B / 2 + rigid.F / h
    parts = [plus, minus, lower, upper, rigid.S[:3, :], h / 4 * rigid.G]
    if e.closed_form_force is not None:
        parts += [e.closed_form_force.A, h / 2 * e.closed_form_force.T]
    return ca.vertcat(*(ca.vec(ca.densify(part).T) for part in parts))


def _rest_jacobians(e: DiscreteEquations, bodies: ca.SX, bodies_p: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
    """What the pairs leave out, sparse: of the rows and of p1 by (unknowns, old, input), of the constraint by unknowns.

    `bodies` and `bodies_p` are the bodies' part of the balance and of p1.
    """
    unknown, old = ca.vertcat(e.q1, e.z1, e.lam), ca.vertcat(e.q0, e.z0)
    inputs = ca.vertcat(unknown, old, e.u)
    m, n = e.lam.numel(), e.q0.numel()

    def by_internal(expression: ca.SX) -> ca.SX:
        """What the closed form leaves out: placements and masses may depend on internal coordinates."""
        blocks = [ca.jacobian(expression, z) for z in (e.z1, e.z0)]
        gaps = [ca.SX(expression.numel(), count) for count in (n, m + n, e.u.numel())]
        return ca.horzcat(gaps[0], blocks[0], gaps[1], blocks[1], gaps[2])

    rest = ca.jacobian(ca.vertcat(e.balance_remainder, e.internal_residual, ca.SX(m, 1)), inputs)
    rest += by_internal(ca.vertcat(bodies, ca.SX(e.z0.numel() + m, 1)))
    rest_p = ca.jacobian(e.p1_remainder, inputs) + by_internal(bodies_p)
    by_q1, pulls = e.constraint_impulses.after_jacobian, e.constraint_impulses
    if pulls.midpoint_share:
        # what the curvatures of `StepFunctions` leave out: grasps may depend on internal coordinates
        middle, right = (
            -e.row_scale * (part.T @ e.lam)
            for part in (pulls.midpoint_share * pulls.middle_jacobian, pulls.right_jacobian)
        )
        rest += by_internal(ca.vertcat(middle, ca.SX(e.z0.numel() + m, 1)))
        rest_p += by_internal(right)
    if e.constraint_relaxation_gain is not None:
        # the rows of a relaxing grasp depend on where it was before as well
        by_q1 = e.constraint_relaxation_gain * by_q1
        at = unknown.numel()
        rest[-m:, at : at + n] = (1 - e.constraint_relaxation_gain) * pulls.before_jacobian
        rest[-m:, at + n : at + old.numel()] = ca.jacobian(e.constraint_residual, e.z0)
    by_rest = ca.jacobian(e.constraint_residual, ca.vertcat(e.z1, e.lam))
    return ca.sparsify(rest), ca.sparsify(rest_p), ca.sparsify(ca.horzcat(by_q1, by_rest))


def parameter_jacobian_function(equations: DiscreteEquations, names: Sequence[str]) -> ca.Function:
    """CasADi function of the sparse derivatives of (residual, p1, prescribed effort) by the named parameters."""
    e = equations
    chosen = ca.vertcat(*(e.system.parameters[name].symbol for name in names)) if names else ca.SX(0, 1)
    prescribed = list(e.system.prescribed_indices)
    rows = ca.vertcat(e.momentum_balance, e.internal_residual, e.constraint_residual)
    effort = -e.momentum_balance[prescribed] / e.h
    outputs = [ca.jacobian(expression, chosen) for expression in (rows, e.p1, effort)]
    return ca.Function("by_theta", e.arguments, ca.cse(outputs))


@dataclass(frozen=True)
class StepIndexTables:
    """Sparsity, elimination order and fill-in of a step's Jacobians, the same at every state.

    Attributes
    ----------
    unknown_rows : (ny,)
        Full row (balance, internal, constraint) of each unknown (free q1, z1, lam).
    elimination_order : (ny,)
        Elimination order: internal coordinates, tips before roots, multipliers last.
    fill_in : list of (k,) arrays
        For each pivot, the later positions that its row and column fill.
    """

    unknown_rows: Indices
    elimination_order: Indices
    fill_in: tuple[Indices, ...]
    joint_ancestors: tuple[Indices, ...]
    residual_old_columns: tuple[Indices, ...]
    p1_old_columns: tuple[Indices, ...]
    p1_new_columns: tuple[Indices, ...]


def step_index_tables(functions: StepFunctions) -> StepIndexTables:
    """The index tables of a step: sparsity, elimination order and fill-in."""
    e = functions.equations
    system = e.system
    n, nz, m = system.n_coordinates, e.z0.numel(), e.lam.numel()
    nt, nqz = n + nz + m, n + nz
    related = np.zeros((n, n), bool)
    ancestors = tuple(np.array(system.mechanism.ancestor_joints(j), np.int32) for j in range(n))
    for j, chain in enumerate(ancestors):
        related[j, chain] = related[chain, j] = True
    rows_new, rows_old = np.zeros((nt, nt), bool), np.zeros((nt, nqz), bool)
    p1_new, p1_old = np.zeros((n, nt), bool), np.zeros((n, nqz), bool)
    rows_new[:n, :n] = rows_old[:n, :n] = p1_new[:, :n] = p1_old[:, :n] = related
    for key, new, old in (("rest", rows_new, rows_old), ("rest_p", p1_new, p1_old)):
        row, column = nonzero_indices(functions.sparsity_patterns[key])
        inside = column < nt
        new[row[inside], column[inside]] = True
        inside = (column >= nt) & (column < nt + nqz)
        old[row[inside], column[inside] - nt] = True
    row, column = nonzero_indices(functions.sparsity_patterns["constraint"])
    rows_new[n + nz + row, column] = True
    row, column = nonzero_indices(functions.sparsity_patterns["matrix"])
    rows_new[column, n + nz + row] = True
    if e.constraint_impulses.midpoint_share:
        p1_new[column, n + nz + row] = True
    row, column = nonzero_indices(functions.sparsity_patterns["curve"])
    for matrix in (rows_new, rows_old, p1_new, p1_old):
        matrix[row, column] = True
    row, column = nonzero_indices(functions.sparsity_patterns["after_curve"])
    p1_new[row, column] = True
    row, column = nonzero_indices(functions.sparsity_patterns["pull"])
    rows_old[row, column] = True

    free = np.array(system.free_indices, np.int32)
    unknown_row = np.concatenate([free, np.arange(n, nt, dtype=np.int32)]).astype(np.int32)
    nf = len(free)
    order = np.concatenate([np.arange(nf, nf + nz), np.arange(nf)[::-1], np.arange(nf + nz, nf + nz + m)])
    order = order.astype(np.int32)
    pattern = rows_new[np.ix_(unknown_row[order], unknown_row[order])]
    pattern = pattern | pattern.T
    fill = []
    for k in range(len(order)):
        later = np.flatnonzero(pattern[k, k + 1 :]) + k + 1
        pattern[np.ix_(later, later)] = True
        fill.append(later.astype(np.int32))

    def columns(matrix: NDArray[np.bool_]) -> tuple[Indices, ...]:
        return tuple(np.flatnonzero(line).astype(np.int32) for line in matrix)

    return StepIndexTables(
        unknown_row, order, tuple(fill), ancestors, columns(rows_old), columns(p1_old), columns(p1_new)
    )


def kernel_source(functions: StepFunctions, tables: StepIndexTables, batched: bool = False) -> str | None:
    """C source of the stepping kernel: `simd.c`, CasADi's functions, sizes, tables, then `kernel.c`.

    Parameters
    ----------
    functions : StepFunctions
    tables : Structure
    batched : bool
        Whether the code handles several rollouts at once, as many as `yid_lanes` returns; None where a function has
        no SIMD form.
    """
    e = functions.equations
    system = e.system
    n, nz, m = system.n_coordinates, e.z0.numel(), e.lam.numel()
    patterns = functions.sparsity_patterns
    sizes = {
        "N": n,
        "NZ": nz,
        "M": m,
        "NU": e.u.numel(),
        "NC": len(system.prescribed),
        "NF": n - len(system.prescribed),
        "NY": len(tables.elimination_order),
        "NT": n + nz + m,
        "NTHETA": e.theta.numel(),
        "NNZ_REST": patterns["rest"].nnz(),
        "NNZ_REST_P": patterns["rest_p"].nnz(),
        "NNZ_CONSTRAINT": patterns["constraint"].nnz(),
        "NNZ_MATRIX": patterns["matrix"].nnz(),
        "NNZ_PULL": patterns["pull"].nnz(),
        "NNZ_CURVE": patterns["curve"].nnz(),
        "NNZ_AFTER_CURVE": patterns["after_curve"].nnz(),
        "NNZ_RESTING": patterns["resting"].nnz(),
        "SZ_W": max(f.sz_w() for f in functions.all_functions),
        "SZ_IW": max(f.sz_iw() for f in functions.all_functions),
        "ROW_SCALED": int(bool(system.joint_compliances)),
        "MIDDLE": int(bool(e.constraint_impulses.midpoint_share)),
        "CLOSED": int(e.closed_form_force is not None),
        "CLOSED_LEFT": e.closed_form_force_shares[0],
        "CLOSED_RIGHT": e.closed_form_force_shares[1],
    }
    lines = [f"#define {name} {value}" for name, value in sizes.items()]

    def table(name: str, values: Sequence[int] | NDArray[np.integer]) -> None:
        entries = ", ".join(str(int(v)) for v in values) or "0"
        lines.append(f"static const int {name}[] = {{{entries}}};")

    def runs(name: str, lists: Sequence[Indices], gap: int) -> None:
        starts, flat = [0], []
        for entries in lists:
            for first, last in _runs(entries, gap):
                flat += [first, last]
            starts.append(len(flat) // 2)
        table(f"{name}_start", starts)
        table(f"{name}_run", flat)

    def ragged(name: str, lists: Sequence[Indices]) -> None:
        table(f"{name}_start", np.concatenate([[0], np.cumsum([len(entries) for entries in lists])]))
        table(f"{name}_col", np.concatenate(lists) if lists else [])

    table("free_index", system.free_indices)
    table("prescribed_index", system.prescribed_indices)
    table("unknown_row", tables.unknown_rows)
    table("order", tables.elimination_order)
    runs("ancestor", tables.joint_ancestors, 0)
    runs("fill", tables.fill_in, 0)
    ragged("rows_old", tables.residual_old_columns)
    ragged("p1_old", tables.p1_old_columns)
    ragged("p1_new", tables.p1_new_columns)
    for key in ("rest", "rest_p", "constraint", "matrix", "pull", "curve", "after_curve", "resting"):
        row, column = nonzero_indices(patterns[key])
        table(f"{key}_row", row)
        table(f"{key}_col", column)
    made = simd_c_source(functions.all_functions) if batched else _step_source(functions.all_functions)
    if made is None:
        return None
    arithmetic, kernel = (
        resources.files("yid_ocp.integrator").joinpath(name).read_text(encoding="utf-8")
        for name in ("simd.c", "kernel.c")
    )
    return "\n".join(["#define BATCHED" if batched else "", arithmetic, made, *lines, kernel])


def _step_source(functions: Sequence[ca.Function]) -> str:
    """C source of a step's functions: CasADi's own, but for long ones, which no compiler takes whole."""
    long = [function for function in functions if is_long_function(function)]
    ours = simd_c_source(long)
    if not long or ours is None:
        return casadi_c_source("step", functions)
    short = [function for function in functions if not is_long_function(function)]
    return "\n".join([casadi_c_source("step", short), ours])


def casadi_c_source(name: str, functions: Sequence[ca.Function]) -> str:
    """C source that CasADi generates for functions; they keep their names."""
    generator = ca.CodeGenerator(name, {"with_header": False, "indent": 0})
    for function in functions:
        generator.add(function)
    return generator.dump()


def nonzero_indices(sparsity: ca.Sparsity) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Row and column indices of the structural nonzeros of a sparsity pattern."""
    row, column = sparsity.get_triplet()
    return np.array(row, np.int64), np.array(column, np.int64)


def _runs(entries: Indices, gap: int) -> list[tuple[int, int]]:
    result: list[tuple[int, int]] = []
    for value in map(int, entries):
        if result and value <= result[-1][1] + gap:
            result[-1] = (result[-1][0], value + 1)
        else:
            result.append((value, value + 1))
    return result
