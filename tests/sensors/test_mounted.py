"""Wrist force/torque sensors and inertial units: MuJoCo's own sensors, joint efforts, derivatives and recordings."""

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from yid_ocp.arrays import Array
from yid_ocp.data import JointGroup, Recording, SensorChannelGroup, read_recording, write_recording
from yid_ocp.effects import candidate_kinds_and_locations, make_effect
from yid_ocp.errors import DataError
from yid_ocp.inference.smoother_model import residual_models_with_smoother_unknowns
from yid_ocp.integrator.step import Step, compile_step
from yid_ocp.model import FlexibleSegment, Grasp, System, flexible_object
from yid_ocp.model.kinematics import forward_kinematics
from yid_ocp.model.urdf import read_urdf
from yid_ocp.problem import EstimationProblem, ProblemOptions, SensorOptions
from yid_ocp.problem.recorded_inputs import recorded_signal_kinds
from yid_ocp.sensors import SENSOR_READERS, sensor_function_with_jacobians
from yid_ocp.solvers import GaussNewton, fit_problem
from yid_ocp.workflow.build_problem import load_problem

LINK = """<link name="{}"><inertial><origin xyz="{}"/><mass value="{}"/>
<inertia ixx="{}" iyy="{}" izz="{}" ixy="{}" ixz="0" iyz="{}"/></inertial></link>"""
BODIES = [
    ("upper", "0.01 0.02 0.2", 1.2, 0.02, 0.021, 0.003, 1e-3, 0),
    ("lower", "0 0.03 0.15", 0.8, 0.012, 0.011, 0.002, 0, 1e-3),
    ("camera", "0.02 0 0", 0.1, 1e-4, 1e-4, 1e-4, 0, 0),
    ("lamp", "0.02 0 0.03", 0.15, 2e-4, 1e-4, 1e-4, 0, 0),
    ("wrist", "0.01 0 0.02", 0.2, 4e-4, 3e-4, 2e-4, 0, 0),
    ("tool", "0 0.03 0.05", 0.3, 1e-3, 1.2e-3, 4e-4, 1e-4, 0),
    ("finger", "0 0 0.04", 0.05, 1e-4, 1e-4, 2e-5, 0, 0),
]
JOINT = """<joint name="{}" type="{}"><parent link="{}"/><child link="{}"/><origin xyz="{}" rpy="{}"/><axis xyz="{}"/>
<limit lower="-3" upper="3" effort="100" velocity="10"/></joint>"""
JOINTS = [
    ("shoulder", "revolute", "base", "upper", "0 0 0.3", "0 0 0", "0 1 0"),
    ("elbow", "revolute", "upper", "lower", "0 0.05 0.4", "0.2 0 0.3", "1 0 0"),
    ("camera_mount", "fixed", "lower", "camera", "0.03 0 0.1", "0 0 0", "0 0 1"),
    ("lamp_hinge", "revolute", "camera", "lamp", "0 0.02 0", "0 0.4 0", "0 1 0"),
    ("flange", "fixed", "lower", "wrist", "0.01 0.02 0.3", "0.3 -0.4 0.8", "0 0 1"),
    ("tool_mount", "fixed", "wrist", "tool", "0 0.01 0.05", "0 0.3 0", "0 0 1"),
    ("grip", "revolute", "tool", "finger", "0 0 0.1", "0.5 0 0", "0 0 1"),
]
PARTS = "".join([*(LINK.format(*body) for body in BODIES), *(JOINT.format(*joint) for joint in JOINTS)])
ARM, START = ("shoulder", "elbow"), {"shoulder": 0.8, "elbow": 0.6}
KINDS = {"force": "wrist", "torque": "wrist", "gyro": "imu", "accelerometer": "imu"}
QUANTITIES = {"force": "force", "torque": "torque", "gyro": "angular_velocity", "accelerometer": "specific_force"}
STDS = {"force_std": 0.1, "torque_std": 0.01}


