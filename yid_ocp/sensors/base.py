"""The interface of all sensors: channels, symbolic readings, and how measurements are taken from a recording."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Literal, Protocol

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from yid_ocp.errors import DataError, nearest_name_hint
from yid_ocp.model.kinematics import forward_kinematics
from yid_ocp.model.mechanism import Placement
from yid_ocp.model.system import NodeState, System
from yid_ocp.registry import Registry

Array = NDArray[np.float64]


class Sensor(ABC):
    """A group of measured channels with one clock; hashable, as subclasses are frozen dataclasses.

    Channels are named `group.point` (three outputs each) or `joints.quantity.JOINT` (one output each).

    Attributes
    ----------
    group_name : str
        The recording's group, such as `points_camera`.
    unit : str
        Of the readings.
    outputs_per_channel : int
        3 for a point, 1 for a joint.
    naive_prediction : "zero" or "stays"
        What a trivial prediction without a model is: zero, or the first measured value.
    frame_names, point_names : tuple of str
        The mechanism's frame that each channel marks and its recorded name; none for joints.
    """

    group_name: str
    unit: ClassVar[str]
    outputs_per_channel: ClassVar[int] = 1
    naive_prediction: ClassVar[Literal["zero", "stays"]] = "stays"
    frame_names: tuple[str, ...]
    point_names: tuple[str, ...]

    @property
    @abstractmethod
    def channel_names(self) -> tuple[str, ...]:
        """Names of the channels, in the order of the outputs."""

    @property
    def effort_joints(self) -> tuple[str, ...]:
        """Names of joints whose predicted effort it reads, filtered like the path; none for other sensors."""
        return ()

    @property
    def camera_pose(self) -> Placement | None:
        """Pose of the camera in the world; None for any other sensor."""
        return None

    @abstractmethod
    def ideal_reading(self, state: NodeState) -> ca.SX:
        """What the sensor reads at a node without effects, shape (outputs_per_channel * len(channel_names), 1)."""


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
    rows = {name: i for i, name in enumerate(system.internal_coordinates)}
    q, z = ca.SX.sym("q", system.n_coordinates), ca.SX.sym("z", len(rows))
    effort = ca.SX.sym("effort", system.n_coordinates)
    kinematics = forward_kinematics(system.mechanism, q)
    state = NodeState(system, kinematics, q, z, effort, rows, sensor.camera_pose)
    parts = ca.vertsplit(sensor.ideal_reading(state), sensor.outputs_per_channel)
    read = []
    marked = sensor.frame_names or (None,) * len(sensor.channel_names)
    for channel, part, frame in zip(sensor.channel_names, parts, marked, strict=True):
        for effect in system.effects:
            part = effect.distorted_reading(channel, part, replace(state, marked_frame=frame))
        read.append(part)
    output = ca.vertcat(*read)
    symbols = ca.vertcat(*system.internal_coordinates.values()) if rows else ca.SX(0, 1)
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
    def effort_kind_or_default(self) -> str: ...  # noqa: D102
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


class SensorUsage(Protocol):
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
    def effort_kind(self) -> EffortKind | None: ...  # noqa: D102


class SmoothingFilter(Protocol):
    """A zero-phase low-pass filter, as in `problem.effort_filter.LowPassFilter`."""

    @property
    def cutoff(self) -> float: ...  # noqa: D102
    @property
    def settling_time(self) -> float: ...  # noqa: D102

    def __call__(self, t: Array, values: Array) -> Array: ...  # noqa: D102
    def decorrelation_stride(self, step: float) -> int: ...  # noqa: D102
    def noise_gains(self, step: float) -> tuple[float, float, float]: ...  # noqa: D102


@dataclass(frozen=True)
class SensorContext:
    """What is needed to read a sensor's measurements from a recording.

    Attributes
    ----------
    system : System
    recording : RecordingData
    sensor_usage : callable
        From a group's name to how it is used.
    node_times : ndarray, shape (N + 1,)
        Of the rollout's nodes [s].
    time_step : float
        Between them [s].
    effort_filter : Smoothing
        That of efforts of prescribed joints.
    joint_mass_matrices : callable
        From joint names and some of their configurations, shape (K, k), to their part of the mass matrix in each of
        them, shape (K, k, k) [kg m^2 or kg].
    """

    system: System
    recording: RecordingData
    sensor_usage: Callable[[str], SensorUsage]
    node_times: Array
    time_step: float
    effort_filter: SmoothingFilter
    joint_mass_matrices: Callable[[tuple[str, ...], Array], Array]


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
    predictable_nodes : (int, int), optional
        First and last node at which the sensor can be predicted; all of them when absent.
    bias_std : ndarray, optional, shape (k,)
        Standard deviations of an error of every output that is constant in one recording; none when absent.
    noise_correlation : ndarray, optional, shape (M, k, k)
        Of the noise of the outputs of one sample; none when absent.
    """

    sensor: Sensor
    t: Array
    value: Array
    std: Array
    predictable_nodes: tuple[int, int] | None = None
    bias_std: Array | None = None
    noise_correlation: Array | None = None


SENSOR_READERS: Registry[Callable[[SensorContext], list[SensorData]]] = Registry("kind of sensor")
"""Functions that take all measurements of one kind of sensor from a recording, by kind."""


def recorded_joint_columns(joints: JointData, names: tuple[str, ...], where: str) -> list[int]:
    """Column indices of the named joints in a recording; `DataError` for a joint that is not recorded."""
    for name in names:
        if name not in joints.names:
            raise DataError(
                f"joint '{name}' of the model is not recorded",
                where=f"{where}: joints",
                hint=nearest_name_hint(name, joints.names),
            )
    return [joints.names.index(name) for name in names]
