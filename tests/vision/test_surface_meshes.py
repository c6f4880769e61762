from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest

from yid_ocp import vision
from yid_ocp.errors import DataError, ModelError
from yid_ocp.model.mechanism import homogeneous_transform
from yid_ocp.model.system import System
from yid_ocp.model.urdf import read_urdf
from yid_ocp.vision import surface_meshes
from yid_ocp.vision.surface_meshes import ArticulatedSurfaces, TriangleMesh, load_robot_meshes_by_joint

SHAPE = (480, 640)


def frames(system, until=1.0, values=None, **camera):
    """What a virtual camera takes of an object that stays as it is."""
    scene, still = vision.SceneDescription(system, None, values), np.zeros((2, system.n_coordinates))
    return vision.render_virtual_frames(scene, [0, until], still, vision.VirtualCameraSetup(np.eye(4), **camera))


@pytest.fixture
def image(alone, monkeypatch):
    """image(camera, depth and cosine everywhere): the depths that it measures, NaN where none."""

    def taken(camera, depth, cosine=1.0):
        scene = np.broadcast_to(depth, SHAPE), np.broadcast_to(cosine, SHAPE), None
        monkeypatch.setattr(ArticulatedSurfaces, "render_depth_incidence_and_part", lambda *_: scene)
        points = frames(alone, sensor_model=camera).sequence.load_cloud(0)
        lens, seen = camera.intrinsics, np.full(SHAPE, np.nan)
        column, row = np.rint(points[:, :2] / points[:, 2:] * [lens.fx, lens.fy] + [lens.cx, lens.cy]).astype(int).T
        seen[row, column] = points[:, 2]
        return seen

    return taken


def tubes(system, values=None):
    """Meshes of the object's tubes by joint, as a virtual camera has them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(surface_meshes, "ArticulatedSurfaces", made := Mock())
        frames(system, values=values)
    return made.call_args.args[1]


def inner(image):
    return image[20:-20, 60:-60]


@pytest.mark.parametrize("distance", [1.0, 2.0, 3.0])
def test_noise_grows_with_the_square_of_distance(image, distance):
    camera = vision.DepthCameraModel()
    seen = inner(image(camera, distance))
    disparity_std = np.hypot(camera.disparity_std, camera.disparity_step / np.sqrt(12.0))
    expected = distance**2 / (camera.intrinsics.fx * camera.baseline) * disparity_std
    assert np.nanstd(seen) == pytest.approx(expected, rel=0.15)
    assert abs(np.nanmean(seen) - distance) < 0.002 * distance


def test_the_figures_at_two_metres(image):
    cameras = replace(vision.DepthCameraModel(), disparity_step=0.0), vision.DepthCameraModel()
    fine, stepped = (inner(image(own, 2.0)) for own in cameras)
    assert np.nanstd(fine) == pytest.approx(0.0058, rel=0.05)
    steps = np.unique(stepped)
    assert np.diff(steps[np.isfinite(steps)]).mean() == pytest.approx(0.0115, rel=0.1)


def test_what_is_out_of_range_or_seen_at_a_grazing_angle_is_lost(image):
    camera = vision.DepthCameraModel()
    assert np.isnan(image(camera, 0.5)).all()
    assert np.isnan(image(camera, np.inf)).all()
    assert np.isnan(image(camera, 2.0, 0.05)).all()
    assert np.isfinite(inner(image(camera, 2.0))).mean() > 0.97


def test_edges_have_holes_and_a_shadow_on_one_side(image):
    depth = np.full(SHAPE, 3.0)
    depth[:, 300:340] = 1.5
    camera = replace(vision.DepthCameraModel(), loss_probability=0.0)
    lost = np.isnan(image(camera, depth)).mean(axis=0)
    shift = round(camera.intrinsics.fx * camera.baseline * (1 / 1.5 - 1 / 3.0))
    assert (lost[342 : 338 + shift] == 1).all(), "the projector's shadow"
    assert lost[345 + shift] == 0
    assert lost[290] == 0
    assert 0.3 < lost[300] < 0.9
    assert lost[320] == 0


def test_outliers_are_as_many_as_asked_for(image):
    seen = inner(image(replace(vision.DepthCameraModel(), outlier_probability=0.2), 2.0))
    assert (np.abs(seen - 2.0) > 0.04).mean() == pytest.approx(0.2 * 0.9, abs=0.02)


def test_frame_timing(alone):
    made = frames(alone, 300.0, mean_rate=10.0, dropped_frame_fraction=1 / 3, latency=0.05, latency_std=0.002)
    assert len(made.capture_times) == pytest.approx(2000, rel=0.05)
    assert np.std(made.sequence.stamps - made.capture_times - 0.05) == pytest.approx(0.002, rel=0.1)


def test_virtual_frames_are_the_same_every_time(system, run):
    pose = vision.look_at_pose([2.6, 0.0, 0.45], [0.85, 0.0, -0.1])
    camera = vision.VirtualCameraSetup(pose, mean_rate=2.0)
    one, two = (
        vision.render_virtual_frames(vision.SceneDescription(system), run.t, run.q, replace(camera, seed=seed))
        for seed in (3, 4)
    )
    first = one.sequence.load_cloud(1)
    one.sequence.load_cloud(0)
    assert np.array_equal(first, one.sequence.load_cloud(1))
    assert not np.array_equal(one.capture_times[:3], two.capture_times[:3])
    # the object's surface is where the points are
    surfaces = ArticulatedSurfaces(system.mechanism_with_values(), tubes(system))
    points = first @ pose[:3, :3].T + pose[:3, 3]
    away, _, _ = surfaces.nearest_moving_surfaces(points, one.true_configuration_at(one.capture_times[1]), 0.2)
    assert np.median(away) < 0.006
    assert len(away) > 5000
    with pytest.raises(DataError, match="pose of the camera is missing"):
        vision.render_virtual_frames(vision.SceneDescription(system), run.t, run.q, replace(camera, pose=None))


@pytest.fixture(scope="module")
def tree(urdf_folder):
    return read_urdf(urdf_folder / "double_pendulum.urdf").with_numeric_values()


@pytest.fixture(scope="module")
def ball(tree):
    """A ball of 0.1 m on the second joint's frame of a double pendulum, and a box in the world."""
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
        found = ball.nearest_moving_surfaces(points, q, 0.15)[0]
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
    distance, normal, part = ball.nearest_moving_surfaces(points, q, 0.2)
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


