"""From settings to objects: the system, the compiled step, recordings, the estimation problem."""

from __future__ import annotations

import contextlib
import fnmatch
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from importlib import resources
from pathlib import Path

import casadi as ca
import numpy as np

from yid_ocp.data.recording import Recording, read_recording
from yid_ocp.errors import DataError, ModelError, YidError, nearest
from yid_ocp.integrator.step import Step, compile_step
from yid_ocp.model import FlexibleObject, Grasp, Mechanism, Segment, System, flexible_object
from yid_ocp.model.mechanism import robot_description_file, roll_pitch_yaw
from yid_ocp.model.parameters import Parameters
from yid_ocp.model.system import Spring, placement_matrix
from yid_ocp.model.y_object import y_segments
from yid_ocp.problem import EstimationProblem, ProblemOptions, SensorOptions
from yid_ocp.workflow.settings import MountSettings, ParameterSettings, Run, SegmentedObject, YObject

Placed = tuple[FlexibleObject, str | None, np.ndarray | None]


@contextlib.contextmanager
def located(run: Run, *path: str | int) -> Iterator[None]:
    """Say in errors of the block which setting they come from."""
    try:
        yield
    except YidError as error:
        where = run.where(*path)
        if error.where and error.where not in where:
            where = f"{where} ({error.where})"
        raise type(error)(error.what, where=where, allowed=error.allowed, hint=error.hint) from error


def build_system(run: Run, links: int | None = None) -> System:
    """The system of a run, its parameters at the values and bounds of the settings.

    Parameters
    ----------
    run : Run
    links : int, optional
        Rigid links of every tube of the object instead of those of the settings, with the same stiffness per tube; for
        convergence checks.

    Returns
    -------
    System

    Raises
    ------
    ConfigError, ModelError
        Names that do not exist, values outside their bounds; the error names the setting.
    """
    model = run.model
    robot = _robot(run)
    by_name = dict(model.damping) if isinstance(model.damping, Mapping) else None
    everywhere = 0.05 if by_name is not None else float(model.damping)  # type: ignore[arg-type]
    joints = () if robot is None else robot.joint_names
    if by_name is not None:
        for name in by_name:
            if name not in joints:
                raise run.refuse(
                    f"there is no joint '{name}'", "model", "damping", name, hint=nearest(name, joints)
                )
    damping = dict.fromkeys(joints, everywhere) | (by_name or {})
    for name, spring in model.springs.items():
        if name not in joints:
            raise run.refuse(f"there is no joint '{name}'", "model", "springs", name, hint=nearest(name, joints))
        if spring.damping is not None:
            damping[name] = spring.damping
    with located(run, "model", "object"):
        objects = _objects(run, everywhere, links)
    mode = model.arms.mode
    grasps = [
        Grasp(name, grasp.holder, grasp.held, grasp.kind, ca.SX(ca.DM(roll_pitch_yaw(*grasp.rpy))))
        for name, grasp in model.grasp.items()
    ]
    if robot is None and not objects:
        raise run.refuse("the model has neither a robot nor an object", "model", hint="set model.robot or model.object")
    with located(run, "model"):
        system = System.build(
            robot,
            objects=objects,
            grasps=grasps,
            driven=joints if mode == "driven" else (),
            prescribed=joints if mode == "prescribed" else (),
            damping=damping,
            gravity=model.gravity,
            points=model.points,
            springs={name: Spring(s.stiffness, s.rest) for name, s in model.springs.items()},
        )
    return replace(system, parameters=_set_parameters(run, system.parameters))


def _robot(run: Run) -> Mechanism | None:
    model = run.model
    if model.robot is None:
        return None
    with located(run, "model", "robot"):
        file = robot_file(run)
        if file is not None and not file.is_file():
            near = nearest(file.name, (entry.name for entry in file.parent.glob("*.urdf"))) if file.parent.is_dir() else ""
            raise ModelError("there is no such URDF file", where=str(file), hint=near)
    with located(run, "model", "arms", "joints"):
        return Mechanism.from_urdf(model.robot, joints=model.arms.joints, locked=model.arms.locked)


