"""A linear model of how unknown forces, grasp offsets and sensor biases change the residual of a recording.

The residual is linearised about the rollout of a fitted model. Every DEL row gets an unknown generalized force, every
grasp an unknown offset, and every output of a point sensor an unknown bias. Every segment gets an unknown push, a force
at one of its points that acts on all joints between this point and the ground. To first order

    x_{k+1} = A_k x_k + E_k d_j,   y_k = C_k x_k + b_j + noise,

where the unknowns d and b are constant over an interval j. States inside an interval are eliminated, so that the cost
of later steps is linear in the number of intervals.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import casadi as ca
import numpy as np
import scipy.linalg
import scipy.sparse

from yid_ocp.arrays import Array, IntArray
from yid_ocp.display import grouped
from yid_ocp.effects.base import arm_joint_names
from yid_ocp.inference.linearized_residual import (
    NominalTrajectory,
    ResidualDerivativesByStateAndEffort,
    nominal_trajectory_from_prediction,
)
from yid_ocp.integrator.compiler import MappedFunction
from yid_ocp.integrator.step import (
    actuated_joint_torques_of_rollout,
    linearized_rollout_steps,
    reachable_and_observable_state_mask,
)
from yid_ocp.model.kinematics import forward_kinematics
from yid_ocp.model.system import System
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.episodes import Episode, mass_matrix_diagonal_at_zero
from yid_ocp.problem.evaluation import Evaluation
from yid_ocp.sensors import Sensor

_UnknownKind = Literal["force", "push", "offset", "bias"]

_CORRELATION_TIME = 0.5  # memory of the unknowns [s]
_MIN_INTERVAL = 0.1  # shortest time over which unknowns are constant [s]
_MAX_INTERVAL_COUNT = 150  # largest number of intervals; longer recordings have longer intervals
# Reference sizes of unknowns: a force over the load at its place, an offset of a grasp [m], a bias over its noise.
_FORCE_STD_OVER_LOAD, _GRASP_OFFSET_STD, _BIAS_STD_OVER_NOISE = 0.1, 2e-3, 3.0
_NEGLIGIBLE_ROW = 1e-4  # of its noise: rows that typical changes of states and unknowns affect less are left out
_FORCE_POINT = "75%"  # point of the push by arc length: a compromise of tip and distributed loads


@dataclass(frozen=True)
class SmoothedUnknownGroup:
    """A group of unknown forces, offsets or biases that have the same location and standard deviation."""

    location: str
    kind: _UnknownKind
    # equivalent to a bias of an effort sensor, as a force at a prescribed joint with measured effort
    is_confounded_with_bias: bool = False


class _LinearizedEpisode(NamedTuple):
    """An episode of a problem and the trajectory about which the smoother linearises it."""

    problem: EstimationProblem
    episode: Episode
    nominal: NominalTrajectory

    @property
    def system(self) -> System:
        return self.problem.system


class _SmootherUnknowns(NamedTuple):
    """Unknowns of a recording, in order: forces on coordinates, offsets of constraints, pushes on segments, biases."""

    names: tuple[str, ...]
    sources: tuple[SmoothedUnknownGroup, ...]
    reference: Array
    forced: IntArray
    grasped: IntArray
    pushed: tuple[str, ...]
    biased: tuple[tuple[int, int], ...]

    @property
    def loading(self) -> int:
        """Number of unknown forces and offsets, which contribute equally to every step."""
        return len(self.forced) + len(self.grasped)

    @property
    def driving(self) -> int:
        """Number of unknowns that move the state: forces, offsets and pushes."""
        return self.loading + 3 * len(self.pushed)


def _smoother_unknowns(course: _LinearizedEpisode) -> _SmootherUnknowns:
    """Unknowns of one recording, with their groups and reference sizes."""
    names, sources, reference, forced = _unknown_forces(course)
    grasped, row = [], 0
    for grasp in course.system.grasps:
        grasped += [row, row + 1, row + 2]
        names += [f"{grasp.name}.{axis}" for axis in "xyz"]
        sources += [SmoothedUnknownGroup(grasp.name, "offset")] * 3
        reference += [_GRASP_OFFSET_STD] * 3
        row += grasp.n_constraint_equations
    pushed = _segment_weights(course.system, course.nominal.theta)
    for segment, weight in pushed.items():
        names += [f"{segment}.push_{axis}" for axis in "xyz"]
        sources += [SmoothedUnknownGroup(segment, "push")] * 3
        reference += [_FORCE_STD_OVER_LOAD * weight] * 3
    biased = []
    for k, samples in enumerate(course.episode.measurements):
        sensor = samples.sensor
        if sensor.effort_joints:
            continue  # at a prescribed joint, bias and force are equivalent
        for column, name in enumerate(sensor.output_names):
            if not np.any(samples.positive_weight_mask[:, column]):
                continue
            frame = sensor.frame_name_per_output[column]
            biased.append((k, column))
            names.append(name)
            sources.append(SmoothedUnknownGroup(sensor_bias_location_name(course.system, sensor, frame), "bias"))
            reference.append(_BIAS_STD_OVER_NOISE * float(np.nanmedian(samples.std[:, column])))
    held, biases = np.array(grasped, int), tuple(biased)
    return _SmootherUnknowns(tuple(names), tuple(sources), np.array(reference), forced, held, tuple(pushed), biases)


def _unknown_forces(course: _LinearizedEpisode) -> tuple[list[str], list[SmoothedUnknownGroup], list[float], IntArray]:
    """Names, sources, reference sizes and coordinates of the unknown forces."""
    system, joint_names = course.system, course.system.mechanism.joint_names
    place = {joint: s.name for s in system.segment_layouts for link in s.link_joints for joint in link}
    place |= {joint: joint for joint in arm_joint_names(system)}
    measured = {joint for samples in course.episode.measurements for joint in samples.sensor.effort_joints}
    silent = {joint_names[i] for i in course.system.prescribed_coordinate_indices} - measured
    names = [n for n in joint_names if n in place and n not in silent and n not in system.joint_compliances]
    forced = np.array([joint_names.index(name) for name in names], int)
    load = _loads(course)
    of_place = grouped((place[name], load[index]) for name, index in zip(names, forced, strict=True))
    largest = max((max(v) for v in of_place.values()), default=1.0)
    rms = {p: max(float(np.sqrt(np.mean(np.square(v)))), 1e-2 * largest) for p, v in of_place.items()}
    sources = [SmoothedUnknownGroup(place[name], "force", name in measured) for name in names]
    return names, sources, [_FORCE_STD_OVER_LOAD * rms[place[name]] for name in names], forced


def sensor_bias_location_name(system: System, sensor: Sensor, frame: str) -> str:
    """Return the location of a sensor's bias: `camera`, `wrist:FRAME`, the frame's grasp, or the sensor's group."""
    held = (grasp.name for grasp in system.grasps if frame in (grasp.held_frame, grasp.holder_frame))
    return sensor.bias_location_name_for_frame(frame) or next(held, sensor.group_name)


