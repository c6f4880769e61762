"""Registration of a camera's pose, depth and clock to the robot in its view.

A point p that the camera measured at its time s should lie on the robot's surface at the joint angles of that time:

    P = t + R (g + o/z) p,      e = n . (P - surface(q(s - tau0 - beta (s - s0)))).

(R, t) is the camera's pose, g a factor and o an offset of its depth z along the ray. Its clock is ahead by tau0, and by
beta in every second. The surface point is the intersection of the robot with the camera's ray through P, or the nearest
surface point, which converges from further away. Gauss-Newton minimises a robust sum (Geman and McClure) of e, with a
normal prior about the specified values.

Errors are correlated between pixels of a frame, and between frames at one location of a link. The covariance is the
sandwich H^-1 B H^-1. B is summed over frames and over patches of the links as clusters, minus the sum over patches in
each frame. The data are weighted against the prior by the ratio of H to B.

References
----------
Chen and Medioni (1992), Image and Vision Computing 10:145, doi:10.1016/0262-8856(92)90066-C. Blais and Levine (1995),
IEEE Trans. Pattern Analysis 17:820, doi:10.1109/34.400574, for points along the camera's rays. Cameron, Gelbach and
Miller (2011), J. Business & Economic Statistics 29:238, doi:10.1198/jbes.2010.07136, for sums over two kinds of blocks.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import eigh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from yid_ocp.arrays import Array, BoolArray, IntArray
from yid_ocp.vision.frames import CameraIntrinsics
from yid_ocp.vision.point_cloud import MAD_TO_STD
from yid_ocp.vision.surface_meshes import ArticulatedSurfaces

ROTATION_SLICE, TRANSLATION_SLICE = slice(0, 3), slice(3, 6)
DEPTH_SCALE_INDEX, DEPTH_OFFSET_INDEX, CLOCK_OFFSET_INDEX, CLOCK_DRIFT_INDEX = 6, 7, 8, 9
"""Positions of the parts of a `CameraState` change in its vector."""
CAMERA_STATE_SIZE, MIN_ARM_POINTS_PER_FRAME = 10, 40

# through which the robot's visible surface is sampled
_START_INTRINSICS = CameraIntrinsics.from_field_of_view(160, 120, math.radians(80.0))
_SURFACE_SAMPLES = 150  # samples of the arm's surface per frame
_GRID_CELL_SIZE = 0.02  # cell size of the distance field for initial states [m]
_SIDEWAYS_CELLS, _FORWARD_CELLS, _CELL_STRIDE = 12, 10, 2  # cells to either side of starts tried, and between them
_CLOCK_STEP = 0.08  # between starts of the clock [s]
_MAX_START_DISTANCE = 0.06  # how near to the cloud a start must bring the surface [m]
_HIDDEN_SAMPLE_COST = 0.5  # relative cost of a sample out of view; a sample in view without a near point costs one
_MAX_STARTS = 4
_MIN_START_SEPARATION = 0.08  # starts nearer together are one [m]
_MIN_INCIDENCE_COSINE = 0.3  # cosine of ray and normal below which a point is not used
_VELOCITY_TIME_STEP = 0.01  # over which velocities are taken [s]
_MESH_ERROR_PATCH_SIZE = 0.08  # size of a link's patch with a common mesh error [m]
_ROBUST_SCALE_STDS = 2.5  # scale of the robust sum in standard deviations
_MIN_POINT_STD = 1e-3  # [m]
_MIN_CURVATURE_FRACTION = 0.2  # lower bound of the robust sum's curvature, relative to that of its weights


@dataclass(frozen=True, eq=False)
class CameraState:
    """The estimated state of a camera: pose, depth scale and offset, clock offset and drift."""

    pose: Array  # (4, 4), camera in the world, R and t
    depth_scale: float = 1.0  # factor g on a measured depth
    depth_offset: float = 0.0  # offset o added to the scaled depth [m]
    clock_offset: float = 0.0  # stamp minus joint time at the stamp `clock_reference_stamp`, tau0 [s]
    clock_drift: float = 0.0  # growth of the clock offset per second, beta
    clock_reference_stamp: float = 0.0  # stamp s0 at which the clock offset is tau0 [s]

    def measured_to_world_points(self, points: Array) -> Array:
        """Transform measured points (N, 3) [m] from the camera's frame to the world."""
        placed = np.asarray(points @ self.pose[:3, :3].T)
        if self.depth_scale != 1.0 or self.depth_offset != 0.0:
            placed *= (self.depth_scale + self.depth_offset / points[:, 2])[:, None]
        placed += self.pose[:3, 3]
        return placed

    def world_to_measured_points(self, points: Array) -> Array:
        """Transform world points (N, 3) [m] to the points that the camera would measure, in its own frame."""
        own = (points - self.pose[:3, 3]) @ self.pose[:3, :3]
        return np.asarray(own * ((1.0 - self.depth_offset / own[:, 2:3]) / self.depth_scale))

    def stamps_to_joint_clock(self, stamp: ArrayLike) -> Array:
        """Convert camera time stamps to the clock of the joint recording [s]."""
        at = np.asarray(stamp, float)
        return np.asarray(at - self.clock_offset - self.clock_drift * (at - self.clock_reference_stamp))

    def world_point_jacobian_by_pose_and_depth(self, points: Array) -> Array:
        """Compute the Jacobian (N, 3, 8) of world points (N, 3) by rotation, position and depth (log scale, offset)."""
        away = points - self.pose[:3, 3]
        ahead = away @ self.pose[:3, 2]
        result = np.zeros((len(points), 3, CLOCK_OFFSET_INDEX))
        result[:, :, ROTATION_SLICE] = np.cross(np.eye(3), away[:, None]).transpose(0, 2, 1)
        result[:, :, TRANSLATION_SLICE] = np.eye(3)
        result[:, :, DEPTH_SCALE_INDEX] = away
        result[:, :, DEPTH_OFFSET_INDEX] = away / ahead[:, None]
        return result

    def with_state_increment(self, change: Array) -> CameraState:
        """Return a copy plus `change` (10,): rotation, position, depth (log scale, offset), clock (offset, drift)."""
        pose = self.pose.copy()
        pose[:3, :3] = Rotation.from_rotvec(change[ROTATION_SLICE]).as_matrix() @ pose[:3, :3]
        pose[:3, 3] += change[TRANSLATION_SLICE]
        scale, offset, clock, drift = map(float, change[DEPTH_SCALE_INDEX:])
        depth = self.depth_scale * math.exp(scale), self.depth_offset + offset
        clocks = self.clock_offset + clock, self.clock_drift + drift, self.clock_reference_stamp
        return CameraState(pose, *depth, *clocks)

    def state_increment_from(self, other: CameraState) -> Array:
        """Return this state minus another one, (10,): the increment that leads from the other state to this one."""
        turn = Rotation.from_matrix(self.pose[:3, :3] @ other.pose[:3, :3].T).as_rotvec()
        moved, scale = self.pose[:3, 3] - other.pose[:3, 3], math.log(self.depth_scale / other.depth_scale)
        clock = self.clock_offset - other.clock_offset, self.clock_drift - other.clock_drift
        return np.array([*turn, *moved, scale, self.depth_offset - other.depth_offset, *clock])


