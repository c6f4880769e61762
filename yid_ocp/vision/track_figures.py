"""Figures of a frame's processing stages and of a whole track."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from yid_ocp.errors import OutputError
from yid_ocp.files import atomic_write
from yid_ocp.vision.track_result import FrameStages, TrackResult

Array = NDArray[np.float64]

_MOST = 12000  # points in one picture: more hide each other
_GREY, _BLUE, _ORANGE, _GREEN = "#9a9a9a", "#1f5fa8", "#e07a1f", "#2a8f4f"
_STAGE_NAMES = ("cloud", "filtered", "skeleton", "graph", "fit")
"""The pictures of one frame, in order."""


def draw_frame_stages(stages: FrameStages, folder: str | os.PathLike[str]) -> list[Path]:
    """Write one picture for every stage that a frame came to: cloud, filtered, skeleton, graph, fit.

    Parameters
    ----------
    stages : Stages
    folder : path-like
        Made where it does not exist.

    Returns
    -------
    list of Path
        `NAME_1_cloud.png` to `NAME_5_fit.png`; the title of the last one says why the frame was dropped.

    Raises
    ------
    OutputError
        The folder or a file cannot be written.
    """
    path = Path(folder)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"the folder cannot be made: {error.strerror}", where=str(path)) from error
    parts = [] if stages.filtered_points is None else [stages.filtered_points]
    parts += [] if stages.shape_fit is None else [stages.shape_fit.link_ends.reshape(-1, 3)]
    near = np.concatenate([np.empty((0, 3)), *parts])
    stem = "".join(letter if letter.isalnum() else "_" for letter in Path(stages.frame_name).stem)
    written = []
    drawings = _drawings(stages)
    for number, (name, (title, draw)) in enumerate(zip(_STAGE_NAMES, drawings, strict=False), start=1):
        target = path / f"{stem}_{number}_{name}.png"
        frame = stages.raw_points if name == "cloud" or not len(near) else near
        ended = f"\n{stages.drop_reason}" if number == len(drawings) and stages.drop_reason else ""
        _write(target, f"{stages.frame_name}: {title}{ended}", frame, stages.camera_position, draw)
        written.append(target)
    return written


def _drawings(stages: FrameStages) -> list[tuple[str, Callable[[Any], None]]]:
    """Title and drawing of every stage that the frame came to, in the order of `_STAGE_NAMES`."""
    rng = np.random.default_rng(0)
    near, skeleton, fit = stages.filtered_points, stages.skeleton, stages.shape_fit

    def cloud(axes: Any) -> None:
        _scatter(axes, _some(stages.raw_points, rng), _GREY, 0.4)

    made: list[tuple[str, Callable[[Any], None]]] = [(f"{len(stages.raw_points)} points of the camera", cloud)]
    if near is None:
        return made

    def filtered(axes: Any) -> None:
        _scatter(axes, _some(near, rng), _BLUE, 1.5)

    made.append((f"{len(near)} points of the object", filtered))
    if skeleton is None:
        return made

    def nodes(axes: Any) -> None:
        _scatter(axes, _some(near, rng), _GREY, 0.4)
        _scatter(axes, skeleton.nodes, _ORANGE, 14)

    def graph(axes: Any) -> None:
        _scatter(axes, skeleton.nodes, _ORANGE, 14)
        for a, b in skeleton.edges:
            axes.plot(*skeleton.nodes[[a, b]].T, color=_BLUE, linewidth=1.2)

    made.append((f"{len(skeleton.nodes)} nodes of the walk", nodes))
    made.append(
        (f"{len(skeleton.edges)} edges, {len(set(skeleton.component_of_node.tolist()))} connected parts", graph)
    )
    if fit is None:
        return made

    def shape(axes: Any) -> None:
        _scatter(axes, _some(near, rng), _GREY, 0.4)
        for link in fit.link_ends:
            axes.plot(*link.T, color=_GREEN, linewidth=2.5)
        _scatter(axes, fit.link_ends.reshape(-1, 3), _GREEN, 18)
        _scatter(axes, fit.point_positions, _ORANGE, 40)

    return [*made, (f"fitted shape, {1e3 * fit.mean_distance:.1f} mm off on average", shape)]


def draw_track(track: TrackResult, file: str | os.PathLike[str]) -> None:
    """Write a picture of the points over time: the good frames with two standard deviations, and the spline between.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    figure = Figure(figsize=(9, 2.2 * len(track.point_names) + 0.8), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(track.point_names), 1, sharex=True, squeeze=False)[:, 0]
    fine = np.linspace(track.t[0], track.t[-1], 400)
    course = np.array([track.points_at(t) for t in fine])
    lost = [frame.joint_time for frame in track.frame_reports if not frame.is_good and np.isfinite(frame.joint_time)]
    for row, (panel, name) in enumerate(zip(axes, track.point_names, strict=True)):
        for axis, colour in enumerate((_BLUE, _ORANGE, _GREEN)):
            centre = (
                np.nanmean(track.position[:, row, axis]) if np.isfinite(track.position[:, row, axis]).any() else 0.0
            )
            panel.plot(fine, 1e3 * (course[:, row, axis] - centre), color=colour, linewidth=1)
            seen = 1e3 * (track.position[:, row, axis] - centre)
            panel.errorbar(track.t, seen, 2e3 * track.std[:, row, axis], fmt=".", color=colour, label="xyz"[axis])
        for t in lost:
            panel.axvline(t, color=_GREY, linewidth=0.6, linestyle=":")
        panel.set_ylabel(f"{name} [mm]")
    axes[0].legend(loc="upper right", ncols=3, frameon=False)
    axes[0].set_title(
        f"about the mean, two standard deviations; dotted: dropped frames\n{track.camera_calibration.message}",
        fontsize=9,
    )
    axes[-1].set_xlabel("t [s]")
    with atomic_write(Path(file)) as temporary:
        figure.savefig(temporary, format="png", dpi=110)


def _some(points: Array, rng: np.random.Generator) -> Array:
    return points if len(points) <= _MOST else points[rng.choice(len(points), _MOST, replace=False)]


def _scatter(axes: Any, points: Array, colour: str, size: float) -> None:
    axes.scatter(*points.T, s=size, c=colour, linewidths=0, depthshade=False)


def _write(path: Path, title: str, frame: Array, camera: Array, draw: Callable[[Any], None]) -> None:
    figure = Figure(figsize=(6.4, 6.4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot(projection="3d")
    draw(axes)
    low, high = np.percentile(frame, 0.5, axis=0) - 0.02, np.percentile(frame, 99.5, axis=0) + 0.02
    middle, half = 0.5 * (low + high), 0.5 * float((high - low).max())
    axes.set_xlim(middle[0] - half, middle[0] + half)
    axes.set_ylim(middle[1] - half, middle[1] + half)
    axes.set_zlim(middle[2] - half, middle[2] + half)
    axes.set_box_aspect((1, 1, 1))
    away = camera - middle
    # beside the camera's own view, where depth shows
    axes.view_init(elev=18, azim=float(np.degrees(np.arctan2(away[1], away[0]))) + 35)
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    axes.set_zlabel("z [m]")
    axes.set_title(title, fontsize=10)
    with atomic_write(path) as temporary:
        figure.savefig(temporary, format="png", dpi=110)