def _loads(course: _LinearizedEpisode) -> Array:
    """Root mean square load of every coordinate, from its spring, motor or prescribed effort, (n,) [N m or N]."""
    system, rollout = course.system, course.nominal.rollout
    load, q = np.zeros(system.n_coordinates), rollout.state[:, : system.n_coordinates]
    springs = [(system.mechanism.joint_index(s.joint_name), s) for s in system.elastic_joints]
    if springs:
        symbols = ca.vertcat(*(ca.vertcat(s.stiffness, s.rest_angle) for _, s in springs))
        values = np.array(ca.Function("springs", [system.parameters.symbols], [symbols])(course.nominal.theta)).ravel()
        for (index, _), stiffness, rest in zip(springs, values[::2], values[1::2], strict=True):
            load[index] = stiffness * float(np.sqrt(np.mean((q[:, index] - rest) ** 2)))
    torque = actuated_joint_torques_of_rollout(course.problem.step, course.nominal.theta, rollout)
    for indices, force in (
        (system.actuated_coordinate_indices, torque),
        (system.prescribed_coordinate_indices, rollout.effort),
    ):
        if len(indices):
            load[list(indices)] = np.sqrt(np.mean(force**2, axis=0))
    return load


def _segment_weights(system: System, theta: Array) -> dict[str, float]:
    tree, masses = system.mechanism, {}
    for segment in system.segment_layouts:
        joints = [tree.joint(name) for link in segment.link_joints for name in link]
        if tree.has_frame(f"{segment.name}:{_FORCE_POINT}"):
            masses[segment.name] = sum((body.mass for joint in joints for body in joint.bodies), ca.SX(0))
    if not masses:
        return {}
    total = ca.norm_2(ca.SX(system.gravity)) * ca.vertcat(*masses.values())
    found = np.array(ca.Function("weights", [system.parameters.symbols], [total])(theta)).ravel()
    return {name: float(weight) for name, weight in zip(masses, found, strict=True) if weight > 0}


