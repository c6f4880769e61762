"""Patterns: what can differ from zero holds all that does, of matrices and of steps."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from made_recordings import holding_pendulum

from yid_ocp.analysis.step_diagnostics import step_equation_jacobians_at_state, step_jacobian_sparsity_patterns
from yid_ocp.analysis.step_symbols import NamedStepEquations
from yid_ocp.effects import make_effect
from yid_ocp.integrator.statics import EquilibriumSolver
from yid_ocp.integrator.step import compile_step


@pytest.fixture(scope="module", params=["driven", "prescribed", "relaxing"])
def step(request, urdf_folder):
    """Two motors that take the end of a rod, driven, moved as measured, or with inner coordinates."""
    system = holding_pendulum(urdf_folder)
    if request.param == "prescribed":
        system = replace(system, driven=("elbow",), prescribed=("shoulder",))
    if request.param == "relaxing":
        system = system.with_effects([make_effect("standard_linear_solid", "T1", system, {"ratio": 0.4})])
    return compile_step(system, 0.01, use_compiler=False)


def test_patterns_of_a_step_hold_its_matrices(step):
    """At a state like any other, where nothing vanishes by chance."""
    sizes, n = step.sizes, step.sizes["n"]
    rng = np.random.default_rng(5)
    symbols = NamedStepEquations.from_equations(step.equations)
    theta = step.system.parameters.vector()
    rest = EquilibriumSolver(step).solve(np.array([0.3, -0.6]), theta, None)
    assert rest.is_converged
    state = rest.state + 1e-3 * rng.normal(size=sizes["nx"])
    path = state[list(step.system.prescribed_coordinate_indices)]
    torque = rest.holding_torque + rng.normal(size=sizes["nu"])
    pair = (path, path) if len(path) else None
    a, b_input, b_theta = step.jacobians(state[:n], state[n : 2 * n], torque, theta, pair, state[2 * n :])
    rows = step_equation_jacobians_at_state(step, state, torque, theta, path)
    kept = np.setdiff1d(np.arange(rows.residual_by_new.shape[1]), step.system.prescribed_coordinate_indices)
    found = step_jacobian_sparsity_patterns(symbols)
    for name, matrix in (
        ("A", a),
        ("B_u", b_input),
        ("B_theta", b_theta),
        ("dR_dtheta", np.vstack([rows.residual_by_theta[0], rows.p1_by_theta[0]])),
        ("dR_dy", rows.residual_by_new[0][np.ix_(kept, kept)]),
    ):
        pattern = found[name]
        assert np.all(np.isfinite(matrix))
        assert pattern.nonzero_mask.shape == matrix.shape, name
        outside = (np.abs(matrix) > 1e-13 * np.abs(matrix).max(initial=0.0)) & ~pattern.nonzero_mask
        assert not np.any(outside), [(pattern.row_labels[i], pattern.column_labels[j]) for i, j in np.argwhere(outside)]
        marked = pattern.with_numerical_nonzeros_marked(matrix, "here")
        assert np.count_nonzero(marked.marked_mask & pattern.nonzero_mask) > 0.5 * pattern.n_nonzeros
        assert marked.mark_label == "not zero at here"
    assert not np.any(found["A"].nonzero_mask[list(step.system.prescribed_coordinate_indices)])


def test_blocks_cover_rows_and_columns(step):
    symbols = NamedStepEquations.from_equations(step.equations)
    names = {"dR_dy": ("del", "q1"), "A": ("q1", "q0"), "B_u": ("q1", "u"), "B_theta": ("q1", "theta")}
    for name, pattern in step_jacobian_sparsity_patterns(symbols).items():
        for spans, labels, count in (
            (pattern.row_blocks, pattern.row_labels, pattern.nonzero_mask.shape[0]),
            (pattern.column_blocks, pattern.column_labels, pattern.nonzero_mask.shape[1]),
        ):
            assert spans[0].start == 0
            assert spans[-1].stop == count == len(labels)
            assert all(a.stop == b.start for a, b in pairwise(spans))
        if name in names:
            assert (pattern.row_blocks[0].name, pattern.column_blocks[0].name) == names[name]
    free = [name for name in step.system.mechanism.joint_names if name not in step.system.prescribed]
    assert step_jacobian_sparsity_patterns(symbols)["dR_dy"].column_labels[: len(free)] == tuple(free)


def test_a_stiffness_enters_the_rows_of_its_joints_alone(step):
    found = step_jacobian_sparsity_patterns(NamedStepEquations.from_equations(step.equations))["dR_dtheta"]
    column = found.column_labels.index("T1.twist")
    rows = {found.row_labels[i] for i in np.flatnonzero(found.nonzero_mask[:, column])}
    relaxing = {name for name in step.system.effect_internal_coordinate_symbols if name.endswith("_z")}
    assert rows - relaxing == {"T1_0_z", "T1_1_z", "T1_2_z"}
