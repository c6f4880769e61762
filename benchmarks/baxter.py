"""The system of the source paper, which tests and benchmarks share."""

from __future__ import annotations

from yid_ocp.model.objects.foam_y import foam_y_object
from yid_ocp.model.system import Grasp, System
from yid_ocp.model.urdf import read_urdf
from yid_ocp.virtual.joint_motion import BAXTER_JOINT_NAMES_WITHOUT_SIDE


def baxter_foam_y_system(arms: int) -> System:
    """Build the system of Caldwell (ISER 2014), in which one or two arms of Baxter hold the foam Y by point grasps.

    The left arm holds the tip of T2 (43 coordinates), the right arm the tip of T3 (50). Every arm joint is driven, and
    every coordinate has a viscous damping of 0.05 N m s/rad.
    """
    sides = ("left", "right")[:arms]
    names = [f"{side}_{joint}" for side in sides for joint in BAXTER_JOINT_NAMES_WITHOUT_SIDE]
    robot = read_urdf("package:baxter", joints=names)
    grasps = [Grasp(side, f"{side}_gripper", held) for side, held in zip(sides, ("w_T2", "w_T3"), strict=False)]
    return System.build(robot, objects=[(foam_y_object(), None, None)], grasps=grasps, driven=names, damping=0.05)
