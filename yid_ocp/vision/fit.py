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
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Annotated

import casadi as ca
import numpy as np
from annotated_types import Ge, Gt, Le
from numpy.typing import ArrayLike, NDArray

from yid_ocp.errors import ConfigError, DataError
from yid_ocp.least_squares import Quadratic, damped_newton
from yid_ocp.model.kinematics import Kinematics, forward_kinematics
from yid_ocp.model.mechanism import Mechanism
from yid_ocp.model.system import System
from yid_ocp.options import About, check
from yid_ocp.vision.evidence import Evidence, Sight, Tubes, gather, nearest, slender
from yid_ocp.vision.fitted import Fit, SizeRows
from yid_ocp.vision.meshes import numeric_mechanism
from yid_ocp.vision.residuals import along_sight, nearest_way
from yid_ocp.vision.starts import Anchor, Starts

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

NODE_FACTOR = math.pi / 4
"""Distance of the mean of a tube's visible half from its axis, as a fraction of its radius."""

_SIGMAS = 3.0  # of a point, beyond which an end stands elsewhere than the shape has it
_NEAR = 3.0  # times the last scale, beyond which a point says nothing of the shape
_TOUCHING = 1e-3  # [m]
_LEAST_STIFFNESS = 1e-2  # of the mean; softer bends are still held this much
_LOOSE = 1e-2  # [1/m, 1/rad]; holds what no point tells, such as a straight rope's turn about itself
_TOLERANCE = 1e-4  # of a bend [rad] and, relative, of the cost, at which a pass ends


@dataclass(frozen=True)
class FitOptions:
    """Settings of the shape fit."""

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
    least_filled: Annotated[
        float,
        Ge(0),
        Le(1),
        About("a tube with points on a smaller share of its visible length is not where the fit has it"),
    ] = 0.75

    def __post_init__(self) -> None:
        check(self, "fit options")
        if not self.scales and not self.surface_scales:
            raise ConfigError("there is no pass to fit in", where="fit options: scales", allowed="one scale or more")


