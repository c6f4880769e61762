"""Fisher information that a recorded experiment would give if its grasps, arms, motions or sensors were changed."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import casadi as ca
import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike

from yid_ocp.analysis.identifiability import InitialStateKnowledge, with_free_starts_and_grasps
from yid_ocp.analysis.point_checks import point_frame_names
from yid_ocp.analysis.torque_error_propagation import point_jacobians_and_joint_information
from yid_ocp.arrays import Array
from yid_ocp.data.recording import JointGroup, PointGroup, Recording
from yid_ocp.display import NULL_PROGRESS, Progress
from yid_ocp.effects.base import frame_positions
from yid_ocp.errors import DataError, SolverError, YidError, failed_rollout_error
from yid_ocp.inference.whitening import problem_with_whitening_at
from yid_ocp.integrator.step import Step, compile_step_like
from yid_ocp.model.mechanism import Frame, Placement
from yid_ocp.model.system import System
from yid_ocp.problem import EstimationProblem, SensorOptions
from yid_ocp.problem.episodes import Episode
from yid_ocp.problem.measurements import TimeGrid
from yid_ocp.sensors import camera_pose_of_point_group
from yid_ocp.sensors.base import missing_noise_level_error
from yid_ocp.sensors.joints import JOINT_EFFORT_SENSOR_KEY, JOINT_POSITION_GROUP_NAME, is_point_group_measured_by_arm
from yid_ocp.virtual.joint_motion import MultisineOptions, grasping_joint_angles, random_multisine_motion
from yid_ocp.virtual.mujoco_simulation import SimulationOptions, simulate_in_mujoco

CAMERA_GROUP, ARM_GROUP = "points_camera", "points_arm"
_MARKER_AXIS_DISTANCE = 0.03  # distance of a marker from the axis [m]
_DEFAULT_CAMERA_STD, _DEFAULT_CAMERA_RATE = 5e-3, 3.0  # of a hypothetical camera [m], [Hz]
_DEFAULT_ARM_POINT_STD = 1e-3  # of hypothetical points measured by an arm [m]
ASSUMED_TORQUE_NOISE_STD = 0.1  # noise of joint torques for which none is stated [N m]
_MOTION_SEED = 11  # of alternative motions
# Offsets of two grippers towards each other and away from the robot: a fully stretched branched tube snaps through [m].
_INWARD_GRIPPER_OFFSET, _FORWARD_GRIPPER_OFFSET = 0.05, 0.08


@dataclass(frozen=True)
class SinglePointObservationSchedule:
    """The sample times and noise standard deviations with which one point of a group is measured."""

    point_group: str
    frame: str
    times: Array  # since the recording's start, shape (M,) [s]
    std: Array  # shape (M, 3) [m]


@dataclass(frozen=True)
class UnchangedExperiment:
    """A recorded experiment before any change: its problem, unknowns, and knowledge of initial states and grasps."""

    problem: EstimationProblem
    x: Array  # unknowns at which the information is evaluated, shape (nx,)
    initial_state_knowledge: InitialStateKnowledge = "assumed"
    grasp_offset_prior_std: float | None = None
    two_arm_system: System | None = None  # system with a second arm and its grasp

    @property
    def parameter_values(self) -> dict[str, float]:
        """The values of all model parameters by name, at the unknowns `x`."""
        theta, _ = self.problem.unpack_episode_unknowns(self.x, 0)
        return dict(zip(self.problem.system.parameters.names, map(float, theta), strict=True))

    def camera_points_times_and_median_std(self, episode: Episode) -> tuple[PointGroup | None, Array, float]:
        """Return the points that a camera sees, with times [s] and median noise [m]. Without any: None and defaults."""
        times = uniform_sample_times(episode.grid, _DEFAULT_CAMERA_RATE)
        return self._sampling(episode, lambda g: camera_pose_of_point_group(g) is not None, times, _DEFAULT_CAMERA_STD)

    def arm_point_group_times_and_std(self, episode: Episode) -> tuple[PointGroup | None, Array, float]:
        """Return the points that arms measure, with times [s] and median noise [m]. Without any: None and defaults."""
        t = episode.grid.node_times - episode.grid.start_time
        return self._sampling(episode, lambda g: "arm" in g.name or g.sensor_name == "arm", t, _DEFAULT_ARM_POINT_STD)

    def _sampling(
        self, episode: Episode, fits: Callable[[PointGroup], bool], times: Array, std: float
    ) -> tuple[PointGroup | None, Array, float]:
        for group in filter(fits, _used_point_groups(self.problem, episode)):
            return group, group.t - episode.grid.start_time, float(np.nanmedian(self._std(group)))
        return None, times, std

    def existing_point_observation_schedules(self, episode: Episode) -> list[SinglePointObservationSchedule]:
        """Return the sample times and noise standard deviations of every point that is measured in a recording."""
        found = []
        for group in _used_point_groups(self.problem, episode):
            std, t = self._std(group), group.t - episode.grid.start_time
            choice = self.problem.options.sensors.get(group.name, SensorOptions())
            for point, frame in point_frame_names(self.problem.system, group, choice).items():
                at = group.names.index(point)
                seen = np.all(np.isfinite(group.position[:, at]), axis=1)
                found.append(SinglePointObservationSchedule(group.name, frame, t[seen], std[seen, at]))
        return found

    def _std(self, group: PointGroup) -> Array:
        said = self.problem.options.sensors.get(group.name, SensorOptions()).std
        if isinstance(said, float):
            return np.full(group.position.shape, said)
        if group.std is None:
            raise missing_noise_level_error(f"group '{group.name}'", f"sensors.{group.name}.std", group.name, "m")
        return group.std


def _used_point_groups(problem: EstimationProblem, episode: Episode) -> list[PointGroup]:
    sensors = problem.options.sensors
    return [g for g in episode.recording.points if sensors.get(g.name, SensorOptions()).use is not False]


def uniform_sample_times(grid: TimeGrid, rate: float) -> Array:
    """Return evenly spaced sample times [s] at `rate` [Hz], from zero to the end of a recording's grid."""
    return np.arange(0.0, grid.steps * grid.time_step + 1e-9, 1.0 / rate)


