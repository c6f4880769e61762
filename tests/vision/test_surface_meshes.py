from dataclasses import replace

import numpy as np
import pytest

from yid_ocp import vision
from yid_ocp.errors import ConfigError, DataError, ModelError
from yid_ocp.model.mechanism import homogeneous_transform
from yid_ocp.model.system import System
from yid_ocp.model.urdf import read_urdf
from yid_ocp.vision import surface_meshes
from yid_ocp.vision.surface_meshes import (
    ArticulatedSurfaces,
    TriangleMesh,
    _tube_meshes_by_joint,
    load_robot_meshes_by_joint,
)

SHAPE = (480, 640)


def wall(depth):
    return np.full(SHAPE, depth), np.ones(SHAPE)


def inner(image):
    return image[20:-20, 60:-60]


@pytest.mark.parametrize("distance", [1.0, 2.0, 3.0])
def test_noise_grows_with_the_square_of_distance(distance):
    camera = vision.DepthCameraModel()
    seen = inner(camera._simulate_depth_image(*wall(distance), np.random.default_rng(0)))
    disparity_std = np.hypot(camera.disparity_std, camera.disparity_step / np.sqrt(12.0))
    expected = distance**2 / (camera.intrinsics.fx * camera.baseline) * disparity_std
    assert np.nanstd(seen) == pytest.approx(expected, rel=0.15)
    assert abs(np.nanmean(seen) - distance) < 0.002 * distance


def test_the_figures_at_two_metres():
    cameras = replace(vision.DepthCameraModel(), disparity_step=0.0), vision.DepthCameraModel()
    fine, stepped = (inner(own._simulate_depth_image(*wall(2.0), np.random.default_rng(0))) for own in cameras)
    assert np.nanstd(fine) == pytest.approx(0.0058, rel=0.05)
    steps = np.unique(stepped)
    assert np.diff(steps[np.isfinite(steps)]).mean() == pytest.approx(0.0115, rel=0.1)


def test_what_is_out_of_range_or_seen_at_a_grazing_angle_is_lost():
    camera, rng = vision.DepthCameraModel(), np.random.default_rng(0)
    assert np.isnan(camera._simulate_depth_image(*wall(0.5), rng)).all()
    assert np.isnan(camera._simulate_depth_image(*wall(np.inf), rng)).all()
    assert np.isnan(camera._simulate_depth_image(np.full(SHAPE, 2.0), np.full(SHAPE, 0.05), rng)).all()
    assert np.isfinite(inner(camera._simulate_depth_image(*wall(2.0), rng))).mean() > 0.97


def test_edges_have_holes_and_a_shadow_on_one_side():
    depth, cosine = wall(3.0)
    depth[:, 300:340] = 1.5
    camera = replace(vision.DepthCameraModel(), loss_probability=0.0)
    lost = np.isnan(camera._simulate_depth_image(depth, cosine, np.random.default_rng(1))).mean(axis=0)
    shift = round(camera.intrinsics.fx * camera.baseline * (1 / 1.5 - 1 / 3.0))
    assert (lost[342 : 338 + shift] == 1).all(), "the projector's shadow"
    assert lost[345 + shift] == 0
    assert lost[290] == 0
    assert 0.3 < lost[300] < 0.9
    assert lost[320] == 0


def test_outliers_are_as_many_as_asked_for():
    camera = replace(vision.DepthCameraModel(), outlier_probability=0.2)
    seen = inner(camera._simulate_depth_image(*wall(2.0), np.random.default_rng(0)))
    assert (np.abs(seen - 2.0) > 0.04).mean() == pytest.approx(0.2 * 0.9, abs=0.02)


