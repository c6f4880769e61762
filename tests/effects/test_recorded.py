"""Recordings under effects: inputs corrected, samples shifted; all effects at once: slopes, nothing at neutral."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from small_problems import STEPS, H, keeps_inputs

from yid_ocp.data.recording import JointGroup, PointGroup, Recording
from yid_ocp.effects import candidate_kinds_and_locations, make_effect
from yid_ocp.errors import DataError, ModelError, SolverError
from yid_ocp.integrator.step import compile_step
from yid_ocp.problem import EstimationProblem, ProblemOptions
from yid_ocp.problem.recorded_inputs import recorded_signal_kinds
from yid_ocp.sensors import camera_pose_of_point_group, sensor_function_with_jacobians
from yid_ocp.solvers import MultipleShooting

NAMES = ("left_a", "left_b", "left_c")
KINDS = {
    "encoder_offset": {"left_b": {"offset": 0.01}},
    "series_elasticity": {"left_b": {"stiffness": 400.0}},
    "backlash": {"left_c": {"width": 0.006}},
    "effort_gain": {"left_a": {"scale": 0.93}, "left_b": {"scale": 1.04}},
    "effort_offset": {"left_b": {"offset": -0.3}},
    "effort_delay": {"left": {"delay": 0.013}},
    "effort_lag": {"left_a": {"time_constant": 0.015}, "left_c": {"time_constant": 0.03}},
    "camera_latency": {"camera": {"delay": 0.0217}},
    "camera_rotation": {"camera": {"rx": 0.02}},
    "clock_scale": {"clock": {"scale": 0.97}},
    "kelvin_voigt": {"T3": {"tau": 0.03}},
}
# what changes the momentum that the arm's motion has
HEAVIER = {"rotor_inertia": {"left_b": {"armature": 0.05}}, "link_mass": {"left_c": {"scale": 1.1}}}
KINDS |= HEAVIER
OPEN = {"path_cutoff": float("inf"), "weak_prior_geometric_std": 0.0}


def recording(bench, effort: bool = True, camera: bool = True) -> Recording:
    """Smooth motion about the bench's posture, effort about that at rest, points somewhere near."""
    rng = np.random.default_rng(5)
    t = H * np.arange(STEPS + 1)
    ramp = np.minimum(t / 0.1, 1.0)[:, None] ** 2
    position = bench.posture + 0.02 * ramp * np.sin(14 * t[:, None] + np.arange(3))
    load = np.array([0.5, -3.0, 1.0]) if not len(bench.rest.holding_torque) else bench.rest.holding_torque
    torque = load + 0.4 * ramp * np.sin(11 * t[:, None] + 2 * np.arange(3))
    known = {"position_std": 1e-4, "effort_std": 0.05, "effort_kind": "command"}
    joints = JointGroup(NAMES, t, position, effort=torque if effort else None, **known)
    groups = [PointGroup("points_arm", ("w_T2",), t, rng.normal(size=(len(t), 1, 3)), np.array(0.01), "arm")]
    if camera:
        seen = np.sort(rng.uniform(0.0, t[-1], 9))
        place = rng.normal(size=(9, 2, 3))
        pose = np.array(bench.pose)
        groups.append(
            PointGroup("points_camera", ("w_T1", "w_T3"), seen, place, np.array(0.02), "camera", camera_pose=pose)
        )
    return Recording(joints, tuple(groups), name="made")


@cache
def effects_and_step(bench, kinds: tuple[str, ...], neutral: bool):
    chosen = [(kind, place, values) for kind in kinds for place, values in KINDS[kind].items()]
    effects = [make_effect(kind, place, bench.system, {} if neutral else values) for kind, place, values in chosen]
    return effects, compile_step(bench.system.with_effects(effects), H, use_compiler=False)


def problem(bench, kinds, *, neutral=False, feedback="none", free=(), **options) -> EstimationProblem:
    effects, step = effects_and_step(bench, tuple(kinds), neutral)
    names = tuple(name for effect in effects for name in effect.parameters.names)
    gains = (20.0, 20.0, 10.0)
    settings = ProblemOptions(**OPEN, arm_tracking_feedback=feedback, arm_proportional_gains=gains, **options)
    return EstimationProblem(step, [recording(bench)], ("T1.bend", *names, *free), settings)


