"""Plans of a small system: derivatives, goals, limits, uncertainty, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from small_problems import pendulum_step

from yid_ocp.errors import ConfigError, ModelError
from yid_ocp.integrator.statics import EquilibriumSolver
from yid_ocp.integrator.step import compile_step, simulate
from yid_ocp.planning.joint_paths import (
    FramePositionEvaluator,
    PathSimulator,
    PlanLimits,
    PlanOptions,
    RestToRestSplineBasis,
)
from yid_ocp.planning.motion_plan import ParameterCovarianceBeforePlan, plan_motion_to_target
from yid_ocp.planning.motion_search import MotionToTargetSearch, PlanResidualAndLimitFunctions

START, GOAL = 0.2, 0.7


def point_at(step, angle, name="tip"):
    """Where a point rests with the shoulder at an angle."""
    mover = rested(step, step.system.parameters.vector(), angle)
    return places(mover, mover.start_equilibrium.state[None], name)[0]


def rested(step, theta, angle=START, path=None):
    """A simulator that begins at rest."""
    return PathSimulator(
        step, theta, EquilibriumSolver(step).solve([angle], theta), path or RestToRestSplineBasis(0.4, 4), 0.1
    )


def places(mover, state, name="tip"):
    """Positions of a frame along states."""
    return mover.frame_positions_along_states(FramePositionEvaluator(mover.step.system, [name]), state)[:, 0]


def elsewhere(plan, change):
    """The plan's simulator with another stiffness of the elbow."""
    theta = plan.simulator.theta.copy()
    theta[plan.simulator.step.system.parameters.index("elbow.stiffness")] += change
    start = EquilibriumSolver(plan.simulator.step).solve([START], theta)
    return replace(plan.simulator, theta=theta, start_equilibrium=start)


@pytest.fixture(scope="module")
def wanted(moved):
    place, start = tuple(float(x) for x in point_at(moved, GOAL)), {"shoulder": START}
    sizes = {"duration": 0.6, "hold_duration": 0.3, "n_spline_coefficients": 6}
    return PlanOptions(point="tip", target_position=place, start_joint_positions=start, **sizes)


@pytest.fixture(scope="module")
def found(moved, wanted):
    return plan_motion_to_target(moved, wanted)


BOX = ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.3))


@pytest.mark.parametrize(
    "more",
    [
        {"goal": "place", "effort_weight": 0.5, "limits": PlanLimits(max_spring_angle=0.5)},
        {"goal": "path", "point_waypoint_offsets_from_start": ((0.0, 0.1, 0.0),)},
        {"goal": "box", "box": BOX},
    ],
    ids=["place", "path", "box"],
)
def test_slopes_are_derivatives(moved, wanted, more):
    options, mover = replace(wanted, **more), rested(moved, moved.system.parameters.vector())
    frames = FramePositionEvaluator(moved.system, ("tip", "lower"))
    simple = mover.path.straight_line_coefficients([0.4])
    inside = frames if options.box else None
    rows = PlanResidualAndLimitFunctions(mover, options, frames, np.array(options.target_position), simple, inside)
    shooting = MotionToTargetSearch([rows])
    rng, x, e = np.random.default_rng(5), simple.ravel() + 0.1, 1e-5
    way = rng.normal(size=x.size)
    before, after, here = (shooting._residual_and_limit_values(tuple(y)) for y in (x - e * way, x + e * way, x))
    for value in (0, 2):
        slope = (after[value] - before[value]) / (2 * e)
        np.testing.assert_allclose(here[value + 1] @ way, slope, rtol=1e-5, atol=1e-5 * np.abs(slope).max())
    assert len(here[2]) == sum(len(bounded.row_names) for bounded in rows.limit_rows)


def test_the_point_arrives_and_stays_without_swinging(moved, wanted, found):
    assert found.is_successful, found.message
    assert found.max_position_error < 1e-4
    assert found.max_residual_speed < wanted.point_rest_speed_tolerance
    for values in (found.joint_velocities, found.joint_accelerations):
        np.testing.assert_allclose(values[[0, -1]], 0.0, atol=1e-9)
    assert found.joint_positions[0] == pytest.approx([START])
    mover, start = found.simulator, found.simulator.start_equilibrium.state
    again = simulate(mover.step, mover.theta, start, len(found.t) - 1, path=found.joint_positions)
    tip = places(mover, again.state)
    np.testing.assert_allclose(found.point_trajectories["tip"], tip, atol=1e-12)
    end = found.t >= wanted.duration - 1e-9
    assert np.linalg.norm(tip[end] - wanted.target_position, axis=1).max() == pytest.approx(found.max_position_error)
    speed = np.linalg.norm(np.diff(tip[end], axis=0), axis=1) / mover.step.time_step
    assert speed.max() <= found.max_residual_speed + 1e-12
    # moving the shoulder there smoothly, as if the elbow were stiff, leaves the tip swinging
    simple = mover.simulate_path(mover.path.straight_line_coefficients([GOAL - START]))
    left = places(mover, simple.state[end]) - wanted.target_position
    assert np.linalg.norm(left, axis=1).max() > 20 * found.max_position_error