@dataclass(frozen=True, eq=False)
class StampedCloud:
    """A frame of a depth camera: its time stamp [s] and its points (N, 3) [m] in the camera's frame."""

    stamp: float
    points: Array

    @cached_property
    def _trees(self) -> tuple[cKDTree, cKDTree]:
        return cKDTree(self.points), cKDTree(self.points[:, :2] / self.points[:, 2:])


class _CalibrationEquations(NamedTuple):
    """Linearised calibration equations of one frame's points near the arm, one row for each point."""

    jacobian: Array
    residuals: Array
    patch_indices: IntArray


@dataclass(frozen=True, eq=False)
class MovingArmSurface:
    """The surface of the robot along its recorded motion."""

    robot_surfaces: ArticulatedSurfaces
    configuration_at: Callable[[float], Array]  # function of the joints' time
    # grasp positions (G, 3) [m] at a configuration; points within the radius [m] of one may belong to the object
    grasp_positions_at: Callable[[Array], Array]
    grasp_exclusion_radius: float

    @cached_property
    def _moving(self) -> BoolArray:
        return np.array([joint >= 0 for joint in self.robot_surfaces.part_joints])

    def _part_poses_at_time(self, t: float) -> Array:
        return self.robot_surfaces.part_poses_at_configuration(self.configuration_at(t))

    def visible_surface_points_and_parts(self, state: CameraState, stamp: float) -> tuple[Array, IntArray]:
        """Return world points (N, 3) on moving surfaces that an unobstructed camera sees, and their surface parts."""
        q = self.configuration_at(float(state.stamps_to_joint_clock(stamp)))
        depth, cosine, part = self.robot_surfaces.render_depth_incidence_and_part(_START_INTRINSICS, state.pose, q)
        seen = np.isfinite(depth) & (cosine > _MIN_INCIDENCE_COSINE) & (part >= 0) & self._moving[part]
        points = _START_INTRINSICS.pixel_rays_at_unit_depth[seen] * depth[seen][:, None]
        return points @ state.pose[:3, :3].T + state.pose[:3, 3], part[seen]

    def near_moving_surface_off_grasps_mask(self, points: Array, t: float, within: float) -> BoolArray:
        """Check for each world point (N, 3) whether it is `within` [m] of a moving surface and not near a grasp."""
        q = self.configuration_at(t)
        result = self.robot_surfaces.within_surface_distance_mask(points, q, within, moving_only=True)
        for held in self.grasp_positions_at(q):
            result &= np.linalg.norm(points - held, axis=1) > self.grasp_exclusion_radius
        return np.asarray(result)

    def match_points_to_surface(
        self, points: Array, origin: Array, t: float, reach: float, along: bool
    ) -> _SurfaceMatches:
        """Match world points (N, 3) to the arm's surface within `reach`, along camera rays (`along`) or the nearest."""
        q = self.configuration_at(t)
        if along:
            ahead = points - origin
            distance, normal, part = self.robot_surfaces.intersect_rays(origin, ahead, q)
            square = -np.einsum("ij,ij->i", normal, ahead)
            with np.errstate(invalid="ignore"):  # rays without an intersection
                error = (distance - 1.0) * square  # n . (P - (origin + d (P - origin)))
            kept = (square > _MIN_INCIDENCE_COSINE * np.linalg.norm(ahead, axis=1)) & (np.abs(error) < reach)
        else:
            error, normal, part = self.robot_surfaces.nearest_moving_surfaces(points, q, reach)
            kept = np.ones(len(points), bool)
        chosen = np.flatnonzero(kept & (part >= 0) & self._moving[part])
        times = (t - _VELOCITY_TIME_STEP, t, t + _VELOCITY_TIME_STEP)
        behind, now, later = (self._part_poses_at_time(at)[part[chosen]] for at in times)
        local = np.einsum("nji,nj->ni", now[:, :3, :3], points[chosen] - now[:, :3, 3])
        moved = np.einsum("nij,nj->ni", later[:, :3, :3] - behind[:, :3, :3], local)
        velocity = (moved + later[:, :3, 3] - behind[:, :3, 3]) / (2 * _VELOCITY_TIME_STEP)
        rate = np.einsum("ni,ni->n", normal[chosen], velocity)
        return _SurfaceMatches(chosen, error[chosen], normal[chosen], rate, part[chosen], local)

    def linearized_surface_distances(
        self, state: CameraState, frame: StampedCloud, reach: float, along: bool
    ) -> _CalibrationEquations:
        """Linearise the distances [m] of a frame's points from the arm by the camera state. `along`: camera rays."""
        points, t = state.measured_to_world_points(frame.points), float(state.stamps_to_joint_clock(frame.stamp))
        met = self.match_points_to_surface(points, state.pose[:3, 3], t, reach, along)
        slope = np.empty((len(met.point_indices), CAMERA_STATE_SIZE))
        by_camera = state.world_point_jacobian_by_pose_and_depth(points[met.point_indices])
        slope[:, :CLOCK_OFFSET_INDEX] = np.einsum("ni,nij->nj", met.normal, by_camera)
        # a later offset takes the surface back along its velocity, away from the point
        slope[:, CLOCK_OFFSET_INDEX] = met.normal_velocity
        slope[:, CLOCK_DRIFT_INDEX] = met.normal_velocity * (frame.stamp - state.clock_reference_stamp)
        patch = np.column_stack([met.part, np.floor(met.part_coordinates / _MESH_ERROR_PATCH_SIZE).astype(np.int64)])
        return _CalibrationEquations(slope, met.normal_distance, patch)


