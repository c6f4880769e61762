"""Torque laws: smooth functions of known quantities, for torques that no kind of effect describes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import casadi as ca
import numpy as np
import scipy.interpolate

from yid_ocp.arrays import Array
from yid_ocp.effects import base
from yid_ocp.errors import ConfigError, DataError, unknown_name_error_arguments
from yid_ocp.files import read_input_text
from yid_ocp.model.kinematics import forward_kinematics
from yid_ocp.model.parameters import Parameter, Parameters
from yid_ocp.model.servos_and_springs import MOTOR_OFF_COMMAND
from yid_ocp.model.system import EffectStepTerms, MidpointStateSymbols, System

TorqueLawQuantitiesName = Literal["angle", "speed", "angle+speed", "load", "command", "time"]
"""Quantities on which a law's torque depends: one, or two. The torque is a sum of one function of each."""
TORQUE_LAW_QUANTITY_UNITS = {"angle": "rad", "speed": "rad/s", "load": "N m", "command": "N m", "time": "s"}
"""Unit of each quantity on which a law may depend, for revolute joints."""
_TABLE_COLUMNS = ("quantity", "unit", "at", "torque", "std")
_SPACING_RTOL = 1e-3  # relative tolerance on equal spacing of knots in a file


@dataclass(frozen=True)
class TorqueLawTable:
    """A table of torque against one quantity, with values and standard deviations at equally spaced knots (k,).

    A natural cubic spline interpolates the values. Beyond the knots the torque is constant.
    """

    quantity: str  # one of `TORQUE_LAW_QUANTITY_UNITS`
    knots: Array
    torque: Array  # [N m]
    torque_std: Array  # [N m]; NaN where it is not known

    def interpolated_torque(self, x: Array) -> Array:
        """Interpolate the torque (m,) [N m] at the values `x` of the quantity."""
        spline = scipy.interpolate.CubicSpline(self.knots, self.torque, bc_type="natural")
        return np.asarray(spline(np.clip(x, self.knots[0], self.knots[-1])), float)


@dataclass(frozen=True)
class TorqueLaw(base.EffectBase):
    """A torque that is a smooth function F = f(x), on an arm joint or on every joint that bends a segment.

    x is the joint's own angle, speed, load or command, or the time since the start of the recording (an internal
    coordinate s with ds/dt = 1). f is a natural cubic spline whose parameters are its values at equally spaced knots,
    and constant beyond the knots; for two quantities it is a sum of two splines. In a segment, angle and speed are
    those of its typical joint at the same curvature, so that a linear law acts like another stiffness or damping. The
    command is the torque that the servo requests, after saturation; for a DC motor it is the torque of the duty cycle
    without back-EMF. A law of the command is zero while the motor is off. Load and command exist at arm joints only.
    """

    knots: Mapping[str, Array] | None = None  # knots of every quantity

    equation = "F = f(x)"
    required_excitation = "the angle"

    @property
    def quantities(self) -> tuple[str, ...]:
        """The quantities on which the torque depends."""
        return tuple(self.knots or ())

    def restricted_to_quantities(self, quantities: Sequence[str]) -> TorqueLaw:
        """Return a copy of the law for only the given quantities, without the parameters of other quantities."""
        kept = {name: own for name, own in (self.knots or {}).items() if name in quantities}
        definitions = [d for d in self.definitions if d.name.rstrip("0123456789") in kept]
        entries = Parameters(self.parameters[f"{self.label}.{d.name}"] for d in definitions)
        return replace(self, parameters=entries, definitions=tuple(definitions), knots=kept)

    def knot_parameter_names(self, quantity: str) -> tuple[str, ...]:
        """Return the names of the parameters at the knots of one quantity."""
        return tuple(f"{self.label}.{quantity}{k}" for k in range(len((self.knots or {})[quantity])))

    def step_terms(self, state: MidpointStateSymbols) -> EffectStepTerms:
        force = ca.SX(state.system.n_coordinates, 1)
        for index, factor in _coordinate_indices_and_factors(state.system, self.location).items():
            for quantity in self.quantities:
                scale = 1.0 if quantity == "time" else factor
                torque = self._torque(quantity, scale * _quantity(quantity, state, self.label, index))
                if quantity == "command":
                    torque = ca.if_else(_servo_input(state, index) < MOTOR_OFF_COMMAND / 2, torque, 0)
                force[index] += torque
        equations, at_rest = {}, {}
        for name in self.internal_coordinate_symbols:
            row = state.internal_rows[name]
            equations[name], at_rest[name] = state.h * (state.z_rate[row] - 1), state.z[row]
        return EffectStepTerms(generalized_force=force, internal_equations=equations, static_equations=at_rest)

    def _torque(self, quantity: str, x: ca.SX) -> ca.SX:
        """f(x) by truncated powers: a constant, a line, and a cube that begins at each knot."""
        knots = (self.knots or {})[quantity]
        values = ca.vertcat(*(self.parameters[name].symbol for name in self.knot_parameter_names(quantity)))
        first, slope, *cubes = ca.vertsplit(ca.SX(ca.DM(_truncated_power_weights(len(knots)))) @ values)
        place = ca.fmin(ca.fmax((x - knots[0]) / (knots[1] - knots[0]), 0), len(knots) - 1)
        # a comparison has no derivative, that of a maximum needs a division
        return first + slope * place + sum(cube * (place > k) * (place - k) ** 3 for k, cube in enumerate(cubes))


