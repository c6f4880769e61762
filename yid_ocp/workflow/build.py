"""Builds the system of a run, its parameters and its compiled step."""

from __future__ import annotations

import fnmatch
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np

from yid_ocp.config.reader import load_config
from yid_ocp.config.settings import (
    GraspSettings,
    ParameterSettings,
    RunSettings,
)
from yid_ocp.data.channel_checks import median_edge_lengths
from yid_ocp.effects import make_effect
from yid_ocp.errors import YidError, nearest_name_hint
from yid_ocp.integrator.step import Step, compile_step
from yid_ocp.model import FlexibleObject, Grasp, Mechanism, System
from yid_ocp.model.objects.base import CableTopology, ClampedObject
from yid_ocp.model.parameters import Parameters
from yid_ocp.model.rotations import rotation_from_rpy
from yid_ocp.model.servos_and_springs import PositionServoOptions, RobotJointSpring
from yid_ocp.model.urdf import read_urdf
from yid_ocp.workflow.clamps import clamp_mechanism, marker_parameter_values, with_extra_frames
from yid_ocp.workflow.run_inputs import (
    input_files,
    load_plugins,
    locate_errors,
    read_recordings,
)

_OBJECT_DAMPING_KEY = "object"  # key of the object's damping beside those of the joints
_DEFAULT_JOINT_DAMPING = 0.05  # of joints that a damping by name does not mention [N m s/rad]
_PlacedObject = tuple[FlexibleObject, str | None, np.ndarray | None]


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
    if isinstance(model.object, ClampedObject):
        return _clamped_system(run, model.object)
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
    mode = "driven" if arms_are_estimated_states(run) else model.arms.mode
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


def arms_are_estimated_states(run: RunSettings) -> bool:
    """Whether prescribed arms become estimated states, driven by measured torques and corrected by encoders."""
    if run.model.arms.mode != "prescribed" or not run.model.grasp:
        return False
    recordings = read_recordings(run, "estimate")
    return bool(recordings) and all(r.joints is not None and r.joints.effort is not None for r in recordings)


def _dampings(run: RunSettings, joints: Sequence[str]) -> tuple[dict[str, float], float]:
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
    for i, said in enumerate(run.model.effects):
        with locate_errors(run, "model", "effects", i):
            system = system.with_effects([make_effect(said.kind, said.location, system, dict(said.values))])
    return replace(system, parameters=_set_parameters(run, system.parameters, finer))


def _clamped_system(run: RunSettings, item: ClampedObject) -> System:
    """The system of an object that brings its clamps."""
    cable = build_cable(run)
    assert run.model.object is not None
    assert cable is not None
    kind = run.model.object.kind
    for key in ("robot", "grasp", "springs", "clamps", "frames"):
        if getattr(run.model, key):
            what = f"a {kind} takes no {key}: its clamps hold it"
            raise run.config_error(what, "model", key, hint=f"remove {key}")
    recordings = read_recordings(run, "estimate")
    if not recordings:
        what = f"a {kind}'s lengths come from recordings"
        raise run.config_error(what, "recordings", "estimate", hint="list at least one")
    with locate_errors(run, "model", "object"):
        system = item.clamped_system(median_edge_lengths(cable.edges, recordings), run.model.gravity)
    return _completed(run, system)


def build_cable(run: RunSettings) -> CableTopology | None:
    """Measured vertices and clamps of a run's object that brings its clamps, None for another object."""
    with locate_errors(run, "model", "object"):
        return run.model.object.topology() if isinstance(run.model.object, ClampedObject) else None


def _robot(run: RunSettings) -> Mechanism | None:
    model = run.model
    if model.robot is None:
        return None
    with locate_errors(run, "model", "arms", "joints"):
        arms = model.arms
        return read_urdf(model.robot, joints=arms.joints, locked=arms.locked_joints, exclude_links=arms.exclude_links)


def _objects(run: RunSettings, damping: float, link_division: int) -> list[_PlacedObject]:
    item = run.model.object
    return [] if item is None else [(item.build(damping, link_division), *item.placement)]


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
    item = run.model.object
    return 1 if item is None else item.link_division_factor(name, link_division)


def _key_of(run: RunSettings, name: str) -> str:
    keys = [key for key in run.parameters if key == name or fnmatch.fnmatchcase(name, key)]
    return keys[-1] if keys else name


# -- data and problem -------------------------------------------------------------------------------------------------


def build_step(run: RunSettings, system: System | None = None) -> Step:
    """The compiled step of a run."""
    said = run.problem
    system = build_system(run) if system is None else system
    return compile_step(system, said.time_step, said.force_split, said.constraint_force, use_compiler=said.use_compiler)


# -- from a file -----------------------------------------------------------------------------------------------------


def load_system(path: str | Path, overrides: Sequence[str] = ()) -> System:
    """The system that a configuration file describes; errors as `load_config` and `build_system`."""
    return build_system(load_config(path, overrides))


# -- the second arm ---------------------------------------------------------------------------------------------------

_OTHER_SIDE = {"left": "right", "right": "left"}


def system_with_second_arm(run: RunSettings, system: System) -> System | None:
    """The run's system with the second arm at a free end of the object; None where impossible."""
    model = run.model
    joints = model.arms.joints
    if joints is None or model.arms.mode != "driven" or len(model.grasp) != 1:
        return None
    side, grasp = next(iter(model.grasp.items()))
    prefix = f"{side}_"
    if side not in _OTHER_SIDE or not all(name.startswith(prefix) for name in (*joints, grasp.holder_frame)):
        return None
    parents = {segment.parent_segment for segment in system.segment_layouts}
    free = [
        f"w_{s.name}" for s in system.segment_layouts if s.name not in parents and f"w_{s.name}" != grasp.held_frame
    ]
    if not free:
        return None

    def mirrored(name: str) -> str:
        return f"{_OTHER_SIDE[side]}_{name.removeprefix(prefix)}"

    arms = replace(model.arms, joints=(*joints, *(mirrored(name) for name in joints)))
    added = GraspSettings(holder_frame=mirrored(grasp.holder_frame), held_frame=free[0], kind=grasp.kind, rpy=grasp.rpy)
    changed = replace(model, arms=arms, grasp={**model.grasp, _OTHER_SIDE[side]: added})
    try:
        return build_system(replace(run, model=changed))
    except YidError:
        # the robot has no other arm of that name
        return None
