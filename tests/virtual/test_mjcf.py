"""Systems and effects in MuJoCo's terms: equal to the equations that they have here, or refused."""

import re
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from virtual_examples import SYSTEMS, TRUTH, mujoco

from yid_ocp.effects import EFFECTS, make_effect
from yid_ocp.errors import ModelError
from yid_ocp.export.models import export_support_by_effect
from yid_ocp.model import FlexibleSegment, Grasp, Parameter, Parameters, System, flexible_object
from yid_ocp.model.kinematics import forward_kinematics, lagrangian_first_derivatives, mass_matrix
from yid_ocp.model.mechanism import Frame, Inertia, Placement
from yid_ocp.model.system import Effect, EffectStepTerms, MidpointStateSymbols, six_joint_floating_mechanism
from yid_ocp.model.urdf import read_urdf
from yid_ocp.virtual.mjcf import CasadiEvaluator, mujoco_model_from_mjcf_text, mujoco_xml, system_joint_dynamics_terms

MECHANICAL = {
    "kelvin_voigt": ("T", {"tau": 0.05}),
    "cubic_stiffness": ("T", {"k3": 4.0}),
    "rest_curvature": ("T", {"qx": 0.1, "qy": -0.05}),
    "bend_anisotropy": ("T", {"ratio": 0.3}),
    "joint_spring": ("elbow", {"stiffness": 5.0, "rest_angle": 0.4}),
    "density": ("B", {"scale": 1.2}),
    "link_mass": ("elbow", {"scale": 0.8}),
    "point_mass": ("w_B", {"mass": 0.05}),
    "payload": ("tip", {"mass": 0.4, "mx": 0.02, "mz": 0.04}),
    "length_scale": ("T", {"scale": 1.02}),
    "rotor_inertia": ("shoulder", {"armature": 0.3}),
    "joint_viscous": ("elbow", {"b": 0.2}),
    "gravity_tilt": ("world", {"rx": 0.02, "ry": -0.03}),
    "mount_compliance": ("base", {"stiffness": 50.0}),
}
OTHERS = {
    "gravity_scale": ("object", {"fraction": -0.4}, "native"),
    "grasp_offset": ("hold", {"dx": 0.01}, "native"),
    "effort_gain": ("elbow", {"scale": 1.25}, "native"),
    "effort_offset": ("elbow", {"offset": 0.3}, "native"),
    "effort_delay": ("gripper", {"delay": 0.02}, "native"),
    "effort_lag": ("elbow", {"time_constant": 0.03}, "native"),
    "joint_coulomb": ("elbow", {"tau_c": 0.4}, "emulated"),
    "joint_presliding": ("elbow", {"tau_c": 0.4}, "emulated"),
    "grasp_compliance": ("hold", {"stiffness": 500.0, "damping": 3.0}, "emulated"),
    "standard_linear_solid": ("T", {"ratio": 0.3}, "not representable"),
    "hysteresis": ("T", {"stiffness": 0.5}, "not representable"),
    "joint_stribeck": ("elbow", {"tau_s": 0.3}, "not representable"),
    "aerodynamic_drag": ("T", {"cd": 1.0}, "not representable"),
    "grasp_slip": ("hold", {"slip_per_load": 1e-3}, "not representable"),
    "encoder_offset": ("elbow", {"offset": 0.01}, "not representable"),
    "series_elasticity": ("elbow", {"stiffness": 500.0}, "not representable"),
    "backlash": ("elbow", {"width": 0.01}, "not representable"),
    "camera_translation": ("camera", {"x": 0.01}, "not representable"),
    "camera_rotation": ("camera", {"rx": 0.01}, "not representable"),
    "camera_scale": ("camera", {"scale": 1.01}, "not representable"),
    "camera_latency": ("camera", {"delay": 0.05}, "not representable"),
    "surface_offset": ("camera", {"fraction": 0.5}, "not representable"),
    "sensor_bias": ("wrist:tip", {"force_x": 1.0}, "not representable"),
    "sensor_scale": ("imu:tip", {"scale": 1.1}, "not representable"),
    "clock_scale": ("clock", {"scale": 1.05}, "not representable"),
    # two branches on joints without mass, which only writing the model shows
    "junction_compliance": ("w_T", {"stiffness": 50.0}, "native"),
}


