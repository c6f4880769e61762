"""An arm of two joints beside a flexible Y, and what its sensors read."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import casadi as ca
import numpy as np
import pytest

from yid_ocp.model import Mechanism, Segment, System, flexible_object
from yid_ocp.model.mechanism import Frame, Inertia, Joint, Placement
from yid_ocp.model.rotations import homogeneous_transform, rotation_from_rpy
from yid_ocp.sensors import Sensor, sensor_reading_function

Read = Callable[..., np.ndarray]


@pytest.fixture(scope="session")
def system() -> System:
    along = Placement.from_matrix(homogeneous_transform(np.eye(3), [0.0, 0.0, 0.5]))
    body = Inertia.from_values(1.0, [0.0, 0.0, 0.25], np.diag([0.02, 0.02, 0.001]))
    upper = Joint("left_a", "revolute", -1, Placement.identity(), (0.0, 1.0, 0.0), (body,))
    lower = Joint("left_b", "revolute", 0, along, (1.0, 0.0, 0.0), (body,))
    robot = Mechanism("arm", (upper, lower), {"left_gripper": Frame(1, along)})
    segments = (
        Segment("T1", 0.4, 0.08, 0.03, 2),
        Segment("T2", 0.3, 0.04, 0.01, 1, parent="T1", rest_rotation=rotation_from_rpy(-0.8, 0.0, 0.0)),
    )
    return System.build(robot, objects=[(flexible_object(segments), None, None)], prescribed=robot.joint_names)


@pytest.fixture(scope="session")
def read() -> Read:
    """read(system, sensor, q, effort): outputs at the parameters' nominal values."""

    def outputs(
        system: System, sensor: Sensor, q: Sequence[float] | None = None, effort: Sequence[float] | None = None
    ) -> np.ndarray:
        n = system.n_coordinates
        function = sensor_reading_function(system, sensor, ())
        at = {name: np.zeros(n) if values is None else values for name, values in (("q", q), ("load", effort))}
        return np.array(ca.densify(function(**at, theta=system.parameters.vector())["y"])).ravel()

    return outputs
