"""Effects as the other engine does them, against the vocabulary's equations as the library has them."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from virtual_examples import SYSTEMS, TRUTH, mujoco, single_arm_xml

from yid_ocp.data.recording import JointGroup, PointGroup, Recording
from yid_ocp.effects import EFFECTS, make_effect
from yid_ocp.errors import ConfigError
from yid_ocp.model.kinematics import forward_kinematics
from yid_ocp.model.system import MidpointState
from yid_ocp.virtual.experiment import VirtualExperiment, recording_with_sensor_error
from yid_ocp.virtual.injected import (
    _FORCE_KINDS,
    _MUJOCO_MODEL_KINDS,
    _SENSOR_ERROR_KINDS,
    INJECTABLE_EFFECT_KINDS,
    OUT_OF_LIBRARY_EFFECTS,
    InjectedEffect,
    _InjectedTerms,
    run_experiment_with_effects,
)
from yid_ocp.virtual.joint_motion import random_multisine_motion
from yid_ocp.virtual.mjcf import mujoco_xml
from yid_ocp.virtual.mujoco_simulation import SimulationOptions

SYSTEM = SYSTEMS[1]
SIZES = {
    "kelvin_voigt@T1": {"tau": 0.05},
    "joint_viscous@left_s1": {"b": 1.3},
    "joint_spring@left_s1": {"stiffness": 20.0, "rest_angle": -0.4},
    "cubic_stiffness@T2": {"k3": 40.0},
    "aerodynamic_drag@T3": {"cd": 2.0},
    "gravity_scale@object": {"fraction": -0.4},
    "joint_coulomb@left_e1": {"tau_c": 0.7},
    "joint_stribeck@left_e1": {"tau_s": 0.7, "v_stribeck": 1.0},
}
# found back by test_vocabulary_twins.py
TWINS = ("payload", "joint_presliding", "effort_lag")


def passive(effects, q, v):
    """MuJoCo's passive forces and joint inertias with effects, in configuration order."""
    model = mujoco.MjModel.from_xml_string(single_arm_xml())
    order = [model.joint(name).id for name in SYSTEM.mechanism.joint_names]
    data = mujoco.MjData(model)
    injected = _InjectedTerms(SYSTEM, TRUTH, effects)
    injected.edit_model(model)
    injected.start_motion(data)
    data.qpos[order], data.qvel[order] = q, v
    mujoco.set_mjcb_passive(injected.add_forces)
    try:
        mujoco.mj_forward(model, data)
    finally:
        mujoco.set_mjcb_passive(None)
    return np.array(data.qfrc_passive[order]), np.array(model.dof_armature[order])


def symbolic(kind, location, values, q, v):
    """The library's generalized force."""
    effect = make_effect(kind, location, SYSTEM, values)
    changed = SYSTEM.with_effects([effect])
    sq, sv = ca.SX.sym("q", SYSTEM.n_coordinates), ca.SX.sym("v", SYSTEM.n_coordinates)
    none = ca.SX(0, 1)
    u, reaction = ca.SX.sym("u", len(SYSTEM.driven)), ca.SX.sym("r", SYSTEM.n_constraints)
    state = MidpointState(
        changed, forward_kinematics(changed.mechanism, sq), sq, sv, none, none, u, reaction, {}, ca.SX(1)
    )
    terms = effect.step_terms(state)
    total = ca.gradient(terms.lagrangian, sq)
    for force in (
        terms.generalized_force,
        terms.dissipative_force,
        None if terms.force_with_derivatives is None else terms.force_with_derivatives.force,
    ):
        total = total if force is None else total + force
    function = ca.Function("f", [sq, sv, changed.parameters.symbols], [total])
    return np.array(ca.densify(function(q, v, changed.parameters.vector(TRUTH)))).ravel()


@pytest.mark.parametrize("label", sorted(set(SIZES) - {"gravity_scale@object"}))
def test_forces_are_those_of_the_library(label):
    kind, _, place = label.partition("@")
    rng = np.random.default_rng(3)
    q, v = rng.uniform(-0.4, 0.4, SYSTEM.n_coordinates), rng.uniform(-1, 1, SYSTEM.n_coordinates)
    with_it, _ = passive([InjectedEffect(kind, place, SIZES[label])], q, v)
    without, _ = passive([], q, v)
    expected = symbolic(kind, place, SIZES[label], q, v)
    assert np.abs(expected).max() > 1e-4
    # the library rounds the drag off below a millimetre a second
    assert with_it - without == pytest.approx(expected, rel=1e-4, abs=1e-6)


def test_weight_is_taken_away_without_the_inertia():
    rng = np.random.default_rng(4)
    q, v = rng.uniform(-0.4, 0.4, SYSTEM.n_coordinates), np.zeros(SYSTEM.n_coordinates)
    lifted = passive([InjectedEffect("gravity_scale", "object", {"fraction": -1.0})], q, v)[0] - passive([], q, v)[0]
    effect = make_effect("gravity_scale", "object", SYSTEM, {"fraction": -1.0})
    weightless, heavy = (
        mujoco.MjModel.from_xml_string(mujoco_xml(replace(SYSTEM, gravity=g), TRUTH))
        for g in (ca.SX(ca.DM.zeros(3)), SYSTEM.gravity)
    )
    order = [heavy.joint(name).id for name in SYSTEM.mechanism.joint_names]
    bias = []
    for model in (heavy, weightless):
        data = mujoco.MjData(model)
        data.qpos[order] = q
        mujoco.mj_forward(model, data)
        bias.append(np.array(data.qfrc_bias[order]))
    on_object = [i for i, name in enumerate(SYSTEM.mechanism.joint_names) if not name.startswith("left")]
    assert lifted[on_object] == pytest.approx((bias[0] - bias[1])[on_object], abs=1e-9)
    assert effect.label == "gravity_scale@object"


