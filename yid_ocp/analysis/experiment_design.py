"""Hypothetical variants of a recorded experiment: grasps, arms, motions and sensors, with their Fisher information."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import casadi as ca
import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike, NDArray

from yid_ocp.analysis.identifiability import InitialStateKnowledge, transfer_unknowns, with_nuisance_unknowns
from yid_ocp.analysis.torque_error_propagation import episode_sensitivities
from yid_ocp.data.recording import JointGroup, PointGroup, Recording
from yid_ocp.errors import DataError, SolverError, YidError
from yid_ocp.inference.whitening import whitened_at
from yid_ocp.integrator.step import Step, compile_step_like
from yid_ocp.model.kinematics import forward_kinematics
from yid_ocp.model.mechanism import Frame, Placement
from yid_ocp.model.system import System
from yid_ocp.problem import EstimationProblem, SensorOptions
from yid_ocp.problem.episodes import Episode
from yid_ocp.problem.measurements import TimeGrid
from yid_ocp.progress import NULL_PROGRESS, Progress
from yid_ocp.sensors import recorded_camera_pose
from yid_ocp.sensors.joints import POSITION_GROUP, PositionSensor, is_measured_by_arm
from yid_ocp.virtual.joint_motion import MultisineOptions, grasping_joint_angles, random_multisine
from yid_ocp.virtual.mujoco_simulation import SimulationOptions, simulate_in_mujoco

Array = NDArray[np.float64]

CAMERA_GROUP, ARM_GROUP = "points_camera", "points_arm"
_MARKER_AXIS_DISTANCE = 0.03  # of a marker from the axis [m]
_DEFAULT_CAMERA_STD, _DEFAULT_CAMERA_RATE = 5e-3, 3.0  # of a camera where there was none [m], [Hz]
_DEFAULT_ARM_POINT_STD = 1e-3  # of points that an arm measures where it measured none [m]
DEFAULT_TORQUE_STD = 0.1  # of joint torques whose noise nobody stated [N m]
# Two arms hold the object pushed together and away from the robot: at its full stretch a branched tube snaps [m].
_INWARD_GRIPPER_OFFSET, _FORWARD_GRIPPER_OFFSET = 0.05, 0.08


@dataclass(frozen=True)
class FrameObservation:
    """Times and noise at which a sensor measures the position of one frame.

    Attributes
    ----------
    point_group, frame : str
        Group of the recording and frame of the mechanism.
    times : ndarray, shape (M,)
        Since the start of the recording [s].
    std : ndarray, shape (M, 3)
        [m]
    """

    point_group: str
    frame: str
    times: Array
    std: Array


@dataclass(frozen=True)
class BaseExperiment:
    """The recorded experiment, and what its variants may use.

    Attributes
    ----------
    problem : EstimationProblem
    x : ndarray, shape (nx,)
        Unknowns at which the information is evaluated.
    initial_state_knowledge : "unknown" or "known"
    grasp_offset_prior_std : float or None
    two_arm_system : System, optional
        The system with a second arm and its grasp.
    torque_std : float
        Of joint torques as a measurement, where the recording states none [N m].
    motion_seed : int
        Random seed of alternative motions.
    """

    problem: EstimationProblem
    x: Array
    initial_state_knowledge: InitialStateKnowledge = "assumed"
    grasp_offset_prior_std: float | None = None
    two_arm_system: System | None = None
    torque_std: float = DEFAULT_TORQUE_STD
    motion_seed: int = 11

    @property
    def parameter_values(self) -> dict[str, float]:
        """Values of all model parameters at `x`, by name."""
        theta, _ = self.problem.split(self.x, 0)
        return dict(zip(self.problem.system.parameters.names, map(float, theta), strict=True))

    def camera_sampling(self, episode: Episode) -> tuple[PointGroup | None, Array, float]:
        """The camera's point group, its frame times since the start [s] and its typical standard deviation [m]."""
        for group in _used_point_groups(self.problem, episode):
            if recorded_camera_pose(group) is not None:
                std = self._std(group)
                return group, group.t - episode.grid.start_time, float(np.nanmedian(std))
        return None, uniform_sample_times(episode.grid, _DEFAULT_CAMERA_RATE), _DEFAULT_CAMERA_STD

    def arm_sampling(self, episode: Episode) -> tuple[PointGroup | None, Array, float]:
        """Point group, sample times [s] and standard deviation [m] of points that the arms measure."""
        for group in _used_point_groups(self.problem, episode):
            if "arm" in group.name or group.sensor == "arm":
                return group, group.t - episode.grid.start_time, float(np.nanmedian(self._std(group)))
        return None, episode.grid.node_times - episode.grid.start_time, _DEFAULT_ARM_POINT_STD

    def recorded_observations(self, episode: Episode) -> list[FrameObservation]:
        """Observations of the recording's sensors, one entry for each point."""
        found = []
        for group in _used_point_groups(self.problem, episode):
            std = self._std(group)
            for point, frame in self.point_frames(group).items():
                at = group.names.index(point)
                seen = np.all(np.isfinite(group.position[:, at]), axis=1)
                found.append(
                    FrameObservation(group.name, frame, group.t[seen] - episode.grid.start_time, std[seen, at])
                )
        return found

    def point_frames(self, group: PointGroup) -> dict[str, str]:
        """Frame of the mechanism that each used point of a group marks, by point name."""
        choice = self.problem.options.sensors.get(group.name, SensorOptions())
        wanted = choice.points if choice.points is not None else group.names
        frames = {point: choice.frames.get(point, point) for point in wanted}
        return {p: f for p, f in frames.items() if self.problem.system.mechanism.has_frame(f)}

    def _std(self, group: PointGroup) -> Array:
        said = self.problem.options.sensors.get(group.name, SensorOptions()).std
        if isinstance(said, float):
            return np.full(group.position.shape, said)
        if group.std is None:
            raise DataError(f"the noise level of group '{group.name}' is not known", hint="set it under `sensors`")
        return group.std


