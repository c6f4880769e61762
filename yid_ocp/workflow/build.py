"""Functions that build the system of a run from its settings, and compile its time step."""

from __future__ import annotations

import fnmatch
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from yid_ocp.config.reader import load_config
from yid_ocp.config.settings import EffectSettings, ParameterSettings, RunSettings
from yid_ocp.data.channel_checks import typical_point_pair_distances
from yid_ocp.data.recording import Recording
from yid_ocp.effects import EffectBase, make_effect
from yid_ocp.effects.base import arm_joint_names
from yid_ocp.effects.bodies import system_with_mass_scale_parameters
from yid_ocp.effects.friction import (
    EFFECT_KINDS_BY_FRICTION_LAW,
    TORQUE_DRIVEN_SIGN_SMOOTHING_SPEED,
    effect_with_sign_smoothing_speed,
    lower_smoothing_speed_to_joint_min,
)
from yid_ocp.effects.law import read_torque_law_tables, torque_law_from_tables
from yid_ocp.errors import ConfigError, DataError, YidError, unknown_name_error_arguments
from yid_ocp.integrator.step import Step, compile_step
from yid_ocp.model import FlexibleObject, Grasp, Mechanism, Parameter, System
from yid_ocp.model.flexible import ROOT_ROTATION_PARAMETERS
from yid_ocp.model.mechanism import Frame, Placement, rotation_from_rpy, transform_from_xyz_rpy
from yid_ocp.model.mjcf_robot import mjcf_joint_constants
from yid_ocp.model.objects.base import CableVertices, ObjectBuilder
from yid_ocp.model.parameters import Parameters
from yid_ocp.model.servos_and_springs import MOTOR_PRESETS, StiffnessAndRest
from yid_ocp.model.urdf import read_urdf, urdf_path_from_robot_name
from yid_ocp.problem.options import SensorOptions
from yid_ocp.workflow import run_inputs

_OBJECT_DAMPING_KEY = "object"  # key of the object's damping, next to the joints' keys
_DEFAULT_JOINT_DAMPING = 0.05  # damping of joints without an entry [N m s/rad]
_LINK_MASS_PARAMETER = "mass_scale"  # factor on mass and inertia of the link that a joint moves
_AXES = "xyz"
_PRESET_RELATIVE_STD = 0.25  # std of published motor constants, which differ by 10 to 40 % between friction laws
_OTHER_SIDE = {"left": "right", "right": "left"}


