"""Effects that are in no library: every force against the potential, or the rule, that it is said to follow."""

from __future__ import annotations

import math

import numpy as np
import pytest
from virtual_examples import SYSTEMS, TRUTH, mujoco, single_arm_xml

from yid_ocp.virtual.injected import (
    _CORD_LENGTH,
    _CREASE_ANGLE,
    _DRIFT_TIME,
    _MAGNET_DISTANCE,
    _MAGNET_POLE_SIZE,
    _SLIP_TIMES,
    _WALL_DISTANCE,
    _WARM_UP_TIME,
    InjectedEffect,
    _InjectedTerms,
)

SYSTEM = SYSTEMS[1]


class Bench:
    """MuJoCo's model with one effect, whose force is asked for at states of one's choice."""

    def __init__(self, kind, location, size, running=True):
        self.model = mujoco.MjModel.from_xml_string(single_arm_xml())
        self.data = mujoco.MjData(self.model)
        self.terms = _InjectedTerms(SYSTEM, TRUTH, [InjectedEffect(kind, location, {"size": size})])
        self.terms.edit_model(self.model)
        if running:
            self.terms.start_motion(self.data)
        self.force(np.zeros(self.model.nv))  # what is anchored somewhere is anchored by this state
        self.began = {joint: self.place(joint) for joint in ("left_w0", joints_of("T3", 2)[-1])}

    def at(self, q, v=None, time=0.0):
        self.data.qpos[:], self.data.time = q, time
        self.data.qvel[:] = 0.0 if v is None else v
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)

    def force(self, q, v=None, time=0.0):
        self.at(q, v, time)
        self.data.qfrc_passive[:] = 0.0
        self.terms.add_forces(self.model, self.data)
        return np.array(self.data.qfrc_passive)

    def place(self, joint):
        return np.array(self.data.xipos[self.model.jnt_bodyid[self.model.joint(joint).id]])

    def address(self, *joints):
        return np.array([self.model.joint(joint).id for joint in joints])


def joints_of(segment, *axes):
    return [link[axis] for link in SYSTEM.segment_layout(segment).link_joints for axis in axes]


def slope(bench, potential, q, step=1e-6):
    """- dV/dq by differences."""
    found = np.zeros(len(q))
    for i in range(len(q)):
        ends = []
        for sign in (1, -1):
            moved = q.copy()
            moved[i] += sign * step
            bench.at(moved)
            ends.append(potential(bench))
        found[i] = -(ends[0] - ends[1]) / (2 * step)
    return found


TIP = joints_of("T3", 2)[-1]


def moved(bench, joint):
    """How far the link that a joint carries is from where it began."""
    return bench.place(joint) - bench.began[joint]


def cord(joint, hung):
    anchor = np.array([0.0, 0.0, hung])
    return lambda bench: 0.5 * 20.0 * max(np.linalg.norm(moved(bench, joint) - anchor) - _CORD_LENGTH, 0.0) ** 2


def pole(bench):
    away = np.array([_MAGNET_DISTANCE, 0.0, 0.0]) - moved(bench, TIP)
    return 0.5 * 0.3 * _MAGNET_POLE_SIZE * math.log(away @ away + _MAGNET_POLE_SIZE**2)


def soft_wall(bench):
    return 0.5 * 30.0 * max(moved(bench, TIP)[1] - _WALL_DISTANCE, 0.0) ** 2


def creased(bench):
    bent = bench.data.qpos[bench.address(*SYSTEM.segment_layout("T1").link_joints[1][:2])]
    return -0.5 * 12.0 * max(np.linalg.norm(bent) - _CREASE_ANGLE, 0.0) ** 2


def crossed(bench):
    x, y = (bench.data.qpos[bench.address(*joints_of("T1", axis))] for axis in (0, 1))
    return 8.0 * float(x @ y)


def lopsided(bench):
    return 5.0 / 3 * float(np.sum(bench.data.qpos[bench.address(*joints_of("T2", 0, 1))] ** 3))


@pytest.mark.parametrize(
    ("kind", "place", "size", "potential"),
    [
        ("tether", "T3", 20.0, cord(TIP, -_CORD_LENGTH)),
        ("tether", "left_w0", 20.0, cord("left_w0", _CORD_LENGTH)),
        ("magnet", "T3", 0.3, pole),
        ("wall", "T3", 30.0, soft_wall),
        ("crease", "T1", 12.0, creased),
        ("cross_stiffness", "T1", 8.0, crossed),
        ("quadratic_stiffness", "T2", 5.0, lopsided),
    ],
)
def test_what_has_a_potential_is_its_slope(kind, place, size, potential):
    bench = Bench(kind, place, size)
    rng = np.random.default_rng(5)
    felt = 0
    for _ in range(4):
        q = rng.uniform(-0.3, 0.3, bench.model.nv)
        found = bench.force(q)
        felt += np.abs(found).max() > 1e-3
        assert found == pytest.approx(slope(bench, potential, q), abs=2e-6)
    assert felt, "some of these states are beyond the cord, the wall or the crease"


