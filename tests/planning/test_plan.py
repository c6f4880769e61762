"""Plans of a small system: derivatives, goals, limits, uncertainty, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from yid_ocp.errors import ConfigError, ModelError, YidError
from yid_ocp.integrator.rollout import simulate
from yid_ocp.integrator.statics import Statics
from yid_ocp.integrator.step import compile_step
from yid_ocp.planning.mover import Mover
from yid_ocp.planning.options import PlanLimits, PlanOptions
from yid_ocp.planning.path import SplinePath
from yid_ocp.planning.plan import Known, plan
from yid_ocp.planning.points import Points
from yid_ocp.planning.rows import Rows
from yid_ocp.planning.shooting import Shooting

START, GOAL = 0.2, 0.7


def tip_at(step, angle, theta=None):
    """Where the tip rests with the shoulder at an angle."""
    theta = step.system.parameters.vector() if theta is None else theta
    rest = Statics(step).solve([angle], theta)
    return Points(step.system, ["tip"]).at(rest.state[None, : step.system.size], theta)[0][0]


@pytest.fixture(scope="module")
def wanted(moved):
    place = tuple(float(x) for x in tip_at(moved, GOAL))
    return PlanOptions(point="tip", place=place, posture={"shoulder": START}, duration=0.6, settle=0.3, knots=6)


@pytest.fixture(scope="module")
def found(moved, wanted):
    return plan(moved, wanted)


BOX = ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.3))


@pytest.mark.parametrize(
    "more",
    [
        {"goal": "place", "effort": 0.5, "limits": PlanLimits(spring_angle=0.5)},
        {"goal": "path", "via": ((0.0, 0.1, 0.0),)},
        {"goal": "box", "box": BOX},
    ],
    ids=["place", "path", "box"],
)
def test_slopes_are_derivatives(moved, wanted, more):
    options = replace(wanted, **more)
    theta = moved.system.parameters.vector()
    mover = Mover(moved, theta, Statics(moved).solve([START], theta), SplinePath(0.4, 4), 0.1)
    inside = Points(moved.system, ("tip", "lower")) if options.box else None
    simple = mover.path.straight([0.4])
    rows = Rows(mover, options, Points(moved.system, ("tip", "lower")), np.array(options.place), simple, inside)
    shooting = Shooting([rows], simple.shape)
    rng, x, e = np.random.default_rng(5), simple.ravel() + 0.1, 1e-5
    way = rng.normal(size=x.size)
    before, after, here = (shooting.at(y) for y in (x - e * way, x + e * way, x))
    for low, high, middle in zip(before, after, here, strict=True):
        slope = (high.value - low.value) / (2 * e)
        np.testing.assert_allclose(middle.slope @ way, slope, rtol=1e-5, atol=1e-5 * np.abs(slope).max())
    assert len(here[1].value) == sum(len(bounded.names) for bounded in rows.bounded)


def test_the_point_arrives_and_stays_without_swinging(moved, wanted, found):
    assert found.reached, found.message
    assert found.error < 1e-4
    assert found.swing < wanted.swing
    n = moved.system.size
    step = found.mover.step
    again = simulate(step, found.mover.theta, found.mover.start.state, len(found.t) - 1, path=found.position)
    tip = Points(moved.system, ["tip"]).at(again.state[:, :n], found.mover.theta)[0]
    np.testing.assert_allclose(found.points["tip"], tip, atol=1e-12)
    end = found.t >= wanted.duration - 1e-9
    assert np.linalg.norm(tip[end] - wanted.place, axis=1).max() == pytest.approx(found.error)
    speed = np.linalg.norm(np.diff(tip[end], axis=0), axis=1) / step.time_step
    assert speed.max() <= found.swing + 1e-12
    # moving the shoulder there smoothly, as if the elbow were stiff, leaves the tip swinging
    simple = found.mover.roll(found.mover.path.straight([GOAL - START]))
    left = Points(moved.system, ["tip"]).at(simple.state[end, :n], found.mover.theta)[0] - wanted.place
    assert np.linalg.norm(left, axis=1).max() > 20 * found.error


def test_what_hangs_below_the_point_comes_to_rest_as_well(moved, wanted):
    lower = Points(moved.system, ["lower"])

    def at(angle):
        rest = Statics(moved).solve([angle], moved.system.parameters.vector())
        return lower.at(rest.state[None, : moved.system.size], moved.system.parameters.vector())[0][0]

    # the shoulder alone brings this one there, whatever the elbow does
    done = plan(moved, replace(wanted, point="lower", place=tuple(map(float, at(GOAL)))))
    assert done.reached, done.message
    tip = np.diff(done.points["tip"][done.mover.standing], axis=0) / done.mover.step.time_step
    assert np.linalg.norm(tip, axis=1).max() < wanted.swing


def test_a_plan_holds_where_time_is_stepped_more_finely(moved, wanted):
    coarse, fine = (compile_step(moved.system, h, use_compiler=False) for h in (0.05, 0.001))
    done = plan(coarse, wanted)
    assert done.reached, done.message
    assert done.mover.step.time_step < coarse.time_step
    start = Statics(fine).solve([START], done.mover.theta)
    held = replace(done.mover, step=fine, start=start)
    tip = Points(moved.system, ["tip"]).at(held.roll(done.unknowns).state[:, : moved.system.size], held.theta)[0]
    end = held.times >= wanted.duration - 1e-9
    assert np.linalg.norm(tip[end] - wanted.place, axis=1).max() < wanted.tolerance
    assert np.linalg.norm(np.diff(tip[end], axis=0), axis=1).max() / fine.time_step < 2 * wanted.swing


def test_a_plan_starts_and_ends_at_rest(found):
    for values in (found.velocity, found.acceleration):
        np.testing.assert_allclose(values[[0, -1]], 0.0, atol=1e-9)
    assert found.position[0] == pytest.approx([START])


def test_limits_are_kept_at_the_price_of_the_goal_or_of_calm(moved, wanted, found):
    top = np.abs(found.acceleration).max()
    bound = 0.8 * top
    calm = plan(moved, replace(wanted, duration=0.8, limits=PlanLimits(acceleration=bound)))
    assert calm.reached, calm.message
    assert np.abs(calm.acceleration).max() <= bound * 1.001
    strong = np.abs(found.effort).max()
    share = 0.97 * strong / 40.0
    gentle = plan(moved, replace(wanted, duration=0.8, limits=PlanLimits(effort=share)))
    assert np.abs(gentle.effort).max() <= share * 40.0 * 1.005, gentle.message


def test_a_limit_that_cannot_be_kept_is_named(moved, wanted):
    hasty = plan(moved, replace(wanted, duration=0.15))
    assert not hasty.reached
    assert "shoulder passes its limit" in hasty.message or "leaves the point" in hasty.message
    assert "plan.duration" in hasty.message


def test_a_motion_that_leaves_the_point_elsewhere_has_not_arrived(moved, wanted):
    few = plan(moved, replace(wanted, knots=2, duration=0.4, limits=PlanLimits(acceleration=1e3)))
    assert few.error > 2 * wanted.tolerance, "the motion must fail for this to be a test"
    assert not few.reached
    assert f"leaves the point {1e3 * few.error:.3g} mm from its place" in few.message


def test_a_path_is_followed(moved, wanted):
    begin = tip_at(moved, START)
    via = tuple(tuple(float(x) for x in tip_at(moved, angle) - begin) for angle in (0.45, 0.8))
    options = replace(wanted, goal="path", via=via, duration=1.5, knots=12, tolerance=5e-3)
    followed = plan(moved, options)
    assert followed.reached, followed.message
    direct = plan(moved, replace(options, goal="place")).points["tip"]
    passed = np.linalg.norm(direct - (begin + via[1]), axis=1).min()
    assert passed > 0.03, "the direct motion must not pass there for this to be a test"
    for share, shift in zip((1 / 3, 2 / 3), via, strict=True):
        at = followed.points["tip"][int(np.argmin(np.abs(followed.t - share * 1.5)))]
        # one joint cannot follow a curve in the plane exactly
        assert np.linalg.norm(at - begin - shift) < 0.02


def test_points_stay_in_the_box(moved, wanted, found):
    tip = found.points["tip"]
    top = float(tip[:, 2].max())
    low, high = tip.min(0), tip.max(0)
    assert top > wanted.place[2] + 2e-3, "the free motion must overshoot for this to be a test"
    lid = 0.5 * (top + wanted.place[2])
    box = ((-1.0, float(low[1]) - 1.0, float(low[2]) - 1.0), (1.0, float(high[1]) + 1.0, lid))
    kept = plan(moved, replace(wanted, goal="box", box=box, inside=("tip",), duration=0.8, knots=8))
    assert kept.reached, kept.message
    assert kept.points["tip"][::2, 2].max() <= lid + 1e-4


def test_the_shortest_duration_is_shorter_and_arrives(moved, wanted):
    quick = plan(moved, replace(wanted, duration=1.2, shortest=True))
    assert quick.reached
    assert quick.swing <= wanted.swing
    assert quick.mover.path.duration < 0.8


def test_spread_is_the_derivative_times_the_uncertainty(moved, wanted):
    known = Known(("elbow.stiffness",), np.array([[0.3**2]]))
    told = plan(moved, wanted, known=known)
    places = []
    for sign in (-1, 1):
        theta = told.mover.theta.copy()
        theta[moved.system.parameters.index("elbow.stiffness")] += sign * 1e-4
        mover = replace(told.mover, theta=theta, start=Statics(moved).solve([START], theta))
        state = mover.roll(told.unknowns).state[-1:, : moved.system.size]
        places.append(Points(moved.system, ["tip"]).at(state, theta)[0][0])
    np.testing.assert_allclose(told.std, 0.3 * np.abs(places[1] - places[0]) / 2e-4, rtol=1e-4, atol=1e-9)


def test_a_motion_planned_for_uncertainty_errs_less_where_the_stiffness_is_another(moved, wanted):
    known = Known(("elbow.stiffness",), np.array([[0.6**2]]))
    options, worst = replace(wanted, knots=8, duration=1.0), []
    for spread in (False, True):
        done = plan(moved, replace(options, spread=spread), known=known)
        assert done.reached, done.message
        errors = []
        for sign in (-1, 1):
            theta = done.mover.theta.copy()
            theta[moved.system.parameters.index("elbow.stiffness")] += sign * 0.6
            mover = replace(done.mover, theta=theta, start=Statics(moved).solve([START], theta))
            state = mover.roll(done.unknowns).state[done.mover.standing, : moved.system.size]
            off = Points(moved.system, ["tip"]).at(state, theta)[0] - options.place
            errors.append(np.sqrt(np.mean(np.sum(off**2, axis=1))))
        worst.append(max(errors))
    assert worst[1] < 0.8 * worst[0]


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"place": (0.0, 3.0, 0.0)}, ("out of reach", "mm off", "joint's limit", "nearer place")),
        ({"point": "tipp"}, ("no frame 'tipp'",)),
        ({"point": None}, ("no point is named",)),
        ({"shift": (0.0, 0.1, 0.0)}, ("said twice", "one of place and shift")),
        ({"place": None}, ("nothing says where the point is to arrive",)),
        ({"posture": {"shoulder": 1.5}}, ("shoulder starts at 1.5", "0.3 beyond its limit", "-1.2 to 1.2")),
        ({"posture": {"sholder": 0.5}}, ("'sholder' is no joint that moves", "did you mean 'shoulder'?")),
        ({"posture": {}}, ("says nothing of shoulder",)),
        ({"posture": None}, ("nothing says where the motion begins",)),
        ({"goal": "path"}, ("no places on the way",)),
        ({"goal": "box"}, ("there is no box",)),
        ({"goal": "box", "box": ((0, 0, 1), (1, 1, 0))}, ("empty along z", "from 1 up to 0 m")),
        ({"goal": "box", "box": ((-1, -1, -1), (1, 1, 0.3))}, ("mm outside the box along z", "plan.inside")),
        ({"spread": True}, ("uncertainty is not known", "plan.run")),
        ({"knots": 1}, ("knots = 1", "from 2")),
        ({"duration": -1.0}, ("duration = -1", "above 0")),
    ],
)
def test_what_is_refused(moved, wanted, more, words):
    with pytest.raises(YidError) as caught:
        plan(moved, replace(wanted, **more))
    assert isinstance(caught.value, (ConfigError, ModelError))
    for word in words:
        assert word in str(caught.value)


def test_a_system_without_moved_joints_is_refused(urdf_folder, wanted):
    from small_problems import pendulum_step

    with pytest.raises(ConfigError, match="no joint is prescribed"):
        plan(pendulum_step(urdf_folder), wanted)
