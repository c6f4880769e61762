"""Generalized forces J' f of external forces on segments of the object.

An unknown generalized force is a torque between neighbours. What pulls at a segment from outside is felt by every joint
between it and the ground, most by the lowest.
"""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from yid_ocp.model.kinematics import forward_kinematics
from yid_ocp.model.system import System

Array = NDArray[np.float64]

_FORCE_POINT = "75%"
"""Where a segment is pushed, by arc length: what acts on its tip and what acts all along it are both near that."""


def segment_weights(system: System, theta: Array) -> dict[str, float]:
    """Return the weight of every segment that has a mass [N].

    Parameters
    ----------
    system : System
    theta : ndarray, shape (ntheta,)
    """
    tree, masses = system.mechanism, {}
    for segment in system.segment_layouts:
        joints = [tree.joints[tree.joint_index(name)] for link in segment.link_joints for name in link]
        if tree.has_frame(f"{segment.name}:{_FORCE_POINT}"):
            masses[segment.name] = sum((body.mass for joint in joints for body in joint.bodies), ca.SX(0))
    if not masses:
        return {}
    total = ca.norm_2(ca.SX(system.gravity)) * ca.vertcat(*masses.values())
    found = np.array(ca.Function("weights", [system.parameters.symbols], [total])(theta)).ravel()
    return {name: float(weight) for name, weight in zip(masses, found, strict=True) if weight > 0}


def generalized_forces_per_newton(system: System, theta: Array, q: Array, segments: Sequence[str]) -> Array:
    """Return the generalized forces of 1 N along x, y and z on each of some segments.

    Parameters
    ----------
    system : System
    theta : ndarray, shape (ntheta,)
    q : ndarray, shape (N, n)
        Configurations.
    segments : sequence of str

    Returns
    -------
    ndarray, shape (N, n, 3 ns)
        [N m/N or 1].
    """
    if not segments:
        return np.zeros((*q.shape, 0))
    symbol = ca.SX.sym("q", system.n_coordinates)
    moved = forward_kinematics(system.mechanism, symbol)
    jacobian = ca.vertcat(*(moved.position_jacobian(f"{segment}:{_FORCE_POINT}") for segment in segments))
    function = ca.Function("pushed", [symbol, system.parameters.symbols], [ca.densify(jacobian.T)])
    found = np.array(function.map(len(q))(q.T, np.tile(theta[:, None], len(q))))
    return found.reshape(system.n_coordinates, len(q), 3 * len(segments)).transpose(1, 0, 2)
