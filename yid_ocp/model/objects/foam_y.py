"""The foam letter Y of Caldwell (ISER 2014). Three tubes of four links each stand on the ground."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from annotated_types import Ge, Le

from yid_ocp.model.flexible import FlexibleObject, FlexibleSegment, flexible_object
from yid_ocp.model.mechanism import homogeneous_transform, rotation_from_rpy
from yid_ocp.model.objects.base import OBJECT_KINDS, InitialObjectSettings, InitObjectFactory, MountedObjectBuilder
from yid_ocp.options import OptionInfo

_FOOT_POSE = homogeneous_transform(np.eye(3), (0.85, 0.0, -0.93))  # of the trunk in Baxter's `base` [m]


def foam_y_segments() -> tuple[FlexibleSegment, ...]:
    """Define the segments of the foam Y. Branches T2 and T3 leave the trunk T1 at 45 degrees, towards +y and -y."""
    lean = math.radians(45.0)
    return (
        FlexibleSegment("T1", 0.813, 0.064, 0.032),
        FlexibleSegment("T2", 0.610, 0.015, 0.025, parent="T1", rest_rotation=rotation_from_rpy(-lean, 0.0, 0.0)),
        FlexibleSegment("T3", 0.737, 0.016, 0.019, parent="T1", rest_rotation=rotation_from_rpy(lean, 0.0, 0.0)),
    )


def foam_y_object(links: int = 4, gravity_fraction: float = 1.0) -> FlexibleObject:
    """Build the foam Y with its foot at (0.85, 0, -0.93) m. Joint stiffnesses do not depend on `links`."""
    return _FoamY(links=links, gravity_fraction=gravity_fraction).build(FlexibleSegment.damping)


def _init_object(numbers: Mapping[str, Any], links: int) -> InitialObjectSettings:
    names = [f"{segment.name}.{quantity}" for segment in foam_y_segments() for quantity in ("bend", "twist")]
    values, text = dict.fromkeys(names, (3.0, "")), "stiffness of every joint of a tube [N m/rad]"
    return InitialObjectSettings(_FoamY(links=links), values, text, True)


@OBJECT_KINDS.register("foam_y")
@dataclass(frozen=True, kw_only=True)
class _FoamY(MountedObjectBuilder):
    """The foam letter Y of Caldwell (ISER 2014). Without a mount its foot is at the position of that experiment."""

    init_templates: ClassVar[Mapping[str, InitObjectFactory]] = {"foam_y": InitObjectFactory(4, _init_object)}

    kind: Annotated[Literal["foam_y"], OptionInfo("kind of object")] = "foam_y"
    links: Annotated[int, Ge(1), Le(64), OptionInfo("number of rigid links of every tube")] = 4

    def segment_definitions(self, damping: float = 0.0, link_division: int = 1) -> list[FlexibleSegment]:
        """Return the three tubes of the foam Y. The nominal joint stiffness does not depend on the setting `links`."""
        n = link_division
        links, damping = self.links * n, damping * n
        return [replace(s, links=links, bend=s.bend * n, twist=s.twist * n, damping=damping) for s in foam_y_segments()]

    def build(self, damping: float, link_division: int = 1) -> FlexibleObject:
        segments = self.segment_definitions(damping, link_division)
        return flexible_object(segments, _FOOT_POSE if self.mount is None else None, "y_object", self.gravity_fraction)
