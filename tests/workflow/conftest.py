"""A pendulum whose elbow rubs, which its model does not know."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from yid_ocp.data import read_recording, write_recording


@pytest.fixture(scope="session")
def rubbing(tmp_path_factory, pendulum_data):
    """The pendulum's configuration for recordings with friction in the elbow."""
    folder = tmp_path_factory.mktemp("rubbing")
    for name in ("estimate", "held_out"):
        recording = read_recording(pendulum_data.folder / f"{name}.h5")
        joints = recording.joints
        rubbed = joints.effort.copy()
        rubbed[:, 1] += 0.03 * np.sign(np.gradient(joints.position[:, 1]))
        write_recording(replace(recording, joints=replace(joints, effort=rubbed)), folder / f"{name}.h5")
    text = pendulum_data.text.replace(str(pendulum_data.folder), str(folder))
    file = folder / "rubbing.yaml"
    file.write_text(
        f"{text}diagnosis: {{candidates: [joint_coulomb, effort_offset, link_mass@elbow], max_effects: 1}}\n"
        "output: {write_report: false}\n"
    )
    return file
