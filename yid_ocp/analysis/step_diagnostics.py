"""Diagnostics of a step: number of operations, sparsity patterns, observed parameters, and natural frequencies."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
import scipy.sparse
from scipy.sparse.csgraph import maximum_bipartite_matching, shortest_path

from yid_ocp.analysis.step_symbols import NamedStepEquations
from yid_ocp.arrays import Array, BoolArray
from yid_ocp.integrator.discrete import ConstraintForcePlacement, ForceSplit
from yid_ocp.integrator.statics import Equilibrium, EquilibriumSolver
from yid_ocp.integrator.step import Step, compile_step, linearized_rollout_steps, simulate
from yid_ocp.integrator.step_model import Rollout, StepResidualsAndJacobians, TrackingFeedback
from yid_ocp.model.system import System
from yid_ocp.problem.episodes import Episode
from yid_ocp.sensors import sensor_function_with_jacobians


def step_complexity_summary(step: Step) -> dict[str, Any]:
    """Return the number of variables, unknowns, Jacobian nonzeros and operations of a step and of its functions."""
    e, functions = step.equations, step.model.functions.all_functions
    found = [{"name": f.name(), "operations": f.n_instructions(), "nonzeros": f.nnz_out()} for f in functions]
    nonzeros = ca.jacobian_sparsity(e.residual, e.newton_unknowns).nnz()
    counts = {"unknowns": e.newton_unknowns.numel(), "jacobian_nonzeros": nonzeros}
    return {"sizes": step.sizes, **counts, "functions": found}


def step_equation_jacobians_at_state(
    step: Step, state: Array, torque: Array, theta: Array, path: Array
) -> StepResidualsAndJacobians:
    """Compute the step's Jacobians at `state` (nx,), `torque` (nu,) [N m] and prescribed coordinates `path` (nc,)."""
    one = simulate(step, theta, state, 1, torque[None], np.stack([path, path]))
    names = step.system.parameters.names
    return step.kernel.step_residuals_and_jacobians(theta, one.state, one.multipliers, one.torque, names, True)


# A row is observed if a reading changes by more than this fraction of the largest change over all rows: smaller changes
# are rounding errors of the equilibrium (1e-12 rad) and of a hundred steps.
_MIN_RELATIVE_RESPONSE = 1e-7
_RESPONSE_STEPS = 100  # steps in which readings are examined; slower responses take longer than most motions


@dataclass(frozen=True)
class EquationsAndSensorsOfParameter:
    """The step equations that contain one parameter, and the response of the sensors to this parameter."""

    parameter: str
    unit: str
    rows: tuple[str, ...]  # names of rows that contain the parameter in any state
    observable_rows: tuple[str, ...] | None  # those of `rows` that change a reading to first order; None: no sensors
    most_sensitive_sensor: str  # with the largest response to the rows; empty if no sensor responds
    directly_dependent_sensors: tuple[str, ...]  # sensors whose readings contain the parameter
    change_along_recordings: float | None = None  # root of the sum of squared changes of all readings, per unit [stds]


def equations_and_sensors_per_parameter(
    step: Step,
    symbols: NamedStepEquations,
    episode: Episode | None,
    state: Array,
    torque: Array,
    theta: Array,
    path: Array,
) -> tuple[EquationsAndSensorsOfParameter, ...]:
    """Find for each parameter the step equations that contain it, and the sensors that respond to it.

    The equilibrium `state` is disturbed by adding one unit to one equation of one step. The later states follow the
    linear model x_next = (A - B_u K) x, where K is the first gain of the tracking filter. The equation is observed to
    first order if a reading changes within `_RESPONSE_STEPS` steps. `torque` (nu,) and `path` (nc,) hold the system at
    `state`. `episode` provides sensors and tracking filter; without it only equations are listed.
    """
    names, parameters, at = symbols.row_names, step.system.parameters, symbols.row_or_column_block_slice("theta")
    entered: dict[int, list[int]] = {i: [] for i in range(len(parameters))}
    for row, column in zip(*symbols.full_jacobian_sparsity_pattern.get_triplet(), strict=True):
        if at.start <= column < at.stop:
            entered[column - at.start].append(row)
    known = [(p.name, p.unit, tuple(names[r] for r in sorted(entered[i]))) for i, p in enumerate(parameters)]
    if episode is None:
        return tuple(EquationsAndSensorsOfParameter(*entry, None, "", ()) for entry in known)
    sensors = _sensors(step, episode, state, theta)
    one = simulate(step, theta, state, 1, torque[None], np.stack([path, path]))
    steps = min(_RESPONSE_STEPS, episode.grid.steps)
    by_row = _answers(step, theta, one, episode.tracking_feedback, sensors, steps)
    strength = np.max(by_row, axis=0, initial=0.0)
    found = []
    for i, entry in enumerate(known):
        answered = [r for r in sorted(entered[i]) if strength[r] > _MIN_RELATIVE_RESPONSE * np.max(strength)]
        seen, read = tuple(names[r] for r in answered), tuple(s.name for s in sensors if np.any(s.by_theta[:, i]))
        best = sensors[int(np.argmax(np.max(by_row[:, answered], axis=1)))].name if answered else "".join(read[:1])
        found.append(EquationsAndSensorsOfParameter(*entry, seen, best, read))
    return tuple(found)


