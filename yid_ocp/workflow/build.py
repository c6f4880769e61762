"""Builds system, compiled step, recordings and estimation problem from the settings."""

from __future__ import annotations

import contextlib
import fnmatch
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from importlib import resources
from pathlib import Path

import casadi as ca
import numpy as np

from yid_ocp.analysis.convergence import min_grasp_gaps
from yid_ocp.config.reader import load_config
from yid_ocp.config.settings import (
    CableSettings,
    FoamYSettings,
    MountSettings,
    ParameterSettings,
    RunSettings,
    SegmentedObjectSettings,
)
from yid_ocp.data.edge_lengths import median_edge_lengths
from yid_ocp.data.recording import Recording
from yid_ocp.data.recording_hdf5 import read_recording
from yid_ocp.effects import make_effect
from yid_ocp.errors import DataError, ModelError, YidError, nearest_name_hint, unknown_name_details
from yid_ocp.files import is_file
from yid_ocp.integrator.step import Step, compile_step
from yid_ocp.model import FlexibleObject, Grasp, Mechanism, Segment, System, flexible_object
from yid_ocp.model.cable import CableTopology, cable_system, edge_length_parameters, read_vertex_positions
from yid_ocp.model.parameters import Parameters
from yid_ocp.model.rotations import rotation_from_rpy, transform_from_xyz_rpy
from yid_ocp.model.servos_and_springs import PositionServoOptions, RobotJointSpring
from yid_ocp.model.urdf import read_urdf, resolve_urdf_path
from yid_ocp.model.y_object import Y_FOOT_POSITION, y_segments
from yid_ocp.problem import EstimationProblem, ProblemOptions, SensorOptions
from yid_ocp.problem.episodes import Episode
from yid_ocp.sensors.joints import EFFORT_GROUP, POSITION_GROUP, is_measured_by_arm
from yid_ocp.workflow.clamps import clamp_mechanism, clamp_paths, marker_parameter_values, with_extra_frames
from yid_ocp.workflow.plugins import load_plugins
from yid_ocp.workflow.recording_issues import (
    check_recordings,
    mention_issues_in_errors,
    object_point_issues,
    raise_for_issues,
)

_START_FRAMES = 2  # of a cable's free points, from which every prediction starts
_MAX_GRASP_GAP = 0.01  # what encoder noise and a slightly wrong length of the object can make of a grasp [m]
_OBJECT_DAMPING_KEY = "object"  # key of the object's damping beside those of the joints
_PER_JOINT_QUANTITIES = ("bend", "twist", "damping", "twist_damping")
_DEFAULT_JOINT_DAMPING = 0.05  # of joints that a damping by name does not mention [N m s/rad]
_PlacedObject = tuple[FlexibleObject, str | None, np.ndarray | None]


@contextlib.contextmanager
def locate_errors(run: RunSettings, *path: str | int) -> Iterator[None]:
    """Context manager that adds the location of a setting to errors raised in its block."""
    try:
        yield
    except YidError as error:
        where = run.describe_location(*path)
        if error.where and error.where not in where:
            where = f"{where} ({error.where})"
        raise type(error)(error.what, where=where, allowed=error.allowed, hint=error.hint) from error


