"""Settings of tracking, from frames to measured points."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from annotated_types import Ge, Gt, Le

from yid_ocp.options import About, check
from yid_ocp.vision.calibration import CalibrationOptions
from yid_ocp.vision.clock import ClockOptions
from yid_ocp.vision.doubt import SizeKind
from yid_ocp.vision.filters import FilterOptions, Triple
from yid_ocp.vision.fit import FitOptions
from yid_ocp.vision.meshes import MeshKind
from yid_ocp.vision.skeleton import WalkOptions

RootPlace = Literal["model", "fixed", "free"]


@dataclass(frozen=True)
class TrackOptions:
    """Settings that turn a frame sequence into measured points and select its good frames."""

    filters: Annotated[FilterOptions, About("what counts as the object")] = field(default_factory=FilterOptions)
    walk: Annotated[WalkOptions, About("how a cloud is thinned")] = field(default_factory=WalkOptions)
    fit: Annotated[FitOptions, About("how a shape is fitted")] = field(default_factory=FitOptions)
    clock: Annotated[ClockOptions, About("how the camera's clock is compared with the joints'")] = field(
        default_factory=ClockOptions
    )
    calibration: Annotated[
        CalibrationOptions, About("how pose, depth and clock of the camera are estimated from the arm that it sees")
    ] = field(default_factory=CalibrationOptions)
    background: Annotated[
        Literal["none", "frames"],
        About(
            "frames: what stands still in most frames, away from every shape that was fitted, is left out; beside it "
            "track.background"
        ),
    ] = "none"
    estimate: Annotated[
        tuple[SizeKind, ...],
        About("sizes of the tubes that are estimated from the clouds, where these tell them; all are checked anyway"),
    ] = ()
    d_max: Annotated[
        float,
        Gt(0),
        About(
            "a frame whose points are further from the fitted shape on average, beyond their noise, is dropped; in "
            "radii of the tubes"
        ),
    ] = 0.5
    largest_bend: Annotated[
        float, Gt(0), About("a frame whose shape has a joint that is bent further is dropped", "rad")
    ] = 1.2
    worse: Annotated[
        float, Gt(0), About("a frame whose distance is so many times the median of all good frames is dropped")
    ] = 1.7
    gap_max: Annotated[
        float,
        Gt(0),
        About(
            "a frame in which an end is further from the gripper that holds it than usual by more is dropped: its time "
            "is not what its stamp says",
            "m",
        ),
    ] = 0.008
    least_covered: Annotated[
        float,
        Ge(0),
        Le(1),
        About("a frame with points on a smaller share of the object's visible length is dropped"),
    ] = 0.6
    point_std_max: Annotated[
        float, Gt(0), About("a point that is known less well in a frame counts as not seen there", "m")
    ] = 0.02
    std_floor: Annotated[
        float, Gt(0), About("standard deviation that no fit is better than, of straight links in place of a curve", "m")
    ] = 0.002
    stamp_std: Annotated[
        float, Ge(0), About("standard deviation of a frame's time stamp, beyond the common offset", "s")
    ] = 0.003
    exposure: Annotated[
        float, Ge(0), About("how long the camera looks for one frame, half of it before its stamp and half behind", "s")
    ] = 0.0
    points: Annotated[
        tuple[str, ...] | None,
        About("points to write down; those that no arm holds when absent, as arms know theirs better"),
    ] = None
    root: Annotated[
        RootPlace,
        About(
            "where the object's root is: as the model has it; fixed in one place that is found from the frames; or "
            "free, anywhere in every frame, as of a rope in a hand or on a table"
        ),
    ] = "model"
    root_near: Annotated[
        Triple | None,
        About("place in the world to which the root is nearer than other ends, where root is not model", "m"),
    ] = None
    mesh: Annotated[MeshKind, About("meshes of the robot's self-filter")] = "visual"
    seed: Annotated[int, Ge(0), About("of the walk's random points and of all subsampling")] = 0

    def __post_init__(self) -> None:
        check(self, "track options")
