"""Stick figures and what was measured beside them, sparsity patterns, and figures of a page."""

from __future__ import annotations

import json

import casadi as ca
import numpy as np
import plotly.graph_objects as go
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from yid_ocp.analysis.step_diagnostics import NamedIndexRange, SparsityPattern
from yid_ocp.data import JointGroup, PointGroup, Recording
from yid_ocp.effects import make_effect
from yid_ocp.model.flexible import FlexibleSegment, flexible_object
from yid_ocp.model.kinematics import forward_kinematics
from yid_ocp.model.system import System
from yid_ocp.report import animation, figures
from yid_ocp.report.animation import ConfigurationTrajectory, animation_of_trajectories, animations_to_dict
from yid_ocp.report.figures import TimeHeatMapRow, TimePlotData
from yid_ocp.report.png_figures import draw_sparsity_patterns
from yid_ocp.vision.surface_meshes import load_robot_meshes_by_joint


def point(system: System, name: str, q: np.ndarray) -> np.ndarray:
    symbols = ca.SX.sym("q", system.n_coordinates)
    place = forward_kinematics(system.mechanism, symbols).frame_position(name)
    found = ca.Function("place", [symbols, system.parameters.symbols], [place])
    return np.array(found(q, system.parameters.vector())).ravel()


def animated(system: System, q: np.ndarray):
    told = ConfigurationTrajectory("predicted", system, system.parameters.vector(), np.arange(len(q)), q)
    return animation_of_trajectories("a", [told]).motions[0]


def test_places_are_those_of_the_model_and_sticks_its_links(single_arm):
    postures = np.random.default_rng(0).uniform(-0.5, 0.5, size=(3, single_arm.n_coordinates))
    motion = animated(single_arm, postures)
    assert set(motion.point_indices) == set(single_arm.point_frames)
    for name, k in motion.point_indices.items():
        for q, now in zip(postures, motion.positions, strict=True):
            np.testing.assert_allclose(now[k], point(single_arm, name, q), atol=1e-12)
    is_object = np.array([stick.is_object_part for stick in motion.sticks])
    a, b = np.transpose([stick.end_indices for stick in motion.sticks])
    lengths = np.linalg.norm(motion.positions[:, a] - motion.positions[:, b], axis=2)
    links = sorted(4 * [0.813 / 4] + 4 * [0.610 / 4] + 4 * [0.737 / 4])
    np.testing.assert_allclose(sorted(lengths[0, is_object]), links, atol=1e-9)
    radii = {stick.radius for stick in motion.sticks if stick.is_object_part}
    assert sorted(radii) == pytest.approx([0.019, 0.025, 0.032])
    assert np.count_nonzero(~is_object) >= 6
    assert np.ptp(lengths, axis=0).max() < 1e-9  # rigid, whatever the posture


def test_what_an_effect_puts_under_the_object_is_no_arm():
    bare = System.build(objects=[(flexible_object([FlexibleSegment("rod", 0.4, 0.1, 0.01, links=2)]), None, None)])
    system = bare.with_effects([make_effect("mount_compliance", "base", bare, {"stiffness": 12.0})])
    assert any("@" in name for name in system.mechanism.joint_names)
    sticks = animated(system, np.zeros((1, system.n_coordinates))).sticks
    assert [stick.is_object_part for stick in sticks] == [True, True]


