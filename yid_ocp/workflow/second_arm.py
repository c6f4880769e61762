"""Variant of a run's system in which the second arm grasps the object too."""

from __future__ import annotations

from dataclasses import replace

from yid_ocp.config.settings import GraspSettings, RunSettings
from yid_ocp.errors import YidError
from yid_ocp.model.system import System
from yid_ocp.workflow.build import build_system

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
