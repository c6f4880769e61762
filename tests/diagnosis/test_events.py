"""Events of a two-joint arm that MuJoCo plays: pushes, a snag, a wrong encoder sample, and nothing at all."""

import sys
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from factories import FORCE, smoothed, trace
from small_problems import joints, places, recording, seen

from yid_ocp.data.recording import Recording, SensorChannelGroup
from yid_ocp.diagnosis.diagnose import diagnose
from yid_ocp.diagnosis.events import (
    EventSet,
    ForceOrFaultEvent,
    _alone,
    _floor,
    _one_each,
    _Overspeed,
    _short,
    _without_forces_of_motion,
    find_force_and_fault_events,
    problem_corrected_for_events,
)
from yid_ocp.diagnosis.pulse_detection import DetectedForcePulse, ForceEstimate
from yid_ocp.diagnosis.thresholds import Thresholds
from yid_ocp.inference.null_test import times_since_recording_start
from yid_ocp.inference.smoother import smooth_unknown_forces_and_biases
from yid_ocp.integrator.step import compile_step, simulate
from yid_ocp.model import System
from yid_ocp.model.urdf import read_urdf
from yid_ocp.problem import EstimationProblem, ProblemOptions, SensorOptions
from yid_ocp.solvers import GaussNewton, fit_problem
from yid_ocp.virtual.experiment import ArmSensorNoise, VirtualExperimentSettings, run_virtual_experiment
from yid_ocp.virtual.joint_motion import MultisineMotion
from yid_ocp.virtual.mujoco_simulation import SimulationOptions

pytest.importorskip("mujoco", reason="twins are made in MuJoCo: pip install '.[blind]'")

JOINTS = ("shoulder", "elbow")


@dataclass(frozen=True)
class Push:
    """peak sin^2(pi (t - start)/(end - start)) on one coordinate, and a spring that holds it where it was first."""

    joint: str
    start: float
    end: float
    peak: float = 0.0
    stiffness: float = 0.0

    @property
    def impulse(self) -> float:
        return self.peak * (self.end - self.start) / 2


class DisturbanceTerms:
    """Disturbances as `InjectedSimulatorTerms`; times are since the motion's beginning."""

    def __init__(self, *pushes: Push) -> None:
        self.pushes, self.begun, self.caught = pushes, 0.0, {}

    def edit_model(self, model) -> None:
        pass

    def begin_motion(self, data) -> None:
        self.begun, self.caught = float(data.time), {}

    def add_forces(self, model, data) -> None:
        t = float(data.time) - self.begun
        for push in (p for p in self.pushes if p.start < t < p.end):
            at = model.joint(push.joint).id
            caught = self.caught.setdefault(push, float(data.qpos[at]))
            wave = np.sin(np.pi * (t - push.start) / (push.end - push.start)) ** 2
            data.qfrc_passive[at] += push.peak * wave - push.stiffness * (float(data.qpos[at]) - caught)


DAMPING = {"shoulder": 0.1, "elbow": 0.05}
PUSHES = (Push("shoulder", 1.5, 2.0, 1.5), Push("elbow", 3.0, 3.4, -0.8))


@dataclass(frozen=True)
class Twin:
    """An arm that MuJoCo drives, and the problem of its motion as measured."""

    driven: System
    prescribed: System

    def recording(self, interruptions: DisturbanceTerms | None = None, seed: int = 0) -> Recording:
        frequency = np.array([[0.5, 0.9, 1.3], [0.6, 1.0, 1.5]])
        phase = np.random.default_rng(seed).uniform(0, 2 * np.pi, (2, 3))
        motion = MultisineMotion(JOINTS, 0.25 / frequency, frequency, phase)
        simulation = SimulationOptions(5.0, 200.0, 1e-3, effort_kind="mean")
        noise, start = ArmSensorNoise(position_std=5e-5, effort_std=0.02), dict.fromkeys(JOINTS, 0.3)
        how = VirtualExperimentSettings(motion, start, simulation, noise, None, interruptions, seed, f"run_{seed}")
        return run_virtual_experiment(self.driven, None, how)

    def problem(self, *recordings: Recording, duration: float | None = None) -> EstimationProblem:
        sensors = {"joints.effort": SensorOptions(std=0.02), "joints.position": SensorOptions(std=5e-5)}
        step = compile_step(self.prescribed, 0.01)
        free = [f"{joint}.damping" for joint in JOINTS]
        options = ProblemOptions(sensors=sensors, path_cutoff=8.0, duration=duration)
        return EstimationProblem(step, recordings, free, options)

    def events(self, *recordings: Recording, duration: float | None = None) -> EventSet:
        problem = self.problem(*recordings, duration=duration)
        x = fit_problem(problem, GaussNewton()).x
        return find_force_and_fault_events(problem, x, problem.evaluate(x), None)