def _generalized_forces_per_newton(system: System, theta: Array, q: Array, segments: Sequence[str]) -> Array:
    if not segments:
        return np.zeros((*q.shape, 0))
    symbol = ca.SX.sym("q", system.n_coordinates)
    moved = forward_kinematics(system.mechanism, symbol)
    jacobian = ca.vertcat(*(moved.position_jacobian(f"{segment}:{_FORCE_POINT}") for segment in segments))
    function = ca.Function("pushed", [symbol, system.parameters.symbols], [ca.densify(jacobian.T)])
    return MappedFunction(function, shared_inputs=(1,), use_compiler=False)(q, theta)[0]


@dataclass(frozen=True)
class _IntervalModel:
    """Linear model of one interval: residual, transition of the state from start to end, and input of the unknowns."""

    # whitened residual, then its derivative by the free parameters, both with the opposite sign, shape (r, 1 + ntheta)
    negative_residual_jacobian: Array
    state_jacobian: Array  # shape (r, ns)
    unknown_jacobian: Array  # shape (r, nd)
    state_transition: Array  # shape (ns, ns)
    unknown_input_matrix: Array  # shape (ns, nd)
    unreachable_products: Array  # products of residual parts that no state or unknown affects, (1 + ntheta, 1 + ntheta)
    sample_count: int  # before rows were compressed


@dataclass(frozen=True)
class ResidualStateSpaceModel:
    """A linear state-space model of one recording's residual, with one set of matrices for each time interval."""

    recording: str
    intervals: tuple[_IntervalModel, ...]
    interval_edges: Array  # beginnings of the intervals and the end, shape (J + 1,) [s]
    unknown_names: tuple[str, ...]  # coordinate, grasp or channel of each unknown
    unknown_groups: tuple[SmoothedUnknownGroup, ...]
    reference_std: Array  # shape (nd,): the matrices are by unknowns in this unit
    initial_state_jacobian: Array  # first state by the unknowns of the first interval, shape (ns, nd)
    initial_state_std: Array  # remaining error of the first state, shape (ns,)
    interval_correlation: float  # correlation of an unknown with its value one interval later
    torque_noise_variance: Array  # added to the group's variance, shape (nd,) [squared reference]


def residual_models_with_smoother_unknowns(
    problem: EstimationProblem, x: Array, evaluation: Evaluation, interval: float = _MIN_INTERVAL
) -> tuple[ResidualStateSpaceModel, ...]:
    """Linearize every recording's residual with respect to unknown forces, offsets and biases.

    `evaluation` is the evaluation at the unknowns `x`, with a Jacobian. The unknown forces, offsets and biases are
    constant over intervals of at least `interval` [s].
    """
    assert evaluation.jacobian is not None
    columns = -np.column_stack([evaluation.residual, evaluation.jacobian * problem.unknown_scales])
    found = []
    for i, (episode, result) in enumerate(zip(problem.episodes, evaluation.episode_predictions, strict=True)):
        groups = problem.residual_rows.measurements[i]
        observed = columns[groups[0].start : groups[-1].stop]
        theta, _ = problem.unpack_episode_unknowns(x, i)
        nominal = nominal_trajectory_from_prediction(problem.predictor, episode, result, theta)
        pairs = zip(episode.measurements, result.predicted_outputs, strict=True)
        blocks = [samples.residual_and_jacobian(y, threshold=problem.options.huber_threshold) for samples, y in pairs]
        course = _LinearizedEpisode(problem, episode, nominal)
        found.append(_recording(course, np.concatenate([block.robust_factor for block in blocks]), observed, interval))
    prior = columns[problem.residual_rows.stated_priors]
    # stated priors of the free parameters are observations on which no unknown acts
    first, *later = found[0].intervals
    first = replace(first, unreachable_products=first.unreachable_products + prior.T @ prior)
    return (replace(found[0], intervals=(first, *later)), *found[1:])


def _loads_of(course: _LinearizedEpisode, unknowns: _SmootherUnknowns) -> tuple[Array, Array]:
    """Contributions of unknown forces and grasp offsets of reference size to every step's equations and momentum."""
    step = course.problem.step
    n, nz, m = (step.sizes[key] for key in ("n", "nz", "m"))
    forces, loading = len(unknowns.forced), unknowns.loading
    rows, momentum = np.zeros((n + nz + m, loading)), np.zeros((n, loading))
    # an unknown force is constant over the step and split between both equations like any other force
    first_share = 1.0 if step.force_split == "left" else 0.5
    impulse = step.time_step * unknowns.reference[:forces]
    rows[unknowns.forced, np.arange(forces)] = first_share * impulse
    momentum[unknowns.forced, np.arange(forces)] = (1 - first_share) * impulse
    rows[n + nz + unknowns.grasped, np.arange(forces, loading)] = unknowns.reference[forces:loading]
    return rows, momentum


