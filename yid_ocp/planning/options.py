"""Settings of a planned motion: its goal and its limits."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Literal

from annotated_types import Ge, Gt, Le

from yid_ocp.options import OptionInfo

_Vector3 = tuple[float, float, float]
_PlanGoal = Literal["place", "path", "box", "information"]


@dataclass(frozen=True, kw_only=True)
class PlanLimits:
    """Limits of the motion; joints also keep the position, velocity and effort limits of the URDF."""

    velocity_fraction: Annotated[float, Gt(0), Le(1), OptionInfo("part of the URDF's velocity limits that is used")] = (
        0.9
    )
    max_acceleration: Annotated[float, Gt(0), OptionInfo("of every joint", "rad/s^2 or m/s^2")] = 20.0
    effort_fraction: Annotated[float, Gt(0), Le(1), OptionInfo("part of the URDF's effort limits that is used")] = 0.9
    max_spring_angle: Annotated[
        float | None, Gt(0), OptionInfo("of every spring of the object; none when absent", "rad")
    ] = None


@dataclass(frozen=True, kw_only=True)
class PlanOptions:
    """Goal, duration and numerics of a planned motion of the arms."""

    goal: Annotated[
        _PlanGoal,
        OptionInfo(
            "bring a point to a place, there along a path, or there with points kept inside a box; or move so that the "
            "recordings tell most"
        ),
    ] = "place"
    point: Annotated[str | None, OptionInfo("frame that is to arrive: a tip of the object, T3:50%, a gripper")] = None
    target_position: Annotated[_Vector3 | None, OptionInfo("where to, in the world; or give a shift", "m")] = None
    target_offset: Annotated[_Vector3 | None, OptionInfo("where to, from where the point rests at the start", "m")] = (
        None
    )
    waypoint_offsets: Annotated[
        tuple[_Vector3, ...], OptionInfo("of a path: shifts on the way, passed at equal times", "m")
    ] = ()
    box: Annotated[tuple[_Vector3, _Vector3] | None, OptionInfo("lowest and highest corner in the world", "m")] = None
    frames_in_box: Annotated[
        tuple[str, ...] | None, OptionInfo("frames kept inside the box; all points of the object")
    ] = None
    start_joint_positions: Annotated[
        Mapping[str, float] | None,
        OptionInfo(
            "joints at the start, at rest; when absent those with which the first recording begins, else those of the "
            "arms' first grasp of the undeformed object",
            "rad or m",
        ),
    ] = None
    duration: Annotated[float, Gt(0), Le(60), OptionInfo("of the arms' motion", "s")] = 1.5
    hold_duration: Annotated[
        float, Gt(0), Le(60), OptionInfo("after it, the arms at rest and the point in its place", "s")
    ] = 0.5
    n_spline_coefficients: Annotated[
        int, Ge(2), Le(40), OptionInfo("unknowns of each joint's spline of degree 5, its end included")
    ] = 7
    minimize_duration: Annotated[
        bool, OptionInfo("whether the shortest duration is sought with which the goal is reached")
    ] = False
    position_tolerance: Annotated[float, Gt(0), OptionInfo("distance that counts as reached", "m")] = 1e-3
    rest_speed_tolerance: Annotated[float, Gt(0), OptionInfo("speed of the point that counts as rest", "m/s")] = 0.01
    effort_weight: Annotated[
        float, Ge(0), OptionInfo("weight of the mean squared effort in parts of its limit; raise it for calm motions")
    ] = 0.0
    minimize_parameter_sensitivity: Annotated[
        bool, OptionInfo("whether the error that comes of the parameters' uncertainty is minimised along")
    ] = False
    identify: Annotated[
        tuple[str, ...] | None,
        OptionInfo("of information: parameters that are to be told most precisely together; all free ones when absent"),
    ] = None
    discriminate: Annotated[
        tuple[str, ...] | None, OptionInfo("of information: effects, kind@location, that are to be told apart")
    ] = None
    n_random_starts: Annotated[
        int,
        Ge(1),
        Le(1000),
        OptionInfo("of information: random motions from which the search begins; the best is kept"),
    ] = 5
    seed: Annotated[int, Ge(0), OptionInfo("of these motions")] = 0
    limits: Annotated[PlanLimits, OptionInfo("of joints and springs")] = field(default_factory=PlanLimits)
    max_iterations: Annotated[
        int,
        Ge(1),
        OptionInfo(
            "limit on evaluations of a search, each time the limits are sharpened; of information, on its rounds"
        ),
    ] = 100
