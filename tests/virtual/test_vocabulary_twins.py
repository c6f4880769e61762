"""Arms moved by MuJoCo with something wrong about them, which the library's equations find back; position servos."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import pytest

from yid_ocp.data.recording import Recording
from yid_ocp.diagnosis.diagnose import fit_nominal_model
from yid_ocp.diagnosis.hypotheses import AllCandidatesProblem
from yid_ocp.diagnosis.refit import RefitContext, refit_with_effects
from yid_ocp.diagnosis.screening import screen_candidates
from yid_ocp.effects import EffectBase, make_effect
from yid_ocp.effects.friction import effect_with_sign_smoothing_speed
from yid_ocp.errors import ModelError
from yid_ocp.export.models import export_support_by_effect, support_in_export_format_by_parameter
from yid_ocp.integrator.step import compile_step
from yid_ocp.model import Mechanism, System
from yid_ocp.model.mechanism import Frame, Inertia, Joint, Placement, homogeneous_transform
from yid_ocp.model.servos_and_springs import TORQUE_SATURATION_EXPONENT, MotorKindAndPreset, ServoModelOptions
from yid_ocp.model.urdf import read_urdf
from yid_ocp.problem import EstimationProblem, ProblemOptions
from yid_ocp.solvers import GaussNewton, fit_problem
from yid_ocp.virtual.experiment import ArmSensorNoise, PointCamera, VirtualExperimentSettings
from yid_ocp.virtual.injected import InjectedEffect, run_experiment_with_injected_effects
from yid_ocp.virtual.joint_motion import MultisineOptions, random_multisine_motion
from yid_ocp.virtual.mjcf import mujoco_xml
from yid_ocp.virtual.mujoco_simulation import SimulationOptions, replay_mismatch_by_channel

POSTURE = {"shoulder": 0.4, "elbow": 0.7}


def arm(mode: str = "driven") -> System:
    """Two joints across each other, 0.3 m links of 1 kg, a hand at the end."""
    along = Placement.from_matrix(homogeneous_transform(np.eye(3), [0.0, 0.0, 0.3]))
    body = Inertia.from_values(1.0, [0.0, 0.01, 0.15], np.diag([9e-3, 8e-3, 2e-3]))
    joints = (
        Joint("shoulder", "revolute", -1, Placement.identity(), (0.0, 1.0, 0.0), (body,)),
        Joint("elbow", "revolute", 0, along, (1.0, 0.0, 0.0), (body,)),
    )
    frames = {"upper": Frame(0, Placement.identity()), "hand": Frame(1, along)}
    return System.build(Mechanism("arm", joints, frames), damping=0.1, point_frames=(), **{mode: [*POSTURE]})


def recorded(
    effects: list[InjectedEffect], seed: int = 1, duration: float = 1.6, friction: list[InjectedEffect] | None = None
) -> Recording:
    noise = ArmSensorNoise(position_std=5e-5, velocity_std=1e-3, effort_std=0.0)
    simulation = SimulationOptions(duration, time_step=2.5e-4)
    experiment = VirtualExperimentSettings(None, POSTURE, simulation, noise, camera=None, seed=seed)
    return run_experiment_with_injected_effects(arm(), {}, effects, experiment, friction)


def fitted(
    kind: str, place: str, recording: Recording, mode: str, is_compiled: bool = False
) -> dict[str, tuple[float, float]]:
    """Value and standard deviation of an effect's quantities, fitted beside the dampings."""
    system = arm(mode)
    effect = effect_with_sign_smoothing_speed(make_effect(kind, place, system), 0.005)
    assert isinstance(effect, EffectBase)
    step = compile_step(system.with_effects([effect]), 0.01, use_compiler=is_compiled)
    free = (*effect.parameters.names, "shoulder.damping", "elbow.damping")
    problem = EstimationProblem(step, [recording], free, ProblemOptions(path_cutoff=20.0))
    found = fit_problem(problem, GaussNewton(max_iterations=25))
    values = dict(zip(found.unknown_names, found.x, strict=True))
    stds = {name: found.std[name] for name in effect.parameters.names}
    return {name: (entry.value, entry.std) for name, entry in effect.to_reported_parameters(values, stds).items()}


def agrees(found: tuple[float, float], true: float, rel: float = 0.0) -> bool:
    """Within three standard deviations, or a small part of the value that steps of different lengths make."""
    return abs(found[0] - true) <= max(3 * found[1], rel * abs(true))


