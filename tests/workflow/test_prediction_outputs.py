"""Trajectories, held-out errors beside guesses, and torque offsets as they are written."""

from dataclasses import replace
from types import SimpleNamespace

import h5py
import mujoco
import numpy as np
import pytest
from small_problems import pendulum_step

from yid_ocp.analysis import estimation
from yid_ocp.analysis.estimation import prediction_errors_units_and_fit_rmse
from yid_ocp.config.reader import load_config
from yid_ocp.data import read_recording, write_recording
from yid_ocp.data.recording import JointGroup, Recording
from yid_ocp.diagnosis.events import NO_EVENTS
from yid_ocp.diagnosis.pulse_detection import ForceEstimate
from yid_ocp.effects import make_effect
from yid_ocp.errors import OutputError
from yid_ocp.inference.uncertainty import ParameterEstimate
from yid_ocp.inference.whitening import problem_with_exact_inputs, problem_with_whitening_at
from yid_ocp.model.servos_and_springs import StiffnessAndRest
from yid_ocp.model.system import System
from yid_ocp.problem import EstimationProblem, ProblemOptions, SensorOptions
from yid_ocp.report.summaries import _noise_cells
from yid_ocp.report.terminal import copyable_estimates_blocks, summary_terminal_lines, torque_offset_table
from yid_ocp.workflow import prediction_outputs
from yid_ocp.workflow.build import build_system
from yid_ocp.workflow.check import _fine_time_step, _input_noise, _too_stiff_start_warnings


def test_a_solution_with_its_predictions(solved_pendulum, tmp_path):
    problem, solution, held_out = solved_pendulum
    apart = [(held_out[0][0], "step 3 did not converge")]
    with pytest.raises(OutputError, match="does not exist"):
        prediction_outputs.write_solve_trajectories(tmp_path / "no" / "t.h5", problem, solution, apart)
    prediction_outputs.write_solve_trajectories(tmp_path / "t.h5", problem, solution, apart)
    with h5py.File(tmp_path / "t.h5") as file:
        assert file.attrs["format"] == "yid-trajectories/2"
        assert list(file["unknowns"].attrs["names"]) == list(solution.unknown_names)
        np.testing.assert_array_equal(file["unknowns/x"], solution.x)
        np.testing.assert_array_equal(file["unknowns/covariance"], solution.covariance)
        made, missing = file["recordings/estimate"], file["recordings/held_out"]
        assert (made.attrs["role"], missing.attrs["role"]) == ("estimate", "held_out")
        assert missing.attrs["message"] == "step 3 did not converge"
        assert list(missing) == []
        episode, outcome = problem.episodes[0], solution.episode_predictions[0]
        n = problem.system.n_coordinates
        state, sensor, samples = outcome.rollout.state, made["joints.effort"], episode.measurements[0]
        arrays = {"t": episode.grid.node_times, "q": state[:, :n], "p": state[:, n : 2 * n]}
        for name, values in (arrays | {"effort": outcome.rollout.effort}).items():
            np.testing.assert_array_equal(made[name], values)
        assert {"multipliers", "torque"} < set(made)
        assert list(sensor.attrs["channels"]) == list(samples.sensor.channel_names)
        assert set(sensor.attrs["units"]) == {"N m"}
        arrays = {"measured": samples.value, "predicted": outcome.predicted_outputs[0], "std": samples.std}
        for name, values in arrays.items():
            np.testing.assert_array_equal(sensor[name], values)
        inside = np.min(np.abs(sensor["t"][()][:, None] - episode.recording.joints.t[None, :]), axis=1)
        assert np.max(inside) < 0.5 * problem.step.time_step


