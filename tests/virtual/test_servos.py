"""Position servos in MuJoCo: its own actuators move an arm as our equations have it, and gears with play."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest

from yid_ocp.data.recording import Recording
from yid_ocp.effects import make_effect
from yid_ocp.errors import ModelError
from yid_ocp.export.models import effect_format_support, parameter_format_support
from yid_ocp.integrator.step import compile_step
from yid_ocp.model import System
from yid_ocp.model.servos_and_springs import TORQUE_SATURATION_EXPONENT, MotorOptions, PositionServoOptions
from yid_ocp.model.urdf import read_urdf
from yid_ocp.problem import EstimationProblem
from yid_ocp.virtual.experiment import ArmSensorNoise, PointCamera, VirtualExperiment
from yid_ocp.virtual.injected import InjectedEffect, run_experiment_with_effects
from yid_ocp.virtual.joint_motion import MultisineOptions, random_multisine_motion
from yid_ocp.virtual.mjcf import mujoco_xml
from yid_ocp.virtual.mujoco_replay import replay_in_mujoco
from yid_ocp.virtual.mujoco_simulation import SimulationOptions

POSTURE = {"pan": 0.2, "lift": 0.4, "elbow": 1.0, "wrist_flex": 0.3, "wrist_roll": 0.0}
JOINTS = tuple(POSTURE)
SERVO = {"servo_gain": 40.0, "servo_damping": 2.0, "servo_delay": 0.035}
VALUES = {f"{joint}.{name}": value for joint in JOINTS for name, value in SERVO.items()}


def moved_by(servos: PositionServoOptions, **more: Any) -> System:
    return System.build(read_urdf("default:servo_arm.urdf"), driven=JOINTS, servos=servos, damping=0.02, **more)


@pytest.fixture(scope="module")
def arm() -> System:
    return moved_by(PositionServoOptions(), point_frames=["gripper"])


def played(arm: System, *effects: InjectedEffect) -> Recording:
    excitation = MultisineOptions(max_joint_speed=2.0, duration=1.0, frequency_band=(0.5, 2.0))
    experiment = VirtualExperiment(
        motion=random_multisine_motion(arm, VALUES, seed=4, initial_joint_angles=POSTURE, excitation=excitation),
        initial_joint_angles=POSTURE,
        simulation=SimulationOptions(1.0, sample_rate=50.0, time_step=1e-4),
        arm_noise=ArmSensorNoise(position_std=1e-6, velocity_std=1e-6),
        camera=PointCamera(point_std=1e-6, frame_rate=50.0, has_dropouts=False, hidden_probability=0.0, pose=np.eye(4)),
    )
    return run_experiment_with_effects(arm, VALUES, effects, experiment)


@pytest.fixture(scope="module")
def recording(arm: System) -> Recording:
    return played(arm)


def evaluated(system: System, recording: Recording) -> tuple[float, np.ndarray]:
    """Cost, and angles by our equations under the recorded commands, shape (N + 1, 5) [rad]."""
    step = compile_step(system, 0.005, use_compiler=False)
    problem = EstimationProblem(step, [recording], ["pan.damping"], None, VALUES)
    found = problem.evaluate(problem.initial_unknowns, derivatives=False)
    assert found.ok, found.message
    return found.cost, np.asarray(found.episode_predictions[0].rollout.state[::4, : len(JOINTS)])


def test_a_virtual_experiment_records_commands_and_no_efforts(recording: Recording) -> None:
    joints = recording.joints
    assert joints is not None
    assert joints.effort is None
    assert joints.position_command is not None
    np.testing.assert_allclose(joints.position_command[0], list(POSTURE.values()), atol=1e-12)
    # it lags and sags
    assert np.ptp(joints.position, axis=0).min() > 0.05
    assert np.abs(joints.position - joints.position_command).max() > 0.05
    assert "commands of position servos" in recording.description


def test_both_engines_move_alike(arm: System, recording: Recording) -> None:
    joints = recording.joints
    assert joints is not None
    assert joints.position_command is not None
    apart = np.abs(evaluated(arm, recording)[1] - joints.position).max(axis=0)
    assert apart.max() < 1e-3
    assert np.all(apart < 0.02 * np.abs(joints.position - joints.position_command).max(axis=0))


def test_both_engines_move_a_direct_current_motor_alike() -> None:
    """At its duty's limit a motor gives the limit less its counter-voltage, which a clip of the whole would not."""
    servos = {kind: PositionServoOptions(motor=MotorOptions(kind)) for kind in ("dc", "ideal")}
    systems = {kind: moved_by(own, point_frames=[]) for kind, own in servos.items()}
    limited = ("servo_saturation", "lift", {"limit": 1.3})
    made = played(systems["dc"], InjectedEffect(*limited))
    assert made.joints is not None
    apart = {}
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
def test_an_injected_effect_is_the_librarys(arm: System, effect: InjectedEffect) -> None:
    """Put into the model it brings the two engines together again, which are apart without it."""
    made = played(arm, effect)
    system = arm.with_effects([make_effect(effect.kind, effect.location, arm, effect.values)])
    without, with_it = (evaluated(made_of, made)[0] for made_of in (arm, system))
    assert with_it < 0.05 * without


