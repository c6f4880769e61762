from __future__ import annotations

from functools import cache

import pytest
from virtual_examples import SEEDS, SYSTEMS, TRUTH, Runs

from yid_ocp.virtual.engine import SimulatedRun, Simulation, simulate_in_mujoco
from yid_ocp.virtual.motion import multisine


@pytest.fixture(scope="session")
def runs() -> Runs:
    """runs(arms, time step [s]): five seconds of the paper's system."""

    @cache
    def run(arms: int, step: float) -> SimulatedRun:
        motion = multisine(SYSTEMS[arms], TRUTH, seed=SEEDS[arms])
        return simulate_in_mujoco(SYSTEMS[arms], TRUTH, motion, Simulation(time_step=step))

    return run
