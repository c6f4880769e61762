"""Unknown pushes on segments, and places that the data cannot tell apart."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from test_smoother import random_model

from yid_ocp.diagnosis.localise import localise_gap
from yid_ocp.diagnosis.thresholds import Thresholds
from yid_ocp.inference import smoother
from yid_ocp.inference.smoother import _instead, _run
from yid_ocp.inference.smoother_model import (
    _FORCE_POINT,
    UnknownGroup,
    _generalized_forces_per_newton,
    _segment_weights,
)
from yid_ocp.model.kinematics import forward_kinematics
from yid_ocp.virtual.experiment import baxter_foam_y_system

SYSTEM = baxter_foam_y_system(1)
THETA = np.array([parameter.value for parameter in SYSTEM.parameters])


def test_a_push_is_what_virtual_work_says():
    q = 0.3 * np.random.default_rng(3).standard_normal((2, SYSTEM.n_coordinates))
    found = _generalized_forces_per_newton(SYSTEM, THETA, q, ("T1", "T3"))
    assert found.shape == (2, SYSTEM.n_coordinates, 6)
    symbol = ca.SX.sym("q", SYSTEM.n_coordinates)
    at = ca.vertcat(
        *(forward_kinematics(SYSTEM.mechanism, symbol).frame_position(f"{s}:{_FORCE_POINT}") for s in ("T1", "T3"))
    )
    place = ca.Function("place", [symbol, SYSTEM.parameters.symbols], [at])
    for k, row in enumerate(q):
        for i in range(SYSTEM.n_coordinates):
            step = np.zeros(SYSTEM.n_coordinates)
            step[i] = 1e-6
            moved = (np.array(place(row + step, THETA)) - np.array(place(row - step, THETA))).ravel() / 2e-6
            assert found[k, i] == pytest.approx(moved, abs=1e-8)


def test_pushes_are_measured_by_the_weight_of_their_segment():
    found = _segment_weights(SYSTEM, THETA)
    assert found == pytest.approx({"T1": 9.81 * 0.064, "T2": 9.81 * 0.015, "T3": 9.81 * 0.016})


def test_what_cannot_be_pushed_is_not():
    assert _segment_weights(replace(SYSTEM, segment_layouts=()), THETA) == {}
    assert _generalized_forces_per_newton(SYSTEM, THETA, np.zeros((4, SYSTEM.n_coordinates)), ()).shape == (
        4,
        SYSTEM.n_coordinates,
        0,
    )


# -- places that do as well -------------------------------------------------------------------------------------------

HERE, LIKE, OTHER = UnknownGroup("here", "force"), UnknownGroup("there", "push"), UnknownGroup("elsewhere", "force")


@pytest.fixture
def twice():
    """A model in which two unknowns at two places do the same, a third something else, and the first one is at work."""
    model = random_model(2, unknowns=3, count=12, rows=8)
    rng = np.random.default_rng(0)
    intervals = []
    for one in model.intervals:
        by, drive = one.unknown_jacobian.copy(), one.unknown_input_matrix.copy()
        by[:, 1] = by[:, 0] + 0.02 * rng.standard_normal(len(by))
        drive[:, 1] = drive[:, 0]
        observed = 0.1 * one.negative_residual_jacobian
        observed[:, 0] += 8.0 * by[:, 0]
        intervals.append(
            type(one)(
                observed,
                one.state_jacobian,
                by,
                one.state_transition,
                drive,
                one.unreachable_products,
                one.sample_count,
            )
        )
    kept = {**vars(model), "intervals": tuple(intervals), "unknown_groups": (HERE, LIKE, OTHER)}
    return type(model)(**kept)


def test_a_place_that_does_as_well_is_told(twice):
    variance = {HERE: 50.0, LIKE: 0.0, OTHER: 0.0}
    state = _run([twice], variance)
    weight = smoother._weights([twice], variance, state)
    assert weight[HERE] > 100
    found = _instead([twice], variance, state.log_evidence, weight, Thresholds())
    assert found == {HERE: (LIKE,)}
    strict = Thresholds(location_tie=1.0, min_log_bayes_factor=1e-9)
    assert LIKE not in _instead([twice], variance, state.log_evidence + 1e3, weight, strict)[HERE]


def test_it_is_named_beside_the_place_but_its_own_other_unknowns_are_not():
    same = UnknownGroup("here", "push")
    seen = SimpleNamespace(
        log_evidence_drop={HERE: 9.0, LIKE: 0.0, same: 0.0},
        detectable_std=dict.fromkeys((HERE, LIKE, same), 0.5),
        group_variance={HERE: 1.0, LIKE: 0.0, same: 0.0},
        smoothed_unknowns=(),
        alternative_groups={HERE: (LIKE, same)},
    )
    first, *_ = localise_gap(seen)
    assert (first.location, first.indistinguishable_from) == ("here", ("there",))
