"""The object's shape from a cloud: equation (3) of the source paper, robust and with derivatives.

    q_o = argmin sum_i w_i rho(e_i) + |g(q)/s_g|^2 + |b(q)|^2,      e_i = |p_i - c_i(q)| - f r_i

p_i: point of the cloud, or node of its skeleton; c_i: nearest point of the model's line segments, with r_i the radius
of its tube. A camera sees surfaces: points lie at the radius (f = 1) from the centre line, on the camera's side; a
node, the mean of the visible half of a tube, lies at f = pi/4. rho is Geman and McClure's loss. g: distance of held
frames from the grippers, known from the joint angles. b: bends, in proportion to the square root of their stiffness, so
that of all shapes through the points it is the one of least elastic energy. Twists about the tubes' axes move no centre
line (the two bends at the next joint reach every direction) and stay at rest.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import casadi as ca
import numpy as np
from annotated_types import Ge, Gt, Le
from numpy.typing import ArrayLike, NDArray

from yid_ocp.errors import ConfigError, DataError
from yid_ocp.least_squares import Quadratic, damped_newton
from yid_ocp.model.kinematics import forward_kinematics
from yid_ocp.model.system import System
from yid_ocp.options import About, check
from yid_ocp.vision.meshes import numeric_mechanism
from yid_ocp.vision.starts import Anchor, Starts

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

NODE_FACTOR = math.pi / 4
"""Where the mean of a tube's visible half lies, as a share of its radius."""

_AWAY = -0.5  # cosine of normal and sight beyond which a point cannot be on the side that the camera sees
_STATIONS = 6  # per link, where it is asked whether points are near
_OWN_SHARE = 0.3
_TOUCHING = 1e-3  # [m]
_LEAST_STIFFNESS = 1e-2  # of the mean; softer bends are still held this much
_LOOSE = 1e-2  # [1/m, 1/rad]; holds what no point tells, such as a straight rope's turn about itself
_TOLERANCE = 1e-4  # of a bend [rad] and, relative, of the cost, at which a pass ends


@dataclass(frozen=True)
class FitOptions:
    """How a shape is fitted."""

    scales: Annotated[
        tuple[Annotated[float, Gt(0)], ...],
        About(
            "scale of the robust loss on the nodes, pass after pass: wide first, to catch a start some decimetres off",
            "m",
        ),
    ] = (0.15, 0.05)
    surface_scales: Annotated[
        tuple[Annotated[float, Gt(0)], ...],
        About("the same on the points of the cloud; empty for a fit to the nodes alone, as in the source paper", "m"),
    ] = (0.03, 0.015)
    noise: Annotated[
        float, Gt(0), About("standard deviation of one averaged point's distance from the surface", "m")
    ] = 0.006
    noise_correlation: Annotated[
        float, Gt(0), About("of how many points the errors are alike; divides the weight of all points together")
    ] = 8.0
    grasp_std: Annotated[
        float, Gt(0), About("standard deviation between a gripper, by its joint angles, and what it holds", "m")
    ] = 0.004
    direction_std: Annotated[
        float, Gt(0), About("the same of the axes that grasps of kind axis and weld make coincide", "rad")
    ] = 0.05
    bend_std: Annotated[
        float, Gt(0), About("bend of a joint of mean stiffness that costs as much as one standard deviation", "rad")
    ] = 0.3
    iterations: Annotated[int, Ge(1), About("at most so many in a pass")] = 25
    weight_cap: Annotated[float, Gt(0), About("a point counts at most for so many of the camera's")] = 6.0
    least_coverage: Annotated[
        float,
        Ge(0),
        Le(1),
        About("a link with points along a smaller fraction of its length is hidden, or not where the fit has it"),
    ] = 0.5

    def __post_init__(self) -> None:
        check(self, "fit options")
        if not self.scales and not self.surface_scales:
            raise ConfigError("there is no pass to fit in", where="fit options: scales", allowed="one scale or more")


