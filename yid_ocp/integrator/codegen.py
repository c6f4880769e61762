"""Generation of CasADi functions, index tables and C code from symbolic step equations.

Batched kernels, and functions of very many instructions, are written with the SIMD arithmetic of `simd.c`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from yid_ocp.arrays import BoolArray, IntArray
from yid_ocp.integrator.discrete import DiscreteEquations
from yid_ocp.parallel import CASADI_LOCK, CasadiLockedCache

_Indices = NDArray[np.int32]


class StepFunctions:
    """The CasADi functions of one step, all with the inputs `DiscreteEquations.arguments`, and sparsity patterns.

    `function` returns one by its name in `build_casadi_step_functions`, and builds it when it is first used, because a
    cached kernel needs none. If constraint forces act at the node, the outputs that contain the constraint Jacobian at
    the midpoint or at the end of the step are empty.
    """

    def __init__(
        self,
        equations: DiscreteEquations,
        outputs: Mapping[str, Sequence[ca.SX]],
        sparsity_patterns: Mapping[str, ca.Sparsity],
    ) -> None:
        self.equations = equations
        self.sparsity_patterns = sparsity_patterns
        self._outputs = outputs
        self.function = CasadiLockedCache[str, ca.Function](
            lambda name: ca.Function(name, equations.arguments, ca.cse(list(outputs[name])))
        )

    @property
    def all_functions(self) -> tuple[ca.Function, ...]:
        """All CasADi functions of the step, in the order of the generated C code."""
        return tuple(map(self.function, self._outputs))


def build_casadi_step_functions(equations: DiscreteEquations) -> StepFunctions:
    """Build the CasADi functions of a step. The kernel forms the Jacobians of the bodies from vectors per joint."""
    e = equations
    rigid, pulls = e.rigid_body_terms, e.constraint_impulses
    bodies = [e.row_scale * (e.h / 2 * rigid.lagrangian_by_q + sign * rigid.lagrangian_by_v) for sign in (-1, 1)]
    if e.force_with_derivatives_impulses is not None:
        bodies = [part + push for part, push in zip(bodies, e.force_with_derivatives_impulses, strict=True)]
    balance, p1 = e.balance_remainder + e.p0 + bodies[0], e.p1_remainder + bodies[1]
    rest, rest_p, by_unknown = _rest_jacobians(e, *bodies)
    by_z = ca.jacobian(pulls.before_jacobian.T @ e.lam, e.z0)
    pull = ca.sparsify(pulls.start_share * ca.horzcat(pulls.before_force_by_q, by_z))
    moving = [pulls.middle_jacobian, pulls.after_jacobian, pulls.middle_force_by_q / 2, pulls.after_force_by_q]
    by_node = [[ca.jacobian(e.internal_residual_at_rest, x) for x in pair] for pair in ((e.q0, e.q1), (e.z0, e.z1))]
    by_held = [ca.jacobian(e.internal_residual_at_rest, x) for x in (e.lam, e.u)]
    at_rest = ca.sparsify(ca.horzcat(*(first + second for first, second in by_node), *by_held))
    share = pulls.midpoint_share
    middle, after, curve, after_curve = (share * x if share else ca.SX(*x.shape) for x in moving)

    def nonzeros(matrix: ca.SX) -> Any:
        return matrix.nz[:]

    matrices = {"rest": rest, "rest_p": rest_p, "constraint": by_unknown, "matrix": pulls.before_jacobian, "pull": pull}
    matrices |= {"curve": curve, "after_curve": after_curve, "resting": at_rest}
    outputs = {
        # balance and p1 without the constraints' pull; the share of Dphi(q_m)
        "residual": (balance, e.internal_residual, e.constraint_residual, p1, nonzeros(middle)),
        # vectors per joint, other entries of Jacobians, derivative of the midpoint's constraint force by q_k or q_{k+1}
        "linear": (_pairs(e), nonzeros(rest), nonzeros(rest_p), nonzeros(by_unknown), nonzeros(curve)),
        # share of Dphi(q_k) in the balance, which does not depend on the unknowns, and of Dphi(q_{k+1}) in p1
        "matrix": (nonzeros(pulls.start_share * pulls.before_jacobian),),
        "ending": (nonzeros(after),),
        # derivatives of the pull of the first of these two by (q_k, z_k), of the second by q_{k+1}
        "pull": (nonzeros(pull), nonzeros(after_curve)),
        "scales": (e.row_scale, e.h),
        # internal equations with equal nodes, and their derivatives by (q, z, lam, u)
        "resting": (e.internal_residual_at_rest, nonzeros(at_rest)),
    }
    return StepFunctions(e, outputs, {name: matrix.sparsity() for name, matrix in matrices.items()})


def _pairs(e: DiscreteEquations) -> ca.SX:
    """Vectors per joint from which the kernel forms the bodies' part of the Jacobians, joint by joint."""
    h, rigid = e.h, e.rigid_body_terms
    plus, minus = rigid.S + h / 2 * rigid.D, rigid.S - h / 2 * rigid.D
    lower, upper = rigid.B / 2 - rigid.F / h, rigid.B / 2 + rigid.F / h
    parts = [plus, minus, lower, upper, rigid.S[:3, :], h / 4 * rigid.G]
    if e.force_with_derivatives is not None:
        parts += [e.force_with_derivatives.A, h / 2 * e.force_with_derivatives.T]
    return ca.vertcat(*(ca.vec(ca.densify(part).T) for part in parts))


