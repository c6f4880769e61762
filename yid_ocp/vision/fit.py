"""A robust fit of the object's shape to a cloud. It solves equation (3) of Caldwell (ISER 2014) with derivatives.

    q_o = argmin sum_i w_i rho(e_i) + |g(q)/s_g|^2 + |b(q)|^2,      e_i = |p_i - c_i(q)| - f r_i

p_i is a point of the cloud (f = 1), or a node of its skeleton, the mean of a tube's visible half (f = pi/4). w_i is its
weight, c_i the nearest point of the model's line segments, r_i the radius of its tube, rho the Geman-McClure loss. g is
the distance of held frames from the grippers, s_g its standard deviation. b are bends times the square root of their
relative stiffness. Twists about a tube's axis do not move its centre line and stay at zero.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from copy import copy
from dataclasses import fields
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from yid_ocp.arrays import Array, BoolArray
from yid_ocp.errors import DataError
from yid_ocp.integrator.interpreted import dense_function_evaluator
from yid_ocp.least_squares import LocalQuadraticModel, minimize_by_damped_newton
from yid_ocp.model.system import System
from yid_ocp.vision import shape_evidence
from yid_ocp.vision.shape_evidence import FrameShapeFit, ProcessedFrameCloud, ShapeFitQualityAndPointClasses
from yid_ocp.vision.shape_guesses import ObservedObjectEnd, ShapeGuessFinder
from yid_ocp.vision.surface_meshes import model_link_lengths_and_radius_by_segment

_Left = tuple[BoolArray, BoolArray]  # masks of the nodes and points of a frame that are used
_NODE_RADIUS_FRACTION = math.pi / 4  # distance of the mean of a tube's visible half from its axis, over the radius
_END_OFFSET_STDS = 3.0  # stds of a point beyond which an end differs from the shape
SURFACE_NOISE_STD = 0.006  # of one averaged point of usual depth cameras [m]
_NODE_LOSS_SCALES = (0.15, 0.05)  # of the robust loss, per pass: wide first, for poor initial shapes [m]
_SURFACE_LOSS_SCALES = (0.03, 0.015)  # of the loss on points, per pass [m]
MAX_INFORMATIVE_SURFACE_DISTANCE = 3.0 * _SURFACE_LOSS_SCALES[-1]  # points beyond carry no information [m]
_GRASP_POSITION_STD = 0.004  # between a gripper, by joint angles, and the grasped point [m]
_TOUCHING_DISTANCE = 1e-3  # [m]
_MIN_STIFFNESS_FRACTION = 1e-2  # lower bound of a bend's stiffness, relative to the mean
_WEAK_REGULARISATION = 1e-2  # [1/m, 1/rad]; determines what no point shows, such as the roll of a straight rope
_MAX_ITERATIONS = 25  # of a pass
_CORRELATED_POINTS = 8.0  # neighbouring points whose errors are correlated; divides the total weight of the points
_MAX_POINT_WEIGHT = 6.0  # [camera points]
_GRASP_DIRECTION_STD = 0.05  # between axes that grasps of kind axis and weld align [rad]
_BEND_PRIOR_STD = 0.3  # bend of a joint of mean stiffness that costs as much as one standard deviation [rad]
_MIN_LINK_COVERAGE = 0.5  # a link with points along a smaller fraction of its length is hidden or misplaced
_MIN_TUBE_COVERAGE = 0.75  # a tube with points on a smaller fraction of its visible length is misplaced
_PASS_TOLERANCE = 1e-4  # change of a bend [rad] and relative change of the cost at which a pass ends


class ShapeFitter:
    """A fitter of a flexible object's bending angles to camera points. Parameters default to nominal values.

    `surface_noise_std` is the standard deviation of an averaged point's distance from the surface [m]. The joints in
    `loose`, such as a free root (`shape_guesses.add_free_root_joints`), are fitted too, with an almost flat prior.
    Raises `DataError` if the system has no object.
    """

    def __init__(
        self,
        system: System,
        values: Mapping[str, float] | None = None,
        loose: Sequence[str] = (),
        surface_noise_std: float = SURFACE_NOISE_STD,
    ) -> None:
        self.system, self.surface_noise_std = system, surface_noise_std
        if not system.segment_layouts:
            what, hint = "the model has no object whose shape could be fitted", "set model.object, such as kind: foam_y"
            raise DataError(what, where="model.object", allowed="an object made of segments", hint=hint)
        bends = [entry for entry in system.elastic_joints if entry.deformation == "bend" and entry.axis]
        self.bend_joints = tuple(system.mechanism.joint_index(entry.joint_name) for entry in bends)
        self.free_joints = (*self.bend_joints, *(system.mechanism.joint_index(name) for name in loose))
        owner = {joint: s.name for s in system.segment_layouts for names in s.link_joints for joint in names}
        self._free_joint_segments = (*(owner.get(entry.joint_name, "") for entry in bends), *[""] * len(loose))
        sought = {*(entry.joint_name for entry in system.elastic_joints), *loose}
        self.recorded_joint_names = tuple(name for name in system.mechanism.joint_names if name not in sought)
        self.recorded_joint_indices = [system.mechanism.joint_index(name) for name in self.recorded_joint_names]
        self._symbolic = _symbolic_functions(system, self.free_joints)
        self._set_values(values)

    def with_parameter_values(self, values: Mapping[str, float] | None) -> ShapeFitter:
        """Return a fitter with other parameter values. This is faster than a new fitter: the equations are known."""
        other = copy(self)
        other._set_values(values)
        return other

    def _set_values(self, values: Mapping[str, float] | None) -> None:
        system, index = self.system, self.system.mechanism.joint_index
        self._values = values
        theta = system.parameters.vector(values)
        springs = [ca.vertcat(entry.rest_angle, entry.stiffness) for entry in system.elastic_joints]
        numbers = ca.Function("springs", [system.parameters.symbols], [ca.densify(ca.horzcat(*springs))])(theta)
        rest, stiff = np.array(numbers)
        self.rest_configuration = np.zeros(system.n_coordinates)
        self.rest_configuration[[index(entry.joint_name) for entry in system.elastic_joints]] = rest
        stiffness = stiff[[entry.deformation == "bend" and bool(entry.axis) for entry in system.elastic_joints]]
        typical = stiffness.mean() if stiffness.max() > 0 else 1.0
        held_by = np.sqrt(np.maximum(stiffness / typical, _MIN_STIFFNESS_FRACTION)) / _BEND_PRIOR_STD
        n_loose = len(self.free_joints) - len(self.bend_joints)
        self._prior = np.concatenate([held_by, np.full(n_loose, _WEAK_REGULARISATION)])

        sizes = model_link_lengths_and_radius_by_segment(system, values)
        self.link_radii = np.concatenate([np.full(len(lengths), radius) for lengths, radius in sizes.values()])
        self.link_segments = tuple(name for name, (lengths, _) in sizes.items() for _ in lengths)
        q = ca.SX.sym("q", system.n_coordinates)
        at = [q, ca.SX(ca.DM(theta))]
        own = {name: ca.Function(name, [q], function.call(at)) for name, function in self._symbolic.items()}
        quick = (dense_function_evaluator(own[name]) for name in ("corners", "seen", "held", "holders"))
        self._corners, self._seen, self._held, self._holders = quick
        self._gap, self._grown = own["gap"], own["grown"]
        at_rest = self._links_at(self.rest_configuration)
        self._lengths = np.linalg.norm(at_rest[:, 1] - at_rest[:, 0], axis=1)
        self._tube_lengths = np.array([self._lengths[self._links_of({name})].sum() for name in self.link_segments])
        # links without successors
        places = np.array(own["taken"](self.rest_configuration)).reshape(-1, 3)
        apart = np.linalg.norm(at_rest[:, 1][:, None] - np.concatenate([at_rest[:, 0], places]), axis=2).min(axis=1)
        self.free_end_links = tuple(int(k) for k in np.flatnonzero(apart > _TOUCHING_DISTANCE))

    def _links_at(self, q: Array) -> Array:
        return self._corners(q)[0].reshape(-1, 2, 3)

    def fit_frame(self, cloud: ProcessedFrameCloud, q_known: Array, starts: Sequence[Array] = ()) -> FrameShapeFit:
        """Fit the object's shape in one frame, given the robot's configuration `q_known` (n,).

        The fit has two stages. Cheap passes on skeleton nodes run from every guess in `starts` (default: the undeformed
        shape). Passes on points run from the best result. The filtered `cloud` has points and nodes of their skeleton.
        """
        free, q = list(self.free_joints), self.rest_configuration.copy()
        q[self.recorded_joint_indices] = q_known[self.recorded_joint_indices]
        begun = [self._with_free(q, start[free]) for start in starts or (self.rest_configuration,)]
        everything = np.ones(len(cloud.skeleton_nodes), bool), np.ones(len(cloud.points), bool)
        thin = shape_evidence.tube_like_node_and_point_masks(cloud, float(self.link_radii.max()))
        best, evidence = self._attempt(cloud, begun, thin if thin[0].any() and thin[1].any() else everything)
        for left in (self._without(best, evidence, cloud, self._links_of(self._failed(evidence))), everything):
            failed = self._failed(evidence)
            if not failed:
                break
            # a part of the object is misplaced: something similar was nearer to the initial guess
            if left[0].any() and left[1].any():
                other = self._attempt(cloud, [self._rested(best.q, failed), *begun], left)
                covered = [own.covered_fraction_of_visible_length(self._lengths) for own in (evidence, other[1])]
                if covered[1] > covered[0]:
                    best, evidence = other
        return self._judged(best, evidence, self._rivals(best, evidence, cloud), cloud)

    def _with_free(self, q: Array, angles: Array) -> Array:
        trial = q.copy()
        trial[list(self.free_joints)] = angles
        return trial

    def _rested(self, q: Array, tubes: Collection[str]) -> Array:
        """The configuration `q`, but with the tubes named `tubes` undeformed."""
        free = list(self.free_joints)
        again = np.array([owner in tubes for owner in self._free_joint_segments])
        return self._with_free(q, np.where(again, self.rest_configuration[free], q[free]))

    def _links_of(self, tubes: Collection[str]) -> BoolArray:
        return np.array([owner in tubes for owner in self.link_segments])

    def _rivals(
        self, best: _BestFit, evidence: ShapeFitQualityAndPointClasses, sight: ProcessedFrameCloud
    ) -> list[Array]:
        """Configurations of other shapes that may fit the cloud, one for each tube that a foreign object touches."""
        if not evidence.is_contested.any():
            return []
        tubes, contested = self.tube_links_at_configuration(best.q), sight.points[evidence.is_contested]
        touched = shape_evidence.nearest_link_axis_projections(tubes.link_ends, tubes.radius, contested)[0]
        found = []
        for name in dict.fromkeys(self.link_segments[k] for k in sorted(set(touched.tolist()))):
            mine = self._links_of({name})
            onward = mine & (np.arange(len(mine)) >= min(k for k in touched if mine[k]))
            left = self._without(best, evidence, sight, onward)
            if left[0].any() and left[1].any():
                rival, its = self._attempt(sight, [self._rested(best.q, {name}), best.q], left)
                if not self._failed(its):
                    found.append(rival.q)
        return found

    def _failed(self, evidence: ShapeFitQualityAndPointClasses) -> set[str]:
        """Names of the tubes that have points on too small a part of their visible length."""
        own = {name: self._lengths * self._links_of({name}) for name in self.link_segments}
        empty, covered = evidence.visibly_empty_fraction, evidence.covered_fraction_of_visible_length
        return {name for name, mine in own.items() if mine @ empty > 0 and covered(mine) < _MIN_TUBE_COVERAGE}

    def _without(
        self, best: _BestFit, evidence: ShapeFitQualityAndPointClasses, sight: ProcessedFrameCloud, links: BoolArray
    ) -> _Left:
        """Masks of the nodes and points that are not on the links of the mask `links`."""
        tubes, nodes = self.tube_links_at_configuration(best.q), sight.skeleton_nodes
        project = partial(shape_evidence.nearest_link_axis_projections, tubes.link_ends, tubes.radius)
        wrong = links[project(sight.points)[0]] & (evidence.is_own | evidence.is_contested)
        at, _, _, distance = project(nodes, _NODE_RADIUS_FRACTION)
        return ~(links[at] & (distance < 2 * tubes.radius[at])), ~wrong

    def _attempt(
        self, sight: ProcessedFrameCloud, starts: Sequence[Array], left: _Left
    ) -> tuple[_BestFit, ShapeFitQualityAndPointClasses]:
        """The best shape by the nodes and points of the masks `left`, refined with the points that belong to it."""
        on_nodes, on_points = self._tasks(sight, *left)
        unit = np.eye(len(self.free_joints))
        tried = [self._minimise(_BestFit(start, unit, math.inf), on_nodes) for start in starts]
        last = self._minimise(min(tried, key=lambda minimum: minimum.cost), on_points)
        near = MAX_INFORMATIVE_SURFACE_DISTANCE
        evidence = shape_evidence.fit_quality_and_point_classes(self.tube_links_at_configuration(last.q), sight, near)
        keep = ~(evidence.is_contested | evidence.is_foreign)
        if keep.any():
            last = self._minimise(last, self._tasks(sight, left[0], keep)[1])
            tubes = self.tube_links_at_configuration(last.q)
            evidence = shape_evidence.fit_quality_and_point_classes(tubes, sight, near)
        return last, evidence

    def _tasks(
        self, sight: ProcessedFrameCloud, at_nodes: BoolArray, at_points: BoolArray
    ) -> tuple[list[_Task], list[_Task]]:
        """The passes on the chosen nodes, and the passes on the chosen points."""
        camera, factor = sight.camera_position, 1.0 / (_CORRELATED_POINTS * self.surface_noise_std**2)
        weight = np.minimum(sight.point_weights, _MAX_POINT_WEIGHT)[at_points]
        nodes, points = sight.skeleton_nodes[at_nodes], sight.points[at_points]
        # nodes together weigh as much as the points, whose errors they share
        node_weight = np.full(len(nodes), weight.sum() / max(len(nodes), 1)) * factor
        on_nodes, on_surface = (nodes, node_weight, _NODE_RADIUS_FRACTION), (points, weight * factor, 1.0)
        both = (on_nodes, _NODE_LOSS_SCALES), (on_surface, _SURFACE_LOSS_SCALES)
        nodes_first, points_then = ([_Task(*of, s, camera, sight.end_anchors) for s in scales] for of, scales in both)
        return nodes_first, points_then

    def _minimise(self, start: _BestFit, tasks: Sequence[_Task]) -> _BestFit:
        """The minimum after several passes, each of which starts at the result of the previous one."""
        end, most = start, _MAX_ITERATIONS
        for task in tasks:

            def about(bends: Array, task: _Task = task, q: Array = end.q) -> LocalQuadraticModel:
                return self._quadratic(self._with_free(q, bends), task)

            begin = end.q[list(self.free_joints)]
            x, final = minimize_by_damped_newton(
                about, begin, max_iterations=most, step_tolerance=_PASS_TOLERANCE, cost_tolerance=_PASS_TOLERANCE
            )
            end = _BestFit(self._with_free(end.q, x), final.hessian, final.cost)
        return end

    def _judged(
        self,
        best: _BestFit,
        evidence: ShapeFitQualityAndPointClasses,
        rivals: Sequence[Array],
        sight: ProcessedFrameCloud,
    ) -> FrameShapeFit:
        """The fitted shape of a frame, with the standard deviations of its points and the quality of its fit."""
        q = best.q
        points, jacobian = self._seen(q)
        places = points.reshape(-1, 3)
        spread = np.diag(jacobian @ np.linalg.solve(best.hessian, jacobian.T)).reshape(-1, 3)
        none = np.zeros(len(sight.skeleton_nodes), bool)
        own = self._tasks(sight, none, ~(evidence.is_contested | evidence.is_foreign))[1][-1]
        moved = np.zeros(places.shape)
        if evidence.is_contested.any():
            # how far the contested points would take the shape, if they counted
            every = self._tasks(sight, none, ~evidence.is_foreign)[1][-1]
            moved = (jacobian @ self._quadratic(q, every).damped_step(0.0)).reshape(-1, 3)
        for rival in rivals:
            moved = np.maximum(np.abs(moved), np.abs(self.point_positions_at_configuration(rival) - places))
        corners = self._links_at(q)
        touching = np.linalg.norm(corners[:, :, None] - places, axis=3).min(axis=1) < _TOUCHING_DISTANCE
        # the spread across the links about each point
        across = shape_evidence.link_normals_perpendicular_to_sight(corners, sight.camera_position)
        wide = np.sqrt(evidence.excess_variance)[:, None] * np.abs(across)
        swath = np.max(np.where(touching[..., None], wide[:, None], 0.0), axis=0)
        off_end, noise = np.zeros(places.shape), max(self.surface_noise_std, evidence.noise_std)
        for k, offset in zip(self.free_end_links, evidence.end_offsets, strict=True):
            if abs(offset) > _END_OFFSET_STDS * noise:
                at_end = np.linalg.norm(places - corners[k, 1], axis=1) < _TOUCHING_DISTANCE
                off_end[at_end] = offset * shape_evidence.unit_link_axes(corners)[k]
        # a point counts as seen if a link that starts or ends there is seen and its tube is not misplaced
        sure = evidence.covered_fraction >= _MIN_LINK_COVERAGE
        sure &= ~self._links_of(self._failed(evidence))
        held = {grasp.held_frame for grasp in self.system.grasps}
        seen = (touching & sure[:, None]).any(axis=0) | np.array([name in held for name in self.system.point_frames])
        return FrameShapeFit(
            **{entry.name: getattr(evidence, entry.name) for entry in fields(shape_evidence.ShapeFitQuality)},
            q=q,
            point_positions=places,
            point_std=np.sqrt(np.maximum(spread, 0.0) + moved**2 + swath**2 + off_end**2),
            is_point_seen=np.asarray(seen),
            grasp_gaps=np.array(self._gap(q)).reshape(-1, 3),
            dimension_equations=self._size_rows(q, own, evidence),
            link_ends=corners,
        )

    def _quadratic(self, q: Array, task: _Task) -> LocalQuadraticModel:
        """Cost of a pass at `q`, with gradient and Gauss-Newton Hessian by the free joints."""
        out, by_q = self._corners(q)
        corners = out.reshape(-1, 2, 3)
        seen = task.points, task.camera, task.share
        surface = shape_evidence.nearest_surface_residuals(corners, self.link_radii, *seen)
        link, error = surface.link_indices, surface.signed_distance
        square = (error / task.scale) ** 2
        cost = 0.5 * task.scale**2 * float(np.sum(task.weight * square / (1 + square)))
        weight = task.weight / (1 + square) ** 2
        # sums over the points of each link, by the start and the end of its centre line
        order = np.argsort(link, kind="stable")
        block, apart = surface.jacobian_by_link_ends[order], error[order]
        weighted = block * weight[order, None]
        bounds = pairwise(np.searchsorted(link[order], np.arange(len(self.link_radii) + 1)))
        of_links = [slice(*edges) for edges in bounds]
        pull = np.array([apart[mine] @ weighted[mine] for mine in of_links])
        stiff = np.array([block[mine].T @ weighted[mine] for mine in of_links])
        gradient = by_q.T @ pull.ravel()
        hessian = by_q.T @ np.matmul(stiff, by_q.reshape(len(stiff), 6, -1)).reshape(by_q.shape)
        for anchor in task.anchors:
            end, towards = anchor.link_end_index, anchor.direction / anchor.position_std
            off = float(towards @ (corners.reshape(-1, 3)[end] - anchor.position))
            by_off = towards @ by_q[3 * end : 3 * end + 3]
            cost += 0.5 * off**2
            gradient += by_off * off
            hessian += np.outer(by_off, by_off)
        held, by_held = self._held(q)
        bend = (q - self.rest_configuration)[list(self.free_joints)] * self._prior
        cost += 0.5 * float(held.ravel() @ held.ravel() + bend @ bend)
        gradient += by_held.T @ held.ravel() + bend * self._prior
        hessian += by_held.T @ by_held + np.diag(self._prior**2)
        return LocalQuadraticModel(cost, gradient, hessian)

    def make_shape_guess_finder(self) -> ShapeGuessFinder:
        """Make a finder of initial shapes for a system with a free root (`shape_guesses.add_free_root_joints`)."""
        lengths = {name: self._lengths[self._links_of({name})] for name in dict.fromkeys(self.link_segments)}
        tree = self.system.mechanism_with_values(self._values)
        return ShapeGuessFinder(self.system, tree, self.rest_configuration, self.bend_joints, lengths)

    def _size_rows(
        self, q: Array, task: _Task, evidence: ShapeFitQualityAndPointClasses
    ) -> shape_evidence.QuadraticTubeDimensionCost:
        """Cost of tube lengths and radii in a frame, from the points of the pass `task` at the fitted shape `q`."""
        names = [segment.name for segment in self.system.segment_layouts]
        free, many = len(self.free_joints), len(names)
        corners, jacobian = self._links_at(q), self._corners(q)[1]
        by_length, seen_by_length, held_by_length = (np.array(x) for x in self._grown(q))
        chain = np.hstack([jacobian, by_length])
        total = free + 2 * many
        gradient, hessian = np.zeros(total), np.zeros((total, total))

        def add(rows: Array, error: Array, weight: Array) -> None:
            weighted = rows * weight[:, None]
            gradient[:] += weighted.T @ error
            hessian[:] += weighted.T @ rows

        depths = shape_evidence.surface_residuals_along_sight(corners, self.link_radii, task.points, task.camera)
        weight = task.weight[depths.point_indices] / (1 + (depths.signed_distance / task.scale) ** 2) ** 2
        segment = np.array([names.index(owner) for owner in self.link_segments])
        for k in range(len(self.link_radii)):
            mine = depths.link_indices == k
            rows = np.zeros((int(mine.sum()), total))
            rows[:, : free + many] = depths.jacobian_by_link_ends[mine] @ chain[6 * k : 6 * k + 6]
            rows[:, free + many + segment[k]] = depths.derivative_by_radius[mine] * self.link_radii[k]
            add(rows, depths.signed_distance[mine], weight[mine])
        for k, offset in zip(self.free_end_links, evidence.end_offsets, strict=True):
            if np.isfinite(offset):
                rows = np.zeros((1, total))
                rows[0, : free + many] = -shape_evidence.unit_link_axes(corners)[k] @ chain[6 * k + 3 : 6 * k + 6]
                noise = max(self.surface_noise_std, evidence.noise_std)
                add(rows, np.array([offset]), np.array([1.0 / noise**2]))
        held, by_held = self._held(q)
        add(np.hstack([by_held, held_by_length, np.zeros((len(held), many))]), held.ravel(), np.ones(len(held)))
        gradient[:free] += (q - self.rest_configuration)[list(self.free_joints)] * self._prior**2
        hessian[:free, :free] += np.diag(self._prior**2)
        # the bends follow: dq = -H_qq^-1 (g_q + H_qx x)
        both = np.column_stack([gradient, hessian[:, free:]])
        follow = np.linalg.solve(hessian[:free, :free], both[:free])
        left = both[free:] - hessian[free:, :free] @ follow
        moved = np.hstack([seen_by_length, np.zeros((len(seen_by_length), many))])
        moved = moved - self._seen(q)[1] @ follow[:, 1:]
        return shape_evidence.QuadraticTubeDimensionCost(left[:, 0], left[:, 1:], moved.reshape(-1, 3, 2 * many))

    def tube_links_at_configuration(self, q: Array) -> shape_evidence.TubeLinks:
        """Return the links of the object as tubes in the world at the configuration `q`."""
        return shape_evidence.TubeLinks(self._links_at(q), self.link_radii, self.free_end_links, self._tube_lengths)

    def gripper_positions_at_configuration(self, q: ArrayLike) -> Array:
        """Return the positions (grasps, 3) [m] of the grippers' frames at a configuration."""
        return self._holders(np.asarray(q, float))[0].reshape(-1, 3)

    def point_positions_at_configuration(self, q: ArrayLike) -> Array:
        """Return the positions (np, 3) [m] of the system's points at a configuration."""
        return self._seen(np.asarray(q, float))[0].reshape(-1, 3)


