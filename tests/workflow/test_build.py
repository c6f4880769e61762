"""From settings to systems and problems: the paper's, segments, springs, effects, friction, a known motor; errors."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

import yid_ocp as yid
from yid_ocp.analysis.compare import PAPER_ESTIMATES
from yid_ocp.config.reader import load_config
from yid_ocp.config.settings import EffectSettings, ParameterSettings, config_yaml_with_defaults
from yid_ocp.diagnosis.hypotheses import make_candidate_effects
from yid_ocp.errors import ConfigError, ModelError
from yid_ocp.model import forward_kinematics
from yid_ocp.problem import EstimationProblem
from yid_ocp.solvers import GaussNewton
from yid_ocp.workflow.build import are_arm_states_estimated, build_system, load_system, settings_by_parameter_name
from yid_ocp.workflow.build_problem import build_problem, load_problem, make_problem_options
from yid_ocp.workflow.run_inputs import read_recordings_of_role


@pytest.fixture
def built(written):
    """built(text, link_division): the system that settings describe."""
    return lambda text, link_division=1: build_system(load_config(written(text)), link_division)


def place(system, frame):
    """Where a frame is with all coordinates at zero."""
    q = ca.SX(ca.DM(np.zeros(system.n_coordinates)))
    position = forward_kinematics(system.mechanism.with_numeric_values(), q).frame_position(frame)
    return np.array(ca.DM(position)).ravel()


@pytest.mark.parametrize(("name", "size", "constraints"), [("single_arm_vision", 43, 3), ("dual_arm_vision", 50, 6)])
def test_the_papers_systems(repository, paper_systems, name, size, constraints):
    system = yid.load_system(repository / "configs" / f"{name}.yaml")
    assert (system.n_coordinates, system.n_constraints) == (size, constraints)
    reference = paper_systems["single" if size == 43 else "dual"]
    assert system.mechanism.joint_names == reference.mechanism.joint_names
    assert system.parameters.names == reference.parameters.names
    np.testing.assert_array_equal(system.parameters.vector(), reference.parameters.vector())
    assert system.parameters.vector({"T1.bend": 22.0})[system.parameters.index("T1.bend")] == 22.0


def test_an_object_mounted_on_a_driven_arm_is_refused(written):
    """The tracking filter compares the arm's momentum with that of the arm alone."""
    rod = "{length: 0.3, mass: 0.1, radius: 0.01, links: 2}"
    object_ = f"{{kind: segments, mount: {{parent_frame: panda_hand}}, named_segments: {{rod: {rod}}}}}"
    text = f"model: {{robot: package:panda, arms: {{mode: driven, joints: [panda_joint1]}}, object: {object_}}}\n"
    with pytest.raises(ConfigError, match=r"(?s)rod_0_.* is mounted on a driven arm.*grasp"):
        build_problem(load_config(written(text)))


def test_parameters_of_a_run(built):
    given = "T*.bend: {initial: 5, free: true, bounds: [0, 50]}, T2.bend: {initial: 7}, T1.mass: {initial: 0.07}"
    parameters = built(f"model: {{object: {{kind: foam_y}}}}\nparameters: {{{given}}}\n").parameters
    assert [parameters[f"T{i}.bend"].value for i in (1, 2, 3)] == [5, 7, 5]
    assert parameters["T3.bend"].upper == 50
    assert parameters["T1.mass"].value == 0.07