# actuators of another system: tests/virtual/test_vocabulary_twins.py
OF_SERVOS = {"servo_gain", "servo_delay", "servo_saturation", "supply_voltage", "back_emf"}


def clamped_beam() -> System:
    beam = flexible_object([FlexibleSegment("B", 0.5, 0.2, 0.01, links=3)], name="beam")
    clamp = six_joint_floating_mechanism("clamp")
    body = Inertia.from_values(0.3, [0.01, 0.02, 0.03], np.diag([1e-3, 2e-3, 2.5e-3]))
    clamp = replace(clamp, joints=(*clamp.joints[:-1], replace(clamp.joints[-1], bodies=(body,))))
    return System.build(clamp, objects=[(beam, "clamp", None)], driven=["clamp_x"], damping=0.1)


def assert_same_mechanics(system: System, values: dict[str, float]) -> None:
    """Mass matrix, bias and passive forces, and places of points are in MuJoCo what they are in symbols."""
    q, v = ca.SX.sym("q", system.n_coordinates), ca.SX.sym("v", system.n_coordinates)
    kinematics, none = forward_kinematics(system.mechanism, q), ca.SX(0, 1)
    rigid = lagrangian_first_derivatives(kinematics, v, system.gravity)
    mass = mass_matrix(rigid, system.mechanism)
    bias = ca.jtimes(rigid.lagrangian_by_v, q, v) - rigid.lagrangian_by_q
    passive = system.viscous_force(v) - ca.gradient(system.elastic_energy(q), q)
    for joint, compliance in system.joint_compliances.items():
        at = system.mechanism.joint_index(joint)
        passive[at] -= (q[at] + system.joint_relaxation_times[joint] * v[at]) / compliance
    for effect in system.effects:
        terms = effect.step_terms(MidpointStateSymbols(system, kinematics, q, v, none, none, none, none, {}, ca.SX(1)))
        mass, passive = mass + ca.hessian(terms.lagrangian, v)[0], passive + ca.gradient(terms.lagrangian, q)
        passive += 0 if terms.dissipative_force is None else terms.dissipative_force
    points = ca.horzcat(ca.SX(3, 0), *(kinematics.frame_position(name) for name in system.point_frames))
    ours = ca.Function("ours", [q, v, system.parameters.symbols], [mass, bias, passive, points])
    model = mujoco_model_from_mjcf_text(mujoco_xml(system, values))
    data = mujoco.MjData(model)
    order = [model.joint(name).id for name in system.mechanism.joint_names]
    assert model.nv == system.n_coordinates
    rng = np.random.default_rng(0)
    for _ in range(2):
        posture, velocity = rng.uniform(-1, 1, (2, system.n_coordinates))
        data.qpos[order], data.qvel[order] = posture, velocity
        mujoco.mj_forward(model, data)
        full = np.zeros((model.nv, model.nv))
        for column in range(model.nv):
            mujoco.mj_mulM(model, data, full[column], np.eye(model.nv)[column])
        expected = [np.array(ca.densify(e)) for e in ours(posture, velocity, system.parameters.vector(values))]
        np.testing.assert_allclose(full[np.ix_(order, order)], expected[0], rtol=0, atol=1e-9)
        np.testing.assert_allclose(data.qfrc_bias[order], expected[1].ravel(), rtol=0, atol=1e-9)
        np.testing.assert_allclose(data.qfrc_passive[order], expected[2].ravel(), rtol=1e-9, atol=1e-9)
        seen = np.array([data.site(name).xpos for name in system.point_frames]).reshape(-1, 3)
        np.testing.assert_allclose(seen, expected[3].T, rtol=0, atol=1e-9)


@pytest.fixture(scope="module")
def system() -> System:
    """Two driven joints, a trunk with two branches, the tip of one of them held by the ceiling."""
    branches = [FlexibleSegment(name, 0.2, 0.1, 0.01, 1, parent="T", bend=6.0) for name in "BC"]
    item = flexible_object([FlexibleSegment("T", 0.4, 0.2, 0.01, 2, bend=8.0, twist=5.0), *branches])
    robot = read_urdf("default:double_pendulum.urdf")
    grasps = [Grasp("hold", "ceiling", "w_B")]
    return System.build(robot, objects=[(item, "tip", None)], grasps=grasps, driven=robot.joint_names, damping=0.1)


def with_effect(system: System, kind: str, location: str, values: dict[str, float]) -> System:
    return system.with_effects([make_effect(kind, location, system, values)])


