"""Virtual experiments from another engine, shared by the tests of solvers."""

import pytest

from yid_ocp.data import read_recording
from yid_ocp.integrator.step import compile_step
from yid_ocp.problem import EstimationProblem, ProblemOptions

FREE = ("T1.bend", "T1.twist", "T2.bend", "T2.twist", "T3.bend", "T3.twist")


@pytest.fixture(scope="session")
def one_arm(paper_systems):
    return compile_step(paper_systems["single"], 0.01)


@pytest.fixture(scope="session")
def recording(clean):
    """One arm and a camera, five seconds, from MuJoCo."""
    return read_recording(clean / "single_arm_vision_estimate.h5")


@pytest.fixture(scope="session")
def make_problem(one_arm, recording):
    def make(free=FREE, values=None, **options):
        return EstimationProblem(one_arm, [recording], free, ProblemOptions(**options), values)

    return make
