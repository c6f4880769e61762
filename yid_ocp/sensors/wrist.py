"""Wrist force/torque sensors, which measure the wrench that bodies and grasps beyond their frame exert on them.

The model is cut at the frame. The part beyond hangs on six locked joints, three along and three about the frame's axes.
By the Euler-Lagrange equations of the cut model, the efforts of these joints are

    d/dt dL/dv - dL/dq - F + Dphi(q)' lam.

They are the force and torque of the sensor on the part beyond. The reading has the opposite sign.
"""

from __future__ import annotations

from dataclasses import replace

import casadi as ca

from yid_ocp.model.kinematics import forward_kinematics, lagrangian_first_derivatives
from yid_ocp.model.mechanism import Inertia, Placement
from yid_ocp.model.system import MidpointStateSymbols, NodeStateSymbols, System, six_joint_floating_mechanism
from yid_ocp.sensors.base import RecordedChannelSpec
from yid_ocp.sensors.mounted import MountedSensor, register_class_of_mounted_sensor

_XYZ, _SIGN = ("x", "y", "z"), {"sign": "1"}
_N_LOCKED_JOINTS = 6


@register_class_of_mounted_sensor
class _WristForceSensor(MountedSensor):
    """Force that the part beyond the sensor exerts on it, along the sensor frame's axes."""

    channel = RecordedChannelSpec("wrist", "force", "N", _XYZ, _SIGN)

    def _frame_reading(self, state: NodeStateSymbols, frame: str) -> ca.SX:
        return _wrench_on_sensor(state, frame)[:3]


@register_class_of_mounted_sensor
class _WristTorqueSensor(MountedSensor):
    """Torque that the part beyond the sensor exerts on it about the origin of its frame, along the frame's axes."""

    channel = RecordedChannelSpec("wrist", "torque", "N m", _XYZ, _SIGN)

    def _frame_reading(self, state: NodeStateSymbols, frame: str) -> ca.SX:
        return _wrench_on_sensor(state, frame)[3:]


def _wrench_on_sensor(state: NodeStateSymbols, frame: str) -> ca.SX:
    """Force and torque (6, 1), along the frame's axes, that the part beyond a frame exerts on the sensor in it."""
    system, first = _cut_at_frame(state.system, frame)
    locked, n = slice(first, first + _N_LOCKED_JOINTS), system.n_coordinates
    q, v = ca.SX.sym("q", n), ca.SX.sym("v", n)

    def widened(values: ca.SX) -> ca.SX:
        return ca.vertcat(values[:first], ca.SX(ca.DM.zeros(_N_LOCKED_JOINTS)), values[first:])

    kinematics = forward_kinematics(system.mechanism, q)
    rigid = lagrangian_first_derivatives(kinematics, v, system.gravity)
    momentum, push = rigid.lagrangian_by_v[locked], rigid.lagrangian_by_q[locked]
    u, z_rate = ca.SX(len(system.driven), 1), ca.SX(*state.z.shape)
    rows = state.internal_rows
    middle = MidpointStateSymbols(system, kinematics, q, v, state.z, z_rate, u, state.lam, rows, ca.SX(1))
    for effect in system.effects:
        terms = effect.step_terms(middle)
        momentum += ca.gradient(terms.lagrangian, v)[locked]
        push += ca.gradient(terms.lagrangian, q)[locked]
        wrenches = terms.force_with_derivatives
        forces = (terms.generalized_force, terms.dissipative_force, wrenches.force if wrenches else None)
        push += sum((force[locked] for force in forces if force is not None), ca.SX(_N_LOCKED_JOINTS, 1))
    if system.n_constraints:
        push -= ca.jtimes(system.constraint_residual(kinematics), q, state.lam, True)[locked]
    needed = ca.jtimes(momentum, q, v) + ca.jtimes(momentum, v, widened(state.a)) - push
    return ca.substitute(-needed, ca.vertcat(q, v), ca.vertcat(widened(state.q), widened(state.v)))


def _cut_at_frame(system: System, name: str) -> tuple[System, int]:
    """Copy of a system in which six locked joints carry the part beyond a frame, and the index of the first of them."""
    tree = system.mechanism
    frame = tree.frame(name)
    before, first = frame.joint_index, frame.joint_index + 1
    last, turn = before + _N_LOCKED_JOINTS, frame.placement.rotation.T
    back = Placement(turn, -turn @ frame.placement.translation)
    chain = list(six_joint_floating_mechanism(f"{name} cut").joints)
    chain[0] = replace(chain[0], parent_index=before, placement=frame.placement)
    near = (body.scaled_by(ca.SX(-1)) for body in frame.proximal_bodies)
    bodies = tuple(body.transformed_by(back) for body in (*tree.joints[before].bodies, *near))
    chain[-1] = replace(chain[-1], bodies=bodies)
    wide = tree.with_joint_chain_added_at_index(first, chain)
    joints = list(wide.joints)
    for i, joint in enumerate(wide.joints[last + 1 :], last + 1):
        if joint.parent_index == before and joint.name not in frame.proximal_names:
            joints[i] = replace(joint, parent_index=last, placement=back @ joint.placement)
    frames = dict(wide.frames)
    for key, entry in wide.frames.items():
        if entry.joint_index == before and key not in frame.proximal_names:
            frames[key] = replace(entry, joint_index=last, placement=back @ entry.placement)
    if system.servos:  # a controller may compensate the arm's weight, but the weight still acts on a sensor
        joints = [replace(joint, bodies=tuple(map(_with_weight, joint.bodies))) for joint in joints]
    return replace(system, mechanism=replace(wide, joints=tuple(joints), frames=frames)), first


def _with_weight(body: Inertia) -> Inertia:
    return replace(body, gravity_fraction=ca.SX(1)) if body.gravity_fraction.is_zero() else body
