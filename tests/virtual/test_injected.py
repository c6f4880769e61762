"""Effects as the other engine does them: against the library's equations, or the potential or rule they follow."""

import math
from unittest.mock import Mock

import casadi as ca
import numpy as np
import pytest
from virtual_examples import SYSTEMS, TRUTH, mujoco

from yid_ocp.data.recording import JointGroup, PointGroup, Recording
from yid_ocp.effects import EFFECTS, make_effect
from yid_ocp.errors import ConfigError
from yid_ocp.model.kinematics import forward_kinematics, lagrangian_first_derivatives
from yid_ocp.model.system import MidpointStateSymbols
from yid_ocp.virtual import injected
from yid_ocp.virtual.experiment import VirtualExperimentSettings, recording_with_sensor_error
from yid_ocp.virtual.injected import OUT_OF_LIBRARY_FORCE_BUILDERS, InjectedEffect, run_experiment_with_injected_effects
from yid_ocp.virtual.joint_motion import random_multisine_motion
from yid_ocp.virtual.mjcf import mujoco_xml
from yid_ocp.virtual.mujoco_simulation import SimulationOptions

SYSTEM = SYSTEMS[1]
MODEL_XML = mujoco_xml(SYSTEM, TRUTH)
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


def terms_of(*effects):
    """What a simulation is given of injected effects."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(injected, "run_virtual_experiment", given := Mock())
        run_experiment_with_injected_effects(SYSTEM, TRUTH, effects)
    return given.call_args.args[2].injected_terms or Mock()


def passive(effects, q, v):
    """MuJoCo's passive forces and joint inertias with effects, in configuration order."""
    model = mujoco.MjModel.from_xml_string(MODEL_XML)
    order = [model.joint(name).id for name in SYSTEM.mechanism.joint_names]
    data = mujoco.MjData(model)
    terms = terms_of(*effects)
    terms.edit_model(model)
    terms.begin_motion(data)
    data.qpos[order], data.qvel[order] = q, v
    mujoco.set_mjcb_passive(terms.add_forces)
    try:
        mujoco.mj_forward(model, data)
    finally:
        mujoco.set_mjcb_passive(None)
    return np.array(data.qfrc_passive[order]), np.array(model.dof_armature[order])


def symbolic(kind, location, values, q, v):
    """The library's generalized force, changed weight included."""
    effect = make_effect(kind, location, SYSTEM, values)
    changed = SYSTEM.with_effects([effect])
    sq, sv = ca.SX.sym("q", SYSTEM.n_coordinates), ca.SX.sym("v", SYSTEM.n_coordinates)
    none, u = ca.SX(0, 1), ca.SX.sym("u", len(SYSTEM.driven))
    reaction = ca.SX.sym("r", SYSTEM.n_constraints)
    kinematics, nominal = (forward_kinematics(system.mechanism, sq) for system in (changed, SYSTEM))
    terms = effect.step_terms(MidpointStateSymbols(changed, kinematics, sq, sv, none, none, u, reaction, {}, ca.SX(1)))
    rigid = (lagrangian_first_derivatives(k, 0 * sv, SYSTEM.gravity) for k in (kinematics, nominal))
    weight, usual = (terms_at_rest.lagrangian_by_q for terms_at_rest in rigid)
    closed = terms.force_with_derivatives
    forces = (terms.generalized_force, terms.dissipative_force, None if closed is None else closed.force)
    total = ca.gradient(terms.lagrangian, sq) + weight - usual
    total += sum((force for force in forces if force is not None), ca.SX(0))
    function = ca.Function("f", [sq, sv, changed.parameters.symbols], [total])
    return np.array(ca.densify(function(q, v, changed.parameters.vector(TRUTH)))).ravel()


@pytest.mark.parametrize("label", sorted(SIZES))
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
    points = np.tile([0.5, 0.1, 0.2], (101, 1, 1))
    camera = PointGroup("points_camera", ("w_T1",), t, points, sensor_name="camera", camera_pose=pose)
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

    shifted = seen("camera_translation", x=0.01, y=0.0, z=-0.01).position
    assert shifted == pytest.approx(true + np.array([0.01, 0.0, -0.01]))
    centre = np.array([2.0, 0.0, 0.0])
    assert seen("camera_scale", scale=1.02).position == pytest.approx(centre + 1.02 * (true - centre))
    turned = seen("camera_rotation", rx=0.0, ry=0.0, rz=0.1).position - centre
    assert np.linalg.norm(turned, axis=2) == pytest.approx(np.linalg.norm(true - centre, axis=2))
    assert seen("camera_latency", delay=0.1).t[0] == pytest.approx(0.1)
    assert np.linalg.norm(seen("surface_offset", fraction=1.0).position - true, axis=2) == pytest.approx(0.032)


