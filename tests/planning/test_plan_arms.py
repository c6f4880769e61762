"""Plans of the shipped configurations, coarsened: one arm and two that hold the Y, two that hold a cable, clamps."""

import json

import numpy as np
import pytest

from yid_ocp.config.reader import load_config
from yid_ocp.data import read_recording
from yid_ocp.errors import ConfigError
from yid_ocp.integrator.step import simulate
from yid_ocp.planning.joint_paths import FramePositionEvaluator
from yid_ocp.workflow.plan import run_plan
from yid_ocp.workflow.run_inputs import resolve_recording_path

STIFF = "parameters={T*.bend: {initial: 15}, T*.twist: {initial: 10}}"
COARSE = {
    "plan_place": ("model.object.links=2", "plan.point_target_offset_from_start=[-0.01, 0.02, 0.015]"),
    "plan_cable": ("model.object.named_segments.cable.links=3",),
}


def planned(repository, tmp_path, name, *overrides):
    run = load_config(repository / "configs" / f"{name}.yaml", [*overrides, "output.write_report=false"])
    return run, run_plan(run, tmp_path / "out")


def test_every_plan_that_ships_is_tried(repository):
    assert {path.stem for path in (repository / "configs").glob("plan_*.yaml")} == set(COARSE)


@pytest.mark.parametrize("name", sorted(COARSE))
def test_a_plan_that_ships_arrives_within_its_limits(repository, tmp_path, name):
    run, outcome = planned(repository, tmp_path, name, *COARSE[name])
    assert outcome.is_successful, outcome.result["message"]
    assert outcome.result["error"] < run.plan.position_tolerance
    assert outcome.result["swing"] < run.plan.point_rest_speed_tolerance
    for joint, own in outcome.result["joints"].items():
        assert own["velocity"] <= run.plan.limits.velocity_fraction + 1e-3, joint
        assert own["effort"] <= run.plan.limits.effort_fraction + 1e-3, joint
    written = read_recording(outcome.folder / "recording.h5")
    assert set(written.joints.names) == set(run.model.arms.joints)
    # what is to arrive is among the points that were written, whether or not the system names it
    group = written.points[0]
    last = group.position[-1, group.names.index(run.plan.point)]
    np.testing.assert_allclose(last, outcome.result["place"], atol=run.plan.position_tolerance)
    message = json.loads((outcome.folder / "trajectory.json").read_text())
    assert message["joint_names"] == list(written.joints.names)


def test_the_middle_of_a_cable_stays_below_a_lid(repository, tmp_path):
    quick = (*COARSE["plan_cable"], "plan.duration=0.6", "plan.hold_duration=0.2", "plan.n_spline_coefficients=5")
    _, free = planned(repository, tmp_path / "free", "plan_cable", *quick, "plan.goal=place")
    assert free.output.n_evaluations < 50, "the search must end where the cost falls by little"
    height = free.output.point_trajectories["cable:50%"][:, 2]
    lid = 0.5 * (height.max() + free.output.target_position[2])
    assert height.max() > lid + 1e-3, "the free motion must pass the lid for this to be a test"
    box = f"plan.box=[[0.0, -1.0, -0.6], [1.5, 1.0, {lid}]]"
    _, kept = planned(repository, tmp_path / "kept", "plan_cable", *quick, box, "plan.frames_in_box=['cable:50%']")
    assert kept.is_successful, kept.result["message"]
    assert kept.output.point_trajectories["cable:50%"][:, 2].max() < lid + 2e-4


@pytest.mark.slow
def test_a_path_of_the_free_tip_is_followed_as_far_as_it_says(repository, tmp_path):
    path = (
        "goal=path",
        "point_waypoint_offsets_from_start=[[-0.01, 0.01, 0.02]]",
        "duration=1.6",
        "n_spline_coefficients=8",
    )
    more = (f"plan.{entry}" for entry in (*path, "position_tolerance=0.004"))
    run, outcome = planned(repository, tmp_path, "plan_place", *COARSE["plan_place"], *more)
    assert outcome.is_successful, outcome.result["message"]
    tip, t = outcome.output.point_trajectories["w_T3"], outcome.output.t
    waypoint = run.plan.point_waypoint_offsets_from_start[0]
    off = np.linalg.norm(tip[int(np.argmin(np.abs(t - 0.8)))] - tip[0] - waypoint)
    assert off <= outcome.result["off_path"] + 1e-9
    assert outcome.result["off_path"] < 0.01
    aside = np.linalg.norm(waypoint - 0.5 * (outcome.output.target_position - tip[0]))
    assert aside > 0.01, "the way must not lead there by itself"


