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

from yid_ocp.analysis.identifiability import StartKnowledge, carried, with_nuisances
from yid_ocp.analysis.torque_errors import in_view
from yid_ocp.data.recording import JointGroup, PointGroup, Recording
from yid_ocp.errors import DataError, SolverError, YidError
from yid_ocp.integrator.step import Step, compile_alike
from yid_ocp.model.kinematics import forward_kinematics
from yid_ocp.model.mechanism import Frame, Placement
from yid_ocp.model.system import System
from yid_ocp.problem import EstimationProblem, SensorOptions
from yid_ocp.problem.episodes import Episode
from yid_ocp.problem.grid import Grid
from yid_ocp.progress import SILENT, Progress
from yid_ocp.sensors import camera_pose
from yid_ocp.sensors.joints import POSITION, PositionSensor, of_arm
from yid_ocp.virtual.engine import Simulation, simulate_in_mujoco
from yid_ocp.virtual.motion import Excitation, multisine
from yid_ocp.virtual.posture import initial_posture

Array = NDArray[np.float64]

CAMERA, ARM = "points_camera", "points_arm"
MARKER_DISTANCE = 0.03  # of a marker from the axis [m]
CAMERA_STD, CAMERA_RATE = 5e-3, 3.0  # of a camera where there was none [m], [Hz]
ARM_STD = 1e-3  # of points that an arm measures where it measured none [m]
TORQUE_STD = 0.1  # of joint torques whose noise nobody stated [N m]
# Two arms hold the object pushed together and away from the robot: at its full stretch a branched tube snaps [m].
TOGETHER, FORWARD = 0.05, 0.08


@dataclass(frozen=True)
class View:
    """Times and noise at which a sensor measures the position of one frame.

    Attributes
    ----------
    group, frame : str
        Group of the recording and frame of the mechanism.
    times : ndarray, shape (M,)
        Since the start of the recording [s].
    std : ndarray, shape (M, 3)
        [m]
    """

    group: str
    frame: str
    times: Array
    std: Array


@dataclass(frozen=True)
class Setting:
    """The recorded experiment, and what its variants may use.

    Attributes
    ----------
    problem : EstimationProblem
    x : ndarray, shape (nx,)
        Unknowns at which the information is evaluated.
    start : "unknown" or "known"
    grasp_std : float or None
    second_arm : System, optional
        The system with a second arm and its grasp.
    torque_std : float
        Of joint torques as a measurement, where the recording states none [N m].
    seed : int
        Random seed of alternative motions.
    """

    problem: EstimationProblem
    x: Array
    start: StartKnowledge = "assumed"
    grasp_std: float | None = None
    second_arm: System | None = None
    torque_std: float = TORQUE_STD
    seed: int = 11

    @property
    def values(self) -> dict[str, float]:
        """Values of all model parameters at `x`, by name."""
        theta, _ = self.problem.split(self.x, 0)
        return dict(zip(self.problem.system.parameters.names, map(float, theta), strict=True))

    def camera(self, episode: Episode) -> tuple[PointGroup | None, Array, float]:
        """The camera's point group, its frame times since the start [s] and its typical standard deviation [m]."""
        for group in used_groups(self.problem, episode):
            if camera_pose(group) is not None:
                std = self._std(group)
                return group, group.t - episode.grid.start, float(np.nanmedian(std))
        return None, regular_times(episode.grid, CAMERA_RATE), CAMERA_STD

    def arm(self, episode: Episode) -> tuple[PointGroup | None, Array, float]:
        """Point group, sample times [s] and standard deviation [m] of points that the arms measure."""
        for group in used_groups(self.problem, episode):
            if "arm" in group.name or group.sensor == "arm":
                return group, group.t - episode.grid.start, float(np.nanmedian(self._std(group)))
        return None, episode.grid.times - episode.grid.start, ARM_STD

    def views(self, episode: Episode) -> list[View]:
        """Observations of the recording's sensors, one entry for each point."""
        found = []
        for group in used_groups(self.problem, episode):
            std = self._std(group)
            for point, frame in self.frames(group).items():
                at = group.names.index(point)
                seen = np.all(np.isfinite(group.position[:, at]), axis=1)
                found.append(View(group.name, frame, group.t[seen] - episode.grid.start, std[seen, at]))
        return found

    def frames(self, group: PointGroup) -> dict[str, str]:
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


