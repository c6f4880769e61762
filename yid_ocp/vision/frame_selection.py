"""Selection of good frames, choice of the object's root end in all frames, and uncertainty of the points."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge
from scipy.interpolate import CubicSpline
from scipy.sparse.csgraph import shortest_path

from yid_ocp.arrays import Array
from yid_ocp.display import grouped
from yid_ocp.errors import DataError
from yid_ocp.options import OptionInfo, PositiveFloat, check_option_bounds
from yid_ocp.vision.calibration import ArmBasedCameraCalibrationOptions, CameraClockOptions
from yid_ocp.vision.fit import SURFACE_NOISE_STD, ShapeFitter
from yid_ocp.vision.point_cloud import CloudFilterOptions, XyzTuple
from yid_ocp.vision.sequence_calibration import (
    ForeignObject,
    SequenceEstimates,
    TubeDimensionEstimates,
    TubeDimensionKind,
)
from yid_ocp.vision.shape_evidence import FrameShapeFit
from yid_ocp.vision.track_result import FrameReport


@dataclass(frozen=True)
class TrackOptions:
    """The settings of the tracking: how measured points are computed from frames, and which frames are used."""

    filters: Annotated[CloudFilterOptions, OptionInfo("selection of the object's points")] = field(
        default_factory=CloudFilterOptions
    )
    clock_offset_search: Annotated[
        CameraClockOptions, OptionInfo("estimation of the camera clock's offset from the joints' clock")
    ] = field(default_factory=CameraClockOptions)
    calibration: Annotated[
        ArmBasedCameraCalibrationOptions,
        OptionInfo("estimation of pose, depth and clock of the camera from the visible arm"),
    ] = field(default_factory=ArmBasedCameraCalibrationOptions)
    background_estimation: Annotated[
        Literal["none", "frames"],
        OptionInfo(
            "frames: points static in most frames, away from every fitted shape, are removed, in addition to those "
            "of track.background_frames_path"
        ),
    ] = "none"
    estimated_dimensions: Annotated[
        tuple[TubeDimensionKind, ...],
        OptionInfo("sizes of the tubes estimated from the clouds if these determine them; all sizes are checked"),
    ] = ()
    max_mean_surface_distance_in_radii: Annotated[
        PositiveFloat,
        OptionInfo("mean distance of points from the shape, beyond noise, that drops a frame; in tube radii"),
    ] = 0.5
    max_seen_point_std: Annotated[
        PositiveFloat, OptionInfo("a point with a larger standard deviation in a frame counts as not seen", "m")
    ] = 0.02
    surface_noise_std: Annotated[
        PositiveFloat, OptionInfo("standard deviation of one averaged point's distance from the surface", "m")
    ] = SURFACE_NOISE_STD
    frame_stamp_std: Annotated[
        float, Ge(0), OptionInfo("standard deviation of a frame's time stamp, beyond the common offset", "s")
    ] = 0.003
    exposure_time: Annotated[float, Ge(0), OptionInfo("exposure time of a frame, centred on its stamp", "s")] = 0.0
    tracked_points: Annotated[
        tuple[str, ...] | None,
        OptionInfo("points to record; default: those that no arm holds, because arms measure held points better"),
    ] = None
    root_placement: Annotated[
        Literal["model", "fixed", "free"],
        OptionInfo(
            "position of the object's root: model: from the model; fixed: one position found from the frames; free: "
            "any position in every frame, as for a rope in a hand or on a table"
        ),
    ] = "model"
    approximate_root_position: Annotated[
        XyzTuple | None, OptionInfo("position nearer to the root than to other ends, unless root is model", "m")
    ] = None
    seed: Annotated[int, Ge(0), OptionInfo("random seed of subsampling and skeleton extraction")] = 0

    def __post_init__(self) -> None:
        check_option_bounds(self, "track options")


_NO_FIT, _END_ELSEWHERE = "the shape does not fit", "an end is not where its gripper is"
_MISFIT_REASONS = (_NO_FIT, _END_ELSEWHERE)
_MAX_BEND_ANGLE = 1.2  # of a joint in a good frame [rad]
_MAX_DISTANCE_OVER_MEDIAN = 1.7  # of a frame's mean distance, over the median of good frames
_MAX_GRASP_GAP_CHANGE = 0.008  # distance of an end from its gripper, beyond the usual, of a wrong stamp [m]
_MIN_COVERED_VISIBLE_LENGTH_FRACTION = 0.6  # of the object, by points, in a good frame
_MIN_POINT_STD = 0.002  # lower bound of a point's std, for straight links in place of a curve [m]
_MAX_NOTES = 2  # notes in a hint
_MEAN_ABS_DEVIATION = math.sqrt(2.0 / math.pi)  # mean absolute deviation of a normal variable, in stds


def frame_rejection_reason(fit: FrameShapeFit, shape: ShapeFitter, options: TrackOptions) -> str | None:
    """Return the reason to reject a frame for its own fit, regardless of other frames. None if it is good."""
    if not np.isfinite(fit.q).all():
        return "the fit of the shape failed (its angles are not finite)"
    # a mean distance of normal noise is 0.8 of its standard deviation
    widest = options.max_mean_surface_distance_in_radii * float(shape.link_radii.mean())
    limit = math.hypot(widest, _MEAN_ABS_DEVIATION * shape.surface_noise_std)
    if not math.isfinite(fit.mean_distance):
        return f"{_NO_FIT}: no point of the cloud is near it"
    if fit.mean_distance > limit:
        most = f"track.options.max_mean_surface_distance_in_radii allows only {1e3 * limit:.1f} mm"
        return f"{_NO_FIT}: points are {1e3 * fit.mean_distance:.1f} mm from it on average, but {most}"
    bend = float(np.abs((fit.q - shape.rest_configuration)[list(shape.bend_joints)]).max())
    if bend > _MAX_BEND_ANGLE:
        most = f"but only {math.degrees(_MAX_BEND_ANGLE):.0f} degrees are allowed"
        return f"the shape is folded: a joint is bent by {math.degrees(bend):.0f} degrees, {most}"
    if fit.visible_length_coverage < _MIN_COVERED_VISIBLE_LENGTH_FRACTION:
        seen, least = (100 * x for x in (fit.visible_length_coverage, _MIN_COVERED_VISIBLE_LENGTH_FRACTION))
        return f"{_NO_FIT}: only {seen:.0f} % of its visible length has points of its own, not at least {least:.0f} %"
    return None


def mark_outlying_frames_as_dropped(frames: Sequence[FrameReport], grasped: Sequence[str]) -> list[FrameReport]:
    """Mark frames as dropped if misfit or gap at a point in `grasped` are far from good frames. Returns all frames."""
    fits = _good_fits(frames)
    if not fits:
        return list(frames)
    limit = _MAX_DISTANCE_OVER_MEDIAN * float(np.median([fit.mean_distance for fit in fits.values()]))
    gap, made = np.median([fit.grasp_gaps for fit in fits.values()], axis=0), list(frames)
    for k, fit in fits.items():
        reason, shifts = "", np.linalg.norm(fit.grasp_gaps - gap, axis=1)
        apart = float(shifts.max(initial=0.0))
        if fit.mean_distance > limit:
            off = f"points are {1e3 * fit.mean_distance:.1f} mm from it on average, but only {1e3 * limit:.1f} mm are"
            most = f"allowed ({_MAX_DISTANCE_OVER_MEDIAN} times the median of all images). A part may be hidden"
            reason = f"the shape fits worse than in other images: {off} {most}"
        elif apart > _MAX_GRASP_GAP_CHANGE:
            most = f"({1e3 * _MAX_GRASP_GAP_CHANGE:.0f} mm are allowed). The time stamp of this image may be late"
            at = f"the distance of {grasped[int(np.argmax(shifts))]} from its gripper"
            reason = f"{_END_ELSEWHERE}: {at} differs by {1e3 * apart:.0f} mm from that in most images {most}"
        made[k] = replace(frames[k], drop_reason=reason)
    return made


def _good_fits(frames: Sequence[FrameReport]) -> dict[int, FrameShapeFit]:
    """Fitted shapes of the good frames, by the position of the frame in `frames`."""
    return {k: frame.shape_fit for k, frame in enumerate(frames) if frame.is_good and frame.shape_fit is not None}


def times_configurations_points_of_good_frames(
    frames: Sequence[FrameReport],
    columns: Sequence[int],
    common: SequenceEstimates,
    foreign_objects: Sequence[ForeignObject],
    options: TrackOptions,
    source: str,
) -> tuple[Array, Array, Array, Array, Array]:
    """Return times (M,), configurations (M, n) and points (M, np, 3) of the M good frames, and two std of the points.

    The first std is the total, the second is its part from the calibration, common to all frames. `columns` are the
    indices of the points. Raises `DataError` if no frame is good, or if no frame shows a point well enough.
    """
    good, sizes, calibration = _good_fits(frames), common.dimensions, common.camera_calibration
    if not good:
        raise _none_good(frames, sizes, foreign_objects, source)
    fits, of = list(good.values()), list(columns)
    t = np.array([frames[k].joint_time for k in good])
    position = np.array([fit.point_positions[of] for fit in fits])
    by_sizes = np.array([sizes.point_std_from_dimensions(fit.dimension_equations.point_jacobian[of]) for fit in fits])
    std = np.hypot(np.hypot(np.array([fit.point_std[of] for fit in fits]), _MIN_POINT_STD), by_sizes)
    velocity = np.asarray(CubicSpline(t, position, axis=0)(t, 1)) if len(t) > 1 else np.zeros_like(position)
    # a point is measured at a uniformly distributed time within the exposure
    std = np.hypot(std, np.abs(velocity) * math.hypot(options.frame_stamp_std, options.exposure_time / math.sqrt(12.0)))
    flat = position.reshape(-1, 3), velocity.reshape(-1, 3), np.repeat([frames[k].stamp for k in good], len(of))
    shared = calibration.point_std_from_calibration(*flat).reshape(std.shape)
    std = np.hypot(std, shared)
    seen, limit = np.array([fit.is_point_seen[of] for fit in fits]), options.max_seen_point_std
    unseen = (np.linalg.norm(std, axis=2) > math.sqrt(3.0) * limit) | ~seen
    if unseen.all():
        best = float(np.sqrt((std**2).mean(axis=2))[seen].min(initial=math.inf))
        is_size = bool((np.linalg.norm(by_sizes, axis=2) > math.sqrt(3.0) * limit).all())
        known = f"no point is known to {1e3 * limit:g} mm in any frame: the smallest std is {1e3 * best:.3g} mm"
        what = f"{_because(sizes, is_size)}{known if seen.any() else 'no frame shows a point'}"
        check, where = "check track.camera_pose and the camera's clock", "track.options.max_seen_point_std"
        if seen.any() and not is_size:
            check = f"set {where}: {best + 5e-4:.3f} if this accuracy is enough. If not, {check}"
        allowed = f"one point in one frame with a std of at most {1e3 * limit:g} mm"
        raise DataError(what, where=where, allowed=allowed, hint=_hint(sizes, foreign_objects, check))
    position, std, shared = (np.where(unseen[..., None], np.nan, entry) for entry in (position, std, shared))
    return t, np.array([fit.q for fit in fits]), position, std, shared


def _none_good(
    frames: Sequence[FrameReport], sizes: TubeDimensionEstimates, things: Sequence[ForeignObject], source: str
) -> DataError:
    kinds = grouped((frame.drop_reason.partition(":")[0], frame.drop_reason) for frame in frames)
    often = sorted(kinds.values(), key=len, reverse=True)[:2]
    said = [own[0].replace(": ", ", for example: ", 1) if len(set(own)) > 1 else own[0] for own in often]
    cause = _because(sizes, next((reasons[0] for reasons in often), "").startswith(_MISFIT_REASONS))
    hint = "check track.camera_pose, track.point_cloud_unit and track.options.filters"
    of_cause = {
        "time stamp is": "set track.options.clock_offset_search.initial_stamp_minus_joint_time to the offset [s]",
        "not in metres": "set track.point_cloud_unit: mm, or unit: mm in camera.json",
        "from end to end": "tighten track.options.filters, or loosen them if a part is missing",
        "dense enough": "check track.point_cloud_unit, and loosen track.options.filters",
        "no encoding of depth": "set track.frame_topic to a topic of depth images (16UC1, 32FC1 or mono16)",
        "cannot be used": "copy or export the damaged files again",
        "crosses or touches itself": "record the object without crossings and contacts of its parts",
    }
    hints = [own for words, own in of_cause.items() if any(words in reasons[0] for reasons in often)]
    hint = _hint(sizes, things, "; ".join(hints) or hint)
    told = [f"in {len(own)} of {len(frames)} frames, {text}" for own, text in zip(often, said, strict=True)]
    what = f"{cause}no frame could be used: {'; '.join(told)}"
    return DataError(what, where=source, allowed="one usable frame or more", hint=hint)


def _because(sizes: TubeDimensionEstimates, matters: bool) -> str:
    """Beginning of an error message: the contradicted dimensions of the object, if they are the likely cause."""
    return f"{sizes.contradiction_message}, and " if matters and sizes.contradiction_message else ""


def _hint(sizes: TubeDimensionEstimates, things: Sequence[ForeignObject], otherwise: str) -> str:
    """Advice in an error message: on wrong dimensions and foreign objects first, then the advice `otherwise`."""
    return "; ".join([*[*sizes.messages, *(thing.text for thing in things)][:_MAX_NOTES], otherwise])


_TOUCHING_DISTANCE = 1e-3  # [m]
# parts of an object nearer than so many radii along it cannot help being near each other
_MIN_CROSSING_SEPARATION_RADII = 4.0
_MAX_SHAPE_STATIONS = 400  # places along a shape that are compared
_FIXED_ROOT_MOTION_RATIO = 2.0  # times
_SAME_ROOT_FRACTION = 0.1  # of the length between the ends; closer roots are the same
_HANGING_HEIGHT_FRACTION = 0.2  # of the length between the ends; height difference that makes one end higher


def choose_root_end_of_frames(frames: Sequence[FrameReport], options: TrackOptions) -> tuple[list[FrameReport], str]:
    """Return the frames with the object's root at the same end in all fits, and a text on how this end was chosen.

    A choice is needed if a shape fits equally well with its root at another end. Ends are first followed from frame to
    frame. The root is then the end that does not move (if the root is fixed) or the higher end.
    """
    if options.root_placement == "model":
        return list(frames), ""
    fitted = _good_fits(frames)
    two = [k for k in fitted if frames[k].alternative_fit is not None]
    if not two:
        near = "is the end nearest to track.options.approximate_root_position"
        said = "follows from the object's lengths and branches" if options.approximate_root_position is None else near
        return _fixed(frames, options), f"The object's first end (root) {said}"
    made, last = list(frames), None
    for k, fit in fitted.items():
        other_fit = frames[k].alternative_fit
        if other_fit is not None and last is not None and _apart(other_fit, last) < _apart(fit, last):
            made[k] = _exchanged(frames[k])
        last = made[k].shape_fit
    roots, tips = _ends(made[k].shape_fit for k in two)
    moving = [float(np.median(np.linalg.norm(ends - np.median(ends, axis=0), axis=1))) for ends in (roots, tips)]
    above = float(np.median(roots[:, 2] - tips[:, 2]))
    between = float(np.median(np.linalg.norm(roots - tips, axis=1)))
    own = float(np.median(np.linalg.norm(roots - _ends(made[k].alternative_fit for k in two)[0], axis=1)))
    if own < _SAME_ROOT_FRACTION * between:
        other, said = False, "is known. Equal branches are followed from image to image, and may be exchanged"
    elif options.root_placement == "fixed" and max(moving) > _FIXED_ROOT_MOTION_RATIO * min(moving):
        other, said = moving[0] > moving[1], "is the end that stays in its place"
    elif abs(above) > _HANGING_HEIGHT_FRACTION * between:
        other, said = above < 0, "is the higher end"
    else:
        other, said = False, "is one of two possible ends. If it is wrong, set track.options.approximate_root_position"
    if other:
        made = [_exchanged(frame) for frame in made]
    return _fixed(made, options), f"The object's first end (root) {said}"


def _exchanged(frame: FrameReport) -> FrameReport:
    if frame.alternative_fit is None:
        return frame
    return replace(frame, shape_fit=frame.alternative_fit, alternative_fit=frame.shape_fit)


def _apart(one: FrameShapeFit, other: FrameShapeFit) -> float:
    return float(np.linalg.norm(one.link_ends - other.link_ends, axis=2).mean())


def _ends(fits: Iterable[FrameShapeFit | None]) -> tuple[Array, Array]:
    """Positions of the roots, and of the tips of the last links, (fits, 3) each [m]."""
    lines = np.array([fit.link_ends for fit in fits if fit is not None])
    return lines[:, 0, 0], lines[:, -1, 1]


def _fixed(frames: Sequence[FrameReport], options: TrackOptions) -> list[FrameReport]:
    """Drop frames whose root position differs from the other frames, if the root is fixed."""
    good, made = _good_fits(frames), list(frames)
    if options.root_placement == "fixed" and good:
        roots = _ends(good.values())[0]
        for k, away in zip(good, np.linalg.norm(roots - np.median(roots, axis=0), axis=1), strict=True):
            if away > (most := _MAX_GRASP_GAP_CHANGE + 2 * options.max_seen_point_std):
                reason = f"the object's first end (root) is {1e3 * away:.0f} mm from its place in other images "
                reason += f"({1e3 * most:.0f} mm are allowed). If it moves, set track.options.root_placement: free"
                made[k] = replace(frames[k], drop_reason=reason)
    return made


def is_shape_self_touching(centre_line: Array, radius: Array) -> bool:
    """Check whether parts of a shape touch that are far apart along it. `centre_line` (K, 2, 3), `radius` (K,) [m]."""
    corners = centre_line.reshape(-1, 3)
    near = np.linalg.norm(corners[:, None] - corners, axis=2)
    edges = np.where(near < _TOUCHING_DISTANCE, 1e-6, 0.0)  # zero would mean no edge
    lengths = np.linalg.norm(centre_line[:, 1] - centre_line[:, 0], axis=1)
    starts = 2 * np.arange(len(centre_line))
    edges[starts, starts + 1] = edges[starts + 1, starts] = lengths
    along = shortest_path(edges, directed=False)
    spacing = max(float(radius.min()), float(lengths.sum()) / _MAX_SHAPE_STATIONS)
    link = np.repeat(np.arange(len(lengths)), np.ceil(lengths / spacing).astype(np.int64) + 1)
    share = np.concatenate([np.linspace(0.0, 1.0, np.count_nonzero(link == k)) for k in range(len(lengths))])
    places = centre_line[link, 0] + share[:, None] * (centre_line[link, 1] - centre_line[link, 0])
    to = [share * lengths[link], (1 - share) * lengths[link]]  # each end of its link
    ways = [along[np.ix_(2 * link + a, 2 * link + b)] + to[a][:, None] + to[b] for a in (0, 1) for b in (0, 1)]
    reach = radius[link][:, None] + radius[link]
    far = (np.min(ways, axis=0) > _MIN_CROSSING_SEPARATION_RADII * reach) & (link[:, None] != link)
    return bool((far & (np.linalg.norm(places[:, None] - places, axis=2) < reach)).any())
