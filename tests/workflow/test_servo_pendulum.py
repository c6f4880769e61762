"""Ordinary friction and a known motor in the settings, on a real geared servo with a pendulum."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from yid_ocp.config.reader import load_config
from yid_ocp.errors import ConfigError
from yid_ocp.problem import EstimationProblem
from yid_ocp.solvers import GaussNewton
from yid_ocp.workflow.build import build_system, settings_by_parameter_name
from yid_ocp.workflow.build_problem import build_problem

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
    errors = [
        float(np.sqrt(np.mean((found.predicted_outputs[0] - episode.measurements[0].value) ** 2)))
        for episode, found in problem.predict_held_out(x)
    ]
    assert np.mean(errors) < 0.035  # [rad]
    drops = [
        float(np.sqrt(np.mean((found.predicted_outputs[0] - episode.measurements[0].value) ** 2)))
        for episode, found in zip(problem.episodes, problem.evaluate(x, False).episode_predictions, strict=True)
        if episode.name.startswith("drop")
    ]
    assert max(drops) < 0.030
    inertia = 0.49 * 0.1**2 + problem.named_values(x)["rotor_inertia@joint.armature"]
    assert 0.0064 < inertia < 0.0073


def test_the_firmwares_gain_of_each_file_is_known_unless_the_settings_say_otherwise(fitted) -> None:
    problem, _ = fitted
    stated = {episode.name: episode.known_parameters["joint.servo_gain_factor"] for episode in problem.episodes}
    assert {stated["sines_100"], stated["sines_400"]} == {100.0, 400.0}
    said = build_problem(load_config(CONFIG, ["parameters.joint.servo_gain_factor={initial: 400}"]))
    assert not any(episode.known_parameters for episode in said.episodes)
