"""Structural sparsity of a step's matrices and of the KKT matrix of the NLP."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
import scipy.sparse
from scipy.sparse.csgraph import maximum_bipartite_matching

from yid_ocp.analysis.step_symbols import StepSymbols
from yid_ocp.arrays import Array, BoolArray
from yid_ocp.sensors import Sensor, sensor_reading_function

_ZERO_RTOL = 1e-14  # of the largest entry: rounding


@dataclass(frozen=True)
class NamedIndexRange:
    """A named range of row or column indices."""

    name: str
    start: int
    stop: int


@dataclass(frozen=True)
class SparsityPattern:
    """Structural nonzeros of a matrix, with names of its blocks, rows and columns.

    Attributes
    ----------
    name, title : str
        For files, and for people.
    nonzero_mask : ndarray of bool, shape (r, c)
    row_blocks, column_blocks : tuple of NamedIndexRange
        Blocks, in order and without gaps.
    marked_mask : ndarray of bool, shape (r, c), or None
        Entries that are highlighted; `mark_label` is their meaning.
    """

    name: str
    title: str
    nonzero_mask: BoolArray
    row_blocks: tuple[NamedIndexRange, ...]
    column_blocks: tuple[NamedIndexRange, ...]
    row_labels: tuple[str, ...]
    column_labels: tuple[str, ...]
    marked_mask: BoolArray | None = None
    mark_label: str = ""

    def with_numerical_nonzeros_marked(self, values: Array, where: str) -> SparsityPattern:
        """The pattern with the numerically nonzero entries of one matrix highlighted."""
        marked = np.abs(values) > _ZERO_RTOL * np.max(np.abs(values), initial=0.0)
        return replace(self, marked_mask=marked, mark_label=f"not zero at {where}")

    @property
    def n_nonzeros(self) -> int:
        """Number of structurally nonzero entries."""
        return int(np.count_nonzero(self.nonzero_mask))


_Block = tuple[str, tuple[str, ...]]
"""Name of a block and labels of its entries."""


def _pattern(
    name: str, title: str, mask: BoolArray, rows: Sequence[_Block], columns: Sequence[_Block]
) -> SparsityPattern:
    def named(blocks: Sequence[_Block]) -> tuple[tuple[NamedIndexRange, ...], tuple[str, ...]]:
        spans, at = [], 0
        for block, own in blocks:
            spans.append(NamedIndexRange(block, at, at := at + len(own)))
        return tuple(spans), tuple(label for _, own in blocks for label in own)

    (row_spans, row_labels), (column_spans, column_labels) = named(rows), named(columns)
    return SparsityPattern(name, title, mask, row_spans, column_spans, row_labels, column_labels)


def _blocks(symbols: StepSymbols, *wanted: str, kept: Sequence[int] | None = None) -> list[_Block]:
    """Blocks of a step by name, only the kept entries of the first one."""
    blocks = {block.name: block.labels for block in (*symbols.row_blocks, *symbols.column_blocks)}
    found = [(name, blocks[name]) for name in wanted]
    if kept is not None:
        found[0] = wanted[0], tuple(found[0][1][i] for i in kept)
    return found


# -- one step ---------------------------------------------------------------------------------------------------------


def step_sparsity_patterns(symbols: StepSymbols) -> dict[str, SparsityPattern]:
    """Structural sparsity patterns of one step's matrices, by name.

    `dR_dy`, residual by unknowns; `A` = dx_{k+1}/dx_k, `B_u` and `B_theta` by the implicit function theorem;
    `dR_dtheta`, all rows by the parameters.
    """
    whole = _mask(symbols.jacobian_sparsity_pattern)
    system = symbols.equations.system
    free = list(system.unprescribed_coordinate_indices)
    joints = system.mechanism.joint_names

    def block(row: str, column: str) -> BoolArray:
        return whole[symbols.block_slice(row), symbols.block_slice(column)]

    def by(*columns: str) -> BoolArray:
        """Residual's rows by columns."""
        parts = [np.hstack([block(row, column) for column in columns]) for row in ("del", "internal", "constraint")]
        return np.vstack([parts[0][free], *parts[1:]])

    by_new = by("q1", "z1", "lam")
    nc = len(joints)
    known = np.setdiff1d(np.arange(by_new.shape[1]), system.prescribed_coordinate_indices)
    by_unknown = by_new[:, known]
    inverse = _inverse_sparsity(by_unknown)

    def response(*columns: str) -> BoolArray:
        """The state after the step by columns."""
        y = _times(inverse, by(*columns))
        full = np.zeros((by_new.shape[1], y.shape[1]), bool)
        full[known] = y
        direct = np.hstack([block("p1", column) for column in columns])
        p1 = direct | _times(np.hstack([block("p1", c) for c in ("q1", "z1", "lam")]), full)
        nz = len(system.internal_coordinates)
        return np.vstack([full[:nc], p1, full[nc : nc + nz]])

    unknowns = _blocks(symbols, "q1", "z1", "lam", kept=free)
    residual = _blocks(symbols, "del", "internal", "constraint", kept=free)
    before, after = _blocks(symbols, "q0", "p0", "z0"), _blocks(symbols, "q1", "p1", "z1")
    every = [(block.name, block.labels) for block in symbols.row_blocks]
    torque, theta = _blocks(symbols, "u"), _blocks(symbols, "theta")
    by_theta = whole[:, symbols.block_slice("theta")]
    found = (
        _pattern("dR_dy", "residual of a step by its unknowns", by_unknown, residual, unknowns),
        _pattern("A", "A: state after a step by the state before it", response("q0", "p0", "z0"), after, before),
        _pattern("B_u", "B_u: state after a step by torques", response("u"), after, torque),
        _pattern("B_theta", "B_theta: state after a step by parameters", response("theta"), after, theta),
        _pattern("dR_dtheta", "dR/dtheta: equations by parameters", by_theta, every, theta),
    )
    return {pattern.name: pattern for pattern in found}