def test_an_object_of_segments_on_a_robots_hand(built):
    text = (
        "model:\n  robot: package:panda\n"
        f"  arms: {{mode: prescribed, joints: [{', '.join(f'panda_joint{i}' for i in range(1, 8))}]}}\n"
        "  object:\n    kind: segments\n"
        "    mount: {parent_frame: panda_hand, xyz: [0, 0, 0.1], rpy: [0, 1.5708, 0]}\n"
        "    named_segments:\n"
        "      beam: {length: 0.5, mass: 0.3, radius: 0.01, links: 5, "
        "values_given_as_rigidities: true, clamped_at_base: true}\n"
        "      tip: {link_lengths: [0.1, 0.05], mass: 0.01, radius: 0.01, parent: beam}\n"
        "parameters: {beam.bend: {initial: 1.3}, tip.damping: {initial: 0.001}}\n"
    )
    system, finer = built(text), built(text, 2)
    assert (system.n_coordinates, finer.n_coordinates) == (7 + 15 + 6, 7 + 30 + 12)
    assert len(system.prescribed) == 7
    assert system.parameters["beam.bend"].unit == "N m^2"
    for name, coarse, fine in (("tip.damping", 0.001, 0.002), ("beam.bend", 1.3, 1.3), ("tip.bend", 3.0, 6.0)):
        assert (system.parameters[name].value, finer.parameters[name].value) == (coarse, fine)
    for fine, coarse in (("tip_1_tip", "tip_0_tip"), ("w_tip", "w_tip"), ("beam_5_tip", "beam_2_tip")):
        assert np.allclose(place(finer, fine), place(system, coarse))


@pytest.mark.parametrize("finer", [1, 2, 3])
def test_a_branch_stays_at_its_place_of_a_finer_parent(built, finer):
    text = (
        "model:\n  object:\n    kind: segments\n    named_segments:\n"
        "      a: {length: 0.4, mass: 0.1, radius: 0.01, links: 4}\n"
        "      b: {length: 0.1, mass: 0.1, radius: 0.01, links: 1, parent: a, parent_link_index: 0}\n"
    )
    assert np.allclose(place(built(text, finer), "b:0%"), [0, 0, 0.1])


def test_springs_on_joints(built, urdf_folder):
    system = built(
        f"model:\n  robot: {urdf_folder / 'mixed_joints.urdf'}\n  arms: {{mode: passive}}\n"
        "  joint_springs:\n    hinge: {stiffness: 2.0, rest_position: 0.1, damping: 0.3}\n    slide: {stiffness: 50}\n"
        "  damping: {spin: 0.2}\n"
    )
    parameters = system.parameters
    assert (parameters["hinge.stiffness"].unit, parameters["hinge.rest"].value) == ("N m/rad", 0.1)
    assert (parameters["slide.stiffness"].unit, parameters["slide.rest"].unit) == ("N/m", "m")
    assert [parameters[f"{joint}.damping"].value for joint in ("hinge", "spin", "slide")] == [0.3, 0.2, 0.05]
    assert (system.driven, system.prescribed) == ((), ())


EFFECTS = (
    "model:\n  object: {kind: foam_y}\n  effects:\n"
    "    - {kind: kelvin_voigt, location: T3}\n"
    "    - {kind: density, location: T2, values: {scale: 1.1}}\n"
    "parameters:\n  kelvin_voigt@T3.tau: {free: true, initial: 0.02}\n"
)


def test_effects_bring_their_parameters(written):
    run = load_config(written(EFFECTS))
    system = build_system(run)
    assert [(effect.kind, effect.location) for effect in system.effects] == [("kelvin_voigt", "T3"), ("density", "T2")]
    assert system.parameters["kelvin_voigt@T3.tau"].value == 0.02
    assert system.parameters["density@T2.scale"].value == 1.1
    assert load_config(written(config_yaml_with_defaults(run))) == run


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (EFFECTS.replace("kelvin_voigt, loc", "kelvin_voight, loc"), "line 4: model.effects.0"),
        (EFFECTS.replace("location: T2", "location: T9"), "line 5: model.effects.1"),
        (EFFECTS.replace("location: T3", "locaton: T3"), "did you mean 'location'?"),
        (EFFECTS.replace("scale: 1.1", "scale: much"), "model.effects.1.values"),
        ("model:\n  robot: package:baxterr\n", "line 2: model.robot"),
        ("model:\n  robot: package:baxter\n  damping: {left_s9: 1}\n", "line 3: model.damping.left_s9"),
        ("model:\n  object: {kind: segments, named_segments: {a: {mass: 1, radius: 0.1}}}\n", "line 2: model.object"),
        ("model:\n  object: {kind: foam_y}\n  measured_points: [w_T9]\n", "line 3: model.measured_points"),
    ],
)
def test_errors_of_the_model_name_the_setting(written, text, message, refused_with):
    with refused_with((ConfigError, ModelError), (message,)):
        load_system(written(text))


