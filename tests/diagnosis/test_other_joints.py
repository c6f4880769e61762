"""A bare arm with efforts from Pinocchio's inverse dynamics: an effect is found at whatever joint it sits."""

from functools import lru_cache

import numpy as np
import pytest

from yid_ocp.data.recording import JointGroup, Recording
from yid_ocp.diagnosis.diagnose import diagnose
from yid_ocp.diagnosis.thresholds import Thresholds
from yid_ocp.integrator.step import compile_step
from yid_ocp.model import System
from yid_ocp.model.urdf import read_urdf, urdf_path_from_robot_name
from yid_ocp.problem import EstimationProblem, ProblemOptions

pin = pytest.importorskip("pinocchio", reason="the other engine is Pinocchio: pip install pin")
pytestmark = pytest.mark.usefixtures("without_law")

JOINTS = ("s0", "s1", "e0", "e1", "w0", "w1", "w2")
CENTRE = np.array([0.1, -0.5, 0.2, 1.0, -0.1, 0.8, 0.0])
DAMPING, NOISE, TIME_STEP = 0.3, 0.05, 0.01
CANDIDATES = ("joint_spring", "joint_coulomb", "effort_offset", "link_mass")


@lru_cache(maxsize=2)
def robot(side: str):
    names = tuple(f"{side}_{joint}" for joint in JOINTS)
    system = System.build(read_urdf("package:baxter", joints=names), prescribed=names, damping=0.05)
    model = pin.buildModelFromUrdf(str(urdf_path_from_robot_name("package:baxter")))
    locked = [j for j in range(1, model.njoints) if model.names[j] not in names]
    return names, compile_step(system, TIME_STEP), pin.buildReducedModel(model, locked, pin.neutral(model))


def recording(side: str, seed: int, extra) -> Recording:
    """A multi-sine motion with the efforts of inverse dynamics, viscous friction and whatever `extra` adds."""
    names, _, model = robot(side)
    data, rng = model.createData(), np.random.default_rng(seed)
    t = TIME_STEP * np.arange(251)
    frequency = rng.uniform([0.1, 0.3, 0.7], [0.25, 0.6, 1.2], (7, 3))
    phase = rng.uniform(0, 2 * np.pi, (7, 3))
    amplitude = 0.12 / frequency**0.7
    angle = 2 * np.pi * frequency * t[:, None, None] + phase
    mirror = np.array([-1, 1, -1, 1, -1, 1, -1]) if side == "right" else np.ones(7)
    q = mirror * (CENTRE + np.sum(amplitude * np.sin(angle), axis=2))
    v = mirror * np.sum(2 * np.pi * frequency * amplitude * np.cos(angle), axis=2)
    a = -mirror * np.sum((2 * np.pi * frequency) ** 2 * amplitude * np.sin(angle), axis=2)
    column = [model.joints[model.getJointId(name)].idx_v for name in names]
    effort = np.zeros_like(q)
    for k in range(len(t)):
        full = [np.zeros(model.nv) for _ in range(3)]
        for target, source in zip(full, (q[k], v[k], a[k]), strict=True):
            target[column] = source
        effort[k] = pin.rnea(model, data, *full)[column]
    effort += DAMPING * v + extra(names, q, v) + NOISE * rng.standard_normal(q.shape)
    joints = JointGroup(names, t, q, velocity=v, effort=effort, effort_std=NOISE, position_std=0.0)
    return Recording(joints, name=f"{side}_{seed}")


def at_one(joint: str, law):
    """Effort that one joint needs beside inverse dynamics, by its angle and speed."""
    return lambda names, q, v: np.where(np.array(names) == joint, law(q, v), 0.0)


def diagnosed(side: str, extra):
    names, step, _ = robot(side)
    free, options = tuple(f"{name}.damping" for name in names), ProblemOptions(path_cutoff=np.inf)
    estimate, held_out = (recording(side, seed, extra) for seed in (1, 2))
    problem = EstimationProblem(step, [estimate], free, options, held_out=[held_out])
    return diagnose(problem, CANDIDATES, thresholds=Thresholds(max_effects=1, n_refit_per_round=3))


def test_a_spring_is_found_at_a_wrist():
    finding = diagnosed("right", at_one("right_w1", lambda q, v: 3.0 * (q + 0.4)))
    assert finding.verdict in ("effect", "confusable")
    assert finding.accepted_effects[0].label == "joint_spring@right_w1"
    assert finding.gap_locations[0].location == "right_w1"
    assert finding.selected_effects[-1].cumulative_closure.fraction > 0.95
    fit = finding.final_model
    found = finding.accepted_effects[0].to_reported_parameters(fit.values, fit.std)
    assert found["stiffness"].value == pytest.approx(3.0, rel=0.05)


def test_dry_friction_is_told_from_a_spring():
    finding = diagnosed("left", at_one("left_e1", lambda q, v: 1.5 * np.tanh(v / 0.02)))
    assert finding.accepted_effects[0].label == "joint_coulomb@left_e1"
    assert finding.gap_locations[0].location == "left_e1"


def test_an_arm_as_the_model_says_has_no_gap():
    assert diagnosed("left", lambda names, q, v: np.zeros_like(q)).verdict == "no_gap"
