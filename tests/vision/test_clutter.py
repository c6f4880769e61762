"""Things about smooth rods: they are set apart, named, and left out where they are known."""

import numpy as np
import pytest
from smooth_rods import COARSE, EYE, TARGET, SmoothY, box, filmed, floor_and_wall, frames_of, measured, pole, seen

from yid_ocp.errors import ConfigError, DataError, ModelError
from yid_ocp.vision import CloudFilterOptions, ExtraMesh, look_at_pose
from yid_ocp.vision.point_cloud import wanted_colour_mask
from yid_ocp.vision.sequence_calibration import BackgroundPoints, foreign_clusters_to_objects
from yid_ocp.vision.shape_evidence import ForeignCluster, TubeLinks
from yid_ocp.vision.surface_meshes import extra_meshes_by_joint_index

FRAMES = 2
TABLE = [0.6, 0.5, -0.2], [0.6, 0.8, 0.04]


@pytest.mark.parametrize(
    ("things", "junction"),
    [
        (lambda k: [pole([1.1 + 0.02 * k, -0.75, -0.9], 1.5, 0.12), pole([1.1, -0.6, -0.1], 0.1, 0.3)], 0.9),
        (lambda k: [box([0.85, -0.5, -0.3], [0.2, 0.2, 0.2])], 0.9),
        (lambda k: [box([0.93, 0.0, -0.5], [0.1, 0.3, 0.1])], 0.5),  # before the trunk, touching it
        (lambda k: [pole([0.9, -0.25, -0.93], 1.6, 0.02)], 0.9),  # as thick as the branch that touches it
    ],
)
def test_things_in_reach_neither_drop_frames_nor_mislead(alone, things, junction):
    found, error = measured(alone, *filmed(SmoothY(), FRAMES, things), filters=COARSE)
    assert np.isfinite(error[:, 0, 0]).sum() >= junction * FRAMES
    assert np.nanmax(np.linalg.norm(error, axis=2)) < 0.04
    assert np.mean(np.abs(error / found.std)[np.isfinite(error)] < 2) > 0.9


@pytest.mark.slow
def test_messages_name_the_thing_and_every_remedy_takes_it_away(alone):
    """A background of frames or of an empty scene, and its mesh."""
    table = filmed(SmoothY(), FRAMES, lambda k: [box(*TABLE)])
    found, _ = measured(alone, *table, filters=COARSE)
    thing = found.foreign_objects[0]
    assert thing.centre == pytest.approx([0.7, 0.5, -0.18], abs=0.15)
    assert thing.size[1] == pytest.approx(0.8, abs=0.1)
    assert not thing.moving
    assert thing.frames == FRAMES
    assert "track.options.background_estimation: frames" in thing.text
    clouds = [seen([*floor_and_wall(), box(*TABLE)], [9, k]) for k in range(2)]
    empty = frames_of([0.0, 1.0], clouds, look_at_pose(EYE, TARGET))
    mesh = ExtraMesh(box_size=TABLE[1], xyz=TABLE[0])
    for how in ({"background_estimation": "frames"}, {"extra": [mesh]}, {"empty": empty}):
        found, error = measured(alone, *table, filters=COARSE, **how)
        assert np.nanmax(np.linalg.norm(error, axis=2)) < 0.02
        assert all(np.linalg.norm(thing.size) < 0.6 for thing in found.foreign_objects)


def test_an_empty_scene_is_a_background():
    rng = np.random.default_rng(0)
    wall = np.column_stack([rng.uniform(0, 1, (20000, 2)), 0.003 * rng.standard_normal(20000)])
    background = BackgroundPoints.from_point_clouds([wall[::2], wall[1::2]], 0.008, 0.006)
    asked = np.array([[0.5, 0.5, 0.01], [0.5, 0.5, 0.06], [2.0, 0.5, 0.0]])
    assert background.near_background_mask(asked).tolist() == [True, False, False]
    assert background.near_background_mask(asked, 0.05).tolist() == [True, True, False]
    assert not BackgroundPoints().near_background_mask(asked).any()