def _steps(
    course: _LinearizedEpisode,
    loads: tuple[Array, Array],
    pushes: Array,
    moving: IntArray,
    span: slice,
    with_forces: bool,
) -> tuple[Array, Array, Array]:
    """A_k (steps, ns, ns), E_k (steps, ns, nd') and derivatives of efforts (and forces) (steps, nc, ns + nd')."""
    a, e, effort, done = [], [], [], span.start
    feedback, nominal, step = course.episode.tracking_feedback, course.nominal, course.problem.step
    nx, width, forces = step.sizes["nx"], loads[1].shape[1], pushes.shape[1]
    inputs = np.zeros((len(pushes), step.sizes["nu"], width))
    if feedback is not None:
        # the momentum of the measured motion contains half the impulse of an unknown force, taken from this step
        inputs = feedback.gain @ np.vstack([0 * loads[1], loads[1]])[feedback.state_indices]
    for pair in linearized_rollout_steps(step, nominal.theta, nominal.rollout, inputs, feedback, loads, span):
        push, done = pushes[done : done + len(pair[0])], done + len(pair[0])
        by_state = (one[:, :, moving] for one in pair)
        by_load = [one[:, :, nx : nx + width] + one[:, :, nx + width :] for one in pair]
        by_load = [np.concatenate([one, one[:, :, :forces] @ push], axis=2) for one in by_load]
        state, own = (np.concatenate(both, axis=2) for both in zip(by_state, by_load, strict=True))
        a.append(state[:, moving, : len(moving)])
        e.append(state[:, moving, len(moving) :])
        effort.append(own if with_forces else own[:, : step.sizes["nc"]])
    return np.concatenate(a), np.concatenate(e), np.concatenate(effort)


def _recording(course: _LinearizedEpisode, factor: Array, observed: Array, shortest: float) -> ResidualStateSpaceModel:
    """Linear model of one recording from its whitened residuals and their derivatives."""
    h, steps = course.problem.step.time_step, course.episode.grid.steps
    length = int(max(round(shortest / h), math.ceil(steps * _MIN_INTERVAL / (_MAX_INTERVAL_COUNT * shortest)), 1))
    edges = np.unique(np.append(np.arange(0, steps, length), steps))
    unknowns = _smoother_unknowns(course)
    loads, forces = _loads_of(course, unknowns), len(unknowns.forced)
    nodes = course.nominal.rollout.state[:, : course.system.n_coordinates]
    pushes = _generalized_forces_per_newton(course.system, course.nominal.theta, nodes, unknowns.pushed)
    pushes = pushes[:, unknowns.forced]
    pushes *= unknowns.reference[unknowns.loading : unknowns.driving] / unknowns.reference[:forces, None]
    about = course.problem.step, course.nominal.theta, course.nominal.rollout
    moving = np.flatnonzero(reachable_and_observable_state_mask(*about, loads))
    slopes = ResidualDerivativesByStateAndEffort.from_nominal_trajectory(course.nominal, with_neighbours=True)
    slopes = slopes.select_states(moving)
    beyond = len(slopes.by_state) - 2  # steps that samples at an interval's end depend on
    by_bias = _bias_slopes(course, unknowns)
    interval_of_row = np.clip(np.searchsorted(edges, slopes.node, side="right") - 1, 0, len(edges) - 2)
    rests = course.problem.options.initial_state != "fitted_to_points"
    ns, driving = len(moving), unknowns.driving
    at_rest = np.zeros((ns, len(unknowns.names)))
    start_std = np.zeros(ns) if rests else _loose_start(course)[moving]
    intervals = []
    for j in range(len(edges) - 1):
        span_of_steps = slice(int(edges[j]), min(int(edges[j + 1]) + beyond, steps))
        made = _steps(course, loads, pushes, moving, span_of_steps, beyond > 0)
        if j == 0 and rests:
            # equilibrium under constant unknowns, x = A x + E d; coordinates without stiffness have none
            at_rest[:, :driving] = np.linalg.lstsq(np.eye(ns) - made[0][0], made[1][0], rcond=1e-6)[0]
        rows = np.flatnonzero(interval_of_row == j)
        own = factor[rows, None] * by_bias[rows]
        span_of_interval = int(edges[j]), int(edges[j + 1] - edges[j])
        state, drive, moved = _interval_response(made, slopes.select_residual_rows(rows), *span_of_interval)
        moved *= factor[rows, None]
        by_unknown = np.hstack([moved[:, ns:], own])
        drive = np.pad(drive, ((0, 0), (0, own.shape[1])))
        # changes of the state that unknowns of reference size cause in one interval, or that the start allows
        typical = np.linalg.norm(np.column_stack([drive, at_rest, start_std]), axis=1)
        intervals.append(_compressed(observed[rows], moved[:, :ns], by_unknown, state, drive, typical))
    span = h * float(np.median(np.diff(edges)))
    decay = math.exp(-span / _CORRELATION_TIME)
    told = h * edges, unknowns.names, unknowns.sources, unknowns.reference
    noise = _torque_noise(course, unknowns, span, decay)
    return ResidualStateSpaceModel(course.episode.name, tuple(intervals), *told, at_rest, start_std, decay, noise)


