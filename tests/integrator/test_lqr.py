"""The tracking filter: optimal gains, a reference that a true motion follows, what effects do to its momentum."""

import casadi as ca
import numpy as np
import pytest
import scipy.linalg

from yid_ocp.effects import make_effect
from yid_ocp.effects.bodies import system_with_mass_scale_parameters
from yid_ocp.errors import ModelError
from yid_ocp.integrator.step import compile_step, simulate
from yid_ocp.integrator.tracking_feedback import (
    EffectMomentumCalculator,
    RecordedMotionWithSensitivities,
    lqr_tracking_feedback,
    proportional_tracking_feedback,
)
from yid_ocp.model import FlexibleSegment, System, flexible_object, forward_kinematics
from yid_ocp.model.kinematics import lagrangian_first_derivatives, mass_matrix

ANGLE, RATE, TORQUE = 0.02, 0.3, 1.0
STEPS, TIME_STEP = 300, 5e-3


@pytest.fixture(scope="module")
def step(robot):
    """The driven pendulum with a rod hung on its tip."""
    rod = flexible_object([FlexibleSegment("R", 0.2, 0.02, 0.01, links=1)])
    system = System.build(robot, objects=[(rod, "tip", None)], driven=robot.joint_names, damping=0.1)
    return compile_step(system, TIME_STEP, use_compiler=False)


@pytest.fixture(scope="module")
def motion(robot):
    """The bare arm's own motion under a known torque."""
    arm = compile_step(System.build(robot, driven=robot.joint_names, damping=0.1), TIME_STEP, use_compiler=False)
    time = np.arange(STEPS) * TIME_STEP
    torque = np.stack([3.0 * np.sin(2 * time), np.cos(3 * time)], axis=1)
    swung = simulate(arm, arm.system.parameters.vector(), np.array([0.3, -0.2, 0.0, 0.0]), STEPS, torque)
    assert swung.status.is_converged
    return arm, torque, swung


def test_gains_far_from_the_end_solve_the_riccati_equation(step, robot):
    """About a posture that is held still, the weights being those that the filter promises, in angles and rates."""
    posture = np.array([0.3, -0.2])
    q, v = ca.SX.sym("q", 2), ca.SX.sym("v", 2)
    tree = robot.with_numeric_values()
    rigid = lagrangian_first_derivatives(forward_kinematics(tree, q), v, ca.SX(ca.DM([0, 0, -9.81])))
    function = ca.Function("arm", [q, v], [mass_matrix(rigid, tree), rigid.lagrangian_by_q])
    inertia, by_q = (np.array(ca.densify(x)) for x in function(posture, [0, 0]))
    torque = np.tile(-by_q.ravel(), (STEPS, 1))
    theta = step.system.parameters.vector()
    loop = lqr_tracking_feedback(step, np.tile(posture, (STEPS + 1, 1)), torque, theta)
    n = step.system.n_coordinates
    np.testing.assert_array_equal(loop.state_indices, [0, 1, n, n + 1])

    arm = compile_step(System.build(robot, driven=robot.joint_names, damping=0.1), TIME_STEP, use_compiler=False)
    a, b, _ = arm.jacobians(posture, np.zeros(2), torque[0], arm.system.parameters.vector(), names=())
    backward = np.linalg.inv(inertia)
    weight = scipy.linalg.block_diag(np.eye(2) / ANGLE**2, backward.T @ backward / RATE**2)
    held = np.eye(2) / TORQUE**2
    cost = scipy.linalg.solve_discrete_are(a, b, weight, held)
    expected = np.linalg.solve(held + b.T @ cost @ b, b.T @ cost @ a)
    np.testing.assert_allclose(loop.gain[0], expected, rtol=2e-2, atol=2e-2 * np.max(np.abs(expected[:, 2:])))
    # momenta are fed back, and by the end no angle is worth a torque
    assert np.min(np.abs(np.diag(expected[:, 2:]))) > 1.0
    assert np.max(np.abs(loop.gain[-1, :, :2])) < 0.01 * np.max(np.abs(expected[:, :2]))


def test_the_reference_is_a_motion_of_the_arm_alone(step, motion):
    """It holds the angles and, by the arm's own equations, the momenta; the first one from a standing start."""
    _, torque, swung = motion
    loop = lqr_tracking_feedback(step, swung.state[:, :2], torque, step.system.parameters.vector())
    np.testing.assert_allclose(loop.reference[1:], swung.state[1:-1], rtol=0, atol=1e-9)


