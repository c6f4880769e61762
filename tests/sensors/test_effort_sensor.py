from __future__ import annotations

import numpy as np
import pytest

from yid_ocp.effects import make_effect
from yid_ocp.errors import ModelError
from yid_ocp.sensors import EffortSensor, Sensor

SENSOR = EffortSensor(("left_b", "left_a"))


def test_it_says_what_it_measures() -> None:
    assert isinstance(SENSOR, Sensor)
    assert SENSOR.group_name == "joints.effort"
    assert SENSOR.channel_names == ("joints.effort.left_b", "joints.effort.left_a")
    assert (SENSOR.unit, SENSOR.outputs_per_channel) == ("N m", 1)
    assert (SENSOR.frame_names, SENSOR.camera_pose) == ((), None)


def test_it_reads_the_efforts_of_its_joints_in_its_own_order(system, read) -> None:
    effort = np.arange(1.0, system.n_coordinates + 1)
    a, b = (system.mechanism.joint_index(name) for name in ("left_a", "left_b"))
    assert read(system, SENSOR, effort=effort) == pytest.approx([effort[b], effort[a]])


def test_effects_change_the_channel_that_they_sit_on(system, read) -> None:
    effort = np.zeros(system.n_coordinates)
    effort[[system.mechanism.joint_index(name) for name in ("left_a", "left_b")]] = [2.0, 5.0]
    gain = make_effect("effort_gain", "left_a", system, {"scale": 0.9})
    offset = make_effect("effort_offset", "left_a", system, {"offset": 0.3})
    assert read(system.with_effects([gain, offset]), SENSOR, effort=effort) == pytest.approx([5.0, 0.9 * 2.0 + 0.3])
    assert read(system.with_effects([offset, gain]), SENSOR, effort=effort) == pytest.approx([5.0, 0.9 * (2.0 + 0.3)])


def test_a_joint_that_is_not_there_is_refused(system, read) -> None:
    with pytest.raises(ModelError, match="left_c"):
        read(system, EffortSensor(("left_c",)))