def build_system(run: RunSettings, link_division: int = 1) -> System:
    """The system of a run, its parameters at the values and bounds of the settings.

    Parameters
    ----------
    link_division : int
        Into how many links each of the object's is divided, the stiffness and damping of a tube kept; to see what the
        number of links does. A cable's edges stay as they are.

    Raises
    ------
    ConfigError, ModelError
        Names that do not exist, values outside their bounds; the error names the setting.
    """
    model = run.model
    input_files(run)
    load_plugins(run)
    if isinstance(model.object, CableSettings):
        return _cable_model(run)
    robot = _robot(run)
    joints = () if robot is None else robot.joint_names
    held = clamp_mechanism(run)
    damping, of_object = _dampings(run, joints)
    for name, spring in model.springs.items():
        if name not in joints:
            raise run.config_error(
                f"there is no joint '{name}'", "model", "springs", name, hint=nearest_name_hint(name, joints)
            )
        if spring.damping is not None:
            damping[name] = spring.damping
    with locate_errors(run, "model", "object"):
        objects = _objects(run, of_object, link_division)
    mode = "driven" if _arms_are_estimated_states(run) else model.arms.mode
    for i, name in enumerate(model.arms.passive_joints):
        if name not in joints:
            hint = nearest_name_hint(name, joints)
            raise run.config_error(f"there is no joint '{name}'", "model", "arms", "passive_joints", i, hint=hint)
    moved = tuple(name for name in joints if name not in model.arms.passive_joints)
    grasps = [
        Grasp(name, grasp.holder_frame, grasp.held_frame, grasp.kind, ca.SX(ca.DM(rotation_from_rpy(*grasp.rpy))))
        for name, grasp in model.grasp.items()
    ]
    if robot is None and not objects:
        raise run.config_error(
            "the model has neither a robot nor an object", "model", hint="set model.robot or model.object"
        )
    with locate_errors(run, "model", "frames"):
        carrier, items = with_extra_frames(run, robot if held is None else held, [item for item, _, _ in objects])
    with locate_errors(run, "model"):
        system = System.build(
            carrier,
            objects=[(item, frame, place) for item, (_, frame, place) in zip(items, objects, strict=True)],
            grasps=grasps,
            driven=moved if mode in ("driven", "servo") else (),
            prescribed=held.joint_names if held is not None else moved if mode == "prescribed" else (),
            damping=damping,
            gravity=model.gravity,
            point_frames=model.points,
            springs={name: RobotJointSpring(s.stiffness, s.rest_position) for name, s in model.springs.items()},
            servos=PositionServoOptions(**vars(model.arms.servo)) if mode == "servo" else None,
        )
    if any(said.marker_reference_pose for said in model.frames.values()) and run.recordings.estimate:
        # where markers sit when nobody says which recording is meant
        first = replace(run, recordings=replace(run.recordings, estimate=run.recordings.estimate[:1]))
        [places] = marker_parameter_values(run, system, read_recordings(first, "estimate")).values()
        system = replace(system, parameters=system.parameters.with_values(places))
    return _completed(run, system, link_division)


def _arms_are_estimated_states(run: RunSettings) -> bool:
    """Whether prescribed arms become estimated states, driven by measured torques and corrected by encoders."""
    if run.model.arms.mode != "prescribed" or not run.model.grasp:
        return False
    recordings = read_recordings(run, "estimate")
    return bool(recordings) and all(r.joints is not None and r.joints.effort is not None for r in recordings)


def _dampings(run: RunSettings, joints: Sequence[str]) -> tuple[dict[str, float], float]:
    """Damping of every joint of the robot, and of the object's joints."""
    said = run.model.damping
    if not isinstance(said, Mapping):
        return dict.fromkeys(joints, said), said
    known = (*joints, _OBJECT_DAMPING_KEY) if run.model.object is not None else joints
    for name in said:
        if name not in known:
            raise run.config_error(
                f"there is no joint '{name}'", "model", "damping", name, hint=nearest_name_hint(name, known)
            )
    if run.model.object is not None and _OBJECT_DAMPING_KEY not in said:
        allowed = f"joints of the robot and `{_OBJECT_DAMPING_KEY}`, for all joints of the object"
        what = "the damping is given by joint, but not that of the object"
        raise run.config_error(
            what, "model", "damping", allowed=allowed, hint=f"set model.damping.{_OBJECT_DAMPING_KEY}"
        )
    return {name: said.get(name, _DEFAULT_JOINT_DAMPING) for name in joints}, said.get(
        _OBJECT_DAMPING_KEY, _DEFAULT_JOINT_DAMPING
    )


def _completed(run: RunSettings, system: System, finer: int = 1) -> System:
    """The system with its effects, its parameters at the values and bounds of the settings."""
    for i, said in enumerate(run.model.effects):
        with locate_errors(run, "model", "effects", i):
            system = system.with_effects([make_effect(said.kind, said.location, system, dict(said.values))])
    return replace(system, parameters=_set_parameters(run, system.parameters, finer))