def test_a_scene_has_what_was_measured_beside_what_was_predicted(single_arm):
    n, t = single_arm.n_coordinates, np.linspace(0.0, 2.0, 401)
    q = 0.1 * np.sin(t)[:, None] * np.ones(n)
    at = [single_arm.mechanism.joint_index(name) for name in single_arm.driven]
    joints = JointGroup(tuple(single_arm.driven), t, q[:, at] + 0.01)
    seldom = np.array([0.5, 1.0, 1.5])
    seen = np.arange(9.0).reshape(3, 1, 3)
    seen[1] = np.nan
    recording = Recording(joints, (PointGroup("camera", ("w_T1",), seldom, seen),), name="a")
    told = ConfigurationTrajectory("predicted", single_arm, single_arm.parameters.vector(), t, q)
    made = animation_of_trajectories("a", [told], recording)
    assert [motion.name for motion in made.motions] == ["predicted", "measured"]
    assert len(made.t) == 150
    predicted, measured = made.motions
    # an object's shape is not measured
    assert {stick.is_object_part for stick in measured.sticks} == {False}
    k = measured.point_indices["w_T1"]
    shown = np.isfinite(measured.positions[:, k]).all(axis=1)
    # half a period about every frame in which it was seen
    near = np.minimum(np.abs(made.t - 0.5), np.abs(made.t - 1.5))
    sure = np.abs(near - 0.25) > 1e-3
    np.testing.assert_array_equal(shown[sure], near[sure] <= 0.25)
    # it is a measurement of one moment alone
    np.testing.assert_array_equal(measured.is_new_measurement[:, 0], near <= 0.5 * np.median(np.diff(made.t)))
    np.testing.assert_array_equal(measured.positions[np.argmin(abs(made.t - 0.5)), k], seen[0, 0])
    often = np.arange(0.003, 2.0, 0.01)
    moving = PointGroup("camera", ("w_T1",), often, often[:, None, None] * np.ones(3))
    between = animation_of_trajectories("a", [told], Recording(joints, (moving,), name="a")).motions[1].positions[1:, k]
    np.testing.assert_allclose(between[:-2], made.t[1:-2, None] * np.ones(3), atol=1e-9)
    arm, recorded = measured.sticks[0].end_indices[1], np.where(np.isin(np.arange(n), at), q[:1] + 0.01, q[:1])
    moved = animated(single_arm, recorded).positions
    np.testing.assert_allclose(measured.positions[0, arm], moved[0, arm], atol=1e-9)
    goal = animation_of_trajectories("a", [told], goal=np.ones(3)).motions[0]
    assert (goal.name, goal.positions.min(), goal.positions.max()) == ("goal", 1.0, 1.0)
    [page] = animations_to_dict([made])["scenes"]
    assert page["motions"][1]["places"][0][3 * k] is None
    first = np.array(page["motions"][0]["places"][0]).reshape(-1, 3) / page["scale"]
    np.testing.assert_allclose(first, predicted.positions[0], atol=0.51 / page["scale"])


def test_a_recording_alone_is_a_scene_where_it_has_places(single_arm):
    t = np.array([0.0, 0.1, 0.2])
    points = PointGroup("camera", ("w_T1",), t, np.ones((3, 1, 3)))
    theta = single_arm.parameters.vector()
    [alone] = animation.measured_motion_animation("a", single_arm, theta, Recording(None, (points,), name="a"))
    assert [motion.name for motion in alone.motions] == ["measured"]
    other = JointGroup(("elsewhere",), t, np.zeros((3, 1)))
    assert animation.measured_motion_animation("a", single_arm, theta, Recording(other, (), name="a")) == []


@pytest.fixture(scope="module")
def worn(single_arm):
    """A moving arm that wears the meshes of its robot, as a page has it, and its configurations."""
    t = np.linspace(0.0, 2.0, 401)
    q = 0.4 * np.sin(t)[:, None] * np.ones(single_arm.n_coordinates)
    told = ConfigurationTrajectory("predicted", single_arm, single_arm.parameters.vector(), t, q)
    return animations_to_dict([animation_of_trajectories(name, [told]) for name in "abcd"], "package:baxter")


def test_a_robot_wears_its_meshes_thinned(single_arm, worn):
    assert len(json.dumps(worn, separators=(",", ":"))) < 1_000_000
    assert set(worn["meshes"]) == {"", *single_arm.driven}
    assert 2000 < sum(len(faces) for _, faces in worn["meshes"].values()) / 3 < 10_001
    whole = load_robot_meshes_by_joint("package:baxter", single_arm.mechanism_with_values())
    scale = worn["scenes"][0]["scale"]
    for name in single_arm.driven:
        mesh = whole[single_arm.mechanism.joint_index(name)]
        flat, faces = (np.array(own).reshape(-1, 3) for own in worn["meshes"][name])
        # every corner is near the surface, and the thinned link is as long, wide and high
        away, _ = cKDTree(mesh.vertices).query(flat / scale)
        assert away.max() < 0.03
        np.testing.assert_allclose(np.ptp(flat / scale, axis=0), np.ptp(mesh.vertices, axis=0), atol=0.03)
        assert len({tuple(sorted(face)) for face in faces.tolist()}) == len(faces)
        assert all(len(set(face)) == 3 for face in faces.tolist())