def test_a_problem_from_a_file(repository):
    file = repository / "configs" / "single_arm_vision.yaml"
    quick = ["model.object.links=1", "problem.use_compiler=false", "problem.duration=0.3"]
    problem = load_problem(file, [*quick, "sensors.points_camera.use=false"])
    assert problem.free == tuple(f"T{i}.{kind}" for i in (1, 2, 3) for kind in ("bend", "twist"))
    assert [s.sensor.group_name for s in problem.episodes[0].measurements] == ["points_arm"]
    assert len(problem.held_out) == 1
    assert build_problem(load_config(file, quick), problem.step).free == problem.free


SEGMENTED = (
    "model:\n  object:\n    kind: segments\n    named_segments:\n"
    "      a: {length: 0.4, mass: 0.1, radius: 0.01, links: 2}\n"
    "      b: {length: 0.4, mass: 0.1, radius: 0.01, links: 2, parent: a, "
    "values_given_as_rigidities: true, has_separate_twist_damping: true}\n"
    "parameters:\n  '*.bend': {initial: 5, bounds: [1, 8]}\n  a.twist: {initial: 2}\n  b.damping: {initial: 0.3}\n"
)


def test_a_stiffness_stands_under_parameters_alone(written, built):
    for key in ("bend", "twist", "damping"):
        with pytest.raises(ConfigError, match=f"there is no key '{key}'"):
            load_config(written(SEGMENTED.replace("links: 2,", f"links: 2, {key}: 1,")))
    parameters = built(SEGMENTED).parameters
    assert [parameters[name].value for name in ("a.bend", "b.bend", "a.twist", "b.twist")] == [5, 5, 2, 3]
    assert [parameters[name].value for name in ("a.damping", "b.damping", "b.twist_damping")] == [0.05, 0.3, 0.05]
    assert "a.twist_damping" not in parameters


def test_more_links_scale_what_is_said_of_a_stiffness_per_joint(built):
    finer = built(SEGMENTED, 3).parameters
    assert [finer[name].value for name in ("a.bend", "a.twist", "b.bend", "b.damping")] == [15, 6, 5, 0.3]
    assert finer["a.damping"].value == pytest.approx(0.15)
    assert (finer["a.bend"].lower, finer["a.bend"].upper) == (3, 24)
    assert (finer["b.bend"].lower, finer["b.bend"].upper) == (1, 8)
    finer = built(SEGMENTED.split("parameters:")[0], 3).parameters
    assert [finer[name].value for name in ("a.bend", "a.twist", "b.bend")] == [9, 9, 3]
    foam = "model: {object: {kind: foam_y}, damping: 0.02}\nparameters: {T1.bend: {initial: 10}}\n"
    finer = built(foam, 2).parameters
    assert [finer[name].value for name in ("T1.bend", "T2.bend", "T1.damping")] == [20, 6, 0.04]


BY_JOINT = "model:\n  robot: {urdf}\n  arms: {{mode: passive}}\n  object: {{kind: foam_y}}\n"
BY_JOINT += "  damping: {{hinge: 0.2{more}}}\n"


def test_damping_by_joint_says_that_of_the_object_too(built, urdf_folder):
    urdf = urdf_folder / "mixed_joints.urdf"
    parameters = built(BY_JOINT.format(urdf=urdf, more=", object: 0.01")).parameters
    assert [parameters[f"{name}.damping"].value for name in ("hinge", "slide")] == [0.2, 0.05]
    assert [parameters[f"T{i}.damping"].value for i in (1, 2, 3)] == [0.01] * 3
    with pytest.raises(ConfigError, match="not that of the object") as caught:
        built(BY_JOINT.format(urdf=urdf, more=""))
    assert "line 5: model.damping" in caught.value.where
    assert "`object`" in caught.value.allowed
    alone = BY_JOINT.format(urdf=urdf, more=", object: 1").replace("object: {kind: foam_y}", "measured_points: []")
    with pytest.raises(ConfigError, match="there is no joint 'object'"):
        built(alone)