def _rest_jacobians(e: DiscreteEquations, bodies: ca.SX, bodies_p: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Sparse Jacobians without the bodies' part: residual and p1 by (unknowns, old, input), constraints by unknowns."""
    unknown, old = ca.vertcat(e.q1, e.z1, e.lam), ca.vertcat(e.q0, e.z0)
    inputs = ca.vertcat(unknown, old, e.u)
    m, n = e.lam.numel(), e.q0.numel()

    def by_internal(expression: ca.SX) -> ca.SX:
        """Terms besides the closed form: placements and masses may depend on internal coordinates."""
        blocks = [ca.jacobian(expression, z) for z in (e.z1, e.z0)]
        gaps = [ca.SX(expression.numel(), count) for count in (n, m + n, e.u.numel())]
        return ca.horzcat(gaps[0], blocks[0], gaps[1], blocks[1], gaps[2])

    rest = ca.jacobian(ca.vertcat(e.balance_remainder, e.internal_residual, ca.SX(m, 1)), inputs)
    rest += by_internal(ca.vertcat(bodies, ca.SX(e.z0.numel() + m, 1)))
    rest_p = ca.jacobian(e.p1_remainder, inputs) + by_internal(bodies_p)
    by_q1, pulls = e.constraint_impulses.after_jacobian, e.constraint_impulses
    if pulls.midpoint_share:
        # what the curvatures of `StepFunctions` leave out: grasps may depend on internal coordinates
        parts = (pulls.midpoint_share * pulls.middle_jacobian, pulls.right_jacobian)
        middle, right = (-e.row_scale * (part.T @ e.lam) for part in parts)
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
    """Build a CasADi function for the sparse derivatives of a step with respect to the parameters `names`.

    Its outputs are the derivatives of the residual, of p1 and of the prescribed effort.
    """
    e = equations
    chosen = ca.vertcat(*(e.system.parameters[name].symbol for name in names)) if names else ca.SX(0, 1)
    prescribed = list(e.system.prescribed_coordinate_indices)
    rows = ca.vertcat(e.momentum_balance, e.internal_residual, e.constraint_residual)
    effort = -e.momentum_balance[prescribed] / e.h
    outputs = [ca.jacobian(expression, chosen) for expression in (rows, e.p1, effort)]
    return ca.Function("by_theta", e.arguments, ca.cse(outputs))


@dataclass(frozen=True)
class StepSparsityTables:
    """The index tables of a step's sparse Jacobians and of their elimination, which are valid at every state."""

    unknown_rows: _Indices  # full row (balance, internal, constraint) of each unknown (free q1, z1, lam), (ny,)
    elimination_order: _Indices  # internal coordinates, tips before roots, multipliers last, (ny,)
    fill_in: tuple[_Indices, ...]  # for each pivot, the later positions that its row and column fill
    joint_ancestors: tuple[_Indices, ...]
    # for each row of a Jacobian its columns that are not always zero
    residual_old_columns: tuple[_Indices, ...]
    p1_old_columns: tuple[_Indices, ...]
    p1_new_columns: tuple[_Indices, ...]


def step_elimination_tables(functions: StepFunctions) -> StepSparsityTables:
    """Compute the sparsity, elimination order and fill-in of a step's Jacobians."""
    e = functions.equations
    system = e.system
    n, nz, m = system.n_coordinates, e.z0.numel(), e.lam.numel()
    nt, nqz = n + nz + m, n + nz

    def at(key: str) -> tuple[IntArray, IntArray]:
        return rows_and_columns_of_nonzeros(functions.sparsity_patterns[key])

    related = np.zeros((n, n), bool)
    ancestors = tuple(np.array(system.mechanism.ancestor_joint_indices(j), np.int32) for j in range(n))
    for j, chain in enumerate(ancestors):
        related[j, chain] = related[chain, j] = True
    rows_new, rows_old = np.zeros((nt, nt), bool), np.zeros((nt, nqz), bool)
    p1_new, p1_old = np.zeros((n, nt), bool), np.zeros((n, nqz), bool)
    rows_new[:n, :n] = rows_old[:n, :n] = p1_new[:, :n] = p1_old[:, :n] = related
    for key, new, old in (("rest", rows_new, rows_old), ("rest_p", p1_new, p1_old)):
        row, column = at(key)
        inside = column < nt
        new[row[inside], column[inside]] = True
        inside = (column >= nt) & (column < nt + nqz)
        old[row[inside], column[inside] - nt] = True
    row, column = at("constraint")
    rows_new[n + nz + row, column] = True
    row, column = at("matrix")
    rows_new[column, n + nz + row] = True
    if e.constraint_impulses.midpoint_share:
        p1_new[column, n + nz + row] = True
    for matrix in (rows_new, rows_old, p1_new, p1_old):
        matrix[at("curve")] = True
    p1_new[at("after_curve")] = True
    rows_old[at("pull")] = True

    free = np.array(system.unprescribed_coordinate_indices, np.int32)
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

    def columns(matrix: BoolArray) -> tuple[_Indices, ...]:
        return tuple(np.flatnonzero(line).astype(np.int32) for line in matrix)

    varying = (columns(matrix) for matrix in (rows_old, p1_old, p1_new))
    return StepSparsityTables(unknown_row, order, tuple(fill), ancestors, *varying)


def kernel_cache_key_text(functions: StepFunctions, tables: StepSparsityTables) -> str:
    """Return the text that identifies a kernel in the cache: generators, index tables and serialized equations."""
    folder = resources.files("yid_ocp.integrator")
    files = [folder.joinpath(name).read_text(encoding="utf-8") for name in ("codegen.py", "simd.c", "kernel.c")]
    with CASADI_LOCK:
        together = [output for own in functions._outputs.values() for output in own]
        graphs = str(ca.Function("step", functions.equations.arguments, together).serialize())
    return "\0".join([*files, *_kernel_tables(functions, tables), graphs])


def kernel_c_source(functions: StepFunctions, tables: StepSparsityTables, batched: bool = False) -> str | None:
    """Join `simd.c`, CasADi's functions, sizes and tables, and `kernel.c` to the C source of the stepping kernel.

    With `batched`, the kernel integrates `yid_simd_width` rollouts at once; None if a function has no SIMD form.
    """
    made = _simd_c_source(functions.all_functions) if batched else _step_source(functions.all_functions)
    if made is None:
        return None
    sizes = [f"#define {name} {value}" for name, value in _kernel_sizes(functions, tables).items()]
    folder = resources.files("yid_ocp.integrator")
    arithmetic, kernel = (folder.joinpath(name).read_text(encoding="utf-8") for name in ("simd.c", "kernel.c"))
    parts = ["#define BATCHED" if batched else "", arithmetic, made, *sizes, *_kernel_tables(functions, tables), kernel]
    return "\n".join(parts)


def _kernel_sizes(functions: StepFunctions, tables: StepSparsityTables) -> dict[str, float]:
    e, system = functions.equations, functions.equations.system
    n, nz, m, nc = system.n_coordinates, e.z0.numel(), e.lam.numel(), len(system.prescribed)
    left, right = e.force_with_derivatives_shares
    return {
        **{"N": n, "NZ": nz, "M": m, "NU": e.u.numel(), "NC": nc, "NF": n - nc},
        **{"NY": len(tables.elimination_order), "NT": n + nz + m, "NTHETA": e.theta.numel()},
        **{f"NNZ_{key.upper()}": pattern.nnz() for key, pattern in functions.sparsity_patterns.items()},
        "SZ_W": max(f.sz_w() for f in functions.all_functions),
        "SZ_IW": max(f.sz_iw() for f in functions.all_functions),
        "ROW_SCALED": int(bool(system.joint_compliances)),
        "MIDDLE": int(bool(e.constraint_impulses.midpoint_share)),
        **{"CLOSED": int(e.force_with_derivatives is not None), "CLOSED_LEFT": left, "CLOSED_RIGHT": right},
    }


def _kernel_tables(functions: StepFunctions, tables: StepSparsityTables) -> list[str]:
    system = functions.equations.system
    lines: list[str] = []

    def table(name: str, values: Sequence[int] | NDArray[np.integer]) -> None:
        lines.append(f"static const int {name}[] = {{{', '.join(str(int(v)) for v in values) or '0'}}};")

    def ragged(name: str, suffix: str, lists: Sequence[Sequence[int] | _Indices], width: int = 1) -> None:
        table(f"{name}_start", np.concatenate([[0], np.cumsum([len(entries) // width for entries in lists])]))
        table(f"{name}_{suffix}", np.concatenate(lists) if lists else [])

    table("free_index", system.unprescribed_coordinate_indices)
    table("prescribed_index", system.prescribed_coordinate_indices)
    table("unknown_row", tables.unknown_rows)
    table("order", tables.elimination_order)
    ragged("ancestor", "run", [_runs(entries) for entries in tables.joint_ancestors], 2)
    ragged("fill", "run", [_runs(entries) for entries in tables.fill_in], 2)
    ragged("rows_old", "col", tables.residual_old_columns)
    ragged("p1_old", "col", tables.p1_old_columns)
    ragged("p1_new", "col", tables.p1_new_columns)
    for key, pattern in functions.sparsity_patterns.items():
        row, column = rows_and_columns_of_nonzeros(pattern)
        table(f"{key}_row", row)
        table(f"{key}_col", column)
    return lines


def _step_source(functions: Sequence[ca.Function]) -> str:
    """C source of a step's functions: CasADi's own code, except for functions too long for a compiler."""
    long = [function for function in functions if _is_long_function(function)]
    ours = _simd_c_source(long)
    if not long or ours is None:
        return casadi_c_source("step", functions)
    return "\n".join([casadi_c_source("step", [f for f in functions if not _is_long_function(f)]), ours])


def casadi_c_source(name: str, functions: Sequence[ca.Function]) -> str:
    """Generate the C source of CasADi functions, which keep their names. `name` is the name of the generated file."""
    generator = ca.CodeGenerator(name, {"with_header": False, "indent": 0})
    for function in functions:
        generator.add(function)
    return generator.dump()


def rows_and_columns_of_nonzeros(sparsity: ca.Sparsity) -> tuple[IntArray, IntArray]:
    """Return the row and column indices (nnz,) of the structural nonzeros in a sparsity pattern."""
    row, column = sparsity.get_triplet()
    return np.array(row, np.int64), np.array(column, np.int64)


def _runs(entries: _Indices) -> list[int]:
    """First number and last number + 1 of every run of consecutive numbers, in one list."""
    values = np.array(entries, int)
    runs = np.split(values, np.flatnonzero(np.diff(values) != 1) + 1)
    return [bound for run in runs if len(run) for bound in (int(run[0]), int(run[-1]) + 1)]


# libm's functions of one member after another
_UNARY_FUNCTIONS = "exp log tan asin acos atan sinh cosh tanh asinh acosh atanh floor ceil erf log1p expm1"
_BINARY_FUNCTIONS = ("pow", "constpow", "atan2", "fmod", "remainder", "copysign", "hypot")
_ARITHMETIC_SIGNS = {ca.OP_ADD: "+", ca.OP_SUB: "-", ca.OP_MUL: "*", ca.OP_DIV: "/"}
COMPARISON_OPERATOR_SYMBOLS: Mapping[int, str] = {ca.OP_LT: "<", ca.OP_LE: "<=", ca.OP_EQ: "==", ca.OP_NE: "!="}
_OPERATION_FORMS = {
    ca.OP_ASSIGN: "{0}",
    **{op: f"{{0}} {sign} {{1}}" for op, sign in _ARITHMETIC_SIGNS.items()},
    ca.OP_NEG: "-{0}",
    ca.OP_SQ: "{0} * {0}",
    ca.OP_TWICE: "{0} + {0}",
    ca.OP_INV: "1.0 / {0}",
    ca.OP_SQRT: "root({0})",
    ca.OP_FABS: "magnitude({0})",
    ca.OP_SIGN: "sign_of({0})",
    ca.OP_FMIN: "lesser({0}, {1})",
    ca.OP_FMAX: "larger({0}, {1})",
    **{op: f"truth({{0}} {sign} {{1}})" for op, sign in COMPARISON_OPERATOR_SYMBOLS.items()},
    ca.OP_NOT: "truth({0} == 0)",
    ca.OP_AND: "truth(({0} != 0) & ({1} != 0))",
    ca.OP_OR: "truth(({0} != 0) | ({1} != 0))",
    ca.OP_IF_ELSE_ZERO: "choose({0} != 0, {1}, (real)ALL(0.0))",
    **{getattr(ca, f"OP_{name.upper()}"): f"each({name}, {{0}})" for name in _UNARY_FUNCTIONS.split()},
    **{
        getattr(ca, f"OP_{name.upper()}"): f"each_pair({name.removeprefix('const')}, {{0}}, {{1}})"
        for name in _BINARY_FUNCTIONS
    },
}
_SINE_AND_COSINE = {ca.OP_SIN: "sine", ca.OP_COS: "cosine"}
_TRANSLATED_OPERATIONS = {ca.OP_INPUT, ca.OP_OUTPUT, ca.OP_CONST, *_OPERATION_FORMS, *_SINE_AND_COSINE}

_LONG_INSTRUCTION_COUNT = 80_000  # from which on a function is split into parts: compile time grows superlinearly
_PART_INSTRUCTION_COUNT = 300  # with which a step of 151 variables compiles in half the time of 4000 and runs as fast


def _is_long_function(function: ca.Function) -> bool:
    return int(function.n_instructions()) > _LONG_INSTRUCTION_COUNT


def _simd_c_source(functions: Sequence[ca.Function]) -> str | None:
    """SIMD C source of SX functions with CasADi's signatures, in parts; None if an operation has no SIMD form."""
    sources = [_source(function) for function in functions]
    return None if None in sources else "\n".join(source for source in sources if source is not None)


@dataclass(frozen=True)
class ResolvedInstruction:
    """One instruction of a CasADi function."""

    code: int
    inputs: list[int]  # argument and entry, or the instructions whose values it takes
    outputs: list[int]  # the place of CasADi's work vector, or result and entry
    constant: float


def _source(function: ca.Function) -> str | None:
    instructions = resolved_instructions(function)
    if any(instruction.code not in _TRANSLATED_OPERATIONS for instruction in instructions):
        return None
    size = _PART_INSTRUCTION_COUNT if _is_long_function(function) else max(len(instructions), 1)
    needed = [0] * len(instructions)  # the last part that takes its value
    for k, instruction in enumerate(instructions):
        for of in instruction.inputs if instruction.code != ca.OP_INPUT else ():
            needed[of] = k // size
    signature, name = "const real **arg, real **res, long long *iw, real *restrict w, int mem", function.name()
    parts = [_part(instructions, first, size, needed) for first in range(0, max(len(instructions), 1), size)]
    if len(parts) == 1:
        return "\n".join([f"static void {name}({signature}) {{", *parts[0], "}"])
    head = "static __attribute__((noinline)) void"
    written = ["\n".join([f"{head} {name}_{i}({signature}) {{", *lines, "}"]) for i, lines in enumerate(parts)]
    calls = [f"{name}_{i}(arg, res, iw, w, mem);" for i in range(len(parts))]
    return "\n".join([*written, f"static void {name}({signature}) {{", *calls, "}"])


def resolved_instructions(function: ca.Function) -> list[ResolvedInstruction]:
    """Return the instructions of a function of SX expressions, in order, each with the instructions that it uses."""
    held: dict[int, int] = {}  # the instruction whose value stands in a place now
    found = []
    for k in range(function.n_instructions()):
        code, inputs = function.instruction_id(k), function.instruction_input(k)
        outputs = function.instruction_output(k)
        if code not in (ca.OP_INPUT, ca.OP_PARAMETER):
            inputs = [held[place] for place in inputs]
        constant = function.instruction_constant(k) if code == ca.OP_CONST else 0.0
        found.append(ResolvedInstruction(code, inputs, outputs, constant))
        if code != ca.OP_OUTPUT:
            held.update(dict.fromkeys(outputs, k))
    return found


def _part(instructions: Sequence[ResolvedInstruction], first: int, size: int, needed: Sequence[int]) -> list[str]:
    """C lines of some instructions. Values that later parts need are written to the work vector."""
    lines: list[str] = []
    known: dict[int, str] = {}  # values of this part, and those that it has read from the work vector
    turned: dict[int, str] = {}  # sine and cosine of a value are worked out together

    def value(of: int) -> str:
        if of not in known:
            known[of] = f"v{of}"
            lines.append(f"const real v{of} = w[{instructions[of].outputs[0]}];")
        return known[of]

    own = range(first, min(first + size, len(instructions)))
    for k in own:
        told, name = instructions[k], f"v{k}"
        if told.code == ca.OP_OUTPUT:
            lines.append(f"res[{told.outputs[0]}][{told.outputs[1]}] = {value(told.inputs[0])};")
            continue
        if told.code == ca.OP_CONST:
            constant = repr(told.constant).replace("inf", "INFINITY").replace("nan", "NAN")
            lines.append(f"const real {name} = ALL({constant});")
        elif told.code == ca.OP_INPUT:
            lines.append(f"const real {name} = arg[{told.inputs[0]}][{told.inputs[1]}];")
        elif told.code in _SINE_AND_COSINE:
            of, angle = told.inputs[0], value(told.inputs[0])
            if of not in turned:
                turned[of] = f"t{k}"
                lines.append(f"const Turn t{k} = turn({angle});")
            name = f"{turned[of]}.{_SINE_AND_COSINE[told.code]}"
        else:
            operands = [value(of) for of in told.inputs]
            lines.append(f"const real {name} = {_OPERATION_FORMS[told.code].format(*operands)};")
        known[k] = name
    kept = sorted((instructions[k].outputs[0], k) for k in own if needed[k] > first // size)
    return [*lines, *(f"w[{place}] = {known[k]};" for place, k in kept)]
