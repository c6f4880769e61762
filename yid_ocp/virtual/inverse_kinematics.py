"""Inverse kinematics of the start: joint angles at which the grippers meet the points that they hold."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import least_squares

from yid_ocp.errors import ModelError
from yid_ocp.model.kinematics import forward_kinematics
from yid_ocp.model.mechanism import Mechanism, Placement
from yid_ocp.model.system import System
from yid_ocp.virtual.rigid_body_terms import ParameterEvaluator

Array = NDArray[np.float64]

BAXTER_ARM_JOINTS = ("s0", "s1", "e0", "e1", "w0", "w1", "w2")
_ELBOW_UP_ANGLES: Mapping[str, float] = {
    f"{side}_{joint}": sign * value if joint in ("s0", "e0", "w0", "w2") else value
    for side, sign in (("left", 1.0), ("right", -1.0))
    for joint, value in zip(BAXTER_ARM_JOINTS, (-0.40, -1.13, -0.15, 1.19, -0.08, 1.13, 0.0), strict=True)
}
"""Initial guess of Baxter's joint angles [rad]: elbow above the hand, the right arm mirrored."""

_PULL = 1e-5  # [m/rad]; moves the gripper by less than 1e-9 m


def grasping_joint_angles(
    system: System,
    values: Mapping[str, float] | None = None,
    *,
    start_angles: Mapping[str, float] | None = None,
    offsets: Mapping[str, ArrayLike] | None = None,
) -> dict[str, float]:
    """Arm joint angles at which every gripper meets the end of the undeformed object, or a point beside it.

    Only positions are matched; of several solutions one near the initial guess is returned.

    Parameters
    ----------
    system : System
        Those joints are sought that carry a grasp's holder and are not elastic.
    values : mapping of str to float, optional
        Parameter values; nominal where absent.
    start_angles : mapping of str to float, optional
        Start of the search by joint name [rad or m]. Where absent: `_ELBOW_UP_ANGLES` for Baxter, else the middle of the
        joint's range (zero when it has none).
    offsets : mapping of grasp to array_like, shape (3,), optional
        Where each gripper stands beside the undeformed tube end, in the world [m]. Two arms that hold a straight Y are
        at its full stretch, a singular posture: moving them towards it makes the start well defined.

    Returns
    -------
    dict of str to float
        Angle of every driven joint and every joint sought [rad or m], in configuration order.

    Raises
    ------
    ModelError
        The grasped points cannot be reached within the joint limits.
    """
    tree = replace(system.mechanism, parameters=system.parameters).with_numeric_values(values)
    value = ParameterEvaluator(system, values)
    posture = _undeformed(system, tree, value, {**_ELBOW_UP_ANGLES, **(start_angles or {})})
    elastic = {spring.joint_name for spring in system.elastic_joints}
    holding = {j for grasp in system.grasps for j in tree.ancestor_joints(tree.frame(grasp.holder_frame).joint_index)}
    sought = [j for j, joint in enumerate(tree.joints) if j in holding and joint.name not in elastic]
    if sought:
        gap = _gap_function(system, tree, value, offsets or {}, sought)
        posture = _reached(system, tree, posture, sought, gap)
    wanted = sorted(set(sought) | set(system.driven_indices))
    return {tree.joints[j].name: float(posture[j]) for j in wanted}


def _undeformed(system: System, tree: Mechanism, value: ParameterEvaluator, start: Mapping[str, float]) -> Array:
    """Configuration with the object at rest and the other joints where the search starts, shape (n,)."""
    posture = np.zeros(system.n_coordinates)
    for spring in system.elastic_joints:
        posture[tree.joint_index(spring.joint_name)] = value(spring.rest_angle)[0]
    elastic = {spring.joint_name for spring in system.elastic_joints}
    for j, joint in enumerate(tree.joints):
        if joint.name not in elastic:
            bounded = math.isfinite(joint.lower_limit) and math.isfinite(joint.upper_limit)
            middle = 0.5 * (joint.lower_limit + joint.upper_limit) if bounded else 0.0
            posture[j] = np.clip(start.get(joint.name, middle), joint.lower_limit, joint.upper_limit)
    return posture


def _gap_function(
    system: System, tree: Mechanism, value: ParameterEvaluator, offsets: Mapping[str, ArrayLike], sought: Sequence[int]
) -> ca.Function:
    """From q to the gaps between grippers and what they hold [m], and their derivatives by the joints sought."""
    q = ca.SX.sym("q", system.n_coordinates)
    kinematics = forward_kinematics(tree, q)
    gaps = []
    for grasp in system.grasps:
        offset = Placement(ca.SX(ca.DM.eye(3)), ca.SX(ca.DM(value(grasp.holder_offset))))
        beside = ca.DM(np.asarray(offsets.get(grasp.name, np.zeros(3)), float))
        held = kinematics.frame_position(grasp.held_frame) + beside
        gaps.append((kinematics.frame_pose(grasp.holder_frame) @ offset).translation - held)
    gap = ca.vertcat(*gaps)
    return ca.Function("gap", [q], [gap, ca.jacobian(gap, q)[:, list(sought)]])


def _reached(system: System, tree: Mechanism, posture: Array, sought: Sequence[int], gap: ca.Function) -> Array:
    """The posture with the joints sought where they close all gaps."""

    def at(x: Array) -> Array:
        full = posture.copy()
        full[sought] = x
        return full

    lower = np.array([tree.joints[j].lower_limit for j in sought])
    upper = np.array([tree.joints[j].upper_limit for j in sought])
    near = np.clip(posture[sought], lower + 1e-6, upper - 1e-6)
    # The pull towards the start keeps joints that do not move the gripper where they are.
    result = least_squares(
        lambda x: np.append(np.array(gap(at(x))[0]), _PULL * (x - near)),
        near,
        jac=lambda x: np.vstack([np.array(ca.densify(gap(at(x))[1])), _PULL * np.eye(len(x))]),
        bounds=(lower, upper),
        xtol=1e-15,
        ftol=1e-15,
        gtol=1e-15,
    )
    miss = np.abs(result.fun[: gap.numel_out(0)]).max()
    if miss > 1e-7:
        raise ModelError(
            f"the arms miss the grasped points by {1e3 * miss:.3g} mm",
            where=", ".join(f"{grasp.holder_frame} -> {grasp.held_frame}" for grasp in system.grasps),
            allowed="grasps within reach and within the joint limits",
            hint="move the object, or give another seed",
        )
    return at(result.x)