def test_a_problem_has_the_options_of_its_section(written):
    text = (
        "model: {object: {kind: foam_y}}\nsensors: {points: {std: 0.1}}\n"
        "problem: {weighting: paper, huber_threshold: 3, initial_state_fit_parameters: [T1.mass], duration: 2}\n"
        "parameters: {T1.bend: {prior_std: 2, per_recording: true}}\n"
    )
    run = load_config(written(text))
    options = make_problem_options(run, build_system(run))
    assert (options.weighting, options.huber_threshold, options.duration) == ("paper", 3.0, 2.0)
    assert (options.initial_state_fit_parameters, options.local_parameters) == (("T1.mass",), ("T1.bend",))
    assert options.prior_stds == {"T1.bend": 2.0}
    assert options.sensors["points"].std == 0.1
    wrong = load_config(written("model: {object: {kind: foam_y}}\nproblem: {initial_state_fit_parameters: [T1.mas]}\n"))
    for key, hint in (("T*.bent", "did you mean 'T*.bend'?"), ("x.servo_gain", "set model.arms.mode: servo, which")):
        with pytest.raises(ConfigError, match="there is no parameter") as caught:
            build_system(replace(wrong, parameters={key: ParameterSettings(free=True)}))
        assert caught.value.hint.startswith(hint)
    with pytest.raises(ConfigError, match=r"there is no parameter 'T1.mas'") as caught:
        make_problem_options(wrong, build_system(wrong))
    assert "line 2: problem.initial_state_fit_parameters" in caught.value.where


@pytest.mark.parametrize(
    ("file", "overrides", "expected"),
    [
        ("dual_arm_vision", ["model.arms.mode=prescribed"], True),
        ("dual_arm_vision", [], False),
        ("single_arm_vision", ["model.arms.mode=prescribed"], True),
        ("baxter_arm", ["recordings={}"], False),
        ("dual_arm_vision", ["model.arms.mode=prescribed", "recordings.estimate=[]"], False),
    ],
    ids=["two grasps", "driven", "one grasp", "no grasp", "without recordings"],
)
def test_prescribed_arms_that_hold_an_object_are_states(repository, file, overrides, expected):
    run = load_config(repository / "configs" / f"{file}.yaml", overrides)
    assert are_arm_states_estimated(run) is expected
    assert bool(build_system(run).driven) == (expected or run.model.arms.mode == "driven")


def test_their_encoders_are_measurements_and_the_points_of_the_arm_are_not(repository):
    file = repository / "configs" / "dual_arm_vision.yaml"
    run = load_config(file, ["model.arms.mode=prescribed", "recordings.held_out=[]", "problem.use_compiler=false"])
    options = make_problem_options(run, build_system(run), read_recordings_of_role(run))
    used = {group: said.use for group, said in options.sensors.items()}
    assert used == {"joints.position": True, "points_arm": False}


@pytest.mark.parametrize("name", PAPER_ESTIMATES)
def test_the_papers_configurations_ask_for_its_answers(repository, printed, name):
    file = repository / "configs" / f"{name}.yaml"
    assert load_config(file).compare.reference_paper_experiment_name == name
    wrong = "compare.reference_paper_experiment_name=triple"
    assert "no experiment 'triple'" in printed("compare", file, "--set", wrong, code=2)


CONFIG = Path(__file__).parents[2] / "configs" / "servo_pendulum.yaml"


def settings(*overrides: str):
    return load_config(CONFIG, ["recordings={}", *overrides])


def test_friction_is_free_and_a_preset_gives_values_and_priors_of_the_law() -> None:
    run = settings()
    parameters = build_system(run).parameters
    said = settings_by_parameter_name(run, parameters)
    values = dict(zip(parameters.names, parameters.vector(), strict=True))
    assert all(said[name].free for name in ("joint.damping", "joint_coulomb@joint.tau_c"))
    assert said["joint_load_friction@joint.share"].free
    motor = ["joint.servo_gain", "joint.servo_damping", "joint.servo_torque_limit", "rotor_inertia@joint.armature"]
    assert [name for name in said if name in motor] == motor, "not the order of a set"
    # torque per unit of gain and rad: 0.00288 x 0.386 x 7.4 / 3.4, with a prior of a quarter of it
    assert values["joint.servo_gain"] == pytest.approx(0.00288 * 0.386 * 7.4 / 3.4)
    assert said["joint.servo_gain"].prior_std == pytest.approx(0.25 * values["joint.servo_gain"])
    assert values["joint_load_friction@joint.share"] == 0.068
    # constants of one law do not go with those of another
    plain = build_system(settings("model.friction={law: coulomb}")).parameters
    assert plain["joint.servo_gain"].value == pytest.approx(0.00288 * 0.387 * 7.4 / 4.02)
    assert plain["joint_coulomb@joint.tau_c"].value == 0.0128