def build_system(run: RunSettings, link_division: int = 1) -> System:
    """Build the mechanical model of a run. Parameters have the values and bounds of the settings.

    Each of the object's links is divided into `link_division` links with the same stiffness and damping in total; edges
    of a cable are not divided. Raises `ConfigError` or `ModelError`, with the setting, if a name does not exist or a
    value is outside its bounds.
    """
    model, arms = run.model, run.model.arms
    run_inputs.input_files_by_name(run)
    run_inputs.load_plugins(run)
    if (cable := cable_vertices_between_clamps(run)) is not None:
        return _completed(run, _clamped_system(run, cable))
    robot = None
    if model.robot is not None:
        try:
            robot = read_urdf(model.robot, **urdf_reader_arguments(run))
        except YidError as error:
            with run_inputs.add_setting_location_to_errors(run, "model", "robot"):
                read_urdf(model.robot)  # an error of the file itself
            with run_inputs.add_setting_location_to_errors(run, "model", "arms", "joints"):
                raise error
    joints = () if robot is None else robot.joint_names
    damping, of_object = _dampings(run, joints)
    item = model.object
    with run_inputs.add_setting_location_to_errors(run, "model", "object"):
        objects = (
            [] if item is None else [(_built_object(item, of_object, link_division), *item.parent_frame_and_root_pose)]
        )
    mode = "driven" if are_arm_states_estimated(run) else arms.mode
    run_inputs.check_names_in_setting(run, "joint", arms.passive_joints, joints, "model", "arms", "passive_joints")
    moved = tuple(name for name in joints if name not in arms.passive_joints)
    for key in ("joints", "passive_joints", "locked_joints"):
        if getattr(arms, key) and robot is None:
            hint = "set model.robot to a URDF file, or remove model.arms"
            what, allowed = f"model.arms.{key} names joints, but the model has no robot", "joints of a robot"
            raise run.config_error(what, "model", "arms", key, allowed=allowed, hint=hint)
    if robot is None and not objects:
        what, allowed = "the model has neither a robot nor an object", "a robot, an object or both"
        hint = "set model.robot or model.object" + ("" if run.key_locations else "; the configuration is empty")
        raise run.config_error(what, "model", allowed=allowed, hint=hint)
    with run_inputs.add_setting_location_to_errors(run, "model", "frames"):
        carrier, items = _with_extra_frames(run, robot, [item for item, *_ in objects])
    with run_inputs.add_setting_location_to_errors(run, "model", "object", "mount", "parent_frame"):
        _ = [carrier.frame(frame) for _, frame, _ in objects if carrier is not None and frame]
    with run_inputs.add_setting_location_to_errors(run, "model"):
        system = System.build(
            carrier,
            objects=[(item, frame, place) for item, (_, frame, place) in zip(items, objects, strict=True)],
            grasps=[
                Grasp(name, s.holder_frame, s.held_frame, s.kind, ca.SX(ca.DM(rotation_from_rpy(*s.held_frame_rpy))))
                for name, s in model.grasp.items()
            ],
            driven=moved if mode in ("driven", "servo") else (),
            prescribed=moved if mode == "prescribed" else (),
            damping=damping,
            gravity=model.gravity,
            point_frames=model.measured_points,
            springs={name: StiffnessAndRest(s.stiffness, s.rest_position) for name, s in model.joint_springs.items()},
            servos=arms.servo if mode == "servo" else None,
        )
    if any(said.use_recorded_straight_position for said in model.frames.values()) and run.recordings.estimate:
        # marker positions if no recording is specified
        [places] = marker_position_values_by_recording(
            run, system, run_inputs.read_recordings_of_role(run, count=1)
        ).values()
        system = replace(system, parameters=system.parameters.with_nominal_values(places))
    return _completed(run, system, link_division)


def _built_object(item: ObjectBuilder, damping: float, link_division: int) -> FlexibleObject:
    built = item.build(damping, link_division)
    return built if item.root_rotation_std == 0 else built.with_root_rotation_parameters()


def urdf_reader_arguments(run: RunSettings) -> dict[str, Any]:
    """Return the arguments of `read_urdf` that select the joints and links of the robot that a run uses."""
    arms = run.model.arms
    return {"joints": arms.joints, "locked": arms.locked_joints, "exclude_links": arms.exclude_links}


def build_step(run: RunSettings, system: System | None = None) -> Step:
    """Compile the discrete Euler-Lagrange step of a run's system."""
    said, system = run.problem, build_system(run) if system is None else system
    rule = said.force_split, said.constraint_force_at
    return compile_step(system, said.time_step_or_10_ms, *rule, use_compiler=said.use_compiler)


def load_system(path: str | Path, overrides: Sequence[str] = ()) -> System:
    """Build the system of a configuration file. Raises `ConfigError`, `DataError` or `ModelError` for a fault in it."""
    return build_system(load_config(path, overrides))


def cable_vertices_between_clamps(run: RunSettings) -> CableVertices | None:
    """Return the measured vertices and clamps of a run's cable. None for an object that is not held by clamps."""
    with run_inputs.add_setting_location_to_errors(run, "model", "object"):
        return None if run.model.object is None else run.model.object.clamped_cable_vertices()


def are_arm_states_estimated(run: RunSettings) -> bool:
    """Return whether arms of `mode: prescribed` are simulated as driven by measured torques, with estimated states.

    This needs a grasp, no object mounted on an arm, and recorded efforts. The encoders then correct the states. Arms
    with sensors on links remain prescribed, because such sensors cannot be weighted under process noise.
    """
    item = run.model.object
    if run.model.arms.mode != "prescribed" or not run.model.grasp or (item and item.parent_frame_and_root_pose[0]):
        return False
    recordings = run_inputs.read_recordings_of_role(run)
    mounted = [key for recording in recordings for key, *_ in recording.mounted_sensor_channels]
    if any(run.sensors.get(key, SensorOptions()).use is not False for key in mounted):
        return False
    return bool(recordings) and all(r.joints is not None and r.joints.effort is not None for r in recordings)