class _WhitenedSensor(NamedTuple):
    """Derivatives of one sensor's whitened readings at an equilibrium by state, effort and parameters."""

    name: str
    by_state: Array
    by_effort: Array
    by_theta: Array


def _sensors(step: Step, episode: Episode, state: Array, theta: Array) -> list[_WhitenedSensor]:
    system, n, found = step.system, step.system.n_coordinates, []
    at = {"q": state[:n], "z": state[2 * n :], "theta": theta}
    for samples in episode.measurements:
        known = np.where(np.isfinite(samples.std) & samples.positive_weight_mask, samples.std, np.nan)
        if np.any(np.isfinite(known)):
            used = np.any(samples.positive_weight_mask, axis=0)
            std = np.array([np.nanmedian(known[:, k]) if u else np.inf for k, u in enumerate(used)])
            function = sensor_function_with_jacobians(system, samples.sensor, system.parameters.names)
            by = {name: np.array(ca.densify(x)) / std[:, None] for name, x in function(**at).items()}
            by_state = np.hstack([by["by_q"], np.zeros_like(by["by_q"]), by["by_z"]])
            found.append(_WhitenedSensor(samples.sensor.group_name, by_state, by["by_load"], by["by_theta"]))
    return found


def _answers(
    step: Step,
    theta: Array,
    one: Rollout,
    feedback: TrackingFeedback | None,
    sensors: Sequence[_WhitenedSensor],
    steps: int,
) -> Array:
    """Largest whitened response (sensors, rows) to a unit in each row of the first step, linearised about `one`."""
    sizes, known = step.sizes, list(step.system.prescribed_coordinate_indices)
    nt = sizes["n"] + sizes["nz"] + sizes["m"]
    unit = np.eye(nt + sizes["n"])
    none = np.zeros((1, sizes["nu"], 0))
    [(after, forces)] = linearized_rollout_steps(step, theta, one, none, feedback, (unit[:nt], unit[nt:]))
    x, largest = np.zeros((sizes["nx"], len(unit))), np.zeros((len(sensors), len(unit)))
    for k in range(steps + 1):
        moved, effort = np.vstack([x, unit * (k == 0)]), np.zeros((sizes["n"], len(unit)))
        effort[known] = forces[0, : len(known)] @ moved
        for i, sensor in enumerate(sensors):
            read = sensor.by_state @ x + sensor.by_effort @ effort
            largest[i] = np.maximum(largest[i], np.max(np.abs(read), axis=0, initial=0.0))
        x = after[0] @ moved
    return largest


_ZERO_RTOL = 1e-14  # entries below this fraction of the largest one are rounding


class NamedIndexRange(NamedTuple):
    """A named block of matrix rows or columns, from index `start` to `stop` (exclusive)."""

    name: str
    start: int
    stop: int