def test_a_diagnosis_without_a_gap_has_predictions_alone(solved_pendulum, tmp_path):
    ((episode, outcome),) = solved_pendulum[2]
    other = SimpleNamespace(predicted_outputs=[2 * array for array in outcome.predicted_outputs])
    t = np.arange(4.0)
    whole = ForceEstimate("run", "arm", "elbow", "N m", t, 2 * t, np.diag(t + 1), t + 1, 0 * t)
    spans = tuple(whole.subset_at_time_indices(np.array(part)) for part in ([0, 1, 2], [1, 2, 3]))
    finding = SimpleNamespace(smoother_result=None, events=replace(NO_EVENTS, force_estimates=spans))
    prediction_outputs.write_diagnosis_hdf5(tmp_path / "t.h5", finding, [(episode, outcome, other)])
    with h5py.File(tmp_path / "t.h5") as file:
        assert file.attrs["format"] == "yid-diagnosis-trajectories/2"
        assert list(file) == ["events", "held_out"]
        np.testing.assert_allclose([file["events/run/elbow"][k] for k in ("t", "allowed")], [t, t + 1])
        group = file["held_out/joints.effort"]
        np.testing.assert_array_equal(group["before"], outcome.predicted_outputs[0])
        np.testing.assert_array_equal(group["after"], 2 * outcome.predicted_outputs[0])
        assert group["t"].shape == (len(group["measured"]),)


def test_a_held_out_recording_beside_a_guess_without_a_model(solved_pendulum):
    problem, fit, held_out = solved_pendulum
    apart = [*held_out, (held_out[0][0], "step 3 did not converge")]
    entry, failed, _ = prediction_errors_units_and_fit_rmse(problem, fit, apart)[0]
    assert entry["recording"] == "held_out"
    samples = held_out[0][0].measurements[0]
    for i, channel in enumerate(samples.sensor.channel_names):
        error = held_out[0][1].predicted_outputs[0][:, i] - samples.value[:, i]
        assert entry["rmse"][channel] == pytest.approx(np.sqrt(np.nanmean(error**2)))
        assert entry["baselines"]["zero"][channel] == pytest.approx(np.sqrt(np.nanmean(samples.value[:, i] ** 2)))
    assert (failed["message"], failed["rmse"]) == ("step 3 did not converge", {})
    assert failed["baselines"] == entry["baselines"]


STEPS, OFFSET, WHITE, ANGLE = 200, 0.2, 0.05, 1e-4


@pytest.fixture(scope="module")
def step(urdf_folder):
    return pendulum_step(urdf_folder, driven=("shoulder",))


def problem_of(step, *, bias=OFFSET, white=WHITE, held_out=True, options=None):
    """A pendulum under torques that are 0.3 N m too large, in one recording to estimate on and one held out."""
    t = 0.01 * np.arange(STEPS + 1)
    torque = np.sin(6 * t)[:, None]
    options = options or ProblemOptions(arm_tracking_feedback="proportional", arm_proportional_gains=(9.0,))
    stated = {"effort_std": white, "effort_bias_std": bias, "position_std": ANGLE, "effort_kind": "command"}
    joints = JointGroup(("shoulder",), t, np.zeros((STEPS + 1, 1)), effort=torque, **stated)
    first = Recording(joints, (), name="first")
    bare = replace(options, arm_tracking_feedback="none", arm_proportional_gains=None)
    made = EstimationProblem(step, [first], ("elbow.stiffness",), bare)
    episode = made.episodes[0]
    swept = made.predictor.predict_episode(episode, *made.unpack_episode_unknowns(made.initial_unknowns, 0), False)
    joints = replace(first.joints, position=swept.rollout.state[:, :1], effort=torque + 0.3)
    recordings = [replace(first, joints=joints, name=name) for name in ("first", "second")]
    apart = recordings[1:] if held_out else ()
    return EstimationProblem(step, recordings[:1], ("elbow.stiffness",), options, None, apart)


