import numpy as np
import pytest

from yid_ocp.data.recording import PointGroup, Recording
from yid_ocp.errors import DataError
from yid_ocp.problem.predictions import (
    clamp_displacement_baseline,
    constant_position_baseline,
    interpolated_displacement_baseline,
    measured_point_positions,
    position_rmse,
)

PARENT = ("p0", "p1", "p2", "p3", "p4")
NAMES = (*PARENT, "c1", "c2")
CHILDREN = {"c": ("p2", "c1", "c2")}


@pytest.fixture
def recording():
    """A straight chain along x with a child; its left end rises by 1 mm a frame, its right end by 3 mm."""
    frames = 11
    at = np.zeros((frames, len(NAMES), 3))
    at[:, :5, 0] = [0.0, 0.1, 0.2, 0.4, 0.5]
    at[:, 5:] = [[0.2, 0.1, 0.0], [0.2, 0.2, 0.0]]
    rise = 1e-3 * np.arange(frames)
    at[:, 0, 2], at[:, 4, 2] = rise, 3 * rise
    return Recording(points=(PointGroup("points", NAMES, 0.01 * np.arange(frames), at),), name="made")


def test_stay_repeats_the_last_given_frame(recording):
    predicted = constant_position_baseline(recording, NAMES)
    np.testing.assert_array_equal(predicted[:2], measured_point_positions(recording, NAMES)[:2])
    np.testing.assert_array_equal(predicted[2:], np.broadcast_to(predicted[1], (9, 7, 3)))


def test_all_points_move_with_the_mean_of_the_clamps(recording):
    predicted = clamp_displacement_baseline(recording, ("p2", "c1"), ("p0", "p4"))
    np.testing.assert_allclose(predicted[-1, :, 2], 2e-3 * 9)
    np.testing.assert_allclose(predicted[-1, :, :2], [[0.2, 0.0], [0.2, 0.1]])


def test_linear_carry_interpolates_along_the_arc_and_children_follow_their_junction(recording):
    predicted = interpolated_displacement_baseline(recording, ("p1", "p2", "p3", "c1", "c2"), PARENT, CHILDREN)
    # arc length as in the last given frame; the ends' heights differ by 2 mm there, which lengthens the chain by 1e-5
    np.testing.assert_allclose(predicted[-1, :, 2] / 9e-3, [1.4, 1.8, 2.6, 1.8, 1.8], rtol=1e-3)


def test_linear_carry_between_inner_points_holds_the_ends_beyond_them(recording):
    predicted = interpolated_displacement_baseline(recording, ("p2",), PARENT, CHILDREN, clamped=("p0", "p1", "p4"))
    np.testing.assert_allclose(predicted[-1, 0, 2], 3 * 9e-3 * 0.25, rtol=1e-3)


def test_baselines_never_look_at_free_points_after_the_given_frames(recording):
    seen = recording.points[0].position.copy()
    seen[2:, 1:4] += 7.0
    seen[2:, 5:] += 7.0
    other = Recording(points=(PointGroup("points", NAMES, recording.points[0].t, seen),), name="other")
    free = ("p1", "p2", "p3", "c1", "c2")
    for method in (
        lambda r: constant_position_baseline(r, free),
        lambda r: clamp_displacement_baseline(r, free, ("p0", "p4")),
        lambda r: interpolated_displacement_baseline(r, free, PARENT, CHILDREN),
    ):
        np.testing.assert_array_equal(method(recording)[2:], method(other)[2:])


def test_prediction_error_is_euclidean_and_leaves_out_given_frames_and_gaps():
    measured, predicted = np.zeros((4, 2, 3)), np.zeros((4, 2, 3))
    predicted[:2] = 100.0
    predicted[2:, 0] = [3.0, 4.0, 0.0]
    assert position_rmse(predicted, measured) == pytest.approx(np.sqrt(25 / 2))
    measured[2:, 1] = np.nan
    assert position_rmse(predicted, measured) == pytest.approx(5.0)
    assert np.isnan(position_rmse(predicted, np.full_like(measured, np.nan)))


@pytest.mark.parametrize(
    ("call", "text"),
    [
        (lambda r: constant_position_baseline(r, ("p9",)), "not recorded"),
        (lambda r: constant_position_baseline(r, ("p1",), given=0), "given = 0"),
        (lambda r: constant_position_baseline(r, ("p1",), given=11), "given = 11"),
        (lambda r: interpolated_displacement_baseline(r, ("c1",), PARENT), "belongs to no branch"),
        (lambda r: position_rmse(np.zeros((3, 1, 3)), np.zeros((4, 1, 3))), "differ in shape"),
    ],
)
def test_what_cannot_be_predicted_is_said(recording, call, text):
    with pytest.raises(DataError, match=text):
        call(recording)


def test_a_point_hidden_in_the_given_frame_is_said(recording):
    seen = recording.points[0].position.copy()
    seen[1, 2] = np.nan
    hidden = Recording(points=(PointGroup("points", NAMES, recording.points[0].t, seen),), name="hidden")
    with pytest.raises(DataError, match="'p2' is not seen"):
        constant_position_baseline(hidden, ("p2",))