def _used_point_groups(problem: EstimationProblem, episode: Episode) -> list[PointGroup]:
    """Point groups of a recording that the problem uses."""
    sensors = problem.options.sensors
    return [g for g in episode.recording.points if sensors.get(g.name, SensorOptions()).use is not False]


def uniform_sample_times(grid: TimeGrid, rate: float) -> Array:
    """Evenly spaced sample times over a recording, from its start [s]."""
    return np.arange(0.0, grid.steps * grid.time_step + 1e-9, 1.0 / rate)


# -- what could be seen -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ObservableFrame:
    """A frame that a camera, or also an arm, could measure; `added_frame` where it must be added to the mechanism."""

    name: str
    description: str
    is_arm_measurable: bool
    added_frame: Frame | None = None


def observable_frames(system: System) -> list[ObservableFrame]:
    """Measurable frames: tips and middles of segments and markers beside them; without segments, links and markers."""
    tree = system.mechanism
    held = {grasp.held_frame for grasp in system.grasps}
    found: list[ObservableFrame] = []
    for segment in system.segment_layouts:
        count, tip = len(segment.link_joints), f"w_{segment.name}"
        found.append(ObservableFrame(tip, f"the end of {segment.name}", False))
        if count > 1:
            found.append(
                ObservableFrame(f"{segment.name}_{(count - 1) // 2}_tip", f"the middle of {segment.name}", False)
            )
        beside = _displaced(tree.frame(tip), (_MARKER_AXIS_DISTANCE, 0.0, 0.0))
        words = f"a marker {100 * _MARKER_AXIS_DISTANCE:g} cm off the axis at the end of {segment.name}"
        found.append(ObservableFrame(f"{segment.name}_marker", words, tip in held, beside))
    if system.segment_layouts:
        return found
    moving = [name for name, frame in tree.frames.items() if frame.joint_index >= 0]
    found = [ObservableFrame(name, name, False) for name in moving]
    for spring in system.elastic_joints:
        joint = tree.joints[tree.joint_index(spring.joint_name)]
        if joint.kind == "revolute":
            across = np.eye(3)[int(np.argmin(np.abs(joint.axis)))]
            across -= np.array(joint.axis) * float(across @ joint.axis)
            across *= _MARKER_AXIS_DISTANCE / float(np.linalg.norm(across))
            frame = _displaced(Frame(tree.joint_index(spring.joint_name), Placement.identity()), across)
            words = f"a marker {100 * _MARKER_AXIS_DISTANCE:g} cm off the axis of {spring.joint_name}"
            found.append(ObservableFrame(f"{spring.joint_name}_marker", words, False, frame))
    return found