def _truncated_power_weights(count: int) -> Array:
    """Weights (count + 1, count) of 1, x and max(x - k, 0)^3 for the natural spline through values at x = 0, 1, ..."""
    x = np.arange(count, dtype=float)
    powers = np.column_stack([np.ones(count), x, np.maximum(x[:, None] - x[:-1], 0) ** 3])
    return np.asarray(np.linalg.inv(np.vstack([powers, np.concatenate([[0, 0], x[-1] - x[:-1]])]))[:, :count], float)


def _coordinate_indices_and_factors(system: System, location: str) -> dict[int, float]:
    """The coordinates on which a law at a location acts, each with its stiffness over that of the typical joint."""
    index = system.mechanism.joint_index
    if location not in base.flexible_segment_names(system):
        return {index(location): 1.0}
    stiffness = base.nominal_bend_stiffness_by_joint_of_segment(system, location)
    typical = float(np.median([*stiffness.values()])) if stiffness else 0.0
    return {index(joint): own / typical if typical > 0 else 1.0 for joint, own in stiffness.items()}


def _servo_input(state: MidpointStateSymbols, index: int) -> ca.SX:
    return state.u[state.system.actuated_coordinate_indices.index(index)]


def _quantity(quantity: str, state: MidpointStateSymbols, label: str, index: int) -> ca.SX:
    system = state.system
    if quantity == "time":
        return state.z[state.internal_rows[f"{label}.time"]]
    if quantity == "angle":
        return state.q[index]
    if quantity == "speed":
        return state.v[index]
    if quantity == "command":
        u, servo = _servo_input(state, index), system.servos[system.mechanism.joints[index].name]
        drag = servo.damping * state.v[index] if servo.motor_kind == "dc" else 0
        return ca.if_else(u < MOTOR_OFF_COMMAND / 2, servo.torque(u, state.q[index], state.v[index]) + drag, 0)
    return system.friction_load_of_gear(state, index)


def allowed_torque_law_quantity_names(system: System, location: str) -> tuple[str, ...]:
    """Return the quantities on which a law at a location may depend. Empty if no law is possible.

    `load` needs a driven joint, `command` a servo.
    """
    if location in base.flexible_segment_names(system):
        return ("angle", "speed", "time")
    if location not in base.arm_joint_names(system):
        return ()
    driven = ("load",) if location in system.driven else ()
    return ("angle", "speed", *driven, *(("command",) if location in system.servos else ()), "time")


def torque_law_quantity_at_midpoints(
    system: System, location: str, quantity: str, theta: Array, nodes: Mapping[str, Array]
) -> Array:
    """Compute `quantity` (N, joints), such as speed or load, at the midpoints of the N steps of a rollout.

    Columns are the joints of `location`. A command is NaN while the motor is off. `nodes` holds `state` (N + 1, nx),
    `torque` (N, nu), the constraint `multipliers` (N, m) and the `time_step` [s] as an array.
    """
    n, h = system.n_coordinates, float(nodes["time_step"])
    if quantity == "time":
        return np.asarray((np.arange(len(nodes["state"]) - 1) + 0.5)[:, None] * h, float)
    factors, q = _coordinate_indices_and_factors(system, location), nodes["state"][:, :n]
    at, scale = [*factors], np.array([*factors.values()])
    if quantity == "speed":
        return np.asarray(scale * np.diff(q[:, at], axis=0) / h, float)
    if quantity == "angle":
        return np.asarray(scale * (q[1:, at] + q[:-1, at]) / 2, float)
    internal = system.effect_internal_coordinate_symbols
    sizes = {"q": n, "v": n, "z": len(internal), "u": len(system.driven), "lam": system.n_constraints}
    symbols = {name: ca.SX.sym(name, size) for name, size in sizes.items()}
    midpoint, v, z, u, lam = symbols.values()
    kinematics = forward_kinematics(system.mechanism, midpoint)
    rows = {name: i for i, name in enumerate(internal)}
    state = MidpointStateSymbols(system, kinematics, midpoint, v, z, z, u, lam, rows, ca.SX(h))
    wanted = ca.vertcat(*(_quantity(quantity, state, "", index) for index in at))
    wanted = ca.substitute(wanted, ca.vertcat(*internal.values()), z) if internal else wanted
    function = ca.Function("quantity", [*symbols.values(), system.parameters.symbols], [wanted])
    before = nodes["state"][:-1, 2 * n :]
    inputs = ((q[1:] + q[:-1]) / 2, np.diff(q, axis=0) / h, before, nodes["torque"], nodes["multipliers"] / h)
    columns = [own.T if own.shape[1] else ca.DM(0, len(own)) for own in inputs]
    values = np.asarray(function.map(len(q) - 1)(*columns, np.tile(theta[:, None], len(q) - 1)), float).T
    if quantity == "command":
        inputs_there = nodes["torque"][:, [system.actuated_coordinate_indices.index(index) for index in at]]
        values[inputs_there >= MOTOR_OFF_COMMAND / 2] = np.nan
    return values


