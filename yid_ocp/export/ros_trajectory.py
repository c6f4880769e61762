"""Joint trajectories as a ROS message for robot controllers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from numpy.typing import NDArray


def joint_trajectory_message(
    names: Sequence[str],
    t: NDArray,
    position: NDArray,
    velocity: NDArray,
    acceleration: NDArray,
    effort: NDArray,
) -> dict[str, Any]:
    """A joint trajectory as a dict in the form of ROS's trajectory_msgs/JointTrajectory.

    Parameters
    ----------
    names : sequence of str
        Joints, nj of them.
    t : ndarray, shape (N,)
        Since the start [s].
    position, velocity, acceleration, effort : ndarray, shape (N, nj)

    References
    ----------
    https://docs.ros.org/en/api/trajectory_msgs/html/msg/JointTrajectory.html
    """
    points = []
    for i, time in enumerate(t):
        second = math.floor(time)
        points.append(
            {
                "positions": position[i].tolist(),
                "velocities": velocity[i].tolist(),
                "accelerations": acceleration[i].tolist(),
                "effort": effort[i].tolist(),
                "time_from_start": {"sec": second, "nanosec": min(round(1e9 * (time - second)), 999_999_999)},
            }
        )
    return {
        "header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""},
        "joint_names": list(names),
        "points": points,
    }