def _dampings(run: RunSettings, joints: Sequence[str]) -> tuple[dict[str, float], float]:
    said, has_object = run.model.damping, run.model.object is not None
    of_file = {name: own["damping"] for name, own in _robot_file_constants(run).items() if "damping" in own}
    if isinstance(said, Mapping):
        known = (*joints, _OBJECT_DAMPING_KEY) if has_object else joints
        run_inputs.check_names_in_setting(run, "joint", said, known, "model", "damping")
        if has_object and _OBJECT_DAMPING_KEY not in said:
            allowed = f"joints of the robot and `{_OBJECT_DAMPING_KEY}`, for all joints of the object"
            what = "model.damping lists dampings of joints, but not that of the object"
            hint = f"set model.damping.{_OBJECT_DAMPING_KEY}, for example to {_DEFAULT_JOINT_DAMPING:g} N m s/rad"
            raise run.config_error(what, "model", "damping", allowed=allowed, hint=hint)
        of_object = said.get(_OBJECT_DAMPING_KEY, _DEFAULT_JOINT_DAMPING)
        damping = {name: said.get(name, of_file.get(name, _DEFAULT_JOINT_DAMPING)) for name in joints}
    else:
        damping, of_object = {name: of_file.get(name, said) for name in joints}, said
    springs = run.model.joint_springs
    run_inputs.check_names_in_setting(run, "joint", springs, joints, "model", "joint_springs")
    return damping | {name: own.damping for name, own in springs.items() if own.damping is not None}, of_object


def _clamped_system(run: RunSettings, cable: CableVertices) -> System:
    assert run.model.object is not None
    kind = run.model.object.kind
    for key in ("robot", "grasp", "joint_springs", "frames"):
        if getattr(run.model, key):
            what, allowed = f"model.{key} is not possible for an object of kind {kind}, which clamps hold", f"no {key}"
            raise run.config_error(what, "model", key, allowed=allowed, hint=f"remove model.{key}")
    recordings = run_inputs.read_recordings_of_role(run)
    if not recordings:
        what, hint = f"the lengths of a {kind} are computed from recordings, but none is listed", "list its recordings"
        raise run.config_error(what, "recordings", "estimate", allowed="one recording or more", hint=hint)
    with run_inputs.add_setting_location_to_errors(run, "model", "object"):
        lengths = typical_point_pair_distances(cable.edge_vertex_names, recordings)
        return run.model.object.build_system_with_clamps(lengths, run.model.gravity)