def _cable_model(run: RunSettings) -> System:
    cable, item = build_cable(run), run.model.object
    assert cable is not None
    assert isinstance(item, CableSettings)
    for key in ("robot", "grasp", "springs", "clamps", "frames"):
        if getattr(run.model, key):
            raise run.config_error(f"a cable takes no {key}: its clamps hold it", "model", key, hint=f"remove {key}")
    for name in item.branches:
        if name not in cable.branch_vertices:
            hint = nearest_name_hint(name, cable.branch_vertices)
            raise run.config_error(f"there is no branch '{name}'", "model", "object", "branches", name, hint=hint)
    recordings = read_recordings(run, "estimate")
    if not recordings:
        raise run.config_error(
            "a cable's lengths come from recordings", "recordings", "estimate", hint="list at least one"
        )
    with locate_errors(run, "model", "object"):
        system = cable_system(
            median_edge_lengths(cable.edges, recordings), cable, replace(item, gravity=run.model.gravity)
        )
    return _completed(run, system)


def build_cable(run: RunSettings) -> CableTopology | None:
    """The cable that a run's object describes, None for another object."""
    item = run.model.object
    if not isinstance(item, CableSettings):
        return None
    with locate_errors(run, "model", "object", "undeformed_shape_file"):
        undeformed = read_vertex_positions(item.undeformed_shape_file)
    with locate_errors(run, "model", "object"):
        return CableTopology(item.parent_vertices, dict(item.child_vertices), undeformed)


def _robot(run: RunSettings) -> Mechanism | None:
    model = run.model
    if model.robot is None:
        return None
    with locate_errors(run, "model", "arms", "joints"):
        arms = model.arms
        return read_urdf(model.robot, joints=arms.joints, locked=arms.locked_joints, exclude_links=arms.exclude_links)


def input_files(run: RunSettings) -> dict[str, Path]:
    """Every file that a run reads, by its name in the settings: configuration, plug-ins, robot, recordings.

    Raises
    ------
    ConfigError
        One does not exist; the error names the setting and the nearest file that does.
    """
    files: dict[str, Path] = {}
    if run.config_file:
        files["configuration"] = Path(run.config_file)
    for i, path in enumerate(run.plugins):
        files[path] = _existing(run, Path(path), "plug-in", "plugins", i)
    robot = run.model.robot
    if robot is not None:
        with locate_errors(run, "model", "robot"):
            file = resolve_urdf_path(robot)
        files[robot] = _existing(run, file, "URDF file", "model", "robot")
    if isinstance(run.model.object, CableSettings):
        file = Path(run.model.object.undeformed_shape_file)
        files[str(file)] = _existing(run, file, "table of points", "model", "object", "undeformed_shape_file")
    for which in ("estimate", "held_out"):
        for i, path in enumerate(getattr(run.recordings, which)):
            files[path] = _existing(run, recording_path(path), "recording", "recordings", which, i)
    return files


def _existing(run: RunSettings, file: Path, noun: str, *key: str | int) -> Path:
    if is_file(file):
        return file
    folder = file.parent
    names = [entry.name for entry in folder.glob(f"*{file.suffix}")] if folder.is_dir() else []
    hint = (
        nearest_name_hint(file.name, names) if names else "check the path, which is relative to the configuration file"
    )
    raise run.config_error(f"there is no such {noun}: {file}", *key, hint=hint)


def _objects(run: RunSettings, damping: float, finer: int) -> list[_PlacedObject]:
    item = run.model.object
    if item is None or isinstance(item, CableSettings):
        return []
    if isinstance(item, FoamYSettings):
        segments = [
            replace(
                segment,
                links=item.links * finer,
                bend=segment.bend * finer,
                twist=segment.twist * finer,
                damping=damping * finer,
            )
            for segment in y_segments()
        ]
        if item.mount is None:
            made = flexible_object(segments, transform_from_xyz_rpy(Y_FOOT_POSITION), "y_object", item.gravity_fraction)
            return [(made, None, None)]
        made = flexible_object(segments, None, "y_object", item.gravity_fraction)
        return [(made, item.mount.parent_frame, _placement(item.mount))]
    made = flexible_object(_segments(item, damping, finer), name="object", gravity_fraction=item.gravity_fraction)
    return [(made, item.mount.parent_frame, _placement(item.mount))]