def test_offsets_of_all_recordings_are_told_with_what_was_expected(step):
    problem = problem_of(step)
    assert prediction_outputs.torque_offsets_by_recording(problem, problem.initial_unknowns) == {}
    weighted = problem_with_whitening_at(problem, problem.initial_unknowns, rounds=2)
    found = prediction_outputs.torque_offsets_by_recording(weighted, problem.initial_unknowns)
    assert list(found) == ["first", "second"]
    for entry in found.values():
        own = entry["shoulder"]
        assert own["prior_std"] == OFFSET
        assert own["std"] < 0.1 * OFFSET
        assert own["value"] == pytest.approx(0.3, abs=4 * own["std"])
    alone = problem_with_whitening_at(problem_of(step, held_out=False), problem.initial_unknowns)
    assert list(prediction_outputs.torque_offsets_by_recording(alone, problem.initial_unknowns)) == ["first"]
    unbiased = problem_with_whitening_at(problem_of(step, bias=0.0), problem.initial_unknowns)
    assert prediction_outputs.torque_offsets_by_recording(unbiased, problem.initial_unknowns) == {}


def test_the_table_has_a_row_for_a_joint_and_a_column_for_a_recording():
    def offset(value, prior=0.3):
        return {"value": value, "std": 0.012, "prior_std": prior}

    offsets = {"a": {"s0": offset(0.4), "e0": offset(-0.1)}, "b": {"s0": offset(0.2, 0.1)}}
    assert torque_offset_table({"torque_offsets": offsets}).rows == [
        ("joint", "a", "b", "expected size"),
        ("s0", "0.40 ± 0.01", "0.20 ± 0.01", "± 0.3, ± 0.1"),
        ("e0", "-0.10 ± 0.01", "", "± 0.3"),
    ]
    assert len(torque_offset_table({"torque_offsets": {}}).rows) == len(torque_offset_table({}).rows) == 1


def simulated(problem, seeds):
    return [problem.simulate_synthetic_recording(seed=seed).joints for seed in seeds]


def test_simulated_torques_are_wrong_as_the_estimation_expects_and_say_so(step):
    exact, *wrong = simulated(problem_of(step), [None, *range(60)])
    errors = np.array([(joints.effort - exact.effort)[:, 0] for joints in wrong])
    # for 60 draws a standard deviation is good to a tenth of itself
    assert errors.mean(axis=1).std() == pytest.approx(OFFSET, rel=0.3)
    assert (errors - errors.mean(axis=1, keepdims=True)).std() == pytest.approx(WHITE, rel=0.05)
    for group in (wrong[0], exact):
        assert (group.effort_std, group.effort_bias_std, group.position_std) == (WHITE, OFFSET, ANGLE)
    # settings come before what the recording says
    sensors = {"joints.effort": SensorOptions(std={"shoulder": 0.4}, bias_std=0.7)}
    options = ProblemOptions(arm_tracking_feedback="proportional", arm_proportional_gains=(9.0,), sensors=sensors)
    [made] = simulated(problem_of(step, options=options), [1])
    assert (made.effort_std, made.effort_bias_std) == (0.4, 0.7)


@pytest.mark.parametrize(("white", "estimated"), [(WHITE, False), (None, True)])
def test_check_lists_noise_that_drives_the_motion_and_whether_anybody_stated_it(step, white, estimated):
    problem = problem_of(step, white=white)
    noise = _input_noise(problem, problem.episodes[0])
    effort, position = noise["joints.effort"], noise["joints.position"]
    assert (effort["estimated"], position["estimated"]) == (estimated, False)
    assert (effort["bias_std"], position["std"]) == (OFFSET, ANGLE)
    by_effort, by_position = _noise_cells(noise, 1.0)
    assert by_effort[2:] == ("0.2 N m", "estimated" if estimated else "stated")
    assert by_position == ("joints.position", "0.0001 rad", "", "stated")
    [computed] = _noise_cells({"joints.effort": {"std": 0.005, "unit": "N m", "recorded_std": 0.04}}, 1.0)
    assert computed[3] == "stated 0.04 N m, low-pass filtered, with the noise of the angles"
    calm = problem_with_exact_inputs(problem)
    assert _input_noise(calm, calm.episodes[0]) == {}