def _completed(run: RunSettings, system: System, link_division: int = 1) -> System:
    """The system with uncertain link masses, the effects, and the parameter values of the settings."""
    if run.model.arms.relative_link_mass_std > 0:
        system = system_with_mass_scale_parameters(system, _LINK_MASS_PARAMETER)
    named = {said.label for said in run.model.effects}
    for joint in friction_joint_names(run, system):
        assert run.model.friction is not None
        kinds, speed = EFFECT_KINDS_BY_FRICTION_LAW[run.model.friction.law], run.model.friction.sign_smoothing_speed
        if speed is None and joint in system.driven and joint not in system.servos:
            speed = TORQUE_DRIVEN_SIGN_SMOOTHING_SPEED
        made = [make_effect(kind, joint, system) for kind in kinds if f"{kind}@{joint}" not in named]
        system = system.with_effects([effect_with_sign_smoothing_speed(effect, speed) for effect in made])
    for i, said in enumerate(run.model.effects):
        with run_inputs.add_setting_location_to_errors(run, "model", "effects", i):
            system = system.with_effects([_stated_effect(said, system)])
    system = _with_robot_file_constants(run, system)
    chosen, entries = settings_by_parameter_name(run, system.parameters), []
    for entry in system.parameters:
        if entry.name in chosen:
            given, factor = chosen[entry.name], link_division_parameter_scale(run, entry.name, link_division)
            lower, upper = (entry.lower, entry.upper) if given.bounds is None else (factor * b for b in given.bounds)
            value = entry.value if given.initial is None else factor * given.initial
            key = ([key for key in run.parameters if _matches(entry.name, key)] or [entry.name])[-1]
            if lower < entry.lower or upper > entry.upper or lower > upper:
                low, high = max(lower, entry.lower) / factor, min(upper, entry.upper) / factor
                fault = "reversed" if lower > upper else "too low" if lower < entry.lower else "too high"
                hint = f"set parameters.{key}.bounds to [{low:g}, {high:g}]".replace(" inf", " .inf")
                hint = "exchange the numbers" if lower > upper else hint if low <= high else "use allowed numbers"
                what = f"the bounds {lower:g} to {upper:g} {entry.unit} of {entry.name} are {fault}"
                allowed = f"two numbers from {entry.lower:g} to {entry.upper:g} {entry.unit}, the lower one first"
                raise run.config_error(what, "parameters", key, "bounds", allowed=allowed, hint=hint)
            with run_inputs.add_setting_location_to_errors(run, "parameters", key, "initial"):
                entry = replace(entry, value=value, lower=lower, upper=upper)
        entries.append(entry)
    return replace(system, parameters=Parameters(entries))


def _stated_effect(said: EffectSettings, system: System) -> EffectBase:
    if said.kind != "law":
        if said.law_csv is not None or said.depends_on is not None:
            what, where = "only an effect of kind: law has `law_csv` and `depends_on`", said.label
            allowed, hint = f"kind: {said.kind} with `location` and `values`", "remove both keys, or set kind: law"
            raise ConfigError(what, where=where, allowed=allowed, hint=hint)
        made = make_effect(said.kind, said.location, system, dict(said.values))
        return lower_smoothing_speed_to_joint_min(made, system)
    if said.law_csv is None or said.depends_on is None or said.values:
        fault = "has `values`" if said.values else "has no `law_csv`" if said.law_csv is None else "has no `depends_on`"
        where, allowed = f"law@{said.location}", "law_csv: FILE.csv and depends_on: QUANTITY, without `values`"
        raise ConfigError(f"the law {fault}", where=where, allowed=allowed, hint="write these two keys and no `values`")
    return torque_law_from_tables(said.location, system, read_torque_law_tables(Path(said.law_csv), said.depends_on))


def _with_robot_file_constants(run: RunSettings, system: System) -> System:
    """The system with armature, dry friction and servos of an MJCF file; settings and a friction law override these."""
    present = {said.label for said in run.model.effects if said.values}
    kinds = {"armature": ("rotor_inertia", "armature"), "frictionloss": ("joint_coulomb", "tau_c")}
    for joint, own in _robot_file_constants(run).items():
        if joint not in (*system.driven, *system.prescribed):
            continue
        values = {f"{joint}.{key}": own[key] for key in ("servo_gain", "servo_damping") if key in own}
        for key in kinds.keys() & own.keys():
            kind, parameter = kinds[key]
            name = f"{kind}@{joint}"
            is_replaced_by_law = key == "frictionloss" and joint in friction_joint_names(run, system)
            if f"{name}.{parameter}" not in system.parameters and not is_replaced_by_law:
                system = system.with_effects([make_effect(kind, joint, system)])
            values |= {f"{name}.{parameter}": own[key]} if name not in present else {}
        values = {name: value for name, value in values.items() if name in system.parameters}
        system = replace(system, parameters=system.parameters.with_nominal_values(values))
    return system


def _robot_file_constants(run: RunSettings) -> dict[str, dict[str, float]]:
    return {} if run.model.robot is None else mjcf_joint_constants(urdf_path_from_robot_name(run.model.robot))


def _matches(name: str, key: str) -> bool:
    return name == key or fnmatch.fnmatchcase(name, key)