CASES = [("prescribed", "none"), ("driven", "proportional"), ("driven", "lqr")]


@pytest.mark.parametrize(("mode", "feedback"), CASES)
def test_neutral_readings_change_nothing(mode, feedback, request) -> None:
    bench = request.getfixturevalue(mode)
    plain = problem(bench, (), feedback=feedback)
    full = problem(bench, KINDS, neutral=True, feedback=feedback)
    one, other = (p.evaluate(p.initial_unknowns, derivatives=False) for p in (plain, full))
    assert one.ok, one.message
    assert other.residual == pytest.approx(one.residual, rel=1e-9, abs=1e-9)
    assert keeps_inputs(plain)
    assert keeps_inputs(full.with_free_parameters_without_recompiling(["T1.bend", "kelvin_voigt@T3.tau"]))
    # the momentum that an LQR filter follows depends on an arm's damping and on how fast the clock runs
    assert keeps_inputs(problem(bench, (), feedback=feedback, free=("left_a.damping",))) is (feedback != "lqr")
    timed = full.with_free_parameters_without_recompiling(["T1.bend", "clock_scale@clock.scale"])
    assert keeps_inputs(timed) is (feedback != "lqr")
    for name in ("effort_delay@left.delay", "effort_lag@left_c.time_constant", "camera_latency@camera.delay"):
        assert not keeps_inputs(full.with_free_parameters_without_recompiling([name]))
    with pytest.raises(SolverError, match="gauss_newton"):
        MultipleShooting(condensing=True).minimize_cost(full, full.initial_unknowns, None)


