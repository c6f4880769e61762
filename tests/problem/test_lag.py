"""First-order lags beside the differential equation, their derivatives, and the way back."""

import itertools

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from yid_ocp.sensors.signal_filters import FirstOrderLag, ZeroPhaseLowPassFilter

H, N = 0.01, 40
RNG = np.random.default_rng(4)
VALUE = RNG.normal(size=(N, 2))
SLOPE = RNG.normal(size=(N, 2, 3))
BY = np.array([[1.0, 0.0, 0.3], [0.0, 1.0, 0.0]])
SLOW_PART = ZeroPhaseLowPassFilter(5.0).node_smoother(np.arange(N), N, H)


def lag(first: float = 0.02, second: float = 0.004, slow_part=None) -> FirstOrderLag:
    return FirstOrderLag(np.array([first, second]), BY, H, slow_part)


def solved(course, time_constant: float, start: float, times: np.ndarray, breaks: np.ndarray) -> np.ndarray:
    """T dz/dt = x(t) - z by another integrator, from break to break."""
    found, z = [], start
    for a, b in itertools.pairwise(breaks):
        inside = times[(times >= a) & (times < b)]
        run = solve_ivp(
            lambda t, y: (course(t) - y) / time_constant, (a, b), [z], dense_output=True, rtol=1e-9, atol=1e-11
        )
        found += [float(run.sol(t)[0]) for t in inside]
        z = float(run.y[0, -1])
    return np.array(found)


def test_steps_have_the_mean_of_the_differential_equation() -> None:
    mean, _ = lag().lagged_step_means(VALUE, None)
    breaks = H * np.arange(N + 1)
    fine = H / 20 * (np.arange(20 * N) + 0.5)
    for column, time in enumerate((0.02, 0.004)):
        held = VALUE[:, column]
        z = solved(lambda t, x=held: x[min(int(t / H + 1e-9), N - 1)], time, held[0], fine, breaks)
        np.testing.assert_allclose(mean[:, column], z.reshape(N, 20).mean(1), atol=2e-3)


def test_nodes_follow_straight_lines_between_them() -> None:
    followed, _ = lag().lagged_node_values(VALUE, None)
    times = H * np.arange(N)
    for column, time in enumerate((0.02, 0.004)):
        x = VALUE[:, column]
        z = solved(lambda t, x=x: np.interp(t, times, x), time, x[1], times[1:-1], times[1:])
        np.testing.assert_allclose(followed[1:-1, column], z, atol=1e-6)
        assert followed[0, column] == x[0]


def test_without_a_time_constant_all_is_followed_at_once() -> None:
    at_once = lag(0.0, 0.0)
    np.testing.assert_array_equal(at_once.lagged_step_means(VALUE, None)[0], VALUE)
    np.testing.assert_array_equal(at_once.lagged_node_values(VALUE, None)[0], VALUE)
    # and there is a slope all the same, that of a delay
    means, nodes = at_once.lagged_step_means(VALUE, None)[1], at_once.lagged_node_values(VALUE, np.zeros((N, 2, 3)))[1]
    np.testing.assert_allclose(means[1:, 0, 0], -np.diff(VALUE[:, 0]) / H)
    np.testing.assert_allclose(nodes[2:, 0, 0], -np.diff(VALUE[1:, 0]) / H)


def test_of_a_negative_time_constant_the_value_follows() -> None:
    """What a smooth value is said to follow, followed again, is the value."""
    t = 0.001 * np.arange(1200)
    value = np.stack([np.sin(5 * t), np.cos(3 * t)], axis=1)
    there, back = (FirstOrderLag(np.array([time, 0.0]), BY, 0.001) for time in (-0.03, 0.03))
    ahead, _ = there.lagged_node_values(value, None)
    again, _ = back.lagged_node_values(ahead, None)
    np.testing.assert_allclose(again[300:], value[300:], atol=2e-5)
    assert np.abs(ahead - value)[300:, 0].max() == pytest.approx(0.15, rel=0.02)
    np.testing.assert_array_equal(ahead[:, 1], value[:, 1])


@pytest.mark.parametrize("slow_part", [None, SLOW_PART])
@pytest.mark.parametrize(
    ("form", "size"),
    [("lagged_step_means", x) for x in (0.02, 1e-3)] + [("lagged_node_values", x) for x in (0.02, 1e-3, -0.02)],
)
def test_derivatives_agree_with_differences(form, size, slow_part) -> None:
    """By the time constant directly, and through what is followed."""
    _, slope = getattr(lag(size, slow_part=slow_part), form)(VALUE, SLOPE)
    for direction in range(3):
        above, below = (
            getattr(lag(*(np.array([size, 0.004]) + s * BY[:, direction]), slow_part), form)(
                VALUE + s * SLOPE[:, :, direction], None
            )[0]
            for s in (1e-7, -1e-7)
        )
        np.testing.assert_allclose(slope[:, :, direction], (above - below) / 2e-7, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("slow_part", [None, SLOW_PART])
@pytest.mark.parametrize("size", [0.02, -0.02])
def test_a_pull_comes_back_by_the_transpose(size, slow_part) -> None:
    pull = np.random.default_rng(5).normal(size=(N, 2))
    _, slope = lag(size, slow_part=slow_part).lagged_node_values(VALUE, SLOPE)
    back, direct = lag(size, slow_part=slow_part).lagged_node_values_adjoint(VALUE, pull)
    total = np.einsum("kn,knd->d", back, SLOPE) + direct
    np.testing.assert_allclose(total, np.einsum("kn,knd->d", pull, slope), rtol=1e-12)


def test_noise_of_the_followed_values_does_not_hide_a_lag() -> None:
    """Noise whose derivative is larger than the signal's lets a fit prefer no lag, unless only the slow part lags."""
    t, tried, best = H * np.arange(500), np.linspace(-0.01, 0.03, 41), []
    value = 10 * np.sin(5 * t)[:, None] + np.random.default_rng(6).normal(0, 2.0, (len(t), 1))
    recorded = 10 * np.sin(5 * t)[:, None] + 0.02 * 50 * np.cos(5 * t)[:, None]
    for slow_part in (None, ZeroPhaseLowPassFilter(5.0).node_smoother(np.arange(len(t)), len(t), H)):
        lags = [FirstOrderLag(np.array([-x]), np.ones((1, 1)), H, slow_part) for x in tried]
        left = [np.sum((own.lagged_node_values(value, None)[0] - recorded) ** 2) for own in lags]
        best.append(tried[np.argmin(left)])
    assert best[0] < 0.01
    assert best[1] == pytest.approx(0.02, abs=0.002)
