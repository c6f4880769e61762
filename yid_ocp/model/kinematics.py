"""Symbolic kinematics and rigid-body mechanics of a kinematic tree, with joint screws in the world frame.

A spatial velocity is the angular velocity and the linear velocity of the body's point at the world origin. A wrench is
the moment about the world origin and the force. Derivatives are cheap because all are in one fixed frame.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import casadi as ca

from yid_ocp.model.mechanism import Frame, Inertia, Mechanism, Placement, symbolic_rotation_from_axis_angle


@dataclass(frozen=True)
class Kinematics:
    """The symbolic poses and screws of all joints of a mechanism at one configuration."""

    mechanism: Mechanism
    joint_rotations: tuple[ca.SX, ...]  # from each joint's moving frame to the world, each (3, 3)
    joint_origins: tuple[ca.SX, ...]  # each (3, 1) [m]
    joint_screws: tuple[ca.SX, ...]  # S_j, the spatial velocity per unit rate of joint j, each (6, 1)

    def frame_pose(self, frame: str | Frame) -> Placement:
        """Return the pose of a frame in the world. The frame is given by name or as a `Frame`."""
        entry = self._frame(frame)
        j, local = entry.joint_index, entry.placement
        return local if j < 0 else Placement(self.joint_rotations[j], self.joint_origins[j]) @ local

    def frame_position(self, frame: str | Frame) -> ca.SX:
        """Return the position of a frame's origin in the world, shape (3, 1) [m]."""
        return self.frame_pose(frame).translation

    def position_jacobian(self, frame: str | Frame) -> ca.SX:
        """Return the Jacobian (3, n) of a frame's world position with respect to the configuration."""
        point = self.frame_position(frame)
        return self._columns(frame, lambda screw: screw[3:] + ca.cross(screw[:3], point))

    def angular_jacobian(self, frame: str | Frame) -> ca.SX:
        """Return the Jacobian (3, n) of a frame's angular velocity, in world axes, with respect to the joint rates."""
        return self._columns(frame, lambda screw: screw[:3])

    def joint_velocities_and_screw_rates(self, v: ca.SX) -> tuple[list[ca.SX], list[ca.SX]]:
        """Return each joint's spatial velocity V_j and the rate D_j = V_parent x S_j of its screw, each (6, 1)."""
        velocities, rates = list[ca.SX](), list[ca.SX]()
        for j, joint in enumerate(self.mechanism.joints):
            above = velocities[joint.parent_index] if joint.parent_index >= 0 else ca.SX(ca.DM.zeros(6))
            rates.append(motion_cross_motion_product(above, self.joint_screws[j]))
            velocities.append(above + self.joint_screws[j] * v[j])
        return velocities, rates

    def _frame(self, frame: str | Frame) -> Frame:
        return self.mechanism.frame(frame) if isinstance(frame, str) else frame

    def _columns(self, frame: str | Frame, column: Callable[[ca.SX], ca.SX]) -> ca.SX:
        columns = [ca.SX(3, 1)] * len(self.joint_screws)
        for j in self.mechanism.ancestor_joint_indices(self._frame(frame).joint_index):
            columns[j] = column(self.joint_screws[j])
        return ca.horzcat(ca.SX(3, 0), *columns)


@dataclass(frozen=True)
class LagrangianFirstDerivatives:
    """The first derivatives of the rigid-body Lagrangian, and vectors from which the second derivatives are computed.

    S_j is the screw of joint j and D_j = V_parent(j) x S_j, with the velocity V_parent(j) of the link before the joint.
    Ic_j, H_j and W_j are the inertia, momentum and weight of all bodies that joint j moves:

        dL/dv_j = S_j . H_j            dL/dq_j = D_j . H_j + S_j . W_j

    The second derivatives, for i = j or i an ancestor of j, with F_j = Ic_j S_j, B_j = Ic_j D_j + S_j x* H_j, the
    derivative G_j of the weight's moment (in W_j) by q_j, and the angular part w_i of S_i:

        L_vv[i, j] = S_i . F_j              L_qv[j, i] = S_i . B_j   (row: q_j, column: v_i)
        L_qq[i, j] = D_i . B_j + w_i . G_j  L_qv[i, j] = D_i . F_j
    """

    lagrangian_by_q: ca.SX  # shape (n, 1)
    lagrangian_by_v: ca.SX  # shape (n, 1)
    potential_energy: ca.SX  # [J]
    S: ca.SX  # S, D, F and B have the shape (6, n)
    D: ca.SX
    F: ca.SX
    B: ca.SX
    G: ca.SX  # shape (3, n)


