"""The interface of all sensors: recorded channels, symbolic readings, and measurements from a recording."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, ClassVar, Literal, Protocol

import casadi as ca
import numpy as np
from annotated_types import Ge, Gt, Len

from yid_ocp.arrays import Array
from yid_ocp.errors import ConfigError, DataError, nearest_name_question, require_known_names
from yid_ocp.model.mechanism import Placement
from yid_ocp.model.system import NodeStateSymbols, System
from yid_ocp.options import OptionInfo
from yid_ocp.registry import Registry
from yid_ocp.sensors.signal_filters import ZeroPhaseLowPassFilter

EffortSamplingKind = Literal["sample", "mean", "command"]
"""Meaning of a recorded effort: the sampled torque, its mean until the next sample, or a command held until then."""
_Positive = Annotated[float, Gt(0)]
_NonNegative = Annotated[float, Ge(0)]


@dataclass(frozen=True)
class SensorOptions:
    """The settings of one sensor group, such as `points` [m] or `joints.effort` [N m]; stds are in its unit."""

    use: Annotated[
        bool | None,
        OptionInfo(
            "whether the estimation uses it; default: yes, but encoders of driven joints (joints.position) only if "
            "the arm has no measured points"
        ),
    ] = None
    std: Annotated[
        _Positive | Mapping[str, _Positive] | None,
        OptionInfo("noise standard deviation instead of the recorded one, by name if they differ", "sensor's SI unit"),
    ] = None
    frame_by_recorded_name: Annotated[
        Mapping[str, str],
        OptionInfo("model frame of a point (or T1:40%), wrist sensor or IMU whose name differs from the recorded one"),
    ] = field(default_factory=dict)
    used_points: Annotated[tuple[str, ...] | None, Len(1), OptionInfo("points to use; default: all")] = None
    bias_std: Annotated[
        _NonNegative | Mapping[str, _NonNegative] | None,
        OptionInfo(
            "standard deviation of a constant error of each joint's torque, or of each component of a wrist sensor "
            "or IMU, independent in every recording, instead of the recorded one",
            "the sensor's SI unit",
        ),
    ] = None
    clock_offset_std: Annotated[
        _NonNegative | None,
        OptionInfo(
            "standard deviation of a constant offset between the clocks of a point group and the joints, "
            "independent in every recording, which a fit corrects first if it exceeds half a sample; default: the "
            "recording's, or else half a sample if damping is free, or else 0",
            "s",
        ),
    ] = None
    effort_sampling_kind: Annotated[
        EffortSamplingKind | None,
        OptionInfo("relation of recorded efforts to the true torque, instead of the recording's (joints.effort only)"),
    ] = None
    constants: Annotated[
        Mapping[str, float | Mapping[str, float]],
        OptionInfo(
            "constants that the sensor's kind declares, by name, such as torque_constant [N m/A] of motors.current or "
            "sign (1 or -1) of wrist.force"
        ),
    ] = field(default_factory=dict)


@dataclass(frozen=True)
class RecordedChannelSpec:
    """A kind of recorded quantity, with its group, dataset, unit, components and sensor constants.

    Noise levels are in the group's attributes `QUANTITY_std` and `QUANTITY_bias_std` or, for points, the dataset `std`.
    """

    group: str  # recording group; a recording may have several, `GROUP` and `GROUP_NAME`, each with its own clock
    quantity: str  # dataset of the group, with one column for every name of the group
    unit: str
    components: tuple[str, ...] = ()  # names of the components of each value; none for a number
    # units of the constants that `sensors.GROUP.QUANTITY.constants` may give, by name
    constants: Mapping[str, str] = field(default_factory=dict)

    @property
    def std_attribute_names(self) -> tuple[str, str]:
        """The names of the attributes that hold the standard deviations of white noise and of a constant error."""
        return f"{self.quantity}_std", f"{self.quantity}_bias_std"

    def matches_group_name(self, name: str) -> bool:
        """Check whether a group's name is `GROUP` or `GROUP_NAME` of this channel kind. Contents are not checked."""
        return re.fullmatch(rf"{self.group}(_[^/]+)?", name) is not None


