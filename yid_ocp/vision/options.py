"""Settings of tracking, from frames to measured points."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from annotated_types import Ge

from yid_ocp.options import OptionInfo, PositiveFloat, UnitIntervalFloat, check_option_bounds
from yid_ocp.vision.calibration import CameraCalibrationOptions, CameraClockOptions
from yid_ocp.vision.fit import ShapeFitOptions
from yid_ocp.vision.point_cloud import CloudFilterOptions, SkeletonOptions, XyzCoordinates
from yid_ocp.vision.sequence_calibration import TubeDimensionKind
from yid_ocp.vision.surface_meshes import UrdfMeshKind

_RootPlacement = Literal["model", "fixed", "free"]


@dataclass(frozen=True)
class TrackOptions:
    """Settings that turn a frame sequence into measured points and select its good frames."""

    filters: Annotated[CloudFilterOptions, OptionInfo("what counts as the object")] = field(
        default_factory=CloudFilterOptions
    )
    skeleton: Annotated[SkeletonOptions, OptionInfo("how a cloud is thinned")] = field(default_factory=SkeletonOptions)
    shape_fit: Annotated[ShapeFitOptions, OptionInfo("how a shape is fitted")] = field(default_factory=ShapeFitOptions)
    clock: Annotated[CameraClockOptions, OptionInfo("how the camera's clock is compared with the joints'")] = field(
        default_factory=CameraClockOptions
    )
    calibration: Annotated[
        CameraCalibrationOptions,
        OptionInfo("how pose, depth and clock of the camera are estimated from the arm that it sees"),
    ] = field(default_factory=CameraCalibrationOptions)
    background_estimation: Annotated[
        Literal["none", "frames"],
        OptionInfo(
            "frames: what stands still in most frames, away from every shape that was fitted, is left out; beside it "
            "track.background_frames"
        ),
    ] = "none"
    estimated_dimensions: Annotated[
        tuple[TubeDimensionKind, ...],
        OptionInfo(
            "sizes of the tubes that are estimated from the clouds, where these tell them; all are checked anyway"
        ),
    ] = ()
    max_distance_in_radii: Annotated[
        PositiveFloat,
        OptionInfo(
            "a frame whose points are further from the fitted shape on average, beyond their noise, is dropped; in "
            "radii of the tubes"
        ),
    ] = 0.5
    max_bend_angle: Annotated[
        PositiveFloat, OptionInfo("a frame whose shape has a joint that is bent further is dropped", "rad")
    ] = 1.2
    max_distance_ratio: Annotated[
        PositiveFloat, OptionInfo("a frame whose distance is so many times the median of all good frames is dropped")
    ] = 1.7
    max_grasp_gap_change: Annotated[
        PositiveFloat,
        OptionInfo(
            "a frame in which an end is further from the gripper that holds it than usual by more is dropped: its time "
            "is not what its stamp says",
            "m",
        ),
    ] = 0.008
    min_visible_coverage: Annotated[
        UnitIntervalFloat,
        OptionInfo("a frame with points on a smaller share of the object's visible length is dropped"),
    ] = 0.6
    max_point_std: Annotated[
        PositiveFloat, OptionInfo("a point that is known less well in a frame counts as not seen there", "m")
    ] = 0.02
    min_point_std: Annotated[
        PositiveFloat,
        OptionInfo("standard deviation that no fit is better than, of straight links in place of a curve", "m"),
    ] = 0.002
    stamp_std: Annotated[
        float, Ge(0), OptionInfo("standard deviation of a frame's time stamp, beyond the common offset", "s")
    ] = 0.003
    exposure_time: Annotated[
        float,
        Ge(0),
        OptionInfo("how long the camera looks for one frame, half of it before its stamp and half behind", "s"),
    ] = 0.0
    tracked_points: Annotated[
        tuple[str, ...] | None,
        OptionInfo("points to write down; those that no arm holds when absent, as arms know theirs better"),
    ] = None
    root_placement: Annotated[
        _RootPlacement,
        OptionInfo(
            "where the object's root is: as the model has it; fixed in one place that is found from the frames; or "
            "free, anywhere in every frame, as of a rope in a hand or on a table"
        ),
    ] = "model"
    approximate_root_position: Annotated[
        XyzCoordinates | None,
        OptionInfo("place in the world to which the root is nearer than other ends, where root is not model", "m"),
    ] = None
    robot_mesh_kind: Annotated[UrdfMeshKind, OptionInfo("meshes of the robot's self-filter")] = "visual"
    seed: Annotated[int, Ge(0), OptionInfo("of the walk's random points and of all subsampling")] = 0

    def __post_init__(self) -> None:
        check_option_bounds(self, "track options")
