"""What a recording says against itself: every fault is told by its cause, and a recording without one by none."""

import re
from dataclasses import replace

import numpy as np
import pytest
from made_series import without

from yid_ocp.data.channel_checks import ISSUE_CAUSE_DESCRIPTIONS, Issue, typical_point_pair_distances
from yid_ocp.data.checks import duplicate_data_issue, recording_quality_issues, split_recording_at_gaps
from yid_ocp.data.recording import JointGroup, PointGroup, Recording
from yid_ocp.errors import DataError
from yid_ocp.problem.options import SensorOptions
from yid_ocp.sensors.joints import joint_angle_noise_std

NAMES = ("a", "b", "c")
STD = 1e-4


def made(seed: int = 1, duration: float = 8.0, rate: float = 100.0, **more) -> Recording:
    """Three joints in motion with noise, velocities and efforts, and a point that a slow camera sees."""
    rng, t = np.random.default_rng(seed), np.arange(round(duration * rate) + 1) / rate
    phase, wave = rng.uniform(0, 6, 3), 2 * np.pi * np.array([0.3, 0.5, 0.7])
    angle = 0.4 * np.sin(wave * t[:, None] + phase)
    rate_of = 0.4 * wave * np.cos(wave * t[:, None] + phase)
    effort = 5 * np.sin(0.7 * wave * t[:, None]) + 0.05 * rng.standard_normal(angle.shape)
    position = angle + STD * rng.standard_normal(angle.shape)
    velocity = rate_of + 5e-3 * rng.standard_normal(angle.shape)
    stds = {"position_std": np.full(3, STD), "effort_std": 0.05}
    joints = JointGroup(NAMES, t, position, velocity=velocity, effort=effort, **stds, **more)
    at = np.arange(0.2, duration, 0.3)
    seen = np.stack([np.sin(at), np.cos(at), 0 * at], axis=1)[:, None, :]
    camera = PointGroup("points_camera", ("p",), at, seen, np.full(seen.shape, 5e-3), "camera")
    return Recording(joints, (camera,), name="made")


def changed(recording: Recording, **fields) -> Recording:
    return replace(recording, joints=replace(recording.joints, **fields))


def column(values, j, change):
    values = np.array(values)
    values[:, j] = change(values[:, j])
    return values


def causes(recording, **sensors) -> set[str]:
    chosen = {name.replace("_", "."): options for name, options in sensors.items()}
    found = recording_quality_issues(recording, lambda group: chosen.get(group, SensorOptions()))
    assert all(own.recording == recording.name and own.advice and own.limit_violation_ratio >= 1 for own in found)
    return {doubt.cause for doubt in found}


@pytest.mark.parametrize("seed", range(12))
def test_a_recording_without_a_fault_is_not_in_doubt(seed):
    assert causes(made(seed, rate=[50.0, 100.0, 500.0][seed % 3])) == set()


def test_steps_as_large_as_the_stated_noise_and_a_rest_on_one_of_them_are_not_in_doubt():
    step = 12**0.5 * STD
    assert causes(changed(RECORDING, position=step * np.rint(POSITION / step), velocity=None)) == set()
    # however coarse an encoder is, if the recording says so
    coarse = changed(RECORDING, position=0.01 * np.rint(POSITION / 0.01), position_resolution=0.01)
    assert "quantised" in causes(replace(coarse, joints=replace(coarse.joints, position_resolution=None)))
    assert causes(coarse) == causes(changed(coarse, position_std=None)) == set()
    rest, still = column(POSITION, 1, lambda x: 0 * x + 0.3), column(VELOCITY, 1, lambda v: 0 * v)
    assert causes(changed(RECORDING, position=rest, velocity=still, position_std=None)) == set()
    # a constant command holds a joint that stands
    first = np.arange(len(EFFORT)) < 300
    held = changed(RECORDING, effort=column(EFFORT, 1, lambda x: np.where(first, 1.7, x)), velocity=None)
    stands = column(POSITION, 1, lambda x: np.where(first, STD * NOISE[:, 1], x))
    assert ("stuck" in causes(held), "stuck" in causes(changed(held, position=stands))) == (True, False)


