"""Where the camera stands, how it scales depth, and what its clock says: from the arm that it sees.

The robot is the calibration target. A point p that the camera measured at its time s should lie on the robot's surface
at the joint angles of that time:

    P = t + R (g + o/z) p,      e = n . (P - surface(q(s - tau0 - beta (s - s0)))),

with the camera's pose (R, t), a scale g and an offset o of its depth z along the ray, and its clock, ahead by tau0 and
by beta in every second. All ten are estimated together over a sample of the frames, by Gauss-Newton steps on a robust
sum (Geman and McClure) of distances from points to planes of the robot's meshes (Chen and Medioni), about what is told
with wide normal priors, which decide where the arm's motion informs of nothing. The start is looked for among shifts of
the camera and offsets of the clock, by how near to the cloud the visible surface of the robot then lies.

The points' errors are alike, from pixel to pixel of a frame and, where a mesh is not quite the robot's surface, from
frame to frame at the same place of a link. The covariance is therefore the sandwich H^-1 B H^-1 with B summed over
frames and over patches of the links as wholes, not over points; data weigh against the priors by how much larger B is
than H.

References
----------
Chen and Medioni (1992), Image and Vision Computing 10:145, doi:10.1016/0262-8856(92)90066-C. Cameron, Gelbach and
Miller (2011), J. Business & Economic Statistics 29:238, doi:10.1198/jbes.2010.07136, for sums over two kinds of blocks.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
from annotated_types import Ge, Gt
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from yid_ocp.errors import DataError
from yid_ocp.options import About, check
from yid_ocp.vision.filters import voxel_grid
from yid_ocp.vision.frames import Pinhole
from yid_ocp.vision.meshes import Surfaces

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

TURN, SHIFT, SCALE, DEPTH, CLOCK, DRIFT = slice(0, 3), slice(3, 6), 6, 7, 8, 9
SIZE = 10

_VOXEL = 0.008  # [m]
_LOOK = Pinhole.of_view(120, 90, math.radians(75.0))  # through which the visible surface of the robot is sampled
_CELL = 0.02  # of the field of distances in which starts are tried [m]
_LATERAL, _AHEAD = 12, 10  # cells to either side, in steps of two, of starts tried
_SEARCH_STEP = 0.08  # of starts of the clock [s]
_CAPTURE = 0.06  # [m]; how near a start must come
_SAMPLES = 150  # of the visible surface, in every frame
_FIRST_FRAMES = 8  # in which starts are tried
_STARTS = 4
_REACHES = (0.08, 0.06, 0.045, 0.035, 0.03)  # of the points that count, from stage to stage [m]
_ROUNDS = 3  # of Gauss and Newton in each but the last
_LAST_ROUNDS = 12
_POINTS = 900  # of a frame
_FEWEST = 40
_STEP = 0.01  # over which velocities are taken [s]
_PATCH = 0.08  # of a link, over which its mesh is alike wrong [m]
_TO_SIGMA = 1.4826
_CUT = 2.5  # scale of the robust sum in standard deviations
_LEAST_SIGMA = 1e-3  # [m]
_APART = 0.08  # [m]; starts nearer together are one


@dataclass(frozen=True)
class CalibrationOptions:
    """What is known of the camera beforehand, and how the arm is used to know better."""

    fix_pose: Annotated[
        bool,
        About("whether the told pose and depth are kept, as by a hand-eye calibration; the arm then only checks them"),
    ] = False
    frames: Annotated[int, Ge(3), About("so many, spread over the sequence, are compared with the arm")] = 24
    turn_std: Annotated[float, Gt(0), About("standard deviation of the told pose's directions", "rad")] = 0.06
    shift_std: Annotated[float, Gt(0), About("of its place", "m")] = 0.04
    scale_std: Annotated[float, Gt(0), About("of the depth's scale about 1")] = 0.03
    depth_std: Annotated[float, Gt(0), About("of an offset of all depths", "m")] = 0.01
    drift_std: Annotated[float, Gt(0), About("of the rate of the camera's clock, relative to that of the joints")] = 1e-3
    search: Annotated[
        float, Ge(0), About("how far from `clock.offset` its offset is looked for; 0 to take it as it is", "s")
    ] = 0.5

    def __post_init__(self) -> None:
        check(self, "calibration options")


@dataclass(frozen=True, eq=False)
class CameraState:
    """What is estimated: pose (R, t), factor g and offset o [m] of measured depths, clock tau0 [s] and beta.

    Attributes
    ----------
    pose : ndarray, shape (4, 4)
    factor : float
        True over seen depth, without the offset.
    depth : float
        Added to a depth [m].
    offset : float
        Stamp minus joint time at the stamp `about` [s].
    drift : float
        Seconds of the camera per second of the joints, less one.
    about : float
        [s]
    """

    pose: Array
    factor: float
    depth: float
    offset: float
    drift: float
    about: float

    def world(self, points: Array) -> Array:
        """Measured points, shape (N, 3), in the world [m]."""
        corrected = points * (self.factor + self.depth / points[:, 2:3])
        return np.asarray(corrected @ self.pose[:3, :3].T + self.pose[:3, 3])

    def time(self, stamp: ArrayLike) -> Array:
        """Joint time of a stamp [s]."""
        at = np.asarray(stamp, float)
        return np.asarray(at - self.offset - self.drift * (at - self.about))

    def slopes(self, points: Array) -> Array:
        """Derivatives of world points by pose and depth, shape (N, 3, 8)."""
        away = points - self.pose[:3, 3]
        depth = away @ self.pose[:3, 2]
        result = np.zeros((len(points), 3, CLOCK))
        result[:, 0, 1], result[:, 0, 2] = away[:, 2], -away[:, 1]
        result[:, 1, 0], result[:, 1, 2] = -away[:, 2], away[:, 0]
        result[:, 2, 0], result[:, 2, 1] = away[:, 1], -away[:, 0]
        result[:, :, SHIFT] = np.eye(3)
        result[:, :, SCALE] = away
        result[:, :, DEPTH] = away / np.maximum(np.abs(depth), 0.1)[:, None]
        return result

    def moved(self, x: Array) -> CameraState:
        """After a change x, shape (10,)."""
        pose = self.pose.copy()
        pose[:3, :3] = Rotation.from_rotvec(x[TURN]).as_matrix() @ pose[:3, :3]
        pose[:3, 3] += x[SHIFT]
        return replace(
            self,
            pose=pose,
            factor=self.factor * math.exp(float(x[SCALE])),
            depth=self.depth + float(x[DEPTH]),
            offset=self.offset + float(x[CLOCK]),
            drift=self.drift + float(x[DRIFT]),
        )

    def minus(self, other: CameraState) -> Array:
        """The change from another state, shape (10,)."""
        turn = Rotation.from_matrix(self.pose[:3, :3] @ other.pose[:3, :3].T).as_rotvec()
        rest = [
            math.log(self.factor / other.factor),
            self.depth - other.depth,
            self.offset - other.offset,
            self.drift - other.drift,
        ]
        return np.concatenate([turn, self.pose[:3, 3] - other.pose[:3, 3], rest])


@dataclass(frozen=True, eq=False)
class Glimpse:
    """One frame of the sample: its stamp [s] and points in the camera's frame, shape (N, 3) [m]."""

    stamp: float
    points: Array