def settings_by_parameter_name(run: RunSettings, parameters: Parameters) -> dict[str, ParameterSettings]:
    """Return the settings of every parameter that a name or pattern matches. Later keys override earlier ones.

    Settings implied by `model.friction`, `model.arms.servo.motor`, `model.arms.relative_link_mass_std`, the object's
    `mount.rotation_std` and the frames' `position_std` count if no key overrides them, and stand last. Raises
    `ConfigError` if a name or pattern matches nothing.
    """
    sections = _section_parameter_settings(run, parameters)
    result: dict[str, ParameterSettings] = {}
    for key, given in run.parameters.items():
        matches = [name for name in parameters.names if _matches(name, key)]
        if not matches:
            split = [name.rpartition(".") for name in parameters.names]
            owner = key.rpartition(".")[0]  # for a pattern such as T*.bend, patterns are proposed
            alike = dict.fromkeys(f"{owner}.{end}" for own, _, end in split if "*" in owner and _matches(own, owner))
            error = run_inputs.unknown_name_error(run, "parameter", key, alike or parameters.names, "parameters", key)
            if ".servo_" in key and run.model.arms.mode != "servo":
                error.hint = f"set model.arms.mode: servo, which has this parameter, or delete parameters.{key}"
            raise error
        said = {name: value for name, value in vars(given).items() if value is not None}
        known = {name: result.get(name, sections.get(name, ParameterSettings())) for name in matches}
        result |= {name: replace(own, **said) for name, own in known.items()}
    result |= {name: own for name, own in sections.items() if name not in result}
    # a fixed parameter has the published value without a prior
    fixed = (name for name in sections if not result[name].free)
    return result | {name: replace(result[name], prior_std=None) for name in fixed}


def friction_joint_names(run: RunSettings, system: System) -> tuple[str, ...]:
    """Return the joints with friction: those in `model.friction`, or all arm joints. Empty without that section."""
    if run.model.friction is None:
        return ()
    known = tuple(name for name in arm_joint_names(system) if name in system.joint_damping)
    chosen = known if run.model.friction.joints is None else run.model.friction.joints
    run_inputs.check_names_in_setting(run, "joint", chosen, known, "model", "friction", "joints")
    return chosen


def friction_parameter_names(run: RunSettings, parameters: Parameters) -> list[str]:
    """List the parameters of a run's joint friction, including joint damping."""
    if run.model.friction is None:
        return []
    wanted = run.model.friction.joints
    arms = {name.rpartition(".")[0] for name in parameters.names if name.endswith(".damping")}
    arms = {name for name in arms if parameters[f"{name}.damping"].description.endswith(f"of {name}")}  # no segments
    joints = arms if wanted is None else arms & set(wanted)
    kinds = EFFECT_KINDS_BY_FRICTION_LAW[run.model.friction.law]
    starts = tuple(f"{kind}@{joint}." for kind in kinds for joint in joints)
    dampings = {f"{joint}.damping" for joint in joints}
    return [name for name in parameters.names if name in dampings or name.startswith(starts)]


