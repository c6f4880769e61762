"""A law where names end: a torque that no effect of the library makes is found with its place, quantity and curve."""

from pathlib import Path

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
import scipy.interpolate
from small_problems import H, assert_slopes_are_those_of_differences, joints, pendulum_step, recording, torque_function

from yid_ocp.config.reader import load_config
from yid_ocp.diagnosis.diagnose import diagnose
from yid_ocp.diagnosis.thresholds import Thresholds
from yid_ocp.effects.law import (
    TorqueLawTable,
    read_torque_law_tables,
    torque_law_from_tables,
    torque_law_quantity_at_midpoints,
    torque_law_tables_csv,
)
from yid_ocp.errors import ConfigError, DataError
from yid_ocp.integrator.step import compile_step, simulate
from yid_ocp.model import System
from yid_ocp.model.servos_and_springs import MOTOR_OFF_COMMAND, MotorKindAndPreset, ServoModelOptions
from yid_ocp.model.urdf import read_urdf
from yid_ocp.problem import EstimationProblem, ProblemOptions
from yid_ocp.workflow.build import build_system

JOINTS, DAMPING, NOISE = ("shoulder", "elbow"), 0.1, 0.02
UNNAMED = {"speed": lambda q, v: -0.3 * np.maximum(v, 0.0), "angle": lambda q, v: 0.1 * np.sin(6.0 * q)}


@pytest.fixture(scope="module")
def system(urdf_folder):
    robot = read_urdf(str(urdf_folder / "double_pendulum.urdf"))
    return System.build(robot, prescribed=list(JOINTS), damping=dict.fromkeys(JOINTS, DAMPING))


def moved(folder, torque, seed, seconds=4.0):
    """A recording of a known motion whose efforts are Pinocchio's inverse dynamics less a torque at the elbow."""
    model = pin.buildModelFromUrdf(str(folder / "double_pendulum.urdf"))
    data, still, rng = model.createData(), pin.neutral(model), np.random.default_rng(seed)
    t = H * np.arange(round(seconds / H) + 1)
    rate, phase = 2 * np.pi * rng.uniform([0.2, 0.6], [0.5, 1.0], (2, 2)), rng.uniform(0, 2 * np.pi, (2, 2))
    angle = rate * t[:, None, None] + phase
    q, v, a = (np.sum(0.6 * rate**k * f(angle), axis=2) for k, f in enumerate((np.sin, np.cos, lambda x: -np.sin(x))))
    effort = np.array(
        [pin.rnea(model, data, pin.integrate(model, still, x), *own) for x, *own in zip(q, v, a, strict=True)]
    )
    effort += DAMPING * v
    effort[:, 1] -= torque(q[:, 1], v[:, 1])
    group = joints(JOINTS, t, q, effort=effort + NOISE * rng.standard_normal(effort.shape), effort_std=NOISE)
    return recording(group, name=f"run_{seed}")


def problem_of(step, recordings):
    return EstimationProblem(step, recordings, ["shoulder.damping"], ProblemOptions(path_cutoff=float("inf")))


@pytest.mark.parametrize("quantity", UNNAMED)
def test_a_torque_without_a_name_is_found_at_its_joint_as_a_function_of_its_quantity(system, urdf_folder, quantity):
    truth = UNNAMED[quantity]
    runs = [moved(urdf_folder, truth, seed) for seed in range(3)]
    problem = problem_of(compile_step(system, H), runs[:2])
    found = diagnose(problem, ["gravity_tilt"], runs[2:], thresholds=Thresholds(max_effects=1))
    assert found.verdict == "unknown"
    law = found.law
    assert (law.location, law.depends_on) == ("elbow", quantity)
    assert law.closure.fraction > 0.9
    told = found.to_dict()["law"]
    assert (told["location"], told["depends_on"]) == ("elbow", quantity)
    assert [row["torque"] for row in told["table"]] == law.tables[0].torque.tolist()
    assert told["runner_up"]["closure"] < told["closure"]
    low, high = told["visited_range"][quantity]
    assert law.tables[0].knots[0] < low < high < law.tables[0].knots[-1]
    [table], inner = law.tables, slice(2, -2)
    least, at = min((f, x) for f, x in zip(table.torque, table.knots, strict=True) if low <= x <= high)
    assert f"depends on the {quantity} of elbow (from {least:.2g} N m at {at:.2g} rad" in found.summary
    assert np.all(np.abs(table.torque - truth(table.knots, table.knots))[inner] < 3 * table.torque_std[inner] + 0.02)


