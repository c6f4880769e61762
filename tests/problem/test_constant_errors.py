"""Errors of efforts and clocks that are constant over a recording are noise of all its samples together."""

import math
from dataclasses import replace

import numpy as np
import pytest
from small_problems import H, pendulum_step, taken

from yid_ocp.analysis.clock_checks import problem_with_fitted_point_clocks
from yid_ocp.data.recording import JointGroup, PointGroup, Recording
from yid_ocp.inference.whitening import problem_with_whitening_at
from yid_ocp.integrator.step import compile_step
from yid_ocp.model.servos_and_springs import RobotJointSpring
from yid_ocp.model.system import System
from yid_ocp.model.urdf import read_urdf
from yid_ocp.problem import EstimationProblem, ProblemOptions
from yid_ocp.problem.measurements import (
    _estimated_constant_errors,
    subtract_estimated_bias_and_clock_errors,
    whiten_against_sensor_biases,
    whitened_measurement_sensitivities_to_sensor_errors,
)
from yid_ocp.problem.options import SensorOptions
from yid_ocp.solvers import GaussNewton, MultipleShooting, solve

BIAS = {"shoulder": 0.4, "elbow": 0.2}  # [N m]
OFFSETS = {f"effort_offset@{joint}.offset": std for joint, std in BIAS.items()}


def options(bias=None, **more):
    # accelerations of an unsmoothed path would drown the constants, were the encoders any worse
    sensors = {"joints.effort": SensorOptions(bias_std=bias), "joints.position": SensorOptions(std=1e-4)}
    return ProblemOptions(path_cutoff=math.inf, weak_prior_geometric_std=0.0, sensors=sensors, **more)


def arm(folder, bias, free, recordings=2, **how):
    """A double pendulum of which recordings say no constant error, stated as noise or free beside its prior."""
    step = pendulum_step(folder, [("effort_offset", joint, {}) for joint in BIAS], **how)
    recorded = [taken(step, seed) for seed in range(recordings)]
    if bias is not None:
        return EstimationProblem(step, recorded, free, options(bias), held_out=[taken(step, 9)])
    local = options(local_parameters=tuple(OFFSETS), prior_stds=OFFSETS)
    return EstimationProblem(step, recorded, (*free, *OFFSETS), local)


def least(problem, x):
    """The least cost over the offsets, in which it is square, and where."""
    own = [i for i, name in enumerate(problem.unknown_names) if name.startswith("effort_offset")]
    for _ in range(2):
        found = problem.evaluate(x)
        x = x.copy()
        x[own] -= np.linalg.lstsq(found.jacobian[:, own], found.residual, rcond=None)[0]
    return problem.evaluate(x, derivatives=False).cost, x


def test_the_map_is_that_of_generalised_least_squares():
    rng = np.random.default_rng(3)
    slopes, columns = rng.standard_normal((40, 3)) * [0.1, 2.0, 30.0], rng.standard_normal((40, 5))
    covariance = np.eye(40) + slopes @ slopes.T
    made = whiten_against_sensor_biases(slopes, columns)
    np.testing.assert_allclose(made.T @ made, columns.T @ np.linalg.solve(covariance, columns), rtol=1e-9)
    expected = -slopes.T @ np.linalg.solve(covariance, columns[:, 0])
    found = _estimated_constant_errors(slopes, columns[:, 0])
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)


def test_a_stated_constant_is_what_an_offset_of_every_recording_beside_its_prior_would_be(urdf_folder):
    free = ("shoulder.damping", "elbow.mass")
    stated, spelt = (arm(urdf_folder, bias, free, prescribed=tuple(BIAS)) for bias in (BIAS, None))
    found, other = (solve(problem, GaussNewton(), restarts=False) for problem in (stated, spelt))
    assert found.cost == pytest.approx(other.cost, rel=1e-9)
    for name in free:
        assert found.parameters[name].value == pytest.approx(other.parameters[name].value, rel=1e-3)
    shot = solve(stated, MultipleShooting(max_iterations=1), restarts=False)
    assert "without the constant errors" in shot.message
    plain = solve(arm(urdf_folder, 0.0, free, prescribed=tuple(BIAS)), GaussNewton(), restarts=False)
    assert plain.cost > found.cost + 10.0