def test_every_kind_of_the_library_is_looked_at() -> None:
    ours = {kind for kind in EFFECTS if EFFECTS[kind].__module__.startswith("yid_ocp.effects")}
    assert set(MECHANICAL) | set(OTHERS) | OF_SERVOS | {"joint_load_friction", "current_limit"} == ours


@pytest.mark.parametrize("kind", MECHANICAL)
def test_mechanics_of_an_effect_equals_the_symbolic_one(system: System, kind: str) -> None:
    assert_same_mechanics(with_effect(system, kind, *MECHANICAL[kind]), {})


@pytest.mark.parametrize("kind", [*MECHANICAL, *OTHERS])
def test_what_is_said_of_it(system: System, kind: str) -> None:
    location, values, *status = (*MECHANICAL[kind], "native") if kind in MECHANICAL else OTHERS[kind]
    [said] = export_support_by_effect(with_effect(system, kind, location, values), {}, "mjcf").values()
    assert [said.status] == status
    neutral = with_effect(system, kind, location, {})
    assert export_support_by_effect(neutral, {}, "mjcf")[f"{kind}@{location}"].how.startswith("it changes nothing")


def test_what_has_no_term_is_refused(system: System) -> None:
    for kind, (location, values, status) in OTHERS.items():
        changed = with_effect(system, kind, location, values)
        [said] = export_support_by_effect(changed, {}, "mjcf").values()
        motion = not said.how.startswith("what a sensor reads")
        if kind == "junction_compliance" or (status == "not representable" and motion):
            with pytest.raises(ModelError):
                mujoco_xml(changed, standalone=True)
        if status == "emulated":
            with pytest.raises(ModelError):
                mujoco_xml(changed)
            mujoco_xml(changed, standalone=True)


def test_a_part_of_the_weight(system: System) -> None:
    changed = with_effect(system, "gravity_scale", "object", {"fraction": -0.4})
    model, whole = (mujoco_model_from_mjcf_text(mujoco_xml(s)) for s in (changed, system))
    light, heavy = mujoco.MjData(model), mujoco.MjData(whole)
    for m, d in ((model, light), (whole, heavy)):
        d.qpos[:] = np.linspace(-0.5, 0.5, m.nq)
        mujoco.mj_forward(m, d)
    loads = np.zeros(model.nv)  # of the object's weight, by the Jacobians of its bodies
    for body in range(model.nbody):
        if model.body(body).name.startswith(("T_", "B_", "C_")):
            jacobian = np.zeros((3, model.nv))
            mujoco.mj_jacBodyCom(whole, heavy, jacobian, None, body)
            loads += jacobian.T @ (whole.body_mass[body] * whole.opt.gravity)
    np.testing.assert_allclose(light.qfrc_passive - heavy.qfrc_passive, -0.4 * loads, atol=1e-9)


def test_recorded_torques_become_those_that_act(system: System) -> None:
    system = replace(system, grasps=(), gravity=ca.SX(ca.DM.zeros(3)))
    for kind in ("effort_gain", "effort_offset", "effort_lag"):
        location, values, _ = OTHERS[kind]
        system = with_effect(system, kind, location, values)
    for changed, delay in ((system, 0.0), (with_effect(system, "effort_delay", "gripper", {"delay": 0.02}), 0.02)):
        model = mujoco_model_from_mjcf_text(mujoco_xml(changed, time_step=1e-3, standalone=True))
        data = mujoco.MjData(model)
        at, found = model.joint("elbow").id, []
        for _ in range(120):
            data.ctrl[:] = 2.0
            mujoco.mj_step(model, data)
            found.append(data.qfrc_actuator[at])
        # the lag acts on what was recorded, the other two on what follows it
        t = 1e-3 * np.arange(120) - delay
        expected = 2.0 * (1 - np.exp(-np.maximum(t, 0.0) / 0.03)) / 1.25 - 0.3 / 1.25
        np.testing.assert_allclose(found, expected, atol=0.06)  # a step late
        assert found[-1] == pytest.approx(expected[-1], abs=2e-3)