def test_meshes_move_with_their_joints(single_arm, worn):
    [motion] = worn["scenes"][0]["motions"]
    names = [name for name in worn["meshes"] if name]
    symbols = ca.SX.sym("q", single_arm.n_coordinates)
    moved = forward_kinematics(single_arm.mechanism, symbols)
    index = single_arm.mechanism.joint_index("left_w1")
    function = ca.Function("pose", [symbols], [moved.joint_rotations[index], moved.joint_origins[index]])
    for k in (0, 77, 149):
        rotation, origin = (np.array(own) for own in function(0.4 * np.sin(worn["scenes"][0]["t"][k])))
        row = np.array(motion["poses"][k]).reshape(len(names), 7)[names.index("left_w1")]
        np.testing.assert_allclose(row[:3] / worn["scenes"][0]["scale"], origin.ravel(), atol=1e-4)
        np.testing.assert_allclose(Rotation.from_quat(row[3:] / 1e4).as_matrix(), rotation, atol=1e-3)


def test_a_robot_without_meshes_is_sticks(single_arm, urdf_folder):
    q = np.zeros((2, single_arm.n_coordinates))
    told = ConfigurationTrajectory("p", single_arm, single_arm.parameters.vector(), np.arange(2), q)
    for robot in (None, str(urdf_folder / "double_pendulum.urdf"), "nowhere.urdf"):
        page = animations_to_dict([animation_of_trajectories("a", [told])], robot)
        assert page["meshes"] == {}
        assert page["scenes"][0]["motions"][0]["sticks"]


def test_meshes_are_read_again_where_a_file_changed(single_arm, tmp_path, monkeypatch):
    reads, q = list[str](), np.zeros((2, single_arm.n_coordinates))
    told = ConfigurationTrajectory("p", single_arm, single_arm.parameters.vector(), np.arange(2), q)
    shape, robot = '<visual><geometry><mesh filename="{}"/></geometry></visual>', tmp_path / "robot.urdf"
    robot.write_text(f'<robot name="r"><link name="left_wrist">{shape.format("box.stl")}</link></robot>')
    monkeypatch.setenv("YID_OCP_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(
        animation, "load_robot_meshes_by_joint", lambda *a: reads.append("") or load_robot_meshes_by_joint(*a)
    )

    def width(edge: float | None = None) -> float:
        if edge is not None:
            import trimesh  # half a second

            trimesh.creation.box([edge, 0.1, 0.1]).export(tmp_path / "box.stl")
        [(flat, _)] = animations_to_dict([animation_of_trajectories("a", [told])], str(robot))["meshes"].values()
        return np.ptp(np.reshape(flat, (-1, 3)), axis=0).max() / 1e4

    assert [width(0.2), width(), width(0.3), width()] == pytest.approx([0.2, 0.2, 0.3, 0.3])
    assert len(reads) == 2
    # half a file in the cache is no reason to go without
    for file in (tmp_path / "cache").glob("meshes-*"):
        file.write_text(file.read_text()[:9])
    assert (width(0.3), len(reads)) == (pytest.approx(0.3), 3)
    # nor is a cache that cannot be made
    monkeypatch.setenv("YID_OCP_CACHE", str(robot / "cache"))
    assert width() == pytest.approx(0.3)
    robot.write_text("<robot><visual")
    assert animations_to_dict([animation_of_trajectories("a", [told])], str(robot))["meshes"] == {}


def test_what_acts_is_where_it_acts(single_arm):
    n, t = single_arm.n_coordinates, np.array([0.0, 1.0, 2.0])
    q = np.random.default_rng(0).uniform(-0.4, 0.4, size=(3, n))
    push = np.arange(9.0).reshape(3, 3)
    acting = [(f"on {place}", place, "N", push) for place in ("T1", "left_e0", "left", "camera_group")]
    told = ConfigurationTrajectory("p", single_arm, single_arm.parameters.vector(), t, q, acting)
    [motion] = animation_of_trajectories("a", [told]).motions
    at = {label: (k, values) for label, k, _, values in motion.acting}
    np.testing.assert_array_equal(at["on T1"][1], push)
    for label, frame in (("on T1", "T1:75%"), ("on left", single_arm.grasps[0].held_frame)):
        for now, posture in zip(motion.positions, q, strict=True):
            np.testing.assert_allclose(now[at[label][0]], point(single_arm, frame, posture), atol=1e-9)
    assert motion.acting[1][1] >= 0
    # what has no place is written beside the picture
    assert at["on camera_group"][0] == -1
    # a mark is no part of the object
    assert len(motion.sticks) == len(animated(single_arm, q).sticks)


