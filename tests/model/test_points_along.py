"""Points named by arc length: where they lie, however many links there are."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from yid_ocp.errors import ModelError
from yid_ocp.model import Mechanism, Segment, flexible_object, forward_kinematics
from yid_ocp.model.objects.base import CableTopology
from yid_ocp.model.objects.cable import cable_system
from yid_ocp.model.rotations import homogeneous_transform, rotation_from_rpy


def branched(links=4, **more):
    return flexible_object(
        (
            Segment("T1", 0.8, 0.08, 0.03, links, **more),
            Segment("T2", 0.5, 0.04, 0.01, links, parent="T1", rest_rotation=rotation_from_rpy(-0.8, 0.0, 0.0)),
        ),
        homogeneous_transform(np.eye(3), [0.1, 0.2, 0.3]),
    )


def places(tree: Mechanism, names, q=None, values=None):
    """Poses (4, 4) of frames at a configuration."""
    q = np.zeros(len(tree.joints)) if q is None else q
    kinematics = forward_kinematics(tree.with_numeric_values(values), ca.SX(ca.DM(q)))
    return [np.array(ca.DM(kinematics.frame_pose(name).homogeneous_matrix())) for name in names]


def bent(tree: Mechanism):
    return np.random.default_rng(3).uniform(-0.4, 0.4, len(tree.joints))


@pytest.mark.parametrize("links", [1, 2, 3, 4, 7, 8])
@pytest.mark.parametrize("percent", [0.0, 10.0, 25.0, 33.3, 50.0, 99.0, 100.0])
def test_a_percentage_is_that_part_of_the_length_however_many_links(links, percent):
    tree = branched(links).mechanism
    first, second, junction = places(tree, [f"T1:{percent:g}%", f"T2:{percent:g}%", "w_T1"])
    np.testing.assert_allclose(first[:3, 3], [0.1, 0.2, 0.3 + 0.8 * percent / 100], atol=1e-12)
    away = np.linalg.norm(second[:3, 3] - junction[:3, 3])
    assert away == pytest.approx(0.5 * percent / 100, abs=1e-12)


@pytest.mark.parametrize(("percent", "before", "after", "part"), [(40, "T1_0_tip", "T1_1_tip", 0.6), (85, 2, 3, 0.4)])
def test_inside_a_link_it_lies_on_the_straight_line_and_turns_with_it(percent, before, after, part):
    tree = branched().mechanism
    ends = [name if isinstance(name, str) else f"T1_{name}_tip" for name in (before, after)]
    near, far, point = places(tree, [*ends, f"T1:{percent}%"], bent(tree))
    np.testing.assert_allclose(point[:3, 3], near[:3, 3] + part * (far - near)[:3, 3], atol=1e-12)
    np.testing.assert_allclose(point[:3, :3], far[:3, :3], atol=1e-12)


def test_unequal_links_are_counted_by_their_lengths():
    tree = flexible_object([Segment("T1", 0.0, 0.1, 0.01, link_lengths=[0.1, 0.5, 0.2])]).mechanism
    heights = [pose[2, 3] for pose in places(tree, [f"T1:{p}%" for p in (5, 12.5, 50, 90)])]
    assert heights == pytest.approx([0.04, 0.1, 0.4, 0.72])


def test_points_stay_when_the_tree_is_put_together():
    """On a robot, after another joint was inserted before it, and with numbers for its parameters."""
    base = flexible_object([Segment("B", 0.3, 0.1, 0.01, 2)]).mechanism
    base = replace(base, frames={name: frame for name, frame in base.frames.items() if name != "object_root"})
    tree = base.with_attached_mechanism(
        branched().mechanism, "B:50%", homogeneous_transform(np.eye(3), [1.0, 0.0, 0.0])
    )
    found = places(tree, ["B:50%", "T1:40%"])
    np.testing.assert_allclose(found[0][:3, 3], [0.0, 0.0, 0.15], atol=1e-12)
    np.testing.assert_allclose(found[1][:3, 3], [1.1, 0.2, 0.15 + 0.3 + 0.32], atol=1e-12)
    more = tree.with_inserted_joints(2, [replace(tree.joints[0], name="extra")])
    [again] = places(more, ["T1:40%"])
    np.testing.assert_allclose(again, found[1], atol=1e-12)


def test_a_cable_is_counted_from_clamp_to_clamp():
    parent = ("a", "b", "c", "d", "e")
    shape = {name: [0.1 * i, 0.0, 0.0] for i, name in enumerate(parent)} | {"f": [0.2, 0.0, 0.1]}
    cable = CableTopology(parent, {"child": ("c", "f")}, shape)
    tree = cable_system(dict.fromkeys(cable.edges, 0.1), cable).mechanism
    along = places(tree, ["parent:0%", "parent:12.5%", "parent:25%", "parent:50%", "parent:100%", "child:50%"])
    a, b, c, e, f = places(tree, ["a", "b", "c", "e", "f"])
    for found, place in zip(along, (a, (a + b) / 2, b, c, e, (c + f) / 2), strict=True):
        np.testing.assert_allclose(found[:3, 3], place[:3, 3], atol=1e-12)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("T1:140%", "'140%' is no place along 'T1'"),
        ("T1:-1%", "a percentage of its length from 0% to 100%, base to tip"),
        ("T1:40", "T1:40%"),
        ("T1:half", "'half' is no place along 'T1'"),
        ("T1:nan%", "'nan%' is no place"),
        ("T9:40%", "there is no frame 'T9:40%'"),
        ("T9:40%", ":40%'?"),
        ("w_T9", "did you mean 'w_T"),
    ],
)
def test_what_is_no_place_is_refused(name, words):
    tree = branched().mechanism
    with pytest.raises(ModelError) as refused:
        tree.frame(name)
    assert words in str(refused.value)
    assert tree.has_frame(name) == name.startswith("T1:")