def test_two_arms_bring_the_junction_to_a_place_and_keep_hold_of_it(repository, tmp_path):
    name = "dual_arm_vision"
    way = "plan={point: w_T1, point_target_offset_from_start: [0.03, 0.03, 0.0], duration: 0.8, hold_duration: 0.3}"
    run, outcome = planned(repository, tmp_path, name, "model.object.links=2", STIFF, way)
    assert outcome.is_successful, outcome.result["message"]
    assert outcome.result["swing"] < run.plan.point_rest_speed_tolerance
    found = outcome.output
    # it begins where the recording does, and both arms take part
    recorded = read_recording(resolve_recording_path(run.recordings.estimate[0])).joints
    first = recorded.position[0, [recorded.names.index(name) for name in found.joint_names]]
    np.testing.assert_allclose(found.joint_positions[0], first, atol=5e-3)
    travel = dict(zip(found.joint_names, np.ptp(found.joint_positions, axis=0), strict=True))
    assert min(max(v for k, v in travel.items() if k.startswith(side)) for side in ("left", "right")) > 0.01
    system = found.simulator.step.system
    names = [end for grasp in system.grasps for end in (grasp.holder_frame, grasp.held_frame)]
    at = found.simulator.frame_positions_along_states(FramePositionEvaluator(system, names), found.rollout.state)
    at = at.reshape(len(found.t), -1, 2, 3)
    assert np.abs(at[:, :, 0] - at[:, :, 1]).max() < 1e-8


def test_an_arm_that_holds_nothing_cannot_move_the_object(repository, tmp_path):
    with pytest.raises(ConfigError, match=r"(?s)no joint moves the point 'w_T3'.*point, or set model\.grasp"):
        planned(repository, tmp_path, "plan_place", "model.object.links=1", "model.grasp={}")


@pytest.mark.parametrize(
    ("limit", "words"),
    [
        ("effort_fraction=0.4", r"(?s)left_s1 at rest where the motion begins.*beyond its limit.*effort_fraction"),
        ("max_spring_angle=0.001", r"(?s)at rest.*rad.*plan\.limits\.max_spring_angle"),
    ],
)
def test_limits_that_rest_itself_passes_are_refused(repository, tmp_path, limit, words):
    with pytest.raises(ConfigError, match=words):
        planned(repository, tmp_path, "plan_place", *COARSE["plan_place"], f"plan.limits.{limit}")


def test_a_real_cable_in_two_clamps_is_at_rest_before_it_is_moved(repository, tmp_path):
    run = load_config(repository / "configs" / "deft_bdlo1.yaml")
    if not resolve_recording_path(run.recordings.estimate[0]).is_file():
        pytest.skip("its recordings are not here")
    way = "plan={point: p6, point_target_offset_from_start: [0.01, 0.01, 0.0], duration: 0.6, hold_duration: 0.2}"
    fewer = (
        "child_branch_vertex_names={}",
        "branch_properties_by_name={}",
        "main_branch_vertex_names=[p0, p1, p4, p6, p8, p11, p12]",
        "branch_properties_by_name={parent: {has_separate_twist_damping: true, linear_density: 0.05}}",
    )
    coarse = [f"model.object.{entry}" for entry in fewer]
    run, outcome = planned(repository, tmp_path, "deft_bdlo1", "problem.use_compiler=false", *coarse, way)
    assert outcome.is_successful, outcome.result["message"]
    first = outcome.output.rollout.state[0]
    held = simulate(outcome.output.simulator.step, outcome.output.simulator.theta, first, 20).state[-1]
    np.testing.assert_allclose(held, first, atol=1e-7)
    arrived = outcome.output.point_trajectories["p6"][-1]
    np.testing.assert_allclose(arrived, outcome.result["place"], atol=run.plan.position_tolerance)
