"""The ladder of friction laws: kinds of motion left out in turn, and the law that they warrant."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from small_problems import PENDULUM, joints, pendulum_step, recording

from yid_ocp.analysis.friction_ladder import (
    FrictionLawFit,
    fit_friction_law,
    friction_torque_clouds,
    mean_and_standard_error,
    motion_kinds,
    warranted_law,
)
from yid_ocp.model.servos_and_springs import PositionServoOptions
from yid_ocp.problem import EstimationProblem
from yid_ocp.solvers import GaussNewton, solve

KINDS = {"a": ("a_1", "a_2"), "b": ("b_1",), "c": ("c_1",)}


def fit_of(law: str, *errors: float) -> FrictionLawFit:
    return FrictionLawFit(law, {}, dict(zip(("a_1", "a_2", "b_1", "c_1"), errors, strict=True)), "rad", True)


def test_kinds_weigh_alike_however_many_recordings_each_has() -> None:
    mean, error = mean_and_standard_error({"a_1": 1.0, "a_2": 3.0, "b_1": 5.0, "c_1": 8.0}, KINDS)
    assert mean == pytest.approx(5.0)
    assert error == pytest.approx(np.std([2.0, 5.0, 8.0], ddof=1) / np.sqrt(3))


def test_the_simplest_law_within_one_standard_error_of_the_best_is_warranted() -> None:
    rough, good, best = fit_of("viscous", 9, 9, 8, 9), fit_of("coulomb", 3, 3, 2, 4), fit_of("stribeck", 2.8, 2.8, 2, 4)
    assert warranted_law([rough, good, best], KINDS) is good
    far = fit_of("stribeck", 1, 1, 1.1, 0.9)
    assert warranted_law([rough, good, far], KINDS) is far
    failed = fit_of("coulomb", float("nan"), 1, 1, 1)
    assert warranted_law([rough, failed, far], KINDS) is far


TRUTH = {
    "shoulder.servo_gain": 60.0, "shoulder.servo_damping": 4.0, "shoulder.servo_torque_limit": 9.0,
    "elbow.servo_gain": 25.0, "elbow.servo_damping": 1.5, "elbow.servo_torque_limit": 3.0,
    "joint_coulomb@shoulder.tau_c": 1.2,
}  # fmt: skip


@pytest.fixture(scope="module")
def dry(urdf_folder) -> EstimationProblem:
    """Three kinds of motion of an arm with dry friction, as its own model has them, and one with motors off."""
    step = pendulum_step(
        urdf_folder, [("joint_coulomb", "shoulder", {})], driven=PENDULUM, servos=PositionServoOptions()
    )
    made = []
    t = 0.01 * np.arange(81)
    for name, rate in (("slow_1", 4.0), ("slow_2", 5.0), ("fast_1", 11.0), ("turn_1", 7.0)):
        command = 0.4 * np.sin(rate * t[:, None] + [0.0, 1.0]) + (0.5 * t[:, None] if name == "turn_1" else 0.0)
        group = joints(PENDULUM, t, command, position_command=command, position_std=1e-3)
        source = EstimationProblem(step, [recording(group, name=name)], ["shoulder.servo_gain"], None, TRUTH)
        made.append(source.simulate_recording(seed=len(made)))
    off = joints(PENDULUM, t, np.zeros((81, 2)), effort=np.zeros((81, 2)), position_std=1e-3)
    names = ["joint_coulomb@shoulder.tau_c", "shoulder.servo_gain"]
    known = TRUTH | {"joint_coulomb@shoulder.tau_c": 0.6}
    found = [recording(m.joints, name=n) for m, n in zip(made, ("slow_1", "slow_2", "fast_1", "turn_1"), strict=True)]
    return EstimationProblem(step, [*found, recording(off, name="drop")], names, None, known)


def test_kinds_go_by_name_and_motors_that_are_off_stay_in_the_fit(dry) -> None:
    assert motion_kinds(dry) == {"slow": ("slow_1", "slow_2"), "fast": ("fast_1",), "turn": ("turn_1",)}


def test_a_law_that_is_true_predicts_what_is_left_out_to_its_noise_and_shows_in_the_torques(dry) -> None:
    driven = dry.with_episodes(dry.episodes[:-1], ())
    solution = solve(driven, GaussNewton(), restarts=False)
    fit = fit_friction_law("coulomb", driven, solution, motion_kinds(driven))
    assert set(fit.left_out_errors) == {"slow_1", "slow_2", "fast_1", "turn_1"}
    assert all(error < 1.3e-3 for error in fit.left_out_errors.values())
    assert fit.parameters["joint_coulomb@shoulder.tau_c"].value == pytest.approx(1.2, abs=0.05)
    [cloud] = friction_torque_clouds(driven, solution, ["joint_coulomb@shoulder.tau_c"])
    moving = np.abs(cloud.speed) > 0.5
    # friction is against the motion, in the data as in the law
    assert np.median(cloud.measured[moving] * np.sign(cloud.speed[moving])) == pytest.approx(1.2, abs=0.15)
    assert np.median(cloud.predicted[moving] * np.sign(cloud.speed[moving])) == pytest.approx(1.2, abs=0.05)


def test_the_command_says_which_law_a_real_servo_warrants(cli, repository, shared, tmp_path: Path) -> None:
    folder = shared / "recordings" / "servo_pendulum"
    if not folder.is_dir():
        pytest.skip("the real recordings are not here (shared/recordings beside the project)")
    files = ", ".join(str(folder / f"{kind}_400.h5") for kind in ("sines", "sweep", "lift", "drop"))
    settings = ("problem.duration=2.0", "problem.time_step=0.01", "recordings={held_out: []}")
    settings = (*settings, f"recordings.estimate=[{files}]")
    more = [part for setting in settings for part in ("--set", setting)]
    done = cli("friction", repository / "configs" / "servo_pendulum.yaml", "--out", tmp_path / "run", *more)
    assert done.code in (0, 1), done.err
    result = json.loads((tmp_path / "run" / "result.json").read_text())
    assert set(result["kinds"]) == {"sines", "sweep", "lift"}
    assert set(result["laws"]) == {"viscous", "coulomb", "stribeck", "presliding", "load", "load_stribeck"}
    assert f"friction: {{law: {result['warranted']}, joints: [joint]}}" in done.out
    assert result["laws"]["load"]["mean_error"] < result["laws"]["viscous"]["mean_error"]