CHANNEL_KINDS: Registry[RecordedChannelSpec] = Registry("recorded channel")
"""Kinds of recorded channels. Those of `joints` and `points` have their own fields in `data.recording.Recording`."""


def channel_specs_for_group_name(group: str) -> tuple[RecordedChannelSpec, ...]:
    """Return the channel kinds that a recorded group of this name may contain. Empty for joints and points."""
    found = (CHANNEL_KINDS[name] for name in CHANNEL_KINDS)
    return tuple(c for c in found if c.group not in ("joints", "points") and c.matches_group_name(group))


class _RecordedGroup(Protocol):
    @property
    def name(self) -> str: ...
    @property
    def names(self) -> tuple[str, ...]: ...
    @property
    def t(self) -> Array: ...


class RecordedPointsInterface(_RecordedGroup, Protocol):
    """The interface of a recorded point group, with times and positions. `data.recording.PointGroup` implements it."""

    @property
    def sensor_name(self) -> str: ...
    @property
    def position(self) -> Array: ...
    @property
    def std(self) -> Array | None: ...
    @property
    def camera_pose(self) -> Array | None: ...
    @property
    def clock_offset_std(self) -> float | None: ...


class RecordedJointsInterface(_RecordedGroup, Protocol):
    """The interface of recorded joints, with names, times and channels. `data.recording.JointGroup` implements it."""

    @property
    def position(self) -> Array: ...
    @property
    def effort(self) -> Array | None: ...
    @property
    def effort_std(self) -> float | Array | None: ...
    @property
    def effort_bias_std(self) -> float | Array | None: ...
    @property
    def effort_sampling_kind_or_default(self) -> str: ...
    @property
    def position_resolution(self) -> float | Array | None: ...


class RecordedExtraChannelsInterface(_RecordedGroup, Protocol):
    """The interface of an additional sensor's recorded channels. `data.recording.SensorChannelGroup` implements it."""

    @property
    def values_by_quantity(self) -> Mapping[str, Array]: ...
    @property
    def noise_and_bias_stds_by_attribute(self) -> Mapping[str, float | Array]: ...


class _RecordingData(Protocol):
    """The interface of a recording that sensors use. `data.recording.Recording` implements it."""

    @property
    def name(self) -> str: ...
    @property
    def joints(self) -> RecordedJointsInterface | None: ...
    @property
    def points(self) -> Sequence[RecordedPointsInterface]: ...
    @property
    def channel_groups(self) -> Sequence[RecordedExtraChannelsInterface]: ...


def missing_noise_level_error(noun: str, where: str, key: str, unit: str) -> DataError:
    """Return the error for a channel whose noise standard deviation is neither recorded nor in the settings."""
    what = f"the standard deviation of the noise of {noun} is neither recorded nor in the settings"
    allowed, hint = f"a number above 0 [{unit}]", f"set sensors.{key}.std, or sensors.{key}.use: false"
    return DataError(what, where=where, allowed=allowed, hint=hint)


def recorded_joint_column_indices(joints: RecordedJointsInterface, names: tuple[str, ...], where: str) -> list[int]:
    """Return the columns of the named joints in the recorded arrays. Raises `DataError` if one is not recorded."""
    for name in names:
        if name not in joints.names:
            what = f"joint '{name}' of the model is not recorded"
            others, allowed = [own for own in joints.names if own not in names], ", ".join(joints.names)
            hint = "record it, or leave it out of model.arms.joints"
            if near := nearest_name_question(name, others):
                hint = f"{near} If so, import the file again with --joints RECORDED={name}, which renames it"
            raise DataError(what, where=f"recording '{where}': joints", allowed=allowed, hint=hint)
    return [joints.names.index(name) for name in names]