def _displaced(frame: Frame, offset: ArrayLike) -> Frame:
    shift = Placement(ca.SX(ca.DM.eye(3)), ca.SX(ca.DM(np.asarray(offset, float))))
    return Frame(frame.joint_index, frame.placement @ shift)


def with_added_frames(step: Step, frames: Mapping[str, Frame]) -> Step:
    """The step with further frames in its mechanism; the equations of motion stay the same."""
    mechanism = step.system.mechanism
    system = replace(step.system, mechanism=replace(mechanism, frames={**mechanism.frames, **frames}))
    return replace(step, model=replace(step.model, system=system))


# -- layouts ----------------------------------------------------------------------------------------------------------


@dataclass
class CandidateExperiment:
    """One variant of an experiment, with the sensitivities of all frames that could be measured.

    Attributes
    ----------
    problem : EstimationProblem
        With nuisances, and with every measurable frame observed at every node.
    x : ndarray, shape (nx,)
    free_parameters : tuple of str
        Free parameters, in the order of results.
    position_sensitivities : mapping of (episode, group, frame) to ndarray, shape (N + 1, 3, nx + q)
        Sensitivity of a frame's position at every node by the unknowns, then by what stands for the errors of the
        torques that drive this episode (`_low_rank_error_sensitivity`).
    prior_information : ndarray, shape (nx, nx)
        Fisher information of the priors of nuisances.
    joint_information : mapping of episode to ndarray, shape (nx + q, nx + q)
        Fisher information of measured torques or angles, and of the prior of the torque errors.
    feasibility_notes : tuple of str
        Obstacles on a real robot, such as joint limits.
    """

    problem: EstimationProblem
    x: Array
    free_parameters: tuple[str, ...]
    position_sensitivities: Mapping[tuple[int, str, str], Array]
    prior_information: Array
    joint_information: Mapping[int, Array] = field(default_factory=dict)
    feasibility_notes: tuple[str, ...] = ()
    _known: dict[tuple[int, str, str, bytes, bytes], Array] = field(default_factory=dict, repr=False)

    def fisher_information(self, views: Sequence[Sequence[FrameObservation]]) -> Array:
        """Fisher information of observations, one list for each recording, plus the prior information, (nx, nx)."""
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

    def _of(self, episode: int, grid: TimeGrid, view: FrameObservation) -> Array:
        key = (episode, view.point_group, view.frame, view.times.tobytes(), view.std.tobytes())
        if key not in self._known:
            inside = (view.times >= -1e-9) & (view.times <= grid.steps * grid.time_step + 1e-9)
            node, fraction = grid.node_and_fraction(grid.start_time + view.times[inside])
            slopes = self.position_sensitivities[episode, view.point_group, view.frame]
            after = slopes[np.minimum(node + 1, grid.steps)]
            rows = slopes[node] + fraction[:, None, None] * (after - slopes[node])
            rows = (rows / view.std[inside][:, :, None]).reshape(-1, rows.shape[2])
            self._known[key] = rows.T @ rows
        return self._known[key]


MECHANICAL_CHANGES: Mapping[str, str] = {
    "weld": "weld grasps in place of points",
    "second_arm": "a second arm",
    "motion": "another motion",
    "travel": "another motion of twice the travel",
    "torque": "joint torques as a measurement, the arms' motion as known",
}


