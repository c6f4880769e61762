from __future__ import annotations

import numpy as np
import pytest

from yid_ocp.errors import ConfigError
from yid_ocp.vision import CloudFilterOptions, ShapeFitOptions, SkeletonOptions, TrackOptions
from yid_ocp.vision.point_cloud import (
    ReachableObjectRegion,
    is_statistical_inlier,
    voxel_averages,
    weighted_median,
)
from yid_ocp.vision.surface_meshes import ArticulatedSurfaces, load_robot_meshes

CAMERA = np.array([2.6, 0.0, 0.45])


def test_voxels_keep_weight_and_centroid():
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.3, 0.3, (5000, 3))
    cloud = voxel_averages(points, 0.05)
    assert cloud.point_weights.sum() == 5000
    assert np.allclose(np.average(cloud.points, axis=0, weights=cloud.point_weights), points.mean(0))
    assert len(cloud) <= 13**3
    assert len(voxel_averages(points, 1e-5)) == 5000
    assert len(voxel_averages(np.empty((0, 3)), 0.05)) == 0


def test_weighted_median():
    assert weighted_median(np.array([3.0, 1.0, 2.0]), np.array([1.0, 1.0, 1.0])) == 2.0
    assert weighted_median(np.array([3.0, 1.0, 2.0]), np.array([5.0, 1.0, 1.0])) == 3.0


@pytest.mark.parametrize("share", [0.0, 0.2])
def test_outliers_go_and_the_surface_stays(share):
    rng = np.random.default_rng(1)
    count = 8000
    plane = np.column_stack([rng.uniform(-0.5, 0.5, (count, 2)), 0.004 * rng.standard_normal(count)])
    wrong = rng.uniform(-0.6, 0.6, (round(count * share / (1 - share)), 3))
    cloud = voxel_averages(np.concatenate([plane, wrong]), 0.008)
    far = np.abs(cloud.points[:, 2]) > 0.05
    stays = is_statistical_inlier(cloud, 12, 4.0)
    assert stays[~far].mean() > 0.85
    assert share == 0 or stays[far].mean() < 0.05
    assert not is_statistical_inlier(cloud.select(np.arange(5)), 12, 4.0).any()


def test_the_robot_goes_with_its_padding(system, run):
    tree = system.numeric_mechanism()
    meshes = load_robot_meshes("package:baxter", tree)
    robot = ArticulatedSurfaces(tree, meshes)
    wrist = system.mechanism.joint_index("left_w1")
    for q in (run.q[0], run.q[-1]):
        pose = robot.part_poses_at(q)[robot.part_joints.index(wrist)]
        surface = meshes[wrist].transformed(pose).vertices[::20]
        assert robot.is_within_surface_distance(surface, q, 0.01).all()
        assert not robot.is_within_surface_distance(surface + np.array([0.0, 0.0, 3.0]), q, 0.01).any()
    tip = run.point_positions[0][system.point_frames.index("w_T1")][None]
    assert not robot.is_within_surface_distance(tip, run.q[0], 0.03).any()


def test_where_the_object_can_be(system, run):
    region = ReachableObjectRegion(system, CloudFilterOptions()).membership_test_at(run.q[0], CAMERA)
    foot = np.array([0.85, 0.0, -0.93])
    inside = {
        "floor": foot + np.array([0.3, 0.0, 0.02]),
        "behind": np.array([-0.2, 0.0, 0.3]),
        "beyond reach": foot + np.array([0.0, 1.2, 1.4]),
    }
    for reason, point in inside.items():
        assert not region(point[None])[0], reason
    assert region(run.point_positions.reshape(-1, 3)).all()
    assert region((foot + np.array([0.0, 0.0, 0.1]))[None]).all()
    box = CloudFilterOptions(
        box_lower=(0.5, -2.0, -2.0), box_upper=(2.0, 2.0, 0.0), floor_height=-0.9, max_depth_behind_base=None
    )
    region = ReachableObjectRegion(system, box).membership_test_at(run.q[0], CAMERA)
    points = np.array([[0.85, 0.0, -0.1], [0.4, 0.0, -0.1], [0.85, 0.0, 0.1], [0.85, 0.0, -0.91]])
    assert region(points).tolist() == [True, False, False, False]


@pytest.mark.parametrize(
    ("options", "name"),
    [
        (CloudFilterOptions, "robot_padding"),
        (SkeletonOptions, "neighbour_radius"),
        (TrackOptions, "max_distance_in_radii"),
        (ShapeFitOptions, "surface_noise_std"),
    ],
)
def test_options_are_checked(options, name):
    with pytest.raises(ConfigError, match=f"{name} = -1"):
        options(**{name: -1.0})