class _SurfaceMatches(NamedTuple):
    """Points matched to the arm: index, normal distance e [m], normal, normal velocity [m/s], part, local position."""

    point_indices: IntArray
    normal_distance: Array
    normal: Array
    normal_velocity: Array
    part: IntArray
    part_coordinates: Array


@dataclass(frozen=True, eq=False)
class RobustCostDerivatives:
    """The gradient and Hessian of the robust cost at a camera state, and the covariance of the gradient."""

    gradient: Array  # (10,)
    hessian: Array  # (10, 10), of Gauss and Newton
    curvature_ratio: float  # curvature of the robust sum, relative to the Hessian
    # (10, 10): outer products of gradients, summed over frames plus over patches minus over each patch in each frame
    # (counted twice), and at least the last sum (two-way clusters of Cameron, Gelbach and Miller 2011)
    score_covariance: Array

    def scaled_hessian_gradient_and_data_weight(self, precision: Array) -> tuple[Array, Array, float]:
        """Return weighted Hessian and gradient, and this weight of the data. `precision`: inverse prior covariance."""
        scale = 1.0 / np.sqrt(np.diag(self.hessian) + np.diag(precision))
        whole = (self.hessian + 1e-6 * precision) * np.outer(scale, scale)
        excess = np.linalg.solve(whole, self.score_covariance * np.outer(scale, scale))
        weight = 1.0 / max(1.0, float(np.trace(excess)) / CAMERA_STATE_SIZE)
        return weight * self.hessian, weight * self.gradient, weight

    def state_covariance(self, precision: Array) -> Array:
        """Compute the covariance (10, 10) of the state that minimises the cost of data and prior."""
        hessian, _, weight = self.scaled_hessian_gradient_and_data_weight(precision)
        bread = np.linalg.inv(self.curvature_ratio * hessian + precision)
        return np.asarray(bread @ (weight**2 * self.score_covariance + precision) @ bread)


