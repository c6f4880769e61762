"""A double pendulum whose motion is known and whose joint efforts are measured: quick, and every verdict can occur."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import pytest

from yid_ocp.data.recording import JointGroup, Recording
from yid_ocp.effects import make_effect
from yid_ocp.integrator.step import Step, compile_step, simulate
from yid_ocp.model import System
from yid_ocp.model.urdf import read_urdf
from yid_ocp.problem import EstimationProblem, ProblemOptions

TIME_STEP = 0.01
NOISE = 0.02
JOINTS = ("shoulder", "elbow")
FREE = ("shoulder.damping", "elbow.damping")


@dataclass(frozen=True)
class Bench:
    """Makes recordings with effects that the nominal model does not have, and problems that do not know them."""

    system: System
    step: Step

    def recording(self, effects, seed: int, duration: float = 4.0, torque=None, noise=NOISE) -> Recording:
        """A recording of a motion with effects, as a mapping of label to values, and noise."""
        made = [make_effect(*label.split("@"), self.system, values) for label, values in effects.items()]
        system = self.system.with_effects(made)
        step = compile_step(system, TIME_STEP)
        rng = np.random.default_rng(seed)
        steps = round(duration / TIME_STEP)
        t = TIME_STEP * np.arange(steps + 1)
        frequency = rng.uniform([0.2, 0.6, 1.2], [0.5, 1.1, 1.8], (2, 3))
        phase = rng.uniform(0, 2 * np.pi, (2, 3))
        path = np.sum(0.3 / frequency * np.sin(2 * np.pi * frequency * t[:, None, None] + phase), axis=2)
        start = np.zeros(step.sizes["nx"])
        start[:2] = path[0]
        swept = simulate(step, system.parameters.vector(), start, steps, None, path)
        assert swept.status.is_converged
        effort = np.vstack([swept.effort, swept.effort[-1:]])
        if torque is not None:
            effort = effort + torque(t)
        measured = effort + noise * rng.standard_normal(effort.shape)
        return Recording(JointGroup(JOINTS, t, path, effort=measured, effort_std=NOISE), name=f"run_{seed}")

    def problem(self, recordings, held_out=(), free=FREE, options: ProblemOptions | None = None) -> EstimationProblem:
        options = options or ProblemOptions(path_cutoff=float("inf"))
        return EstimationProblem(self.step, recordings, free, options, None, held_out)


@lru_cache(maxsize=1)
def _bench(file: str) -> Bench:
    system = System.build(read_urdf(file), prescribed=JOINTS, damping=dict.fromkeys(JOINTS, 0.05))
    return Bench(system, compile_step(system, TIME_STEP))


@pytest.fixture(scope="session")
def bench(urdf_folder) -> Bench:
    return _bench(str(urdf_folder / "double_pendulum.urdf"))