def _inverse_sparsity(mask: BoolArray) -> BoolArray:
    """Structural nonzeros of a matrix's inverse from those of the matrix.

    With rows put in the order of a perfect matching the diagonal is full, and entry (i, j) of the inverse can differ
    from zero where a path leads from i to j in the matrix's graph; all can where there is no perfect matching.
    """
    count = len(mask)
    matched = maximum_bipartite_matching(scipy.sparse.csr_matrix(mask), perm_type="row")
    if count == 0 or np.any(matched < 0):
        return np.ones((count, count), bool)
    reach = mask[matched]
    for _ in range(int(np.ceil(np.log2(max(count, 2))))):
        reach = _times(reach, reach)
    result = np.zeros_like(mask)
    result[:, matched] = reach
    return result


def _times(a: BoolArray, b: BoolArray) -> BoolArray:
    product: BoolArray = (a.astype(np.float32) @ b.astype(np.float32)) > 0
    return product


def _mask(pattern: ca.Sparsity) -> BoolArray:
    mask = np.zeros(pattern.shape, bool)
    row, column = pattern.get_triplet()
    mask[row, column] = True
    return mask


# -- the NLP ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _NlpStage:
    """Sparsity of one stage of the NLP, the same for all; the start depends on all free parameters."""

    constraint_mask: BoolArray  # one step's constraints by (theta_free, x_k, x_{k+1}, lam_k)
    hessian_mask: BoolArray  # of these constraints times their multipliers
    gauss_newton_mask: BoolArray  # of the priors and of one reading of every sensor, by (theta_free, x_k)
    constraint_blocks: Sequence[_Block]
    state_blocks: Sequence[_Block]
    multiplier_labels: tuple[str, ...]
    free: tuple[str, ...]
    fixed_start_rows: Sequence[int]  # of the first node's state, that the start fixes
    estimated_start_rows: Sequence[int]  # that have a prior about it

    @property
    def sizes(self) -> tuple[int, int, int, int]:
        """Numbers of free parameters, states, multipliers and constraints of a step."""
        f, m, height = len(self.free), len(self.multiplier_labels), len(self.constraint_mask)
        return f, len(self.gauss_newton_mask) - f, m, height


def nlp_stage_sparsity(
    symbols: StepSymbols,
    free: Sequence[str],
    sensors: Sequence[Sensor],
    followed: Sequence[int],
    loose: Sequence[int],
) -> _NlpStage:
    """Sparsity of one stage of the NLP with a node at every step, in the order of `solvers.transcription`.

    The parameters `free` are unknowns, `sensors` read nodes, the tracking filter feeds the rows `followed` of the state
    back to the torques, and the rows `loose` of the first node's state are estimated, with a prior; the start fixes the
    others that are not prescribed.
    """
    e, system = symbols.equations, symbols.equations.system
    kept = list(system.unprescribed_coordinate_indices)
    rows = ca.vertcat(e.residual, e.p1)
    chosen = ca.vertcat(*(system.parameters[name].symbol for name in free)) if free else ca.SX(0, 1)
    local = ca.vertcat(chosen, e.q0, e.p0, e.z0, e.q1, e.z1, e.lam, e.u)
    weights = ca.SX.sym("weights", rows.numel())
    by_local = _mask(ca.jacobian_sparsity(rows, local))
    curved = _mask(ca.jacobian_sparsity(ca.gradient(ca.dot(weights, rows), local), local))
    f, n, nz, m, nu = len(free), system.n_coordinates, e.z0.numel(), e.lam.numel(), e.u.numel()
    nx = 2 * n + nz
    # where each local variable stands in the stage; torques are not unknowns, under the filter they follow the state
    places = [*range(f + nx), *range(f + nx, f + nx + n), *range(f + nx + 2 * n, f + 2 * nx + m)]
    placing = np.zeros((local.numel(), f + 2 * nx + m), bool)
    placing[np.arange(len(places)), places] = True
    placing[np.ix_(np.arange(len(places), len(places) + nu), f + np.array(followed, int))] = True
    by_stage = _times(by_local, placing)
    hessian = _times(_times(placing.T, curved), placing)
    # the constraint on the momentum after the step holds that momentum itself
    at = rows.numel() - n
    by_stage[at + np.arange(n), f + nx + n + np.arange(n)] = True
    measured = np.zeros((f + nx, f + nx), bool)
    measured[np.arange(f), np.arange(f)] = True  # priors
    for sensor in sensors:
        function = sensor_reading_function(system, sensor, tuple(free))
        by_q, by_z, by_theta = (_mask(function.sparsity_out(f"by_{name}")) for name in ("q", "z", "theta"))
        reading = np.hstack([by_theta, by_q, np.zeros((len(by_q), n), bool), by_z])
        measured |= _times(reading.T, reading)
    rows_blocks = _blocks(symbols, "del", "internal", "constraint", "p1", kept=kept)
    state, labels = _blocks(symbols, "q0", "p0", "z0"), _blocks(symbols, "lam")[0][1]
    fixed = np.setdiff1d(np.arange(nx), [*system.prescribed_coordinate_indices, *loose]).tolist()
    return _NlpStage(by_stage, hessian, measured, rows_blocks, state, labels, tuple(free), fixed, loose)