@pytest.fixture(scope="module")
def twin(urdf_folder) -> Twin:
    tree = read_urdf(str(urdf_folder / "double_pendulum.urdf"))
    return Twin(*(System.build(tree, **{mode: JOINTS}, damping=DAMPING) for mode in ("driven", "prescribed")))


@pytest.fixture(scope="module")
def pushed(twin) -> Recording:
    return twin.recording(DisturbanceTerms(*PUSHES))


def test_pushes_are_found_at_their_joints_in_their_windows_with_their_impulses(twin, pushed):
    found = twin.events(pushed).disturbances
    assert [(e.kind, e.location, e.unit) for e in found] == [("force", name, "N m") for name in JOINTS]
    for event, push in zip(found, PUSHES, strict=True):
        assert (event.start_time, event.end_time) == pytest.approx((push.start, push.end), abs=0.1)
        assert event.impulse == pytest.approx(push.impulse, rel=0.15)
        assert abs(event.impulse - push.impulse) < 3 * event.impulse_std


@pytest.mark.parametrize("seed", range(2))
def test_nothing_happens_in_a_clean_run(twin, seed):
    assert not twin.events(twin.recording(seed=seed))


def test_a_snag_is_an_event_of_its_joint(twin):
    found = twin.events(twin.recording(DisturbanceTerms(Push("elbow", 2.0, 2.3, stiffness=30.0)))).disturbances
    assert found
    assert {event.location for event in found} == {"elbow"}
    assert all(event.start_time > 1.8 and event.end_time < 2.5 for event in found)


def test_forces_that_mostly_recur_are_the_motions_own(twin, pushed):
    """What is there at the same times of another recording comes with the motion; one that does is still an event."""
    other = (replace(PUSHES[0], start=3.2, end=3.7), *PUSHES[1:])
    third = (*PUSHES, Push("shoulder", 4.0, 4.5, -1.2))
    first, again = (twin.recording(DisturbanceTerms(*third), seed=seed) for seed in (0, 1))
    assert not twin.events(first, again).disturbances
    found = twin.events(pushed, twin.recording(DisturbanceTerms(*other), seed=1)).disturbances
    assert [event.location for event in found] == ["shoulder", "elbow", "elbow", "shoulder"]


def pulses(recording: str, *at: tuple[float, float]) -> list[ForceOrFaultEvent]:
    """Events of 0.4 s at one joint: start and impulse of each, known to 0.02 N m s."""
    where = (recording, "elbow", "elbow", "force")
    return [ForceOrFaultEvent(*where, t, t + 0.4, 5 * size, size, 0.02, "N m") for t, size in at]