def _placement(mount: MountSettings) -> np.ndarray:
    return transform_from_xyz_rpy(mount.xyz, mount.rpy)


def _segments(item: SegmentedObjectSettings, damping: float, finer: int) -> list[Segment]:
    result = []
    for name, s in item.segments.items():
        if s.length is None and s.link_lengths is None:
            raise ModelError(
                f"segment '{name}' has no length", where=f"segments.{name}", hint="set length or link_lengths"
            )
        # a rigidity does not depend on the number of links, a stiffness per joint does
        factor = 1 if s.stiffness_per_curvature else finer
        lengths = s.link_lengths
        result.append(
            Segment(
                name,
                s.length if s.length is not None else float(sum(lengths or ())),
                s.mass,
                s.radius,
                s.links * finer,
                None if lengths is None else [length / finer for length in lengths for _ in range(finer)],
                s.parent,
                # a child stays at the same place of its parent
                None if s.parent_link_index is None else (s.parent_link_index + 1) * finer - 1,
                rotation_from_rpy(*s.rpy),
                bend=Segment.bend * factor,
                twist=Segment.twist * factor,
                damping=damping * factor,
                twist_damping=damping * factor if s.separate_twist_damping else None,
                stiffness_per_curvature=s.stiffness_per_curvature,
                clamped_at_base=s.clamped_at_base,
                joint_axes=s.joint_axes,
                cross_section=s.cross_section,
                link_length_parameters=s.link_length_parameters,
            )
        )
    return result


# -- parameters -------------------------------------------------------------------------------------------------------


def parameter_settings(run: RunSettings, parameters: Parameters) -> dict[str, ParameterSettings]:
    """Settings of every parameter that a name or pattern of the run matches; later keys override earlier ones.

    Raises
    ------
    ConfigError
        A name or pattern that matches nothing.
    """
    result: dict[str, ParameterSettings] = {}
    for key, given in run.parameters.items():
        matches = [name for name in parameters.names if name == key or fnmatch.fnmatchcase(name, key)]
        if not matches:
            hint = nearest_name_hint(key, parameters.names) + "; all of them are listed by `yid-ocp inspect`"
            raise run.config_error(f"there is no parameter '{key}'", "parameters", key, hint=hint)
        said = {name: value for name, value in vars(given).items() if value is not None}
        for name in matches:
            result[name] = replace(result.get(name, ParameterSettings()), **said)
    return result


def _set_parameters(run: RunSettings, parameters: Parameters, finer: int) -> Parameters:
    chosen = parameter_settings(run, parameters)
    entries = []
    for entry in parameters:
        if entry.name in chosen:
            said, factor = chosen[entry.name], link_division_factor(run, entry.name, finer)
            lower, upper = (entry.lower, entry.upper) if said.bounds is None else (factor * b for b in said.bounds)
            value = entry.value if said.initial is None else factor * said.initial
            key = _key_of(run, entry.name)
            if lower < entry.lower or upper > entry.upper or lower > upper:
                what = f"the bounds {lower:g} to {upper:g} {entry.unit} of {entry.name} are not possible"
                allowed = f"within {entry.lower:g} to {entry.upper:g} {entry.unit}, lower first"
                raise run.config_error(what, "parameters", key, "bounds", allowed=allowed)
            with locate_errors(run, "parameters", key, "initial"):
                entry = replace(entry, value=value, lower=lower, upper=upper)
        entries.append(entry)
    return Parameters(entries)


def link_division_factor(run: RunSettings, name: str, link_division: int) -> int:
    """Factor on a per-joint parameter that keeps the tube's stiffness when each link is divided."""
    item, (owner, _, quantity) = run.model.object, name.rpartition(".")
    if quantity not in _PER_JOINT_QUANTITIES or isinstance(item, CableSettings):
        return 1
    if isinstance(item, FoamYSettings):
        return link_division if owner in [segment.name for segment in y_segments()] else 1
    owned = None if item is None else item.segments.get(owner)
    return 1 if owned is None or owned.stiffness_per_curvature else link_division