def test_frame_timing():
    rng = np.random.default_rng(0)
    when = vision.VirtualCameraTiming(10.0, dropped_frame_fraction=1 / 3, latency=0.05, latency_std=0.002)
    taken, stamps = when._sample_times_and_stamps(0.0, 300.0, rng)
    assert len(taken) == pytest.approx(2000, rel=0.05)
    assert np.std(stamps - taken - 0.05) == pytest.approx(0.002, rel=0.1)
    with pytest.raises(ConfigError, match="rate"):
        vision.VirtualCameraTiming(mean_rate=0.0)._sample_times_and_stamps(0.0, 1.0, rng)


def test_virtual_frames_are_the_same_every_time(system, run):
    pose = vision.look_at_pose([2.6, 0.0, 0.45], [0.85, 0.0, -0.1])
    camera = vision.VirtualCameraSetup(pose, timing=vision.VirtualCameraTiming(mean_rate=2.0))
    one, two = (
        vision.render_virtual_frames(vision.SceneDescription(system), run.t, run.q, replace(camera, seed=seed))
        for seed in (3, 4)
    )
    first = one.sequence.load_cloud(1)
    one.sequence.load_cloud(0)
    assert np.array_equal(first, one.sequence.load_cloud(1))
    assert not np.array_equal(one.capture_times[:3], two.capture_times[:3])
    # the object's surface is where the points are
    tubes = ArticulatedSurfaces(system.mechanism_with_values(), _tube_meshes_by_joint(system))
    away, _, _ = tubes.distance_to_moving_surface(
        one.sequence.load_world_cloud(1), one.true_configuration_at(one.capture_times[1]), 0.2
    )
    assert np.median(away) < 0.006
    assert len(away) > 5000
    with pytest.raises(DataError, match="pose of the camera is missing"):
        vision.render_virtual_frames(vision.SceneDescription(system), run.t, run.q, replace(camera, pose=None))


@pytest.fixture(scope="module")
def ball(urdf_folder):
    """A ball of 0.1 m on the second joint's frame of a double pendulum, and a box in the world."""
    tree = read_urdf(urdf_folder / "double_pendulum.urdf").with_numeric_values()
    box = TriangleMesh.box([1.0, 1.0, 1.0]).transformed(homogeneous_transform(np.eye(3), [0.0, 5.0, 0.0]))
    return ArticulatedSurfaces(tree, {1: TriangleMesh.sphere(0.1), -1: box})


def centre(surfaces, q):
    return surfaces.part_poses_at_configuration(q)[surfaces.part_joints.index(1)][:3, 3]


def test_distances_follow_the_joints(ball):
    for q in ([0.0, 0.0], [0.7, -0.4]):
        middle = centre(ball, q)
        directions = np.random.default_rng(0).standard_normal((50, 3))
        directions /= np.linalg.norm(directions, axis=1)[:, None]
        radii = np.linspace(0.05, 0.3, 50)
        points, expected = middle + radii[:, None] * directions, np.abs(radii - 0.1)
        found = ball.distance_to_moving_surface(points, q, 0.15)[0]
        assert np.allclose(found[expected < 0.145], expected[expected < 0.145], atol=6e-4)
        assert np.isinf(found[expected > 0.155]).all()
        assert np.array_equal(ball.within_surface_distance_mask(points, q, 0.15, moving_only=True), np.isfinite(found))
    beside = np.array([[0.0, 5.0, 0.6]])
    assert ball.within_surface_distance_mask(beside, [0, 0], 0.2).all()
    assert not ball.within_surface_distance_mask(beside, [0, 0], 0.2, moving_only=True).any()


def test_closest_points_give_the_way_out(ball):
    q = [0.3, 0.2]
    direction = np.array([0.6, 0.0, 0.8])
    points = centre(ball, q) + np.array([[0.14], [0.08], [0.5]]) * direction
    distance, normal, part = ball.distance_to_moving_surface(points, q, 0.2)
    assert np.allclose(distance[:2], [0.04, 0.02], atol=6e-4)
    assert np.allclose(normal[0], direction, atol=0.05)
    assert np.allclose(normal[1], -direction, atol=0.08)  # from the surface to the point, inwards here
    assert part.tolist()[2] == -1
    assert np.isinf(distance[2])