def test_a_drifting_stiffness_softens_with_time():
    q = np.random.default_rng(6).uniform(-0.3, 0.3, Bench("gusts", "T1", 0.1).model.nv)
    bench = Bench("stiffness_drift", "T1", 0.4)
    at = bench.address(*joints_of("T1", 0, 1, 2))
    stiffness = np.array([22.0, 22.0, 13.6] * 4)
    half = bench.force(q, time=_DRIFT_TIME / 2)
    assert half[at] == pytest.approx(0.2 * stiffness * q[at])
    assert np.count_nonzero(half) == len(at)
    assert not bench.force(q, time=0.0).any()
    assert not Bench("stiffness_drift", "T1", 0.4, running=False).force(q, time=2.0).any()


def test_one_way_damping_brakes_one_way_only():
    bench = Bench("one_way_damping", "T1", 0.6)
    at = bench.address(*joints_of("T1", 0, 1))
    v = np.random.default_rng(7).uniform(-1, 1, bench.model.nv)
    found = bench.force(np.zeros(bench.model.nv), v)
    assert found[at] == pytest.approx(-0.6 * np.maximum(v[at], 0.0))
    assert np.setdiff1d(np.flatnonzero(found), at).size == 0


def test_a_cold_gear_brakes_until_it_is_warm():
    bench = Bench("warming_gear", "left_s1", 3.0)
    v = np.ones(bench.model.nv)
    [at] = bench.address("left_s1")
    forces = [bench.force(np.zeros(bench.model.nv), v, time)[at] for time in (0.0, _WARM_UP_TIME, 10 * _WARM_UP_TIME)]
    assert forces == pytest.approx([-3.0, -3.0 / math.e, 0.0], abs=2e-4)


@pytest.mark.parametrize(("torque", "given"), [(2.0, 2.0), (5.0, 3.5), (-9.0, -3.5)])
def test_a_saturating_drive_gives_no_more_than_it_can(torque, given):
    bench = Bench("saturating_drive", "left_e1", 3.5)
    [at] = bench.address("left_e1")
    bench.data.qfrc_applied[at] = torque
    assert bench.force(np.zeros(bench.model.nv))[at] + torque == pytest.approx(given)


def test_a_loose_load_follows_the_joint_late():
    bench = Bench("shifting_load", "left_w1", 0.8)
    [at] = bench.address("left_w1")
    q = np.zeros(bench.model.nv)
    q[at] = 0.5
    found = [bench.force(q, time=time)[at] for time in np.arange(0.0, 2.0, 0.01)]
    assert found[0] == 0.0
    assert np.all(np.diff(found) >= -1e-12)
    assert found[20] == pytest.approx(0.8 * (1 - math.exp(-1)), rel=0.05)
    assert found[-1] == pytest.approx(0.8, rel=1e-3)


def test_a_slipping_grasp_has_moved_along_the_tube_after_every_slip():
    bench = Bench("slipping_grasp", "left", 0.008)
    site = bench.model.site("grasp_left_held").id
    begin = bench.model.site_pos[site].copy()
    moved = []
    for time in (_SLIP_TIMES[0] - 0.01, 0.5 * sum(_SLIP_TIMES), _SLIP_TIMES[1] + 1.0):
        bench.force(np.zeros(bench.model.nv), time=time)
        moved.append(bench.model.site_pos[site] - begin)
    assert np.array(moved) == pytest.approx(np.array([[0, 0, 0], [0, 0, -0.008], [0, 0, -0.016]]), abs=1e-12)


def test_torque_ripples_with_the_angle_and_wind_waits_for_the_motion():
    bench = Bench("torque_ripple", "left_e1", 1.0)
    q = np.full(bench.model.nv, 0.3)
    assert bench.force(q)[bench.address("left_e1")] == pytest.approx(math.sin(18.0))
    assert not Bench("gusts", "T3", 0.1, running=False).force(q, time=1.0).any()
    assert Bench("gusts", "T3", 0.1).force(q, time=1.0).any()