class CandidateExperimentBuilder:
    """Builds and caches variants of an experiment by their mechanical changes.

    Parameters
    ----------
    setting : Setting
    progress : Progress, optional
    """

    def __init__(self, setting: BaseExperiment, progress: Progress = NULL_PROGRESS) -> None:
        self.setting = setting
        self._progress = progress
        self._layouts: dict[frozenset[str], CandidateExperiment | str] = {}

    def build_experiment(self, mechanics: frozenset[str]) -> CandidateExperiment | str:
        """The experiment with a set of mechanical changes, or a message why it cannot be built."""
        if mechanics not in self._layouts:
            if mechanics:
                self._progress.begin_stage(
                    "working out " + " and ".join(MECHANICAL_CHANGES[name] for name in sorted(mechanics))
                )
            try:
                self._layouts[mechanics] = self._build(mechanics)
            except YidError as error:
                self._layouts[mechanics] = error.what
        return self._layouts[mechanics]

    def applicable_changes(self) -> list[str]:
        """Names of the mechanical changes that apply to the system."""
        setting, system = self.setting, self.setting.problem.system
        found = []
        if any(grasp.kind != "weld" for grasp in system.grasps):
            found.append("weld")
        if setting.two_arm_system is not None:
            found.append("second_arm")
        if system.driven and not system.servos:
            found += ["motion", "travel"]
        measured = any(s.sensor.effort_joints for e in setting.problem.episodes for s in e.measurements)
        if (system.driven or system.prescribed) and not measured and setting.problem.episodes[0].recording.joints:
            found.append("torque")
        return found

    def _build(self, mechanics: frozenset[str]) -> CandidateExperiment:
        setting = self.setting
        base = setting.problem
        system, recordings, notes = self._experiment(mechanics)
        if "torque" in mechanics:
            system = replace(system, driven=(), servos={}, prescribed=(*system.prescribed, *system.driven))
        if mechanics - {"motion", "travel"} or system is not base.system:
            step = compile_step_like(base.step, system, use_compiler=False)
        else:
            step = base.step
        seen = observable_frames(system)
        step = with_added_frames(
            step, {sight.name: sight.added_frame for sight in seen if sight.added_frame is not None}
        )
        wide = with_nuisance_unknowns(base, setting.x, setting.initial_state_knowledge, setting.grasp_offset_prior_std)
        sensors = {k: replace(v, use=None) for k, v in base.options.sensors.items() if k.startswith("joints.")}
        if "second_arm" in mechanics:
            # made motions state their noise, that of joints which the settings do not know too
            sensors = {name: replace(choice, std=None, bias_std=None) for name, choice in sensors.items()}
        if "torque" in mechanics:
            sensors["joints.effort"] = self._torque_options()
        options = replace(
            wide.options,
            sensors=sensors,
            huber_threshold=math.inf,
            weak_prior_factor=0.0,
            weighting="whitened",
            duration=None,
        )
        dense = [self._dense(entry, i, seen, "torque" in mechanics) for i, entry in enumerate(recordings)]
        values = {name: v for name, v in setting.parameter_values.items() if name in step.system.parameters}
        nuisances = [name for name in wide.free if name not in base.free]
        problem = EstimationProblem(step, dense, (*base.free, *nuisances), options, values)
        x = transfer_unknowns(setting.x, base.unknown_names, problem)
        evaluation = problem.evaluate(x)
        if not evaluation.ok or evaluation.jacobian is None:
            raise SolverError(f"the model cannot be rolled out: {evaluation.message}")
        slopes: dict[tuple[int, str, str], Array] = {}
        by_joints: dict[int, Array] = {}
        encoders = self._with_encoders(problem)
        for i in range(len(problem.episodes)):
            finest = self._finest(base.episodes[i % len(base.episodes)])
            points, by_joints[i] = episode_sensitivities(problem, evaluation, x, i, finest, encoders)
            slopes |= {(i, *key): value for key, value in points.items()}
        names = tuple(name for name in problem.unknown_names if name.split("[")[0] in base.free)
        stated = evaluation.jacobian[problem.residual_rows.stated_priors].copy()
        # what is assumed of the parameters themselves stays out: what is asked is what sensors say
        stated[:, [problem.unknown_names.index(name) for name in names]] = 0.0
        return CandidateExperiment(problem, x, names, slopes, stated.T @ stated, by_joints, tuple(notes))

    def _finest(self, episode: Episode) -> dict[str, float]:
        """Least standard deviation that each group's points can have in a recording [m]."""
        setting, finest = self.setting, {}
        for default, (group, _, std) in (
            (CAMERA_GROUP, setting.camera_sampling(episode)),
            (ARM_GROUP, setting.arm_sampling(episode)),
        ):
            finest[default if group is None else group.name] = std
        for view in setting.recorded_observations(episode):
            finest[view.point_group] = min(finest.get(view.point_group, math.inf), float(view.std.min()))
        return finest

    def _with_encoders(self, problem: EstimationProblem) -> EstimationProblem | None:
        """The same experiment with the driven joints' encoders as measurements, where they are in the one made."""
        base = self.setting.problem
        used = any(isinstance(samples.sensor, PositionSensor) for e in base.episodes for samples in e.measurements)
        if not used or not problem.system.driven:
            return None
        sensors = dict(problem.options.sensors)
        sensors[POSITION_GROUP] = replace(sensors.get(POSITION_GROUP, SensorOptions()), use=True)
        recordings = [
            replace(e.recording, points=tuple(group for group in e.recording.points if not is_measured_by_arm(group)))
            for e in problem.episodes
        ]
        values = dict(zip(problem.system.parameters.names, map(float, problem.theta), strict=True))
        options = replace(problem.options, sensors=sensors)
        return EstimationProblem(problem.step, recordings, problem.free, options, values)

    def _experiment(self, mechanics: frozenset[str]) -> tuple[System, list[Recording], list[str]]:
        """System and motion, driven as in the recordings."""
        setting = self.setting
        base = setting.problem
        recordings = [self._cut(episode) for episode in self._corrected.episodes]
        system = base.system
        if "second_arm" in mechanics:
            assert setting.two_arm_system is not None
            system = setting.two_arm_system
        if "weld" in mechanics:
            system = self._welded(system, mechanics - {"weld", "torque", "motion", "travel"})
        if not mechanics & {"motion", "travel", "second_arm"}:
            return system, recordings, []
        made: list[Recording] = []
        notes: list[str] = []
        for i, episode in enumerate(base.episodes):
            try:
                recording, beyond = self._moved(system, episode, setting.motion_seed + i, "travel" in mechanics)
            except DataError:
                if system.driven != base.system.driven or not base.held_out or "travel" in mechanics:
                    raise
                recording, beyond = self._cut(base.held_out[i % len(base.held_out)]), []
            made.append(replace(recording, name=episode.name))
            notes += [note for note in beyond if note not in notes]
        return system, made, notes

    @cached_property
    def _corrected(self) -> EstimationProblem:
        """The problem with the errors of torques known that its measurements tell of."""
        return whitened_at(self.setting.problem, self.setting.x, rounds=2)

    def _cut(self, episode: Episode) -> Recording:
        """The part of a recording that the problem uses, its torques without the errors that are known."""
        recording, errors = episode.recording, episode.input_errors
        joints = recording.joints
        if errors is not None and joints is not None and joints.effort is not None:
            effort = joints.effort.copy()
            columns = [joints.names.index(name) for name in self.setting.problem.system.driven]
            effort[errors.sample_of_step[:, None], columns] = (
                effort[errors.sample_of_step[:, None], columns] - errors.total_torque_error
            )
            recording = replace(recording, joints=replace(joints, effort=effort))
        if self.setting.problem.options.duration is None:
            return recording
        return recording.time_slice(-math.inf, float(episode.grid.node_times[-1]) + 1e-6)

    def _welded(self, system: System, others: frozenset[str]) -> System:
        """Grasps as welds that keep the orientation in which the ends lie at the start."""
        layout = self.build_experiment(others)
        if isinstance(layout, str):
            raise SolverError(layout)
        problem = layout.problem
        episode = problem.episodes[0]
        start = problem.initial_state(episode, *problem.split(layout.x, 0))
        if start.failure_message:
            raise SolverError(start.failure_message)
        q, parameters = ca.SX.sym("q", system.n_coordinates), problem.system.parameters
        kinematics = forward_kinematics(problem.system.mechanism, q)
        turned = []
        for grasp in system.grasps:
            pose = (
                kinematics.frame_pose(grasp.holder_frame).rotation.T @ kinematics.frame_pose(grasp.held_frame).rotation
            )
            rotation = ca.Function("turn", [q, parameters.symbols], [pose])
            theta, _ = problem.split(layout.x, 0)
            turned.append(
                replace(
                    grasp, kind="weld", held_orientation=ca.SX(rotation(start.state[: system.n_coordinates], theta))
                )
            )
        return replace(system, grasps=tuple(turned))

    def _moved(self, system: System, episode: Episode, seed: int, twice: bool) -> tuple[Recording, list[str]]:
        """A motion of the driven joints in MuJoCo, from the recording's posture; what of it a robot could not do."""
        setting = self.setting
        base = setting.problem
        values = {name: v for name, v in setting.parameter_values.items() if name in system.parameters}
        measured = dict(zip(base.system.driven, map(float, episode.measured_driven_angles[0]), strict=True))
        posture = measured
        if system.driven != base.system.driven:
            posture = grasping_joint_angles(
                system, values, start_angles=measured, offsets=_pushed_together(system, values)
            )
        duration = episode.grid.steps * episode.grid.time_step
        travel = _travel(base.system, setting.parameter_values, episode) * (2.0 if twice else 1.0)
        speed = 2.8 if twice else 1.4
        excitation = MultisineOptions(gripper_travel=travel, max_joint_speed=speed, duration=duration)
        motion = random_multisine(system, values, seed=seed, initial_joint_angles=posture, excitation=excitation)
        run = simulate_in_mujoco(system, values, motion, SimulationOptions(duration), initial_joint_angles=posture)
        driven, noise = list(system.driven_indices), _noise_as_recorded(base.system, system, episode)
        joints = JointGroup(
            system.driven,
            run.t,
            run.q[:, driven],
            effort=run.effort,
            effort_kind="command",
            position_std=noise[0],
            effort_std=noise[1],
            effort_bias_std=noise[2],
        )
        beyond: dict[str, list[str]] = {"range": [], "torque": []}
        for k, name in enumerate(system.driven):
            joint = system.mechanism.joints[driven[k]]
            q, effort = run.q[:, driven[k]], run.effort[:, k]
            if q.min() < joint.lower_limit or q.max() > joint.upper_limit:
                beyond["range"].append(name)
            if np.abs(effort).max() > joint.effort_limit:
                beyond["torque"].append(name)
        notes = [f"beyond the {what} of {', '.join(names)}" for what, names in beyond.items() if names]
        return Recording(joints, source="what if", name=episode.name), notes

    def _dense(self, recording: Recording, index: int, seen: Sequence[ObservableFrame], torque: bool) -> Recording:
        """The recording with every sight in view at every node, of unit standard deviation, and efforts to predict."""
        setting = self.setting
        base = setting.problem
        episode = base.episodes[index % len(base.episodes)]
        joints = recording.joints
        t = joints.t if joints is not None else episode.recording.points[0].t
        step = base.step.time_step
        times = t[0] + step * np.arange(math.floor(float(t[-1] - t[0]) / step + 1e-6) + 1)
        wanted: dict[str, list[str]] = {}
        poses: dict[str, Array | None] = {CAMERA_GROUP: np.eye(4), ARM_GROUP: None}
        sensors = {CAMERA_GROUP: "camera", ARM_GROUP: "arm"}
        for view in setting.recorded_observations(episode):
            wanted.setdefault(view.point_group, []).append(view.frame)
        for group in _used_point_groups(base, episode):
            poses[group.name], sensors[group.name] = group.pose, group.sensor
        camera, arm = setting.camera_sampling(episode)[0], setting.arm_sampling(episode)[0]
        look = wanted.setdefault(CAMERA_GROUP if camera is None else camera.name, [])
        look += [sight.name for sight in seen if sight.name not in look]
        feel = wanted.setdefault(ARM_GROUP if arm is None else arm.name, [])
        feel += [sight.name for sight in seen if sight.is_arm_measurable and sight.name not in feel]
        held = {grasp.held_frame for grasp in (setting.two_arm_system or base.system).grasps}
        feel += [frame for frame in held if frame not in feel]
        groups = []
        for name, frames in wanted.items():
            shape = (len(times), len(frames), 3)
            if frames:
                blank = (np.zeros(shape), np.ones(shape))
                groups.append(PointGroup(name, tuple(frames), times, *blank, sensors[name], pose=poses[name]))
        if torque and joints is not None and joints.effort is None:
            joints = replace(joints, effort=np.zeros_like(joints.position))
        return replace(recording, joints=joints, points=tuple(groups))

    def _torque_options(self) -> SensorOptions:
        joints = self.setting.problem.episodes[0].recording.joints
        said = None if joints is None else joints.effort_std
        stated = said is not None and bool(np.all(np.asarray(said) > 0))
        return SensorOptions(std=None if stated else self.setting.torque_std)