def test_beside_noise_that_drives_other_joints_too(urdf_folder):
    """One joint driven, the other prescribed: the filter's rows and the constants of the other's efforts together."""
    how = {"driven": ("shoulder",), "prescribed": ("elbow",)}
    step = pendulum_step(urdf_folder, [("effort_offset", "elbow", {})], **how)
    name = "effort_offset@elbow.offset"
    recorded = [taken(step, 4, camera=False)]
    sensors = {"joints.effort": SensorOptions(std=0.05, bias_std={"shoulder": 0.1, "elbow": 0.5})}
    given = ProblemOptions(path_cutoff=math.inf, weak_prior_geometric_std=0.0, sensors=sensors)
    stated = EstimationProblem(step, recorded, ("elbow.mass",), given)
    bare = replace(given, sensors={"joints.effort": SensorOptions(std=0.05, bias_std={"shoulder": 0.1, "elbow": 0.0})})
    spelt = EstimationProblem(step, recorded, ("elbow.mass", name), replace(bare, prior_stds={name: 0.5}))
    assert stated.episodes[0].has_biases_treated_as_noise
    assert not spelt.episodes[0].has_biases_treated_as_noise
    weighted, beside = (problem_with_whitening_at(problem, problem.initial_unknowns) for problem in (stated, spelt))
    assert weighted.whitening_filters[0] is not None
    expected, _ = least(beside, spelt.initial_unknowns)
    assert weighted.evaluate(stated.initial_unknowns).cost == pytest.approx(expected, rel=1e-6)


def test_the_gradient_is_that_of_the_cost(urdf_folder):
    problem = arm(urdf_folder, BIAS, ("shoulder.damping", "elbow.mass"), prescribed=tuple(BIAS))
    x = problem.initial_unknowns * 1.1
    _, gradient, _ = problem.cost_and_gradient(x)
    for i, size in enumerate(1e-5 * np.abs(x)):
        moved = size * np.eye(len(x))[i]
        rise = problem.evaluate(x + moved, False).cost - problem.evaluate(x - moved, False).cost
        assert gradient[i] == pytest.approx(rise / (2 * size), rel=1e-5)


def test_what_is_known_of_constants_is_taken_off_the_samples(urdf_folder):
    problem = arm(urdf_folder, BIAS, ("shoulder.damping",), prescribed=tuple(BIAS))
    spelt = arm(urdf_folder, None, ("shoulder.damping",), prescribed=tuple(BIAS))
    _, x = least(spelt, spelt.initial_unknowns)
    found = problem.evaluate(problem.initial_unknowns, derivatives=False)
    for i, (episode, result) in enumerate(zip(problem.episodes, found.episode_predictions, strict=True)):
        corrected = subtract_estimated_bias_and_clock_errors(episode.measurements, result.predicted_outputs)
        pairs = zip(episode.measurements, corrected, strict=True)
        [(before, after)] = [pair for pair in pairs if pair[0].sensor.effort_joints]
        offsets = [x[spelt.unknown_names.index(f"effort_offset@{joint}.offset[{episode.name}]")] for joint in BIAS]
        np.testing.assert_allclose(before.value - after.value, np.broadcast_to(offsets, before.value.shape), rtol=1e-6)
        assert not np.any(after.bias_std), i


def test_held_out_rows_count_it_and_rows_without_a_constant_stay(urdf_folder):
    problem = arm(urdf_folder, BIAS, ("shoulder.damping",), prescribed=tuple(BIAS))
    [(episode, result)] = problem.predict_held_out(problem.initial_unknowns)
    counted = problem.whitened_held_out_residual_and_jacobian(0, episode, result).residual
    pairs = zip(episode.measurements, result.predicted_outputs, strict=True)
    plain = np.concatenate([samples.residual_and_jacobian(y).residual for samples, y in pairs])
    slopes = whitened_measurement_sensitivities_to_sensor_errors(episode.measurements)
    rows = np.any(slopes != 0, axis=1)
    np.testing.assert_allclose(counted[~rows], plain[~rows], rtol=1e-14)
    covariance = np.eye(len(plain)) + slopes @ slopes.T
    assert counted @ counted == pytest.approx(plain @ np.linalg.solve(covariance, plain), rel=1e-9)


BENCH = """<mujoco>
  <option timestep="0.00025" integrator="implicitfast"/>
  <worldbody>
    <body name="upper" pos="0 0 1">
      <joint name="shoulder" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.6"/>
      <body name="lower" pos="0 0 -0.3">
        <joint name="elbow" axis="0 1 0" {elbow}/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.015" mass="0.3"/>
        <site name="tip" pos="0 0 -0.3"/>
      </body>
    </body>
  </worldbody>
  <actuator><position joint="shoulder" kp="4000" dampratio="1"/></actuator>
</mujoco>"""


def swung(late, frequency, seed):
    """Two seconds of MuJoCo's bench: the shoulder's angle, and its tip to half a millimetre, marked `late` [s] late."""
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_string(BENCH.format(elbow='stiffness="3" damping="0.02"'))
    data, noise, begin = mujoco.MjData(model), np.random.default_rng(seed), round(late / 0.00025)
    t, angle, place = 0.01 * np.arange(200), [], []
    for k in range(8000):
        mujoco.mj_kinematics(model, data)
        if k % 40 == 0:
            angle.append(data.qpos[:1] + 1e-4 * noise.standard_normal())
        if (k + begin) % 40 == 0:
            place.append(data.site("tip").xpos + 5e-4 * noise.standard_normal(3))
        data.ctrl = 0.7 * np.sin(2 * np.pi * frequency * k / 4000) * np.sin(np.pi * k / 8000) ** 2
        mujoco.mj_step(model, data)
    seen = PointGroup("points", ("tip",), t + 0.01, np.array(place)[:, None])
    return Recording(JointGroup(("shoulder",), t, np.array(angle)), (seen,), name=f"run_{seed}")