@pytest.fixture
def drawn(monkeypatch):
    """Figures that were saved."""
    from matplotlib.figure import Figure  # half a second

    saved, save = [], Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda *given, **more: (saved.append(given[0]), save(*given, **more)))
    return saved


def pattern(height=6, width=8, **more):
    mask = np.random.default_rng(0).random((height, width)) < 0.4
    ends = {"del": (0, height - 2), "internal": (height - 2, height - 2), "constraint": (height - 2, height)}
    rows = tuple(NamedIndexRange(name, *own) for name, own in ends.items())
    columns = (NamedIndexRange("q1", 0, width - 3), NamedIndexRange("lam", width - 3, width))
    row_labels = (*(f"T{1 + i // 3}_{i % 3}_x" for i in range(height - 2)), "left.x", "left.y")
    column_labels = (*(f"T{1 + i // 3}_{i % 3}_x" for i in range(width - 3)), "left.x", "left.y", "left.z")
    return SparsityPattern("dR_dy", "a step", mask, rows, columns, row_labels, column_labels, **more)


def shown(axes):
    return np.array(axes.images[0].get_array())


def test_a_picture_shows_the_pattern_with_its_names(drawn, tmp_path):
    entry = pattern()
    marked = np.arange(6)[:, None] < 2
    other = pattern(marked_mask=np.broadcast_to(marked, entry.nonzero_mask.shape), mark_label="not zero at the rest")
    draw_sparsity_patterns(tmp_path / "p.png", [[entry, other]])
    assert (tmp_path / "p.png").read_bytes().startswith(b"\x89PNG")
    axes, beside = drawn[0].get_axes()
    np.testing.assert_array_equal(shown(axes) > 0, entry.nonzero_mask)
    assert [label.get_text() for label in axes.get_xticklabels()] == list(entry.column_labels)
    assert [label.get_text() for label in axes.get_yticklabels()] == list(entry.row_labels)
    np.testing.assert_array_equal(axes.get_yticks(), np.arange(6))
    # an empty block has no line of its own
    (along, _), (_, across) = (line.get_data() for line in axes.lines)
    assert (list(along), list(across)) == ([4.5, 4.5], [3.5, 3.5])
    top, right = axes.child_axes
    assert [label.get_text() for label in top.get_xticklabels()] == ["q1", "lam"]
    assert list(top.get_xticks()) == [2.0, 6.0]
    assert [label.get_text() for label in right.get_yticklabels()] == ["del", "constraint"]
    assert axes.get_title() == f"a step\n6 x 8, {entry.n_nonzeros} entries can differ from zero"
    np.testing.assert_array_equal(shown(beside) == 2, entry.nonzero_mask & marked)
    np.testing.assert_array_equal(shown(beside) > 0, entry.nonzero_mask)
    assert beside.get_title().endswith(f"dark: {np.count_nonzero(entry.nonzero_mask & marked)} not zero at the rest")


def test_many_rows_share_the_label_of_their_owner(drawn, tmp_path):
    height = 64 + 9
    draw_sparsity_patterns(tmp_path / "p.png", [[pattern(height)]])
    (axes,) = drawn[0].get_axes()
    owners = dict.fromkeys(f"T{1 + i // 3}" for i in range(height - 2))
    assert [label.get_text() for label in axes.get_yticklabels()] == [*owners, "left"]
    # three rows of T1, then of T2, ...: in the middle of each
    assert list(axes.get_yticks())[:2] == [1.0, 4.0]
    assert axes.get_yticks()[-1] == height - 1.5


def test_patterns_stand_beside_each_other_and_empty_ones_are_left_out(drawn, tmp_path):
    empty = pattern()
    empty = SparsityPattern("B_u", "no torque", np.zeros((6, 0), bool), empty.row_blocks, (), empty.row_labels, ())
    draw_sparsity_patterns(tmp_path / "p.png", [[pattern(), pattern(6, 12)], [empty], [pattern(9, 5), empty]])
    assert [shown(axes).shape for axes in drawn[0].get_axes()] == [(6, 8), (6, 12), (9, 5)]


