"""Ropes and branched objects without a robot: smooth curves, not the model's own links, seen from one side."""

import json
from dataclasses import replace

import numpy as np
import pytest
from smooth_rods import frames_of

from yid_ocp import vision
from yid_ocp.cli import main
from yid_ocp.data.recording_hdf5 import read_recording
from yid_ocp.errors import ConfigError, DataError
from yid_ocp.model.flexible import FlexibleSegment, flexible_object
from yid_ocp.model.system import System
from yid_ocp.vision import SceneDescription, TrackOptions, look_at_pose
from yid_ocp.vision.frame_selection import is_shape_self_touching
from yid_ocp.vision.track import track_object

MILLIMETRE = 1e-3
RADIUS = 0.006
TABLE = look_at_pose([0.0, 0.0, 1.0], [0.0, 0.0, 0.0], up=(0, 1, 0))
WALL = look_at_pose([1.2, 0.0, -0.4], [0.0, 0.0, -0.4])
FILTERS = vision.CloudFilterOptions(voxel_size=0.004)
OPTIONS = TrackOptions(root_placement="free", filters=FILTERS)
CONFIG = """\
model:
  robot: null
  object:
    kind: segments
    named_segments: {rope: {length: 1.0, mass: 0.1, radius: 0.006, links: 16}}
  measured_points: ["rope:0%", w_rope]
track:
  frames_path: FRAMES
  n_drawn_frames: 1
  options: {root_placement: free, approximate_root_position: [-0.5, 0, 0], filters: {voxel_size: 0.004}}
"""


def line(course, length):
    """Places along a curve of a length, shape (2000, 3), evenly spaced: `course` from (0, 1) to places of any scale."""
    fine = course(np.linspace(0.0, 1.0, 8001))
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(fine, axis=0), axis=1))])
    even = np.linspace(0.0, along[-1], 2000)
    return np.stack([np.interp(even, along, fine[:, a]) for a in range(3)], axis=1) * (length / along[-1])


def seen(places, pose, rng, count=3500, noise=MILLIMETRE):
    """Points of the side of a rope that a camera sees, in the camera's frame."""
    index = rng.integers(1, len(places) - 1, count)
    centre, ahead = places[index], places[index + 1] - places[index - 1]
    ahead /= np.linalg.norm(ahead, axis=1)[:, None]
    across = np.cross(ahead, pose[:3, 3] - centre)
    across /= np.linalg.norm(across, axis=1)[:, None]
    angle = rng.uniform(-0.5 * np.pi, 0.5 * np.pi, count)[:, None]
    points = centre + RADIUS * (np.sin(angle) * across + np.cos(angle) * np.cross(across, ahead))
    return (points + noise * rng.standard_normal(points.shape) - pose[:3, 3]) @ pose[:3, :3]


def film(lines, pose, **how):
    rng = np.random.default_rng(7)
    clouds = [seen(places, pose, rng, **how) for places in lines]
    return frames_of(0.2 * np.arange(len(lines)), clouds, pose)


def snake(k):
    places = line(lambda s: np.stack([s, (0.05 + 0.02 * k) * np.sin(6 * s + 0.2 * k), 0 * s], axis=1), 1.0)
    return places - [0.5, 0.0, 0.0]


def swing(k):
    angle, out = 0.5 * np.sin(0.9 * k), 0.1 * np.cos(k)
    return line(lambda s: np.stack([out * s**2, np.sin(angle * s) * s, -np.cos(angle * s) * s], axis=1), 1.0)


@pytest.fixture(scope="module")
def rope():
    segment, names = FlexibleSegment("rope", 1.0, 0.1, RADIUS, links=16), ("rope:0%", "rope:50%", "w_rope")
    return System.build(objects=[(flexible_object([segment]), None, None)], point_frames=names)


def ends(places):
    return places[[0, len(places) // 2, -1]]


def errors(found, lines):
    truth = np.array([ends(lines[frame.index]) for frame in found.frame_reports if frame.is_good])
    return np.linalg.norm(found.position - truth, axis=2), found.position - truth


def test_a_rope_on_a_table(rope):
    lines, near = [snake(k) for k in range(3)], replace(OPTIONS, approximate_root_position=(-0.5, 0.0, 0.0))
    found = track_object(SceneDescription(rope), None, film(lines, TABLE), near)
    apart, off = errors(found, lines)
    assert len(found.t) == 3
    assert apart.max() < 4 * MILLIMETRE
    assert (np.abs(off) < 3 * found.std).all()
    assert "approximate_root_position" in found.root_note
    there = replace(OPTIONS, approximate_root_position=(0.5, 0.0, 0.0))
    other = track_object(SceneDescription(rope), None, film(lines[:1], TABLE), there)
    assert np.linalg.norm(other.position[0, 0] - lines[0][-1]) < 4 * MILLIMETRE
    assert found.recording_with_points(None).points[0].names == ("rope:0%", "rope:50%", "w_rope")


@pytest.mark.parametrize(("root", "word"), [("fixed", "stays in its place"), ("free", "higher")])
def test_the_root_of_a_hanging_rope_is_found(rope, root, word):
    lines = [swing(k) for k in range(3)]
    found = track_object(SceneDescription(rope), None, film(lines, WALL), replace(OPTIONS, root_placement=root))
    assert errors(found, lines)[0].max() < 5 * MILLIMETRE
    assert word in found.root_note


def test_a_rope_that_hands_turn_over_keeps_its_root(rope):
    """The end that was lower goes above the other; nothing but the frames before says which one it is."""
    turns = np.linspace(0.0, 0.9 * np.pi, 6)
    lines = [swing(1) @ np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]]).T for a in turns]
    found = track_object(SceneDescription(rope), None, film([places - [0, 0, 0.4] for places in lines], WALL), OPTIONS)
    roots = found.position[:, 0] + [0, 0, 0.4]
    truth = [np.array([places[k] for places in lines]) for k in (0, -1)]
    assert min(np.linalg.norm(roots - places, axis=1).max() for places in truth) < 5 * MILLIMETRE


