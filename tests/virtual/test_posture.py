from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from virtual_examples import SYSTEMS

from yid_ocp.errors import ModelError
from yid_ocp.model.flexible import Segment, flexible_object
from yid_ocp.model.kinematics import forward_kinematics
from yid_ocp.model.system import Grasp, System
from yid_ocp.model.urdf import read_urdf
from yid_ocp.virtual.inverse_kinematics import grasping_joint_angles

mujoco = pytest.importorskip("mujoco", reason="virtual experiments need MuJoCo: pip install 'yid-ocp[blind]'")


def test_initial_posture_reaches_the_tubes_within_the_limits() -> None:
    for arms, system in SYSTEMS.items():
        posture = grasping_joint_angles(system)
        assert len(posture) == 7 * arms
        for name, angle in posture.items():
            joint = system.mechanism.joints[system.mechanism.joint_index(name)]
            assert joint.lower_limit <= angle <= joint.upper_limit
        q = ca.SX.sym("q", system.n_coordinates)
        phi = ca.Function(
            "phi", [q], [system.constraint_residual(forward_kinematics(system.mechanism.with_numeric_values(), q))]
        )
        full = [posture.get(name, 0.0) for name in system.mechanism.joint_names]
        assert np.abs(np.array(phi(full))).max() < 1e-8
    with pytest.raises(ModelError, match="miss the grasped points"):
        grasping_joint_angles(SYSTEMS[1], {"T1.length": 3.0})


def test_other_robots_start_from_the_middle_of_their_range() -> None:
    robot = read_urdf("package:panda", locked={"panda_finger_joint1": 0.0, "panda_finger_joint2": 0.0})
    beam = flexible_object([Segment("B", 0.5, 0.2, 0.01, links=2)])
    names = robot.joint_names[:7]
    placement = np.eye(4)
    placement[:3, 3] = [0.5, 0.0, 0.0]
    system = System.build(
        robot, objects=[(beam, None, placement)], grasps=[Grasp("hand", "panda_hand", "w_B")], driven=names
    )
    posture = grasping_joint_angles(system)
    assert set(names) <= set(posture)