def motion_cross_motion_product(a: ca.SX, b: ca.SX) -> ca.SX:
    """Compute the spatial cross product a x b of two twists, angular part first, shape (6, 1)."""
    return ca.vertcat(ca.cross(a[:3], b[:3]), ca.cross(a[:3], b[3:]) + ca.cross(a[3:], b[:3]))


def motion_cross_force_product(a: ca.SX, f: ca.SX) -> ca.SX:
    """Compute the spatial cross product a x* f of a twist and a wrench, angular part first, shape (6, 1)."""
    return ca.vertcat(ca.cross(a[:3], f[:3]) + ca.cross(a[3:], f[3:]), ca.cross(a[:3], f[3:]))


def forward_kinematics(mechanism: Mechanism, q: ca.SX) -> Kinematics:
    """Compute the poses and screws of all joints at a configuration q (n, 1) [rad or m]."""
    rotations, origins, screws = list[ca.SX](), list[ca.SX](), list[ca.SX]()
    for j, joint in enumerate(mechanism.joints):
        rotation, origin = joint.placement.rotation, joint.placement.translation
        if joint.parent_index >= 0:
            origin = rotations[joint.parent_index] @ origin + origins[joint.parent_index]
            rotation = rotations[joint.parent_index] @ rotation
        axis = rotation @ ca.SX(ca.DM(joint.axis))
        if joint.kind == "revolute":
            rotations.append(rotation @ symbolic_rotation_from_axis_angle(joint.axis, q[j]))
            screws.append(ca.vertcat(axis, ca.cross(origin, axis)))
        else:
            origin = origin + axis * q[j]
            rotations.append(rotation)
            screws.append(ca.vertcat(ca.SX(ca.DM.zeros(3)), axis))
        origins.append(origin)
    return Kinematics(mechanism, tuple(rotations), tuple(origins), tuple(screws))


def lagrangian_first_derivatives(kinematics: Kinematics, v: ca.SX, gravity: ca.SX) -> LagrangianFirstDerivatives:
    """Compute the first derivatives of the bodies' Lagrangian at joint velocities v (n, 1) and gravity (3, 1)."""
    S, (velocity, D) = kinematics.joint_screws, kinematics.joint_velocities_and_screw_rates(v)
    moved, potential_energy = _moved(kinematics, velocity, gravity)
    by_q, by_v, F, B, G = [], [], [], [], []
    for j, part in enumerate(moved):
        moment, weight = ca.cross(part.heavy_first, gravity), part.heavy * gravity
        axis, linear = S[j][:3], S[j][3:]
        by_v.append(ca.dot(S[j], part.momentum))
        by_q.append(ca.dot(D[j], part.momentum) + ca.dot(axis, moment) + ca.dot(linear, weight))
        F.append(part.inertia_times(S[j]))
        B.append(part.inertia_times(D[j]) + motion_cross_force_product(S[j], part.momentum))
        tilted = ca.cross(part.heavy_first, ca.cross(gravity, axis))
        G.append(ca.cross(axis, moment) + ca.cross(linear, weight) + tilted)
    gradients = [ca.densify(ca.vertcat(ca.SX(0, 1), *entries)) for entries in (by_q, by_v)]
    columns = ((S, 6), (D, 6), (F, 6), (B, 6), (G, 3))
    vectors = [ca.densify(ca.horzcat(ca.SX(rows, 0), *entries)) for entries, rows in columns]
    return LagrangianFirstDerivatives(*[*gradients, potential_energy, *vectors])


@dataclass
class _Moved:
    """Mass moments about the world origin and momentum of all bodies that a joint moves."""

    mass: ca.SX = field(default_factory=lambda: ca.SX(0))
    first: ca.SX = field(default_factory=lambda: ca.SX(ca.DM.zeros(3)))
    second: ca.SX = field(default_factory=lambda: ca.SX(ca.DM.zeros(3, 3)))
    momentum: ca.SX = field(default_factory=lambda: ca.SX(ca.DM.zeros(6)))
    heavy: ca.SX = field(default_factory=lambda: ca.SX(0))  # `mass` and `first` as effective weights
    heavy_first: ca.SX = field(default_factory=lambda: ca.SX(ca.DM.zeros(3)))

    def add(self, other: _Moved) -> None:
        for name in vars(self):
            setattr(self, name, getattr(self, name) + getattr(other, name))

    def inertia_times(self, motion: ca.SX) -> ca.SX:
        force = self.mass * motion[3:] + ca.cross(motion[:3], self.first)
        return ca.vertcat(self.second @ motion[:3] + ca.cross(self.first, motion[3:]), force)


