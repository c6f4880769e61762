"""The other arm of a robot, which a change of the experiment may use."""

from __future__ import annotations

from dataclasses import replace

from yid_ocp.config.reader import load_config
from yid_ocp.workflow.build import build_system, system_with_second_arm


def test_the_other_arm_of_a_robot(repository):
    run = load_config(repository / "configs" / "single_arm_vision.yaml")
    system = build_system(run)
    both = system_with_second_arm(run, system)
    assert both is not None
    assert both.driven[:7] == system.driven
    assert both.driven[7:] == tuple(name.replace("left_", "right_") for name in system.driven)
    assert [(grasp.name, grasp.holder_frame, grasp.held_frame) for grasp in both.grasps] == [
        ("left", "left_gripper", "w_T2"),
        ("right", "right_gripper", "w_T3"),
    ]
    assert system_with_second_arm(load_config(repository / "configs" / "dual_arm_vision.yaml"), both) is None
    moved = replace(run, model=replace(run.model, arms=replace(run.model.arms, mode="prescribed")))
    assert system_with_second_arm(moved, system) is None
