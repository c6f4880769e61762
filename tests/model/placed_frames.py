"""Numbers of symbolic kinematics."""

import casadi as ca
import numpy as np

from yid_ocp.model import forward_kinematics


def numbers(expression, parameters=None) -> np.ndarray:
    """The value of an expression, at nominal parameters where it has any."""
    if parameters is None:
        return np.array(ca.DM(ca.densify(expression)))
    return np.array(ca.densify(ca.Function("numbers", [parameters.symbols], [expression])(parameters.vector())))


def positions(item, frames, q=None):
    """Where frames stand at nominal parameters, shape (len(frames), 3)."""
    mechanism = item.mechanism.with_numeric_values()
    q = np.zeros(len(mechanism.joints)) if q is None else q
    kinematics = forward_kinematics(mechanism, ca.SX(ca.DM(q)))
    return np.array([numbers(kinematics.frame_position(frame)).ravel() for frame in frames])
