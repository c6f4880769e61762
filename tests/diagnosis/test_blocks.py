"""One recording that begins in motion, split in blocks: both halves have one start."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from yid_ocp.data.recording import PointGroup, Recording
from yid_ocp.diagnosis import diagnose
from yid_ocp.effects import make_effect
from yid_ocp.integrator.rollout import simulate
from yid_ocp.integrator.step import compile_step
from yid_ocp.model import System
from yid_ocp.model.kinematics import forward_kinematics
from yid_ocp.model.urdf import read_urdf
from yid_ocp.problem import EstimationProblem, ProblemOptions

TIME_STEP, NOISE = 0.01, 1e-3


@pytest.fixture(scope="module")
def swinging(urdf_folder):
    """A pendulum let go, with dry friction in the elbow that the model does not know."""
    tree = read_urdf(str(urdf_folder / "double_pendulum.urdf"))
    nominal = System.build(tree, damping={"shoulder": 0.1, "elbow": 0.1})
    real = nominal.with_effects([make_effect("joint_coulomb", "elbow", nominal, {"tau_c": 0.02})])
    step = compile_step(real, TIME_STEP)
    rng = np.random.default_rng(1)
    start = np.zeros(step.sizes["nx"])
    start[:2], start[2:4] = 0.4 * rng.standard_normal(2), 0.02 * rng.standard_normal(2)
    swept = simulate(step, real.parameters.vector(), start, 600)
    frames = list(nominal.mechanism.frames)[-2:]
    q = ca.SX.sym("q", nominal.n_coordinates)
    kinematics = forward_kinematics(nominal.mechanism, q)
    place = ca.Function("place", [q], [ca.horzcat(*(kinematics.frame_position(frame) for frame in frames))])
    clean = np.stack([np.array(place(x[:2])).T for x in swept.state])
    t = TIME_STEP * np.arange(601)
    seen = clean + NOISE * rng.standard_normal(clean.shape)
    points = PointGroup("points", tuple(frames), t, seen, std=np.full(clean.shape, NOISE))
    options = ProblemOptions(initial_state="estimated", start_configuration_std=0.5, start_velocity_std=2.0)
    return EstimationProblem(
        compile_step(nominal, TIME_STEP),
        [Recording(None, (points,), name="one")],
        ("elbow.damping", "shoulder.damping"),
        options,
    )


def test_the_held_out_blocks_begin_where_the_others_do(swinging):
    finding = diagnose(swinging, ["joint_coulomb", "joint_viscous"])
    assert finding.is_split_in_blocks
    assert finding.nominal_held_out_test.chi2_per_dof == pytest.approx(finding.nominal_test.chi2_per_dof, rel=0.3)
    assert finding.verdict == "effect"
    assert finding.accepted_effects[0].label == "joint_coulomb@elbow"
    assert finding.gap_locations[0].location == "elbow"
