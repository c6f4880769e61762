"""A double pendulum that holds a rod with a relaxing branch, for tests of equations by name."""

from pathlib import Path
from typing import Any

from yid_ocp.effects import make_effect
from yid_ocp.model import FlexibleSegment, Grasp, System, flexible_object
from yid_ocp.model.urdf import read_urdf


def held_rod(
    urdf_folder: Path, *, links: int = 2, kind: str = "point", ratio: float | None = None, **more: Any
) -> System:
    """The system; `more` goes to `System.build`."""
    robot = read_urdf(urdf_folder / "double_pendulum.urdf")
    rod = flexible_object([FlexibleSegment("T1", 0.6, 0.1, 0.02, links=links, bend=4.0, twist=3.0)])
    system = System.build(robot, objects=[(rod, None, None)], grasps=[Grasp("hand", "tip", "w_T1", kind)], **more)
    values = {} if ratio is None else {"ratio": ratio}
    return system.with_effects([make_effect("standard_linear_solid", "T1", system, values)])