UNITS = {"joints.effort.a": "N m", "joints.effort.b": "N m", "points.p": "m", "points.q": "m"}


def entry(rmse, guess):
    return {"recording": "run", "rmse": rmse, "baselines": {"zero": guess}}


EFFORT, POINTS = [("joints", "effort")], [("points", "")]


@pytest.mark.parametrize(
    ("rmse", "guess", "places"),
    [
        ({"joints.effort.a": 1.0, "joints.effort.b": 0.2}, {"joints.effort.a": 3.0, "joints.effort.b": 0.1}, []),
        ({"joints.effort.a": 3.2, "joints.effort.b": 0.2}, {"joints.effort.a": 3.0, "joints.effort.b": 0.4}, EFFORT),
        ({"joints.effort.a": 3.1}, {"joints.effort.a": 3.0}, []),
        ({"points.p": 0.2, "points.q": 0.1, "points": 0.1}, {"points.p": 0.1, "points.q": 0.1, "points": 0.1}, POINTS),
        ({"points.p": 0.2, "points.q": 0.1}, {"points.p": 0.01}, []),
        ({"points.p": 0.2}, {}, []),
        ({}, {"points.p": 0.2}, []),
    ],
)
def test_a_sensor_counts_as_a_whole(rmse, guess, places):
    found = estimation._worse_than_baseline_issues([entry(rmse, guess)], UNITS)
    assert [(doubt.group, doubt.channel) for doubt in found] == places
    assert all((d.cause, d.severity, d.recording) == ("worse_than_guess", "not_trusted", "run") for d in found)


def test_an_estimate_that_its_prior_contradicts_is_in_doubt():
    problem = SimpleNamespace(options=SimpleNamespace(prior_stds={"k": 5.0}))
    for value, places in ((124.0, []), (76.0, []), (126.0, ["parameters.k"])):
        known = {name: SimpleNamespace(value=value, initial=100.0, unit="N/m") for name in ("k", "j")}
        found = estimation._contradicted_prior_issues(problem, SimpleNamespace(parameters=known))
        assert [(own.group, own.severity) for own in found] == [(place, "not_trusted") for place in places]


def test_the_best_guess_counts():
    said = entry({"points.p": 0.2}, {"points.p": 0.3})
    said["baselines"]["stays"] = {"points.p": 0.1}
    (doubt,) = estimation._worse_than_baseline_issues([said], UNITS)
    assert all(fact in doubt.what for fact in ("model", "rms error", "0.2 m", "'constant readings'", "0.1 m"))
    assert doubt.limit_violation_ratio == pytest.approx(0.2 / 0.105)


@pytest.mark.parametrize(("factor", "believed"), [(1.0, True), (0.4, False)])
def test_a_held_out_recording_that_a_guess_predicts_better(carried_out, pendulum_data, tmp_path, factor, believed):
    recording = read_recording(pendulum_data.folder / "held_out.h5")
    less = replace(recording, joints=replace(recording.joints, effort=factor * recording.joints.effort))
    write_recording(less, tmp_path / "held_out.h5")
    (tmp_path / "run.yaml").write_text(pendulum_data.text)
    settings = [f"recordings.held_out=[{tmp_path / 'held_out.h5'}]", "output.write_report=false"]
    done = carried_out("solve", tmp_path / "run.yaml", settings=settings)
    result = done.result
    assert result["fit"]["data_trusted"] is believed
    assert [doubt["cause"] for doubt in result["issues"]] == ([] if believed else ["worse_than_guess"])
    assert result["parameters"]["shoulder.stiffness"]["verdict"] == ("identifiable" if believed else "not_trusted")
    assert ("a prediction without a model has a smaller error" in done.out) is not believed