class _MeasurablePoint(NamedTuple):
    """A point that a camera (or also an arm) could measure. `added_frame` is its frame if the mechanism lacks one."""

    name: str
    description: str
    is_arm_measurable: bool
    added_frame: Frame | None = None


def measurable_points(system: System) -> list[_MeasurablePoint]:
    """List the points that could be measured: on segments or, without segments, on moving frames and spring joints."""
    tree, off_axis = system.mechanism, f"a marker {100 * _MARKER_AXIS_DISTANCE:g} cm off the axis"
    held = {grasp.held_frame for grasp in system.grasps}
    found: list[_MeasurablePoint] = []
    for segment in system.segment_layouts:
        name, count, tip = segment.name, len(segment.link_joints), f"w_{segment.name}"
        found.append(_MeasurablePoint(tip, f"the end of {name}", False))
        if count > 1:
            found.append(_MeasurablePoint(f"{name}_{(count - 1) // 2}_tip", f"the middle of {name}", False))
        beside = _displaced(tree.frame(tip), (_MARKER_AXIS_DISTANCE, 0.0, 0.0))
        found.append(_MeasurablePoint(f"{name}_marker", f"{off_axis} at the end of {name}", tip in held, beside))
    if system.segment_layouts:
        return found
    frames = [name for name, frame in tree.frames.items() if frame.joint_index >= 0]
    found = [_MeasurablePoint(name, f"the point '{name}'", False) for name in frames]
    for spring in system.elastic_joints:
        index, name = tree.joint_index(spring.joint_name), spring.joint_name
        if tree.joints[index].kind == "revolute":
            axis = np.array(tree.joints[index].axis)
            across = np.eye(3)[int(np.argmin(np.abs(axis)))]
            across -= axis * float(across @ axis)
            across *= _MARKER_AXIS_DISTANCE / float(np.linalg.norm(across))
            frame = _displaced(Frame(index, Placement.identity()), across)
            found.append(_MeasurablePoint(f"{name}_marker", f"{off_axis} of {name}", False, frame))
    return found