@pytest.mark.parametrize(
    ("kind", "values"),
    [
        ("joint_coulomb", {"tau_c": 0.6}),
        pytest.param("joint_stribeck", {"tau_s": 0.6}, marks=pytest.mark.slow),
        pytest.param("joint_load_friction", {"share": 0.15}, marks=pytest.mark.slow),
    ],
)
def test_friction_that_the_engines_solver_holds_is_found(kind, values) -> None:
    held = [InjectedEffect(kind, "shoulder", {"v_stribeck": 0.1, **values} if "tau_s" in values else values)]
    made = recorded([], friction=held)
    # where it has not broken loose it does not creep
    assert np.ptp(made.joints.position[made.joints.t < 0.1, 0]) < 4e-4
    [amplitude] = values
    assert agrees(fitted(kind, "shoulder", made, "driven", True)[amplitude], values[amplitude], 0.03)


def test_what_is_injected_adds_to_ordinary_friction() -> None:
    parts = [InjectedEffect("joint_coulomb", "shoulder", {"tau_c": size}) for size in (0.2, 0.4)]
    both = recorded(parts[1:], friction=parts[:1])
    whole = recorded([], friction=[replace(parts[0], values={"tau_c": 0.6})])
    assert np.array_equal(both.joints.position, whole.joints.position)


@pytest.mark.parametrize(
    "values",
    [{"mass": 0.4, "mx": 0.02, "my": -0.03, "mz": 0.02}, {"mass": -0.3, "mx": 0.0, "my": -0.003, "mz": 0.03}],
    ids=["added", "taken away"],
)
def test_a_payload_is_found_with_its_place(values) -> None:
    found = fitted("payload", "hand", recorded([InjectedEffect("payload", "hand", values)]), "prescribed")
    for name, true in values.items():
        assert agrees(found[name], true, 2e-3), name
        assert found[name][1] < 0.01, name


def test_a_payload_that_cannot_be_is_refused() -> None:
    for values, text in (({"mass": 0.01, "mx": 0.05}, "from its frame"), ({"mass": -0.9, "mz": 0.0}, "more mass")):
        with pytest.raises(ModelError, match=text):
            recorded([InjectedEffect("payload", "hand", values)])


def test_friction_that_holds_is_found() -> None:
    recording = recorded([InjectedEffect("joint_presliding", "elbow", {"tau_c": 0.5, "yield_angle": 0.01})])
    found = fitted("joint_presliding", "elbow", recording, "prescribed")
    assert agrees(found["tau_c"], 0.5, 5e-3)
    assert agrees(found["yield_angle"], 0.01, 0.02)


def test_torque_that_follows_its_command_late_is_found() -> None:
    """The other engine lets the torque creep at every inner step, the library in closed form from sample to sample."""
    recording = recorded([InjectedEffect("effort_lag", "elbow", {"time_constant": 0.02})])
    assert agrees(fitted("effort_lag", "elbow", recording, "driven")["time_constant"], 0.02, 3e-3)
    assert agrees(fitted("effort_lag", "elbow", recording, "prescribed")["time_constant"], 0.02, 0.1)


def test_a_sensor_that_follows_the_effort_late_is_found() -> None:
    """Of a prescribed joint a negative time constant; here the measured effort is filtered sample by sample."""
    recording = recorded([])
    true, decay = recording.joints.effort[:, 1], np.exp(-0.01 / 0.03)
    effort = recording.joints.effort.copy()
    for k in range(len(true) - 1):
        # the torque is held from sample to sample
        effort[k + 1, 1] = true[k] + (effort[k, 1] - true[k]) * decay
    late = replace(recording, joints=replace(recording.joints, effort=effort, effort_kind="sample"))
    found, there = (fitted("effort_lag", "elbow", r, "prescribed")["time_constant"] for r in (late, recording))
    assert agrees(found, -0.03, 0.1)
    assert found[0] < -3 * found[1]
    assert abs(there[0]) < 3 * there[1] + 0.003


@pytest.mark.parametrize(
    ("kind", "place", "values"),
    [
        ("effort_gain", "elbow", {"scale": -1.0}),
        ("payload", "hand", {"mass": 0.1, "mx": -0.03, "my": -0.05, "mz": 0.01}),
    ],
    ids=["a flipped sign", "a load far out"],
)
def test_what_lies_uphill_is_found_by_a_refit_from_where_its_screening_leads(kind, place, values) -> None:
    """Downhill from 1 lies a gain without end, and from no mass one of -0.29 kg that leaves 160 times the error."""
    system = arm("prescribed")
    runs = [recorded([InjectedEffect(kind, place, values)], seed, 1.0) for seed in (1, 2)]
    step = compile_step(system, 0.01, use_compiler=False)
    nominal = EstimationProblem(step, runs[:1], ("shoulder.damping", "elbow.damping"), ProblemOptions(path_cutoff=20.0))
    composed = AllCandidatesProblem.from_problem(nominal, [make_effect(kind, place, system)], runs[1:])
    search = RefitContext(composed)
    start = fit_nominal_model(nominal, search)
    [score] = screen_candidates(composed, (), start.values).candidate_scores
    found = refit_with_effects(search, composed.candidate_effects, {**start.values, **score.predicted_values})
    for name, reported in found.effects[0].to_reported_parameters(found.values, found.std).items():
        assert reported.value == pytest.approx(values[name], rel=0.01 if kind == "effort_gain" else 0.05), name
    assert found.held_out_loss.chi2_per_sample < 0.01 * start.held_out_loss.chi2_per_sample


