"""Systems and values that the tests of this folder share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from yid_ocp.model.flexible import Segment, flexible_object
from yid_ocp.model.mechanism import Inertia
from yid_ocp.model.system import System, floating_clamp
from yid_ocp.virtual.experiment import baxter_foam_y_system
from yid_ocp.virtual.mujoco_simulation import SimulationResult

TRUTH = {"T1.bend": 22.0, "T1.twist": 13.6, "T2.bend": 10.7, "T2.twist": 8.2, "T3.bend": 11.5, "T3.twist": 9.7}
SYSTEMS = {arms: baxter_foam_y_system(arms) for arms in (1, 2)}
SEEDS = {1: 7, 2: 7}
Runs = Callable[..., SimulationResult]


def clamped_beam() -> System:
    beam = flexible_object([Segment("B", 0.5, 0.2, 0.01, links=3)], name="beam")
    clamp = floating_clamp("clamp")
    body = Inertia.from_values(0.3, [0.01, 0.02, 0.03], np.diag([1e-3, 2e-3, 2.5e-3]))
    clamp = replace(clamp, joints=(*clamp.joints[:-1], replace(clamp.joints[-1], bodies=(body,))))
    return System.build(clamp, objects=[(beam, "clamp", None)], driven=["clamp_x"], damping=0.1)
