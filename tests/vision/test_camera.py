from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from yid_ocp.errors import ConfigError, DataError
from yid_ocp.vision import (
    CameraScene,
    DepthCamera,
    FrameTiming,
    VirtualCamera,
    look_at_pose,
    render_virtual_frames,
)
from yid_ocp.vision.surface_meshes import ArticulatedSurfaces, tube_meshes_by_joint

SHAPE = (480, 640)


def wall(depth):
    return np.full(SHAPE, depth), np.ones(SHAPE)


def inner(image):
    return image[20:-20, 60:-60]


@pytest.mark.parametrize("distance", [1.0, 2.0, 3.0])
def test_noise_grows_with_the_square_of_distance(distance):
    camera = DepthCamera()
    seen = inner(camera._simulate_depth_image(*wall(distance), np.random.default_rng(0)))
    disparity_std = np.hypot(camera.disparity_std, camera.disparity_step / np.sqrt(12.0))
    expected = distance**2 / (camera.intrinsics.fx * camera.baseline) * disparity_std
    assert np.nanstd(seen) == pytest.approx(expected, rel=0.15)
    assert abs(np.nanmean(seen) - distance) < 0.002 * distance


def test_the_figures_at_two_metres():
    fine, stepped = (
        inner(camera._simulate_depth_image(*wall(2.0), np.random.default_rng(0)))
        for camera in (replace(DepthCamera(), disparity_step=0.0), DepthCamera())
    )
    assert np.nanstd(fine) == pytest.approx(0.0058, rel=0.05)
    steps = np.unique(stepped)
    assert np.diff(steps[np.isfinite(steps)]).mean() == pytest.approx(0.0115, rel=0.1)


def test_what_is_out_of_range_or_seen_at_a_grazing_angle_is_lost():
    camera, rng = DepthCamera(), np.random.default_rng(0)
    assert np.isnan(camera._simulate_depth_image(*wall(0.5), rng)).all()
    assert np.isnan(camera._simulate_depth_image(*wall(np.inf), rng)).all()
    assert np.isnan(camera._simulate_depth_image(np.full(SHAPE, 2.0), np.full(SHAPE, 0.05), rng)).all()
    assert np.isfinite(inner(camera._simulate_depth_image(*wall(2.0), rng))).mean() > 0.97


def test_edges_have_holes_and_a_shadow_on_one_side():
    depth, cosine = wall(3.0)
    depth[:, 300:340] = 1.5
    camera = replace(DepthCamera(), loss_probability=0.0)
    lost = np.isnan(camera._simulate_depth_image(depth, cosine, np.random.default_rng(1))).mean(axis=0)
    shift = round(camera.intrinsics.fx * camera.baseline * (1 / 1.5 - 1 / 3.0))
    assert (lost[342 : 338 + shift] == 1).all(), "the projector's shadow"
    assert lost[345 + shift] == 0
    assert lost[290] == 0
    assert 0.3 < lost[300] < 0.9
    assert lost[320] == 0


def test_outliers_are_as_many_as_asked_for():
    camera = replace(DepthCamera(), outlier_probability=0.2)
    seen = inner(camera._simulate_depth_image(*wall(2.0), np.random.default_rng(0)))
    assert (np.abs(seen - 2.0) > 0.04).mean() == pytest.approx(0.2 * 0.9, abs=0.02)


def test_frame_timing():
    rng = np.random.default_rng(0)
    when = FrameTiming(10.0, dropped_fraction=1 / 3, latency=0.05, latency_std=0.002)
    taken, stamps = when._sample_times_and_stamps(0.0, 300.0, rng)
    assert len(taken) == pytest.approx(2000, rel=0.05)
    delay = stamps - taken - 0.05
    assert np.std(delay) == pytest.approx(0.002, rel=0.1)
    with pytest.raises(ConfigError, match="rate"):
        FrameTiming(mean_rate=0.0)._sample_times_and_stamps(0.0, 1.0, rng)


def test_virtual_frames_are_the_same_every_time(system, run):
    pose = look_at_pose([2.6, 0.0, 0.45], [0.85, 0.0, -0.1])
    camera = VirtualCamera(pose, timing=FrameTiming(mean_rate=2.0))
    one, two = (render_virtual_frames(CameraScene(system), run.t, run.q, replace(camera, seed=seed)) for seed in (3, 4))
    first = one.sequence.load_cloud(1)
    one.sequence.load_cloud(0)
    assert np.array_equal(first, one.sequence.load_cloud(1))
    assert not np.array_equal(one.capture_times[:3], two.capture_times[:3])
    # the object's surface is where the points are
    tubes = ArticulatedSurfaces(system.numeric_mechanism(), tube_meshes_by_joint(system))
    away, _, _ = tubes.nearest_moving_surface(
        one.sequence.load_world_cloud(1), one.true_configuration_at(one.capture_times[1]), 0.2
    )
    assert np.median(away) < 0.006
    assert len(away) > 5000
    with pytest.raises(DataError, match="pose of the camera is missing"):
        render_virtual_frames(CameraScene(system), run.t, run.q, replace(camera, pose=None))