class _BestFit(NamedTuple):
    """Minimum of the passes: configuration, Hessian by the free joints, and cost."""

    q: Array
    hessian: Array
    cost: float


class _Task(NamedTuple):
    """One pass: points or nodes, their weights, distance from the axis in radii, loss scale, camera, observed ends."""

    points: Array
    weight: Array
    share: float
    scale: float
    camera: Array
    anchors: Sequence[ObservedObjectEnd]


def _symbolic_functions(system: System, free_joints: Sequence[int]) -> dict[str, ca.Function]:
    """Functions of the configuration and of all parameters, by name.

    `corners` (ends of the links), `seen` (points of the system) and `held` (errors of held frames, in standard
    deviations) have derivatives by the free joints as a second output. `grown` has the derivatives of these three by
    the logarithm of each tube's length. `gap`: errors of the grasps [m]; `holders`, `taken`: positions of their frames.
    """
    symbols, tree, (q, kinematics) = system.parameters.symbols, system.mechanism, system.symbols_and_kinematics
    corners = []
    for segment in system.segment_layouts:
        for i, names in enumerate(segment.link_joints):
            start = kinematics.joint_origins[tree.joint_index(names[0])]
            corners += [start, kinematics.frame_position(f"{segment.name}_{i}_tip")]
    rows, gaps = [ca.SX(0, 1)], [ca.SX(0, 1)]
    for grasp in system.grasps:
        residual, alignment = grasp.constraint_residual(kinematics), grasp.holder_minus_held_axis_directions(kinematics)
        gaps.append(residual[:3])
        rows.append(residual[:3] / _GRASP_POSITION_STD)
        if grasp.kind != "point":  # the first column of a weld is a roll, which stays unknown
            rows.append(alignment[-3:] / _GRASP_DIRECTION_STD)
    seen = ca.vertcat(*(kinematics.frame_position(name) for name in system.point_frames))
    full = {"corners": ca.vertcat(*corners), "seen": seen, "held": ca.vertcat(*rows)}
    outputs = {name: [entry, ca.jacobian(entry, q)[:, list(free_joints)]] for name, entry in full.items()}
    growth = ca.SX(symbols.numel(), len(system.segment_layouts))
    for k, segment in enumerate(system.segment_layouts):
        for symbol in ca.symvar(ca.vertcat(*segment.link_lengths)):
            index = system.parameters.names.index(symbol.name())
            growth[index, k] = symbols[index]
    outputs["grown"] = [ca.mtimes(ca.jacobian(entry, symbols), growth) for entry in full.values()]
    outputs["gap"] = [ca.vertcat(*gaps)]
    for name, frames in (("holders", "holder_frame"), ("taken", "held_frame")):
        places = (kinematics.frame_position(getattr(grasp, frames)) for grasp in system.grasps)
        outputs[name] = [ca.vertcat(ca.SX(0, 1), *places)]
    return {name: ca.Function(name, [q, symbols], [ca.densify(e) for e in ca.cse(of)]) for name, of in outputs.items()}