def robust_cost_derivatives(rows: Sequence[_CalibrationEquations], reach: float) -> RobustCostDerivatives:
    """Return the derivatives of the robust cost of all frames' points. The median error sets the scale of the cost."""
    jacobian, residuals, patches = (np.concatenate(parts) for parts in zip(*rows, strict=True))
    sigma = max(MAD_TO_STD * float(np.median(np.abs(residuals))) if len(residuals) else reach, _MIN_POINT_STD)
    square = (residuals / min(_ROBUST_SCALE_STDS * sigma, reach)) ** 2
    weight = 1 / (1 + square) ** 2 / sigma**2
    scores = jacobian * (weight * residuals)[:, None]
    bent, blocks = float((weight * (1 - 3 * square) / (1 + square)).sum()), np.zeros((CAMERA_STATE_SIZE,) * 2)
    if len(residuals):
        frame = np.repeat(np.arange(len(rows)), [len(r.residuals) for r in rows])
        patch = np.unique(patches, axis=0, return_inverse=True)[1].ravel()

        def summed(group: IntArray) -> Array:
            totals = np.stack([np.bincount(group, column) for column in scores.T], axis=1)
            return np.asarray(totals.T @ totals)

        both = summed(frame * (patch.max() + 1) + patch)
        blocks = _at_least(both, summed(frame) + summed(patch) - both)
    curvature = max(bent / max(float(weight.sum()), 1e-12), _MIN_CURVATURE_FRACTION)
    return RobustCostDerivatives(scores.sum(axis=0), jacobian.T @ (weight[:, None] * jacobian), curvature, blocks)