def test_a_proportional_filter(step):
    measured = np.arange(8.0).reshape(4, 2)
    loop = proportional_tracking_feedback(step, measured, [5.0, 7.0])
    np.testing.assert_array_equal(loop.gain, [np.diag([5.0, 7.0])] * 3)
    np.testing.assert_array_equal(loop.reference, measured[:-1])
    np.testing.assert_array_equal(loop.state_indices, [0, 1])
    np.testing.assert_array_equal(proportional_tracking_feedback(step, measured, 5.0).gain, [np.diag([5.0, 5.0])] * 3)
    with pytest.raises(ModelError, match=r"-1 N m/rad is negative"):
        proportional_tracking_feedback(step, measured, [5.0, -1.0])
    with pytest.raises(ModelError, match="3 gains for 2 driven joints"):
        proportional_tracking_feedback(step, measured, [1.0, 2.0, 3.0])


def test_driven_joints_must_come_first(parts):
    step = compile_step(parts.cable(driven=["C_2_x"]), 0.01, use_compiler=False)
    with pytest.raises(ModelError, match="come before the driven ones"):
        lqr_tracking_feedback(step, np.zeros((4, 1)), np.zeros((3, 1)), step.system.parameters.vector())


ANGLES = slice(0, 2)
MOMENTA = slice(2, 4)
AT = "shoulder"
OWN = {f"{joint}.{quantity}" for joint in ("shoulder", "elbow") for quantity in ("mass", "damping")}
EFFECTS = {
    "nothing": (),
    "armature": (("rotor_inertia", {"armature": 0.3}),),
    "a heavier link": (("link_mass", {"scale": 1.2}),),
    "friction": (("joint_coulomb", {"tau_c": 0.4}), ("joint_viscous", {"b": 0.2})),
    "friction that holds": (("joint_presliding", {"tau_c": 0.4, "yield_angle": 0.05}),),
    "at its neutral angle": (("joint_presliding", {"tau_c": 0.4, "yield_angle": 5e-3}),),
    "two that hold": tuple(("joint_presliding", {"tau_c": 0.4, "yield_angle": 0.05}) for _ in range(2)),
}


@pytest.fixture(scope="module")
def plain(robot):
    return System.build(robot, driven=robot.joint_names, damping=0.1)


def step_with(system, names):
    """The step with effects at the shoulder, a second one of a kind at the elbow."""
    effects = []
    for kind, size in names:
        place = "elbow" if any(effect.kind == kind for effect in effects) else AT
        effects.append(make_effect(kind, place, system, size))
    return compile_step(system.with_effects(effects), TIME_STEP, use_compiler=False)


def moved(step, values=None, remembered=0.6):
    """The step, its parameters, a motion with the torques and first memories that made it, and the momentum's shift."""
    theta = step.system.parameters.vector(values)
    time = np.arange(STEPS) * TIME_STEP
    torque = np.stack([3.0 * np.sin(2 * time), np.cos(3 * time)], axis=1)
    internal = np.full(step.sizes["nz"], remembered)
    swung = simulate(step, theta, np.concatenate([[0.3, -0.2, 0.0, 0.0], internal]), STEPS, torque)
    assert swung.status.is_converged
    return step, theta, (swung.state, torque, internal), EffectMomentumCalculator(step)


@pytest.mark.parametrize("names", EFFECTS.values(), ids=EFFECTS)
@pytest.mark.parametrize("misread", [0.0, 0.5], ids=["torque as read", "torque misread"])
def test_reference_and_shift_are_the_momentum_of_the_true_motion(plain, names, misread):
    """A filter that follows them pulls at nothing; the first node is stood at before the reference begins."""
    step, theta, (state, torque, internal), shift = moved(step_with(plain, names))
    read = torque + misread
    loop = lqr_tracking_feedback(step, state[:, ANGLES], read, shift.parameter_values_with_neutral_effects(theta))
    recorded, true = (RecordedMotionWithSensitivities(state[:, ANGLES], x, internal) for x in (read, torque))
    value, _ = shift.effect_momentum_shifts_and_sensitivities(recorded, true, theta, ())
    np.testing.assert_allclose(loop.reference[1:, MOMENTA] + value[1:], state[1:-1, MOMENTA], atol=1e-9)
    if names or misread:
        assert np.max(np.abs(value)) > 1e-3


