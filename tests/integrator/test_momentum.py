"""What effects do to the momentum of a known motion: the filter's reference and the shift are the true one's."""

from __future__ import annotations

import numpy as np
import pytest

from yid_ocp.effects import make_effect
from yid_ocp.integrator.step import compile_step, simulate
from yid_ocp.integrator.tracking_feedback import DrivenJointMotion, EffectMomentumShift, lqr_feedback
from yid_ocp.model import System
from yid_ocp.model.urdf import read_urdf

STEPS, TIME_STEP = 300, 5e-3
ANGLES = slice(0, 2)
MOMENTA = slice(2, 4)
AT = "shoulder"
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
def plain(urdf_folder):
    robot = read_urdf(urdf_folder / "double_pendulum.urdf")
    return System.build(robot, driven=robot.joint_names, damping=0.1)


def compiled(system, names):
    """The step with effects at the shoulder, a second one of a kind at the elbow."""
    effects = []
    for kind, size in names:
        place = "elbow" if any(effect.kind == kind for effect in effects) else AT
        effects.append(make_effect(kind, place, system, size))
    return compile_step(system.with_effects(effects), TIME_STEP, use_compiler=False)


def moved(step, theta, remembered=0.6):
    """A motion, the torques that made it, and what its joints remembered at first."""
    time = np.arange(STEPS) * TIME_STEP
    torque = np.stack([3.0 * np.sin(2 * time), np.cos(3 * time)], axis=1)
    internal = np.full(step.sizes["nz"], remembered)
    start = np.concatenate([[0.3, -0.2, 0.0, 0.0], internal])
    swung = simulate(step, theta, start, STEPS, torque)
    assert swung.status.is_converged
    return swung.state, torque, internal


@pytest.mark.parametrize("names", EFFECTS.values(), ids=EFFECTS)
@pytest.mark.parametrize("misread", [0.0, 0.5], ids=["torque as read", "torque misread"])
def test_reference_and_shift_are_the_momentum_of_the_true_motion(plain, names, misread):
    """A filter that follows them pulls at nothing; the first node is stood at before the reference begins."""
    step = compiled(plain, names)
    theta = step.system.parameters.vector()
    state, torque, internal = moved(step, theta)
    shift = EffectMomentumShift(step)
    read = torque + misread
    loop = lqr_feedback(step, state[:, ANGLES], read, shift.theta_without_effects(theta))
    true = DrivenJointMotion(state[:, ANGLES], torque, internal)
    value, _ = shift.momentum_shift_and_derivatives(
        DrivenJointMotion(state[:, ANGLES], read, internal), true, theta, ()
    )
    np.testing.assert_allclose(loop.reference[1:, MOMENTA] + value[1:], state[1:-1, MOMENTA], atol=1e-9)
    if names or misread:
        assert np.max(np.abs(value)) > 1e-3


def test_the_shift_of_a_torque_that_was_misread(plain):
    """Half the impulse of the error; the derivative says the same of a gain."""
    step = compiled(plain, ())
    theta = step.system.parameters.vector()
    state, torque, none = moved(step, theta)
    shift = EffectMomentumShift(step)
    assert shift.parameter_names == ()
    by_torque = np.stack([torque, 0 * torque], axis=2)
    recorded = DrivenJointMotion(state[:, ANGLES], torque, none)
    true = DrivenJointMotion(state[:, ANGLES], 1.5 * torque, none, torque_sensitivity=by_torque)
    value, slope = shift.momentum_shift_and_derivatives(recorded, true, theta, ("gain", "other"))
    np.testing.assert_allclose(value[1:], 0.5 * TIME_STEP / 2 * torque[:-1], atol=1e-12)
    np.testing.assert_allclose(slope[:, :, 0] * 0.5, value, atol=1e-12)
    np.testing.assert_array_equal(slope[:, :, 1], 0.0)
    np.testing.assert_allclose(
        shift.momentum_derivative_by_previous_torque(theta), TIME_STEP / 2 * np.eye(2), atol=1e-15
    )


@pytest.mark.parametrize("names", [EFFECTS["two that hold"], EFFECTS["friction"]], ids=["holds", "slides"])
def test_derivatives_are_those_of_differences(plain, names):
    """By the effects' parameters, and by what angles, torques and internal coordinates do beside them."""
    step = compiled(plain, names)
    theta = step.system.parameters.vector()
    state, torque, internal = moved(step, theta)
    shift = EffectMomentumShift(step)
    wanted = shift.parameter_names
    d, rng = len(wanted) + 2, np.random.default_rng(1)
    by_angles, by_torque = (0.01 * rng.normal(size=(*x.shape, d)) for x in (state[:, ANGLES], torque))
    by_internal = 0.1 * rng.normal(size=(len(internal), d))
    recorded = DrivenJointMotion(state[:, ANGLES], torque, internal)

    def at(move):
        """The shift after a move along each of d directions; parameters move by the first ones."""
        own = theta.copy()
        own[[step.system.parameters.index(name) for name in wanted]] += move[: len(wanted)]
        parts = (state[:, ANGLES] + by_angles @ move, torque + by_torque @ move, internal + by_internal @ move)
        return shift.momentum_shift_and_derivatives(
            recorded, DrivenJointMotion(*parts, by_angles, by_torque, by_internal), own, wanted
        )

    value, slopes = at(np.zeros(d))
    assert slopes.shape == (*value.shape, d)
    for i, one in enumerate(np.eye(d)):
        numeric = (at(1e-6 * one)[0] - at(-1e-6 * one)[0]) / 2e-6
        np.testing.assert_allclose(slopes[:, :, i], numeric, rtol=1e-4, atol=1e-4 * max(np.abs(numeric).max(), 1e-3))


def test_an_effect_away_from_neutral_or_sought_shifts_the_momentum(plain):
    step = compiled(plain, EFFECTS["armature"])
    shift = EffectMomentumShift(step)
    [name] = shift.parameter_names
    theta = step.system.parameters.vector()
    neutral = shift.theta_without_effects(theta)
    assert neutral[step.system.parameters.index(name)] == 0.0
    assert not shift.is_active(neutral, ())
    assert shift.is_active(theta, ())
    assert shift.is_active(neutral, (name,))