def used_groups(problem: EstimationProblem, episode: Episode) -> list[PointGroup]:
    """Point groups of a recording that the problem uses."""
    sensors = problem.options.sensors
    return [g for g in episode.recording.points if sensors.get(g.name, SensorOptions()).use is not False]


def regular_times(grid: Grid, rate: float) -> Array:
    """Evenly spaced sample times over a recording, from its start [s]."""
    return np.arange(0.0, grid.steps * grid.time_step + 1e-9, 1.0 / rate)


# -- what could be seen -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Sight:
    """A frame that a camera, or also an arm, could measure; `frame` where it must be added to the mechanism."""

    name: str
    words: str
    arm: bool
    frame: Frame | None = None


def sights(system: System) -> list[Sight]:
    """Measurable frames: tips and middles of segments and markers beside them; without segments, links and markers."""
    tree = system.mechanism
    held = {grasp.held for grasp in system.grasps}
    found: list[Sight] = []
    for segment in system.segments:
        count, tip = len(segment.links), f"w_{segment.name}"
        found.append(Sight(tip, f"the end of {segment.name}", False))
        if count > 1:
            found.append(Sight(f"{segment.name}_{(count - 1) // 2}_tip", f"the middle of {segment.name}", False))
        beside = _displaced(tree.frame(tip), (MARKER_DISTANCE, 0.0, 0.0))
        words = f"a marker {100 * MARKER_DISTANCE:g} cm off the axis at the end of {segment.name}"
        found.append(Sight(f"{segment.name}_marker", words, tip in held, beside))
    if system.segments:
        return found
    moving = [name for name, frame in tree.frames.items() if frame.joint >= 0]
    found = [Sight(name, name, False) for name in moving]
    for spring in system.elastic:
        joint = tree.joints[tree.joint_index(spring.joint)]
        if joint.kind == "revolute":
            across = np.eye(3)[int(np.argmin(np.abs(joint.axis)))]
            across -= np.array(joint.axis) * float(across @ joint.axis)
            across *= MARKER_DISTANCE / float(np.linalg.norm(across))
            frame = _displaced(Frame(tree.joint_index(spring.joint), Placement.identity()), across)
            words = f"a marker {100 * MARKER_DISTANCE:g} cm off the axis of {spring.joint}"
            found.append(Sight(f"{spring.joint}_marker", words, False, frame))
    return found


def _displaced(frame: Frame, offset: ArrayLike) -> Frame:
    shift = Placement(ca.SX(ca.DM.eye(3)), ca.SX(ca.DM(np.asarray(offset, float))))
    return Frame(frame.joint, frame.placement @ shift)


def seeing(step: Step, frames: Mapping[str, Frame]) -> Step:
    """The step with further frames in its mechanism; the equations of motion stay the same."""
    mechanism = step.system.mechanism
    system = replace(step.system, mechanism=replace(mechanism, frames={**mechanism.frames, **frames}))
    return replace(step, model=replace(step.model, system=system))


# -- layouts ----------------------------------------------------------------------------------------------------------


@dataclass
class Layout:
    """One variant of an experiment, with the sensitivities of all frames that could be measured.

    Attributes
    ----------
    problem : EstimationProblem
        With nuisances, and with every measurable frame observed at every node.
    x : ndarray, shape (nx,)
    names : tuple of str
        Free parameters, in the order of results.
    slopes : mapping of (episode, group, frame) to ndarray, shape (N + 1, 3, nx + q)
        Sensitivity of a frame's position at every node by the unknowns, then by what stands for the errors of the
        torques that drive this episode (`seen_errors`).
    fixed : ndarray, shape (nx, nx)
        Fisher information of the priors of nuisances.
    by_joints : mapping of episode to ndarray, shape (nx + q, nx + q)
        Fisher information of measured torques or angles, and of the prior of the torque errors.
    notes : tuple of str
        Obstacles on a real robot, such as joint limits.
    """

    problem: EstimationProblem
    x: Array
    names: tuple[str, ...]
    slopes: Mapping[tuple[int, str, str], Array]
    fixed: Array
    by_joints: Mapping[int, Array] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    _known: dict[tuple[int, str, str, bytes, bytes], Array] = field(default_factory=dict, repr=False)

    def information(self, views: Sequence[Sequence[View]]) -> Array:
        """Fisher information of observations, one list for each recording, plus the prior information, (nx, nx)."""
        total = self.fixed.copy()
        nx = len(total)
        for i, episode in enumerate(self.problem.episodes):
            seen = [self._of(i, episode.grid, view) for view in views[i % len(views)]]
            if i in self.by_joints:
                seen.append(self.by_joints[i])
            own = sum(seen, np.zeros_like(seen[0]) if seen else np.zeros((nx, nx)))
            total += own[:nx, :nx]
            if len(own) > nx:
                total -= own[:nx, nx:] @ scipy.linalg.solve(own[nx:, nx:], own[nx:, :nx], assume_a="pos")
        return total

    def _of(self, episode: int, grid: Grid, view: View) -> Array:
        key = (episode, view.group, view.frame, view.times.tobytes(), view.std.tobytes())
        if key not in self._known:
            inside = (view.times >= -1e-9) & (view.times <= grid.steps * grid.time_step + 1e-9)
            node, fraction = grid.locate(grid.start + view.times[inside])
            slopes = self.slopes[episode, view.group, view.frame]
            after = slopes[np.minimum(node + 1, grid.steps)]
            rows = slopes[node] + fraction[:, None, None] * (after - slopes[node])
            rows = (rows / view.std[inside][:, :, None]).reshape(-1, rows.shape[2])
            self._known[key] = rows.T @ rows
        return self._known[key]


