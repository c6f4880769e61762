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
    CableSettings,
    FoamYSettings,
    GraspSettings,
    MountSettings,
    ParameterSettings,
    RunSettings,
    SegmentedObjectSettings,
)
from yid_ocp.data.channel_checks import median_edge_lengths
from yid_ocp.effects import make_effect
from yid_ocp.errors import ModelError, YidError, nearest_name_hint
from yid_ocp.integrator.step import Step, compile_step
from yid_ocp.model import FlexibleObject, Grasp, Mechanism, Segment, System, flexible_object
from yid_ocp.model.cable import CableTopology, cable_system, read_vertex_positions
from yid_ocp.model.parameters import Parameters
from yid_ocp.model.rotations import rotation_from_rpy, transform_from_xyz_rpy
from yid_ocp.model.servos_and_springs import PositionServoOptions, RobotJointSpring
from yid_ocp.model.urdf import read_urdf
from yid_ocp.model.y_object import Y_FOOT_POSITION, y_segments
from yid_ocp.workflow.clamps import clamp_mechanism, marker_parameter_values, with_extra_frames
from yid_ocp.workflow.run_inputs import (
    input_files,
    load_plugins,
    locate_errors,
    read_recordings,
)

_OBJECT_DAMPING_KEY = "object"  # key of the object's damping beside those of the joints
_PER_JOINT_QUANTITIES = ("bend", "twist", "damping", "twist_damping")
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
