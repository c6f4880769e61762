"""Friction in the joints of arms."""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca

from yid_ocp.effects.base import EFFECTS, SMOOTHING, EffectBase, Quantity, on_joint, robot_joints
from yid_ocp.model.system import MidpointState, System, Terms


@EFFECTS.register("joint_viscous")
class JointViscous(EffectBase):
    """F = -b v, beside the model's damping."""

    equation = "F = -b v"
    depends_on = "how fast it moves"

    @classmethod
    def locations(cls, system: System) -> tuple[str, ...]:
        """Arm joints."""
        return robot_joints(system)

    @classmethod
    def quantities_at(cls, location: str, system: System) -> tuple[Quantity, ...]:
        """b [N m s/rad]."""
        return (Quantity("b", "N m s/rad", 0.0, 0.0, 10.0, (0.0, 2.0), "viscous friction"),)

    def terms(self, state: MidpointState) -> Terms:
        """See the class."""
        return _friction(self, state, lambda v: self["b"] * v)


@EFFECTS.register("joint_coulomb")
class JointCoulomb(EffectBase):
    """F = -tau_c tanh(v/v_s), v_s = `SMOOTHING`."""

    equation = "F = -tau_c tanh(v/v_s)"
    depends_on = "how fast it moves"

    @classmethod
    def locations(cls, system: System) -> tuple[str, ...]:
        """Arm joints."""
        return robot_joints(system)

    @classmethod
    def quantities_at(cls, location: str, system: System) -> tuple[Quantity, ...]:
        """tau_c [N m]."""
        return (Quantity("tau_c", "N m", 0.0, 0.0, 10.0, (0.0, 2.0), "sliding friction"),)

    def terms(self, state: MidpointState) -> Terms:
        """See the class."""
        return _friction(self, state, lambda v: self["tau_c"] * ca.tanh(v / SMOOTHING))


@EFFECTS.register("joint_stribeck")
class JointStribeck(EffectBase):
    """F = -tau_s exp(-(v/v_stribeck)^2) tanh(v/v_s), v_s = `SMOOTHING`: what sticking adds to sliding friction."""

    equation = "F = -tau_s exp(-(v/v_stribeck)^2) tanh(v/v_s)"
    depends_on = "how fast it moves"

    @classmethod
    def locations(cls, system: System) -> tuple[str, ...]:
        """Arm joints."""
        return robot_joints(system)

    @classmethod
    def quantities_at(cls, location: str, system: System) -> tuple[Quantity, ...]:
        """tau_s [N m] and v_stribeck [rad/s]."""
        return (
            Quantity("tau_s", "N m", 0.0, 0.0, 10.0, (0.0, 2.0), "friction at low speed beside sliding friction"),
            Quantity("v_stribeck", "rad/s", 0.1, 5e-3, 2.0, (0.01, 0.3), "speed beyond which it is gone", shape=True),
        )

    def terms(self, state: MidpointState) -> Terms:
        """See the class."""
        width = self["v_stribeck"]
        return _friction(self, state, lambda v: self["tau_s"] * ca.exp(-((v / width) ** 2)) * ca.tanh(v / SMOOTHING))


def _friction(effect: EffectBase, state: MidpointState, law: Callable[[ca.SX], ca.SX]) -> Terms:
    v = state.v[state.system.mechanism.joint_index(effect.location)]
    return Terms(viscous=on_joint(state.system, effect.location, -law(v)))