def test_the_reference_follows_masses_and_damping_of_the_arm_that_are_fitted(plain):
    step = compile_step(system_with_mass_scale_parameters(plain, "mass_scale"), TIME_STEP, use_compiler=False)
    names = {"shoulder.mass_scale": 1.1, "elbow.mass_scale": 0.8, "elbow.damping": 0.4}
    step, theta, (state, torque, internal), shift = moved(step, names)
    loop = lqr_tracking_feedback(step, state[:, ANGLES], torque, shift.parameter_values_with_neutral_effects(theta))
    recorded = RecordedMotionWithSensitivities(state[:, ANGLES], torque, internal)
    value, slopes = shift.effect_momentum_shifts_and_sensitivities(recorded, recorded, theta, tuple(names))
    np.testing.assert_allclose(loop.reference[1:, MOMENTA] + value[1:], state[1:-1, MOMENTA], atol=1e-9)
    assert np.all(np.max(np.abs(slopes), axis=(0, 1)) > 1e-4)


def test_the_shift_of_a_torque_that_was_misread(plain):
    """Half the impulse of the error; the derivative says the same of a gain."""
    _, theta, (state, torque, none), shift = moved(step_with(plain, ()))
    assert set(shift.parameter_names) == OWN
    by_torque = np.stack([torque, 0 * torque], axis=2)
    recorded = RecordedMotionWithSensitivities(state[:, ANGLES], torque, none)
    true = RecordedMotionWithSensitivities(state[:, ANGLES], 1.5 * torque, none, torque_sensitivity=by_torque)
    value, slope = shift.effect_momentum_shifts_and_sensitivities(recorded, true, theta, ("gain", "other"))
    np.testing.assert_allclose(value[1:], 0.5 * TIME_STEP / 2 * torque[:-1], atol=1e-12)
    np.testing.assert_allclose(slope[:, :, 0] * 0.5, value, atol=1e-12)
    np.testing.assert_array_equal(slope[:, :, 1], 0.0)
    by_previous = shift.momentum_derivative_by_previous_torque(theta)
    np.testing.assert_allclose(by_previous, TIME_STEP / 2 * np.eye(2), atol=1e-15)


@pytest.mark.parametrize("names", [EFFECTS["two that hold"], EFFECTS["friction"]], ids=["holds", "slides"])
def test_derivatives_are_those_of_differences(plain, names):
    """By the effects' parameters, and by what angles, torques and internal coordinates do beside them."""
    step, theta, (state, torque, internal), shift = moved(step_with(plain, names))
    wanted = shift.parameter_names
    d, rng = len(wanted) + 2, np.random.default_rng(1)
    by_angles, by_torque = (0.01 * rng.normal(size=(*x.shape, d)) for x in (state[:, ANGLES], torque))
    by_internal = 0.1 * rng.normal(size=(len(internal), d))
    recorded = RecordedMotionWithSensitivities(state[:, ANGLES], torque, internal)

    def at(move):
        """The shift after a move along each of d directions; parameters move by the first ones."""
        own = theta.copy()
        own[[step.system.parameters.index(name) for name in wanted]] += move[: len(wanted)]
        parts = (state[:, ANGLES] + by_angles @ move, torque + by_torque @ move, internal + by_internal @ move)
        true = RecordedMotionWithSensitivities(*parts, by_angles, by_torque, by_internal)
        return shift.effect_momentum_shifts_and_sensitivities(recorded, true, own, wanted)

    value, slopes = at(np.zeros(d))
    assert slopes.shape == (*value.shape, d)
    for i, one in enumerate(np.eye(d)):
        numeric = (at(1e-6 * one)[0] - at(-1e-6 * one)[0]) / 2e-6
        np.testing.assert_allclose(slopes[:, :, i], numeric, rtol=1e-4, atol=1e-4 * max(np.abs(numeric).max(), 1e-3))


def test_an_effect_away_from_neutral_or_sought_shifts_the_momentum(plain):
    step = step_with(plain, EFFECTS["armature"])
    shift = EffectMomentumCalculator(step)
    [name] = set(shift.parameter_names) - OWN
    theta = step.system.parameters.vector()
    neutral = shift.parameter_values_with_neutral_effects(theta)
    assert neutral[step.system.parameters.index(name)] == 0.0
    assert not shift.changes_momentum(neutral, ())
    assert shift.changes_momentum(theta, ())
    assert shift.changes_momentum(neutral, (name,))