def test_what_hangs_below_the_point_comes_to_rest_as_well(moved, wanted):
    # the shoulder alone brings this one there, whatever the elbow does
    goal = tuple(map(float, point_at(moved, GOAL, "lower")))
    done = plan_motion_to_target(moved, replace(wanted, point="lower", target_position=goal))
    assert done.is_successful, done.message
    moves = np.diff(done.point_trajectories["tip"][done.simulator.node_indices_after_motion], axis=0)
    assert np.linalg.norm(moves, axis=1).max() / done.simulator.step.time_step < wanted.point_rest_speed_tolerance


def test_a_plan_holds_where_time_is_stepped_more_finely(moved, wanted):
    coarse, fine = (compile_step(moved.system, h, use_compiler=False) for h in (0.05, 0.001))
    done = plan_motion_to_target(coarse, wanted)
    assert done.is_successful, done.message
    assert done.simulator.step.time_step < coarse.time_step
    start = EquilibriumSolver(fine).solve([START], done.simulator.theta)
    held = replace(done.simulator, step=fine, start_equilibrium=start)
    tip = places(held, held.simulate_path(done.spline_coefficients).state)
    end = held.node_times >= wanted.duration - 1e-9
    assert np.linalg.norm(tip[end] - wanted.target_position, axis=1).max() < wanted.position_tolerance
    assert (
        np.linalg.norm(np.diff(tip[end], axis=0), axis=1).max() / fine.time_step < 2 * wanted.point_rest_speed_tolerance
    )


def test_limits_are_kept_at_the_price_of_the_goal_or_of_calm(moved, wanted, found):
    bound = 0.8 * np.abs(found.joint_accelerations).max()
    calm = plan_motion_to_target(moved, replace(wanted, duration=0.8, limits=PlanLimits(max_acceleration=bound)))
    assert calm.is_successful, calm.message
    assert np.abs(calm.joint_accelerations).max() <= bound * 1.001
    share = 0.97 * np.abs(found.joint_efforts).max() / 40.0
    gentle = plan_motion_to_target(moved, replace(wanted, duration=0.8, limits=PlanLimits(effort_fraction=share)))
    assert np.abs(gentle.joint_efforts).max() <= share * 40.0 * 1.005, gentle.message


def test_a_limit_that_cannot_be_kept_is_named(moved, wanted):
    hasty = plan_motion_to_target(moved, replace(wanted, duration=0.15))
    assert not hasty.is_successful
    assert "of shoulder reaches" in hasty.message or "leaves the point" in hasty.message
    assert "plan.duration" in hasty.message


def test_a_motion_that_leaves_the_point_elsewhere_has_not_arrived(moved, wanted):
    limits = PlanLimits(max_acceleration=1e3)
    few = plan_motion_to_target(moved, replace(wanted, n_spline_coefficients=2, duration=0.4, limits=limits))
    assert few.max_position_error > 2 * wanted.position_tolerance, "the motion must fail for this to be a test"
    assert not few.is_successful
    assert f"leaves the point {1e3 * few.max_position_error:.3g} mm from its target (1.5 mm, 1.5 t" in few.message


def test_a_path_is_followed(moved, wanted):
    begin = point_at(moved, START)
    via = tuple(tuple(float(x) for x in point_at(moved, angle) - begin) for angle in (0.45, 0.8))
    more = {"duration": 1.5, "n_spline_coefficients": 12, "position_tolerance": 5e-3}
    options = replace(wanted, goal="path", point_waypoint_offsets_from_start=via, **more)
    followed = plan_motion_to_target(moved, options)
    assert followed.is_successful, followed.message
    direct = plan_motion_to_target(moved, replace(options, goal="place")).point_trajectories["tip"]
    passed = np.linalg.norm(direct - (begin + via[1]), axis=1).min()
    assert passed > 0.03, "the direct motion must not pass there for this to be a test"
    for share, shift in zip((1 / 3, 2 / 3), via, strict=True):
        at = followed.point_trajectories["tip"][int(np.argmin(np.abs(followed.t - share * 1.5)))]
        # one joint cannot follow a curve in the plane exactly
        assert np.linalg.norm(at - begin - shift) < 0.02