MECHANICS: Mapping[str, str] = {
    "weld": "weld grasps in place of points",
    "second_arm": "a second arm",
    "motion": "another motion",
    "travel": "another motion of twice the travel",
    "torque": "joint torques as a measurement, the arms' motion as known",
}


class LayoutBuilder:
    """Builds and caches variants of an experiment by their mechanical changes.

    Parameters
    ----------
    setting : Setting
    progress : Progress, optional
    """

    def __init__(self, setting: Setting, progress: Progress = SILENT) -> None:
        self.setting = setting
        self._progress = progress
        self._layouts: dict[frozenset[str], Layout | str] = {}

    def layout(self, mechanics: frozenset[str]) -> Layout | str:
        """The experiment with a set of mechanical changes, or a message why it cannot be built."""
        if mechanics not in self._layouts:
            if mechanics:
                self._progress.stage("working out " + " and ".join(MECHANICS[name] for name in sorted(mechanics)))
            try:
                self._layouts[mechanics] = self._build(mechanics)
            except YidError as error:
                self._layouts[mechanics] = error.what
        return self._layouts[mechanics]

    def possible(self) -> list[str]:
        """Names of the mechanical changes that apply to the system."""
        setting, system = self.setting, self.setting.problem.system
        found = []
        if any(grasp.kind != "weld" for grasp in system.grasps):
            found.append("weld")
        if setting.second_arm is not None:
            found.append("second_arm")
        if system.driven and not system.servos:
            found += ["motion", "travel"]
        measured = any(s.sensor.efforts for e in setting.problem.episodes for s in e.samples)
        if (system.driven or system.prescribed) and not measured and setting.problem.episodes[0].recording.joints:
            found.append("torque")
        return found

    def _build(self, mechanics: frozenset[str]) -> Layout:
        setting = self.setting
        base = setting.problem
        system, recordings, notes = self._experiment(mechanics)
        if "torque" in mechanics:
            system = replace(system, driven=(), servos={}, prescribed=(*system.prescribed, *system.driven))
        if mechanics - {"motion", "travel"} or system is not base.system:
            step = compile_alike(base.step, system, use_compiler=False)
        else:
            step = base.step
        seen = sights(system)
        step = seeing(step, {sight.name: sight.frame for sight in seen if sight.frame is not None})
        wide = with_nuisances(base, setting.x, setting.start, setting.grasp_std)
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
        values = {name: v for name, v in setting.values.items() if name in step.system.parameters}
        nuisances = [name for name in wide.free if name not in base.free]
        problem = EstimationProblem(step, dense, (*base.free, *nuisances), options, values)
        x = carried(setting.x, base.names, problem)
        evaluation = problem.evaluate(x)
        if not evaluation.ok or evaluation.jacobian is None:
            raise SolverError(f"the model cannot be rolled out: {evaluation.message}")
        slopes: dict[tuple[int, str, str], Array] = {}
        by_joints: dict[int, Array] = {}
        encoders = self._with_encoders(problem)
        for i in range(len(problem.episodes)):
            finest = self._finest(base.episodes[i % len(base.episodes)])
            points, by_joints[i] = in_view(problem, evaluation, x, i, finest, encoders)
            slopes |= {(i, *key): value for key, value in points.items()}
        names = tuple(name for name in problem.names if name.split("[")[0] in base.free)
        stated = evaluation.jacobian[problem.rows.stated_priors].copy()
        # what is assumed of the parameters themselves stays out: what is asked is what sensors say
        stated[:, [problem.names.index(name) for name in names]] = 0.0
        return Layout(problem, x, names, slopes, stated.T @ stated, by_joints, tuple(notes))

    def _finest(self, episode: Episode) -> dict[str, float]:
        """Least standard deviation that each group's points can have in a recording [m]."""
        setting, finest = self.setting, {}
        for default, (group, _, std) in ((CAMERA, setting.camera(episode)), (ARM, setting.arm(episode))):
            finest[default if group is None else group.name] = std
        for view in setting.views(episode):
            finest[view.group] = min(finest.get(view.group, math.inf), float(view.std.min()))
        return finest

    def _with_encoders(self, problem: EstimationProblem) -> EstimationProblem | None:
        """The same experiment with the driven joints' encoders as measurements, where they are in the one made."""
        base = self.setting.problem
        used = any(isinstance(samples.sensor, PositionSensor) for e in base.episodes for samples in e.samples)
        if not used or not problem.system.driven:
            return None
        sensors = dict(problem.options.sensors)
        sensors[POSITION] = replace(sensors.get(POSITION, SensorOptions()), use=True)
        recordings = [
            replace(e.recording, points=tuple(group for group in e.recording.points if not of_arm(group)))
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
            assert setting.second_arm is not None
            system = setting.second_arm
        if "weld" in mechanics:
            system = self._welded(system, mechanics - {"weld", "torque", "motion", "travel"})
        if not mechanics & {"motion", "travel", "second_arm"}:
            return system, recordings, []
        made: list[Recording] = []
        notes: list[str] = []
        for i, episode in enumerate(base.episodes):
            try:
                recording, beyond = self._moved(system, episode, setting.seed + i, "travel" in mechanics)
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
        return self.setting.problem.weighted_at(self.setting.x, rounds=2)

    def _cut(self, episode: Episode) -> Recording:
        """The part of a recording that the problem uses, its torques without the errors that are known."""
        recording, errors = episode.recording, episode.errors
        joints = recording.joints
        if errors is not None and joints is not None and joints.effort is not None:
            effort = joints.effort.copy()
            columns = [joints.names.index(name) for name in self.setting.problem.system.driven]
            effort[errors.sample[:, None], columns] = effort[errors.sample[:, None], columns] - errors.taken_off
            recording = replace(recording, joints=replace(joints, effort=effort))
        if self.setting.problem.options.duration is None:
            return recording
        return recording.slice(-math.inf, float(episode.grid.times[-1]) + 1e-6)

    def _welded(self, system: System, others: frozenset[str]) -> System:
        """Grasps as welds that keep the orientation in which the ends lie at the start."""
        layout = self.layout(others)
        if isinstance(layout, str):
            raise SolverError(layout)
        problem = layout.problem
        episode = problem.episodes[0]
        start = problem.start_state(episode, *problem.split(layout.x, 0))
        if start.message:
            raise SolverError(start.message)
        q, parameters = ca.SX.sym("q", system.size), problem.system.parameters
        kinematics = forward_kinematics(problem.system.mechanism, q)
        turned = []
        for grasp in system.grasps:
            pose = kinematics.pose(grasp.holder).rotation.T @ kinematics.pose(grasp.held).rotation
            rotation = ca.Function("turn", [q, parameters.symbols], [pose])
            theta, _ = problem.split(layout.x, 0)
            turned.append(replace(grasp, kind="weld", rotation=ca.SX(rotation(start.state[: system.size], theta))))
        return replace(system, grasps=tuple(turned))

    def _moved(self, system: System, episode: Episode, seed: int, twice: bool) -> tuple[Recording, list[str]]:
        """A motion of the driven joints in MuJoCo, from the recording's posture; what of it a robot could not do."""
        setting = self.setting
        base = setting.problem
        values = {name: v for name, v in setting.values.items() if name in system.parameters}
        measured = dict(zip(base.system.driven, map(float, episode.measured_arm[0]), strict=True))
        posture = measured
        if system.driven != base.system.driven:
            posture = initial_posture(system, values, seed=measured, offsets=_pushed_together(system, values))
        duration = episode.grid.steps * episode.grid.time_step
        travel = _travel(base.system, setting.values, episode) * (2.0 if twice else 1.0)
        speed = 2.8 if twice else 1.4
        excitation = Excitation(travel=travel, speed=speed, duration=duration)
        motion = multisine(system, values, seed=seed, posture=posture, excitation=excitation)
        run = simulate_in_mujoco(system, values, motion, Simulation(duration), posture=posture)
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
            if q.min() < joint.lower or q.max() > joint.upper:
                beyond["range"].append(name)
            if np.abs(effort).max() > joint.effort_limit:
                beyond["torque"].append(name)
        notes = [f"beyond the {what} of {', '.join(names)}" for what, names in beyond.items() if names]
        return Recording(joints, source="what if", name=episode.name), notes

    def _dense(self, recording: Recording, index: int, seen: Sequence[Sight], torque: bool) -> Recording:
        """The recording with every sight in view at every node, of unit standard deviation, and efforts to predict."""
        setting = self.setting
        base = setting.problem
        episode = base.episodes[index % len(base.episodes)]
        joints = recording.joints
        t = joints.t if joints is not None else episode.recording.points[0].t
        step = base.step.time_step
        times = t[0] + step * np.arange(math.floor(float(t[-1] - t[0]) / step + 1e-6) + 1)
        wanted: dict[str, list[str]] = {}
        poses: dict[str, Array | None] = {CAMERA: np.eye(4), ARM: None}
        sensors = {CAMERA: "camera", ARM: "arm"}
        for view in setting.views(episode):
            wanted.setdefault(view.group, []).append(view.frame)
        for group in used_groups(base, episode):
            poses[group.name], sensors[group.name] = group.pose, group.sensor
        camera, arm = setting.camera(episode)[0], setting.arm(episode)[0]
        look = wanted.setdefault(CAMERA if camera is None else camera.name, [])
        look += [sight.name for sight in seen if sight.name not in look]
        feel = wanted.setdefault(ARM if arm is None else arm.name, [])
        feel += [sight.name for sight in seen if sight.arm and sight.name not in feel]
        held = {grasp.held for grasp in (setting.second_arm or base.system).grasps}
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
    errors = episode.errors
    if errors is None:
        return (0.0, 0.0, 0.0)
    place = {joint: i for i, joint in enumerate(base.driven)}
    return [
        np.array([std[place[joint]] if joint in place else np.median(std) for joint in system.driven])
        for std in (errors.angle_std, errors.torque_std, errors.bias_std)
    ]


def _travel(system: System, values: Mapping[str, float], episode: Episode) -> float:
    """Largest distance of a gripper from where it starts [m]."""
    q = ca.SX.sym("q", system.size)
    tree = replace(system.mechanism, parameters=system.parameters).numeric(values)
    kinematics = forward_kinematics(tree, q)
    whole = np.zeros((len(episode.measured_arm), system.size))
    whole[:, list(system.driven_indices)] = episode.measured_arm
    farthest = 0.0
    for grasp in system.grasps:
        tip = ca.Function("tip", [q], [kinematics.position(grasp.holder)]).map(len(whole))
        path = np.array(tip(whole.T)).T
        farthest = max(farthest, float(np.max(np.linalg.norm(path - path[0], axis=1))))
    return farthest if farthest > 0 else 0.11


def _pushed_together(system: System, values: Mapping[str, float]) -> dict[str, Array]:
    """Offsets of grippers that take an object held by several out of its full stretch."""
    q = ca.SX.sym("q", system.size)
    tree = replace(system.mechanism, parameters=system.parameters).numeric(values)
    kinematics = forward_kinematics(tree, q)
    place = ca.Function("place", [q], [ca.horzcat(*(kinematics.position(name) for name in system.points))])
    points = np.array(place(np.zeros(system.size))).T
    middle, held = points.mean(0), {name: points[i] for i, name in enumerate(system.points)}
    away = np.array([middle[0], middle[1], 0.0])
    away /= max(float(np.linalg.norm(away)), 1e-9)
    offsets = {}
    for grasp in system.grasps:
        if grasp.held in held:
            inward = middle - held[grasp.held]
            offsets[grasp.name] = TOGETHER * inward / max(float(np.linalg.norm(inward)), 1e-9) + FORWARD * away
    return offsets
