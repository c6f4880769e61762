import numpy as np
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from yid_ocp.errors import ConfigError
from yid_ocp.vision import CloudFilterOptions, TrackOptions
from yid_ocp.vision.point_cloud import (
    ReachableObjectRegion,
    WeightedCloud,
    extract_skeleton_graph,
    statistical_inlier_mask,
    voxel_averages,
)
from yid_ocp.vision.surface_meshes import ArticulatedSurfaces, load_robot_meshes_by_joint

CAMERA, DIAMETER = np.array([2.6, 0.0, 0.45]), 0.04


def test_voxels_keep_weight_and_centroid():
    points = np.random.default_rng(0).uniform(-0.3, 0.3, (5000, 3))
    cloud = voxel_averages(points, 0.05)
    assert cloud.point_weights.sum() == 5000
    assert np.allclose(np.average(cloud.points, axis=0, weights=cloud.point_weights), points.mean(0))
    assert len(cloud) <= 13**3
    assert len(voxel_averages(points, 1e-5)) == 5000


@pytest.mark.parametrize("share", [0.0, 0.2])
def test_outliers_go_and_the_surface_stays(share):
    rng = np.random.default_rng(1)
    count = 8000
    plane = np.column_stack([rng.uniform(-0.5, 0.5, (count, 2)), 0.004 * rng.standard_normal(count)])
    wrong = rng.uniform(-0.6, 0.6, (round(count * share / (1 - share)), 3))
    cloud = voxel_averages(np.concatenate([plane, wrong]), 0.008)
    far = np.abs(cloud.points[:, 2]) > 0.05
    stays = statistical_inlier_mask(cloud)
    assert stays[~far].mean() > 0.85
    assert share == 0 or stays[far].mean() < 0.05
    assert not statistical_inlier_mask(cloud.select(np.arange(5))).any()


def test_the_robot_goes_with_its_padding(system, run):
    tree = system.mechanism_with_values()
    meshes = load_robot_meshes_by_joint("package:baxter", tree)
    robot = ArticulatedSurfaces(tree, meshes)
    wrist = system.mechanism.joint_index("left_w1")
    for q in (run.q[0], run.q[-1]):
        pose = robot.part_poses_at_configuration(q)[robot.part_joints.index(wrist)]
        surface = meshes[wrist].transformed(pose).vertices[::20]
        assert robot.within_surface_distance_mask(surface, q, 0.01).all()
        assert not robot.within_surface_distance_mask(surface + np.array([0.0, 0.0, 3.0]), q, 0.01).any()
    tip = run.point_positions[0][system.point_frames.index("w_T1")][None]
    assert not robot.within_surface_distance_mask(tip, run.q[0], 0.03).any()


def test_where_the_object_can_be(system, run):
    region = ReachableObjectRegion(system, CloudFilterOptions()).membership_mask_function_at(run.q[0], CAMERA)
    foot = np.array([0.85, 0.0, -0.93])
    # on the floor, behind the robot, beyond reach
    outside = np.array([[1.15, 0.0, -0.91], [-0.2, 0.0, 0.3], [0.85, 1.2, 0.47]])
    assert region(outside).tolist() == [False, False, False]
    assert region(run.point_positions.reshape(-1, 3)).all()
    assert region((foot + np.array([0.0, 0.0, 0.1]))[None]).all()
    corners = {"box_lower": (0.5, -2.0, -2.0), "box_upper": (2.0, 2.0, 0.0)}
    box = CloudFilterOptions(**corners, floor_height=-0.9, max_depth_behind_robot_base=None)
    region = ReachableObjectRegion(system, box).membership_mask_function_at(run.q[0], CAMERA)
    points = np.array([[0.85, 0.0, -0.1], [0.4, 0.0, -0.1], [0.85, 0.0, 0.1], [0.85, 0.0, -0.91]])
    assert region(points).tolist() == [True, False, False, False]


@pytest.mark.parametrize(
    ("options", "name"),
    [
        (CloudFilterOptions, "robot_padding"),
        (TrackOptions, "max_mean_surface_distance_in_radii"),
        (TrackOptions, "surface_noise_std"),
    ],
)
def test_options_are_checked(options, name):
    with pytest.raises(ConfigError, match=f"{name} is -1"):
        options(**{name: -1.0})


