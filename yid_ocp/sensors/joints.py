"""Sensors of the robot's joints: effort."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import casadi as ca
import numpy as np

from yid_ocp.errors import ConfigError, DataError, nearest
from yid_ocp.model.mechanism import Placement
from yid_ocp.model.system import NodeState
from yid_ocp.sensors.base import SENSORS, Array, Choice, SensorData, Surroundings, joint_columns

EFFORT = "joints.effort"


@dataclass(frozen=True)
class EffortSensor:
    """Effort of the named joints, which are prescribed: what the discrete inverse dynamics says they needed."""

    joints: tuple[str, ...]
    group: str = EFFORT

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
    def points(self) -> tuple[str, ...]:
        """No points."""
        return ()

    @property
    def efforts(self) -> tuple[str, ...]:
        """All its joints."""
        return self.joints

    @property
    def camera(self) -> Placement | None:
        """No camera."""
        return None

    @property
    def baseline(self) -> Literal["zero", "stays"]:
        """No effort is needed."""
        return "zero"

    def output(self, state: NodeState) -> ca.SX:
        """Efforts of the joints, shape (nj, 1) [N m]."""
        return ca.vertcat(*(state.effort[state.system.mechanism.joint_index(joint)] for joint in self.joints))


@SENSORS.register(EFFORT)
def measured_efforts(around: Surroundings) -> list[SensorData]:
    """Recorded efforts of prescribed joints, smoothed like the motion, at nodes far enough apart to be independent.

    Raises
    ------
    DataError
        No noise level, or a recording too short for the filter.
    """
    joints, choice = around.recording.joints, around.choice(EFFORT)
    if joints is None or joints.effort is None or not choice.use:
        return []
    names = tuple(name for name in around.system.prescribed if name in joints.names)
    if not names:
        return []
    times, low_pass, where = around.times, around.low_pass, around.recording.name
    effort = low_pass(joints.t, joints.effort[:, joint_columns(joints, names, where)])
    measured = np.stack([np.interp(times, joints.t, column) for column in effort.T], axis=1)
    period = float(np.median(np.diff(joints.t)))
    std = _effort_std(around, names, choice, period)
    # Smoothed values repeat their neighbours: only as many are kept as count as independent. Both ends are left out:
    # the filter sees one side alone there, the impulse at node 0 depends on the motion before the recording and that at
    # the last node on the motion after it.
    # Steps shorter than the recording's period have nodes between its samples, where nothing was measured.
    step, steps = around.time_step, len(times) - 1
    apart = max(1, round(period / step))
    ends = apart * math.ceil(max(1, math.ceil(low_pass.settling / step)) / apart)
    kept = np.arange(ends, steps + 1 - ends, apart * math.ceil(low_pass.stride(step) / apart))
    if not len(kept):
        raise DataError(
            f"{steps * step:.3g} s of efforts are too short for a filter of {low_pass.cutoff:g} Hz",
            where=where,
            allowed=f"more than {2 * ends * step:.3g} s",
            hint="use a longer recording, or raise problem.path_cutoff",
        )
    spread = np.broadcast_to(std, measured.shape)[kept]
    return [SensorData(EffortSensor(names), times[kept], measured[kept], spread, (1, steps - 1))]


def _effort_std(around: Surroundings, names: tuple[str, ...], choice: Choice, period: float) -> Array:
    """Standard deviation of smoothed efforts: the sensor's noise and that of accelerations from noisy encoders."""
    joints = around.recording.joints
    assert joints is not None
    given = choice.std if choice.std is not None else joints.effort_std
    if given is None:
        raise DataError(
            "the noise level of the joint efforts is neither recorded nor given",
            where=around.recording.name,
            hint="set sensors.joints.effort.std [N m], from a stretch at rest or the data sheet",
        )
    std = _by_joint(given, joints.names, names, "sensors.joints.effort.std")
    value_gain, _, second_gain = around.low_pass.gains(period)
    known = choice.position_std if choice.position_std is not None else joints.position_std
    angle = _by_joint(0.0 if known is None else known, joints.names, names, "sensors.joints.effort.position_std")
    return np.asarray(np.sqrt((std * value_gain) ** 2 + (around.inertia(names) * angle * second_gain) ** 2))


def _by_joint(
    given: float | Array | Mapping[str, float], recorded: Sequence[str], names: Sequence[str], key: str
) -> Array:
    """One number for each of `names` from one for all, one for each recorded joint, or a mapping."""
    if isinstance(given, Mapping):
        for name in names:
            if name not in given:
                raise ConfigError(f"joint '{name}' has no value", where=key, hint=nearest(name, given))
        return np.array([float(given[name]) for name in names])
    wide = np.broadcast_to(np.asarray(given, float), (len(recorded),))
    return wide[[list(recorded).index(name) for name in names]]