def full_nlp_size(stage: _NlpStage, steps: Sequence[int]) -> dict[str, int]:
    """Size of the NLP with a node at every step, of several recordings, whose numbers of steps are given.

    `jacobian_nonzeros` counts those of the constraints, `hessian_nonzeros` both triangles of the exact Hessian of the
    steps' constraints times their multipliers; what measurements add to it is not counted, and the start is linear in
    the parameters, as multiple shooting takes it.
    """
    (f, nx, m, height), begun = stage.sizes, len(stage.fixed_start_rows)
    # every step after the first adds the same entries
    one, two = (int(np.count_nonzero(_nlp_sparsity_masks(stage, k)[1])) for k in (1, 2))
    shared, each = int(np.count_nonzero(stage.hessian_mask[:f, :f])), int(np.count_nonzero(stage.constraint_mask))
    return {
        "variables": f + sum((k + 1) * nx + k * m for k in steps),
        "constraints": sum(begun + k * height for k in steps),
        "jacobian_nonzeros": sum(begun * (1 + f) + k * each for k in steps),
        "hessian_nonzeros": shared + sum(one - shared + (k - 1) * (two - one) for k in steps),
    }


def _nlp_sparsity_masks(stage: _NlpStage, steps: int) -> tuple[BoolArray, BoolArray, BoolArray]:
    """Sparsity masks of one recording's constraint Jacobian, constraint Hessian and measurement Hessian."""
    (f, nx, m, height), fixed = stage.sizes, stage.fixed_start_rows
    width = f + (steps + 1) * nx + steps * m
    jacobian = np.zeros((len(fixed) + steps * height, width), bool)
    hessian, measured = np.zeros((width, width), bool), np.zeros((width, width), bool)
    jacobian[np.arange(len(fixed)), f + np.array(fixed, int)] = True
    jacobian[: len(fixed), :f] = True
    if len(stage.estimated_start_rows):
        begun = np.concatenate([np.arange(f), f + np.array(stage.estimated_start_rows)])
        measured[np.ix_(begun, begun)] = True
    for k in range(steps + 1):
        # x_0, lam_0, x_1, lam_1, ...
        node = f + k * (nx + m)
        here = np.concatenate([np.arange(f), node + np.arange(nx)])
        measured[np.ix_(here, here)] |= stage.gauss_newton_mask
        if k == steps:
            break
        columns = np.concatenate([here, node + nx + m + np.arange(nx), node + nx + np.arange(m)])
        top = len(fixed) + k * height
        jacobian[np.ix_(np.arange(top, top + height), columns)] |= stage.constraint_mask
        hessian[np.ix_(columns, columns)] |= stage.hessian_mask
    return jacobian, hessian, measured


def kkt_sparsity_pattern(stage: _NlpStage, steps: int) -> SparsityPattern:
    """The KKT matrix [[H, J'], [J, 0]] of the first steps of a recording, as if every node were measured."""
    jacobian, hessian, measured = _nlp_sparsity_masks(stage, steps)
    blank = np.zeros((len(jacobian), len(jacobian)), bool)
    mask = np.vstack([np.hstack([hessian | measured, jacobian.T]), np.hstack([jacobian, blank])])
    blocks = [("theta", stage.free)]
    for k in range(steps + 1):
        blocks += [(f"{name[0]}{k}", labels) for name, labels in stage.state_blocks]
        blocks += [(f"lam{k}", stage.multiplier_labels)] if k < steps else []
    state = [label for _, labels in stage.state_blocks for label in labels]
    blocks.append(("start", tuple(state[i] for i in stage.fixed_start_rows)))
    for k in range(steps):
        blocks += [(f"p{k + 1} rule" if n == "p1" else f"{n}{k}", labels) for n, labels in stage.constraint_blocks]
    blocks = [block for block in blocks if block[1]]
    marked = np.zeros_like(mask)
    marked[: len(measured), : len(measured)] = measured
    title = f"KKT matrix of the NLP with a node at every step: the first {steps} steps"
    found = _pattern("kkt", title, mask, blocks, blocks)
    return replace(found, marked_mask=marked, mark_label="of a reading or a prior, where there is one")
