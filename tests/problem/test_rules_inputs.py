"""From a recording to what drives the model: torques, loads, paths, clamps, filters; rule by rule."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.signal
from scipy.spatial.transform import Rotation
from small_problems import joints, recording, seen

from yid_ocp.errors import DataError
from yid_ocp.model.objects.base import ClampPosePointNames
from yid_ocp.problem.measurements import TimeGrid
from yid_ocp.problem.recorded_inputs import (
    prescribed_coordinates_at_nodes,
    recorded_signal_kinds,
    smoothed_efforts_at_nodes,
    step_mean_input_delay_derivative,
    step_mean_inputs,
)
from yid_ocp.sensors.signal_filters import ZeroPhaseLowPassFilter, zero_phase_effort_filter

PLAIN = ZeroPhaseLowPassFilter(math.inf)


def driven(effort, t=None, kind="command"):
    effort = np.asarray(effort, float).reshape(-1, 1)
    t = 0.1 * np.arange(len(effort)) if t is None else np.asarray(t, float)
    return joints(["other", "a"], t, np.zeros((len(t), 2)), effort=np.hstack([99 + effort, effort]), effort_kind=kind)


HELD = {
    "step by step": (TimeGrid(0.0, 0.1, 3), 0.0, [1.0, 2.0, 4.0]),
    "two samples a step": (TimeGrid(0.0, 0.2, 2), 0.0, [1.5, 6.0]),
    "in between": (TimeGrid(0.05, 0.1, 2), 0.0, [1.5, 3.0]),
    "two steps a sample": (TimeGrid(0.0, 0.05, 4), 0.0, [1.0, 1.0, 2.0, 2.0]),
    "beyond the end": (TimeGrid(0.2, 0.1, 4), 0.0, [4.0, 8.0, 8.0, 8.0]),
    "before the start": (TimeGrid(-0.2, 0.1, 3), 0.0, [1.0, 1.0, 1.0]),
    "late": (TimeGrid(0.0, 0.1, 3), 0.1, [1, 1, 2]),
    "late by half a step": (TimeGrid(0.0, 0.1, 3), 0.05, [1, 1.5, 3]),
    "early": (TimeGrid(0.0, 0.1, 3), -0.1, [2, 4, 8]),
}


@pytest.mark.parametrize(("grid", "delay", "expected"), HELD.values(), ids=HELD)
def test_a_torque_is_held_from_sample_to_sample_and_averaged_over_a_step(grid, delay, expected):
    found = step_mean_inputs(driven([1.0, 2.0, 4.0, 8.0]), ("a",), grid, "run", np.array([delay]))
    np.testing.assert_allclose(found[:, 0], expected)


def test_an_uneven_clock_weighs_samples_by_how_long_they_are_held():
    found = step_mean_inputs(driven([1.0, 5.0, 9.0], [0.0, 0.15, 0.2]), ("a",), TimeGrid(0.0, 0.2, 1), "run")
    np.testing.assert_allclose(found, [[(0.15 * 1.0 + 0.05 * 5.0) / 0.2]])


def pointed(**how):
    return recording(None, seen(["p"], [0, 1], np.zeros((2, 1, 3)), **how))


CUBIC = np.polynomial.Polynomial([1, 2, -7, 5])
UNEVEN = np.array([0.0, 0.1, 0.25, 0.3, 0.45, 0.5, 0.65])


@pytest.mark.parametrize("kind", ["sample", None])
@pytest.mark.parametrize("delay", [0.0, 0.02])
def test_sampled_torque_is_a_smooth_course_whose_mean_a_step_takes(kind, delay):
    grid = TimeGrid(0.05, 0.02, 20)
    found = step_mean_inputs(driven(CUBIC(UNEVEN), UNEVEN, kind), ("a",), grid, "run", np.array([delay]))
    np.testing.assert_allclose(found[:, 0], np.diff(CUBIC.integ()(grid.node_times - delay)) / 0.02, rtol=1e-12)


def test_mean_torque_keeps_the_mean_over_every_recorded_interval():
    effort = np.random.default_rng(2).normal(size=12)
    t = 0.1 * np.arange(12)
    fine = step_mean_inputs(driven(effort, t, "mean"), ("a",), TimeGrid(0.0, 0.025, 44), "run")[:, 0]
    np.testing.assert_allclose(fine.reshape(11, 4).mean(axis=1), effort[:11], rtol=1e-12)
    times = np.append(t, 1.2)
    smooth = np.diff(times + times**2 - 7 * times**3) / 0.1
    grid = TimeGrid(0.0, 0.05, 22)
    found = step_mean_inputs(driven(smooth, t, "mean"), ("a",), grid, "run")[:, 0]
    times = grid.node_times
    np.testing.assert_allclose(found, np.diff(times + times**2 - 7 * times**3) / 0.05, rtol=1e-9)


@pytest.mark.parametrize(("kind", "first", "last"), [("command", 1, 5), ("sample", 1, 5), ("mean", 0.5, 5.5)])
def test_beyond_the_recording_torque_is_held(kind, first, last):
    made = driven([1.0, 2.0, 3.0, 4.0, 5.0], kind=kind)
    before = step_mean_inputs(made, ("a",), TimeGrid(-0.5, 0.1, 3), "run")[:, 0]
    np.testing.assert_allclose(before, first, rtol=1e-12)
    after = step_mean_inputs(made, ("a",), TimeGrid(0.55, 0.1, 3), "run")[:, 0]
    np.testing.assert_allclose(after, last, rtol=1e-12)


@pytest.mark.parametrize("kind", ["command", "sample", "mean"])
@pytest.mark.parametrize("delay", [0.03, 0.17, -0.04])
def test_the_slope_by_the_delay_is_that_of_differences(delay, kind):
    made, grid = driven([1.0, 2.0, 4.0, 8.0, 5.0, 1.0], kind=kind), TimeGrid(0.1, 0.1, 3)
    ends = [step_mean_inputs(made, ("a",), grid, "run", np.array([delay + sign * 1e-6])) for sign in (1, -1)]
    found = step_mean_input_delay_derivative(made, ("a",), grid, "run", np.array([delay]))
    np.testing.assert_allclose(found, (ends[0] - ends[1]) / 2e-6, rtol=1e-6, atol=1e-6)


def test_at_a_jump_the_slope_is_the_mean_of_both_sides():
    made, grid = driven([1.0, 2.0, 4.0, 8.0, 5.0, 1.0]), TimeGrid(0.1, 0.1, 3)
    at, *sides = (
        step_mean_input_delay_derivative(made, ("a",), grid, "run", np.array([delay])) for delay in (0.0, 1e-3, -1e-3)
    )
    np.testing.assert_allclose(at, np.mean(sides, axis=0))
    # beyond the ends the torque is held, and so does not change
    for first in (0.7, -0.7):
        beyond = step_mean_input_delay_derivative(made, ("a",), TimeGrid(first, 0.1, 2), "run", np.zeros(1))
        np.testing.assert_array_equal(beyond, np.zeros((2, 1)))


def test_nothing_driven_needs_no_torque_and_a_driven_joint_does():
    silent = joints(["a"], [0.0, 0.1], np.zeros((2, 1)))
    assert step_mean_inputs(silent, (), TimeGrid(0.0, 0.1, 3), "run").shape == (3, 0)
    with pytest.raises(DataError, match="joint efforts drive the model"):
        step_mean_inputs(silent, ("a",), TimeGrid(0.0, 0.1, 3), "run")
    with pytest.raises(DataError, match=r"(?s)'b' of the model is not recorded.*leave it out of model\.arms\.joints"):
        step_mean_inputs(driven([1.0, 2.0]), ("b",), TimeGrid(0.0, 0.1, 3), "run")


def test_loads_are_smoothed_and_interpolated():
    t = 0.01 * np.arange(200)
    effort = np.stack([np.ones(200), 3 * t + np.sin(2 * np.pi * 40 * t)], axis=1)
    made = recording(joints(["a", "b"], t, np.zeros((200, 2)), effort=effort))
    grid = TimeGrid(0.5, 0.025, 20)
    found = smoothed_efforts_at_nodes(made, ("b", "a"), grid, ZeroPhaseLowPassFilter(5.0))
    np.testing.assert_allclose(found[:, 0], 3 * grid.node_times, atol=1e-3)
    np.testing.assert_allclose(found[:, 1], 1.0, atol=1e-9)
    low_pass, made = ZeroPhaseLowPassFilter(5.0), made.with_effort_sampling_kind("mean")
    later = smoothed_efforts_at_nodes(made, ("b", "a"), grid, low_pass)
    np.testing.assert_allclose(later[1:, 0], found[1:, 0] - 3 * np.diff(t)[0] / 2, atol=1e-3)
    for without in (recording(joints(["a"], t, np.zeros((200, 1)))), pointed()):
        with pytest.raises(DataError, match=r"backlash\) needs joint efforts"):
            smoothed_efforts_at_nodes(without, ("a",), grid, PLAIN)


RECORDED = {
    "efforts": (recording(driven([1.0, 2.0])), {"joints.position", "joints.effort"}),
    "no efforts": (recording(joints(["a"], [0.0, 0.1], np.zeros((2, 1)))), {"joints.position"}),
    "points": (pointed(), set()),
    "camera by its pose": (pointed(camera_pose=np.eye(4)), {"camera"}),
    "camera by its name": (pointed(sensor_name="camera"), {"camera"}),
    "nominal clock": (pointed(clock="nominal"), {"nominal_clock"}),
}


@pytest.mark.parametrize(("made", "expected"), RECORDED.values(), ids=RECORDED)
def test_sensors_are_known_by_what_was_recorded(made, expected):
    assert recorded_signal_kinds([made]) == expected
    with_efforts, both = RECORDED["efforts"]
    assert recorded_signal_kinds([with_efforts, made]) == expected | both


def moving(*names):
    return SimpleNamespace(prescribed=names)


def test_a_prescribed_joint_follows_its_recorded_positions():
    t = 2.0 + 0.1 * np.arange(11)
    made = recording(joints(["a", "b"], t, np.stack([np.sin(t), t**2], axis=1)))
    grid = TimeGrid(2.0, 0.025, 40)
    found = prescribed_coordinates_at_nodes(made, moving("b", "a"), grid, PLAIN)
    np.testing.assert_allclose(found[:, 0], grid.node_times**2, atol=1e-9)
    np.testing.assert_allclose(found[:, 1], np.sin(grid.node_times), atol=1e-4)
    beyond = prescribed_coordinates_at_nodes(made, moving("b"), TimeGrid(1.9, 0.1, 13), PLAIN)
    assert beyond[0, 0] == pytest.approx(4.0)
    assert beyond[-1, 0] == pytest.approx(9.0)
    assert prescribed_coordinates_at_nodes(made, moving(), grid, PLAIN).shape == (41, 0)
    with pytest.raises(DataError, match="'a' is prescribed, but the recording has no joints"):
        prescribed_coordinates_at_nodes(pointed(), moving("a"), grid, PLAIN)


def clamped(origin, towards, t=None):
    t = 0.1 * np.arange(len(origin)) if t is None else t
    return recording(None, seen(["o", "d"], t, np.stack([origin, towards], axis=1)))


def path_of(made, grid, low_pass=None, towards="d"):
    clamps = (ClampPosePointNames("end", "o", towards),)
    return prescribed_coordinates_at_nodes(made, moving(*AXES), grid, low_pass or PLAIN, clamps)


AXES = tuple(f"end_{axis}" for axis in ("x", "y", "z", "rx", "ry", "rz"))


def test_a_clamp_stands_at_its_point_and_looks_along_its_direction():
    origin = np.cumsum(np.full((8, 3), [0.01, 0.02, -0.01]), axis=0)
    turned = Rotation.from_euler("XYZ", np.stack([np.linspace(0.3, 4.0, 8), np.linspace(-0.5, 0.8, 8), np.zeros(8)], 1))
    path = path_of(clamped(origin, origin + turned.apply([0.0, 0.0, 0.25])), TimeGrid(0.0, 0.1, 7))
    np.testing.assert_allclose(path[:, :3], origin, atol=1e-12)
    np.testing.assert_allclose(path[:, 3], np.linspace(0.3, 4.0, 8), atol=1e-9)
    np.testing.assert_allclose(path[:, 4], np.linspace(-0.5, 0.8, 8), atol=1e-9)


def test_a_transported_clamp_does_not_turn_about_its_axis():
    steps = 400
    angle = np.linspace(0.0, 2 * np.pi, steps + 1)
    direction = np.stack([0.5 * np.cos(angle), 0.5 * np.sin(angle), np.ones(steps + 1)], axis=1)
    made = clamped(np.zeros((steps + 1, 3)), direction, np.linspace(0.0, 1.0, steps + 1))
    path = path_of(made, TimeGrid(0.0, 1.0 / steps, steps))
    frames = Rotation.from_euler("XYZ", path[:, 3:])
    assert np.abs((frames[:-1].inv() * frames[1:]).as_rotvec()[:, 2]).max() < 1e-5
    # carried round a cone it comes back turned by the solid angle that it enclosed
    assert abs(path[-1, 5] - path[0, 5]) == pytest.approx(2 * np.pi * (1 - 1 / math.sqrt(1.25)), rel=1e-3)


def test_a_clamp_needs_two_points_apart_and_seen_often_enough():
    origin, grid = np.zeros((5, 3)), TimeGrid(0.0, 0.1, 4)
    with pytest.raises(DataError, match="its points 'o' and 'd' coincide at 0 s"):
        path_of(clamped(origin, origin), grid)
    hidden = np.tile([0.0, 0.0, 1.0], (5, 1))
    hidden[1, 2] = math.nan
    made = clamped(origin, hidden)
    np.testing.assert_allclose(path_of(made, grid), np.zeros((5, 6)), atol=1e-12)
    hidden[2] = math.nan
    with pytest.raises(DataError, match="'d' is seen in 3 frames"):
        path_of(clamped(origin, hidden), grid)
    with pytest.raises(DataError, match="there is no point 'x'"):
        path_of(made, grid, towards="x")


def test_a_course_is_smoothed_and_stays_where_it_was_seen_last():
    t = 0.01 * np.arange(300)
    line = np.stack([t, 2 * t, 0 * t], axis=1) + 0.1 * np.cos(2 * np.pi * 45 * t)[:, None]
    made = clamped(line, line + np.array([0.0, 0.0, 1.0]), t)
    found = path_of(made, TimeGrid(0.5, 0.1, 20), ZeroPhaseLowPassFilter(5.0))[:, :3]
    np.testing.assert_allclose(found, np.outer(TimeGrid(0.5, 0.1, 20).node_times, [1.0, 2.0, 0.0]), atol=2e-3)
    held = path_of(made, TimeGrid(2.9, 0.1, 3))
    np.testing.assert_allclose(held[2], held[3])


@pytest.mark.parametrize("frequency", [0.5, 5.0, 10.0, 20.0])
def test_the_filter_is_butterworths_of_order_four_forth_and_back(frequency):
    step, cutoff = 0.002, 5.0
    t = step * np.arange(10001)
    found = ZeroPhaseLowPassFilter(cutoff)(t, np.sin(2 * np.pi * frequency * t)[:, None])[:, 0]
    # bilinear transformation: frequencies are warped
    ratio = math.tan(math.pi * frequency * step) / math.tan(math.pi * cutoff * step)
    middle = slice(3000, 7000)
    np.testing.assert_allclose(found[middle], np.sin(2 * np.pi * frequency * t[middle]) / (1 + ratio**8), atol=1e-4)


@pytest.mark.parametrize("columns", [0, 2])
def test_it_begins_and_ends_steadily_as_signal_processing_has_it(columns):
    """With values that go on beyond both ends in mirror, as long as the filter remembers."""
    t, rng = 0.01 * np.arange(200), np.random.default_rng(2)
    values = np.cumsum(rng.standard_normal((200, columns)), axis=0)
    sections = scipy.signal.butter(4, 7.0 * 2 * 0.01, output="sos")
    expected = scipy.signal.sosfiltfilt(sections, values, axis=0, padlen=42)
    np.testing.assert_allclose(ZeroPhaseLowPassFilter(7.0)(t, values), expected, atol=1e-9)


def test_without_a_cutoff_values_are_as_they_were():
    values = np.random.default_rng(1).standard_normal((5, 2))
    assert PLAIN(np.arange(5.0), values) is values
    assert PLAIN.decorrelation_stride_for_step(0.01) == 1


def test_an_uneven_clock_is_resampled_in_between():
    t = np.sort(np.concatenate([0.01 * np.arange(400), [1.003, 2.5042]]))
    line = np.stack([2 + 3 * t], axis=1)
    np.testing.assert_allclose(ZeroPhaseLowPassFilter(5.0)(t, line), line, atol=2e-4)


def test_smoothed_values_tell_something_new_twice_a_period():
    for cutoff, step, stride in ((5.0, 0.01, 10), (5.0, 0.02, 5), (10.0, 0.01, 5), (30.0, 0.05, 1), (7.0, 0.01, 7)):
        assert ZeroPhaseLowPassFilter(cutoff).decorrelation_stride_for_step(step) == stride


@pytest.mark.parametrize("cutoff", [2.0, 5.0])
def test_what_lies_beyond_an_end_is_forgotten_after_settling(cutoff):
    """The slowest poles' response has fallen to a thousandth then."""
    step = 0.002
    settling = ZeroPhaseLowPassFilter(cutoff).end_distortion_duration
    sections = scipy.signal.butter(4, cutoff * 2 * step, output="sos")
    impulse = np.zeros(5000)
    impulse[0] = 1.0
    response = np.abs(scipy.signal.sosfilt(sections, impulse))
    assert 1e-4 < response[round(settling / step) :].max() / response.max() < 1e-2
    poles = np.log(scipy.signal.butter(4, cutoff * 2 * step, output="zpk")[1]) / step
    assert settling == pytest.approx(math.log(1e3) / np.abs(poles.real).min(), rel=1e-2)


