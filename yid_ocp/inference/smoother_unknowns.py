"""Unknowns of the smoother: which forces, pushes, grasp offsets and sensor biases there may be, and how large.

Every DEL row gets an unknown generalized force (a torque between neighbours), every segment an unknown push (a force in
the world on a point of it, felt by every joint between it and the ground), every grasp an unknown offset and every
output of a point sensor an unknown bias.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import casadi as ca
import numpy as np
from annotated_types import Ge, Gt, Le
from numpy.typing import NDArray

from yid_ocp.effects.base import grasp_names, robot_joints
from yid_ocp.inference.residual_slopes import NominalTrajectory
from yid_ocp.integrator.rollout import applied_joint_torque
from yid_ocp.model.kinematics import forward_kinematics
from yid_ocp.model.system import System
from yid_ocp.options import OptionInfo
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.episodes import Episode
from yid_ocp.sensors import Sensor

Array = NDArray[np.float64]
_UnknownKind = Literal["force", "push", "offset", "bias"]

_FORCE_POINT = "75%"
"""Where a segment is pushed, by arc length: what acts on its tip and what acts all along it are both near that."""


@dataclass(frozen=True)
class SmootherThresholds:
    """How large unknowns may be, and what counts as evidence for a group of them.

    Attributes
    ----------
    min_log_bayes_factor : float
        Smallest log Bayes factor for adding a group of unknowns; 5 means odds of 150 to 1.
    max_unknown_groups : int
        Maximum number of groups of unknowns.
    detectable_chi2 : float
        Rise of r'r at which unknowns of the reference size below are detectable.
    force_prior_std : float
        Prior standard deviation of an unknown force, relative to the load at its location.
    grasp_offset_prior_std : float
        Prior standard deviation of a grasp's unknown offset [m].
    bias_prior_std : float
        Prior standard deviation of a sensor's unknown bias, relative to its noise.
    location_tie : float
        Fraction of a location's log evidence that another must reach to be indistinguishable from it.
    """

    min_log_bayes_factor: Annotated[
        float, Gt(0), OptionInfo("rise of the log evidence that a group of unknowns must bring")
    ] = 5.0
    max_unknown_groups: Annotated[int, Ge(1), OptionInfo("groups of unknowns taken in at most")] = 4
    detectable_chi2: Annotated[float, Gt(0), OptionInfo("rise of r'r by which unknowns would be noticed")] = 10.0
    force_prior_std: Annotated[float, Gt(0), OptionInfo("unknown force over the load that its place carries")] = 0.1
    grasp_offset_prior_std: Annotated[float, Gt(0), OptionInfo("unknown offset of a grasp", "m")] = 2e-3
    bias_prior_std: Annotated[float, Gt(0), OptionInfo("unknown bias over the noise of its sensor")] = 3.0
    location_tie: Annotated[
        float, Gt(0), Le(1), OptionInfo("part of a place's evidence at which another is named beside it")
    ] = 0.9


DEFAULT_SMOOTHER_THRESHOLDS = SmootherThresholds()
"""Default thresholds of the smoother."""


@dataclass(frozen=True)
class UnknownGroup:
    """Group of unknowns that share a location and a standard deviation.

    Attributes
    ----------
    is_confounded_with_bias : bool
        Whether a bias of an effort sensor would be the same: a force at a prescribed joint whose effort is measured.
    """

    location: str
    kind: _UnknownKind
    is_confounded_with_bias: bool = False


@dataclass(frozen=True)
class LinearizedEpisode:
    """An episode of a problem and the trajectory about which the smoother's model of it is linear."""

    problem: EstimationProblem
    episode: Episode
    nominal: NominalTrajectory

    @property
    def system(self) -> System:
        """The problem's system."""
        return self.problem.system


@dataclass(frozen=True)
class SmootherUnknowns:
    """What gets an unknown, and how large it may be.

    Attributes
    ----------
    names : tuple of str, length nd
        Coordinate, grasp, segment or channel, and axis: first forces, then offsets, pushes and biases.
    reference : ndarray, shape (nd,)
    forced : ndarray of int
        Coordinates with an unknown force.
    grasped : ndarray of int
        Constraint rows with an unknown offset.
    pushed : tuple of str
        Segments with an unknown push.
    biased : tuple of (int, int)
        Group of samples and column with an unknown bias.
    """

    names: tuple[str, ...]
    sources: tuple[UnknownGroup, ...]
    reference: Array
    forced: NDArray[np.int64]
    grasped: NDArray[np.int64]
    pushed: tuple[str, ...]
    biased: tuple[tuple[int, int], ...]

    @property
    def loading(self) -> int:
        """How many of them add the same to every step."""
        return len(self.forced) + len(self.grasped)

    @property
    def driving(self) -> int:
        """How many of them move the state."""
        return self.loading + 3 * len(self.pushed)


