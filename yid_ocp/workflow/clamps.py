"""Clamps that hold an object without a robot, and additional frames such as markers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import casadi as ca
import numpy as np

from yid_ocp.config.settings import RunSettings
from yid_ocp.data.recording import Recording
from yid_ocp.errors import DataError, nearest_name_hint
from yid_ocp.model import FlexibleObject, Mechanism, Parameter, System, forward_kinematics
from yid_ocp.model.mechanism import Frame, Placement
from yid_ocp.model.objects.base import CableTopology, ClampPath
from yid_ocp.model.rotations import transform_from_xyz_rpy
from yid_ocp.model.system import floating_clamp

_AXES = "xyz"


def clamp_paths(run: RunSettings, cable: CableTopology | None) -> tuple[ClampPath, ...]:
    """Clamps and the measured points that they follow, from the settings or from the cable."""
    if cable is not None:
        return cable.clamp_paths
    return tuple(
        ClampPath(name, s.origin_point, s.z_axis_point, s.roll_convention) for name, s in run.model.clamps.items()
    )


def clamp_mechanism(run: RunSettings) -> Mechanism | None:
    """Mechanism of the clamps that move an object without a robot; None without clamps.

    Raises
    ------
    ConfigError
        Clamps beside a robot, settings of a robot's joints without one.
    """
    model = run.model
    if model.robot is not None:
        if model.clamps:
            hint = "remove model.clamps, or set model.robot: null; a robot holds by model.grasp or by the mount"
            raise run.config_error(
                "clamps hold an object without a robot, and the model has one", "model", "clamps", hint=hint
            )
        return None
    said = model.arms
    for key, given in (("joints", said.joints), ("passive", said.passive_joints), ("locked", said.locked_joints)):
        if given:
            hint = "set model.robot to its URDF file, or remove model.arms; the world or model.clamps hold an object"
            raise run.config_error(
                "the settings name joints, but the model has no robot", "model", "arms", key, hint=hint
            )
    found: Mechanism | None = None
    for name, clamp in model.clamps.items():
        if clamp.origin_point == clamp.z_axis_point:
            raise run.config_error(
                f"clamp '{name}' has one point for both ends", "model", "clamps", name, allowed="two different points"
            )
        found = floating_clamp(name) if found is None else found.with_mechanism(floating_clamp(name))
    return found


def with_extra_frames(
    run: RunSettings, carrier: Mechanism | None, items: Sequence[FlexibleObject]
) -> tuple[Mechanism | None, list[FlexibleObject]]:
    """Robot (or clamps) and objects with the additional frames of the settings.

    A frame whose place the recordings tell has the parameters NAME.x, .y, .z; see `marker_parameter_values`.

    Raises
    ------
    ConfigError
        What carries a frame does not exist.
    ModelError
        A name that is taken.
    """
    made = list(items)
    for name, said in run.model.frames.items():
        where = ("model", "frames", name)
        owner = next(
            (i for i, item in enumerate(made) if said.parent_frame and item.mechanism.has_frame(said.parent_frame)),
            None,
        )
        tree = carrier if owner is None else made[owner].mechanism
        if owner is None:
            if said.marker_reference_pose:
                what = f"'{name}' is placed by `marker_reference_pose`, but sits on nothing of the object"
                allowed = "a frame of the object, such as w_SEGMENT, its end, or SEGMENT:40%"
                raise run.config_error(what, *where, allowed=allowed, hint=f"set model.frames.{name}.parent_frame")
            tree = Mechanism("world", (), {}) if tree is None else tree
            known = [*tree.frames, *(frame for item in made for frame in item.mechanism.frames)]
            if said.parent_frame is not None and not tree.has_frame(said.parent_frame):
                hint = nearest_name_hint(said.parent_frame, known)
                raise run.config_error(f"there is no frame '{said.parent_frame}'", *where, "parent_frame", hint=hint)
        assert tree is not None
        if said.marker_reference_pose:
            tree = _marked(tree, name, str(said.parent_frame))
        else:
            tree = tree.with_frame(name, said.parent_frame, transform_from_xyz_rpy(said.xyz, said.rpy))
        if owner is None:
            carrier = tree
        else:
            made[owner] = replace(made[owner], mechanism=tree)
    return carrier, made


def _marked(tree: Mechanism, name: str, frame: str) -> Mechanism:
    """The mechanism with a frame at a parameter's place in another one, turned like it."""
    carrier = tree.with_frame(name, frame, np.eye(4)).frames[name]
    entries = [Parameter(f"{name}.{axis}", 0.0, "m", description=f"{axis} of {name} in {frame}") for axis in _AXES]
    offset = Placement(ca.SX(ca.DM.eye(3)), ca.vertcat(*(entry.symbol for entry in entries)))
    frames = {**tree.frames, name: Frame(carrier.joint_index, carrier.placement @ offset)}
    return replace(tree, frames=frames, parameters=tree.parameters.with_added(entries))


def marker_parameter_values(
    run: RunSettings, system: System, recordings: Sequence[Recording]
) -> dict[str, dict[str, float]]:
    """Marker positions on the object per recording, as parameter values, from its straight reference pose [m].

    Parameters
    ----------
    system : System
        Whose object stands in the world; without its weight it is straight.

    Returns
    -------
    dict of recording to dict of parameter to value
        Empty where no frame is placed so.

    Raises
    ------
    ConfigError
        The object does not stand in the world, or a marker is no point of a recording.
    DataError
        A recording without `straight`.
    """
    names = [name for name, said in run.model.frames.items() if said.marker_reference_pose]
    if not names:
        return {}
    _check_standing(run, names[0])
    q = ca.SX.sym("q", system.n_coordinates)
    kinematics = forward_kinematics(system.mechanism, q)
    poses = [kinematics.frame_pose(name) for name in names]
    outputs = [out for pose in poses for out in (pose.rotation, pose.translation)]
    function = ca.Function("straight", [q, system.parameters.symbols], outputs)
    theta = system.parameters.vector({f"{name}.{axis}": 0.0 for name in names for axis in _AXES})
    placed = [np.array(out) for out in function(np.zeros(system.n_coordinates), theta)]
    found: dict[str, dict[str, float]] = {}
    for recording in recordings:
        group = recording.points[0].names if recording.points else ()
        if recording.marker_reference_pose is None:
            hint = f"record them, or give model.frames.{names[0]}.xyz in place of marker_reference_pose: true"
            what = "the recording does not say where its markers were while the object was held straight"
            allowed = "positions of the points of its first group, shape (np, 3) [m]"
            raise DataError(what, where=f"{recording.name}: straight", allowed=allowed, hint=hint)
        values: dict[str, float] = {}
        for i, name in enumerate(names):
            if name not in group:
                what = f"'{name}' is no point of {recording.name}"
                raise run.config_error(what, "model", "frames", name, hint=nearest_name_hint(name, group))
            rotation, origin = placed[2 * i], placed[2 * i + 1].ravel()
            local = rotation.T @ (recording.marker_reference_pose[group.index(name)] - origin)
            values |= {f"{name}.{axis}": float(x) for axis, x in zip(_AXES, local, strict=True)}
        found[recording.name] = values
    return found


def _check_standing(run: RunSettings, name: str) -> None:
    item = run.model.object
    if item is not None and not item.stands_in_world:
        what = "the object moves with what carries it, so `marker_reference_pose` does not say where it was"
        allowed = "an object whose mount stands in the world"
        hint = f"give model.frames.{name}.xyz instead"
        raise run.config_error(what, "model", "frames", name, "marker_reference_pose", allowed=allowed, hint=hint)