def test_an_effect_acts_on_a_whole_recording_and_leaves_no_trace_of_itself():
    """1 N m s/rad is some hundred times what an explicit step of a light branch bears: it asks little of the arm."""
    motion = random_multisine_motion(SYSTEM, TRUTH, seed=1)
    experiment = VirtualExperimentSettings(motion, simulation=SimulationOptions(0.3, time_step=5e-4), seed=2)
    hysteresis = InjectedEffect("hysteresis", "T1", {"stiffness": 9.0, "yield_angle": 0.1})
    clean, pushed, light, again = (
        run_experiment_with_injected_effects(SYSTEM, TRUTH, effects, experiment).joints.effort
        for effects in ((), [hysteresis], [InjectedEffect("one_way_damping", "T3", {"size": 1.0})], ())
    )
    assert np.abs(pushed - clean).max() > 1e-3
    assert 1e-4 < np.abs(light - clean).max() < 5.0
    assert again == pytest.approx(clean, abs=0)


def test_every_kind_is_done_once_and_what_is_outside_is_not_in_the_library():
    described = "density point_mass length_scale link_mass rest_curvature bend_anisotropy gravity_tilt grasp_offset"
    servos = "servo_gain servo_delay servo_saturation rotor_inertia standard_linear_solid hysteresis backlash"
    sensors = "effort_gain effort_offset effort_delay encoder_offset series_elasticity surface_offset"
    cameras = "camera_translation camera_rotation camera_scale camera_latency"
    tested = [*{label.partition("@")[0] for label in SIZES}, *TWINS]
    tested += f"{described} {servos} {sensors} {cameras}".split()
    assert sorted(injected.INJECTABLE_EFFECT_KINDS) == sorted(tested)
    assert set(injected.INJECTABLE_EFFECT_KINDS) <= set(EFFECTS)
    assert not set(OUT_OF_LIBRARY_FORCE_BUILDERS) & set(EFFECTS)
    with pytest.raises(ConfigError, match="grasp_slip"):
        run_experiment_with_injected_effects(SYSTEM, TRUTH, [InjectedEffect("grasp_slip", "left", {})])


class Bench:
    """MuJoCo's model with one effect, whose force is asked for at states of one's choice."""

    def __init__(self, kind, location, size, running=True):
        self.model = mujoco.MjModel.from_xml_string(MODEL_XML)
        self.data = mujoco.MjData(self.model)
        self.terms = terms_of(InjectedEffect(kind, location, {"size": size}))
        self.terms.edit_model(self.model)
        if running:
            self.terms.begin_motion(self.data)
        self.force(np.zeros(self.model.nv))  # what is anchored somewhere is anchored by this state
        self.began = {joint: self.place(joint) for joint in ("left_w0", joints_of("T3", 2)[-1])}

    def at(self, q, v=None, time=0.0):
        self.data.qpos[:], self.data.time = q, time
        self.data.qvel[:] = 0.0 if v is None else v
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)

    def force(self, q, v=None, time=0.0):
        self.at(q, v, time)
        self.data.qfrc_passive[:] = 0.0
        self.terms.add_forces(self.model, self.data)
        return np.array(self.data.qfrc_passive)

    def place(self, joint):
        return np.array(self.data.xipos[self.model.jnt_bodyid[self.model.joint(joint).id]])

    def address(self, *joints):
        return np.array([self.model.joint(joint).id for joint in joints])


def joints_of(segment, *axes):
    return [link[axis] for link in SYSTEM.find_segment_layout(segment).link_joints for axis in axes]


def slope(bench, potential, q, step=1e-6):
    """- dV/dq by differences."""

    def energy(x):
        bench.at(x)
        return potential(bench)

    return np.array([energy(q - way) - energy(q + way) for way in step * np.eye(len(q))]) / (2 * step)


TIP, CORD = joints_of("T3", 2)[-1], 0.3  # length of a tether [m]


def moved(bench, joint):
    """How far the link that a joint carries is from where it began."""
    return bench.place(joint) - bench.began[joint]


def cord(joint, hung):
    anchor = np.array([0.0, 0.0, hung])
    return lambda bench: 0.5 * 20.0 * max(np.linalg.norm(moved(bench, joint) - anchor) - CORD, 0.0) ** 2


def pole(bench):
    away = np.array([0.06, 0.0, 0.0]) - moved(bench, TIP)
    return 0.5 * 0.3 * 0.04 * math.log(away @ away + 0.04**2)


def soft_wall(bench):
    return 0.5 * 30.0 * max(moved(bench, TIP)[1] - 0.01, 0.0) ** 2


def creased(bench):
    bent = bench.data.qpos[bench.address(*SYSTEM.find_segment_layout("T1").link_joints[1][:2])]
    return -0.5 * 12.0 * max(np.linalg.norm(bent) - 0.03, 0.0) ** 2


def crossed(bench):
    x, y = (bench.data.qpos[bench.address(*joints_of("T1", axis))] for axis in (0, 1))
    return 8.0 * float(x @ y)


