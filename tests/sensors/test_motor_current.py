"""Motor currents: a sensor that is one file; damping found from currents that another engine made."""

from dataclasses import replace

import h5py
import numpy as np
import pytest
from small_problems import PENDULUM

from yid_ocp.data import JointGroup, Recording, SensorChannelGroup, read_recording, write_recording
from yid_ocp.errors import ConfigError, DataError
from yid_ocp.integrator.step import compile_step
from yid_ocp.model import System
from yid_ocp.model.urdf import read_urdf
from yid_ocp.problem import EstimationProblem, ProblemOptions, SensorOptions
from yid_ocp.solvers import GaussNewton, fit_problem
from yid_ocp.workflow.build_problem import load_problem

CONSTANTS = {"shoulder": 0.5, "elbow": -0.2}  # [N m/A]
TRUTH = {"shoulder.damping": 0.3, "elbow.damping": 0.2}
NOISE = 0.05  # [A]
T = 0.01 * np.arange(401)
KEY = "motors.current"
KNOWN = SensorOptions(constants={"torque_constant": CONSTANTS})


@pytest.fixture(scope="module")
def made(urdf_folder) -> Recording:
    """The motion of a double pendulum and its currents by Pinocchio's inverse dynamics, elbow first."""
    pin = pytest.importorskip("pinocchio", reason="the other engine is Pinocchio: pip install pin")
    model = pin.buildModelFromUrdf(str(urdf_folder / "double_pendulum.urdf"))
    data, start, size, rate = model.createData(), pin.neutral(model), np.array([0.6, 0.5]), np.array([2.9, 3.7])
    turned = T[:, None] * rate + [0.0, 1.0]
    q, v, a = size * np.sin(turned), size * rate * np.cos(turned), -size * rate**2 * np.sin(turned)
    states = zip(q, v, a, strict=True)
    effort = np.array([pin.rnea(model, data, pin.integrate(model, start, x), *row) for x, *row in states])
    effort += v * list(TRUTH.values())
    current = effort / list(CONSTANTS.values())
    current += NOISE * np.random.default_rng(0).standard_normal(current.shape)
    names, values = ("elbow", "shoulder"), {"current": current[:, ::-1]}
    motors = SensorChannelGroup("motors_left", names, T, values, {"current_std": NOISE})
    return Recording(JointGroup(PENDULUM, T, q, position_std=0.0), name="arm", channel_groups=(motors,))


@pytest.fixture(scope="module")
def step(urdf_folder):
    system = System.build(read_urdf(urdf_folder / "double_pendulum.urdf"), prescribed=PENDULUM, damping=0.1)
    return compile_step(system, 0.01, use_compiler=False)


def problem_of(step, made, options=KNOWN) -> EstimationProblem:
    settings = ProblemOptions(path_cutoff=10.0, weak_prior_geometric_std=0.0, sensors={"motors_left.current": options})
    return EstimationProblem(step, [made], tuple(TRUTH), settings)


def test_damping_is_found_from_currents_of_another_engine(step, made):
    problem = problem_of(step, made)
    [samples] = problem.episodes[0].measurements
    assert samples.sensor.channel_names == ("motors_left.current.shoulder", "motors_left.current.elbow")
    assert (samples.sensor.unit, samples.sensor.effort_joints) == ("A", PENDULUM)
    solution = fit_problem(problem, GaussNewton())
    for name, true in TRUTH.items():
        found = solution.parameters[name]
        assert abs(found.value - true) < 4 * found.std < 0.1
    assert 0.7 < solution.evaluation.cost / (samples.n_residuals / 2) < 1.3