SERVO_POSTURE = {"pan": 0.2, "lift": 0.4, "elbow": 1.0, "wrist_flex": 0.3, "wrist_roll": 0.0}
JOINTS, SERVO = tuple(SERVO_POSTURE), {"servo_gain": 40.0, "servo_damping": 2.0, "servo_delay": 0.035}
VALUES = {f"{joint}.{name}": value for joint in JOINTS for name, value in SERVO.items()}


def moved_by(servos: ServoModelOptions, **more: Any) -> System:
    return System.build(read_urdf("default:servo_arm.urdf"), driven=JOINTS, servos=servos, damping=0.02, **more)


@pytest.fixture(scope="module")
def servo_arm() -> System:
    return moved_by(ServoModelOptions(), point_frames=["gripper"])


def played(system: System, *effects: InjectedEffect) -> Recording:
    excitation = MultisineOptions(max_joint_speed=2.0, duration=1.0, frequency_band=(0.5, 2.0))
    start = {"initial_joint_angles": SERVO_POSTURE}
    experiment = VirtualExperimentSettings(
        motion=random_multisine_motion(system, VALUES, seed=4, excitation=excitation, **start),
        simulation=SimulationOptions(1.0, sample_rate=50.0, time_step=1e-4),
        arm_noise=ArmSensorNoise(position_std=1e-6, velocity_std=1e-6),
        camera=PointCamera(point_std=1e-6, frame_rate=50.0, has_dropouts=False, hidden_probability=0.0, pose=np.eye(4)),
        **start,
    )
    return run_experiment_with_injected_effects(system, VALUES, effects, experiment)


@pytest.fixture(scope="module")
def recording(servo_arm: System) -> Recording:
    return played(servo_arm)


def evaluated(system: System, recording: Recording) -> tuple[float, np.ndarray]:
    """Cost, and angles by our equations under the recorded commands, shape (N + 1, 5) [rad]."""
    step = compile_step(system, 0.005, use_compiler=False)
    problem = EstimationProblem(step, [recording], ["pan.damping"], None, VALUES)
    found = problem.evaluate(problem.initial_unknowns, derivatives=False)
    assert found.ok, found.message
    return found.cost, np.asarray(found.episode_predictions[0].rollout.state[::4, : len(JOINTS)])


def test_a_virtual_experiment_records_commands_and_no_efforts(servo_arm: System, recording: Recording) -> None:
    joints = recording.joints
    assert joints.effort is None
    np.testing.assert_allclose(joints.position_command[0], list(SERVO_POSTURE.values()), atol=1e-12)
    # it lags and sags
    assert np.ptp(joints.position, axis=0).min() > 0.05
    assert np.abs(joints.position - joints.position_command).max() > 0.05
    with pytest.raises(ModelError, match="no joint efforts"):
        played(servo_arm, InjectedEffect("encoder_offset", "pan", {"offset": 0.01}))


def test_both_engines_move_alike(servo_arm: System, recording: Recording) -> None:
    joints = recording.joints
    apart = np.abs(evaluated(servo_arm, recording)[1] - joints.position).max(axis=0)
    assert apart.max() < 1e-3
    assert np.all(apart < 0.02 * np.abs(joints.position - joints.position_command).max(axis=0))


def test_both_engines_move_a_direct_current_motor_alike() -> None:
    """At its duty's limit a motor gives the limit less its counter-voltage, which a clip of the whole would not."""
    servos = {kind: ServoModelOptions(motor=MotorKindAndPreset(kind)) for kind in ("dc", "ideal")}
    systems = {kind: moved_by(own, point_frames=[]) for kind, own in servos.items()}
    limited = ("servo_saturation", "lift", {"limit": 1.3})
    made, apart = played(systems["dc"], InjectedEffect(*limited)), {}
    for kind, system in systems.items():
        own = system.with_effects([make_effect(*limited[:2], system, limited[2])])
        apart[kind] = np.abs(evaluated(own, made)[1] - made.joints.position)[:, JOINTS.index("lift")].max()
    assert apart["dc"] < 2e-3
    assert apart["ideal"] > 10 * apart["dc"]


