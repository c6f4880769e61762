"""What every sensor has in common: its channels, the expression of what it reads, what it takes from a recording."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, Protocol, runtime_checkable

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from yid_ocp.errors import DataError, nearest
from yid_ocp.model.kinematics import forward_kinematics
from yid_ocp.model.mechanism import Placement
from yid_ocp.model.system import NodeState, System
from yid_ocp.registry import Registry

Array = NDArray[np.float64]


@runtime_checkable
class Sensor(Protocol):
    """A group of measured channels that share a clock; hashable.

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
    def points(self) -> tuple[str, ...]:
        """Recorded name of the point that each channel marks; none for joints."""
        ...

    @property
    def efforts(self) -> tuple[str, ...]:
        """Joints whose effort it reads, smoothed like the motion it follows from; none for other sensors."""
        ...

    @property
    def camera(self) -> Placement | None:
        """Pose in the world of the camera that looks; None for any other sensor."""
        ...

    @property
    def baseline(self) -> Literal["zero", "stays"]:
        """What a prediction without a model says: nothing is needed, or everything stays where it was first seen."""
        ...

    def __hash__(self) -> int: ...

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


# -- from a recording -------------------------------------------------------------------------------------------------


class PointData(Protocol):
    """A recorded group of points; see `data.recording.PointGroup`."""

    @property
    def name(self) -> str: ...  # noqa: D102
    @property
    def names(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def sensor(self) -> str: ...  # noqa: D102
    @property
    def t(self) -> Array: ...  # noqa: D102
    @property
    def position(self) -> Array: ...  # noqa: D102
    @property
    def std(self) -> Array | None: ...  # noqa: D102
    @property
    def pose(self) -> Array | None: ...  # noqa: D102


class JointData(Protocol):
    """Recorded joints; see `data.recording.JointGroup`."""

    @property
    def names(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def t(self) -> Array: ...  # noqa: D102
    @property
    def position(self) -> Array: ...  # noqa: D102
    @property
    def effort(self) -> Array | None: ...  # noqa: D102
    @property
    def effort_std(self) -> float | Array | None: ...  # noqa: D102
    @property
    def effort_bias_std(self) -> float | Array | None: ...  # noqa: D102
    @property
    def effort_taken_as(self) -> str: ...  # noqa: D102
    @property
    def position_std(self) -> float | Array | None: ...  # noqa: D102


class RecordingData(Protocol):
    """What sensors need of a recording; see `data.recording.Recording`."""

    @property
    def name(self) -> str: ...  # noqa: D102
    @property
    def joints(self) -> JointData | None: ...  # noqa: D102
    @property
    def points(self) -> Sequence[PointData]: ...  # noqa: D102


EffortKind = Literal["sample", "mean", "command"]
"""What a recorded effort is of the torque that acted: its value, its mean until the next sample, or held until then."""


class Choice(Protocol):
    """How one group of a recording is used; see `problem.options.SensorOptions`."""

    @property
    def use(self) -> bool | None: ...  # noqa: D102
    @property
    def std(self) -> float | Mapping[str, float] | None: ...  # noqa: D102
    @property
    def frames(self) -> Mapping[str, str]: ...  # noqa: D102
    @property
    def points(self) -> tuple[str, ...] | None: ...  # noqa: D102
    @property
    def bias_std(self) -> float | Mapping[str, float] | None: ...  # noqa: D102
    @property
    def kind(self) -> EffortKind | None: ...  # noqa: D102


class Smoothing(Protocol):
    """A zero-phase low-pass filter; see `problem.low_pass.LowPass`."""

    @property
    def cutoff(self) -> float: ...  # noqa: D102
    @property
    def settling(self) -> float: ...  # noqa: D102

    def __call__(self, t: Array, values: Array) -> Array: ...  # noqa: D102
    def stride(self, step: float) -> int: ...  # noqa: D102
    def gains(self, step: float) -> tuple[float, float, float]: ...  # noqa: D102


@dataclass(frozen=True)
class Surroundings:
    """What a sensor's part of a recording is read with.

    Attributes
    ----------
    system : System
    recording : RecordingData
    choice : callable
        From a group's name to how it is used.
    times : ndarray, shape (N + 1,)
        Of the rollout's nodes [s].
    time_step : float
        Between them [s].
    low_pass : Smoothing
        That of efforts of prescribed joints.
    inertia : callable
        From joint names and some of their configurations, shape (K, k), to their part of the mass matrix in each of
        them, shape (K, k, k) [kg m^2 or kg].
    """

    system: System
    recording: RecordingData
    choice: Callable[[str], Choice]
    times: Array
    time_step: float
    low_pass: Smoothing
    inertia: Callable[[tuple[str, ...], Array], Array]


@dataclass(frozen=True)
class SensorData:
    """What one sensor measured in one recording.

    Attributes
    ----------
    sensor : Sensor
    t : ndarray, shape (M,)
        [s]
    value, std : ndarray, shape (M, k)
        Outputs, NaN where there is none, and the standard deviations of their noise, in the sensor's unit.
    span : (int, int), optional
        First and last node at which the sensor can be predicted; all of them when absent.
    bias_std : ndarray, optional, shape (k,)
        Standard deviations of an error of every output that is constant in one recording; none when absent.
    correlation : ndarray, optional, shape (M, k, k)
        Of the noise of the outputs of one sample; none when absent.
    """

    sensor: Sensor
    t: Array
    value: Array
    std: Array
    span: tuple[int, int] | None = None
    bias_std: Array | None = None
    correlation: Array | None = None


SENSORS: Registry[Callable[[Surroundings], list[SensorData]]] = Registry("kind of sensor")
"""What looks through a recording for the measurements of one kind of sensor."""


def joint_columns(joints: JointData, names: tuple[str, ...], where: str) -> list[int]:
    """Columns of the named joints; `DataError` with the nearest recorded name where one is missing."""
    for name in names:
        if name not in joints.names:
            raise DataError(
                f"joint '{name}' of the model is not recorded",
                where=f"{where}: joints",
                hint=nearest(name, joints.names),
            )
    return [joints.names.index(name) for name in names]
