"""A payload: inverse dynamics beside Pinocchio's, the link's inertia stays positive, where it is looked for."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from baxter import baxter_foam_y_system

from yid_ocp.analysis.pinocchio_comparison import _assembled
from yid_ocp.effects import EFFECTS, make_effect
from yid_ocp.effects.base import effort_limit_ratio_to_baxter, frame_names_at_arm_link_ends, one_frame_name_per_arm_link
from yid_ocp.model import Mechanism, System
from yid_ocp.model.kinematics import forward_kinematics, lagrangian_first_derivatives, mass_matrix
from yid_ocp.model.mechanism import (
    Frame,
    Inertia,
    Joint,
    Placement,
    homogeneous_transform,
    merge_inertias,
    rotation_from_rpy,
)
from yid_ocp.model.urdf import read_urdf

TURNED = homogeneous_transform(rotation_from_rpy(0.3, -0.5, 1.1), [0.02, 0.1, 0.25])


def arm() -> System:
    """Three joints, of which the last carries a hand in a frame that is turned and beside it."""
    along = Placement.from_matrix(homogeneous_transform(np.eye(3), [0.0, 0.05, 0.3]))
    body = Inertia.from_values(1.2, [0.01, -0.02, 0.15], [[9e-3, 3e-4, 0], [3e-4, 8e-3, 2e-4], [0, 2e-4, 2e-3]])
    axes, places = ((0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)), (Placement.identity(), along, along)
    joints = (Joint(f"j{i}", "revolute", i - 1, places[i], axes[i], (body,)) for i in range(3))
    frames = {f"link{i}": Frame(i, Placement.identity()) for i in range(3)}
    frames |= {"hand": Frame(2, Placement.from_matrix(TURNED))}
    return System.build(Mechanism("arm", tuple(joints), frames), prescribed=["j0", "j1", "j2"], damping=0.0)


def mechanics(system: System):
    """Mass matrix, dL/dq and dL/dv of a system at (q, v) as functions of its parameters."""
    q, v = ca.SX.sym("q", system.n_coordinates), ca.SX.sym("v", system.n_coordinates)
    rigid = lagrangian_first_derivatives(forward_kinematics(system.mechanism, q), v, system.gravity)
    outputs = [mass_matrix(rigid, system.mechanism), rigid.lagrangian_by_q, rigid.lagrangian_by_v]
    return ca.Function("mechanics", [q, v, system.parameters.symbols], [ca.densify(x) for x in outputs])


def in_pinocchio(system: System, mass: float, point):
    """The same arm with a point of some mass, negative or not, put on its last joint by Pinocchio."""
    model = _assembled(system.mechanism, np.array([0.0, 0.0, -9.81]), weight=True)
    own = model.inertias[model.njoints - 1]
    whole, centre = own.mass + mass, (own.mass * own.lever + mass * np.array(point)) / (own.mass + mass)
    apart = np.array(point) - own.lever
    tensor = own.inertia + own.mass * mass / whole * (apart @ apart * np.eye(3) - np.outer(apart, apart))
    model.inertias[model.njoints - 1] = pin.Inertia(whole, centre, tensor)
    return model


@pytest.mark.parametrize(
    ("mass", "point"), [(0.33, (-0.1, 0.2, 0.4)), (2.5, (0.1, 0.3, 0.2)), (-0.35, (0.01, -0.03, 0.2))]
)
def test_inverse_dynamics_are_those_of_a_point_on_the_link(mass, point) -> None:
    nominal = arm()
    moment = mass * TURNED[:3, :3].T @ (np.array(point) - TURNED[:3, 3])
    values = dict(zip(("mass", "mx", "my", "mz"), (mass, *moment), strict=True))
    system = nominal.with_effects([make_effect("payload", "hand", nominal, values)])
    model = in_pinocchio(nominal, mass, point)
    data, rng, theta = model.createData(), np.random.default_rng(2), system.parameters.vector()
    found = mechanics(system)
    for _ in range(3):
        q, v = rng.uniform(-1, 1, (2, 3))
        inertia, by_q, momentum = (np.array(x) for x in found(q, v, theta))
        expected = pin.crba(model, data, q)
        expected = np.triu(expected) + np.triu(expected, 1).T
        # the limit of its place and the smooth way to nothing at neutral change a point by a part in a thousand
        size = np.abs(expected).max()
        np.testing.assert_allclose(inertia, expected, atol=2e-3 * size)
        np.testing.assert_allclose(momentum.ravel(), expected @ v, atol=2e-3 * size * np.abs(v).max())
        still = np.array(found(q, 0 * v, theta)[1]).ravel()
        weight = pin.computeGeneralizedGravity(model, data, q)
        np.testing.assert_allclose(-still, weight, atol=2e-3 * np.abs(weight).max())
        np.testing.assert_allclose(by_q.ravel() - still, 0.5 * _slope(found, q, v, theta), atol=1e-6)


def _slope(found, q, v, theta) -> np.ndarray:
    """d(v' M v)/dq by central differences."""
    ends = [[v @ np.array(found(q + way, v, theta)[0]) @ v for way in sign * np.eye(len(q))] for sign in (1e-6, -1e-6)]
    return np.subtract(*ends) / 2e-6


def test_the_link_keeps_mass_and_inertia_wherever_a_search_goes() -> None:
    nominal = arm()
    effect = make_effect("payload", "hand", nominal)
    system = nominal.with_effects([effect])
    last = merge_inertias(system.mechanism.joints[2].bodies)
    outputs = [last.mass, last.center_of_mass, last.inertia_about_com]
    function = ca.Function("link", [system.parameters.symbols], outputs)
    rng = np.random.default_rng(0)
    bounds = [(q.lower, q.upper) for q in effect.definitions]
    centre = nominal.mechanism.joints[2].bodies[0]
    for k in range(400):
        scale = 10.0 ** -rng.uniform(0, 5)
        values = {n: scale * rng.uniform(*b) for n, b in zip(effect.parameters.names, bounds, strict=True)}
        if k % 4 == 0:
            values[effect.parameters.names[0]] = (0.0, bounds[0][0])[k % 8 == 0]
        mass, com, tensor = (np.array(x) for x in function(system.parameters.vector(values)))
        assert mass[0, 0] > 0.05 * float(centre.mass)
        # of a body: what it has about every axis is no less than nothing, and so the triangle inequalities hold
        assert np.linalg.eigvalsh(np.trace(tensor) / 2 * np.eye(3) - tensor)[0] > -1e-7
        assert np.linalg.eigvalsh(tensor)[0] > 1e-5
        assert np.all(np.isfinite(com))


def test_moments_beyond_reach_do_not_act_and_what_acts_is_reported() -> None:
    nominal = arm()
    effect = make_effect("payload", "hand", nominal)
    names = effect.parameters.names
    std = dict.fromkeys(names, 0.01)
    near = effect.to_reported_parameters(dict(zip(names, (1.0, 0.0, 0.2, 0.0), strict=True)), std)
    assert near["my"].value == pytest.approx(0.2, rel=1e-3)
    assert near["my"].std == 0.01
    far = effect.to_reported_parameters(dict(zip(names, (1.0, 0.0, 3.0, 4.0), strict=True)), std)
    assert np.hypot(far["my"].value, far["mz"].value) == pytest.approx(np.hypot(0.5 * 1.0, 0.05 * 1.2), rel=1e-6)
    assert np.isnan(far["my"].std)
    assert far["mass"].std == 0.01
    given = nominal.with_effects([make_effect("payload", "hand", nominal, {"mass": 1.0, "my": 3.0, "mz": 4.0})])
    body = merge_inertias(given.mechanism.joints[2].bodies)
    moments = ca.Function("moments", [given.parameters.symbols], [body.mass * body.center_of_mass])
    first = moments(given.parameters.vector())
    own = merge_inertias(nominal.mechanism.joints[2].bodies)
    added = np.array(first).ravel() - np.array(ca.DM(own.mass * own.center_of_mass)).ravel()
    acting = np.array([far[name].value for name in ("mx", "my", "mz")])
    assert added == pytest.approx(TURNED[:3, :3] @ acting + 1.0 * TURNED[:3, 3])


@pytest.mark.parametrize(
    ("mass", "moments", "other"),
    [
        (0.2, (0.0, 0.03, -0.04), -0.05 / 0.5),
        (-0.2, (0.0, 0.03, -0.04), 0.05 / 0.5),
        (0.2, (3.0, 0.0, 0.0), -0.9 * 1.2),
        (0.2, (0.0, 0.0, 0.0), None),
        (0.0, (0.1, 0.0, 0.0), None),
    ],
    ids=["less", "more", "all that there is", "no moment", "no mass"],
)
def test_a_search_begins_with_the_other_sign_too(mass, moments, other) -> None:
    effect = make_effect("payload", "hand", arm())
    found = effect.alternative_start(dict(zip(effect.parameters.names, (mass, *moments), strict=True)))
    assert found == (None if other is None else {"payload@hand.mass": pytest.approx(other)})


def test_places_for_a_mass() -> None:
    one = baxter_foam_y_system(1)
    frames = one_frame_name_per_arm_link(one)
    assert len(frames) == 7
    assert frames[-1] == "left_gripper"
    ends = frame_names_at_arm_link_ends(one)
    # what the hand holds is where the branch ends, and the first link's frame turns about its own origin
    assert "left_gripper" not in ends
    assert "left_upper_shoulder" not in ends
    assert {"left_lower_shoulder", "left_wrist"} <= set(ends)
    assert set(ends) <= set(EFFECTS["point_mass"].candidate_locations(one))
    names = [f"panda_joint{i}" for i in range(1, 8)]
    bare = System.build(read_urdf("package:panda", joints=names, exclude_links=["panda_hand"]), prescribed=names)
    assert one_frame_name_per_arm_link(bare)[-1] == "panda_link8"
    # joints 1 and 2 meet where nothing moves, 5 and 6 in one place
    assert sorted(frame_names_at_arm_link_ends(bare)) == [f"panda_link{i}" for i in (3, 4, 5, 7, 8)]
    whole = read_urdf("package:panda")
    fingers = [j.name for j in whole.joints if j.kind == "prismatic"]
    held = System.build(whole, prescribed=whole.joint_names)
    assert fingers
    carriers = {held.mechanism.frame(name).joint_index for name in one_frame_name_per_arm_link(held)}
    assert held.mechanism.joint_index(fingers[0]) not in carriers


def test_ranges_of_strong_joints_follow_their_limits() -> None:
    system = arm()
    pairs = zip(system.mechanism.joints, (300.0, 20.0, 1e9), strict=True)
    joints = tuple(replace(joint, effort_limit=limit) for joint, limit in pairs)
    strong = replace(system, mechanism=replace(system.mechanism, joints=joints))
    assert [effort_limit_ratio_to_baxter(strong, name) for name in ("j0", "j1", "j2")] == [6.0, 1.0, 1.0]
    for kind in ("joint_coulomb", "joint_presliding"):
        assert make_effect(kind, "j0", strong).definitions[0].upper == pytest.approx(0.2 * 300.0)
        assert make_effect(kind, "j1", strong).definitions[0] == make_effect(kind, "j1", system).definitions[0]
    for kind in ("joint_viscous", "joint_stribeck", "joint_spring", "rotor_inertia", "effort_offset"):
        first, plain = (make_effect(kind, "j0", s).definitions[0] for s in (strong, system))
        assert first.upper == pytest.approx(6 * plain.upper)
        assert first.prior_range[1] == pytest.approx(6 * plain.prior_range[1])
    # what the first joint bears, the hand may hold
    assert make_effect("point_mass", "hand", strong).definitions[0].upper == pytest.approx(60.0)


def test_a_mass_on_the_object_may_weigh_as_much_as_the_object() -> None:
    system = baxter_foam_y_system(1)
    whole = 0.064 + 0.015 + 0.016
    mass = make_effect("point_mass", "w_T1", system).definitions[0]
    assert mass.prior_range[1] == pytest.approx(whole, rel=0.05)
    assert mass.upper >= whole