def test_a_grasp_that_gives_way_is_a_tendon(system: System) -> None:
    changed = with_effect(system, *("grasp_compliance", *OTHERS["grasp_compliance"][:2]))
    model = mujoco_model_from_mjcf_text(mujoco_xml(changed, standalone=True))
    data = mujoco.MjData(model)
    data.qpos[:] = 0.1
    mujoco.mj_forward(model, data)
    apart = data.site("grasp_hold_holder").xpos - data.site("grasp_hold_held").xpos
    jacobian = np.zeros((3, model.nv))
    mujoco.mj_jacSite(model, data, jacobian, None, model.site("grasp_hold_held").id)
    plain = mujoco_model_from_mjcf_text(mujoco_xml(replace(changed, grasps=()), standalone=True))
    other = mujoco.MjData(plain)
    other.qpos[:] = 0.1
    mujoco.mj_forward(plain, other)
    np.testing.assert_allclose(data.qfrc_passive - other.qfrc_passive, 500.0 * jacobian.T @ apart, atol=1e-8)
    assert model.tendon_damping[0] == pytest.approx(3.0)


def test_dry_friction_is_friction_of_the_joint(system: System) -> None:
    changed = with_effect(system, "joint_coulomb", "elbow", {"tau_c": 0.4})
    assert system_joint_dynamics_terms(changed, CasadiEvaluator(changed))["elbow"].dry_friction == 0.4
    model = mujoco_model_from_mjcf_text(mujoco_xml(changed, standalone=True))
    assert model.dof_frictionloss[model.joint("elbow").id] == 0.4


def test_the_page_lists_what_is_native(repository) -> None:
    text = (repository / "docs" / "howto" / "export.md").read_text(encoding="utf-8")
    rows = re.search(r"\| effect \| meaning \| in MJCF \|\n(.*?)\n\n", text, re.DOTALL)
    listed = {kind for row in rows[1].splitlines()[1:] for kind in re.findall(r"`(\w+)`", row.split("|")[1])}
    native = {kind for kind, (*_, status) in OTHERS.items() if status == "native"} - {"junction_compliance"}
    assert listed == native | set(MECHANICAL) | OF_SERVOS


@pytest.mark.parametrize(
    ("system", "values"),
    [
        (SYSTEMS[1], TRUTH),
        (SYSTEMS[2], {**TRUTH, "T2.mass": 0.03, "T3.length": 0.9, "left_w0.mass": 3.0}),
        (clamped_beam(), {"B.length": 0.6}),
        (replace(clamped_beam(), point_frames=("w_B", "B:40%")), {}),
    ],
    ids=["single", "dual", "clamp", "along"],
)
def test_mechanics_equals_the_symbolic_one(system: System, values: dict[str, float]) -> None:
    assert_same_mechanics(system, values)


class Pull(Effect):
    def step_terms(self, state: MidpointStateSymbols) -> EffectStepTerms:
        return EffectStepTerms(generalized_force=self.parameters["pull@T1.force"].symbol * state.v)


def test_what_mujoco_cannot_express_is_refused() -> None:
    system = clamped_beam()
    with_effect = system.with_effects([Pull("pull", "T1", Parameters([Parameter("pull@T1.force", 0.0, "N m")]))])
    assert mujoco_xml(with_effect) == mujoco_xml(system)
    with pytest.raises(ModelError, match="pull@T1"):
        mujoco_xml(with_effect, {"pull@T1.force": 1.0})
    grasp = Grasp("clamp", "clamp", "w_B", compliance=ca.SX(1e-3))
    with pytest.raises(ModelError, match="compliant"):
        mujoco_xml(replace(system, grasps=(grasp,)))
    with pytest.raises(ModelError, match="compliance of joint 'B_0_x' is zero"):
        mujoco_xml(replace(system, joint_compliances={"B_0_x": ca.SX(0)}))
    with pytest.raises(ModelError, match="has a mass"):
        mujoco_xml(System.build(six_joint_floating_mechanism("clamp")))
    beam = flexible_object([FlexibleSegment("B", 0.5, 0.2, 0.01)])
    tree = SYSTEMS[1].mechanism
    bare = Frame(tree.joint_index("T2_1_y"), Placement.identity())
    with pytest.raises(ModelError, match="seven joints in series have no mass"):
        mujoco_xml(System.build(six_joint_floating_mechanism("clamp"), objects=[(beam, "clamp", None)]))
    tree = replace(tree, frames={**tree.frames, "bare": bare})
    with pytest.raises(ModelError, match="is on a joint without mass"):
        mujoco_xml(replace(SYSTEMS[1], point_frames=("bare",), mechanism=tree))