def test_currents_say_what_efforts_say(step, made):
    """Over a constant, they give the residual and the slopes of an effort sensor with as much noise."""
    motors, joints = made.channel_groups[0], made.joints
    effort = motors.values_by_quantity["current"][:, ::-1] * list(CONSTANTS.values())
    known = replace(joints, effort=effort, effort_std=NOISE * np.abs(list(CONSTANTS.values())), position_std=1e-4)
    pair = []
    for recording in (replace(made, joints=replace(joints, position_std=1e-4)), replace(made, joints=known)):
        pair.append(problem_of(step, recording, replace(KNOWN, use=recording.joints.effort is None)))
    one, other = (problem.evaluate(problem.initial_unknowns) for problem in pair)
    assert one.cost == pytest.approx(other.cost, rel=1e-9)
    np.testing.assert_allclose(one.jacobian.T @ one.residual, other.jacobian.T @ other.residual, rtol=1e-8)
    _, gradient, _ = pair[0].cost_and_gradient(pair[0].initial_unknowns)
    np.testing.assert_allclose(gradient, one.jacobian.T @ one.residual, rtol=1e-8)


def test_encoders_are_as_noisy_however_often_currents_are_read(step, made):
    joints, found = replace(made.joints, position_std=1e-4), []
    for t in (T, np.linspace(0.0, 4.0, 4001), np.linspace(0.0, 4.0, 201)):
        silent = {"values_by_quantity": {"current": np.zeros((len(t), 2))}}
        motors = replace(made.channel_groups[0], t=t, noise_and_bias_stds_by_attribute={"current_std": 1e-9}, **silent)
        problem = problem_of(step, replace(made, joints=joints, channel_groups=(motors,)))
        found.append(problem.episodes[0].measurements[0].std.max(axis=0))
    np.testing.assert_allclose(found[1:], [found[0]] * 2, rtol=0.01)


def test_a_synthetic_recording_holds_currents(step, made):
    again = problem_of(step, made).simulate_synthetic_recording(TRUTH, seed=1)
    [motors] = again.channel_groups
    assert (motors.name, motors.names) == ("motors_left", PENDULUM)
    assert motors.values_by_quantity["current"].shape == (401, 2)
    again = replace(again, name="arm", joints=replace(again.joints, effort=None))
    found = fit_problem(problem_of(step, again), GaussNewton()).parameters
    assert all(abs(found[name].value - true) < 4 * found[name].std for name, true in TRUTH.items())


def test_the_file_keeps_currents_and_refuses_what_no_sensor_declares(tmp_path, made):
    write_recording(made, tmp_path / "run.h5")
    [one], [other] = made.channel_groups, read_recording(tmp_path / "run.h5").channel_groups
    for field in ("name", "names", "noise_and_bias_stds_by_attribute", "clock"):
        assert getattr(one, field) == getattr(other, field)
    np.testing.assert_array_equal(one.values_by_quantity["current"], other.values_by_quantity["current"])
    with h5py.File(tmp_path / "run.h5") as file:
        assert {key: file["motors_left"][key].attrs["unit"] for key in ("t", "current")} == {"t": "s", "current": "A"}
    assert made.time_slice(1.0, 2.0).channel_groups[0].t[[0, -1]] == pytest.approx([1.0, 2.0])
    assert made.sensor_setting_keys == ("joints.effort", "joints.position", "motors_left.current")
    for change, message in (
        (lambda file: file.create_group("motor"), "unknown group, 'motor'"),
        (lambda file: file["motors_left"].create_dataset("voltage", data=T), "unknown dataset, 'voltage'"),
        (lambda file: file["motors_left"].attrs.update(voltage_std=1.0), "unknown attribute, 'voltage_std'"),
        (lambda file: file["motors_left/current"].attrs.update(unit="mA"), "the unit is 'mA', but must be 'A'"),
        (lambda file: file["motors_left"].__delitem__("t"), "the dataset 't' is missing"),
        (lambda file: file["motors_left"].__delitem__("current"), "the group has no dataset"),
    ):
        write_recording(made, tmp_path / "changed.h5")
        with h5py.File(tmp_path / "changed.h5", "a") as file:
            change(file)
        with pytest.raises(DataError, match=message):
            read_recording(tmp_path / "changed.h5")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"values_by_quantity": {"current": np.zeros((400, 2))}}, r"shape \(400, 2\)"),
        ({"values_by_quantity": {"current": np.full((401, 2), np.nan)}}, "not finite"),
        ({"values_by_quantity": {"voltage": np.zeros((401, 2))}}, "unknown dataset, 'voltage'"),
        ({"noise_and_bias_stds_by_attribute": {"current_std": -1.0}}, "current_std is -1.0"),
        ({"name": "engines"}, "unknown dataset, 'current'"),
        ({"t": T[::-1]}, "does not advance"),
    ],
)
def test_a_group_that_cannot_be_written_is_refused(tmp_path, made, changes, message):
    group = replace(made.channel_groups[0], **changes)
    with pytest.raises(DataError, match=message):
        write_recording(replace(made, channel_groups=(group,)), tmp_path / "run.h5")