def torque_law_from_tables(
    location: str, system: System, tables: Sequence[TorqueLawTable], torque_scale: float = math.inf
) -> TorqueLaw:
    """Create a torque law at a joint or segment from one table for each quantity on which its torque depends.

    The prior range of knot torques is ±`torque_scale` [N m]. Raises `ConfigError` if the location allows no such law.
    """
    label, possible = f"law@{location}", allowed_torque_law_quantity_names(system, location)
    if not possible:
        places = (*base.flexible_segment_names(system), *base.arm_joint_names(system))
        what, choice = f"a law cannot act at '{location}'", unknown_name_error_arguments(location, places)
        raise ConfigError(what, where=label, **choice)
    definitions, entries = [], []
    for table in tables:
        if table.quantity not in possible:
            allowed, what = ", ".join(possible), f"a law at {location} cannot depend on '{table.quantity}'"
            raise ConfigError(what, where=label, allowed=allowed, hint=f"set depends_on: {possible[0]}")
        for k, (at, torque) in enumerate(zip(table.knots, table.torque, strict=True)):
            said = f"torque at {at:.4g} {TORQUE_LAW_QUANTITY_UNITS[table.quantity]}"
            name, size = f"{table.quantity}{k}", min(torque_scale, 1e6)
            definitions.append(base.ParameterDefinition(name, "N m", 0.0, -math.inf, math.inf, (-size, size), said))
            entries.append(Parameter(f"{label}.{name}", float(torque), "N m", description=said))
    inner = {f"{label}.time": ca.SX.sym(f"{label}.time")} if any(t.quantity == "time" for t in tables) else {}
    knots = {table.quantity: np.asarray(table.knots, float) for table in tables}
    return TorqueLaw("law", location, Parameters(entries), inner, tuple(definitions), (), knots)


def read_torque_law_tables(path: Path, depends_on: TorqueLawQuantitiesName) -> tuple[TorqueLawTable, ...]:
    """Read a law's tables, one for each quantity in `depends_on`, from a CSV file as `torque_law_tables_csv` makes it.

    Raises `DataError` for a malformed file, knots that are not evenly spaced and increasing, or other quantities.
    """
    allowed = f"a header {','.join(_TABLE_COLUMNS)}, then rows of a quantity, its unit and three numbers"
    hint = "correct or delete this line; law.csv in a run folder of `yid-ocp diagnose` is an example"
    lines = [line.split(",") for line in read_input_text(path).splitlines() if line.strip()]
    if not lines or tuple(word.strip() for word in lines[0]) != _TABLE_COLUMNS:
        raise DataError("the header is not that of a torque law", where=f"{path}, line 1", allowed=allowed, hint=hint)
    rows: dict[str, list[list[float]]] = {}
    for number, words in enumerate(lines[1:], 2):
        try:
            quantity, _, *numbers = (word.strip() for word in words)
            rows.setdefault(quantity, []).append([float(word or "nan") for word in numbers])
            if len(numbers) != 3 or not all(map(math.isfinite, rows[quantity][-1][:2])):
                raise ValueError
        except ValueError:
            what = f"in the row '{','.join(words)}', at, torque or std is no number, or a cell is missing"
            raise DataError(what, where=f"{path}, line {number}", allowed=allowed, hint=hint) from None
    wanted = depends_on.split("+")
    if set(rows) != set(wanted):
        what = f"the table has {', '.join(rows) or 'no rows'}, but the law depends on {depends_on}"
        hint = f"set depends_on: {'+'.join(rows) or depends_on}, or give another table"
        raise DataError(what, where=str(path), allowed=f"rows of {', '.join(wanted)}", hint=hint)
    tables = []
    for quantity in wanted:
        knots, torque, std = np.array(rows[quantity]).T
        gaps = np.diff(knots)
        if len(knots) < 4 or np.any(gaps <= 0) or np.ptp(gaps) > _SPACING_RTOL * float(np.mean(gaps)):
            fault = "fewer than 4" if len(knots) < 4 else "not increasing" if np.any(gaps <= 0) else "not evenly spaced"
            what, hint = f"the values `at` of {quantity} are {fault}", "interpolate the table at evenly spaced values"
            raise DataError(what, where=str(path), allowed="four or more evenly spaced, increasing numbers", hint=hint)
        tables.append(TorqueLawTable(quantity, knots, torque, std))
    return tuple(tables)


def torque_law_tables_csv(tables: Sequence[TorqueLawTable]) -> str:
    """Convert the tables of a law to CSV text, which `read_torque_law_tables` reads."""
    lines = [",".join(_TABLE_COLUMNS)]
    for table in tables:
        unit = TORQUE_LAW_QUANTITY_UNITS[table.quantity]
        for at, torque, std in zip(table.knots, table.torque, table.torque_std, strict=True):
            lines.append(f"{table.quantity},{unit},{at:.10g},{torque:.10g},{std:.6g}")
    return "\n".join(lines) + "\n"
