"""Made-up pieces of small problems: recordings, measurements on nodes, sensors."""

from __future__ import annotations

import numpy as np

from yid_ocp.data.recording import JointGroup, PointGroup, Recording
from yid_ocp.problem.measurements import Measurements
from yid_ocp.sensors.joints import EffortSensor
from yid_ocp.sensors.points import PointSensor


def efforts(*joints: str) -> EffortSensor:
    """A sensor of one output a joint."""
    return EffortSensor(joints)


def points(*names: str, pose=None, group="points") -> PointSensor:
    """A sensor of three outputs a point, each its own frame."""
    return PointSensor(group, names, names, pose)


def measured(sensor, node, fraction, value, weight=None, std=None, span=(0, 100)) -> Measurements:
    """Samples on nodes; whitened by unit noise unless weights are given."""
    value = np.asarray(value, float)
    seen = np.isfinite(value)
    weight = np.where(seen, 1.0, 0.0) if weight is None else np.asarray(weight, float)
    std = np.where(seen, 1.0, np.nan) if std is None else np.asarray(std, float)
    return Measurements(sensor, np.asarray(node), np.asarray(fraction, float), value, weight, std, span)


def joints(names, t, position, **more) -> JointGroup:
    return JointGroup(tuple(names), np.asarray(t, float), np.asarray(position, float), **more)


def seen(names, t, position, name="points", **more) -> PointGroup:
    return PointGroup(name, tuple(names), np.asarray(t, float), np.asarray(position, float), **more)


def recording(group=None, *groups, name="made") -> Recording:
    return Recording(group, groups, name=name)