def test_a_group_without_a_sample_has_no_expected_error():
    sensor = SimpleNamespace(channel_names=("points.p",), outputs_per_channel=3)
    empty = np.zeros((0, 3))
    slopes = np.zeros((0, 3, 0))
    nothing = SimpleNamespace(sensor=sensor, value=empty, std=empty, output_changes_per_bias_and_clock_std=slopes)
    vars(nothing).update(weight=empty, n_residuals=0, positive_weight_mask=empty > 0)
    nothing.decorrelate_residual_rows = lambda rows: rows
    outcome = SimpleNamespace(predicted_outputs=(np.zeros((0, 3)),))
    assert estimation._expected_errors(SimpleNamespace(measurements=(nothing,)), outcome, [[empty]]) == {}


def copied(system, values, uncounted=(), **estimates):
    """Texts to copy, of estimates given as (value, std, unit, verdict); all parameters have `values`."""
    made = {n: ParameterEstimate(*own[:3], 3.0, 0.0, np.inf, True, own[3]) for n, own in estimates.items()}
    theta = system.parameters.vector(values)
    return prediction_outputs.copyable_estimate_texts(system, theta, made, ("export", "my runs/a"), uncounted)


def test_what_is_found_at_a_joint_of_a_robot_is_a_line_that_mujoco_reads(robot):
    system = System.build(robot, springs={"elbow": StiffnessAndRest(3.0, 0.2)})
    kinds = [("joint_coulomb", "elbow"), ("rotor_inertia", "elbow"), ("joint_coulomb", "shoulder")]
    system = system.with_effects([make_effect(*own, system) for own in kinds])
    values = {"elbow.stiffness": 4.0, "elbow.damping": 0.3, "shoulder.damping": 0.2}
    values |= {"joint_coulomb@elbow.tau_c": 0.5, "rotor_inertia@elbow.armature": 0.01}
    lost = {"shoulder.damping": (0.2, 0.1, "N m s/rad", "weak")}
    found = {name: (value, 0.01 * value, "SI", "identifiable") for name, value in values.items() if name not in lost}
    [line] = copied(system, values, **found, **lost)["mjcf"]
    slide = prediction_outputs._mjcf_joint_line("rail", {"springref": 0.1}, ["elbow"])
    partly = prediction_outputs._mjcf_joint_line("rail", {"damping": 0.1}, [], ["rail.damping"])
    assert ("radian" in line, "radian" in slide, "contains rail.damping" in partly) == (True, False, True)
    joint = line.replace("<joint ", '<joint axis="0 0 1" ')
    body = f'<body><geom size="1"/>{joint}</body>'
    model = mujoco.MjModel.from_xml_string(f'<mujoco><compiler angle="radian"/><worldbody>{body}</worldbody></mujoco>')
    told = (model.jnt_stiffness, model.qpos_spring, model.dof_damping, model.dof_frictionloss, model.dof_armature)
    assert np.ravel(told).tolist() == pytest.approx([4.0, 0.2, 0.3, 0.5, 0.01])
    only = copied(system, values, **{"elbow.damping": found["elbow.damping"]})
    assert only["mjcf"] == ['<joint name="elbow" damping="0.3"/>']
    lost = {"elbow.damping": (0.3, 9.0, "N m s/rad", "not_identifiable")}
    found["elbow.damping[run1]"] = found["elbow.damping"]  # of one recording
    assert copied(system, values, **{"elbow.damping[run1]": found["elbow.damping"]})["yaml"] == []
    [stiff] = copied(system, values, **{"elbow.stiffness": found["elbow.stiffness"]}, **lost)["mjcf"]
    assert ('stiffness="4"' in stiff, "damping=" in stiff, "<!-- add " in stiff) == (True, False, True)
    assert copied(system, values, **{"shoulder.mass": (1.0, 0.1, "kg", "identifiable")})["mjcf"] == []