@pytest.mark.parametrize("step", [1e-4, 2 * np.pi / 4096])
def test_a_joint_that_stands_between_two_motions_is_not_stuck_but_one_that_misses_a_motion_is(step):
    recording = made()
    t = recording.joints.t
    # to 0.6 rad, a rest of 2 s, and back
    x = np.clip(np.where(t < 5, t - 1, 7 - t) / 2, 0, 1)
    angle = 0.6 * (10 * x**3 - 15 * x**4 + 6 * x**5)
    others = changed(recording, velocity=None, effort=None, position_std=None)
    rounded = step * np.rint(angle / step)
    assert "stuck" not in causes(changed(others, position=column(POSITION, 2, lambda _: rounded)))
    if step > 1e-3:  # of which slow motion repeats many values
        k = np.clip(np.arange(len(t)) - 300, 0, None)  # after a breakaway from stiction, 2, 8, 18 ... steps
        leaps = step * np.where(k < 10, 2 * k**2, 200 + 40 * (k - 10))
        assert "stuck" not in causes(changed(others, position=column(POSITION, 2, lambda _: leaps)))
        return
    misses = np.where((t > 1.8) & (t < 2.3), rounded[np.searchsorted(t, 1.8)], rounded)
    assert "stuck" in causes(changed(others, position=column(POSITION, 2, lambda _: misses)))


def test_noise_from_a_clock_that_is_known_by_its_period_only_is_no_noise():
    recording = made()
    t, rng = recording.joints.t, np.random.default_rng(0)
    angle = np.stack([np.interp(t + rng.uniform(-3e-3, 3e-3, len(t)), t, x) for x in recording.joints.position.T], 1)
    assert "noise" in causes(changed(recording, position=angle))
    assert causes(changed(recording, position=angle, clock="nominal")) == set()


RECORDING = made()


def timed(joints, points):
    """The recording with times that are computed from its own."""
    group = RECORDING.points[0]
    points = (replace(group, t=points(group.t)),)
    return replace(changed(RECORDING, t=joints(RECORDING.joints.t)), points=points)


POSITION, VELOCITY, EFFORT = RECORDING.joints.position, RECORDING.joints.velocity, RECORDING.joints.effort
NOISE = np.random.default_rng(2).standard_normal(EFFORT.shape)


def turned(j, change):
    return changed(RECORDING, position=column(POSITION, j, change))