def smoother_unknowns(course: LinearizedEpisode, limits: SmootherThresholds) -> SmootherUnknowns:
    """Unknowns of one recording, with their groups and reference sizes."""
    names, sources, reference, forced = _unknown_forces(course, limits.force_prior_std)
    grasped, row = [], 0
    for grasp, name in zip(course.system.grasps, grasp_names(course.system), strict=True):
        grasped += [row, row + 1, row + 2]
        names += [f"{name}.{axis}" for axis in "xyz"]
        sources += [UnknownGroup(name, "offset")] * 3
        reference += [limits.grasp_offset_prior_std] * 3
        row += grasp.n_equations
    pushed = []
    for segment, weight in segment_weights(course.system, course.nominal.theta).items():
        pushed.append(segment)
        names += [f"{segment}.push_{axis}" for axis in "xyz"]
        sources += [UnknownGroup(segment, "push")] * 3
        reference += [limits.force_prior_std * weight] * 3
    biased = []
    for k, samples in enumerate(course.episode.measurements):
        sensor = samples.sensor
        if sensor.effort_joints:
            continue  # at a prescribed joint a bias and a force are the same
        for column, channel in enumerate(samples.channel_of_column):
            if not np.any(samples.is_used[:, column]):
                continue
            axis = f".{'xyz'[column % 3]}" if sensor.outputs_per_channel == 3 else ""
            frame = sensor.frame_names[column // sensor.outputs_per_channel] if sensor.frame_names else ""
            biased.append((k, column))
            names.append(f"{channel}{axis}")
            sources.append(UnknownGroup(sensor_bias_location(course.system, sensor, frame), "bias"))
            reference.append(limits.bias_prior_std * float(np.nanmedian(samples.std[:, column])))
    held = np.array(grasped, int)
    return SmootherUnknowns(
        tuple(names), tuple(sources), np.array(reference), forced, held, tuple(pushed), tuple(biased)
    )


def _unknown_forces(
    course: LinearizedEpisode, part: float
) -> tuple[list[str], list[UnknownGroup], list[float], NDArray[np.int64]]:
    """Names, sources, reference sizes and coordinates of the unknown forces."""
    system, joint_names = course.system, course.system.mechanism.joint_names
    place = {joint: s.name for s in system.segment_layouts for link in s.link_joints for joint in link}
    place |= {joint: joint for joint in robot_joints(system)}
    measured = {joint for samples in course.episode.measurements for joint in samples.sensor.effort_joints}
    silent = {joint_names[i] for i in course.system.prescribed_indices} - measured
    names = [n for n in joint_names if n in place and n not in silent and n not in system.joint_compliances]
    forced = np.array([joint_names.index(name) for name in names], int)
    load = _loads(course)
    of_place: dict[str, list[float]] = {}
    for name, index in zip(names, forced, strict=True):
        of_place.setdefault(place[name], []).append(load[index])
    largest = max((max(v) for v in of_place.values()), default=1.0)
    size = {p: part * max(float(np.sqrt(np.mean(np.square(v)))), 1e-2 * largest) for p, v in of_place.items()}
    sources = [UnknownGroup(place[name], "force", name in measured) for name in names]
    return names, sources, [size[place[name]] for name in names], forced


def sensor_bias_location(system: System, sensor: Sensor, frame: str) -> str:
    """Return the location of a sensor's bias: the camera, the arm that holds the frame, else the sensor's group."""
    if sensor.camera_pose is not None:
        return "camera"
    for grasp in system.grasps:
        if frame in (grasp.held_frame, grasp.holder_frame):
            return grasp.name
    return sensor.group_name


def _loads(course: LinearizedEpisode) -> Array:
    """Typical load of every coordinate: of its spring, its motor or its prescription, shape (n,) [N m or N]."""
    system, rollout = course.system, course.nominal.rollout
    load = np.zeros(system.n_coordinates)
    q = rollout.state[:, : system.n_coordinates]
    springs = [(system.mechanism.joint_index(s.joint_name), s) for s in system.elastic_joints]
    if springs:
        symbols = ca.vertcat(*(ca.vertcat(s.stiffness, s.rest_angle) for _, s in springs))
        values = np.array(ca.Function("springs", [system.parameters.symbols], [symbols])(course.nominal.theta)).ravel()
        for (index, _), stiffness, rest in zip(springs, values[::2], values[1::2], strict=True):
            load[index] = stiffness * float(np.sqrt(np.mean((q[:, index] - rest) ** 2)))
    torque = applied_joint_torque(course.problem.step, course.nominal.theta, rollout)
    for indices, force in ((system.driven_indices, torque), (system.prescribed_indices, rollout.effort)):
        if len(indices):
            load[list(indices)] = np.sqrt(np.mean(force**2, axis=0))
    return load


def segment_weights(system: System, theta: Array) -> dict[str, float]:
    """Return the weight of every segment that has a mass [N].

    Parameters
    ----------
    theta : ndarray, shape (ntheta,)
    """
    tree, masses = system.mechanism, {}
    for segment in system.segment_layouts:
        joints = [tree.joints[tree.joint_index(name)] for link in segment.link_joints for name in link]
        if tree.has_frame(f"{segment.name}:{_FORCE_POINT}"):
            masses[segment.name] = sum((body.mass for joint in joints for body in joint.bodies), ca.SX(0))
    if not masses:
        return {}
    total = ca.norm_2(ca.SX(system.gravity)) * ca.vertcat(*masses.values())
    found = np.array(ca.Function("weights", [system.parameters.symbols], [total])(theta)).ravel()
    return {name: float(weight) for name, weight in zip(masses, found, strict=True) if weight > 0}


def generalized_forces_per_newton(system: System, theta: Array, q: Array, segments: Sequence[str]) -> Array:
    """Return the generalized forces of 1 N along x, y and z on each of some segments.

    Parameters
    ----------
    theta : ndarray, shape (ntheta,)
    q : ndarray, shape (N, n)
        Configurations.

    Returns
    -------
    ndarray, shape (N, n, 3 ns)
        [N m/N or 1].
    """
    if not segments:
        return np.zeros((*q.shape, 0))
    symbol = ca.SX.sym("q", system.n_coordinates)
    moved = forward_kinematics(system.mechanism, symbol)
    jacobian = ca.vertcat(*(moved.position_jacobian(f"{segment}:{_FORCE_POINT}") for segment in segments))
    function = ca.Function("pushed", [symbol, system.parameters.symbols], [ca.densify(jacobian.T)])
    found = np.array(function.map(len(q))(q.T, np.tile(theta[:, None], len(q))))
    return found.reshape(system.n_coordinates, len(q), 3 * len(segments)).transpose(1, 0, 2)