@pytest.mark.parametrize("calm", range(1, 13))
def test_a_push_is_found_beside_any_number_of_runs_that_all_have_the_motions_forces(calm):
    """Among them pushes of the time but not the size of such a force, and one that is alike in one run by chance."""
    motions = ((1.0, 0.2), (4.0, -0.2))
    pushes = pulses("pushed", (1.1, 0.5), (2.5, 0.2), (7.0, 0.3))
    forces = [*pushes, *pulses("pushed", motions[1])]
    forces += [event for k in range(calm) for event in pulses(f"calm_{k}", *motions)]
    forces += pulses("calm_0", (7.05, 0.3))
    durations = {force.recording: 10.0 for force in forces}
    kept = _without_forces_of_motion(forces, durations, Thresholds())
    assert kept[:3] == pushes
    if calm > 3:
        assert [force.recording for force in kept] == 3 * ["pushed"] + ["calm_0"]
    alone = _without_forces_of_motion(pushes, durations, Thresholds())
    assert (alone, _without_forces_of_motion([], {}, Thresholds())) == (pushes, [])


def test_currents_tell_of_a_push_what_efforts_tell(twin, pushed):
    """With torque constants far from one, and of either sign."""
    constants = np.array([4.0, -0.05])
    joints = replace(pushed.joints, effort_kind="sample")
    group = SensorChannelGroup("motors", JOINTS, joints.t, {"current": joints.effort / constants})
    use = {
        "joints.effort": SensorOptions(use=False),
        "motors.current": SensorOptions(
            std=tuple(0.02 / np.abs(constants)), constants={"torque_constant": tuple(constants)}
        ),
    }
    plain = twin.problem(replace(pushed, joints=joints))
    options = replace(plain.options, sensors=plain.options.sensors | use)
    made = replace(pushed, joints=replace(joints, effort=None), channel_groups=(group,))
    found = []
    for problem in (plain, EstimationProblem(plain.step, [made], plain.free, options)):
        x = problem.initial_unknowns
        found.append(find_force_and_fault_events(problem, x, problem.evaluate(x), None).disturbances)
    assert len(found[0]) == len(found[1]) == len(PUSHES)
    for one, other in zip(*found, strict=True):
        assert (one.channel, one.unit) == (other.channel, other.unit)
        assert (one.impulse, one.impulse_std) == pytest.approx((other.impulse, other.impulse_std), rel=1e-6)


def test_the_same_push_in_another_recording_is_another_event(twin):
    pulse = DetectedForcePulse(1.0, 1.2, -0.1, False, 0.01, 1e-9)
    surer = replace(pulse, p_value=1e-12)
    problem = SimpleNamespace(system=SimpleNamespace(prescribed=()))
    t = 0.1 * np.arange(30)
    force = ForceEstimate("run_0", "elbow", "elbow", "N m", t, 0 * t, np.eye(30), 0 * t, 0 * t)
    other, rival = replace(force, recording="run_1"), replace(force, location="shoulder", coordinate="shoulder")
    found = _one_each([(force, pulse), (other, surer), (rival, surer)], problem)
    assert sorted((e.recording, e.channel) for e in found) == [("run_0", "shoulder"), ("run_1", "elbow")]


def test_an_effort_behind_a_filter_is_noisier_than_what_is_left_of_it(twin, pushed):
    problem = twin.problem(pushed)
    [episode], share = problem.episodes, 2 * problem.options.path_cutoff * 0.005
    assert _floor(problem, episode, "elbow", "effort") == pytest.approx(0.02 / np.sqrt(share))
    assert _floor(problem, episode, "elbow", "position") == pytest.approx(5e-5)


def test_a_force_that_is_never_sure_is_no_event():
    std = np.full((10, 1), 0.1)
    for sure, expected in ((0, []), (1, ["T1.0"]), (9, [])):
        mean = np.zeros((10, 1))
        mean[:sure] = 5.0
        assert _short(smoothed({FORCE: 1.0}, traces=[trace([FORCE], mean, std)]), 0) == expected


def test_a_wrong_encoder_sample_is_named_as_such_and_makes_no_push(twin):
    clean = twin.recording()
    position = clean.joints.position.copy()
    position[500:502, 1] += 0.05
    wrong = replace(clean, joints=replace(clean.joints, position=position))
    (event,) = twin.events(wrong).disturbances
    assert (event.kind, event.channel, event.unit) == ("sample", "joints.position.elbow", "rad")
    assert event.peak_value == pytest.approx(0.05, abs=2e-3)
    assert event.start_time == pytest.approx(wrong.joints.t[500], abs=0.006)
    assert event.end_time == pytest.approx(wrong.joints.t[501], abs=0.006)
    assert not twin.events(wrong, duration=2.0), "a wrong sample after the part that is used"