class ShapeFit:
    """Fitter of the shape of a system's object to a camera's points.

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
        self.free_owner = (*(_owner(system, entry.joint) for entry in bends), *[""] * len(loose))
        self.rest = np.zeros(system.size)
        for entry in system.elastic:
            self.rest[tree.joint_index(entry.joint)] = number(entry.rest)[0]
        stiffness = np.array([number(entry.stiffness)[0] for entry in bends])
        typical = stiffness.mean() if stiffness.max() > 0 else 1.0
        self._prior = np.sqrt(np.maximum(stiffness / typical, _LEAST_STIFFNESS)) / self.options.bend_std
        self._prior = np.concatenate([self._prior, np.full(len(loose), _LOOSE)])
        sought = {*(entry.joint for entry in system.elastic), *loose}
        self.known = tuple(name for name in tree.joint_names if name not in sought)

        radii, owners = [], []
        for segment in system.segments:
            radii += [number(segment.radius)[0]] * len(segment.links)
            owners += [segment.name] * len(segment.links)
        self.radius, self.owner = np.array(radii), tuple(owners)
        q, columns = ca.SX.sym("q", system.size), list(self.free)
        corners, seen, held, gap = _expressions(system, forward_kinematics(tree, q), self.options)
        held, gap = (ca.substitute(entry, symbols, ca.SX(ca.DM(theta))) for entry in (held, gap))
        self._corners = ca.Function("corners", [q], ca.cse([corners, ca.densify(ca.jacobian(corners, q)[:, columns])]))
        self._seen = ca.Function("seen", [q], ca.cse([seen, ca.densify(ca.jacobian(seen, q)[:, columns])]))
        holders = [forward_kinematics(tree, q).position(grasp.holder) for grasp in system.grasps]
        self._holders = ca.Function("holders", [q], [ca.densify(ca.vertcat(ca.SX(0, 1), *holders))])
        self._gap = ca.Function("gap", [q], [ca.densify(gap)])
        self._held = ca.Function("held", [q], ca.cse([held, ca.densify(ca.jacobian(held, q)[:, columns])]))
        # how all this moves as the tubes grow
        full = _expressions(system, forward_kinematics(system.mechanism, q), self.options)[:3]
        growth = np.zeros((len(theta), len(system.segments)))
        for k, segment in enumerate(system.segments):
            for name in ca.symvar(ca.vertcat(*segment.lengths)):
                index = system.parameters.names.index(name.name())
                growth[index, k] = theta[index]
        grown = [ca.densify(ca.mtimes(ca.jacobian(entry, symbols), ca.DM(growth))) for entry in full]
        self._grown = ca.Function("grown", [q], ca.cse(ca.substitute(grown, [symbols], [ca.SX(ca.DM(theta))])))
        at_rest = self._corners(self.rest)[0]
        self._lengths = np.linalg.norm(np.diff(np.array(at_rest).reshape(-1, 2, 3), axis=1)[:, 0], axis=1)
        self.reach, self.free_ends = self._ends(np.array(at_rest).reshape(-1, 2, 3), tree)

    def _ends(self, corners: Array, tree: Mechanism) -> tuple[Array, tuple[int, ...]]:
        """Length of the tube that each link belongs to, and the links after which nothing comes."""
        reach = np.array([self._lengths[[name == other for other in self.owner]].sum() for name in self.owner])
        q = ca.SX.sym("q", self.system.size)
        kinematics = forward_kinematics(tree, q)
        held = [kinematics.position(grasp.held) for grasp in self.system.grasps]
        places = np.array(ca.Function("held", [q], [ca.horzcat(ca.SX(3, 0), *held)])(self.rest)).T
        taken = np.concatenate([corners[:, 0], places])
        apart = np.linalg.norm(corners[:, 1][:, None] - taken, axis=2).min(axis=1)
        return reach, tuple(int(k) for k in np.flatnonzero(apart > _TOUCHING))

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
        begun = []
        for start in starts or (self.rest,):
            trial = q.copy()
            trial[free] = start[free]
            begun.append(trial)
        everything = _Left(np.ones(len(sight.nodes), bool), np.ones(len(sight.points), bool))
        thin = _Left(*slender(sight, float(self.radius.max())))
        best = self._attempt(sight, begun, thin if thin.nodes.any() and thin.points.any() else everything)
        for left in (self._without(best, sight, self._links_of(self._failed(best.evidence))), everything):
            failed = self._failed(best.evidence)
            if not failed:
                break
            # a part of the object is not where this has it: something like it stood nearer to where the search began
            if left.nodes.any() and left.points.any():
                other = self._attempt(sight, [self._rested(best.minimum.q, failed), *begun], left)
                best = max(best, other, key=lambda attempt: self._covered(attempt.evidence))
        return self._judged(best, self._rivals(best, sight), sight)

    def _rested(self, q: Array, tubes: Collection[str]) -> Array:
        """A configuration with some tubes as at rest."""
        trial = q.copy()
        again = [index for index, owner in zip(self.free, self.free_owner, strict=True) if owner in tubes]
        trial[again] = self.rest[again]
        return trial

    def _links_of(self, tubes: Collection[str]) -> NDArray[np.bool_]:
        return np.array([owner in tubes for owner in self.owner])

    def _rivals(self, best: _Attempt, sight: Sight) -> list[Array]:
        """Other shapes that the cloud speaks for as much: where a thing touches a tube, that may go on along the thing.

        Everything is tried that is left without the points on which the tube lies from the contact on.
        """
        if not best.evidence.contested.any() or not self.options.surface_scales:
            return []
        tubes = self.tubes(best.minimum.q)
        touched = nearest(tubes.corners, tubes.radius, sight.points[best.evidence.contested])[0]
        found = []
        for name in dict.fromkeys(self.owner[k] for k in sorted(set(touched.tolist()))):
            mine = self._links_of({name})
            onward = mine & (np.arange(len(mine)) >= min(k for k in touched if mine[k]))
            left = self._without(best, sight, onward)
            if left.nodes.any() and left.points.any():
                rival = self._attempt(sight, [self._rested(best.minimum.q, {name}), best.minimum.q], left)
                if not self._failed(rival.evidence):
                    found.append(rival.minimum.q)
        return found

    def _covered(self, evidence: Evidence) -> float:
        """Share of the visible length that has points of its own."""
        filled, empty = float(self._lengths @ evidence.filled), float(self._lengths @ evidence.empty)
        return filled / max(filled + empty, 1e-12)

    def _failed(self, evidence: Evidence) -> set[str]:
        """Tubes of which too much is seen to be empty."""
        failed = set()
        for name in dict.fromkeys(self.owner):
            mine = self._lengths * np.array([name == owner for owner in self.owner])
            filled, empty = float(mine @ evidence.filled), float(mine @ evidence.empty)
            if empty > 0 and filled < self.options.least_filled * (filled + empty):
                failed.add(name)
        return failed

    def _without(self, attempt: _Attempt, sight: Sight, links: NDArray[np.bool_]) -> _Left:
        """All nodes and points but those on which some links lie."""
        tubes = self.tubes(attempt.minimum.q)
        link = nearest(tubes.corners, tubes.radius, sight.points)[0]
        wrong = links[link] & (attempt.evidence.own | attempt.evidence.contested)
        node_link, _, _, distance = nearest(tubes.corners, tubes.radius, sight.nodes, NODE_FACTOR)
        return _Left(~(links[node_link] & (distance < 2 * tubes.radius[node_link])), ~wrong)

    def _attempt(self, sight: Sight, starts: Sequence[Array], left: _Left) -> _Attempt:
        """The best shape through some of the nodes and points, then through those that are surely its own."""
        on_nodes, on_points = self._tasks(sight, left)
        tried = [self._minimise(_Minimum(start, np.eye(len(self.free)), math.inf, 0), on_nodes) for start in starts]
        best = min(tried, key=lambda minimum: minimum.cost)
        last = self._minimise(best, on_points)
        iterations = sum(minimum.iterations for minimum in tried) + last.iterations - best.iterations
        evidence = gather(self.tubes(last.q), sight, self.near)
        if on_points:
            keep = ~(evidence.contested | evidence.foreign)
            if keep.any():
                last = self._minimise(last, self._tasks(sight, _Left(left.nodes, keep))[1])
                evidence = gather(self.tubes(last.q), sight, self.near)
        return _Attempt(replace(last, iterations=iterations + last.iterations), evidence)

    @property
    def near(self) -> float:
        """Distance from the surface beyond which a point says nothing of the shape [m]."""
        return (self.options.surface_scales or self.options.scales)[-1] * _NEAR

    def _tasks(self, sight: Sight, left: _Left) -> tuple[list[_Task], list[_Task]]:
        """The passes on the nodes and those on the points."""
        options, camera = self.options, sight.camera
        factor = 1.0 / (options.noise_correlation * options.noise**2)
        weight = np.minimum(sight.weight, options.weight_cap)[left.points]
        nodes, points = sight.nodes[left.nodes], sight.points[left.points]
        # nodes weigh together as much as the points, which share their errors
        node_weight = np.full(len(nodes), weight.sum() / max(len(nodes), 1)) * factor
        anchors = sight.anchors
        return (
            [_Task(nodes, node_weight, NODE_FACTOR, scale, camera, anchors) for scale in options.scales],
            [_Task(points, weight * factor, 1.0, scale, camera, anchors) for scale in options.surface_scales],
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

    def _judged(self, attempt: _Attempt, rivals: Sequence[Array], sight: Sight) -> Fit:
        """The shape with its standard deviations, and what speaks for and against it."""
        minimum, evidence = attempt.minimum, attempt.evidence
        q, on_shape = minimum.q, evidence.own | evidence.contested
        points, jacobian = (np.array(x) for x in self._seen(q))
        spread = jacobian @ np.linalg.solve(minimum.hessian, jacobian.T)
        places = points.reshape(-1, 3)
        own, every = (
            self._tasks(sight, _Left(np.zeros(len(sight.nodes), bool), mask))[1][-1:]
            for mask in (~(evidence.contested | evidence.foreign), ~evidence.foreign)
        )
        moved = np.zeros(places.shape)
        if every and evidence.contested.any():
            # how far the contested points would take the shape, if they counted
            moved = (jacobian @ self._quadratic(q, every[0]).change(0.0)).reshape(-1, 3)
        for rival in rivals:
            moved = np.maximum(np.abs(moved), np.abs(self.place(rival) - places))
        corners = self.tubes(q).corners
        swath = self._swath_std(corners, places, evidence, sight.camera)
        off_end = np.zeros(places.shape)
        for k, offset in zip(self.free_ends, evidence.ends, strict=True):
            if abs(offset) > _SIGMAS * max(self.options.noise, evidence.noise):
                at_end = np.linalg.norm(places - corners[k, 1], axis=1) < _TOUCHING
                axis = (corners[k, 1] - corners[k, 0]) / np.linalg.norm(corners[k, 1] - corners[k, 0])
                off_end[at_end] = offset * axis
        return Fit(
            q,
            places,
            np.sqrt(np.maximum(np.diag(spread), 0.0).reshape(-1, 3) + moved**2 + swath**2 + off_end**2),
            evidence.distance,
            evidence.noise,
            evidence.filled,
            evidence.empty,
            self._seen_points(corners, places, evidence),
            np.array(self._gap(q)).reshape(-1, 3),
            evidence.ends,
            float(evidence.contested.sum() / max(on_shape.sum(), 1)),
            evidence.things,
            self._size_rows(q, own[0] if own else None, evidence),
            minimum.iterations,
            corners,
        )

    def _quadratic(self, q: Array, task: _Task) -> Quadratic:
        """Cost, gradient and Gauss-Newton Hessian by the free bends."""
        out, jacobian = self._corners(q)
        corners, by_q = np.array(out).reshape(-1, 2, 3), np.array(jacobian)
        surface = nearest_way(corners, self.radius, task.points, task.camera, task.share)
        link, error, rows = surface.link, surface.error, surface.rows
        square = (error / task.scale) ** 2
        cost = 0.5 * task.scale**2 * float(np.sum(task.weight * square / (1 + square)))
        weight = task.weight / (1 + square) ** 2
        # sums over the points of each link, by the start and the end of its centre line
        order = np.argsort(link, kind="stable")
        block, apart = rows[order], error[order]
        weighted = block * weight[order, None]
        pull, stiff = np.zeros((len(self.radius), 6)), np.zeros((len(self.radius), 6, 6))
        bounds = np.searchsorted(link[order], np.arange(len(self.radius) + 1))
        for k, (begin, end) in enumerate(pairwise(bounds)):
            pull[k] = apart[begin:end] @ weighted[begin:end]
            stiff[k] = block[begin:end].T @ weighted[begin:end]
        chain = by_q.reshape(len(self.radius), 6, -1)
        gradient = by_q.T @ pull.ravel()
        hessian = by_q.T @ np.matmul(stiff, chain).reshape(by_q.shape)
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

    def _seen_points(self, corners: Array, places: Array, evidence: Evidence) -> NDArray[np.bool_]:
        """A point is seen where a link that begins or ends there is, of a tube that is where it should be."""
        apart = np.linalg.norm(corners[:, :, None] - places, axis=3).min(axis=1)
        failed = self._failed(evidence)
        sure = evidence.filled >= self.options.least_coverage
        sure &= np.array([owner not in failed for owner in self.owner])
        covered = (apart < _TOUCHING) & sure[:, None]
        held = {grasp.held for grasp in self.system.grasps}
        return np.asarray(covered.any(axis=0) | np.array([name in held for name in self.system.points]))

    def starts(self) -> Starts:
        """Finder of initial shapes for a system with a free root (`starts.loosened`)."""
        lengths = np.linalg.norm(np.diff(np.array(self._corners(self.rest)[0]).reshape(-1, 2, 3), axis=1)[:, 0], axis=1)
        by_owner = {name: lengths[[name == owner for owner in self.owner]] for name in dict.fromkeys(self.owner)}
        return Starts(self.system, self._tree, self.rest, self.bends, by_owner)

    def _swath_std(self, corners: Array, places: Array, evidence: Evidence, camera: Array) -> Array:
        """Standard deviation of each point, shape (np, 3), that the spread across the links about it leaves [m]."""
        apart = np.linalg.norm(corners[:, :, None] - places, axis=3).min(axis=1)
        across = np.cross(corners[:, 1] - corners[:, 0], corners.mean(axis=1) - camera)
        across /= np.maximum(np.linalg.norm(across, axis=1), 1e-12)[:, None]
        spread = np.sqrt(evidence.swath)[:, None] * np.abs(across)
        return np.asarray(np.max(np.where((apart < _TOUCHING)[..., None], spread[:, None], 0.0), axis=0))

    def _size_rows(self, q: Array, task: _Task | None, evidence: Evidence) -> SizeRows:
        """What a frame's points say of lengths and radii at its shape."""
        names = [segment.name for segment in self.system.segments]
        free, many = len(self.free), len(names)
        out, jacobian = self._corners(q)
        by_length, seen_by_length, held_by_length = (np.array(x) for x in self._grown(q))
        chain = np.hstack([np.array(jacobian), by_length])
        total = free + 2 * many
        gradient, hessian = np.zeros(total), np.zeros((total, total))

        def add(rows: Array, error: Array, weight: Array) -> None:
            nonlocal gradient, hessian
            weighted = rows * weight[:, None]
            gradient = gradient + weighted.T @ error
            hessian = hessian + weighted.T @ rows

        if task is not None:
            depths = along_sight(np.array(out).reshape(-1, 2, 3), self.radius, task.points, task.camera)
            weight = task.weight[depths.index] / (1 + (depths.error / task.scale) ** 2) ** 2
            segment = np.array([names.index(owner) for owner in self.owner])
            for k in range(len(self.radius)):
                mine = depths.link == k
                rows = np.zeros((int(mine.sum()), total))
                rows[:, : free + many] = depths.rows[mine] @ chain[6 * k : 6 * k + 6]
                rows[:, free + many + segment[k]] = depths.by_radius[mine] * self.radius[k]
                add(rows, depths.error[mine], weight[mine])
        for k, offset in zip(self.free_ends, evidence.ends, strict=True):
            if np.isfinite(offset):
                start, tip = np.array(out).reshape(-1, 2, 3)[k]
                axis = (tip - start) / np.linalg.norm(tip - start)
                rows = np.zeros((1, total))
                rows[0, : free + many] = -axis @ chain[6 * k + 3 : 6 * k + 6]
                add(rows, np.array([offset]), np.array([1.0 / max(self.options.noise, evidence.noise) ** 2]))
        held, by_held = (np.array(x) for x in self._held(q))
        add(np.hstack([by_held, held_by_length, np.zeros((len(held), many))]), held.ravel(), np.ones(len(held)))
        gradient[:free] += (q - self.rest)[list(self.free)] * self._prior**2
        hessian[:free, :free] += np.diag(self._prior**2)
        # the bends follow: dq = -H_qq^-1 (g_q + H_qx x)
        follow = np.linalg.solve(hessian[:free, :free], np.column_stack([gradient[:free], hessian[:free, free:]]))
        pull = gradient[free:] - hessian[free:, :free] @ follow[:, 0]
        curvature = hessian[free:, free:] - hessian[free:, :free] @ follow[:, 1:]
        moved = np.hstack([seen_by_length, np.zeros((len(seen_by_length), many))])
        moved = moved - np.array(self._seen(q)[1]) @ follow[:, 1:]
        return SizeRows(pull, curvature, moved.reshape(-1, 3, 2 * many))

    def tubes(self, q: Array) -> Tubes:
        """Tube links in the world at a configuration."""
        corners = np.array(self._corners(q)[0]).reshape(-1, 2, 3)
        return Tubes(corners, self.radius, self.free_ends, self.reach)

    def grips(self, q: ArrayLike) -> Array:
        """Gripper positions at a configuration, shape (grasps, 3) [m]."""
        return np.array(self._holders(np.asarray(q, float))).reshape(-1, 3)

    def place(self, q: ArrayLike) -> Array:
        """Positions of the system's points at a configuration, shape (np, 3) [m]."""
        return np.array(self._seen(np.asarray(q, float))[0]).reshape(-1, 3)


