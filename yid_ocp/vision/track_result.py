"""Results of tracking: reports on all frames, shapes and points of the good frames, and figures."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from yid_ocp.arrays import Array
from yid_ocp.data.recording import PointGroup, Recording, validated_recording
from yid_ocp.display import count_with_noun
from yid_ocp.files import atomic_write, make_folder
from yid_ocp.vision.calibration import CameraCalibration
from yid_ocp.vision.point_cloud import CloudSkeleton
from yid_ocp.vision.sequence_calibration import ForeignObject, TubeDimensionEstimates
from yid_ocp.vision.shape_evidence import FrameShapeFit

_CAMERA_POINT_GROUP = "points_camera"


@dataclass(frozen=True, eq=False)
class FrameReport:
    """The fitted shape of one frame, or the reason why the frame was dropped."""

    index: int  # index in the sequence
    name: str
    stamp: float  # stamp of the camera [s]
    joint_time: float  # time on the joints' clock [s]
    drop_reason: str  # why the frame was dropped; empty for a good frame
    n_raw_points: int  # number of points of the cloud
    n_filtered_points: int  # number of points that the filters keep
    n_skeleton_nodes: int
    stamp_delay: float  # delay of the stamp beyond the common offset, NaN if unknown [s]
    cpu_seconds: float  # processor time from the filtered cloud to the fitted points [s]
    shape_fit: FrameShapeFit | None
    alternative_fit: FrameShapeFit | None = None  # fit with another end as root, if it is equally good

    @property
    def is_good(self) -> bool:
        """Whether the frame was not dropped."""
        return not self.drop_reason


def count_dropped_frames_by_reason(frames: Iterable[FrameReport]) -> dict[str, int]:
    """Count the dropped frames by reason. The part of a reason after a colon, such as numbers, is ignored."""
    return dict(Counter(frame.drop_reason.partition(":")[0] for frame in frames if not frame.is_good).most_common())


@dataclass(eq=False)
class SingleFrameStages:
    """The processing stages of one frame so far. Stages that a dropped frame did not reach are None."""

    report: FrameReport
    camera_position: Array  # (3,) [m]
    raw_points: Array = field(default_factory=lambda: np.empty((0, 3)))  # (N, 3), in the world [m]
    filtered_points: Array | None = None  # (N, 3), points that the filters keep [m]
    skeleton: CloudSkeleton | None = None

    def update_report(self, **changes: Any) -> None:
        """Change entries of the report."""
        self.report = replace(self.report, **changes)


@dataclass(frozen=True, eq=False)
class TrackResult:
    """The result of tracking: shapes and points of the good frames, and reports on all frames."""

    point_names: tuple[str, ...]  # names of the tracked points
    t: Array  # (M,), times of the good frames on the joints' clock [s]
    configurations: Array  # (M, n), configurations with zero twists
    position: Array  # (M, np, 3), NaN (as in `std`) if a point was not seen well enough [m]
    std: Array  # (M, np, 3), standard deviation [m]
    shared_std: Array  # (M, np, 3), part of `std` from the camera's pose, depth and clock: an error of all frames [m]
    frame_reports: tuple[FrameReport, ...]  # reports on all frames, by time stamp
    camera_calibration: CameraCalibration
    dimensions: TubeDimensionEstimates  # the object's lengths and radii by the frames
    foreign_objects: tuple[ForeignObject, ...]  # objects near the modelled object
    root_note: str  # how the root end was chosen; empty if the model defines it
    _place: Callable[[Array], Array]  # from a configuration to the positions of the tracked points

    def point_positions_at_time(self, t: float) -> Array:
        """Return positions (np, 3) [m] of the tracked points at `t` [s]. Beyond the good frames they are constant.

        The configurations of the good frames are interpolated by a cubic spline.
        """
        if len(self.t) < 2:
            return self._place(self.configurations[0])
        return self._place(CubicSpline(self.t, self.configurations, axis=0)(np.clip(t, self.t[0], self.t[-1])))

    @property
    def frame_drop_reason_counts(self) -> dict[str, int]:
        """The number of frames that were dropped for each reason."""
        return count_dropped_frames_by_reason(self.frame_reports)

    def to_point_group(self) -> PointGroup:
        """Convert the points to the point group `points_camera` of a recording."""
        pose, words = self.camera_calibration.camera_state.pose, "depth camera, fitted shape"
        if np.nanmax(self.shared_std) > 0:
            words += f"; all frames share an error of {1e3 * np.nanmedian(self.shared_std):.1f} mm (a part of std)"
        return PointGroup(_CAMERA_POINT_GROUP, self.point_names, self.t, self.position, self.std, words, "world", pose)

    def recording_with_points(self, recording: Recording | None) -> Recording:
        """Return a copy of a recording (None: an empty one) with these points as `points_camera`."""
        recording = Recording(source="depth camera", name="camera") if recording is None else recording
        others = tuple(group for group in recording.points if group.name != _CAMERA_POINT_GROUP)
        count = f"Points are from {len(self.t)} of {len(self.frame_reports)} images"
        text = f"{recording.description} {count}. {self.camera_calibration.message}."
        made = replace(recording, points=(*others, self.to_point_group()), description=text.strip(), sha256=None)
        # the positions of a straight object belong to the group that a file lists first
        if not others or others[0] is not recording.points[0] or others[0].name > _CAMERA_POINT_GROUP:
            made = replace(made, marker_reference_pose=None)
        return validated_recording(made)


_MAX_DRAWN_POINTS = 12000  # points in one picture: more hide each other
_GREY, _BLUE, _ORANGE, _GREEN = "#9a9a9a", "#1f5fa8", "#e07a1f", "#2a8f4f"


class _Picture(NamedTuple):
    """A picture for a figure: points with colour and size, lines (2, 3) and their colour."""

    name: str
    title: str
    points: Sequence[tuple[Array, str, float]]
    lines: Sequence[Array] = ()
    line_colour: str = ""


def draw_frame_processing_stages(stages: SingleFrameStages, folder: str | os.PathLike[str]) -> list[Path]:
    """Draw a picture of every stage that a frame reached: cloud, filtered, skeleton, graph, fit. Returns their paths.

    The files are `NAME_1_cloud.png` to `NAME_5_fit.png` in `folder`, which is created. If the frame was dropped, the
    title of the last picture states the reason. Raises `OutputError` if writing fails.
    """
    path, report, parts = make_folder(folder), stages.report, [np.empty((0, 3))]
    parts += [] if stages.filtered_points is None else [stages.filtered_points]
    parts += [] if report.shape_fit is None else [report.shape_fit.link_ends.reshape(-1, 3)]
    near = np.concatenate(parts)
    stem = "".join(letter if letter.isalnum() else "_" for letter in Path(report.name).stem)
    written, pictures = [], _pictures(stages)
    for number, picture in enumerate(pictures, start=1):
        written.append(path / f"{stem}_{number}_{picture.name}.png")
        frame = stages.raw_points if picture.name == "cloud" or not len(near) else near
        ended = f"\nnot used, because {report.drop_reason}" if number == len(pictures) and report.drop_reason else ""
        _write(written[-1], f"{report.name}: {picture.title}{ended}", frame, stages.camera_position, picture)
    return written


def _pictures(stages: SingleFrameStages) -> list[_Picture]:
    raw, near, skeleton, fit = stages.raw_points, stages.filtered_points, stages.skeleton, stages.report.shape_fit
    made = [_Picture("cloud", f"{len(raw)} points of the camera", [(raw, _GREY, 0.4)])]
    if near is not None:
        made.append(_Picture("filtered", f"{len(near)} points of the object", [(near, _BLUE, 1.5)]))
    if near is not None and skeleton is not None:
        faint, nodes, edges = (near, _GREY, 0.4), (skeleton.nodes, _ORANGE, 14.0), skeleton.nodes[skeleton.edges]
        made.append(_Picture("skeleton", f"{len(skeleton.nodes)} points along the object (skeleton)", [faint, nodes]))
        parts = count_with_noun(len(skeleton.nodes) - len(edges), "connected part")  # the edges close no loop
        made.append(_Picture("graph", f"{count_with_noun(len(edges), 'edge')}, {parts}", [nodes], list(edges), _BLUE))
        if fit is not None:
            off = f", {1e3 * fit.mean_distance:.1f} mm from the points on average (image used)"
            title = "fitted shape" + ("" if stages.report.drop_reason else off)
            places = [faint, (fit.link_ends.reshape(-1, 3), _GREEN, 18.0), (fit.point_positions, _ORANGE, 40.0)]
            made.append(_Picture("fit", title, places, list(fit.link_ends), _GREEN))
    return made


def _write(path: Path, title: str, frame: Array, camera: Array, picture: _Picture) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 6.4), layout="constrained")
    axes: Any = figure.add_subplot(projection="3d")
    rng = np.random.default_rng(0)
    for points, colour, size in picture.points:
        shown = points if len(points) <= _MAX_DRAWN_POINTS else rng.choice(points, _MAX_DRAWN_POINTS, replace=False)
        axes.scatter(*shown.T, s=size, c=colour, linewidths=0, depthshade=False)
    for line in picture.lines:
        axes.plot(*line.T, color=picture.line_colour, linewidth=1.2 if picture.line_colour == _BLUE else 2.5)
    low, high = np.percentile(frame, 0.5, axis=0) - 0.02, np.percentile(frame, 99.5, axis=0) + 0.02
    middle, half = 0.5 * (low + high), 0.5 * float((high - low).max())
    limits = np.column_stack([middle - half, middle + half])
    axes.set(xlim=limits[0], ylim=limits[1], zlim=limits[2], xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
    axes.set_box_aspect((1, 1, 1))
    away = camera - middle
    # second view from the side, which shows depth
    axes.view_init(elev=18, azim=float(np.degrees(np.arctan2(away[1], away[0]))) + 35)
    axes.set_title(title, fontsize=10)
    with atomic_write(path) as temporary:
        figure.savefig(temporary, format="png", dpi=110)


def write_tracked_points_plot(track: TrackResult, file: str | os.PathLike[str]) -> None:
    """Plot the tracked points over time, with two standard deviations and a spline. Errors are as in `atomic_write`."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 2.2 * len(track.point_names) + 0.8), layout="constrained")
    axes = figure.subplots(len(track.point_names), 1, sharex=True, squeeze=False)[:, 0]
    fine = np.linspace(track.t[0], track.t[-1], 400)
    course = np.array([track.point_positions_at_time(t) for t in fine])
    lost = [frame.joint_time for frame in track.frame_reports if not frame.is_good and np.isfinite(frame.joint_time)]
    for row, (panel, name) in enumerate(zip(axes, track.point_names, strict=True)):
        for axis, colour in enumerate((_BLUE, _ORANGE, _GREEN)):
            place = track.position[:, row, axis]
            centre = np.nanmean(place) if np.isfinite(place).any() else 0.0
            panel.plot(fine, 1e3 * (course[:, row, axis] - centre), color=colour, linewidth=1)
            seen = 1e3 * (place - centre)
            panel.errorbar(track.t, seen, 2e3 * track.std[:, row, axis], fmt=".", color=colour, label="xyz"[axis])
        for t in lost:
            panel.axvline(t, color=_GREY, linewidth=0.6, linestyle=":")
        panel.set_ylabel(f"{name} [mm]")
    axes[0].legend(loc="upper right", ncols=3, frameon=False)
    said = "positions minus their mean, ± two standard deviations. Dotted lines: images that are not used"
    axes[0].set_title(f"{said}\n{track.camera_calibration.message}", fontsize=9)
    axes[-1].set_xlabel("t [s]")
    with atomic_write(Path(file)) as temporary:
        figure.savefig(temporary, format="png", dpi=110)