class Arm:
    """The robot's surface along its recorded motion.

    Parameters
    ----------
    robot : Surfaces
    posture : callable
        From a time on the joints' clock to a configuration.
    """

    def __init__(self, robot: Surfaces, posture: Callable[[float], Array]) -> None:
        self.robot, self.posture = robot, posture
        self.moving = np.array([joint >= 0 for joint in robot.joints])

    def poses(self, t: float) -> Array:
        """Poses of the parts, shape (parts, 4, 4)."""
        return self.robot.poses(self.posture(t))

    def visible(self, state: CameraState, stamp: float) -> tuple[Array, Integers]:
        """Points of moving surfaces that the camera would see, in the world, and their parts."""
        depth, cosine, part = self.robot.cast(_LOOK, state.pose, self.posture(float(state.time(stamp))))
        seen = np.isfinite(depth) & (cosine > 0.2) & (part >= 0)
        seen &= self.moving[part]
        points = _LOOK.rays[seen] * depth[seen][:, None]
        return points @ state.pose[:3, :3].T + state.pose[:3, 3], part[seen]

    def rows(self, state: CameraState, glimpse: Glimpse, reach: float) -> Rows:
        """Linear equations of the points within reach."""
        t = float(state.time(glimpse.stamp))
        points = state.world(glimpse.points)
        distance, normal, part = self.robot.closest(points, self.posture(t), reach)
        near = np.flatnonzero(part >= 0)
        behind, now, ahead = (self.poses(t + d)[part[near]] for d in (-_STEP, 0.0, _STEP))
        local = np.einsum("nji,nj->ni", now[:, :3, :3], points[near] - now[:, :3, 3])
        moved = np.einsum("nij,nj->ni", ahead[:, :3, :3] - behind[:, :3, :3], local)
        velocity = (moved + ahead[:, :3, 3] - behind[:, :3, 3]) / (2 * _STEP)
        rate = np.einsum("ni,ni->n", normal[near], velocity)
        slope = np.empty((len(near), SIZE))
        slope[:, :CLOCK] = np.einsum("ni,nij->nj", normal[near], state.slopes(points[near]))
        # a later offset takes the surface back along its velocity, away from the point
        slope[:, CLOCK] = rate
        slope[:, DRIFT] = rate * (glimpse.stamp - state.about)
        cells = np.floor(local / _PATCH).astype(np.int64)
        return Rows(slope, distance[near], np.column_stack([part[near], cells]))


