"""Motion that cannot tell what is asked of it, however good the sensors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from yid_ocp.analysis.joint_checks import RecordedJointsModel, check_inertial_effort_excitation, check_joint_excitation
from yid_ocp.data.recording import JointGroup, Recording
from yid_ocp.model.system import System
from yid_ocp.model.urdf import read_urdf
from yid_ocp.problem.options import SensorOptions

USUAL = SensorOptions()


@pytest.fixture(scope="module")
def arm(urdf_folder) -> RecordedJointsModel:
    robot = read_urdf(urdf_folder / "double_pendulum.urdf")
    system = System.build(robot, prescribed=robot.joint_names)
    return RecordedJointsModel.from_system(system, system.parameters.vector())


def moved(arm: RecordedJointsModel, hertz: float, size: float = 0.3, noise: float = 0.05, seed: int = 0) -> Recording:
    """Both joints to and fro, with the efforts that they need and noise."""
    rng = np.random.default_rng(seed)
    t = 0.01 * np.arange(3001)
    phase = 2 * np.pi * hertz * t[:, None] + np.array([0.0, 1.0])
    rate = 2 * np.pi * hertz
    q, v, a = size * np.sin(phase), size * rate * np.cos(phase), -size * rate**2 * np.sin(phase)
    effort = arm._inverse_dynamics(q, v, a) + noise * rng.standard_normal(q.shape)
    return Recording(JointGroup(arm.joint_names, t, q, effort=effort, effort_std=noise), name="run")


@pytest.mark.parametrize(("hertz", "said"), [(0.02, True), (0.5, False), (1.0, False)])
def test_a_motion_so_slow_that_only_postures_tell(arm, hertz, said):
    for seed in range(3):
        found = list(check_inertial_effort_excitation(arm, moved(arm, hertz, 0.03, seed=seed), USUAL))
        assert [(d.cause, d.weight) for d in found] == ([("weak_excitation", "warning")] if said else [])


def test_less_noise_sees_more_and_efforts_that_nobody_uses_do_not_count(arm):
    slow = moved(arm, 0.02, 0.03)
    assert list(check_inertial_effort_excitation(arm, slow, replace(USUAL, std=1e-4))) == []
    assert len(list(check_inertial_effort_excitation(arm, slow, replace(USUAL, std=10.0)))) == 1
    assert list(check_inertial_effort_excitation(arm, slow, replace(USUAL, use=False))) == []


def test_a_joint_that_never_turns_tells_nothing_of_its_own_spring(arm):
    asked = {"elbow": ("elbow.stiffness", "elbow.damping")}
    recording = moved(arm, 0.5)
    still = replace(recording.joints, position=recording.joints.position * [1.0, 0.01])
    held = replace(recording, joints=still, name="held")
    (doubt,) = check_joint_excitation([held], asked, USUAL)
    assert (doubt.cause, doubt.channel, doubt.recording) == ("weak_excitation", "position.elbow", "held")
    assert doubt.setting == "parameters.elbow.stiffness.free: false; parameters.elbow.damping.free: false"
    assert list(check_joint_excitation([held, recording], asked, USUAL)) == []
    assert list(check_joint_excitation([held], {"shoulder": ("shoulder.damping",)}, USUAL)) == []
    coarse = replace(USUAL, std=0.2)
    assert len(list(check_joint_excitation([recording], asked, coarse))) == 1