@dataclass(frozen=True, eq=False)
class Fit:
    """A shape and how good it is.

    Attributes
    ----------
    q : ndarray, shape (n,)
        Configuration, twists at rest.
    points : ndarray, shape (np, 3)
        The system's points there [m].
    std : ndarray, shape (np, 3)
        Standard deviation of each coordinate by the curvature of the cost [m].
    distance : float
        Mean of |e_i| over the points of the cloud, each counted for 0.1 m at most: the value of equation (3) [m].
        Parts of the cloud that are not connected with the largest one and lie off the shape are left out.
    inliers : float
        Share of these points that are nearer than three times the last scale.
    coverage : ndarray, shape (K,)
        Share of each link's length along which there are points.
    seen : ndarray of bool, shape (np,)
        Whether there are points enough about each of the system's points, or a gripper that holds it.
    gap : ndarray, shape (grasps, 3)
        From what each gripper holds to the gripper [m].
    iterations : int
    centre_line : ndarray, shape (K, 2, 3)
        Start and end of every link [m].
    """

    q: Array
    points: Array
    std: Array
    distance: float
    inliers: float
    coverage: Array
    seen: NDArray[np.bool_]
    gap: Array
    iterations: int
    centre_line: Array


@dataclass(frozen=True, eq=False)
class Sight:
    """What one frame knows: processed points and where they were seen from.

    Attributes
    ----------
    points : ndarray, shape (N, 3)
        Surface points in the world [m].
    weight : ndarray, shape (N,)
    part : ndarray of int, shape (N,)
        Connected part of the skeleton's graph to which each point belongs, 0 for the largest.
    nodes : ndarray, shape (K, 3)
        Of their skeleton [m].
    camera : ndarray, shape (3,)
        The camera's position [m].
    anchors : sequence of Anchor
        Ends of the object that were seen.
    """

    points: Array
    weight: Array
    part: Integers
    nodes: Array
    camera: Array
    anchors: Sequence[Anchor] = ()


