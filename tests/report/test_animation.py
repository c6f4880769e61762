"""Stick figures and what was measured beside them."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from yid_ocp.data import JointGroup, PointGroup, Recording
from yid_ocp.effects import make_effect
from yid_ocp.model.flexible import Segment, flexible_object
from yid_ocp.model.kinematics import forward_kinematics
from yid_ocp.model.system import System
from yid_ocp.report.animation import ModelTrajectory, make_animation, recording_animation


def point(system: System, name: str, q: np.ndarray) -> np.ndarray:
    symbols = ca.SX.sym("q", system.n_coordinates)
    place = forward_kinematics(system.mechanism, symbols).frame_position(name)
    found = ca.Function("place", [symbols, system.parameters.symbols], [place])
    return np.array(found(q, system.parameters.vector())).ravel()


@pytest.fixture(scope="module")
def posed(single_arm):
    """Three postures, and the picture of the arm and the object in them."""
    q = np.random.default_rng(0).uniform(-0.5, 0.5, size=(3, single_arm.n_coordinates))
    return q, drawn(single_arm, q)


def drawn(system: System, q: np.ndarray):
    told = ModelTrajectory("predicted", system, system.parameters.vector(), np.arange(len(q)), q)
    return make_animation("a", [told]).motions[0]


def test_places_are_those_of_the_model(single_arm, posed):
    postures, motion = posed
    assert set(motion.point_indices) == set(single_arm.point_frames)
    for name, k in motion.point_indices.items():
        for q, now in zip(postures, motion.positions, strict=True):
            np.testing.assert_allclose(now[k], point(single_arm, name, q), atol=1e-12)


def test_sticks_are_the_links_of_the_object_and_the_arm(posed):
    _, motion = posed
    places = motion.positions
    own = [stick for stick in motion.sticks if stick.is_object_part]
    lengths = sorted(
        float(np.linalg.norm(places[0, a] - places[0, b])) for a, b in (stick.end_indices for stick in own)
    )
    links = sorted(4 * [0.813 / 4] + 4 * [0.610 / 4] + 4 * [0.737 / 4])
    np.testing.assert_allclose(lengths, links, atol=1e-9)
    assert sorted({stick.radius for stick in own}) == pytest.approx([0.019, 0.025, 0.032])
    assert len(motion.sticks) - len(own) >= 6
    for stick in motion.sticks:  # rigid, whatever the posture
        a, b = stick.end_indices
        assert np.ptp(np.linalg.norm(places[:, a] - places[:, b], axis=1)) < 1e-9


def test_what_an_effect_puts_under_the_object_is_no_arm():
    bare = System.build(objects=[(flexible_object([Segment("rod", 0.4, 0.1, 0.01, links=2)]), None, None)])
    system = bare.with_effects([make_effect("mount_compliance", "base", bare, {"stiffness": 12.0})])
    assert any("@" in name for name in system.mechanism.joint_names)
    sticks = drawn(system, np.zeros((1, system.n_coordinates))).sticks
    assert [stick.is_object_part for stick in sticks] == [True, True]


def test_a_scene_has_what_was_measured_beside_what_was_predicted(single_arm):
    n, t = single_arm.n_coordinates, np.linspace(0.0, 2.0, 401)
    q = 0.1 * np.sin(t)[:, None] * np.ones(n)
    at = [single_arm.mechanism.joint_index(name) for name in single_arm.driven]
    joints = JointGroup(tuple(single_arm.driven), t, q[:, at] + 0.01)
    seldom = np.array([0.5, 1.0, 1.5])
    seen = np.arange(9.0).reshape(3, 1, 3)
    seen[1] = np.nan
    recording = Recording(joints, (PointGroup("camera", ("w_T1",), seldom, seen),), name="a")
    told = ModelTrajectory("predicted", single_arm, single_arm.parameters.vector(), t, q)
    made = make_animation("a", [told], recording)
    assert [motion.name for motion in made.motions] == ["predicted", "measured"]
    assert len(made.t) == 150
    predicted, measured = made.motions
    assert measured.sticks
    assert not any(stick.is_object_part for stick in measured.sticks), "an object's shape is not measured"
    k = measured.point_indices["w_T1"]
    shown = np.isfinite(measured.positions[:, k]).all(axis=1)
    # half a period about every frame in which it was seen
    near = np.minimum(np.abs(made.t - 0.5), np.abs(made.t - 1.5))
    sure = np.abs(near - 0.25) > 1e-3
    np.testing.assert_array_equal(shown[sure], near[sure] <= 0.25)
    # it is a measurement of one moment alone
    np.testing.assert_array_equal(measured.is_new_measurement[:, 0], near <= 0.5 * np.median(np.diff(made.t)))
    np.testing.assert_array_equal(measured.positions[np.argmin(abs(made.t - 0.5)), k], seen[0, 0])
    arm, recorded = measured.sticks[0].end_indices[1], np.where(np.isin(np.arange(n), at), q[:1] + 0.01, q[:1])
    moved = drawn(single_arm, recorded).positions
    np.testing.assert_allclose(measured.positions[0, arm], moved[0, arm], atol=1e-9)
    page = made.to_dict()
    assert page["motions"][1]["places"][0][3 * k] is None
    first = np.array(page["motions"][0]["places"][0]).reshape(-1, 3) / page["scale"]
    np.testing.assert_allclose(first, predicted.positions[0], atol=0.51 / page["scale"])


def test_a_recording_alone_is_a_scene_where_it_has_places(single_arm):
    t = np.array([0.0, 0.1, 0.2])
    points = PointGroup("camera", ("w_T1",), t, np.ones((3, 1, 3)))
    theta = single_arm.parameters.vector()
    alone = recording_animation("a", single_arm, theta, Recording(None, (points,), name="a"))
    assert [motion.name for motion in alone.motions] == ["measured"]
    other = JointGroup(("elsewhere",), t, np.zeros((3, 1)))
    assert recording_animation("a", single_arm, theta, Recording(other, (), name="a")) is None