def test_what_a_reader_copies_is_of_found_parameters_and_of_single_joints():
    system, lost = build_system(load_config(None)), {"T1.twist": (7.0, 0.5, "N m/rad", "not_identifiable")}
    found = {"T1.bend": (22.0, 0.5, "N m/rad", "identifiable")} | lost
    told, rough = (copied(system, {"T1.bend": 22.0}, errors, **found) for errors in ((), ["of the time step"]))
    assert told["values"] == rough["values"] == ["T1.bend = 22 ± 0.5 N m/rad"]
    stated, ignored, lacking, *_ = copyable_estimates_blocks({"to_use": rough, "format": "yid-solve/1"})
    assert summary_terminal_lines([stated])[::3] == ["To use these numbers:", "T1.bend = 22 ± 0.5 N m/rad"]
    assert "leaves out the error of the time step." in ignored
    assert "not known well enough: T1.twist." in lacking
    zero = {"T3.bend": (0.01, 0.2, "N m/rad", "identifiable")}
    blocks = [*copyable_estimates_blocks({"to_use": copied(system, {"T1.bend": 22.0}, **found, **zero)})]
    assert "do not differ from zero by more than two ±: T3.bend." in " ".join(b for b in blocks if isinstance(b, str))
    assert "T3.bend = " not in str(blocks)
    assert told["joints"] == [{"segment": "T1", "deformation": "bend", "links": 4, "lowest": 22.0, "highest": 22.0}]
    assert told["yaml"] == ["parameters:", "  T1.bend: {free: true, initial: 22}"]
    assert told["mjcf"][0].startswith('<joint stiffness="22" damping="0.05"/> <!-- T1 bend, 4 links; for n links, mult')
    assert told["latex"] == [r"T1.bend & $22 \pm 0.5$ & N m/rad \\"]
    assert (told["export"], told["uncounted_errors"]) == ("yid-ocp export 'my runs/a'", [])
    digits = copied(system, {}, (), **{"T1.bend": (10.6344, 0.0741, "1", "identifiable")})
    assert (digits["values"], r"$10.634 \pm 0.074$" in digits["latex"][0]) == (["T1.bend = 10.634 ± 0.074"], True)
    small = copied(system, {}, (), **{"T1.bend": (2.2e-5, 5e-7, "1", "identifiable")})
    assert small["latex"] == [r"T1.bend & $2.2 \cdot 10^{-5} \pm 5 \cdot 10^{-7}$ & 1 \\"]
    assert small["values"] == ["T1.bend = 2.2e-05 ± 5e-07"]
    assert copied(system, {}, **lost) == {}
    system = build_system(load_config(None, ["model.frames={tip: {parent_frame: w_T1, position_std: 0.01}}"]))
    marker = {"tip.x": (0.01, 0.001, "m", "identifiable")}
    assert copied(system, {}, **marker)["values"] == ["tip.x = 0.01 ± 0.001 m"]
    both = copied(system, {"T1.bend": 22.0}, **marker, **found)
    assert [len(both[key]) for key in ("values", "latex", "yaml")] == [1, 1, 3], "an offset is no result"


def test_a_frequency_that_follows_the_time_step_tells_of_a_start_that_is_too_stiff():
    known = {"beam.bend": SimpleNamespace(name="beam.bend", unit="N m^2"), "a": SimpleNamespace(name="a", unit="kg")}
    parameters = type("Parameters", (), {"names": tuple(known), "__getitem__": lambda _, name: known[name]})()
    system = SimpleNamespace(parameters=parameters)
    [said] = _too_stiff_start_warnings(system, np.array([1.3e6, 2.0]), 0.005, [98.6], [378.0])
    assert said.endswith("Check size and unit of the initial values: beam.bend (1.3e+06 N m^2)")
    assert _too_stiff_start_warnings(system, np.array([1.3, 2.0]), 0.005, [4.0], [4.1]) == []
    assert _fine_time_step(0.05, 32.76) == pytest.approx(0.45 / (2 * np.pi * 88), rel=0.02)