@dataclass(frozen=True)
class SparsityPattern:
    """The possible nonzero entries of a matrix, with named blocks, rows and columns."""

    name: str  # used in file names; `title` is for display
    title: str
    nonzero_mask: BoolArray  # shape (r, c)
    row_blocks: tuple[NamedIndexRange, ...]  # in order and without gaps, like `column_blocks`
    column_blocks: tuple[NamedIndexRange, ...]
    row_labels: tuple[str, ...]
    column_labels: tuple[str, ...]
    marked_mask: BoolArray | None = None  # entries that are highlighted, shape (r, c)
    mark_label: str = ""  # meaning of the highlight

    def with_numerical_nonzeros_marked(self, values: Array, where: str) -> SparsityPattern:
        """Return the pattern with those entries highlighted at which `values` (r, c), taken at `where`, are nonzero."""
        marked = np.abs(values) > _ZERO_RTOL * np.max(np.abs(values), initial=0.0)
        return replace(self, marked_mask=marked, mark_label=f"not zero at {where}")

    @property
    def n_nonzeros(self) -> int:
        """The number of matrix entries that can be nonzero."""
        return int(np.count_nonzero(self.nonzero_mask))


_Block = tuple[str, tuple[str, ...]]  # name of a block and labels of its entries


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


def _blocks(symbols: NamedStepEquations, *wanted: str, kept: Sequence[int] | None = None) -> list[_Block]:
    blocks = {block.name: block.labels for block in (*symbols.row_blocks, *symbols.column_blocks)}
    found = [(name, blocks[name]) for name in wanted]
    if kept is not None:
        found[0] = wanted[0], tuple(found[0][1][i] for i in kept)
    return found


def step_jacobian_sparsity_patterns(symbols: NamedStepEquations) -> dict[str, SparsityPattern]:
    """Compute the sparsity patterns of the Jacobians of one step, by name.

    `dR_dy` is the Jacobian of the step's residual with respect to its unknowns, `dR_dtheta` that of all rows with
    respect to the parameters. `A` (state), `B_u` (input), `B_theta` (parameters) are Jacobians of the next state.
    """
    whole = ca.DM.ones(symbols.full_jacobian_sparsity_pattern).full() > 0
    system = symbols.equations.system
    free, joints = list(system.unprescribed_coordinate_indices), system.mechanism.joint_names

    def block(row: str, column: str) -> BoolArray:
        return whole[symbols.row_or_column_block_slice(row), symbols.row_or_column_block_slice(column)]

    def by(*columns: str) -> BoolArray:
        """Return the sparsity of the residual's Jacobian with respect to the named columns."""
        parts = [np.hstack([block(row, column) for column in columns]) for row in ("del", "internal", "constraint")]
        return np.vstack([parts[0][free], *parts[1:]])

    by_new, nc = by("q1", "z1", "lam"), len(joints)
    known = np.setdiff1d(np.arange(by_new.shape[1]), system.prescribed_coordinate_indices)
    by_unknown = by_new[:, known]
    inverse = _inverse_sparsity(by_unknown)

    def response(*columns: str) -> BoolArray:
        """Return the sparsity of the next state's Jacobian with respect to the named columns."""
        y = _times(inverse, by(*columns))
        full = np.zeros((by_new.shape[1], y.shape[1]), bool)
        full[known] = y
        direct = np.hstack([block("p1", column) for column in columns])
        p1 = direct | _times(np.hstack([block("p1", c) for c in ("q1", "z1", "lam")]), full)
        return np.vstack([full[:nc], p1, full[nc : nc + len(system.effect_internal_coordinate_symbols)]])

    unknowns = _blocks(symbols, "q1", "z1", "lam", kept=free)
    residual = _blocks(symbols, "del", "internal", "constraint", kept=free)
    before, after = _blocks(symbols, "q0", "p0", "z0"), _blocks(symbols, "q1", "p1", "z1")
    every = [(block.name, block.labels) for block in symbols.row_blocks]
    torque, theta = _blocks(symbols, "u"), _blocks(symbols, "theta")
    by_theta = whole[:, symbols.row_or_column_block_slice("theta")]
    found = (
        _pattern("dR_dy", "dR/dy: derivative of a step's equations by its unknowns", by_unknown, residual, unknowns),
        _pattern("A", "A: derivative of the next state by the state", response("q0", "p0", "z0"), after, before),
        _pattern("B_u", "B_u: derivative of the next state by torques", response("u"), after, torque),
        _pattern("B_theta", "B_theta: derivative of the next state by parameters", response("theta"), after, theta),
        _pattern("dR_dtheta", "dR/dtheta: derivative of the equations by parameters", by_theta, every, theta),
    )
    return {pattern.name: pattern for pattern in found}