def test_values_of_very_different_sizes_get_a_logarithmic_axis():
    def drawn(**rows):
        return go.Figure(figures.parameter_values_by_source_figure(rows, "x [m]", {"2": "#000000"}))

    close = drawn(a={"1": (2.0, None), "2": (1.0, None)}, b={"1": (3.0, None), "3": (1.0, None)})
    far = drawn(a={"1": (20.0, None), "2": (0.1, None)})
    assert (close.layout.xaxis.type, far.layout.xaxis.type, far.layout.showlegend) == (None, "log", True)
    assert [trace.name for trace in close.data] == ["2", "1", "3"]
    assert close.data[0].marker.color == "#000000" != close.data[1].marker.color
    # bars of what cannot be told do not widen the axis
    figure = drawn(a={"1": (2.0, float("inf")), "2": (1.0, 1e7)})
    assert figure.layout.xaxis.range[1] < 3.0
    assert figure.data[1].error_x.array is None
    assert figure.data[0].error_x.array == (2e7,)


def test_a_map_keeps_its_groups_together_and_its_gaps_empty():
    values = np.array([1.0, np.nan, -4000.0])
    rows = [TimeHeatMapRow(name, group, values, ["", "", ""]) for name, group in (("x", "a"), ("y", "a"), ("z", "b"))]
    figure = go.Figure(raw := figures.time_heat_map_figure(np.array([0.0, 0.1, 0.2, 0.3]), rows, "deviations"))
    [heat] = figure.data
    assert raw["data"][0]["colorscale"][2] == (0.5, "#ffffff"), "the script needs pairs"
    assert (heat.z[0][1], len(heat.x), "1000" in heat.colorbar.ticktext) == (None, 4, True)
    assert heat.zmax == -heat.zmin > 0
    assert [a.text for a in figure.layout.annotations] == ["color: deviations", "a", "b"]
    assert len(figure.layout.shapes) == 1


def test_a_ranking_says_what_lies_beyond_its_axis():
    untried = {"untried": (None, 0.5)}
    entries = {"good": ((90.0, 80.0, 95.0), 88.0), "bad": ((-900.0, -2000.0, -100.0), 1.0)} | untried
    figure = go.Figure(figures.gap_closure_and_screening_figure(entries, "closed [%]", "promised [%]"))
    assert [a.text for a in figure.layout.annotations] == ["◀ -900"]
    assert figure.layout.yaxis.categoryarray == ("untried", "bad", "good")
    alone = go.Figure(figures.gap_closure_and_screening_figure(untried, "closed", "promised"))
    assert [trace.type for trace in alone.data] == ["bar"]


def test_bands_and_spans_are_shaded():
    t = np.linspace(0, 3, 31)
    plots = [TimePlotData("a", {"line": (t, t)}, t, t, 0.2, [(1.0, 2.0)])]
    band, span = go.Figure(figures.time_plots_figure(plots, "#000000", {"line": "blue"})).layout.shapes
    assert (band.y0, band.y1, span.x0, span.x1) == (-0.2, 0.2, 1.0, 2.0)


def test_long_curves_are_thinned_and_gaps_stay():
    t = np.linspace(0.0, 10.0, 50_000)
    measured = np.sin(t)
    measured[:10_000] = np.nan
    predicted, plot_data = {"predicted": np.sin(t)}, figures.channel_prediction_and_residual_plot_data
    figure = go.Figure(figures.time_plots_figure(plot_data("x", "m", t, measured, 0 * t + 1e-3, predicted)))
    assert max(len(trace.x) for trace in figure.data) <= 1200
    assert np.isnan(figure.data[0].y[0])


def test_cost_history_has_a_curve_for_each_horizon():
    figure = go.Figure(figures.solution_cost_history_figure([5.0, 3.0, 9.0, 2.0], ["first 1 s"] * 2 + ["", ""]))
    assert [trace.name for trace in figure.data] == ["first 1 s", "whole recordings"]
    assert [list(trace.x) for trace in figure.data] == [[0, 1], [2, 3]]