def _key_of(run: RunSettings, name: str) -> str:
    keys = [key for key in run.parameters if key == name or fnmatch.fnmatchcase(name, key)]
    return keys[-1] if keys else name


# -- data and problem -------------------------------------------------------------------------------------------------


def recording_path(path: str) -> Path:
    """Path of a recording named in the settings; `default:NAME` is one shipped with the package."""
    if not path.startswith("default:"):
        return Path(path)
    return Path(str(resources.files("yid_ocp.data").joinpath("defaults", path.removeprefix("default:"))))


def read_recordings(run: RunSettings, which: str) -> list[Recording]:
    """Recordings under `recordings.estimate` or `recordings.held_out`, each with a name of its own.

    Raises
    ------
    DataError
        As `read_recording`; the error names the setting.
    """
    paths: Sequence[str] = getattr(run.recordings, which)
    result: list[Recording] = []
    for i, path in enumerate(paths):
        file = _existing(run, recording_path(path), "recording", "recordings", which, i)
        with locate_errors(run, "recordings", which, i):
            recording = read_recording(file)
        if recording.name in [entry.name for entry in result]:
            recording = replace(recording, name=f"{recording.name}_{i}")
        result.append(recording)
    return result


def build_step(run: RunSettings, system: System | None = None) -> Step:
    """The compiled step of a run."""
    said = run.problem
    system = build_system(run) if system is None else system
    return compile_step(system, said.time_step, said.force_split, said.constraint_force, use_compiler=said.use_compiler)


def problem_options(run: RunSettings, system: System, recordings: Sequence[Recording] = ()) -> ProblemOptions:
    """`ProblemOptions` of a run, with values that depend on system and recordings.

    Parameters
    ----------
    recordings : sequence of Recording
        Where values differ from recording to recording (a cable's edges, places of markers), those of these.
    """
    parameters = system.parameters
    chosen = parameter_settings(run, parameters)
    for name in run.problem.start_fit_parameters:
        if name not in parameters:
            hint = nearest_name_hint(name, parameters.names)
            raise run.config_error(f"there is no parameter '{name}'", "problem", "start_fit_parameters", hint=hint)
    sensors = dict(run.sensors)
    if _arms_are_estimated_states(run):
        # what the encoders say is what counts of the arms, as it does where they are prescribed
        sensors[POSITION_GROUP] = replace(sensors.get(POSITION_GROUP, SensorOptions()), use=True)
        for group in {
            group.name for recording in recordings for group in recording.points if is_measured_by_arm(group)
        }:
            sensors[group] = replace(sensors.get(group, SensorOptions()), use=False)
    cable = build_cable(run)
    own = marker_parameter_values(run, system, recordings)
    if cable is not None and isinstance(run.model.object, CableSettings):
        for group in {group.name for recording in recordings for group in recording.points}:
            said = sensors.get(group, SensorOptions())
            sensors[group] = said if said.points is not None else replace(said, points=cable.free_vertices)
        if run.model.object.lengths_per_recording:
            own = {
                recording.name: edge_length_parameters(
                    cable, median_edge_lengths(cable.edges, [recording], _START_FRAMES)
                )
                for recording in recordings
            }
    return replace(
        run.problem,
        sensors=sensors,
        clamp_paths=clamp_paths(run, cable),
        local_parameters=tuple(name for name, said in chosen.items() if said.per_recording),
        prior_stds={name: said.prior_std for name, said in chosen.items() if said.prior_std is not None},
        parameters_by_recording=own,
    )