FAULTS = {
    "milliseconds": (timed(lambda t: 1e3 * t, lambda t: 1e3 * t), {"time_unit"}),
    "nanoseconds": (timed(lambda t: 1e9 * t, lambda t: 1e9 * t), {"time_unit"}),
    "ten times as fast": (timed(lambda t: 0.1 * t, lambda t: 0.1 * t), {"time_scale"}),
    "since 1970": (timed(lambda t: t + 1.7e9, lambda t: t), {"clock_base"}),
    "a late camera": (timed(lambda t: t, lambda t: t + 3.0), {"clock_offset"}),
    "an early camera": (timed(lambda t: t, lambda t: t - 3.0), {"clock_offset"}),
    "degrees": (changed(RECORDING, position=np.degrees(POSITION), position_std=np.degrees(STD)), {"degrees"}),
    "degrees per second": (changed(RECORDING, velocity=np.degrees(VELOCITY)), {"degrees"}),
    "one angle too large": (turned(1, lambda x: 20 * x), {"angle_scale", "noise"}),
    "one angle turned": (turned(1, lambda x: -x), {"angle_sign"}),
    "two angles exchanged": (changed(RECORDING, position=POSITION[:, [1, 0, 2]]), {"swapped_joints"}),
    "a stuck encoder": (turned(2, lambda x: np.where(np.arange(len(x)) > 300, x[300], x)), {"stuck"}),
    "all repeat one sample": (changed(RECORDING, position=0 * POSITION + 0.1, velocity=None, effort=None), {"stuck"}),
    "coarse angles": (changed(RECORDING, position=0.01 * np.rint(POSITION / 0.01)), {"quantised"}),
    "coarse efforts": (changed(RECORDING, effort=np.rint(EFFORT)), {"quantised"}),
    "noisy efforts": (changed(RECORDING, effort=EFFORT + 0.5 * NOISE), {"noise"}),
    "clipped efforts": (changed(RECORDING, effort=np.clip(EFFORT, -4, 3)), {"saturated"}),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_told_by_its_cause(fault):
    recording, expected = FAULTS[fault]
    assert causes(recording) == expected


def test_commands_may_end_at_a_bound():
    recording, _ = FAULTS["clipped efforts"]
    assert causes(changed(recording, effort_kind="command")) == set()
    assert causes(recording, joints_effort=SensorOptions(effort_sampling_kind="command")) == set()
    commands = changed(recording, effort_kind="command")
    assert causes(commands, joints_effort=SensorOptions(effort_sampling_kind="sample")) == {"saturated"}


def test_noise_that_settings_state_counts_instead_of_the_recorded():
    recording, _ = FAULTS["noisy efforts"]
    assert causes(recording, joints_effort=SensorOptions(std=0.5)) == set()
    assert causes(recording, joints_effort=SensorOptions(std=dict.fromkeys(NAMES, 0.1))) == {"noise"}
    assert causes(made(), joints_effort=SensorOptions(std=0.005)) == {"noise"}


def test_noise_stated_far_above_what_is_there():
    recording = changed(made(), effort_std=np.array([1.0, 0.05, 1.0]))
    (doubt,) = recording_quality_issues(recording, lambda _: SensorOptions())
    assert (doubt.cause, doubt.severity, doubt.group) == ("noise_overstated", "warning", "joints")
    assert re.fullmatch(r"sensors.joints.effort.std: {a: 0.0[56]\d*, b: 0.05, c: 0.0[56]\d*}", doubt.setting)
    assert "not 1 N m as stated (too large for 2 of 3 such channels)" in doubt.what
    # one number for all joints holds for the noisiest
    noisy = column(EFFORT, 0, lambda x: x + 0.5 * np.random.default_rng(3).standard_normal(len(x)))
    assert causes(changed(made(), effort=noisy, effort_std=0.5)) == set()
    assert causes(changed(made(), effort_std=0.2)) == set()


def test_what_a_sensor_smooths_is_computed_or_weighed_by_settings_is_not_overstated():
    recording = made(rate=1000.0)
    slow = np.random.default_rng(5).standard_normal((len(recording.joints.t) + 20, 3))
    slow = np.stack([np.convolve(x, np.full(21, 21**-0.5), "valid") for x in slow.T], axis=1)
    assert causes(changed(recording, effort=5 * np.sin(recording.joints.t)[:, None] + 0.05 * slow)) == set()
    recording = changed(made(), effort_std=1.0)
    assert causes(recording) == {"noise_overstated"}
    assert causes(recording, joints_effort=SensorOptions(std=1.0)) == set()
    assert causes(recording, joints_effort=SensorOptions(use=False)) == set()
    assert causes(changed(recording, effort_kind="command")) == set()
    assert causes(changed(recording, effort=5 * np.sin(recording.joints.t)[:, None] * np.ones(3))) == set()


def test_a_camera_that_runs_longer_than_the_joints_at_both_ends_is_not_late():
    t = np.arange(-4.0, 12.0, 0.3)
    longer = replace(RECORDING.points[0], t=t, position=np.ones((len(t), 1, 3)) * np.sin(t)[:, None, None], std=None)
    assert causes(replace(RECORDING, points=(longer,))) == set()


def test_half_of_the_samples_missing_is_a_warning():
    rows = np.random.default_rng(1).random(len(RECORDING.joints.t)) > 0.5
    thin = {name: values[rows] for name, values in RECORDING.joints.values_by_channel.items()}
    assert causes(changed(RECORDING, t=RECORDING.joints.t[rows], **thin)) == {"dropped_samples"}


def test_nothing_moves():
    rng, group = np.random.default_rng(1), RECORDING.points[0]
    position, velocity = STD * rng.standard_normal(POSITION.shape), 5e-3 * rng.standard_normal(POSITION.shape)
    still = replace(group, position=1 + 5e-3 * rng.standard_normal(group.position.shape))
    assert causes(replace(changed(RECORDING, position=position, velocity=velocity), points=(still,))) == {"standstill"}


def test_one_measurement_listed_twice_is_told_also_in_part():
    assert duplicate_data_issue(RECORDING, replace(RECORDING, name="again")).cause == "same_data"
    part = replace(RECORDING.time_slice(2.0, 6.0), name="part")
    assert duplicate_data_issue(RECORDING, part).what.startswith("401 samples of part")
    assert duplicate_data_issue(RECORDING, made(2)) is None


def encoder_counts_per_turn(seed: int, n: int = 3000) -> Recording:
    """A slow motion of one joint, read to a 4096th of a turn at uneven times."""
    t = np.cumsum(0.0053 + 0.0005 * np.random.default_rng(seed).uniform(-1, 1, n))
    angle, step = np.sin(0.7 * t + seed) + 0.3 * np.sin(1.9 * t), 2 * np.pi / 4096
    return Recording(JointGroup(("a",), t - t[0], step * np.rint(angle / step)[:, None]), name=f"run_{seed}")


def test_the_step_of_an_encoder_is_noise_of_its_variance_stated_or_seen_in_gaps_between_values():
    step, unstated = 2 * np.pi / 4096, SensorOptions()
    seen = encoder_counts_per_turn(1, n=400).joints
    assert joint_angle_noise_std(replace(seen, position_std=0.0), ("a",), unstated, "") == pytest.approx(step / 12**0.5)
    both = replace(seen, position_std=3e-4, position_resolution=1e-3)
    assert joint_angle_noise_std(both, ("a",), unstated, "") == pytest.approx(np.hypot(3e-4, 1e-3 / 12**0.5))
    assert joint_angle_noise_std(both, ("a",), SensorOptions(std=1e-4), "") == 1e-4
    # without steps there are none, however short the recording is
    smooth = replace(seen, position=seen.position + 1e-4 * np.random.default_rng(0).standard_normal((400, 1)))
    assert joint_angle_noise_std(replace(smooth, position_std=1e-4), ("a",), unstated, "") == 1e-4


def test_equal_counts_of_an_encoder_are_no_second_copy_but_a_copied_stretch_is():
    one, other = encoder_counts_per_turn(1), encoder_counts_per_turn(2)
    assert np.isin(other.joints.position, one.joints.position).mean() > 0.8
    assert duplicate_data_issue(one, other) is None
    steady = replace(one, joints=replace(one.joints, t=0.005 * np.arange(3000)))
    alike = replace(other, joints=replace(other.joints, t=0.005 * np.arange(3000)))
    assert duplicate_data_issue(steady, alike) is None
    for whole in (one, steady):
        part = replace(whole.time_slice(5.0, 8.0), name="part")
        assert "samples of part equal samples of run_1 to the last digit" in duplicate_data_issue(whole, part).what


def test_few_samples_of_the_joints_are_serious_and_few_frames_beside_them_are_not():
    few, serious = [("points_camera", "warning")], [("joints", "not_trusted")]
    for until, span, said in ((0.02, np.inf, serious), (0.6, np.inf, few), (9.0, 0.6, few), (9.0, 9.0, [])):
        issues = recording_quality_issues(made().time_slice(0.0, until), lambda _: SensorOptions(), span)
        assert [(own.group, own.severity) for own in issues if own.cause == "few_samples"] == said


def test_doubts_have_a_cause_that_is_listed_and_say_how_sure_they_are():
    with pytest.raises(ValueError, match="no cause 'bad'"):
        Issue("bad", "", "warning", 1.0, "", "r")
    words = [Issue("noise", "", "warning", evidence, "", "r").certainty_word for evidence in (0.5, 1.6, 4.0)]
    words.append(Issue("few_samples", "", "warning", 1.3, "", "r").certainty_word)
    assert words == ["perhaps", "likely", "certain", "certain"]
    assert Issue("gap", "", "warning", np.inf, "", "r", "joints", "t", 1.0, 2.0).location_text == "r/joints/t, 1 to 2 s"
    assert len(set(ISSUE_CAUSE_DESCRIPTIONS.values())) == len(ISSUE_CAUSE_DESCRIPTIONS)


def test_a_recording_is_cut_at_a_gap_and_every_part_is_kept_where_it_may_start_in_motion():
    parts, (doubt,) = split_recording_at_gaps(without(made(), 3.0, 5.0), (), True)
    assert [(p.joints.t[0], p.joints.t[-1]) for p in parts] == [(0.0, 2.99), (5.01, 8.0)]
    assert [p.name for p in parts] == ["made_part1", "made_part2"]
    assert (doubt.cause, doubt.severity, doubt.begin, doubt.end) == ("gap", "warning", 2.99, 5.01)
    assert "2 parts of the data (5.98 s) are used" in doubt.what


def test_where_a_model_starts_from_rest_only_parts_that_do_are_kept():
    recording = without(made(), 3.0, 5.0)
    parts, (doubt,) = split_recording_at_gaps(recording, (), False)
    assert [(p.name, p.joints.t[-1]) for p in parts] == [("made", 2.99)]
    assert "a part must start at rest" in doubt.what
    resting = np.where(np.abs(recording.joints.t - 5.2) < 0.3, 0.0, 1.0)[:, None] * recording.joints.position
    assert len(split_recording_at_gaps(changed(recording, position=resting), (), False)[0]) == 2


def test_a_few_samples_missing_are_no_gap_and_short_parts_are_left_out():
    assert split_recording_at_gaps(without(made(), 3.0, 3.05), (), True)[1] == []
    assert [p.joints.t[0] for p in split_recording_at_gaps(without(made(), 0.3, 1.0), (), True)[0]] == [1.01]


def test_a_clock_that_jumps_is_told_from_joints_that_went_on_unseen():
    recording = made()
    late = np.where(recording.joints.t > 4.0, 2.0, 0.0)
    parts, doubts = split_recording_at_gaps(changed(recording, t=recording.joints.t + late), (), True)
    assert [doubt.cause for doubt in doubts] == ["clock_jump"]
    assert len(parts) == 2


def test_points_that_drive_a_model_may_be_hidden_for_a_while():
    t = np.arange(500) / 100
    seen = np.zeros((500, 2, 3)) + np.sin(t)[:, None, None]
    seen[200:300, 0] = np.nan
    recording = Recording(None, (PointGroup("points", ("p0", "p5"), t, seen),), name="cable")
    assert [len(p.points[0].t) for p in split_recording_at_gaps(recording, ("p0",), True)[0]] == [200, 200]
    assert split_recording_at_gaps(recording, ("p5",), True)[1] == []


def stretched(lengths: list[float], name: str = "r") -> Recording:
    """Two points that are so far apart in each frame."""
    position = np.zeros((len(lengths), 2, 3))
    position[:, 1, 0] = lengths
    return Recording(points=(PointGroup("points", ("a", "b"), np.arange(len(lengths)), position),), name=name)


def test_lengths_are_means_over_frames_and_medians_over_recordings() -> None:
    recordings = [stretched([1.0, 2.0, np.nan]), stretched([5.0]), stretched([3.0, 3.0])]
    assert typical_point_pair_distances([("a", "b")], recordings) == {("a", "b"): 3.0}
    assert typical_point_pair_distances([("a", "b")], recordings[:1], frames=1) == {("a", "b"): 1.0}
    # between points of two groups at the times of the slower one, where the other is interpolated
    slow = PointGroup("slow", ("c",), [0.5, 0.75, 7.0], 4 * np.eye(3)[:, None])
    two = Recording(points=(*stretched([1.0, 2.0, 3.0, 4.0]).points, slow))
    expected = (2.5 + np.hypot(1.75, 4.0)) / 2  # of b at 1.5 and 1.75 from c at 4 along x and along y
    assert typical_point_pair_distances([("b", "c")], [two])["b", "c"] == pytest.approx(expected)
    # one that never shows an edge does not count
    hidden, seen = stretched([np.nan]), stretched([2.0])
    assert typical_point_pair_distances([("a", "b")], [hidden, seen]) == {("a", "b"): 2.0}
    with pytest.raises(DataError, match="no frame shows both points of the edge a to b"):
        typical_point_pair_distances([("a", "b")], [hidden])
    with pytest.raises(DataError, match="there is no point 'c'\n  where: recording 'run'"):
        typical_point_pair_distances([("a", "c")], [stretched([4.0], "run")])