def test_tubes_have_their_lengths_and_radii(system):
    meshes = tubes(system)
    link = meshes[system.mechanism.joint_index("T3_3_z")].vertices
    assert link[:, 2].max() == pytest.approx(0.737 / 4)
    assert np.abs(link[:, :2]).max() == pytest.approx(0.019)
    assert len(meshes) == 12
    thin = tubes(system, {"T3.radius": 0.01})[system.mechanism.joint_index("T3_3_z")].vertices
    assert np.abs(thin[:, :2]).max() == pytest.approx(0.01)


def test_what_cannot_be_seen_is_said(tmp_path, tree):
    with pytest.raises(DataError, match="no object"):
        tubes(System.build(tree))
    with pytest.raises(ModelError, match="URDF cannot be read: there is no such file"):
        load_robot_meshes_by_joint(tmp_path / "none.urdf", tree)
    bare = tmp_path / "bare.urdf"
    bare.write_text('<robot name="bare"><link name="base"/></robot>')
    with pytest.raises(ModelError, match="no visual shapes"):
        load_robot_meshes_by_joint(bare, tree)


def test_names_of_mesh_files(tmp_path, tree):
    """A package's folder need not bear its name."""
    urdf, mesh = tmp_path / "arm" / "urdf" / "arm.urdf", tmp_path / "arm" / "mesh.obj"
    urdf.parent.mkdir(parents=True)
    mesh.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")

    def corners(name):
        shape = f'<visual><geometry><mesh filename="{name}"/></geometry></visual>'
        urdf.write_text(f'<robot name="arm"><link name="ceiling">{shape}</link></robot>')
        return load_robot_meshes_by_joint(urdf, tree)[-1].vertices.sum(axis=0).tolist()

    for name in ("package://arm/mesh.obj", "package://arm_1.2/mesh.obj", "../mesh.obj", f"file://{mesh}"):
        assert corners(name) == [1, 1, 0]
    with pytest.raises(ModelError, match=r"package://nobody/none.obj.*does not exist"):
        corners("package://nobody/none.obj")