def expand_to_joint_values(
    given: float | Array | Mapping[str, float], recorded: Sequence[str], names: Sequence[str], key: str
) -> Array:
    """Return a value for each joint in `names`, from one value, an array over the `recorded` joints or a mapping."""
    if isinstance(given, Mapping):
        require_known_names(given, recorded, "recorded joint", key, ConfigError)
        for name in names:
            if name not in given:
                allowed, hint = f"a value for each of {', '.join(names)}", f"add {name}: NUMBER to {key}"
                raise ConfigError(f"'{name}' has no value", where=key, allowed=allowed, hint=hint)
        return np.array([float(given[name]) for name in names])
    return np.broadcast_to(np.asarray(given, float), (len(recorded),))[[list(recorded).index(name) for name in names]]


class Sensor(ABC):
    """The base class of sensors, which predict a group of measured channels on one clock. Sensors are hashable.

    Channels are named `group.point` (three outputs each) or `group.quantity.JOINT` (one output each).
    """

    channel: ClassVar[RecordedChannelSpec]  # kind of recorded channels
    group_name: str  # settings key: a point group, such as `points_camera`, or `joints.effort`
    # prediction without a model: zero, or the first measured value
    naive_prediction: ClassVar[Literal["zero", "stays"]] = "stays"
    has_paper_weight: ClassVar[bool] = True  # whether the cost of the source paper, in square metres, includes it
    frame_names: tuple[str, ...]  # the mechanism's frame that each channel marks; none for joints
    point_names: tuple[str, ...]  # recorded names of the points; none for joints

    @property
    def unit(self) -> str:
        """The unit of the sensor's readings (at revolute joints)."""
        return self.channel.unit

    @property
    def channel_units(self) -> tuple[str, ...]:
        """The unit of each channel's readings."""
        return (self.unit,) * len(self.channel_names)

    @property
    def outputs_per_channel(self) -> int:
        """The number of outputs of each channel, such as 3 for a point and 1 for a joint."""
        return max(len(self.channel.components), 1)

    @property
    @abstractmethod
    def channel_names(self) -> tuple[str, ...]:
        """The names of the channels, in the order of the outputs."""

    @property
    def output_names(self) -> tuple[str, ...]:
        """The name of each scalar output: the channel, followed by the component if there are several."""
        parts = [f".{part}" for part in self.channel.components] or [""]
        return tuple(f"{name}{part}" for name in self.channel_names for part in parts)

    @property
    def frame_name_per_output(self) -> tuple[str, ...]:
        """The name of the frame at which each output is measured; empty for joints."""
        frames = self.frame_names or ("",) * len(self.channel_names)
        return tuple(frame for frame in frames for _ in range(self.outputs_per_channel))

    @property
    def effort_joints(self) -> tuple[str, ...]:
        """The names of the joints whose measured efforts the sensor predicts; empty if it measures no efforts."""
        return ()

    @property
    def effort_per_unit_reading(self) -> Array:
        """The joint effort that corresponds to one unit of each output, (len(effort_joints),) [N m per unit]."""
        return np.ones(len(self.effort_joints))

    @property
    def position_joints(self) -> tuple[str, ...]:
        """The names of the driven joints whose encoders the sensor reads; empty for other sensors."""
        return ()

    @property
    def camera_pose(self) -> Placement | None:
        """The pose of the camera in the world. None if the sensor is not a camera."""
        return None

    def bias_location_name_for_frame(self, frame: str) -> str | None:
        """Return the location of a constant error of readings at a frame; None: a grasp at the frame, or the group."""
        return None if self.camera_pose is None else "camera"

    @abstractmethod
    def ideal_reading(self, state: NodeStateSymbols) -> ca.SX:
        """Return the symbolic reading without errors at a node, (outputs_per_channel * len(channel_names), 1)."""