class ShapeFit:
    """Fits the shape of a system's object to what a camera saw.

    Parameters
    ----------
    system : System
    options : FitOptions, optional
    values : mapping of str to float, optional
        Parameter values (lengths, radii, stiffnesses for the prior); nominal where absent.
    loose : sequence of str
        Joints beside the bends that are sought as well, with next to no prior: see `starts.loosened`.

    Raises
    ------
    DataError
        The system has no object with bends.
    """

    def __init__(
        self,
        system: System,
        options: FitOptions | None = None,
        values: Mapping[str, float] | None = None,
        loose: Sequence[str] = (),
    ) -> None:
        self.system = system
        self.options = options or FitOptions()
        if not system.segments:
            raise DataError("the model has no object whose shape could be fitted", hint="give it segments")
        tree = numeric_mechanism(system, values)
        self._tree = tree
        symbols, theta = system.parameters.symbols, system.parameters.vector(values)

        def number(expression: ca.SX) -> Array:
            return np.array(ca.densify(ca.Function("number", [symbols], [expression])(theta))).ravel()

        bends = [entry for entry in system.elastic if entry.kind == "bend" and entry.axis]
        self.bends = tuple(tree.joint_index(entry.joint) for entry in bends)
        self.free = (*self.bends, *(tree.joint_index(name) for name in loose))
        self.rest = np.zeros(system.size)
        for entry in system.elastic:
            self.rest[tree.joint_index(entry.joint)] = number(entry.rest)[0]
        stiffness = np.array([number(entry.stiffness)[0] for entry in bends])
        typical = stiffness.mean() if stiffness.max() > 0 else 1.0
        self._prior = np.sqrt(np.maximum(stiffness / typical, _LEAST_STIFFNESS)) / self.options.bend_std
        self._prior = np.concatenate([self._prior, np.full(len(loose), _LOOSE)])
        sought = {*(entry.joint for entry in system.elastic), *loose}
        self.known = tuple(name for name in tree.joint_names if name not in sought)

        q = ca.SX.sym("q", system.size)
        kinematics = forward_kinematics(tree, q)
        columns = list(self.free)
        starts, ends, radii, owners = [], [], [], []
        for segment in system.segments:
            for i, names in enumerate(segment.links):
                starts.append(kinematics.origins[tree.joint_index(names[0])])
                ends.append(kinematics.position(f"{segment.name}_{i}_tip"))
                radii.append(number(segment.radius)[0])
                owners.append(segment.name)
        self.radius, self.owner = np.array(radii), tuple(owners)
        corners = ca.vertcat(*(ca.vertcat(a, b) for a, b in zip(starts, ends, strict=True)))
        self._corners = ca.Function("corners", [q], ca.cse([corners, ca.densify(ca.jacobian(corners, q)[:, columns])]))
        seen = ca.vertcat(*(kinematics.position(name) for name in system.points))
        self._seen = ca.Function("seen", [q], ca.cse([seen, ca.densify(ca.jacobian(seen, q)[:, columns])]))
        rows = [ca.SX(0, 1)]
        for grasp in system.grasps:
            residual, alignment = grasp.residual(kinematics), grasp.alignment(kinematics)
            rows.append(residual[:3] / self.options.grasp_std)
            if grasp.kind != "point":  # the first column of a weld is a roll, which stays unknown
                rows.append(alignment[-3:] / self.options.direction_std)
        held = ca.substitute(ca.vertcat(*rows), symbols, ca.SX(ca.DM(theta)))
        gaps = [grasp.residual(kinematics)[:3] for grasp in system.grasps]
        holders = [kinematics.position(grasp.holder) for grasp in system.grasps]
        self._holders = ca.Function("holders", [q], [ca.densify(ca.vertcat(ca.SX(0, 1), *holders))])
        gap = ca.substitute(ca.vertcat(ca.SX(0, 1), *gaps), symbols, ca.SX(ca.DM(theta)))
        self._gap = ca.Function("gap", [q], [ca.densify(gap)])
        self._held = ca.Function("held", [q], ca.cse([held, ca.densify(ca.jacobian(held, q)[:, columns])]))

    def solve(
        self,
        sight: Sight,
        q_known: Array,
        starts: Sequence[Array] = (),
    ) -> Fit:
        """Fit the shape in one frame.

        Parameters
        ----------
        sight : Sight
        q_known : ndarray, shape (n,)
            Configuration whose robot part is right; the object's part is not used.
        starts : sequence of ndarray, each (n,)
            Where the search for the object's part begins; at rest where absent. The passes on the nodes, which cost
            little, run from all of them, the others from the best that was found.

        Returns
        -------
        Fit

        Raises
        ------
        DataError
            There is no point.
        """
        if not len(sight.points) or not len(sight.nodes):
            raise DataError("there is no point to fit to", where="fit")
        free = list(self.free)
        q = self.rest.copy()
        known = [self.system.mechanism.joint_index(name) for name in self.known]
        q[known] = q_known[known]
        weight = np.minimum(sight.weight, self.options.weight_cap)
        on_nodes, on_points = self._tasks(sight, weight)
        tried = []
        for start in starts or (self.rest,):
            trial = q.copy()
            trial[free] = start[free]
            tried.append(self._minimise(_Minimum(trial, np.eye(len(free)), math.inf, 0), on_nodes))
        best = min(tried, key=lambda minimum: minimum.cost)
        last = self._minimise(best, on_points)
        iterations = sum(minimum.iterations for minimum in tried) + last.iterations - best.iterations
        return self._judged(replace(last, iterations=iterations), sight, weight)

    def _tasks(self, sight: Sight, weight: Array) -> tuple[list[_Task], list[_Task]]:
        """The passes on the nodes and those on the points."""
        options = self.options
        factor = 1.0 / (options.noise_correlation * options.noise**2)
        # nodes weigh together as much as the points, which share their errors
        node_weight = np.full(len(sight.nodes), weight.sum() / len(sight.nodes)) * factor
        camera, anchors = sight.camera, sight.anchors
        return (
            [_Task(sight.nodes, node_weight, NODE_FACTOR, scale, camera, anchors) for scale in options.scales],
            [_Task(sight.points, weight * factor, 1.0, scale, camera, anchors) for scale in options.surface_scales],
        )

    def _minimise(self, start: _Minimum, tasks: Sequence[_Task]) -> _Minimum:
        """One pass after the other, each from where the one before ended."""
        free, end = list(self.free), start
        for task in tasks:
            q = end.q.copy()

            def about(bends: Array, task: _Task = task, q: Array = q) -> Quadratic:
                trial = q.copy()
                trial[free] = bends
                return self._quadratic(trial, task)

            found = damped_newton(
                about,
                q[free],
                iterations=self.options.iterations,
                step_tolerance=_TOLERANCE,
                cost_tolerance=_TOLERANCE,
            )
            q[free] = found.x
            end = _Minimum(q, found.model.hessian, found.model.cost, end.iterations + found.iterations)
        return end

    def _judged(self, minimum: _Minimum, sight: Sight, weight: Array) -> Fit:
        """The shape with its standard deviations, and how much of the cloud lies on it."""
        q = minimum.q
        near = (self.options.surface_scales or self.options.scales)[-1] * 3
        error, link, along = self._errors(q, sight.points, 1.0, sight.camera)
        size = np.abs(error)
        on_shape = size < near
        own = _own_parts(sight.part, on_shape, weight)
        points, jacobian = self._seen(q)
        spread = np.array(jacobian) @ np.linalg.solve(minimum.hessian, np.array(jacobian).T)
        corners = np.array(self._corners(q)[0]).reshape(-1, 2, 3)
        coverage = self._coverage(link[on_shape], along[on_shape])
        places = np.array(points).reshape(-1, 3)
        return Fit(
            q,
            places,
            np.sqrt(np.maximum(np.diag(spread), 0.0)).reshape(-1, 3),
            float(np.average(np.minimum(size, 0.1)[own], weights=weight[own])),
            float(np.average(on_shape[own], weights=weight[own])),
            coverage,
            self._seen_points(corners, places, coverage),
            np.array(self._gap(q)).reshape(-1, 3),
            minimum.iterations,
            corners,
        )

    def _errors(self, q: Array, points: Array, share: float, camera: Array) -> tuple[Array, Integers, Array]:
        """e_i, the link that each point belongs to, and where along it (0 to 1)."""
        corners = np.array(self._corners(q)[0]).reshape(-1, 2, 3)
        link, along, normal, distance = self._nearest(corners, points, share)
        away = np.einsum("ij,ij->i", normal, points - camera) > -_AWAY * np.linalg.norm(points - camera, axis=1)
        return np.where(away, -distance, distance) - share * self.radius[link], link, along

    def _nearest(self, corners: Array, points: Array, share: float) -> tuple[Integers, Array, Array, Array]:
        start, edge = corners[:, 0], corners[:, 1] - corners[:, 0]
        square = np.einsum("ij,ij->i", edge, edge)
        # (p - a).d for all points and links at once, by one product of matrices
        t = np.clip((points @ edge.T - np.einsum("ij,ij->i", start, edge)) / square, 0.0, 1.0)
        apart = np.zeros(t.shape)
        for axis in range(3):
            apart += (points[:, axis, None] - start[:, axis] - t * edge[:, axis]) ** 2
        link = np.argmin(np.sqrt(apart) - share * self.radius, axis=1)
        rows = np.arange(len(points))
        along = t[rows, link]
        normal = points - start[link] - along[:, None] * edge[link]
        distance = np.sqrt(apart[rows, link])
        return link, along, normal / np.maximum(distance, 1e-9)[:, None], distance

    def _quadratic(self, q: Array, task: _Task) -> Quadratic:
        """Cost, gradient and Gauss-Newton Hessian by the free bends."""
        out, jacobian = self._corners(q)
        corners, by_q = np.array(out).reshape(-1, 2, 3), np.array(jacobian)
        link, along, normal, distance = self._nearest(corners, task.points, task.share)
        sight = task.points - task.camera
        away = np.einsum("ij,ij->i", normal, sight) > -_AWAY * np.linalg.norm(sight, axis=1)
        sign = np.where(away, -1.0, 1.0)
        error = sign * distance - task.share * self.radius[link]
        square = (error / task.scale) ** 2
        cost = 0.5 * task.scale**2 * float(np.sum(task.weight * square / (1 + square)))
        weight = task.weight / (1 + square) ** 2
        # e falls as the centre line moves along the normal: de = -n'((1 - t) da + t db)
        direction = -sign[:, None] * normal
        rows = np.concatenate([direction * (1 - along)[:, None], direction * along[:, None]], axis=1)
        count = len(self.radius)
        gradient, hessian = np.zeros(by_q.shape[1]), np.zeros((by_q.shape[1],) * 2)
        for k in range(count):
            mine = np.flatnonzero(link == k)
            if len(mine):
                block, chain = rows[mine], by_q[6 * k : 6 * k + 6]
                weighted = block * weight[mine, None]
                gradient += chain.T @ (weighted.T @ error[mine])
                hessian += chain.T @ (block.T @ weighted) @ chain
        for anchor in task.anchors:
            off = float(anchor.ahead @ (corners.reshape(-1, 3)[anchor.corner] - anchor.place)) / anchor.std
            by_off = anchor.ahead @ by_q[3 * anchor.corner : 3 * anchor.corner + 3] / anchor.std
            cost += 0.5 * off**2
            gradient += by_off * off
            hessian += np.outer(by_off, by_off)
        held, by_held = (np.array(x) for x in self._held(q))
        held = held.ravel()
        bend = (q - self.rest)[list(self.free)] * self._prior
        cost += 0.5 * float(held @ held + bend @ bend)
        gradient += by_held.T @ held + bend * self._prior
        hessian += by_held.T @ by_held + np.diag(self._prior**2)
        return Quadratic(cost, gradient, hessian)

    def _coverage(self, link: Integers, along: Array) -> Array:
        stations = link * _STATIONS + np.minimum((along * _STATIONS).astype(np.int64), _STATIONS - 1)
        filled = np.bincount(stations, minlength=len(self.radius) * _STATIONS).reshape(-1, _STATIONS) > 0
        return np.asarray(filled.mean(axis=1))

    def _seen_points(self, corners: Array, places: Array, coverage: Array) -> NDArray[np.bool_]:
        """A point is seen where a link that begins or ends there is."""
        apart = np.linalg.norm(corners[:, :, None] - places, axis=3).min(axis=1)
        covered = (apart < _TOUCHING) & (coverage[:, None] >= self.options.least_coverage)
        held = {grasp.held for grasp in self.system.grasps}
        return np.asarray(covered.any(axis=0) | np.array([name in held for name in self.system.points]))

    def grips(self, q: ArrayLike) -> Array:
        """Where the grippers are at a configuration, shape (grasps, 3) [m]."""
        return np.array(self._holders(np.asarray(q, float))).reshape(-1, 3)

    def starts(self) -> Starts:
        """What finds starts for a system whose root is sought (`starts.loosened`)."""
        lengths = np.linalg.norm(np.diff(np.array(self._corners(self.rest)[0]).reshape(-1, 2, 3), axis=1)[:, 0], axis=1)
        by_owner = {name: lengths[[name == owner for owner in self.owner]] for name in dict.fromkeys(self.owner)}
        return Starts(self.system, self._tree, self.rest, self.bends, by_owner)

    def place(self, q: ArrayLike) -> Array:
        """The system's points at a configuration, shape (np, 3) [m]."""
        return np.array(self._seen(np.asarray(q, float))[0]).reshape(-1, 3)


def _own_parts(part: Integers, near: NDArray[np.bool_], weight: Array) -> NDArray[np.bool_]:
    """Points of the largest part, and of others that mostly lie on the shape."""
    total = np.bincount(part, weight)
    share = np.bincount(part, weight * near) / np.maximum(total, 1e-12)
    share[0] = 1.0
    return np.asarray(share[part] >= _OWN_SHARE)


@dataclass(frozen=True, eq=False)
class _Minimum:
    """Where passes ended: configuration, Hessian by the free bends and cost there, iterations so far."""

    q: Array
    hessian: Array
    cost: float
    iterations: int


@dataclass(frozen=True, eq=False)
class _Task:
    """One pass: points, their weights, where they lie on the tubes, the scale of the loss, the camera, seen ends."""

    points: Array
    weight: Array
    share: float
    scale: float
    camera: Array
    anchors: Sequence[Anchor]