FOOT, FORK = np.zeros(3), np.array([0.0, 0.0, 0.8])
ENDS = (np.array([0.0, 0.4, 1.2]), np.array([0.0, -0.5, 1.3]))
BONES = ((FOOT, FORK), (FORK, ENDS[0]), (FORK, ENDS[1]))


def letter(seed=0, count=900, spread=0.008):
    rng = np.random.default_rng(seed)
    parts = []
    for start, end in BONES:
        t = rng.uniform(0, 1, count)
        parts.append(start + t[:, None] * (end - start) + spread * rng.standard_normal((count, 3)))
    points = np.concatenate(parts)
    return WeightedCloud(points, np.ones(len(points)))


def from_bones(points):
    best = np.full(len(points), np.inf)
    for start, end in BONES:
        edge = end - start
        t = np.clip((points - start) @ edge / (edge @ edge), 0, 1)
        best = np.minimum(best, np.linalg.norm(points - start - t[:, None] * edge, axis=1))
    return best


def n_parts(found):
    one, other = found.edges.T
    graph = coo_matrix((np.ones(len(one)), (one, other)), shape=(len(found.nodes),) * 2)
    return connected_components(graph, directed=False)[0]


def test_nodes_and_edges_are_a_tree_on_the_centre_lines_from_the_lowest_point():
    cloud = letter()
    found, again, other = (extract_skeleton_graph(cloud, np.random.default_rng(seed), DIAMETER) for seed in (0, 0, 2))
    nodes, label = found.nodes, found.node_of_point
    assert np.median(from_bones(nodes)) < 0.005
    assert from_bones(nodes).max() < 0.02
    assert (found.node_of_point >= 0).mean() > 0.9
    for i in range(len(nodes)):
        mine = cloud.points[label == i]
        assert len(mine) <= 50
        assert np.allclose(mine.mean(0), nodes[i])
    assert np.linalg.norm(nodes[0] - FOOT) < 0.05
    # from there the walk goes on to neighbours
    assert np.linalg.norm(np.diff(nodes[:6], axis=0), axis=1).max() < 0.1
    assert n_parts(found) == 1
    assert len(found.edges) == len(nodes) - 1
    assert from_bones(nodes[found.edges].mean(axis=1)).max() < 0.02
    assert np.array_equal(nodes, again.nodes)
    assert abs(len(other.nodes) - len(nodes)) < 0.15 * len(nodes)


def test_two_parts_and_a_stray_heap():
    cloud = letter()
    far = np.random.default_rng(3).normal([0.5, 0.5, 0.5], 0.01, (60, 3))
    near = np.abs(cloud.points[:, 2] - 0.4) > 0.15  # a gap across the trunk
    points = np.concatenate([cloud.points[near], far])
    found = extract_skeleton_graph(WeightedCloud(points, np.ones(len(points))), np.random.default_rng(0), DIAMETER)
    assert n_parts(found) == len(found.nodes) - len(found.edges) == 2
    assert not (found.node_of_point >= 0)[-60:].any()


def test_too_little_gives_nothing_and_points_at_one_place_do_not_hang_it(monkeypatch):
    few = WeightedCloud(np.random.default_rng(0).uniform(-1, 1, (30, 3)), np.ones(30))
    assert len(extract_skeleton_graph(few, np.random.default_rng(0), DIAMETER).nodes) == 0
    empty = extract_skeleton_graph(WeightedCloud(np.empty((0, 3)), np.empty(0)), np.random.default_rng(0), DIAMETER)
    assert len(empty.nodes) == len(empty.edges) == len(empty.node_of_point) == 0
    found = extract_skeleton_graph(WeightedCloud(np.zeros((500, 3)), np.ones(500)), np.random.default_rng(0), DIAMETER)
    assert len(found.nodes) == 10
    assert (found.node_of_point >= 0).all()
    angle = np.arange(40)
    ring = WeightedCloud(0.5 * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle]), np.ones(40))
    monkeypatch.setattr("yid_ocp.vision.point_cloud._MIN_SEGMENT_POINTS", 1)
    assert len(extract_skeleton_graph(ring, np.random.default_rng(0), 0.0).nodes)
