"""Pulses in made-up histories of a force: sizes and windows, and all that looks like one and is none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from yid_ocp.diagnosis.pulse_detection import DetectedForcePulse, ForceEstimate, _Rest, detect_force_pulses
from yid_ocp.diagnosis.thresholds import Thresholds
from yid_ocp.inference.null_test import benjamini_hochberg_mask
from yid_ocp.sensors.signal_filters import ZeroPhaseLowPassFilter

T = 0.1 * np.arange(80)
NOISE = 0.02


def history(values: np.ndarray, seed: int = 0, noise: float = NOISE, **changed) -> ForceEstimate:
    """What sensors of this noise say of a force, where the model may be wrong by 0.03."""
    measured = values + noise * np.random.default_rng(seed).standard_normal(len(values))
    made = ForceEstimate(
        "run", "elbow", "elbow", "N m", T, measured / noise**2, np.eye(len(T)) / noise**2, 0.03 + 0 * T, 0 * T
    )
    return replace(made, **changed)


def bell(begin: float, end: float, size: float) -> np.ndarray:
    return size * np.sin(np.pi * np.clip((T - begin) / (end - begin), 0, 1)) ** 2


def sure(of: ForceEstimate, limits: Thresholds | None = None) -> list[DetectedForcePulse]:
    found, tries = detect_force_pulses(of, limits or Thresholds())
    real = benjamini_hochberg_mask([pulse.p_value for pulse in found], tries, 0.01)
    return sorted((p for p, r in zip(found, real, strict=True) if r), key=lambda p: p.start_time)


def wobble() -> np.ndarray:
    """A rest that varies over seconds, as much as the pulses do."""
    return 0.3 * np.sin(2 * np.pi * T / 7.3) + 0.2


@pytest.mark.parametrize("seed", range(3))
def test_pulses_are_found_with_their_windows_and_impulses_beside_a_slow_rest(seed):
    truth = [(1.5, 2.1, 0.6), (5.0, 5.5, -0.5)]
    found = sure(history(wobble() + sum(bell(*entry) for entry in truth), seed))
    assert len(found) == 2
    for pulse, (begin, end, size) in zip(found, truth, strict=True):
        assert pulse.start_time == pytest.approx(begin, abs=0.1)
        assert pulse.end_time == pytest.approx(end, abs=0.1)
        impulse = size * (end - begin) / 2
        assert pulse.impulse == pytest.approx(impulse, rel=0.25)
        assert abs(pulse.impulse - impulse) < 3 * pulse.peak_std * pulse.impulse_per_unit_peak


def test_a_pulse_that_stays_at_its_size_is_flat():
    part = np.clip((T - 3.0) / 0.8, 0, 1)
    plateau = 0.5 * np.sin(np.pi / 2 * np.minimum(np.minimum(part, 1 - part) / 0.25, 1)) ** 2
    (pulse,) = sure(history(plateau))
    assert pulse.is_flat_topped
    assert pulse.impulse == pytest.approx(0.5 * 0.8 * 0.75, rel=0.15)


@pytest.mark.parametrize(
    "values",
    [
        pytest.param(0 * T, id="noise"),
        pytest.param(wobble(), id="what varies slowly"),
        pytest.param(0.4 * (T > 4.02), id="a step"),
        pytest.param(0.4 * np.sign(np.sin(2 * np.pi * T / 1.3)), id="friction that nobody modelled"),
        pytest.param(0.4 * np.sin(2 * np.pi * T / 0.9), id="an oscillation"),
        pytest.param(bell(2.0, 5.0, 0.5), id="what lasts longer than the longest event"),
    ],
)
@pytest.mark.parametrize("seed", range(2))
def test_what_is_no_pulse(values, seed):
    assert sure(history(values, seed)) == []


def test_the_threshold_grows_with_what_the_model_may_be_wrong_by():
    values = bell(3.0, 3.5, 0.3)
    assert len(sure(history(values))) == 1
    assert sure(history(values, model_error_std=0.3 + 0 * T)) == []


def test_friction_that_holds_may_change_by_twice_itself_wherever_a_joint_stands_still():
    values = bell(3.0, 3.5, 0.3)
    at_rest = np.where((T > 2.9) & (T < 3.3), 0.2, 0.0)
    assert sure(history(values, friction_limit=at_rest)) == []
    assert len(sure(history(values, friction_limit=at_rest / 4))) == 1
    assert len(sure(history(values, friction_limit=np.where(T > 6, 0.2, 0.0)))) == 1


@pytest.mark.parametrize("unit", [1.0, 1e-9, 1e9])
def test_the_likeliest_forces_are_those_measured_in_whatever_unit(unit):
    made, values = history(wobble()), NOISE**2 * history(wobble()).score
    scaled = replace(made, score=made.score / unit, information=made.information / unit**2)
    np.testing.assert_allclose(scaled.most_likely_force_signal / unit, values, rtol=1e-5)


def test_windows_longer_than_a_history_are_not_looked_at():
    made = history(wobble()).subset_at_time_indices(np.arange(20))
    tries = [detect_force_pulses(made, Thresholds(max_event_duration=longest))[1] for longest in (1.9, 5.0, 50.0)]
    assert tries[0] == tries[1] == tries[2] > 1


def test_a_filter_widens_what_is_seen_and_not_what_is_told():
    fine = np.arange(0, 8, 0.005)
    cutoff = 3.0
    narrow = 0.8 * np.where((fine > 4) & (fine < 4.3), np.sin(np.pi * (fine - 4) / 0.3) ** 2, 0)
    seen = np.interp(T, fine, ZeroPhaseLowPassFilter(cutoff)(fine, narrow[:, None])[:, 0])
    (pulse,) = sure(history(seen, noise=0.005, filter_cutoff=cutoff, model_error_std=0.01 + 0 * T))
    assert pulse.end_time - pulse.start_time < 0.5
    assert pulse.impulse == pytest.approx(0.8 * 0.15, rel=0.15)
    assert pulse.filtered_force_at(T, cutoff) == pytest.approx(seen, abs=0.06)


def test_the_evidence_is_a_gaussians():
    """Sigma^-1 y and the evidence against dense algebra."""
    made = history(bell(3.0, 3.5, 0.3), friction_limit=0.1 + 0 * T)
    apart, value = np.abs(T[:, None] - T), NOISE**2 * made.score

    def total(error, floor, slow):
        quick = (error * 0.03) ** 2 + floor**2 + 0.1**2 / 3
        covariance = quick * (np.eye(len(T)) + np.exp(-apart / 0.3)) / 2
        return covariance + slow**2 * np.exp(-apart / 2.0) + NOISE**2 * np.eye(len(T))

    def log_density(matrix: np.ndarray) -> float:
        return -0.5 * float(value @ np.linalg.solve(matrix, value)) - 0.5 * float(np.linalg.slogdet(matrix)[1])

    whole, other = (2.0, 0.05, 0.2), (1.0, 0.0, 0.05)
    rest, less = (_Rest.of(made, *sizes) for sizes in (whole, other))
    assert rest.precision == pytest.approx(np.linalg.inv(total(*whole)), rel=1e-5, abs=1e-4)
    assert rest.scored == pytest.approx(np.linalg.solve(total(*whole), value), rel=1e-5, abs=1e-4)
    gained = log_density(total(*whole)) - log_density(total(*other))
    assert rest.evidence - less.evidence == pytest.approx(gained, rel=1e-5, abs=1e-3)


def test_beside_a_pulse_that_was_taken_in_a_profile_gains_what_it_adds_to_it():
    made = history(wobble() + bell(3.0, 3.5, 0.3) + bell(5.0, 5.4, -0.4))
    rest, first = _Rest.of(made, 1.0, 0.05, 0.2), bell(3.0, 3.5, 1.0)
    profiles = np.stack([bell(3.1, 3.6, 1.0), bell(5.0, 5.4, 1.0), bell(1.0, 2.0, 1.0)], axis=1)
    beside = rest.beside(first[:, None])
    both = [rest.beside(np.stack([first, other], axis=1)) for other in profiles.T]
    added = [each.evidence - beside.evidence for each in both]
    np.testing.assert_allclose(beside.gains(profiles), added, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(beside.gains(profiles, rest.information(profiles)), added, rtol=1e-6, atol=1e-9)