def _displaced(frame: Frame, offset: ArrayLike) -> Frame:
    shift = Placement(ca.SX(ca.DM.eye(3)), ca.SX(ca.DM(np.asarray(offset, float))))
    return Frame(frame.joint_index, frame.placement @ shift)


def step_and_measurable_points_with_frames(step: Step) -> tuple[Step, list[_MeasurablePoint]]:
    """Return the step with a frame at each measurable point, and these points. The equations do not change."""
    mechanism, seen = step.system.mechanism, measurable_points(step.system)
    added = {sight.name: sight.added_frame for sight in seen if sight.added_frame is not None}
    system = replace(step.system, mechanism=replace(mechanism, frames={**mechanism.frames, **added}))
    return replace(step, model=replace(step.model, system=system)), seen


@dataclass
class VariantPositionSensitivities:
    """The derivatives of the positions of all measurable points in one variant of an experiment.

    `position_sensitivities` holds, by (episode, group, frame), the derivatives of the frame's position at every node
    with respect to nx unknowns and q unknowns of torque and encoder errors (`point_jacobians_and_joint_information`).
    """

    problem: EstimationProblem  # with nuisance unknowns; every measurable frame is observed at every node
    x: Array
    free_parameters: tuple[str, ...]
    position_sensitivities: Mapping[tuple[int, str, str], Array]  # shape (N + 1, 3, nx + q)
    prior_information: Array  # prior of nuisances, shape (nx, nx)
    # by episode: information (nx + q, nx + q) of measured torques or angles, and of the prior of torque errors
    joint_information: Mapping[int, Array] = field(default_factory=dict)
    feasibility_notes: tuple[str, ...] = ()  # obstacles on a real robot, such as joint limits
    _known: dict[tuple[int, str, str, bytes, bytes], Array] = field(default_factory=dict, repr=False)

    def fisher_information_with_prior(self, views: Sequence[Sequence[SinglePointObservationSchedule]]) -> Array:
        """Return the Fisher information (nx, nx) of observations (`views`, one list per recording) and prior."""
        total = self.prior_information.copy()
        nx = len(total)
        for i, episode in enumerate(self.problem.episodes):
            seen = [self._of(i, episode.grid, view) for view in views[i % len(views)]]
            if i in self.joint_information:
                seen.append(self.joint_information[i])
            own = sum(seen, np.zeros_like(seen[0]) if seen else np.zeros((nx, nx)))
            total += own[:nx, :nx]
            if len(own) > nx:
                total -= own[:nx, nx:] @ scipy.linalg.solve(own[nx:, nx:], own[nx:, :nx], assume_a="pos")
        return total

    def _of(self, episode: int, grid: TimeGrid, view: SinglePointObservationSchedule) -> Array:
        key = (episode, view.point_group, view.frame, view.times.tobytes(), view.std.tobytes())
        if key not in self._known:
            inside = (view.times >= -1e-9) & (view.times <= grid.steps * grid.time_step + 1e-9)
            node, fraction = grid.preceding_node_and_fraction(grid.start_time + view.times[inside])
            slopes = self.position_sensitivities[episode, view.point_group, view.frame]
            rows = slopes[node] + fraction[:, None, None] * (slopes[np.minimum(node + 1, grid.steps)] - slopes[node])
            rows = (rows / view.std[inside][:, :, None]).reshape(-1, rows.shape[2])
            self._known[key] = rows.T @ rows
        return self._known[key]


SETUP_CHANGE_DESCRIPTIONS: Mapping[str, str] = {
    "weld": "weld grasps in place of point grasps",
    "second_arm": "a second arm",
    "motion": "another motion",
    "travel": "another motion of twice the travel",
    "torque": "joint torques as measurements, with the arms moved as measured",
}