def _moved(kinematics: Kinematics, velocity: Sequence[ca.SX], gravity: ca.SX) -> tuple[list[_Moved], ca.SX]:
    """Mass moments and momentum of the bodies that each joint moves, and the potential energy [J]."""
    joints = kinematics.mechanism.joints
    moved = [_Moved() for _ in joints]
    potential_energy = ca.SX(0)
    # if a body's weight is not mass times gravity, weights are summed separately from inertia
    apart = any(not body.gravity_fraction.is_one() for joint in joints for body in joint.bodies)
    for j, joint in enumerate(joints):
        for body in joint.bodies:
            com = kinematics.joint_rotations[j] @ body.center_of_mass + kinematics.joint_origins[j]
            about_com = _rotated_tensor(body, kinematics.joint_rotations[j])
            angular, linear = velocity[j][:3], velocity[j][3:] + ca.cross(velocity[j][:3], com)
            impulse = body.mass * linear
            heavy = body.mass * body.gravity_fraction
            potential_energy -= heavy * ca.dot(gravity, com)
            second = about_com + body.mass * (ca.dot(com, com) * ca.SX.eye(3) - com @ com.T)
            momentum = ca.vertcat(about_com @ angular + ca.cross(com, impulse), impulse)
            moved[j].add(_Moved(body.mass, body.mass * com, second, momentum, heavy, heavy * com))
    for j in reversed(range(len(joints))):
        if joints[j].parent_index >= 0:
            moved[joints[j].parent_index].add(moved[j])
    if not apart:
        for part in moved:
            part.heavy, part.heavy_first = part.mass, part.first
    return moved, potential_energy


def mass_matrix(rigid: LagrangianFirstDerivatives, mechanism: Mechanism) -> ca.SX:
    """Return the mass matrix (n, n) of the mechanism, computed from its Lagrangian derivatives `rigid`."""
    return _from_pairs(mechanism, lambda i, j: (_dot(rigid.S, i, rigid.F, j),) * 2)


def lagrangian_second_derivatives(
    rigid: LagrangianFirstDerivatives, mechanism: Mechanism
) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Return the second derivatives L_qq, L_qv and L_vv (n, n) of the bodies' Lagrangian. L_qv has a row for each q."""
    S, D, F, B, G = rigid.S, rigid.D, rigid.F, rigid.B, rigid.G
    by_qq = _from_pairs(mechanism, lambda i, j: (_dot(D, i, B, j) + _dot(S[:3, :], i, G, j),) * 2)
    by_qv = _from_pairs(mechanism, lambda i, j: (_dot(D, i, F, j), _dot(S, i, B, j)))
    return by_qq, by_qv, mass_matrix(rigid, mechanism)


def _dot(a: ca.SX, i: int, b: ca.SX, j: int) -> ca.SX:
    return ca.dot(a[:, i], b[:, j])


def _from_pairs(mechanism: Mechanism, entry: Callable[[int, int], tuple[ca.SX, ca.SX]]) -> ca.SX:
    """Matrix (n, n) with the entries (upper [i, j], lower [j, i]) for every joint j and its ancestors i."""
    n = len(mechanism.joints)
    matrix = ca.SX(n, n)
    for j in range(n):
        for i in mechanism.ancestor_joint_indices(j):
            upper, lower = entry(i, j)
            matrix[j, i], matrix[i, j] = lower, upper  # on the diagonal the upper one stays
    return matrix


def _rotated_tensor(body: Inertia, rotation: ca.SX) -> ca.SX:
    tensor = ca.densify(body.inertia_about_com)
    diagonal = all(tensor[i, j].is_zero() and tensor[j, i].is_zero() for i, j in [(0, 1), (0, 2), (1, 2)])
    if diagonal and ca.is_equal(tensor[0, 0], tensor[1, 1], 8):
        axis = rotation[:, 2]
        return tensor[0, 0] * ca.SX.eye(3) + (tensor[2, 2] - tensor[0, 0]) * (axis @ axis.T)
    return rotation @ tensor @ rotation.T
