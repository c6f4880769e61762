"""Lengths and radii against clouds of smooth rods."""

from functools import cache

import numpy as np
import pytest
from smooth_rods import COARSE, Y_LENGTHS, Y_RADII, SmoothY, filmed, measured

from yid_ocp.errors import DataError
from yid_ocp.vision import CloudFilterOptions
from yid_ocp.vision.sequence_calibration import TubeDimensionEstimates

FRAMES = 3


@pytest.fixture(scope="module")
def track(alone):
    """track(lengths, radii, **options): a track of smooth rods of other sizes, and its errors [m]."""

    @cache
    def film(lengths, radii, frames):
        return filmed(SmoothY(Y_LENGTHS | dict(lengths), Y_RADII | dict(radii)), frames)

    @cache
    def make(lengths, radii, frames, options):
        return measured(alone, *film(lengths, radii, frames), **dict(options))

    def by_name(lengths=(), radii=(), frames=FRAMES, **options):
        return make(tuple(dict(lengths).items()), tuple(dict(radii).items()), frames, tuple(options.items()))

    return by_name


def ratio(found, name):
    return np.exp(found.dimensions.log_ratio[found.dimensions.names.index(name)])


def test_right_sizes_are_not_doubted(track):
    found, error = track()
    assert found.dimensions.n_frames == FRAMES
    assert not found.dimensions.contradicted_model_value_mask.any()
    assert not found.dimensions.messages
    assert np.nanmax(np.linalg.norm(error, axis=2)) < 0.006
    assert np.isfinite(error).mean() > 0.9


@pytest.mark.parametrize(("factor", "value"), [(1.1, "811 mm"), (0.9, "663 mm")])
def test_a_wrong_length_is_said_and_its_point_is_not_written(track, factor, value):
    found, error = track({"T3": factor * Y_LENGTHS["T3"]})
    assert found.dimensions.contradicted_model_value_mask.tolist() == [False, False, True, False, False, False]
    assert ratio(found, "T3.length") == pytest.approx(factor, abs=0.02)
    [message] = found.dimensions.messages
    assert "T3.length seems to be wrong" in message
    assert "the model has 737 mm" in message
    assert "estimated_dimensions: [length]" in message
    # the interval holds the truth
    i = found.dimensions.names.index("T3.length")
    assert abs(found.dimensions.log_ratio[i] - np.log(factor)) < 2 * found.dimensions.dimension_log_ratio_std[i]
    assert np.isnan(error[:, found.point_names.index("w_T3")]).all()
    assert np.nanmax(np.abs(error)) < 0.006


@pytest.mark.slow
def test_a_wrong_length_further_up_moves_everything_and_is_found(track):
    longer = {"T1": 1.1 * Y_LENGTHS["T1"]}
    found, error = track(longer, frames=3, filters=COARSE, estimated_dimensions=("length",))
    assert ratio(found, "T1.length") == pytest.approx(1.1, abs=0.02)
    assert np.nanmax(np.linalg.norm(error, axis=2)) < 0.012
    assert "T1.length is estimated: " in found.dimensions.messages[0]
    with pytest.raises(DataError, match=r"no point is known|no frame could be used") as caught:
        track(longer, frames=3, filters=COARSE)
    assert caught.value.what.startswith("the object's dimensions contradict the model (T1.length")
    assert "T1.length seems to be wrong" in caught.value.hint


def test_radii_wrong_by_a_third_are_said_and_enter_the_standard_deviation(track):
    found, error = track(radii={name: 1.3 * radius for name, radius in Y_RADII.items()})
    sizes = found.dimensions
    assert sizes.contradicted_model_value_mask.tolist() == [False, False, False, True, True, True]
    assert np.exp(sizes.log_ratio[3:]) == pytest.approx(1.3, abs=0.1)
    # the camera's side of a thicker tube is nearer to it: all points are off by that, and say so
    assert np.nanmean((error / found.std) ** 2) < 1.5
    plain, _ = track()
    assert np.nanmedian(found.std) > 1.5 * np.nanmedian(plain.std)


def test_estimated_radii_are_used(track):
    thin = {name: 0.7 * radius for name, radius in Y_RADII.items()}
    found, error = track(radii=thin, frames=4, estimated_dimensions=("radius",))
    assert np.exp(found.dimensions.log_ratio[3:]) == pytest.approx(0.7, abs=0.06)
    assert np.nanmax(np.linalg.norm(error, axis=2)) < 0.012


def test_an_end_outside_of_the_filters_box_tells_nothing_of_a_length(track):
    """What was cut off by a filter is no missing end."""
    found, _ = track(filters=CloudFilterOptions(box_lower=(0.0, -0.45, -2.0), box_upper=(2.0, 2.0, 2.0)))
    assert not found.dimensions.contradicted_model_value_mask[found.dimensions.names.index("T3.length")]
    assert all(np.isnan(frame.shape_fit.end_offsets[1]) for frame in found.frame_reports if frame.shape_fit is not None)


def test_what_sizes_do_to_points():
    """One size moves a point by 1 m per unit of its logarithm along x, another one along y."""
    moves = np.zeros((1, 3, 2))
    moves[0, 0, 0] = moves[0, 1, 1] = 1.0
    covariance = np.diag([0.01**2, 0.02**2])
    change = np.array([0.05, 0.05])  # five and two and a half standard deviations

    told = "the object's dimensions contradict the model (a.length is 1000 mm in the model, 1051 mm by the fit)"
    for used, std in (((False, False), [0.05, 0, 0]), ((True, False), [0.01, 0, 0]), ((True, True), [0.01, 0.02, 0])):
        check = TubeDimensionEstimates(("a.length", "a.radius"), np.ones(2), change, covariance, used, 5)
        assert check.point_std_from_dimensions(moves)[0] == pytest.approx(std)
        # a refusal names what contradicts the frames and has no estimate in its place
        assert check.contradiction_message == ("" if used[0] else told)