def _torque_noise(course: _LinearizedEpisode, unknowns: _SmootherUnknowns, span: float, decay: float) -> Array:
    errors, driven = course.episode.input_errors, course.system.driven
    known = np.zeros(len(unknowns.names))
    if errors is None:
        return known
    held = course.problem.step.time_step * len(errors.sample_of_step) / len(np.unique(errors.sample_of_step))
    # equal spectral density at low frequencies as an unknown force of memory `decay`
    white = errors.torque_std**2 * (held / span) * (1 - decay) / (1 + decay)
    for i, name in enumerate(unknowns.names[: len(unknowns.forced)]):
        if name in driven:
            at = driven.index(name)
            known[i] = (white[at] + errors.torque_bias_std[at] ** 2) / unknowns.reference[i] ** 2
    return known


def _loose_start(course: _LinearizedEpisode) -> Array:
    """Standard deviation (nx,) of an initial state that was fitted to points."""
    problem, free = course.problem, np.array(course.system.unprescribed_coordinate_indices, int)
    options, joints = problem.options, course.system.mechanism.joint_names
    inertia = mass_matrix_diagonal_at_zero(problem.step, course.nominal.theta, tuple(joints[i] for i in free))
    loose = np.zeros(problem.step.sizes["nx"])
    loose[free] = options.initial_configuration_prior_std
    loose[course.system.n_coordinates + free] = options.initial_velocity_prior_std * np.abs(inertia)
    return loose


def _interval_response(
    steps: tuple[Array, Array, Array], slopes: ResidualDerivativesByStateAndEffort, first: int, length: int
) -> tuple[Array, Array, Array]:
    """Derivatives of an interval's final state and rows; steps beyond `length` serve rows of the next interval."""
    a, e, by_effort = steps
    count, ns, driving = len(a), a.shape[1], e.shape[2]
    node = np.zeros((count + 1, ns, ns + driving))
    node[0, :, :ns] = np.eye(ns)
    effort = np.zeros((count + 1, by_effort.shape[1], ns + driving))
    for k in range(count):
        node[k + 1] = a[k] @ node[k]
        node[k + 1][:, ns:] += e[k]
        effort[k] = by_effort[k][:, :ns] @ node[k]
        effort[k][:, ns:] += by_effort[k][:, ns:]
    effort[-1] = effort[-2]
    state, drive = np.split(node[length].copy(), [ns], axis=1)
    return state, drive, slopes.directional_residual_derivatives(node, effort, first)


def _bias_slopes(course: _LinearizedEpisode, unknowns: _SmootherUnknowns) -> Array:
    """Derivatives of all rows by the biases, in units of their reference, shape (r, nb)."""
    reference, found = unknowns.reference[unknowns.driving :], []
    group, output = np.array(unknowns.biased, int).reshape(-1, 2).T
    for k, samples in enumerate(course.episode.measurements):
        sample, column = np.nonzero(samples.positive_weight_mask)
        own = reference * ((group == k) & (output == column[:, None]))
        found.append(samples.decorrelate_residual_rows(samples.weight[sample, column][:, None] * own))
    return np.concatenate(found)


def _compressed(
    observed: Array, by_state: Array, by_unknown: Array, transition: Array, drive: Array, typical: Array
) -> _IntervalModel:
    """An interval with only the rows that states or unknowns affect; the others only add to the products."""
    joined, count = np.hstack([by_state, by_unknown]), len(observed)
    rest = np.zeros((observed.shape[1], observed.shape[1]))
    if len(joined):
        sizes = np.append(typical, np.ones(by_unknown.shape[1]))
        q, r, _ = scipy.linalg.qr(joined * sizes, mode="economic", pivoting=True, check_finite=False)
        q = q[:, np.abs(np.diag(r)) > _NEGLIGIBLE_ROW]
        turned = q.T @ observed
        rest = observed.T @ observed - turned.T @ turned
        observed, joined = turned, q.T @ joined
    ns = by_state.shape[1]
    return _IntervalModel(observed, joined[:, :ns], joined[:, ns:], transition, drive, rest, count)
