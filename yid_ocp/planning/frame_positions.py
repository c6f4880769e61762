"""Positions of named frames in the world along a motion, with Jacobians."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from yid_ocp.errors import ConfigError, nearest_name_hint
from yid_ocp.model.kinematics import forward_kinematics
from yid_ocp.model.system import System
from yid_ocp.parallel import CASADI_LOCK

Array = NDArray[np.float64]


class FramePositions:
    """Function for world positions of named frames and their Jacobian by the configuration.

    Parameters
    ----------
    system : System
    names : sequence of str

    Raises
    ------
    ConfigError
        There is no such frame.
    """

    def __init__(self, system: System, names: Sequence[str]) -> None:
        for name in names:
            if not system.mechanism.has_frame(name):
                raise ConfigError(
                    f"there is no frame '{name}'", where="plan", hint=nearest_name_hint(name, system.point_frames)
                )
        self.names = tuple(names)
        with CASADI_LOCK:
            q, theta = ca.SX.sym("q", system.n_coordinates), ca.vertcat(*(entry.symbol for entry in system.parameters))
            kinematics = forward_kinematics(system.mechanism, q)
            at = ca.vertcat(ca.SX(0, 1), *(kinematics.frame_position(name) for name in names))
            slope = ca.densify(ca.jacobian(at, q))
            self._function = ca.Function("points", [q, theta], [ca.densify(at), ca.vec(slope.T)])

    def positions_and_jacobian(self, q: Array, theta: Array) -> tuple[Array, Array]:
        """Positions (N, 3 np) [m] and their Jacobian (N, 3 np, n) at configurations (N, n)."""
        at, slope = (np.array(x).T for x in self._function(np.asarray(q).T, np.asarray(theta)))
        return at, slope.reshape(len(at), at.shape[1], np.shape(q)[1])