def robot_file(run: Run) -> Path | None:
    """The URDF file of a run's robot, None without one."""
    if run.model.robot is None:
        return None
    name = run.model.robot
    return robot_description_file(name.removeprefix("package:")) if name.startswith("package:") else Path(name)


def _objects(run: Run, damping: float, links: int | None) -> list[Placed]:
    item = run.model.object
    if item is None:
        return []
    if isinstance(item, YObject):
        count = item.links if links is None else links
        factor = count / item.links
        segments = [
            replace(s, links=count, bend=s.bend * factor, twist=s.twist * factor, damping=damping)
            for s in y_segments()
        ]
        if item.mount is None:
            foot = placement_matrix((0.85, 0.0, -0.93))
            return [(flexible_object(segments, foot), None, None)]
        return [(flexible_object(segments), item.mount.frame, _placement(item.mount))]
    segments = _segments(item, damping, links)
    return [(flexible_object(segments, name="object"), item.mount.frame, _placement(item.mount))]


def _placement(mount: MountSettings) -> np.ndarray:
    return placement_matrix(mount.xyz, mount.rpy)


def _segments(item: SegmentedObject, damping: float, links: int | None) -> list[Segment]:
    result = []
    for name, s in item.segments.items():
        if s.length is None and s.link_lengths is None:
            raise ModelError(f"segment '{name}' has no length", where=f"segments.{name}", hint="set length or link_lengths")
        count = s.links if links is None or s.link_lengths is not None else links
        # a rigidity does not depend on the number of links, a stiffness per joint does
        factor = 1.0 if s.rigidity else count / s.links
        result.append(
            Segment(
                name,
                s.length if s.length is not None else float(sum(s.link_lengths or ())),
                s.mass,
                s.radius,
                count,
                s.link_lengths,
                s.parent,
                s.at_link,
                roll_pitch_yaw(*s.rpy),
                bend=s.bend * factor,
                twist=s.twist * factor,
                damping=damping if s.damping is None else s.damping,
                twist_damping=s.twist_damping,
                rigidity=s.rigidity,
                clamped=s.clamped,
                joint_order=s.joint_order,
                separate_lengths=s.separate_lengths,
            )
        )
    return result


# -- parameters -------------------------------------------------------------------------------------------------------


def parameter_settings(run: Run, parameters: Parameters) -> dict[str, ParameterSettings]:
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
            raise run.refuse(
                f"there is no parameter '{key}'",
                "parameters",
                key,
                hint=nearest(key, parameters.names) + "; all of them are listed by `yid-ocp inspect`",
            )
        said = {name: value for name, value in vars(given).items() if value is not None}
        for name in matches:
            result[name] = replace(result.get(name, ParameterSettings()), **said)
    return result


def _set_parameters(run: Run, parameters: Parameters) -> Parameters:
    chosen = parameter_settings(run, parameters)
    entries = []
    for entry in parameters:
        if entry.name in chosen:
            said = chosen[entry.name]
            lower, upper = (entry.lower, entry.upper) if said.bounds is None else said.bounds
            value = entry.value if said.initial is None else said.initial
            key = _key_of(run, entry.name)
            if lower < entry.lower or upper > entry.upper or lower > upper:
                raise run.refuse(
                    f"the bounds {lower:g} to {upper:g} {entry.unit} of {entry.name} are not possible",
                    "parameters",
                    key,
                    "bounds",
                    allowed=f"within {entry.lower:g} to {entry.upper:g} {entry.unit}, lower first",
                )
            with located(run, "parameters", key, "initial"):
                entry = replace(entry, value=value, lower=lower, upper=upper)
        entries.append(entry)
    return Parameters(entries)


def _key_of(run: Run, name: str) -> str:
    keys = [key for key in run.parameters if key == name or fnmatch.fnmatchcase(name, key)]
    return keys[-1] if keys else name


# -- data and problem -------------------------------------------------------------------------------------------------