def _at_least(least: Array, matrix: Array) -> Array:
    """The symmetric `matrix`, enlarged where it is smaller in some direction than the positive definite one `least`."""
    base = least + 1e-12 * np.diag(np.diag(least)) + 1e-300 * np.eye(len(least))
    values, vectors = eigh(matrix, base)
    back = vectors.T @ base  # the inverse of the vectors, which are orthonormal in the base
    return np.asarray(back.T @ (np.maximum(values, 1.0)[:, None] * back))


def candidate_camera_states(
    arm: MovingArmSurface, frames: Sequence[StampedCloud], specified: CameraState, search: float
) -> list[CameraState]:
    """Find candidate camera states that place the arm's visible surface on the clouds, best first.

    Returns at most `_MAX_STARTS` states, at least `_MIN_START_SEPARATION` apart. Their clock offsets differ from that
    of the specified state by at most `search` [s].
    """
    steps = math.ceil(search / _CLOCK_STEP)
    delays = np.linspace(-search, search, 2 * steps + 1) if steps else np.zeros(1)
    sides, ahead = (np.arange(-n, n + 1, _CELL_STRIDE) for n in (_SIDEWAYS_CELLS, _FORWARD_CELLS))
    cells = np.stack(np.meshgrid(sides, sides, ahead, indexing="ij"), axis=-1).reshape(-1, 3)
    total = np.zeros((len(delays), len(cells)))
    for glimpse in frames:
        _add_costs(total, arm, specified, glimpse, delays, cells)
    result: list[CameraState] = []
    for index in np.argsort(total, axis=None):
        delay, cell = np.unravel_index(index, total.shape)
        change = np.zeros(CAMERA_STATE_SIZE)
        # the cloud moves opposite to the surface's displacement by cells
        change[TRANSLATION_SLICE] = -specified.pose[:3, :3] @ (_GRID_CELL_SIZE * cells[cell])
        change[CLOCK_OFFSET_INDEX] = delays[delay]
        trial = specified.with_state_increment(change)
        between = [trial.state_increment_from(other) for other in result]
        apart = [np.linalg.norm(d[TRANSLATION_SLICE]) + 0.5 * abs(d[CLOCK_OFFSET_INDEX]) for d in between]
        if min(apart, default=math.inf) >= _MIN_START_SEPARATION:
            result.append(trial)
        if len(result) == _MAX_STARTS:
            break
    return result


