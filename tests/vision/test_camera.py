from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from yid_ocp.errors import ConfigError, DataError
from yid_ocp.vision import Background, DepthCamera, FrameTiming, Scene, VirtualCamera, look_at, virtual_frames

SHAPE = (480, 640)


def wall(depth):
    return np.full(SHAPE, depth), np.ones(SHAPE)


def inner(image):
    return image[20:-20, 60:-60]


@pytest.mark.parametrize("distance", [1.0, 2.0, 3.0])
def test_noise_grows_with_the_square_of_distance(distance):
    camera = DepthCamera()
    seen = inner(camera.measure(*wall(distance), np.random.default_rng(0)))
    assert np.nanstd(seen) == pytest.approx(float(camera.depth_std(distance)), rel=0.15)
    assert float(camera.depth_std(distance)) == pytest.approx(distance**2 * float(camera.depth_std(1.0)))
    assert abs(np.nanmean(seen) - distance) < 0.002 * distance


def test_the_figures_at_two_metres():
    camera = replace(DepthCamera(), disparity_step=0.0)
    assert np.nanstd(inner(camera.measure(*wall(2.0), np.random.default_rng(0)))) == pytest.approx(0.0058, rel=0.05)
    steps = np.unique(DepthCamera().measure(*wall(2.0), np.random.default_rng(0)))
    assert np.diff(steps[np.isfinite(steps)]).mean() == pytest.approx(0.0115, rel=0.1)


def test_what_is_out_of_range_or_seen_at_a_grazing_angle_is_lost():
    camera, rng = DepthCamera(), np.random.default_rng(0)
    assert np.isnan(camera.measure(*wall(0.5), rng)).all()
    assert np.isnan(camera.measure(*wall(np.inf), rng)).all()
    assert np.isnan(camera.measure(np.full(SHAPE, 2.0), np.full(SHAPE, 0.05), rng)).all()
    assert np.isfinite(inner(camera.measure(*wall(2.0), rng))).mean() > 0.97


def test_edges_have_holes_and_a_shadow_on_one_side():
    depth, cosine = wall(3.0)
    depth[:, 300:340] = 1.5
    camera = replace(DepthCamera(), loss=0.0)
    lost = np.isnan(camera.measure(depth, cosine, np.random.default_rng(1))).mean(axis=0)
    shift = round(camera.pinhole.fx * camera.baseline * (1 / 1.5 - 1 / 3.0))
    assert (lost[342 : 338 + shift] == 1).all(), "the projector's shadow"
    assert lost[345 + shift] == 0
    assert lost[290] == 0
    assert 0.3 < lost[300] < 0.9
    assert lost[320] == 0


def test_outliers_are_as_many_as_asked_for():
    camera = replace(DepthCamera(), outliers=0.2)
    seen = inner(camera.measure(*wall(2.0), np.random.default_rng(0)))
    assert (np.abs(seen - 2.0) > 0.04).mean() == pytest.approx(0.2 * 0.9, abs=0.02)


def test_frame_timing():
    rng = np.random.default_rng(0)
    when = FrameTiming(rate=10.0, spread=0.25, dropped=1 / 3, latency=0.05, latency_std=0.002, late=0.1, late_by=0.2)
    taken, stamps = when.times(0.0, 300.0, rng)
    assert len(taken) == pytest.approx(2000, rel=0.05)
    delay = stamps - taken - 0.05
    assert (delay > 0.15).mean() == pytest.approx(0.1, abs=0.03)
    assert np.std(delay[delay < 0.1]) == pytest.approx(0.002, rel=0.1)
    with pytest.raises(ConfigError, match="rate"):
        FrameTiming(rate=0.0).times(0.0, 1.0, rng)


def test_virtual_frames_are_the_same_every_time(system, run):
    pose = look_at([2.6, 0.0, 0.45], [0.85, 0.0, -0.1])
    camera = VirtualCamera(pose, timing=FrameTiming(rate=2.0), background=Background(None, None))
    one, two = (virtual_frames(Scene(system), run.t, run.q, replace(camera, seed=seed)) for seed in (3, 4))
    first = one.sequence.load(1)
    one.sequence.load(0)
    assert np.array_equal(first, one.sequence.load(1))
    assert not np.array_equal(one.taken[:3], two.taken[:3])
    assert len(one.depth) == len(one.sequence)
    # the object's surface is where the points are
    from yid_ocp.vision.meshes import Surfaces, numeric_mechanism, tube_meshes

    tubes = Surfaces(numeric_mechanism(system), tube_meshes(system))
    away = tubes.distance(one.sequence.world(1), one.q[1], 0.2)
    assert np.median(away) < 0.006
    assert len(away) > 5000
    with pytest.raises(DataError, match="pose of the camera is missing"):
        virtual_frames(Scene(system), run.t, run.q, replace(camera, pose=None))