@pytest.mark.parametrize("low_pass", [ZeroPhaseLowPassFilter(*args) for args in ((4.0,), (4.0, 2), (9.0,))])
def test_at_some_nodes_it_is_the_same_filter(low_pass):
    t, rng = 0.01 * np.arange(301), np.random.default_rng(1)
    values, nodes = rng.standard_normal((301, 2)), np.array([3, 120, 150, 299])
    made = low_pass.node_smoother(nodes, 301, 0.01)
    np.testing.assert_allclose(made.smooth(values)[nodes[1:3]], low_pass(t, values)[nodes[1:3]], atol=2e-3)
    np.testing.assert_array_equal(np.delete(made.smooth(values), nodes, axis=0), np.delete(values, nodes, axis=0))
    np.testing.assert_allclose(made.matrix.sum(axis=1), 1.0, rtol=1e-12)
    # what comes before a motion sets in does not count
    assert made.matrix[:, [0]].nnz == 0
    pull = rng.standard_normal((301, 2))
    assert np.sum(made.smoothing_adjoint(pull) * values) == pytest.approx(np.sum(pull * made.smooth(values)))


def test_two_passes_are_one_after_the_other():
    t, values = 0.01 * np.arange(301), np.random.default_rng(1).standard_normal((301, 2))
    once, twice = ZeroPhaseLowPassFilter(5.0), zero_phase_effort_filter(5.0)
    np.testing.assert_allclose(twice(t, values)[80:-80], once(t, once(t, values))[80:-80], atol=1e-3)
    assert (once.end_distortion_duration, twice.end_distortion_duration) == pytest.approx((0.574, 0.768), abs=1e-3)
    assert (twice.cutoff, twice.passes) == (5.0, 2)