def _section_parameter_settings(run: RunSettings, parameters: Parameters) -> dict[str, ParameterSettings]:
    """Parameter settings implied by sections of the model: free friction, and priors of motors and link masses."""
    found: dict[str, ParameterSettings] = {}
    friction, motor = run.model.friction, run.model.arms.servo.motor
    values: dict[str, float] = {}
    if motor.preset is not None and run.model.arms.mode == "servo":
        data = MOTOR_PRESETS[motor.preset]
        by_load = data.load_dependent if friction is not None and friction.law.startswith("load") else None
        constants = data.plain if by_load is None else by_load
        for joint in (name.rpartition(".")[0] for name in parameters.names if name.endswith(".servo_gain")):
            own = {f"{joint}.{name}": value for name, value in data.servo_values(constants).items()}
            own[f"rotor_inertia@{joint}.armature"] = data.armature
            for name in filter(parameters.names.__contains__, own):
                found[name] = ParameterSettings(initial=own[name], prior_std=_PRESET_RELATIVE_STD * own[name])
            if friction is not None:
                values |= {
                    f"{joint}.damping": constants.viscous,
                    f"joint_coulomb@{joint}.tau_c": constants.coulomb,
                    f"joint_load_friction@{joint}.share": constants.load_share,
                    f"joint_stribeck@{joint}.tau_s": constants.stribeck,
                }
    for name in friction_parameter_names(run, parameters):
        found[name] = ParameterSettings(free=True, initial=values.get(name))
    if run.model.arms.relative_link_mass_std > 0:
        masses = [name for name in parameters.names if name.endswith(f".{_LINK_MASS_PARAMETER}")]
        found |= dict.fromkeys(masses, ParameterSettings(free=True, prior_std=run.model.arms.relative_link_mass_std))
    if run.model.object is not None and (std := run.model.object.root_rotation_std) > 0:
        found |= dict.fromkeys(ROOT_ROTATION_PARAMETERS, ParameterSettings(free=True, prior_std=std))
    for frame, said in run.model.frames.items():
        if said.position_std > 0:
            names = [f"{frame}.{axis}" for axis in _AXES]
            found |= dict.fromkeys(names, ParameterSettings(free=True, prior_std=said.position_std))
    return found


def free_parameter_names(run: RunSettings, parameters: Parameters) -> list[str]:
    """Return the names of the parameters that the settings declare to be estimated."""
    return [name for name, said in settings_by_parameter_name(run, parameters).items() if said.free]


def link_division_parameter_scale(run: RunSettings, name: str, link_division: int) -> int:
    """Return the factor on a parameter that keeps the object's stiffness if each link becomes `link_division` links."""
    item = run.model.object
    return 1 if item is None else item.link_division_parameter_factor(name, link_division)


def system_with_second_arm_holding_object(run: RunSettings, system: System) -> System | None:
    """Return the run's system with the other arm holding a free end of the object. None without such an arm or end."""
    model, joints = run.model, run.model.arms.joints
    if joints is None or model.arms.mode != "driven" or len(model.grasp) != 1:
        return None
    side, grasp = next(iter(model.grasp.items()))
    if side not in _OTHER_SIDE or not all(name.startswith(f"{side}_") for name in (*joints, grasp.holder_frame)):
        return None
    parents = {segment.parent_segment for segment in system.segment_layouts}
    ends = [f"w_{segment.name}" for segment in system.segment_layouts if segment.name not in parents]
    free = [end for end in ends if end != grasp.held_frame]
    if not free:
        return None
    other = _OTHER_SIDE[side]
    mirrored, holder = ([f"{other}{name.removeprefix(side)}" for name in own] for own in (joints, [grasp.holder_frame]))
    added = replace(grasp, holder_frame=holder[0], held_frame=free[0])
    arms = replace(model.arms, joints=(*joints, *mirrored))
    try:
        return build_system(replace(run, model=replace(model, arms=arms, grasp={**model.grasp, other: added})))
    except YidError:
        return None  # the robot has no other arm of that name