def test_a_problem_takes_gains_and_equilibria_from_one_of_the_same_arms(driven) -> None:
    """An effect that adds coordinates moves the states of the arms; what is taken belongs to the states as they are."""
    plain, soft = problem(driven, (), feedback="lqr"), make_effect("junction_compliance", "w_T1", driven.system)
    step = compile_step(driven.system.with_effects([soft]), H, use_compiler=False)
    full, made = (
        EstimationProblem(step, [recording(driven)], plain.free, plain.options, like=p) for p in (None, plain)
    )
    (first,), (own,), (other,) = (p.episodes for p in (plain, full, made))
    assert other.tracking_feedback.gain is first.tracking_feedback.gain
    assert list(other.tracking_feedback.state_indices) == list(own.tracking_feedback.state_indices)
    assert own.tracking_feedback.gain == pytest.approx(first.tracking_feedback.gain, rel=1e-9, abs=1e-9)
    assert other.equilibrium_guess == pytest.approx(own.equilibrium_guess, abs=1e-9)
    one, two = (p.evaluate(p.initial_unknowns, derivatives=False) for p in (full, made))
    assert two.residual == pytest.approx(one.residual, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize(("mode", "feedback"), CASES)
def test_derivatives_agree_with_differences_and_with_the_adjoint(mode, feedback, request) -> None:
    task = problem(request.getfixturevalue(mode), KINDS, feedback=feedback)
    x = task.initial_unknowns
    result = task.evaluate(x)
    assert result.ok, result.message
    for column, name in enumerate(task.unknown_names):
        width = 1e-5 if name.endswith(("delay", "offset", "width", "compliance", "time_constant")) else 1e-4
        shift = width * np.eye(len(x))[column]
        above, below = (task.evaluate(x + sign * shift, derivatives=False).residual for sign in (1, -1))
        numeric = (above - below) / (2 * width)
        exact = result.jacobian[:, column]
        assert np.max(np.abs(exact - numeric)) <= 1e-4 * np.max(np.abs(exact)) + 1e-5, name
    _, gradient, _ = task.cost_and_gradient(x)
    assert gradient == pytest.approx(result.jacobian.T @ result.residual, rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("time_constant", [0.02, -0.02])
def test_what_acts_follows_the_recorded_effort_of_a_prescribed_joint(time_constant, prescribed) -> None:
    """T dz/dt = c - z; with a negative T the recorded effort follows what acts."""
    task = problem(prescribed, ("effort_lag",), neutral=True)
    x = task.initial_unknowns.copy()
    column = task.unknown_names.index("effort_lag@left_a.time_constant")
    acting = task.evaluate(x, derivatives=False).episode_predictions[0]
    x[column] = time_constant
    recorded = task.evaluate(x, derivatives=False).episode_predictions[0]
    at = next(i for i, samples in enumerate(task.episodes[0].measurements) if samples.sensor.effort_joints)
    joint = task.episodes[0].measurements[at].sensor.effort_joints.index("left_a")
    z, c = (found.predicted_outputs[at][:, joint] for found in (acting, recorded))
    follower, other = (z, c) if time_constant > 0 else (c, z)
    error = 0.02 * np.gradient(follower, H) - (other - follower)
    # the ramp of the motion ends in a step of its acceleration, which no difference of rates resolves
    assert np.median(np.abs(error)) < 0.05 * np.median(np.abs(other - follower))
    others = [k for k in range(recorded.predicted_outputs[at].shape[1]) if k != joint]
    np.testing.assert_array_equal(recorded.predicted_outputs[at][:, others], acting.predicted_outputs[at][:, others])


def test_a_late_camera_sees_the_past(driven, sensors) -> None:
    task = problem(driven, ("camera_latency",), neutral=True)
    delay = 3 * H
    index = task.unknown_names.index("camera_latency@camera.delay")
    x = task.initial_unknowns.copy()
    now = task.evaluate(x, derivatives=False).episode_predictions[0]
    x[index] = delay
    late = task.evaluate(x, derivatives=False).episode_predictions[0]
    episode = task.episodes[0]
    at = next(i for i, s in enumerate(episode.measurements) if s.sensor.group_name == "points_camera")
    moved = episode.measurements[at]
    assert late.predicted_outputs[1 - at] == pytest.approx(now.predicted_outputs[1 - at], abs=1e-9)
    position = np.maximum(moved.node + moved.fraction - 3.0, 0.0)
    n = driven.system.n_coordinates
    function = sensor_function_with_jacobians(task.system, sensors.camera, ())
    states = now.rollout.state
    nodes = np.array([np.array(function(q=s[:n], theta=task.theta)["y"]).ravel() for s in states])
    for k in range(6):
        expected = np.interp(position, np.arange(len(nodes)), nodes[:, k])
        assert late.predicted_outputs[at][:, k] == pytest.approx(expected, abs=1e-9)


def test_a_gear_needs_recorded_effort(prescribed) -> None:
    effect = make_effect("series_elasticity", "left_b", prescribed.system)
    step = compile_step(prescribed.system.with_effects([effect]), H, use_compiler=False)
    with pytest.raises(DataError, match=r"backlash\) needs joint efforts"):
        EstimationProblem(step, [recording(prescribed, effort=False)], ("T1.bend",))


def test_what_a_recording_holds(driven) -> None:
    full = recording(driven)
    assert recorded_signal_kinds([full]) == {"joints.position", "joints.effort", "camera"}
    assert recorded_signal_kinds([recording(driven, effort=False, camera=False)]) == {"joints.position"}
    arm, camera = full.points
    assert camera_pose_of_point_group(arm) is None
    assert camera_pose_of_point_group(camera) is not None
    unposed = PointGroup("points_camera", ("p",), [0.0], np.zeros((1, 1, 3)), clock="nominal")
    assert camera_pose_of_point_group(unposed) == tuple(map(tuple, np.eye(4)))
    assert "nominal_clock" in recorded_signal_kinds([Recording(points=(unposed,))])


def test_a_cable_from_a_fitted_start(cable, all_effects) -> None:
    layout, made, system = cable
    options = ProblemOptions(
        **OPEN, initial_state="fitted_to_points", clamp_pose_point_names=layout.clamp_pose_point_names
    )
    residuals = []
    for one in (system, system.with_effects(all_effects(system))):
        found = EstimationProblem(compile_step(one, H, use_compiler=False), [made], ("parent.bend",), options)
        result = found.evaluate(found.initial_unknowns)
        assert result.ok, result.message
        residuals.append(np.column_stack([result.residual, result.jacobian]))
    assert residuals[1] == pytest.approx(residuals[0], rel=1e-6, abs=1e-7)


def test_the_filter_follows_the_momentum_of_the_effects(driven) -> None:
    """The cost is one number, whether derivatives are asked for or not, and however the effects' values are given."""
    task = problem(driven, HEAVIER, feedback="lqr")
    with_slopes, without = (task.evaluate(task.initial_unknowns, derivatives=flag).cost for flag in (True, False))
    fixed = task.with_free_parameters_without_recompiling(["T1.bend"])
    told = problem(driven, HEAVIER, neutral=True, feedback="lqr")
    values = dict(zip(task.unknown_names, task.initial_unknowns, strict=True))
    other = told.evaluate([values[name] for name in told.unknown_names], derivatives=False).cost
    assert without == pytest.approx(with_slopes, rel=1e-12)
    assert fixed.evaluate(fixed.initial_unknowns, derivatives=False).cost == pytest.approx(without, rel=1e-12)
    assert other == pytest.approx(without, rel=1e-9)


FEW_STEPS = 4


def somewhere(effect) -> dict[str, float]:
    """Values well inside the expected ranges, away from neutral."""
    values = {}
    for i, (name, (low, high)) in enumerate(effect.prior_ranges.items()):
        values[name] = low + (0.3, 0.65, 0.8)[i % 3] * (high - low)
    return values


def at(bench, step, effects, where: str) -> SimpleNamespace:
    names = tuple(name for effect in effects for name in effect.parameters.names)
    values = {}
    for effect in effects if where == "away" else ():
        values |= somewhere(effect)
    start = bench.start(step)
    run = bench.run(step, values, names, start, FEW_STEPS)
    assert run.rollout.status.is_converged, run.rollout.status.message
    widths = {name: high - low for effect in effects for name, (low, high) in effect.prior_ranges.items()}
    return SimpleNamespace(bench=bench, step=step, names=names, values=values, start=start, run=run, widths=widths)


@pytest.fixture(scope="module")
def cases(driven, prescribed, all_effects):
    effects = {bench: all_effects(bench.system) for bench in (driven, prescribed)}
    step, benches = cache(lambda bench: bench.step(*effects[bench])), {"driven": driven, "prescribed": prescribed}
    return cache(lambda mode, where: at(own := benches[mode], step(own), effects[own], where))


@pytest.mark.parametrize("where", ["neutral", "away"])
@pytest.mark.parametrize("mode", ["driven", "prescribed"])
def test_sensitivities_agree_with_differences(mode, where, cases) -> None:
    """Kind by kind, along a direction in which all its parameters move."""
    case, rng = cases(mode, where), np.random.default_rng(4)
    centre = {name: case.step.system.parameters[name].value for name in case.names} | case.values
    for kind in {name.partition("@")[0] for name in case.names}:
        own = [name for name in case.names if name.startswith(f"{kind}@")]
        way = {name: case.widths[name] * rng.choice([-1, 1]) * rng.uniform(0.5, 1) for name in own}
        weights = np.array([way.get(name, 0.0) for name in case.names])
        ends = ({n: centre[n] + sign * 4e-5 * way[n] for n in own} for sign in (1, -1))
        above, below = (case.bench.run(case.step, case.values | e, (), case.start, FEW_STEPS).rollout for e in ends)
        for field in ("state", "multipliers", "effort"):
            exact = getattr(case.run.rollout, f"{field}_sensitivity") @ weights
            if exact.size == 0:
                continue
            numeric = (getattr(above, field) - getattr(below, field)) / 8e-5
            floor = 1e-9 * np.max(np.abs(getattr(case.run.rollout, field))) / 4e-5
            error = np.max(np.abs(exact - numeric))
            assert error <= 2e-5 * np.max(np.abs(exact)) + floor, (kind, field, error, np.max(np.abs(exact)))


@pytest.mark.parametrize("which", ["camera", "effort"])
def test_readings_have_exact_slopes(which, prescribed, all_effects, sensors) -> None:
    effects = all_effects(prescribed.system)
    system = prescribed.system.with_effects(effects)
    names = tuple(name for effect in effects for name in effect.parameters.names)
    function = sensor_function_with_jacobians(system, getattr(sensors, which), names)
    values = {}
    for effect in effects:
        values |= somewhere(effect)
    theta = system.parameters.vector(values)
    rng = np.random.default_rng(0)
    at = {name: rng.normal(size=function.numel_in(name)) for name in ("q", "z", "load")}
    exact = np.array(ca.densify(function(**at, theta=theta)["by_theta"]))
    for column, name in enumerate(names):
        shift = 1e-6 * np.eye(len(theta))[system.parameters.index(name)]
        above, below = (np.array(function(**at, theta=theta + sign * shift)["y"]) for sign in (1, -1))
        assert np.allclose(exact[:, column], (above - below).ravel() / 2e-6, rtol=1e-6, atol=1e-8), name


@pytest.mark.usefixtures("c_compiler")
def test_compiled_and_interpreted_agree_with_every_effect(cases) -> None:
    case = cases("driven", "away")
    bench = case.bench
    step = compile_step(case.step.system, case.step.time_step)
    assert step.is_compiled
    fast, slow = bench.run(step, case.values, case.names, case.start, FEW_STEPS).rollout, case.run.rollout
    for field in ("state", "multipliers", "state_sensitivity", "multipliers_sensitivity"):
        one, other = getattr(fast, field), getattr(slow, field)
        assert np.max(np.abs(one - other)) <= 1e-8 * np.max(np.abs(other)), field
    weight = np.random.default_rng(1).normal(size=slow.state.shape)
    exact = np.einsum("kx,kxd->d", weight, slow.state_sensitivity)
    for s, rollout in ((step, fast), (case.step, slow)):
        gradient = s.kernel.adjoint_gradient(case.run.theta, rollout, None, case.names, (weight, None, None))
        assert gradient.by_theta == pytest.approx(exact, rel=1e-6, abs=1e-8 * np.max(np.abs(exact)))


def largest(difference, reference) -> float:
    return float(np.max(np.abs(difference)) / np.max(np.abs(reference)))


@pytest.mark.parametrize("mode", ["driven", "prescribed"])
def test_at_neutral_parameters_they_change_nothing(mode, request, all_effects, sensors) -> None:
    bench = request.getfixturevalue(mode)
    plain, full = bench.run(bench.plain), bench.run(bench.step(*all_effects(bench.system)))
    assert full.rollout.status.is_converged
    assert full.rollout.status.newton_iterations <= 1.5 * plain.rollout.status.newton_iterations
    assert largest(bench.nominal_part(full) - bench.nominal_part(plain), bench.nominal_part(plain)) < 1e-10
    assert largest(full.rollout.multipliers - plain.rollout.multipliers, plain.rollout.multipliers) < 1e-10
    for sensor in [sensors.camera, sensors.arm] + ([sensors.effort] if mode == "prescribed" else []):
        nominal = bench.reading(plain, sensor)
        assert largest(bench.reading(full, sensor) - nominal, nominal) < 1e-10


def test_the_clock_of_any_group_of_points_may_be_late_or_early(driven):
    """Not that of points which the arm measures by its own encoders."""
    [camera] = [group for group in recording(driven).points if group.name.endswith("camera")]
    mocap = replace(camera, name="points_mocap", sensor_name="mocap", camera_pose=None)
    made = replace(recording(driven, camera=False), points=(*recording(driven, camera=False).points, mocap))
    assert "points:points_mocap" in recorded_signal_kinds([made])
    found = candidate_kinds_and_locations(driven.system, recorded_signal_kinds([made]))
    assert [place for kind, place in found if kind == "camera_latency"] == ["points_mocap"]
    late = make_effect("camera_latency", "points_mocap", driven.system)
    assert late.parameters["camera_latency@points_mocap.delay"].lower < 0
    # points of the arm's own frames need none of `System.point_frames`
    bare = replace(driven.system, point_frames=())
    assert make_effect("camera_latency", "points_mocap", bare).label == "camera_latency@points_mocap"
    assert float(ca.DM(late.added_channel_delay("points_arm.w_T2", False))) == 0
    assert ca.is_equal(late.added_channel_delay("points_mocap.w_T2", False), late["delay"])
    with pytest.raises(ModelError, match="camera_latency is not possible at 'mocap'"):
        make_effect("camera_latency", "mocap", driven.system)
