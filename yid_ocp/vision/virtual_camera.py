"""A virtual depth camera: clouds of a robot and its object as a structured-light sensor would see them.

Noise and steps are even in the pattern's disparity d = f b / z [pixels]; in depth they are dz = z^2/(f b) dd.

References
----------
Khoshelham & Elberink (2012), Sensors 12:1437, doi:10.3390/s120201437, equations (5) and (10).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline

from yid_ocp.arrays import Array, BoolArray
from yid_ocp.errors import ConfigError
from yid_ocp.model.rotations import homogeneous_transform
from yid_ocp.vision.frames import XTION_INTRINSICS, CameraIntrinsics, FrameSequence, validated_camera_pose
from yid_ocp.vision.surface_meshes import (
    ArticulatedSurfaces,
    CameraScene,
    TriangleMesh,
    load_robot_meshes,
    tube_meshes_by_joint,
)

_FLOOR_AND_WALL = (([8.0, 8.0, 0.02], [1.0, 0.0, -0.94]), ([0.02, 8.0, 3.0], [-0.61, 0.0, 0.5]))
"""Edges and middles of thin boxes [m]."""


_PERIOD_JITTER = 0.25  # share of its mean by which a period varies either way


@dataclass(frozen=True)
class DepthCamera:
    """Geometry and errors of a structured-light depth camera; the defaults are an Asus Xtion Pro Live."""

    intrinsics: CameraIntrinsics = XTION_INTRINSICS
    baseline: float = 0.075  # between projector and camera, along x [m]
    # range of depths that it measures [m]
    min_depth: float = 0.8
    max_depth: float = 3.5
    disparity_std: float = 1 / 16  # standard deviation of the disparity [pixels]; 1/16 gives 6 mm at 2 m
    disparity_step: float = 1 / 8  # step of the disparity [pixels]; 1/8 gives 12 mm at 2 m
    noise_correlation_length: float = 0.7  # over how many pixels neighbouring errors are alike [pixels]
    # cosine of ray and normal below which nothing comes back; up to twice as much it comes back sometimes
    min_incidence_cosine: float = 0.12
    # difference in depth of neighbouring pixels that makes an edge, relative to depth
    min_relative_edge_depth: float = 0.02
    # probability that a pixel at an edge is lost, or lies anywhere between front and back
    edge_loss_probability: float = 0.6
    edge_mixing_probability: float = 0.05
    loss_probability: float = 0.01  # probability that any pixel is lost
    # probability that a pixel's pattern is matched wrongly: its depth is then anywhere within `outlier_depth_range`
    outlier_probability: float = 0.0
    outlier_depth_range: float = 0.4  # [m], to either side of the true depth

    def _simulate_depth_image(self, depth: Array, cosine: Array, rng: np.random.Generator) -> Array:
        """Measured depth image [m], NaN where nothing was measured.

        From the true one [m], infinite where there is nothing, and the cosine of ray and normal, all (height, width).
        """
        from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter  # slow to import

        scale = self.intrinsics.fx * self.baseline
        shape = depth.shape
        white = rng.standard_normal(shape)
        if self.noise_correlation_length > 0:
            white = gaussian_filter(white, self.noise_correlation_length, mode="wrap")
            white /= white.std()
        chance = rng.random((4, *shape))
        far = np.where(np.isfinite(depth), depth, 1e3)
        front, back = minimum_filter(far, size=3), maximum_filter(far, size=3)
        edge = back - front > self.min_relative_edge_depth * front
        mixed = edge & (chance[0] < self.edge_mixing_probability) & (back < self.max_depth)
        true = np.where(mixed, front + rng.random(shape) * (back - front), far)
        wrong = chance[1] < self.outlier_probability
        true = np.where(wrong, true + self.outlier_depth_range * rng.uniform(-1.0, 1.0, shape), true)
        disparity = scale / np.maximum(true, 1e-3) + self.disparity_std * white
        if self.disparity_step > 0:
            disparity = np.rint(disparity / self.disparity_step) * self.disparity_step
        measured = scale / np.maximum(disparity, 1e-6)
        lost = (np.minimum(far, measured) < self.min_depth) | (np.maximum(far, measured) > self.max_depth)
        lost |= cosine < self.min_incidence_cosine * (1.0 + chance[2])
        lost |= edge & ~mixed & (chance[0] > 1.0 - self.edge_loss_probability)
        lost |= chance[3] < self.loss_probability
        lost |= self._shadow(far)
        return np.where(lost, np.nan, measured)

    def _shadow(self, depth: Array) -> BoolArray:
        """Pixels that the projector, on the camera's left, does not reach: another one of its line is nearer."""
        if self.baseline <= 0:
            return np.zeros(depth.shape, bool)
        disparity = self.intrinsics.fx * self.baseline / depth
        height, width = depth.shape
        margin = math.ceil(float(disparity.max())) + 1
        # the projector stands at x = -baseline, so that its image of a pixel lies to the right by the disparity
        column = np.rint(np.arange(width) + disparity).astype(np.int64)
        flat = np.arange(height)[:, None] * (width + margin + 1) + np.minimum(column, width + margin)
        nearest = np.zeros(height * (width + margin + 1))
        np.maximum.at(nearest, flat.ravel(), disparity.ravel())
        return np.asarray(disparity < nearest[flat] - 1.0)


