"""Equilibria at which a planned motion begins and ends, with the arms at rest."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from yid_ocp.errors import ConfigError, ModelError, nearest_name_hint
from yid_ocp.integrator.rollout import simulate
from yid_ocp.integrator.statics import Equilibrium, EquilibriumSolver
from yid_ocp.integrator.step import Step
from yid_ocp.model.system import System
from yid_ocp.planning.frame_positions import FramePositions
from yid_ocp.planning.options import PlanLimits

Array = NDArray[np.float64]

_TRAVEL_WEIGHT = (
    1e-2  # weight of a joint's travel [rad] beside the distance to the place in units of what counts as reached
)
_MIN_POINT_MOBILITY = 1e-9  # motion of the point by a joint's, in metres per radian or metre, that counts as none
REACHED_TOLERANCE_FACTOR = 1.5  # of that unit: beyond it a place is out of reach


@dataclass(frozen=True)
class EndEquilibrium:
    """An equilibrium at which the point rests near its target.

    Attributes
    ----------
    joint_positions : ndarray, shape (nc,)
        Moved joints [rad or m].
    equilibrium : Rest
    target_distance : float
        Distance of the point from its target [m].
    joints_at_limit : tuple of str
        Joints that stand at a limit of theirs.
    """

    joint_positions: Array
    equilibrium: Equilibrium
    target_distance: float
    joints_at_limit: tuple[str, ...]


def joint_position_limits(system: System) -> tuple[Array, Array]:
    """Lower and upper limits of the moved joints, shape (nc,) each."""
    joints = [system.mechanism.joints[i] for i in system.prescribed_indices]
    return np.array([joint.lower_limit for joint in joints]), np.array([joint.upper_limit for joint in joints])


def ordered_start_positions(system: System, posture: Mapping[str, float]) -> Array:
    """Start positions of the moved joints, given by name, as an array of shape (nc,).

    Raises
    ------
    ConfigError
        A joint is missing, does not exist, or stands outside its range.
    """
    for name in posture:
        if name not in system.prescribed:
            raise ConfigError(
                f"'{name}' is no joint that moves",
                where="plan.start_joint_positions",
                hint=nearest_name_hint(name, system.prescribed),
            )
    missing = [name for name in system.prescribed if name not in posture]
    if missing:
        raise ConfigError(
            f"the posture says nothing of {', '.join(missing)}",
            where="plan.start_joint_positions",
            allowed="every joint that moves",
            hint="leave plan.start_joint_positions out to begin where the arms first grasp the undeformed object",
        )
    chosen = np.array([float(posture[name]) for name in system.prescribed])
    for name, value, low, high in zip(system.prescribed, chosen, *joint_position_limits(system), strict=True):
        if not low - 1e-9 <= value <= high + 1e-9:
            over = low - value if value < low else value - high
            raise ConfigError(
                f"{name} starts at {value:.4g}, {over:.3g} beyond its limit",
                where="plan.start_joint_positions",
                allowed=f"{low:.4g} to {high:.4g}",
            )
    return chosen


def solve_start_equilibrium(step: Step, theta: Array, posture: Array, guess: Array | None = None) -> Equilibrium:
    """Solve for the equilibrium at which a motion begins, near a configuration where one is given.

    Raises
    ------
    ModelError
        There is none, for example because a grasp cannot be closed.
    """
    rest = EquilibriumSolver(step).solve(posture, theta, guess=guess)
    if not rest.is_converged:
        raise ModelError(
            f"the motion cannot begin: {rest.message}",
            where="plan.start_joint_positions",
            allowed="a posture at which every grasp holds the object at rest",
            hint="give plan.start_joint_positions or a recording, which begins where the object is held; or correct model.grasp",
        )
    return rest


def check_standstill_limits(step: Step, theta: Array, rest: Equilibrium, limits: PlanLimits, when: str) -> None:
    """Raise where efforts or spring angles exceed their limits although the arms stand still.

    Raises
    ------
    ConfigError
        Naming the joint or spring, its value and what is allowed.
    """
    system = step.system
    effort = simulate(step, theta, rest.state, 1).effort[0]
    joints = [system.mechanism.joints[i] for i in system.prescribed_indices]
    springs = sorted({system.mechanism.joint_index(spring.joint_name) for spring in system.elastic_joints})
    largest = np.inf if limits.max_spring_angle is None else limits.max_spring_angle
    rows = [
        *(
            (j.name, "effort", "N m or N", u, limits.effort_fraction * j.effort_limit)
            for j, u in zip(joints, effort, strict=True)
        ),
        *((system.mechanism.joint_names[i], "spring_angle", "rad", rest.state[i], largest) for i in springs),
    ]
    for name, which, unit, value, limit in rows:
        if not abs(value) <= limit * (1 + 1e-9):
            raise ConfigError(
                f"{name} at rest {when} takes {value:.4g} {unit}, {abs(value) - limit:.3g} beyond its limit",
                where=f"plan.limits.{which}",
                allowed=f"up to {limit:.4g} {unit}",
                hint=f"raise plan.limits.{which} where the machine allows it, or take another posture or place",
            )


def solve_end_equilibrium(
    step: Step, theta: Array, start: Equilibrium, point: FramePositions, place: Array, tolerance: float
) -> EndEquilibrium:
    """Solve for joint positions within their limits, near the start, at which the point rests nearest to its target.

    Raises
    ------
    ConfigError
        No joint moves the point.
    """
    statics, system = EquilibriumSolver(step), step.system
    joints, n = list(system.prescribed_indices), system.n_coordinates
    first = start.state[joints]
    guess = [start.state[:n]]
    last: list[tuple[Array, tuple[Array, Array]]] = []

    def at(x: Array) -> tuple[Array, Array]:
        # the search asks for residual and slope of a point one after the other
        if not last or not np.array_equal(last[-1][0], x):
            last[:] = [(np.array(x), rows(x))]
        return last[-1][1]

    def rows(x: Array) -> tuple[Array, Array]:
        rest = statics.solve(x, theta, guess=guess[0])
        if not rest.is_converged:
            return np.full(3 + len(x), 1e3), np.zeros((3 + len(x), len(x)))
        guess[0] = rest.state[:n]
        where, by_q = point.positions_and_jacobian(rest.state[None, :n], theta)
        slope = by_q[0, :3] @ rest.state_by_known_coordinates[:n]
        return (
            np.concatenate([(where[0, :3] - place) / tolerance, _TRAVEL_WEIGHT * (x - first)]),
            np.vstack([slope / tolerance, _TRAVEL_WEIGHT * np.eye(len(x))]),
        )

    moved, reach = (
        start.state_by_known_coordinates[:n],
        point.positions_and_jacobian(start.state[None, :n], theta)[1][0, :3],
    )
    if np.abs(reach @ moved).max(initial=0.0) < _MIN_POINT_MOBILITY:
        raise ConfigError(
            f"no arm moves '{point.names[0]}'",
            where="plan.point",
            allowed="a point of what an arm holds or carries",
            hint="set model.grasp, or name another point",
        )
    lower, upper = joint_position_limits(system)
    begin = np.clip(first, lower + 1e-6, upper - 1e-6)
    found = least_squares(
        lambda x: at(x)[0], begin, jac=lambda x: at(x)[1], bounds=(lower, upper), x_scale=1.0, max_nfev=100
    )
    rest = statics.solve(found.x, theta, guess=guess[0])
    where, _ = point.positions_and_jacobian(rest.state[None, :n], theta)
    distance = float(np.linalg.norm(where[0, :3] - place)) if rest.is_converged else np.inf
    near = (found.x - lower < 1e-3) | (upper - found.x < 1e-3)
    limits = tuple(name for name, one in zip(system.prescribed, near, strict=True) if one)
    return EndEquilibrium(found.x, rest, distance, limits)


def check_target_reachable(end: EndEquilibrium, name: str, place: Array, tolerance: float) -> None:
    """Raise where the point cannot rest at its target.

    Raises
    ------
    ConfigError
        Saying how far off it remains, and which joints stand at their limits.
    """
    if end.target_distance <= REACHED_TOLERANCE_FACTOR * tolerance:
        return
    off = (
        f"{1e3 * end.target_distance:.3g} mm off"
        if np.isfinite(end.target_distance)
        else "nowhere, as no posture near it is at rest"
    )
    limits = f", with {', '.join(end.joints_at_limit)} at the joint's limit" if end.joints_at_limit else ""
    raise ConfigError(
        f"the goal is out of reach: '{name}' comes to rest {off}{limits}",
        where=f"plan.target_position ({', '.join(f'{x:.4g}' for x in place)} m in the world)",
        allowed="a place at which the point can rest",
        hint="take a nearer place, a smaller plan.target_offset, or another plan.start_joint_positions to begin with",
    )
