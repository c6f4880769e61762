"""Sensors of the robot's joints."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from yid_ocp.model.mechanism import Placement
from yid_ocp.model.system import NodeState


@dataclass(frozen=True)
class EffortSensor:
    """Effort of the named joints, which are prescribed: what the discrete inverse dynamics says they needed."""

    joints: tuple[str, ...]
    group: str = "joints.effort"

    @property
    def channels(self) -> tuple[str, ...]:
        """`joints.effort.JOINT` for every joint."""
        return tuple(f"{self.group}.{joint}" for joint in self.joints)

    @property
    def unit(self) -> str:
        """Newton metres."""
        return "N m"

    @property
    def width(self) -> int:
        """One output a joint."""
        return 1

    @property
    def frames(self) -> tuple[str, ...]:
        """No points."""
        return ()

    @property
    def camera(self) -> Placement | None:
        """No camera."""
        return None

    def output(self, state: NodeState) -> ca.SX:
        """Efforts of the joints, shape (nj, 1) [N m]."""
        return ca.vertcat(*(state.effort[state.system.mechanism.joint_index(joint)] for joint in self.joints))