def test_damping_is_right_where_markers_are_late(tmp_path):
    file = tmp_path / "bench.xml"
    file.write_text(BENCH.format(elbow=""))
    seen = {"prescribed": ["shoulder"], "point_frames": ["tip"], "springs": {"elbow": RobotJointSpring(2.0, 0.0)}}
    step = compile_step(System.build(read_urdf(file), damping={"elbow": 0.05}, **seen), 0.005)
    late = [swung(0.0005, frequency, i) for i, frequency in enumerate((0.9, 1.4))]
    truth, problems = {"elbow.stiffness": 3.0, "elbow.damping": 0.02}, {}
    for std in (0.0, None):
        sensors = {"joints.position": SensorOptions(std=1e-4), "points": SensorOptions(std=5e-4, clock_offset_std=std)}
        told = ProblemOptions(path_cutoff=20.0, sensors=sensors, has_uncertain_point_clocks=True)
        problems[std] = EstimationProblem(step, late, tuple(truth), told)
    far = [
        replace(made, points=(replace(made.points[0], t=made.points[0].t + shift, clock_offset_std=0.03),))
        for made, shift in zip((*late, swung(0.0005, 1.1, 2)), (0.03, -0.02, 0.025), strict=True)
    ]
    problem = EstimationProblem(step, far[:2], tuple(truth), told, held_out=far[2:])
    problems["fitted"], doubts = problem_with_fitted_point_clocks(problem)
    fitted = [episode.recording for episode in (*problems["fitted"].episodes, *problems["fitted"].held_out)]
    shifts = [1e3 * (own.points[0].t - made.points[0].t)[0] for own, made in zip(far, fitted, strict=True)]
    assert shifts == pytest.approx([30.5, -19.5, 25.5], abs=0.5), "of held-out recordings too"
    assert doubts == [], "within what is stated"
    sure = [replace(own, points=(replace(own.points[0], clock_offset_std=0.01),)) for own in far]
    _, doubts = problem_with_fitted_point_clocks(
        EstimationProblem(step, sure[:2], tuple(truth), told, held_out=sure[2:])
    )
    assert [doubt.recording for doubt in doubts] == [sure[0].name, sure[2].name]
    assert " ms late by a fit" in doubts[0].what
    before, after = (solve(own, GaussNewton()).goodness_of_fit.chi2_per_dof for own in (problem, problems["fitted"]))
    assert before > 1.5
    assert after == pytest.approx(1.0, abs=0.15)
    found = {std: solve(problem, GaussNewton()).parameters for std, problem in problems.items()}
    off = {std: (own["elbow.damping"].value - 0.02) / own["elbow.damping"].std for std, own in found.items()}
    assert all(found[std][name].verdict == "identifiable" for std in (None, "fitted") for name in truth)
    assert max(abs(off[None]), abs(off["fitted"])) < 2.5
    assert abs(off[0.0]) > 5.0, "an offset that is denied is taken for damping"


@pytest.mark.parametrize(
    ("free", "effects", "clock_offset_std", "group", "expected"),
    [
        ("elbow.damping", (), None, "points_mocap", H / 2),
        ("elbow.mass", (), None, "points_mocap", None),
        ("elbow.damping", (), None, "points_arm", None),
        ("elbow.damping", (), 0.0, "points_mocap", None),
        ("elbow.mass", (), 0.01, "points_mocap", 0.01),
        ("elbow.damping", (("camera_latency", "points_mocap", {}),), None, "points_mocap", None),
    ],
    ids=["half a sample", "no damper is free", "the arm's", "one clock", "as stated", "an effect of the model says it"],
)
def test_a_clock_is_uncertain_where_dampers_are_free(urdf_folder, free, effects, clock_offset_std, group, expected):
    step = pendulum_step(urdf_folder, effects, prescribed=tuple(BIAS))
    sensors = {
        "joints.position": SensorOptions(std=1e-4),
        "points_mocap": SensorOptions(clock_offset_std=clock_offset_std),
    }
    told = ProblemOptions(sensors=sensors, has_uncertain_point_clocks=True)
    made = taken(step, 3, efforts=False, camera=False)
    made = replace(made, points=(replace(made.points[0], name=group),))
    problem = EstimationProblem(step, [made], (free,), told)
    [samples] = [own for own in problem.episodes[0].measurements if own.sensor.group_name == group]
    assert samples.has_uncertain_biases_or_clock is (expected is not None)
    if expected is not None:
        rates = np.gradient(samples.value, H, axis=0)
        np.testing.assert_allclose(samples.change_by_clock, expected * rates, rtol=1e-6)