def build_problem(
    run: RunSettings, step: Step | None = None, reference_recordings: Sequence[Recording] = ()
) -> EstimationProblem:
    """The estimation problem of a run.

    Parameters
    ----------
    step : Step, optional
        Compiled before; built when absent.
    reference_recordings : sequence of Recording
        That will be predicted only; the options say where markers sit in them.

    Raises
    ------
    ConfigError, DataError, ModelError
        Settings, recordings or names that do not fit, a grasp that cannot be closed, a recording that nothing can be
        done with; with `recordings.strict` any doubt about one.
    """
    system = build_system(run) if step is None else step.system
    free = [name for name, said in parameter_settings(run, system.parameters).items() if said.free]
    if not free:
        raise run.config_error(
            "no parameter is free", "parameters", hint="set parameters.NAME.free: true for what is sought"
        )
    same = sorted(set(run.recordings.estimate) & set(run.recordings.held_out))
    if same:
        what = "a recording is both estimated on and held out"
        raise run.config_error(what, "recordings", "held_out", allowed="one of the two", hint=same[0])
    estimate, held_out = read_recordings(run, "estimate"), read_recordings(run, "held_out")
    if not estimate:
        raise run.config_error(
            "there is no recording to estimate on", "recordings", "estimate", hint="list at least one recording"
        )
    _check_sensors(run, [*estimate, *held_out])
    seen = check_recordings(run, system, build_cable(run), free, estimate, held_out)
    options = problem_options(run, system, [*seen.estimate, *seen.held_out, *reference_recordings])
    step = build_step(run, system) if step is None else step
    said = replace(options, data_issues=seen.issues)
    problem = EstimationProblem(step, seen.estimate, free, said, None, seen.held_out)
    with mention_issues_in_errors(seen.issues):
        _check_grasps_close(run, problem)
    more = object_point_issues(problem)
    if more:
        raise_for_issues(run, more)
        problem = problem.with_options(replace(said, data_issues=(*seen.issues, *more)))
    return problem


def initial_grasp_gaps(problem: EstimationProblem, episode: Episode) -> dict[str, float]:
    """Remaining gap of every grasp at the first configuration of a recording, by grasp name [m]."""
    system = problem.system
    if not system.grasps:
        return {}
    posture = dict(
        zip((*system.driven, *system.prescribed), map(float, episode.initial_known_coordinates), strict=True)
    )
    theta = problem.theta.copy()
    for name, value in problem.options.parameters_by_recording.get(episode.name, {}).items():
        theta[system.parameters.index(name)] = value
    return min_grasp_gaps(system, posture, theta)


def _check_grasps_close(run: RunSettings, problem: EstimationProblem) -> None:
    """Raise an error for recordings at whose first configuration a grasp cannot be closed."""
    for episode in (*problem.episodes, *problem.held_out):
        for name, gap in initial_grasp_gaps(problem, episode).items():
            if gap > _MAX_GRASP_GAP:
                raise DataError(
                    f"grasp '{name}' cannot be closed at the first posture of '{episode.name}': "
                    f"{1e3 * gap:.3g} mm are missing",
                    where=run.describe_location("model", "grasp", name),
                    allowed=f"at most {1e3 * _MAX_GRASP_GAP:g} mm",
                    hint="check the object's lengths and mount, the grasp's frames and the recording's joints",
                )


def _check_sensors(run: RunSettings, recordings: Sequence[Recording]) -> None:
    known = {group.name for recording in recordings for group in recording.points}
    known |= (
        {"joints.position", "joints.effort"} if any(recording.joints is not None for recording in recordings) else set()
    )
    for name in run.sensors:
        if name not in known:
            raise run.config_error(
                f"no recording has a group '{name}'", "sensors", name, **unknown_name_details(name, sorted(known))
            )
        if run.sensors[name].effort_kind is not None and name != EFFORT_GROUP:
            hint = f"say it of {EFFORT_GROUP}, or leave it out"
            raise run.config_error(f"'{name}' holds no efforts", "sensors", name, "effort_kind", hint=hint)


# -- from a file -----------------------------------------------------------------------------------------------------


def load_system(path: str | Path, overrides: Sequence[str] = ()) -> System:
    """The system that a configuration file describes; errors as `load_config` and `build_system`."""
    return build_system(load_config(path, overrides))


def load_problem(path: str | Path | None = None, overrides: Sequence[str] = ()) -> EstimationProblem:
    """The estimation problem of a configuration file, of the embedded one when absent.

    Parameters and errors as `load_config`; errors as `build_problem`.
    """
    return build_problem(load_config(path, overrides))
