"""Patterns: what can differ from zero holds all that does, of matrices, of steps, and of the NLP as it is solved."""

import math
from dataclasses import replace
from itertools import pairwise

import casadi as ca
import numpy as np
import pytest
from made_recordings import holding_pendulum

from yid_ocp.analysis.step_diagnostics import (
    full_nlp_size,
    kkt_sparsity_pattern,
    linearise_step_equations,
    nlp_stage_sparsity,
    step_sparsity_patterns,
)
from yid_ocp.analysis.step_symbols import NamedStepEquations
from yid_ocp.data.recording import JointGroup, PointGroup, Recording
from yid_ocp.effects import make_effect
from yid_ocp.integrator.statics import EquilibriumSolver
from yid_ocp.integrator.step import compile_step
from yid_ocp.problem import EstimationProblem, ProblemOptions
from yid_ocp.solvers.symbolic_transcription import transcribe


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
    rows = linearise_step_equations(step, state, torque, theta, path)
    kept = np.setdiff1d(np.arange(rows.residual_by_new.shape[1]), step.system.prescribed_coordinate_indices)
    found = step_sparsity_patterns(symbols)
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
    for name, pattern in step_sparsity_patterns(symbols).items():
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
    assert step_sparsity_patterns(symbols)["dR_dy"].column_labels[: len(free)] == tuple(free)


def test_a_stiffness_enters_the_rows_of_its_joints_alone(step):
    found = step_sparsity_patterns(NamedStepEquations.from_equations(step.equations))["dR_dtheta"]
    column = found.column_labels.index("T1.twist")
    rows = {found.row_labels[i] for i in np.flatnonzero(found.nonzero_mask[:, column])}
    relaxing = {name for name in step.system.effect_internal_coordinate_symbols if name.endswith("_z")}
    assert rows - relaxing == {"T1_0_z", "T1_1_z", "T1_2_z"}


def made_problem(urdf_folder, feedback, start):
    """Four steps of the motors' small motion, a point between two nodes seen, parameters with a prior."""
    system = holding_pendulum(urdf_folder, links=2)
    t = 0.01 * np.arange(5)
    path = np.stack([0.02 * t, 0.03 * t], axis=1)
    effort = {"effort": np.zeros_like(path), "effort_kind": "command", "effort_std": 0.1}
    joints = JointGroup(("shoulder", "elbow"), t, path, position_std=1e-3, **effort)
    how = {"sensor": "camera", "pose": np.eye(4)}
    camera = PointGroup("points_camera", ["T1_0_tip"], t[:4] + 0.004, np.zeros((4, 1, 3)), 2e-3, **how)
    step = compile_step(system, 0.01, use_compiler=False)
    options = ProblemOptions(path_cutoff=math.inf, arm_tracking_feedback=feedback, initial_state=start)
    return EstimationProblem(step, [Recording(joints, (camera,), name="short")], ("T1.bend", "T1.length"), options)


@pytest.mark.parametrize(("feedback", "start"), [("lqr", "equilibrium"), ("none", "equilibrium"), ("lqr", "estimated")])
def test_the_nlp_has_the_pattern_that_is_shown(urdf_folder, feedback, start):
    problem = made_problem(urdf_folder, feedback, start)
    program = transcribe(problem)
    episode = problem.episodes[0]
    symbols = NamedStepEquations.from_equations(problem.step.equations)
    followed = () if episode.tracking_feedback is None else tuple(episode.tracking_feedback.state_indices)
    sensors = [samples.sensor for samples in episode.measurements]
    loose = problem.predictor.estimated_initial_state_indices
    stage = nlp_stage_sparsity(symbols, problem.shared_parameters, sensors, followed, loose)
    steps = episode.grid.steps
    kkt, size = kkt_sparsity_pattern(stage, steps), full_nlp_size(stage, [steps])
    width = size["variables"]
    jacobian, curved, measured = kkt.nonzero_mask[width:, :width], kkt.nonzero_mask[:width, :width], kkt.marked_mask
    # the program has the equilibrium at the start and the torques' errors besides
    shown = np.setdiff1d(np.arange(program.w.numel()), program.named_block("rest").index)[:width]
    rng = np.random.default_rng(0)
    w = program.initial_guess + 1e-3 * rng.normal(size=len(program.initial_guess))
    weights = rng.normal(size=program.g.numel())
    weights[: program.constraint_terms[0].n_values] = 0.0
    expressions = [program.jac_g, program.jac_r, ca.hessian(ca.dot(ca.DM(weights), program.g), program.w)[0]]
    values = ca.Function("values", [program.w, program.p], expressions)(w, program.parameter_values)
    found, slope, curvature = (np.array(value)[:, shown] for value in values)
    exact, begun = found[program.constraint_terms[0].n_values :], len(stage.fixed_start_rows)
    assert exact.shape == jacobian[begun:].shape
    assert not np.any((np.abs(exact) > 1e-12) & ~jacobian[begun:])
    # random states leave hardly anything at zero that can differ from it; the start is a rest at any parameter
    assert np.mean(exact[jacobian[begun:]] != 0) > 0.95
    gauss_newton = np.abs(slope.T @ slope) > 0
    curvature = curvature[shown]
    assert size["constraints"] == begun + len(exact) == len(jacobian)
    assert size["jacobian_nonzeros"] == np.count_nonzero(jacobian)
    unmeasured = np.count_nonzero(curved & ~measured[:width, :width])
    assert unmeasured <= size["hessian_nonzeros"] <= np.count_nonzero(curved)
    outside = (np.abs(curvature) > 1e-5 * np.abs(curvature).max()) & ~curved
    assert not np.any(outside)
    # a reading between two nodes couples them; each node's own block is the one shown
    f, nx, m, _ = stage.sizes
    for k in range(episode.grid.steps + 1):
        here = np.concatenate([np.arange(f), f + k * (nx + m) + np.arange(nx)])
        block = np.ix_(here, here)
        assert not np.any(gauss_newton[block] & ~measured[block]), k