def test_what_stands_still_is_a_background_but_for_the_object():
    rng = np.random.default_rng(1)
    heap = np.array([0.5, 0.0, 0.0]) + rng.uniform(-0.05, 0.05, (3000, 3))
    rod = np.column_stack([rng.uniform(0, 0.3, 2000), 0.01 * rng.standard_normal((2000, 2))])
    elsewhere = [np.array([0.0, 1.0 + k, 0.0]) + rng.uniform(-0.05, 0.05, (3000, 3)) for k in range(4)]
    clouds = [np.concatenate([heap, rod, other]) for other in elsewhere]
    shape = TubeLinks(np.array([[[0.0, 0.0, 0.0], [0.3, 0.0, 0.0]]]), np.array([0.02]), (0,), np.array([0.3]))
    background = BackgroundPoints.from_point_clouds(clouds, 0.016, 0.006, [shape] * 4, 0.045)
    assert background.near_background_mask(heap).mean() > 0.95
    assert not background.near_background_mask(rod).any()
    assert not background.near_background_mask(elsewhere[0]).any()


def test_what_moves_with_a_link_is_told_from_what_moves_by_itself():
    times = np.arange(6) / 20
    links = {t: {"hand": np.array([[1, 0, 0, t], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])} for t in times}
    size, box_ = np.full(3, 0.1), (np.zeros(3), np.ones(3))

    def looked(place):
        return [(t, [ForeignCluster(np.asarray(place(t), float), size, 100)]) for t in times]

    for place, moving, link, help_ in (
        (lambda t: [0.5, 0.5, 0.5], False, "", "background"),
        (lambda t: [t + 0.1, 0.0, 0.2], True, "hand", "surfaces_missing_from_urdf"),
        (lambda t: [0.5, 0.3 * t, 0.5], True, "", "take it out of view"),
        (lambda t: [3.0, 0.3 * t, 0.5], True, "", "box_lower and box_upper"),
    ):
        [thing] = foreign_clusters_to_objects(looked(place), 0.006, box_, links.__getitem__, False)
        assert (thing.moving, thing.link, thing.frames) == (moving, link, 6)
        assert help_ in thing.text
    [thing] = foreign_clusters_to_objects(looked(lambda t: [0.5, 0.3 * t, 0.5]), 0.006, box_, links.__getitem__, True)
    assert "colour" in thing.text
    still = looked(lambda t: [0.5, 0.5, 0.5])
    for left_out in (False, True):  # what is done already is no advice
        [thing] = foreign_clusters_to_objects(still, 0.006, box_, links.__getitem__, False, left_out)
        assert ("background_estimation: frames" in thing.text) != left_out
        assert "record the scene without object and robot" in thing.text


def test_extra_meshes_hang_on_links(system):
    tree = system.mechanism_with_values()
    extra = [
        ExtraMesh(parent_frame="left_gripper", box_size=(0.1, 0.1, 0.1)),
        ExtraMesh(sphere_radius=0.2, xyz=(1, 2, 3)),
    ]
    made = extra_meshes_by_joint_index(extra, tree)
    assert set(made) == {-1, tree.frames["left_gripper"].joint_index}
    assert made[-1][0].vertices.mean(axis=0) == pytest.approx([1, 2, 3], abs=0.01)
    for wrong, error, message in (
        (ExtraMesh(parent_frame="left_griper", sphere_radius=0.1), ConfigError, "no link 'left_griper'"),
        (ExtraMesh(box_size=(1, 1, 1), sphere_radius=0.1), ConfigError, "box_size and sphere_radius"),
        (ExtraMesh(mesh_file="nowhere.stl"), ModelError, "no mesh"),
    ):
        with pytest.raises(error, match=message):
            extra_meshes_by_joint_index([wrong], tree)


def test_colours_in_light_and_shade_and_clouds_without_any(alone):
    red = [200, 40, 30]
    seen = np.array([[200, 40, 30], [100, 18, 13], [40, 200, 30], [120, 120, 120], [0, 0, 0]])
    assert wanted_colour_mask(seen, [red]).tolist() == [True, True, False, False, False]
    assert wanted_colour_mask(seen, [red, [128, 128, 128]]).tolist() == [True, True, False, True, True]
    with pytest.raises(DataError, match="no colours"):
        measured(alone, *filmed(SmoothY(), 1), filters=CloudFilterOptions(object_colours=((200.0, 40.0, 30.0),)))