def _add_costs(
    total: Array, arm: MovingArmSurface, told: CameraState, glimpse: StampedCloud, delays: Array, cells: IntArray
) -> None:
    """Add a frame's costs to `total` (delays, cells), with the arm `delays` [s] earlier and shifted by the cells."""
    from scipy.ndimage import distance_transform_edt  # slow to import; only needed to search for the camera's pose

    points, part = arm.visible_surface_points_and_parts(told, glimpse.stamp)
    own = told.world_to_measured_points(points)
    at, towards = (p[:, :2] / p[:, 2:] for p in (glimpse.points, own))
    view = np.array([at.min(axis=0), at.max(axis=0)])
    chosen = np.flatnonzero(((towards >= view[0]) & (towards <= view[1])).all(axis=1))
    if len(chosen) < MIN_ARM_POINTS_PER_FRAME:
        return
    chosen = chosen[np.linspace(0, len(chosen) - 1, min(len(chosen), _SURFACE_SAMPLES)).astype(np.int64)]
    points, part, own = points[chosen], part[chosen], own[chosen]
    # distance field with margins for the shifts and for the arm's motion
    edge = np.array([_SIDEWAYS_CELLS, _SIDEWAYS_CELLS, _FORWARD_CELLS])
    margin = _GRID_CELL_SIZE * (edge + 2) + 0.2
    low = own.min(axis=0) - margin
    shape = np.ceil((own.max(axis=0) + margin - low) / _GRID_CELL_SIZE).astype(int) + 1
    cell = np.floor((glimpse.points - low) / _GRID_CELL_SIZE).astype(int)
    cell = cell[((cell >= 0) & (cell < shape)).all(axis=1)]
    if not len(cell):
        return
    empty = np.ones(shape, bool)
    empty[tuple(cell.T)] = False
    x, y, z = (low[axis] + _GRID_CELL_SIZE * (np.arange(shape[axis]) + 0.5) for axis in range(3))
    depth = np.maximum(z, _GRID_CELL_SIZE)
    u, v = x[:, None, None] / depth, y[:, None] / depth
    outside = (u < view[0, 0]) | (u > view[1, 0]) | (v < view[0, 1]) | (v > view[1, 1])
    distance = np.minimum(distance_transform_edt(empty, sampling=_GRID_CELL_SIZE), _MAX_START_DISTANCE)
    flat = np.where(outside, _HIDDEN_SAMPLE_COST, (distance / _MAX_START_DISTANCE) ** 2).astype(np.float32).ravel()
    t = float(told.stamps_to_joint_clock(glimpse.stamp))
    before = arm._part_poses_at_time(t)[part]
    local = np.einsum("nji,nj->ni", before[:, :3, :3], points - before[:, :3, 3])
    strides = np.array([shape[1] * shape[2], shape[2], 1])
    for row, delay in zip(total, delays, strict=True):
        then = arm._part_poses_at_time(t - delay)[part]
        own = told.world_to_measured_points(np.einsum("nij,nj->ni", then[:, :3, :3], local) + then[:, :3, 3])
        index = np.clip(np.floor((own - low) / _GRID_CELL_SIZE).astype(np.int64), edge, shape - 1 - edge)
        row += flat[(index @ strides)[None, :] + (cells @ strides)[:, None]].mean(axis=1)


@dataclass(frozen=True)
class SurfaceObservationFractions:
    """The fractions of the arm's visible surface at which a point was measured on it, in front of it or behind it."""

    there: float  # fraction with measured points on it
    covered: float  # fraction with measured points in front of it
    through: float  # fraction with measured points behind it
    samples: int  # number of surface points that were compared


def seen_occluded_and_seen_through_surface_fractions(
    arm: MovingArmSurface, frames: Sequence[StampedCloud], state: CameraState, within: float
) -> SurfaceObservationFractions:
    """Return the fractions of the arm's visible surface with points on it (`within` [m]), in front of or behind it."""
    counts = np.zeros(4)
    for glimpse in frames:
        points, _ = arm.visible_surface_points_and_parts(state, glimpse.stamp)
        own, (places, rays) = state.world_to_measured_points(points), glimpse._trees
        away, _ = places.query(own, distance_upper_bound=within)
        # as wide as the gaps between points of a thinned cloud
        apart, index = rays.query(own[:, :2] / own[:, 2:], distance_upper_bound=0.015)
        near, known = np.isfinite(away), np.isfinite(apart)
        depth = glimpse.points[np.minimum(index, len(glimpse.points) - 1), 2]
        through = known & ~near & (depth > own[:, 2] + within)
        covered = known & ~near & (depth < own[:, 2] - within)
        counts += [np.count_nonzero(x) for x in (near, covered, through, known | near)]
    there, covered, through = (float(share) for share in counts[:3] / max(counts[3], 1.0))
    return SurfaceObservationFractions(there, covered, through, int(counts[3]))