@pytest.mark.parametrize(
    ("options", "changes", "message"),
    [
        (SensorOptions(), {}, "motors' torque constants are not stated"),
        (SensorOptions(constants={"torque_constant": 0.0}), {}, "torque constant of joint 'shoulder' is zero"),
        (SensorOptions(constants={"torque_constant": {"elbow": 1.0}}), {}, "'shoulder' has no value"),
        (
            SensorOptions(constants={"torque_constant": {"elbow": 1.0, "sholder": 1.0}}),
            {},
            "no recorded joint 'sholder'",
        ),
        (KNOWN, {"noise_and_bias_stds_by_attribute": {}}, "standard deviation of the noise of the motor currents"),
        (KNOWN, {"names": ("elbow", "sholder")}, "no joint 'sholder', whose current is recorded"),
        (replace(KNOWN, use=False), {}, "no sensor of the model has a measurement"),
        (KNOWN, {"t": T[:1], "values_by_quantity": {"current": np.zeros((1, 2))}}, "0 s of motors_left.current"),
        (
            KNOWN,
            {"t": T[:20], "values_by_quantity": {"current": np.zeros((20, 2))}},
            r"0\.19 s of motors_left.current are too short",
        ),
    ],
)
def test_currents_that_cannot_be_compared_are_refused(step, made, options, changes, message):
    group = replace(made.channel_groups[0], **changes)
    with pytest.raises((DataError, ConfigError), match=message):
        problem_of(step, replace(made, channel_groups=(group,)), options)


def test_a_configuration_names_them(tmp_path, urdf_folder, made):
    write_recording(made, tmp_path / "run.h5")
    text = f"""
model:
  robot: {urdf_folder / "double_pendulum.urdf"}
  arms: {{mode: prescribed}}
  damping: {{shoulder: 0.1, elbow: 0.1}}
recordings: {{estimate: [run.h5]}}
sensors: {{motors_left.current: {{constants: {{torque_constant: {{shoulder: 0.5, elbow: -0.2}}}}}}}}
parameters: {{"*.damping": {{free: true}}}}
"""
    (tmp_path / "run.yaml").write_text(text)
    problem = load_problem(tmp_path / "run.yaml")
    assert [s.sensor.group_name for s in problem.episodes[0].measurements] == ["motors_left.current"]
    assert load_problem(tmp_path / "run.yaml", ["sensors.motors_left.current.std=0.2"]).evaluate(
        problem.initial_unknowns
    ).cost == pytest.approx(problem.evaluate(problem.initial_unknowns).cost / 16, rel=1e-6)
    with pytest.raises(ConfigError, match="no constant 'torque_constan'"):
        load_problem(tmp_path / "run.yaml", ["sensors.motors_left.current.constants={torque_constan: 1}"])
    with pytest.raises(ConfigError, match=r"no recording has the sensor 'motors\.current'"):
        load_problem(tmp_path / "run.yaml", ["sensors.motors.current.std=0.2"])