@pytest.mark.parametrize(("count", "wrong", "named"), [(45, 1, 1), (45, 3, 1), (45, 4, 0), (39, 1, 0)])
def test_up_to_three_samples_among_forty_are_named_as_wrong(count, wrong, named):
    t = 0.01 * np.arange(count)
    values = np.sin(3 * t) + 1e-4 * np.random.default_rng(0).standard_normal(count)
    values[20 : 20 + wrong] += 0.1
    found = list(_alone(t, values, np.full(count, 1e-4), ("run", "elbow", "joints.position.elbow", "rad")))
    assert len(found) == named
    for event in found:
        assert (event.start_time, event.end_time) == pytest.approx((0.195, 0.195 + 0.01 * wrong))
        assert event.peak_value == pytest.approx(0.1, abs=5e-3)


def test_a_gap_that_lives_in_events_alone_is_none_and_the_words_tell_of_them(bench):
    def push(t):
        return -np.stack([0 * t, 0.5 * np.sin(np.pi * np.clip((t - 1.5) / 0.4, 0, 1)) ** 2], axis=1)

    problem = bench.problem([bench.recording({}, 1, torque=push)])
    finding = diagnose(problem, ["joint_coulomb@elbow", "effort_offset@elbow"], [bench.recording({}, 2)])
    assert finding.verdict == "no_gap"
    (told,) = finding.to_dict()["events"]
    assert list(told) == ["recording", "location", "channel", "kind", "from", "to", "impulse", "peak", "unit", "std"]
    assert (told["location"], told["recording"]) == ("elbow", "run_1")
    assert told["impulse"] == pytest.approx(0.1, rel=0.15)
    assert "The tests leave out 1 brief disturbance: push of elbow at 1.50 to" in finding.summary


@pytest.mark.usefixtures("without_law")
def test_pushes_that_take_little_of_the_gap_with_them_are_a_model_that_errs_everywhere(bench, monkeypatch):
    pulse = DetectedForcePulse(1.0, 1.2, -0.1, False, 0.01, 1e-9)
    size = (-0.1, -0.01, 0.001)
    claimed = ForceOrFaultEvent("run_1", "elbow", "elbow", "force", 1.0, 1.2, *size, "N m", pulse)
    odd = ForceOrFaultEvent("run_1", "elbow", "points_arm.tip.x", "sample", 2.0, 2.01, *size, "m")
    events = EventSet((claimed, odd))
    module = sys.modules["yid_ocp.diagnosis.events"]
    monkeypatch.setattr(module, "find_force_and_fault_events", lambda *_: events)
    heavy = [bench.recording({"link_mass@elbow": {"scale": 1.3}}, seed, 2.0) for seed in (1, 2)]
    for share, expected in ((0.1, (odd,)), (0.0, (claimed, odd))):
        monkeypatch.setattr(module, "_MIN_FORCE_EVENT_GAP_FRACTION", share)
        finding = diagnose(bench.problem(heavy[:1]), ["effort_offset@elbow"], heavy[1:])
        assert finding.verdict == "unknown"
        assert finding.events.disturbances == expected