def test_a_rotor_is_an_armature():
    q = np.zeros(SYSTEM.n_coordinates)
    _, armature = passive([InjectedEffect("rotor_inertia", "left_e1", {"armature": 0.3})], q, q)
    assert armature[SYSTEM.mechanism.joint_index("left_e1")] == 0.3


def reading(duration=1.0) -> Recording:
    t = np.linspace(0, duration, 101)
    names = tuple(SYSTEM.driven)
    position = np.sin(t)[:, None] * np.ones(len(names))
    effort = np.cos(3 * t)[:, None] * np.arange(1, len(names) + 1)
    pose = np.eye(4)
    pose[:3, 3] = [2.0, 0.0, 0.0]
    camera = PointGroup(
        "points_camera", ("w_T1",), t, np.tile([0.5, 0.1, 0.2], (101, 1, 1)), sensor="camera", pose=pose
    )
    return Recording(JointGroup(names, t, position, effort=effort), (camera,), name="r")


@pytest.mark.parametrize(
    ("kind", "values", "channel", "expected"),
    [
        ("effort_gain", {"scale": 1.1}, "effort", lambda position, effort: effort * 1.1),
        ("effort_offset", {"offset": 0.2}, "effort", lambda position, effort: effort + 0.2),
        ("encoder_offset", {"offset": 0.01}, "position", lambda position, effort: position + 0.01),
        ("series_elasticity", {"stiffness": 500.0}, "position", lambda position, effort: position + effort / 500),
        ("backlash", {"width": 0.01}, "position", lambda position, effort: position + 0.005 * np.tanh(effort / 0.2)),
    ],
)
def test_errors_of_joint_sensors_are_those_of_the_table(kind, values, channel, expected):
    true = reading()
    wrong = getattr(recording_with_sensor_error(true, SYSTEM, kind, "left_s1", values).joints, channel)
    assert wrong[:, 1] == pytest.approx(expected(true.joints.position[:, 1], true.joints.effort[:, 1]))
    assert wrong[:, 2] == pytest.approx(getattr(true.joints, channel)[:, 2])


def test_what_is_recorded_late_acts_later():
    recording = reading()
    wrong = recording_with_sensor_error(recording, SYSTEM, "effort_delay", "left", {"delay": 0.05})
    assert wrong.joints.effort[:-6] == pytest.approx(recording.joints.effort[5:-1], abs=1e-9)


def test_errors_of_cameras_are_those_of_the_table():
    recording = reading()
    true = recording.points[0].position

    def seen(kind, **values):
        return recording_with_sensor_error(recording, SYSTEM, kind, "camera", values).points[0]

    assert seen("camera_translation", x=0.01, y=0.0, z=-0.01).position == pytest.approx(
        true + np.array([0.01, 0.0, -0.01])
    )
    centre = np.array([2.0, 0.0, 0.0])
    assert seen("camera_scale", scale=1.02).position == pytest.approx(centre + 1.02 * (true - centre))
    turned = seen("camera_rotation", rx=0.0, ry=0.0, rz=0.1).position - centre
    assert np.linalg.norm(turned, axis=2) == pytest.approx(np.linalg.norm(true - centre, axis=2))
    assert seen("camera_latency", delay=0.1).t[0] == pytest.approx(0.1)
    shift = seen("surface_offset", fraction=1.0).position - true
    assert np.linalg.norm(shift, axis=2) == pytest.approx(0.032)


def test_an_effect_acts_on_a_whole_recording_and_leaves_no_trace_of_itself():
    """1 N m s/rad is some hundred times what an explicit step of a light branch bears: it asks little of the arm."""
    motion = random_multisine_motion(SYSTEM, TRUTH, seed=1)
    experiment = VirtualExperiment(motion, simulation=SimulationOptions(0.3, time_step=5e-4), seed=2)
    hysteresis = InjectedEffect("hysteresis", "T1", {"stiffness": 9.0, "yield_angle": 0.1})
    braked = InjectedEffect("one_way_damping", "T3", {"size": 1.0})
    clean, pushed, light, again = (
        run_experiment_with_effects(SYSTEM, TRUTH, effects, experiment).joints.effort
        for effects in ((), [hysteresis], [braked], ())
    )
    assert np.abs(pushed - clean).max() > 1e-3
    assert 1e-4 < np.abs(light - clean).max() < 5.0
    assert again == pytest.approx(clean, abs=0)


def test_every_kind_is_done_once_and_what_is_outside_is_not_in_the_library():
    assert len(set(INJECTABLE_EFFECT_KINDS)) == len(INJECTABLE_EFFECT_KINDS)
    assert set(INJECTABLE_EFFECT_KINDS) <= set(EFFECTS)
    assert not set(OUT_OF_LIBRARY_EFFECTS) & set(EFFECTS)
    tested_elsewhere = {"rotor_inertia", "standard_linear_solid", "hysteresis", *TWINS}
    assert {label.partition("@")[0] for label in SIZES} | tested_elsewhere == {*_MUJOCO_MODEL_KINDS, *_FORCE_KINDS}
    assert set(_SENSOR_ERROR_KINDS) <= set(INJECTABLE_EFFECT_KINDS)


def test_a_kind_that_cannot_be_done_is_refused():
    with pytest.raises(ConfigError, match="grasp_slip"):
        run_experiment_with_effects(SYSTEM, TRUTH, [InjectedEffect("grasp_slip", "left", {})])
