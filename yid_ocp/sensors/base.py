"""What every sensor has in common: a name, outputs with units, and the expression of what it reads."""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol, runtime_checkable

import casadi as ca

from yid_ocp.model.kinematics import forward_kinematics
from yid_ocp.model.mechanism import Placement
from yid_ocp.model.system import NodeState, System


@runtime_checkable
class Sensor(Protocol):
    """A group of measured channels that share a clock.

    Channels are named `group.point` (three outputs each) or `joints.quantity.JOINT` (one output each).
    """

    @property
    def group(self) -> str:
        """Name of the recording's group."""
        ...

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the channels, in the order of the outputs."""
        ...

    @property
    def unit(self) -> str:
        """Unit of the outputs."""
        ...

    @property
    def width(self) -> int:
        """Number of outputs of one channel."""
        ...

    @property
    def frames(self) -> tuple[str, ...]:
        """Frame of the mechanism that each channel marks; none for joints."""
        ...

    @property
    def camera(self) -> Placement | None:
        """Pose in the world of the camera that looks; None for any other sensor."""
        ...

    def output(self, state: NodeState) -> ca.SX:
        """What the sensor reads at a node, shape (width * len(channels), 1)."""
        ...


def sensor_function(system: System, sensor: Sensor, names: tuple[str, ...]) -> ca.Function:
    """Outputs y(q, z, effort; theta) with derivatives by q, z, effort and the named parameters.

    Parameters
    ----------
    system : System
    sensor : Sensor
    names : tuple of str
        Parameters by which to differentiate.

    Returns
    -------
    casadi.Function
        (q, z, effort, theta) to (y, dy/dq, dy/dz, dy/deffort, dy/dtheta); effort has one entry for every joint.
    """
    rows = {name: i for i, name in enumerate(system.internal)}
    q, z = ca.SX.sym("q", system.size), ca.SX.sym("z", len(rows))
    effort = ca.SX.sym("effort", system.size)
    kinematics = forward_kinematics(system.mechanism, q)
    state = NodeState(system, kinematics, q, z, effort, rows, sensor.camera)
    parts = ca.vertsplit(sensor.output(state), sensor.width)
    read = []
    marked = sensor.frames or (None,) * len(sensor.channels)
    for channel, part, frame in zip(sensor.channels, parts, marked, strict=True):
        for effect in system.effects:
            part = effect.measure(channel, part, replace(state, frame=frame))
        read.append(part)
    output = ca.vertcat(*read)
    symbols = ca.vertcat(*system.internal.values()) if rows else ca.SX(0, 1)
    output = ca.densify(ca.substitute(output, symbols, z))
    chosen = ca.vertcat(*(system.parameters[name].symbol for name in names)) if names else ca.SX(0, 1)
    outputs = [output, *(ca.jacobian(output, x) for x in (q, z, effort, chosen))]
    return ca.Function("sensor", [q, z, effort, system.parameters.symbols], ca.cse(outputs))