def _inverse_sparsity(mask: BoolArray) -> BoolArray:
    """Return where a matrix's inverse can be nonzero: paths in its graph, permuted to a diagonal without zeros."""
    count = len(mask)
    matched = maximum_bipartite_matching(scipy.sparse.csr_matrix(mask), perm_type="row")
    if count == 0 or np.any(matched < 0):
        return np.ones((count, count), bool)
    result = np.zeros_like(mask)
    result[:, matched] = np.isfinite(shortest_path(mask[matched], unweighted=True))
    return result


def _times(a: BoolArray, b: BoolArray) -> BoolArray:
    return np.asarray((a.astype(np.float32) @ b.astype(np.float32)) > 0)


_DAMPING_PARAMETERS = ("damping", "twist_damping")


@dataclass(frozen=True)
class UndampedStepMapFrequencies:
    """The natural frequencies of a system near an equilibrium, as the integrator reproduces them with a fixed robot."""

    frequencies_hz: Array  # without damping, ascending, shape (k,)
    n_unstable_modes: int = 0  # modes that grow although damped: unstable equilibrium, or too long a time step
    message: str = ""  # reason if there are no frequencies


def step_map_natural_frequencies(
    system: System,
    configuration: Mapping[str, float],
    theta: Array,
    time_step: float,
    force_split: ForceSplit = "symmetric",
    constraint_force_at: ConstraintForcePlacement = "midpoint",
    guess: Array | None = None,
) -> UndampedStepMapFrequencies:
    """Compute the natural frequencies that the integrator reproduces near an equilibrium of a system.

    The frequencies follow from the eigenvalues of the linearised step without damping. The driven and prescribed
    coordinates are fixed at `configuration` [rad or m]. The search for the equilibrium starts at `guess` (n,).
    `force_split` and `constraint_force_at` are as in `compile_step`: the midpoint rule lowers a frequency f to
    atan(pi f h)/(pi h), with the time step h, and the force split affects only the growth of modes.
    """
    still = replace(system, driven=(), servos={}, prescribed=(*system.driven, *system.prescribed))
    if not still.unprescribed_coordinate_indices:
        message = "every coordinate is driven or prescribed, so none vibrates"
        return UndampedStepMapFrequencies(np.zeros(0), message=message)
    step = compile_step(still, time_step, force_split, constraint_force_at, use_compiler=False)
    known = np.array([configuration[name] for name in still.prescribed])
    rest = EquilibriumSolver(step).solve(known, theta, guess=guess)
    if not rest.is_converged:
        return UndampedStepMapFrequencies(np.zeros(0), message=rest.message)
    damps = [name.rpartition(".")[2] in _DAMPING_PARAMETERS for name in system.parameters.names]
    without, values = (_eigenvalues(step, rest, known, own) for own in (np.where(damps, 0.0, theta), theta))
    if without is None or values is None:
        said = "a step's equations are singular. Look for redundant grasps or massless links"
        return UndampedStepMapFrequencies(np.zeros(0), message=said)
    angles = np.sort(np.angle(without))
    turning = angles[(angles > 1e-7) & (angles < math.pi - 1e-7)]
    return UndampedStepMapFrequencies(turning / (2 * math.pi * time_step), int(np.sum(np.abs(values) > 1 + 1e-6)))


def _eigenvalues(step: Step, rest: Equilibrium, known: Array, theta: Array) -> Array | None:
    """Return the eigenvalues of A at an equilibrium, without those of the constraints. None if A is not finite."""
    n = step.system.n_coordinates
    q, p, z = rest.state[:n], rest.state[n : 2 * n], rest.state[2 * n :]
    a, _, _ = step.jacobians(q, p, np.zeros(0), theta, (known, known), z, names=())
    if not np.isfinite(a).all():
        return None
    rows = np.add.outer([0, n], step.system.unprescribed_coordinate_indices).ravel()
    values: Array = np.linalg.eigvals(a[np.ix_(rows, rows)])
    return values[np.abs(values) > 0.2]
