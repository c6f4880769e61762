"""Diagnostics of a compiled step: sizes, linearisation against differences, what each parameter enters and moves."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from yid_ocp.analysis.step_symbols import StepSymbols
from yid_ocp.arrays import Array
from yid_ocp.integrator.step import Step
from yid_ocp.integrator.step_model import StepEquationLinearizations
from yid_ocp.model.system import System
from yid_ocp.problem.episodes import Episode
from yid_ocp.sensors import sensor_reading_function

# balances Newton's tolerance against the third derivative, for angles and stiffnesses of order one
_DIFFERENCE_STEP = 1e-5


@dataclass(frozen=True)
class CheckedStepLinearisation:
    """A_k (nx, nx), B_k (nx, nu) and (nx, ntheta) at a state (q, p, z), with their deviation from finite differences.

    Attributes
    ----------
    spectral_radius : float
        Largest absolute eigenvalue of A.
    finite_difference_errors : dict of str to float
        Largest difference from central finite differences, as a fraction of the matrix's largest entry.
    """

    state: Array
    a: Array
    b_input: Array
    b_theta: Array
    spectral_radius: float
    finite_difference_errors: dict[str, float]


def step_size_summary(step: Step) -> dict[str, Any]:
    """Sizes of a step's vectors, number of unknowns, nonzeros of d(residual)/d(unknowns), operations of its functions.

    `unknowns` are the free coordinates, internal coordinates and multipliers that Newton's iteration solves for.
    """
    e, found = step.equations, []
    for f in step.functions.all_functions:
        nonzeros = sum(f.nnz_out(i) for i in range(f.n_out()))
        found.append({"name": f.name(), "operations": f.n_instructions(), "nonzeros": nonzeros})
    nonzeros = ca.jacobian_sparsity(e.residual, e.unknowns).nnz()
    counts = {"unknowns": e.unknowns.numel(), "jacobian_nonzeros": nonzeros}
    return {"sizes": step.sizes, **counts, "functions": found}


def linearise_and_check(step: Step, state: Array, torque: Array, theta: Array, path: Array) -> CheckedStepLinearisation:
    """Linearise a step at a state (nx,) (A_k, B_k) and compare it with central finite differences.

    The torque (nu,) is in N m; `path` (nc,) are the prescribed coordinates, before and after the step.
    """
    n, pair = step.sizes["n"], (path, path) if len(path) else None
    a, b_input, b_theta = step.jacobians(state[:n], state[n : 2 * n], torque, theta, pair, state[2 * n :])

    def after(x: Array, u: Array, values: Array) -> Array:
        q1, p1, _, status = step(x[:n], x[n : 2 * n], u, values, pair, x[2 * n :])
        return np.concatenate([q1, p1, status.internal_coordinates])

    by_state = _differences(lambda v: after(v, torque, theta), state)
    # prescribed coordinates come from the path, so the finite difference does not see them as part of the state
    keep = np.setdiff1d(np.arange(len(state)), step.system.prescribed_coordinate_indices)
    errors = {
        "A": _error(a[:, keep], by_state[:, keep]),
        "B_u": _error(b_input, _differences(lambda v: after(state, v, theta), torque)),
        "B_theta": _error(b_theta, _differences(lambda v: after(state, torque, v), theta)),
    }
    radius = float(np.max(np.abs(np.linalg.eigvals(a)), initial=0.0))
    return CheckedStepLinearisation(state, a, b_input, b_theta, radius, errors)


def linearise_step_equations(
    step: Step, state: Array, torque: Array, theta: Array, path: Array
) -> StepEquationLinearizations:
    """Linearised equations of the step that starts at a state (nx,), with derivatives by all parameters.

    The torque (nu,) is in N m; `path` (nc,) are the prescribed coordinates, before and after the step.
    """
    n = step.sizes["n"]
    q1, p1, lam, status = step(state[:n], state[n : 2 * n], torque, theta, (path, path), state[2 * n :])
    pair = np.stack([state, np.concatenate([q1, p1, status.internal_coordinates])])
    return step.kernel.linearize(theta, pair, lam[None, :], torque[None, :], step.system.parameters.names, True)


def system_with_numeric_parameters(system: System, theta: Array) -> System:
    """The system with numeric parameter values in place of symbols, internal coordinates at zero."""
    inner = ca.vertcat(*system.internal_coordinates.values()) if system.internal_coordinates else ca.SX(0, 1)
    symbols = ca.vertcat(system.parameters.symbols, inner)
    values = np.concatenate([theta, np.zeros(inner.numel())])

    def number(expression: ca.SX) -> ca.SX:
        return ca.SX(ca.densify(ca.Function("number", [symbols], [expression])(values)))

    return system.map_expressions(number)


def _differences(function: Callable[[Array], Array], at: Array) -> Array:
    columns = []
    for i in range(len(at)):
        width = _DIFFERENCE_STEP * max(1.0, abs(at[i]))
        up, down = at.copy(), at.copy()
        up[i] += width
        down[i] -= width
        columns.append((function(up) - function(down)) / (2 * width))
    return np.stack(columns, axis=1) if columns else np.zeros((len(function(at)), 0))


def _error(exact: Array, difference: Array) -> float:
    largest = float(np.max(np.abs(exact), initial=0.0))
    return float(np.max(np.abs(exact - difference), initial=0.0)) / largest if largest > 0 else 0.0


# A row counts as seen where readings answer to it by more than this part of what they answer to the row seen best:
# below is what a rest found to 1e-12 rad and a hundred steps of rounding leave.
_MIN_RELATIVE_RESPONSE = 1e-7
# Steps over which readings are looked at; what is not seen within them takes longer than most motions.
_RESPONSE_STEPS = 100
_NEGLIGIBLE_STDS = 1e-6  # standard deviations: beneath are the tolerance of a rest and what hundred steps make of it
_MAX_LISTED_ROWS = 8  # rows that are named one by one


@dataclass(frozen=True)
class ParameterEquationDependence:
    """The equations of a step that one parameter enters, and how strongly sensors respond to it.

    `rows` contain it whatever the state; `seen` are those of them to which a sensor responds to first order, None
    without sensors, and `best` is the sensor that responds most; the readings of the sensors `read` depend on it
    directly. `moved` is the largest change of a reading within `seconds` per unit of the parameter, starting at the
    equilibrium, `along` that of all readings of the recordings (root of the sum of squares) [standard deviations].
    """

    parameter: str
    unit: str
    rows: tuple[str, ...]
    seen: tuple[str, ...] | None
    best: str
    read: tuple[str, ...]
    moved: float | None
    seconds: float
    along: float | None = None

    @property
    def words(self) -> str:
        """Sentences on the equation rows, then on the change of readings from rest and along the recordings."""
        said = f"{self.parameter} enters {self._rows}"
        if self.read:
            said += f"; the reading of {', '.join(self.read)} depends on it directly"
        more = "1 more of it" if self.unit == "1" else f"one {self.unit} more of it"
        within = f"within {self.seconds:.2g} s"
        if self.moved is not None and self.moved > _NEGLIGIBLE_STDS:
            said += f". From rest, {more} moves readings by at most {self.moved:.2g} standard deviations {within}"
        elif self.moved is not None:
            said += f". From rest, {more} moves no reading by a millionth of its standard deviation {within}"
        if self.along is not None:
            moves = f"moves all readings together by {self.along:.2g} standard deviations"
            said += f". Along the recordings, {more} {moves}, to first order"
        return said + "."

    @property
    def _rows(self) -> str:
        if not self.rows:
            return "no row of a step"
        one, listed = len(self.rows) == 1, _summarize_rows(self.rows)
        said = f"{len(self.rows)} row{'' if one else 's'} ({listed})"
        if self.seen is None:
            return said
        best = f", {self.best} best" if self.best else ""
        if not self.seen:
            return f"{said}, {'which no sensor' if one else 'none of which a sensor'} sees to first order"
        if len(self.seen) == len(self.rows):
            return f"{said}, {'which' if one else 'all of which'} sensors see to first order{best}"
        return f"{said}, {len(self.seen)} of which sensors see to first order ({_summarize_rows(self.seen)}){best}"


def parameter_dependences(
    step: Step,
    symbols: StepSymbols,
    episode: Episode | None,
    state: Array,
    theta: Array,
    stages: StepEquationLinearizations,
) -> tuple[ParameterEquationDependence, ...]:
    """Dependence of the step equations and of a recording's sensors on every parameter, about a state (nx,).

    A unit is added to one row of one step that starts at `state`; with A - B_u K the steps after it are linear, K the
    tracking filter's first gain. The row is seen to first order where a reading answers within `_RESPONSE_STEPS` steps.
    The episode provides the sensors and the tracking filter; without one only rows are listed.
    """
    names, parameters = symbols.row_names, step.system.parameters
    span = symbols.block_slice("theta")
    entered: dict[int, list[int]] = {i: [] for i in range(len(parameters))}
    for row, column in zip(*symbols.jacobian_sparsity_pattern.get_triplet(), strict=True):
        if span.start <= column < span.stop:
            entered[column - span.start].append(row)
    if episode is None:
        return tuple(
            ParameterEquationDependence(
                p.name, p.unit, tuple(names[r] for r in sorted(entered[i])), None, "", (), None, 0.0
            )
            for i, p in enumerate(parameters)
        )
    sizes = step.sizes
    gain = np.zeros((sizes["nu"], sizes["nx"]))
    if episode.tracking_feedback is not None:
        gain[:, episode.tracking_feedback.state_indices] = episode.tracking_feedback.gain[0]
    sensors = _sensors(step, episode, state, theta)
    steps = min(_RESPONSE_STEPS, episode.grid.steps)
    pushed = np.vstack([stages.residual_by_theta[0], stages.p1_by_theta[0]])
    by_row = _answers(step, stages, gain, np.eye(len(names)), sensors, steps, False)
    by_theta = _answers(step, stages, gain, pushed, sensors, steps, True)
    strength = np.max(by_row, axis=0, initial=0.0)
    found = []
    for i, p in enumerate(parameters):
        rows = sorted(entered[i])
        answered = [r for r in rows if strength[r] > _MIN_RELATIVE_RESPONSE * np.max(strength)]
        best = sensors[int(np.argmax(np.max(by_row[:, answered], axis=1)))].name if answered else ""
        read = tuple(s.name for s in sensors if np.any(s.by_theta[:, i]))
        moved = float(np.max(by_theta[:, i], initial=0.0))
        seen, entered_rows = (tuple(names[r] for r in chosen) for chosen in (answered, rows))
        found.append(
            ParameterEquationDependence(p.name, p.unit, entered_rows, seen, best, read, moved, steps * step.time_step)
        )
    return tuple(found)


def _summarize_rows(names: Sequence[str]) -> str:
    """Row names joined to a text; more than eight are counted by kind."""
    if len(names) <= _MAX_LISTED_ROWS:
        return ", ".join(names)
    kinds = [name.partition("[")[0] for name in names]
    return ", ".join(f"{kinds.count(kind)} of {kind}" for kind in dict.fromkeys(kinds))


@dataclass(frozen=True)
class _WhitenedSensor:
    """One sensor at the rest, whitened: derivatives of its readings by state, effort and parameters."""

    name: str
    by_state: Array
    by_effort: Array
    by_theta: Array


def _sensors(step: Step, episode: Episode, state: Array, theta: Array) -> list[_WhitenedSensor]:
    system, n, found = step.system, step.system.n_coordinates, []
    at = {"q": state[:n], "z": state[2 * n :], "theta": theta}
    for samples in episode.measurements:
        known = np.where(np.isfinite(samples.std) & samples.used_output_mask, samples.std, np.nan)
        if np.any(np.isfinite(known)):
            used = np.any(samples.used_output_mask, axis=0)
            std = np.array([np.nanmedian(known[:, k]) if u else np.inf for k, u in enumerate(used)])
            function = sensor_reading_function(system, samples.sensor, system.parameters.names)
            by = {name: np.array(ca.densify(x)) / std[:, None] for name, x in function(**at).items()}
            by_state = np.hstack([by["by_q"], np.zeros_like(by["by_q"]), by["by_z"]])
            found.append(_WhitenedSensor(samples.sensor.group_name, by_state, by["by_load"], by["by_theta"]))
    return found


def _answers(
    step: Step,
    stages: StepEquationLinearizations,
    gain: Array,
    push: Array,
    sensors: Sequence[_WhitenedSensor],
    steps: int,
    held: bool,
) -> Array:
    """Largest whitened answer of every sensor to pushes on rows, of one step or `held`, shape (len(sensors), c)."""
    sizes, h = step.sizes, step.time_step
    n, nz, width = sizes["n"], sizes["nz"], push.shape[1]
    nt = n + nz + sizes["m"]
    known = list(step.system.prescribed_coordinate_indices)
    solved = np.setdiff1d(np.arange(nt), known)
    new, p_new = stages.residual_by_new[0], stages.p1_by_new[0]
    inverse = np.linalg.inv(new[np.ix_(solved, solved)])
    identity = np.vstack([np.eye(n), np.zeros((nt - n, n))])
    old = np.hstack([stages.residual_by_old[0][:, :n], identity, stages.residual_by_old[0][:, n:]])
    p_old = np.hstack([stages.p1_by_old[0][:, :n], np.zeros((n, n)), stages.p1_by_old[0][:, n:]])
    old, p_old = old - stages.residual_by_input[0] @ gain, p_old - stages.p1_by_input[0] @ gain
    x, largest = np.zeros((sizes["nx"], width)), np.zeros((len(sensors), width))
    for k in range(steps + 1):
        added = push if held or k == 0 else np.zeros_like(push)
        y, effort = np.zeros((nt, width)), np.zeros((n, width))
        y[solved] = -inverse @ (old @ x + added[:nt])[solved]
        effort[known] = -(new @ y + old @ x + added[:nt])[known] / h
        for i, sensor in enumerate(sensors):
            read = sensor.by_state @ x + sensor.by_effort @ effort + (sensor.by_theta if held else 0.0)
            largest[i] = np.maximum(largest[i], np.max(np.abs(read), axis=0, initial=0.0))
        momentum = p_new @ y + p_old @ x + added[nt:]
        x = np.vstack([y[:n], momentum, y[n : n + nz]])
    return largest