def test_effects_on_efforts_need_efforts(arm: System) -> None:
    with pytest.raises(ModelError, match="no efforts"):
        played(arm, InjectedEffect("encoder_offset", "pan", {"offset": 0.01}))


def test_export_says_that_a_servo_is_native_in_mjcf_alone(arm: System) -> None:
    effects = [("servo_gain", "pan", {"scale": 0.8}), ("servo_delay", "pan", {"delay": 0.01})]
    effects += [("servo_saturation", "lift", {"limit": 0.9}), ("backlash", "elbow", {"width": 0.01})]
    system = arm.with_effects([make_effect(kind, place, arm, values) for kind, place, values in effects])
    values = dict(zip(system.parameters.names, system.parameters.vector(VALUES), strict=True))
    said = effect_format_support(system, values, "mjcf")
    assert [said[f"{kind}@{place}"].status for kind, place, _ in effects] == ["native"] * 3 + ["not representable"]
    for form, status in (("mjcf", "native"), ("urdf", "not representable"), ("sdf", "not representable")):
        own = parameter_format_support(system, effect_format_support(system, values, form), form)
        names = ("gain", "damping", "delay", "torque_limit")
        assert {own[f"wrist_flex.servo_{name}"].status for name in names} == {status}
    kept = arm.with_effects([make_effect(kind, place, arm, values) for kind, place, values in effects[:3]])
    model = mujoco.MjModel.from_xml_string(mujoco_xml(kept, VALUES))
    pan, lift = model.actuator("pan"), model.actuator("lift")
    assert (pan.gainprm[0], pan.biasprm[1], pan.biasprm[2]) == pytest.approx((32.0, -32.0, -1.6))
    assert model.actuator_delay[pan.id] == pytest.approx(0.045)
    limit = (3.0**-TORQUE_SATURATION_EXPONENT + 0.9**-TORQUE_SATURATION_EXPONENT) ** (-1 / TORQUE_SATURATION_EXPONENT)
    assert lift.forcerange == pytest.approx([-limit, limit])


def test_an_exported_model_replays_its_commands(arm: System, recording: Recording) -> None:
    values = dict(zip(arm.parameters.names, arm.parameters.vector(VALUES), strict=True))
    error = replay_in_mujoco(mujoco_xml(arm, values, emulate=True, actuators=True), arm, recording)["joints.position"]
    assert error.rmse < 1e-3
    wrong = replay_in_mujoco(mujoco_xml(arm, values | {"pan.servo_gain": 10.0}, actuators=True), arm, recording)
    assert wrong["joints.position"].rmse > 5 * error.rmse