@dataclass(frozen=True, eq=False)
class Rows:
    """Points near the arm: derivatives (N, 10) of their distances, these (N,) [m], and where on which link (N, 4)."""

    slope: Array
    distance: Array
    patch: Integers


@dataclass(frozen=True, eq=False)
class _Sum:
    """The robust sum about a state: gradient, Hessian, sums over frames and patches of outer products, points."""

    gradient: Array
    hessian: Array
    blocks: Array
    sigma: float
    count: int


def _summed(rows: Sequence[Rows], reach: float) -> _Sum:
    distance = np.concatenate([r.distance for r in rows])
    sigma = max(_TO_SIGMA * float(np.median(distance)) if len(distance) else reach, _LEAST_SIGMA)
    scale = min(_CUT * sigma, reach)
    gradient, hessian, blocks = np.zeros(SIZE), np.zeros((SIZE, SIZE)), np.zeros((SIZE, SIZE))
    patches: dict[bytes, Array] = {}
    bent, straight = 0.0, 0.0
    for r in rows:
        square = (r.distance / scale) ** 2
        weight = 1 / (1 + square) ** 2 / sigma**2
        score = r.slope * (weight * r.distance)[:, None]
        hessian += r.slope.T @ (weight[:, None] * r.slope)
        frame = score.sum(axis=0)
        gradient += frame
        blocks += np.outer(frame, frame)
        straight += float(weight.sum())
        bent += float((weight * (1 - 3 * square) / (1 + square)).sum())
        if len(r.patch):
            cells, index = np.unique(r.patch, axis=0, return_inverse=True)
            for k, cell in enumerate(cells):
                key = cell.tobytes()
                patches[key] = patches.get(key, np.zeros(SIZE)) + score[index.ravel() == k].sum(axis=0)
    for total in patches.values():
        blocks += np.outer(total, total)
    # the curvature of the robust sum is less than its weights say
    share = max(bent / max(straight, 1e-12), 0.2)
    return _Sum(gradient, hessian * share, blocks, sigma, len(distance))