def test_the_size_of_many_steps_is_that_of_the_matrices(urdf_folder):
    """Of two recordings that share their parameters, where nothing is measured and no prior counts."""
    problem = made_problem(urdf_folder, "lqr", "equilibrium")
    symbols = NamedStepEquations.from_equations(problem.step.equations)
    stage = nlp_stage_sparsity(symbols, ("T1.bend",), [], (0, 1), ())
    size, width, height, nonzeros = full_nlp_size(stage, [5, 7]), 0, 0, 0
    for steps in (5, 7):
        own = full_nlp_size(stage, [steps])
        jacobian = kkt_sparsity_pattern(stage, steps).nonzero_mask[own["variables"] :, : own["variables"]]
        width, height, nonzeros = width + jacobian.shape[1], height + len(jacobian), nonzeros + jacobian.sum()
    assert (size["variables"], size["constraints"], size["jacobian_nonzeros"]) == (width - 1, height, nonzeros)
    separate = sum(full_nlp_size(stage, [steps])["hessian_nonzeros"] for steps in (5, 7))
    assert separate - size["hessian_nonzeros"] == np.count_nonzero(stage.hessian_mask[:1, :1])


def test_the_kkt_matrix_is_symmetric_and_its_blocks_are_named(urdf_folder):
    problem = made_problem(urdf_folder, "lqr", "equilibrium")
    symbols = NamedStepEquations.from_equations(problem.step.equations)
    sensors = [samples.sensor for samples in problem.episodes[0].measurements]
    stage = nlp_stage_sparsity(symbols, problem.shared_parameters, sensors, (), ())
    kkt = kkt_sparsity_pattern(stage, 2)
    np.testing.assert_array_equal(kkt.nonzero_mask, kkt.nonzero_mask.T)
    assert [span.name for span in kkt.row_blocks] == [
        "theta", "q0", "p0", "lam0", "q1", "p1", "lam1", "q2", "p2",
        "start", "del0", "constraint0", "p1 rule", "del1", "constraint1", "p2 rule",
    ]  # fmt: skip
    assert kkt.row_blocks[-1].stop == len(kkt.nonzero_mask) == len(kkt.row_labels)
    assert kkt.row_labels[:2] == problem.shared_parameters
    at = {span.name: span for span in kkt.row_blocks}

    def block(row, column):
        return kkt.nonzero_mask[at[row].start : at[row].stop, at[column].start : at[column].stop]

    n = problem.step.sizes["n"]
    np.testing.assert_array_equal(block("del1", "p1"), np.eye(n, dtype=bool))
    np.testing.assert_array_equal(block("p2 rule", "p2"), np.eye(n, dtype=bool))
    assert not np.any(block("del0", "q2"))
    assert not np.any(block("start", "q1"))
    assert np.any(block("constraint0", "q1"))
    assert not np.any(block("constraint0", "q0"))
    # encoders read the motors, the camera's point hangs on the rod's first joints and does not feel the twist
    seen = kkt.marked_mask[at["q1"].start : at["q1"].stop, at["q1"].start : at["q1"].stop]
    joints = problem.system.mechanism.joint_names
    assert {joints[i] for i in np.flatnonzero(seen.any(axis=0))} == {"shoulder", "elbow", "T1_0_x", "T1_0_y"}
