"""Direct-current motors, motors that are off, gains of a firmware, and friction in gears behind servos."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from small_problems import (
    PENDULUM,
    H,
    assert_slopes_are_those_of_differences,
    joints,
    pendulum_step,
    recording,
    torque_function,
)

from yid_ocp.data.recording import validated_recording
from yid_ocp.effects import candidate_kinds_and_locations
from yid_ocp.errors import ConfigError, DataError
from yid_ocp.integrator.step import actuated_joint_torques_of_rollout, simulate
from yid_ocp.model.servos_and_springs import MOTOR_OFF_COMMAND, MOTOR_PRESETS, MotorKindAndPreset, ServoModelOptions
from yid_ocp.problem import EstimationProblem, ProblemOptions
from yid_ocp.problem.recorded_inputs import servo_gain_parameters_by_recording

VALUES = {
    "shoulder.servo_gain": 0.6, "shoulder.servo_damping": 4.0, "shoulder.servo_torque_limit": 9.0,
    "shoulder.servo_gain_factor": 100.0, "elbow.servo_gain": 0.25, "elbow.servo_damping": 1.5,
    "elbow.servo_torque_limit": 3.0, "elbow.servo_gain_factor": 100.0,
}  # fmt: skip
DC = ServoModelOptions(motor=MotorKindAndPreset("dc"))
FIRMWARE = ServoModelOptions(motor=MotorKindAndPreset("dc", "mx64"), extra_controller_terms=("derivative", "dead_band"))
INTEGRATING = replace(FIRMWARE, extra_controller_terms=("integral", "derivative", "dead_band"))
TERMS = {"integral": 3.0, "derivative": 0.7, "dead_band": 0.02}
FIRMWARE_VALUES = VALUES | {f"{joint}.servo_{term}": value for joint in PENDULUM for term, value in TERMS.items()}


@pytest.fixture(scope="module")
def step(urdf_folder):
    return pendulum_step(urdf_folder, driven=PENDULUM, servos=DC)


def test_a_dc_motor_limits_its_duty_and_its_speed_takes_torque_beyond_the_limit(step) -> None:
    torque = torque_function(step, VALUES)
    # an error of 1 rad asks for 60 N m, the duty gives 9, and 2 rad/s against it cost 8 more
    assert torque([1.0, 0.0], [0.0, 0.0], [2.0, 0.0])[0] == pytest.approx(9.0 - 8.0)
    assert torque([1.0, 0.0], [0.0, 0.0], [-2.0, 0.0])[0] == pytest.approx(9.0 + 8.0)
    assert torque([0.05, 0.0], [0.0, 0.0], [0.1, 0.0])[0] == pytest.approx(60 * 0.05 - 0.4, abs=1e-6)


def test_a_firmware_damps_within_its_duty_and_ignores_small_errors(urdf_folder) -> None:
    torque = torque_function(pendulum_step(urdf_folder, driven=PENDULUM, servos=FIRMWARE), FIRMWARE_VALUES)
    # within the limit of 9 N m damping and counter-voltage add, beyond it the duty's part is gone
    assert torque([0.1, 0.0], [0.0, 0.0], [1.0, 0.0])[0] == pytest.approx(60 * (0.1 - 0.02) - (0.7 + 4.0), abs=1e-3)
    assert torque([1.0, 0.0], [0.0, 0.0], [1.0, 0.0])[0] == pytest.approx(9.0 - 4.0, abs=1e-3)
    assert abs(torque([0.015, 0.0], [0.0, 0.0], [0.0, 0.0])[0]) < 1e-3 * 60
    assert torque([-0.1, 0.0], [0.0, 0.0], [0.0, 0.0])[0] == pytest.approx(-60 * 0.08, abs=1e-3)
    assert torque([0.0, 0.0], [0.0, 0.0], [0.0, 0.0])[0] == 0.0
    with pytest.raises(ConfigError, match="an ideal motor has a derivative term"):
        ServoModelOptions(extra_controller_terms=("derivative",))


def test_an_integral_takes_the_sag_away_and_stands_still_while_the_motor_is_off(urdf_folder) -> None:
    step = pendulum_step(urdf_folder, driven=PENDULUM, servos=replace(DC, extra_controller_terms=("integral",)))
    command = np.tile([0.4, -0.3], (901, 1))
    enabled = np.ones((901, 2))
    enabled[600:] = 0.0
    held = swing(900, position=command, position_command=command, torque_enable=enabled)
    made = problem_of(step, held, values={f"{joint}.servo_integral": 3.0 for joint in PENDULUM})
    [found] = made.evaluate(made.initial_unknowns, False).episode_predictions
    q, z = found.rollout.state[:, :2], found.rollout.state[:, 4:]
    assert np.all(np.abs(q[0] - command[0]) > 1e-3)  # it begins where it sags without one
    assert q[600] == pytest.approx(command[0], abs=2e-4)
    assert z[601:] == pytest.approx(np.tile(z[600], (300, 1)), abs=1e-9)
    middle = (q[1:601] + q[:600]) / 2
    assert z[600] == pytest.approx(H * np.sum(command[0] - middle, axis=0), abs=1e-9)
    torque = actuated_joint_torques_of_rollout(step, made.theta, found.rollout)
    assert torque[599] == pytest.approx(np.array([60.0, 25.0]) * 3.0 * z[600], rel=0.02)


def test_a_current_limit_takes_from_braking_as_well(urdf_folder) -> None:
    effects = [("current_limit", "shoulder", {"limit": 5.0})]
    step = pendulum_step(urdf_folder, effects, driven=PENDULUM, servos=FIRMWARE)
    torque = torque_function(step, VALUES)
    most = 5.0 * MOTOR_PRESETS["mx64"].plain.torque_constant
    assert torque([1.0, 0.0], [0.0, 0.0], [0.0, 0.0])[0] == pytest.approx(most, rel=0.05)
    assert torque([0.0, 0.0], [0.0, 0.0], [-4.0, 0.0])[0] == pytest.approx(most, rel=1e-3)
    assert torque([0.02, 0.0], [0.0, 0.0], [0.0, 0.0])[0] == pytest.approx(60 * 0.02, rel=1e-3)
    # a motor without a published constant has no current
    bare = pendulum_step(urdf_folder, driven=PENDULUM, servos=DC).system
    assert ("current_limit", "shoulder") not in candidate_kinds_and_locations(bare, ["joints.position"])
    assert ("current_limit", "elbow") in candidate_kinds_and_locations(step.system, ["joints.position"])


def test_a_motor_that_is_off_gives_no_torque_however_fast_it_turns(step) -> None:
    assert list(torque_function(step, VALUES)([MOTOR_OFF_COMMAND] * 2, [0.3, 0.2], [3.0, -5.0])) == [0.0, 0.0]


@pytest.mark.parametrize("preset", MOTOR_PRESETS)
def test_a_preset_stalls_at_its_supply_over_its_resistance(preset) -> None:
    data = MOTOR_PRESETS[preset]
    for constants in filter(None, (data.plain, data.load_dependent)):
        values = data.servo_values(constants)
        stall = constants.torque_constant * data.supply_voltage / constants.resistance
        assert values["servo_torque_limit"] == pytest.approx(data.duty_limit * stall)
        # at no load it turns as fast as its counter-voltage is the supply's
        assert stall / values["servo_damping"] == pytest.approx(data.supply_voltage / constants.torque_constant)


def swing(steps: int = 60, **channels):
    """Commands that hold, turn round and hold again: joints stick, slide and reverse."""
    t = H * np.arange(steps + 1)
    wave = np.clip(np.sin(9.0 * t[:, None] + np.array([0.0, 1.0])), -0.6, 0.6)
    command = np.array([0.3, -0.2]) + 0.3 * np.minimum(t / 0.1, 1.0)[:, None] * wave
    values = {"position": command, "position_command": command, "position_std": 1e-3} | channels
    return joints(PENDULUM, t, values.pop("position"), **values)


def problem_of(step, group, free=("shoulder.servo_gain",), values=None, **options) -> EstimationProblem:
    known = {name: value for name, value in VALUES.items() if name in step.system.parameters}
    return EstimationProblem(step, [recording(group)], list(free), ProblemOptions(**options), known | (values or {}))


def test_a_preset_belongs_to_a_dc_motor() -> None:
    with pytest.raises(ConfigError, match="the preset 'xl330' is for a dc motor, but the motor has kind: ideal"):
        MotorKindAndPreset(preset="xl330")


def test_recordings_state_the_gain_of_the_firmware_once_for_all_joints_or_for_each(step) -> None:
    one = recording(swing(proportional_gain=400.0), name="one")
    each = recording(swing(proportional_gain=np.array([400.0, 100.0])), name="each")
    found = servo_gain_parameters_by_recording(step.system, [one, each])
    assert found["one"] == {"shoulder.servo_gain_factor": 400.0, "elbow.servo_gain_factor": 400.0}
    assert found["each"]["elbow.servo_gain_factor"] == 100.0
    with pytest.raises(DataError, match="has no proportional gain"):
        servo_gain_parameters_by_recording(step.system, [one, recording(swing(), name="silent")])


def test_with_efforts_of_zero_and_no_commands_motors_are_off_and_joints_are_let_go(urdf_folder, step) -> None:
    start = np.array([0.4, -0.3])
    off = swing(position=np.tile(start, (61, 1)), position_command=None, effort=np.zeros((61, 2)))
    problem = problem_of(step, off)
    assert np.all(problem.episodes[0].torque == MOTOR_OFF_COMMAND)
    state = problem.evaluate(problem.initial_unknowns).episode_predictions[0].rollout.state
    assert state[0, :2] == pytest.approx(start, abs=1e-3)
    # it falls from rest as a driven pendulum without torque does
    free = pendulum_step(urdf_folder, driven=PENDULUM)
    fallen = simulate(free, free.system.parameters.vector(), np.append(state[0, :2], [0, 0]), 60, np.zeros((60, 2)))
    assert state[-1, 0] != pytest.approx(state[0, 0], abs=0.1)
    assert state[:, :2] == pytest.approx(fallen.state[:, :2], abs=1e-6)


def test_a_column_switches_motors_within_a_recording(step) -> None:
    enabled = np.ones((61, 2))
    enabled[20:35, 1] = 0.0
    moved = swing(position=0.9 * swing().position, torque_enable=enabled)
    problem = problem_of(step, moved)
    off = problem.episodes[0].torque >= MOTOR_OFF_COMMAND / 2
    assert not off[:, 0].any()
    assert list(np.flatnonzero(off[:, 1])) == list(range(20, 35))
    found = problem.simulate_synthetic_recording().joints
    assert np.array_equal(found.torque_enable[:60], enabled[:60])
    assert found.position_command == pytest.approx(moved.position_command)
    with pytest.raises(DataError, match="neither 0 nor 1"):
        validated_recording(recording(swing(torque_enable=np.full((61, 2), 0.5))))


LADDER = {
    "coulomb": [("joint_coulomb", {"tau_c": 0.8})],
    "stribeck": [("joint_coulomb", {"tau_c": 0.8}), ("joint_stribeck", {"tau_s": 0.2, "v_stribeck": 0.1})],
    "presliding": [("joint_presliding", {"tau_c": 0.8})],
    "load": [("joint_coulomb", {"tau_c": 0.3}), ("joint_load_friction", {"share": 0.2})],
    "firmware": [("current_limit", {"limit": 1.5}), ("supply_voltage", {"scale": 0.9})],
    "drive": [("supply_voltage", {"scale": 0.9}), ("back_emf", {"scale": 1.3}), ("servo_gain", {"scale": 0.8})],
}


@pytest.mark.parametrize("law", LADDER)
@pytest.mark.parametrize("power", ["on", "switched", "off"])
def test_slopes_through_sticking_reversal_and_rest_are_those_of_differences(urdf_folder, law, power) -> None:
    effects = [(kind, joint, values) for kind, values in LADDER[law] for joint in PENDULUM]
    step = pendulum_step(urdf_folder, effects, driven=PENDULUM, servos=INTEGRATING if law == "firmware" else DC)
    enabled = np.ones((61, 2))
    enabled[20:35] = 0.0
    group = {
        "on": swing(),
        "switched": swing(torque_enable=enabled),
        "off": swing(position_command=None, effort=np.zeros((61, 2))),
    }[power]
    names = step.system.parameters.names
    # a delay moves the sample at which a motor is switched off: there is a jump, not a slope
    free = [name for name in names if ("servo" in name or "@" in name) and "servo_delay" not in name]
    made = problem_of(step, group, free, FIRMWARE_VALUES if law == "firmware" else None)
    assert_slopes_are_those_of_differences(made, lambda _, value: 1e-6 * max(1e-2, abs(value)), 2e-4, 1e-4)


def test_friction_of_a_load_grows_with_what_hangs_and_pulls(urdf_folder) -> None:
    """Held against its weight by its motor, the gear carries the weight twice: motor and weight pull at both sides."""
    step = pendulum_step(urdf_folder, [("joint_load_friction", "elbow", {"share": 0.1})], driven=PENDULUM, servos=DC)
    system, e = step.system, step.equations
    point = {"q": np.array([0.2, 0.7]), "v": np.array([0.0, 1.0])}
    h = 1e-6
    start, end = point["q"] - h / 2 * point["v"], point["q"] + h / 2 * point["v"]
    balance = ca.Function("b", [e.q0, e.q1, e.p0, e.u, e.theta, e.time_step], [e.balance_remainder])

    def remainder(share: float, command: float) -> float:
        theta = system.parameters.vector(VALUES | {"joint_load_friction@elbow.share": share})
        return float(balance(start, end, [0, 0], [0.2, command], theta, h)[1]) * 2 / h

    torque = torque_function(step, VALUES)
    for command in (0.2, 0.7, 1.5):
        pull = torque([0.2, command], point["q"], point["v"])[1]
        # at rest both nodes are at the same place, and half the slope is of either
        outside = -2 * float(weight_at(e, system, point["q"])[1])
        expected = -0.1 * abs(pull - outside)
        assert remainder(0.1, command) - remainder(0.0, command) == pytest.approx(expected, abs=2e-3)


def weight_at(e, system, q):
    slope = ca.gradient(e.rigid_body_terms.potential_energy, e.q0)
    return np.array(ca.Function("w", [e.q0, e.q1, e.theta], [slope])(q, q, system.parameters.vector(VALUES))).ravel()