def test_an_effect_is_no_surer_than_a_law_of_what_is_left_moves_it(system, urdf_folder):
    """No candidate is the drag beside the dry friction of 0.3 N m."""
    runs = [moved(urdf_folder, lambda q, v: -0.3 * np.sign(v) - 0.03 * v * np.abs(v), seed) for seed in range(3)]
    found = diagnose(problem_of(compile_step(system, H), runs[:2]), ["joint_coulomb"], runs[2:])
    name, fit, beside = "joint_coulomb@elbow.tau_c", found.final_model, found.law.model.values
    assert ([own.label for own in found.accepted_effects], found.law.depends_on) == (["joint_coulomb@elbow"], "speed")
    assert fit.std[name] >= abs(beside[name] - fit.values[name]) > 0.1
    assert abs(fit.values[name] - 0.3) < 2 * fit.std[name]


def test_no_law_is_told_of_recordings_without_a_gap(system, urdf_folder):
    runs = [moved(urdf_folder, lambda q, v: 0.0, seed) for seed in range(3)]
    found = diagnose(problem_of(compile_step(system, H), runs[:2]), ["gravity_tilt"], runs[2:])
    assert found.verdict == "no_gap"
    assert found.law is None
    assert found.to_dict()["law"] is None


def tables(count=7, quantities=("angle",)):
    rng = np.random.default_rng(3)
    return [
        TorqueLawTable(name, np.linspace(-0.5, 0.7, count), rng.normal(size=count), np.ones(count))
        for name in quantities
    ]


def test_the_torque_of_a_law_is_the_spline_through_its_table_and_constant_beyond(system):
    [table] = tables()
    law = torque_law_from_tables("elbow", system, [table])
    plain, with_law = compile_step(system, H), compile_step(system.with_effects([law]), H)
    t = H * np.arange(201)
    path = np.column_stack([0.2 * np.sin(t), 1.5 * np.sin(3 * t)])
    start = np.concatenate([path[0], np.zeros(2)])
    efforts = [simulate(s, s.system.parameters.vector(), start, 200, None, path).effort for s in (plain, with_law)]
    middle = (path[1:, 1] + path[:-1, 1]) / 2
    expected = scipy.interpolate.CubicSpline(table.knots, table.torque, bc_type="natural")(np.clip(middle, -0.5, 0.7))
    # a prescribed joint's effort at a node has half of the force on either side
    np.testing.assert_allclose((efforts[0] - efforts[1])[1:, 1], (expected[1:] + expected[:-1]) / 2, atol=1e-9)
    np.testing.assert_allclose(table.interpolated_torque(middle), expected, atol=1e-12)
    assert np.ptp(middle) > 2 * np.ptp(table.knots)


def test_a_linear_law_of_a_segment_is_another_stiffness_of_all_its_joints():
    file = Path(__file__).parents[2] / "configs" / "soft_beam.yaml"
    beam = build_system(load_config(file, ["model.effects=[]", "parameters={}", "recordings={}"]))
    values = ca.vertcat(*(spring.stiffness for spring in beam.elastic_joints))
    stiffness = ca.Function("k", [beam.parameters.symbols], [values])(beam.parameters.vector()).full()[:, 0]
    assert stiffness[0] == pytest.approx(2 * stiffness[1])  # half a link
    knots = np.linspace(-2.0, 2.0, 9)
    law = torque_law_from_tables("beam", beam, [TorqueLawTable("angle", knots, -0.1 * stiffness[1] * knots, knots)])
    stiffer = beam.parameters.vector({"beam.bend": 1.1 * beam.parameters["beam.bend"].value})
    bent = beam.with_effects([law])
    start, steps = np.concatenate([np.linspace(0.05, 0.2, 10), np.zeros(10)]), 20
    moved = simulate(compile_step(bent, H), bent.parameters.vector(), start, steps).state
    np.testing.assert_allclose(moved, simulate(compile_step(beam, H), stiffer, start, steps).state, atol=1e-9)
    nodes = {"state": moved, "time_step": np.array(H)}
    for quantity, path in (("angle", (moved[1:] + moved[:-1]) / 2), ("speed", np.diff(moved, axis=0) / H)):
        seen = torque_law_quantity_at_midpoints(beam, "beam", quantity, stiffer, nodes)
        np.testing.assert_allclose(seen, path[:, :10] * stiffness / stiffness[1], rtol=1e-12)


