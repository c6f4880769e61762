from __future__ import annotations

from functools import cache

import pytest
from virtual_examples import SEEDS, SYSTEMS, TRUTH, Runs

from yid_ocp.virtual.joint_motion import random_multisine_motion
from yid_ocp.virtual.mujoco_simulation import SimulationOptions, SimulationResult, simulate_in_mujoco


@pytest.fixture(scope="session")
def runs() -> Runs:
    """runs(arms, time step [s], duration [s]): the paper's system, one second where nothing else is said."""

    @cache
    def run(arms: int, step: float, duration: float = 1.0) -> SimulationResult:
        motion = random_multisine_motion(SYSTEMS[arms], TRUTH, seed=SEEDS[arms])
        return simulate_in_mujoco(SYSTEMS[arms], TRUTH, motion, SimulationOptions(duration, time_step=step))

    return run
