"""Settings of a planned motion: its goal and its limits."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Literal

from annotated_types import Ge, Gt, Le

from yid_ocp.options import About

Triple = tuple[float, float, float]
Goal = Literal["place", "path", "box", "information"]


@dataclass(frozen=True, kw_only=True)
class PlanLimits:
    """Limits of the motion; joints also keep the position, velocity and effort limits of the URDF."""

    velocity: Annotated[float, Gt(0), Le(1), About("part of the URDF's velocity limits that is used")] = 0.9
    acceleration: Annotated[float, Gt(0), About("of every joint", "rad/s^2 or m/s^2")] = 20.0
    effort: Annotated[float, Gt(0), Le(1), About("part of the URDF's effort limits that is used")] = 0.9
    spring_angle: Annotated[float | None, Gt(0), About("of every spring of the object; none when absent", "rad")] = None


@dataclass(frozen=True, kw_only=True)
class PlanOptions:
    """Goal, duration and numerics of a planned motion of the arms."""

    goal: Annotated[
        Goal,
        About(
            "bring a point to a place, there along a path, or there with points kept inside a box; or move so that the "
            "recordings tell most"
        ),
    ] = "place"
    point: Annotated[str | None, About("frame that is to arrive: a tip of the object, T3:50%, a gripper")] = None
    place: Annotated[Triple | None, About("where to, in the world; or give a shift", "m")] = None
    shift: Annotated[Triple | None, About("where to, from where the point rests at the start", "m")] = None
    via: Annotated[tuple[Triple, ...], About("of a path: shifts on the way, passed at equal times", "m")] = ()
    box: Annotated[tuple[Triple, Triple] | None, About("lowest and highest corner in the world", "m")] = None
    inside: Annotated[tuple[str, ...] | None, About("frames kept inside the box; all points of the object")] = None
    posture: Annotated[
        Mapping[str, float] | None,
        About(
            "joints at the start, at rest; when absent those with which the first recording begins, else those of the "
            "arms' first grasp of the undeformed object",
            "rad or m",
        ),
    ] = None
    duration: Annotated[float, Gt(0), Le(60), About("of the arms' motion", "s")] = 1.5
    settle: Annotated[float, Gt(0), Le(60), About("after it, the arms at rest and the point in its place", "s")] = 0.5
    knots: Annotated[int, Ge(2), Le(40), About("unknowns of each joint's spline of degree 5, its end included")] = 7
    shortest: Annotated[bool, About("whether the shortest duration is sought with which the goal is reached")] = False
    tolerance: Annotated[float, Gt(0), About("distance that counts as reached", "m")] = 1e-3
    swing: Annotated[float, Gt(0), About("speed of the point that counts as rest", "m/s")] = 0.01
    effort: Annotated[
        float, Ge(0), About("weight of the mean squared effort in parts of its limit; raise it for calm motions")
    ] = 0.0
    spread: Annotated[bool, About("whether the error that comes of the parameters' uncertainty is minimised along")] = (
        False
    )
    inform: Annotated[
        tuple[str, ...] | None,
        About("of information: parameters that are to be told most precisely together; all free ones when absent"),
    ] = None
    separate: Annotated[
        tuple[str, ...] | None, About("of information: effects, kind@location, that are to be told apart")
    ] = None
    starts: Annotated[
        int, Ge(1), Le(1000), About("of information: random motions from which the search begins; the best is kept")
    ] = 5
    seed: Annotated[int, Ge(0), About("of these motions")] = 0
    limits: Annotated[PlanLimits, About("of joints and springs")] = field(default_factory=PlanLimits)
    iterations: Annotated[
        int,
        Ge(1),
        About("limit on evaluations of a search, each time the limits are sharpened; of information, on its rounds"),
    ] = 100
