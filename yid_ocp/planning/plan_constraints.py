"""Goal of a planned motion as residuals, and its limits as bounded rows, with Jacobians."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from yid_ocp.integrator.step_model import Rollout
from yid_ocp.planning.frame_positions import FramePositions
from yid_ocp.planning.options import PlanOptions
from yid_ocp.planning.path_simulator import PathSimulator

Array = NDArray[np.float64]

_LIMIT_NODE_STRIDE = 2  # nodes between those at which limits on what moves freely are asked for
_QUASI_STATIC_DISTANCE = (
    1.0  # root mean square distance of the joints from the quasi-static motion that counts as one [rad or m]
)
_ACCELERATION_WEIGHT = (
    1e-3  # weight of the accelerations' mean square, in parts of their limit: of equal motions the calmer one
)


@dataclass(frozen=True)
class ValueWithJacobian:
    """A vector and its Jacobian by the spline coefficients.

    Attributes
    ----------
    value : ndarray, shape (nr,)
    jacobian : ndarray, shape (nr, nw), or None
    """

    value: Array
    jacobian: Array | None


@dataclass(frozen=True, eq=False)
class LimitRows:
    """Bounds, scales and names of limit rows of one kind.

    Attributes
    ----------
    description : str
        Limited quantity, with its unit.
    lower, upper : ndarray, shape (rows,)
    unit : ndarray, shape (rows,)
        Divisor that scales each row to order one.
    row_names : tuple of str
        Joint, spring or frame of each row.
    """

    description: str
    lower: Array
    upper: Array
    unit: Array
    row_names: tuple[str, ...]


def stack_values(parts: list[ValueWithJacobian]) -> ValueWithJacobian:
    """Vectors and Jacobians stacked one below the other."""
    slopes = [part.jacobian for part in parts]
    known = [slope for slope in slopes if slope is not None]
    value = np.concatenate([part.value for part in parts]) if parts else np.zeros(0)
    return ValueWithJacobian(value, np.vstack(known) if len(known) == len(slopes) and known else None)


class PlanResidualsAndLimits:
    """Residuals and limit rows of a planned motion, for one set of parameters.

    Parameters
    ----------
    simulator : Mover
    options : PlanOptions
    point : Points
        Of the frame that is to arrive, and of all frames that are to rest.
    target : ndarray, shape (3,)
        Where it is to arrive [m].
    quasi_static_coefficients : ndarray, shape (K, nc)
        Unknowns of the quasi-static motion; of motions that do equally well, the one nearest to it is wanted.
    inside : Points, optional
        Frames that stay in the box.
    """

    def __init__(
        self,
        mover: PathSimulator,
        options: PlanOptions,
        point: FramePositions,
        target: Array,
        simple: Array,
        inside: FramePositions | None = None,
    ) -> None:
        self.simulator, self.options, self.point, self.target, self.inside = mover, options, point, target, inside
        self.quasi_static_coefficients = simple
        self.joints = [mover.step.system.mechanism.joints[i] for i in mover.joint_indices]
        self.effort_limit = options.limits.effort_fraction * np.array([joint.effort_limit for joint in self.joints])
        self._springs = sorted(
            {mover.step.system.mechanism.joint_index(spring.joint_name) for spring in mover.step.system.elastic_joints}
        )
        self.limit_rows = self._bounded()

    # -- what is wanted -----------------------------------------------------------------------------------------------

    @property
    def reference_path(self) -> Array | None:
        """Reference position of the point at every node, shape (N + 1, 3) [m]; None where only the end counts."""
        if self.options.goal != "path":
            return None
        first = self.point.positions_and_jacobian(
            self.simulator.start_equilibrium.state[None, : self.simulator.step.system.n_coordinates],
            self.simulator.theta,
        )[0][0, :3]
        places = np.vstack([first, *(first + np.asarray(via) for via in self.options.waypoint_offsets), self.target])
        at = np.linspace(0.0, self.simulator.path.duration, len(places))
        # the clock starts and stops gently as well, so that the way is one that can be followed
        return np.array(CubicSpline(at, places, bc_type="clamped")(np.minimum(self.simulator.node_times, at[-1])))

    def goal_residual(self, rollout: Rollout, w: Array) -> ValueWithJacobian:
        """Goal residual: distances and speeds over their tolerances, and weak regularisation of the motion."""
        mover, options, h = self.simulator, self.options, self.simulator.step.time_step
        n, size = mover.step.system.n_coordinates, w.size
        at, by_q = self.point.positions_and_jacobian(rollout.state[:, :n], mover.theta)
        by_w = None
        if rollout.state_sensitivity is not None:
            by_w = np.einsum("tiq,tqd->tid", by_q, rollout.state_sensitivity[:, :n, -size:])
        end, course = mover.standstill_nodes, self.reference_path
        parts = [_rows(at[end, :3] - self.target, None if by_w is None else by_w[end, :3], options.position_tolerance)]
        parts.append(
            _rows(
                (at[end[1:]] - at[end[1:] - 1]) / h,
                None if by_w is None else (by_w[end[1:]] - by_w[end[1:] - 1]) / h,
                options.rest_speed_tolerance,
            )
        )
        if course is not None:
            parts.append(_rows(at[:, :3] - course, None if by_w is None else by_w[:, :3], options.position_tolerance))
        bend = mover.path.control_point_matrix(2) / options.limits.max_acceleration
        nc = w.shape[1]
        parts.append(
            _rows(
                bend @ w, np.einsum("tk,ji->tjki", bend, np.eye(nc)).reshape(-1, nc, size), _ACCELERATION_WEIGHT**-0.5
            )
        )
        parts.append(_rows(w - self.quasi_static_coefficients, np.eye(size), _QUASI_STATIC_DISTANCE))
        if options.effort_weight:
            finite = np.isfinite(self.effort_limit)
            unit = self.effort_limit[finite] / np.sqrt(options.effort_weight)
            by_effort = None if rollout.effort_sensitivity is None else rollout.effort_sensitivity[:, finite, -size:]
            if by_effort is not None:
                by_effort = by_effort / unit[:, None]
            parts.append(_rows(rollout.effort[:, finite] / unit, by_effort, 1.0))
        return stack_values(parts)

    # -- what is kept within ------------------------------------------------------------------------------------------

    def limit_values(self, rollout: Rollout, w: Array) -> ValueWithJacobian:
        """Values of the limit rows of `limit_rows` along a motion, in their own units."""
        mover, size, nc = self.simulator, w.size, w.shape[1]
        n = mover.step.system.n_coordinates
        moved = rollout.state_sensitivity
        parts = []
        for order in (1, 2):
            controls = mover.path.control_point_matrix(order)
            slope = np.einsum("tk,ji->tjki", controls, np.eye(nc)).reshape(-1, size)
            parts.append(ValueWithJacobian((controls @ w).ravel(), slope))
        every = slice(None, None, _LIMIT_NODE_STRIDE)
        finite = np.isfinite(self.effort_limit)
        by_effort = (
            None
            if rollout.effort_sensitivity is None
            else rollout.effort_sensitivity[every, finite, -size:].reshape(-1, size)
        )
        parts.append(ValueWithJacobian(rollout.effort[every, finite].ravel(), by_effort))
        if self.options.limits.max_spring_angle is not None:
            slope = None if moved is None else moved[every, self._springs, -size:].reshape(-1, size)
            parts.append(ValueWithJacobian(rollout.state[every, self._springs].ravel(), slope))
        if self.inside is not None:
            at, by_q = self.inside.positions_and_jacobian(rollout.state[every, :n], mover.theta)
            slope = None if moved is None else np.einsum("tiq,tqd->tid", by_q, moved[every, :n, -size:])
            parts.append(ValueWithJacobian(at.ravel(), None if slope is None else slope.reshape(-1, size)))
        return stack_values(parts)

    def _bounded(self) -> list[LimitRows]:
        mover, limits = self.simulator, self.options.limits
        names = tuple(joint.name for joint in self.joints)
        speed = limits.velocity_fraction * np.array([joint.velocity_limit for joint in self.joints])
        sharp = np.full(len(names), limits.max_acceleration)
        count = len(mover.path.control_point_matrix())
        found = [_even("velocity [rad/s or m/s]", names, speed, count - 1)]
        found.append(_even("acceleration [rad/s^2 or m/s^2]", names, sharp, count - 2))
        finite = np.isfinite(self.effort_limit)
        steps = len(range(0, len(mover.node_times) - 1, _LIMIT_NODE_STRIDE))
        able = tuple(name for name, one in zip(names, finite, strict=True) if one)
        found.append(_even("effort [N m or N]", able, self.effort_limit[finite], steps))
        nodes = len(range(0, len(mover.node_times), _LIMIT_NODE_STRIDE))
        if limits.max_spring_angle is not None:
            springs = tuple(mover.step.system.mechanism.joint_names[i] for i in self._springs)
            found.append(_even("angle [rad]", springs, np.full(len(springs), limits.max_spring_angle), nodes))
        if self.inside is not None and self.options.box is not None:
            low, high = (np.tile(corner, len(self.inside.names) * nodes) for corner in self.options.box)
            axes = tuple(f"{name}, {axis}" for name in self.inside.names for axis in "xyz")
            found.append(LimitRows("place [m]", low, high, np.full(len(low), 0.1), axes * nodes))
        return found

    def violated_limits(self, value: Array) -> dict[str, tuple[str, float, float]]:
        """The worst violated row of each kind of limit: its name, value and bound."""
        found, at = {}, 0
        for rows in self.limit_rows:
            own = value[at : at + len(rows.row_names)]
            at += len(rows.row_names)
            if not len(own):
                continue
            over = np.maximum(own - rows.upper, rows.lower - own) / rows.unit
            worst = int(np.argmax(over))
            if over[worst] > 1e-4:
                bound = rows.upper[worst] if own[worst] > rows.upper[worst] else rows.lower[worst]
                found[rows.description] = (rows.row_names[worst], float(own[worst]), float(bound))
        return found

    def peak_effort_fractions(self, rollout: Rollout) -> Mapping[str, float]:
        """Largest effort of every joint divided by its URDF limit."""
        limit = np.array([joint.effort_limit for joint in self.joints])
        top = np.max(np.abs(rollout.effort), axis=0) / limit
        return {joint.name: float(one) for joint, one in zip(self.joints, top, strict=True)}


def _rows(value: Array, slope: Array | None, unit: float) -> ValueWithJacobian:
    """Rows of nodes (N, m), so that the sum of their squares is the mean over the nodes in squares of the unit."""
    scale = 1.0 / (unit * np.sqrt(len(value)))
    return ValueWithJacobian(scale * value.ravel(), None if slope is None else scale * slope.reshape(value.size, -1))


def _even(what: str, names: tuple[str, ...], limit: Array, count: int) -> LimitRows:
    upper = np.tile(limit, count)
    return LimitRows(what, -upper, upper, np.where(np.isfinite(upper), upper, 1.0), names * count)