class ExperimentVariantSensitivityBuilder:
    """Computes and keeps the sensitivities for variants of an experiment, such as a second arm or another motion."""

    def __init__(self, setting: UnchangedExperiment, progress: Progress = NULL_PROGRESS) -> None:
        self.setting = setting
        self._progress = progress
        self._layouts: dict[frozenset[str], VariantPositionSensitivities | str] = {}

    def position_sensitivities_of_variant(self, setup_changes: frozenset[str]) -> VariantPositionSensitivities | str:
        """Return the sensitivities for the experiment with the given changes, or the reason of a failure as text."""
        if setup_changes not in self._layouts:
            if setup_changes:
                words = " and ".join(SETUP_CHANGE_DESCRIPTIONS[name] for name in sorted(setup_changes))
                self._progress.begin_stage(f"simulating with {words}")
            try:
                self._layouts[setup_changes] = self._build(setup_changes)
            except YidError as error:
                self._layouts[setup_changes] = error.what + f". To try it, {error.hint}" * bool(error.hint)
        return self._layouts[setup_changes]

    def applicable_setup_changes(self) -> list[str]:
        """List the keys of `SETUP_CHANGE_DESCRIPTIONS` whose change is possible for this experiment."""
        setting, system, episodes = self.setting, self.setting.problem.system, self.setting.problem.episodes
        moves = bool(system.driven) and not system.servos
        measured = any(s.sensor.effort_joints for e in episodes for s in e.measurements)
        robot = (system.driven or system.prescribed) and episodes[0].recording.joints
        loose, second = any(grasp.kind != "weld" for grasp in system.grasps), setting.two_arm_system is not None
        applies = {"weld": loose, "second_arm": second, "motion": moves, "travel": moves}
        return [name for name, does in (applies | {"torque": bool(robot) and not measured}).items() if does]

    def _build(self, setup_changes: frozenset[str]) -> VariantPositionSensitivities:
        setting, base = self.setting, self.setting.problem
        system, recordings, notes = self._experiment(setup_changes)
        if "torque" in setup_changes:
            system = replace(system, driven=(), servos={}, prescribed=(*system.prescribed, *system.driven))
        other = setup_changes - {"motion", "travel"} or system is not base.system
        step = compile_step_like(base.step, system, use_compiler=False) if other else base.step
        step, seen = step_and_measurable_points_with_frames(step)
        wide = with_free_starts_and_grasps(base, setting.initial_state_knowledge, setting.grasp_offset_prior_std)
        plain = replace(wide.options, huber_threshold=math.inf, weak_prior_geometric_std=0.0, weighting="whitened")
        options = replace(plain, sensors=self._joint_sensors(setup_changes), duration=None)
        dense = [self._dense(entry, i, seen, "torque" in setup_changes) for i, entry in enumerate(recordings)]
        values = {name: v for name, v in setting.parameter_values.items() if name in step.system.parameters}
        nuisances = [name for name in wide.free if name not in base.free]
        problem = EstimationProblem(step, dense, (*base.free, *nuisances), options, values)
        x = problem.pack_unknowns(dict(zip(base.unknown_names, setting.x, strict=True)))
        evaluation = problem.evaluate(x)
        if not evaluation.ok or evaluation.jacobian is None:
            raise failed_rollout_error(evaluation.message, f"the experiment with {[*setup_changes] or 'no change'}")
        slopes, by_joints = dict[tuple[int, str, str], Array](), dict[int, Array]()
        encoders = self._with_encoders(problem)
        for i in range(len(problem.episodes)):
            finest = self._finest(base.episodes[i % len(base.episodes)])
            points, by_joints[i] = point_jacobians_and_joint_information(problem, evaluation, x, i, finest, encoders)
            slopes |= {(i, *key): value for key, value in points.items()}
        names = tuple(name for name in problem.unknown_names if name.split("[")[0] in base.free)
        stated = evaluation.jacobian[problem.residual_rows.stated_priors].copy()
        # priors of the parameters are excluded: the result is the information of the sensors
        stated[:, [problem.unknown_names.index(name) for name in names]] = 0.0
        return VariantPositionSensitivities(problem, x, names, slopes, stated.T @ stated, by_joints, tuple(notes))

    def _joint_sensors(self, setup_changes: frozenset[str]) -> dict[str, SensorOptions]:
        given = self.setting.problem.options.sensors
        sensors = {name: replace(choice, use=None) for name, choice in given.items() if name.startswith("joints.")}
        if "second_arm" in setup_changes:
            # simulated motions state their noise, also for joints that the settings do not contain
            sensors = {name: replace(choice, std=None, bias_std=None) for name, choice in sensors.items()}
        if "torque" in setup_changes:
            joints = self.setting.problem.episodes[0].recording.joints
            said = None if joints is None else joints.effort_std
            stated = said is not None and bool(np.all(np.asarray(said) > 0))
            sensors[JOINT_EFFORT_SENSOR_KEY] = SensorOptions(std=None if stated else ASSUMED_TORQUE_NOISE_STD)
        return sensors

    def _finest(self, episode: Episode) -> dict[str, float]:
        """Return the smallest noise standard deviation [m] of the points of each group in a recording."""
        finest = {}
        samplings = self.setting.camera_points_times_and_median_std, self.setting.arm_point_group_times_and_std
        for default, sampling in zip((CAMERA_GROUP, ARM_GROUP), samplings, strict=True):
            group, _, std = sampling(episode)
            finest[default if group is None else group.name] = std
        for view in self.setting.existing_point_observation_schedules(episode):
            finest[view.point_group] = min(finest.get(view.point_group, math.inf), float(view.std.min()))
        return finest

    def _with_encoders(self, problem: EstimationProblem) -> EstimationProblem | None:
        """Return the problem with encoder readings of driven joints, or None if the recorded experiment has none."""
        base = self.setting.problem
        used = any(samples.sensor.position_joints for e in base.episodes for samples in e.measurements)
        if not used or not problem.system.driven:
            return None
        sensors = dict(problem.options.sensors)
        sensors[JOINT_POSITION_GROUP_NAME] = replace(sensors.get(JOINT_POSITION_GROUP_NAME, SensorOptions()), use=True)
        recordings = []
        for recording in (episode.recording for episode in problem.episodes):
            seen = tuple(group for group in recording.points if not is_point_group_measured_by_arm(group))
            recordings.append(replace(recording, points=seen))
        values = dict(zip(problem.system.parameters.names, map(float, problem.theta), strict=True))
        options = replace(problem.options, sensors=sensors)
        return EstimationProblem(problem.step, recordings, problem.free, options, values)

    def _experiment(self, setup_changes: frozenset[str]) -> tuple[System, list[Recording], list[str]]:
        """Return system, recordings and notes on feasibility of the changed experiment."""
        base = self.setting.problem
        system = base.system
        if "second_arm" in setup_changes:
            assert self.setting.two_arm_system is not None
            system = self.setting.two_arm_system
        if "weld" in setup_changes:
            system = self._welded(system, setup_changes - {"weld", "torque", "motion", "travel"})
        if not setup_changes & {"motion", "travel", "second_arm"}:
            return system, [self._cut(episode) for episode in self._corrected.episodes], []
        made, notes = list[Recording](), list[str]()
        for i, episode in enumerate(base.episodes):
            try:
                recording, beyond = self._moved(system, episode, _MOTION_SEED + i, "travel" in setup_changes)
            except DataError:
                if system.driven != base.system.driven or not base.held_out or "travel" in setup_changes:
                    raise
                recording, beyond = self._cut(base.held_out[i % len(base.held_out)]), []
            made.append(replace(recording, name=episode.name))
            notes += [note for note in beyond if note not in notes]
        return system, made, notes

    @cached_property
    def _corrected(self) -> EstimationProblem:
        """The problem with the torque errors that its measurements determine, estimated at `setting.x`."""
        return problem_with_whitening_at(self.setting.problem, self.setting.x, rounds=2)

    def _cut(self, episode: Episode) -> Recording:
        """Return the part of a recording that the problem uses, with the estimated torque errors subtracted."""
        recording, errors, joints = episode.recording, episode.input_errors, episode.recording.joints
        if errors is not None and joints is not None and joints.effort is not None:
            effort, driven = joints.effort.copy(), self.setting.problem.system.driven
            at = errors.sample_of_step[:, None], [joints.names.index(name) for name in driven]
            effort[at] = effort[at] - errors.recorded_minus_true_torque
            recording = replace(recording, joints=replace(joints, effort=effort))
        if self.setting.problem.options.duration is None:
            return recording
        return recording.time_slice(-math.inf, float(episode.grid.node_times[-1]) + 1e-6)

    def _welded(self, system: System, others: frozenset[str]) -> System:
        layout = self.position_sensitivities_of_variant(others)
        if isinstance(layout, str):
            where, hint = " and ".join(sorted(others)) or "the recorded experiment", "leave the change `weld` out"
            raise SolverError(layout, where=where, allowed="experiments that can be simulated", hint=hint)
        problem, n = layout.problem, system.n_coordinates
        theta, offset = problem.unpack_episode_unknowns(layout.x, 0)
        theta = problem.predictor.theta_with_episode_values(problem.episodes[0], theta)
        start = problem.predictor.initial_state_and_derivative(problem.episodes[0], theta, offset)
        if start.failure_message:
            raise failed_rollout_error(start.failure_message, f"recording '{problem.episodes[0].name}'")
        (q, kinematics), parameters = problem.system.symbols_and_kinematics, problem.system.parameters
        turned = []
        for grasp in system.grasps:
            holder, held = (kinematics.frame_pose(name).rotation for name in (grasp.holder_frame, grasp.held_frame))
            rotation = ca.Function("turn", [q, parameters.symbols], [holder.T @ held])
            turned.append(replace(grasp, kind="weld", held_orientation=ca.SX(rotation(start.state[:n], theta))))
        return replace(system, grasps=tuple(turned))

    def _moved(self, system: System, episode: Episode, seed: int, twice: bool) -> tuple[Recording, list[str]]:
        """Simulate a new motion from the recording's posture in MuJoCo. Also return joint limits that it exceeds."""
        base, given = self.setting.problem, self.setting.parameter_values
        values = {name: v for name, v in given.items() if name in system.parameters}
        posture = dict(zip(base.system.driven, map(float, episode.measured_driven_angles[0]), strict=True))
        if system.driven != base.system.driven:
            together = _pushed_together(system, values)
            posture = grasping_joint_angles(system, values, start_angles=posture, offsets=together)
        duration = episode.grid.steps * episode.grid.time_step
        travel, speed = (factor * (2.0 if twice else 1.0) for factor in (_travel(base.system, given, episode), 1.4))
        excitation = MultisineOptions(gripper_travel=travel, max_joint_speed=speed, duration=duration)
        motion = random_multisine_motion(system, values, seed=seed, initial_joint_angles=posture, excitation=excitation)
        run = simulate_in_mujoco(system, values, motion, SimulationOptions(duration), initial_joint_angles=posture)
        driven = list(system.actuated_coordinate_indices)
        q, noise = run.q[:, driven], _noise_as_recorded(base.system, system, episode)
        joints = JointGroup(system.driven, run.t, q, effort=run.effort, effort_kind="command")
        joints = replace(joints, position_std=noise[0], effort_std=noise[1], effort_bias_std=noise[2])
        limits = [system.mechanism.joints[i] for i in driven]
        low, high, most = np.array([(joint.lower_limit, joint.upper_limit, joint.effort_limit) for joint in limits]).T
        beyond = {"range": (q.min(0) < low) | (q.max(0) > high), "torque limit": np.abs(run.effort).max(0) > most}
        names = {what: ", ".join(np.array(system.driven)[over]) for what, over in beyond.items() if over.any()}
        notes = [f"the simulated motion exceeds the {what} of {joints_beyond}" for what, joints_beyond in names.items()]
        return Recording(joints, source="what if", name=episode.name), notes

    def _dense(self, recording: Recording, index: int, seen: Sequence[_MeasurablePoint], torque: bool) -> Recording:
        """Return the recording with every frame measured at every node with unit noise and, if `torque`, efforts."""
        setting, base = self.setting, self.setting.problem
        episode, joints = base.episodes[index % len(base.episodes)], recording.joints
        t, step = joints.t if joints is not None else episode.recording.points[0].t, base.step.time_step
        times = t[0] + step * np.arange(math.floor(float(t[-1] - t[0]) / step + 1e-6) + 1)
        poses: dict[str, Array | None] = {CAMERA_GROUP: np.eye(4), ARM_GROUP: None}
        sensors = {CAMERA_GROUP: "camera", ARM_GROUP: "arm"}
        for group in _used_point_groups(base, episode):
            poses[group.name], sensors[group.name] = group.camera_pose, group.sensor_name
        wanted: dict[str, dict[str, None]] = {}
        for view in setting.existing_point_observation_schedules(episode):
            wanted.setdefault(view.point_group, {})[view.frame] = None
        camera = setting.camera_points_times_and_median_std(episode)[0]
        arm = setting.arm_point_group_times_and_std(episode)[0]
        look = wanted.setdefault(CAMERA_GROUP if camera is None else camera.name, {})
        look |= dict.fromkeys(sight.name for sight in seen)
        feel = wanted.setdefault(ARM_GROUP if arm is None else arm.name, {})
        feel |= dict.fromkeys(sight.name for sight in seen if sight.is_arm_measurable)
        feel |= dict.fromkeys({grasp.held_frame for grasp in (setting.two_arm_system or base.system).grasps})
        groups = []
        for name, frames in wanted.items():
            shape = (len(times), len(frames), 3)
            if frames:
                blank = (np.zeros(shape), np.ones(shape))
                groups.append(PointGroup(name, tuple(frames), times, *blank, sensors[name], camera_pose=poses[name]))
        if torque and joints is not None and joints.effort is None:
            joints = replace(joints, effort=np.zeros_like(joints.position))
        return replace(recording, joints=joints, points=tuple(groups))