def test_rays_meet_a_ball_where_it_is(ball):
    q = [0.4, -0.1]
    middle = centre(ball, q)
    eye = middle + np.array([1.2, 0.3, 0.1])
    camera = vision.CameraIntrinsics(41, 31, 60.0, 60.0, 20.0, 15.0)
    depth, cosine, part = ball.render_depth_incidence_and_part(camera, vision.look_at_pose(eye, middle), q)
    away = np.linalg.norm([1.2, 0.3, 0.1])
    assert depth[15, 20] == pytest.approx(away - 0.1, abs=1e-3)
    assert cosine[15, 20] == pytest.approx(1.0, abs=0.01)
    rays = camera.pixel_rays_at_unit_depth / np.linalg.norm(camera.pixel_rays_at_unit_depth, axis=2)[..., None]
    miss = away * np.sqrt(1 - rays[..., 2] ** 2)
    assert np.isfinite(depth[miss < 0.097]).all()
    assert np.isinf(depth[miss > 0.103]).all()
    behind, _, nobody = ball.render_depth_incidence_and_part(camera, vision.look_at_pose(eye, 2 * eye - middle), q)
    assert np.isinf(behind).all()
    assert (nobody == -1).all()
    assert ((part == ball.part_joints.index(1)) == np.isfinite(depth)).all()


def test_baxters_meshes_are_found_and_move(system):
    tree = system.mechanism_with_values()
    meshes = load_robot_meshes_by_joint("package:baxter", tree)
    assert set(meshes) == {-1, *system.actuated_coordinate_indices}
    assert 0.1 < meshes[system.mechanism.joint_index("left_w2")].vertices[:, 2].max() < 0.5
    assert set(load_robot_meshes_by_joint("package:baxter", tree, "collision")) <= set(meshes)


def test_tubes_have_their_lengths_and_radii(system):
    meshes = _tube_meshes_by_joint(system)
    link = meshes[system.mechanism.joint_index("T3_3_z")].vertices
    assert link[:, 2].max() == pytest.approx(0.737 / 4)
    assert np.abs(link[:, :2]).max() == pytest.approx(0.019)
    assert len(meshes) == 12
    thin = _tube_meshes_by_joint(system, {"T3.radius": 0.01})[system.mechanism.joint_index("T3_3_z")].vertices
    assert np.abs(thin[:, :2]).max() == pytest.approx(0.01)


def test_what_cannot_be_seen_is_said(tmp_path, urdf_folder):
    tree = read_urdf(urdf_folder / "double_pendulum.urdf").with_numeric_values()
    with pytest.raises(DataError, match="no object"):
        _tube_meshes_by_joint(System.build(tree))
    with pytest.raises(ModelError, match="no URDF file"):
        load_robot_meshes_by_joint(tmp_path / "none.urdf", tree)
    bare = tmp_path / "bare.urdf"
    bare.write_text('<robot name="bare"><link name="base"/></robot>')
    with pytest.raises(ModelError, match="no visual meshes"):
        load_robot_meshes_by_joint(bare, tree)
    with pytest.raises(ModelError, match="does not exist"):
        surface_meshes._resolve_mesh_path("package://nobody/mesh.dae", bare)


def test_names_of_mesh_files(tmp_path):
    package = tmp_path / "share" / "arm"
    (package / "urdf").mkdir(parents=True)
    (package / "mesh.stl").write_text("")
    urdf = package / "urdf" / "arm.urdf"
    for name in ("package://arm/mesh.stl", "../mesh.stl", f"file://{package}/mesh.stl"):
        assert surface_meshes._resolve_mesh_path(name, urdf).resolve() == package / "mesh.stl"
    renamed = package.rename(tmp_path / "share" / "arm_1.2")  # a package's folder need not bear its name
    assert surface_meshes._resolve_mesh_path("package://arm/mesh.stl", renamed / "urdf" / "arm.urdf").is_file()