@pytest.fixture(scope="module")
def urdf(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An arm whose last link carries a camera and, beyond a wrist, a tool, each with a link on a hinge."""
    path = tmp_path_factory.mktemp("arm") / "arm.urdf"
    path.write_text(f'<robot name="arm"><link name="base"/>{PARTS}</robot>')
    return path


def test_a_sensor_reads_what_mujoco_reads(urdf: Path) -> None:
    """At any state, of what is beyond the sensor's link alone; MuJoCo's wrench is that of the sensor on it."""
    mujoco = pytest.importorskip("mujoco", reason="the other engine is MuJoCo: pip install '.[blind]'")
    system = System.build(read_urdf(urdf))
    kept = urdf.read_text().replace('name="arm">', 'name="arm"><mujoco><compiler fusestatic="false"/></mujoco>', 1)
    spec = mujoco.MjSpec.from_string(kept)
    for frame in ("wrist", "tool"):
        spec.body(frame).add_site(name=frame)
        for kind in KINDS:
            what = getattr(mujoco.mjtSensor, f"mjSENS_{kind.upper()}")
            spec.add_sensor(name=frame + kind, type=what, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=frame)
    model = spec.compile()
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    order = [model.joint(name).qposadr[0] for name in system.mechanism.joint_names]
    for frame in ("wrist", "tool"):
        for kind, group in KINDS.items():
            zeros = {QUANTITIES[kind]: np.zeros((3, 1, 3))}
            recorded = SimpleNamespace(name="r", channel_groups=[SensorChannelGroup(group, (frame,), range(3), zeros)])
            around = SimpleNamespace(system=system, recording=recorded, sensor_usage=lambda key: SensorOptions(std=1.0))
            around.node_times = np.arange(3.0)
            [mounted] = SENSOR_READERS[f"{group}.{QUANTITIES[kind]}"](around)
            read = sensor_function_with_jacobians(system, mounted.sensor, ())
            data.qpos[:], data.qvel[:], data.qfrc_applied[:] = rng.uniform(-1, 1, (3, 4)) * [[1], [2], [2]]
            mujoco.mj_forward(model, data)
            at = {"q": data.qpos[order], "v": data.qvel[order], "a": data.qacc[order]}
            own = np.array(ca.densify(read(**at, theta=system.parameters.vector())["y"])).ravel()
            expected = (-1 if kind in ("force", "torque") else 1) * data.sensor(frame + kind).data
            np.testing.assert_allclose(own, expected, rtol=1e-9, atol=1e-10)


def holding(urdf: Path, kind: str = "point", effects: Mapping[str, dict[str, float]] | None = None, **moved) -> System:
    """The arm with its hinges locked; its tool holds the end of a rod that stands on the ground."""
    robot = read_urdf(urdf, joints=ARM)
    tree, angles = robot.with_numeric_values(), ca.SX(ca.DM([START[name] for name in ARM]))
    at = forward_kinematics(tree, angles).frame_pose("tool")
    place = np.eye(4)
    place[:3, 3] = np.array(ca.DM(ca.evalf(at.translation))).ravel() - [0.17, 0.1, 0.55]
    leaning = ca.SX(ca.DM(Rotation.from_rotvec([-0.23, 0.39, 0.0]).as_matrix()))  # as a bent rod's end does
    more = {} if kind == "point" else {"held_orientation": ca.SX(ca.DM(ca.evalf(at.rotation.T @ leaning)))}
    rod = flexible_object([FlexibleSegment("T1", 0.6, 0.1, 0.02, links=3, bend=4.0, twist=3.0, damping=0.02)])
    grasp, points = Grasp("hand", "tool", "w_T1", kind, **more), ("lower", "tool", "w_T1")
    system = System.build(
        robot, objects=[(rod, None, place)], grasps=[grasp], damping=0.05, point_frames=points, **moved
    )
    return system.with_effects([make_effect(*key.split("@"), system, said) for key, said in (effects or {}).items()])


@pytest.fixture(scope="module")
def recorded(urdf: Path) -> Recording:
    """A motion of arm and rod in MuJoCo, with its own sensors on the lower link and at the rod's end, without noise."""
    mujoco = pytest.importorskip("mujoco", reason="the other engine is MuJoCo: pip install '.[blind]'")
    from yid_ocp.virtual import mujoco_simulation as engine
    from yid_ocp.virtual.joint_motion import MultisineMotion
    from yid_ocp.virtual.mjcf import mujoco_model_from_mjcf_text, mujoco_xml

    system, step = holding(urdf, driven=ARM), 2e-4
    own = "".join(f"<{kind} name='{site}{kind}' site='{site}'/>" for site in ("lower", "w_T1") for kind in KINDS)
    text = mujoco_xml(system, time_step=step).replace("</mujoco>", f"<sensor>{own}</sensor></mujoco>")
    model = mujoco_model_from_mjcf_text(text)
    scene = engine.MujocoModelAndState(system, model)
    scene.data.qpos[:] = model.qpos_spring
    scene.data.qpos[[model.joint(name).id for name in ARM]] = list(START.values())
    waves = (np.array([[0.05], [0.06]]), np.array([[1.1], [1.7]]), np.zeros((2, 1)), 0.3)
    controller = engine.TrackingController(
        scene, MultisineMotion(ARM, *waves), engine.settle_and_return_holding_torques(scene, model.dof_damping.copy())
    )
    q, read = [], {site + kind: list[Array]() for site in ("lower", "w_T1") for kind in KINDS}
    for tick in range(6001):
        controller.apply_and_return_control_input(tick * step)
        if tick % 50 == 0:
            mujoco.mj_forward(model, scene.data)
            q.append(scene.data.qpos[scene.joint_ids][:2])
            for name, values in read.items():
                values.append(scene.data.sensor(name).data.copy())
        mujoco.mj_step(model, scene.data)
    t = 0.01 * np.arange(len(q))

    def group(name: str, site: str, stds: Mapping[str, float], *kinds: str, sign: float = 1.0) -> SensorChannelGroup:
        values = {QUANTITIES[kind]: sign * np.array(read[site + kind])[:, None] for kind in kinds}
        return SensorChannelGroup(name, (site,), t, values, stds)

    inertial = ("gyro", "accelerometer"), {"angular_velocity_std": 0.01, "specific_force_std": 0.1}
    groups = [
        group(f"imu_{name}", site, inertial[1], *inertial[0]) for name, site in (("arm", "lower"), ("rod", "w_T1"))
    ]
    groups.append(group("wrist", "lower", STDS, "force", "torque", sign=-1.0))
    return Recording(JointGroup(ARM, t, np.array(q)), name="held", channel_groups=tuple(groups))


@cache
def step_of(urdf: Path, kind: str = "point", time_step: float = 0.01) -> Step:
    return compile_step(holding(urdf, kind, prescribed=ARM), time_step, use_compiler=False)


def problem(step: Step, recording: Recording, *free: str, **more) -> EstimationProblem:
    options = ProblemOptions(**{"path_cutoff": np.inf, "weak_prior_geometric_std": 0.0, **more})
    return EstimationProblem(step, [recording], free, options)


def test_predictions_converge_to_what_mujoco_recorded(urdf: Path, recorded: Recording) -> None:
    errors = []
    for step in (0.01, 0.005):
        made = problem(step_of(urdf, time_step=step), recorded, "T1.bend")
        evaluation = made.evaluate(made.initial_unknowns)
        pairs = zip(made.episodes[0].measurements, evaluation.episode_predictions[0].predicted_outputs, strict=True)
        errors.append([np.std(y - s.value) / np.std(s.value) for s, y in pairs])
    assert len(errors[0]) == 6
    assert max(errors[0]) < 0.03
    assert max(errors[1]) < 0.015
    assert np.mean(errors[1]) < 0.5 * np.mean(errors[0])  # of order two


@pytest.mark.parametrize("kind", ["point", "axis", "weld"])
def test_the_elbow_bears_what_the_wrist_reads(urdf: Path, recorded: Recording, kind: str) -> None:
    """Effort of the joint before the sensor: the torque about its axis and its damper, however the rod is held."""
    made = problem(step_of(urdf, kind, 0.005), recorded, "T1.bend")
    [found] = made.evaluate(made.initial_unknowns).episode_predictions
    where = next(i for i, s in enumerate(made.episodes[0].measurements) if s.sensor.group_name == "wrist.torque")
    inner, effort = found.predicted_outputs[where][:, 0], found.rollout.effort[2:-1:2, 1]
    speed = np.gradient(found.rollout.state[:, 1], 0.005)[2:-2:2]
    np.testing.assert_allclose(effort, 0.05 * speed - inner[: len(effort)], atol=0.01 * np.ptp(effort))


def test_slopes_with_effects_are_those_of_differences(urdf: Path, recorded: Recording) -> None:
    """Errors of the sensors, and effects that change what a wrist bears."""
    errors = {"sensor_bias@wrist:lower": {"force_x": 0.3, "torque_z": -0.1}, "sensor_scale@imu:w_T1": {"scale": 1.1}}
    bodies = {"payload@tool": {"mass": 0.2, "mz": 0.01}, "gravity_tilt@world": {"rx": 0.02}}
    forces = {"aerodynamic_drag@T1": {"cd": 2.0}, "grasp_offset@hand": {"dx": 0.01}}
    forces |= {"clock_scale@clock": {"scale": 1.05}}
    system = holding(urdf, effects=errors | bodies | forces, prescribed=ARM)
    tried = [effect.parameters.names[0] for effect in system.effects]
    step = compile_step(system, 0.01, use_compiler=False)
    made = problem(step, recorded, "T1.bend", "elbow.mass", "sensor_bias@wrist:lower.torque_z", *tried, duration=0.6)
    x, rows = made.initial_unknowns, made.residual_rows.data
    evaluation = made.evaluate(x)
    for i, size in enumerate(1e-5 * np.maximum(np.abs(x), 0.1)):
        ends = [made.evaluate(x + sign * size * np.eye(len(x))[i], False).residual[rows] for sign in (1, -1)]
        numeric = (ends[0] - ends[1]) / (2 * size)
        assert np.abs(numeric).max() > 0.1
        np.testing.assert_allclose(evaluation.jacobian[rows, i], numeric, atol=2e-6 * np.abs(numeric).max() + 4e-5)
    np.testing.assert_allclose(made.cost_and_gradient(x)[1], evaluation.jacobian.T @ evaluation.residual, rtol=1e-9)
    with_sensors = candidate_kinds_and_locations(system, recorded_signal_kinds([recorded]))
    places = {place for kind, place in with_sensors if kind == "sensor_bias"}
    assert places == {"wrist:lower", "imu:lower", "imu:w_T1"}


@pytest.mark.parametrize("name", ["wrist", "imu_rod"])
def test_unknown_forces_of_the_smoother_move_these_readings_as_an_effect_does(
    urdf: Path, recorded: Recording, name: str
) -> None:
    """A curvature at rest is a constant moment at every joint: the chained intervals give the problem's own slopes."""
    seen = replace(recorded, channel_groups=tuple(g for g in recorded.channel_groups if g.name == name))
    curved = holding(urdf, effects={"rest_curvature@T1": {}}, prescribed=ARM)
    made = problem(compile_step(curved, 0.01, use_compiler=False), seen, "rest_curvature@T1.qx")
    [model] = residual_models_with_smoother_unknowns(
        made, made.initial_unknowns, made.evaluate(made.initial_unknowns), interval=0.2
    )
    bent = [link[0] for link in curved.find_segment_layout("T1").link_joints]
    moment = 4.0 * np.isin(model.unknown_names, bent) / model.reference_std
    state, products = model.initial_state_jacobian @ moment, np.zeros(3)
    for part in model.intervals:
        own = part.state_jacobian @ state + part.unknown_jacobian @ moment
        slope = -part.negative_residual_jacobian[:, 1] / made.unknown_scales[0]
        products += own @ slope, own @ own, slope @ slope
        state = part.state_transition @ state + part.unknown_input_matrix @ moment
    assert len(model.intervals) > 3
    np.testing.assert_allclose(products / products[2], 1.0, atol=1e-5)


def test_stiffness_is_found_from_a_wrist_in_mujoco_and_from_a_synthetic_one(
    urdf: Path, recorded: Recording, tmp_path: Path
) -> None:
    [wrist] = [group for group in recorded.channel_groups if group.name == "wrist"]
    noise, rng = {"force": 0.1, "torque": 0.01}, np.random.default_rng(0)
    noisy = {q: v + noise[q] * rng.standard_normal(v.shape) for q, v in wrist.values_by_quantity.items()}
    one = replace(recorded, channel_groups=(replace(wrist, values_by_quantity=noisy),))
    made = problem(step_of(urdf, time_step=0.005), one, "T1.bend")
    write_recording(made.simulate_synthetic_recording({"T1.bend": 4.5}, seed=1), tmp_path / "made.h5")
    again = read_recording(tmp_path / "made.h5")
    assert again.channel_groups[0].names == ("lower",)
    assert again.sensor_setting_keys[2:] == ("wrist.force", "wrist.torque")
    for recording, truth in ((one, 4.0), (again, 4.5)):
        wrist_alone = {"joints.effort": SensorOptions(use=False)}
        asked = problem(step_of(urdf, time_step=0.005), recording, "T1.bend", sensors=wrist_alone)
        found = fit_problem(asked, GaussNewton()).parameters["T1.bend"]
        assert abs(found.value - truth) < 4 * found.std < 0.2


def test_noise_of_encoders_is_noise_of_what_the_sensor_weighs(urdf: Path, recorded: Recording) -> None:
    """The acceleration of the tool is worked out from angles; of the filter's gains the covariance is made."""
    loud, coarse = ({"position_std": 1e-3, "position_resolution": 0.0}, {"position_resolution": 12**0.5 * 1e-3})
    three = [replace(recorded, joints=replace(recorded.joints, **said)) for said in ({}, loud, coarse)]
    samples = (problem(step_of(urdf), r, "T1.bend", path_cutoff=10.0).episodes[0].measurements for r in three)
    quiet, noisy, stepped = ({s.sensor.group_name: s for s in of} for of in samples)
    np.testing.assert_allclose(stepped["wrist.force"].std, noisy["wrist.force"].std)
    assert quiet["wrist.force"].noise_correlation is None
    assert noisy["wrist.force"].noise_correlation is not None
    assert np.all(noisy["wrist.force"].std > quiet["wrist.force"].std)
    np.testing.assert_allclose(noisy["imu_rod.specific_force"].std, quiet["imu_rod.specific_force"].std)


@pytest.mark.parametrize(
    ("options", "changes", "message"),
    [
        ({}, {"names": ("hand",)}, "is on the frame 'hand', which does not exist"),
        ({"frame_by_recorded_name": {"lower": "base"}}, {}, "is on the frame 'base', which does not move"),
        ({}, {"noise_and_bias_stds_by_attribute": {}}, "noise of force is neither recorded nor in the settings"),
        ({"constants": {"sign": 2.0}}, {}, "sign of wrist.force"),
    ],
)
def test_sensors_that_cannot_be_compared_are_refused(
    urdf: Path, recorded: Recording, options, changes, message
) -> None:
    wrist = replace(recorded.channel_groups[-1], **changes)
    sensors = {"wrist.force": SensorOptions(**options), "wrist.torque": SensorOptions(use=False)}
    with pytest.raises(DataError, match=message):
        problem(step_of(urdf), replace(recorded, channel_groups=(wrist,)), "T1.bend", sensors=sensors)


def test_a_configuration_names_them_and_keeps_prescribed_arms_prescribed(
    urdf: Path, recorded: Recording, tmp_path: Path
) -> None:
    """Recorded efforts would drive arms whose grasps close loops, but such torques have noise."""
    efforts = replace(recorded.joints, effort=np.zeros((len(recorded.joints.t), 2)), effort_std=1.0, position_std=1e-4)
    write_recording(replace(recorded, joints=efforts), tmp_path / "run.h5")
    root = holding(urdf).mechanism.joints[2].placement.translation
    base = [float(x) for x in np.array(ca.DM(ca.evalf(root))).ravel()]
    (tmp_path / "run.yaml").write_text(f"""
model:
  robot: {urdf}
  arms: {{joints: [shoulder, elbow], mode: prescribed}}
  object:
    kind: segments
    named_segments: {{T1: {{length: 0.6, mass: 0.1, radius: 0.02, links: 3}}}}
    mount: {{xyz: {base}}}
  grasp: {{hand: {{holder_frame: tool, held_frame: w_T1, kind: point}}}}
recordings: {{estimate: [run.h5]}}
sensors: {{joints.effort: {{use: false}}}}
parameters: {{T1.bend: {{free: true, initial: 4.0}}}}
problem: {{path_cutoff: 10.0, use_compiler: false}}
""")
    made = load_problem(tmp_path / "run.yaml")
    assert made.system.prescribed == ARM
    sensors = {samples.sensor.group_name.partition("_")[0] for samples in made.episodes[0].measurements}
    assert sensors == {"wrist.force", "wrist.torque", "imu"}
    unused = [f"sensors.{key}.use=false" for key in recorded.sensor_setting_keys if key[:3] in ("imu", "wri")]
    assert load_problem(tmp_path / "run.yaml", unused).system.driven == ARM