def test_points_stay_in_the_box(moved, wanted, found):
    tip = found.point_trajectories["tip"]
    top = float(tip[:, 2].max())
    low, high = tip.min(0), tip.max(0)
    assert top > wanted.target_position[2] + 2e-3, "the free motion must overshoot for this to be a test"
    lid = 0.5 * (top + wanted.target_position[2])
    box = ((-1.0, float(low[1]) - 1.0, float(low[2]) - 1.0), (1.0, float(high[1]) + 1.0, lid))
    inside = {"goal": "box", "box": box, "frames_in_box": ("tip",)}
    kept = plan_motion_to_target(moved, replace(wanted, **inside, duration=0.8, n_spline_coefficients=8))
    assert kept.is_successful, kept.message
    assert kept.point_trajectories["tip"][::2, 2].max() <= lid + 1e-4


def test_the_shortest_duration_is_shorter_and_arrives(moved, wanted):
    quick = plan_motion_to_target(moved, replace(wanted, duration=0.8, hold_duration=0.15, minimize_duration=True))
    assert quick.is_successful
    assert quick.max_residual_speed <= wanted.point_rest_speed_tolerance
    assert quick.simulator.path.duration < 0.71


def test_spread_is_the_derivative_times_the_uncertainty(moved, wanted):
    known = ParameterCovarianceBeforePlan(("elbow.stiffness",), np.array([[0.3**2]]))
    told = plan_motion_to_target(moved, wanted, known=known)
    movers = (elsewhere(told, -1e-4), elsewhere(told, 1e-4))
    below, above = (places(m, m.simulate_path(told.spline_coefficients).state[-1:])[0] for m in movers)
    np.testing.assert_allclose(told.end_position_std, 0.3 * np.abs(above - below) / 2e-4, rtol=1e-4, atol=1e-9)


def test_a_motion_planned_for_uncertainty_errs_less_where_the_stiffness_is_another(moved, wanted):
    known = ParameterCovarianceBeforePlan(("elbow.stiffness",), np.array([[0.6**2]]))
    options, worst = replace(wanted, n_spline_coefficients=8, duration=1.0, hold_duration=0.15), []
    for spread in (False, True):
        done = plan_motion_to_target(moved, replace(options, minimize_parameter_sensitivity=spread), known=known)
        assert done.is_successful, done.message
        errors = []
        for mover in (elsewhere(done, -0.6), elsewhere(done, 0.6)):
            state = mover.simulate_path(done.spline_coefficients).state[mover.node_indices_after_motion]
            errors.append(np.sqrt(np.mean(np.sum((places(mover, state) - options.target_position) ** 2, axis=1))))
        worst.append(max(errors))
    assert worst[1] < 0.8 * worst[0]


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"target_position": (0.0, 3.0, 0.0)}, ("of reach", "2.34 m off", "joint's limit", "plan.target_position\n")),
        ({"point": "tipp"}, ("no frame 'tipp'", "where: plan.point\n")),
        ({"goal": "box", "frames_in_box": ("tipp",)}, ("no frame 'tipp'", "where: plan.frames_in_box\n")),
        ({"point": None}, ("plan.point is missing",)),
        ({"point_target_offset_from_start": (0.0, 0.1, 0.0)}, ("is given twice", "plan.target_position, plan.point_t")),
        ({"target_position": None}, ("the target of the point", "is not given")),
        ({"start_joint_positions": {"shoulder": 1.5}}, ("starts at 1.5", "0.3 rad beyond its limit", "-1.2 to 1.2")),
        ({"start_joint_positions": {"sholder": 0.5}}, ("no moved joint 'sholder'", "did you mean 'shoulder'?")),
        ({"start_joint_positions": {}}, ("the position of shoulder is missing",)),
        ({"start_joint_positions": None}, ("the start positions of the joints are not given", "model.grasp")),
        ({"goal": "path"}, ("no waypoints",)),
        ({"goal": "box"}, ("plan.goal is box, but plan.box is not set",)),
        ({"goal": "box", "box": ((0, 0, 1), (1, 1, 0))}, ("empty along z", "from 1 up to 0 m")),
        ({"goal": "box", "box": ((-1, -1, -1), (1, 1, 0.3))}, (" m outside the box along z", "plan.frames_in_box")),
        ({"minimize_parameter_sensitivity": True}, ("parameters is not known", "plan.parameter_run_folder")),
        ({"n_spline_coefficients": 1}, ("n_spline_coefficients is 1", "from 2")),
        ({"duration": 0.01}, ("faster than its speed limit", "where: plan.duration\n")),
    ],
)
def test_what_is_refused(refused_with, moved, wanted, more, words):
    with refused_with((ConfigError, ModelError), words):
        plan_motion_to_target(moved, replace(wanted, **more))


def test_a_system_without_moved_joints_is_refused(urdf_folder, wanted):
    for driven, what in (((), "the model has no arm with prescribed"), (["elbow"], "'elbow' is driven, not pre")):
        with pytest.raises(ConfigError, match=what):
            plan_motion_to_target(pendulum_step(urdf_folder, driven=driven), wanted)
