"""The interface of all sensors: channels, symbolic readings, and how measurements are taken from a recording."""

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
    """A group of measured channels with one clock; hashable.

    Channels are named `group.point` (three outputs each) or `joints.quantity.JOINT` (one output each).
    """

    @property
    def group(self) -> str:
        """Name of the recording's group, such as `points_camera`."""
        ...

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the channels, in the order of the outputs."""
        ...

    @property
    def unit(self) -> str:
        """Unit of the readings."""
        ...

    @property
    def width(self) -> int:
        """Number of outputs per channel: 3 for a point, 1 for a joint."""
        ...

    @property
    def frames(self) -> tuple[str, ...]:
        """Name of the mechanism's frame that each channel marks; none for joints."""
        ...

    @property
    def points(self) -> tuple[str, ...]:
        """Recorded name of the point that each channel marks; none for joints."""
        ...

    @property
    def efforts(self) -> tuple[str, ...]:
        """Names of joints whose predicted effort it reads, filtered like the path; none for other sensors."""
        ...

    @property
    def camera(self) -> Placement | None:
        """Pose of the camera in the world; None for any other sensor."""
        ...

    @property
    def baseline(self) -> Literal["zero", "stays"]:
        """What a trivial prediction without a model is: zero, or the first measured value."""
        ...

    def __hash__(self) -> int: ...

    def output(self, state: NodeState) -> ca.SX:
        """What the sensor reads at a node without effects, shape (width * len(channels), 1)."""
        ...


def sensor_function(system: System, sensor: Sensor, names: tuple[str, ...]) -> ca.Function:
    """A CasADi function for readings y(q, z, effort; theta), effects included, with their derivatives.

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
    """A recorded group of points, as in `data.recording.PointGroup`."""

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
    """Recorded joints, as in `data.recording.JointGroup`."""

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
    """A recording as sensors need it, as in `data.recording.Recording`."""

    @property
    def name(self) -> str: ...  # noqa: D102
    @property
    def joints(self) -> JointData | None: ...  # noqa: D102
    @property
    def points(self) -> Sequence[PointData]: ...  # noqa: D102


EffortKind = Literal["sample", "mean", "command"]
"""What a recorded effort is: the sampled torque, its mean until the next sample, or a command held until then."""


class Choice(Protocol):
    """Settings of one recorded group, as in `problem.options.SensorOptions`."""

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
    """A zero-phase low-pass filter, as in `problem.low_pass.LowPass`."""

    @property
    def cutoff(self) -> float: ...  # noqa: D102
    @property
    def settling(self) -> float: ...  # noqa: D102

    def __call__(self, t: Array, values: Array) -> Array: ...  # noqa: D102
    def stride(self, step: float) -> int: ...  # noqa: D102
    def gains(self, step: float) -> tuple[float, float, float]: ...  # noqa: D102


@dataclass(frozen=True)
class Surroundings:
    """What is needed to read a sensor's measurements from a recording.

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
    """The measurements of one sensor in one recording.

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
"""Functions that take all measurements of one kind of sensor from a recording, by kind."""


def joint_columns(joints: JointData, names: tuple[str, ...], where: str) -> list[int]:
    """Column indices of the named joints in a recording; `DataError` for a joint that is not recorded."""
    for name in names:
        if name not in joints.names:
            raise DataError(
                f"joint '{name}' of the model is not recorded",
                where=f"{where}: joints",
                hint=nearest(name, joints.names),
            )
    return [joints.names.index(name) for name in names]