@dataclass(frozen=True, eq=False)
class _Minimum:
    """Where passes ended: configuration, Hessian by the free bends and cost there, iterations so far."""

    q: Array
    hessian: Array
    cost: float
    iterations: int


@dataclass(frozen=True, eq=False)
class _Left:
    """Which of a frame's nodes and points count."""

    nodes: NDArray[np.bool_]
    points: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class _Attempt:
    """A shape and what the whole cloud says of it."""

    minimum: _Minimum
    evidence: Evidence


@dataclass(frozen=True, eq=False)
class _Task:
    """One pass: points, their weights, where they lie on the tubes, the scale of the loss, the camera, seen ends."""

    points: Array
    weight: Array
    share: float
    scale: float
    camera: Array
    anchors: Sequence[Anchor]


def _owner(system: System, joint: str) -> str:
    """Segment to which an elastic joint belongs."""
    return next((s.name for s in system.segments if any(joint in names for names in s.links)), "")


def _expressions(system: System, kinematics: Kinematics, options: FitOptions) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
    """Corners of the links, the system's points, what grasps hold in standard deviations, and their gaps."""
    tree = kinematics.mechanism
    corners = []
    for segment in system.segments:
        for i, names in enumerate(segment.links):
            corners += [kinematics.origins[tree.joint_index(names[0])], kinematics.position(f"{segment.name}_{i}_tip")]
    rows, gaps = [ca.SX(0, 1)], [ca.SX(0, 1)]
    for grasp in system.grasps:
        residual, alignment = grasp.residual(kinematics), grasp.alignment(kinematics)
        gaps.append(residual[:3])
        rows.append(residual[:3] / options.grasp_std)
        if grasp.kind != "point":  # the first column of a weld is a roll, which stays unknown
            rows.append(alignment[-3:] / options.direction_std)
    seen = ca.vertcat(*(kinematics.position(name) for name in system.points))
    return ca.vertcat(*corners), seen, ca.vertcat(*rows), ca.vertcat(*gaps)