def sensor_function_with_jacobians(system: System, sensor: Sensor, names: tuple[str, ...]) -> ca.Function:
    """Build a CasADi function of a sensor's readings y, including effects on the sensor, and of their derivatives.

    It maps (q, v, a, z, load, lam, theta) to (y, dy/dq, dy/dv, dy/da, dy/dz, dy/dload, dy/dlam, dy/dtheta), with the
    symbols of `NodeStateSymbols`. dy/dtheta has one column per parameter in `names`. v, a and lam refer to the recorded
    clock; their derivatives have no columns if the readings do not depend on them.
    """
    rows = {name: i for i, name in enumerate(system.effect_internal_coordinate_symbols)}
    n = system.n_coordinates
    sizes = {"q": n, "v": n, "a": n, "z": len(rows), "load": n, "lam": system.n_constraints}
    at = {name: ca.SX.sym(name, size) for name, size in sizes.items()}
    (at["q"], kinematics), scale = system.symbols_and_kinematics, system.recorded_time_scale
    true = (at["q"], at["v"] / scale, at["a"] / scale**2, at["z"], at["load"], at["lam"] / scale)
    state = NodeStateSymbols(system, kinematics, *true, rows, sensor.camera_pose)
    parts, read = ca.vertsplit(sensor.ideal_reading(state), sensor.outputs_per_channel), []
    marked = sensor.frame_names or (None,) * len(sensor.channel_names)
    for channel, part, frame in zip(sensor.channel_names, parts, marked, strict=True):
        for effect in system.effects:
            part = effect.reading_from_true_value(channel, part, replace(state, marked_frame=frame))
        read.append(part)
    output = ca.vertcat(*read)
    symbols = ca.vertcat(*system.effect_internal_coordinate_symbols.values()) if rows else ca.SX(0, 1)
    output = ca.densify(ca.substitute(output, symbols, at["z"]))
    chosen = ca.vertcat(*(system.parameters[name].symbol for name in names)) if names else ca.SX(0, 1)
    slopes = {name: ca.jacobian(output, symbol) for name, symbol in at.items()}
    slopes |= {name: ca.SX(output.numel(), 0) for name in ("v", "a", "lam") if not slopes[name].nnz()}
    outputs = [output, *slopes.values(), ca.jacobian(output, chosen)]
    inputs, names_in = [*at.values(), system.parameters.symbols], [*at, "theta"]
    return ca.Function("sensor", inputs, ca.cse(outputs), names_in, ["y", *(f"by_{name}" for name in names_in)])


@dataclass(frozen=True)
class SensorDataInputs:
    """The system, recording, options, nodes and filters from which a sensor's measurements are computed.

    `joint_mass_matrices` maps k joint names and configurations (K, k) to blocks (K, k, k) of the mass matrix [kg m^2].
    """

    system: System
    recording: _RecordingData
    sensor_usage: Callable[[str], SensorOptions]  # sensor's options by settings key
    node_times: Array  # times of the rollout's nodes, shape (N + 1,) [s]
    time_step: float  # distance of the nodes [s]
    sampling_stride: int  # number of steps between nodes at which filtered signals can be sampled
    effort_filter: ZeroPhaseLowPassFilter  # filter of prescribed joints' efforts
    path_filter: ZeroPhaseLowPassFilter  # filter of prescribed joints' motion
    joint_mass_matrices: Callable[[tuple[str, ...], Array], Array]
    has_uncertain_clocks: bool = False  # of point groups, if the settings do not specify it
    # by joint: speed [rad/s or m/s] below which a friction that is estimated can hold it with any torque up to its size
    sticking_speeds: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class SensorData:
    """The measurements of one sensor in one recording, with standard deviations of noise and bias."""

    sensor: Sensor
    t: Array  # shape (M,) [s]
    value: Array  # outputs in the sensor's unit, NaN if missing, (M, k)
    std: Array  # standard deviations of their noise, shape (M, k)
    predictable_nodes: tuple[int, int] | None = None  # first and last node that can be predicted; None: all nodes
    bias_std: Array | None = None  # std of every output's constant error in the recording, shape (k,)
    noise_correlation: Array | None = None  # correlation of the outputs' noise in a sample, (M, k, k)
    change_by_clock: Array | None = None  # change of the outputs by one std of the recording's clock offset, (M, k)
    smoothing_filter: ZeroPhaseLowPassFilter | None = None  # of the values, if their noise is autocorrelated by it


SENSOR_READERS: Registry[Callable[[SensorDataInputs], list[SensorData]]] = Registry("kind of sensor")
"""Functions that return all measurements of one kind of sensor in a recording, by kind."""