def test_samples_of_an_events_joint_in_its_window_do_not_count(twin, pushed):
    problem = twin.problem(pushed)
    event = ForceOrFaultEvent("run_0", "elbow", "elbow", "force", 3.0, 3.4, -0.8, -0.16, 0.01, "N m")
    cleaned = problem_corrected_for_events(problem, EventSet((event,)))
    (before,), (after,) = problem.episodes[0].measurements, cleaned.episodes[0].measurements
    t = times_since_recording_start(problem.episodes[0], before)
    hidden = before.positive_weight_mask & ~after.positive_weight_mask
    smear = 1 / problem.options.path_cutoff
    assert not hidden[:, 0].any()
    assert np.array_equal(hidden[:, 1], before.positive_weight_mask[:, 1] & (t > 3.0 - smear) & (t < 3.4 + smear))
    elsewhere = problem_corrected_for_events(problem, EventSet((replace(event, recording="another"),)))
    assert elsewhere.episodes[0].measurements[0] is before
    # beside torques that drive a joint its force acts, with its whole impulse
    arm = EstimationProblem(compile_step(twin.driven, 0.01), [pushed], ["elbow.damping"], problem.options)
    told = replace(event, detected_pulse=DetectedForcePulse(3.0, 3.4, -0.8, False, 0.01, 1e-9))
    [plain], [driven] = (own.episodes for own in (arm, problem_corrected_for_events(arm, EventSet((told,)))))
    added = driven.torque - plain.torque
    assert not added[:, 0].any()
    assert 0.01 * added[:, 1].sum() == pytest.approx(-0.16, rel=0.01)
    assert 0.01 * added[300:340, 1].sum() == pytest.approx(-0.16, rel=0.1)


def test_a_push_beside_driving_torques_is_an_event_where_the_smoother_finds_a_force(twin):
    step, t, push = compile_step(twin.driven, 0.01), 0.01 * np.arange(201), Push("elbow", 0.8, 1.2, 0.12)
    torque = np.zeros((200, 2))
    torque[:, 0] = 1.5 * np.sin(2 * np.pi * 0.7 * t[:-1])
    wave = np.sin(np.pi * np.clip((t[:-1] - push.start) / (push.end - push.start), 0, 1)) ** 2
    pushed = torque + push.peak * np.stack([0 * wave, wave], axis=1)
    state = simulate(step, twin.driven.parameters.vector(), np.zeros(4), 200, pushed).state[:, :2]
    frames = list(twin.driven.mechanism.frames)[-2:]
    place = places(twin.driven, frames, state)
    place += 1e-3 * np.random.default_rng(3).standard_normal(place.shape)
    arm = joints(JOINTS, t, state, effort=np.vstack([torque, torque[-1:]]), effort_std=0.0, effort_kind="command")
    made = recording(arm, seen(frames, t, place, std=np.full(place.shape, 1e-3)))
    sensors = {"joints.position": SensorOptions(use=False)}
    options = ProblemOptions(initial_state="equilibrium", arm_tracking_feedback="none", sensors=sensors)
    problem = EstimationProblem(step, [made], ["shoulder.damping"], options)
    x = fit_problem(problem, GaussNewton()).x
    evaluation = problem.evaluate(x)
    unknowns = smooth_unknown_forces_and_biases(problem, x, evaluation)
    (event,) = find_force_and_fault_events(problem, x, evaluation, unknowns).disturbances
    assert (event.kind, event.location, event.channel, event.unit) == ("force", "elbow", "elbow", "N m")
    assert (event.start_time, event.end_time) == pytest.approx((push.start, push.end), abs=0.15)
    assert event.impulse == pytest.approx(push.impulse, rel=0.2)
    assert abs(event.impulse - push.impulse) < 3 * event.impulse_std


def test_after_a_fall_nothing_counts(twin, pushed):
    problem = twin.problem(pushed)
    x = fit_problem(problem, GaussNewton()).x
    events = find_force_and_fault_events(problem, x, problem.evaluate(x), None, Thresholds(max_joint_speed=1.0))
    (fall,) = events.overspeeds
    assert (fall.recording, fall.joint in JOINTS) == ("run_0", True)
    assert all(event.end_time < fall.start_time for event in events.disturbances)
    cleaned = problem_corrected_for_events(problem, EventSet((), (_Overspeed("run_0", "elbow", 3.0),)))
    (samples,) = cleaned.episodes[0].measurements
    t = times_since_recording_start(cleaned.episodes[0], samples)
    assert not samples.positive_weight_mask[t > 3.0].any()
    assert samples.positive_weight_mask[(t > 1.0) & (t < 2.0)].all()