def _noise_as_recorded(base: System, system: System, episode: Episode) -> Sequence[Array | float]:
    """Of encoders, of torques, and the constant one, of driven joints; that of joints not recorded is a typical one."""
    errors = episode.input_errors
    if errors is None:
        return (0.0, 0.0, 0.0)
    place = {joint: i for i, joint in enumerate(base.driven)}
    return [
        np.array([std[place[joint]] if joint in place else np.median(std) for joint in system.driven])
        for std in (errors.angle_std, errors.torque_std, errors.torque_bias_std)
    ]


def _travel(system: System, values: Mapping[str, float], episode: Episode) -> float:
    """Largest distance of a gripper from where it starts [m]."""
    q = ca.SX.sym("q", system.n_coordinates)
    tree = replace(system.mechanism, parameters=system.parameters).with_numeric_values(values)
    kinematics = forward_kinematics(tree, q)
    whole = np.zeros((len(episode.measured_driven_angles), system.n_coordinates))
    whole[:, list(system.driven_indices)] = episode.measured_driven_angles
    farthest = 0.0
    for grasp in system.grasps:
        tip = ca.Function("tip", [q], [kinematics.frame_position(grasp.holder_frame)]).map(len(whole))
        path = np.array(tip(whole.T)).T
        farthest = max(farthest, float(np.max(np.linalg.norm(path - path[0], axis=1))))
    return farthest if farthest > 0 else 0.11


def _pushed_together(system: System, values: Mapping[str, float]) -> dict[str, Array]:
    """Offsets of grippers that take an object held by several out of its full stretch."""
    q = ca.SX.sym("q", system.n_coordinates)
    tree = replace(system.mechanism, parameters=system.parameters).with_numeric_values(values)
    kinematics = forward_kinematics(tree, q)
    place = ca.Function("place", [q], [ca.horzcat(*(kinematics.frame_position(name) for name in system.point_frames))])
    points = np.array(place(np.zeros(system.n_coordinates))).T
    middle, held = points.mean(0), {name: points[i] for i, name in enumerate(system.point_frames)}
    away = np.array([middle[0], middle[1], 0.0])
    away /= max(float(np.linalg.norm(away)), 1e-9)
    offsets = {}
    for grasp in system.grasps:
        if grasp.held_frame in held:
            inward = middle - held[grasp.held_frame]
            offsets[grasp.name] = (
                _INWARD_GRIPPER_OFFSET * inward / max(float(np.linalg.norm(inward)), 1e-9)
                + _FORWARD_GRIPPER_OFFSET * away
            )
    return offsets