def test_a_motor_that_is_off_has_no_command_and_none_of_its_torque(urdf_folder):
    plain = pendulum_step(urdf_folder, driven=JOINTS, servos=ServoModelOptions(motor=MotorKindAndPreset("dc")))
    law = torque_law_from_tables("elbow", plain.system, tables(quantities=("command",)))
    with_law = compile_step(plain.system.with_effects([law]), H, use_compiler=False)
    commands = np.tile([0.4, -0.3], (40, 1))
    commands[:20] = MOTOR_OFF_COMMAND
    runs = [simulate(s, s.system.parameters.vector(), [0.4, -0.3, 0, 0], 40, commands) for s in (plain, with_law)]
    # the torque of a node has half of the next step's force
    np.testing.assert_allclose(runs[1].state[:20], runs[0].state[:20], atol=1e-12)
    assert np.abs(runs[1].state[40] - runs[0].state[40]).max() > 1e-4
    nodes = {"state": runs[1].state, "torque": commands, "multipliers": np.zeros((40, 0)), "time_step": np.array(H)}
    theta = with_law.system.parameters.vector()
    seen = torque_law_quantity_at_midpoints(with_law.system, "elbow", "command", theta, nodes)
    assert np.isnan(seen[:20]).all()
    motor = torque_function(plain, {})
    middle, rate = (runs[1].state[21:, :2] + runs[1].state[20:-1, :2]) / 2, np.diff(runs[1].state[20:, :2], axis=0) / H
    damping = with_law.system.parameters["elbow.servo_damping"].value
    asked = [motor(*own)[1] + damping * own[2][1] for own in zip(commands[20:], middle, rate, strict=True)]
    np.testing.assert_allclose(seen[20:, 0], asked, rtol=1e-9)


@pytest.mark.parametrize("quantities", [("angle",), ("speed",), ("angle", "speed"), ("time",)])
def test_derivatives_by_the_values_at_the_knots(system, urdf_folder, quantities):
    law = torque_law_from_tables("elbow", system, tables(5, quantities))
    step = compile_step(system.with_effects([law]), H, use_compiler=False)
    run = moved(urdf_folder, UNNAMED["angle"], 5, seconds=0.4)
    problem = EstimationProblem(step, [run], law.parameters.names, ProblemOptions(path_cutoff=float("inf")))
    assert_slopes_are_those_of_differences(problem, lambda name, value: 1e-4, 1e-6, 1e-7)


def test_a_table_is_read_as_it_was_written(tmp_path):
    file, written = tmp_path / "law.csv", tables(6, ("angle", "speed"))
    file.write_text(torque_law_tables_csv(written))
    for own, other in zip(written, read_torque_law_tables(file, "angle+speed"), strict=True):
        assert own.quantity == other.quantity
        np.testing.assert_allclose(own.knots, other.knots, rtol=1e-9)
        np.testing.assert_allclose(own.torque, other.torque, rtol=1e-9)


HEAD = "quantity,unit,at,torque,std\n"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a,b\n1,2\n", "not that of a torque law"),
        (HEAD + "angle,rad,0,x,1\n", "line 2"),
        (HEAD + "".join(f"speed,rad/s,{x},0,0\n" for x in range(5)), "the law depends on angle"),
        (HEAD + "".join(f"angle,rad,{x},0,0\n" for x in (0, 1, 3, 4)), "evenly spaced"),
        (HEAD + "".join(f"angle,rad,{x},0,0\n" for x in (0, 1, 2)), "four or more"),
    ],
)
def test_a_table_that_is_none_is_refused(tmp_path, text, said):
    file = tmp_path / "law.csv"
    file.write_text(text)
    with pytest.raises(DataError, match=said):
        read_torque_law_tables(file, "angle")


def test_a_law_has_a_place_and_a_quantity_there(system):
    with pytest.raises(ConfigError, match="cannot act at 'nowhere'"):
        torque_law_from_tables("nowhere", system, tables())
    with pytest.raises(ConfigError, match="cannot depend on 'command'"):
        torque_law_from_tables("elbow", system, tables(quantities=("command",)))


def test_a_configuration_has_a_law_by_its_table(tmp_path):
    file = tmp_path / "law.csv"
    file.write_text(torque_law_tables_csv(tables()))
    said = f"model.effects=[{{kind: law, location: T1, depends_on: angle, law_csv: {file}}}]"
    made = build_system(load_config(None, [said]))
    assert [effect.label for effect in made.effects] == ["law@T1"]
    assert made.parameters["law@T1.angle3"].value == pytest.approx(tables()[0].torque[3])
    for wrong, text in (
        ("{kind: law, location: T1}", "has no `law_csv`"),
        (f"{{kind: kelvin_voigt, location: T1, law_csv: {file}}}", "only an effect of kind: law has `law_csv`"),
    ):
        with pytest.raises(ConfigError, match=text):
            build_system(load_config(None, [f"model.effects=[{wrong}]"]))