@dataclass(frozen=True)
class FrameTiming:
    """Timing model of a camera: frame rate, dropped frames and errors of time stamps."""

    mean_rate: float = 3.0  # mean rate [Hz]
    dropped_fraction: float = 0.0  # share of frames that never arrive
    # by how much every stamp is later than the picture, and the camera's clock ahead, taken together [s]
    latency: float = 0.0
    latency_std: float = 0.0  # standard deviation of the latency from frame to frame [s]

    def _sample_times_and_stamps(self, start: float, stop: float, rng: np.random.Generator) -> tuple[Array, Array]:
        """Times of the pictures that arrive and their stamps, both shape (M,) [s]."""
        if not self.mean_rate > 0:
            raise ConfigError(f"mean_rate = {self.mean_rate}", allowed="mean_rate > 0")
        count = math.ceil((stop - start) * self.mean_rate / (1 - _PERIOD_JITTER)) + 2
        taken = start + np.cumsum(rng.uniform(1 - _PERIOD_JITTER, 1 + _PERIOD_JITTER, count) / self.mean_rate)
        taken = taken[taken < stop]
        taken = taken[rng.random(len(taken)) >= self.dropped_fraction]
        return taken, taken + self.latency + self.latency_std * rng.standard_normal(len(taken))


@dataclass(frozen=True, eq=False)
class VirtualFrames:
    """Frame sequence of a virtual camera with the true times and configurations."""

    sequence: FrameSequence
    capture_times: Array  # (M,), time of every picture on the simulator's clock [s]
    true_configuration_at: Callable[[float], Array]  # from a time to the configuration then, shape (n,)


@dataclass(frozen=True, eq=False)
class VirtualCamera:
    """Virtual depth camera: sensor model, pose and frame timing."""

    pose: ArrayLike | None  # (4, 4), camera in the world (x right, y down, z ahead) [m]
    depth_camera: DepthCamera = field(default_factory=DepthCamera)  # an Asus Xtion Pro Live where absent
    timing: FrameTiming = field(default_factory=FrameTiming)
    seed: int = 0  # of all that is drawn at random


def render_virtual_frames(scene: CameraScene, t: ArrayLike, q: ArrayLike, camera: VirtualCamera) -> VirtualFrames:
    """Render the frames that a virtual camera takes of a motion, when they are loaded and the same every time.

    Configurations (N, n) at times (N,) [s] come from whatever simulator; between them a cubic spline interpolates.
    Where there is a robot, the paper's Y stands on a floor, and a wall stands behind Baxter.

    Raises
    ------
    DataError, ModelError
        No Open3D, no object, a mesh that cannot be read, or a pose that is none.
    """
    lens, pose = camera.depth_camera.intrinsics, validated_camera_pose(camera.pose, "sequence")
    times, path, rng = np.asarray(t, float), np.asarray(q, float), np.random.default_rng(camera.seed)
    taken, stamps = camera.timing._sample_times_and_stamps(float(times[0]), float(times[-1]), rng)
    course = CubicSpline(times, path, axis=0)
    configuration = np.asarray(course(taken))
    of = scene.system, scene.parameter_values
    tree, meshes = scene.system.numeric_mechanism(scene.parameter_values), tube_meshes_by_joint(*of)
    robot = load_robot_meshes(scene.robot_urdf, tree) if scene.robot_urdf is not None else {}
    around = [TriangleMesh.box(size).transformed(homogeneous_transform(np.eye(3), at)) for size, at in _FLOOR_AND_WALL]
    still = [*(around if robot else []), *([robot.pop(-1)] if -1 in robot else [])]
    surfaces = ArticulatedSurfaces(tree, meshes | robot | ({-1: TriangleMesh.concatenate(still)} if still else {}))

    def cloud(index: int) -> Array:
        depth, cosine, _ = surfaces.render_depth_image(lens, pose, configuration[index])
        rng = np.random.default_rng([camera.seed, index])
        return lens.points_from_depth(camera.depth_camera._simulate_depth_image(depth, cosine, rng))

    names = tuple(f"frame {i}" for i in range(len(taken)))
    made = FrameSequence(stamps, names, pose, cloud, lens, "virtual camera")
    return VirtualFrames(made, taken, lambda at: np.asarray(course(at)))