def _with_extra_frames(
    run: RunSettings, carrier: Mechanism | None, items: Iterable[FlexibleObject]
) -> tuple[Mechanism | None, list[FlexibleObject]]:
    """Robot and objects with the additional frames of the settings.

    A frame of uncertain position, or located by `marker_position_values_by_recording`, has parameters NAME.x, .y, .z.
    """
    made = list(items)
    for name, said in run.model.frames.items():
        where, parent = ("model", "frames", name), said.parent_frame
        owner = next((i for i, item in enumerate(made) if parent and item.mechanism.has_frame(parent)), None)
        if owner is not None:
            tree = made[owner].mechanism
        elif said.use_recorded_straight_position:
            what = f"'{name}' has `use_recorded_straight_position`, but its parent is not a frame of the object"
            allowed = "a frame of the object, such as w_SEGMENT, its end, or SEGMENT:40%"
            raise run.config_error(what, *where, allowed=allowed, hint=f"set model.frames.{name}.parent_frame to one")
        else:
            tree = Mechanism("world", (), {}) if carrier is None else carrier
            if parent is not None and not tree.has_frame(parent):
                known = [*tree.frames, *(frame for item in made for frame in item.mechanism.frames)]
                known += [f"{segment}:40%" for item in made for segment in item.mechanism.link_chains]
                raise run_inputs.unknown_name_error(run, "frame", parent, known, *where, "parent_frame")
        pose = np.eye(4) if said.use_recorded_straight_position else transform_from_xyz_rpy(said.xyz, said.rpy)
        tree = tree.with_added_frame(name, parent, pose)
        if said.use_recorded_straight_position or said.position_std > 0:
            words = [(axis, f"{axis} of {name} in {parent}") for axis in _AXES]
            entries = [Parameter(f"{name}.{axis}", 0.0, "m", description=text) for axis, text in words]
            offset = Placement(ca.SX(ca.DM.eye(3)), ca.vertcat(*(entry.symbol for entry in entries)))
            frame = Frame(tree.frames[name].joint_index, tree.frames[name].placement @ offset)
            tree = replace(tree, frames={**tree.frames, name: frame}, parameters=tree.parameters.with_added(entries))
        if owner is None:
            carrier = tree
        else:
            made[owner] = replace(made[owner], mechanism=tree)
    return carrier, made


def marker_position_values_by_recording(
    run: RunSettings, system: System, recordings: Iterable[Recording]
) -> dict[str, dict[str, float]]:
    """Return parameter values for marker positions on the object [m], by recording, from its pose when straight.

    Empty if no frame has `use_recorded_straight_position`. Raises `ConfigError` if the object is not fixed in the world
    or a marker is not a point of a recording, and `DataError` if a recording has no `straight` positions.
    """
    names = [name for name, said in run.model.frames.items() if said.use_recorded_straight_position]
    if not names:
        return {}
    if run.model.object is not None and not run.model.object.is_root_fixed_in_world:
        what = f"the object's mount moves, so positions of the straight object do not determine the frame {names[0]}"
        where = ("model", "frames", names[0], "use_recorded_straight_position")
        hint, allowed = f"set model.frames.{names[0]}.xyz: [x, y, z] [m] instead", "an object with a mount in the world"
        raise run.config_error(what, *where, allowed=allowed, hint=hint)
    q, kinematics = system.symbols_and_kinematics
    poses = [kinematics.frame_pose(name).homogeneous_matrix() for name in names]
    function = ca.Function("straight", [q, system.parameters.symbols], [ca.horzcat(*poses)])
    theta = system.parameters.vector({f"{name}.{axis}": 0.0 for name in names for axis in _AXES})
    placed = np.split(np.array(function(np.zeros(system.n_coordinates), theta)), len(names), axis=1)
    found: dict[str, dict[str, float]] = {}
    for recording in recordings:
        group = recording.points[0].names if recording.points else ()
        if recording.marker_reference_pose is None:
            hint = f"record them, or give model.frames.{names[0]}.xyz in place of use_recorded_straight_position: true"
            what = f"the recording has no marker positions of the straight object, from which {names[0]} is placed"
            allowed = "a dataset `straight`: positions of all points of the first group, shape (np, 3) [m]"
            raise DataError(what, where=f"recording '{recording.name}': straight", allowed=allowed, hint=hint)
        found[recording.name] = {}
        for name, pose in zip(names, placed, strict=True):
            if name not in group:
                what = f"recording '{recording.name}' lacks the point '{name}', where the frame of this name is placed"
                hint = "rename the frame to a recorded point, or set its xyz: [x, y, z] instead"
                allowed = unknown_name_error_arguments(name, group)["allowed"]
                raise run.config_error(what, "model", "frames", name, allowed=allowed, hint=hint)
            local = pose[:3, :3].T @ (recording.marker_reference_pose[group.index(name)] - pose[:3, 3])
            found[recording.name] |= {f"{name}.{axis}": float(x) for axis, x in zip(_AXES, local, strict=True)}
    return found