def recording_file(path: str) -> Path:
    """File of a recording in the settings; `default:NAME` is one that ships with the package."""
    if not path.startswith("default:"):
        return Path(path)
    folder = Path(str(resources.files("yid_ocp.data").joinpath("defaults")))
    name = path.removeprefix("default:")
    file = folder / name
    if not file.is_file():
        known = sorted(entry.name for entry in folder.glob("*.h5"))
        raise DataError(f"no recording '{name}' ships with the package", allowed=", ".join(known), hint=nearest(name, known))
    return file


def read_recordings(run: Run, which: str) -> list[Recording]:
    """Recordings under `recordings.estimate` or `recordings.held_out`, each with a name of its own.

    Raises
    ------
    DataError
        As `read_recording`; the error names the setting.
    """
    paths: Sequence[str] = getattr(run.recordings, which)
    result: list[Recording] = []
    for i, path in enumerate(paths):
        with located(run, "recordings", which, i):
            recording = read_recording(recording_file(path))
        if recording.name in [entry.name for entry in result]:
            recording = replace(recording, name=f"{recording.name}_{i}")
        result.append(recording)
    return result


def build_step(run: Run, system: System | None = None) -> Step:
    """The compiled step of a run."""
    solver = run.solver
    return compile_step(
        build_system(run) if system is None else system,
        solver.time_step,
        solver.force_split,
        use_compiler=solver.compiler,
    )


def problem_options(run: Run, parameters: Parameters) -> ProblemOptions:
    """What the settings say about the estimation problem."""
    solver, chosen = run.solver, parameter_settings(run, parameters)
    sensors = {
        name: SensorOptions(s.use, s.std, dict(s.frames), s.points, s.position_std) for name, s in run.sensors.items()
    }
    return ProblemOptions(
        initial_state=solver.initial_state,
        feedback=solver.feedback,
        gains=tuple(solver.gains),
        weighting=solver.weighting,
        robust_scale=solver.robust_scale,
        path_cutoff=solver.path_cutoff,
        sensors=sensors,
        local=tuple(name for name, said in chosen.items() if said.local),
        priors={name: said.prior for name, said in chosen.items() if said.prior is not None},
        tie_break=solver.tie_break,
        configuration_std=solver.configuration_std,
        velocity_std=solver.velocity_std,
        duration=solver.duration,
        start_window=solver.start_window,
    )


def build_problem(run: Run, step: Step | None = None) -> EstimationProblem:
    """The estimation problem of a run.

    Parameters
    ----------
    run : Run
    step : Step, optional
        Compiled before; built when absent.

    Returns
    -------
    EstimationProblem

    Raises
    ------
    ConfigError, DataError, ModelError
        Settings, recordings or names that do not fit.
    """
    system = build_system(run) if step is None else step.system
    free = [name for name, said in parameter_settings(run, system.parameters).items() if said.free]
    if not free:
        raise run.refuse("no parameter is free", "parameters", hint="set parameters.NAME.free: true for what is sought")
    same = sorted(set(run.recordings.estimate) & set(run.recordings.held_out))
    if same:
        raise run.refuse(
            "a recording is both estimated on and held out", "recordings", "held_out", allowed="one of the two", hint=same[0]
        )
    estimate, held_out = read_recordings(run, "estimate"), read_recordings(run, "held_out")
    if not estimate:
        raise run.refuse(
            "there is no recording to estimate on", "recordings", "estimate", hint="list at least one recording"
        )
    _check_sensors(run, [*estimate, *held_out])
    options = problem_options(run, system.parameters)
    step = build_step(run, system) if step is None else step
    return EstimationProblem(step, estimate, free, options, None, held_out)


def _check_sensors(run: Run, recordings: Sequence[Recording]) -> None:
    known = {group.name for recording in recordings for group in recording.points}
    known |= {"joints.effort"} if any(recording.joints is not None for recording in recordings) else set()
    for name in run.sensors:
        if name not in known:
            raise run.refuse(
                f"no recording has a group '{name}'", "sensors", name, allowed=", ".join(sorted(known)), hint=nearest(name, known)
            )