def test_what_is_said_of_a_parameter_or_an_effect_goes_before_a_section() -> None:
    run = settings("parameters.joint.damping={free: false, initial: 0.01}")
    system = build_system(run)
    assert system.parameters["joint.damping"].value == 0.01
    assert not settings_by_parameter_name(run, system.parameters)["joint.damping"].free


@pytest.mark.parametrize(("file", "v_s"), [(None, "null"), (None, "3e-3"), (CONFIG, "null")])
def test_joints_driven_by_torques_have_sharp_friction_and_candidates_are_as_sharp(file, v_s) -> None:
    run = load_config(file, ["recordings={}", f"model.friction={{law: coulomb, sign_smoothing_speed: {v_s}}}"])
    candidates = make_candidate_effects(build_system(run), [], ["joint_stribeck"])
    stated = EffectSettings(kind="joint_stribeck", location=candidates[0].location, values={"tau_s": 0.1})
    known = build_system(replace(run, model=replace(run.model, effects=(*run.model.effects, stated)))).effects
    with pytest.raises(ConfigError, match=f"already has the effect joint_coulomb, {known[0].label}\n"):
        make_candidate_effects(build_system(run), [], ["joint_coulomb", "joint_stribeck", known[0].label])
    dry = [own for own in (*known, *candidates) if own.kind in ("joint_coulomb", "joint_stribeck")]
    assert {effect.sign_smoothing_speed for effect in dry} == {3e-3 if v_s == "3e-3" else 0.02 if file else 1e-3}


def test_friction_of_a_joint_that_is_not_there_is_refused() -> None:
    with pytest.raises(ConfigError, match="joint 'joynt'"):
        build_system(settings("model.friction={law: coulomb, joints: [joynt]}"))


@pytest.fixture(scope="module")
def fitted() -> tuple[EstimationProblem, np.ndarray]:
    run = load_config(CONFIG)
    if not Path(run.recordings.estimate[0]).is_file() and not (CONFIG.parent / run.recordings.estimate[0]).is_file():
        pytest.skip("the real recordings are not here (shared/recordings beside the project)")
    problem = build_problem(run)
    return problem, GaussNewton(max_iterations=15).minimize_cost(problem, problem.initial_unknowns, None).x


def test_a_real_geared_servo_is_predicted(fitted) -> None:
    problem, x = fitted

    def rmse(episode, found) -> float:
        return float(np.sqrt(np.mean((found.predicted_outputs[0] - episode.measurements[0].value) ** 2)))

    assert np.mean([rmse(*held_out) for held_out in problem.predict_held_out(x)]) < 0.035  # [rad]
    told = zip(problem.episodes, problem.evaluate(x, False).episode_predictions, strict=True)
    assert max(rmse(*drop) for drop in told if drop[0].name.startswith("drop")) < 0.030
    inertia = 0.49 * 0.1**2 + problem.unknowns.named_values(x)["rotor_inertia@joint.armature"]
    assert 0.0064 < inertia < 0.0073


def test_the_firmwares_gain_of_each_file_is_known_unless_the_settings_say_otherwise(fitted) -> None:
    problem, _ = fitted
    stated = {episode.name: episode.known_parameters["joint.servo_gain_factor"] for episode in problem.episodes}
    assert {stated["sines_100"], stated["sines_400"]} == {100.0, 400.0}
    said = build_problem(load_config(CONFIG, ["parameters.joint.servo_gain_factor={initial: 400}"]))
    assert not any(episode.known_parameters for episode in said.episodes)
