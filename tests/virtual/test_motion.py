from __future__ import annotations

import numpy as np
import pytest
from virtual_examples import SYSTEMS

from yid_ocp.virtual.motion import multisine

mujoco = pytest.importorskip("mujoco", reason="virtual experiments need MuJoCo: pip install 'yid-ocp[blind]'")


def test_motion_starts_smoothly_and_is_drawn_from_the_seed() -> None:
    motion = multisine(SYSTEMS[1], seed=3)
    assert all(np.abs(part).max() == 0.0 for part in motion.at(0.0))
    assert np.all((motion.frequency >= 0.2) & (motion.frequency <= 2.0))
    h = 1e-4
    for t in (0.4, 1.0, 2.3):
        before, now, after = (motion.at(t + shift) for shift in (-h, 0.0, h))
        np.testing.assert_allclose((after[0] - before[0]) / (2 * h), now[1], atol=1e-6)
        np.testing.assert_allclose((after[1] - before[1]) / (2 * h), now[2], atol=1e-4)
    np.testing.assert_array_equal(multisine(SYSTEMS[1], seed=3).amplitude, motion.amplitude)
    assert not np.array_equal(multisine(SYSTEMS[1], seed=4).amplitude, motion.amplitude)