@pytest.mark.parametrize("cutoff", [1.0, 4.0, 8.0, 40.0, math.inf])
def test_gains_turn_white_noise_into_that_of_value_rate_and_second_rate(cutoff):
    """Norms of the response to one sample, of its central difference and of its second difference."""
    step = 0.01
    impulse = np.zeros((4001, 1))
    impulse[2000] = 1.0
    value = ZeroPhaseLowPassFilter(cutoff)(step * np.arange(4001), impulse)[:, 0]
    rate = (value[2:] - value[:-2]) / (2 * step)
    second = (value[2:] - 2 * value[1:-1] + value[:-2]) / step**2
    expected = [np.linalg.norm(x) for x in (value, rate, second)]
    np.testing.assert_allclose(ZeroPhaseLowPassFilter(cutoff).noise_gains_of_value_and_rates(step), expected, rtol=1e-4)


def test_a_cutoff_lies_between_zero_and_half_the_sampling_rate():
    t = 0.01 * np.arange(300)
    for cutoff in (0.0, -1.0, 50.0, 51.0):
        with pytest.raises(DataError, match="path_cutoff"):
            ZeroPhaseLowPassFilter(cutoff)(t, np.zeros((300, 1)))
    assert ZeroPhaseLowPassFilter(49.9)(t, np.ones((300, 1))) == pytest.approx(1.0)


def test_short_records_are_padded_as_far_as_they_go():
    for count in (5, 20, 40):
        t = 0.01 * np.arange(count)
        np.testing.assert_allclose(ZeroPhaseLowPassFilter(3.0)(t, np.ones((count, 1))), 1.0, atol=1e-9)