def _noise_as_recorded(base: System, system: System, episode: Episode) -> Sequence[Array | float]:
    """Return the std of encoder noise, torque noise and torque offset of driven joints; medians for a new arm."""
    errors = episode.input_errors
    if errors is None:
        return (0.0, 0.0, 0.0)
    known = np.stack([errors.angle_std, errors.torque_std, errors.torque_bias_std])
    columns = dict(zip(base.driven, known.T, strict=True))
    return list(np.stack([columns.get(joint, np.median(known, axis=1)) for joint in system.driven], axis=1))


def _travel(system: System, values: Mapping[str, float], episode: Episode) -> float:
    whole = np.zeros((len(episode.measured_driven_angles), system.n_coordinates))
    whole[:, list(system.actuated_coordinate_indices)] = episode.measured_driven_angles
    paths = frame_positions(system, values, [grasp.holder_frame for grasp in system.grasps], whole)
    return float(np.linalg.norm(paths - paths[0], axis=2).max(initial=0.0)) or 0.11


def _pushed_together(system: System, values: Mapping[str, float]) -> dict[str, Array]:
    """Return gripper offsets [m] that keep an object between several grippers from being fully stretched."""

    def direction(x: Array) -> Array:
        return np.asarray(x / max(float(np.linalg.norm(x)), 1e-9))

    points = frame_positions(system, values, system.point_frames, np.zeros((1, system.n_coordinates)))[0]
    middle, held = points.mean(0), dict(zip(system.point_frames, points, strict=True))
    forward = _FORWARD_GRIPPER_OFFSET * direction(np.array([middle[0], middle[1], 0.0]))
    inward = {grasp.name: middle - held[grasp.held_frame] for grasp in system.grasps if grasp.held_frame in held}
    return {name: _INWARD_GRIPPER_OFFSET * direction(x) + forward for name, x in inward.items()}