@pytest.mark.parametrize(
    "effect",
    [
        InjectedEffect("servo_gain", "pan", {"scale": 0.6}),
        InjectedEffect("servo_delay", "elbow", {"delay": 0.03}),
        InjectedEffect("servo_saturation", "elbow", {"limit": 0.6}),
        InjectedEffect("backlash", "elbow", {"width": 0.03}),
    ],
    ids=["gain", "delay", "saturation", "play"],
)
def test_an_injected_effect_is_the_librarys(servo_arm: System, effect: InjectedEffect) -> None:
    """Put into the model it brings the two engines together again, which are apart without it."""
    made = played(servo_arm, effect)
    system = servo_arm.with_effects([make_effect(effect.kind, effect.location, servo_arm, effect.values)])
    without, with_it = (evaluated(made_of, made)[0] for made_of in (servo_arm, system))
    assert with_it < 0.05 * without


def test_export_says_that_a_servo_is_native_in_mjcf_alone(servo_arm: System) -> None:
    effects = [("servo_gain", "pan", {"scale": 0.8}), ("servo_delay", "pan", {"delay": 0.01})]
    effects += [("servo_saturation", "lift", {"limit": 0.9}), ("backlash", "elbow", {"width": 0.01})]
    system = servo_arm.with_effects([make_effect(kind, place, servo_arm, values) for kind, place, values in effects])
    values = dict(zip(system.parameters.names, system.parameters.vector(VALUES), strict=True))
    said = export_support_by_effect(system, values, "mjcf")
    assert [said[f"{kind}@{place}"].status for kind, place, _ in effects] == ["native"] * 3 + ["not representable"]
    for form, status in (("mjcf", "native"), ("urdf", "not representable"), ("sdf", "not representable")):
        own = support_in_export_format_by_parameter(system, export_support_by_effect(system, values, form), form)
        names = ("gain", "damping", "delay", "torque_limit")
        assert {own[f"wrist_flex.servo_{name}"].status for name in names} == {status}
    kept = servo_arm.with_effects([make_effect(kind, place, servo_arm, values) for kind, place, values in effects[:3]])
    model = mujoco.MjModel.from_xml_string(mujoco_xml(kept, VALUES))
    pan, lift = model.actuator("pan"), model.actuator("lift")
    assert (pan.gainprm[0], pan.biasprm[1], pan.biasprm[2]) == pytest.approx((32.0, -32.0, -1.6))
    assert model.actuator_delay[pan.id] == pytest.approx(0.045)
    limit = (3.0**-TORQUE_SATURATION_EXPONENT + 0.9**-TORQUE_SATURATION_EXPONENT) ** (-1 / TORQUE_SATURATION_EXPONENT)
    assert lift.forcerange == pytest.approx([-limit, limit])


def test_a_firmwares_damping_is_native_in_mjcf_and_its_dead_band_and_current_limit_are_not() -> None:
    system = moved_by(
        ServoModelOptions(motor=MotorKindAndPreset("dc", "sts3215"), extra_controller_terms=("derivative", "dead_band"))
    )
    values = VALUES | {"pan.servo_derivative": 0.3}
    pan = mujoco.MjModel.from_xml_string(mujoco_xml(system, values)).actuator("pan")
    assert pan.biasprm[1:3] == pytest.approx((-40.0, -0.3))
    with pytest.raises(ModelError, match="servo 'lift' has a dead band, MuJoCo none"):
        mujoco_xml(system, values | {"lift.servo_dead_band": 0.01})
    limited = system.with_effects([make_effect("current_limit", "pan", system, {"limit": 1.5})])
    with pytest.raises(ModelError, match="cannot express what the effect changes: dead band and current limit"):
        mujoco_xml(limited, values)


def test_an_exported_model_replays_its_commands(servo_arm: System, recording: Recording, tmp_path, monkeypatch) -> None:
    nominal = dict(zip(servo_arm.parameters.names, servo_arm.parameters.vector(VALUES), strict=True))

    def error(own: Recording = recording, **changes: float) -> float:
        text = mujoco_xml(servo_arm, nominal | changes, standalone=True)
        return replay_mismatch_by_channel(text, servo_arm, own)["joints.position"].rmse

    assert error() < 1e-3
    assert error(**{"pan.servo_gain": 10.0}) > 5 * error()
    # MuJoCo resets a state that diverges, goes on, and leaves a log where it is
    monkeypatch.chdir(tmp_path)
    wild = np.array(recording.joints.position_command)
    wild[25] = 9e9
    joints = replace(recording.joints, position_command=wild)
    with pytest.raises(ModelError, match="the replay in MuJoCo diverged"):
        error(replace(recording, joints=joints), **{"pan.servo_torque_limit": 1e12})