def test_either_end_where_nothing_tells(rope):
    lines = [snake(k) for k in range(2)]
    found = track_object(SceneDescription(rope), None, film(lines, TABLE), OPTIONS)
    assert "one of two possible ends" in found.root_note
    assert all(frame.alternative_fit is not None for frame in found.frame_reports)


def test_branches_tell_where_the_root_is():
    branches = (
        FlexibleSegment(name, size, 0.1, RADIUS, links=4, parent="stem") for name, size in (("a", 0.3), ("b", 0.2))
    )
    segments = [FlexibleSegment("stem", 0.4, 0.1, RADIUS, links=5), *branches]
    names = ("stem:0%", "w_stem", "w_a", "w_b")
    system = System.build(objects=[(flexible_object(segments), None, None)], point_frames=names)

    def bow(start, angle, length, curve):
        s = np.linspace(0.0, length, 3000)
        steps = np.stack([np.cos(angle + curve * s), np.sin(angle + curve * s), 0 * s], axis=1) * (s[1] - s[0])
        return start + np.cumsum(steps, axis=0)

    rng, clouds, truth = np.random.default_rng(3), [], []
    for k in range(3):
        stem = bow([-0.35, 0.05 * k, 0.0], 0.1 * k, 0.4, 1.0 - 0.5 * k)
        angle = 0.1 * k + 0.4 * (1.0 - 0.5 * k)
        parts = (stem, bow(stem[-1], angle + 0.6, 0.3, 1.5), bow(stem[-1], angle - 0.7, 0.2, -1.0))
        counts = (1600, 1200, 800)
        clouds.append(np.concatenate([seen(p, TABLE, rng, count=n) for p, n in zip(parts, counts, strict=True)]))
        truth.append([stem[0], *(part[-1] for part in parts)])
    frames = frames_of(np.arange(3.0), clouds, TABLE)
    found = track_object(SceneDescription(system), None, frames, OPTIONS)
    assert np.linalg.norm(found.position - truth, axis=2).max() < 4 * MILLIMETRE
    assert "lengths and branches" in found.root_note


def crossing(s):
    angle = 2.8 * np.pi * s
    return np.stack([0.3 * np.sin(angle) + 0.8 * s, 0.3 * np.cos(angle), 0 * s], axis=1)


def folded(s):
    return np.stack([0.5 - np.abs(s - 0.5), 0.02 * (s > 0.5), 0 * s], axis=1)


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (lambda: line(crossing, 1.0) - [0.3, 0, 0], "crosses or touches itself"),
        (lambda: line(folded, 1.0) - [0.3, 0, 0], "cannot be followed from end to end"),
        (lambda: snake(1)[:1500], "the cloud has 0.7"),
        (lambda: snake(1)[::20][:20], "cannot be followed"),
    ],
)
def test_what_cannot_be_followed_is_refused_with_the_reason(rope, make, reason):
    with pytest.raises(DataError, match="no frame could be used") as caught:
        track_object(SceneDescription(rope), None, film([make()], TABLE), OPTIONS)
    assert reason in caught.value.what


def test_shapes_that_touch_themselves():
    def links(places):
        return np.stack([places[:-1], places[1:]], axis=1)

    radius = np.full(40, RADIUS)
    assert not is_shape_self_touching(links(snake(2)[::50]), radius[:39])
    cross = line(crossing, 1.0)[::50]
    assert is_shape_self_touching(links(cross), radius[:39])
    cross[:, 2] = np.linspace(0.0, 0.3, 40)  # a coil crosses nothing
    assert not is_shape_self_touching(links(cross), radius[:39])


def test_a_robot_says_where_the_root_is(rope):
    with pytest.raises(ConfigError, match="the robot determines the place"):
        track_object(SceneDescription(rope, "package:baxter"), None, film([snake(0)], TABLE), OPTIONS)


@pytest.mark.slow
def test_the_command_needs_no_recording(tmp_path, capsys):
    lines = [snake(k) for k in range(2)]
    vision.write_frame_folder(film(lines, TABLE), tmp_path / "frames")
    (tmp_path / "rope.yaml").write_text(CONFIG.replace("FRAMES", str(tmp_path / "frames")))
    assert main(["track", str(tmp_path / "rope.yaml"), "--out", str(tmp_path / "run")]) == 0, capsys.readouterr().err
    group = read_recording(tmp_path / "run" / "recording.h5").points[0]
    truth = np.array([places[[0, -1]] for places in lines])
    assert np.linalg.norm(group.position - truth, axis=2).max() < 4 * MILLIMETRE
    assert "approximate_root_position" in json.loads((tmp_path / "run" / "result.json").read_text())["root"]