def lopsided(bench):
    return 5.0 / 3 * float(np.sum(bench.data.qpos[bench.address(*joints_of("T2", 0, 1))] ** 3))


@pytest.mark.parametrize(
    ("kind", "place", "size", "potential"),
    [
        ("tether", "T3", 20.0, cord(TIP, -CORD)),
        ("tether", "left_w0", 20.0, cord("left_w0", CORD)),
        ("magnet", "T3", 0.3, pole),
        ("wall", "T3", 30.0, soft_wall),
        ("crease", "T1", 12.0, creased),
        ("cross_stiffness", "T1", 8.0, crossed),
        ("quadratic_stiffness", "T2", 5.0, lopsided),
    ],
)
def test_what_has_a_potential_is_its_slope(kind, place, size, potential):
    bench = Bench(kind, place, size)
    rng = np.random.default_rng(5)
    felt = 0
    for _ in range(4):
        q = rng.uniform(-0.3, 0.3, bench.model.nv)
        found = bench.force(q)
        felt += np.abs(found).max() > 1e-3
        assert found == pytest.approx(slope(bench, potential, q), abs=2e-6)
    assert felt, "some of these states are beyond the cord, the wall or the crease"


def test_a_drifting_stiffness_softens_with_time():
    q = np.random.default_rng(6).uniform(-0.3, 0.3, Bench("gusts", "T1", 0.1).model.nv)
    bench = Bench("stiffness_drift", "T1", 0.4)
    at = bench.address(*joints_of("T1", 0, 1, 2))
    stiffness = np.array([22.0, 22.0, 13.6] * 4)
    half = bench.force(q, time=2.5)
    assert half[at] == pytest.approx(0.2 * stiffness * q[at])
    assert np.count_nonzero(half) == len(at)
    assert not bench.force(q, time=0.0).any()
    assert not Bench("stiffness_drift", "T1", 0.4, running=False).force(q, time=2.0).any()


def test_one_way_damping_brakes_one_way_only():
    bench = Bench("one_way_damping", "T1", 0.6)
    at = bench.address(*joints_of("T1", 0, 1))
    v = np.random.default_rng(7).uniform(-1, 1, bench.model.nv)
    found = bench.force(np.zeros(bench.model.nv), v)
    assert found[at] == pytest.approx(-0.6 * np.maximum(v[at], 0.0))
    assert np.setdiff1d(np.flatnonzero(found), at).size == 0


def test_a_cold_gear_brakes_until_it_is_warm():
    bench = Bench("warming_gear", "left_s1", 3.0)
    v = np.ones(bench.model.nv)
    [at] = bench.address("left_s1")
    forces = [bench.force(np.zeros(bench.model.nv), v, time)[at] for time in (0.0, 1.5, 15.0)]
    assert forces == pytest.approx([-3.0, -3.0 / math.e, 0.0], abs=2e-4)


@pytest.mark.parametrize(("torque", "given"), [(2.0, 2.0), (5.0, 3.5), (-9.0, -3.5)])
def test_a_saturating_drive_gives_no_more_than_it_can(torque, given):
    bench = Bench("saturating_drive", "left_e1", 3.5)
    [at] = bench.address("left_e1")
    bench.data.qfrc_applied[at] = torque
    assert bench.force(np.zeros(bench.model.nv))[at] + torque == pytest.approx(given)


def test_a_loose_load_follows_the_joint_late():
    bench = Bench("shifting_load", "left_w1", 0.8)
    [at] = bench.address("left_w1")
    q = np.zeros(bench.model.nv)
    q[at] = 0.5
    found = [bench.force(q, time=time)[at] for time in np.arange(0.0, 2.0, 0.01)]
    assert found[0] == 0.0
    assert np.all(np.diff(found) >= -1e-12)
    assert found[20] == pytest.approx(0.8 * (1 - math.exp(-1)), rel=0.05)
    assert found[-1] == pytest.approx(0.8, rel=1e-3)


def test_a_slipping_grasp_has_moved_along_the_tube_after_every_slip():
    bench = Bench("slipping_grasp", "left", 0.008)
    site = bench.model.site("grasp_left_held").id
    begin = bench.model.site_pos[site].copy()
    moved = []
    for time in (1.49, 2.5, 4.5):
        bench.force(np.zeros(bench.model.nv), time=time)
        moved.append(bench.model.site_pos[site] - begin)
    assert np.array(moved) == pytest.approx(np.array([[0, 0, 0], [0, 0, -0.008], [0, 0, -0.016]]), abs=1e-12)


def test_torque_ripples_with_the_angle_and_wind_waits_for_the_motion():
    bench = Bench("torque_ripple", "left_e1", 1.0)
    q = np.full(bench.model.nv, 0.3)
    assert bench.force(q)[bench.address("left_e1")] == pytest.approx(math.sin(18.0))
    assert not Bench("gusts", "T3", 0.1, running=False).force(q, time=1.0).any()
    assert Bench("gusts", "T3", 0.1).force(q, time=1.0).any()
